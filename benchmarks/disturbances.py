"""Trained policies that are pushed, or see nothing new for a while: options whole, replanned, or ended by the critics.

    sb3-ctco study run --preset benchmarks/joins.yml --rates 500 --settings tuned --tasks cheetah ball_in_cup
    python benchmarks/disturbances.py runs/study/joins

Every model of CTCO with this setting in a study's folder plays greedily,

- as in training,
- with pushes: once a second on average, at random moments, the velocity of the cheetah's trunk, or of the ball, changes by a
  random amount,
- with observations that are lost: once a second on average, the policy and the critics go on seeing the same one for 0.2 s,

and its options are played whole; broken off every 50 ms; or ended when its critics say so, asked every 20 ms. Neither was part
of training. Prints means over seeds (smallest to largest) of the discounted return, and decisions a second.
"""

import argparse
import json
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.evaluation import evaluate_discounted_return
from sb3_ctco.interruption import CriticInterrupt
from sb3_ctco.registry import find_task
from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import RECORD, SETTINGS
from sb3_ctco.wrappers import RealTimeOptionWrapper

#: Per task the velocities that a push changes, and the standard deviation of the change
PUSHES = {"cheetah": (slice(0, 3), np.array([3.0, 1.5, 3.0])), "ball_in_cup": (slice(2, 4), np.array([1.5, 1.5]))}
#: Disturbances a second, on average
FREQUENCY = 1.0
#: How long an observation is lost, in s
LOST = 0.2
CONDITIONS = ("as in training", "pushes", "lost observations")


class Pushed(gym.Wrapper):
    """Changes the velocities of a task of dm_control at random moments."""

    def __init__(self, env: gym.Env, velocities: slice, scale: np.ndarray):
        super().__init__(env)
        self.velocities, self.scale = velocities, scale

    def step(self, action: Any) -> Any:
        if self.np_random.random() < FREQUENCY * self.get_wrapper_attr("dt"):
            physics = self.get_wrapper_attr("physics")
            physics.data.qvel[self.velocities] += self.scale * self.np_random.standard_normal(len(self.scale))
            physics.forward()
        return self.env.step(action)


class LosesObservations(gym.Wrapper):
    """From random moments on, the observation is the same for a while."""

    def reset(self, **kwargs: Any) -> Any:
        self.left, result = 0, self.env.reset(**kwargs)
        self.seen = result[0]
        return result

    def step(self, action: Any) -> Any:
        obs, *rest = self.env.step(action)
        dt = self.get_wrapper_attr("dt")
        if self.left:
            self.left -= 1
        elif self.np_random.random() < FREQUENCY * dt:
            self.left = round(LOST / dt)
        if not self.left:
            self.seen = obs
        return self.seen, *rest


def every(period: float) -> Callable[[Any, Any, float], bool]:
    return lambda decided_on, obs, seconds: seconds > period - 1e-6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--setting", default="tuned")
    parser.add_argument("--episodes", type=int, default=10, help="of each model, condition and way to play")
    parser.add_argument("--period", type=float, default=0.05, help="of replanning, in s")
    parser.add_argument("--check-period", type=float, default=0.02, help="of the critics, in s")
    parser.add_argument("--margin", type=float, default=0.0, help="how much more it must be worth to decide anew, beside β_h")
    args = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore", message=".*Monitor is outside.*")
    cells: dict[tuple[str, str], list[list[tuple[float, float]]]] = defaultdict(list)
    for file in sorted(args.folder.glob(f"*/{RECORD}")):
        run = Run(**json.loads((file.parent / SETTINGS).read_text()))
        if run.algorithm != "ctco" or run.setting != args.setting or run.task not in PUSHES:
            continue
        model = CTCO.load(file.parent / "model.zip", device="cpu", buffer_size=1)
        for condition in CONDITIONS:
            row = []
            for interrupt in (None, every(args.period), CriticInterrupt(model, args.check_period, args.margin)):
                env: Any = find_task(run.task).make_env(run.rate)
                if condition == "pushes":
                    env = Pushed(env, *PUSHES[run.task])
                elif condition == "lost observations":
                    env = LosesObservations(env)
                env = RealTimeOptionWrapper(env, interrupt=interrupt, **model.option_space.arguments)
                env.reset(seed=1000)  # the same first states for each
                episodes = evaluate_discounted_return(model, env, args.episodes)
                env.close()
                values = [[episode.discounted_return, episode.decision_rate_hz] for episode in episodes]
                row.append(tuple(np.mean(values, axis=0)))
            cells[run.task, condition].append(row)
            print(run.task, "seed", run.seed, condition, np.round(row, 2).tolist(), flush=True)
    ways = ("options whole", f"decided anew every {1000 * args.period:.0f} ms", "ended by the critics")
    print(f"\n| task | | seeds | {' | '.join(ways)} |\n|{'---|' * 6}")
    for (task, condition), seeds in cells.items():
        numbers = np.array(seeds)
        text = [f"{v.mean():.2f} ({v.min():.2f} to {v.max():.2f}), {hz.mean():.1f}/s" for v, hz in numbers.transpose(1, 2, 0)]
        print(f"| {task} | {condition} | {len(seeds)} | {' | '.join(text)} |")


if __name__ == "__main__":
    main()
