"""Folders that one process at a time writes to."""

import contextlib
import errno
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

#: The file that is locked
LOCK = "lock"


@contextlib.contextmanager
def lock(path: Path, patience: float = 0.5, name: str = LOCK) -> Iterator[bool]:
    """Hold a folder for this process; the operating system lets go of it when the process dies.

    :param path: the folder
    :param patience: how long to try, in s: to ask for a run's state holds its lock for a moment
    :param name: of the file that is locked
    :return: whether the folder is ours
    """
    with (path / name).open("a") as file:
        end = time.monotonic() + patience
        while True:
            try:
                _flock(file)
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                    raise
                if time.monotonic() >= end:
                    yield False
                    return
                time.sleep(0.05)
            else:
                try:
                    yield True
                finally:
                    _unlock(file)
                return


def _flock(file: IO[str]) -> None:
    """Lock a file as a whole, or raise an ``OSError`` if another process has."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _unlock(file: IO[str]) -> None:
    """Let go of it even if a process that was forked meanwhile has the file open, too."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)
