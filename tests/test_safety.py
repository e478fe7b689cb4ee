"""What reaches a machine when a decision cannot be relied on, and how fast commands change."""

import tracemalloc

import gymnasium as gym
import numpy as np
import pytest
from conftest import FakeClock
from gymnasium import spaces

from sb3_ctco import OptionController
from sb3_ctco.options import JOINS, OptionSpace
from sb3_ctco.safety import Guard, Safety
from sb3_ctco.wrappers import OptionExecutionWrapper, RealTimeOptionWrapper, RealTimeWrapper, TakeOverWrapper

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32)
UNLIMITED = {"max_rate": None, "max_slew": None}


def commands(safety, targets, seconds=0.02):
    guard = Guard(safety, LOW, HIGH)
    return np.array([guard.command(np.array(target, np.float32), seconds) for target in targets])


def test_a_jump_takes_as_long_as_the_rate_says():
    """10 widths a second for 0.02 s are 0.2 widths: 0.4 and 0.8 in these units."""
    sent = commands(Safety(max_rate=10.0, max_slew=None), [[-1, 0]] * 2 + [[1, 4]] * 7)
    np.testing.assert_allclose(sent[:, 0], [-1, -1, -0.6, -0.2, 0.2, 0.6, 1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(sent[:, 1], [0, 0, 0.8, 1.6, 2.4, 3.2, 4, 4, 4], atol=1e-6)
    assert sent.dtype == np.float32


def test_the_first_command_may_be_any_unless_it_is_known_what_is_sent():
    guard = Guard(Safety(max_slew=None), LOW, HIGH)
    np.testing.assert_array_equal(guard.command(np.array([1, 4]), 0.02), [1, 4])
    guard.start([-1, 0])
    np.testing.assert_allclose(guard.command(np.array([1, 4]), 0.02), [-0.6, 0.8], atol=1e-6)


@pytest.mark.parametrize("seconds", [0.002, 0.02, 0.05])
@pytest.mark.parametrize("max_rate", [None, 3.0])
def test_slew_is_limited_without_running_past_the_target(seconds, max_rate):
    safety = Safety(max_rate=max_rate, max_slew=50.0)
    rng = np.random.default_rng(0)
    targets = np.repeat(rng.uniform(LOW, HIGH, (6, 2)), 1500 if seconds < 0.01 else 150, axis=0)
    sent = commands(safety, targets, seconds).astype(np.float64) / (HIGH - LOW)
    rates = np.diff(sent, axis=0) / seconds
    assert np.abs(np.diff(rates, axis=0)).max() <= 50.0 * seconds + 1e-6 / seconds
    if max_rate is not None:
        assert np.abs(rates).max() <= max_rate + 1e-6 / seconds
    for part, goal in zip(np.split(sent, 6), targets[:: len(targets) // 6] / (HIGH - LOW), strict=True):
        # Monotonous towards it, from where it was at rest, and there in the end
        gap = (goal - part) * np.sign(goal - part[0])
        assert gap.min() > -1e-5
        np.testing.assert_allclose(part[-1], goal, atol=1e-5)


def test_smooth_commands_pass_as_they_are_without_a_limit():
    targets = np.random.default_rng(0).uniform(LOW, HIGH, (20, 2)).astype(np.float32)
    np.testing.assert_array_equal(commands(Safety(**UNLIMITED), targets), targets)


def broken(sent):
    raise RuntimeError("no idea")


SAFE_ACTIONS = [
    ("zero", [0, 0]),
    ("hold", [0.5, 3]),
    (lambda sent: sent / 2, [0.25, 1.5]),
    (lambda sent: [9, 9], [1, 4]),  # within the bounds
    (broken, [0.5, 3]),  # held, in place of a function that fails
    (lambda sent: sent * np.nan, [0.5, 3]),
]


@pytest.mark.parametrize(("safe_action", "expected"), SAFE_ACTIONS)
def test_the_safe_action(safe_action, expected, caplog):
    guard = Guard(Safety(safe_action=safe_action, stale_after=0.5, **UNLIMITED), LOW, HIGH)
    good = np.array([0.5, 3])
    for bad, age in ((np.array([np.nan, 3]), 0.0), (np.array([1, 1]), 0.51)):
        np.testing.assert_array_equal(guard.command(good, 0.02, age=0.5), good)
        assert not guard.is_safe_action
        np.testing.assert_array_equal(guard.command(bad, 0.02, age), expected)
        assert guard.is_safe_action
    guard.command(bad, 0.02, age)
    assert guard.replaced == {"the action is not finite": 1, "no fresh observation": 2}
    assert caplog.text.count("the safe action is sent (no fresh observation)") == 1


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"stale_after": None}, "stale_after must be a positive number, not None"),
        ({"max_rate": 0.0}, "max_rate must be a positive number, not 0.0"),
        ({"max_slew": float("nan")}, "max_slew must be a positive number, not nan"),
        ({"safe_action": "stop"}, "safe_action must be 'hold', 'zero' or a function of the last action, not 'stop'"),
    ],
)
def test_settings_that_are_none(wrong, message):
    with pytest.raises(ValueError, match=message):
        Safety(**wrong)


class Interrupt:
    """Asked every 0.2 s; what it was asked, and whether it ends an option."""

    check_period = 0.2
    answer = False

    def __init__(self):
        self.asked = []

    def worth_ending(self, observations, rests):
        self.asked.append((observations, rests))
        return np.full(len(rests), self.answer)


class Policy:
    """Options of 0.4 s that repeat ``value``; the observations that it was asked about."""

    option_space = OptionSpace.make(n_rbf=1, d_max=0.4, d_min=0.4, dt=0.1, discount_rate=0.4)
    primitive_action_space = spaces.Box(LOW, HIGH)
    observation_space = spaces.Box(-np.inf, np.inf, (3,))
    value: float | Exception = 0.5

    def __init__(self):
        self.asked = []

    def __call__(self, observation):
        self.asked.append(observation)
        if isinstance(self.value, Exception):
            raise self.value
        option = np.array([self.value, self.value, 0.0], np.float32)
        return option if np.ndim(observation) == 1 else np.tile(option, (len(observation), 1))


HALF = [0.5, 3.0]  # what 0.5 is in the units of the box


def make_controller(**kwargs):
    policy = Policy()
    return policy, OptionController(policy, safety=Safety(**{**UNLIMITED, "stale_after": 0.25, **kwargs}))


def test_no_fresh_observation(caplog):
    policy, controller = make_controller()
    obs = np.zeros(3)
    np.testing.assert_array_equal(controller(obs, now=10.0), HALF)
    np.testing.assert_array_equal(controller(None, now=10.1), HALF)
    np.testing.assert_array_equal(controller(None, now=10.2), HALF)
    np.testing.assert_array_equal(controller(None, now=10.3), [0, 0])
    # An old one is no fresh one
    np.testing.assert_array_equal(controller(obs, now=10.4, observed_at=10.1), [0, 0])
    assert len(policy.asked) == 1
    # With a fresh one it is decided at once
    np.testing.assert_array_equal(controller(obs, now=10.5), HALF)
    assert len(policy.asked) == 2
    assert controller.replaced == {"no fresh observation": 2}
    assert caplog.text.count("no fresh observation") == 1


@pytest.mark.parametrize("n", [None, 3])
def test_a_stop_takes_the_option_s_place_within_the_limits(n):
    policy, controller = make_controller(max_rate=10.0)
    obs = np.zeros(3) if n is None else np.zeros((n, 3))
    np.testing.assert_array_equal(controller(obs, now=0.0), HALF if n is None else [HALF] * n)
    # By 10 widths a second, which are 2 and 4, at most
    for k, expected in enumerate([[0.1, 2.2], [0.0, 1.4], [0.0, 0.6], [0.0, 0.0]]):
        sent = controller.stop(now=0.02 * (k + 1))
        np.testing.assert_allclose(sent, expected if n is None else [expected] * n, atol=1e-6)
    assert controller.replaced == {"stopped": 4}
    assert len(policy.asked) == 1
    np.testing.assert_allclose(controller(obs, now=0.1), np.broadcast_to([0.4, 0.8], sent.shape), atol=1e-6)
    assert len(policy.asked) == 2


def test_a_stop_before_the_first_tick_sends_the_safe_action():
    _, controller = make_controller()
    np.testing.assert_array_equal(controller.stop(now=0.0), [0, 0])


def test_a_stop_needs_a_clock_and_a_safe_action():
    _, controller = make_controller()
    controller(np.zeros(3))
    with pytest.raises(ValueError, match="give now at each tick or at none"):
        controller.stop(now=0.1)
    controller.reset()
    controller.stop(now=0.1)
    with pytest.raises(ValueError, match="must not run backwards"):
        controller.stop(now=0.0)
    with pytest.raises(ValueError, match="safety=None has no safe action"):
        OptionController(Policy(), safety=None).stop(now=0.0)


def test_an_option_that_runs_out_without_a_new_observation_holds_its_last_action():
    policy, controller = make_controller(stale_after=1.0)
    controller(np.zeros(3), now=0.0)
    np.testing.assert_array_equal(controller(None, now=0.6), HALF)
    assert len(policy.asked) == 1
    controller(np.zeros(3), now=0.7)
    assert len(policy.asked) == 2


@pytest.mark.parametrize("failure", [float("nan"), ZeroDivisionError("oh")])
@pytest.mark.parametrize("n", [None, 3])
def test_a_policy_that_fails(failure, n, caplog):
    policy, controller = make_controller(safe_action="hold")
    obs = np.zeros(3) if n is None else np.zeros((n, 3))
    expected = HALF if n is None else [HALF] * n
    np.testing.assert_array_equal(controller(obs, now=0.0), expected)
    policy.value = failure
    for k in range(5):  # the option runs until 0.35
        np.testing.assert_array_equal(controller(obs, now=0.1 * (k + 1)), expected)
    assert controller.replaced == {"the policy failed": 2}
    assert caplog.text.count("the policy failed: ") == 1
    policy.value = -0.5
    np.testing.assert_array_equal(controller(obs, now=0.6), np.broadcast_to([-0.5, 1.0], np.shape(expected)))


def test_a_policy_that_fails_at_once():
    policy, controller = make_controller()
    policy.value = float("nan")
    action = controller(np.zeros((3, 3)), now=0.0)
    assert action.shape == (3, 2)
    np.testing.assert_array_equal(action, 0.0)
    policy.value = 0.5
    np.testing.assert_array_equal(controller(np.zeros((3, 3)), now=0.1), [HALF] * 3)


def test_limits_hold_by_a_clock_and_not_at_a_fixed_rate():
    policy = Policy()
    policy.value = -1.0
    by_clock, by_tick = OptionController(policy), OptionController(policy)
    sent = []
    for k in range(60):
        policy.value = 1.0 if k >= 30 else -1.0
        sent.append((by_clock(np.zeros(3), now=0.01 * k)[0], by_tick(np.zeros(3))[0]))
    steps = np.abs(np.diff(sent, axis=0)).max(axis=0)
    assert 0.1 < steps[0] <= 2 * 10.0 * 0.01 + 1e-6
    assert steps[1] == 2.0
    policy.value = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        for _ in range(5):
            by_tick(np.zeros(3))


def peak_of_memory(function, obs):
    """Of 40 calls, in bytes; the least of two times, because the interpreter has its own needs now and then."""
    peaks = []
    for _ in range(2):
        tracemalloc.start()
        for _ in range(40):
            function(obs)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return min(peaks)


@pytest.mark.parametrize("n", [None, 3])
def test_between_decisions_nothing_is_allocated_and_an_action_may_be_kept(n):
    policy = Policy()
    controller = OptionController(policy, dt=0.004)  # 100 ticks an option
    obs = np.zeros(3) if n is None else np.zeros((n, 3))
    kept = [controller(obs) for _ in range(10)]
    copies = [action.copy() for action in kept]
    assert all(action.base is kept[0].base for action in kept)  # rows of one plan
    # What Python itself takes of a call is below 200 bytes, an array of 50 numbers is above.
    assert peak_of_memory(controller, obs) < peak_of_memory(lambda obs: None, obs) + 200
    assert peak_of_memory(lambda obs: np.zeros(50), obs) > peak_of_memory(lambda obs: None, obs) + 200
    assert len(policy.asked) == 1
    policy.value = -1.0
    for _ in range(150):
        controller(obs)
    np.testing.assert_array_equal(kept, copies)


def test_smooth_commands_pass_as_they_are():
    """At 50 Hz, up to 8 widths a second: what can be stopped within a period."""
    targets = np.stack([np.sin(np.arange(50) * 0.1), 2 + 2 * np.cos(np.arange(50) * 0.1)], axis=1).astype(np.float32)
    np.testing.assert_allclose(commands(Safety(), targets), targets, atol=1e-6)


class Machine(gym.Env):
    """Commands arrive; its observations are of age ``age``; the action that it is sending at first is −1."""

    dt = 0.1
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    age = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.commands = []
        return np.zeros(1), {"last_action": [-1.0]}

    def send(self, action):
        self.commands.append(round(float(action[0]), 4))

    def receive(self):
        return np.array([float(len(self.commands))]), 0.0, False, False, {"observation_age": self.age}


def test_commands_to_a_machine_are_limited_and_those_to_a_simulation_are_not():
    env = RealTimeWrapper(Machine(), clock=FakeClock(), safety=Safety(max_rate=2.0, max_slew=None))
    env.reset()
    for _ in range(4):
        env.step(np.ones(1))
    assert env.unwrapped.commands == [-0.6, -0.2, 0.2, 0.6]  # 0.4 of a width of 2 in 0.1 s at 2/s: from what is being sent

    assert RealTimeWrapper(Machine(), clock=FakeClock()).guard.safety == Safety()

    class Simulation(Machine):
        send = receive = None

    assert RealTimeWrapper(Simulation(), clock=FakeClock()).guard is None
    assert RealTimeWrapper(Machine(), clock=FakeClock(), safety=None).guard is None


def test_an_old_observation_ends_the_option(caplog):
    machine = Machine()
    env = RealTimeWrapper(machine, clock=FakeClock(), safety=Safety(stale_after=0.3, safe_action="zero", **UNLIMITED))
    env = RealTimeOptionWrapper(env, n_rbf=1, d_max=1.0)
    env.reset()
    machine.age = 0.5
    *_, info = env.step([0.5, 1.0])
    # The first command is decided on the observation of the reset, the second one on an old one.
    assert machine.commands == [0.5, 0.0]
    assert info["option"]["n_steps"] == 2
    assert info["taken_over"]
    machine.age = 0.0
    *_, info = env.step([0.5, 1.0])
    assert machine.commands == [0.5, 0.0, 0.0]  # what was seen last is still old
    *_, info = env.step([0.5, 1.0])
    assert machine.commands == [0.5, 0.0, 0.0, *[0.5] * 10]
    assert "taken_over" not in info
    assert env.get_wrapper_attr("total_statistics").safe_ticks == 2
    env.close()
    assert "the safe action was sent 2 times: {'no fresh observation': 2}" in caplog.text


def limited_machine(wrapper, **kwargs):
    env = RealTimeWrapper(Machine(), clock=FakeClock(), safety=Safety(max_rate=2.0, max_slew=None, stale_after=0.3))
    return wrapper(env, n_rbf=1, d_max=0.3, join="continuous", **kwargs)


@pytest.mark.parametrize("wrapper", [OptionExecutionWrapper, RealTimeOptionWrapper])
def test_options_in_real_time_leave_from_what_was_sent(wrapper):
    """A rate of 2/s lets through 0.4 in 0.1 s; three steps from −1 to 1 are of 2/3."""
    env = limited_machine(wrapper, n_sub_options=20, sub_option_tolerance=2.0)
    obs, _ = env.reset(seed=0)
    assert obs[-1] == -1.0
    obs, *_ = env.step([1.0, 1.0])
    np.testing.assert_allclose(env.unwrapped.commands, [-0.6, -0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(obs, [3.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(env.plan([1.0, 1.0])[:, 0], [0.2 + 0.8 * k / 3 for k in (1, 2, 3)], atol=1e-6)
    # A sub-option leaves from what was sent, and comes to what was wanted.
    count, sent = 0, [-1.0, *env.unwrapped.commands]
    while count < 10:
        env.reset()
        sub = env.step([1.0, 1.0])[-1]["sub_options"]
        for one, after, option in zip(sub.observations, sub.next_observations, sub.options.astype(np.float64), strict=True):
            first, end = int(one[0]), int(after[0])
            assert (one[1], after[1]) == pytest.approx((sent[first], sent[end]), abs=1e-6)
            assert env.option_space.plan(option, one[1:])[-1, 0] == pytest.approx([-1 / 3, 1 / 3, 1.0][end - 1], abs=1e-6)
            count += 1


def test_the_rest_of_an_option_is_told_from_what_was_sent():
    interrupt = Interrupt()
    env = limited_machine(RealTimeOptionWrapper, interrupt=interrupt)
    env.reset()
    env.step([1.0, 1.0])
    ((seen, rests),) = interrupt.asked
    np.testing.assert_allclose(seen, [[2.0, -0.2]], atol=1e-6)
    np.testing.assert_allclose(rests[0, 0], 1.0, atol=1e-6)


@pytest.mark.parametrize("ahead", [0.0, 0.2])
@pytest.mark.parametrize("join", JOINS)
def test_an_option_that_is_not_finite(ahead, join):
    machine = Machine()
    env = RealTimeWrapper(machine, clock=FakeClock(), safety=Safety(safe_action="hold", **UNLIMITED))
    env = RealTimeOptionWrapper(env, ahead, n_rbf=1, d_max=1.0, join=join, background=bool(ahead))
    env.reset()
    env.step([0.5, 1.0])
    for _ in range(2):
        obs, *_, info = env.step([np.nan, 1.0])
        assert info["taken_over"]
        if join != "free":
            assert obs[1] == 0.5
    if join == "smooth":
        assert obs[2] == 0.0
    *_, info = env.step([0.25, 1.0])
    env.close()
    assert np.isfinite(machine.commands).all()
    assert machine.commands[9:12] == [0.5] * 3
    assert machine.commands[12] == pytest.approx({"free": 0.25, "continuous": 0.475, "smooth": 0.4975}[join])
    assert "taken_over" not in info
    assert env.get_wrapper_attr("total_statistics").safe_ticks == 2
    unguarded = RealTimeOptionWrapper(RealTimeWrapper(Machine(), clock=FakeClock(), safety=None), n_rbf=1, d_max=1.0)
    unguarded.reset()
    with pytest.raises(ValueError, match="must be finite"):
        unguarded.step([np.nan, 1.0])


def test_the_safe_action_ends_an_option_in_the_plain_wrapper_too():
    """Eyes shut after the second of ten steps: the third action is the safe one, and ends an option that is nobody's."""

    class Blind(Machine):
        def receive(self):
            obs, reward, terminated, truncated, info = super().receive()
            return obs, reward, terminated, truncated, {**info, "observation_age": 9.9 if len(self.commands) == 2 else 0.0}

    machine = Blind()
    env = OptionExecutionWrapper(RealTimeWrapper(machine, clock=FakeClock(), safety=Safety(**UNLIMITED)), n_rbf=1, d_max=1.0)
    env.reset()
    *_, info = env.step([0.5, 1.0])
    assert info["option"]["n_steps"] == len(machine.commands) == 3
    assert info["taken_over"]
    *_, info = env.step([0.5, 1.0])
    assert "taken_over" not in info
    assert info["option"]["n_steps"] == 10


def test_an_observation_grows_old_while_somebody_decides():
    """0.2 s is as old as it may be: after 0.15 s of thinking it is acted on, after 60 s it is not, and the next one is."""
    clock, machine = FakeClock(), Machine()
    env = RealTimeWrapper(machine, clock=clock, safety=Safety(stale_after=0.2, **UNLIMITED))
    env.reset()
    for thinking in (0.0, 0.15, 60.0, 0.0):
        clock.time += thinking
        env.step(np.array([0.5]))
    assert machine.commands == [0.5, 0.5, 0.0, 0.5]
    clock.time = 0.0  # a clock that was set back: nobody knows how old it is, and it is not older
    env.step(np.array([0.5]))
    assert machine.commands[-1] == 0.5


@pytest.mark.parametrize(
    ("limits", "start", "age"),
    [
        ({"max_slew": np.inf}, [0.0], 0.0),
        ({"max_rate": np.inf, "max_slew": np.inf}, [0.0], 0.0),
        ({}, [np.nan], 0.0),
        ({}, None, np.nan),
    ],
)
def test_a_guard_never_sends_nan(limits, start, age):
    guard = Guard(Safety(**limits), -np.ones(1), np.ones(1))
    guard.start(start)
    sent = [guard.command(np.array([0.5]), 0.1, age).item() for _ in range(3)]
    assert np.isfinite(sent).all()
    assert guard.is_safe_action == np.isnan(age)
    assert sent[-1] == (0.0 if guard.is_safe_action else 0.5)


def test_limits_need_bounds():
    unbounded = np.full(2, np.inf)
    with pytest.raises(ValueError, match=r"max_rate=10.0 and max_slew=400.0 count in widths of the box"):
        Guard(Safety(), -unbounded, unbounded)
    guard = Guard(Safety(**UNLIMITED), -unbounded, unbounded)
    for action in ([5.0, 6.0], [7.0, 8.0]):
        np.testing.assert_array_equal(guard.command(np.array(action), 0.1), action)


def test_some_robots_are_reset_before_their_number_is_known():
    _, controller = make_controller()
    assert controller(None, now=0.0).shape == (2,)
    controller.reset([2])
    controller.reset(np.array([False, False, True]))
    with pytest.raises(ValueError, match="before the first tick"):
        controller.reset([2], last_action=[0.0, 0.0])


def test_after_a_stall_a_command_changes_by_two_ticks_worth_at_most():
    policy, controller = make_controller(max_rate=1.0)
    policy.value = 1.0
    for k in range(4):
        assert controller(np.zeros(3), now=0.1 * k)[0] == 1.0
    policy.value = -1.0
    assert controller(np.zeros(3), now=0.9)[0] == pytest.approx(1.0 - 2 * 0.1 * 2.0)  # at a width, 2, a second
    # Of ticks that are faster than dt, too
    policy, controller = make_controller(max_rate=1.0)
    policy.value = 1.0
    for k in range(100):
        assert controller(np.zeros(3), now=0.01 * k)[0] == 1.0
    policy.value = -1.0
    assert controller(np.zeros(3), now=1.5)[0] == pytest.approx(1.0 - 2 * 0.01 * 2.0, abs=0.001)
    # A loop that is always slower than dt is no stall.
    policy, controller = make_controller(max_rate=0.1, stale_after=9.0)
    policy.value = 1.0
    controller.reset(last_action=[-1.0, 0.0])
    sent = [controller(np.zeros(3), now=0.5 * k)[0] for k in range(25)]
    assert np.diff(sent)[:3] == pytest.approx([0.04, 0.044, 0.0484], rel=1e-3)
    assert np.diff(sent)[14:16] == pytest.approx(0.1, rel=1e-3)


def test_one_of_several_robots_begins_from_what_is_sent_to_it():
    low = [-1.0, 0.0]
    _, controller = make_controller(max_rate=1.0)
    with pytest.raises(ValueError, match="before the first tick pass the last action of all robots"):
        controller.reset([1], last_action=low)
    obs = np.zeros((3, 3))
    np.testing.assert_array_equal(controller(obs, now=0.0), [HALF] * 3)
    controller.reset([1], last_action=low)
    # In 0.1 s it moves by a tenth of the widths, 2 and 4.
    np.testing.assert_allclose(controller(obs, now=0.1), [HALF, [-0.8, 0.4], HALF], rtol=1e-6)
    # The same while the safe action is sent
    for now in (0.2, 0.3, 0.4):
        controller(None, now=now)
    assert controller.replaced
    before = controller._guard._sent.copy()
    controller.reset([2], last_action=[1.0, 4.0])
    np.testing.assert_allclose(controller._guard._sent, [*before[:2], [1.0, 4.0]])
    assert (controller._first[2] == [1.0, 4.0]).all()
    controller.reset([2])
    assert (controller._first[2] == controller._middle).all()
    controller.reset([0], last_action=[np.nan, 2.0])
    assert np.isfinite(controller._guard._sent).all()
    # And each from its own, from the beginning, also if the first ticks have nothing to go by
    controller.reset(last_action=[low, HALF, [1.0, 4.0]])
    np.testing.assert_allclose(controller(obs, now=9.0), [[-0.8, 0.4], HALF, [0.8, 3.6]], rtol=1e-6)
    controller.reset(last_action=[low, low, HALF])
    for now in (9.1, 9.2):
        assert controller(None, now=now).shape == (3, 2)
    assert controller.replaced["no fresh observation"] >= 2


def test_what_was_sent_is_asked_in_the_machines_actions_only():
    def rescaled(**kwargs):
        return gym.wrappers.RescaleAction(RealTimeWrapper(Machine(), clock=FakeClock(), **kwargs), -2.0, 2.0)

    with pytest.raises(ValueError, match=r"join='continuous' needs to know what was sent.*safety=None"):
        OptionExecutionWrapper(rescaled(), join="continuous")
    with pytest.raises(ValueError, match="take_over needs to know what was sent"):
        TakeOverWrapper(rescaled(), lambda obs: None, print)
    OptionExecutionWrapper(rescaled())
    OptionExecutionWrapper(rescaled(safety=None), join="continuous")


def test_a_time_of_another_clock_is_no_fresh_observation():
    """Stamps of the wall clock, by which an observation would stay fresh for decades."""
    _, controller = make_controller()
    np.testing.assert_array_equal(controller(np.zeros(3), now=1.0, observed_at=1.7e9), [0, 0])
    np.testing.assert_array_equal(controller(None, now=1.1), [0, 0])
    assert controller.replaced == {"observed_at is of another clock than now": 2}
    np.testing.assert_array_equal(controller(np.zeros(3), now=1.2, observed_at=1.25), HALF)  # clocks differ by a little

    machine = Machine()
    env = RealTimeWrapper(machine, clock=FakeClock(), safety=Safety(**UNLIMITED))
    env.reset()
    machine.age = -1.7e9
    for _ in range(3):
        env.step(np.array([0.5], np.float32))
    assert machine.commands == [0.5, 0.0, 0.0]


def test_options_take_the_time_that_they_say_on_a_machine():
    arguments = {"n_rbf": 1, "d_max": 1.0, "dt": 0.1}
    machine = Machine()
    machine.dt = 0.02
    with pytest.raises(ValueError, match=r"RealTimeWrapper inside has dt=0\.02 s, and options here have dt=0\.1 s"):
        RealTimeOptionWrapper(RealTimeWrapper(machine, clock=FakeClock()), **arguments)
    env = RealTimeOptionWrapper(RealTimeWrapper(machine, clock=FakeClock()), **{**arguments, "dt": 0.02})
    env.reset()
    assert env.step([0.0, 1.0])[-1]["option"]["n_steps"] == 50


def test_there_is_nothing_to_hold_before_the_first_action(caplog):
    controller = OptionController(Policy(), safety=Safety(safe_action="hold", **UNLIMITED))
    np.testing.assert_array_equal(controller(np.zeros(3), now=1.0, observed_at=0.0), [0, 0])
    assert "since no last action is known: tell reset of it" in caplog.text
