import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from torch.distributions import Normal

from sb3_ctco import DACPPO, OptionExecutionWrapper, RewardRateWrapper
from sb3_ctco.dac_ppo.buffers import MDPS, DACRolloutBuffer
from sb3_ctco.dac_ppo.dac_ppo import clipped_surrogate_loss
from sb3_ctco.dac_ppo.policies import DACPolicy, high_log_probs

SMALL = {
    "policy_kwargs": {"net_arch": [8]},
    "n_steps": 32,
    "batch_size": 16,
    "n_epochs": 2,
    "device": "cpu",
    "seed": 0,
}


def make(env, policy="MlpPolicy", **kwargs):
    return DACPPO(policy, env, **{**SMALL, **kwargs})


def test_whole_numbers_are_refused(scripted_env):
    env = scripted_env()
    env.action_space = spaces.Box(0, 10, (1,), np.int64)
    with pytest.raises(TypeError, match="needs actions that are real numbers"):
        make(env)


# --- π_H, from numbers worked by hand

MASTER = th.tensor([[0.3, 0.7]])
BETA = th.tensor([[0.2, 0.9]])


@pytest.mark.parametrize(
    ("previous", "start", "expected"),
    [
        # (1 − β_0)·1[o = 0] + β_0·π_W: 0.8 + 0.2·0.3, 0.2·0.7. With β taken elementwise it would be 0.86, 0.63.
        (0, False, [0.86, 0.14]),
        # (1 − β_1)·1[o = 1] + β_1·π_W: 0.9·0.3, 0.1 + 0.9·0.7
        (1, False, [0.27, 0.73]),
        (0, True, [0.3, 0.7]),
        (1, True, [0.3, 0.7]),
    ],
)
def test_master_and_termination_by_hand(previous, start, expected):
    log_probs = high_log_probs(MASTER.log(), BETA.logit(), th.tensor([previous]), th.tensor([start]))
    np.testing.assert_allclose(log_probs.exp().numpy(), [expected], rtol=1e-6)


logits = st.floats(-200.0, 200.0, width=32)


@settings(deadline=None)
@given(st.lists(st.tuples(logits, logits), min_size=1, max_size=6), st.data())
def test_rows_sum_to_one(rows, data):
    """For any networks, previous option and start; and gradients stay finite at any termination."""
    k = len(rows)
    master = th.tensor([row[0] for row in rows])[None].requires_grad_(True)
    beta = th.tensor([row[1] for row in rows])[None].requires_grad_(True)
    previous = th.tensor([data.draw(st.integers(0, k - 1))])
    log_probs = high_log_probs(master.log_softmax(dim=1), beta, previous, th.tensor([data.draw(st.booleans())]))
    assert log_probs.exp().sum().item() == pytest.approx(1.0, abs=1e-5)
    (log_probs.exp() * log_probs).sum().backward()
    for tensor in (log_probs, master.grad, beta.grad if beta.grad is not None else beta):
        assert th.isfinite(tensor).all()


def test_log_probabilities_are_taken_directly(random_walk_env):
    """Far below log(1e-5) = −11.5, where adding 1e-5 inside the logarithm would put a floor."""
    master = th.tensor([[0.0, -40.0]]).log_softmax(dim=1)
    log_probs = high_log_probs(master, th.tensor([[-20.0, 0.0]]), th.tensor([0]), th.tensor([False]))
    # log β_0 + log π_W(1) = −20 − 40
    assert log_probs[0, 1].item() == pytest.approx(-60.0, abs=1e-4)
    policy = make(random_walk_env()).policy
    predictions = policy.options(th.zeros(1, 2))
    far = predictions.low_distribution(th.tensor([1])).log_prob(th.tensor([[20.0]])).item()
    # softplus(0) = log 2
    assert far == pytest.approx(Normal(predictions.means[1, 0, 0].item(), math.log(2.0)).log_prob(th.tensor(20.0)).item())
    assert far < -300


def test_clipped_surrogate_by_hand():
    log_ratio = th.tensor([1.5, 1.5, 0.5, 0.5]).log()
    advantages = th.tensor([1.0, -1.0, 1.0, -1.0])
    loss, ratio = clipped_surrogate_loss(log_ratio, th.zeros(4), advantages, 0.2)
    # min(1.5, 1.2), min(−1.5, −1.2), min(0.5, 0.8), min(−0.5, −0.8)
    assert loss.item() == pytest.approx(-(1.2 - 1.5 + 0.5 - 0.8) / 4)
    th.testing.assert_close(ratio, th.tensor([1.5, 1.5, 0.5, 0.5]))


# --- the networks


def fix_networks(policy, q_values, master, beta, means=None):
    """Let the networks' outputs be these numbers in every state."""
    with th.no_grad():
        for network in (policy.q_network, policy.master, policy.terminations, policy.option_means):
            network[-1].weight.zero_()
        policy.q_network[-1].bias.copy_(th.tensor(q_values)[None, None])
        policy.master[-1].bias.copy_(th.tensor(master).log()[None, None])
        policy.terminations[-1].bias.copy_(th.tensor(beta).logit()[:, None, None])
        if means is not None:
            policy.option_means[-1].bias.copy_(th.tensor(means).atanh()[:, None, None])


TWO_OPTIONS = {"policy_kwargs": {"net_arch": [8], "n_options": 2}}


def test_values_by_hand(random_walk_env):
    policy = make(random_walk_env(), **TWO_OPTIONS).policy
    fix_networks(policy, [10.0, 20.0], [0.3, 0.7], [0.2, 0.9])
    obs, previous = th.zeros(3, 2), th.tensor([0, 1, 1])
    starts = th.tensor([False, False, True])
    # 0.86·10 + 0.14·20, 0.27·10 + 0.73·20, 0.3·10 + 0.7·20
    th.testing.assert_close(policy.high_value(obs, previous, starts), th.tensor([11.4, 17.3, 17.0]))
    output = policy(obs, previous, starts)
    th.testing.assert_close(output["high_values"], th.tensor([11.4, 17.3, 17.0]))
    th.testing.assert_close(output["low_values"], 10.0 + 10.0 * output["options"])
    # Greedy: the likeliest of π_H, which keeps option 0 where the master prefers option 1.
    assert policy(obs, previous, starts, deterministic=True)["options"].tolist() == [0, 1, 1]


def test_bodies_are_separate_and_orthogonal(random_walk_env):
    policy = DACPPO("MlpPolicy", random_walk_env(), device="cpu").policy
    assert policy.n_options == 4
    for network, members in (
        (policy.master, 1),
        (policy.q_network, 1),
        (policy.option_means, 4),
        (policy.terminations, 4),
    ):
        assert network[0].weight.shape == (members, 2, 64)
        second = network[2].weight
        assert second.shape == (members, 64, 64)
        for weight in second:
            th.testing.assert_close(weight @ weight.T, 2.0 * th.eye(64), atol=1e-4, rtol=0)
    parameters = [id(p) for p in policy.parameters()]
    assert len(parameters) == len(set(parameters)) == 4 * 6 + 1
    # The step of one process leaves the other one's policy alone.
    predictions = policy.options(th.zeros(3, 2))
    predictions.means.sum().backward()
    assert policy.terminations[0].weight.grad is None
    assert policy.master[0].weight.grad is None


def test_optimizer_defaults(random_walk_env):
    group = make(random_walk_env()).policy.optimizer.param_groups[0]
    assert (group["lr"], group["eps"]) == (3e-4, 1e-5)


# --- the rollout


def rollout(model):
    """Collect one rollout and do not learn from it."""
    model.train = lambda: None
    model.learn(model.n_steps * model.n_envs)
    return model.rollout_buffer


def test_advantages_by_hand(random_walk_env):
    """Two steps, each process with its own values; both bootstrap from V_H."""
    space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    buffer = DACRolloutBuffer(2, space, space, "cpu", gae_lambda=0.5, gamma=0.9)
    for reward, high, low, start in ((1.0, 2.0, 3.0, True), (4.0, 5.0, 7.0, False)):
        output = {
            "actions": th.zeros(1, 1),
            "options": th.tensor([1]),
            "high_values": th.tensor([high]),
            "low_values": th.tensor([low]),
            "high_log_probs": th.tensor([-0.1]),
            "low_log_probs": th.tensor([-0.2]),
        }
        buffer.add_step(np.zeros((1, 1)), np.array([reward]), np.array([start]), np.array([0]), output)
    buffer.compute_returns_and_advantage(th.tensor([10.0]), np.array([False]))
    # δ_1 = 4 + 0.9·10 − V(1); δ_0 = 1 + 0.9·V(1) − V(0); A_0 = δ_0 + 0.45·A_1
    high_1, low_1 = 13.0 - 5.0, 13.0 - 7.0
    high_0, low_0 = 1.0 + 4.5 - 2.0 + 0.45 * high_1, 1.0 + 6.3 - 3.0 + 0.45 * low_1
    np.testing.assert_allclose(buffer.mdp_advantages["high"][:, 0], [high_0, high_1], rtol=1e-6)
    np.testing.assert_allclose(buffer.mdp_advantages["low"][:, 0], [low_0, low_1], rtol=1e-6)
    np.testing.assert_allclose(buffer.mdp_returns["high"][:, 0], [high_0 + 2.0, high_1 + 5.0], rtol=1e-6)
    np.testing.assert_allclose(buffer.mdp_returns["low"][:, 0], [low_0 + 3.0, low_1 + 7.0], rtol=1e-6)
    for mdp, log_prob in (("high", -0.1), ("low", -0.2)):
        batch = next(buffer.minibatches(mdp, 2))
        assert batch.old_log_prob.tolist() == pytest.approx([log_prob] * 2)
        assert sorted(batch.returns.tolist()) == pytest.approx(sorted(buffer.mdp_returns[mdp][:, 0].tolist()))
        assert batch.options.tolist() == [1, 1]
        assert sorted(batch.episode_starts.tolist()) == [False, True]


def test_each_value_is_regressed_on_its_own_returns(random_walk_env):
    """½(ret_H − Σ_o π_H·q)² and ½(ret_L − q(s, o))², not the other way round."""
    model = make(random_walk_env(), learning_rate=0.0, **TWO_OPTIONS)
    fix_networks(model.policy, [10.0, 20.0], [0.3, 0.7], [0.2, 0.9])
    buffer = rollout(model)
    for mdp, values in (("high", buffer.mdp_values["high"]), ("low", buffer.mdp_values["low"])):
        batch = next(buffer.minibatches(mdp, len(values)))
        statistics = model._update(mdp, batch, 0.2)
        expected = 0.5 * np.mean((buffer.mdp_returns[mdp] - values) ** 2)
        assert statistics[1].item() == pytest.approx(expected, rel=1e-5)
    # So that one could not be mistaken for the other:
    assert set(np.unique(buffer.mdp_values["low"])) == {10.0, 20.0}
    assert buffer.mdp_values["high"].min() > 11.0


def test_the_values_error_does_not_move_the_policy(random_walk_env):
    model = make(random_walk_env(), **TWO_OPTIONS)
    batch = next(rollout(model).minibatches("high", 32))
    values, _, _ = model._evaluate("high", batch)
    model.policy.zero_grad()
    values.sum().backward()
    assert model.policy.master[-1].weight.grad is None
    assert model.policy.terminations[-1].weight.grad is None
    assert model.policy.q_network[-1].weight.grad.abs().sum() > 0


@pytest.mark.parametrize("n_envs", [1, 3])
def test_ratios_are_one_with_unchanged_parameters(random_walk_env, n_envs):
    """In both processes, over episode starts and changes of option."""
    model = make(make_vec_env(random_walk_env, n_envs), n_steps=64, gamma=0.9)
    buffer = rollout(model)
    assert buffer.episode_starts.sum() > n_envs
    assert (buffer.options != buffer.previous_options).any()
    for mdp in MDPS:
        batch = next(buffer.minibatches(mdp, 64 * n_envs))
        values, log_prob, _ = model._evaluate(mdp, batch)
        ratio = (log_prob - batch.old_log_prob).exp()
        th.testing.assert_close(ratio, th.ones_like(ratio), atol=2e-6, rtol=0)
        # and the values are those that the advantages were computed with
        th.testing.assert_close(batch.returns - batch.advantages, values, atol=1e-5, rtol=1e-5)


def test_training_without_a_step_size_sees_no_change(random_walk_env):
    model = make(random_walk_env(), learning_rate=0.0).learn(32)
    for mdp in MDPS:
        assert model.logger.name_to_value[f"train/{mdp}_clip_fraction"] == 0.0
        assert model.logger.name_to_value[f"train/{mdp}_approx_kl"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("end", ["truncate_at", "terminate_at"])
def test_timeouts_bootstrap_and_terminations_do_not(scripted_env, end):
    env = scripted_env(rewards=lambda step, action: 1.0 + step, **{end: 2})
    model = make(env, n_steps=4, batch_size=4, gamma=0.9, gamma_dt=0.1, **TWO_OPTIONS)
    fix_networks(model.policy, [10.0, 20.0], [0.3, 0.7], [0.2, 0.9])
    buffer = rollout(model)
    # V_H(o_t, terminal observation), in the middle of an option: never π_W alone
    values = np.where(buffer.options[[1, 3], 0] == 0, 11.4, 17.3)
    bonus = 0.9 * values if end == "truncate_at" else np.zeros(2)
    np.testing.assert_allclose(buffer.rewards[:, 0], [1.0, 2.0 + bonus[0], 1.0, 2.0 + bonus[1]], rtol=1e-6)
    assert buffer.episode_starts[:, 0].tolist() == [1.0, 0.0, 1.0, 0.0]
    # Both processes have these rewards, and nothing beyond an episode's end.
    for mdp in MDPS:
        np.testing.assert_allclose(
            buffer.mdp_advantages[mdp][[1, 3]], buffer.rewards[[1, 3]] - buffer.mdp_values[mdp][[1, 3]], rtol=1e-5
        )


def test_the_rollouts_end_bootstraps_from_the_option_that_runs(scripted_env):
    model = make(scripted_env(), n_steps=4, batch_size=4, gamma=0.9, gamma_dt=0.1, **TWO_OPTIONS)
    fix_networks(model.policy, [10.0, 20.0], [0.3, 0.7], [0.2, 0.9])
    buffer = rollout(model)
    last = 11.4 if buffer.options[-1, 0] == 0 else 17.3
    for mdp in MDPS:
        assert buffer.mdp_advantages[mdp][-1, 0] == pytest.approx(1.0 + 0.9 * last - buffer.mdp_values[mdp][-1, 0], rel=1e-5)


def test_options_are_carried_on(scripted_env):
    """The previous option is the last step's, over rollouts as well."""
    model = make(scripted_env(), n_steps=16)
    first = rollout(model)
    options = first.options.copy()
    np.testing.assert_array_equal(first.previous_options[1:], options[:-1])
    model.learn(16, reset_num_timesteps=False)
    assert model.rollout_buffer.previous_options[0, 0] == options[-1, 0]
    assert model.rollout_buffer.episode_starts[0, 0] == 0.0


def test_an_option_without_termination_stays(scripted_env):
    model = make(scripted_env(truncate_at=8), n_steps=32, **TWO_OPTIONS)
    fix_networks(model.policy, [0.0, 0.0], [0.5, 0.5], [1e-30, 1e-30])
    buffer = rollout(model)
    episodes = buffer.options[:, 0].reshape(4, 8)
    assert (episodes == episodes[:, :1]).all()
    assert len(np.unique(episodes)) == 2


class RecordingWriter(KVWriter):
    def __init__(self):
        self.recorded = {}

    def write(self, key_values, key_excluded, step=0):
        self.recorded.update(key_values)

    def close(self):
        pass


def test_option_length_is_logged_in_seconds(scripted_env):
    model = make(scripted_env(truncate_at=8, dt=0.05), n_steps=32, **TWO_OPTIONS)
    fix_networks(model.policy, [0.0, 0.0], [0.5, 0.5], [1e-30, 1e-30])
    writer = RecordingWriter()
    model.set_logger(Logger(None, [writer]))
    model.learn(32)
    assert writer.recorded["option/n_steps_mean"] == 8.0
    assert writer.recorded["option/duration_mean"] == pytest.approx(0.4)


def test_actions_are_mapped_to_the_box(scripted_env):
    """μ in (−1, 1) stands for the whole box, and what noise pushes out of it is clipped to the bounds."""
    space = spaces.Box(np.array([2.0, -1.0], np.float32), np.array([6.0, 0.0], np.float32))
    env = scripted_env(action_space=space)
    model = make(env, n_steps=64, **TWO_OPTIONS)
    with th.no_grad():
        model.policy.option_means[-1].weight.zero_()
        model.policy.option_means[-1].bias.copy_(th.tensor([0.5, -0.5]).atanh().expand(2, 1, 2))
    action, _ = model.predict(np.zeros(2, dtype=np.float32), deterministic=True)
    # 2 + (0.5 + 1)/2·4, −1 + (−0.5 + 1)/2
    np.testing.assert_allclose(action, [5.0, -0.75], rtol=1e-6)
    rollout(model)
    played = np.array(env.actions)
    assert space.contains(played.min(axis=0))
    assert space.contains(played.max(axis=0))
    assert played[:, 0].max() == 6.0
    assert np.abs(model.rollout_buffer.actions).max() > 1.0


# --- predict


def test_predict_carries_the_option_as_state(random_walk_env):
    model = make(random_walk_env(), **TWO_OPTIONS)
    fix_networks(model.policy, [0.0, 0.0], [0.9, 0.1], [1e-30, 1e-30], means=[0.25, -0.5])
    obs = np.zeros((2, 2), dtype=np.float32)
    # Without a state an episode starts, and the master picks.
    actions, state = model.predict(obs, deterministic=True)
    assert state[0].tolist() == [0, 0]
    np.testing.assert_allclose(actions, [[0.5], [0.5]], rtol=1e-6)
    # Options do not terminate here: each stays what it is ...
    actions, state = model.predict(obs, (np.array([1, 0]),), np.array([False, False]), deterministic=True)
    assert state[0].tolist() == [1, 0]
    np.testing.assert_allclose(actions, [[-1.0], [0.5]], rtol=1e-6)
    # ... and is so without episode_start, too, until an episode starts.
    assert model.predict(obs, (np.array([1, 0]),), deterministic=True)[1][0].tolist() == [1, 0]
    assert model.predict(obs, (np.array([1, 1]),), np.array([True, False]), deterministic=True)[1][0].tolist() == [0, 1]


def test_predict_of_one_observation(random_walk_env):
    model = make(random_walk_env())
    action, state = model.predict(np.zeros(2, dtype=np.float32))
    assert action.shape == (1,)
    assert state[0].shape == (1,)
    assert model.predict(np.zeros(2, dtype=np.float32), state)[0].shape == (1,)


def test_evaluate_policy_resets_options(scripted_env):
    """Two environments whose episodes end at different times."""
    model = make(scripted_env(truncate_at=8), **TWO_OPTIONS)
    fix_networks(model.policy, [0.0, 0.0], [0.5, 0.5], [1e-30, 1e-30], means=[0.5, -0.5])
    env = DummyVecEnv([lambda n=n: scripted_env(truncate_at=n) for n in (3, 5)])
    seen = []
    evaluate_policy(
        model,
        env,
        40,
        deterministic=False,
        callback=lambda local, _: seen.append((local["i"], local["states"][0][local["i"]], local["dones"][local["i"]])),
        warn=False,
    )
    for i, length in enumerate((3, 5)):
        options = [option for index, option, _ in seen if index == i]
        episodes = np.reshape(options[: len(options) // length * length], (-1, length))
        assert (episodes == episodes[:, :1]).all()
        assert len(np.unique(episodes)) == 2


# --- the clock


def test_gamma_and_lambda_mean_the_same_at_every_dt(scripted_env):
    for dt, exponent in ((0.05, 1.0), (0.002, 0.04), (0.1, 2.0)):
        model = make(scripted_env(dt=dt), gamma=0.98, gae_lambda=0.9)
        assert model.step_gamma == pytest.approx(0.98**exponent)
        assert model.step_gae_lambda == pytest.approx(0.9**exponent)
        assert (model.rollout_buffer.gamma, model.rollout_buffer.gae_lambda) == (model.step_gamma, model.step_gae_lambda)


def test_gamma_a_step_needs_no_dt(scripted_env):
    model = make(scripted_env(dt=None), gamma_dt=None).learn(32)
    assert (model.step_gamma, model.step_gae_lambda) == (0.99, 0.95)
    with pytest.raises(ValueError, match="pass dt"):
        make(scripted_env(dt=None))
    with pytest.raises(ValueError, match="pass dt"):
        make(scripted_env(dt=None), gamma_dt=None, n_epochs=None, updates_per_second=1.0)
    assert make(scripted_env(dt=None), dt=0.1).step_gamma == pytest.approx(0.99**2)


def test_default_number_of_updates(random_walk_env):
    # 2 processes · 2 epochs · ⌈32/12⌉ minibatches
    assert make(random_walk_env(), batch_size=12).learn(32)._n_updates == 2 * 2 * 3
    assert DACPPO("MlpPolicy", random_walk_env()).n_epochs == 5


def test_updates_per_second(scripted_env):
    """7 steps of 0.05 s bring 3.5 updates at 10 a second; the half is carried over."""
    model = make(scripted_env(dt=0.05), n_steps=7, n_epochs=None, updates_per_second=10.0)
    numbers = []
    update = model._update
    model._update = lambda mdp, batch, clip_range: numbers.append(mdp) or update(mdp, batch, clip_range)
    for total in (3, 7, 10, 14):
        model.learn(7, reset_num_timesteps=False)
        assert len(numbers) == model._n_updates == total
    assert abs(numbers.count("high") - numbers.count("low")) <= 2
    # Two environments bring twice as much.
    vec_env = make_vec_env(lambda: scripted_env(dt=0.05), 2)
    assert make(vec_env, n_steps=7, n_epochs=None, updates_per_second=10.0).learn(14)._n_updates == 7


def test_both_orders_occur(random_walk_env):
    model = make(random_walk_env(), n_steps=4, batch_size=4, n_epochs=1)
    order = []
    update = model._update
    model._update = lambda mdp, batch, clip_range: order.append(mdp) or update(mdp, batch, clip_range)
    model.learn(4 * 20)
    assert set(order[::2]) == set(order[1::2]) == {"high", "low"}
    assert all(first != second for first, second in zip(order[::2], order[1::2], strict=True))


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_dt_is_found_in_vectorised_environments(random_walk_env, vec_env_cls):
    env = make_vec_env(random_walk_env, 2, vec_env_cls=vec_env_cls)
    assert make(env).dt == 0.1
    env.close()
    rendered = make_vec_env("MountainCarContinuous-v0", 2, vec_env_cls=vec_env_cls)
    assert make(rendered).dt == pytest.approx(1 / 30)
    rendered.close()


def test_environments_of_another_dt_are_refused(scripted_env):
    model = make(scripted_env(dt=0.1))
    with pytest.raises(ValueError, match=r"dt=0\.2, DACPPO has dt=0\.1"):
        model.set_env(scripted_env(dt=0.2))
    model.set_env(scripted_env(dt=0.1))
    with pytest.raises(ValueError, match="same dt"):
        make(DummyVecEnv([lambda dt=dt: scripted_env(dt=dt) for dt in (0.1, 0.2)]))
    # What the user says holds on any environment.
    make(scripted_env(dt=0.1), dt=0.3).set_env(scripted_env(dt=0.2))


# --- settings


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_epochs": 3, "updates_per_second": 10.0}, "pass one of them"),
        ({"n_epochs": 0}, "n_epochs must be at least 1"),
        ({"n_epochs": None, "updates_per_second": 0.0}, "updates_per_second must be positive"),
        ({"n_epochs": None, "updates_per_second": np.inf}, "updates_per_second must be positive"),
        ({"gamma": 0.0}, "gamma must be in"),
        ({"gamma": 1.1, "gamma_dt": None}, "gamma must be in"),
        ({"gamma_dt": 0.0}, "gamma_dt must be"),
        ({"gae_lambda": 1.1}, "gae_lambda must be in"),
        ({"dt": -1.0}, "dt must be"),
        ({"batch_size": 1}, "batch_size must be at least 2"),
        ({"policy_kwargs": {"n_options": 0}}, "n_options must be at least 1"),
        ({"policy_kwargs": {"use_sde": True}}, "use_sde"),
        ({"rollout_buffer_class": RolloutBuffer}, "DACRolloutBuffer"),
    ],
)
def test_bad_settings(random_walk_env, kwargs, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(random_walk_env(), **kwargs)


def test_options_of_several_steps_are_refused(random_walk_env):
    with pytest.raises(ValueError, match="remove the wrapper"):
        make(OptionExecutionWrapper(random_walk_env()))


def test_under_rewards_as_rates(random_walk_env):
    model = make(RewardRateWrapper(random_walk_env()))
    assert model.dt == 0.1
    buffer = rollout(model)
    assert np.abs(buffer.rewards[:19]).max() <= 0.1


def test_one_option_is_plain_ppo(random_walk_env):
    """With K = 1 the high process has nothing to choose, and both values are the same."""
    model = make(random_walk_env(), policy_kwargs={"net_arch": [8], "n_options": 1})
    buffer = rollout(model)
    np.testing.assert_allclose(buffer.mdp_log_probs["high"], 0.0, atol=1e-6)
    np.testing.assert_allclose(buffer.mdp_values["high"], buffer.mdp_values["low"], rtol=1e-6)
    np.testing.assert_allclose(buffer.mdp_advantages["high"], buffer.mdp_advantages["low"], rtol=1e-5, atol=1e-6)


def test_the_policy_alone_can_be_saved(random_walk_env, tmp_path):
    model = make(random_walk_env(), **TWO_OPTIONS)
    model.policy.save(tmp_path / "policy.pt")
    policy = DACPolicy.load(tmp_path / "policy.pt", device="cpu")
    obs = np.array([[0.1, 0.2]], dtype=np.float32)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_actors_and_critic_of_different_sizes(random_walk_env):
    policy = make(random_walk_env(), policy_kwargs={"net_arch": {"pi": [6, 5], "vf": [9]}}).policy
    for networks in (policy.master, policy.option_means, policy.terminations):
        assert [layer.weight.shape[-1] for layer in networks[::2]][:-1] == [6, 5]
    assert [layer.weight.shape[-1] for layer in policy.q_network[::2]][:-1] == [9]
    # As in PPO, what is left out has no hidden layers.
    policy = make(random_walk_env(), policy_kwargs={"net_arch": {"pi": [6]}}).policy
    assert [layer.weight.shape[-1] for layer in policy.master[::2]] == [6, 4]
    assert [layer.weight.shape[-1] for layer in policy.q_network[::2]] == [4]
    with pytest.raises(ValueError, match=r"net_arch must be a list of sizes, or dict\(pi=..., vf=...\)"):
        make(random_walk_env(), policy_kwargs={"net_arch": {"pi": [6], "qf": [9]}})


@pytest.mark.parametrize("share", [False, True])
def test_features_of_its_own_for_the_critic(random_walk_env, tmp_path, share):
    kwargs = {"share_features_extractor": share, "features_extractor_class": NatureCNN}
    model = make(random_walk_env("image"), policy_kwargs=kwargs, n_steps=8, n_epochs=1).learn(8)
    policy = model.policy
    obs, _ = policy.obs_to_tensor(np.full((1, 3, 36, 36), 90, np.uint8))
    policy.zero_grad()
    policy.options(obs).q_values.sum().backward()
    moved = {name.split(".")[0] for name, parameter in policy.named_parameters() if parameter.grad is not None}
    assert moved == {"q_network", "features_extractor" if share else "vf_features_extractor"}
    policy.save(tmp_path / "policy.pt")
    assert policy.load(tmp_path / "policy.pt", device="cpu").share_features_extractor is share


def test_the_clip_range_is_a_schedule(random_walk_env, tmp_path):
    """As PPO's: it is called with the remaining progress, is logged, and can be changed while loading."""
    model = make(random_walk_env(), clip_range=lambda remaining: 0.1 + 0.2 * remaining, n_steps=8).learn(32)
    assert model.clip_range(1.0) == pytest.approx(0.3)
    assert model.logger.name_to_value["train/clip_range"] == pytest.approx(0.1)
    model.save(tmp_path / "model")
    assert DACPPO.load(tmp_path / "model").clip_range(0.5) == pytest.approx(0.2)
    assert DACPPO.load(tmp_path / "model", clip_range=0.4).clip_range(0.5) == pytest.approx(0.4)


# --- learning


def test_options_specialise_on_a_bandit(scripted_env):
    """A reward for the sign of the action: each process has to learn for the return to rise."""
    env = scripted_env(rewards=lambda step, action: float(np.ravel(action)[0]), truncate_at=8)
    model = make(env, n_steps=128, batch_size=32, n_epochs=10, learning_rate=5e-3, **TWO_OPTIONS)
    before, _ = evaluate_policy(model, env, 4, deterministic=True, warn=False)
    model.learn(128 * 12)
    after, _ = evaluate_policy(model, env, 4, deterministic=True, warn=False)
    assert before < 4.0
    assert after > 6.0


@pytest.mark.slow
def test_dac_ppo_learns_pendulum():
    """From about −1200 of a random policy, in a third of the 300,000 steps for which docs/dac_ppo.md has figures."""
    env = VecNormalize(make_vec_env("Pendulum-v1", 8, seed=0), gamma=0.9)
    model = DACPPO("MlpPolicy", env, n_steps=256, batch_size=256, gamma=0.9, learning_rate=1e-3, seed=0, device="cpu")
    model.learn(100_000)
    env.training, env.norm_reward = False, False
    env.seed(1000)
    mean_return, _ = evaluate_policy(model, env, n_eval_episodes=40)
    assert mean_return > -600


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 1.5}, "gamma must be in"),
        ({"gae_lambda": 2.0}, "gae_lambda must be in"),
        ({"n_epochs": 0}, "n_epochs must be at least 1"),
        ({"updates_per_second": -1.0}, "updates_per_second must be positive"),
    ],
)
def test_load_refuses_what_the_constructor_does(scripted_env, tmp_path, change, message):
    make(scripted_env(), n_epochs=3).save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        DACPPO.load(tmp_path / "model", **change)


def test_how_often_to_update_may_be_changed_while_loading(scripted_env, tmp_path):
    make(scripted_env(), n_epochs=None, updates_per_second=10.0).save(tmp_path / "model")
    loaded = DACPPO.load(tmp_path / "model", updates_per_second=None)
    assert (loaded.n_epochs, loaded.updates_per_second) == (5, None)
    loaded = DACPPO.load(tmp_path / "model", n_epochs=2)
    assert (loaded.n_epochs, loaded.updates_per_second) == (2, None)
    loaded.save(tmp_path / "model")
    loaded = DACPPO.load(tmp_path / "model", updates_per_second=4.0)
    assert (loaded.n_epochs, loaded.updates_per_second) == (None, 4.0)


@pytest.mark.parametrize("dt", [0.0, -0.1, math.inf])
def test_an_interaction_period_that_is_none(scripted_env, dt):
    with pytest.raises(ValueError, match=f"dt must be a positive number of seconds, not {dt}"):
        DACPPO("MlpPolicy", scripted_env(dt=dt))
