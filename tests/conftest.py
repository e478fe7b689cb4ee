"""Stub environments with scripted rewards, whose every number can be worked out by hand."""

import os
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

# Several processes of the suite share the cores.
th.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")

#: How long tests wait for other processes, in s: not how fast these should be, but the end of a hang, however loaded the
#: machine is
PATIENCE = float(os.environ.get("TEST_PATIENCE", "900"))


class ScriptedEnv(gym.Env[np.ndarray, np.ndarray]):
    """Observes how many steps were made and the last action; pays ``rewards(step, action)``; ends where told.

    :param rewards: reward of the k-th step (from 0) of an episode
    :param terminate_at: the step count at which the episode terminates
    :param truncate_at: the step count at which it is truncated
    """

    metadata: dict[str, Any] = {}

    def __init__(
        self,
        rewards: Callable[[int, np.ndarray], float] = lambda step, action: 1.0,
        dt: float | None = 0.1,
        terminate_at: int | None = None,
        truncate_at: int | None = None,
        action_space: spaces.Space | None = None,
    ):
        if dt is not None:
            self.dt = dt
        self.rewards = rewards
        self.terminate_at, self.truncate_at = terminate_at, truncate_at
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Box(-1e6, 1e6, (2,), np.float32)
        self.actions: list[np.ndarray] = []
        self.count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.count = 0
        self.actions = []
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.actions.append(np.array(action))
        reward = self.rewards(self.count, action)
        self.count += 1
        return self._obs(), reward, self.count == self.terminate_at, self.count == self.truncate_at, {"count": self.count}

    def _obs(self) -> np.ndarray:
        last = float(np.ravel(self.actions[-1])[0]) if self.actions else 0.0
        return np.array([self.count, last], dtype=np.float32)


class RandomWalkEnv(gym.Env):
    """A point in [−1, 1] that actions push; 20 steps of 0.1 s an episode; any observation kind.

    :param kind: "vector", "image" or "dict"
    """

    metadata: dict[str, Any] = {}
    dt = 0.1

    def __init__(self, kind: str = "vector"):
        self.kind = kind
        vector = spaces.Box(-1.0, 1.0, (2,), np.float32)
        image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
        self.observation_space = {
            "vector": vector,
            "image": image,
            "dict": spaces.Dict({"image": image, "vector": vector}),
        }[kind]
        self.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.x, self.count = float(self.np_random.uniform(-1, 1)), 0
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.x = float(np.clip(self.x + 0.1 * float(action[0]), -1, 1))
        self.count += 1
        return self._obs(), -abs(self.x), False, self.count >= 20, {}

    def _obs(self) -> Any:
        vector = np.array([self.x, self.count / 20], dtype=np.float32)
        if self.kind == "vector":
            return vector
        image = np.full((3, 36, 36), int(127.5 * (self.x + 1)), dtype=np.uint8)
        return image if self.kind == "image" else {"image": image, "vector": vector}


class FakeClock:
    """Time passes when somebody sleeps, and when the test says so."""

    def __init__(self):
        self.time = 100.0
        self.slept = []

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.time += seconds


@pytest.fixture
def scripted_env() -> type[ScriptedEnv]:
    return ScriptedEnv


@pytest.fixture
def random_walk_env() -> type[RandomWalkEnv]:
    return RandomWalkEnv


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip a test where pictures cannot be made, but not with REQUIRE_OPENGL, where that is a failure."""
    from sb3_ctco.envs.visual_reacher import VisualReacherEnv

    try:
        VisualReacherEnv().close()
    except RuntimeError as error:  # it says what to install
        if "REQUIRE_OPENGL" in os.environ:
            raise
        pytest.skip(str(error))
