"""Compare stock SAC with CTCO: the same environment, number of steps, networks and updates.

    python examples/compare_with_sac.py --env Pendulum-v1 --steps 20000

Writes a figure of learning curves over environment steps and task seconds, and prints a table. Both algorithms get the
same arguments, but for the temperature that they start at (1 with SAC, 0.02 with CTCO), and both are measured by the
same code in the same bare environment.
"""

import argparse
import math
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_ctco import CTCO
from sb3_ctco.evaluation import DiscountedReturnCallback, EpisodeStatistics, evaluate_discounted_return
from sb3_ctco.options import discount_rate_from_gamma
from sb3_ctco.wrappers import find_dt

mpl.use("Agg")
from matplotlib import pyplot as plt


@dataclass
class Run:
    """One training: its episodes, when they ended, greedy episodes after it, and the wall-clock time it took."""

    steps: list[int]
    episodes: list[EpisodeStatistics]
    greedy: list[EpisodeStatistics]
    wall_seconds: float


def train(name: str, args: argparse.Namespace, seed: int) -> Run:
    env = gym.make(args.env, **({"dt": 1 / args.rate} if args.rate else {}))
    dt = args.dt or find_dt(env)
    if dt is None:
        raise SystemExit(f"{args.env} does not tell its interaction period: pass --dt, in s, or give it an attribute dt")
    common: dict[str, Any] = {
        "learning_rate": args.learning_rate,
        "learning_starts": args.learning_starts,
        "batch_size": args.batch_size,
        "tau": 0.005,  # SAC's default; CTCO's is another one
        "train_freq": args.train_freq,
        "gradient_steps": args.gradient_steps,
        "policy_kwargs": {"net_arch": args.net_arch},
        "seed": seed,
        "device": "cpu",
    }
    gamma_dt = args.gamma_dt or dt
    discount_rate = discount_rate_from_gamma(args.gamma, gamma_dt)
    model: OffPolicyAlgorithm
    if name == "SAC":
        model = SAC("MlpPolicy", env, gamma=math.exp(-discount_rate * dt), **common)
    else:
        model = CTCO("MlpPolicy", env, gamma=args.gamma, gamma_dt=gamma_dt, d_max=args.d_max, dt=args.dt, **common)
    callback = DiscountedReturnCallback(discount_rate, dt)
    start = time.time()
    model.learn(args.steps, callback, progress_bar=args.progress)
    wall_seconds = time.time() - start
    if not callback.episodes:
        raise SystemExit(f"no episode ended in {args.steps} steps: pass more --steps")
    greedy = evaluate_discounted_return(
        model, model.get_env(), args.eval_episodes, discount_rate=discount_rate, dt=dt, smoothness=True
    )
    return Run(callback.timesteps, callback.episodes, greedy, wall_seconds)


def curve(run: Run, grid: np.ndarray, window: int) -> np.ndarray:
    """Mean return of the last ``window`` episodes at each number of steps; nan before the first episode's end."""
    returns = np.array([episode.episode_return for episode in run.episodes])
    ended = np.searchsorted(run.steps, grid, side="right")
    return np.array([returns[max(0, n - window) : n].mean() if n else np.nan for n in ended])


def plot(runs: dict[str, list[Run]], args: argparse.Namespace, path: Path) -> None:
    grid = np.linspace(0, args.steps, 201)
    first = next(iter(runs.values()))[0]
    seconds_per_step = sum(episode.seconds for episode in first.episodes) / first.steps[-1]
    figure, axis = plt.subplots(figsize=(6.5, 4), layout="constrained")
    for name, of_name in runs.items():
        curves = np.array([curve(run, grid, args.window) for run in of_name])
        (line,) = axis.plot(grid, curves.mean(axis=0), linewidth=1.8, label=name)
        if len(of_name) > 1:
            axis.fill_between(grid, curves.min(axis=0), curves.max(axis=0), alpha=0.2, color=line.get_color(), linewidth=0)
    n_seeds = len(next(iter(runs.values())))
    band = f"; mean and range of {n_seeds} seeds" if n_seeds > 1 else "; one seed"
    axis.set_xlabel("environment steps")
    axis.set_ylabel(f"training return, mean of {args.window} episodes")
    axis.set_title(f"{args.env}{band}", fontsize=10, loc="left", pad=34)
    axis.set_xlim(0, args.steps)
    axis.legend(frameon=False, loc="lower right")
    axis.spines["right"].set_visible(False)
    task_time = axis.secondary_xaxis("top", functions=(lambda n: n * seconds_per_step, lambda s: s / seconds_per_step))
    task_time.set_xlabel("task time, s")
    figure.savefig(path, dpi=150, bbox_inches="tight")
    plt.close(figure)


def table(runs: dict[str, list[Run]]) -> str:
    rows = [
        "| | return | discounted return | decisions a second | mean jerk, 1/s³ | spectral smoothness | wall-clock, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, of_name in runs.items():
        greedy = [episode for run in of_name for episode in run.greedy]

        def mean(attribute: str, episodes: list[EpisodeStatistics] = greedy) -> float:
            return float(np.mean([getattr(episode, attribute) for episode in episodes]))

        wall = np.mean([run.wall_seconds for run in of_name])
        rows.append(
            f"| {name} | {mean('episode_return'):.1f} | {mean('discounted_return'):.2f} | {mean('decision_rate_hz'):.1f} "
            f"| {mean('mean_absolute_jerk'):.0f} | {mean('spectral_smoothness'):.5f} | {wall:.0f} |"
        )
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1", help="Gymnasium id, or module:id of one that a module registers")
    parser.add_argument("--dt", type=float, help="interaction period in s, for environments that do not tell it")
    parser.add_argument("--rate", type=float, help="control rate in Hz, for environments that take dt")
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps")
    parser.add_argument("--seeds", type=int, default=1, help="how many, from 0 on")
    parser.add_argument("--net-arch", type=int, nargs="+", default=[64, 64])
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--learning-starts", type=int, default=1000)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--train-freq", type=int, default=1, help="environment steps between two trainings")
    parser.add_argument("--gradient-steps", type=int, default=-1, help="updates per training; -1 is one a step")
    parser.add_argument("--gamma", type=float, default=0.98, help="discount factor over GAMMA_DT seconds, for both")
    parser.add_argument("--gamma-dt", type=float, default=0.05, help="in s; 0 for a step (--gamma 0.99 is SAC's)")
    parser.add_argument("--d-max", type=float, default=0.3, help="CTCO's longest option, s")
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("--window", type=int, default=10, help="episodes that a point of the curves averages")
    parser.add_argument("--figure", default="compare_with_sac.png")
    parser.add_argument("--progress", action="store_true")
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*GLFW.*")
    th.set_num_threads(1)

    runs = {name: [train(name, args, seed) for seed in range(args.seeds)] for name in ("SAC", "CTCO")}
    print(table(runs))
    plot(runs, args, Path(args.figure))
    print(f"wrote {args.figure}")


if __name__ == "__main__":
    main()
