"""Where runs are made: in worker processes of this machine (joblib), or on Ray."""

import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import RECORD, Outcome, perform, record_failure

#: How often a run begins again whose process died
RETRIES = 3


def run_local(runs: Sequence[Run], folder: Path, workers: int) -> Iterator[Outcome]:
    """Make runs in processes of this machine, one a worker with one thread.

    :param runs: the runs, planned in the folder
    :param folder: the study's
    :param workers: number of processes
    :return: what became of each run, in the order in which they end
    """
    import joblib  # noqa: PLC0415
    from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415

    left = {run.name: run for run in runs}
    for attempt in range(RETRIES + 1):
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator_unordered")
            try:
                for outcome in parallel(joblib.delayed(perform)(run, folder, os.getpid()) for run in list(left.values())):
                    del left[outcome.name]
                    yield outcome
                return
            except TerminatedWorkerError as error:
                # One process died, of a lack of memory for instance, and took the others with it.
                left = {name: run for name, run in left.items() if not (folder / name / RECORD).exists()}
                if attempt == RETRIES:
                    for run in left.values():
                        yield record_failure(run, folder, error)


def run_on_ray(runs: Sequence[Run], folder: Path, workers: int, address: str | None) -> Iterator[Outcome]:
    """Make runs on Ray, one CPU each; Ray begins a run again whose process or machine died.

    :param runs: the runs, planned in the folder
    :param folder: the study's, in a file system that all machines share
    :param workers: number of processes of a Ray that is started here
    :param address: of a running cluster, such as ``"auto"``; None to start Ray here
    :return: what became of each run, in the order in which they end
    :raises ImportError: if Ray is not installed
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # noqa: PLC0415
    except ImportError as error:
        raise ImportError("--engine ray needs Ray: in a clone of sb3-ctco, run pip install '.[ray]'") from error

    ray.init(
        address=address,
        num_cpus=None if address else workers,
        include_dashboard=None if address else False,
        logging_level=logging.WARNING,
        log_to_driver=False,
    )
    try:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(perform)
        pending = {task.remote(run, folder): run for run in runs}
        while pending:
            (ready,), _ = ray.wait(list(pending), num_returns=1)
            run = pending.pop(ready)
            try:
                yield ray.get(ready)
            except ray.exceptions.RayError as error:
                yield record_failure(run, folder, error)
    finally:
        ray.shutdown()
