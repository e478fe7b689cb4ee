"""What FiGAR-SAC and DAC-PPO have in common with every algorithm of Stable-Baselines3."""

import inspect
from importlib import resources

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from test_can_i_use import SPACES, VECTOR, SpacesEnv, table

import sb3_ctco
from sb3_ctco import DACPPO, FiGARSAC, OptionExecutionWrapper
from sb3_ctco.option_array import plain

FIGAR = {"n_repetitions": 4, "batch_size": 8, "learning_starts": 20, "gradient_steps": 2, "buffer_size": 500}
DAC = {"n_steps": 20, "batch_size": 10, "n_epochs": 1}
ALGORITHMS = pytest.mark.parametrize(("algorithm", "kwargs"), [(FiGARSAC, FIGAR), (DACPPO, DAC)])


def make(algorithm, env, kwargs, policy="MlpPolicy", **further):
    return algorithm(policy, env, **{"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0, **kwargs, **further})


def make_env(algorithm, env, n_envs=1, **kwargs):
    """A VecEnv, wrapped if the algorithm decides by options."""
    if algorithm is FiGARSAC:
        wrapper_kwargs = {"n_rbf": 1, "d_max": 0.4, "duration_scale": "linear"}
        kwargs |= {"wrapper_class": OptionExecutionWrapper, "wrapper_kwargs": wrapper_kwargs}
    return make_vec_env(env, n_envs, **kwargs)


def parameters(model):
    return th.cat([p.detach().ravel() for p in model.policy.parameters()])


@ALGORITHMS
def test_a_seed_makes_it_reproducible(algorithm, kwargs, random_walk_env):
    runs = [parameters(make(algorithm, random_walk_env(), kwargs, seed=seed).learn(120)) for seed in (3, 3, 4)]
    assert th.equal(runs[0], runs[1])
    assert not th.equal(runs[0], runs[2])


@ALGORITHMS
def test_saving_and_loading(algorithm, kwargs, random_walk_env, tmp_path):
    model = make(algorithm, random_walk_env(), kwargs, learning_rate=1e-2).learn(60)
    model.save(tmp_path / "model.zip")
    obs = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    expected, _ = model.predict(obs, deterministic=True)

    alone = algorithm.load(tmp_path / "model.zip")
    np.testing.assert_array_equal(alone.predict(obs, deterministic=True)[0], expected)
    loaded = algorithm.load(tmp_path / "model.zip", env=random_walk_env())
    assert th.equal(parameters(loaded), parameters(model))
    for name in model._get_torch_save_params()[0][1:]:
        ours, theirs = (
            _optimizer_state(getattr(m, name) if "." not in name else _attribute(m, name)) for m in (model, loaded)
        )
        assert len(ours) > 0
        for one, other in zip(ours, theirs, strict=True):
            assert th.equal(one, other)
    assert loaded.num_timesteps == model.num_timesteps
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded.num_timesteps >= model.num_timesteps + 60
    assert not th.equal(parameters(loaded), parameters(model))


def _attribute(model, name):
    for part in name.split("."):
        model = getattr(model, part)
    return model


def _optimizer_state(optimizer):
    return [value for state in optimizer.state.values() for value in state.values() if th.is_tensor(value)]


@ALGORITHMS
def test_the_same_policy_goes_on_learning_the_same(algorithm, kwargs, random_walk_env, tmp_path):
    """A copy and a saved model, from the same place with the same random numbers, end with the same parameters."""
    model = make(algorithm, random_walk_env(), kwargs).learn(60)
    model.save(tmp_path / "model.zip")
    ends = []
    for _ in range(2):
        loaded = algorithm.load(tmp_path / "model.zip", env=random_walk_env())
        loaded.set_random_seed(5)
        ends.append(parameters(loaded.learn(60)))
    assert th.equal(*ends)


@ALGORITHMS
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_two_environments(algorithm, kwargs, vec_env_cls, random_walk_env, tmp_path):
    env = make_env(algorithm, random_walk_env, 2, vec_env_cls=vec_env_cls, seed=0)
    model = make(algorithm, env, kwargs).learn(160)
    assert model.num_timesteps >= 160
    assert model._n_updates > 0
    actions, _ = model.predict(env.reset())
    assert actions.shape == (2, *env.action_space.shape)
    # Episodes of the 20 steps that an environment has, whatever a decision takes
    assert {info["l"] for info in model.ep_info_buffer} == {20}
    mean_return, _ = evaluate_policy(model, env, 4)
    assert -20 <= mean_return <= 0
    model.save(tmp_path / "model.zip")
    single = algorithm.load(tmp_path / "model.zip", env=random_walk_env())
    assert single.n_envs == 1
    single.learn(40)
    env.close()


@ALGORITHMS
@pytest.mark.parametrize(("kind", "policy"), [("image", "CnnPolicy"), ("dict", "MultiInputPolicy")])
def test_images_and_dictionaries(algorithm, kwargs, kind, policy, random_walk_env, tmp_path):
    model = make(algorithm, random_walk_env(kind), kwargs, policy)
    before = parameters(model)
    model.learn(60)
    assert not th.equal(parameters(model), before)
    obs = model.get_env().reset()
    action, _ = model.predict(obs, deterministic=True)
    assert action.shape == (1, *model.action_space.shape)
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=random_walk_env(kind))
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], action)


@ALGORITHMS
def test_predict_of_one_and_of_several_observations(algorithm, kwargs, random_walk_env):
    model = make(algorithm, random_walk_env(), kwargs)
    space = model.action_space
    one = np.array([0.5, 0.1], dtype=np.float32)
    several = np.stack([one, -one, 0 * one])
    action, _ = model.predict(one, deterministic=True)
    actions, _ = model.predict(several, deterministic=True)
    assert space.contains(action)
    assert actions.shape == (3, *space.shape)
    np.testing.assert_allclose(plain(actions)[0], action, rtol=1e-5, atol=1e-6)
    draws = [model.predict(one)[0] for _ in range(5)]
    assert all(space.contains(draw) for draw in draws)
    assert len({draw.tobytes() for draw in draws}) > 1


@ALGORITHMS
def test_callbacks_count_primitive_steps(algorithm, kwargs, random_walk_env, tmp_path):
    model = make(algorithm, random_walk_env(), kwargs)
    evaluation = EvalCallback(
        make_env(algorithm, random_walk_env), eval_freq=40, n_eval_episodes=2, log_path=str(tmp_path), verbose=0
    )
    model.learn(100, callback=[evaluation, CheckpointCallback(50, str(tmp_path), name_prefix="model")])
    results = np.load(tmp_path / "evaluations.npz")
    assert results["timesteps"].tolist() == [40, 80]
    assert (results["ep_lengths"] == 20).all()
    saved = sorted(path.name for path in tmp_path.glob("model_*"))
    assert saved == ["model_100_steps.zip", "model_50_steps.zip"]


@ALGORITHMS
def test_a_callback_can_stop_it(algorithm, kwargs, random_walk_env):
    model = make(algorithm, random_walk_env(), kwargs)
    model.learn(1000, callback=lambda local, _: local["self"].num_timesteps < 33)
    assert 33 <= model.num_timesteps < 40
    model.learn(40, reset_num_timesteps=False)


@ALGORITHMS
def test_normalised_observations(algorithm, kwargs, random_walk_env):
    env = VecNormalize(make_env(algorithm, random_walk_env), norm_reward=False)
    model = make(algorithm, env, kwargs).learn(80)
    assert model.get_vec_normalize_env() is env
    assert env.obs_rms.count > 20


@ALGORITHMS
def test_schedules(algorithm, kwargs, random_walk_env):
    model = make(algorithm, random_walk_env(), kwargs, learning_rate=lambda remaining: 1e-3 * remaining).learn(80)
    assert 0.0 <= model.logger.name_to_value["train/learning_rate"] < 5e-4


@ALGORITHMS
def test_it_is_public(algorithm, kwargs):
    assert algorithm.__name__ in sb3_ctco.__all__
    assert set(algorithm.policy_aliases) == {"MlpPolicy", "CnnPolicy", "MultiInputPolicy"}
    # Every argument has its line of documentation.
    for name in inspect.signature(algorithm).parameters:
        assert f":param {name}:" in algorithm.__doc__


# --- what the pages say


@ALGORITHMS
@pytest.mark.parametrize("kind", SPACES)
def test_spaces(algorithm, kwargs, kind):
    page = {FiGARSAC: "figar_sac", DACPPO: "dac_ppo"}[algorithm]
    action, observation = table(page, "| Space | Action | Observation |")[kind]
    policy = "MultiInputPolicy" if kind == "Dict" else "MlpPolicy"
    assert observation == "✓"
    make(algorithm, SpacesEnv(SPACES[kind], VECTOR), kwargs, policy).learn(30)
    if action.startswith("✓"):
        make(algorithm, SpacesEnv(VECTOR, SPACES[kind]), kwargs).learn(30)
    else:
        # DACPPO leaves it to Stable-Baselines3 to refuse them.
        with pytest.raises((TypeError, AssertionError), match="action space"):
            make(algorithm, SpacesEnv(VECTOR, SPACES[kind]), kwargs)


# --- RL Zoo

NAMES = {"figar_sac": FiGARSAC, "dac_ppo": DACPPO}
CONFIGS = {name: yaml.safe_load((resources.files("sb3_ctco.zoo_configs") / f"{name}.yml").read_text()) for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_zoo_settings_are_arguments(name):
    known = {*inspect.signature(NAMES[name]).parameters, "n_timesteps", "n_envs", "normalize"}
    assert {"default", "Pendulum-v1", "sb3_ctco/ball_in_cup-catch-500hz-v0"} <= set(CONFIGS[name])
    for settings in CONFIGS[name].values():
        assert set(settings) <= known
        # YAML reads a bare 1e-3 as a string.
        assert isinstance(settings["n_timesteps"], int | float)
        assert isinstance(settings.get("learning_rate", 0.1), float)


@pytest.mark.parametrize(
    ("name", "env_id"), [(name, env_id) for name in NAMES for env_id in CONFIGS[name] if "500hz" not in env_id]
)
def test_the_zoo_trains_each_entry(name, env_id, tmp_path, monkeypatch):
    zoo = pytest.importorskip("sb3_ctco.zoo")
    trained = []
    monkeypatch.setattr(zoo.OptionExperimentManager, "save_trained_model", lambda self, model: trained.append(model))
    env = "MountainCarContinuous-v0" if env_id == "default" else env_id
    few = (
        ["learning_starts:50", "buffer_size:500", "batch_size:16"] if name == "figar_sac" else ["n_steps:50", "batch_size:50"]
    )
    flags = ["-n", "200", "--eval-freq", "-1", "--seed", "0", "--device", "cpu", "--verbose", "0", "-f", str(tmp_path)]
    if env_id == "default" and name == "figar_sac":
        few.append("d_max:0.5")  # whole steps at 30 Hz
    zoo.main(["train", "--algo", name, "--env", env, *flags, "-params", *few])
    (model,) = trained
    assert type(model) is NAMES[name]
    assert model.num_timesteps >= 200
    assert model._n_updates > 0
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


@pytest.mark.parametrize("name", NAMES)
def test_enjoy_after_train(name, tmp_path, capsys):
    zoo = pytest.importorskip("sb3_ctco.zoo")
    few = ["learning_starts:50", "batch_size:16"] if name == "figar_sac" else ["n_envs:1", "n_steps:50", "batch_size:50"]
    flags = ["--algo", name, "--env", "Pendulum-v1", "-f", str(tmp_path)]
    zoo.main(["train", *flags, "-n", "200", "--eval-freq", "-1", "--device", "cpu", "-params", *few])
    capsys.readouterr()
    zoo.main(["enjoy", *flags, "--no-render", "-n", "250"])
    assert "Mean reward: -" in capsys.readouterr().out


def test_the_zoo_needs_seconds_for_repetitions():
    arguments = {"n_repetitions": 4, "d_max": None, "dt": None, "gamma": 0.98, "gamma_dt": 0.05}
    with pytest.raises(ValueError, match="pass d_max, in seconds, or dt"):
        FiGARSAC.wrapper_kwargs(arguments)
    kwargs = FiGARSAC.wrapper_kwargs({**arguments, "dt": 0.1})
    assert (kwargs["n_rbf"], kwargs["d_max"], kwargs["d_min"], kwargs["dt"]) == (1, 0.4, 0.0, 0.1)
    assert FiGARSAC.wrapper_kwargs({**arguments, "n_repetitions": None, "d_max": 0.3})["d_max"] == 0.3
