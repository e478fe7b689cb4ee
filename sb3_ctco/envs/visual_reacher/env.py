"""A velocity-controlled arm looks for a red bag with the camera on its wrist."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces

try:
    import mujoco
except ImportError as error:  # pragma: no cover
    raise ImportError("this environment needs mujoco: in a clone of sb3-ctco, run pip install '.[dm-control]'") from error

from sb3_ctco.envs.visual_reacher.model import BAG_HALF_SIZE, JOINT_LIMITS, scene_xml
from sb3_ctco.envs.visual_reacher.rendering import OffscreenCamera
from sb3_ctco.options import check_seconds

Difficulty = Literal["easy", "hard"]

WIDTH, HEIGHT = 80, 60
#: Rate of the camera, in Hz
IMAGE_RATE = 25.0
#: Fastest joint velocity, in rad/s
MAX_VELOCITY = 0.2
START_POSE = np.array([0.0, 0.13, 0.02, -1.9, 0.03, 2.0, 0.8])
#: The start pose's joints are off by up to this much, in rad
START_SPREAD = 0.02
#: ρ from which on the reward is 1
REWARD_THRESHOLD = 0.015
#: Corners of the box that the end effector is kept in, in m
WORKSPACE = np.array([(0.4, -0.25, 0.1), (0.7, 0.25, 0.4)])
#: Speed at which it is led back into the box, in m/s
RETURN_SPEED = 0.05
#: Joints are led back this far from their limits (rad), at this speed (rad/s)
JOINT_MARGIN, JOINT_RETURN_VELOCITY = 0.1, 0.1
#: Corners of the area that the bag's centre lies in, in m
BAG_AREA = np.array([(0.45, -0.15), (0.65, 0.15)])
#: Hard resets scatter the bag around one of the area's corners, moved in by this much (m), with a standard deviation
#: (m) drawn between 0 and the last number
CLUSTER_INSET, CLUSTER_MAX_SCATTER = 0.02, 0.05


def _pixel_weights() -> np.ndarray:
    """(0.5 − |p_x|)(0.5 − |p_y|)/(w·h) of every pixel, at its centre, shape ``[HEIGHT, WIDTH]``."""
    x = np.abs((np.arange(WIDTH) + 0.5) / WIDTH - 0.5)
    y = np.abs((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)
    return np.outer(0.5 - y, 0.5 - x) / (WIDTH * HEIGHT)


_PIXEL_WEIGHTS = _pixel_weights()


def bag_visibility(image: np.ndarray) -> float:
    """ρ(s), section "Real-World performance analysis": how large and how central what is red appears in a picture.

    A pixel is red if its red channel is above 60 and more than twice each of the others.

    :param image: uint8, shape ``[60, 80, 3]``
    :return: ρ, from 0 (nothing red) to 0.0625 (everything)
    """
    red = image[:, :, 0]
    # red > 2·x is (red − 1)//2 ≥ x in whole numbers, which fits in 8 bits.
    half = (red - 1) >> 1
    return float(_PIXEL_WEIGHTS[(red > 60) & (half >= image[:, :, 1]) & (half >= image[:, :, 2])].sum())


class VisualReacherEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """Visual reaching with a 7-joint arm, the robot task of Karimi et al. 2023, in simulation.

    Registered as ``sb3_ctco/visual_reacher-easy-v0`` and ``sb3_ctco/visual_reacher-hard-v0``::

        gymnasium.make("sb3_ctco/visual_reacher-easy-v0", dt=0.02)

    An action is a velocity for each joint, which the arm follows at once: q += u·dt. The observation is a dictionary
    of ``image``, the wrist camera's picture (uint8 ``[60, 80, 3]``, taken at 25 Hz and repeated in between), and
    ``proprioception`` (float32 ``[21]``: joint positions in rad, joint velocities and the last action in rad/s).
    The reward is 1 while the picture shows the bag large and central enough (:func:`bag_visibility` ≥ 0.015) and 0
    otherwise. An episode is truncated after ``time_limit`` seconds.

    Where the end effector has left a box of 30×50×30 cm, the command is replaced by one that leads it back at
    0.05 m/s, and a joint near its limits is led back likewise. The observed joint velocities are those that ran.

    ``easy`` puts the bag anywhere in an area of 20×30 cm; ``hard`` puts it near one of the area's corners, with a
    scatter that is drawn anew each time.

    :param difficulty: ``"easy"`` or ``"hard"``
    :param dt: control period, in s
    :param time_limit: in s, whatever the period
    :param bag_speed: in m/s; the bag wanders on the table, in straight lines that are reflected at its area's border
    :param render_mode: None or ``"rgb_array"``: the scene from outside, for people
    :param width: of rendered frames, in pixels
    :param height: of rendered frames, in pixels
    :raises ValueError: for settings out of their range
    :raises RuntimeError: if this machine cannot render without a display
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        difficulty: Difficulty = "easy",
        dt: float = 0.02,
        time_limit: float = 8.0,
        bag_speed: float = 0.0,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ):
        if difficulty not in ("easy", "hard"):
            raise ValueError(f"difficulty must be 'easy' or 'hard', not {difficulty!r}")
        check_seconds(dt=dt, time_limit=time_limit)
        if not (bag_speed >= 0 and math.isfinite(bag_speed)):
            raise ValueError(f"bag_speed must be a number of m/s that is at least 0, not {bag_speed}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        if width < 1 or height < 1:
            raise ValueError(f"width and height of rendered frames must be at least 1 pixel, not {width} and {height}")
        self.difficulty: Difficulty = difficulty
        #: Control period, in s
        self.dt = float(dt)
        self.bag_speed = float(bag_speed)
        self._step_limit = max(1, round(time_limit / dt))
        self._steps_done = self._step_limit

        self._model = mujoco.MjModel.from_xml_string(scene_xml())
        self._data = mujoco.MjData(self._model)
        self._end_effector = self._data.site("end_effector").xpos
        self._camera_position = self._data.cam("wrist").xpos
        self._camera_axes = self._data.cam("wrist").xmat
        self._bag_position = self._model.body("bag").pos
        self._bag_velocity = np.zeros(2)
        self._wrist_camera = OffscreenCamera(self._model, "wrist", WIDTH, HEIGHT)
        self._outside_camera: OffscreenCamera | None = None
        self._soft_limits = JOINT_LIMITS + np.array([[JOINT_MARGIN], [-JOINT_MARGIN]])

        n = len(START_POSE)
        speed = np.full(n, MAX_VELOCITY)
        self.action_space = spaces.Box(-MAX_VELOCITY, MAX_VELOCITY, (n,), np.float32)
        low = np.concatenate([JOINT_LIMITS[0], -speed, -speed]).astype(np.float32)
        high = np.concatenate([JOINT_LIMITS[1], speed, speed]).astype(np.float32)
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            {
                "image": spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                "proprioception": spaces.Box(low, high, dtype=np.float32),
            }
        )
        self._velocity = np.zeros(n)
        self._action = np.zeros(n)
        self._image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        self._visibility = 0.0

        self.render_mode = render_mode
        self._frame_size = (width, height)
        self.metadata = {**self.metadata, "render_fps": 1.0 / self.dt}

    @property
    def joint_positions(self) -> np.ndarray:
        """q, in rad, shape ``[7]``; a copy."""
        return self._data.qpos.copy()

    @property
    def bag_position(self) -> np.ndarray:
        """Centre of the bag, in m, shape ``[3]``; a copy."""
        return self._bag_position.copy()

    @property
    def end_effector_position(self) -> np.ndarray:
        """The point between the fingertips, in m, shape ``[3]``; a copy."""
        return self._end_effector.copy()

    def camera_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position of the wrist camera in m, ``[3]``, and its axes as the columns of ``[3, 3]``: right, up, backwards."""
        return self._camera_position.copy(), self._camera_axes.reshape(3, 3).copy()

    def jacobian(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How a point that is fixed to the hand moves with the joints, at the present pose.

        :param point: in m, shape ``[3]``
        :return: of its velocity (m/rad) and of the hand's angular velocity (rad/rad), each ``[3, 7]``
        """
        axes = self._data.xaxis
        return np.cross(axes, point - self._data.xanchor).T, axes.T.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; ``seed`` makes it and those that follow reproducible, to the pixel."""
        super().reset(seed=seed)
        self._data.qpos[:] = START_POSE + self.np_random.uniform(-START_SPREAD, START_SPREAD, len(START_POSE))
        self._bag_position[:] = *self._draw_bag_position(), BAG_HALF_SIZE[2]
        heading = self.np_random.uniform(-math.pi, math.pi)
        self._bag_velocity[:] = self.bag_speed * math.cos(heading), self.bag_speed * math.sin(heading)
        self._velocity[:] = 0.0
        self._action[:] = 0.0
        self._steps_done = 0
        mujoco.mj_kinematics(self._model, self._data)
        self._take_picture()
        return self._observation(), {"bag_visibility": self._visibility}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One control period."""
        obs, rewards, terminated, truncated, info = self.step_sequence(np.asarray(action)[None])
        return obs, float(rewards[0]), terminated, truncated, info

    def step_sequence(
        self, actions: np.ndarray, observe: Sequence[int] = ()
    ) -> tuple[dict[str, np.ndarray], np.ndarray, bool, bool, dict[str, Any]]:
        """Play several actions; see :class:`~sb3_ctco.wrappers.SupportsStepSequence`.

        :param actions: joint velocities in rad/s, shape ``[n_steps, 7]``; clipped to the action space
        :param observe: numbers of steps after which to observe, too, increasing
        :return: last observation, the rewards of the steps that ran, terminated (never), truncated, info
        :raises gymnasium.error.ResetNeeded: before the first reset and after the end of an episode
        """
        if self._steps_done >= self._step_limit:
            raise gym.error.ResetNeeded("call reset() first: the environment was not reset, or its episode has ended")
        actions = np.clip(actions, -MAX_VELOCITY, MAX_VELOCITY)[: self._step_limit - self._steps_done]
        rewards = np.empty(len(actions))
        observations = []
        for k, action in enumerate(actions):
            if k in observe:
                self._action[:] = actions[k - 1]
                observations.append(self._observation())
            self._move(action)
            # The slack keeps a period that divides the camera's from missing a picture by rounding.
            picture = math.floor(self._steps_done * self.dt * IMAGE_RATE + 1e-6)
            self._steps_done += 1
            if math.floor(self._steps_done * self.dt * IMAGE_RATE + 1e-6) > picture:
                self._take_picture()
            rewards[k] = self._visibility >= REWARD_THRESHOLD
        self._action[:] = actions[-1]
        truncated = self._steps_done >= self._step_limit
        info: dict[str, Any] = {"bag_visibility": self._visibility}
        if observe:
            info["observations"] = observations
        return self._observation(), rewards, False, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The scene from outside, uint8 ``[height, width, 3]``, if ``render_mode`` is ``"rgb_array"``."""
        if self.render_mode != "rgb_array":
            return None
        if self._outside_camera is None:
            self._outside_camera = OffscreenCamera(self._model, "outside", *self._frame_size, shadows=True)
        mujoco.mj_camlight(self._model, self._data)
        return self._outside_camera.render(self._data)

    def close(self) -> None:
        """Free both cameras."""
        self._wrist_camera.close()
        if self._outside_camera is not None:
            self._outside_camera.close()

    def _draw_bag_position(self) -> np.ndarray:
        if self.difficulty == "easy":
            return self.np_random.uniform(*BAG_AREA)
        inset = BAG_AREA + np.array([[CLUSTER_INSET], [-CLUSTER_INSET]])
        corner = inset[self.np_random.integers(2, size=2), [0, 1]]
        scatter = self.np_random.uniform(0.0, CLUSTER_MAX_SCATTER)
        return np.clip(self.np_random.normal(corner, scatter), *BAG_AREA)

    def _move(self, action: np.ndarray) -> None:
        """One period of the arm, with the safety bounds in force, and of the bag."""
        q = self._data.qpos
        velocity = action.astype(np.float64)
        outside = np.clip(self._end_effector, *WORKSPACE) - self._end_effector
        if outside.any():
            translation, _ = self.jacobian(self._end_effector)
            inward = outside * (RETURN_SPEED / np.linalg.norm(outside))
            velocity = np.linalg.pinv(translation) @ inward
            # All joints slow down together, so that the direction stays.
            velocity *= min(1.0, MAX_VELOCITY / np.abs(velocity).max())
        velocity[q < self._soft_limits[0]] = JOINT_RETURN_VELOCITY
        velocity[q > self._soft_limits[1]] = -JOINT_RETURN_VELOCITY
        q += velocity * self.dt
        self._velocity[:] = velocity
        if self.bag_speed:
            self._move_bag()
        mujoco.mj_kinematics(self._model, self._data)

    def _move_bag(self) -> None:
        position = self._bag_position[:2] + self._bag_velocity * self.dt
        inside = np.clip(position, *BAG_AREA)
        self._bag_velocity[position != inside] *= -1.0
        # Mirrored at the border; a second clip is for a step that is longer than the area.
        self._bag_position[:2] = np.clip(2 * inside - position, *BAG_AREA)

    def _take_picture(self) -> None:
        mujoco.mj_camlight(self._model, self._data)
        self._image = self._wrist_camera.render(self._data)
        self._visibility = bag_visibility(self._image)

    def _observation(self) -> dict[str, np.ndarray]:
        proprioception = np.concatenate([self._data.qpos, self._velocity, self._action], dtype=np.float32)
        return {"image": self._image.copy(), "proprioception": proprioception}
