"""Rollout buffers of DAC-PPO: Stable-Baselines3's, for the two Markov decision processes of one rollout."""

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs

MDP = Literal["high", "low"]
MDPS: tuple[MDP, MDP] = ("high", "low")


class DACRolloutSamples(NamedTuple):
    """A minibatch for one of the two processes.

    :param observations: s
    :param previous_options: p, ``[batch]``
    :param episode_starts: whether an episode began with s, ``[batch]``, boolean
    :param options: o, ``[batch]``
    :param actions: a in units of the normalised box, ``[batch, action_dim]``
    :param old_log_prob: log π_H or log π_L when they were picked, ``[batch]``
    :param advantages: of this process, ``[batch]``
    :param returns: of this process, ``[batch]``
    """

    observations: PyTorchObs
    previous_options: th.Tensor
    episode_starts: th.Tensor
    options: th.Tensor
    actions: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor


class _DACStorage(RolloutBuffer):
    """What the two rollout buffers add to their Stable-Baselines3 base.

    Both processes have the same rewards; log-probabilities, values, advantages and returns are kept for each,
    ``[buffer_size, n_envs]``.
    """

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        shape = (self.buffer_size, self.n_envs)
        self.previous_options = np.zeros(shape, dtype=np.int64)
        self.options = np.zeros(shape, dtype=np.int64)
        self.mdp_log_probs = {mdp: np.zeros(shape, dtype=np.float32) for mdp in MDPS}
        self.mdp_values = {mdp: np.zeros(shape, dtype=np.float32) for mdp in MDPS}
        self.mdp_advantages = {mdp: np.zeros(shape, dtype=np.float32) for mdp in MDPS}
        self.mdp_returns = {mdp: np.zeros(shape, dtype=np.float32) for mdp in MDPS}

    def add_step(
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        episode_start: np.ndarray,
        previous_options: np.ndarray,
        output: dict[str, th.Tensor],
    ) -> None:
        """Store one step of each environment.

        :param obs: s
        :param reward: r, ``[n_envs]``
        :param episode_start: whether an episode began with s, ``[n_envs]``
        :param previous_options: p, ``[n_envs]``
        :param output: what the policy's ``forward`` returned for s
        """
        position = self.pos
        super().add(
            obs,  # type: ignore[arg-type]
            output["actions"].cpu().numpy(),
            reward,
            episode_start,
            output["high_values"],
            output["high_log_probs"],
        )
        self.previous_options[position] = previous_options
        self.options[position] = output["options"].cpu().numpy()
        for mdp in MDPS:
            self.mdp_log_probs[mdp][position] = output[f"{mdp}_log_probs"].cpu().numpy()
            self.mdp_values[mdp][position] = output[f"{mdp}_values"].cpu().numpy()

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """Generalised advantage estimation in each process, with its own values.

        :param last_values: V_H of the observation after the last step, ``[n_envs]``; the next option is not picked
            yet, so it is the expected value of both processes
        :param dones: whether the last step ended an episode, ``[n_envs]``
        """
        for mdp in MDPS:
            self.values = self.mdp_values[mdp]
            self.advantages = self.mdp_advantages[mdp]
            super().compute_returns_and_advantage(last_values, dones)
            self.mdp_returns[mdp] = self.returns

    def minibatches(self, mdp: MDP, batch_size: int) -> Iterator[DACRolloutSamples]:
        """Minibatches of one process, epoch after epoch without end, each epoch in a random order of its own.

        :param mdp: which process
        :param batch_size: steps in a minibatch; an epoch's last one may be smaller
        """
        observations: Any = self.observations
        if isinstance(observations, dict):
            observations = {key: self.swap_and_flatten(values) for key, values in observations.items()}
        else:
            observations = self.swap_and_flatten(observations)
        actions = self.swap_and_flatten(self.actions)
        fields = [
            self.swap_and_flatten(array)[:, 0]
            for array in (
                self.previous_options,
                self.episode_starts.astype(bool),
                self.options,
                self.mdp_log_probs[mdp],
                self.mdp_advantages[mdp],
                self.mdp_returns[mdp],
            )
        ]
        while True:
            order = np.random.permutation(len(actions))
            for start in range(0, len(order), batch_size):
                rows = order[start : start + batch_size]
                previous_options, episode_starts, options, log_probs, advantages, returns = (
                    self.to_torch(array[rows]) for array in fields
                )
                yield DACRolloutSamples(
                    {key: self.to_torch(values[rows]) for key, values in observations.items()}
                    if isinstance(observations, dict)
                    else self.to_torch(observations[rows]),
                    previous_options,
                    episode_starts,
                    options,
                    self.to_torch(actions[rows]),
                    log_probs,
                    advantages,
                    returns,
                )


class DACRolloutBuffer(_DACStorage):
    """Stable-Baselines3's ``RolloutBuffer`` for the two processes of double actor-critic."""


class DACDictRolloutBuffer(_DACStorage, DictRolloutBuffer):
    """Stable-Baselines3's ``DictRolloutBuffer`` for the two processes of double actor-critic."""
