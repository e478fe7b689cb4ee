"""Tables of a study's records, as Markdown."""

import math
from collections.abc import Sequence

import numpy as np

from sb3_ctco.registry import ALGORITHMS, find_task
from sb3_ctco.study.records import Record, paper_returns
from sb3_ctco.study.scores import (
    Estimates,
    Line,
    by_line,
    frequency_averaged,
    mean_and_interval,
    rate_of,
    seeds_at_each_rate,
    seeds_in_words,
    tasks_of,
)

METRICS = {
    "discounted_return": "discounted return,\ntraining episodes of the last tenth",
    "greedy_return": "discounted return,\ngreedy episodes",
    "decision_rate_hz": "decisions a second,\ntraining episodes of the last tenth",
}
#: What papers on Gymnasium's tasks report; a sum grows with the rate, so it is to be compared at one rate
SUMS = {
    "episode_return": "sum of rewards, training episodes of the last tenth",
    "greedy_episode_return": "sum of rewards, greedy episodes",
}


def table(records: Sequence[Record], estimates: dict[str, Estimates]) -> str:
    """Markdown: returns and decision rates of each task, algorithm and rate, beside the paper's returns.

    :param records: of the runs
    :param estimates: interquartile means by metric
    """
    rates = sorted({rate_of(record) for record in records})
    presets = sorted({f"{record['preset']} ({record['task_seconds']:g} s of task time)" for record in records})
    commits = sorted({record["commit"] for record in records})
    parts = [
        f"Preset {', '.join(presets)}; {seeds_in_words(records)}; commit {', '.join(commits)}. Means over seeds, ± half of "
        "the 95 % interval (Student's t) where there are at least two.\n"
    ]
    for metric, name in {**METRICS, **SUMS}.items():
        known = [record for record in records if math.isfinite(record.get(metric, math.nan))]  # older records have no sums
        if not known:
            continue
        parts.append(f"## {name.replace(chr(10), ' ').capitalize()}\n")
        parts.append(_row("task", "algorithm", "setting", "seeds", *(f"{rate} Hz" for rate in rates)))
        parts.append(_row(*["---"] * (4 + len(rates))))
        for task in tasks_of(known):
            for (algorithm, setting), values in by_line(known, task, metric).items():
                numbers = sorted({len(one) for one in values.values()})
                seeds = "–".join(str(number) for number in {numbers[0]: 0, numbers[-1]: 0})
                cells = (_cell(values.get(rate, [])) for rate in rates)
                parts.append(_row(find_task(task).label, ALGORITHMS[algorithm].label, setting, seeds, *cells))
            if metric in ("discounted_return", "greedy_return"):
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
        "Over tasks and seeds, of discounted return × 0.404/s (with the paper's discount a fraction of the most that a reward "
        "of 1 a second can give), with 95 % intervals of rliable's stratified bootstrap where there are at least two seeds.\n"
    )
    parts.append(_row("episodes", "algorithm", "setting", *(f"{rate} Hz" for rate in rates)))
    parts.append(_row(*["---"] * (3 + len(rates))))
    for metric, of_lines in estimates.items():
        name = {"discounted_return": "training", "greedy_return": "greedy"}[metric]
        for (algorithm, setting), of_rates in of_lines.items():
            cells = (_interval_cell(of_rates.get(rate)) for rate in rates)
            parts.append(_row(name, ALGORITHMS[algorithm].label, setting, *cells))
    return "\n".join(parts) + "\n"


def averaged_table(scores: dict[Line, dict[int, np.ndarray]]) -> str:
    """Markdown: scores averaged over rates."""
    rows = [_row("algorithm", "setting", "seeds", "score"), _row(*["---"] * 4)]
    for (algorithm, setting), estimate in frequency_averaged(scores).items():
        n_seeds = str(seeds_at_each_rate(scores[algorithm, setting]))
        rows.append(_row(ALGORITHMS[algorithm].label, setting, n_seeds, _interval_cell(estimate)))
    caption = (
        "Interquartile mean, over tasks and seeds, of the mean over rates of return by the best mean return at any rate. Of "
        "as many seeds, the first ones, as there are at each rate; who lacks a rate is left out."
    )
    return "\n".join(["\n## Averaged over rates\n", caption, "", *rows, ""])


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
