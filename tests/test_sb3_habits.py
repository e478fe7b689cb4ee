"""What users of Stable-Baselines3 take for granted, on every learner: a release that breaks a habit is seen here.

What off-policy algorithms of this package are asked beyond that is in test_sb3_contract.py.
"""

import math
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_ctco import CTCO, DACPPO, FiGARSAC, OptionExecutionWrapper, OptionReplayBuffer
from sb3_ctco.option_array import plain

_OFF_POLICY = {
    "learning_starts": 10,
    "batch_size": 8,
    "buffer_size": 400,
    "train_freq": 8,
    "gradient_steps": 2,
    "policy_kwargs": {"net_arch": [8]},
    "device": "cpu",
}
_ON_POLICY = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}


class Learner:
    """A class, the arguments that make its runs short, and what its environments must be wrapped in, if anything."""

    def __init__(self, algorithm: type, arguments: dict[str, Any], wrapper_kwargs: dict[str, Any] | None = None):
        self.algorithm, self.arguments, self.wrapper_kwargs = algorithm, arguments, wrapper_kwargs
        self.off_policy = algorithm is not DACPPO
        #: Whether the algorithm wraps bare environments itself
        self.wraps = algorithm in (CTCO, FiGARSAC)

    def env(self, env: gym.Env) -> gym.Env:
        """Around a single environment, what the algorithm does not put there itself."""
        return self.as_played(env) if self.wrapper_kwargs and not self.wraps else env

    def as_played(self, env: gym.Env) -> gym.Env:
        """The environment whose actions the model's are."""
        return OptionExecutionWrapper(Monitor(env), **self.wrapper_kwargs) if self.wrapper_kwargs else Monitor(env)

    def vec_env(self, env: Any, n_envs: int = 2, **kwargs: Any) -> Any:
        wrapper = (
            {"wrapper_class": OptionExecutionWrapper, "wrapper_kwargs": self.wrapper_kwargs} if self.wrapper_kwargs else {}
        )
        return make_vec_env(env, n_envs, **wrapper, **kwargs)

    def make(self, env: Any, policy: Any = "MlpPolicy", **kwargs: Any) -> Any:
        arguments = {**self.arguments, **kwargs}
        arguments["policy_kwargs"] = {**self.arguments["policy_kwargs"], **kwargs.get("policy_kwargs", {})}
        return self.algorithm(policy, self.env(env) if isinstance(env, gym.Env) else env, **arguments)

    def load(self, path: Any, env: Any = None, **kwargs: Any) -> Any:
        return self.algorithm.load(path, env=env, device="cpu", **kwargs)


LEARNERS = {
    "CTCO": Learner(CTCO, {**_OFF_POLICY, "d_max": 0.3}, {"d_max": 0.3}),
    "FiGARSAC": Learner(FiGARSAC, {**_OFF_POLICY, "d_max": 0.3}, {"n_rbf": 1, "d_max": 0.3, "duration_scale": "linear"}),
    "DACPPO": Learner(DACPPO, _ON_POLICY),
    "SAC": Learner(SAC, {**_OFF_POLICY, "replay_buffer_class": OptionReplayBuffer}, {"d_max": 0.3, "n_sub_options": 2}),
}
pytestmark = pytest.mark.parametrize("learner", LEARNERS.values(), ids=LEARNERS)


def parameters(model: Any) -> dict[str, th.Tensor]:
    return deepcopy(model.policy.state_dict())


def same(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(th.equal(value, other[name]) for name, value in one.items())


# --- learn


def test_learn_returns_the_model_and_goes_on(learner, random_walk_env):
    model = learner.make(random_walk_env())
    assert model.learn(64) is model
    first = model.num_timesteps
    # Up to one option, or one round of train_freq, more than was asked for
    assert 64 <= first < 64 + 11
    model.learn(32, reset_num_timesteps=False)
    assert first + 32 <= model.num_timesteps < first + 32 + 11
    model.learn(64)
    assert 64 <= model.num_timesteps < 64 + 11
    assert -0.2 < model._current_progress_remaining < 0.2


def test_the_same_seed_the_same_model(learner, random_walk_env):
    models = [learner.make(learner.vec_env(random_walk_env, seed=seed), seed=seed).learn(64) for seed in (3, 3, 4)]
    one, again, other = map(parameters, models)
    assert same(one, again)
    assert not same(one, other)


def test_learning_changes_the_policy_and_the_seed_of_torch_does_not_matter(learner, random_walk_env):
    results = []
    for noise in (1, 2):
        th.manual_seed(noise)
        np.random.seed(noise)
        model = learner.make(random_walk_env(), seed=0)
        before = parameters(model)
        results.append(parameters(model.learn(64)))
        assert not same(before, results[-1])
    assert same(*results)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_vectorised_environments(learner, random_walk_env, vec_env_cls):
    in_processes = {"vec_env_kwargs": {"start_method": "fork"}} if vec_env_cls is SubprocVecEnv else {}
    env = learner.vec_env(random_walk_env, 2, vec_env_cls=vec_env_cls, **in_processes)
    model = learner.make(env).learn(128)
    assert model.n_envs == 2
    assert model.num_timesteps >= 128
    # Monitor counts the environment's own steps in all of them.
    assert {info["l"] for info in model.ep_info_buffer} == {20}
    env.close()


def test_lists_of_functions_and_vec_monitor(learner, random_walk_env):
    env = VecMonitor(DummyVecEnv([lambda: learner.as_played(random_walk_env())] * 2))
    assert learner.make(env).learn(64).get_env() is env


def test_by_the_environments_id(learner):
    env = "Pendulum-v1" if learner.wraps or not learner.wrapper_kwargs else learner.vec_env("Pendulum-v1", 1)
    assert learner.make(env).learn(40).get_env().num_envs == 1


# --- predict


def test_predict(learner, random_walk_env):
    model = learner.make(random_walk_env())
    action_space = model.get_env().action_space
    observation = np.array([0.2, 0.5], np.float32)
    for deterministic in (False, True):
        action, _ = model.predict(observation, deterministic=deterministic)
        assert action_space.contains(action.astype(action_space.dtype))
        actions, _ = model.predict(np.stack([observation] * 3), deterministic=deterministic)
        assert actions.shape == (3, *action_space.shape)
    # Of several options the array has the numbers; a row is an Option, no action.
    alone = model.predict(observation, deterministic=True)[0]
    np.testing.assert_allclose(plain(actions)[0], plain(alone), rtol=1e-5, atol=1e-6)  # of single precision near 0
    assert not np.array_equal(model.predict(observation)[0], model.predict(observation)[0])


def test_mistakes_in_predict_are_explained(learner, random_walk_env):
    model = learner.make(random_walk_env())
    with pytest.raises(ValueError, match="mixing Gym API"):
        model.predict((np.zeros(2, np.float32), {}))
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(3, np.float32))


def test_evaluate_policy(learner, random_walk_env):
    model = learner.make(random_walk_env())
    mean, _ = evaluate_policy(model, learner.as_played(random_walk_env()), n_eval_episodes=3)
    assert -20 <= mean <= 0
    returns, lengths = evaluate_policy(model, model.get_env(), 2, return_episode_rewards=True)
    assert len(returns) == 2
    assert lengths == [20, 20]


# --- save and load


def test_saved_and_loaded_it_acts_and_learns_on(learner, random_walk_env, tmp_path):
    model = learner.make(random_walk_env(), seed=0).learn(64)
    observations = np.stack([model.observation_space.sample() for _ in range(5)])
    model.save(tmp_path / "model")
    loaded = learner.load(tmp_path / "model", env=learner.env(random_walk_env()))
    assert same(parameters(model), parameters(loaded))
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (model, loaded)))
    assert loaded.num_timesteps == model.num_timesteps
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.num_timesteps >= model.num_timesteps + 32


def test_custom_objects_and_excluded_attributes(learner, random_walk_env, tmp_path):
    model = learner.make(random_walk_env(), learning_rate=LinearSchedule(1e-3, 0.0, 1.0))
    model.save(tmp_path / "model", exclude=["tensorboard_log"])
    loaded = learner.load(tmp_path / "model", custom_objects={"learning_rate": 0.0, "lr_schedule": lambda _: 0.0})
    assert loaded.lr_schedule(1.0) == 0.0
    assert learner.load(tmp_path / "model").lr_schedule(0.5) == pytest.approx(5e-4)


def test_parameters_from_one_model_to_another(learner, random_walk_env):
    one, other = (learner.make(random_walk_env(), seed=seed).learn(32) for seed in (0, 1))
    assert not same(parameters(one), parameters(other))
    other.set_parameters(one.get_parameters())
    assert same(parameters(one), parameters(other))
    with pytest.raises(ValueError, match="invalid object name"):
        other.set_parameters({"nothing": {}}, exact_match=False)


def test_the_replay_buffer_survives(learner, random_walk_env, tmp_path):
    if not learner.off_policy:
        pytest.skip("has none")
    model = learner.make(random_walk_env()).learn(40)
    model.save_replay_buffer(tmp_path / "buffer")
    other = learner.make(random_walk_env())
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.size() == model.replay_buffer.size() > 10
    np.testing.assert_array_equal(other.replay_buffer.observations, model.replay_buffer.observations)
    other.learn(20, reset_num_timesteps=False)


# --- environments


def test_set_env(learner, random_walk_env):
    model = learner.make(random_walk_env()).learn(32)
    other = learner.env(random_walk_env())
    model.set_env(other)
    assert model.get_env().num_envs == 1
    model.learn(32)
    with pytest.raises(ValueError, match=r"[Oo]bservation spaces do not match"):
        model.set_env(learner.env(random_walk_env("image")))
    with pytest.raises((AssertionError, ValueError), match="number of environments"):
        model.set_env(learner.vec_env(random_walk_env, 2))


def test_normalised_observations(learner, random_walk_env, tmp_path):
    env = VecNormalize(learner.vec_env(random_walk_env, 1), norm_reward=False)
    model = learner.make(env).learn(64)
    assert model.get_vec_normalize_env() is env
    assert env.obs_rms.count > 10
    model.save(tmp_path / "model")
    env.save(tmp_path / "normalizer")
    again = VecNormalize.load(tmp_path / "normalizer", learner.vec_env(random_walk_env, 1))
    again.training = False
    loaded = learner.load(tmp_path / "model", env=again)
    observation = again.normalize_obs(np.array([[0.3, 0.4]], np.float32))
    np.testing.assert_array_equal(*(one.predict(observation, deterministic=True)[0] for one in (model, loaded)))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(4),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.Box(-np.inf, np.inf, (2,), np.float64),
        spaces.Box(-1.0, 1.0, (2, 2), np.float32),
    ],
    ids=str,
)
def test_observation_spaces(learner, space):
    class Env(gym.Env):
        dt = 0.1
        observation_space, action_space = space, spaces.Box(-1.0, 1.0, (2, 1), np.float64)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.count = 0
            return space.sample(), {}

        def step(self, action):
            self.count += 1
            assert self.action_space.contains(np.asarray(action, np.float64))
            return space.sample(), 1.0, False, self.count >= 10, {}

    model = learner.make(Env()).learn(40)
    assert evaluate_policy(model, model.get_env(), 1)[0] == 10.0


# --- policies


def with_own_policy(learner: Learner) -> type:
    return type("OwnPolicy", (learner.algorithm.policy_aliases["MlpPolicy"],), {})


@pytest.mark.parametrize(
    "kwargs",
    [
        {"net_arch": []},
        {"net_arch": [8, 4], "activation_fn": th.nn.ELU},
        {"net_arch": "different"},
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.01}},
        {"share_features_extractor": True},
        {"share_features_extractor": False},
    ],
    ids=str,
)
def test_policy_kwargs(learner, random_walk_env, tmp_path, kwargs):
    if kwargs.get("net_arch") == "different":
        kwargs = {"net_arch": {"pi": [8], ("qf" if learner.off_policy else "vf"): [4, 4]}}
    model = learner.make(random_walk_env(), policy_kwargs=kwargs).learn(40)
    model.save(tmp_path / "model")
    assert same(parameters(model), parameters(learner.load(tmp_path / "model")))


def test_a_policy_of_ones_own_and_one_that_does_not_exist(learner, random_walk_env):
    own = with_own_policy(learner)
    assert type(learner.make(random_walk_env(), own).learn(40).policy) is own
    with pytest.raises(ValueError, match="Policy NoPolicy unknown"):
        learner.make(random_walk_env(), "NoPolicy")


def test_set_up_later(learner, random_walk_env):
    model = learner.make(random_walk_env(), _init_setup_model=False)
    assert getattr(model, "policy", None) is None
    model._setup_model()
    model.learn(32)


def test_the_device(learner, random_walk_env):
    model = learner.make(random_walk_env(), device=th.device("cpu"))
    assert model.device == model.policy.device == th.device("cpu")


def test_the_learning_rate_follows_its_schedule(learner, random_walk_env):
    seen: list[float] = []
    model = learner.make(random_walk_env(), learning_rate=lambda remaining: seen.append(remaining) or 1e-3 * remaining)
    model.learn(96)
    assert max(seen) == 1.0
    assert min(seen) < 0.2
    optimizer = model.actor.optimizer if learner.off_policy else model.policy.optimizer
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * model._current_progress_remaining, abs=1e-4)


@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise(learner, random_walk_env, noise, n_envs):
    if not learner.off_policy:
        pytest.skip("takes none")
    env = learner.vec_env(random_walk_env, n_envs)
    shape = env.action_space.shape
    model = learner.make(env, action_noise=noise(np.zeros(shape), 0.2 * np.ones(shape))).learn(60)
    stored = model.replay_buffer.actions[: model.replay_buffer.pos]
    assert np.abs(stored).max() <= 1.0


# --- callbacks and logs


def test_a_callback_stops_learning(learner, random_walk_env):
    calls: list[int] = []
    model = learner.make(random_walk_env())
    model.learn(1000, callback=lambda local, _: calls.append(1) or len(calls) < 25)
    assert len(calls) == 25
    assert model.num_timesteps < 25 * 3 + 1
    model.learn(2000, callback=StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps <= 60


def test_evaluations_and_checkpoints(learner, random_walk_env, tmp_path):
    evaluation = EvalCallback(
        learner.as_played(random_walk_env()),
        eval_freq=25,
        n_eval_episodes=1,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        callback_after_eval=StopTrainingOnNoModelImprovement(100),
        verbose=0,
    )
    model = learner.make(random_walk_env())
    model.learn(64, callback=[evaluation, CheckpointCallback(25, str(tmp_path), save_replay_buffer=learner.off_policy)])
    file = np.load(tmp_path / "evaluations.npz")
    assert file["ep_lengths"].tolist() == [[20]] * len(file["timesteps"])
    assert len(file["timesteps"]) >= 1
    assert max(file["results"].max(axis=1)) == evaluation.best_mean_reward
    assert learner.load(tmp_path / "best_model").num_timesteps > 0
    assert list(tmp_path.glob("rl_model_*_steps.zip"))


def test_logs(learner, random_walk_env, tmp_path):
    model = learner.make(random_walk_env(), stats_window_size=3)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(200, log_interval=1)
    rows = (tmp_path / "progress.csv").read_text().splitlines()
    header = rows[0].split(",")
    assert {"time/total_timesteps", "rollout/ep_rew_mean", "rollout/ep_len_mean", "train/n_updates"} <= set(header)
    last = dict(zip(header, rows[-1].split(","), strict=True))
    assert float(last["rollout/ep_len_mean"]) == 20
    assert float(last["time/total_timesteps"]) <= model.num_timesteps
    assert model.ep_info_buffer.maxlen == 3


def test_tensorboard(learner, random_walk_env, tmp_path):
    model = learner.make(random_walk_env(), tensorboard_log=str(tmp_path))
    model.learn(64, tb_log_name="run", log_interval=1)
    model.learn(64, tb_log_name="run", log_interval=1, reset_num_timesteps=False)
    model.learn(64, log_interval=1)
    assert {path.name for path in tmp_path.iterdir()} == {"run_1", f"{learner.algorithm.__name__}_1"}


def test_a_progress_bar_and_words(learner, random_walk_env, capsys):
    learner.make(random_walk_env(), verbose=1).learn(64, log_interval=1, progress_bar=True)
    assert "Using cpu device" in capsys.readouterr().out


# --- arguments of load

#: What can be changed while loading, by what is then seen of it; of the class's own arguments, each is here or refused.
_CHANGES: dict[str, tuple[Any, Any]] = {
    "learning_rate": (1e-5, lambda model: model.lr_schedule(1.0) == 1e-5),
    "batch_size": (4, lambda model: model.batch_size == 4),
    "gamma": (0.5, lambda model: math.isclose(model.replay_buffer.discount_rate, -math.log(0.5) / 0.05)),
    "gamma_dt": (0.1, lambda model: math.isclose(model.replay_buffer.discount_rate, -math.log(0.98) / 0.1)),
    "buffer_size": (77, lambda model: model.replay_buffer.buffer_size == 77),
    "tau": (0.5, lambda model: model.tau == 0.5),
    "train_freq": (7, lambda model: model.train_freq.frequency == 7),
    "gradient_steps": (3, lambda model: (model.gradient_steps, model.updates_per_second) == (3, None)),
    "updates_per_second": (5.0, lambda model: (getattr(model, "gradient_steps", -1), model.updates_per_second) == (-1, 5.0)),
    # Of an option in CTCO, of the action in FiGAR-SAC
    "target_entropy": (
        -7.0,
        lambda model: math.isclose(model._target_entropies[: 99 if type(model) is CTCO else -1].sum(), -7.0, rel_tol=1e-6),
    ),
    "duration_target_entropy": (-2.0, lambda model: model._target_entropies[-1] == -2.0),
    "stats_window_size": (5, lambda model: model._stats_window_size == 5),
    "n_sub_options": (3, lambda model: model.get_env().get_attr("n_sub_options") == [3]),
    "n_epochs": (2, lambda model: (model.n_epochs, model.updates_per_second) == (2, None)),
    "clip_range": (0.05, lambda model: model.clip_range(1.0) == 0.05),
    "gae_lambda": (0.5, lambda model: math.isclose(model.rollout_buffer.gae_lambda, 0.5**2)),
    "n_steps": (16, lambda model: model.rollout_buffer.buffer_size == 16),
    "ent_coef": (0.7, lambda model: model.ent_coef == 0.7),
}
_REFUSED = {
    "d_max": 0.6,
    "d_min": 0.2,
    "dt": 0.05,  # of DAC-PPO alone: a policy of options may run at another rate
    "n_rbf": 3,
    "n_repetitions": 7,
    "ent_coef": 0.7,
    "duration_ent_coef": 0.7,
    "target_decision_rate": 5.0,
}


def test_arguments_of_load_are_applied_or_refused(learner, random_walk_env, tmp_path):
    if learner.algorithm is SAC:
        pytest.skip("Stable-Baselines3's own")
    learner.make(random_walk_env()).save(tmp_path / "model")
    names = set(learner.algorithm.__init__.__annotations__)
    applied = refused = 0
    for name, (value, is_seen) in _CHANGES.items():
        if name not in names or (name in _REFUSED and learner.off_policy):
            continue
        seen = is_seen
        if name.startswith("gamma") and not learner.off_policy:
            gamma, gamma_dt = {"gamma": 0.99, "gamma_dt": 0.05, name: value}.values()
            seen = lambda model, factor=gamma ** (0.1 / gamma_dt): math.isclose(model.rollout_buffer.gamma, factor)  # noqa: E731
        loaded = learner.load(tmp_path / "model", env=random_walk_env(), **{name: value})
        assert seen(loaded), name
        loaded.learn(32)
        applied += 1
    for name, value in _REFUSED.items():
        if name not in names or (name == "ent_coef" and not learner.off_policy) or (name == "dt" and learner.off_policy):
            continue
        with pytest.raises(ValueError, match=f"'{name}': {value}.* cannot be changed while loading.*learning_rate"):
            learner.load(tmp_path / "model", **{name: value})
        refused += 1
        # What the file says already is no change.
        same_as_file = getattr(learner.load(tmp_path / "model"), name)
        learner.load(tmp_path / "model", **{name: same_as_file})
    if learner.off_policy:
        # FiGAR-SAC keeps it as three steps of 0.1 s, which rounds to another number.
        learner.load(tmp_path / "model", d_max=learner.arguments["d_max"])
    assert applied >= 9
    assert refused >= 1
    with pytest.raises(TypeError, match=r"no arguments \['gama'\] to change"):
        learner.load(tmp_path / "model", gama=0.5)


def test_of_two_ways_to_say_how_often_to_update_the_one_given_to_load_holds(learner, random_walk_env, tmp_path):
    if learner.algorithm is SAC:
        pytest.skip("has one way")
    updates = {"updates_per_second": 5.0}
    kwargs = {"gradient_steps": -1} if learner.off_policy else {"n_epochs": None}
    learner.make(random_walk_env(), **updates, **kwargs).save(tmp_path / "model")
    name = "gradient_steps" if learner.off_policy else "n_epochs"
    loaded = learner.load(tmp_path / "model", **{name: 2})
    assert (getattr(loaded, name), loaded.updates_per_second) == (2, None)
