"""It learns. Hyperparameters are fixed here; the seeds are those that were tried first."""

import gymnasium as gym
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_ctco import CTCO


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pendulum_within_20000_steps(seed):
    """The greedy policy's return on a bare Pendulum-v1; a policy that does nothing gets about −1200."""
    model = CTCO(
        "MlpPolicy",
        gym.make("Pendulum-v1"),
        learning_rate=1e-3,
        learning_starts=1000,
        batch_size=64,
        tau=0.01,
        updates_per_second=8,
        n_rbf=3,
        d_max=0.4,
        high_freq_penalty=0.01,
        policy_kwargs={"net_arch": [64, 64]},
        seed=seed,
    )
    model.learn(20_000)
    mean, _ = evaluate_policy(model, model.wrap_env(gym.make("Pendulum-v1")), n_eval_episodes=20)
    assert mean > -400
