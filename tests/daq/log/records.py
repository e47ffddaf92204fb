"""Records of an MCAP file with right checksums, made up for tests:
an attacker can make them too.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zstandard
from mcap.opcode import Opcode

from daq.log.container import MAGIC
from daq.log.message import (
    DEFINITIONS,
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    SAMPLES_SCHEMA,
    SAMPLES_TOPIC,
    sample_dtype,
)


def raw_record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    """Opcode, length and body; another length than the body's if given."""
    packed = struct.pack("<BQ", opcode, len(body) if length is None else length)
    return packed + body


def cdr_text(text: str) -> bytes:
    """Length and characters."""
    packed = struct.pack("<I", len(text.encode()))
    return packed + text.encode()


def finished_file(path: Path, records: list[bytes]) -> Path:
    """A file of these records, with both checksums."""
    data = MAGIC + b"".join(records)
    body = struct.pack("<I", zlib.crc32(data))
    data += raw_record(Opcode.DATA_END, body)
    packed = struct.pack("<QQ", 0, 0)
    footer = raw_record(Opcode.FOOTER, packed)[:9].replace(b"\x10", b"\x14", 1) + struct.pack(
        "<QQ", 0, 0
    )
    content = data + footer + struct.pack("<I", zlib.crc32(footer)) + MAGIC
    path.write_bytes(content)
    return path


def metadata_record(name: str, entries: dict[str, str]) -> bytes:
    """A metadata record."""
    pairs = b"".join(cdr_text(key) + cdr_text(value) for key, value in entries.items())
    body = cdr_text(name) + struct.pack("<I", len(pairs)) + pairs
    return raw_record(Opcode.METADATA, body)


def attachment_record(name: str, data: bytes) -> bytes:
    """An attachment with its checksum."""
    packed = struct.pack("<QQ", 0, 0)
    body = packed + cdr_text(name) + cdr_text("") + struct.pack("<Q", len(data)) + data
    return raw_record(Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))


def chunk_record(data: bytes, size: int | None = None, compression: str = "zstd") -> bytes:
    """A chunk with its checksum."""
    if compression == "zstd":
        packed = zstandard.compress(data)
    else:
        packed = data
    head = struct.pack(
        "<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data)
    ) + cdr_text(compression)
    body = head + struct.pack("<Q", len(packed)) + packed
    return raw_record(Opcode.CHUNK, body)


def definitions(topic: str, schema: str, number: int) -> bytes:
    """Schema and channel of a topic."""
    packed = struct.pack("<H", number)
    described = packed + cdr_text(schema) + cdr_text("ros2msg") + cdr_text(DEFINITIONS[schema])
    channel = (
        struct.pack("<HH", number, number)
        + cdr_text(topic)
        + cdr_text("cdr")
        + struct.pack("<I", 0)
    )
    return raw_record(Opcode.SCHEMA, described) + raw_record(Opcode.CHANNEL, channel)


HEADER = raw_record(Opcode.HEADER, cdr_text("ros2") + cdr_text("test"))
TOPICS = definitions(SAMPLES_TOPIC, SAMPLES_SCHEMA, 1) + definitions(EVENTS_TOPIC, EVENTS_SCHEMA, 2)


def sample_records(cycle: Sequence[int], time_ns: Sequence[int], axes: int = 6) -> bytes:
    """Messages of samples at rest, shape (k,) each; one chunk holds some of them."""
    made = np.zeros(len(cycle), dtype=sample_dtype(axes))
    length = made.itemsize - 9
    heads = {
        "opcode": Opcode.MESSAGE,
        "length": length,
        "channel": 1,
        "encapsulation": 0x100,
    }
    for name, value in {
        **heads,
        **dict.fromkeys(("positions", "currents", "statuswords"), axes),
    }.items():
        made[name] = value
    made["cycle"] = cycle
    made["seconds"], made["nanoseconds"] = np.divmod(
        np.asarray(time_ns, dtype=np.int64), 1_000_000_000
    )
    return made.tobytes()
