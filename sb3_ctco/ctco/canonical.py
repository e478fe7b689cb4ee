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
        self._space = space
        self._matrices = th.as_tensor(space.trajectory.canonical(space.n_before), dtype=th.float32, device=device)
        n_steps = np.arange(1, steps_in(space.d_max, space.dt) + 1)
        no_weights = np.empty((len(n_steps), 0, space.trajectory.n_weights))
        self._durations = th.as_tensor(space.encode(no_weights, n_steps)[:, -1], device=device)

    @staticmethod
    def makes_no_difference(space: OptionSpace) -> bool:
        """Whether even the shortest option has as many steps as weights; then the rounding of durations is small, too."""
        return round(space.d_min / space.dt) >= space.trajectory.n_weights

    def __call__(self, options: th.Tensor) -> th.Tensor:
        """Canonical options, differentiable by ω, and by d as if it were not rounded.

        :param options: normalised, ``[*batch, option_dim]``
        :return: likewise
        """
        omega, d = options[..., :-1].unflatten(-1, (-1, self._space.trajectory.n_weights)), options[..., -1:]
        n_steps = self._n_steps(options)
        rounded = self._durations[n_steps - 1][..., None]
        return th.cat(((omega @ self._of(n_steps).mT).flatten(-2), d + (rounded - d).detach()), dim=-1)

    def gradient(self, gradient: th.Tensor, options: th.Tensor) -> th.Tensor:
        """The gradient by options, from that by canonical ones.

        :param gradient: ``[*batch, option_dim]``
        :param options: normalised, likewise
        """
        by_omega = gradient[..., :-1].unflatten(-1, (-1, self._space.trajectory.n_weights))
        return th.cat(((by_omega @ self._of(self._n_steps(options))).flatten(-2), gradient[..., -1:]), dim=-1)

    def _n_steps(self, options: th.Tensor) -> th.Tensor:
        n_steps = (self._space.seconds(options[..., -1].detach()) / self._space.dt + 0.5).floor().long()
        return n_steps.clamp(1, len(self._durations))

    def _of(self, n_steps: th.Tensor) -> th.Tensor:
        """The matrix of each option, ``[*batch, n_weights, n_weights]``."""
        return self._matrices[n_steps.clamp(max=len(self._matrices)) - 1]
