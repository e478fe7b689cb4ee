"""Trajectories of actions: from an option's weights to a plan, and from stretches of a plan back to weights.

A :class:`Trajectory` is linear in its weights ω: at the phase x = t/d of an option its actions are ``basis(x) @ ωᵀ``. A new
kind of option is a class with a ``basis``; plans, clocks, sub-options and exported policies follow from that.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

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

    def plan(self, omega: FloatArray, n_steps: int) -> FloatArray:
        """The whole open-loop action trajectory a_t = φ(t/d)ᵀω of an option, equation (4) of the paper.

        :param omega: weights, shape ``[action_dim, n_weights]``
        :param n_steps: number of primitive steps of the option, whose phases are k/n_steps
        :return: one action a step, shape ``[n_steps, action_dim]``, in the box that ω is in
        """
        return basis_of_steps(self, n_steps) @ np.asarray(omega).T

    def fit(
        self, plan: FloatArray, firsts: npt.NDArray[np.integer], ends: npt.NDArray[np.integer]
    ) -> tuple[FloatArray, FloatArray]:
        """The options whose actions come closest to stretches of a plan: least squares, clipped to [−1, 1].

        Exact for a constant plan, and for the whole plan of an option of at least n_weights steps.

        :param plan: normalised actions, shape ``[n_steps, action_dim]``
        :param firsts: the first step of each stretch, shape ``[n]``
        :param ends: the step after its last, shape ``[n]``
        :return: ω, shape ``[n, action_dim, n_weights]``, and the residuals, the largest deviation of an action from the
            plan, shape ``[n]``
        """
        if not len(firsts):
            return np.empty((0, plan.shape[1], self.n_weights)), np.empty(0)
        lengths = ends - firsts
        # One row a step, the stretches one after the other: they begin at the rows `starts`.
        starts = lengths.cumsum() - lengths
        actions = np.concatenate([plan[first:end] for first, end in zip(firsts.tolist(), ends.tolist(), strict=True)])
        tables = np.concatenate([_basis_and_fit(self, length) for length in lengths.tolist()])
        basis, fit = tables[:, 0], tables[:, 1]
        omega = np.add.reduceat(actions[:, :, None] * fit[:, None], starts).clip(-1.0, 1.0)
        fitted = np.einsum("tai,ti->ta", omega.repeat(lengths, axis=0), basis)
        return omega, np.maximum.reduceat(np.abs(fitted - actions), starts).max(axis=1)

    def canonical(self) -> FloatArray:
        """What turns the weights of options into weights that play the same actions, the same for all that do.

        :return: shape ``[n_weights, n_weights, n_weights]``: the matrix at index k − 1 is for options of k steps (and the last
            one, the identity, for longer ones): ``matrix @ ω`` for an action dimension's weights
        """
        matrices = [_basis_and_fit(self, k) for k in range(1, self.n_weights)]
        return np.stack([*(table[:, 1].T @ table[:, 0] for table in matrices), np.eye(self.n_weights)])


class RadialBasis(Trajectory):
    """Normalised radial basis functions φ(t/d), the paper's options, equation (4). One weight repeats one action.

    Centres stand at ``linspace(−0.5/n, 1 + 0.5/n, n)`` (0.5 for n = 1) with the variance ½((1 + 1/n)/n)².
    """

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


#: Trajectories that a name stands for, in hyperparameter files and in exported policies
TRAJECTORIES: dict[str, type[Trajectory]] = {"rbf": RadialBasis, "bezier": BezierCurve}


@lru_cache(maxsize=4096)
def basis_of_steps(trajectory: Trajectory, n_steps: int) -> FloatArray:
    """φ(t/d) at the steps t = 0, dt, …, (n − 1)·dt of an option of n steps: the phases k/n. Cached and read-only.

    :return: shape ``[n_steps, n_weights]``
    """
    matrix = trajectory.basis(np.arange(n_steps) / n_steps)
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=4096)
def _basis_and_fit(trajectory: Trajectory, n_steps: int) -> FloatArray:
    """φ, and what turns an action plan of n steps into the weights that fit it best: ``[n_steps, 2, n_weights]``."""
    matrix = basis_of_steps(trajectory, n_steps)
    # About the plan's mean, which equal weights give exactly: where few steps leave weights open, they stay near it.
    mean = np.full((1, n_steps), 1.0 / n_steps)
    inverse = np.linalg.pinv(matrix)
    return np.stack([matrix, (mean + inverse - inverse.sum(axis=1, keepdims=True) * mean).T], axis=1)


@lru_cache(maxsize=64)
def _centres_and_variance(n: int) -> tuple[FloatArray, float]:
    centres = np.linspace(-0.5 / n, 1 + 0.5 / n, n) if n > 1 else np.array([0.5])
    return centres, 0.5 * ((1 + 1 / n) / n) ** 2
