"""Policies of DAC-PPO: a master over options, the options' Gaussians and terminations, and one critic of options."""

import math
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn import functional as F

from sb3_ctco.common.policies import EnsembleLinear, ensemble_mlp


def high_log_probs(
    master_log_probs: th.Tensor, beta_logits: th.Tensor, previous_options: th.Tensor, episode_starts: th.Tensor
) -> th.Tensor:
    """log π_H(o|p, s), where π_H(o|p, s) = (1 − β_p(s))·1[o = p] + β_p(s)·π_W(o|s), and π_W alone at an episode's start.

    β is the previous option's, for all o: so each row sums to one. Computed from logarithms throughout, so nothing is
    added to a probability to keep its logarithm finite.

    :param master_log_probs: log π_W(o|s), ``[batch, K]``
    :param beta_logits: of the termination probabilities β_o(s), ``[batch, K]``
    :param previous_options: p, ``[batch]``, integers; without meaning at an episode's start
    :param episode_starts: ``[batch]``, boolean
    :return: ``[batch, K]``
    """
    index = previous_options[:, None]
    beta_logit = beta_logits.gather(1, index)
    switched = F.logsigmoid(beta_logit) + master_log_probs
    # 1 − sigmoid(x) = sigmoid(−x)
    kept = th.logaddexp(switched.gather(1, index), F.logsigmoid(-beta_logit))
    return th.where(episode_starts[:, None], master_log_probs, switched.scatter(1, index, kept))


class OptionPredictions:
    """What the networks say of a batch of observations, for each of K options; a network runs when it is first asked.

    :param policy: whose networks
    :param obs: observations
    """

    def __init__(self, policy: "DACPolicy", obs: PyTorchObs):
        self._policy = policy
        self._obs = obs

    @cached_property
    def _features(self) -> th.Tensor:
        return self._policy.extract_features(self._obs, self._policy.features_extractor)[None]

    def _of_each_option(self, networks: nn.Sequential) -> th.Tensor:
        return networks(self._features.expand(self._policy.n_options, -1, -1))

    @cached_property
    def master_log_probs(self) -> th.Tensor:
        """log π_W(o|s), ``[batch, K]``."""
        return self._policy.master(self._features)[0].log_softmax(dim=1)

    @cached_property
    def q_values(self) -> th.Tensor:
        """q(s, o), ``[batch, K]``."""
        if self._policy.share_features_extractor:
            return self._policy.q_network(self._features)[0]
        features = self._policy.extract_features(self._obs, self._policy.vf_features_extractor)
        return self._policy.q_network(features[None])[0]

    @cached_property
    def means(self) -> th.Tensor:
        """μ_o(s), ``[K, batch, action_dim]``, in [−1, 1]."""
        return self._of_each_option(self._policy.option_means).tanh()

    @cached_property
    def beta_logits(self) -> th.Tensor:
        """Logits of the termination probabilities β_o(s), ``[batch, K]``."""
        return self._of_each_option(self._policy.terminations)[:, :, 0].T

    def high_log_probs(self, previous_options: th.Tensor, episode_starts: th.Tensor) -> th.Tensor:
        """log π_H(o|p, s), ``[batch, K]``; see :func:`high_log_probs`."""
        return high_log_probs(self.master_log_probs, self.beta_logits, previous_options, episode_starts)

    def low_distribution(self, options: th.Tensor) -> th.distributions.Normal:
        """π_L(a|s, o) = N(μ_o(s), σ_o) in units of the normalised box, for the options o, ``[batch]``."""
        rows = th.arange(len(options), device=options.device)
        return th.distributions.Normal(self.means[options, rows], self._policy.stds[options], validate_args=False)


class DACPolicy(BasePolicy):
    """All networks of double actor-critic: each with a body of its own, on shared features or with q's own.

    :param observation_space: observation space
    :param action_space: action space, a ``Box`` with finite bounds
    :param lr_schedule: learning rate schedule
    :param net_arch: sizes of the hidden layers of each body, or ``dict(pi=..., vf=...)``: π_W's, the options' and their
        terminations', and q's; none where one of the two is left out, as in Stable-Baselines3's PPO
    :param activation_fn: activation function
    :param ortho_init: whether to initialise orthogonally
    :param n_options: K
    :param features_extractor_class: features extractor to use, in place of the class's own
    :param features_extractor_kwargs: keyword arguments of the features extractor
    :param share_features_extractor: whether q sees the features of the actors, or has an extractor of its own
    :param normalize_images: whether to divide images by 255
    :param optimizer_class: the optimizer to use
    :param optimizer_kwargs: its keyword arguments, without the learning rate; Adam runs fused with ``eps=1e-5`` by default
    :raises ValueError: if there is less than one option, ``net_arch`` is malformed, or gSDE is asked for
    """

    action_space: spaces.Box
    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = True,
        n_options: int = 4,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = True,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        use_sde: bool = False,
    ):
        if use_sde:
            raise ValueError("DACPPO does not support generalized State-Dependent Exploration: remove use_sde=True")
        if n_options < 1:
            raise ValueError(f"n_options must be at least 1, not {n_options}")
        if optimizer_class is th.optim.Adam:
            optimizer_kwargs = {"eps": 1e-5, "fused": True, **(optimizer_kwargs or {})}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class or self.default_features_extractor,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        self.net_arch = [64, 64] if net_arch is None else net_arch
        if isinstance(self.net_arch, dict) and not set(self.net_arch) <= {"pi", "vf"}:
            raise ValueError(f"net_arch must be a list of sizes, or dict(pi=..., vf=...) of such, not {net_arch}")
        self.activation_fn = activation_fn
        self.ortho_init = ortho_init
        self.n_options = n_options
        self.action_dim = math.prod(action_space.shape)

        self.share_features_extractor = share_features_extractor
        self.features_extractor = self.make_features_extractor()
        if not share_features_extractor:
            self.vf_features_extractor = self.make_features_extractor()
        #: log π_W up to a constant
        self.master = self._networks("pi", 1, n_options, 0.01)
        self.q_network = self._networks("vf", 1, n_options, 1.0)
        self.option_means = self._networks("pi", n_options, self.action_dim, 0.01)
        self.terminations = self._networks("pi", n_options, 1, 0.01)
        self.raw_stds = nn.Parameter(th.zeros(n_options, self.action_dim))
        if ortho_init:
            self.features_extractor.apply(lambda module: self.init_weights(module, math.sqrt(2)))
            if not share_features_extractor:
                self.vf_features_extractor.apply(lambda module: self.init_weights(module, math.sqrt(2)))
        self.optimizer = optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _networks(self, kind: Literal["pi", "vf"], n_members: int, n_outputs: int, head_gain: float) -> nn.Sequential:
        """Networks of one shape, evaluated together."""
        net_arch = self.net_arch.get(kind, []) if isinstance(self.net_arch, dict) else self.net_arch
        networks = ensemble_mlp(n_members, self.features_extractor.features_dim, net_arch, n_outputs, self.activation_fn)
        if self.ortho_init:
            for layer in networks:
                if isinstance(layer, EnsembleLinear):
                    layer.orthogonal_(head_gain if layer is networks[-1] else math.sqrt(2))
        return networks

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            lr_schedule=self._dummy_schedule,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            ortho_init=self.ortho_init,
            n_options=self.n_options,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            share_features_extractor=self.share_features_extractor,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
        )
        return data

    @property
    def stds(self) -> th.Tensor:
        """σ_o = softplus of a free parameter, ``[K, action_dim]``."""
        return F.softplus(self.raw_stds)

    def options(self, obs: PyTorchObs) -> OptionPredictions:
        """The networks' predictions for observations."""
        return OptionPredictions(self, obs)

    def high_value(self, obs: PyTorchObs, previous_options: th.Tensor, episode_starts: th.Tensor) -> th.Tensor:
        """V_H(p, s) = Σ_o π_H(o|p, s)·q(s, o), ``[batch]``.

        :param previous_options: p, ``[batch]``
        :param episode_starts: ``[batch]``, boolean
        """
        predictions = self.options(obs)
        log_probs = predictions.high_log_probs(previous_options, episode_starts)
        return (log_probs.exp() * predictions.q_values).sum(dim=1)

    def forward(
        self, obs: PyTorchObs, previous_options: th.Tensor, episode_starts: th.Tensor, deterministic: bool = False
    ) -> dict[str, th.Tensor]:
        """Pick an option and an action.

        :param obs: observations
        :param previous_options: p, ``[batch]``
        :param episode_starts: ``[batch]``, boolean
        :param deterministic: whether to pick the likeliest option and its mean action
        :return: ``actions`` in units of the normalised box, not clipped to it, ``[batch, action_dim]``; and of shape
            ``[batch]``: ``options``, ``high_log_probs`` (log π_H), ``low_log_probs`` (log π_L), ``high_values`` (V_H) and
            ``low_values`` (V_L)
        """
        predictions = self.options(obs)
        log_probs = predictions.high_log_probs(previous_options, episode_starts)
        options = log_probs.argmax(dim=1) if deterministic else th.multinomial(log_probs.exp(), 1)[:, 0]
        low = predictions.low_distribution(options)
        actions = low.mean if deterministic else low.sample()
        index = options[:, None]
        return {
            "options": options,
            "actions": actions,
            "high_log_probs": log_probs.gather(1, index)[:, 0],
            "low_log_probs": low.log_prob(actions).sum(dim=1),
            "high_values": (log_probs.exp() * predictions.q_values).sum(dim=1),
            "low_values": predictions.q_values.gather(1, index)[:, 0],
        }

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        n = len(next(iter(observation.values()))) if isinstance(observation, dict) else len(observation)
        previous_options = th.zeros(n, dtype=th.long, device=self.device)
        starts = th.ones(n, dtype=th.bool, device=self.device)
        return self(observation, previous_options, starts, deterministic)["actions"].clamp(-1.0, 1.0)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions for observations, and the options they come from.

        :param observation: observations
        :param state: what the last call returned: the current options, as ``(options,)``; None at the beginning
        :param episode_start: whether an episode begins with the observation, ``[n_envs]``; its option is forgotten then
        :param deterministic: whether to pick the likeliest option and its mean action
        :return: actions, and the state for the next call
        """
        self.set_training_mode(False)
        # Stable-Baselines3's other policies look for this mistake in BasePolicy.predict, which has no place for a state.
        given: Any = observation
        if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], dict):
            raise ValueError(
                "You have passed a tuple to predict: you are probably mixing Gym API with SB3 VecEnv API, "
                "`obs, info = env.reset()` (Gym) and `obs = vec_env.reset()` (SB3 VecEnv)"
            )
        obs, is_vectorized = self.obs_to_tensor(observation)
        n = len(next(iter(obs.values()))) if isinstance(obs, dict) else len(obs)
        options = np.zeros(n, dtype=np.int64) if state is None else state[0]
        starts = np.zeros(n, dtype=bool) if episode_start is None else np.asarray(episode_start, dtype=bool).reshape(n)
        if state is None:
            starts = np.ones(n, dtype=bool)
        with th.no_grad():
            output = self(
                obs,
                th.as_tensor(options, device=self.device),
                th.as_tensor(starts, device=self.device),
                deterministic,
            )
        actions = self.env_actions(output["actions"].cpu().numpy())
        return actions if is_vectorized else actions[0], (output["options"].cpu().numpy(),)

    def env_actions(self, actions: np.ndarray) -> np.ndarray:
        """Actions in the environment's units, within its bounds.

        :param actions: in units of the normalised box, ``[batch, action_dim]``
        :return: ``[batch, *action_shape]``
        """
        scaled = np.clip(actions, -1.0, 1.0).reshape(-1, *self.action_space.shape)
        # Single precision may round past a bound.
        return np.clip(self.unscale_action(scaled), self.action_space.low, self.action_space.high)


MlpPolicy = DACPolicy


class CnnPolicy(DACPolicy):
    """:class:`DACPolicy` with Stable-Baselines3's ``NatureCNN`` as features extractor."""

    default_features_extractor = NatureCNN


class MultiInputPolicy(DACPolicy):
    """:class:`DACPolicy` with Stable-Baselines3's ``CombinedExtractor``, for dictionary observations."""

    default_features_extractor = CombinedExtractor
