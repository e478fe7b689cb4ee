"""Comparisons over all tasks, of returns divided by the best one: profiles, probability of improvement, mean over rates."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_ctco.registry import ALGORITHMS, find_task
from sb3_ctco.study import plots
from sb3_ctco.study.plots import (
    Line,
    _apart,
    _interval_cell,
    _legend,
    _line_of,
    _panels,
    _rate,
    _rate_axis,
    _row,
    _seeds,
    _style,
    by_line,
    lines_of,
    mean_and_interval,
    tasks_of,
)
from sb3_ctco.study.records import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DECISION_RATES = (1, 2, 5, 10, 20, 50, 100, 200, 500)
#: What a step held for so many steps is called in a preset, and the line of the best of them
STEPS, BEST = "steps", "best"


def with_equal_repeats(records: Sequence[Record]) -> list[Record]:
    """Records in which SAC stands for an action repeat wherever it is one, and the best repeat is a line of its own.

    An action that is held for one step, or for 20 ms at 50 Hz, is SAC itself. Of the settings of ``sac_repeat`` in steps, that
    with the best mean return in training is kept for each task and rate, as setting ``best``: it is chosen by what it is
    judged by, which favours it.
    """
    repeats = [record for record in records if record["algorithm"] == "sac_repeat"]
    if not repeats:
        return list(records)
    sac = [{**record, "algorithm": "sac_repeat"} for record in records if record["algorithm"] == "sac"]
    held = {record["setting"] for record in repeats if not record["setting"].endswith(STEPS)}
    kept = [record for record in records if record["algorithm"] != "sac_repeat" or record["setting"] in held]
    kept += [{**record, "setting": name} for record in sac if (name := f"{1000 * record['dt']:g}ms") in held]
    cells: dict[tuple[str, int], dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in [*sac, *(record for record in repeats if record["setting"] not in held)]:
        cells[record["task"], _rate(record)][record["setting"]].append(record)
    for of_setting in cells.values():
        best = max(of_setting.values(), key=lambda group: float(np.mean([one["discounted_return"] for one in group])))
        kept += [{**record, "setting": BEST} for record in best]
    return kept


def relative_scores(records: Sequence[Record], metric: str) -> dict[Line, dict[int, np.ndarray]]:
    """Returns divided by the best mean over seeds at any rate, for each task where that is positive.

    :return: by line, then by rate in Hz, ``[n_seeds, n_tasks]``, of the seeds that are complete in all tasks
    """
    tasks = tasks_of(records)
    best = {
        task: max(float(np.mean(values)) for rates in by_line(records, task, metric).values() for values in rates.values())
        for task in tasks
    }
    # What costs have no share of what can be had.
    tasks = [task for task in tasks if best[task] > 0]
    values = {(_line_of(record), _rate(record), record["seed"], record["task"]): record[metric] for record in records}
    scores: dict[Line, dict[int, np.ndarray]] = {}
    for line in lines_of(records):
        for rate in sorted({_rate(record) for record in records}):
            seeds = sorted({key[2] for key in values if key[:2] == (line, rate)})
            complete = [seed for seed in seeds if all((line, rate, seed, task) in values for task in tasks)]
            if complete and tasks:
                matrix = [[values[line, rate, seed, task] / best[task] for task in tasks] for seed in complete]
                scores.setdefault(line, {})[rate] = np.array(matrix)
    return scores


def frequency_averaged(scores: dict[Line, dict[int, np.ndarray]]) -> dict[Line, tuple[float, float, float]]:
    """Interquartile mean, over seeds and tasks, of the mean over rates of relative scores, with its 95 % interval.

    Of lines that have all rates; as many seeds as each rate has.
    """
    from rliable.metrics import aggregate_iqm

    rates = {rate for of_rates in scores.values() for rate in of_rates}
    averaged = {}
    for line, of_rates in scores.items():
        if set(of_rates) == rates:
            n_seeds = min(len(matrix) for matrix in of_rates.values())
            mean = np.mean([matrix[:n_seeds] for matrix in of_rates.values()], axis=0)
            averaged[line] = _estimate(aggregate_iqm, mean)
    return averaged


def improvement(scores: dict[Line, dict[int, np.ndarray]], of: Line) -> dict[Line, dict[int, tuple[float, float, float]]]:
    """Probability that a seed of one line has more than one of another, mean over tasks, with its 95 % interval.

    :param of: the line that is compared with all others
    :return: by the other line, then by rate in Hz
    """
    better: dict[Line, dict[int, tuple[float, float, float]]] = {}
    for line, of_rates in scores.items():
        for rate, matrix in of_rates.items():
            if line != of and rate in scores[of]:
                estimate = _estimate(_probability_of_improvement, scores[of][rate], matrix)
                better.setdefault(line, {})[rate] = estimate
    return better


def _probability_of_improvement(one: np.ndarray, other: np.ndarray) -> float:
    """rliable's, in one go for the bootstrap: the share of pairs of seeds in which one is ahead; a tie is half of one."""
    ahead = one[:, None] - other[None, :]
    return float(np.mean((ahead > 0) + 0.5 * (ahead == 0)))


def _estimate(function: Callable[..., float], *matrices: np.ndarray) -> tuple[float, float, float]:
    """An estimate with rliable's 95 % interval, by a bootstrap over seeds within tasks; nan for one seed."""
    from rliable.library import get_interval_estimates

    value = float(function(*matrices))
    if min(map(len, matrices)) < 2:
        return value, float("nan"), float("nan")
    given = matrices[0] if len(matrices) == 1 else list(matrices)
    with plots.repeatable():
        _, intervals = get_interval_estimates(
            {"": given}, lambda *resampled: np.array([function(*resampled)]), reps=plots._BOOTSTRAP_REPETITIONS
        )
    return value, float(intervals[""][0, 0]), float(intervals[""][1, 0])


def draw_pareto(records: Sequence[Record], metric: str) -> "Figure":
    """Return over decisions a second: a row a rate, a column a task, a point a setting; three or more are joined."""
    tasks, lines = tasks_of(records), lines_of(records)
    rates = sorted({_rate(record) for record in records})
    figure, axes = _panels(len(rates), len(tasks))
    for row, rate in zip(axes, rates, strict=True):
        for ax, task in zip(row, tasks, strict=True):
            here = [record for record in records if record["task"] == task and _rate(record) == rate]
            decisions = {line: float(np.mean(of[rate])) for line, of in by_line(here, task, "decision_rate_hz").items()}
            returns = {line: mean_and_interval(of[rate]) for line, of in by_line(here, task, metric).items()}
            for algorithm in dict.fromkeys(line[0] for line in lines):
                swept = sorted((decisions[line], *returns[line]) for line in returns if line[0] == algorithm)
                if swept:
                    x, y, half_width = np.array(swept).T
                    row_of = ALGORITHMS[algorithm]
                    style: dict[str, Any] = {"fmt": "o-" if len(swept) > 2 else "o", "color": row_of.colour, "linewidth": 0.8}
                    ax.errorbar(x, y, half_width, label=row_of.label, markersize=4, capsize=2, **style)
            ax.set_xscale("log")
            ax.set_xticks(_DECISION_RATES, [str(tick) for tick in _DECISION_RATES])
            ax.minorticks_off()
            ax.set_xlim(0.8, 700.0)
            ax.set_visible(bool(returns))  # A task that has a rate of its own has nothing at others'.
            means = [0.0, *(value for value, _ in returns.values())]
            ax.set_ylim(min(means) - 0.04 * max(*means, 0.1), 1.15 * max(*means, 0.1))
            ax.set_title(f"{find_task(task).label}, {rate} Hz")
        row[0].set_ylabel("discounted return")
    for ax in axes[-1]:
        ax.set_xlabel("decisions a second")
    _legend(figure, f"a point a setting; 95 % interval (Student's t) of {_seeds(records)}")
    return figure


def draw_profiles(records: Sequence[Record], scores: dict[Line, dict[int, np.ndarray]]) -> "Figure":
    """Performance profiles: the share of runs, over tasks and seeds, whose score is above a threshold; a panel a rate."""
    from rliable.library import create_performance_profile

    rates = sorted({rate for of_rates in scores.values() for rate in of_rates})
    lines = list(scores)
    thresholds = np.linspace(0.0, 1.2, 61)
    figure, axes = _panels(1, len(rates))
    for ax, rate in zip(axes[0], rates, strict=True):
        for line in lines:
            if rate not in scores[line]:
                continue
            style, label = _style(line, lines)
            several = len(scores[line][rate]) > 1
            with plots.repeatable():
                profiles, bands = create_performance_profile(
                    {"": scores[line][rate]}, thresholds, reps=plots._BOOTSTRAP_REPETITIONS if several else 1
                )
            ax.plot(thresholds, profiles[""], label=label, linewidth=1.2, **style)
            if several:
                ax.fill_between(thresholds, *bands[""], color=style["color"], alpha=0.12, linewidth=0)
        ax.set_title(f"{rate} Hz")
        ax.set_xlabel("score x")
        ax.set_ylim(0.0, 1.02)
    axes[0][0].set_ylabel("share of runs above x")
    _legend(figure, f"score: return by the best mean at any rate; bands: 95 %, bootstrap over {_seeds(records)}")
    return figure


def draw_improvement(records: Sequence[Record], scores: dict[Line, dict[int, np.ndarray]]) -> "Figure":
    """Probability that a seed of the first line beats one of another, over rates; and the scores averaged over rates."""
    lines = list(scores)
    first, others = lines[0], improvement(scores, lines[0])
    figure, axes = _panels(1, 2)
    left, right = axes[0]
    for line, of_rates in others.items():
        style, label = _style(line, lines)
        value, low, high = np.array(list(of_rates.values())).T
        x = _apart(list(of_rates), line, lines)
        left.errorbar(x, value, (value - low, high - value), label=label, marker="o", markersize=4, capsize=2, **style)
    left.axhline(0.5, color="0.6", linewidth=0.8)
    left.set_ylim(-0.02, 1.02)
    _rate_axis(left, records)
    left.set_title(f"probability that {_style(first, lines)[1]} is better")
    averaged = frequency_averaged(scores)
    for place, (line, (value, low, high)) in enumerate(reversed(averaged.items())):
        right.errorbar(
            value, place, xerr=[[value - low], [high - value]], fmt="o", color=ALGORITHMS[line[0]].colour, capsize=2
        )
    right.set_yticks(range(len(averaged)), [_style(line, lines)[1] for line in reversed(averaged)], fontsize="small")
    right.set_ylim(-0.5, max(len(averaged), 1) - 0.5)
    right.set_xlim(left=0.0)
    right.set_title("score averaged over rates")
    right.set_xlabel("return by the best at any rate")
    _legend(figure, f"interquartile means, 95 % intervals: stratified bootstrap over {_seeds(records)}")
    return figure


def averaged_table(scores: dict[Line, dict[int, np.ndarray]]) -> str:
    """Markdown: scores averaged over rates."""
    rows = [_row("algorithm", "setting", "score"), _row("---", "---", "---")]
    for (algorithm, setting), estimate in frequency_averaged(scores).items():
        rows.append(_row(ALGORITHMS[algorithm].label, setting, _interval_cell(estimate)))
    caption = "Interquartile mean, over tasks and seeds, of the mean over rates of return by the best mean return at any rate."
    return "\n".join(["\n## Averaged over rates\n", caption, "", *rows, ""])
