"""Let somebody else act for a while, and record what they do."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_ctco.datasets import RecordedTrajectory
from sb3_ctco.options import INTERRUPTED, LAST_ACTION, TAKEN_OVER, stack
from sb3_ctco.wrappers.checks import reset_env
from sb3_ctco.wrappers.real_time import refuse_other_actions
from sb3_ctco.wrappers.timing import find_dt

#: ``take_over(observation)``: the action to send in place of the policy's, in the environment's units, or None
TakeOver = Callable[[Any], Any]


class TakeOverWrapper(gym.Wrapper, RecordConstructorArgs):
    """Send somebody else's actions in place of the policy's while they have taken over, and record them.

    ``take_over`` is asked as soon as there is an observation, for the step that follows. Where control passes from one to the
    other, ``info["interrupted"]`` ends the option that runs (:class:`~sb3_ctco.wrappers.RealTimeOptionWrapper`), so that no
    transition is of both. Steps of somebody else have ``info["taken_over"]``: their transitions are not the policy's.

    :param env: the environment, of primitive steps
    :param take_over: called with each observation: returns the action to send next, in the environment's units, or None to
        leave it to the policy; it must be quick
    :param record: called with what somebody else did, when they give control back and at the end of the episode
    :param dt: the interaction period, in s; by default what :func:`~sb3_ctco.wrappers.find_dt` finds
    """

    def __init__(
        self, env: gym.Env, take_over: TakeOver, record: Callable[[RecordedTrajectory], None], dt: float | None = None
    ):
        RecordConstructorArgs.__init__(self, take_over=take_over, record=record, dt=dt, _disable_deepcopy=True)
        gym.Wrapper.__init__(self, env)
        refuse_other_actions(env, "take_over")
        self.dt = find_dt(env, required_by="TakeOverWrapper", given=dt)
        self.take_over = take_over
        self.record = record
        self._next_action: np.ndarray | None = None
        self._last_obs: Any = None
        self._observations: list[Any] = []
        self._actions: list[np.ndarray] = []
        self._rewards: list[float] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; what was being recorded is handed over."""
        self.hand_over()
        obs, info = reset_env(self.env, seed, options)
        self._ask(obs)
        return obs, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the policy's action, or somebody else's."""
        other = self._next_action
        obs, reward, terminated, truncated, info = self.env.step(action if other is None else other)
        if other is not None:
            self._observations = self._observations or [self._last_obs]
            self._observations.append(deepcopy(obs))
            # A guard inside may have sent another one.
            self._actions.append(np.array(info.get(LAST_ACTION, other)))
            self._rewards.append(float(reward))
            # Whatever is inside, such as a guard, knows better what was sent.
            info = {LAST_ACTION: other, **info, TAKEN_OVER: True}
        self._ask(obs)
        if self._next_action is None or terminated or truncated:
            self.hand_over(terminated, truncated)
        if (self._next_action is None) != (other is None):
            info = {**info, INTERRUPTED: True}
        return obs, reward, terminated, truncated, info

    def hand_over(self, terminated: bool = False, truncated: bool = False) -> None:
        """Hand over what was recorded; what follows is recorded anew.

        :param terminated: whether the episode terminated with it
        :param truncated: whether it was truncated with it
        """
        if self._actions:
            seen, actions = stack(self._observations), np.array(self._actions)
            rewards = np.array(self._rewards)
            # Forgotten first, so that what cannot be recorded is not handed over again.
            self._observations, self._actions, self._rewards = [], [], []
            self.record(RecordedTrajectory(seen, actions, rewards, terminated, truncated, self.dt))

    def close(self) -> None:
        """Hand over what was being recorded, and close the environment."""
        self.hand_over()
        super().close()

    def _ask(self, obs: Any) -> None:
        given = self.take_over(obs)
        self._next_action = None
        if given is not None:
            space: Any = self.env.action_space
            action = np.asarray(given, dtype=space.dtype).reshape(space.shape)
            if not np.isfinite(action).all():
                raise ValueError(f"take_over returned {given}, which is not finite: return None to hand over")
            self._next_action = action.clip(space.low, space.high)
            self._last_obs = deepcopy(obs)
