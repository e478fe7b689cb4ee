"""The deployment example runs on an exported file, in a process without PyTorch."""

import subprocess
import sys
from pathlib import Path

from sb3_ctco import CTCO
from sb3_ctco.export import export_onnx

EXAMPLE = Path(__file__).parent.parent / "examples" / "run_exported.py"


def test_run_exported(tmp_path):
    export_onnx(CTCO("MlpPolicy", "Pendulum-v1", seed=0), tmp_path / "pendulum.onnx")
    command = [sys.executable, str(EXAMPLE), str(tmp_path / "pendulum.onnx"), "--env", "Pendulum-v1", "--episodes", "2"]
    output = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    assert "episode 1: return -" in output
    assert "200 ticks" in output
    assert "PyTorch was not loaded" in output
