"""Somebody else acts for a while: what is sent, recorded and stored."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_ctco.wrappers import RealTimeOptionWrapper, TakeOverWrapper


def between(first, last):
    """Somebody who acts, by commands of −0.5, on the observations of the steps from ``first`` on and before ``last``."""
    return lambda obs: np.array([-0.5]) if first <= obs[0] < last else None


def make_env(scripted_env, take_over, join="free", **kwargs):
    recorded = []
    inner = TakeOverWrapper(scripted_env(rewards=lambda step, action: float(step), **kwargs), take_over, recorded.append)
    env = RealTimeOptionWrapper(inner, n_rbf=1, d_max=1.0, duration_scale="linear", join=join)
    env.reset(seed=0)
    return env, recorded


def test_control_passes_between_options(scripted_env):
    """Options of 10 steps of 0.25; somebody takes over after 4, for 13 steps."""
    env, recorded = make_env(scripted_env, between(4, 17))
    options = []
    for _ in range(5):
        obs, _, _, _, info = env.step([0.25, 1.0])
        options.append((info["option"]["n_steps"], "taken_over" in info, int(obs[0])))
    # The option ends where they take over; those that they play through are theirs; the one after it is whole again.
    assert options == [(4, False, 4), (10, True, 14), (3, True, 17), (10, False, 27), (10, False, 37)]
    assert np.ravel(env.unwrapped.actions).tolist() == [0.25] * 4 + [-0.5] * 13 + [0.25] * 20
    (trajectory,) = recorded
    np.testing.assert_array_equal(trajectory.observations[:, 0], np.arange(4, 18))
    np.testing.assert_array_equal(trajectory.actions, np.full((13, 1), -0.5))
    np.testing.assert_array_equal(trajectory.rewards, np.arange(4, 17))
    assert (trajectory.terminated, trajectory.truncated, trajectory.dt) == (False, False, 0.1)


@pytest.mark.parametrize("end", [{"terminate_at": 6}, {"truncate_at": 6}])
def test_an_episode_that_ends_meanwhile(scripted_env, end):
    env, recorded = make_env(scripted_env, between(3, 100), **end)
    for _ in range(2):
        env.step([0.25, 1.0])
    env.reset()
    env.step([0.25, 1.0])
    env.close()
    (trajectory,) = recorded  # the second episode's has no step
    np.testing.assert_array_equal(trajectory.observations[:, 0], [3, 4, 5, 6])
    assert (trajectory.terminated, trajectory.truncated) == ("terminate_at" in end, "truncate_at" in end)


def test_a_reset_in_the_middle_hands_over_what_there_is(scripted_env):
    env, recorded = make_env(scripted_env, between(0, 100))
    env.step([0.25, -0.5])
    env.reset()
    env.step([0.25, -1.0])
    env.close()
    assert [len(trajectory.actions) for trajectory in recorded] == [3, 1]


def test_commands_stay_in_their_bounds(scripted_env):
    env, recorded = make_env(scripted_env, lambda obs: [7])
    env.step([0.25, -1.0])
    env.close()
    np.testing.assert_array_equal(recorded[0].actions, [[1.0]])
    assert recorded[0].actions.dtype == np.float32


def test_deciding_ahead(scripted_env):
    """The rest of an option that plays while the next is decided on is broken off, too."""
    recorded = []
    inner = TakeOverWrapper(scripted_env(), between(9, 15), recorded.append)
    env = RealTimeOptionWrapper(inner, n_rbf=1, d_max=1.0, decide_ahead=0.2)
    env.reset(seed=0)
    options = []
    for _ in range(3):
        *_, info = env.step([0.25, 1.0])
        options.append((info["option"]["n_steps"], "taken_over" in info))
    assert options == [(8, False), (1, False), (6, True)]
    assert len(recorded[0].actions) == 6


def test_with_a_smooth_join_control_comes_back_with_the_slope_at_which_it_was_given(scripted_env):
    env, _ = make_env(scripted_env, lambda obs: [0.1 * obs[0] - 0.5] if 4 <= obs[0] < 8 else None, join="smooth")
    env.step([0.25, 1.0])
    obs, *_ = env.step([0.25, 1.0])
    # By 0.1 a step to 0.2; as steep as an option gets is 4 in the shortest duration.
    np.testing.assert_allclose(obs[2:], [0.2, 0.1 / (4 * 0.1 / env.option_space.d_min)], atol=1e-6)
    np.testing.assert_allclose(env.plan([0.25, 1.0])[0, 0], 0.81 * 0.2 + 0.18 * 0.7 + 0.01 * 0.25, atol=1e-6)


def test_with_a_continuous_join_control_comes_back_where_it_was_given(scripted_env):
    env, _ = make_env(scripted_env, between(4, 8), join="continuous")
    for last_action in (0.1, -0.5):
        obs, *_, info = env.step([0.25, 1.0])
        assert obs[-1] == pytest.approx(last_action)
        assert info["option"]["n_steps"] == 4
    # A tenth of the way from −0.5 to 0.25 with each step
    np.testing.assert_allclose(env.plan([0.25, 1.0])[:2, 0], [-0.425, -0.35], atol=1e-6)


def test_what_a_machine_says_was_sent_is_copied(scripted_env):
    """It may say so in the same array each time."""

    class Reporting(gym.Wrapper):
        sent = np.zeros(1, np.float32)

        def step(self, action):
            self.sent[:] = action
            *outcome, info = self.env.step(action)
            return (*outcome, {**info, "last_action": self.sent})

    recorded = []
    env = TakeOverWrapper(Reporting(scripted_env()), lambda obs: [obs[0] / 10], recorded.append)
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(1, np.float32))
    env.hand_over()
    np.testing.assert_allclose(recorded[0].actions[:, 0], [0.0, 0.1, 0.2, 0.3], atol=1e-6)


def test_an_action_that_is_not_finite_is_not_sent(scripted_env):
    inner = scripted_env()
    env = TakeOverWrapper(inner, lambda obs: [np.nan], lambda trajectory: None)
    with pytest.raises(ValueError, match=r"take_over returned .*, which is not finite"):
        env.reset()
    assert not inner.actions
