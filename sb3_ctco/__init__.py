"""Continuous-Time Continuous-Options for Stable-Baselines3: reinforcement learning that decides when to decide."""

from sb3_ctco._version import __version__
from sb3_ctco.common.buffers import DictOptionReplayBuffer, OptionReplayBuffer
from sb3_ctco.ctco import CTCO
from sb3_ctco.envs import register_envs
from sb3_ctco.wrappers import OptionExecutionWrapper

__all__ = ["CTCO", "DictOptionReplayBuffer", "OptionExecutionWrapper", "OptionReplayBuffer", "__version__"]

register_envs()
