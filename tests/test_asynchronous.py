"""Acting and learning in two processes: what is stored, what comes back, and how it ends."""

import contextlib
import itertools
import logging
import math
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import PATIENCE
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, ConvertCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ctco import CTCO, FiGARSAC, OptionExecutionWrapper, sac_at_rate
from sb3_ctco.common.lock import lock
from sb3_ctco.realtime import AsynchronousTrainer, JournalError, JournalReader, JournalWriter, LearnerError, Transition
from sb3_ctco.realtime import trainer as trainer_module
from sb3_ctco.realtime.weights import SharedWeights
from sb3_ctco.safety import Safety
from sb3_ctco.wrappers import RealTimeOptionWrapper, RealTimeWrapper

# Processes that start and stop
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def interrupts_interrupt():
    """A shell's background job, which the tests may be, ignores SIGINT; what nohup starts ignores SIGHUP."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGHUP, before[1])


class Point(gym.Env):
    """A point moved by its velocity; every command is kept."""

    def __init__(self, fail_at=None):
        self.dt = 0.02
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.commands = []
        self.fail_at = fail_at

    def _obs(self):
        return np.array([self.x, self.steps * self.dt], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = 0.0, 0
        return self._obs(), {}

    def step(self, action):
        self.commands.append(float(action[0]))
        if self.fail_at is not None and len(self.commands) == self.fail_at:
            raise ConnectionError("the cable was pulled")
        self.x += self.dt * float(action[0])
        self.steps += 1
        return self._obs(), -abs(self.x - 0.3), False, self.steps >= 50, {}


def make_model(algorithm, env, **kwargs):
    return algorithm(
        "MlpPolicy", env, learning_starts=40, batch_size=16, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu", **kwargs
    )


SMALL = {"batch_size": 16, "policy_kwargs": {"net_arch": [16]}, "seed": 0, "device": "cpu"}


def records_of(folder):
    reader = JournalReader(folder / "journal")
    records = [Transition.from_arrays(arrays) for arrays in reader.read(10**6)]
    reader.close()
    return records


def test_shared_weights_have_a_version_and_arrive_whole():
    source, target = (th.nn.Sequential(th.nn.Linear(3, 4), th.nn.BatchNorm1d(4)) for _ in range(2))
    weights = SharedWeights(source, multiprocessing.get_context("spawn"))
    assert not weights.fetch(target)
    weights.publish(source)
    assert weights.fetch(target)
    assert weights.version == 1
    for name, tensor in source.state_dict().items():
        assert th.equal(tensor, target.state_dict()[name]), name
    assert not weights.fetch(target), "these are known"
    weights.publish(source)
    weights.publish(source)
    weights._version.value += 1
    assert not weights.fetch(target), "they are being written, and a reader does not wait"
    weights._version.value += 1
    assert weights.fetch(target)
    assert 0 <= weights.age < 10
    weights.publish(source)
    before = {name: tensor.clone() for name, tensor in target.state_dict().items()}
    weights._array()[3] ^= 1
    assert not weights.fetch(target), "what was read is not what was written"
    assert all(th.equal(tensor, before[name]) for name, tensor in target.state_dict().items())


def publish_forever(weights, module):
    with th.no_grad():
        for value in itertools.count():
            for parameter in module.parameters():
                parameter.fill_(value % 1000)
            weights.publish(module)


def test_weights_are_of_one_version_while_another_process_writes():
    context = multiprocessing.get_context("spawn")
    source, target = th.nn.Linear(200, 200), th.nn.Linear(200, 200)
    weights = SharedWeights(source, context)
    writer = context.Process(target=publish_forever, args=(weights, source), daemon=True)
    writer.start()
    n_fetched, deadline = 0, time.monotonic() + PATIENCE
    while n_fetched < 50 and time.monotonic() < deadline:
        if weights.fetch(target):
            n_fetched += 1
            values = th.cat([parameter.flatten() for parameter in target.parameters()])
            assert (values == values[0]).all()
    writer.kill()
    writer.join()
    assert n_fetched == 50


class UntilLearned(BaseCallback):
    """Ends acting once the learner's weights have come, however busy the machine is; pauses for so many s after each step."""

    def __init__(self, pause=0.0):
        super().__init__()
        self.pause = pause

    def _weights(self):
        return th.cat([p.detach().flatten() for p in self.model.policy.actor.parameters()])

    def _on_training_start(self):
        self.first = self._weights().clone()

    def _on_step(self):
        time.sleep(self.pause)
        return th.equal(self._weights(), self.first)


class Watcher(BaseCallback):
    """Counts its ticks and keeps what was logged; ends acting once it has seen enough."""

    def __init__(self, *names):
        super().__init__()
        self.ticks = 0
        self.names, self.logged = set(names), set()

    def _on_step(self):
        self.ticks += 1
        self.logged.update(self.logger.name_to_value)
        return self.ticks < 250 or not self.names <= self.logged


@pytest.mark.parametrize("algorithm", [SAC, CTCO, FiGARSAC])
def test_learns_elsewhere_and_everything_comes_back(tmp_path, algorithm):
    env = Point()
    model = make_model(algorithm, env)
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    watcher = Watcher("asynchronous/updates_per_second", "train/critic_loss")
    start = time.monotonic()
    with AsynchronousTrainer(model, env, tmp_path, updates_per_second=50) as trainer:
        trainer.learn(10**6, [watcher, CheckpointCallback(100, str(tmp_path / "checkpoints"))])
        statistics = trainer.real_time.total_statistics
    elapsed = time.monotonic() - start
    assert statistics.ticks >= 245
    assert model.num_timesteps >= 250
    assert watcher.ticks == model.num_timesteps
    assert 0 < model._n_updates < 50 * elapsed, "no more than the updates a second that were asked for"
    after = model.policy.state_dict()
    assert all(not th.equal(before[name], after[name]) for name in before if "critic" in name or "latent_pi" in name)
    learned = algorithm.load(tmp_path / "model.zip")
    assert all(th.equal(after[name], tensor) for name, tensor in learned.policy.state_dict().items())
    assert len(list((tmp_path / "checkpoints").iterdir())) == model.num_timesteps // 100
    assert algorithm.load(next((tmp_path / "checkpoints").iterdir()), env=Point()).predict(np.zeros(2))[0].size

    # Every step that was made is in the journal, with the reward that it had; but as in Stable-Baselines3 the last decision is
    # not, if a callback ends learning with it.
    records = records_of(tmp_path)
    assert model.num_timesteps - 25 <= records[-1].num_timesteps < model.num_timesteps
    for first, second in itertools.pairwise(records):
        if not first.done[0]:
            np.testing.assert_array_equal(first.next_obs, second.obs)
    assert len(records) > 3
    # The last command is the safe one.
    assert env.commands[-1] == 0.0
    assert any(command != 0.0 for command in env.commands)
    # In its own process the model learns as ever.
    model.learn(60)


def test_actor_uses_new_weights_while_it_acts(tmp_path):
    env = Point()
    model = make_model(SAC, env)
    first = model.policy.actor.latent_pi[0].weight.detach().clone()
    seen = []

    def watch(local_variables, global_variables):
        seen.append(float((model.policy.actor.latent_pi[0].weight.detach() - first).abs().max()))
        # However long the learner takes on a machine that is busy.
        return len(set(seen)) <= 5

    with AsynchronousTrainer(model, env, tmp_path) as trainer:
        trainer.learn(3000, watch)
        assert len(trainer.decision_seconds) == len(trainer.weight_ages) == len(seen)
    assert seen[20] == 0.0
    assert len(set(seen)) == 6


def test_resume_continues_with_all_that_was_collected(tmp_path):
    env = Point()
    with AsynchronousTrainer(make_model(CTCO, env), env, tmp_path, real_time=False, updates_per_second=500) as trainer:
        trainer.learn(100)
    n_records, learned = len(records_of(tmp_path)), CTCO.load(tmp_path / "model.zip")
    with pytest.raises(FileExistsError, match="resume=True"):
        AsynchronousTrainer(make_model(CTCO, env), env, tmp_path)

    model = make_model(CTCO, env)
    with AsynchronousTrainer(model, env, tmp_path, resume=True, real_time=False) as trainer:
        steps = model.num_timesteps
        assert steps >= 100
        for name, tensor in learned.policy.state_dict().items():
            assert th.equal(model.policy.state_dict()[name], tensor)
        assert th.equal(model.log_ent_coefs, learned.log_ent_coefs)
        trainer.learn(steps)  # has been reached
        assert len(records_of(tmp_path)) == n_records
        trainer.learn(steps + 60)
    records = records_of(tmp_path)
    assert len(records) > n_records
    assert records[-1].num_timesteps == model.num_timesteps >= steps + 60
    trainer.restore_replay_buffer()
    assert model.replay_buffer.n_decisions == len(records)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """The folder of a run of CTCO that is over, and how many environment steps it made."""
    folder = tmp_path_factory.mktemp("collected")
    env = Point()
    with AsynchronousTrainer(make_model(CTCO, env), env, folder, real_time=False, updates_per_second=500) as trainer:
        trainer.learn(100)
    return folder, trainer.model.num_timesteps


@pytest.mark.parametrize(
    ("algorithm", "changes", "message"),
    [
        (CTCO, {"d_max": 0.4}, r"options={.*'d_max': 0.5.*} there, {.*'d_max': 0.4.*} here"),
        (CTCO, {"gamma": 0.9}, "'discount_rate'"),
        (CTCO, {"n_rbf": 3}, "'n_rbf': 2.*'n_rbf': 3"),
        (SAC, {}, "algorithm='CTCO' there, 'SAC' here; options="),
    ],
)
def test_resuming_what_means_something_else_is_refused(collected, algorithm, changes, message):
    folder, _ = collected
    env = Point()
    with pytest.raises(ValueError, match=f"means something else: .*{message}.*begin in another folder"):
        AsynchronousTrainer(make_model(algorithm, env, **changes), env, folder, resume=True)


def test_what_rewards_mean_is_kept_and_asked_of_a_journal(collected):
    env = OptionExecutionWrapper(Point(), reward_unit="impulse")
    with pytest.raises(ValueError, match=r"means something else: options=.*'reward_unit': 'impulse'"):
        AsynchronousTrainer(make_model(CTCO, env), Point(), collected[0], resume=True, real_time=False)


def test_a_sac_of_a_fixed_rate_has_its_rewards_weighed(tmp_path):
    model = sac_at_rate(Point(), 0.02, learning_starts_seconds=0.5, **SMALL)
    trainer = AsynchronousTrainer(model, Point(), tmp_path, real_time=False)
    assert trainer.model.get_env().get_attr("reward_scale") == [model.reward_scale]
    assert model.get_env().get_attr("option_space") == [model.option_space]
    # A journal tells what its rewards mean.
    JournalWriter(tmp_path / "journal", trainer_module._meaning(model)).close()
    other = sac_at_rate(Point(), 0.02, gamma_dt=0.02, **SMALL)
    with pytest.raises(ValueError, match=r"means something else: options=.*'reward_scale': "):
        AsynchronousTrainer(other, Point(), tmp_path, resume=True, real_time=False)
    held = sac_at_rate(Point(), 0.02, hold_seconds=0.1, **SMALL)
    with pytest.raises(ValueError, match="has no use for a SAC that holds its actions"):
        AsynchronousTrainer(held, Point(), tmp_path / "held", real_time=False)


def test_resuming_after_damage_says_what_was_dropped(collected, tmp_path, caplog):
    folder = shutil.copytree(collected[0], tmp_path / "run")
    n = len(records_of(folder))
    journal = folder / "journal" / "000000.journal"
    data = bytearray(journal.read_bytes())
    data[len(data) // 2] ^= 4
    journal.write_bytes(data)
    with pytest.raises(JournalError, match="is damaged at byte"):
        records_of(folder)
    env = Point()
    with caplog.at_level(logging.WARNING, logger="sb3_ctco.realtime.journal"):
        trainer = AsynchronousTrainer(make_model(CTCO, env), env, folder, resume=True)
    assert trainer.model.num_timesteps == collected[1]
    assert f"bytes were dropped, {n - 1} records are left" in caplog.text
    assert (folder / "journal" / "000000.journal.damaged").read_bytes() == data
    assert len(records_of(folder)) == n - 1


def test_resuming_without_a_checkpoint_or_with_a_broken_one(collected, tmp_path, caplog):
    folder = shutil.copytree(collected[0], tmp_path / "run")
    data = (folder / "model.zip").read_bytes()
    env = Point()
    for broken in (data[: len(data) // 2], b"", data[:200] + b"\0" * 4000 + data[4200:]):
        (folder / "model.zip").write_bytes(broken)
        with pytest.raises(ValueError, match=r"model.zip cannot be read.*move the file away"):
            AsynchronousTrainer(make_model(CTCO, env), env, folder, resume=True)
    (folder / "model.zip").write_bytes(data)
    with pytest.raises(ValueError, match="was learned with other networks"):
        AsynchronousTrainer(CTCO("MlpPolicy", env, policy_kwargs={"net_arch": [8]}), env, folder, resume=True)
    (folder / "model.zip").unlink()
    with caplog.at_level(logging.WARNING, logger="sb3_ctco.realtime.trainer"):
        trainer = AsynchronousTrainer(make_model(CTCO, env), env, folder, resume=True)
    assert "model.zip: learning begins anew, with all that was collected" in caplog.text
    assert trainer.model.num_timesteps == collected[1]


def test_a_start_file_that_is_gone_is_an_error_at_once(tmp_path, monkeypatch):
    env = Point()
    trainer = AsynchronousTrainer(make_model(CTCO, env), env, tmp_path)
    monkeypatch.setattr(trainer.model, "save", lambda path: None, raising=False)
    with pytest.raises(LearnerError, match=r"start\.zip"):
        trainer.learn(100)
    assert env.commands == []


def test_the_journal_keeps_what_the_replay_buffer_holds(tmp_path):
    env = Point()
    model = make_model(CTCO, env, buffer_size=30, n_sub_options=2, d_max=0.2)
    with AsynchronousTrainer(model, env, tmp_path, real_time=False) as trainer:
        for steps in (200, 400, 600):
            trainer.learn(steps)  # each one begins a segment
        trainer.restore_replay_buffer()
    assert model.replay_buffer.full
    assert sum(record.n_rows for record in records_of(tmp_path)) >= 30
    assert not (tmp_path / "journal" / "000000.journal").exists()


@pytest.mark.parametrize("join", ["free", "continuous", "smooth"])
def test_sub_options_are_in_the_learners_replay_buffer(tmp_path, join):
    arguments = {"n_sub_options": 4, "d_max": 0.5, "join": join}
    # With random options only, so that both do the same.
    there = make_model(CTCO, env := Point(), **arguments)
    there.learning_starts = 1000
    with AsynchronousTrainer(there, env, tmp_path, real_time=False) as trainer:
        trainer.learn(200)
        trainer.restore_replay_buffer()
    here = make_model(CTCO, Point(), **arguments)
    here.learning_starts = 1000
    here.learn(200)
    assert here.replay_buffer.n_decisions == there.replay_buffer.n_decisions == len(records_of(tmp_path))
    size = here.replay_buffer.size()
    assert size == there.replay_buffer.size() > 2 * here.replay_buffer.n_decisions
    for name in ("observations", "next_observations", "actions", "durations", "integrated_rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(there.replay_buffer, name)[:size], getattr(here.replay_buffer, name)[:size])


def test_exception_of_the_environment_stops_both(tmp_path):
    env = Point(fail_at=60)
    model = make_model(SAC, env)
    with AsynchronousTrainer(model, env, tmp_path) as trainer, pytest.raises(ConnectionError, match="cable"):
        before = {*vars(model)}
        trainer.learn(1000)
    assert env.commands[-1] == 0.0
    assert len(env.commands) == 61
    assert len(records_of(tmp_path)) == 59
    assert SAC.load(tmp_path / "model.zip").num_timesteps <= 59
    assert {*vars(model)} - before <= {"start_time", "_logger"}, "nothing is left on the model that hides its own methods"


class KillLearner(BaseCallback):
    """Do something to the learner's process after a step."""

    def __init__(self, at, signum):
        super().__init__()
        self.at, self.signum = at, signum
        self.is_done = False

    def _on_step(self):
        if not self.is_done and self.num_timesteps >= self.at:
            (learner,) = multiprocessing.active_children()
            os.kill(learner.pid, self.signum)
            if self.signum == signal.SIGKILL:
                learner.join()  # which may take its time on a machine that is busy
            self.is_done = True
            self.n_commands = len(self.training_env.get_attr("commands")[0])
        return True


@pytest.mark.parametrize("algorithm", [SAC, CTCO, FiGARSAC])
def test_killed_learner_is_reported_and_the_machine_made_safe(tmp_path, algorithm):
    env = Point()

    def safe_stop(machine):
        assert machine is env
        machine.commands.append("safe")

    model = make_model(algorithm, env)
    killer = KillLearner(60, signal.SIGKILL)
    with AsynchronousTrainer(model, env, tmp_path, safe_stop=safe_stop) as trainer:
        with pytest.raises(LearnerError, match="killed by signal SIGKILL"):
            trainer.learn(1000, killer)
        assert env.commands.index("safe") == len(env.commands) - 1 <= killer.n_commands + 1, "within a step"
        n = len(records_of(tmp_path))
    # Nothing that was collected is lost: a new learner begins with all of it.
    env.commands.clear()
    model = make_model(algorithm, env)
    with AsynchronousTrainer(model, env, tmp_path, resume=True) as trainer:
        assert model.num_timesteps >= 55
        trainer.learn(model.num_timesteps + 20)
        trainer.restore_replay_buffer()
        assert model.replay_buffer.size() > n


class Undivided(SAC):
    """A learner that fails."""

    def train(self, gradient_steps, batch_size=64):
        raise ZeroDivisionError("no way to learn from this")


def test_failing_learner_is_reported_with_its_traceback(tmp_path):
    env = Point()
    model = make_model(Undivided, env)
    with AsynchronousTrainer(model, env, tmp_path) as trainer, pytest.raises(LearnerError, match="no way to learn"):
        trainer.learn(10**6)
    assert env.commands[-1] == 0.0
    assert len(env.commands) > 40
    assert (tmp_path / "model.zip").exists()


@pytest.mark.parametrize(
    ("signum", "to_group"),
    [(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGTERM, True), (signal.SIGHUP, True)],
    ids=str,
)
def test_ctrl_c_stops_both_within_a_second_and_saves(tmp_path, signum, to_group):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import multiprocessing, signal, sys, time
            sys.path.insert(0, {os.path.dirname(__file__)!r})
            from test_asynchronous import Point, make_model
            from sb3_ctco import CTCO
            from sb3_ctco.realtime import AsynchronousTrainer

            class Timed(Point):
                def step(self, action):
                    self.when = time.monotonic()
                    return super().step(action)

            if __name__ == "__main__":
                # Shells let what they start in the background ignore Ctrl-C, and tests may run there.
                signal.signal(signal.SIGINT, signal.default_int_handler)
                signal.signal(signal.SIGHUP, signal.SIG_DFL)
                env = Timed()
                trainer = AsynchronousTrainer(make_model(CTCO, env), env, {str(tmp_path / "run")!r}, learner_niceness=0)
                def report(a, b):
                    print("acting", multiprocessing.active_children()[0].pid, flush=True)
                    return True
                try:
                    trainer.learn(10**6, report)
                except (KeyboardInterrupt, SystemExit) as stop:
                    print(type(stop).__name__, env.commands[-1], env.when, flush=True)
            """
        )
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, start_new_session=True, env={**os.environ}
    )
    for _ in range(100):
        word, learner = process.stdout.readline().split()
        assert word == "acting"
    # As a terminal, or what ends a service, does: to every process of the group.
    sent = time.monotonic()
    if to_group:
        os.killpg(process.pid, signum)
    else:
        process.send_signal(signum)
    rest, _ = process.communicate(timeout=PATIENCE)
    name, command, when = rest.strip().splitlines()[-1].split()
    assert name == ("KeyboardInterrupt" if signum == signal.SIGINT else "SystemExit")
    assert float(command) == 0.0
    assert float(when) - sent < 1.0, "the machine is stopped"
    saved = CTCO.load(tmp_path / "run" / "model.zip")
    assert saved._n_updates > 0
    assert len(records_of(tmp_path / "run")) > 1
    with pytest.raises(ProcessLookupError):
        os.kill(int(learner), 0)


class Stall(BaseCallback):
    """Stop the learner's process at a step, and let it go on at another one."""

    def __init__(self, first, last):
        super().__init__()
        self.first, self.last = first, last

    def _on_step(self):
        if self.n_calls == self.first:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGSTOP)
        if self.n_calls == self.last:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGCONT)
        return True


def test_acting_goes_on_while_the_learner_stands_still(tmp_path):
    env = Point()
    model = make_model(SAC, env)
    with AsynchronousTrainer(model, env, tmp_path) as trainer:
        # To the learner's stop, 60 steps of 0.02 s on without a wait for anybody, and until new weights have come.
        goes_on = ConvertCallback(lambda *_: len(env.commands) < 200 or trainer.weight_ages[-1] > 1.0)
        trainer.learn(10**6, [Stall(100, 160), goes_on])
        ages = list(trainer.weight_ages)
    assert max(ages[99:161]) > 1.0, "with the weights that there were"
    n_steps = model.num_timesteps - 1  # As in Stable-Baselines3 a step by which a callback ends learning is not kept.
    records = records_of(tmp_path)
    assert len(records) == n_steps
    assert env.commands[:-2] == [pytest.approx(float(record.action[0, 0])) for record in records], "each one is kept"
    assert SAC.load(tmp_path / "model.zip").num_timesteps == n_steps, "and learned from"


def test_a_learner_that_stands_still_at_the_end_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer_module, "_STOP_SECONDS", 0.5)
    env = Point()
    with (
        AsynchronousTrainer(make_model(SAC, env), env, tmp_path) as trainer,
        pytest.raises(LearnerError, match="did not stop within 0 s and was killed"),
    ):
        trainer.learn(80, KillLearner(60, signal.SIGSTOP))
    assert env.commands[-1] == 0.0
    assert len(env.commands) == 81
    assert len(records_of(tmp_path)) == 80
    assert not multiprocessing.active_children()


class Blocking(Point):
    """One step takes 70 ms."""

    def __init__(self):
        super().__init__()
        self.times = []

    def step(self, action):
        self.times.append(time.monotonic())
        if len(self.times) == 30:
            time.sleep(0.07)
        return super().step(action)


def test_an_environment_that_blocks_is_late_once_and_nothing_is_made_up_for(tmp_path, caplog):
    env = Blocking()
    with (
        caplog.at_level(logging.WARNING, logger="sb3_ctco.wrappers.real_time"),
        AsynchronousTrainer(make_model(SAC, env), env, tmp_path) as trainer,
    ):
        trainer.learn(49)
        statistics = trainer.real_time.total_statistics
    assert statistics.late_ticks >= 1
    assert statistics.worst_lateness > 0.045
    assert "ticks were late by more than 1.0 ms" in caplog.text
    # The command after it comes at once, and the next one a period later.
    gaps = np.diff(env.times)
    assert gaps[29] > 0.069
    assert gaps[30] > 0.015
    assert len(records_of(tmp_path)) == 49


class FillDisk(BaseCallback):
    """From a step on, files of this process take no more bytes."""

    def __init__(self, at, folder):
        super().__init__()
        self.at, self.folder = at, folder

    def _on_step(self):
        if self.n_calls == self.at:
            (path,) = (self.folder / "journal").glob("*.journal")
            hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, hard))
        return True


def test_a_full_disk_stops_the_machine_and_keeps_what_was_written(tmp_path):
    env = Point()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with (
            AsynchronousTrainer(make_model(SAC, env), env, tmp_path) as trainer,
            pytest.raises(OSError, match=r"experience cannot be written to .*File too large"),
        ):
            trainer.learn(1000, FillDisk(60, tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert env.commands[-1] == 0.0
    n = len(records_of(tmp_path))
    assert 55 <= n <= 61
    assert (tmp_path / "model.zip").exists()
    model = make_model(SAC, env)
    with AsynchronousTrainer(model, env, tmp_path, resume=True) as trainer:
        assert model.num_timesteps == n
        trainer.learn(n + 10)
    assert len(records_of(tmp_path)) == n + 10


class Unsaveable(SAC):
    """Its checkpoints find no room, but the first file does."""

    def save(self, path, **kwargs):
        if "unfinished" in str(path):
            path.write_bytes(b"a part")
            raise OSError(28, "No space left on device", str(path))
        super().save(path, **kwargs)


def test_a_learner_without_room_for_its_checkpoint_is_reported(tmp_path):
    env = Point()
    trainer = AsynchronousTrainer(make_model(Unsaveable, env), env, tmp_path, checkpoint_seconds=0.2)
    (tmp_path / "model.zip").write_bytes(b"the one before")
    with trainer, pytest.raises(LearnerError, match="No space left on device"):
        trainer.learn(1000)
    assert env.commands[-1] == 0.0
    assert (tmp_path / "model.zip").read_bytes() == b"the one before"
    assert not (tmp_path / "model.unfinished.zip").exists()


def test_a_folder_that_cannot_be_written_to_is_refused_before_anything_moves(tmp_path):
    env = Point()
    (tmp_path / "file").touch()
    read_only = tmp_path / "read_only"
    read_only.mkdir(mode=0o500)
    # Root may write anywhere but to what is no real file system.
    for folder in (tmp_path / "file" / "run", tmp_path / "file", Path("/proc/run") if os.geteuid() == 0 else read_only):
        with pytest.raises(OSError, match=f"cannot be kept in {folder}.*that can be written to"):
            AsynchronousTrainer(make_model(SAC, env), env, folder)
    assert env.commands == []


def test_kill_9_of_acting_leaves_nothing_in_the_system_and_all_in_the_folder(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import multiprocessing, sys
            sys.path.insert(0, {os.path.dirname(__file__)!r})
            from test_asynchronous import Point, make_model
            from sb3_ctco import CTCO
            from sb3_ctco.realtime import AsynchronousTrainer
            if __name__ == "__main__":
                env = Point()
                trainer = AsynchronousTrainer(make_model(CTCO, env, n_sub_options=0), env, {str(tmp_path / "run")!r})
                def report(a, b):
                    print("acting", multiprocessing.active_children()[0].pid, flush=True)
                    return True
                trainer.learn(10**6, report)
            """
        )
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    for _ in range(200):
        learner = int(process.stdout.readline().split()[1])
    mapped = {
        line.split(maxsplit=5)[5].strip()
        for pid in (process.pid, learner)
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines()
        if "/dev/shm" in line
    }
    # Memory without a name goes with the last process that has it; a semaphore would have one.
    assert all(name.endswith("(deleted)") for name in mapped)
    process.kill()
    process.wait()
    with lock(tmp_path / "run", PATIENCE, "learner.lock") as has_ended:
        assert has_ended, "the learner saves and ends"
    assert CTCO.load(tmp_path / "run" / "model.zip")._n_updates > 0
    env = Point()
    model = make_model(CTCO, env, n_sub_options=0)
    AsynchronousTrainer(model, env, tmp_path / "run", resume=True)
    assert model.num_timesteps >= 150, "what is in flight may be lost, which is one option of at most 50 steps"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"updates_per_second": 0}, "updates_per_second must be a positive number or None, not 0"),
        ({"updates_per_second": math.nan}, "updates_per_second must be a positive number or None, not nan"),
        ({"updates_per_second": math.inf}, "updates_per_second must be a positive number or None, not inf"),
        ({"updates_per_second": "20"}, "updates_per_second must be a positive number or None, not '20'"),
        ({"learner_threads": 0}, "learner_threads must be a whole number from 1 or None, not 0"),
        ({"learner_threads": 1.5}, "learner_threads must be a whole number from 1 or None, not 1.5"),
        ({"learner_niceness": -1}, "learner_niceness must be a whole number from 0 to 19, not -1"),
        ({"learner_niceness": 20}, "learner_niceness must be a whole number from 0 to 19, not 20"),
        ({"learner_niceness": 1.5}, "learner_niceness must be a whole number from 0 to 19, not 1.5"),
        ({"learner_niceness": True}, "learner_niceness must be a whole number from 0 to 19, not True"),
        ({"learner_niceness": None}, "learner_niceness must be a whole number from 0 to 19, not None"),
        ({"acting_priority": 100}, "acting_priority must be None or, on Linux, a whole number from 1 to 99, not 100"),
        ({"checkpoint_seconds": -1}, "checkpoint_seconds must be a positive number of seconds, not -1"),
        ({"checkpoint_seconds": 0.0}, "checkpoint_seconds must be a positive number of seconds, not 0.0"),
        ({"checkpoint_seconds": math.nan}, "checkpoint_seconds must be a positive number of seconds, not nan"),
        ({"decide_ahead": -0.1}, "decide_ahead must be a finite number of seconds from 0, not -0.1"),
        ({"decide_ahead": math.nan}, "decide_ahead must be a finite number of seconds from 0, not nan"),
        ({"decide_ahead": math.inf}, "decide_ahead must be a finite number of seconds from 0, not inf"),
        ({"decide_ahead": 1.0}, r"decide_ahead must be at least 0 s and less than d_max=1.0 s, not 1.0"),
        ({"safe_stop": None}, "safe_stop must be a function of the bare environment, not None"),
        ({"safe_stop": 0.0}, "safe_stop must be a function of the bare environment, not 0.0"),
        ({"interrupt": 0.1}, "interrupt must be a function or None, not 0.1"),
        ({"learner_device": "abacus"}, "learner_device='abacus' is no device of torch"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_made(tmp_path, arguments, message):
    env = Point()
    with pytest.raises((ValueError, TypeError), match=message):
        AsynchronousTrainer(make_model(CTCO, env, d_max=1.0), env, tmp_path / "run", **arguments)
    assert env.commands == []
    assert not (tmp_path / "run" / "journal").exists()


@pytest.mark.parametrize("total_timesteps", [-1, 1.5, math.nan, None, True])
def test_a_total_that_is_no_number_of_steps_is_refused(tmp_path, total_timesteps):
    env = Point()
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path)
    with pytest.raises(ValueError, match=f"total_timesteps must be a whole number of steps from 0, not {total_timesteps}"):
        trainer.learn(total_timesteps)
    assert trainer.learn(0) is trainer.model
    assert not (tmp_path / "journal").exists()


def test_statistics_of_decisions_do_not_grow_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer_module, "_MAX_KEPT", 30)
    env = Point()
    with AsynchronousTrainer(make_model(SAC, env), env, tmp_path, real_time=False) as trainer:
        trainer.learn(40)
    assert len(trainer.decision_seconds) == len(trainer.weight_ages) == 30


def test_refusals(tmp_path):
    env = Point()
    with pytest.raises(ValueError, match="off-policy algorithm such as CTCO or SAC, not PPO"):
        AsynchronousTrainer(PPO("MlpPolicy", env, device="cpu"), env, tmp_path)
    model = make_model(SAC, env)
    with pytest.raises(ValueError, match="pass one bare Gymnasium environment"):
        AsynchronousTrainer(model, OptionExecutionWrapper(env), tmp_path)
    with pytest.raises(ValueError, match="pass one bare Gymnasium environment"):
        AsynchronousTrainer(model, model.get_env(), tmp_path)
    with pytest.raises(ValueError, match="options, which SAC is not"):
        AsynchronousTrainer(model, env, tmp_path, decide_ahead=0.1)


# Options decided ahead, and interrupted


def play(env, options):
    """The transitions of an episode under scripted options."""
    env.reset(seed=0)
    return [env.step(np.array(option)) for option in options]


# With n_rbf = 1 an option is [action, duration]; durations run from 0.02 s (−1) to 0.2 s (1).
OPTIONS = [(0.5, 1.0), (-0.5, 1.0), (0.25, -1.0), (1.0, 0.0)]
LENGTHS = [10, 10, 1, 6]
SETTINGS = {"n_rbf": 1, "d_max": 0.2, "duration_scale": "linear"}


@pytest.mark.parametrize("background", [False, True])
def test_deciding_ahead_plays_the_same_commands_and_counts_each_once(background):
    plain = OptionExecutionWrapper(Point(), **SETTINGS)
    play(plain, OPTIONS)
    ahead = RealTimeOptionWrapper(Point(), decide_ahead=0.06, background=background, **SETTINGS)
    transitions = play(ahead, OPTIONS)
    # 10 − 3; the rest of 3 and 10 − 3; the rest of 3 alone; the one of 1 and 6 − 3
    assert [t[4]["option"]["n_steps"] for t in transitions] == [7, 10, 3, 4]
    times = [float(t[0][1]) for t in transitions]
    np.testing.assert_allclose(times, [0.14, 0.34, 0.4, 0.48], atol=1e-6)
    for transition in transitions:
        option = transition[4]["option"]
        assert option["duration"] == pytest.approx(option["n_steps"] * 0.02)
    ahead.abandon()
    commands = ahead.unwrapped.commands
    np.testing.assert_allclose(commands[:24], plain.unwrapped.commands[:24])
    # The rewards of the steps that ran, each in one transition
    assert len(commands) >= 24
    x = np.cumsum(np.array(commands[:24]) * 0.02)
    rewards = -np.abs(x - 0.3)
    expected = np.split(rewards, np.cumsum([7, 10, 3]))
    np.testing.assert_allclose([t[1] for t in transitions], [e.sum() for e in expected], atol=1e-6)
    with pytest.raises(ResetNeeded):
        ahead.step(np.zeros(2))
    ahead.close()


def test_without_decide_ahead_nothing_differs():
    plain = play(OptionExecutionWrapper(Point(), **SETTINGS), OPTIONS)
    same = play(RealTimeOptionWrapper(Point(), **SETTINGS), OPTIONS)
    for one, other in zip(plain, same, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
        assert one[4]["option"] == other[4]["option"]
    assert [t[4]["option"]["n_steps"] for t in plain] == LENGTHS


def test_the_rest_of_an_option_may_end_the_episode():
    env = RealTimeOptionWrapper(Point(), decide_ahead=0.1, **SETTINGS)
    env.reset(seed=0)
    lengths, truncated = [], False
    while not truncated:
        _, _, _, truncated, info = env.step(np.array([0.1, 1.0]))
        lengths.append(info["option"]["n_steps"])
    assert lengths == [5, 10, 10, 10, 10, 5]
    with pytest.raises(ResetNeeded):
        env.step(np.array([0.1, 1.0]))
    env.reset()
    assert env.step(np.array([0.1, 1.0]))[4]["option"]["n_steps"] == 5, "an episode begins without a rest"


def test_interruption_ends_an_option_with_the_time_that_ran():
    calls = []

    def interrupt(decided_on, obs, seconds):
        calls.append((float(decided_on[0]), float(obs[0]), seconds))
        return abs(obs[0] - decided_on[0]) > 0.05

    env = RealTimeOptionWrapper(Point(), interrupt=interrupt, **SETTINGS)
    env.reset(seed=0)
    # 0.02 m a step at full speed: the third step passes 0.05 m.
    obs, _, _, _, info = env.step(np.array([1.0, 1.0]))
    assert info["option"]["n_steps"] == 3
    assert info["option"]["duration"] == pytest.approx(0.06)
    assert info["interrupted"]
    np.testing.assert_allclose(obs, [0.06, 0.06], atol=1e-6)
    np.testing.assert_allclose(calls, [(0, 0.02, 0.02), (0, 0.04, 0.04), (0, 0.06, 0.06)], atol=1e-6)
    # The next one is measured from where it was decided on.
    assert env.step(np.array([1.0, 1.0]))[4]["option"]["n_steps"] == 3
    info = env.step(np.array([0.1, 1.0]))[4]
    assert info["option"]["n_steps"] == 10
    assert "interrupted" not in info


def test_an_interrupted_option_has_no_rest():
    env = RealTimeOptionWrapper(Point(), decide_ahead=0.06, interrupt=lambda before, obs, seconds: obs[0] > 0.09, **SETTINGS)
    transitions = play(env, [(1.0, 1.0), (-1.0, 1.0)])
    assert [t[4]["option"]["n_steps"] for t in transitions] == [5, 7]
    assert env.unwrapped.commands[:6] == [1.0] * 5 + [-1.0]


def test_decide_ahead_in_real_time(tmp_path):
    env = Point()
    model = make_model(CTCO, env, n_rbf=1, d_max=0.2, d_min=0.1)
    with AsynchronousTrainer(model, env, tmp_path, decide_ahead=0.04) as trainer:
        trainer.learn(200)
    assert env.commands[-1] == 0.0
    records = records_of(tmp_path)
    assert records[-1].num_timesteps == model.num_timesteps
    # The first decision of an episode is 0.04 s short of its option; the next ones come when an option's time has run.
    assert {len(r.infos) for r in records} == {1}
    steps = [r.infos[0]["option"]["n_steps"] for r in records]
    assert sum(steps) == model.num_timesteps
    assert 3 <= steps[0] <= 8


@pytest.mark.parametrize("decide_ahead", [-0.1, 0.2])
def test_decide_ahead_out_of_range(decide_ahead):
    with pytest.raises(ValueError, match=f"less than d_max=0.2 s, not {decide_ahead}"):
        RealTimeOptionWrapper(Point(), decide_ahead=decide_ahead, d_max=0.2)


def test_acting_priority_is_in_force_while_acting(tmp_path):
    if not hasattr(os, "sched_setscheduler"):
        pytest.skip("this operating system has no real-time scheduler to ask for")
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("this user may not ask for the real-time scheduler")
    os.sched_setscheduler(0, before, os.sched_param(0))
    env = Point()
    model = make_model(SAC, env)
    seen = set()

    def watch(local_variables, global_variables):
        seen.add((os.sched_getscheduler(0) & os.SCHED_FIFO, os.sched_getparam(0).sched_priority))
        return True

    with AsynchronousTrainer(model, env, tmp_path, acting_priority=7) as trainer:
        trainer.learn(20, watch)
    assert seen == {(os.SCHED_FIFO, 7)}
    assert os.sched_getscheduler(0) == before
    with pytest.raises(ValueError, match="from 1 to 99, not 0"):
        AsynchronousTrainer(model, env, tmp_path / "other", acting_priority=0)


def lead(obs):
    """Somebody who leads the point to where it is paid for, in the second half of each episode."""
    return [np.clip(2.0 * (0.3 - obs[0]), -1.0, 1.0)] if obs[1] >= 0.5 else None


def test_demonstrations_and_what_is_taken_over_reach_the_learner(tmp_path):
    env = Point()
    model = make_model(CTCO, env, d_max=0.2)
    with AsynchronousTrainer(model, env, tmp_path, real_time=False, updates_per_second=500, take_over=lead) as trainer:
        observations = np.stack([0.3 * np.ones(31), 0.02 * np.arange(31)], axis=1).astype(np.float32)
        with pytest.raises(ValueError, match="n actions, n rewards"):
            trainer.add_trajectory(observations, np.zeros((20, 1)), np.zeros(20), True, False, 0.02)
        added = trainer.add_trajectory(observations, np.zeros((30, 1)), np.zeros(30), False, True, 0.02)
        assert added.added > 20
        trainer.learn(150)
        assert model.replay_buffer.n_demonstrations == 0
        trainer.restore_replay_buffer()
        with pytest.raises(ValueError, match="add_trajectory of AsynchronousTrainer"):
            AsynchronousTrainer(model, env, tmp_path / "other")
    buffer = model.replay_buffer
    # What it was shown, and the second halves of three episodes of 50 steps
    assert added.added + 3 * 20 < buffer.n_demonstrations < added.added + 3 * 25 + 1
    rows = slice(buffer.buffer_size - buffer.n_demonstrations, None)
    led = buffer.observations[rows, 0]
    assert ((led[:, 0] == np.float32(0.3)) | (led[:, 1] >= 0.5)).all()
    # The policy's own are the first halves, each up to where somebody took over
    assert (buffer.observations[: buffer.pos, 0, 1] < 0.5).all()
    assert buffer.next_observations[: buffer.pos, 0, 1].max() == pytest.approx(0.5)

    again = make_model(CTCO, env, d_max=0.2)
    with AsynchronousTrainer(again, env, tmp_path, resume=True, real_time=False, take_over=lead) as trainer:
        trainer.restore_replay_buffer()
    assert abs(again.replay_buffer.n_demonstrations - buffer.n_demonstrations) < 10


def test_take_over_is_for_options(tmp_path):
    env = Point()
    with pytest.raises(ValueError, match="take_over are for algorithms with options, which SAC is not"):
        AsynchronousTrainer(make_model(SAC, env), env, tmp_path, take_over=lead)
    with pytest.raises(TypeError, match="take_over must be a function or None, not 3"):
        AsynchronousTrainer(make_model(CTCO, env), env, tmp_path, take_over=3)


class Machine(Point):
    """The same as a machine that takes commands and is read later."""

    def send(self, action):
        self.commands.append(float(action[0]))

    def receive(self):
        self.x += self.dt * self.commands[-1]
        self.steps += 1
        return self._obs(), -abs(self.x - 0.3), False, False, {}

    def step(self, action):
        raise AssertionError("a machine is commanded by send and read by receive")


@pytest.mark.parametrize("algorithm", [SAC, CTCO])
def test_a_machine_without_a_learner_is_held_until_its_option_is_broken_off(tmp_path, algorithm, caplog):
    class KillLearner(BaseCallback):
        def _on_step(self):
            if self.n_calls == 20:
                multiprocessing.active_children()[0].kill()
            return True

    machine = Machine()
    safety = Safety(stale_after=math.inf, safe_action=lambda sent: [0.125], max_rate=None, max_slew=None)
    env = gym.wrappers.TimeLimit(RealTimeWrapper(machine, safety=safety), 1000)
    model = make_model(algorithm, env)
    trainer = AsynchronousTrainer(model, env, tmp_path)
    with trainer, pytest.raises(LearnerError, match="killed by signal SIGKILL"):
        trainer.learn(5000, KillLearner())
    assert machine.commands[-2:] == [0.125, 0.125]  # the safe action, and then the safe stop, which is the same
    assert trainer.real_time.total_statistics.safe_ticks == 1
    assert "the safe action is sent (the learner was killed by signal SIGKILL)" in caplog.text


def test_a_policy_that_diverges_stops_nothing(tmp_path):
    machine = Machine()
    env = gym.wrappers.TimeLimit(machine, 30)  # the period is held inside
    model = make_model(CTCO, env, d_max=0.1)
    model.learning_starts = 0
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.fill_(th.nan)
    trainer = AsynchronousTrainer(model, env, tmp_path)
    trainer._settings["updates_per_second"] = 1e-3
    with trainer:
        trainer.learn(40)
    assert trainer.real_time.env is machine
    assert trainer.real_time.total_statistics.safe_ticks == 40
    assert set(machine.commands) == {0.0}
    assert records_of(tmp_path) == []


@pytest.mark.parametrize("given", ["auto", 1.0])
def test_the_unit_that_critics_learned_in_is_resumed(given, tmp_path):
    """Another unit, found anew in what the journal has left, would be that of other critics."""
    model = make_model(CTCO, Point(), buffer_size=500, replay_buffer_kwargs={"reward_scale": "auto"}).learn(60)
    unit = model.replay_buffer.reward_scale
    assert unit not in ("auto", 1.0)
    model.save(tmp_path / "model.zip")
    again = make_model(CTCO, Point(), buffer_size=500, replay_buffer_kwargs={"reward_scale": given})
    if given == "auto":
        AsynchronousTrainer(again, Point(), tmp_path, resume=True, real_time=False)
        assert again.replay_buffer.reward_scale == again.replay_buffer_kwargs["reward_scale"] == unit
    else:
        with pytest.raises(
            ValueError, match=r"reward_scale=1.0 cannot be changed .* learned with reward_scale=.*: pass the arguments of"
        ):
            AsynchronousTrainer(again, Point(), tmp_path, resume=True, real_time=False)


def test_a_model_of_normalised_observations_is_refused(tmp_path):
    model = make_model(SAC, VecNormalize(DummyVecEnv([Point]), norm_reward=False))
    with pytest.raises(ValueError, match=r"sees observations through VecNormalize.*NormalizeObservation"):
        AsynchronousTrainer(model, Point(), tmp_path, real_time=False)


def test_discrete_actions_are_refused(tmp_path):
    model = make_model(DQN, "CartPole-v1", buffer_size=100)
    with pytest.raises(ValueError, match=r"needs continuous actions, not Discrete\(2\)"):
        AsynchronousTrainer(model, gym.make("CartPole-v1"), tmp_path, real_time=False)


def test_the_safe_stop_is_sent_when_what_was_taken_over_cannot_be_recorded(tmp_path):
    stopped = []
    env = Point()
    trainer = AsynchronousTrainer(
        make_model(CTCO, env, buffer_size=100),
        env,
        tmp_path,
        real_time=False,
        take_over=lambda obs: [0.9] if round(obs[1] / env.dt) % 4 < 2 else None,
        safe_stop=stopped.append,
    )
    # What learn does, without the learner's process
    trainer._demonstrations = JournalWriter(tmp_path / "demonstrations", trainer_module._meaning(trainer.model))
    trainer._demonstrations._error = OSError(28, "No space left on device")  # as the writer's thread leaves it
    model = trainer.model
    model.env.reset()
    with pytest.raises(OSError, match="No space left"):
        for _ in range(10):
            model.env.step(np.zeros((1, *model.action_space.shape), np.float32))
    trainer._make_safe()
    assert stopped == [env]


def test_what_is_learned_from_twice_begins_with_a_reset_and_has_the_learners_price(tmp_path):
    env = gym.make("Pendulum-v1")
    model = make_model(CTCO, env, buffer_size=1000)
    with AsynchronousTrainer(model, env, tmp_path, real_time=False) as trainer:
        trainer.learn(10**6, UntilLearned(pause=0.002))
        assert model._current_high_freq_penalty() == CTCO.load(tmp_path / "model.zip")._current_high_freq_penalty() > 0
        n_steps = model.num_timesteps
        trainer.learn(n_steps + 100)
    assert model.num_timesteps >= n_steps + 100


def test_a_learner_that_died_does_not_stop_the_next(tmp_path):
    env = Machine()
    wrapped = gym.wrappers.TimeLimit(env, 400)
    model = make_model(SAC, wrapped, buffer_size=1000)
    with AsynchronousTrainer(model, wrapped, tmp_path) as trainer, pytest.raises(LearnerError):
        trainer.learn(200, KillLearner(60, signal.SIGKILL))
    n_sent = len(env.commands)
    with AsynchronousTrainer(make_model(SAC, wrapped, buffer_size=1000), wrapped, tmp_path, resume=True) as trainer:
        trainer.learn(trainer.model.num_timesteps + 60)
    assert len({command for command in env.commands[n_sent:] if command != 0.0}) > 20


@pytest.mark.parametrize("take_over", [None, lambda obs: None])
def test_the_clock_the_options_and_what_is_recorded_have_one_period(take_over, tmp_path):
    env = Point()
    del env.dt
    clock = RealTimeWrapper(env, dt=0.05)
    model = make_model(CTCO, clock, buffer_size=100)
    assert model.dt == 0.05
    trainer = AsynchronousTrainer(model, clock, tmp_path / "clock", take_over=take_over)
    assert trainer.real_time is clock
    trainer = AsynchronousTrainer(
        make_model(CTCO, Point(), dt=0.05, buffer_size=100), Point(), tmp_path / "given", take_over=take_over
    )
    assert trainer.real_time.dt == trainer.model.env.get_attr("option_space")[0].dt == 0.05
    assert take_over is None or trainer._take_over.dt == 0.05
    with pytest.raises(ValueError, match=r"RealTimeWrapper has dt=0.05, the model has dt=0.02: give both the same"):
        AsynchronousTrainer(make_model(CTCO, Point(), dt=0.02, buffer_size=100), clock, tmp_path / "other")


def test_demonstrations_of_an_earlier_run_are_an_earlier_run(tmp_path):
    model = make_model(CTCO, "Pendulum-v1", buffer_size=1000)
    trainer = AsynchronousTrainer(model, gym.make("Pendulum-v1"), tmp_path, real_time=False)
    trainer.add_trajectory(np.zeros((31, 3), np.float32), np.zeros((30, 1)), np.zeros(30), False, True, 0.05)
    with pytest.raises(FileExistsError, match="holds the experience of an earlier run: pass resume=True"):
        AsynchronousTrainer(model, gym.make("Pendulum-v1"), tmp_path, real_time=False)


def test_a_reset_that_is_interrupted_leaves_the_machine_safe(tmp_path):
    class Arm(Point):
        def reset(self, *, seed=None, options=None):
            raise KeyboardInterrupt

        def send(self, action):
            raise NotImplementedError

        def receive(self):
            raise NotImplementedError

    stopped, env = [], Arm()
    trainer = AsynchronousTrainer(make_model(CTCO, env, buffer_size=100), env, tmp_path / "one", safe_stop=stopped.append)
    with pytest.raises(KeyboardInterrupt):
        trainer.learn(10)
    assert stopped == [env]
    # What a reset failed by is what is raised, also if it cannot be stopped: send raises NotImplementedError here.
    trainer = AsynchronousTrainer(make_model(CTCO, env, buffer_size=100), env, tmp_path / "two")
    with pytest.raises(KeyboardInterrupt):
        trainer.learn(10)


def test_one_trainer_at_a_time_uses_a_folder(collected, monkeypatch):
    folder, steps = collected
    env = Point()
    trainer = AsynchronousTrainer(make_model(CTCO, env), env, folder, resume=True, real_time=False)
    with lock(folder):
        with pytest.raises(RuntimeError, match="another AsynchronousTrainer uses"):
            trainer.learn(steps + 20)
        with pytest.raises(RuntimeError, match="another AsynchronousTrainer uses"):
            AsynchronousTrainer(make_model(CTCO, env), env, folder, resume=True, real_time=False)
        with pytest.raises(RuntimeError, match="another AsynchronousTrainer uses"):
            trainer.add_trajectory(np.zeros((31, 2), np.float32), np.zeros((30, 1)), np.zeros(30), True, False, 0.02)
    # The learner of one that was killed
    monkeypatch.setattr(trainer_module, "_STOP_SECONDS", 0.2)
    with lock(folder, name="learner.lock"), pytest.raises(RuntimeError, match="another AsynchronousTrainer uses"):
        trainer.learn(steps + 20)


def test_learning_goes_on_from_all_that_was_learned_when_it_was_interrupted(tmp_path):
    env = Point()
    model = make_model(CTCO, env, buffer_size=500)
    first = model.actor.omega_head.weight.detach().clone()

    def interrupt(locals_, globals_):
        time.sleep(0.001)
        if not th.equal(model.actor.omega_head.weight, first):  # however long the learner takes on a machine that is busy
            raise KeyboardInterrupt
        return True

    with AsynchronousTrainer(model, env, tmp_path, real_time=False, updates_per_second=500) as trainer:
        with pytest.raises(KeyboardInterrupt):
            trainer.learn(10**9, interrupt)
        learned = CTCO.load(tmp_path / "model.zip")
        assert learned._n_updates > 0
        trainer.learn(model.num_timesteps + 10)
    start = CTCO.load(tmp_path / "start.zip")
    th.testing.assert_close(start.get_parameters(), learned.get_parameters(), rtol=0.0, atol=0.0)


def test_noise_that_is_a_function_of_the_state_is_refused(tmp_path):
    with pytest.raises(ValueError, match="use_sde=True is not supported"):
        AsynchronousTrainer(make_model(SAC, Point(), use_sde=True), Point(), tmp_path, real_time=False)


class SlowStop:
    """A safe stop that takes a while, in which signals come."""

    def __init__(self, *signals):
        self.signals, self.is_done = signals, False

    def __call__(self, env):
        for number in self.signals:
            os.kill(os.getpid(), number)
            time.sleep(0.05)
        env.commands.append(0.25)
        self.is_done = True


class SignalAt(BaseCallback):
    def __init__(self, number):
        super().__init__()
        self.number = number

    def _on_step(self):
        if self.n_calls == 20:
            os.kill(os.getpid(), self.number)
        return True


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_does_not_break_off_the_safe_stop(tmp_path, caplog, first, second):
    env, safe_stop = Point(), SlowStop(second)
    before = signal.getsignal(first), signal.getsignal(second)
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path, safe_stop=safe_stop)
    with trainer, pytest.raises(KeyboardInterrupt if first == signal.SIGINT else SystemExit):
        trainer.learn(5000, SignalAt(first))
    assert safe_stop.is_done
    assert env.commands[-1] == 0.25
    assert "the machine is being made safe; once more breaks that off" in caplog.text
    assert (signal.getsignal(first), signal.getsignal(second)) == before
    assert len(records_of(tmp_path)) > 10


class SignalsAt(BaseCallback):
    def __init__(self, *numbers):
        super().__init__()
        self.numbers = numbers

    def _on_step(self):
        if self.num_timesteps == 10:
            for number in self.numbers:
                os.kill(os.getpid(), number)
        return True


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None], ids=["ignored", "ends nothing"])
def test_an_interrupt_that_ends_nothing_is_not_the_first_signal(tmp_path, handler):
    signal.signal(signal.SIGINT, handler)
    env, safe_stop = Point(), SlowStop()
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path, safe_stop=safe_stop)
    with trainer, pytest.raises(SystemExit):
        trainer.learn(5000, SignalsAt(signal.SIGINT, signal.SIGTERM))
    assert safe_stop.is_done
    assert len(env.commands) < 100


def test_an_interrupt_that_would_end_the_process_makes_the_machine_safe(tmp_path):
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    env, safe_stop = Point(), SlowStop()
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path, safe_stop=safe_stop)
    with trainer, pytest.raises(KeyboardInterrupt):
        trainer.learn(5000, SignalAt(signal.SIGINT))
    assert safe_stop.is_done
    assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL


class BrokenSensor(Point):
    """Returns observations, or rewards, that are no numbers, from its 60th step on.

    One observation alone may be one that nothing is learned from: within an option, some are left out.
    """

    def __init__(self, obs=0.0, reward=0.0):
        super().__init__()
        self.fault = obs, reward

    def step(self, action):
        obs, reward, *rest = super().step(action)
        if len(self.commands) >= 60:
            obs, reward = obs + np.float32(self.fault[0]), reward + self.fault[1]
        return obs, reward, *rest


@pytest.mark.parametrize("fault", [{"obs": np.nan}, {"reward": np.inf}], ids=["observation", "reward"])
@pytest.mark.parametrize("algorithm", [SAC, CTCO])
def test_what_is_not_finite_is_not_learned_from(tmp_path, algorithm, fault):
    env = BrokenSensor(**fault)
    with AsynchronousTrainer(make_model(algorithm, env), env, tmp_path) as trainer, pytest.raises(ValueError, match="finite"):
        trainer.learn(1000)
    assert env.commands[-1] == 0.0
    env = Point()
    with AsynchronousTrainer(make_model(algorithm, env), env, tmp_path, resume=True) as trainer:
        trainer.learn(100)
    for transition in records_of(tmp_path):
        assert np.isfinite(transition.next_obs).all()
        assert np.isfinite(transition.reward).all()


class LateReport:
    """A pipe's end whose messages arrive just after somebody stopped waiting for them."""

    def __init__(self, *messages):
        self.messages, self.was_waited_for = list(messages), False

    def poll(self, timeout):
        if timeout > 0:
            self.was_waited_for = True
            return False
        return self.was_waited_for and bool(self.messages)

    def recv(self):
        return self.messages.pop(0)


@pytest.mark.parametrize("messages", [[("ready", None)], [("ready", None), ("log", {"a": 1.0})]])
def test_a_learner_that_is_ready_at_any_moment_is_heard(monkeypatch, messages):
    monkeypatch.setattr(trainer_module, "_START_SECONDS", 0.5)
    link = trainer_module._Link(SimpleNamespace(exitcode=None), LateReport(*messages), None, None)
    link.wait_until_ready()


def test_a_learner_that_never_is_ready(monkeypatch):
    monkeypatch.setattr(trainer_module, "_START_SECONDS", 0.05)
    link = trainer_module._Link(SimpleNamespace(exitcode=None), LateReport(), None, None)
    with pytest.raises(LearnerError, match="did not start"):
        link.wait_until_ready()


def test_a_folder_with_the_model_of_an_earlier_run_is_refused(tmp_path):
    env = Point()
    (tmp_path / "model.zip").write_bytes(b"the one before")
    with pytest.raises(FileExistsError, match="holds the experience of an earlier run: pass resume=True"):
        AsynchronousTrainer(make_model(SAC, env), env, tmp_path)


def test_learning_that_diverges_leaves_the_checkpoint_as_it_was(tmp_path):
    env = Point()
    with AsynchronousTrainer(make_model(CTCO, env), env, tmp_path) as trainer:
        trainer.learn(100)
    before = (tmp_path / "model.zip").read_bytes()
    model = make_model(CTCO, env, learning_rate=1e30)
    with (
        AsynchronousTrainer(model, env, tmp_path, resume=True) as trainer,
        pytest.raises(LearnerError, match="learning diverged"),
    ):
        trainer.learn(5000)
    assert (tmp_path / "model.zip").read_bytes() == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_machine_is_made_safe_at_the_end_is_not_lost(tmp_path, number):
    """Somebody who learns in a loop would move the machine again."""
    env, safe_stop = Point(), SlowStop(number)
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path, safe_stop=safe_stop)
    before = signal.getsignal(number)
    with trainer, pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit):
        trainer.learn(20)
    assert safe_stop.is_done
    assert signal.getsignal(number) == before
    assert len(records_of(tmp_path)) == 20


def test_the_end_of_a_terminal_is_left_to_who_handles_it(tmp_path):
    seen = []
    before = signal.signal(signal.SIGHUP, lambda number, frame: seen.append(number))
    try:
        with AsynchronousTrainer(make_model(SAC, Point()), Point(), tmp_path) as trainer:
            trainer.learn(40, SignalAt(signal.SIGHUP))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert seen == [signal.SIGHUP]
    assert trainer.model.num_timesteps == 40


def test_a_learner_that_is_killed_when_acting_has_ended_is_reported(tmp_path):
    def kill_learner(env):
        (learner,) = multiprocessing.active_children()
        learner.kill()
        learner.join()

    env = Point()
    model = make_model(SAC, env)
    trainer = AsynchronousTrainer(model, env, tmp_path, safe_stop=kill_learner)
    first = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    with trainer, pytest.raises(LearnerError, match="killed by signal SIGKILL"):
        trainer.learn(10**6, UntilLearned())
    # There is no checkpoint yet, and no actor beside critics that learned nothing.
    assert not (tmp_path / "model.zip").exists()
    assert all(th.equal(first[name], tensor) for name, tensor in model.policy.state_dict().items())


def test_a_folder_is_free_though_a_process_that_was_forked_meanwhile_lives_on(tmp_path):
    with lock(tmp_path) as is_ours:
        assert is_ours
        child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(PATIENCE,), daemon=True)
        child.start()
    with lock(tmp_path, patience=0.0) as is_ours:
        assert is_ours
    child.kill()
    child.join()


def test_two_learners_do_not_share_a_folder(tmp_path, monkeypatch):
    """One may be left of a trainer that was killed while its learner started."""
    monkeypatch.setattr(trainer_module, "_alone_in", lambda folder: contextlib.nullcontext())
    trainer = AsynchronousTrainer(make_model(SAC, Point()), Point(), tmp_path)
    with lock(tmp_path, name="learner.lock"), trainer, pytest.raises(LearnerError, match="another learner is at work in"):
        trainer.learn(20)
    assert not (tmp_path / "model.zip").exists()


def test_what_a_learner_said_before_its_end_is_heard():
    class Last:
        """Says it, and ends, between two looks at it."""

        exitcode = None

        def poll(self, timeout):
            if self.exitcode is None:
                self.exitcode = 1
                return False
            return bool(self.messages)

        def recv(self):
            return self.messages.pop()

        messages = [("failed", "there is no more memory")]

    last = Last()
    link = trainer_module._Link(last, last, None, None)
    link.check()
    with pytest.raises(LearnerError, match="no more memory"):
        link.check()


def test_a_third_signal_breaks_it_off(tmp_path):
    env, safe_stop = Point(), SlowStop(signal.SIGINT, signal.SIGINT)
    trainer = AsynchronousTrainer(make_model(SAC, env), env, tmp_path, safe_stop=safe_stop)
    with trainer, pytest.raises(KeyboardInterrupt):
        trainer.learn(5000, SignalAt(signal.SIGINT))
    assert not safe_stop.is_done


class SilentMachine(Machine):
    """Falls silent after some commands, until it is told to speak."""

    def __init__(self, silent_after):
        super().__init__()
        self.silent_after, self.speaks = silent_after, threading.Event()

    def receive(self):
        if len(self.commands) == self.silent_after:
            self.speaks.wait()
        return super().receive()


@pytest.mark.parametrize("decide_ahead", [0.0, 0.06])
def test_a_machine_that_says_nothing_is_stopped(tmp_path, monkeypatch, decide_ahead):
    """Also where it is waited for in the background, where no signal ends that."""
    monkeypatch.setattr(trainer_module, "_ABANDON_SECONDS", 0.2)
    machine, stopped = SilentMachine(silent_after=100), []
    env = gym.wrappers.TimeLimit(machine, 1000)
    model = make_model(CTCO, env, d_min=0.1, d_max=0.2)
    trainer = AsynchronousTrainer(
        model, env, tmp_path, safe_stop=lambda env: stopped.append(env.speaks.is_set()), decide_ahead=decide_ahead
    )
    end_of_a_hang = threading.Timer(PATIENCE, machine.speaks.set)
    end_of_a_hang.daemon = True
    end_of_a_hang.start()

    def interrupt():
        while len(machine.commands) < 100:
            time.sleep(0.01)
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            trainer.learn(5000)
        assert stopped == [False]  # before it spoke again
    finally:
        end_of_a_hang.cancel()
        machine.speaks.set()
    trainer.__exit__()


def test_a_machine_that_stays_silent_does_not_keep_python_from_ending():
    script = """
        import threading
        from concurrent.futures import Future
        from sb3_ctco.wrappers.real_time_options import _Player
        started = threading.Event()
        _Player().play(Future(), lambda: (started.set(), threading.Event().wait()))
        started.wait()
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=True, timeout=PATIENCE)


def test_who_abandons_does_not_wait_for_a_rest_that_never_began(monkeypatch):
    env = RealTimeOptionWrapper(Point(), decide_ahead=0.06, background=True, n_rbf=1, d_min=0.1, d_max=0.2)
    env.reset(seed=0)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(env._player, "play", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(env.action_space.sample())
    assert env.abandon(0.0)
    n_commands = len(env.unwrapped.commands)
    monkeypatch.undo()
    env.reset()
    env.step(env.action_space.sample())
    assert len(env.unwrapped.commands) > n_commands
    env.close()


def test_positions_that_are_held_stay_held(tmp_path):
    """Zero, the default where nothing is guarded, would be somewhere else."""
    machine = Machine()
    reset = machine.reset
    machine.reset = lambda **kwargs: (reset(**kwargs)[0], {"last_action": np.array([1.0], np.float32)})
    real_time = RealTimeWrapper(machine, safety=Safety(safe_action="hold", max_rate=0.5, max_slew=None))
    env = gym.wrappers.TimeLimit(real_time, 1000)
    with AsynchronousTrainer(make_model(SAC, env), env, tmp_path) as trainer:
        trainer.learn(30)
    # 0.5 widths of 2 a second are 0.02 a step.
    assert np.abs(np.diff([1.0, *machine.commands])).max() <= 0.02 + 1e-6
    assert machine.commands[-1] == pytest.approx(machine.commands[-2])


def test_after_an_error_the_model_is_what_the_learner_saved(tmp_path):
    """And not an actor that learned beside critics that did not."""
    env = Point()
    model = make_model(SAC, env)
    trainer = AsynchronousTrainer(model, env, tmp_path, updates_per_second=100)

    class PullTheCable(UntilLearned):
        def _on_step(self):
            if env.fail_at is None and not super()._on_step():
                env.fail_at = len(env.commands) + 5
            return True

    with trainer, pytest.raises(ConnectionError, match="the cable was pulled"):
        trainer.learn(10**6, PullTheCable())
    saved = SAC.load(tmp_path / "model.zip", device="cpu")
    assert saved._n_updates == model._n_updates > 0
    for name, value in saved.policy.state_dict().items():
        assert th.equal(value, model.policy.state_dict()[name]), name


def test_experience_is_restored_once(tmp_path):
    env = Point()
    with AsynchronousTrainer(make_model(SAC, env), env, tmp_path, real_time=False) as trainer:
        trainer.learn(60)
        trainer.restore_replay_buffer()
        size = trainer.model.replay_buffer.size()
        with pytest.raises(ValueError, match=f"holds {size} transitions already"):
            trainer.restore_replay_buffer()
        trainer.model.replay_buffer.reset()
        trainer.restore_replay_buffer()
        assert trainer.model.replay_buffer.size() == size
