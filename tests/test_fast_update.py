"""CTCO's update by hand-worked gradients, against autograd's."""

import copy
import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.common.policies import EnsembleLinear
from sb3_ctco.ctco.fast_update import FastUpdate, PlainNetworks, _layers

SMALL = {
    "policy_kwargs": {"net_arch": {"pi": [10, 12], "qf": [16, 8]}},
    "batch_size": 16,
    "device": "cpu",
    "seed": 0,
    "learning_starts": 50,
}


def make(**kwargs):
    return CTCO("MlpPolicy", "Pendulum-v1", **{**SMALL, "d_max": 0.3, "n_rbf": 2, **kwargs})


def plain(model):
    """The same model, updated with autograd."""
    other = copy.deepcopy(model)
    other.fast_updates = False
    return other


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": 0.2},
        {"ent_coef": 0.2, "d_min": 0.1, "d_max": 0.1},
        {"entropy_reference": "paper", "duration_scale": "linear"},
        {"entropy_reference": "uniform", "ent_coef": 0.5},
        {"critic_pessimism": "time"},
        {"policy_kwargs": {"n_critics": 1, "net_arch": [8]}},
        {"policy_kwargs": {"target_actor": False, "net_arch": [8]}},
        {"policy_kwargs": {"n_critics": 3, "net_arch": {"pi": [8, 8, 8], "qf": []}}},
        {"policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"betas": (0.8, 0.9), "eps": 1e-5, "weight_decay": 0.1}}},
        {"d_min": 0.1, "d_max": 0.1},
        {"n_rbf": 3, "d_max": 0.15},
        {"n_rbf": 3, "d_max": 0.15, "trajectory": "rbf"},
        {"n_rbf": 3, "d_max": 0.15, "join": "continuous"},
        {"n_rbf": 3, "d_max": 0.15, "join": "smooth"},
        {"n_rbf": 3, "d_max": 0.3, "duration_scale": "linear"},
    ],
)
def test_an_update_is_that_of_autograd(kwargs):
    model = make(learning_rate=1e-2, **kwargs).learn(80)
    assert FastUpdate.refusal(model) is None
    with th.no_grad():
        model.actor.omega_head.bias[2] = 3.0  # a standard deviation beyond its bound, through which no gradient goes
        for target in model._target_parameters:
            target.add_(0.1 * th.randn_like(target))
    other = plain(model)
    before = copy.deepcopy(model.policy.state_dict())
    for n_updates in (1, 20):
        for one in (model, other):
            th.manual_seed(1)
            np.random.seed(1)
            one.train(n_updates, 16)
        assert model.fast_updates_refusal is None
        assert other.fast_updates_refusal == "fast_updates=False"
        expected = other.policy.state_dict()
        for name, value in model.policy.state_dict().items():
            th.testing.assert_close(value, expected[name], rtol=1e-5 * n_updates, atol=1e-6 * n_updates, msg=name)
        for name in ("actor", "critic"):
            states = [getattr(one, name).optimizer.state_dict()["state"] for one in (model, other)]
            th.testing.assert_close(*states, rtol=1e-5 * n_updates, atol=1e-6 * n_updates)
        th.testing.assert_close(model.log_ent_coefs, other.log_ent_coefs, rtol=1e-6, atol=1e-6)
        for name in ("actor_loss", "critic_loss"):
            values = [one.logger.name_to_value[f"train/{name}"] for one in (model, other)]
            assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert any((value != before[name]).any() for name, value in model.policy.state_dict().items())


def test_the_network_s_gradients_are_autograd_s():
    th.manual_seed(0)
    layers = th.nn.Sequential(EnsembleLinear(2, 5, 7), th.nn.ReLU(), EnsembleLinear(2, 7, 3))
    network = PlainNetworks(_layers(layers), _layers(copy.deepcopy(layers)))
    x = th.randn(11, 5, requires_grad=True)
    outputs = layers(x.expand(2, 11, 5))
    gradient = th.randn(2, 11, 3)
    outputs.backward(gradient)
    th.testing.assert_close(network.forward(x.detach().expand(2, 11, 5)), outputs.detach())
    network.backward(gradient)
    assert set(network.learned) == set(layers.parameters())
    for parameter, pieces in network.learned.items():
        ((_, _, value),) = pieces
        th.testing.assert_close(value, parameter.grad)
    th.testing.assert_close(network.input_gradient(gradient), x.grad)
    th.testing.assert_close(network.input_gradient(gradient, first=2), x.grad[:, 2:])


class OtherLoss(CTCO):
    def _actor_loss(self, obs, sample):
        return 2.0 * super()._actor_loss(obs, sample)


class OtherTargets(CTCO):
    def _update_targets(self):
        """Targets that stay where they are."""


class OtherUpdate(CTCO):
    """Whose update learns nothing but to be noticed."""

    def _update(self, data):
        with th.no_grad():
            self.actor.omega_head.bias.add_(1.0)
        return th.zeros(3)


def hooked(model, add):
    add(model)
    return model


@pytest.mark.parametrize(
    ("make_model", "reason"),
    [
        (lambda: make(policy_kwargs={"net_arch": [8], "activation_fn": th.nn.Tanh}), "linear layers"),
        (lambda: make(policy_kwargs={"net_arch": []}), "linear layers"),
        (lambda: make(policy_kwargs={"net_arch": [8], "optimizer_kwargs": {"amsgrad": True}}), "optimizer"),
        (lambda: make(policy_kwargs={"net_arch": [8], "optimizer_class": th.optim.SGD}), "optimizer"),
        (lambda: OtherLoss("MlpPolicy", "Pendulum-v1", **SMALL), "OtherLoss is a subclass"),
        (lambda: OtherTargets("MlpPolicy", "Pendulum-v1", **SMALL), "OtherTargets is a subclass"),
        (lambda: OtherUpdate("MlpPolicy", "Pendulum-v1", **SMALL), "OtherUpdate is a subclass"),
        (lambda: make(fast_updates=False), "fast_updates=False"),
        (lambda: hooked(make(), lambda m: setattr(m, "_actor_loss", m._actor_loss)), "methods of its own: .'_actor_loss'"),
        (lambda: hooked(make(), lambda m: m.actor.latent_pi[0].register_forward_hook(lambda *_: None)), "hooks"),
        (lambda: hooked(make(), lambda m: m.critic.q_networks[0].weight.register_hook(lambda g: g)), "hooks"),
        (lambda: hooked(make(), lambda m: m.actor.optimizer.register_step_post_hook(lambda *_: None)), "hooks"),
    ],
)
def test_what_it_does_not_know_is_left_to_autograd(make_model, reason):
    model = make_model().learn(80)
    model.train(1, 16)
    assert model._n_updates > 0
    assert re.search(reason, model.fast_updates_refusal)
    assert model._fast_update is None


def test_a_subclass_with_an_update_of_its_own_keeps_what_it_learned():
    model = OtherUpdate("MlpPolicy", "Pendulum-v1", **SMALL).learn(80)
    before = model.actor.omega_head.bias.detach().clone()
    model.train(3, 16)
    th.testing.assert_close(model.actor.omega_head.bias.detach(), before + 3.0)


def test_a_step_size_holds_from_the_training_on_for_which_it_is_given():
    model = make().learn(80)
    model.lr_schedule = lambda _: 0.0
    before = copy.deepcopy(list(model.actor.parameters()))
    model.train(3, 16)
    assert model.fast_updates_refusal is None
    for parameter, value in zip(model.actor.parameters(), before, strict=True):
        th.testing.assert_close(parameter, value, rtol=0, atol=0)


def test_frozen_parameters_stay():
    model = make().learn(80)
    model.actor.latent_pi[0].weight.requires_grad_(False)
    before = model.actor.latent_pi[0].weight.clone()
    model.train(1, 16)
    th.testing.assert_close(model.actor.latent_pi[0].weight, before, rtol=0, atol=0)


def test_after_loading_and_moving_it_works_on_the_new_parameters(tmp_path):
    model = make().learn(80)
    assert model.fast_updates_refusal is None
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CTCO.load(tmp_path / "model", env=gym.make("Pendulum-v1"), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(5, reset_num_timesteps=False)  # for its logger
    model.set_parameters(loaded.get_parameters())
    for parameter in model.policy.parameters():  # as policy.to(device) does
        parameter.data = parameter.data.clone()
    other = plain(model)
    for one in (model, other):
        th.manual_seed(1)
        np.random.seed(1)
        one.train(3, 16)
    assert model.fast_updates_refusal is None
    for name, value in model.policy.state_dict().items():
        th.testing.assert_close(value, other.policy.state_dict()[name], rtol=1e-5, atol=1e-6, msg=name)
