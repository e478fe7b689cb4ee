"""The examples of docs/extending.md run in full, and do what the page says of them."""

import re
from pathlib import Path

import gymnasium as gym
import pytest

from sb3_ctco.registry import ALGORITHMS, TASKS

PAGE = Path(__file__).parent.parent / "docs" / "extending.md"
#: The Python block of each section, by the section's heading
EXAMPLES = dict(re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE))


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs a section's example in an empty folder, and returns what it prints. What it registers is gone afterwards."""
    monkeypatch.chdir(tmp_path)

    def run(section):
        before = {id(registry): set(registry) for registry in (ALGORITHMS, TASKS, gym.registry)}
        try:
            exec(compile(EXAMPLES[section], f"{PAGE.name}, {section}", "exec"), {"__name__": "example"})
        finally:
            for registry in (ALGORITHMS, TASKS, gym.registry):
                for name in set(registry) - before[id(registry)]:
                    del registry[name]
        return capsys.readouterr().out

    return run


def test_every_section_has_one_example():
    assert list(EXAMPLES) == re.findall(r"^## (.*)$", PAGE.read_text(), re.MULTILINE)
    assert PAGE.read_text().count("```python") == len(EXAMPLES) == 4


def test_a_trajectory(run):
    output = run("A trajectory")
    # Half of the option from 0 to 1, half of it back: by hand.
    assert "plan: [0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]" in output
    updates = int(re.search(r"updates: (\d+) sub-options too: True", output).group(1))
    assert updates > 50


def test_a_critic(run):
    output = run("A critic")
    shares = [float(share) for share in re.search(r"below the quantiles: \[(.*)\]", output).group(1).split(", ")]
    assert shares == sorted(shares)
    assert shares == pytest.approx([0.1, 0.3, 0.5, 0.7, 0.9], abs=0.15)
    assert "made with autograd, because QuantileCTCO is a subclass of CTCO" in output


def test_a_baseline(run):
    output = run("A baseline")
    assert "done" in output.splitlines()
    # An action is held for 0.2 s: one update for each, of 100 s without the first 10 s.
    assert "decisions a second: 5.0" in output
    updates = int(re.search(r"updates: (\d+)", output).group(1))
    assert updates == pytest.approx(90 / 0.2, abs=2)


def test_a_task(run):
    output = run("A task")
    assert re.search(r"runs: (.*)", output).group(1) == str(
        ["heater-ctco_small-50hz-seed0", "Pendulum-v1-ctco_small-20hz-seed0", "heater-ctco_small-10hz-seed0"]
    )
    assert "gammas: [0.98, 0.99, 0.98]" in output
    assert "done" in output.splitlines()
    assert float(re.search(r"greedy return: ([\d.]+)", output).group(1)) > 1.8
