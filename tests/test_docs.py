"""The documentation's snippets run, and Sphinx has no complaint."""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

mpl.use("Agg")
ROOT = Path(__file__).parent.parent
PAGES = sorted(page for page in (ROOT / "docs").glob("*.md") if "```python" in page.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_snippets_run(page, tmp_path, monkeypatch):
    """All Python blocks of a page, one after the other in one namespace, with short trainings.

    Blocks that are marked ``py`` need a machine.
    """
    monkeypatch.chdir(tmp_path)
    for base in (OffPolicyAlgorithm, OnPolicyAlgorithm):

        def short(self, total_timesteps, *args, learn=base.learn, **kwargs):
            return learn(self, min(total_timesteps, 300), *args, **kwargs)

        monkeypatch.setattr(base, "learn", short)
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(compile(block, page.name, "exec"), namespace)


@pytest.mark.slow
def test_sphinx_builds_without_warnings(tmp_path):
    pytest.importorskip("myst_parser")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(ROOT / "docs"), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "ctco.html").exists()


def run_example(name: str, folder: Path, *arguments: str) -> str:
    command = [sys.executable, str(ROOT / "examples" / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout


@pytest.mark.slow
def test_watch(tmp_path):
    from sb3_ctco import CTCO

    CTCO("MlpPolicy", "Pendulum-v1", seed=0).save(tmp_path / "model.zip")
    output = run_example("watch.py", tmp_path, "model.zip", "--env", "Pendulum-v1", "--no-video")
    assert "return -" in output
    assert (tmp_path / "watch" / "episode.png").stat().st_size > 10_000


@pytest.mark.slow
def test_compare_with_sac(tmp_path):
    output = run_example("compare_with_sac.py", tmp_path, "--steps", "1500", "--net-arch", "16", "--eval-episodes", "2")
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in output.splitlines() if line.startswith("|")}
    # At 20 Hz SAC decides 20 times a second, CTCO at most as often.
    assert float(rows["SAC"][2]) == 20.0
    assert 1 / 0.3 - 0.1 <= float(rows["CTCO"][2]) <= 20.0
    assert (tmp_path / "compare_with_sac.png").stat().st_size > 10_000
