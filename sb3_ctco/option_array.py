"""Options as ``predict`` returns them: arrays that no environment can mistake for actions."""

from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

MESSAGE = (
    "this is an option [ω, d], the weights of an action trajectory and how long it runs, and not an action: step and evaluate "
    "in an environment that plays options, model.wrap_env(env) or OptionExecutionWrapper(env, ...); a bare environment gets "
    "its actions from OptionController(model); the option's numbers are option.vector"
)

# What looks at options and computes no action from them. A single option allows this alone.
_LOOKS: frozenset[Any] = frozenset(
    {
        *(np.equal, np.not_equal, np.less, np.less_equal, np.greater, np.greater_equal, np.isfinite, np.isnan, np.isinf),
        *(np.allclose, np.array_equal, np.isclose, np.ndim, np.save, np.shape, np.size, np.stack),
    }
)


class Option(NDArrayOperatorsMixin):
    """One of several options, as a VecEnv hands it to its environment.

    It is no array, and refuses to become one: an environment that reads an action from it gets an error that says what
    it was given.

    :param vector: its numbers, ω then d, normalised; shape ``[action_dim · n_rbf + 1]``
    """

    def __init__(self, vector: np.ndarray):
        self.vector = vector

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        raise TypeError(MESSAGE)

    def __getitem__(self, index: Any) -> Any:
        raise TypeError(MESSAGE)

    def __float__(self) -> float:
        raise TypeError(MESSAGE)

    def __getattr__(self, name: str) -> Any:
        # An array has it, perhaps.
        raise AttributeError(f"no {name}: {MESSAGE}")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return _apply(getattr(ufunc, method), ufunc in _LOOKS, inputs, kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _apply(func, func in _LOOKS, args, kwargs)

    def __repr__(self) -> str:
        return f"Option({self.vector.tolist()})"


class OptionArray(np.ndarray):
    """What ``predict`` returns: one option ``[option_dim]``, or several ``[n, option_dim]``.

    Several are an array like any other, but their rows are :class:`Option`. One is an array to look at, compare, store
    and play: to compute with it, or to read a single number of it, is what an environment does that takes it for an
    action, and raises a ``TypeError`` that says so. ``vector`` (or ``np.asarray``) is the plain array.

    Example:
        >>> option = np.array([0.5, -0.5, 1.0]).view(OptionArray)
        >>> option.vector[-1]
        np.float64(1.0)
    """

    @property
    def vector(self) -> np.ndarray:
        """The numbers as a plain array."""
        return self.view(np.ndarray)

    def __getitem__(self, index: Any) -> Any:
        is_row = isinstance(index, int | np.integer)
        if self.ndim > 1:
            return Option(self.vector[index]) if is_row else self.vector[index]
        if is_row:
            raise TypeError(MESSAGE)
        return super().__getitem__(index)

    def __float__(self) -> float:
        raise TypeError(MESSAGE)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        return _apply(getattr(ufunc, method), ufunc in _LOOKS, inputs, kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _apply(func, func in _LOOKS, args, kwargs)

    def __repr__(self) -> str:
        return f"OptionArray({np.array2string(self.vector, separator=', ')})"

    def __str__(self) -> str:
        return str(self.vector)


def plain(value: Any) -> Any:
    """The numbers of an option or of several, also inside lists; whatever else as it is."""
    if isinstance(value, Option | OptionArray):
        return value.vector
    if isinstance(value, list | tuple):
        return type(value)([plain(entry) for entry in value])
    return value


def _apply(function: Any, looks: bool, args: Any, kwargs: dict[str, Any]) -> Any:
    """Call a function of numpy with the options' numbers, if it only looks at them or all of them are arrays of several."""
    if not looks and any(_is_single(arg) for arg in (*args, *kwargs.values())):
        raise TypeError(MESSAGE)
    return function(*[plain(arg) for arg in args], **{name: plain(value) for name, value in kwargs.items()})


def _is_single(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(_is_single(entry) for entry in value)
    return isinstance(value, Option) or (isinstance(value, OptionArray) and value.ndim < 2)
