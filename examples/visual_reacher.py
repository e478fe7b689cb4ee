"""Learn visual reaching with a robot arm, as in section "Real-World performance analysis" of the paper.

    python examples/visual_reacher.py                    # in simulated time, 4 updates per second of it
    python examples/visual_reacher.py --asynchronous     # by the wall clock, learning in a process of its own

With ``--asynchronous`` experience is kept in FOLDER, and the same command again continues it. How CTCO compares with SAC:
``sb3-ctco study run --preset benchmarks/visual_reacher.yml``.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import CTCO
from sb3_ctco.evaluation import DiscountedReturnCallback, EpisodeStatistics, evaluate_discounted_return
from sb3_ctco.realtime import AsynchronousTrainer
from sb3_ctco.torch_layers import SpatialSoftmaxExtractor

UPDATES_PER_SECOND = 4.0


def make_model(env: gym.Env, rate: int, seed: int, **kwargs: Any) -> CTCO:
    return CTCO(
        "MultiInputPolicy",
        env,
        learning_rate=1e-3,
        learning_starts=60 * rate,
        buffer_size=120_000,
        batch_size=32,
        tau=0.01,
        n_rbf=2,
        n_sub_options=4,
        d_max=1.0,
        high_freq_penalty=0.02,
        entropy_reference="uniform",  # as when docs/visual_reacher.md was measured
        policy_kwargs={
            "net_arch": {"pi": [10, 10], "qf": [64, 64]},
            "features_extractor_class": SpatialSoftmaxExtractor,
            "features_extractor_kwargs": {"max_shift": 4},
        },
        seed=seed,
        # So that the learner of --asynchronous may use a GPU while acting does not wait for one.
        device="cpu",
        **kwargs,
    )


def describe(episodes: list[EpisodeStatistics]) -> str:
    returns, rates = zip(*((one.discounted_return, one.decision_rate_hz) for one in episodes), strict=True)
    return f"discounted return {np.mean(returns):.2f}, {np.mean(rates):.1f} decisions a second, in {len(episodes)} episodes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--difficulty", choices=("easy", "hard"), default="easy")
    parser.add_argument("--rate", type=int, default=50, help="interaction frequency, Hz")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=40.0, help="task time")
    parser.add_argument("--asynchronous", action="store_true", help="act by the wall clock, learn in another process")
    parser.add_argument("--folder", type=Path, default=Path("runs/visual_reacher"))
    args = parser.parse_args()
    th.set_num_threads(1)
    task = {"id": f"sb3_ctco/visual_reacher-{args.difficulty}-v0", "dt": 1.0 / args.rate}
    env = gym.make(**task)
    n_steps = round(args.minutes * 60.0 * args.rate)
    training = DiscountedReturnCallback()
    if args.asynchronous:
        model = make_model(env, args.rate, args.seed)
        journal = args.folder / "journal"
        with AsynchronousTrainer(
            model, env, args.folder, resume=journal.exists(), updates_per_second=UPDATES_PER_SECOND
        ) as trainer:
            trainer.learn(n_steps, training)
            print(trainer.real_time.total_statistics)
    else:
        model = make_model(env, args.rate, args.seed, updates_per_second=UPDATES_PER_SECOND)
        model.learn(n_steps, training)
        args.folder.mkdir(parents=True, exist_ok=True)
        model.save(args.folder / "model")
    if training.episodes:  # none if everything had been learned before
        print("training:", describe(training.episodes[-max(1, len(training.episodes) // 10) :]))
    print("greedy:", describe(evaluate_discounted_return(model, model.wrap_env(gym.make(**task)))))


if __name__ == "__main__":
    main()
