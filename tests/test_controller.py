"""OptionController: the wrapped environment's actions in a control loop, at any rate, from a model or a file."""

import json
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_ctco import CTCO, DACPPO, FiGARSAC, OptionController, OptionExecutionWrapper
from sb3_ctco.export import export_onnx
from sb3_ctco.exported import OnnxPolicy, to_metadata
from sb3_ctco.options import OptionSpace, RadialBasis
from sb3_ctco.safety import Safety

DT = 0.1
SETTINGS = OptionSpace.make(n_rbf=1, d_max=0.4, d_min=DT, dt=DT, discount_rate=0.4, duration_scale="linear")
SPACE = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))


class ScriptedPolicy:
    """Options from a list, in turn; several observations get the same one. Durations in s, for SETTINGS."""

    option_space = SETTINGS
    primitive_action_space = SPACE

    def __init__(self, *script: tuple[float, float, float]):
        self.script = list(script)
        self.asked: list[np.ndarray] = []

    def __call__(self, observation):
        observation = np.asarray(observation)
        self.asked.append(observation)
        first, second, duration = self.script[(len(self.asked) - 1) % len(self.script)]
        option = np.array([first, second, 2 * (duration - DT) / (0.4 - DT) - 1], np.float32)
        return option if observation.ndim == 1 else np.tile(option, (len(observation), 1))


@pytest.fixture
def pendulum_model() -> CTCO:
    return CTCO("MlpPolicy", "Pendulum-v1", n_rbf=3, d_max=0.7, seed=3)


def rollout_through_wrapper(model: CTCO, env: gym.Env, n_steps: int) -> list[np.ndarray]:
    """Observations at the decisions of model.predict in the wrapped environment."""
    wrapped = model.wrap_env(env)
    obs, _ = wrapped.reset(seed=5)
    trajectory, steps = [obs], 0
    while steps < n_steps:
        obs, _, terminated, truncated, info = wrapped.step(model.predict(obs, deterministic=True)[0])
        steps += info["option"]["n_steps"]
        trajectory.append(obs)
        if terminated or truncated:
            break
    return trajectory


def rollout_through_controller(controller: OptionController, env: gym.Env, n_decisions: int) -> list[np.ndarray]:
    """Observations at the first ticks of options, of the bare environment."""
    obs, _ = env.reset(seed=5)
    trajectory: list[np.ndarray] = []
    while True:
        action = controller(obs)
        if controller.elapsed == 0:
            trajectory.append(obs)
        if len(trajectory) == n_decisions:
            return trajectory
        obs, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            return [*trajectory, obs]


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [("Pendulum-v1", {}), ("sb3_ctco/ball_in_cup-catch-v0", {"dt": 0.002}), ("sb3_ctco/cheetah-run-v0", {"dt": 0.02})],
)
def test_bare_environment_moves_exactly_as_the_wrapped_one(env_id, kwargs):
    model = CTCO("MlpPolicy", gym.make(env_id, **kwargs), n_rbf=3, d_max=0.37, seed=1)
    expected = rollout_through_wrapper(model, gym.make(env_id, **kwargs), 1000)
    assert len(expected) > 5
    found = rollout_through_controller(OptionController(model), gym.make(env_id, **kwargs), len(expected))
    np.testing.assert_array_equal(found, expected)


def test_actions_in_the_units_of_the_box():
    # ω is the action itself with one basis function: halfway up, −2..2 and 0..10 give 1 and 7.5.
    controller = OptionController(ScriptedPolicy((0.5, 0.5, 0.2)))
    np.testing.assert_allclose(controller(np.zeros(3)), [1.0, 7.5])
    assert controller(np.zeros(3)).dtype == np.float32


def test_decides_when_the_option_has_run_out():
    policy = ScriptedPolicy((0.0, 0.0, 0.3), (1.0, 1.0, 0.1))
    controller = OptionController(policy)
    remaining, elapsed, first = [], [], []
    for i in range(6):
        first.append(float(controller(np.full(3, i))[0]))
        remaining.append(controller.remaining)
        elapsed.append(controller.elapsed)
    np.testing.assert_allclose(first, [0, 0, 0, 2, 0, 0])
    np.testing.assert_allclose(elapsed, [0, 0.1, 0.2, 0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(remaining, [0.3, 0.2, 0.1, 0.1, 0.3, 0.2])
    np.testing.assert_array_equal([asked[0] for asked in policy.asked], [0, 3, 4])
    np.testing.assert_allclose(controller.option[:2], [0.0, 0.0])


def test_another_rate_keeps_durations():
    ticks = {}
    for dt in (0.2, 0.1, 0.02):
        policy = ScriptedPolicy((0.0, 0.0, 0.4))
        controller = OptionController(policy, dt=dt)
        for _ in range(round(4.0 / dt)):
            controller(np.zeros(3))
        ticks[dt] = len(policy.asked)
        assert controller.duration == pytest.approx(0.4)
    assert ticks == {0.2: 10, 0.1: 10, 0.02: 10}


def test_a_tick_longer_than_the_shortest_duration_still_runs_one_tick():
    policy = ScriptedPolicy((0.0, 0.0, 0.1))
    controller = OptionController(policy, dt=0.5)
    for _ in range(3):
        controller(np.zeros(3))
    assert len(policy.asked) == 3
    assert controller.duration == 0.5


def test_a_clock_at_the_fixed_rate_gives_the_same_actions(pendulum_model):
    dt = pendulum_model.dt
    by_tick, by_clock = OptionController(pendulum_model), OptionController(pendulum_model, safety=None)
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    for i, obs in enumerate(observations):
        # The ends of options fall on the same ticks, although i·dt is rounded.
        np.testing.assert_allclose(by_clock(obs, now=7.3 + i * dt), by_tick(obs), rtol=1e-5, atol=1e-6)
        assert by_clock.elapsed == pytest.approx(by_tick.elapsed, abs=1e-9)


def test_irregular_ticks():
    policy = ScriptedPolicy((0.0, 0.0, 0.3), (1.0, 1.0, 0.2))
    controller = OptionController(policy)
    # The first option ends at 10.3, so at the first tick after 10.25; the second at 10.47, so after 10.42.
    decided = []
    for now in (10.0, 10.01, 10.24, 10.27, 10.3, 10.41, 10.43):
        controller(np.zeros(3), now=now)
        decided.append(controller.elapsed == 0)
    assert decided == [True, False, False, True, False, False, True]
    assert controller.remaining == pytest.approx(0.3)


def test_a_late_tick_holds_the_last_action_of_the_option():
    class Ramp(ScriptedPolicy):
        option_space = OptionSpace.make(n_rbf=2, d_max=0.4, d_min=0.4, dt=DT, discount_rate=0.4)
        primitive_action_space = spaces.Box(-1.0, 1.0, (1,))

        def __call__(self, observation):
            return np.array([-1.0, 1.0, 0.0])

    controller = OptionController(Ramp())
    start, almost_over = controller(np.zeros(3), now=0.0), controller(np.zeros(3), now=0.34)
    assert start < 0 < almost_over
    assert controller.remaining == pytest.approx(0.06)


def test_several_observations_have_options_of_their_own(pendulum_model):
    rng = np.random.default_rng(1)
    observations = rng.normal(size=(60, 4, 3)).astype(np.float32)
    together = OptionController(pendulum_model)
    alone = [OptionController(pendulum_model) for _ in range(4)]
    for obs in observations:
        actions = together(obs)
        assert actions.shape == (4, 1)
        # A batch may differ from single observations in the last bits of a float32.
        np.testing.assert_allclose(actions, [one(o) for one, o in zip(alone, obs, strict=True)], atol=1e-5)
        np.testing.assert_allclose(together.remaining, [one.remaining for one in alone], atol=1e-9)
    assert together.option.shape == (4, 4)
    assert together.duration.shape == together.elapsed.shape == (4,)


@pytest.mark.parametrize("which", [[1], np.array([False, True, False])])
@pytest.mark.parametrize("clock", [False, True])
def test_reset_of_one_among_several(which, clock):
    policy = ScriptedPolicy((0.0, 0.0, 0.4))
    controller = OptionController(policy)
    controller(np.zeros((3, 5)), **({"now": 0.0} if clock else {}))
    controller.reset(which)
    controller(np.arange(15.0).reshape(3, 5), **({"now": 0.1} if clock else {}))
    np.testing.assert_array_equal(policy.asked[1], [np.arange(5.0, 10.0)])
    np.testing.assert_allclose(controller.elapsed, [0.1, 0.0, 0.1])


def test_reset_of_some_before_the_first_tick_does_nothing():
    controller = OptionController(ScriptedPolicy((0.0, 0.0, 0.4)))
    controller.reset([0, 1])
    controller(np.zeros((2, 3)))
    np.testing.assert_allclose(controller.elapsed, [0.0, 0.0])


def test_reset_decides_anew_and_forgets_the_clock():
    policy = ScriptedPolicy((0.0, 0.0, 0.4))
    controller = OptionController(policy)
    controller(np.zeros(3), now=100.0)
    controller.reset()
    controller(np.zeros(3), now=0.0)
    assert len(policy.asked) == 2


class DictEnv(gym.Env):
    observation_space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Box(-1, 1, (3,))})
    action_space = spaces.Box(-1, 1, (2,))
    dt = 0.1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def test_dict_observations():
    model = CTCO("MultiInputPolicy", DictEnv(), seed=0)
    controller = OptionController(model)
    one = model.observation_space.sample()
    assert controller(one).shape == (2,)
    controller.reset()
    two = {key: np.stack([value] * 2) for key, value in one.items()}
    for _ in range(30):
        assert controller(two).shape == (2, 2)


GOOD = {"a": np.zeros(2, np.float32), "b": np.zeros(3, np.float32)}


@pytest.mark.parametrize(
    "wrong",
    [{}, {"stamp": 1.0, **GOOD}, {**GOOD, "stamp": 1.0}, {"b": GOOD["b"]}, {"a": None, "b": GOOD["b"]}, GOOD["a"], "x"],
    ids=["empty", "one more first", "one more", "one less", "none", "no dictionary", "text"],
)
@pytest.mark.parametrize("at_first", [True, False])
def test_no_exception_reaches_a_loop_by_a_clock_from_an_observation_that_is_none(wrong, at_first):
    controller = OptionController(
        CTCO("MultiInputPolicy", DictEnv(), buffer_size=10), safety=Safety(max_rate=None, max_slew=None)
    )
    if not at_first:
        controller(GOOD, now=0.0)
    np.testing.assert_array_equal(controller(wrong, now=10.0), [0.0, 0.0])
    assert controller.replaced["the policy failed"] == 1


@pytest.mark.parametrize("suffix", ["", ".zip"])
def test_from_a_saved_model(tmp_path, pendulum_model, suffix):
    pendulum_model.save(tmp_path / "model")
    from_file, from_model = OptionController(tmp_path / f"model{suffix}"), OptionController(pendulum_model)
    for obs in np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32):
        np.testing.assert_array_equal(from_file(obs), from_model(obs))


def normalized_model() -> CTCO:
    env = DummyVecEnv([lambda: OptionExecutionWrapper(gym.make("Pendulum-v1"))])
    env = VecNormalize(env, norm_reward=False, clip_obs=1.0)
    model = CTCO("MlpPolicy", env, learning_starts=50, batch_size=16, seed=0)
    model.learn(200)
    return model


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_not_acted_on(value):
    """Also where normalisation clips an infinite one."""
    controller, wrong = OptionController(normalized_model()), np.array([0.3, value, 0.1], np.float32)
    with pytest.raises(ValueError, match="the observation is not finite"):
        controller(wrong)
    controller(wrong, now=0.0)
    assert controller.replaced == {"the policy failed": 1}


def test_observations_are_normalised_as_in_training(tmp_path):
    model = normalized_model()
    env = model.get_vec_normalize_env()
    obs = np.array([0.3, -0.4, 5.0], np.float32)
    expected = model.predict(env.normalize_obs(obs), deterministic=True)[0]
    assert not np.allclose(expected, model.predict(obs, deterministic=True)[0])

    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "vecnormalize.pkl")
    export_onnx(model, tmp_path / "model.onnx")
    for controller in (
        OptionController(model),
        OptionController(tmp_path / "model.zip", vec_normalize=tmp_path / "vecnormalize.pkl"),
        OptionController(tmp_path / "model.onnx"),
    ):
        controller(obs)
        np.testing.assert_allclose(controller.option, expected, atol=1e-5)


def test_exported_policy_is_the_policy(tmp_path, pendulum_model):
    path = tmp_path / "model.onnx"
    export_onnx(pendulum_model, path)
    policy = OnnxPolicy(path)
    assert policy.option_space == pendulum_model.option_space
    assert policy.primitive_action_space == pendulum_model.primitive_action_space
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    expected = pendulum_model.predict(observations, deterministic=True)[0]
    np.testing.assert_allclose(policy(observations), expected, atol=1e-5)
    np.testing.assert_allclose(policy(observations[0]), expected[0].vector, atol=1e-5)


@pytest.mark.parametrize("kind", ["dict", "image"])
def test_exported_policy_of_other_observations(tmp_path, kind):
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)

    class SomeEnv(gym.Env):
        observation_space = image if kind == "image" else spaces.Dict({"image": image, "q": spaces.Box(-1, 1, (3,))})
        action_space = spaces.Box(-1, 1, (2,))
        dt = 0.1

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {}

    model = CTCO("CnnPolicy" if kind == "image" else "MultiInputPolicy", SomeEnv(), buffer_size=10, seed=0)
    export_onnx(model, tmp_path / "model.onnx")
    policy = OnnxPolicy(tmp_path / "model.onnx")
    for _ in range(3):
        obs = model.observation_space.sample()
        np.testing.assert_allclose(policy(obs), model.predict(obs, deterministic=True)[0], atol=1e-5)
    if kind == "dict":
        # In another order than the space's, and with another shape first
        one = dict(reversed(model.observation_space.sample().items()))
        played, expected = (OptionController(source)(one) for source in (tmp_path / "model.onnx", model))
        assert played.shape == (2,)
        np.testing.assert_allclose(played, expected, atol=1e-5)


def test_what_cannot_be_exported_leaves_no_file(tmp_path):
    class Unnamed(RadialBasis):
        pass

    with pytest.raises(ValueError, match="Unnamed has no name"):
        export_onnx(CTCO("MlpPolicy", "Pendulum-v1", trajectory=Unnamed, buffer_size=10), tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())
    export_onnx(CTCO("MlpPolicy", "Pendulum-v1", n_rbf=np.int64(2), buffer_size=10), tmp_path / "model.onnx")
    assert [file.name for file in tmp_path.iterdir()] == ["model.onnx"]
    assert OnnxPolicy(tmp_path / "model.onnx").option_space.trajectory.n_weights == 2


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The file of an exported policy with three basis functions."""
    path = tmp_path_factory.mktemp("exported") / "model.onnx"
    export_onnx(CTCO("MlpPolicy", "Pendulum-v1", n_rbf=3, buffer_size=10, seed=0), path)
    return path


# It unpickles nothing, either: Python tells of every class that a pickle asks for.
RUN_WITHOUT_TORCH = """
import json, sys
import numpy as np
from sb3_ctco import OptionController

def refuse(event, arguments):
    if event == "pickle.find_class":
        raise SystemExit(f"it unpickled {arguments}")

sys.addaudithook(refuse)
controller = OptionController(sys.argv[1])
actions = [controller(np.array(obs, np.float32)).tolist() for obs in json.loads(sys.argv[2])]
loaded = [name for name in ("torch", "stable_baselines3") if name in sys.modules]
print(json.dumps({"actions": actions, "loaded": loaded}))
"""


def test_exported_policy_runs_without_torch(tmp_path, pendulum_model):
    export_onnx(pendulum_model, tmp_path / "model.onnx")
    observations = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    command = [sys.executable, "-c", RUN_WITHOUT_TORCH, str(tmp_path / "model.onnx"), json.dumps(observations.tolist())]
    result = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert result["loaded"] == []
    controller = OptionController(pendulum_model)
    np.testing.assert_allclose(result["actions"], [controller(obs) for obs in observations], atol=1e-4)


def test_from_a_file_of_figar_sac(tmp_path):
    model = FiGARSAC("MlpPolicy", "Pendulum-v1", n_repetitions=7, seed=3)
    model.save(tmp_path / "model")
    from_file, from_model = OptionController(tmp_path / "model"), OptionController(model)
    for obs in np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32):
        np.testing.assert_array_equal(from_file(obs), from_model(obs))
        assert from_file.duration == from_model.duration


def test_files_of_models_without_options_are_refused(tmp_path):
    DACPPO("MlpPolicy", "Pendulum-v1").save(tmp_path / "dac_ppo")
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "sac")
    for name in ("dac_ppo", "sac.zip"):
        with pytest.raises(TypeError, match=f"{name[:3]}.*zip was not saved by CTCO or FiGARSAC.*model.predict"):
            OptionController(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="model does not exist"):
        OptionController(tmp_path / "model")
    (tmp_path / "model.zip").write_bytes((tmp_path / "sac.zip").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"model\.zip is damaged or no model of Stable-Baselines3"):
        OptionController(tmp_path / "model.zip")


@pytest.mark.parametrize("given", [{"deterministic": False}, {"vec_normalize": "vecnormalize.pkl"}])
def test_a_policy_takes_nothing_that_is_a_models(given):
    with pytest.raises(ValueError, match="ScriptedPolicy is a policy that acts and normalises by itself"):
        OptionController(ScriptedPolicy((0.0, 0.0, 0.2)), **given)


def test_errors_say_what_to_do(tmp_path, pendulum_model):
    with pytest.raises(ValueError, match="dt must be a positive number of seconds, not -1"):
        OptionController(pendulum_model, dt=-1)
    with pytest.raises(TypeError, match="decides by options, such as CTCO, not SAC"):
        OptionController(SAC("MlpPolicy", "Pendulum-v1"))
    with pytest.raises(ValueError, match=r"\.zip or exported as \.onnx"):
        OptionController(tmp_path / "model.pt")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        OptionController(tmp_path / "model.onnx")
    with pytest.raises(ValueError, match="acts greedily"):
        OptionController(tmp_path / "model.onnx", deterministic=False)
    with pytest.raises(ValueError, match=r"must end in \.onnx"):
        export_onnx(pendulum_model, tmp_path / "model.zip")

    controller = OptionController(pendulum_model)
    with pytest.raises(ValueError, match="no option runs"):
        _ = controller.option
    controller(np.zeros(3, np.float32), now=1.0)
    with pytest.raises(ValueError, match="at each tick or at none"):
        controller(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="must not run backwards"):
        controller(np.zeros(3, np.float32), now=0.9)
    with pytest.raises(ValueError, match="must be finite"):
        controller(np.zeros(3, np.float32), now=float("nan"))

    controller.reset()
    controller(np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="3 observations, and there were 2"):
        controller(np.zeros((3, 3), np.float32))


def test_files_that_are_no_exported_policies(tmp_path, pendulum_model):
    onnx = pytest.importorskip("onnx")
    path = tmp_path / "model.onnx"
    export_onnx(pendulum_model, path)
    policy = OnnxPolicy(path)
    with pytest.raises(ValueError, match=r"must have shape \(3,\) or \[n, 3\], not \(4,\)"):
        policy(np.zeros(4))
    file = onnx.load(path)
    del file.metadata_props[:]
    onnx.save(file, path)
    with pytest.raises(ValueError, match="export_onnx"):
        OptionController(path)


def with_metadata(source, target, change):
    """A copy of an exported policy whose metadata somebody changed."""
    onnx = pytest.importorskip("onnx")
    file = onnx.load(source)
    (entry,) = file.metadata_props
    data = json.loads(entry.value)
    entry.value = json.dumps(change(data) or data)
    onnx.save(file, target)
    return target


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["option_space"].update(n_rbf=10**9), "the graph's outputs are"),
        (lambda data: data["option_space"].update(n_rbf=2), "the graph's outputs are .* have 3 numbers"),
        (lambda data: data["option_space"].update(n_rbf="3"), "option_space"),
        (lambda data: data["option_space"].update(dt=float("nan")), "dt must be a positive number"),
        (lambda data: data["option_space"].update(d_max=True), "option_space"),
        (lambda data: data["option_space"].update(other=1.0), "option_space"),
        (lambda data: data["option_space"].pop("dt"), "option_space"),
        (lambda data: data.update(option_space=[1]), "option_space"),
        (lambda data: data.update(observations=[1]), "AttributeError"),
        (lambda data: data.update(action_dtype="O"), "action_dtype must be of floating point, not 'O'"),
        (lambda data: data.update(action_low=[float("-inf")]), "must be finite and of one shape"),
        (lambda data: data.update(action_low=[3.0]), "action_low must not be above action_high"),
        (lambda data: data.update(action_low=["a"]), "ValueError"),
        (lambda data: data.update(action_low=[-2.0] * 2, action_high=[2.0] * 2), "the graph's outputs are"),
        (lambda data: data["observations"].update(observation=[[4], "float32"]), "the graph's inputs are"),
        (lambda data: data["observations"].update(observation=[[3], "float64"]), "the graph's inputs are"),
        (lambda data: data["observations"].update(observation=[[-3], "float32"]), "must have sizes and a dtype"),
        (lambda data: data["observations"].update(observation=[[3], "O"]), "must have sizes and a dtype"),
        (lambda data: data["observations"].update(more=[[3], "float32"]), "the graph's inputs are"),
        (lambda data: data.pop("observations"), "KeyError"),
        (lambda data: [data], "TypeError"),
    ],
)
def test_metadata_that_somebody_changed(exported, tmp_path, change, message):
    def changed(data):
        result = change(data)
        return result if isinstance(result, list) and isinstance(result[0], dict) else None

    path = with_metadata(exported, tmp_path / "model.onnx", changed)
    with pytest.raises(ValueError, match=f"the metadata of .* are not those of an exported policy.*({message})"):
        OptionController(path)


def test_an_exported_policy_that_is_damaged(exported, tmp_path):
    path = tmp_path / "model.onnx"
    path.write_bytes(exported.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"model\.onnx is damaged or no ONNX file"):
        OptionController(path)


def test_the_model_remembers_the_bare_environments_actions(tmp_path, pendulum_model):
    assert pendulum_model.primitive_action_space == gym.make("Pendulum-v1").action_space
    pendulum_model.save(tmp_path / "model")
    loaded = CTCO.load(tmp_path / "model")
    assert loaded.primitive_action_space == pendulum_model.primitive_action_space
    stronger = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    with pytest.raises(ValueError, match="learned actions in"):
        loaded.set_env(stronger)


def test_a_controller_can_be_pickled(pendulum_model):
    controller = OptionController(ScriptedPolicy((0.5, 0.5, 0.3)))
    controller(np.zeros(3))
    assert controller.option.shape == (3,)
    copy = pickle.loads(pickle.dumps(controller))
    assert copy.remaining == controller.remaining


def test_a_trajectory_without_a_name_cannot_be_exported():
    class Line(RadialBasis):
        """A class that no file can name."""

    space = OptionSpace.make(2, 0.4, 0.1, 0.1, 0.4, Line)
    box = gym.spaces.Box(-1.0, 1.0, (1,))
    with pytest.raises(ValueError, match=r"Line has no name: give it one, sb3_ctco.options.TRAJECTORIES"):
        to_metadata(space, box, {"observation": ((2,), "float32")})


def test_an_exported_policy_drives_several_that_observe_a_number(tmp_path):
    class Numbered(gym.Env):
        dt = 0.05
        observation_space = spaces.Discrete(5)
        action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    model = CTCO("MlpPolicy", Numbered(), policy_kwargs={"net_arch": [8]}, buffer_size=10)
    export_onnx(model, tmp_path / "model.onnx")
    for observation in (np.array(2), np.array([2, 3])):
        np.testing.assert_allclose(
            OptionController(tmp_path / "model.onnx")(observation), OptionController(model)(observation), atol=1e-5
        )
    with pytest.raises(ValueError, match=r"must have shape \(\) or \[n, \], not \(2, 1\)"):
        OptionController(tmp_path / "model.onnx")(np.array([[2], [3]]))


def test_what_a_controller_tells_while_the_safe_action_is_sent(pendulum_model):
    controller = OptionController(pendulum_model)
    with pytest.raises(ValueError, match="call the controller with an observation first"):
        _ = controller.elapsed
    for obs, shape in ((np.zeros(3, np.float32), ()), (np.zeros((2, 3), np.float32), (2,))):
        controller.reset()
        controller(obs, now=0.0)
        assert np.all(controller.elapsed == 0.0)
        controller(None, now=1.0)
        for told in (controller.elapsed, controller.duration, controller.remaining, controller.option[..., 0]):
            assert np.shape(told) == shape
            assert np.isnan(told).all()
        controller(obs, now=1.1)
        assert np.all(controller.elapsed == 0.0)
