"""Policies of FiGAR-SAC: an actor over actions and repetitions, and critics with one output a repetition."""

from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac import policies as sac_policies
from torch import nn

from sb3_ctco.common.policies import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    EnsembleCritic,
    SoftOptionPolicy,
    SquashedActor,
    squashed_log_prob,
)

Numbers = TypeVar("Numbers", np.ndarray, th.Tensor)


def encode_repetitions(repetitions: Numbers, n_repetitions: int) -> Numbers:
    """A repetition k of {1, …, K} as the last entry of an option: 2(k − 1)/(K − 1) − 1.

    With ``d_min = dt`` and ``d_max = K·dt`` the wrapper maps it to k·dt, give or take a relative error of single
    precision, and rounds to the nearest step: exactly k while K < 10⁶.

    :param repetitions: k, floating point
    :param n_repetitions: K
    :return: in [−1, 1], the shape of ``repetitions``
    """
    return 2.0 * (repetitions - 1.0) / max(n_repetitions - 1, 1) - 1.0


def decode_repetitions(encoded: Numbers, n_repetitions: int) -> Numbers:
    """The repetition k of {1, …, K} that :func:`encode_repetitions` encoded.

    :param encoded: in [−1, 1]
    :param n_repetitions: K
    :return: k, a whole number in floating point, the shape of ``encoded``
    """
    return (0.5 * (encoded + 1.0) * (n_repetitions - 1)).round() + 1.0


class FiGARActor(SquashedActor):
    """π_a(a|s), a Gaussian squashed by tanh, and π_x(k|s), a categorical distribution over {1, …, K}.

    Both are heads of one body, and independent of each other given the state.

    Parameters are those of :class:`~sb3_ctco.common.policies.SquashedActor`; the option space has the shape
    ``[action_dim + 1]``.

    :param n_repetitions: K
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        *args: Any,
        n_repetitions: int,
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, *args, **kwargs)
        self.n_repetitions = n_repetitions
        self.action_dim = action_space.shape[0] - 1
        self.action_head = nn.Linear(self.latent_dim, 2 * self.action_dim)
        self.repetition_head = nn.Linear(self.latent_dim, n_repetitions)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(n_repetitions=self.n_repetitions)
        return data

    def distribution_parameters(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Mean and log standard deviation of an action before squashing, each ``[batch, action_dim]``, and log π_x(·|s).

        :return: the last one ``[batch, K]``
        """
        latent = self.latent(obs)
        mean, log_std = self.action_head(latent).chunk(2, dim=1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX), self.repetition_head(latent).log_softmax(dim=1)

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Reparameterised sample of an action, and the distribution of its repetition.

        :return: actions ``[batch, action_dim]`` in [−1, 1], log π_a(a|s) as a density over that box ``[batch]``, and
            log π_x(·|s) ``[batch, K]``
        """
        mean, log_std, repetition_log_probs = self.distribution_parameters(obs)
        noise = th.randn_like(mean)
        y = mean + noise * log_std.exp()
        return y.tanh(), squashed_log_prob(noise, log_std, y).sum(dim=1), repetition_log_probs

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Options ``[batch, action_dim + 1]`` in [−1, 1]; the mean action and the likeliest k if ``deterministic``."""
        mean, log_std, repetition_log_probs = self.distribution_parameters(obs)
        if deterministic:
            y, index = mean, repetition_log_probs.argmax(dim=1, keepdim=True)
        else:
            y = mean + th.randn_like(mean) * log_std.exp()
            index = th.multinomial(repetition_log_probs.exp(), 1)
        duration = encode_repetitions(index.to(y.dtype) + 1.0, self.n_repetitions)
        return th.cat((y.tanh(), duration), dim=1)


class FiGARCritic(EnsembleCritic):
    """Q_i(s, a) ∈ R^K: one network's output k is the value of repeating a for k steps.

    :param n_repetitions: K
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        *,
        n_repetitions: int,
        **kwargs: Any,
    ):
        action_dim = action_space.shape[0] - 1
        super().__init__(observation_space, action_space, option_dim=action_dim, n_outputs=n_repetitions, **kwargs)


class FiGARSACPolicy(SoftOptionPolicy):
    """Actor, critics and target critics of FiGAR-SAC; see :class:`~sb3_ctco.common.policies.SoftOptionPolicy`.

    :param n_repetitions: K; :class:`~sb3_ctco.figar_sac.FiGARSAC` passes its own
    """

    actor_class = FiGARActor
    critic_class = FiGARCritic
    actor: FiGARActor  # type: ignore[assignment]
    critic: FiGARCritic  # type: ignore[assignment]
    critic_target: FiGARCritic  # type: ignore[assignment]

    def __init__(self, *args: Any, n_repetitions: int, **kwargs: Any):
        self._n_repetitions = n_repetitions
        super().__init__(*args, **kwargs)

    def _update_features_extractor(self, net_kwargs: dict[str, Any], *args: Any) -> dict[str, Any]:
        return {**super()._update_features_extractor(net_kwargs, *args), "n_repetitions": self._n_repetitions}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(n_repetitions=self._n_repetitions)
        return data


MlpPolicy = FiGARSACPolicy


class CnnPolicy(FiGARSACPolicy, sac_policies.CnnPolicy):
    """:class:`FiGARSACPolicy` with Stable-Baselines3's ``NatureCNN`` as features extractor."""


class MultiInputPolicy(FiGARSACPolicy, sac_policies.MultiInputPolicy):
    """:class:`FiGARSACPolicy` with Stable-Baselines3's ``CombinedExtractor``, for dictionary observations."""
