"""Run a trained policy in a control loop: an observation in, an action of the bare environment or robot out."""

import json
import logging
import math
import pickle
import sys
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_ctco.exported import Observation, OnnxPolicy
from sb3_ctco.options import (
    OBSERVATION,
    ActionBox,
    OptionSpace,
    ValueInterrupt,
    check_seconds,
    is_finite,
    shortest_steps,
    stack,
    steps_in,
    with_last_action,
)
from sb3_ctco.safety import Guard, Safety

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm

logger = logging.getLogger(__name__)

_NOW_OR_NEVER = "give now at each tick or at none; to change, call reset() in between"


class OptionPolicy(Protocol):
    """What :class:`OptionController` needs of a policy: a function from observations to options, and their meaning.

    Unless the join is free, observations hold what an option leaves from, and the space that they are then in is
    ``observation_space``.
    """

    option_space: OptionSpace
    primitive_action_space: spaces.Box
    observation_space: spaces.Space

    def __call__(self, observation: Observation) -> np.ndarray:
        """Options for one observation, shape ``[option_dim]``, or for several, ``[n, option_dim]``."""


class ModelPolicy:
    """The policy of a trained model as an :class:`OptionPolicy`.

    :param model: a trained model that decides by options, for instance CTCO
    :param deterministic: whether to act greedily
    :param vec_normalize: normalises observations as in training, if training did; by default the one around the
        environment that the model has
    :raises TypeError: if the model does not decide by options
    :raises ValueError: if the model never had an environment
    """

    def __init__(
        self,
        model: "OptionOffPolicyAlgorithm",
        deterministic: bool = True,
        vec_normalize: "VecNormalize | None" = None,
    ):
        if not hasattr(model, "primitive_action_space"):
            raise TypeError(
                f"OptionController needs a model that decides by options, such as CTCO, not {type(model).__name__}: "
                "a model of fixed rate has its action from model.predict"
            )
        if model.primitive_action_space is None:
            raise ValueError(
                f"this {type(model).__name__} never had an environment, so the bounds of its actions are not known: "
                "call set_env(env) before, and save the model after that"
            )
        self.option_space = model.option_space
        self.primitive_action_space = model.primitive_action_space
        self.observation_space = model.observation_space
        self.deterministic = deterministic
        self.vec_normalize = model.get_vec_normalize_env() if vec_normalize is None else vec_normalize
        self.model = model

    def __call__(self, observation: Observation) -> np.ndarray:
        """Options for one or several observations."""
        if self.vec_normalize is not None:
            observation = self.vec_normalize.normalize_obs(observation)
        return np.asarray(self.model.predict(observation, deterministic=self.deterministic)[0])


@dataclass(slots=True)
class _Execution:
    """An option in execution, or none yet (``n_steps`` of 0).

    :param n_steps: after how many it is time to decide
    :param plan: its actions at a fixed rate
    :param weights: ω in the units of the actions, ``[n_before + n_rbf, action_dim]``, if they come by a clock; unless the join
        is free, the points that are given are the first
    :param sent: the actions of the last two ticks, ``[2, *action_shape]``; at a fixed rate, of those before ``_rows``
    :param tick: how many of its ticks have passed
    :param start: when it began, by the caller's clock, in s
    :param checked: after how many steps a ValueInterrupt was asked
    """

    option: np.ndarray
    n_steps: int
    plan: np.ndarray
    weights: np.ndarray
    sent: np.ndarray
    tick: int = 0
    start: float = 0.0
    checked: int = 0


class OptionController:
    """A trained policy as a controller: called once a control tick, it returns the action to apply until the next.

    It holds the option that runs, ω and d, and asks the policy for the next one when that has run out. Between two
    decisions a tick at a fixed rate reads an action from memory and allocates nothing; the observation is not looked at,
    unless an ``interrupt`` is asked. Who gets an action may keep it: it is written once, when its option is decided on. The
    worst tick is one that decides (``benchmarks/controller.py`` measures both).

    Ticks come either at a fixed rate, ``controller(obs)`` every ``dt`` seconds, where ``dt`` may be another than in
    training; or whenever they come, ``controller(obs, now=t)`` with a clock of your own, in s. An option's duration is
    rounded to whole ``dt`` in both cases, as in :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`; with a clock the
    option ends with the tick that is nearest to its end.

    Several robots are driven at once by observations with a leading axis: each has an option of its own, and the
    policy is asked about those whose option has run out.

    Ticks by a clock are real time, and guarded (:class:`~sb3_ctco.safety.Safety`): changes of actions are limited, and the
    safe action takes their place while there is no fresh observation, or when the policy fails, by an exception or by
    numbers that are not finite. That is counted in ``replaced`` and logged, and no exception reaches the loop. Without a new
    observation pass None. Ticks every ``dt`` are a simulation's, and are not guarded. Unless joins are free, an option leaves
    from what was really sent.

    Example:
        >>> import gymnasium as gym
        >>> from sb3_ctco import CTCO, OptionController
        >>> env = gym.make("Pendulum-v1")
        >>> controller = OptionController(CTCO("MlpPolicy", env))
        >>> obs, _ = env.reset(seed=0)
        >>> action = controller(obs)
        >>> action.shape == env.action_space.shape
        True

    :param policy: a trained model; or the path of one: ``.zip`` as saved by CTCO or FiGARSAC, or ``.onnx`` as written by
        :func:`sb3_ctco.export.export_onnx`; or an :class:`OptionPolicy`. To read a ``.zip`` may run code that is in it
    :param dt: time between two ticks, in s; training's by default
    :param deterministic: whether to act greedily; for a model, since an :class:`OptionPolicy` and an exported one act their
        own way
    :param vec_normalize: normalises observations as in training, or the path it was saved to; needed for a path to a
        ``.zip`` only, and only if training normalised observations
    :param replan_period: decide anew after so many seconds at most, whatever the option's duration; never by default
    :param interrupt: asked every ``check_period`` whether the rest of an option is worth playing, such as
        :class:`~sb3_ctco.interruption.CriticInterrupt`
    :param safety: how ticks by a clock are guarded; None for not at all
    :raises TypeError: if the model decides by no options
    :raises ValueError: if ``dt`` or ``replan_period`` is not a positive number, the file is of another kind, or
        ``deterministic`` or ``vec_normalize`` is given beside a policy that does not take it
    :raises FileNotFoundError: if there is no such file
    """

    def __init__(
        self,
        policy: "OptionOffPolicyAlgorithm | OptionPolicy | str | Path",
        dt: float | None = None,
        deterministic: bool = True,
        vec_normalize: "VecNormalize | str | Path | None" = None,
        replan_period: float | None = None,
        interrupt: ValueInterrupt | None = None,
        safety: Safety | None = Safety(),  # noqa: B008 (frozen)
    ):
        check_seconds(replan_period=replan_period)
        if not (interrupt is None or isinstance(interrupt, ValueInterrupt)):
            raise TypeError(
                f"interrupt must be a ValueInterrupt such as CriticInterrupt(model, check_period=0.05), not {interrupt!r}: "
                "to follow a rule of your own, call decide_anew()"
            )
        self.policy = _as_policy(policy, deterministic, vec_normalize)
        trained = self.policy.option_space
        #: What options mean here: training's, at this controller's ``dt``.
        self.option_space = trained if dt is None else replace(trained, dt=dt)
        self._trajectory = self.option_space.trajectory
        self._box = ActionBox(self.policy.primitive_action_space.low, self.policy.primitive_action_space.high)
        self._middle = self._box.actions(np.zeros((1, self._box.low.size)))[0]
        #: The last two actions where no option runs, ``[n or 1, 2, *action_shape]``; None if they are not known
        self._first: np.ndarray | None = None
        self._longest = sys.maxsize if replan_period is None else steps_in(replan_period, self.dt)
        self._interrupt = interrupt
        self._check_steps = sys.maxsize if interrupt is None else steps_in(interrupt.check_period, self.dt)
        self._executions: list[_Execution] = []
        self._several = False
        #: The time between two ticks by a clock, on average of the latest ten or so, in s; of the first ones ``dt``
        self._usual_tick = self.dt
        self._now: float | None = None
        #: Actions of the ticks up to the next decision or check, and which of them is next
        self._rows: list[np.ndarray] = []
        self._next = 0
        self.safety = safety
        self._guard: Guard | None = None
        self._observed_at = -math.inf
        self._sent_at: float | None = None
        #: How many ticks by a clock sent the safe action, by reason
        self.replaced: Counter[str] = Counter()

    @property
    def dt(self) -> float:
        """Time between two ticks, in s."""
        return self.option_space.dt

    def reset(
        self, which: Sequence[int] | npt.NDArray[Any] | None = None, last_action: npt.NDArray[Any] | None = None
    ) -> None:
        """Forget the options that run, so that the next tick decides anew: at the start of each episode.

        :param which: with several observations, those to reset: their indices or a mask; all of them by default
        :param last_action: the action that is being sent, of one or of each of those, from which the first option leaves
            unless the join is free, and changes by a clock are limited; by default options leave from the middle of the box,
            as in training, and changes go on being limited from what was sent, or after a reset of all from any action
        :raises ValueError: for the last action of some robots before the first tick: how many there are is not known
        """
        shape, first = self._box.low.shape, None
        if last_action is not None:
            actions = np.asarray(last_action, self._box.low.dtype).reshape(-1, *shape)
            first = np.stack([actions, actions], axis=1)
        # What was told of one may be of any number of them.
        n = len(self._executions) or (0 if self._first is None or len(self._first) == 1 else len(self._first))
        if which is not None and first is not None and n == 0:
            raise ValueError("before the first tick pass the last action of all robots, [n, *action_shape], and no which")
        self.decide_anew(which)
        if which is None:
            self._executions = []
            self._first = first
            self._now = self._sent_at = self._guard = None
            self._observed_at = -math.inf
            return
        if n == 0:
            return
        rows = np.atleast_1d(np.arange(n)[np.asarray(which)])
        firsts = np.broadcast_to(self._middle if first is None else first, (len(rows), 2, *shape))
        for i, execution in enumerate(self._chosen(which)):
            execution.sent = firsts[i]
        if not self._executions:  # while the safe action is sent
            self._first = np.array(self._first)
            self._first[rows] = firsts
        if first is not None and self._guard is not None:
            several = self._guard.low.ndim > len(shape)
            self._guard.restart(rows if several else ..., firsts[:, 1] if several else firsts[0, 1])

    def decide_anew(self, which: Sequence[int] | npt.NDArray[Any] | None = None) -> None:
        """Break the options off that run: the next tick decides anew, on from what is being sent.

        :param which: with several observations, those whose options to break off; all of them by default
        """
        self._leave_rows()
        for execution in self._chosen(which):
            execution.n_steps = 0

    def _chosen(self, which: Sequence[int] | npt.NDArray[Any] | None) -> list[_Execution]:
        if which is None or not self._executions:
            return self._executions
        return [self._executions[i] for i in np.atleast_1d(np.arange(len(self._executions))[np.asarray(which)])]

    def _leave_rows(self) -> None:
        for actions in self._rows[max(self._next - 2, 0) : self._next]:
            self._keep_sent(actions, self.dt)
        self._rows, self._next = [], 0

    def _keep_sent(self, actions: np.ndarray, seconds: float) -> None:
        for execution, action in zip(self._executions, actions if self._several else [actions], strict=True):
            execution.sent = self._last_two(execution.sent, action, seconds)

    def _last_two(self, sent: np.ndarray, action: np.ndarray, seconds: float) -> np.ndarray:
        """The last two actions, as if they had been sent dt apart.

        :param seconds: how much later than the one before the last was sent
        """
        return np.stack([sent[1] + (action - sent[1]) * (1.0 - self.dt / (seconds or self.dt)), action])

    def __call__(
        self, observation: Observation | None, now: float | None = None, observed_at: float | None = None
    ) -> np.ndarray:
        """The action to apply from this tick to the next.

        :param observation: one observation, or several with a leading axis; by a clock also None, if there is no new one
        :param now: the time of this tick by the caller's clock, in s; None if ticks come every ``dt``
        :param observed_at: the time of the observation by that clock, in s; ``now`` by default
        :return: shape ``[*action_shape]``, or ``[n, *action_shape]`` for n observations
        :raises ValueError: if ``now`` is not finite, runs backwards, or is given at some ticks and not at others; or if
            the number of observations changes without a reset
        """
        executions = self._executions
        if executions:
            if (now is None) != (self._now is None):
                raise ValueError(_NOW_OR_NEVER)
            if self._several and observation is not None and len(_first_leaf(observation)) != len(executions):
                raise ValueError(
                    f"there are {len(_first_leaf(observation))} observations, and there were {len(executions)}: "
                    "call reset() before their number changes"
                )
        if now is not None:
            now = self._checked(now)
            if self.safety is not None:
                return self._guarded(observation, now, observed_at)
            seconds = self.dt if self._now is None else now - self._now
            actions = self._at(observation, now)
            self._keep_sent(actions, seconds)
            return actions

        if self._next == len(self._rows):
            self._leave_rows()
            due = [i for i, e in enumerate(executions) if e.tick >= e.n_steps]
            self._renew(observation, due, [e.tick for e in executions], 0.0)
            n_ticks = min(min(e.n_steps - e.tick, e.checked + self._check_steps - e.tick) for e in self._executions)
            plans = [e.plan[e.tick : e.tick + n_ticks] for e in self._executions]
            self._rows = list(np.stack(plans, axis=1) if self._several else plans[0])
        for e in self._executions:
            e.tick += 1
        self._next += 1
        return self._rows[self._next - 1]

    def stop(self, now: float) -> np.ndarray:
        """The safe action in place of what the option says, within the limits, as at a tick by a clock.

        Call it every tick until the machine rests. A tick with an observation after that decides anew, on from there.

        :param now: the time of this tick by the caller's clock, in s
        :return: shape ``[*action_shape]``, or ``[n, *action_shape]`` for n robots
        :raises ValueError: without a ``safety``, after ticks without ``now``, or if ``now`` is not finite or runs backwards
        """
        if self.safety is None:
            raise ValueError("safety=None has no safe action: pass OptionController(policy, safety=Safety(...))")
        if self._executions and self._now is None:
            raise ValueError(_NOW_OR_NEVER)
        return self._guarded(None, self._checked(now), None, "stopped")

    def _checked(self, now: float) -> float:
        now = float(now)
        if not (math.isfinite(now) and (self._now is None or now >= self._now)):
            raise ValueError(f"now must be finite and must not run backwards, and it is {now} s after {self._now} s")
        return now

    def _guarded(
        self, observation: Observation | None, now: float, observed_at: float | None, reason: str | None = None
    ) -> np.ndarray:
        assert self.safety is not None
        if observation is not None:
            self._observed_at = now if observed_at is None else observed_at
        age = now - self._observed_at
        low, high = self._box.low, self._box.high
        actions = low
        if self._first is not None and len(self._first) > 1:
            actions = np.broadcast_to(low, (len(self._first), *low.shape))
        if reason is None and not age <= self.safety.stale_after:
            reason = "no fresh observation"
        if reason is None and age < -self.safety.stale_after:
            reason = "observed_at is of another clock than now"
        try:
            if self._first is None and observation is not None and self._are_several(observation):
                actions = np.broadcast_to(low, (len(_first_leaf(observation)), *low.shape))
            if reason is None:
                actions = self._at(observation, now)
        except Exception as error:  # the policy's own, or by an observation that is none, of any kind
            if reason is None:
                reason = "the policy failed"
                if not (self._guard is not None and self._guard.is_safe_action):
                    logger.error("the policy failed: %s: %s", type(error).__name__, error)
        if self._guard is None or (reason is None and self._guard.low.shape != actions.shape):
            self._guard = Guard(self.safety, np.broadcast_to(low, actions.shape), np.broadcast_to(high, actions.shape))
            self._guard.replaced = self.replaced
            shape = (actions.size // low.size, *low.shape)
            self._guard.start(None if self._first is None else np.broadcast_to(self._first[:, 1], shape))
        seconds = self.dt if self._sent_at is None else now - self._sent_at
        self._now = self._sent_at = now
        # After a stall a command may not change by all that the time of the stall would allow.
        counted = min(seconds, 2.0 * self._usual_tick)
        self._usual_tick += 0.1 * (counted - self._usual_tick)
        command = self._guard.command(actions, counted, reason=reason)
        if self._guard.is_safe_action:
            # Whatever comes next is decided anew, on from here.
            commands = command.reshape(-1, *low.shape)
            before = [e.sent for e in self._executions] or self._firsts(len(commands))
            self._first = np.stack([self._last_two(*both, seconds) for both in zip(before, commands, strict=True)])
            self._executions = []
        else:
            self._keep_sent(command, seconds)
        return command

    def _at(self, observation: Observation | None, now: float) -> np.ndarray:
        dt = self.option_space.dt
        due = [i for i, e in enumerate(self._executions) if now - e.start >= (e.n_steps - 0.5) * dt]
        # Without an observation an option holds its last action, as it does past its end at a late tick.
        if observation is not None or not self._executions:
            self._renew(observation, due, [round((now - e.start) / dt) for e in self._executions], now)
        self._now = now
        # The action that an option leaves from is that of the tick before it.
        n_before = self.option_space.n_before
        lead = dt if n_before else 0.0
        phases = np.array([min((now - e.start + lead) / (len(e.plan) * dt), 1.0) for e in self._executions])
        features = self._trajectory.joined_basis(phases, n_before) if n_before else self._trajectory.basis(phases)
        actions = self._box.cast(np.array([row.dot(e.weights) for row, e in zip(features, self._executions, strict=True)]))
        return actions if self._several else actions[0]

    def _renew(self, observation: Observation | None, due: list[int], ran: list[int], now: float) -> None:
        """Decide on what comes after the options that are due, or that are broken off.

        :param ran: how many steps of each have been played
        """
        if observation is None:
            raise ValueError("the first tick, and each one at a fixed rate, needs an observation")
        if self._interrupt is not None:
            due = self._with_interrupted(observation, due, ran)
        if due or not self._executions:
            self._decide(observation, due, now)

    def _decide(self, observation: Observation, due: list[int], now: float) -> None:
        if not self._executions:
            several = self.option_space.joined and self._are_several(observation)
            n = len(_first_leaf(observation)) if several else 1
            options = self._ask(observation, self._firsts(n) if self.option_space.joined else [], several)
            self._several = options.ndim == 2
            options = np.atleast_2d(options)
            self._executions = [self._begin(*both, now) for both in zip(options, self._firsts(len(options)), strict=True)]
            return
        if self._several and len(due) < len(self._executions):
            observation = _rows(observation, due)
        sent = [self._executions[i].sent for i in due]
        options = np.atleast_2d(self._ask(observation, sent, self._several))
        for i, option, action in zip(due, options, sent, strict=True):
            self._executions[i] = self._begin(option, action, now)

    def _firsts(self, n: int) -> list[np.ndarray]:
        """The two actions before n first options."""
        return list(np.broadcast_to(self._middle if self._first is None else self._first, (n, 2, *self._box.low.shape)))

    def _with_interrupted(self, observation: Observation, due: list[int], ran: list[int]) -> list[int]:
        """Options that are due, and those whose rest is not worth playing.

        :param ran: how many steps of each have been played
        """
        asked, rests = [], []
        for i, (e, n_ran) in enumerate(zip(self._executions, ran, strict=True)):
            if i in due or n_ran - e.checked < self._check_steps:
                continue
            e.checked = n_ran
            if len(e.plan) - n_ran < shortest_steps(self.option_space):
                continue
            before = self._before(e.sent) if self.option_space.joined else None
            rests.append(self.option_space.closest(self._box.normalise(e.plan[n_ran:]), before)[0])
            asked.append(i)
        if not asked:
            return due
        assert self._interrupt is not None
        seen: Any = _rows(observation, asked) if self._several else stack([observation])
        seen = self._as_seen(seen, [self._executions[i].sent for i in asked], several=True)
        worth_ending = self._interrupt.worth_ending(seen, np.array(rests))
        return sorted([*due, *(i for i, ends in zip(asked, worth_ending, strict=True) if ends)])

    def _ask(self, observation: Observation, sent: list[np.ndarray], several: bool) -> np.ndarray:
        """Options for one or several observations, and the last two actions before each."""
        if not is_finite(observation):  # which normalisation would hide
            raise ValueError(f"the observation is not finite: {observation}")
        return np.asarray(self.policy(self._as_seen(observation, sent, several)))

    def _as_seen(self, observation: Observation, sent: list[np.ndarray], several: bool) -> Observation:
        """Observations as the policy sees them."""
        if not self.option_space.joined:
            return observation
        before = np.stack([self._before(actions) for actions in sent])
        seen: Observation = with_last_action(self.policy.observation_space, observation, before if several else before[0])
        return seen

    def _before(self, sent: np.ndarray) -> np.ndarray:
        """What an option leaves from, by the last two actions before it."""
        return self.option_space.before(self._box.normalise(sent))[0]

    def _are_several(self, observation: Observation) -> bool:
        # A policy of one's own, with free joins, may not tell.
        space: Any = getattr(self.policy, "observation_space", None)
        if space is None:
            return False
        if isinstance(space, spaces.Dict):
            space = space[next(iter(observation)) if isinstance(observation, dict) else OBSERVATION]
        return np.ndim(_first_leaf(observation)) > len(space.shape)

    def _begin(self, option: np.ndarray, sent: np.ndarray, now: float) -> _Execution:
        # As OptionExecutionWrapper does, in the same precision.
        option = np.clip(option.astype(np.float64), -1.0, 1.0)
        if not np.isfinite(option).all():
            raise ValueError(f"the policy returned an option that is not finite: {option}")
        omega, n_steps = self.option_space.decode(option)
        start = self.option_space.first_points(self._before(sent), n_steps) if self.option_space.joined else None
        plan = self._box.actions(self._trajectory.plan(omega, n_steps, start))
        # Features sum to one, so that actions are the same combination of weights in their own units.
        weights = self._box.scale(omega.T if start is None else np.vstack([start, omega.T]))
        return _Execution(option, min(n_steps, self._longest), plan, weights, sent, start=now)

    @property
    def option(self) -> np.ndarray:
        """The option that runs, normalised to [−1, 1]: ``[option_dim]``, or ``[n, option_dim]``.

        This and the three below are NaN while the safe action is sent.
        """
        return self._for_each([e.option for e in self._running()])

    @property
    def duration(self) -> Any:
        """How long the running option takes, in s: a number, or an array ``[n]``."""
        return self._for_each([e.n_steps * self.option_space.dt for e in self._running()])

    @property
    def elapsed(self) -> Any:
        """How long it had been running at the last tick, in s; 0 if it was chosen then: a number, or an array ``[n]``."""
        if self._now is None:
            return self._for_each([(e.tick - 1) * self.option_space.dt for e in self._running()])
        return self._for_each([self._now - e.start for e in self._running()])

    @property
    def remaining(self) -> Any:
        """How long it had to run at the last tick, in s, at least 0: a number, or an array ``[n]``."""
        return self._for_each(np.maximum(np.asarray(self.duration) - self.elapsed, 0.0).reshape(-1).tolist())

    def _running(self) -> list[_Execution]:
        if self._executions:
            return self._executions
        if self._now is None:
            raise ValueError("no option runs: call the controller with an observation first")
        # The safe action is being sent. Whoever logs goes on.
        nan: Any = math.nan
        nothing = np.full(self._box.low.size * self.option_space.arguments["n_rbf"] + 1, nan, np.float32)
        n = len(self._first) if self._several and self._first is not None else 1
        return [_Execution(nothing, nan, nothing, nothing, nothing, start=nan)] * n

    def _for_each(self, values: list[Any]) -> Any:
        return np.stack(values) if self._several else values[0]


def _rows(observation: Observation, rows: list[int]) -> Observation:
    if isinstance(observation, dict):
        return {key: np.asarray(value)[rows] for key, value in observation.items()}
    return np.asarray(observation)[rows]


def _first_leaf(observation: Observation) -> npt.NDArray[Any]:
    return next(iter(observation.values())) if isinstance(observation, dict) else observation


def _as_policy(policy: Any, deterministic: bool, vec_normalize: Any) -> OptionPolicy:
    if not isinstance(policy, str | Path):
        if callable(policy):
            if vec_normalize is not None or not deterministic:
                raise ValueError(
                    f"{type(policy).__name__} is a policy that acts and normalises by itself: pass no vec_normalize, "
                    "deterministic, or pass the model"
                )
            return policy
        return ModelPolicy(policy, deterministic, _load_vec_normalize(vec_normalize))
    path = Path(policy)
    if path.suffix == ".onnx":
        if vec_normalize is not None or not deterministic:
            raise ValueError("an exported policy acts greedily and normalises by itself: pass no vec_normalize, deterministic")
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist")
        return OnnxPolicy(path)
    if path.suffix not in ("", ".zip"):
        raise ValueError(f"{path} must be a model saved as .zip or exported as .onnx")
    # A controller needs no replay buffer.
    model = _algorithm_of(path).load(path, device="cpu", buffer_size=1)
    return ModelPolicy(model, deterministic, _load_vec_normalize(vec_normalize))


def _algorithm_of(path: Path) -> "type[OptionOffPolicyAlgorithm]":
    """The class that saved a file, by a setting that only it has; nothing of the file is run to find out."""
    # Imported here, because an exported policy needs none of this.
    from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
    from sb3_ctco.registry import ALGORITHMS

    # As Stable-Baselines3 does: the ending may be left out.
    file = path if path.exists() else path.with_name(f"{path.name}.zip")
    if not file.exists():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        with zipfile.ZipFile(file) as archive:
            settings = json.loads(archive.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{file} is damaged or no model of Stable-Baselines3: {error}") from error
    for row in ALGORITHMS.values():
        algorithm = row.zoo_class
        if algorithm is not None and issubclass(algorithm, OptionOffPolicyAlgorithm) and algorithm._own_setting in settings:
            return algorithm
    raise TypeError(
        f"{file} was not saved by CTCO or FiGARSAC: load it with its own class, and pass the model if it decides by options; "
        "one of fixed rate, such as SAC or DACPPO, has its action from model.predict"
    )


def _load_vec_normalize(vec_normalize: Any) -> Any:
    if not isinstance(vec_normalize, str | Path):
        return vec_normalize
    with Path(vec_normalize).open("rb") as file:
        # VecNormalize.load asks for an environment, which a controller has not.
        return pickle.load(file)
