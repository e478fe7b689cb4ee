"""The arithmetic of a semi-Markov decision process over options: discount, integrated reward, durations in steps.

Pure functions of numpy arrays; equations are those of Karimi et al. 2023, https://arxiv.org/abs/2212.04407.
"""

import math
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]
RewardUnit = Literal["rate", "impulse"]
REWARD_UNITS: tuple[RewardUnit, ...] = ("rate", "impulse")


def check_seconds(**seconds: float | None) -> None:
    """Refuse times that are not positive and finite; None stands for a time that was not given.

    :param seconds: times in s, by the names that their error gives them
    :raises ValueError: if one is out of range
    """
    for name, value in seconds.items():
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise ValueError(f"{name} must be a positive number of seconds, not {value}")


def discount_rate_from_gamma(gamma: float = 0.98, gamma_dt: float = 0.05) -> float:
    """The paper's τ = −ln(γ_base)/dt_base (section "Empirical Analysis").

    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]
    :param gamma_dt: the time over which ``gamma`` discounts, in s
    :return: the time constant of discounting, in 1/s; 0.404 for the paper's 0.98 at 0.05 s
    :raises ValueError: if ``gamma`` is outside (0, 1] or ``gamma_dt`` is not positive
    """
    if not 0.0 < gamma <= 1.0:
        raise ValueError(f"gamma must be in (0, 1], not {gamma}: it is the discount factor over gamma_dt seconds")
    check_seconds(gamma_dt=gamma_dt)
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
    :raises ValueError: for another unit
    """
    if unit not in REWARD_UNITS:
        raise ValueError(f"the unit of rewards must be one of {REWARD_UNITS}, not {unit!r}")
    rewards = np.asarray(rewards, dtype=np.float64)
    total = float(rewards @ discounts_of_steps(len(rewards), dt, discount_rate))
    return total * step_weight(dt, discount_rate) if unit == "rate" else total
