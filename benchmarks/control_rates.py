"""Run a policy at other control rates than the one it was trained at, with OptionController in the bare environment.

    sb3-ctco train --env sb3_ctco/ball_in_cup-catch-50hz-v0 --seed 0
    python benchmarks/control_rates.py logs/ctco/sb3_ctco-ball_in_cup-catch-50hz-v0_1/sb3_ctco-ball_in_cup-catch-50hz-v0.zip

Prints a row a rate: the discounted return (τ = 0.404/s) with its standard error, the share of the time that is rewarded,
and the decision rate, over greedy episodes of 10 s from the same first states.
"""

import argparse
import warnings
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import OptionController
from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, integrated_reward

RATES = (25, 50, 100, 250, 500)
SECONDS = 10.0


@dataclass
class Episode:
    discounted_return: float
    mean_reward: float
    decision_rate_hz: float


def play(controller: OptionController, env: gym.Env, seed: int) -> Episode:
    obs, _ = env.reset(seed=seed)
    controller.reset()
    rewards, decisions, done = [], 0, False
    while not done:
        action = controller(obs)
        decisions += controller.elapsed == 0
        obs, reward, terminated, truncated, _ = env.step(action)
        rewards.append(float(reward))
        done = terminated or truncated
    value = integrated_reward(np.array(rewards), controller.dt, DEFAULT_DISCOUNT_RATE)
    return Episode(value, float(np.mean(rewards)), decisions / (len(rewards) * controller.dt))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a CTCO model, saved as .zip, or an exported .onnx")
    parser.add_argument("--env", default="sb3_ctco/ball_in_cup-catch-v0", help="an environment that takes dt and time_limit")
    parser.add_argument("--episodes", type=int, default=20)
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*GLFW.*")
    th.set_num_threads(1)

    policy = OptionController(args.model).policy
    print(f"trained at {1 / policy.option_space.dt:g} Hz")
    print("| control rate, Hz | discounted return | rewarded | decisions a second |\n|---|---|---|---|")
    for rate in RATES:
        env = gym.make(args.env, dt=1 / rate, time_limit=SECONDS)
        controller = OptionController(policy, dt=1 / rate)
        episodes = [play(controller, env, seed) for seed in range(args.episodes)]
        values = np.array([episode.discounted_return for episode in episodes])
        error = values.std(ddof=1) / np.sqrt(len(values))
        rewarded = np.mean([episode.mean_reward for episode in episodes])
        decisions = np.mean([episode.decision_rate_hz for episode in episodes])
        print(f"| {rate} | {values.mean():.2f} ± {error:.2f} | {rewarded:.0%} | {decisions:.1f} |", flush=True)
        env.close()


if __name__ == "__main__":
    main()
