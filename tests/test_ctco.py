import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from torch.distributions import Normal

from sb3_ctco import CTCO, DictOptionReplayBuffer, FiGARSAC, OptionExecutionWrapper, OptionReplayBuffer
from sb3_ctco.common.losses import actor_loss, critic_loss, critic_target, log_reference_density, pessimistic_values
from sb3_ctco.common.policies import EnsembleLinear, squashed_log_prob
from sb3_ctco.ctco.policies import CTCOPolicy
from sb3_ctco.options import DEFAULT_DISCOUNT_RATE, discount_rate_from_gamma, step_weight
from sb3_ctco.safety import Safety
from sb3_ctco.wrappers import TakeOverWrapper

# Without sub-options, so that rows of the buffer are the decisions in their order.
SMALL = {
    "policy_kwargs": {"net_arch": [8]},
    "batch_size": 8,
    "device": "cpu",
    "seed": 0,
    "learning_starts": 20,
    "n_sub_options": 0,
}


def make(env, **kwargs):
    return CTCO("MlpPolicy", env, **{**SMALL, **kwargs})


def set_temperature_of_d(model, temperature):
    """Another one than that of ω, so that numbers worked by hand tell which is where."""
    with th.no_grad():
        model.log_ent_coefs[-1] = math.log(temperature)


# --- losses, from numbers worked by hand


def test_critic_target_by_hand():
    column = lambda *values: th.tensor(values)[:, None]  # noqa: E731
    # R − β_h + γ(d)·(Q' − cost); the second row terminated: 1 − 0.1 + 0.5·(4 − 2) and 3 − 0.1
    target = critic_target(
        column(1.0, 3.0), column(0.0, 1.0), column(0.5, 0.9), column(4.0, 7.0), column(2.0, 5.0), high_freq_penalty=0.1
    )
    th.testing.assert_close(target, column(1.9, 2.9))


def test_losses_by_hand():
    q_values = th.tensor([[[1.0], [2.0]], [[3.0], [0.0]]])  # [2 critics, batch of 2, 1]
    # ½·mean(0², 1²) + ½·mean(2², 1²)
    assert critic_loss(q_values, th.tensor([[1.0], [1.0]])).item() == pytest.approx(0.25 + 1.25)
    # mean(0.5 − min(1, 3), 0.25 − min(2, 0))
    assert actor_loss(q_values, th.tensor([[0.5], [0.25]])).item() == pytest.approx((-0.5 + 0.25) / 2)


def test_the_policy_gradient_runs_through_omega_and_d():
    """Equation (8): the gradient of L_π against finite differences of Q on a quadratic critic."""
    th.manual_seed(0)
    matrix = th.randn(4, 4, dtype=th.float64)
    noise = th.randn(16, 3, dtype=th.float64)
    parameters = th.randn(6, dtype=th.float64).requires_grad_(True)
    reference = log_reference_density(th.tensor([2.0, 1.0], dtype=th.float64), 0.1, 1.0, "uniform")
    coefficients = th.tensor([0.3, 0.7], dtype=th.float64)
    scale = th.tensor([1.0, 1.0, 0.5], dtype=th.float64)

    def loss(values):
        mean, log_std = values[:3], values[3:]
        y = (mean + noise * log_std.exp()) * scale
        log_prob = squashed_log_prob(noise, log_std.expand_as(noise), y) - scale.log()
        parts = th.stack((log_prob[:, :2].sum(dim=1), log_prob[:, 2]), dim=1)
        costs = ((parts - reference) @ coefficients)[:, None]
        x = th.cat((y.tanh(), th.ones(16, 1, dtype=th.float64)), dim=1)
        q_value = -((x @ matrix) * x).sum(dim=1, keepdim=True)
        return actor_loss(q_value[None], costs)

    loss(parameters).backward()
    for i in range(6):
        step = th.zeros(6, dtype=th.float64)
        step[i] = 1e-6
        with th.no_grad():
            difference = (loss(parameters + step) - loss(parameters - step)) / 2e-6
        assert parameters.grad[i].item() == pytest.approx(difference.item(), rel=1e-5, abs=1e-8)
    # Both d's mean and its deviation matter.
    assert parameters.grad[2].abs() > 1e-3
    assert parameters.grad[5].abs() > 1e-3


def test_densities_against_a_change_of_variables():
    """log π over the normalised box, for ω (tanh) and d (sigmoid), as the derivative of the inverse says."""
    th.manual_seed(0)
    policy = make(random_walk_like()).policy
    obs = th.rand(64, 2) * 2 - 1
    th.manual_seed(1)
    options, log_prob = policy.actor.option_log_prob(obs)
    mean, log_std = policy.actor.distribution_parameters(obs)
    omega, d = options[:, :-1].double(), options[:, -1].double()
    inverse = th.cat((th.atanh(omega), th.logit((d + 1) / 2)[:, None]), dim=1)
    gaussian = Normal(mean.double(), log_std.double().exp()).log_prob(inverse)
    # dω/dx = 1 − ω², and d/dx (2σ(x) − 1) = 2σ(1 − σ) = (1 − d²)/2
    expected_omega = gaussian[:, :-1] - th.log(1 - omega**2)
    expected_d = gaussian[:, -1] - th.log((1 - d**2) / 2)
    th.testing.assert_close(log_prob[:, :-1].double(), expected_omega, rtol=1e-4, atol=1e-4)
    th.testing.assert_close(log_prob[:, -1].double(), expected_d, rtol=1e-4, atol=1e-4)


def test_entropy_references():
    # Two temperatures for six weights, and d's
    sizes = th.tensor([3.0, 3.0, 1.0])
    # Uniform over [−1, 1]^3, twice, and over [−1, 1]
    uniform = log_reference_density(sizes, 0.1, 1.0, "uniform")
    th.testing.assert_close(uniform, th.tensor([-3.0, -3.0, -1.0]) * math.log(2.0))
    # The unit density over ω and over d in s: [0.1, 2.1] s is as long as [−1, 1].
    th.testing.assert_close(log_reference_density(sizes, 0.1, 2.1, "paper"), th.zeros(3))
    th.testing.assert_close(log_reference_density(sizes, 0.1, 0.6, "paper"), th.tensor([0.0, 0.0, math.log(0.25)]))


def test_relative_to_the_average_a_decision_costs_nothing():
    model = make(random_walk_like(), n_rbf=1, ent_coef=1.0, entropy_reference="average")
    set_temperature_of_d(model, 0.5)
    # 5 and 7 are 1 off their mean, 1 and 3 likewise at half the temperature.
    costs = model.entropy_costs(th.tensor([[5.0, 1.0], [7.0, 3.0]]))
    th.testing.assert_close(costs, th.tensor([[-1.5], [1.5]]))


def test_each_weight_of_a_trajectory_has_a_temperature():
    """Two actions of three weights: the first, the second and the third of both share one; d has its own."""
    model = make(random_walk_like(action_dim=2), n_rbf=3, ent_coef="auto_0.5")
    set_temperature_of_d(model, 0.25)
    th.testing.assert_close(model.ent_coefs, th.tensor([0.5, 0.5, 0.5, 0.25]))
    th.testing.assert_close(model._target_entropies, th.tensor([-2.0, -2.0, -2.0, -1.0]))
    log_prob = th.tensor([[1.0, 2.0, 4.0, 10.0, 20.0, 40.0, 7.0]])
    th.testing.assert_close(log_prob @ model._parts, th.tensor([[11.0, 22.0, 44.0, 7.0]]))
    # Each follows its own weights: more random than −2, as random, and less; and d is less random than −1.
    model._update_temperatures(th.tensor([[1.0, 2.0, 3.0, 9.0]]))
    assert th.sign(model.ent_coefs - th.tensor([0.5, 0.5, 0.5, 0.25])).tolist() == [-1.0, 0.0, 1.0, 1.0]


@pytest.mark.slow
def test_the_price_of_a_decision_is_the_penalty_alone(scripted_env):
    """Where nothing is ever paid, long and short options are worth the same: without a penalty no duration is preferred.

    The mean duration then is the one of most entropy, in the middle of 0.1 to 2 s.
    """

    def mean_duration(seed, **kwargs):
        env = scripted_env(rewards=lambda step, action: 0.0, dt=0.1, truncate_at=50)
        small = {"n_rbf": 1, "d_max": 2.0, "batch_size": 64, "policy_kwargs": {"net_arch": [32, 32]}, "learning_rate": 1e-3}
        timing = {"gamma": 0.9, "gamma_dt": 0.1, "updates_per_second": 5, "learning_starts": 500}
        temperatures = {"ent_coef": 0.1, "duration_scale": "linear"}
        model = make(env, **{**small, **timing, **temperatures, "seed": seed, **kwargs}).learn(6000)
        obs = th.tensor([[count, 0.0] for count in range(0, 50, 5)]).repeat(200, 1)
        with th.no_grad():
            options, _ = model.actor.option_log_prob(obs)
        return 0.1 + 0.5 * (options[:, -1].mean().item() + 1.0) * 1.9

    free = [mean_duration(seed, high_freq_penalty=0.0, entropy_reference="average") for seed in range(3)]
    np.testing.assert_allclose(free, 1.05, atol=0.1)
    # A penalty lengthens options, and being paid for entropy shortens them.
    assert mean_duration(0, high_freq_penalty=0.2, entropy_reference="average") > max(free) + 0.1
    assert mean_duration(0, high_freq_penalty=0.0, entropy_reference="paper") < min(free) - 0.1


def test_a_decision_is_never_paid_for_its_entropy():
    """Relative to the uniform distribution the expected cost is a KL divergence, at least 0."""
    model = make(random_walk_like(), n_rbf=3, ent_coef=1.0, entropy_reference="uniform")
    _, log_prob = model.actor.option_log_prob(th.zeros(4096, 2))
    assert model.entropy_costs(log_prob @ model._parts).mean() > -0.05
    # With the paper's density the same policy is paid at each decision.
    model = make(random_walk_like(), n_rbf=3, ent_coef=1.0, entropy_reference="paper", duration_scale="linear")
    assert model.entropy_costs(log_prob @ model._parts).mean() < -0.5


def test_paper_entropies_need_the_papers_durations():
    with pytest.raises(ValueError, match=r"entropy_reference='paper' .* needs duration_scale='linear', not 'log'"):
        make(random_walk_like(), entropy_reference="paper", duration_scale="log")


def test_the_critics_see_what_is_played(random_walk_env):
    """Of one step the first of two weights is all: options that differ in the other have one value, and no gradient by it."""
    of_options = {"n_rbf": 2, "d_max": 0.5, "duration_scale": "linear"}
    model = make(random_walk_env(), **of_options, trajectory="bezier").learn(40)
    obs = th.zeros(2, 2)
    # Of one step: up to 0.15 s, which is −0.75 on the way from 0.1 to 0.5 s
    options = th.tensor([[0.3, 0.9, -1.0], [0.3, -0.4, -0.8]], requires_grad=True)
    values = model.critic(obs, model._as_critics_see(options))
    th.testing.assert_close(values[:, 0], values[:, 1])
    (gradient,) = th.autograd.grad(values.sum(), options)
    assert (gradient[:, 1] == 0).all() and (gradient[:, [0, 2]] != 0).all()
    # Three steps are −1 + 2·0.2/0.4.
    longer = th.tensor([[0.3, 0.9, 0.1]])
    th.testing.assert_close(model._as_critics_see(longer), th.tensor([[0.3, 0.9, 0.0]]))
    # Where the shortest option has two steps, weights stay as they are, and so does all; and with the paper's basis functions.
    for kwargs in ({"d_min": 0.2}, {"trajectory": "rbf"}):
        assert make(random_walk_env(), **{**of_options, **kwargs})._as_critics_see(longer) is longer


def test_what_was_counted_goes_on_after_loading(tmp_path, random_walk_env):
    model = make(random_walk_env(), target_decision_rate=5.0).learn(60)
    counted = model._counted_decisions
    assert counted[0] > 0
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CTCO.load(tmp_path / "model", env=random_walk_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert tuple(loaded._counted_decisions) == counted
    before = loaded.log_high_freq_penalty.item()
    loaded._update_high_freq_penalty()  # no decision since
    assert loaded.log_high_freq_penalty.item() == before


def test_the_temperature_has_sacs_name(random_walk_env):
    model = make(random_walk_env(), ent_coef="auto_0.5").learn(30)
    th.testing.assert_close(model.log_ent_coef, model.log_ent_coefs[:1].detach())


def test_what_a_decision_costs_is_logged(random_walk_env):
    model = make(random_walk_env(), high_freq_penalty=0.25, entropy_reference="uniform").learn(40)
    model.train(1, 8)
    logged = model.logger.name_to_value
    next_q_values, costs = model._last_next_values
    assert logged["option/high_freq_penalty"] == 0.25
    assert logged["option/entropy_price"] == pytest.approx(costs.mean().item())
    # Of two critics
    assert logged["option/critic_spread"] == pytest.approx((next_q_values[0] - next_q_values[1]).abs().mean().item())


@pytest.mark.parametrize("scale", [0.0, -1.0, math.inf, "gamma_dt"])
def test_a_reward_scale_that_is_none(scale, random_walk_env):
    with pytest.raises(ValueError, match="reward_scale must be a positive number or 'auto'"):
        make(random_walk_env(), replay_buffer_kwargs={"reward_scale": scale})


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("penalty", [0.003, "relative_0.1"])
def test_units_make_no_difference(penalty, fast):
    """Rewards in another unit, or γ over another gamma_dt: the same networks, but for rounding."""

    def learned(factor=1.0, gamma=0.98, gamma_dt=0.05):
        env = gym.wrappers.TransformReward(gym.make("Pendulum-v1"), lambda r: factor * r)
        unit = {"replay_buffer_kwargs": {"reward_scale": "auto"}, "high_freq_penalty": penalty}
        settings = {"gamma": gamma, "gamma_dt": gamma_dt, "d_max": 0.3, "fast_updates": fast, **unit}
        model = make(env, n_sub_options=2, learning_starts=50, policy_kwargs={"net_arch": [16]}, **settings).learn(200)
        assert model._n_updates > 50
        return th.nn.utils.parameters_to_vector(model.policy.parameters())

    weights = learned()
    th.testing.assert_close(learned(factor=128.0), weights, rtol=0, atol=0)  # a power of two rounds nothing
    th.testing.assert_close(learned(factor=100.0), weights, rtol=1e-3, atol=1e-3)
    th.testing.assert_close(learned(factor=0.01), weights, rtol=1e-3, atol=1e-3)
    th.testing.assert_close(learned(gamma=0.98**2, gamma_dt=0.1), weights, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("scale", [1.0, 5.0, "auto"])
def test_a_relative_penalty_follows_what_is_paid(scale, tmp_path):
    """−3 at each of 30 steps of 0.05 s, so what options pay a second is 3, less what is discounted within them."""
    env = gym.wrappers.TransformReward(gym.make("Pendulum-v1"), lambda r: -3.0)
    settings = {"d_min": 0.1, "d_max": 0.1001, "n_sub_options": 2, "learning_starts": 20, "high_freq_penalty": "relative_0.5"}
    model = make(env, replay_buffer_kwargs={"reward_scale": scale}, **settings)
    model.learn(30)
    buffer = model.replay_buffer
    size = buffer.size()
    rate = np.abs(buffer.integrated_rewards[:size]).sum() / buffer.durations[:size].sum()
    assert 2.9 < rate < 3.0
    assert buffer.mean_reward_rate == pytest.approx(rate)
    model.train(1, 8)
    # Half of 3 for 0.1 s, in the unit of the critics
    assert model._current_high_freq_penalty() == pytest.approx(0.5 * rate * 0.1 * buffer.reward_scale)
    assert model.logger.name_to_value["option/high_freq_penalty"] == model._current_high_freq_penalty()
    model.save(tmp_path / "model")
    assert CTCO.load(tmp_path / "model")._current_high_freq_penalty() == model._current_high_freq_penalty()


def test_before_anything_was_paid_a_relative_penalty_is_that_of_a_reward_of_one():
    env = gym.wrappers.TransformReward(gym.make("Pendulum-v1"), lambda r: 0.0)
    model = make(env, d_min=0.1, d_max=0.2, learning_starts=20, high_freq_penalty="relative_0.5").learn(30)
    model.train(1, 8)
    assert model._current_high_freq_penalty() == pytest.approx(0.5 * 0.1)


def test_a_relative_penalty_is_at_least_that_of_a_step():
    model = make(gym.make("Pendulum-v1"), d_min=0.0, learning_starts=20, high_freq_penalty="relative_0.1").learn(30)
    model.train(1, 8)
    assert model._current_high_freq_penalty() == pytest.approx(0.1 * model.replay_buffer.mean_reward_rate * 0.05)


def test_the_scale_that_was_found_stays(tmp_path, random_walk_env):
    model = make(random_walk_env(), replay_buffer_kwargs={"reward_scale": "auto"}, learning_starts=10)
    assert model.replay_buffer.reward_scale == "auto"
    model.learn(30).save(tmp_path / "model")
    found = model.replay_buffer.reward_scale
    assert found > 0
    resumed = CTCO.load(tmp_path / "model", env=random_walk_env())
    assert resumed.replay_buffer.reward_scale == found
    for given in ({}, {"reward_scale": found}, {"reward_scale": "auto"}, None):
        assert CTCO.load(tmp_path / "model", replay_buffer_kwargs=given).replay_buffer.reward_scale == found
    with pytest.raises(ValueError, match=r"reward_scale=2.0 cannot be changed while loading: .* reward_scale="):
        CTCO.load(tmp_path / "model", replay_buffer_kwargs={"reward_scale": 2.0})
    model.save_replay_buffer(tmp_path / "buffer")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert resumed.learn(30, reset_num_timesteps=False).replay_buffer.reward_scale == found


def test_a_loaded_buffer_has_the_algorithms_unit_and_discount(tmp_path, random_walk_env):
    make(random_walk_env()).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = make(random_walk_env(), replay_buffer_kwargs={"reward_scale": 7.0})
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.reward_scale == 7.0
    with pytest.raises(ValueError, match=r"discount_rate=0.40.*discount_rate=0.20.*the same gamma and gamma_dt"):
        make(random_walk_env(), gamma_dt=0.1).load_replay_buffer(tmp_path / "buffer")


@pytest.mark.parametrize("other", [{"gamma_dt": 0.1}, {"d_max": 0.7}, {"bounds": 1.0}, {"reward_unit": "impulse"}])
def test_a_buffer_that_is_refused_leaves_the_models_own(tmp_path, random_walk_env, other):
    env = random_walk_env()
    if "bounds" in other:
        env.action_space = spaces.Box(-other["bounds"], other["bounds"], (1,), np.float32)
    if "reward_unit" in other:
        env = OptionExecutionWrapper(env, reward_unit=other["reward_unit"])
    arguments = {name: value for name, value in other.items() if name in ("gamma_dt", "d_max")}
    make(env, **arguments).learn(30).save_replay_buffer(tmp_path / "buffer")
    (tmp_path / "stock").write_bytes(pickle.dumps(SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).replay_buffer))
    model = make(random_walk_env()).learn(40)
    own, size = model.replay_buffer, model.replay_buffer.size()
    for name, message in (
        ("buffer", "discount_rate=|d_max=|primitive_action_space=|reward_unit="),
        ("stock", "holds a ReplayB"),
    ):
        with pytest.raises(ValueError, match=message):
            model.load_replay_buffer(tmp_path / name)
    assert model.replay_buffer is own
    assert model.learn(20, reset_num_timesteps=False).replay_buffer.size() > size


def test_a_warm_up_that_somebody_else_played_updates_nothing(random_walk_env):
    env = TakeOverWrapper(random_walk_env(), lambda obs: np.zeros(1, np.float32), lambda trajectory: None)
    model = make(OptionExecutionWrapper(env), target_decision_rate=5.0).learn(60)
    assert (model.replay_buffer.size(), model.num_timesteps) == (0, 60)


def test_with_one_step_options_targets_and_losses_are_sacs():
    """n_rbf = 1 and d = dt, no penalty, entropy as log π, R in the unit of a step's reward: SAC's numbers."""
    kwargs = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 20, "seed": 0, "device": "cpu", "gamma": 0.97}
    sac = SAC("MlpPolicy", "Pendulum-v1", ent_coef=0.5, **kwargs).learn(60)
    options = {"n_rbf": 1, "d_min": 0.05, "d_max": 0.05, "n_sub_options": 0, "high_freq_penalty": 0.0}
    tau = discount_rate_from_gamma(0.97, 0.05)
    unit = {
        "replay_buffer_kwargs": {"reward_scale": 1 / step_weight(0.05, tau)},
        "gamma_dt": 0.05,
        "entropy_reference": "paper",
        "duration_scale": "linear",
    }
    model = CTCO("MlpPolicy", "Pendulum-v1", ent_coef=0.5, **options, **unit, **kwargs).learn(60)
    copy_weights(sac, model)
    # The same experience: an option is a normalised action and a duration; its R is in reward × s.
    data = sac.replay_buffer.sample(32)
    as_option = lambda action: th.cat((action, th.zeros(len(action), 1)), dim=1)  # noqa: E731
    as_log_prob = lambda log_prob: th.stack((log_prob, th.zeros(len(log_prob))), dim=1)  # noqa: E731
    r = data.rewards * step_weight(0.05, model.discount_rate) * model.replay_buffer.reward_scale
    option_data = data._replace(actions=as_option(data.actions), rewards=r, discounts=th.full((32, 1), 0.97))

    with th.no_grad():
        next_actions, next_log_prob = sac.actor.action_log_prob(data.next_observations)
        # Lines of SAC.train, Stable-Baselines3 2.9
        next_q_values = th.cat(sac.critic_target(data.next_observations, next_actions), dim=1).amin(dim=1, keepdim=True)
        expected = data.rewards + (1 - data.dones) * 0.97 * (next_q_values - 0.5 * next_log_prob[:, None])
        values = model.critic_target(data.next_observations, as_option(next_actions))
        targets = model._targets(option_data, values, model.entropy_costs(as_log_prob(next_log_prob)))
    th.testing.assert_close(targets, expected, rtol=1e-6, atol=1e-6)
    critics_loss = 0.5 * sum(th.nn.functional.mse_loss(q, expected) for q in sac.critic(data.observations, data.actions))
    found = critic_loss(model.critic(data.observations, option_data.actions), targets)
    th.testing.assert_close(found, critics_loss, rtol=1e-6, atol=1e-6)
    actions, log_prob = sac.actor.action_log_prob(data.observations)
    q_min = th.cat(sac.critic(data.observations, actions), dim=1).amin(dim=1, keepdim=True)
    found = model._actor_loss(data.observations, (as_option(actions), as_log_prob(log_prob)))
    th.testing.assert_close(found, (0.5 * log_prob[:, None] - q_min).mean(), rtol=1e-6, atol=1e-6)
    mean, log_std, _ = sac.actor.get_action_dist_params(data.observations)
    for found, one in zip(model.actor.distribution_parameters(data.observations), (mean, log_std), strict=True):
        th.testing.assert_close(found[:, :1], one, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("target_actor", [True, False])
def test_targets_sample_the_target_actor_or_as_sac_s_the_actor(tmp_path, random_walk_env, target_actor):
    model = make(random_walk_env(), policy_kwargs={"net_arch": [8], "target_actor": target_actor}).learn(100)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy.pt")
    loaded = CTCO.load(tmp_path / "model")
    data = model.replay_buffer.sample(32)
    for one in (model, loaded):
        assert (one.actor_target is one.actor) == (one.policy.actor_target is one.policy.actor) == (not target_actor)
        with th.no_grad():
            one.actor.omega_head.bias.add_(1.0)  # which a target does not follow before the next update
            th.manual_seed(0)
            targets = one._critic_targets(data)
            actor = one.policy.actor_target if target_actor else one.policy.actor
            th.manual_seed(0)
            options, log_prob = actor.option_log_prob(data.next_observations)
            q_values = one.critic_target(data.next_observations, one._as_critics_see(options))
            expected = one._targets(data, q_values, one.entropy_costs(log_prob @ one._parts))
        th.testing.assert_close(targets, expected, rtol=0, atol=0)
    policy = CTCOPolicy.load(tmp_path / "policy.pt")
    assert (policy.actor_target is policy.actor) == (not target_actor)
    assert all(p.requires_grad for p in policy.actor.parameters())


@th.no_grad()
def copy_weights(sac, model):
    """SAC's networks of one hidden layer as CTCO's; a fixed duration has no part in values."""
    for source, target in ((sac.critic, model.critic), (sac.critic_target, model.critic_target)):
        for i, network in enumerate((source.qf0, source.qf1)):
            for layer in (0, 2):
                weight = network[layer].weight.T
                target.q_networks[layer].weight[i].zero_()
                target.q_networks[layer].weight[i][: len(weight)] = weight
                target.q_networks[layer].bias[i] = network[layer].bias
    model.actor.latent_pi.load_state_dict(sac.actor.latent_pi.state_dict())
    for layer, rows in ((sac.actor.mu, slice(1)), (sac.actor.log_std, slice(1, None))):
        model.actor.omega_head.weight[rows], model.actor.omega_head.bias[rows] = layer.weight, layer.bias


class StaleOptionsEnv(gym.Env):
    """What an option plays gets stale: it pays the rate 1 − (time since it began), whatever the action."""

    dt = 0.02
    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    _obs = np.zeros(1, dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._time = 0.0
        return self._obs, {}

    def step_sequence(self, actions):
        ages = self.dt * np.arange(len(actions))
        self._time += self.dt * len(actions)
        return self._obs, 1.0 - ages, False, self._time >= 20.0, {}


def penalty_of(decision_rate, discount_rate=DEFAULT_DISCOUNT_RATE):
    """β_h with which StaleOptionsEnv's best options are ``1/decision_rate`` long.

    V(d) = (R(d) − β)/(1 − e^(−τd)) is largest where β = R − R'(1 − e^(−τd))/(τe^(−τd)); with R = w − K,
    w = (1 − e^(−τd))/τ, K = ∫κe^(−τκ) dκ = (1 − e^(−τd)(1 + τd))/τ² and R' = e^(−τd)(1 − d), that is d·w − K.
    """
    d, rate = 1.0 / decision_rate, discount_rate
    w = (1 - math.exp(-rate * d)) / rate
    return d * w - (1 - math.exp(-rate * d) * (1 + rate * d)) / rate**2


@pytest.mark.slow
@pytest.mark.parametrize("decision_rate", [2.0, 5.0])
def test_the_penalty_is_found_that_keeps_a_decision_rate(decision_rate):
    assert penalty_of(2.0) == pytest.approx(0.5 * 0.5**2, rel=0.1)  # ½d² without discounting
    model = make(
        StaleOptionsEnv(),
        target_decision_rate=decision_rate,
        high_freq_penalty=0.05,
        d_max=1.0,
        n_rbf=1,
        learning_rate=3e-3,
        tau=0.02,
        batch_size=64,
        ent_coef=0.001,
        updates_per_second=10,
        policy_kwargs={"net_arch": [32]},
    )
    penalties, rates = [], []

    def record(local_variables, global_variables):
        penalties.append(model._current_high_freq_penalty())
        rates.append((model.replay_buffer.n_decisions, model.replay_buffer.decision_seconds))
        return True

    model.learn(round(600 / model.get_env().envs[0].unwrapped.dt), callback=record)
    half = len(rates) // 2
    decisions, seconds = np.subtract(rates[-1], rates[half])
    assert decisions / seconds == pytest.approx(decision_rate, rel=0.1)
    assert np.mean(penalties[half:]) == pytest.approx(penalty_of(decision_rate), rel=0.2)


def test_a_relative_penalty_may_be_found():
    model = make(StaleOptionsEnv(), target_decision_rate=3.0, learning_rate=0.01, high_freq_penalty="relative_0.5").learn(200)
    coefficient = math.exp(model.log_high_freq_penalty.item())
    assert coefficient != pytest.approx(0.5)
    assert model._current_high_freq_penalty() == pytest.approx(coefficient * model._penalty_unit)
    assert model._penalty_unit > 0


def test_a_decision_rate_is_kept_from_above_only():
    """While options are longer than they need be, the penalty falls, and it never pays to be slower still."""
    model = make(StaleOptionsEnv(), target_decision_rate=1000.0, learning_rate=0.01, high_freq_penalty=0.05).learn(200)
    falling = model._current_high_freq_penalty()
    assert 0.0 < falling < 0.05
    model.target_decision_rate = 0.1
    model.learn(2000, reset_num_timesteps=False)
    assert model._current_high_freq_penalty() > falling


def test_target_entropies_may_be_schedules(random_walk_env):
    # 3 at the beginning, −3 in the end, of two weights and d
    model = make(random_walk_env(), target_entropy=lambda remaining: 6 * remaining - 3)
    assert model._target_entropies.tolist() == [1.0, 1.0, 1.0]
    model.learn(200)
    model._current_progress_remaining = 0.25
    model.train(1, 8)
    assert model._target_entropies.tolist() == [-0.5, -0.5, -0.5]
    with pytest.raises(ValueError, match="target_entropy must be a number, a function of the remaining progress or 'auto'"):
        make(random_walk_env(), target_entropy="car")


def test_the_paper_s_algorithm():
    model = CTCO("MlpPolicy", "Pendulum-v1", **CTCO.paper_defaults(), device="cpu", seed=0, learning_starts=50).learn(100)
    assert model.critic.n_critics == 1
    assert [p.shape for p in model.critic.q_networks[2].parameters()] == [(1, 64, 64), (1, 1, 64)]
    assert model._current_high_freq_penalty() == 0.05
    assert model.replay_buffer.size() == model.replay_buffer.n_decisions  # and no sub-options
    th.testing.assert_close(model._log_reference[0], th.tensor(0.0))


def test_the_found_penalty_is_logged_saved_and_loaded(tmp_path):
    model = make(StaleOptionsEnv(), target_decision_rate=3.0, learning_rate=0.01, high_freq_penalty=0.05).learn(200)
    assert model.logger.name_to_value["option/high_freq_penalty"] == pytest.approx(
        model._current_high_freq_penalty(), rel=0.05
    )
    model.save(tmp_path / "model")
    loaded = CTCO.load(tmp_path / "model", env=StaleOptionsEnv(), device="cpu")
    assert loaded._current_high_freq_penalty() == model._current_high_freq_penalty() != 0.05
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded._current_high_freq_penalty() != model._current_high_freq_penalty()


def random_walk_like(action_dim=1):
    """Pendulum's shape is as good as any."""

    class Env(gym.Env):
        dt = 0.1
        observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    return Env()


# --- one update


def batch_of(model, n=16):
    th.manual_seed(3)
    batch = model.replay_buffer.sample(n)
    model.replay_buffer.sample = lambda *args, **kwargs: batch
    return batch


def test_pessimism_by_hand():
    """Options of γ = 0.9 and 0.7: shares of 0.1 and 0.3, a half and one and a half of their mean."""
    q_values, discounts = th.tensor([[[1.0], [5.0]], [[3.0], [4.0]], [[2.0], [9.0]]]), th.tensor([[0.9], [0.7]])
    assert pessimistic_values(q_values, discounts, "decision").tolist() == [[1.0], [4.0]]
    by_time = pessimistic_values(q_values, discounts, "time")
    assert by_time.flatten().tolist() == pytest.approx([2.0 - 0.5 * 1.0, 6.0 - 1.5 * 2.0])
    # What one length of all options and one critic make no difference to
    alike = th.full((2, 1), 0.9)
    th.testing.assert_close(pessimistic_values(q_values, alike, "time"), pessimistic_values(q_values, alike, "decision"))
    th.testing.assert_close(pessimistic_values(q_values[:1], discounts, "time"), q_values[0])


def test_pessimism_by_time_costs_the_same_however_time_is_divided():
    """Critics that always differ take as much off ten short options as off five of twice the length, and not twice as much."""
    short, long = 0.99, 0.99**2
    q_values = th.tensor([[[1.0], [1.0]], [[-1.0], [-1.0]]])  # on average nothing
    discounts = th.tensor([[short], [long]])

    def value(gamma, once):
        return once * gamma * (1 - gamma**1000) / (1 - gamma)  # of γ·once + γ²·once + …

    by_decision = pessimistic_values(q_values, discounts, "decision").flatten().tolist()
    assert value(short, by_decision[0]) / value(long, by_decision[1]) == pytest.approx(2.0, rel=0.02)
    by_time = pessimistic_values(q_values, discounts, "time").flatten().tolist()
    assert value(short, by_time[0]) / value(long, by_time[1]) == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("critic_pessimism", ["decision", "time"])
@pytest.mark.parametrize("entropy_reference", ["average", "uniform"])
def test_one_update_by_hand(entropy_reference, critic_pessimism, random_walk_env):
    """The critic's loss that train logs, recomputed from the networks with β_h, γ(d) and both entropies."""
    model = make(
        random_walk_env(),
        learning_starts=1000,
        learning_rate=0.0,
        ent_coef=0.2,
        high_freq_penalty=0.05,
        trajectory="rbf",
        entropy_reference=entropy_reference,
        critic_pessimism=critic_pessimism,
    )
    set_temperature_of_d(model, 0.4)
    model.learn(200)

    def cost(log_prob):
        price = 0.2 * log_prob[:, :-1].sum(dim=1, keepdim=True) + 0.4 * log_prob[:, -1:]
        # The density of two weights and d that are uniform over [−1, 1] is 1/2 each.
        return price - (price.mean() if entropy_reference == "average" else (2 * 0.2 + 0.4) * math.log(0.5))

    # Let the targets differ from what they follow.
    with th.no_grad():
        for parameter in (*model.critic_target.parameters(), *model.actor_target.parameters()):
            parameter.add_(0.1 * th.randn_like(parameter))
    batch = batch_of(model)
    th.manual_seed(0)
    with th.no_grad():
        options, log_prob = model.actor.option_log_prob(batch.observations)
        next_options, next_log_prob = model.actor_target.option_log_prob(batch.next_observations)
        one, two = model.critic_target(batch.next_observations, next_options)
        next_q = th.minimum(one, two)
        if critic_pessimism == "time":
            share = (1 - batch.discounts) / (1 - batch.discounts).mean()
            assert share.std() > 0.1
            next_q = (one + two) / 2 - share * (one - two).abs() / 2
        bootstrap = (1 - batch.dones) * batch.discounts * (next_q - cost(next_log_prob))
        target = batch.rewards - 0.05 + bootstrap
        q_values = model.critic(batch.observations, batch.actions)
        expected_critic = 0.5 * sum(((q - target) ** 2).mean() for q in q_values)
        expected_actor = (cost(log_prob) - model.critic(batch.observations, options).min(dim=0)[0]).mean()
    th.manual_seed(0)
    model.train(1, 16)
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(expected_critic.item(), rel=1e-5)
    assert model.logger.name_to_value["train/actor_loss"] == pytest.approx(expected_actor.item(), rel=1e-5)


def test_the_penalty_is_a_number_or_a_schedule_and_needs_no_new_data(random_walk_env):
    model = make(random_walk_env(), learning_starts=1000, learning_rate=0.0).learn(100)
    batch = batch_of(model)

    def loss(penalty):
        model.high_freq_penalty = penalty
        th.manual_seed(0)
        model.train(1, 16)
        return model.logger.name_to_value["train/critic_loss"], model.logger.name_to_value["option/high_freq_penalty"]

    none, _ = loss(0.0)
    one, logged = loss(1.0)
    assert logged == 1.0
    assert loss(lambda remaining: 1.0) == (one, 1.0)
    # A quadratic in β_h whose second derivative is the number of critics: ½Σ(q − y + β)²
    two, _ = loss(2.0)
    assert two - 2 * one + none == pytest.approx(2.0, rel=1e-4)
    assert len(batch.rewards) == 16


def test_polyak_and_the_step_size(random_walk_env):
    model = make(random_walk_env(), learning_starts=1000, tau=0.25, learning_rate=1e-2)
    model.learn(100)
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    model.train(1, 16)
    after = dict(model.policy.named_parameters())
    for name in before:
        if name.startswith("actor."):
            target = name.replace("actor.", "actor_target.", 1)
        elif name.startswith("critic."):
            target = name.replace("critic.", "critic_target.", 1)
        else:
            continue
        th.testing.assert_close(after[target], 0.75 * before[target] + 0.25 * after[name])
    # Adam's first step is its step size, a parameter.
    moved = lambda name: (after[name] - before[name]).abs().max().item()  # noqa: E731
    assert moved("actor.omega_head.bias") == pytest.approx(1e-2, rel=0.01)
    assert moved("actor.duration_head.bias") == pytest.approx(1e-2, rel=0.01)


def test_temperatures(random_walk_env):
    model = make(random_walk_env(), learning_starts=1000, ent_coef="auto_0.5", learning_rate=0.1)
    assert model.target_entropy == -3.0  # ω has two entries, and d is one more
    assert model._target_entropies.tolist() == [-1.0, -1.0, -1.0]
    model.learn(60)
    assert model.log_ent_coefs.detach().exp().tolist() == pytest.approx([0.5, 0.5, 0.5])
    model.train(1, 8)
    # A new policy is far more random than its target: its temperatures fall by Adam's first step.
    assert model.log_ent_coefs.detach().tolist() == pytest.approx([math.log(0.5) - 0.1] * 3, abs=1e-4)
    for ent_coef in (0, 0.0, 0.3):
        model = make(random_walk_env(), ent_coef=ent_coef).learn(60)
        assert model.ent_coefs.tolist() == pytest.approx([ent_coef] * 3)  # A number stays.
        assert all(th.isfinite(p).all() for p in model.policy.parameters())


@pytest.mark.parametrize("value", ["automatic", "auto_0", "auto_x", -0.1, math.nan])
def test_bad_temperatures(random_walk_env, value):
    with pytest.raises(ValueError, match="ent_coef must be a number of at least 0, 'auto', or"):
        make(random_walk_env(), ent_coef=value)


# --- the special case: with one basis function and d = dt, it is SAC


def test_options_of_one_step_are_sac(scripted_env):
    """Transitions, discounts and critic targets equal those of plain SAC with γ = e^(−τ·dt) and scaled rewards."""
    dt = 0.05
    make_env = lambda: scripted_env(  # noqa: E731
        rewards=lambda step, action: math.sin(step) + float(action[0]), dt=dt, truncate_at=30
    )
    model = make(
        make_env(),
        n_rbf=1,
        d_min=dt,
        d_max=dt,
        high_freq_penalty=0.0,
        entropy_reference="paper",
        duration_scale="linear",
        ent_coef=0.2,
        learning_starts=1000,
        learning_rate=0.0,
    )
    model.learn(100)
    buffer = model.replay_buffer
    assert buffer.pos == model.num_timesteps == 100

    # The same actions in the bare environment
    env, gamma = make_env(), math.exp(-DEFAULT_DISCOUNT_RATE * dt)
    assert gamma == pytest.approx(0.98)
    plain = ReplayBuffer(100, env.observation_space, env.action_space, device="cpu")
    obs, _ = env.reset()
    for i in range(100):
        action = buffer.actions[i, 0, :1]
        next_obs, reward, terminated, truncated, _ = env.step(action)
        scaled = reward * step_weight(dt, DEFAULT_DISCOUNT_RATE)
        done = terminated or truncated
        plain.add(obs, next_obs, action, np.array([scaled]), np.array([done]), [{"TimeLimit.truncated": truncated}])
        obs = env.reset()[0] if done else next_obs
    np.testing.assert_array_equal(buffer.observations[:100], plain.observations)
    np.testing.assert_array_equal(buffer.next_observations[:100], plain.next_observations)
    np.testing.assert_array_equal(buffer.dones[:100], plain.dones)
    np.testing.assert_array_equal(buffer.timeouts[:100], plain.timeouts)
    np.testing.assert_allclose(buffer.integrated_rewards[:100], plain.rewards, atol=1e-6)

    rows = np.arange(100)
    ours, theirs = buffer._get_samples(rows), plain._get_samples(rows)
    th.testing.assert_close(ours.discounts, th.full((100, 1), gamma), atol=1e-6, rtol=0)
    with th.no_grad():
        options, log_prob = model.actor_target.option_log_prob(ours.next_observations)
        next_q = model.critic_target(ours.next_observations, options).amin(dim=0)
        target = critic_target(
            ours.rewards, ours.dones, ours.discounts, next_q, model.entropy_costs(log_prob @ model._parts), 0.0
        )
        # SAC's target, with the tanh Gaussian of the action alone
        mean, log_std = model.actor_target.distribution_parameters(theirs.next_observations)
        action = options[:, :1].double()
        log_pi = Normal(mean[:, :1].double(), log_std[:, :1].double().exp()).log_prob(th.atanh(action)) - th.log(1 - action**2)
        sac = theirs.rewards + (1 - theirs.dones) * gamma * (next_q - 0.2 * log_pi)
    th.testing.assert_close(target.double(), sac, atol=2e-6, rtol=0)


# --- environments


def test_a_bare_environment_is_wrapped(random_walk_env):
    model = make(random_walk_env(), n_rbf=2, d_max=0.7, gamma=0.9, gamma_dt=0.1)
    settings = model.get_env().get_attr("option_space")[0]
    assert (settings.trajectory.n_weights, settings.d_max, settings.d_min, settings.dt) == (2, 0.7, 0.1, 0.1)
    assert settings.discount_rate == pytest.approx(-math.log(0.9) / 0.1)
    assert (model.dt, model.d_min) == (0.1, 0.1)
    assert model.action_space.shape == (3,)


def test_a_wrapped_environment_is_used_as_it_is(random_walk_env):
    env = OptionExecutionWrapper(random_walk_env(), n_rbf=2, d_min=0.2, reward_unit="impulse")
    model = make(env, n_rbf=2)
    assert model.get_env().envs[0] is env
    assert model.d_min == 0.2
    model.learn(40)
    # The Monitor that was missing stands inside, where it counts primitive steps.
    assert model.ep_info_buffer[0]["l"] == 20


def test_what_rewards_mean_is_kept(random_walk_env, tmp_path):
    make(OptionExecutionWrapper(random_walk_env(), reward_unit="impulse")).save(tmp_path / "model")
    model = CTCO.load(tmp_path / "model", random_walk_env(), device="cpu")
    assert model.get_env().get_attr("reward_unit") == ["impulse"]
    assert model.wrap_env(random_walk_env()).reward_unit == "impulse"
    assert model.replay_buffer.reward_unit == "impulse"
    with pytest.raises(ValueError, match=r"reward_unit='rate', CTCO learned from 'impulse'"):
        model.set_env(OptionExecutionWrapper(random_walk_env()))


def test_a_dt_that_the_wrapper_was_given_is_the_models(random_walk_env):
    """The environment says 0.1 s."""
    model = make(OptionExecutionWrapper(random_walk_env(), dt=0.05))
    assert model.wrap_env(random_walk_env()).option_space.dt == 0.05
    nonsense = random_walk_env()
    nonsense.dt = lambda: "later"
    assert OptionExecutionWrapper(nonsense, dt=0.05).option_space.dt == 0.05
    # What was found is found again.
    faster = random_walk_env()
    faster.dt = 0.05
    assert make(OptionExecutionWrapper(random_walk_env())).wrap_env(faster).option_space.dt == 0.05


@pytest.mark.parametrize(
    ("wrapper", "algorithm", "name"),
    [
        ({"n_rbf": 3}, {}, "n_rbf"),
        ({"d_max": 0.6}, {}, "d_max"),
        ({"d_min": 0.2}, {"d_min": 0.3}, "d_min"),
        ({}, {"dt": 0.2}, "dt"),
        ({"discount_rate": 0.1}, {}, "discount_rate"),
        ({}, {"gamma": 0.99}, "discount_rate"),
    ],
)
def test_disagreeing_settings_are_refused(random_walk_env, wrapper, algorithm, name):
    with pytest.raises(ValueError, match=f"options have {name}="):
        make(OptionExecutionWrapper(random_walk_env(), **wrapper), **algorithm)


def test_environments_that_disagree_among_themselves(random_walk_env):
    env = DummyVecEnv([lambda d=d: OptionExecutionWrapper(random_walk_env(), d_min=d) for d in (0.1, 0.2)])
    with pytest.raises(ValueError, match="d_min"):
        make(env)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_several_wrapped_environments(vec_env_cls, random_walk_env):
    env = make_vec_env(random_walk_env, n_envs=2, wrapper_class=OptionExecutionWrapper, vec_env_cls=vec_env_cls, seed=0)
    model = make(env).learn(120)
    assert model.n_envs == 2
    assert model._n_updates > 0
    env.close()


def test_a_vec_env_of_bare_environments_is_refused(random_walk_env):
    with pytest.raises(ValueError, match="wrapper_class=OptionExecutionWrapper"):
        make(make_vec_env(random_walk_env, n_envs=2))


@pytest.mark.parametrize("kind", ["image", "dict"])
@pytest.mark.parametrize("share", [False, True])
def test_images_and_dictionaries_are_trained(random_walk_env, kind, share):
    model = CTCO(
        {"image": "CnnPolicy", "dict": "MultiInputPolicy"}[kind],
        random_walk_env(kind),
        policy_kwargs={"net_arch": [8], "share_features_extractor": share},
        buffer_size=200,
        batch_size=8,
        learning_starts=20,
        gradient_steps=1,
        seed=0,
    )
    before = [p.clone() for p in model.actor.parameters()]
    model.learn(60)
    assert isinstance(model.replay_buffer, DictOptionReplayBuffer if kind == "dict" else OptionReplayBuffer)
    assert any(not th.equal(p, q) for p, q in zip(before, model.actor.parameters(), strict=True))
    option, _ = model.predict(model.get_env().reset())
    assert option.shape == (1, 3)


def test_vec_normalize(random_walk_env):
    bare = make_vec_env(random_walk_env, wrapper_class=OptionExecutionWrapper)
    with pytest.raises(ValueError, match="norm_reward=False"):
        make(VecNormalize(bare))
    model = make(VecNormalize(bare, norm_reward=False)).learn(80)
    sample = model.replay_buffer.sample(32, env=model.get_vec_normalize_env())
    assert sample.observations.abs().max() > model.replay_buffer.sample(32).observations.abs().max()


def test_action_noise(random_walk_env):
    noise = NormalActionNoise(10 * np.ones(3), np.zeros(3))
    model = make(random_walk_env(), action_noise=noise, learning_starts=0).learn(60)
    np.testing.assert_array_equal(model.replay_buffer.actions[: model.replay_buffer.size()], 1.0)


# --- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"d_max": 0.0}, "d_max"),
        ({"d_max": -1.0}, "d_max"),
        ({"d_min": 2.0}, "d_min"),
        ({"n_rbf": 0}, "n_rbf"),
        ({"gamma": 0.0}, "gamma"),
        ({"gamma": 1.5}, "gamma"),
        ({"gamma_dt": 0.0}, "gamma_dt"),
        ({"entropy_reference": "gaussian"}, "entropy_reference"),
        ({"critic_pessimism": "step"}, r"critic_pessimism must be one of \('decision', 'time'\), not 'step'"),
        ({"critic_pessimism": "time", "gamma": 1.0}, "gamma=1 has none"),
        ({"target_decision_rate": 0.0}, "target_decision_rate must be a positive number of Hz"),
        (
            {"target_decision_rate": 2.0, "d_max": 0.5},
            r"target_decision_rate=2.0 Hz is out of reach .* d_max=0.5 s",
        ),
        ({"target_decision_rate": 5.0, "high_freq_penalty": 0.0}, "high_freq_penalty=0.0 must be a positive number"),
        ({"target_decision_rate": 5.0, "high_freq_penalty": "relative_0"}, "high_freq_penalty=relative_0 must be a positive"),
        ({"high_freq_penalty": "auto"}, "'relative_<number of at least 0>', such as 'relative_0.1', not 'auto'"),
        ({"high_freq_penalty": "relative_-1"}, "not 'relative_-1'"),
        ({"high_freq_penalty": "relative_inf"}, "not 'relative_inf'"),
        ({"high_freq_penalty": "relative_a"}, "not 'relative_a'"),
        ({"replay_buffer_class": ReplayBuffer}, "OptionReplayBuffer"),
        ({"replay_buffer_kwargs": {"optimize_memory_usage": True}}, "optimize_memory_usage"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics"),
        ({"policy_kwargs": {"use_sde": True}}, "State-Dependent"),
    ],
)
def test_bad_settings(random_walk_env, kwargs, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(random_walk_env(), **kwargs)


def test_bad_action_spaces(scripted_env):
    with pytest.raises(TypeError, match="Box action space"):
        make(scripted_env(action_space=spaces.Discrete(2)))
    with pytest.raises(ValueError, match="finite action bounds"):
        make(scripted_env(action_space=spaces.Box(-np.inf, np.inf, (1,))))
    with pytest.raises(ValueError, match="pass dt"):
        make(scripted_env(dt=None))
    assert make(scripted_env(dt=None), dt=0.4).dt == 0.4


@pytest.mark.parametrize("bad", ["nan reward", "inf reward", "nan observation", "error"])
def test_a_bad_environment_leaves_no_trace_in_the_buffer(scripted_env, bad):
    class Env(scripted_env):
        broken = True

        def step(self, action):
            obs, reward, terminated, truncated, info = super().step(action)
            if self.count == 15 and self.broken:
                if bad == "error":
                    raise RuntimeError("the motor is hot")
                if bad == "nan observation":
                    obs = obs * np.nan
                else:
                    reward = float(bad.split()[0])
            return obs, reward, terminated, truncated, info

    env = Env(truncate_at=20)
    model = make(env, d_min=0.5, d_max=0.5, learning_starts=1000)  # so that an option ends at the broken step
    with pytest.raises((RuntimeError, ValueError), match=r"the motor is hot|not finite"):
        model.learn(100)
    buffer = model.replay_buffer
    stored = buffer.pos
    # Everything before the broken option, nothing of it.
    np.testing.assert_array_equal(buffer.next_observations[: stored - 1], buffer.observations[1:stored])
    assert 0 < buffer.next_observations[stored - 1, 0, 0] < 15
    assert (buffer.durations[stored:] == 0).all()
    # Repaired, learning goes on from a reset: no transition spans the break.
    env.broken = False
    model.learn(10, reset_num_timesteps=False)
    assert buffer.observations[stored, 0, 0] == 0


# --- save and load


def test_save_and_load(tmp_path, random_walk_env):
    model = make(random_walk_env(), n_rbf=2, d_max=0.7, d_min=0.2, ent_coef=0.1).learn(60)
    model.save(tmp_path / "model")
    obs = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    expected, _ = model.predict(obs, deterministic=True)

    alone = CTCO.load(tmp_path / "model")
    np.testing.assert_array_equal(alone.predict(obs, deterministic=True)[0], expected)
    assert (alone.dt, alone.d_min, alone.d_max, alone.n_rbf) == (0.1, 0.2, 0.7, 2)
    alone.set_env(random_walk_env())
    alone.learn(30)

    bare = CTCO.load(tmp_path / "model", env=random_walk_env())
    np.testing.assert_array_equal(bare.predict(obs, deterministic=True)[0], expected)
    assert bare.get_env().get_attr("option_space")[0].d_max == 0.7

    wrapped = OptionExecutionWrapper(random_walk_env(), n_rbf=2, d_max=0.7, d_min=0.2)
    CTCO.load(tmp_path / "model", env=wrapped).learn(30)
    two = make_vec_env(
        random_walk_env,
        n_envs=2,
        wrapper_class=OptionExecutionWrapper,
        wrapper_kwargs={"n_rbf": 2, "d_max": 0.7, "d_min": 0.2},
    )
    assert CTCO.load(tmp_path / "model", env=two).learn(30).n_envs == 2

    for other in ({"n_rbf": 2, "d_max": 0.6, "d_min": 0.2}, {"n_rbf": 2, "d_max": 0.7}):
        with pytest.raises(ValueError, match="options have d_m"):
            CTCO.load(tmp_path / "model", env=OptionExecutionWrapper(random_walk_env(), **other))
        with pytest.raises(ValueError, match="options have d_m"):
            alone.set_env(OptionExecutionWrapper(random_walk_env(), **other))
    faster = random_walk_env()
    faster.dt = 0.05
    with pytest.raises(ValueError, match=r"options have dt=0\.05"):
        CTCO.load(tmp_path / "model", env=faster)
    # On purpose, the same policy runs at another rate.
    assert CTCO.load(tmp_path / "model", env=faster, dt=0.05).learn(30).num_timesteps >= 30


def test_everything_that_is_learned_is_saved(tmp_path, random_walk_env):
    model = make(random_walk_env(), learning_rate=1e-2).learn(60)
    model.save(tmp_path / "model")
    loaded = CTCO.load(tmp_path / "model", env=random_walk_env())
    for name, value in model.policy.state_dict().items():
        th.testing.assert_close(loaded.policy.state_dict()[name], value)
    th.testing.assert_close(loaded.log_ent_coefs.detach(), model.log_ent_coefs.detach())
    assert (loaded.log_ent_coefs.detach() != 0).all()
    for one, other in (
        (loaded.actor.optimizer, model.actor.optimizer),
        (loaded.critic.optimizer, model.critic.optimizer),
        (loaded.ent_coef_optimizer, model.ent_coef_optimizer),
    ):
        for left, right in zip(one.state_dict()["state"].values(), other.state_dict()["state"].values(), strict=True):
            th.testing.assert_close(left["exp_avg"], right["exp_avg"])
            assert left["step"] == right["step"] > 0
    # Learning moves what was loaded: temperatures and networks are those that the optimizers hold.
    before = loaded.log_ent_coefs.detach().clone()
    loaded.learn(40)
    assert not th.equal(loaded.log_ent_coefs.detach(), before)


def test_training_continues_from_a_saved_model_and_buffer(tmp_path, random_walk_env):
    model = make(random_walk_env()).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CTCO.load(tmp_path / "model", env=random_walk_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    stored = loaded.replay_buffer.pos
    assert stored == model.replay_buffer.pos
    updates = loaded._n_updates
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps >= model.num_timesteps + 40
    assert loaded.replay_buffer.pos > stored
    assert loaded._n_updates > updates
    # The policy alone
    model.policy.save(tmp_path / "policy")
    policy = CTCOPolicy.load(tmp_path / "policy")
    obs = np.zeros((1, 2), dtype=np.float32)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_same_seed_same_result(random_walk_env):
    def run(seed):
        model = make(random_walk_env(), seed=seed).learn(120)
        return th.cat([p.detach().ravel() for p in model.policy.parameters()])

    first = run(1)
    assert th.equal(first, run(1))
    assert not th.equal(first, run(2))


# --- networks


def test_ensemble_linear_is_several_linear_layers():
    th.manual_seed(0)
    layer = EnsembleLinear(3, 4, 5)
    x = th.randn(3, 7, 4)
    out = layer(x)
    assert out.shape == (3, 7, 5)
    for i in range(3):
        th.testing.assert_close(out[i], x[i] @ layer.weight[i] + layer.bias[i])
    assert layer.weight.abs().max() <= 0.5  # 1/√4, as nn.Linear
    assert layer.weight.std().item() == pytest.approx(0.5 / math.sqrt(3), rel=0.2)


def test_one_critic_on_request(random_walk_env):
    model = make(random_walk_env(), policy_kwargs={"net_arch": [8], "n_critics": 1}).learn(40)
    assert model.critic(th.zeros(5, 2), th.zeros(5, 3)).shape == (1, 5, 1)


def test_greedy_options_are_the_means(random_walk_env):
    model = make(random_walk_env())
    obs = np.array([[0.3, 0.1]], dtype=np.float32)
    mean = model.actor.distribution_parameters(th.as_tensor(obs))[0][0].detach().numpy()
    expected = np.append(np.tanh(mean[:-1]), 2 / (1 + math.exp(-mean[-1])) - 1)
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0][0].vector, expected, rtol=1e-5)
    assert not np.allclose(model.predict(obs)[0], model.predict(obs)[0])


def test_docstrings_run():
    import doctest

    import sb3_ctco.wrappers.option_execution as module

    result = doctest.testmod(module)
    assert result.attempted > 3
    assert result.failed == 0


def test_training_mode_is_that_of_the_networks() -> None:
    model = CTCO("MlpPolicy", "Pendulum-v1", d_max=0.5)
    for training in (True, True, False, False, True):
        model.policy.set_training_mode(training)
        assert model.actor.training is model.critic.training is training
        assert not model.actor_target.training
    model.predict(np.zeros(3))
    assert not model.actor.training


# --- at the edges


@pytest.mark.parametrize("number", [np.float32, np.float64, np.int64])
def test_numbers_may_be_numpys(number, random_walk_env):
    """As they come of ``np.prod``, ``np.linspace`` or a search for hyperparameters."""
    short = {"learning_starts": 5, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    model = CTCO(
        "MlpPolicy",
        random_walk_env(),
        high_freq_penalty=number(1),
        target_decision_rate=number(4),
        target_entropy=-number(2),
        replay_buffer_kwargs={"reward_scale": number(2)},
        **short,
    )
    assert model.learn(30)._n_updates > 0
    entropies = {"target_entropy": -number(1), "duration_target_entropy": number(1)}
    assert FiGARSAC("MlpPolicy", random_walk_env(), **entropies, **short).learn(20)._n_updates > 0
    Safety(max_rate=number(3))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_learned_with_is_finite(value, random_walk_env):
    with pytest.raises(ValueError, match="target_entropy must be a number"):
        CTCO("MlpPolicy", random_walk_env(), target_entropy=value)
    model = CTCO("MlpPolicy", random_walk_env(), learning_starts=5, high_freq_penalty=lambda remaining: value)
    with pytest.raises(ValueError, match=f"high_freq_penalty returned {value}"):
        model.learn(30)


def test_an_eval_callback_within_another(random_walk_env):
    inner = EvalCallback(random_walk_env(), n_eval_episodes=1, eval_freq=1)
    outer = EvalCallback(random_walk_env(), n_eval_episodes=1, callback_on_new_best=inner, eval_freq=20)
    CTCO("MlpPolicy", random_walk_env(), learning_starts=999).learn(60, callback=outer)
    assert np.isfinite(inner.last_mean_reward)


def test_stock_sac_with_the_option_buffer_refuses_rewards_that_are_normalised(random_walk_env):
    env = VecNormalize(DummyVecEnv([lambda: OptionExecutionWrapper(random_walk_env())]))
    model = SAC("MlpPolicy", env, replay_buffer_class=OptionReplayBuffer, learning_starts=10, batch_size=8)
    with pytest.raises(ValueError, match="pass norm_reward=False"):
        model.learn(100)
