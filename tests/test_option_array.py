"""An option handed to a bare environment is refused with a sentence; everywhere else it is an array."""

import copy
import io
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecMonitor, VecNormalize

from sb3_ctco import CTCO, DACPPO, FiGARSAC, OptionExecutionWrapper
from sb3_ctco.option_array import Option, OptionArray

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 1000, "seed": 0}
ALGORITHMS = [CTCO, FiGARSAC]
REFUSAL = r"(?s)option.*not an action.*wrap_env.*OptionController"


class Force(gym.Env):
    """Reads its action in one of the ways that environments do."""

    dt = 0.1
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, read):
        self.read = read

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.zeros(2, np.float32), float(self.read(action)), False, self.count == 5, {}


READS = {
    "clip": lambda u: np.clip(u, -1, 1)[0],
    "method": lambda u: u.clip(-1, 1)[0],
    "index": lambda u: min(max(u[0], -1), 1),
    "times": lambda u: (0.1 * u).sum(),
    "times a number": lambda u: (u * 0.1)[0],
    "matrix": lambda u: (np.ones((1, 4)) @ u)[0],
    "mean": np.mean,
    "iterate": lambda u: next(iter(u)),
    "float": float,
    "slice": lambda u: u[:1] + 0.0,
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("env_id", ["Pendulum-v1", "HalfCheetah-v5", "MountainCarContinuous-v0"])
def test_evaluate_policy_in_a_bare_environment_is_refused(algorithm, env_id):
    model = algorithm("MlpPolicy", env_id, dt=0.05, **SMALL)
    with pytest.raises((TypeError, AttributeError), match=REFUSAL):
        evaluate_policy(model, Monitor(gym.make(env_id)), n_eval_episodes=1)
    evaluate_policy(model, model.wrap_env(gym.make(env_id, max_episode_steps=20)), n_eval_episodes=1)


@pytest.mark.parametrize("read", READS)
def test_however_an_environment_reads_its_action(read):
    model = CTCO("MlpPolicy", Force(READS[read]), **SMALL)
    with pytest.raises((TypeError, AttributeError), match=REFUSAL):
        evaluate_policy(model, Force(READS[read]), n_eval_episodes=1, warn=False)
    env = Force(READS[read])
    obs, _ = env.reset()
    option, _ = model.predict(obs)
    with pytest.raises((TypeError, AttributeError), match=REFUSAL):
        env.step(option)


def test_in_worker_processes():
    model = CTCO("MlpPolicy", "Pendulum-v1", **SMALL)
    wrapped = make_vec_env(
        "Pendulum-v1",
        2,
        wrapper_class=OptionExecutionWrapper,
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
    )
    try:
        rewards, lengths = evaluate_policy(model, wrapped, n_eval_episodes=2, return_episode_rewards=True)
    finally:
        wrapped.close()
    assert lengths == [200, 200] and max(rewards) < 0


def test_one_option_is_an_array_to_look_at(random_walk_env):
    model = CTCO("MlpPolicy", random_walk_env(), **SMALL)
    env = model.wrap_env(random_walk_env())
    obs, _ = env.reset(seed=0)
    option, state = model.predict(obs, deterministic=True)
    assert type(option) is OptionArray and state is None
    assert option.shape == env.action_space.shape and env.action_space.contains(option)
    again, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(option, again)
    np.testing.assert_allclose(option, again)
    assert np.array_equal(option, again) and (option == again).all() and type(option == again) is np.ndarray
    assert np.stack([option, again]).shape == (2, 3) and type(np.stack([option, again])) is np.ndarray
    assert type(option.vector) is type(np.asarray(option)) is np.ndarray
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(option)), option)
    np.testing.assert_array_equal(copy.deepcopy(option), option)
    file = io.BytesIO()
    np.save(file, option)
    file.seek(0)
    np.testing.assert_array_equal(np.load(file), option.vector)
    assert str(option) == str(option.vector) and repr(option).startswith("OptionArray([")
    assert th.as_tensor(option).shape == (3,)
    np.testing.assert_array_equal(env.plan(option), env.plan(option.vector))
    from_vector = model.wrap_env(random_walk_env())
    from_vector.reset(seed=0)
    np.testing.assert_array_equal(env.step(option)[0], from_vector.step(option.vector)[0])


def test_several_options_are_an_array_of_options(random_walk_env):
    model = CTCO("MlpPolicy", random_walk_env(), **SMALL)
    options, _ = model.predict(np.zeros((3, 2), np.float32), deterministic=True)
    assert options.shape == (3, 3) and type(options * 2) is np.ndarray and type(np.clip(options, -1, 1)) is np.ndarray
    assert type(options[:, -1]) is type(options[:2]) is np.ndarray
    assert [type(row) for row in options] == [Option] * 3
    np.testing.assert_array_equal(options[1].vector, options.vector[1])
    row = pickle.loads(pickle.dumps(options[1]))
    assert repr(row) == repr(options[1]) and str(options) == str(options.vector)
    with pytest.raises(IndexError):
        options[3]
    env = model.wrap_env(random_walk_env())
    env.reset(seed=0)
    env.step(row)
    checked = VecCheckNan(DummyVecEnv([lambda: model.wrap_env(random_walk_env())] * 1), raise_exception=True)
    checked.step(model.predict(checked.reset())[0])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("nested", [False, True])
def test_eval_callback_wraps_a_bare_environment(random_walk_env, tmp_path, algorithm, nested):
    env = Monitor(random_walk_env())
    callback = EvalCallback(env, n_eval_episodes=2, eval_freq=1 if nested else 40, log_path=str(tmp_path), verbose=0)
    model = algorithm("MlpPolicy", random_walk_env(), **SMALL)
    model.learn(80, callback=EveryNTimesteps(40, CallbackList([callback])) if nested else callback)
    assert all(callback.eval_env.env_is_wrapped(OptionExecutionWrapper))
    # An episode has 20 primitive steps, however few decisions.
    assert np.unique(np.load(tmp_path / "evaluations.npz")["ep_lengths"]).tolist() == [20]


def test_eval_callback_evaluates_repeatably(random_walk_env):
    def evaluated():
        env = DummyVecEnv([random_walk_env])
        env.seed(3)
        callback = EvalCallback(env, n_eval_episodes=2, eval_freq=30, verbose=0)
        CTCO("MlpPolicy", random_walk_env(), **SMALL).learn(60, callback=callback)
        return callback.last_mean_reward

    assert evaluated() == evaluated()


def test_eval_callback_refuses_what_it_cannot_wrap(random_walk_env):
    model = CTCO("MlpPolicy", random_walk_env(), d_max=1.0, **SMALL)
    bare = VecNormalize(DummyVecEnv([random_walk_env]), norm_reward=False)
    with pytest.raises(ValueError, match=r"VecNormalize.*do not play options.*model\.wrap_env"):
        model.learn(20, callback=EvalCallback(bare))
    other = OptionExecutionWrapper(Monitor(random_walk_env()), d_max=0.7)
    with pytest.raises(ValueError, match=r"d_max=0\.7.*CTCO has d_max=1\.0"):
        model.learn(20, callback=EvalCallback(other))


def test_dac_ppo_gives_actions(random_walk_env):
    """Its options choose primitive actions: any environment is the right one."""
    model = DACPPO("MlpPolicy", random_walk_env(), n_steps=16, batch_size=8, policy_kwargs={"net_arch": [8]})
    mean, _ = evaluate_policy(model, Monitor(random_walk_env()), n_eval_episodes=2)
    assert -20 <= mean <= 0


def test_a_monitor_outside_is_named(random_walk_env):
    outside = Monitor(OptionExecutionWrapper(random_walk_env()))
    with pytest.warns(UserWarning, match=r"Monitor is outside OptionExecutionWrapper.*decisions.*wrap_env"):
        CTCO("MlpPolicy", outside, **SMALL)
    with pytest.warns(UserWarning, match="Monitor is outside OptionExecutionWrapper"):
        CTCO("MlpPolicy", DummyVecEnv([lambda: outside]), **SMALL)
    venv = make_vec_env(random_walk_env, 2, wrapper_class=OptionExecutionWrapper)
    with pytest.warns(UserWarning, match="VecMonitor is outside OptionExecutionWrapper"):
        CTCO("MlpPolicy", VecMonitor(venv), **SMALL)


@pytest.mark.filterwarnings("error:.*outside OptionExecutionWrapper.*")
def test_a_monitor_inside_is_not(random_walk_env):
    CTCO("MlpPolicy", Monitor(random_walk_env()), **SMALL)
    CTCO("MlpPolicy", OptionExecutionWrapper(Monitor(random_walk_env())), **SMALL)
    CTCO("MlpPolicy", make_vec_env(random_walk_env, 2, wrapper_class=OptionExecutionWrapper), **SMALL)


def test_what_predict_returned_can_be_planned(random_walk_env):
    model = CTCO("MlpPolicy", random_walk_env())
    option, _ = model.predict(random_walk_env().reset(seed=0)[0])
    space = model.option_space
    assert space.duration(option) == space.duration(option.vector)
    np.testing.assert_array_equal(space.plan(option), space.plan(option.vector))
