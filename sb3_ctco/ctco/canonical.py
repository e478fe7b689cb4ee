"""One vector for all options that play the same actions."""

import numpy as np
import torch as th

from sb3_ctco.options import OptionSpace, steps_in


class CanonicalOptions:
    """Options as critics see them: the same vector for all that play the same actions.

    An option of one step plays one action, whatever number of weights it has, and for as long as a step takes, whatever its
    duration was before it was rounded. A critic that sees the options as they are must learn from data what of them matters;
    of canonical ones (:meth:`sb3_ctco.options.Trajectory.canonical`) all does. Weights of options of at least as many steps as
    weights stay as they are.

    :param space: what options mean
    :param device: where options are
    """

    def __init__(self, space: OptionSpace, device: th.device | str):
        self._n_weights = space.trajectory.n_weights
        n_steps = np.arange(1, steps_in(space.d_max, space.dt) + 1)
        matrices = space.trajectory.canonical(space.n_before)
        #: Of options of each number of steps: the matrix, and the last entry
        self._matrices = th.as_tensor(matrices[n_steps.clip(max=len(matrices)) - 1], dtype=th.float32, device=device)
        self._durations = th.as_tensor(space.normalised(n_steps * space.dt), dtype=th.float32, device=device)
        # From where on the last entry stands for one step more; where all options are of one duration, it always does.
        bounds = space.normalised((n_steps[1:] - 0.5) * space.dt) if space.d_max > space.d_min else -np.ones(len(n_steps) - 1)
        self._bounds = th.as_tensor(bounds, dtype=th.float32, device=device)

    @staticmethod
    def makes_no_difference(space: OptionSpace) -> bool:
        """Whether even the shortest option has as many steps as weights; then the rounding of durations is small, too."""
        return steps_in(space.d_min, space.dt) >= space.trajectory.n_weights

    def __call__(self, options: th.Tensor) -> th.Tensor:
        """Canonical options, differentiable by ω, and by d as if it were not rounded.

        :param options: normalised, ``[*batch, option_dim]``
        :return: likewise
        """
        omega, d = options[..., :-1].unflatten(-1, (-1, self._n_weights)), options[..., -1:]
        index = self._index(options)
        rounded = self._durations[index][..., None]
        return th.cat(((omega @ self._matrices[index].mT).flatten(-2), d + (rounded - d).detach()), dim=-1)

    def gradient(self, gradient: th.Tensor, options: th.Tensor) -> th.Tensor:
        """The gradient by options, from that by canonical ones.

        :param gradient: ``[*batch, option_dim]``
        :param options: normalised, likewise
        """
        by_omega = gradient[..., :-1].unflatten(-1, (-1, self._n_weights))
        return th.cat(((by_omega @ self._matrices[self._index(options)]).flatten(-2), gradient[..., -1:]), dim=-1)

    def _index(self, options: th.Tensor) -> th.Tensor:
        """How many steps each option has, less one."""
        return th.bucketize(options[..., -1].detach().contiguous(), self._bounds, right=True)
