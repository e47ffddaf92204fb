"""Read the records of an MCAP file and the messages in its chunks; every byte is covered by a checksum.

The file may be truncated, damaged or malicious: every length is compared with the size of the file before memory is
allocated, and a record is parsed only from its own bytes. The `mcap` package parses single records here; its readers do
not serve, because they trust lengths inside records and do not check attachments.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Metadata, Schema
from numpy.typing import NDArray

from daq.config.document_kind import IN_ORDER
from daq.config.yaml_file import kind_of_file
from daq.errors import LogCorrupt, LogForeign, LogMissing, LogTruncated
from daq.files import open_regular
from daq.log.message import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    LARGEST_AXES,
    READING_SCHEMA,
    READING_TOPICS,
    SAMPLES_TOPIC,
    SCHEMA_OF,
    event_from_bytes,
    reading_from_bytes,
    sample_dtype,
)
from drivers.messages import CellEvent, SlowReading

MAGIC = b"\x89MCAP0\r\n"
UNFINISHED = ".part"  #: Suffix of a log that is being written, or whose recorder has died
LARGEST_RECORD = 64 * 2**20  #: [bytes]; our chunks hold 200 ms
LARGEST_CHUNK = 64 * 2**20
LARGEST_RATIO = 200
"""Largest ratio of unpacked bytes to the size of the file, to bound the memory; our logs have 2 to 20."""

RECORDS, BYTES_A_RECORD = 500_000, 4
"""Records that are read one by one, not as an array: so many, and one for so many bytes of the file. Ours need more
bytes each; without a bound, megabytes of equal events take gigabytes and minutes."""
BYTES_A_UNIT = 64  #: An event of so many bytes counts as another record: its text is kept

Record = TypeVar("Record", bound=McapRecord)
_PARSERS: tuple[tuple[Opcode, Callable[[ReadDataStream], McapRecord]], ...] = (
    (Opcode.HEADER, Header.read),
    (Opcode.SCHEMA, Schema.read),
    (Opcode.CHANNEL, Channel.read),
    (Opcode.ATTACHMENT, Attachment.read),
    (Opcode.METADATA, Metadata.read),
    (Opcode.CHUNK, Chunk.read),
)


class RecordFile:
    """Iterate over the records of the data section; afterwards `sha256` is the digest of the whole file.

    During `unfinished`, everything before `whole_bytes` is undamaged.

    Raises (while iterating):
        LogMissing, LogForeign, LogTruncated, LogCorrupt: with the offset in the file.
    """

    def __init__(self, path: Path, source: Path | None = None) -> None:
        """Store the path, and where the content is if not there."""
        self.path = path
        self._source = source or path
        self.sha256 = ""
        self.whole_bytes = 0
        self._allowance = self._records_left = 0
        self._zstd = zstandard.ZstdDecompressor()

    def __iter__(self) -> Generator[tuple[int, McapRecord], None, None]:
        """Yield offset and record, without the records that only index others.

        The file is open until the last record, or until the generator is closed: who may stop before the end, as at an
        error, closes it. An error that is kept would otherwise keep the file open.
        """
        yield from self._opened(self._records)

    def unfinished(self) -> Generator[tuple[int, McapRecord], None, None]:
        """Yield the records before the damage of a file without a valid end, then raise an error with its place.

        Such a file has only the checksums of chunks and attachments, so an unknown kind of record counts as damage. A
        whole data section ends the iteration without an error.
        """
        yield from self._opened(self._unfinished_records)

    def _opened(
        self, records: Callable[[BinaryIO, int], Iterator[tuple[int, McapRecord]]]
    ) -> Generator[tuple[int, McapRecord], None, None]:
        try:
            with open_regular(self._source) as stream:
                size = os.fstat(stream.fileno()).st_size
                self._allowance = LARGEST_CHUNK + LARGEST_RATIO * size
                self._records_left = RECORDS + size // BYTES_A_RECORD
                yield from records(stream, size)
        except OSError as error:
            raise LogMissing(
                str(self.path),
                found=(error.strerror or type(error).__name__).lower(),
                expected="a log (.mcap)",
                remedy="check the name",
            ) from error

    def _unfinished_records(self, stream: BinaryIO, size: int) -> Iterator[tuple[int, McapRecord]]:
        self._check_start(stream, size)
        crc = zlib.crc32(MAGIC)
        offset = stream.seek(len(MAGIC))
        while True:
            self.whole_bytes = offset
            head = stream.read(9)
            opcode, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, LARGEST_RECORD)
            if length > LARGEST_RECORD:
                raise self.corrupt(offset, f"a record of {length} bytes", f"at most {LARGEST_RECORD}")
            body = stream.read(length) if len(head) == 9 else b""
            if len(body) < length:
                raise self._truncated(offset + len(head) + len(body), offset)
            if opcode == Opcode.DATA_END:
                self._check_crc(offset, "data section", _parse(DataEnd.read, body, self, offset).data_section_crc, crc)
                return
            crc = zlib.crc32(body, zlib.crc32(head, crc))
            if opcode == Opcode.MESSAGE_INDEX:
                if length < 6 or length != 6 + int.from_bytes(body[2:6], "little"):
                    raise self.corrupt(offset, "a broken index", "one of the chunk before it")
            elif all(opcode != known for known, _ in _PARSERS):
                raise self.corrupt(offset, f"a record of kind {opcode:#04x}", "one of a data section")
            yield from self._record(offset, opcode, body)
            offset += 9 + length

    def _records(self, stream: BinaryIO, size: int) -> Iterator[tuple[int, McapRecord]]:
        self._check_start(stream, size)
        self._check_end(stream, size)
        digest = hashlib.sha256(MAGIC)
        crc = zlib.crc32(MAGIC)
        offset = stream.seek(len(MAGIC))
        in_data = True
        while offset < size - len(MAGIC):
            head = stream.read(9)
            opcode, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, size)
            if length > min(size - len(MAGIC) - offset - 9, LARGEST_RECORD):
                raise self.corrupt(offset, f"a record of {length} bytes", "one that fits the file")
            body = stream.read(length)
            digest.update(head)
            digest.update(body)
            if opcode == Opcode.DATA_END and in_data:
                self._check_crc(offset, "data section", _parse(DataEnd.read, body, self, offset).data_section_crc, crc)
                crc, in_data = 0, False
            elif opcode == Opcode.FOOTER and not in_data:
                crc = zlib.crc32(body[:16], zlib.crc32(head, crc))
                self._check_crc(offset, "summary", _parse(Footer.read, body, self, offset).summary_crc, crc)
                offset += 9 + length
                break
            else:
                crc = zlib.crc32(body, zlib.crc32(head, crc))
                if in_data:
                    yield from self._record(offset, opcode, body)
            offset += 9 + length
        else:
            raise self.corrupt(offset, "no footer", "one before the end")
        if offset != size - len(MAGIC):
            raise self.corrupt(offset, f"{size - len(MAGIC) - offset} bytes behind the footer", "none")
        digest.update(MAGIC)
        self.sha256 = digest.hexdigest()

    def _record(self, offset: int, opcode: int, body: bytes) -> Iterator[tuple[int, McapRecord]]:
        if opcode == Opcode.ATTACHMENT:
            stored = int.from_bytes(body[-4:], "little")
            self._check_crc(offset, "attachment", stored, zlib.crc32(body[:-4]))
        for known, read in _PARSERS:
            if opcode == known:
                yield offset, _parse(read, body, self, offset)

    def _check_start(self, stream: BinaryIO, size: int) -> None:
        start = stream.read(len(MAGIC))
        if start != MAGIC[: len(start)] or (size < len(MAGIC) and size > 0):
            is_text = all(byte in b"\t\n\r" or 0x20 <= byte < 0x7F for byte in start)
            kind = kind_of_file(self.path)
            if kind is not None:
                found = kind.value
            elif is_text:
                found = f"a text file that begins with {start.decode()!r}"
            else:
                found = f"first bytes {start!r}"
            raise LogForeign(
                str(self.path), found=found, expected="a log (MCAP)", remedy=f"is this the right file? {IN_ORDER}"
            )

    def _check_end(self, stream: BinaryIO, size: int) -> None:
        stream.seek(max(0, size - len(MAGIC)))
        if size < 2 * len(MAGIC) or stream.read(len(MAGIC)) != MAGIC:
            raise self._truncated(size, None)

    def _truncated(self, size: int, good: int | None) -> LogTruncated:
        return LogTruncated(
            str(self.path),
            found=f"{size} bytes without the closing mark" + ("" if good is None else f", whole records up to {good}"),
            expected="a finished log",
            remedy="the recorder was killed or the copy is incomplete: copy it again, or use `drivegain salvage`",
        )

    def _check_crc(self, offset: int, what: str, stored: int, computed: int) -> None:
        # 0 means "not computed" in MCAP; our logs always have one, and without it a flipped bit would pass for data.
        if stored == 0 or stored != computed:
            found = "no checksum" if stored == 0 else f"checksum {stored:#010x} and contents of {computed:#010x}"
            raise self.corrupt(offset, f"{what} with {found}", "contents that match their checksum")

    def corrupt(self, offset: int, found: str, expected: str) -> LogCorrupt:
        """Make the error for a place in this file."""
        return LogCorrupt(
            f"{self.path}, byte {offset}",
            found=found,
            expected=expected,
            remedy="the file was damaged after it was written; copy it again from where it was recorded",
        )

    def foreign(self, found: str, expected: str) -> LogForeign:
        """Make the error for an MCAP file that is not a log of a cell."""
        return LogForeign(str(self.path), found=found, expected=expected, remedy="is this a log of a cell?")

    def spend(self, offset: int, kept_bytes: int = 0) -> None:
        """Count a record that is read by itself, with the bytes of it that are kept.

        Raises:
            LogCorrupt: there are more than a recording of this size has.
        """
        self._records_left -= 1 + kept_bytes // BYTES_A_UNIT
        if self._records_left < 0:
            raise self.corrupt(offset, "too many messages for a file of its size", "a recording")

    def unpack(self, offset: int, chunk: Chunk) -> bytes:
        """Decompress a chunk.

        Raises:
            LogForeign: another compression than zstd or lz4.
            LogCorrupt: too large, broken, or of another checksum.
        """
        size = chunk.uncompressed_size
        if size > LARGEST_CHUNK:
            raise self.corrupt(offset, f"a chunk of {size} bytes", f"at most {LARGEST_CHUNK}")
        self._allowance -= size
        if self._allowance < 0:
            raise self.corrupt(offset, f"chunks that unfold to {LARGEST_RATIO} times the file", "a recording")
        if chunk.compression not in {"zstd", "lz4", ""}:
            raise LogForeign(
                str(self.path),
                found=f"chunks in {chunk.compression!r}",
                expected="zstd or lz4",
                remedy="convert the file with a tool for MCAP",
            )
        data = chunk.data
        if chunk.compression == "zstd":
            try:
                claimed = zstandard.frame_content_size(data)
                if claimed > size:
                    raise self.corrupt(offset, f"a chunk that unfolds to {claimed} bytes", f"{size}, as declared")
                data = self._zstd.decompress(data, max_output_size=size)
            except zstandard.ZstdError as error:
                raise self.corrupt(offset, f"a broken chunk ({error})", "zstd") from error
        elif chunk.compression == "lz4":
            try:
                data = LZ4FrameDecompressor().decompress(data, max_length=size)
            except (RuntimeError, EOFError) as error:
                raise self.corrupt(offset, f"a broken chunk ({error})", "lz4") from error
        if len(data) != size:
            raise self.corrupt(offset, f"a chunk of {len(data)} bytes", f"{size}, as declared")
        self._check_crc(offset, "chunk", chunk.uncompressed_crc, zlib.crc32(data))
        return data


def _parse(read: Callable[[ReadDataStream], Record], body: bytes, file: RecordFile, offset: int) -> Record:
    """Parse a record from its own bytes only."""
    stream = BytesIO(body)
    try:
        return read(ReadDataStream(stream))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise file.corrupt(offset, f"a broken record ({type(error).__name__})", "an MCAP record") from error


_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_QUANTITIES = {topic: quantity for quantity, topic in READING_TOPICS.items()}
_READ = (SAMPLES_TOPIC, EVENTS_TOPIC, *_QUANTITIES)  #: Topics that a fit needs; the others are for viewers


class ChunkContents:
    """Reader of chunks, one after the other: schemas and channels, samples as one array, events one by one."""

    def __init__(self, file: RecordFile) -> None:
        self.events: list[CellEvent] = []  #: of all chunks so far, in the order of the log
        self.readings: list[SlowReading] = []  #: likewise
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def samples(self, offset: int, data: bytes) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the samples of a chunk, all at once if it holds nothing else; its events and readings are collected.

        Args:
            offset: offset of the chunk in the file, for messages.
            data: its content.

        Raises:
            LogCorrupt: a record is broken.
            LogForeign: a topic has another type than in a log of a cell.
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
        """Yield the samples of a chunk with events and viewers' topics, or repacked by another tool."""
        samples: list[bytes] = []
        while start < len(data):
            opcode, length, channel, _, _, _ = self._message_head(offset, data, start)
            record = data[start : start + 9 + length]
            start += 9 + length
            self._file.spend(offset)
            if opcode != Opcode.MESSAGE:
                continue
            topic = self._topic(channel)
            if topic == SAMPLES_TOPIC:
                samples.append(record)
            elif topic == EVENTS_TOPIC:
                self._file.spend(offset, length)
                try:
                    self.events.append(event_from_bytes(record[_MESSAGE_HEAD.size :]))
                except (ValueError, struct.error) as error:
                    raise self._file.corrupt(offset, f"a broken event ({error})", EVENTS_SCHEMA) from error
            elif topic in _QUANTITIES:
                try:
                    self.readings.append(reading_from_bytes(record[_MESSAGE_HEAD.size :], _QUANTITIES[topic]))
                except (ValueError, struct.error) as error:
                    raise self._file.corrupt(offset, f"a broken reading ({error})", READING_SCHEMA) from error
        if samples:
            axes = self._axes(offset, len(samples[0]) - 9)
            dtype = sample_dtype(axes)
            if any(len(sample) != dtype.itemsize for sample in samples):
                raise self._file.corrupt(offset, "samples of different sizes", "one number of axes")
            yield offset, np.frombuffer(b"".join(samples), dtype=dtype)

    def _definitions(self, offset: int, data: bytes) -> int:
        """Read the schemas and channels at the start of a chunk; return the position of the first message."""
        start = 0
        while start < len(data) and data[start] != Opcode.MESSAGE:
            self._file.spend(offset)
            end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
            if end > len(data):
                raise self._file.corrupt(offset, "a record beyond the end of its chunk", "one inside")
            if data[start] in {Opcode.SCHEMA, Opcode.CHANNEL}:
                read = Schema.read if data[start] == Opcode.SCHEMA else Channel.read
                self.define(_parse(read, data[start + 9 : end], self._file, offset))
            start = end
        return start

    def define(self, record: McapRecord) -> None:
        """Register a schema or channel.

        Raises:
            LogForeign: a topic has another type than in a log of a cell.
        """
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            schema = self._schemas.get(record.schema_id)
            expected = SCHEMA_OF[record.topic] if record.topic in _READ else None
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
        """Return the number of axes of samples of this length."""
        for axes in range(1, LARGEST_AXES + 1):
            if sample_dtype(axes).itemsize == 9 + length:
                return axes
        raise self._file.corrupt(offset, f"a sample of {length} bytes", f"1 to {LARGEST_AXES} axes")
