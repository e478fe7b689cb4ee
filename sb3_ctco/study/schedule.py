"""Which runs fit into so many hours, by what runs like them took."""

import heapq
from collections.abc import Mapping, Sequence

import numpy as np

from sb3_ctco.study.grid import Run
from sb3_ctco.study.records import Record

#: Wall time of a second of task time where nothing is known: what the dearest runs of preset quick take
UNKNOWN = 1.0


def costs(runs: Sequence[Run], *sources: Sequence[Record]) -> dict[str, float]:
    """Expected wall time of runs, in s.

    That of runs like it, a second of task time: of the same task, algorithm, setting and rate, else of other tasks, else of
    other settings; and if there is none, the dearest at its rate, or of all, so that what is unknown is not thought cheap.

    :param runs: the runs
    :param sources: records; what an earlier source knows is taken from there, because machines differ
    :return: by the runs' names
    """
    known: list[dict[tuple[object, ...], list[float]]] = []
    for records in sources:
        known.append({})
        for record in records:
            cost = record["wall_seconds"] / record["task_seconds"]
            for key in _keys(record["task"], record["algorithm"], record["setting"], round(1.0 / record["dt"])):
                known[-1].setdefault(key, []).append(cost)
    expected = {}
    for run in runs:
        keys = _keys(run.task, run.algorithm, run.setting, run.rate)
        found = next(((key, of[key]) for key in keys for of in known if key in of), None)
        # Of other algorithms the dearest; of the same the mean.
        cost = UNKNOWN if found is None else float(max(found[1]) if len(found[0]) < 2 else np.mean(found[1]))
        expected[run.name] = cost * run.task_seconds
    return expected


def _keys(task: str, algorithm: str, setting: str, rate: int) -> tuple[tuple[object, ...], ...]:
    return (task, algorithm, setting, rate), (algorithm, setting, rate), (algorithm, rate), (rate,), ()


def fit(runs: Sequence[Run], cost: Mapping[str, float], workers: int, seconds: float) -> list[tuple[float, Run]]:
    """The most telling runs that end in time: seed by seed, and the cheapest of a seed first.

    :param runs: those to choose from
    :param cost: their expected wall time, in s
    :param workers: number of processes
    :param seconds: how long there is
    :return: when each begins, in s, in that order
    """
    free = [0.0] * workers
    chosen = []
    for run in sorted(runs, key=lambda run: (run.seed, cost[run.name])):
        if free[0] + cost[run.name] <= seconds:
            chosen.append((free[0], run))
            heapq.heapreplace(free, free[0] + cost[run.name])
    return chosen
