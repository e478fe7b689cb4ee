"""Environments in worker processes that do not wait for each other's options."""

import time

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_ctco import CTCO, FiGARSAC, OptionExecutionWrapper
from sb3_ctco.evaluation import DiscountedReturnCallback, evaluate_discounted_return
from sb3_ctco.figar_sac.policies import decode_repetitions
from sb3_ctco.vec_env import AsyncOptionVecEnv

WRAPPER = {"n_rbf": 2, "d_max": 1.0}


def make_env(env_class, n_envs, vec_env_cls=AsyncOptionVecEnv, n_sub_options=0, **kwargs):
    return make_vec_env(
        env_class,
        n_envs=n_envs,
        seed=0,
        wrapper_class=OptionExecutionWrapper,
        wrapper_kwargs={**WRAPPER, "n_sub_options": n_sub_options},
        vec_env_cls=vec_env_cls,
        vec_env_kwargs={"start_method": "fork", **kwargs},
    )


def make_model(env, policy="MlpPolicy", **kwargs):
    return CTCO(
        policy,
        env,
        **{
            **WRAPPER,
            "learning_starts": 60,
            "gradient_steps": 1,
            "batch_size": 8,
            "policy_kwargs": {"net_arch": [8]},
            "buffer_size": 5000,
            "seed": 0,
            **kwargs,
        },
    )


@pytest.fixture
def make_slow_env(random_walk_env):
    class Env(random_walk_env):
        """A tenth of a millisecond or ten a step, as its action says."""

        def step(self, action):
            time.sleep(0.01 if float(action[0]) > 0 else 0.0001)
            return super().step(action)

    return Env


@pytest.fixture
def slow_and_fast(make_slow_env):
    env = make_env(make_slow_env, 2)
    yield env, env.reset()
    env.close()


def option(value, duration):
    return np.array([value, value, duration], dtype=np.float32)


def test_who_is_ready_is_returned_and_who_runs_keeps_its_option(slow_and_fast):
    env, first = slow_and_fast
    # Environment 0 plays ten slow steps, 1 one fast step: x moves by 0.1·2·value a step.
    obs, rewards, dones, infos = env.step(np.stack([option(0.25, 1.0), option(-0.5, -1.0)]))
    assert infos[0] == {"option_pending": True}
    np.testing.assert_array_equal(obs[0], first[0])
    assert rewards[0] == 0
    assert not dones.any()
    assert infos[1]["option"]["n_steps"] == 1
    np.testing.assert_array_equal(infos[1]["option_played"], option(-0.5, -1.0))
    assert obs[1, 0] == pytest.approx(max(first[1, 0] - 0.1, -1))
    # What is asked of 0 next is ignored; it ends what it began.
    while "option_pending" in infos[0]:
        obs, _, _, infos = env.step(np.stack([option(-1.0, -1.0), option(-0.5, -1.0)]))
    np.testing.assert_array_equal(infos[0]["option_played"], option(0.25, 1.0))
    assert infos[0]["option"]["n_steps"] == 10
    assert obs[0, 0] == pytest.approx(min(first[0, 0] + 0.5, 1), abs=1e-5)


def test_questions_and_resets_wait_for_options_that_run(slow_and_fast):
    env, _ = slow_and_fast
    actions = np.stack([option(0.25, 1.0), option(-0.5, -1.0)])
    infos = env.step(actions)[3]
    assert "option_pending" in infos[0]
    assert env.get_attr("dt") == [0.1, 0.1]
    # 0 has ended meanwhile, which the next step tells at once.
    assert "option" in env.step(actions)[3][0]
    env.step(actions)
    obs = env.reset()
    np.testing.assert_array_equal(obs[:, 1], 0.0)
    infos = env.step(actions)[3]
    assert infos[1]["option"]["n_steps"] == 1


def test_min_ready(make_slow_env):
    env = make_env(make_slow_env, 2, min_ready=2)
    env.reset()
    infos = env.step(np.stack([option(0.25, 1.0), option(-0.5, -1.0)]))[3]
    assert [info["option"]["n_steps"] for info in infos] == [10, 1]
    env.close()
    for wrong in (0, 3):
        with pytest.raises(ValueError, match=f"min_ready must be 1 to 2, .* not {wrong}"):
            make_env(make_slow_env, 2, min_ready=wrong)


class Watch(BaseCallback):
    """What a user's callback sees."""

    def __init__(self):
        super().__init__()
        self.episodes, self.done, self.options = [], 0, 0

    def _on_step(self):
        assert self.num_timesteps == self.n_calls * self.training_env.num_envs
        infos = self.locals["infos"]
        self.episodes += [info["episode"]["l"] for info in infos if "episode" in info]
        self.options += sum("option" in info for info in infos)
        self.done += int(self.locals["dones"].sum())
        return True


@pytest.mark.parametrize("kind", ["vector", "image", "dict"])
def test_accounting_of_a_training(random_walk_env, kind):
    policy = {"vector": "MlpPolicy", "image": "CnnPolicy", "dict": "MultiInputPolicy"}[kind]
    env = make_env(lambda: random_walk_env(kind), 3, n_sub_options=2)
    watch = Watch()
    model = make_model(env, policy, n_sub_options=2, learning_starts=300 if kind != "vector" else 60)
    model.learn(300, callback=watch, log_interval=10**6)
    buffer, durations = model.replay_buffer, np.array(model._durations_since_log)
    # Steps are those of the options that ended, and at most those that end together come on top.
    assert model.num_timesteps == round(durations.sum() / 0.1) >= 300
    assert model.num_timesteps < 300 + 3 * 10
    assert watch.n_calls == model.num_timesteps // 3
    assert watch.options >= len(durations) - 3
    # An episode has 20 steps, and what has not ended is at most one a environment.
    assert model.num_timesteps // 20 - 3 < model._episode_num <= model.num_timesteps / 20
    assert watch.done == len(watch.episodes) >= model._episode_num - 1
    assert set(watch.episodes) == {20}
    rows = buffer.pos
    assert len(durations) < rows <= 3 * len(durations)
    if kind == "vector":
        # One update a call, and a call brings at most three options of ten steps: how many there are depends on timing.
        assert model._n_updates >= (300 - 60) / 30
    env.close()


def test_rows_are_what_an_environment_of_its_own_does(make_slow_env):
    """Each row, replayed: the same next observation, R, duration and end."""
    env = make_env(make_slow_env, 4, n_sub_options=1)
    model = make_model(env, n_sub_options=1).learn(400, log_interval=10**6)
    env.close()
    alone = OptionExecutionWrapper(make_slow_env(), **WRAPPER)
    alone.unwrapped.step = lambda action: super(make_slow_env, alone.unwrapped).step(action)
    buffer, options = model.replay_buffer, 0
    for row in range(buffer.pos):
        if buffer.rewards[row, 0] == buffer.integrated_rewards[row, 0]:
            continue  # a sub-option, whose actions differ by its residual
        alone.reset()
        x, phase = buffer.observations[row, 0]
        alone.unwrapped.x, alone.unwrapped.count = float(x), round(20 * phase)
        obs, reward, terminated, truncated, info = alone.step(buffer.actions[row, 0])
        np.testing.assert_allclose(obs, buffer.next_observations[row, 0], atol=1e-5)
        assert reward == pytest.approx(buffer.rewards[row, 0], abs=1e-4)
        assert info["option"]["integrated_reward"] == pytest.approx(buffer.integrated_rewards[row, 0], abs=1e-4)
        assert info["option"]["duration"] == pytest.approx(buffer.durations[row, 0])
        assert not terminated
        assert truncated == buffer.dones[row, 0] == buffer.timeouts[row, 0]
        options += 1
    assert options == len(model._durations_since_log) > 40


@pytest.mark.parametrize("min_ready", [1, 3])
def test_figar_sac_stores_the_repetitions_that_ran(random_walk_env, min_ready):
    """Of pending options nothing, and of those that the episode's end cut short what they became."""
    env = make_vec_env(
        random_walk_env,
        n_envs=3,
        seed=0,
        wrapper_class=OptionExecutionWrapper,
        wrapper_kwargs={"n_rbf": 1, "d_max": 1.2, "duration_scale": "linear"},
        vec_env_cls=AsyncOptionVecEnv,
        vec_env_kwargs={"start_method": "fork", "min_ready": min_ready},
    )
    model = FiGARSAC("MlpPolicy", env, n_repetitions=12, learning_starts=200, gradient_steps=1, seed=0).learn(600)
    env.close()
    buffer = model.replay_buffer
    rows = slice(0, buffer.pos)
    repetitions = decode_repetitions(buffer.actions[rows, 0, -1], 12)
    np.testing.assert_allclose(repetitions, buffer.durations[rows, 0] / 0.1, atol=1e-4)
    # Nothing of what was pending: all that ran is in the buffer once.
    assert round(repetitions.sum()) == model.num_timesteps
    assert buffer.dones[rows].sum() > 5


def test_evaluation_counts_options_once(slow_and_fast):
    env, _ = slow_and_fast

    class Policy:
        """Environment 0 plays options of ten steps, 1 of one step."""

        def predict(self, observation, **kwargs):
            return np.stack([option(0.25, 1.0), option(-0.5, -1.0)]), None

    episodes = evaluate_discounted_return(Policy(), env, 4, smoothness=True)
    assert all(episode.seconds == pytest.approx(2.0) for episode in episodes)
    assert {episode.decisions for episode in episodes} <= {2, 20}
    # Each of these options is a constant action, and the same as the one before.
    assert all(episode.mean_absolute_jerk == pytest.approx(0.0, abs=1e-6) for episode in episodes)


def test_the_callback_of_discounted_returns_counts_options_once(random_walk_env):
    env = make_env(random_walk_env, 3)
    callback = DiscountedReturnCallback()
    model = make_model(env, n_sub_options=0).learn(300, callback)
    env.close()
    assert all(episode.seconds == pytest.approx(2.0) for episode in callback.episodes)
    assert model._episode_num - 1 <= len(callback.episodes) <= model._episode_num


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_callers_actions_stay_as_they_are(random_walk_env, n_envs):
    env = make_env(random_walk_env, n_envs)
    model = make_model(env, n_sub_options=0)
    model.learn(0)
    actions = np.full((n_envs, 3), 0.9, dtype=np.float32)
    infos = [
        {
            "option": {
                "duration": 0.1,
                "n_steps": 1,
                "integrated_reward": 0.0,
                "discount": np.exp(-0.1 * model.discount_rate),
            },
            "option_played": np.full(3, 0.1, dtype=np.float32),
        }
        for _ in range(n_envs)
    ]
    model._store_transition(model.replay_buffer, actions, env.reset(), np.zeros(n_envs), np.zeros(n_envs, dtype=bool), infos)
    env.close()
    assert (actions == np.float32(0.9)).all()
    np.testing.assert_allclose(model.replay_buffer.actions[:n_envs], 0.1, rtol=1e-6)


def test_waiting_for_all_is_the_synchronous_one(random_walk_env):
    buffers = []
    for vec_env_cls, kwargs in ((SubprocVecEnv, {}), (AsyncOptionVecEnv, {"min_ready": 3})):
        env = make_env(random_walk_env, 3, vec_env_cls, n_sub_options=2, **kwargs)
        model = make_model(env, n_sub_options=2).learn(300)
        env.close()
        buffers.append(model.replay_buffer)
    sync, asynchronous = buffers
    assert sync.pos == asynchronous.pos > 100
    for name in ("observations", "next_observations", "actions", "rewards", "integrated_rewards", "durations", "timeouts"):
        np.testing.assert_allclose(getattr(sync, name), getattr(asynchronous, name), atol=1e-5)


def test_statistics_of_pending_observations_are_refused(random_walk_env):
    env = make_env(random_walk_env, 2)
    with pytest.raises(ValueError, match="VecNormalize would count an observation again"):
        make_model(VecNormalize(env, norm_reward=False))
    env.close()
