"""Read ROS 2 bags in MCAP: their messages, the joint states in them,
and the name of a file that is no log of ours.
"""

from __future__ import annotations

import struct
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema

from daq.errors import LogForeign, LogTruncated, LogUnreadable, on_one_line
from daq.log.container import HEAD_BYTES, LARGEST_RATIO, PlacedRecord, RecordFile
from daq.log.message import JOINTS_SCHEMA, SAMPLES_TOPIC

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
EXAMINED = 10_000  #: Messages that are examined to say what a file is


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag."""

    name: str  #: as publishers know it
    has_joint_states: bool  #: in CDR
    #: name of the node, where the bag has it (ROS 1, or MCAP converted from it)
    publisher: str = ""
    #: among those of the same name in its file, from 1: a writer may give each publisher its own
    channel: int = 1


class BagMessage(NamedTuple):
    """A message as it was recorded."""

    place: int  #: byte of the file, or row of the table
    topic: Topic  #: where it was published
    time_ns: int  #: time of its recording
    data: bytes  #: its fields, maybe packed: see `unpack_message`


class McapBag(RecordFile):
    """A bag in MCAP, which is laxer than a log of ours:
    checksums are optional, and messages need no chunks.
    """

    def __init__(self, path: Path, source: Path | None = None) -> None:
        """Store the path, and where the content is if not there."""
        super().__init__(path, source)
        self.library = ""
        self.has_entries = False  #: Attachments or metadata, with which a log of ours begins
        self.topics: dict[int, Topic] = {}
        self._schemas: dict[int, Schema] = {}

    def messages(self) -> Generator[BagMessage, None, None]:
        """Yield the messages; `topics` grows meanwhile.

        Raises:
            LogUnreadable: one of its kinds, with the place in the file.
        """
        with closing(iter(self)) as records:
            yield from self._messages(records)

    def unfinished_messages(self) -> Generator[BagMessage, None, None]:
        """Yield the messages before the damage of a file without a valid end,
        then raise as `messages`.
        """
        with closing(self.unfinished()) as records:
            yield from self._messages(records)

    def _messages(self, records: Iterable[PlacedRecord]) -> Iterator[BagMessage]:
        for offset, outer in records:
            inside = self._inside(offset, outer) if isinstance(outer, Chunk) else (outer,)
            for record in inside:
                if isinstance(record, Message):
                    topic = self.topics.get(record.channel_id)
                    if topic is None:
                        raise self.corrupt(
                            offset,
                            f"a message of channel {record.channel_id}",
                            "a channel before it",
                        )
                    yield BagMessage(offset, topic, record.log_time, record.data)
                elif isinstance(record, Attachment | Metadata):
                    self.has_entries = True
                elif isinstance(record, Header):
                    self.library = record.library
                elif isinstance(record, Schema):
                    self._schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = self._schemas.get(record.schema_id)
                    is_joints = schema is not None and schema.name == JOINTS_SCHEMA
                    has_joint_states = is_joints and record.message_encoding == "cdr"
                    others = [
                        number
                        for number, topic in self.topics.items()
                        if topic.name == record.topic
                    ]
                    known = self.topics.get(record.id)
                    # The index at the end repeats the channels.
                    if known is None:
                        channel = len(others) + 1
                    else:
                        channel = known.channel
                    node = record.metadata.get("callerid", "")
                    self.topics[record.id] = Topic(record.topic, has_joint_states, node, channel)

    def _inside(self, offset: int, chunk: Chunk) -> Iterator[McapRecord]:
        data = self.unpack(offset, chunk)
        for opcode, start, end in self.records_inside(offset, data):
            for _, record in self._record(offset, opcode, data[start + HEAD_BYTES : end]):
                yield record

    def _record(self, offset: int, opcode: int, body: bytes) -> Iterator[PlacedRecord]:
        if opcode != Opcode.MESSAGE:
            yield from super()._record(offset, opcode, body)
        elif len(body) < 22:
            raise self.corrupt(offset, "a message without its head", "one of at least 22 bytes")
        else:
            channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
            yield offset, Message(channel, log_time, body[22:], publish_time, sequence)

    def _check_crc(self, offset: int, what: str, stored: int, computed: int) -> None:
        if stored != 0:  # ROS 2 leaves the checksum of the data section out
            super()._check_crc(offset, what, stored, computed)

    def _truncated(self, size: int, good: int | None) -> LogTruncated:
        error = super()._truncated(size, good)
        remedy = (
            "the recorder was killed or the copy is incomplete: copy it again, or repair it "
            "with `mcap recover`"
        )
        return LogTruncated(
            error.subject, found=error.found, expected="a finished bag", remedy=remedy
        )


def unpack_message(data: bytes) -> bytes:
    """Return the fields of a message that may be packed by itself (`compression_mode: MESSAGE`).

    CDR begins with two bytes of which the first is 0, a frame of zstd never does.

    Raises:
        ValueError: it is packed, and broken or large.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        largest = LARGEST_RATIO * len(data)
        claimed = zstandard.frame_content_size(data)
        if claimed > largest:
            raise ValueError(f"{len(data)} bytes that unfold to {claimed}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=largest)
    except zstandard.ZstdError as error:
        raise ValueError(f"packed bytes ({error})") from error


@dataclass(frozen=True, slots=True)
class JointState:
    """A message of the type sensor_msgs/msg/JointState; a field without values is empty."""

    stamp_ns: int  #: of its header
    frame: str  #: of its header
    names: tuple[str, ...]  #: names of n joints
    position: tuple[float, ...]  #: [rad; m for a prismatic joint], shape (n,)
    velocity: tuple[float, ...]  #: per second, shape (n,)
    #: [Nm; N for a prismatic joint], or what the publisher takes it for, shape (n,)
    effort: tuple[float, ...]


def joint_state_from_cdr(data: bytes) -> JointState:
    """Decode a message of OMG CDR: four bytes of encapsulation, then the fields, each aligned.

    Raises:
        ValueError: it is not one, or ends early.
    """
    order = {b"\x00\x00": ">", b"\x00\x01": "<"}.get(data[:2])
    if order is None:
        raise ValueError(f"encapsulation {data[:2].hex()}")
    body = data[4:]
    at = 8

    def unsigned() -> int:
        nonlocal at
        at += -at % 4
        (number,) = struct.unpack_from(order + "I", body, at)
        at += 4
        return int(number)

    def text() -> str:
        nonlocal at
        size = unsigned()
        if size > len(body) - at:
            raise ValueError(f"{len(body) - at} bytes of a text of {size}")
        at += size
        return body[at - size : at].rstrip(b"\0").decode()

    def numbers() -> tuple[float, ...]:
        nonlocal at
        count = unsigned()
        at += -at % 8 if count else 0
        if 8 * count > len(body) - at:
            raise ValueError(f"{len(body) - at} bytes of {count} numbers")
        at += 8 * count
        return struct.unpack_from(f"{order}{count}d", body, at - 8 * count)

    try:
        seconds, nanoseconds = struct.unpack_from(order + "iI", body)
        frame = text()
        count = unsigned()
        if count > len(body):
            raise ValueError(f"{count} names in {len(body)} bytes")
        names = tuple([text() for _ in range(count)])
        return JointState(
            seconds * 1_000_000_000 + nanoseconds, frame, names, numbers(), numbers(), numbers()
        )
    except struct.error as error:
        raise ValueError(f"a message of {len(data)} bytes ({error})") from error


def foreign_recording(path: Path) -> LogForeign | None:
    """Return the error for an MCAP file of another program;
    None if it may be a log of ours, or no MCAP file.
    """
    bag = McapBag(path)
    joints: tuple[str, ...] = ()
    is_finished = False
    with suppress(LogUnreadable, ValueError), closing(bag.unfinished_messages()) as messages:
        for message in islice(messages, EXAMINED):
            if message.topic.has_joint_states:
                joints = joints or joint_state_from_cdr(unpack_message(message.data)).names
        is_finished = True
    topics = {topic.name: topic.has_joint_states for topic in bag.topics.values()}
    if SAMPLES_TOPIC in topics:
        return None
    if not topics:
        if bag.has_entries:
            return None
        return _without_message(path, bag.library, is_finished=is_finished)
    states = [topic for topic, has in topics.items() if has]
    library = on_one_line(bag.library) or "another program"
    content = ", ".join(map(on_one_line, topics))
    if states:
        joints_listed = ", ".join(map(on_one_line, joints)) or "no joint"
        topics_listed = ", ".join(map(on_one_line, states))
        content = f"joint states of {joints_listed} on {topics_listed}"
    found = f"a bag of {library} with {content}"
    remedy = f"`drivegain import` reads bags with {JOINTS_SCHEMA}"
    if states:
        remedy = (
            "import it: `drivegain import`, with the joints as `columns` "
            "(configs/imports/tx40.yaml)"
        )
    return LogForeign(str(path), found=found, expected="a log of drivegain", remedy=remedy)


OWN_LIBRARY = "drivegain"  #: Begin of the library's name in logs of ours


def _without_message(path: Path, library: str, *, is_finished: bool) -> LogForeign | None:
    """Return the error for a file without a message, if another library began it.

    Args:
        path: of the file.
        library: that wrote its header.
        is_finished: whether its data section has an end, so that nothing is missing.
    """
    if not library or library.startswith(OWN_LIBRARY):
        return None
    library = on_one_line(library)
    if is_finished:
        return LogForeign(
            str(path),
            found=f"a bag of {library} without a message",
            expected="a log of drivegain",
            remedy="was the right topic recorded? `drivegain import` reads bags with "
            f"{JOINTS_SCHEMA}",
        )
    return LogForeign(
        str(path),
        found=f"the begin of a bag of {library}, without a whole message",
        expected="a log of drivegain",
        remedy="the copy is incomplete, or its recorder was killed: copy it again, or repair it "
        f"with `mcap recover`; then `drivegain import` reads bags with {JOINTS_SCHEMA}",
    )
