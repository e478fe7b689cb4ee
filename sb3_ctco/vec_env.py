"""Environments in worker processes that do not wait for each other's options."""

from collections.abc import Callable
from multiprocessing.connection import wait
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs

from sb3_ctco.options import PENDING, PLAYED


class AsyncOptionVecEnv(SubprocVecEnv):
    """Stable-Baselines3's ``SubprocVecEnv`` for options of different durations: nobody waits for the slowest.

    ``step`` returns as soon as ``min_ready`` options have ended. Environments whose option runs on are marked by
    ``info["option_pending"]``: their observation is the one that the option began with, their reward is 0, and the action that
    they are given next is ignored. Where an option ended, ``info["option_played"]`` is the action that began it, perhaps
    several calls before. CTCO and FiGAR-SAC learn from the options that ended; environments run on while the networks
    are updated.

    Which option ends first depends on timing, so that runs cannot be repeated exactly. Other algorithms, and wrappers of
    VecEnvs that keep statistics or stacks of observations, would count pending observations again.

    Example::

        make_vec_env(env_id, n_envs=8, wrapper_class=OptionExecutionWrapper, vec_env_cls=AsyncOptionVecEnv)

    :param env_fns: environments to run in worker processes, each in an ``OptionExecutionWrapper``
    :param start_method: how to start the processes, see ``SubprocVecEnv``
    :param min_ready: how many options must have ended before ``step`` returns, 1 to the number of environments; more
        make batches larger, all of them are ``SubprocVecEnv``
    :raises ValueError: if ``min_ready`` is out of range
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], start_method: str | None = None, min_ready: int = 1):
        if not 1 <= min_ready <= len(env_fns):
            raise ValueError(f"min_ready must be 1 to {len(env_fns)}, the number of environments, not {min_ready}")
        super().__init__(env_fns, start_method)
        self.min_ready = min_ready
        self._running: set[int] = set()
        self._ended: dict[int, tuple[Any, ...]] = {}
        self._played: list[Any] = [None] * self.num_envs
        self._obs: list[Any] = []

    def reset(self) -> VecEnvObs:
        """Reset all environments; options that run are played to their end before."""
        self._let_end()
        self._ended.clear()
        observations = super().reset()
        self.reset_infos = list(self.reset_infos)
        if isinstance(observations, dict):
            self._obs = [{key: value[i] for key, value in observations.items()} for i in range(self.num_envs)]
        else:
            self._obs = list(observations)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Begin options in the environments where none runs."""
        for i in {*range(self.num_envs)} - self._running - {*self._ended}:
            self.remotes[i].send(("step", actions[i]))
            self._played[i] = actions[i]
            self._running.add(i)

    def step_wait(self) -> VecEnvStepReturn:
        """Wait until ``min_ready`` options have ended."""
        self._receive(self.min_ready)
        ended, self._ended = self._ended, {}
        rewards, dones = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{PENDING: True} for _ in range(self.num_envs)]
        for i, (obs, reward, done, info, reset_info) in ended.items():
            self._obs[i], rewards[i], dones[i], self.reset_infos[i] = obs, reward, done, reset_info
            infos[i] = {PLAYED: self._played[i], **info}
        return _stack_obs(self._obs, self.observation_space), rewards, dones, infos

    def _receive(self, count: int) -> None:
        """Wait until so many options have ended that were not returned yet."""
        while len(self._ended) < count:
            running = {self.remotes[i]: i for i in self._running}
            for remote in wait(list(running)):
                i = running[remote]  # type: ignore[index]
                self._ended[i] = self.remotes[i].recv()
                self._running.remove(i)

    def _let_end(self) -> None:
        self._receive(len(self._ended) + len(self._running))

    def _get_target_remotes(self, indices: VecEnvIndices) -> list[Any]:
        # A worker answers one question after the other, so what it was asked first must be fetched first.
        self._let_end()
        return super()._get_target_remotes(indices)

    def get_images(self) -> Any:
        """Frames, once the options that run have ended."""
        self._let_end()
        return super().get_images()

    def close(self) -> None:
        """Let running options end, then the processes."""
        if not self.closed:
            self._let_end()
        super().close()
