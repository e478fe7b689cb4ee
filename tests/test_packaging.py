"""The package as users install it, imported from outside the checkout and from inside, and what is distributed."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROBE = """
import importlib.resources, pathlib, sys
import sb3_ctco, sb3_ctco.wrappers, sb3_ctco.zoo_configs
from sb3_ctco import CTCO, OptionExecutionWrapper, OptionReplayBuffer, DictOptionReplayBuffer
files = [f.name for f in importlib.resources.files("sb3_ctco.zoo_configs").iterdir() if f.name.endswith(".yml")]
assert "ctco.yml" in files, files
assert importlib.resources.files("sb3_ctco").joinpath("py.typed").is_file()
assert "wrappers" not in sys.modules
model = CTCO("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8])).learn(150)
print(pathlib.Path(sb3_ctco.__file__).resolve().parent, model.num_timesteps)
"""


def run(*command, cwd=None, env=None):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True, cwd=cwd, env=env, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def make_venv(folder):
    """A virtual environment that finds this one's libraries, but not its editable sb3-ctco."""
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    python = folder / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


def install(python, *what):
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-build-isolation", *what)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    source = folder / "source"
    # From what git tracks, so that a file that was forgotten is missed.
    run("git", "clone", "--quiet", ROOT, source)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, source)
    return next(folder.glob("*.whl"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_an_installation_works_outside_the_checkout(tmp_path, wheel, kind):
    python = make_venv(tmp_path / "venv")
    if kind == "wheel":
        install(python, wheel)
    else:
        run("git", "clone", "--quiet", ROOT, tmp_path / "checkout")
        install(python, "--editable", tmp_path / "checkout")
    outside = tmp_path / "outside"
    outside.mkdir()
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    package, steps = run(python, "-c", PROBE, cwd=outside, env=env).split()
    home = tmp_path / ("venv" if kind == "wheel" else "checkout")
    assert Path(package).is_relative_to(home.resolve())
    assert int(steps) >= 150


INSIDE = """
import sb3_ctco, sb3_ctco.wrappers, sb3_ctco.zoo_configs
from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.study.grid import load_preset
import importlib.resources
assert importlib.resources.files("sb3_ctco.zoo_configs").joinpath("ctco.yml").is_file()
load_preset("smoke")
CTCO("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8])).learn(20)
print(sb3_ctco.__file__)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nothing", "plain", "editable", "wheel"])
def test_python_started_in_the_checkout_imports_it(tmp_path, request, kind):
    """A shell, a notebook or a script there has the checkout on its path first, whatever is installed."""
    checkout = tmp_path / "checkout"
    run("git", "clone", "--quiet", ROOT, checkout)
    python = make_venv(tmp_path / "venv")
    if kind == "wheel":
        install(python, request.getfixturevalue("wheel"))
    elif kind != "nothing":
        install(python, *(["--editable"] if kind == "editable" else []), checkout)
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    assert Path(run(python, "-c", INSIDE, cwd=checkout, env=env).strip()).is_relative_to(checkout.resolve())
    script = checkout / "script.py"
    script.write_text(INSIDE)
    run(python, "script.py", cwd=checkout, env=env)
    # An example is started from the checkout, but its own folder is what Python looks in first.
    if kind != "nothing":
        assert "--task" in run(python, "examples/quickstart.py", "--help", cwd=checkout, env=env)


@pytest.mark.slow
def test_the_source_distribution_has_what_docs_and_tests_need(wheel):
    with tarfile.open(next(wheel.parent.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = set(run("git", "ls-files", cwd=ROOT).split())
    missing = {name for name in tracked if not name.startswith((".github/", ".gitignore"))} - names
    assert not missing
    assert {"docs/index.md", "tests/conftest.py", "wrappers/option_execution.py", "zoo_configs/ctco.yml"} <= names


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"sb3_ctco"}
    for wanted in (
        "study/presets/quick.yml",
        "study/figure_frequency.csv",
        "py.typed",
        "wrappers/option_execution.py",
        "zoo_configs/ctco.yml",
        "ctco/ctco.py",
        "options/trajectory.py",
        "video.py",
    ):
        assert f"sb3_ctco/{wanted}" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
