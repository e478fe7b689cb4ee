"""RL Zoo with CTCO: the packaged files, and train, enjoy and tune as a user calls them."""

import csv
import pickle
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml

pytest.importorskip("rl_zoo3")

import rl_zoo3.train
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS

from sb3_ctco import CTCO, OptionExecutionWrapper
from sb3_ctco.cli import main as cli
from sb3_ctco.zoo import OptionExperimentManager, convert_ctco_params, main, packaged_config, with_defaults

#: Small networks' worth of warm-up, so that a run of 200 steps updates as well.
FEW_STEPS = ["-n", "200", "--eval-freq", "-1", "--seed", "0", "--device", "cpu", "--verbose", "0"]
FEW_STEPS_PARAMS = ["-params", "learning_starts:50", "buffer_size:500", "batch_size:16"]
TUNED = {
    "Pendulum-v1",
    "MountainCarContinuous-v0",
    "Hopper-v5",
    "HalfCheetah-v5",
    "Walker2d-v5",
    "Reacher-v5",
    *(
        f"sb3_ctco/{task}-{rate}hz-v0"
        for task in ("point_mass-sparse", "cheetah-run", "ball_in_cup-catch")
        for rate in (50, 100, 250, 500)
    ),
    *(f"sb3_ctco/visual_reacher-{difficulty}-v0" for difficulty in ("easy", "hard")),
}


def entries(algo: str) -> dict:
    config = packaged_config(algo)
    assert config is not None
    return yaml.safe_load(Path(config).read_text())


@pytest.fixture
def models(monkeypatch) -> list:
    """The models that the Zoo trains, which it does not return."""
    trained = []
    save = OptionExperimentManager.save_trained_model
    monkeypatch.setattr(
        OptionExperimentManager, "save_trained_model", lambda self, model: (save(self, model), trained.append(model))
    )
    return trained


@pytest.mark.parametrize("algo", ["ctco", "sac"])
def test_packaged_files_have_the_same_entries_default_first(algo):
    names = list(entries(algo))
    assert names[0] == "default"
    assert set(names[1:]) == TUNED


@pytest.mark.parametrize(
    ("algo", "name"),
    [
        pytest.param(algo, name, marks=[] if name in ("default", "Pendulum-v1") else pytest.mark.slow)
        for algo in ("ctco", "sac")
        for name in entries(algo)
    ],
    ids=lambda value: value,
)
def test_each_entry_builds_and_takes_200_steps(request, tmp_path, models, algo, name):
    env_id = "sb3_ctco/cartpole-swingup-v0" if name == "default" else name
    if "visual" in name:
        request.getfixturevalue("opengl")
    main(["train", "--algo", algo, "--env", env_id, "-f", str(tmp_path), *FEW_STEPS, *FEW_STEPS_PARAMS])
    (model,) = models
    assert type(model) is ALGOS[algo]
    assert model.num_timesteps >= 200
    assert model._n_updates > 0
    for value in model.policy.state_dict().values():
        assert np.isfinite(value.numpy()).all()


def test_the_wrapper_has_the_settings_of_the_entry_and_the_command_line(tmp_path, models):
    params = [*FEW_STEPS_PARAMS, "n_rbf:4", "gamma:0.9", "gamma_dt:0.1", "n_sub_options:2"]
    main(["train", "--env", "Pendulum-v1", "-f", str(tmp_path), *FEW_STEPS, *params])
    (model,) = models
    assert model.n_rbf == 4
    assert model.d_max == entries("ctco")["Pendulum-v1"]["d_max"]
    assert model.option_space.discount_rate == pytest.approx(-np.log(0.9) / 0.1)
    assert model.get_env().get_attr("n_sub_options") == [2]
    saved = yaml.unsafe_load((tmp_path / "ctco/Pendulum-v1_1/Pendulum-v1/config.yml").read_text())
    wrapper = saved["env_wrapper"][0]["sb3_ctco.wrappers.OptionExecutionWrapper"]
    # What enjoy makes its environment with: sub-options are for learning only.
    assert (wrapper["n_rbf"], wrapper["n_sub_options"]) == (4, 0)


def test_other_wrappers_of_an_entry_go_inside(tmp_path, models):
    config = tmp_path / "own.yml"
    config.write_text(
        "Pendulum-v1:\n  n_timesteps: 200\n  policy: MlpPolicy\n  learning_starts: 50\n  n_rbf: 2\n"
        "  env_wrapper: gymnasium.wrappers.FlattenObservation\n"
    )
    main(["train", "--env", "Pendulum-v1", "--conf-file", str(config), "-f", str(tmp_path), *FEW_STEPS])
    env = models[0].env.envs[0]
    assert type(env) is OptionExecutionWrapper
    assert type(env.env) is gym.wrappers.FlattenObservation


@pytest.mark.parametrize(
    "name", ["wrappers.OptionExecutionWrapper", "OptionExecutionWrapper", "wrappers.RealTimeOptionWrapper"]
)
def test_an_option_wrapper_in_the_file_is_left_alone(tmp_path, models, name):
    config = tmp_path / "own.yml"
    config.write_text(
        "Pendulum-v1:\n  n_timesteps: 200\n  policy: MlpPolicy\n  learning_starts: 50\n  n_rbf: 2\n"
        f"  env_wrapper:\n    - sb3_ctco.{name}:\n        n_rbf: 2\n        reward_unit: impulse\n"
    )
    main(["train", "--env", "Pendulum-v1", "--conf-file", str(config), "-f", str(tmp_path), *FEW_STEPS])
    assert models[0].get_env().get_attr("reward_unit") == ["impulse"]


def test_evaluation_checkpoints_normalisation_and_enjoy(tmp_path, models, capsys):
    flags = ["-f", str(tmp_path), "-n", "400", "--seed", "0", "--eval-freq", "200", "--n-eval-envs", "2"]
    flags += ["--eval-episodes", "2", "--save-freq", "100", "--save-replay-buffer"]
    normalize = """normalize:"{'norm_obs': True, 'norm_reward': False}" """.strip()
    main(["train", "--env", "Pendulum-v1", *flags, *FEW_STEPS_PARAMS, normalize])
    folder = tmp_path / "ctco" / "Pendulum-v1_1"
    assert models[0].get_vec_normalize_env() is not None
    # By primitive steps, as for an agent of fixed rate, although decisions take several.
    assert {f"rl_model_{n}_steps.zip" for n in (100, 200, 300, 400)} <= {file.name for file in folder.glob("*.zip")}
    np.testing.assert_array_equal(np.load(folder / "evaluations.npz")["timesteps"], [200, 400])
    assert (folder / "best_model.zip").exists()
    assert (folder / "replay_buffer.pkl").exists()
    assert (folder / "Pendulum-v1" / "vecnormalize.pkl").exists()

    capsys.readouterr()
    main(["enjoy", "--env", "Pendulum-v1", "-f", str(tmp_path), "--no-render", "-n", "250", "--load-best"])
    output = capsys.readouterr().out
    assert "Loading running average" in output
    assert "Mean reward: -" in output
    # RL Zoo counts calls of step.
    assert "a timestep of -n and of Episode Length is a decision" in output


def test_training_goes_on_from_a_saved_agent(tmp_path, models):
    main(["train", "--env", "Pendulum-v1", "-f", str(tmp_path), *FEW_STEPS, *FEW_STEPS_PARAMS])
    saved = tmp_path / "ctco/Pendulum-v1_1/Pendulum-v1.zip"
    main(["train", "--env", "Pendulum-v1", "-f", str(tmp_path), "-i", str(saved), *FEW_STEPS, *FEW_STEPS_PARAMS])
    assert models[1]._n_updates > models[0]._n_updates


@pytest.mark.slow
def test_environments_in_processes_of_their_own(tmp_path, models):
    flags = ["--env", "sb3_ctco/point_mass-sparse-50hz-v0", "--vec-env", "subproc", "-f", str(tmp_path)]
    main(["train", *flags, *FEW_STEPS, *FEW_STEPS_PARAMS, "n_envs:2"])
    assert models[0].n_envs == 2
    assert models[0].num_timesteps >= 200


@pytest.mark.slow
def test_two_trials_of_tuning(tmp_path):
    flags = ["--env", "Pendulum-v1", "-f", str(tmp_path), "-n", "400", "--seed", "0", "--n-trials", "2"]
    flags += ["--n-evaluations", "2", "--eval-episodes", "1", "--pruner", "none", "--no-optim-plots"]
    main(["tune", *flags, *FEW_STEPS_PARAMS])
    (report,) = (tmp_path / "ctco").glob("report_*.csv")
    trials = list(csv.DictReader(report.open()))
    assert len(trials) == 2
    assert all(np.isfinite(float(trial["value"])) for trial in trials)
    with report.with_suffix(".pkl").open("rb") as file:
        study = pickle.load(file)
    for trial in study.trials:
        # What Optuna stored is enough to build the model again.
        model = CTCO("MlpPolicy", "Pendulum-v1", **convert_ctco_params(trial.params))
        assert model.n_rbf == trial.params["n_rbf"]
        assert float(model.log_ent_coefs[0].exp().detach()) == pytest.approx(trial.params["ent_coef_start"], rel=1e-5)
    assert study.trials[0].params["d_max"] != study.trials[1].params["d_max"]


def test_a_trial_whose_settings_make_no_model_is_pruned(tmp_path, capsys):
    """Options of at most 0.1 to 2 s, and a rate that needs 1 s."""
    flags = ["--env", "Pendulum-v1", "-f", str(tmp_path), "-n", "400", "--seed", "0", "--n-trials", "4"]
    flags += ["--n-evaluations", "2", "--eval-episodes", "1", "--pruner", "none", "--no-optim-plots"]
    main(["tune", *flags, *FEW_STEPS_PARAMS, "target_decision_rate:1.0"])
    (report,) = (tmp_path / "ctco").glob("report_*.csv")
    states = [trial["state"] for trial in csv.DictReader(report.open())]
    assert set(states) == {"COMPLETE", "PRUNED"}
    assert "has settings that make no model: target_decision_rate=1.0 Hz is out of reach" in capsys.readouterr().out


def test_figars_repetitions_are_whole_steps_of_any_environment(tmp_path, models):
    # 1 s, by default, is no whole number of 15 ms.
    main(
        ["train", "--algo", "figar_sac", "--env", "sb3_ctco/dog-stand-v0", "-f", str(tmp_path), *FEW_STEPS, *FEW_STEPS_PARAMS]
    )
    assert models[0].d_max == pytest.approx(67 * 0.015)
    saved = yaml.unsafe_load((tmp_path / "figar_sac/sb3_ctco-dog-stand-v0_1/sb3_ctco-dog-stand-v0/config.yml").read_text())
    assert saved["env_wrapper"][0]["sb3_ctco.wrappers.OptionExecutionWrapper"]["dt"] is None


@pytest.mark.parametrize(
    ("command", "arguments", "expected"),
    [
        ("train", ["--algo", "ppo"], ["--algo", "ppo"]),
        ("train", [], ["--algo", "ctco", "--conf-file", packaged_config("ctco")]),
        ("train", ["--algo=sac"], ["--conf-file", packaged_config("sac"), "--algo=sac"]),
        ("train", ["-conf", "own.yml"], ["--algo", "ctco", "-conf", "own.yml"]),
        (
            "tune",
            ["--n-jobs", "2"],
            ["--algo", "ctco", "--conf-file", packaged_config("ctco"), "--optimize-hyperparameters", "--n-jobs", "2"],
        ),
        ("enjoy", ["--no-render"], ["--folder", "logs", "--algo", "ctco", "--no-render"]),
        ("enjoy", ["-f", "runs"], ["--algo", "ctco", "-f", "runs"]),
    ],
)
def test_defaults_are_added_where_nothing_is_given(command, arguments, expected):
    assert with_defaults(command, arguments) == expected


def test_the_zoo_is_left_as_it_was(tmp_path, capsys):
    argv = list(sys.argv)
    with pytest.raises(SystemExit):
        main(["train", "--algo", "no-such-algorithm"])
    assert "ctco" in capsys.readouterr().err  # among the choices
    assert sys.argv == argv
    assert rl_zoo3.train.ExperimentManager is ExperimentManager


def test_an_unknown_command_names_the_known_ones(capsys):
    with pytest.raises(SystemExit):
        cli(["learn"])
    error = capsys.readouterr().err
    assert all(command in error for command in ("train", "enjoy", "tune"))


def test_a_search_that_has_no_space_is_refused():
    with pytest.raises(SystemExit, match=r"hyperparameters are searched for .*ctco.*, not for figar_sac"):
        main(["tune", "--algo", "figar_sac", "--env", "Pendulum-v1"])
