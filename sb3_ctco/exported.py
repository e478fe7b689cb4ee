"""A policy that :func:`sb3_ctco.export.export_onnx` wrote: its file's metadata, and how it is run without PyTorch."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ctco.options import OPTIONS_OF_0_1_0, OptionSpace

Observation = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]

#: Key under which an exported file keeps what its options mean.
METADATA_KEY = "sb3_ctco"


class OnnxPolicy:
    """A greedy policy in an ONNX file written by :func:`sb3_ctco.export.export_onnx`.

    It is an :class:`~sb3_ctco.controller.OptionPolicy`.

    Needs onnxruntime, and neither PyTorch nor Stable-Baselines3. Observations are those of the environment: if training
    normalised them, the file does as well. Images come channels first.

    Nothing in the file can run code: it is a graph of numbers, and its metadata are JSON, of which types, ranges and sizes are
    checked against each other and against the graph.

    :param path: the file
    :param n_threads: threads of onnxruntime; more than one seldom pays for networks of this size
    :raises ImportError: without onnxruntime
    :raises ValueError: if the file was not written by ``export_onnx``, or is damaged
    """

    def __init__(self, path: str | Path, n_threads: int = 1):
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(
                "running an exported policy needs onnxruntime: in a clone of sb3-ctco, run pip install '.[onnx]'"
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = n_threads
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own, which have no common class
            raise ValueError(f"{path} is damaged or no ONNX file: {error}") from error
        metadata = self._session.get_modelmeta().custom_metadata_map
        if METADATA_KEY not in metadata:
            raise ValueError(f"{path} does not tell what its options mean: write it with sb3_ctco.export.export_onnx")
        try:
            self.option_space, self.primitive_action_space, self._observations = _from_metadata(metadata[METADATA_KEY])
            _check_graph(self._session, self.option_space, self.primitive_action_space, self._observations)
            self.observation_space = _observation_space(self._observations)
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"the metadata of {path} are not those of an exported policy ({type(error).__name__}: {error}): write it anew "
                "with sb3_ctco.export.export_onnx"
            ) from None

    def __call__(self, observation: Observation) -> np.ndarray:
        """Options for one or several observations.

        :raises ValueError: if an observation has another shape than in training
        """
        leaves = observation if isinstance(observation, dict) else {"observation": observation}
        several, feed = False, {}
        for name, (shape, dtype) in self._observations.items():
            leaf = np.asarray(leaves[name], dtype=dtype)
            if leaf.ndim not in (len(shape), len(shape) + 1) or leaf.shape[leaf.ndim - len(shape) :] != shape:
                raise ValueError(f"{name} must have shape {shape} or [n, {', '.join(map(str, shape))}], not {leaf.shape}")
            several = leaf.ndim > len(shape)
            feed[name] = leaf.reshape(-1, *shape)
        options = self._session.run(None, feed)[0]
        return options if several else options[0]


def to_metadata(settings: OptionSpace, action_space: spaces.Box, observations: dict[str, tuple[tuple[int, ...], str]]) -> str:
    """What an exported policy's options mean, as a line of JSON.

    :param observations: shape and dtype of each observation, by the name of the file's input
    :raises ValueError: if the trajectory has no name, by which the file's reader would know it
    """
    arguments = settings.arguments
    if not isinstance(arguments["trajectory"], str):
        raise ValueError(
            f"an exported policy names its trajectory, and {arguments['trajectory'].__name__} has no name: give it one, "
            f"sb3_ctco.options.TRAJECTORIES['name'] = {arguments['trajectory'].__name__}, here and where the file is read"
        )
    return json.dumps(
        {
            "option_space": arguments,
            "action_low": action_space.low.tolist(),
            "action_high": action_space.high.tolist(),
            "action_dtype": str(action_space.dtype),
            "observations": observations,
        },
        default=lambda number: number.item(),  # numpy's
    )


#: What an exported file says of its options, and of which types
_SETTINGS: dict[str, tuple[type, ...]] = {
    "n_rbf": (int,),
    "trajectory": (str,),
    "d_max": (int, float),
    "d_min": (int, float),
    "dt": (int, float),
    "discount_rate": (int, float),
    "duration_scale": (str,),
    "join": (str,),
}

#: Name of a dtype of numbers, as numpy has it, and what ONNX calls it
_ONNX_TYPES = {
    "bool": "tensor(bool)",
    "float16": "tensor(float16)",
    "float32": "tensor(float)",
    "float64": "tensor(double)",
    **{f"{sign}int{bits}": f"tensor({sign}int{bits})" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}


def _from_metadata(text: str) -> tuple[OptionSpace, spaces.Box, dict[str, tuple[tuple[int, ...], str]]]:
    """The inverse of :func:`to_metadata`, for a text that anybody may have written.

    :raises ValueError: if a value is out of its range, or malformed; likewise KeyError and TypeError
    """
    data = json.loads(text)
    # Files that 0.1.0 wrote have it under another name.
    settings = data["option_space"] if "option_space" in data else data["option_settings"]
    settings = {**OPTIONS_OF_0_1_0, **settings} if isinstance(settings, dict) else settings
    if not isinstance(settings, dict) or settings.keys() != _SETTINGS.keys():
        raise ValueError(f"option_space must have {list(_SETTINGS)}, not {settings}")
    for name, value in settings.items():
        if type(value) not in _SETTINGS[name]:
            raise ValueError(f"option_space has {name}={value!r}, which must be of {_SETTINGS[name]}")
    if data["action_dtype"] not in ("float16", "float32", "float64"):
        raise ValueError(f"action_dtype must be of floating point, not {data['action_dtype']!r}")
    dtype = np.dtype(data["action_dtype"])
    low, high = np.array(data["action_low"], dtype), np.array(data["action_high"], dtype)
    if low.shape != high.shape or low.size == 0 or not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"action_low and action_high must be finite and of one shape, not {low} and {high}")
    if (low > high).any():
        raise ValueError(f"action_low must not be above action_high: {low} and {high}")
    observations = {}
    for name, (shape, kind) in data["observations"].items():
        if kind not in _ONNX_TYPES or not all(type(n) is int and n > 0 for n in shape):
            raise ValueError(f"observation {name} must have sizes and a dtype of numbers, not {shape} and {kind!r}")
        observations[name] = (tuple(shape), kind)
    return OptionSpace.make(**settings), spaces.Box(low, high, dtype=dtype.type), observations


def _check_graph(
    session: Any, settings: OptionSpace, action_space: spaces.Box, observations: dict[str, tuple[tuple[int, ...], str]]
) -> None:
    """Refuse metadata that do not fit the graph they came with.

    :raises ValueError: if they do not
    """
    inputs = {entry.name: (entry.type, tuple(entry.shape[1:])) for entry in session.get_inputs()}
    expected = {name: (_ONNX_TYPES[kind], shape) for name, (shape, kind) in observations.items()}
    if inputs != expected:
        raise ValueError(f"the graph's inputs are {inputs}, the metadata's {expected}")
    outputs = [(entry.type, *entry.shape[1:]) for entry in session.get_outputs()]
    option_dim = action_space.low.size * settings.trajectory.n_weights + 1
    if outputs != [("tensor(float)", option_dim)]:
        raise ValueError(f"the graph's outputs are {outputs}, and options of these settings have {option_dim} numbers")


def _observation_space(observations: dict[str, tuple[tuple[int, ...], str]]) -> spaces.Space:
    """The space of an exported policy's observations: their shapes and types, whose bounds are all that these allow."""
    boxes: dict[str, spaces.Space] = {}
    for name, (shape, kind) in observations.items():
        dtype: Any = np.dtype(kind)
        low, high = {"f": (-np.inf, np.inf), "b": (0, 1)}.get(dtype.kind) or (np.iinfo(dtype).min, np.iinfo(dtype).max)
        boxes[name] = spaces.Box(low, high, shape, dtype)
    return boxes["observation"] if boxes.keys() == {"observation"} else spaces.Dict(boxes)
