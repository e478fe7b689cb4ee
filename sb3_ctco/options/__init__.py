"""The option model and the arithmetic of its semi-Markov decision process.

Pure functions of numpy arrays and frozen objects; equations are those of Karimi et al. 2023, "Dynamic Decision Frequency with
Continuous Options" (https://arxiv.org/abs/2212.04407). Words and units:

============== ============================================ ========================
paper          code                                         unit or shape
============== ============================================ ========================
Δt             ``dt``                                       s
ω              ``omega``                                    [action_dim, n_weights]
d              ``duration``                                 s
φ(t/d)         ``basis``                                    [n_steps, n_weights]
τ              ``discount_rate``                            1/s
γ(d) = e^(−τd) ``discount``                                 –
R              ``integrated_reward``                        reward rate × s
============== ============================================ ========================
"""

from sb3_ctco.options.infos import INTERRUPTED, LAST_ACTION, OBSERVATION_AGE, PENDING, PLAYED, TAKEN_OVER, OptionInfo
from sb3_ctco.options.interrupts import ValueInterrupt
from sb3_ctco.options.joins import OBSERVATION, with_last_action, with_last_action_space
from sb3_ctco.options.semi_mdp import (
    DEFAULT_DISCOUNT_RATE,
    REWARD_UNITS,
    FloatArray,
    RewardUnit,
    check_seconds,
    discount,
    discount_rate_from_gamma,
    discounts_of_steps,
    integrated_reward,
    step_weight,
    steps_in,
)
from sb3_ctco.options.space import (
    DURATION_SCALES,
    JOINS,
    OPTIONS_OF_0_1_0,
    ActionBox,
    DurationScale,
    Join,
    OptionSpace,
    default_durations,
)
from sb3_ctco.options.sub_options import (
    Stacked,
    SubOptions,
    draw_stretches,
    fit_sub_options,
    is_finite,
    rows_of,
    shortest_steps,
    stack,
)
from sb3_ctco.options.trajectory import TRAJECTORIES, BezierCurve, RadialBasis, Trajectory, basis_of_steps

__all__ = [
    "DEFAULT_DISCOUNT_RATE",
    "DURATION_SCALES",
    "INTERRUPTED",
    "JOINS",
    "LAST_ACTION",
    "OBSERVATION",
    "OBSERVATION_AGE",
    "OPTIONS_OF_0_1_0",
    "PENDING",
    "PLAYED",
    "REWARD_UNITS",
    "TAKEN_OVER",
    "TRAJECTORIES",
    "ActionBox",
    "BezierCurve",
    "DurationScale",
    "FloatArray",
    "Join",
    "OptionInfo",
    "OptionSpace",
    "RadialBasis",
    "RewardUnit",
    "Stacked",
    "SubOptions",
    "Trajectory",
    "ValueInterrupt",
    "basis_of_steps",
    "check_seconds",
    "default_durations",
    "discount",
    "discount_rate_from_gamma",
    "discounts_of_steps",
    "draw_stretches",
    "fit_sub_options",
    "integrated_reward",
    "is_finite",
    "rows_of",
    "shortest_steps",
    "stack",
    "step_weight",
    "steps_in",
    "with_last_action",
    "with_last_action_space",
]
