"""Look at what environments return, before anything is stored."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_ctco.options import is_finite


def reset_env(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
    """Reset an environment, and look at what it returns.

    :raises TypeError: if that is not an observation and an info
    :raises ValueError: if the observation is not finite, or not as its space says
    """
    # Many environments' reset takes a seed and nothing else; Stable-Baselines3 passes options only if there are some, too.
    result = env.reset(seed=seed) if options is None else env.reset(seed=seed, options=options)
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise TypeError(
            f"reset of the environment {env} must return an observation and an info, a dictionary, as Gymnasium's do, not "
            f"{result!r}: wrap one of the old Gym in shimmy.GymV21CompatibilityV0"
        )
    check_observation(env, result[0])
    return result


def check_observation(env: gym.Env, obs: Any) -> None:
    """Look at what an environment observed.

    :raises ValueError: if it is not finite, or not as the environment's space says
    """
    fault = _find_fault(obs, env.observation_space)
    if fault is not None:
        raise ValueError(f"the environment {env} returned an observation that {fault}")


def _find_fault(obs: Any, space: spaces.Space) -> str | None:
    """What is wrong with an observation: a key, a shape, or a number that is not finite; None if nothing is."""
    if isinstance(space, spaces.Dict):
        if not isinstance(obs, dict) or obs.keys() != space.spaces.keys():
            return f"is no dictionary of {sorted(space.spaces)}: {obs}"
        faults = ((key, _find_fault(obs[key], inner)) for key, inner in space.spaces.items())
        return next((f"has a {key!r} that {fault}" for key, fault in faults if fault), None)
    if isinstance(space, spaces.Box):
        if np.shape(obs) != space.shape:
            return f"has the shape {np.shape(obs)}, not its space's {space.shape}: {obs}"
        if not is_finite(obs):
            return f"is not finite: {obs}"
    return None
