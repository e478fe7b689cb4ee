"""Play options, smooth action trajectories of variable duration, in an environment with a fixed step."""

import contextlib
import itertools
import math
import traceback
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.env_util import unwrap_wrapper

from sb3_ctco.option_array import plain
from sb3_ctco.options import (
    DEFAULT_DISCOUNT_RATE,
    LAST_ACTION,
    REWARD_UNITS,
    TAKEN_OVER,
    ActionBox,
    DurationScale,
    Join,
    OptionInfo,
    OptionSpace,
    RewardUnit,
    Trajectory,
    default_durations,
    draw_stretches,
    fit_sub_options,
    integrated_reward,
    is_finite,
    rows_of,
    shortest_steps,
    stack,
    with_last_action,
    with_last_action_space,
)
from sb3_ctco.wrappers.checks import check_observation, reset_env
from sb3_ctco.wrappers.real_time import refuse_other_actions
from sb3_ctco.wrappers.reward_rate import RewardRateWrapper
from sb3_ctco.wrappers.step_sequence import SequenceResult, StepSequence, find_step_sequence
from sb3_ctco.wrappers.timing import find_dt

#: Where the loop over ``step`` leaves what it observed on the way, and the actions that were sent, so that an environment's
#: own infos stay
ON_THE_WAY = "_observations_on_the_way"


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
    Stable-Baselines3's ``Monitor`` and Gymnasium's ``OrderEnforcing`` and ``PassiveEnvChecker``, it is called in place of
    the loop over ``step``.

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
    :param n_rbf: number of weights an action dimension; 1 repeats one action
    :param d_max: longest duration, in s; by default a fifth of the horizon 1/τ, 0.5 s at most, see
        :func:`~sb3_ctco.options.default_durations`
    :param d_min: shortest duration, in s; 0 for one step (``dt``), which an option takes in any case; by default a hundredth
        of the horizon and 0.025 s at most, or a step if that is longer
    :param dt: the interaction period, in s; by default what :func:`find_dt` finds
    :param discount_rate: τ, in 1/s; by default the paper's 0.404 (a factor of 0.98 over 0.05 s)
    :param reward: what ``step`` returns as reward: ``"sum"`` of the primitive rewards, which makes returns comparable
        with an agent of fixed rate, or ``"integral"``, R, for use under an algorithm that knows nothing of options
    :param reward_unit: ``"rate"`` if rewards do not shrink with dt, ``"impulse"`` if they are paid per event
    :param n_sub_options: how many random stretches of each option, at most, to hand over as options of their own, in
        ``info["sub_options"]`` (:class:`~sb3_ctco.options.SubOptions`), for a replay buffer that learns from them
    :param sub_option_tolerance: leave out a sub-option if its actions deviate by more from those that were played;
        actions count as normalised to [−1, 1]
    :param trajectory: how ω becomes actions, a name in ``sb3_ctco.options.TRAJECTORIES`` or a class
    :param duration_scale: ``"log"`` or ``"linear"``, see :class:`~sb3_ctco.options.OptionSpace`
    :param join: ``"free"``; ``"continuous"``: an option leaves from the action that is being sent when it begins; or
        ``"smooth"``: there, and with the slope at which actions were changing. What it leaves from, normalised, is then part
        of the observation (:mod:`sb3_ctco.options.joins`); an episode begins with the middle of the box, at rest. Where the
        environment's info has a ``"last_action"``, after ``reset`` or after a step in which something else was sent than it
        was given, that is taken, in the environment's units
    :raises TypeError: if the action space is not a ``Box`` of real numbers
    :raises ValueError: if its bounds are not finite, a setting is out of range, or dt is not given and not found
    """

    action_space: spaces.Box  # type: ignore[assignment, override]

    #: Whether ``dt`` was given and is another than what the environment tells of itself
    overrides_dt = False
    #: Calls of ``reset`` and ``step``: more of them tell a model that somebody else used its environment
    n_calls = 0

    def __init__(
        self,
        env: gym.Env,
        n_rbf: int = 2,
        d_max: float | None = None,
        d_min: float | None = None,
        dt: float | None = None,
        discount_rate: float = DEFAULT_DISCOUNT_RATE,
        reward: Literal["sum", "integral"] = "sum",
        reward_unit: RewardUnit = "rate",
        n_sub_options: int = 0,
        sub_option_tolerance: float = 0.1,
        trajectory: str | type[Trajectory] = "bezier",
        duration_scale: DurationScale = "log",
        join: Join = "free",
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
            join=join,
        )
        gym.Wrapper.__init__(self, env)

        if unwrap_wrapper(env, OptionExecutionWrapper) is not None:
            raise ValueError(f"the environment {env} plays options already: wrap it once")
        if reward_unit == "rate" and unwrap_wrapper(env, RewardRateWrapper) is not None:
            raise ValueError(
                f"the environment {env} has a RewardRateWrapper, which integrates rewards over a step, and options integrate "
                "them once more: wrap the environment inside it, or pass reward_unit='impulse'"
            )
        if join != "free":
            refuse_other_actions(env, f"join={join!r}")
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(
                f"OptionExecutionWrapper needs a Box action space, not {space}: options are trajectories of continuous actions"
            )
        if not np.issubdtype(space.dtype, np.floating):
            raise TypeError(
                f"OptionExecutionWrapper needs actions that are real numbers, not {space}: options are trajectories of "
                "continuous actions, which whole numbers would round to zero"
            )
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise ValueError(
                f"OptionExecutionWrapper needs finite action bounds, not {space}: "
                "wrap the environment with gymnasium.wrappers.TransformAction(env, lambda action: action, "
                "Box(low, high)), or give its space bounds"
            )
        if reward not in ("sum", "integral"):
            raise ValueError(f"reward must be 'sum' or 'integral', not {reward!r}")
        if reward_unit not in REWARD_UNITS:
            raise ValueError(f"reward_unit must be one of {REWARD_UNITS}, not {reward_unit!r}")
        if not sub_option_tolerance >= 0:
            raise ValueError(f"sub_option_tolerance must be at least 0, not {sub_option_tolerance}")
        if dt is not None:
            with contextlib.suppress(Exception):  # An environment may tell nonsense, which a given dt corrects.
                told = find_dt(env)
                self.overrides_dt = told is not None and not math.isclose(told, dt, rel_tol=1e-6)
        dt = find_dt(env, required_by="OptionExecutionWrapper", given=dt)
        shortest, longest = default_durations(discount_rate)
        d_min = max(shortest, dt) if d_min is None else d_min or dt
        d_max = longest if d_max is None else d_max
        #: The settings that a policy for this environment must share.
        self.option_space = OptionSpace.make(n_rbf, d_max, d_min, dt, discount_rate, trajectory, duration_scale, join)
        self.reward: Literal["sum", "integral"] = reward
        self.reward_unit: RewardUnit = reward_unit

        #: The action space of the environment inside.
        self.primitive_action_space = space
        self._box = ActionBox(space.low, space.high)
        option_dim = space.low.size * n_rbf + 1
        self.action_space = spaces.Box(-1.0, 1.0, (option_dim,), np.float32)
        if self.option_space.joined:
            n_numbers = self.option_space.n_before * space.low.size
            self.observation_space = with_last_action_space(env.observation_space, n_numbers)
        #: The actions of the last option that ran, in the inner environment's units, ``[n_ran, *action_shape]``
        self.played = np.empty((0, *space.shape), space.dtype)
        #: What an option leaves from, ``[n_before · action_dim]``; None with a free join
        self._before: np.ndarray | None = None
        #: The last two actions of which that tells, normalised
        self._last_two = np.zeros((2, space.low.size))
        self._play: StepSequence | None = None

        self.n_sub_options = 0
        self.set_n_sub_options(n_sub_options)
        self.sub_option_tolerance = sub_option_tolerance
        # A generator of its own, so that sub-options change nothing in what the environment does.
        self._stretch_rng = np.random.default_rng()
        self._last_obs: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the inner environment.

        :raises TypeError: if the environment does not return an observation and an info
        :raises ValueError: if the observation is not finite, or not as its space says
        """
        self.n_calls += 1
        self._play = None
        result = reset_env(self.env, seed, options)
        if seed is not None:
            self._stretch_rng = np.random.default_rng(seed)
        self._last_obs = deepcopy(result[0]) if self.n_sub_options else result[0]
        self._play = self._choose_play()
        if not self.option_space.joined:
            return result
        obs, info = result
        self._last_two = np.zeros((2, self._box.low.size))
        if LAST_ACTION in info:
            self._last_two = self._box.normalise([info[LAST_ACTION]] * 2).clip(-1.0, 1.0)
        self._before = self.option_space.before(self._last_two)[-1]
        return with_last_action(self.observation_space, obs, self._before), info

    def _choose_play(self) -> StepSequence:
        """What plays an option's actions until the episode ends."""
        return find_step_sequence(self.env, self.n_sub_options > 0) or self._step_in_a_loop

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
        self.n_calls += 1
        given = np.asarray(plain(action), dtype=np.float64)
        option = given.ravel()
        if option.shape != self.action_space.shape:
            raise ValueError(f"an option here has shape {self.action_space.shape} (ω, then d), not {given.shape}")
        if not np.isfinite(option).all():
            raise ValueError(f"an option must be finite, not {option}")
        if self._play is None:
            raise ResetNeeded("call reset() first: the environment was not reset, its episode ended, or it raised an error")
        play, self._play = self._play, None

        space = self.option_space
        before = self._before
        trajectory = space.plan(option.clip(-1.0, 1.0), before)
        n_steps = len(trajectory)
        stretches = self._draw_stretches(n_steps)
        observe = sorted({k for ends in stretches for k in ends} - {0, n_steps})
        actions = self._box.actions(trajectory)
        obs, rewards, terminated, truncated, info = self._checked(play, actions, observe)
        n_ran = len(rewards)
        self.played = actions[:n_ran]
        if ON_THE_WAY in info:
            on_the_way, sent = info.pop(ON_THE_WAY)
        else:
            on_the_way = list(info.pop("observations", []))[: len(observe)] if observe else []
            sent = [*actions[: n_ran - 1], info[LAST_ACTION]] if LAST_ACTION in info else actions[:n_ran]
        # Stacked, they are copies, too: the environment may overwrite its own.
        seen = stack([self._last_obs, *on_the_way, obs]) if self.n_sub_options else None
        if on_the_way and not is_finite(seen):
            raise ValueError(f"the environment {self.env} returned an observation that is not finite: {seen}")
        if not (terminated or truncated):
            self._play = play

        if before is not None:
            since = np.vstack([self._last_two, self._box.normalise(sent).clip(-1.0, 1.0)])
            self._last_two, befores = since[-2:], space.before(since)
            self._before = befores[-1]
            obs = with_last_action(self.observation_space, obs, self._before)
        integral = integrated_reward(rewards, space.dt, space.discount_rate, self.reward_unit)
        info["option"] = OptionInfo(
            duration=n_ran * space.dt,
            n_steps=n_ran,
            integrated_reward=integral,
            discount=math.exp(-space.discount_rate * n_ran * space.dt),
        )
        if seen is not None:
            steps = [0, *observe[: len(on_the_way)], n_ran]
            self._last_obs = rows_of(seen, -1)
            if before is not None:
                before = befores[[*steps[:-1], -1]]
                # Where there is nothing to say, what was sent before says 0.
                trajectory = np.where(self._box.is_fixed, 0.0, trajectory)
                seen = with_last_action(self.observation_space, seen, before)
            played, ended = (trajectory, rewards, stretches, steps, seen), (terminated, truncated)
            info["sub_options"] = fit_sub_options(space, *played, *ended, self.reward_unit, self.sub_option_tolerance, before)
        return obs, float(rewards.sum()) if self.reward == "sum" else integral, terminated, truncated, info

    def set_n_sub_options(self, n_sub_options: int) -> None:
        """How many sub-options to hand over from now on; after a change the environment must be reset.

        :raises ValueError: if it is negative, or not a whole number
        """
        if isinstance(n_sub_options, bool) or not isinstance(n_sub_options, int | np.integer) or n_sub_options < 0:
            raise ValueError(f"n_sub_options must be a whole number of at least 0, not {n_sub_options}")
        if n_sub_options != self.n_sub_options:
            self.n_sub_options = n_sub_options
            self._play = None

    def _draw_stretches(self, n_steps: int) -> list[tuple[int, int]]:
        return draw_stretches(self._stretch_rng, self.n_sub_options, n_steps, shortest_steps(self.option_space))

    def plan(self, option: npt.ArrayLike) -> np.ndarray:
        """All primitive actions of an option that begins now, in the inner environment's units.

        :param option: shape ``[action_dim · n_rbf + 1]``
        :return: shape ``[n_steps, *action_shape]``
        """
        return self._box.actions(self.option_space.plan(np.clip(plain(option), -1.0, 1.0), self._before))

    def _checked(
        self, play: StepSequence, actions: np.ndarray, observe: Sequence[int]
    ) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        """Play actions, and look at what the environment returns; rewards as an array ``[n_steps]``."""
        try:
            obs, rewards, terminated, truncated, info = play(actions, observe) if observe else play(actions)
        except (TypeError, ValueError) as error:
            *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
            # Where a wrapper unpacks what a step returned. What fails within the environment's own step says what it is.
            package, *_ = innermost.f_globals["__name__"].split(".")
            if "unpack" not in str(error) or package not in ("gymnasium", "stable_baselines3", "sb3_ctco"):
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

    def _step_in_a_loop(self, actions: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        rewards: list[float] = []
        on_the_way = []
        joined = self.option_space.joined
        sent = actions.astype(np.float64) if joined else actions
        step = self.env.step
        # In stretches between the observations that are wanted, so that a step costs nothing more.
        for first, last in itertools.pairwise((0, *observe, len(actions))):
            for action in actions[first:last]:
                obs, reward, terminated, truncated, info = step(action)
                # A copy, as an environment may return the same array once more.
                rewards.append(reward.copy() if isinstance(reward, np.ndarray) else reward)  # type: ignore[arg-type]
                if joined and LAST_ACTION in info:
                    sent[len(rewards) - 1] = info[LAST_ACTION]
                # What was sent in place of an action ends its option, as the end of an episode does.
                ended = terminated or truncated or (isinstance(info, dict) and info.get(TAKEN_OVER))
                if ended:
                    break
            if ended:
                break
            if last < len(actions):
                on_the_way.append(deepcopy(obs))
        if observe or joined:
            info[ON_THE_WAY] = on_the_way, sent[: len(rewards)]
        return obs, rewards, terminated, truncated, info
