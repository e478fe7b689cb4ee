"""RL Zoo (rl_zoo3) with the algorithms and environments of this package.

``sb3-ctco train``, ``sb3-ctco enjoy`` and ``sb3-ctco tune`` take the Zoo's own flags::

    sb3-ctco train --env Pendulum-v1
    sb3-ctco enjoy --env Pendulum-v1
    sb3-ctco tune --env Pendulum-v1 --n-trials 50

Importing this module registers the algorithms and their samplers with the Zoo. ``python -m rl_zoo3.train`` itself cannot
know them: it checks ``--algo`` before it imports ``--gym-packages``.
"""

import argparse
import copy
import importlib
import sys
from collections.abc import Sequence
from importlib import resources
from typing import Any

import gymnasium as gym

try:
    import optuna
    import rl_zoo3.enjoy
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import ALGOS, get_wrapper_class
except ImportError as error:  # pragma: no cover
    missing = (error.name or "rl_zoo3").partition(".")[0]
    raise ImportError(
        f"RL Zoo is needed, and {missing} is missing: in a clone of sb3-ctco, run pip install '.[zoo]'"
    ) from error
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_ctco import registry
from sb3_ctco.common.load_arguments import constructor_parameters
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.envs.quiet import mute_deprecated_attributes
from sb3_ctco.wrappers import OptionExecutionWrapper, find_dt

#: The package's algorithms by their names in the Zoo.
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    name: row.zoo_class for name, row in registry.ALGORITHMS.items() if row.zoo_class is not None
}

WRAPPER = "sb3_ctco.wrappers.OptionExecutionWrapper"


def convert_ctco_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """CTCO's arguments from what :func:`sample_ctco_params` suggested (and Optuna stored)."""
    hyperparams = dict(sampled_params)
    hyperparams["ent_coef"] = f"auto_{hyperparams.pop('ent_coef_start')}"
    hyperparams["high_freq_penalty"] = f"relative_{hyperparams.pop('relative_penalty')}"
    # In place of a file's gradient_steps, which updates_per_second contradicts.
    hyperparams["gradient_steps"] = -1
    return hyperparams


def sample_ctco_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Optuna sampler for what CTCO has and SAC has not, and the step size.

    ``gamma`` and ``gamma_dt`` are not sampled, because they say what is to be optimised.

    :param trial: Optuna's
    :param n_actions: size of the option space, unused
    :param n_envs: number of environments, unused
    :param additional_args: the Zoo's, unused
    :return: arguments of CTCO
    """
    return convert_ctco_params(
        {
            "n_rbf": trial.suggest_int("n_rbf", 1, 5),
            "d_max": trial.suggest_float("d_max", 0.1, 2.0, log=True),
            "relative_penalty": trial.suggest_float("relative_penalty", 0.01, 3.0, log=True),
            "ent_coef_start": trial.suggest_float("ent_coef_start", 0.005, 1.0, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
            "updates_per_second": trial.suggest_float("updates_per_second", 5.0, 60.0, log=True),
            "n_sub_options": trial.suggest_int("n_sub_options", 0, 8),
        }
    )


class OptionExperimentManager(ExperimentManager):
    """The Zoo's ``ExperimentManager``, which wraps environments for algorithms that decide by options.

    The Zoo makes its environments before the algorithm, which cannot wrap them then. Here they get an
    :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`, around the ``env_wrapper`` that a file may name, with the
    algorithm's settings; so that a file, the command line and a sampler name these once. An OptionExecutionWrapper in
    the file is left as it is.
    """

    _option_hyperparams: dict[str, Any] | None = None
    _trial: optuna.Trial | None = None

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The Zoo's, with the wrapper added; also in what is saved, so that ``enjoy`` finds it."""
        hyperparams, saved = super().read_hyperparameters()
        if issubclass(ALGOS[self.algo], OptionOffPolicyAlgorithm):
            self._option_hyperparams = dict(hyperparams)
            hyperparams["env_wrapper"] = self._wrappers(hyperparams)
            saved["env_wrapper"] = self._wrappers({**self._option_hyperparams, "n_sub_options": 0})
        return hyperparams, saved

    def objective(self, trial: optuna.Trial) -> float:
        """Value of one trial, in environments that share its options' settings.

        :raises optuna.TrialPruned: if the sampled settings make no model
        """
        # A copy, because trials run in threads if --n-jobs is more than one.
        manager = copy.copy(self)
        manager._trial = trial
        try:
            return super(OptionExperimentManager, manager).objective(trial)
        except ValueError as error:
            # Of settings that contradict the environment's, such as a d_max below its step
            print(f"Trial {trial.number} has settings that make no model: {error}")
            raise optuna.TrialPruned from error

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """The Zoo's; within a trial with the settings that it sampled, and without sub-options to evaluate in."""
        if self._option_hyperparams is not None:
            hyperparams = dict(self._option_hyperparams)
            if self._trial is not None:
                # By now the sampler has run, and names of parameters are those of CTCO's arguments.
                hyperparams.update(self._trial.params)
            if eval_env:
                hyperparams["n_sub_options"] = 0
            self.env_wrapper = get_wrapper_class({"env_wrapper": self._wrappers(hyperparams)})
        return super().create_envs(n_envs, eval_env, no_log)

    def _wrappers(self, hyperparams: dict[str, Any]) -> list[Any]:
        given = hyperparams.get("env_wrapper") or []
        wrappers = list(given) if isinstance(given, list) else [given]
        if any(map(_plays_options, wrappers)):
            return wrappers
        algorithm = ALGOS[self.algo]
        assert issubclass(algorithm, OptionOffPolicyAlgorithm)
        parameters = constructor_parameters(algorithm)
        arguments = {name: hyperparams.get(name, parameter.default) for name, parameter in parameters.items()}
        if "n_repetitions" in arguments and arguments["dt"] is None:
            # Repetitions are whole steps, and how long one is only the environment knows.
            env = gym.make(self.env_name.gym_id, **(hyperparams.get("env_kwargs") or self.env_kwargs))
            arguments["dt"] = find_dt(env)
            env.close()
        # Which a wrapper asks its own environment for, unless the file says it.
        return [*wrappers, {WRAPPER: {**algorithm.wrapper_kwargs(arguments), "dt": hyperparams.get("dt")}}]


def _plays_options(wrapper: Any) -> bool:
    """Whether an entry of ``env_wrapper``, a name, a class, or one with arguments, is an OptionExecutionWrapper."""
    (named,) = wrapper if isinstance(wrapper, dict) else [wrapper]
    if isinstance(named, str):
        module, _, name = named.rpartition(".")
        named = getattr(importlib.import_module(module), name)
    return isinstance(named, type) and issubclass(named, OptionExecutionWrapper)


def register() -> None:
    """Make the algorithms known to the Zoo; once is enough."""
    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER["ctco"] = sample_ctco_params
    HYPERPARAMS_CONVERTER["ctco"] = convert_ctco_params


def packaged_config(algo: str) -> str | None:
    """Path of the hyperparameter file for an algorithm in this package, or None if there is none."""
    file = resources.files("sb3_ctco.zoo_configs") / f"{algo}.yml"
    return str(file) if file.is_file() else None


def with_defaults(command: str, arguments: Sequence[str]) -> list[str]:
    """The Zoo's arguments for one of our commands, this package's defaults added where none are given.

    :param command: ``"train"``, ``"tune"`` or ``"enjoy"``
    :param arguments: as typed
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-f", "--folder", "--log-folder")
    given, _ = parser.parse_known_args(arguments)
    algo = given.algo or "ctco"
    defaults = [] if given.algo else ["--algo", algo]
    if command == "enjoy":
        # Where train puts it; the Zoo itself looks for its own agents.
        return [*([] if given.folder else ["--folder", "logs"]), *defaults, *arguments]
    config = packaged_config(algo)
    if given.conf_file is None and config is not None:
        defaults += ["--conf-file", config]
    if command == "tune":
        defaults.append("--optimize-hyperparameters")
    return [*defaults, *arguments]


def _check_sampler(flags: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    given, _ = parser.parse_known_args(flags)
    if given.optimize_hyperparameters and given.algo not in HYPERPARAMS_SAMPLER:
        sys.exit(f"hyperparameters are searched for {', '.join(sorted(HYPERPARAMS_SAMPLER))}, not for {given.algo}")


def main(arguments: Sequence[str]) -> None:
    """RL Zoo's part of the command ``sb3-ctco``.

    :param arguments: ``"train"``, ``"tune"`` or ``"enjoy"``, then RL Zoo's flags
    """
    command, *flags = arguments
    mute_deprecated_attributes()
    argv, manager = sys.argv, rl_zoo3.train.ExperimentManager
    flags = with_defaults(command, flags)
    _check_sampler(flags)
    sys.argv = [f"sb3-ctco {command}", *flags]
    rl_zoo3.train.ExperimentManager = OptionExperimentManager  # type: ignore[misc]
    if command == "enjoy":
        print("With an algorithm of options, a timestep of -n and of Episode Length is a decision, not an environment step.")
    try:
        (rl_zoo3.enjoy.enjoy if command == "enjoy" else rl_zoo3.train.train)()
    finally:
        sys.argv, rl_zoo3.train.ExperimentManager = argv, manager  # type: ignore[misc]


register()
