"""Records and learning curves of runs, from folders or from CSV files."""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import MONITOR, RECORD, SETTINGS, read_json, write_whole

Record = dict[str, Any]

#: Columns of the CSV file, and what their values are. ``dt`` and seconds are in s, rates in Hz, ``discounted_return`` and
#: ``greedy_return`` in reward rate × s; ``episode_return`` and ``greedy_episode_return`` are plain sums of rewards.
COLUMNS: dict[str, type] = {
    "task": str,
    "algorithm": str,
    "dt": float,
    "seed": int,
    "discounted_return": float,
    "greedy_return": float,
    "decision_rate_hz": float,
    "task_seconds": float,
    "updates": int,
    "wall_seconds": float,
    "preset": str,
    "setting": str,
    "greedy_decision_rate_hz": float,
    "episode_return": float,
    "greedy_episode_return": float,
    "commit": str,
    "fingerprint": str,
    "versions": str,
}
_KEY = ("preset", "task", "algorithm", "setting", "dt", "seed")
#: Columns of the CSV file of learning curves: whose point it is, its task time in s, and its return
CURVE_COLUMNS: dict[str, type] = {
    **{name: COLUMNS[name] for name in _KEY},
    "seconds": float,
    "discounted_return": float,
}
#: Training episodes that a point of a learning curve is the mean of
CURVE_EPISODES = 12


def key(record: Record) -> tuple[Any, ...]:
    """What tells a run from the others."""
    return tuple(record[name] for name in _KEY)


def key_of_run(run: Run) -> tuple[Any, ...]:
    """The key that the run's record has."""
    return tuple(getattr(run, name) for name in _KEY)


def read_records(source: Path) -> list[Record]:
    """Records of a study's folder, or of a CSV file.

    :raises ValueError: if there are none, or the file lacks a column
    """
    if source.is_dir():
        # Runs of before had no sums of rewards.
        none = {"episode_return": math.nan, "greedy_episode_return": math.nan}
        records = [{**none, **read_json(file)} for file in sorted(source.glob(f"*/{RECORD}"))]
    elif source.is_file():
        records = _read_csv(source, COLUMNS)
    else:
        raise ValueError(f"there is no folder or CSV file {source}")
    if not records:
        raise ValueError(f"no run in {source} is complete")
    return records


def curves_file(file: Path) -> Path:
    """Where :func:`collect` puts learning curves: ``NAME_curves.csv`` beside ``NAME.csv``."""
    return file.with_name(f"{file.stem}_curves.csv")


def read_curves(source: Path) -> list[Record]:
    """Learning curves of a study's folder (of runs in flight, too), or those beside a CSV file; empty if there are none.

    :return: points, each the mean of (up to) ``CURVE_EPISODES`` training episodes and the task time at the end of the last
    """
    if not source.is_dir():
        file = curves_file(source)
        return _read_csv(file, CURVE_COLUMNS) if file.exists() else []
    return [point for file in sorted(source.glob(f"*/{MONITOR}")) for point in _curve(file.parent)]


def collect(folders: Sequence[Path], into: Path) -> tuple[int, int]:
    """Merge records of folders into a CSV file, and learning curves into one beside it; what they have stays as it is.

    :param folders: of studies
    :param into: the file, made if there is none; see :func:`curves_file` for the other
    :return: the number of rows that are new, and of all rows
    :raises ValueError: if a run is there already with other settings, or ``into`` is a folder
    """
    if into.is_dir():
        raise ValueError(f"{into} is a folder: name a CSV file")
    # It may have no rows yet, but its columns.
    merged = {key(record): record for record in _read_csv(into, COLUMNS)} if into.exists() else {}
    curves = _by_run(read_curves(into))
    n_before = len(merged)
    for folder in folders:
        of_folder = _by_run(read_curves(folder))
        for record in read_records(folder):
            name = key(record)
            there = merged.setdefault(name, record)
            refuse_other_fingerprint(there["fingerprint"], record["fingerprint"], name, into)
            curves.setdefault(name, of_folder.get(name, []))
    into.parent.mkdir(parents=True, exist_ok=True)
    points = (point for name in sorted(curves) for point in curves[name])
    write_whole(curves_file(into), _as_csv(CURVE_COLUMNS, points))
    write_whole(into, _as_csv(COLUMNS, (merged[name] for name in sorted(merged))))
    return len(merged) - n_before, len(merged)


def _by_run(points: Iterable[Record]) -> dict[tuple[Any, ...], list[Record]]:
    curves: dict[tuple[Any, ...], list[Record]] = {}
    for point in points:
        curves.setdefault(key(point), []).append(point)
    return curves


def _curve(run_folder: Path) -> Iterator[Record]:
    settings = json.loads((run_folder / SETTINGS).read_text(encoding="utf-8"))
    with (run_folder / MONITOR).open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["wall_seconds"]]  # The last may be half written.
    window = min(CURVE_EPISODES, len(rows) // 2)
    for end in range(window, len(rows) + 1, window) if window else ():
        returns = [float(row["discounted_return"]) for row in rows[end - window : end]]
        yield {
            **{name: settings[name] for name in _KEY if name != "dt"},
            "dt": 1.0 / settings["rate"],
            "seconds": float(rows[end - 1]["task_seconds"]),
            "discounted_return": round(sum(returns) / window, 5),
        }


def _read_csv(file: Path, columns: dict[str, type]) -> list[Record]:
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{file} lacks the columns {missing}: pass a file that `sb3-ctco study collect` wrote")
        rows = []
        for number, row in enumerate(reader, start=2):
            try:
                rows.append({name: kind(row[name]) for name, kind in columns.items()})
            except (TypeError, ValueError) as error:
                raise ValueError(f"{file}, line {number}, is damaged or cut off ({error}): {row}") from None
        return rows


def _as_csv(columns: dict[str, type], rows: Iterable[Record]) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def without_recorded(runs: Iterable[Run], file: Path) -> list[Run]:
    """The runs that a CSV file has no row of.

    :raises ValueError: if it has a row with other settings
    """
    recorded = {key(record): record["fingerprint"] for record in read_records(file)}
    left = []
    for run in runs:
        found = recorded.get(key_of_run(run))
        if found is None:
            left.append(run)
        else:
            refuse_other_fingerprint(found, run.fingerprint, key_of_run(run), file)
    return left


def refuse_other_fingerprint(there: str, here: str, name: tuple[Any, ...], file: Path) -> None:
    """Raise ``ValueError`` if two records of one run were made with different settings."""
    if there != here:
        raise ValueError(
            f"{file} has run {name} with other settings (fingerprint {there}, not {here}): remove its row, or use another file"
        )


def paper_returns() -> dict[tuple[str, str], dict[int, float]]:
    """The numbers of the paper's figure: discounted return by task and algorithm, and then by rate in Hz."""
    text = (resources.files("sb3_ctco.study") / "figure_frequency.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        (row["task"], row["algorithm"].lower().replace("-", "_")): {
            int(column.removeprefix("hz")): float(value) for column, value in row.items() if column.startswith("hz")
        }
        for row in rows
    }
