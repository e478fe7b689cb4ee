"""Videos of primitive steps."""

import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_ctco import OptionExecutionWrapper
from sb3_ctco.video import RecordEpisodes

ROOT = Path(__file__).parents[1]


class Canvas(gym.Env):
    """Draws its clock."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, dt=0.002, last=500, fail=False, render_mode="rgb_array"):
        self.dt, self.last, self.fail, self.render_mode = dt, last, fail, render_mode
        self.rendered_at = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        self.rendered_at = []
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.zeros(1, np.float32), 0.0, False, self.count == self.last, {}

    def step_sequence(self, actions, observe=()):
        raise AssertionError("a recorder must see each step")

    def render(self):
        if self.fail:
            raise RuntimeError("no OpenGL")
        self.rendered_at.append(self.count)
        return np.full((64, 64, 3), self.count % 255, np.uint8)


def play(env):
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        done = terminated or truncated


def duration_and_fps(file):
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(file))
    about = next(reader)
    n_frames = sum(1 for _ in reader)
    return n_frames, about["fps"]


@pytest.mark.parametrize(("dt", "last", "fps", "every"), [(0.002, 500, 25.0, 20), (0.02, 50, 50.0, 1), (0.05, 20, 25.0, 1)])
def test_frames_are_those_of_the_video_whatever_the_rate(tmp_path, dt, last, fps, every):
    pytest.importorskip("moviepy")
    env = RecordEpisodes(Canvas(dt, last), tmp_path, fps)
    play(OptionExecutionWrapper(env, d_max=0.3))
    assert env.unwrapped.rendered_at == list(range(0, last + 1, every))
    assert env.files == [tmp_path / "episode-0.mp4"]
    assert duration_and_fps(env.files[0]) == (last // every + 1, pytest.approx(min(fps, 1 / dt)))


def test_earlier_videos_stay(tmp_path):
    pytest.importorskip("moviepy")
    for number in range(2):
        env = RecordEpisodes(Canvas(0.05, 3), tmp_path)
        play(env)
        assert env.files == [tmp_path / f"episode-{number}.mp4"]


def test_without_moviepy_it_says_so_before_the_first_episode(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "moviepy.video.io.ImageSequenceClip", None)
    with pytest.raises(ImportError, match=r"a video needs moviepy: .* pip install '.\[render\]'"):
        RecordEpisodes(Canvas(), tmp_path)


def test_an_episode_a_file_and_a_progress_bar(tmp_path, capsys):
    pytest.importorskip("moviepy")
    env = RecordEpisodes(Canvas(0.02, 30), tmp_path / "new", name="run", progress=True)
    wrapped = OptionExecutionWrapper(env, d_max=0.2)
    play(wrapped)
    wrapped.reset()
    wrapped.step(np.ones(3))
    wrapped.close()
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["run-0.mp4", "run-1.mp4"]
    assert "filming" in capsys.readouterr().err


def test_refusals(tmp_path):
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        RecordEpisodes(Canvas(render_mode=None), tmp_path)
    with pytest.raises(ValueError, match="fps must be positive, not 0"):
        RecordEpisodes(Canvas(), tmp_path, fps=0)
    with pytest.raises(ValueError, match="pass dt"):
        RecordEpisodes(Canvas(dt=None), tmp_path)
    with pytest.raises(RuntimeError, match=r"could not render: no OpenGL.*MUJOCO_GL=egl"):
        RecordEpisodes(Canvas(fail=True), tmp_path).reset()


@pytest.mark.slow
def test_without_a_display_watch_says_what_to_set(tmp_path):
    """With a backend that cannot be had here, whatever this machine has."""
    pytest.importorskip("dm_control")
    from sb3_ctco import CTCO

    CTCO("MlpPolicy", gym.make("sb3_ctco/point_mass-easy-v0"), policy_kwargs={"net_arch": [8]}).save(tmp_path / "model")
    env = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
    command = [sys.executable, str(ROOT / "examples" / "watch.py"), "model.zip", "--env", "sb3_ctco/point_mass-easy-v0"]
    result = subprocess.run(
        [*command, "--env-kwargs", "sparse:True", "time_limit:0.1"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**env, "MUJOCO_GL": "glfw"},
        check=False,
    )
    assert result.returncode != 0
    assert "MUJOCO_GL=egl" in result.stderr.splitlines()[-1]


@pytest.mark.slow
def test_watch_films_the_task_that_its_arguments_name(tmp_path, opengl):
    pytest.importorskip("moviepy")
    from sb3_ctco import CTCO

    bare = gym.make("sb3_ctco/point_mass-easy-v0", dt=0.002, sparse=True)
    CTCO("MlpPolicy", bare, policy_kwargs={"net_arch": [8]}).save(tmp_path / "model")
    command = [sys.executable, str(ROOT / "examples" / "watch.py"), "model.zip", "--env", "sb3_ctco/point_mass-easy-v0"]
    command += ["--rate", "500", "--env-kwargs", "sparse:True", "time_limit:1.0", "--fps", "20"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert re.search(r"return 0\.0|return [0-9]", result.stdout)
    assert duration_and_fps(tmp_path / "watch" / "episode-0.mp4") == (21, 20.0)


def test_an_episode_that_nobody_played_has_no_video(tmp_path):
    """A VecEnv resets once more at the end of the last episode."""
    env = RecordEpisodes(Canvas(last=50), tmp_path)
    play(env)
    env.reset()
    env.close()
    assert [file.name for file in env.files] == ["episode-0.mp4"]
