"""Acting and learning in two processes: what is stored, what comes back, and how it ends."""

import itertools
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import PATIENCE
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_ctco import CTCO, FiGARSAC, OptionExecutionWrapper
from sb3_ctco.realtime import AsynchronousTrainer, JournalReader, JournalWriter, LearnerError
from sb3_ctco.realtime.weights import SharedWeights
from sb3_ctco.wrappers import RealTimeOptionWrapper


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


def records_of(folder):
    reader = JournalReader(folder / "journal")
    records = reader.read(10**6)
    reader.close()
    return records


def test_journal_keeps_what_was_written_and_drops_what_was_cut_off(tmp_path):
    path = tmp_path / "journal"
    writer = JournalWriter(path)
    records = [np.arange(k) for k in range(20)]
    for record in records:
        writer.add(record)
    writer.close()
    reader = JournalReader(path)
    assert [len(r) for r in reader.read(15)] == list(range(15))
    assert [len(r) for r in reader.read(15)] == [15, 16, 17, 18, 19]
    assert reader.read(15) == []
    with path.open("ab") as file:
        data = pickle.dumps("lost")
        file.write(len(data).to_bytes(8, "little") + data[:-3])
    assert reader.read(1) == [], "an unfinished record waits"
    writer = JournalWriter(path)
    writer.add("continued")
    writer.close()
    assert reader.read(15) == ["continued"]
    reader.close()


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
    with weights._lock:
        assert not weights.fetch(target), "a reader does not wait"
    assert weights.fetch(target)
    assert weights.version == 3
    assert 0 <= weights.age < 10


class Watcher(BaseCallback):
    """Counts its ticks and keeps the actor's weights."""

    def __init__(self):
        super().__init__()
        self.ticks = 0
        self.logged = set()

    def _on_step(self):
        self.ticks += 1
        self.logged.update(self.logger.name_to_value)
        return True


@pytest.mark.parametrize("algorithm", [SAC, CTCO, FiGARSAC])
def test_learns_elsewhere_and_everything_comes_back(tmp_path, algorithm):
    env = Point()
    model = make_model(algorithm, env)
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    watcher = Watcher()
    with AsynchronousTrainer(model, env, tmp_path, updates_per_second=50) as trainer:
        trainer.learn(250, [watcher, CheckpointCallback(100, str(tmp_path / "checkpoints"))])
        statistics = trainer.real_time.total_statistics
    assert statistics.ticks >= 245
    assert model.num_timesteps >= 250
    assert watcher.ticks == model.num_timesteps
    assert "asynchronous/updates_per_second" in watcher.logged
    assert "train/critic_loss" in watcher.logged
    assert 20 < model._n_updates < 50 * 250 * 0.02 + 50, "no more than the updates a second that were asked for"
    after = model.policy.state_dict()
    assert all(not th.equal(before[name], after[name]) for name in before if "critic" in name or "latent_pi" in name)
    learned = algorithm.load(tmp_path / "model.zip")
    assert all(th.equal(after[name], tensor) for name, tensor in learned.policy.state_dict().items())
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2
    assert algorithm.load(next((tmp_path / "checkpoints").iterdir()), env=Point()).predict(np.zeros(2))[0].size

    # Every step that was made is in the journal, with the reward that it had.
    records = records_of(tmp_path)
    assert records[-1].num_timesteps == model.num_timesteps
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
        return True

    with AsynchronousTrainer(model, env, tmp_path) as trainer:
        trainer.learn(150, watch)
        assert len(trainer.decision_seconds) == len(trainer.weight_ages) == 150
    assert seen[20] == 0.0
    assert seen[-1] > 0.0
    assert len(set(seen)) > 5


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


def test_sub_options_are_in_the_learners_replay_buffer(tmp_path):
    arguments = {"n_sub_options": 4, "d_max": 0.5}
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
        trainer.learn(1000)
    assert env.commands[-1] == 0.0
    assert len(env.commands) == 61
    assert len(records_of(tmp_path)) == 59
    assert SAC.load(tmp_path / "model.zip").num_timesteps <= 59
    assert "train" not in model.__dict__


class KillLearner(BaseCallback):
    """Do something to the learner's process at a step."""

    def __init__(self, at, signum):
        super().__init__()
        self.at, self.signum = at, signum
        self.when = None

    def _on_step(self):
        if self.n_calls == self.at:
            os.kill(multiprocessing.active_children()[0].pid, self.signum)
            self.when = time.monotonic()
        return True


@pytest.mark.parametrize("algorithm", [SAC, CTCO, FiGARSAC])
def test_killed_learner_is_reported_and_the_machine_made_safe(tmp_path, algorithm):
    env = Point()
    stopped = []

    def safe_stop(machine):
        assert machine is env
        stopped.append(time.monotonic())
        machine.commands.append("safe")

    model = make_model(algorithm, env)
    killer = KillLearner(60, signal.SIGKILL)
    with AsynchronousTrainer(model, env, tmp_path, safe_stop=safe_stop) as trainer:
        with pytest.raises(LearnerError, match="killed by signal SIGKILL"):
            trainer.learn(1000, killer)
        assert stopped[0] - killer.when < 1.0
        assert env.commands[-1] == "safe"
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
        trainer.learn(1000)
    assert env.commands[-1] == 0.0
    assert 40 < len(env.commands) < 200
    assert (tmp_path / "model.zip").exists()


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_both_within_a_second_and_saves(tmp_path, signum):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import multiprocessing, signal, sys, time
            sys.path.insert(0, {os.path.dirname(__file__)!r})
            from test_asynchronous import Point, make_model
            from sb3_ctco import CTCO
            from sb3_ctco.realtime import AsynchronousTrainer
            if __name__ == "__main__":
                # Shells let what they start in the background ignore Ctrl-C, and tests may run there.
                signal.signal(signal.SIGINT, signal.default_int_handler)
                env = Point()
                trainer = AsynchronousTrainer(make_model(CTCO, env), env, {str(tmp_path / "run")!r}, learner_niceness=0)
                def report(a, b):
                    print("acting", multiprocessing.active_children()[0].pid, flush=True)
                    return True
                try:
                    trainer.learn(10**6, report)
                except (KeyboardInterrupt, SystemExit) as stop:
                    print(type(stop).__name__, env.commands[-1], time.monotonic(), flush=True)
            """
        )
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, start_new_session=True, env={**os.environ}
    )
    for _ in range(100):
        word, learner = process.stdout.readline().split()
        assert word == "acting"
    # As a terminal does: to every process of the group.
    sent = time.monotonic()
    if signum == signal.SIGINT:
        os.killpg(process.pid, signum)
    else:
        process.send_signal(signum)
    rest, _ = process.communicate(timeout=PATIENCE)
    name, command, when = rest.strip().splitlines()[-1].split()
    assert name == {signal.SIGINT: "KeyboardInterrupt", signal.SIGTERM: "SystemExit"}[signum]
    assert float(command) == 0.0
    assert float(when) - sent < 1.0
    saved = CTCO.load(tmp_path / "run" / "model.zip")
    assert saved._n_updates > 0
    assert len(records_of(tmp_path / "run")) > 1
    with pytest.raises(ProcessLookupError):
        os.kill(int(learner), 0)


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
    with pytest.raises(ValueError, match="updates_per_second must be positive or None, not 0"):
        AsynchronousTrainer(model, env, tmp_path, updates_per_second=0)


# Options decided ahead, and interrupted


def play(env, options):
    """The transitions of an episode under scripted options."""
    env.reset(seed=0)
    return [env.step(np.array(option)) for option in options]


# With n_rbf = 1 an option is [action, duration]; durations run from 0.02 s (−1) to 0.2 s (1).
OPTIONS = [(0.5, 1.0), (-0.5, 1.0), (0.25, -1.0), (1.0, 0.0)]
LENGTHS = [10, 10, 1, 6]


@pytest.mark.parametrize("background", [False, True])
def test_deciding_ahead_plays_the_same_commands_and_counts_each_once(background):
    plain = OptionExecutionWrapper(Point(), n_rbf=1, d_max=0.2)
    play(plain, OPTIONS)
    ahead = RealTimeOptionWrapper(Point(), decide_ahead=0.06, background=background, n_rbf=1, d_max=0.2)
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
    plain = play(OptionExecutionWrapper(Point(), n_rbf=1, d_max=0.2), OPTIONS)
    same = play(RealTimeOptionWrapper(Point(), n_rbf=1, d_max=0.2), OPTIONS)
    for one, other in zip(plain, same, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
        assert one[4]["option"] == other[4]["option"]
    assert [t[4]["option"]["n_steps"] for t in plain] == LENGTHS


def test_the_rest_of_an_option_may_end_the_episode():
    env = RealTimeOptionWrapper(Point(), decide_ahead=0.1, n_rbf=1, d_max=0.2)
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

    env = RealTimeOptionWrapper(Point(), interrupt=interrupt, n_rbf=1, d_max=0.2)
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
    env = RealTimeOptionWrapper(
        Point(), decide_ahead=0.06, interrupt=lambda before, obs, seconds: obs[0] > 0.09, n_rbf=1, d_max=0.2
    )
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
