"""Eight environments in worker processes: AsyncOptionVecEnv against SubprocVecEnv, which waits for the slowest option.

    python benchmarks/vec_env.py

Interaction of CTCO without gradient steps. A step takes a fixed time in which the processor is free, as on a robot, in a
remote simulator or with a core for each environment. Options are as long as the policy says: an untrained one's are short
and long alike; in the second
row half of the environments are five times as slow as the others. Each repeat measures both, one
after the other, and the median of the ratios is reported.
"""

import argparse
import statistics
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.vec_env import AsyncOptionVecEnv

N_ENVS = 8


class TimedEnv(gym.Env):
    """A step takes ``seconds``; 200 steps of 0.02 s an episode."""

    dt = 0.02
    render_mode = None
    observation_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, seconds: float):
        self.seconds = seconds

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(4, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        time.sleep(self.seconds)
        self.count += 1
        return np.zeros(4, dtype=np.float32), 0.0, False, self.count >= 200, {}


def steps_a_second(vec_env_cls: type[SubprocVecEnv], seconds: list[float], d_max: float, steps: int) -> tuple[float, float]:
    """Primitive steps and decisions a second of wall time."""

    def make(one: float) -> Any:
        return lambda: OptionExecutionWrapper(TimedEnv(one), d_max=d_max)

    env = vec_env_cls([make(one) for one in seconds])
    model = CTCO(
        "MlpPolicy", env, d_max=d_max, learning_starts=0, gradient_steps=0, policy_kwargs={"net_arch": [64, 64]}, seed=0
    )
    model.learn(steps // 10)
    before = model.num_timesteps, model.replay_buffer.pos  # type: ignore[union-attr]
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    spent = time.perf_counter() - start
    counts = model.num_timesteps - before[0], model.replay_buffer.pos - before[1]  # type: ignore[union-attr]
    env.close()
    return counts[0] / spent, counts[1] / spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--milliseconds", type=float, default=5.0, help="time of a step")
    parser.add_argument("--steps", type=int, default=3_000)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    th.set_num_threads(1)
    fast = args.milliseconds / 1000
    settings = {
        "options of 1 to 50 steps": ([fast] * N_ENVS, 1.0),
        "half of the environments 5 times as slow": ([fast, 5 * fast] * (N_ENVS // 2), 1.0),
    }
    print("| 8 environments | SubprocVecEnv [steps/s] | AsyncOptionVecEnv [steps/s] | ratio | ratio of decisions |")
    print("|---|---|---|---|---|")
    for name, (seconds, d_max) in settings.items():
        rates = np.array(
            [
                [steps_a_second(cls, seconds, d_max, args.steps) for cls in (SubprocVecEnv, AsyncOptionVecEnv)]
                for _ in range(args.repeats)
            ]
        )
        sync, asynchronous = np.median(rates[:, :, 0], axis=0)
        ratios = [statistics.median(rates[:, 1, i] / rates[:, 0, i]) for i in range(2)]
        print(f"| {name} | {sync:.0f} | {asynchronous:.0f} | {ratios[0]:.1f} | {ratios[1]:.1f} |", flush=True)


if __name__ == "__main__":
    main()
