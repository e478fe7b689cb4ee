"""Record what SAC does as a Minari dataset, from which CTCO can learn.

pip install '.[minari]'
python examples/record_demonstrations.py --env Pendulum-v1 --dataset pendulum/sac-v0
"""

import argparse

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from stable_baselines3 import SAC


def record(model: SAC, env: gym.Env, seed: int) -> EpisodeBuffer:
    """One greedy episode; greedy, because the noise of exploration is nothing to learn from."""
    obs, _ = env.reset(seed=seed)
    steps: list[tuple] = []
    observations = [obs]
    while not steps or not (steps[-1][2] or steps[-1][3]):
        action, _ = model.predict(obs, deterministic=True)
        obs, reward, terminated, truncated, _ = env.step(action)
        observations.append(obs)
        steps.append((action, float(reward), terminated, truncated))
    actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
    return EpisodeBuffer(None, seed, None, np.array(observations), actions, rewards, terminations, truncations)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--model", help="a trained SAC, .zip; one is trained otherwise")
    parser.add_argument("--steps", type=int, default=10_000, help="of that training")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--dataset", default="pendulum/sac-v0", help="its name; it goes to ~/.minari/datasets")
    args = parser.parse_args()
    if args.dataset in minari.list_local_datasets():
        raise SystemExit(f"there is a dataset {args.dataset} already: name another --dataset, or delete it with minari delete")
    env = gym.make(args.env)
    model = SAC.load(args.model) if args.model else SAC("MlpPolicy", env, seed=0).learn(args.steps, progress_bar=False)
    episodes = [record(model, env, seed) for seed in range(args.episodes)]
    minari.create_dataset_from_buffers(args.dataset, episodes, env=env, algorithm_name="SAC")
    returns = [np.sum(episode.rewards) for episode in episodes]
    print(f"{args.dataset}: {len(episodes)} episodes, return {np.mean(returns):.1f} on average")


if __name__ == "__main__":
    main()
