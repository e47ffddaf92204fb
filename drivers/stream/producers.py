"""SYNC producers other than this process: the kernel, or a drive.

A stream follows them (`FollowedSync`).

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
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import ceil

from drivers.canopen.bus import BusAddress
from drivers.canopen.capture import FRAME
from drivers.canopen.link import SYNC_COB_ID
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import download_request
from drivers.errors import WHILE, BusError, DriverError
from drivers.profiles.profile import ObjectEntry
from drivers.stream.sync import Producer

SYNC_COB_ID_OBJECT = ObjectEntry(0x1005, 0, 32)
#: Period [us]; a producer sends no SYNC while it is 0 (CiA 301)
CYCLE_PERIOD = ObjectEntry(0x1006, 0, 32)
PRODUCES = 1 << 30  #: Bit of 1005h
#: Time for which the kernel goes on alone; less than the 0.5 s of the amplifiers' own watch
LEASE_S = 0.4
#: SYNCs that the kernel sends alone where the period is so long that fewer come in `LEASE_S`
LEAST_SYNCS = 3
RENEWAL_S = 0.025  #: Time between two renewals
STEERING_S = 0.25  #: Time between two corrections of the kernel's interval
#: Fraction of the period; a kernel that is later than that produces time stamps which are refused
LARGEST_CORRECTION = 0.2
# linux/can/bcm.h
_TX_SETUP = 1
_SET_TIMER = 0x1
_SET_AND_START_TIMER = 0x3
# struct bcm_msg_head: opcode, flags, count, two intervals of (s, us), identifier, number of frames.
# `0q` pads it to the alignment of the can_frame that follows.
_HEAD = struct.Struct("@3I4l2I0q")


def steered_us(period_us: int, interval_us: int, late_ns: int, phase_ns: int, periods: int) -> int:
    """Return the kernel's interval for the next window of SYNCs [us].

    The next window is expected to be too long by `late_ns` again, and it has to be shorter by
    `phase_ns` to end on schedule. Its periods share both.

    Args:
        period_us: of the schedule [us].
        interval_us: of the last window [us].
        late_ns: time by which the last window was too long [ns].
        phase_ns: time by which its last SYNC was late in the schedule [ns].
        periods: in a window.
    """
    correction_us = (late_ns + phase_ns) / (1000 * periods)
    shortest_us = (1.0 - LARGEST_CORRECTION) * period_us
    longest_us = (1.0 + LARGEST_CORRECTION) * period_us
    bounded_us = min(max(interval_us - correction_us, shortest_us), longest_us)
    return round(bounded_us)


def setup_message(flags: int, interval_us: int) -> bytes:
    """Return a message to the broadcast manager:
    send so many SYNCs as last for `LEASE_S`, then none.
    """
    seconds, rest_us = divmod(interval_us, 1_000_000)
    count = max(LEAST_SYNCS, ceil(LEASE_S * 1e6 / interval_us))
    head = _HEAD.pack(_TX_SETUP, flags, count, seconds, rest_us, 0, 0, SYNC_COB_ID, 1)
    return head + FRAME.pack(SYNC_COB_ID, 0, bytes(8))


class KernelProducer(Producer, AbstractContextManager["KernelProducer"]):
    """SYNC by the kernel's broadcast manager (CAN_BCM), whose timer needs no process to wake up.

    It ends at once with the process that started it. Where that process lives and sees no SYNC, it
    ends after `LEASE_S`: a recorder that hangs must not keep the axes running, one that is stopped
    for 300 ms must lose nothing.

    Each interval counts from the actual time of the last SYNC, so the period is too long by the
    lateness of the timer: `seen` measures that and shortens the interval.
    """

    in_kernel = True

    def __init__(self, network: CanopenNetwork, period_us: int) -> None:
        super().__init__("the kernel", period_us)
        self._link = network.link
        self._socket: socket.socket | None = None
        self._interval_us = period_us
        self._window_periods = max(8, round(STEERING_S * 1e6 / period_us))
        self._window_begun_ns = 0  # by the SYNC that began it
        self._periods = 0  # since the window began
        self._phase_ns = 0  # time by which the SYNC that began it was late in the schedule
        self._renewed_ns = 0

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Send SYNC from now on: the first at once, and all after it count from that one.

        Raises:
            BusError: the kernel has no broadcast manager, or the bus is not SocketCAN.
        """
        address = self._link.address
        if not isinstance(address, BusAddress) or not address.kind.has_kernel_sync:
            raise BusError(str(address), "SYNC by the kernel needs one bus of interface socketcan")
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_BCM)
                self._socket.connect((address.channel,))
            self._link.sync_producer = self.name
            self._socket.send(setup_message(_SET_AND_START_TIMER, self._interval_us))
        except OSError as error:
            self.stop()
            number = error.errno or 0
            name = errno.errorcode.get(number, "")
            reason = f"SYNC by the kernel: {os.strerror(number)} {name}; modprobe can-bcm?"
            raise BusError(str(address), reason) from error

    def seen(self, monotonic_ns: int, periods: int) -> None:
        """Process a SYNC and its periods since the one before, 0 for the first.

        It renews the lease, and once a window corrects the interval.
        """
        since_renewal_ns = monotonic_ns - self._renewed_ns
        is_renewed = 0 <= since_renewal_ns < RENEWAL_S * 1e9
        if self._socket is not None and not is_renewed:
            # This does not start a timer that has ended: the recorder was stopped for too long.
            self._renewed_ns = monotonic_ns
            self._socket.send(setup_message(_SET_TIMER, self._interval_us))
        if periods == 0:
            self._window_begun_ns = monotonic_ns
            self._phase_ns = 0
            self._periods = 0
            return
        self._periods += periods
        if self._periods < self._window_periods or self._socket is None:
            return
        lasted_ns = monotonic_ns - self._window_begun_ns
        late_ns = lasted_ns - 1000 * self.period_us * self._periods
        self._phase_ns += late_ns
        interval_us = steered_us(
            self.period_us, self._interval_us, late_ns, self._phase_ns, self._periods
        )
        self._window_begun_ns = monotonic_ns
        self._periods = 0
        if interval_us != self._interval_us:
            self._interval_us = interval_us
            self._socket.send(setup_message(_SET_TIMER, interval_us))

    def rest(self) -> None:
        """Stop sending: the next start begins a new phase."""
        self.pause()

    def pause(self) -> None:
        """Stop sending; SYNCs on their way are still the kernel's."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def stop(self) -> None:
        """Stop sending, if started."""
        self.pause()
        self._link.sync_producer = None


@dataclass(frozen=True, slots=True)
class _SyncObjects:
    """Values of the SYNC objects of a drive."""

    cob_id: int  #: 1005h
    period_us: int  #: 1006h


class DriveProducer(Producer, AbstractContextManager["DriveProducer"]):
    """SYNC by a drive of the cell: by its objects 1005h (bit 30) and 1006h, which are restored.

    Args:
        network: of the drive.
        axis: its index.
        period_us: of SYNC [us].
    """

    def __init__(self, network: CanopenNetwork, axis: int, period_us: int) -> None:
        super().__init__(network.axes[axis].name, period_us)
        self._network = network
        self._node_id = network.node_ids[axis]
        self._before: _SyncObjects | None = None  # as before the first start; None unless started
        self._produces = False

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is None:
            self.stop()
            return
        self._network.begin_closing()
        for problem in self._restore():
            error.add_note(f"{WHILE}stopping SYNC: {problem}")

    def start(self) -> None:
        """Let the drive send SYNC; where it does so already, nothing is written."""
        if self._produces:
            return
        access = self._network.link.objects(self._node_id)
        if self._before is None:
            cob_id = access.read(SYNC_COB_ID_OBJECT)
            period_us = access.read(CYCLE_PERIOD)
            self._before = _SyncObjects(cob_id, period_us)
            own_identifier = cob_id & ~PRODUCES
            if cob_id & PRODUCES and own_identifier != SYNC_COB_ID:
                # CiA 301, 1005h: bits 0 to 29 must not change while bit 30 is set.
                access.write(SYNC_COB_ID_OBJECT, own_identifier)
        self._network.link.sync_producer = self.name
        # Drives may refuse another period while they produce SYNC, so production begins last and
        # ends first.
        access.write(SYNC_COB_ID_OBJECT, SYNC_COB_ID)
        access.write(CYCLE_PERIOD, self.period_us)
        access.write(SYNC_COB_ID_OBJECT, SYNC_COB_ID | PRODUCES)
        self._produces = True

    def pause(self) -> None:
        """Tell the drive to stop, without waiting for its answer; `stop` restores its objects."""
        if self._before is not None:
            request = download_request(self._node_id, SYNC_COB_ID_OBJECT, SYNC_COB_ID)
            self._network.link.send((request,))
            self._produces = False

    def stop(self) -> None:
        """Restore both objects, if started and if the drive still answers.

        Raises:
            DriverError: an object could not be restored. A note names the other one, where that
                could not be restored either.
        """
        problems = self._restore()
        if problems:
            first, *others = problems
            for other in others:
                first.add_note(f"{WHILE}stopping SYNC: {other}")
            raise first

    def _restore(self) -> list[DriverError]:
        """Restore both objects, as `stop`; return a problem for each that could not be restored."""
        before = self._before
        self._before = None
        self._produces = False
        try:
            if before is None or self._node_id in self._network.link.silent:
                return []
            return self._write_back(before)
        finally:
            self._network.link.sync_producer = None

    def _write_back(self, before: _SyncObjects) -> list[DriverError]:
        """Write both objects, also where one is refused; return a problem for each that was."""
        # Production ends first, and another identifier comes back in a write of its own.
        writes = [(SYNC_COB_ID_OBJECT, SYNC_COB_ID), (CYCLE_PERIOD, before.period_us)]
        if before.cob_id != SYNC_COB_ID:
            writes.append((SYNC_COB_ID_OBJECT, before.cob_id))
        access = self._network.link.objects(self._node_id)
        problems: dict[ObjectEntry, DriverError] = {}  # of the last write of each object
        for entry, value in writes:
            try:
                access.write(entry, value)
            except DriverError as problem:
                problems[entry] = problem
            else:
                problems.pop(entry, None)
        return list(problems.values())


SyncProducer = KernelProducer | DriveProducer
