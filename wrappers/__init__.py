"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper
from sb3_ctco.wrappers.real_time import Clock, RealTimeWrapper, SupportsSendReceive, WallClock
from sb3_ctco.wrappers.real_time_options import Interrupt, RealTimeOptionWrapper
from sb3_ctco.wrappers.reward_rate import RewardRateWrapper
from sb3_ctco.wrappers.step_sequence import SupportsStepSequence
from sb3_ctco.wrappers.take_over import TakeOver, TakeOverWrapper
from sb3_ctco.wrappers.timing import find_dt

__all__ = [
    "Clock",
    "Interrupt",
    "OptionExecutionWrapper",
    "RealTimeOptionWrapper",
    "RealTimeWrapper",
    "RewardRateWrapper",
    "SupportsSendReceive",
    "SupportsStepSequence",
    "TakeOver",
    "TakeOverWrapper",
    "WallClock",
    "find_dt",
]
