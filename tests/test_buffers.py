import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl

from sb3_ctco import DictOptionReplayBuffer, OptionExecutionWrapper, OptionReplayBuffer

TAU = math.log(2.0)
OPTION_SPACE = spaces.Box(-1.0, 1.0, (3,), np.float32)
VECTOR = spaces.Box(-10.0, 10.0, (2,), np.float32)


def option_info(duration, integral, truncated=False):
    option = {"duration": duration, "n_steps": 1, "integrated_reward": integral, "discount": 0.5**duration}
    return {"option": option, "TimeLimit.truncated": truncated}


def make_buffer(kind, n_envs=1, size=8):
    if kind == "dict":
        space = spaces.Dict({"a": VECTOR, "b": spaces.Box(0, 255, (4,), np.uint8)})
        return DictOptionReplayBuffer(size, space, OPTION_SPACE, device="cpu", n_envs=n_envs, discount_rate=TAU)
    return OptionReplayBuffer(size, VECTOR, OPTION_SPACE, device="cpu", n_envs=n_envs, discount_rate=TAU)


def observation(kind, value, n_envs=1):
    vector = np.full((n_envs, 2), value, dtype=np.float32)
    return {"a": vector, "b": np.full((n_envs, 4), value, dtype=np.uint8)} if kind == "dict" else vector


def add(buffer, kind, value, infos, done=False):
    n = len(infos)
    action = np.full((n, 3), value / 10, dtype=np.float32)
    reward, dones = np.full(n, 99.0), np.full(n, done)
    buffer.add(observation(kind, value, n), observation(kind, value + 1, n), action, reward, dones, infos)


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_a_sample_has_the_integral_and_the_discount(kind):
    buffer = make_buffer(kind)
    add(buffer, kind, 3, [option_info(2.0, 0.25)])
    sample = buffer.sample(4)
    assert sample.rewards.shape == sample.discounts.shape == sample.dones.shape == (4, 1)
    th.testing.assert_close(sample.rewards, th.full((4, 1), 0.25))
    th.testing.assert_close(sample.discounts, th.full((4, 1), 0.25))  # half a second
    th.testing.assert_close(sample.actions, th.full((4, 3), 0.3))
    assert sample.discounts.dtype == sample.rewards.dtype == th.float32
    obs, next_obs = sample.observations, sample.next_observations
    if kind == "dict":
        assert obs["b"].dtype == th.uint8
        obs, next_obs = obs["a"], next_obs["a"]
    th.testing.assert_close(obs, th.full((4, 2), 3.0))
    th.testing.assert_close(next_obs, th.full((4, 2), 4.0))


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_rows_of_several_environments_stay_together(kind):
    buffer = make_buffer(kind, n_envs=2, size=20)
    assert buffer.durations.shape == (20, 1)
    for value in range(10):
        add(buffer, kind, value, [option_info(value / 2, value), option_info(value / 4, -value)])
    assert buffer.full
    sample = buffer.sample(400)
    obs = sample.observations["a"] if kind == "dict" else sample.observations
    value, sign = obs[:, :1], th.sign(sample.rewards)
    th.testing.assert_close(sample.rewards, sign * value)
    duration = th.where(sign > 0, value / 2, value / 4)
    th.testing.assert_close(sample.discounts, th.pow(0.5, duration))
    assert (sign > 0).any()
    assert (sign < 0).any()


@pytest.mark.parametrize(("truncated", "done", "expected"), [(True, True, 0.0), (False, True, 1.0), (False, False, 0.0)])
def test_only_termination_stops_bootstrapping(truncated, done, expected):
    buffer = make_buffer("vector")
    add(buffer, "vector", 1, [option_info(1.0, 1.0, truncated)], done)
    assert (buffer.sample(3).dones == expected).all()


def test_the_ring_overwrites_the_oldest():
    buffer = make_buffer("vector", size=3)
    for value in range(5):
        add(buffer, "vector", value, [option_info(1.0, float(value))])
    assert sorted(buffer.integrated_rewards[:, 0]) == [2.0, 3.0, 4.0]
    np.testing.assert_array_equal(buffer.integrated_rewards[:, 0], buffer.observations[:, 0, 0])


@pytest.mark.parametrize(
    ("infos", "message"),
    [
        ([{}], "OptionExecutionWrapper"),
        ([option_info(1.0, math.nan)], "not finite"),
        ([option_info(1.0, 1.0) | {"option": {"duration": 1.0, "integrated_reward": 1.0, "discount": 0.9}}], "discount_rate"),
    ],
)
def test_bad_infos_leave_the_buffer_as_it_was(infos, message):
    buffer = make_buffer("vector")
    add(buffer, "vector", 1, [option_info(1.0, 1.0)])
    before = {name: value.copy() for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
    with pytest.raises(ValueError, match=message):
        add(buffer, "vector", 2, infos)
    assert buffer.pos == 1
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(buffer, name), value)


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_memory_optimisation_is_refused(kind):
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        cls = type(make_buffer(kind))
        cls(8, make_buffer(kind).observation_space, OPTION_SPACE, optimize_memory_usage=True)


def test_saved_and_loaded(tmp_path):
    buffer = make_buffer("vector")
    add(buffer, "vector", 3, [option_info(2.0, 0.25)])
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    sample = load_from_pkl(tmp_path / "buffer.pkl").sample(2)
    th.testing.assert_close(sample.discounts, th.full((2, 1), 0.25))


@pytest.mark.parametrize("algorithm", [SAC, TD3])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_stock_algorithms_learn_on_the_semi_markov_process(algorithm, n_envs):
    """SAC and TD3 use a sample's rewards and discounts as they are."""
    env = make_vec_env(
        "Pendulum-v1",
        n_envs=n_envs,
        wrapper_class=OptionExecutionWrapper,
        wrapper_kwargs={"reward": "integral", "n_rbf": 2, "d_max": 0.5},
    )
    model = algorithm(
        "MlpPolicy",
        env,
        replay_buffer_class=OptionReplayBuffer,
        learning_starts=10,
        policy_kwargs={"net_arch": [16, 16]},
        batch_size=32,
        seed=0,
    )
    model.learn(60)
    buffer = model.replay_buffer
    stored = slice(0, buffer.pos)
    assert buffer.pos == 60
    # With reward="integral" what Stable-Baselines3 stored is R as well.
    np.testing.assert_allclose(buffer.rewards[stored], buffer.integrated_rewards[stored], rtol=1e-6)
    assert (buffer.durations[stored] >= 0.05 - 1e-6).all()
    assert (buffer.durations[stored] <= 0.5 + 1e-6).all()
    assert len(np.unique(buffer.durations[stored])) > 3
    assert model._n_updates > 0


def test_the_discounts_reach_sacs_target(monkeypatch):
    """The critic's loss of stock SAC, recomputed by hand with γ(d) from the buffer."""
    env = OptionExecutionWrapper(gym.make("Pendulum-v1"), n_rbf=1, discount_rate=TAU)
    model = SAC(
        "MlpPolicy",
        env,
        replay_buffer_class=OptionReplayBuffer,
        replay_buffer_kwargs={"discount_rate": TAU},
        ent_coef=0.0,
        policy_kwargs={"net_arch": [8]},
        learning_starts=100,
        learning_rate=0.0,
        seed=0,
    )
    model.learn(20)
    batch = model.replay_buffer.sample(16)
    assert len(th.unique(batch.discounts)) > 3
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    th.manual_seed(0)
    with th.no_grad():
        model.actor.action_log_prob(batch.observations)  # SAC draws these first
        next_actions, _ = model.actor.action_log_prob(batch.next_observations)
        next_q = th.cat(model.critic_target(batch.next_observations, next_actions), dim=1).min(dim=1, keepdim=True)[0]
        target = batch.rewards + batch.discounts * next_q
        q_values = model.critic(batch.observations, batch.actions)
        expected = 0.5 * sum(((q - target) ** 2).mean() for q in q_values)
    th.manual_seed(0)
    model.train(1, 16)
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(expected.item(), rel=1e-5)


def test_memory_of_a_transition():
    assert make_buffer("vector").bytes_per_transition == 2 * 2 * 4 + 3 * 4 + 5 * 4
    # 80×60 pixels and 21 floats, options of 7 actions of 3 weights: 100,000 fit into 3 GB.
    space = spaces.Dict({"image": spaces.Box(0, 255, (3, 60, 80), np.uint8), "proprioception": spaces.Box(-1, 1, (21,))})
    buffer = DictOptionReplayBuffer(10, space, spaces.Box(-1, 1, (22,)), device="cpu")
    assert buffer.bytes_per_transition == 2 * (80 * 60 * 3 + 21 * 4) + 22 * 4 + 5 * 4 == 29_076
    assert 100_000 * buffer.bytes_per_transition < 3e9


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_a_scale_that_does_not_depend_on_the_unit_of_rewards(kind):
    """With γ = 0.5 a second, 3 for 1 s is worth 3/(1 − 0.5) = 6 if it is repeated forever, −4 for 2 s is −4/(1 − 0.25)."""
    buffer = make_buffer(kind)
    buffer.reward_scale = "auto"
    add(buffer, kind, 0, [option_info(1.0, 0.0)])
    assert buffer._get_samples(np.array([0])).rewards.item() == 0.0
    assert buffer.reward_scale == "auto"  # nothing was paid
    add(buffer, kind, 1, [option_info(1.0, 3.0)])
    add(buffer, kind, 2, [option_info(2.0, -4.0)])
    rewards = buffer._get_samples(np.arange(3)).rewards[:, 0]
    np.testing.assert_allclose(rewards, [0.0, 50.0, -4.0 * 100 / 6], rtol=1e-6)
    add(buffer, kind, 3, [option_info(1.0, 30.0)])
    assert buffer._get_samples(np.array([3])).rewards.item() == pytest.approx(500.0)  # as critics learned


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_what_options_pay_a_second(kind):
    buffer = make_buffer(kind)
    add(buffer, kind, 0, [option_info(1.0, 0.0)])
    assert buffer.mean_reward_rate == 1.0  # Nothing was paid.
    add(buffer, kind, 1, [option_info(1.0, 3.0)])
    add(buffer, kind, 2, [option_info(2.0, -4.5)])
    # What is lost counts, too; what pays nothing does not; what was paid earlier fades over 100 horizons.
    kept = np.exp(-2.0 * buffer.discount_rate / 100.0)
    assert buffer.mean_reward_rate == pytest.approx((3.0 * kept + 4.5) / (kept + 2.0), rel=1e-12)
    assert 2.4 < buffer.mean_reward_rate < 2.5
    for _ in range(10):
        add(buffer, kind, 3, [option_info(100.0, 100.0)])
    # The first 3 s, of 2.5 a second, weigh a fiftieth of the rest.
    weight = np.exp(-1000.0 * buffer.discount_rate / 100.0)
    assert buffer.mean_reward_rate == pytest.approx(1.0, abs=1.5 * 3.0 * weight / 100.0)


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_what_somebody_else_did_is_no_transition_of_the_policy(kind):
    buffer = make_buffer(kind, n_envs=2)
    add(buffer, kind, 1, [option_info(1.0, 3.0) | {"taken_over": True}, option_info(1.0, 4.0)])
    assert buffer.size() == buffer.n_decisions == 1
    assert buffer.integrated_rewards[0, 0] == 4.0


def test_a_scale_waits_until_a_row_pays():
    """What was paid may have been overwritten."""
    buffer = OptionReplayBuffer(2, VECTOR, OPTION_SPACE, device="cpu", discount_rate=TAU, reward_scale="auto")
    for value, paid in enumerate((3.0, 0.0, 0.0)):
        add(buffer, "vector", value, [option_info(1.0, paid)])
    assert buffer.found_reward_scale() == 1.0
    add(buffer, "vector", 3, [option_info(1.0, 2.0)])
    assert buffer.found_reward_scale() == pytest.approx(100 / 4)  # 2 a second for one halves: 4 forever


def test_a_key_of_an_environments_own_means_nothing():
    """Only what the package's own environments say keeps a decision out."""
    buffer = make_buffer("vector")
    for key, value in (("pending", True), ("played", np.ones(3)), ("taken_over", False)):
        add(buffer, "vector", 1, [option_info(1.0, 3.0) | {key: value}])
    assert buffer.size() == 3
    np.testing.assert_allclose(buffer.actions[:3, 0], 0.1)
