"""Continuous-Time Continuous-Options."""

from sb3_ctco.ctco.ctco import CTCO
from sb3_ctco.ctco.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CTCO", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
