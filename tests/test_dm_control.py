import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
import shimmy
from dm_control import suite
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.monitor import Monitor

from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.envs import DM_CONTROL_TASKS
from sb3_ctco.envs.dm_control import DMControlEnv
from sb3_ctco.wrappers import find_dt

PAPER_TASKS = [("point_mass", "easy", True), ("cheetah", "run", False), ("ball_in_cup", "catch", False)]


def make(domain, task, **kwargs):
    return gym.make(f"sb3_ctco/{domain}-{task}-v0", **kwargs)


def test_every_task_of_the_suite_is_registered():
    assert {(domain, task) for domain, tasks in DM_CONTROL_TASKS.items() for task in tasks} == set(suite.ALL_TASKS)


# One task a domain, and those with unusual observations
@pytest.mark.parametrize(("domain", "task"), [(domain, tasks[0]) for domain, tasks in DM_CONTROL_TASKS.items()])
def test_tasks_run(domain, task):
    env = make(domain, task, time_limit=0.5)
    obs, _ = env.reset(seed=0)
    assert obs.dtype == np.float32
    assert env.observation_space.contains(obs)
    if domain == "lqr":  # its actions are not limited
        assert np.isinf(env.action_space.low).all()
        return
    env.action_space.seed(0)
    for _ in range(3):
        obs, reward, _, _, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs)
        assert np.isfinite(reward)
    env.close()


@pytest.mark.parametrize(("domain", "task", "sparse"), PAPER_TASKS)
def test_env_checkers(domain, task, sparse):
    env = make(domain, task, dt=0.002, time_limit=1.0, sparse=sparse)
    sb3_check_env(env, warn=True)
    gymnasium_check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("domain", "task"),
    [
        ("cheetah", "run"),
        ("ball_in_cup", "catch"),
        ("point_mass", "easy"),
        ("walker", "walk"),
        ("cartpole", "swingup"),
        ("finger", "turn_easy"),
        ("hopper", "hop"),
    ],
)
def test_trajectories_and_rewards_are_dm_controls(domain, task):
    """At dm_control's own period, step by step and as a sequence."""
    reference = suite.load(domain, task)
    env, sequence = (make(domain, task).unwrapped for _ in range(2))
    env.reset(seed=7)
    sequence.reset(seed=7)
    # The same episode in dm_control: its task draws from the same RandomState.
    reference.task._random = np.random.RandomState(np.random.default_rng(7).integers(2**32, dtype=np.uint32))
    timestep = reference.reset()
    rng = np.random.default_rng(0)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (60, *env.action_space.shape))
    rewards = []
    for action in actions:
        timestep = reference.step(action)
        obs, reward, _, _, _ = env.step(action)
        rewards.append(timestep.reward)
        assert reward == pytest.approx(timestep.reward, abs=1e-9)
        np.testing.assert_allclose(env._physics.get_state(), reference.physics.get_state(), atol=1e-9)
    flat = np.concatenate([np.ravel(value) for value in timestep.observation.values()])
    np.testing.assert_allclose(obs, flat.astype(np.float32))
    last, together, terminated, truncated, _ = sequence.step_sequence(actions)
    assert not terminated
    assert not truncated
    np.testing.assert_allclose(together, rewards, atol=1e-9)
    np.testing.assert_array_equal(last, obs)


def reward_of_arrays(env):
    """The reward of the state that the environment is in."""
    return float(env._rewards(env._data.qpos[None], env._data.sensordata[None], env._data.ctrl[None])[0])


def test_rewards_of_arrays_agree_where_they_pay():
    """Random actions rarely reach a reward, so states are set."""
    rng = np.random.default_rng(0)
    env = make("ball_in_cup", "catch").unwrapped
    env.reset(seed=0)
    paid = 0
    for _ in range(300):
        with env._physics.reset_context():
            env._data.qpos[:2] = rng.uniform(-0.2, 0.2, 2)
        with env._physics.reset_context():
            # The ball somewhere around the target in the cup
            env._data.qpos[2:] = env._physics.ball_to_target() + rng.uniform(-0.05, 0.05, 2)
        assert reward_of_arrays(env) == env._task.get_reward(env._physics)
        paid += reward_of_arrays(env)
    assert 10 < paid < 290
    env = make("point_mass", "easy").unwrapped
    env.reset(seed=0)
    values = set()
    for _ in range(100):
        with env._physics.reset_context():
            env._data.qpos[:] = env._data.geom("target").xpos[:2] + rng.uniform(-0.04, 0.04, 2)
        env._data.ctrl[:] = rng.uniform(-1.2, 1.2, 2)
        assert reward_of_arrays(env) == pytest.approx(env._task.get_reward(env._physics), abs=1e-12)
        values.add(round(reward_of_arrays(env), 1))
    assert len(values) > 5
    env = make("cheetah", "run").unwrapped
    env.reset(seed=0)
    values = set()
    for speed in np.linspace(-3, 12, 40):
        with env._physics.reset_context():
            env._data.qvel[0] = speed
        assert reward_of_arrays(env) == pytest.approx(env._task.get_reward(env._physics), abs=1e-12)
        values.add(round(reward_of_arrays(env), 3))
    assert {0.0, 1.0} < values


def test_sparse_point_mass_pays_inside_the_target_only():
    env = make("point_mass", "easy", sparse=True).unwrapped
    env.reset(seed=0)
    size = float(env._model.geom("target").size[0])
    target = env._data.geom("target").xpos
    for distance in (0.0, 0.99 * size, 1.01 * size, 3 * size):
        with env._physics.reset_context():
            env._data.qpos[:] = [target[0] + distance, target[1]]
        assert reward_of_arrays(env) == (1.0 if distance < size else 0.0)
        # dm_control's own reward goes on outside.
        if distance == 3 * size:
            assert env._task.get_reward(env._physics) > 0
    with pytest.raises(ValueError, match="no sparse reward"):
        make("cheetah", "run", sparse=True)


@pytest.mark.parametrize(("domain", "task", "sparse"), PAPER_TASKS)
@pytest.mark.parametrize("dt", [0.02, 0.01, 0.004, 0.002])
def test_any_control_period(domain, task, sparse, dt):
    env = make(domain, task, dt=dt, time_limit=0.4, sparse=sparse)
    base = env.unwrapped
    assert find_dt(env) == base.dt == dt
    env.reset(seed=0)
    own = suite.load(domain, task).physics.timestep()
    assert base._model.opt.timestep <= own + 1e-12
    assert base._model.opt.timestep * base._n_sub_steps == pytest.approx(dt)
    # Where dm_control's own step divides the period, it is kept.
    if math.isclose(dt / own, round(dt / own)):
        assert base._model.opt.timestep == pytest.approx(own)
    start = base._data.time
    steps, truncated = 0, False
    while not truncated:
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        steps += 1
        assert not terminated
    assert steps == round(0.4 / dt)
    assert base._data.time - start == pytest.approx(0.4)
    with pytest.raises(ResetNeeded):
        base.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(("domain", "task", "sparse"), PAPER_TASKS)
def test_first_states_do_not_depend_on_the_period(domain, task, sparse):
    first = [make(domain, task, dt=dt, sparse=sparse).reset(seed=3)[0] for dt in (0.02, 0.002)]
    np.testing.assert_array_equal(*first)


@pytest.mark.parametrize("action", [0.5, [0.5], [[0.5] * 6]])
def test_an_action_of_another_shape(action):
    env = gym.make("sb3_ctco/cheetah-run-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"an action must have shape \(6,\), not "):
        env.step(np.array(action, np.float32))


def test_seeds():
    env = make("cheetah", "run", dt=0.01)

    def episodes(seed):
        return [env.reset(seed=seed)[0], env.reset()[0], env.step(np.full(6, 0.3, dtype=np.float32))[0]]

    first = episodes(5)
    np.testing.assert_array_equal(first, episodes(5))
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first, episodes(6))


@pytest.mark.parametrize(("domain", "task", "sparse"), PAPER_TASKS)
def test_an_option_is_the_same_step_by_step(domain, task, sparse):
    """Through step_sequence below a Monitor, and through the loop, options have the same outcome."""
    kwargs = {"dt": 0.002, "time_limit": 1.0, "sparse": sparse}
    fast = OptionExecutionWrapper(Monitor(make(domain, task, **kwargs)), d_max=0.3)
    slow = OptionExecutionWrapper(Monitor(make(domain, task, **kwargs)), d_max=0.3)
    outcomes = []
    for env in (fast, slow):
        env.action_space.seed(1)
        env.reset(seed=1)
        if env is slow:
            env._play = env._step_in_a_loop
        outcome = []
        truncated = False
        while not truncated:
            obs, reward, _, truncated, info = env.step(env.action_space.sample())
            outcome.append((obs, reward, info["option"]["integrated_reward"], info["option"]["n_steps"]))
        outcome.append((info["episode"]["r"], info["episode"]["l"]))
        outcomes.append(outcome)
    assert len(outcomes[0]) > 3
    np.testing.assert_equal(outcomes[0], outcomes[1])
    assert outcomes[0][-1][1] == 500


@pytest.mark.parametrize(("domain", "task"), [("point_mass", "hard"), ("cheetah", "run"), ("ball_in_cup", "catch")])
@pytest.mark.parametrize("dt", [0.02, 0.002])
def test_rolled_out_options_are_those_of_dm_controls_functions(domain, task, dt):
    """Rewards, states and observations on the way, from arrays and from the task's own functions step by step."""
    fast, plain = (make(domain, task, dt=dt, time_limit=100 * dt).unwrapped for _ in range(2))
    plain._rewards = None
    rng = np.random.default_rng(0)
    for episode in range(3):
        np.testing.assert_array_equal(fast.reset(seed=episode)[0], plain.reset(seed=episode)[0])
        for n_steps in (1, 40, 59):
            actions = np.repeat(rng.uniform(-1, 1, (n_steps // 10 + 1, *fast.action_space.shape)), 10, axis=0)[:n_steps]
            observe = sorted({*rng.integers(1, n_steps, 5).tolist()}) if n_steps > 1 else []
            (obs, rewards, *end, info), (obs2, rewards2, *end2, info2) = (
                env.step_sequence(actions, observe) for env in (fast, plain)
            )
            np.testing.assert_array_equal(obs, obs2)
            np.testing.assert_allclose(rewards, rewards2, rtol=0, atol=1e-9)
            np.testing.assert_allclose(fast._physics.get_state(), plain._physics.get_state(), rtol=0, atol=1e-9)
            np.testing.assert_array_equal(info.get("observations", []), info2.get("observations", []))
            assert len(info.get("observations", [])) == len(observe)
            assert end == end2
        assert end == [False, True]


@pytest.mark.parametrize(("domain", "task"), [("point_mass", "easy"), ("cheetah", "run"), ("ball_in_cup", "catch")])
@pytest.mark.parametrize("inputs", ["xfrc_applied", "qfrc_applied"])
def test_external_forces_push(domain, task, inputs):
    """As in dm_control's own functions step by step, and no longer than they are set."""
    fast, plain, free = (make(domain, task, dt=0.01, time_limit=2.0).unwrapped for _ in range(3))
    plain._rewards = None
    for env in (fast, plain, free):
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for force in (1.0, 0.0, 1.0):
        actions = rng.uniform(-1, 1, (40, *fast.action_space.shape))
        for env in (fast, plain):
            forces = getattr(env._data, inputs)
            forces[...] = 0.0
            forces[(-1, 0) if inputs == "xfrc_applied" else -1] = force
        (obs, rewards, *_), (obs2, rewards2, *_) = (env.step_sequence(actions) for env in (fast, plain))
        free.step_sequence(actions)
        np.testing.assert_allclose(obs, obs2, rtol=0, atol=1e-6)
        np.testing.assert_allclose(rewards, rewards2, rtol=0, atol=1e-9)
        assert getattr(fast._data, inputs).sum() == force
    assert np.abs(fast._data.qpos - free._data.qpos).max() > 1e-3


def test_the_same_seed_is_the_same_world():
    """dm_control draws lqr's stiffnesses and dampings where it makes the model."""
    one, other = (make("lqr", "lqr_6_2").unwrapped for _ in range(2))
    np.testing.assert_array_equal(one._model.jnt_stiffness, other._model.jnt_stiffness)
    np.testing.assert_array_equal(one._model.dof_damping, other._model.dof_damping)
    starts = [env.reset(seed=3)[0] for env in (one, other)]
    np.testing.assert_array_equal(*starts)
    ends = [env.step_sequence(np.ones((20, 2)))[0] for env in (one, other)]
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"dt": 0.0}, "dt"), ({"time_limit": -1.0}, "time_limit"), ({"render_mode": "human"}, "render_mode")],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        DMControlEnv("point_mass", "easy", **kwargs)


def test_unknown_task():
    with pytest.raises(ValueError, match="does not exist"):
        DMControlEnv("point_mass", "difficult")


def test_a_diverging_simulation_is_reported_and_needs_a_reset():
    env = OptionExecutionWrapper(make("point_mass", "easy"))
    env.reset(seed=0)
    env.unwrapped._data.qvel[:] = 1e300
    with pytest.raises(Exception, match=r"[Pp]hysics|unstable|BAD"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.step(np.ones(5))
    with pytest.raises(ResetNeeded):
        env.step(np.ones(5))


def test_shimmys_environments_work_under_the_wrapper():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gym.register_envs(shimmy)
        env = gym.make("dm_control/ball_in_cup-catch-v0")
        assert find_dt(env) == pytest.approx(0.02)
        model = CTCO(
            "MultiInputPolicy",
            env,
            policy_kwargs={"net_arch": [8]},
            learning_starts=50,
            gradient_steps=1,
            n_sub_options=0,
            buffer_size=1000,
        )
        model.learn(150)
    assert model.num_timesteps >= 150
    assert model.replay_buffer.pos == model._n_updates + sum(model.replay_buffer.durations.cumsum() <= 1.0)
