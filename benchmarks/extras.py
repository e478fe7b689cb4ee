"""CTCO as it is shipped, with one more ingredient: what was tried and did, or did not, pay.

    python benchmarks/extras.py layer_norm --tasks point_mass cheetah ball_in_cup

Runs of preset quick (setting tuned) plus

- ``nothing``: as it is shipped, to compare with,
- ``layer_norm``: layer normalisation (without learned scales) after each hidden layer of the critics,
- ``two_step``: two decisions in a row as one transition, R₁ + γ(d₁)·(R₂ − β_h) over d₁ + d₂; sub-options as ever,
- ``updates_40``: 40 updates a second of task time in place of 20,
- ``anneal_2``: target entropies that fall by two nats a dimension, not by one.

A row a run goes to results/extras.csv; rows that are there are skipped.
"""

import argparse
import csv
import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_ctco import CTCO, OptionReplayBuffer
from sb3_ctco.common.evaluation import DiscountedReturnCallback, evaluate_discounted_return
from sb3_ctco.common.policies import EnsembleLinear
from sb3_ctco.ctco.policies import CTCOPolicy, OptionCritic
from sb3_ctco.envs import STUDY_RATES
from sb3_ctco.options import discount
from sb3_ctco.registry import TASKS, find_task
from sb3_ctco.study import agents
from sb3_ctco.study.grid import Run, load_preset
from sb3_ctco.study.runs import git_commit

RESULTS = Path(__file__).parents[1] / "results" / "extras.csv"
COLUMNS = (
    "variant", "task", "rate", "seed", "task_seconds", "discounted_return", "greedy_return", "decision_rate_hz",
    "updates", "wall_seconds", "commit",
)  # fmt: skip


class LayerNormCritic(OptionCritic):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        layers: list[nn.Module] = []
        for layer in self.q_networks:
            layers.append(layer)
            if isinstance(layer, EnsembleLinear) and layer is not self.q_networks[-1]:
                layers.append(nn.LayerNorm(layer.weight.shape[2], elementwise_affine=False))
        self.q_networks = nn.Sequential(*layers)


class LayerNormPolicy(CTCOPolicy):
    critic_class = LayerNormCritic


class TwoStepBuffer(OptionReplayBuffer):
    """Of one environment: stores each decision together with the one that follows it."""

    def __init__(self, *args: Any, high_freq_penalty: float, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.high_freq_penalty = high_freq_penalty
        self.previous: tuple[np.ndarray, np.ndarray, dict[str, Any]] | None = None

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        (info,) = infos
        option = info["option"]
        if self.previous is None:
            self._add_sub_options(info["sub_options"])
        else:
            first_obs, first_action, first = self.previous
            duration = first["duration"] + option["duration"]
            both = {
                "duration": duration,
                "integrated_reward": first["integrated_reward"]
                + first["discount"] * (option["integrated_reward"] - self.high_freq_penalty),
                "discount": float(discount(duration, self.discount_rate)),
            }
            super().add(first_obs, next_obs, first_action, reward, done, [{**info, "option": both}])
        self.previous = None if done[0] else (obs.copy(), action.copy(), option)
        if done[0]:
            last = {key: value for key, value in info.items() if key != "sub_options"}
            super().add(obs, next_obs, action, reward, done, [last])


def make_model(run: Run, variant: str) -> CTCO:
    arguments = agents.constructor_arguments(run)
    if variant == "updates_40":
        arguments["updates_per_second"] = 40
    if variant == "anneal_2":
        last = arguments["target_entropy_anneal"]  # by which they fall by one nat, and these functions by another
        dim = arguments["n_rbf"] * find_task(run.task).make_env(run.rate).action_space.shape[0]
        arguments["target_entropy"] = lambda left: -dim - dim * max(0.0, 1.0 - left / last)
        arguments["duration_target_entropy"] = lambda left: -1.0 - max(0.0, 1.0 - left / last)
    if variant == "two_step":
        arguments["replay_buffer_class"] = TwoStepBuffer
        arguments["replay_buffer_kwargs"] = {"high_freq_penalty": arguments["high_freq_penalty"]}
    policy = LayerNormPolicy if variant == "layer_norm" else "MlpPolicy"
    return CTCO(policy, find_task(run.task).make_env(run.rate), seed=run.seed, device="cpu", **arguments)


def perform(run: Run, variant: str) -> dict[str, Any]:
    model = make_model(run, variant)
    monitor = DiscountedReturnCallback()
    start = time.monotonic()
    model.learn(round(run.task_seconds * run.rate), monitor)
    wall_seconds = time.monotonic() - start
    greedy = evaluate_discounted_return(
        model, agents.make_eval_env(run, model), run.eval_episodes, discount_rate=agents.discount_rate(run)
    )
    beginning = 0.9 * run.task_seconds
    training = [e for e, n in zip(monitor.episodes, monitor.timesteps, strict=True) if n * run.dt > beginning]
    return {
        "variant": variant,
        "task": run.task,
        "rate": run.rate,
        "seed": run.seed,
        "task_seconds": run.task_seconds,
        "discounted_return": round(float(np.mean([e.discounted_return for e in training])), 4),
        "greedy_return": round(float(np.mean([e.discounted_return for e in greedy])), 4),
        "decision_rate_hz": round(float(np.mean([e.decision_rate_hz for e in training])), 2),
        "updates": model._n_updates,
        "wall_seconds": round(wall_seconds, 1),
        "commit": git_commit(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variant", choices=("nothing", "layer_norm", "two_step", "updates_40", "anneal_2"))
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--rate", type=int, choices=STUDY_RATES, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--task-seconds", type=float, default=None, help="the preset's by default")
    args = parser.parse_args()
    th.set_num_threads(1)
    runs = load_preset("quick").select(args.tasks, [args.rate], ["ctco"], ["tuned"], [args.seed])
    if args.task_seconds is not None:
        runs = [dataclasses.replace(run, task_seconds=args.task_seconds) for run in runs]
    for run in runs:
        rows = []
        if RESULTS.exists():
            with RESULTS.open(newline="") as file:
                rows = list(csv.DictReader(file))
        name = (args.variant, run.task, str(run.rate), str(run.seed), str(run.task_seconds))
        if any((r["variant"], r["task"], r["rate"], r["seed"], r["task_seconds"]) == name for r in rows):
            continue
        row = perform(run, args.variant)
        print(row, flush=True)
        with RESULTS.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if not rows:
                writer.writeheader()
            writer.writerow(row)


if __name__ == "__main__":
    main()
