"""Let amplifiers stop by themselves when the recorder falls silent: killed, hung, or cut off.

The recorder sends a heartbeat while axes have power. Each amplifier watches it (CiA 301, consumer heartbeat time 1016h,
which begins with the first heartbeat). When none comes, it acts by its abort connection option code (CiA 402-2, 6007h):
quick stop.

A heartbeat does not identify its sender. Another device with the recorder's node id would keep the axes running after
the recorder was killed. The recorder therefore takes an id that no device uses, and a foreign heartbeat with it is a
fault. All functions raise ObjectAccessError only when the amplifier does not answer; a refusal is no reason not to
record.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.canopen.sdo import ObjectAccess
from drivers.errors import ObjectAccessError
from drivers.profiles.profile import ObjectEntry

CONSUMERS = ObjectEntry(0x1016, 0, 8, signed=False)
ABORT_CONNECTION = ObjectEntry(0x6007, 0, 16, signed=True)
QUICK_STOP_ON_LOSS = 3
MOST_CONSUMERS = 127  #: Entries that 1016h can have (CiA 301)

Consumers = tuple[tuple[ObjectEntry, int], ...]
"""Entries of 1016h and their values: node id of a heartbeat producer << 16 | time in ms."""


def producer_of(value: int) -> int:
    """Return the node id that an entry of 1016h watches, 0 where it watches none."""
    return value >> 16 & 0x7F if value & 0xFFFF else 0


def read_consumers(access: ObjectAccess) -> Consumers | None:
    """Read 1016h up to the first entry that cannot be read; None where the amplifier has no such object."""
    found: list[tuple[ObjectEntry, int]] = []
    try:
        for sub in range(1, min(access.read(CONSUMERS), MOST_CONSUMERS) + 1):
            entry = ObjectEntry(CONSUMERS.index, sub, 32, signed=False)
            found.append((entry, access.read(entry)))
    except ObjectAccessError as error:
        if error.abort_code is None:
            raise
        return tuple(found) or None
    return tuple(found)


class Guard:
    """The watch of an amplifier over the recorder, by an entry of 1016h that is free or of a killed recorder.

    Args:
        access: to the amplifier.
        consumers: its 1016h.
        left_over: whether the value of an entry watches a killed recorder.
    """

    def __init__(self, access: ObjectAccess, consumers: Consumers | None, left_over: Callable[[int], bool]) -> None:
        self.lack = ""  #: Missing capability, in words; empty when nothing is missing
        self._access = access
        self._consumer: ObjectEntry | None = None
        self._consumer_before = 0
        self._option_before: int | None = None
        for entry, value in consumers or ():
            if (ours := left_over(value)) or not value & 0xFFFF:
                self._consumer, self._consumer_before = entry, 0 if ours else value
                break
        else:
            free = "" if consumers is None else "free "
            self.lack = f"no {free}1016h: it does NOT stop by itself when the recorder is killed"
            return
        self._option_before = access.read_optional(ABORT_CONNECTION, any_abort=True)
        if self._option_before is None:
            self.lack = "no 6007h: when the recorder is killed it stops in the way that its maker decided"

    def describe(self, silence_ms: int) -> str:
        """Describe the guard in words, for the log."""
        if self._consumer is None:
            return self.lack
        return f"watches the recorder by {self._consumer}, {silence_ms} ms" + (f"; {self.lack}" if self.lack else "")

    def arm(self, recorder_id: int, silence_ms: int) -> None:
        """Let the amplifier quick stop after this silence of the recorder, counted from its first heartbeat.

        A refused write is reported in `lack`; the recording goes on.
        """
        if self._consumer is None:
            return
        if self._option_before is not None and (refused := self._refused(ABORT_CONNECTION, QUICK_STOP_ON_LOSS)):
            before, self._option_before = self._option_before, None
            self.lack = f"6007h = {before} rules how it stops when the recorder is killed: 3 is {refused}"
        if refused := self._refused(self._consumer, recorder_id << 16 | silence_ms):
            if self._option_before is not None:
                self._access.write(ABORT_CONNECTION, self._option_before)
            self.lack = f"it does NOT stop by itself when the recorder is killed: 1016h is {refused}"
            self._consumer = None

    def _refused(self, entry: ObjectEntry, value: int) -> str:
        try:
            self._access.write(entry, value)
        except ObjectAccessError as error:
            if error.abort_code is None:
                raise
            return error.reason
        return ""

    def disarm(self) -> None:
        """Restore the original values."""
        if self._consumer is not None:
            self._access.write(self._consumer, self._consumer_before)
            if self._option_before is not None:
                self._access.write(ABORT_CONNECTION, self._option_before)
