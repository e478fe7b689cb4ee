"""Every task of dm_control's suite at any control period, as a Gymnasium environment that can play whole options."""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

try:
    import mujoco

    with warnings.catch_warnings():
        # Without a display glfw warns, though nothing here needs a window.
        warnings.filterwarnings("ignore", message=".*GLFWError.*|.*DISPLAY.*")
        from dm_control import suite
        from dm_control.rl.control import PhysicsError
except ImportError as error:  # pragma: no cover
    raise ImportError("this environment needs dm_control: pip install 'sb3-ctco[dm-control]'") from error

Reward = Callable[[], float]


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
        for name, seconds in (("dt", dt), ("time_limit", time_limit)):
            if seconds is not None and not (seconds > 0 and math.isfinite(seconds)):
                raise ValueError(f"{name} must be a positive number of seconds, not {seconds}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        if sparse and domain not in _SPARSE_REWARDS:
            raise ValueError(f"{domain} has no sparse reward here; these domains have one: {sorted(_SPARSE_REWARDS)}")
        env = suite.load(domain, task)
        self._task = env.task
        self._physics = env.physics
        self._model: mujoco.MjModel = env.physics.model.ptr
        self._data: mujoco.MjData = env.physics.data.ptr
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

        make_reward = _SPARSE_REWARDS.get(domain) if sparse else _FAST_REWARDS.get((domain, task))
        self._reward: Reward = (
            make_reward(self._model, self._data) if make_reward else lambda: self._task.get_reward(self._physics)
        )

        first_joint = _JOINT_OBSERVATIONS.get((domain, task))
        self._joints = None if first_joint is None else (self._data.qpos[first_joint:], self._data.qvel)

        spec = env.action_spec()
        # dm_control stands in 1e10 for "no limit".
        low, high = (np.where(np.abs(b) >= 1e10, np.sign(b) * np.inf, b) for b in (spec.minimum, spec.maximum))
        self.action_space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        size = self._flat_observation().size
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

        self.render_mode = render_mode
        self._camera = {"width": width, "height": height, "camera_id": camera_id}
        self.metadata = {**self.metadata, "render_fps": 1.0 / self.dt}

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
        :raises gymnasium.error.ResetNeeded: before the first reset and after the end of an episode
        :raises dm_control.rl.control.PhysicsError: if the simulation diverges; the episode is over then
        """
        if self._steps_left < 1:
            raise gym.error.ResetNeeded("call reset() first: the environment was not reset, or its episode has ended")
        model, data, n_more, rk4 = self._model, self._data, self._n_sub_steps - 1, self._uses_rk4
        step, step1, step2, reward = mujoco.mj_step, mujoco.mj_step1, mujoco.mj_step2, self._reward
        get_termination, physics, ctrl = self._task.get_termination, self._physics, data.ctrl
        steps_left, self._steps_left = self._steps_left, 0
        discount = None
        rewards: list[float] = []
        observations = []
        try:
            with physics.check_invalid_state():
                for first, last in itertools.pairwise((0, *observe, len(actions))):
                    for action in actions[first:last]:
                        ctrl[:] = action
                        # dm_control's legacy step: mj_step1 at the end leaves positions and velocities in sync.
                        if rk4:
                            step(model, data, n_more + 1)
                        else:
                            step2(model, data)
                            if n_more:
                                step(model, data, n_more)
                        step1(model, data)
                        rewards.append(reward())
                        discount = get_termination(physics)
                        if discount is not None or len(rewards) >= steps_left:
                            break
                    if discount is not None or len(rewards) >= steps_left:
                        break
                    if last < len(actions):
                        observations.append(self._flat_observation())
        except PhysicsError as error:
            raise PhysicsError(f"{error} (within {len(rewards)} steps of {self.dt} s)") from error
        steps_left -= len(rewards)
        terminated = discount is not None and discount == 0
        truncated = not terminated and (discount is not None or steps_left < 1)
        if not (terminated or truncated):
            self._steps_left = steps_left
        info = {"observations": observations} if observe else {}
        return self._flat_observation(), np.array(rewards, dtype=np.float64), terminated, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A frame, uint8 ``[height, width, 3]``, if ``render_mode`` is ``"rgb_array"``."""
        return self._physics.render(**self._camera) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the renderer and the simulation."""
        self._physics.free()

    def _flat_observation(self) -> np.ndarray:
        if self._joints is not None:
            return np.concatenate(self._joints, dtype=np.float32, casting="same_kind")
        leaves = [np.ravel(value) for value in _leaves(self._task.get_observation(self._physics))]
        return np.concatenate(leaves, dtype=np.float32, casting="same_kind")


def _leaves(observation: Mapping[str, Any]) -> Iterator[Any]:
    for value in observation.values():
        if isinstance(value, Mapping):
            yield from _leaves(value)
        else:
            yield value


# Rewards and observations of the paper's tasks read from mujoco's arrays: the same numbers as dm_control's own functions,
# whose named indexing takes several times as long as the physics.


def _sparse_point_mass(model: mujoco.MjModel, data: mujoco.MjData) -> Reward:
    target, mass = model.geom("target").id, model.geom("pointmass").id
    target_pos, mass_pos = data.geom_xpos[target], data.geom_xpos[mass]
    size = float(model.geom_size[target, 0])

    def reward() -> float:
        return 1.0 if math.dist(target_pos, mass_pos) <= size else 0.0

    return reward


def _point_mass(model: mujoco.MjModel, data: mujoco.MjData) -> Reward:
    target, mass = model.geom("target").id, model.geom("pointmass").id
    target_pos, mass_pos, ctrl = data.geom_xpos[target], data.geom_xpos[mass], data.ctrl
    size = float(model.geom_size[target, 0])

    def reward() -> float:
        # dm_control's tolerance: Gaussian outside the target, 0.1 one target's size away from it.
        outside = max(math.dist(target_pos, mass_pos) - size, 0.0) / size
        small_control = sum(max(1.0 - u * u, 0.0) for u in ctrl.tolist()) / len(ctrl)
        return 0.1 ** (outside * outside) * (small_control + 4.0) / 5.0

    return reward


def _cheetah_run(model: mujoco.MjModel, data: mujoco.MjData) -> Reward:
    speed = data.sensor("torso_subtreelinvel").data

    def reward() -> float:
        return min(max(float(speed[0]) / 10.0, 0.0), 1.0)

    return reward


def _ball_in_cup_catch(model: mujoco.MjModel, data: mujoco.MjData) -> Reward:
    target = model.site("target").id
    target_pos, ball_pos = data.site_xpos[target], data.xpos[model.body("ball").id]
    ball_size = float(model.geom("ball").size[0])
    x_max = float(model.site_size[target, 0]) - ball_size
    z_max = float(model.site_size[target, 2]) - ball_size

    def reward() -> float:
        inside = abs(target_pos[0] - ball_pos[0]) < x_max and abs(target_pos[2] - ball_pos[2]) < z_max
        return 1.0 if inside else 0.0

    return reward


#: Tasks that observe the joints' positions, from some joint on, and velocities: which joint, by task
_JOINT_OBSERVATIONS = {
    ("point_mass", "easy"): 0,
    ("point_mass", "hard"): 0,
    ("cheetah", "run"): 1,
    ("ball_in_cup", "catch"): 0,
}
_FAST_REWARDS = {
    ("point_mass", "easy"): _point_mass,
    ("point_mass", "hard"): _point_mass,
    ("cheetah", "run"): _cheetah_run,
    ("ball_in_cup", "catch"): _ball_in_cup_catch,
}
_SPARSE_REWARDS = {"point_mass": _sparse_point_mass, "ball_in_cup": _ball_in_cup_catch}
