"""Models and replay buffers that version 0.1.0 saved, in tests/data: they act as they did, and learn on."""

import base64
import json
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
