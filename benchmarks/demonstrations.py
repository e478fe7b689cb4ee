"""What ten demonstrations are worth: CTCO with a quarter of each batch from them, and without.

    python benchmarks/demonstrations.py --task point_mass --seeds 3
    python benchmarks/demonstrations.py --task visual_reacher --seeds 3

Demonstrations are by a controller that is told where to go. A file a run goes to FOLDER, a row an episode; runs that are there
are not repeated. The table has the mean discounted return of training episodes in parts of the training.
"""

import argparse
import csv
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.datasets import RecordedTrajectory
from sb3_ctco.envs.visual_reacher.oracle import servo_action
from sb3_ctco.evaluation import DiscountedReturnCallback
from sb3_ctco.torch_layers import SpatialSoftmaxExtractor

DT = 0.02


def to_the_middle(env: gym.Env, obs: np.ndarray) -> np.ndarray:
    """Accelerations that bring the point mass to rest in the middle."""
    return np.clip(-30.0 * obs[:2] - 15.0 * obs[2:], -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Task:
    make: Callable[[], gym.Env]
    demonstrate: Callable[[gym.Env, Any], np.ndarray]
    seconds: float
    policy: str = "MlpPolicy"
    arguments: dict[str, Any] = field(default_factory=dict)


COMMON = {"learning_rate": 1e-3, "tau": 0.01, "learning_starts": round(60.0 / DT), "device": "cpu"}
TASKS = {
    "point_mass": Task(
        lambda: gym.make("sb3_ctco/point_mass-sparse-50hz-v0"),
        to_the_middle,
        1200.0,
        arguments={
            "d_max": 0.5,
            "high_freq_penalty": 0.003,
            "entropy_reference": "uniform",
            "batch_size": 100,
            "buffer_size": 200_000,
            "updates_per_second": 20,
            "policy_kwargs": {"net_arch": {"pi": [64, 64], "qf": [128, 128]}},
        },
    ),
    # As examples/visual_reacher.py learns it
    "visual_reacher": Task(
        lambda: gym.make("sb3_ctco/visual_reacher-easy-v0", dt=DT),
        lambda env, obs: servo_action(env.unwrapped),  # type: ignore[arg-type]
        1800.0,
        "MultiInputPolicy",
        {
            "n_rbf": 2,
            "d_max": 1.0,
            "n_sub_options": 4,
            "high_freq_penalty": 0.02,
            "entropy_reference": "uniform",
            "batch_size": 32,
            "buffer_size": 120_000,
            "updates_per_second": 4,
            "policy_kwargs": {
                "net_arch": {"pi": [10, 10], "qf": [64, 64]},
                "features_extractor_class": SpatialSoftmaxExtractor,
                "features_extractor_kwargs": {"max_shift": 4},
            },
        },
    ),
}


def record(task: Task, env: gym.Env, seed: int) -> RecordedTrajectory:
    """One episode of the demonstrator."""
    obs, _ = env.reset(seed=seed)
    observations, actions, rewards = [obs], [], []
    ended = (False, False)
    while not any(ended):
        actions.append(task.demonstrate(env, obs))
        obs, reward, *ended, _ = env.step(actions[-1])  # type: ignore[assignment]
        observations.append(obs)
        rewards.append(reward)
    if isinstance(obs, dict):
        stacked: Any = {key: np.array([one[key] for one in observations]) for key in obs}
    else:
        stacked = np.array(observations)
    return RecordedTrajectory(stacked, np.array(actions), np.array(rewards, dtype=np.float64), *ended, DT)


def run(task: Task, n_demonstrations: int, fraction: float, seed: int, seconds: float, path: Path) -> None:
    env = task.make()
    buffer = {"demonstration_fraction": fraction}
    model = CTCO(task.policy, env, seed=seed, replay_buffer_kwargs=buffer, **COMMON, **task.arguments)
    for k in range(n_demonstrations):
        trajectory = record(task, task.make(), 1000 * seed + k)
        result = model.replay_buffer.add_trajectory(*trajectory)  # type: ignore[union-attr]
        print(f"demonstration {k}: return {trajectory.rewards.sum() * DT:.2f} reward × s, {result}")
    episodes = DiscountedReturnCallback(dt=DT)
    model.learn(round(seconds / DT), episodes)
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["seconds", "discounted_return", "decision_rate_hz"])
        for n, episode in zip(episodes.timesteps, episodes.episodes, strict=True):
            writer.writerow([round(v, 4) for v in (n * DT, episode.discounted_return, episode.decision_rate_hz)])
    os.replace(unfinished, path)  # in one move: its presence says that the run is complete


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default="point_mass")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, help="task time of a training")
    parser.add_argument("--demonstrations", type=int, default=10)
    parser.add_argument("--fraction", type=float, default=0.25, help="part of each batch that is drawn from them")
    parser.add_argument("--parts", type=int, default=6, help="of the training, in the table")
    parser.add_argument("--folder", type=Path, default=Path("runs/demonstrations"))
    args = parser.parse_args()
    th.set_num_threads(1)
    args.folder.mkdir(parents=True, exist_ok=True)
    task = TASKS[args.task]
    seconds = args.seconds or task.seconds
    edges = np.linspace(0.0, seconds, args.parts + 1)
    print(f"| demonstrations | {' | '.join(f'to {edge:.0f} s' for edge in edges[1:])} |\n|---|{'---|' * args.parts}")
    for n in (0, args.demonstrations):
        curves = []
        for seed in range(args.seeds):
            share = f"_{args.fraction:g}" if n else ""
            path = args.folder / f"{args.task}_{n}{share}_{seconds:.0f}s_seed{seed}.csv"
            if not path.exists():
                run(task, n, args.fraction, seed, seconds, path)
            with path.open(newline="") as file:
                rows = np.array([[float(row["seconds"]), float(row["discounted_return"])] for row in csv.DictReader(file)])
            parts = np.searchsorted(edges, rows[:, 0]) - 1
            curves.append([rows[parts == part, 1].mean() if (parts == part).any() else np.nan for part in range(args.parts)])
        table = np.array(curves)
        cells = [f"{column.mean():.2f} ({column.min():.2f} to {column.max():.2f})" for column in table.T]
        print(f"| {n} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
