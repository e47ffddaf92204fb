"""Read the records of an MCAP file and the messages in its chunks;
every byte is covered by a checksum.

The file may be truncated, damaged or malicious: every length is compared with the size of the file
before memory is allocated, and a record is parsed only from its own bytes. The `mcap` package
parses single records here; its readers do not serve, because they trust lengths inside records and
do not check attachments.
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
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
)
from numpy.typing import NDArray

from daq.config.foreign_files import HEAD_BYTES as FOREIGN_BYTES
from daq.config.foreign_files import foreign_kind
from daq.config.yaml_file import IN_ORDER, MAGIC_OF_LOGS, kind_of_file
from daq.errors import (
    LogCorrupt,
    LogForeign,
    LogMissing,
    LogTruncated,
    LogUnreadable,
    reason_of,
)
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
HEAD_BYTES = 9  #: Kind and length before every record
LARGEST_RECORD = 64 * 2**20  #: [bytes]; our chunks hold 200 ms
LARGEST_CHUNK = 64 * 2**20
LARGEST_RATIO = 200
"""Largest ratio of unpacked bytes to the size of the file, to bound the memory;
our logs have 2 to 20.
"""

RECORDS = 500_000
BYTES_A_RECORD = 4
"""Records that are read one by one, not as an array: so many, and one for so many bytes of the
file. Ours need more bytes each; without a bound, megabytes of equal events take gigabytes and
minutes.
"""
BYTES_A_UNIT = 64  #: An event of so many bytes counts as another record: its text is kept

RecordArray = NDArray[np.void]  #: Records with samples, of `sample_dtype`
PlacedRecord = tuple[int, McapRecord]  #: Offset in the file, and the record there
Record = TypeVar("Record", bound=McapRecord)
_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.CHUNK: Chunk.read,
}


class RecordFile:
    """Iterate over the records of the data section;
    afterwards `sha256` is the digest of the whole file.

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

    def __iter__(self) -> Generator[PlacedRecord, None, None]:
        """Yield offset and record, without the records that only index others.

        The file is open until the last record, or until the generator is closed: who may stop
        before the end, as at an error, closes it. An error that is kept would otherwise keep the
        file open.
        """
        yield from self._opened(self._records)

    def unfinished(self) -> Generator[PlacedRecord, None, None]:
        """Yield the records before the damage of a file without a valid end,
        then raise an error with its place.

        Such a file has only the checksums of chunks and attachments, so an unknown kind of record
        counts as damage. A whole data section ends the iteration without an error.
        """
        yield from self._opened(self._unfinished_records)

    def _opened(
        self, records: Callable[[BinaryIO, int], Iterator[PlacedRecord]]
    ) -> Generator[PlacedRecord, None, None]:
        try:
            with open_regular(self._source) as stream:
                size = os.fstat(stream.fileno()).st_size
                self._allowance = LARGEST_CHUNK + LARGEST_RATIO * size
                self._records_left = RECORDS + size // BYTES_A_RECORD
                yield from records(stream, size)
        except OSError as error:
            raise LogMissing(
                str(self.path),
                found=reason_of(error),
                expected="a log (.mcap)",
                remedy="check the name",
            ) from error

    def _unfinished_records(self, stream: BinaryIO, size: int) -> Iterator[PlacedRecord]:
        self._check_start(stream, size)
        if size < len(MAGIC):
            raise self._truncated(size, None)
        crc = zlib.crc32(MAGIC)
        self.whole_bytes = stream.seek(len(MAGIC))
        while True:
            offset = self.whole_bytes
            head = stream.read(HEAD_BYTES)
            if len(head) < HEAD_BYTES:
                raise self._truncated(offset + len(head), offset)
            opcode = head[0]
            length = _length(head)
            if length > LARGEST_RECORD:
                raise self.corrupt(
                    offset, f"a record of {length} bytes", f"at most {LARGEST_RECORD}"
                )
            body = stream.read(length)
            if len(body) < length:
                raise self._truncated(offset + HEAD_BYTES + len(body), offset)
            if opcode == Opcode.DATA_END:
                self._check_crc(
                    offset,
                    "data section",
                    _parse(DataEnd.read, body, self, offset).data_section_crc,
                    crc,
                )
                return
            crc = zlib.crc32(body, zlib.crc32(head, crc))
            if opcode == Opcode.MESSAGE_INDEX:
                if length < 6 or length != 6 + int.from_bytes(body[2:6], "little"):
                    raise self.corrupt(offset, "a broken index", "one of the chunk before it")
            elif opcode not in _PARSERS:
                raise self.corrupt(
                    offset, f"a record of kind {opcode:#04x}", "one of a data section"
                )
            yield from self._record(offset, opcode, body)
            self.whole_bytes += HEAD_BYTES + length

    def _records(self, stream: BinaryIO, size: int) -> Iterator[PlacedRecord]:
        self._check_start(stream, size)
        self._check_end(stream, size)
        digest = hashlib.sha256(MAGIC)
        crc = zlib.crc32(MAGIC)
        offset = stream.seek(len(MAGIC))
        end = size - len(MAGIC)
        opcode = 0
        in_data = True
        while in_data or opcode != Opcode.FOOTER:
            if offset == end:
                raise self.corrupt(offset, "no footer", "one before the end")
            head = stream.read(HEAD_BYTES)
            length = _length(head)
            if not head or length > min(end - offset - HEAD_BYTES, LARGEST_RECORD):
                raise self.corrupt(offset, f"a record of {length} bytes", "one that fits the file")
            opcode = head[0]
            body = stream.read(length)
            digest.update(head)
            digest.update(body)
            if in_data and opcode == Opcode.DATA_END:
                self._check_crc(
                    offset,
                    "data section",
                    _parse(DataEnd.read, body, self, offset).data_section_crc,
                    crc,
                )
                crc = 0
                in_data = False
            elif in_data:
                crc = zlib.crc32(body, zlib.crc32(head, crc))
                yield from self._record(offset, opcode, body)
            elif opcode == Opcode.FOOTER:
                crc = zlib.crc32(body[:16], zlib.crc32(head, crc))
                self._check_crc(
                    offset, "summary", _parse(Footer.read, body, self, offset).summary_crc, crc
                )
            else:
                crc = zlib.crc32(body, zlib.crc32(head, crc))
            offset += HEAD_BYTES + length
        if offset != end:
            raise self.corrupt(offset, f"{end - offset} bytes after the footer", "none")
        digest.update(MAGIC)
        self.sha256 = digest.hexdigest()

    def _record(self, offset: int, opcode: int, body: bytes) -> Iterator[PlacedRecord]:
        if opcode == Opcode.ATTACHMENT:
            stored = int.from_bytes(body[-4:], "little")
            self._check_crc(offset, "attachment", stored, zlib.crc32(body[:-4]))
        if opcode in _PARSERS:
            yield offset, _parse(_PARSERS[opcode], body, self, offset)

    def _check_start(self, stream: BinaryIO, size: int) -> None:
        start = stream.read(len(MAGIC))
        if 0 < size < len(MAGIC) and MAGIC.startswith(start):
            raise self._truncated(size, None)
        if start.startswith(MAGIC_OF_LOGS) and not MAGIC.startswith(start):
            raise self._other_mark(start)
        if not MAGIC.startswith(start):
            raise self._other_file(start, start + stream.read(FOREIGN_BYTES))

    def _other_file(self, start: bytes, head: bytes) -> LogForeign:
        """Make the error for a file that is no MCAP file, from its first bytes."""
        remedy = f"is this the right file? {IN_ORDER}"
        is_text = all(byte in b"\t\n\r" or 0x20 <= byte < 0x7F for byte in start)
        kind = kind_of_file(self.path)
        foreign = foreign_kind(head)
        if foreign is not None:
            found = foreign.value
            remedy = foreign.remedy
        elif kind is not None:
            found = kind.value
        elif is_text:
            found = f"a text file that begins with {start.decode()!r}"
        else:
            found = f"first bytes {start!r}"
        return LogForeign(str(self.path), found=found, expected="a log (MCAP)", remedy=remedy)

    def _other_mark(self, start: bytes) -> LogUnreadable:
        """Make the error for an MCAP file with another opening mark than ours.

        The mark ends in a carriage return and a line feed, so that a copy in text mode shows.
        """
        at_version = slice(len(MAGIC_OF_LOGS), len(MAGIC_OF_LOGS) + 1)
        version = start[at_version]
        if version == MAGIC[at_version]:
            return LogCorrupt(
                f"{self.path}, byte 0",
                found=f"an opening mark of {start!r}",
                expected=f"{MAGIC!r}",
                remedy="its line ends were converted, or it was damaged: copy it again from where "
                "it was recorded, as a binary file",
            )
        return LogForeign(
            str(self.path),
            found=f"MCAP of version {version!r}",
            expected="a log (MCAP of version 0)",
            remedy="convert the file with a tool for MCAP",
        )

    def _check_end(self, stream: BinaryIO, size: int) -> None:
        stream.seek(max(0, size - len(MAGIC)))
        if size < 2 * len(MAGIC) or stream.read(len(MAGIC)) != MAGIC:
            raise self._truncated(size, None)

    def _truncated(self, size: int, good: int | None) -> LogTruncated:
        return LogTruncated(
            str(self.path),
            found=f"{size} bytes without the closing "
            "mark" + ("" if good is None else f", whole records up to {good}"),
            expected="a finished log",
            remedy="the recorder was killed or the copy is incomplete: copy it again, or use "
            "`drivegain salvage`",
        )

    def _check_crc(self, offset: int, what: str, stored: int, computed: int) -> None:
        # 0 means "not computed" in MCAP; our logs always have one, and without it a flipped bit
        # would pass for data.
        if stored == 0 or stored != computed:
            if stored == 0:
                raise LogCorrupt(
                    f"{self.path}, byte {offset}",
                    found=f"{what} with no checksum",
                    expected="contents that match their checksum",
                    remedy="another tool may have written or cut the log: take the original",
                )
            found = f"checksum {stored:#010x} and contents of {computed:#010x}"
            raise self.corrupt(offset, f"{what} with {found}", "contents that match their checksum")

    def corrupt(self, offset: int, found: str, expected: str) -> LogCorrupt:
        """Make the error for a place in this file."""
        return LogCorrupt(
            f"{self.path}, byte {offset}",
            found=found,
            expected=expected,
            remedy="the file was damaged after it was written; copy it again from where it "
            "was recorded",
        )

    def foreign(self, found: str, expected: str) -> LogForeign:
        """Make the error for an MCAP file that is not a log of a cell."""
        return LogForeign(
            str(self.path), found=found, expected=expected, remedy="is this a log of a cell?"
        )

    def spend(self, offset: int, kept_bytes: int = 0) -> None:
        """Count a record that is read by itself, with the bytes of it that are kept.

        Raises:
            LogCorrupt: there are more than a recording of this size has.
        """
        self._records_left -= 1 + kept_bytes // BYTES_A_UNIT
        if self._records_left < 0:
            raise self.corrupt(offset, "too many messages for a file of its size", "a recording")

    def records_inside(self, offset: int, data: bytes) -> Iterator[tuple[int, int, int]]:
        """Yield kind, start and end of each record of a chunk.

        Raises:
            LogCorrupt: one is longer than the chunk, or there are more than a recording of this
                size has.
        """
        start = 0
        while start < len(data):
            self.spend(offset)
            end = start + HEAD_BYTES + _length(data[start : start + HEAD_BYTES])
            if end > len(data):
                raise self.corrupt(offset, "a record beyond the end of its chunk", "one inside")
            yield data[start], start, end
            start = end

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
            raise self.corrupt(
                offset, f"chunks that unfold to {LARGEST_RATIO} times the file", "a recording"
            )
        if chunk.compression not in {"zstd", "lz4", ""}:
            raise LogForeign(
                str(self.path),
                found=f"chunks in {chunk.compression!r}",
                expected="zstd or lz4",
                remedy="convert the file with a tool for MCAP",
            )
        data = chunk.data
        try:
            if chunk.compression == "zstd":
                claimed = zstandard.frame_content_size(data)
                if claimed > size:
                    raise self.corrupt(
                        offset, f"a chunk that unfolds to {claimed} bytes", f"{size}, as declared"
                    )
                data = self._zstd.decompress(data, max_output_size=size)
            elif chunk.compression == "lz4":
                data = LZ4FrameDecompressor().decompress(data, max_length=size)
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise self.corrupt(offset, f"a broken chunk ({error})", chunk.compression) from error
        if len(data) != size:
            raise self.corrupt(offset, f"a chunk of {len(data)} bytes", f"{size}, as declared")
        self._check_crc(offset, "chunk", chunk.uncompressed_crc, zlib.crc32(data))
        return data


def _length(head: bytes) -> int:
    """Return the length of the body of a record."""
    return int.from_bytes(head[1:], "little")


def _parse(
    read: Callable[[ReadDataStream], Record], body: bytes, file: RecordFile, offset: int
) -> Record:
    """Parse a record from its own bytes only."""
    stream = BytesIO(body)
    try:
        return read(ReadDataStream(stream))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise file.corrupt(
            offset, f"a broken record ({type(error).__name__})", "an MCAP record"
        ) from error


_MESSAGE_HEAD_BYTES = HEAD_BYTES + 22  #: Kind, length, channel, sequence and two times
_QUANTITIES = {topic: quantity for quantity, topic in READING_TOPICS.items()}
#: Topics that a fit needs; the others are for viewers
_READ = (SAMPLES_TOPIC, EVENTS_TOPIC, *_QUANTITIES)


class ChunkContents:
    """Reader of chunks, one after the other:
    schemas and channels, samples as one array, events one by one.
    """

    def __init__(self, file: RecordFile) -> None:
        self.events: list[CellEvent] = []  #: of all chunks so far, in the order of the log
        self.readings: list[SlowReading] = []  #: likewise
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, str] = {}

    def samples(self, offset: int, data: bytes) -> Iterator[tuple[int, RecordArray]]:
        """Yield the samples of a chunk, all at once if it holds nothing else;
        its events and readings are collected.

        Args:
            offset: offset of the chunk in the file, for messages.
            data: its content.

        Raises:
            LogCorrupt: a record is broken.
            LogForeign: a topic has another type than in a log of a cell.
        """
        samples: list[bytes] = []
        for opcode, start, end in self._file.records_inside(offset, data):
            if opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self.define(
                    _parse(_PARSERS[opcode], data[start + HEAD_BYTES : end], self._file, offset)
                )
            if opcode != Opcode.MESSAGE:
                continue
            channel = int.from_bytes(data[start + HEAD_BYTES : start + HEAD_BYTES + 2], "little")
            topic = self._topics.get(channel)
            body = data[start + _MESSAGE_HEAD_BYTES : end]
            if topic == SAMPLES_TOPIC:
                if not samples:
                    alike = self._samples_alike(offset, data, start, end)
                    if alike is not None:
                        yield offset, alike
                        return
                samples.append(data[start:end])
            elif topic == EVENTS_TOPIC:
                self._file.spend(offset, len(body))
                try:
                    self.events.append(event_from_bytes(body))
                except (ValueError, struct.error) as error:
                    raise self._file.corrupt(
                        offset, f"a broken event ({error})", EVENTS_SCHEMA
                    ) from error
            elif topic in _QUANTITIES:
                try:
                    self.readings.append(reading_from_bytes(body, _QUANTITIES[topic]))
                except (ValueError, struct.error) as error:
                    raise self._file.corrupt(
                        offset, f"a broken reading ({error})", READING_SCHEMA
                    ) from error
        if samples:
            axes = self._axes(offset, len(samples[0]))
            dtype = sample_dtype(axes)
            if any(len(sample) != dtype.itemsize for sample in samples):
                raise self._file.corrupt(offset, "samples of different sizes", "one number of axes")
            yield offset, np.frombuffer(b"".join(samples), dtype=dtype)

    def _samples_alike(self, offset: int, data: bytes, start: int, end: int) -> RecordArray | None:
        """Return the rest of a chunk as one array, if it holds nothing but samples as the first one
        of them.
        """
        dtype = sample_dtype(self._axes(offset, end - start))
        if (len(data) - start) % dtype.itemsize:
            return None
        records = np.frombuffer(data, dtype=dtype, offset=start)
        heads = records[["opcode", "length", "channel"]]
        return records if (heads == heads[0]).all() else None

    def define(self, record: McapRecord) -> None:
        """Register a schema or channel.

        Raises:
            LogForeign: a topic has another type than in a log of a cell.
        """
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            schema = self._schemas.get(record.schema_id)
            if record.topic in _READ:
                expected = SCHEMA_OF[record.topic]
            else:
                expected = None
            name = schema.name if schema else "no schema"
            if expected and (record.message_encoding != "cdr" or name != expected):
                raise self._file.foreign(
                    f"{record.topic} as {name} in {record.message_encoding!r}",
                    f"{expected} in 'cdr'",
                )
            self._topics[record.id] = record.topic

    def _axes(self, offset: int, size: int) -> int:
        """Return the number of axes of samples of this size, as records."""
        for axes in range(1, LARGEST_AXES + 1):
            if sample_dtype(axes).itemsize == size:
                return axes
        raise self._file.corrupt(
            offset, f"a sample of {size - HEAD_BYTES} bytes", f"1 to {LARGEST_AXES} axes"
        )
