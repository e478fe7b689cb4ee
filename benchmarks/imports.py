"""Wall time of importing sb3_ctco and CTCO beyond stable_baselines3's, each in a fresh process.

python benchmarks/imports.py
"""

import argparse
import statistics
import subprocess
import sys

CODE = """
import time
start = time.perf_counter()
import stable_baselines3
middle = time.perf_counter()
{statement}
print(middle - start, time.perf_counter() - middle)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    print("| after `import stable_baselines3` | stable_baselines3 [s] | further [s] |\n|---|---|---|")
    for statement in ("import sb3_ctco", "from sb3_ctco import CTCO, OptionController"):
        command = [sys.executable, "-c", CODE.format(statement=statement)]
        outputs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(args.repeats)]
        first, further = (statistics.median(float(output.stdout.split()[column]) for output in outputs) for column in range(2))
        print(f"| `{statement}` | {first:.2f} | {further:.3f} |")


if __name__ == "__main__":
    main()
