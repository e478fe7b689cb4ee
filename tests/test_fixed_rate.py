import doctest
import math
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.sac.policies import MlpPolicy

from sb3_ctco import CTCO, OptionExecutionWrapper, RewardRateWrapper, sac_at_rate
from sb3_ctco import fixed_rate as module
from sb3_ctco.evaluation import DiscountedReturnCallback, evaluate_discounted_return
from sb3_ctco.fixed_rate import FixedRateSAC, QuickSACPolicy, hold_actions, update_schedule
from sb3_ctco.options import DEFAULT_DISCOUNT_RATE
from sb3_ctco.wrappers import TakeOverWrapper, reward_rate

SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "device": "cpu", "seed": 0}


# --- the wrapper


def test_the_agents_reward_is_in_the_unit_of_gamma_dt(scripted_env):
    """At ``gamma_dt`` rewards are as they are, as for stock SAC; half that time is worth a little more than half."""
    for dt, expected in ((0.1, 3.0), (0.05, 3.0 / (1.0 + math.sqrt(0.9)))):
        model = sac_at_rate(scripted_env(rewards=lambda step, action: 3.0, dt=dt), dt=dt, gamma=0.9, gamma_dt=0.1)
        env = model.get_env()
        env.reset()
        _, rewards, _, infos = env.step(np.zeros((1, 1)))
        assert rewards[0] == pytest.approx(expected)
        # What is evaluated stays the integral: 3·(1 − 0.9^(dt/0.1))/τ.
        tau = -math.log(0.9) / 0.1
        assert infos[0]["option"]["integrated_reward"] == pytest.approx(3.0 * (1 - 0.9 ** (dt / 0.1)) / tau)


def test_reward_rate_by_hand(scripted_env):
    """τ = ln 2 per second and steps of 1 s: a rate of r is worth r·(1 − ½)/ln 2."""
    env = RewardRateWrapper(scripted_env(rewards=lambda step, action: 3.0 + step), dt=1.0, discount_rate=math.log(2.0))
    env.reset()
    for rate in (3.0, 4.0):
        _, reward, _, _, info = env.step(np.zeros(1))
        assert reward == pytest.approx(rate * 0.5 / math.log(2.0))
        assert info["option"] == {
            "duration": 1.0,
            "n_steps": 1,
            "integrated_reward": reward,
            "discount": pytest.approx(0.5),
        }
        assert info["count"] == rate - 2


def test_without_discounting_a_rate_is_worth_its_time(scripted_env):
    env = RewardRateWrapper(scripted_env(dt=0.02), discount_rate=0.0)
    env.reset()
    assert env.step(np.zeros(1))[1] == pytest.approx(0.02)


@given(st.floats(0.001, 1.0), st.floats(0.0, 5.0), st.integers(1, 20))
def test_a_step_is_an_option_of_one_step(dt, discount_rate, n_steps):
    """The discounted return of n steps is the R of the option that is made of them."""
    from conftest import ScriptedEnv

    make_env = lambda: ScriptedEnv(rewards=lambda step, action: math.cos(step), dt=dt)  # noqa: E731
    env = RewardRateWrapper(make_env(), discount_rate=discount_rate)
    env.reset()
    total, discounts = 0.0, 1.0
    for _ in range(n_steps):
        _, reward, _, _, info = env.step(np.zeros(1))
        total += discounts * reward
        discounts *= info["option"]["discount"]
    d = n_steps * dt
    option_env = OptionExecutionWrapper(make_env(), n_rbf=1, d_min=d, d_max=d, discount_rate=discount_rate)
    option_env.reset()
    option = option_env.step(np.zeros(2))[4]["option"]
    assert option["n_steps"] == n_steps
    assert total == pytest.approx(option["integrated_reward"], rel=1e-9, abs=1e-9)
    assert discounts == pytest.approx(option["discount"])


def test_bad_wrapper_settings(scripted_env):
    with pytest.raises(ValueError, match=r"pass dt, in seconds, .* or to RewardRateWrapper"):
        RewardRateWrapper(scripted_env(dt=None))
    with pytest.raises(ValueError, match="dt must be a positive"):
        RewardRateWrapper(scripted_env(), dt=0.0)
    with pytest.raises(ValueError, match="discount_rate must be"):
        RewardRateWrapper(scripted_env(), discount_rate=-1.0)
    env = RewardRateWrapper(scripted_env(rewards=lambda step, action: math.nan))
    env.reset()
    with pytest.raises(ValueError, match="not finite: nan"):
        env.step(np.zeros(1))


def test_the_wrapper_can_be_rebuilt_from_its_spec():
    env = RewardRateWrapper(gym.make("Pendulum-v1"), discount_rate=0.1)
    again = gym.make(env.spec)
    assert again.option_space == env.option_space


# --- the schedule of updates


@pytest.mark.parametrize(
    ("updates_per_step", "expected"),
    [
        (20 * 0.02, (5, 2)),  # 20 updates a second at 50 Hz
        (20 * 0.01, (5, 1)),
        (20 * 0.004, (25, 2)),
        (20 * 0.002, (25, 1)),  # at 500 Hz
        (20 * 0.05, (1, 1)),
        (20 / 30, (3, 2)),
        (3.0, (1, 3)),
        (2.5, (2, 5)),
    ],
)
def test_update_schedule_by_hand(updates_per_step, expected):
    assert update_schedule(updates_per_step) == expected


@given(st.floats(1e-3, 50.0))
def test_update_schedule_keeps_the_rate(updates_per_step):
    train_freq, gradient_steps = update_schedule(updates_per_step)
    assert gradient_steps >= 1
    assert gradient_steps / train_freq == pytest.approx(updates_per_step, rel=1.001e-3)
    # and nothing smaller does
    for smaller in range(1, min(train_freq, 50)):
        assert abs(round(updates_per_step * smaller) / smaller / updates_per_step - 1) > 1e-3


# --- the algorithm


@pytest.mark.parametrize(("dt", "gamma"), [(0.05, 0.98), (0.1, 0.98**2), (0.002, 0.98**0.04)])
def test_the_same_clock_at_every_dt(scripted_env, dt, gamma):
    model = sac_at_rate(scripted_env(dt=dt), dt, learning_starts_seconds=3.0, **SMALL)
    assert model.gamma == pytest.approx(gamma)
    assert model.learning_starts == round(3.0 / dt)
    one = model.get_env().get_attr("option_space")[0]
    assert (one.dt, one.discount_rate) == (dt, pytest.approx(DEFAULT_DISCOUNT_RATE))
    assert model.gradient_steps / model.train_freq.frequency == pytest.approx(20 * dt, rel=1e-3)


def test_updates_are_counted_in_task_time(scripted_env):
    """20 a second over 6 s, of which the first 2 s are random."""
    for dt in (0.02, 0.01):
        model = sac_at_rate(scripted_env(dt=dt), dt, learning_starts_seconds=2.0, **SMALL).learn(round(6.0 / dt))
        assert model._n_updates == pytest.approx(80, abs=2)


def test_several_environments_bring_more_task_time(scripted_env):
    env = make_vec_env(lambda: scripted_env(dt=0.02), 2, wrapper_class=RewardRateWrapper)
    model = sac_at_rate(env, 0.02, learning_starts_seconds=2.0, **SMALL).learn(300)
    assert (model.train_freq.frequency, model.gradient_steps) == (5, 4)
    assert model._n_updates == pytest.approx(80, abs=4)


def test_returns_are_reported_as_they_are(scripted_env):
    env = scripted_env(dt=0.1, truncate_at=10)
    model = sac_at_rate(env, 0.1, learning_starts_seconds=100.0, **SMALL)
    callback = DiscountedReturnCallback(DEFAULT_DISCOUNT_RATE)
    model.learn(20, callback=callback)
    # Monitor stands inside, so that the wrapper's scale does not show.
    assert [info["r"] for info in model.ep_info_buffer] == [10.0, 10.0]
    # ∫₀¹ e^(−τt) dt
    expected = (1 - math.exp(-DEFAULT_DISCOUNT_RATE)) / DEFAULT_DISCOUNT_RATE
    assert [episode.discounted_return for episode in callback.episodes] == pytest.approx([expected] * 2)
    episodes = evaluate_discounted_return(model, RewardRateWrapper(scripted_env(dt=0.1, truncate_at=10)), 2)
    assert [episode.discounted_return for episode in episodes] == pytest.approx([expected] * 2)


def test_environments_that_are_wrapped_already(scripted_env):
    env = RewardRateWrapper(Monitor(scripted_env(dt=0.1)))
    assert sac_at_rate(env, 0.1, **SMALL).get_env().envs[0] is env
    with pytest.raises(ValueError, match=r"RewardRateWrapper has dt=0\.1, sac_at_rate has dt=0\.2"):
        sac_at_rate(env, 0.2, **SMALL)
    with pytest.raises(ValueError, match="RewardRateWrapper has discount_rate="):
        sac_at_rate(env, 0.1, gamma=0.9, **SMALL)
    with pytest.raises(ValueError, match="wrapper_class=RewardRateWrapper"):
        sac_at_rate(make_vec_env(scripted_env, 2), 0.1, **SMALL)


def test_a_callback_is_made_ready_once(scripted_env):
    class Counting(BaseCallback):
        n = 0

        def _init_callback(self):
            self.n += 1

        def _on_step(self):
            return True

    single, one_of_several = Counting(), Counting()
    for callback in (single, [one_of_several]):
        sac_at_rate(scripted_env(), 0.1, hold_seconds=0.2, **SMALL).learn(4, callback)
    assert (single.n, one_of_several.n) == (1, 1)


# --- fewer decisions, and other noise


def test_a_held_action_is_one_semi_markov_decision(scripted_env):
    """Three steps of 0.1 s a decision, which pay 0, 1, 2, …; γ = 0.9 over 0.1 s, the unit of rewards."""
    env = scripted_env(rewards=lambda step, action: float(step), dt=0.1, truncate_at=9)
    model = sac_at_rate(env, 0.1, gamma=0.9, gamma_dt=0.1, learning_starts_seconds=1e3, hold_seconds=0.3, **SMALL)
    callback = DiscountedReturnCallback()
    model.learn(30, callback)
    assert (model.num_timesteps, callback.timesteps) == (30, [9, 18, 27])
    assert [episode.decisions for episode in callback.episodes] == [3, 3, 3]
    assert model.action_space.shape == (1,)
    played = np.array(env.actions)  # of the episode that began last
    assert np.array_equal(played, np.repeat(played[:1], 3, axis=0))
    samples = model.replay_buffer._get_samples(np.array([0, 1, 2]))
    assert samples.rewards.ravel().tolist() == pytest.approx([0.9 + 0.81 * 2, 3 + 0.9 * 4 + 0.81 * 5, 6 + 0.9 * 7 + 0.81 * 8])
    assert samples.discounts.ravel().tolist() == pytest.approx([0.9**3] * 3)
    assert samples.dones.sum() == 0  # a time limit


def test_held_for_one_step_it_is_the_same_sac(random_walk_env):
    kwargs = {"learning_starts_seconds": 1e3, **SMALL}
    plain, held = (sac_at_rate(random_walk_env(), 0.1, hold_seconds=hold, **kwargs).learn(60) for hold in (None, 0.1))
    assert (plain.gamma, plain.learning_starts) == (held.gamma, held.learning_starts)
    rows = np.arange(60)
    buffers = (plain.replay_buffer, held.replay_buffer)
    for buffer in buffers:
        buffer._normalize_obs = lambda obs, env: obs
    one, other = (buffer._get_samples(rows) for buffer in buffers)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(other.discounts, plain.gamma, rtol=1e-6)


@pytest.mark.parametrize(("hold", "n_rbf"), [(0.1, 1), (0.5, 1), (0.5, 3)])
def test_holding_changes_no_clock(scripted_env, hold, n_rbf):
    """20 updates a second over 6 s, of which the first 2 s are random, in primitive steps."""
    model = sac_at_rate(scripted_env(dt=0.02), 0.02, learning_starts_seconds=2.0, hold_seconds=hold, n_rbf=n_rbf, **SMALL)
    model.learn(300)
    assert model.num_timesteps == 300
    assert model._n_updates == pytest.approx(80, abs=10)
    assert model.action_space.shape == (n_rbf,)
    steps = round(hold / 0.02)
    played = np.array(model.get_env().envs[0].unwrapped.actions[:steps]).ravel()
    assert len(set(played)) == (1 if n_rbf == 1 else steps)
    assert model.get_env().env_method("plan", np.ones(n_rbf))[0].ravel().tolist() == pytest.approx([1.0] * steps)


def test_a_held_sac_is_saved_and_evaluated(scripted_env, tmp_path):
    env = scripted_env(dt=0.1, truncate_at=10)
    model = sac_at_rate(env, 0.1, learning_starts_seconds=0.5, hold_seconds=0.5, **SMALL).learn(40, progress_bar=False)
    model.save(tmp_path / "model")
    loaded = FixedRateSAC.load(tmp_path / "model", env=model.get_env(), device="cpu")
    due = loaded._n_updates
    loaded.learn(40, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates - due) == (80, 80)  # 20 a second of 0.1 s steps
    episodes = evaluate_discounted_return(
        loaded, hold_actions(env, 0.5, 1, False, 0.1, DEFAULT_DISCOUNT_RATE), 2, smoothness=True
    )
    assert [episode.decisions for episode in episodes] == [2, 2]
    assert math.isfinite(episodes[0].mean_absolute_jerk)


@pytest.mark.parametrize("learned_duration", [False, True])
@pytest.mark.parametrize("hold_seconds", [0.1, 0.5])
def test_an_environment_to_evaluate_in_has_the_model_s_actions(scripted_env, hold_seconds, learned_duration):
    """Also where decisions take one step, so that a learned duration has nothing to say."""
    held = {"hold_seconds": hold_seconds, "learned_duration": learned_duration, "n_rbf": 2}
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, **held, **SMALL)
    assert model.wrap_env(scripted_env(dt=0.1)).action_space == model.action_space


def test_a_learned_duration_and_the_price_of_a_decision(scripted_env):
    """TaCoS: rewards of 1 a second, and each decision costs 0.05, whatever time it takes; updates follow the time."""
    kwargs = {"gamma": 0.9, "gamma_dt": 0.1, "learning_starts_seconds": 2.0, "hold_seconds": 0.5, **SMALL}
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, learned_duration=True, decision_price=0.05, **kwargs).learn(80)
    assert model.action_space.shape == (2,)
    buffer = model.replay_buffer
    n_steps = np.round(buffer.durations[: buffer.size(), 0] / 0.1)
    assert set(n_steps) == {1, 2, 3, 4, 5}
    samples = buffer._get_samples(np.arange(buffer.size()))
    tau = -math.log(0.9) / 0.1
    price = 0.05 / ((1 - 0.9) / tau)  # in the unit of a reward of 1 over gamma_dt
    assert samples.rewards.ravel().numpy() == pytest.approx((1 - 0.9**n_steps) / (1 - 0.9) - price, rel=1e-5)
    assert samples.discounts.ravel().numpy() == pytest.approx(0.9**n_steps, rel=1e-5)
    assert model._n_updates == pytest.approx(20 * 6, abs=10)
    # What is measured of an episode knows no price.
    assert buffer.integrated_rewards[: buffer.size(), 0] == pytest.approx((1 - 0.9**n_steps) / tau, rel=1e-5)


def test_learning_goes_on_at_the_same_rate_of_updates(scripted_env):
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, learning_starts_seconds=1.0, hold_seconds=0.2, **SMALL)
    assert model.learn(30)._n_updates == pytest.approx(20 * 2, abs=4)
    assert model.learn(30, reset_num_timesteps=False)._n_updates == pytest.approx(20 * 5, abs=4)
    assert model.learn(30)._n_updates == pytest.approx(20 * 7, abs=8)


@pytest.mark.parametrize("hold", [None, 0.3])
def test_the_quick_policy_is_the_same_sac(random_walk_env, hold):
    """The same actions from the same random numbers, in training and greedily, and so the same weights."""
    arguments = {**SMALL, "policy_kwargs": {"net_arch": {"pi": [8, 6], "qf": [16]}}, "learning_starts_seconds": 2.0}
    stock, quick = (
        sac_at_rate(random_walk_env(), 0.1, policy=policy, hold_seconds=hold, **arguments).learn(120)
        for policy in ("MlpPolicy", QuickSACPolicy)
    )
    assert stock._n_updates == quick._n_updates > 100
    for name, value in stock.policy.state_dict().items():
        np.testing.assert_allclose(quick.policy.state_dict()[name], value, rtol=1e-3, atol=1e-4, err_msg=name)
    n = min(stock.replay_buffer.pos, quick.replay_buffer.pos)
    np.testing.assert_allclose(stock.replay_buffer.actions[:n], quick.replay_buffer.actions[:n], atol=1e-4)
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    quick.policy.load_state_dict(stock.policy.state_dict())
    for one in (obs, obs[0]):
        actions = (model.predict(one, deterministic=True)[0] for model in (quick, stock))
        np.testing.assert_allclose(*actions, atol=1e-6)


def test_an_environment_of_another_clock_is_refused(scripted_env):
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, **SMALL)
    clock = model.option_space, model.reward_scale
    scale = model.get_env().get_attr("reward_scale")[0]
    with pytest.raises(ValueError, match=r"it has d_max=.*dt=0\.05 in place of 0\.1"):
        model.set_env(RewardRateWrapper(scripted_env(), dt=0.05, reward_scale=scale))
    with pytest.raises(ValueError, match=r"it has reward_scale=1\.0 in place of "):
        model.set_env(RewardRateWrapper(scripted_env(), dt=0.1))
    other_spaces = scripted_env(dt=0.1)
    other_spaces.observation_space = spaces.Box(-1, 1, (3,))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(other_spaces)
    assert (model.option_space, model.reward_scale) == clock
    model.set_env(RewardRateWrapper(scripted_env(), dt=0.1, reward_scale=scale))


@pytest.mark.parametrize("kwargs", [{}, {"hold_seconds": 0.3}, {"hold_seconds": 0.3, "n_rbf": 2}], ids=str)
def test_a_bare_environment_is_wrapped_as_the_models_was(scripted_env, tmp_path, kwargs):
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, **kwargs, **SMALL)
    model.save(tmp_path / "model")
    loaded = FixedRateSAC.load(tmp_path / "model", device="cpu")
    loaded.set_env(scripted_env(dt=0.1))
    for one in (loaded.get_env(), loaded.wrap_env(scripted_env(dt=0.1))):
        assert str(one.envs[0] if one is loaded.get_env() else one) == str(model.get_env().envs[0])
    loaded.learn(20)


def test_a_held_sac_whose_warm_up_somebody_else_played(random_walk_env):
    """20 updates a second of the 4 s in which somebody gave control back, after three episodes and a little."""
    n_seen = []

    def somebody(obs):
        n_seen.append(obs)
        return np.zeros(1, np.float32) if len(n_seen) < 70 else None

    env = TakeOverWrapper(random_walk_env(), somebody, lambda trajectory: None)
    model = sac_at_rate(env, 0.1, hold_seconds=0.3, learning_starts_seconds=1.0, **SMALL).learn(60)
    assert model.replay_buffer.size() == 0
    model.learn(40, reset_num_timesteps=False)
    assert 0 < model.replay_buffer.size() < 20
    assert 50 <= model._n_updates <= 80  # of 200 that all of the time would have


def test_the_quick_policy_knows_one_observation_from_several():
    class Env(gym.Env):
        observation_space, action_space = spaces.Box(-1, 1, (2, 3)), spaces.Box(-1, 1, (2,))

    model = SAC(QuickSACPolicy, Env(), buffer_size=10, **SMALL)
    assert model.predict(np.zeros((2, 3), np.float32))[0].shape == (2,)
    assert model.predict(np.zeros((4, 2, 3), np.float32))[0].shape == (4, 2)


def test_the_quick_policy_refuses_what_it_cannot_do(scripted_env):
    for kwargs in ({"use_sde": True}, {"policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.Tanh}}):
        with pytest.raises(ValueError, match=r"for vectors, ReLU and no gSDE, not for FlattenExtractor, .*: use SACPolicy"):
            sac_at_rate(scripted_env(), 0.1, policy=QuickSACPolicy, **{**SMALL, **kwargs})


def test_pink_noise_stays_on_one_side_for_longer(scripted_env):
    lasting = []
    for pink in (None, 10.0):
        model = sac_at_rate(scripted_env(dt=0.02), 0.02, pink_noise_seconds=pink, **SMALL)
        obs = np.zeros((1, 2), dtype=np.float32)
        actions = np.array([model.predict(obs, deterministic=False)[0] for _ in range(500)]).ravel()
        noise = actions - actions.mean()
        lasting.append(float((noise[1:] * noise[:-1]).mean() / noise.var()))
    assert lasting[0] < 0.2
    assert lasting[1] > 0.4


def test_pink_noise_says_what_it_needs(scripted_env, monkeypatch):
    monkeypatch.setitem(sys.modules, "pink", None)
    with pytest.raises(ImportError, match="pip install pink-noise-rl"):
        sac_at_rate(scripted_env(), 0.1, pink_noise_seconds=1.0, **SMALL)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"hold_seconds": 0.05}, ValueError, "hold_seconds must be None, or at least a step of 0.1 s, not 0.05"),
        ({"pink_noise_seconds": math.nan}, ValueError, "pink_noise_seconds must be None, or at least"),
        ({"n_rbf": 3}, ValueError, "n_rbf=3, .* are of decisions that take several steps: pass hold_seconds"),
        ({"dt": 0.0}, ValueError, "dt must be a positive"),
        ({"updates_per_second": 0.0}, ValueError, "updates_per_second must be positive"),
        ({"learning_starts_seconds": -1.0}, ValueError, "learning_starts_seconds must be at least 0"),
        ({"gamma": 2.0}, ValueError, "gamma must be in"),
        ({"gamma_dt": 0.0}, ValueError, "gamma_dt must be"),
        ({"train_freq": 1}, TypeError, "sets train_freq itself"),
        ({"gradient_steps": 1}, TypeError, "sets gradient_steps itself"),
        ({"learning_starts": 100}, TypeError, "sets learning_starts itself"),
    ],
)
def test_bad_settings(scripted_env, kwargs, error, message):
    with pytest.raises(error, match=message):
        sac_at_rate(**{"env": scripted_env(), "dt": 0.1, **kwargs})


def test_a_saved_model_is_a_plain_sac(scripted_env, tmp_path):
    model = sac_at_rate("Pendulum-v1", 0.05, learning_starts_seconds=1.0, updates_per_second=2.0, **SMALL).learn(60)
    model.save(tmp_path / "sac.zip")
    loaded = SAC.load(tmp_path / "sac.zip", RewardRateWrapper(gym.make("Pendulum-v1")))
    assert loaded.gamma == model.gamma
    obs = np.zeros((1, 3), dtype=np.float32)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    loaded.learn(20, reset_num_timesteps=False)


@pytest.mark.parametrize("documented", [module, reward_rate])
def test_docstring_examples(documented):
    result = doctest.testmod(documented)
    assert result.attempted > 0
    assert result.failed == 0


def test_the_quick_policy_refuses_pictures_and_numbers_of_states(random_walk_env):
    """Whose observations Stable-Baselines3 scales or encodes, which it does not."""

    class States(random_walk_env):
        def __init__(self):
            super().__init__()
            self.observation_space = gym.spaces.Discrete(4)

        def _obs(self):
            return np.int64(self.count % 4)

    for env in (random_walk_env("image"), States()):
        with pytest.raises(ValueError, match=r"for vectors, .*: use SACPolicy"):
            sac_at_rate(env, 0.1, policy=QuickSACPolicy, **SMALL)


def test_what_holding_actions_does_with_the_replay_buffers_arguments(scripted_env, random_walk_env):
    kwargs = {"handle_timeout_termination": False}
    model = sac_at_rate(scripted_env(), 0.1, hold_seconds=0.2, replay_buffer_kwargs=kwargs, **SMALL)
    assert not model.replay_buffer.handle_timeout_termination
    with pytest.raises(TypeError, match="sets replay_buffer_class itself, not to ReplayBuffer"):
        sac_at_rate(scripted_env(), 0.1, hold_seconds=0.2, replay_buffer_class=ReplayBuffer, **SMALL)
    with pytest.raises(ValueError, match=r"in one array, not in Dict.*FlattenObservation"):
        sac_at_rate(random_walk_env("dict"), 0.1, policy="MultiInputPolicy", hold_seconds=0.2, **SMALL)


# --- decisions of several steps among Stable-Baselines3's callbacks, files and predictions


def test_a_held_sac_is_evaluated_in_its_own_time(scripted_env):
    """A bare environment of an EvalCallback is wrapped, and a held action sent to a bare one is an error."""
    held = {"hold_seconds": 0.5, "learning_starts_seconds": 100.0}
    model = sac_at_rate(scripted_env(dt=0.1, truncate_at=20), 0.1, **held, **SMALL)
    bare, played = scripted_env(dt=0.1, truncate_at=20), []
    step = bare.step
    bare.step = lambda action: played.append(float(action[0])) or step(action)
    model.learn(20, EvalCallback(Monitor(bare), n_eval_episodes=1, eval_freq=20, verbose=0))
    assert len(played) == 20
    assert played == [action for action in played[::5] for _ in range(5)]
    model = sac_at_rate("Pendulum-v1", 0.05, hold_seconds=0.2, **SMALL)
    with pytest.raises(TypeError, match="bare environment"):
        evaluate_policy(model, Monitor(gym.make("Pendulum-v1")), 1)
    other = hold_actions(gym.make("Pendulum-v1"), 0.5, 1, False, 0.05, DEFAULT_DISCOUNT_RATE)
    with pytest.raises(ValueError, match=r"d_max=0\.5 in place of 0\.2"):
        model.learn(20, EvalCallback(other, verbose=0))


@pytest.mark.parametrize("held", [{}, {"hold_seconds": 0.5}, {"hold_seconds": 0.5, "learned_duration": True}])
def test_a_bare_environment_is_wrapped_while_loading(scripted_env, tmp_path, held):
    model = sac_at_rate(scripted_env(dt=0.1), 0.1, learning_starts_seconds=100.0, **held, **SMALL).learn(20)
    model.save(tmp_path / "model")
    loaded = FixedRateSAC.load(tmp_path / "model", env=scripted_env(dt=0.1), device="cpu")
    assert loaded.get_env().get_attr("option_space") == model.get_env().get_attr("option_space")
    assert 40 <= loaded.learn(20, reset_num_timesteps=False).num_timesteps < 50
    with pytest.raises(ValueError, match=r"'gamma': 0\.5.* cannot be changed while loading"):
        FixedRateSAC.load(tmp_path / "model", gamma=0.5)


def test_what_the_clock_says_of_the_buffer_is_not_given_twice(scripted_env):
    with pytest.raises(TypeError, match=r"sets the replay buffer's reward_scale itself, not to 0\.1"):
        sac_at_rate(scripted_env(), 0.1, hold_seconds=0.5, replay_buffer_kwargs={"reward_scale": 0.1})


def test_quick_decisions_are_those_of_white_noise_and_of_right_observations(scripted_env):
    quick = {"policy": QuickSACPolicy, **SMALL}
    with pytest.raises(ValueError, match="QuickSACPolicy draws white noise"):
        sac_at_rate(scripted_env(), 0.1, pink_noise_seconds=1.0, **quick)
    model = sac_at_rate(scripted_env(), 0.1, **quick)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="tuple"):
        model.predict((np.zeros(2, np.float32), {}))


def test_progress_ends_at_zero_also_where_the_last_decision_ends_later(scripted_env):
    seen = []
    model = sac_at_rate(
        scripted_env(dt=0.1),
        0.1,
        learning_starts_seconds=0.5,
        hold_seconds=0.5,
        learning_rate=lambda remaining: seen.append(remaining) or 1e-3,
        **SMALL,
    )
    assert model.learn(22).num_timesteps == 25
    assert min(seen) == 0.0


def test_rewards_are_integrated_once(scripted_env):
    """Options around a wrapper that integrates each step's reward would do it once more."""
    env = RewardRateWrapper(scripted_env(truncate_at=20), dt=0.1)
    for make in (lambda: sac_at_rate(env, dt=0.1, hold_seconds=0.2), lambda: CTCO("MlpPolicy", env)):
        with pytest.raises(ValueError, match="RewardRateWrapper, which integrates rewards over a step"):
            make()
    OptionExecutionWrapper(env, reward_unit="impulse")


@pytest.mark.parametrize("other", [{"reward_scale": 7.0}, {"dt": 0.2}])
def test_each_environment_of_several_has_the_same_clock_and_unit(scripted_env, other):
    settings = [{"dt": 0.1, "reward_scale": 1.0}, {"dt": 0.1, "reward_scale": 1.0, **other}]
    make = [lambda kwargs=kwargs: RewardRateWrapper(scripted_env(dt=kwargs["dt"]), **kwargs) for kwargs in settings]
    with pytest.raises(ValueError, match="another one than the first one of the VecEnv"):
        FixedRateSAC("MlpPolicy", DummyVecEnv(make), **SMALL)
    model = FixedRateSAC("MlpPolicy", DummyVecEnv(make[:1] * 2), **SMALL)
    with pytest.raises(ValueError, match="another one than that which this model learned in"):
        model.set_env(DummyVecEnv(make))


@pytest.mark.parametrize("shape", [(3,), (1, 3), (2, 2)])
def test_the_quick_policy_acts_in_the_shape_of_the_actions(scripted_env, shape):
    model = sac_at_rate(scripted_env(action_space=spaces.Box(-1.0, 1.0, shape)), dt=0.1, policy=QuickSACPolicy, **SMALL)
    slow = MlpPolicy(model.observation_space, model.action_space, lambda _: 1e-3, net_arch=[8])
    slow.load_state_dict(model.policy.state_dict())
    for obs in (np.ones(2, np.float32), np.ones((5, 2), np.float32)):
        expected, _ = slow.predict(obs, deterministic=True)
        action, _ = model.predict(obs, deterministic=True)
        assert action.shape == expected.shape
        np.testing.assert_allclose(action, expected, atol=1e-6)
