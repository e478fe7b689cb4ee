"""Play several primitive steps in one call, where nobody needs to see each of them."""

import inspect
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from stable_baselines3.common.monitor import Monitor

SequenceResult = tuple[Any, npt.ArrayLike, bool, bool, dict[str, Any]]
StepSequence = Callable[..., SequenceResult]


@runtime_checkable
class SupportsStepSequence(Protocol):
    """An environment that can play several actions at once, without computing what nobody sees.

    ``step_sequence(actions, observe)`` is ``step`` in a loop: it plays ``actions`` (shape ``[n_steps, *action_shape]``)
    until they run out or the episode ends, and returns the last observation, the reward of each step that ran, whether
    the last step terminated or truncated the episode, and the last step's info. ``observe`` lists, in increasing order
    and below ``n_steps``, the numbers of steps after which the observation is wanted, too: ``info["observations"]`` has
    those that came before the episode's end, in a list. It is passed only if sub-options are wanted
    (``n_sub_options``); an environment whose ``step_sequence(actions)`` does not take it is stepped in a loop then, and
    always one whose class, below that which defines ``step_sequence``, defines another ``step``.
    """

    def step_sequence(self, actions: np.ndarray, observe: Sequence[int] = ()) -> SequenceResult:
        """Play actions ``[n_steps, *action_shape]``, observing after some numbers of steps."""
        ...


def find_step_sequence(env: gym.Env, observing: bool) -> StepSequence | None:
    """The environment's ``step_sequence``, if no wrapper above it needs to see each step.

    :param observing: whether it must be able to observe on the way
    """
    if isinstance(env, SupportsStepSequence):
        able = _says_the_same(env) and (not observing or "observe" in inspect.signature(env.step_sequence).parameters)
        return env.step_sequence if able else None
    # Exact types: a subclass may look at every step.
    if type(env) in (OrderEnforcing, PassiveEnvChecker):
        return find_step_sequence(env.env, observing)  # type: ignore[attr-defined]
    if type(env) is Monitor:
        inner = find_step_sequence(env.env, observing)
        return None if inner is None else partial(_play_monitored, env, inner)
    return None


def _says_the_same(env: gym.Env) -> bool:
    """Whether ``step_sequence`` knows of the ``step`` that is called: no subclass put another one in its place."""
    definers = [vars(env), *map(vars, type(env).__mro__)]
    first = {name: next((i for i, names in enumerate(definers) if name in names), 0) for name in ("step", "step_sequence")}
    return first["step_sequence"] <= first["step"]


def _play_monitored(monitor: Monitor, play: StepSequence, actions: np.ndarray, *observe: Sequence[int]) -> SequenceResult:
    """Play, and keep the Monitor's books: those of ``Monitor.step`` (Stable-Baselines3 2.9.2), of several steps at once."""
    obs, rewards, terminated, truncated, info = play(actions, *observe)
    rewards = np.asarray(rewards, dtype=np.float64)
    monitor.rewards.extend(rewards.tolist())
    monitor.total_steps += len(rewards)
    if terminated or truncated:
        monitor.needs_reset = True
        seconds = time.time() - monitor.t_start
        monitor.episode_returns.append(sum(monitor.rewards))
        monitor.episode_lengths.append(len(monitor.rewards))
        monitor.episode_times.append(seconds)
        info["episode"] = {
            "r": round(monitor.episode_returns[-1], 6),
            "l": monitor.episode_lengths[-1],
            "t": round(seconds, 6),
            **{key: info[key] for key in monitor.info_keywords},
            **monitor.current_reset_info,
        }
        if monitor.results_writer:
            monitor.results_writer.write_row(info["episode"])
    return obs, rewards, terminated, truncated, info
