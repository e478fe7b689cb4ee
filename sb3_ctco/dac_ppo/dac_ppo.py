"""Double Actor-Critic (Zhang and Whiteson 2019, https://arxiv.org/abs/1904.12691) on proximal policy optimisation."""

import io
import itertools
import pathlib
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_ctco.common.load_arguments import check_load_arguments
from sb3_ctco.dac_ppo.buffers import MDP, MDPS, DACDictRolloutBuffer, DACRolloutBuffer, DACRolloutSamples
from sb3_ctco.dac_ppo.policies import CnnPolicy, DACPolicy, MlpPolicy, MultiInputPolicy
from sb3_ctco.options import check_seconds, discount_rate_from_gamma
from sb3_ctco.wrappers import OptionExecutionWrapper
from sb3_ctco.wrappers.timing import UNTOLD_DT, find_dt_of_all

SelfDACPPO = TypeVar("SelfDACPPO", bound="DACPPO")


def clipped_surrogate_loss(
    log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, clip_range: float
) -> tuple[th.Tensor, th.Tensor]:
    """PPO's loss −E[min(ratio·A, clip(ratio, 1 − ε, 1 + ε)·A)], and the ratios π/π_old.

    :param log_prob: ``[batch]``
    :param old_log_prob: ``[batch]``
    :param advantages: A, ``[batch]``
    :param clip_range: ε
    :return: the loss, and the ratios ``[batch]``
    """
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
    return -th.minimum(ratio * advantages, clipped * advantages).mean(), ratio


class DACPPO(OnPolicyAlgorithm):
    """Double Actor-Critic on proximal policy optimisation (DAC-PPO).

    A policy over K options is two Markov decision processes at once: in the high one a master picks the option, given
    the previous one; in the low one the option picks the action. Both are solved by PPO, on the same rollouts.

    Paper: Zhang, Whiteson: "DAC: The Double Actor-Critic Architecture for Learning Options", NeurIPS 2019,
    https://arxiv.org/abs/1904.12691. It is a baseline of Karimi et al. 2023, https://arxiv.org/abs/2212.04407.

    The policy picks an action, and may leave its option, at every step of the environment; so options last fewer
    seconds the shorter the step is.

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: the environment to learn from, with a ``Box`` of finite bounds as action space
    :param learning_rate: step size, or a function of the remaining progress
    :param n_steps: steps in each environment between trainings
    :param batch_size: steps in a minibatch
    :param n_epochs: epochs a training, for each of the two processes; 5 by default
    :param updates_per_second: updates per second of task time, in place of ``n_epochs``: half of them for each process;
        a fraction is carried over
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]; it means the same at every ``dt``
    :param gamma_dt: in s; None for one step of the environment, whatever time it takes
    :param dt: interaction period of the environment, in s; by default found in the environment
    :param gae_lambda: λ of generalised advantage estimation over ``gamma_dt`` seconds, in [0, 1]
    :param clip_range: how far from 1 the ratio of probabilities may be, or a function of the remaining progress
    :param normalize_advantage: whether to normalise advantages in each minibatch
    :param ent_coef: weight of the entropy of π_H
    :param vf_coef: weight of the value losses ½(return − V)²
    :param max_grad_norm: largest norm of a gradient
    :param rollout_buffer_class: ``DACRolloutBuffer`` or ``DACDictRolloutBuffer``, or a subclass
    :param rollout_buffer_kwargs: keyword arguments for the rollout buffer
    :param policy_kwargs: arguments of the policy, e.g. ``dict(n_options=4, net_arch=[64, 64])``
    :param stats_window_size: number of episodes that rollout statistics are averaged over
    :param tensorboard_log: log location for TensorBoard (None for no log)
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: seed of the pseudo-random generators
    :param device: device to run on
    :param _init_setup_model: whether to build the networks at the creation of the instance
    :raises ValueError: for settings out of range, or that contradict each other or the environment's
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: DACPolicy  # type: ignore[assignment]
    rollout_buffer: DACRolloutBuffer | DACDictRolloutBuffer  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[DACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int | None = None,
        updates_per_second: float | None = None,
        gamma: float = 0.99,
        gamma_dt: float | None = 0.05,
        dt: float | None = None,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        normalize_advantage: bool = True,
        ent_coef: float = 0.01,
        vf_coef: float = 1.0,
        max_grad_norm: float = 0.5,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,  # type: ignore[arg-type]
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
            supported_action_spaces=(spaces.Box,),
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.updates_per_second = updates_per_second
        self.gamma_dt = gamma_dt
        self.dt = dt
        # An explicit dt stays the user's word on any environment; one that was found must be found again.
        self._dt_was_given = dt is not None
        self.clip_range: float | Schedule = clip_range
        self.normalize_advantage = normalize_advantage
        self._updates_due = 0.0

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if not np.issubdtype(self.action_space.dtype, np.floating):  # type: ignore[arg-type]
            raise TypeError(f"DACPPO needs actions that are real numbers, not {self.action_space}, which it would round")
        self._check_arguments()
        if self.env is not None:
            self._check_env(self.env)
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = DACDictRolloutBuffer if is_dict else DACRolloutBuffer
        elif not issubclass(self.rollout_buffer_class, DACRolloutBuffer | DACDictRolloutBuffer):
            raise ValueError(
                "rollout_buffer_class must be DACRolloutBuffer, DACDictRolloutBuffer or a subclass, not "
                f"{self.rollout_buffer_class.__name__}, which keeps one process only"
            )
        super()._setup_model()
        self.rollout_buffer.gamma, self.rollout_buffer.gae_lambda = self.step_gamma, self.step_gae_lambda
        # As in Stable-Baselines3's PPO: a function of the remaining progress, whatever was given.
        self.clip_range = FloatSchedule(self.clip_range)
        self._last_options = np.zeros(self.n_envs, dtype=np.int64)

    def _check_arguments(self) -> None:
        if self.n_epochs is not None and self.updates_per_second is not None:
            raise ValueError(
                f"n_epochs={self.n_epochs} and updates_per_second={self.updates_per_second} both say how often to update: "
                "pass one of them"
            )
        if self.updates_per_second is not None and not 0 < self.updates_per_second < np.inf:
            raise ValueError(f"updates_per_second must be positive or None, not {self.updates_per_second}")
        if self.n_epochs is None and self.updates_per_second is None:
            self.n_epochs = 5
        if self.n_epochs is not None and self.n_epochs < 1:
            raise ValueError(f"n_epochs must be at least 1, not {self.n_epochs}")
        if self.batch_size < 2 and self.normalize_advantage:
            raise ValueError(f"batch_size must be at least 2 to normalise advantages, not {self.batch_size}")
        if not 0.0 <= self.gae_lambda <= 1.0:
            raise ValueError(f"gae_lambda must be in [0, 1], not {self.gae_lambda}")
        # With one step as the unit of time γ is the discount of a step, so this checks its range as well.
        discount_rate_from_gamma(self.gamma, 1.0 if self.gamma_dt is None else self.gamma_dt)
        check_seconds(dt=self.dt)

    def _check_env(self, env: VecEnv) -> None:
        """Find the environment's dt, or see that it is the algorithm's.

        :raises ValueError: if it is not found but needed, differs, or the environment's steps are options
        """
        if any(env.env_is_wrapped(OptionExecutionWrapper)):
            raise ValueError(
                "DACPPO's options are made of single steps, and it does not know how long a step of OptionExecutionWrapper "
                "takes: remove the wrapper"
            )
        if self._dt_was_given:
            return
        found = find_dt_of_all(env)
        check_seconds(dt=found)
        if self.dt is not None and found is not None and not np.isclose(found, self.dt, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"the environment has dt={found}, DACPPO has dt={self.dt}: a policy is for one dt, so make the environment "
                "with the same"
            )
        self.dt = self.dt if found is None else found
        if self.dt is None and (self.gamma_dt is not None or self.updates_per_second is not None):
            raise ValueError(
                f"the environment {UNTOLD_DT}: pass dt, in seconds, to DACPPO, or gamma_dt=None for a gamma and a gae_lambda "
                "a step"
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Stable-Baselines3's ``set_env``.

        :raises ValueError: if the environment's dt is not the algorithm's
        """
        env = self._wrap_env(env, self.verbose)
        self._check_env(env)
        super().set_env(env, force_reset)

    @classmethod
    def load(
        cls: type[SelfDACPPO],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfDACPPO:
        """Stable-Baselines3's ``load``.

        :param kwargs: arguments of the constructor to change; all but ``dt`` and ``policy_kwargs``
        :raises TypeError: for an argument that the constructor does not have
        :raises ValueError: if the environment's dt differs from the file's, or an argument that cannot be changed
        """
        kwargs = check_load_arguments(cls, path, kwargs, ("dt",))
        # Of two that say the same in different ways, the one that is given holds.
        if "n_epochs" in kwargs:
            kwargs.setdefault("updates_per_second", None)
        elif kwargs.get("updates_per_second") is not None:
            kwargs["n_epochs"] = None
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def _a_step(self, factor: float) -> float:
        """What a factor over ``gamma_dt`` seconds is over one step."""
        if self.gamma_dt is None:
            return factor
        assert self.dt is not None
        return factor ** (self.dt / self.gamma_dt)

    @property
    def step_gamma(self) -> float:
        """Discount factor over one step, γ^(dt/γ_dt) = e^(−τ·dt)."""
        return self._a_step(self.gamma)

    @property
    def step_gae_lambda(self) -> float:
        """λ over one step, λ^(dt/γ_dt)."""
        return self._a_step(self.gae_lambda)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect steps with the current policy.

        Stable-Baselines3 2.9's method, with options carried from step to step; gSDE is left out.

        :return: False if the callback stopped the rollout
        """
        obs = self._last_obs
        assert obs is not None and self._last_episode_starts is not None
        assert isinstance(rollout_buffer, DACRolloutBuffer | DACDictRolloutBuffer)
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()

        for _ in range(n_rollout_steps):
            previous_options, episode_starts = self._last_options, self._last_episode_starts.astype(bool)
            with th.no_grad():
                output = self.policy(
                    obs_as_tensor(obs, self.device),
                    th.as_tensor(previous_options, device=self.device),
                    th.as_tensor(episode_starts, device=self.device),
                )
            options = output["options"].cpu().numpy()
            new_obs, rewards, dones, infos = env.step(self.policy.env_actions(output["actions"].cpu().numpy()))
            self.num_timesteps += env.num_envs

            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)

            for i in np.flatnonzero(dones):
                # A timeout is no end: both processes go on from the terminal observation.
                if infos[i].get("TimeLimit.truncated", False) and infos[i].get("terminal_observation") is not None:
                    value = self._high_values(infos[i]["terminal_observation"], options[i : i + 1])
                    rewards[i] += self.step_gamma * value.item()

            rollout_buffer.add_step(obs, rewards, episode_starts, previous_options, output)
            self._last_obs = obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones
            self._last_options = options

        last_values = self._high_values(obs, self._last_options)
        rollout_buffer.compute_returns_and_advantage(last_values, dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _high_values(self, obs: Any, previous_options: np.ndarray) -> th.Tensor:
        """V_H(p, s) in the middle of an episode, ``[n]``."""
        with th.no_grad():
            return self.policy.high_value(
                self.policy.obs_to_tensor(obs)[0],
                th.as_tensor(previous_options, device=self.device),
                th.zeros(len(previous_options), dtype=th.bool, device=self.device),
            )

    def dump_logs(self, iteration: int = 0) -> None:
        """Write log data; also how long an option lasted in the last rollout."""
        buffer = self.rollout_buffer
        picked = (buffer.options != buffer.previous_options) | (buffer.episode_starts > 0)
        # The first step of a rollout begins the part of an option that is seen.
        picked[0] = True
        n_steps = picked.size / picked.sum()
        self.logger.record("option/n_steps_mean", n_steps)
        if self.dt is not None:
            self.logger.record("option/duration_mean", n_steps * self.dt)
        super().dump_logs(iteration)

    def _evaluate(self, mdp: MDP, batch: DACRolloutSamples) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Values and log-probabilities of a minibatch in one process, and the entropy of π_H, each ``[batch]``."""
        predictions = self.policy.options(batch.observations)
        index = batch.options[:, None]
        if mdp == "low":
            log_prob = predictions.low_distribution(batch.options).log_prob(batch.actions).sum(dim=1)
            return predictions.q_values.gather(1, index)[:, 0], log_prob, th.zeros_like(log_prob)
        log_probs = predictions.high_log_probs(batch.previous_options, batch.episode_starts)
        probs = log_probs.exp()
        # The value's error is q's to correct, not the policy's.
        values = (probs.detach() * predictions.q_values).sum(dim=1)
        return values, log_probs.gather(1, index)[:, 0], -(probs * log_probs).sum(dim=1)

    def _numbers_of_updates(self) -> tuple[int, int]:
        """How many updates are due for the process that comes first, and for the other one."""
        n_samples = self.n_steps * self.n_envs
        if self.updates_per_second is None:
            assert self.n_epochs is not None
            n_updates = self.n_epochs * -(-n_samples // self.batch_size)
            return n_updates, n_updates
        assert self.dt is not None
        self._updates_due += n_samples * self.dt * self.updates_per_second
        n_updates = int(self._updates_due)
        self._updates_due -= n_updates
        return n_updates - n_updates // 2, n_updates // 2

    def train(self) -> None:
        """Update by PPO in both processes, in random order, on the current rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        assert isinstance(self.clip_range, FloatSchedule)
        clip_range = self.clip_range(self._current_progress_remaining)

        order = MDPS if np.random.rand() < 0.5 else MDPS[::-1]
        for mdp, n_updates in zip(order, self._numbers_of_updates(), strict=True):
            batches = self.rollout_buffer.minibatches(mdp, self.batch_size)
            statistics = [self._update(mdp, batch, clip_range) for batch in itertools.islice(batches, n_updates)]
            self._n_updates += n_updates
            if statistics:
                # Read once, because each reading waits for the device.
                means = th.stack(statistics).mean(dim=0).tolist()
                for name, mean in zip(("policy_loss", "value_loss", "approx_kl", "clip_fraction"), means, strict=True):
                    self.logger.record(f"train/{mdp}_{name}", mean)
            values, returns = self.rollout_buffer.mdp_values[mdp], self.rollout_buffer.mdp_returns[mdp]
            self.logger.record(f"train/{mdp}_explained_variance", explained_variance(values.ravel(), returns.ravel()))

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        self.logger.record("train/std", self.policy.stds.mean().item())

    def _update(self, mdp: MDP, batch: DACRolloutSamples, clip_range: float) -> th.Tensor:
        """One step of the optimiser.

        :return: policy loss, value loss, approximate KL divergence from the old policy, and fraction of ratios clipped
        """
        values, log_prob, entropy = self._evaluate(mdp, batch)
        advantages = batch.advantages
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        policy_loss, ratio = clipped_surrogate_loss(log_prob, batch.old_log_prob, advantages, clip_range)
        value_loss = 0.5 * (batch.returns - values).square().mean()
        loss = policy_loss - self.ent_coef * entropy.mean() + self.vf_coef * value_loss
        self.policy.optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        with th.no_grad():
            # The estimate of http://joschu.net/blog/kl-approx.html, as in Stable-Baselines3's PPO
            approx_kl = (ratio - 1.0 - ratio.log()).mean()
            clip_fraction = ((ratio - 1.0).abs() > clip_range).float().mean()
            return th.stack((policy_loss, value_loss, approx_kl, clip_fraction))

    def learn(
        self: SelfDACPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "DACPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDACPPO:
        """Learn for ``total_timesteps``, rounded up to whole rollouts.

        Parameters are those of Stable-Baselines3's ``learn``.
        """
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
