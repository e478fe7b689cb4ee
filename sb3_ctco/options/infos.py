"""What infos tell of options: the keys by which wrappers, buffers and callbacks understand each other."""

from typing import TypedDict


class OptionInfo(TypedDict):
    """What ran of an option: ``info["option"]``.

    :param duration: time that ran, in s
    :param n_steps: primitive steps that ran
    :param integrated_reward: R, in reward rate × s
    :param discount: γ(d) = e^(−τ·duration)
    """

    duration: float
    n_steps: int
    integrated_reward: float
    discount: float


#: The option that ended, normalised, where that is not the action of this step
PLAYED = "option_played"
#: True of an environment whose option runs on (:class:`~sb3_ctco.vec_env.AsyncOptionVecEnv`)
PENDING = "option_pending"
#: True of a step that ends the option that runs, as an environment or a wrapper may say
INTERRUPTED = "interrupted"
#: True of a step in which something else was sent than the policy's action: no transition of the policy
TAKEN_OVER = "taken_over"
#: In infos, what was really sent, in the units of the environment; in observations, what an option leaves from, normalised
LAST_ACTION = "last_action"
#: How old an observation is, in s
OBSERVATION_AGE = "observation_age"
