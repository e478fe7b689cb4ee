"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SupportsStepSequence, find_dt
from sb3_ctco.wrappers.real_time import Clock, RealTimeWrapper, SupportsSendReceive, WallClock

__all__ = [
    "Clock",
    "OptionExecutionWrapper",
    "RealTimeWrapper",
    "SupportsSendReceive",
    "SupportsStepSequence",
    "WallClock",
    "find_dt",
]
