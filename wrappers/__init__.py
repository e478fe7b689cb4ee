"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SupportsStepSequence, find_dt
from sb3_ctco.wrappers.real_time import Clock, RealTimeWrapper, SupportsSendReceive, WallClock
from sb3_ctco.wrappers.real_time_options import Interrupt, RealTimeOptionWrapper

__all__ = [
    "Clock",
    "Interrupt",
    "OptionExecutionWrapper",
    "RealTimeOptionWrapper",
    "RealTimeWrapper",
    "SupportsSendReceive",
    "SupportsStepSequence",
    "WallClock",
    "find_dt",
]
