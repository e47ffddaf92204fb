"""The process that only reads a SocketCAN bus: receive, time stamp, forward.

    python capture.py SOCKET OUT INTERFACE [RECORDS]

SOCKET and OUT are the numbers of two inherited file descriptors: the bus, and a stream to the
parent. INTERFACE names the bus's interface. RECORDS limits the backlog.

It runs as a script, isolated and with the standard library alone, so that it starts within
milliseconds. Its parent sends on the same socket; only this process receives. Frames leave as
records of fixed size. While the parent is busy they wait here in a bounded backlog; overflow is
counted. The process ends when its parent is gone.
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import signal
import socket
import struct
import sys
import time
from contextlib import suppress
from enum import IntEnum

# asm-generic/socket.h
SO_RXQ_OVFL = 40
SCM_TIMESTAMPNS = 35
SO_MEMINFO = 55
# linux/can/raw.h: flags of a received frame
MSG_CONFIRM = 0x800  #: Sent by this very socket
MSG_DONTROUTE = 0x4  #: Sent by a program of this machine
BACKLOG_RECORDS = 1 << 20  #: A hundred seconds of a full bus in 56 MiB
BURST = 128  #: Frames between two checks of the parent
IDLE_MS = 20  #: Silence after which losses are reported without a following frame
#: Time between two checks of the interface's own counters, and of the parent's process id
CHECK_INTERVAL_NS = 200_000_000
INTERFACE_COUNTERS = ("rx_dropped", "rx_over_errors", "rx_missed_errors")
"""Frames that were lost before any socket:
in the kernel's queue behind the driver, and in the controller.
"""
FRAME = struct.Struct("=IB3x8s")  #: struct can_frame
SYNC = 0x080
_TIMESPEC = struct.Struct("@ll")
_U32 = struct.Struct("=I")
_MEMINFO = struct.Struct("=9I")
# linux/sock_diag.h: index of the socket's drop counter in SO_MEMINFO
_SK_MEMINFO_DROPS = 8
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_U32.size)
# struct cmsghdr: length with the data, level, type
_CMSG_HEADER = struct.Struct("@Nii")
_MAX_SEND_BYTES = 1 << 16
#: Two clocks that were read further apart do not belong together: the process was preempted
_MAX_CLOCK_READ_NS = 200_000
#: A larger difference between two bursts is no slewing: the wall clock was set
_CLOCK_STEP_NS = 1_000_000


class RecordKind(IntEnum):
    """Kind of a record."""

    READY = 0
    FRAME = 1
    LOSSES = 2  #: Losses and time alone, where no frame followed that could carry them
    END = 3  #: The last record; its identifier is the error number


RECORD = struct.Struct("=qqQQQIBB??8s")
"""One frame, or a note of the capture process. Its fields:

- q: wall time at which the kernel received the frame [ns since 1970]; 0 in a note
- q: the same by the monotonic clock [ns]; in a note, when nothing was left to receive
- Q, Q, Q: frames lost so far in the socket's buffer, before it, and in the backlog
- I: identifier and flags of struct can_frame; in the note END the error number
- B: `RecordKind`
- B: number of data bytes
- ?: whether this very socket sent the frame
- ?: whether a program of this machine sent it
- 8s: data, filled up with zeros
"""


class _Vector(ctypes.Structure):
    """Struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    """Struct mmsghdr: struct msghdr, and the bytes received."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
        ("padding", ctypes.c_void_p * 0),
        ("received", ctypes.c_uint),
    )


class Batch:
    """Receives many frames in one system call (recvmmsg), which Python's socket cannot."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
        self.frames = (ctypes.c_char * (BURST * FRAME.size))()
        self._control = (ctypes.c_char * (BURST * _ANCILLARY_BYTES))()
        self._vectors = (_Vector * BURST)()
        self._messages = (_Message * BURST)()
        for index in range(BURST):
            vector = self._vectors[index]
            message = self._messages[index]
            vector.base = ctypes.addressof(self.frames) + index * FRAME.size
            vector.length = FRAME.size
            message.vectors = ctypes.addressof(self._vectors) + index * ctypes.sizeof(_Vector)
            message.vector_count = 1
            message.control = ctypes.addressof(self._control) + index * _ANCILLARY_BYTES
            message.control_length = _ANCILLARY_BYTES
        # The kernel overwrites lengths and flags: each call begins with these headers.
        self._initial_messages = bytes(self._messages)

    def receive(self) -> int:
        """Receive the frames that wait, `BURST` at most; returns their number.

        Raises:
            OSError: as `socket.recv`, also where no frame waits.
        """
        initial = self._initial_messages
        ctypes.memmove(self._messages, initial, len(initial))
        count: int = self._recvmmsg(
            self._descriptor,
            self._messages,
            BURST,
            socket.MSG_DONTWAIT,
            None,
        )
        if count < 0:
            raise OSError(ctypes.get_errno(), "recvmmsg")
        return count

    def metadata(self, index: int) -> tuple[int, int, int | None, int | None]:
        """Return bytes, flags, time stamp [ns since 1970] and drop counter of a received frame.

        Stamp and counter are ancillary data (cmsg(3)); None where the kernel gave none.
        """
        message = self._messages[index]
        stamp_ns: int | None = None
        drops: int | None = None
        header_at = index * _ANCILLARY_BYTES
        end = header_at + message.control_length
        while header_at + _CMSG_HEADER.size <= end:
            length, level, kind = _CMSG_HEADER.unpack_from(self._control, header_at)
            data_at = header_at + socket.CMSG_LEN(0)
            if level == socket.SOL_SOCKET and kind == SCM_TIMESTAMPNS:
                seconds, rest_ns = _TIMESPEC.unpack_from(self._control, data_at)
                stamp_ns = seconds * 1_000_000_000 + rest_ns
            elif level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL:
                (drops,) = _U32.unpack_from(self._control, data_at)
            data_bytes = length - socket.CMSG_LEN(0)
            header_at += socket.CMSG_SPACE(data_bytes)
        return message.received, message.flags, stamp_ns, drops


class MonotonicTime:
    """Converts the kernel's wall-clock stamps to the monotonic clock,
    also when the wall clock is set.

    The kernel stamps received frames by CLOCK_REALTIME alone. The difference of the clocks is read
    after each burst; after a step of the wall clock a frame may still have a stamp from before it.

    Args:
        wall_ns, monotonic_ns: both clocks, read together; no frame is stamped before them.
    """

    def __init__(self, wall_ns: int, monotonic_ns: int) -> None:
        self.offset_ns = wall_ns - monotonic_ns  #: Last known difference of the clocks
        self._last_ns = monotonic_ns

    def convert(self, stamp_ns: int, wall_ns: int, monotonic_ns: int) -> int:
        """Return the monotonic time of a kernel's stamp [ns].

        It is never before the previous one, and never after `monotonic_ns`.

        Args:
            stamp_ns: wall time at which the kernel received the frame [ns since 1970].
            wall_ns, monotonic_ns: both clocks, read together after the frame.
        """
        offset_ns = wall_ns - monotonic_ns
        converted_ns = stamp_ns - offset_ns
        clock_was_set = abs(offset_ns - self.offset_ns) > _CLOCK_STEP_NS
        is_possible = self._last_ns <= converted_ns <= monotonic_ns
        if clock_was_set and not is_possible:
            # The stamp is still from before the step.
            converted_ns = stamp_ns - self.offset_ns
        else:
            self.offset_ns = offset_ns
        latest_ns = max(monotonic_ns, self._last_ns)
        not_before_last_ns = max(converted_ns, self._last_ns)
        self._last_ns = min(not_before_last_ns, latest_ns)
        return self._last_ns


class Capture:
    """Reads one bus and forwards its frames to the parent.

    Args:
        bus: CAN_RAW socket, or a packet socket that carries struct can_frame; used non-blocking.
        out: stream socket to the parent.
        interface: name of the bus's interface, for its counters.
        backlog_records: largest number that may wait for the parent.
    """

    def __init__(
        self,
        bus: socket.socket,
        out: socket.socket,
        interface: str,
        backlog_records: int = BACKLOG_RECORDS,
    ) -> None:
        self._bus = bus
        self._out = out
        self._max_backlog_bytes = backlog_records * RECORD.size
        self._backlog = bytearray()
        self._now_ns = time.monotonic_ns()
        self._time = MonotonicTime(time.time_ns(), self._now_ns)
        self._kernel_dropped = 0
        self._interface_dropped = 0
        self._backlog_dropped = 0
        self._counter_files = tuple(
            f"/sys/class/net/{interface}/statistics/{name}" for name in INTERFACE_COUNTERS
        )
        self._interface_count_at_start = self._read_interface_count()
        # Monotonic time at which nothing was left to receive
        self._all_received_ns = 0
        self._reported_losses = (0, 0, 0)
        self._batch = Batch(bus.fileno())

    def run(self, parent: int) -> None:
        """Capture until the parent, given by its process id, or the bus is gone."""
        poller = select.poll()
        poller.register(self._bus, select.POLLIN)
        poller.register(self._out, 0)
        bus_descriptor = self._bus.fileno()
        out_descriptor = self._out.fileno()
        self._append_note(RecordKind.READY)
        next_check_ns = self._now_ns + CHECK_INTERVAL_NS
        bus_ended = False
        while self._backlog or not bus_ended:
            poller.modify(self._out, select.POLLOUT if self._backlog else 0)
            ready = dict(poller.poll(IDLE_MS))
            if ready.get(out_descriptor, 0) & (select.POLLHUP | select.POLLERR):
                return
            if bus_descriptor in ready:
                error_number = self.receive()
                if error_number:
                    self._append_note(RecordKind.END, error_number)
                    poller.unregister(self._bus)
                    bus_ended = True
            elif not ready:
                self._report_silence()
            if not self.forward():
                return
            if self._now_ns >= next_check_ns:
                next_check_ns = self._now_ns + CHECK_INTERVAL_NS
                count = self._read_interface_count()
                self._interface_dropped = count - self._interface_count_at_start
                if os.getppid() != parent:
                    # Another process holds the parent's end of the pair open.
                    return

    def receive(self) -> int:
        """Receive waiting frames, a burst at most.

        Returns:
            the error number that ended the bus, else 0.
        """
        try:
            count = self._batch.receive()
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as error:
            self._now_ns = time.monotonic_ns()
            return error.errno or errno.EIO
        wall_ns, monotonic_ns = self._read_clocks()
        for index in range(count):
            size, flags, stamp_ns, drops = self._batch.metadata(index)
            if size == 0:
                # End of file: the other end of a packet socket is closed.
                return errno.ENODEV
            if drops is not None:
                self._note_kernel_drops(drops)
            can_id, length, data = FRAME.unpack_from(self._batch.frames, index * FRAME.size)
            own = bool(flags & MSG_CONFIRM)
            if own and can_id != SYNC:
                # Of our own frames only SYNC is of interest: its actual time.
                continue
            if stamp_ns is None:
                stamp_ns = wall_ns
            received_ns = self._time.convert(stamp_ns, wall_ns, monotonic_ns)
            if len(self._backlog) >= self._max_backlog_bytes:
                self._backlog_dropped += 1
                continue
            self._reported_losses = self._losses
            self._backlog += RECORD.pack(
                stamp_ns,
                received_ns,
                *self._reported_losses,
                can_id,
                RecordKind.FRAME,
                length,
                own,
                bool(flags & MSG_DONTROUTE),
                data,
            )
        return 0

    def _read_clocks(self) -> tuple[int, int]:
        """Return the wall clock and the monotonic clock [ns], read together."""
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        self._now_ns = time.monotonic_ns()
        monotonic_ns = (before_ns + self._now_ns) // 2
        if self._now_ns - before_ns > _MAX_CLOCK_READ_NS:
            wall_ns = monotonic_ns + self._time.offset_ns
        return wall_ns, monotonic_ns

    def _report_silence(self) -> None:
        """Note that nothing is left to receive, and read the drop counter of the socket."""
        self._now_ns = time.monotonic_ns()
        self._all_received_ns = self._now_ns
        # The parent distinguishes a silent bus from a capture process that was stopped.
        self._append_note(RecordKind.LOSSES)
        # A frame reports the drops before it, but none may follow. Linux has SO_MEMINFO since 4.12;
        # on an older one the next frame has to report them.
        with suppress(OSError):
            packed = self._bus.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size)
            if len(packed) == _MEMINFO.size:
                counters = _MEMINFO.unpack(packed)
                self._note_kernel_drops(counters[_SK_MEMINFO_DROPS])

    def _note_kernel_drops(self, count: int) -> None:
        # A frame carries the count of the time when it was queued, which may be less than a reading
        # of the socket.
        self._kernel_dropped = max(count, self._kernel_dropped)

    def _append_note(self, kind: RecordKind, error_number: int = 0) -> None:
        """Append a note to the backlog, even when that is full: notes are few."""
        self._reported_losses = self._losses
        self._backlog += RECORD.pack(
            0,
            self._all_received_ns,
            *self._reported_losses,
            error_number,
            kind,
            0,
            False,
            False,
            bytes(8),
        )

    @property
    def _losses(self) -> tuple[int, int, int]:
        """Frames lost so far, in the order of `RECORD`."""
        return (self._kernel_dropped, self._interface_dropped, self._backlog_dropped)

    def _read_interface_count(self) -> int:
        """Return the sum of the interface's counters of lost frames."""
        total = 0
        for name in self._counter_files:
            try:
                with open(name, "rb") as file:  # noqa: PTH123 - pathlib costs the start of this process some ms
                    total += int(file.read())
            except (OSError, ValueError):
                # It is gone, or does not count this.
                continue
        return total

    def forward(self) -> bool:
        """Forward what the parent accepts without waiting.

        Returns:
            False when the parent is gone.
        """
        flags = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
        try:
            while self._backlog:
                with memoryview(self._backlog) as waiting:
                    sent = self._out.send(waiting[:_MAX_SEND_BYTES], flags)
                del self._backlog[:sent]
            if self._reported_losses != self._losses:
                # The next call sends it.
                self._append_note(RecordKind.LOSSES)
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True


def run_capture(arguments: list[str]) -> None:
    """Capture from one inherited socket to the other.

    Args:
        arguments: of the program, see the head of this file.
    """
    bus_descriptor, out_descriptor, interface, *backlog_records = arguments
    # The parent handles Ctrl-C: it stops the axes first, and needs the frames for that.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()
    # Real-time priority where permitted (root, CAP_SYS_NICE): this process does little and must not
    # wait.
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    with (
        socket.socket(fileno=int(bus_descriptor)) as bus,
        socket.socket(fileno=int(out_descriptor)) as out,
    ):
        Capture(bus, out, interface, *map(int, backlog_records)).run(parent)


if __name__ == "__main__":
    run_capture(sys.argv[1:])
