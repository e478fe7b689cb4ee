"""Options that an option contained: from what was played and seen of it to transitions.

Pure functions. The wrapper calls them, so that in a VecEnv of processes they run beside the environment.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_ctco.options.semi_mdp import FloatArray, RewardUnit, discounts_of_steps, step_weight
from sb3_ctco.options.space import OptionSpace

#: Observations ``[n, *observation_shape]``, or a dictionary of such
Stacked = np.ndarray | dict[str, np.ndarray]


def stack(observations: list[Any]) -> Stacked:
    """Copies of observations, or of dictionaries of observations, stacked."""
    if isinstance(observations[0], dict):
        return {key: np.array([obs[key] for obs in observations]) for key in observations[0]}
    return np.array(observations)


def rows_of(stacked: Stacked, rows: Any) -> Any:
    """Rows of stacked observations."""
    return {key: value[rows] for key, value in stacked.items()} if isinstance(stacked, dict) else stacked[rows]


def is_finite(observation: Any) -> bool:
    """Whether an observation, stacked or not, or all of a dictionary of such, is finite."""
    if isinstance(observation, dict):
        return all(is_finite(value) for value in observation.values())
    array = np.asarray(observation)
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


def shortest_steps(space: OptionSpace) -> int:
    """The fewest steps that are as long as the shortest duration, at least one."""
    return max(1, math.ceil(space.d_min / space.dt - 1e-6))


def draw_stretches(rng: np.random.Generator, n: int, n_steps: int, shortest: int) -> list[tuple[int, int]]:
    """Random stretches of an option of ``n_steps``, of at least ``shortest`` steps, and not all of it.

    There are fewer of them than steps. Otherwise what is played when options are still long would fill most of a replay buffer
    if options become as short as a step.

    :param n: how many to draw; those that are too short, all of it or drawn before are left out
    :return: pairs of the first step, and the step after the last
    """
    if n == 0 or n_steps <= shortest:
        return []
    pairs = rng.integers(0, n_steps + 1, size=(min(n, n_steps - 1), 2))
    pairs.sort(axis=1)
    drawn = dict.fromkeys(map(tuple, pairs.tolist()))
    return [(first, end) for first, end in drawn if shortest <= end - first < n_steps]


@dataclass(frozen=True, eq=False)
class SubOptions:
    """Shorter options that an option contained, as transitions: ``info["sub_options"]``.

    Every field but ``seen`` has one entry a sub-option.

    :param seen: the observations at their ends, stacked: ``[n_seen, *observation_shape]``, or a dictionary of such
    :param begins: rows of ``seen`` where they began, ``[n]``
    :param ends: rows of ``seen`` where they ended, ``[n]``
    :param options: option vectors, float32 ``[n, option_dim]``
    :param durations: in s, ``[n]``
    :param integrated_rewards: R of each, ``[n]``
    :param terminated: whether the episode terminated with it, ``[n]``
    :param truncated: whether it was truncated with it, ``[n]``
    :param residuals: largest deviation of its actions from those that were played, normalised, ``[n]``
    """

    seen: Stacked
    begins: np.ndarray
    ends: np.ndarray
    options: np.ndarray
    durations: np.ndarray
    integrated_rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    residuals: np.ndarray

    @property
    def observations(self) -> Stacked:
        """Where they began, ``[n, *observation_shape]``, or a dictionary of such."""
        return rows_of(self.seen, self.begins)

    @property
    def next_observations(self) -> Stacked:
        """Where they ended, likewise."""
        return rows_of(self.seen, self.ends)

    def __len__(self) -> int:
        return len(self.options)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SubOptions):
            return NotImplemented
        return all(_equal(mine, vars(other)[name]) for name, mine in vars(self).items())

    __hash__ = None  # type: ignore[assignment]

    def __deepcopy__(self, memo: dict[int, Any]) -> "SubOptions":
        # Nobody writes to it, so skip the copy that Stable-Baselines3 makes of infos.
        return self


def fit_sub_options(
    space: OptionSpace,
    plan: FloatArray,
    rewards: FloatArray,
    stretches: list[tuple[int, int]],
    steps: list[int],
    seen: Stacked,
    terminated: bool,
    truncated: bool,
    reward_unit: RewardUnit = "rate",
    tolerance: float = 0.1,
    before: FloatArray | None = None,
) -> SubOptions:
    """Transitions of stretches of an option; at the episode's end they end with it, or are dropped.

    :param space: what options mean
    :param plan: its normalised actions, ``[n_steps, action_dim]``, of which the first ``len(rewards)`` ran
    :param rewards: of the steps that ran, ``[n_ran]``
    :param stretches: of :func:`draw_stretches`
    :param steps: after how many steps each row of ``seen`` was observed, increasing
    :param seen: observations, stacked, the one that the option began with first
    :param terminated: whether the episode terminated with it
    :param truncated: whether it was truncated with it
    :param reward_unit: ``"rate"`` or ``"impulse"``, see :func:`~sb3_ctco.options.integrated_reward`
    :param tolerance: largest deviation that a stretch's fitted actions may have, normalised
    :param before: what an option leaves from that begins at each row of ``seen``, unless the join is free: ``[n_seen, *]`` of
        :meth:`OptionSpace.before`
    """
    n_ran = len(rewards)
    firsts, ends = np.array(stretches, dtype=np.int64).reshape(-1, 2).T
    if n_ran < len(plan):
        ends = np.minimum(ends, n_ran)
        long_enough = ends - firsts >= shortest_steps(space)
        firsts, ends = firsts[long_enough], ends[long_enough]
    rows = np.array(steps)
    starts = None if before is None else space.first_points(before[rows.searchsorted(firsts)], ends - firsts)
    omega, residuals = space.trajectory.fit(plan, firsts, ends, starts)
    kept = residuals <= tolerance
    if not kept.all():
        firsts, ends, omega, residuals = firsts[kept], ends[kept], omega[kept], residuals[kept]
    # R of a stretch from the discounted rewards up to its ends
    discounts = discounts_of_steps(n_ran, space.dt, space.discount_rate)
    total = np.zeros(n_ran + 1)
    (rewards * discounts).cumsum(out=total[1:])
    weight = step_weight(space.dt, space.discount_rate) if reward_unit == "rate" else 1.0
    lengths, at_end = ends - firsts, ends == n_ran
    return SubOptions(
        seen=seen,
        begins=rows.searchsorted(firsts),
        ends=rows.searchsorted(ends),
        options=space.encode(omega, lengths),
        durations=lengths * space.dt,
        integrated_rewards=(total[ends] - total[firsts]) * weight / discounts[firsts],
        terminated=at_end & terminated,
        truncated=at_end & truncated,
        residuals=residuals,
    )


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)
