"""What figures and tables show: means over seeds, and comparisons over all tasks, with their intervals."""

import contextlib
import itertools
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from sb3_ctco.options import DEFAULT_DISCOUNT_RATE
from sb3_ctco.registry import ALGORITHMS, TASKS
from sb3_ctco.study.records import Record

#: What a step held for so many steps is called in a preset, and the line of the best of them
STEPS, BEST = "steps", "best"
#: Resamples of the bootstrap, as many as rliable's authors take for figures
BOOTSTRAP_REPETITIONS = 2000

#: An algorithm and its setting, which is a line of a figure
Line = tuple[str, str]
#: Interquartile mean with lower and upper bound, by line, then by rate in Hz
Estimates = dict[Line, dict[int, tuple[float, float, float]]]


def rate_of(record: Record) -> int:
    """The interaction rate, in Hz."""
    return round(1.0 / record["dt"])


def line_of(record: Record) -> Line:
    """The line of a figure that a record is of."""
    return record["algorithm"], record["setting"]


def lines_of(records: Sequence[Record]) -> list[Line]:
    """Algorithms and settings that occur, in a fixed order; the paper's settings come after others."""
    present = {line_of(record) for record in records}
    return sorted(present, key=lambda line: (list(ALGORITHMS).index(line[0]), line[1] == "paper", line[1]))


def tasks_of(records: Sequence[Record]) -> list[str]:
    """Tasks that occur: the paper's in its order, and then others."""
    present = {record["task"] for record in records}
    return [*(task for task in TASKS if task in present), *sorted(present - set(TASKS))]


def seeds_in_words(records: Sequence[Record]) -> str:
    """How many seeds there are of a task, algorithm, setting and rate, in words."""
    counts = Counter((r["task"], r["algorithm"], r["setting"], r["dt"]) for r in records).values()
    fewest, most = min(counts), max(counts)
    return f"{most} seed{'s' * (most > 1)}" if fewest == most else f"{fewest} to {most} seeds"


def by_line(records: Sequence[Record], task: str, metric: str) -> dict[Line, dict[int, list[float]]]:
    """A metric of one task, by algorithm and setting, then by rate in Hz: one value a seed."""
    lines: dict[Line, dict[int, list[float]]] = {line: defaultdict(list) for line in lines_of(records)}
    for record in records:
        if record["task"] == task:
            lines[line_of(record)][rate_of(record)].append(record[metric])
    return {line: dict(sorted(rates.items())) for line, rates in lines.items() if rates}


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


def with_equal_repeats(records: Sequence[Record]) -> list[Record]:
    """Records in which SAC stands for an action repeat wherever it is one, and the best repeat is a line of its own.

    An action that is held for one step, or for 20 ms at 50 Hz, is SAC itself. Of the settings of ``sac_repeat`` in steps, that
    with the best mean return in training is kept for each task and rate that has any, as setting ``best``: it is chosen by
    what it is judged by, which favours it. What is held for a time that is whole steps competes with them, and settings with
    fewer seeds than another do not. SAC stands in with runs as long as the others, of the setting that has most of them.
    """
    repeats = [record for record in records if record["algorithm"] == "sac_repeat"]
    if not repeats:
        return list(records)
    lengths = {(record["task"], record["task_seconds"]) for record in repeats}
    as_long = [
        record for record in records if record["algorithm"] == "sac" and (record["task"], record["task_seconds"]) in lengths
    ]
    ((usual, _),) = Counter(record["setting"] for record in as_long).most_common(1) or [("", 0)]
    sac = [{**record, "algorithm": "sac_repeat"} for record in as_long if record["setting"] == usual]
    held = {record["setting"] for record in repeats if not record["setting"].endswith(STEPS)}
    kept = [record for record in records if record["algorithm"] != "sac_repeat" or record["setting"] in held]
    there = {(record["setting"], record["task"], record["dt"], record["seed"]) for record in repeats}
    for record in sac:
        name = f"{1000 * record['dt']:g}ms"
        if name in held and (name, record["task"], record["dt"], record["seed"]) not in there:
            kept.append({**record, "setting": name})
    cells: dict[tuple[str, int], dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in [*sac, *repeats]:
        if record["setting"] not in held or _is_whole_steps(record):
            cells[record["task"], rate_of(record)][record["setting"]].append(record)
    for of_setting in cells.values():
        if not any(setting.endswith(STEPS) for setting in of_setting):
            continue
        best = max(of_setting.values(), key=lambda group: (len(group), np.mean([one["discounted_return"] for one in group])))
        kept += [{**record, "setting": BEST} for record in best]
    return kept


def _is_whole_steps(record: Record) -> bool:
    """Whether a setting such as 20ms is an action repeat of some steps, and not of a part of one."""
    named = re.fullmatch(r"([\d.]+)ms", record["setting"])
    steps = float(named[1]) / 1000.0 / record["dt"] if named else 0.5
    return abs(steps - round(steps)) < 1e-6


def complete_seeds(records: Sequence[Record], metric: str, tasks: Sequence[str]) -> dict[Line, dict[int, np.ndarray]]:
    """A metric of the seeds that are complete in all of some tasks, by line, then by rate in Hz: ``[n_seeds, n_tasks]``."""
    values = {(line_of(record), rate_of(record), record["seed"], record["task"]): record[metric] for record in records}
    seeds, rates = sorted({record["seed"] for record in records}), sorted({rate_of(record) for record in records})
    matrices: dict[Line, dict[int, np.ndarray]] = {}
    for line, rate in itertools.product(lines_of(records), rates):
        of_seeds = [[values.get((line, rate, seed, task)) for task in tasks] for seed in seeds]
        if rows := [row for row in of_seeds if None not in row]:
            matrices.setdefault(line, {})[rate] = np.array(rows)
    return matrices


def interquartile_means(records: Sequence[Record], metric: str) -> Estimates:
    """Interquartile means over seeds and tasks with their 95 % intervals, from rliable.

    Scores are returns times the paper's τ, 0.404/s, that is fractions of the most that a reward of 1 a second can give. A rate
    needs at least one seed that is complete in all tasks.
    """
    from rliable.metrics import aggregate_iqm

    return {
        line: {rate: _estimate(aggregate_iqm, matrix * DEFAULT_DISCOUNT_RATE) for rate, matrix in of_rates.items()}
        for line, of_rates in complete_seeds(records, metric, tasks_of(records)).items()
    }


def relative_scores(records: Sequence[Record], metric: str) -> dict[Line, dict[int, np.ndarray]]:
    """Returns divided by the best mean over seeds at any rate, for each task where that is positive.

    :return: by line, then by rate in Hz, ``[n_seeds, n_tasks]``, of the seeds that are complete in all these tasks
    """
    best = {
        task: max(float(np.mean(values)) for rates in by_line(records, task, metric).values() for values in rates.values())
        for task in tasks_of(records)
    }
    # What costs have no share of what can be had.
    best = {task: value for task, value in best.items() if value > 0}
    if not best:
        return {}
    matrices = complete_seeds(records, metric, list(best))
    return {
        line: {rate: matrix / [*best.values()] for rate, matrix in of_rates.items()} for line, of_rates in matrices.items()
    }


def frequency_averaged(scores: dict[Line, dict[int, np.ndarray]]) -> dict[Line, tuple[float, float, float]]:
    """Interquartile mean, over seeds and tasks, of the mean over rates of relative scores, with its 95 % interval.

    Of lines that have all rates; as many seeds as each rate has.
    """
    from rliable.metrics import aggregate_iqm

    rates = {rate for of_rates in scores.values() for rate in of_rates}
    averaged = {}
    for line, of_rates in scores.items():
        if set(of_rates) == rates:
            n_seeds = seeds_at_each_rate(of_rates)
            mean = np.mean([matrix[:n_seeds] for matrix in of_rates.values()], axis=0)
            averaged[line] = _estimate(aggregate_iqm, mean)
    return averaged


def seeds_at_each_rate(of_rates: dict[int, np.ndarray]) -> int:
    """How many seeds there are at each of a line's rates, of relative scores."""
    return min(map(len, of_rates.values()))


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
    with repeatable():
        _, intervals = get_interval_estimates(
            {"": given}, lambda *resampled: np.array([function(*resampled)]), reps=BOOTSTRAP_REPETITIONS
        )
    return value, float(intervals[""][0, 0]), float(intervals[""][1, 0])
