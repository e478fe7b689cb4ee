"""The "Can I use?" tables of the algorithms' pages, tried line by line."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.export import export_onnx

DOCS = Path(__file__).parent.parent / "docs"
ALGORITHMS = {"ctco": CTCO}
VECTOR = spaces.Box(-1.0, 1.0, (2,), np.float32)
SPACES = {
    "Discrete": spaces.Discrete(3),
    "Box": VECTOR,
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
    "Dict": spaces.Dict({"a": VECTOR, "b": spaces.Discrete(2)}),
}
FEW = {"learning_starts": 10, "batch_size": 4, "buffer_size": 50, "d_max": 0.3, "policy_kwargs": {"net_arch": [8]}}


class SpacesEnv(gym.Env):
    """Random observations of a space, actions of another."""

    dt = 0.1

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.count += 1
        return self.observation_space.sample(), 1.0, False, self.count == 10, {}


def table(page: str, header: str) -> dict[str, list[str]]:
    """Rows of the table with that header, by their first cell."""
    lines = (DOCS / f"{page}.md").read_text().splitlines()
    rows = {}
    for line in lines[lines.index(header) + 2 :]:
        if not line.startswith("|"):
            break
        first, *others = (cell.strip() for cell in line.strip("|").split("|"))
        rows[first] = others
    return rows


@pytest.mark.parametrize("page", ALGORITHMS)
@pytest.mark.parametrize("kind", SPACES)
def test_spaces(page, kind):
    action, observation = table(page, "| Space | Action | Observation |")[kind]
    policy = "MultiInputPolicy" if kind == "Dict" else "MlpPolicy"
    assert observation.startswith("✓")
    ALGORITHMS[page](policy, SpacesEnv(SPACES[kind], VECTOR), **FEW).learn(30)
    if action.startswith("✓"):
        ALGORITHMS[page]("MlpPolicy", SpacesEnv(VECTOR, SPACES[kind]), **FEW).learn(30)
    else:
        with pytest.raises(TypeError, match="needs a Box action space"):
            ALGORITHMS[page]("MlpPolicy", SpacesEnv(VECTOR, SPACES[kind]), **FEW)


def test_actions_need_finite_bounds():
    assert "finite bounds" in table("ctco", "| Space | Action | Observation |")["Box"][0]
    with pytest.raises(ValueError, match="finite action bounds"):
        CTCO("MlpPolicy", SpacesEnv(VECTOR, spaces.Box(-np.inf, np.inf, (1,))), **FEW)


@pytest.mark.parametrize("page", ALGORITHMS)
def test_features(page, tmp_path):
    algorithm, rows = ALGORITHMS[page], table(page, "| | |")
    claimed = {re.sub(r" \(.*\)", "", name): cells[0].startswith("✓") for name, cells in rows.items()}
    env = SpacesEnv(VECTOR, VECTOR)

    model = algorithm("MlpPolicy", env, **FEW).learn(30)
    assert not claimed.pop("Recurrent policies")
    with pytest.raises(ValueError, match="Policy MlpLstmPolicy unknown"):
        algorithm("MlpLstmPolicy", env, **FEW)

    assert claimed.pop("Multi processing")
    venv = make_vec_env(
        lambda: SpacesEnv(VECTOR, VECTOR), 2, wrapper_class=OptionExecutionWrapper, wrapper_kwargs={"d_max": 0.3}
    )
    algorithm("MlpPolicy", venv, **FEW).learn(30)

    assert claimed.pop("Replay buffer")
    model.save_replay_buffer(tmp_path / "buffer")
    for refused in ({"n_steps": 3}, {"replay_buffer_class": HerReplayBuffer}, {"optimize_memory_usage": True}):
        with pytest.raises((TypeError, ValueError)):
            algorithm("MlpPolicy", env, **FEW, **refused)

    assert not claimed.pop("gSDE")
    with pytest.raises(ValueError, match="use_sde"):
        algorithm("MlpPolicy", env, **{**FEW, "policy_kwargs": {"use_sde": True}})

    assert "observations ✓, rewards ✗" in rows["VecNormalize"][0]
    claimed.pop("VecNormalize")
    wrapped = DummyVecEnv([lambda: OptionExecutionWrapper(env, d_max=0.3)])
    algorithm("MlpPolicy", VecNormalize(wrapped, norm_reward=False), **FEW).learn(30)
    with pytest.raises(ValueError, match="norm_reward=False"):
        algorithm("MlpPolicy", VecNormalize(wrapped), **FEW)

    assert claimed.pop("Saving, loading, continuing")
    model.save(tmp_path / "model")
    algorithm.load(tmp_path / "model", env=env).learn(10, reset_num_timesteps=False)

    assert claimed.pop("ONNX")
    export_onnx(model, tmp_path / "model.onnx")

    assert claimed.pop("RL Zoo")
    zoo = pytest.importorskip("sb3_ctco.zoo")
    assert zoo.ALGORITHMS[page] is algorithm
    assert not claimed, "lines of the table that are not tried here"
