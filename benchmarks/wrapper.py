"""What OptionExecutionWrapper adds to a primitive step of a Gymnasium environment, against the environment in a bare loop.

    python benchmarks/wrapper.py

Both play the same actions from the same first states; each repeat times both, one after the other, and the median of the
ratios is reported.
"""

import argparse
import statistics
import time

import gymnasium as gym
import numpy as np

from sb3_ctco import OptionExecutionWrapper

ENVS = ("MountainCarContinuous-v0", "Pendulum-v1", "HalfCheetah-v5")
DT = 0.05


def microseconds_bare(env: gym.Env, plans: list[np.ndarray], seed: int) -> float:
    """Mean time of a step in a loop."""
    env.reset(seed=seed)
    start = time.perf_counter()
    for plan in plans:
        for action in plan:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                raise RuntimeError("the episode must not end within a repeat")
    return 1e6 * (time.perf_counter() - start) / sum(map(len, plans))


def microseconds_wrapped(env: OptionExecutionWrapper, options: np.ndarray, seed: int) -> float:
    """Mean time of a step within options."""
    env.reset(seed=seed)
    start = time.perf_counter()
    steps = 0
    for option in options:
        steps += env.step(option)[4]["option"]["n_steps"]
    return 1e6 * (time.perf_counter() - start) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=51)
    args = parser.parse_args()
    print("| environment | steps an option | bare loop [µs] | wrapped [µs] | ratio |\n|---|---|---|---|---|")
    rng = np.random.default_rng(0)
    for name in ENVS:
        for n_steps in (10, 50):
            duration = n_steps * DT
            bare, wrapped = gym.make(name), OptionExecutionWrapper(gym.make(name), d_min=duration, d_max=duration, dt=DT)
            times = []
            for seed in range(args.repeats):
                options = rng.uniform(-1, 1, (150 // n_steps, *wrapped.action_space.shape))
                plans = [wrapped.plan(option) for option in options]
                times.append((microseconds_bare(bare, plans, seed), microseconds_wrapped(wrapped, options, seed)))
            alone, with_wrapper = (statistics.median(column) for column in zip(*times, strict=True))
            ratio = statistics.median(b / a for a, b in times)
            print(f"| {name} | {n_steps} | {alone:.1f} | {with_wrapper:.1f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
