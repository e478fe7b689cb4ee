"""The acting process: keeps the clock, never waits for the learner, and leaves the machine in a safe state."""

import contextlib
import ctypes
import logging
import math
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_ctco.common.buffers import AddedTrajectory
from sb3_ctco.common.callbacks import as_callback
from sb3_ctco.common.lock import lock
from sb3_ctco.common.option_algorithm import OptionOffPolicyAlgorithm
from sb3_ctco.datasets import RecordedTrajectory
from sb3_ctco.fixed_rate import FixedRateSAC
from sb3_ctco.options import TAKEN_OVER, ValueInterrupt, is_finite
from sb3_ctco.realtime.journal import JournalReader, JournalWriter, check_meaning, repair_journal, segments
from sb3_ctco.realtime.learner import (
    LEARNER_LOCK,
    LearnerError,
    LearnerSettings,
    Transition,
    acting_module,
    fill_replay_buffer,
    run_learner,
)
from sb3_ctco.realtime.weights import SharedWeights
from sb3_ctco.wrappers import (
    Interrupt,
    OptionExecutionWrapper,
    RealTimeOptionWrapper,
    RealTimeWrapper,
    SupportsSendReceive,
    TakeOver,
    TakeOverWrapper,
)
from sb3_ctco.wrappers.checks import reset_env

logger = logging.getLogger(__name__)

SafeStop = Callable[[gym.Env], None]
AlgorithmType = TypeVar("AlgorithmType", bound=OffPolicyAlgorithm)

#: The model that the learner begins with
_START = "start.zip"
#: How long the learner may take to start and to read what was collected before, in s
_START_SECONDS = 120.0
#: How long it may take to stop and save before it is killed, in s
_STOP_SECONDS = 60.0
#: How long a step may take in the background before the machine is stopped without its end, in s
_ABANDON_SECONDS = 1.0
#: How many decisions' times are kept
_MAX_KEPT = 100_000


def send_zero(env: gym.Env) -> None:
    """Command zero, or the nearest that actions may be, which stops a machine that is controlled by velocities.

    :param env: the bare environment, with ``send`` or only with ``step``; one whose episode has ended is left alone
    """
    space = env.action_space
    action = np.zeros(space.shape or (), dtype=space.dtype)
    _send(env, action.clip(space.low, space.high) if isinstance(space, spaces.Box) else action)


def _send(env: gym.Env, action: np.ndarray) -> None:
    if isinstance(env, SupportsSendReceive):
        env.send(action)
        return
    try:
        env.step(action)
    except ResetNeeded:
        return


class AsynchronousTrainer(Generic[AlgorithmType]):
    """Act in this process and learn in another one, for any off-policy algorithm of continuous actions.

    Acting keeps the period of the environment by the wall clock and never waits for the learner. Every transition is
    written to ``folder/journal``, from which the learner fills its replay buffer: whatever was collected survives the
    end of either process, and is deleted only when as much that is newer fills the replay buffer. Weights come back
    through shared memory, with a version, and are picked up between two decisions. Callbacks, the logger and the progress
    bar are those of ``model.learn``; the model that they see has the weights in use, but critics and optimizers only once
    learning is over, also by an error. ``folder/model.zip`` is the learner's checkpoint, with all of them.

    However learning ends (Ctrl-C, SIGTERM, an exception on either side, a learner that was killed), the last command is
    the safe one; then the learner ends its round of updates (0.1 s, or one update), saves and stops. A script that uses
    it needs ``if __name__ == "__main__":``, because the learner's process imports it.

    ::

        model = CTCO("MlpPolicy", env)
        with AsynchronousTrainer(model, env, folder="runs/arm") as trainer:
            trainer.learn(100_000, progress_bar=True)

    :param model: CTCO, SAC or another off-policy algorithm; the device it is on is used for acting, best the CPU
    :param env: the bare environment; it must tell its period, or be wrapped in
        :class:`~sb3_ctco.wrappers.RealTimeWrapper` already
    :param folder: for the journal and the checkpoints
    :param resume: continue what is in ``folder``; without it, an existing journal is an error. What was damaged, by a
        machine that lost its power for instance, is dropped with a warning, and kept as a copy. ``model.zip`` is a file of
        Stable-Baselines3, and to read it may run code that is in it: resume only what is yours
    :param real_time: whether to hold the wall-clock period; False plays a simulation as fast as it goes
    :param safe_stop: called with the bare environment to leave the machine in a safe state; by default it commands the safe
        action of a guarded ``RealTimeWrapper``, and zero where nothing is guarded
    :param updates_per_second: at most so many updates; None for as many as the learner's processor can do
    :param learner_device: device to learn on
    :param learner_threads: torch's threads of the learner; None for torch's own choice
    :param learner_niceness: how much less urgent learning is to the operating system than acting
    :param acting_priority: priority of the acting thread under Linux's real-time scheduler (SCHED_FIFO, 1 to 99), which no
        ordinary process delays; needs root or CAP_SYS_NICE. None leaves it to the ordinary scheduler
    :param checkpoint_seconds: between two checkpoints of the learner; ``math.inf`` for one at the end alone
    :param decide_ahead: decide on the next option this many seconds before the current one ends, see
        :class:`~sb3_ctco.wrappers.RealTimeOptionWrapper`; for algorithms with options
    :param interrupt: ends an option early, see there; for algorithms with options
    :param take_over: called with each observation; returns the action to send in place of the policy's, or None, see
        :class:`~sb3_ctco.wrappers.TakeOverWrapper`. What is done so becomes demonstrations, and no transitions of the policy;
        for algorithms with options
    :raises ValueError: for an environment, a model or settings that cannot be right, and for ``resume`` if what is in
        ``folder`` was collected with other settings or cannot be read
    :raises TypeError: if ``safe_stop`` or ``interrupt`` is no function
    :raises OSError: if ``folder`` cannot be written to
    :raises FileExistsError: if ``folder`` holds a journal and ``resume`` is not asked for
    :raises RuntimeError: if ``resume`` is asked for while another trainer uses ``folder``
    """

    def __init__(
        self,
        model: AlgorithmType,
        env: gym.Env,
        folder: str | Path,
        resume: bool = False,
        real_time: bool = True,
        safe_stop: SafeStop = send_zero,
        updates_per_second: float | None = None,
        learner_device: str = "auto",
        learner_threads: int | None = 1,
        learner_niceness: int = 10,
        acting_priority: int | None = None,
        checkpoint_seconds: float = 60.0,
        decide_ahead: float = 0.0,
        interrupt: Interrupt | None = None,
        take_over: TakeOver | None = None,
    ):
        _check_model_and_env(model, env)
        _check_functions(safe_stop, interrupt=interrupt, take_over=take_over)
        _check_numbers(
            updates_per_second=updates_per_second,
            learner_threads=learner_threads,
            learner_niceness=learner_niceness,
            acting_priority=acting_priority,
            checkpoint_seconds=checkpoint_seconds,
            decide_ahead=decide_ahead,
        )
        _check_device(learner_device)
        reactive = decide_ahead > 0 or interrupt is not None or take_over is not None
        if reactive and not isinstance(model, OptionOffPolicyAlgorithm):
            raise ValueError(
                f"decide_ahead, interrupt and take_over are for algorithms with options, which {type(model).__name__} is not"
            )
        if getattr(model.replay_buffer, "n_demonstrations", 0):
            raise ValueError(
                "the learner has a replay buffer of its own, and the demonstrations are in the model's: add them with "
                "add_trajectory of AsynchronousTrainer"
            )
        self.folder = Path(folder)
        self._journal_folder = self.folder / "journal"
        # Apart from the journal, whose oldest files are deleted.
        self._demonstration_folder = self.folder / "demonstrations"
        self._demonstrations: JournalWriter | None = None
        self._take_over: TakeOverWrapper | None = None
        earlier = self._journal_folder.exists() or segments(self._demonstration_folder) or (self.folder / "model.zip").exists()
        if earlier and not resume:
            raise FileExistsError(
                f"{self.folder} holds the experience of an earlier run: pass resume=True to continue it, or another folder"
            )
        _check_folder(self.folder)
        self.model = model
        self.bare_env = env.unwrapped
        self.safe_stop = safe_stop
        self.acting_priority = acting_priority
        #: Counts late ticks; None without ``real_time``
        self.real_time: RealTimeWrapper | None = None
        if real_time:
            env, self.real_time = _hold_period(env, model)
        self._supervisor = _Supervisor(env)
        wrapped: gym.Env = self._supervisor
        if take_over is not None:
            wrapped = self._take_over = TakeOverWrapper(wrapped, take_over, self._keep_demonstration, _given_dt(model))
        # In real time also without any of that, so that a watchdog ends an option.
        if reactive or (real_time and isinstance(model, OptionOffPolicyAlgorithm)):
            assert isinstance(model, OptionOffPolicyAlgorithm)
            wrapped = RealTimeOptionWrapper.like(
                model.wrap_env(wrapped), decide_ahead=decide_ahead, interrupt=interrupt, background=real_time
            )
        # Of its own accord each of these algorithms wraps what is bare; stock SAC takes it as it is.
        model.set_env(wrapped)
        if model.seed is not None:
            model.env.seed(model.seed)  # type: ignore[union-attr]
        self._settings: dict[str, Any] = {
            "device": learner_device,
            "n_threads": learner_threads,
            "niceness": learner_niceness,
            "updates_per_second": updates_per_second,
            "checkpoint_seconds": checkpoint_seconds,
        }
        #: Seconds that each of the latest 100,000 decisions took the policy, the latest last
        self.decision_seconds: deque[float] = deque(maxlen=_MAX_KEPT)
        #: Age in s of the weights that each of them was made with
        self.weight_ages: deque[float] = deque(maxlen=_MAX_KEPT)
        self._is_unfinished = False
        if resume:
            with _alone_in(self.folder):
                for journal in (self._journal_folder, self._demonstration_folder):
                    repair_journal(journal)
                    check_meaning(journal, _meaning(model))
                self._load_checkpoint()
                self._count_timesteps()

    def __enter__(self) -> "AsynchronousTrainer[AlgorithmType]":
        return self

    def __exit__(self, *exception: object) -> None:
        self._supervisor.close()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "asynchronous",
        progress_bar: bool = False,
    ) -> AlgorithmType:
        """Act until ``total_timesteps`` environment steps have been made in all, what was resumed included.

        :return: the model, with everything that the learner learned
        :raises ValueError: if ``total_timesteps`` is negative
        :raises LearnerError: if the learner failed or was killed
        :raises RuntimeError: if another trainer uses the folder
        :raises OSError: if what was collected cannot be written
        """
        _check_numbers(total_timesteps=total_timesteps)
        model = self.model
        remaining = total_timesteps - model.num_timesteps
        if remaining <= 0:
            return model
        with _alone_in(self.folder):
            if self._is_unfinished:
                # What acts has the learner's actor, and critics from before.
                self._load_checkpoint()
            self._is_unfinished = True
            try:
                self._learn(total_timesteps, remaining, callback, log_interval, tb_log_name, progress_bar)
            except BaseException:
                # As far as it was saved, so that nobody goes on with critics that know nothing of the actor.
                try:
                    self._load_checkpoint()
                except Exception:
                    logger.exception("the model is not what the learner learned")
                raise
            self._load_checkpoint()
            self._is_unfinished = False
        return model

    def _learn(
        self,
        total_timesteps: int,
        remaining: int,
        callback: MaybeCallback,
        log_interval: int,
        tb_log_name: str,
        progress_bar: bool,
    ) -> None:
        model = self.model
        context = multiprocessing.get_context("spawn")
        weights = SharedWeights(acting_module(model), context)
        stop = context.RawValue(ctypes.c_bool, False)
        report, learner_end = context.Pipe(duplex=False)
        start = self.folder / _START
        start.unlink(missing_ok=True)  # an earlier run's
        assert model.replay_buffer is not None
        # What a replay buffer of this size has forgotten, no other one would learn from.
        journal = JournalWriter(self._journal_folder, _meaning(model), keep=model.replay_buffer.buffer_size)
        self._demonstrations = JournalWriter(self._demonstration_folder, _meaning(model))
        model.save(start)
        settings = LearnerSettings(type(model), start, self.folder, total_timesteps, **self._settings)
        process = context.Process(target=run_learner, args=(settings, weights, stop, learner_end), name="learner", daemon=True)
        link = _Link(process, report, weights, model)
        in_between = _AsynchronousCallback(self, link)
        given = as_callback(callback)
        callbacks = CallbackList([in_between, *([] if given is None else [given])])
        try:
            process.start()
            learner_end.close()
            with _one_signal() as none_more:
                try:
                    link.wait_until_ready()
                    if self.real_time is not None:
                        self.real_time.alarm = None  # an earlier learner's
                    self._supervisor.check = lambda: self._look_at(link)
                    with _prompt_threads(), _scheduled(self.acting_priority):
                        self._act(in_between, journal, remaining, callbacks, log_interval, tb_log_name, progress_bar)
                finally:
                    try:
                        none_more()
                    finally:  # a signal may come in between
                        self._supervisor.check = None
                        self._make_safe()
        finally:
            try:
                try:
                    journal.close()
                finally:
                    self._close_demonstrations()
            finally:
                stop.value = True
                link.join()
        link.raise_if_failed()

    def _act(
        self,
        in_between: "_AsynchronousCallback",
        journal: JournalWriter,
        total_timesteps: int,
        callback: MaybeCallback,
        log_interval: int,
        tb_log_name: str,
        progress_bar: bool,
    ) -> None:
        """``OffPolicyAlgorithm.learn`` of Stable-Baselines3 2.9.2 with a journal for replay buffer, and without ``train``."""
        model = self.model
        total_timesteps, callback = model._setup_learn(
            total_timesteps, callback, model.num_timesteps == 0, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        assert model.env is not None
        env = _DecidedEnv(model.env, in_between)
        while model.num_timesteps < total_timesteps:
            rollout = model.collect_rollouts(
                env,
                callback,
                TrainFreq(1, TrainFrequencyUnit.STEP),  # nobody trains here
                _JournalBuffer(journal, model),  # type: ignore[arg-type]
                model.action_noise,
                model.learning_starts,
                log_interval,
            )
            if not rollout.continue_training:
                break
        callback.on_training_end()

    def add_trajectory(
        self,
        observations: Any,
        actions: np.ndarray,
        rewards: np.ndarray,
        terminated: bool,
        truncated: bool,
        dt: float,
    ) -> AddedTrajectory:
        """Have the learner learn from a recorded trajectory, too, see :meth:`OptionReplayBuffer.add_trajectory`.

        It is kept in ``folder/demonstrations``. For use before learning; what is recorded meanwhile is ``take_over``'s.

        :return: what becomes of it
        :raises ValueError: if it cannot be right, see there, or the model's algorithm is none with options
        """
        if not isinstance(self.model, OptionOffPolicyAlgorithm):
            raise ValueError(f"demonstrations become options, for which {type(self.model).__name__} has no use")
        trajectory = RecordedTrajectory(observations, actions, rewards, terminated, truncated, dt)
        buffer: Any = self.model.replay_buffer
        added = buffer.add_trajectory(*trajectory)
        buffer.n_demonstrations = 0  # The learner's has them; here they were looked at.
        with _alone_in(self.folder):
            self._demonstrations = JournalWriter(self._demonstration_folder, _meaning(self.model))
            self._keep_demonstration(trajectory)
            self._close_demonstrations()
        return added

    def _close_demonstrations(self) -> None:
        demonstrations, self._demonstrations = self._demonstrations, None
        assert demonstrations is not None
        demonstrations.close()

    def _keep_demonstration(self, trajectory: RecordedTrajectory) -> None:
        if self._demonstrations is None:
            logger.warning("what somebody else played outside of learn is not kept")
            return
        self._demonstrations.add(trajectory._asdict())

    def restore_replay_buffer(self) -> None:
        """Fill the model's own replay buffer with everything that was collected, for instance to learn on in place."""
        buffer: Any = self.model.replay_buffer
        if buffer.size():
            raise ValueError(
                f"the model's replay buffer holds {buffer.size()} transitions already, which may be the same ones: call this "
                "once, or reset it before, model.replay_buffer.reset()"
            )
        for folder in filter(segments, (self._demonstration_folder, self._journal_folder)):
            journal = JournalReader(folder)
            while fill_replay_buffer(self.model, journal, 1000):
                pass
            journal.close()

    def _look_at(self, link: "_Link") -> None:
        """See whether the learner is alive. Where commands are guarded it is no error here, within a tick."""
        try:
            link.check()
        except LearnerError as error:
            if self.real_time is None or self.real_time.guard is None:
                raise
            first, *further = str(error).splitlines()
            # The last line of a traceback says what went wrong.
            self.real_time.alarm = f"{first} {further[-1]}" if first.endswith(":") else first

    def _make_safe(self) -> None:
        option_env = unwrap_wrapper(self.model.env.envs[0], RealTimeOptionWrapper)  # type: ignore[union-attr]
        # Learning that goes on begins with a reset.
        self.model._last_obs = None
        try:
            try:
                # Somebody who waits for a machine that says nothing would wait for ever.
                if isinstance(option_env, RealTimeOptionWrapper) and not option_env.abandon(_ABANDON_SECONDS):
                    logger.error("a step in the background has not ended within %.1f s", _ABANDON_SECONDS)
            finally:
                if self._supervisor.has_commanded:
                    self._stop()
        except Exception as error:
            if self._supervisor.has_stepped or error.__context__ is None:
                raise
            # Whatever the reset of a machine failed by says more, for instance that it is not connected.
            logger.exception("safe_stop failed after a reset that did not end")
        finally:
            if self._take_over is not None:
                self._take_over.hand_over()

    def _stop(self) -> None:
        guard = None if self.real_time is None else self.real_time.guard
        if self.safe_stop is not send_zero or self.real_time is None or guard is None:
            self.safe_stop(self.bare_env)
        else:  # what the guard sends, zero may be far from where joints are held
            _send(self.real_time.env, guard.safe_action().astype(guard.low.dtype).clip(guard.low, guard.high))

    def _load_checkpoint(self) -> None:
        path = self.folder / "model.zip"
        if not path.exists():
            if segments(self._journal_folder):
                logger.warning("there is no %s: learning begins anew, with all that was collected", path)
            path = self.folder / _START
            # What acts may have an actor that the learner published before it failed.
            if not (self._is_unfinished and path.exists()):
                return
        model = self.model
        try:
            learned = type(model).load(path, device=model.device)
            if isinstance(model, OptionOffPolicyAlgorithm):
                model.go_on_from(learned)  # type: ignore[arg-type]
            model.set_parameters(learned.get_parameters(), device=model.device)  # type: ignore[arg-type]
        except Exception as error:  # a damaged file fails in as many ways as it has parts
            raise ValueError(
                f"{path} cannot be read, or was learned with other networks ({type(error).__name__}: {error}): pass the "
                "arguments of that model, or move the file away to learn anew from what was collected"
            ) from error
        for name in model._get_torch_save_params()[1]:
            # A temperature may be fixed, and then be None in some algorithms.
            if isinstance(getattr(model, name), th.Tensor):
                getattr(model, name).data.copy_(getattr(learned, name).data)
        model._n_updates = learned._n_updates

    def _count_timesteps(self) -> None:
        if not segments(self._journal_folder):
            return
        journal = JournalReader(self._journal_folder)
        while records := journal.read(1000):
            self.model.num_timesteps = Transition.from_arrays(records[-1]).num_timesteps
        journal.close()


def _given_dt(model: OffPolicyAlgorithm) -> float | None:
    """The period that the user gave the algorithm, in s; None if the environment is to tell it."""
    if isinstance(model, FixedRateSAC) and model.option_space is not None:
        return model.option_space.dt
    return model.dt if isinstance(model, OptionOffPolicyAlgorithm) and model._dt_was_given else None


def _hold_period(env: gym.Env, model: OffPolicyAlgorithm) -> tuple[gym.Env, RealTimeWrapper]:
    """An environment with a RealTimeWrapper, and that one: directly around a machine, whose step has two halves."""
    found, dt = unwrap_wrapper(env, RealTimeWrapper), _given_dt(model)
    if isinstance(found, RealTimeWrapper):
        if dt is not None and not math.isclose(found.dt, dt, rel_tol=1e-6):
            raise ValueError(f"the environment's RealTimeWrapper has dt={found.dt}, the model has dt={dt}: give both the same")
        return env, found
    if env is env.unwrapped or not isinstance(env.unwrapped, SupportsSendReceive):
        real_time = RealTimeWrapper(env, dt)
        return real_time, real_time
    innermost: Any = env
    while innermost.env is not env.unwrapped:
        innermost = innermost.env
    innermost.env = RealTimeWrapper(env.unwrapped, dt)
    return env, innermost.env


def _check_model_and_env(model: Any, env: Any) -> None:
    if not isinstance(model, OffPolicyAlgorithm):
        raise ValueError(f"AsynchronousTrainer needs an off-policy algorithm such as CTCO or SAC, not {type(model).__name__}")
    if not isinstance(env, gym.Env) or unwrap_wrapper(env, OptionExecutionWrapper) is not None:
        raise ValueError(
            f"pass one bare Gymnasium environment, not {env}: AsynchronousTrainer wraps it itself, with the settings of "
            "the model"
        )
    if model.use_sde:
        raise ValueError("use_sde=True is not supported: its noise would be drawn anew at each step of the machine")
    if isinstance(model, FixedRateSAC) and model.updates_per_step is not None:
        raise ValueError("AsynchronousTrainer has no use for a SAC that holds its actions: train CTCO or FiGARSAC with it")
    if not isinstance(model.action_space, spaces.Box):
        raise ValueError(f"AsynchronousTrainer needs continuous actions, not {model.action_space}")
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None and normalizer.norm_obs:
        raise ValueError(
            "the model sees observations through VecNormalize, and AsynchronousTrainer acts without it: normalise them with "
            "gymnasium.wrappers.NormalizeObservation in the environment, or make a model without"
        )
    if model.replay_buffer_class is not None and issubclass(model.replay_buffer_class, HerReplayBuffer):
        raise ValueError(
            "HerReplayBuffer is not supported: it computes rewards with the environment, which the learner has not"
        )


def _check_functions(safe_stop: Any, **others: Any) -> None:
    if not callable(safe_stop):
        raise TypeError(f"safe_stop must be a function of the bare environment, not {safe_stop!r}: it leaves the machine safe")
    if isinstance(others["interrupt"], ValueInterrupt):
        raise TypeError(
            f"interrupt must be a rule about observations, not {type(others['interrupt']).__name__}: the acting process gets "
            "the actor's weights, not the critics'"
        )
    for name, function in others.items():
        if not (function is None or callable(function)):
            raise TypeError(f"{name} must be a function or None, not {function!r}")


#: Of each number: its type, whether None is allowed, its range, and that in words
_NUMBERS: dict[str, tuple[type, bool, Callable[[Any], bool], str]] = {
    "total_timesteps": (int, False, lambda n: n >= 0, "a whole number of steps from 0"),
    "updates_per_second": (float, True, lambda x: 0 < x < math.inf, "a positive number or None"),
    "learner_threads": (int, True, lambda n: n >= 1, "a whole number from 1 or None"),
    "learner_niceness": (int, False, lambda n: 0 <= n <= 19, "a whole number from 0 to 19"),
    "acting_priority": (
        int,
        True,
        lambda n: hasattr(os, "sched_setscheduler") and 1 <= n <= 99,
        "None or, on Linux, a whole number from 1 to 99",
    ),
    "checkpoint_seconds": (float, False, lambda x: x > 0, "a positive number of seconds"),
    "decide_ahead": (float, False, lambda x: 0 <= x < math.inf, "a finite number of seconds from 0"),
}


def _check_numbers(**numbers: Any) -> None:
    """Refuse numbers that are none, are out of their range, or are NaN, which fails every comparison."""
    for name, value in numbers.items():
        kind, optional, is_allowed, allowed = _NUMBERS[name]
        if value is None and optional:
            continue
        kinds = (int, np.integer) if kind is int else (int, float, np.integer, np.floating)
        if isinstance(value, bool) or not isinstance(value, kinds) or not is_allowed(value):
            raise ValueError(f"{name} must be {allowed}, not {value!r}")


def _check_device(device: Any) -> None:
    try:
        get_device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"learner_device={device!r} is no device of torch, such as 'cpu' or 'cuda': {error}") from error


def _check_folder(folder: Path) -> None:
    """Make a folder, and refuse one that cannot be written to, before anything moves."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"experience cannot be kept in {folder} ({error}): pass a folder that can be written to") from error


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep others away from what is collected.

    :raises RuntimeError: if another trainer uses it
    """
    with lock(folder) as acts_alone:
        learns_alone = False
        if acts_alone:
            # The learner of one that was killed may still be saving.
            with lock(folder, _STOP_SECONDS, LEARNER_LOCK) as learns_alone:
                pass
        if not learns_alone:
            raise RuntimeError(f"another AsynchronousTrainer uses {folder}: wait for its end, or pass another folder")
        yield


class _Supervisor(gym.Wrapper):
    """Lets the trainer look at every primitive step, so that it can stop within an option."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.check: Callable[[], None] | None = None
        self.has_commanded = self.has_stepped = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        # A machine moves to where it starts.
        self.has_commanded = self.has_commanded or isinstance(self.env.unwrapped, SupportsSendReceive)
        return reset_env(self.env, seed, options)

    def step(self, action: Any) -> Any:
        if self.check is not None:
            self.check()
        self.has_commanded = self.has_stepped = True
        return self.env.step(action)


class _JournalBuffer:
    """Stands where the acting model has its replay buffer."""

    def __init__(self, journal: JournalWriter, model: OffPolicyAlgorithm):
        self._journal = journal
        self._model = model

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        if infos[0].get(TAKEN_OVER):
            return  # its option is not what was played
        # What is in the journal is learned from, by each training that goes on with it.
        if not (is_finite(next_obs) and np.isfinite(reward).all()):
            raise ValueError(f"the environment returned what is not finite: the observation {next_obs}, the reward {reward}")
        # Stable-Baselines3 hands over arrays of its own, except for the observations, which the next step writes over.
        transition = Transition(_copy(obs), _copy(next_obs), action, reward, done, infos, self._model.num_timesteps)
        self._journal.add(transition.to_arrays(), transition.n_rows)


def _meaning(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """What a model's transitions mean, by which another one may or may not learn from them."""
    space = model.observation_space
    leaves = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    actions: Any = model.action_space
    options: dict[str, Any] | None = None
    if isinstance(model, OptionOffPolicyAlgorithm):
        actions = model.primitive_action_space
        # A trajectory that is no name is a class, of which JSON keeps the name.
        arguments = model.option_space.arguments
        options = {name: value if isinstance(value, int | float | str) else str(value) for name, value in arguments.items()}
        if model.reward_unit != "rate":
            options["reward_unit"] = model.reward_unit
    elif isinstance(model, FixedRateSAC) and model.option_space is not None:
        options = {"dt": model.option_space.dt, "discount_rate": model.option_space.discount_rate}
        options["reward_scale"] = model.reward_scale
    return {
        "algorithm": type(model).__name__,
        "options": options,
        "actions": {"low": actions.low.tolist(), "high": actions.high.tolist()},
        "observations": {name: [list(leaf.shape or ()), str(leaf.dtype)] for name, leaf in leaves.items()},
    }


def _copy(obs: np.ndarray | dict[str, np.ndarray]) -> np.ndarray | dict[str, np.ndarray]:
    return {key: value.copy() for key, value in obs.items()} if isinstance(obs, dict) else obs.copy()


class _Link:
    """The acting process's end of the line to the learner."""

    def __init__(self, process: Any, report: Any, weights: SharedWeights, model: OffPolicyAlgorithm):
        self.process = process
        self.report = report
        self.weights = weights
        self.model = model
        self.log: dict[str, float] = {}
        self._is_ready = False
        self._failure: str | None = None

    def wait_until_ready(self) -> None:
        deadline = time.monotonic() + _START_SECONDS
        while not self._is_ready:
            if time.monotonic() >= deadline:
                raise LearnerError(f"the learner did not start within {_START_SECONDS:.0f} s")
            self.report.poll(0.1)
            self.check()

    def check(self) -> None:
        """Raise if the learner has failed or gone."""
        code = self.process.exitcode  # first: what it said before its end is in the pipe then
        self._read_all()
        if code is not None:
            self._note_end(code)
        self.raise_if_failed()

    def raise_if_failed(self) -> None:
        if self._failure is not None:
            raise LearnerError(
                f"{self._failure}\nThe environment was stopped; all experience is in the journal: resume=True continues."
            )

    def join(self) -> None:
        if self.process.pid is None:
            return  # was never started
        deadline = time.monotonic() + _STOP_SECONDS
        # The learner does not wait for a reader, but a pipe that is full would not have its last word.
        while self.process.exitcode is None and time.monotonic() < deadline:
            if self.report.poll(0.1) and self._read() is None:
                self.process.join(max(0.0, deadline - time.monotonic()))
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()
            self._failure = self._failure or f"the learner did not stop within {_STOP_SECONDS:.0f} s and was killed"
        self._read_all()
        if self.process.exitcode:  # while it saved
            self._note_end(self.process.exitcode)
        self.report.close()

    def _note_end(self, code: int) -> None:
        how = f"was killed by signal {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        self._failure = self._failure or f"the learner {how}"

    def _read_all(self) -> None:
        while self.report.poll(0) and self._read() is not None:
            pass

    def _read(self) -> str | None:
        try:
            kind, content = self.report.recv()
        except (EOFError, OSError):  # its end, or half a message of one that was killed
            return None
        if kind == "ready":
            self._is_ready = True
        elif kind == "log":
            self.log = content
        elif kind == "failed":
            self._failure = self._failure or f"the learner failed:\n{content}"
        return str(kind)


class _AsynchronousCallback(BaseCallback):
    """Picks weights up between decisions and hands the learner's log on."""

    def __init__(self, trainer: AsynchronousTrainer, link: _Link):
        super().__init__()
        self.trainer = trainer
        self.link = link

        self._decision_began = 0.0

    def _on_rollout_start(self) -> None:
        self.link.weights.fetch(acting_module(self.link.model))
        self._decision_began = time.perf_counter()

    def decided(self) -> None:
        """The policy has decided."""
        self.trainer.decision_seconds.append(time.perf_counter() - self._decision_began)
        self.trainer.weight_ages.append(self.link.weights.age)

    def _on_step(self) -> bool:
        self.link.raise_if_failed()
        log, self.link.log = self.link.log, {}  # at once: another thread may look at the link
        if log:
            for name, value in log.items():
                self.logger.record(name, value)
            self.logger.record("asynchronous/weights_version", self.link.weights.version)
            self.logger.record("asynchronous/weights_age", self.link.weights.age)
            if self.trainer.real_time is not None:
                statistics = self.trainer.real_time.total_statistics
                self.logger.record("real_time/ticks", statistics.ticks)
                self.logger.record("real_time/late_ticks", statistics.late_ticks)
                self.logger.record("real_time/worst_lateness", statistics.worst_lateness)
                self.logger.record("real_time/safe_ticks", statistics.safe_ticks)
        return True


class _DecidedEnv(VecEnvWrapper):
    """Tells of each decision when it reaches the environment."""

    def __init__(self, venv: VecEnv, in_between: _AsynchronousCallback):
        super().__init__(venv)
        self.in_between = in_between

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.in_between.decided()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()


@contextmanager
def _one_signal() -> Iterator[Callable[[], None]]:
    """The first SIGTERM ends the block by SystemExit, the first SIGINT as it does outside, so that what follows is done.

    A second one does not break that off; the third does. A SIGINT that is ignored outside, or that ends nothing there, counts
    as none. It yields a function after which the first does not break it off, either, but takes effect when the block ends.
    SIGHUP, the end of a terminal, is as SIGTERM, unless it is handled or ignored outside.
    """
    n_signals, has_raised = 0, False
    put_off: tuple[int, Any] | None = None

    def none_more() -> None:
        nonlocal n_signals
        n_signals = max(n_signals, 1)

    if threading.current_thread() is not threading.main_thread():
        yield none_more
        return

    interrupt: Any = signal.getsignal(signal.SIGINT)
    if interrupt == signal.SIG_DFL:  # which would leave the machine as it is
        interrupt = signal.default_int_handler

    def end(number: int, frame: Any) -> None:
        if number != signal.SIGINT:
            raise SystemExit(128 + number)
        interrupt(number, frame)

    def handle(number: int, frame: Any) -> None:
        nonlocal n_signals, has_raised, put_off
        if n_signals == 1:
            n_signals = 2
            put_off = None if has_raised else (number, frame)
            logger.warning("%s: the machine is being made safe; once more breaks that off", signal.Signals(number).name)
            return
        try:
            end(number, frame)
        except BaseException:
            n_signals, has_raised = n_signals + 1, True
            raise

    handled = [signal.SIGTERM, signal.SIGINT] if callable(interrupt) else [signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        handled.append(signal.SIGHUP)
    before: dict[int, Any] = {number: signal.signal(number, handle) for number in handled}
    try:
        yield none_more
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if put_off is not None:
            end(*put_off)


@contextmanager
def _prompt_threads() -> Iterator[None]:
    """Let threads take turns sooner than every 5 ms, Python's default and more than a period at 500 Hz.

    A tick may wait for several turns: 0.2 % were late by 1 ms with turns of 0.5 ms, 0.01 % with 0.1 ms
    (``benchmarks/README.md``, "Keeping the clock").
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def _scheduled(priority: int | None) -> Iterator[None]:
    """Run this thread, and those that it starts meanwhile, under the real-time scheduler."""
    if priority is None:
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        raise PermissionError(
            f"acting_priority={priority} needs root or CAP_SYS_NICE: grant it (sudo, or rtprio in /etc/security/limits.conf), "
            "or pass None"
        ) from None
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)
