"""What the README shows runs, and what it says is so."""

import csv
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch as th

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
RESEARCHER, ENGINEER, STUDENT = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def run(snippet: str) -> dict[str, object]:
    namespace: dict[str, object] = {}
    exec(compile(snippet, "README", "exec"), namespace)
    return namespace


@pytest.fixture
def one_thread():
    # A thread a core is slower than one for networks of this size, many times so if other tests run beside.
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_first_example_solves_its_task_by_long_options(seed, tmp_path, monkeypatch, capsys, one_thread):
    monkeypatch.chdir(tmp_path)
    assert "seed=0" in RESEARCHER
    run(RESEARCHER.replace("seed=0", f"seed={seed}"))
    printed = capsys.readouterr().out

    lengths = [int(n) for n in re.findall(r"an option of (\d+) steps", printed)]
    episode_return, steps = re.search(r"return (-?[\d.]+) after (\d+) steps", printed).groups()
    assert sum(lengths) == int(steps)
    assert np.mean(lengths) >= 5
    # The summit is worth 100, less what driving takes; standing still is worth 0. With 20 seeds it is 91.2 to 95.0.
    assert float(episode_return) > 80
    assert (tmp_path / "mountain_car.zip").exists()


def test_a_controller_plays_what_the_first_example_saved(tmp_path, monkeypatch):
    from sb3_ctco import CTCO

    monkeypatch.chdir(tmp_path)
    CTCO("MlpPolicy", "MountainCarContinuous-v0", d_max=2.0, seed=0).save("mountain_car")
    names = run(ENGINEER)
    controller, action = names["controller"], names["action"]
    assert action.shape == (1,)
    assert abs(action[0]) <= 1
    # In ticks of 5 ms; an untrained policy plays options of about √(d_min·d_max), 0.26 s.
    assert controller.dt == 0.005
    assert 0.13 < controller.duration < 0.5


def test_the_option_model_prints_what_the_equations_give(capsys):
    run(STUDENT)
    printed = capsys.readouterr().out
    actions = [float(number) for number in re.search(r"\[(.*)\]", printed).group(1).split()]
    # By hand: centres −1/6, 1/2, 7/6 and 2h = (4/9)², so φ(0) ∝ (e^(−0.140625), e^(−1.265625), e^(−6.890625)).
    phi = np.exp([-0.140625, -1.265625, -6.890625])
    assert actions[0] == pytest.approx(phi @ [-1.0, 0.5, 1.0] / phi.sum(), abs=0.005)
    assert actions == sorted(actions)
    assert len(actions) == 10
    # The second number by e^(−0.404·0.5); the first from the actions as printed, so not to the last digit.
    weights = np.exp(-0.404 * 0.05 * np.arange(10)) * (1 - np.exp(-0.404 * 0.05)) / 0.404
    assert float(re.search(r"R = (-[\d.]+)", printed).group(1)) == pytest.approx(-weights @ np.square(actions), abs=0.005)
    assert "γ(d) = 0.817" in printed


def records_of(*files):
    for name in files:
        with (ROOT / "results" / name).open() as file:
            yield from csv.DictReader(file)


def test_the_table_is_that_of_the_records():
    """Means of training returns, of as many seeds as the README says."""
    records = defaultdict(list)
    for row in records_of("quick.csv", "opponents.csv"):
        run = row["task"], row["algorithm"], round(1 / float(row["dt"])), row["setting"]
        records[run].append(float(row["discounted_return"]))
    seeds = "**five** of SAC at 50 Hz and of SAC that holds its actions, **one** of all else"
    assert f"**five** seeds of CTCO (one at 100 Hz), {seeds}" in README.replace("\n", " ")
    number = r"([\d.]+)"
    pattern = rf"^\| ([a-z ]+), (\d+) Hz \| {number} \| {number} \| (the same|[\d.]+) \| {number} \|$"
    rows = re.findall(pattern, README, flags=re.MULTILINE)
    assert len(rows) == 6
    for name, rate, ctco, sac, held, figar_sac in rows:
        task = {"sparse point mass": "point_mass", "cheetah run": "cheetah", "ball in cup": "ball_in_cup"}[name]
        shown = {("ctco", "tuned"): (ctco, 5), ("sac", "large"): (sac, 5 if rate == "50" else 1)}
        shown["figar_sac", "large"] = figar_sac, 1
        if rate == "500":
            shown["sac_repeat", "20ms"] = held, 5
        else:
            assert held == "the same"  # a step takes 20 ms
        for (algorithm, setting), (value, n_seeds) in shown.items():
            returns = records[task, algorithm, int(rate), setting]
            assert len(returns) == n_seeds, (name, rate, algorithm)
            assert float(value) == pytest.approx(np.mean(returns), abs=0.0051), (name, rate, algorithm)


def test_the_rows_of_gymnasium_are_means_of_the_records():
    rows = re.findall(r"^\| (\w+-v5), \d+ Hz \| ([\d,]+) \| ([\d,]+) \|", README, flags=re.MULTILINE)
    assert len(rows) == 2
    for task, *shown in rows:
        for (algorithm, setting), value in zip((("ctco", "tuned"), ("sac", "large")), shown, strict=True):
            returns = [
                float(row["greedy_episode_return"])
                for row in records_of("native.csv")
                if (row["task"], row["algorithm"], row["setting"]) == (task, algorithm, setting)
            ]
            assert len(returns) == 5
            assert float(value.replace(",", "")) == pytest.approx(np.mean(returns), abs=0.51)


def test_links_lead_somewhere():
    targets = [target for target in re.findall(r"\]\(([^)]+)\)", README) if "://" not in target]
    assert targets
    for target in targets:
        path, _, heading = target.partition("#")
        assert (ROOT / path).exists(), target
        headings = re.findall(r"^#+ (.*)$", (ROOT / path).read_text(), flags=re.MULTILINE) if heading else []
        assert not heading or heading in [h.lower().replace(" ", "-") for h in headings], target


def test_the_commands_exist():
    makefile = (ROOT / "Makefile").read_text()
    for command in ("demo", "test"):
        assert f"make {command}" in README
        assert f"\n{command}:" in makefile
