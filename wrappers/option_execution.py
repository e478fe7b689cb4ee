"""Play options, smooth action trajectories of variable duration, in an environment with a fixed step."""

from collections.abc import Callable
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

from sb3_ctco.options import (
    DEFAULT_DISCOUNT_RATE,
    REWARD_UNITS,
    OptionSettings,
    RewardUnit,
    action_plan,
    discount,
    integrated_reward,
    primitive_actions,
)

SequenceResult = tuple[Any, npt.ArrayLike, bool, bool, dict[str, Any]]
StepSequence = Callable[[np.ndarray], SequenceResult]


@runtime_checkable
class SupportsStepSequence(Protocol):
    """An environment that can play several actions at once, without computing what nobody sees.

    ``step_sequence(actions)`` is ``step`` in a loop: it plays ``actions`` (shape ``[n_steps, *action_shape]``) until
    they run out or the episode ends, and returns the last observation, the reward of each step that ran, whether the
    last step terminated or truncated the episode, and the last step's info.
    """

    def step_sequence(self, actions: np.ndarray) -> SequenceResult:
        """Play actions ``[n_steps, *action_shape]``."""
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
    Stable-Baselines3's ``Monitor`` and Gymnasium's ``OrderEnforcing`` and ``PassiveEnvChecker``, it is called in
    place of the loop over ``step``.

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
    :raises TypeError: if the action space is not a ``Box``
    :raises ValueError: if its bounds are not finite, a setting is out of range, or dt is not given and not found
    """

    action_space: spaces.Box  # type: ignore[assignment, override]

    def __init__(
        self,
        env: gym.Env,
        n_rbf: int = 3,
        d_max: float = 1.0,
        d_min: float | None = None,
        dt: float | None = None,
        discount_rate: float = DEFAULT_DISCOUNT_RATE,
        reward: Literal["sum", "integral"] = "sum",
        reward_unit: RewardUnit = "rate",
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
        if dt is None:
            dt = find_dt(env)
        if dt is None:
            raise ValueError(
                f"{env} does not tell its interaction period (no unwrapped.dt, control_timestep() or "
                "metadata['render_fps']): pass dt, in seconds, to OptionExecutionWrapper"
            )
        #: The settings that a policy for this environment must share.
        self.option_settings = OptionSettings(
            n_rbf=n_rbf, d_max=d_max, d_min=dt if d_min is None else d_min, dt=dt, discount_rate=discount_rate
        )
        self.reward: Literal["sum", "integral"] = reward
        self.reward_unit: RewardUnit = reward_unit

        #: The action space of the environment inside.
        self.primitive_action_space = space
        option_dim = space.low.size * n_rbf + 1
        self.action_space = spaces.Box(-1.0, 1.0, (option_dim,), np.float32)
        self._checks_observation = isinstance(env.observation_space, spaces.Box) and np.issubdtype(
            env.observation_space.dtype, np.floating
        )
        self._play: StepSequence | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the inner environment."""
        result = self.env.reset(seed=seed, options=options)
        self._play = _find_step_sequence(self.env) or self._step_in_a_loop
        return result

    def step(self, action: npt.ArrayLike) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Play one option.

        :param action: the option, shape ``[action_dim · n_rbf + 1]``
        :raises gymnasium.error.ResetNeeded: before the first reset, after the end of an episode, and after an error
            in the middle of an option
        :raises ValueError: if the option has another shape or is not finite, or if the environment returned a reward
            or an observation that is not finite
        """
        option = np.asarray(action, dtype=np.float64).ravel()
        if option.shape != self.action_space.shape:
            raise ValueError(f"an option here has shape {self.action_space.shape} (ω, then d), not {np.shape(action)}")
        if not np.isfinite(option).all():
            raise ValueError(f"an option must be finite, not {option}")
        if self._play is None:
            raise ResetNeeded("call reset() first: the environment was not reset, its episode ended, or it raised an error")
        play, self._play = self._play, None

        obs, rewards, terminated, truncated, info = play(self.plan(option))

        rewards = np.asarray(rewards, dtype=np.float64)
        if not np.isfinite(rewards).all():
            raise ValueError(f"the environment {self.env} returned a reward that is not finite: {rewards}")
        if self._checks_observation and not np.isfinite(obs).all():
            raise ValueError(f"the environment {self.env} returned an observation that is not finite: {obs}")
        if not (terminated or truncated):
            self._play = play

        settings = self.option_settings
        duration = len(rewards) * settings.dt
        integral = integrated_reward(rewards, settings.dt, settings.discount_rate, self.reward_unit)
        info["option"] = {
            "duration": duration,
            "n_steps": len(rewards),
            "integrated_reward": integral,
            "discount": float(discount(duration, settings.discount_rate)),
        }
        return obs, float(rewards.sum()) if self.reward == "sum" else integral, terminated, truncated, info

    def plan(self, option: np.ndarray) -> np.ndarray:
        """All primitive actions of an option, in the inner environment's units.

        :param option: shape ``[action_dim · n_rbf + 1]``
        :return: shape ``[n_steps, *action_shape]``
        """
        omega, n_steps = self.option_settings.decode(np.clip(option, -1.0, 1.0))
        return primitive_actions(
            action_plan(omega, n_steps), self.primitive_action_space.low, self.primitive_action_space.high
        )

    def _step_in_a_loop(self, actions: np.ndarray) -> SequenceResult:
        rewards: list[float] = []
        step = self.env.step
        for action in actions:
            obs, reward, terminated, truncated, info = step(action)
            rewards.append(reward)  # type: ignore[arg-type]
            if terminated or truncated:
                break
        return obs, rewards, terminated, truncated, info


def _find_step_sequence(env: gym.Env) -> StepSequence | None:
    """The environment's ``step_sequence``, if no wrapper above it needs to see each step."""
    if isinstance(env, SupportsStepSequence):
        return env.step_sequence
    # Exact types: a subclass may look at every step.
    if type(env) in (OrderEnforcing, PassiveEnvChecker):
        return _find_step_sequence(env.env)  # type: ignore[attr-defined]
    if type(env) is Monitor:
        inner = _find_step_sequence(env.env)
        return None if inner is None else _monitored(env, inner)
    return None


def _monitored(monitor: Monitor, play: StepSequence) -> StepSequence:
    """Keep a Monitor's books over a sequence of steps that it does not see one by one."""

    def step_sequence(actions: np.ndarray) -> SequenceResult:
        obs, rewards, terminated, truncated, info = play(actions)
        rewards = np.asarray(rewards, dtype=np.float64)
        monitor.rewards.extend(rewards[:-1].tolist())
        monitor.total_steps += len(rewards) - 1
        # Monitor's own step closes the books of the last step, and of the episode if it ended there.
        env, last_step = monitor.env, (obs, rewards[-1], terminated, truncated, info)
        monitor.env = SimpleNamespace(step=lambda _: last_step)  # type: ignore[assignment]
        try:
            obs, _, terminated, truncated, info = monitor.step(actions[len(rewards) - 1])
        finally:
            monitor.env = env
        return obs, rewards, terminated, truncated, info

    return step_sequence
