"""Deciding ahead on ball in cup: what the age of the observation costs in return.

    python benchmarks/decide_ahead.py

CTCO learns at 50 Hz with the next option decided on at the end of the one that plays, or some time before; each policy is
then played greedily with each of these times. Without sub-options.
"""

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.evaluation import DiscountedReturnCallback, evaluate_discounted_return
from sb3_ctco.wrappers import RealTimeOptionWrapper

ENV = "sb3_ctco/ball_in_cup-catch-50hz-v0"
DT = 0.02
#: In s
AHEAD = (0.0, 0.02, 0.06, 0.1)
OPTIONS: dict[str, Any] = {"n_rbf": 3, "d_max": 0.5}


def measure(ahead: float, seed: int, seconds: float, episodes: int) -> list[float]:
    """Train, then play with each time.

    :return: the return in training's last tenth, then the greedy ones
    """
    th.set_num_threads(1)
    callback = DiscountedReturnCallback()
    model = CTCO(
        "MlpPolicy",
        RealTimeOptionWrapper(gym.make(ENV), ahead, **OPTIONS),
        learning_rate=1e-3,
        batch_size=100,
        tau=0.01,
        learning_starts=round(60.0 / DT),
        updates_per_second=20,
        n_sub_options=0,
        policy_kwargs={"net_arch": {"pi": [64, 64], "qf": [128, 128]}},
        seed=seed,
        device="cpu",
        **OPTIONS,
    ).learn(round(seconds / DT), callback)
    tail = callback.episodes[-math.ceil(len(callback.episodes) / 10) :]
    returns = [float(np.mean([episode.discounted_return for episode in tail]))]
    for other in AHEAD:
        env = RealTimeOptionWrapper(gym.make(ENV), other, **OPTIONS)
        env.reset(seed=1000)  # the same first states for each
        greedy = evaluate_discounted_return(model, env, episodes)
        returns.append(float(np.mean([episode.discounted_return for episode in greedy])))
    return returns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=2400.0, help="task time of a training")
    parser.add_argument("--episodes", type=int, default=30, help="of an evaluation")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    jobs = [(ahead, seed, args.seconds, args.episodes) for ahead in AHEAD for seed in range(args.seeds)]
    with ProcessPoolExecutor(args.workers) as executor:
        rows = np.array(list(executor.map(measure, *zip(*jobs, strict=True)))).reshape(len(AHEAD), args.seeds, -1)
    played = " | ".join(f"greedy at {1000 * ahead:.0f} ms" for ahead in AHEAD)
    print(f"| learned with | training | {played} |\n|{'---|' * (len(AHEAD) + 2)}")
    for ahead, seeds in zip(AHEAD, rows, strict=True):
        cells = " | ".join(" / ".join(f"{value:.2f}" for value in column) for column in seeds.T)
        print(f"| {1000 * ahead:.0f} ms ahead | {cells} |")
    print(f"\n{args.seeds} seeds, {args.seconds:.0f} s of task time each, {args.episodes} greedy episodes; discounted returns")


if __name__ == "__main__":
    main()
