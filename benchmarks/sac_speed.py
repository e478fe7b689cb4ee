"""What SAC's runs of the study cost, and what QuickSACPolicy saves of it.

    python benchmarks/sac_speed.py

Cheetah at 50 and 500 Hz, the arguments of preset quick, one thread, in processor time: stock SAC and the study's take turns,
from the same seed, and the ratio is the median over the repeats. Both make the same actions and updates up to rounding.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch as th

from sb3_ctco.fixed_rate import QuickSACPolicy, sac_at_rate
from sb3_ctco.registry import find_task
from sb3_ctco.study.agents import constructor_arguments
from sb3_ctco.study.grid import load_preset
from sb3_ctco.study.runs import _Monitor

#: Random actions first, in s
WARM_UP = 4.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="task time of a repeat")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)
    print("| | of a step [ms] | of an update [ms] | a second of task time [s] | with QuickSACPolicy [s] | ratio |")
    print("|---|---|---|---|---|---|")
    for rate in (50, 500):
        (run,) = load_preset("quick").select(tasks=["cheetah"], rates=[rate], algorithms=["sac"])
        arguments = {**constructor_arguments(run), "learning_starts_seconds": WARM_UP, "buffer_size": 100_000, "seed": 0}
        models = []
        for policy in ("MlpPolicy", QuickSACPolicy):
            env = find_task(run.task).make_env(rate)
            model = sac_at_rate(env, dt=run.dt, policy=policy, device="cpu", **arguments)
            monitor = _Monitor(run, Path(tempfile.mkdtemp()) / "monitor.csv")
            model.learn(round((WARM_UP + 1.0) * rate), monitor)
            models.append((model, monitor))
        costs: list[list[float]] = []
        updates = []
        for _ in range(args.repeats):
            costs.append([])
            for model, monitor in models:
                start = time.process_time()
                model.learn(round(args.seconds * rate), monitor, reset_num_timesteps=False)
                costs[-1].append((time.process_time() - start) / args.seconds)
            start = time.process_time()
            models[0][0].train(20, arguments["batch_size"])
            updates.append((time.process_time() - start) / 20)
        stock, quick = (statistics.median(column) for column in zip(*costs, strict=True))
        ratio = statistics.median(row[1] / row[0] for row in costs)
        update = statistics.median(updates)
        of_step = (stock - update * arguments["updates_per_second"]) / rate
        print(f"| {rate} Hz | {1000 * of_step:.2f} | {1000 * update:.2f} | {stock:.3f} | {quick:.3f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
