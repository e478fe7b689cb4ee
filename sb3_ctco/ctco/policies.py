"""Policies of CTCO: an actor over options, an ensemble of critics, and a target of both."""

import math
from typing import Any

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


class OptionActor(BasePolicy):
    """π_θ(ω, d | s) of section "The Policy": independent Gaussians for ω and d, squashed into their boxes.

    An option is ``tanh(x)`` for ω and ``2·sigmoid(x) − 1`` for d, x being Gaussian with the heads' means and standard
    deviations; the wrapper maps the latter to ``d_min + (d_max − d_min)·sigmoid(x)``. ω has a head of its own, and so
    has d, whose step size may differ.

    :param observation_space: observation space
    :param action_space: option space, shape ``[omega_dim + 1]``
    :param net_arch: sizes of the hidden layers
    :param features_extractor: network to extract features
    :param features_dim: number of features
    :param activation_fn: activation function
    :param normalize_images: whether to divide images by 255
    """

    action_space: spaces.Box
    squash_scale: th.Tensor

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

        self.omega_dim = action_space.shape[0] - 1
        self.latent_pi = nn.Sequential(*create_mlp(features_dim, -1, net_arch, activation_fn))
        latent_dim = net_arch[-1] if net_arch else features_dim
        self.omega_head = nn.Linear(latent_dim, 2 * self.omega_dim)
        self.duration_head = nn.Linear(latent_dim, 2)
        # 2·sigmoid(x) − 1 = tanh(x/2), so one squashing serves both.
        scale = th.ones(self.omega_dim + 1)
        scale[-1] = 0.5
        self.register_buffer("squash_scale", scale, persistent=False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
            features_extractor=self.features_extractor,
        )
        return data

    def distribution_parameters(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation before squashing, each ``[batch, omega_dim + 1]``."""
        latent = self.latent_pi(self.extract_features(obs, self.features_extractor))
        omega_mean, omega_log_std = self.omega_head(latent).chunk(2, dim=1)
        duration_mean, duration_log_std = self.duration_head(latent).chunk(2, dim=1)
        mean = th.cat((omega_mean, duration_mean), dim=1)
        log_std = th.cat((omega_log_std, duration_log_std), dim=1).clamp(LOG_STD_MIN, LOG_STD_MAX)
        return mean, log_std

    def option_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Reparameterised sample f_θ(s; ε) of section "The Policy", and its log-densities.

        :return: options ``[batch, omega_dim + 1]`` in [−1, 1], and log π(ω|s), log π(d|s) as the columns of
            ``[batch, 2]``, densities over the normalised box
        """
        mean, log_std = self.distribution_parameters(obs)
        noise = th.randn_like(mean)
        # y = x·scale is what tanh is taken of; its density is Gaussian with the scaled deviation.
        y = (mean + noise * log_std.exp()) * self.squash_scale
        log_prob = squashed_log_prob(noise, log_std, y) - self.squash_scale.log()
        omega_log_prob = log_prob[:, :-1].sum(dim=1)
        return y.tanh(), th.stack((omega_log_prob, log_prob[:, -1]), dim=1)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Options ``[batch, omega_dim + 1]`` in [−1, 1]: sampled, or those of the means."""
        mean, log_std = self.distribution_parameters(obs)
        x = mean if deterministic else mean + th.randn_like(mean) * log_std.exp()
        return th.tanh(x * self.squash_scale)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)


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
        return th.baddbmm(self.bias, x, self.weight)


class OptionCritic(BaseModel):
    """Q̂_χ(s, ω, d): an ensemble of ``n_critics`` networks on shared features, evaluated together.

    Options enter normalised to [−1, 1], as the buffer keeps them.

    :param n_critics: number of networks; 2 for clipped double Q-learning, 1 for the paper's single critic
    :param share_features_extractor: whether the features extractor is the actor's, and trained by its loss alone
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
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.n_critics = n_critics
        self.share_features_extractor = share_features_extractor
        layers: list[nn.Module] = []
        in_features = features_dim + action_space.shape[0]
        for out_features in net_arch:
            layers += [EnsembleLinear(n_critics, in_features, out_features), activation_fn()]
            in_features = out_features
        self.q_networks = nn.Sequential(*layers, EnsembleLinear(n_critics, in_features, 1))

    def forward(self, obs: PyTorchObs, options: th.Tensor) -> th.Tensor:
        """Q-values, ``[n_critics, batch, 1]``, of options ``[batch, option_dim]``."""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        x = th.cat((features, options), dim=1)
        return self.q_networks(x.expand(self.n_critics, *x.shape))


class CTCOPolicy(sac_policies.SACPolicy):
    """Actor, critics and targets of CTCO. Parameters are those of Stable-Baselines3's ``SACPolicy``, without gSDE.

    Adam runs fused unless ``optimizer_kwargs`` say otherwise.

    :raises ValueError: if gSDE (``use_sde``) is asked for, or less than one critic
    """

    actor: OptionActor  # type: ignore[assignment]
    actor_target: OptionActor
    critic: OptionCritic  # type: ignore[assignment]
    critic_target: OptionCritic  # type: ignore[assignment]

    def __init__(self, *args: Any, **kwargs: Any):
        if kwargs.get("use_sde"):
            raise ValueError("CTCO does not support generalized State-Dependent Exploration: remove use_sde=True")
        if kwargs.get("n_critics", 2) < 1:
            raise ValueError(f"n_critics must be at least 1, not {kwargs['n_critics']}")
        if kwargs.get("optimizer_class", th.optim.Adam) is th.optim.Adam:
            kwargs["optimizer_kwargs"] = {"fused": True, **(kwargs.get("optimizer_kwargs") or {})}
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # A parameter group of its own lets d's head have its own step size.
        head = set(self.actor.duration_head.parameters())
        self.actor.optimizer = self.optimizer_class(
            [  # type: ignore[arg-type]
                {"params": [p for p in self.actor.parameters() if p not in head]},
                {"params": list(self.actor.duration_head.parameters())},
            ],
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)
            target.set_training_mode(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> OptionActor:  # type: ignore[override]
        """An actor; with a features extractor of its own unless one is given."""
        kwargs = self._update_features_extractor(self.net_args, features_extractor)
        return OptionActor(**kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> OptionCritic:  # type: ignore[override]
        """An ensemble of critics; with a features extractor of its own unless one is given."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return OptionCritic(**kwargs).to(self.device)


MlpPolicy = CTCOPolicy


class CnnPolicy(CTCOPolicy, sac_policies.CnnPolicy):
    """:class:`CTCOPolicy` with Stable-Baselines3's ``NatureCNN`` as features extractor."""


class MultiInputPolicy(CTCOPolicy, sac_policies.MultiInputPolicy):
    """:class:`CTCOPolicy` with Stable-Baselines3's ``CombinedExtractor``, for dictionary observations."""
