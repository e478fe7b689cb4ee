"""The console script ``sb3-ctco``."""

import argparse
import sys
from collections.abc import Sequence

from sb3_ctco._version import __version__
from sb3_ctco.study.cli import main as study

COMMANDS = {
    "train": "train an agent",
    "enjoy": "watch an agent that was trained",
    "tune": "search hyperparameters with Optuna (train --optimize-hyperparameters)",
    "study": "the frequency study; its flags are its own, see sb3-ctco study --help",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Hand over to the study, which does without RL Zoo, or to RL Zoo's commands.

    :param arguments: the command and its flags; those of the process by default
    """
    parser = argparse.ArgumentParser(
        prog="sb3-ctco",
        description="RL Zoo with CTCO. Commands take RL Zoo's flags; sb3-ctco COMMAND --help lists them.",
        epilog="\n".join(f"{name:7} {text}" for name, text in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sb3-ctco {__version__}")
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("flags", nargs=argparse.REMAINDER, help="RL Zoo's flags; --algo is ctco by default")
    args = parser.parse_args(arguments)
    if args.command == "study":
        sys.exit(study(args.flags))
    try:
        from sb3_ctco.zoo import main as zoo
    except ImportError as error:
        sys.exit(f"sb3-ctco {args.command}: {error}")
    zoo([args.command, *args.flags])
