"""Free, continuous and smooth joins: returns, jerk and jumps of trained policies, and a picture of their actions.

    sb3-ctco study run --preset benchmarks/joins.yml
    python benchmarks/joins.py table runs/study/joins
    python benchmarks/joins.py figure runs/study/joins --task cheetah --output docs/images/joins.png

`table` plays the greedy policy of each run that is complete, and prints a row a task and setting: means over seeds, with the
smallest and the largest. The jump at joins is the largest change of an action from one step to the next where a new option
begins, that within is the largest elsewhere; actions count as normalised to [−1, 1].

`figure` draws the first action of one greedy episode a setting, with a dot where an option begins.
"""

import argparse
import json
import warnings
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.evaluation import largest_jump, mean_absolute_jerk
from sb3_ctco.options import ActionBox, discount
from sb3_ctco.study.agents import make_eval_env
from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import RECORD, SETTINGS

COLUMNS = ("return in training", "greedy return", "decisions/s", "mean jerk, 1/s³", "largest jump at joins", "within options")


def load(folder: Path) -> tuple[Run, CTCO]:
    return Run(**json.loads((folder / SETTINGS).read_text())), CTCO.load(folder / "model.zip", device="cpu", buffer_size=1)


def play(run: Run, model: CTCO, n_episodes: int = 1) -> Iterable[tuple[float, np.ndarray, np.ndarray]]:
    """Greedy episodes: discounted return, normalised actions ``[n_steps, action_dim]``, and the steps where options begin."""
    env = make_eval_env(run, model)
    space = model.primitive_action_space
    assert space is not None
    box = ActionBox(space.low, space.high)
    for _ in range(n_episodes):
        obs, done = env.reset(), False
        value, actions, begins = 0.0, [], [0]
        while not done:
            obs, _, (done,), (info,) = env.step(model.predict(obs, deterministic=True)[0])  # type: ignore[arg-type, misc]
            option = info["option"]
            value += float(discount(begins[-1] * run.dt, model.discount_rate)) * option["integrated_reward"]
            actions.append(box.normalise(env.get_attr("played")[0]))
            begins.append(begins[-1] + option["n_steps"])
        yield value, np.concatenate(actions), np.array(begins[:-1])
    env.close()


def measure(run: Run, model: CTCO, record: dict[str, Any], n_episodes: int) -> list[float]:
    """The columns of the table, for one run."""
    values, rates, jerks, at_joins, within = [], [], [], [], []
    for value, actions, begins in play(run, model, n_episodes):
        steps = np.abs(np.diff(actions, axis=0)).max(axis=1)
        is_join = np.isin(np.arange(1, len(actions)), begins)
        values.append(value)
        rates.append(len(begins) / (len(actions) * run.dt))
        jerks.append(mean_absolute_jerk(actions, run.dt))
        at_joins.append(steps[is_join].max(initial=0.0))
        within.append(steps[~is_join].max(initial=0.0))
        assert max(at_joins[-1], within[-1]) == largest_jump(actions)
    return [record["discounted_return"], np.mean(values), np.mean(rates), np.mean(jerks), np.max(at_joins), np.max(within)]


def table(args: argparse.Namespace) -> None:
    rows: dict[tuple[str, str], list[list[float]]] = defaultdict(list)
    for file in sorted(args.folder.glob(f"*/{RECORD}")):
        run, model = load(file.parent)
        rows[run.task, run.setting].append(measure(run, model, json.loads(file.read_text()), args.episodes))
    print(f"| task | joins | seeds | {' | '.join(COLUMNS)} |\n|{'---|' * (3 + len(COLUMNS))}")
    for (task, setting), seeds in sorted(rows.items()):
        numbers = np.array(seeds)
        summary = zip(numbers.mean(axis=0), numbers.min(axis=0), numbers.max(axis=0), strict=True)
        cells = [f"{mean:.3g} ({low:.3g} to {high:.3g})" for mean, low, high in summary]
        print(f"| {task} | {setting} | {len(seeds)} | {' | '.join(cells)} |")


def figure(args: argparse.Namespace) -> None:
    import matplotlib.pyplot as plt

    folders = [args.folder / f"{args.task}-ctco_{setting}-{args.rate}hz-seed{args.seed}" for setting in args.settings]
    _, panels = plt.subplots(
        len(folders), sharex=True, sharey=True, squeeze=False, figsize=(8, 2 * len(folders)), layout="tight"
    )
    for panel, folder in zip(panels[:, 0], folders, strict=True):
        run, model = load(folder)
        [(_, actions, begins)] = play(run, model)
        n_steps = round(args.seconds * run.rate)
        begins, signal = begins[begins < n_steps], actions[:n_steps, 0]
        panel.step(np.arange(len(signal)) * run.dt, signal, where="post", linewidth=1)
        panel.plot(begins * run.dt, signal[begins], "o", markersize=3, color="C1")
        panel.set(title=f"join={model.join!r}", ylabel="action", ylim=(-1.05, 1.05))
    panels[-1, 0].set_xlabel("time, s")
    plt.savefig(args.output, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    of_table = commands.add_parser("table")
    of_table.set_defaults(command=table)
    of_table.add_argument("folder", type=Path)
    of_table.add_argument("--episodes", type=int, default=5)
    of_figure = commands.add_parser("figure")
    of_figure.set_defaults(command=figure)
    of_figure.add_argument("folder", type=Path)
    of_figure.add_argument("--task", default="cheetah")
    of_figure.add_argument("--rate", type=int, default=500)
    of_figure.add_argument("--seed", type=int, default=0)
    of_figure.add_argument("--settings", nargs="+", default=["tuned", "continuous", "smooth"])
    of_figure.add_argument("--seconds", type=float, default=2.0)
    of_figure.add_argument("--output", type=Path, default=Path("joins.png"))
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*GLFW.*")
    th.set_num_threads(1)
    args.command(args)


if __name__ == "__main__":
    main()
