"""Train CTCO on a MuJoCo task at a high interaction frequency, and look at what it does.

By default: the sparse point mass at 500 Hz. A mass must be pushed to a small target; the reward is 1 a second on the
target and nothing anywhere else. README.md says how long it takes.

    python examples/quickstart.py
    python examples/quickstart.py --task ball_in_cup --dt 0.02 --seconds 2400 --seed 1 --output runs/cup
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np
import torch as th

from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.evaluation import DiscountedReturnCallback, EpisodeStatistics, evaluate_discounted_return
from sb3_ctco.options import step_weight

mpl.use("Agg")
import matplotlib.pyplot as plt

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "point_mass": ("sb3_ctco/point_mass-easy-v0", {"sparse": True}),
    "cheetah": ("sb3_ctco/cheetah-run-v0", {}),
    "ball_in_cup": ("sb3_ctco/ball_in_cup-catch-v0", {}),
}
EPISODE_SECONDS = 10.0


class RandomPolicy:
    """Uniformly random options."""

    def __init__(self, env: gym.Env, seed: int):
        self.space = env.action_space
        self.space.seed(seed)

    def predict(self, obs: np.ndarray, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        return np.stack([self.space.sample() for _ in obs]), None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default="point_mass")
    parser.add_argument("--dt", type=float, default=0.002, help="interaction period, s (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1500.0, help="task time to train for, s (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/quickstart"), help="folder (default: %(default)s)")
    args = parser.parse_args()
    if args.seconds < EPISODE_SECONDS:
        parser.error(f"--seconds must be at least those of an episode, {EPISODE_SECONDS:g}, not {args.seconds:g}")
    args.output.mkdir(parents=True, exist_ok=True)
    # The networks are small: a second thread would cost more than it brings.
    th.set_num_threads(1)

    env_id, kwargs = TASKS[args.task]

    def make_env() -> gym.Env:
        return gym.make(env_id, dt=args.dt, time_limit=EPISODE_SECONDS, **kwargs)

    model = CTCO(
        "MlpPolicy",
        make_env(),
        learning_rate=1e-3,
        learning_starts=round(60 / args.dt),
        batch_size=100,
        tau=0.01,
        updates_per_second=20,
        d_max=0.5,
        # What a decision costs, ten times the default: where little is to be decided, few decisions do.
        high_freq_penalty="relative_1.0",
        buffer_size=200_000,
        policy_kwargs={"net_arch": {"pi": [64, 64], "qf": [128, 128]}},
        seed=args.seed,
    )
    steps = round(args.seconds / args.dt)
    print(
        f"CTCO learns {env_id} at {1 / args.dt:.0f} Hz for {args.seconds:.0f} s of task time: {steps:,} steps of "
        f"{args.dt} s,\n"
        f"played as options of up to {model.d_max} s, with {model.updates_per_second} updates per second of task time."
    )
    curve = DiscountedReturnCallback(model.discount_rate)
    model.learn(steps, curve, progress_bar=True)
    model.save(args.output / "model")

    test_env = model.wrap_env(make_env())
    test_env.reset(seed=args.seed + 1000)
    random = evaluate_discounted_return(RandomPolicy(test_env, args.seed), test_env, 20)
    greedy = evaluate_discounted_return(model, test_env, 20)
    maximum = step_weight(EPISODE_SECONDS, model.discount_rate)
    print(f"\nMean discounted return over 20 episodes of {EPISODE_SECONDS:.0f} s (τ = {model.discount_rate:.3f} 1/s):")
    print(f"  random options       {mean_return(random):6.3f}")
    print(f"  greedy policy        {mean_return(greedy):6.3f}")
    print(f"  a reward of 1 always {maximum:6.3f}   (what nobody reaches: getting there takes time)")
    rate = float(np.mean([episode.decision_rate_hz for episode in greedy]))
    print(
        f"The greedy policy decides {rate:.1f} times a second, in an environment that steps {1 / args.dt:.0f} times a second."
    )

    draw_learning_curve(curve, args.dt, mean_return(random), args.output / "learning_curve.png")
    draw_episode(model, test_env, args.seed + 2000, args.output / "episode.png")
    print(f"Saved model.zip, learning_curve.png and episode.png in {args.output}")


def mean_return(episodes: list[EpisodeStatistics]) -> float:
    return float(np.mean([episode.discounted_return for episode in episodes]))


def draw_learning_curve(curve: DiscountedReturnCallback, dt: float, random: float, path: Path) -> None:
    seconds = np.array(curve.timesteps) * dt
    returns = np.array([episode.discounted_return for episode in curve.episodes])
    window = min(12, len(returns))
    smooth = np.convolve(returns, np.ones(window) / window, mode="valid")
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(seconds, returns, ".", color="0.75", label="training episode")
    axes.plot(seconds[window - 1 :], smooth, color="C0", label=f"mean of {window} episodes")
    axes.axhline(random, color="C3", linestyle="--", label="random options")
    axes.set(xlabel="task time [s]", ylabel="discounted return", title="Learning curve")
    axes.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def draw_episode(model: CTCO, env: OptionExecutionWrapper, seed: int, path: Path) -> None:
    """Play one greedy episode primitive step by primitive step, and draw its actions, decisions and rewards."""
    bare, dt = env.env, env.option_space.dt
    obs, _ = bare.reset(seed=seed)
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    decisions: list[float] = []
    over = False
    while not over:
        option, _ = model.predict(obs, deterministic=True)
        decisions.append(len(actions) * dt)
        for action in env.plan(option):
            obs, reward, terminated, truncated, _ = bare.step(action)
            actions.append(action)
            rewards.append(float(reward))
            over = terminated or truncated
            if over:
                break

    time = np.arange(len(actions)) * dt
    shown = min(4.0, time[-1] + dt)
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(9, 5), sharex=True, layout="constrained", gridspec_kw={"height_ratios": [3, 1]}
    )
    for i, values in enumerate(np.array(actions).reshape(len(actions), -1).T):
        top.plot(time, values, label=f"action {i + 1}")
    for axes in (top, bottom):
        axes.vlines(decisions, 0, 1, transform=axes.get_xaxis_transform(), color="0.5", linestyle=":", label="decision")
    n_shown = sum(decision < shown for decision in decisions)
    top.set(
        ylabel="action",
        title=f"The first {shown:.0f} s of a greedy episode: {n_shown} decisions, {round(shown / dt):,} steps",
        xlim=(0, shown),
    )
    top.legend(loc="upper right", ncols=3)
    bottom.fill_between(time, rewards, step="post", color="C2", alpha=0.5)
    bottom.set(ylabel="reward", xlabel="time [s]")
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
