"""A features extractor for pictures that tells where things are: convolutions and a spatial softmax."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import (
    get_flattened_obs_dim,
    is_image_space,
    is_image_space_channels_first,
)
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F


class SpatialSoftmax(nn.Module):
    """Where each channel of a feature map is active, on average: its expected position under a softmax over positions.

    The softmax has one learned inverse temperature for all channels.
    """

    def __init__(self) -> None:
        super().__init__()
        self.log_sharpness = nn.Parameter(th.zeros(()))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Expected positions.

        :param features: ``[batch, channels, height, width]``
        :return: x of every channel, then y of every channel, ``[batch, 2 · channels]``; x from −1 (left) to 1 (right),
            y from −1 (top) to 1 (bottom)
        """
        _, _, height, width = features.shape
        weights = F.softmax(features.flatten(2) * self.log_sharpness.exp(), dim=2).view_as(features)
        x = th.linspace(-1.0, 1.0, width, device=features.device)
        y = th.linspace(-1.0, 1.0, height, device=features.device)
        return th.cat((weights.sum(dim=2) @ x, weights.sum(dim=3) @ y), dim=1)


def random_shift(images: th.Tensor, max_shift: int) -> th.Tensor:
    """Move each picture by up to ``max_shift`` pixels in both directions, repeating what is at its border.

    :param images: ``[batch, channels, height, width]``
    :param max_shift: in pixels
    :return: the shape of ``images``
    """
    batch, _, height, width = images.shape
    padded = F.pad(images, (max_shift,) * 4, mode="replicate")
    shifts = th.randint(0, 2 * max_shift + 1, (2, batch, 1), device=images.device)
    rows = shifts[0] + th.arange(height, device=images.device)
    columns = shifts[1] + th.arange(width, device=images.device)
    samples = th.arange(batch, device=images.device)[:, None, None]
    # Indices around the slice put the channels last.
    return padded[samples, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


class SpatialSoftmaxExtractor(BaseFeaturesExtractor):
    """Four 3×3 convolutions (strides 2, 2, 2, 1) and a spatial softmax for each picture, joined with everything else.

    For any algorithm of Stable-Baselines3, through ``policy_kwargs``::

        CTCO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": SpatialSoftmaxExtractor})

    Observations are a picture, or a dictionary with pictures and other entries. Pictures may have their channels first
    (as Stable-Baselines3 moves them) or last. Other entries are flattened, and those with bounds are scaled to [−1, 1].

    :param observation_space: a picture, or a ``Dict`` with at least one
    :param n_channels: of each convolution; a picture gives twice as many features
    :param max_shift: in training mode, shift each picture by up to this many pixels (augmentation); 0 for none
    :param normalized_image: whether pictures are floats in [0, 1] already; then pass ``normalize_images=False`` to the
        policy
    :raises ValueError: if there is no picture, or a parameter is out of its range
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        n_channels: int = 32,
        max_shift: int = 0,
        normalized_image: bool = False,
    ):
        if n_channels < 1:
            raise ValueError(f"n_channels must be at least 1, not {n_channels}")
        if max_shift < 0:
            raise ValueError(f"max_shift must be a number of pixels that is at least 0, not {max_shift}")
        entries = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        images: dict[str, spaces.Box] = {
            key: space
            for key, space in entries.items()
            if isinstance(space, spaces.Box) and is_image_space(space, normalized_image=normalized_image)
        }
        if not images:
            raise ValueError(
                f"SpatialSoftmaxExtractor needs a picture, and {observation_space} has none: a picture is a uint8 Box of "
                "three axes from 0 to 255 (or a float Box with normalized_image=True)"
            )
        vectors = {key: space for key, space in entries.items() if key not in images}
        features_dim = 2 * n_channels * len(images) + sum(get_flattened_obs_dim(space) for space in vectors.values())
        super().__init__(observation_space, features_dim)

        self.max_shift = max_shift
        self._image_keys = list(images)
        self._vector_keys = list(vectors)
        self._channels_last = {key for key, space in images.items() if not is_image_space_channels_first(space)}
        # Keys may hold characters that a module's name may not.
        self.encoders = nn.ModuleList(
            _encoder(space.shape[-1 if key in self._channels_last else 0], n_channels) for key, space in images.items()
        )
        self._bounded: dict[str, int] = {}
        for i, (key, space) in enumerate(vectors.items()):
            if isinstance(space, spaces.Box) and space.is_bounded("both"):
                low, high = (th.as_tensor(bound, dtype=th.float32).flatten() for bound in (space.low, space.high))
                self._bounded[key] = i
                self.register_buffer(f"centre_{i}", (high + low) / 2, persistent=False)
                # An entry that cannot vary stays 0.
                self.register_buffer(f"half_range_{i}", ((high - low) / 2).clamp_min(1e-8), persistent=False)

    def forward(self, observations: th.Tensor | dict[str, th.Tensor]) -> th.Tensor:
        """Features of observations that Stable-Baselines3 has preprocessed (pictures in [0, 1]).

        :return: positions of each picture's channels, then the other entries, ``[batch, features_dim]``
        """
        entries = observations if isinstance(observations, dict) else {"": observations}
        features = []
        for key, encoder in zip(self._image_keys, self.encoders, strict=True):
            image = entries[key]
            if key in self._channels_last:
                image = image.permute(0, 3, 1, 2)
            if self.training and self.max_shift:
                image = random_shift(image, self.max_shift)
            # On a processor convolutions take about two thirds of the time in this layout.
            features.append(encoder(image.contiguous(memory_format=th.channels_last)))
        for key in self._vector_keys:
            vector = entries[key].flatten(1)
            if key in self._bounded:
                i = self._bounded[key]
                vector = (vector - self.get_buffer(f"centre_{i}")) / self.get_buffer(f"half_range_{i}")
            features.append(vector)
        return th.cat(features, dim=1)


def _encoder(in_channels: int, n_channels: int) -> nn.Sequential:
    # Padding keeps what is at the border of the picture within reach of a position.
    layers: list[nn.Module] = []
    for stride in (2, 2, 2):
        layers += [nn.Conv2d(in_channels, n_channels, 3, stride, padding=1), nn.ReLU()]
        in_channels = n_channels
    encoder = nn.Sequential(*layers, nn.Conv2d(n_channels, n_channels, 3, padding=1), SpatialSoftmax())
    return encoder.to(memory_format=th.channels_last)  # type: ignore[call-overload]
