import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_ctco.options import (
    DEFAULT_DISCOUNT_RATE,
    TRAJECTORIES,
    BezierCurve,
    OptionSpace,
    RadialBasis,
    basis_of_steps,
    discount,
    discount_rate_from_gamma,
    integrated_reward,
    shortest_steps,
    step_weight,
    steps_in,
)


def plan_of(omega, n_steps):
    """The actions of radial basis functions, as many as ω has weights."""
    return RadialBasis(omega.shape[1]).plan(omega, n_steps)


# --- basis, worked by hand from centres linspace(−0.5/n, 1 + 0.5/n, n) and variance ½((1 + 1/n)/n)²


def test_one_basis_function_is_constant():
    np.testing.assert_array_equal(RadialBasis(1).basis(np.array([0.0, 0.3, 0.99])), np.ones((3, 1)))


def test_two_basis_functions():
    # Centres −0.25 and 1.25, variance ½·0.75² = 0.28125: at x = 0 the exponents are −0.0625/0.5625 and −1.5625/0.5625.
    a, b = math.exp(-1 / 9), math.exp(-25 / 9)
    # At x = 0.5 both are equally far.
    expected = [[a / (a + b), b / (a + b)], [0.5, 0.5]]
    np.testing.assert_allclose(RadialBasis(2).basis(np.array([0.0, 0.5])), expected, rtol=1e-12)


def test_three_basis_functions():
    # Centres −1/6, 1/2, 7/6, variance ½·(4/9)², so φ ∝ exp(−(x − c)²·81/16).
    e = [math.exp(-((0.25 - c) ** 2) * 81 / 16) for c in (-1 / 6, 1 / 2, 7 / 6)]
    np.testing.assert_allclose(RadialBasis(3).basis(np.array([0.25])), [[x / sum(e) for x in e]], rtol=1e-12)
    # By symmetry about x = 1/2.
    np.testing.assert_allclose(
        RadialBasis(3).basis(np.array([0.25]))[0], RadialBasis(3).basis(np.array([0.75]))[0, ::-1], rtol=1e-12
    )


def test_basis_of_steps_are_the_phases_k_over_n():
    np.testing.assert_array_equal(basis_of_steps(RadialBasis(3), 4), RadialBasis(3).basis(np.array([0.0, 0.25, 0.5, 0.75])))
    with pytest.raises(ValueError, match="read-only"):
        basis_of_steps(RadialBasis(3), 4)[0, 0] = 1.0


def test_plan_of_two_dimensions_by_hand():
    omega = np.array([[1.0, -1.0], [0.5, 0.5]])
    a, b = math.exp(-1 / 9), math.exp(-25 / 9)
    # Steps at phases 0 and 0.5; equal weights give a constant.
    np.testing.assert_allclose(plan_of(omega, 2), [[(a - b) / (a + b), 0.5], [0.0, 0.5]], atol=1e-12)


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 8)), elements=st.floats(-1, 1)),
    st.integers(1, 300),
)
def test_actions_stay_in_the_box_of_the_weights(omega, n_steps):
    plan = plan_of(omega, n_steps)
    assert plan.shape == (n_steps, omega.shape[0])
    assert (plan <= omega.max(axis=1) + 1e-12).all()
    assert (plan >= omega.min(axis=1) - 1e-12).all()
    np.testing.assert_allclose(basis_of_steps(RadialBasis(omega.shape[1]), n_steps).sum(axis=1), 1.0)


# --- discount and integrated reward


def test_discount_rate_is_the_papers():
    assert pytest.approx(0.40405, abs=1e-5) == DEFAULT_DISCOUNT_RATE
    assert discount_rate_from_gamma(1.0, 0.05) == 0.0
    # 0.98 over 0.05 s is 0.98² over 0.1 s.
    assert float(discount(0.1, DEFAULT_DISCOUNT_RATE)) == pytest.approx(0.98**2)


@pytest.mark.parametrize(("gamma", "gamma_dt"), [(0.0, 0.05), (1.1, 0.05), (-0.5, 0.05), (0.98, 0.0), (0.98, math.inf)])
def test_discount_rate_out_of_range(gamma, gamma_dt):
    with pytest.raises(ValueError, match="must be"):
        discount_rate_from_gamma(gamma, gamma_dt)


def test_integrated_reward_by_hand():
    # Two steps of 0.5 s at τ = ln 4 /s discount by ½ each: (1 − ½)/ln 4 = 0.5/ln 4 is the weight of a step.
    tau = math.log(4.0)
    assert step_weight(0.5, tau) == pytest.approx(0.5 / tau)
    assert integrated_reward(np.array([2.0, 6.0]), 0.5, tau) == pytest.approx((2 + 6 * 0.5) * 0.5 / tau)
    assert integrated_reward(np.array([2.0, 6.0]), 0.5, tau, "impulse") == pytest.approx(2 + 6 * 0.5)
    # Without discounting a rate is held for dt.
    assert integrated_reward(np.array([2.0, 6.0]), 0.5, 0.0) == pytest.approx(4.0)


@pytest.mark.parametrize("dt", [0.1, 0.01, 0.002])
def test_a_constant_rate_is_integrated_exactly_at_any_dt(dt):
    tau, duration = 0.404, 0.8
    exact = (1 - math.exp(-tau * duration)) / tau
    assert integrated_reward(np.ones(round(duration / dt)), dt, tau) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("a", [0.7, -1.5, 0.404])
def test_an_exponential_rate_converges_to_its_closed_form(a):
    # ∫₀¹ e^((a−τ)t) dt
    tau = 0.404
    exact = 1.0 if a == tau else (math.exp(a - tau) - 1) / (a - tau)
    errors = []
    for n in (50, 100, 200, 400):
        t = np.arange(n) / n
        errors.append(abs(integrated_reward(np.exp(a * t), 1 / n, tau) - exact))
    assert errors[-1] < 2e-3
    # First order: halving dt halves the error.
    for coarse, fine in itertools.pairwise(errors):
        assert fine == pytest.approx(coarse / 2, rel=0.05)


@given(
    hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(-100, 100)),
    st.floats(-10, 10),
    st.sampled_from(["rate", "impulse"]),
)
def test_the_integral_scales_with_the_reward(rewards, factor, unit):
    once = integrated_reward(rewards, 0.02, 0.404, unit)
    assert integrated_reward(factor * rewards, 0.02, 0.404, unit) == pytest.approx(factor * once, rel=1e-9, abs=1e-6)


@given(hnp.arrays(np.float64, 20, elements=st.floats(-10, 10)), st.integers(1, 19))
def test_options_in_a_row_add_up_to_the_whole(rewards, cut):
    dt, tau = 0.05, 0.404
    first, second = integrated_reward(rewards[:cut], dt, tau), integrated_reward(rewards[cut:], dt, tau)
    whole = integrated_reward(rewards, dt, tau)
    assert first + float(discount(cut * dt, tau)) * second == pytest.approx(whole, abs=1e-9)


# --- settings


def test_the_shortest_option_is_a_step():
    assert shortest_steps(OptionSpace.make(1, 1.0, 1e-9, 0.02, 0.4)) == 1
    assert shortest_steps(OptionSpace.make(1, 1.0, 0.05, 0.02, 0.4)) == 3


@pytest.mark.parametrize(
    ("duration", "dt", "expected"),
    [(0.1, 0.1, 1), (0.04, 0.1, 1), (0.24, 0.1, 2), (0.25, 0.1, 3), (0.3, 0.1, 3), (1.0, 0.002, 500), (0.001, 0.002, 1)],
)
def test_durations_are_rounded_half_up_to_at_least_one_step(duration, dt, expected):
    assert steps_in(duration, dt) == expected


def test_decode():
    settings = OptionSpace.make(n_rbf=2, d_max=1.0, d_min=0.2, dt=0.1, discount_rate=0.4, duration_scale="linear")
    omega, n_steps = settings.decode(np.array([0.1, 0.2, 0.3, 0.4, 0.0]))
    np.testing.assert_array_equal(omega, [[0.1, 0.2], [0.3, 0.4]])
    assert n_steps == 6  # the middle of [0.2, 1.0] s
    assert settings.duration(np.array([-1.0])) == pytest.approx(0.2)
    assert settings.duration(np.array([1.0])) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"n_rbf": 0}, ValueError),
        ({"n_rbf": 2.0}, TypeError),
        ({"n_rbf": True}, TypeError),
        ({"d_max": 0.0}, ValueError),
        ({"d_max": -1.0}, ValueError),
        ({"d_max": math.inf}, ValueError),
        ({"d_min": 2.0}, ValueError),
        ({"d_min": 0.0}, ValueError),
        ({"dt": 0.0}, ValueError),
        ({"dt": math.nan}, ValueError),
        ({"discount_rate": -0.1}, ValueError),
        ({"discount_rate": math.nan}, ValueError),
    ],
)
def test_settings_out_of_range(change, error):
    good = {"n_rbf": 3, "d_max": 1.0, "d_min": 0.1, "dt": 0.1, "discount_rate": 0.4}
    OptionSpace.make(**good)
    with pytest.raises(error, match=next(iter(change))):
        OptionSpace.make(**{**good, **change})


# --- sub-options


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(1, 5)), elements=st.floats(-1, 1)),
    st.integers(1, 60),
)
def test_a_fit_over_the_whole_option_returns_its_weights(omega, n_steps):
    [fitted], [residual] = RadialBasis(omega.shape[1]).fit(plan_of(omega, n_steps), np.array([0]), np.array([n_steps]))
    if n_steps >= omega.shape[1]:  # with fewer, the weights nearest to the mean may leave the box, and are clipped
        assert residual < 1e-9
    if n_steps >= 2 * omega.shape[1]:  # enough steps to tell the weights apart
        np.testing.assert_allclose(fitted, omega, atol=1e-6)


def test_slices_of_repeated_actions_are_exact():
    plan = plan_of(np.array([[0.3], [-1.0]]), 17)
    omega, residuals = RadialBasis(1).fit(plan, np.array([0, 3, 16, 1]), np.array([1, 9, 17, 17]))
    np.testing.assert_allclose(omega, np.tile([[0.3], [-1.0]], (4, 1, 1)), atol=1e-12)
    assert (residuals < 1e-12).all()


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(1, 4)), elements=st.floats(-1, 1)),
    st.lists(st.tuples(st.integers(0, 29), st.integers(1, 30)), min_size=1),
)
def test_slices_fitted_together_are_fitted_each_about_its_mean(omega, stretches):
    plan, n_rbf = plan_of(omega, 30), omega.shape[1]
    firsts, lengths = np.array(stretches).T
    ends = np.minimum(firsts + lengths, 30)
    for first, end, weights, residual in zip(firsts, ends, *RadialBasis(n_rbf).fit(plan, firsts, ends), strict=True):
        actions, matrix = plan[first:end], basis_of_steps(RadialBasis(n_rbf), end - first)
        mean = actions.mean(axis=0)
        expected = (mean + np.linalg.pinv(matrix) @ (actions - mean)).clip(-1, 1)
        np.testing.assert_allclose(weights, expected.T, atol=1e-9)
        assert residual == pytest.approx(np.abs(matrix @ expected - actions).max(), abs=1e-9)


def test_a_fit_is_the_least_squares_one_and_says_how_far_off_it_is():
    # Two basis functions, two steps, at phases 0 and ½: rows (p, 1 − p) with p = 1/(1 + e^(−8/3)), and (½, ½).
    p = 1 / (1 + math.exp(-8 / 3))
    # ω = (u, v) with pu + (1 − p)v = 0.4 and (u + v)/2 = 0.1
    v = (0.4 - 0.2 * p) / (1 - 2 * p)
    [omega], [residual] = RadialBasis(2).fit(np.array([[0.4], [0.1]]), np.array([0]), np.array([2]))
    np.testing.assert_allclose(omega, [[0.2 - v, v]], atol=1e-9)
    assert residual < 1e-9
    # A plan that leaves the box of the weights is clipped, and the deviation told.
    [omega], [residual] = RadialBasis(2).fit(np.array([[1.0], [-1.0]]), np.array([0]), np.array([2]))
    assert np.abs(omega).max() <= 1.0
    plan = plan_of(omega, 2)
    assert residual == pytest.approx(np.abs(plan - [[1.0], [-1.0]]).max())
    assert residual > 0.05


def test_encode_is_the_inverse_of_decode():
    settings = OptionSpace.make(n_rbf=2, d_max=1.0, d_min=0.1, dt=0.1, discount_rate=0.4)
    omega = np.array([[0.1, 0.2], [-0.3, 0.4]])
    options = settings.encode(np.tile(omega, (10, 1, 1)), np.arange(1, 11))
    assert options.dtype == np.float32
    for n_steps, option in enumerate(options, start=1):
        again, steps = settings.decode(option)
        np.testing.assert_allclose(again, omega, rtol=1e-6)
        assert steps == n_steps
    fixed = OptionSpace.make(n_rbf=2, d_max=0.3, d_min=0.3, dt=0.1, discount_rate=0.4)
    assert fixed.decode(fixed.encode(omega[None], np.array([3]))[0])[1] == 3


# --- other trajectories, and durations on a logarithmic scale


def test_a_bezier_curve_by_hand():
    # Three control points: (1−x)², 2x(1−x), x² at x = 1/4.
    np.testing.assert_allclose(BezierCurve(3).basis(np.array([0.25])), [[9 / 16, 6 / 16, 1 / 16]])
    np.testing.assert_array_equal(BezierCurve(1).basis(np.array([0.0, 0.7])), [[1.0], [1.0]])
    # It begins at its first weight. Four steps are at x = 0, 1/4, 1/2, 3/4.
    plan = BezierCurve(2).plan(np.array([[1.0, -1.0]]), 4)
    np.testing.assert_allclose(plan[:, 0], [1.0, 0.5, 0.0, -0.5])


@pytest.mark.parametrize("kind", TRAJECTORIES.values())
def test_a_stretch_of_a_plan_is_fitted_back(kind):
    trajectory = kind(3)
    omega = np.array([[0.5, -0.3, 0.9], [0.0, 0.2, -0.7]])
    plan = trajectory.plan(omega, 30)
    assert np.abs(plan).max() <= 0.9
    fitted, residuals = trajectory.fit(plan, np.array([0, 10]), np.array([30, 20]))
    np.testing.assert_allclose(fitted[0], omega, atol=1e-6)
    np.testing.assert_allclose(trajectory.plan(fitted[1], 10), plan[10:20], atol=residuals[1] + 1e-12)
    assert residuals[0] < 1e-6


def test_a_logarithmic_duration_by_hand():
    """Halfway is the geometric mean: 0.04 s to 0.64 s is a factor of 16, and 0.16 s is four times the shortest."""
    space = OptionSpace.make(1, 0.64, 0.04, 0.02, 0.4, duration_scale="log")
    for normalised, seconds in ((-1.0, 0.04), (-0.5, 0.08), (0.0, 0.16), (1.0, 0.64)):
        assert space.duration(np.array([0.0, normalised])) == pytest.approx(seconds)
    options = space.encode(np.zeros((3, 1, 1)), np.array([2, 4, 8]))
    np.testing.assert_allclose(options[:, -1], [-1.0, -0.5, 0.0], atol=1e-6)
    assert [space.decode(option)[1] for option in options.astype(np.float64)] == [2, 4, 8]


def test_option_spaces_tell_their_arguments_and_differences():
    space = OptionSpace.make(2, 0.5, 0.02, 0.01, 0.4, "bezier", "log")
    assert OptionSpace.make(**space.arguments) == space
    assert space.arguments["trajectory"] == "bezier"
    other = OptionSpace.make(2, 0.5 * (1 + 1e-9), 0.03, 0.01, 0.4, "rbf", "log")
    assert space.differences(other) == {"trajectory": ("bezier", "rbf"), "d_min": (0.02, 0.03)}
    for arguments, message in (
        ({"trajectory": "spline"}, "trajectory must be one of"),
        ({"duration_scale": "x"}, "duration_scale"),
    ):
        with pytest.raises(ValueError, match=message):
            OptionSpace.make(**{**space.arguments, **arguments})


@pytest.mark.parametrize("kind", TRAJECTORIES.values())
def test_canonical_weights_play_the_same_and_are_the_same_for_all_that_do(kind):
    trajectory, rng = kind(3), np.random.default_rng(0)
    matrices = trajectory.canonical()
    for n_steps in (1, 2, 3, 4):
        matrix = matrices[min(n_steps, 3) - 1]
        omega = rng.uniform(-1, 1, (2, 3))
        canonical = omega @ matrix.T
        np.testing.assert_allclose(trajectory.plan(canonical, n_steps), trajectory.plan(omega, n_steps), atol=1e-9)
        # Weights that differ in what nothing feels
        felt = basis_of_steps(trajectory, n_steps)
        free = np.eye(3) - np.linalg.pinv(felt) @ felt
        np.testing.assert_allclose((omega + rng.normal(size=(2, 3)) @ free) @ matrix.T, canonical, atol=1e-9)
    # One step: all weights are the action.
    np.testing.assert_allclose(np.ptp((omega @ matrices[0].T), axis=1), 0.0, atol=1e-9)
    np.testing.assert_array_equal(matrices[2], np.eye(3))
