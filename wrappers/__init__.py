"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SubOptions, SupportsStepSequence, find_dt
from sb3_ctco.wrappers.real_time import Clock, RealTimeWrapper, SupportsSendReceive, WallClock
from sb3_ctco.wrappers.real_time_options import Interrupt, RealTimeOptionWrapper
from sb3_ctco.wrappers.reward_rate import RewardRateWrapper

__all__ = [
    "Clock",
    "Interrupt",
    "OptionExecutionWrapper",
    "RealTimeOptionWrapper",
    "RealTimeWrapper",
    "RewardRateWrapper",
    "SubOptions",
    "SupportsSendReceive",
    "SupportsStepSequence",
    "WallClock",
    "find_dt",
]
