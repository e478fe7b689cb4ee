"""Task time a second of wall time in a whole training, against Stable-Baselines3's SAC.

    python benchmarks/training.py

Both play the same environment (ball in cup), make 20 updates per second of task time with the paper's networks and
batches, and use one thread; they take turns, and the ratio is the median over the repeats. CTCO decides as its untrained
policy does, two to three times a second.
"""

import argparse
import statistics
import time
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_ctco import CTCO
from sb3_ctco.fixed_rate import sac_at_rate

COMMON: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 100,
    "tau": 0.01,
    "updates_per_second": 20,
    "buffer_size": 200_000,
    "device": "cpu",
    "seed": 0,
}
NETWORKS: dict[str, Any] = {"net_arch": {"pi": [10, 10], "qf": [64, 64]}}


def make(name: str, rate: int) -> BaseAlgorithm:
    env = gym.make(f"sb3_ctco/ball_in_cup-catch-{rate}hz-v0")
    if name == "sac":
        return sac_at_rate(env, dt=1.0 / rate, learning_starts_seconds=10.0, policy_kwargs=NETWORKS, **COMMON)
    n_sub_options = 8 if name == "ctco" else 0
    return CTCO(
        "MlpPolicy",
        env,
        d_max=0.5,
        n_sub_options=n_sub_options,
        learning_starts=10 * rate,
        policy_kwargs=NETWORKS,
        **COMMON,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="task time of a repeat")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    th.set_num_threads(1)
    print("| | SAC [s/s] | CTCO [s/s] | ratio | CTCO without sub-options [s/s] | ratio |\n|---|---|---|---|---|---|")
    for rate in (50, 500):
        models = [make(name, rate) for name in ("sac", "ctco", "plain")]
        for model in models:
            model.learn(20 * rate)
        speeds: list[list[float]] = []
        for _ in range(args.repeats):
            speeds.append([])
            for model in models:
                before, start = model.num_timesteps, time.perf_counter()
                model.learn(round(args.seconds * rate), reset_num_timesteps=False)
                speeds[-1].append((model.num_timesteps - before) / rate / (time.perf_counter() - start))
        sac, ours, plain = (statistics.median(column) for column in zip(*speeds, strict=True))
        ratios = [statistics.median(row[i] / row[0] for row in speeds) for i in (1, 2)]
        print(f"| {rate} Hz | {sac:.1f} | {ours:.1f} | {ratios[0]:.1f} | {plain:.1f} | {ratios[1]:.1f} |")


if __name__ == "__main__":
    main()
