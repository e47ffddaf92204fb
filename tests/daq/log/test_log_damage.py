"""A damaged, foreign or hostile file gets a named error; never silently wrong data."""

from __future__ import annotations

import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer

from daq.errors import (
    LogCorrupt,
    LogForeign,
    LogIncomplete,
    LogMissing,
    LogTruncated,
    LogUnreadable,
)
from daq.log.container import MAGIC
from daq.log.reader import Log, read_log
from tests.daq.logs import content, samples, write


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small log."""
    rows = samples([[k * k, -k] for k in range(450)])
    path = tmp_path_factory.mktemp("logs") / "good.mcap"
    return write(path, content(2), rows)


def _same(one: Log, other: Log) -> bool:
    slots = type(one.samples).__slots__
    pairs = [(getattr(one.samples, n), getattr(other.samples, n)) for n in slots]
    heads = (one.head, one.events, one.statistics) == (other.head, other.events, other.statistics)
    return heads and all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.slow
def test_no_flipped_bit_gives_other_data(good: Path, tmp_path: Path) -> None:
    original = read_log(good)
    data = good.read_bytes()
    chance = random.Random(7)
    refused = 0
    for offset in sorted({*range(0, 200), *(chance.randrange(len(data)) for _ in range(500))}):
        flipped = bytearray(data)
        flipped[offset] ^= 1 << chance.randrange(8)
        path = tmp_path / "flipped.mcap"
        path.write_bytes(flipped)
        try:
            assert _same(read_log(path), original), offset
        except LogUnreadable:
            refused += 1
    assert refused >= 690


def test_no_cut_off_file_is_read(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    chance = random.Random(8)
    for size in {
        0,
        1,
        7,
        8,
        9,
        16,
        len(data) - 1,
        *(chance.randrange(len(data)) for _ in range(100)),
    }:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:size])
        with pytest.raises((LogTruncated, LogForeign)):
            read_log(path)


def test_a_part_missing_in_the_middle_is_noticed(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    path = tmp_path / "hole.mcap"
    path.write_bytes(data[: len(data) // 3] + data[len(data) // 2 :])
    with pytest.raises(LogCorrupt):
        read_log(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(LogMissing, match="no such file"):
        read_log(tmp_path / "none.mcap")
    with pytest.raises(LogMissing, match="directory"):
        read_log(tmp_path)


@pytest.mark.parametrize(
    "text", [b"time,q1\n0,1\n", b"\x89HDF\r\n\x1a\n" + b"\0" * 100, b"\0" * 1000]
)
def test_a_foreign_file(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(text)
    with pytest.raises(LogForeign, match=r"a log .MCAP"):
        read_log(path)


def _foreign(path: Path, profile: str, topic: str, schema: str) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, enable_data_crcs=True)
        writer.start(profile)
        identifier = writer.register_schema(schema, "ros2msg", b"uint8 a\n")
        channel = writer.register_channel(topic, "cdr", identifier)
        writer.add_message(channel, 0, b"\0\1\0\0\1", 0)
        writer.finish()
    return path


def test_mcap_of_others(tmp_path: Path) -> None:
    for profile in ("ros1", "ros2"):
        path = tmp_path / "a.mcap"
        with pytest.raises(
            LogForeign,
            match=r"a bag of mcap-python.* with /x; expected a log of "
            r"drivegain",
        ):
            read_log(_foreign(path, profile, "/x", "a/msg/B"))
    b_path = tmp_path / "b.mcap"
    with pytest.raises(LogForeign, match="/cell/samples as a/msg/B"):
        read_log(_foreign(b_path, "ros2", "/cell/samples", "a/msg/B"))


def _record(opcode: int, body: bytes) -> bytes:
    packed = struct.pack("<BQ", opcode, len(body))
    return packed + body


def _file(path: Path, *records: bytes) -> Path:
    data = MAGIC + b"".join(records)
    body = struct.pack("<I", zlib.crc32(data))
    data += _record(Opcode.DATA_END, body)
    path.write_bytes(data + _record(Opcode.FOOTER, b"\0" * 20) + MAGIC)
    return path


def _chunk(size: int, crc: int, compression: bytes, data: bytes) -> bytes:
    packed = struct.pack("<QQQI", 0, 0, size, crc)
    head = packed + struct.pack("<I", len(compression)) + compression
    body = head + struct.pack("<Q", len(data)) + data
    return _record(Opcode.CHUNK, body)


BOMB = zstandard.compress(b"\0" * 2**27)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (_chunk(100, 1, b"zstd", BOMB), "unfolds to 134217728 bytes"),
        (_chunk(2**40, 1, b"zstd", BOMB), "at most"),
        (_chunk(100, 1, b"zstd", b"nonsense"), "broken chunk"),
        (_chunk(3, 0, b"", b"abc"), "no checksum"),
        (_chunk(3, 1, b"", b"abc"), "checksum"),
        (_chunk(9, zlib.crc32(b"abc"), b"", b"abc"), "a chunk of 3 bytes"),
        (struct.pack("<BQ", Opcode.CHUNK, 2**60), "fits the file"),
        (_record(Opcode.METADATA, struct.pack("<I", 2**31) + b"x"), "broken record|none"),
        (_record(Opcode.ATTACHMENT, b"\1\2"), "attachment with"),
        (_chunk(31, zlib.crc32(b"\5" * 31), b"", b"\5" * 31), "beyond the end"),
    ],
)
def test_a_file_made_to_harm(tmp_path: Path, record: bytes, message: str) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises((LogCorrupt, LogIncomplete), match=message):
        read_log(_file(path, record))


def test_a_log_packed_anew_by_another_tool_is_the_same(good: Path, tmp_path: Path) -> None:
    """Samples, events and viewers' topics in common chunks: slower, and equal."""
    path = tmp_path / "anew.mcap"
    with good.open("rb") as source, path.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, enable_data_crcs=True)
        writer.start("ros2")
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if schema is not None and channel.id not in channels:
                identifier = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, identifier
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    assert _same(read_log(path), read_log(good))


def test_a_log_with_converted_line_ends_is_damaged_and_no_other_file(
    good: Path, tmp_path: Path
) -> None:
    """It was "found a log (MCAP); expected a log (MCAP)"."""
    path = tmp_path / "text-mode.mcap"
    path.write_bytes(good.read_bytes().replace(b"\r\n", b"\n"))
    with pytest.raises(LogCorrupt, match="line ends were converted"):
        read_log(path)


def test_another_version_of_mcap_is_named(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "later.mcap"
    path.write_bytes(good.read_bytes().replace(b"\x89MCAP0", b"\x89MCAP1", 1))
    with pytest.raises(LogForeign, match="MCAP of version b'1'"):
        read_log(path)


def test_a_log_without_a_checksum_was_written_by_another_tool(good: Path, tmp_path: Path) -> None:
    """Its bytes are as that tool wrote them: to copy the file again does not help."""
    data = bytearray(good.read_bytes())
    end = data.rindex(bytes([Opcode.DATA_END]) + struct.pack("<Q", 4))
    data[end + 9 : end + 13] = bytes(4)
    path = tmp_path / "no-checksum.mcap"
    path.write_bytes(data)
    with pytest.raises(LogCorrupt, match=r"with no checksum.*another tool.*take the original"):
        read_log(path)


def test_a_bag_of_another_program_without_a_message_is_no_incomplete_copy(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="rosbag2")
        writer.finish()
    with pytest.raises(LogForeign, match="a bag of rosbag2 without a message"):
        read_log(path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(LogForeign, match="the copy is incomplete"):
        read_log(path)
