"""From a run's settings to a model to train, and an environment to evaluate it in."""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, sync_envs_normalization

from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.common.sac_at_rate import sac_at_rate
from sb3_ctco.ctco import CTCO
from sb3_ctco.dac_ppo import DACPPO
from sb3_ctco.figar_sac import FiGARSAC
from sb3_ctco.options import discount_rate_from_gamma
from sb3_ctco.study.grid import EPISODE_SECONDS, Run
from sb3_ctco.wrappers import RewardRateWrapper

#: What may be an argument in a preset file, beside those in seconds
_SIGNATURES: dict[str, list[Callable[..., Any]]] = {
    "ctco": [CTCO],
    "figar_sac": [FiGARSAC],
    "dac_ppo": [DACPPO],
    "sac": [sac_at_rate, SAC],
}


def constructor_arguments(run: Run) -> dict[str, Any]:
    """The algorithm's arguments: numbers of seconds become numbers of steps, at the run's rate.

    :raises ValueError: if an argument is unknown, or ``gamma``, ``gamma_dt`` or ``updates_per_second`` is missing
    """
    arguments = dict(run.arguments)
    if run.algorithm in ("ctco", "figar_sac") and "learning_starts_seconds" in arguments:
        arguments["learning_starts"] = round(arguments.pop("learning_starts_seconds") * run.rate)
    if run.algorithm == "dac_ppo" and "rollout_seconds" in arguments:
        arguments["n_steps"] = round(arguments.pop("rollout_seconds") * run.rate / n_envs(run))
    known = {name for constructor in _SIGNATURES[run.algorithm] for name in inspect.signature(constructor).parameters}
    unknown = sorted(set(arguments) - known)
    if unknown:
        raise ValueError(f"preset {run.preset}: {run.algorithm} ({run.setting}) has no arguments {unknown}")
    missing = [name for name in ("gamma", "gamma_dt", "updates_per_second") if name not in arguments]
    if missing:
        raise ValueError(
            f"preset {run.preset}: {run.algorithm} ({run.setting}) lacks {missing}, which must not be left to the "
            "algorithms' defaults, because these differ"
        )
    return arguments


def n_envs(run: Run) -> int:
    """Number of environments: one, but for DAC-PPO as many as a rollout has episodes.

    Its policy does not change within a rollout, so episodes side by side are what they are one after the other, and cost
    less. Task time is summed over them.
    """
    return max(1, round(run.arguments.get("rollout_seconds", 0.0) / EPISODE_SECONDS))


def discount_rate(run: Run) -> float:
    """τ, in 1/s."""
    return discount_rate_from_gamma(run.arguments["gamma"], run.arguments["gamma_dt"])


def make_model(run: Run) -> BaseAlgorithm:
    """The model of a run with its environment, or environments; for DAC-PPO observations are normalised."""
    arguments = {**constructor_arguments(run), "seed": run.seed, "device": "cpu"}
    if run.algorithm == "sac":
        return sac_at_rate(_make_env(run), dt=run.dt, **arguments)
    if run.algorithm == "dac_ppo":
        return DACPPO("MlpPolicy", _normalised(_with_reward_rate(run, n_envs(run))), **arguments)
    algorithm = CTCO if run.algorithm == "ctco" else FiGARSAC
    return algorithm("MlpPolicy", _make_env(run), **arguments)


def make_eval_env(run: Run, model: BaseAlgorithm) -> VecEnv:
    """An environment for the model to be evaluated in, seeded apart from training."""
    if isinstance(model, OptionOffPolicyAlgorithm):
        wrapped: gym.Env = model.wrap_env(_make_env(run))
        env: VecEnv = DummyVecEnv([lambda: wrapped])
    elif isinstance(model, DACPPO):
        env = _normalised(_with_reward_rate(run))
        env.training = False
        sync_envs_normalization(model.get_env(), env)  # type: ignore[arg-type]
    else:
        env = _with_reward_rate(run)
    env.seed(10_000 + run.seed)
    return env


def _make_env(run: Run) -> gym.Env:
    return gym.make(run.env_id, disable_env_checker=True)


def _with_reward_rate(run: Run, n_envs: int = 1) -> VecEnv:
    def make() -> gym.Env:
        return RewardRateWrapper(Monitor(_make_env(run)), dt=run.dt, discount_rate=discount_rate(run))

    return DummyVecEnv([make] * n_envs)


def _normalised(env: VecEnv) -> VecNormalize:
    return VecNormalize(env, norm_obs=True, norm_reward=False)
