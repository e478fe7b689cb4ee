"""One vector for all options that play the same actions."""

import torch as th

from sb3_ctco.options import OptionSpace


class CanonicalOptions:
    """Options of fewer steps than weights, with weights that play the same actions, and are the same for all that do.

    An option of one step plays one action, whatever number of weights it has. A critic that sees the weights must learn from
    data which of them matter; of canonical ones (:meth:`sb3_ctco.options.Trajectory.canonical`) all do. Options of at least
    as many steps as weights stay as they are.

    :param space: what options mean
    :param device: where options are
    """

    def __init__(self, space: OptionSpace, device: th.device | str):
        self._space = space
        self._matrices = th.as_tensor(space.trajectory.canonical(space.joined), dtype=th.float32, device=device)

    @staticmethod
    def makes_no_difference(space: OptionSpace) -> bool:
        """Whether even the shortest option has as many steps as weights."""
        return round(space.d_min / space.dt) >= space.trajectory.n_weights

    def __call__(self, options: th.Tensor) -> th.Tensor:
        """Canonical options, differentiable by ω.

        :param options: normalised, ``[*batch, option_dim]``
        :return: likewise
        """
        omega = options[..., :-1].unflatten(-1, (-1, self._space.trajectory.n_weights))
        return th.cat(((omega @ self._of(options).mT).flatten(-2), options[..., -1:]), dim=-1)

    def gradient(self, gradient: th.Tensor, options: th.Tensor) -> th.Tensor:
        """The gradient by options, from that by canonical ones.

        :param gradient: ``[*batch, option_dim]``
        :param options: normalised, likewise
        """
        by_omega = gradient[..., :-1].unflatten(-1, (-1, self._space.trajectory.n_weights))
        return th.cat(((by_omega @ self._of(options)).flatten(-2), gradient[..., -1:]), dim=-1)

    def _of(self, options: th.Tensor) -> th.Tensor:
        """The matrix of each option, ``[*batch, n_weights, n_weights]``."""
        n_steps = (self._space.seconds(options[..., -1].detach()) / self._space.dt + 0.5).floor().long()
        return self._matrices[n_steps.clamp(1, len(self._matrices)) - 1]
