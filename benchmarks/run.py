"""Run the benchmarks that report ratios, and write their tables into benchmarks/README.md.

make bench                                   # or: python benchmarks/run.py
python benchmarks/run.py env_step sub_options  # only these; the other tables stay
"""

import argparse
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

from sb3_ctco.study.runs import git_commit

FOLDER = Path(__file__).parent
README = FOLDER / "README.md"
#: Each script prints one table.
SCRIPTS = ("updates", "training", "env_step", "wrapper", "sub_options", "vec_env", "controller", "imports", "memory")
PACKAGES = ("stable-baselines3", "gymnasium", "torch", "numpy", "mujoco", "dm-control")


def setting() -> str:
    """The machine, versions and commit."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    machine = f"{cpu_name()}, {os.cpu_count()} cores, one thread"
    return f"{machine}; Python {platform.python_version()}, {versions}; commit `{git_commit()}`"


def cpu_name() -> str:
    """What Linux calls the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else []
    return names[0] if names else platform.processor() or platform.machine()


def table_of(script: str) -> str:
    """The Markdown table that a script prints."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / f"{script}.py")]
    output = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment).stdout
    return "\n".join(line for line in output.splitlines() if line.startswith("|"))


def write(script: str, text: str) -> None:
    """Replace what stands between a script's markers."""
    begin, end = f"<!-- {script}: written by run.py -->", f"<!-- end of {script} -->"
    page = README.read_text()
    if begin not in page or end not in page:
        raise ValueError(f"{README} has no place for the table of {script}.py: add the lines {begin} and {end}")
    before, after = page.split(begin)[0], page.split(end)[1]
    README.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scripts", nargs="*", metavar="script", help=f"all by default: {' '.join(SCRIPTS)}")
    args = parser.parse_args()
    if unknown := {*args.scripts} - {*SCRIPTS}:
        parser.error(f"there is no {' '.join(sorted(unknown))}; these exist: {' '.join(SCRIPTS)}")
    where = setting()
    for script in args.scripts or SCRIPTS:
        print(f"{script} ...", flush=True)
        table = table_of(script)
        write(script, f"\n{table}\n\n{where}\n")
        print(table, flush=True)


if __name__ == "__main__":
    main()
