"""The arm's kinematics, the reward, resets, pictures, and how hard the task is to explore."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import SAC

from sb3_ctco import CTCO
from sb3_ctco.envs.visual_reacher import VisualReacherEnv, servo_action
from sb3_ctco.envs.visual_reacher.env import BAG_AREA, JOINT_MARGIN, START_POSE, WORKSPACE, bag_visibility
from sb3_ctco.envs.visual_reacher.model import JOINT_LIMITS
from sb3_ctco.study.agents import constructor_arguments
from sb3_ctco.study.grid import load_preset
from sb3_ctco.study.runs import Outcome, perform, plan
from sb3_ctco.torch_layers import SpatialSoftmaxExtractor
from sb3_ctco.wrappers import OptionExecutionWrapper, SupportsStepSequence, find_dt

pytestmark = pytest.mark.usefixtures("opengl")


@pytest.fixture
def env():
    made = VisualReacherEnv()
    yield made
    made.close()


def dh_transform(a, alpha, d, theta):
    """From frame i to frame i − 1 in Craig's convention."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]])


def flange_by_dh(q):
    half_turn = np.pi / 2
    rows = [
        (0, 0, 0.333),
        (0, -half_turn, 0),
        (0, half_turn, 0.316),
        (0.0825, half_turn, 0),
        (-0.0825, -half_turn, 0.384),
        (0, half_turn, 0),
        (0.088, half_turn, 0),
    ]
    pose = np.eye(4)
    for row, theta in zip(rows, q, strict=True):
        pose = pose @ dh_transform(*row, theta)
    return pose @ dh_transform(0, 0, 0.107, 0)


def place(env, q):
    """Put the arm at a pose and look at the result, without a command."""
    env._data.qpos[:] = q
    env._velocity[:] = 0
    import mujoco

    mujoco.mj_kinematics(env._model, env._data)
    env._take_picture()


def test_forward_kinematics_is_the_product_of_denavit_hartenberg_transforms(env):
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for q in [np.zeros(7), START_POSE, *rng.uniform(*JOINT_LIMITS, (20, 7))]:
        place(env, q)
        pose = flange_by_dh(q)
        site = env._data.site("flange")
        np.testing.assert_allclose(site.xpos, pose[:3, 3], atol=1e-6)
        # The hand is mounted at −45° about the flange's axis.
        mounting = dh_transform(0, 0, 0, -np.pi / 4)
        np.testing.assert_allclose(site.xmat.reshape(3, 3), (pose @ mounting)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(env.end_effector_position, (pose @ [0, 0, 0.1034, 1])[:3], atol=1e-6)
        camera, axes = env.camera_pose()
        np.testing.assert_allclose(camera, (pose @ mounting @ [0.07, 0, 0.03, 1])[:3], atol=1e-6)
        np.testing.assert_allclose(-axes[:, 2], pose[:3, 2], atol=1e-6)


def test_jacobian_is_the_derivative_of_the_kinematics(env):
    env.reset(seed=0)
    translation, rotation = env.jacobian(env.end_effector_position)
    q, before, axes_before = env.joint_positions, env.end_effector_position, env.camera_pose()[1]
    for i in range(7):
        moved = q.copy()
        moved[i] += 1e-6
        place(env, moved)
        np.testing.assert_allclose((env.end_effector_position - before) / 1e-6, translation[:, i], atol=1e-5)
        turned = (env.camera_pose()[1] - axes_before) / 1e-6
        np.testing.assert_allclose(np.cross(rotation[:, i], axes_before, axisb=0).T, turned, atol=1e-5)


def test_visibility_of_hand_made_pictures():
    assert bag_visibility(np.zeros((60, 80, 3), np.uint8)) == 0
    red = np.zeros((60, 80, 3), np.uint8)
    red[:, :, 0] = 200
    # ∫(0.5 − |p|) dp over the whole side is 1/4.
    assert bag_visibility(red) == pytest.approx(1 / 16)
    left = red.copy()
    left[:, 40:] = 0
    assert bag_visibility(left) == pytest.approx(1 / 32)
    one = np.zeros((60, 80, 3), np.uint8)
    one[30, 40] = 200, 10, 10
    # The centre of this pixel is at (0.5/80, 0.5/60).
    assert bag_visibility(one) == pytest.approx((0.5 - 0.5 / 80) * (0.5 - 0.5 / 60) / 4800)
    for colour, is_red in {(61, 30, 30): 1, (60, 0, 0): 0, (200, 100, 0): 0, (201, 100, 100): 1, (200, 0, 100): 0}.items():
        one[30, 40] = colour
        assert (bag_visibility(one) > 0) == is_red, colour


def test_arm_follows_velocities_and_observation_says_so(env):
    start = env.reset(seed=3)[0]["proprioception"]
    np.testing.assert_allclose(start[:7], START_POSE, atol=0.021)
    assert not start[7:].any()
    action = np.array([0.1, -0.2, 0.05, 0.0, 0.2, -0.1, 0.15], np.float32)
    obs = env.step(action)[0]["proprioception"]
    assert obs.dtype == np.float32
    np.testing.assert_allclose(obs[:7], start[:7] + 0.02 * action, atol=1e-6)
    np.testing.assert_allclose(obs[7:14], action)
    np.testing.assert_allclose(obs[14:], action)
    obs = env.step(np.full(7, 9.0))[0]["proprioception"]
    np.testing.assert_allclose(obs[7:], 0.2)


def test_end_effector_is_led_back_into_its_box(env):
    env.reset(seed=0)
    rng = np.random.default_rng(1)
    overruled = 0
    for _ in range(8):
        env.reset()
        for action in rng.uniform(-0.2, 0.2, (8, 7)):
            for _ in range(50):
                before = np.clip(env.end_effector_position, *WORKSPACE) - env.end_effector_position
                obs = env.step(action)[0]["proprioception"]
                after = np.clip(env.end_effector_position, *WORKSPACE) - env.end_effector_position
                assert np.abs(after).max() < 0.01
                if before.any():
                    overruled += 1
                    assert np.linalg.norm(after) < np.linalg.norm(before)
                    assert not np.allclose(obs[7:14], obs[14:])
                    assert np.abs(obs[7:14]).max() <= 0.2 + 1e-6
    assert overruled > 20


def test_return_speed_is_five_centimetres_a_second(env):
    env.reset(seed=0)
    place(env, START_POSE + np.array([0, 0, 0, 0.45, 0, 0, 0]))
    before = env.end_effector_position
    inward = np.clip(before, *WORKSPACE) - before
    assert inward.any()
    env.step(np.zeros(7))
    moved = (env.end_effector_position - before) / env.dt
    np.testing.assert_allclose(moved, 0.05 * inward / np.linalg.norm(inward), atol=1e-3)


def test_joints_are_led_back_from_their_limits(env):
    env.reset(seed=0)
    for sign, limit in ((-1, JOINT_LIMITS[0, 6]), (1, JOINT_LIMITS[1, 6])):
        q = START_POSE.copy()
        q[6] = limit - sign * (JOINT_MARGIN + 0.01)
        place(env, q)
        for _ in range(150):
            env.step(np.array([0, 0, 0, 0, 0, 0, sign * 0.2]))
        distance = sign * (limit - env.joint_positions[6])
        assert JOINT_MARGIN - 0.005 < distance < JOINT_MARGIN + 0.005
        env.reset()


def test_easy_bag_fills_its_area_and_hard_bag_its_corners():
    centre = BAG_AREA.mean(axis=0)
    positions = {}
    for difficulty in ("easy", "hard"):
        env = VisualReacherEnv(difficulty)
        env.reset(seed=0)
        positions[difficulty] = np.array([[*env._draw_bag_position()] for _ in range(2000)])
        env.close()
        assert (positions[difficulty] >= BAG_AREA[0]).all()
        assert (positions[difficulty] <= BAG_AREA[1]).all()
    relative = {key: (p - centre) / (0.5 * (BAG_AREA[1] - BAG_AREA[0])) for key, p in positions.items()}
    counts, _, _ = np.histogram2d(*relative["easy"].T, bins=4, range=[[-1, 1], [-1, 1]])
    assert counts.min() > 80
    counts, _, _ = np.histogram2d(*relative["hard"].T, bins=4, range=[[-1, 1], [-1, 1]])
    corners = counts[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert corners.min() > 300
    assert counts[1:3, 1:3].sum() < 200


def test_image_is_taken_at_25_hz_and_repeated():
    for dt, expected in ((0.02, [0, 1, 0, 1, 0, 1]), (0.01, [0, 0, 0, 1, 0, 0, 0, 1]), (0.04, [1, 1, 1]), (0.1, [1, 1])):
        env = VisualReacherEnv(dt=dt)
        image = env.reset(seed=0)[0]["image"]
        for fresh in expected:
            following = env.step(np.array([0.2, 0.2, 0, 0, 0, 0, 0.2]))[0]["image"]
            assert (following != image).any() == bool(fresh), dt
            image = following
        env.close()


def test_reward_is_that_of_the_picture_and_of_the_definition(env):
    paid = set()
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(200):
            obs, reward, terminated, _, info = env.step(servo_action(env))
            assert info["bag_visibility"] == bag_visibility(obs["image"])
            assert reward == (info["bag_visibility"] >= 0.015)
            assert not terminated
            paid.add(reward)
    assert paid == {0.0, 1.0}


def test_playing_a_sequence_is_stepping_in_a_loop():
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (401, 7)).astype(np.float32)
    actions[:, :] = np.repeat(actions[::50], 50, axis=0)[:401]
    one, other = VisualReacherEnv(), VisualReacherEnv()
    assert isinstance(one, SupportsStepSequence)
    for seed in range(3):
        one.reset(seed=seed)
        other.reset(seed=seed)
        lengths = [1, 7, 50, 342]
        position = 0
        for n in lengths:
            observe = [k for k in (1, 4, 6, 40, 200) if k < n]
            obs, rewards, terminated, truncated, info = one.step_sequence(actions[position : position + n], observe)
            between = info.pop("observations", [])
            singles = [other.step(a) for a in actions[position : position + n]]
            position += n
            np.testing.assert_array_equal(obs["image"], singles[-1][0]["image"])
            np.testing.assert_array_equal(obs["proprioception"], singles[-1][0]["proprioception"])
            assert list(rewards) == [s[1] for s in singles]
            assert (terminated, truncated) == singles[-1][2:4]
            assert info == singles[-1][4]
            for k, seen in zip(observe, between, strict=True):
                for key, value in singles[k - 1][0].items():
                    np.testing.assert_array_equal(seen[key], value)
        assert truncated
        with pytest.raises(ResetNeeded, match="reset"):
            one.step_sequence(actions[:1])
    one.close()
    other.close()


def test_episode_is_truncated_after_eight_seconds_at_any_rate():
    for dt, n in ((0.02, 400), (0.01, 800), (0.05, 160)):
        env = VisualReacherEnv(dt=dt)
        assert find_dt(env) == dt
        env.reset(seed=0)
        _, rewards, terminated, truncated, _ = env.step_sequence(np.zeros((n + 5, 7)))
        assert (len(rewards), terminated, truncated) == (n, False, True)
        env.close()


def test_same_seed_same_pixels():
    def play(seed):
        env = VisualReacherEnv("hard")
        frames = [env.reset(seed=seed)[0]["image"]]
        for k in range(150):
            frames.append(env.step(np.array([0.2, 0.1, 0, -0.1, 0, 0, 0.2]) * (-1) ** (k // 40))[0]["image"])
        env.close()
        return np.array(frames)

    first = play(7)
    np.testing.assert_array_equal(first, play(7))
    assert (first != play(8)).any()


def test_closing_one_environment_leaves_the_pictures_of_another():
    first, second = VisualReacherEnv(render_mode="rgb_array"), VisualReacherEnv(render_mode="rgb_array")
    expected = second.reset(seed=5)[0]["image"]
    view = second.render()
    first.reset(seed=6)
    first.render()
    second.step(np.zeros(7))
    # The second environment's context is current at this point.
    first.close()
    np.testing.assert_array_equal(second.reset(seed=5)[0]["image"], expected)
    np.testing.assert_array_equal(second.render(), view)
    assert len(np.unique(expected.reshape(-1, 3), axis=0)) > 2
    with pytest.raises(RuntimeError, match="closed"):
        first.reset(seed=0)
    first.close()
    second.close()


def test_wrist_camera_sees_fingers_table_and_bag(env):
    seen = 0
    for seed in range(10):
        image = env.reset(seed=seed)[0]["image"]
        assert (image[-3:].max(axis=2) < 80).sum() > 10, "fingers at the lower edge"
        assert (image.min(axis=2) > 100).sum() > 2000, "table"
        seen += bag_visibility(image) > 0
    assert seen >= 5


def test_view_from_outside():
    env = VisualReacherEnv(render_mode="rgb_array", width=200, height=120)
    env.reset(seed=0)
    before = env.render()
    assert before.shape == (120, 200, 3)
    assert before.dtype == np.uint8
    assert ((before[:, :, 0] > 60) & (before[:, :, 0] > 2 * before[:, :, 1].astype(int))).sum() > 20, "the bag"
    env.step_sequence(np.tile([0.2, 0, 0, 0, 0, 0, 0], (100, 1)))
    assert (before != env.render()).any()
    env.close()
    still = VisualReacherEnv()
    assert still.render() is None
    still.close()


def test_moving_bag_stays_on_its_area_and_keeps_its_speed():
    env = VisualReacherEnv(bag_speed=0.1)
    env.reset(seed=0)
    positions = [env.bag_position[:2]]
    for _ in range(400):
        env.step(np.zeros(7))
        positions.append(env.bag_position[:2])
    env.close()
    positions = np.array(positions)
    assert (positions >= BAG_AREA[0]).all()
    assert (positions <= BAG_AREA[1]).all()
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 0.02
    assert np.median(speeds) == pytest.approx(0.1)
    assert (np.abs(speeds - 0.1) > 1e-6).sum() < 20, "slower only where a step is reflected"


def test_registered_and_valid():
    for difficulty in ("easy", "hard"):
        made = gym.make(f"sb3_ctco/visual_reacher-{difficulty}-v0", dt=0.04)
        assert made.unwrapped.difficulty == difficulty
        assert made.unwrapped.dt == 0.04
        check_env(made.unwrapped, skip_render_check=True)
        made.close()


def test_options_play_by_sequences():
    wrapped = OptionExecutionWrapper(gym.make("sb3_ctco/visual_reacher-easy-v0"), n_rbf=2, d_max=1.0)
    wrapped.reset(seed=0)
    obs, _, _, _, info = wrapped.step(np.ones(15))
    assert info["option"]["n_steps"] == 50
    np.testing.assert_allclose(obs["proprioception"][14:], 0.2, atol=1e-6)
    wrapped.close()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"difficulty": "medium"}, "'easy' or 'hard', not 'medium'"),
        ({"dt": 0.0}, "dt must be a positive number of seconds, not 0.0"),
        ({"time_limit": float("inf")}, "time_limit must be a positive number of seconds, not inf"),
        ({"bag_speed": -1.0}, "at least 0, not -1.0"),
        ({"render_mode": "human"}, "None or 'rgb_array', not 'human'"),
        ({"width": 0}, "at least 1 pixel, not 0"),
    ],
)
def test_errors_name_the_value(kwargs, message):
    with pytest.raises(ValueError, match=message):
        VisualReacherEnv(**kwargs)


@pytest.mark.parametrize(
    ("backend", "hide", "message"),
    [("off", "", "MUJOCO_GL=off switches rendering off"), ("", "libEGL libOSMesa", "no display and neither libEGL")],
)
def test_without_headless_opengl_the_error_says_what_to_install(backend, hide, message):
    code = f"""
import ctypes
load = ctypes.CDLL.__init__
def hidden(self, name, *args, **kwargs):
    if any(part in str(name) for part in {hide.split()!r}):
        raise OSError(name)
    load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = hidden
from stable_baselines3 import SAC

from sb3_ctco import CTCO
from sb3_ctco.envs.visual_reacher import VisualReacherEnv
try:
    VisualReacherEnv()
except RuntimeError as error:
    print(error)
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
    if backend:
        environment["MUJOCO_GL"] = backend
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert message in result.stdout, result.stderr
    assert "apt-get install libegl1" in result.stdout


def test_pictures_without_a_display_need_no_setting_and_leave_quietly():
    code = """
from stable_baselines3 import SAC

from sb3_ctco import CTCO
from sb3_ctco.envs.visual_reacher import VisualReacherEnv
env = VisualReacherEnv()
print(env.reset(seed=0)[0]["image"].max() > 0)
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert result.stdout.strip() == "True", result.stderr
    assert "Error" not in result.stderr


def finds_reward(n_episodes, hold_seconds, seed=0):
    """The share of easy episodes in which random actions, each held for a while, meet a reward."""
    env = VisualReacherEnv()
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    hold, found = round(hold_seconds / env.dt), 0
    for _ in range(n_episodes):
        env.reset()
        truncated, rewarded = False, False
        while not (truncated or rewarded):
            _, rewards, _, truncated, _ = env.step_sequence(np.tile(rng.uniform(-0.2, 0.2, 7), (hold, 1)))
            rewarded = rewards.any()
        found += rewarded
    env.close()
    return found / n_episodes


@pytest.mark.slow
def test_white_noise_does_not_find_the_reward():
    assert finds_reward(100, 0.02) <= 0.03


@pytest.mark.slow
@pytest.mark.parametrize("hold_seconds", [0.5, 2.0])
def test_held_actions_find_the_reward(hold_seconds):
    assert finds_reward(200, hold_seconds) >= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", ["easy", "hard"])
def test_oracle_finds_the_reward(difficulty):
    env = VisualReacherEnv(difficulty)
    env.reset(seed=0)
    first_hits = []
    for _ in range(40):
        env.reset()
        for k in range(400):
            if env.step(servo_action(env))[1]:
                first_hits.append(k * env.dt)
                break
    env.close()
    assert len(first_hits) >= 0.95 * 40
    assert 1.0 < np.median(first_hits) < 3.0


@pytest.mark.slow
def test_speed():
    env = VisualReacherEnv()
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (400, 7)).astype(np.float32)
    rates = []
    for _ in range(5):
        env.reset()
        start = time.process_time()
        for action in actions:
            env.step(action)
        rates.append(400 / (time.process_time() - start))
    env.close()
    # Time of the processor, over all threads: other programs on the machine do not count.
    assert max(rates) >= 2500


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["sub-options", "plain", "same"])
def test_the_experiment_is_a_study(tmp_path, setting):
    preset = load_preset(str(Path(__file__).parents[1] / "benchmarks" / "visual_reacher.yml"))
    (run,) = preset.select(tasks=["visual_reacher_hard"], settings=[setting], seeds=[3])
    shorter = {"learning_starts_seconds": 8, "buffer_size": 1000}
    run = dataclasses.replace(run, task_seconds=16.0, eval_episodes=1, arguments={**run.arguments, **shorter})
    plan([run], tmp_path)
    assert perform(run, tmp_path) == Outcome(run.name, "done")
    record = json.loads((tmp_path / run.name / "record.json").read_text())
    assert 28 <= record["updates"] <= 36  # four a second, after the warm-up
    model = {"ctco": CTCO, "sac": SAC}[run.algorithm].load(tmp_path / run.name / "model.zip", device="cpu")
    assert type(model.policy.actor.features_extractor) is SpatialSoftmaxExtractor


def test_an_encoder_that_is_not_there_is_named():
    preset = load_preset(str(Path(__file__).parents[1] / "benchmarks" / "visual_reacher.yml"))
    run = preset.runs[0]
    run.arguments["policy_kwargs"]["features_extractor_class"] = "sb3_ctco.torch_layers.Softmax"
    with pytest.raises(ValueError, match=r"no features_extractor_class sb3_ctco\.torch_layers\.Softmax; give its full name"):
        constructor_arguments(run)
