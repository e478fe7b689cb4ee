"""Double Actor-Critic on proximal policy optimisation."""

from sb3_ctco.dac_ppo.dac_ppo import DACPPO
from sb3_ctco.dac_ppo.policies import CnnPolicy, DACPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DACPPO", "CnnPolicy", "DACPolicy", "MlpPolicy", "MultiInputPolicy"]
