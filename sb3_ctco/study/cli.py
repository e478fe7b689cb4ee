"""The command ``sb3-ctco study``."""

import argparse
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_ctco.study.grid import Run

#: Exit codes: all chosen runs are complete; some failed; another study is still at some
COMPLETE, FAILED, BUSY = 0, 1, 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: as typed after ``sb3-ctco study``; those of the process by default
    :return: the exit code: 0, 1 if a run failed or something given is wrong, 3 if another study is still at some runs
    """
    args = _parser().parse_args(arguments)
    try:
        return args.call(args)
    except ModuleNotFoundError as error:
        missing = (error.name or str(error)).partition(".")[0]
        print(
            f"sb3-ctco study {args.command}: {missing} is missing: in a clone of sb3-ctco, run pip install '.[study]'",
            file=sys.stderr,
        )
        return FAILED
    except (ValueError, ImportError, OSError) as error:  # an OSError is a file or folder that cannot be read or written
        print(f"sb3-ctco study {args.command}: {error}", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-ctco study", description="The frequency study: a grid of runs, its records, and its figures."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    run = commands.add_parser("run", help="make the runs that are missing", description="Make the runs that are missing.")
    run.add_argument("--preset", required=True, help="one of the package's, such as smoke or quick, or a YAML file")
    run.add_argument("--folder", type=Path, help="where the runs go; runs/study/PRESET by default")
    run.add_argument("--workers", type=int, help="number of processes; one a core by default")
    run.add_argument("--engine", choices=("local", "ray"), default="local", help="processes of this machine, or Ray")
    run.add_argument("--address", help="of a running Ray cluster, such as auto; by default Ray is started here")
    run.add_argument("--skip-records", type=Path, metavar="CSV", help="skip the runs that a file of `collect` has")
    run.add_argument(
        "--hours",
        type=float,
        help="only what ends in so many hours, by the time that runs took; seed by seed, the cheap first",
    )
    run.add_argument("--costs", type=Path, nargs="+", default=[], metavar="CSV", help="for --hours: more files of `collect`")
    for name, kind in {"tasks": str, "rates": int, "algorithms": str, "settings": str}.items():
        run.add_argument(f"--{name}", nargs="+", type=kind, help=f"only these {name} of the preset")
    run.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="import these, which register your tasks")
    run.add_argument("--seeds", nargs="+", type=int, help="these in place of the preset's, which begin at 0")
    run.set_defaults(call=_run)

    status = commands.add_parser("status", help="how far a study is")
    status.add_argument("folder", type=Path)
    status.set_defaults(call=_status)

    collect = commands.add_parser("collect", help="merge records and learning curves of finished runs into CSV files")
    collect.add_argument("folders", type=Path, nargs="+", metavar="folder")
    collect.add_argument("--into", type=Path, required=True, metavar="CSV", help="NAME.csv; curves go to NAME_curves.csv")
    collect.set_defaults(call=_collect)

    plot = commands.add_parser("plot", help="figures and a table")
    plot.add_argument("sources", type=Path, nargs="+", metavar="source", help="a study's folder, or a file of `collect`")
    plot.add_argument("--output", type=Path, metavar="DIR", help="SOURCE/figures by default, or figures beside the file")
    plot.add_argument("--algorithms", nargs="+", help="only these")
    plot.add_argument("--settings", nargs="+", help="only these, but for the figure pareto; best is the best action repeat")
    plot.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="as for run")
    plot.set_defaults(call=_plot)
    return parser


def _run(args: argparse.Namespace) -> int:
    from sb3_ctco.study.agents import constructor_arguments
    from sb3_ctco.study.engines import import_packages, run_local, run_on_ray
    from sb3_ctco.study.grid import load_preset
    from sb3_ctco.study.records import read_records, without_recorded
    from sb3_ctco.study.runs import RECORD, git_commit, plan

    if args.workers is not None and args.workers < 1:
        raise ValueError(f"--workers must be at least 1, not {args.workers}")
    if args.hours is not None and not (args.hours > 0 and args.engine == "local"):
        raise ValueError(f"--hours must be positive and is for --engine local, not {args.hours} with {args.engine}")
    if args.address and args.engine != "ray":
        raise ValueError(f"--address {args.address} is Ray's: add --engine ray")
    import_packages(args.gym_packages)
    preset = load_preset(args.preset)
    runs = preset.select(args.tasks, args.rates, args.algorithms, args.settings, args.seeds)
    for run in runs:
        constructor_arguments(run)  # So that a mistake in the preset shows at once.
    if args.skip_records is not None:
        runs = without_recorded(runs, args.skip_records)
        commits = ", ".join(sorted({record["commit"] for record in read_records(args.skip_records)}))
        print(f"{len(runs)} runs are not in {args.skip_records}, whose rows are of commits {commits}; this is {git_commit()}")
        if not runs:
            return COMPLETE
    folder = (args.folder or Path("runs/study") / preset.name).resolve()
    plan(runs, folder)
    left = [run for run in runs if not (folder / run.name / RECORD).exists()]
    print(f"{len(runs) - len(left)} of {len(runs)} runs are complete in {folder}", flush=True)

    workers = args.workers or _cpu_count()
    may_begin = None
    if args.hours is not None:
        left, may_begin = _in_time(args, left, folder, workers)
        runs = [run for run in runs if run in left or (folder / run.name / RECORD).exists()]
    if args.engine == "ray":
        outcomes = run_on_ray(left, folder, workers, args.address, args.gym_packages)
    else:
        outcomes = run_local(left, folder, workers, may_begin or (lambda run: True), args.gym_packages)
    states = set()
    with _Progress(folder, runs, workers):
        for outcome in outcomes:
            states.add(outcome.state)
            if outcome.state == "failed":
                _say(f"{outcome.name} failed, see {folder / outcome.name / 'error.txt'}: {outcome.message}")
            elif outcome.state == "busy":
                _say(f"{outcome.name} is in the hands of another study")
    return FAILED if "failed" in states else BUSY if "busy" in states else COMPLETE


def _in_time(
    args: argparse.Namespace, left: "list[Run]", folder: Path, workers: int
) -> "tuple[list[Run], Callable[[Run], bool]]":
    """The runs that fit into ``--hours``, as is printed, and whether one still does when its turn comes."""
    from sb3_ctco.study.records import read_records
    from sb3_ctco.study.runs import RECORD
    from sb3_ctco.study.schedule import costs, fit
    from sb3_ctco.study.status import clock

    files = [*args.costs, *([args.skip_records] if args.skip_records else [])]
    sources = [read_records(source) for source in ([folder] if any(folder.glob(f"*/{RECORD}")) else []) + files]
    cost = costs(left, *sources)
    planned = fit(left, cost, workers, 3600 * args.hours)
    computing = sum(cost[run.name] for _, run in planned) / 3600
    print(f"{len(planned)} of {len(left)} runs fit into {args.hours:g} h on {workers} processes ({computing:.1f} h in all):")
    for begin, run in planned:
        print(f"  after {clock(begin)}: {run.name}, {clock(cost[run.name])}")
    end = time.monotonic() + 3600 * args.hours
    return [run for _, run in planned], lambda run: time.monotonic() + cost[run.name] <= end


def _status(args: argparse.Namespace) -> int:
    from sb3_ctco.study.status import read_status

    status = read_status(args.folder)
    print("\n".join([status.summary(), *status.details()]))
    return COMPLETE


def _collect(args: argparse.Namespace) -> int:
    from sb3_ctco.study.records import collect

    n_new, n_all = collect(args.folders, args.into)
    print(f"{n_new} new rows, {n_all} in {args.into}")
    return COMPLETE


def _plot(args: argparse.Namespace) -> int:
    from sb3_ctco.study.engines import import_packages
    from sb3_ctco.study.plots import plot

    import_packages(args.gym_packages)
    first = args.sources[0]
    output = args.output or (first if first.is_dir() else first.parent) / "figures"
    for file in plot(args.sources, output, args.algorithms, args.settings):
        print(file)
    return COMPLETE


def _cpu_count() -> int:
    import joblib

    return joblib.cpu_count()  # What the process may use, in a container or under taskset, too.


def _say(text: str) -> None:
    from tqdm import tqdm

    tqdm.write(text)


class _Progress:
    """Shows how far the runs are, while the engine is at them: a bar in a terminal, else a line a minute.

    :param folder: the study's
    :param runs: those that were asked for
    :param workers: number of processes
    """

    def __init__(self, folder: Path, runs: "Sequence[Run]", workers: int):
        from tqdm import tqdm

        self.folder, self.names, self.workers = folder, [run.name for run in runs], workers
        self.terminal = sys.stderr.isatty()
        self.bar = tqdm(total=len(runs), bar_format="{bar:20} {desc}", disable=not self.terminal, dynamic_ncols=True)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self.thread.start()

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.thread.join()
        self._show()
        self.bar.close()

    def _watch(self) -> None:
        while not self.ended.wait(2.0 if self.terminal else 60.0):
            self._show()

    def _show(self) -> None:
        if not self.names:  # none fits into --hours
            return
        from sb3_ctco.study.status import read_status

        status = read_status(self.folder, self.names)
        if self.terminal:
            self.bar.n = len(status.of("done"))
            returns = (f"{one.name} {100 * one.progress:.0f} % {one.recent_return:.2f}" for one in status.of("running"))
            self.bar.set_description_str("; ".join([status.summary(self.workers), *returns]))
        else:
            print("\n".join([status.summary(self.workers), *status.details()]), flush=True)
