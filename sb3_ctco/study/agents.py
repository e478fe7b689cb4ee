"""From a run's settings to a model to train, and an environment to evaluate it in."""

import copy
import sys
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

import sb3_ctco.torch_layers  # noqa: F401 (whose features extractors presets name)
from sb3_ctco.options import discount_rate_from_gamma
from sb3_ctco.registry import ALGORITHMS, find_task
from sb3_ctco.study.grid import Run


def constructor_arguments(run: Run) -> dict[str, Any]:
    """The algorithm's arguments: numbers of seconds become numbers of steps, at the run's rate, and names become classes.

    :raises ValueError: if an argument is unknown, or ``gamma``, ``gamma_dt`` or ``updates_per_second`` is missing, or there is
        no such class
    """
    where = f"preset {run.preset}: {run.algorithm} ({run.setting})"
    episode_seconds = find_task(run.task).seconds_of_episode(run.rate)
    # A copy, since Stable-Baselines3 writes into policy_kwargs, and the run's are what its record is known by.
    arguments = ALGORITHMS[run.algorithm].arguments(copy.deepcopy(run.arguments), run.dt, episode_seconds, where)
    policy_kwargs = arguments.get("policy_kwargs") or {}
    if "features_extractor_class" in policy_kwargs:
        name = policy_kwargs["features_extractor_class"]
        # Of what is imported already: to read a preset imports nothing, and runs nothing that is no features extractor.
        module, _, class_name = name.rpartition(".") if isinstance(name, str) else ("", "", "")
        extractor = getattr(sys.modules.get(module), class_name, None)
        if not (isinstance(extractor, type) and issubclass(extractor, BaseFeaturesExtractor)):
            raise ValueError(
                f"{where}: there is no features_extractor_class {name}; give its full name, module.Class, and your own "
                "module's to --gym-packages"
            )
        arguments["policy_kwargs"] = {**policy_kwargs, "features_extractor_class": extractor}
    return arguments


def discount_rate(run: Run) -> float:
    """τ, in 1/s."""
    return discount_rate_from_gamma(run.arguments["gamma"], run.arguments["gamma_dt"])


def make_model(run: Run) -> BaseAlgorithm:
    """The model of a run with its environment, or environments."""
    arguments = {**constructor_arguments(run), "seed": run.seed, "device": "cpu"}
    return ALGORITHMS[run.algorithm].make(lambda: find_task(run.task).make_env(run.rate), run.dt, arguments)


def make_eval_env(run: Run, model: BaseAlgorithm) -> VecEnv:
    """An environment for the model to be evaluated in, seeded apart from training."""
    env = ALGORITHMS[run.algorithm].make_eval_env(model, lambda: find_task(run.task).make_env(run.rate))
    env.seed(10_000 + run.seed)
    return env
