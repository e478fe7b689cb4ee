"""Every task of dm_control's suite at any control period, as a Gymnasium environment that can play whole options."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_ctco.envs.quiet import without_deprecations
from sb3_ctco.options import check_seconds

try:
    import mujoco
    from mujoco.rollout import Rollout

    with warnings.catch_warnings():
        # Without a display glfw warns, though nothing here needs a window.
        warnings.filterwarnings("ignore", message=".*GLFWError.*|.*DISPLAY.*")
        from dm_control import suite
        from dm_control.rl.control import PhysicsError
except ImportError as error:  # pragma: no cover
    raise ImportError("this environment needs dm_control: in a clone of sb3-ctco, run pip install '.[dm-control]'") from error

#: Rewards ``[n_steps]`` from the qpos, sensordata and ctrl that steps led to, ``[n_steps, ...]`` each
Rewards = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

#: Rewards of the steps that ran, dm_control's discount if the episode ended, and the observations on the way
_Played = tuple[np.ndarray, float | None, Sequence[np.ndarray] | np.ndarray]
_STATE, _USER = int(mujoco.mjtState.mjSTATE_FULLPHYSICS), int(mujoco.mjtState.mjSTATE_USER)


class DMControlEnv(gym.Env[np.ndarray, np.ndarray]):
    """A task of dm_control's suite at a control period of your choice.

    Registered as ``sb3_ctco/<domain>-<task>-v0``::

        gymnasium.make("sb3_ctco/point_mass-easy-v0", dt=0.002, time_limit=10.0, sparse=True)

    Observations are the task's, flattened in its order to float32. The physics step is dm_control's own, or smaller
    where that does not divide ``dt``. An episode begins as in dm_control (with its own physics step, so that the
    distribution of first states does not depend on ``dt``) and is truncated after ``time_limit`` seconds. The
    environment offers ``step_sequence``, which
    :class:`~sb3_ctco.wrappers.OptionExecutionWrapper` uses to play an option without computing observations that
    nobody sees.

    :param domain: for instance ``"cheetah"``
    :param task: for instance ``"run"``
    :param dt: control period, in s; dm_control's own by default
    :param time_limit: in s, whatever the period; dm_control's own by default
    :param sparse: reward 1 inside the target and 0 elsewhere, for tasks with a dense reward around a target
        (point_mass; ball_in_cup is sparse already)
    :param render_mode: None or ``"rgb_array"`` (headless machines need ``MUJOCO_GL=egl`` or ``osmesa`` in their
        environment before mujoco is imported)
    :param width: of rendered frames, in pixels
    :param height: of rendered frames, in pixels
    :param camera_id: which of the model's cameras renders
    :raises ValueError: for an unknown task, a period or limit that is not positive, or a task without sparse reward
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        domain: str,
        task: str,
        dt: float | None = None,
        time_limit: float | None = None,
        sparse: bool = False,
        render_mode: str | None = None,
        width: int = 320,
        height: int = 240,
        camera_id: int = 0,
    ):
        check_seconds(dt=dt, time_limit=time_limit)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        if sparse and domain not in _SPARSE_REWARDS:
            raise ValueError(f"{domain} has no sparse reward here; these domains have one: {sorted(_SPARSE_REWARDS)}")
        with without_deprecations():
            # Some models are drawn at random (lqr's): the same one each time. What reset draws follows from its seed.
            env = suite.load(domain, task, task_kwargs={"random": 0})
        self._task = env.task
        self._physics = env.physics
        self._model: mujoco.MjModel = env.physics.model.ptr
        self._data: mujoco.MjData = env.physics.data.ptr
        self._name = (domain, task, sparse)
        self._uses_rk4 = self._model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4

        #: Control period, in s
        self.dt: float = env.control_timestep() if dt is None else float(dt)
        self._reset_timestep = env.physics.timestep()
        # The slack keeps a period that is a multiple of the physics step from being split once more by rounding.
        self._n_sub_steps = max(1, math.ceil(self.dt / self._reset_timestep - 1e-6))
        self._timestep = self.dt / self._n_sub_steps
        limit = env._step_limit * env.control_timestep() if time_limit is None else float(time_limit)
        self._step_limit = limit if math.isinf(limit) else max(1, round(limit / self.dt))
        self._steps_left: float = 0

        self._rewards = self._make_rewards()
        self._first_joint = _FIRST_JOINTS.get(domain, 0)
        self._rollout = Rollout(nthread=0)

        spec = env.action_spec()
        # dm_control stands in 1e10 for "no limit".
        low, high = (np.where(np.abs(b) >= 1e10, np.sign(b) * np.inf, b) for b in (spec.minimum, spec.maximum))
        self.action_space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        size = self._flat_observation().size
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

        self.render_mode = render_mode
        self._camera = {"width": width, "height": height, "camera_id": camera_id}
        self.metadata = {**self.metadata, "render_fps": 1.0 / self.dt}

    @property
    def physics(self) -> Any:
        """dm_control's ``Physics``, for what changes the state from outside: call its ``forward()`` afterwards."""
        return self._physics

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; ``seed`` makes it and those that follow reproducible."""
        super().reset(seed=seed)
        # dm_control draws from a RandomState of its own.
        self._task._random = np.random.RandomState(self.np_random.integers(2**32, dtype=np.uint32))
        self._model.opt.timestep = self._reset_timestep
        with self._physics.reset_context():
            self._task.initialize_episode(self._physics)
        self._model.opt.timestep = self._timestep
        self._steps_left = self._step_limit
        return self._flat_observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period."""
        obs, rewards, terminated, truncated, info = self.step_sequence(np.asarray(action)[None])
        return obs, float(rewards[0]), terminated, truncated, info

    def step_sequence(
        self, actions: np.ndarray, observe: Sequence[int] = ()
    ) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:
        """Play several actions; see :class:`~sb3_ctco.wrappers.SupportsStepSequence`.

        :param actions: shape ``[n_steps, action_dim]``
        :param observe: numbers of steps after which to observe, too, increasing
        :return: last observation, the rewards of the steps that ran, terminated, truncated, info
        :raises ValueError: if the actions have another shape
        :raises gymnasium.error.ResetNeeded: before the first reset and after the end of an episode
        :raises dm_control.rl.control.PhysicsError: if the simulation diverges; the episode is over then
        """
        if self._steps_left < 1:
            raise gym.error.ResetNeeded("call reset() first: the environment was not reset, or its episode has ended")
        if actions.shape[1:] != self.action_space.shape:
            raise ValueError(f"an action must have shape {self.action_space.shape}, not {actions.shape[1:]}")
        steps_left, self._steps_left = self._steps_left, 0
        actions = actions[: int(min(steps_left, len(actions)))]
        observe = [k for k in observe if k < len(actions)]
        play = self._step_in_a_loop if self._rewards is None else self._step_once if len(actions) == 1 else self._roll_out
        try:
            with self._physics.check_invalid_state():
                rewards, discount, observations = play(actions, observe)
        except PhysicsError as error:
            raise PhysicsError(f"{error} (within {len(actions)} steps of {self.dt} s)") from error
        steps_left -= len(rewards)
        terminated = discount == 0
        truncated = not terminated and (discount is not None or steps_left < 1)
        if not (terminated or truncated):
            self._steps_left = steps_left
        info = {"observations": observations} if observe else {}
        return self._flat_observation(), rewards, terminated, truncated, info

    def _step_in_a_loop(self, actions: np.ndarray, observe: Sequence[int]) -> _Played:
        """Any task, by dm_control's own functions."""
        task, physics = self._task, self._physics
        rewards: list[float] = []
        observations: list[np.ndarray] = []
        for action in actions:
            if len(rewards) in observe:
                observations.append(self._flat_observation())
            self._advance(action)
            rewards.append(task.get_reward(physics))
            discount = task.get_termination(physics)
            if discount is not None:
                break
        return np.array(rewards, dtype=np.float64), discount, observations

    def _advance(self, action: np.ndarray) -> None:
        """dm_control's legacy step: mj_step1 at the end leaves positions and velocities in sync."""
        model, data, n_sub_steps = self._model, self._data, self._n_sub_steps
        data.ctrl[:] = action
        if self._uses_rk4:
            mujoco.mj_step(model, data, n_sub_steps)
        else:
            mujoco.mj_step2(model, data)
            if n_sub_steps > 1:
                mujoco.mj_step(model, data, n_sub_steps - 1)
        mujoco.mj_step1(model, data)

    def _step_once(self, actions: np.ndarray, observe: Sequence[int]) -> _Played:
        """One step of a task whose reward is a function of arrays: quicker than rolling it out."""
        self._advance(actions[0])
        data = self._data
        assert self._rewards is not None
        return self._rewards(data.qpos[None], data.sensordata[None], data.ctrl[None]), None, []

    def _roll_out(self, actions: np.ndarray, observe: Sequence[int]) -> _Played:
        """The same for tasks whose reward is a function of arrays, and whose episodes do not terminate: all in C.

        mj_step is mj_step1, then mj_step2: stepping from positions and velocities that are in sync, as the legacy step
        leaves them, repeats mj_step1 once and is otherwise the same.
        """
        model, data, n_sub_steps = self._model, self._data, self._n_sub_steps
        inputs = _rollout_inputs(model, data, actions, n_sub_steps)
        start = np.empty((1, mujoco.mj_stateSize(model, _STATE)))
        mujoco.mj_getState(model, data, start[0], _STATE)
        states = np.empty((1, inputs.shape[1], start.shape[1]))
        # The sensors of a step are those of the state that it starts in; the last state's are read from the data.
        sensors = np.empty((1, inputs.shape[1] + 1, model.nsensordata))
        self._rollout.rollout(
            [model],
            [data],
            start,
            inputs,
            control_spec=_USER,
            skip_checks=True,
            nstep=inputs.shape[1],
            initial_warmstart=data.qacc_warmstart[None].copy(),
            state=states,
            sensordata=sensors[:, :-1],
        )
        mujoco.mj_step1(model, data)
        sensors[0, -1] = data.sensordata
        # A full state is time, qpos, qvel, …
        joints = states[0, n_sub_steps - 1 :: n_sub_steps, 1 : 1 + model.nq + model.nv]
        assert self._rewards is not None
        ctrl = inputs[0, ::n_sub_steps, : model.nu]
        rewards = self._rewards(joints[:, : model.nq], sensors[0, n_sub_steps::n_sub_steps], ctrl)
        return rewards, None, list(joints[[k - 1 for k in observe], self._first_joint :].astype(np.float32))

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A frame, uint8 ``[height, width, 3]``, if ``render_mode`` is ``"rgb_array"``."""
        return self._physics.render(**self._camera) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the renderer and the simulation."""
        self._physics.free()

    def _make_rewards(self) -> Rewards | None:
        domain, task, sparse = self._name
        make_rewards = _SPARSE_REWARDS.get(domain) if sparse else _REWARDS.get((domain, task))
        if make_rewards is None:
            return None
        # In the model's own position, so that the same numbers come out whatever the episode is at.
        data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, data)
        return make_rewards(self._model, data)

    def __getstate__(self) -> dict[str, Any]:
        # What refers to the simulation's memory is made anew.
        return {name: value for name, value in vars(self).items() if name not in ("_model", "_data", "_rewards", "_rollout")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._model, self._data = self._physics.model.ptr, self._physics.data.ptr
        self._rewards, self._rollout = self._make_rewards(), Rollout(nthread=0)

    def _flat_observation(self) -> np.ndarray:
        if self._rewards is not None:
            joints = (self._data.qpos[self._first_joint :], self._data.qvel)
            return np.concatenate(joints, dtype=np.float32, casting="same_kind")
        leaves = [np.ravel(value) for value in _leaves(self._task.get_observation(self._physics))]
        return np.concatenate(leaves, dtype=np.float32, casting="same_kind")


def _rollout_inputs(model: mujoco.MjModel, data: mujoco.MjData, actions: np.ndarray, n_frames: int) -> np.ndarray:
    """What ``mujoco.rollout`` is to set before each frame: actions, and all else that is a user's as it stands.

    That is external forces (``xfrc_applied``, ``qfrc_applied``), mocap bodies, which equalities are active, and user
    data: mujoco.rollout resets what it is not given.

    :param actions: ``[n_steps, nu]``
    :param n_frames: how many frames of the simulation a step has
    :return: ``[1, n_steps · n_frames, size of mjSTATE_USER]``, which begins with the actions
    """
    inputs = np.empty(mujoco.mj_stateSize(model, _USER))
    mujoco.mj_getState(model, data, inputs, _USER)
    inputs = np.tile(inputs, (1, len(actions) * n_frames, 1))
    inputs[0, :, : model.nu] = np.repeat(actions, n_frames, axis=0)
    return inputs


def _leaves(observation: Mapping[str, Any]) -> Iterator[Any]:
    for value in observation.values():
        if isinstance(value, Mapping):
            yield from _leaves(value)
        else:
            yield value


# Rewards of the paper's tasks as functions of mujoco's arrays: the same numbers as dm_control's own, whose named indexing
# takes several times as long as the physics. The observations of these tasks are the joints' positions and velocities.


def _sparse_point_mass(model: mujoco.MjModel, data: mujoco.MjData) -> Rewards:
    distances, size = _distances_to_target(model, data)
    return lambda qpos, sensors, ctrl: (distances(qpos) <= size).astype(np.float64)


def _point_mass(model: mujoco.MjModel, data: mujoco.MjData) -> Rewards:
    distances, size = _distances_to_target(model, data)

    def rewards(qpos: np.ndarray, sensors: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
        # dm_control's tolerance: Gaussian outside the target, 0.1 one target's size away from it.
        outside = np.maximum(distances(qpos) - size, 0.0) / size
        small_control = np.maximum(1.0 - ctrl * ctrl, 0.0).mean(axis=1)
        return 0.1 ** (outside * outside) * (small_control + 4.0) / 5.0

    return rewards


def _distances_to_target(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """From qpos ``[n, nq]`` to the distances of the mass from the middle of the target, ``[n]``, and the target's size."""
    target, mass = model.geom("target").id, model.geom("pointmass").id
    slopes = _jacobian(mujoco.mj_jacGeom, model, data, mass)
    origin = data.geom_xpos[mass] - slopes @ data.qpos - data.geom_xpos[target]

    def distances(qpos: np.ndarray) -> np.ndarray:
        offset = origin + qpos @ slopes.T
        return np.sqrt((offset * offset).sum(axis=1))

    return distances, float(model.geom_size[target, 0])


def _cheetah_run(model: mujoco.MjModel, data: mujoco.MjData) -> Rewards:
    speed = model.sensor("torso_subtreelinvel").adr[0]
    return lambda qpos, sensors, ctrl: (sensors[:, speed] / 10.0).clip(0.0, 1.0)


def _ball_in_cup_catch(model: mujoco.MjModel, data: mujoco.MjData) -> Rewards:
    target, ball = model.site("target").id, model.body("ball").id
    slopes = _jacobian(mujoco.mj_jacSite, model, data, target) - _jacobian(mujoco.mj_jacBody, model, data, ball)
    origin = data.site_xpos[target] - data.xpos[ball] - slopes @ data.qpos
    x_and_z = [0, 2]
    origin, slopes, limit = origin[x_and_z], slopes[x_and_z], model.site_size[target, x_and_z] - model.geom("ball").size[0]
    return lambda qpos, sensors, ctrl: (np.abs(origin + qpos @ slopes.T) < limit).all(axis=1).astype(np.float64)


def _jacobian(jac: Callable[..., None], model: mujoco.MjModel, data: mujoco.MjData, index: int) -> np.ndarray:
    """How a position moves with the joints, ``[3, nv]``: a constant where all joints are slides."""
    slopes = np.empty((3, model.nv))
    jac(model, data, slopes, None, index)
    return slopes


_REWARDS = {
    ("point_mass", "easy"): _point_mass,
    ("point_mass", "hard"): _point_mass,
    ("cheetah", "run"): _cheetah_run,
    ("ball_in_cup", "catch"): _ball_in_cup_catch,
}
_SPARSE_REWARDS = {"point_mass": _sparse_point_mass, "ball_in_cup": _ball_in_cup_catch}
#: The first joint whose position is observed; cheetah does not observe how far it has run.
_FIRST_JOINTS = {"cheetah": 1}
