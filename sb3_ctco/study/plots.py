"""Figures and tables of a study's records."""

import contextlib
import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE
from sb3_ctco.registry import ALGORITHMS, TASKS, find_task
from sb3_ctco.study.records import (
    CURVE_EPISODES,
    Record,
    key,
    paper_returns,
    read_curves,
    read_records,
    refuse_other_fingerprint,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METRICS = {
    "discounted_return": "discounted return,\ntraining episodes of the last tenth",
    "greedy_return": "discounted return,\ngreedy episodes",
    "decision_rate_hz": "decisions a second,\ntraining episodes of the last tenth",
}
_DASHES = ("-", "-.", ":")
#: Resamples of the bootstrap, as many as rliable's authors take for figures
_BOOTSTRAP_REPETITIONS = 2000

#: An algorithm and its setting, which is a line of a figure
Line = tuple[str, str]
#: Interquartile mean with lower and upper bound, by line, then by rate in Hz
Estimates = dict[Line, dict[int, tuple[float, float, float]]]


def mean_and_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean over seeds, and half the width of its 95 % interval (Student's t; nan for one seed)."""
    from scipy.stats import t

    n = len(values)
    half_width = float(t.ppf(0.975, n - 1)) * float(np.std(values, ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return float(np.mean(values)), half_width


@contextlib.contextmanager
def repeatable() -> Iterator[None]:
    """The same intervals each time: rliable draws from NumPy's global generator."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)


def by_line(records: Sequence[Record], task: str, metric: str) -> dict[Line, dict[int, list[float]]]:
    """A metric of one task, by algorithm and setting, then by rate in Hz: one value a seed."""
    lines: dict[Line, dict[int, list[float]]] = {line: defaultdict(list) for line in lines_of(records)}
    for record in records:
        if record["task"] == task:
            lines[_line_of(record)][_rate(record)].append(record[metric])
    return {line: dict(sorted(rates.items())) for line, rates in lines.items() if rates}


def lines_of(records: Sequence[Record]) -> list[Line]:
    """Algorithms and settings that occur, in a fixed order; the paper's settings come after others."""
    present = {_line_of(record) for record in records}
    return sorted(present, key=lambda line: (list(ALGORITHMS).index(line[0]), line[1] == "paper", line[1]))


def tasks_of(records: Sequence[Record]) -> list[str]:
    """Tasks that occur: the paper's in its order, and then others."""
    present = {record["task"] for record in records}
    return [*(task for task in TASKS if task in present), *sorted(present - set(TASKS))]


def interquartile_means(records: Sequence[Record], metric: str) -> Estimates:
    """Interquartile means over seeds and tasks with their 95 % intervals, from rliable.

    Scores are returns times the paper's τ, 0.404/s, that is fractions of the most that a reward of 1 a second can give. A rate
    needs at least one seed that is complete in all tasks; its interval is that of a bootstrap over seeds within tasks, and nan
    for one.
    """
    from rliable.library import get_interval_estimates
    from rliable.metrics import aggregate_iqm

    tasks = tasks_of(records)
    values = {(_line_of(record), _rate(record), record["seed"], record["task"]): record[metric] for record in records}
    rates = sorted({_rate(record) for record in records})
    seeds = sorted({record["seed"] for record in records})
    estimates: Estimates = {}
    for line in lines_of(records):
        for rate in rates:
            complete = [seed for seed in seeds if all((line, rate, seed, task) in values for task in tasks)]
            if not complete:
                continue
            scores = np.array([[values[line, rate, seed, task] for task in tasks] for seed in complete])
            scores = scores * DEFAULT_DISCOUNT_RATE
            low = high = math.nan
            if len(complete) > 1:
                with repeatable():
                    _, interval = get_interval_estimates(
                        {"": scores}, lambda x: np.array([aggregate_iqm(x)]), reps=_BOOTSTRAP_REPETITIONS
                    )
                low, high = (float(bound) for bound in interval[""][:, 0])
            estimates.setdefault(line, {})[rate] = (float(aggregate_iqm(scores)), low, high)
    return estimates


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
    seeds = _seeds(records)
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
    seeds = _seeds(records)
    _legend(figure, seeds if seeds == "1 seed" else f"95 % intervals: stratified bootstrap over {seeds}")
    return figure


def draw_learning_curves(points: Sequence[Record]) -> "Figure":
    """Discounted return of training episodes over task time, mean over seeds: a row a rate, a column a task.

    Intervals are drawn from three seeds on: those of two would hide all else.

    :param points: of :func:`~sb3_ctco.study.records.read_curves`
    """
    tasks, lines = tasks_of(points), lines_of(points)
    rates = sorted({_rate(point) for point in points})
    runs: dict[tuple[str, int, Line], dict[int, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for point in points:
        of_seeds = runs[point["task"], _rate(point), _line_of(point)]
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
    seeds = _seeds(list({key(point): point for point in points}.values()))
    episodes = f"mean of (up to) {CURVE_EPISODES} training episodes"
    interval = "" if seeds == "1 seed" else f"; mean of {seeds}, 95 % interval (Student's t) of 3 or more"
    _legend(figure, episodes + interval)
    return figure


def _together(curves: Sequence[Sequence[tuple[float, float]]]) -> dict[float, list[float]]:
    """Runs' returns by task time: episodes that end early end at other times in each run, so that between points are lines."""
    together: dict[float, list[float]] = {seconds: [] for seconds in sorted({at for curve in curves for at, _ in curve})}
    for curve in curves:
        seconds, returns = np.array(sorted(curve)).T
        for at, values in together.items():
            if seconds[0] <= at <= seconds[-1]:
                values.append(float(np.interp(at, seconds, returns)))
    return together


def table(records: Sequence[Record], estimates: dict[str, Estimates]) -> str:
    """Markdown: returns and decision rates of each task, algorithm and rate, beside the paper's returns.

    :param records: of the runs
    :param estimates: interquartile means by metric
    """
    rates = sorted({_rate(record) for record in records})
    presets = sorted({f"{record['preset']} ({record['task_seconds']:g} s of task time)" for record in records})
    commits = sorted({record["commit"] for record in records})
    parts = [
        f"Preset {', '.join(presets)}; {_seeds(records)}; commit {', '.join(commits)}. Means over seeds, ± half of the 95 % "
        "interval (Student's t) where there are at least two.\n"
    ]
    for metric, name in METRICS.items():
        parts.append(f"## {name.replace(chr(10), ' ').capitalize()}\n")
        parts.append(_row("task", "algorithm", "setting", "seeds", *(f"{rate} Hz" for rate in rates)))
        parts.append(_row(*["---"] * (4 + len(rates))))
        for task in tasks_of(records):
            for (algorithm, setting), values in by_line(records, task, metric).items():
                numbers = sorted({len(one) for one in values.values()})
                seeds = "–".join(str(number) for number in {numbers[0]: 0, numbers[-1]: 0})
                cells = (_cell(values.get(rate, [])) for rate in rates)
                parts.append(_row(find_task(task).label, ALGORITHMS[algorithm].label, setting, seeds, *cells))
            if metric != "decision_rate_hz":
                for algorithm in ALGORITHMS:
                    numbers_of_paper = paper_returns().get((task, algorithm))
                    if numbers_of_paper is None:
                        continue
                    cells = (f"{numbers_of_paper[rate]:.2f}" if rate in numbers_of_paper else "–" for rate in rates)
                    parts.append(
                        _row(find_task(task).label, ALGORITHMS[algorithm].label, "*the paper's figure*", "30", *cells)
                    )
        parts.append("")
    parts.append("## Interquartile means\n")
    parts.append(
        "Over tasks and seeds, of discounted return × τ (a fraction of the most that a reward of 1 a second can give), with "
        "95 % intervals of rliable's stratified bootstrap where there are at least two seeds.\n"
    )
    parts.append(_row("episodes", "algorithm", "setting", *(f"{rate} Hz" for rate in rates)))
    parts.append(_row(*["---"] * (3 + len(rates))))
    for metric, of_lines in estimates.items():
        name = {"discounted_return": "training", "greedy_return": "greedy"}[metric]
        for (algorithm, setting), of_rates in of_lines.items():
            cells = (_interval_cell(of_rates.get(rate)) for rate in rates)
            parts.append(_row(name, ALGORITHMS[algorithm].label, setting, *cells))
    return "\n".join(parts) + "\n"


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

    from sb3_ctco.study import scores

    by = list(algorithms or ALGORITHMS)

    def chosen(rows: Sequence[Record]) -> list[Record]:
        return [row for row in rows if row["algorithm"] in by and (settings is None or row["setting"] in settings)]

    # Text as text, and the same bytes for the same records.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "sb3-ctco"})
    everything = _merged(sources)
    records = chosen(scores.with_equal_repeats(everything))
    if not records:
        raise ValueError(f"no record has an algorithm of {algorithms} and a setting of {settings}: {lines_of(everything)}")
    output.mkdir(parents=True, exist_ok=True)
    estimates = {metric: interquartile_means(records, metric) for metric in ("discounted_return", "greedy_return")}
    relative = scores.relative_scores(records, "discounted_return")
    figures = {
        "frequency": draw_metric(records, "discounted_return"),
        "frequency_greedy": draw_metric(records, "greedy_return"),
        "decision_rates": draw_metric(records, "decision_rate_hz"),
        "interquartile_means": draw_interquartile_means(records, estimates),
        "pareto": scores.draw_pareto([row for row in everything if row["algorithm"] in by], "discounted_return"),
    }
    if relative:
        figures["profiles"] = scores.draw_profiles(records, relative)
        figures["improvement"] = scores.draw_improvement(records, relative)
    # A run that is in several sources is one run.
    of_runs = {(*key(point), point["seconds"]): point for source in sources for point in read_curves(source)}
    if points := chosen(list(of_runs.values())):
        figures["learning_curves"] = draw_learning_curves(points)
    written = []
    for name, figure in figures.items():
        for ending, metadata in (("png", None), ("svg", {"Date": None})):
            written.append(output / f"{name}.{ending}")
            figure.savefig(written[-1], dpi=120, metadata=metadata)
        plt.close(figure)
    written.append(output / "table.md")
    written[-1].write_text(table(records, estimates) + scores.averaged_table(relative), encoding="utf-8")
    return written


def _merged(sources: Sequence[Path]) -> list[Record]:
    """The records of all sources, each run once.

    :raises ValueError: if a run is there with different settings, or if runs of different lengths would make one mean
    """
    merged: dict[tuple[Any, ...], Record] = {}
    lengths: dict[tuple[Any, ...], Record] = {}
    for source in sources:
        for record in read_records(source):
            there = merged.setdefault(key(record), record)
            refuse_other_fingerprint(there["fingerprint"], record["fingerprint"], key(record), source)
            of_mean = lengths.setdefault((record["task"], _line_of(record), _rate(record)), record)
            if of_mean["task_seconds"] != record["task_seconds"]:
                raise ValueError(
                    f"{source} has runs of preset {record['preset']} with {record['task_seconds']:g} s of task time, and "
                    f"preset {of_mean['preset']} has {of_mean['task_seconds']:g} s: they make no mean, plot one of them"
                )
    return list(merged.values())


def _rate(record: Record) -> int:
    return round(1.0 / record["dt"])


def _seeds(records: Sequence[Record]) -> str:
    """How many seeds there are of a task, algorithm, setting and rate, in words."""
    counts = Counter((r["task"], r["algorithm"], r["setting"], r["dt"]) for r in records).values()
    fewest, most = min(counts), max(counts)
    return f"{most} seed{'s' * (most > 1)}" if fewest == most else f"{fewest} to {most} seeds"


def _line_of(record: Record) -> Line:
    return record["algorithm"], record["setting"]


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
    ax.plot(rates, means, marker="o", markersize=4, label=label, **style)
    ax.errorbar(
        _apart(rates, line, lines),
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
    """From zero to a little above what is shown; wide intervals of few seeds run off the panel."""
    ax.set_ylim(min(0.0, *shown), 1.08 * max(*shown, 0.1))


def _rate_axis(ax: "Axes", records: Sequence[Record]) -> None:
    rates = sorted({_rate(record) for record in records})
    ax.set_xscale("log")
    ax.set_xticks(rates, [str(rate) for rate in rates])
    ax.minorticks_off()
    ax.set_xlabel("interaction frequency [Hz]")


def _legend(figure: "Figure", title: str) -> None:
    """Each label once, whichever panels it is in."""
    shown = [zip(*ax.get_legend_handles_labels(), strict=True) for ax in figure.axes if ax.get_visible()]
    entries = {label: handle for of_panel in shown for handle, label in of_panel}
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": 4, "fontsize": "small", "title_fontsize": "small"}
    figure.legend(list(entries.values()), list(entries), title=title, **place)


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(values: Sequence[float]) -> str:
    if not values:
        return "–"
    mean, half_width = mean_and_interval(values)
    return f"{mean:.2f}" if math.isnan(half_width) else f"{mean:.2f} ± {half_width:.2f}"


def _interval_cell(estimate: tuple[float, float, float] | None) -> str:
    if estimate is None:
        return "–"
    mean, low, high = estimate
    return f"{mean:.2f}" if math.isnan(low) else f"{mean:.2f} [{low:.2f}, {high:.2f}]"
