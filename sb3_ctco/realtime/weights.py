"""A policy's weights in shared memory, with a version."""

import ctypes
import time
import zlib
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
import torch as th
from torch import nn


class SharedWeights:
    """Weights that one process publishes and another one picks up, neither of which ever waits.

    There is no lock, so that either may be stopped or killed at any moment, and nothing is left behind in the system. The
    version is odd while weights are being written, and a checksum tells whether what was read is what was written.

    :param module: whose ``state_dict`` is shared; both sides have one of the same shapes
    :param context: of multiprocessing, that starts the other process
    """

    def __init__(self, module: nn.Module, context: BaseContext):
        n_bytes = sum(tensor.numel() * tensor.element_size() for tensor in module.state_dict().values())
        self._memory = context.RawArray(ctypes.c_byte, n_bytes)
        self._version = context.RawValue(ctypes.c_int64, 0)
        self._checksum = context.RawValue(ctypes.c_uint32, 0)
        self._published_at = context.RawValue(ctypes.c_double, time.monotonic())
        self._seen = 0
        self._seen_published_at = time.monotonic()

    def publish(self, module: nn.Module) -> None:
        """Put a module's weights in place of the last ones."""
        flat = np.concatenate([_bytes_of(tensor) for tensor in module.state_dict().values()])
        self._version.value += 1
        self._array()[:] = flat
        self._checksum.value = zlib.crc32(flat.data)
        self._published_at.value = time.monotonic()
        self._version.value += 1

    def fetch(self, module: nn.Module) -> bool:
        """Copy the latest weights into a module, unless it has them or they are being written.

        :return: whether they were copied
        """
        version = self._version.value
        if version == self._seen or version % 2:
            return False
        flat = self._array().copy()
        checksum, published_at = self._checksum.value, self._published_at.value
        # The checksum, too, because processors may show writes in another order than they were made.
        if self._version.value != version or checksum != zlib.crc32(flat):
            return False
        self._seen, self._seen_published_at = version, published_at
        position = 0
        with th.no_grad():
            for tensor in module.state_dict().values():
                n = tensor.numel() * tensor.element_size()
                values = flat[position : position + n].view(_numpy_dtype(tensor))
                tensor.copy_(th.from_numpy(values).view(tensor.shape))
                position += n
        return True

    def _array(self) -> np.ndarray:
        return np.frombuffer(memoryview(self._memory), dtype=np.uint8)

    @property
    def version(self) -> int:
        """How often weights had been published when those in use were; 0 for those that the process began with."""
        return self._seen // 2

    @property
    def age(self) -> float:
        """Seconds since the weights fetched last were published."""
        return time.monotonic() - self._seen_published_at


def has_finite_weights(module: nn.Module) -> bool:
    """Whether all weights of a module are numbers."""
    return all(bool(th.isfinite(weights).all()) for weights in module.parameters())


def _bytes_of(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy().reshape(-1).view(np.uint8)


def _numpy_dtype(tensor: th.Tensor) -> Any:
    return th.empty(0, dtype=tensor.dtype).numpy().dtype
