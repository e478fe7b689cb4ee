"""Figures of a study's records."""

import math
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_ctco.registry import ALGORITHMS, find_task
from sb3_ctco.study.records import (
    CURVE_EPISODES,
    Record,
    key,
    paper_returns,
    read_curves,
    read_records,
    refuse_other_fingerprint,
)
from sb3_ctco.study.scores import (
    BOOTSTRAP_REPETITIONS,
    Estimates,
    Line,
    by_line,
    frequency_averaged,
    improvement,
    interquartile_means,
    line_of,
    lines_of,
    mean_and_interval,
    rate_of,
    relative_scores,
    repeatable,
    seeds_in_words,
    tasks_of,
    with_equal_repeats,
)
from sb3_ctco.study.tables import METRICS, averaged_table, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Of an algorithm's settings; "--" is the paper's
_DASHES: tuple[Any, ...] = ("-", "-.", ":", (0, (6, 2, 1, 2, 1, 2)), (0, (1, 3)), (0, (8, 2)), (0, (3, 1)), (0, (2, 2, 6, 2)))
_DECISION_RATES = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def plot(
    sources: Sequence[Path], output: Path, algorithms: Sequence[str] | None = None, settings: Sequence[str] | None = None
) -> list[Path]:
    """Draw everything that studies' folders, or CSV files of their records, have the data for.

    :param sources: folders or files; the learning curves of a file are in the one beside it
    :param output: folder for figures (PNG and SVG) and ``table.md``
    :param algorithms: only these; all by default
    :param settings: likewise; ``best`` is the best action repeat
    :return: the files written
    :raises ValueError: if nothing is left
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    by = list(algorithms or ALGORITHMS)

    def chosen(rows: Sequence[Record]) -> list[Record]:
        return [row for row in rows if row["algorithm"] in by and (settings is None or row["setting"] in settings)]

    # Text as text, and the same bytes for the same records.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "sb3-ctco"})
    # Where no episode ended in the last tenth, there is no return.
    everything = [record for record in _merged(sources) if math.isfinite(record["discounted_return"])]
    records = chosen(with_equal_repeats(everything))
    if not records:
        raise ValueError(f"no record has an algorithm of {algorithms} and a setting of {settings}: {lines_of(everything)}")
    output.mkdir(parents=True, exist_ok=True)
    estimates = {metric: interquartile_means(records, metric) for metric in ("discounted_return", "greedy_return")}
    relative = relative_scores(records, "discounted_return")
    figures = {
        "frequency": draw_metric(records, "discounted_return"),
        "frequency_greedy": draw_metric(records, "greedy_return"),
        "decision_rates": draw_metric(records, "decision_rate_hz"),
        "interquartile_means": draw_interquartile_means(records, estimates),
        "pareto": draw_pareto([row for row in everything if row["algorithm"] in by], "discounted_return"),
    }
    if relative:
        figures["profiles"] = draw_profiles(records, relative)
        figures["improvement"] = draw_improvement(records, relative)
    # A run that is in several sources is one run.
    of_runs = {(*key(point), point["seconds"]): point for source in sources for point in read_curves(source)}
    _refuse_two_presets(of_runs.values())
    if points := chosen(list(of_runs.values())):
        figures["learning_curves"] = draw_learning_curves(points)
    written = []
    for name, figure in figures.items():
        for ending, metadata in (("png", None), ("svg", {"Date": None})):
            written.append(output / f"{name}.{ending}")
            figure.savefig(written[-1], dpi=120, metadata=metadata)
        plt.close(figure)
    written.append(output / "table.md")
    written[-1].write_text(table(records, estimates) + averaged_table(relative), encoding="utf-8")
    return written


def _merged(sources: Sequence[Path]) -> list[Record]:
    """The records of all sources, each run once.

    :raises ValueError: if a run is there with different settings, or if runs of different lengths, or the same seed of two
        presets, would make one mean
    """
    merged: dict[tuple[Any, ...], Record] = {}
    lengths: dict[tuple[Any, ...], Record] = {}
    for source in sources:
        for record in read_records(source):
            there = merged.setdefault(key(record), record)
            refuse_other_fingerprint(there["fingerprint"], record["fingerprint"], key(record), source)
            of_mean = lengths.setdefault((record["task"], line_of(record), rate_of(record)), record)
            if of_mean["task_seconds"] != record["task_seconds"]:
                raise ValueError(
                    f"{source} has runs of preset {record['preset']} with {record['task_seconds']:g} s of task time, and "
                    f"preset {of_mean['preset']} has {of_mean['task_seconds']:g} s: they make no mean, plot one of them"
                )
    _refuse_two_presets(merged.values())
    return list(merged.values())


def _refuse_two_presets(rows: Iterable[Record]) -> None:
    """Of records, or of points of learning curves."""
    presets: dict[tuple[Any, ...], str] = {}
    for row in rows:
        task, line, seed = row["task"], line_of(row), row["seed"]
        preset = presets.setdefault((task, line, rate_of(row), seed), row["preset"])
        if preset != row["preset"]:
            raise ValueError(
                f"presets {preset} and {row['preset']} both have seed {seed} of {line} on {task}: they are no two seeds, plot "
                "one of them"
            )


def draw_metric(records: Sequence[Record], metric: str) -> "Figure":
    """A metric over the interaction rate: a panel a task, a line an algorithm and setting, and the paper's numbers."""
    tasks = tasks_of(records)
    figure, axes = _panels(1, len(tasks))
    paper = paper_returns() if metric != "decision_rate_hz" else {}
    lines = lines_of(records)
    for ax, task in zip(axes[0], tasks, strict=True):
        shown: list[float] = []
        for line, rates in by_line(records, task, metric).items():
            means, half_widths = np.array([mean_and_interval(values) for values in rates.values()]).T
            _line_with_intervals(ax, list(rates), means, means - half_widths, means + half_widths, line, lines)
            for x, values in zip(_apart(list(rates), line, lines), rates.values(), strict=True):
                if len(values) > 1:
                    ax.plot([x] * len(values), values, ".", color=ALGORITHMS[line[0]].colour, markersize=3)
                shown += values
        for algorithm in dict(lines):
            if numbers := paper.get((task, algorithm)):
                shown += numbers.values()
                label = f"{ALGORITHMS[algorithm].label}, the paper's figure"
                colour = ALGORITHMS[algorithm].colour
                ax.plot(list(numbers), list(numbers.values()), "--", color=colour, linewidth=0.8, alpha=0.7, label=label)
        _rate_axis(ax, records)
        ax.set_title(find_task(task).label)
        if metric == "decision_rate_hz":
            ax.set_yscale("log")
        else:
            _return_axis(ax, shown)
    axes[0][0].set_ylabel(METRICS[metric])
    seeds = seeds_in_words(records)
    _legend(figure, seeds if seeds == "1 seed" else f"mean and 95 % interval (Student's t) of {seeds}; a dot a seed")
    return figure


def draw_interquartile_means(records: Sequence[Record], estimates: dict[str, Estimates]) -> "Figure":
    """Interquartile means over the interaction rate: training episodes and greedy ones.

    :param records: which they are of
    :param estimates: by metric
    """
    figure, axes = _panels(1, 2)
    lines = lines_of(records)
    for ax, (metric, of_lines) in zip(axes[0], estimates.items(), strict=True):
        for line, rates in of_lines.items():
            means, low, high = np.array(list(rates.values())).T
            _line_with_intervals(ax, list(rates), means, low, high, line, lines)
        _rate_axis(ax, records)
        ax.set_title(METRICS[metric].split(",\n")[1])
        lowest = min((mean for rates in of_lines.values() for mean, _, _ in rates.values()), default=0.0)
        ax.set_ylim(min(0.0, 1.08 * lowest), max(0.0, ax.get_ylim()[1]))
    axes[0][0].set_ylabel("interquartile mean\nof discounted return × 0.404/s")
    seeds = seeds_in_words(records)
    _legend(figure, seeds if seeds == "1 seed" else f"95 % intervals: stratified bootstrap over {seeds}")
    return figure


def draw_learning_curves(points: Sequence[Record]) -> "Figure":
    """Discounted return of training episodes over task time, mean over seeds: a row a rate, a column a task.

    Intervals are drawn from three seeds on: those of two would hide all else.

    :param points: of :func:`~sb3_ctco.study.records.read_curves`
    """
    tasks, lines = tasks_of(points), lines_of(points)
    rates = sorted({rate_of(point) for point in points})
    runs: dict[tuple[str, int, Line], dict[int, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for point in points:
        of_seeds = runs[point["task"], rate_of(point), line_of(point)]
        of_seeds[point["seed"]].append((point["seconds"], point["discounted_return"]))
    figure, axes = _panels(len(rates), len(tasks))
    for row, rate in zip(axes, rates, strict=True):
        for ax, task in zip(row, tasks, strict=True):
            shown = [0.0]
            for line in lines:
                curve = _together(list(runs[task, rate, line].values()))
                style, label = _style(line, lines)
                minutes = np.array(list(curve)) / 60
                means, half_widths = np.array([mean_and_interval(one) for one in curve.values()]).reshape(-1, 2).T
                ax.plot(minutes, means, linewidth=1.2, label=label, **style)
                several = np.array([len(one) > 2 for one in curve.values()])
                if several.any():
                    low, high = means - half_widths, means + half_widths
                    ax.fill_between(minutes, low, high, where=several, color=style["color"], alpha=0.15, linewidth=0)
                shown += means.tolist()
            ax.set_title(f"{find_task(task).label}, {rate} Hz")
            _return_axis(ax, shown)
            # A task that has a rate of its own has nothing at others'.
            ax.set_visible(len(shown) > 1)
        row[0].set_ylabel("discounted return")
    for ax in axes[-1]:
        ax.set_xlabel("task time [min]")
    seeds = seeds_in_words(list({key(point): point for point in points}.values()))
    episodes = f"mean of (up to) {CURVE_EPISODES} training episodes"
    interval = "" if seeds == "1 seed" else f"; mean of {seeds}, 95 % interval (Student's t) of 3 or more"
    _legend(figure, episodes + interval)
    return figure


def _together(curves: Sequence[Sequence[tuple[float, float]]]) -> dict[float, list[float]]:
    """Runs' returns by task time: episodes that end early end at other times in each run, so that between points are lines.

    From where all of them have a point to where one of them ends, so that the mean is of the same runs everywhere.
    """
    sorted_curves = [np.array(sorted(curve)).T for curve in curves]
    first = max((seconds[0] for seconds, _ in sorted_curves), default=0.0)
    last = min((seconds[-1] for seconds, _ in sorted_curves), default=0.0)
    times = sorted({float(at) for seconds, _ in sorted_curves for at in seconds if first <= at <= last})
    return {at: [float(np.interp(at, *curve)) for curve in sorted_curves] for at in times}


def draw_pareto(records: Sequence[Record], metric: str) -> "Figure":
    """Return over decisions a second: a row a rate, a column a task, a point a setting, by its name.

    Of the rates at which there is something to compare, if there are any.
    """
    tasks, lines = tasks_of(records), lines_of(records)
    at_rates: dict[int, set[Line]] = defaultdict(set)
    for record in records:
        at_rates[rate_of(record)].add(line_of(record))
    rates = sorted(rate for rate, there in at_rates.items() if len(there) > 1) or sorted(at_rates)
    figure, axes = _panels(len(rates), len(tasks))
    for row, rate in zip(axes, rates, strict=True):
        for ax, task in zip(row, tasks, strict=True):
            here = [record for record in records if record["task"] == task and rate_of(record) == rate]
            decisions = {line: float(np.mean(of[rate])) for line, of in by_line(here, task, "decision_rate_hz").items()}
            returns = {line: mean_and_interval(of[rate]) for line, of in by_line(here, task, metric).items()}
            for algorithm in dict.fromkeys(line[0] for line in lines):
                swept = sorted((decisions[line], *returns[line], line[1]) for line in returns if line[0] == algorithm)
                if swept:
                    x, y, half_width, settings = zip(*swept, strict=True)
                    style: dict[str, Any] = {"fmt": "o", "color": ALGORITHMS[algorithm].colour, "linewidth": 0.8}
                    ax.errorbar(x, y, half_width, label=ALGORITHMS[algorithm].label, markersize=4, capsize=2, **style)
                    for at, value, setting in zip(x, y, settings, strict=True):
                        where: dict[str, Any] = {"xytext": (-3, 3), "ha": "right"} if at > 100 else {"xytext": (3, 3)}
                        ax.annotate(setting, (at, value), textcoords="offset points", fontsize=6, **where)
            ax.set_xscale("log")
            ax.set_xticks(_DECISION_RATES, [str(tick) for tick in _DECISION_RATES])
            ax.minorticks_off()
            ax.set_xlim(
                min([0.8, *(0.8 * at for at in decisions.values())]), max([700.0, *(1.3 * at for at in decisions.values())])
            )
            ax.set_visible(bool(returns))  # A task that has a rate of its own has nothing at others'.
            means = [0.0, *(value for value, _ in returns.values())]
            ax.set_ylim(min(means) - 0.04 * max(*means, 0.1), 1.15 * max(*means, 0.1))
            ax.set_title(f"{find_task(task).label}, {rate} Hz")
        row[0].set_ylabel("discounted return")
    for ax in axes[-1]:
        ax.set_xlabel("decisions a second")
    _legend(figure, f"a point a setting; 95 % interval (Student's t) of {seeds_in_words(records)}")
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
            with repeatable():
                profiles, bands = create_performance_profile(
                    {"": scores[line][rate]}, thresholds, reps=BOOTSTRAP_REPETITIONS if several else 1
                )
            ax.plot(thresholds, profiles[""], label=label, linewidth=1.2, **style)
            if several:
                ax.fill_between(thresholds, *bands[""], color=style["color"], alpha=0.12, linewidth=0)
        ax.set_title(f"{rate} Hz")
        ax.set_xlabel("score x")
        ax.set_ylim(0.0, 1.02)
    axes[0][0].set_ylabel("share of runs above x")
    _legend(figure, f"score: return by the best mean at any rate; bands: 95 %, bootstrap over {seeds_in_words(records)}")
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
    _legend(figure, f"interquartile means, 95 % intervals: stratified bootstrap over {seeds_in_words(records)}")
    return figure


def _panels(n_rows: int, n_columns: int) -> tuple["Figure", np.ndarray]:
    import matplotlib.pyplot as plt

    size = (4.0 * n_columns, 2.6 * n_rows + 1.2)
    return plt.subplots(n_rows, n_columns, figsize=size, squeeze=False, layout="constrained")


def _style(line: Line, lines: Sequence[Line]) -> tuple[dict[str, Any], str]:
    algorithm, setting = line
    settings = [other for name, other in lines if name == algorithm]
    style = {"color": ALGORITHMS[algorithm].colour, "linestyle": _DASHES[settings.index(setting) % len(_DASHES)]}
    return style, f"{ALGORITHMS[algorithm].label} ({setting})"


def _line_with_intervals(
    ax: "Axes", rates: Sequence[int], means: np.ndarray, low: np.ndarray, high: np.ndarray, line: Line, lines: Sequence[Line]
) -> None:
    """Draw a line over the rates with its intervals as bars, set a little apart from those of other lines."""
    style, label = _style(line, lines)
    apart = _apart(rates, line, lines)
    # A point that no line leads to stands with its interval.
    ax.plot(apart if len(rates) == 1 else rates, means, marker="o", markersize=4, label=label, **style)
    ax.errorbar(
        apart,
        means,
        (means - low, high - means),
        fmt="none",
        color=style["color"],
        elinewidth=0.8,
        capsize=2,
    )


def _apart(rates: Sequence[int], line: Line, lines: Sequence[Line]) -> np.ndarray:
    return np.array(rates) * 1.03 ** (lines.index(line) - (len(lines) - 1) / 2)


def _return_axis(ax: "Axes", shown: Sequence[float]) -> None:
    """From zero, or a little below what is shown, to a little above it; wide intervals of few seeds run off the panel."""
    low, high = min(0.0, *shown), max(*shown, 0.1)
    ax.set_ylim(low - 0.08 * (high - low) if low < 0.0 else 0.0, high + 0.08 * (high - low))


def _rate_axis(ax: "Axes", records: Sequence[Record]) -> None:
    rates = sorted({rate_of(record) for record in records})
    ax.set_xscale("log")
    ax.set_xticks(rates, [str(rate) for rate in rates])
    ax.minorticks_off()
    if len(rates) == 1:  # of which an axis has no length
        ax.set_xlim(rates[0] / 1.3, rates[0] * 1.3)
    ax.set_xlabel("interaction frequency [Hz]")


def _legend(figure: "Figure", title: str) -> None:
    """Each label once, whichever panels it is in."""
    shown = [zip(*ax.get_legend_handles_labels(), strict=True) for ax in figure.axes if ax.get_visible()]
    entries = {label: handle for of_panel in shown for handle, label in of_panel}
    place: dict[str, Any] = {
        "loc": "outside lower center",
        "ncols": min(4, len(figure.axes) + 1),
        "fontsize": "small",
        "title_fontsize": "small",
    }
    title = textwrap.fill(title, round(15 * figure.get_figwidth()))
    figure.legend(list(entries.values()), list(entries), title=title, **place)
