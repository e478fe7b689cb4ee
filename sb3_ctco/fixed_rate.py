"""Stable-Baselines3's SAC under the clock that the algorithms with options use."""

from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import SACPolicy

from sb3_ctco.options import OptionSpace, discount, discount_rate_from_gamma, step_weight
from sb3_ctco.wrappers import RewardRateWrapper


def update_schedule(updates_per_step: float, tolerance: float = 1e-3) -> tuple[int, int]:
    """The smallest ``train_freq`` with a whole number of ``gradient_steps`` that keeps a rate of updates.

    :param updates_per_step: updates a call of the vectorised environment's ``step``, positive
    :param tolerance: relative error that the rate may have
    :return: ``train_freq`` and ``gradient_steps``
    """
    train_freq = 1
    while abs(round(updates_per_step * train_freq) / (updates_per_step * train_freq) - 1.0) > tolerance:
        train_freq += 1
    return train_freq, round(updates_per_step * train_freq)


def sac_at_rate(
    env: GymEnv | str,
    dt: float,
    updates_per_second: float = 20.0,
    gamma: float = 0.98,
    gamma_dt: float = 0.05,
    learning_starts_seconds: float = 60.0,
    policy: str | type[SACPolicy] = "MlpPolicy",
    **kwargs: Any,
) -> SAC:
    """A plain SAC that at every ``dt`` learns as often a second, for the same discounted return.

    Its discount factor is γ^(dt/γ_dt) = e^(−τ·dt), its reward is a rate held over a step
    (:class:`~sb3_ctco.wrappers.RewardRateWrapper`) in the unit of a reward of 1 over ``gamma_dt``, and its ``train_freq`` and
    ``gradient_steps`` are the smallest that give ``updates_per_second`` to a thousandth. With ``gamma_dt = dt`` it is stock
    SAC on the rewards as they are. This is the SAC of the paper's section "Empirical Analysis".

    Example:
        >>> model = sac_at_rate("Pendulum-v1", dt=0.05, updates_per_second=5)
        >>> round(model.gamma, 6), model.train_freq.frequency, model.gradient_steps, model.learning_starts
        (0.98, 4, 1, 1200)

    :param env: the environment to learn from: a Gymnasium id, a bare environment, one in a ``RewardRateWrapper``, or a
        VecEnv of such
    :param dt: the environment's interaction period, in s
    :param updates_per_second: updates per second of task time, summed over the environments of a VecEnv
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]
    :param gamma_dt: in s
    :param learning_starts_seconds: act at random for this long before learning, in s of task time
    :param policy: SAC's policy
    :param kwargs: SAC's further arguments
    :return: a ``stable_baselines3.SAC``
    :raises ValueError: for settings out of range, or that contradict the environment's
    :raises TypeError: if ``kwargs`` have what follows from the clock: ``train_freq``, ``gradient_steps`` or
        ``learning_starts``
    """
    for name in ("train_freq", "gradient_steps", "learning_starts"):
        if name in kwargs:
            raise TypeError(
                f"sac_at_rate sets {name} itself, not to {kwargs[name]}: pass updates_per_second and "
                "learning_starts_seconds in its place"
            )
    discount_rate = discount_rate_from_gamma(gamma, gamma_dt)
    if not (dt > 0 and np.isfinite(dt)):
        raise ValueError(f"dt must be a positive number of seconds, not {dt}")
    if not (updates_per_second > 0 and np.isfinite(updates_per_second)):
        raise ValueError(f"updates_per_second must be positive, not {updates_per_second}")
    if not (learning_starts_seconds >= 0 and np.isfinite(learning_starts_seconds)):
        raise ValueError(f"learning_starts_seconds must be at least 0, not {learning_starts_seconds}")

    reward_scale = 1.0 / step_weight(gamma_dt, discount_rate)
    env = _with_reward_rate(maybe_make_env(env, kwargs.get("verbose", 0)), dt, discount_rate, reward_scale)
    n_envs = env.num_envs if isinstance(env, VecEnv) else 1
    train_freq, gradient_steps = update_schedule(updates_per_second * dt * n_envs)
    return SAC(
        policy,
        env,
        gamma=float(discount(dt, discount_rate)),
        train_freq=train_freq,
        gradient_steps=gradient_steps,
        learning_starts=round(learning_starts_seconds / dt),
        **kwargs,
    )


def _with_reward_rate(env: GymEnv, dt: float, discount_rate: float, reward_scale: float) -> GymEnv:
    if isinstance(env, VecEnv):
        if not all(env.env_is_wrapped(RewardRateWrapper)):
            raise ValueError(
                "sac_at_rate cannot wrap the environments of a VecEnv from outside: make it with "
                "make_vec_env(..., wrapper_class=RewardRateWrapper, wrapper_kwargs=dict(dt=..., discount_rate=...))"
            )
        settings: list[OptionSpace] = env.get_attr("option_space")
    elif (wrapped := unwrap_wrapper(env, RewardRateWrapper)) is not None:
        settings = [wrapped.option_space]  # type: ignore[attr-defined]
    else:
        if unwrap_wrapper(env, Monitor) is None:
            env = Monitor(env)
        return RewardRateWrapper(env, dt=dt, discount_rate=discount_rate, reward_scale=reward_scale)
    for one in settings:
        for name, value in (("dt", dt), ("discount_rate", discount_rate)):
            if not np.isclose(getattr(one, name), value, rtol=1e-6, atol=0.0):
                raise ValueError(
                    f"the environment's RewardRateWrapper has {name}={getattr(one, name)}, sac_at_rate has {name}={value}: "
                    "give both the same (discount_rate is -ln(gamma)/gamma_dt)"
                )
    return env
