"""Is CTCO SAC, where options take one step? Learning curves of both on two of Gymnasium's tasks, from results/native.csv.

    python benchmarks/one_step.py

Draws results/native/one_step.png, and prints for how much of the task time each mean is inside the other's 95 % interval.
"""

from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import numpy as np

from sb3_ctco.study.records import read_curves
from sb3_ctco.study.scores import mean_and_interval, rate_of

mpl.use("Agg")
from matplotlib import pyplot as plt

RESULTS = Path(__file__).parents[1] / "results"
TASKS = ("HalfCheetah-v5", "Hopper-v5")
LABELS = {"sac": "SAC", "ctco": "CTCO, options of one step"}


def curves(task: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Task time in s, and by algorithm mean returns and half widths of their intervals, ``[n, 2]``."""
    runs: dict[str, dict[int, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for point in read_curves(RESULTS / "native.csv"):
        if point["task"] == task and (point["algorithm"] == "sac" or point["setting"] == f"one-step-{rate_of(point)}hz"):
            runs[point["algorithm"]][point["seed"]].append((point["seconds"], point["discounted_return"]))
    all_runs = [np.array(points) for of_seeds in runs.values() for points in of_seeds.values()]
    seconds = np.linspace(max(run[0, 0] for run in all_runs), min(run[-1, 0] for run in all_runs), 200)
    intervals = {}
    for algorithm, of_seeds in runs.items():
        interpolated = [np.interp(seconds, *zip(*run, strict=True)) for run in of_seeds.values()]
        intervals[algorithm] = np.array([mean_and_interval(at) for at in zip(*interpolated, strict=True)])
    return seconds, intervals


def main() -> None:
    figure, axes = plt.subplots(1, len(TASKS), figsize=(9, 3.2), layout="constrained")
    print("| task | CTCO's mean inside SAC's interval | SAC's mean inside CTCO's |\n|---|---|---|")
    for ax, task in zip(axes, TASKS, strict=True):
        seconds, of = curves(task)
        gap = np.abs(of["ctco"][:, 0] - of["sac"][:, 0])
        print(f"| {task} | {np.mean(gap <= of['sac'][:, 1]):.0%} | {np.mean(gap <= of['ctco'][:, 1]):.0%} |")
        for colour, (algorithm, label) in zip(("C1", "C0"), LABELS.items(), strict=True):
            means, half_widths = of[algorithm].T
            ax.plot(seconds / 60, means, color=colour, linewidth=1.2, label=label)
            ax.fill_between(seconds / 60, means - half_widths, means + half_widths, color=colour, alpha=0.15, linewidth=0)
        ax.set_title(task, fontsize=10)
        ax.set_xlabel("task time [min]")
    axes[0].set_ylabel("discounted return, training")
    axes[0].legend(frameon=False, title="five seeds, 95 % interval", alignment="left")
    (RESULTS / "native").mkdir(exist_ok=True)
    figure.savefig(RESULTS / "native" / "one_step.png", dpi=150)


if __name__ == "__main__":
    main()
