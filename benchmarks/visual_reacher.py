"""Gather runs of examples/visual_reacher.py into results/ and draw their learning curves.

    python benchmarks/visual_reacher.py runs/visual_reacher    # gather, then draw
    python benchmarks/visual_reacher.py                        # draw what has been gathered

A row a run goes to results/visual_reacher.csv, a row an episode to results/visual_reacher_episodes.csv; runs that are there
already are replaced.
"""

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).parents[1]
RUNS, EPISODES = ROOT / "results" / "visual_reacher.csv", ROOT / "results" / "visual_reacher_episodes.csv"
#: What tells runs apart
KEY = ("difficulty", "algorithm", "rate", "seed", "n_sub_options", "asynchronous")
#: Of the real robot, easy, at 50 Hz after about 95 minutes, five runs each, read by eye from its authors' plots (±0.05)
PAPER = {"ctco": 1.22, "sac": 1.10}
LABELS = {
    ("ctco", "0", "False"): ("CTCO, no sub-options", "C2"),
    ("ctco", "4", "False"): ("CTCO", "C0"),
    ("ctco", "4", "True"): ("CTCO, asynchronous, in real time", "C4"),
    ("sac", "0", "False"): ("SAC", "C1"),
}
#: Episodes that a point averages
WINDOW = 15


def read(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def key_of(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(str(row[column]) for column in KEY)


def gather(folder: Path) -> None:
    runs, episodes = read(RUNS), read(EPISODES)
    for file in sorted(folder.glob("*.json")):
        summary = json.loads(file.read_text())
        ticks = summary.pop("ticks") or {}
        row = {key: round(value, 4) if isinstance(value, float) else value for key, value in summary.items()}
        row |= {f"ticks_{key}": round(value, 6) for key, value in ticks.items()}
        identity = {column: row[column] for column in KEY}
        runs = [other for other in runs if key_of(other) != key_of(row)] + [row]
        episodes = [other for other in episodes if key_of(other) != key_of(row)]
        episodes += [identity | episode for episode in read(file.with_suffix(".csv"))]
    write(RUNS, sorted(runs, key=key_of))
    write(EPISODES, sorted(episodes, key=key_of))


def draw(path: Path) -> None:
    mpl.use("Agg")
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), sharex=True, sharey="row", layout="constrained")
    curves: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for episode in read(EPISODES):
        curves.setdefault(key_of(episode), []).append(episode)
    for (difficulty, algorithm, _, _, n_sub_options, asynchronous), rows in curves.items():
        label, colour = LABELS[algorithm, n_sub_options, asynchronous]
        minutes = np.array([float(row["seconds"]) for row in rows]) / 60
        for ax, column in zip(axes[:, int(difficulty == "hard")], ("discounted_return", "decision_rate_hz"), strict=True):
            values = np.array([float(row[column]) for row in rows])
            smooth = np.convolve(values, np.ones(WINDOW) / WINDOW, mode="valid")
            ax.plot(minutes[WINDOW - 1 :], smooth, color=colour, label=label)
    for algorithm, value in PAPER.items():
        label, colour = LABELS[algorithm, "4" if algorithm == "ctco" else "0", "False"]
        axes[0, 0].axhline(value, color=colour, linestyle=":", label=f"{label}, the paper's robot after 95 min")
    axes[0, 0].set_ylabel("discounted return")
    axes[1, 0].set_ylabel("decisions a second")
    axes[1, 0].set_yscale("log")
    for ax, title in zip(axes[0], ("easy, 50 Hz", "hard, 50 Hz"), strict=True):
        ax.set_title(title)
    for ax in axes[1]:
        ax.set_xlabel("task time [min]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=3, fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "images" / "visual_reacher.png")
    args = parser.parse_args()
    for folder in args.folders:
        gather(folder)
    draw(args.figure)


if __name__ == "__main__":
    main()
