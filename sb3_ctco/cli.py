"""The console script ``sb3-ctco``."""

import sys

from sb3_ctco.study.cli import main as study


def main() -> None:
    """Hand over to the study, which does without RL Zoo, or to RL Zoo's commands."""
    if sys.argv[1:2] == ["study"]:
        sys.exit(study(sys.argv[2:]))
    from sb3_ctco.zoo import main as zoo  # noqa: PLC0415

    zoo()
