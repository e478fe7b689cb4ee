"""Time accounting: callbacks that see primitive steps while the algorithm takes decisions."""

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_ctco.options import PENDING


def eval_callbacks(callback: BaseCallback | None) -> Iterator[EvalCallback]:
    """The callbacks that evaluate, also those that others contain."""
    if isinstance(callback, EvalCallback):
        yield callback
        yield from eval_callbacks(callback.callback_on_new_best)
    children = callback.callbacks if isinstance(callback, CallbackList) else []
    for child in [*children, callback.callback] if isinstance(callback, EventCallback) else children:
        yield from eval_callbacks(child)


def wrap_each(env: DummyVecEnv, wrap: Callable[[gym.Env], gym.Env]) -> DummyVecEnv:
    """An EvalCallback's environments, which it was given bare, wrapped; with the seed that they were given."""
    wrapped = DummyVecEnv([lambda inner=inner: wrap(inner) for inner in env.envs])  # type: ignore[misc]
    if env._seeds[0] is not None:
        wrapped.seed(env._seeds[0])
    return wrapped


def as_callback(callback: MaybeCallback) -> BaseCallback | None:
    """What ``learn`` accepts as one callback: a list of them, or a function, as Stable-Baselines3 takes it."""
    if isinstance(callback, list):
        return CallbackList(callback)
    return callback if callback is None or isinstance(callback, BaseCallback) else ConvertCallback(callback)


def in_primitive_steps(callback: BaseCallback | None, progress_bar: bool) -> CallbackList:
    """A user's callback that sees primitive steps, and the progress bar that does."""
    return CallbackList([PrimitiveStepCallback(callback), *([OptionProgressBarCallback()] if progress_bar else [])])


class WithinRollout(BaseCallback):
    """What a rollout of several pieces shows its callback of each: the steps, and not where a piece begins and ends.

    :param callback: that of the whole rollout
    """

    def __init__(self, callback: BaseCallback):
        super().__init__()
        self.callback = callback

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Hand on the locals of the piece."""
        self.callback.update_locals(locals_)

    def on_step(self) -> bool:
        """Hand on the step."""
        return self.callback.on_step()

    def _on_step(self) -> bool:
        return True


class PrimitiveStepCallback(BaseCallback):
    """Call a callback once a primitive step, although the algorithm calls this one once a decision.

    Stable-Baselines3 counts calls of ``env.step``, which are decisions here. This callback corrects the algorithm's
    ``num_timesteps`` to primitive steps, and ticks its child as often as an agent of fixed rate would have: so
    evaluations, checkpoints and the child's ``num_timesteps`` fall where they would for SAC. What a decision brought
    (``dones``, ``rewards`` and ``infos`` in the child's locals) is shown at its last tick only.

    With several environments one tick stands for a primitive step in each of them, as in Stable-Baselines3; options
    of different lengths are averaged, and the remainder is carried over; what options brought that end one by one
    (:class:`~sb3_ctco.vec_env.AsyncOptionVecEnv`) is shown together, at the next tick.

    :param callback: the user's callback; None if there is none
    """

    def __init__(self, callback: BaseCallback | None):
        super().__init__()
        self.callback = callback
        self._unseen: deque[dict[str, Any]] = deque()

    def init_callback(self, model: BaseAlgorithm) -> None:
        """Initialise the child, too."""
        super().init_callback(model)
        if self.callback is not None:
            self.callback.init_callback(model)

    def _on_training_start(self) -> None:
        if self.callback is not None:
            # A copy, because the child is shown other locals between the ticks.
            self.callback.on_training_start(dict(self.locals), self.globals)

    def _on_rollout_start(self) -> None:
        if self.callback is not None:
            self.callback.on_rollout_start()

    def on_step(self) -> bool:
        """One decision: tick the child, and count primitive steps.

        :return: False if the child wants training to stop
        """
        n_envs = self.training_env.num_envs
        # collect_rollouts has counted this decision as one step of each environment.
        before = self.model.num_timesteps - n_envs
        after = before + sum(info["option"]["n_steps"] for info in self.locals["infos"] if "option" in info)
        continue_training = self._tick(before // n_envs, after // n_envs, n_envs)
        self.model.num_timesteps = after
        self.n_calls += 1
        self.num_timesteps = after
        return continue_training

    def _tick(self, first: int, last: int, n_envs: int) -> bool:
        if self.callback is None:
            return True
        self._add_unseen({key: self.locals[key] for key in ("dones", "rewards", "infos")})
        nothing: dict[str, Any] = {
            "dones": np.zeros(n_envs, dtype=bool),
            "rewards": np.zeros_like(self.locals["rewards"]),
            "infos": [{} for _ in range(n_envs)],
        }
        self.callback.update_locals({**self.locals, **nothing})
        for tick in range(first + 1, last + 1):
            if self._unseen and last - tick < len(self._unseen):
                self.callback.update_locals(self._unseen.popleft())
            self.model.num_timesteps = tick * n_envs
            if not self.callback.on_step():
                return False
        return True

    def _add_unseen(self, decision: dict[str, Any]) -> None:
        """Options that end one by one (AsyncOptionVecEnv) may take fewer steps than there are environments: no tick."""
        pending = [PENDING in info for info in decision["infos"]]
        if self._unseen and all(p or PENDING in info for p, info in zip(pending, self._unseen[-1]["infos"], strict=True)):
            last = self._unseen[-1]
            for i in np.flatnonzero(np.logical_not(pending)):
                last["dones"][i], last["rewards"][i], last["infos"][i] = (decision[key][i] for key in decision)
        else:
            self._unseen.append(decision)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.callback is not None:
            self.callback.on_rollout_end()

    def _on_training_end(self) -> None:
        if self.callback is not None:
            self.callback.on_training_end()


class OptionProgressBarCallback(ProgressBarCallback):
    """Stable-Baselines3's progress bar, moved by as many primitive steps as a decision took."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._shown = self.num_timesteps

    def _on_step(self) -> bool:
        self.pbar.update(self.num_timesteps - self._shown)
        self._shown = self.num_timesteps
        return True
