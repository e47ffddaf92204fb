"""Read joint states from ROS 2 bags in MCAP as tables.

A column is `position.JOINT`, `velocity.JOINT` or `effort.JOINT`; the time column is `header.stamp`. Messages of one
stamp that hold different joints make one row, because several publishers may share a topic.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Schema

from daq.config.import_description import Column, ImportDescription, TimeColumn, TimeUnit
from daq.errors import LogForeign, LogTruncated, LogUnreadable, TableUnfit
from daq.log.container import RecordFile
from daq.log.message import JOINTS_SCHEMA, SAMPLES_TOPIC
from daq.log.table import LATEST_NS, Table, digest_of, require_finite, stamps_of_ns

STAMP = "header.stamp"  #: Name of the time column
FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True, slots=True)
class JointState:
    """A message of the type sensor_msgs/msg/JointState; a field without values is empty."""

    stamp_ns: int  #: of its header
    names: tuple[str, ...]  #: names of n joints
    position: tuple[float, ...]  #: [rad; m for a prismatic joint], shape (n,)
    velocity: tuple[float, ...]  #: per second, shape (n,)
    effort: tuple[float, ...]  #: [Nm; N for a prismatic joint], or what the publisher takes it for, shape (n,)


def joint_state_from_cdr(data: bytes) -> JointState:
    """Decode a message (OMG CDR as DDS transports it: four bytes of encapsulation, then the fields, each aligned).

    Raises:
        ValueError: it is not one, or ends early.
    """
    order = {b"\x00\x00": ">", b"\x00\x01": "<"}.get(data[:2])
    if order is None:
        raise ValueError(f"encapsulation {data[:2].hex()}")
    body, at = data[4:], 8

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
        text()  # the frame
        count = unsigned()
        if count > len(body):
            raise ValueError(f"{count} names in {len(body)} bytes")
        names = tuple([text() for _ in range(count)])
        return JointState(seconds * 1_000_000_000 + nanoseconds, names, numbers(), numbers(), numbers())
    except struct.error as error:
        raise ValueError(f"a message of {len(data)} bytes ({error})") from error


class BagFile(RecordFile):
    """Records of a bag, which is laxer than a log of ours: checksums are optional, and messages need no chunks."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.library = ""
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}

    def messages(self, records: Iterable[tuple[int, McapRecord]]) -> Iterator[tuple[int, Channel, Message]]:
        """Yield offset, channel and message of this bag's records; `channels` and `schemas` grow meanwhile.

        Raises:
            LogUnreadable: one of its kinds, with the place in the file.
        """
        for offset, outer in records:
            for record in self._inside(offset, outer) if isinstance(outer, Chunk) else (outer,):
                if isinstance(record, Header):
                    self.library = record.library
                elif isinstance(record, Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, Channel):
                    self.channels[record.id] = record
                elif isinstance(record, Message):
                    if record.channel_id not in self.channels:
                        raise self.corrupt(offset, f"a message of channel {record.channel_id}", "a channel before it")
                    yield offset, self.channels[record.channel_id], record

    def is_joint_state(self, channel: Channel) -> bool:
        """Whether a channel has joint states."""
        schema = self.schemas.get(channel.schema_id)
        return schema is not None and schema.name == JOINTS_SCHEMA and channel.message_encoding == "cdr"

    def _inside(self, offset: int, chunk: Chunk) -> Iterator[McapRecord]:
        data = self.unpack(offset, chunk)
        at = 0
        while at < len(data):
            self.spend(offset)
            opcode, length = struct.unpack_from("<BQ", data, at) if len(data) - at >= 9 else (0, len(data))
            at += 9 + length
            if at > len(data):
                raise self.corrupt(offset, "a record beyond the end of its chunk", "one inside")
            for _, record in self._record(offset, opcode, data[at - length : at]):
                yield record

    def _record(self, offset: int, opcode: int, body: bytes) -> Iterator[tuple[int, McapRecord]]:
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
        remedy = "the recorder was killed or the copy is incomplete: copy it again, or repair it with `mcap recover`"
        return LogTruncated(error.subject, found=error.found, expected="a finished bag", remedy=remedy)


def read_bag(path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None) -> Table:
    """Read columns of a bag, which is a file or a folder of several.

    Raises:
        LogUnreadable: a file is no MCAP file, ends early or is damaged.
        TableUnfit: there are no joint states, or not those that the columns name.
    """
    files = sorted(path.glob("*.mcap"), key=lambda file: (len(file.name), file.name)) if path.is_dir() else [path]
    if time is not None and (time.column != STAMP or time.unit is not TimeUnit.NANOSECOND):
        found = f"time column {time.column!r} in {time.unit.value}"
        raise _unfit(path, found, f"`column: {STAMP}` and `unit: ns`", "correct `time` in the import description")
    rows = _Rows(path, tuple(_field_and_joint(path, column) for column in columns))
    topics: dict[str, bool] = {}
    for file in files:
        bag = BagFile(file)
        with closing(iter(bag)) as records:
            for offset, channel, message in bag.messages(records):
                chosen = wanted.topic in {None, channel.topic} and bag.is_joint_state(channel)
                topics[channel.topic] = chosen
                if chosen:
                    try:
                        rows.add(joint_state_from_cdr(message.data), message.log_time)
                    except ValueError as error:
                        raise bag.corrupt(offset, f"{channel.topic} with {error}", JOINTS_SCHEMA) from error
    used = [topic for topic, chosen in topics.items() if chosen]
    if not used:
        found = f"topics {', '.join(topics)}" if topics else "no message"
        raise _unfit(path, found, f"{wanted.topic or 'a topic'} of type {JOINTS_SCHEMA}", "is this the right bag?")
    if len(used) > 1:
        remedy = "choose one in the import description: `topic: NAME`"
        raise _unfit(path, f"joint states on {len(used)} topics, {', '.join(used)}", "one topic", remedy)
    return rows.table(columns, time)


def _unfit(
    path: Path, found: str, expected: str, remedy: str = "correct `columns` in the import description"
) -> TableUnfit:
    return TableUnfit(str(path), found=found, expected=expected, remedy=remedy)


def _field_and_joint(path: Path, column: Column) -> tuple[str, str]:
    field, _, joint = str(column).partition(".")
    if field not in FIELDS or not joint:
        raise _unfit(path, f"column {column!r}", "position.JOINT, velocity.JOINT or effort.JOINT")
    return field, joint


SINCE_1970_NS = 10**18  #: Stamps from here on, 2001, are times of day; earlier ones are since some start
UNDECIDED = 1000  #: Messages with a stamp of 0 that wait for a later one, which says what 0 means


class _Rows:
    """Rows of joint states: a message begins one, or completes that of its stamp.

    A stamp of 0 is the first instant of a clock that starts at 0, as simulation time does, or the stamp that a
    publisher left out. The first other stamp of the bag tells the two apart.
    """

    def __init__(self, path: Path, columns: tuple[tuple[str, str], ...]) -> None:
        """Store the columns, each with field and joint."""
        self._path = path
        self._zero_is_a_time: bool | None = None  # None until a stamp has shown it
        self._undecided: list[tuple[JointState, int]] = []  # with the time of their recording
        self._columns = columns
        self._stamp_ns = array("q")
        self._values = array("d")
        self._present = bytearray()
        self._begun: dict[int, int] = {}  # incomplete rows by their stamp
        self._places: dict[tuple[str, ...], list[tuple[str, int, int]]] = {}  # field, index and column, by the names
        self._unstamped = 0

    def add(self, state: JointState, log_time_ns: int) -> None:
        """Add a message; one without a stamp is taken at the time of its recording.

        Raises:
            TableUnfit: it has fewer values than joints.
            ValueError: no log can hold the time of its recording.
        """
        if state.names not in self._places:
            if len(set(state.names)) < len(state.names):
                twice = next(name for name in state.names if state.names.count(name) > 1)
                raise _unfit(self._path, f"joint {twice} twice in one message", "each joint once", "mend its publisher")
            self._places[state.names] = [
                (field, state.names.index(joint), column)
                for column, (field, joint) in enumerate(self._columns)
                if joint in state.names
            ]
        if not self._places[state.names]:
            return  # joints of something else
        if self._zero_is_a_time is None:
            if state.stamp_ns == 0:
                _require_possible(log_time_ns)
                self._undecided.append((state, log_time_ns))
                if len(self._undecided) == UNDECIDED:
                    self._decide(zero_is_a_time=False)
                return
            self._decide(zero_is_a_time=state.stamp_ns < SINCE_1970_NS)
        self._take(state, log_time_ns)

    def _decide(self, *, zero_is_a_time: bool) -> None:
        """Fix the meaning of a stamp of 0, and take the messages that waited for it."""
        self._zero_is_a_time = zero_is_a_time
        waiting = self._undecided
        self._undecided = []
        for state, log_time_ns in waiting:
            self._take(state, log_time_ns)

    def _take(self, state: JointState, log_time_ns: int) -> None:
        """Begin or complete the row of a message."""
        places = self._places[state.names]
        width = len(self._columns)
        stamp_ns = state.stamp_ns
        if stamp_ns == 0 and not self._zero_is_a_time:
            self._unstamped += 1
            stamp_ns = log_time_ns
        _require_possible(stamp_ns)
        row = self._begun.get(stamp_ns)
        if row is None or any(self._present[row * width + column] for _, _, column in places):
            row = self._begun[stamp_ns] = len(self._stamp_ns)
            self._stamp_ns.append(stamp_ns)
            self._values.extend([0.0] * width)
            self._present.extend(bytes(width))
        for field, index, column in places:
            numbers: tuple[float, ...] = getattr(state, field)
            if index >= len(numbers):
                found = f"a message with {len(state.names)} names and {len(numbers)} values of {field}"
                raise _unfit(self._path, found, "one value a joint", "does this controller publish it?")
            self._values[row * width + column] = numbers[index]
            self._present[row * width + column] = 1
        if all(self._present[row * width : (row + 1) * width]):
            del self._begun[stamp_ns]

    def table(self, columns: tuple[Column, ...], time: TimeColumn | None) -> Table:
        """Return the complete rows.

        Raises:
            TableUnfit: a joint is missing in every row or between complete ones, or a number is not finite.
        """
        self._decide(zero_is_a_time=self._zero_is_a_time is True)
        width = len(self._columns)
        present = np.frombuffer(self._present, dtype=np.bool_).reshape(-1, width)
        joints = sorted({name for names in self._places for name in names})
        absent = [str(columns[number]) for number in np.flatnonzero(~present.any(axis=0))]
        if absent:
            raise _unfit(self._path, f"joints {', '.join(joints) or 'none'}", f"those of {', '.join(absent)}")
        whole = np.flatnonzero(present.all(axis=1))
        inside = slice(whole[0], whole[-1] + 1) if whole.size else slice(0, 1)
        if not whole.size or len(whole) < len(present[inside]):
            row = int(np.argmin(present[inside].all(axis=1))) + inside.start
            lacking = [str(columns[number]) for number in np.flatnonzero(~present[row])]
            raise _unfit(
                self._path,
                f"no {', '.join(lacking)} at {self._stamp_ns[row] * 1e-9:.9f} s",
                "all joints in messages of the same stamp",
                "messages are missing, or joints are stamped apart: record a topic that has all joints in each message",
            )
        remarks = []
        if len(whole) < len(present):
            remarks.append(f"{len(present) - len(whole)} stamps at the ends of the bag lack joints and are left out")
        if self._unstamped:
            remarks.append(f"{self._unstamped} messages have no stamp; the time of their recording is used")
        values = np.frombuffer(self._values).reshape(-1, width)[inside]
        clock = stamps_of_ns(self._stamp_ns[inside])
        stamps = None if time is None else clock
        table = Table(self._path, columns, values, digest_of(values, clock), stamps, remarks=tuple(remarks))
        return require_finite(table)


def _require_possible(time_ns: int) -> None:
    if time_ns >= LATEST_NS:
        raise ValueError(f"a time of {time_ns} ns")


EXAMINED = 10_000  #: Messages that are examined to say what a file is


def foreign_recording(path: Path) -> LogForeign | None:
    """Return the error for an MCAP file of another program; None if it may be a log of ours, or no MCAP file."""
    bag = BagFile(path)
    joints: tuple[str, ...] = ()
    with suppress(LogUnreadable, ValueError), closing(bag.unfinished()) as records:
        for _, channel, message in islice(bag.messages(records), EXAMINED):
            if bag.is_joint_state(channel):
                joints = joints or joint_state_from_cdr(message.data).names
    topics = {channel.topic: bag.is_joint_state(channel) for channel in bag.channels.values()}
    if not topics or SAMPLES_TOPIC in topics:
        return None
    states = [topic for topic, has in topics.items() if has]
    found = f"a bag of {bag.library or 'another program'} with " + (
        f"joint states of {', '.join(joints) or 'no joint'} on {', '.join(states)}" if states else ", ".join(topics)
    )
    remedy = f"`drivegain import` reads bags with {JOINTS_SCHEMA}"
    if states:
        remedy = "import it: `drivegain import`, with the joints as `columns` (configs/imports/tx40.yaml)"
    return LogForeign(str(path), found=found, expected="a log of drivegain", remedy=remedy)
