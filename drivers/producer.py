"""Who sends SYNC instead of the recorder: this machine's kernel, or one of the drives; and who told them to stop.

A producer is started once the network is prepared and stopped before the network is left:

    with CanopenNetwork(...) as network, KernelProducer(network, period_us) as producer:
        network.prepare()
        producer.start()
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from types import TracebackType
from typing import Self

from drivers.bus import BusAddress
from drivers.errors import WHILE, BusError, DriverError
from drivers.link import SYNC_COB_ID
from drivers.network import CanopenNetwork
from drivers.profile import ObjectEntry

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
