"""Options that leave from the action that is being sent: plans, wrapper, sub-options, controller, files, real time."""

import copy
import itertools
import json
import math

import gymnasium as gym
import numpy as np
import onnx
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ctco import CTCO, FiGARSAC, OptionController, OptionExecutionWrapper
from sb3_ctco.checkpoint import load_checkpoint, save_checkpoint
from sb3_ctco.controller import ModelPolicy
from sb3_ctco.evaluation import evaluate_discounted_return, largest_jump, mean_absolute_jerk
from sb3_ctco.export import export_onnx
from sb3_ctco.exported import METADATA_KEY, OnnxPolicy
from sb3_ctco.options import (
    JOINS,
    LAST_ACTION,
    TRAJECTORIES,
    ActionBox,
    BezierCurve,
    OptionSpace,
    RadialBasis,
    with_last_action_space,
)
from sb3_ctco.safety import Safety
from sb3_ctco.vec_env import AsyncOptionVecEnv
from sb3_ctco.wrappers import RealTimeOptionWrapper

KINDS = TRAJECTORIES.values()
JOINED = JOINS[1:]
POLICIES = {"vector": "MlpPolicy", "image": "MultiInputPolicy", "dict": "MultiInputPolicy"}
SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "device": "cpu", "seed": 0, "buffer_size": 2000}


def joined(env, **kwargs):
    return OptionExecutionWrapper(env, **{"n_rbf": 2, "d_max": 1.5, "join": "continuous", **kwargs})


# --- plans


def test_plans_by_hand():
    # One weight: from 0 to 1 in a straight line, whatever the trajectory; the phases are 1/4, 2/4, 3/4 and 1.
    for kind in KINDS:
        np.testing.assert_allclose(kind(1).plan([[1.0]], 4, [0.0])[:, 0], [0.25, 0.5, 0.75, 1.0])
    # Control points 0, 1, −1: 2x(1−x) − x² at x = 1/2 and 1
    np.testing.assert_allclose(BezierCurve(2).plan([[1.0, -1.0]], 2, [0.0])[:, 0], [0.25, -1.0])
    # Halfway the action before counts (1/2)², and of the rest each of two bumps has half.
    np.testing.assert_allclose(RadialBasis(2).plan([[0.8, 0.4]], 2, [-1.0])[0], [-0.25 + 0.75 * 0.6])
    # Of two points before, the second counts 2x(1−x) beside one weight.
    for kind in KINDS:
        np.testing.assert_allclose(kind(1).plan([[1.0]], 2, [[-1.0], [0.0]])[:, 0], [-0.25 + 0.25, 1.0])


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_a_smooth_plan_by_hand(trajectory):
    """Actions have come to 0 by 0.1 a step. In half of four steps that leads to 0.2: 2x(1−x)·0.2 + x² with a weight of 1."""
    space = OptionSpace.make(1, 0.4, 0.2, 0.1, 0.4, trajectory, join="smooth")
    # As steep as an option gets is twice from −1 to 1 in two steps.
    before = space.before(np.array([[-0.1], [0.0]]))[0]
    np.testing.assert_allclose(before, [0.0, 0.1 / 2.0])
    option = space.encode(np.array([[[1.0]]]), np.array([4]))[0].astype(np.float64)
    plan = space.plan(option, before)[:, 0]
    np.testing.assert_allclose(plan, [0.1375, 0.35, 0.6375, 1.0])
    # The step grows by 0.075 within the option, and by half of that at the join.
    np.testing.assert_allclose(np.diff([-0.1, 0.0, *plan], 2), [0.0375, 0.075, 0.075, 0.075])
    # Towards a bound it leads no further than that: from 0.95 to 1 in place of 1.15.
    plan = space.plan(option, space.before(np.array([[0.85], [0.95]]))[0])[:, 0]
    np.testing.assert_allclose(plan[1], 0.25 * 0.95 + 0.5 * 1.0 + 0.25 * 1.0)
    # What is steeper than an option counts as such: the plan depends on what the observation can tell.
    np.testing.assert_allclose(space.before(np.array([[1.0], [-1.0], [1.0]])), [[-1.0, -1.0], [1.0, 1.0]])
    steep = OptionSpace.make(1, 0.4, 0.4, 0.1, 0.4, trajectory, join="smooth")
    np.testing.assert_allclose(steep.before(np.array([[1.0], [-1.0], [0.5]])), [[-1.0, -1.0], [0.5, 1.0]])


@pytest.mark.parametrize("kind", KINDS)
@given(
    omega=hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(1, 5)), elements=st.floats(-1, 1)),
    start=st.lists(st.floats(-1, 1), min_size=1, max_size=2),
    n_steps=st.integers(1, 200),
)
def test_a_plan_is_a_mixture_of_its_weights_and_the_points_before(kind, omega, start, n_steps):
    trajectory, start = kind(omega.shape[1]), np.tile(np.array(start)[:, None], len(omega))
    plan = trajectory.plan(omega, n_steps, start)
    assert plan.shape == (n_steps, len(omega))
    everything = np.vstack([start, omega.T])
    assert (plan <= everything.max(axis=0) + 1e-12).all()
    assert (plan >= everything.min(axis=0) - 1e-12).all()
    # At phase 0 it is the action before.
    at_start = trajectory.joined_basis(np.zeros(1), len(start))
    np.testing.assert_array_equal(at_start, np.eye(1, len(start) + omega.shape[1]))


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@given(
    omega=hnp.arrays(np.float64, (2, 3), elements=st.floats(-1, 1)),
    sent=hnp.arrays(np.float64, (2, 2), elements=st.floats(-1, 1)),
    n_steps=st.integers(2, 40),
)
def test_smooth_plans_stay_in_the_box(trajectory, omega, sent, n_steps):
    space = OptionSpace.make(3, 0.4, 0.02, 0.01, 0.4, trajectory, join="smooth")
    option = space.encode(omega[None], np.array([n_steps]))[0].astype(np.float64)
    assert np.abs(space.plan(option, space.before(sent)[0])).max() <= 1.0 + 1e-12


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_the_bend_at_a_smooth_join_shrinks_with_dt_as_those_within_do(trajectory):
    """Twice as many steps quarter how much a step differs from the one before, also at joins; with continuous joins only
    halve. Weights are small, so that no slope would lead out of the box."""
    omegas = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2, 3))
    bends: dict[str, list[np.ndarray]] = {join: [] for join in JOINED}
    for n_steps, join in itertools.product((50, 100, 200), JOINED):
        space = OptionSpace.make(3, 1.0, 0.5, 1.0 / n_steps, 0.4, trajectory, join=join)
        sent = np.zeros((2, 2))
        for omega in omegas:
            option = space.encode(omega[None], np.array([n_steps]))[0].astype(np.float64)
            sent = np.vstack([sent, space.plan(option, space.before(sent[-2:])[0])])
        assert np.abs(sent).max() < 0.9
        bends[join].append(np.abs(np.diff(sent, 2, axis=0)).max(axis=1).reshape(20, n_steps))
    for coarse, fine in itertools.pairwise(bends["smooth"]):
        assert fine.max() == pytest.approx(coarse.max() / 4, rel=0.1)
        assert fine[:, 0].max() == pytest.approx(coarse[:, 0].max() / 4, rel=0.1)
        # Half of what a step differs from the one before after the join.
        assert fine[1:, 0].max() < 0.7 * fine[:, 1:].max()
    for coarse, fine in itertools.pairwise(bends["continuous"]):
        assert fine[:, 0].max() == pytest.approx(coarse[:, 0].max() / 2, rel=0.1)
        assert fine[1:, 0].max() > 5 * fine[:, 1:].max()


@pytest.mark.parametrize("kind", KINDS)
def test_the_step_at_a_join_shrinks_with_dt_as_those_within_do(kind):
    """Twice as many steps for the same options halve the largest step, which is not at a join."""
    omegas = np.random.default_rng(0).uniform(-1, 1, (20, 2, 3))
    largest, ratio = [], []
    for n_steps in (50, 100, 200, 400):
        plans, action = [], np.zeros(2)
        for omega in omegas:
            plans.append(kind(3).plan(omega, n_steps, action))
            action = plans[-1][-1]
        steps = np.abs(np.diff(np.vstack([np.zeros((1, 2)), *plans]), axis=0)).max(axis=1).reshape(20, n_steps)
        largest.append(steps.max())
        ratio.append(steps[1:, 0].max() / steps[:, 1:].max())
        assert largest[-1] == largest_jump(np.vstack([np.zeros((1, 2)), *plans]))
    for coarse, fine in itertools.pairwise(largest):
        assert fine == pytest.approx(coarse / 2, rel=0.1)
    assert max(ratio) < 1.1
    # Options that begin anywhere jump by the same however small dt is.
    free = [np.vstack([kind(3).plan(omega, n) for omega in omegas]) for n in (50, 400)]
    assert largest_jump(free[1]) > 0.9 * largest_jump(free[0]) > 0.5


def test_the_shortest_option_bounds_how_fast_actions_change():
    """A Bézier curve of n + 1 points in [−1, 1] is no steeper than 2n over its duration."""
    rng, n_steps = np.random.default_rng(0), 20
    for _ in range(200):
        start = rng.choice([-1.0, 1.0], 1)
        plan = np.vstack([start, BezierCurve(3).plan(rng.choice([-1.0, 1.0], (1, 3)), n_steps, start)])
        assert largest_jump(plan) <= 2 * 3 / n_steps + 1e-12


# --- fits


@pytest.mark.parametrize("kind", KINDS)
@given(
    omega=hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(1, 4)), elements=st.floats(-1, 1)),
    start=st.lists(st.floats(-1, 1), min_size=1, max_size=2),
    n_steps=st.integers(1, 60),
)
def test_a_fit_over_the_whole_option_returns_its_weights(kind, omega, start, n_steps):
    trajectory, start = kind(omega.shape[1]), np.tile(np.array(start)[:, None], len(omega))
    plan = trajectory.plan(omega, n_steps, start)
    [fitted], [residual] = trajectory.fit(plan, np.array([0]), np.array([n_steps]), start[None])
    if n_steps >= omega.shape[1]:
        assert residual < 1e-9
    if n_steps >= 2 * omega.shape[1]:
        np.testing.assert_allclose(fitted, omega, atol=1e-6)


def test_a_stretch_leaves_from_the_action_before_its_first_step():
    # From 0 to 1 in ten steps of 0.1: the steps 3 to 6 go from 0.3 to 0.7, so one weight of 0.7 plays them.
    trajectory = BezierCurve(1)
    plan = trajectory.plan([[1.0]], 10, [0.0])
    omega, residuals = trajectory.fit(plan, np.array([3, 0, 9]), np.array([7, 1, 10]), np.array([[0.3], [0.0], [0.9]]))
    np.testing.assert_allclose(omega[:, 0, 0], [0.7, 0.1, 1.0])
    np.testing.assert_allclose(residuals, 0.0, atol=1e-12)


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(1, 2), st.integers(1, 4)), elements=st.floats(-1, 1)),
    st.floats(-1, 1),
    st.lists(st.tuples(st.integers(0, 29), st.integers(1, 30)), min_size=1),
)
def test_stretches_of_bezier_curves_are_exact(omega, start, stretches):
    trajectory, start = BezierCurve(omega.shape[1]), np.full(len(omega), start)
    plan = trajectory.plan(omega, 30, start)
    firsts, lengths = np.array(stretches).T
    ends = np.minimum(firsts + lengths, 30)
    starts = np.vstack([start, plan])[firsts]
    fitted, residuals = trajectory.fit(plan, firsts, ends, starts)
    for first, end, before, weights, residual in zip(firsts, ends, starts, fitted, residuals, strict=True):
        played = trajectory.plan(weights, end - first, before)
        assert np.abs(played - plan[first:end]).max() == pytest.approx(residual, abs=1e-12)
        if end - first >= omega.shape[1]:
            assert residual < 1e-8


def test_a_stretch_leaves_towards_where_the_slope_leads():
    """Stretches of lines go on as they were, and of curves as they were before the stretch, which is a little off."""
    space = OptionSpace.make(2, 1.0, 0.1, 0.1, 0.4, "bezier", join="smooth")
    line = np.linspace(-0.5, 0.5, 11)[:, None]
    option, residual = space.closest(line[3:], space.before(line[1:3])[0])
    assert residual < 1e-12
    np.testing.assert_allclose(option[:2], [-0.3 + 0.8 * 2 / 3, 0.5], atol=1e-6)
    residuals = []
    for dt in (0.1, 0.05, 0.025):
        space = OptionSpace.make(2, 1.0, 0.1, dt, 0.4, "bezier", join="smooth")
        sent = np.sin(np.arange(0.0, 1.0, dt))[:, None] * 0.9
        half = len(sent) // 2
        residuals.append(space.closest(sent[half:], space.before(sent[half - 2 : half])[0])[1])
    assert residuals[0] < 0.01
    assert residuals[2] < 0.5 * residuals[0]


@pytest.mark.parametrize("n_before", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_canonical_weights_play_the_same_from_any_action(kind, n_before):
    trajectory, rng = kind(3), np.random.default_rng(0)
    matrices = trajectory.canonical(n_before)
    for n_steps in (1, 2, 3, 4):
        matrix = matrices[min(n_steps, 3) - 1]
        omega, start = rng.uniform(-1, 1, (2, 3)), rng.uniform(-1, 1, (n_before, 2))
        canonical = omega @ matrix.T
        np.testing.assert_allclose(
            trajectory.plan(canonical, n_steps, start), trajectory.plan(omega, n_steps, start), atol=1e-9
        )
        felt = trajectory.joined_basis((np.arange(n_steps) + 1) / n_steps, n_before)[:, n_before:]
        free = np.eye(3) - np.linalg.pinv(felt) @ felt
        np.testing.assert_allclose((omega + rng.normal(size=(2, 3)) @ free) @ matrix.T, canonical, atol=1e-9)
    # One step: all weights are the action.
    np.testing.assert_allclose(omega @ matrices[0].T, trajectory.plan(omega, 1, start).T.repeat(3, axis=1), atol=1e-9)


def test_settings():
    space = OptionSpace.make(2, 0.5, 0.1, 0.1, 0.4, join="continuous")
    assert OptionSpace.make(**space.arguments) == space
    free = OptionSpace.make(2, 0.5, 0.1, 0.1, 0.4)
    assert space.differences(free) == {"join": ("continuous", "free")}
    with pytest.raises(ValueError, match=r"join must be one of \('free', 'continuous', 'smooth'\), not 'sticky'"):
        OptionSpace.make(**{**space.arguments, "join": "sticky"})
    with pytest.raises(ValueError, match="depends on the action before"):
        space.plan(np.zeros(3))
    with pytest.raises(ValueError, match="depends not on the action before"):
        free.plan(np.zeros(3), np.zeros(1))


def test_actions_are_normalised():
    box = ActionBox(np.array([-2.0, 0.0, 1.0], np.float32), np.array([2.0, 10.0, 1.0], np.float32))
    np.testing.assert_allclose(box.normalise([[1.0, 7.5, 1.0], [-2.0, 10.0, 1.0]]), [[0.5, 0.5, 0.0], [-1, 1, 0]])
    matrix = ActionBox(np.full((2, 3), -3.0), np.full((2, 3), 1.0))
    trajectory = np.random.default_rng(0).uniform(-1, 1, (4, 6))
    np.testing.assert_allclose(matrix.normalise(matrix.actions(trajectory)), trajectory, atol=1e-12)


# --- the wrapper


def test_an_episode_by_hand(scripted_env):
    """One weight and four steps: straight lines from 0 to 1, and from there to −1. The episode ends in the second."""
    env = joined(scripted_env(truncate_at=6, action_space=spaces.Box(-2.0, 2.0, (1,), np.float32)), n_rbf=1, d_max=0.4)
    assert env.observation_space == spaces.Box(np.float32([-1e6, -1e6, -1.0]), np.float32([1e6, 1e6, 1.0]))
    obs, _ = env.reset()
    np.testing.assert_array_equal(obs, [0, 0, 0])
    np.testing.assert_allclose(env.plan([1.0, 1.0])[:, 0], [0.5, 1.0, 1.5, 2.0])
    obs, *_ = env.step([1.0, 1.0])
    np.testing.assert_allclose(np.ravel(env.unwrapped.actions), [0.5, 1.0, 1.5, 2.0])
    # Observed are the steps, the action in its units, and normalised.
    np.testing.assert_allclose(obs, [4, 2, 1])
    assert obs.dtype == np.float32
    obs, _, _, truncated, _ = env.step([-1.0, 1.0])
    np.testing.assert_allclose(np.ravel(env.unwrapped.actions)[4:], [1.0, 0.0])
    np.testing.assert_allclose(env.played[:, 0], [1.0, 0.0])
    np.testing.assert_allclose(obs, [6, 0, 0])
    assert truncated
    np.testing.assert_array_equal(env.reset()[0], [0, 0, 0])


def test_a_smooth_episode_by_hand(scripted_env):
    """Of one weight and four steps, the plan of test_a_smooth_plan_by_hand, twice, and with the units of the environment."""
    env = joined(
        scripted_env(action_space=spaces.Box(-2.0, 2.0, (1,), np.float32)), n_rbf=1, d_max=0.4, d_min=0.4, join="smooth"
    )
    assert env.observation_space == spaces.Box(np.float32([-1e6, -1e6, -1, -1]), np.float32([1e6, 1e6, 1, 1]))
    np.testing.assert_array_equal(env.reset()[0], [0, 0, 0, 0])
    # From rest at 0: 0.5·x². The last step is of 0.5 − 0.28125, and the steepest 4 in four steps.
    obs, *_ = env.step([0.5, 1.0])
    np.testing.assert_allclose(np.ravel(env.played), 2 * 0.5 * np.array([1, 4, 9, 16]) / 16)
    np.testing.assert_allclose(obs, [4, 1.0, 0.5, 0.21875])
    # In half of four steps that leads to 0.5 + 2·0.21875.
    obs, *_ = env.step([-1.0, 1.0])
    np.testing.assert_allclose(env.played[1, 0], 2 * (0.25 * 0.5 + 0.5 * 0.9375 - 0.25))
    third = 0.0625 * 0.5 + 2 * 0.75 * 0.25 * 0.9375 - 0.5625
    np.testing.assert_allclose(obs, [8, -2.0, -1.0, -1.0 - third])
    # An episode begins at rest.
    np.testing.assert_array_equal(env.reset()[0], [0, 0, 0, 0])
    env.step([0.5, 1.0])
    np.testing.assert_allclose(env.played[0, 0], 2 * 0.5 / 16)


def test_a_slope_over_options_of_one_step(scripted_env):
    env = joined(scripted_env(), n_rbf=1, d_max=0.1, d_min=0.1, join="smooth")
    env.reset()
    seen = [env.step([weight, 0.0])[0][2:] for weight in (0.5, 0.25, 1.0)]
    np.testing.assert_allclose(seen, [[0.5, 0.125], [0.25, -0.0625], [1.0, 0.1875]])


def test_an_environment_may_say_what_is_being_sent(scripted_env):
    class Env(scripted_env):
        def reset(self, **kwargs):
            return super().reset(**kwargs)[0], {LAST_ACTION: np.array([0.5])}

    env = joined(Env(), n_rbf=1, d_max=0.2)
    np.testing.assert_array_equal(env.reset()[0], [0, 0, 0.5])
    env.step([1.0, 1.0])
    np.testing.assert_allclose(np.ravel(env.unwrapped.actions), [0.75, 1.0])
    np.testing.assert_array_equal(joined(Env(), join="smooth").reset()[0], [0, 0, 0.5, 0])


@pytest.mark.parametrize("n_sub_options", [0, 4])
def test_an_environment_may_send_something_else(scripted_env, n_sub_options):
    class Limited(scripted_env):
        def step(self, action):
            *result, info = super().step(np.minimum(action, 0.5))
            return *result, {**info, LAST_ACTION: self.actions[-1]}

    env = joined(Limited(), n_rbf=1, d_max=0.4, n_sub_options=n_sub_options)
    env.reset(seed=0)
    obs, *_, info = env.step([1.0, 1.0])
    assert obs[-1] == 0.5
    if n_sub_options:
        assert (info["sub_options"].seen[-1] == obs).all()
    np.testing.assert_allclose(env.plan([1.0, 1.0])[:, 0], [0.625, 0.75, 0.875, 1.0])
    # The slope is of what was sent: 0.25, 0.5, 0.5 and 0.5 with this option, which grows by 1/4, by 3/4 or not at all.
    env = joined(Limited(), n_rbf=1, d_max=0.4, n_sub_options=n_sub_options, sub_option_tolerance=9.0, join="smooth")
    obs, _ = env.reset(seed=0)
    sent, found = [0.0, 0.0], 0
    for weight in (1.0, 0.5, -1.0, 0.0):
        before, first = obs, len(sent) - 1
        obs, *_, info = env.step([weight, 1.0])
        sent = [0.0, 0.0, *np.ravel(env.unwrapped.actions)]
        steepest = 2 * 2 * 0.1 / env.option_space.d_min
        np.testing.assert_allclose(obs[2:], [sent[-1], (sent[-1] - sent[-2]) / steepest], atol=1e-6)
        if n_sub_options:
            seen = info["sub_options"].seen
            np.testing.assert_array_equal(seen[[0, -1]], [before, obs])
            for row in seen:
                last, one_before = sent[int(row[0]) + 1], sent[int(row[0])]
                np.testing.assert_allclose(row[2:], [last, (last - one_before) / steepest], atol=1e-6)
                found += first < int(row[0]) + 1 < len(sent) - 1
    assert found > 3 or not n_sub_options


@pytest.mark.parametrize("join", JOINED)
@pytest.mark.parametrize("kind", ["vector", "image", "dict"])
def test_where_observations_hold_it(random_walk_env, kind, join):
    env = joined(random_walk_env(kind), join=join)
    gymnasium_check_env(env, skip_render_check=True)
    env.reset(seed=0)
    obs, *_ = env.step([0.5, -0.25, -1.0])
    if kind == "vector":
        last = obs[2:]
    else:
        assert set(obs) == {"image": {"observation"}, "dict": {"image", "vector"}}[kind] | {LAST_ACTION}
        last = obs[LAST_ACTION]
    assert last.shape == ({"continuous": 1, "smooth": 2}[join],)
    np.testing.assert_allclose(last[:1], env.played[-1] / 2.0, rtol=1e-6)


def test_an_entry_of_that_name_is_refused():
    space = spaces.Dict({LAST_ACTION: spaces.Box(-1, 1, (2,))})
    with pytest.raises(ValueError, match="the environment's have one of that name"):
        with_last_action_space(space, 2)


def test_a_free_join_is_what_it_was(random_walk_env):
    """With the same option vectors: the weights alone say where actions begin, and observations are the environment's."""
    env = OptionExecutionWrapper(random_walk_env(), n_rbf=2, d_max=1.5, trajectory="rbf", duration_scale="linear")
    inside = random_walk_env()
    assert env.observation_space == inside.observation_space
    env.reset(seed=0)
    option = np.array([0.5, -0.25, 0.0])
    env.step(option)
    np.testing.assert_array_equal(env.played, 2 * RadialBasis(2).plan([[0.5, -0.25]], 8).astype(np.float32))


@pytest.mark.parametrize("join", JOINED)
@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_sub_options_leave_from_the_action_before_them(random_walk_env, trajectory, join):
    kwargs = {"n_rbf": 3, "trajectory": trajectory, "n_sub_options": 8, "sub_option_tolerance": 2.0, "join": join}
    env = joined(random_walk_env(), **kwargs)
    env.action_space.seed(0)
    residuals = []
    for _ in range(20):
        env.reset(seed=0)
        done, sent = False, [0.0, 0.0]
        while not done:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            done, sub = terminated or truncated, info["sub_options"]
            sent.extend(env.played[:, 0] / 2.0)
            # An observation's second entry is the step within the episode, over 20, and its last one the action before.
            first, end = (np.rint(20 * obs[:, 1]).astype(int) for obs in (sub.observations, sub.next_observations))
            before = env.option_space.before(np.array(sent)[:, None])
            np.testing.assert_allclose(sub.observations[:, 2:], before[first], atol=1e-6)
            np.testing.assert_allclose(sub.next_observations[:, 2:], before[end], atol=1e-6)
            for i, option in enumerate(sub.options.astype(np.float64)):
                again = env.option_space.plan(option, sub.observations[i, 2:].astype(np.float64))[:, 0]
                assert len(again) == end[i] - first[i]
                error = np.abs(again - sent[first[i] + 2 : end[i] + 2]).max()
                assert error == pytest.approx(sub.residuals[i], abs=2e-6)
                residuals.append(error if len(again) >= 3 else 0.0)
    assert len(residuals) > 200
    # Part of a polynomial is one of the same degree, from any action, and at its own slope, from which the last step differs.
    assert max(residuals) < (1e-5 if trajectory == "bezier" and join == "continuous" else 0.2)
    assert np.mean(residuals) < (0.01 if trajectory == "bezier" else 0.02)


def test_an_entry_of_one_value_refuses_no_sub_option(scripted_env):
    env = scripted_env()
    env.action_space = spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([1.0, 2.0], np.float32))
    wrapper = OptionExecutionWrapper(env, n_rbf=3, d_min=0.3, d_max=3.0, join="continuous", n_sub_options=20)
    wrapper.reset()
    *_, info = wrapper.step(np.ones(7))
    assert len(info["sub_options"]) > 5
    assert info["sub_options"].residuals.max() < 1e-5


def test_time_that_a_free_join_does_not_spend(random_walk_env):
    """Nothing is normalised where nobody needs it."""
    env = OptionExecutionWrapper(random_walk_env())
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env._before is None


# --- learning


@pytest.mark.parametrize(
    ("kind", "join"), [("vector", "continuous"), ("image", "continuous"), ("dict", "continuous"), ("dict", "smooth")]
)
def test_learns_from_each_kind_of_observation(random_walk_env, tmp_path, kind, join):
    env = random_walk_env(kind)
    model = CTCO(POLICIES[kind], env, join=join, d_max=0.5, learning_starts=50, gradient_steps=1, **SMALL).learn(80)
    assert model._n_updates > 5
    assert model.replay_buffer.size() > 1.5 * model.replay_buffer.n_decisions
    model.save(tmp_path / "model.zip")
    loaded = CTCO.load(tmp_path / "model.zip", env=random_walk_env(kind), device="cpu")
    assert loaded.option_space == model.option_space
    obs = loaded.get_env().reset()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0].vector, model.predict(obs, deterministic=True)[0].vector
    )
    loaded.learn(20, reset_num_timesteps=False)
    with pytest.raises(ValueError, match=r"'join': 'free'.*cannot be changed while loading"):
        CTCO.load(tmp_path / "model.zip", join="free")


def test_settings_of_model_and_environment_agree(random_walk_env):
    with pytest.raises(ValueError, match="the environment's options have join=continuous, CTCO has join=free"):
        CTCO("MlpPolicy", joined(random_walk_env(), n_rbf=2, d_max=0.5), d_max=0.5, **SMALL)
    arguments = {"join": "continuous", "gamma": 0.98, "gamma_dt": 0.05, "d_max": 0.4}
    assert CTCO.wrapper_kwargs(arguments)["join"] == "continuous"
    figar = {"gamma": 0.98, "gamma_dt": 0.05, "d_max": 0.4, "n_repetitions": None, "dt": None}
    assert FiGARSAC.wrapper_kwargs(figar)["join"] == "free"


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, AsyncOptionVecEnv])
def test_several_environments(random_walk_env, vec_env_cls):
    kwargs = {"d_max": 0.5, "join": "continuous"}
    env = make_vec_env(
        random_walk_env, 2, wrapper_class=OptionExecutionWrapper, wrapper_kwargs=kwargs, vec_env_cls=vec_env_cls, seed=0
    )
    model = CTCO("MlpPolicy", env, join="continuous", d_max=0.5, learning_starts=50, gradient_steps=1, **SMALL).learn(150)
    assert model._n_updates > 0
    # An episode begins with the middle of the box.
    steps = model.replay_buffer.observations[: model.replay_buffer.pos, 0, 1]
    last = model.replay_buffer.observations[: model.replay_buffer.pos, 0, 2]
    assert (last[steps == 0] == 0).all()
    assert (np.abs(last[steps > 0]) > 0).mean() > 0.9
    episodes = evaluate_discounted_return(model, env, 4, smoothness=True)
    assert all(0.0 < episode.largest_jump < math.inf for episode in episodes)
    env.close()


@pytest.mark.parametrize("join", JOINED)
def test_a_training_goes_on_in_the_middle_of_an_episode(random_walk_env, tmp_path, join):
    def make(env):
        return CTCO("MlpPolicy", env, join=join, d_max=0.5, learning_starts=20, **SMALL)

    model = make(random_walk_env()).learn(33)
    save_checkpoint(model, tmp_path / "checkpoint")
    model.learn(40, reset_num_timesteps=False)
    loaded = load_checkpoint(CTCO, tmp_path / "checkpoint", random_walk_env(), device="cpu")
    loaded.learn(40, reset_num_timesteps=False)
    for name in ("observations", "actions"):
        np.testing.assert_array_equal(getattr(loaded.replay_buffer, name), getattr(model.replay_buffer, name))


def test_smoothness_of_a_policy(random_walk_env):
    """Of the same weights, the actions of continuous joins have a smaller largest jump and jerk."""
    found = {}
    for join in ("free", "continuous"):
        env = OptionExecutionWrapper(gym.make("Pendulum-v1"), n_rbf=2, d_min=0.5, d_max=0.5, join=join)
        model = CTCO("MlpPolicy", env, n_rbf=2, d_min=0.5, d_max=0.5, join=join, buffer_size=10, seed=0, device="cpu")
        env.reset(seed=0)
        found[join] = evaluate_discounted_return(model, env, 1, deterministic=False, smoothness=True)[0]
    assert found["continuous"].largest_jump < 0.6 * found["free"].largest_jump
    assert found["continuous"].mean_absolute_jerk < found["free"].mean_absolute_jerk


def test_largest_jump_by_hand():
    assert largest_jump([[0.0, 1.0], [0.5, 0.75], [0.25, 0.0]]) == 0.75
    assert np.isnan(largest_jump([[0.0]]))


@pytest.mark.slow
@pytest.mark.parametrize("join", JOINED)
def test_pendulum_is_learned(join):
    model = CTCO(
        "MlpPolicy",
        "Pendulum-v1",
        join=join,
        learning_rate=1e-3,
        learning_starts=500,
        batch_size=128,
        updates_per_second=20,
        n_rbf=2,
        d_max=0.3,
        high_freq_penalty=0.01,
        ent_coef="auto_0.1",
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
        device="cpu",
    ).learn(6_000)
    env = model.wrap_env(gym.make("Pendulum-v1"))
    env.reset(seed=100)
    episodes = evaluate_discounted_return(model, env, 10)
    assert np.mean([episode.episode_return for episode in episodes]) > -300


# --- the controller


def trained(env, policy="MlpPolicy", **kwargs):
    model = CTCO(policy, env, **{**SMALL, "join": "continuous", "n_rbf": 3, "d_max": 0.37, **kwargs})
    # Untrained actors ask for weights near 0.
    weights = model.actor.omega_head.bias.data[: model.actor.omega_dim]
    weights.copy_(th.linspace(1.5, -1.0, len(weights)))
    return model


def through_wrapper(model, env, n_steps):
    wrapped = model.wrap_env(env)
    obs, _ = wrapped.reset(seed=5)
    actions = []
    while sum(map(len, actions)) < n_steps:
        obs, _, terminated, truncated, _ = wrapped.step(model.predict(obs, deterministic=True)[0])
        actions.append(wrapped.played)
        if terminated or truncated:
            obs, _ = wrapped.reset()
    return np.concatenate(actions)[:n_steps]


def through_controller(controller, env, n_steps, clock=False):
    obs, _ = env.reset(seed=5)
    actions, now = [], 0.0
    for _ in range(n_steps):
        actions.append(controller(obs, now if clock else None))
        now += controller.dt
        obs, _, terminated, truncated, _ = env.step(actions[-1])
        if terminated or truncated:
            controller.reset()
            obs, _ = env.reset()
    return np.array(actions)


@pytest.mark.parametrize("join", JOINED)
@pytest.mark.parametrize(("kind", "trajectory"), [("vector", "rbf"), ("vector", "bezier"), ("image", "rbf"), ("dict", "rbf")])
def test_the_controller_plays_what_the_wrapper_does(random_walk_env, kind, trajectory, join):
    model = trained(random_walk_env(kind), POLICIES[kind], trajectory=trajectory, join=join)
    expected = through_wrapper(model, random_walk_env(kind), 50)
    assert np.ptp(expected) > 0.5
    np.testing.assert_array_equal(through_controller(OptionController(model), random_walk_env(kind), 50), expected)
    by_clock = through_controller(OptionController(model, safety=None), random_walk_env(kind), 50, clock=True)
    np.testing.assert_allclose(by_clock, expected, atol=1e-5)


@pytest.mark.parametrize("join", JOINED)
@pytest.mark.parametrize("kind", ["vector", "image", "dict"])
def test_several_robots(random_walk_env, kind, join):
    """Each leaves from its own action, also after one of them was reset."""
    model = trained(random_walk_env(kind), POLICIES[kind], join=join)
    together, alone = OptionController(model), [OptionController(model) for _ in range(3)]
    space = random_walk_env(kind).observation_space
    space.seed(0)
    for tick in range(20):
        if tick == 9:
            together.reset([1])
            alone[1].reset()
        observations = [space.sample() for _ in range(3)]
        stacked = (
            {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
            if kind == "dict"
            else np.stack(observations)
        )
        expected = [controller(obs) for controller, obs in zip(alone, observations, strict=True)]
        np.testing.assert_allclose(together(stacked), expected, atol=1e-5)


def test_the_first_option_leaves_from_what_is_being_sent(random_walk_env):
    model = trained(random_walk_env(), n_rbf=1, d_min=0.4, d_max=0.4)
    controller = OptionController(model)
    controller.reset(last_action=np.array([2.0]))
    obs, _ = random_walk_env().reset(seed=0)
    actions = [float(controller(obs)[0]) for _ in range(4)]
    # A straight line from 2 to the fourth action
    np.testing.assert_allclose(actions, np.linspace(2.0, actions[-1], 5)[1:], atol=1e-6)
    controller.reset()
    actions = [float(controller(obs)[0]) for _ in range(4)]
    np.testing.assert_allclose(actions, np.linspace(0.0, actions[-1], 5)[1:], atol=1e-6)


def test_the_slope_of_ticks_that_come_irregularly(random_walk_env):
    """It is of the time from one to the next: of the same curve much the same however far apart they are."""
    model = trained(random_walk_env(), n_rbf=1, d_min=1.0, d_max=1.0, join="smooth")
    obs, _ = random_walk_env().reset(seed=0)
    before = []
    for ticks in ([0.0, 0.3, 0.6, 0.8], [0.0, 0.55, 0.79, 0.8]):
        policy = Remembering(model)
        controller = OptionController(policy, safety=None)
        actions = [float(controller(obs, now=now)[0]) for now in ticks]
        controller.decide_anew()
        controller(obs, now=0.9)
        slope = (actions[-1] - actions[-2]) / 2.0 / (ticks[-1] - ticks[-2])
        # As steep as an option gets is 4/s.
        np.testing.assert_allclose(policy.seen[-1][2:], [actions[-1] / 2.0, slope / 4.0], atol=1e-5)
        before.append(slope)
    assert before[0] > 0.1
    assert before[1] == pytest.approx(before[0], rel=0.2)


class Remembering(ModelPolicy):
    """Keeps what it was shown."""

    def __init__(self, model):
        super().__init__(model)
        self.seen = []

    def __call__(self, observation):
        self.seen.append(observation)
        return super().__call__(observation)


def test_a_safe_action_is_left_from_as_it_was_sent(random_walk_env):
    """Where a guard moves to 2 by 0.2 a step, because nothing fresh was seen, an option goes on at that slope."""
    model = trained(random_walk_env(), n_rbf=1, d_min=0.4, d_max=0.4, join="smooth")
    safety = Safety(max_rate=0.5, max_slew=None, stale_after=0.05, safe_action=lambda sent: np.array([2.0]))
    policy = Remembering(model)
    controller = OptionController(policy, safety=safety)
    controller.reset(last_action=np.array([-2.0]))
    obs, _ = random_walk_env().reset(seed=0)
    sent = [float(controller(None, now=0.1 * k)[0]) for k in range(3)]
    np.testing.assert_allclose(sent, [-1.8, -1.6, -1.4], atol=1e-6)
    controller(obs, now=0.3)
    # From −0.7 by 0.1 a step: as steep as an option gets is 1 a step.
    np.testing.assert_allclose(policy.seen[-1][2:], [-0.7, 0.1], atol=1e-6)


def test_a_clock_with_fine_ticks_sends_no_jumps(random_walk_env):
    model = trained(random_walk_env(), d_min=0.2)
    obs, _ = random_walk_env().reset(seed=0)
    jumps = {}
    for ticks_per_step in (10, 20, 40):
        controller = OptionController(model, dt=0.1 / ticks_per_step, safety=None)
        actions = [controller(obs, now=i * controller.dt) for i in range(20 * ticks_per_step)]
        jumps[ticks_per_step] = largest_jump(np.array(actions) / 2.0)
    assert jumps[20] == pytest.approx(jumps[10] / 2, rel=0.15)
    assert jumps[40] == pytest.approx(jumps[20] / 2, rel=0.15)


@pytest.mark.parametrize(
    ("kind", "join"), [("vector", "continuous"), ("image", "continuous"), ("dict", "continuous"), ("dict", "smooth")]
)
def test_an_exported_policy_plays_the_same(random_walk_env, tmp_path, kind, join):
    model = trained(random_walk_env(kind), POLICIES[kind], join=join)
    export_onnx(model, tmp_path / "model.onnx")
    policy = OnnxPolicy(tmp_path / "model.onnx")
    assert policy.option_space == model.option_space
    expected = through_controller(OptionController(model), random_walk_env(kind), 30)
    found = through_controller(OptionController(tmp_path / "model.onnx"), random_walk_env(kind), 30)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    model.save(tmp_path / "model.zip")
    from_zip = through_controller(OptionController(tmp_path / "model.zip"), random_walk_env(kind), 30)
    np.testing.assert_array_equal(from_zip, expected)


def test_an_exported_policy_that_does_not_tell_its_join_has_free_ones(tmp_path):
    path = tmp_path / "model.onnx"
    export_onnx(CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=0), path)
    file = onnx.load(path)
    for entry in file.metadata_props:
        if entry.key == METADATA_KEY:
            data = json.loads(entry.value)
            del data["option_space"]["join"]
            entry.value = json.dumps(data)
    onnx.save(file, path)
    assert OnnxPolicy(path).option_space.join == "free"


def test_observations_are_normalised_as_in_training(random_walk_env):
    env = VecNormalize(DummyVecEnv([lambda: joined(random_walk_env(), n_rbf=3, d_max=0.37)]), norm_reward=False)
    model = trained(env, learning_starts=1000)
    model.learn(200)
    assert env.obs_rms.mean.shape == (3,)
    expected = through_normalised_wrapper(model, env, random_walk_env(), 20)
    np.testing.assert_array_equal(through_controller(OptionController(model), random_walk_env(), 20), expected)


def through_normalised_wrapper(model, vec_normalize, env, n_steps):
    wrapped = model.wrap_env(env)
    obs, _ = wrapped.reset(seed=5)
    actions = []
    while sum(map(len, actions)) < n_steps:
        obs, *_ = wrapped.step(model.predict(vec_normalize.normalize_obs(obs), deterministic=True)[0])
        actions.append(wrapped.played)
    return np.concatenate(actions)[:n_steps]


def test_a_controller_is_copied_with_what_it_sends(random_walk_env):
    controller = OptionController(trained(random_walk_env()))
    obs, _ = random_walk_env().reset(seed=0)
    for _ in range(3):
        controller(obs)
    other = copy.deepcopy(controller)
    np.testing.assert_array_equal([controller(obs) for _ in range(10)], [other(obs) for _ in range(10)])


# --- real time


@pytest.mark.parametrize("join", JOINED)
@pytest.mark.parametrize("background", [False, True])
def test_deciding_ahead_leaves_from_the_end_of_the_rest(scripted_env, background, join):
    """The commands are those without deciding ahead, and the observation at a decision holds what they will have come to."""
    options = [(1.0, 0.9), (-0.5, 0.3), (0.25, 1.0), (0.0, 0.0)]
    kwargs = {"n_rbf": 1, "d_max": 1.0, "join": join}
    plain = OptionExecutionWrapper(scripted_env(), **kwargs)
    ahead = RealTimeOptionWrapper(scripted_env(), decide_ahead=0.3, background=background, **kwargs)
    observations = {env: [env.reset()[0]] for env in (plain, ahead)}
    played = []
    for option in options:
        for env, seen in observations.items():
            seen.append(env.step(option)[0])
        played.append(ahead.played)
    ahead.abandon()
    for one, other in zip(observations[plain], observations[ahead], strict=True):
        np.testing.assert_array_equal(one[2:], other[2:])
    commands, expected = np.ravel(ahead.unwrapped.actions), np.ravel(plain.unwrapped.actions)
    shortest = min(len(commands), len(expected))
    assert shortest > 20
    np.testing.assert_array_equal(commands[:shortest], expected[:shortest])
    # What a transition says was played is what was sent in its time.
    sent = np.concatenate(played).ravel()
    np.testing.assert_array_equal(sent, commands[: len(sent)])


def test_an_interrupted_option_leaves_the_next_one_at_what_was_sent(scripted_env):
    env = RealTimeOptionWrapper(
        scripted_env(), interrupt=lambda before, obs, seconds: seconds > 0.35, n_rbf=1, d_max=1.0, join="continuous"
    )
    env.reset()
    obs, *_, info = env.step([1.0, 1.0])
    assert info["interrupted"]
    np.testing.assert_allclose(env.played[:, 0], [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    np.testing.assert_allclose(obs, [4, 0.4, 0.4], atol=1e-6)
    env.step([1.0, 1.0])
    np.testing.assert_allclose(env.played[0, 0], 0.46, atol=1e-6)


@pytest.mark.parametrize("ahead", [0.0, 0.2])
def test_an_interrupted_option_is_left_at_the_slope_that_was_sent(scripted_env, ahead):
    """With decide_ahead, too, since its rest is not played."""
    rule = {"at": 7}
    env = RealTimeOptionWrapper(
        scripted_env(), ahead, interrupt=lambda before, obs, seconds: obs[0] == rule["at"], n_rbf=1, d_max=1.0, join="smooth"
    )
    env.reset()
    for at in (7, 12, 13):
        rule["at"] = at
        while True:
            obs, *_, info = env.step([0.8, 1.0])
            if info.get("interrupted"):
                break
        sent = np.ravel(env.unwrapped.actions)
        assert obs[0] == len(sent) == at
        np.testing.assert_allclose(obs[2:], [sent[-1], (sent[-1] - sent[-2]) / (4 * 0.1 / env.option_space.d_min)], atol=1e-6)


def test_jerk_of_a_joined_signal_grows_more_slowly_with_the_rate():
    """A jump has a jerk of 1/dt³ at its steps, a bend one of 1/dt², and a smooth join one of 1/dt."""
    omegas = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 1, 2))
    jerks = {}
    for join, n_steps in itertools.product(JOINS, (50, 100)):
        space = OptionSpace.make(2, 1.0, 0.5, 1.0 / n_steps, 0.4, "bezier", join=join)
        sent = np.zeros((2, 1))
        for option in space.encode(omegas, np.full(len(omegas), n_steps)).astype(np.float64):
            before = space.before(sent[-2:])[0] if space.joined else None
            sent = np.vstack([sent, space.plan(option, before)])
        jerks[join, n_steps] = mean_absolute_jerk(sent[2:], 1.0 / n_steps)
    # Steps at a join become rarer by 2.
    for join, growth in zip(JOINS, (4.0, 2.0, 1.0), strict=True):
        assert jerks[join, 100] / jerks[join, 50] == pytest.approx(growth, rel=0.1)
