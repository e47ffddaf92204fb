"""What goes wrong in a simulated cell, when, and on which axis: part of its truth, frozen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class FaultKind(Enum):
    """One way to fail. Of a kind that lasts, `cycles` tells how long; the others happen once.

    Lasting: SILENT (deaf and mute: no power, cable off), NO_HEARTBEAT, FROZEN (its TPDOs repeat position and current: a
    dead encoder), STALE (its TPDOs are repeated whole: a processor that hangs behind its bus), LIMIT (statusword bit
    11), LOST, LATE (TPDOs that come with the next SYNC), DUPLICATE (TPDOs sent twice), SHORT_PDO (TPDOs that lack their
    last byte), WRONG_COB_ID (TPDOs under the identifier of TPDO4), SHIFTED (TPDOs carry another position than 6064h),
    SECOND_MASTER (somebody else's SYNC, whole cell), SDO_MASTER (somebody else's SDO requests to the axis),
    SYNC_PRODUCER (the axis sends a SYNC by itself), BUS_OFF (an error frame of this end; then nobody hears or is heard,
    whole cell); and from power-on for ever: REFUSES_NMT (it does not go to OPERATIONAL), REFUSES_MAPPING (its TPDOs
    cannot be mapped), OTHER_SERIAL (an exchanged amplifier), NO_GUARD (it has no 1016h), REFUSES_WRITE (its gain 2003h
    cannot be written), REFUSES_SAVE (1010h does not store).

    Once: EMERGENCY (an EMCY of the code `value`, and FAULT), FOLLOWING_ERROR, FALLS_BACK (PRE-OPERATIONAL with EMCY
    8130h), REBOOTS (reset: boot-up message, settings lost), LOSES_POWER (SWITCH ON DISABLED by itself, as STO does),
    ERROR_PASSIVE (an error frame says that the controller counts too many errors, whole cell).
    """

    SILENT = "silent"
    NO_HEARTBEAT = "no-heartbeat"
    FROZEN = "frozen"
    STALE = "stale"
    LIMIT = "limit"
    LOST = "lost"
    LATE = "late"
    DUPLICATE = "duplicate"
    SHORT_PDO = "short-pdo"
    WRONG_COB_ID = "wrong-cob-id"
    SHIFTED = "shifted"
    REFUSES_NMT = "refuses-nmt"
    REFUSES_MAPPING = "refuses-mapping"
    OTHER_SERIAL = "other-serial"
    NO_GUARD = "no-guard"
    REFUSES_WRITE = "refuses-write"
    REFUSES_SAVE = "refuses-save"
    SECOND_MASTER = "second-master"
    SDO_MASTER = "sdo-master"
    SYNC_PRODUCER = "sync-producer"
    EMERGENCY = "emergency"
    FOLLOWING_ERROR = "following-error"
    FALLS_BACK = "falls-back"
    REBOOTS = "reboots"
    LOSES_POWER = "loses-power"
    BUS_OFF = "bus-off"
    ERROR_PASSIVE = "error-passive"


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One fault.

    Attributes:
        kind: what goes wrong.
        axis: index from 0, or None for all.
        at_cycle: number of the SYNC since power-on that it comes with; 0 is from power-on.
        cycles: how many it lasts, None for ever.
        value: EMCY code (EMERGENCY).
    """

    kind: FaultKind
    axis: int | None = None
    at_cycle: int = 0
    cycles: int | None = None
    value: int = 0

    def active(self, cycle: int) -> bool:
        """Whether it lasts in this cycle."""
        return self.at_cycle <= cycle and (self.cycles is None or cycle < self.at_cycle + self.cycles)

    def concerns(self, axis: int) -> bool:
        """Whether it is on this axis."""
        return self.axis is None or self.axis == axis


# The faults of a simulated cell between its nodes and its bus: what becomes of every frame.


Frame = tuple[int, bytes]

FOREIGN_SDO = bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0))
"""Somebody reads 6041h."""
ERROR_FRAMES = {
    FaultKind.BUS_OFF: (0x040, bytes(8)),
    FaultKind.ERROR_PASSIVE: (0x004, bytes((0, 0x30, 0, 0, 0, 0, 0, 0))),
}
"""Class and data of an error frame of this end's controller (linux/can/error.h): bus-off; both counters passive."""
_FROZEN_BYTES = 6
"""Of a TPDO: position and current; the statusword behind them goes on."""


class Disturbance:
    """Asked by the cell in every cycle and for every frame.

    Attributes:
        cycle: number of the last SYNC, from 0; also before the first one.
    """

    def __init__(self, faults: Sequence[FaultSpec]) -> None:
        self._faults = tuple(faults)
        self.cycle = 0
        self._held: list[Frame] = []
        self._frozen: dict[int, bytes] = {}

    def __bool__(self) -> bool:
        return bool(self._faults)

    def active(self, kind: FaultKind, axis: int) -> bool:
        """Whether a lasting fault acts on an axis now."""
        return any(f.kind is kind and f.concerns(axis) and f.active(self.cycle) for f in self._faults)

    def beginning(self) -> tuple[FaultSpec, ...]:
        """Faults whose first cycle this is."""
        return tuple(fault for fault in self._faults if fault.at_cycle == self.cycle)

    def cut_off(self, axis: int) -> bool:
        """Whether an axis neither hears nor is heard."""
        gone = any(f.kind is FaultKind.BUS_OFF and f.active(self.cycle) for f in self._faults)
        return gone or self.active(FaultKind.SILENT, axis)

    def sent(self, axis: int, node_id: int, identifier: int, data: bytes) -> list[Frame]:
        """What comes onto the bus of a frame that a node sends."""
        if self.cut_off(axis):
            return []
        frame = (identifier, data)
        if identifier == 0x700 + node_id:
            return [] if self.active(FaultKind.NO_HEARTBEAT, axis) else [frame]
        if identifier != 0x180 + node_id:
            return [frame]
        if self.active(FaultKind.LOST, axis):
            return []
        frozen, stale = self.active(FaultKind.FROZEN, axis), self.active(FaultKind.STALE, axis)
        if frozen or stale:
            kept = self._frozen.setdefault(axis, data)
            frame = (identifier, kept if stale else kept[:_FROZEN_BYTES] + data[_FROZEN_BYTES:])
        else:
            self._frozen.pop(axis, None)
        if self.active(FaultKind.SHIFTED, axis):
            position = int.from_bytes(data[:4], "little", signed=True) + 100_000
            frame = (identifier, (position & 0xFFFF_FFFF).to_bytes(4, "little") + data[4:])
        if self.active(FaultKind.SHORT_PDO, axis):
            frame = (identifier, data[:-1])
        if self.active(FaultKind.WRONG_COB_ID, axis):
            frame = (0x480 + node_id, data)
        if self.active(FaultKind.LATE, axis):
            self._held.append(frame)
            return []
        return [frame, frame] if self.active(FaultKind.DUPLICATE, axis) else [frame]

    def release(self) -> list[Frame]:
        """Frames that were held since the SYNC before."""
        held, self._held = self._held, []
        return held
