"""When the next SYNC goes out, and what time it stands for.

Samples and events of all pacings have one epoch: wall time [ns since 1970] at the stream's first SYNC, plus the time
that has passed since, which no setting of the wall clock changes. On SocketCAN a SYNC's time is the kernel's, taken to
the monotonic clock (drivers/stream/capture.py); the clock must then be that one.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import SYNC_COB_ID
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import Clock
from drivers.errors import WHILE, BusError, DriverError
from drivers.profiles.profile import ObjectEntry


@dataclass(frozen=True, slots=True)
class LockstepSync:
    """The next SYNC goes out when the last one is answered: for a cell whose time is the SYNC itself.

    The samples' time is made up, a period a cycle: that is true of a simulated cell alone.

    Attributes:
        period_ns: what one cycle stands for [ns].
        timeout_s: how long one cycle waits for its answers [s of the clock].
        start_ns: wall time of cycle 0 [ns since 1970].
        clock: for the time-out and the heartbeats [ns].
    """

    period_ns: int
    timeout_s: float = 1.0
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


@dataclass(frozen=True, slots=True)
class TimedSync:
    """A SYNC every period by the clock, on an absolute schedule that starts with the first one.

    A schedule that slips by whole periods leaves them out, counted; it never sends a burst to catch up.

    Attributes:
        period_ns: of the schedule [ns].
        start_ns: wall time of the first SYNC [ns since 1970].
        clock: monotonic; what has passed by it since the first SYNC is added to start_ns [ns].
    """

    period_ns: int
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


def ignore(monotonic_ns: int, periods: int) -> None:
    """For a producer that keeps its period by itself."""


@dataclass(frozen=True, slots=True)
class FollowedSync:
    """Somebody else sends SYNC, told so by us (drivers/stream/sync.py): a cycle begins with each one that is seen.

    What belongs to which cycle is decided by the order of the frames on the bus: a reader that is late loses nothing.

    Attributes:
        period_ns: of the producer [ns].
        producer: its name, for messages.
        in_kernel: the producer is this machine's kernel; a SYNC from the wire is then somebody else's.
        timeout_s: without a SYNC, whatever else is on the bus, after which the producer is taken for dead; the stream
            then sends SYNC itself, because the axes are stopped by frames that act on SYNC.
        seen: told the monotonic time of each SYNC [ns], and how many periods after the one before it came.
        start_ns: wall time of the first SYNC [ns since 1970].
        clock: monotonic; what has passed by it since the first SYNC is added to start_ns [ns].
    """

    period_ns: int
    producer: str
    in_kernel: bool = False
    timeout_s: float = 0.1
    seen: Callable[[int, int], None] = ignore
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


Pacing = LockstepSync | TimedSync | FollowedSync


# Who sends SYNC instead of the recorder: this machine's kernel, or one of the drives; and who told them to stop.
#
# A producer is started once the network is prepared and stopped before the network is left:
#
#     with CanopenNetwork(...) as network, KernelProducer(network, period_us) as producer:
#         network.prepare()
#         producer.start()


SYNC_COB_ID_OBJECT = ObjectEntry(0x1005, 0, 32, signed=False)
CYCLE_PERIOD = ObjectEntry(0x1006, 0, 32, signed=False)
"""In us; a producer sends none while it is 0 (CiA 301)."""
PRODUCES = 1 << 30
STEERING_S = 0.25
"""Between two corrections of the kernel's interval."""
LARGEST_CORRECTION = 0.2
"""Of the period; where the kernel is later than that, the time stamps are to be refused."""
_TX_SETUP, _SET_TIMER, _SET_AND_START_TIMER = 1, 0x1, 0x3  # linux/can/bcm.h
# struct bcm_msg_head: opcode, flags, count, two intervals of (s, us), identifier, number of frames; then can_frame.
_HEAD, _FRAME = struct.Struct("@3I4l2I0q"), struct.Struct("=IB3x8s")


def steered_us(period_us: int, interval_us: int, late_ns: int, phase_ns: int, periods: int) -> int:
    """The interval to tell the kernel for the next window [us].

    What it was late in the last window it will be late again, and the phase is to be made up within one window.

    Args:
        period_us: wanted.
        interval_us: that the kernel has now.
        late_ns: how much longer than its periods the last window was.
        phase_ns: how late its last SYNC was in the whole schedule.
        periods: in a window.
    """
    wanted_us = interval_us - (late_ns + phase_ns) / (1000 * periods)
    return round(min(max(wanted_us, (1.0 - LARGEST_CORRECTION) * period_us), (1.0 + LARGEST_CORRECTION) * period_us))


def _setup(flags: int, interval_us: int) -> bytes:
    seconds, rest_us = divmod(interval_us, 1_000_000)
    head = _HEAD.pack(_TX_SETUP, flags, 0, 0, 0, seconds, rest_us, SYNC_COB_ID, 1)
    return head + _FRAME.pack(SYNC_COB_ID, 0, bytes(8))


class KernelProducer:
    """The kernel's broadcast manager (CAN_BCM): a timer of the kernel's, no process has to wake up for it.

    It ends with the process that started it, however that ends. It counts each interval from when the last SYNC really
    went out, so its period is too long by what the timer is late: `seen` measures that, and sets the interval shorter.

    Args:
        network: on SocketCAN.
        period_us: of SYNC.
    """

    name = "the kernel"

    def __init__(self, network: CanopenNetwork, period_us: int) -> None:
        self._link = network.link
        self._period_us = period_us
        self._socket: socket.socket | None = None
        self._interval_us = period_us
        self._window = max(8, round(STEERING_S * 1e6 / period_us))
        self._begun_ns = self._phase_ns = self._periods = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Send SYNC from now on.

        Raises:
            BusError: the kernel has no broadcast manager, or the bus is none of its.
        """
        address = self._link.address
        if not isinstance(address, BusAddress) or address.interface != "socketcan":
            raise BusError(str(address), "SYNC by the kernel needs one bus of interface socketcan")
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_BCM)
            self._socket.connect((address.channel,))
            self._link.sync_producer = self.name
            self._socket.send(_setup(_SET_AND_START_TIMER, self._interval_us))
        except OSError as error:
            self.stop()
            name = errno.errorcode.get(error.errno or 0, "")
            reason = f"SYNC by the kernel: {os.strerror(error.errno or 0)} {name}; modprobe can-bcm?"
            raise BusError(str(address), reason) from error

    def seen(self, monotonic_ns: int, periods: int) -> None:
        """Take note of a SYNC, so that on average they come at the period and stay in phase with the first.

        Args:
            monotonic_ns: when it went out [ns].
            periods: since the one before; 0 for the first, where the schedule begins.

        Raises:
            OSError: the kernel takes no interval any more.
        """
        if periods == 0:
            self._begun_ns, self._phase_ns, self._periods = monotonic_ns, 0, 0
            return
        self._periods += periods
        if self._periods < self._window or self._socket is None:
            return
        late_ns = monotonic_ns - self._begun_ns - 1000 * self._period_us * self._periods
        self._phase_ns += late_ns
        interval_us = steered_us(self._period_us, self._interval_us, late_ns, self._phase_ns, self._periods)
        self._begun_ns, self._periods = monotonic_ns, 0
        if interval_us != self._interval_us:
            self._interval_us = interval_us
            self._socket.send(_setup(_SET_TIMER, interval_us))

    def stop(self) -> None:
        """Send no more; nothing happens when it did not start."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._link.sync_producer = None, None


class DriveProducer:
    """A drive of the cell, by its objects 1005h (bit 30) and 1006h; both are given back as they were.

    Args:
        network: that the drive belongs to.
        axis: index of the axis.
        period_us: of SYNC.
    """

    def __init__(self, network: CanopenNetwork, axis: int, period_us: int) -> None:
        self.name = network.axes[axis].name
        self._network = network
        self._node_id = network.node_ids[axis]
        self._period_us = period_us
        self._before: tuple[int, int] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.stop()
        except DriverError as problem:
            if error is None:
                raise
            error.add_note(f"{WHILE}stopping SYNC: {problem}")

    def seen(self, monotonic_ns: int, periods: int) -> None:
        """A drive keeps its period by itself."""

    def start(self) -> None:
        """Tell the drive to send SYNC.

        Raises:
            ObjectAccessError: it cannot, or does not answer.
        """
        access = self._network.link.objects(self._node_id)
        self._before = (access.read(SYNC_COB_ID_OBJECT), access.read(CYCLE_PERIOD))
        self._network.link.sync_producer = self.name
        # CiA 301: the period may be refused while the drive produces, so production begins last and ends first.
        access.write(SYNC_COB_ID_OBJECT, SYNC_COB_ID)
        access.write(CYCLE_PERIOD, self._period_us)
        access.write(SYNC_COB_ID_OBJECT, SYNC_COB_ID | PRODUCES)

    def stop(self) -> None:
        """Give both objects back; nothing happens when it was not started, or does not answer any more.

        Raises:
            ObjectAccessError: the drive refuses.
        """
        before, self._before = self._before, None
        try:
            if before is not None and self._node_id not in self._network.link.silent:
                access = self._network.link.objects(self._node_id)
                access.write(SYNC_COB_ID_OBJECT, before[0] & ~PRODUCES)
                access.write(CYCLE_PERIOD, before[1])
                if before[0] & PRODUCES:
                    access.write(SYNC_COB_ID_OBJECT, before[0])
        finally:
            self._network.link.sync_producer = None


SyncProducer = KernelProducer | DriveProducer


# Whether more SYNCs come than the one producer sends that we know of.


SURPLUS = 3.0
"""SYNCs ahead of the period: what a late producer catches up with is one or two."""
DECAY = 0.99
"""Of what a SYNC was ahead, after the next: clocks differ by some tens of ppm for ever, which adds up to nothing so."""


class SyncRate:
    """Followed SYNCs against their period.

    A SYNC of somebody else looks like the producer's own; but then too many come. Jitter cancels out: who comes late
    once comes early after it.

    Args:
        period_ns: of the producer [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ahead = 0.0

    def too_fast(self, since_last_ns: int) -> bool:
        """Whether this SYNC, so long after the one before, is one too many."""
        self._ahead = max(-1.0, DECAY * self._ahead + 1.0 - since_last_ns / self._period_ns)
        return self._ahead > SURPLUS
