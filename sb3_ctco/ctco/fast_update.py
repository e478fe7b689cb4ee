"""CTCO's update with gradients worked out by hand, for networks of plain layers.

In an update of small networks autograd and optimizers spend more time on their own bookkeeping than on numbers. CTCO's
losses are a few lines, and so are their gradients: :class:`FastUpdate` does, to rounding, what
:meth:`~sb3_ctco.common.soft_actor_critic.SoftOptionActorCritic._update` does with autograd, with the same random numbers.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_ctco.common.losses import critic_loss
from sb3_ctco.common.policies import LOG_STD_MAX, LOG_STD_MIN, EnsembleLinear, affine
from sb3_ctco.ctco.policies import OptionActor, OptionCritic

if TYPE_CHECKING:
    from sb3_ctco.ctco.ctco import CTCO

aten = th.ops.aten

#: A layer, and which of its outputs. A list of such is a layer that has these outputs side by side.
Part = tuple[nn.Module, slice]


class FastUpdate:
    """Updates of a :class:`~sb3_ctco.ctco.ctco.CTCO` without autograd, on copies of its networks' parameters.

    :meth:`load` takes the copies and :meth:`store` writes them back: around every training.

    :param model: whose networks it updates; :meth:`refusal` must have nothing to say against it
    """

    def __init__(self, model: CTCO):
        self._model = model
        self._actors = _PlainActors(model.actor, model.actor_target, model._parts)
        self._critics = PlainNetworks(_layers(model.critic.q_networks), _layers(model.critic_target.q_networks))
        self._memory = _memory(model.policy.parameters())

    @staticmethod
    def refusal(model: CTCO) -> str | None:
        """Why ``model`` must be updated with autograd: what gradients were not worked out for; None if nothing is."""
        from sb3_ctco.ctco.ctco import CTCO

        actors, critics = (model.actor, model.actor_target), (model.critic, model.critic_target)
        networks = actors + critics
        optimizers = [model.actor.optimizer, model.critic.optimizer, *filter(None, [model.ent_coef_optimizer])]
        overridden = [name for name in vars(model) if inspect.isfunction(getattr(type(model), name, None))]
        plain_networks = all(type(actor) is OptionActor and _is_plain(actor.latent_pi, nn.Linear) for actor in actors) and all(
            type(critic) is OptionCritic and _is_plain(critic.q_networks, EnsembleLinear) for critic in critics
        )
        reasons = {
            f"{type(model).__name__} is a subclass of CTCO, which may have losses of its own": type(model) is not CTCO,
            f"the model has methods of its own: {overridden}": overridden,
            "the networks are others than linear layers with rectifiers between them": not plain_networks,
            "the features extractor has something to learn": any(
                type(network.features_extractor) is not FlattenExtractor for network in networks
            ),
            "parameters are frozen": not all(p.requires_grad for one in (model.actor, model.critic) for p in one.parameters()),
            "a network or a parameter has hooks": any(map(_has_hooks, networks)),
            # Optimizers get their state with their first step.
            "an optimizer is another than fused Adam, has hooks, or has made no step so far": not all(
                map(_is_plain_adam, optimizers)
            ),
        }
        return next((reason for reason, applies in reasons.items() if applies), None)

    def is_valid(self) -> bool:
        """Whether the networks' parameters are still where they were, as they are not after ``policy.to(device)``."""
        return self._memory == _memory(self._model.policy.parameters())

    def load(self) -> None:
        """Take parameters from the networks, step sizes and moments from the optimizers."""
        model = self._model
        for networks in (self._actors.networks, self._critics):
            th._foreach_copy_(networks.copies, networks.originals)
        self._actor_adam = _Adam(model.actor.optimizer, self._actors.networks.learned)
        self._critic_adam = _Adam(model.critic.optimizer, self._critics.learned)
        self._ent_coef_gradient = th.zeros_like(model.log_ent_coefs)
        self._ent_coef_adam: _Adam | None = None
        if model.ent_coef_optimizer is not None:
            learned = {model.log_ent_coefs: [(slice(None), model.log_ent_coefs.detach()[None], self._ent_coef_gradient[None])]}
            self._ent_coef_adam = _Adam(model.ent_coef_optimizer, learned)

    def store(self) -> None:
        """Write parameters to the networks, and to the optimizers how many steps they took."""
        with th.no_grad():
            for networks in (self._actors.networks, self._critics):
                th._foreach_copy_(networks.originals, networks.copies)
        for adam in filter(None, (self._actor_adam, self._critic_adam, self._ent_coef_adam)):
            adam.store()

    @th.inference_mode()
    def update(self, data: ReplayBufferSamples) -> th.Tensor:
        """Update temperatures, critics, actor and targets.

        :return: the losses of actor, critics and temperatures, ``[3]``
        """
        model, n_critics = self._model, self._critics.n_learned
        features = th.stack([self._features(obs) for obs in (data.observations, data.next_observations)])
        batch_size = features.shape[1]

        # Of the actor in the observations, and of its target in the next.
        options, log_prob = self._actors.sample(features)
        gradient, ent_coef_loss = model._temperature_gradient(log_prob[0])
        if self._ent_coef_adam is not None:
            self._ent_coef_gradient.copy_(gradient)
            self._ent_coef_adam.step()

        inputs = th.cat((features, model._as_critics_see(th.stack((data.actions, options[1])))), dim=2)
        # Of the critics, and of their targets.
        q_values, next_q_values = self._critics.forward(
            inputs[:, None].expand(-1, n_critics, -1, -1).flatten(end_dim=1)
        ).split(n_critics)
        targets = model._targets(data, next_q_values, model.entropy_costs(log_prob[1]))
        self._critics.backward((q_values - targets) / batch_size)
        self._critic_adam.step()
        q_loss = critic_loss(q_values, targets)

        inputs = th.cat((features[0], model._as_critics_see(options[0])), dim=1)
        q_values = self._critics.forward(inputs.expand(n_critics, -1, -1))
        q_min = q_values.amin(dim=0)
        pi_loss = (model.entropy_costs(log_prob[0]) - q_min).mean()
        option_gradient = self._critics.input_gradient((q_values == q_min) / -batch_size, first=features.shape[2])
        if model._canonical is not None:
            option_gradient = model._canonical.gradient(option_gradient, options[0])
        self._actors.backward(option_gradient, model.ent_coefs / batch_size)
        self._actor_adam.step()

        self._critics.update_targets(model.tau)
        self._actors.networks.update_targets(model.tau if model.policy.target_actor else 1.0)
        return th.stack((pi_loss, q_loss, ent_coef_loss))

    def _features(self, obs: th.Tensor) -> th.Tensor:
        return self._model.actor.extract_features(obs, self._model.actor.features_extractor)


class PlainNetworks:
    """An ensemble of networks of linear layers with rectifiers between them, and its targets, side by side.

    It works on copies of their parameters, and has the gradients of the ensemble's.

    :param learned: layers of the ensemble: ``EnsembleLinear``, or ``nn.Linear`` for an ensemble of one
    :param targets: layers of its targets
    """

    def __init__(self, learned: Sequence[Sequence[Part]], targets: Sequence[Sequence[Part]]):
        #: Parameters, as views, and their copies here.
        self.originals: list[th.Tensor] = []
        self.copies: list[th.Tensor] = []
        #: Of each parameter of the ensemble: rows, and their copy and gradient here.
        self.learned: dict[nn.Parameter, list[tuple[slice, th.Tensor, th.Tensor]]] = {}
        self._stacks: list[th.Tensor] = []
        weights, biases = (
            [self._stack(parts, name) for parts in zip(learned, targets, strict=True)] for name in ("weight", "bias")
        )
        #: How many members the ensemble has; :meth:`forward` evaluates these alone, or those of the targets as well.
        self.n_learned = len(weights[0][1])
        self._weights = {n: [weight[:n] for weight, _ in weights] for n in (self.n_learned, len(weights[0][0]))}
        self._biases = {n: [bias[:n] for bias, _ in biases] for n in self._weights}
        self._gradients = [(weight, bias) for (_, weight), (_, bias) in zip(weights, biases, strict=True)]
        self._learned_stacks = [stack[: self.n_learned] for stack in self._stacks]
        self._target_stacks = [stack[self.n_learned :] for stack in self._stacks]
        self._activations: list[th.Tensor] = []

    def _stack(self, ensembles: Sequence[Sequence[Part]], name: str) -> tuple[th.Tensor, th.Tensor]:
        """Copies of weights or biases of a layer of all members, and what will be the gradient of the learned.

        :return: ``[n_members, in_features, out_features]``, or ``[n_members, 1, out_features]``
        """
        views = [[_rows(getattr(module, name).detach(), rows) for module, rows in parts] for parts in ensembles]
        stack = th.cat([th.cat(parts, dim=1) for parts in views])
        gradient = th.zeros_like(stack[: len(views[0][0])])
        first_member = 0
        for parts, part_views in zip(ensembles, views, strict=True):
            members, first_row = slice(first_member, first_member + len(part_views[0])), 0
            for (module, rows), view in zip(parts, part_views, strict=True):
                part = (members, slice(first_row, first_row + view.shape[1]))
                self.originals.append(view)
                self.copies.append(stack[part])
                if first_member == 0:
                    self.learned.setdefault(getattr(module, name), []).append((rows, stack[part], gradient[part]))
                first_row += view.shape[1]
            first_member += len(part_views[0])
        self._stacks.append(stack)
        if isinstance(ensembles[0][0][0], nn.Linear):
            return (stack.mT, gradient.mT) if name == "weight" else (stack[:, None], gradient[:, None])
        return stack, gradient

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Outputs ``[n_members, batch, out_features]`` of inputs ``[n_members, batch, in_features]``, which are remembered."""
        weights, biases = self._weights[len(x)], self._biases[len(x)]
        self._activations = [x]
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = affine(x if i == 0 else x.relu_(), weight, bias)
            self._activations.append(x)
        return x

    def backward(self, gradient: th.Tensor) -> None:
        """Compute the gradients of the ensemble's parameters.

        :param gradient: of its last outputs, ``[n_learned, batch, out_features]``
        """
        for i in reversed(range(len(self._gradients))):
            weight_gradient, bias_gradient = self._gradients[i]
            activations = self._activations[i][: self.n_learned]
            if gradient.shape[2] == 1:
                th.bmm(gradient.mT, activations, out=weight_gradient.mT)  # BLAS is slow the other way, see affine
            else:
                th.bmm(activations.mT, gradient, out=weight_gradient)
            th.sum(gradient, 1, keepdim=True, out=bias_gradient)
            if i > 0:
                gradient = self._before_layer(gradient, i)

    def input_gradient(self, gradient: th.Tensor, first: int = 0) -> th.Tensor:
        """The gradient of the ensemble's last inputs, summed over its members.

        :param gradient: of its last outputs, ``[n_learned, batch, out_features]``
        :param first: from which column of the inputs on
        :return: ``[batch, in_features − first]``
        """
        for i in reversed(range(1, len(self._gradients))):
            gradient = self._before_layer(gradient, i)
        return _times_transposed(gradient, self._weights[self.n_learned][0][:, first:]).sum(dim=0)

    def _before_layer(self, gradient: th.Tensor, i: int) -> th.Tensor:
        """The gradient of what the rectifier before layer ``i`` was given, from that of the layer's outputs."""
        gradient = _times_transposed(gradient, self._weights[self.n_learned][i])
        return aten.threshold_backward(gradient, self._activations[i][: self.n_learned], 0.0)

    def update_targets(self, tau: float) -> None:
        """Stable-Baselines3's ``polyak_update``."""
        th._foreach_lerp_(self._target_stacks, self._learned_stacks, tau)


class _PlainActors:
    """The actor of :class:`~sb3_ctco.ctco.policies.OptionActor` and its target: samples, and the actor's gradients."""

    def __init__(self, actor: OptionActor, target: OptionActor, parts: th.Tensor):
        self._n = n = actor.omega_dim

        def layers(actor: OptionActor) -> list[list[Part]]:
            omega, duration = actor.omega_head, actor.duration_head
            means, log_stds = [(omega, slice(n)), (duration, slice(1))], [(omega, slice(n, None)), (duration, slice(1, None))]
            return [*_layers(actor.latent_pi), [*means, *log_stds]]

        self.networks = PlainNetworks(layers(actor), layers(target))
        self._scale = actor.squash_scale
        self._parts = parts
        self._constants = (-self._scale.log() - 0.5 * math.log(2 * math.pi) - 2.0 * math.log(2.0)) @ self._parts

    def sample(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """``CTCO._sample_policy``: options, and log π of their parts, of both actors.

        :param obs: ``[2, batch, features]``
        :return: ``[2, batch, omega_dim + 1]`` and ``[2, batch, n_weights + 1]``
        """
        mean, raw_log_std = self.networks.forward(obs).split(self._n + 1, dim=2)
        log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        noise = th.empty_like(log_std)
        for one in noise:  # as randn_like would draw it for one actor after the other
            one.normal_()
        deviation = noise * log_std.exp()
        y = (mean + deviation) * self._scale
        options = y.tanh()
        # squashed_log_prob in fewer operations: its constants are added in the end
        log_prob = F.softplus(-2.0 * y).add_(y).mul_(2.0).sub_(th.addcmul(log_std, noise, noise, value=0.5))
        self._options, self._deviation, self._raw_log_std = options[0], deviation[0], raw_log_std[0]
        return options, (log_prob @ self._parts).add_(self._constants)

    def backward(self, option_gradient: th.Tensor, log_prob_gradient: th.Tensor) -> None:
        """Compute the gradients of the actor's parameters from those of its last sample.

        :param option_gradient: of the options, ``[batch, omega_dim + 1]``
        :param log_prob_gradient: of log π of the parts, the same for the whole batch, ``[n_weights + 1]``
        """
        log_prob_gradient = self._parts @ log_prob_gradient
        # The derivative of squashed_log_prob by y, with the noise fixed, is 2·tanh(y); by log_std it is −1.
        y_gradient = aten.tanh_backward(option_gradient, self._options) + 2.0 * log_prob_gradient * self._options
        mean_gradient = y_gradient * self._scale
        log_std_gradient = aten.hardtanh_backward(
            mean_gradient * self._deviation - log_prob_gradient, self._raw_log_std, LOG_STD_MIN, LOG_STD_MAX
        )
        self.networks.backward(th.cat((mean_gradient, log_std_gradient), dim=1)[None])


class _Adam:
    """PyTorch's fused Adam on an optimizer's own moments, without what its ``step`` does beside.

    :param optimizer: that has stepped, so that it has a state
    :param learned: of each of its parameters, rows, their values and their gradients, see :class:`PlainNetworks`
    """

    def __init__(self, optimizer: th.optim.Optimizer, learned: dict[Any, list[tuple[slice, th.Tensor, th.Tensor]]]):
        self._groups: list[tuple[tuple[list[th.Tensor], ...], dict[str, Any]]] = []
        self._counters: list[tuple[th.Tensor, list[th.Tensor]]] = []
        for group in optimizer.param_groups:
            states = [optimizer.state[p] for p in group["params"]]
            # Parameters of a group have taken the same number of steps. One counter serves all until the end.
            count = states[0]["step"].clone()
            self._counters.append((count, [state["step"] for state in states]))
            pieces = [
                (value, gradient, _rows(state["exp_avg"], rows), _rows(state["exp_avg_sq"], rows))
                for p, state in zip(group["params"], states, strict=True)
                for rows, value, gradient in learned[p]
            ]
            tensors = (*(list(column) for column in zip(*pieces, strict=True)), [], [count] * len(pieces))
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

    def store(self) -> None:
        for count, steps in self._counters:
            for step in steps:
                step.copy_(count)


def _layers(network: nn.Sequential) -> list[list[Part]]:
    return [[(module, slice(None))] for module in network if not isinstance(module, nn.ReLU)]


def _rows(parameter: th.Tensor, rows: slice) -> th.Tensor:
    """Rows of a parameter of ``nn.Linear`` as of an ensemble of one; ``EnsembleLinear`` has its own as they are."""
    return parameter if parameter.dim() == 3 else parameter[rows][None]


def _times_transposed(gradient: th.Tensor, weight: th.Tensor) -> th.Tensor:
    return gradient * weight.mT if weight.shape[2] == 1 else th.bmm(gradient, weight.mT)


def _is_plain(network: nn.Sequential, linear: type[nn.Module]) -> bool:
    """Whether linear layers and rectifiers alternate, beginning with a linear layer."""
    return len(network) > 0 and all(type(module) is (nn.ReLU if i % 2 else linear) for i, module in enumerate(network))


def _has_hooks(network: nn.Module) -> bool:
    return any(
        module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks
        for module in network.modules()
    ) or any(p._backward_hooks or p._post_accumulate_grad_hooks for p in network.parameters())


def _is_plain_adam(optimizer: th.optim.Optimizer) -> bool:
    refused = ("amsgrad", "maximize", "capturable", "differentiable", "decoupled_weight_decay")
    hooks = optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks or "step" in vars(optimizer)
    return (type(optimizer) is th.optim.Adam and not hooks) and all(
        group["fused"] and not any(group.get(name) for name in refused) and all(p in optimizer.state for p in group["params"])
        for group in optimizer.param_groups
    )


def _memory(parameters: Iterable[nn.Parameter]) -> list[int]:
    return [p.data_ptr() for p in parameters]
