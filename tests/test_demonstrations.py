"""Recorded trajectories of primitive actions as options, and training that draws a part of each batch from them."""

import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl

from sb3_ctco import CTCO, DictOptionReplayBuffer, OptionReplayBuffer
from sb3_ctco.datasets import lerobot_trajectories, minari_trajectories
from sb3_ctco.options import OptionSpace, integrated_reward, with_last_action_space

TAU = math.log(2.0)
ACTIONS = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32))
STEPS = spaces.Box(-np.inf, np.inf, (1,), np.float32)


def make_buffer(size=10_000, n_rbf=2, d_min=0.1, d_max=0.5, space=STEPS, **kwargs):
    """A buffer of options of an environment with a step of 0.1 s."""
    kind = DictOptionReplayBuffer if isinstance(space, spaces.Dict) else OptionReplayBuffer
    return kind(
        size,
        space,
        spaces.Box(-1.0, 1.0, (2 * n_rbf + 1,), np.float32),
        device="cpu",
        discount_rate=TAU,
        option_space=OptionSpace.make(n_rbf, d_max, d_min, 0.1, TAU, "rbf", "linear"),
        primitive_action_space=ACTIONS,
        **kwargs,
    )


def recording(n, slope=0.5, dt=0.1):
    """Observations that count steps, actions that drift slowly within their bounds, and a reward a step."""
    observations = np.arange(n + 1, dtype=np.float32)[:, None]
    phase = slope * dt * np.arange(n)
    actions = np.stack([2.0 * np.sin(phase), 0.5 + 0.5 * np.cos(phase)], axis=1)
    return observations, actions, np.sin(np.arange(n) * 7.0)


@pytest.fixture(autouse=True)
def seed():
    np.random.seed(0)


def demonstrations(buffer):
    """The rows of ``buffer`` that demonstrations are in."""
    return range(buffer.buffer_size - buffer.n_demonstrations, buffer.buffer_size)


@pytest.mark.parametrize(("terminated", "truncated"), [(True, False), (False, True), (False, False)])
@pytest.mark.parametrize("unit", ["rate", "impulse"])
@pytest.mark.parametrize("dt", [0.1, 0.03, 0.25])
def test_accounting_equals_what_was_recorded(dt, unit, terminated, truncated):
    """Observations, actions, R, duration and the end of each option, at the environment's rate, a higher and a lower one."""
    buffer = make_buffer()
    observations, actions, rewards = recording(60, dt=dt)
    kwargs = {"n_stretches": 3, "reward_unit": unit}
    added, refused, residual = buffer.add_trajectory(observations, actions, rewards, terminated, truncated, dt, **kwargs)
    assert added == buffer.n_demonstrations == buffer.size()
    assert refused == 0
    normalised = (actions - [0.0, 0.5]) / [2.0, 0.5]
    lengths, residuals, ended = set(), [], 0
    for row in demonstrations(buffer):
        first, last = int(buffer.observations[row, 0, 0]), int(buffer.next_observations[row, 0, 0])
        lengths.add(last - first)
        assert 0 <= first < last <= 60
        assert buffer.durations[row, 0] == pytest.approx((last - first) * dt)
        expected = integrated_reward(rewards[first:last], dt, TAU, unit)
        assert buffer.integrated_rewards[row, 0] == pytest.approx(expected, abs=1e-6)
        assert buffer.dones[row, 0] == (last == 60 and (terminated or truncated))
        assert buffer.timeouts[row, 0] == (last == 60 and truncated)
        ended += last == 60
        # What the option vector stands for, at the rate of the recording
        option = buffer.actions[row, 0].astype(np.float64)
        assert buffer.option_space.duration(option) == pytest.approx((last - first) * dt, rel=1e-6)
        plan = buffer.option_space.trajectory.plan(option[:-1].reshape(2, 2), last - first)
        residuals.append(np.abs(plan - normalised[first:last]).max())
    # From d_min to d_max; where the steps are longer than d_min, from one step on
    assert lengths == {0.1: {1, 2, 3, 4, 5}, 0.03: set(range(4, 17)), 0.25: {1, 2}}[dt]
    assert residual == pytest.approx(max(residuals), abs=1e-6)
    assert ended >= 3
    assert added > 150


def test_until_the_policy_is_paid_the_price_is_relative_to_what_demonstrations_paid():
    buffer = make_buffer()
    observations, actions, _ = recording(60)
    assert buffer.mean_reward_rate == 1.0
    buffer.add_trajectory(observations, actions, np.zeros(60), False, False, 0.1)
    assert buffer.mean_reward_rate == 1.0  # these paid nothing
    buffer.add_trajectory(observations, actions, np.full(60, -0.001), False, False, 0.1)
    # R of options of 0.1 to 0.5 s is a little less than what is paid, by their discount.
    assert buffer.mean_reward_rate == pytest.approx(0.001, rel=0.2)


def test_one_weight_plays_a_constant_action_exactly():
    buffer = make_buffer(n_rbf=1)
    observations, _, rewards = recording(20)
    result = buffer.add_trajectory(observations, np.tile([1.0, 0.25], (20, 1)), rewards, False, False, 0.1)
    assert result.largest_residual == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(buffer.actions[list(demonstrations(buffer)), 0, :2], [[0.5, -0.5]] * result.added)


def test_an_hour_keeps_its_last_rewards():
    """Discounting from the recording's beginning would make them nothing: 2^−3600."""
    buffer = make_buffer(100_000)
    observations, actions, rewards = recording(36_000)
    buffer.add_trajectory(observations, actions, rewards, True, False, 0.1)
    for row in list(demonstrations(buffer))[:50]:
        first, last = int(buffer.observations[row, 0, 0]), int(buffer.next_observations[row, 0, 0])
        assert first > 30_000
        expected = integrated_reward(rewards[first:last], 0.1, TAU)
        assert buffer.integrated_rewards[row, 0] == pytest.approx(expected, abs=1e-6)


def test_what_no_option_plays_is_refused_and_counted():
    buffer = make_buffer()
    observations, actions, rewards = recording(400)
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, actions.shape) * [2.0, 0.5]
    actions[200:] = noise[200:] + np.array([0.0, 0.5])
    tolerance = 0.05
    result = buffer.add_trajectory(observations, actions, rewards, False, False, 0.1, tolerance=tolerance)
    assert result.largest_residual <= tolerance
    # Two weights play any two steps, and about nothing longer of noise. One stretch in five is of one step, one of two.
    assert 80 < result.refused < 160
    for row in demonstrations(buffer):
        first, last = int(buffer.observations[row, 0, 0]), int(buffer.next_observations[row, 0, 0])
        assert last <= 201 or last - first <= 3


def test_a_recording_shorter_than_an_option_adds_nothing():
    buffer = make_buffer(d_min=0.3)
    observations, actions, rewards = recording(2)
    assert buffer.add_trajectory(observations, actions, rewards, True, False, 0.1) == (0, 0, 0.0)


BAD = [
    ({"observations": np.zeros((20, 1))}, "n \\+ 1 observations, .* not 20 actions, rewards of shape \\(20,\\) and \\[20\\]"),
    ({"observations": np.zeros((21, 3))}, r"shape \[n \+ 1, \*\(1,\)\], not \(21, 3\)"),
    ({"observations": {"a": np.zeros((21, 1))}}, "observations must have shape"),
    ({"observations": np.full((21, 1), np.nan)}, "finite"),
    ({"actions": np.zeros((20, 3))}, r"shape \[n, \*\(2,\)\], not \(20, 3\)"),
    ({"actions": np.full((20, 2), 3.0)}, "within the environment's bounds.* from 1.5 to 5.0"),
    ({"actions": np.full((20, 2), np.nan)}, "actions must be finite"),
    ({"rewards": np.zeros((20, 1))}, r"rewards of shape \(20, 1\)"),
    ({"rewards": np.full(20, np.inf)}, "rewards must be finite"),
    ({"dt": 0.0}, "positive number of seconds, not 0.0"),
    ({"dt": 0.6}, "dt=0.6 s is as long as an option, 0.1 to 0.5 s: record at a higher rate"),
    ({"n_stretches": 0}, "not 0, 0.1 and 'rate'"),
    ({"tolerance": math.nan}, "tolerance at least 0"),
    ({"reward_unit": "sum"}, "'sum'"),
    ({"n_stretches": 20}, "buffer_size=50 must be larger, or n_stretches=20 smaller"),
]


@pytest.mark.parametrize(("wrong", "message"), BAD)
def test_what_is_wrong_leaves_the_buffer_as_it_was(wrong, message):
    buffer = make_buffer(50)
    observations, actions, rewards = recording(20)
    right = {
        "observations": observations,
        "actions": actions,
        "rewards": rewards,
        "terminated": True,
        "truncated": False,
        "dt": 0.1,
    }
    buffer.add_trajectory(**right)
    before = {name: np.copy(value) for name, value in vars(buffer).items() if isinstance(value, np.ndarray | int)}
    with pytest.raises(ValueError, match=message):
        buffer.add_trajectory(**{**right, **wrong})
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(buffer, name), value, err_msg=name)


def test_a_buffer_that_does_not_know_what_options_mean_says_how_to_tell_it():
    buffer = OptionReplayBuffer(10, STEPS, spaces.Box(-1.0, 1.0, (5,)), device="cpu")
    with pytest.raises(ValueError, match="pass option_space and primitive_action_space"):
        buffer.add_trajectory(*recording(5), True, False, 0.1)


@pytest.mark.parametrize("fraction", [-0.1, 1.1, math.nan])
def test_a_fraction_is_one(fraction):
    with pytest.raises(ValueError, match="demonstration_fraction"):
        make_buffer(demonstration_fraction=fraction)


def add_experience(buffer, value):
    """A decision whose R is ``value``, below 0 to tell it from a demonstration."""
    option = {"duration": 0.5, "n_steps": 5, "integrated_reward": value, "discount": 0.5**0.5}
    obs = np.zeros((1, 1), np.float32)
    buffer.add(obs, obs, np.zeros((1, 5)), np.zeros(1), np.zeros(1), [{"option": option}])


def test_demonstrations_stay_and_experience_goes_round():
    buffer = make_buffer(50)
    for value in range(40):
        add_experience(buffer, -1.0 - value)
    observations, actions, _ = recording(20)
    added = buffer.add_trajectory(observations, actions, np.ones(20), True, False, 0.1).added
    assert 15 <= added <= 20
    # There were 40, and there are rows for fewer
    assert buffer.full
    assert buffer.size() == 50
    kept = buffer.integrated_rewards[list(demonstrations(buffer)), 0].copy()
    assert (kept > 0).all()
    for value in range(100):
        add_experience(buffer, -1000.0 - value)
    np.testing.assert_array_equal(buffer.integrated_rewards[list(demonstrations(buffer)), 0], kept)
    n_rows = 50 - added
    assert sorted(buffer.integrated_rewards[:n_rows, 0]) == [-1099.0 + k for k in range(n_rows)]


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 1.0])
def test_the_part_of_a_batch(fraction, tmp_path):
    buffer = make_buffer(1000, demonstration_fraction=fraction)
    observations, actions, _ = recording(20)
    buffer.add_trajectory(observations, actions, np.ones(20), True, False, 0.1)
    assert (buffer.sample(32).rewards > 0).all()  # there is nothing else
    for _ in range(3):
        add_experience(buffer, -1.0)
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    for one in (buffer, load_from_pkl(tmp_path / "buffer.pkl")):
        rewards = one.sample(32).rewards
        assert rewards.shape == (32, 1)
        assert (rewards > 0).sum() == 32 * fraction
        assert (rewards == -1.0).sum() == 32 * (1 - fraction)


def test_dictionaries_and_pictures():
    space = spaces.Dict({"image": spaces.Box(0, 255, (3, 4, 5), np.uint8), "count": STEPS})
    buffer = make_buffer(space=space)
    observations, actions, rewards = recording(20)
    pictures = np.zeros((21, 4, 5, 3), np.uint8)  # channels last, as a camera has them
    pictures[..., 1] = np.arange(21)[:, None, None]
    result = buffer.add_trajectory({"image": pictures, "count": observations}, actions, rewards, True, False, 0.1)
    assert result.added > 10
    for row in demonstrations(buffer):
        first = int(buffer.observations["count"][row, 0, 0])
        assert (buffer.observations["image"][row, 0, 1] == first).all()
        assert (buffer.observations["image"][row, 0, [0, 2]] == 0).all()
    with pytest.raises(ValueError, match=r"dictionary of \['count', 'image'\], not a dictionary of \['count'\]"):
        buffer.add_trajectory({"count": observations}, actions, rewards, True, False, 0.1)


def walk(env, seed):
    """A recording of somebody who goes to 0."""
    obs, _ = env.reset(seed=seed)
    observations, actions, rewards = [obs], [], []
    done = False
    while not done:
        actions.append(np.clip([-2.0 * obs[0]], -2.0, 2.0))
        obs, reward, terminated, done, _ = env.step(actions[-1])
        observations.append(obs)
        rewards.append(reward)
    return np.array(observations), np.array(actions), np.array(rewards), terminated, done, env.dt


def test_ctco_learns_with_demonstrations_by_fast_updates(random_walk_env, tmp_path):
    model = CTCO(
        "MlpPolicy",
        random_walk_env(),
        learning_starts=20,
        batch_size=32,
        policy_kwargs={"net_arch": [16]},
        replay_buffer_kwargs={"demonstration_fraction": 0.75},
        buffer_size=500,
        seed=0,
    )
    for seed in range(3):
        assert model.replay_buffer.add_trajectory(*walk(random_walk_env(), seed)).refused == 0
    count = model.replay_buffer.n_demonstrations
    model.learn(200)
    assert model.fast_updates_refusal is None
    assert model.replay_buffer.n_demonstrations == count
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = CTCO.load(tmp_path / "model.zip")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.replay_buffer.n_demonstrations == count
    loaded.set_env(random_walk_env())
    loaded.learn(50, reset_num_timesteps=False)
    # A loaded model's new buffer knows what options mean, and keeps the share
    fresh = CTCO.load(tmp_path / "model.zip").replay_buffer
    assert fresh.add_trajectory(*walk(random_walk_env(), 0)).added > 10
    assert fresh.demonstration_fraction == 0.75


def test_without_demonstrations_batches_are_what_they_were():
    buffer = make_buffer(100)
    for value in range(30):
        add_experience(buffer, float(value))
    np.random.seed(0)
    batch = buffer.sample(16)
    np.random.seed(0)
    rows = np.random.randint(0, 30, size=16)
    th.testing.assert_close(batch.rewards[:, 0], th.tensor(rows, dtype=th.float32))


class Episodes:
    """What of a Minari dataset is used."""

    def __init__(self, *episodes):
        self.episodes = episodes

    def iterate_episodes(self):
        return iter(self.episodes)


def test_minari_datasets_are_read():
    observations, actions, rewards = recording(20)
    no, last = np.zeros(20, bool), np.arange(20) == 19
    common = {"observations": observations, "actions": actions, "rewards": rewards.tolist()}
    episodes = [SimpleNamespace(terminations=last, truncations=no, **common)]
    episodes += [SimpleNamespace(terminations=no, truncations=last, **common)]
    trajectories = list(minari_trajectories(Episodes(*episodes), dt=0.1))
    assert [(t.terminated, t.truncated, t.dt) for t in trajectories] == [(True, False, 0.1), (False, True, 0.1)]
    buffer = make_buffer()
    assert buffer.add_trajectory(*trajectories[0]).added > 10


def test_a_minari_dataset_that_a_script_recorded(tmp_path):
    """With minari itself, by the example that makes a dataset from SAC."""
    script = Path(__file__).parents[1] / "examples" / "record_demonstrations.py"
    arguments = ["--env", "Pendulum-v1", "--steps", "300", "--episodes", "2", "--dataset", "pendulum/sac-v0"]
    environment = {**os.environ, "MINARI_DATASETS_PATH": str(tmp_path), "PYTHONPATH": str(script.parents[1])}
    command = [sys.executable, str(script), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd=tmp_path)
    assert "pendulum/sac-v0: 2 episodes" in result.stdout
    os.environ["MINARI_DATASETS_PATH"] = str(tmp_path)
    try:
        trajectories = list(minari_trajectories("pendulum/sac-v0", dt=0.05))
    finally:
        del os.environ["MINARI_DATASETS_PATH"]
    model = CTCO("MlpPolicy", "Pendulum-v1", buffer_size=5000)
    results = [model.replay_buffer.add_trajectory(*trajectory) for trajectory in trajectories]
    assert [len(trajectory.rewards) for trajectory in trajectories] == [200, 200]
    assert all(0 < result.added <= 200 for result in results)


@pytest.mark.parametrize("one_file_an_episode", [True, False])
def test_lerobot_datasets_are_read(tmp_path, one_file_an_episode):
    """Versions 2 and 3 of the format: frames of episodes of 6, 4 and 1, the latter two of which are not done."""
    import pyarrow
    from pyarrow import parquet

    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text('{"fps": 20}')
    folder = tmp_path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    episode, frame = np.array([0] * 6 + [1] * 4 + [2]), np.array([*range(6), *range(4), 0])
    order = np.array([3, 1, 2, 0, *range(4, 11)])  # rows need not be in order
    vectors = pyarrow.list_(pyarrow.float32(), 2)
    columns = {
        "episode_index": pyarrow.array(episode[order]),
        "frame_index": pyarrow.array(frame[order]),
        "observation.state": pyarrow.array([[10 * episode[k] + frame[k], 0.5] for k in order], vectors),
        "action": pyarrow.array([[0.1 * frame[k], 0.0] for k in order], pyarrow.list_(pyarrow.float32())),
        "next.reward": pyarrow.array((1.0 + frame[order]).astype(np.float32)),
        "next.done": pyarrow.array((frame[order] == 5).tolist()),
    }
    table = pyarrow.table(columns)
    if one_file_an_episode:
        parquet.write_table(table.slice(0, 6), folder / "episode_000000.parquet")
        parquet.write_table(table.slice(6), folder / "episode_000001.parquet")
    else:
        parquet.write_table(table, folder / "file-000.parquet")
    first, second = lerobot_trajectories(tmp_path)
    np.testing.assert_array_equal(first.observations[:, 0], [0, 1, 2, 3, 4, 5, 5])  # the last stands in for none
    np.testing.assert_array_equal(first.rewards, [1, 2, 3, 4, 5, 6])
    np.testing.assert_allclose(first.actions[:, 0], 0.1 * np.arange(6), rtol=1e-6)
    assert (first.terminated, first.truncated, first.dt) == (True, False, 0.05)
    np.testing.assert_array_equal(second.observations[:, 0], [10, 11, 12, 13])
    np.testing.assert_array_equal(second.rewards, [1, 2, 3])
    assert (second.terminated, second.truncated) == (False, True)
    first, _ = lerobot_trajectories(tmp_path, {"state": "observation.state"}, lambda obs, actions: obs["state"][1:, 0], False)
    np.testing.assert_array_equal(first.rewards, [1, 2, 3, 4, 5])
    assert (first.terminated, first.truncated) == (False, True)
    with pytest.raises(ValueError, match=r"no column observation.images.front, and has .*videos"):
        next(lerobot_trajectories(tmp_path, "observation.images.front"))
    with pytest.raises(FileNotFoundError, match=r"meta/info\.json"):
        next(lerobot_trajectories(tmp_path / "data"))


@pytest.mark.parametrize(("kind", "join"), [("vector", "continuous"), ("dict", "continuous"), ("dict", "smooth")])
def test_stretches_leave_from_the_action_before_them(kind, join):
    space = OptionSpace.make(2, 0.5, 0.1, 0.1, TAU, "bezier", join=join)
    bare = STEPS if kind == "vector" else spaces.Dict({"q": STEPS})
    buffer = make_buffer(space=with_last_action_space(bare, 2 * space.n_before))
    buffer.option_space = space
    observations, actions, rewards = recording(40)
    added = buffer.add_trajectory(
        observations if kind == "vector" else {"q": observations}, actions, rewards, False, True, 0.1
    )
    assert added.added > 30
    sent = np.vstack([np.zeros((2, 2)), actions / [2.0, 0.5] - [0.0, 1.0]])
    before, sent = space.before(sent), sent[1:]
    for row in demonstrations(buffer):
        stored = buffer.observations if kind == "vector" else buffer.observations["q"]
        first = int(stored[row, 0, 0])
        last = buffer.observations[row, 0, 1:] if kind == "vector" else buffer.observations["last_action"][row, 0]
        np.testing.assert_allclose(last, before[first], atol=1e-6)
        plan = space.plan(buffer.actions[row, 0].astype(np.float64), before[first])
        assert np.abs(plan - sent[first + 1 : first + 1 + len(plan)]).max() <= added.largest_residual + 1e-6
    with pytest.raises(ValueError, match="n actions, n rewards and n \\+ 1 observations"):
        wrong = observations[:-1] if kind == "vector" else {"q": observations[:-1]}
        buffer.add_trajectory(wrong, actions, rewards, False, True, 0.1)


def test_a_loaded_buffer_has_the_share_that_the_model_was_given(tmp_path, random_walk_env):
    CTCO("MlpPolicy", random_walk_env(), buffer_size=50).save_replay_buffer(tmp_path / "buffer")
    model = CTCO("MlpPolicy", random_walk_env(), replay_buffer_kwargs={"demonstration_fraction": 0.75})
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.demonstration_fraction == 0.75
