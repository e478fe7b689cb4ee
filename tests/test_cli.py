"""The command ``sb3-ctco`` where something is missing."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_ctco
from sb3_ctco.cli import main

ROOT = Path(__file__).parents[1]


def run_without(modules, *arguments):
    """The command in a Python where modules cannot be imported."""
    hidden = "".join(f"sys.modules[{name!r}] = None; " for name in modules)
    code = f"import sys; {hidden}from sb3_ctco.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def test_version(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"sb3-ctco {sb3_ctco.__version__}\n"


def test_help_needs_no_extra():
    result = run_without(["rl_zoo3", "optuna", "yaml", "joblib", "tqdm", "matplotlib", "fcntl"], "--help")
    assert result.returncode == 0, result.stderr
    assert all(command in result.stdout for command in ("train", "enjoy", "tune", "study"))
    assert run_without(["rl_zoo3", "yaml"], "study", "--help").returncode == 0


@pytest.mark.parametrize(
    ("missing", "arguments", "said"),
    [
        ("rl_zoo3", ["train", "--env", "Pendulum-v1"], "sb3-ctco train: .*rl_zoo3 is missing.*pip install '.[zoo]'"),
        ("optuna", ["enjoy", "--env", "Pendulum-v1"], "sb3-ctco enjoy: .*optuna is missing.*pip install '.[zoo]'"),
        ("yaml", ["study", "run", "--preset", "smoke"], "sb3-ctco study run: yaml is missing.*pip install '.[study]'"),
        (
            "rliable",
            ["study", "plot", f"{ROOT}/results/quick.csv"],
            "sb3-ctco study plot: rliable is missing.*pip install '.[study]'",
        ),
    ],
)
def test_a_missing_extra_is_named(missing, arguments, said):
    result = run_without([missing], *arguments)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    beginning, *rest = said.split(".*")
    assert result.stderr.startswith(beginning) and all(part in result.stderr for part in rest), result.stderr


def test_no_error_names_an_index_where_the_package_is_not():
    files = [*ROOT.glob("sb3_ctco/**/*.py"), *ROOT.glob("wrappers/*.py"), *ROOT.glob("examples/*.py")]
    assert len(files) > 40
    assert [file for file in files if re.search(r"pip install .?sb3-ctco", file.read_text())] == []
