"""Train CTCO on the paper's tasks and draw learning curves and decision rates.

    python benchmarks/learning.py run --task point_mass --rate 500 --seed 0
    python benchmarks/learning.py plot --folder benchmarks/records --figures benchmarks/figures

A run's records are one row an episode in FOLDER/<setting>/<task>_<rate>hz_seed<seed>.csv and its summary beside it. A
run that is complete is skipped; one that was interrupted starts again.
"""

import argparse
import csv
import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import torch as th

import sb3_ctco
from sb3_ctco.common.evaluation import DiscountedReturnCallback, evaluate_discounted_return

HERE = Path(__file__).parent
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "point_mass": ("sb3_ctco/point_mass-easy-v0", {"sparse": True}),
    "cheetah": ("sb3_ctco/cheetah-run-v0", {}),
    "ball_in_cup": ("sb3_ctco/ball_in_cup-catch-v0", {}),
}
TASK_NAMES = {"point_mass": "sparse point mass", "cheetah": "cheetah run", "ball_in_cup": "ball in cup"}

COMMON: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 100,
    "tau": 0.01,
    "updates_per_second": 20,
    "policy_kwargs": {"net_arch": {"pi": [10, 10], "qf": [64, 64]}},
}
#: Warm-up with random options, in s of task time
LEARNING_STARTS = 60.0
SETTINGS: dict[str, dict[str, Any]] = {
    # The paper's network sizes, penalty and number of basis functions. What the paper leaves open: temperatures that
    # start low, and a small step for d's head, as in its authors' code; without them the penalty drives d to d_max
    # before any reward is found.
    "paper": {
        **COMMON,
        "n_sub_options": 0,
        "n_rbf": 3,
        "d_max": 0.5,
        "high_freq_penalty": 0.05,
        "ent_coef": "auto_0.02",
        "duration_ent_coef": "auto_0.02",
        "duration_learning_rate": 1e-5,
    },
}


def make_env(task: str, rate: float) -> gym.Env:
    env_id, kwargs = TASKS[task]
    return gym.make(env_id, dt=1.0 / rate, time_limit=10.0, **kwargs)


def run(args: argparse.Namespace) -> None:
    folder = Path(args.folder) / args.setting
    stem = folder / f"{args.task}_{args.rate}hz_seed{args.seed}"
    summary_file = stem.with_suffix(".json")
    if summary_file.exists():
        print(f"{summary_file} is complete")
        return
    folder.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)
    dt = 1.0 / args.rate
    model = sb3_ctco.CTCO(
        "MlpPolicy",
        make_env(args.task, args.rate),
        seed=args.seed,
        learning_starts=round(LEARNING_STARTS / dt),
        buffer_size=200_000,
        **{**SETTINGS[args.setting], **args.override},
    )
    callback = DiscountedReturnCallback(model.discount_rate)
    start = time.time()
    model.learn(round(args.seconds / dt), callback, progress_bar=args.progress)
    wall_seconds = time.time() - start

    greedy = evaluate_discounted_return(model, model.wrap_env(make_env(args.task, args.rate)), 20)
    last_tenth = [e for e, n in zip(callback.episodes, callback.timesteps, strict=True) if n * dt > 0.9 * args.seconds]
    summary = {
        "setting": args.setting,
        "override": args.override,
        "task": args.task,
        "rate": args.rate,
        "seed": args.seed,
        "task_seconds": args.seconds,
        "discounted_return": float(np.mean([e.discounted_return for e in last_tenth])),
        "greedy_return": float(np.mean([e.discounted_return for e in greedy])),
        "decision_rate_hz": float(np.mean([e.decision_rate_hz for e in last_tenth])),
        "greedy_decision_rate_hz": float(np.mean([e.decision_rate_hz for e in greedy])),
        "updates": model._n_updates,
        "wall_seconds": wall_seconds,
        "commit": _commit(),
    }
    with stem.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["seconds", "discounted_return", "decision_rate_hz"])
        for episode, n in zip(callback.episodes, callback.timesteps, strict=True):
            writer.writerow([round(n * dt, 2), round(episode.discounted_return, 4), round(episode.decision_rate_hz, 3)])
    model.save(stem.with_suffix(".zip"))
    # Last, and in one move: its presence says that the run is complete.
    unfinished = summary_file.with_suffix(".tmp")
    unfinished.write_text(json.dumps(summary, indent=1) + "\n")
    os.replace(unfinished, summary_file)
    print(json.dumps(summary))


def plot(args: argparse.Namespace) -> None:
    """Learning curves and decision rates of all complete runs of a setting, and a table of their summaries."""
    mpl.use("Agg")
    figures = Path(args.figures)
    figures.mkdir(parents=True, exist_ok=True)
    runs = [json.loads(path.read_text()) for path in sorted((Path(args.folder) / args.setting).glob("*.json"))]
    for column, label in (("discounted_return", "discounted return"), ("decision_rate_hz", "decisions a second")):
        figure, axes = plt.subplots(1, len(TASKS), figsize=(12, 3.5), layout="constrained")
        for ax, task in zip(axes, TASKS, strict=True):
            for one in (one for one in runs if one["task"] == task):
                name = f"{task}_{one['rate']}hz_seed{one['seed']}.csv"
                episodes = np.genfromtxt(Path(args.folder) / args.setting / name, delimiter=",", names=True)
                window = min(12, len(episodes))
                smooth = np.convolve(episodes[column], np.ones(window) / window, mode="valid")
                colour = {50: "C0", 500: "C1"}.get(one["rate"], "C2")
                ax.plot(episodes["seconds"][window - 1 :] / 60, smooth, color=colour, label=f"{one['rate']} Hz")
            ax.set(title=TASK_NAMES[task], xlabel="task time [min]", ylim=(0, None))
        axes[0].set_ylabel(f"{label}\n(mean of 12 training episodes)")
        axes[0].legend(title="interaction frequency")
        figure.savefig(figures / f"{args.setting}_{column}.png", dpi=120)
        plt.close(figure)
    print("| task | interaction frequency | seed | training return | greedy return | decisions a second | wall time |")
    print("|---|---|---|---|---|---|---|")
    for one in sorted(runs, key=lambda one: (list(TASKS).index(one["task"]), one["rate"], one["seed"])):
        print(
            f"| {TASK_NAMES[one['task']]} | {one['rate']} Hz | {one['seed']} | {one['discounted_return']:.2f} | "
            f"{one['greedy_return']:.2f} | {one['decision_rate_hz']:.1f} | {one['wall_seconds']:.0f} s |"
        )


def _commit() -> str:
    result = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=HERE, check=False)
    return result.stdout.strip() or "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("run")
    one.add_argument("--task", choices=TASKS, required=True)
    one.add_argument("--rate", type=int, required=True, help="interaction frequency, Hz")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--setting", choices=SETTINGS, default="paper")
    one.add_argument("--override", type=json.loads, default={}, help='JSON, e.g. {"d_max": 1.0}; use a --folder of its own')
    one.add_argument("--seconds", type=float, default=2400.0, help="task time")
    one.add_argument("--folder", default="runs/learning")
    one.add_argument("--progress", action="store_true")
    one.set_defaults(call=run)
    drawing = commands.add_parser("plot")
    drawing.add_argument("--setting", choices=SETTINGS, default="paper")
    drawing.add_argument("--folder", default="runs/learning")
    drawing.add_argument("--figures", default="runs/learning/figures")
    drawing.set_defaults(call=plot)
    args = parser.parse_args()
    args.call(args)


if __name__ == "__main__":
    main()
