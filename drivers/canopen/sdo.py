"""SDO access that reads the bus itself, retries, and never accepts an old answer for a new one."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, cast

import can
from canopen import ObjectDictionary
from canopen.sdo.client import BlockUploadStream, ReadableStream, SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.canopen.bus import base_frame
from drivers.errors import ObjectAccessError
from drivers.profiles.profile import ObjectEntry

NO_SUCH_OBJECT = frozenset((0x0602_0000, 0x0609_0011))
"""Aborts of a drive that lacks the object or its sub-index (CiA 301);
any other may be gone at the next request.
"""
SDO_REQUEST, SDO_ANSWER = 0x600, 0x580  #: COB-IDs, to which the node id is added (CiA 301)
_ABORT_TIMED_OUT = 0x0504_0000
_ABORT_UNKNOWN_COMMAND = 0x0504_0001
_ABORT_OUT_OF_MEMORY = 0x0504_0005
_ABORT = 0x80
_SEGMENT_BYTES = 7
#: Answers to other requests that are skipped, before a node counts as one that does not answer
MOST_SURPLUS = 64
_INITIATE_DOWNLOAD = 1
_INITIATE_UPLOAD = 2
_INITIATE_BLOCK_UPLOAD = 5
_UPLOAD_REQUEST = _INITIATE_UPLOAD << 5
#: Bits of an upload answer with its data, and of one that says their size
_EXPEDITED, _SIZE_INDICATED = 0x42, 0x01
_HEAD = struct.Struct("<BHB")

T = TypeVar("T")

Clock = Callable[[], int]  #: Monotonic time [ns]


@dataclass(frozen=True, slots=True)
class UploadAnswer:
    """Answer to the request for an object of at most four bytes."""

    value: int | None = None  #: None where the answer has no data, or fewer than the object
    bits: int | None = None  #: size of the data; None where the answer has none
    abort_code: int | None = None  #: reason for which the node refuses


def upload_request(node_id: int, entry: ObjectEntry) -> can.Message:
    """Return the request for an object."""
    data = _HEAD.pack(_UPLOAD_REQUEST, entry.index, entry.subindex) + bytes(4)
    return base_frame(SDO_REQUEST + node_id, data)


def download_request(node_id: int, entry: ObjectEntry, value: int) -> can.Message:
    """Return the request to write an object of at most four bytes."""
    # Expedited, with its size
    command = _INITIATE_DOWNLOAD << 5 | (4 - entry.bits // 8) << 2 | 0x03
    data = _HEAD.pack(command, entry.index, entry.subindex) + struct.pack("<L", value)
    return base_frame(SDO_REQUEST + node_id, data)


def upload_answer(data: bytes, entry: ObjectEntry) -> UploadAnswer | None:
    """Read an SDO answer (CiA 301, SDO upload initiate);
    None for one that is not about this object.

    Data longer than the object are cut: some drives send four bytes whatever its size is.
    """
    if len(data) != 8 or _HEAD.unpack_from(data)[1:] != (entry.index, entry.subindex):
        return None
    command = data[0]
    if command == _ABORT:
        return UploadAnswer(abort_code=int.from_bytes(data[4:], "little"))
    if command & 0xE2 != _EXPEDITED:
        return UploadAnswer()
    size = 4 - (command >> 2 & 3) if command & _SIZE_INDICATED else 4
    if 8 * size < entry.bits:
        return UploadAnswer(bits=8 * size)
    value = int.from_bytes(data[4 : 4 + entry.bits // 8], "little", signed=entry.signed)
    return UploadAnswer(value, bits=8 * size)


@dataclass(frozen=True, slots=True)
class SdoPolicy:
    """Limits of a transfer; answers do get lost near SYNC traffic."""

    timeout_s: float = 0.5  #: until an answer
    attempts: int = 3  #: where no answer comes
    transfer_s: float = 2.0  #: until the end of an object of several frames
    most_bytes: int = 4096  #: of one object


class TransferUnboundedError(Exception):
    """A node sends an object without end; nothing is gained by another attempt."""


class ObjectAccess:
    """Reads and writes the object dictionary of one node; every failure is an ObjectAccessError."""

    def __init__(
        self, node_id: int, client: SynchronousSdoClient, policy: SdoPolicy, name: str = ""
    ) -> None:
        self.node_id = node_id
        self.name = name
        self._client = client
        self._policy = policy

    def read(self, entry: ObjectEntry) -> int:
        """Read an integer object.

        Raises:
            ObjectAccessError: aborted, not answered, or shorter than the entry.
        """
        data = self.read_bytes(entry.index, entry.subindex)
        if 8 * len(data) < entry.bits:
            raise ObjectAccessError(
                self, str(entry), f"has {8 * len(data)} bits, expected {entry.bits}"
            )
        # Some drives send four bytes whatever the object's size is.
        return int.from_bytes(data[: entry.bits // 8], "little", signed=entry.signed)

    def read_optional(self, entry: ObjectEntry, *, any_abort: bool = False) -> int | None:
        """Read an integer object that a drive need not have;
        None where it has none, or aborts for any reason.
        """
        try:
            return self.read(entry)
        except ObjectAccessError as error:
            if error.abort_code in NO_SUCH_OBJECT or (any_abort and error.abort_code is not None):
                return None
            raise

    def write(self, entry: ObjectEntry, value: int) -> None:
        """Write an integer object.

        Raises:
            ObjectAccessError: aborted, not answered, or the value does not fit the entry.
        """
        try:
            data = value.to_bytes(entry.bits // 8, "little", signed=entry.signed)
        except OverflowError as error:
            raise ObjectAccessError(
                self, str(entry), f"{value} does not fit {entry.bits} bits"
            ) from error
        self._attempt(str(entry), lambda: self._client.download(entry.index, entry.subindex, data))

    def read_bytes(self, index: int, subindex: int) -> bytes:
        """Read the raw bytes of any object."""
        name = f"{index:04X}h:{subindex:02X}"
        return self._attempt(name, lambda: self._client.upload(index, subindex))

    def _attempt(self, name: str, transfer: Callable[[], T]) -> T:
        reason = ""
        for _ in range(self._policy.attempts):
            if self._client.closing_is_over:
                reason = reason or "the time for closing the network was over"
                break
            try:
                return transfer()
            except SdoAbortedError as error:
                # An abort is an answer: another attempt would get it again.
                raise ObjectAccessError(self, name, f"aborted, {error}", error.code) from error
            except TransferUnboundedError as error:
                raise ObjectAccessError(self, name, str(error)) from error
            except SdoCommunicationError as error:
                reason = str(error)
        else:
            reason = f"{reason}, asked {self._policy.attempts} times"
        raise ObjectAccessError(self, name, reason)


class _Bus(Protocol):
    """The reader of the bus (drivers/canopen/link.py)."""

    clock: Clock
    asked_by: dict[int, object]

    def send(self, messages: Sequence[can.Message]) -> None: ...

    def pump(self, timeout_s: float) -> None: ...

    def allowed_s(self, seconds: float) -> float: ...

    def note_twice(self, node_id: int, first: bytes, second: bytes) -> None: ...


def _unaborted(response: bytes) -> bytes:
    """Return an answer, or raise the abort that it is."""
    if response[0] == _ABORT:
        raise SdoAbortedError(struct.unpack_from("<L", response, 4)[0])
    return response


class SynchronousSdoClient(SdoClient):
    """canopen's SDO client without its thread: it reads the bus while it waits.

    canopen leaves reading to a Notifier thread, which dies silently of an exception and would be a
    second reader alongside the stream. Here the caller is the only reader.
    """

    def __init__(self, node_id: int, bus: _Bus, policy: SdoPolicy) -> None:
        SdoClient.__init__(self, SDO_REQUEST + node_id, SDO_ANSWER + node_id, ObjectDictionary())
        self._bus = bus
        self._policy = policy
        self._answered = b""  # the last answer, if only one can have been sent for it
        # Objects whose request was given up: its answer may still come
        self._unanswered: set[bytes] = set()

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object; by block transfer where the node has it that way alone.

        Raises:
            TransferUnboundedError: it is longer, or takes longer, than the policy allows; the
                transfer was aborted.
            SdoAbortedError, SdoCommunicationError: the node refuses, or does not answer.
        """
        try:
            return self._read_whole(index, subindex, block=False)
        except SdoAbortedError as error:
            if error.code != _ABORT_UNKNOWN_COMMAND:
                raise
        return self._read_whole(index, subindex, block=True)

    def _read_whole(self, index: int, subindex: int, *, block: bool) -> bytes:
        deadline = self._bus.clock() + round(self._policy.transfer_s * 1e9)
        most = self._policy.most_bytes
        data = bytearray()
        try:
            with (
                BlockUploadStream(self, index, subindex)
                if block
                else ReadableStream(self, index, subindex) as stream
            ):
                size = stream.size or 0
                read = cast("Callable[[int], bytes]", stream.read)
                while size <= most and (segment := read(_SEGMENT_BYTES)):
                    data += segment
                    size = max(size, len(data))
                    if self._bus.clock() >= deadline:
                        break
                else:
                    if size <= most:
                        return bytes(data)
        except AttributeError as error:  # canopen's block transfer, where its end does not come
            raise SdoCommunicationError("the block transfer was not ended") from error
        self.abort(_ABORT_OUT_OF_MEMORY)
        limits = f"at most {most} bytes within {self._policy.transfer_s:g} s"
        raise TransferUnboundedError(
            f"found {size} bytes and no end, expected {limits}; the transfer was aborted"
        )

    @property
    def closing_is_over(self) -> bool:
        """Whether the network closes, and there is no time left for another request."""
        return self._bus.allowed_s(self._policy.timeout_s) <= 0.0

    def receive(self, data: bytearray) -> None:
        """Accept an answer that was read from the bus; CiA 301: an SDO always has eight bytes."""
        if len(data) == 8:
            self._note_surplus(self._answered, bytes(data))
            self.responses.put(bytes(data))

    def send_request(self, request: bytes) -> None:
        """Send a request; a failing bus raises BusError."""
        self._bus.send((base_frame(self.rx_cobid, request),))
        self._bus.asked_by[self.rx_cobid - SDO_REQUEST] = self

    def abort(self, abort_code: int = _ABORT_TIMED_OUT) -> None:
        """Abort the transfer on the node's side."""
        self.send_request(struct.pack("<B3xL", _ABORT, abort_code))

    def read_response(self) -> bytes:
        """Wait for the next answer of the node; SdoCommunicationError where none comes in time."""
        return _unaborted(self._read_until(self._deadline()))

    def _deadline(self) -> int:
        return self._bus.clock() + round(self._bus.allowed_s(self._policy.timeout_s) * 1e9)

    def _read_until(self, deadline: int) -> bytes:
        while self.responses.empty():
            left_s = (deadline - self._bus.clock()) * 1e-9
            if left_s <= 0:
                raise SdoCommunicationError(f"no answer within {self._policy.timeout_s:g} s")
            self._bus.pump(left_s)
        response: bytes = self.responses.get_nowait()
        return response

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return the answer that belongs to it, or raise SdoAbortedError,
        SdoCommunicationError.
        """
        self._bus.pump(0.0)
        self.responses.queue.clear()
        before = self._answered
        self._answered = b""
        if self._bus.asked_by.get(self.tx_cobid - SDO_ANSWER) is not self:
            before = b""
        self.send_request(sdo_request)
        requested = bytes(sdo_request[1:4])
        names_object = sdo_request[0] >> 5 in (
            _INITIATE_DOWNLOAD,
            _INITIATE_UPLOAD,
            _INITIATE_BLOCK_UPLOAD,
        )
        deadline = self._deadline()
        for _ in range(MOST_SURPLUS):
            try:
                response = self._read_until(deadline)
            except SdoCommunicationError:
                self._give_up(requested)
                raise
            about = response[1:4]
            if (
                names_object
                and about != requested
                and not (response[0] == _ABORT and about == b"\0\0\0")
            ):
                self._note_surplus(before, response)  # or a late answer to an earlier request
                continue
            if names_object and requested not in self._unanswered:
                self._answered = response
            else:
                self._answered = b""
            self._unanswered.discard(requested)
            return _unaborted(response)
        self._give_up(requested)
        raise SdoCommunicationError(f"{MOST_SURPLUS} answers to other requests")

    def _give_up(self, requested: bytes) -> None:
        self._unanswered.add(requested)
        self.abort()

    def _note_surplus(self, first: bytes, second: bytes) -> None:
        """Report a second answer to one request: two devices have the node id."""
        node_id = self.tx_cobid - SDO_ANSWER
        if first and second[1:4] == first[1:4] and self._bus.asked_by.get(node_id) is self:
            self._bus.note_twice(node_id, first, second)
