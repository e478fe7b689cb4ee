"""Observations that hold what an option leaves from unless its join is free: the action that is being sent.

With a smooth join that is followed by how it was changing (:meth:`sb3_ctco.options.OptionSpace.before`).

A vector of floating-point numbers gets it at its end, a dictionary an entry of its own; anything else, an image for
instance, becomes a dictionary of two entries.
"""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_ctco.options.infos import LAST_ACTION
from sb3_ctco.options.semi_mdp import FloatArray

#: The entry of what was no dictionary and no vector
OBSERVATION = "observation"


def with_last_action_space(space: spaces.Space, n_numbers: int) -> spaces.Space:
    """The space of observations that hold the last action.

    :param space: the environment's, of observations without it
    :param n_numbers: how many tell what an option leaves from, ``n_before · action_dim``
    :raises ValueError: if the environment's own observations have an entry of that name
    """
    actions = spaces.Box(-1.0, 1.0, (n_numbers,), np.float32)
    if isinstance(space, spaces.Dict):
        if LAST_ACTION in space.spaces:
            raise ValueError(
                f"a join that is not free adds the entry {LAST_ACTION!r} to observations, and the environment's have one of "
                "that name: rename it, or pass join='free'"
            )
        return spaces.Dict({**space.spaces, LAST_ACTION: actions})
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        low, high = (np.append(bound, end) for bound, end in ((space.low, actions.low), (space.high, actions.high)))
        return spaces.Box(low, high, dtype=space.dtype)  # type: ignore[arg-type]
    return spaces.Dict({OBSERVATION: space, LAST_ACTION: actions})


def with_last_action(space: spaces.Space, observation: Any, action: FloatArray) -> Any:
    """An observation that holds the last action, or several with a leading axis.

    :param space: of :func:`with_last_action_space`
    :param observation: the environment's, ``[*shape]`` or ``[n, *shape]``, or a dictionary of such
    :param action: what an option leaves from, ``[n_numbers]`` or ``[n, n_numbers]``
    :raises ValueError: if a vector is of another length than the environment's
    """
    action = action.clip(-1.0, 1.0)  # rounding
    if isinstance(space, spaces.Box):
        expected = space.shape[0] - action.shape[-1]
        if np.shape(observation)[-1:] != (expected,):
            raise ValueError(
                f"the environment's observations have the shape {(expected,)}, without the last action, which is added here; "
                f"this one has the shape {np.shape(observation)}"
            )
        return np.concatenate([observation, action.astype(space.dtype)], axis=-1)
    parts = observation if isinstance(observation, dict) else {OBSERVATION: observation}
    return {**parts, LAST_ACTION: action.astype(np.float32)}
