"""Replay buffers for options: Stable-Baselines3's, extended by the duration and the integrated reward of a decision."""

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_ctco.options import (
    DEFAULT_DISCOUNT_RATE,
    PENDING,
    REWARD_UNITS,
    TAKEN_OVER,
    ActionBox,
    OptionSpace,
    RewardUnit,
    Stacked,
    SubOptions,
    check_seconds,
    discount,
    fit_sub_options,
    rows_of,
    shortest_steps,
    with_last_action,
)


def refuse_normalised_rewards(env: VecNormalize | None) -> None:
    """Options have rewards of their own, which VecNormalize does not know.

    :raises ValueError: if it normalises rewards
    """
    if env is not None and env.norm_reward:
        raise ValueError(
            "VecNormalize counts its returns per decision, whatever time a decision takes: pass norm_reward=False"
        )


class AddedTrajectory(NamedTuple):
    """What became of a recorded trajectory, see :meth:`OptionReplayBuffer.add_trajectory`.

    :param added: how many of its stretches were stored as options
    :param refused: how many were not, because no option plays their actions within the tolerance
    :param largest_residual: the largest deviation of a stored option's actions from those that were recorded, normalised
    """

    added: int
    refused: int
    largest_residual: float


class _OptionStorage(ReplayBuffer):
    """What the two option buffers add to their Stable-Baselines3 base."""

    #: Of buffers that were saved without these
    reward_scale: float | Literal["auto"] = 1.0
    demonstration_fraction = 0.25
    n_demonstrations = 0
    option_space: OptionSpace | None = None
    primitive_action_space: spaces.Box | None = None
    #: That of the model's environment; None where no model told
    reward_unit: RewardUnit | None = None

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
        reward_scale: float | Literal["auto"] = 1.0,
        demonstration_fraction: float = 0.25,
        option_space: OptionSpace | None = None,
        primitive_action_space: spaces.Box | None = None,
    ):
        if not 0.0 <= demonstration_fraction <= 1.0:
            raise ValueError(f"demonstration_fraction must be a part of each batch, in [0, 1], not {demonstration_fraction}")
        if reward_scale != "auto" and not (isinstance(reward_scale, int | float | np.number) and 0 < reward_scale < math.inf):
            raise ValueError(f"reward_scale must be a positive number or 'auto', not {reward_scale!r}")
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
        self.reward_scale: float | Literal["auto"] = "auto" if reward_scale == "auto" else float(reward_scale)
        self.demonstration_fraction = float(demonstration_fraction)
        self.option_space = option_space
        self.primitive_action_space = primitive_action_space
        #: How many options of recorded trajectories there are: the last rows, which nothing overwrites
        self.n_demonstrations = 0
        self.durations = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        self.integrated_rewards = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)
        #: How many decisions were ever added (without sub-options), and how long their options took, in s.
        self.n_decisions = 0
        self.decision_seconds = 0.0
        self._paid = self._paid_seconds = 0.0

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if "_paid" not in state:  # saved without; rows that nothing was written to count nothing
            self._paid = self._paid_seconds = 0.0
            self._count_paid(self.integrated_rewards, self.durations)

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
            (``info["option_pending"]`` of :class:`~sb3_ctco.vec_env.AsyncOptionVecEnv`), or where something else was sent
            than the policy's actions (``info["taken_over"]``, of a guard or of :class:`~sb3_ctco.wrappers.TakeOverWrapper`)
        :raises ValueError: if that is missing, not finite, or was discounted at another rate, or if sub-options saw other
            observations than these; nothing is stored then
        """
        try:
            options = {i: info["option"] for i, info in enumerate(infos) if PENDING not in info and not info.get(TAKEN_OVER)}
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
            i: _as_stored(infos[i]["sub_options"], rows_of(obs, i), None if done[i] else rows_of(next_obs, i))
            for i in options
            if "sub_options" in infos[i]
        }
        for i, option in options.items():
            position, row, info = self.pos, slice(i, i + 1), infos[i]
            super().add(
                rows_of(obs, row),  # type: ignore[arg-type]
                rows_of(next_obs, row),  # type: ignore[arg-type]
                action[row],
                reward[row],
                done[row],
                [info],
            )
            self.durations[position] = option["duration"]
            self.integrated_rewards[position] = option["integrated_reward"]
            self._move_to(position + 1)
            self.n_decisions += 1
            self.decision_seconds += option["duration"]
            self._count_paid(self.integrated_rewards[position], self.durations[position])
            if i in sub_options:
                self._add_sub_options(sub_options[i])

    def add_trajectory(
        self,
        observations: Stacked,
        actions: np.ndarray,
        rewards: np.ndarray,
        terminated: bool,
        truncated: bool,
        dt: float,
        *,
        n_stretches: int = 1,
        tolerance: float = 0.1,
        reward_unit: RewardUnit | None = None,
    ) -> AddedTrajectory:
        """Store stretches of a trajectory of primitive actions, whoever chose them, as options.

        From each of its steps on, random stretches of d_min to d_max, and at most to its end, are fitted as sub-options are
        (:func:`~sb3_ctco.options.fit_sub_options`). They are demonstrations: nothing overwrites them, and
        ``demonstration_fraction`` of each batch is drawn from them. Nothing is stored if anything is wrong.

        Options are in seconds, so the trajectory may have been recorded at another rate than the environment's. A stretch
        is of whole recorded steps: where these are longer than d_min, no option is shorter than one of them. Unless joins are
        free, a stretch leaves from the action before it, which is put into the observations here; the first leaves from the
        middle of the box, at rest.

        :param observations: ``[n + 1, *observation_shape]``, in the end the one after the last action; or a dictionary of such
        :param actions: in the units of the environment, ``[n, *action_shape]``
        :param rewards: ``[n]``
        :param terminated: whether the episode terminated with the last action
        :param truncated: whether it was truncated with it
        :param dt: time from one action to the next, in s
        :param n_stretches: how many begin at each step; those that would be too short at its end are left out
        :param tolerance: refuse a stretch if its option's actions deviate by more from those recorded; actions count as
            normalised to [−1, 1]. Noisy actions of a fixed rate fit no option of more than n_rbf steps well
        :param reward_unit: ``"rate"`` or ``"impulse"``, see :func:`~sb3_ctco.options.integrated_reward`; by default what the
            model's environment has
        :raises ValueError: if a number is out of range or not finite, a shape is wrong, ``dt`` fits no option, the buffer
            does not know what options mean, or its rows do not suffice
        """
        if self.option_space is None or self.primitive_action_space is None:
            raise ValueError(
                "this buffer does not know what options mean: add to the replay_buffer of a model that has an environment, or "
                f"pass option_space and primitive_action_space (of OptionExecutionWrapper) to {type(self).__name__}"
            )
        check_seconds(dt=dt)
        reward_unit = reward_unit or self.reward_unit or "rate"
        if n_stretches < 1 or not tolerance >= 0 or reward_unit not in REWARD_UNITS:
            raise ValueError(
                f"n_stretches must be at least 1, tolerance at least 0, and reward_unit one of {REWARD_UNITS}, not "
                f"{n_stretches}, {tolerance} and {reward_unit!r}"
            )
        space = dataclasses.replace(self.option_space, dt=dt)
        shortest, longest = shortest_steps(space), math.floor(space.d_max / dt + 1e-6)
        if longest < shortest:
            raise ValueError(
                f"no whole number of steps of dt={dt} s is as long as an option, {space.d_min} to {space.d_max} s: record at "
                "a higher rate, or use a model with a larger d_max"
            )
        rewards = np.asarray(rewards, dtype=np.float64)
        plan = ActionBox(self.primitive_action_space.low, self.primitive_action_space.high).normalise(actions)
        _check_recorded(observations, plan, rewards)
        sent = None
        if space.joined:
            # As an episode begins: with the middle of the box
            sent = space.before(np.vstack([np.zeros((2, plan.shape[1])), plan]))
            observations = with_last_action(self.observation_space, observations, sent)
        seen = _recorded(observations, self.observation_space)

        n_steps = len(rewards)
        firsts = np.arange(n_steps).repeat(n_stretches)
        ends = np.minimum(firsts + np.random.randint(shortest, longest + 1, len(firsts)), n_steps)
        long_enough = ends - firsts >= shortest
        firsts, ends = firsts[long_enough], ends[long_enough]
        parts = []
        # In windows, since R is computed from rewards that are discounted from a window's beginning.
        for first, end in ((k, min(k + 2 * longest, n_steps)) for k in range(0, n_steps, longest)):
            begun = slice(*firsts.searchsorted([first, first + longest]))
            stretches = list(zip((firsts[begun] - first).tolist(), (ends[begun] - first).tolist(), strict=True))
            window, rows = slice(first, end), slice(first, end + 1)
            played = (plan[window], rewards[window], stretches, list(range(end - first + 1)), rows_of(seen, rows))
            ended = (terminated and end == n_steps, truncated and end == n_steps)
            before = None if sent is None else sent[rows]
            parts.append(fit_sub_options(space, *played, *ended, reward_unit, tolerance, before))
        added = sum(map(len, parts))
        if self.n_demonstrations + added >= self.buffer_size:
            raise ValueError(
                f"{added} options of this trajectory and {self.n_demonstrations} that are there leave no row for what the "
                f"policy does: buffer_size={self.buffer_size} must be larger, or n_stretches={n_stretches} smaller"
            )
        for part in parts:
            self.n_demonstrations += len(part)
            row = self.buffer_size - self.n_demonstrations
            self._write(slice(row, row + len(part)), part)
        self._move_to(self.pos)
        residuals = np.concatenate([part.residuals for part in parts])
        return AddedTrajectory(added, len(firsts) - added, float(residuals.max(initial=0.0)))

    def size(self) -> int:
        """How many transitions there are, demonstrations included."""
        return self._n_experienced + self.n_demonstrations

    @property
    def mean_reward_rate(self) -> float:
        """Mean abs(R) by mean duration, of the last decisions that paid anything, in the unit of rewards.

        What was paid fades over 100 horizons 1/τ of such decisions, 250 s with the paper's discount. Before any, it is that of
        the demonstrations that paid anything, and 1 without.
        """
        if self._paid_seconds:
            return self._paid / self._paid_seconds
        rows = slice(self.buffer_size - self.n_demonstrations, None)
        paid, seconds = np.abs(self.integrated_rewards[rows]), self.durations[rows]
        return float(paid.sum() / seconds[paid > 0].sum()) if paid.any() else 1.0

    def _count_paid(self, integrated_rewards: np.ndarray, durations: np.ndarray) -> None:
        seconds = float(np.sum(durations[integrated_rewards != 0]))
        # Without a discount, a horizon is 100 s.
        kept = math.exp(-seconds * max(self.discount_rate, 0.01) / 100.0)
        self._paid = kept * self._paid + float(np.abs(integrated_rewards).sum())
        self._paid_seconds = kept * self._paid_seconds + seconds

    @property
    def _n_experienced(self) -> int:
        """Rows of what the policy did, the first ones."""
        return self.buffer_size - self.n_demonstrations if self.full else self.pos

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Stable-Baselines3's ``sample``, with ``demonstration_fraction`` of the batch from demonstrations, if there are any.

        :param batch_size: number of transitions
        :param env: normalises observations
        """
        if not self.n_demonstrations:
            return super().sample(batch_size, env)
        first = self.buffer_size - self.n_demonstrations
        count = round(self.demonstration_fraction * batch_size) if self._n_experienced else batch_size
        demonstrated = np.random.randint(first, self.buffer_size, count)
        experienced = np.random.randint(0, max(self._n_experienced, 1), batch_size - count)
        return self._get_samples(np.concatenate([demonstrated, experienced]), env)

    def _move_to(self, position: int) -> None:
        """Where the next transition goes, at the ring's beginning again after its end."""
        n_rows = self.buffer_size - self.n_demonstrations
        self.full = self.full or position >= n_rows
        self.pos = position % n_rows

    def _add_sub_options(self, sub_options: SubOptions) -> None:
        end, n_rows = self.pos + len(sub_options), self.buffer_size - self.n_demonstrations
        self._write(slice(self.pos, end) if end <= n_rows else np.arange(self.pos, end) % n_rows, sub_options)
        self._move_to(end)

    def _write(self, rows: slice | np.ndarray, sub_options: SubOptions) -> None:
        count = len(sub_options)
        if count == 0:
            return
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
        # Both flags are set where the last step that is allowed ends the episode: that is an end.
        self.timeouts[rows, 0] = sub_options.truncated & ~sub_options.terminated & self.handle_timeout_termination

    def _sample_fields(self, batch_inds: np.ndarray, env: VecNormalize | None) -> dict[str, Any]:
        refuse_normalised_rewards(env)

        # ReplayBuffer._get_samples of Stable-Baselines3 2.9 has no place for further fields, so it is written anew.
        def rows(stored: np.ndarray) -> np.ndarray:
            return stored[:, 0].take(batch_inds, axis=0)  # makes the copy that to_torch would make again

        def observations(stored: Any) -> Any:
            if isinstance(stored, dict):
                obs = self._normalize_obs({key: rows(values) for key, values in stored.items()}, env)
                return {key: self._tensor(values) for key, values in obs.items()}  # type: ignore[union-attr]
            return self._tensor(self._normalize_obs(rows(stored), env))  # type: ignore[arg-type]

        dones = rows(self.dones) * (1.0 - rows(self.timeouts))
        rewards = rows(self.integrated_rewards)[:, None]
        return {
            "observations": observations(self.observations),
            "actions": self._tensor(rows(self.actions)),
            "next_observations": observations(self.next_observations),
            "dones": self._tensor(dones[:, None]),
            "rewards": self._tensor(rewards) * self.found_reward_scale(),
            "discounts": self._tensor(discount(rows(self.durations), self.discount_rate)[:, None]),
        }

    def found_reward_scale(self) -> float:
        """What R is multiplied by in samples; ``"auto"`` is found now, if anything was paid yet, and 1 until then."""
        if self.reward_scale != "auto":
            return self.reward_scale
        paid = self.integrated_rewards != 0
        if not paid.any():
            return 1.0  # To nothing every scale is the same.
        # Without a discount, forever is 100 s.
        forever = np.abs(self.integrated_rewards[paid]) / -np.expm1(-max(self.discount_rate, 0.01) * self.durations[paid])
        self.reward_scale = 100.0 / float(forever.max())
        return self.reward_scale

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device)


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


def _recorded(observations: Any, space: spaces.Space) -> Stacked:
    """Recorded observations, stacked, as a buffer for this space stores them.

    :raises ValueError: if they have other shapes, or are not finite
    """
    if isinstance(space, spaces.Dict):
        if not isinstance(observations, dict) or observations.keys() != space.spaces.keys():
            raise ValueError(f"observations must be a dictionary of {sorted(space.spaces)}, not {_described(observations)}")
        return {key: _recorded(observations[key], inner) for key, inner in space.spaces.items()}  # type: ignore[misc]
    stacked = np.asarray(observations)
    if stacked.ndim == 4 and stacked.shape[1:] != space.shape:
        stacked = np.moveaxis(stacked, -1, 1)  # pictures as they are recorded, where VecTransposeImage turns them
    if stacked.shape[1:] != space.shape:
        raise ValueError(f"observations must have shape [n + 1, *{space.shape}], not {np.shape(observations)}")
    if not np.isfinite(stacked).all():
        raise ValueError("observations must be finite, and these are not: leave out the steps where a sensor failed")
    return stacked


def _check_recorded(observations: Any, plan: np.ndarray, rewards: np.ndarray) -> None:
    """Refuse a recorded trajectory whose parts do not fit together.

    :param observations: as they are given, whatever their shape
    :param plan: actions, normalised, ``[n, action_dim]``
    """
    leaves = observations.values() if isinstance(observations, dict) else [observations]
    n_seen = {len(np.atleast_1d(leaf)) for leaf in leaves}
    if rewards.ndim != 1 or len(rewards) == 0 or len(plan) != len(rewards) or n_seen != {len(rewards) + 1}:
        raise ValueError(
            f"a trajectory has n actions, n rewards and n + 1 observations, the last one of after the last action, not "
            f"{len(plan)} actions, rewards of shape {rewards.shape} and {sorted(n_seen)} observations"
        )
    if not np.isfinite(rewards).all():
        raise ValueError(f"rewards must be finite, not {rewards}")
    # Single precision rounds past a bound.
    if not (np.abs(plan) <= 1.0 + 1e-4).all():
        raise ValueError(
            f"actions must be finite and within the environment's bounds, and normalised to [−1, 1] by these they go from "
            f"{plan.min()} to {plan.max()}: convert their units, clip them, or widen the bounds"
        )


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
    :param reward_scale: what R is multiplied by in samples. ``"auto"`` finds it at the first sample after something was
        paid, and keeps it: the best (or worst) option so far, R/(1 − γ(d)) if it were repeated forever, is worth 100. That
        does not depend on the unit of rewards, and it is what a reward of 1 a step is worth to SAC with its usual discount
        of 0.99
    :param demonstration_fraction: part of each batch that is drawn from what ``add_trajectory`` stored, if that is anything
    :param option_space: what options mean, for ``add_trajectory``; CTCO and FiGAR-SAC tell their buffer
    :param primitive_action_space: the action space of the bare environment, likewise
    :raises ValueError: for a number out of range, or if ``optimize_memory_usage`` is asked for
    """

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return ReplayBufferSamples(**self._sample_fields(batch_inds, env))


class DictOptionReplayBuffer(_OptionStorage, DictReplayBuffer):  # type: ignore[misc]
    """Stable-Baselines3's ``DictReplayBuffer`` for options; see :class:`OptionReplayBuffer`."""

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        return DictReplayBufferSamples(**self._sample_fields(batch_inds, env))
