"""Continuous-Time Continuous-Options for Stable-Baselines3: reinforcement learning that decides when to decide."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

# An installed package has its wrappers/ and zoo_configs/ inside. A checkout has them beside it: look there as well, because
# Python started in a clone imports this folder, whatever is installed.
if not (Path(__file__).parent / "wrappers").is_dir():
    __path__.append(str(Path(__file__).parents[1]))

from sb3_ctco._version import __version__
from sb3_ctco.envs import register_envs

if TYPE_CHECKING:
    from sb3_ctco.common.buffers import DictOptionReplayBuffer, OptionReplayBuffer
    from sb3_ctco.controller import OptionController
    from sb3_ctco.ctco import CTCO
    from sb3_ctco.dac_ppo import DACPPO
    from sb3_ctco.figar_sac import FiGARSAC
    from sb3_ctco.fixed_rate import sac_at_rate
    from sb3_ctco.wrappers import OptionExecutionWrapper, RewardRateWrapper

__all__ = [
    "CTCO",
    "DACPPO",
    "DictOptionReplayBuffer",
    "FiGARSAC",
    "OptionController",
    "OptionExecutionWrapper",
    "OptionReplayBuffer",
    "RewardRateWrapper",
    "__version__",
    "sac_at_rate",
]

# Imported when first used, so that a control loop that runs an exported policy does not load PyTorch.
_HOMES = {
    "CTCO": "sb3_ctco.ctco",
    "DACPPO": "sb3_ctco.dac_ppo",
    "DictOptionReplayBuffer": "sb3_ctco.common.buffers",
    "FiGARSAC": "sb3_ctco.figar_sac",
    "OptionController": "sb3_ctco.controller",
    "OptionExecutionWrapper": "sb3_ctco.wrappers",
    "OptionReplayBuffer": "sb3_ctco.common.buffers",
    "RewardRateWrapper": "sb3_ctco.wrappers",
    "sac_at_rate": "sb3_ctco.fixed_rate",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
