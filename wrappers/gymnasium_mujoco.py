"""Options in Gymnasium's planar MuJoCo robots (v5), simulated in one call of mujoco.rollout."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

#: Robots whose reward and health depend on joints and actions alone, and bounds of the velocities that they observe
_ROBOTS = {
    "gymnasium.envs.mujoco.half_cheetah_v5.HalfCheetahEnv": np.inf,
    "gymnasium.envs.mujoco.swimmer_v5.SwimmerEnv": np.inf,
    "gymnasium.envs.mujoco.hopper_v5.HopperEnv": 10.0,
    "gymnasium.envs.mujoco.walker2d_v5.Walker2dEnv": 10.0,
}


def find_rollout(env: Any) -> Callable[..., tuple[Any, np.ndarray, bool, bool, dict[str, Any]]] | None:
    """A ``step_sequence`` (:class:`~sb3_ctco.wrappers.SupportsStepSequence`) for an environment of Gymnasium, if there is one.

    Its outcome equals that of the environment's own steps. The last step is the environment's own; those before it need
    no observation and no info.

    :param env: HalfCheetah, Swimmer, Hopper or Walker2d, v5, without wrappers; for any other the answer is None
    """
    bound = _ROBOTS.get(f"{type(env).__module__}.{type(env).__qualname__}")
    if bound is None or env.render_mode == "human":
        return None
    import mujoco  # noqa: PLC0415 (these environments have loaded it)
    from mujoco.rollout import Rollout  # noqa: PLC0415

    rollout = Rollout(nthread=0)
    model, data = env.model, env.data
    full_state = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    joints = slice(1, 1 + model.nq + model.nv)  # a full state is time, qpos, qvel, …
    start = np.empty((1, mujoco.mj_stateSize(model, full_state)))

    def roll_out(actions: np.ndarray, warmstart: np.ndarray) -> np.ndarray:
        """The joints' positions and velocities after each step from ``start``, ``[n_steps, nq + nv]``."""
        inputs = rollout_inputs(model, data, actions, env.frame_skip)
        n_frames = inputs.shape[1]
        states, sensors = np.empty((1, n_frames, start.shape[1])), np.empty((1, n_frames, model.nsensordata))
        rollout.rollout(
            [model],
            [data],
            start,
            inputs,
            control_spec=int(mujoco.mjtState.mjSTATE_USER),
            skip_checks=True,
            nstep=n_frames,
            initial_warmstart=warmstart,
            state=states,
            sensordata=sensors,
        )
        return states[0, env.frame_skip - 1 :: env.frame_skip, joints]

    def step_sequence(actions: np.ndarray, observe: Sequence[int] = ()) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        rewards, seen = np.empty(0), np.empty((0, model.nq + model.nv))
        if len(actions) > 1:
            mujoco.mj_getState(model, data, start[0], full_state)
            warmstart = data.qacc_warmstart[None].copy()
            seen = roll_out(actions[:-1], warmstart)
            healthy = _is_healthy(env, seen)
            if getattr(env, "_terminate_when_unhealthy", False) and not healthy.all():
                # The step that ends the episode is the last one, from where the step before it led to.
                actions = actions[: 1 + int(healthy.argmin())]
                mujoco.mj_setState(model, data, start[0], full_state)
                data.qacc_warmstart[:] = warmstart
                return step_sequence(actions, observe)
            velocities = np.diff(seen[:, 0], prepend=start[0, 1]) / env.dt
            ctrl_costs = env._ctrl_cost_weight * np.sum(np.square(actions[:-1]), axis=1)
            survival = healthy * getattr(env, "_healthy_reward", 0.0)
            rewards = env._forward_reward_weight * velocities + survival - ctrl_costs
        obs, reward, terminated, truncated, info = env.step(actions[-1])
        if observe:
            on_the_way = seen[[k - 1 for k in observe if k < len(actions)]]
            on_the_way[:, model.nq :] = on_the_way[:, model.nq :].clip(-bound, bound)
            info["observations"] = on_the_way[:, seen.shape[1] - env.observation_space.shape[0] :]
        return obs, np.append(rewards, reward), terminated, truncated, info

    return step_sequence


def rollout_inputs(model: Any, data: Any, actions: np.ndarray, n_frames: int) -> np.ndarray:
    """What ``mujoco.rollout`` is to set before each frame: actions, and all else that is a user's as it stands.

    That is external forces (``xfrc_applied``, ``qfrc_applied``), mocap bodies, which equalities are active, and user
    data: mujoco.rollout resets what it is not given.

    :param actions: ``[n_steps, nu]``
    :param n_frames: how many frames of the simulation a step has
    :return: ``[1, n_steps · n_frames, size of mjSTATE_USER]``, which begins with the actions
    """
    import mujoco  # noqa: PLC0415 (who has a model has loaded it)

    user = int(mujoco.mjtState.mjSTATE_USER)
    inputs = np.empty(mujoco.mj_stateSize(model, user))
    mujoco.mj_getState(model, data, inputs, user)
    inputs = np.tile(inputs, (1, len(actions) * n_frames, 1))
    inputs[0, :, : model.nu] = np.repeat(actions, n_frames, axis=0)
    return inputs


def _is_healthy(env: gym.Env, joints: np.ndarray) -> np.ndarray:
    """Health by the environment's ranges, for positions and velocities ``[n, nq + nv]``."""
    healthy = np.ones(len(joints), dtype=bool)
    for name, values in (
        ("_healthy_z_range", joints[:, 1:2]),
        ("_healthy_angle_range", joints[:, 2:3]),
        ("_healthy_state_range", joints[:, 2:]),
    ):
        low, high = getattr(env, name, (-np.inf, np.inf))
        healthy &= ((low < values) & (values < high)).all(axis=1)
    return healthy
