"""What the study, its figures and RL Zoo know of algorithms and tasks: one row each.

A new algorithm is its folder and a row in :data:`ALGORITHMS`; a new task is a row in :data:`TASKS`, and any Gymnasium id is a
task without one.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, sync_envs_normalization

from sb3_ctco.common.load_arguments import constructor_parameters
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.ctco import CTCO
from sb3_ctco.dac_ppo import DACPPO
from sb3_ctco.figar_sac import FiGARSAC
from sb3_ctco.fixed_rate import FixedRateSAC, QuickSACPolicy, sac_at_rate
from sb3_ctco.options import OptionSpace, discount_rate_from_gamma
from sb3_ctco.wrappers import RewardRateWrapper, find_dt


@dataclass(frozen=True)
class Task:
    """A task, which a study runs at different rates.

    :param name: in presets and records
    :param label: in figures and tables
    :param env_id: of the environment in Gymnasium's registry
    :param env_kwargs: its arguments
    :param any_rate: whether it takes ``dt``, in s; otherwise it runs at the rate that it has
    :param episode_seconds: longest episode, in s; None for what the id's ``max_episode_steps`` says
    """

    name: str
    label: str
    env_id: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    any_rate: bool = True
    episode_seconds: float | None = 10.0

    def make_env(self, rate: int) -> gym.Env:
        """The bare environment at an interaction rate in Hz.

        :raises ValueError: if it has another rate, and no choice
        """
        timing: dict[str, Any] = {"dt": 1.0 / rate, "time_limit": self.episode_seconds} if self.any_rate else {}
        env = gym.make(self.env_id, disable_env_checker=True, **self.env_kwargs, **timing)
        dt = find_dt(env)
        if dt is None or not math.isclose(dt, 1.0 / rate, rel_tol=1e-3):
            if dt is None:
                raise ValueError(
                    f"task {self.name} does not tell its interaction period: give the environment an attribute dt, in s"
                )
            whole = math.isclose(round(1 / dt) * dt, 1.0, rel_tol=1e-3)
            hint = "its rates must be a list of that one" if whole else "a study needs a whole number of Hz"
            raise ValueError(f"task {self.name} runs at {1 / dt:g} Hz, not at {rate} Hz: {hint}")
        return env

    def seconds_of_episode(self, rate: int) -> float:
        """Longest episode, in s; 0 if there is no limit."""
        if self.episode_seconds is not None:
            return self.episode_seconds
        return (gym.spec(self.env_id).max_episode_steps or 0) / rate


#: The paper's tasks, in its order
TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task("point_mass", "sparse point mass", "sb3_ctco/point_mass-easy-v0", {"sparse": True}),
        Task("cheetah", "cheetah run", "sb3_ctco/cheetah-run-v0"),
        Task("ball_in_cup", "ball in cup", "sb3_ctco/ball_in_cup-catch-v0"),
        Task("visual_reacher_easy", "visual reaching, easy", "sb3_ctco/visual_reacher-easy-v0", episode_seconds=8.0),
        Task("visual_reacher_hard", "visual reaching, hard", "sb3_ctco/visual_reacher-hard-v0", episode_seconds=8.0),
    )
}


def find_task(name: str) -> Task:
    """A task by its name here, or by its id in Gymnasium's registry.

    Tasks of dm_control's suite (``sb3_ctco/...``) take any rate, and episodes of 10 s; others have their own.

    :raises ValueError: if there is none
    """
    if not isinstance(name, str) or name not in {*TASKS, *gym.registry}:
        raise ValueError(
            f"there is no task {name!r}: name one of {list(TASKS)}, or an id of Gymnasium's registry; of your own "
            "environments --gym-packages names the module that registers them"
        )
    if name in TASKS:
        return TASKS[name]
    if gym.spec(name).entry_point == "sb3_ctco.envs.dm_control:DMControlEnv" and "dt" not in gym.spec(name).kwargs:
        return Task(name, name.removeprefix("sb3_ctco/").removesuffix("-v0"), name)
    return Task(name, name, name, any_rate=False, episode_seconds=gym.spec(name).kwargs.get("time_limit"))


#: Parameters of constructors that follow from a run's place in the grid, or are the same for all runs
_SAID_BY_THE_STUDY = {"env", "make_env", "dt", "discount_rate", "seed", "device", "_init_setup_model"}


@dataclass(frozen=True)
class Algorithm:
    """An algorithm as a study makes it.

    ``make(make_env, dt, arguments)`` returns a model. ``make_env()`` is the bare environment, ``dt`` its interaction period
    in s, ``arguments`` are a preset's, of which those in seconds have become steps.
    ``make_eval_env(model, make_env)`` returns an environment to evaluate it in.

    :param name: in presets, records and RL Zoo
    :param label: in figures and tables
    :param colour: its lines', one of matplotlib's
    :param constructors: whose parameters may be arguments in a preset, but for those that the study says itself
    :param in_steps: turns arguments in seconds into steps: ``in_steps(arguments, dt, episode_seconds)``
    :param zoo_class: the class that RL Zoo trains; None for one that it has itself
    """

    name: str
    label: str
    colour: str
    constructors: tuple[Callable[..., Any], ...]
    make: Callable[[Callable[[], gym.Env], float, dict[str, Any]], BaseAlgorithm]
    make_eval_env: Callable[[Any, Callable[[], gym.Env]], VecEnv]
    in_steps: Callable[[dict[str, Any], float, float], dict[str, Any]]
    zoo_class: type[BaseAlgorithm] | None = None

    def arguments(self, given: Mapping[str, Any], dt: float, episode_seconds: float, where: str) -> dict[str, Any]:
        """A preset's arguments, in which numbers of seconds become numbers of steps.

        :param given: as in the preset
        :param dt: interaction period, in s
        :param episode_seconds: longest episode, in s
        :param where: names the place in an error
        :raises ValueError: if one is unknown, or ``gamma``, ``gamma_dt`` or ``updates_per_second`` is missing
        """
        for name in ("learning_starts_seconds", "rollout_seconds", "action_repeat"):
            value = given.get(name, 1)
            if isinstance(value, bool) or not isinstance(value, int | float) or value < 0:
                raise ValueError(f"{where} has {name}={value!r}, which must be a number of at least 0 (to YAML 6e1 is none)")
        if "rollout_seconds" in given and not episode_seconds > 0:
            raise ValueError(f"{where} has rollout_seconds, whole episodes of a task that has no longest one: pass n_steps")
        arguments = self.in_steps(dict(given), dt, episode_seconds)
        known = {name for constructor in self.constructors for name in constructor_parameters(constructor)}
        unknown = sorted(set(arguments) - known | set(arguments) & _SAID_BY_THE_STUDY)
        if unknown:
            raise ValueError(f"{where} has no arguments {unknown}")
        missing = [name for name in ("gamma", "gamma_dt", "updates_per_second") if name not in arguments]
        if missing:
            raise ValueError(
                f"{where} lacks {missing}, which must not be left to the algorithms' defaults, because these differ"
            )
        return arguments


def _warm_up_in_steps(arguments: dict[str, Any], dt: float, episode_seconds: float) -> dict[str, Any]:
    if "learning_starts_seconds" in arguments:
        arguments["learning_starts"] = round(arguments.pop("learning_starts_seconds") / dt)
    return arguments


def _wrapped_as_the_model_s(model: OptionOffPolicyAlgorithm | FixedRateSAC, make_env: Callable[[], gym.Env]) -> VecEnv:
    return DummyVecEnv([lambda: model.wrap_env(make_env())])


def _of_options(algorithm: type[OptionOffPolicyAlgorithm]) -> dict[str, Any]:
    """What rows of algorithms that decide by options share."""
    return {
        "constructors": (algorithm,),
        "make": lambda make_env, dt, arguments: algorithm(env=make_env(), **{"policy": "MlpPolicy", **arguments}),
        "make_eval_env": _wrapped_as_the_model_s,
        "in_steps": _warm_up_in_steps,
        "zoo_class": algorithm,
    }


def _make_sac(make_env: Callable[[], gym.Env], dt: float, arguments: dict[str, Any]) -> SAC:
    other_noise = arguments.get("use_sde") or arguments.get("pink_noise_seconds") is not None
    policy = "MlpPolicy" if other_noise else QuickSACPolicy
    return sac_at_rate(make_env(), dt=dt, **{"policy": policy, **arguments})


def _action_repeat_in_seconds(arguments: dict[str, Any], dt: float, episode_seconds: float) -> dict[str, Any]:
    """``action_repeat``, a number of steps at every rate, is the one argument whose time depends on the rate."""
    if "action_repeat" in arguments:
        arguments["hold_seconds"] = arguments.pop("action_repeat") * dt
    return arguments


#: Of stock SAC and what practitioners do about high rates: rows that differ in their arguments alone, told apart in figures
_SAC: dict[str, Any] = {
    "constructors": (sac_at_rate, SAC),
    "make": _make_sac,
    "make_eval_env": _wrapped_as_the_model_s,
    "in_steps": _action_repeat_in_seconds,
}


def _with_reward_rate(make_env: Callable[[], gym.Env], dt: float, discount_rate: float, n_envs: int = 1) -> VecEnv:
    return DummyVecEnv([lambda: RewardRateWrapper(Monitor(make_env()), dt=dt, discount_rate=discount_rate)] * n_envs)


def _make_dac_ppo(make_env: Callable[[], gym.Env], dt: float, arguments: dict[str, Any]) -> DACPPO:
    discount_rate = discount_rate_from_gamma(arguments["gamma"], arguments["gamma_dt"])
    n_envs = arguments.pop("n_envs", 1)
    env = _with_reward_rate(make_env, dt, discount_rate, n_envs)
    # The environments have seeds from this one on, which are not to be those of the next run.
    seed = arguments.pop("seed", None)
    arguments["seed"] = None if seed is None else seed * n_envs
    return DACPPO(env=VecNormalize(env, norm_reward=False), **{"policy": "MlpPolicy", **arguments})


def _make_dac_ppo_eval_env(model: DACPPO, make_env: Callable[[], gym.Env]) -> VecEnv:
    own = model.get_env()
    assert own is not None
    clock: OptionSpace = own.get_attr("option_space")[0]
    env = VecNormalize(_with_reward_rate(make_env, clock.dt, clock.discount_rate), training=False, norm_reward=False)
    sync_envs_normalization(own, env)
    return env


def _rollouts_in_steps(arguments: dict[str, Any], dt: float, episode_seconds: float) -> dict[str, Any]:
    """One environment for each episode that a rollout has.

    DAC-PPO's policy does not change within a rollout, so episodes side by side are what they are one after the other, and
    cost less. Task time is summed over them.
    """
    if "rollout_seconds" in arguments:
        seconds = arguments.pop("rollout_seconds")
        arguments["n_envs"] = max(1, round(seconds / episode_seconds))
        arguments["n_steps"] = round(seconds / dt / arguments["n_envs"])
    return arguments


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("ctco", "CTCO", "C0", **_of_options(CTCO)),
        Algorithm("sac", "SAC", "C1", **_SAC),
        Algorithm("figar_sac", "FiGAR-SAC", "C2", **_of_options(FiGARSAC)),
        Algorithm(
            "dac_ppo",
            "DAC-PPO",
            "C3",
            constructors=(DACPPO, _with_reward_rate),
            make=_make_dac_ppo,
            make_eval_env=_make_dac_ppo_eval_env,
            in_steps=_rollouts_in_steps,
            zoo_class=DACPPO,
        ),
        Algorithm("sac_repeat", "SAC, action repeat", "C4", **_SAC),
        Algorithm("sac_chunks", "SAC, action chunks", "C5", **_SAC),
        Algorithm("sac_gsde", "SAC, gSDE", "C6", **_SAC),
        Algorithm("sac_pink", "SAC, pink noise", "C7", **_SAC),
        Algorithm("tacos", "TaCoS", "C8", **_SAC),
    )
}
