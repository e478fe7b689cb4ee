"""What a study runs: a preset file, and the grid of runs that follows from it."""

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from sb3_ctco.envs import STUDY_RATES

#: Tasks by their names in records, and what they are called in the ids of environments
TASKS = {"point_mass": "point_mass-sparse", "cheetah": "cheetah-run", "ball_in_cup": "ball_in_cup-catch"}
ALGORITHMS = ("ctco", "sac", "figar_sac", "dac_ppo")
#: What the name of a setting may be: it becomes part of the name of a folder
_SETTING = re.compile(r"\w[\w.+-]*", re.ASCII)
#: Length of an episode, in s
EPISODE_SECONDS = 10.0


@dataclass(frozen=True)
class Run:
    """One run: everything that its result depends on, except for the versions of what it is made with.

    :param preset: name of the preset that it belongs to
    :param task: ``"point_mass"``, ``"cheetah"`` or ``"ball_in_cup"``
    :param algorithm: ``"ctco"``, ``"sac"``, ``"figar_sac"`` or ``"dac_ppo"``
    :param setting: name of the algorithm's arguments, such as ``"paper"`` or ``"tuned"``
    :param rate: interaction rate, in Hz
    :param seed: of the algorithm and the environment
    :param task_seconds: how long to learn, in s of task time
    :param eval_episodes: number of greedy episodes at the end
    :param arguments: the algorithm's, as in the preset file
    """

    preset: str
    task: str
    algorithm: str
    setting: str
    rate: int
    seed: int
    task_seconds: float
    eval_episodes: int
    arguments: dict[str, Any]

    @property
    def dt(self) -> float:
        """Interaction period, in s."""
        return 1.0 / self.rate

    @property
    def env_id(self) -> str:
        """Id of the environment in Gymnasium's registry."""
        return f"sb3_ctco/{TASKS[self.task]}-{self.rate}hz-v0"

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return f"{self.task}-{self.algorithm}_{self.setting}-{self.rate}hz-seed{self.seed}"

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that change with any setting."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()[:8]

    def as_dict(self) -> dict[str, Any]:
        """The settings, as they are kept in the run's folder."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Preset:
    """A preset file.

    :param name: the file's name without its ending
    :param runs: the whole grid, seed by seed, and within a seed the runs that take longest (those at high rates) first
    """

    name: str
    runs: tuple[Run, ...]

    def select(
        self,
        tasks: Sequence[str] | None = None,
        rates: Sequence[int] | None = None,
        algorithms: Sequence[str] | None = None,
        settings: Sequence[str] | None = None,
        seeds: Sequence[int] | None = None,
    ) -> list[Run]:
        """The runs that pass all filters; None lets all pass.

        :param seeds: any, not only the preset's, since seeds differ in nothing else
        :raises ValueError: if another filter names what no run of the preset has, or for a negative seed
        """
        chosen = list(self.runs)
        if seeds is not None:
            if min(seeds, default=0) < 0:
                raise ValueError(f"seeds must not be negative: {list(seeds)}")
            chosen = [dataclasses.replace(run, seed=seed) for seed in seeds for run in chosen if run.seed == 0]
        filters: dict[str, Sequence[Any] | None] = {
            "task": tasks,
            "rate": rates,
            "algorithm": algorithms,
            "setting": settings,
        }
        for name, wanted in filters.items():
            if wanted is None:
                continue
            present = sorted({getattr(run, name) for run in self.runs})
            missing = sorted(set(wanted) - set(present))
            if missing:
                raise ValueError(f"preset {self.name} has no {name} {missing}; it has {present}")
            chosen = [run for run in chosen if getattr(run, name) in wanted]
        if not chosen:
            raise ValueError(f"no run of preset {self.name} passes all of the filters {filters}")
        return chosen


def preset_names() -> list[str]:
    """Names of the presets in this package."""
    files = (resources.files("sb3_ctco.study") / "presets").iterdir()
    return sorted(file.name.removesuffix(".yml") for file in files if file.name.endswith(".yml"))


def load_preset(name: str) -> Preset:
    """Read a preset.

    :param name: of a preset in this package, or path of a YAML file
    :raises ValueError: if there is none, or something in it is not as it must be
    """
    if name in preset_names():
        content = (resources.files("sb3_ctco.study") / "presets" / f"{name}.yml").read_bytes()
    elif Path(name).is_file():
        content, name = Path(name).read_bytes(), Path(name).stem
    else:
        raise ValueError(f"there is no preset {name!r}: name one of {preset_names()}, or a YAML file")
    try:
        parsed = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError) as error:  # a date that there is not is a ValueError
        raise ValueError(f"preset {name} is no YAML: {error}") from error
    return Preset(name, tuple(_grid(name, parsed)))


def _grid(preset: str, content: Any) -> list[Run]:
    _check_keys(
        f"preset {preset}", content, ("task_seconds", "eval_episodes", "tasks", "rates", "seeds", "algorithms"), optional=()
    )
    _check_values(preset, "tasks", content["tasks"], tuple(TASKS))
    _check_values(preset, "rates", content["rates"], STUDY_RATES)
    for name in ("seeds", "eval_episodes"):
        # True is an integer to Python.
        if isinstance(content[name], bool) or not (isinstance(content[name], int) and content[name] >= 1):
            raise ValueError(f"preset {preset}: {name} must be a whole number from 1, not {content[name]!r}")
    task_seconds = content["task_seconds"]
    if not (isinstance(task_seconds, int | float) and math.isfinite(task_seconds) and task_seconds >= 10 * EPISODE_SECONDS):
        raise ValueError(
            f"preset {preset}: task_seconds must be at least {10 * EPISODE_SECONDS:g}, so that an episode of "
            f"{EPISODE_SECONDS:g} s ends in the last tenth, and finite, not {task_seconds!r}"
        )
    if not (isinstance(content["algorithms"], dict) and content["algorithms"]):
        raise ValueError(
            f"preset {preset}: algorithms must be a mapping of names to setting and arguments, not {content['algorithms']!r}"
        )
    entries = []
    for name, entry in content["algorithms"].items():
        where = f"preset {preset}, algorithm {name}"
        _check_keys(where, entry, ("setting", "arguments"), optional=("algorithm",))
        algorithm, setting, arguments = entry.get("algorithm", name), str(entry["setting"]), entry["arguments"]
        if algorithm not in ALGORITHMS:
            raise ValueError(f"{where}: must be one of {ALGORITHMS}, or name one of them as its algorithm, not {algorithm!r}")
        if entry["setting"] is None or not _SETTING.fullmatch(setting):
            raise ValueError(
                f"{where}: setting becomes part of a folder's name, so it must be of letters, digits and _ . + -, not "
                f"{entry['setting']!r}"
            )
        if not (isinstance(arguments, dict) and all(isinstance(argument, str) for argument in arguments)):
            raise ValueError(f"{where}: arguments must be a mapping of names to values ({{}} for none), not {arguments!r}")
        entries.append((algorithm, setting, dict(arguments)))
    names = [entry[:2] for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError(f"preset {preset}: two entries have the same algorithm and setting, in {names}")
    return [
        Run(preset, task, algorithm, setting, rate, seed, float(task_seconds), content["eval_episodes"], arguments)
        for seed in range(content["seeds"])
        for rate in sorted(content["rates"], reverse=True)
        for task in content["tasks"]
        for algorithm, setting, arguments in entries
    ]


def _check_keys(where: str, content: Any, required: Sequence[str], optional: Sequence[str]) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where}: must be a mapping with {[*required, *optional]}, not {content!r}")
    missing, unknown = set(required) - set(content), set(content) - {*required, *optional}
    if missing or unknown:
        raise ValueError(
            f"{where}: {sorted(missing)} missing, {sorted(unknown, key=str)} unknown; it has {[*required, *optional]}"
        )


def _check_values(preset: str, name: str, given: Any, allowed: tuple[Any, ...]) -> None:
    if not (isinstance(given, list) and given and all(one in allowed for one in given) and len(set(given)) == len(given)):
        raise ValueError(f"preset {preset}: {name} must be a list of some of {allowed}, each once, not {given!r}")
