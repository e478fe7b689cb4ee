"""Learn visual reaching with a robot arm, as in section "Real-World performance analysis" of the paper.

    python examples/visual_reacher.py --algorithm ctco --difficulty easy --seed 0
    python examples/visual_reacher.py --algorithm sac --difficulty easy --seed 0

runs in simulated time, with a fixed number of updates per second of task time, which a seed makes repeatable. With
``--asynchronous`` acting keeps the wall clock and learning takes place in a process of its own.

One row an episode goes to FOLDER/<algorithm>_<difficulty>_<rate>hz_seed<seed>.csv (task time in s, discounted return,
decisions a second). A run that is complete is skipped; one that was interrupted continues from its last checkpoint.
"""

import argparse
import csv
import json
import os
import pickle
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_ctco import CTCO
from sb3_ctco.evaluation import DiscountedReturnCallback, evaluate_discounted_return
from sb3_ctco.options import DEFAULT_DISCOUNT_RATE
from sb3_ctco.realtime import AsynchronousTrainer
from sb3_ctco.torch_layers import SpatialSoftmaxExtractor

COMMON: dict[str, Any] = {
    "learning_rate": 1e-3,
    "tau": 0.01,
    # From SAC's usual start, 1, a reward of 1 a second would be outweighed by entropy for most of a run.
    "ent_coef": "auto_0.02",
    "policy_kwargs": {
        "net_arch": {"pi": [10, 10], "qf": [64, 64]},
        "features_extractor_class": SpatialSoftmaxExtractor,
        "features_extractor_kwargs": {"max_shift": 4},
    },
    # So that the learner of --asynchronous may use a GPU while acting does not wait for one.
    "device": "cpu",
}
#: Warm-up with random actions or options, in s of task time
LEARNING_STARTS = 60.0
ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {"ctco": CTCO, "sac": SAC}


def make_env(args: argparse.Namespace) -> gym.Env:
    return gym.make(f"sb3_ctco/visual_reacher-{args.difficulty}-v0", dt=1.0 / args.rate)


def make_model(args: argparse.Namespace, env: gym.Env) -> OffPolicyAlgorithm:
    starts = round(LEARNING_STARTS * args.rate)
    if args.algorithm == "ctco":
        updates = {} if args.asynchronous else {"updates_per_second": args.updates_per_second}
        return CTCO(
            "MultiInputPolicy",
            env,
            seed=args.seed,
            learning_starts=starts,
            buffer_size=args.buffer_size,
            batch_size=args.batch_size,
            n_rbf=2,
            n_sub_options=args.n_sub_options,
            d_max=args.d_max,
            high_freq_penalty=0.02,
            **updates,
            **COMMON,
        )
    every = Fraction(args.rate) / Fraction(args.updates_per_second).limit_denominator(100)
    return SAC(
        "MultiInputPolicy",
        env,
        seed=args.seed,
        learning_starts=starts,
        buffer_size=args.buffer_size,
        batch_size=args.batch_size,
        gamma=float(np.exp(-DEFAULT_DISCOUNT_RATE / args.rate)),
        train_freq=every.numerator,
        gradient_steps=every.denominator,
        **COMMON,
    )


class RecordCallback(DiscountedReturnCallback):
    """Write each episode to a file as it ends.

    :param path: of the file; rows that are later than the checkpoint that a run continues from are dropped
    :param dt: interaction period, in s
    """

    def __init__(self, path: Path, dt: float):
        super().__init__(dt=dt)
        self.path = path
        self.period = dt
        self.written = 0

    def _on_training_start(self) -> None:
        super()._on_training_start()
        rows = []
        if self.path.exists():
            with self.path.open(newline="") as file:
                rows = list(csv.reader(file))[1:]
        with self.path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["seconds", "discounted_return", "decision_rate_hz"])
            writer.writerows(row for row in rows if float(row[0]) <= self.num_timesteps * self.period)

    def _on_step(self) -> bool:
        super()._on_step()
        if self.written < len(self.episodes):
            with self.path.open("a", newline="") as file:
                for episode, n in zip(self.episodes[self.written :], self.timesteps[self.written :], strict=True):
                    row = n * self.period, episode.discounted_return, episode.decision_rate_hz
                    csv.writer(file).writerow([round(value, 4) for value in row])
            self.written = len(self.episodes)
        return True


class ResumableCallback(BaseCallback):
    """Save the model and the filled part of its replay buffer now and then.

    :param stem: of the files
    :param every: in environment steps
    """

    def __init__(self, stem: Path, every: int):
        super().__init__()
        self.stem = stem
        self.every = every
        self.due = 0

    def _on_training_start(self) -> None:
        self.due = self.num_timesteps + self.every

    def _on_rollout_start(self) -> None:
        # Here the last transition is in the buffer, and the updates that it called for have been made.
        if self.model.num_timesteps >= self.due:
            save_run(self.stem, self.model)
            self.due += self.every

    def _on_step(self) -> bool:
        return True


def save_run(stem: Path, model: OffPolicyAlgorithm) -> None:
    buffer = model.replay_buffer
    filled = {}
    for name, value in vars(buffer).items():
        if isinstance(value, np.ndarray):
            filled[name] = value[: buffer.size()]
        elif isinstance(value, dict) and name.endswith("observations"):
            filled[name] = {key: array[: buffer.size()] for key, array in value.items()}
    content = {"filled": filled, "pos": buffer.pos, "full": buffer.full}
    unfinished = stem.with_suffix(".unfinished")
    with unfinished.open("wb") as file:
        pickle.dump(content, file, protocol=pickle.HIGHEST_PROTOCOL)
    model.save(stem.with_suffix(".checkpoint.zip"))
    os.replace(unfinished, stem.with_suffix(".buffer"))


def load_run(stem: Path, algorithm: type[OffPolicyAlgorithm], env: gym.Env) -> OffPolicyAlgorithm:
    model = algorithm.load(stem.with_suffix(".checkpoint.zip"), env=env, device="cpu")
    with stem.with_suffix(".buffer").open("rb") as file:
        content = pickle.load(file)
    buffer = model.replay_buffer
    for name, value in content["filled"].items():
        if isinstance(value, dict):
            for key, array in value.items():
                getattr(buffer, name)[key][: len(array)] = array
        else:
            getattr(buffer, name)[: len(value)] = value
    buffer.pos, buffer.full = content["pos"], content["full"]
    return model


def run(args: argparse.Namespace) -> None:
    folder = Path(args.folder)
    mode = "_asynchronous" if args.asynchronous else ""
    stem = folder / f"{args.algorithm}_{args.difficulty}_{args.rate}hz_seed{args.seed}{mode}"
    summary_file = stem.with_suffix(".json")
    if summary_file.exists():
        print(f"{summary_file} is complete")
        return
    folder.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)
    dt = 1.0 / args.rate
    n_steps = round(args.minutes * 60.0 / dt)
    env = make_env(args)
    record = RecordCallback(stem.with_suffix(".csv"), dt)
    start = time.time()
    late = None
    if args.asynchronous:
        journal = stem.with_suffix("")
        model = make_model(args, env)
        with AsynchronousTrainer(
            model,
            env,
            journal,
            resume=(journal / "journal").exists(),
            updates_per_second=args.updates_per_second,
        ) as trainer:
            trainer.learn(n_steps, record, progress_bar=args.progress)
            late = vars(trainer.real_time.total_statistics)
    else:
        resumed = stem.with_suffix(".buffer").exists()
        algorithm = ALGORITHMS[args.algorithm]
        model = load_run(stem, algorithm, env) if resumed else make_model(args, env)
        resumable = ResumableCallback(stem, round(args.checkpoint_minutes * 60.0 / dt))
        # A callback that writes comes last.
        model.learn(
            n_steps - model.num_timesteps,
            CallbackList([record, resumable]),
            reset_num_timesteps=not resumed,
            progress_bar=args.progress,
        )
    wall_seconds = time.time() - start

    model.save(stem.with_suffix(".zip"))
    bare = make_env(args)
    greedy_env = model.wrap_env(bare) if isinstance(model, CTCO) else bare
    greedy = evaluate_discounted_return(model, greedy_env, args.evaluations, dt=dt)
    with stem.with_suffix(".csv").open(newline="") as file:
        episodes = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    tail = [row for row in episodes if row["seconds"] > 0.9 * args.minutes * 60.0] or episodes[-1:]
    summary = {
        "algorithm": args.algorithm,
        "difficulty": args.difficulty,
        "rate": args.rate,
        "seed": args.seed,
        "asynchronous": args.asynchronous,
        "n_sub_options": args.n_sub_options if args.algorithm == "ctco" else 0,
        "batch_size": args.batch_size,
        "task_minutes": args.minutes,
        "updates_per_second": args.updates_per_second,
        "discounted_return": float(np.mean([row["discounted_return"] for row in tail])),
        "decision_rate_hz": float(np.mean([row["decision_rate_hz"] for row in tail])),
        "greedy_return": float(np.mean([episode.discounted_return for episode in greedy])),
        "greedy_decision_rate_hz": float(np.mean([episode.decision_rate_hz for episode in greedy])),
        "updates": model._n_updates,
        "ticks": late,
        "wall_seconds_of_last_part": wall_seconds,
    }
    unfinished = stem.with_suffix(".tmp")
    unfinished.write_text(json.dumps(summary, indent=1) + "\n")
    # In one move: its presence says that the run is complete.
    os.replace(unfinished, summary_file)
    for suffix in (".buffer", ".checkpoint.zip"):
        stem.with_suffix(suffix).unlink(missing_ok=True)
    print(json.dumps(summary))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="ctco")
    parser.add_argument("--difficulty", choices=("easy", "hard"), default="easy")
    parser.add_argument("--rate", type=int, default=50, help="interaction frequency, Hz")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=40.0, help="task time")
    parser.add_argument("--updates-per-second", type=float, default=4.0, help="of task time")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--n-sub-options", type=int, default=4, help="of CTCO; 0 is the paper's way")
    parser.add_argument("--d-max", type=float, default=1.0, help="longest option of CTCO, s")
    parser.add_argument("--buffer-size", type=int, default=120_000, help="transitions; a full one takes 29 kB each")
    parser.add_argument("--asynchronous", action="store_true", help="act by the wall clock, learn in another process")
    parser.add_argument("--checkpoint-minutes", type=float, default=5.0, help="task time between two checkpoints")
    parser.add_argument("--evaluations", type=int, default=20, help="greedy episodes at the end")
    parser.add_argument("--folder", default="runs/visual_reacher")
    parser.add_argument("--progress", action="store_true")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
