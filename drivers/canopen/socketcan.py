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
from pathlib import Path
from typing import NamedTuple

import can

from drivers.canopen import capture
from drivers.canopen.capture import FRAME, RECORD, RecordKind

#: The kernel's default of 208 KiB holds 43 ms of a full bus; a busy machine needs more
RECEIVE_BUFFER_BYTES = 4 << 20
#: Time for the capture process to start; a loaded machine is slow to start an interpreter
START_S = 20.0
END_S = 1.0  #: Time for the capture process to end by itself
#: Longest time to wait while the transmit queue is full: at 10 kbit/s a frame takes 13 ms
SEND_S = 0.1
SEND_RETRY_S = 0.0002  #: Time between two attempts meanwhile
# asm-generic/socket.h
SO_RCVBUFFORCE = 33  #: Exceeds net.core.rmem_max; needs CAP_NET_ADMIN
SO_TIMESTAMPNS = 35
CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; Python's socket has no name for it
# linux/can/error.h: classes of error frames
CAN_ERR_CRTL = 0x004  #: Controller problems: error passive, overflow
CAN_ERR_BUSOFF = 0x040
CAN_ERR_RESTARTED = 0x100
#: Error frames to receive. Errors of single frames are not among them: on a bus without a second
#: node they come by the thousand a second.
ERROR_CLASSES = CAN_ERR_CRTL | CAN_ERR_BUSOFF | CAN_ERR_RESTARTED
# linux/can.h: flags in the identifier of struct can_frame, and masks of the identifier itself
_EXTENDED = 0x8000_0000
_REMOTE = 0x4000_0000
_ERROR = 0x2000_0000
_BASE_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFF_FFFF
_RECORD_BUFFER_BYTES = 1 << 18  #: Of the socket pair to the capture process
_FILTER = struct.Struct("=II")  #: struct can_filter


class Losses(NamedTuple):
    """Frames that came over the wire and were lost in this machine."""

    kernel: int = 0  #: in the socket's receive buffer (SO_RXQ_OVFL)
    #: Before any socket, in the controller or in the kernel's queue behind its driver (the
    #: interface's counters, which are read five times a second).
    interface: int = 0
    backlog: int = 0  #: in the capture process, because this process did not read them in time

    def since(self, earlier: Losses) -> Losses:
        """Return the losses since an earlier reading."""
        return Losses(
            self.kernel - earlier.kernel,
            self.interface - earlier.interface,
            self.backlog - earlier.backlog,
        )


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
    """Let the kernel discard unwanted frames, where a bus can: see `SocketcanBus.receive_only`."""
    set_filters: Callable[[Sequence[tuple[int, int]]], None] | None = getattr(
        bus, "receive_only", None
    )
    if set_filters is not None:
        set_filters(wanted)


def read_until_ns(bus: can.BusABC) -> int | None:
    """Return the monotonic time up to which every frame of a bus has been received [ns].

    None where frames have no stamps. On a bus with stamps our own SYNC comes back, in its place
    among the other frames.
    """
    until_ns: int | None = getattr(bus, "read_until_ns", None)
    return until_ns


def lags_behind(bus: can.BusABC, time_ns: int) -> bool:
    """Return whether frames from before a monotonic time may still come.

    A bus that has received nothing yet has read until 0, and lags too. A bus whose frames have no
    stamps never lags.
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
    can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        remarks = _configure(can_socket, channel, receive_buffer_bytes)
    except BaseException:
        can_socket.close()
        raise
    return SocketcanBus(channel, can_socket, backlog_records, remarks)


def receive_within(bus: can.BusABC, timeout: float | None = None) -> can.Message | None:
    """Return the next frame of a bus; None if none comes within a time [s].

    This is `can.BusABC.recv` by the monotonic clock. python-can's own measures the time by the wall
    clock: when that is set back by an hour, it waits an hour longer, and no SYNC is sent.
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
    """A bus that reads many frames with one system call.

    All but the first of them are returned without python-can's clock and logging.
    """

    _received: deque[can.Message]  # frames not returned yet; subclasses begin with an empty one

    def take(self) -> can.Message | None:
        """Return a frame that is received already; None where the bus must be read for the next."""
        # Filters are applied by `receive_within` alone.
        if self._received and self._filters is None:
            return self._received.popleft()
        return None

    def recv(self, timeout: float | None = None) -> can.Message | None:
        # The same as `take`, without another call: this runs for every frame.
        if self._received and self._filters is None:
            return self._received.popleft()
        return receive_within(self, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        # The caller applies its filters where this is False.
        already_filtered = False
        if not self._received:
            self._fill(timeout)
        if not self._received:
            return None, already_filtered
        return self._received.popleft(), already_filtered

    @abstractmethod
    def _fill(self, timeout_s: float | None) -> None:
        """Append frames to `_received`; waits for the first of them at most this long."""


class SocketcanBus(BurstBus):
    """A socket of classic CAN frames, and the process that reads it.

    Args:
        channel: name of the interface, for messages.
        can_socket: bound socket; the bus closes it.
        backlog_records: frames that may wait in the capture process.
        remarks: for the operator, on how it was opened.

    Raises:
        can.CanError: the capture process did not start; the socket is closed.
    """

    def __init__(
        self,
        channel: str,
        can_socket: socket.socket,
        backlog_records: int = capture.BACKLOG_RECORDS,
        remarks: tuple[str, ...] = (),
    ) -> None:
        self.channel_info = f"socketcan {channel}"
        self.losses = NO_LOSSES  #: Of the frames received so far
        self.read_until_ns = 0  #: Monotonic time up to which every frame has been received
        self.remarks = remarks
        self._channel = channel
        self._received = deque()
        self._unparsed: deque[bytes] = deque()  # from the capture process
        self._ready = False  # whether the capture process reads
        self._end_reason: str | None = None
        self._can_socket = can_socket
        self._process: subprocess.Popen[bytes] | None = None
        self._record_socket, capture_end = socket.socketpair()
        try:
            with capture_end:
                self._record_socket.setsockopt(
                    socket.SOL_SOCKET, socket.SO_RCVBUF, _RECORD_BUFFER_BYTES
                )
                capture_end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _RECORD_BUFFER_BYTES)
                self._process = _spawn(can_socket, capture_end, channel, backlog_records)
            self.capture_pid = self._process.pid
            self._wait_until_ready()
            super().__init__(channel=channel)
        except BaseException:
            self._close()
            raise

    def _wait_until_ready(self) -> None:
        """Wait for the capture process: before it reads, another master would not be heard."""
        deadline_s = time.monotonic() + START_S
        while not self._ready:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise can.CanInitializationError(
                    f"the capture process did not start within {START_S:g} s"
                )
            self._fill(left_s)

    def fileno(self) -> int:
        return self._record_socket.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.is_fd:
            raise can.CanOperationError(f"no CAN FD frames on this bus: {msg}")
        can_id = msg.arbitration_id
        if msg.is_extended_id:
            can_id |= _EXTENDED
        if msg.is_remote_frame:
            can_id |= _REMOTE
        if msg.is_error_frame:
            can_id |= _ERROR
        frame = FRAME.pack(can_id, msg.dlc, bytes(msg.data))
        if timeout is None:
            timeout = SEND_S
        deadline_s = time.monotonic() + timeout
        while True:
            try:
                self._can_socket.send(frame, socket.MSG_DONTWAIT)
            except OSError as error:
                queue_is_full = error.errno in (errno.ENOBUFS, errno.EAGAIN)
                if not queue_is_full:
                    raise can.CanOperationError(_reason(error.errno or errno.EIO)) from error
                # The interface's queue holds ten frames by default; a burst of set-points is
                # longer.
                if time.monotonic() >= deadline_s:
                    reason = (
                        f"the transmit queue stays full for {timeout:g} s: does any node "
                        "acknowledge frames?"
                    )
                    raise can.CanOperationError(reason) from error
                time.sleep(SEND_RETRY_S)
            else:
                return

    def receive_only(self, wanted: Sequence[tuple[int, int]]) -> None:
        """Let the kernel discard unwanted frames, so that a flood of them costs nothing.

        Error frames are still received.

        Args:
            wanted: identifier and mask of base data frames.
        """
        filters = bytearray()
        for identifier, mask in wanted:
            # The mask has both flags and the identifier none: a frame with one does not match.
            filters += _FILTER.pack(identifier, mask | _EXTENDED | _REMOTE)
        # A socket other than CAN_RAW has no filters: it receives all.
        with suppress(OSError):
            self._can_socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)

    def _fill(self, timeout_s: float | None) -> None:
        """Take records from the capture process, waiting for the first of them."""
        if self._end_reason is not None:
            raise can.CanOperationError(self._end_reason)
        # Bytes that an interrupted call received and did not parse come first.
        unparsed_bytes = sum(map(len, self._unparsed))
        try:
            if unparsed_bytes < RECORD.size and not self._read_records(timeout_s):
                return
        except (OSError, ValueError) as error:
            raise can.CanOperationError(str(error)) from error
        # A socket gives no bytes at the end of the file.
        end_of_file = not self._unparsed[-1]
        if end_of_file:
            exit_code = self._wait()
            self._end_reason = (
                f"the capture process ended by itself ({exit_code}); frames since then are lost"
            )
            raise can.CanOperationError(self._end_reason)
        self._parse()
        if self._end_reason is not None and not self._received:
            raise can.CanOperationError(self._end_reason)

    def _read_records(self, timeout_s: float | None) -> bool:
        """Append bytes of the capture process to `_unparsed`, empty ones at end of file.

        Returns:
            False where none came in time.
        """
        # `extend` over `map` receives and appends in one call into C: no exception of a signal
        # handler can come in between and lose the bytes.
        receive = partial(map, self._record_socket.recv, (_RECORD_BUFFER_BYTES,))
        try:
            # Next to a busy thread each system call may wait for the interpreter lock: try without
            # select first.
            self._unparsed.extend(receive((socket.MSG_DONTWAIT,)))
        except BlockingIOError:
            if timeout_s == 0:
                return False
            readable, _, _ = select.select((self._record_socket,), (), (), timeout_s)
            if not readable:
                return False
            self._unparsed.extend(receive((0,)))
        return True

    def _parse(self) -> None:
        """Parse the bytes of the capture process into frames.

        An exception meanwhile, such as Ctrl-C, leaves them for the next time.
        """
        unparsed = b"".join(self._unparsed)
        complete_bytes = len(unparsed) - len(unparsed) % RECORD.size
        incomplete_record = deque((unparsed[complete_bytes:],))
        received = self._received.copy()
        ready = self._ready
        end_reason = self._end_reason
        # These two keep the values of the last record.
        lost: list[int] = list(self.losses)
        monotonic_ns = self.read_until_ns
        for record in RECORD.iter_unpack(memoryview(unparsed)[:complete_bytes]):
            kernel_ns, monotonic_ns, *lost, can_id, kind, length, own, local, data = record
            if kind == RecordKind.FRAME:
                received.append(
                    self._message(kernel_ns, monotonic_ns, can_id, data[:length], own, local)
                )
            elif kind == RecordKind.READY:
                ready = True
            elif kind == RecordKind.END:
                end_reason = _reason(can_id)
        losses = Losses(*lost)
        until_ns = max(monotonic_ns, self.read_until_ns)
        # Assignments alone, without a call: an exception changes all of the state, or none of it.
        self._unparsed = incomplete_record
        self._received = received
        self._ready = ready
        self._end_reason = end_reason
        self.losses = losses
        self.read_until_ns = until_ns

    def _message(
        self, kernel_ns: int, monotonic_ns: int, can_id: int, data: bytes, own: bool, local: bool
    ) -> CapturedMessage:
        """Return a frame of a record; `own` if this end sent it, `local` if this machine did."""
        extended = bool(can_id & _EXTENDED)
        remote = bool(can_id & _REMOTE)
        error = bool(can_id & _ERROR)
        if extended or error:
            identifier = can_id & _EXTENDED_MASK
        else:
            identifier = can_id & _BASE_MASK
        dlc = len(data)
        if remote:
            # It requests so many bytes, and carries none.
            data = b""
        message = CapturedMessage(
            timestamp=kernel_ns * 1e-9,
            arbitration_id=identifier,
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=error,
            is_rx=not own,
            channel=self._channel,
            data=data,
            dlc=dlc,
        )
        message.kernel_ns = kernel_ns
        message.monotonic_ns = monotonic_ns
        message.local = local
        return message

    def shutdown(self) -> None:
        super().shutdown()
        self._close()

    def _close(self) -> None:
        """End the capture process and close both sockets."""
        self._end_reason = self._end_reason or "is closed"
        # The capture process ends when its parent's end of the pair is closed.
        self._record_socket.close()
        self._wait()
        self._can_socket.close()

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
    """Start the capture process; it inherits the two sockets."""
    descriptors = (bus.fileno(), out.fileno())
    script = str(Path(capture.__file__).resolve())
    arguments = (*map(str, descriptors), channel, str(backlog_records))
    return subprocess.Popen(
        # Isolated from the user's environment, and without the packages of this one.
        [sys.executable, "-I", "-S", script, *arguments],
        pass_fds=descriptors,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        # A terminal's Ctrl-C goes to the whole process group, but stopping the axes needs the
        # frames.
        start_new_session=True,
    )


def _configure(
    can_socket: socket.socket, channel: str, receive_buffer_bytes: int
) -> tuple[str, ...]:
    """Set the options of a CAN_RAW socket and bind it; returns remarks for the operator."""
    for level, option, value in (
        (socket.SOL_SOCKET, SO_TIMESTAMPNS, 1),
        (socket.SOL_SOCKET, capture.SO_RXQ_OVFL, 1),
        (socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ERROR_CLASSES),
        (socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1),
    ):
        can_socket.setsockopt(level, option, value)
    try:
        can_socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer_bytes)
    except PermissionError:
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
    can_socket.bind((channel,))
    error_number = can_socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if error_number:
        raise can.CanInitializationError(_reason(error_number))
    # The kernel doubles the requested size for its own book-keeping, and reports the double.
    granted_bytes = can_socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    if granted_bytes >= receive_buffer_bytes:
        return ()
    remark = (
        f"the kernel gave {granted_bytes >> 10} KiB of receive buffer instead of "
        f"{receive_buffer_bytes >> 10} KiB: raise net.core.rmem_max, or let the recorder have "
        "CAP_NET_ADMIN"
    )
    return (remark,)


def _reason(error_number: int) -> str:
    """Explain an error of the socket."""
    name = errno.errorcode.get(error_number, str(error_number))
    if error_number == errno.ENETDOWN:
        return f"the interface is down ({name}): ip link set ... up"
    if error_number in (errno.ENODEV, errno.ENXIO):
        return f"the interface is gone ({name}): was the adapter unplugged?"
    return f"{os.strerror(error_number)} ({name})"
