"""Videos of primitive steps, which options hide from recorders that see decisions."""

import math
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from sb3_ctco.wrappers import find_dt
from sb3_ctco.wrappers.checks import reset_env


class RecordEpisodes(gym.Wrapper, RecordConstructorArgs):
    """Film episodes in task time, rendering only the frames that the video shows.

    It belongs inside the wrapper that plays options, where each primitive step is seen; the environment is then stepped
    one step after the other, without ``step_sequence``::

        env = model.wrap_env(RecordEpisodes(gym.make("Pendulum-v1", render_mode="rgb_array"), "videos"))
        evaluate_policy(model, env, n_eval_episodes=1)
        env.close()

    writes ``videos/episode-0.mp4``. Needs moviepy, and tqdm for the progress bar.

    :param env: an environment whose ``render_mode`` is ``"rgb_array"``
    :param folder: where the videos go
    :param fps: frames per second, at most one a step
    :param name: the files are ``<name>-<number>.mp4``, numbered from 0, or from where those of before end; environments side
        by side need a name each
    :param dt: interaction period, in s; by default what :func:`~sb3_ctco.wrappers.find_dt` finds
    :param progress: whether to show a progress bar of the frames
    :raises ValueError: for another render mode, or if ``dt`` is not given and not found
    :raises ImportError: without moviepy
    """

    def __init__(
        self,
        env: gym.Env,
        folder: str | Path,
        fps: float = 25.0,
        name: str = "episode",
        dt: float | None = None,
        progress: bool = False,
    ):
        RecordConstructorArgs.__init__(self, folder=folder, fps=fps, name=name, dt=dt, progress=progress)
        gym.Wrapper.__init__(self, env)
        if env.render_mode != "rgb_array":
            raise ValueError(f"a video needs gymnasium.make(..., render_mode='rgb_array'), not {env.render_mode!r}")
        dt = find_dt(env, required_by=type(self).__name__, given=dt)
        if not fps > 0:
            raise ValueError(f"fps must be positive, not {fps}")
        try:
            from moviepy.video.io.ImageSequenceClip import ImageSequenceClip
        except ImportError as error:
            raise ImportError("a video needs moviepy: in a clone of sb3-ctco, run pip install '.[render]'") from error
        self._clip = ImageSequenceClip
        self.folder, self.name, self.dt, self.progress = Path(folder), name, dt, progress
        self.fps = min(fps, 1.0 / dt)
        #: Files that were written
        self.files: list[Path] = []
        self._frames: list[Any] = []
        self._n_steps = 0
        self._bar: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and its video."""
        self._write()
        result = reset_env(self.env, seed, options)
        self._n_steps = 0
        if self.progress:
            from tqdm import tqdm

            limit = self.spec.max_episode_steps if self.spec is not None else None
            total = None if limit is None else 1 + math.floor(limit * self.dt * self.fps + 1e-6)
            self._bar = tqdm(total=total, unit=" frames", desc="filming")
        self._film()
        return result

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """One primitive step; the video is written at the end of the episode."""
        result = self.env.step(action)
        self._n_steps += 1
        # Frame k shows the time k/fps, as soon as it has come.
        if self._n_steps * self.dt * self.fps >= len(self._frames) - 1e-6:
            self._film()
        if result[2] or result[3]:
            self._write()
        return result

    def close(self) -> None:
        """Write what an episode that has not ended has, and close the environment."""
        try:
            self._write()
        finally:
            super().close()

    def _film(self) -> None:
        try:
            frame = self.env.render()
        except Exception as error:
            self._close_bar()
            raise RuntimeError(
                f"{self.env} could not render: {error}. Without a display, MuJoCo draws with MUJOCO_GL=egl (or osmesa), set "
                "before Python starts; on Debian, apt install libegl1 libgl1-mesa-dri"
            ) from error
        self._frames.append(frame)
        if self._bar is not None:
            self._bar.update()

    def _close_bar(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _write(self) -> None:
        self._close_bar()
        if not self._n_steps:  # of an episode that nobody played
            self._frames = []
        if not self._frames:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        number = len(self.files)
        while (file := self.folder / f"{self.name}-{number}.mp4").exists():  # of an earlier recording
            number += 1
        self._clip(self._frames, fps=self.fps).write_videofile(str(file), logger=None)
        self.files.append(file)
        self._frames = []
