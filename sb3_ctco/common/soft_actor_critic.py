"""Soft actor-critic on options: what CTCO and FiGAR-SAC share, their losses and the loop of updates."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, polyak_update
from torch import nn

from sb3_ctco.common.losses import critic_loss
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.common.policies import EnsembleCritic, SoftOptionPolicy, SquashedActor


class SoftOptionActorCritic(OptionOffPolicyAlgorithm):
    """Soft actor-critic whose options have two parts: what to do, and for how long.

    Each part has temperatures of its own, the duration one, and what to do as many as ``_n_temperatures`` says. Subclasses
    say how the policy is sampled, what the critics learn, and how the actor is judged: ``_sample_policy``, ``_q_values``,
    ``_critic_targets``, ``_critic_loss``, ``_actor_loss``, ``_auto_target_entropy`` and ``_split_target_entropy``.

    Parameters that :class:`~sb3_ctco.common.option_algorithm.OptionOffPolicyAlgorithm` has are documented there:

    :param ent_coef: temperature of what to do: a number, ``"auto"`` to learn it, or ``"auto_0.1"`` to start at 0.1
    :param duration_ent_coef: temperature of the duration, likewise
    :param target_entropy: entropy that learned temperatures keep, a function of the remaining progress, or ``"auto"``
    """

    _kept_when_loaded: ClassVar[tuple[str, ...]] = (
        *OptionOffPolicyAlgorithm._kept_when_loaded,
        "ent_coef",
        "duration_ent_coef",
    )

    policy: SoftOptionPolicy
    actor: SquashedActor
    critic: EnsembleCritic
    critic_target: EnsembleCritic

    def __init__(
        self,
        policy: str | type[SoftOptionPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule,
        *,
        ent_coef: str | float,
        duration_ent_coef: str | float,
        target_entropy: str | float | Schedule,
        **kwargs: Any,
    ):
        super().__init__(policy, env, learning_rate, **kwargs)
        self.ent_coef = ent_coef
        self.duration_ent_coef = duration_ent_coef
        self.target_entropy = target_entropy

    def _setup_model(self) -> None:
        super()._setup_model()
        self._create_aliases()
        self._source_parameters: list[th.Tensor] = []
        self._target_parameters: list[th.Tensor] = []
        # Running statistics of batch normalisation are no parameters, so they are copied to the targets.
        self._batch_norm_stats: list[th.Tensor] = []
        self._batch_norm_stats_target: list[th.Tensor] = []
        for network, target in self._networks_and_targets():
            self._source_parameters += network.parameters()
            self._target_parameters += target.parameters()
            self._batch_norm_stats += get_parameters_by_name(network, ["running_"])
            self._batch_norm_stats_target += get_parameters_by_name(target, ["running_"])
        self._setup_temperatures()

    def _networks_and_targets(self) -> list[tuple[nn.Module, nn.Module]]:
        """The networks that a target follows, each with it."""
        return [(self.critic, self.critic_target)]

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor  # type: ignore[assignment]
        self.critic = self.policy.critic  # type: ignore[assignment]
        self.critic_target = self.policy.critic_target  # type: ignore[assignment]

    def _auto_target_entropy(self) -> float:
        """The target entropy that ``"auto"`` stands for."""
        raise NotImplementedError

    def _split_target_entropy(self, target: float) -> tuple[float, float]:
        """The target entropies of what to do, and of the duration.

        :param target: ``target_entropy`` at the remaining progress
        """
        raise NotImplementedError

    def _setup_temperatures(self) -> None:
        """All temperatures and what belongs to them as vectors ``[n + 1]``: those of what to do, and the duration's."""
        if not callable(self.target_entropy):
            self.target_entropy = parse_target_entropy("target_entropy", self.target_entropy, self._auto_target_entropy())
        coef, learned = _parse_ent_coef("ent_coef", self.ent_coef)
        duration_coef, duration_learned = _parse_ent_coef("duration_ent_coef", self.duration_ent_coef)
        if self.d_min == self.d_max:
            # A duration that is fixed has no entropy to be paid for.
            duration_coef, duration_learned = 0.0, False
        n = self._n_temperatures()
        self._ent_coef_learned = th.tensor([learned] * n + [duration_learned], device=self.device)
        self._target_entropies = th.zeros(n + 1, device=self.device)
        self._update_target_entropies()
        self.log_ent_coefs = th.tensor([coef] * n + [duration_coef], device=self.device).log().requires_grad_(True)
        self.ent_coef_optimizer: th.optim.Adam | None = None
        if learned or duration_learned:
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coefs], lr=self.lr_schedule(1), fused=True)

    def _after_load(self) -> None:
        loaded, n = self.log_ent_coefs.detach(), self._n_temperatures()
        if len(loaded) <= n:  # a file of 0.1.0, with one temperature of what to do
            self._setup_temperatures()
            with th.no_grad():
                self.log_ent_coefs.copy_(th.cat((loaded[:1].repeat(n), loaded[1:])))

    def _n_temperatures(self) -> int:
        """How many temperatures what to do has."""
        return 1

    def _update_target_entropies(self) -> None:
        assert not isinstance(self.target_entropy, str)  # since the temperatures were set up
        current = FloatSchedule(self.target_entropy)(self._current_progress_remaining)
        target, duration_target = self._split_target_entropy(current)
        self._target_entropies[:-1] = target / self._n_temperatures()
        self._target_entropies[-1] = duration_target

    def _sample_policy(self, obs: PyTorchObs) -> tuple[th.Tensor, ...]:
        """Sample the policy, reparameterised.

        :return: what to do, and log π that each temperature is of, ``[batch, n + 1]``; more, if a subclass needs it
        """
        raise NotImplementedError

    def _critic_targets(self, data: ReplayBufferSamples) -> th.Tensor:
        """What the critics learn, ``[batch, 1]``; called without gradients."""
        raise NotImplementedError

    def _critic_loss(self, q_values: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """The critics' loss, of what ``_q_values`` and ``_critic_targets`` returned."""
        return critic_loss(q_values, targets)

    def _q_values(self, data: ReplayBufferSamples) -> th.Tensor:
        """The critics' values of the stored options, ``[n_critics, batch, 1]``."""
        return self.critic(data.observations, data.actions)

    def _actor_loss(self, obs: PyTorchObs, sample: tuple[th.Tensor, ...]) -> th.Tensor:
        """The actor's loss, of what ``_sample_policy`` returned."""
        raise NotImplementedError

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Sample the replay buffer and update temperatures, critics, actor and targets; nothing while it is empty.

        :param gradient_steps: number of updates
        :param batch_size: decisions in a minibatch
        """
        assert self.replay_buffer is not None
        if not self.replay_buffer.size():
            return  # All that was played was somebody else's.
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)

        self._update_target_entropies()
        losses = []
        with self._begin_updates() as update:
            for _ in range(gradient_steps):
                losses.append(update(self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)))

        self._n_updates += gradient_steps
        # What reward_scale="auto" found is saved with the model, which its replay buffer is not.
        self.replay_buffer_kwargs["reward_scale"] = self.replay_buffer.reward_scale  # type: ignore[attr-defined]
        # Read once, because each reading waits for the device.
        pi_loss_mean, q_loss_mean, ent_coef_loss_mean = th.stack(losses).mean(dim=0).tolist()
        ent_coefs = self.ent_coefs
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/ent_coef", ent_coefs[:-1].mean().item())
        self.logger.record("train/duration_ent_coef", ent_coefs[-1].item())
        self.logger.record("train/actor_loss", pi_loss_mean)
        self.logger.record("train/critic_loss", q_loss_mean)
        if self.ent_coef_optimizer is not None:
            self.logger.record("train/ent_coef_loss", ent_coef_loss_mean)

    @property
    def ent_coefs(self) -> th.Tensor:
        """All temperatures, those of what to do and the duration's, ``[n + 1]``, without gradients."""
        return self.log_ent_coefs.detach().exp()

    @contextlib.contextmanager
    def _begin_updates(self) -> Iterator[Callable[[ReplayBufferSamples], th.Tensor]]:
        """What makes the updates of a training: :meth:`_update`, or something faster that computes the same."""
        yield self._update

    @property
    def log_ent_coef(self) -> th.Tensor:
        """The logarithm of the first temperature of what to do, ``[1]``, under the name that Stable-Baselines3's SAC has."""
        return self.log_ent_coefs.detach()[:1]

    def _update(self, data: ReplayBufferSamples) -> th.Tensor:
        """One update of temperatures, critics, actor and targets.

        :return: the losses of actor, critics and temperatures, ``[3]``
        """
        sample = self._sample_policy(data.observations)
        ent_coef_loss = self._update_temperatures(sample[1].detach())

        with th.no_grad():
            targets = self._critic_targets(data)
        q_loss = self._critic_loss(self._q_values(data), targets)
        self.critic.optimizer.zero_grad()
        q_loss.backward()
        self.critic.optimizer.step()

        pi_loss = self._actor_loss(data.observations, sample)
        self.actor.optimizer.zero_grad()
        pi_loss.backward(inputs=[p for p in self.actor.parameters() if p.requires_grad])  # and no gradients for the critics
        self.actor.optimizer.step()

        self._update_targets()
        return th.stack((pi_loss.detach(), q_loss.detach(), ent_coef_loss))

    def _update_temperatures(self, log_prob: th.Tensor) -> th.Tensor:
        """SAC's dual ascent on all temperatures.

        :param log_prob: ``[batch, n + 1]``, over the normalised box
        :return: the loss
        """
        if self.ent_coef_optimizer is None:
            return th.zeros((), device=self.device)
        # The loss is linear in the logarithms, so its gradient needs no backward pass.
        self.log_ent_coefs.grad, loss = self._temperature_gradient(log_prob)
        self.ent_coef_optimizer.step()
        return loss

    def _temperature_gradient(self, log_prob: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The gradient of the temperatures' loss by their logarithms; zero for a temperature that is fixed.

        :param log_prob: ``[batch, n + 1]``, over the normalised box
        :return: the gradient, ``[n + 1]``, and the loss
        """
        excess = th.where(self._ent_coef_learned, log_prob.mean(dim=0) + self._target_entropies, 0.0)
        # A temperature of zero is fixed and has no finite logarithm.
        loss = -(th.where(self._ent_coef_learned, self.log_ent_coefs.detach(), 0.0) * excess).sum()
        return -excess, loss

    def _update_targets(self) -> None:
        with th.no_grad():
            # Stable-Baselines3's polyak_update of all parameters in one call
            th._foreach_lerp_(self._target_parameters, self._source_parameters, self.tau)
        polyak_update(self._batch_norm_stats, self._batch_norm_stats_target, 1.0)

    def _excluded_save_params(self) -> list[str]:
        aliases = ["actor", "critic", "critic_target"]
        derived = [
            "_source_parameters",
            "_target_parameters",
            "_batch_norm_stats",
            "_batch_norm_stats_target",
            "_ent_coef_learned",
            "_target_entropies",
        ]
        return super()._excluded_save_params() + aliases + derived

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer"]
        if self.ent_coef_optimizer is not None:
            state_dicts.append("ent_coef_optimizer")
        return state_dicts, ["log_ent_coefs"]


def parse_target_entropy(name: str, value: str | float, auto: float) -> float:
    """A target entropy that is no function.

    :raises ValueError: if it is neither "auto" nor a finite number
    """
    try:
        target = auto if isinstance(value, str) and value == "auto" else float(value)
    except (TypeError, ValueError):
        target = math.nan
    if not math.isfinite(target):
        raise ValueError(f"{name} must be a number, a function of the remaining progress or 'auto', not {value!r}")
    return target


def _parse_ent_coef(name: str, value: str | float) -> tuple[float, bool]:
    """A temperature's initial value, and whether it is learned.

    :raises ValueError: if ``value`` is neither a number that is at least 0, nor "auto", nor "auto_<positive number>"
    """
    learned = isinstance(value, str) and (value == "auto" or value.startswith("auto_"))
    try:
        initial = float(value.removeprefix("auto").removeprefix("_") or 1.0) if learned else float(value)  # type: ignore
    except ValueError:
        initial = -1.0
    if initial < 0 or (learned and initial == 0) or not math.isfinite(initial):
        raise ValueError(f"{name} must be a number of at least 0, 'auto', or 'auto_<positive number>', not {value!r}")
    return initial, learned
