"""Injected faults: their kind, time and axis, and their effect on the frames that a node sends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class FaultKind(Enum):
    """Kind of fault."""

    # During `cycles`.
    SILENT = "silent"  # neither sends nor receives: no power, cable off
    NO_HEARTBEAT = "no-heartbeat"
    FROZEN = "frozen"  # TPDOs repeat position and current: a dead encoder
    STALE = "stale"  # TPDOs are repeated unchanged: a processor that hangs behind its bus
    LIMIT = "limit"  # statusword bit 11
    LOST = "lost"  # no TPDOs
    LATE = "late"  # TPDOs arrive with the next SYNC
    DUPLICATE = "duplicate"  # TPDOs are sent twice
    SHORT_PDO = "short-pdo"  # TPDOs lack their last byte
    WRONG_COB_ID = "wrong-cob-id"  # TPDOs have the identifier of TPDO4
    SHIFTED = "shifted"  # TPDOs carry another position than 6064h
    SECOND_MASTER = "second-master"  # SYNC from another master, every axis
    SDO_MASTER = "sdo-master"  # SDO requests from another master
    BUS_OFF = "bus-off"  # error frame, then no frame passes, every axis
    # From power-on.
    SYNC_PRODUCER = "sync-producer"  # the amplifier sends a SYNC by itself
    REFUSES_NMT = "refuses-nmt"  # does not go to OPERATIONAL
    REFUSES_MAPPING = "refuses-mapping"  # transmit PDOs cannot be mapped
    OTHER_SERIAL = "other-serial"  # an exchanged amplifier
    NO_GUARD = "no-guard"  # no consumer heartbeat 1016h
    REFUSES_WRITE = "refuses-write"  # gain 2003h cannot be written
    REFUSES_SAVE = "refuses-save"  # 1010h does not store
    # Once, at `at_cycle`.
    EMERGENCY = "emergency"  # EMCY with the code `value`, then FAULT
    FOLLOWING_ERROR = "following-error"
    FALLS_BACK = "falls-back"  # PRE-OPERATIONAL with EMCY 8130h
    REBOOTS = "reboots"  # boot-up message, settings lost
    LOSES_POWER = "loses-power"  # SWITCH ON DISABLED, as after STO
    # Error frame: the controller counts too many errors, every axis
    ERROR_PASSIVE = "error-passive"


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One fault."""

    kind: FaultKind  #: kind of fault
    axis: int | None = None  #: index from 0, or None for all
    at_cycle: int = 0  #: first SYNC since power-on with the fault; 0 is from power-on
    cycles: int | None = None  #: duration, or None without end
    value: int = 0  #: EMCY code (EMERGENCY)

    def active(self, cycle: int) -> bool:
        """Return whether the fault is present in a cycle."""
        if cycle < self.at_cycle:
            return False
        return self.cycles is None or cycle < self.at_cycle + self.cycles

    def concerns(self, axis: int) -> bool:
        """Return whether the fault affects an axis."""
        return self.axis is None or self.axis == axis


Frame = tuple[int, bytes]

FOREIGN_SDO = bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0))  #: SDO request of another master: read 6041h
ERROR_FRAMES = {
    FaultKind.BUS_OFF: (0x040, bytes(8)),
    FaultKind.ERROR_PASSIVE: (0x004, bytes((0, 0x30, 0, 0, 0, 0, 0, 0))),
}
"""Class and data of an error frame of this end's controller (linux/can/error.h): bus-off;
both counters passive.
"""
#: Bytes of a TPDO that hold position and current; the statusword after them is not frozen
_FROZEN_BYTES = 6


class Disturbance:
    """Faults of a cell, applied to each cycle and each frame;
    `cycle` is the number of the last SYNC, from 0.
    """

    def __init__(self, faults: Sequence[FaultSpec]) -> None:
        self._faults = tuple(faults)
        self.cycle = 0
        self._late: list[Frame] = []
        self._frozen: dict[int, bytes] = {}

    def __bool__(self) -> bool:
        return bool(self._faults)

    def active(self, kind: FaultKind, axis: int) -> bool:
        """Return whether a lasting fault affects an axis now."""
        return any(
            f.kind is kind and f.concerns(axis) and f.active(self.cycle) for f in self._faults
        )

    def beginning(self) -> tuple[FaultSpec, ...]:
        """Return the faults that begin in this cycle."""
        return tuple(fault for fault in self._faults if fault.at_cycle == self.cycle)

    def cut_off(self, axis: int) -> bool:
        """Return whether an axis neither sends nor receives."""
        gone = any(f.kind is FaultKind.BUS_OFF and f.active(self.cycle) for f in self._faults)
        return gone or self.active(FaultKind.SILENT, axis)

    def sent(self, axis: int, node_id: int, identifier: int, data: bytes) -> list[Frame]:
        """Return the frames that reach the bus when a node sends one."""
        if self.cut_off(axis):
            return []
        frame = (identifier, data)
        if identifier == 0x700 + node_id and self.active(FaultKind.NO_HEARTBEAT, axis):
            return []
        if identifier != 0x180 + node_id:
            return [frame]
        return self._sent_pdo(axis, node_id, data)

    def _sent_pdo(self, axis: int, node_id: int, data: bytes) -> list[Frame]:
        """Return the frames that reach the bus when a node sends its first PDO."""
        if self.active(FaultKind.LOST, axis):
            return []
        identifier = 0x180 + node_id
        frame = (identifier, data)
        frozen = self.active(FaultKind.FROZEN, axis)
        stale = self.active(FaultKind.STALE, axis)
        if frozen or stale:
            first = self._frozen.setdefault(axis, data)
            frame = (identifier, first)
            if not stale:
                frame = (identifier, first[:_FROZEN_BYTES] + data[_FROZEN_BYTES:])
        else:
            self._frozen.pop(axis, None)
        if self.active(FaultKind.SHIFTED, axis):
            position = int.from_bytes(data[:4], "little", signed=True) + 100_000
            shifted = (position & 0xFFFF_FFFF).to_bytes(4, "little")
            frame = (identifier, shifted + data[4:])
        if self.active(FaultKind.SHORT_PDO, axis):
            frame = (identifier, data[:-1])
        if self.active(FaultKind.WRONG_COB_ID, axis):
            frame = (0x480 + node_id, data)
        if self.active(FaultKind.LATE, axis):
            self._late.append(frame)
            return []
        if self.active(FaultKind.DUPLICATE, axis):
            return [frame, frame]
        return [frame]

    def release(self) -> list[Frame]:
        """Return the TPDOs delayed since the previous SYNC."""
        late = self._late
        self._late = []
        return late
