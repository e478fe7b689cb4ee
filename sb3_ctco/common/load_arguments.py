"""What may be changed of a saved model while it is loaded."""

import inspect
import io
import math
import pathlib
from collections.abc import Callable, Collection
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_ctco.options import TRAJECTORIES


def check_load_arguments(
    algorithm: type[BaseAlgorithm],
    path: str | pathlib.Path | io.BufferedIOBase,
    arguments: dict[str, Any],
    kept: Collection[str],
    older: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Arguments of ``load`` that take effect: Stable-Baselines3 makes attributes of all, whether anything reads them or not.

    :param algorithm: the class that is loaded
    :param path: of the file
    :param arguments: what was passed to ``load`` beside its own parameters
    :param kept: names of those that only the file's value is right for, because the networks were trained with it
    :param older: values of those that the file says nothing of, because its version did not have them
    :return: the arguments by the names of their attributes
    :raises TypeError: for an argument that the class's constructor does not have
    :raises ValueError: for one of ``kept`` that differs from the file's
    """
    known = constructor_parameters(algorithm).keys() - {"policy", "env", "device", "_init_setup_model"}
    unknown = sorted(arguments.keys() - known)
    if unknown:
        raise TypeError(f"{algorithm.__name__} has no arguments {unknown} to change while loading; it has {sorted(known)}")
    fixed = sorted(arguments.keys() & set(kept))
    if fixed:
        data, _, _ = load_from_zip_file(path, device="cpu")
        assert data is not None
        data = {**(older or {}), **data}
        differing = {name: arguments[name] for name in fixed if not _equal(arguments[name], data.get(name))}
        if differing:
            of_file = {name: data.get(name) for name in differing}
            raise ValueError(
                f"{differing} cannot be changed while loading: the file's networks were trained with {of_file}. Leave them "
                f"out, or make a new model; these can be changed: {sorted(known - set(kept))}"
            )
    arguments = {name: value for name, value in arguments.items() if name not in fixed}  # as the file says
    return {"_stats_window_size" if name == "stats_window_size" else name: value for name, value in arguments.items()}


def constructor_parameters(algorithm: Callable[..., BaseAlgorithm]) -> dict[str, inspect.Parameter]:
    """What makes an algorithm takes by name: a function, or a class with what it hands on to its base as ``**kwargs``."""
    if not isinstance(algorithm, type):
        return dict(inspect.signature(algorithm).parameters)
    found: dict[str, inspect.Parameter] = {}
    for cls in algorithm.__mro__:
        if "__init__" not in vars(cls):
            continue
        parameters = dict(inspect.signature(cls).parameters)
        for name, parameter in parameters.items():
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                found.setdefault(name, parameter)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    return found


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, type) and isinstance(other, str):  # a trajectory by its class
        return TRAJECTORIES.get(other) is one
    # FiGAR-SAC's d_max is a number of steps times dt by the time it is saved.
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=1e-9)
    return bool(one == other)
