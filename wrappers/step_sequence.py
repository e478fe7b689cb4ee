"""Play several primitive steps in one call, where nobody needs to see each of them."""

import inspect
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from stable_baselines3.common.monitor import Monitor

from sb3_ctco.wrappers.gymnasium_mujoco import find_rollout

SequenceResult = tuple[Any, npt.ArrayLike, bool, bool, dict[str, Any]]
StepSequence = Callable[..., SequenceResult]

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


def find_step_sequence(env: gym.Env, observing: bool) -> StepSequence | None:
    """The environment's ``step_sequence``, if no wrapper above it needs to see each step.

    :param observing: whether it must be able to observe on the way
    """
    if isinstance(env, SupportsStepSequence):
        able = not observing or "observe" in inspect.signature(env.step_sequence).parameters
        return env.step_sequence if able else None
    # Exact types: a subclass may look at every step.
    if type(env) in (OrderEnforcing, PassiveEnvChecker):
        return find_step_sequence(env.env, observing)  # type: ignore[attr-defined]
    if type(env) is Monitor:
        inner = find_step_sequence(env.env, observing)
        return None if inner is None else _monitored(env, inner)
    if isinstance(env, gym.Wrapper) and f"{type(env).__module__}.{type(env).__name__}" in _TIME_LIMITS:
        inner = find_step_sequence(env.env, observing)
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
