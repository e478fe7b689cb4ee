"""Hold an environment to the wall clock."""

import logging
import math
import time
from dataclasses import dataclass
from typing import Any, Literal, Protocol, SupportsFloat, runtime_checkable

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.env_util import unwrap_wrapper

from sb3_ctco.options import INTERRUPTED, LAST_ACTION, OBSERVATION_AGE, TAKEN_OVER
from sb3_ctco.safety import Guard, Safety
from sb3_ctco.wrappers.checks import reset_env
from sb3_ctco.wrappers.timing import find_dt

logger = logging.getLogger(__name__)


class Clock(Protocol):
    """What a real-time loop needs of time; a fake one makes tests exact."""

    def now(self) -> float:
        """Time that never goes backwards, in s."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


class WallClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Time that never goes backwards, in s."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


@runtime_checkable
class SupportsSendReceive(Protocol):
    """A machine that takes a command and is read later: ``step`` in two halves, with the control period in between."""

    def send(self, action: Any) -> None:
        """Put a command into force; return at once."""

    def receive(self) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Read the sensors: what ``step`` returns."""


@dataclass
class TickStatistics:
    """How well the period was kept.

    :param ticks: commands that had a time to be sent at (all but the first of each episode)
    :param late_ticks: those that were sent later than that by more than the tolerance
    :param worst_lateness: of any tick, in s
    :param total_lateness: of the late ticks, in s
    :param safe_ticks: commands that were replaced by the safe action
    """

    ticks: int = 0
    late_ticks: int = 0
    worst_lateness: float = 0.0
    total_lateness: float = 0.0
    safe_ticks: int = 0

    def add(self, lateness: float, tolerance: float) -> None:
        """Account for a tick that was late by so many seconds."""
        self.ticks += 1
        self.worst_lateness = max(self.worst_lateness, lateness)
        if lateness > tolerance:
            self.late_ticks += 1
            self.total_lateness += lateness


class RealTimeWrapper(gym.Wrapper, RecordConstructorArgs):
    """Hold the period: the k-th command of an episode is sent k·dt after the first one, by the wall clock.

    ``step`` sends the command, waits for the end of the period, and returns what is observed then. A robot's
    environment offers ``send`` and ``receive`` (:class:`SupportsSendReceive`), between which the wait takes place; for
    any other one, a simulation, the wait follows its ``step``. Put it directly around that environment, inside
    ``TimeLimit``, ``Monitor`` and ``OptionExecutionWrapper``.

    A command is late if whoever decides, or the machine, took too long. Late ticks are counted in ``statistics`` (of
    this episode) and ``total_statistics``, shown as ``info["real_time"]`` (``lateness`` of this step's command in s)
    and logged as one warning an episode. The following commands keep their times, unless a whole period was lost or the
    clock was set back: then it starts anew, because commands in quick succession do a machine no good, and to wait until the
    old time comes again no better.

    Commands to a machine are guarded (:class:`~sb3_ctco.safety.Safety`): their changes are limited, and the safe action takes
    the place of one that is not finite, or that was decided on without a fresh observation. ``receive`` tells the age of
    its observation, in s, as ``info["observation_age"]``, if it may be old, and ``reset`` may tell the action that is being
    sent as ``info["last_action"]``, as each guarded step does. A step with the safe action has ``info["interrupted"]`` and
    ``info["taken_over"]``, so that it ends an option, and is no transition of the policy.

    :param env: the environment
    :param dt: the period, in s; by default what :func:`~sb3_ctco.wrappers.find_dt` finds
    :param clock: :class:`WallClock` by default
    :param tolerance: how late a command may be, in s, before it counts
    :param safety: how commands are guarded; by default ``Safety()`` for a machine, and not at all for a simulation
    :raises ValueError: if dt is not given and not found, or a number is out of range
    """

    def __init__(
        self,
        env: gym.Env,
        dt: float | None = None,
        clock: Clock | None = None,
        tolerance: float = 1e-3,
        safety: Safety | Literal["machine"] | None = "machine",
    ):
        RecordConstructorArgs.__init__(self, dt=dt, clock=clock, tolerance=tolerance, safety=safety, _disable_deepcopy=True)
        gym.Wrapper.__init__(self, env)
        dt = find_dt(env, required_by="RealTimeWrapper", given=dt)
        if not tolerance >= 0:
            raise ValueError(f"tolerance must be a number of seconds that is at least 0, not {tolerance}")
        #: Period, in s
        self.dt = dt
        self.tolerance = float(tolerance)
        self.clock: Clock = WallClock() if clock is None else clock
        self.statistics = TickStatistics()
        self.total_statistics = TickStatistics()
        self._due: float | None = None
        # Found once: to look for a protocol's methods takes as long as a cheap step.
        self._machine = env if isinstance(env, SupportsSendReceive) else None
        if safety == "machine":
            safety = None if self._machine is None else Safety()
        space: Any = env.action_space
        #: What guards commands; None if nothing does
        self.guard = None if safety is None else Guard(safety, space.low, space.high)
        #: Why the safe action is to be sent, whatever is decided; None if it is not. For whoever watches the loop
        self.alarm: str | None = None
        self._observed_at = 0.0
        self._sent_at: float | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; the clock starts with the first command."""
        self._log()
        self.statistics = TickStatistics()
        self._due = None
        obs, info = reset_env(self.env, seed, options)
        self._observed_at, self._sent_at = self.clock.now(), None
        if self.guard is not None:
            self.guard.start(info.get(LAST_ACTION))
        return obs, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send a command and return what is observed one period later."""
        now = self.clock.now()
        # Before its time, without a wait that returned early: the clock was set back, and there is no telling how far.
        if self._due is None or now < self._due - self.tolerance:
            self._due, lateness = now, 0.0
        else:
            lateness = max(0.0, now - self._due)
            self.statistics.add(lateness, self.tolerance)
            self.total_statistics.add(lateness, self.tolerance)
        # Whole periods that were lost are not made up for.
        self._due = (now if lateness >= self.dt else self._due) + self.dt

        replaced = False
        if self.guard is not None:
            seconds = self.dt if self._sent_at is None else min(now - self._sent_at, self.dt)
            self._sent_at = now
            # Whoever decides takes time as well, in which it grows older.
            action = self.guard.command(action, seconds, now - self._observed_at, self.alarm)
            replaced = self.guard.is_safe_action
            self.statistics.safe_ticks += replaced
            self.total_statistics.safe_ticks += replaced
        if self._machine is not None:
            self._machine.send(action)
            self._wait()
            obs, reward, terminated, truncated, info = self._machine.receive()
        else:
            obs, reward, terminated, truncated, info = self.env.step(action)
            self._wait()
        age = info.get(OBSERVATION_AGE, 0.0)
        if self.guard is not None and age < -self.guard.safety.stale_after:
            age = math.inf  # A time of another clock does not tell it.
        self._observed_at = self.clock.now() - age
        info = {**info, "real_time": {"lateness": lateness}}
        if self.guard is not None:
            info = {LAST_ACTION: action, **info}
        if replaced:
            info |= {INTERRUPTED: True, TAKEN_OVER: True}
        return obs, reward, terminated, truncated, info

    def close(self) -> None:
        """Log the last episode's late ticks and close the environment."""
        self._log()
        self.statistics = TickStatistics()
        super().close()

    def _wait(self) -> None:
        assert self._due is not None
        remaining = self._due - self.clock.now()
        if remaining > 0:
            # A clock that was set back must not stop the machine for as long.
            self.clock.sleep(min(remaining, self.dt))

    def _log(self) -> None:
        s = self.statistics
        if s.safe_ticks and self.guard is not None:
            logger.warning("the safe action was sent %d times: %s", s.safe_ticks, dict(self.guard.replaced))
            self.guard.replaced.clear()
        if s.late_ticks:
            logger.warning(
                "%d of %d ticks were late by more than %.1f ms: by %.1f ms on average, %.1f ms at worst (period %.1f ms)",
                s.late_ticks,
                s.ticks,
                1e3 * self.tolerance,
                1e3 * s.total_lateness / s.late_ticks,
                1e3 * s.worst_lateness,
                1e3 * self.dt,
            )


def refuse_other_actions(env: gym.Env, what: str) -> None:
    """Refuse an environment whose guard tells what it sent in other units than those of the environment's actions.

    :param what: names what needs to know what was sent
    :raises ValueError: if a wrapper outside a guarded :class:`RealTimeWrapper` has other actions than the machine
    """
    real_time = unwrap_wrapper(env, RealTimeWrapper)
    if isinstance(real_time, RealTimeWrapper) and real_time.guard is not None and env.action_space != real_time.action_space:
        raise ValueError(
            f"{what} needs to know what was sent, which the guard tells in the machine's actions, {real_time.action_space}, "
            f"and actions here are in {env.action_space}: scale them in the machine's send, or pass a RealTimeWrapper with "
            "safety=None"
        )
