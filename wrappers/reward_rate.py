"""Give an agent of fixed rate its reward as an integral over time."""

import math
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, OptionSpace, discount, step_weight
from sb3_ctco.wrappers.checks import check_observation, reset_env
from sb3_ctco.wrappers.timing import find_dt


class RewardRateWrapper(gym.Wrapper, RecordConstructorArgs):
    """Take rewards as rates, held over a step: multiply them by ∫₀^dt e^(−τκ) dκ = (1 − e^(−τ·dt))/τ.

    With γ = e^(−τ·dt) an agent of fixed rate then maximises the same discounted return, at every ``dt``, as one that
    decides by options: each step is an option of one step, and ``info["option"]`` tells of it as
    :class:`~sb3_ctco.wrappers.OptionExecutionWrapper` does.

    The order of wrappers is ``RewardRateWrapper(Monitor(TimeLimit(env)))``: what is inside sees the rewards as they are.

    Example:
        >>> import gymnasium as gym
        >>> env = RewardRateWrapper(gym.make("Pendulum-v1"), discount_rate=0.0)
        >>> _, _ = env.reset(seed=0)
        >>> _, reward, _, _, info = env.step(np.array([0.0]))
        >>> reward == info["option"]["integrated_reward"], info["option"]["duration"]
        (True, 0.05)

    :param env: the environment to wrap
    :param dt: the interaction period, in s; by default what :func:`~sb3_ctco.wrappers.find_dt` finds
    :param discount_rate: τ, in 1/s; by default the paper's 0.404 (a factor of 0.98 over 0.05 s)
    :param reward_scale: what rewards are multiplied by, too, for the agent alone: ``info["option"]`` tells the integral
    :raises ValueError: if a setting is out of range, or dt is not given and not found
    """

    def __init__(
        self,
        env: gym.Env,
        dt: float | None = None,
        discount_rate: float = DEFAULT_DISCOUNT_RATE,
        reward_scale: float = 1.0,
    ):
        RecordConstructorArgs.__init__(self, dt=dt, discount_rate=discount_rate, reward_scale=reward_scale)
        gym.Wrapper.__init__(self, env)
        dt = find_dt(env, required_by="RewardRateWrapper", given=dt)
        if not 0 < reward_scale < math.inf:
            raise ValueError(f"reward_scale must be positive and finite, not {reward_scale}")
        #: The clock: a step as an option of one step
        self.option_space = OptionSpace.make(1, d_max=dt, d_min=dt, dt=dt, discount_rate=discount_rate)
        self.reward_scale = reward_scale
        self._weight = step_weight(dt, discount_rate)
        self._discount = float(discount(dt, discount_rate))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the inner environment.

        :raises ValueError: if the observation is not finite, or not as its space says
        """
        return reset_env(self.env, seed, options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the inner environment, and weigh its reward.

        :raises ValueError: if the reward or the observation is not finite
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        integral = float(reward) * self._weight
        if not np.isfinite(integral):
            raise ValueError(f"the environment {self.env} returned a reward that is not finite: {reward}")
        check_observation(self.env, obs)
        info["option"] = {
            "duration": self.option_space.dt,
            "n_steps": 1,
            "integrated_reward": integral,
            "discount": self._discount,
        }
        return obs, integral * self.reward_scale, terminated, truncated, info
