"""Safeguards of a recording: disk space, and the payload's mass."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from daq.config.cell import Cell, WeighedPayload
from daq.config.cell_file import URDF
from daq.errors import DiskSpaceShort, OutputFailed, UsageError, writing
from daq.log.container import UNFINISHED
from daq.log.message import currents_bytes, joint_state_bytes, joint_state_prefix, sample_dtype
from daq.log.writer import JOINT_STATE_NS
from ident.model.bodies import Payload

FreeBytes = Callable[[Path], int]  #: Room left for this user on the disk of a folder [bytes]

RESERVE_BYTES = 64 * 2**20
"""Never used: others write to the same disk, and the stop of the axes and the end of the log need
some too.
"""
INDEX_BYTES = 16  #: Index entry of a message, after its chunk
MESSAGE_HEAD_BYTES = 31
CHUNKS_BYTES_S = 4096.0  #: Heads and indexes of the chunks of one second
ENDS_BYTES = 2**16  #: Definitions and metadata, at the start and again at the end


def free_bytes(folder: Path) -> int:
    """Room left for this user on the disk of a folder [bytes];
    OSError when there is no such folder.
    """
    return shutil.disk_usage(folder).free


def largest_log_bytes(
    names: tuple[str, ...], rate_hz: float, duration_s: float, attached: Mapping[str, bytes]
) -> int:
    """Size of a log at most: as if nothing could be compressed [bytes]."""
    zeros = [0.0] * len(names)
    joint_state = joint_state_bytes(joint_state_prefix(names), 0, zeros, zeros)
    currents = currents_bytes(0, zeros)
    sample_bytes = sample_dtype(len(names)).itemsize + INDEX_BYTES
    state_bytes = 2 * (MESSAGE_HEAD_BYTES + INDEX_BYTES) + len(joint_state) + len(currents)
    states_hz = 1e9 / JOINT_STATE_NS
    growth_bytes_s = rate_hz * sample_bytes + states_hz * state_bytes + CHUNKS_BYTES_S
    attached_bytes = sum(map(len, attached.values()))
    # A topic has it too, for viewers
    urdf_bytes = len(attached.get(URDF, b""))
    return round(duration_s * growth_bytes_s) + ENDS_BYTES + attached_bytes + urdf_bytes


class DiskRoom:
    """The room for one log."""

    def __init__(self, log: Path, free: FreeBytes = free_bytes) -> None:
        self._log = log
        self._free = free

    def require(self, needed_bytes: int) -> None:
        """Ask before anything moves.

        Raises:
            DiskSpaceShort: there is less than that, and a reserve.
            OutputFailed: there is no such folder.
        """
        needed = _megabytes(needed_bytes)
        reserve = _megabytes(RESERVE_BYTES)
        self._require(
            needed_bytes + RESERVE_BYTES,
            f"{needed} for the log of this plan and {reserve} in reserve",
            "nothing has moved; free space, name a folder on another disk, or plan a shorter run",
        )

    def check(self) -> None:
        """Ask while the log grows.

        Raises:
            DiskSpaceShort: the reserve is all that is left.
            OutputFailed: the folder has gone.
        """
        folder = self._log.parent
        if not folder.exists():
            part = self._log.name + UNFINISHED
            raise OutputFailed(
                str(self._log),
                found=f"no folder {folder} any more: it was moved or removed during the recording",
                expected="the folder of a log in its place for as long as it is written",
                remedy=f"the axes were sent a stop; what was recorded until then is {part} in the "
                "folder under its new name (`drivegain salvage` saves it), and is lost if the "
                "folder was removed: move the folder back, then record again",
            )
        self._require(
            RESERVE_BYTES,
            f"{_megabytes(RESERVE_BYTES)} in reserve",
            "the axes were sent a stop; the log up to there is finished and marked invalid: free "
            "space, record again",
        )

    def _require(self, least_bytes: int, expected: str, remedy: str) -> None:
        with writing(self._log.parent):
            free = self._free(self._log.parent)
        if free < least_bytes:
            found = f"{_megabytes(free)} left on its disk"
            raise DiskSpaceShort(str(self._log), found=found, expected=expected, remedy=remedy)


def _megabytes(number: int) -> str:
    return f"{number / 1e6:.1f} MB"


_ROUNDING_KG = 1e-9  #: Two spellings of one number are one number


def tolerance_kg(payloads: Iterable[WeighedPayload], name: str) -> float:
    """How far two weighings of a body may differ [kg]; 0 for one that the cell does not have."""
    return next((payload.mass_tolerance_kg for payload in payloads if payload.name == name), 0.0)


def agree(one_kg: float, other_kg: float, within_kg: float) -> bool:
    """Whether two weighings are of the same body."""
    return abs(one_kg - other_kg) <= within_kg + _ROUNDING_KG


def check_entered_mass(cell: Cell, payload: Payload | None, entered_kg: float | None) -> None:
    """Refuse a mass from the scale that is not the cell file's, before anything moves.

    Raises:
        UsageError: it differs by more than the payload's `mass_tolerance_kg`, or nothing is
            mounted.
    """
    if entered_kg is None:
        return
    if payload is None:
        raise UsageError(
            "--mass",
            found=f"{entered_kg:g} kg and no payload",
            expected="the mass of what is mounted",
            remedy="name the payload too, or leave out its mass",
        )
    declared_kg = payload.known["m"]
    within_kg = tolerance_kg(cell.payloads, payload.name)
    if not agree(entered_kg, declared_kg, within_kg):
        raise UsageError(
            f"payload {payload.name!r}",
            found=f"{entered_kg:g} kg from the scale",
            expected=f"{declared_kg:g} kg within {within_kg:g} kg, as in the cell file",
            remedy="weigh it again and correct the wrong one of the two: all gains are in "
            "proportion to this mass",
        )
