"""Gymnasium wrappers of sb3-ctco."""

from sb3_ctco.wrappers.option_execution import OptionExecutionWrapper, SupportsStepSequence, find_dt

__all__ = ["OptionExecutionWrapper", "SupportsStepSequence", "find_dt"]
