"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SubOptions, SupportsStepSequence, find_dt

__all__ = ["OptionExecutionWrapper", "SubOptions", "SupportsStepSequence", "find_dt"]
