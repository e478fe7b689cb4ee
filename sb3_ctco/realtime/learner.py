"""The learning process: reads experience from the journal, updates, publishes weights."""

import contextlib
import logging
import multiprocessing
import os
import select
import signal
import sys
import time
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_ctco.common.files import replace_durably
from sb3_ctco.common.lock import lock
from sb3_ctco.options import SubOptions
from sb3_ctco.realtime.journal import Arrays, JournalError, JournalReader
from sb3_ctco.realtime.weights import SharedWeights, has_finite_weights

logger = logging.getLogger(__name__)

#: How long a round of updates may take, so that it can be stopped in time; in s
_ROUND_SECONDS = 0.1
_LOG_SECONDS = 1.0
#: How long to wait for a learner that was left alone and saves, in s
_LOCK_SECONDS = 10.0
#: How much of what was collected last a checkpoint waits for, in s of reading
_LAST_READING_SECONDS = 10.0
#: Held while a learner lives, which may be longer than who started it
LEARNER_LOCK = "learner.lock"


class LearnerError(RuntimeError):
    """The learning process failed or was killed; acting was stopped safely."""


class Transition(NamedTuple):
    """What ``ReplayBuffer.add`` takes, and the number of environment steps that had been made by then."""

    obs: np.ndarray | dict[str, np.ndarray]
    next_obs: np.ndarray | dict[str, np.ndarray]
    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    infos: list[dict[str, Any]]
    num_timesteps: int

    def to_arrays(self) -> Arrays:
        """As a record of the journal, with what a replay buffer uses of the one environment's info."""
        (info,) = self.infos
        kept: dict[str, Any] = {name: info[name] for name in ("TimeLimit.truncated", "option") if name in info}
        if "sub_options" in info:
            kept["sub_options"] = vars(info["sub_options"])
        return {**self._asdict(), "infos": kept}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Transition":
        """The transition that a record holds.

        :raises JournalError: if it is another kind of record
        """
        try:
            info = dict(arrays["infos"]) if "infos" in arrays else {}
            if "TimeLimit.truncated" in info:
                info["TimeLimit.truncated"] = bool(info["TimeLimit.truncated"])
            if "option" in info:
                info["option"] = {name: value.item() for name, value in info["option"].items()}
            if "sub_options" in info:
                info["sub_options"] = SubOptions(**info["sub_options"])
            return cls(**{**arrays, "infos": [info], "num_timesteps": int(arrays["num_timesteps"])})
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise JournalError(f"a record of the journal is no transition: {type(error).__name__}: {error}") from None

    @property
    def n_rows(self) -> int:
        """Rows of a replay buffer that it fills."""
        return 1 + len(self.infos[0].get("sub_options", ()))


@dataclass(frozen=True)
class LearnerSettings:
    """What the learning process is told.

    :param algorithm: class of the model
    :param start: file of the model to begin with
    :param folder: of the journal and the checkpoints
    :param total_timesteps: for schedules
    :param device: to learn on
    :param n_threads: of torch; None for its own choice
    :param niceness: how much less urgent than acting
    :param updates_per_second: at most; None for as many as possible
    :param checkpoint_seconds: between two checkpoints
    """

    algorithm: type[OffPolicyAlgorithm]
    start: Path
    folder: Path
    total_timesteps: int
    device: str
    n_threads: int | None
    niceness: int
    updates_per_second: float | None
    checkpoint_seconds: float


def acting_module(model: OffPolicyAlgorithm) -> th.nn.Module:
    """The part of a policy that acting needs."""
    actor = getattr(model.policy, "actor", None)
    return actor if isinstance(actor, th.nn.Module) else model.policy


def run_learner(settings: LearnerSettings, weights: SharedWeights, stop: Any, report: Connection) -> None:
    """Learn until ``stop.value`` is true or the acting process is gone, then save. Runs in a process of its own.

    What it reports is ``("ready", None)``, ``("log", {name: value})`` and ``("failed", traceback)``.
    """
    # Ctrl-C reaches every process of the terminal; the acting one decides what to do about it. What ends a service reaches its
    # whole group.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: setattr(stop, "value", True))
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: setattr(stop, "value", True))
    os.nice(settings.niceness)
    if settings.n_threads is not None:
        th.set_num_threads(settings.n_threads)
    exit_code = 0
    with lock(settings.folder, _LOCK_SECONDS, LEARNER_LOCK) as learns_alone:
        try:
            if not learns_alone:
                raise RuntimeError(
                    f"another learner is at work in {settings.folder}: wait for its end, or pass another folder"
                )
            learner = _Learner(settings, weights, stop, report)
            report.send(("ready", None))
            to_do = [learner.run, learner.save]
        except (BrokenPipeError, ConnectionResetError):
            to_do = []  # the acting process is gone before anything was learned that a checkpoint could have
        except Exception:
            exit_code, to_do = 1, []
            _tell_failure(report)
        for work in to_do:
            try:
                work()
            except (BrokenPipeError, ConnectionResetError):
                pass  # the acting process is gone
            except Exception:
                exit_code = 1
                _tell_failure(report)
    # Everything is on disk. The interpreter would take another second to clear its memory, and the acting process waits.
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):  # a terminal that was closed
            stream.flush()
    os._exit(exit_code)


def _tell_failure(report: Connection) -> None:
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        report.send(("failed", traceback.format_exc()))


class _Learner:
    def __init__(self, settings: LearnerSettings, weights: SharedWeights, stop: Any, report: Connection):
        self.settings = settings
        self.weights = weights
        self.stop = stop
        self.report = report
        self.model = settings.algorithm.load(settings.start, device=settings.device)
        self.model._total_timesteps = settings.total_timesteps
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.journals = [JournalReader(settings.folder / name) for name in ("journal", "demonstrations")]
        self.num_updates = 0

    def run(self) -> None:
        """Alternate between reading what was collected and a short round of updates."""
        parent = multiprocessing.parent_process()
        assert parent is not None
        model, settings = self.model, self.settings
        assert model.replay_buffer is not None
        seconds_per_update = _ROUND_SECONDS
        started: float | None = None
        logged_at = saved_at = time.monotonic()
        updates_logged = 0
        has_caught_up = False
        # What the parent forked may outlive it, and keep the pipe open that tells of its end.
        while not self.stop.value and parent.is_alive() and os.getppid() == parent.pid:
            n_read = max(fill_replay_buffer(model, journal, 1000) for journal in self.journals)
            has_caught_up = has_caught_up or n_read < 1000
            if not has_caught_up:
                continue  # learning waits until all that was collected before is read
            now = time.monotonic()
            ready = model.num_timesteps > model.learning_starts and model.replay_buffer.size() > 0
            n_updates = max(1, int(_ROUND_SECONDS / seconds_per_update))
            if ready and settings.updates_per_second is not None:
                started = now if started is None else started
                due = (now - started) * settings.updates_per_second - self.num_updates
                n_updates = min(n_updates, int(due))
            if ready and n_updates > 0:
                model._update_current_progress_remaining(model.num_timesteps, settings.total_timesteps)
                model.train(gradient_steps=n_updates, batch_size=model.batch_size)
                self.num_updates += n_updates
                if not has_finite_weights(model.policy):
                    raise RuntimeError(
                        "learning diverged, weights are not finite: go on from the checkpoint with a smaller learning_rate"
                    )
                self.weights.publish(acting_module(model))
                seconds_per_update = max(1e-5, (time.monotonic() - now) / n_updates)
            else:
                time.sleep(0.002)
            if now - logged_at > _LOG_SECONDS:
                values = {k: v for k, v in model.logger.name_to_value.items() if isinstance(v, int | float)}
                values["asynchronous/updates_per_second"] = (self.num_updates - updates_logged) / (now - logged_at)
                # If nobody reads, which a long reset may be the reason of, it is left out: learning must not wait for it.
                if select.select([], [self.report], [], 0.0)[1]:
                    self.report.send(("log", values))
                logged_at, updates_logged = now, self.num_updates
            if now - saved_at > settings.checkpoint_seconds:
                self.save()
                saved_at = now
        # So that the checkpoint says how far acting got.
        end = time.monotonic() + _LAST_READING_SECONDS
        while fill_replay_buffer(model, self.journals[0], 1000) and time.monotonic() < end:
            pass

    def save(self) -> None:
        """Write a checkpoint, in one move; nothing in place of a good one if learning diverged."""
        if not has_finite_weights(self.model.policy):
            return
        unfinished = self.settings.folder / "model.unfinished.zip"
        try:
            self.model.save(unfinished)
            replace_durably(unfinished, self.settings.folder / "model.zip")
        finally:
            # On a full disk it would take the room of what comes after it.
            unfinished.unlink(missing_ok=True)


def fill_replay_buffer(model: OffPolicyAlgorithm, journal: JournalReader, max_records: int) -> int:
    """Move transitions, and recorded trajectories, from a journal to a model's replay buffer.

    :return: how many
    """
    assert model.replay_buffer is not None
    records = journal.read(max_records)
    for record in records:
        if "dt" in record:
            try:
                model.replay_buffer.add_trajectory(**{**record, "dt": float(record["dt"])})  # type: ignore[attr-defined]
            except ValueError as error:
                # What somebody did must not stop the machine.
                logger.warning("a demonstration was left out: %s", error)
            continue
        transition = Transition.from_arrays(record)
        model.replay_buffer.add(*transition[:-1])  # type: ignore[arg-type]
        model.num_timesteps = transition.num_timesteps
    return len(records)
