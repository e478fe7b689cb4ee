"""Gymnasium's MuJoCo robots, rolled out, against their own steps."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

from sb3_ctco import OptionExecutionWrapper
from sb3_ctco.wrappers.gymnasium_mujoco import find_rollout

ROBOTS = ["HalfCheetah-v5", "Swimmer-v5", "Hopper-v5", "Walker2d-v5"]


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(
    "kwargs", [{}, {"terminate_when_unhealthy": False}, {"exclude_current_positions_from_observation": False}]
)
def test_options_equal_the_environments_own_steps(name, kwargs):
    """Observations, rewards, ends, infos, sub-options and the Monitor's books, bit by bit."""
    if "terminate_when_unhealthy" in kwargs and name in ROBOTS[:2]:
        pytest.skip("never terminates")
    traces = []
    for rolled in (True, False):
        env = OptionExecutionWrapper(Monitor(gym.make(name, max_episode_steps=90, **kwargs)), d_max=0.3, n_sub_options=4)
        env.action_space.seed(0)
        trace = [env.reset(seed=0)[0]]
        assert env._play != env._step_in_a_loop
        for _ in range(60):
            if not rolled:
                env._play = env._step_in_a_loop
            obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            trace.append([obs, reward, terminated, truncated, vars(info.pop("sub_options"))])
            if "episode" in info:
                del info["episode"]["t"]
            trace.append(info)
            if terminated or truncated:
                trace.append(env.reset()[0])
        traces.append(trace)
        env.close()
    np.testing.assert_equal(traces[0], traces[1])
    assert sum("episode" in entry for entry in traces[0] if isinstance(entry, dict)) >= 2


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("inputs", ["xfrc_applied", "qfrc_applied"])
def test_external_forces_push(name, inputs):
    """As in the environment's own steps, for as long as they are set; until then they are 0."""
    traces = []
    for rolled in (True, False):
        env = OptionExecutionWrapper(gym.make(name, max_episode_steps=400), d_max=0.3, n_sub_options=4)
        env.action_space.seed(0)
        trace = [env.reset(seed=0)[0]]
        data = env.unwrapped.data
        for force in (0.0, 20.0, 20.0, 0.0):
            if not rolled:
                env._play = env._step_in_a_loop
            forces = getattr(data, inputs)
            forces[...] = 0.0
            # On the torso along the track, or on the joint along it
            forces[(1, 0) if inputs == "xfrc_applied" else 0] = force
            obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            trace.append([obs, reward, terminated, truncated, vars(info.pop("sub_options"))])
            if force:
                assert forces.sum() == force
            if terminated:
                break
        traces.append([*trace, data.qpos.copy()])
        env.close()
    np.testing.assert_equal(traces[0], traces[1])
    assert len(traces[0]) >= 3  # Hopper falls


def test_a_push_is_felt():
    env = OptionExecutionWrapper(gym.make("HalfCheetah-v5"), d_max=1.0)
    ends = []
    for force in (0.0, 100.0):
        env.reset(seed=0)
        env.unwrapped.data.xfrc_applied[1, 0] = force
        env.step([0.0] * 18 + [1.0])
        ends.append(float(env.unwrapped.data.qpos[0]))
    assert ends[1] - ends[0] > 1.0


def test_others_are_stepped(scripted_env):
    class Mine(type(gym.make("Hopper-v5").unwrapped)):
        """May look at each step."""

    assert find_rollout(Mine()) is None
    assert find_rollout(gym.make("InvertedPendulum-v5").unwrapped) is None
    assert find_rollout(scripted_env()) is None


def test_below_the_time_limit_that_rl_zoo_puts_in_place_of_gymnasium_s():
    pytest.importorskip("rl_zoo3.gym_patches")
    env = OptionExecutionWrapper(gym.make("HalfCheetah-v5", max_episode_steps=7), d_max=0.5)
    assert "PatchedTimeLimit" in str(env)
    env.reset(seed=0)
    assert env._play != env._step_in_a_loop
    _, _, terminated, truncated, info = env.step([0.0] * 18 + [1.0])
    assert (terminated, truncated, info["option"]["n_steps"], info["TimeLimit.truncated"]) == (False, True, 7, True)
