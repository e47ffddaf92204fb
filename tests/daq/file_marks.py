"""Marks of a file system, as chattr sets them."""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

# ioctl_iflags(2): commands and bits
_FS_IOC_GETFLAGS = 0x80086601
_FS_IOC_SETFLAGS = 0x40086602
IMMUTABLE = 0x10
APPEND_ONLY = 0x20


@contextmanager
def file_mark(place: Path, bit: int) -> Iterator[None]:
    """Mark a file or folder for a while; the test is skipped where that cannot be done."""
    try:
        _mark(place, bit, is_set=True)
    except OSError as error:
        pytest.skip(f"this user or file system sets no such mark: {error.strerror}")
    try:
        yield
    finally:
        _mark(place, bit, is_set=False)


def _mark(place: Path, bit: int, *, is_set: bool) -> None:
    """Set or clear one mark.

    Raises:
        OSError: user or file system cannot.
    """
    descriptor = os.open(place, os.O_RDONLY)
    answer = bytearray(struct.calcsize("l"))
    try:
        fcntl.ioctl(descriptor, _FS_IOC_GETFLAGS, answer)
        marks = struct.unpack("l", answer)[0] & ~bit
        if is_set:
            marks |= bit
        fcntl.ioctl(descriptor, _FS_IOC_SETFLAGS, struct.pack("l", marks))
    finally:
        os.close(descriptor)
