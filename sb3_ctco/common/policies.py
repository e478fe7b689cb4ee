"""Parts of the policies of soft actor-critic algorithms with options."""

import math
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac import policies as sac_policies
from torch import nn
from torch.nn import functional as F

# As in Stable-Baselines3's SAC.
LOG_STD_MAX = 2.0
LOG_STD_MIN = -20.0


def squashed_log_prob(noise: th.Tensor, log_std: th.Tensor, y: th.Tensor) -> th.Tensor:
    """Log-density of tanh(y) an entry, where y = mean + noise·std is Gaussian.

    :param noise: standard normal sample
    :param log_std: log standard deviation of y
    :param y: the sample before squashing
    :return: log N(y) − log(1 − tanh²(y)), the shape of ``y``
    """
    gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    # log(1 − tanh²(y)) without cancellation
    return gaussian - 2.0 * (math.log(2.0) - y - F.softplus(-2.0 * y))


def affine(x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """``x @ weight + bias`` of each member of an ensemble.

    BLAS takes several times as long for a matrix of one column, as critics have it, as a product and a sum do.

    :param x: ``[n_members, batch, in_features]``
    :param weight: ``[n_members, in_features, out_features]``
    :param bias: ``[n_members, 1, out_features]``
    :return: ``[n_members, batch, out_features]``
    """
    if weight.shape[2] == 1:
        return (x * weight.transpose(1, 2)).sum(dim=2, keepdim=True) + bias
    return th.baddbmm(bias, x, weight)


class EnsembleLinear(nn.Module):
    """``n_members`` linear layers as one batched product, each initialised as ``nn.Linear`` is.

    :param n_members: number of layers
    :param in_features: size of each input
    :param out_features: size of each output
    """

    def __init__(self, n_members: int, in_features: int, out_features: int):
        super().__init__()
        bound = 1.0 / math.sqrt(in_features)
        self.weight = nn.Parameter(th.empty(n_members, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n_members, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """:param x: ``[n_members, batch, in_features]``
        :return: ``[n_members, batch, out_features]``
        """
        return affine(x, self.weight, self.bias)

    def orthogonal_(self, gain: float) -> None:
        """Initialise each member orthogonally, with zero bias, as Stable-Baselines3's on-policy algorithms do."""
        for weight in self.weight.data:
            nn.init.orthogonal_(weight, gain=gain)
        nn.init.zeros_(self.bias)


def ensemble_mlp(
    n_members: int, in_features: int, net_arch: list[int], out_features: int, activation_fn: type[nn.Module]
) -> nn.Sequential:
    """``n_members`` networks of one shape, evaluated together: Stable-Baselines3's ``create_mlp`` for an ensemble.

    :param net_arch: sizes of the hidden layers
    """
    layers: list[nn.Module] = []
    for size in net_arch:
        layers += [EnsembleLinear(n_members, in_features, size), activation_fn()]
        in_features = size
    return nn.Sequential(*layers, EnsembleLinear(n_members, in_features, out_features))


class SquashedActor(BasePolicy):
    """The body of an actor whose output is in [−1, 1]; subclasses add heads.

    :param observation_space: observation space
    :param action_space: option space
    :param net_arch: sizes of the hidden layers
    :param features_extractor: network to extract features
    :param features_dim: number of features
    :param activation_fn: activation function
    :param normalize_images: whether to divide images by 255
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.latent_pi = nn.Sequential(*create_mlp(features_dim, -1, net_arch, activation_fn))
        #: Size of the body's output, which the heads take
        self.latent_dim = net_arch[-1] if net_arch else features_dim

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
            features_extractor=self.features_extractor,
        )
        return data

    def latent(self, obs: PyTorchObs) -> th.Tensor:
        """Output of the body, ``[batch, latent_dim]``."""
        return self.latent_pi(self.extract_features(obs, self.features_extractor))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)


class EnsembleCritic(BaseModel):
    """An ensemble of ``n_critics`` networks on shared features, evaluated together.

    Options enter normalised to [−1, 1], as the buffer keeps them.

    :param n_critics: number of networks; 2 for clipped double Q-learning
    :param share_features_extractor: whether the features extractor is the actor's, and trained by its loss alone
    :param option_dim: size of what enters beside the features; by default the whole option
    :param n_outputs: Q-values a network
    """

    features_extractor: BaseFeaturesExtractor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        option_dim: int | None = None,
        n_outputs: int = 1,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.n_critics = n_critics
        self.share_features_extractor = share_features_extractor
        in_features = features_dim + (action_space.shape[0] if option_dim is None else option_dim)
        self.q_networks = ensemble_mlp(n_critics, in_features, net_arch, n_outputs, activation_fn)

    def forward(self, obs: PyTorchObs, options: th.Tensor) -> th.Tensor:
        """Q-values, ``[n_critics, batch, n_outputs]``, of options ``[batch, option_dim]``."""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        x = th.cat((features, options), dim=1)
        return self.q_networks(x.expand(self.n_critics, *x.shape))


class SoftOptionPolicy(sac_policies.SACPolicy):
    """Actor, critics and target critics. Parameters are those of Stable-Baselines3's ``SACPolicy``, without gSDE.

    Adam runs fused unless ``optimizer_kwargs`` say otherwise.

    :raises ValueError: if gSDE (``use_sde``) is asked for, or less than one critic
    """

    actor_class: ClassVar[type[SquashedActor]]
    critic_class: ClassVar[type[EnsembleCritic]]

    def __init__(self, *args: Any, **kwargs: Any):
        if kwargs.get("use_sde"):
            raise ValueError(
                f"{type(self).__name__} does not support generalized State-Dependent Exploration: remove use_sde=True"
            )
        if kwargs.get("n_critics", 2) < 1:
            raise ValueError(f"n_critics must be at least 1, not {kwargs['n_critics']}")
        if kwargs.get("optimizer_class", th.optim.Adam) is th.optim.Adam:
            kwargs["optimizer_kwargs"] = {"fused": True, **(kwargs.get("optimizer_kwargs") or {})}
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.critic_target.requires_grad_(False)

    def set_training_mode(self, mode: bool) -> None:
        """Stable-Baselines3's, which asks for a mode before each decision; most often it is that mode already."""
        if mode != self.training:
            super().set_training_mode(mode)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """An actor; with a features extractor of its own unless one is given."""
        kwargs = self._update_features_extractor(self.net_args, features_extractor)
        return self.actor_class(**kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """An ensemble of critics; with a features extractor of its own unless one is given."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(**kwargs).to(self.device)
