"""How well acting keeps the clock while a learner runs beside it.

    python benchmarks/realtime.py --rate 500 --minutes 5

A simulated machine that does nothing, controlled at 500 Hz by CTCO (or ``--algorithm sac``), with the learner at full
speed in its own process. Prints what was measured, as one JSON object: the share of ticks that were late by more than
1 ms, updates per second, the age of the weights that decisions were made with, and how long a decision took.
"""

import argparse
import json
import os
import tempfile
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC

from sb3_ctco import CTCO
from sb3_ctco.realtime import AsynchronousTrainer


class IdleMachine(gym.Env):
    """Takes commands at any rate and reports a walk that they steer."""

    def __init__(self, rate: float):
        self.dt = 1.0 / rate
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)
        self.state = np.zeros(8, np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.state[:] = 0.0
        self.steps = 0
        return self.state.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.state[:3] += self.dt * action
        self.steps += 1
        return self.state.copy(), -float(np.abs(self.state).sum()), False, self.steps * self.dt >= 10.0, {}


def percentiles(values: list[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "p99.9": float(np.percentile(values, 99.9)), "max": float(np.max(values))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=("ctco", "sac"), default="ctco")
    parser.add_argument("--rate", type=float, default=500.0, help="of control, Hz")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--decide-ahead", type=float, default=0.0, help="s, for CTCO")
    parser.add_argument("--acting-priority", type=int, default=None, help="of Linux's real-time scheduler, 1 to 99")
    args = parser.parse_args()
    th.set_num_threads(1)
    env = IdleMachine(args.rate)
    settings: dict[str, Any] = {
        "learning_starts": round(10 * args.rate),
        "batch_size": 100,
        "device": "cpu",
        "policy_kwargs": {"net_arch": {"pi": [10, 10], "qf": [64, 64]}},
    }
    algorithm = CTCO if args.algorithm == "ctco" else SAC
    model = algorithm("MlpPolicy", env, **settings)
    with tempfile.TemporaryDirectory() as folder:
        with AsynchronousTrainer(
            model, env, folder, decide_ahead=args.decide_ahead, acting_priority=args.acting_priority
        ) as trainer:
            start = time.monotonic()
            trainer.learn(round(args.minutes * 60.0 * args.rate))
            seconds = time.monotonic() - start
        assert trainer.real_time is not None
        ticks = trainer.real_time.total_statistics
    result = {
        "algorithm": args.algorithm,
        "rate_hz": args.rate,
        "decide_ahead_s": args.decide_ahead,
        "acting_priority": args.acting_priority,
        "wall_seconds": seconds,
        "ticks": ticks.ticks,
        "late_ticks": ticks.late_ticks,
        "late_share": ticks.late_ticks / ticks.ticks,
        "worst_lateness_ms": 1e3 * ticks.worst_lateness,
        "updates_per_second": model._n_updates / seconds,
        "weights_age_s": percentiles(list(trainer.weight_ages)),
        "decision_ms": percentiles([1e3 * value for value in trainer.decision_seconds]),
        "processors": os.cpu_count(),
        "load_average": os.getloadavg()[0],
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
