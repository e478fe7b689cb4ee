"""The spatial softmax extractor: positions follow what moves, for every layout of observations."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_ctco import CTCO
from sb3_ctco.torch_layers import SpatialSoftmax, SpatialSoftmaxExtractor, random_shift

HEIGHT, WIDTH = 60, 80
FIRST = spaces.Box(0, 255, (3, HEIGHT, WIDTH), np.uint8)
LAST = spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def picture(x, y, channel=0, size=10):
    """A bright square with its centre at (x, y) pixels in one channel, channels last."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[y - size // 2 : y + size // 2, x - size // 2 : x + size // 2, channel] = 255
    return image


def detect_red(extractor):
    """Make the first channel a detector of red: every convolution passes a local mean of it on."""
    with th.no_grad():
        for i, layer in enumerate(layer for layer in extractor.encoders[0] if isinstance(layer, th.nn.Conv2d)):
            layer.weight.zero_()
            layer.bias.zero_()
            layer.weight[0, 0] = 1 / 9
            if i == 3:
                layer.weight[0, 0] *= 60.0


def features_of(extractor, observation):
    space = extractor._observation_space
    batch = (
        {key: th.as_tensor(value[None]) for key, value in observation.items()}
        if isinstance(observation, dict)
        else th.as_tensor(observation[None])
    )
    return extractor(preprocess_obs(batch, space)).detach().numpy()[0]


def test_softmax_of_a_single_peak_is_its_position():
    features = th.zeros(1, 2, 3, 5)
    features[0, 0, 0, 0] = 100.0
    features[0, 1, 2, 3] = 100.0
    # x of both channels, then y of both
    np.testing.assert_allclose(SpatialSoftmax()(features).detach()[0], [-1, 0.5, -1, 1], atol=1e-6)
    even = SpatialSoftmax()(th.ones(1, 1, 4, 4)).detach()[0]
    np.testing.assert_allclose(even, [0, 0], atol=1e-6)


@pytest.mark.parametrize("space", [FIRST, LAST], ids=["channels first", "channels last"])
def test_keypoint_follows_a_moving_blob(space):
    extractor = SpatialSoftmaxExtractor(space).eval()
    detect_red(extractor)
    arrange = (lambda image: image.transpose(2, 0, 1)) if space is FIRST else (lambda image: image)
    for x, y in [(12, 12), (40, 30), (68, 12), (20, 48), (66, 46)]:
        features = features_of(extractor, arrange(picture(x, y)))
        # The 8×10 positions lie 8 pixels apart, from pixel 0 on.
        expected = (x / 36 - 1, y / 28 - 1)
        np.testing.assert_allclose((features[0], features[32]), expected, atol=0.08)
        # Green and blue ones are not seen by this channel: its mass is spread evenly.
        for channel in (1, 2):
            other = features_of(extractor, arrange(picture(x, y, channel)))
            np.testing.assert_allclose((other[0], other[32]), (0, 0), atol=1e-5)


def test_untrained_keypoints_already_tell_where_the_blob_is():
    th.manual_seed(0)
    extractor = SpatialSoftmaxExtractor(LAST).eval()
    positions = [(x, y) for x in range(10, 75, 8) for y in range(10, 55, 8)]
    features = np.array([features_of(extractor, picture(x, y)) for x, y in positions])
    targets = np.array(positions) / (WIDTH, HEIGHT)
    design = np.column_stack([features, np.ones(len(features))])
    # Few enough features for a fit that could fail
    design = design[:, [0, 1, 2, 3, 32, 33, 34, 35, -1]]
    weights, *_ = np.linalg.lstsq(design, targets, rcond=None)
    residual = targets - design @ weights
    assert (residual.var(axis=0) < 0.1 * targets.var(axis=0)).all()


def test_architecture_and_number_of_features():
    space = spaces.Dict({"image": LAST, "proprioception": spaces.Box(-1, 1, (21,), np.float32)})
    extractor = SpatialSoftmaxExtractor(space)
    assert extractor.features_dim == 64 + 21
    convolutions = [layer for layer in extractor.encoders[0] if isinstance(layer, th.nn.Conv2d)]
    assert [(c.out_channels, c.kernel_size, c.stride[0]) for c in convolutions] == [
        (32, (3, 3), 2),
        (32, (3, 3), 2),
        (32, (3, 3), 2),
        (32, (3, 3), 1),
    ]


def test_other_entries_are_joined_and_bounded_ones_scaled():
    space = spaces.Dict(
        {
            "image": LAST,
            "joints": spaces.Box(np.array([0.0, -2.0], np.float32), np.array([4.0, 2.0], np.float32)),
            "free": spaces.Box(-np.inf, np.inf, (2, 1), np.float32),
            "mode": spaces.Discrete(3),
        }
    )
    extractor = SpatialSoftmaxExtractor(space).eval()
    observation = {
        "image": picture(20, 20),
        "joints": np.array([3.0, -2.0], np.float32),
        "free": np.array([[5.0], [6.0]], np.float32),
        "mode": np.array(1),
    }
    features = features_of(extractor, observation)
    assert features.shape == (extractor.features_dim,)
    sizes = {"joints": 2, "free": 2, "mode": 3}
    joined, at = {}, 64
    for key in (key for key in space.spaces if key != "image"):
        joined[key] = features[at : at + sizes[key]]
        at += sizes[key]
    np.testing.assert_allclose(joined["joints"], [0.5, -1.0])
    np.testing.assert_allclose(joined["free"], [5.0, 6.0])
    np.testing.assert_allclose(joined["mode"], [0, 1, 0])


def test_random_shift_moves_whole_pictures_within_its_bound():
    th.manual_seed(0)
    images = th.as_tensor(np.array([picture(40, 30), picture(30, 25)] * 50)).permute(0, 3, 1, 2).float()
    shifted = random_shift(images, 4)
    assert shifted.shape == images.shape
    seen = set()
    for before, after in zip(images, shifted, strict=True):
        moves = [
            (dy, dx) for dy in range(-4, 5) for dx in range(-4, 5) if th.equal(th.roll(before, (dy, dx), dims=(1, 2)), after)
        ]
        assert len(moves) == 1
        seen.update(moves)
    assert {dy for dy, _ in seen} == {dx for _, dx in seen} == set(range(-4, 5))
    edge = th.arange(6.0).view(1, 1, 1, 6).expand(20, 1, 6, 6)
    assert {row.tolist()[0] for row in random_shift(edge, 1)[:, 0, 0]} == {0.0, 1.0}, "the border is repeated"


def test_augmentation_only_in_training_mode():
    extractor = SpatialSoftmaxExtractor(LAST, max_shift=4)
    batch = preprocess_obs(th.as_tensor(np.array([picture(40, 30)] * 8)), LAST)
    extractor.eval()
    assert th.allclose(extractor(batch), extractor(batch))
    assert extractor(batch).std(dim=0).max() < 1e-6
    extractor.train()
    assert extractor(batch).std(dim=0).max() > 1e-4
    plain = SpatialSoftmaxExtractor(LAST).train()
    assert th.allclose(plain(batch), plain(batch))


class PictureEnv(gym.Env):
    """A picture, alone or with a vector, and a reward for a large action."""

    def __init__(self, space):
        self.metadata = {"render_fps": 20}
        self.observation_space = space
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), float(action[0]), False, self.steps >= 20, {}


@pytest.mark.parametrize("algorithm", [SAC, CTCO])
@pytest.mark.parametrize(
    ("policy", "space"),
    [
        ("CnnPolicy", LAST),
        ("CnnPolicy", FIRST),
        ("MultiInputPolicy", spaces.Dict({"image": LAST, "vector": spaces.Box(-1, 1, (3,), np.float32)})),
    ],
    ids=["last", "first", "dict"],
)
def test_learns_in_stable_baselines3(algorithm, policy, space):
    model = algorithm(
        policy,
        PictureEnv(space),
        learning_starts=20,
        batch_size=4,
        buffer_size=100,
        policy_kwargs={
            "features_extractor_class": SpatialSoftmaxExtractor,
            "features_extractor_kwargs": {"n_channels": 4, "max_shift": 2},
            "net_arch": [8],
        },
        seed=0,
    )
    before = [p.clone() for p in model.critic.features_extractor.parameters()]
    model.learn(60)
    after = list(model.critic.features_extractor.parameters())
    assert all(not th.equal(b, a) for b, a in zip(before, after, strict=True))
    observation = model.observation_space.sample()
    first, _ = model.predict(observation, deterministic=True)
    second, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (spaces.Box(-1, 1, (3,), np.float32), {}, "needs a picture"),
        (spaces.Dict({"vector": spaces.Box(-1, 1, (3,), np.float32)}), {}, "needs a picture"),
        (LAST, {"n_channels": 0}, "n_channels must be at least 1, not 0"),
        (LAST, {"max_shift": -1}, "at least 0, not -1"),
    ],
)
def test_errors(space, kwargs, message):
    with pytest.raises(ValueError, match=message):
        SpatialSoftmaxExtractor(space, **kwargs)
