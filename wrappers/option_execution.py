"""Play options, smooth action trajectories of variable duration, in an environment with a fixed step."""

import inspect
import itertools
import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal, Protocol, SupportsFloat, runtime_checkable

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from stable_baselines3.common.monitor import Monitor

from sb3_ctco.option_array import plain
from sb3_ctco.options import (
    DEFAULT_DISCOUNT_RATE,
    REWARD_UNITS,
    ActionBox,
    DurationScale,
    OptionSpace,
    RewardUnit,
    Trajectory,
    discounts_of_steps,
    integrated_reward,
    step_weight,
)
from sb3_ctco.wrappers.gymnasium_mujoco import find_rollout

SequenceResult = tuple[Any, npt.ArrayLike, bool, bool, dict[str, Any]]
StepSequence = Callable[..., SequenceResult]
Stacked = np.ndarray | dict[str, np.ndarray]


#: Where the loop over ``step`` leaves what it observed on the way, so that an environment's own infos stay
_ON_THE_WAY = "_observations_on_the_way"

#: Gymnasium's TimeLimit, and that which RL Zoo puts in its place
_TIME_LIMITS = ("gymnasium.wrappers.common.TimeLimit", "rl_zoo3.gym_patches.PatchedTimeLimit")


@runtime_checkable
class SupportsStepSequence(Protocol):
    """An environment that can play several actions at once, without computing what nobody sees.

    ``step_sequence(actions, observe)`` is ``step`` in a loop: it plays ``actions`` (shape ``[n_steps, *action_shape]``)
    until they run out or the episode ends, and returns the last observation, the reward of each step that ran, whether
    the last step terminated or truncated the episode, and the last step's info. ``observe`` lists, in increasing order
    and below ``n_steps``, the numbers of steps after which the observation is wanted, too: ``info["observations"]`` has
    those that came before the episode's end, in a list. It is passed only if sub-options are wanted
    (``n_sub_options``); an environment whose ``step_sequence(actions)`` does not take it is stepped in a loop then.
    """

    def step_sequence(self, actions: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        """Play actions ``[n_steps, *action_shape]``, observing after some numbers of steps."""
        ...


def find_dt(env: gym.Env) -> float | None:
    """The interaction period of an environment, in s, from what it says of itself.

    Looked for, in this order: ``env.unwrapped.dt``, dm_control's ``control_timestep()``, ``1/metadata["render_fps"]``.

    :return: the period in s, or None if the environment does not tell
    """
    base = env.unwrapped
    dt = getattr(base, "dt", None)
    if dt is None:
        control_timestep = getattr(base, "control_timestep", None)
        dt = control_timestep() if callable(control_timestep) else None
    if dt is None:
        render_fps = (env.metadata or {}).get("render_fps")
        dt = 1.0 / float(render_fps) if render_fps else None
    return None if dt is None else float(dt)


@dataclass(frozen=True, eq=False)
class SubOptions:
    """Shorter options that an option contained, as transitions: ``info["sub_options"]``.

    Every field but ``seen`` has one entry a sub-option.

    :param seen: the observations at their ends, stacked: ``[n_seen, *observation_shape]``, or a dictionary of such
    :param begins: rows of ``seen`` where they began, ``[n]``
    :param ends: rows of ``seen`` where they ended, ``[n]``
    :param options: option vectors, float32 ``[n, option_dim]``
    :param durations: in s, ``[n]``
    :param integrated_rewards: R of each, ``[n]``
    :param terminated: whether the episode terminated with it, ``[n]``
    :param truncated: whether it was truncated with it, ``[n]``
    :param residuals: largest deviation of its actions from those that were played, normalised, ``[n]``
    """

    seen: Stacked
    begins: np.ndarray
    ends: np.ndarray
    options: np.ndarray
    durations: np.ndarray
    integrated_rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    residuals: np.ndarray

    @property
    def observations(self) -> Stacked:
        """Where they began, ``[n, *observation_shape]``, or a dictionary of such."""
        return _at(self.seen, self.begins)

    @property
    def next_observations(self) -> Stacked:
        """Where they ended, likewise."""
        return _at(self.seen, self.ends)

    def __len__(self) -> int:
        return len(self.options)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SubOptions):
            return NotImplemented
        fields = [(mine, vars(other)[name]) for name, mine in vars(self).items()]
        return all(
            mine.keys() == its.keys() and all(np.array_equal(mine[key], its[key]) for key in mine)
            if isinstance(mine, dict) and isinstance(its, dict)
            else np.array_equal(mine, its)
            for mine, its in fields
        )

    __hash__ = None  # type: ignore[assignment]

    def __deepcopy__(self, memo: dict[int, Any]) -> "SubOptions":
        # Stable-Baselines3 copies infos deeply; what nobody writes to need not be copied.
        return self


def _stack(observations: list[Any]) -> Stacked:
    if isinstance(observations[0], dict):
        return {key: np.array([obs[key] for obs in observations]) for key in observations[0]}
    return np.array(observations)


def reset_env(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
    """Reset an environment, and look at what it returns.

    :raises TypeError: if that is not an observation and an info
    :raises ValueError: if the observation is not finite, or not as its space says
    """
    # Many environments' reset takes a seed and nothing else; Stable-Baselines3 passes options only if there are some, too.
    result = env.reset(seed=seed) if options is None else env.reset(seed=seed, options=options)
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise TypeError(
            f"reset of the environment {env} must return an observation and an info, a dictionary, as Gymnasium's do, not "
            f"{result!r}: wrap one of the old Gym in shimmy.GymV21CompatibilityV0"
        )
    check_observation(env, result[0])
    return result


def check_observation(env: gym.Env, obs: Any) -> None:
    """Look at what an environment observed.

    :raises ValueError: if it is not finite, or not as the environment's space says
    """
    fault = _find_fault(obs, env.observation_space)
    if fault is not None:
        raise ValueError(f"the environment {env} returned an observation that {fault}")


def _find_fault(obs: Any, space: spaces.Space) -> str | None:
    """What is wrong with an observation: a key, a shape, or a number that is not finite; None if nothing is."""
    if isinstance(space, spaces.Dict):
        if not isinstance(obs, dict) or obs.keys() != space.spaces.keys():
            return f"is no dictionary of {sorted(space.spaces)}: {obs}"
        faults = ((key, _find_fault(obs[key], inner)) for key, inner in space.spaces.items())
        return next((f"has a {key!r} that {fault}" for key, fault in faults if fault), None)
    if isinstance(space, spaces.Box):
        if np.shape(obs) != space.shape:
            return f"has the shape {np.shape(obs)}, not its space's {space.shape}: {obs}"
        if not _is_finite(obs):
            return f"is not finite: {obs}"
    return None


def _is_finite(obs: Any) -> bool:
    if isinstance(obs, dict):
        return all(_is_finite(value) for value in obs.values())
    array = np.asarray(obs)
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())


def _at(stacked: Stacked, rows: Any) -> Any:
    return {key: value[rows] for key, value in stacked.items()} if isinstance(stacked, dict) else stacked[rows]


class OptionExecutionWrapper(gym.Wrapper, RecordConstructorArgs):
    """Turn an environment with a fixed step into a semi-Markov decision process over options.

    An action of the wrapped environment is an *option* ``[ω, d]``: the weights ω of a smooth action trajectory
    (``[action_dim, n_rbf]``, flattened) and its duration d, all normalised to [−1, 1]. One ``step`` rounds d to a
    whole number of primitive steps (half up, at least one), computes all actions in one go, plays them, stops early
    at the end of the episode, and returns the last observation and info. Entries outside [−1, 1] are clipped.

    ``info["option"]`` tells what ran: ``duration`` (s), ``n_steps``, ``integrated_reward`` (R, equation (5) of
    Karimi et al. 2023) and ``discount`` (e^(−τ·duration)).

    The order of wrappers is ``OptionExecutionWrapper(Monitor(TimeLimit(env)))``: what is inside sees primitive steps.
    If the inner environment offers ``step_sequence`` (:class:`SupportsStepSequence`), directly or below nothing but
    Stable-Baselines3's ``Monitor`` and Gymnasium's ``TimeLimit``, ``OrderEnforcing`` and ``PassiveEnvChecker``, it is
    called in place of the loop over ``step``. Gymnasium's HalfCheetah, Swimmer, Hopper and Walker2d (v5) are given one.

    Example:
        >>> import gymnasium as gym
        >>> env = OptionExecutionWrapper(gym.make("Pendulum-v1"), n_rbf=2, d_max=0.5)
        >>> _, _ = env.reset(seed=0)
        >>> env.action_space.shape
        (3,)
        >>> _, _, _, _, info = env.step([0.0, 1.0, 1.0])
        >>> info["option"]["n_steps"], info["option"]["duration"]
        (10, 0.5)

    :param env: the environment to wrap; its action space must be a ``Box`` with finite bounds, of any shape
    :param n_rbf: number of radial basis functions an action dimension; 1 repeats one action
    :param d_max: longest duration, in s
    :param d_min: shortest duration, in s; one step (``dt``) by default
    :param dt: the interaction period, in s; by default what :func:`find_dt` finds
    :param discount_rate: τ, in 1/s; by default the paper's 0.404 (a factor of 0.98 over 0.05 s)
    :param reward: what ``step`` returns as reward: ``"sum"`` of the primitive rewards, which makes returns comparable
        with an agent of fixed rate, or ``"integral"``, R, for use under an algorithm that knows nothing of options
    :param reward_unit: ``"rate"`` if rewards do not shrink with dt, ``"impulse"`` if they are paid per event
    :param n_sub_options: how many random stretches of each option to hand over as options of their own, in
        ``info["sub_options"]`` (:class:`SubOptions`), for a replay buffer that learns from them
    :param sub_option_tolerance: leave out a sub-option if its actions deviate by more from those that were played;
        actions count as normalised to [−1, 1]
    :param trajectory: how ω becomes actions, a name in ``sb3_ctco.options.TRAJECTORIES`` or a class
    :param duration_scale: ``"log"`` or ``"linear"``, see :class:`~sb3_ctco.options.OptionSpace`
    :raises TypeError: if the action space is not a ``Box``
    :raises ValueError: if its bounds are not finite, a setting is out of range, or dt is not given and not found
    """

    action_space: spaces.Box  # type: ignore[assignment, override]

    def __init__(
        self,
        env: gym.Env,
        n_rbf: int = 3,
        d_max: float = 0.5,
        d_min: float | None = None,
        dt: float | None = None,
        discount_rate: float = DEFAULT_DISCOUNT_RATE,
        reward: Literal["sum", "integral"] = "sum",
        reward_unit: RewardUnit = "rate",
        n_sub_options: int = 0,
        sub_option_tolerance: float = 0.1,
        trajectory: str | type[Trajectory] = "rbf",
        duration_scale: DurationScale = "linear",
    ):
        RecordConstructorArgs.__init__(
            self,
            n_rbf=n_rbf,
            d_max=d_max,
            d_min=d_min,
            dt=dt,
            discount_rate=discount_rate,
            reward=reward,
            reward_unit=reward_unit,
            n_sub_options=n_sub_options,
            sub_option_tolerance=sub_option_tolerance,
            trajectory=trajectory,
            duration_scale=duration_scale,
        )
        gym.Wrapper.__init__(self, env)

        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(
                f"OptionExecutionWrapper needs a Box action space, not {space}: options are trajectories of continuous actions"
            )
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise ValueError(
                f"OptionExecutionWrapper needs finite action bounds, not {space}: "
                "wrap the environment with gymnasium.wrappers.ClipAction or RescaleAction, or give its space bounds"
            )
        if reward not in ("sum", "integral"):
            raise ValueError(f"reward must be 'sum' or 'integral', not {reward!r}")
        if reward_unit not in REWARD_UNITS:
            raise ValueError(f"reward_unit must be one of {REWARD_UNITS}, not {reward_unit!r}")
        if not sub_option_tolerance >= 0:
            raise ValueError(f"sub_option_tolerance must be at least 0, not {sub_option_tolerance}")
        if dt is None:
            dt = find_dt(env)
        if dt is None:
            raise ValueError(
                f"{env} does not tell its interaction period (no unwrapped.dt, control_timestep() or "
                "metadata['render_fps']): pass dt, in seconds, to the algorithm, CTCO(..., dt=0.02), or to "
                "OptionExecutionWrapper(env, dt=0.02)"
            )
        #: The settings that a policy for this environment must share.
        self.option_space = OptionSpace.make(
            n_rbf, d_max, dt if d_min is None else d_min, dt, discount_rate, trajectory, duration_scale
        )
        self.reward: Literal["sum", "integral"] = reward
        self.reward_unit: RewardUnit = reward_unit

        #: The action space of the environment inside.
        self.primitive_action_space = space
        self._box = ActionBox(space.low, space.high)
        option_dim = space.low.size * n_rbf + 1
        self.action_space = spaces.Box(-1.0, 1.0, (option_dim,), np.float32)
        self._play: StepSequence | None = None

        self.n_sub_options = 0
        self.set_n_sub_options(n_sub_options)
        self.sub_option_tolerance = sub_option_tolerance
        self._shortest = math.ceil(self.option_space.d_min / dt - 1e-6)
        # A generator of its own, so that sub-options change nothing in what the environment does.
        self._slice_rng = np.random.default_rng()
        self._last_obs: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the inner environment.

        :raises TypeError: if the environment does not return an observation and an info
        :raises ValueError: if the observation is not finite, or not as its space says
        """
        self._play = None
        result = reset_env(self.env, seed, options)
        if seed is not None:
            self._slice_rng = np.random.default_rng(seed)
        self._last_obs = deepcopy(result[0]) if self.n_sub_options else None
        self._play = self._choose_play()
        return result

    def _choose_play(self) -> StepSequence:
        """What plays an option's actions until the episode ends."""
        return _find_step_sequence(self.env, self.n_sub_options > 0) or self._step_in_a_loop

    def __getstate__(self) -> dict[str, Any]:
        # What plays is a function that belongs to this object, and to a simulation.
        return {**vars(self), "_play": self._play is not None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._play = self._choose_play() if state["_play"] else None

    def step(self, action: npt.ArrayLike) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Play one option.

        :param action: the option, shape ``[action_dim · n_rbf + 1]``
        :raises gymnasium.error.ResetNeeded: before the first reset, after the end of an episode, and after an error
            in the middle of an option
        :raises TypeError: if the environment does not return what Gymnasium's step returns
        :raises ValueError: if the option has another shape or is not finite, or if the environment returned a reward
            or an observation that is not finite or has another shape
        """
        given = np.asarray(plain(action), dtype=np.float64)
        option = given.ravel()
        if option.shape != self.action_space.shape:
            raise ValueError(f"an option here has shape {self.action_space.shape} (ω, then d), not {given.shape}")
        if not np.isfinite(option).all():
            raise ValueError(f"an option must be finite, not {option}")
        if self._play is None:
            raise ResetNeeded("call reset() first: the environment was not reset, its episode ended, or it raised an error")
        play, self._play = self._play, None

        settings = self.option_space
        omega, n_steps = settings.decode(option.clip(-1.0, 1.0))
        trajectory = settings.trajectory.plan(omega, n_steps)
        slices = self._draw_slices(n_steps)
        observe = sorted({k for ends in slices for k in ends} - {0, n_steps})
        actions = self._box.actions(trajectory)
        obs, rewards, terminated, truncated, info = self._checked(play, actions, observe)
        observations = info.pop(_ON_THE_WAY if _ON_THE_WAY in info else "observations", []) if observe else []
        # Stacked, they are copies, too: the environment may overwrite its own.
        seen = _stack([self._last_obs, *observations, obs]) if self.n_sub_options else None
        if len(observations) and not _is_finite(seen):
            raise ValueError(f"the environment {self.env} returned an observation that is not finite: {seen}")
        if not (terminated or truncated):
            self._play = play

        n_ran, total = len(rewards), float(rewards.sum())
        duration = n_ran * settings.dt
        integral = integrated_reward(rewards, settings.dt, settings.discount_rate, self.reward_unit)
        info["option"] = {
            "duration": duration,
            "n_steps": n_ran,
            "integrated_reward": integral,
            "discount": math.exp(-settings.discount_rate * duration),
        }
        if seen is not None:
            steps = [0, *observe[: len(observations)], n_ran]
            info["sub_options"] = self._sub_options(slices, trajectory, rewards, seen, steps, terminated, truncated)
            self._last_obs = _at(seen, -1)
        return obs, total if self.reward == "sum" else integral, terminated, truncated, info

    def set_n_sub_options(self, n_sub_options: int) -> None:
        """How many sub-options to hand over from now on; after a change the environment must be reset.

        :raises ValueError: if it is negative
        """
        if n_sub_options < 0:
            raise ValueError(f"n_sub_options must be at least 0, not {n_sub_options}")
        if n_sub_options != self.n_sub_options:
            self.n_sub_options = n_sub_options
            self._play = None

    def plan(self, option: npt.ArrayLike) -> np.ndarray:
        """All primitive actions of an option, in the inner environment's units.

        :param option: shape ``[action_dim · n_rbf + 1]``
        :return: shape ``[n_steps, *action_shape]``
        """
        return self._box.actions(self.option_space.plan(np.clip(plain(option), -1.0, 1.0)))

    def _checked(
        self, play: StepSequence, actions: np.ndarray, observe: Sequence[int]
    ) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        """Play actions, and look at what the environment returns; rewards as an array ``[n_steps]``."""
        try:
            obs, rewards, terminated, truncated, info = play(actions, observe) if observe else play(actions)
        except (TypeError, ValueError) as error:
            if "unpack" not in str(error):
                raise
            raise TypeError(
                f"{error}, from the environment {self.env}: step must return observation, reward, terminated, truncated and "
                "info, as Gymnasium's do; wrap one of the old Gym in shimmy.GymV21CompatibilityV0"
            ) from error
        if not isinstance(info, dict):
            raise TypeError(f"the environment {self.env} returned the info {info!r}, which must be a dictionary")
        # None and strings would pass for False and True.
        for name, value in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(value, int | np.bool_):
                raise TypeError(f"the environment {self.env} returned {name}={value!r}, which must be True or False")
        rewards = np.asarray(rewards, dtype=np.float64)
        if rewards.size != len(rewards):
            raise ValueError(f"the environment {self.env} returned rewards that are no numbers: {rewards}")
        if not np.isfinite(rewards).all():
            raise ValueError(f"the environment {self.env} returned a reward that is not finite: {rewards}")
        check_observation(self.env, obs)
        return obs, rewards.reshape(-1), terminated, truncated, info

    def _draw_slices(self, n_steps: int) -> list[tuple[int, int]]:
        """Random stretches ``(first step, step after the last)`` of an option, of at least ``d_min``, not all of it."""
        if self.n_sub_options == 0 or n_steps <= self._shortest:
            return []
        pairs = self._slice_rng.integers(0, n_steps + 1, size=(self.n_sub_options, 2))
        pairs.sort(axis=1)
        return [(first, end) for first, end in pairs.tolist() if self._shortest <= end - first < n_steps]

    def _sub_options(
        self,
        slices: list[tuple[int, int]],
        trajectory: np.ndarray,
        rewards: np.ndarray,
        seen: Stacked,
        steps: list[int],
        terminated: bool,
        truncated: bool,
    ) -> SubOptions:
        """Make transitions of the slices; at the episode's end they end with it, or are dropped.

        :param steps: after how many steps of the option each row of ``seen`` was observed
        """
        settings, n_ran = self.option_space, len(rewards)
        firsts, ends = np.array(slices, dtype=np.int64).reshape(-1, 2).T
        if n_ran < len(trajectory):
            ends = np.minimum(ends, n_ran)
            long_enough = ends - firsts >= self._shortest
            firsts, ends = firsts[long_enough], ends[long_enough]
        omega, residuals = settings.trajectory.fit(trajectory, firsts, ends)
        kept = residuals <= self.sub_option_tolerance
        if not kept.all():
            firsts, ends, omega, residuals = firsts[kept], ends[kept], omega[kept], residuals[kept]
        # R of a stretch from the discounted rewards up to its ends
        discounts = discounts_of_steps(n_ran, settings.dt, settings.discount_rate)
        total = np.zeros(n_ran + 1)
        (rewards * discounts).cumsum(out=total[1:])
        weight = step_weight(settings.dt, settings.discount_rate) if self.reward_unit == "rate" else 1.0
        lengths, at_end, rows = ends - firsts, ends == n_ran, np.array(steps)
        return SubOptions(
            seen=seen,
            begins=rows.searchsorted(firsts),
            ends=rows.searchsorted(ends),
            options=settings.encode(omega, lengths),
            durations=lengths * settings.dt,
            integrated_rewards=(total[ends] - total[firsts]) * weight / discounts[firsts],
            terminated=at_end & terminated,
            truncated=at_end & truncated,
            residuals=residuals,
        )

    def _step_in_a_loop(self, actions: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        rewards: list[float] = []
        observations = []
        step = self.env.step
        # In stretches between the observations that are wanted, so that a step costs nothing more.
        for first, last in itertools.pairwise((0, *observe, len(actions))):
            for action in actions[first:last]:
                obs, reward, terminated, truncated, info = step(action)
                rewards.append(reward)  # type: ignore[arg-type]
                if terminated or truncated:
                    break
            if terminated or truncated:
                break
            if last < len(actions):
                observations.append(deepcopy(obs))
        if observe:
            info[_ON_THE_WAY] = observations
        return obs, rewards, terminated, truncated, info


def _find_step_sequence(env: gym.Env, observing: bool) -> StepSequence | None:
    """The environment's ``step_sequence``, if no wrapper above it needs to see each step.

    :param observing: whether it must be able to observe on the way
    """
    if isinstance(env, SupportsStepSequence):
        able = not observing or "observe" in inspect.signature(env.step_sequence).parameters
        return env.step_sequence if able else None
    # Exact types: a subclass may look at every step.
    if type(env) in (OrderEnforcing, PassiveEnvChecker):
        return _find_step_sequence(env.env, observing)  # type: ignore[attr-defined]
    if type(env) is Monitor:
        inner = _find_step_sequence(env.env, observing)
        return None if inner is None else _monitored(env, inner)
    if isinstance(env, gym.Wrapper) and f"{type(env).__module__}.{type(env).__name__}" in _TIME_LIMITS:
        inner = _find_step_sequence(env.env, observing)
        return None if inner is None else _time_limited(env, inner)
    return find_rollout(env)


def _time_limited(env: gym.Wrapper, play: StepSequence) -> StepSequence:
    """Keep a TimeLimit's count over a sequence of steps that it does not see one by one."""

    def step_sequence(actions: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        limit: Any = env
        actions = actions[: max(1, limit._max_episode_steps - limit._elapsed_steps)]
        on_the_way = [k for k in observe if k < len(actions)]
        obs, rewards, terminated, truncated, info = play(actions, on_the_way) if on_the_way else play(actions)
        rewards = np.asarray(rewards, dtype=np.float64)
        limit._elapsed_steps += len(rewards) - 1
        last_step = (obs, rewards[-1], terminated, truncated, info)
        obs, _, terminated, truncated, info = _see_last_step(env, actions[len(rewards) - 1], last_step)
        return obs, rewards, terminated, truncated, info

    return step_sequence


def _monitored(monitor: Monitor, play: StepSequence) -> StepSequence:
    """Keep a Monitor's books over a sequence of steps that it does not see one by one."""

    def step_sequence(actions: np.ndarray, *observe: Sequence[int]) -> SequenceResult:
        obs, rewards, terminated, truncated, info = play(actions, *observe)
        rewards = np.asarray(rewards, dtype=np.float64)
        monitor.rewards.extend(rewards[:-1].tolist())
        monitor.total_steps += len(rewards) - 1
        last_step = (obs, rewards[-1], terminated, truncated, info)
        obs, _, terminated, truncated, info = _see_last_step(monitor, actions[len(rewards) - 1], last_step)
        return obs, rewards, terminated, truncated, info

    return step_sequence


def _see_last_step(wrapper: gym.Wrapper, action: np.ndarray, result: tuple[Any, ...]) -> tuple[Any, ...]:
    """What a wrapper's own ``step`` makes of a step that was made already."""
    env = wrapper.env
    wrapper.env = SimpleNamespace(step=lambda _: result)  # type: ignore[assignment]
    try:
        return wrapper.step(action)
    finally:
        wrapper.env = env
