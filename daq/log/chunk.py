"""What stands in the chunks of a log: schemas and channels, samples as one array, events one by one."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema
from numpy.typing import NDArray

from daq.log.framing import RecordFile
from daq.log.message import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    LARGEST_AXES,
    SAMPLES_SCHEMA,
    SAMPLES_TOPIC,
    event_from_bytes,
    sample_dtype,
)
from drivers.event import CellEvent

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")


class ChunkContents:
    """Reads one chunk after the other.

    Args:
        file: that they are in; it names what is wrong.

    Attributes:
        events: of all chunks until now, in the order of the log.
    """

    def __init__(self, file: RecordFile) -> None:
        self.events: list[CellEvent] = []
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def samples(self, offset: int, data: bytes) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Samples of a chunk: at once when it holds nothing else, else picked one by one; its events are kept.

        Args:
            offset: of the chunk in the file, for messages.
            data: what is in it.

        Raises:
            LogCorrupt: a record of it is broken.
            LogForeign: a topic is not what it is in a log of a cell.
        """
        start = self._definitions(offset, data)
        if start == len(data):
            return
        head = self._message_head(offset, data, start)
        if self._topic(head[2]) == SAMPLES_TOPIC:
            count, rest = divmod(len(data) - start, 9 + head[1])
            axes = self._axes(offset, head[1])
            if not rest:
                records = np.frombuffer(data, dtype=sample_dtype(axes), count=count, offset=start)
                words = zip((records[name] for name in ("opcode", "length", "channel")), head[:3], strict=True)
                if all((column == word).all() for column, word in words):
                    yield offset, records
                    return
        yield from self._mixed(offset, data, start)

    def _mixed(self, offset: int, data: bytes, start: int) -> Iterator[tuple[int, NDArray[np.void]]]:
        """A chunk of events and viewers' topics, or one that another tool has packed anew."""
        samples: list[bytes] = []
        while start < len(data):
            opcode, length, channel, _, _, _ = self._message_head(offset, data, start)
            record = data[start : start + 9 + length]
            start += 9 + length
            if opcode != Opcode.MESSAGE:
                continue
            topic = self._topic(channel)
            if topic == SAMPLES_TOPIC:
                samples.append(record)
            elif topic == EVENTS_TOPIC:
                try:
                    self.events.append(event_from_bytes(record[_MESSAGE_HEAD.size :]))
                except (ValueError, struct.error) as error:
                    raise self._file.corrupt(offset, f"a broken event ({error})", EVENTS_SCHEMA) from error
        if samples:
            axes = self._axes(offset, len(samples[0]) - 9)
            dtype = sample_dtype(axes)
            if any(len(sample) != dtype.itemsize for sample in samples):
                raise self._file.corrupt(offset, "samples of different sizes", "one number of axes")
            yield offset, np.frombuffer(b"".join(samples), dtype=dtype)

    def _definitions(self, offset: int, data: bytes) -> int:
        """Take the schemas and channels at the start of a chunk; position of the first message."""
        start = 0
        while start < len(data) and data[start] != Opcode.MESSAGE:
            end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
            if end > len(data):
                raise self._file.corrupt(offset, "a record beyond the end of its chunk", "one inside")
            if data[start] in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self.define(self._file.definition(offset, data[start], data[start + 9 : end]))
            start = end
        return start

    def define(self, record: McapRecord) -> None:
        """Take note of a schema or channel.

        Raises:
            LogForeign: a topic is not what it is in a log of a cell.
        """
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            schema = self._schemas.get(record.schema_id)
            expected = {SAMPLES_TOPIC: SAMPLES_SCHEMA, EVENTS_TOPIC: EVENTS_SCHEMA}.get(record.topic)
            name = schema.name if schema else "no schema"
            if expected and (record.message_encoding != "cdr" or name != expected):
                raise self._file.foreign(
                    f"{record.topic} as {name} in {record.message_encoding!r}", f"{expected} in 'cdr'"
                )
            self._channels[record.id] = record

    def _message_head(self, offset: int, data: bytes, start: int) -> tuple[int, int, int, int, int, int]:
        if start + _MESSAGE_HEAD.size > len(data):
            raise self._file.corrupt(offset, "a message beyond the end of its chunk", "one inside")
        opcode, length, channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data, start)
        if start + 9 + length > len(data):
            raise self._file.corrupt(offset, "a message beyond the end of its chunk", "one inside")
        return opcode, length, channel, sequence, log_time, publish_time

    def _topic(self, channel: int) -> str:
        known = self._channels.get(channel)
        return known.topic if known else ""

    def _axes(self, offset: int, length: int) -> int:
        """Number of axes of samples of this length."""
        for axes in range(1, LARGEST_AXES + 1):
            if sample_dtype(axes).itemsize == 9 + length:
                return axes
        raise self._file.corrupt(offset, f"a sample of {length} bytes", f"1 to {LARGEST_AXES} axes")
