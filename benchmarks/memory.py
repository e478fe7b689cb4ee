"""Memory of the replay buffer: bytes a transition, by its arrays and by all that is allocated for them.

python benchmarks/memory.py
"""

import argparse
import tracemalloc

import numpy as np
from gymnasium import spaces

from sb3_ctco import DictOptionReplayBuffer, OptionReplayBuffer
from sb3_ctco.options import SubOptions

IMAGE = spaces.Dict({"image": spaces.Box(0, 255, (3, 60, 80), np.uint8), "proprioception": spaces.Box(-10, 10, (21,))})
SPACES = {
    "cheetah run, 17 floats, 6 actions": (spaces.Box(-10, 10, (17,)), 6),
    "visual reacher, 80×60 pixels and 21 floats, 7 actions": (IMAGE, 7),
}


def rows_of_ones(space: spaces.Space, option_dim: int, count: int) -> SubOptions:
    """Transitions as the wrapper hands them over."""

    def ones(box: spaces.Space) -> np.ndarray:
        assert isinstance(box, spaces.Box)
        return np.ones((1, *box.shape), box.dtype)

    seen = {key: ones(box) for key, box in space.items()} if isinstance(space, spaces.Dict) else ones(space)
    rows, numbers = np.zeros(count, dtype=int), np.ones(count)
    options = np.ones((count, option_dim), dtype=np.float32)
    return SubOptions(seen, rows, rows, options, numbers, numbers, numbers > 0, numbers > 0, numbers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filled", type=int, default=10_000, help="transitions to measure with")
    args = parser.parse_args()
    print("| observations | bytes a transition | measured | 100,000 transitions [GB] |\n|---|---|---|---|")
    for name, (space, action_dim) in SPACES.items():
        cls = DictOptionReplayBuffer if isinstance(space, spaces.Dict) else OptionReplayBuffer
        option_dim = 2 * action_dim + 1
        tracemalloc.start()
        buffer = cls(args.filled, space, spaces.Box(-1, 1, (option_dim,)), device="cpu")
        for _ in range(args.filled // 100):
            buffer._add_sub_options(rows_of_ones(space, option_dim, 100))
        allocated, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        size = buffer.bytes_per_transition
        print(f"| {name} | {size:,} | {allocated / args.filled:,.0f} | {size * 1e5 / 1e9:.2f} |")


if __name__ == "__main__":
    main()
