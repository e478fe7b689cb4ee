"""Fine-Grained Action Repetition (Sharma et al. 2017, https://arxiv.org/abs/1702.06054) on soft actor-critic."""

import math
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_ctco.common.losses import critic_target, repeated_actor_loss, repetition_values
from sb3_ctco.common.soft_actor_critic import SoftOptionActorCritic, parse_target_entropy
from sb3_ctco.figar_sac.policies import (
    CnnPolicy,
    FiGARActor,
    FiGARCritic,
    FiGARSACPolicy,
    MlpPolicy,
    MultiInputPolicy,
    decode_repetitions,
    encode_repetitions,
)
from sb3_ctco.options import OptionSpace, check_seconds, steps_in
from sb3_ctco.wrappers import OptionExecutionWrapper, find_dt

#: Options that hold an action for a whole number of steps
REPETITIONS: dict[str, Any] = {"n_rbf": 1, "d_min": 0.0, "duration_scale": "linear"}
#: K, of Sharma et al.
DEFAULT_REPETITIONS = 20


class FiGARSAC(SoftOptionActorCritic):
    """Fine-Grained Action Repetition on soft actor-critic (FiGAR-SAC).

    The policy picks an action, and how many steps of {1, …, K} to repeat it. Learning is soft actor-critic on the
    resulting semi-Markov decision process.

    Paper: Sharma, Lakshminarayanan, Ravindran: "Learning to Repeat: Fine Grained Action Repetition for Deep
    Reinforcement Learning", ICLR 2017, https://arxiv.org/abs/1702.06054. On soft actor-critic it is a baseline of
    Karimi et al. 2023, https://arxiv.org/abs/2212.04407.

    Steps are primitive environment steps everywhere. An environment that is wrapped already must have been given
    ``OptionExecutionWrapper(env, n_rbf=1, d_max=K * dt, d_min=0, duration_scale="linear")``.

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: the environment to learn from: a Gymnasium id, a bare environment, one in an
        :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`, or a VecEnv of such
    :param learning_rate: step size of Adam for all networks and temperatures, or a function of the remaining progress
    :param buffer_size: size of the replay buffer, in decisions
    :param learning_starts: play random actions and repetitions for this many steps before learning
    :param batch_size: decisions in a minibatch
    :param tau: Polyak coefficient of the target networks
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]; it means the same at every ``dt``
    :param gamma_dt: in s
    :param train_freq: collect at least this many steps between trainings, or ``(n, "episode")``
    :param gradient_steps: updates per training; -1 for one a step
    :param updates_per_second: updates per second of task time, in place of ``gradient_steps``
    :param n_repetitions: K, the longest repetition, in steps; 20 by default
    :param d_max: the longest repetition in s, in place of ``n_repetitions``; rounded to whole steps
    :param dt: interaction period of the environment, in s; by default found in the environment
    :param ent_coef: α_a, the action's temperature: a number, ``"auto"`` to learn it, or ``"auto_0.1"`` to start at 0.1
    :param duration_ent_coef: α_x, the repetition's temperature, likewise
    :param target_entropy: entropy of the action over the box [−1, 1] that a learned temperature keeps; ``"auto"`` is
        −dim(a)
    :param duration_target_entropy: likewise for the repetition; ``"auto"`` is 0.4·log K
    :param action_noise: noise added to normalised options while exploring
    :param replay_buffer_class: ``OptionReplayBuffer`` or ``DictOptionReplayBuffer``, or a subclass
    :param replay_buffer_kwargs: keyword arguments for the replay buffer
    :param policy_kwargs: arguments of the policy, e.g. ``dict(net_arch=dict(pi=[10, 10], qf=[64, 64]))``
    :param stats_window_size: number of episodes that rollout statistics are averaged over
    :param tensorboard_log: log location for TensorBoard (None for no log)
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: seed of the pseudo-random generators
    :param device: device to run on
    :param _init_setup_model: whether to build the networks at the creation of the instance
    :raises ValueError: for settings out of range, or that contradict each other or the environment's
    :raises TypeError: if ``n_repetitions`` is not an integer
    """

    _own_setting: ClassVar[str] = "n_repetitions"
    _kept_when_loaded: ClassVar[tuple[str, ...]] = (*SoftOptionActorCritic._kept_when_loaded, "n_repetitions", "dt")

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: FiGARSACPolicy
    actor: FiGARActor
    critic: FiGARCritic
    critic_target: FiGARCritic

    def __init__(
        self,
        policy: str | type[FiGARSACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.98,
        gamma_dt: float = 0.05,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = -1,
        updates_per_second: float | None = None,
        n_repetitions: int | None = None,
        d_max: float | None = None,
        dt: float | None = None,
        ent_coef: str | float = "auto",
        duration_ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        duration_target_entropy: str | float = "auto",
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if n_repetitions is not None and d_max is not None:
            raise ValueError(
                f"n_repetitions={n_repetitions} steps and d_max={d_max} s both say how long the longest repetition is: "
                "pass one of them"
            )
        if n_repetitions is None and d_max is None:
            n_repetitions = DEFAULT_REPETITIONS
        if n_repetitions is not None:
            if isinstance(n_repetitions, bool) or not isinstance(n_repetitions, int | np.integer):
                raise TypeError(f"n_repetitions must be an integer, not {n_repetitions!r}")
            if n_repetitions < 1:
                raise ValueError(f"n_repetitions must be at least 1, not {n_repetitions}")
        check_seconds(d_max=d_max)
        #: K; known once dt is, if it was given as ``d_max``
        self.n_repetitions = n_repetitions
        super().__init__(
            policy,
            env,
            learning_rate,
            **REPETITIONS,
            d_max=d_max,
            dt=dt,
            gamma=gamma,
            gamma_dt=gamma_dt,
            updates_per_second=updates_per_second,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            ent_coef=ent_coef,
            duration_ent_coef=duration_ent_coef,
            target_entropy=target_entropy,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.duration_target_entropy = duration_target_entropy
        if _init_setup_model:
            self._setup_model()

    @classmethod
    def wrapper_kwargs(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        """OptionExecutionWrapper's arguments for the algorithm's, where environments are made before it.

        :param arguments: the algorithm's arguments, defaults included
        :raises ValueError: if they do not tell how many seconds the longest repetition takes
        """
        n_repetitions, d_max, dt = arguments["n_repetitions"], arguments["d_max"], arguments["dt"]
        if d_max is None and dt is None:
            raise ValueError(
                f"how long n_repetitions={n_repetitions} steps take is not known before the environment is made: pass d_max, "
                "in seconds, or dt"
            )
        if d_max is None:
            d_max = (DEFAULT_REPETITIONS if n_repetitions is None else n_repetitions) * dt
        elif dt is not None:
            d_max = steps_in(d_max, dt) * dt
        return super().wrapper_kwargs({**arguments, **REPETITIONS, "join": "free", "d_max": d_max})

    def _resolve_repetitions(self, dt: float) -> None:
        """Make ``n_repetitions`` and ``d_max``, of which the user gave one, say the same at the first dt that is known."""
        if self.n_repetitions is None or self.d_max is None:
            if self.n_repetitions is None:
                self.n_repetitions = steps_in(self.d_max, dt)
            self.d_max = self.n_repetitions * dt

    def wrap_env(self, env: gym.Env, n_sub_options: int = 0) -> OptionExecutionWrapper:
        """Wrap a bare environment as the algorithm wraps its own, for instance to evaluate in it.

        :param env: the bare environment
        :param n_sub_options: see :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`; FiGAR-SAC learns without
        :return: ``OptionExecutionWrapper(Monitor(env), ...)`` of K repetitions, a Monitor being added where there is none
        """
        dt = self.dt if self._dt_was_given else find_dt(env)
        if dt is not None:
            self._resolve_repetitions(dt)
        return super().wrap_env(env, n_sub_options)

    def _as_option_env(self, env: GymEnv) -> GymEnv:
        env = super()._as_option_env(env)
        if self.dt is not None:
            self._resolve_repetitions(self.dt)
        elif isinstance(env, VecEnv):
            self._resolve_repetitions(env.get_attr("option_space")[0].dt)
        else:
            self._resolve_repetitions(env.get_wrapper_attr("option_space").dt)
        return env

    def _check_env(self, env: VecEnv) -> OptionSpace:
        space = super()._check_env(env)
        if not np.isclose(space.d_min, space.dt, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"the environment's options have d_min={space.d_min}, but FiGARSAC's shortest repetition is one step, "
                f"dt={space.dt}: pass d_min=0 to OptionExecutionWrapper"
            )
        return space

    def _setup_model(self) -> None:
        # The user's stay as they were, so that a file can be loaded with them.
        given, self.policy_kwargs = self.policy_kwargs, {**self.policy_kwargs, "n_repetitions": self.n_repetitions}
        super()._setup_model()
        self.policy_kwargs = given

    def _setup_temperatures(self) -> None:
        if not callable(self.duration_target_entropy):
            assert self.n_repetitions is not None
            self.duration_target_entropy = parse_target_entropy(
                "duration_target_entropy", self.duration_target_entropy, 0.4 * math.log(self.n_repetitions)
            )
        super()._setup_temperatures()

    def _auto_target_entropy(self) -> float:
        return float(-self.actor.action_dim)

    def _split_target_entropy(self, target: float) -> tuple[float, float]:
        assert not isinstance(self.duration_target_entropy, str)  # since the temperatures were set up
        return target, self.duration_target_entropy

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        action, buffer_action = super()._sample_action(learning_starts, action_noise, n_envs)
        if self.num_timesteps < learning_starts:
            # A duration drawn from [dt, K·dt] rounds to 1 and to K half as often as to the repetitions between.
            assert self.n_repetitions is not None
            index = np.minimum(np.floor(0.5 * (action[:, -1] + 1.0) * self.n_repetitions), self.n_repetitions - 1)
            action[:, -1] = buffer_action[:, -1] = encode_repetitions(index + 1.0, self.n_repetitions)
        return action, buffer_action

    def _see_what_ran(self, options: np.ndarray, infos: list[dict[str, Any]]) -> None:
        # What ran is what was asked for, unless the episode's end cut it short: then it equals a shorter repetition.
        assert self.n_repetitions is not None
        for option, info in zip(options, infos, strict=True):
            if "option" in info:
                n_steps = np.array(info["option"]["n_steps"], dtype=np.float32)
                option[-1] = encode_repetitions(n_steps, self.n_repetitions)

    def _sample_policy(self, obs: PyTorchObs) -> tuple[th.Tensor, ...]:
        actions, action_log_prob, repetition_log_probs = self.actor.action_log_prob(obs)
        # Of the repetition its expectation, the negative entropy.
        negative_entropy = (repetition_log_probs.exp() * repetition_log_probs).sum(dim=1)
        return actions, th.stack((action_log_prob, negative_entropy), dim=1), repetition_log_probs

    def _q_values(self, data: ReplayBufferSamples) -> th.Tensor:
        assert self.n_repetitions is not None
        q_values = self.critic(data.observations, data.actions[:, :-1])
        index = decode_repetitions(data.actions[:, -1:], self.n_repetitions).long() - 1
        return q_values.gather(2, index.expand(len(q_values), *index.shape))

    def _critic_targets(self, data: ReplayBufferSamples) -> th.Tensor:
        """R + (1 − done)·γ^n·(Σ_k π_x(k|s')[min_i Q̄_i(s', a')_k − α_x log π_x(k|s')] − α_a log π_a(a'|s'))."""
        assert data.discounts is not None
        ent_coef, duration_ent_coef = self.ent_coefs
        actions, action_log_prob, repetition_log_probs = self.actor.action_log_prob(data.next_observations)
        q_values = self.critic_target(data.next_observations, actions)
        return critic_target(
            data.rewards,
            data.dones,
            data.discounts,
            repetition_values(q_values, repetition_log_probs, duration_ent_coef),
            ent_coef * action_log_prob[:, None],
        )

    def _actor_loss(self, obs: PyTorchObs, sample: tuple[th.Tensor, ...]) -> th.Tensor:
        actions, log_prob, repetition_log_probs = sample
        return repeated_actor_loss(self.critic(obs, actions), log_prob[:, 0], repetition_log_probs, self.ent_coefs)
