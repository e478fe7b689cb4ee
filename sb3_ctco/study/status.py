"""How far a study is, read from its folder."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sb3_ctco.study.runs import ERROR, MONITOR, RECORD, SETTINGS, is_running, read_json

State = Literal["waiting", "running", "failed", "done"]
#: Number of episodes that a current return is the mean of
RECENT = 10


@dataclass(frozen=True)
class RunStatus:
    """How far a run is.

    :param name: of the run
    :param cell: its algorithm, setting and rate in Hz, by which runs cost about the same
    :param state: ``"running"`` if some process is at it
    :param progress: fraction of its task time
    :param wall_seconds: wall time that it took so far, in s
    :param recent_return: mean discounted return of its last ten training episodes; nan if there is none
    :param error: last line of its traceback
    """

    name: str
    cell: tuple[str, str, int]
    state: State
    progress: float = 0.0
    wall_seconds: float = 0.0
    recent_return: float = math.nan
    error: str = ""


@dataclass(frozen=True)
class Status:
    """How far a study is."""

    runs: tuple[RunStatus, ...]

    def of(self, state: State) -> list[RunStatus]:
        """The runs in a state."""
        return [run for run in self.runs if run.state == state]

    def seconds_left(self, workers: int) -> float:
        """Wall time until all are done, in s: each run as long as those of its algorithm, setting and rate take.

        :param workers: number of processes
        :return: nan before anything is known
        """
        known: dict[tuple[str, str, int], list[float]] = {}
        for run in self.runs:
            if run.state in ("done", "running") and run.progress > 0:
                known.setdefault(run.cell, []).append(run.wall_seconds / run.progress)
        if not known:
            return math.nan
        cost = {cell: float(np.mean(seconds)) for cell, seconds in known.items()}
        typical = float(np.mean(list(cost.values())))
        left = [(1.0 - run.progress) * cost.get(run.cell, typical) for run in self.runs if run.state in ("waiting", "running")]
        return max([sum(left) / workers, *left])

    def summary(self, workers: int | None = None) -> str:
        """One line: runs done of all, and time left.

        :param workers: number of processes; as many as are running by default
        """
        running, failed = self.of("running"), self.of("failed")
        parts = [f"{len(self.of('done'))} of {len(self.runs)} runs done", f"{len(running)} running"]
        if failed:
            parts.append(f"{len(failed)} failed")
        workers = len(running) if workers is None else workers
        if workers and (running or self.of("waiting")):
            parts.append(f"{clock(self.seconds_left(workers))} left")
        return ", ".join(parts)

    def details(self) -> list[str]:
        """A line for each run that is running, with its current return, and for each that failed."""
        return [
            *(f"running {one.name}: {100 * one.progress:.0f} %, return {one.recent_return:.2f}" for one in self.of("running")),
            *(f"failed  {one.name}: {one.error}" for one in self.of("failed")),
        ]


def read_status(folder: Path, names: Sequence[str] | None = None) -> Status:
    """Look at the runs that are planned in a folder.

    :param folder: the study's
    :param names: of the runs to look at; all by default
    :raises ValueError: if the folder has no run
    """
    paths = sorted(file.parent for file in folder.glob(f"*/{SETTINGS}"))
    if names is not None:
        paths = [path for path in paths if path.name in set(names)]
    if not paths:
        raise ValueError(f"{folder} is no folder of a study: there is no run in it")
    return Status(tuple(_read_run(path) for path in paths))


def _read_run(path: Path) -> RunStatus:
    settings = read_json(path / SETTINGS)
    cell = (settings["algorithm"], settings["setting"], settings["rate"])
    if (path / RECORD).exists():
        record = read_json(path / RECORD)
        return RunStatus(path.name, cell, "done", 1.0, record["wall_seconds"], record["discounted_return"])
    if is_running(path):
        return RunStatus(path.name, cell, "running", *_progress(path, settings))
    if (path / ERROR).exists():
        error = (path / ERROR).read_text(encoding="utf-8").strip().splitlines()[-1]
        return RunStatus(path.name, cell, "failed", error=error)
    return RunStatus(path.name, cell, "waiting")


def _progress(path: Path, settings: dict[str, Any]) -> tuple[float, float, float]:
    """Fraction of task time, wall time in s, and recent return, from the episodes so far."""
    try:
        with (path / MONITOR).open(newline="") as file:
            # The last row may be half written.
            rows = [row for row in csv.DictReader(file) if row["wall_seconds"]]
    except FileNotFoundError:
        rows = []
    if not rows:
        return 0.0, 0.0, math.nan
    return (
        min(float(rows[-1]["task_seconds"]) / settings["task_seconds"], 1.0),
        float(rows[-1]["wall_seconds"]),
        float(np.mean([float(row["discounted_return"]) for row in rows[-RECENT:]])),
    )


def clock(seconds: float) -> str:
    """Seconds in words."""
    if math.isnan(seconds):
        return "unknown time"
    minutes = math.ceil(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
