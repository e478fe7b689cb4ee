"""What ends an option before its plan does."""

from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class ValueInterrupt(Protocol):
    """What ends options by the worth of the rest of their plans, such as :class:`~sb3_ctco.interruption.CriticInterrupt`.

    :param check_period: time between two checks of an option, in s
    """

    check_period: float

    def worth_ending(self, observations: Any, rests: np.ndarray) -> np.ndarray:
        """Which of n options to end.

        :param observations: as the policy sees them, ``[n, *observation_shape]``, or a dictionary of such
        :param rests: the rest of each plan as an option, ``[n, option_dim]``
        :return: ``[n]``
        """
