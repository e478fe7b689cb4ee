"""Where runs are made: in worker processes of this machine, or on Ray."""

import contextlib
import importlib
import logging
import multiprocessing
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from sb3_ctco.envs.quiet import mute_deprecated_attributes
from sb3_ctco.study.grid import Run
from sb3_ctco.study.runs import Outcome, perform, record_failure

#: How often a run begins again whose process died
RETRIES = 3

#: What libraries read, once, to know how many threads to have
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def run_local(
    runs: Sequence[Run],
    folder: Path,
    workers: int,
    may_begin: Callable[[Run], bool] = lambda run: True,
    gym_packages: Sequence[str] = (),
) -> Iterator[Outcome]:
    """Make runs in processes of this machine, one a worker with one thread.

    They are connected by pipes alone, so that no semaphore and no shared memory outlives a study that was killed, and they
    end at once when it does. A run whose process died begins again; one that another study is at is tried once more at the
    end, because that study may have been killed meanwhile.

    :param runs: the runs, planned in the folder
    :param folder: the study's
    :param workers: number of processes
    :param may_begin: asked of each run when a process is free for it; one that may not is left out
    :param gym_packages: modules that register environments
    :return: what became of each run, in the order in which they end
    """
    waiting, deaths, seen_busy = deque(runs), Counter[str](), set[str]()
    at_work: dict[Connection, tuple[BaseProcess, Run]] = {}
    idle: list[tuple[Connection, BaseProcess]] = []
    try:
        while waiting or at_work:
            while waiting and len(at_work) < workers:
                run = waiting.popleft()
                if not may_begin(run):
                    continue
                connection, process = idle.pop() if idle else _start_worker(folder, gym_packages)
                at_work[connection] = process, run
                with contextlib.suppress(BrokenPipeError):  # it has died, as is found below
                    connection.send(run)
            for ready in wait(list(at_work)) if at_work else ():
                assert isinstance(ready, Connection)
                connection = ready
                process, run = at_work.pop(connection)
                try:
                    outcome: Outcome = connection.recv()
                except (EOFError, ConnectionResetError):
                    # For lack of memory, for instance.
                    connection.close()
                    process.join()
                    deaths[run.name] += 1
                    if deaths[run.name] <= RETRIES:
                        waiting.append(run)
                    else:
                        how = f"the run's process died {RETRIES + 1} times, at last with exit code {process.exitcode}"
                        yield record_failure(run, folder, RuntimeError(how))
                    continue
                idle.append((connection, process))
                if outcome.state == "busy" and run.name not in seen_busy:
                    seen_busy.add(run.name)
                    waiting.append(run)
                else:
                    yield outcome
    finally:
        for process, _ in at_work.values():
            process.terminate()
        for connection, process in [*idle, *((connection, process) for connection, (process, _) in at_work.items())]:
            connection.close()
            process.join()


def _start_worker(folder: Path, gym_packages: Sequence[str]) -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")
    connection, end_of_worker = context.Pipe()
    process = context.Process(target=_work, args=(end_of_worker, folder, gym_packages), daemon=True)
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    end_of_worker.close()
    return connection, process


def _work(connection: Connection, folder: Path, gym_packages: Sequence[str]) -> None:
    mute_deprecated_attributes()
    threading.Thread(target=_end_with_the_study, daemon=True).start()
    # Until the study closes its end, or somebody presses Ctrl-C, which reaches every process of the terminal.
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        while True:
            connection.send(_perform(connection.recv(), folder, gym_packages))


def _perform(run: Run, folder: Path, gym_packages: Sequence[str]) -> Outcome:
    import_packages(gym_packages)
    return perform(run, folder)


def import_packages(names: Sequence[str]) -> None:
    """Import modules, which register environments, as RL Zoo's ``--gym-packages`` does.

    :raises ValueError: if one cannot be imported
    """
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ValueError(
                f"--gym-packages {name} cannot be imported: {error}; for a file in this folder, run PYTHONPATH=. sb3-ctco ..."
            ) from error


def _end_with_the_study() -> None:
    study = multiprocessing.parent_process()
    assert study is not None
    study.join()
    os._exit(1)  # Nobody waits for this run any more. The next study begins it again.


def run_on_ray(
    runs: Sequence[Run], folder: Path, workers: int, address: str | None, gym_packages: Sequence[str] = ()
) -> Iterator[Outcome]:
    """Make runs on Ray, one CPU each; Ray begins a run again whose process or machine died.

    :param runs: the runs, planned in the folder
    :param folder: the study's, in a file system that all machines share
    :param workers: number of processes of a Ray that is started here
    :param address: of a running cluster, such as ``"auto"``; None to start Ray here
    :param gym_packages: modules that register environments
    :return: what became of each run, in the order in which they end
    :raises ImportError: if Ray is not installed
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
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
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(_perform)
        pending = {task.remote(run, folder, gym_packages): run for run in runs}
        while pending:
            (ready,), _ = ray.wait(list(pending), num_returns=1)
            run = pending.pop(ready)
            try:
                yield ray.get(ready)
            except ray.exceptions.RayError as error:
                yield record_failure(run, folder, error)
    finally:
        ray.shutdown()
