"""Options on a machine that does not wait: decided ahead of time, and interrupted when the world changes."""

import math
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from copy import deepcopy
from queue import SimpleQueue
from threading import Thread
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.env_util import unwrap_wrapper

from sb3_ctco.option_array import plain
from sb3_ctco.options import (
    INTERRUPTED,
    LAST_ACTION,
    PLAYED,
    TAKEN_OVER,
    FloatArray,
    ValueInterrupt,
    shortest_steps,
    stack,
    steps_in,
    with_last_action,
)
from sb3_ctco.wrappers.option_execution import ON_THE_WAY, OptionExecutionWrapper
from sb3_ctco.wrappers.real_time import RealTimeWrapper
from sb3_ctco.wrappers.step_sequence import SequenceResult, StepSequence

#: ``interrupt(observation of the last decision, observation, seconds since that one)``: whether to end the option
Interrupt = Callable[[Any, Any, float], bool]


class _Player:
    """A thread that plays the rests of options.

    It is a daemon, which an executor's is not: if it waits for a machine that says nothing, Python can end all the same.
    """

    def __init__(self) -> None:
        self._queue: SimpleQueue[Any] = SimpleQueue()
        self._is_running = False
        weakref.finalize(self, self._queue.put, None)

    def play(self, future: "Future[Any]", function: Callable[..., Any], *args: Any) -> None:
        if not self._is_running:
            self._is_running = True
            Thread(target=_work, args=(self._queue,), name="option", daemon=True).start()
        self._queue.put((future, function, args))

    def stop(self) -> None:
        self._queue.put(None)
        self._is_running = False


def _work(queue: "SimpleQueue[Any]") -> None:
    while (item := queue.get()) is not None:
        future, function, args = item
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(function(*args))
            except BaseException as error:
                future.set_exception(error)
        del item, future, function, args  # which hold the environment


class RealTimeOptionWrapper(OptionExecutionWrapper):
    """An :class:`OptionExecutionWrapper` that hides the policy's latency, and that can break an option off.

    With ``decide_ahead``, a ``step`` returns that long before its option ends, and the rest of the option plays while
    the next one is decided on: in a thread of its own with ``background``, otherwise at the beginning of the next
    ``step``, which is the same to a simulation. A transition is what happened between two decisions: the rest of the
    option before, then the new one without its rest. Its duration and rewards are exactly those of that time, so
    nothing is counted twice or late; but the state at a decision does not tell which rest is still to play. The policy
    sees the state of ``decide_ahead`` seconds before its option begins, and the process is a semi-Markov process only
    as far as that does not matter. The first option of an episode begins at once. Unless the join is free, an option leaves
    from the end of that rest, and the observation holds the action there: what is commanded, since a guard has not limited it
    yet.

    With ``interrupt``, a function that is called after each primitive step, an option ends as soon as it says so; or as soon
    as a :class:`~sb3_ctco.options.ValueInterrupt` does, which is asked every ``check_period`` and told the rest of the plan.
    The transition has the time that ran, and ``info["option_played"]`` is the option that plays what was played, as which CTCO
    stores it (not with ``decide_ahead``, where a transition consists of parts of two options). ``info["interrupted"]`` of the
    environment inside ends it as well.

    An option that is not finite, of a policy that has diverged, is no error where commands are guarded
    (:class:`~sb3_ctco.wrappers.RealTimeWrapper`): the safe action is sent, and the next decision follows.

    :param env: the environment to wrap
    :param decide_ahead: in s; rounded to whole steps
    :param interrupt: called as ``interrupt(observation of the last decision, observation, seconds since that one)``; or a
        :class:`~sb3_ctco.options.ValueInterrupt`
    :param background: whether the rest of an option plays in a thread of its own, which is for environments that the
        wall clock governs and that may be stepped from another thread (one that renders may not)
    :param kwargs: see :class:`OptionExecutionWrapper`
    :raises ValueError: if ``decide_ahead`` is negative or not shorter than the longest option, or for a ValueInterrupt with
        ``decide_ahead``
    """

    def __init__(
        self,
        env: gym.Env,
        decide_ahead: float = 0.0,
        interrupt: Interrupt | ValueInterrupt | None = None,
        background: bool = False,
        **kwargs: Any,
    ):
        RecordConstructorArgs.__init__(
            self, decide_ahead=decide_ahead, interrupt=interrupt, background=background, _disable_deepcopy=True, **kwargs
        )
        super().__init__(env, **kwargs)
        if not 0.0 <= decide_ahead < self.option_space.d_max:
            raise ValueError(
                f"decide_ahead must be at least 0 s and less than d_max={self.option_space.d_max} s, not {decide_ahead}"
            )
        self._ahead_steps = round(decide_ahead / self.option_space.dt)
        self._player = _Player() if background else None
        self._rest: np.ndarray | None = None
        self._commands: list[np.ndarray] = []
        #: What was sent, and before it the last two actions that were sent before
        self._sent: list[np.ndarray] = []
        self._playing_rest: Future[SequenceResult] | None = None
        self._abandoned = False
        self._decided_on: Any = None
        self._play: StepSequence | None = None
        self.interrupt = interrupt
        real_time = unwrap_wrapper(env, RealTimeWrapper)
        if isinstance(real_time, RealTimeWrapper) and not math.isclose(real_time.dt, self.option_space.dt, rel_tol=1e-6):
            raise ValueError(
                f"the RealTimeWrapper inside has dt={real_time.dt} s, and options here have dt={self.option_space.dt} s, so "
                f"that they would take another time than they say: pass dt={real_time.dt}, at which they last as long"
            )
        self._is_guarded = isinstance(real_time, RealTimeWrapper) and real_time.guard is not None
        self._is_lost = False

    @property
    def interrupt(self) -> Interrupt | ValueInterrupt | None:
        """What ends an option early; may be set between two steps."""
        return self._interrupt

    @interrupt.setter
    def interrupt(self, interrupt: Interrupt | ValueInterrupt | None) -> None:
        self._interrupt = interrupt
        #: What a ValueInterrupt's period is in steps
        self._check_steps: int | None = None
        if isinstance(interrupt, ValueInterrupt):
            if self._ahead_steps:
                raise ValueError(
                    "a ValueInterrupt compares the rest of an option with the next one, which is decided on already with "
                    "decide_ahead: pass decide_ahead=0, or a rule about observations"
                )
            self._check_steps = steps_in(interrupt.check_period, self.option_space.dt)

    @classmethod
    def like(
        cls,
        wrapper: OptionExecutionWrapper,
        decide_ahead: float,
        interrupt: Interrupt | ValueInterrupt | None,
        background: bool,
    ) -> "RealTimeOptionWrapper":
        """The same wrapper around the same environment, with what this class adds."""
        return cls(
            wrapper.env,
            decide_ahead,
            interrupt,
            background,
            **wrapper.option_space.arguments,
            reward=wrapper.reward,
            reward_unit=wrapper.reward_unit,
            n_sub_options=wrapper.n_sub_options,
            sub_option_tolerance=wrapper.sub_option_tolerance,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the inner environment."""
        self.abandon()
        self._abandoned = False
        result = super().reset(seed=seed, options=options)
        self._commands = []
        self._sent = list(self._box.actions(self._last_two))
        self._decided_on = deepcopy(self._last_obs)
        return result

    def step(self, action: npt.ArrayLike) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Play one option, or what is due of it and of the one before."""
        option: FloatArray = np.asarray(plain(action), dtype=np.float64)
        self._is_lost = self._is_guarded and not np.isfinite(option).all()
        before = self._before
        # In place of one that is lost the shortest one, whose actions the guard replaces.
        result = super().step(np.full_like(option, -1.0) if self._is_lost else option)
        self.played = self._played
        info = result[4]
        if self._is_lost:
            info[TAKEN_OVER] = True
        elif info.get(INTERRUPTED, False) and not self._ahead_steps:
            # What is shorter than any option is played by none: it stays the beginning of the one that was asked for.
            option, residual = self.option_space.closest(self._box.normalise(self.played), before)
            if residual <= self.sub_option_tolerance and len(self.played) >= shortest_steps(self.option_space):
                info[PLAYED] = option
        return result

    def _choose_play(self) -> StepSequence:
        return self._play_around_decisions

    def abandon(self, timeout: float | None = None) -> bool:
        """Stop playing, at the next primitive step; needs a reset then.

        :param timeout: for how long to wait for the step that is being made in the background, in s; None for its end
        :return: whether nothing is played any more
        """
        self._abandoned = True
        self._play = None
        self._rest = None
        # Whatever it raised is of no interest any more.
        rest = self._playing_rest
        has_ended = rest is None or rest.cancel() or not wait([rest], timeout).not_done
        if has_ended:
            self._playing_rest = None
        return has_ended

    def close(self) -> None:
        """Stop playing and close the environment."""
        self.abandon()
        if self._player is not None:
            self._player.stop()
        super().close()

    def _draw_stretches(self, n_steps: int) -> list[tuple[int, int]]:
        # An option that begins at once, or after another time, tells nothing of options that are decided on so much ahead.
        n_rest = 0 if self._rest is None else len(self._rest)
        return super()._draw_stretches(n_steps) if n_rest == self._ahead_steps <= n_steps else []

    def _play_around_decisions(self, plan: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        rest = self._finish_rest()
        if self._is_lost:
            plan = np.full_like(plan[:1], np.nan)
        # Something must happen between two decisions, and what is lost is not for later.
        n_now = max(len(plan) - self._ahead_steps, 1 if rest is None or self._is_lost else 0)
        over = rest is not None and (rest[2] or rest[3] or rest[4].get(INTERRUPTED, False))
        if rest is not None and (over or n_now == 0):
            result = rest
        else:
            result = self._play_until_interrupted(plan[:n_now], 0 if rest is None else len(rest[1]))  # type: ignore[arg-type]
            if rest is not None:
                result[4][ON_THE_WAY] = [*rest[4][ON_THE_WAY], *result[4][ON_THE_WAY]]
                result = (result[0], [*rest[1], *result[1]], *result[2:])  # type: ignore[misc]
            over = result[2] or result[3] or result[4].get(INTERRUPTED, False)
        # The environment may return the same array once more.
        self._decided_on = deepcopy(result[0])
        self._played, self._commands = np.array(self._commands), []
        # A sub-option that was decided on after k steps of this time would play as this option does from its step k on.
        on_the_way, n_ran = result[4][ON_THE_WAY], len(np.asarray(result[1]))
        seen = [on_the_way[k - 1] for k in observe if k < n_ran]
        sent, self._sent = self._sent[2:], self._sent[-2:]
        if self._ahead_steps:
            # It would leave from an action that was still to be sent then, as the next option does, unless there is no rest.
            sent = [*plan, *self._sent] if over or n_now == len(plan) else list(plan)
        result[4][ON_THE_WAY] = seen, sent
        if not over and n_now < len(plan):
            self._rest = plan[n_now:]
            if self._player is not None:
                # The environment may write into its array while the thread steps it.
                result = (deepcopy(result[0]), *result[1:])
                # Known before it begins, so that who abandons does not miss it.
                self._playing_rest = Future()
                self._player.play(self._playing_rest, self._play_until_interrupted, self._rest)
        return result

    def _finish_rest(self) -> SequenceResult | None:
        rest = self._rest
        if self._playing_rest is not None:
            # While this waits, who abandons must find it, and wait as well.
            result = self._playing_rest.result()
            self._playing_rest = self._rest = None
            return result
        self._rest = None
        return None if rest is None else self._play_until_interrupted(rest)

    def _play_until_interrupted(self, actions: np.ndarray, steps_before: int = 0) -> SequenceResult:
        rewards: list[Any] = []
        on_the_way = []
        for action in actions:
            if self._abandoned:
                raise ResetNeeded("playing was abandoned: call reset() first")
            self._commands.append(action)
            obs, reward, terminated, truncated, info = self.env.step(action)
            rewards.append(deepcopy(reward))
            self._sent.append(np.array(info.get(LAST_ACTION, action), np.float64))
            if self.n_sub_options:
                # All of them, because those of a rest are chosen after it.
                on_the_way.append(deepcopy(obs))
            if terminated or truncated or info.get(INTERRUPTED):
                break
            if self._interrupt is not None and self._is_interrupted(obs, actions, len(rewards), steps_before):
                info = {**info, INTERRUPTED: True}
                break
        return obs, rewards, terminated, truncated, {**info, ON_THE_WAY: on_the_way}

    def _is_interrupted(self, obs: Any, actions: np.ndarray, n_ran: int, steps_before: int) -> bool:
        if self._check_steps is None:
            assert callable(self._interrupt)
            return self._interrupt(self._decided_on, obs, (steps_before + n_ran) * self.option_space.dt)
        if n_ran % self._check_steps or len(actions) - n_ran < shortest_steps(self.option_space):
            return False
        assert isinstance(self._interrupt, ValueInterrupt)
        before = None
        if self.option_space.joined:
            before = self.option_space.before(self._box.normalise(self._sent[-2:]).clip(-1.0, 1.0))[0]
            obs = with_last_action(self.observation_space, obs, before)
        rest, _ = self.option_space.closest(self._box.normalise(actions[n_ran:]), before)
        return bool(self._interrupt.worth_ending(stack([obs]), rest[None])[0])
