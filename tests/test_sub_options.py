"""Stretches of an option that was played, as transitions of their own."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import FlattenObservation, TransformObservation
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
)

from sb3_ctco import CTCO, DictOptionReplayBuffer, OptionExecutionWrapper, OptionReplayBuffer
from sb3_ctco.options import discount, draw_stretches, integrated_reward, step_weight

TAU = math.log(2.0)


def wrap(env, **kwargs):
    of_options = {"n_rbf": 3, "d_max": 1.5, "discount_rate": TAU, "trajectory": "rbf", "duration_scale": "linear"}
    return OptionExecutionWrapper(env, **{**of_options, "n_sub_options": 8, "sub_option_tolerance": 2.0, **kwargs})


def play(env, n_options=200, seed=0):
    """Random options; yields their sub-options with the trace of the episode up to then."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(n_options):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        yield info["sub_options"], info["option"], terminated, truncated
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("end", [{"terminate_at": 23}, {"truncate_at": 23}])
@pytest.mark.parametrize("unit", ["rate", "impulse"])
def test_accounting_equals_running_the_stretch(scripted_env, end, unit):
    """R, duration, observations and the end of each sub-option, from the rewards that were paid."""
    paid = lambda step, action: math.sin(step) + float(action[0])  # noqa: E731
    env = wrap(scripted_env(rewards=paid, **end), reward_unit=unit)
    seen_at_end = lengths = 0
    for sub, option, terminated, truncated in play(env):
        base = env.unwrapped
        start = base.count - option["n_steps"]
        for i in range(len(sub)):
            first, last = int(sub.observations[i][0]), int(sub.next_observations[i][0])
            # Within the option, and no longer than it was
            assert start <= first < last <= base.count
            rewards = np.array([paid(k, base.actions[k]) for k in range(first, last)])
            assert sub.durations[i] == pytest.approx((last - first) * 0.1)
            assert sub.integrated_rewards[i] == pytest.approx(integrated_reward(rewards, 0.1, TAU, unit), abs=1e-9)
            at_end = last == base.count
            assert sub.terminated[i] == (terminated and at_end)
            assert sub.truncated[i] == (truncated and at_end)
            seen_at_end += bool(sub.terminated[i] or sub.truncated[i])
            lengths += last - first
            # What the option vector stands for: the duration, and the actions within the residual
            settings = env.option_space
            omega, n_steps = settings.decode(sub.options[i])
            assert n_steps == last - first
            plan = env.plan(sub.options[i])
            played = np.array(base.actions[first:last])
            assert np.abs(plan - played).max() == pytest.approx(sub.residuals[i], abs=1e-6)
            assert np.abs(omega).max() <= 1
    assert seen_at_end > 10
    assert lengths > 500


def test_one_basis_function_is_exact(scripted_env):
    env = wrap(scripted_env(truncate_at=40), n_rbf=1)
    count = 0
    for sub, option, _, _ in play(env):
        np.testing.assert_allclose(sub.residuals, 0.0, atol=1e-12)
        played = np.ravel(env.unwrapped.actions)[-option["n_steps"] :]
        for vector in sub.options:
            assert vector[0] == pytest.approx(played[0], abs=1e-6)
            count += 1
    assert count > 800


def test_replayed_a_sub_option_lands_in_the_same_state():
    """In a deterministic environment, from where it began, up to what its residual does."""
    env = OptionExecutionWrapper(
        gym.make("sb3_ctco/point_mass-easy-v0", dt=0.01), n_rbf=3, d_max=0.5, n_sub_options=8, sub_option_tolerance=0.05
    )
    again = OptionExecutionWrapper(gym.make("sb3_ctco/point_mass-easy-v0", dt=0.01, time_limit=1e6), n_rbf=3, d_max=0.5)
    again.reset(seed=0)
    errors, moved = [], []
    for sub, *_ in itertools.islice(play(env), 60):
        for i in range(len(sub)):
            state = np.asarray(sub.observations[i], dtype=np.float64)
            base = again.unwrapped
            with base._physics.reset_context():
                base._data.qpos[:], base._data.qvel[:] = state[:2], state[2:]
            obs, _, _, _, info = again.step(sub.options[i])
            assert info["option"]["duration"] == pytest.approx(sub.durations[i])
            if np.abs([obs[:2], sub.next_observations[i][:2]]).max() > 0.28:
                continue  # a wall is no free flight
            # A control of 1 accelerates the mass by 1/3 m/s², so one that is off by the residual for d changes the
            # velocity by residual·d/3, and the position, d being below 1 s, by less.
            bound = sub.residuals[i] * sub.durations[i] / 3 + 1e-5
            np.testing.assert_allclose(obs, sub.next_observations[i], atol=bound)
            errors.append(np.abs(obs - sub.next_observations[i]).max())
            moved.append(np.abs(np.asarray(sub.next_observations[i]) - sub.observations[i]).max())
    assert len(moved) > 150
    assert np.mean(moved) > 20 * np.mean(errors)


def test_stretches_that_fit_badly_are_left_out(scripted_env):
    kept = {}
    for tolerance in (0.0, 0.02, 2.0):
        env = wrap(scripted_env(truncate_at=40), sub_option_tolerance=tolerance)
        subs = [sub for sub, *_ in play(env)]
        kept[tolerance] = sum(len(sub) for sub in subs)
        assert all((sub.residuals <= tolerance).all() for sub in subs)
    assert kept[0.0] < kept[0.02] < kept[2.0]


def test_stretches_are_not_shorter_than_d_min(scripted_env):
    env = wrap(scripted_env(truncate_at=37), d_min=0.3)
    subs = [sub for sub, *_ in play(env)]
    durations = np.concatenate([sub.durations for sub in subs])
    assert durations.min() == pytest.approx(0.3)
    # Nothing is shorter than an option that is as short as can be.
    fixed = wrap(scripted_env(), d_min=0.3, d_max=0.3)
    assert all(len(sub) == 0 for sub, *_ in itertools.islice(play(fixed), 5))


@pytest.mark.parametrize(
    ("kwargs", "message"), [({"n_sub_options": -1}, "n_sub_options"), ({"sub_option_tolerance": -0.1}, "tolerance")]
)
def test_bad_arguments(scripted_env, kwargs, message):
    with pytest.raises(ValueError, match=message):
        wrap(scripted_env(), **kwargs)


def test_an_observation_on_the_way_that_is_not_finite_is_refused(scripted_env):
    class Env(scripted_env):
        def _obs(self):
            # Every observation within an option of 15 steps, but neither its first nor its last one
            return super()._obs() * (np.nan if 0 < self.count < 15 else 1.0)

    env = wrap(Env())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="observation that is not finite"):
        env.step(np.append(np.zeros(3), 1.0))
    # Without sub-options nobody sees them.
    env = wrap(Env(), n_sub_options=0)
    env.reset(seed=0)
    env.step(np.append(np.zeros(3), 1.0))


@pytest.mark.parametrize("n_sub_options", [0, 8])
def test_an_environments_own_infos_stay(scripted_env, n_sub_options):
    class Env(scripted_env):
        def step(self, action):
            return *super().step(action)[:4], {"observations": "its own"}

    env = wrap(Env(), n_sub_options=n_sub_options)
    env.reset(seed=0)
    info = env.step(np.append(np.zeros(3), 1.0))[4]
    assert info["observations"] == "its own"
    assert len(info.get("sub_options", [])) >= n_sub_options / 2
    assert set(info) <= {"observations", "option", "sub_options"}


@pytest.mark.parametrize("kind", ["vector", "dict"])
def test_equal_if_all_fields_are(random_walk_env, kind):
    """Checkers of environments compare infos."""
    env = wrap(random_walk_env(kind))
    gymnasium_check_env(env, skip_render_check=True)
    (one, *_), (same, *_) = next(play(env)), next(play(env))
    (_, *_), (other, *_) = itertools.islice(play(env), 2)
    assert one == same
    assert one != other
    assert one != "no sub-options"


def test_they_change_nothing_in_what_the_environment_does():
    def outcome(n):
        env = OptionExecutionWrapper(Monitor(gym.make("sb3_ctco/ball_in_cup-catch-v0", dt=0.01)), n_sub_options=n)
        env.action_space.seed(0)
        trace = [env.reset(seed=0)[0]]
        for _ in range(30):
            obs, reward, _, truncated, info = env.step(env.action_space.sample())
            trace.append((obs, reward, info["option"]))
            if truncated:
                trace.append(env.reset()[0])
        return trace

    np.testing.assert_equal(outcome(0), outcome(8))


@pytest.mark.parametrize("takes_observe", [False, True])
def test_step_sequence_observes_on_the_way_or_gives_way_to_the_loop(scripted_env, takes_observe):
    class Sequence(gym.Wrapper):
        calls = 0

        if takes_observe:

            def step_sequence(self, actions, observe=()):
                return self._play(actions, observe)
        else:

            def step_sequence(self, actions):
                return self._play(actions, ())

        def _play(self, actions, observe):
            self.calls += 1
            rewards, observations = [], []
            for action in actions:
                obs, reward, terminated, truncated, info = self.env.step(action)
                rewards.append(reward)
                if terminated or truncated:
                    break
                if len(rewards) in observe:
                    observations.append(obs)
            info["observations"] = observations
            return obs, rewards, terminated, truncated, info

    fast, slow = wrap(Monitor(Sequence(scripted_env(truncate_at=23)))), wrap(scripted_env(truncate_at=23))
    for left, right in zip(play(fast), play(slow), strict=True):
        np.testing.assert_equal([vars(left[0]), *left[1:]], [vars(right[0]), *right[1:]])
    assert (fast.env.env.calls == 200) == takes_observe


# --- in the buffer


def make(env, policy="MlpPolicy", **kwargs):
    return CTCO(
        policy,
        env,
        **{
            "n_sub_options": 4,
            "learning_starts": 10**9,
            "policy_kwargs": {"net_arch": [8]},
            "batch_size": 8,
            "seed": 0,
            **kwargs,
        },
    )


def test_the_buffer_holds_them_beside_the_options(random_walk_env):
    model = make(random_walk_env()).learn(300)
    buffer = model.replay_buffer
    rows = slice(0, buffer.pos)
    assert 3 * model.num_timesteps / 6 < buffer.pos
    # Their R, discount and end in a sample, as of any other row
    sample = buffer.sample(500)
    np.testing.assert_allclose(
        np.unique(sample.discounts), np.unique(discount(buffer.durations[rows], buffer.discount_rate)), rtol=1e-6
    )
    # Slices are not interaction.
    assert 300 <= model.num_timesteps < 310
    # In this environment an observation's second entry is the step within the episode, over 20.
    first, last = buffer.observations[rows, 0, 1] * 20, buffer.next_observations[rows, 0, 1] * 20
    np.testing.assert_allclose(last - first, buffer.durations[rows, 0] / 0.1, atol=1e-3)
    assert (buffer.dones[rows, 0] == (last > 19.5)).all()
    assert (buffer.timeouts[rows, 0] == buffer.dones[rows, 0]).all()
    # The reward after a step is −|x|, so rows of one step have R ≈ −0.1·|x'|.
    single = np.isclose(buffer.durations[rows, 0], 0.1)
    assert single.sum() > 10
    integrals, x = buffer.integrated_rewards[rows, 0][single], buffer.next_observations[rows, 0, 0][single]
    np.testing.assert_allclose(integrals, -step_weight(0.1, buffer.discount_rate) * np.abs(x), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["vector", "image", "dict"])
def test_several_environments_and_other_observations(random_walk_env, kind):
    policy = {"vector": "MlpPolicy", "image": "CnnPolicy", "dict": "MultiInputPolicy"}[kind]
    env = make_vec_env(
        lambda: random_walk_env(kind),
        n_envs=2,
        wrapper_class=OptionExecutionWrapper,
        wrapper_kwargs={"n_sub_options": 4},
        vec_env_cls=SubprocVecEnv if kind == "dict" else None,
    )
    model = make(env, policy, buffer_size=1000, learning_starts=30, gradient_steps=1).learn(100)
    buffer = model.replay_buffer
    rows = slice(0, buffer.pos)
    assert buffer.pos > 60
    if kind == "image":  # a grey value for x, the same in each pixel
        image = buffer.observations[rows, 0]
        assert (image == image[:, :1, :1, :1]).all()
    if kind == "dict":
        x = buffer.observations["vector"][rows, 0, 0]
        np.testing.assert_allclose(buffer.observations["image"][rows, 0, 0, 0, 0], 127.5 * (x + 1), atol=1)
    assert model._n_updates > 0
    env.close()


def test_images_that_sb3_transposes(random_walk_env):
    class SevenFirst(gym.ObservationWrapper):
        dt = 0.1

        def __init__(self, env):
            super().__init__(env)
            self.observation_space = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)

        def observation(self, obs):
            obs = np.moveaxis(obs, 0, -1).copy()
            obs[..., 0] = 7
            return obs

    model = make(SevenFirst(random_walk_env("image")), "CnnPolicy", buffer_size=500).learn(40)
    buffer = model.replay_buffer
    images = buffer.observations[: buffer.pos, 0]
    assert images.shape[1:] == (3, 36, 36)
    assert (images[:, 0] == 7).all()
    assert buffer.pos > 20


class MovingImages(gym.ObservationWrapper):
    """Images in which each pixel is another, and that change with the state."""

    dt = 0.1

    def __init__(self, env):
        super().__init__(env)
        image = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
        self.observation_space = gym.spaces.Dict({"a": image}) if env.kind == "dict" else image

    def observation(self, obs):
        image = np.arange(36 * 40 * 3).reshape(36, 40, 3)
        image = ((image + self.env.count * 7) % 256).astype(np.uint8)
        return {"a": image} if self.env.kind == "dict" else image


@pytest.mark.parametrize("kind", ["image", "dict"])
@pytest.mark.parametrize("algorithm", ["SAC", "CTCO"])
def test_images_with_channels_last_are_transposed_and_not_reshaped(random_walk_env, kind, algorithm):
    env = OptionExecutionWrapper(MovingImages(random_walk_env(kind)), d_max=1.0, n_sub_options=4)
    policy = "CnnPolicy" if kind == "image" else "MultiInputPolicy"
    if algorithm == "SAC":
        buffer_class = OptionReplayBuffer if kind == "image" else DictOptionReplayBuffer
        model = SAC(policy, env, replay_buffer_class=buffer_class, buffer_size=200, learning_starts=10**9)
        model.learn(20)
    else:
        model = make(env, policy, buffer_size=200, d_max=1.0).learn(100)
    buffer = model.replay_buffer
    assert buffer.pos > 1.5 * buffer.n_decisions
    for stored in (buffer.observations, buffer.next_observations):
        images = stored["a"] if kind == "dict" else stored
        for image in images[: buffer.pos, 0].astype(int):
            # Down a channel a pixel differs from its neighbour by 3, and the channels from each other by 1.
            assert image.shape == (3, 36, 40)
            assert (np.diff(image, axis=2) % 256 == 3).all()
            assert (np.diff(image, axis=0) % 256 == 1).all()


def shifted(env):
    return TransformObservation(env, lambda obs: obs + 1000, gym.spaces.Box(-np.inf, np.inf, env.observation_space.shape))


class Shifted(VecEnvWrapper):
    def reset(self):
        return self.venv.reset() + 1000

    def step_wait(self):
        obs, *rest = self.venv.step_wait()
        return obs + 1000, *rest


def wrapped(env):
    return OptionExecutionWrapper(env, d_max=1.0, n_sub_options=4)


@pytest.mark.parametrize(
    "outside",
    [
        lambda env: shifted(wrapped(env())),
        lambda env: FlattenObservation(wrapped(env("dict"))),
        lambda env: VecExtractDictObs(DummyVecEnv([lambda: wrapped(env("dict"))]), "vector"),
        lambda env: Shifted(DummyVecEnv([lambda: wrapped(env())])),
        lambda env: VecNormalize(DummyVecEnv([lambda: shifted(wrapped(env()))]), norm_reward=False),
    ],
    ids=["TransformObservation", "FlattenObservation", "VecExtractDictObs", "VecEnvWrapper", "below VecNormalize"],
)
def test_observations_changed_outside_are_refused(random_walk_env, outside):
    env = outside(random_walk_env)
    model = make(env, d_max=1.0, buffer_size=500)
    with pytest.raises(ValueError, match=r"put wrappers that change observations inside, .*or pass n_sub_options=0"):
        model.learn(100)
    assert model.replay_buffer.size() == 0
    make(env, d_max=1.0, n_sub_options=0, buffer_size=500).learn(100)


def test_observations_changed_inside_reach_the_buffer(random_walk_env):
    model = make(wrapped(shifted(random_walk_env())), d_max=1.0).learn(100)
    stored = model.replay_buffer.observations[: model.replay_buffer.pos, 0]
    assert len(stored) > 1.5 * model.replay_buffer.n_decisions
    assert ((stored >= 999) & (stored <= 1001)).all()


def test_vec_normalize_keeps_the_originals(random_walk_env):
    """Of observations; those at an episode's end Stable-Baselines3 works back, which is not exact."""
    env = VecNormalize(DummyVecEnv([lambda: wrapped(random_walk_env())]), norm_reward=False)
    buffer = make(env, d_max=1.0).learn(300).replay_buffer
    rows = slice(0, buffer.pos)
    assert buffer.pos > 1.5 * buffer.n_decisions
    first, last = buffer.observations[rows, 0, 1] * 20, buffer.next_observations[rows, 0, 1] * 20
    np.testing.assert_allclose(last - first, buffer.durations[rows, 0] / 0.1, atol=1e-3)


def test_the_ring_goes_round(random_walk_env):
    model = make(random_walk_env(), buffer_size=50).learn(300)
    buffer = model.replay_buffer
    assert buffer.full
    assert (buffer.durations > 0).all()


def test_the_algorithm_tells_the_environment_how_many(random_walk_env):
    env = OptionExecutionWrapper(random_walk_env(), n_sub_options=2, duration_scale="linear")
    env.reset(seed=0)
    model = make(env, n_sub_options=5, duration_scale="linear")
    assert env.n_sub_options == 5
    with pytest.raises(ResetNeeded):
        env.step(env.action_space.sample())  # whose first observation nobody has kept
    model.learn(50)
    assert model.replay_buffer.size() > 2 * model.replay_buffer.n_decisions
    with pytest.raises(ValueError, match="at least 0, not -1"):
        env.set_n_sub_options(-1)


def test_what_cannot_be_sliced_is_refused(random_walk_env):
    stacked = VecFrameStack(
        make_vec_env(random_walk_env, wrapper_class=OptionExecutionWrapper, wrapper_kwargs={"n_sub_options": 4}), 2
    )
    with pytest.raises(ValueError, match="VecFrameStack"):
        make(stacked)


def test_the_residual_is_logged(random_walk_env):
    """The mean of what was fitted since the last log."""
    model = make(random_walk_env(), d_max=1.5)
    model.learn(0)
    logged, expected, seen = [], [], []
    dump = model.logger.dump

    def compare_and_dump(step):
        logged.append(model.logger.name_to_value["option/slice_residual"])
        expected.append(np.mean(seen))
        seen.clear()
        dump(step)

    def watch(local_variables, global_variables):
        for info in local_variables["infos"]:
            seen.extend(info["sub_options"].residuals if "sub_options" in info else [])
        return True

    model.logger.dump = compare_and_dump
    model._custom_logger = True
    model.learn(400, callback=watch)
    assert len(logged) >= 2
    assert min(logged) > 0
    assert logged == pytest.approx(expected)


def test_an_option_has_fewer_sub_options_than_steps():
    """So that long options do not fill the buffer when options become short."""
    rng = np.random.default_rng(0)
    for n_steps in range(1, 12):
        counts = []
        for _ in range(200):
            drawn = draw_stretches(rng, 8, n_steps, shortest=1)
            assert len(set(drawn)) == len(drawn)
            assert all(0 <= first < end <= n_steps and (first, end) != (0, n_steps) for first, end in drawn)
            counts.append(len(drawn))
        assert max(counts) == min(8, n_steps - 1)


def test_an_end_at_the_time_limit_is_an_end(random_walk_env):
    """Gymnasium's TimeLimit truncates at its last step also an episode that terminates with it."""

    class Ends(random_walk_env):
        def step(self, action):
            obs, reward, _, _, info = super().step(action)
            return obs, reward, self.count == 20, False, info

    model = make(gym.wrappers.TimeLimit(Ends(), 20), d_min=0.1, learning_starts=10**6).learn(200)
    buffer = model.replay_buffer
    size = buffer.size()
    last = buffer.next_observations[:size, 0, 1] == 1.0
    assert last.sum() > 10  # of options and of sub-options
    np.testing.assert_array_equal((buffer.dones * (1 - buffer.timeouts))[:size, 0], last)
    space = model.option_space
    rows = buffer.size()
    added = buffer.add_trajectory(
        np.linspace(0, 1, 8).reshape(4, 2), np.zeros((3, 1)), np.ones(3), True, True, space.dt, n_stretches=2
    )
    assert added.added > 0
    assert buffer.size() == rows + added.added
    ended = buffer.dones[-added.added :, 0] == 1
    assert ended.any()
    assert not buffer.timeouts[-added.added :].any()
