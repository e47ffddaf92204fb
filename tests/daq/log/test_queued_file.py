"""A file that a thread writes: what it takes, what a slow disk does, and what the disk refuses."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.log.queued_file import BEHIND_S, QueuedFile
from daq.log.writer import LogWriter
from tests.daq.log.disks import Disk, refuse
from tests.daq.logs import content, joints, samples

WAIT_S = 30.0  #: Longer than any step of these tests, so that a failure ends


class Stall:
    """What happens before a write to a disk that takes nothing until the test permits it."""

    def __init__(self) -> None:
        """Begin to take nothing."""
        self.is_asked = threading.Event()
        self.is_over = threading.Event()

    def __call__(self) -> None:
        """Wait until the stall is over."""
        self.is_asked.set()
        assert self.is_over.wait(WAIT_S)


def _new(path: Path) -> io.FileIO:
    return path.open("xb", buffering=0)


@settings(deadline=None, max_examples=50)
@given(pieces=st.lists(st.binary(max_size=300), max_size=20), largest_bytes=st.integers(1, 50))
def test_pieces_are_written_in_order_where_the_disk_takes_a_part_at_a_time(
    tmp_path_factory: pytest.TempPathFactory, pieces: list[bytes], largest_bytes: int
) -> None:
    path = tmp_path_factory.mktemp("queued") / "log"
    disk = Disk(_new(path), lambda: None, largest_bytes)
    with QueuedFile(disk) as file:
        for piece in pieces:
            assert file.write(piece) == len(piece)
        size_bytes = file.tell()
    whole = b"".join(pieces)
    assert path.read_bytes() == whole
    assert size_bytes == len(whole)


def test_a_write_returns_while_the_disk_takes_nothing(tmp_path: Path) -> None:
    stall = Stall()
    path = tmp_path / "log"
    with QueuedFile(Disk(_new(path), stall)) as file:
        file.write(b"one ")
        assert stall.is_asked.wait(WAIT_S)
        file.write(b"two")
        assert path.read_bytes() == b""
        stall.is_over.set()
        file.drain()
        assert path.read_bytes() == b"one two"


def test_the_longest_wait_is_that_of_the_disk(tmp_path: Path) -> None:
    now_s = 10.0
    stall = Stall()
    with QueuedFile(Disk(_new(tmp_path / "log"), stall), lambda: now_s) as file:
        file.write(b"one")
        assert stall.is_asked.wait(WAIT_S)
        now_s = 10.7
        stall.is_over.set()
        file.drain()
        assert file.longest_wait_s == pytest.approx(0.7)
        file.write(b"two")
        file.drain()
        assert file.longest_wait_s == pytest.approx(0.7)


def test_a_disk_that_is_too_far_behind_is_an_error(tmp_path: Path) -> None:
    now_s = 0.0
    stall = Stall()
    path = tmp_path / "log"
    with QueuedFile(Disk(_new(path), stall), lambda: now_s) as file:
        file.write(b"one ")
        assert stall.is_asked.wait(WAIT_S)
        now_s = 0.9 * BEHIND_S
        file.write(b"two")
        now_s = 1.1 * BEHIND_S
        with pytest.raises(OSError, match="more than 5 s behind"):
            file.write(b"three")
        stall.is_over.set()
    assert path.read_bytes() == b"one two"


def test_a_disk_that_catches_up_is_not_behind(tmp_path: Path) -> None:
    """What counts is the age of what the disk does not have, and not that of the file."""
    now_s = 0.0
    with QueuedFile(_new(tmp_path / "log"), lambda: now_s) as file:
        for _ in range(3):
            now_s += 2.0 * BEHIND_S
            file.write(b"piece")
            file.drain()
        assert file.longest_wait_s == 0.0


def test_what_the_disk_refuses_is_raised_by_the_next_call(tmp_path: Path) -> None:
    path = tmp_path / "log"
    file = QueuedFile(Disk(_new(path), refuse))
    file.write(b"one")
    calls: list[Callable[[], object]] = [file.drain, lambda: file.write(b"two"), file.close]
    for call in calls:
        with pytest.raises(OSError, match="No space left"):
            call()
    assert file.closed
    assert path.read_bytes() == b""


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
