"""Fine-Grained Action Repetition on soft actor-critic."""

from sb3_ctco.figar_sac.figar_sac import FiGARSAC
from sb3_ctco.figar_sac.policies import CnnPolicy, FiGARSACPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "FiGARSAC", "FiGARSACPolicy", "MlpPolicy", "MultiInputPolicy"]
