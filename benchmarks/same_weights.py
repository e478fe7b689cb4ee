"""Whether a refactoring changed what is learned: the weights of each algorithm after 300 updates, before and after it.

    git stash; python benchmarks/same_weights.py --save before.pt; git stash pop
    python benchmarks/same_weights.py --compare before.pt

Both on one machine, since others round differently. 0 is to the last bit.
"""

import argparse
from pathlib import Path
from typing import Any

import torch as th
from torch import nn

from sb3_ctco import CTCO, DACPPO, FiGARSAC

SMALL: dict[str, Any] = {"seed": 3, "device": "cpu", "policy_kwargs": {"net_arch": [32, 32]}}
OFF_POLICY = {**SMALL, "learning_starts": 100, "batch_size": 64, "learning_rate": 1e-3}


def learned() -> dict[str, dict[str, th.Tensor]]:
    """Weights by name, of each algorithm."""
    # Tanh is updated with autograd.
    by_autograd = {**OFF_POLICY, "policy_kwargs": {"net_arch": [32], "activation_fn": nn.Tanh}}
    models = {
        "CTCO": CTCO("MlpPolicy", "Pendulum-v1", **OFF_POLICY).learn(400),
        "CTCO, uniform": CTCO("MlpPolicy", "Pendulum-v1", entropy_reference="uniform", **OFF_POLICY).learn(400),
        "CTCO, autograd": CTCO("MlpPolicy", "Pendulum-v1", **by_autograd).learn(400),
        "FiGAR-SAC": FiGARSAC("MlpPolicy", "Pendulum-v1", **OFF_POLICY).learn(400),
        "DAC-PPO": DACPPO("MlpPolicy", "Pendulum-v1", n_steps=200, **SMALL).learn(800),
    }
    return {name: model.policy.state_dict() for name, model in models.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--save", type=Path)
    what.add_argument("--compare", type=Path)
    args = parser.parse_args()
    th.set_num_threads(1)
    now = learned()
    if args.save:
        th.save(now, args.save)
        return
    for name, before in th.load(args.compare).items():
        assert before.keys() == now[name].keys(), f"{name} has other parameters: {before.keys() ^ now[name].keys()}"
        largest = max((value - before[key]).abs().max().item() for key, value in now[name].items())
        print(f"{name}: largest difference {largest:g}")


if __name__ == "__main__":
    main()
