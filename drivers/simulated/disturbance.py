"""The faults of a simulated cell between its nodes and its bus: what becomes of every frame."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.simulated.fault import FaultKind, FaultSpec

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
