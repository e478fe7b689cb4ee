"""Trained policies where the clock is not training's: other rates, ticks that come late, observations that are old.

    sb3-ctco study run --preset quick --rates 500 --algorithms ctco --settings tuned
    sb3-ctco study run --preset opponents --rates 500 --settings 20ms --folder runs/study/quick
    python benchmarks/robustness.py runs/study/quick --output results/robustness

Every model of CTCO, FiGAR-SAC and SAC (also with held actions) in a study's folder plays greedily. Options and held actions
have their durations in seconds, so that they mean the same at another rate; SAC decides once a tick, whatever that takes.
Writes a row an episode to robustness.csv, and draws robustness.png:

- rate: the environment has another step, from 12.5 to 1,000 Hz
- jitter: each step takes a time of its own, dt·(1 ± the share that is given), uniformly; played at 1,000 Hz with actions held
- age: the policy sees the observation of so many ms ago
"""

import argparse
import csv
import json
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_ctco import OptionController
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.options import discount, step_weight
from sb3_ctco.registry import ALGORITHMS, find_task
from sb3_ctco.study.agents import constructor_arguments
from sb3_ctco.study.agents import discount_rate as discount_rate_of
from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import RECORD, SETTINGS

RATES = (12.5, 25, 50, 100, 250, 500, 1000)
JITTERS = (0.0, 0.25, 0.5, 0.75)
AGES = (0.0, 0.01, 0.02, 0.05, 0.1)
#: Rate of the environment in which ticks come at times of their own
FINEST = 1000
#: DAC-PPO's observations are normalised by statistics that a run does not keep; chunks and TaCoS have other actions
PLAYED = ("ctco", "figar_sac", "sac", "sac_repeat", "sac_gsde", "sac_pink")
COLUMNS = ("task", "algorithm", "setting", "rate", "seed", "what", "value", "discounted_return")


def act_of(run: Run, folder: Path) -> Callable[[float], Callable[[np.ndarray, float], np.ndarray]]:
    """What makes, for a control period in s, a function from an observation and the time in s to an action."""
    file = folder / "model.zip"
    if issubclass(ALGORITHMS[run.algorithm].zoo_class or SAC, OptionOffPolicyAlgorithm):
        policy = OptionController(file).policy

        def make(dt: float) -> Callable[[np.ndarray, float], np.ndarray]:
            # The policy alone, without limits of how fast commands change
            controller = OptionController(policy, dt=dt, safety=None)
            return lambda obs, now: controller(obs, now=now)

        return make
    model = SAC.load(file, device="cpu")
    hold = constructor_arguments(run).get("hold_seconds") or 0.0

    def make_held(dt: float) -> Callable[[np.ndarray, float], np.ndarray]:
        held: dict[str, Any] = {"until": 0.0}

        def act(obs: np.ndarray, now: float) -> np.ndarray:
            if now >= held["until"] - dt / 2:
                held["action"] = model.predict(obs, deterministic=True)[0]
                held["until"] = now + hold
            return held["action"]

        return act

    return make_held


def play(
    env: gym.Env,
    act: Callable[[np.ndarray, float], np.ndarray],
    dt: float,
    ticks: Iterator[int],
    age: float,
    discount_rate: float,
) -> float:
    """Discounted return of an episode.

    :param dt: the environment's step, in s
    :param ticks: after how many steps of it the next action is asked for
    :param age: of the observation, in s
    """
    obs, _ = env.reset()
    seen: deque[np.ndarray] = deque([obs], maxlen=round(age / dt) + 1)
    value, step, until, action, done = 0.0, 0, 0, None, False
    while not done:
        if step >= until:
            action = act(seen[0], step * dt)
            until += next(ticks)
        obs, reward, terminated, truncated, _ = env.step(action)
        seen.append(obs)
        value += float(discount(step * dt, discount_rate)) * float(reward) * step_weight(dt, discount_rate)
        step += 1
        done = terminated or truncated
    return value


def measure(run: Run, folder: Path, episodes: int) -> Iterator[tuple[Any, ...]]:
    """A row an episode."""
    make_act, discount_rate = act_of(run, folder), discount_rate_of(run)
    rng = np.random.default_rng(run.seed)

    def returns(rate: float, dt: float, share: float, age: float) -> Iterator[float]:
        task = find_task(run.task)
        env = gym.make(task.env_id, disable_env_checker=True, dt=1 / rate, time_limit=task.episode_seconds, **task.env_kwargs)
        env.reset(seed=10_000 + run.seed)
        for _ in range(episodes):
            ticks = iter(lambda: max(1, round(dt * rate * (1 + share * rng.uniform(-1, 1)))), 0)
            yield play(env, make_act(dt), 1 / rate, ticks, age, discount_rate)
        env.close()

    cell = run.task, run.algorithm, run.setting, run.rate, run.seed
    for rate in RATES:
        yield from ((*cell, "rate", rate, value) for value in returns(rate, 1 / rate, 0.0, 0.0))
    for share in JITTERS:
        yield from ((*cell, "jitter", share, value) for value in returns(FINEST, run.dt, share, 0.0))
    for age in AGES:
        rate = max(run.rate, 100)  # so that 10 ms are a whole number of steps
        yield from ((*cell, "age", age, value) for value in returns(rate, run.dt, 0.0, age))


def draw(rows: list[dict[str, Any]], file: Path) -> None:
    """A row a task, a column a disturbance; mean over seeds, a thin line a seed."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(row["task"] for row in rows))
    labels = {"rate": "control rate [Hz]", "jitter": "jitter, share of dt", "age": "age of the observation [ms]"}
    figure, axes = plt.subplots(len(tasks), 3, figsize=(11, 2.6 * len(tasks) + 1), squeeze=False, layout="constrained")
    for of_task, task in zip(axes, tasks, strict=True):
        for ax, (what, label) in zip(of_task, labels.items(), strict=True):
            here = [row for row in rows if (row["task"], row["what"]) == (task, what)]
            lines = list(dict.fromkeys((row["algorithm"], row["setting"], row["rate"]) for row in here))
            for algorithm, setting, rate in lines:
                style: dict[str, Any] = {"color": ALGORITHMS[algorithm].colour, "linestyle": "-" if rate > 100 else "--"}
                seeds: dict[int, dict[float, list[float]]] = {}
                for row in here:
                    if (row["algorithm"], row["setting"], row["rate"]) == (algorithm, setting, rate):
                        curve = seeds.setdefault(row["seed"], {})
                        curve.setdefault(row["value"] * (1000 if what == "age" else 1), []).append(row["discounted_return"])
                means = np.array([[np.mean(values) for values in curve.values()] for curve in seeds.values()])
                x = list(next(iter(seeds.values())))
                if len(means) > 1:
                    ax.plot(x, means.T, linewidth=0.5, alpha=0.5, **style)
                name = f"{ALGORITHMS[algorithm].label} ({setting}), trained at {rate} Hz"
                ax.plot(x, means.mean(axis=0), marker="o", markersize=3, label=name, **style)
            if what == "rate":
                ax.set_xscale("log")
                ax.set_xticks(RATES, [f"{rate:g}" for rate in RATES], fontsize="small")
                ax.minorticks_off()
            ax.set_ylim(bottom=min(0.0, *(row["discounted_return"] for row in here)))
            ax.set_xlabel(label)
            ax.set_title(find_task(task).label)
        of_task[0].set_ylabel("discounted return, greedy")
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(file, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a study's")
    parser.add_argument("--output", type=Path, default=Path("results/robustness"))
    parser.add_argument("--episodes", type=int, default=10)
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*GLFW.*")
    th.set_num_threads(1)
    args.output.mkdir(parents=True, exist_ok=True)
    file, rows = args.output / "robustness.csv", []
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for record in sorted(args.folder.glob(f"*/{RECORD}")):
            run = Run(**json.loads((record.parent / SETTINGS).read_text()))
            if run.algorithm not in PLAYED:
                continue
            for row in measure(run, record.parent, args.episodes):
                writer.writerow(row)
                rows.append(dict(zip(COLUMNS, row, strict=True)))
            print(run.name, flush=True)
    draw(rows, args.output / "robustness.png")


if __name__ == "__main__":
    main()
