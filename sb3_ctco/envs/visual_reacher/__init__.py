"""Visual reaching with a robot arm: the task of section "Real-World performance analysis", in simulation."""

from sb3_ctco.envs.visual_reacher.env import VisualReacherEnv
from sb3_ctco.envs.visual_reacher.oracle import servo_action

__all__ = ["VisualReacherEnv", "servo_action"]
