"""The real-time wrapper, by a clock that the test turns."""

import logging
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
from conftest import FakeClock
from gymnasium import spaces

from sb3_ctco.options import integrated_reward
from sb3_ctco.wrappers import OptionExecutionWrapper, RealTimeOptionWrapper, RealTimeWrapper


class Simulation(gym.Env):
    """Each step takes the seconds that the script says; observations are the time."""

    def __init__(self, clock, script=()):
        self.clock = clock
        self.script = list(script)
        self.commands = []
        self.dt = 0.25
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self.clock.now()]), {"scripted": True}

    def step(self, action):
        self.commands.append(self.clock.now())
        self.clock.time += self.script.pop(0) if self.script else 0.0
        return np.array([self.clock.now()]), 1.0, False, False, {"scripted": True}


class Robot(Simulation):
    """A machine that is read after the period."""

    def step(self, action):
        raise AssertionError("a machine is commanded by send and read by receive")

    def send(self, action):
        self.commands.append(self.clock.now())

    def receive(self):
        return np.array([self.clock.now()]), 1.0, False, False, {}


def test_commands_keep_the_period_whatever_a_step_takes():
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock, [0.0, 0.125, 0.25, 0.0]), clock=clock)
    env.reset()
    clock.time += 5.0  # whatever happens before the first command is nobody's delay
    for _ in range(4):
        env.step(np.zeros(1))
    assert env.env.commands == [105.0, 105.25, 105.5, 105.75]
    assert clock.slept == [0.25, 0.125, 0.25]
    assert (env.statistics.ticks, env.statistics.late_ticks, env.statistics.worst_lateness) == (3, 0, 0.0)


def test_late_tick_is_counted_and_the_next_ones_keep_their_times():
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock), clock=clock)
    env.reset()
    env.step(np.zeros(1))
    clock.time += 0.125  # a slow decision
    _, _, _, _, info = env.step(np.zeros(1))
    assert info == {"scripted": True, "real_time": {"lateness": 0.125}}
    _, _, _, _, info = env.step(np.zeros(1))
    assert info["real_time"]["lateness"] == 0.0
    assert env.env.commands == [100.0, 100.375, 100.5]
    s = env.statistics
    assert (s.ticks, s.late_ticks, s.worst_lateness, s.total_lateness) == (2, 1, 0.125, 0.125)


def test_lost_periods_are_not_made_up_for():
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock, [1.0, 0.0, 0.0]), clock=clock)
    env.reset()
    for _ in range(3):
        env.step(np.zeros(1))
    # The second command was due at 100.25 and comes at 101; the third a full period later.
    assert env.env.commands == [100.0, 101.0, 101.25]
    assert (env.statistics.late_ticks, env.statistics.worst_lateness) == (1, 0.75)


@pytest.mark.parametrize("jump", [-3600.0, -0.125, 3600.0])
@pytest.mark.parametrize("robot", [False, True])
def test_a_clock_that_jumps_costs_a_period_at_most(jump, robot):
    """Commands stay a period apart by time that passes, and nobody waits for an hour."""
    clock = FakeClock()
    env = RealTimeWrapper((Robot if robot else Simulation)(clock), clock=clock)
    env.reset()
    for k in range(6):
        if k == 3:
            clock.time += jump
        env.step(np.zeros(1))
    assert all(0 < seconds <= 0.25 for seconds in clock.slept)
    gaps = np.diff(env.unwrapped.commands)
    np.testing.assert_allclose(gaps, [0.25, 0.25, 0.25 + jump, 0.25, 0.25])
    assert sum(clock.slept) == pytest.approx(6 * 0.25)
    assert env.statistics.late_ticks == (1 if jump > 0 else 0)


def test_a_clock_that_is_set_back_while_waiting():
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock, [0.0, -3600.0, 0.0, 0.0]), clock=clock)
    env.reset()
    for _ in range(4):
        env.step(np.zeros(1))
    assert clock.slept == [0.25] * 4


def test_tolerance():
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock), clock=clock, tolerance=0.0625)
    env.reset()
    for delay in (0.0, 0.0625, 0.125):
        clock.time += delay
        env.step(np.zeros(1))
    assert (env.statistics.ticks, env.statistics.late_ticks) == (2, 1)


def test_machine_is_read_at_the_end_of_the_period():
    clock = FakeClock()
    env = RealTimeWrapper(Robot(clock), clock=clock)
    env.reset()
    obs = [float(env.step(np.zeros(1))[0][0]) for _ in range(3)]
    assert env.env.commands == [100.0, 100.25, 100.5]
    assert obs == [100.25, 100.5, 100.75]


def test_statistics_of_an_episode_and_of_all(caplog):
    clock = FakeClock()
    env = RealTimeWrapper(Simulation(clock), clock=clock)
    with caplog.at_level(logging.WARNING, logger="sb3_ctco.wrappers.real_time"):
        for delay in (0.125, 0.0, 0.0625):
            env.reset()
            env.step(np.zeros(1))
            clock.time += delay
            env.step(np.zeros(1))
        assert env.statistics.late_ticks == 1
        assert env.total_statistics.late_ticks == 2
        assert env.total_statistics.ticks == 3
        env.close()
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert messages[0].startswith("1 of 1 ticks were late by more than 1.0 ms: by 125.0 ms on average")
    assert "62.5 ms at worst (period 250.0 ms)" in messages[1]


def test_under_options_every_primitive_step_is_timed():
    clock = FakeClock()
    env = OptionExecutionWrapper(RealTimeWrapper(Simulation(clock), clock=clock), n_rbf=1, d_max=1.0)
    env.reset()
    env.step(np.ones(2))
    assert env.unwrapped.commands == [100.0, 100.25, 100.5, 100.75]
    assert clock.now() == 101.0


def test_wall_clock():
    simulation = Simulation(FakeClock())
    env = RealTimeWrapper(simulation, dt=0.01)
    env.reset()
    start = time.monotonic()
    for _ in range(20):
        env.step(np.zeros(1))
    assert time.monotonic() - start >= 0.2


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"dt": 0.0}, "positive number of seconds, not 0.0"), ({"tolerance": -1.0}, "at least 0, not -1.0")],
)
def test_errors(kwargs, message):
    with pytest.raises(ValueError, match=message):
        RealTimeWrapper(Simulation(FakeClock()), **kwargs)


def test_an_environment_without_a_period_is_refused():
    env = Simulation(FakeClock())
    del env.dt
    with pytest.raises(ValueError, match=r"pass dt, in seconds, .* or to RealTimeWrapper"):
        RealTimeWrapper(env)


TAU = 0.7


def played_in_real_time(env, n_options, rng):
    """Random options, some of them broken off, with what the environment did from one decision to the next."""
    env.reset(seed=0)
    first = 0
    for _ in range(n_options):
        option = rng.uniform(-1.0, 1.0, 4).astype(np.float32)
        *_, terminated, truncated, info = env.step(option)
        last = first + info["option"]["n_steps"]
        yield option, first, last, terminated, truncated, info
        first = last
        if terminated or truncated:
            env.reset()
            first = 0


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("ahead", [0, 2])
@pytest.mark.parametrize("breaks_off", [False, True])
def test_sub_options_in_real_time(scripted_env, ahead, breaks_off, background):
    """Each one is what it would have been to decide on it: on its observation, ``ahead`` steps before it plays."""
    interrupt = (lambda decided_on, obs, seconds: obs[0] % 11 == 0) if breaks_off else None
    inner = scripted_env(rewards=lambda step, action: np.sin(step), truncate_at=40)
    env = RealTimeOptionWrapper(
        inner,
        ahead * 0.1,
        interrupt,
        background,
        n_rbf=3,
        d_max=1.5,
        discount_rate=TAU,
        n_sub_options=8,
        sub_option_tolerance=2.0,
    )
    count = at_end = 0
    for option, first, last, _, truncated, info in played_in_real_time(env, 250, np.random.default_rng(0)):
        sub = info["sub_options"]
        plan = env.option_space.plan(option.astype(np.float64))
        for i in range(len(sub)):
            begin, end = int(sub.observations[i][0]), int(sub.next_observations[i][0])
            assert first <= begin < end <= last
            rewards = np.sin(np.arange(begin, end))
            assert sub.durations[i] == pytest.approx((end - begin) * 0.1)
            assert sub.integrated_rewards[i] == pytest.approx(integrated_reward(rewards, 0.1, TAU), abs=1e-9)
            assert sub.truncated[i] == (truncated and end == last)
            fitted = env.option_space.plan(sub.options[i].astype(np.float64))
            assert np.abs(fitted - plan[begin - first : end - first]).max() == pytest.approx(sub.residuals[i], abs=1e-6)
            count += 1
            at_end += bool(sub.truncated[i])
    env.close()
    assert count > 200
    assert at_end > 5


def test_what_a_sub_option_stands_for_was_played_so_much_later(scripted_env):
    """An option of steps 0, 1, 2, …: decided on at step k, it plays what was sent at k + ahead."""
    env = RealTimeOptionWrapper(scripted_env(), 0.2, n_rbf=1, d_max=1.0, n_sub_options=20)
    env.reset(seed=0)
    env.step([0.1, 1.0])  # begins at once, and leaves two steps to play
    assert env.unwrapped.count == 8
    *_, info = env.step([0.5, 1.0])
    sent = np.ravel(env.unwrapped.actions)
    np.testing.assert_allclose(sent[8:18], [0.1] * 2 + [0.5] * 8, rtol=1e-6)
    assert len(info["sub_options"]) > 5
    np.testing.assert_allclose(info["sub_options"].options[:, 0], 0.5, rtol=1e-6)
    for begin, end in zip(info["sub_options"].observations[:, 0], info["sub_options"].next_observations[:, 0], strict=True):
        played = sent[int(begin) + 2 : int(end) + 2]
        np.testing.assert_allclose(played, 0.5, rtol=1e-6)  # as far as it was played until now


@pytest.mark.parametrize("join", ["continuous", "smooth"])
@pytest.mark.parametrize("ahead", [0, 3])
def test_sub_options_leave_from_the_action_before_them(scripted_env, ahead, join):
    """The one that is being sent when they begin to play, ``ahead`` steps after their observation."""
    env = RealTimeOptionWrapper(
        scripted_env(),
        ahead * 0.1,
        n_rbf=2,
        d_max=1.0,
        trajectory="bezier",
        duration_scale="linear",
        n_sub_options=8,
        sub_option_tolerance=2.0,
        join=join,
    )
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    found = []
    for k in range(30):
        sub = env.step(rng.uniform(-1.0, 1.0, 3))[-1]["sub_options"]
        # The first option begins at once, and tells nothing of those that are decided on ahead.
        assert k > 0 or not ahead or not len(sub)
        found += zip(sub.observations, sub.next_observations, sub.options.astype(np.float64), sub.residuals, strict=True)
    env.step([0.0, 0.0, -1.0])  # sends the rest
    sent = np.concatenate([[0.0, 0.0], np.ravel(env.unwrapped.actions)])
    before = env.option_space.before(sent[:, None])
    assert len(found) > 50
    for one, after, option, residual in found:
        first, end = int(one[0]) + ahead, int(after[0]) + ahead
        np.testing.assert_allclose(one[2:], before[first], atol=1e-6)
        np.testing.assert_allclose(after[2:], before[end], atol=1e-6)
        again = env.option_space.plan(option, one[2:].astype(np.float64))[:, 0]
        assert np.abs(again - sent[first + 2 : end + 2]).max() == pytest.approx(residual, abs=2e-6)
        assert residual < {"continuous": 1e-5, "smooth": 0.2}[join]


def test_a_reset_waits_for_a_step_that_was_given_up():
    """Or the rest of the old option would be played beside the new episode."""
    log, hangs, goes_on = [], threading.Event(), threading.Event()

    class Machine(Simulation):
        def reset(self, *, seed=None, options=None):
            log.append("reset")
            return super().reset(seed=seed)

        def step(self, action):
            log.append(round(float(action[0]), 2))
            if len(log) == 9:  # the second step of the rest
                hangs.set()
                goes_on.wait(30.0)
            return super().step(action)

    env = RealTimeOptionWrapper(Machine(FakeClock()), decide_ahead=1.0, background=True, n_rbf=1, d_max=2.5)
    env.reset()
    env.step([0.7, 1.0])
    assert hangs.wait(30.0)
    assert not env.abandon(0.05)
    log.append("given up")
    threading.Timer(0.2, goes_on.set).start()
    env.reset()
    goes_on.wait(30.0)
    time.sleep(0.1)
    env.step([-0.7, 0.0])
    env.close()
    after = log[log.index("given up") + 1 :]
    assert after[0] == "reset"
    assert set(after[1:]) == {-0.7}
