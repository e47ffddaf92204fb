"""The answers of the axes to SYNC: the values in each TPDO, and the SYNC to which it belongs.

A TPDO carries no cycle number. An answer that comes after the next SYNC can be distinguished from that SYNC's own
answer only by waiting for both. After a missing frame this is done for one cycle, before the frame counts as lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from drivers.canopen.pdo import AxisPdos, feedback_entries, payload_of, wanted_pdos
from drivers.profiles.profile import Axis


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """Counts of frames up to now; in a sound run all are zero but `cycles`, `frames` and `foreign`."""

    cycles: int = 0  #: SYNCs sent, or followed
    frames: int = 0  #: answers used
    missing: int = 0  #: answers that did not come in their cycle
    late: int = 0  #: answers that came in a later cycle, where that could be known
    duplicate: int = 0  #: second answers of an axis to one SYNC
    surplus: int = 0  #: PDOs of an axis of the cell that are not mapped
    wrong_length: int = 0  #: answers whose length differs from the mapping; they count as missing too
    skipped_periods: int = 0  #: periods without a SYNC because the schedule slipped, or a followed SYNC did not come
    kernel_dropped: int = 0  #: frames of any kind that the kernel dropped because its receive buffer was full
    interface_dropped: int = 0  #: frames dropped by the interface, before the buffer
    backlog_dropped: int = 0  #: frames that the capture process dropped because this process did not read them
    foreign: int = 0  #: PDOs that do no harm: of nodes that are no axes of the cell, or from before the first SYNC


@dataclass(frozen=True, slots=True)
class Slot:
    """Place of the values of one TPDO; column = field × axes + axis, with fields position, current, statusword."""

    axis: int
    bit: int
    length: int
    layout: Struct
    columns: tuple[int, ...]


def slots_of(axes: Sequence[Axis], pdos: Sequence[AxisPdos] | None = None) -> dict[int, Slot]:
    """Return the slot of each COB-ID; `pdos` are those of each axis, None for those that a recording maps."""
    slots: dict[int, Slot] = {}
    for number, (axis, used) in enumerate(zip(axes, pdos or tuple(map(wanted_pdos, axes)), strict=True)):
        entries = feedback_entries(axis)
        for record in used.feedback:
            form, carried = payload_of(record, entries)
            columns = tuple(entries.index(entry) * len(axes) + number for entry in carried)
            slots[record.cob_id & 0x7FF] = Slot(number, 1 << len(slots), form.size, form, columns)
    return slots


class Answers:
    """Assigns answers to cycles and counts them."""

    def __init__(self, axes: Sequence[Axis], pdos: Sequence[AxisPdos] | None = None) -> None:
        self.slots = slots_of(axes, pdos)  #: By COB-ID
        self.values = [0] * (3 * len(axes))  #: Last value of each column
        self.counts: Counter[str] = Counter()  #: By their names in StreamStatistics
        self._all = (1 << len(self.slots)) - 1
        self._owed_slots = 0  # slots whose answer to an earlier SYNC may still come
        self._still_owed = self._answered_slots = 0
        self._last_data: dict[int, bytearray] = {}

    def begin(self) -> None:
        """Begin a cycle."""
        self._still_owed, self._answered_slots = self._owed_slots, 0

    @property
    def complete(self) -> bool:
        """Whether all answers of the cycle have come, and none of an earlier one is open."""
        return self._answered_slots == self._all and not self._still_owed

    @property
    def any(self) -> bool:
        """Whether an answer of the cycle has come."""
        return bool(self._answered_slots)

    def take(self, identifier: int, slot: Slot, data: bytearray) -> None:
        """Accept an answer within a cycle."""
        if self._answered_slots & slot.bit:
            if self._still_owed & slot.bit:
                # The first one was the late answer to an earlier SYNC, this one belongs to the current SYNC.
                self._still_owed &= ~slot.bit
                self.counts["late"] += 1
            else:
                self.counts["duplicate"] += 1
                if self._last_data.get(identifier) == data:
                    return
                # The second answer differs: the first may have been a repetition of the cycle before.
        self._answered_slots |= slot.bit
        self._last_data[identifier] = data
        for column, value in zip(slot.columns, slot.layout.unpack(data), strict=True):
            self.values[column] = value

    def take_between(self, slot: Slot) -> None:
        """Count an answer that is read before the next SYNC, and so belongs to none that is open."""
        if self._owed_slots & slot.bit:
            self._owed_slots &= ~slot.bit
            self.counts["late"] += 1
        else:
            self.counts["duplicate"] += 1

    def end(self) -> int:
        """End a cycle; returns the axes without a complete answer, bit i for axis i."""
        # If only one answer came while two were owed, the older frame is lost; the answer counts for this cycle.
        self._owed_slots = self._all & ~self._answered_slots
        self.counts["frames"] += self._answered_slots.bit_count()
        absent = 0
        if self._owed_slots:
            for slot in self.slots.values():
                if self._owed_slots & slot.bit:
                    absent |= 1 << slot.axis
                    self.counts["missing"] += 1
        return absent
