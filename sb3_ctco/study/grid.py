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

from sb3_ctco.registry import ALGORITHMS, find_task

#: What the name of a setting may be: it becomes part of the name of a folder
_SETTING = re.compile(r"\w[\w.+-]*", re.ASCII)


@dataclass(frozen=True)
class Run:
    """One run: everything that its result depends on, except for the versions of what it is made with.

    :param preset: name of the preset that it belongs to
    :param task: of :mod:`sb3_ctco.registry`, or an id of Gymnasium's registry
    :param algorithm: of :mod:`sb3_ctco.registry`
    :param setting: name of the algorithm's arguments, such as ``"paper"`` or ``"tuned"``
    :param rate: interaction rate, in Hz
    :param seed: of the algorithm and the environment
    :param task_seconds: how long to learn, in s of task time
    :param eval_episodes: number of greedy episodes of an evaluation
    :param arguments: the algorithm's, as in the preset file, and what the task says of them
    :param evaluations: how many evaluations to make, evenly in the last tenth of task time, the last at its end
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
    evaluations: int = 1

    @property
    def dt(self) -> float:
        """Interaction period, in s."""
        return 1.0 / self.rate

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return f"{self.task.replace('/', '_')}-{self.algorithm}_{self.setting}-{self.rate}hz-seed{self.seed}"

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that change with any setting."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()[:8]

    def as_dict(self) -> dict[str, Any]:
        """The settings, as they are kept in the run's folder."""
        settings = dataclasses.asdict(self)
        if self.evaluations == 1:
            del settings["evaluations"]  # Runs were recorded without it.
        return settings


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


class _Loader(yaml.SafeLoader):
    """YAML's, where of two entries of one name the second does not silently take the place of the first."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        names = [key.value for key, _ in node.value]
        for key, _ in node.value:
            if names.count(key.value) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is there twice", key.start_mark)
        return node


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
        parsed = yaml.load(content, _Loader)
    except (yaml.YAMLError, ValueError) as error:  # a date that there is not is a ValueError
        raise ValueError(f"preset {name} is no YAML: {error}") from error
    return Preset(name, tuple(_grid(name, parsed)))


_TASK_KEYS = ("rates", "task_seconds", "eval_episodes", "evaluations", "arguments")


def _grid(preset: str, content: Any) -> list[Run]:
    where = f"preset {preset}"
    _check_keys(where, content, ("task_seconds", "eval_episodes", "tasks", "rates", "seeds", "algorithms"), ("evaluations",))
    tasks = content["tasks"]
    if isinstance(tasks, list):
        tasks = {find_task(name).name: {} for name in tasks} if len(set(map(str, tasks))) == len(tasks) else None
    if not (isinstance(tasks, dict) and tasks):
        raise ValueError(f"{where}: tasks must be a list of tasks, each once, or a mapping, not {content['tasks']!r}")
    entries = _entries(where, content["algorithms"])
    if not _is_whole(content["seeds"]):
        raise ValueError(
            f"{where}: seeds must be a whole number from 1, how many there are, not {content['seeds']!r}: which ones, from 0 "
            "on if nothing else is said, is what --seeds tells"
        )
    # What the preset says of every task, and a task for itself
    shared = {name: content[name] for name in ("rates", "task_seconds", "eval_episodes", "evaluations") if name in content}
    cells = []
    for name, own in tasks.items():
        of_task = f"{where}, task {name}"
        task = find_task(name)
        _check_keys(of_task, own or {}, (), _TASK_KEYS)
        settings = {"evaluations": 1, **shared, **(own or {})}
        _check_rates(of_task, settings["rates"])
        _check_whole(of_task, "eval_episodes", settings["eval_episodes"])
        _check_whole(of_task, "evaluations", settings["evaluations"])
        for rate in settings["rates"]:
            _check_seconds(of_task, settings["task_seconds"], task.seconds_of_episode(rate))
            cells.append((rate, name, settings))
    # Sorting keeps the order of the tasks at a rate.
    cells.sort(key=lambda cell: -cell[0])
    for algorithm, setting, _, rates in entries:
        if rates is not None and not any(rate in rates for rate, _, _ in cells):
            raise ValueError(f"{where}: {algorithm} ({setting}) has no run, since no task has one of its rates {rates}")
    runs = [
        Run(
            preset,
            name,
            algorithm,
            setting,
            rate,
            seed,
            float(settings["task_seconds"]),
            settings["eval_episodes"],
            {**arguments, **_checked_arguments(f"{where}, task {name}", settings.get("arguments", {}))},
            settings["evaluations"],
        )
        for seed in range(content["seeds"])
        for rate, name, settings in cells
        for algorithm, setting, arguments, rates in entries
        if rates is None or rate in rates
    ]
    of_names: dict[str, Run] = {}
    for run in runs:
        if (other := of_names.setdefault(run.name, run)) is not run:
            raise ValueError(
                f"{where}: {run.algorithm} ({run.setting}) and {other.algorithm} ({other.setting}) would have the same folder "
                f"{run.name}: give one of them another setting"
            )
    return runs


def _entries(where: str, algorithms: Any) -> list[tuple[str, str, dict[str, Any], list[int] | None]]:
    """Algorithms with their settings and arguments, and the rates that they are run at, None for all."""
    if not (isinstance(algorithms, dict) and algorithms):
        raise ValueError(f"{where}: algorithms must be a mapping of names to setting and arguments, not {algorithms!r}")
    entries = []
    for name, entry in algorithms.items():
        of_entry = f"{where}, algorithm {name}"
        _check_keys(of_entry, entry, ("setting", "arguments"), optional=("algorithm", "rates"))
        if "rates" in entry:
            _check_rates(of_entry, entry["rates"])
        algorithm, setting = entry.get("algorithm", name), str(entry["setting"])
        if algorithm not in list(ALGORITHMS):
            raise ValueError(
                f"{of_entry}: must be one of {list(ALGORITHMS)}, or name one of them as its algorithm, not {algorithm!r}"
            )
        if entry["setting"] is None or not _SETTING.fullmatch(setting):
            raise ValueError(
                f"{of_entry}: setting becomes part of a folder's name, so it must be of letters, digits and _ . + -, not "
                f"{entry['setting']!r}"
            )
        entries.append((algorithm, setting, _checked_arguments(of_entry, entry["arguments"]), entry.get("rates")))
    names = [entry[:2] for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: two entries have the same algorithm and setting, in {names}")
    return entries


def _checked_arguments(where: str, arguments: Any) -> dict[str, Any]:
    if not (isinstance(arguments, dict) and all(isinstance(name, str) for name in arguments)):
        raise ValueError(f"{where}: arguments must be a mapping of names to values ({{}} for none), not {arguments!r}")
    return dict(arguments)


def _check_keys(where: str, content: Any, required: Sequence[str], optional: Sequence[str]) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where}: must be a mapping with {[*required, *optional]}, not {content!r}")
    missing, unknown = set(required) - set(content), set(content) - {*required, *optional}
    if missing or unknown:
        raise ValueError(
            f"{where}: {sorted(missing)} missing, {sorted(unknown, key=str)} unknown; it has {[*required, *optional]}"
        )


def _check_rates(where: str, rates: Any) -> None:
    if not (isinstance(rates, list) and rates and all(map(_is_whole, rates)) and len(set(rates)) == len(rates)):
        raise ValueError(f"{where}: rates must be a list of whole numbers of Hz, each once, not {rates!r}")


def _check_whole(where: str, name: str, value: Any) -> None:
    if not _is_whole(value):
        raise ValueError(f"{where}: {name} must be a whole number from 1, not {value!r}")


def _check_seconds(where: str, task_seconds: Any, episode_seconds: float) -> None:
    shortest = 10 * episode_seconds
    if isinstance(task_seconds, bool) or not (isinstance(task_seconds, int | float) and shortest <= task_seconds < math.inf):
        raise ValueError(
            f"{where}: task_seconds must be at least {shortest:g}, so that an episode of {episode_seconds:g} s ends in the "
            f"last tenth, and finite, not {task_seconds!r}"
        )


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1
