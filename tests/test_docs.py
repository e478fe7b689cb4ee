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
# tests/test_extending.py runs that page's blocks in full, each for itself.
PAGES = sorted(
    page for page in (ROOT / "docs").glob("*.md") if "```python" in page.read_text() and page.name != "extending.md"
)


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
    pages = [page.read_text() for page in tmp_path.glob("*.html")]
    assert (tmp_path / "ctco.html").exists()
    # What a page loads, as opposed to what it links to, comes with it: no scripts, fonts or formulas from the net.
    loaded = re.findall(r"<(?:script|img|link)[^>]*(?:src|href)=\"(?:https?:)?//([^\"]*)", "".join(pages))
    assert loaded == []
    # Numbers that two pages need stand on one of them.
    assert any("What each ingredient is worth" in page for page in pages)


def test_the_installation_page_has_every_extra():
    extras = re.search(
        r"^\[project.optional-dependencies\]$(.*?)^\[", (ROOT / "pyproject.toml").read_text(), re.DOTALL | re.MULTILINE
    )
    names = re.findall(r"^([a-z-]+) = \[", extras.group(1), re.MULTILINE)
    assert "dm-control" in names
    page = (ROOT / "docs" / "installation.md").read_text()
    assert [name for name in names if f"| `{name}` |" not in page] == []


def test_the_study_page_has_every_preset_and_its_own_one_loads(tmp_path):
    pytest.importorskip("yaml")
    from sb3_ctco.study.agents import constructor_arguments
    from sb3_ctco.study.grid import load_preset, preset_names

    page = (ROOT / "docs" / "study.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \|(?:[^|]*\|){3} ([\d,and ]+) \|", page, re.MULTILINE))
    assert set(rows) == set(preset_names())
    for name, numbers in rows.items():
        assert sum(int(number.replace(",", "")) for number in numbers.split(" and ")) == len(load_preset(name).runs)

    (block,) = re.findall(r"```yaml\n(task_seconds: .*?)```", page, re.DOTALL)
    (tmp_path / "mine.yml").write_text(block)
    runs = load_preset(str(tmp_path / "mine.yml")).runs
    # Five seeds of two settings, on two tasks at two rates and on one at its own
    assert len(runs) == 5 * 4 * (2 + 2 + 1)
    for run in runs:
        constructor_arguments(run)


def test_the_environments_page_has_every_task():
    from sb3_ctco.envs import DM_CONTROL_TASKS

    page = (ROOT / "docs" / "environments.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (`[^|]*`) \|", page, re.MULTILINE))
    assert {domain: tuple(re.findall(r"`(\w+)`", rows.get(domain, ""))) for domain in DM_CONTROL_TASKS} == DM_CONTROL_TASKS


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
def test_visual_reacher(tmp_path, opengl):
    output = run_example("visual_reacher.py", tmp_path, "--minutes", "0.4", "--rate", "25")
    assert re.search(r"training: discounted return \d\.\d\d, .* in 1 episodes", output)
    assert re.search(r"greedy: discounted return \d\.\d\d, .* in 20 episodes", output)
    assert (tmp_path / "runs" / "visual_reacher" / "model.zip").exists()


@pytest.mark.slow
def test_compare_with_sac(tmp_path):
    output = run_example("compare_with_sac.py", tmp_path, "--steps", "1500", "--net-arch", "16", "--eval-episodes", "2")
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in output.splitlines() if line.startswith("|")}
    # At 20 Hz SAC decides 20 times a second, CTCO at most as often.
    assert float(rows["SAC"][2]) == 20.0
    assert 1 / 0.3 - 0.1 <= float(rows["CTCO"][2]) <= 20.0
    assert (tmp_path / "compare_with_sac.png").stat().st_size > 10_000
