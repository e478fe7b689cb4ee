"""Time accounting: callbacks that see primitive steps while the algorithm takes decisions."""

from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback


class PrimitiveStepCallback(BaseCallback):
    """Call a callback once a primitive step, although the algorithm calls this one once a decision.

    Stable-Baselines3 counts calls of ``env.step``, which are decisions here. This callback corrects the algorithm's
    ``num_timesteps`` to primitive steps, and ticks its child as often as an agent of fixed rate would have: so
    evaluations, checkpoints and the child's ``num_timesteps`` fall where they would for SAC. What a decision brought
    (``dones``, ``rewards`` and ``infos`` in the child's locals) is shown at its last tick only.

    With several environments one tick stands for a primitive step in each of them, as in Stable-Baselines3; options
    of different lengths are averaged, and the remainder is carried over.

    :param callback: the user's callback; None if there is none
    """

    def __init__(self, callback: BaseCallback | None):
        super().__init__()
        self.callback = callback

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
        after = before + sum(info["option"]["n_steps"] for info in self.locals["infos"])
        continue_training = self._tick(before // n_envs, after // n_envs, n_envs)
        self.model.num_timesteps = after
        self.n_calls += 1
        self.num_timesteps = after
        return continue_training

    def _tick(self, first: int, last: int, n_envs: int) -> bool:
        if self.callback is None:
            return True
        decision = {key: self.locals[key] for key in ("dones", "rewards", "infos")}
        nothing: dict[str, Any] = {
            "dones": np.zeros_like(decision["dones"]),
            "rewards": np.zeros_like(decision["rewards"]),
            "infos": [{} for _ in range(n_envs)],
        }
        self.callback.update_locals({**self.locals, **nothing})
        for tick in range(first + 1, last + 1):
            if tick == last:
                self.callback.update_locals(decision)
            self.model.num_timesteps = tick * n_envs
            if not self.callback.on_step():
                return False
        return True

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
