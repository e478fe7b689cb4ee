"""What an environment says of its interaction period."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import unwrap_wrapper


def find_dt(env: gym.Env, required_by: str | None = None) -> Any:
    """The interaction period of an environment, in s, from what it says of itself.

    Looked for, in this order: that of a :class:`~sb3_ctco.wrappers.RealTimeWrapper`, ``env.unwrapped.dt``,
    dm_control's ``control_timestep()``, ``1/metadata["render_fps"]``.

    :param required_by: names who needs it, in the error if the environment does not tell
    :return: the period in s, or None if the environment does not tell and nobody needs it
    :raises ValueError: if somebody needs it
    """
    from sb3_ctco.wrappers.real_time import RealTimeWrapper  # noqa: PLC0415 (which looks here for its own)

    clock = unwrap_wrapper(env, RealTimeWrapper)
    if isinstance(clock, RealTimeWrapper):
        return clock.dt
    base = env.unwrapped
    dt = getattr(base, "dt", None)
    if dt is None:
        control_timestep = getattr(base, "control_timestep", None)
        dt = control_timestep() if callable(control_timestep) else None
    if dt is None:
        render_fps = (env.metadata or {}).get("render_fps")
        dt = 1.0 / float(render_fps) if render_fps else None
    if dt is None and required_by is not None:
        raise ValueError(
            f"{env} does not tell its interaction period (no unwrapped.dt, control_timestep() or metadata['render_fps']): "
            f"pass dt, in seconds, to the algorithm, CTCO(..., dt=0.02), or to {required_by}(env, dt=0.02)"
        )
    return None if dt is None else float(dt)
