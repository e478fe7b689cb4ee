"""Write a policy to a file that runs without PyTorch."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_ctco.common.files import replace_durably
from sb3_ctco.controller import ModelPolicy
from sb3_ctco.exported import METADATA_KEY, to_metadata

if TYPE_CHECKING:
    from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm


class _GreedyActor(nn.Module):
    """Observations as the environment gives them to the policy's greedy option, ``[batch, option_dim]``."""

    def __init__(self, actor: nn.Module, names: list[str] | None, vec_normalize: VecNormalize | None):
        super().__init__()
        self.actor = actor
        self.names = names
        self.normalizers = nn.ModuleDict()
        if vec_normalize is not None and vec_normalize.norm_obs:
            statistics = vec_normalize.obs_rms if isinstance(vec_normalize.obs_rms, dict) else {"": vec_normalize.obs_rms}
            for name, rms in statistics.items():
                self.normalizers["_" + name] = _Normalizer(
                    rms.mean, np.sqrt(rms.var + vec_normalize.epsilon), vec_normalize.clip_obs
                )

    def forward(self, *observations: th.Tensor) -> th.Tensor:
        if self.names is None:
            return self.actor(self._normalized("", observations[0]), deterministic=True)
        named = {name: self._normalized(name, obs) for name, obs in zip(self.names, observations, strict=True)}
        return self.actor(named, deterministic=True)

    def _normalized(self, name: str, observation: th.Tensor) -> th.Tensor:
        key = "_" + name
        return self.normalizers[key](observation) if key in self.normalizers else observation


class _Normalizer(nn.Module):
    """VecNormalize's arithmetic on observations."""

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, mean: np.ndarray, std: np.ndarray, clip: float):
        super().__init__()
        self.register_buffer("mean", th.as_tensor(mean, dtype=th.float32))
        self.register_buffer("std", th.as_tensor(std, dtype=th.float32))
        self.clip = clip

    def forward(self, observation: th.Tensor) -> th.Tensor:
        return ((observation - self.mean) / self.std).clamp(-self.clip, self.clip)


def export_onnx(
    model: "OptionOffPolicyAlgorithm", path: str | Path, vec_normalize: VecNormalize | None = None, opset_version: int = 18
) -> None:
    """Write the greedy policy as ONNX, for :class:`~sb3_ctco.controller.OptionController`.

    The graph maps observations ``[n, *shape]`` (one input a key for dictionaries, the single input ``observation``
    otherwise; images channels first) to options ``[n, option_dim]``: ω, then d, normalised to [−1, 1]. Normalisation of
    observations is in the graph. The file's metadata holds what the options mean: the options' settings and the bounds
    of the bare environment's actions.

    :param model: a trained model that decides by options, for instance CTCO
    :param path: the file to write, ``.onnx``
    :param vec_normalize: the normalisation of training; by default that of the environment that the model has
    :param opset_version: of ONNX
    :raises TypeError: if the model does not decide by options
    :raises ValueError: if ``path`` does not end in ``.onnx``, or the model never had an environment
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"path must end in .onnx, by which OptionController knows an exported policy, not be {path}")
    try:
        import onnx
    except ImportError as error:
        raise ImportError(
            "exporting a policy needs onnx and onnxscript: in a clone of sb3-ctco, run pip install '.[onnx]'"
        ) from error

    policy = ModelPolicy(model, vec_normalize=vec_normalize)
    space = model.observation_space
    named = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
    observations = {name: (_shape(leaf), str(leaf.dtype)) for name, leaf in named.items()}
    actor_network = model.policy.actor
    assert isinstance(actor_network, nn.Module)
    actor = _GreedyActor(actor_network, list(named) if isinstance(space, spaces.Dict) else None, policy.vec_normalize)
    metadata = to_metadata(policy.option_space, policy.primitive_action_space, observations)
    # A batch of two, because the exporter takes a batch of one for a constant.
    examples = tuple(th.as_tensor(np.stack([leaf.sample()] * 2), device=model.device) for leaf in named.values())

    # A robot may read the file that is there meanwhile.
    unfinished = Path(path).with_name(Path(path).name + ".unfinished")
    was_training = model.policy.training
    model.policy.set_training_mode(False)
    try:
        batch = th.export.Dim("n")
        th.onnx.export(
            actor.eval().to(model.device),
            examples,
            str(unfinished),
            input_names=list(named),
            output_names=["option"],
            dynamic_shapes=(tuple({0: batch} for _ in named),),
            opset_version=opset_version,
            external_data=False,
            verbose=False,
        )
        file = onnx.load(unfinished)
        entry = file.metadata_props.add()
        entry.key, entry.value = METADATA_KEY, metadata
        onnx.save(file, unfinished)
        replace_durably(unfinished, path)
    finally:
        model.policy.set_training_mode(was_training)
        unfinished.unlink(missing_ok=True)


def _shape(space: spaces.Space) -> tuple[int, ...]:
    assert space.shape is not None
    return tuple(space.shape)
