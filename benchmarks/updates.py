"""Gradient updates per second, against Stable-Baselines3's SAC with the same networks, batch and optimizer.

    python benchmarks/updates.py

Both train on a full replay buffer of ball in cup, one thread, taking turns; the ratio is the median over the repeats.
"with autograd" is CTCO as it trains networks that sb3_ctco/ctco/fast_update.py does not know.
"""

import argparse
import statistics
import time
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_ctco import CTCO

ENV = "sb3_ctco/ball_in_cup-catch-50hz-v0"
SIZES: dict[str, tuple[dict[str, list[int]], int]] = {
    "actor 10-10, critics 64-64, batch 100 (the paper's)": ({"pi": [10, 10], "qf": [64, 64]}, 100),
    "actor 64-64, critics 128-128, batch 100": ({"pi": [64, 64], "qf": [128, 128]}, 100),
    "256-256, batch 256": ({"pi": [256, 256], "qf": [256, 256]}, 256),
}


class AutogradCTCO(CTCO):
    """A subclass, which is updated with autograd."""


def make(algorithm: type[OffPolicyAlgorithm], net_arch: dict[str, list[int]], batch_size: int) -> OffPolicyAlgorithm:
    """A model with a full replay buffer."""
    kwargs: dict[str, Any] = {"policy_kwargs": {"net_arch": net_arch}, "batch_size": batch_size, "buffer_size": 10_000}
    model = algorithm("MlpPolicy", ENV, device="cpu", seed=0, **kwargs)
    buffer, rng = model.replay_buffer, np.random.default_rng(0)
    assert buffer is not None
    buffer.full = True
    for stored in (buffer.observations, buffer.next_observations, buffer.rewards):
        stored[:] = rng.normal(size=stored.shape)
    buffer.actions[:] = rng.uniform(-1.0, 1.0, size=buffer.actions.shape)
    if isinstance(model, CTCO):
        buffer.durations[:], buffer.integrated_rewards[:] = 0.2, buffer.rewards  # type: ignore[attr-defined]
    model.set_logger(Logger(None, []))
    model.train(10, batch_size)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=200, help="updates a repeat")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    th.set_num_threads(1)
    print("| networks | SAC [1/s] | CTCO [1/s] | ratio | CTCO with autograd [1/s] | ratio |\n|---|---|---|---|---|---|")
    for name, (net_arch, batch_size) in SIZES.items():
        models = [make(algorithm, net_arch, batch_size) for algorithm in (SAC, CTCO, AutogradCTCO)]
        speeds: list[list[float]] = []
        for _ in range(args.repeats):
            speeds.append([])
            for model in models:
                start = time.perf_counter()
                model.train(args.updates, batch_size)
                speeds[-1].append(args.updates / (time.perf_counter() - start))
        sac, ours, autograd = (statistics.median(column) for column in zip(*speeds, strict=True))
        ratios = [statistics.median(row[i] / row[0] for row in speeds) for i in (1, 2)]
        print(f"| {name} | {sac:.0f} | {ours:.0f} | {ratios[0]:.2f} | {autograd:.0f} | {ratios[1]:.2f} |")


if __name__ == "__main__":
    main()
