"""Time one control tick of OptionController.

    python benchmarks/controller.py

Prints microseconds a tick, median, 99th percentile and the worst one, between decisions and at decisions; and, where the
critics may end an option, at the ticks at which they are asked.
"""

import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th

from sb3_ctco import CTCO, OptionController
from sb3_ctco.export import export_onnx
from sb3_ctco.interruption import CriticInterrupt

N_TICKS = 20_000
#: Of a check by the critics, which are told that nothing is worth it
CHECK_PERIOD, MARGIN = 0.02, 1e9


def measure(name: str, controller: OptionController, observation: np.ndarray, clock: bool, checked: bool = False) -> None:
    ticks: list[float] = []
    decisions: list[float] = []
    checks: list[float] = []
    check_steps = round(CHECK_PERIOD / controller.dt)
    for i in range(N_TICKS):
        now = i * controller.dt if clock else None
        start = time.perf_counter()
        controller(observation, now)
        seconds = time.perf_counter() - start
        if np.all(controller.elapsed == 0):
            decisions.append(seconds)
        elif checked and round(float(np.max(controller.elapsed)) / controller.dt) % check_steps == 0:
            checks.append(seconds)
        else:
            ticks.append(seconds)
    for kind, seconds in (("between decisions", ticks), ("at a decision", decisions), ("at a check", checks)):
        if not seconds:
            continue
        median, high, worst = np.percentile(seconds, [50, 99, 100]) * 1e6
        print(f"| {name} | {kind} | {median:.1f} | {high:.1f} | {worst:.0f} |")


def main() -> None:
    th.set_num_threads(1)
    env = gym.make("sb3_ctco/cheetah-run-v0", dt=0.002)
    model = CTCO("MlpPolicy", env, n_rbf=3, d_max=0.5, seed=0)
    obs, _ = env.reset(seed=0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        export_onnx(model, path)
        print("| policy and ticks | tick | median, µs | 99 %, µs | worst, µs |\n|---|---|---|---|---|")
        for kind, policy in (("PyTorch", model), ("onnxruntime", path)):
            measure(f"{kind}, every dt", OptionController(policy), obs, False)
            measure(f"{kind}, by a clock", OptionController(policy), obs, True)
            measure(f"{kind}, 8 robots, every dt", OptionController(policy), np.tile(obs, (8, 1)), False)
        interrupt = CriticInterrupt(model, CHECK_PERIOD, MARGIN)
        measure("PyTorch, every dt, critics may end", OptionController(model, interrupt=interrupt), obs, False, checked=True)


if __name__ == "__main__":
    main()
