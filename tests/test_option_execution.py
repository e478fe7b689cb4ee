import math

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import RecordVideo, TimeLimit, TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_ctco import CTCO
from sb3_ctco.fixed_rate import sac_at_rate
from sb3_ctco.options import RadialBasis
from sb3_ctco.video import RecordEpisodes
from sb3_ctco.wrappers import (
    OptionExecutionWrapper,
    RealTimeWrapper,
    RewardRateWrapper,
    SupportsStepSequence,
    TakeOverWrapper,
    find_dt,
)

TAU = math.log(2.0)  # half in a second


def wrap(env, **kwargs):
    paper = {"trajectory": "rbf", "duration_scale": "linear"}
    return OptionExecutionWrapper(env, **{"n_rbf": 1, "d_max": 1.0, "discount_rate": TAU, **paper, **kwargs})


# --- one decision


def test_an_option_by_hand(scripted_env):
    # d = 0 is the middle of [0.1, 0.5] s: 0.3 s, three steps of 0.1 s, paid 0, 1, 2
    env = wrap(scripted_env(rewards=lambda step, action: float(step)), d_min=0.1, d_max=0.5)
    env.reset()
    obs, reward, terminated, truncated, info = env.step([0.25, 0.0])
    assert obs[0] == 3
    assert (reward, terminated, truncated) == (3.0, False, False)
    option = info["option"]
    assert option["n_steps"] == 3
    assert option["duration"] == pytest.approx(0.3)
    assert option["discount"] == pytest.approx(0.5**0.3)
    weight = (1 - 0.5**0.1) / TAU
    assert option["integrated_reward"] == pytest.approx(weight * (1 * 0.5**0.1 + 2 * 0.5**0.2))
    assert info["count"] == 3
    np.testing.assert_allclose(np.ravel(env.unwrapped.actions), [0.25, 0.25, 0.25])
    # Scalars only: Stable-Baselines3 copies infos deeply.
    assert all(type(value) in (int, float) for value in option.values())


def test_reward_kinds(scripted_env):
    def play(**kwargs):
        env = wrap(scripted_env(rewards=lambda step, action: 2.0), d_min=0.2, d_max=0.2, **kwargs)
        env.reset()
        _, reward, _, _, info = env.step([0.0, 0.7])
        return reward, info["option"]["integrated_reward"]

    rate = 2.0 * (1 - 0.5**0.2) / TAU
    impulse = 2.0 * (1 + 0.5**0.1)
    assert play() == (4.0, pytest.approx(rate))
    assert play(reward="integral") == (pytest.approx(rate), pytest.approx(rate))
    assert play(reward="integral", reward_unit="impulse") == (pytest.approx(impulse), pytest.approx(impulse))


def test_actions_are_mapped_to_the_bounds_of_any_shape(scripted_env):
    low = np.array([[0.0, -3.0], [5.0, -1.0]], dtype=np.float32)
    high = np.array([[1.0, 3.0], [6.0, 0.0]], dtype=np.float32)
    env = wrap(scripted_env(action_space=spaces.Box(low, high)), n_rbf=2, d_max=0.3)
    assert env.action_space.shape == (9,)
    env.reset()
    env.step(np.concatenate([np.ones(8), [1.0]]))
    for action in env.unwrapped.actions:
        np.testing.assert_array_equal(action, high)
        assert action.dtype == np.float32
    env.step(np.concatenate([-np.ones(8), [1.0]]))
    np.testing.assert_array_equal(env.unwrapped.actions[-1], low)
    # ω is [action_dim, n_rbf] flattened: the first two weights drive the first action entry, halfway up its range.
    omega = np.array([[0.0, 0.0], [1.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
    env.step(np.concatenate([omega.ravel(), [1.0]]))
    plan = RadialBasis(omega.shape[1]).plan(omega, 3)
    for action, expected in zip(env.unwrapped.actions[-3:], plan, strict=True):
        np.testing.assert_allclose(action, [[0.5, 3.0 * expected[1]], [5.5, -0.5]], rtol=1e-6)


def test_entries_outside_the_box_are_clipped(scripted_env):
    env = wrap(scripted_env(), d_max=0.2)
    env.reset()
    _, _, _, _, info = env.step([7.0, 1.5])
    assert info["option"]["n_steps"] == 2
    np.testing.assert_array_equal(np.ravel(env.unwrapped.actions), [1.0, 1.0])


# --- the end of an episode


@pytest.mark.parametrize("kind", ["terminate_at", "truncate_at"])
def test_an_option_stops_at_the_end_of_the_episode(scripted_env, kind):
    env = wrap(scripted_env(**{kind: 3}), d_max=1.0)
    env.reset()
    obs, reward, terminated, truncated, info = env.step([0.0, 1.0])  # asks for ten steps
    assert obs[0] == 3
    assert (terminated, truncated) == (kind == "terminate_at", kind == "truncate_at")
    assert info["option"]["n_steps"] == 3
    assert info["option"]["duration"] == pytest.approx(0.3)
    assert info["option"]["discount"] == pytest.approx(0.5**0.3)
    assert reward == 3.0
    with pytest.raises(ResetNeeded, match="reset"):
        env.step([0.0, 1.0])
    env.reset()
    assert env.step([0.0, -1.0])[4]["option"]["n_steps"] == 1


def test_fixed_duration(scripted_env):
    env = wrap(scripted_env(), d_min=0.4, d_max=0.4)
    env.reset()
    for entry in (-1.0, 0.3, 1.0):
        assert env.step([0.0, entry])[4]["option"]["n_steps"] == 4


def test_step_before_reset(scripted_env):
    with pytest.raises(ResetNeeded, match="reset"):
        wrap(scripted_env()).step([0.0, 0.0])


# --- bad input


def test_other_action_spaces_are_refused(scripted_env):
    with pytest.raises(TypeError, match="Box"):
        wrap(scripted_env(action_space=spaces.Discrete(3)))
    with pytest.raises(ValueError, match="finite action bounds"):
        wrap(scripted_env(action_space=spaces.Box(-np.inf, np.inf, (2,))))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"d_max": 0.0}, "d_max"),
        ({"d_min": 0.5, "d_max": 0.2}, "d_min=0.5 s is longer than d_max=0.2 s"),
        ({"d_max": 0.05}, r"d_max=0.05 s is shorter than a step of the environment, dt=0.1 s: .* d_max=1, ten steps"),
        ({"n_rbf": 0}, "n_rbf"),
        ({"discount_rate": -1.0}, "discount_rate"),
        ({"reward": "mean"}, "'sum' or 'integral', not 'mean'"),
        ({"reward_unit": "metres"}, "not 'metres'"),
        ({"dt": -0.1}, "dt"),
    ],
)
def test_bad_settings(scripted_env, kwargs, message):
    with pytest.raises(ValueError, match=message):
        wrap(scripted_env(), **kwargs)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_rewards_and_observations(scripted_env, bad):
    env = wrap(scripted_env(rewards=lambda step, action: bad if step == 1 else 0.0), d_max=0.5)
    env.reset()
    with pytest.raises(ValueError, match="reward that is not finite"):
        env.step([0.0, 1.0])
    with pytest.raises(ResetNeeded):  # the option was half played
        env.step([0.0, 1.0])

    env = wrap(scripted_env(), d_max=0.5)
    env.reset()
    env.unwrapped._obs = lambda: np.array([bad, 0.0], dtype=np.float32)
    with pytest.raises(ValueError, match="observation that is not finite"):
        env.step([0.0, 1.0])


class Faulty(gym.Env):
    """Has faults: ``"reset"`` is what it returns from it, ``"step"`` what it returns from its third step on."""

    dt = 0.1
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, kind):
        vector = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = vector if kind == "vector" else spaces.Dict({"x": vector, "n": spaces.Discrete(9)})
        self.good = np.zeros(2, np.float32) if kind == "vector" else {"x": np.zeros(2, np.float32), "n": 3}
        self.faults = {}

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return self.faults.get("reset", (self.good, {}))

    def step(self, action):
        self.count += 1
        good = (self.good, 0.0, False, False, {})
        return self.faults.get("step", good) if self.count >= 3 else good


GOOD, NAN, INF = np.zeros(2, np.float32), np.array([0.0, np.nan], np.float32), np.array([-np.inf, 0.0], np.float32)
#: What an environment with vectors returns from reset, and what is said
BAD_RESETS = [
    (None, TypeError, "must return an observation and an info"),
    (GOOD, TypeError, "must return an observation and an info"),
    ((GOOD,), TypeError, "must return an observation and an info"),
    ((GOOD, None), TypeError, "must return an observation and an info"),
    ((NAN, {}), ValueError, "observation that is not finite"),
    ((INF, {}), ValueError, "observation that is not finite"),
    ((np.zeros(3), {}), ValueError, r"shape \(3,\), not its space's \(2,\)"),
    ((np.zeros((1, 2)), {}), ValueError, r"shape \(1, 2\), not its space's \(2,\)"),
    ((None, {}), ValueError, r"shape \(\), not its space's \(2,\)"),
]
#: The same from the third step on
BAD_STEPS = [
    (None, TypeError, "must return observation, reward, terminated, truncated and info"),
    ((GOOD, 0.0, False, {}), TypeError, "must return observation, reward, terminated, truncated and info"),
    ((GOOD, 0.0, False, False, None), TypeError, "info None, which must be a dictionary"),
    ((GOOD, 0.0, None, False, {}), TypeError, "terminated=None, which must be True or False"),
    ((GOOD, 0.0, False, None, {}), TypeError, "truncated=None, which must be True or False"),
    ((GOOD, 0.0, False, "no", {}), TypeError, "truncated='no', which must be True or False"),
    ((GOOD, np.nan, False, False, {}), ValueError, "reward that is not finite"),
    ((GOOD, None, False, False, {}), TypeError, "a real number, not 'NoneType'"),
    ((NAN, 0.0, False, False, {}), ValueError, "observation that is not finite"),
    ((NAN, 0.0, True, False, {}), ValueError, "observation that is not finite"),
    ((np.zeros((1, 2)), 0.0, False, False, {}), ValueError, r"shape \(1, 2\), not its space's \(2,\)"),
    ((None, 0.0, False, False, {}), ValueError, r"shape \(\), not its space's \(2,\)"),
]
#: Likewise of an environment with dictionaries
BAD_DICTS = [
    ({"x": NAN, "n": 3}, r"has a 'x' that is not finite"),
    ({"x": np.zeros(3), "n": 3}, r"has a 'x' that has the shape \(3,\), not its space's \(2,\)"),
    ({"x": GOOD}, r"is no dictionary of \['n', 'x'\]"),
    (GOOD, r"is no dictionary of \['n', 'x'\]"),
]
BAD_ENVIRONMENTS = [
    *[("vector", {"reset": given}, error, message) for given, error, message in BAD_RESETS],
    *[("vector", {"step": given}, error, message) for given, error, message in BAD_STEPS],
    *[("dict", {"reset": (given, {})}, ValueError, message) for given, message in BAD_DICTS],
    *[("dict", {"step": (given, 0.0, False, False, {})}, ValueError, message) for given, message in BAD_DICTS],
]


@pytest.mark.parametrize("n_sub_options", [0, 4])
@pytest.mark.parametrize(("kind", "faults", "error", "message"), BAD_ENVIRONMENTS)
def test_what_an_environment_must_not_return_is_not_stored(kind, faults, error, message, n_sub_options):
    """What was given, what is said, and that the buffer is as before; the first option, of two steps, is good."""
    env = Faulty(kind)
    model = CTCO(
        "MlpPolicy" if kind == "vector" else "MultiInputPolicy",
        env,
        d_min=0.2,
        d_max=0.2,
        n_sub_options=n_sub_options,
        learning_starts=100,
        buffer_size=50,
        policy_kwargs={"net_arch": [4]},
    ).learn(2)
    assert model.replay_buffer.size() == 1
    env.faults = faults
    with pytest.raises(error, match=message):
        model.learn(2, reset_num_timesteps="reset" in faults)
    assert model.replay_buffer.size() == 1


def test_environments_whose_reset_takes_a_seed_alone():
    class Env(Faulty):
        def reset(self, seed=None):
            return super().reset()

    SAC("MlpPolicy", Env("vector"), learning_starts=10).learn(2)
    CTCO("MlpPolicy", Env("vector"), learning_starts=10).learn(2)
    sac_at_rate(Env("vector"), dt=0.1).learn(2)


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_a_reward_may_be_an_array_of_one_number(scripted_env, shape):
    env = wrap(scripted_env(rewards=lambda step, action: np.full(shape, 2.0)), d_max=0.3)
    env.reset()
    _, reward, _, _, info = env.step([0.0, 1.0])
    assert reward == 6.0
    assert info["option"]["integrated_reward"] == pytest.approx(2.0 * (1 - 0.5**0.3) / TAU)
    env.unwrapped.rewards = lambda step, action: np.zeros(2)
    with pytest.raises(ValueError, match="rewards that are no numbers"):
        env.step([0.0, 1.0])


@pytest.mark.parametrize("option", [[0.0], [0.0, 0.0, 0.0], [np.nan, 0.0], [0.0, np.inf]])
def test_bad_options(scripted_env, option):
    env = wrap(scripted_env())
    env.reset()
    with pytest.raises(ValueError, match="an option"):
        env.step(option)
    env.step([0.0, 0.0])  # nothing was played, so the episode goes on


def test_an_error_in_the_middle_of_an_option_needs_a_reset(scripted_env):
    def rewards(step, action):
        if step == 2:
            raise RuntimeError("the motor is hot")
        return 0.0

    env = wrap(scripted_env(rewards=rewards), d_max=0.5)
    env.reset()
    with pytest.raises(RuntimeError, match="the motor is hot"):
        env.step([0.0, 1.0])
    with pytest.raises(ResetNeeded):
        env.step([0.0, 1.0])
    env.reset()
    env.step([0.0, -1.0])


# --- dt


def test_dt_is_found(scripted_env):
    assert find_dt(scripted_env(dt=0.25)) == 0.25
    env = scripted_env(dt=None)
    env.control_timestep = lambda: 0.125
    env.metadata = {"render_fps": 50}
    assert find_dt(env) == 0.125
    del env.control_timestep
    assert find_dt(env) == pytest.approx(0.02)
    assert find_dt(gym.make("Pendulum-v1")) == pytest.approx(0.05)
    # An explicit dt goes before everything found.
    assert wrap(env, dt=0.5).option_space.dt == 0.5


def test_dt_that_is_not_found(scripted_env):
    with pytest.raises(ValueError, match="pass dt"):
        wrap(scripted_env(dt=None))


def in_a_film(env, dt):
    env.render_mode = "rgb_array"
    return RecordEpisodes(env, "films", dt=dt)


@pytest.mark.parametrize(
    "wrapper",
    [
        wrap,
        in_a_film,
        RealTimeWrapper,
        RewardRateWrapper,
        lambda env, dt: TakeOverWrapper(env, lambda obs: None, lambda trajectory: None, dt=dt),
    ],
)
@pytest.mark.parametrize("dt", [0.0, -0.1, math.inf, math.nan])
def test_dt_out_of_range(scripted_env, wrapper, dt):
    with pytest.raises(ValueError, match=f"dt must be a positive number of seconds, not {dt}"):
        wrapper(scripted_env(), dt=dt)


# --- among other wrappers


def test_options_of_options_are_refused(scripted_env):
    with pytest.raises(ValueError, match="plays options already: wrap it once"):
        wrap(gym.wrappers.TimeLimit(wrap(scripted_env()), 10))


class SequenceEnv(gym.Wrapper):
    """Offers step_sequence and counts its calls."""

    calls = 0

    def step_sequence(self, actions):
        self.calls += 1
        rewards = []
        for action in actions:
            obs, reward, terminated, truncated, info = self.env.step(action)
            rewards.append(reward)
            if terminated or truncated:
                break
        return obs, rewards, terminated, truncated, info


def play_random(env, n_options=60):
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    trace = [obs]
    for _ in range(n_options):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        info = {key: value for key, value in info.items() if key != "episode"} | {
            key: value for key, value in info.get("episode", {}).items() if key != "t"
        }
        trace.append((obs, reward, terminated, truncated, info))
        if terminated or truncated:
            env.reset(seed=len(trace))
    return trace


def assert_same_trace(left, right):
    for one, other in zip(left, right, strict=True):
        np.testing.assert_equal(one, other)


@pytest.mark.parametrize("end", [{"terminate_at": 25}, {"truncate_at": 25}])
def test_step_sequence_is_used_below_monitor_and_changes_nothing(scripted_env, end, tmp_path):
    def rewards(step, action):
        return 0.5 * step - float(action[0])

    def monitored(env, name):
        # Whoever gives a file wants to know the seed and the environment's count of each episode, too.
        return Monitor(env, str(tmp_path / name), reset_keywords=("seed",), info_keywords=("count",))

    plain = monitored(scripted_env(rewards=rewards, **end), "plain")
    sequence = SequenceEnv(scripted_env(rewards=rewards, **end))
    assert isinstance(sequence, SupportsStepSequence)
    fast = monitored(sequence, "fast")
    assert_same_trace(play_random(wrap(plain)), play_random(wrap(fast)))
    assert sequence.calls == 60
    assert fast.get_episode_rewards() == plain.get_episode_rewards()
    assert fast.get_episode_lengths() == plain.get_episode_lengths() == [25] * len(plain.get_episode_lengths())
    assert fast.get_total_steps() == plain.get_total_steps()
    assert fast.needs_reset == plain.needs_reset
    assert fast.get_episode_times() == sorted(fast.get_episode_times())
    assert len(fast.get_episode_times()) == len(fast.get_episode_lengths())
    plain_rows, fast_rows = (pd.read_csv(tmp_path / f"{name}.monitor.csv", skiprows=1) for name in ("plain", "fast"))
    pd.testing.assert_frame_equal(fast_rows.drop(columns="t"), plain_rows.drop(columns="t"))
    assert list(fast_rows) == ["r", "l", "t", "seed", "count"]


def test_a_time_limit_sees_each_step(scripted_env):
    sequence = SequenceEnv(scripted_env())
    env = wrap(Monitor(TimeLimit(sequence, 7)), d_max=0.5)
    env.reset()
    assert env.step([0.0, 1.0])[3] is False
    _, _, terminated, truncated, info = env.step([0.0, 1.0])
    assert (terminated, truncated, info["option"]["n_steps"], info["episode"]["l"]) == (False, True, 2, 7)
    assert sequence.calls == 0


def test_a_wrapper_that_looks_at_each_step_gets_to_see_it(scripted_env):
    sequence = SequenceEnv(scripted_env())
    env = wrap(TransformReward(sequence, lambda reward: 10.0 * reward), d_max=0.5)
    env.reset()
    assert env.step([0.0, 1.0])[1] == 50.0
    assert sequence.calls == 0


def test_monitor_counts_primitive_steps():
    env = OptionExecutionWrapper(Monitor(gym.make("Pendulum-v1")))
    env.reset(seed=0)
    n_steps, total = 0, 0.0
    truncated = False
    while not truncated:
        _, reward, _, truncated, info = env.step(env.action_space.sample())
        n_steps += info["option"]["n_steps"]
        total += reward
    assert info["episode"]["l"] == n_steps == 200
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-4)


def test_evaluate_policy_reports_primitive_steps():
    class RandomPolicy:
        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            return np.zeros((1, 3), dtype=np.float32), None

    env = make_vec_env("Pendulum-v1", wrapper_class=OptionExecutionWrapper)
    _, lengths = evaluate_policy(RandomPolicy(), env, n_eval_episodes=2, return_episode_rewards=True)
    assert lengths == [200, 200]


def test_a_video_keeps_every_primitive_frame(tmp_path, scripted_env):
    class Rendered(scripted_env):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
        render_mode = "rgb_array"

        def render(self):
            return np.full((32, 32, 3), self.count, dtype=np.uint8)

    video = RecordVideo(Rendered(truncate_at=12), str(tmp_path), episode_trigger=lambda episode: True, disable_logger=True)
    env = wrap(video, d_max=0.5)
    env.reset()
    truncated = False
    while not truncated:
        _, _, _, truncated, _ = env.step([0.0, 1.0])
    # One frame of the reset and one of each step, though only three options were played.
    assert [frame[0, 0, 0] for frame in video.recorded_frames] == list(range(13))
    env.close()
    assert len(list(tmp_path.glob("*.mp4"))) == 1
    import moviepy

    clip = moviepy.VideoFileClip(str(next(tmp_path.glob("*.mp4"))))
    assert clip.n_frames == 13
    clip.close()


@pytest.mark.parametrize("n_rbf", [1, 3])
def test_env_checkers(n_rbf):
    sb3_check_env(OptionExecutionWrapper(gym.make("Pendulum-v1"), n_rbf=n_rbf), warn=True)
    gymnasium_check_env(OptionExecutionWrapper(gym.make("Pendulum-v1").unwrapped, n_rbf=n_rbf), skip_render_check=True)


def test_the_spec_rebuilds_the_environment():
    env = OptionExecutionWrapper(gym.make("Pendulum-v1"), n_rbf=2, d_max=0.5, reward="integral")
    again = gym.make(env.spec)
    assert isinstance(again, OptionExecutionWrapper)
    assert again.option_space == env.option_space
    assert again.reward == "integral"


def test_time_limit_inside_counts_primitive_steps(scripted_env):
    env = wrap(TimeLimit(scripted_env(), max_episode_steps=7), d_max=0.5)
    env.reset()
    assert env.step([0.0, 1.0])[3] is False
    _, _, _, truncated, info = env.step([0.0, 1.0])
    assert truncated
    assert info["option"]["n_steps"] == 2


@pytest.mark.parametrize(
    ("dt", "gamma", "gamma_dt", "expected"),
    [
        (0.002, 0.98, 0.05, (0.025, 0.5)),  # 500 Hz, the paper's discount
        (0.05, 0.98, 0.05, (0.05, 0.5)),  # a step is longer
        (0.008, 0.99, 0.008, (0.008, 0.1608)),  # SAC's discount at 125 Hz
        (0.05, 0.999, 0.05, (0.05, 0.5)),  # 50 s ahead, but not an option of 10 s
        (0.002, 1.0, 0.05, (0.025, 0.5)),
    ],
)
def test_durations_follow_from_rate_and_discount(scripted_env, dt, gamma, gamma_dt, expected):
    model = CTCO("MlpPolicy", scripted_env(dt=dt), gamma=gamma, gamma_dt=gamma_dt, device="cpu")
    space = model.option_space
    assert (space.d_min, space.d_max) == pytest.approx(expected, abs=5e-4)
    wrapped = OptionExecutionWrapper(scripted_env(dt=dt), discount_rate=model.discount_rate)
    assert wrapped.option_space == space
    assert CTCO("MlpPolicy", wrapped, gamma=gamma, gamma_dt=gamma_dt, device="cpu").option_space == space
    assert OptionExecutionWrapper(scripted_env(dt=dt), d_min=0.0).option_space.d_min == dt


def test_options_mean_the_same_where_a_step_takes_longer_than_the_shortest(scripted_env):
    """At a slower rate −0.5 still stands for 0.14 s, a quarter of the way from 0.02 to 0.5 s."""
    model = CTCO("MlpPolicy", scripted_env(dt=0.02), d_min=0.0, d_max=0.5, n_rbf=1, duration_scale="linear", device="cpu")
    assert model.option_space.d_min == 0.02
    for dt, n_steps in ((0.02, 7), (0.1, 1)):
        env = model.wrap_env(scripted_env(dt=dt))
        env.reset()
        assert env.step([0.0, -0.5])[4]["option"]["n_steps"] == n_steps


def test_whole_numbers_are_no_continuous_actions(scripted_env):
    with pytest.raises(TypeError, match=r"actions that are real numbers, not Box\(-3, 3, \(1,\), int8\)"):
        OptionExecutionWrapper(scripted_env(action_space=spaces.Box(-3, 3, (1,), np.int8)))


class Playing(gym.Env):
    """Plays sequences itself, as quick environments do."""

    dt = 0.1
    observation_space = spaces.Box(-1e6, 1e6, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 1.0, False, False, {}

    def step_sequence(self, actions, observe=()):
        return np.zeros(1, np.float32), [1.0] * len(actions), False, False, {"observations": [np.zeros(1)] * len(observe)}


class Shaped(Playing):
    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, reward - 3.0, *rest


class ShapedTogether(Shaped):
    def step_sequence(self, actions, observe=()):
        obs, rewards, *rest = super().step_sequence(actions, observe)
        return obs, [reward - 5.0 for reward in rewards], *rest


@pytest.mark.parametrize("n_sub_options", [0, 2])
@pytest.mark.parametrize(("environment", "reward"), [(Playing, 1.0), (Shaped, -2.0), (ShapedTogether, -4.0)])
def test_a_step_that_a_subclass_defines_is_not_passed_by(environment, reward, n_sub_options):
    env = wrap(environment(), reward="sum", n_sub_options=n_sub_options)
    env.reset(seed=0)
    assert env.step([0.0, 1.0])[1] == pytest.approx(10 * reward)
    replaced = environment()
    step = replaced.step

    def with_bonus(action):
        obs, r, *rest = step(action)
        return obs, r + 7.0, *rest

    replaced.step = with_bonus
    env = wrap(replaced, reward="sum")
    env.reset(seed=0)
    inner = -2.0 if environment is ShapedTogether else reward  # what its step says
    assert env.step([0.0, 1.0])[1] == pytest.approx(10 * (inner + 7.0))


def test_rewards_may_come_in_the_same_array_each_time(scripted_env):
    paid = np.zeros(1)

    def rewards(step, action):
        paid[:] = step + 1
        return paid

    env = wrap(scripted_env(rewards=rewards), reward="sum")
    env.reset(seed=0)
    assert env.step([0.0, 1.0])[1] == 55.0


def test_a_fault_of_the_environments_own_says_what_it_is(scripted_env):
    class Faulty(type(scripted_env())):
        def step(self, action):
            _, _ = [1]

    env = OptionExecutionWrapper(Faulty())
    env.reset()
    with pytest.raises(ValueError, match=r"^not enough values to unpack \(expected 2, got 1\)$"):
        env.step(np.zeros(3))
