"""The console script ``sb3-ctco``: RL Zoo's commands, and the study, which does without RL Zoo."""

import sys


def main() -> None:
    """Run the command of the process's arguments."""
    if sys.argv[1:2] == ["study"]:
        from sb3_ctco.study.cli import main as study  # noqa: PLC0415

        sys.exit(study(sys.argv[2:]))
    from sb3_ctco.zoo import main as zoo  # noqa: PLC0415

    zoo()
