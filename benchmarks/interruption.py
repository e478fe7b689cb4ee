"""A target that moves faster than it did in training: options that are played to their end, and options that are broken off.

    python benchmarks/interruption.py

A point is to stay near a target. CTCO learns with a target that stands still; then the target moves, and the greedy policy
plays its options whole; has them broken off as soon as the target is 0.1 from where it was at the decision; or has its
critics end them, asked every 0.1 s, when to decide anew is worth more than the rest of the plan. The paper's section on
limitations says that the first fails if the target is too fast.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_ctco import CTCO
from sb3_ctco.evaluation import evaluate_discounted_return
from sb3_ctco.interruption import CriticInterrupt
from sb3_ctco.wrappers import RealTimeOptionWrapper

SPEEDS = (0.0, 0.1, 0.2, 0.4, 0.8)
#: How far the target must have moved to end an option
DISTANCE = 0.1
#: How often the critics are asked, in s
CHECK_PERIOD = 0.1


class MovingTarget(gym.Env):
    """A point in the square [−1, 1]² with a commanded velocity of up to 1/s an axis, and a target to stay within 0.15 of.

    :param speed: of the target, which moves in straight lines that are reflected at the border, in 1/s
    """

    dt = 0.02
    n_steps = 400
    observation_space = spaces.Box(-1.0, 1.0, (4,))
    action_space = spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, speed: float = 0.0):
        self.speed = speed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.target = self.np_random.uniform(-1.0, 1.0, (2, 2))
        heading = self.np_random.uniform(-np.pi, np.pi)
        self.velocity = self.speed * np.array([np.cos(heading), np.sin(heading)])
        self.steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.position = np.clip(self.position + self.dt * action, -1.0, 1.0)
        self.target = self.target + self.dt * self.velocity
        self.velocity = np.where(np.abs(self.target) > 1.0, -np.abs(self.velocity) * np.sign(self.target), self.velocity)
        self.target = np.clip(self.target, -1.0, 1.0)
        self.steps += 1
        near = float(np.linalg.norm(self.position - self.target) < 0.15)
        return self._observe(), near, False, self.steps >= self.n_steps, {}

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.position, self.target]).astype(np.float32)


def target_moved(decided_on: np.ndarray, obs: np.ndarray, _: float) -> bool:
    return float(np.linalg.norm(obs[2:] - decided_on[2:])) > DISTANCE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1200.0, help="task time of a training")
    parser.add_argument("--episodes", type=int, default=50, help="of an evaluation")
    parser.add_argument("--margin", type=float, default=0.0, help="how much more it must be worth to decide anew, beside β_h")
    args = parser.parse_args()
    th.set_num_threads(1)
    options: dict[str, Any] = {"n_rbf": 2, "d_max": 2.0}
    results = np.zeros((args.seeds, len(SPEEDS), 3, 2))
    for seed in range(args.seeds):
        model = CTCO(
            "MlpPolicy",
            MovingTarget(),
            learning_rate=1e-3,
            batch_size=100,
            tau=0.01,
            learning_starts=round(60.0 / MovingTarget.dt),
            updates_per_second=20,
            high_freq_penalty=0.02,
            entropy_reference="uniform",
            policy_kwargs={"net_arch": {"pi": [64, 64], "qf": [128, 128]}},
            seed=seed,
            device="cpu",
            **options,
        ).learn(round(args.seconds / MovingTarget.dt))
        for i, speed in enumerate(SPEEDS):
            for j, interrupt in enumerate((None, target_moved, CriticInterrupt(model, CHECK_PERIOD, args.margin))):
                env = RealTimeOptionWrapper(MovingTarget(speed), interrupt=interrupt, **options)
                env.reset(seed=1000)  # the same first states for each
                episodes = evaluate_discounted_return(model, env, args.episodes)
                results[seed, i, j, 0] = np.mean([episode.discounted_return for episode in episodes])
                results[seed, i, j, 1] = np.mean([episode.decision_rate_hz for episode in episodes])
    ways = ("options whole", "broken off by a rule", "ended by the critics")
    print(f"| speed of the target [1/s] | {' | '.join(f'{way} | decisions/s' for way in ways)} |\n|{'---|' * 7}")
    for speed, seeds in zip(SPEEDS, results.transpose(1, 2, 0, 3), strict=True):
        cells = [f"{v[:, 0].mean():.2f} ({v[:, 0].min():.2f} to {v[:, 0].max():.2f}) | {v[:, 1].mean():.1f}" for v in seeds]
        print(f"| {speed} | {' | '.join(cells)} |")
    print(f"\n{args.seeds} seeds, {args.seconds:.0f} s of task time each, {args.episodes} greedy episodes a cell")


if __name__ == "__main__":
    main()
