"""The process that only reads a SocketCAN bus: receive, time stamp, forward.

    python capture.py SOCKET OUT INTERFACE [RECORDS]     (two inherited file descriptors by their numbers)

It runs as a script, isolated and with the standard library alone, so that it starts within
milliseconds. Its parent sends on the same socket; only this process receives. Frames leave as
records of fixed size. While the parent is busy they wait here in a bounded backlog; overflow is
counted. The process ends when its parent is gone.
"""  # noqa: E501

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
MSG_OWN = 0x800
MSG_LOCAL = 0x4
"""linux/can/raw.h: MSG_CONFIRM (sent by this socket) and MSG_DONTROUTE (sent by this machine)."""
BACKLOG_RECORDS = 1 << 20  #: A hundred seconds of a full bus in 56 MiB
BURST = 128  #: Frames between two checks of the parent
IDLE_MS = 20  #: Silence after which losses are reported without a following frame
#: Time between two checks of the interface's own counters, and of the parent's process id
LOOK_NS = 200_000_000
INTERFACE_COUNTERS = ("rx_dropped", "rx_over_errors", "rx_missed_errors")
"""Frames that were lost before any socket:
in the kernel's queue behind the driver, and in the controller.
"""
FRAME = struct.Struct("=IB3x8s")  #: struct can_frame
SYNC = 0x080
_TIMESPEC = struct.Struct("@ll")
_U32 = struct.Struct("=I")
_MEMINFO = struct.Struct("=9I")
_DROPS = 8  # SK_MEMINFO_DROPS
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_U32.size)
_ANCILLARY_HEAD = struct.Struct("@Nii")  # struct cmsghdr: its length with the data, level, type
_SEND_BYTES = 1 << 16
_PAUSE_NS = 200_000
#: A larger difference between two bursts is no slewing: the wall clock was set
_CLOCK_STEP_NS = 1_000_000


class RecordKind(IntEnum):
    """Kind of a record."""

    READY = 0
    FRAME = 1
    LOSSES = 2  #: Only the counts and the time, where no frame followed that could carry them
    END = 3  #: The last record; its identifier is the error number


RECORD = struct.Struct("=qqQQQIBB??8s")
"""One frame, or a note of the capture process.

Time at which the kernel received the frame, by the wall clock [ns since 1970] and by the monotonic
clock [ns]; a note has 0, and the monotonic time at which nothing was left to receive. Frames lost
so far in the socket's buffer, before it, and in the backlog; identifier and flags of struct
can_frame; `RecordKind`; bytes of data; whether it was sent by this very socket, and by any program
of this machine; eight bytes.
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

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._receive = ctypes.CDLL(None, use_errno=True).recvmmsg
        self.frames = (ctypes.c_char * (BURST * FRAME.size))()
        self._control = (ctypes.c_char * (BURST * _ANCILLARY_BYTES))()
        self._vectors = (_Vector * BURST)()
        self._messages = (_Message * BURST)()
        for number in range(BURST):
            vector = self._vectors[number]
            message = self._messages[number]
            vector.base = ctypes.addressof(self.frames) + number * FRAME.size
            vector.length = FRAME.size
            message.vectors = ctypes.addressof(self._vectors) + number * ctypes.sizeof(_Vector)
            message.vector_count = 1
            message.control = ctypes.addressof(self._control) + number * _ANCILLARY_BYTES
            message.control_length = _ANCILLARY_BYTES
        self._fresh = bytes(self._messages)

    def receive(self) -> int:
        """Receive what waits, `BURST` frames at most; returns their number.

        OSError as for a socket.
        """
        ctypes.memmove(self._messages, self._fresh, len(self._fresh))
        count: int = self._receive(self._handle, self._messages, BURST, socket.MSG_DONTWAIT, None)
        if count < 0:
            raise OSError(ctypes.get_errno(), "recvmmsg")
        return count

    def about(self, number: int) -> tuple[int, int, int | None, int | None]:
        """Return bytes, flags, time stamp [ns since 1970] and drop counter of a received frame."""
        message = self._messages[number]
        stamp_ns: int | None = None
        drops: int | None = None
        at = number * _ANCILLARY_BYTES
        end = number * _ANCILLARY_BYTES + message.control_length
        while at + _ANCILLARY_HEAD.size <= end:
            length, level, kind = _ANCILLARY_HEAD.unpack_from(self._control, at)
            data = at + socket.CMSG_LEN(0)
            if level == socket.SOL_SOCKET and kind == SCM_TIMESTAMPNS:
                seconds, rest_ns = _TIMESPEC.unpack_from(self._control, data)
                stamp_ns = seconds * 1_000_000_000 + rest_ns
            elif level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL:
                (drops,) = _U32.unpack_from(self._control, data)
            at += socket.CMSG_SPACE(length - socket.CMSG_LEN(0))
        return message.received, message.flags, stamp_ns, drops


class MonotonicTime:
    """Converts the kernel's wall-clock stamps to the monotonic clock,
    also when the wall clock is set.

    The kernel stamps received frames by CLOCK_REALTIME alone. The difference of the clocks is read
    after each burst; after a step of the wall clock a frame may still have a stamp from before it.

    Args:
        wall_ns, monotonic_ns: both clocks, read together; no stamp becomes older than that.
    """

    def __init__(self, wall_ns: int, monotonic_ns: int) -> None:
        self.offset_ns = wall_ns - monotonic_ns  #: Last known difference of the clocks
        self._last_ns = monotonic_ns

    def of(self, stamp_ns: int, wall_ns: int, monotonic_ns: int) -> int:
        """Return the monotonic time of a kernel's stamp [ns],
        from both clocks read together after the frame.

        It is never before the previous one, and never after `monotonic_ns`.
        """
        offset_ns = wall_ns - monotonic_ns
        found_ns = stamp_ns - offset_ns
        stepped = abs(offset_ns - self.offset_ns) > _CLOCK_STEP_NS
        if stepped and not self._last_ns <= found_ns <= monotonic_ns:
            found_ns = stamp_ns - self.offset_ns  # it is still from before the step
        else:
            self.offset_ns = offset_ns
        self._last_ns = min(max(found_ns, self._last_ns), max(monotonic_ns, self._last_ns))
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
        self._most_bytes = backlog_records * RECORD.size
        self._backlog = bytearray()
        self._kernel_dropped = 0
        self._now_ns = time.monotonic_ns()
        self._time = MonotonicTime(time.time_ns(), self._now_ns)
        self._backlog_dropped = self._interface_dropped = 0
        self._counters = tuple(
            f"/sys/class/net/{interface}/statistics/{name}" for name in INTERFACE_COUNTERS
        )
        self._interface_before = self._read_interface()
        self._empty_ns = 0
        self._reported_drops = (0, 0, 0)
        self._batch = Batch(bus.fileno())

    def run(self, parent: int) -> None:
        """Capture until the parent, given by its process id, or the bus is gone."""
        poller = select.poll()
        poller.register(self._bus, select.POLLIN)
        poller.register(self._out, 0)
        bus_number = self._bus.fileno()
        out_number = self._out.fileno()
        self._note(RecordKind.READY)
        look_ns = self._now_ns + LOOK_NS
        ended = False
        while not (ended and not self._backlog):
            poller.modify(self._out, select.POLLOUT if self._backlog else 0)
            ready = dict(poller.poll(IDLE_MS))
            if ready.get(out_number, 0) & (select.POLLHUP | select.POLLERR):
                return
            if bus_number in ready:
                number = self.receive()
                if number:
                    self._note(RecordKind.END, number)
                    poller.unregister(self._bus)
                    ended = True
            elif not ready:
                self._empty_ns = self._now_ns = time.monotonic_ns()
                # The parent distinguishes a silent bus from a capture process that was stopped.
                self._note(RecordKind.LOSSES)
                # A frame reports the drops before it, and there may be none: ask the socket itself.
                with suppress(OSError):  # before Linux 4.12 the next frame reports it
                    counters = self._bus.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size)
                    if len(counters) == _MEMINFO.size:
                        self._see_drops(_MEMINFO.unpack(counters)[_DROPS])
            if not self.forward():
                return
            if self._now_ns >= look_ns:
                look_ns = self._now_ns + LOOK_NS
                self._interface_dropped = self._read_interface() - self._interface_before
                if os.getppid() != parent:
                    return  # another process holds the parent's end of the pair open

    def receive(self) -> int:
        """Receive waiting frames, a burst at most;
        returns the error number that ended the bus, else 0.
        """
        number = count = 0
        try:
            count = self._batch.receive()
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as error:
            number = error.errno or errno.EIO
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        self._now_ns = time.monotonic_ns()
        now_ns = (before_ns + self._now_ns) // 2
        if self._now_ns - before_ns > _PAUSE_NS:
            # Preempted between the readings: they do not belong together
            wall_ns = now_ns + self._time.offset_ns
        for index in range(count):
            size, flags, stamp_ns, drops = self._batch.about(index)
            if size == 0:
                return errno.ENODEV
            if drops is not None:
                self._see_drops(drops)
            can_id, length, payload = FRAME.unpack_from(self._batch.frames, index * FRAME.size)
            if flags & MSG_OWN and can_id != SYNC:
                continue  # of our own frames only SYNC is of interest: its actual time
            if stamp_ns is None:
                stamp_ns = wall_ns
            monotonic_ns = self._time.of(stamp_ns, wall_ns, now_ns)
            if len(self._backlog) >= self._most_bytes:
                self._backlog_dropped += 1
                continue
            self._reported_drops = self._counts
            own = bool(flags & MSG_OWN)
            local = bool(flags & MSG_LOCAL)
            head = (stamp_ns, monotonic_ns, *self._reported_drops)
            self._backlog += RECORD.pack(
                *head, can_id, RecordKind.FRAME, length, own, local, payload
            )
        return number

    def _see_drops(self, count: int) -> None:
        # A frame carries the count of the time when it was queued, which may be less than a reading
        # of the socket.
        self._kernel_dropped = max(count, self._kernel_dropped)

    def _note(self, kind: RecordKind, number: int = 0) -> None:
        """Append a note to the backlog, even when that is full: notes are few."""
        self._reported_drops = self._counts
        self._backlog += RECORD.pack(
            0, self._empty_ns, *self._reported_drops, number, kind, 0, False, False, bytes(8)
        )

    @property
    def _counts(self) -> tuple[int, int, int]:
        return (self._kernel_dropped, self._interface_dropped, self._backlog_dropped)

    def _read_interface(self) -> int:
        total = 0
        for name in self._counters:
            try:
                with open(name, "rb") as file:  # noqa: PTH123 - pathlib costs the start of this process some ms
                    total += int(file.read())
            except (OSError, ValueError):
                continue  # it is gone, or does not count this
        return total

    def forward(self) -> bool:
        """Forward what the parent accepts without waiting;
        returns False when the parent is gone.
        """
        try:
            while self._backlog:
                with memoryview(self._backlog) as waiting:
                    sent = self._out.send(
                        waiting[:_SEND_BYTES], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
                    )
                del self._backlog[:sent]
            if self._reported_drops != self._counts:
                self._note(RecordKind.LOSSES)
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True


def run_capture(arguments: list[str]) -> None:
    """Capture from one inherited socket to the other."""
    # The parent handles Ctrl-C: it stops the axes first, and needs the frames for that.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()
    # Real-time priority where permitted (root, CAP_SYS_NICE): this process does little and must not
    # wait.
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    with (
        socket.socket(fileno=int(arguments[0])) as bus,
        socket.socket(fileno=int(arguments[1])) as out,
    ):
        Capture(bus, out, arguments[2], *map(int, arguments[3:])).run(parent)


if __name__ == "__main__":
    run_capture(sys.argv[1:])
