"""Options that end before their plan does: by the critics, by a rule, or after some time."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_ctco import CTCO, FiGARSAC, OptionController, OptionExecutionWrapper
from sb3_ctco.interruption import CriticInterrupt
from sb3_ctco.options import JOINS, PLAYED, OptionSpace, ValueInterrupt
from sb3_ctco.vec_env import AsyncOptionVecEnv
from sb3_ctco.wrappers import RealTimeOptionWrapper

DT = 0.1
# With one weight an option is [action, duration]; durations run from 0.1 s (−1) to 1 s (1).
SETTINGS = {"n_rbf": 1, "d_max": 1.0, "duration_scale": "linear"}
SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "device": "cpu", "seed": 0, "buffer_size": 2000}


class Scripted:
    """A ValueInterrupt that ends options at the checks that it is told, and remembers what it was asked."""

    def __init__(self, check_period, *answers):
        self.check_period = check_period
        self.answers = list(answers)
        self.asked = []

    def worth_ending(self, observations, rests):
        self.asked.append((observations, rests))
        return np.array([self.answers.pop(0) if self.answers else False for _ in rests])


def model_for(env, **kwargs):
    """A CTCO whose greedy option is [0.5, the longest], and whose critics say what a test tells them."""
    model = CTCO("MlpPolicy", env, **{**SMALL, **SETTINGS, "high_freq_penalty": 0.125, **kwargs})
    with th.no_grad():
        for head, value in ((model.actor.omega_head, float(np.arctanh(0.5))), (model.actor.duration_head, 40.0)):
            head.weight.zero_()
            head.bias.fill_(value)
    return model


# --- what the critics say


@pytest.fixture
def toy(scripted_env):
    """Critics to whom the value is the number of steps so far times the action; the second one doubles it."""
    model = model_for(scripted_env())
    model.critic = lambda obs, options: th.stack([scale * obs[:, :1] * options[:, :1] for scale in (1.0, 2.0)])
    return model


def test_worth_ending_by_hand(toy):
    interrupt = CriticInterrupt(toy, check_period=0.2)
    assert isinstance(interrupt, ValueInterrupt)
    observations = np.array([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]], np.float32)
    rests = np.array([[0.25, 0.0], [0.5, 0.0], [0.25, 0.0], [0.75, 0.0]], np.float32)
    # The greedy action is 0.5, so the first critic's gains are 0.25, 0, −0.25 and 0.25, and β_h is 0.125.
    np.testing.assert_array_equal(interrupt.worth_ending(observations, rests), [True, False, False, True])
    interrupt.margin = 0.25
    assert not interrupt.worth_ending(observations, rests).any()


def test_every_critic_must_say_so(toy):
    toy.critic = lambda obs, options: th.stack([options[:, :1], -0.1 * options[:, :1]])
    interrupt = CriticInterrupt(toy, check_period=0.2, margin=-0.125)
    assert not interrupt.worth_ending(np.zeros((1, 2), np.float32), np.array([[-1.0, 0.0]], np.float32))[0]


def test_beta_is_the_price_that_learning_has_come_to(toy):
    interrupt, observation = CriticInterrupt(toy, check_period=0.2), np.array([[1.0, 0.0]], np.float32)
    rest = np.array([[0.25, 0.0]], np.float32)
    assert interrupt.worth_ending(observation, rest)[0]
    toy.high_freq_penalty = 0.26
    assert not interrupt.worth_ending(observation, rest)[0]


@pytest.mark.parametrize("kind", ["image", "dict"])
def test_other_observations(random_walk_env, kind):
    env = random_walk_env(kind)
    policy = {"image": "CnnPolicy", "dict": "MultiInputPolicy"}[kind]
    model = CTCO(policy, env, **SMALL, **SETTINGS)
    observations = [env.reset(seed=seed)[0] for seed in range(3)]
    stacked = (
        {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
        if kind == "dict"
        else np.stack(observations)
    )
    rests = np.zeros((3, 2), np.float32)
    assert CriticInterrupt(model, 0.1, margin=-100.0).worth_ending(stacked, rests).all()
    assert not CriticInterrupt(model, 0.1, margin=100.0).worth_ending(stacked, rests).any()


def test_bad_arguments(toy, random_walk_env):
    for arguments, message in (((0.0,), "check_period must be a positive"), ((0.1, np.nan), "margin must be a finite")):
        with pytest.raises(ValueError, match=message):
            CriticInterrupt(toy, *arguments)
    with pytest.raises(TypeError, match="CTCO's, not FiGARSAC's"):
        CriticInterrupt(FiGARSAC("MlpPolicy", random_walk_env(), **SMALL), 0.1)
    with pytest.raises(TypeError, match=r"to follow a rule of your own, call decide_anew\(\)"):
        OptionController(toy, interrupt=lambda *_: True)
    for period in (0, np.inf):
        with pytest.raises(ValueError, match=f"replan_period must be a positive number of seconds, not {period}"):
            OptionController(toy, replan_period=period)
    with pytest.raises(ValueError, match="decided on already with decide_ahead"):
        RealTimeOptionWrapper(random_walk_env(), decide_ahead=0.1, interrupt=Scripted(0.2), **SETTINGS)


# --- in the wrapper


def test_the_wrapper_asks_every_period_about_the_rest(scripted_env):
    interrupt = Scripted(0.3, False, True)
    env = RealTimeOptionWrapper(scripted_env(), interrupt=interrupt, **SETTINGS)
    env.reset()
    _, _, _, _, info = env.step([0.5, 1.0])
    assert info["option"]["n_steps"] == 6
    assert info["interrupted"]
    # Asked after three steps about seven, and after six about four
    np.testing.assert_allclose([obs[0, 0] for obs, _ in interrupt.asked], [3, 6])
    np.testing.assert_allclose(
        [rests[0] for _, rests in interrupt.asked], [[0.5, 2 * 0.6 / 0.9 - 1], [0.5, 2 * 0.3 / 0.9 - 1]]
    )
    np.testing.assert_allclose(info[PLAYED], [0.5, 2 * 0.5 / 0.9 - 1], atol=1e-6)
    # The next one is asked about from its own beginning, and not when too little is left.
    env.step([0.5, -0.3])
    assert len(interrupt.asked) == 3
    assert interrupt.asked[-1][0][0, 0] == 9


def test_what_is_shorter_than_any_option_stays_the_beginning_of_the_one_that_was_asked_for(scripted_env):
    env = RealTimeOptionWrapper(scripted_env(), interrupt=lambda *_: True, **SETTINGS, n_sub_options=0, d_min=0.35)
    env.reset()
    _, _, _, _, info = env.step([0.5, 1.0])
    assert info["option"]["n_steps"] == 1
    assert PLAYED not in info


@pytest.mark.parametrize("join", JOINS)
def test_what_ran_of_an_option_is_one_that_plays_the_same(scripted_env, join):
    """By a rule about observations as well; with Bézier curves exactly."""
    settings = {"n_rbf": 3, "d_max": 1.0, "trajectory": "bezier", "join": join}
    env = RealTimeOptionWrapper(scripted_env(), interrupt=lambda decided_on, obs, seconds: seconds > 0.55, **settings)
    env.action_space.seed(0)
    env.reset()
    for _ in range(5):
        option = env.action_space.sample()
        option[-1] = 1.0
        before = env._before
        obs, _, _, _, info = env.step(option)
        assert info["option"]["n_steps"] == 6
        again = env.option_space.plan(info[PLAYED].astype(np.float64), before)
        np.testing.assert_allclose(again, env.played, atol=1e-5)
        if join != "free":
            assert obs[2] == pytest.approx(env.played[-1, 0], abs=1e-6)


def test_what_ran_is_what_is_learned_from(random_walk_env):
    env = RealTimeOptionWrapper(random_walk_env(), interrupt=lambda decided_on, obs, seconds: seconds > 0.25, **SETTINGS)
    model = CTCO("MlpPolicy", env, n_sub_options=0, learning_starts=20, **SMALL, **SETTINGS).learn(200)
    rows = slice(0, model.replay_buffer.pos)
    actions, durations = model.replay_buffer.actions[rows, 0], model.replay_buffer.durations[rows, 0]
    ended = model.replay_buffer.dones[rows, 0] == 1
    assert durations.max() == pytest.approx(0.3)
    asked = [model.option_space.decode(option)[1] * 0.1 for option in actions[~ended].astype(np.float64)]
    np.testing.assert_allclose(asked, durations[~ended], rtol=1e-5)


def test_several_environments_at_once(random_walk_env):
    kwargs = {"interrupt": lambda decided_on, obs, seconds: seconds > 0.25, **SETTINGS}
    env = make_vec_env(
        random_walk_env, 2, wrapper_class=RealTimeOptionWrapper, wrapper_kwargs=kwargs, vec_env_cls=AsyncOptionVecEnv, seed=0
    )
    model = CTCO("MlpPolicy", env, n_sub_options=0, learning_starts=1000, **SMALL, **SETTINGS).learn(100)
    rows = slice(0, model.replay_buffer.pos)
    running = model.replay_buffer.dones[rows, 0] == 0
    asked = [model.option_space.decode(o)[1] * 0.1 for o in model.replay_buffer.actions[rows, 0][running].astype(np.float64)]
    np.testing.assert_allclose(asked, model.replay_buffer.durations[rows, 0][running], rtol=1e-5)
    env.close()


def test_critics_end_options_while_they_learn(random_walk_env):
    env = RealTimeOptionWrapper(random_walk_env(), **SETTINGS)
    model = CTCO("MlpPolicy", env, n_sub_options=0, learning_starts=20, **SMALL, **SETTINGS)
    env.interrupt = CriticInterrupt(model, check_period=0.1, margin=-100.0)
    model.learn(60)
    assert (model.replay_buffer.durations[: model.replay_buffer.pos] < 0.11).all()
    env.interrupt = CriticInterrupt(model, check_period=0.1, margin=100.0)
    model.learn(200, reset_num_timesteps=False)
    assert model.replay_buffer.durations.max() > 0.5


# --- in the controller


@pytest.mark.parametrize("clock", [False, True])
@pytest.mark.parametrize("join", JOINS)
def test_the_controller_ends_what_the_wrapper_ends(scripted_env, join, clock):
    settings = {**SETTINGS, "n_rbf": 2, "join": join}
    answers = (False, True, True, False, False, True)
    model = model_for(scripted_env(), **settings)
    # Two and a half steps are rounded up by both.
    there, here = Scripted(0.25, *answers), Scripted(0.25, *answers)
    env = RealTimeOptionWrapper(scripted_env(), interrupt=there, **settings)
    obs, _ = env.reset()
    for _ in range(4):
        obs, *_ = env.step(model.predict(obs, deterministic=True)[0])
    bare = scripted_env()
    controller = OptionController(model, interrupt=here, safety=None)
    obs, _ = bare.reset()
    for tick in range(env.unwrapped.count):
        obs, *_ = bare.step(controller(obs, tick * DT if clock else None))
    np.testing.assert_allclose(bare.actions, env.unwrapped.actions, atol=1e-6)
    n_asked = min(len(here.asked), len(there.asked))
    assert n_asked >= 6
    for one, other in zip(here.asked[:n_asked], there.asked[:n_asked], strict=True):
        np.testing.assert_allclose(one[0], other[0], atol=1e-6)
        np.testing.assert_allclose(one[1], other[1], atol=1e-5)


class TwoRobots:
    """Each is given its own number as action, for one second."""

    option_space = OptionSpace.make(1, 1.0, DT, DT, 0.4, duration_scale="linear")
    primitive_action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self):
        self.asked = []

    def __call__(self, observation):
        self.asked.append(np.asarray(observation)[:, 0].tolist())
        return np.column_stack([observation[:, 0] / 10.0, np.ones(len(observation))])


def test_one_of_several_robots_is_interrupted():
    policy, interrupt = TwoRobots(), Scripted(0.2, False, True)
    controller = OptionController(policy, interrupt=interrupt)
    for _ in range(4):
        controller(np.array([[1.0], [2.0]]))
    # After two ticks both are asked about, and the second decides anew.
    np.testing.assert_allclose(interrupt.asked[0][1][:, 0], [0.1, 0.2], atol=1e-6)
    assert policy.asked == [[1.0, 2.0], [2.0]]
    np.testing.assert_allclose(controller.elapsed, [0.3, 0.1])


def test_replanning(toy, scripted_env):
    """Four steps of each plan are played, and the rest never."""
    controller = OptionController(toy, replan_period=0.4)
    decided = []
    for tick in range(10):
        controller(np.array([tick, 0.0], np.float32))
        decided.append(controller.elapsed == 0)
    assert np.flatnonzero(decided).tolist() == [0, 4, 8]
    assert controller.remaining == pytest.approx(0.3)
    # The plan is that of the whole option, by the clock too.
    model = model_for(scripted_env(), join="continuous")
    for now in (None, 0.0):
        controller = OptionController(model, replan_period=0.2, safety=None)
        actions = [float(controller(np.zeros(2), now if now is None else k * DT)[0]) for k in range(3)]
        # A tenth of the way to 0.5 with each step, from where it is
        np.testing.assert_allclose(actions, [0.05, 0.1, 0.14], atol=1e-6)


def test_deciding_anew_goes_on_from_what_is_being_sent(scripted_env):
    controller = OptionController(model_for(scripted_env(), join="continuous"))
    controller.decide_anew()  # before the first tick there is nothing to break off
    actions = []
    for tick in range(4):
        if tick == 2:
            controller.decide_anew()
        actions.append(float(controller(np.zeros(2))[0]))
    np.testing.assert_allclose(actions, [0.05, 0.1, 0.14, 0.18], atol=1e-6)


def test_real_time_wrapper_of_a_gymnasium_id_checks_with_critics():
    """The whole way, with networks: a margin decides between all and none."""
    model = CTCO("MlpPolicy", gym.make("Pendulum-v1"), n_rbf=2, d_min=0.4, d_max=0.5, **SMALL)
    lengths = {}
    for margin in (-100.0, 100.0):
        env = RealTimeOptionWrapper(
            gym.make("Pendulum-v1"), interrupt=CriticInterrupt(model, 0.05, margin), n_rbf=2, d_min=0.05, d_max=0.5
        )
        obs, _ = env.reset(seed=0)
        lengths[margin] = env.step(model.predict(obs, deterministic=True)[0])[4]["option"]["n_steps"]
    assert lengths[-100.0] == 1
    assert lengths[100.0] > 1


def test_no_option_is_asked_about_where_nothing_interrupts(scripted_env):
    wrapper = OptionExecutionWrapper(scripted_env(), **SETTINGS)
    wrapper.reset()
    assert PLAYED not in wrapper.step([0.5, 1.0])[4]


def test_an_environment_may_return_one_array_each_time():
    """What an option was decided on is kept, and not where the environment writes."""

    class One(gym.Env):
        dt = 0.1
        observation_space = spaces.Box(-9.0, 9.0, (1,), np.float32)
        action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            self.obs = np.zeros(1, np.float32)
            return self.obs, {}

        def step(self, action):
            self.obs += 0.1
            return self.obs, 0.0, False, False, {}

    env = RealTimeOptionWrapper(One(), n_rbf=1, d_max=1.0, interrupt=lambda first, seen, elapsed: seen[0] - first[0] > 0.35)
    env.reset()
    for _ in range(2):
        assert env.step([0.0, 1.0])[4]["option"]["n_steps"] == 4
