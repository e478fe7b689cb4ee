"""Stable-Baselines3's SAC under the clock that the algorithms with options use."""

import io
import pathlib
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, SACPolicy
from torch import nn

from sb3_ctco.common.buffers import OptionReplayBuffer
from sb3_ctco.common.callbacks import as_callback, eval_callbacks, in_primitive_steps, wrap_each
from sb3_ctco.common.load_arguments import check_load_arguments
from sb3_ctco.option_array import OptionArray, plain
from sb3_ctco.options import OptionSpace, check_seconds, discount, discount_rate_from_gamma, step_weight
from sb3_ctco.wrappers import OptionExecutionWrapper, RewardRateWrapper

SelfFixedRateSAC = TypeVar("SelfFixedRateSAC", bound="FixedRateSAC")


class FixedDurationWrapper(gym.ActionWrapper, RecordConstructorArgs):
    """Options that all take the longest duration: an action is their weights alone.

    An agent with entropy would otherwise be paid for the noise of a duration that changes nothing.

    :param env: in an :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        gym.ActionWrapper.__init__(self, env)
        (option_dim,) = env.action_space.shape  # type: ignore[misc]
        self.action_space = spaces.Box(-1.0, 1.0, (option_dim - 1,), np.float32)

    def action(self, action: np.ndarray) -> np.ndarray:
        """The option of these weights."""
        return np.append(plain(action), 1.0)

    def plan(self, action: np.ndarray) -> np.ndarray:
        """The primitive actions that it plays, ``[n_steps, *action_shape]``."""
        return self.env.get_wrapper_attr("plan")(self.action(action))


class QuickSACPolicy(SACPolicy):
    """Stable-Baselines3's policy of SAC, quick at decisions: the same actions up to rounding, and the same random numbers.

    A decision about one observation is nearly all overhead of PyTorch and Stable-Baselines3. Here the actor's layers are
    evaluated by NumPy, on the parameters' own memory, so that updates need no copy. For an actor of linear layers and ReLU,
    on the CPU, without gSDE, whose observations are vectors; Adam is fused.

    :raises ValueError: for another actor
    """

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs["optimizer_kwargs"] = {"fused": True, **(kwargs.get("optimizer_kwargs") or {})}
        super().__init__(*args, **kwargs)
        space, activation, extractor = self.observation_space, self.activation_fn, type(self.actor.features_extractor)
        is_vector = isinstance(space, spaces.Box) and not is_image_space(space) and extractor is FlattenExtractor
        self._observation_shape: tuple[int, ...] = space.shape or ()
        self._action_shape: tuple[int, ...] = self.action_space.shape or ()
        if self.actor.use_sde or activation is not nn.ReLU or not is_vector:
            raise ValueError(
                f"QuickSACPolicy is for vectors, ReLU and no gSDE, not for {extractor.__name__}, {activation.__name__}, "
                f"use_sde={self.actor.use_sde} and observations in {space}: use SACPolicy"
            )

    def set_training_mode(self, mode: bool) -> None:
        """Stable-Baselines3 asks for a mode at each decision: nothing here depends on it."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Stable-Baselines3's ``predict``."""
        n_axes = len(self._observation_shape)
        if (
            not isinstance(observation, np.ndarray)
            or observation.shape[observation.ndim - n_axes :] != self._observation_shape
        ):
            return super().predict(observation, state, episode_start, deterministic)  # which says what is wrong with it
        x = observation.reshape(-1, self.actor.features_dim).astype(np.float32)
        layers: Any = self.actor.latent_pi
        for layer in layers[0::2]:
            x = np.maximum(_affine(layer, x), 0.0)
        gaussian = _affine(self.actor.mu, x)
        if not deterministic:
            log_std = _affine(self.actor.log_std, x).clip(LOG_STD_MIN, LOG_STD_MAX)
            gaussian += np.exp(log_std) * th.randn(gaussian.shape).numpy()
        actions = self.unscale_action(np.tanh(gaussian).reshape(-1, *self._action_shape))
        return actions if observation.ndim > n_axes else actions[0], state


def _affine(layer: Any, x: np.ndarray) -> np.ndarray:
    return x @ layer.weight.detach().numpy().T + layer.bias.detach().numpy()


class FixedRateSAC(SAC):
    """SAC as :func:`sac_at_rate` makes it: what its rewards and decisions mean is saved, and asked of every environment.

    Its arguments are SAC's. A model that was saved goes on with ``FixedRateSAC.load``; ``SAC.load`` makes a stock SAC of it,
    which counts decisions as steps and explores without pink noise.

    :raises ValueError: for an environment that does not tell of time in ``info["option"]``, or not as the model's did
    """

    #: Where decisions take several steps: updates by these, in place of ``train_freq`` and ``gradient_steps``
    updates_per_step: float | None = None
    #: The ``PinkNoiseDist`` that the actor samples with
    pink_noise: Any = None
    #: What a decision means in the environment, and what its reward is multiplied by
    option_space: OptionSpace | None = None
    reward_scale: float | None = None
    _updates_due = 0.0
    _n_seen = 0

    def _setup_model(self) -> None:
        if self.env is not None:
            self.option_space, self.reward_scale = self._clock_of(self.env)
        super()._setup_model()
        if self.pink_noise is not None:
            self.actor.action_dist = self.pink_noise

    def wrap_env(self, env: gym.Env) -> gym.Env:
        """Wrap a bare environment as the model's own is wrapped, for instance to evaluate in it."""
        space = self.option_space
        assert space is not None  # since there was an environment
        if self.updates_per_step is not None:
            n_rbf, (action_dim,) = space.arguments["n_rbf"], self.action_space.shape  # type: ignore[misc]
            learned_duration = action_dim > n_rbf * int(np.prod(env.action_space.shape))  # type: ignore[arg-type]
            return hold_actions(env, space.d_max, n_rbf, learned_duration, space.dt, space.discount_rate)
        return _with_reward_rate(env, space.dt, space.discount_rate, self.reward_scale or 1.0)  # type: ignore[return-value]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Stable-Baselines3's ``set_env``; a bare environment is wrapped as the model's own.

        :raises ValueError: if one that is wrapped already counts time or rewards otherwise
        """
        if self.option_space is not None and not isinstance(env, VecEnv) and not env.has_wrapper_attr("option_space"):
            env = self.wrap_env(env)
        env = self._wrap_env(env, self.verbose)
        clock = self._clock_of(env)
        super().set_env(env, force_reset)
        self.option_space, self.reward_scale = clock

    def _clock_of(self, env: VecEnv) -> tuple[OptionSpace, float | None]:
        if not env.has_attr("option_space"):
            raise ValueError(
                "the environment must be wrapped as sac_at_rate wraps it: call set_env with one bare environment, or make a "
                "VecEnv with wrapper_class=RewardRateWrapper; a new model is made by sac_at_rate"
            )
        spaces = env.get_attr("option_space")
        scales = env.get_attr("reward_scale") if env.has_attr("reward_scale") else [None] * len(spaces)
        expected = self.option_space or spaces[0]
        expected_scale = scales[0] if self.reward_scale is None else self.reward_scale
        for space, scale in zip(spaces, scales, strict=True):
            differences = expected.differences(space)
            if scale is not None and expected_scale is not None and not np.isclose(scale, expected_scale, rtol=1e-6):
                differences["reward_scale"] = expected_scale, scale
            if differences:
                found = ", ".join(f"{name}={there} in place of {here}" for name, (here, there) in differences.items())
                other = "the first one of the VecEnv" if self.option_space is None else "that which this model learned in"
                raise ValueError(f"an environment is another one than {other}: it has {found}")
        return spaces[0], scales[0]

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfFixedRateSAC],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfFixedRateSAC:
        """Stable-Baselines3's ``load``; a bare environment is wrapped as the model's own was.

        :param kwargs: SAC's arguments to change, but for those that follow from the clock
        :raises ValueError: if the environment counts time or rewards otherwise
        """
        kwargs = check_load_arguments(cls, path, kwargs, ("gamma", "train_freq", "gradient_steps", "replay_buffer_class"))
        if env is not None:
            kwargs["n_envs"] = env.num_envs if isinstance(env, VecEnv) else 1
        model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        if env is not None:
            model.set_env(env, force_reset)
            if model.seed is not None:
                model.env.seed(model.seed)  # type: ignore[union-attr]
        return model

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        self._n_seen = self.num_timesteps
        if self.updates_per_step is None:
            return super()._init_callback(callback, progress_bar)
        callback = as_callback(callback)
        for evaluating in eval_callbacks(callback):
            env = evaluating.eval_env
            if type(env) is DummyVecEnv and not env.has_attr("option_space"):
                evaluating.eval_env = wrap_each(env, self.wrap_env)
            self._clock_of(evaluating.eval_env)
        return super()._init_callback(in_primitive_steps(callback, progress_bar))

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last decision may end after the last step that was asked for: schedules are of numbers from 1 to 0.
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Stable-Baselines3's ``predict``; with ``hold_seconds`` for an environment wrapped as by :meth:`wrap_env`."""
        actions, state = super().predict(observation, state, episode_start, deterministic)
        return actions if self.updates_per_step is None else actions.view(OptionArray), state

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """SAC's; where decisions take several steps, the updates that are due."""
        if self.updates_per_step is None:
            super().train(gradient_steps, batch_size)
            return
        self._updates_due += self.updates_per_step * (self.num_timesteps - max(self._n_seen, self.learning_starts))
        self._n_seen = self.num_timesteps
        assert self.replay_buffer is not None
        n_updates = int(self._updates_due)
        self._updates_due -= n_updates
        # While all that is played is somebody else's, there is nothing to learn from.
        if n_updates and self.replay_buffer.size():
            super().train(n_updates, batch_size)


class _PricedReplayBuffer(OptionReplayBuffer):
    """Decisions cost something, which is subtracted where they are sampled: what is recorded of them stays as it is.

    :param decision_price: in the unit of samples, that is after ``reward_scale``
    """

    def __init__(self, *args: Any, decision_price: float = 0.0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.decision_price = decision_price

    def _sample_fields(self, *args: Any) -> dict[str, Any]:
        fields = super()._sample_fields(*args)
        fields["rewards"] -= self.decision_price
        return fields


def update_schedule(updates_per_step: float, tolerance: float = 1e-3) -> tuple[int, int]:
    """The smallest ``train_freq`` with a whole number of ``gradient_steps`` that keeps a rate of updates.

    :param updates_per_step: updates a call of the vectorised environment's ``step``, positive
    :param tolerance: relative error that the rate may have
    :return: ``train_freq`` and ``gradient_steps``
    """
    train_freq = 1
    while abs(round(updates_per_step * train_freq) / (updates_per_step * train_freq) - 1.0) > tolerance:
        train_freq += 1
    return train_freq, round(updates_per_step * train_freq)


def sac_at_rate(
    env: GymEnv | str,
    dt: float,
    updates_per_second: float = 20.0,
    gamma: float = 0.98,
    gamma_dt: float = 0.05,
    learning_starts_seconds: float = 60.0,
    policy: str | type[SACPolicy] = "MlpPolicy",
    hold_seconds: float | None = None,
    n_rbf: int = 1,
    learned_duration: bool = False,
    decision_price: float = 0.0,
    pink_noise_seconds: float | None = None,
    **kwargs: Any,
) -> FixedRateSAC:
    """A plain SAC that at every ``dt`` learns as often a second, for the same discounted return.

    Its discount factor is γ^(dt/γ_dt) = e^(−τ·dt), its reward is a rate held over a step
    (:class:`~sb3_ctco.wrappers.RewardRateWrapper`) in the unit of a reward of 1 over ``gamma_dt``, and its ``train_freq`` and
    ``gradient_steps`` are the smallest that give ``updates_per_second`` to a thousandth. With ``gamma_dt = dt`` it is stock
    SAC on the rewards as they are. This is the SAC of the paper's section "Empirical Analysis".

    With ``hold_seconds`` it decides less often, as with an action repeat of ``hold_seconds/dt`` steps: each decision is an
    option of that duration, whose reward is integrated and discounted over the time that it ran. Steps are still primitive
    ones in ``learn``, ``num_timesteps`` and callbacks.

    Example:
        >>> model = sac_at_rate("Pendulum-v1", dt=0.05, updates_per_second=5)
        >>> round(model.gamma, 6), model.train_freq.frequency, model.gradient_steps, model.learning_starts
        (0.98, 4, 1, 1200)

    :param env: the environment to learn from: a Gymnasium id, a bare environment; without ``hold_seconds`` also one in a
        ``RewardRateWrapper``, or a VecEnv of such. A ``RewardRateWrapper`` of yours has the unit that its ``reward_scale``
        says; that of a bare environment is given 1/``step_weight(gamma_dt, discount_rate)``
    :param dt: the environment's interaction period, in s
    :param updates_per_second: updates per second of task time, summed over the environments of a VecEnv
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]
    :param gamma_dt: in s
    :param learning_starts_seconds: act at random for this long before learning, in s of task time
    :param policy: SAC's policy
    :param hold_seconds: decide this often, in s; each step by default
    :param n_rbf: number of weights an action dimension that a decision has; 1 holds an action for ``hold_seconds``, more make
        it a chunk of that length
    :param learned_duration: whether a decision also says how long it takes, from one step to ``hold_seconds``
    :param decision_price: what a decision costs, in reward × s; with ``n_rbf=1`` and ``learned_duration`` this is TaCoS
        (Treven et al. 2024, "When to Sense and Control?", https://arxiv.org/abs/2406.01163) with SAC
    :param pink_noise_seconds: explore with pink noise, in pieces of this length in s, usually an episode's; it is the
        ``PinkNoiseDist`` of the package ``pink-noise-rl``
    :param kwargs: SAC's further arguments
    :return: a ``stable_baselines3.SAC`` that knows its clock, see :class:`FixedRateSAC`
    :raises ValueError: for settings out of range, or that contradict the environment's
    :raises TypeError: if ``kwargs`` have what follows from the clock: ``train_freq``, ``gradient_steps`` or
        ``learning_starts``, or with ``hold_seconds`` a ``replay_buffer_class``
    """
    for name in ("train_freq", "gradient_steps", "learning_starts"):
        if name in kwargs:
            raise TypeError(
                f"sac_at_rate sets {name} itself, not to {kwargs[name]}: pass updates_per_second and "
                "learning_starts_seconds in its place"
            )
    discount_rate = discount_rate_from_gamma(gamma, gamma_dt)
    check_seconds(dt=dt)
    if not (updates_per_second > 0 and np.isfinite(updates_per_second)):
        raise ValueError(f"updates_per_second must be positive, not {updates_per_second}")
    if not (learning_starts_seconds >= 0 and np.isfinite(learning_starts_seconds)):
        raise ValueError(f"learning_starts_seconds must be at least 0, not {learning_starts_seconds}")

    for name, seconds in (("hold_seconds", hold_seconds), ("pink_noise_seconds", pink_noise_seconds)):
        if seconds is not None and not dt - 1e-9 <= seconds < np.inf:
            raise ValueError(f"{name} must be None, or at least a step of {dt} s, not {seconds}")
    if hold_seconds is None and (n_rbf, learned_duration, decision_price) != (1, False, 0.0):
        raise ValueError(
            f"n_rbf={n_rbf}, learned_duration={learned_duration} and decision_price={decision_price} are of decisions that "
            "take several steps: pass hold_seconds"
        )

    reward_scale = 1.0 / step_weight(gamma_dt, discount_rate)
    env = maybe_make_env(env, kwargs.get("verbose", 0))
    clock: dict[str, Any] = {
        "gamma": float(discount(dt, discount_rate)),
        "learning_starts": round(learning_starts_seconds / dt),
    }
    if hold_seconds is None:
        env = _with_reward_rate(env, dt, discount_rate, reward_scale)
        n_envs = env.num_envs if isinstance(env, VecEnv) else 1
        train_freq, gradient_steps = update_schedule(updates_per_second * dt * n_envs)
        model = FixedRateSAC(policy, env, train_freq=train_freq, gradient_steps=gradient_steps, **clock, **kwargs)
    else:
        # The buffer has the discount of each decision, so gamma is not used.
        kwargs |= _priced_buffer(kwargs, env, discount_rate, reward_scale, decision_price)
        env = hold_actions(env, hold_seconds, n_rbf, learned_duration, dt, discount_rate)
        model = FixedRateSAC(policy, env, **clock, **kwargs)
        model.updates_per_step = updates_per_second * dt
    if pink_noise_seconds is not None:
        _explore_with_pink_noise(model, round(pink_noise_seconds / (hold_seconds or dt)))
    return model


def hold_actions(
    env: GymEnv, hold_seconds: float, n_rbf: int, learned_duration: bool, dt: float, discount_rate: float
) -> gym.Env:
    """An environment of decisions that take ``hold_seconds``, as :func:`sac_at_rate` makes it.

    :raises ValueError: for a VecEnv
    """
    if isinstance(env, VecEnv):
        raise ValueError("hold_seconds is for a single environment, which sac_at_rate wraps: pass that in place of a VecEnv")
    if unwrap_wrapper(env, Monitor) is None:
        env = Monitor(env)
    shortest = dt if learned_duration else hold_seconds
    options = OptionExecutionWrapper(env, n_rbf, hold_seconds, shortest, dt, discount_rate, duration_scale="linear")
    return options if learned_duration else FixedDurationWrapper(options)


def _priced_buffer(
    given: dict[str, Any], env: GymEnv, discount_rate: float, reward_scale: float, decision_price: float
) -> dict[str, Any]:
    """SAC's arguments for its replay buffer, of which users may have given some."""
    if given.get("replay_buffer_class") is not None:
        raise TypeError(
            "with hold_seconds sac_at_rate sets replay_buffer_class itself, not to "
            f"{given['replay_buffer_class'].__name__}: leave it out"
        )
    if isinstance(env.observation_space, spaces.Dict):
        raise ValueError(
            f"hold_seconds is for observations in one array, not in {env.observation_space}: flatten them with "
            "gymnasium.wrappers.FlattenObservation"
        )
    buffer_kwargs = given.get("replay_buffer_kwargs") or {}
    for name in ("discount_rate", "reward_scale", "decision_price"):
        if name in buffer_kwargs:
            raise TypeError(
                f"with hold_seconds sac_at_rate sets the replay buffer's {name} itself, not to {buffer_kwargs[name]}: leave "
                "it out of replay_buffer_kwargs"
            )
    kwargs = {
        **buffer_kwargs,
        "discount_rate": discount_rate,
        "reward_scale": reward_scale,
        "decision_price": decision_price * reward_scale,
    }
    return {"replay_buffer_class": _PricedReplayBuffer, "replay_buffer_kwargs": kwargs}


def _explore_with_pink_noise(model: FixedRateSAC, n_decisions: int) -> None:
    try:
        from pink import PinkNoiseDist
    except ImportError as error:
        raise ImportError("pink_noise_seconds needs the package pink-noise-rl: run pip install pink-noise-rl") from error
    if isinstance(model.policy, QuickSACPolicy):
        raise ValueError("QuickSACPolicy draws white noise, whatever pink_noise_seconds says: use policy='MlpPolicy'")
    (action_dim,) = model.action_space.shape  # type: ignore[misc]
    model.pink_noise = PinkNoiseDist(n_decisions, action_dim, rng=np.random.default_rng(model.seed))
    model.actor.action_dist = model.pink_noise


def _with_reward_rate(env: GymEnv, dt: float, discount_rate: float, reward_scale: float) -> GymEnv:
    if isinstance(env, VecEnv):
        if not all(env.env_is_wrapped(RewardRateWrapper)):
            raise ValueError(
                "sac_at_rate cannot wrap the environments of a VecEnv from outside: make it with "
                f"make_vec_env(..., wrapper_class=RewardRateWrapper, wrapper_kwargs=dict(dt={dt}, "
                f"discount_rate={discount_rate:.6g}, reward_scale={reward_scale:.6g}))"
            )
        settings: list[OptionSpace] = env.get_attr("option_space")
    elif (wrapped := unwrap_wrapper(env, RewardRateWrapper)) is not None:
        settings = [wrapped.option_space]  # type: ignore[attr-defined]
    else:
        if unwrap_wrapper(env, Monitor) is None:
            env = Monitor(env)
        return RewardRateWrapper(env, dt=dt, discount_rate=discount_rate, reward_scale=reward_scale)
    for one in settings:
        for name, value in (("dt", dt), ("discount_rate", discount_rate)):
            if not np.isclose(getattr(one, name), value, rtol=1e-6, atol=0.0):
                raise ValueError(
                    f"the environment's RewardRateWrapper has {name}={getattr(one, name)}, sac_at_rate has {name}={value}: "
                    "give both the same (discount_rate is -ln(gamma)/gamma_dt)"
                )
    return env
