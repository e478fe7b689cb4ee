"""Evaluation: one yardstick for option policies and for models of fixed rate."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_ctco import CTCO, OptionExecutionWrapper, RewardRateWrapper
from sb3_ctco.evaluation import (
    DiscountedReturnCallback,
    evaluate_discounted_return,
    mean_absolute_jerk,
    spectral_smoothness,
)

TAU = 0.5
DT = 0.1


class CountingEnv(gym.Env):
    """Rewards 1, 2, 3, … a second, episodes of ten steps of 0.1 s."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(np.array([0.0], np.float32), np.array([4.0], np.float32))
    dt = DT

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        return np.zeros(1, np.float32), float(self.n_steps), False, self.n_steps == 10, {}


class Scripted:
    """A model whose actions are given, in turn."""

    def __init__(self, *actions):
        self.actions = [np.asarray(action, np.float32) for action in actions]
        self.calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action = self.actions[self.calls % len(self.actions)]
        self.calls += 1
        return np.tile(action, (len(observation), 1)), None


def test_returns_of_both_kinds_are_the_integral_by_hand():
    # ∫ e^(−τt) r dt of the rate k in the k-th tenth of a second
    weight = (1 - math.exp(-TAU * DT)) / TAU
    expected = sum(k * math.exp(-TAU * DT * (k - 1)) * weight for k in range(1, 11))
    (plain,) = evaluate_discounted_return(Scripted([1.0]), CountingEnv(), 1, discount_rate=TAU, dt=DT)
    options = OptionExecutionWrapper(CountingEnv(), n_rbf=1, d_max=0.3, discount_rate=TAU)
    (by_options,) = evaluate_discounted_return(Scripted([0.0, 1.0]), options, 1, discount_rate=TAU)
    for episode in (plain, by_options):
        assert episode.discounted_return == pytest.approx(expected)
        assert episode.episode_return == 55.0
        assert episode.seconds == pytest.approx(1.0)
        assert math.isnan(episode.mean_absolute_jerk)
    # Three options of three steps and one cut off after one
    assert (plain.decisions, by_options.decisions) == (10, 4)
    assert by_options.decision_rate_hz == pytest.approx(4.0)


def test_impulses_count_alike_by_steps_and_by_options():
    expected = sum(k * math.exp(-TAU * DT * (k - 1)) for k in range(1, 11))
    kwargs = {"discount_rate": TAU, "reward_unit": "impulse"}
    (plain,) = evaluate_discounted_return(Scripted([1.0]), CountingEnv(), 1, dt=DT, **kwargs)
    options = OptionExecutionWrapper(CountingEnv(), n_rbf=1, d_max=0.3, **kwargs)
    (by_options,) = evaluate_discounted_return(Scripted([0.0, 1.0]), options, 1)
    assert plain.discounted_return == pytest.approx(expected)
    assert by_options.discounted_return == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"the unit of rewards must be one of .*, not 'impulses'"):
        evaluate_discounted_return(Scripted([1.0]), CountingEnv(), 1, dt=DT, reward_unit="impulses")


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_scale_of_rewards_that_is_none(scale):
    with pytest.raises(ValueError, match="reward_scale must be positive and finite"):
        RewardRateWrapper(CountingEnv(), reward_scale=scale)


def test_rewards_count_as_they_were_paid():
    env = VecNormalize(DummyVecEnv([CountingEnv]), norm_reward=True)
    (normalised,) = evaluate_discounted_return(Scripted([1.0]), env, 1, discount_rate=TAU, dt=DT)
    (plain,) = evaluate_discounted_return(Scripted([1.0]), CountingEnv(), 1, discount_rate=TAU, dt=DT)
    assert normalised.discounted_return == pytest.approx(plain.discounted_return)
    callback = DiscountedReturnCallback(discount_rate=TAU, dt=DT)
    SAC("MlpPolicy", env, buffer_size=100, learning_starts=1000).learn(10, callback)
    assert callback.episodes[0].discounted_return == pytest.approx(plain.discounted_return)


def test_the_rate_of_discounting_is_the_environments():
    options = OptionExecutionWrapper(CountingEnv(), n_rbf=1, d_max=0.3, discount_rate=TAU)
    (given,) = evaluate_discounted_return(Scripted([0.0, 1.0]), options, 1, discount_rate=TAU)
    (found,) = evaluate_discounted_return(Scripted([0.0, 1.0]), options, 1)
    assert found == given
    # Within options the environment has discounted already, so another rate between them would be neither.
    with pytest.raises(ValueError, match=r"discount_rate=\[0.5\], within them, so not at 0.4 between them"):
        evaluate_discounted_return(Scripted([0.0, 1.0]), options, 1, discount_rate=0.4)
    fixed = RewardRateWrapper(CountingEnv(), discount_rate=TAU)
    (by_steps,) = evaluate_discounted_return(Scripted([0.0]), fixed, 1)
    assert by_steps.discounted_return == pytest.approx(given.discounted_return)
    mixed = DummyVecEnv(
        [lambda rate=rate: OptionExecutionWrapper(CountingEnv(), n_rbf=1, discount_rate=rate) for rate in (0.5, 0.6)]
    )
    with pytest.raises(ValueError, match=r"discount_rate=\[0.5, 0.6\]"):
        evaluate_discounted_return(Scripted([0.0, 1.0]), mixed, 1)


def test_the_callback_discounts_as_the_environment_does():
    kwargs = {"gamma": 0.9, "learning_starts": 1000, "d_max": 0.3, "n_sub_options": 0, "buffer_size": 100}
    callback = DiscountedReturnCallback()
    model = CTCO("MlpPolicy", CountingEnv(), **kwargs).learn(10, callback)
    tau = -math.log(0.9) / 0.05
    weight = (1 - math.exp(-tau * DT)) / tau
    expected = sum(k * math.exp(-tau * DT * (k - 1)) * weight for k in range(1, 11))
    assert callback.episodes[0].discounted_return == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"not at 0\.5 between them"):
        model.learn(10, DiscountedReturnCallback(discount_rate=0.5))


def test_an_entry_of_an_action_that_has_one_value_only_is_smooth():
    class Env(CountingEnv):
        action_space = spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([1.0, 2.0], np.float32))

    model = Scripted([1.0, 2.0], [-1.0, 2.0])
    (episode,) = evaluate_discounted_return(model, Env(), 1, dt=DT, smoothness=True)
    # Third differences of 1, −1, 1, … are 8 or −8, and 0 in the other entry.
    assert episode.mean_absolute_jerk == pytest.approx(4 / DT**3)


def test_jerk_by_hand():
    # a = t³ has the third derivative 6, and finite differences of a cubic are exact.
    t = np.arange(20)[:, None] * 0.1
    assert mean_absolute_jerk(t**3, 0.1) == pytest.approx(6.0)
    assert mean_absolute_jerk(np.hstack([t**3, -2 * t**3]), 0.1) == pytest.approx(9.0)
    assert mean_absolute_jerk(3 * t**2 - t, 0.1) == pytest.approx(0.0, abs=1e-9)
    # +1, −1, …: each third difference is 8 in size.
    assert mean_absolute_jerk([[1], [-1], [1], [-1], [1]], 0.5) == pytest.approx(8 / 0.5**3)
    assert math.isnan(mean_absolute_jerk([[1], [2], [3]], 0.1))


@pytest.mark.parametrize("cycles", [1, 7, 31])
@pytest.mark.parametrize("amplitude", [1.0, 0.25])
def test_spectral_smoothness_of_a_sinusoid_by_hand(cycles, amplitude):
    # One component: M = amplitude, f/f_s = cycles/100, n = 50.
    signal = amplitude * np.sin(2 * np.pi * cycles * np.arange(100) / 100 + 0.3)[:, None] + 0.5
    assert spectral_smoothness(signal) == pytest.approx(2 / 50 * amplitude * cycles / 100)


def test_spectral_smoothness_at_half_the_sampling_frequency():
    signal = np.tile([1.0, -1.0], 10)[:, None]
    assert spectral_smoothness(signal) == pytest.approx(2 / 10 * 1.0 * 0.5)
    assert spectral_smoothness(np.ones((20, 3))) == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(spectral_smoothness([[1.0]]))


def test_smoothness_is_of_normalised_primitive_actions():
    # The box is 0..4: one model plays 0, 4, 0, 4, …, the other options of one step that ask for the same.
    plain = Scripted([0.0], [4.0])
    by_options = Scripted([-1.0, -1.0], [1.0, -1.0])
    wrapped = OptionExecutionWrapper(CountingEnv(), n_rbf=1, d_max=0.3)
    (a,) = evaluate_discounted_return(plain, CountingEnv(), 1, dt=DT, smoothness=True)
    (b,) = evaluate_discounted_return(by_options, wrapped, 1, smoothness=True)
    for episode in (a, b):
        assert episode.mean_absolute_jerk == pytest.approx(8 / DT**3)
        assert episode.spectral_smoothness == pytest.approx(2 / 5 * 0.5)


def test_an_option_that_is_cut_off_counts_as_far_as_it_ran():
    # Each option rises over three steps; the fourth of an episode runs one step, and the next episode starts anew.
    wrapped = OptionExecutionWrapper(CountingEnv(), n_rbf=2, d_max=0.3)
    option = np.array([-1.0, 1.0, 1.0])
    episodes = evaluate_discounted_return(Scripted(option), wrapped, 2, smoothness=True)
    ramp = wrapped.plan(option) / 2.0 - 1.0
    played = np.concatenate([ramp, ramp, ramp, ramp[:1]])
    for episode in episodes:
        assert episode.mean_absolute_jerk == pytest.approx(mean_absolute_jerk(played, DT))
        assert episode.spectral_smoothness == pytest.approx(spectral_smoothness(played))


def test_several_environments():
    env = DummyVecEnv([lambda: OptionExecutionWrapper(CountingEnv(), n_rbf=1, d_max=0.3)] * 2)
    episodes = evaluate_discounted_return(Scripted([0.5, 0.0]), env, 4, smoothness=True)
    assert len(episodes) == 4
    assert all(episode.spectral_smoothness == pytest.approx(0.0, abs=1e-12) for episode in episodes)


def test_unbounded_actions_have_no_smoothness():
    env = gym.make("CartPole-v1")
    with pytest.raises(ValueError, match="Box with finite bounds, not in Discrete"):
        evaluate_discounted_return(Scripted([0]), env, 1, dt=0.02, smoothness=True)


def test_plain_steps_need_dt():
    with pytest.raises(ValueError, match="pass dt"):
        evaluate_discounted_return(Scripted([0.0]), CountingEnv(), 1)


@pytest.mark.parametrize(("algorithm", "dt"), [(SAC, 0.05), (CTCO, None)])
def test_callback_records_each_episode_of_either(algorithm, dt):
    callback = DiscountedReturnCallback(dt=dt)
    algorithm("MlpPolicy", "Pendulum-v1", learning_starts=1000).learn(650, callback)
    assert len(callback.episodes) == 3
    assert callback.timesteps == [200, 400, 600]
    for episode in callback.episodes:
        assert episode.seconds == pytest.approx(10.0)
        assert episode.discounted_return < 0


def test_tensorboard_has_a_histogram_of_durations(tmp_path):
    model = CTCO("MlpPolicy", "Pendulum-v1", learning_starts=1000, d_max=0.4, tensorboard_log=str(tmp_path))
    model.learn(450, log_interval=1)
    events = EventAccumulator(str(tmp_path / "CTCO_1"), size_guidance={"histograms": 0})
    events.Reload()
    histograms = events.Histograms("option/duration")
    assert len(histograms) == 2
    for event in histograms:
        histogram = event.histogram_value
        # An episode of 10 s in options of 0.05 s to 0.4 s
        assert histogram.sum == pytest.approx(10.0)
        assert 0.05 - 1e-6 <= histogram.min < histogram.max <= 0.4 + 1e-6
    assert "option/duration_mean" in events.Tags()["scalars"]


def test_a_policy_with_a_memory_gets_it_back(scripted_env):
    """Such as DAC-PPO, whose state is the current option."""

    class Counter(Scripted):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            state = (np.where(episode_start, 0, 0 if state is None else state[0]) + 1,)
            seen.append(int(state[0][0]))
            return super().predict(observation)[0], state

    seen: list[int] = []
    evaluate_discounted_return(Counter([0.0]), scripted_env(truncate_at=3), 2, dt=0.1)
    assert seen == [1, 2, 3, 1, 2, 3]


class ShortOrLong(CountingEnv):
    """Pays 1 a step; its first episode has ``first`` steps, all others one."""

    def __init__(self, first):
        self.lengths = iter([first, *[1] * 100])

    def reset(self, *, seed=None, options=None):
        self.length = next(self.lengths)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        obs, *_ = super().step(action)
        return obs, 1.0, False, self.n_steps == self.length, {}


def test_each_environment_plays_its_share_of_the_episodes():
    """The first four to end are those of the quick environments, of one step each."""
    envs = DummyVecEnv([lambda first=first: ShortOrLong(first) for first in (9, 1, 1)])
    episodes = evaluate_discounted_return(Scripted([1.0]), envs, 4, discount_rate=TAU, dt=DT)
    # (4 + i) // 3 of the i-th, as Stable-Baselines3 shares them
    assert sorted(episode.episode_return for episode in episodes) == [1.0, 1.0, 1.0, 9.0]


def test_the_smoothness_of_rewards_as_rates():
    env = RewardRateWrapper(CountingEnv(), discount_rate=TAU)
    (episode,) = evaluate_discounted_return(Scripted([0.0], [4.0]), env, 1, smoothness=True)
    assert episode.largest_jump == 2.0  # through the whole of [−1, 1]


@pytest.mark.parametrize("algorithm", ["ctco", "sac"])
def test_an_episode_that_a_training_was_stopped_in_is_recorded_whole_or_not_at_all(algorithm):
    """Episodes of ten steps; a training of 15, then one that goes on in the middle of the second episode."""

    def make_model():
        kwargs = {"learning_starts": 1000, "buffer_size": 100}
        if algorithm == "sac":
            return SAC("MlpPolicy", RewardRateWrapper(Monitor(CountingEnv())), **kwargs)
        return CTCO("MlpPolicy", CountingEnv(), d_min=0.1, d_max=0.1, n_sub_options=0, **kwargs)

    whole = DiscountedReturnCallback()
    make_model().learn(40, whole)
    assert len(whole.episodes) == 4
    # The same callback sees both parts of the second episode.
    callback = DiscountedReturnCallback()
    model = make_model().learn(15, callback)
    model.learn(25, callback, reset_num_timesteps=False)
    assert [vars(one) for one in callback.episodes] == [pytest.approx(vars(one), nan_ok=True) for one in whole.episodes]
    # Another one sees the end of it alone, which is no episode.
    model = make_model().learn(15)
    other = DiscountedReturnCallback()
    model.learn(25, other, reset_num_timesteps=False)
    assert [vars(one) for one in other.episodes] == [pytest.approx(vars(one), nan_ok=True) for one in whole.episodes[2:]]
    # And one that saw the beginning of an episode that was broken off.
    model = make_model().learn(15, callback := DiscountedReturnCallback())
    model._last_obs = None  # as after an error: the next training begins with a reset
    model.learn(25, callback, reset_num_timesteps=False)
    assert [episode.seconds for episode in callback.episodes] == pytest.approx([1.0, 1.0])


def test_less_than_no_episodes_are_refused(scripted_env):
    with pytest.raises(ValueError, match="n_eval_episodes must be at least 0, not -1"):
        evaluate_discounted_return(None, scripted_env(), n_eval_episodes=-1, dt=0.1)
