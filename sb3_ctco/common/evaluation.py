"""Measure agents that decide at different rates by one yardstick: the discounted return in task time."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, discount, step_weight


@dataclass
class EpisodeStatistics:
    """What an episode was worth, and how it was played.

    :param discounted_return: ∫ e^(−τt) r dt, equation (3) of Karimi et al. 2023, in reward rate × s
    :param seconds: task time of the episode, in s
    :param decisions: how often the policy was asked
    """

    discounted_return: float = 0.0
    seconds: float = 0.0
    decisions: int = 0

    @property
    def decision_rate_hz(self) -> float:
        """Decisions a second of task time."""
        return self.decisions / self.seconds


@dataclass
class _EpisodeTracker:
    """Sums up the episodes of a VecEnv, whether its steps are options or primitive steps of ``dt``."""

    n_envs: int
    discount_rate: float
    dt: float | None
    running: list[EpisodeStatistics] = field(init=False)

    def __post_init__(self) -> None:
        self.running = [EpisodeStatistics() for _ in range(self.n_envs)]

    def step(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> list[EpisodeStatistics]:
        """Account for one step of each environment.

        :return: the episodes that ended with it
        """
        ended = []
        for i, (reward, done, info) in enumerate(zip(rewards, dones, infos, strict=True)):
            if "option" in info:
                duration, integral = info["option"]["duration"], info["option"]["integrated_reward"]
            elif self.dt is not None:
                duration, integral = self.dt, float(reward) * step_weight(self.dt, self.discount_rate)
            else:
                raise ValueError("these steps are no options: pass dt, the environment's interaction period in seconds")
            episode = self.running[i]
            episode.discounted_return += float(discount(episode.seconds, self.discount_rate)) * integral
            episode.seconds += duration
            episode.decisions += 1
            if done:
                ended.append(episode)
                self.running[i] = EpisodeStatistics()
        return ended


def evaluate_discounted_return(
    model: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = True,
    discount_rate: float = DEFAULT_DISCOUNT_RATE,
    dt: float | None = None,
) -> list[EpisodeStatistics]:
    """Play whole episodes.

    :param model: anything with Stable-Baselines3's ``predict``
    :param env: the environment that the model acts in: for CTCO one wrapped in ``OptionExecutionWrapper``, with the
        same ``discount_rate``
    :param n_eval_episodes: number of episodes
    :param deterministic: whether to act greedily
    :param discount_rate: τ, in 1/s
    :param dt: interaction period in s, needed where steps are no options
    :return: one entry an episode
    """
    if not isinstance(env, VecEnv):
        single = env
        env = DummyVecEnv([lambda: single])
    tracker = _EpisodeTracker(env.num_envs, discount_rate, dt)
    episodes: list[EpisodeStatistics] = []
    obs = env.reset()
    while len(episodes) < n_eval_episodes:
        actions, _ = model.predict(obs, deterministic=deterministic)  # type: ignore[arg-type]
        obs, rewards, dones, infos = env.step(actions)
        episodes += tracker.step(rewards, dones, infos)
    return episodes[:n_eval_episodes]


class DiscountedReturnCallback(BaseCallback):
    """Record the discounted return and the decision rate of each training episode, of CTCO and of any other algorithm.

    Logs ``rollout/ep_discounted_return_mean`` over the last 100 episodes.

    :param discount_rate: τ, in 1/s
    :param dt: interaction period in s, needed where the algorithm's steps are no options
    """

    def __init__(self, discount_rate: float = DEFAULT_DISCOUNT_RATE, dt: float | None = None):
        super().__init__()
        self.discount_rate = discount_rate
        self.dt = dt
        #: Episodes in the order of their ends, and the algorithm's number of steps then.
        self.episodes: list[EpisodeStatistics] = []
        self.timesteps: list[int] = []

    def _on_training_start(self) -> None:
        self._tracker = _EpisodeTracker(self.training_env.num_envs, self.discount_rate, self.dt)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if infos[0]:  # empty at the ticks between two decisions
            ended = self._tracker.step(self.locals["rewards"], self.locals["dones"], infos)
            if ended:
                self.episodes += ended
                self.timesteps += [self.num_timesteps] * len(ended)
                recent = [episode.discounted_return for episode in self.episodes[-100:]]
                self.logger.record("rollout/ep_discounted_return_mean", float(np.mean(recent)))
        return True
