"""A training that was interrupted goes on bit by bit as the one that was not."""

import random

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_ctco import CTCO, DACPPO, FiGARSAC, OptionExecutionWrapper, OptionReplayBuffer
from sb3_ctco.checkpoint import load_checkpoint, save_checkpoint
from sb3_ctco.fixed_rate import FixedRateSAC, sac_at_rate

OFF_POLICY = {"learning_starts": 60, "batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}, "seed": 3}
LEARNERS = {
    CTCO: {**OFF_POLICY, "d_max": 0.3, "n_sub_options": 3},
    FiGARSAC: {**OFF_POLICY, "d_max": 0.3},
    DACPPO: {"n_steps": 20, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}, "seed": 3},
    SAC: {**OFF_POLICY, "replay_buffer_class": OptionReplayBuffer},
}
WRAPPERS = {
    CTCO: {"d_max": 0.3},
    FiGARSAC: {"n_rbf": 1, "d_max": 0.3, "duration_scale": "linear"},
    SAC: {"d_max": 0.3, "n_sub_options": 3},
}


def vec_env(algorithm, make_env, n_envs=1):
    def make():
        env = make_env()
        return OptionExecutionWrapper(env, **WRAPPERS[algorithm]) if algorithm in WRAPPERS else env

    return make_vec_env(make, n_envs, seed=1)


def outcome(model):
    """All that a training leaves: parameters, the replay buffer, and what is drawn next."""
    arrays = {name: value.numpy() for name, value in model.policy.state_dict().items()}
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        arrays |= {name: getattr(buffer, name) for name in ("observations", "actions", "integrated_rewards", "durations")}
    arrays |= {"steps": model.num_timesteps, "updates": model._n_updates, "torch": th.rand(1).numpy()}
    arrays |= {"numpy": np.random.rand(), "python": random.random(), "observation": model._last_obs}
    arrays["episodes"] = [(info["r"], info["l"]) for info in model.ep_info_buffer]
    return arrays


def assert_goes_on_alike(model, make_env, path, before, after):
    """``before`` steps, a checkpoint, and ``after`` more, in the process that saved it and with a model that was loaded."""
    model.learn(before)
    save_checkpoint(model, path)
    expected = outcome(model.learn(after, reset_num_timesteps=False))
    for seed in (th.manual_seed, np.random.seed, random.seed):
        seed(99)
    loaded = load_checkpoint(type(model), path, make_env(), device="cpu")
    loaded.learn(after, reset_num_timesteps=False)
    np.testing.assert_equal(outcome(loaded), expected)


@pytest.mark.parametrize("algorithm", LEARNERS)
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("before", [30, 100], ids=["random options", "learning"])
def test_each_learner_goes_on(random_walk_env, tmp_path, algorithm, n_envs, before):
    make_env = lambda: vec_env(algorithm, random_walk_env, n_envs)  # noqa: E731
    model = algorithm("MlpPolicy", make_env(), device="cpu", **LEARNERS[algorithm])
    assert_goes_on_alike(model, make_env, tmp_path / "checkpoint", before, 70)


@pytest.mark.parametrize("name", ["Pendulum-v1", "sb3_ctco/ball_in_cup-catch-v0", "sb3_ctco/point_mass-easy-v0"])
def test_in_the_middle_of_an_episode(tmp_path, name):
    make_env = lambda: gym.make(name)  # noqa: E731
    model = CTCO("MlpPolicy", make_env(), device="cpu", **LEARNERS[CTCO])
    assert_goes_on_alike(model, make_env, tmp_path / "checkpoint", 90, 150)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"target_decision_rate": 5.0},
        {"updates_per_second": 3.3},
        {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(3), np.full(3, 0.2))},
        {"ent_coef": 0.1, "learning_rate": lambda remaining: 1e-3 * remaining},
    ],
    ids=", ".join,
)
def test_what_is_carried_over(random_walk_env, tmp_path, kwargs):
    make_env = lambda: vec_env(CTCO, random_walk_env)  # noqa: E731
    model = CTCO("MlpPolicy", make_env(), device="cpu", **{**LEARNERS[CTCO], **kwargs})
    assert_goes_on_alike(model, make_env, tmp_path / "checkpoint", 100, 70)


def test_statistics_of_observations(random_walk_env, tmp_path):
    make_env = lambda: VecNormalize(vec_env(CTCO, random_walk_env), norm_reward=False)  # noqa: E731
    model = CTCO("MlpPolicy", make_env(), device="cpu", **LEARNERS[CTCO])
    assert_goes_on_alike(model, make_env, tmp_path / "checkpoint", 100, 70)


@pytest.mark.parametrize("kwargs", [{}, {"hold_seconds": 0.3}, {"pink_noise_seconds": 2.0}], ids=str)
def test_a_sac_of_a_fixed_rate(random_walk_env, tmp_path, kwargs):
    small = {"buffer_size": 500, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 3, "device": "cpu"}
    model = sac_at_rate(random_walk_env(), 0.1, learning_starts_seconds=2.0, updates_per_second=5.0, **kwargs, **small)
    path, env = tmp_path / "checkpoint", model.get_env()
    model.learn(100)
    save_checkpoint(model, path)
    parameters = lambda: [p.detach().clone() for p in model.policy.parameters()]  # noqa: E731
    model.learn(70, reset_num_timesteps=False)
    expected, steps, updates = parameters(), model.num_timesteps, model._n_updates
    model = load_checkpoint(FixedRateSAC, path, env, device="cpu").learn(70, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (steps, updates)
    th.testing.assert_close(parameters(), expected, rtol=0.0, atol=0.0)
    with pytest.raises(ValueError, match=r"a checkpoint of FixedRateSAC: load it with that class"):
        load_checkpoint(SAC, path, env)


def test_what_cannot_be_saved_is_refused(random_walk_env, tmp_path):
    path = tmp_path / "checkpoint"

    def save(env):
        save_checkpoint(CTCO("MlpPolicy", env, device="cpu", **LEARNERS[CTCO]), path)

    with pytest.raises(ValueError, match="as an EzPickle it is made anew"):
        save(gym.make("HalfCheetah-v5"))
    env = make_vec_env(
        random_walk_env, 1, wrapper_class=OptionExecutionWrapper, wrapper_kwargs=WRAPPERS[CTCO], vec_env_cls=SubprocVecEnv
    )
    with pytest.raises(ValueError, match="SubprocVecEnv cannot be saved, it is in other processes"):
        save(env)
    env.close()
    open_file = random_walk_env()
    open_file.log = (tmp_path / "log").open("w")
    with pytest.raises(ValueError, match=r"state of the environments cannot be saved: Cannot pickle files"):
        save(open_file)
    assert not path.exists()
    with pytest.raises(ValueError, match="the model has no environment"):
        save_checkpoint(CTCO("MlpPolicy", None, dt=0.1, d_min=0.1, _init_setup_model=False), path)


def test_an_environment_made_otherwise_is_refused(random_walk_env, tmp_path):
    model = CTCO("MlpPolicy", vec_env(CTCO, random_walk_env), device="cpu", **LEARNERS[CTCO]).learn(10)
    save_checkpoint(model, tmp_path / "checkpoint")
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint"]
    for env in (vec_env(CTCO, random_walk_env, 2), VecNormalize(vec_env(CTCO, random_walk_env), norm_reward=False)):
        with pytest.raises(ValueError, match=r"the checkpoint's is 1 in \['DummyVecEnv'\]"):
            load_checkpoint(CTCO, tmp_path / "checkpoint", env)
    assert isinstance(load_checkpoint(CTCO, tmp_path / "checkpoint", random_walk_env()).get_env(), DummyVecEnv)


def test_hindsight_is_refused(tmp_path):
    """HerReplayBuffer computes rewards with an environment, which pickle does not keep."""
    env = BitFlippingEnv(n_bits=4, continuous=True, max_steps=5)
    model = SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match=r"HerReplayBuffer.*cannot be saved"):
        save_checkpoint(model, tmp_path / "checkpoint")
    assert not (tmp_path / "checkpoint").exists()
