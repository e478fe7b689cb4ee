"""The file that experience goes through: what was collected is on disk before anybody learns from it."""

import os
import pickle
import queue
import struct
import threading
from pathlib import Path
from typing import Any

_HEADER = struct.Struct("<Q")


class JournalWriter:
    """Appends records to a file from a thread of its own, so that whoever adds one does not wait for the disk.

    A record that was cut off by the end of an earlier process is removed first.

    :param path: of the file; an existing one is continued
    """

    def __init__(self, path: Path):
        self._file = path.open("ab")
        with path.open("rb") as file:
            end = _end_of_last_record(file)
        self._file.truncate(end)
        self._records: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._error: OSError | None = None
        self._thread: threading.Thread | None = None

    def add(self, record: Any) -> None:
        """Append a record, some time soon.

        :param record: anything that can be pickled, and that nobody changes afterwards
        :raises OSError: if an earlier record could not be written
        """
        if self._error is not None:
            raise OSError(f"experience cannot be written to {self._file.name}: {self._error}") from self._error
        if self._thread is None:
            # Only here, so that it has the priority of the thread that adds: it must not hold that one up by being slow
            # to let go of the interpreter.
            self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
            self._thread.start()
        self._records.put(record)

    def close(self) -> None:
        """Write what is left and close the file.

        :raises OSError: if a record could not be written
        """
        if self._thread is not None:
            self._records.put(None)
            self._thread.join()
        self._file.close()
        if self._error is not None:
            raise OSError(f"experience cannot be written to {self._file.name}: {self._error}") from self._error

    def _write(self) -> None:
        while (record := self._records.get()) is not None:
            data = pickle.dumps(record, protocol=pickle.HIGHEST_PROTOCOL)
            try:
                self._file.write(_HEADER.pack(len(data)) + data)
                self._file.flush()
            except OSError as error:
                self._error = error
                return


class JournalReader:
    """Reads a journal's records in order, while it grows.

    :param path: of the file
    """

    def __init__(self, path: Path):
        self._file = path.open("rb")

    def read(self, max_records: int) -> list[Any]:
        """Up to so many further records, as many as are complete."""
        records: list[Any] = []
        while len(records) < max_records:
            start = self._file.tell()
            header = self._file.read(_HEADER.size)
            data = self._file.read(_HEADER.unpack(header)[0]) if len(header) == _HEADER.size else b""
            if not data or len(data) < _HEADER.unpack(header)[0]:
                self._file.seek(start)
                break
            records.append(pickle.loads(data))
        return records

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _end_of_last_record(file: Any) -> int:
    size = os.fstat(file.fileno()).st_size
    end = 0
    while end + _HEADER.size <= size:
        file.seek(end)
        following = end + _HEADER.size + _HEADER.unpack(file.read(_HEADER.size))[0]
        if following > size:
            break
        end = following
    return end
