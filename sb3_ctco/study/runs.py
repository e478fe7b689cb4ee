"""One run in a folder of its own: resumable, and safe against another study on the same folder."""

import contextlib
import csv
import dataclasses
import json
import os
import platform
import subprocess
import time
import traceback
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_ctco
from sb3_ctco.common.files import replace_durably
from sb3_ctco.common.lock import LOCK, lock
from sb3_ctco.evaluation import DiscountedReturnCallback, EpisodeStatistics, evaluate_discounted_return
from sb3_ctco.study.agents import discount_rate, make_eval_env, make_model
from sb3_ctco.study.grid import Run

SETTINGS, VERSIONS, RECORD, ERROR = "settings.json", "versions.json", "record.json", "error.txt"
#: Runs that make one mean, over seeds
_CELL = ("task", "algorithm", "setting", "rate")
MONITOR, EVALUATION = "monitor.csv", "evaluation.csv"
MONITOR_COLUMNS = ("task_seconds", "discounted_return", "decision_rate_hz", "wall_seconds")
EVALUATION_COLUMNS = ("task_seconds", "discounted_return", "decision_rate_hz", "episode_return")
_PACKAGES = ("sb3-ctco", "stable-baselines3", "torch", "numpy", "gymnasium", "mujoco", "dm-control")


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    :param name: the run's
    :param state: ``"done"``, ``"failed"``, or ``"busy"`` if another study is at it
    :param message: the error's last line, if it failed
    """

    name: str
    state: Literal["done", "failed", "busy"]
    message: str = ""


def plan(runs: Sequence[Run], folder: Path) -> None:
    """Make the runs' folders, each with its settings; those of a run that failed are written anew.

    :raises ValueError: if a folder has other settings, also of another seed, since seeds make one mean, or cannot be made
    """
    try:
        there = {file: read_json(file) for file in sorted(folder.glob(f"*/{SETTINGS}")) if not _has_failed(file.parent)}
        cells: dict[tuple[Any, ...], list[Path]] = defaultdict(list)
        for file, found in there.items():
            cells[tuple(found.get(name) for name in _CELL)].append(file)
        for run in runs:
            file = folder / run.name / SETTINGS
            if file in there:
                _refuse_other_settings(run, there[file], file)
            for other in cells[tuple(getattr(run, name) for name in _CELL)]:
                of_its_seed = dataclasses.replace(run, preset=there[other]["preset"], seed=there[other]["seed"])
                _refuse_other_settings(of_its_seed, there[other], other)
        for run in runs:
            file = folder / run.name / SETTINGS
            if file not in there:
                file.parent.mkdir(parents=True, exist_ok=True)
                write_whole(file, json.dumps(run.as_dict(), indent=1) + "\n")
    except OSError as error:
        raise ValueError(
            f"{folder} cannot be the study's folder: {error}. Name another --folder, one that can be written to"
        ) from error


def _has_failed(path: Path) -> bool:
    return (path / ERROR).exists() and not (path / RECORD).exists()


def read_json(file: Path) -> dict[str, Any]:
    """What a file of a run's folder holds.

    :raises ValueError: if it is damaged, as a power cut may leave it
    """
    try:
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is damaged ({error}): delete {file.parent} to run it again") from error
    return content


def _refuse_other_settings(run: Run, found: dict[str, Any], file: Path) -> None:
    expected = json.loads(json.dumps(run.as_dict()))
    different = [
        f"{name}: {found.get(name)!r} there, {expected.get(name)!r} in the preset"
        for name in sorted({*found, *expected})
        if found.get(name) != expected.get(name)
    ]
    if different:
        raise ValueError(
            f"{file} has other settings than preset {run.preset}: {'; '.join(different)}. Name another --folder, or delete "
            f"{file.parent} to run it again"
        )


def perform(run: Run, folder: str | Path) -> Outcome:
    """Make a run, unless it is complete or another study is at it.

    What a run that was interrupted has left is written anew.

    :param run: the run, planned in the folder
    :param folder: the study's
    """
    path = Path(folder) / run.name
    with lock(path) as locked:
        if not locked:
            return Outcome(run.name, "busy")
        if (path / RECORD).exists():
            return Outcome(run.name, "done")
        (path / ERROR).unlink(missing_ok=True)
        try:
            _train(run, path)
        except Exception as error:
            return record_failure(run, folder, error)
        return Outcome(run.name, "done")


def record_failure(run: Run, folder: str | Path, error: Exception) -> Outcome:
    """Write an error and its traceback into a run's folder, if the disk takes them."""
    with contextlib.suppress(OSError):
        write_whole(Path(folder) / run.name / ERROR, "".join(traceback.format_exception(error)))
    return Outcome(run.name, "failed", f"{type(error).__name__}: {error}")


def is_running(path: Path) -> bool:
    """Whether some process holds a run's folder."""
    if not (path / LOCK).exists():
        return False
    with lock(path, patience=0.0) as locked:
        return not locked


class _Monitor(DiscountedReturnCallback):
    """Writes each training episode to a CSV file as it ends, and evaluates in the last tenth of task time."""

    def __init__(self, run: Run, file: Path):
        super().__init__(discount_rate(run))
        self.run, self.file = run, file
        #: Greedy episodes, and the task time in s at which they were played
        self.greedy: list[tuple[float, EpisodeStatistics]] = []
        self._evaluations_left = run.evaluations

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._start = time.monotonic()
        _write_csv(self.file, MONITOR_COLUMNS, [])

    def _on_step(self) -> bool:
        n_written = len(self.episodes)
        proceed = super()._on_step()
        for episode, timestep in zip(self.episodes[n_written:], self.timesteps[n_written:], strict=True):
            wall_seconds = time.monotonic() - self._start
            row = (timestep * self.run.dt, episode.discounted_return, episode.decision_rate_hz, wall_seconds)
            with self.file.open("a", newline="") as file:
                csv.writer(file).writerow([_short(value) for value in row])
        seconds = self.num_timesteps * self.run.dt
        # The last evaluation is that of the model which is saved.
        if self._evaluations_left > 1 and seconds >= self.run.task_seconds * (
            1.0 - 0.1 * (self._evaluations_left - 1) / self.run.evaluations
        ):
            self.evaluate(self.model)
        return proceed

    def evaluate(self, model: BaseAlgorithm) -> None:
        """Play greedy episodes."""
        self._evaluations_left -= 1
        env = make_eval_env(self.run, model)
        episodes = evaluate_discounted_return(model, env, self.run.eval_episodes, discount_rate=discount_rate(self.run))
        env.close()
        self.greedy += [(self.num_timesteps * self.run.dt, episode) for episode in episodes]

    def last_tenth(self) -> list[EpisodeStatistics]:
        """The episodes that ended in the last tenth of task time."""
        beginning = 0.9 * self.run.task_seconds
        return [e for e, n in zip(self.episodes, self.timesteps, strict=True) if n * self.run.dt > beginning]


def _train(run: Run, path: Path) -> None:
    th.set_num_threads(1)  # Several runs share the cores.
    commit, versions = git_commit(), package_versions()
    write_whole(path / VERSIONS, json.dumps({"commit": commit, **versions}, indent=1) + "\n")
    model = make_model(run)
    monitor = _Monitor(run, path / MONITOR)
    start = time.monotonic()
    model.learn(round(run.task_seconds * run.rate), monitor)
    wall_seconds = time.monotonic() - start
    model.save(path / "model.zip")

    monitor.evaluate(model)
    greedy = [episode for _, episode in monitor.greedy]
    _write_csv(
        path / EVALUATION,
        EVALUATION_COLUMNS,
        [(seconds, e.discounted_return, e.decision_rate_hz, e.episode_return) for seconds, e in monitor.greedy],
    )
    env = model.get_env()
    assert env is not None
    env.close()
    training = monitor.last_tenth()
    record = {
        "task": run.task,
        "algorithm": run.algorithm,
        "dt": run.dt,
        "seed": run.seed,
        "discounted_return": _short(np.mean([e.discounted_return for e in training])),
        "greedy_return": _short(np.mean([e.discounted_return for e in greedy])),
        "decision_rate_hz": _short(np.mean([e.decision_rate_hz for e in training])),
        "task_seconds": run.task_seconds,
        "updates": model._n_updates,  # type: ignore[attr-defined]
        "wall_seconds": round(wall_seconds, 1),
        "preset": run.preset,
        "setting": run.setting,
        "greedy_decision_rate_hz": _short(np.mean([e.decision_rate_hz for e in greedy])),
        "episode_return": _short(np.mean([e.episode_return for e in training])),
        "greedy_episode_return": _short(np.mean([e.episode_return for e in greedy])),
        "commit": commit,
        "fingerprint": run.fingerprint,
        "versions": " ".join(f"{name}={version}" for name, version in versions.items()),
    }
    # Last, and in one move: its presence says that the run is complete.
    write_whole(path / RECORD, json.dumps(record, indent=1) + "\n")


def package_versions() -> dict[str, str]:
    """Versions of Python and of what computes the results."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def git_commit() -> str:
    """Commit of the checkout that this package is imported from, "+" if it was changed; empty outside of one."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", os.path.dirname(sb3_ctco.__file__), *arguments]
        try:
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            return ""

    # A virtual environment may lie in a checkout of something else.
    return git("describe", "--always", "--abbrev=7", "--dirty=+", "--exclude=*") if git("ls-files", "__init__.py") else ""


def write_whole(file: Path, text: str) -> None:
    """Write a file such that whoever reads it sees all of it, or what was there before."""
    part = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        part.write_text(text, encoding="utf-8")
        replace_durably(part, file)
    finally:
        part.unlink(missing_ok=True)


def _write_csv(file: Path, columns: Sequence[str], rows: Sequence[Sequence[float]]) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows([_short(value) for value in row] for row in rows)


def _short(value: float | np.floating) -> float:
    return round(float(value), 5)
