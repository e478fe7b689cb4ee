"""Continuous-Time Continuous-Options for Stable-Baselines3: reinforcement learning that decides when to decide."""

from sb3_ctco._version import __version__
from sb3_ctco.common.buffers import DictOptionReplayBuffer, OptionReplayBuffer
from sb3_ctco.common.sac_at_rate import sac_at_rate
from sb3_ctco.ctco import CTCO
from sb3_ctco.dac_ppo import DACPPO
from sb3_ctco.envs import register_envs
from sb3_ctco.figar_sac import FiGARSAC
from sb3_ctco.wrappers import OptionExecutionWrapper, RewardRateWrapper

__all__ = [
    "CTCO",
    "DACPPO",
    "DictOptionReplayBuffer",
    "FiGARSAC",
    "OptionExecutionWrapper",
    "OptionReplayBuffer",
    "RewardRateWrapper",
    "__version__",
    "sac_at_rate",
]

register_envs()
