"""Measure agents that decide at different rates by one yardstick: returns in task time, and smoothness of actions."""

import math
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, PENDING, ActionBox, RewardUnit, discount, integrated_reward


def mean_absolute_jerk(actions: npt.ArrayLike, dt: float) -> float:
    """Mean absolute third derivative of an action signal, by finite differences: the mean size of Δ³a/dt³.

    The measure of Hogan and Sternad 2009, "Sensitivity of Smoothness Measures to Movement Duration, Amplitude, and
    Arrests", https://doi.org/10.3200/35-09-004-RC, of the action in place of a position. A signal with jumps has a jerk
    that grows as dt shrinks: compare at one dt.

    :param actions: one action a step, normalised to [−1, 1], shape ``[n_steps, action_dim]``
    :param dt: the interaction period, in s
    :return: in 1/s³, averaged over steps and dimensions; nan for less than four steps
    """
    actions = np.asarray(actions, dtype=np.float64)
    return float(np.abs(np.diff(actions, n=3, axis=0)).mean()) / dt**3 if len(actions) > 3 else math.nan


def spectral_smoothness(actions: npt.ArrayLike) -> float:
    """Sm = 2/(n·f_s)·Σᵢ Mᵢfᵢ, the measure of the CAPS paper; smaller is smoother.

    Mysore, Mabsout, Mancuso, Saenko 2021, "Regularizing Action Policies for Smooth Control with Reinforcement Learning",
    section "Measuring Smoothness", https://arxiv.org/abs/2012.06644. Mᵢ is the amplitude of the sinusoid of frequency fᵢ
    in the signal, i = 1 … n = n_steps // 2 (the mean has frequency 0), and f_s the sampling frequency. Frequencies are
    relative to f_s, so compare at one dt.

    :param actions: one action a step, normalised to [−1, 1], shape ``[n_steps, action_dim]``
    :return: averaged over dimensions, at least 0; nan for less than two steps
    """
    actions = np.asarray(actions, dtype=np.float64)
    n_steps = len(actions)
    n = n_steps // 2
    if n == 0:
        return math.nan
    amplitudes = 2.0 * np.abs(np.fft.rfft(actions, axis=0)[1 : n + 1]) / n_steps
    if n_steps % 2 == 0:
        amplitudes[-1] /= 2.0  # half the sampling frequency has no mirror image
    relative_frequencies = np.fft.rfftfreq(n_steps)[1 : n + 1, None]
    return float(2.0 / n * (amplitudes * relative_frequencies).sum(axis=0).mean())


def largest_jump(actions: npt.ArrayLike) -> float:
    """The largest change of an action from one step to the next, of any dimension.

    It shrinks in proportion with dt where a signal is continuous, and stays where it jumps: compare at one dt.

    :param actions: one action a step, normalised to [−1, 1], shape ``[n_steps, action_dim]``
    :return: 0 to 2; nan for less than two steps
    """
    actions = np.asarray(actions, dtype=np.float64)
    return float(np.abs(np.diff(actions, axis=0)).max()) if len(actions) > 1 else math.nan


@dataclass
class EpisodeStatistics:
    """What an episode was worth, and how it was played.

    :param discounted_return: ∫ e^(−τt) r dt, equation (2) of Karimi et al. 2023, in reward rate × s
    :param seconds: task time of the episode, in s
    :param decisions: how often the policy was asked
    :param episode_return: sum of the primitive rewards, from ``Monitor``; without one, of what ``step`` returned
    :param mean_absolute_jerk: of the primitive actions, see :func:`mean_absolute_jerk`; nan if not measured
    :param spectral_smoothness: likewise, see :func:`spectral_smoothness`
    :param largest_jump: likewise, see :func:`largest_jump`
    """

    discounted_return: float = 0.0
    seconds: float = 0.0
    decisions: int = 0
    episode_return: float = 0.0
    mean_absolute_jerk: float = math.nan
    spectral_smoothness: float = math.nan
    largest_jump: float = math.nan

    @property
    def decision_rate_hz(self) -> float:
        """Decisions a second of task time."""
        return self.decisions / self.seconds


def _find_discount_rate(env: VecEnv, given: float | None) -> float:
    """τ, in 1/s, of an environment whose steps are options; of any other what is given, or the default.

    :raises ValueError: if the environment's is another than what is given, or its environments differ
    """
    if not env.has_attr("option_space"):
        return DEFAULT_DISCOUNT_RATE if given is None else given
    rates = [space.discount_rate for space in env.get_attr("option_space")]
    expected = rates[0] if given is None else given
    if not np.allclose(rates, expected, rtol=1e-6, atol=0.0):
        raise ValueError(
            f"the environments' options are discounted at discount_rate={rates}, within them, so not at {expected} between "
            "them: leave discount_rate out, or make the environments with the same"
        )
    return expected


def _as_paid(env: VecEnv, rewards: np.ndarray) -> np.ndarray:
    """The last step's rewards, before VecNormalize."""
    normalizer = unwrap_vec_normalize(env)
    return rewards if normalizer is None else normalizer.get_original_reward()


@dataclass
class _EpisodeTracker:
    """Sums up the episodes of a VecEnv, whether its steps are options or primitive steps of ``dt``."""

    n_envs: int
    discount_rate: float
    dt: float | None
    reward_unit: RewardUnit
    running: list[EpisodeStatistics] = field(init=False)
    #: What a reward of 1 in a primitive step of ``dt`` integrates to
    weight: float = field(init=False)
    #: Primitive steps of the running episodes, and of those that ended last
    n_steps: list[int] = field(init=False)
    n_steps_of_last: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.running = [EpisodeStatistics() for _ in range(self.n_envs)]
        self.weight = 0.0 if self.dt is None else integrated_reward(np.ones(1), self.dt, self.discount_rate, self.reward_unit)
        self.n_steps = [0] * self.n_envs
        self.n_steps_of_last = [0] * self.n_envs

    def step(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> dict[int, EpisodeStatistics]:
        """Account for one step of each environment.

        :return: the episodes that ended with it, by environment
        """
        ended = {}
        for i, (reward, done, info) in enumerate(zip(rewards, dones, infos, strict=True)):
            if PENDING in info:
                continue
            if "option" in info:
                duration, integral = info["option"]["duration"], info["option"]["integrated_reward"]
            elif self.dt is not None:
                duration, integral = self.dt, float(reward) * self.weight
            else:
                raise ValueError("these steps are no options: pass dt, the environment's interaction period in seconds")
            episode = self.running[i]
            episode.discounted_return += float(discount(episode.seconds, self.discount_rate)) * integral
            episode.seconds += duration
            episode.decisions += 1
            self.n_steps[i] += info["option"]["n_steps"] if "option" in info else 1
            episode.episode_return += float(reward)
            if done:
                if "episode" in info:
                    episode.episode_return = info["episode"]["r"]
                ended[i] = episode
                self.running[i] = EpisodeStatistics()
                self.n_steps_of_last[i], self.n_steps[i] = self.n_steps[i], 0
        return ended


@dataclass
class _ActionRecorder:
    """Collects the primitive actions of a VecEnv's episodes, whether its steps are options or primitive steps."""

    env: VecEnv
    actions: list[list[np.ndarray]] = field(init=False)

    def __post_init__(self) -> None:
        self.actions = [[] for _ in range(self.env.num_envs)]
        self.is_option_env = self.env.has_attr("primitive_action_space")
        space = self.env.get_attr("primitive_action_space")[0] if self.is_option_env else self.env.action_space
        if not (isinstance(space, spaces.Box) and np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise ValueError(f"smoothness is measured of actions in a Box with finite bounds, not in {space}")
        self.box = ActionBox(space.low, space.high)

    def step(self, actions: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> dict[int, np.ndarray]:
        """Account for one step of each environment.

        :return: the normalised actions of the episodes that ended with it, by environment, each ``[n_steps, action_dim]``
        """
        ended = {}
        for i, (action, done, info) in enumerate(zip(actions, dones, infos, strict=True)):
            if PENDING in info:
                continue
            played = self.env.get_attr("played", indices=i)[0] if self.is_option_env else action[None]
            self.actions[i].append(self.box.normalise(played))
            if done:
                ended[i] = np.concatenate(self.actions[i])
                self.actions[i] = []
        return ended


def evaluate_discounted_return(
    model: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = True,
    discount_rate: float | None = None,
    dt: float | None = None,
    smoothness: bool = False,
    reward_unit: RewardUnit = "rate",
) -> list[EpisodeStatistics]:
    """Play whole episodes.

    :param model: anything with Stable-Baselines3's ``predict``
    :param env: the environment that the model acts in: for CTCO one wrapped in ``OptionExecutionWrapper``
    :param n_eval_episodes: number of episodes, shared among the environments of a VecEnv
    :param deterministic: whether to act greedily
    :param discount_rate: τ, in 1/s; by default the environment's where steps are options, and the paper's 0.404 elsewhere
    :param dt: interaction period in s, needed where steps are no options
    :param smoothness: whether to measure the smoothness of the primitive actions as well, normalised to [−1, 1]
    :param reward_unit: where steps are no options, ``"rate"`` or ``"impulse"``, see
        :func:`~sb3_ctco.options.integrated_reward`; options have their environment's
    :return: one entry an episode
    :raises ValueError: if ``n_eval_episodes`` is negative, the environment's options are discounted at another rate, for an
        unknown ``reward_unit`` where steps are no options, or if smoothness is asked for where actions are not in a Box with
        finite bounds
    """
    if n_eval_episodes < 0:
        raise ValueError(f"n_eval_episodes must be at least 0, not {n_eval_episodes}")
    if not isinstance(env, VecEnv):
        single = env
        env = DummyVecEnv([lambda: single])
    tracker = _EpisodeTracker(env.num_envs, _find_discount_rate(env, discount_rate), dt, reward_unit)
    recorder = _ActionRecorder(env) if smoothness else None
    episodes: list[EpisodeStatistics] = []
    obs = env.reset()
    # Of policies with a memory, such as DAC-PPO's current option
    state: tuple[np.ndarray, ...] | None = None
    dones = np.ones(env.num_envs, dtype=bool)
    # As many of each environment, as Stable-Baselines3's evaluate_policy has: those that end first are the short ones.
    wanted = [(n_eval_episodes + i) // env.num_envs for i in range(env.num_envs)]
    while any(wanted):
        actions, state = model.predict(obs, state=state, episode_start=dones, deterministic=deterministic)  # type: ignore[arg-type]
        obs, rewards, dones, infos = env.step(actions)
        ended = tracker.step(_as_paid(env, rewards), dones, infos)
        if recorder is not None:
            for i, played in recorder.step(actions, dones, infos).items():
                episode = ended[i]
                episode.mean_absolute_jerk = mean_absolute_jerk(played, episode.seconds / len(played))
                episode.spectral_smoothness = spectral_smoothness(played)
                episode.largest_jump = largest_jump(played)
        for i, episode in ended.items():
            if wanted[i]:
                wanted[i] -= 1
                episodes.append(episode)
    return episodes


class DiscountedReturnCallback(BaseCallback):
    """Record the discounted return and the decision rate of each training episode, of CTCO and of any other algorithm.

    Logs ``rollout/ep_discounted_return_mean`` over the last 100 episodes.

    :param discount_rate: τ, in 1/s; by default the environment's where steps are options, and the paper's 0.404 elsewhere
    :param dt: interaction period in s, needed where the algorithm's steps are no options
    :param reward_unit: where they are none, ``"rate"`` or ``"impulse"``, see :func:`~sb3_ctco.options.integrated_reward`
    :raises ValueError: when training starts, if the environment's options are discounted at another rate, or for another
        ``reward_unit``
    """

    def __init__(self, discount_rate: float | None = None, dt: float | None = None, reward_unit: RewardUnit = "rate"):
        super().__init__()
        self.discount_rate = discount_rate
        self.dt = dt
        self.reward_unit: RewardUnit = reward_unit
        self._tracker: _EpisodeTracker | None = None
        #: Episodes in the order of their ends, and the algorithm's number of steps then.
        self.episodes: list[EpisodeStatistics] = []
        self.timesteps: list[int] = []

    def _on_training_start(self) -> None:
        env, goes_on = self.training_env, self.locals.get("reset_num_timesteps") is False
        if not (goes_on and self._tracker is not None and self._tracker.n_envs == env.num_envs):
            self._tracker = _EpisodeTracker(
                env.num_envs, _find_discount_rate(env, self.discount_rate), self.dt, self.reward_unit
            )
        # Episodes that run already may not have been seen from their beginning, or may never end.
        self._torn = set(range(env.num_envs)) if goes_on else set()

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if infos[0]:  # empty at the ticks between two decisions
            assert self._tracker is not None
            rewards, dones = _as_paid(self.training_env, self.locals["rewards"]), self.locals["dones"]
            ended = self._tracker.step(rewards, dones, infos)
            for i in self._torn & ended.keys():
                self._torn.remove(i)
                # By Monitor's count, of steps, or of decisions where it is outside of them.
                length = infos[i].get("episode", {}).get("l")
                if length is not None and length not in (ended[i].decisions, self._tracker.n_steps_of_last[i]):
                    del ended[i]
            if ended:
                self.episodes += ended.values()
                self.timesteps += [self.num_timesteps] * len(ended)
                recent = [episode.discounted_return for episode in self.episodes[-100:]]
                self.logger.record("rollout/ep_discounted_return_mean", float(np.mean(recent)))
        return True
