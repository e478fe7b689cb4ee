"""The option model and the arithmetic of its semi-Markov decision process.

Pure functions of numpy arrays; equations are those of Karimi et al. 2023, "Dynamic Decision Frequency with
Continuous Options" (https://arxiv.org/abs/2212.04407). Words and units:

============== ============================================ ====================
paper          code                                         unit or shape
============== ============================================ ====================
Δt             ``dt``                                       s
ω              ``omega``                                    [action_dim, n_rbf]
d              ``duration``                                 s
φ(t/d)         ``basis``                                    [n_steps, n_rbf]
τ              ``discount_rate``                            1/s
γ(d) = e^(−τd) ``discount``                                 –
R              ``integrated_reward``                        reward rate × s
============== ============================================ ====================
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]
RewardUnit = Literal["rate", "impulse"]
REWARD_UNITS: tuple[RewardUnit, ...] = ("rate", "impulse")


def discount_rate_from_gamma(gamma: float = 0.98, gamma_dt: float = 0.05) -> float:
    """The paper's τ = −ln(γ_base)/dt_base (section "Empirical Analysis").

    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]
    :param gamma_dt: the time over which ``gamma`` discounts, in s
    :return: the time constant of discounting, in 1/s; 0.404 for the paper's 0.98 at 0.05 s
    :raises ValueError: if ``gamma`` is outside (0, 1] or ``gamma_dt`` is not positive
    """
    if not 0.0 < gamma <= 1.0:
        raise ValueError(f"gamma must be in (0, 1], not {gamma}: it is the discount factor over gamma_dt seconds")
    if not (gamma_dt > 0.0 and math.isfinite(gamma_dt)):
        raise ValueError(f"gamma_dt must be a positive number of seconds, not {gamma_dt}")
    return -math.log(gamma) / gamma_dt


DEFAULT_DISCOUNT_RATE = discount_rate_from_gamma()


def discount(duration: FloatArray | float, discount_rate: float) -> FloatArray:
    """γ(d) = e^(−τd), the discount of a decision that took ``duration``.

    :param duration: time that ran, in s, any shape
    :param discount_rate: τ, in 1/s
    :return: discount, the shape of ``duration``
    """
    return np.exp(-discount_rate * np.asarray(duration))


@lru_cache(maxsize=4096)
def discounts_of_steps(n_steps: int, dt: float, discount_rate: float) -> FloatArray:
    """e^(−τk·dt) at the beginning of the steps k = 0, …, n − 1. Cached and read-only.

    :return: shape ``[n_steps]``
    """
    discounts = discount(np.arange(n_steps) * dt, discount_rate)
    discounts.setflags(write=False)
    return discounts


def steps_in(duration: float, dt: float) -> int:
    """How many primitive steps play an option of this duration: d/dt rounded half up, at least one.

    :param duration: d, in s
    :param dt: the interaction period, in s
    """
    return max(1, math.floor(duration / dt + 0.5))


def basis(phase: FloatArray, n_rbf: int) -> FloatArray:
    """Normalised radial basis functions φ(t/d), equation (4) of the paper.

    Centres stand at ``linspace(−0.5/n, 1 + 0.5/n, n)`` (0.5 for n = 1) with the variance ½((1 + 1/n)/n)². Each row
    sums to one, so φᵀω stays inside any box that ω is in, and ``n_rbf=1`` repeats one action.

    :param phase: t/d in [0, 1), shape ``[n_steps]``
    :param n_rbf: number of basis functions
    :return: shape ``[n_steps, n_rbf]``
    """
    centres, variance = _centres_and_variance(n_rbf)
    distance = np.asarray(phase)[:, None] - centres
    activation = np.exp(distance * distance / (-2.0 * variance))
    return activation / activation.sum(axis=1, keepdims=True)


@lru_cache(maxsize=64)
def _centres_and_variance(n: int) -> tuple[FloatArray, float]:
    centres = np.linspace(-0.5 / n, 1 + 0.5 / n, n) if n > 1 else np.array([0.5])
    return centres, 0.5 * ((1 + 1 / n) / n) ** 2


@lru_cache(maxsize=4096)
def basis_of_steps(n_steps: int, n_rbf: int) -> FloatArray:
    """φ(t/d) at the steps t = 0, dt, …, (n − 1)·dt of an option of n steps: the phases k/n. Cached and read-only.

    :return: shape ``[n_steps, n_rbf]``
    """
    matrix = basis(np.arange(n_steps) / n_steps, n_rbf)
    matrix.setflags(write=False)
    return matrix


def action_plan(omega: FloatArray, n_steps: int) -> FloatArray:
    """The whole open-loop action trajectory a_t = φ(t/d)ᵀω of an option, equation (4) of the paper.

    :param omega: weights, shape ``[action_dim, n_rbf]``
    :param n_steps: number of primitive steps of the option
    :return: one action a step, shape ``[n_steps, action_dim]``, in the box that ω is in
    """
    omega = np.asarray(omega)
    return basis_of_steps(n_steps, omega.shape[1]) @ omega.T


@lru_cache(maxsize=4096)
def _basis_and_fit(n_steps: int, n_rbf: int) -> FloatArray:
    """φ, and what turns an action plan of n steps into the weights that fit it best: ``[n_steps, 2, n_rbf]``."""
    matrix = basis_of_steps(n_steps, n_rbf)
    # About the plan's mean, which equal weights give exactly: where few steps leave weights open, they stay near it.
    mean = np.full((1, n_steps), 1.0 / n_steps)
    inverse = np.linalg.pinv(matrix)
    return np.stack([matrix, (mean + inverse - inverse.sum(axis=1, keepdims=True) * mean).T], axis=1)


def fit_slices(
    plan: FloatArray, firsts: npt.NDArray[np.integer], ends: npt.NDArray[np.integer], n_rbf: int
) -> tuple[FloatArray, FloatArray]:
    """The options whose actions come closest to stretches of a plan: least squares, clipped to [−1, 1].

    Exact for ``n_rbf=1`` and a constant plan, and for the whole plan of an option of at least n_rbf steps.

    :param plan: normalised actions, shape ``[n_steps, action_dim]``
    :param firsts: the first step of each stretch, shape ``[n]``
    :param ends: the step after its last, shape ``[n]``
    :param n_rbf: number of basis functions
    :return: ω, shape ``[n, action_dim, n_rbf]``, and the residuals, the largest deviation of an action from the plan,
        shape ``[n]``
    """
    if not len(firsts):
        return np.empty((0, plan.shape[1], n_rbf)), np.empty(0)
    lengths = ends - firsts
    # One row a step, the stretches one after the other: they begin at the rows `starts`.
    starts = lengths.cumsum() - lengths
    actions = np.concatenate([plan[first:end] for first, end in zip(firsts.tolist(), ends.tolist(), strict=True)])
    tables = np.concatenate([_basis_and_fit(length, n_rbf) for length in lengths.tolist()])
    basis, fit = tables[:, 0], tables[:, 1]
    omega = np.add.reduceat(actions[:, :, None] * fit[:, None], starts).clip(-1.0, 1.0)
    fitted = np.einsum("tai,ti->ta", omega.repeat(lengths, axis=0), basis)
    return omega, np.maximum.reduceat(np.abs(fitted - actions), starts).max(axis=1)


class ActionBox:
    """The bounds of primitive actions, to which normalised ones are scaled.

    :param low: lower bounds, shape ``action_shape``, of which action_dim is the product
    :param high: upper bounds, likewise
    """

    def __init__(self, low: npt.NDArray[Any], high: npt.NDArray[Any]):
        self.low, self.high = low, high
        self._bottom = low.astype(np.float64).ravel()
        self._half_width = 0.5 * (high.astype(np.float64).ravel() - self._bottom)

    def actions(self, trajectory: FloatArray) -> npt.NDArray[Any]:
        """Normalised actions in the units of the box.

        :param trajectory: actions in [−1, 1], shape ``[n_steps, action_dim]``
        :return: shape ``[n_steps, *action_shape]``, in the precision of ``low``
        """
        return self.cast(self.scale(trajectory))

    def scale(self, trajectory: FloatArray) -> FloatArray:
        """Normalised actions in the units of the box, in double precision: shape ``[n_steps, action_dim]``, as given."""
        return (trajectory + 1.0) * self._half_width + self._bottom

    def cast(self, actions: FloatArray) -> npt.NDArray[Any]:
        """Actions in the units of the box, in its shape and precision: ``[n_steps, *action_shape]``."""
        # The cast may round past a bound.
        return actions.astype(self.low.dtype).reshape(-1, *self.low.shape).clip(self.low, self.high)


def step_weight(dt: float, discount_rate: float) -> float:
    """∫₀^dt e^(−τκ) dκ = (1 − e^(−τ·dt))/τ: what a reward rate of 1, held over one step, is worth at its start.

    :return: in s; the limit ``dt`` for τ → 0
    """
    return -math.expm1(-discount_rate * dt) / discount_rate if discount_rate > 0 else dt


def integrated_reward(rewards: FloatArray, dt: float, discount_rate: float, unit: RewardUnit = "rate") -> float:
    """R(s, ω, d) = ∫₀ᵈ e^(−τκ) r dκ, equation (5) of the paper, for rewards sampled once a step.

    A reward ``"rate"`` is held over its step, which makes the sum the exact integral of a piecewise constant rate.
    An ``"impulse"`` is paid at once, at the start of its step: Σ e^(−τk·dt)·r_k.

    :param rewards: one reward a step that ran, shape ``[n_steps]``
    :param dt: the interaction period, in s
    :param discount_rate: τ, in 1/s
    :param unit: ``"rate"`` for rewards that do not shrink with dt (dm_control, most of Gymnasium), ``"impulse"`` for
        rewards that are paid per event
    :return: R, in reward rate × s, or in reward for impulses
    """
    rewards = np.asarray(rewards, dtype=np.float64)
    total = float(rewards @ discounts_of_steps(len(rewards), dt, discount_rate))
    return total * step_weight(dt, discount_rate) if unit == "rate" else total


@dataclass(frozen=True)
class OptionSettings:
    """What an option vector means: the settings that a policy and the environment it acts in must share.

    An option vector is ``[ω flattened from [action_dim, n_rbf], duration]``, every entry in [−1, 1].

    :param n_rbf: number of radial basis functions an action dimension
    :param d_max: longest duration, in s
    :param d_min: shortest duration, in s
    :param dt: the interaction period of the environment, in s
    :param discount_rate: τ, in 1/s
    :raises ValueError: if a setting is out of its range
    :raises TypeError: if ``n_rbf`` is not an integer
    """

    n_rbf: int
    d_max: float
    d_min: float
    dt: float
    discount_rate: float

    def __post_init__(self) -> None:
        if isinstance(self.n_rbf, bool) or not isinstance(self.n_rbf, int | np.integer):
            raise TypeError(f"n_rbf must be an integer, not {self.n_rbf!r}")
        if self.n_rbf < 1:
            raise ValueError(f"n_rbf must be at least 1, not {self.n_rbf}: one basis function repeats one action")
        for name in ("dt", "d_max", "d_min"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be a positive number of seconds, not {value}")
        if self.d_min > self.d_max:
            raise ValueError(
                f"d_min={self.d_min} s is longer than d_max={self.d_max} s: "
                "raise d_max, or pass a d_min (by default one step, dt) that is at most d_max"
            )
        if not (self.discount_rate >= 0 and math.isfinite(self.discount_rate)):
            raise ValueError(f"discount_rate must be a finite number of 1/s that is at least 0, not {self.discount_rate}")

    def duration(self, option: FloatArray) -> float:
        """The duration d that an option vector asks for, in s: its last entry, mapped from [−1, 1] to [d_min, d_max]."""
        return self.d_min + 0.5 * (float(option[-1]) + 1.0) * (self.d_max - self.d_min)

    def encode(self, omega: FloatArray, n_steps: npt.NDArray[np.integer]) -> FloatArray:
        """The option vectors that :meth:`decode` turns into these; d is encoded as 0 if d_min = d_max.

        :param omega: weights, shape ``[n, action_dim, n_rbf]``
        :param n_steps: numbers of primitive steps, shape ``[n]``
        :return: shape ``[n, action_dim · n_rbf + 1]``, float32
        """
        width = self.d_max - self.d_min
        options = np.zeros((len(omega), omega.shape[1] * omega.shape[2] + 1), dtype=np.float32)
        options[:, :-1] = omega.reshape(len(omega), options.shape[1] - 1)
        if width > 0:
            options[:, -1] = (2.0 * (n_steps * self.dt - self.d_min) / width - 1.0).clip(-1.0, 1.0)
        return options

    def decode(self, option: FloatArray) -> tuple[FloatArray, int]:
        """Split an option vector.

        :param option: shape ``[action_dim · n_rbf + 1]``, entries in [−1, 1]
        :return: ω, shape ``[action_dim, n_rbf]``, and the number of primitive steps
        """
        return option[:-1].reshape(-1, self.n_rbf), steps_in(self.duration(option), self.dt)
