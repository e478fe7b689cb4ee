"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SubOptions, SupportsStepSequence, find_dt
from sb3_ctco.wrappers.reward_rate import RewardRateWrapper

__all__ = ["OptionExecutionWrapper", "RewardRateWrapper", "SubOptions", "SupportsStepSequence", "find_dt"]
