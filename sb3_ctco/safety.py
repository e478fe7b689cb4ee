"""What is sent to a machine when a decision cannot be relied on, and how fast commands may change."""

import logging
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

logger = logging.getLogger(__name__)

#: ``safe_action(last action that was sent)``: the one to send; or the name of one
SafeAction = Literal["hold", "zero"] | Callable[[np.ndarray], Any]


@dataclass(frozen=True)
class Safety:
    """What a control loop does to be safe.

    Changes of actions count in widths of their box, whatever its units: a ``max_rate`` of 10/s crosses it in 0.1 s. Safe
    actions are sent within these limits, too. The numbers are a start; those of the machine are the right ones.

    :param stale_after: an observation that is older than this is not acted on, in s; ``math.inf`` to act on any
    :param safe_action: what is sent then, or when the policy fails: ``"zero"``, which stops a machine that is commanded by
        velocities, ``"hold"``, the last action once more (zero while none is known), which stops one that is commanded by
        positions, or a function. Of torques neither is safe: pass a function that brakes and holds the weight
    :param max_rate: the largest change of an action, in widths of its box a second; None for no limit
    :param max_slew: the largest change of that rate, in widths a second, a second; None for no limit. It slows down in time
        to come to rest at what is commanded, so it follows commands a little late that move faster than it stops in a period.
        It counts on ticks of one length: where a short one follows a late one, it may run past, by some hundredths of the box
    :raises ValueError: if a number is not positive, or ``safe_action`` is neither a function nor one of its names
    """

    stale_after: float = 0.2
    safe_action: SafeAction = "zero"
    max_rate: float | None = 10.0
    max_slew: float | None = 400.0

    def __post_init__(self) -> None:
        for name in ("stale_after", "max_rate", "max_slew"):
            value = getattr(self, name)
            if not (value is None and name != "stale_after") and not (
                isinstance(value, int | float | np.number) and value > 0
            ):
                raise ValueError(f"{name} must be a positive number, not {value!r}")
        named = isinstance(self.safe_action, str) and self.safe_action in ("hold", "zero")
        if not (named or callable(self.safe_action)):
            raise ValueError(
                f"safe_action must be 'hold', 'zero' or a function of the last action, not {self.safe_action!r}: for an "
                "action that is always the same pass lambda last: action"
            )


class Guard:
    """Stands between whoever decides and a machine. Nothing in it raises.

    :param safety: what it does
    :param low: lower bounds of actions
    :param high: upper bounds, likewise
    :raises ValueError: if changes of actions are limited, which have no width
    """

    def __init__(self, safety: Safety, low: np.ndarray, high: np.ndarray):
        limits = [limit for limit in (safety.max_rate, safety.max_slew) if limit not in (None, math.inf)]
        if limits and not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError(
                f"max_rate={safety.max_rate} and max_slew={safety.max_slew} count in widths of the box of actions, and from "
                f"{low} to {high} there is none: give the machine's own action space bounds, or pass "
                "RealTimeWrapper(env, safety=Safety(max_rate=None, max_slew=None))"
            )
        self.safety = safety
        self.low, self.high = low, high
        #: How many actions were replaced by the safe one, by reason
        self.replaced: Counter[str] = Counter()
        self._width = np.where(high > low, high.astype(np.float64) - low, 1.0)
        self._zero = np.zeros_like(low).clip(low, high)
        self._reason: str | None = None
        self.start(None)

    def start(self, action: Any) -> None:
        """Begin anew.

        :param action: the one that is being sent; None if that is not known, as one that is not finite is not: the next one
            may then be any
        """
        known = action is not None and np.isfinite(action).all()
        self._sent = np.array(action, np.float64).reshape(self.low.shape) if known else None
        self._rate = np.zeros(self.low.shape)

    def restart(self, rows: Any, actions: np.ndarray) -> None:
        """Begin anew for some of several machines: these actions are being sent to them, at rest."""
        if self._sent is not None:
            self._sent[rows] = np.where(np.isfinite(actions), actions, self._sent[rows])
            self._rate[rows] = 0.0

    def command(self, action: np.ndarray, seconds: float, age: float = 0.0, reason: str | None = None) -> np.ndarray:
        """What is to be sent.

        :param action: what was decided
        :param seconds: since the last command, in s
        :param age: of the observation, in s
        :param reason: why it is not to be sent, if that is known already
        :return: an array of its own, in the precision of the bounds
        """
        if reason is None and not age <= self.safety.stale_after:
            reason = "no fresh observation"
        if reason is None and not np.isfinite(action).all():
            reason = "the action is not finite"
        if reason is not None:
            action = self.safe_action()
            self.replaced[reason] += 1
            if reason != self._reason:  # once, and not at every tick
                nothing = self._sent is None and self.safety.safe_action == "hold"
                hint = ", since no last action is known: tell reset of it" if nothing else ""
                logger.warning("the safe action is sent (%s): %s%s", reason, action, hint)
        self._reason = reason
        self._sent = self._limited(np.asarray(action, np.float64).clip(self.low, self.high), seconds)
        return self._sent.astype(self.low.dtype).clip(self.low, self.high)

    @property
    def is_safe_action(self) -> bool:
        """Whether the last action was replaced by the safe one."""
        return self._reason is not None

    def safe_action(self) -> np.ndarray:
        """What is to be sent when nothing else is, before limits."""
        sent = self._zero if self._sent is None else self._sent
        if not callable(self.safety.safe_action):
            return self._zero if self.safety.safe_action == "zero" else sent
        try:
            action = np.asarray(self.safety.safe_action(sent.astype(self.low.dtype)), np.float64).reshape(self.low.shape)
            if np.isfinite(action).all():
                return action
            logger.error("safe_action returned %s: the last action is sent once more", action)
        except Exception:  # a user's function, at the moment when nothing may fail
            logger.exception("safe_action failed: the last action is sent once more")
        return sent

    def _limited(self, action: np.ndarray, seconds: float) -> np.ndarray:
        max_rate, max_slew = (None if limit == math.inf else limit for limit in (self.safety.max_rate, self.safety.max_slew))
        if self._sent is None or (max_rate is None and max_slew is None):
            return action
        if seconds <= 0.0:
            return self._sent
        gap = (action - self._sent) / self._width
        rate = gap / seconds
        if max_rate is not None:
            rate = rate.clip(-max_rate, max_rate)
        if max_slew is not None:
            step = max_slew * seconds
            # The fastest that, after this period, can still be braked before the end of the gap, v·dt + v²/(2s) = gap; or, at
            # its end, in one period.
            brakes = np.maximum(np.sqrt(step * step + 2.0 * max_slew * np.abs(gap)) - step, step)
            rate = rate.clip(-brakes, brakes).clip(self._rate - step, self._rate + step)
        self._rate = rate
        return (self._sent + rate * seconds * self._width).clip(self.low, self.high)
