"""Continuous-Time Continuous-Options (Karimi et al. 2023, https://arxiv.org/abs/2212.04407) on Stable-Baselines3."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from torch import nn

from sb3_ctco.common.buffers import DictOptionReplayBuffer, OptionReplayBuffer
from sb3_ctco.common.losses import (
    ENTROPY_REFERENCES,
    PESSIMISMS,
    EntropyReference,
    Pessimism,
    actor_loss,
    critic_target,
    log_reference_density,
    pessimistic_values,
)
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.common.soft_actor_critic import SoftOptionActorCritic
from sb3_ctco.ctco.canonical import CanonicalOptions
from sb3_ctco.ctco.fast_update import FastUpdate
from sb3_ctco.ctco.policies import CnnPolicy, CTCOPolicy, MlpPolicy, MultiInputPolicy, OptionActor, OptionCritic
from sb3_ctco.options import DurationScale, Join, Trajectory, default_durations, discount_rate_from_gamma


def _parse_penalty(value: float | str | Schedule) -> tuple[float | Schedule, bool]:
    """β_h or what it is a multiple of, and whether it is one.

    :raises ValueError: if ``value`` is neither a finite number nor a function nor ``"relative_<number of at least 0>"``
    """
    if not isinstance(value, str):
        if not callable(value) and not math.isfinite(value):
            raise ValueError(f"high_freq_penalty must be a finite number, not {value}")
        return value if callable(value) else float(value), False
    try:
        coefficient = float(value.removeprefix("relative_")) if value.startswith("relative_") else -1.0
    except ValueError:
        coefficient = -1.0
    if not 0.0 <= coefficient < math.inf:
        raise ValueError(
            f"high_freq_penalty must be a number, a function of the remaining progress, or 'relative_<number of at least 0>', "
            f"such as 'relative_0.1', not {value!r}"
        )
    return coefficient, True


def _longest(d_max: float | None, gamma: float, gamma_dt: float) -> float:
    """The longest duration, in s: by default what follows from the discount."""
    return default_durations(discount_rate_from_gamma(gamma, gamma_dt))[1] if d_max is None else d_max


class CTCO(SoftOptionActorCritic):
    """Continuous-Time Continuous-Options (CTCO).

    The policy picks an option: the weights ω of a smooth open-loop trajectory of actions, and the time d to play it.
    Learning is soft actor-critic on the resulting semi-Markov decision process, with a penalty per decision.

    Paper: Karimi, Jin, Luo, Mahmood, Jagersand, Tosatto: "Dynamic Decision Frequency with Continuous Options",
    IROS 2023, https://arxiv.org/abs/2212.04407

    Where it differs from the paper, the paper's way is an argument away, and :meth:`paper_defaults` has those that the paper
    gives a value of: Bézier curves (``trajectory="rbf"``), two weights for each number of an action (``n_rbf=3``), durations
    on a logarithmic scale (``duration_scale="linear"``) from a shortest one that follows from the discount (``d_min=0`` is one
    step), sub-options (``n_sub_options=0``), a relative β_h (``high_freq_penalty=0.05``), entropy relative to its average
    (``entropy_reference="paper"``, with linear durations), learned temperatures (``ent_coef`` as a number, the paper's β_E)
    and two critics (``policy_kwargs=dict(n_critics=1)``). One thing has no argument: ω is squashed by tanh, so that actions
    stay in their bounds. The class's own settings were measured to learn more on cheetah run and ball in cup, and two weights
    more than three on sparse point mass and cheetah run at 500 Hz.

    Steps are primitive environment steps everywhere.

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: the environment to learn from: a Gymnasium id, a bare environment, one in an
        :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`, or a VecEnv of such
    :param learning_rate: step size of Adam for all networks and temperatures, or a function of the remaining progress
    :param buffer_size: size of the replay buffer, in decisions and sub-options
    :param learning_starts: play random options for this many steps before learning
    :param batch_size: decisions in a minibatch
    :param tau: Polyak coefficient of the target networks (the paper's time constant τ follows from ``gamma``)
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]; it means the same at every ``dt``
    :param gamma_dt: in s
    :param train_freq: collect at least this many steps between trainings, or ``(n, "episode")``
    :param gradient_steps: updates per training; -1 for one a step; 1 (with ``train_freq=1``) for the paper's Algorithm 1
    :param updates_per_second: updates per second of task time, in place of ``gradient_steps``
    :param n_sub_options: how many random stretches of each option that was played, at most, go into the replay buffer with it,
        as options of their own, which counts in ``buffer_size``; 0 is the paper's way
    :param n_rbf: number of weights an action dimension: 1 holds an action, 2 goes straight from one to another, more bend; the
        paper has 3
    :param d_max: longest duration of an option, in s; by default a fifth of the horizon 1/τ, and 0.5 s at most
    :param d_min: shortest duration, in s; 0 for one step of the environment, which an option takes in any case; by default a
        hundredth of the horizon and 0.025 s at most, or a step if that is longer, see
        :func:`~sb3_ctco.options.default_durations`
    :param dt: interaction period of the environment, in s; by default found in the environment
    :param trajectory: how ω becomes actions: ``"bezier"``, ``"rbf"``, the paper's radial basis functions, or a subclass of
        :class:`~sb3_ctco.options.Trajectory`. It also says whether critics see the same vector for all options that play the
        same actions, see :class:`~sb3_ctco.ctco.canonical.CanonicalOptions`, or ω and d as they are, as in the paper
    :param duration_scale: ``"log"`` or ``"linear"``, the paper's, see :class:`~sb3_ctco.options.OptionSpace`
    :param join: where an option's actions begin: wherever its weights say (``"free"``, the paper's way), at the action that
        is being sent then (``"continuous"``), or there and at the slope at which actions were changing (``"smooth"``), see
        :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`
    :param high_freq_penalty: β_h, subtracted once a decision in the critic's target: a number, or a function of the remaining
        progress, in the unit of R times the buffer's ``reward_scale``; or ``"relative_0.1"`` for 0.1 times the mean absolute
        reward that recent options earned in a time of ``d_min``, which depends on no unit of rewards. Options that earned
        nothing do not count
    :param target_decision_rate: in Hz, in place of a fixed β_h: ``high_freq_penalty`` is where β_h starts, and it rises
        while the policy decides more often than this, and falls while it decides less often
    :param ent_coef: temperature, a number, in the unit of β_h; ``"auto"`` to learn one for each of the ``n_rbf`` weights of a
        trajectory and one for d, or ``"auto_0.1"`` to start them at 0.1
    :param target_entropy: entropy of an option over the box [−1, 1] that learned temperatures keep, in equal parts for each
        entry of ω and d, or a function of the remaining progress; ``"auto"`` is −dim(ω) − 1
    :param entropy_reference: ``"average"``, ``"uniform"`` or ``"paper"``, see :func:`log_reference_density`
    :param critic_pessimism: whether the critics' disagreement is paid by ``"decision"``, as in SAC, or by ``"time"``, see
        :func:`~sb3_ctco.common.losses.pessimistic_values`
    :param fast_updates: whether to compute gradients without autograd where that is known to give the same, see
        :mod:`sb3_ctco.ctco.fast_update`; ``fast_updates_refusal`` says why not where it is not
    :param action_noise: noise added to normalised options while exploring
    :param replay_buffer_class: ``OptionReplayBuffer`` or ``DictOptionReplayBuffer``, or a subclass
    :param replay_buffer_kwargs: keyword arguments for the replay buffer, e.g. ``dict(reward_scale="auto")`` for values in a
        unit that does not depend on that of rewards, see :class:`~sb3_ctco.common.buffers.OptionReplayBuffer`
    :param policy_kwargs: arguments of the policy, e.g. ``dict(net_arch=dict(pi=[10, 10], qf=[64, 64]))``
    :param stats_window_size: number of episodes that rollout statistics are averaged over
    :param tensorboard_log: log location for TensorBoard (None for no log)
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: seed of the pseudo-random generators
    :param device: device to run on
    :param _init_setup_model: whether to build the networks at the creation of the instance
    :raises ValueError: for settings out of range, or that contradict the environment's
    """

    _own_setting: ClassVar[str] = "high_freq_penalty"
    _kept_when_loaded: ClassVar[tuple[str, ...]] = (*SoftOptionActorCritic._kept_when_loaded, "target_decision_rate")

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: CTCOPolicy
    actor: OptionActor
    actor_target: OptionActor
    critic: OptionCritic
    critic_target: OptionCritic

    def __init__(
        self,
        policy: str | type[CTCOPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 100,
        tau: float = 0.01,
        gamma: float = 0.98,
        gamma_dt: float = 0.05,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = -1,
        updates_per_second: float | None = None,
        n_sub_options: int = 8,
        n_rbf: int = 2,
        d_max: float | None = None,
        d_min: float | None = None,
        dt: float | None = None,
        trajectory: str | type[Trajectory] = "bezier",
        duration_scale: DurationScale = "log",
        join: Join = "free",
        high_freq_penalty: float | str | Schedule = "relative_0.1",
        target_decision_rate: float | None = None,
        ent_coef: str | float = "auto_0.02",
        target_entropy: str | float | Schedule = "auto",
        entropy_reference: EntropyReference = "average",
        critic_pessimism: Pessimism = "decision",
        fast_updates: bool = True,
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
        super().__init__(
            policy,
            env,
            learning_rate,
            n_rbf=n_rbf,
            d_max=_longest(d_max, gamma, gamma_dt),
            d_min=d_min,
            dt=dt,
            trajectory=trajectory,
            duration_scale=duration_scale,
            join=join,
            gamma=gamma,
            gamma_dt=gamma_dt,
            updates_per_second=updates_per_second,
            n_sub_options=n_sub_options,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            ent_coef=ent_coef,
            duration_ent_coef=ent_coef,
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
        self.high_freq_penalty = high_freq_penalty
        #: What a relative β_h is a multiple of, as of the last training: nothing before it
        self._penalty_unit = 0.0
        self.target_decision_rate = target_decision_rate
        self.fast_updates = fast_updates
        self.entropy_reference: EntropyReference = entropy_reference
        self.critic_pessimism: Pessimism = critic_pessimism

        if _init_setup_model:
            self._setup_model()

    @classmethod
    def wrapper_kwargs(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        """OptionExecutionWrapper's arguments for the algorithm's, where environments are made before it.

        :param arguments: the algorithm's arguments, defaults included
        """
        longest = _longest(arguments["d_max"], arguments["gamma"], arguments["gamma_dt"])
        return super().wrapper_kwargs({**arguments, "d_max": longest})

    @staticmethod
    def paper_defaults() -> dict[str, Any]:
        """The paper's algorithm as it stands, where it differs from the class's defaults.

        Section "Empirical Analysis" and Algorithm 1: one critic, networks of 10-10 and 64-64 units, β_h = 0.05, three basis
        functions, entropy as log π, no sub-options; batches of 100 as in its authors' code. The paper names neither d_max,
        nor β_E, nor step sizes, which stay at the class's defaults.

        Example:
            >>> model = CTCO("MlpPolicy", "Pendulum-v1", **CTCO.paper_defaults(), updates_per_second=20)

        :return: keyword arguments
        """
        return {
            "batch_size": 100,
            "n_sub_options": 0,
            "n_rbf": 3,
            "d_min": 0.0,
            "high_freq_penalty": 0.05,
            "trajectory": "rbf",
            "duration_scale": "linear",
            "join": "free",
            "entropy_reference": "paper",
            "critic_pessimism": "decision",
            "policy_kwargs": {"n_critics": 1, "net_arch": {"pi": [10, 10], "qf": [64, 64]}},
        }

    def _setup_model(self) -> None:
        # Here, since load comes by as well.
        if self.entropy_reference not in ENTROPY_REFERENCES:
            raise ValueError(f"entropy_reference must be one of {ENTROPY_REFERENCES}, not {self.entropy_reference!r}")
        if self.entropy_reference == "paper" and self.duration_scale != "linear":
            raise ValueError(
                "entropy_reference='paper' is of densities over d in s, so it needs duration_scale='linear', not "
                f"{self.duration_scale!r}"
            )
        if self.critic_pessimism not in PESSIMISMS:
            raise ValueError(f"critic_pessimism must be one of {PESSIMISMS}, not {self.critic_pessimism!r}")
        if self.critic_pessimism == "time" and self.gamma == 1.0:
            raise ValueError(
                "critic_pessimism='time' counts in shares of the discount, and gamma=1 has none: pass a smaller gamma, or "
                "critic_pessimism='decision'"
            )
        target, (coefficient, _) = self.target_decision_rate, _parse_penalty(self.high_freq_penalty)
        if target is not None and not 0 < target < math.inf:
            raise ValueError(f"target_decision_rate must be a positive number of Hz or None, not {target}")
        if target is not None and not (isinstance(coefficient, int | float) and coefficient > 0):
            raise ValueError(
                f"with a target_decision_rate, high_freq_penalty={self.high_freq_penalty} must be a positive number, or "
                "relative: β_h starts there, and its logarithm is learned"
            )
        super()._setup_model()
        space, n = self.option_space, self._n_temperatures()
        if target is not None and target * space.d_max <= 1.0:
            raise ValueError(
                f"target_decision_rate={target} Hz is out of reach of options that take d_max={space.d_max} s at most, "
                f"{1.0 / space.d_max:g} a second at least: pass a larger d_max"
            )
        # Which temperature each entry of an option has: weights by where they stand in an action's trajectory, and d's own.
        self._parts = th.zeros(self.actor.omega_dim + 1, n + 1, device=self.device)
        self._parts[:-1, :n] = th.eye(n, device=self.device).repeat(self.actor.omega_dim // n, 1)
        self._parts[-1, -1] = 1.0
        # None where it makes no difference or the trajectory does not want it
        self._canonical: CanonicalOptions | None = None
        if space.trajectory.critics_see_canonical and not CanonicalOptions.makes_no_difference(space):
            self._canonical = CanonicalOptions(space, self.device)
        self._fast_update: FastUpdate | None = None
        #: Why updates were made with autograd in the last training; None if they were not
        self.fast_updates_refusal: str | None = None
        if self.target_decision_rate is not None:
            assert isinstance(coefficient, int | float)
            self.log_high_freq_penalty = th.tensor(math.log(coefficient), device=self.device, requires_grad=True)
            self.high_freq_penalty_optimizer = th.optim.Adam([self.log_high_freq_penalty], lr=self.lr_schedule(1))
            #: What the replay buffer had counted at the last training: decisions, and their time in s; a file's goes on.
            self._counted_decisions: tuple[int, float] = getattr(self, "_counted_decisions", (0, 0.0))
        self._last_next_values: tuple[th.Tensor, th.Tensor] | None = None
        self._log_reference = log_reference_density(self._parts.sum(dim=0), space.d_min, space.d_max, self.entropy_reference)

    @classmethod
    def _arguments_of_older_files(cls, saved: dict[str, Any]) -> dict[str, Any]:
        arguments = super()._arguments_of_older_files(saved)
        targets = [saved.get("target_entropy"), saved.get("duration_target_entropy")]
        if all(isinstance(target, int | float) for target in targets):
            arguments["target_entropy"] = sum(targets)  # which was of ω alone, beside that of d
        return arguments

    def _after_load(self) -> None:
        super()._after_load()
        vars(self).pop("duration_target_entropy", None)

    def go_on_from(self, learned: OptionOffPolicyAlgorithm) -> None:
        """Take over the unit of the critics' values, and that of a relative β_h.

        :raises ValueError: if this model was given another unit of values
        """
        super().go_on_from(learned)
        assert isinstance(learned, CTCO)
        self._penalty_unit = learned._penalty_unit

    def _networks_and_targets(self) -> list[tuple[nn.Module, nn.Module]]:
        actors = [(self.actor, self.actor_target)] if self.policy.target_actor else []
        return [*super()._networks_and_targets(), *actors]

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.actor_target = self.policy.actor_target

    def _n_temperatures(self) -> int:
        # A short option feels little of its later weights: under one temperature these would have all of the entropy.
        return self.n_rbf

    def _auto_target_entropy(self) -> float:
        return -1.0 - self.actor.omega_dim

    def _split_target_entropy(self, target: float) -> tuple[float, float]:
        share = target / (self.actor.omega_dim + 1)
        return share * self.actor.omega_dim, share

    def entropy_costs(self, log_prob: th.Tensor) -> th.Tensor:
        """β_E log π relative to the reference, each part's with its own temperature.

        :param log_prob: of each part, ``[batch, n_weights + 1]``
        :return: ``[batch, 1]``
        """
        reference = log_prob.detach().mean(dim=0) if self._log_reference is None else self._log_reference
        return ((log_prob - reference) @ self.ent_coefs)[:, None]

    def _sample_policy(self, obs: PyTorchObs) -> tuple[th.Tensor, ...]:
        options, log_prob = self.actor.option_log_prob(obs)
        return options, log_prob @ self._parts

    def _critic_targets(self, data: ReplayBufferSamples) -> th.Tensor:
        next_options, next_log_prob = self.actor_target.option_log_prob(data.next_observations)
        next_q_values = self.critic_target(data.next_observations, self._as_critics_see(next_options))
        return self._targets(data, next_q_values, self.entropy_costs(next_log_prob @ self._parts))

    def _targets(self, data: ReplayBufferSamples, next_q_values: th.Tensor, next_entropy_costs: th.Tensor) -> th.Tensor:
        """What the critics learn, ``[batch, 1]``.

        :param next_q_values: of options that the target policy sampled, ``[n_critics, batch, 1]``
        :param next_entropy_costs: of those, ``[batch, 1]``
        """
        assert data.discounts is not None
        self._last_next_values = (next_q_values, next_entropy_costs)
        return critic_target(
            data.rewards,
            data.dones,
            data.discounts,
            pessimistic_values(next_q_values, data.discounts, self.critic_pessimism),
            next_entropy_costs,
            self._current_high_freq_penalty(),
        )

    def _actor_loss(self, obs: PyTorchObs, sample: tuple[th.Tensor, ...]) -> th.Tensor:
        options, log_prob = sample
        return actor_loss(self.critic(obs, self._as_critics_see(options)), self.entropy_costs(log_prob))

    def _q_values(self, data: ReplayBufferSamples) -> th.Tensor:
        return self.critic(data.observations, self._as_critics_see(data.actions))

    def _as_critics_see(self, options: th.Tensor) -> th.Tensor:
        return options if self._canonical is None else self._canonical(options)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Sample the replay buffer and update temperatures, critics, actor and targets; nothing while it is empty.

        :param gradient_steps: number of updates
        :param batch_size: decisions in a minibatch
        """
        if self.target_decision_rate is not None:
            self._update_high_freq_penalty()
        self._penalty_unit = self._paid_in_the_shortest_option()
        super().train(gradient_steps, batch_size)
        self.logger.record("option/high_freq_penalty", self._current_high_freq_penalty())
        if self._last_next_values is None:
            return  # A subclass has targets of its own.
        # What a decision costs beside it, in the last batch: of entropy, and of taking the smallest of the critics' values.
        next_q_values, next_entropy_costs = self._last_next_values
        self.logger.record("option/entropy_price", next_entropy_costs.mean().item())
        self.logger.record("option/critic_spread", (next_q_values.amax(dim=0) - next_q_values.amin(dim=0)).mean().item())

    @contextlib.contextmanager
    def _begin_updates(self) -> Iterator[Callable[[ReplayBufferSamples], th.Tensor]]:
        refusal = FastUpdate.refusal(self) if self.fast_updates else "fast_updates=False"
        self.logger.record("train/fast_updates", float(refusal is None))
        if refusal is not None:
            self._fast_update = None
            # Before the first update, with which optimizers get their state, there is always a reason.
            if refusal != self.fast_updates_refusal and self._n_updates > 0 and self.verbose > 0:
                print(f"Updates are made with autograd: {refusal}")
            self.fast_updates_refusal = refusal
            yield self._update
            return
        self.fast_updates_refusal = None
        if self._fast_update is None or not self._fast_update.is_valid():
            self._fast_update = FastUpdate(self)
        self._fast_update.load()
        try:
            yield self._fast_update.update
        finally:  # also what was learned until somebody pressed Ctrl-C
            self._fast_update.store()

    def _current_high_freq_penalty(self) -> float:
        # Read anew, so that it can be changed between trainings.
        coefficient, relative = _parse_penalty(self.high_freq_penalty)
        if self.target_decision_rate is not None:
            coefficient = math.exp(self.log_high_freq_penalty.item())
        penalty = FloatSchedule(coefficient)(self._current_progress_remaining)
        if not math.isfinite(penalty):
            raise ValueError(
                f"high_freq_penalty returned {penalty} at a remaining progress of {self._current_progress_remaining:g}: it "
                "must be finite"
            )
        return penalty * (self._penalty_unit if relative else 1.0)

    def _paid_in_the_shortest_option(self) -> float:
        """What a relative β_h is a multiple of: mean abs(R) a second, times ``d_min``, in the unit of the critics."""
        assert isinstance(self.replay_buffer, OptionReplayBuffer | DictOptionReplayBuffer)
        paid_a_second = self.replay_buffer.found_reward_scale() * self.replay_buffer.mean_reward_rate
        return paid_a_second * max(self.option_space.d_min, self.option_space.dt)

    def _update_high_freq_penalty(self) -> None:
        """Dual ascent on log β_h, as SAC's on its temperature, with the decisions since the last training.

        The constraint is that their mean duration be at least ``1/target_decision_rate``.
        """
        assert isinstance(self.replay_buffer, OptionReplayBuffer | DictOptionReplayBuffer)
        assert self.target_decision_rate is not None
        count, seconds = self.replay_buffer.n_decisions, self.replay_buffer.decision_seconds
        decisions, time_played = count - self._counted_decisions[0], seconds - self._counted_decisions[1]
        self._counted_decisions = (count, seconds)
        if decisions <= 0:
            return  # none, or another buffer was loaded
        update_learning_rate(self.high_freq_penalty_optimizer, self.lr_schedule(self._current_progress_remaining))
        # Bounded, so that rare long options do not make Adam's steps small for long.
        shortfall = max(-1.0, 1.0 - self.target_decision_rate * time_played / decisions)
        self.log_high_freq_penalty.grad = th.full_like(self.log_high_freq_penalty, -shortfall)
        self.high_freq_penalty_optimizer.step()

    def _excluded_save_params(self) -> list[str]:
        derived = [
            "actor_target",
            "_canonical",
            "_log_reference",
            "_parts",
            "_last_next_values",
            "_fast_update",
            "fast_updates_refusal",
        ]
        return [*super()._excluded_save_params(), *derived]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        if self.target_decision_rate is not None:
            state_dicts, tensors = [*state_dicts, "high_freq_penalty_optimizer"], [*tensors, "log_high_freq_penalty"]
        return state_dicts, tensors
