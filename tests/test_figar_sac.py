import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.sac.sac as sac_module
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_ctco import FiGARSAC, OptionController, OptionExecutionWrapper, RewardRateWrapper
from sb3_ctco.common import soft_actor_critic
from sb3_ctco.common.losses import repeated_actor_loss, repetition_values
from sb3_ctco.export import export_onnx
from sb3_ctco.figar_sac.policies import FiGARSACPolicy, decode_repetitions, encode_repetitions
from sb3_ctco.options import OptionSpace, discount

SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "device": "cpu", "seed": 0, "learning_starts": 20}


def make(env, **kwargs):
    return FiGARSAC("MlpPolicy", env, **{**SMALL, **kwargs})


def column(*values):
    return th.tensor(values)[:, None]


# --- losses, from numbers worked by hand

# One state, two critics, two repetitions: min_i Q = (1, 3), π_x = (1/4, 3/4)
Q_VALUES = th.tensor([[[1.0, 4.0]], [[2.0, 3.0]]])
LOG_PROBS = th.tensor([[0.25, 0.75]]).log()
ENTROPY = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)


def test_expectation_over_repetitions_by_hand():
    # 1/4·1 + 3/4·3 = 2.5
    assert repetition_values(Q_VALUES, LOG_PROBS, th.tensor(0.0)).item() == pytest.approx(2.5)
    assert repetition_values(Q_VALUES, LOG_PROBS, th.tensor(0.5)).item() == pytest.approx(2.5 + 0.5 * ENTROPY)


def test_actor_loss_by_hand():
    # L_a = 0.2·(−1.5) − 2.5; L_x = −(2.5 + 0.5·H)
    loss = repeated_actor_loss(Q_VALUES, th.tensor([-1.5]), LOG_PROBS, th.tensor([0.2, 0.5]))
    assert loss.item() == pytest.approx(-0.3 - 2.5 - 2.5 - 0.5 * ENTROPY)


def test_each_part_of_the_policy_is_moved_with_the_other_one_held_fixed():
    q_values = Q_VALUES.clone().requires_grad_(True)
    logits = LOG_PROBS.clone().requires_grad_(True)
    log_prob = th.tensor([-1.5], requires_grad=True)
    repeated_actor_loss(q_values, log_prob, logits.log_softmax(dim=1), th.tensor([0.2, 0.5])).backward()
    # The action climbs Σ_k π_x(k)·min_i Q_k: −π_x for the smaller critic of each k, through L_a alone.
    th.testing.assert_close(q_values.grad, th.tensor([[[-0.25, 0.0]], [[0.0, -0.75]]]))
    assert log_prob.grad.item() == pytest.approx(0.2)
    # Softmax's gradient of L_x alone: π_k·(c_k − Σ_j π_j·c_j) with c = α_x·log π − min Q
    costs = [0.5 * math.log(0.25) - 1.0, 0.5 * math.log(0.75) - 3.0]
    mean = 0.25 * costs[0] + 0.75 * costs[1]
    expected = [[0.25 * (costs[0] - mean), 0.75 * (costs[1] - mean)]]
    np.testing.assert_allclose(logits.grad.numpy(), expected, rtol=1e-5)


def samples(**kwargs):
    """Two equal transitions, of which the second one terminated."""
    fields = {
        "observations": th.zeros(2, 2),
        "actions": th.zeros(2, 2),
        "next_observations": th.zeros(2, 2),
        "dones": column(0.0, 1.0),
        "rewards": column(0.7, 0.7),
        "discounts": column(0.9, 0.9),
    }
    return ReplayBufferSamples(**{**fields, **kwargs})


def test_critic_targets_by_hand(random_walk_env):
    model = make(random_walk_env(), n_repetitions=2, ent_coef=0.2, duration_ent_coef=0.5)
    model.actor.action_log_prob = lambda obs: (th.zeros(2, 1), th.tensor([-1.5, -1.5]), LOG_PROBS.expand(2, 2))
    model.critic_target = lambda obs, actions: Q_VALUES.expand(2, 2, 2)
    # 0.7 + 0.9·(2.5 + 0.5·H − 0.2·(−1.5)), and 0.7 where it terminated
    expected = column(0.7 + 0.9 * (2.8 + 0.5 * ENTROPY), 0.7)
    th.testing.assert_close(model._critic_targets(samples()), expected)


def test_the_critic_learns_the_repetition_that_ran(random_walk_env):
    model = make(random_walk_env(), n_repetitions=3)
    outputs = th.arange(12.0).reshape(2, 2, 3)  # [critics, batch, K]
    seen = []

    def critic(obs, actions):
        seen.append(actions)
        return outputs

    model.critic = critic
    # k = 3 in the first row, k = 1 in the second one
    data = samples(actions=th.tensor([[0.3, 1.0], [-0.4, -1.0]]))
    th.testing.assert_close(model._q_values(data), th.tensor([[[2.0], [3.0]], [[8.0], [9.0]]]))
    th.testing.assert_close(seen[0], th.tensor([[0.3], [-0.4]]))


# --- repetitions


@pytest.mark.parametrize("dt", [0.002, 0.01, 1 / 60, 0.02, 0.05, 0.1, 1 / 3])
@pytest.mark.parametrize("n", [*range(1, 25), 79, 100, 127, 300, 517])
def test_repetitions_are_exact(dt, n):
    """Each k of {1, …, K} becomes k steps, whether numpy or torch encodes it, in single precision."""
    option = OptionSpace.make(1, n * dt, dt, dt, discount_rate=0.0, duration_scale="linear")
    repetitions = np.arange(1, n + 1, dtype=np.float32)
    for encoded in (encode_repetitions(repetitions, n), encode_repetitions(th.tensor(repetitions), n).numpy()):
        assert encoded.dtype == np.float32
        # As Stable-Baselines3 scales actions
        scaled = np.float32(-1.0) + np.float32(0.5) * (encoded + np.float32(1.0)) * np.float32(2.0)
        assert [option.decode(np.array([0.0, u], dtype=np.float32))[1] for u in scaled] == repetitions.tolist()
        assert decode_repetitions(encoded, n).tolist() == repetitions.tolist()


@given(n=st.integers(1, 5000), dt=st.floats(1e-4, 10.0), share=st.floats(0.0, 1.0))
def test_any_repetition_is_exact(n, dt, share):
    k = 1 + round(share * (n - 1))
    option = OptionSpace.make(1, n * dt, dt, dt, discount_rate=0.0, duration_scale="linear")
    encoded = encode_repetitions(np.array([k], dtype=np.float32), n)
    assert option.decode(np.array([0.0, encoded[0]], dtype=np.float32))[1] == k


def test_the_environment_plays_each_repetition(scripted_env):
    model = make(scripted_env(), n_repetitions=30)
    env = model.get_env()
    env.reset()
    for k in range(1, 31):
        encoded = encode_repetitions(np.float32(k), 30)
        assert env.step(np.array([[0.5, encoded]], dtype=np.float32))[3][0]["option"]["n_steps"] == k


def test_random_repetitions_are_uniform(random_walk_env):
    model = make(random_walk_env(), n_repetitions=5)
    drawn = [decode_repetitions(model._sample_action(10**9, None, 1)[1][:, -1], 5).item() for _ in range(3000)]
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [1, 2, 3, 4, 5]
    # Four standard deviations of 22 around 600; the ends would be drawn 375 times if durations were uniform.
    assert np.abs(counts - 600).max() < 90


def test_the_policy_draws_repetitions_from_its_distribution(random_walk_env):
    model = make(random_walk_env(), n_repetitions=3)
    with th.no_grad():
        model.actor.repetition_head.weight.zero_()
        model.actor.repetition_head.bias.copy_(th.tensor([0.2, 0.7, 0.1]).log())
    obs = np.zeros((4000, 2), dtype=np.float32)
    drawn = decode_repetitions(model.predict(obs)[0][:, -1], 3)
    shares = [float((drawn == k).mean()) for k in (1, 2, 3)]
    np.testing.assert_allclose(shares, [0.2, 0.7, 0.1], atol=0.03)
    greedy, _ = model.predict(obs[:5], deterministic=True)
    assert decode_repetitions(greedy[:, -1], 3).tolist() == [2.0] * 5


def test_what_is_stored_is_what_ran(scripted_env):
    """Episodes of 5 steps cut the second repetition of 4 to 1."""
    model = make(scripted_env(terminate_at=5), n_repetitions=4, learning_starts=1000)
    asked = np.array([[0.5, encode_repetitions(np.float32(4), 4)]], dtype=np.float32)
    model._sample_action = lambda *args: (asked.copy(), asked.copy())
    model.learn(10)
    buffer = model.replay_buffer
    assert decode_repetitions(buffer.actions[:4, 0, 1], 4).tolist() == [4.0, 1.0, 4.0, 1.0]
    np.testing.assert_allclose(buffer.durations[:4, 0], [0.4, 0.1, 0.4, 0.1])
    assert buffer.dones[:4, 0].tolist() == [0.0, 1.0, 0.0, 1.0]
    np.testing.assert_allclose(buffer.actions[:4, 0, 0], 0.5)


def test_noise_changes_what_is_played_and_stored_alike(random_walk_env):
    noise = NormalActionNoise(np.zeros(2), 0.5 * np.ones(2))
    model = make(random_walk_env(), n_repetitions=6, action_noise=noise).learn(100)
    buffer = model.replay_buffer
    stored = decode_repetitions(buffer.actions[: buffer.pos, 0, 1], 6)
    np.testing.assert_allclose(stored * 0.1, buffer.durations[: buffer.pos, 0], rtol=1e-5)
    assert len(np.unique(stored)) > 2


# --- with one repetition, it is SAC


def test_one_repetition_is_sac(monkeypatch):
    """Same networks, data and noise: the critics' targets and the actor's gradients are those of SB3's SAC."""
    common = {"policy_kwargs": {"net_arch": [16]}, "learning_rate": 0.0, "ent_coef": 0.2, "seed": 0, "device": "cpu"}
    model = FiGARSAC("MlpPolicy", gym.make("Pendulum-v1"), n_repetitions=1, learning_starts=10_000, **common).learn(250)
    gamma = float(discount(model.dt, model.discount_rate))
    assert gamma == pytest.approx(0.98)
    sac = SAC("MlpPolicy", gym.make("Pendulum-v1"), gamma=gamma, learning_starts=0, buffer_size=1000, **common)
    sac._logger = model.logger

    buffer = model.replay_buffer
    for i in range(250):
        truncated = bool(buffer.timeouts[i, 0])
        sac.replay_buffer.add(
            buffer.observations[i],
            buffer.next_observations[i],
            buffer.actions[i, :, :1],
            buffer.integrated_rewards[i],
            buffer.dones[i],
            [{"TimeLimit.truncated": truncated}],
        )
    assert buffer.timeouts[:250].sum() == 1

    with th.no_grad():
        # SB3 adds 1e-6 inside the logarithm of the squashing, which shows where tanh is flat: keep away from there.
        mean, log_std = model.actor.action_head.weight.chunk(2)
        mean.mul_(0.1)
        log_std.zero_()
        model.actor.action_head.bias.copy_(th.tensor([0.0, -2.0]))
        for ours, theirs in zip(model.actor.latent_pi, sac.actor.latent_pi, strict=True):
            theirs.load_state_dict(ours.state_dict())
        sac.actor.mu.weight.copy_(mean)
        sac.actor.mu.bias.zero_()
        sac.actor.log_std.weight.zero_()
        sac.actor.log_std.bias.fill_(-2.0)
        for critic, sac_critic in ((model.critic, sac.critic), (model.critic_target, sac.critic_target)):
            for parameter in critic.parameters():
                parameter.add_(0.1 * th.randn_like(parameter))
            for i, network in enumerate(sac_critic.q_networks):
                for ours, theirs in zip(critic.q_networks, network, strict=True):
                    if hasattr(ours, "weight"):
                        theirs.weight.copy_(ours.weight[i].T)
                        theirs.bias.copy_(ours.bias[i, 0])

    targets = {"ours": [], "theirs": []}
    critic_loss = soft_actor_critic.critic_loss

    def our_loss(q_values, target):
        targets["ours"].append(target)
        return critic_loss(q_values, target)

    def their_loss(q_values, target):
        targets["theirs"].append(target)
        return th.nn.functional.mse_loss(q_values, target)

    monkeypatch.setattr(soft_actor_critic, "critic_loss", our_loss)
    monkeypatch.setattr(sac_module, "F", SimpleNamespace(mse_loss=their_loss))
    for algorithm in (model, sac):
        np.random.seed(0)
        th.manual_seed(0)
        algorithm.train(1, batch_size=64)
    assert targets["ours"][0].std() > 0.01
    th.testing.assert_close(targets["ours"][0], targets["theirs"][0], atol=1e-6, rtol=1e-6)
    our_mean, our_log_std = model.actor.action_head.weight.grad.chunk(2)
    assert our_mean.abs().max() > 1e-4
    th.testing.assert_close(our_mean, sac.actor.mu.weight.grad, atol=1e-5, rtol=1e-4)
    th.testing.assert_close(our_log_std, sac.actor.log_std.weight.grad, atol=1e-5, rtol=1e-4)


def test_one_repetition_has_no_temperature(random_walk_env):
    model = make(random_walk_env(), n_repetitions=1).learn(60)
    assert model.ent_coefs[1] == 0.0
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


# --- temperatures


def test_target_entropies(random_walk_env):
    model = make(random_walk_env(), n_repetitions=20)
    assert model.target_entropy == -1.0
    assert model.duration_target_entropy == pytest.approx(0.4 * math.log(20))


def test_temperature_of_the_repetition_follows_its_entropy(random_walk_env):
    """It falls while the entropy is above 0.4·log K, and rises below."""
    model = make(random_walk_env(), n_repetitions=8, learning_rate=0.01, learning_starts=1000).learn(60)
    with th.no_grad():
        model.actor.repetition_head.weight.zero_()
    for bias, sign in ((0.0, -1.0), (50.0, 1.0)):
        with th.no_grad():
            model.actor.repetition_head.bias.copy_(th.tensor([bias] + [0.0] * 7))
        _, log_prob, _ = model._sample_policy(th.zeros(4, 2))
        # log K if uniform, 0 if certain
        assert log_prob[:, 1].mean().item() == pytest.approx(-math.log(8) if bias == 0.0 else 0.0, abs=1e-4)
        model.ent_coef_optimizer.state.clear()
        before = model.log_ent_coefs[1].item()
        model._update_temperatures(log_prob.detach())
        assert model.log_ent_coefs[1].item() - before == pytest.approx(sign * 0.01, rel=1e-3)


# --- environments and settings


def test_a_bare_environment_is_wrapped(random_walk_env):
    model = make(random_walk_env(), n_repetitions=7)
    one = model.get_env().get_attr("option_space")[0]
    assert (one.trajectory.n_weights, one.d_min, one.dt) == (1, 0.1, 0.1)
    assert one.d_max == pytest.approx(0.7)
    assert make(random_walk_env()).n_repetitions == 20
    assert model.critic(th.zeros(2, 2), th.zeros(2, 1)).shape == (2, 2, 7)


@pytest.mark.parametrize(("d_max", "n"), [(0.5, 5), (0.3, 3), (0.34, 3), (0.05, 1), (0.01, 1)])
def test_longest_repetition_in_seconds(random_walk_env, d_max, n):
    model = make(random_walk_env(), d_max=d_max)
    assert model.n_repetitions == n
    assert model.d_max == pytest.approx(n * 0.1)


@pytest.mark.parametrize("kwargs", [{"n_repetitions": 4}, {"d_max": 0.4}])
def test_wrapped_environments(random_walk_env, kwargs):
    env = OptionExecutionWrapper(random_walk_env(), n_rbf=1, d_max=0.4, duration_scale="linear")
    assert make(env, **kwargs).n_repetitions == 4
    wrapper_kwargs = {"n_rbf": 1, "d_max": 0.4, "duration_scale": "linear"}
    vec_env = make_vec_env(random_walk_env, 2, wrapper_class=OptionExecutionWrapper, wrapper_kwargs=wrapper_kwargs)
    model = make(vec_env, **kwargs).learn(80)
    stored = decode_repetitions(model.replay_buffer.actions[: model.replay_buffer.pos, :, 1], 4)
    np.testing.assert_allclose(stored * 0.1, model.replay_buffer.durations[: model.replay_buffer.pos], rtol=1e-5)


@pytest.mark.parametrize(
    ("wrapper", "name"),
    [({"n_rbf": 2, "d_max": 0.4}, "n_rbf"), ({"d_max": 0.5}, "d_max"), ({"d_min": 0.2, "d_max": 0.4}, "d_min")],
)
def test_disagreeing_settings_are_refused(random_walk_env, wrapper, name):
    with pytest.raises(ValueError, match=f"options have {name}="):
        make(OptionExecutionWrapper(random_walk_env(), **{"n_rbf": 1, "duration_scale": "linear", **wrapper}), n_repetitions=4)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"n_repetitions": 0}, ValueError, "at least 1, not 0"),
        ({"n_repetitions": 2.0}, TypeError, r"integer, not 2\.0"),
        ({"n_repetitions": True}, TypeError, "integer, not True"),
        ({"n_repetitions": 4, "d_max": 1.0}, ValueError, "pass one of them"),
        ({"d_max": 0.0}, ValueError, "d_max must be a positive"),
        ({"d_max": math.inf}, ValueError, "d_max must be a positive"),
        ({"ent_coef": "aut"}, ValueError, "ent_coef must be"),
        ({"policy_kwargs": {"use_sde": True}}, ValueError, "State-Dependent"),
        ({"policy_kwargs": {"n_critics": 0}}, ValueError, "n_critics must be at least 1"),
    ],
)
def test_bad_settings(random_walk_env, kwargs, error, message):
    with pytest.raises(error, match=message):
        make(random_walk_env(), **kwargs)


def test_an_environment_without_dt_needs_one(scripted_env):
    with pytest.raises(ValueError, match="pass dt"):
        make(scripted_env(dt=None), n_repetitions=3)
    assert make(scripted_env(dt=None), n_repetitions=3, dt=0.5).d_max == pytest.approx(1.5)


def test_evaluation_at_another_rate_keeps_seconds(scripted_env):
    model = make(scripted_env(dt=0.1), n_repetitions=4)
    env = model.wrap_env(scripted_env(dt=0.05))
    env.reset()
    n_steps = [env.step([0.0, encode_repetitions(np.float32(k), 4)])[4]["option"]["n_steps"] for k in (1, 2, 3, 4)]
    assert n_steps == [2, 4, 6, 8]


def test_the_policy_alone_can_be_saved(random_walk_env, tmp_path):
    model = make(random_walk_env(), n_repetitions=5)
    model.policy.save(tmp_path / "policy.pt")
    policy = FiGARSACPolicy.load(tmp_path / "policy.pt", device="cpu")
    obs = np.array([[0.1, 0.2]], dtype=np.float32)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_critic_targets_are_an_exact_expectation(seed):
    """Against a sum over repetitions written out."""
    generator = th.Generator().manual_seed(seed)
    q_values = th.randn(2, 3, 4, generator=generator)
    log_probs = th.randn(3, 4, generator=generator).log_softmax(dim=1)
    values = repetition_values(q_values, log_probs, th.tensor(0.3))
    for row in range(3):
        total = 0.0
        for k in range(4):
            log_prob = log_probs[row, k].item()
            total += math.exp(log_prob) * (min(q_values[0, row, k].item(), q_values[1, row, k].item()) - 0.3 * log_prob)
        assert values[row].item() == pytest.approx(total, abs=1e-5)


def test_an_exported_policy_acts_as_the_model(tmp_path):
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    model = FiGARSAC("MlpPolicy", gym.make("Pendulum-v1"), n_repetitions=7, **{**SMALL, "seed": 1})
    export_onnx(model, tmp_path / "policy.onnx")
    exported, direct = OptionController(tmp_path / "policy.onnx"), OptionController(model)
    env = gym.make("Pendulum-v1")
    obs, _ = env.reset(seed=0)
    for _ in range(30):
        action = direct(obs)
        np.testing.assert_allclose(exported(obs), action, atol=1e-5)
        obs, *_ = env.step(action)


# --- learning


def test_a_fixed_rate_wrapper_tells_the_same_integral(scripted_env):
    """The reward of one repetition of one step is that of RewardRateWrapper."""
    make_env = lambda: scripted_env(rewards=lambda step, action: 1.0 + step, dt=0.1)  # noqa: E731
    model = make(make_env(), n_repetitions=1)
    env = model.get_env()
    fixed = RewardRateWrapper(make_env(), discount_rate=model.discount_rate)
    env.reset()
    fixed.reset()
    for _ in range(3):
        option = env.step(np.array([[0.0, 1.0]], dtype=np.float32))[3][0]["option"]
        _, reward, _, _, info = fixed.step(np.array([0.0], dtype=np.float32))
        assert option == pytest.approx(info["option"])
        assert reward == pytest.approx(option["integrated_reward"])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_figar_sac_learns_pendulum(seed):
    """From about −1200 of a random policy to more than −400 in 10,000 of the 20,000 steps that are allowed."""
    model = FiGARSAC(
        "MlpPolicy",
        gym.make("Pendulum-v1"),
        n_repetitions=10,
        learning_rate=2e-3,
        learning_starts=500,
        batch_size=128,
        updates_per_second=5,
        ent_coef="auto_0.1",
        duration_ent_coef="auto_0.1",
        policy_kwargs={"net_arch": [64, 64]},
        seed=seed,
        device="cpu",
    )
    model.learn(10_000)
    env = model.wrap_env(gym.make("Pendulum-v1"))
    env.reset(seed=1000 + seed)
    mean_return, _ = evaluate_policy(model, env, n_eval_episodes=20)
    assert mean_return > -400
