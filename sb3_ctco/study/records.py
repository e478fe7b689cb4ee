"""Records of finished runs: one row a run, from folders or from one CSV file."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import RECORD, write_whole

Record = dict[str, Any]

#: Columns of the CSV file, and what their values are. ``dt`` and seconds are in s, returns in reward rate × s, rates in Hz.
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
    "commit": str,
    "fingerprint": str,
    "versions": str,
}
_KEY = ("preset", "task", "algorithm", "setting", "dt", "seed")


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
        records = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(source.glob(f"*/{RECORD}"))]
    elif source.is_file():
        with source.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(f"{source} lacks the columns {missing}: pass a file that `sb3-ctco study collect` wrote")
            records = [{name: kind(row[name]) for name, kind in COLUMNS.items()} for row in reader]
    else:
        raise ValueError(f"there is no folder or CSV file {source}")
    if not records:
        raise ValueError(f"no run in {source} is complete")
    return records


def collect(folders: Sequence[Path], into: Path) -> tuple[int, int]:
    """Merge the records of folders into a CSV file; rows that it has stay as they are.

    :param folders: of studies
    :param into: the file, made if there is none
    :return: the number of rows that are new, and of all rows
    :raises ValueError: if a run is there already with other settings
    """
    merged = {key(record): record for record in read_records(into)} if into.exists() else {}
    n_before = len(merged)
    for folder in folders:
        for record in read_records(folder):
            there = merged.setdefault(key(record), record)
            _refuse_other_fingerprint(there["fingerprint"], record["fingerprint"], key(record), into)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(merged[name] for name in sorted(merged))
    into.parent.mkdir(parents=True, exist_ok=True)
    write_whole(into, stream.getvalue())
    return len(merged) - n_before, len(merged)


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
            _refuse_other_fingerprint(found, run.fingerprint, key_of_run(run), file)
    return left


def _refuse_other_fingerprint(there: str, here: str, name: tuple[Any, ...], file: Path) -> None:
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
