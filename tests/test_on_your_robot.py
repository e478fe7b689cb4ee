"""docs/on_your_robot.md runs as it stands, against a robot in a process of its own."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_ctco.realtime import JournalReader

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_page_runs_against_a_robot_of_its_own_time(tmp_path):
    page = (ROOT / "docs" / "on_your_robot.md").read_text()
    command = [sys.executable, str(ROOT / "examples" / "simulated_robot.py"), "--port", "0", "--silent-every", "4"]
    robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        port = re.fullmatch(r"listening on (\d+)\n", robot.stdout.readline()).group(1)
        script = "\n\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
        assert script.count("5005") == 1
        (tmp_path / "arm.py").write_text(script.replace("5005", port))
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}

        def run(n_steps):
            command = [sys.executable, "arm.py", str(n_steps)]
            result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
            assert result.returncode == 0, result.stderr
            return result

        result = run(150)
        again = run(170)  # goes on, with what was shown before
    finally:
        robot.send_signal(signal.SIGTERM)
        report = json.loads(robot.stdout.read())
    # Two demonstrations, of which most stretches can be played
    added = [int(n) for n in re.findall(r"AddedTrajectory\(added=(\d+)", result.stdout)]
    assert len(added) == 2
    assert min(added) > 20
    assert "AddedTrajectory" not in again.stdout
    # The robot was silent for 0.6 s in 4: less than 0.3 s is borne, and then joints are held, in learning and in playing.
    assert int(re.search(r"safe_ticks=(\d+)", result.stdout).group(1)) > 0
    assert re.search(r"replaced by the safe action: {'no fresh observation': \d+, 'stopped': 1}", result.stdout)
    assert "the safe action is sent (no fresh observation)" in result.stderr
    # Somebody took over, and that was kept with the demonstrations.
    assert len(JournalReader(tmp_path / "runs" / "reach" / "demonstrations").read(100)) >= 3
    # Demonstrations, learning and playing; 2 widths of 2 rad a second are 0.2 rad a period, and more only at late ticks.
    assert report["commands"] > 2 * 40 + 150 + 90
    assert 0 < report["largest_change"] < 0.5
