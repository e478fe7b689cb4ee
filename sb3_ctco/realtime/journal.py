"""The files that experience goes through: what was collected is on disk before anybody learns from it.

A journal is a folder of segments, ``000000.journal``, ``000001.journal`` and so on, each with a head and records. All numbers
are little-endian; every checksum is zlib's CRC-32.

======== ==========================================================================================
part     bytes
======== ==========================================================================================
head     ``b"CTCOJRNL"``, version (4), length of the text (4), checksum of what is before and of the text (4), the text: JSON,
         what the records mean
record   a mark (4), length of the content (8), number of transitions (4), checksum of the content (4), checksum of the 20
         bytes before (4), the content
content  length of the text (4), the text: JSON, ``[path, dtype, shape]`` of each array, then the arrays' bytes
======== ==========================================================================================

Nothing in it is ever executed: reading makes arrays of numbers, dictionaries of them, and JSON.
"""

import json
import logging
import math
import os
import queue
import shutil
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sb3_ctco.common.files import replace_durably

logger = logging.getLogger(__name__)

#: Of the format; a journal of another version is refused
VERSION = 1

#: Arrays by name, or dictionaries of such
Arrays = dict[str, Any]

_HEAD = struct.Struct("<8sIII")
_MAGIC = b"CTCOJRNL"
_RECORD = struct.Struct("<4sQIII")
_MARK = b"REC\xf1"
_LENGTH = struct.Struct("<I")


class JournalError(ValueError):
    """A journal cannot be read: its bytes are damaged, or it is of another kind."""


class JournalWriter:
    """Appends records to a journal from a thread of its own, so that whoever adds one does not wait for the disk.

    Each writer begins a segment, and another one whenever that has become large. With ``keep``, the oldest segments are
    deleted as soon as the others hold that many transitions.

    :param folder: of the journal; an existing one is continued
    :param meaning: what the records mean, as JSON has it
    :param keep: at least this many of the latest transitions stay on disk; None for all
    :param segment_bytes: size from which a segment is large
    :raises JournalError: if the records that are there mean something else
    :raises OSError: if the folder cannot be written to
    """

    def __init__(
        self, folder: Path, meaning: Mapping[str, Any], keep: int | None = None, segment_bytes: int = 64 * 1024 * 1024
    ):
        self.folder = folder
        self._keep = keep
        self._segment_bytes = segment_bytes
        self._head = _encode_head(meaning)
        check_meaning(folder, meaning)
        folder.mkdir(parents=True, exist_ok=True)
        #: Transitions in each segment that is on disk, the oldest first
        self._counts = {number: _count(path) for number, path in segments(folder).items()} if keep is not None else {}
        self._number = max(segments(folder), default=-1) + 1
        self._file = self._begin_segment()
        self._records: queue.SimpleQueue[tuple[Arrays, int] | None] = queue.SimpleQueue()
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None

    def add(self, record: Arrays, n_transitions: int = 1) -> None:
        """Append a record, some time soon.

        :param record: arrays of numbers that nobody changes afterwards, by name, or dictionaries of such
        :param n_transitions: how many transitions it is to a replay buffer
        :raises OSError: if an earlier record could not be written
        :raises ValueError: after ``close``
        """
        self._raise_if_failed()
        if self._file.closed and not (self._thread is not None and self._thread.is_alive()):
            raise ValueError(f"the journal in {self.folder} is closed")
        if self._thread is None:
            # Only here, so that it has the priority of the thread that adds: it must not hold that one up by being slow
            # to let go of the interpreter.
            self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
            self._thread.start()
        self._records.put((record, n_transitions))

    def close(self) -> None:
        """Write what is left and close the segment.

        :raises OSError: if a record could not be written
        """
        if self._thread is not None:
            self._records.put(None)
            self._thread.join()
        self._file.close()
        self._raise_if_failed()

    def _raise_if_failed(self) -> None:
        if self._error is not None:
            raise OSError(f"experience cannot be written to {self.folder}: {self._error}") from self._error

    def _write(self) -> None:
        try:
            while (item := self._records.get()) is not None:
                self._write_record(*item)
        except Exception as error:
            self._error = error

    def _write_record(self, record: Arrays, n_transitions: int) -> None:
        if self._file.tell() >= self._segment_bytes:
            self._file.close()
            self._number += 1
            self._file = self._begin_segment()
        end = self._file.tell()
        try:
            _write_all(self._file, _encode_record(record, n_transitions))
        except OSError:
            # A full disk takes a part of a record. What can be read stays in order.
            self._file.truncate(end)
            raise
        self._counts[self._number] += n_transitions

    def _begin_segment(self) -> BinaryIO:
        path = self.folder / f"{self._number:06d}.journal"
        unfinished = path.with_suffix(".unfinished")
        # In one move, and on the disk before it, so that neither a reader nor a power cut leaves a part of a head.
        unfinished.write_bytes(self._head)
        replace_durably(unfinished, path)
        self._counts[self._number] = 0
        self._delete_old_segments()
        return path.open("ab", buffering=0)

    def _delete_old_segments(self) -> None:
        if self._keep is None:
            return
        for number in sorted(self._counts)[:-1]:
            if sum(self._counts.values()) - self._counts[number] < self._keep:
                return
            (self.folder / f"{number:06d}.journal").unlink(missing_ok=True)
            del self._counts[number]


class JournalReader:
    """Reads a journal's records in order, while it grows.

    :param folder: of the journal
    :raises FileNotFoundError: if there is none
    :raises JournalError: if it is of another kind or version
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._number, self._is_complete = -1, False
        if not self._open_next():
            raise FileNotFoundError(f"there is no journal in {folder}")

    def read(self, max_records: int) -> list[Arrays]:
        """Up to so many further records, as many as are complete.

        :raises JournalError: if the bytes of a record are damaged
        """
        records: list[Arrays] = []
        while len(records) < max_records:
            start = self._file.tell()
            try:
                records.append(_decode_record(_read_record(self._file)))
            except _IncompleteError:
                self._file.seek(start)
                if not self._is_complete:
                    # It is complete when there is a later one; it may have grown until then, so it is looked at once more.
                    self._is_complete = max(segments(self.folder), default=-1) > self._number
                    if not self._is_complete:
                        break
                elif start < os.fstat(self._file.fileno()).st_size:
                    raise self._damage(start, "a record was cut off") from None
                else:
                    self._file.close()
                    self._open_next()
            except _DamageError as error:
                raise self._damage(start, str(error)) from None
        return records

    def close(self) -> None:
        """Close the segment that is being read."""
        self._file.close()

    def _open_next(self) -> bool:
        for number, path in segments(self.folder).items():
            if number > self._number:
                try:
                    self._file = path.open("rb")
                except FileNotFoundError:
                    continue  # deleted meanwhile, so old that nobody needs it
                _read_head(self._file)
                self._number, self._is_complete = number, False
                return True
        return False

    def _damage(self, start: int, what: str) -> JournalError:
        return JournalError(
            f"{self._file.name} is damaged at byte {start} ({what}): repair_journal({str(self.folder)!r}), which resume=True "
            "does, drops that record, says how much was lost, and keeps the damaged file"
        )


def segments(folder: Path) -> dict[int, Path]:
    """The segments of a journal by number, in order.

    :raises JournalError: if it is a file, which was an earlier release's format
    """
    if folder.is_file():
        raise JournalError(
            f"{folder} is a journal of an earlier release, which could run code when it is read, and is not read: "
            "begin in another folder"
        )
    found = {int(path.stem): path for path in folder.glob("*.journal") if path.stem.isdecimal()}
    return dict(sorted(found.items()))


def check_meaning(folder: Path, meaning: Mapping[str, Any]) -> None:
    """Refuse a journal whose records mean something else.

    :param meaning: what records are to mean
    :raises JournalError: if one of its segments differs, or if a head is damaged
    """
    expected = json.loads(json.dumps(meaning))
    for path in segments(folder).values():
        with path.open("rb") as file:
            found = _read_head(file)
        different = [
            f"{name}={found.get(name)!r} there, {expected.get(name)!r} here"
            for name in sorted({*found, *expected})
            if found.get(name) != expected.get(name)
        ]
        if different:
            raise JournalError(
                f"what was collected in {folder} means something else: {'; '.join(different)}. Continue it with the settings "
                "that it has, or begin in another folder"
            )


def repair_journal(folder: str | Path) -> int:
    """Drop what cannot be read of a journal that nobody writes to, so that all the rest can be read.

    A damaged segment is kept as ``….journal.damaged``, and so is one in which nothing stands, as a power cut leaves it; what
    was dropped is logged as a warning.

    :param folder: of the journal
    :return: how many bytes were dropped
    :raises JournalError: if a head is damaged, without which nobody knows what the records mean
    """
    dropped = 0
    for path in segments(Path(folder)).values():
        data = path.read_bytes()
        if not data.strip(b"\0"):
            damaged = _free_name(path)
            path.rename(damaged)
            dropped += len(data)
            logger.warning("%s was empty: it is put aside as %s", path, damaged)
            continue
        with path.open("rb") as file:
            _read_head(file)
            first = file.tell()
        good = list(_intact_records(data, first))
        n_bad = len(data) - first - sum(end - start for start, end in good)
        if not n_bad:
            continue
        dropped += n_bad
        damaged = _free_name(path)
        shutil.copy2(path, damaged)
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(data[:first] + b"".join(data[start:end] for start, end in good))
        replace_durably(unfinished, path)
        logger.warning(
            "%s was damaged or cut off: %d of its %d bytes were dropped, %d records are left; the file as it was is %s",
            path,
            n_bad,
            len(data),
            len(good),
            damaged,
        )
    return dropped


def _free_name(path: Path) -> Path:
    number, name = 1, path.with_name(f"{path.name}.damaged")
    while name.exists():
        number += 1
        name = path.with_name(f"{path.name}.damaged{number}")
    return name


def _intact_records(data: bytes, position: int) -> Iterator[tuple[int, int]]:
    """Beginnings and ends of the records that can be read; after damage, from the next mark on."""
    while (position := data.find(_MARK, position)) >= 0:
        header = data[position : position + _RECORD.size]
        end = position
        try:
            length, _, checksum = _decode_header(header)
            content = data[position + _RECORD.size : position + _RECORD.size + length]
            if len(content) == length:
                _check(content, checksum)
                _decode_record(content)
                end = position + _RECORD.size + length
        except (_IncompleteError, _DamageError):
            pass
        if end > position:
            yield position, end
        position = max(end, position + 1)


class _DamageError(Exception):
    """Bytes that are not what was written."""


class _IncompleteError(Exception):
    """A record whose end is not in the file, yet."""


def _encode_head(meaning: Mapping[str, Any]) -> bytes:
    text = json.dumps(meaning).encode()
    return _HEAD.pack(_MAGIC, VERSION, len(text), _head_checksum(len(text), text)) + text


def _head_checksum(length: int, text: bytes) -> int:
    return zlib.crc32(text, zlib.crc32(struct.pack("<8sII", _MAGIC, VERSION, length)))


def _read_head(file: BinaryIO) -> dict[str, Any]:
    head = file.read(_HEAD.size)
    name = file.name
    if len(head) < _HEAD.size or head[:8] != _MAGIC:
        raise JournalError(f"{name} is no segment of a journal, or its head is damaged: move it away to go on without it")
    _, version, length, checksum = _HEAD.unpack(head)
    if version != VERSION:
        raise JournalError(
            f"{name} is a journal of version {version}, and this release reads version {VERSION}: use the one that wrote it"
        )
    text = file.read(min(length, os.fstat(file.fileno()).st_size))
    if checksum != _head_checksum(length, text):
        raise JournalError(f"the head of {name} is damaged, so nobody knows what it means: move it away to go on without it")
    return dict(json.loads(text))


def _encode_record(record: Arrays, n_transitions: int) -> bytes:
    paths, arrays = [], []
    for path, array in _leaves(record, ()):
        if array.dtype.kind not in "biuf":
            raise TypeError(f"a journal takes arrays of numbers, and {'/'.join(path)} has dtype {array.dtype}")
        paths.append((path, array.dtype.newbyteorder("<").str, array.shape))
        arrays.append(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
    text = json.dumps(paths).encode()
    content = b"".join([_LENGTH.pack(len(text)), text, *arrays])
    start = struct.pack("<4sQII", _MARK, len(content), n_transitions, zlib.crc32(content))
    return start + struct.pack("<I", zlib.crc32(start)) + content


def _leaves(tree: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    if isinstance(tree, dict):
        for name, branch in tree.items():
            yield from _leaves(branch, (*path, name))
    else:
        yield path, np.asarray(tree)


def _read_record(file: BinaryIO) -> bytes:
    length, _, checksum = _decode_header(file.read(_RECORD.size))
    # Looked up before reading, so that nobody asks for more memory than there are bytes.
    if length > os.fstat(file.fileno()).st_size - file.tell():
        raise _IncompleteError
    content = file.read(length)
    _check(content, checksum)
    return content


def _decode_header(header: bytes) -> tuple[int, int, int]:
    """Length of a record's content, its number of transitions, and the content's checksum."""
    if len(header) < _RECORD.size:
        raise _IncompleteError
    mark, length, n_transitions, checksum, own_checksum = _RECORD.unpack(header)
    if mark != _MARK or own_checksum != zlib.crc32(header[: _RECORD.size - 4]):
        raise _DamageError("where a record should begin there is something else")
    return length, n_transitions, checksum


def _check(content: bytes, checksum: int) -> None:
    if zlib.crc32(content) != checksum:
        raise _DamageError("the checksum is wrong")


def _decode_record(content: bytes) -> Arrays:
    """A record's arrays, read-only."""
    try:
        (length,) = _LENGTH.unpack_from(content)
        position = _LENGTH.size + length
        tree: Arrays = {}
        for path, dtype_name, shape in json.loads(content[_LENGTH.size : position]):
            dtype = np.dtype(str(dtype_name))
            if dtype.kind not in "biuf" or not all(type(n) is int and n >= 0 for n in shape):
                raise _DamageError(f"{path} is no array of numbers")
            count = math.prod(shape)
            if count * dtype.itemsize > len(content) - position:
                raise _DamageError(f"{path} has more bytes than the record")
            array = np.frombuffer(content, dtype, count, position).reshape(shape)
            position += array.nbytes
            branch = tree
            for name in path[:-1]:
                branch = branch.setdefault(name, {})
            branch[path[-1]] = array
        if position != len(content):
            raise _DamageError("the record has more bytes than its arrays")
        return tree
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, struct.error) as error:
        # A checksum keeps out damage, and not what somebody wrote on purpose.
        raise _DamageError(f"its content is malformed: {type(error).__name__}: {error}") from None


def _write_all(file: BinaryIO, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def _count(path: Path) -> int:
    """Transitions in a segment, by the headers of its records."""
    total = 0
    with path.open("rb") as file:
        _read_head(file)
        while True:
            try:
                length, n_transitions, _ = _decode_header(file.read(_RECORD.size))
            except (_IncompleteError, _DamageError):
                return total
            file.seek(length, os.SEEK_CUR)
            total += n_transitions
