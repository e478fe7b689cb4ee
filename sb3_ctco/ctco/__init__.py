"""Continuous-Time Continuous-Options."""

from sb3_ctco.ctco.ctco import CTCO
from sb3_ctco.ctco.policies import CnnPolicy, CTCOPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CTCO", "CTCOPolicy", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
