"""Saved models and replay buffers: those of version 0.1.0, in tests/data, act as before and learn on; what load refuses."""

import base64
import json
import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.save_util import data_to_json, json_to_data

from sb3_ctco import CTCO, FiGARSAC
from sb3_ctco.option_array import plain
from sb3_ctco.options import RadialBasis
from sb3_ctco.torch_layers import SpatialSoftmaxExtractor

DATA = Path(__file__).parent / "data"
OBSERVATIONS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]], dtype=np.float32)
#: What 0.1.0 printed of ``predict(OBSERVATIONS, deterministic=True)``
OPTIONS = {
    CTCO: [[0.23800993, 0.16001892, 0.10798693], [0.22889364, 0.07423103, 0.08157694]],
    FiGARSAC: [[-0.163306, -0.78947365], [-0.19485867, -0.78947365]],
}


@pytest.mark.parametrize("algorithm", [CTCO, FiGARSAC])
def test_a_model_of_0_1_0_acts_as_it_did_and_learns_on(algorithm):
    name = {CTCO: "ctco", FiGARSAC: "figar_sac"}[algorithm]
    model = algorithm.load(DATA / f"{name}-0.1.0.zip", env=gym.make("Pendulum-v1"), device="cpu")
    options, _ = model.predict(OBSERVATIONS, deterministic=True)
    np.testing.assert_allclose(plain(options), OPTIONS[algorithm], atol=1e-5)
    # Its durations were linear, and R was in reward × s.
    assert model.option_space.duration_scale == "linear"
    assert model.replay_buffer.reward_scale == 1.0
    if algorithm is CTCO:
        assert model._canonical is None  # Its critics saw weights as they were,
        assert model.target_entropy == -model.actor.omega_dim - 1.0  # and the target entropy was that of ω.
        assert model.option_space.trajectory == RadialBasis(model.n_rbf)
        assert len(model.ent_coefs) == model.n_rbf + 1
    before = model._n_updates
    assert model.learn(60, reset_num_timesteps=False)._n_updates > before


def test_a_replay_buffer_of_0_1_0_is_learned_from():
    model = CTCO.load(DATA / "ctco-0.1.0.zip", env=gym.make("Pendulum-v1"), device="cpu")
    model.load_replay_buffer(DATA / "ctco-0.1.0-buffer.pkl")
    buffer = model.replay_buffer
    assert buffer.size() == 154
    # What was paid is counted from its rows, and so a unit is found before anything is added.
    rate = np.abs(buffer.integrated_rewards[:154]).sum() / buffer.durations[:154].sum()
    assert buffer.mean_reward_rate == pytest.approx(rate)
    buffer.reward_scale = "auto"
    assert buffer.found_reward_scale() != 1.0
    buffer.reward_scale = 1.0
    model.learn(60, reset_num_timesteps=False)
    samples = model.replay_buffer.sample(8)
    assert samples.rewards.shape == samples.discounts.shape == (8, 1)


def test_the_features_extractor_is_found_where_0_1_0_had_it(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(SpatialSoftmaxExtractor, "__module__", "sb3_ctco.common.spatial_softmax")
        saved = data_to_json({"policy_kwargs": {"features_extractor_class": SpatialSoftmaxExtractor}})
    assert b"sb3_ctco.common.spatial_softmax" in base64.b64decode(json.loads(saved)["policy_kwargs"][":serialized:"])
    assert json_to_data(saved)["policy_kwargs"]["features_extractor_class"] is SpatialSoftmaxExtractor


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"entropy_reference": "avarage"}, "entropy_reference must be one of .*, not 'avarage'"),
        ({"entropy_reference": "paper"}, "needs duration_scale='linear', not 'log'"),
        ({"updates_per_second": -5.0}, "updates_per_second must be positive or None, not -5.0"),
        ({"updates_per_second": math.inf}, "updates_per_second must be positive or None, not inf"),
        ({"high_freq_penalty": "foo"}, "or 'relative_<number of at least 0>', such as 'relative_0.1', not 'foo'"),
        ({"high_freq_penalty": math.nan}, "high_freq_penalty must be a finite number, not nan"),
        ({"target_entropy": "nan"}, "target_entropy must be a number, a function of the remaining progress or 'auto'"),
        ({"n_sub_options": 2.5}, "n_sub_options must be a whole number of at least 0, not 2.5"),
    ],
)
def test_load_checks_what_the_constructor_checks(kwargs, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10, **kwargs)
    CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        CTCO.load(tmp_path / "model", env=gym.make("Pendulum-v1"), **kwargs)


def test_a_file_is_loaded_with_what_it_was_made_with(tmp_path):
    given = {"d_min": 0, "trajectory": "rbf", "policy_kwargs": {"net_arch": [8]}}
    CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10, **given).save(tmp_path / "ctco")
    assert CTCO.load(tmp_path / "ctco", env=gym.make("Pendulum-v1"), **given).d_min == 0.05
    # The constructor's defaults, which it finds values for, and a trajectory by its class
    found = {"dt": None, "d_max": None, "d_min": None, "trajectory": RadialBasis}
    assert CTCO.load(tmp_path / "ctco", env=gym.make("Pendulum-v1"), **found).option_space.arguments["trajectory"] == "rbf"
    FiGARSAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}).save(tmp_path / "figar_sac")
    assert FiGARSAC.load(tmp_path / "figar_sac", policy_kwargs={"net_arch": [8]}, n_repetitions=None).n_repetitions == 20
    with pytest.raises(ValueError, match=r"'d_min': 0.05.*cannot be changed while loading"):
        CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10, d_min=0.1).save(tmp_path / "longer")
        CTCO.load(tmp_path / "longer", d_min=0)


def test_a_dt_that_is_given_to_load_is_the_users_word(tmp_path):
    CTCO("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "model")
    model = CTCO.load(tmp_path / "model", env=gym.make("Pendulum-v1"), dt=0.1)
    assert model.dt == model.get_env().get_attr("option_space")[0].dt == 0.1


def test_a_replay_buffer_whose_options_mean_something_else_is_refused(tmp_path):
    CTCO("MlpPolicy", "Pendulum-v1", buffer_size=100, d_max=0.5).save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"options in the replay buffer in .* have d_max=0.5, CTCO has d_max=2.0"):
        CTCO("MlpPolicy", "Pendulum-v1", buffer_size=100, d_max=2.0).load_replay_buffer(tmp_path / "buffer")
    model = CTCO("MlpPolicy", "Pendulum-v1", buffer_size=100, d_max=0.5, d_min=0.1, dt=0.025)
    with pytest.raises(ValueError, match=r"have d_min=0.05, CTCO has d_min=0.1"):
        model.load_replay_buffer(tmp_path / "buffer")
    model = CTCO("MlpPolicy", "Pendulum-v1", buffer_size=100, d_max=0.5, d_min=0.05, dt=0.025)
    model.load_replay_buffer(tmp_path / "buffer")  # at another rate options last as long
    assert model.replay_buffer.option_space.dt == 0.025


def test_a_learned_penalty_is_the_files(tmp_path):
    CTCO("MlpPolicy", "Pendulum-v1", target_decision_rate=5.0, buffer_size=10).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"'target_decision_rate': None.* cannot be changed while loading"):
        CTCO.load(tmp_path / "model", target_decision_rate=None)  # not found by itself, so None is another value
    with pytest.raises(ValueError, match=r"'high_freq_penalty': 0\.003.* cannot be changed while loading"):
        CTCO.load(tmp_path / "model", high_freq_penalty=0.003)
    assert CTCO.load(tmp_path / "model", high_freq_penalty="relative_0.1").high_freq_penalty == "relative_0.1"


def test_a_subclass_hands_on_its_bases_arguments(tmp_path):
    class Mine(CTCO):
        def __init__(self, *args, alpha=0.1, **kwargs):
            super().__init__(*args, **kwargs)
            self.alpha = alpha

    Mine("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "model")
    model = Mine.load(tmp_path / "model", learning_rate=1e-4, alpha=0.2)
    assert (model.learning_rate, model.alpha) == (1e-4, 0.2)
    with pytest.raises(TypeError, match=r"Mine has no arguments \['beta'\]"):
        Mine.load(tmp_path / "model", beta=1)


def test_what_logs_tell_of_is_no_part_of_a_file(tmp_path, random_walk_env):
    model = CTCO("MlpPolicy", random_walk_env(), gradient_steps=0, buffer_size=500).learn(100, log_interval=None)
    assert len(model._durations_since_log) > 0
    model.save(tmp_path / "model")
    assert len(CTCO.load(tmp_path / "model")._durations_since_log) == 0


def test_two_ways_to_say_how_often_to_update_are_refused_by_load_too(tmp_path, random_walk_env):
    CTCO("MlpPolicy", random_walk_env(), updates_per_second=5.0, buffer_size=10).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"updates_per_second=7.0 and gradient_steps=3 both say how often to update"):
        CTCO.load(tmp_path / "model", gradient_steps=3, updates_per_second=7.0)
    assert CTCO.load(tmp_path / "model", gradient_steps=3).updates_per_second is None


def test_repetitions_are_of_the_files_step(tmp_path, scripted_env):
    FiGARSAC("MlpPolicy", scripted_env(dt=0.1, truncate_at=30), n_repetitions=5, buffer_size=10).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"dt=0.05, FiGARSAC has dt=0.1.*To evaluate at another rate.*wrap_env\(env\)"):
        FiGARSAC.load(tmp_path / "model", env=scripted_env(dt=0.05))
    with pytest.raises(ValueError, match="dt"):
        FiGARSAC.load(tmp_path / "model", env=scripted_env(dt=0.05), dt=0.05)
    wrapped = FiGARSAC.load(tmp_path / "model").wrap_env(scripted_env(dt=0.05))
    wrapped.reset()
    assert wrapped.step(np.array([0.0, 1.0]))[4]["option"]["n_steps"] == 10
