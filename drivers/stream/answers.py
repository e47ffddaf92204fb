"""The answers of the axes to SYNC: the values in each TPDO, and the SYNC to which it belongs.

An answer belongs to the SYNC before it on the bus. A TPDO carries no cycle number, so after a
missing answer the next one may be the missing one, late. If two come, the first is the late one. If
one comes, it is doubtful: its sample is marked missing too, and the next cycle waits for two again.
If only one comes there too, the missing answer counts as lost. Should it and all answers since have
been late, then one more comes than SYNCs were sent, at the latest after the last SYNC (unless one
is really lost meanwhile): a duplicate, which no fit accepts. For this `SyncStream.read_on` stops
the SYNC that the stream follows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from drivers.canopen.pdo import AxisPdos, feedback_entries, record_payload, wanted_pdos
from drivers.profiles.profile import Axis


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """Counts of frames up to now; in a sound run all are zero but `cycles`,
    `frames` and `foreign`.
    """

    cycles: int = 0  #: SYNCs sent, or followed
    frames: int = 0  #: answers used
    missing: int = 0  #: answers that did not come in their cycle, and doubtful ones
    late: int = 0  #: answers that came in the next cycle, and doubtful ones
    duplicate: int = 0  #: second answers of an axis to one SYNC
    surplus: int = 0  #: PDOs of an axis of the cell that are not mapped
    #: answers whose length differs from the mapping; within their cycle they count as missing too
    wrong_length: int = 0
    #: periods without a SYNC because the schedule slipped, or a followed SYNC did not come
    skipped_periods: int = 0
    #: frames of any kind that the kernel dropped because its receive buffer was full
    kernel_dropped: int = 0
    interface_dropped: int = 0  #: frames dropped by the interface, before the buffer
    #: frames that the capture process dropped because this process did not read them
    backlog_dropped: int = 0
    #: PDOs that do no harm: of nodes that are no axes of the cell, or from before the first SYNC
    foreign: int = 0


@dataclass(frozen=True, slots=True)
class Slot:
    """Place of the values of one TPDO; column = field × axes + axis, with fields position, current,
    statusword.
    """

    axis: int  #: index
    bit: int  #: of this slot in the masks
    length: int  #: of its data [bytes]
    layout: Struct  #: of its data
    columns: tuple[int, ...]  #: in `Answers.values`


def slots_of(axes: Sequence[Axis], pdos: Sequence[AxisPdos] | None = None) -> dict[int, Slot]:
    """Return the slot of each COB-ID; `pdos` are those of each axis,
    None for those that a recording maps.
    """
    slots: dict[int, Slot] = {}
    for number, (axis, used) in enumerate(
        zip(axes, pdos or tuple(map(wanted_pdos, axes)), strict=True)
    ):
        entries = feedback_entries(axis)
        for record in used.feedback:
            form, carried = record_payload(record, entries)
            columns = tuple(entries.index(entry) * len(axes) + number for entry in carried)
            slots[record.cob_id & 0x7FF] = Slot(number, 1 << len(slots), form.size, form, columns)
    return slots


class Answers:
    """Assigns answers to cycles and counts them.

    Args:
        axes: of the cell.
        pdos: of each axis; those of most drives where there are none.
        certain: no answer is late, because each cycle waited long enough for it; none is doubtful
            then.
    """

    def __init__(
        self, axes: Sequence[Axis], pdos: Sequence[AxisPdos] | None = None, *, certain: bool = False
    ) -> None:
        self._certain = certain
        self.slots = slots_of(axes, pdos)  #: By COB-ID
        self.values = [0] * (3 * len(axes))  #: Last value of each column
        self.counts: Counter[str] = Counter()  #: By their names in StreamStatistics
        self._all = (1 << len(self.slots)) - 1
        self._owed_slots = 0  # slots whose answer to a SYNC before may still come
        self._missed_slots = 0  # those that did not answer the SYNC before at all
        self._still_owed = self._answered_slots = 0
        # Values before a doubtful answer, by the bit of its slot
        self._before: dict[int, list[int]] = {}
        self._last_data: dict[int, bytearray] = {}

    def begin(self) -> None:
        """Begin a cycle."""
        self._still_owed = self._owed_slots
        self._answered_slots = 0
        self._before.clear()

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
                # The first one was the late answer to an earlier SYNC, this one belongs to the
                # current SYNC.
                self._still_owed &= ~slot.bit
                self._before.pop(slot.bit, None)
                self.counts["late"] += 1
            else:
                self.counts["duplicate"] += 1
                if self._last_data.get(identifier) == data:
                    return
                # The second answer differs: the first may have been a repetition of the cycle
                # before.
        elif self._still_owed & self._missed_slots & slot.bit and not self._certain:
            self._before[slot.bit] = [self.values[column] for column in slot.columns]
        self._answered_slots |= slot.bit
        self._last_data[identifier] = data
        for column, value in zip(slot.columns, slot.layout.unpack(data), strict=True):
            self.values[column] = value

    def take_between(self, slot: Slot) -> None:
        """Count an answer that is read before the next SYNC,
        and so belongs to none that is open.
        """
        if self._owed_slots & slot.bit:
            self._owed_slots &= ~slot.bit
            self._missed_slots &= ~slot.bit
            self.counts["late"] += 1
        else:
            self.counts["duplicate"] += 1

    def leave(self) -> None:
        """End a cycle of which no sample is made, or begin to end one."""
        self._missed_slots = self._all & ~self._answered_slots
        self._owed_slots = self._missed_slots | sum(self._before)

    def end(self) -> int:
        """End a cycle; returns the axes without a complete answer, bit i for axis i."""
        self.leave()
        if not self._owed_slots:
            self.counts["frames"] += self._answered_slots.bit_count()
            return 0
        absent = 0
        for slot in self.slots.values():
            if slot.bit in self._before:
                for column, value in zip(slot.columns, self._before[slot.bit], strict=True):
                    self.values[column] = value
                self.counts["late"] += 1
            elif not self._missed_slots & slot.bit:
                self.counts["frames"] += 1
                continue
            absent |= 1 << slot.axis
            self.counts["missing"] += 1
        return absent
