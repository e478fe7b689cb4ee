"""What must not mislead: files of other algorithms, buffers that do not fit, environments without a period, noise."""

import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC, TD3

from sb3_ctco import CTCO, DACPPO, FiGARSAC
from sb3_ctco.common import option_algorithm
from sb3_ctco.ctco import CTCOPolicy
from sb3_ctco.dac_ppo import DACPolicy
from sb3_ctco.figar_sac import FiGARSACPolicy

ROOT = Path(__file__).parents[1]


def small():
    """A dictionary of its own each time, because Stable-Baselines3 writes into policy_kwargs."""
    return {"policy_kwargs": {"net_arch": [8]}, "seed": 0}


@pytest.mark.parametrize("reader", [CTCO, FiGARSAC])
@pytest.mark.parametrize("writer", [SAC, TD3, PPO, DACPPO, CTCO, FiGARSAC])
def test_files_of_other_algorithms_are_refused_with_their_name(tmp_path, reader, writer):
    writer("MlpPolicy", "Pendulum-v1", **small()).save(tmp_path / "model")
    if reader is writer:
        assert type(reader.load(tmp_path / "model", env=gym.make("Pendulum-v1"))) is reader
        with (tmp_path / "model.zip").open("rb") as file:
            assert type(reader.load(file)) is reader
        return
    with pytest.raises(ValueError, match=rf"not saved by {reader.__name__}.*its policy is from (sb3_ctco|stable_baselines3)"):
        reader.load(tmp_path / "model", env=gym.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("algorithm", "policy"), [(CTCO, CTCOPolicy), (FiGARSAC, FiGARSACPolicy), (DACPPO, DACPolicy)], ids=lambda x: x.__name__
)
def test_policies_are_where_the_algorithms_are(algorithm, policy):
    assert type(algorithm(policy, "Pendulum-v1", **small()).policy) is policy


def test_a_buffer_that_does_not_fit_is_named(random_walk_env, monkeypatch):
    monkeypatch.setattr(option_algorithm, "_available_memory", lambda: 10_000)
    kwargs = {"n_sub_options": 4, "d_max": 0.5, **small()}
    with pytest.warns(UserWarning, match=r"buffer_size=1,000 plans 0\.0 GB.*pass a smaller one, [0-9]+ for half") as caught:
        CTCO("MlpPolicy", random_walk_env(), buffer_size=1_000, **kwargs)
    # A fifth of the rows may be decisions, of 0.1 to 0.5 s.
    assert "holds at least 200 decisions, 20 to 100 s of task time" in str(caught[0].message)


@pytest.mark.filterwarnings("error:.*buffer_size.*")
def test_a_buffer_that_fits_is_not(random_walk_env):
    CTCO("MlpPolicy", random_walk_env(), buffer_size=1_000, **small())


def test_the_default_for_images_says_how_much_it_plans(monkeypatch):
    monkeypatch.setattr(option_algorithm, "_available_memory", lambda: 8 * 10**9)

    class Images(gym.Env):
        dt = 0.05
        observation_space = gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
        action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    with pytest.warns(UserWarning, match=r"plans 24\.6 GB of memory, and 8\.0 GB are available"):
        CTCO("CnnPolicy", Images(), device="cpu")


def test_memory_of_this_machine():
    available = option_algorithm._available_memory()
    if not Path("/proc/meminfo").exists():
        pytest.skip("read on Linux only")
    assert 10**7 < available < 10**14


@pytest.mark.parametrize("algorithm", [CTCO, FiGARSAC])
def test_a_missing_dt_names_the_algorithms_argument(scripted_env, algorithm):
    with pytest.raises(ValueError, match=r"CTCO\(\.\.\., dt=0\.02\).*OptionExecutionWrapper"):
        algorithm("MlpPolicy", scripted_env(dt=None), **small())
    algorithm("MlpPolicy", scripted_env(dt=None), dt=0.02, **small())


def test_dm_controls_deprecations_are_not_shown():
    pytest.importorskip("dm_control")
    code = "import gymnasium, sb3_ctco; gymnasium.make('sb3_ctco/cheetah-run-v0')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "settotalmass" not in result.stdout + result.stderr


def test_a_study_locks_without_fcntl_at_import():
    code = "import sys; sys.modules['fcntl'] = None; import sb3_ctco.study.runs"
    subprocess.run([sys.executable, "-c", code], check=True)


def commands_of(target, folder):
    """What make would run in a fresh clone."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, folder)
    command = ["make", "--dry-run", target, f"PYTHON={sys.executable}"]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout


def test_make_demo_says_what_it_does_before_it_does_it(tmp_path):
    commands = commands_of("demo", tmp_path)
    said, done = commands.index("installing the package"), commands.index("pip install")
    assert commands.index("making a virtual environment") < commands.index("-m venv") < said < done
    assert commands.index("make demo: training") < commands.index("examples/quickstart.py")
    assert "minutes" in commands[said:done]


def test_make_test_fast_leaves_out_what_is_slow(tmp_path):
    assert '-m "not slow" tests' in commands_of("test-fast", tmp_path)


def test_our_commands_do_not_repeat_what_gymnasiums_models_make_mujoco_say():
    code = (
        "from sb3_ctco.envs.quiet import mute_deprecated_attributes; mute_deprecated_attributes()\n"
        "import gymnasium as gym; gym.make('HalfCheetah-v5')\n"
        "import mujoco; model = mujoco.MjModel.from_xml_string("
        "'<mujoco><worldbody><body><freejoint/><geom size=\"1\"/></body></worldbody></mujoco>')\n"
        "data = mujoco.MjData(model); data.qpos[0] = float('nan'); mujoco.mj_step(model, data)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "settotalmass" not in run.stdout + run.stderr
    assert "Nan, Inf or huge value in QPOS" in run.stderr  # others stay
