"""A file that a thread writes: what it takes, what a slow disk does, and what the disk refuses."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.log.queued_file import STALLED_S, QueuedFile
from daq.log.writer import LogWriter
from tests.daq.logs import content, joints, samples

WAIT_S = 30.0  #: Longer than any step of these tests, so that a failure ends


class SlowDisk:
    """`os.write` of a disk that takes nothing until it is told to."""

    def __init__(self) -> None:
        """Begin as a disk that takes nothing."""
        self.is_asked = threading.Event()
        self.may_take = threading.Event()

    def write(self, descriptor: int, data: memoryview) -> int:
        """Take some bytes once that is permitted."""
        self.is_asked.set()
        assert self.may_take.wait(WAIT_S)
        return os.write(descriptor, data)


def refuse(descriptor: int, data: memoryview) -> int:
    """`os.write` of a disk that is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@settings(deadline=None, max_examples=50)
@given(pieces=st.lists(st.binary(max_size=300), max_size=20), portion=st.integers(1, 50))
def test_pieces_are_written_in_order_where_the_disk_takes_a_part_at_a_time(
    tmp_path_factory: pytest.TempPathFactory, pieces: list[bytes], portion: int
) -> None:
    path = tmp_path_factory.mktemp("queued") / "log"

    def write_portion(descriptor: int, data: memoryview) -> int:
        return os.write(descriptor, data[:portion])

    with QueuedFile.create(path, write_portion) as file:
        for piece in pieces:
            assert file.write(piece) == len(piece)
        size_bytes = file.tell()
    whole = b"".join(pieces)
    assert path.read_bytes() == whole
    assert size_bytes == len(whole)


def test_a_write_returns_while_the_disk_takes_nothing(tmp_path: Path) -> None:
    disk = SlowDisk()
    path = tmp_path / "log"
    with QueuedFile.create(path, disk.write) as file:
        file.write(b"one ")
        assert disk.is_asked.wait(WAIT_S)
        file.write(b"two")
        assert path.read_bytes() == b""
        disk.may_take.set()
        file.drain()
        assert path.read_bytes() == b"one two"


def test_the_longest_wait_is_that_of_the_disk(tmp_path: Path) -> None:
    now_s = 10.0
    disk = SlowDisk()
    with QueuedFile.create(tmp_path / "log", disk.write, lambda: now_s) as file:
        file.write(b"one")
        assert disk.is_asked.wait(WAIT_S)
        now_s = 10.7
        disk.may_take.set()
        file.drain()
        assert file.longest_wait_s == pytest.approx(0.7)
        file.write(b"two")
        file.drain()
        assert file.longest_wait_s == pytest.approx(0.7)


@pytest.mark.parametrize("after_s", [0.9 * STALLED_S, 1.1 * STALLED_S])
def test_a_disk_that_takes_nothing_for_long_is_an_error(tmp_path: Path, after_s: float) -> None:
    now_s = 0.0
    disk = SlowDisk()
    with QueuedFile.create(tmp_path / "log", disk.write, lambda: now_s) as file:
        file.write(b"one")
        assert disk.is_asked.wait(WAIT_S)
        now_s = after_s
        if after_s > STALLED_S:
            with pytest.raises(OSError, match="took nothing for 5 s"):
                file.write(b"two")
        else:
            file.write(b"two")
        disk.may_take.set()


def test_what_the_disk_refuses_is_raised_by_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "log"
    file = QueuedFile.create(path, refuse)
    file.write(b"one")
    with pytest.raises(OSError, match="No space left"):
        file.drain()
    with pytest.raises(OSError, match="No space left"):
        file.write(b"two")
    with pytest.raises(OSError, match="No space left"):
        file.close()
    assert file.closed
    assert path.read_bytes() == b""


def test_a_file_of_that_name_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"before")
    with pytest.raises(FileExistsError):
        QueuedFile.create(path)
    assert path.read_bytes() == b"before"


def test_a_log_that_a_thread_writes_is_the_log_of_a_writer_that_waits(tmp_path: Path) -> None:
    rows = samples([[number, -number] for number in range(700)])
    contents = []
    for waits_for_disk in (True, False):
        path = tmp_path / f"{waits_for_disk}.mcap"
        with LogWriter(
            path, content(2), joints, clock_ns=lambda: 0, waits_for_disk=waits_for_disk
        ) as log:
            for sample in rows:
                log.write(sample)
            log.conclude(valid=True)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]
