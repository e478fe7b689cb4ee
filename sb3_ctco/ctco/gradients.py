"""CTCO's update with gradients worked out by hand, for networks of plain layers.

In an update of small networks autograd and optimizers spend more time on their own bookkeeping than on numbers. CTCO's
losses are a few lines, and so are their gradients: :class:`HandGradients` does, to rounding, what
:meth:`~sb3_ctco.common.soft_actor_critic.SoftOptionActorCritic._update` does with autograd, with the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_ctco.common.policies import LOG_STD_MAX, LOG_STD_MIN, EnsembleLinear
from sb3_ctco.common.soft_actor_critic import critic_loss
from sb3_ctco.ctco.policies import OptionActor, OptionCritic

if TYPE_CHECKING:
    from sb3_ctco.ctco.ctco import CTCO

aten = th.ops.aten


class HandGradients:
    """One update of a :class:`~sb3_ctco.ctco.ctco.CTCO` at a time, without autograd.

    :param model: whose networks it updates; :meth:`possible_for` it must be true
    """

    def __init__(self, model: CTCO):
        self._model = model
        self._actor = _PlainActor(model.actor)
        self._actor_target = _PlainActor(model.actor_target)
        self._critic = PlainNetwork(model.critic.q_networks)
        self._critic_target = PlainNetwork(model.critic_target.q_networks)
        self._memory = _memory(model.policy.parameters())
        self.refresh()

    @staticmethod
    def possible_for(model: CTCO) -> bool:
        """Whether ``model`` has networks of linear layers and rectifiers, and fused Adam that has stepped.

        That its losses are CTCO's own is for the caller to know.
        """
        actors, critics = (model.actor, model.actor_target), (model.critic, model.critic_target)
        optimizers = [model.actor.optimizer, model.critic.optimizer, *filter(None, [model.ent_coef_optimizer])]
        return (
            model.entropy_reference != "duration"  # whose weight is another way to the gradient of d
            and all(type(actor) is OptionActor and _is_plain(actor.latent_pi, nn.Linear) for actor in actors)
            and all(type(critic) is OptionCritic and _is_plain(critic.q_networks, EnsembleLinear) for critic in critics)
            and all(type(network.features_extractor) is FlattenExtractor for network in actors + critics)
            and all(p.requires_grad for network in (model.actor, model.critic) for p in network.parameters())
            and all(_is_fused_adam(optimizer) for optimizer in optimizers)
        )

    def is_valid(self) -> bool:
        """Whether the networks' parameters are still where they were, as they are not after ``policy.to(device)``."""
        return self._memory == _memory(self._model.policy.parameters())

    def refresh(self) -> None:
        """Take step sizes and moments from the optimizers anew, which loading replaces."""
        model = self._model
        self._actor_adam = _Adam(model.actor.optimizer, self._actor.gradients)
        self._critic_adam = _Adam(model.critic.optimizer, self._critic.gradients)
        self._ent_coef_gradient = th.zeros_like(model.log_ent_coefs)
        self._ent_coef_adam: _Adam | None = None
        if model.ent_coef_optimizer is not None:
            self._ent_coef_adam = _Adam(model.ent_coef_optimizer, {model.log_ent_coefs: self._ent_coef_gradient})

    @th.inference_mode()
    def update(self, data: ReplayBufferSamples) -> th.Tensor:
        """Update temperatures, critics, actor and targets.

        :return: the losses of actor, critics and temperatures, ``[3]``
        """
        model = self._model
        obs, next_obs = self._features(data.observations), self._features(data.next_observations)

        options, log_prob = self._actor.sample(obs)
        gradient, ent_coef_loss = model._temperature_gradient(log_prob)
        if self._ent_coef_adam is not None:
            self._ent_coef_gradient.copy_(gradient)
            self._ent_coef_adam.step()

        next_options, next_log_prob = self._actor_target.sample(next_obs)
        next_q_values = self._critic_target.forward(th.cat((next_obs, next_options), dim=1))
        targets = model._targets(data, next_q_values, model.entropy_costs(next_options, next_log_prob))
        q_values = self._critic.forward(th.cat((obs, data.actions), dim=1))
        self._critic.backward((q_values - targets) / len(obs))
        self._critic_adam.step()
        q_loss = critic_loss(q_values, targets)

        q_values = self._critic.forward(th.cat((obs, options), dim=1))
        q_min = q_values.amin(dim=0)
        pi_loss = (model.entropy_costs(options, log_prob) - q_min).mean()
        option_gradient = self._critic.input_gradient((q_values == q_min) / -len(obs), first=obs.shape[1])
        self._actor.backward(option_gradient, model.ent_coefs / len(obs))
        self._actor_adam.step()

        model._update_targets()
        return th.stack((pi_loss, q_loss, ent_coef_loss))

    def write_back(self) -> None:
        """Write to the optimizers how many steps they took."""
        for adam in filter(None, (self._actor_adam, self._critic_adam, self._ent_coef_adam)):
            adam.write_back()

    def _features(self, obs: th.Tensor) -> th.Tensor:
        return self._model.actor.extract_features(obs, self._model.actor.features_extractor)


class PlainNetwork:
    """An ensemble of networks of linear layers with rectifiers between them, and the gradients of its parameters.

    :param layers: ``nn.Linear`` (an ensemble of one) or ``EnsembleLinear``, each but perhaps the last followed by a
        ``nn.ReLU``
    """

    def __init__(self, layers: Iterable[nn.Module]):
        modules = list(layers)
        linear: list[Any] = [module for module in modules if not isinstance(module, nn.ReLU)]
        #: Gradients, which :meth:`backward` writes, by their parameters.
        self.gradients: dict[nn.Parameter, th.Tensor] = {p: th.zeros_like(p) for layer in linear for p in layer.parameters()}
        # Views: an optimizer's steps show in them, and what is written to them in the gradients.
        self._weights = [_as_ensemble(layer.weight.detach()) for layer in linear]
        self._biases = [_as_ensemble(layer.bias.detach()) for layer in linear]
        self._weight_gradients = [_as_ensemble(self.gradients[layer.weight]) for layer in linear]
        self._bias_gradients = [_as_ensemble(self.gradients[layer.bias]) for layer in linear]
        self._n_rectified = sum(isinstance(module, nn.ReLU) for module in modules)
        self._activations: list[th.Tensor] = []

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Outputs ``[n_members, batch, out_features]`` of inputs ``[batch, in_features]``, which are remembered."""
        x = x.expand(len(self._weights[0]), *x.shape)
        self._activations = [x]
        for i, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
            x = th.baddbmm(bias, x, weight)
            if i < self._n_rectified:
                x.relu_()
            self._activations.append(x)
        return x

    def backward(self, gradient: th.Tensor) -> None:
        """Compute :attr:`gradients` from the gradient of the last outputs, of their shape."""
        for i in reversed(range(len(self._weights))):
            gradient = self._before_rectifier(gradient, i)
            th.bmm(self._activations[i].transpose(1, 2), gradient, out=self._weight_gradients[i])
            th.sum(gradient, 1, keepdim=True, out=self._bias_gradients[i])
            if i > 0:
                gradient = th.bmm(gradient, self._weights[i].transpose(1, 2))

    def input_gradient(self, gradient: th.Tensor, first: int = 0) -> th.Tensor:
        """The gradient of the last inputs from that of the outputs; :attr:`gradients` stay.

        :param gradient: of the shape of the outputs
        :param first: from which column of the inputs on
        :return: ``[batch, in_features − first]``, summed over the ensemble
        """
        for i in reversed(range(len(self._weights))):
            weight = self._weights[i] if i > 0 else self._weights[i][:, first:]
            gradient = th.bmm(self._before_rectifier(gradient, i), weight.transpose(1, 2))
        return gradient.sum(dim=0)

    def _before_rectifier(self, gradient: th.Tensor, i: int) -> th.Tensor:
        if i >= self._n_rectified:
            return gradient
        return aten.threshold_backward(gradient, self._activations[i + 1], 0.0)


class _PlainActor:
    """The actor of :class:`~sb3_ctco.ctco.policies.OptionActor`, its samples, and the gradients of its parameters."""

    def __init__(self, actor: OptionActor):
        self._body = PlainNetwork(actor.latent_pi)
        self._heads = [PlainNetwork([actor.omega_head]), PlainNetwork([actor.duration_head])]
        self.gradients = {p: g for network in (self._body, *self._heads) for p, g in network.gradients.items()}
        self._scale = actor.squash_scale
        self._omega_dim = actor.omega_dim
        # Sums the columns of ω in its first column, and has those of d in its second.
        self._parts = th.zeros(self._omega_dim + 1, 2, device=self._scale.device)
        self._parts[:-1, 0] = self._parts[-1, 1] = 1.0
        self._constants = (-self._scale.log() - 0.5 * math.log(2 * math.pi) - 2.0 * math.log(2.0)) @ self._parts

    def sample(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """``OptionActor.option_log_prob``: options and log π of their parts."""
        latent = self._body.forward(obs)[0]
        omega, duration = (head.forward(latent)[0] for head in self._heads)
        n = self._omega_dim
        mean = th.cat((omega[:, :n], duration[:, :1]), dim=1)
        self._raw_log_std = th.cat((omega[:, n:], duration[:, 1:]), dim=1)
        log_std = self._raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        noise = th.randn_like(mean)
        self._deviation = noise * log_std.exp()
        y = (mean + self._deviation) * self._scale
        self._options = y.tanh()
        # squashed_log_prob in fewer operations: its constants are added in the end
        log_prob = F.softplus(-2.0 * y).add_(y).mul_(2.0).sub_(th.addcmul(log_std, noise, noise, value=0.5))
        return self._options, th.addmm(self._constants, log_prob, self._parts)

    def backward(self, option_gradient: th.Tensor, log_prob_gradient: th.Tensor) -> None:
        """Compute :attr:`gradients` from those of the last sample.

        :param option_gradient: of the options, ``[batch, omega_dim + 1]``
        :param log_prob_gradient: of log π of both parts, the same for the whole batch, ``[2]``
        """
        log_prob_gradient = self._parts @ log_prob_gradient
        # The derivative of squashed_log_prob by y, with the noise fixed, is 2·tanh(y); by log_std it is −1.
        y_gradient = aten.tanh_backward(option_gradient, self._options) + 2.0 * log_prob_gradient * self._options
        mean_gradient = y_gradient * self._scale
        log_std_gradient = aten.hardtanh_backward(
            mean_gradient * self._deviation - log_prob_gradient, self._raw_log_std, LOG_STD_MIN, LOG_STD_MAX
        )
        n = self._omega_dim
        parts = (mean_gradient[:, :n], log_std_gradient[:, :n]), (mean_gradient[:, n:], log_std_gradient[:, n:])
        latent_gradient = th.zeros(())
        for head, part in zip(self._heads, parts, strict=True):
            gradient = th.cat(part, dim=1)[None]
            head.backward(gradient)
            latent_gradient = latent_gradient + head.input_gradient(gradient)
        self._body.backward(latent_gradient[None])


class _Adam:
    """PyTorch's fused Adam on an optimizer's own state, without what its ``step`` does beside.

    :param optimizer: that has stepped, so that it has a state
    :param gradients: of its parameters
    """

    def __init__(self, optimizer: th.optim.Optimizer, gradients: dict[Any, th.Tensor]):
        self._groups: list[tuple[tuple[list[th.Tensor], ...], dict[str, Any]]] = []
        self._counters: list[tuple[th.Tensor, list[th.Tensor]]] = []
        for group in optimizer.param_groups:
            states = [optimizer.state[p] for p in group["params"]]
            # Parameters of a group have taken the same number of steps. One counter serves all until the end.
            count = states[0]["step"].clone()
            self._counters.append((count, [state["step"] for state in states]))
            tensors: tuple[list[th.Tensor], ...] = (
                [p.detach() for p in group["params"]],
                [gradients[p] for p in group["params"]],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [count] * len(states),
            )
            options = {
                "lr": group["lr"],
                "beta1": group["betas"][0],
                "beta2": group["betas"][1],
                "weight_decay": group["weight_decay"],
                "eps": group["eps"],
                "amsgrad": False,
                "maximize": False,
            }
            self._groups.append((tensors, options))

    def step(self) -> None:
        for (count, _), (tensors, options) in zip(self._counters, self._groups, strict=True):
            count.add_(1.0)
            th._fused_adam_(*tensors, **options)

    def write_back(self) -> None:
        for count, steps in self._counters:
            for step in steps:
                step.copy_(count)


def _as_ensemble(parameter: th.Tensor) -> th.Tensor:
    """Weights as ``[n_members, in_features, out_features]``, biases as ``[n_members, 1, out_features]``."""
    if parameter.dim() == 3:
        return parameter
    return parameter.t()[None] if parameter.dim() == 2 else parameter[None, None]


def _is_plain(network: nn.Sequential, linear: type[nn.Module]) -> bool:
    """Whether linear layers and rectifiers alternate, beginning with a linear layer."""
    return len(network) > 0 and all(type(module) is (nn.ReLU if i % 2 else linear) for i, module in enumerate(network))


def _is_fused_adam(optimizer: th.optim.Optimizer) -> bool:
    refused = ("amsgrad", "maximize", "capturable", "differentiable", "decoupled_weight_decay")
    return type(optimizer) is th.optim.Adam and all(
        group["fused"] and not any(group.get(name) for name in refused) and all(p in optimizer.state for p in group["params"])
        for group in optimizer.param_groups
    )


def _memory(parameters: Iterable[nn.Parameter]) -> list[int]:
    return [p.data_ptr() for p in parameters]
