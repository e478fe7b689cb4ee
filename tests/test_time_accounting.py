"""Every number of steps that a user gives or sees counts primitive steps."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise

from sb3_ctco import CTCO, OptionExecutionWrapper

SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "device": "cpu", "seed": 0}


def make(env, **kwargs):
    # Without sub-options, so that the buffer has as many rows as there were decisions.
    return CTCO("MlpPolicy", env, **{"learning_starts": 10**9, "d_max": 0.6, "n_sub_options": 0, **SMALL, **kwargs})


class Recorder(BaseCallback):
    """Keeps what a callback sees at each call."""

    def __init__(self, stop_at=None):
        super().__init__()
        self.seen = []
        self.stop_at = stop_at

    def _on_step(self):
        done, reward = bool(self.locals["dones"].any()), float(np.sum(self.locals["rewards"]))
        self.seen.append((self.num_timesteps, self.model.num_timesteps, done, reward, len(self.locals["infos"][0])))
        return self.num_timesteps != self.stop_at


@pytest.mark.parametrize("steps", [1, 50, 333])
def test_learn_spends_n_steps_up_to_one_option(random_walk_env, steps):
    env = random_walk_env()
    played = []
    inner = env.step
    env.step = lambda action: played.append(1) or inner(action)
    model = make(env).learn(steps)
    assert model.num_timesteps == len(played)
    assert steps <= model.num_timesteps < steps + 6  # the longest option has six steps
    buffer = model.replay_buffer
    assert round(buffer.durations.sum() / 0.1) == model.num_timesteps


def test_continuing_counts_on(random_walk_env):
    model = make(random_walk_env()).learn(50)
    first = model.num_timesteps
    model.learn(50, reset_num_timesteps=False)
    assert first + 50 <= model.num_timesteps < first + 56
    episodes = model._episode_num
    model.learn(50)
    assert 50 <= model.num_timesteps < 56
    assert model._episode_num < episodes


def test_callbacks_are_called_once_a_primitive_step(random_walk_env):
    recorder = Recorder()
    model = make(random_walk_env()).learn(100, recorder)
    assert [seen[0] for seen in recorder.seen] == list(range(1, model.num_timesteps + 1))
    assert all(seen[0] == seen[1] for seen in recorder.seen)
    # What a decision brought is seen once: all decisions, and every twentieth step ends an episode.
    assert sum(bool(seen[4]) for seen in recorder.seen) == model.replay_buffer.pos
    assert [seen[0] for seen in recorder.seen if seen[2]] == list(range(20, model.num_timesteps + 1, 20))
    total = sum(seen[3] for seen in recorder.seen)
    assert total == pytest.approx(model.replay_buffer.rewards.sum(), rel=1e-5)


def test_several_environments_share_the_count(random_walk_env):
    env = make_vec_env(random_walk_env, n_envs=3, wrapper_class=OptionExecutionWrapper, wrapper_kwargs={"d_max": 0.6})
    recorder = Recorder()
    model = make(env).learn(120, recorder)
    buffer = model.replay_buffer
    assert round(buffer.durations.sum() / 0.1) == model.num_timesteps
    # A call stands for a step in each of the three.
    assert [seen[0] for seen in recorder.seen] == list(range(3, model.num_timesteps + 1, 3))


@pytest.mark.parametrize("algorithm", ["ctco", "sac"])
def test_evaluations_and_checkpoints_fall_where_sacs_do(tmp_path, random_walk_env, algorithm):
    checkpoint = CheckpointCallback(30, str(tmp_path))
    every = EveryNTimesteps(25, counter := Recorder())
    if algorithm == "ctco":
        model = make(random_walk_env())
        eval_env = model.wrap_env(random_walk_env())
    else:
        model = SAC("MlpPolicy", random_walk_env(), learning_starts=10**9, **SMALL)
        eval_env = random_walk_env()
    evaluation = EvalCallback(eval_env, n_eval_episodes=1, eval_freq=40, log_path=str(tmp_path), verbose=0, warn=False)
    model.learn(125, [checkpoint, evaluation, every])
    assert sorted(path.name for path in tmp_path.glob("*.zip")) == sorted(f"rl_model_{n}_steps.zip" for n in (30, 60, 90, 120))
    evaluations = np.load(tmp_path / "evaluations.npz")
    np.testing.assert_array_equal(evaluations["timesteps"], [40, 80, 120])
    assert (evaluations["ep_lengths"] == 20).all()
    assert [seen[0] for seen in counter.seen] == [25, 50, 75, 100, 125]


def test_callbacks_stop_it(random_walk_env):
    recorder = Recorder(stop_at=33)
    model = make(random_walk_env()).learn(1000, recorder)
    assert recorder.seen[-1][0] == 33
    # The option that was playing has been played.
    assert 33 <= model.num_timesteps < 39

    model = make(random_walk_env()).learn(1000, StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps == 60


def test_after_a_stop_learning_goes_on_from_a_reset(random_walk_env):
    model = make(random_walk_env()).learn(1000, Recorder(stop_at=33))
    stored = model.replay_buffer.pos
    model.learn(10, reset_num_timesteps=False)
    assert model.replay_buffer.observations[stored, 0, 1] == 0.0  # no steps made yet in this episode


def test_functions_and_lists_are_callbacks_too(random_walk_env):
    calls = []
    make(random_walk_env()).learn(20, lambda local, glob: calls.append(1) or True)
    assert len(calls) >= 20
    make(random_walk_env()).learn(20, [Recorder(), CallbackList([Recorder()])])


def test_progress_bar(random_walk_env, monkeypatch):
    shown = []

    class Bar:
        def __init__(self, total):
            self.total = total
            shown.append(self)
            self.n = 0

        def update(self, n):
            self.n += n

        def refresh(self):
            pass

        close = refresh

    monkeypatch.setattr("stable_baselines3.common.callbacks.tqdm", Bar)
    model = make(random_walk_env()).learn(90, progress_bar=True)
    assert (shown[0].total, shown[0].n) == (90, model.num_timesteps)
    before = model.num_timesteps
    model.learn(90, progress_bar=True, reset_num_timesteps=False)
    assert (shown[1].total, shown[1].n) == (90, model.num_timesteps - before)


# --- how many updates


def test_learning_starts_and_updates_a_second(random_walk_env):
    # dt = 0.1 s: 3 updates a second are 0.3 a step
    model = make(random_walk_env(), learning_starts=100, updates_per_second=3).learn(99)
    assert model._n_updates == 0
    model = make(random_walk_env(), learning_starts=100, updates_per_second=3).learn(400)
    assert model._n_updates == int((model.num_timesteps - 100) * 0.3 + 1e-9)


def test_updates_a_second_do_not_depend_on_the_rate(scripted_env):
    updates = []
    for dt in (0.02, 0.002):
        model = make(scripted_env(dt=dt, truncate_at=round(2 / dt)), learning_starts=0, updates_per_second=4)
        model.learn(round(20 / dt))
        updates.append(model._n_updates)
        assert model.num_timesteps * dt == pytest.approx(20, abs=0.61)
    assert updates[0] == pytest.approx(80, abs=3)
    assert updates[1] == pytest.approx(80, abs=3)


@pytest.mark.parametrize(
    ("kwargs", "updates_of_steps"),
    [
        ({}, lambda steps, decisions: steps),  # one a step, as SAC
        ({"gradient_steps": 1}, lambda steps, decisions: decisions),  # one a decision, Algorithm 1 of the paper
        ({"gradient_steps": 2}, lambda steps, decisions: 2 * decisions),
    ],
)
def test_gradient_steps(random_walk_env, kwargs, updates_of_steps):
    model = make(random_walk_env(), learning_starts=0, **kwargs).learn(60)
    assert model._n_updates == updates_of_steps(model.num_timesteps, model.replay_buffer.pos)


def test_train_freq_counts_primitive_steps(random_walk_env):
    model = make(random_walk_env(), learning_starts=0, train_freq=20, gradient_steps=1)
    trainings = []
    train = model.train
    model.train = lambda *args, **kwargs: trainings.append(model.num_timesteps) or train(*args, **kwargs)
    model.learn(100)
    assert len(trainings) == 5
    assert all(20 <= gap < 26 for gap in np.diff([0, *trainings]))


def test_train_by_episode(random_walk_env):
    model = make(random_walk_env(), learning_starts=0, train_freq=(1, "episode"), updates_per_second=5).learn(100)
    assert model.num_timesteps == 100
    assert model._n_updates == 50


@pytest.mark.parametrize(
    "kwargs", [{"updates_per_second": 20, "gradient_steps": 1}, {"updates_per_second": 0}, {"updates_per_second": -1.0}]
)
def test_contradicting_update_settings(random_walk_env, kwargs):
    with pytest.raises(ValueError, match="updates_per_second"):
        make(random_walk_env(), **kwargs)


def test_schedules_count_primitive_steps(random_walk_env):
    progress = []

    def schedule(remaining):
        progress.append(remaining)
        return 1e-3

    make(random_walk_env(), learning_rate=schedule, learning_starts=0, gradient_steps=1).learn(100)
    assert progress[-1] == pytest.approx(0.0, abs=0.06)


def test_logs(random_walk_env):
    model = make(random_walk_env(), learning_starts=20, gradient_steps=1, d_min=0.3, high_freq_penalty=0.003)
    logged = {}

    class Spy(BaseCallback):
        def _on_step(self):
            return True

    model.learn(0, Spy())
    dump = model.logger.dump

    def spy(step):
        logged[step] = dict(model.logger.name_to_value)
        dump(step)

    model.logger.dump = spy
    model._custom_logger = True
    model.learn(400, log_interval=4)
    assert list(logged) == [80, 160, 240, 320, 400]  # four episodes of 20 steps each
    last = logged[400]
    assert last["rollout/ep_len_mean"] == 20
    assert 0.3 <= last["option/duration_mean"] <= 0.6
    assert last["option/decision_rate_hz"] == pytest.approx(1 / last["option/duration_mean"])
    assert last["option/high_freq_penalty"] == 0.003
    assert last["time/total_timesteps"] == 400
    for name in ("actor_loss", "critic_loss", "ent_coef", "duration_ent_coef", "ent_coef_loss", "n_updates", "learning_rate"):
        assert np.isfinite(last[f"train/{name}"]), name


def test_gymnasium_pendulum_through_the_string():
    model = CTCO("MlpPolicy", "Pendulum-v1", learning_starts=10**9, **SMALL)
    assert model.dt == pytest.approx(0.05)
    model.learn(200)
    assert model.ep_info_buffer[0]["l"] == 200
    assert gym.make("Pendulum-v1").unwrapped.dt == model.dt


def test_a_rollout_begins_and_ends_once_a_training(random_walk_env):
    """With ``train_freq=50`` four times in 200 steps, as SAC's, however many decisions these take."""

    class Rollouts(Recorder):
        def __init__(self):
            super().__init__()
            self.events = []

        def _on_rollout_start(self):
            self.events.append(("start", self.model._n_updates))

        def _on_rollout_end(self):
            self.events.append(("end", self.num_timesteps))

    callback = Rollouts()
    model = make(random_walk_env(), train_freq=50, gradient_steps=1, learning_starts=0).learn(200, callback)
    starts, ends = ([at for event, at in callback.events if event == name] for name in ("start", "end"))
    assert starts == list(range(model._n_updates))  # each before updates are made
    assert len(ends) == len(starts) == len(callback.events) // 2 == 4
    assert all(end - begin >= 50 for begin, end in itertools.pairwise([0, *ends]))


@pytest.mark.parametrize("train_freq", [0, -3])
def test_a_train_freq_that_is_none(random_walk_env, train_freq):
    with pytest.raises(ValueError, match=f"train_freq must be at least 1, not {train_freq}"):
        make(random_walk_env(), train_freq=train_freq)


def test_schedules_are_of_numbers_from_one_to_zero(random_walk_env):
    """A root of the remaining progress is real, also for updates after an option that ends beyond the last step."""
    seen = []
    model = make(
        random_walk_env(),
        d_min=0.6,
        learning_starts=10,
        learning_rate=lambda remaining: seen.append(remaining) or 1e-3 * math.sqrt(remaining),
    ).learn(102)
    assert model.num_timesteps == 106  # episodes of 20 steps, options of 6 and at last 2
    assert (min(seen), max(seen)) == (0.0, 1.0)


def test_noise_is_of_options(random_walk_env):
    noise = NormalActionNoise(np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match=r"action_noise has the shape \(1,\): it is added to options, \(3,\) numbers"):
        make(random_walk_env(), action_noise=noise).learn(20)
    make(random_walk_env(), action_noise=NormalActionNoise(np.zeros(3), np.ones(3))).learn(20)


def test_learning_goes_on_after_somebody_else_used_the_environment(random_walk_env):
    """To evaluate in the model's own environment moves it on, so the next training begins with a reset."""
    model = make(random_walk_env(), n_sub_options=4, buffer_size=1000).learn(30)
    env = model.get_env()
    resets = []
    reset = env.reset
    env.reset = lambda: resets.append(1) or reset()
    model.learn(30, reset_num_timesteps=False)
    assert not resets
    evaluate_policy(model, env, 1)
    resets.clear()
    model.learn(30, reset_num_timesteps=False)
    assert len(resets) == 1
    rows = model.replay_buffer.observations[: model.replay_buffer.pos, 0], model.replay_buffer.durations[:, 0]
    following = model.replay_buffer.next_observations[: model.replay_buffer.pos, 0]
    # The second number counts steps: an option ends as many later as it took, wherever it began.
    np.testing.assert_allclose(following[:, 1] - rows[0][:, 1], rows[1][: len(following)] / 2.0, atol=1e-6)


def test_two_models_in_turn_in_one_environment(random_walk_env):
    """Each has its sub-options."""
    env = make_vec_env(random_walk_env, wrapper_class=OptionExecutionWrapper, wrapper_kwargs={"d_max": 0.6}, seed=0)
    first, second = make(env, n_sub_options=4), make(env)
    for model in (first, second, first):
        model.learn(60, reset_num_timesteps=False)
    assert first.replay_buffer.size() > first.replay_buffer.n_decisions
    assert second.replay_buffer.size() == second.replay_buffer.n_decisions
