"""SDO access that reads the bus itself, retries, and takes no answer about another object.

A late answer about the same object looks like the answer to the present request: in CiA 301 only
segments have a toggle bit, and an abort is not confirmed. Where a write must be certain, the
object, or what follows from it, is read afterwards.
"""

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
"""Aborts of a drive that lacks the object or its sub-index (CiA 301).

Any other abort may have a cause that passes: the next request may be answered with a value.
"""
# COB-IDs, to which the node id is added (CiA 301)
SDO_REQUEST = 0x600
SDO_ANSWER = 0x580
_ABORT_TIMED_OUT = 0x0504_0000
_ABORT_UNKNOWN_COMMAND = 0x0504_0001
_ABORT_OUT_OF_MEMORY = 0x0504_0005
_ABORT = 0x80
_SEGMENT_BYTES = 7
#: Answers to other requests that are skipped, before a node counts as one that does not answer
MOST_SURPLUS = 64
# Command specifiers: bits 5 to 7 of the first byte (CiA 301)
_INITIATE_DOWNLOAD = 1
_INITIATE_UPLOAD = 2
_INITIATE_BLOCK_UPLOAD = 5
#: Requests with the index and sub-index of their object
_NAMING_REQUESTS = frozenset((_INITIATE_DOWNLOAD, _INITIATE_UPLOAD, _INITIATE_BLOCK_UPLOAD))
_UPLOAD_REQUEST = _INITIATE_UPLOAD << 5
# Bits of the first byte of an expedited transfer: its data are in the frame itself
_EXPEDITED = 0x02
_SIZE_INDICATED = 0x01
_EXPEDITED_ANSWER = _INITIATE_UPLOAD << 5 | _EXPEDITED  #: To an upload request
_EXPEDITED_ANSWER_MASK = 0xE0 | _EXPEDITED
_HEAD = struct.Struct("<BHB")  #: First byte, index and sub-index

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
    """Return the request to write an unsigned object of at most four bytes."""
    unused_bytes = 4 - entry.bits // 8
    command = _INITIATE_DOWNLOAD << 5 | unused_bytes << 2 | _EXPEDITED | _SIZE_INDICATED
    data = _HEAD.pack(command, entry.index, entry.subindex) + struct.pack("<L", value)
    return base_frame(SDO_REQUEST + node_id, data)


def upload_answer(data: bytes, entry: ObjectEntry) -> UploadAnswer | None:
    """Read an SDO answer (CiA 301, SDO upload initiate);
    None for one that is not about this object.

    Data longer than the object are cut: some drives send four bytes whatever its size is.
    """
    if len(data) != 8:
        return None
    command, index, subindex = _HEAD.unpack_from(data)
    if (index, subindex) != (entry.index, entry.subindex):
        return None
    if command == _ABORT:
        return UploadAnswer(abort_code=int.from_bytes(data[4:], "little"))
    if command & _EXPEDITED_ANSWER_MASK != _EXPEDITED_ANSWER:
        return UploadAnswer()  # without data
    size_bytes = 4
    if command & _SIZE_INDICATED:
        unused_bytes = command >> 2 & 3
        size_bytes = 4 - unused_bytes
    bits = 8 * size_bytes
    if bits < entry.bits:
        return UploadAnswer(bits=bits)
    value = int.from_bytes(data[4 : 4 + entry.bits // 8], "little", signed=entry.signed)
    return UploadAnswer(value, bits)


@dataclass(frozen=True, slots=True)
class SdoPolicy:
    """Limits of a transfer; answers do get lost near SYNC traffic."""

    timeout_s: float = 0.5  #: until an answer
    attempts: int = 3  #: requests for one object, where no answer comes
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
        bits = 8 * len(data)
        if bits < entry.bits:
            raise ObjectAccessError(self, str(entry), f"has {bits} bits, expected {entry.bits}")
        # Some drives send four bytes whatever the object's size is.
        return int.from_bytes(data[: entry.bits // 8], "little", signed=entry.signed)

    def read_optional(self, entry: ObjectEntry, *, any_abort: bool = False) -> int | None:
        """Read an integer object that a drive need not have; None where it has none.

        Args:
            entry: the object.
            any_abort: return None after every other abort as well.

        Raises:
            ObjectAccessError: another abort, no answer, or shorter than the entry.
        """
        try:
            return self.read(entry)
        except ObjectAccessError as error:
            if error.abort_code in NO_SUCH_OBJECT:
                return None
            if any_abort and error.abort_code is not None:
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
            reason = f"{value} does not fit {entry.bits} bits"
            raise ObjectAccessError(self, str(entry), reason) from error
        self._attempt(str(entry), lambda: self._client.download(entry.index, entry.subindex, data))

    def read_bytes(self, index: int, subindex: int) -> bytes:
        """Read the raw bytes of any object."""
        name = f"{index:04X}h:{subindex:02X}"
        return self._attempt(name, lambda: self._client.upload(index, subindex))

    def _attempt(self, name: str, transfer: Callable[[], T]) -> T:
        """Return the result of a transfer, which is tried again where no answer comes."""
        reason = ""  # for which the last attempt failed
        for _ in range(self._policy.attempts):
            if self._client.closing_is_over:
                if not reason:
                    reason = "the time for closing the network was over"
                raise ObjectAccessError(self, name, reason)
            try:
                return transfer()
            except SdoAbortedError as error:
                # An abort is an answer: another attempt would get it again.
                raise ObjectAccessError(self, name, f"aborted, {error}", error.code) from error
            except TransferUnboundedError as error:
                raise ObjectAccessError(self, name, str(error)) from error
            except SdoCommunicationError as error:
                reason = str(error)
        raise ObjectAccessError(self, name, f"{reason}, asked {self._policy.attempts} times")


class _Bus(Protocol):
    """The reader of the bus (drivers/canopen/link.py)."""

    clock: Clock
    asked_by: dict[int, object]  #: sender of the last request to each node, by node id

    def send(self, messages: Sequence[can.Message]) -> None: ...

    def pump(self, timeout_s: float) -> None: ...

    def allowed_s(self, seconds: float) -> float: ...

    def note_twice(self, node_id: int, first: bytes, second: bytes) -> None: ...


def _raise_if_aborted(response: bytes) -> None:
    """Raise SdoAbortedError where an answer is an abort."""
    if response[0] == _ABORT:
        (abort_code,) = struct.unpack_from("<L", response, 4)
        raise SdoAbortedError(abort_code)


class SynchronousSdoClient(SdoClient):
    """canopen's SDO client without its thread: it reads the bus while it waits.

    canopen leaves reading to a Notifier thread, which dies silently of an exception and would be a
    second reader alongside the stream. Here the caller is the only reader.
    """

    def __init__(self, node_id: int, bus: _Bus, policy: SdoPolicy) -> None:
        SdoClient.__init__(self, SDO_REQUEST + node_id, SDO_ANSWER + node_id, ObjectDictionary())
        self._bus = bus
        self._policy = policy
        # Bytes of the answer to the last request. Empty while a request is open, and where another
        # answer may be a late one, which is no sign of a second device.
        self._last_answer = b""
        self._is_waiting = False  # for an answer
        # Objects whose request was given up, by index and sub-index: its answer may still come, and
        # is no sign of a second device.
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
        """Read all segments of an object; see `upload`."""
        deadline_ns = self._bus.clock() + round(self._policy.transfer_s * 1e9)
        most_bytes = self._policy.most_bytes
        data = bytearray()
        open_stream: type[BlockUploadStream | ReadableStream]
        open_stream = BlockUploadStream if block else ReadableStream
        try:
            with open_stream(self, index, subindex) as stream:
                read = cast("Callable[[int], bytes]", stream.read)
                # As the node announces it; as found, where the node sends more
                size = stream.size or 0
                while size <= most_bytes:
                    segment = read(_SEGMENT_BYTES)
                    if not segment:
                        return bytes(data)
                    data += segment
                    size = max(size, len(data))
                    if self._bus.clock() >= deadline_ns:
                        break
        except AttributeError as error:
            # canopen calls a method that its stream does not have, where the end of a block
            # transfer does not come.
            raise SdoCommunicationError("the block transfer was not ended") from error
        self.abort(_ABORT_OUT_OF_MEMORY)
        limits = f"at most {most_bytes} bytes within {self._policy.transfer_s:g} s"
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
            self._note_second_answer(self._last_answer, bytes(data))
            if self._is_waiting:
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
        response = self._read_until(self._deadline())
        _raise_if_aborted(response)
        return response

    def _deadline(self) -> int:
        """Return the time by the clock until which an answer is waited for [ns]."""
        return self._bus.clock() + round(self._bus.allowed_s(self._policy.timeout_s) * 1e9)

    def _read_until(self, deadline_ns: int) -> bytes:
        """Return the next answer; SdoCommunicationError where none comes by then."""
        self._is_waiting = True
        try:
            while self.responses.empty():
                left_s = (deadline_ns - self._bus.clock()) * 1e-9
                if left_s <= 0:
                    raise SdoCommunicationError(f"no answer within {self._policy.timeout_s:g} s")
                self._bus.pump(left_s)
        finally:
            self._is_waiting = False
        response: bytes = self.responses.get_nowait()
        return response

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return the answer that belongs to it, or raise SdoAbortedError,
        SdoCommunicationError.
        """
        # What came before the request does not answer it; after an interrupt, one may be stored.
        self._bus.pump(0.0)
        self.responses.queue.clear()
        # Another answer to the last request shows a second device, unless another client has sent a
        # request to this node since.
        last_answer = self._last_answer
        self._last_answer = b""
        if self._bus.asked_by.get(self.tx_cobid - SDO_ANSWER) is not self:
            last_answer = b""
        self.send_request(sdo_request)
        # Index and sub-index; a request for the next segment has other bytes there.
        requested = bytes(sdo_request[1:4])
        names_object = sdo_request[0] >> 5 in _NAMING_REQUESTS
        deadline_ns = self._deadline()
        for _ in range(MOST_SURPLUS):
            try:
                response = self._read_until(deadline_ns)
            except SdoCommunicationError:
                self._give_up(requested)
                raise
            answered_object = response[1:4]
            # Some nodes abort without the index of the object.
            is_unnamed_abort = response[0] == _ABORT and answered_object == b"\0\0\0"
            is_about_another = answered_object != requested and not is_unnamed_abort
            if names_object and is_about_another:
                # A second answer to the last request, or a late answer to an earlier one
                self._note_second_answer(last_answer, response)
                continue
            if names_object and requested not in self._unanswered:
                self._last_answer = response
            else:
                self._last_answer = b""
            self._unanswered.discard(requested)
            _raise_if_aborted(response)
            return response
        self._give_up(requested)
        raise SdoCommunicationError(f"{MOST_SURPLUS} answers to other requests")

    def _give_up(self, requested: bytes) -> None:
        """Abort a request that was not answered."""
        self._unanswered.add(requested)
        self.abort()

    def _note_second_answer(self, first: bytes, second: bytes) -> None:
        """Report a second answer to one request, if it is one: two devices have the node id.

        Args:
            first: the answer to the last request; empty where no other may be compared with it.
            second: an answer that was not requested, or about another object than requested.
        """
        node_id = self.tx_cobid - SDO_ANSWER
        if first and second[1:4] == first[1:4] and self._bus.asked_by.get(node_id) is self:
            self._bus.note_twice(node_id, first, second)
