"""The journal of experience: what comes back, what damage costs, what is deleted, and that nothing in it runs."""

import json
import logging
import struct
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest

from sb3_ctco.realtime import JournalError, JournalReader, JournalWriter, repair_journal
from sb3_ctco.realtime.journal import check_meaning, segments

MEANING = {"options": {"d_max": 1.0}}


def write(folder, numbers, keep=None, segment_bytes=64 * 1024 * 1024):
    """A record for each number: an array of so many entries, the number, and whether it is even, in dictionaries."""
    writer = JournalWriter(folder, MEANING, keep, segment_bytes)
    for k in numbers:
        writer.add({"obs": {"a": np.arange(k, dtype=np.float32), "b": np.int64(k)}, "even": np.array([k % 2 == 0])})
    writer.close()


def read(folder):
    """The numbers of the records."""
    reader = JournalReader(folder)
    records = reader.read(10**6)
    reader.close()
    for record in records:
        k = record["obs"]["b"].item()
        np.testing.assert_array_equal(record["obs"]["a"], np.arange(k))
        assert record["obs"]["a"].dtype == np.float32
        assert record["even"].dtype == bool
        assert record["even"].tolist() == [k % 2 == 0]
    return [record["obs"]["b"].item() for record in records]


def last_segment(folder):
    return list(segments(folder).values())[-1]


def change(path, position, change=lambda byte: byte ^ 1):
    """Change one byte of a file; positions count from its end if they are negative."""
    data = bytearray(path.read_bytes())
    data[position] = change(data[position])
    path.write_bytes(data)


def test_arrays_come_back_in_order_and_while_they_are_written(tmp_path):
    write(tmp_path, range(20))
    reader = JournalReader(tmp_path)
    assert [r["obs"]["b"].item() for r in reader.read(15)] == list(range(15))
    assert [r["obs"]["b"].item() for r in reader.read(15)] == [15, 16, 17, 18, 19]
    assert reader.read(15) == []
    writer = JournalWriter(tmp_path, MEANING)
    writer.add({"x": np.zeros((0, 3))})
    writer.close()
    (record,) = reader.read(15)
    assert record["x"].shape == (0, 3)
    reader.close()


def test_an_unfinished_record_waits(tmp_path):
    write(tmp_path, [3])
    path = last_segment(tmp_path)
    whole = path.read_bytes()
    write(tmp_path / "other", [3, 4])
    both = last_segment(tmp_path / "other").read_bytes()
    reader = JournalReader(tmp_path)
    assert len(reader.read(5)) == 1
    for cut in (len(whole) + 3, len(whole) + 30, len(both) - 1):
        path.write_bytes(both[:cut])
        assert reader.read(5) == []
    path.write_bytes(both)
    assert [r["obs"]["b"].item() for r in reader.read(5)] == [4]


def test_another_meaning_is_refused(tmp_path):
    write(tmp_path, [1])
    with pytest.raises(JournalError, match=r"means something else: options=\{'d_max': 1.0\} there, \{'d_max': 0.5\} here"):
        JournalWriter(tmp_path, {"options": {"d_max": 0.5}})
    assert len(segments(tmp_path)) == 1


@pytest.mark.parametrize("segment_bytes", [1, 2000])
def test_old_segments_are_deleted_and_the_latest_kept(tmp_path, segment_bytes):
    write(tmp_path, range(100), keep=40, segment_bytes=segment_bytes)
    found = read(tmp_path)
    assert found == list(range(100))[-len(found) :]
    assert 40 <= len(found) < 80
    # As if another process went on.
    write(tmp_path, range(100, 140), keep=40, segment_bytes=segment_bytes)
    assert read(tmp_path)[-40:] == list(range(100, 140))
    assert len(read(tmp_path)) < 80


def test_a_reader_that_is_behind_goes_on_with_the_oldest_that_is_left(tmp_path):
    write(tmp_path, range(10), segment_bytes=1)
    reader = JournalReader(tmp_path)
    assert len(reader.read(2)) == 2
    for number, path in segments(tmp_path).items():
        if number <= 6:  # the first one has no record
            path.unlink()
    assert [r["obs"]["b"].item() for r in reader.read(10)] == [6, 7, 8, 9]


# One record of 8 numbers takes 32 + 8 + 1 bytes and 24 of a header, and its text.
@pytest.mark.parametrize(
    ("where", "lost"),
    [("content", [1]), ("header", [1]), ("length", [1]), ("cut", [2]), ("rubbish", []), ("middle cut out", [1])],
)
def test_damage_costs_the_record_that_it_is_in(tmp_path, caplog, where, lost):
    write(tmp_path / "first", [8])
    write(tmp_path / "second", [8, 8])
    begin = len(last_segment(tmp_path / "first").read_bytes())  # of the second record, and of the third at `end`
    end = len(last_segment(tmp_path / "second").read_bytes())
    journal = tmp_path / "journal"
    write(journal, [8, 8, 9])
    path = last_segment(journal)
    before = path.read_bytes()
    if where == "cut":
        path.write_bytes(before[:-5])
    elif where == "rubbish":
        path.write_bytes(before[:end] + b"\0" * 100 + before[end:])
    elif where == "middle cut out":
        path.write_bytes(before[: begin + 30] + before[end:])
    else:
        change(path, {"content": end - 4, "header": begin + 1, "length": begin + 6}[where])
    damaged = path.read_bytes()
    if where != "cut":  # which may be a record that is being written
        with pytest.raises(JournalError, match=rf"damaged at byte {end if where == 'rubbish' else begin} .* repair_journal"):
            read(journal)
    with caplog.at_level(logging.WARNING, logger="sb3_ctco.realtime.journal"):
        dropped = repair_journal(journal)
    expected = [k for i, k in enumerate([8, 8, 9]) if i not in lost]
    assert read(journal) == expected
    message = caplog.records[0].getMessage()
    assert f"{dropped} of its {len(damaged)} bytes were dropped, {len(expected)} records are left" in message
    copy = path.with_name(f"{path.name}.damaged")
    assert copy.read_bytes() == damaged
    assert str(copy) in message
    # It is whole, and a second accident keeps the first copy.
    assert repair_journal(journal) == 0
    change(path, -4)
    assert repair_journal(journal) > 0
    assert copy.read_bytes() == damaged
    assert path.with_name(f"{path.name}.damaged2").exists()


def test_every_single_bit_is_noticed(tmp_path):
    write(tmp_path, [2, 3])
    path = last_segment(tmp_path)
    whole = path.read_bytes()
    for position in range(len(whole)):
        for bit in (0, 7):
            change(path, position, lambda byte, bit=bit: byte ^ (1 << bit))
            with pytest.raises(JournalError):
                read(tmp_path)
            path.write_bytes(whole)


def test_a_segment_before_the_last_that_was_cut_off(tmp_path):
    write(tmp_path, [5, 6])
    path = last_segment(tmp_path)
    path.write_bytes(path.read_bytes()[:-1])
    write(tmp_path, [7])
    with pytest.raises(JournalError, match="a record was cut off"):
        read(tmp_path)
    assert repair_journal(tmp_path) > 0
    assert read(tmp_path) == [5, 7]


def test_what_is_no_journal_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no journal in"):
        JournalReader(tmp_path / "nowhere")
    (tmp_path / "journal").write_bytes(b"\x80\x05")
    for call in (JournalReader, repair_journal, lambda folder: JournalWriter(folder, MEANING)):
        with pytest.raises(JournalError, match="earlier release, which could run code when it is read"):
            call(tmp_path / "journal")
    (tmp_path / "000000.journal").write_bytes(b"something else altogether, and long enough for a head")
    with pytest.raises(JournalError, match="is no segment of a journal"):
        JournalReader(tmp_path)
    write(tmp_path / "later", [1])
    path = last_segment(tmp_path / "later")
    head = bytearray(path.read_bytes())
    head[8:12] = struct.pack("<I", 2)
    path.write_bytes(head)
    with pytest.raises(JournalError, match="version 2, and this release reads version 1"):
        JournalReader(tmp_path / "later")


def forge(folder, content, length=None):
    """Append a record whose checksums are right, whatever its content."""
    start = struct.pack("<4sQII", b"REC\xf1", len(content) if length is None else length, 1, zlib.crc32(content))
    with last_segment(folder).open("ab") as file:
        file.write(start + struct.pack("<I", zlib.crc32(start)) + content)


def described(arrays, data=b""):
    text = json.dumps(arrays).encode()
    return struct.pack("<I", len(text)) + text + data


@pytest.mark.parametrize(
    "content",
    [
        b"",
        struct.pack("<I", 2**32 - 1),
        described([[["x"], "|O", [1]]], b"\0" * 8),
        described([[["x"], "<f4,<f4", [1]]], b"\0" * 8),
        described([[["x"], "<U4", [1]]], b"\0" * 16),
        described([[["x"], "no such dtype", [1]]], b"\0" * 8),
        described([[["x"], "<f8", [2**62]]], b"\0" * 8),
        described([[["x"], "<f8", [-1]]], b"\0" * 8),
        described([[["x"], "<f8", [True]]], b"\0" * 8),
        described([[["x"], "<f8", ["1"]]], b"\0" * 8),
        described([[["x"], "<f8", [1]]], b"\0" * 9),
        described([[["x"], "<f8", [1]], [["x", "y"], "<f8", [1]]], b"\0" * 16),
        described([[[], "<f8", [1]]], b"\0" * 8),
        described({"x": 1}),
        described(7),
        struct.pack("<I", 200_000) + b"[" * 200_000,
        struct.pack("<I", 3) + b"\xff\xfe\xfd",
    ],
)
def test_what_somebody_forged_is_an_error_and_no_more(tmp_path, content):
    write(tmp_path, [1])
    forge(tmp_path, content)
    with pytest.raises(JournalError, match=r"malformed|array of numbers|more bytes"):
        read(tmp_path)
    repair_journal(tmp_path)
    assert read(tmp_path) == [1]


def test_a_length_beyond_the_file_takes_no_memory(tmp_path):
    write(tmp_path, [1])
    forge(tmp_path, b"", length=2**62)
    assert read(tmp_path) == [1], "as if it were still being written"
    assert repair_journal(tmp_path) == 24


WITHOUT_UNPICKLING = """
import pickle, sys
import numpy as np
from pathlib import Path
from sb3_ctco.realtime import JournalReader, repair_journal

def refuse(event, arguments):
    if event in ("pickle.find_class", "exec", "compile", "os.system", "subprocess.Popen"):
        raise SystemExit(f"it ran {event} {arguments}")

sys.addaudithook(refuse)
repair_journal(sys.argv[1])
print(len(JournalReader(Path(sys.argv[1])).read(10)))
"""


def test_reading_runs_no_code(tmp_path):
    write(tmp_path, [1, 2, 3])
    command = [sys.executable, "-c", WITHOUT_UNPICKLING, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "3", result.stderr


def test_other_arrays_than_of_numbers_are_an_error_of_the_writer(tmp_path):
    writer = JournalWriter(tmp_path, MEANING)
    writer.add({"a": {"b": np.array(["text"])}})
    with pytest.raises(OSError, match="a/b has dtype <U4"):
        writer.close()


def test_a_full_disk_is_an_error_and_what_was_written_stays(tmp_path):
    resource = pytest.importorskip("resource")
    writer = JournalWriter(tmp_path, MEANING)
    writer.add({"obs": {"a": np.arange(4, dtype=np.float32), "b": np.int64(4)}, "even": np.array([True])})
    path = last_segment(tmp_path)
    deadline = time.monotonic() + 60
    while not read(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.01)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The system takes no byte of a file beyond this one, as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, hard))
    try:
        writer.add({"x": np.zeros(1000)})
        with pytest.raises(OSError, match=f"experience cannot be written to {tmp_path}"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert read(tmp_path) == [4]
    assert repair_journal(tmp_path) == 0, "the part that was written is gone"
    write(tmp_path, [5])
    assert read(tmp_path) == [4, 5]


@pytest.mark.parametrize("left", [b"", b"\0" * 200])
def test_a_segment_that_a_power_cut_left_empty_is_put_aside(tmp_path, caplog, left):
    write(tmp_path, [3, 4])
    path = tmp_path / "000007.journal"
    path.write_bytes(left)
    with caplog.at_level(logging.WARNING, logger="sb3_ctco.realtime.journal"):
        assert repair_journal(tmp_path) == len(left)
    assert "was empty: it is put aside as" in caplog.text
    assert path.with_name("000007.journal.damaged").read_bytes() == left
    check_meaning(tmp_path, MEANING)
    write(tmp_path, [5])
    assert read(tmp_path) == [3, 4, 5]


def test_nothing_is_added_to_a_journal_that_is_closed(tmp_path):
    writer = JournalWriter(tmp_path, MEANING)
    writer.close()
    with pytest.raises(ValueError, match="is closed"):
        writer.add({"number": np.zeros(1)})
    writer = JournalWriter(tmp_path, MEANING)
    writer.add({"number": np.zeros(1)})
    writer.close()
    with pytest.raises(ValueError, match="is closed"):
        writer.add({"number": np.ones(1)})
