"""What can be had in the visual reaching task: an agent that is told where the bag is."""

import numpy as np

from sb3_ctco.envs.visual_reacher.env import MAX_VELOCITY, VisualReacherEnv

#: Where the wrist camera is led: this far above the centre of the bag, in m
_HEIGHT_ABOVE_BAG = 0.2
#: Feedback gain, in 1/s
_GAIN = 3.0


def servo_action(env: VisualReacherEnv) -> np.ndarray:
    """Joint velocities that lead the wrist camera above the bag and point it down.

    :param env: the bare environment (``env.unwrapped``)
    :return: action, shape ``[7]``, in rad/s
    """
    position, axes = env.camera_pose()
    translation, rotation = env.jacobian(position)
    down = np.array([0.0, 0.0, -1.0])
    target = env.bag_position - _HEIGHT_ABOVE_BAG * down
    tilt = np.cross(-axes[:, 2], down)
    velocity = np.linalg.pinv(np.vstack([translation, rotation])) @ (_GAIN * np.concatenate([target - position, tilt]))
    return (velocity * min(1.0, MAX_VELOCITY / max(np.abs(velocity).max(), 1e-9))).astype(np.float32)
