"""What an option vector means: shared by a policy, its environment, its buffer and its controller."""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sb3_ctco.option_array import plain
from sb3_ctco.options.semi_mdp import DEFAULT_DISCOUNT_RATE, FloatArray, check_seconds, steps_in
from sb3_ctco.options.trajectory import TRAJECTORIES, Trajectory

DurationScale = Literal["log", "linear"]
DURATION_SCALES: tuple[DurationScale, ...] = ("log", "linear")
Join = Literal["free", "continuous", "smooth"]
#: Settings of options in files of 0.1.0, which do not say so: there was nothing else
OPTIONS_OF_0_1_0 = {"trajectory": "rbf", "duration_scale": "linear", "join": "free"}
#: Each at the index of how many of its first points an option is given by what was sent before it
JOINS: tuple[Join, ...] = ("free", "continuous", "smooth")


def default_durations(discount_rate: float) -> tuple[float, float]:
    """The shortest and the longest duration where none is given, in s: they discount by 0.99 and by 0.82.

    An agent that decides much more often than that drowns its own exploration, and one of a fixed rate with the usual discount
    of 0.99 a step decides just that often. With the paper's discount, 0.98 over 0.05 s, they are 0.025 and 0.5 s, and they are
    never longer.

    :param discount_rate: τ, in 1/s
    """
    discount_rate = max(discount_rate, DEFAULT_DISCOUNT_RATE)
    return -math.log(0.99) / discount_rate, -10 * math.log(0.98) / discount_rate


@dataclass(frozen=True)
class OptionSpace:
    """What an option vector means. A policy and the environment it acts in must share it.

    An option vector is ``[ω flattened from [action_dim, n_weights], duration]``, every entry in [−1, 1].

    :param trajectory: how ω becomes actions
    :param d_max: longest duration, in s
    :param d_min: shortest duration, in s
    :param dt: the interaction period of the environment, in s
    :param discount_rate: τ, in 1/s
    :param duration_scale: how [−1, 1] maps to [d_min, d_max]: ``"linear"`` is the paper's, with ``"log"`` equal steps
        multiply the duration, so that short ones are as easy to tell apart as long ones whatever ``d_max`` is
    :param join: where an option's actions begin: ``"free"``, wherever its weights say; ``"continuous"``, at the action that
        is being sent when it begins; or ``"smooth"``, there, and with the slope at which actions were changing
    :raises ValueError: if a setting is out of its range
    """

    trajectory: Trajectory
    d_max: float
    d_min: float
    dt: float
    discount_rate: float
    duration_scale: DurationScale
    join: Join

    def __post_init__(self) -> None:
        check_seconds(dt=self.dt, d_max=self.d_max, d_min=self.d_min)
        if self.d_min > self.d_max:
            if self.dt > self.d_max:
                raise ValueError(
                    f"d_max={self.d_max:g} s is shorter than a step of the environment, dt={self.dt:g} s: pass a larger one, "
                    f"such as d_max={10 * self.dt:g}, ten steps (by default it is 0.5 s at most), and gamma_dt={self.dt:g} if "
                    "gamma is meant for a step"
                )
            raise ValueError(
                f"d_min={self.d_min:g} s is longer than d_max={self.d_max:g} s: raise d_max, or pass a smaller d_min"
            )
        if not (self.discount_rate >= 0 and math.isfinite(self.discount_rate)):
            raise ValueError(f"discount_rate must be a finite number of 1/s that is at least 0, not {self.discount_rate}")
        if self.duration_scale not in DURATION_SCALES:
            raise ValueError(f"duration_scale must be one of {DURATION_SCALES}, not {self.duration_scale!r}")
        if self.join not in JOINS:
            raise ValueError(f"join must be one of {JOINS}, not {self.join!r}")

    @classmethod
    def make(
        cls,
        n_rbf: int,
        d_max: float,
        d_min: float,
        dt: float,
        discount_rate: float,
        trajectory: str | type[Trajectory] = "bezier",
        duration_scale: DurationScale = "log",
        join: Join = "free",
    ) -> "OptionSpace":
        """An option space from the arguments that wrappers and algorithms take.

        :param n_rbf: number of weights an action dimension
        :param trajectory: a name in :data:`~sb3_ctco.options.trajectory.TRAJECTORIES`, or a class
        """
        if isinstance(trajectory, str):
            if trajectory not in TRAJECTORIES:
                raise ValueError(f"trajectory must be one of {list(TRAJECTORIES)} or a Trajectory class, not {trajectory!r}")
            trajectory = TRAJECTORIES[trajectory]
        return cls(trajectory(n_rbf), d_max, d_min, dt, discount_rate, duration_scale, join)

    @property
    def joined(self) -> bool:
        """Whether an option leaves from the action that is being sent when it begins."""
        return self.n_before > 0

    @property
    def n_before(self) -> int:
        """How many numbers an action dimension tell what an option leaves from: an action, and a slope."""
        return JOINS.index(self.join)

    def before(self, sent: FloatArray) -> FloatArray:
        """What an option leaves from that begins after each action but the first.

        With smooth joins that is the action, and how it was changing: the difference from the one before, where 1 is as steep
        as a Bézier curve can be, the whole box ``n_weights + 1`` times in the shortest duration. What is steeper counts as 1.

        :param sent: normalised actions that were sent every dt, ``[n + 1, action_dim]``
        :return: shape ``[n, n_before · action_dim]``
        """
        if self.join != "smooth":
            return sent[1:]
        steepest = 2.0 * (self.trajectory.n_weights + 1) / self.d_min
        return np.hstack([sent[1:], (np.diff(sent, axis=0) / (steepest * self.dt)).clip(-1.0, 1.0)])

    def first_points(self, before: FloatArray, n_steps: Any) -> FloatArray:
        """The points of a trajectory that are given, of one option or several.

        With smooth joins the second is where the slope leads to in ``1 / (n_weights + 1)`` of the duration, in the box.

        :param before: what it leaves from, see :meth:`before`, shape ``[*n, n_before · action_dim]``
        :param n_steps: how many steps it takes, shape ``[*n]``
        :return: shape ``[*n, n_before, action_dim]``
        """
        points = before.reshape(*before.shape[:-1], self.n_before, before.shape[-1] // self.n_before)
        if self.join == "smooth":
            action, slope = points[..., 0, :], points[..., 1, :]
            then = action + slope * (2.0 * self.dt / self.d_min) * np.asarray(n_steps)[..., None]
            points = np.stack([action, then.clip(-1.0, 1.0)], axis=-2)
        return points

    @property
    def arguments(self) -> dict[str, Any]:
        """What :meth:`make`, or ``OptionExecutionWrapper``, makes the same option space from."""
        names = {kind: name for name, kind in TRAJECTORIES.items()}
        kind = type(self.trajectory)
        return {
            "n_rbf": self.trajectory.n_weights,
            "trajectory": names.get(kind, kind),
            **{field.name: getattr(self, field.name) for field in fields(self) if field.name != "trajectory"},
        }

    def differences(self, other: "OptionSpace") -> dict[str, tuple[Any, Any]]:
        """Arguments that differ by more than rounding, each with its value here and in the other."""
        pairs = {name: (value, other.arguments[name]) for name, value in self.arguments.items()}
        return {
            name: (here, there)
            for name, (here, there) in pairs.items()
            if not (here == there or (isinstance(here, int | float) and math.isclose(here, there, rel_tol=1e-6)))
        }

    def duration(self, option: FloatArray) -> float:
        """The duration d that an option vector asks for, in s: its last entry, mapped from [−1, 1] to [d_min, d_max]."""
        return self.seconds(float(plain(option)[-1]))

    def seconds(self, normalised: Any) -> Any:
        """The duration in s that a number in [−1, 1] stands for, or an array or tensor of such."""
        fraction = 0.5 * (normalised + 1.0)
        if self.duration_scale == "log":
            return self.d_min * (self.d_max / self.d_min) ** fraction
        return self.d_min + fraction * (self.d_max - self.d_min)

    def normalised(self, seconds: FloatArray) -> FloatArray:
        """The numbers in [−1, 1] that :meth:`seconds` turns into these durations, or the nearest; 0 if d_min = d_max.

        :param seconds: durations, in s
        """
        if self.d_max == self.d_min:
            return np.zeros_like(seconds)
        if self.duration_scale == "log":
            fraction = np.log(seconds / self.d_min) / math.log(self.d_max / self.d_min)
        else:
            fraction = (seconds - self.d_min) / (self.d_max - self.d_min)
        return (2.0 * fraction - 1.0).clip(-1.0, 1.0)

    def encode(self, omega: FloatArray, n_steps: npt.NDArray[np.integer]) -> FloatArray:
        """The option vectors that :meth:`decode` turns into these; d is encoded as 0 if d_min = d_max.

        :param omega: weights, shape ``[n, action_dim, n_weights]``
        :param n_steps: numbers of primitive steps, shape ``[n]``
        :return: shape ``[n, action_dim · n_weights + 1]``, float32
        """
        options = np.zeros((len(omega), omega.shape[1] * omega.shape[2] + 1), dtype=np.float32)
        options[:, :-1] = omega.reshape(len(omega), options.shape[1] - 1)
        options[:, -1] = self.normalised(n_steps * self.dt)
        return options

    def decode(self, option: FloatArray) -> tuple[FloatArray, int]:
        """Split an option vector.

        :param option: shape ``[action_dim · n_weights + 1]``, entries in [−1, 1]
        :return: ω, shape ``[action_dim, n_weights]``, and the number of primitive steps
        """
        option = plain(option)
        return option[:-1].reshape(-1, self.trajectory.n_weights), steps_in(self.duration(option), self.dt)

    def closest(self, plan: FloatArray, before: FloatArray | None = None) -> tuple[FloatArray, float]:
        """The option that comes closest to a plan.

        :param plan: normalised actions, shape ``[n_steps, action_dim]``
        :param before: what it leaves from unless the join is free, see :meth:`before`
        :return: the option vector, float32, and the largest deviation of its actions from the plan
        """
        ends = np.array([len(plan)])
        starts = None if before is None else self.first_points(before[None], ends)
        omega, residuals = self.trajectory.fit(plan, np.array([0]), ends, starts)
        return self.encode(omega, ends)[0], float(residuals[0])

    def plan(self, option: FloatArray, before: FloatArray | None = None) -> FloatArray:
        """All actions of an option, normalised.

        :param option: shape ``[action_dim · n_weights + 1]``, entries in [−1, 1]
        :param before: what it leaves from unless the join is free, see :meth:`before`
        :return: shape ``[n_steps, action_dim]``
        :raises ValueError: if ``before`` is given with a free join, or missing with another
        """
        if (before is not None) != self.joined:
            raise ValueError(f"with join={self.join!r} a plan depends {'' if self.joined else 'not '}on the action before it")
        omega, n_steps = self.decode(option)
        return self.trajectory.plan(omega, n_steps, None if before is None else self.first_points(before, n_steps))


class ActionBox:
    """The bounds of primitive actions, to which normalised ones are scaled.

    :param low: lower bounds, shape ``action_shape``, of which action_dim is the product
    :param high: upper bounds, likewise
    """

    def __init__(self, low: npt.NDArray[Any], high: npt.NDArray[Any]):
        self.low, self.high = low, high
        self._bottom = low.astype(np.float64).ravel()
        self._half_width = 0.5 * (high.astype(np.float64).ravel() - self._bottom)
        #: Which entries of an action have one value only, ``[action_dim]``
        self.is_fixed = self._half_width == 0.0

    def actions(self, trajectory: FloatArray) -> npt.NDArray[Any]:
        """Normalised actions in the units of the box.

        :param trajectory: actions in [−1, 1], shape ``[n_steps, action_dim]``
        :return: shape ``[n_steps, *action_shape]``, in the precision of ``low``
        """
        return self.cast(self.scale(trajectory))

    def scale(self, trajectory: FloatArray) -> FloatArray:
        """Normalised actions in the units of the box, in double precision: shape ``[n_steps, action_dim]``, as given."""
        return (trajectory + 1.0) * self._half_width + self._bottom

    def normalise(self, actions: npt.ArrayLike) -> FloatArray:
        """The inverse of :meth:`scale`, for actions ``[n_steps, *action_shape]``: shape ``[n_steps, action_dim]``.

        :raises ValueError: if they have another shape
        """
        given = np.asarray(actions, dtype=np.float64)
        if given.ndim == 0 or given.shape[1:] != self.low.shape:
            raise ValueError(f"actions must have shape [n, *{self.low.shape}], not {given.shape}")
        # Where both bounds are the same, there is nothing to say, which is 0.
        width = np.where(self.is_fixed, 1.0, self._half_width)
        return (given.reshape(len(given), self._bottom.size) - self._bottom - self._half_width) / width

    def cast(self, actions: FloatArray) -> npt.NDArray[Any]:
        """Actions in the units of the box, in its shape and precision: ``[n_steps, *action_shape]``."""
        # The cast may round past a bound.
        return actions.astype(self.low.dtype).reshape(-1, *self.low.shape).clip(self.low, self.high)
