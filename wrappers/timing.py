"""What an environment says of its interaction period."""

from typing import Any

import gymnasium as gym


def find_dt(env: gym.Env, required_by: str | None = None) -> Any:
    """The interaction period of an environment, in s, from what it says of itself.

    Looked for, in this order: ``dt`` of the outermost layer that has it (a :class:`~sb3_ctco.wrappers.RealTimeWrapper`, or the
    environment itself), dm_control's ``control_timestep()``, ``1/metadata["render_fps"]``.

    :param required_by: names who needs it, in the error if the environment does not tell
    :return: the period in s, or None if the environment does not tell and nobody needs it
    :raises ValueError: if somebody needs it
    """
    dt = env.get_wrapper_attr("dt") if env.has_wrapper_attr("dt") else None
    if dt is None:
        control_timestep = getattr(env.unwrapped, "control_timestep", None)
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
