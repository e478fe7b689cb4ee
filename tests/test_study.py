"""The frequency study: its grid, its runs in folders, the engines, records and figures."""

import csv
import dataclasses
import inspect
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import matplotlib as mpl
import numpy as np
import pytest
import yaml
from conftest import PATIENCE
from rliable.metrics import aggregate_iqm, probability_of_improvement
from stable_baselines3 import SAC

from sb3_ctco import CTCO, registry
from sb3_ctco.evaluation import evaluate_discounted_return
from sb3_ctco.registry import ALGORITHMS as ALGORITHM_ROWS
from sb3_ctco.registry import TASKS, Task, find_task
from sb3_ctco.study import agents, engines, plots, runs, schedule, scores, status, tables
from sb3_ctco.study.cli import main
from sb3_ctco.study.grid import Run, load_preset, preset_names
from sb3_ctco.study.records import COLUMNS, collect, paper_returns, read_curves, read_records

mpl.use("Agg")

#: A process of its own for the command, to be killed
COMMAND = [sys.executable, "-c", "from sb3_ctco.cli import main; main()", "study"]
ALGORITHMS = ("ctco", "sac", "figar_sac", "dac_ppo")


@pytest.fixture(scope="module", autouse=True)
def one_thread_each():
    """For worker processes, which have their settings from the environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield


def tiny(folder: Path, name: str = "tiny", **changes) -> str:
    """A preset file of runs that take a second or two: by default CTCO with two seeds on one task at 50 Hz."""
    ctco = {"gamma": 0.98, "gamma_dt": 0.05, "updates_per_second": 0.1, "learning_starts_seconds": 20, "batch_size": 8}
    content = {
        "task_seconds": 100,
        "eval_episodes": 1,
        "tasks": ["point_mass"],
        "rates": [50],
        "seeds": 2,
        "algorithms": {
            "ctco": {"setting": "small", "arguments": {**ctco, "policy_kwargs": {"net_arch": {"pi": [4], "qf": [4]}}}},
        },
    }
    file = folder / f"{name}.yml"
    file.write_text(yaml.safe_dump({**content, **changes}))
    return str(file)


@pytest.fixture
def few_resamples(monkeypatch):
    for module in (plots, scores):
        monkeypatch.setattr(module, "BOOTSTRAP_REPETITIONS", 50)


def wait_for(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


# --- presets


def test_the_presets_are_the_grids_that_they_should_be():
    assert preset_names() == ["learning", "native", "opponents", "paper", "quick", "smoke", "unseen"]
    paper, quick = load_preset("paper"), load_preset("quick")
    assert len(paper.select(settings=["paper"])) == 30 * 4 * 3 * 4
    assert {run.task_seconds for run in paper.runs} == {400 * 60}
    assert len(quick.runs) == 8 * 3 * 4
    for preset in (paper, quick):
        assert {run.rate for run in preset.runs} == {50, 100, 250, 500}
        assert {run.task for run in preset.runs} == {"point_mass", "cheetah", "ball_in_cup"}
        assert {run.algorithm for run in preset.runs} == set(ALGORITHMS)
        assert len({run.name for run in preset.runs}) == len(preset.runs)
        assert {(run.arguments["gamma"], run.arguments["gamma_dt"]) for run in preset.runs} == {(0.98, 0.05)}
        assert {run.arguments["updates_per_second"] for run in preset.runs} == {20}
    for run in paper.select(settings=["paper"]):
        critics = "vf" if run.algorithm == "dac_ppo" else "qf"
        assert run.arguments["policy_kwargs"] == {"net_arch": {"pi": [10, 10], critics: [64, 64]}}
    ctco = paper.select(algorithms=["ctco"], settings=["paper"])[0].arguments
    assert (ctco["high_freq_penalty"], ctco["n_rbf"]) == (0.05, 3)
    # A seed is complete before the next one begins, and in it the runs that take longest are first.
    learning = load_preset("learning")
    assert [run.seed for run in learning.runs] == [0] * 18 + [1] * 18 + [2] * 18
    for seed in (learning.runs[:18], quick.runs):
        assert [run.rate for run in seed] == sorted((run.rate for run in seed), reverse=True)


def test_the_preset_of_both_classes_defaults_names_them():
    preset = load_preset(str(Path(__file__).parents[1] / "benchmarks" / "bare.yml"))
    for algorithm, cls, of_the_clock in (("ctco", CTCO, set()), ("sac", SAC, {"gamma_dt"})):
        defaults = {name: parameter.default for name, parameter in inspect.signature(cls.__init__).parameters.items()}
        for run in preset.select(algorithms=[algorithm]):
            named = {name: value for name, value in run.arguments.items() if name not in of_the_clock}
            # An update a step, and a hundred steps before the first
            assert named.pop("updates_per_second") == run.rate
            assert named.pop("learning_starts_seconds") * run.rate == defaults["learning_starts"]
            assert named == {name: defaults[name] for name in named}
    # Where CTCO's defaults are not SAC's
    assert {"learning_rate", "batch_size", "tau"} <= set(preset.select(algorithms=["ctco"])[0].arguments)


def test_seeds_may_be_others_than_the_presets() -> None:
    quick = load_preset("quick")
    runs = quick.select(tasks=["cheetah"], seeds=[5, 0])
    assert [run.seed for run in runs] == [5] * 32 + [0] * 32
    assert runs[32:] == quick.select(tasks=["cheetah"])
    assert runs[0] == dataclasses.replace(runs[32], seed=5)
    with pytest.raises(ValueError, match=r"seeds must not be negative: \[-1\]"):
        quick.select(seeds=[-1])


@pytest.mark.parametrize("name", ["smoke", "quick", "opponents", "paper", "unseen"])
def test_every_setting_fits_its_constructor_and_environment(name):
    for run in load_preset(name).runs:
        agents.constructor_arguments(run)
    for task, rate in {(run.task, run.rate) for run in load_preset(name).runs}:
        spec = find_task(task).make_env(rate).spec
        assert (spec.kwargs["dt"], spec.kwargs["time_limit"]) == (1 / rate, 10.0)


@pytest.mark.parametrize("rate", [50, 500])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_seconds_become_steps(algorithm, rate):
    (run, *_) = load_preset("quick").select(tasks=["point_mass"], rates=[rate], algorithms=[algorithm])
    arguments = {**run.arguments, "buffer_size": 1000} if algorithm != "dac_ppo" else run.arguments
    model = agents.make_model(Run(**{**run.as_dict(), "arguments": arguments}))
    if algorithm in ("sac", "dac_ppo"):
        gamma = model.gamma if algorithm == "sac" else model.step_gamma
        assert gamma == pytest.approx(0.98 ** (1 / rate / 0.05))
        assert model.get_env().get_attr("option_space")[0].dt == pytest.approx(1 / rate)
    if algorithm == "sac":
        assert model.gradient_steps / model.train_freq.frequency * rate == pytest.approx(20)
    else:
        assert model.updates_per_second == 20
    if algorithm == "dac_ppo":
        # 40 s are four episodes of 10 s, one in each of four environments.
        assert (model.n_steps, model.n_envs) == (10 * rate, 4)
    else:
        assert model.learning_starts == 60 * rate
    assert model.seed == 0


@pytest.mark.parametrize(
    ("setting", "weights", "decisions"),
    [("20ms", 2, 500), ("25steps", 2, 40), ("100ms", 6, 100), ("price-0.003", 3, None), ("large", 2, 1000)],
)
def test_opponents_decide_as_their_settings_say(setting, weights, decisions):
    """At 100 Hz, on point mass with its two actuators, in episodes of 10 s."""
    (run, *_) = load_preset("opponents").select(tasks=["point_mass"], rates=[100], settings=[setting])
    model = agents.make_model(dataclasses.replace(run, arguments={**run.arguments, "buffer_size": 1000}))
    assert model.action_space.shape == (weights,)
    assert model.learning_starts == 60 * 100
    (episode,) = evaluate_discounted_return(model, agents.make_eval_env(run, model), 1, deterministic=False)
    assert episode.seconds == pytest.approx(10.0)
    if decisions is not None:
        assert episode.decisions == decisions


def test_an_entry_may_have_rates_of_its_own(tmp_path):
    preset = load_preset("unseen")
    assert {run.rate for run in preset.select(algorithms=["sac_repeat"])} == {500}
    assert {run.rate for run in preset.select(algorithms=["sac"])} == {50, 500}
    with pytest.raises(ValueError, match=r"algorithm ctco: rates must be a list of whole numbers of Hz, each once, not \[\]"):
        load_preset(tiny(tmp_path, **of_ctco(rates=[])))


def of_ctco(**changes):
    return {"algorithms": {"ctco": {"setting": "a", "arguments": {}, **changes}}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ["walker"]}, r"no task 'walker': name one of .*'visual_reacher_hard'\], or an id of Gymnasium's registry"),
        ({"tasks": ["cheetah", "cheetah"]}, "tasks must be a list of tasks, each once, or a mapping"),
        ({"tasks": {"cheetah": {"rate": 50}}}, r"task cheetah: \[\] missing, \['rate'\] unknown"),
        ({"tasks": {"cheetah": {"evaluations": 0}}}, "task cheetah: evaluations must be a whole number from 1, not 0"),
        ({"rates": [50.5]}, r"rates must be a list of whole numbers of Hz, each once, not \[50.5\]"),
        ({"seeds": 0}, "seeds must be a whole number from 1, how many there are, not 0"),
        ({"task_seconds": 50}, "task_seconds must be at least 100, so that an episode of 10 s ends in the last tenth"),
        ({"step": 1}, r"\[\] missing, \['step'\] unknown"),
        ({"algorithms": {"ppo": {"setting": "a", "arguments": {}}}}, "must be one of .* not 'ppo'"),
        ({"tasks": [{"cheetah": 1}]}, r"there is no task \{'cheetah': 1\}"),
        ({"tasks": {"cheetah": {"arguments": [1]}}}, r"task cheetah: arguments must be a mapping .* not \[1\]"),
        ({"seeds": [11, 12]}, r"seeds must be a whole number .*, not \[11, 12\]: which ones, .* --seeds tells"),
        ({"seeds": True}, "seeds must be a whole number from 1, .*, not True"),
        ({"eval_episodes": True}, "eval_episodes must be a whole number from 1, not True"),
        ({"task_seconds": math.inf}, "task_seconds must be at least 100, .* and finite, not inf"),
        ({"task_seconds": math.nan}, "task_seconds must be at least 100, .* and finite, not nan"),
        ({"task_seconds": "long"}, "task_seconds must be at least 100, .* not 'long'"),
        ({"algorithms": ["ctco"]}, r"algorithms must be a mapping of names to setting and arguments, not \['ctco'\]"),
        ({"algorithms": {}}, "algorithms must be a mapping of names to setting and arguments, not {}"),
        ({"algorithms": None}, "algorithms must be a mapping of names to setting and arguments, not None"),
        (
            {"algorithms": {"ctco": None}},
            r"must be a mapping with \['setting', 'arguments', 'algorithm', 'rates'\]",
        ),
        (of_ctco(arguments=None), "arguments must be a mapping of names to values .* not None"),
        (of_ctco(arguments=[1]), r"arguments must be a mapping of names to values .* not \[1\]"),
        (of_ctco(arguments={3: 1}), r"arguments must be a mapping of names to values .* not \{3: 1\}"),
        (of_ctco(algorithm=["ctco"]), r"must be one of .* not \['ctco'\]"),
        (of_ctco(setting=None), "letters, digits and _ . . -, not None"),
        (of_ctco(setting=""), "letters, digits and _ . . -, not ''"),
        (of_ctco(setting="../../elsewhere"), "letters, digits and _ . . -, not '../../elsewhere'"),
        (of_ctco(setting="/tmp"), "letters, digits and _ . . -, not '/tmp'"),
        (of_ctco(setting=[1]), r"letters, digits and _ . . -, not \[1\]"),
    ],
)
def test_mistakes_in_a_preset(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        load_preset(tiny(tmp_path, **changes))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"tasks: [point_mass", "preset broken is no YAML: .*line 1"),
        (b"tasks: \xff", "preset broken is no YAML: "),
        (b"tasks: 2026-13-45", "preset broken is no YAML: "),
        (b"!!python/object/apply:os.system ['true']", "preset broken is no YAML: .*could not determine a constructor"),
        (b"", "preset broken: must be a mapping with .* not None"),
        (b"{1: 2, step: 1}", r"preset broken: \['algorithms', .*\] missing, \[1, 'step'\] unknown"),
        (b"[1, 2]", r"preset broken: must be a mapping with .* not \[1, 2\]"),
    ],
)
def test_files_that_are_no_presets(tmp_path, content, message):
    file = tmp_path / "broken.yml"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=re.compile(message, re.DOTALL)):
        load_preset(str(file))


def test_folders_that_cannot_be_a_study(tmp_path, capsys):
    preset, file = tiny(tmp_path), tmp_path / "file"
    file.write_text("not a folder")
    for arguments, message in [
        (["run", "--preset", preset, "--folder", str(file)], "Not a directory"),
        (["run", "--preset", preset, "--folder", str(file / "inside")], "Not a directory"),
        (["run", "--preset", preset, "--folder", "/proc/nothing"], "/proc/nothing cannot be the study's folder: "),
        (["run", "--preset", str(tmp_path)], "there is no preset"),
        (["status", str(file)], "is no folder of a study"),
        (["collect", str(tmp_path / "none"), "--into", str(tmp_path / "a.csv")], "there is no folder or CSV file"),
    ]:
        assert main(arguments) == 1, arguments
        assert message in capsys.readouterr().err
    settings = tmp_path / "study" / load_preset(preset).runs[0].name / "settings.json"
    settings.parent.mkdir(parents=True)
    settings.write_text('{"preset": ')
    assert main(["run", "--preset", preset, "--folder", str(tmp_path / "study")]) == 1
    assert f"{settings} is damaged" in capsys.readouterr().err


def test_mistakes_on_the_command_line(tmp_path, capsys):
    preset = tiny(tmp_path, algorithms={"ctco": {"setting": "a", "arguments": {"gama": 0.9}}})
    for arguments, message in [
        (
            ["run", "--preset", "none"],
            f"no preset 'none': name one of {preset_names()}, or a YAML file",
        ),
        (["run", "--preset", "quick", "--rates", "60"], "preset quick has no rate [60]; it has [50, 100, 250, 500]"),
        (["run", "--preset", preset], "ctco (a) has no arguments ['gama']"),
        (["run", "--preset", preset, "--workers", "0"], "--workers must be at least 1, not 0"),
        (
            ["run", "--preset", preset, "--hours", "0"],
            "--hours must be positive and is for --engine local, not 0.0 with local",
        ),
        (["run", "--preset", preset, "--address", "auto"], "--address auto is Ray's: add --engine ray"),
        (["status", str(tmp_path)], "is no folder of a study"),
        (["plot", str(tmp_path)], "no run in"),
    ]:
        assert main(arguments) == 1
        assert message in capsys.readouterr().err


def test_the_study_needs_no_rl_zoo():
    code = "import sys; sys.modules['rl_zoo3'] = None; from sb3_ctco.cli import main; main()"
    output = subprocess.run([sys.executable, "-c", code, "study", "--help"], capture_output=True, text=True, check=True)
    assert "status" in output.stdout


# --- runs


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[str, Path]:
    """A preset file, and the folder of its study: two seeds, complete."""
    folder = tmp_path_factory.mktemp("finished")
    preset = tiny(folder)
    assert main(["run", "--preset", preset, "--folder", str(folder / "study"), "--workers", "1"]) == 0
    return preset, folder / "study"


def test_a_run_leaves_its_settings_versions_episodes_and_record(finished):
    preset, folder = finished
    run = load_preset(preset).runs[0]
    path = folder / run.name
    assert run.name == "point_mass-ctco_small-50hz-seed0"
    assert Run(**json.loads((path / "settings.json").read_text())) == run
    assert {"python", "torch", "commit", "mujoco"} <= set(json.loads((path / "versions.json").read_text()))
    episodes = list(csv.DictReader((path / "monitor.csv").open()))
    assert [float(episode["task_seconds"]) for episode in episodes] == pytest.approx(range(10, 101, 10))
    record = json.loads((path / "record.json").read_text())
    assert list(record) == list(COLUMNS)
    # Of ten episodes, the last one ends in the last tenth.
    assert record["discounted_return"] == float(episodes[-1]["discounted_return"])
    (greedy,) = csv.DictReader((path / "evaluation.csv").open())
    assert record["greedy_return"] == float(greedy["discounted_return"])
    assert (record["task"], record["algorithm"], record["dt"], record["seed"]) == ("point_mass", "ctco", 0.02, 0)
    assert (record["task_seconds"], record["updates"], record["preset"]) == (100.0, 8, "tiny")
    assert 1.0 <= record["decision_rate_hz"] <= 50.0


@pytest.mark.slow
def test_finished_runs_are_skipped_and_broken_ones_begin_again(finished, tmp_path, capsys):
    preset, original = finished
    folder = tmp_path / "study"
    shutil.copytree(original, folder)
    whole, broken = sorted(folder.iterdir())
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*")}
    record = json.loads((broken / "record.json").read_text())
    (broken / "record.json").unlink()
    (broken / "monitor.csv").write_text("task_seconds,discounted_return\n1.0,")
    assert main(["run", "--preset", preset, "--folder", str(folder), "--workers", "1"]) == 0
    assert "1 of 2 runs are complete" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in whole.rglob("*") if path in before} == before
    again = json.loads((broken / "record.json").read_text())
    assert again["discounted_return"] == record["discounted_return"]  # The seed makes it reproducible.


def test_a_folder_with_other_settings_is_refused(finished, tmp_path, capsys):
    _, folder = finished
    other = tiny(tmp_path, eval_episodes=2)
    assert main(["run", "--preset", other, "--folder", str(folder)]) == 1
    assert "eval_episodes: 1 there, 2 in the preset. Name another --folder, or delete" in capsys.readouterr().err


@pytest.mark.slow
def test_a_failed_run_is_recorded_and_stops_no_other(tmp_path, capsys):
    bad = {"setting": "bad", "arguments": {"gamma": 0.98, "gamma_dt": 0.05, "updates_per_second": 20, "d_max": -1.0}}
    good = yaml.safe_load(Path(tiny(tmp_path)).read_text())["algorithms"]["ctco"]
    preset = tiny(tmp_path, algorithms={"bad": {"algorithm": "ctco", **bad}, "ctco": good}, seeds=1)
    folder = tmp_path / "study"
    assert main(["run", "--preset", preset, "--folder", str(folder), "--workers", "2"]) == 1
    output = capsys.readouterr().out
    assert "1 of 2 runs done, 0 running, 1 failed" in output
    error = (folder / "point_mass-ctco_bad-50hz-seed0" / "error.txt").read_text()
    assert error.startswith("Traceback")
    assert "ValueError: d_max" in error
    assert (folder / "point_mass-ctco_small-50hz-seed0" / "record.json").exists()
    assert main(["status", str(folder)]) == 0
    assert "failed  point_mass-ctco_bad-50hz-seed0: ValueError: d_max" in capsys.readouterr().out


@pytest.mark.slow
def test_two_studies_on_one_folder(finished, tmp_path, capsys):
    """What one is at, the other leaves alone, and says so."""
    preset, original = finished
    folder = tmp_path / "study"
    shutil.copytree(original, folder)
    first, second = sorted(folder.iterdir())
    for path in (first, second):
        (path / "record.json").unlink()
    before = (first / "monitor.csv").stat().st_mtime_ns
    with runs.lock(first) as locked:
        assert locked
        assert status.read_status(folder).of("running")[0].name == first.name
        assert main(["run", "--preset", preset, "--folder", str(folder), "--workers", "1"]) == 3
    assert f"{first.name} is in the hands of another study" in capsys.readouterr().out
    assert (first / "monitor.csv").stat().st_mtime_ns == before
    assert (second / "record.json").exists()
    assert not runs.is_running(first)


@pytest.mark.slow
def test_two_studies_at_once_make_each_run_once(tmp_path):
    preset, folder = tiny(tmp_path, seeds=3), tmp_path / "study"
    arguments = [*COMMAND, "run", "--preset", preset, "--folder", str(folder), "--workers", "1"]
    studies = [subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) for _ in range(2)]
    outputs = [study.communicate(timeout=PATIENCE)[0] for study in studies]
    assert {study.returncode for study in studies} <= {0, 3}, outputs
    assert len(list(folder.glob("*/record.json"))) == 3
    for file in folder.glob("*/monitor.csv"):
        seconds = [float(row["task_seconds"]) for row in csv.DictReader(file.open())]
        assert seconds == sorted(seconds)
        assert len(seconds) == 10


@pytest.mark.slow
def test_kill_9_loses_only_the_runs_in_flight(tmp_path):
    preset, folder = tiny(tmp_path, seeds=6), tmp_path / "study"
    arguments = ["run", "--preset", preset, "--folder", str(folder), "--workers", "2"]
    shared = set(os.listdir("/dev/shm"))
    study = subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(lambda: len(list(folder.glob("*/record.json"))) >= 2)
    study.send_signal(signal.SIGKILL)
    study.wait()
    # Its workers end with it, whatever they are at.
    wait_for(lambda: not any(runs.is_running(path) for path in folder.iterdir()))
    # Of other processes there may be some that began meanwhile.
    left = [name for name in set(os.listdir("/dev/shm")) - shared if "loky" in name or "joblib" in name]
    assert not left
    done = {file: file.stat().st_mtime_ns for file in folder.glob("*/record.json")}
    assert 2 <= len(done) < 6
    assert main(arguments) == 0
    assert len(list(folder.glob("*/record.json"))) == 6
    assert {file: file.stat().st_mtime_ns for file in done} == done


@pytest.mark.slow
def test_a_study_shares_no_memory_and_no_semaphores(tmp_path):
    """So that none can be left behind, however all of its processes end."""
    preset, folder = tiny(tmp_path, seeds=1), tmp_path / "study"
    arguments = [*COMMAND, "run", "--preset", preset, "--folder", str(folder), "--workers", "2"]
    study = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    worker = worker_at_work(study.pid, folder)
    used = {path for pid in (study.pid, worker) for path in mapped_files(pid) | open_files(pid) if "/dev/shm" in path}
    assert study.wait(timeout=PATIENCE) == 0
    assert used == set()


@pytest.mark.slow
def test_a_run_of_another_study_is_tried_again_at_the_end(finished, tmp_path, capsys):
    """For that study may have been killed meanwhile."""
    preset, original = finished
    folder = tmp_path / "study"
    shutil.copytree(original, folder)
    first, second = sorted(folder.iterdir())
    for path in (first, second):
        (path / "record.json").unlink()
    outcomes = engines.run_local(load_preset(preset).runs, folder, 1)
    with runs.lock(first) as locked:
        assert locked
        assert next(outcomes) == runs.Outcome(second.name, "done")
    assert next(outcomes) == runs.Outcome(first.name, "done")
    assert list(outcomes) == []


@pytest.mark.slow
def test_a_run_whose_process_always_dies_fails(finished, tmp_path, monkeypatch):
    preset, original = finished
    folder = tmp_path / "study"
    shutil.copytree(original, folder)
    (run, *_) = load_preset(preset).runs
    (folder / run.name / "record.json").unlink()
    monkeypatch.setattr(engines, "_work", dies)
    (outcome,) = engines.run_local([run], folder, 1)
    assert outcome.state == "failed"
    assert "process died 4 times, at last with exit code 7" in outcome.message
    assert "exit code 7" in (folder / run.name / "error.txt").read_text()


def dies(connection, folder, gym_packages):
    connection.recv()
    os._exit(7)


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(tmp_path):
    preset, folder = tiny(tmp_path, seeds=4), tmp_path / "study"
    arguments = ["run", "--preset", preset, "--folder", str(folder), "--workers", "2"]
    study = subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.kill(worker_at_work(study.pid, folder), signal.SIGKILL)
    assert study.wait(timeout=PATIENCE) == 0
    assert len(list(folder.glob("*/record.json"))) == 4


@pytest.mark.slow
def test_ray_ends_a_study_although_a_worker_is_killed(tmp_path):
    pytest.importorskip("ray")
    preset, folder = tiny(tmp_path, seeds=3), tmp_path / "study"
    arguments = ["run", "--preset", preset, "--folder", str(folder), "--workers", "2", "--engine", "ray"]
    study = subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.kill(worker_at_work(study.pid, folder), signal.SIGKILL)
    assert study.wait(timeout=PATIENCE) == 0
    assert len(list(folder.glob("*/record.json"))) == 3


def worker_at_work(study_pid: int, folder: Path) -> int:
    """Wait for a run to have had an episode; the process that holds its lock."""
    found: list[int] = []

    def look() -> bool:
        for file in folder.glob("*/monitor.csv"):
            locked = str(file.parent / runs.LOCK)
            if len(file.read_text().splitlines()) > 1 and not (file.parent / runs.RECORD).exists():
                found.extend(pid for pid in processes() if locked in open_files(pid))
        return bool(found)

    wait_for(look)
    assert study_pid not in found
    return found[0]


def processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def mapped_files(pid: int) -> set[str]:
    return {line.split()[-1] for line in Path(f"/proc/{pid}/maps").read_text().splitlines()}


def open_files(pid: int) -> set[str]:
    try:
        return {os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir()}
    except OSError:
        return set()


# --- records and figures


@pytest.mark.slow
def test_a_native_task_runs_at_its_own_rate(tmp_path):
    """Any Gymnasium id, and its plain sum of rewards beside the discounted return."""
    arguments = {"gamma": 0.99, "gamma_dt": 0.05, "updates_per_second": 0.1, "learning_starts_seconds": 20, "batch_size": 8}
    preset = tiny(
        tmp_path,
        tasks={"Pendulum-v1": {"rates": [20], "evaluations": 2, "arguments": arguments}},
        algorithms={name: {"setting": "small", "arguments": {}} for name in ("ctco", "sac")},
        seeds=1,
    )
    assert main(["run", "--preset", preset, "--folder", str(tmp_path / "study"), "--workers", "1"]) == 0
    records = read_records(tmp_path / "study")
    assert [record["algorithm"] for record in records] == ["ctco", "sac"]
    for record in records:
        assert record["dt"] == 0.05
        assert -2000 < record["greedy_episode_return"] < -500
        # A reward of r all the time is worth 200·r in sum, and (1 − e^(−10τ))/τ·r = 4.3·r discounted.
        assert 4.3 / 200 * 0.3 < record["greedy_return"] / record["greedy_episode_return"] < 4.3 / 200 * 3
    rows = list(csv.DictReader((tmp_path / "study" / "Pendulum-v1-sac_small-20hz-seed0" / "evaluation.csv").open()))
    assert [float(row["task_seconds"]) for row in rows] == pytest.approx([95, 100])
    with pytest.raises(ValueError, match="task Pendulum-v1 runs at 20 Hz, not at 50 Hz"):
        find_task("Pendulum-v1").make_env(50)


def test_a_row_makes_an_algorithm_and_a_task_part_of_a_study(tmp_path, monkeypatch):
    row = dataclasses.replace(ALGORITHM_ROWS["ctco"], name="dummy", label="a dummy", colour="C7")
    monkeypatch.setitem(ALGORITHM_ROWS, "dummy", row)
    monkeypatch.setitem(TASKS, "swing", Task("swing", "a swing", "sb3_ctco/pendulum-swingup-v0"))
    arguments = yaml.safe_load(Path(tiny(tmp_path)).read_text())["algorithms"]["ctco"]
    preset = tiny(tmp_path, tasks=["swing"], rates=[25], algorithms={"dummy": arguments}, seeds=1)
    (run,) = load_preset(preset).runs
    runs.plan([run], tmp_path / "study")
    assert runs.perform(run, tmp_path / "study").state == "done"
    assert main(["plot", str(tmp_path / "study")]) == 0
    assert "| a swing | a dummy | small |" in (tmp_path / "study" / "figures" / "table.md").read_text()


def synthetic(n_seeds: int = 2) -> list[dict]:
    """Records whose returns are the paper's, ±0.1 with the seeds 0 and 1; CTCO with two settings."""
    records = []
    for run in load_preset("quick").select(seeds=range(n_seeds)):
        value = paper_returns()[run.task, run.algorithm][run.rate] * (0.5 if run.setting == "paper" else 1.0)
        value += 0.1 * (2 * run.seed - 1)
        rate = 3.0 if run.algorithm == "ctco" else float(run.rate)
        made = {"discounted_return": value, "greedy_return": value + 0.2, "decision_rate_hz": rate}
        made |= {
            "episode_return": 50 * value,
            "greedy_episode_return": 50 * value,
            "greedy_decision_rate_hz": rate,
            "updates": 48000,
            "wall_seconds": 100.0,
            "commit": "abc1234",
            "versions": "a=1",
        }
        known = {name: getattr(run, name) for name in COLUMNS if name not in made}
        records.append({name: {**known, **made}[name] for name in COLUMNS})
    return records


def write_csv(file: Path, records: list[dict]) -> Path:
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(COLUMNS))
        writer.writeheader()
        writer.writerows(records)
    return file


def test_making_a_model_leaves_its_run_as_it_was():
    """A record is known by its run's settings, and Stable-Baselines3 writes into the policy_kwargs that it is given."""
    for run in load_preset("smoke").select(tasks=["point_mass"], rates=[50]):
        before = run.fingerprint
        agents.make_model(run).get_env().close()
        assert run.fingerprint == before, run.name


@pytest.mark.slow
def test_collect_merges_and_skip_records_skips(finished, tmp_path, capsys):
    preset, folder = finished
    into = tmp_path / "results" / "tiny.csv"
    part = tmp_path / "part"
    shutil.copytree(folder, part)
    for path in part.glob("*seed1"):
        (path / "record.json").unlink()
    into.parent.mkdir()
    into.write_text(",".join(COLUMNS) + "\n")  # a table without rows
    assert collect([part], into) == (1, 1)
    elsewhere = str(tmp_path / "elsewhere")
    assert main(["run", "--preset", preset, "--folder", elsewhere, "--skip-records", str(into), "--workers", "1"]) == 0
    assert [path.name[-5:] for path in Path(elsewhere).iterdir()] == ["seed1"]
    assert main(["collect", elsewhere, str(part), "--into", str(into)]) == 0
    assert "1 new rows, 2 in" in capsys.readouterr().out
    before = into.read_text()
    assert collect([folder], into) == (0, 2)
    assert into.read_text() == before
    assert [record["seed"] for record in read_records(into)] == [0, 1]
    assert read_records(into)[0] == read_records(folder)[0]
    with into.open() as file:
        columns = (
            "task,algorithm,dt,seed,discounted_return,greedy_return,decision_rate_hz,task_seconds,updates,wall_seconds,preset"
        )
        assert file.readline().startswith(columns)
    other = tiny(tmp_path, eval_episodes=2)
    assert main(["run", "--preset", other, "--folder", str(tmp_path / "other"), "--skip-records", str(into)]) == 1
    assert "with other settings" in capsys.readouterr().err


def test_the_numbers_of_the_paper():
    returns = paper_returns()
    assert len(returns) == 12
    assert returns["point_mass", "ctco"] == {50: 1.04, 100: 1.05, 250: 1.01, 500: 0.98}
    assert returns["ball_in_cup", "figar_sac"] == {50: 1.90, 100: 1.92, 250: 1.85, 500: 0.71}
    assert returns["cheetah", "dac_ppo"][500] == 0.24


def test_mean_and_interval_by_hand():
    # t(0.975, 1) = 12.706, the standard deviation of 1 and 1.2 is 0.2/√2, by √2 seeds.
    assert scores.mean_and_interval([1.0, 1.2]) == pytest.approx((1.1, 12.706 * 0.1), rel=1e-4)
    mean, half_width = scores.mean_and_interval([0.5])
    assert mean == 0.5
    assert math.isnan(half_width)


def test_the_figure_shows_the_records_and_the_paper():
    figure = plots.draw_metric(synthetic(), "discounted_return")
    assert [ax.get_title() for ax in figure.axes] == ["sparse point mass", "cheetah run", "ball in cup"]
    for ax, task in zip(figure.axes, ("point_mass", "cheetah", "ball_in_cup"), strict=True):
        lines = {line.get_label(): line for line in ax.get_lines()}
        assert ax.get_xscale() == "log"
        for algorithm in ALGORITHMS:
            name = ALGORITHM_ROWS[algorithm].label
            numbers = paper_returns()[task, algorithm]
            setting = "tuned" if algorithm == "ctco" else "large"
            for label in (f"{name} ({setting})", f"{name}, the paper's figure"):
                assert list(lines[label].get_xdata()) == [50, 100, 250, 500]
                np.testing.assert_allclose(lines[label].get_ydata(), list(numbers.values()))
        # The other setting of CTCO is a line of its own, with half of the return.
        np.testing.assert_allclose(
            lines["CTCO (paper)"].get_ydata(), 0.5 * np.array(list(paper_returns()[task, "ctco"].values()))
        )
        # The first line's interval at 50 Hz, by hand: t(0.975, 1) = 12.706 times 0.2/√2/√2.
        (_, low), (_, high) = ax.collections[0].get_segments()[0]
        mean = paper_returns()[task, "ctco"][50]
        assert (low, high) == pytest.approx((mean - 1.2706, mean + 1.2706), rel=1e-3)


@pytest.mark.usefixtures("few_resamples")
def test_interquartile_means_are_those_of_rliable():
    estimates = scores.interquartile_means(synthetic(), "discounted_return")
    tau = -math.log(0.98) / 0.05
    returns = [paper_returns()[task, "sac"][50] for task in ("point_mass", "cheetah", "ball_in_cup")]
    fractions = tau * np.array([[value - 0.1 for value in returns], [value + 0.1 for value in returns]])
    mean, low, high = estimates["sac", "large"][50]
    assert mean == pytest.approx(aggregate_iqm(fractions))
    assert low < mean < high
    # Without one task of one seed, the other seed remains, and there is no interval.
    holed = [one for one in synthetic() if not (one["algorithm"] == "sac" and one["seed"] == 1 and one["task"] == "cheetah")]
    mean, low, high = scores.interquartile_means(holed, "discounted_return")["sac", "large"][50]
    assert mean == pytest.approx(aggregate_iqm(fractions[:1]))
    assert math.isnan(low)
    assert math.isnan(high)


@pytest.mark.usefixtures("few_resamples")
def with_repeats():
    """Synthetic records, and action repeats of which 5 steps are best at 50 Hz, and 25 at 500 Hz."""
    records = [record for record in synthetic() if record["algorithm"] == "sac"]
    repeats = []
    for record in records:
        rate = round(1 / record["dt"])
        for steps in (5, 25):
            value = 2.0 if steps == {50: 5, 500: 25}.get(rate) else 0.1
            held = {"algorithm": "sac_repeat", "discounted_return": value, "greedy_return": value}
            repeats.append({**record, **held, "setting": f"{steps}steps", "decision_rate_hz": rate / steps})
        if rate > 50:
            repeats.append({**record, "algorithm": "sac_repeat", "setting": "20ms", "discounted_return": 0.3})
    return [*records, *repeats]


def test_sac_stands_for_a_repeat_of_one_step_and_the_best_is_a_line():
    records = scores.with_equal_repeats(with_repeats())
    assert scores.lines_of(records) == [("sac", "large"), ("sac_repeat", "20ms"), ("sac_repeat", "best")]
    lines = scores.by_line(records, "cheetah", "discounted_return")
    sac = lines["sac", "large"]
    # 20 ms at 100 and 250 Hz are two steps and five.
    assert lines["sac_repeat", "best"] == {50: [2.0, 2.0], 100: [0.3, 0.3], 250: [0.3, 0.3], 500: [2.0, 2.0]}
    # 20 ms at 50 Hz is a step.
    assert lines["sac_repeat", "20ms"] == {50: sac[50], 100: [0.3, 0.3], 250: [0.3, 0.3], 500: [0.3, 0.3]}
    assert scores.with_equal_repeats(synthetic()) == synthetic()
    # Where no number of steps was tried, none is the best; and a setting of a name of its own is no number of them.
    held = [{**record, "setting": "slow"} if record["setting"] == "20ms" else record for record in with_repeats()]
    held = [record for record in held if not record["setting"].endswith("steps")]
    assert scores.lines_of(scores.with_equal_repeats(held)) == [("sac", "large"), ("sac_repeat", "slow")]


def scored(**returns):
    """Records of two tasks at two rates: a list of seeds for each algorithm, task and rate, as in ``sac_cheetah_50``."""
    records = []
    for name, values in returns.items():
        algorithm, task, rate = name.split("_")
        for seed, value in enumerate(values):
            record = {"algorithm": algorithm, "setting": "a", "task": task, "dt": 1 / int(rate), "seed": seed}
            records.append({**record, "discounted_return": value})
    return records


def test_scores_by_hand(few_resamples):
    """The best of cheetah is 2 (CTCO at 500 Hz), of Pendulum-v1 4 (SAC at 50 Hz)."""
    name = "Pendulum-v1"
    records = scored(
        **{"ctco_cheetah_50": [1, 1], "ctco_cheetah_500": [1, 3], f"ctco_{name}_50": [2, 2], f"ctco_{name}_500": [2, 2]},
        **{"sac_cheetah_50": [1, 2], "sac_cheetah_500": [0, 0], f"sac_{name}_50": [4, 4], f"sac_{name}_500": [0, 3]},
    )
    relative = scores.relative_scores(records, "discounted_return")
    assert relative["ctco", "a"][500].tolist() == [[0.5, 0.5], [1.5, 0.5]]
    assert relative["sac", "a"][50].tolist() == [[0.5, 1.0], [1.0, 1.0]]
    averaged = scores.frequency_averaged(relative)
    # Means over rates: CTCO 0.5 and 1.0 on cheetah, 0.5 twice; SAC 0.25 and 0.5, 0.5 and 0.875. Middle halves: 0.5; 0.5.
    assert averaged["ctco", "a"][0] == pytest.approx(0.5)
    assert averaged["sac", "a"][0] == pytest.approx(0.5)
    # At 50 Hz CTCO's seeds are ahead of SAC's never, and level in half of cheetah's pairs: (½·½ + 0)/2.
    better = scores.improvement(relative, ("ctco", "a"))
    assert list(better) == [("sac", "a")]
    assert better["sac", "a"][50][0] == pytest.approx(0.125)
    assert better["sac", "a"][500][0] == pytest.approx((1.0 + 0.5) / 2)
    assert better["sac", "a"][500][0] == pytest.approx(
        probability_of_improvement(relative["ctco", "a"][500], relative["sac", "a"][500])
    )
    _, low, high = better["sac", "a"][50]
    assert low <= 0.125 <= high
    assert "| CTCO | a | 2 | 0.50 [" in tables.averaged_table(relative)
    # A rate that a line lacks leaves it out of the average over rates, and in at the others.
    without = scores.relative_scores([r for r in records if (r["algorithm"], r["dt"]) != ("sac", 0.02)], "discounted_return")
    assert list(scores.frequency_averaged(without)) == [("ctco", "a")]
    assert list(scores.improvement(without, ("ctco", "a"))["sac", "a"]) == [500]


def test_sac_stands_in_with_runs_as_long_of_one_setting_and_once():
    longer = [{**record, "task_seconds": 6000.0, "seed": record["seed"] + 10} for record in synthetic()]
    small = [{**record, "setting": "small"} for record in synthetic(1) if record["algorithm"] == "sac"]
    own = [{**record, "setting": "20ms", "algorithm": "sac_repeat"} for record in synthetic(1) if record["algorithm"] == "sac"]
    records = scores.with_equal_repeats([*with_repeats(), *longer, *small, *own])
    lines = scores.by_line(records, "cheetah", "discounted_return")
    assert len(lines["sac_repeat", "20ms"][50]) == 2  # seed 0 its own, seed 1 SAC's
    assert len(lines["sac_repeat", "best"][50]) == 2


def test_the_best_repeat_has_as_many_seeds_as_any():
    lucky = [{**r, "setting": "50steps", "discounted_return": 9.0} for r in with_repeats() if r["setting"] == "25steps"]
    records = scores.with_equal_repeats([*with_repeats(), *(record for record in lucky if record["seed"] == 0)])
    assert 9.0 not in scores.by_line(records, "cheetah", "discounted_return")["sac_repeat", "best"][500]


def test_the_same_seed_of_two_presets_is_no_second_seed(tmp_path):
    one = write_csv(tmp_path / "one.csv", synthetic())
    other = write_csv(tmp_path / "other.csv", [{**record, "preset": "native"} for record in synthetic()])
    with pytest.raises(ValueError, match=r"presets quick and native both have seed 0 of .*: they are no two seeds"):
        plots.plot([one, other], tmp_path / "figures")


def test_settings_of_an_algorithm_look_different():
    lines = [("sac_repeat", f"{n}steps") for n in (1, 2, 5, 10, 25, 50)] + [("sac_repeat", "20ms")]
    assert len({str(plots._style(line, lines)[0]) for line in lines}) == len(lines)


def test_the_pareto_figure_names_the_settings_of_an_algorithm():
    figure = plots.draw_pareto(with_repeats(), "discounted_return")
    assert len(figure.axes) == 4 * 3
    ax = next(ax for ax in figure.axes if ax.get_title() == "cheetah run, 500 Hz")
    points = {container.get_label(): container.lines[0].get_xydata().tolist() for container in ax.containers}
    assert points["SAC, action repeat"][0] == [20.0, 2.0]
    assert [x for x, _ in points["SAC, action repeat"]] == sorted(x for x, _ in points["SAC, action repeat"])
    assert {"5steps", "25steps", "20ms", "large"} == {text.get_text() for text in ax.texts}


def test_the_table_stands_beside_the_papers_numbers():
    estimates = {"discounted_return": scores.interquartile_means(synthetic(), "discounted_return")}
    lines = tables.table(synthetic(), estimates).splitlines()
    training = lines[: lines.index("## Discounted return, greedy episodes")]
    assert "| cheetah run | SAC | large | 2 | 1.07 ± 1.27 | 0.15 ± 1.27 | 0.06 ± 1.27 | 0.07 ± 1.27 |" in training
    assert "| cheetah run | SAC | *the paper's figure* | 30 | 1.07 | 0.15 | 0.06 | 0.07 |" in training
    assert "| cheetah run | SAC | large | 2 | 1.27 ± 1.27 | 0.35 ± 1.27 | 0.26 ± 1.27 | 0.27 ± 1.27 |" in lines
    assert any(line.startswith("| training | CTCO | tuned | ") and "[" in line for line in lines)
    assert lines[0].startswith("Preset quick (2400 s of task time); 2 seeds; commit abc1234.")
    without = [{**record, "episode_return": math.nan, "greedy_episode_return": math.nan} for record in synthetic(1)]
    assert "Sum of rewards" not in tables.table(without, {})
    with_sums = [{**record, "episode_return": 250.0, "greedy_episode_return": math.nan} for record in synthetic(1)]
    (sums,) = [part for part in tables.table(with_sums, {}).split("## ") if "um of rewards" in part]
    assert sums.startswith("Sum of rewards, training episodes of the last tenth\n")
    assert "| cheetah run | SAC | large | 1 | 250.00 | 250.00 | 250.00 | 250.00 |" in sums
    assert "the paper's figure" not in sums
    assert "| cheetah run | SAC | large | 1 | 0.97 | 0.05 | -0.04 | -0.03 |" in tables.table(synthetic(1), {})
    assert "; 1 to 2 seeds; " in tables.table(synthetic()[1:], {})


@pytest.mark.slow
@pytest.mark.usefixtures("few_resamples")
def test_plot_of_a_csv_file_and_of_a_folder(finished, tmp_path, capsys):
    file = write_csv(tmp_path / "quick.csv", synthetic())
    assert main(["plot", str(file), "--output", str(tmp_path / "figures")]) == 0
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    drawn = (
        *("frequency", "frequency_greedy", "decision_rates", "interquartile_means"),
        *("pareto", "profiles", "improvement"),
    )
    assert names == {f"{name}.{ending}" for name in drawn for ending in ("png", "svg")} | {"table.md"}
    for name in drawn:
        picture = mpl.image.imread(tmp_path / "figures" / f"{name}.png")
        assert picture[..., :3].std() > 0.05  # not blank
    assert "FiGAR-SAC (large)" in (tmp_path / "figures" / "frequency.svg").read_text()
    assert "## Averaged over rates" in (tmp_path / "figures" / "table.md").read_text()


def test_plot_of_several_files_and_of_some_lines(tmp_path, capsys, few_resamples):
    records = with_repeats()
    kinds = ("sac", "sac_repeat")
    files = [write_csv(tmp_path / f"{kind}.csv", [one for one in records if one["algorithm"] == kind]) for kind in kinds]
    command = ["plot", *map(str, files), "--output", str(tmp_path / "figures"), "--settings"]
    assert main([*command, "large", "best"]) == 0
    text = (tmp_path / "figures" / "frequency.svg").read_text()
    assert "SAC, action repeat (best)" in text
    assert "20ms" not in text
    assert main([*command, "worst"]) == 1
    assert "no record has an algorithm of None and a setting of ['worst']" in capsys.readouterr().err


@pytest.mark.slow
def test_learning_curves_of_a_folder_and_of_a_csv_file(finished, tmp_path, capsys):
    _, folder = finished
    assert main(["collect", str(folder), "--into", str(tmp_path / "tiny.csv")]) == 0
    assert read_curves(tmp_path / "tiny.csv") == read_curves(folder)
    for source in (folder, tmp_path / "tiny.csv"):
        assert main(["plot", str(source), "--output", str(tmp_path / "tiny")]) == 0
        assert "learning_curves.png" in capsys.readouterr().out
    points = read_curves(folder)
    (axes,) = plots.draw_learning_curves(points).axes
    files = sorted(folder.glob("*/monitor.csv"))
    first, second = ([float(row["discounted_return"]) for row in csv.DictReader(file.open())] for file in files)
    line, *others = axes.get_lines()
    assert not others
    np.testing.assert_allclose(line.get_xdata(), [50 / 60, 100 / 60])
    # Half of ten episodes is the window; a point is the mean over both seeds.
    means = np.mean([[np.mean(one[:5]), np.mean(one[5:])] for one in (first, second)], axis=0)
    np.testing.assert_allclose(line.get_ydata(), means, atol=1e-5)
    assert not axes.collections  # two seeds have no band
    third = [{**point, "seed": 2, "discounted_return": 0.3} for point in points if point["seed"] == 0]
    (axes,) = plots.draw_learning_curves([*points, *third]).axes
    # The band by hand: t(0.975, 2) = 4.303 times s/√3
    band = axes.collections[0].get_paths()[0].vertices[:, 1]
    last = [np.mean(first[5:]), np.mean(second[5:]), 0.3]
    half_width = 4.303 * np.std(last, ddof=1) / np.sqrt(3)
    assert half_width > 0
    for bound in (np.mean(last) - half_width, np.mean(last) + half_width):
        assert np.abs(band - bound).min() < 1e-3


def test_collect_takes_records_of_before_and_refuses_a_folder(finished, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path / "before")
    for file in (tmp_path / "before").glob("*/record.json"):
        record = json.loads(file.read_text())
        del record["episode_return"], record["greedy_episode_return"]
        file.write_text(json.dumps(record))
    collect([tmp_path / "before"], tmp_path / "all.csv")
    assert all(math.isnan(record["episode_return"]) for record in read_records(tmp_path / "all.csv"))
    (tmp_path / "results").mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ValueError, match="results is a folder: name a CSV file"):
        collect([folder], tmp_path / "results")
    assert sorted(tmp_path.iterdir()) == before


def test_a_run_in_whose_last_tenth_no_episode_ended_is_not_drawn(finished, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path / "study")
    file = next((tmp_path / "study").glob("*seed1/record.json"))
    file.write_text(json.dumps({**json.loads(file.read_text()), "discounted_return": math.nan}))
    plots.plot([tmp_path / "study"], tmp_path / "figures")
    assert (tmp_path / "figures" / "frequency.png").exists()


def test_collect_keeps_curves_of_other_folders(finished, tmp_path):
    _, folder = finished
    names = sorted(path.name for path in folder.iterdir())
    for name in names:
        shutil.copytree(folder / name, tmp_path / name / name)
    # A run in flight has a curve, but no record.
    (tmp_path / names[1] / "in_flight").mkdir()
    for file in ("settings.json", "monitor.csv"):
        text = (folder / names[1] / file).read_text().replace('"seed": 1', '"seed": 7')
        (tmp_path / names[1] / "in_flight" / file).write_text(text)
    for name in names:
        collect([tmp_path / name], tmp_path / "all.csv")
    assert {point["seed"] for point in read_curves(tmp_path / "all.csv")} == {0, 1}
    assert {point["seed"] for point in read_curves(tmp_path / names[1])} == {1, 7}


def test_collect_takes_no_curve_of_a_run_that_is_not_complete_there(finished, tmp_path):
    _, folder = finished
    collect([folder], tmp_path / "all.csv")
    (tmp_path / "all_curves.csv").unlink()
    shutil.copytree(folder, tmp_path / "again")
    next((tmp_path / "again").glob("*seed0/record.json")).unlink()
    assert collect([tmp_path / "again"], tmp_path / "all.csv") == (0, 2)
    assert {point["seed"] for point in read_curves(tmp_path / "all.csv")} == {1}


def test_status_estimates_the_time_left(finished, tmp_path, capsys):
    _, original = finished
    folder = tmp_path / "study"
    shutil.copytree(original, folder)
    first, second = sorted(folder.iterdir())
    record = json.loads((first / "record.json").read_text())
    (first / "record.json").write_text(json.dumps({**record, "wall_seconds": 7200.0}))
    (second / "record.json").unlink()
    (second / "monitor.csv").write_text(
        "task_seconds,discounted_return,decision_rate_hz,wall_seconds\n10.0,0.5,3.0,1000.0\n25.0,1.5,3.0,1800.0\n"
    )
    with runs.lock(second):
        assert main(["status", str(folder)]) == 0
    # Both take 7,200 s: of the second a quarter is done.
    assert capsys.readouterr().out == (
        "1 of 2 runs done, 1 running, 1 h 30 min left\nrunning point_mass-ctco_small-50hz-seed1: 25 %, return 1.00\n"
    )


def recorded(task, algorithm, rate, seconds, setting="large"):
    """What a plan reads of a record: ``seconds`` of wall time for 1,000 s of task time."""
    return {
        "task": task,
        "algorithm": algorithm,
        "setting": setting,
        "dt": 1 / rate,
        "task_seconds": 1000.0,
        "wall_seconds": seconds,
    }


def test_what_runs_are_expected_to_take():
    quick = load_preset("quick")

    def cost(task, algorithm, rate, setting, *sources):
        (run,) = quick.select([task], [rate], [algorithm], [setting])
        return schedule.costs([run], *sources)[run.name] / 2400  # s a second of task time

    here = [recorded("cheetah", "sac", 500, 900.0), recorded("cheetah", "sac", 500, 700.0)]
    there = [
        recorded("cheetah", "sac", 500, 5000.0),
        recorded("point_mass", "sac", 500, 300.0),
        recorded("cheetah", "ctco", 500, 100.0, "tuned"),
    ]
    assert cost("cheetah", "sac", 500, "large", here, there) == pytest.approx(0.8)  # this machine's, of the same kind
    assert cost("cheetah", "sac", 500, "large", there) == pytest.approx(5.0)
    assert cost("ball_in_cup", "sac", 500, "large", there) == pytest.approx(2.65)  # other tasks
    assert cost("cheetah", "ctco", 500, "paper", here, there) == pytest.approx(0.1)  # another setting
    assert cost("cheetah", "dac_ppo", 500, "large", there) == pytest.approx(5.0)  # the dearest at its rate
    assert cost("cheetah", "dac_ppo", 50, "large", there) == pytest.approx(5.0)  # the dearest of all
    assert cost("cheetah", "dac_ppo", 50, "large") == schedule.UNKNOWN


def test_the_plan_is_seed_by_seed_and_the_cheap_first_and_ends_in_time():
    runs = load_preset("quick").select(["cheetah"], [50, 500], ["ctco", "sac"], ["tuned", "large"], seeds=[0, 1])
    hours = {("ctco", 50): 1.0, ("ctco", 500): 2.0, ("sac", 50): 3.0, ("sac", 500): 9.0}
    cost = {run.name: hours[run.algorithm, run.rate] for run in runs}

    def plan(workers, seconds):
        return [(begin, run.seed, run.algorithm, run.rate) for begin, run in schedule.fit(runs, cost, workers, seconds)]

    # One process and ten hours: seed 0 but for the run of nine hours, and of seed 1 what fits in.
    assert plan(1, 10.0) == [
        (0, 0, "ctco", 50),
        (1, 0, "ctco", 500),
        (3, 0, "sac", 50),
        (6, 1, "ctco", 50),
        (7, 1, "ctco", 500),
    ]
    assert len(plan(1, 30.0)) == len(runs)
    # Two: the second begins with the second, and the first is free again for the third.
    assert plan(2, 4.0) == [(0, 0, "ctco", 50), (0, 0, "ctco", 500), (1, 0, "sac", 50), (2, 1, "ctco", 50)]


def test_hours_make_what_fits_and_leave_the_rest(finished, tmp_path, capsys):
    preset, folder = finished
    collect([folder], tmp_path / "costs.csv")
    rows = list(csv.DictReader((tmp_path / "costs.csv").open()))
    for row in rows:
        row["wall_seconds"] = 3000
    with (tmp_path / "costs.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    study = tmp_path / "study"
    command = ["run", "--preset", preset, "--folder", str(study), "--workers", "1", "--costs", str(tmp_path / "costs.csv")]
    assert main([*command, "--hours", "1"]) == 0
    output = capsys.readouterr().out
    assert "1 of 2 runs fit into 1 h on 1 processes (0.8 h in all):" in output
    assert "  after 0 min: point_mass-ctco_small-50hz-seed0, 50 min" in output
    assert [record["seed"] for record in read_records(study)] == [0]
    # What the first took is known by then, and the second fits.
    assert main([*command, "--hours", "1"]) == 0
    assert [record["seed"] for record in read_records(study)] == [0, 1]


def test_a_run_that_cannot_end_any_more_is_not_begun(finished, tmp_path):
    preset, _ = finished
    runs_ = load_preset(preset).runs
    runs.plan(runs_, tmp_path)
    outcomes = list(engines.run_local(runs_, tmp_path, 1, may_begin=lambda run: run.seed == 1))
    assert [(outcome.name, outcome.state) for outcome in outcomes] == [(runs_[1].name, "done")]


@pytest.mark.slow
def test_the_smoke_preset(tmp_path):
    folder = tmp_path / "smoke"
    assert main(["run", "--preset", "smoke", "--folder", str(folder), "--workers", "2"]) == 0
    records = read_records(folder)
    assert len(records) == 16
    assert {record["algorithm"] for record in records} == set(ALGORITHMS)
    for record in records:
        assert 0.0 <= record["discounted_return"] <= 2.48
        assert record["updates"] == pytest.approx(100 if record["algorithm"] == "dac_ppo" else 80, abs=2)
        if record["algorithm"] in ("sac", "dac_ppo"):
            assert record["decision_rate_hz"] == pytest.approx(1 / record["dt"])
        else:
            assert record["decision_rate_hz"] < 1 / record["dt"]
    assert main(["plot", str(folder)]) == 0
    assert "FiGAR-SAC" in (folder / "figures" / "table.md").read_text()


def test_tasks_that_cost_have_no_score():
    name = "Pendulum-v1"
    values = {"ctco_cheetah_50": [1, 1], f"ctco_{name}_50": [-2, -3], "sac_cheetah_50": [2, 2], f"sac_{name}_50": [-4, -1]}
    records = scored(**values)
    assert scores.relative_scores(records, "discounted_return")["ctco", "a"][50].tolist() == [[0.5], [0.5]]
    costs = [record for record in records if record["task"] == name]
    assert scores.relative_scores(costs, "discounted_return") == {}


@pytest.mark.parametrize("name", ["seed", "device", "dt", "n_envs"])
def test_a_preset_does_not_say_what_the_study_says(name, tmp_path):
    preset = yaml.safe_load(Path(tiny(tmp_path)).read_text())
    preset["algorithms"]["ctco"]["arguments"][name] = 1
    file = tmp_path / "other.yml"
    file.write_text(yaml.safe_dump(preset))
    with pytest.raises(ValueError, match=rf"ctco \(small\) has no arguments \['{name}'\]"):
        agents.constructor_arguments(load_preset(str(file)).select()[0])


def test_a_run_in_two_sources_is_one_run(tmp_path):
    file = write_csv(tmp_path / "one.csv", synthetic(1))
    shutil.copy(file, tmp_path / "two.csv")
    plots.plot([file, tmp_path / "two.csv"], tmp_path / "figures")
    assert "; 1 seed; " in (tmp_path / "figures" / "table.md").read_text()
    other = write_csv(tmp_path / "other.csv", [{**record, "fingerprint": "00000000"} for record in synthetic(1)])
    with pytest.raises(ValueError, match="with other settings"):
        plots.plot([file, other], tmp_path / "figures")
    longer = [{**record, "preset": "learning", "task_seconds": 6000.0} for record in synthetic(1)]
    longer = write_csv(tmp_path / "longer.csv", longer)
    with pytest.raises(ValueError, match="preset learning with 6000 s of task time, and preset quick has 2400 s"):
        plots.plot([file, longer], tmp_path / "figures")
    file.write_text(file.read_text()[:-40])
    with pytest.raises(ValueError, match=r"one.csv, line \d+, is damaged or cut off"):
        read_records(file)


def test_curves_of_episodes_that_end_at_other_times_have_a_mean():
    """0 at 0 s and 10 at 10 s; 0 at 5 s and 20 at 15 s: at 5 s the mean of 5 and 0, at 10 s that of 10 and 10."""
    together = plots._together([[(0.0, 0.0), (10.0, 10.0)], [(5.0, 0.0), (15.0, 20.0)]])
    assert together == {5.0: [5.0, 0.0], 10.0: [10.0, 10.0]}  # where there are both
    assert plots._together([]) == {}


def test_a_legend_has_what_any_panel_has():
    records = [record for record in synthetic() if (record["task"], record["algorithm"]) != ("point_mass", "sac")]
    labels = [text.get_text() for text in plots.draw_metric(records, "discounted_return").legends[0].get_texts()]
    assert "SAC (large)" in labels
    assert len(labels) == len(set(labels))


def test_interquartile_means_of_costs_stand_upright():
    records = [{**record, "discounted_return": -1.0 - record["discounted_return"]} for record in synthetic()]
    estimates = {name: scores.interquartile_means(records, name) for name in ("discounted_return", "greedy_return")}
    low, high = plots.draw_interquartile_means(records, estimates).axes[0].get_ylim()
    assert low < 0.0 <= high


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learning_starts_seconds": "1m"}, "learning_starts_seconds='1m', which must be a number of at least 0"),
        ({"learning_starts_seconds": None}, "learning_starts_seconds=None, which must be a number"),
        ({"policy_kwargs": {"features_extractor_class": 5}}, "there is no features_extractor_class 5"),
        ({"policy_kwargs": {"features_extractor_class": "subprocess.Popen"}}, "no features_extractor_class subprocess.Popen"),
        ({"policy_kwargs": {"features_extractor_class": "this.x"}}, "there is no features_extractor_class this.x"),
    ],
)
def test_arguments_that_cannot_be_right_are_named(changes, message, tmp_path):
    preset = yaml.safe_load(Path(tiny(tmp_path)).read_text())
    preset["algorithms"]["ctco"]["arguments"] |= changes
    file = tmp_path / "other.yml"
    file.write_text(yaml.safe_dump(preset))
    with pytest.raises(ValueError, match=message):
        agents.constructor_arguments(load_preset(str(file)).select()[0])
    assert "this" not in sys.modules  # to look a name up runs nothing


OWN_ENVIRONMENT = """
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv


class Swing(PendulumEnv):
    pass


gym.register("Swing-v0", Swing, max_episode_steps=200)
"""


def test_an_environment_of_one_s_own_is_a_task(tmp_path, monkeypatch, few_resamples, capsys):
    (tmp_path / "my_swing.py").write_text(OWN_ENVIRONMENT)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")  # of the workers
    monkeypatch.syspath_prepend(str(tmp_path))
    preset = tiny(tmp_path, tasks=["Swing-v0"], rates=[20], seeds=1)
    command = ["run", "--preset", preset, "--folder", str(tmp_path / "study"), "--workers", "1"]
    assert main(command) == 1
    assert "--gym-packages names the module that registers them" in capsys.readouterr().err
    try:
        assert main([*command, "--gym-packages", "my_swing"]) == 0
        assert main(["plot", str(tmp_path / "study"), "--gym-packages", "my_swing"]) == 0
        assert "Swing-v0" in (tmp_path / "study" / "figures" / "table.md").read_text()
        assert main([*command, "--gym-packages", "no_such_module"]) == 1
        assert "--gym-packages no_such_module cannot be imported" in capsys.readouterr().err
    finally:
        gymnasium.registry.pop("Swing-v0", None)
        sys.modules.pop("my_swing", None)


def test_an_id_of_one_rate_has_episodes_as_long_as_it_says():
    assert find_task("sb3_ctco/cheetah-run-50hz-v0").seconds_of_episode(50) == 10.0
    assert find_task("Pendulum-v1").seconds_of_episode(20) == 10.0
    with pytest.raises(ValueError, match=r"has rollout_seconds, whole episodes of a task that has no longest one"):
        ALGORITHM_ROWS["dac_ppo"].arguments({"rollout_seconds": 40}, 0.05, 0.0, "dac_ppo (mine)")


def test_a_subclass_has_its_bases_arguments_in_a_preset():
    class Mine(CTCO):
        def __init__(self, *args, alpha=0.1, **kwargs):
            super().__init__(*args, **kwargs)

    row = registry.Algorithm("mine", "mine", "C4", **registry._of_options(Mine))
    given = {"gamma": 0.98, "gamma_dt": 0.05, "updates_per_second": 20, "alpha": 0.2, "n_rbf": 2}
    assert row.arguments(given, 0.02, 10.0, "a preset") == given
    with pytest.raises(ValueError, match=r"a preset has no arguments \['beta'\]"):
        row.arguments({**given, "beta": 1}, 0.02, 10.0, "a preset")


def test_seeds_of_other_settings_make_no_mean(tmp_path):
    first = load_preset(tiny(tmp_path, seeds=1)).runs
    runs.plan(first, tmp_path / "study")
    other = load_preset(tiny(tmp_path, name="other", task_seconds=200)).select(seeds=[1])
    with pytest.raises(ValueError, match=r"seed0/settings.json has other settings than preset tiny: task_seconds: 100"):
        runs.plan(other, tmp_path / "study")
    assert not (tmp_path / "study" / other[0].name).exists()
    runs.plan(load_preset(tiny(tmp_path, name="same")).select(seeds=[1]), tmp_path / "study")


def test_a_run_that_failed_is_planned_anew_with_other_settings(tmp_path):
    (run,) = load_preset(tiny(tmp_path, seeds=1)).runs
    runs.plan([run], tmp_path / "study")
    runs.record_failure(run, tmp_path / "study", ValueError("a mistake in an argument"))
    (corrected,) = load_preset(tiny(tmp_path, seeds=1, task_seconds=200)).runs
    runs.plan([corrected], tmp_path / "study")
    assert runs.read_json(tmp_path / "study" / run.name / "settings.json")["task_seconds"] == 200
    (tmp_path / "study" / run.name / "record.json").write_text("{}")
    with pytest.raises(ValueError, match="has other settings"):
        runs.plan([run], tmp_path / "study")


def test_a_record_that_is_damaged_is_named(tmp_path):
    (run,) = load_preset(tiny(tmp_path, seeds=1)).runs
    runs.plan([run], tmp_path)
    (tmp_path / run.name / "record.json").write_text("")
    for read in (read_records, status.read_status):
        with pytest.raises(ValueError, match=r"record.json is damaged .*: delete .* to run it again"):
            read(tmp_path)


def test_none_that_fits_is_no_error(tmp_path, capsys):
    assert main(["run", "--preset", tiny(tmp_path), "--folder", str(tmp_path / "study"), "--hours", "0.0000001"]) == 0
    assert "0 of 2 runs fit into" in capsys.readouterr().out


def test_a_name_that_is_there_twice(tmp_path):
    file = Path(tiny(tmp_path))
    file.write_text(file.read_text() + "\nseeds: 3\n")
    with pytest.raises(ValueError, match="'seeds' is there twice"):
        load_preset(str(file))


def test_entries_without_runs_or_with_the_same_folder(tmp_path):
    with pytest.raises(ValueError, match=r"ctco \(small\) has no run, since no task has one of its rates \[100\]"):
        load_preset(tiny(tmp_path, algorithms={"ctco": {"setting": "small", "rates": [100], "arguments": {}}}))
    same = {"sac": {"setting": "repeat_x", "arguments": {}}, "sac_repeat": {"setting": "x", "arguments": {}}}
    with pytest.raises(ValueError, match=r"sac_repeat \(x\) and sac \(repeat_x\) would have the same folder"):
        load_preset(tiny(tmp_path, algorithms=same))


def test_versions_of_what_is_installed(monkeypatch):
    monkeypatch.setattr(runs, "_PACKAGES", ("numpy", "not-installed-anywhere"))
    assert list(runs.package_versions()) == ["python", "numpy"]


def test_figures_of_one_rate_and_of_costs(tmp_path):
    """Points and their intervals are side by side, and the worst seed is inside of the panel."""
    records = [{**r, "discounted_return": -10.0 - r["seed"]} for r in synthetic() if r["dt"] == 0.02]
    figure = plots.draw_metric(records, "discounted_return")
    for ax in figure.axes:
        low, high = ax.get_xlim()
        assert low < 50 / 1.2
        assert high > 50 * 1.2
        assert ax.get_ylim()[0] < -11.0
    pareto = plots.draw_pareto([{**r, "decision_rate_hz": 0.4} for r in records], "discounted_return")
    assert all(ax.get_xlim()[0] < 0.4 for ax in pareto.axes)
