"""Policies of CTCO: an actor over options, an ensemble of critics, and a target of both."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
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


class OptionActor(SquashedActor):
    """π_θ(ω, d | s) of section "The Policy": independent Gaussians for ω and d, squashed into their boxes.

    An option is ``tanh(x)`` for ω and ``2·sigmoid(x) − 1`` for d, x being Gaussian with the heads' means and standard
    deviations; the wrapper maps the latter to [d_min, d_max]. ω has a head of its own, and so has d.

    Parameters are those of :class:`~sb3_ctco.common.policies.SquashedActor`; the option space has the shape
    ``[omega_dim + 1]``.
    """

    squash_scale: th.Tensor

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, *args: Any, **kwargs: Any):
        super().__init__(observation_space, action_space, *args, **kwargs)
        self.omega_dim = action_space.shape[0] - 1
        self.omega_head = nn.Linear(self.latent_dim, 2 * self.omega_dim)
        self.duration_head = nn.Linear(self.latent_dim, 2)
        # 2·sigmoid(x) − 1 = tanh(x/2), so one squashing serves both.
        scale = th.ones(self.omega_dim + 1)
        scale[-1] = 0.5
        self.register_buffer("squash_scale", scale, persistent=False)

    def distribution_parameters(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation before squashing, each ``[batch, omega_dim + 1]``."""
        latent = self.latent(obs)
        omega_mean, omega_log_std = self.omega_head(latent).chunk(2, dim=1)
        duration_mean, duration_log_std = self.duration_head(latent).chunk(2, dim=1)
        mean = th.cat((omega_mean, duration_mean), dim=1)
        log_std = th.cat((omega_log_std, duration_log_std), dim=1).clamp(LOG_STD_MIN, LOG_STD_MAX)
        return mean, log_std

    def option_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Reparameterised sample f_θ(s; ε) of section "The Policy", and its log-densities.

        :return: options ``[batch, omega_dim + 1]`` in [−1, 1], and log π of each of their entries, likewise: densities over
            the normalised box
        """
        mean, log_std = self.distribution_parameters(obs)
        noise = th.randn_like(mean)
        # y = x·scale is what tanh is taken of; its density is Gaussian with the scaled deviation.
        y = (mean + noise * log_std.exp()) * self.squash_scale
        return y.tanh(), squashed_log_prob(noise, log_std, y) - self.squash_scale.log()

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Options ``[batch, omega_dim + 1]`` in [−1, 1]: sampled, or those of the means."""
        mean, log_std = self.distribution_parameters(obs)
        x = mean if deterministic else mean + th.randn_like(mean) * log_std.exp()
        return th.tanh(x * self.squash_scale)


class OptionCritic(EnsembleCritic):
    """Q̂_χ(s, ω, d), one Q-value a network; ``n_critics=1`` is the paper's single critic."""


class CTCOPolicy(SoftOptionPolicy):
    """Actor, critics and targets of CTCO; see :class:`~sb3_ctco.common.policies.SoftOptionPolicy`.

    :param target_actor: whether critics' targets sample a target of the actor, which follows it slowly, as in the paper's
        Algorithm 1; without one they sample the actor itself, as SAC's do
    """

    actor_class = OptionActor
    critic_class = OptionCritic
    actor: OptionActor  # type: ignore[assignment]
    actor_target: OptionActor
    critic: OptionCritic  # type: ignore[assignment]
    critic_target: OptionCritic  # type: ignore[assignment]

    def __init__(self, *args: Any, target_actor: bool = True, **kwargs: Any):
        self.target_actor = target_actor
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor.optimizer.register_load_state_dict_pre_hook(_in_one_group)
        if not self.target_actor:
            self.actor_target = self.actor
            return
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.requires_grad_(False)
        self.actor_target.set_training_mode(False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(target_actor=self.target_actor)
        return data


def _in_one_group(_: th.optim.Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    """An optimizer's state with all parameters in one group; in files of 0.1.0 the last ones, of d's head, had their own."""
    groups = state["param_groups"]
    return {**state, "param_groups": [{**groups[0], "params": [p for group in groups for p in group["params"]]}]}


MlpPolicy = CTCOPolicy


class CnnPolicy(CTCOPolicy, sac_policies.CnnPolicy):
    """:class:`CTCOPolicy` with Stable-Baselines3's ``NatureCNN`` as features extractor."""


class MultiInputPolicy(CTCOPolicy, sac_policies.MultiInputPolicy):
    """:class:`CTCOPolicy` with Stable-Baselines3's ``CombinedExtractor``, for dictionary observations."""
