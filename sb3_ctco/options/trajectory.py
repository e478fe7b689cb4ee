"""Trajectories of actions: from an option's weights to a plan, and from stretches of a plan back to weights.

A :class:`Trajectory` is linear in its weights ω: at the phase x = t/d of an option its actions are ``basis(x) @ ωᵀ``. A new
kind of option is a class with a ``basis``; plans, clocks, sub-options and exported policies follow from that.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sb3_ctco.options.semi_mdp import FloatArray


@dataclass(frozen=True)
class Trajectory(ABC):
    """How the weights of an option become its actions.

    :param n_weights: number of weights an action dimension
    :raises TypeError: if that is not an integer
    :raises ValueError: if it is less than one
    """

    #: Whether the critics of CTCO see :meth:`canonical` weights, in place of weights as they are
    critics_see_canonical: ClassVar[bool] = True

    n_weights: int

    def __post_init__(self) -> None:
        if isinstance(self.n_weights, bool) or not isinstance(self.n_weights, int | np.integer):
            raise TypeError(f"n_rbf must be an integer, not {self.n_weights!r}")
        if self.n_weights < 1:
            raise ValueError(f"n_rbf must be at least 1, not {self.n_weights}: one basis function repeats one action")

    @abstractmethod
    def basis(self, phase: FloatArray) -> FloatArray:
        """What weights count at some phases. Rows must be non-negative and sum to one, so that actions stay in ω's box.

        :param phase: t/d in [0, 1], shape ``[n_steps]``
        :return: shape ``[n_steps, n_weights]``
        """

    def joined_basis(self, phase: FloatArray, n_before: int = 1) -> FloatArray:
        """Likewise, of an option whose first points are given: what those count, and then what the weights count.

        They count what the first points of a Bézier curve do that has the weights as its other points. One counts 1 at phase 0
        and (1 − x)^n_weights at the phase x; of two, the actions leave from the first towards the second.

        :param phase: t/d in [0, 1], shape ``[n_steps]``
        :param n_before: how many points are given
        :return: shape ``[n_steps, n_before + n_weights]``; rows are non-negative and sum to one
        """
        x, degree = np.asarray(phase)[:, None], n_before + self.n_weights - 1
        before = np.hstack([math.comb(degree, i) * x**i * (1.0 - x) ** (degree - i) for i in range(n_before)])
        return np.hstack([before, (1.0 - before.sum(axis=1, keepdims=True)) * self.basis(phase)])

    def plan(self, omega: FloatArray, n_steps: int, start: FloatArray | None = None) -> FloatArray:
        """The whole open-loop action trajectory a_t = φ(t/d)ᵀω of an option, equation (4) of the paper.

        :param omega: weights, shape ``[action_dim, n_weights]``
        :param n_steps: number of primitive steps of the option, whose phases are k/n_steps; from a start they are
            (k + 1)/n_steps, because the start was played already
        :param start: its first points, of which the first is the action that it leaves from, shape ``[action_dim]`` or
            ``[n_before, action_dim]``; None for a plan that begins anywhere
        :return: one action a step, shape ``[n_steps, action_dim]``, in the box that ω and the start are in
        """
        if start is None:
            return basis_of_steps(self, n_steps) @ np.asarray(omega).T
        points = np.vstack([start, np.asarray(omega).T])
        return basis_of_steps(self, n_steps, len(points) - self.n_weights) @ points

    def fit(
        self,
        plan: FloatArray,
        firsts: npt.NDArray[np.integer],
        ends: npt.NDArray[np.integer],
        starts: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """The options whose actions come closest to stretches of a plan: least squares, clipped to [−1, 1].

        Exact for a constant plan, and for the whole plan of an option of at least n_weights steps.

        :param plan: normalised actions, shape ``[n_steps, action_dim]``
        :param firsts: the first step of each stretch, shape ``[n]``
        :param ends: the step after its last, shape ``[n]``
        :param starts: the first points of each, as for :meth:`plan`, shape ``[n, action_dim]`` or
            ``[n, n_before, action_dim]``; None if they begin anywhere
        :return: ω, shape ``[n, action_dim, n_weights]``, and the residuals, the largest deviation of an action from the
            plan, shape ``[n]``
        """
        if not len(firsts):
            return np.empty((0, plan.shape[1], self.n_weights)), np.empty(0)
        n_before = 0
        if starts is not None:
            # The first points of a stretch are rows of it, and weights that are known.
            starts = starts.reshape(len(firsts), -1, plan.shape[1])
            n_before = starts.shape[1]
            plan, ends = np.pad(plan, ((n_before, 0), (0, 0))), ends + n_before
        lengths = ends - firsts
        # One row a step, the stretches one after the other: they begin at the rows `begins`.
        begins = lengths.cumsum() - lengths
        actions = np.concatenate([plan[first:end] for first, end in zip(firsts.tolist(), ends.tolist(), strict=True)])
        if starts is not None:
            actions[begins[:, None] + np.arange(n_before)] = starts
        tables = np.concatenate([_basis_and_fit(self, length - n_before, n_before) for length in lengths.tolist()])
        basis, fit = tables[:, 0], tables[:, 1]
        omega = np.add.reduceat(actions[:, :, None] * fit[:, None], begins).clip(-1.0, 1.0)
        fitted = np.einsum("tai,ti->ta", omega.repeat(lengths, axis=0), basis)
        return omega[:, :, n_before:], np.maximum.reduceat(np.abs(fitted - actions), begins).max(axis=1)

    def canonical(self, n_before: int = 0) -> FloatArray:
        """What turns the weights of options into weights that play the same actions, the same for all that do.

        :param n_before: how many first points of options are given; the matrices do not depend on what these are
        :return: shape ``[n_weights, n_weights, n_weights]``: the matrix at index k − 1 is for options of k steps (and the last
            one, the identity, for longer ones): ``matrix @ ω`` for an action dimension's weights
        """
        rows = slice(n_before, None)
        tables = [_basis_and_fit(self, k, n_before)[rows, :, rows] for k in range(1, self.n_weights)]
        return np.stack([*(table[:, 1].T @ table[:, 0] for table in tables), np.eye(self.n_weights)])


class RadialBasis(Trajectory):
    """Normalised radial basis functions φ(t/d), the paper's options, equation (4). One weight repeats one action.

    Centres stand at ``linspace(−0.5/n, 1 + 0.5/n, n)`` (0.5 for n = 1) with the variance ½((1 + 1/n)/n)². As in the paper,
    critics see weights as they are.
    """

    critics_see_canonical = False

    def basis(self, phase: FloatArray) -> FloatArray:
        """Shape ``[n_steps, n_weights]``, see :meth:`Trajectory.basis`."""
        centres, variance = _centres_and_variance(self.n_weights)
        distance = np.asarray(phase)[:, None] - centres
        activation = np.exp(distance * distance / (-2.0 * variance))
        return activation / activation.sum(axis=1, keepdims=True)


class BezierCurve(Trajectory):
    """Bernstein polynomials: the first weight is where the actions begin, the last where they go.

    The weights are the control points of a Bézier curve: φ_i(x) = C(n−1, i)·x^i·(1 − x)^(n−1−i).
    """

    def basis(self, phase: FloatArray) -> FloatArray:
        """Shape ``[n_steps, n_weights]``, see :meth:`Trajectory.basis`."""
        x, i = np.asarray(phase)[:, None], np.arange(self.n_weights)
        binomials = np.array([math.comb(self.n_weights - 1, k) for k in i], dtype=np.float64)
        return binomials * x**i * (1.0 - x) ** (self.n_weights - 1 - i)

    def joined_basis(self, phase: FloatArray, n_before: int = 1) -> FloatArray:
        """The same curve with that many more control points, its first; shape ``[n_steps, n_before + n_weights]``."""
        return BezierCurve(n_before + self.n_weights).basis(phase)


#: Trajectories that a name stands for, in hyperparameter files and in exported policies
TRAJECTORIES: dict[str, type[Trajectory]] = {"rbf": RadialBasis, "bezier": BezierCurve}


@lru_cache(maxsize=4096)
def basis_of_steps(trajectory: Trajectory, n_steps: int, n_before: int = 0) -> FloatArray:
    """φ(t/d) at the steps t = 0, dt, …, (n − 1)·dt of an option of n steps: the phases k/n. Cached and read-only.

    :param n_before: how many of its first points are given; with any it leaves from the action before it, which was played at
        phase 0: the phases are (k + 1)/n
    :return: shape ``[n_steps, n_before + n_weights]``
    """
    steps = np.arange(n_steps)
    matrix = trajectory.joined_basis((steps + 1) / n_steps, n_before) if n_before else trajectory.basis(steps / n_steps)
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=4096)
def _basis_and_fit(trajectory: Trajectory, n_steps: int, n_before: int = 0) -> FloatArray:
    """φ, and what turns an action plan of n steps into the weights that fit it best: ``[n_steps, 2, n_weights]``.

    First points that are given have the first rows, and are the first weights:
    ``[n_before + n_steps, 2, n_before + n_weights]``.
    """
    matrix = basis_of_steps(trajectory, n_steps, n_before)
    before, of_weights = matrix[:, :n_before], matrix[:, n_before:]
    # About the equal weights that fit best, which give a constant exactly: where few steps leave weights open, they stay near
    # these. What the weights count together is 1, but for what the first points count.
    together = 1.0 - before.sum(axis=1)
    mean = (together / (together @ together))[None]
    inverse = np.linalg.pinv(of_weights)
    fit = mean + inverse - (inverse * together).sum(axis=1, keepdims=True) * mean
    known = np.eye(n_before, n_before + trajectory.n_weights)
    of_start = np.hstack([np.eye(n_before), -(fit @ before).T])
    return np.stack([np.vstack([known, matrix]), np.vstack([of_start, np.pad(fit.T, ((0, 0), (n_before, 0)))])], axis=1)


@lru_cache(maxsize=64)
def _centres_and_variance(n: int) -> tuple[FloatArray, float]:
    centres = np.linspace(-0.5 / n, 1 + 0.5 / n, n) if n > 1 else np.array([0.5])
    return centres, 0.5 * ((1 + 1 / n) / n) ** 2
