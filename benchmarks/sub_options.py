"""What sub-options cost the interaction: steps a second with and without, decisions and the replay buffer included.

    python benchmarks/sub_options.py

Each repeat times both, one after the other, without gradient steps; the median of the ratios is reported.
"""

import argparse
import statistics
import time

import gymnasium as gym
import torch as th

from sb3_ctco import CTCO

TASKS = {"point_mass-sparse": 0.5, "cheetah-run": 0.5, "ball_in_cup-catch": 0.5}


def seconds_of_interaction(env_id: str, d_max: float, n_sub_options: int, seconds: float) -> float:
    """Wall time of an untrained policy's interaction."""
    env = gym.make(env_id)
    model = CTCO(
        "MlpPolicy",
        env,
        d_max=d_max,
        n_sub_options=n_sub_options,
        learning_starts=0,
        gradient_steps=0,
        buffer_size=50_000,
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
    )
    steps = round(seconds / env.unwrapped.dt)  # type: ignore[attr-defined]
    model.learn(steps // 10)
    start = time.perf_counter()
    model.learn(steps)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=8, help="sub-options of an option")
    parser.add_argument("--seconds", type=float, default=60.0, help="task time of a repeat")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)
    print(f"| task | without [s] | with {args.n} [s] | ratio |\n|---|---|---|---|")
    for task, d_max in TASKS.items():
        for rate in (50, 500):
            env_id = f"sb3_ctco/{task}-{rate}hz-v0"
            times = [
                tuple(seconds_of_interaction(env_id, d_max, n, args.seconds) for n in (0, args.n)) for _ in range(args.repeats)
            ]
            without, with_them = (statistics.median(column) for column in zip(*times, strict=True))
            ratio = statistics.median(b / a for a, b in times)
            print(f"| {task} at {rate} Hz | {without:.2f} | {with_them:.2f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
