"""Room on the disk for a recording: asked before anything moves, watched while it runs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from daq.errors import DiskSpaceShort, OutputFailed
from daq.log.message import joint_state_bytes, joint_state_prefix, sample_dtype
from daq.log.writer import JOINT_STATE_NS

FreeBytes = Callable[[Path], int]
"""Room left for this user on the disk of a folder [bytes]."""

RESERVE_BYTES = 64 * 2**20
"""Never used: others write to the same disk, and the stop of the axes and the end of the log need some too."""
INDEX_BYTES = 16
"""Of each message, in the index behind its chunk."""
MESSAGE_HEAD_BYTES = 31
CHUNKS_BYTES_S = 4096.0
"""Of each second: heads and indexes of its chunks."""
ENDS_BYTES = 2**16
"""Definitions and metadata, at the start and again at the end."""


def free_bytes(folder: Path) -> int:
    """Room left for this user on the disk of a folder [bytes]; OSError when there is no such folder."""
    return shutil.disk_usage(folder).free


def largest_log_bytes(names: tuple[str, ...], rate_hz: float, duration_s: float, attached: Mapping[str, bytes]) -> int:
    """Size of a log at most: as if nothing could be compressed [bytes].

    Args:
        names: of the axes.
        rate_hz: samples a second.
        duration_s: of the run [s].
        attached: what stands at its start.
    """
    state = joint_state_bytes(joint_state_prefix(names), 0, [0.0] * len(names))
    of_samples = rate_hz * (sample_dtype(len(names)).itemsize + INDEX_BYTES)
    of_states = 1e9 / JOINT_STATE_NS * (MESSAGE_HEAD_BYTES + len(state) + INDEX_BYTES)
    growth_bytes_s = of_samples + of_states + CHUNKS_BYTES_S
    return round(duration_s * growth_bytes_s) + ENDS_BYTES + sum(map(len, attached.values()))


class DiskRoom:
    """The room for one log.

    Args:
        log: to be written.
        free: tells the room.
    """

    def __init__(self, log: Path, free: FreeBytes = free_bytes) -> None:
        self._log = log
        self._free = free

    def require(self, needed_bytes: int) -> None:
        """Ask before anything moves.

        Raises:
            DiskSpaceShort: there is less than that, and a reserve.
            OutputFailed: there is no such folder.
        """
        free = self._ask()
        if free < needed_bytes + RESERVE_BYTES:
            raise DiskSpaceShort(
                str(self._log.parent),
                found=f"{_megabytes(free)} free",
                expected=f"{_megabytes(needed_bytes)} for the log of this plan and {_megabytes(RESERVE_BYTES)} in "
                "reserve",
                remedy="nothing has moved; free space, name a folder on another disk, or plan a shorter run",
            )

    def check(self) -> None:
        """Ask while the log grows.

        Raises:
            DiskSpaceShort: the reserve is all that is left.
            OutputFailed: the folder has gone.
        """
        free = self._ask()
        if free < RESERVE_BYTES:
            raise DiskSpaceShort(
                str(self._log),
                found=f"{_megabytes(free)} left on its disk",
                expected=f"{_megabytes(RESERVE_BYTES)} in reserve",
                remedy="the axes were told to stop; the log up to there is finished and marked invalid: free space and "
                "record again",
            )

    def _ask(self) -> int:
        try:
            return self._free(self._log.parent)
        except OSError as error:
            raise OutputFailed.of(self._log.parent, error) from error


def _megabytes(number: int) -> str:
    return f"{number / 1e6:.1f} MB"
