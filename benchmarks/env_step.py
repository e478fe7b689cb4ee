"""What a primitive step costs through OptionExecutionWrapper: this package's dm_control environments against Shimmy's.

    python benchmarks/env_step.py

Both simulate the same physics at the same control period; each repeat times both, one after the other, on the same
options, and the median of the ratios is reported.
"""

import argparse
import statistics
import time
import warnings

import gymnasium as gym
from dm_control import suite

from sb3_ctco import OptionExecutionWrapper

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # glfw, without a display
    from shimmy.dm_control_compatibility import DmControlCompatibilityV0

TASKS = [
    ("point_mass", "easy", False),
    ("point_mass", "easy", True),
    ("cheetah", "run", False),
    ("ball_in_cup", "catch", False),
]


def make_ours(domain: str, task: str, sparse: bool, dt: float) -> gym.Env:
    return gym.make(f"sb3_ctco/{domain}-{task}-v0", dt=dt, time_limit=10.0, sparse=sparse)


def make_shimmys(domain: str, task: str, sparse: bool, dt: float) -> gym.Env:
    """Shimmy's environment, with the same physics step below the same period. Its reward stays dense."""
    env = suite.load(domain, task, task_kwargs={"time_limit": 10.0})
    steps = max(1, round(dt / env.physics.timestep()))
    env.physics.model.opt.timestep = dt / steps
    env._n_sub_steps = steps
    env._step_limit = round(10.0 / dt)
    return DmControlCompatibilityV0(env)


def microseconds_a_step(env: gym.Env, steps: int, seed: int) -> float:
    """Mean time of a primitive step over random options, resets not counted."""
    wrapped = OptionExecutionWrapper(env)
    wrapped.action_space.seed(seed)
    wrapped.reset(seed=seed)
    done, spent = 0, 0.0
    while done < steps:
        option = wrapped.action_space.sample()
        start = time.perf_counter()
        _, _, terminated, truncated, info = wrapped.step(option)
        spent += time.perf_counter() - start
        done += info["option"]["n_steps"]
        if terminated or truncated:
            wrapped.reset()
    return 1e6 * spent / done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    print(f"| task at {args.rate:.0f} Hz | Shimmy [µs] | sb3-ctco [µs] | ratio |\n|---|---|---|---|")
    for domain, task, sparse in TASKS:
        times = [
            tuple(
                microseconds_a_step(make(domain, task, sparse, 1.0 / args.rate), args.steps, seed)
                for make in (make_shimmys, make_ours)
            )
            for seed in range(args.repeats)
        ]
        theirs, ours = (statistics.median(column) for column in zip(*times, strict=True))
        ratio = statistics.median(a / b for a, b in times)
        name = f"{domain} {task}{' (sparse)' if sparse else ''}"
        print(f"| {name} | {theirs:.1f} | {ours:.1f} | {ratio:.1f} |")


if __name__ == "__main__":
    main()
