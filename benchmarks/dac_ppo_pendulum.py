"""DAC-PPO and Stable-Baselines3's PPO on Pendulum-v1, with the same settings and as many updates.

python benchmarks/dac_ppo_pendulum.py --seeds 0 1 2
"""

import argparse
import time

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ctco import DACPPO

# DAC-PPO's 5 epochs for each of its two processes are as many updates as PPO's 10 epochs.
ALGORITHMS = {"DAC-PPO": (DACPPO, {"n_epochs": 5}), "PPO": (PPO, {"n_epochs": 10})}
SETTINGS = {"n_steps": 256, "batch_size": 256, "gamma": 0.9, "learning_rate": 1e-3, "device": "cpu"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--episodes", type=int, default=100, help="of the greedy policy")
    args = parser.parse_args()
    th.set_num_threads(1)
    for name, (algorithm, epochs) in ALGORITHMS.items():
        for seed in args.seeds:
            start = time.time()
            env = VecNormalize(make_vec_env("Pendulum-v1", 8, seed=seed), gamma=SETTINGS["gamma"])
            model = algorithm("MlpPolicy", env, seed=seed, **SETTINGS, **epochs).learn(args.steps)
            env.training, env.norm_reward = False, False
            env.seed(1000 + seed)
            mean, deviation = evaluate_policy(model, env, args.episodes)
            print(f"{name} seed {seed}: {mean:.1f} ± {deviation:.1f} after {time.time() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
