"""Ending an option early, by the learned values."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_ctco.ctco import CTCO
from sb3_ctco.options import check_seconds

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecNormalize


class CriticInterrupt:
    """Ends an option when deciding anew is worth more than the rest of its plan.

    At a check the rest of the plan is fitted as an option, and the critics value it, and the policy's greedy option there,
    as a batch of two. Deciding anew costs β_h, which the rest has paid already: it must be worth more by that and a margin,
    to each of the critics. The longest that an option runs is still what the policy chose.

    For :class:`~sb3_ctco.wrappers.RealTimeOptionWrapper` and :class:`~sb3_ctco.controller.OptionController`::

        OptionController(model, interrupt=CriticInterrupt(model, check_period=0.05))

    :param model: CTCO, trained or in training
    :param check_period: time between two checks of an option, in s, rounded to whole steps
    :param margin: how much more deciding anew must be worth beside β_h, in the unit of the critics' values
    :param vec_normalize: normalises observations as in training, if training did; by default the one around the
        environment that the model has
    :raises TypeError: if the model is no CTCO, whose critics alone value any option
    :raises ValueError: if ``check_period`` is not a positive number, or the margin not finite
    """

    def __init__(self, model: CTCO, check_period: float, margin: float = 0.0, vec_normalize: "VecNormalize | None" = None):
        if not isinstance(model, CTCO):
            raise TypeError(f"the critics that end an option are CTCO's, not {type(model).__name__}'s")
        check_seconds(check_period=check_period)
        if not math.isfinite(margin):
            raise ValueError(f"margin must be a finite number, in the unit of the critics' values, not {margin}")
        self.model = model
        self.check_period = float(check_period)
        self.margin = float(margin)
        self.vec_normalize = model.get_vec_normalize_env() if vec_normalize is None else vec_normalize

    def worth_ending(self, observations: Any, rests: np.ndarray) -> np.ndarray:
        """Which options to end.

        :param observations: as the policy sees them, ``[n, *observation_shape]``, or a dictionary of such
        :param rests: the rest of each plan as an option, ``[n, option_dim]``
        :return: ``[n]``
        """
        model = self.model
        if self.vec_normalize is not None:
            observations = self.vec_normalize.normalize_obs(observations)
        with th.no_grad():
            obs: Any = model.policy.obs_to_tensor(observations)[0]
            anew = model.actor(obs, deterministic=True)
            both = (
                {key: leaf.repeat(2, *[1] * (leaf.ndim - 1)) for key, leaf in obs.items()}
                if isinstance(obs, dict)
                else (obs.repeat(2, *[1] * (obs.ndim - 1)))
            )
            options = th.cat((th.as_tensor(rests, dtype=anew.dtype, device=anew.device), anew))
            # A critic may have several outputs, such as quantiles.
            of_rests, of_anew = model.critic(both, model._as_critics_see(options)).mean(dim=2).chunk(2, dim=1)
        gains: np.ndarray = (of_anew - of_rests).amin(dim=0).cpu().numpy()
        return gains > model._current_high_freq_penalty() + self.margin
