"""What Stable-Baselines3 and sb3-contrib ask of every algorithm, for each of this package's."""

import io
from collections import OrderedDict
from copy import deepcopy
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_ctco import CTCO, FiGARSAC, OptionExecutionWrapper

#: Each algorithm with arguments that make its runs short.
_SHORT = {
    "learning_starts": 20,
    "batch_size": 8,
    "buffer_size": 300,
    "d_max": 0.3,
    "policy_kwargs": {"net_arch": [16]},
    "device": "cpu",
}
ALGORITHMS = {CTCO: _SHORT, FiGARSAC: _SHORT}
#: OptionExecutionWrapper's arguments for each
WRAPPER: dict[type, dict[str, Any]] = {CTCO: {"d_max": 0.3}, FiGARSAC: {"n_rbf": 1, "d_max": 0.3, "duration_scale": "linear"}}
#: For frames that are stacked outside, where sub-options cannot be
WITHOUT_SUB_OPTIONS: dict[type, dict[str, Any]] = {CTCO: {"n_sub_options": 0}, FiGARSAC: {}}
pytestmark = pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda algorithm: algorithm.__name__)


def make(algorithm: type, env: Any, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    arguments = {**ALGORITHMS[algorithm], **kwargs}
    if "policy_kwargs" in kwargs:
        arguments["policy_kwargs"] = {**ALGORITHMS[algorithm]["policy_kwargs"], **kwargs["policy_kwargs"]}
    return algorithm(policy, env, **arguments)


def wrapped(algorithm: type, env: gym.Env) -> OptionExecutionWrapper:
    return OptionExecutionWrapper(env, **WRAPPER[algorithm])


def copy_of_parameters(model: Any) -> "OrderedDict[str, th.Tensor]":
    return deepcopy(model.policy.state_dict())


def assert_same_parameters(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert th.equal(value, other[name]), name


class StopsAt(BaseCallback):
    """Ends training at a call, and counts the events that Stable-Baselines3 promises."""

    def __init__(self, n_calls: int):
        super().__init__()
        self.stop_at = n_calls
        self.events: list[str] = []

    def _on_training_start(self) -> None:
        self.events.append("training start")

    def _on_rollout_start(self) -> None:
        self.events.append("rollout start")

    def _on_step(self) -> bool:
        self.events.append("step")
        return self.n_calls < self.stop_at

    def _on_training_end(self) -> None:
        self.events.append("training end")


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": 0.1},
        {"ent_coef": "auto_0.01"},
        {"policy_kwargs": {"n_critics": 1}},
        {"policy_kwargs": {"n_critics": 3, "activation_fn": nn.Tanh, "net_arch": {"pi": [4, 4], "qf": [8]}}},
        {"policy_kwargs": {"share_features_extractor": True}},
        {"learning_rate": lambda remaining: 1e-3 * remaining},
        {"train_freq": (1, "episode"), "gradient_steps": 5},
        {"train_freq": 8, "gradient_steps": 2},
        {"action_noise": 0.1},
    ],
    ids=lambda kwargs: ", ".join(kwargs) or "defaults",
)
def test_runs(algorithm, random_walk_env, kwargs):
    env = wrapped(algorithm, random_walk_env())
    if "action_noise" in kwargs:
        shape = env.action_space.shape
        kwargs = {"action_noise": NormalActionNoise(np.zeros(shape), np.full(shape, kwargs["action_noise"]))}
    model = make(algorithm, env, **kwargs)
    before = copy_of_parameters(model)
    model.learn(80)
    assert model.num_timesteps >= 80
    after = model.policy.state_dict()
    assert all(th.isfinite(value).all() for value in after.values())
    assert any(not th.equal(value, after[name]) for name, value in before.items())


@pytest.mark.parametrize("n_envs", [1, 3])
def test_several_environments(algorithm, random_walk_env, n_envs):
    env = make_vec_env(random_walk_env, n_envs, wrapper_class=OptionExecutionWrapper, wrapper_kwargs=WRAPPER[algorithm])
    model = make(algorithm, env).learn(120)
    assert model._n_updates > 0
    assert model.predict(env.reset())[0].shape == (n_envs, *env.action_space.shape)


def test_deterministic_training(algorithm, random_walk_env):
    """The same seed gives the same parameters and the same rewards, another seed others."""
    results = []
    for seed in (0, 0, 1):
        model = make(algorithm, random_walk_env(), seed=seed).learn(80)
        rewards, _ = evaluate_policy(model, model.get_env(), 3, return_episode_rewards=True, warn=False)
        results.append((copy_of_parameters(model), rewards))
    assert_same_parameters(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]
    assert results[0][1] != results[2][1]


def test_predict(algorithm, random_walk_env):
    model = make(algorithm, random_walk_env(), seed=0)
    space = model.observation_space
    one, several = space.sample(), np.stack([space.sample() for _ in range(4)])
    greedy, state = model.predict(one, deterministic=True)
    assert state is None
    assert greedy.shape == model.action_space.shape
    np.testing.assert_array_equal(greedy, model.predict(one, deterministic=True)[0])
    assert not np.array_equal(greedy, model.predict(one, deterministic=False)[0])
    options, _ = model.predict(several)
    assert options.shape == (4, *model.action_space.shape)
    assert all(model.action_space.contains(option.vector) for option in options)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(7, np.float32))


def test_save_load_is_the_same_model(algorithm, tmp_path, random_walk_env):
    model = make(algorithm, random_walk_env(), seed=0).learn(60)
    observations = np.stack([model.observation_space.sample() for _ in range(10)])
    expected = model.predict(observations, deterministic=True)[0]

    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    model.save(tmp_path / "model.zip")
    for source in (file, tmp_path / "model.zip", str(tmp_path / "model")):
        loaded = algorithm.load(source, device="cpu")
        assert_same_parameters(model.policy.state_dict(), loaded.policy.state_dict())
        np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
        assert loaded.num_timesteps == model.num_timesteps
        assert loaded.get_env() is None

    # The optimisers are part of it: both go on alike.
    loaded.set_env(random_walk_env())
    loaded.replay_buffer, loaded._last_obs = deepcopy(model.replay_buffer), None
    for one in (model, loaded):
        one.set_logger(Logger(None, []))
        one.set_random_seed(7)
        one.train(gradient_steps=3, batch_size=8)
    assert_same_parameters(model.policy.state_dict(), loaded.policy.state_dict())
    loaded.learn(40, reset_num_timesteps=False)


def test_load_with_other_arguments(algorithm, tmp_path, random_walk_env):
    make(algorithm, random_walk_env()).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=random_walk_env(), learning_rate=1e-5, device="cpu")
    assert loaded.learning_rate == 1e-5
    assert loaded.lr_schedule(1) == 1e-5
    with pytest.raises(ValueError, match="policy kwargs"):
        algorithm.load(tmp_path / "model", policy_kwargs={"net_arch": [3]}, device="cpu")


def test_set_parameters(algorithm, tmp_path, random_walk_env):
    model = make(algorithm, random_walk_env(), seed=0).learn(60)
    other = make(algorithm, random_walk_env(), seed=1)
    parameters = deepcopy(model.get_parameters())
    other.set_parameters(parameters, exact_match=True)
    assert_same_parameters(model.policy.state_dict(), other.policy.state_dict())

    model.save(tmp_path / "model")
    another = make(algorithm, random_walk_env(), seed=2)
    another.set_parameters(str(tmp_path / "model"), exact_match=True)
    assert_same_parameters(model.policy.state_dict(), another.policy.state_dict())

    only_policy = {"policy": parameters["policy"]}
    another.set_parameters(only_policy, exact_match=False)
    with pytest.raises(ValueError, match="do not match"):
        another.set_parameters(only_policy, exact_match=True)
    with pytest.raises(ValueError, match="invalid object name"):
        another.set_parameters({**parameters, "no such object": {}}, exact_match=False)
    del parameters["policy"][next(iter(parameters["policy"]))]
    with pytest.raises(RuntimeError, match="Missing key"):
        another.set_parameters(parameters, exact_match=True)


def test_exclude_and_include(algorithm, tmp_path, random_walk_env):
    model = make(algorithm, random_walk_env(), learning_rate=0.5)
    model.save(tmp_path / "model", exclude=["learning_rate"])
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert "learning_rate" not in data
    assert not {"policy", "env", "replay_buffer", "actor", "critic"} & data.keys()
    # What is excluded comes from the constructor.
    assert algorithm.load(tmp_path / "model", device="cpu").learning_rate != 0.5
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", custom_objects={"learning_rate": 1e-4}, device="cpu")
    assert loaded.learning_rate == 1e-4

    model.save(tmp_path / "with_noise", include=["_last_obs"])
    data, _, _ = load_from_zip_file(tmp_path / "with_noise")
    assert "_last_obs" in data


def test_policy_alone(algorithm, tmp_path, random_walk_env):
    model = make(algorithm, random_walk_env(), seed=0).learn(40)
    observations = np.stack([model.observation_space.sample() for _ in range(10)])
    model.policy.save(tmp_path / "policy.pkl")
    policy = type(model.policy).load(tmp_path / "policy.pkl", device="cpu")
    np.testing.assert_array_equal(
        policy.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    model.policy.actor.save(tmp_path / "actor.pkl")
    actor = type(model.policy.actor).load(tmp_path / "actor.pkl", device="cpu")
    np.testing.assert_array_equal(
        actor.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_replay_buffer(algorithm, tmp_path, random_walk_env, kind):
    policy = "MlpPolicy" if kind == "vector" else "MultiInputPolicy"
    model = make(algorithm, random_walk_env(kind), policy).learn(60)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    before = model.replay_buffer
    model.replay_buffer = None
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    after = model.replay_buffer
    assert type(after) is type(before)
    assert (after.pos, after.full) == (before.pos, before.full)
    for name in ("actions", "rewards", "dones", "timeouts", "durations", "integrated_rewards"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    model.learn(30, reset_num_timesteps=False)


class TinyCnn(BaseFeaturesExtractor):
    """A few filters, for images of any size."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=4)
        self.layers = nn.Sequential(nn.Conv2d(observation_space.shape[0], 4, 5, 4), nn.AdaptiveAvgPool2d(1), nn.Flatten())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations)


class ChannelsLast(gym.ObservationWrapper):
    """Images as cameras give them."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation.transpose(1, 2, 0)


@pytest.mark.parametrize("share", [False, True])
def test_cnn(algorithm, tmp_path, random_walk_env, share):
    kwargs = {"policy_kwargs": {"features_extractor_class": TinyCnn, "share_features_extractor": share}}
    model = make(algorithm, ChannelsLast(random_walk_env("image")), "CnnPolicy", buffer_size=100, **kwargs)
    before = copy_of_parameters(model)
    model.learn(60)
    # Stable-Baselines3 turned the images round.
    assert model.observation_space.shape == (3, 36, 36)
    changed = {name for name, value in before.items() if not th.equal(value, model.policy.state_dict()[name])}
    assert any("features_extractor" in name and name.startswith("actor.") for name in changed)
    image = np.random.default_rng(0).integers(0, 255, (36, 36, 3), dtype=np.uint8)
    expected = model.predict(image, deterministic=True)[0]
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    np.testing.assert_array_equal(loaded.predict(image, deterministic=True)[0], expected)


def test_nature_cnn(algorithm, random_walk_env):
    model = make(algorithm, random_walk_env("image"), "CnnPolicy", buffer_size=60)
    model.learn(30)
    assert type(model.actor.features_extractor).__name__ == "NatureCNN"


class GoalWalk(gym.Env):
    """A walk with a dictionary of vectors."""

    observation_space = spaces.Dict({"position": spaces.Box(-1, 1, (2,)), "goal": spaces.Box(-10, 10, (1,))})
    action_space = spaces.Box(-1, 1, (2,))
    metadata: ClassVar[dict[str, Any]] = {}
    dt = 0.1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.count = np.zeros(2, np.float32), 0
        self.goal = self.np_random.uniform(-10, 10, 1).astype(np.float32)
        return {"position": self.position, "goal": self.goal}, {}

    def step(self, action):
        self.position = np.clip(self.position + 0.1 * action, -1, 1).astype(np.float32)
        self.count += 1
        distance = float(np.abs(self.position - self.goal / 10).max())
        return {"position": self.position, "goal": self.goal}, -distance, False, self.count >= 20, {}


def test_dictionaries(algorithm):
    model = make(algorithm, GoalWalk(), "MultiInputPolicy").learn(80)
    _, lengths = evaluate_policy(model, model.get_env(), 2, return_episode_rewards=True)
    assert lengths == [20, 20]


def test_dictionaries_normalised_and_stacked(algorithm, tmp_path):
    # VecNormalize outside, as Stable-Baselines3 asks of algorithms with a replay buffer.
    env = VecFrameStack(DummyVecEnv([lambda: wrapped(algorithm, GoalWalk())] * 2), n_stack=3)
    env = VecNormalize(env, norm_obs=True, norm_reward=False, norm_obs_keys=["goal"])
    model = make(algorithm, env, "MultiInputPolicy", **WITHOUT_SUB_OPTIONS[algorithm]).learn(120)
    assert model.observation_space["position"].shape == (6,)
    normalizer = model.get_vec_normalize_env()
    assert normalizer.obs_rms["goal"].count > 1
    assert "position" not in normalizer.obs_rms

    model.save(tmp_path / "model")
    normalizer.save(tmp_path / "normalize.pkl")
    stacked = VecFrameStack(DummyVecEnv([lambda: wrapped(algorithm, GoalWalk())]), n_stack=3)
    again = VecNormalize.load(tmp_path / "normalize.pkl", stacked)
    loaded = algorithm.load(tmp_path / "model", env=again, device="cpu")
    evaluate_policy(loaded, loaded.get_env(), 2, warn=False)
    loaded.learn(40, reset_num_timesteps=False)


def test_images_stacked(algorithm, random_walk_env):
    env = VecFrameStack(DummyVecEnv([lambda: wrapped(algorithm, random_walk_env("image"))]), n_stack=2, channels_order="first")
    kwargs = {"features_extractor_class": TinyCnn}
    kwargs = {"policy_kwargs": kwargs, **WITHOUT_SUB_OPTIONS[algorithm]}
    model = make(algorithm, env, "CnnPolicy", buffer_size=100, **kwargs).learn(40)
    assert model.observation_space.shape == (6, 36, 36)


def test_vec_normalize_of_observations(algorithm, random_walk_env):
    env = VecNormalize(DummyVecEnv([lambda: wrapped(algorithm, random_walk_env())]), norm_reward=False)
    model = make(algorithm, env).learn(80)
    # The buffer keeps observations as they are, and normalises what it samples.
    stored = model.replay_buffer.observations[: model.replay_buffer.pos]
    assert np.abs(stored).max() <= 1.0
    sample = model.replay_buffer.sample(200, env=env).observations
    assert float(sample.abs().max()) > 1.0


class WithDropoutAndBatchNorm(FlattenExtractor):
    """Features that differ between training and evaluation."""

    def __init__(self, observation_space: spaces.Space):
        super().__init__(observation_space)
        self.dropout = nn.Dropout(0.5)
        self.norm = nn.BatchNorm1d(self.features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.norm(self.dropout(super().forward(observations)))


def test_train_and_eval_mode(algorithm, random_walk_env):
    model = make(algorithm, random_walk_env(), policy_kwargs={"features_extractor_class": WithDropoutAndBatchNorm}, tau=0.5)
    observation = np.array([0.3, 0.6], np.float32)
    # Predictions are in evaluation mode: no dropout, and they move no running mean.
    statistics = model.actor.features_extractor.norm.running_mean.clone()
    options = [model.predict(observation, deterministic=True)[0] for _ in range(5)]
    assert all(np.array_equal(option, options[0]) for option in options)
    assert th.equal(model.actor.features_extractor.norm.running_mean, statistics)
    assert not model.actor.features_extractor.training

    # Training moves them, those of the critics and, at once, those of the targets.
    model.learn(60)
    pairs = [(model.critic, model.critic_target)]
    if hasattr(model, "actor_target"):  # FiGAR-SAC has none
        pairs.append((model.actor, model.actor_target))
    for network, target in pairs:
        running = network.features_extractor.norm.running_mean
        assert not th.equal(running, statistics)
        assert th.equal(running, target.features_extractor.norm.running_mean)
    # An update leaves the targets in evaluation mode, and the next prediction the actor.
    assert not model.critic_target.training
    model.predict(observation)
    assert not model.actor.training


def test_without_learning_rate_nothing_but_statistics_moves(algorithm, random_walk_env):
    model = make(algorithm, random_walk_env(), learning_rate=0.0)
    before = copy_of_parameters(model)
    model.learn(80)
    assert model._n_updates > 0
    assert_same_parameters(before, model.policy.state_dict())


def test_callbacks(algorithm, tmp_path, random_walk_env):
    model = make(algorithm, random_walk_env(), seed=0)
    stop = StopsAt(37)
    model.learn(200, stop)
    # One call a primitive step, although decisions take up to three.
    assert stop.events.count("step") == 37
    assert model.num_timesteps < 41
    assert (stop.events[0], stop.events[1], stop.events[-1]) == ("training start", "rollout start", "training end")

    checkpoint = CheckpointCallback(20, str(tmp_path), save_replay_buffer=True)
    evaluation = EvalCallback(
        wrapped(algorithm, random_walk_env()),
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=-1e9),
        eval_freq=50,
        n_eval_episodes=1,
        best_model_save_path=str(tmp_path),
        warn=False,
        verbose=0,
    )
    every = EveryNTimesteps(10, StopsAt(1000))
    model.learn(200, CallbackList([checkpoint, evaluation, every]))
    # The evaluation at step 50 beat the threshold and ended training.
    assert 50 <= model.num_timesteps < 54
    assert every.callback.n_calls == 5
    assert (tmp_path / "best_model.zip").exists()
    assert (tmp_path / "rl_model_40_steps.zip").exists()
    assert (tmp_path / "rl_model_replay_buffer_40_steps.pkl").exists()

    model.learn(200, StopTrainingOnMaxEpisodes(2))
    assert model.num_timesteps == 40
    calls: list[int] = []
    model.learn(30, lambda local, _: calls.append(local["self"].num_timesteps) or True)
    assert calls == list(range(1, model.num_timesteps + 1))


@pytest.mark.parametrize("kind", ["vector", "image", "dict"])
@pytest.mark.filterwarnings("error::UserWarning")
def test_env_checker(algorithm, random_walk_env, kind):
    model = make(algorithm, random_walk_env(kind), {"vector": "MlpPolicy", "image": "CnnPolicy"}.get(kind, "MultiInputPolicy"))
    check_env(model.wrap_env(random_walk_env(kind)), skip_render_check=True)


def test_environments_by_name(algorithm):
    model = make(algorithm, "Pendulum-v1")
    assert isinstance(model.get_env().envs[0], OptionExecutionWrapper)
    with pytest.raises(ValueError, match="Policy FroMe unknown"):
        make(algorithm, "Pendulum-v1", "FroMe")
