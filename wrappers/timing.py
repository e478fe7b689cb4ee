"""What an environment says of its interaction period."""

from typing import overload

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_ctco.options import check_seconds

#: What an error says of an environment that does not tell
UNTOLD_DT = "does not tell its interaction period (no dt, control_timestep() or metadata['render_fps'])"


@overload
def find_dt(env: gym.Env, required_by: str, given: float | None = None) -> float: ...


@overload
def find_dt(env: gym.Env, required_by: None = None) -> float | None: ...


def find_dt(env: gym.Env, required_by: str | None = None, given: float | None = None) -> float | None:
    """The interaction period of an environment, in s, from what it says of itself.

    Looked for, in this order: ``dt`` of the outermost layer that has it (a :class:`~sb3_ctco.wrappers.RealTimeWrapper`, or the
    environment itself), dm_control's ``control_timestep()``, ``1/metadata["render_fps"]``.

    :param required_by: names who needs it, in the error if the environment does not tell
    :param given: what its user said, in s, which the environment is then not asked
    :return: the period in s, or None if the environment does not tell and nobody needs it
    :raises ValueError: if somebody needs it, or what was given is not positive
    """
    if given is not None:
        check_seconds(dt=given)
        return float(given)
    dt = env.get_wrapper_attr("dt") if env.has_wrapper_attr("dt") else None
    if dt is None:
        control_timestep = getattr(env.unwrapped, "control_timestep", None)
        dt = control_timestep() if callable(control_timestep) else None
    if dt is None:
        render_fps = (env.metadata or {}).get("render_fps")
        dt = 1.0 / float(render_fps) if render_fps else None
    if dt is None and required_by is not None:
        raise ValueError(
            f"{env} {UNTOLD_DT}: pass dt, in seconds, to the algorithm, CTCO(..., dt=0.02), or to {required_by}(env, dt=0.02)"
        )
    return None if dt is None else float(dt)


def find_dt_of_all(env: VecEnv) -> float | None:
    """:func:`find_dt` for environments side by side, which may live in other processes.

    :raises ValueError: if they have several
    """
    periods = env.get_attr("dt") if env.has_attr("dt") else [None]
    if periods[0] is None and env.has_attr("control_timestep"):
        periods = env.env_method("control_timestep")
    if periods[0] is None:
        rates = [(metadata or {}).get("render_fps") for metadata in env.get_attr("metadata")]
        periods = [1.0 / float(rate) if rate else None for rate in rates]
    if periods[0] is None:
        return None
    if not np.allclose(np.array(periods, dtype=float), float(periods[0]), rtol=1e-6, atol=0.0):
        raise ValueError(f"the environments' interaction periods are {periods}: make all of them with the same dt")
    return float(periods[0])
