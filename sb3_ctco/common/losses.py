"""Every loss of the soft actor-critic algorithms here, as functions of tensors.

Equations are those of Karimi et al. 2023, https://arxiv.org/abs/2212.04407, unless another paper is named.
"""

import math
from typing import Literal

import torch as th

EntropyReference = Literal["average", "uniform", "paper"]
ENTROPY_REFERENCES: tuple[EntropyReference, ...] = ("average", "uniform", "paper")
Pessimism = Literal["decision", "time"]
PESSIMISMS: tuple[Pessimism, ...] = ("decision", "time")


def critic_target(
    integrated_rewards: th.Tensor,
    dones: th.Tensor,
    discounts: th.Tensor,
    next_q_values: th.Tensor,
    next_entropy_costs: th.Tensor,
    high_freq_penalty: float = 0.0,
) -> th.Tensor:
    """``R − β_h + γ(d)·(Q̂_χ'(s', ω', d') − β_E log π(ω', d'|s'))``, the target in CTCO's L_Q (after equation (6)).

    All tensors are ``[batch, 1]``.

    :param integrated_rewards: R
    :param dones: 1 where the episode terminated (not where it was truncated)
    :param discounts: γ(d) = e^(−τ·duration)
    :param next_q_values: target Q-value of an option of the target policy, see :func:`pessimistic_values`
    :param next_entropy_costs: β_E log π of that option
    :param high_freq_penalty: β_h
    """
    return integrated_rewards - high_freq_penalty + (1.0 - dones) * discounts * (next_q_values - next_entropy_costs)


def pessimistic_values(next_q_values: th.Tensor, discounts: th.Tensor, pessimism: Pessimism) -> th.Tensor:
    """What critics that disagree say of the next option, in targets: ``[batch, 1]``.

    ``"decision"``: the smallest value, as in SAC (clipped double Q-learning, Fujimoto et al. 2018,
    https://arxiv.org/abs/1802.09477). Every decision pays for the disagreement, many short options more often than few long.

    ``"time"``: ``mean − (1 − γ(d))/⟨1 − γ(d)⟩·(mean − smallest)``, where ⟨⟩ is the average over the batch. An option pays for
    the share of the future that it takes, so that it is as much in all however the time is divided. Where all options have
    one length it is the smallest value.

    :param next_q_values: ``[n_critics, batch, 1]``
    :param discounts: γ(d) < 1 of the options that led there, ``[batch, 1]``
    """
    smallest = next_q_values.amin(dim=0)
    if pessimism == "decision":
        return smallest
    mean, share = next_q_values.mean(dim=0), 1.0 - discounts
    return mean - share / share.mean() * (mean - smallest)


def critic_loss(q_values: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """L_Q of CTCO's paper, as Stable-Baselines3's SAC scales it: half the mean square error, summed over critics.

    :param q_values: ``[n_critics, batch, 1]``
    :param targets: ``[batch, 1]``
    """
    return 0.5 * (q_values - targets).square().mean(dim=(1, 2)).sum()


def actor_loss(q_values: th.Tensor, entropy_costs: th.Tensor) -> th.Tensor:
    """L_π, equation (8) of the paper: its gradient runs through ω and d of reparameterised options.

    :param q_values: ``[n_critics, batch, 1]``, of options that the policy sampled
    :param entropy_costs: β_E log π of those options, ``[batch, 1]``
    """
    return (entropy_costs - q_values.amin(dim=0)).mean()


def log_reference_density(sizes: th.Tensor, d_min: float, d_max: float, reference: EntropyReference) -> th.Tensor | None:
    """Log-density of what entropy is counted relative to, over the normalised option box.

    ``"average"`` is the batch's own average of log π, which is not known beforehand: None. Entropy then adds
    nothing, on average, to what a decision costs.
    ``"uniform"`` is the uniform distribution over all options: log π − log u is never negative on average, so
    a decision is never paid for its entropy, and a policy of little entropy pays for each decision.
    ``"paper"`` is the unit density over (ω, d in s): log π as it stands.

    :param sizes: how many entries of an option each density is of, the duration being the last, ``[n + 1]``
    :return: likewise, or None for ``"average"``
    """
    if reference == "average":
        return None
    if reference == "uniform":
        return -sizes * math.log(2.0)
    density = th.zeros_like(sizes)
    # A duration in s has (d_max − d_min)/2 of the length of the box [−1, 1].
    density[-1] = math.log((d_max - d_min) / 2.0) if d_max > d_min else 0.0
    return density


def repetition_values(q_values: th.Tensor, repetition_log_probs: th.Tensor, duration_ent_coef: th.Tensor) -> th.Tensor:
    """Σ_k π_x(k|s)·(min_i Q_i(s, a)_k − α_x log π_x(k|s)): the exact expectation over repetitions.

    :param q_values: Q_i(s, a)_k, ``[n_critics, batch, K]``
    :param repetition_log_probs: log π_x(k|s), ``[batch, K]``
    :param duration_ent_coef: α_x, a scalar
    :return: ``[batch, 1]``
    """
    soft_values = q_values.amin(dim=0) - duration_ent_coef * repetition_log_probs
    return (repetition_log_probs.exp() * soft_values).sum(dim=1, keepdim=True)


def repeated_actor_loss(
    q_values: th.Tensor, action_log_prob: th.Tensor, repetition_log_probs: th.Tensor, ent_coefs: th.Tensor
) -> th.Tensor:
    """L_a + L_x, each part of the policy judged with the other one held fixed.

    L_a = α_a log π_a(a|s) − Σ_k sg[π_x(k|s)]·min_i Q_i(s, a)_k moves the action, and
    L_x = Σ_k π_x(k|s)·(α_x log π_x(k|s) − sg[min_i Q_i(s, a)_k]) the repetition; sg stops gradients.

    :param q_values: Q_i(s, a)_k of reparameterised actions, ``[n_critics, batch, K]``
    :param action_log_prob: log π_a(a|s), ``[batch]``
    :param repetition_log_probs: log π_x(k|s), ``[batch, K]``
    :param ent_coefs: α_a and α_x, ``[2]``
    """
    repetition_probs = repetition_log_probs.exp()
    loss_a = ent_coefs[0] * action_log_prob - (repetition_probs.detach() * q_values.amin(dim=0)).sum(dim=1)
    loss_x = -repetition_values(q_values.detach(), repetition_log_probs, ent_coefs[1])
    return loss_a.mean() + loss_x.mean()
