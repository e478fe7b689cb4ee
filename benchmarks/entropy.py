"""Draw decisions a second and returns over training, for what entropy is relative to.

sb3-ctco study run --preset benchmarks/entropy.yml --folder runs/entropy
python benchmarks/entropy.py runs/entropy
"""

import argparse
import json
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

LABELS = {"average": "relative to its average (default)", "uniform": "relative to uniform", "paper": "log π, the paper's"}
#: Episodes that a point averages
WINDOW = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the study's")
    parser.add_argument("--figure", type=Path, default=Path("entropy.png"))
    args = parser.parse_args()
    mpl.use("Agg")
    figure, axes = plt.subplots(2, 2, figsize=(10, 5.5), sharex=True, sharey="row", layout="constrained")
    records = sorted(args.folder.glob("*/record.json"))
    if not records:
        raise SystemExit(f"no run in {args.folder} is complete")
    for record in records:
        run = json.loads(record.read_text())
        reference, start = run["setting"].split("-from-")
        episodes = np.genfromtxt(record.parent / "monitor.csv", delimiter=",", names=True)
        for row, column in enumerate(("decision_rate_hz", "discounted_return")):
            smooth = np.convolve(episodes[column], np.ones(WINDOW) / WINDOW, mode="valid")
            axes[row, int(start != "1")].plot(
                episodes["task_seconds"][WINDOW - 1 :] / 60,
                smooth,
                color=f"C{list(LABELS).index(reference)}",
                label=LABELS[reference] if run["seed"] == 0 else None,
            )
    for ax, start in zip(axes[0], ("1", "0.02"), strict=True):
        ax.set_title(f"temperatures start at {start}")
        ax.set_ylim(0, None)
    for ax in axes[1]:
        ax.set_xlabel("task time [min]")
    axes[0, 0].set_ylabel("decisions a second")
    axes[1, 0].set_ylabel("discounted return")
    axes[1, 0].legend()
    args.figure.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.figure, dpi=110)


if __name__ == "__main__":
    main()
