"""One end of a SocketCAN bus: a separate process reads it (drivers/canopen/capture.py),
this one sends.

See docs/decisions/0017-capture-in-its-own-process.md.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import subprocess
import sys
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from operator import sub
from pathlib import Path
from typing import NamedTuple

import can

from drivers.canopen import capture
from drivers.canopen.capture import FRAME, RECORD, RecordKind

#: The kernel's default of 208 KiB holds 43 ms of a full bus; a busy machine needs more
RECEIVE_BUFFER_BYTES = 4 << 20
#: Time for the capture process to start; a loaded machine is slow to start an interpreter
START_S = 20.0
END_S = 1.0
SEND_S = 0.1  #: Longest time of a full transmit queue: at 10 kbit/s a frame takes 13 ms
RETRY_S = 0.0002
# asm-generic/socket.h; the first is allowed to CAP_NET_ADMIN
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; Python's socket has no name for it
ERROR_CLASSES = 0x4 | 0x40 | 0x100
"""Controller problems (error passive, overflow), bus-off, restarted: linux/can/error.h.

Single bus errors are not requested: a bus without a second node sends thousands a second.
"""
_EXTENDED = 0x8000_0000
_REMOTE = 0x4000_0000
_ERROR = 0x2000_0000
_PAIR_BYTES = 1 << 18
_FILTER = struct.Struct("=II")  #: struct can_filter


class Losses(NamedTuple):
    """Frames that came over the wire and were lost in this machine."""

    kernel: int = 0  #: in the socket's receive buffer (SO_RXQ_OVFL)
    #: Before any socket, in the controller or in the kernel's queue behind its driver (the
    #: interface's counters, which are read five times a second).
    interface: int = 0
    backlog: int = 0  #: in the capture process, because this process did not read them for minutes

    def since(self, earlier: Losses) -> Losses:
        """Return the losses since an earlier reading."""
        return Losses(*map(sub, self, earlier))


NO_LOSSES = Losses()


class CapturedMessage(can.Message):
    """A frame with the kernel's time.

    ``is_rx`` is False on a SYNC that this end sent itself: it is received for its time.
    """

    __slots__ = ("kernel_ns", "local", "monotonic_ns")

    kernel_ns: int  #: wall time at which the kernel received or sent it [ns since 1970]
    monotonic_ns: int  #: the same time by the monotonic clock [ns]
    local: bool  #: sent by a program of this machine


def losses_of(bus: can.BusABC) -> Losses:
    """Return the frames of a bus that this machine lost; zeros where a bus does not count them."""
    losses: Losses = getattr(bus, "losses", NO_LOSSES)
    return losses


def receive_only(bus: can.BusABC, wanted: Sequence[tuple[int, int]]) -> None:
    """Let the kernel discard what a bus does not need, where it can:
    see `SocketcanBus.receive_only`.
    """
    narrow: Callable[[Sequence[tuple[int, int]]], None] | None = getattr(bus, "receive_only", None)
    if narrow is not None:
        narrow(wanted)


def read_until_ns(bus: can.BusABC) -> int | None:
    """Return the monotonic time up to which every frame of a bus has been received;
    None where frames have no stamps.

    On a bus with stamps our own SYNC comes back, in its place among the other frames.
    """
    until_ns: int | None = getattr(bus, "read_until_ns", None)
    return until_ns


def lags_behind(bus: can.BusABC, time_ns: int) -> bool:
    """Return whether frames from before a monotonic time may still come;
    never on a bus whose frames have no stamps.

    A bus that has received nothing yet has read until 0, and is behind too.
    """
    until_ns = read_until_ns(bus)
    return until_ns is not None and until_ns < time_ns


def remarks_of(bus: can.BusABC) -> tuple[str, ...]:
    """Return remarks for the operator on how a bus was opened."""
    return tuple(getattr(bus, "remarks", ()))


def open_socketcan(
    channel: str,
    receive_buffer_bytes: int = RECEIVE_BUFFER_BYTES,
    backlog_records: int = capture.BACKLOG_RECORDS,
) -> SocketcanBus:
    """Open one end of an interface of the kernel.

    Raises:
        OSError: there is no such interface, or no permission to use it.
        can.CanInitializationError: the interface is down, or the capture process did not start.
    """
    handle = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        remarks = _configure(handle, channel, receive_buffer_bytes)
    except BaseException:
        handle.close()
        raise
    return SocketcanBus(channel, handle, backlog_records, remarks)


def receive_within(bus: can.BusABC, timeout: float | None = None) -> can.Message | None:
    """Return the next frame of a bus; None if none comes within a time [s].

    This is `can.BusABC.recv` by the monotonic clock. The one of python-can waits by the wall clock:
    one that is set back meanwhile makes it wait so much longer, and SYNC is not sent until then.
    """
    left_s = timeout
    end_s = None if timeout is None else time.monotonic() + timeout
    while True:
        message, already_filtered = bus._recv_internal(timeout=left_s)
        if message is not None and (already_filtered or bus._matches_filters(message)):
            return message
        if end_s is None:
            continue
        left_s = end_s - time.monotonic()
        if left_s <= 0.0:
            return None


class BurstBus(can.BusABC):
    """A bus of which one call reads a burst;
    its other frames are returned without python-can's clock and logging.
    """

    _received: deque[can.Message]

    def take(self) -> can.Message | None:
        """Return a frame that was received with the one before;
        None where the bus has to be asked.
        """
        if self._received and self._filters is None:
            return self._received.popleft()
        return None

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self._received and self._filters is None:
            return self._received.popleft()
        return receive_within(self, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._received:
            self._fill(timeout)
        return (self._received.popleft() if self._received else None), False

    @abstractmethod
    def _fill(self, timeout_s: float | None) -> None: ...


class SocketcanBus(BurstBus):
    """A socket of classic CAN frames, and the process that reads it.

    Args:
        channel: name of the interface, for messages.
        handle: bound socket; the bus closes it.
        backlog_records: frames that may wait in the capture process.
        remarks: for the operator, on how it was opened.

    Raises:
        can.CanError: the capture process did not start; the socket is closed.
    """

    def __init__(
        self,
        channel: str,
        handle: socket.socket,
        backlog_records: int = capture.BACKLOG_RECORDS,
        remarks: tuple[str, ...] = (),
    ) -> None:
        self.channel_info = f"socketcan {channel}"
        self.losses = NO_LOSSES  #: Of the frames received so far
        self.read_until_ns = 0  #: Monotonic time up to which every frame has been received
        self.remarks = remarks
        self._channel = channel
        self._received = deque()
        self._chunks: deque[bytes] = deque()
        self._ready = False
        self._end: str | None = None
        self._socket = handle
        self._process: subprocess.Popen[bytes] | None = None
        self._pair, theirs = socket.socketpair()
        try:
            with theirs:
                self._pair.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _PAIR_BYTES)
                theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _PAIR_BYTES)
                self._process = _spawn(handle, theirs, channel, backlog_records)
            self.capture_pid = self._process.pid
            self._wait_until_ready()
            super().__init__(channel=channel)
        except BaseException:
            self._close()
            raise

    def _wait_until_ready(self) -> None:
        """Wait for the capture process: before it reads, another master would not be heard."""
        deadline = time.monotonic() + START_S
        while not self._ready:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                raise can.CanInitializationError(
                    f"the capture process did not start within {START_S:g} s"
                )
            self._fill(left_s)

    def fileno(self) -> int:
        return self._pair.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.is_fd:
            raise can.CanOperationError(f"no CAN FD frames on this bus: {msg}")
        flags = (
            _EXTENDED * msg.is_extended_id
            | _REMOTE * msg.is_remote_frame
            | _ERROR * msg.is_error_frame
        )
        frame = FRAME.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data))
        deadline = time.monotonic() + (SEND_S if timeout is None else timeout)
        while True:
            try:
                self._socket.send(frame, socket.MSG_DONTWAIT)
            except OSError as error:
                # The queue of the interface, or the buffer of the socket, is full.
                if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                    raise can.CanOperationError(_reason(error.errno or errno.EIO)) from error
                # The interface's queue holds ten frames by default; a burst of set-points is
                # longer.
                if time.monotonic() >= deadline:
                    raise can.CanOperationError(
                        f"the transmit queue stays full for {SEND_S:g} s: does any node "
                        "acknowledge frames?"
                    ) from error
                time.sleep(RETRY_S)
            else:
                return

    def receive_only(self, wanted: Sequence[tuple[int, int]]) -> None:
        """Let the kernel discard base frames other than these, given as identifier and mask,
        however many come.

        Error frames are still received.
        """
        filters = b"".join(
            _FILTER.pack(number, mask | _EXTENDED | _REMOTE) for number, mask in wanted
        )
        with suppress(OSError):  # a socket that is no CAN_RAW has no filters: it receives all
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)

    def _fill(self, timeout_s: float | None) -> None:
        """Take records from the capture process, waiting for the first of them."""
        if self._end is not None:
            raise can.CanOperationError(self._end)
        try:
            # Bytes that an interrupted call received and did not parse come first.
            if sum(map(len, self._chunks)) < RECORD.size and not self._take(timeout_s):
                return
        except (OSError, ValueError) as error:
            raise can.CanOperationError(str(error)) from error
        if not self._chunks[-1]:
            self._end = (
                f"the capture process ended by itself ({self._wait()}); frames since then are lost"
            )
            raise can.CanOperationError(self._end)
        self._parse()
        if self._end is not None and not self._received:
            raise can.CanOperationError(self._end)

    def _take(self, timeout_s: float | None) -> bool:
        """Append the bytes of the capture process to the chunks; returns whether there were any."""
        # One call into C, so that no signal handler's exception comes between receiving and
        # appending.
        receive = partial(map, self._pair.recv, (_PAIR_BYTES,))
        try:
            # Next to a busy thread each system call may wait for the interpreter lock: try without
            # select first.
            self._chunks.extend(receive((socket.MSG_DONTWAIT,)))
        except BlockingIOError:
            if timeout_s == 0 or not select.select((self._pair,), (), (), timeout_s)[0]:
                return False
            self._chunks.extend(receive((0,)))
        return True

    def _parse(self) -> None:
        """Parse the chunks into frames; an exception meanwhile, such as Ctrl-C,
        leaves them for the next time.
        """
        chunk = b"".join(self._chunks)
        whole = len(chunk) - len(chunk) % RECORD.size
        rest = deque((chunk[whole:],))
        received = self._received.copy()
        ready = self._ready
        end = self._end
        lost: list[int] = list(self.losses)
        monotonic_ns = self.read_until_ns
        for record in RECORD.iter_unpack(memoryview(chunk)[:whole]):
            kernel_ns, monotonic_ns, *lost, can_id, kind, length, own, local, data = record
            if kind == RecordKind.FRAME:
                received.append(
                    self._message(kernel_ns, monotonic_ns, can_id, data[:length], own, local)
                )
            elif kind == RecordKind.READY:
                ready = True
            elif kind == RecordKind.END:
                end = _reason(can_id)
        losses = Losses(*lost)
        until_ns = max(monotonic_ns, self.read_until_ns)
        # No call from here on: the state changes whole, or not at all.
        self._chunks = rest
        self._received = received
        self._ready = ready
        self._end = end
        self.losses = losses
        self.read_until_ns = until_ns

    def _message(
        self, kernel_ns: int, monotonic_ns: int, can_id: int, data: bytes, own: bool, local: bool
    ) -> CapturedMessage:
        extended = bool(can_id & _EXTENDED)
        error = bool(can_id & _ERROR)
        message = CapturedMessage(
            timestamp=kernel_ns * 1e-9,
            arbitration_id=can_id & (0x1FFF_FFFF if extended or error else 0x7FF),
            is_extended_id=extended,
            is_remote_frame=bool(can_id & _REMOTE),
            is_error_frame=error,
            is_rx=not own,
            channel=self._channel,
            data=b"" if can_id & _REMOTE else data,
            dlc=len(data),
        )
        message.kernel_ns = kernel_ns
        message.monotonic_ns = monotonic_ns
        message.local = local
        return message

    def shutdown(self) -> None:
        super().shutdown()
        self._close()

    def _close(self) -> None:
        self._end = self._end or "is closed"
        # The capture process ends when its parent's end of the pair is closed.
        self._pair.close()
        self._wait()
        self._socket.close()

    def _wait(self) -> int | None:
        """Wait for the end of the capture process; returns its exit code."""
        if self._process is None:
            return None
        try:
            return self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def _spawn(
    bus: socket.socket, out: socket.socket, channel: str, backlog_records: int
) -> subprocess.Popen[bytes]:
    numbers = (bus.fileno(), out.fileno())
    program = (
        str(Path(capture.__file__).resolve()),
        *map(str, numbers),
        channel,
        str(backlog_records),
    )
    return subprocess.Popen(
        # Isolated from the user's environment, and without the packages of this one.
        [sys.executable, "-I", "-S", *program],
        pass_fds=numbers,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        # A terminal's Ctrl-C goes to the whole process group, but stopping the axes needs the
        # frames.
        start_new_session=True,
    )


def _configure(handle: socket.socket, channel: str, receive_buffer_bytes: int) -> tuple[str, ...]:
    """Set the options of a CAN_RAW socket and bind it; returns remarks for the operator."""
    for level, option, value in (
        (socket.SOL_SOCKET, SO_TIMESTAMPNS, 1),
        (socket.SOL_SOCKET, capture.SO_RXQ_OVFL, 1),
        (socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ERROR_CLASSES),
        (socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1),
    ):
        handle.setsockopt(level, option, value)
    try:
        handle.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer_bytes)
    except PermissionError:
        handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
    handle.bind((channel,))
    if number := handle.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
        raise can.CanInitializationError(_reason(number))
    # The kernel doubles the requested size for its own book-keeping, and reports the double.
    given = handle.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    if given >= receive_buffer_bytes:
        return ()
    return (
        f"the kernel gave {given >> 10} KiB of receive buffer instead of "
        f"{receive_buffer_bytes >> 10} KiB: raise net.core.rmem_max, or let the recorder have "
        "CAP_NET_ADMIN",
    )


def _reason(number: int) -> str:
    """Explain an error of the socket."""
    name = errno.errorcode.get(number, str(number))
    if number == errno.ENETDOWN:
        return f"the interface is down ({name}): ip link set ... up"
    if number in (errno.ENODEV, errno.ENXIO):
        return f"the interface is gone ({name}): was the adapter unplugged?"
    return f"{os.strerror(number)} ({name})"
