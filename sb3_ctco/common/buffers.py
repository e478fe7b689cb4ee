"""Replay buffers for options: Stable-Baselines3's, extended by the duration and the integrated reward of a decision."""

import dataclasses
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, SubOptions, discount
from sb3_ctco.vec_env import PENDING


class _OptionStorage(ReplayBuffer):
    """What the two option buffers add to their Stable-Baselines3 base."""

    #: Of buffers that were saved without one
    reward_scale = 1.0

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        discount_rate: float = DEFAULT_DISCOUNT_RATE,
        reward_scale: float = 1.0,
    ):
        if optimize_memory_usage:
            raise ValueError(
                f"{type(self).__name__} does not support optimize_memory_usage=True: it would lose the observation "
                "in which an option was truncated, from which its target bootstraps"
            )
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            # One row a transition, whichever environment it is from: options end at different times, and the number
            # of their sub-options differs.
            n_envs=1,
            handle_timeout_termination=handle_timeout_termination,
        )
        self.discount_rate = float(discount_rate)
        self.reward_scale = float(reward_scale)
        self.durations = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self.integrated_rewards = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        #: How many decisions were ever added (without sub-options), and how long their options took, in s.
        self.n_decisions = 0
        self.decision_seconds = 0.0

    @property
    def bytes_per_transition(self) -> int:
        """Memory of a transition, in bytes: two observations, the option, and five numbers of four bytes."""
        arrays: list[np.ndarray] = []
        for field in vars(self).values():
            arrays.extend(field.values() if isinstance(field, dict) else [field])
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray)) // self.buffer_size

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        next_obs: np.ndarray | dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one decision of each environment, and the sub-options that it contained.

        :param infos: each with ``info["option"]`` of :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`, and
            ``info["sub_options"]`` if it hands over any; nothing is stored of environments whose option runs on
            (``info["pending"]`` of :class:`~sb3_ctco.vec_env.AsyncOptionVecEnv`)
        :raises ValueError: if that is missing, not finite, or was discounted at another rate, or if sub-options saw other
            observations than these; nothing is stored then
        """
        try:
            options = {i: info["option"] for i, info in enumerate(infos) if PENDING not in info}
        except KeyError:
            raise ValueError(
                f"{type(self).__name__} needs info['option']: wrap the environment with "
                "sb3_ctco.wrappers.OptionExecutionWrapper"
            ) from None
        durations = np.array([option["duration"] for option in options.values()])
        integrated_rewards = np.array([option["integrated_reward"] for option in options.values()])
        if not np.isfinite(integrated_rewards).all():
            raise ValueError(f"an option's integrated reward is not finite: {integrated_rewards}")
        discounts = np.array([option["discount"] for option in options.values()])
        if not np.allclose(discounts, discount(durations, self.discount_rate)):
            raise ValueError(
                f"the environment discounts an option of {durations} s by {discounts}, this buffer, at discount_rate="
                f"{self.discount_rate}, by {discount(durations, self.discount_rate)}: give both the same discount_rate"
            )
        sub_options = {
            i: _as_stored(infos[i]["sub_options"], _rows(obs, i), None if done[i] else _rows(next_obs, i))
            for i in options
            if "sub_options" in infos[i]
        }
        for i, option in options.items():
            position, row, info = self.pos, slice(i, i + 1), infos[i]
            super().add(
                _rows(obs, row),  # type: ignore[arg-type]
                _rows(next_obs, row),  # type: ignore[arg-type]
                action[row],
                reward[row],
                done[row],
                [info],
            )
            self.durations[position] = option["duration"]
            self.integrated_rewards[position] = option["integrated_reward"]
            self.n_decisions += 1
            self.decision_seconds += option["duration"]
            if i in sub_options:
                self._add_sub_options(sub_options[i])

    def _add_sub_options(self, sub_options: SubOptions) -> None:
        count = len(sub_options)
        if count == 0:
            return
        end = self.pos + count
        rows = slice(self.pos, end) if end <= self.buffer_size else np.arange(self.pos, end) % self.buffer_size
        values: Any
        for stored, values in (
            (self.observations, sub_options.observations),
            (self.next_observations, sub_options.next_observations),
        ):
            if isinstance(stored, dict):
                for key in stored:
                    stored[key][rows, 0] = values[key].reshape(count, *stored[key].shape[2:])
            else:
                # A discrete observation is a number in the environment, and an array of one here.
                stored[rows, 0] = values.reshape(count, *stored.shape[2:])
        self.actions[rows, 0] = sub_options.options
        # What primitive steps paid in sum is not kept of a sub-option; samples have R.
        self.rewards[rows, 0] = self.integrated_rewards[rows, 0] = sub_options.integrated_rewards
        self.durations[rows, 0] = sub_options.durations
        self.dones[rows, 0] = sub_options.terminated | sub_options.truncated
        self.timeouts[rows, 0] = sub_options.truncated & self.handle_timeout_termination
        self.full = self.full or end >= self.buffer_size
        self.pos = end % self.buffer_size

    def _sample_fields(self, batch_inds: np.ndarray, env: VecNormalize | None) -> dict[str, Any]:
        # ReplayBuffer._get_samples of Stable-Baselines3 2.9 has no place for further fields, so it is written anew.
        def rows(stored: np.ndarray) -> np.ndarray:
            return stored[:, 0].take(batch_inds, axis=0)  # makes the copy that to_torch would make again

        def observations(stored: Any) -> Any:
            if isinstance(stored, dict):
                obs = self._normalize_obs({key: rows(values) for key, values in stored.items()}, env)
                return {key: self._tensor(values) for key, values in obs.items()}  # type: ignore[union-attr]
            return self._tensor(self._normalize_obs(rows(stored), env))  # type: ignore[arg-type]

        dones = rows(self.dones) * (1.0 - rows(self.timeouts))
        return {
            "observations": observations(self.observations),
            "actions": self._tensor(rows(self.actions)),
            "next_observations": observations(self.next_observations),
            "dones": self._tensor(dones[:, None]),
            "rewards": self._tensor(rows(self.integrated_rewards)[:, None]) * self.reward_scale,
            "discounts": self._tensor(discount(rows(self.durations), self.discount_rate)[:, None]),
        }

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device)


def _rows(obs: Any, rows: slice | int) -> Any:
    return {key: value[rows] for key, value in obs.items()} if isinstance(obs, dict) else obs[rows]


def _as_stored(sub_options: SubOptions, first: Any, last: Any) -> SubOptions:
    """Sub-options with observations as the algorithm sees them, which they came past as part of an info.

    :param sub_options: as the environment handed them over
    :param first: the observation that the option began with, as the algorithm saw it
    :param last: likewise the one that it ended with; None at an episode's end, where a VecNormalize gives it back
        inexactly
    :raises ValueError: if what the algorithm saw is not what the sub-options saw, give or take the transposition of images
    """
    seen: Any = sub_options.seen
    if isinstance(first, dict) and isinstance(seen, dict) and first.keys() == seen.keys():
        seen = {key: _matching(seen[key], first[key], None if last is None else last[key]) for key in seen}
    elif not isinstance(first, dict) and not isinstance(seen, dict):
        seen = _matching(seen, first, last)
    else:
        raise _not_seen(_described(seen), _described(first))
    return dataclasses.replace(sub_options, seen=seen)


def _matching(seen: np.ndarray, first: np.ndarray, last: np.ndarray | None) -> np.ndarray:
    """``seen``, with its channels first if Stable-Baselines3's VecTransposeImage put them there."""
    for candidate in (seen, np.moveaxis(seen, -1, 1)) if seen.ndim == 4 else (seen,):
        ends = ((candidate[0], first),) if last is None else ((candidate[0], first), (candidate[-1], last))
        # A VecEnv converts observations to their space's type.
        if all(one.shape == np.shape(other) and (one.astype(other.dtype) == other).all() for one, other in ends):
            return candidate
    raise _not_seen(f"{seen[0]} (shape {seen.shape[1:]})", f"{first} (shape {np.shape(first)})")


def _described(obs: Any) -> str:
    return f"a dictionary of {sorted(obs)}" if isinstance(obs, dict) else f"an array of shape {np.shape(obs)}"


def _not_seen(by_sub_options: str, by_algorithm: str) -> ValueError:
    return ValueError(
        f"sub-options have observations from inside OptionExecutionWrapper, {by_sub_options}, but the algorithm observes "
        f"{by_algorithm}: put wrappers that change observations inside, OptionExecutionWrapper(ObservationWrapper(env)), "
        "or pass n_sub_options=0 (VecNormalize and VecTransposeImage may be outside)"
    )


class OptionReplayBuffer(_OptionStorage):
    """Stable-Baselines3's ``ReplayBuffer`` for options.

    Beside its fields it keeps ``durations`` (time that ran, s) and ``integrated_rewards`` (R). All have the shape
    ``[buffer_size, 1, ...]`` with one row a transition, whichever environment it is from. A sample has R, times
    ``reward_scale``, as ``rewards`` and e^(−τ·duration) as ``discounts``, which SAC and TD3 use as they are: with this buffer
    and an environment wrapped in :class:`~sb3_ctco.wrappers.OptionExecutionWrapper` they learn on the semi-Markov process.

    :param discount_rate: τ, in 1/s; the wrapper's
    :param reward_scale: what R is multiplied by in samples; ``1/step_weight(dt, discount_rate)`` gives R the unit of a reward
        of 1 over ``dt``, so that an option of one step is worth to a stock algorithm what a step is
    :raises ValueError: if ``optimize_memory_usage`` is asked for
    """

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return ReplayBufferSamples(**self._sample_fields(batch_inds, env))


class DictOptionReplayBuffer(_OptionStorage, DictReplayBuffer):  # type: ignore[misc]
    """Stable-Baselines3's ``DictReplayBuffer`` for options; see :class:`OptionReplayBuffer`."""

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        return DictReplayBufferSamples(**self._sample_fields(batch_inds, env))
