"""Files that are whole or not there."""

import os
from pathlib import Path


def replace_durably(unfinished: Path, path: Path) -> None:
    """Put a file that was written under another name in its place, in one move.

    It is on the disk before, or a power cut may leave an empty file of that name.
    """
    with unfinished.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(unfinished, path)
