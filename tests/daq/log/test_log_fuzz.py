"""Foreign and damaged files: a reader returns a log of the same numbers or raises a named error.

Three kinds of attack: damage to a genuine log, records made up with right checksums, and genuine
chunks with made-up messages inside. Bounded in time by the number of examples; derandomised, so
that a failure is one tomorrow too.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import Writer as McapWriter

from daq.errors import LogUnreadable
from daq.log.message import sample_dtype
from daq.log.metadata import READBACK, RUN, STATISTICS, run_record, sealed, statistics_record
from daq.log.reader import Log, LogReader, SampleBlock, read_log
from drivers.messages import CellEvent, EventKind
from tests.daq.log.records import (
    HEADER,
    TOPICS,
    attachment_record,
    chunk_record,
    finished_file,
    metadata_record,
    raw_record,
)
from tests.daq.logs import START_NS, content, samples, write

FUZZ = settings(
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
BITS64, BITS32, BITS16 = (st.integers(0, 2**bits - 1) for bits in (64, 32, 16))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small log."""
    rows = samples([[k * k, -k] for k in range(320)])
    events = [CellEvent(START_NS, None, EventKind.MOVE_START, k, "move") for k in range(3)]
    path = tmp_path_factory.mktemp("logs") / "good.mcap"
    return write(path, content(2), rows, events)


def _attack(path: Path, original: Log | None) -> None:
    """Read as a fit does and as salvage does;
    only a named error, or the numbers of the original, may come of it.
    """
    try:
        log = read_log(path)
    except LogUnreadable:
        pass
    else:
        assert original is None or _same(log, original)
    reader = LogReader(path)
    done = 0
    for block in reader.until_damage():
        if original is not None:
            for name in SampleBlock.__slots__:
                then = getattr(original.samples, name)[done : done + len(block.cycle)]
                assert np.array_equal(getattr(block, name), then), name
        done += len(block.cycle)
    if done:
        try:
            head = reader.head
        except LogUnreadable:
            return
        assert original is None or head == original.head


def _same(one: Log, other: Log) -> bool:
    heads = (one.head, one.events, one.statistics) == (other.head, other.events, other.statistics)
    pairs = (
        (getattr(one.samples, name), getattr(other.samples, name)) for name in SampleBlock.__slots__
    )
    return heads and all(np.array_equal(*pair) for pair in pairs)


DAMAGE = st.lists(
    st.tuples(
        st.sampled_from(("flip", "cut", "remove", "repeat", "fill", "insert")),
        st.floats(0.0, 1.0, exclude_max=True),
        st.integers(0, 7),
        st.integers(1, 600),
        st.binary(min_size=1, max_size=40),
    ),
    min_size=1,
    max_size=4,
)


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(DAMAGE)
def test_no_damage_gives_other_numbers(
    good: Path, tmp_path: Path, damage: list[tuple[str, float, int, int, bytes]]
) -> None:
    original = read_log(good)
    data = bytearray(good.read_bytes())
    for kind, where, bit, length, noise in damage:
        at = int(where * len(data))
        if not data:
            break
        if kind == "flip":
            data[at] ^= 1 << bit
        elif kind == "cut":
            del data[at:]
        elif kind == "remove":
            del data[at : at + length]
        elif kind == "repeat":
            data[at:at] = data[at : at + length]
        elif kind == "fill":
            data[at : at + length] = noise[:1] * len(data[at : at + length])
        else:
            data[at:at] = noise
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    _attack(path, original)


TEXTS = st.text(max_size=12) | st.sampled_from(
    ("0", "-1", "nan", "1e999", "{}", "[]", "[[", "true", "null", "9" * 5000)
)


@st.composite
def _records(draw: st.DrawFn) -> bytes:
    sampled = st.sampled_from(("any", "metadata", "attachment", "chunk", "length"))
    kind = draw(sampled)
    if kind == "any":
        opcode = draw(st.integers(0, 255))
        body = draw(st.binary(max_size=60))
        return raw_record(opcode, body)
    if kind == "length":
        return raw_record(draw(st.integers(1, 15)), draw(st.binary(max_size=20)), draw(BITS64))
    if kind == "metadata":
        start = content(2)
        if draw(st.booleans()):
            base = run_record(start.run)
        else:
            base = {"samples": "1", "missing": "[0, 0]", "valid": "true"}
        entries = base | draw(st.dictionaries(st.sampled_from(sorted(base)), TEXTS, max_size=3))
        entries = sealed(entries) if draw(st.booleans()) else entries
        return metadata_record(draw(st.sampled_from((RUN, STATISTICS))), entries)
    if kind == "attachment":
        data = draw(st.binary(max_size=50) | TEXTS.map(str.encode) | st.just(b"[" * 100_000))
        return attachment_record(draw(st.sampled_from((READBACK, "cell.yaml", ""))), data)
    size = draw(st.none() | BITS64)
    return chunk_record(
        draw(st.binary(max_size=80)), size, draw(st.sampled_from(("zstd", "", "lz4", "\0")))
    )


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(st.lists(_records(), max_size=5))
def test_records_made_up_with_right_checksums_are_read_or_named(
    tmp_path: Path, records: list[bytes]
) -> None:
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, [HEADER, *records])
    _attack(path, None)


@st.composite
def _messages(draw: st.DrawFn) -> bytes:
    sampled = st.sampled_from(("sample", "event", "any"))
    kind = draw(sampled)
    channel = draw(st.sampled_from((1, 1, 2, 2, 3)))
    if kind == "sample":
        axes = draw(st.integers(1, 3))
        record = np.zeros(1, dtype=sample_dtype(axes))
        itemsize = sample_dtype(axes).itemsize
        record["opcode"], record["length"], record["channel"] = (
            Opcode.MESSAGE,
            itemsize - 9,
            channel,
        )
        record["encapsulation"] = draw(st.sampled_from((0x100, 0x100, 0)))
        for name in ("positions", "currents", "statuswords"):
            record[name] = draw(st.sampled_from((axes, axes, axes, 2**32 - 1)))
        record["cycle"], record["nanoseconds"] = draw(BITS64), draw(BITS32)
        record["seconds"], record["missing"] = draw(st.integers(-(2**31), 2**31 - 1)), draw(BITS32)
        return record.tobytes()
    if kind == "event":
        words = draw(st.sampled_from(("emcy", "stop", "nonsense", "")))
        length = draw(st.sampled_from((len(words) + 1, 0, 2**32 - 1)))
        body = struct.pack(
            "<4siIh2x",
            b"\0\1\0\0",
            draw(st.integers(-5, 5)),
            draw(BITS32),
            draw(st.integers(-2, 40)),
        )
        packed = struct.pack("<I", length)
        data = body + packed + words.encode() + b"\0" + draw(st.binary(max_size=20))
    else:
        data = draw(st.binary(max_size=60))
    head = struct.pack("<HIQQ", channel, 0, draw(BITS64), draw(BITS64))
    head_body = head + data
    return raw_record(Opcode.MESSAGE, head_body, draw(st.none() | st.none() | BITS16))


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(st.lists(_messages(), max_size=6), st.booleans(), TEXTS)
@example([], True, "1")
def test_messages_made_up_in_genuine_chunks_are_read_or_named(
    tmp_path: Path, messages: list[bytes], defined: bool, count: str
) -> None:
    start = content(2)
    readback = (
        b'{"axes": [{"name": "J1", "current_per_unit": 1}, {"name": "J2", "current_per_unit": 1}]}'
    )
    statistics = {
        "samples": count,
        "lost_cycles": "0",
        "missing": "[0, 0]",
        "valid": "true",
        "reason": "",
    }
    before = [
        HEADER,
        attachment_record(READBACK, readback),
        metadata_record(RUN, sealed(run_record(start.run))),
    ]
    chunk = chunk_record((TOPICS if defined else b"") + b"".join(messages))
    records = [*before, chunk, metadata_record(STATISTICS, sealed(statistics))]
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, records)
    _attack(path, None)


def test_the_made_up_files_are_ones_that_a_reader_takes(good: Path, tmp_path: Path) -> None:
    """So that the tests above reach the parsers: without a false byte such a file is a log."""
    log = read_log(good)
    start = content(2)
    record = np.zeros(1, dtype=sample_dtype(2))
    for name, value in (
        ("opcode", 5),
        ("length", record.itemsize - 9),
        ("channel", 1),
        ("encapsulation", 0x100),
    ):
        record[name] = value
    for name in ("positions", "currents", "statuswords"):
        record[name] = 2
    statistics = sealed({**statistics_record(log.statistics), "samples": "1", "missing": "[0, 0]"})
    readback = (
        b'{"axes": [{"name": "J1", "current_per_unit": 1}, {"name": "J2", "current_per_unit": 1}]}'
    )
    before = [
        HEADER,
        attachment_record(READBACK, readback),
        metadata_record(RUN, sealed(run_record(start.run))),
    ]
    made = [
        *before,
        chunk_record(TOPICS + record.tobytes()),
        metadata_record(STATISTICS, statistics),
    ]
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, made)
    cycle = read_log(path).samples.cycle
    assert len(cycle) == 1


def _is_open(path: Path) -> bool:
    """Whether this process holds a file open."""
    held: list[str] = []
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # that of the listing itself is closed
            held.append(str(entry.readlink()))
    return str(path) in held


def test_a_log_is_closed_although_its_error_is_kept(tmp_path: Path) -> None:
    """The error's traceback holds the frames, and these hold what was read half."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="of another program")
        writer.finish()
    with pytest.raises(LogUnreadable) as kept:
        read_log(path)
    assert not _is_open(path)
    reader = LogReader(path)
    assert [*reader.until_damage()] == []
    assert reader.damage is not None
    assert not _is_open(path)
    assert kept.value is not None


def test_a_small_file_cannot_take_much_memory(tmp_path: Path) -> None:
    """Each chunk keeps its own bound; together they keep one that goes with the size of the
    file.
    """
    record = np.zeros(500_000, dtype=sample_dtype(2))
    itemsize = sample_dtype(2).itemsize
    for name, value in (("opcode", 5), ("length", itemsize - 9), ("channel", 1)):
        record[name] = value
    record["encapsulation"] = 0x100
    for name in ("positions", "currents", "statuswords"):
        record[name] = 2
    chunk = chunk_record(record.tobytes())
    assert len(chunk) * 200 < record.nbytes
    tobytes = record[:1].tobytes()
    records = [HEADER, chunk_record(TOPICS + tobytes), *[chunk] * 8]
    bomb_path = tmp_path / "bomb.mcap"
    path = finished_file(bomb_path, records)
    taken = 0
    with pytest.raises(LogUnreadable, match="times the file"):
        for block in LogReader(path):
            taken += len(block.cycle)
    assert taken * sample_dtype(2).itemsize <= 64 * 2**20 + 200 * path.stat().st_size
