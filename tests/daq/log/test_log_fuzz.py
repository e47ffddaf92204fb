"""Foreign and damaged files: a reader returns a log of the same numbers or raises a named error.

Three kinds of attack: damage to a genuine log, records made up with right checksums, and genuine
chunks with made-up messages inside. Bounded in time by the number of examples; derandomised, so
that a failure is one tomorrow too.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass
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
BITS64 = st.integers(0, 2**64 - 1)
BITS32 = st.integers(0, 2**32 - 1)
BITS16 = st.integers(0, 2**16 - 1)
COUNTS = ("positions", "currents", "statuswords")  #: fields with the lengths of a sample's arrays
#: Metadata of two axes
TWO_AXES = (
    b'{"axes": [{"name": "J1", "current_per_unit": 1}, {"name": "J2", "current_per_unit": 1}]}'
)


def _sample_messages(count: int, axes: int) -> np.ndarray:
    """Messages of samples as a reader expects them, their values zero."""
    dtype = sample_dtype(axes)
    messages = np.zeros(count, dtype=dtype)
    messages["opcode"] = Opcode.MESSAGE
    messages["length"] = dtype.itemsize - 9
    messages["channel"] = 1
    messages["encapsulation"] = 0x100
    for name in COUNTS:
        messages[name] = axes
    return messages


def _records_before_samples() -> list[bytes]:
    """Records that a log of two axes begins with."""
    run = run_record(content(2).run)
    return [
        HEADER,
        attachment_record(READBACK, TWO_AXES),
        metadata_record(RUN, sealed(run)),
    ]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small log."""
    rows = samples([[k * k, -k] for k in range(320)])
    events = [CellEvent(START_NS, None, EventKind.MOVE_START, k, "move") for k in range(3)]
    path = tmp_path_factory.mktemp("logs") / "good.mcap"
    return write(path, content(2), rows, events)


def _assert_same_samples(block: SampleBlock, original: Log, first: int) -> None:
    """Check a block against the samples of the original from the first of them on."""
    end = first + len(block.cycle)
    for name in SampleBlock.__slots__:
        found = getattr(block, name)
        of_original = getattr(original.samples, name)
        assert np.array_equal(found, of_original[first:end]), name


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
            _assert_same_samples(block, original, done)
        done += len(block.cycle)
    if done:
        try:
            head = reader.head
        except LogUnreadable:
            return
        assert original is None or head == original.head


def _same(one: Log, other: Log) -> bool:
    for name in SampleBlock.__slots__:
        values = getattr(one.samples, name)
        other_values = getattr(other.samples, name)
        if not np.array_equal(values, other_values):
            return False
    same_head = one.head == other.head
    same_events = one.events == other.events
    return same_head and same_events and one.statistics == other.statistics


@dataclass(frozen=True)
class Damage:
    """A change of a file.

    Attributes:
        kind: of change.
        where: its place, as a share of the file.
        bit: that is flipped.
        length: of what is removed, repeated or filled.
        noise: that is inserted; its first byte fills.
    """

    kind: str
    where: float
    bit: int
    length: int
    noise: bytes

    def apply(self, data: bytearray) -> None:
        """Change the content of a file that is not empty."""
        at = int(self.where * len(data))
        end = at + self.length
        match self.kind:
            case "flip":
                data[at] ^= 1 << self.bit
            case "cut":
                del data[at:]
            case "remove":
                del data[at:end]
            case "repeat":
                data[at:at] = data[at:end]
            case "fill":
                filled = len(data[at:end])
                data[at:end] = self.noise[:1] * filled
            case _:
                data[at:at] = self.noise


DAMAGES = st.builds(
    Damage,
    kind=st.sampled_from(("flip", "cut", "remove", "repeat", "fill", "insert")),
    where=st.floats(0.0, 1.0, exclude_max=True),
    bit=st.integers(0, 7),
    length=st.integers(1, 600),
    noise=st.binary(min_size=1, max_size=40),
)


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(st.lists(DAMAGES, min_size=1, max_size=4))
def test_no_damage_gives_other_numbers(good: Path, tmp_path: Path, damages: list[Damage]) -> None:
    original = read_log(good)
    data = bytearray(good.read_bytes())
    for damage in damages:
        if not data:
            break
        damage.apply(data)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    _attack(path, original)


TEXTS = st.text(max_size=12) | st.sampled_from(
    ("0", "-1", "nan", "1e999", "{}", "[]", "[[", "true", "null", "9" * 5000)
)


@st.composite
def _any_record(draw: st.DrawFn) -> bytes:
    opcode = draw(st.integers(0, 255))
    body = draw(st.binary(max_size=60))
    return raw_record(opcode, body)


@st.composite
def _record_of_any_length(draw: st.DrawFn) -> bytes:
    opcode = draw(st.integers(1, 15))
    body = draw(st.binary(max_size=20))
    length = draw(BITS64)
    return raw_record(opcode, body, length)


@st.composite
def _metadata(draw: st.DrawFn) -> bytes:
    if draw(st.booleans()):
        base = run_record(content(2).run)
    else:
        base = {"samples": "1", "missing": "[0, 0]", "valid": "true"}
    keys = st.sampled_from(sorted(base))
    changes = draw(st.dictionaries(keys, TEXTS, max_size=3))
    entries = base | changes
    if draw(st.booleans()):
        entries = sealed(entries)
    name = draw(st.sampled_from((RUN, STATISTICS)))
    return metadata_record(name, entries)


@st.composite
def _attachment(draw: st.DrawFn) -> bytes:
    encoded_texts = TEXTS.map(str.encode)
    deep = st.just(b"[" * 100_000)
    data = draw(st.binary(max_size=50) | encoded_texts | deep)
    name = draw(st.sampled_from((READBACK, "cell.yaml", "")))
    return attachment_record(name, data)


@st.composite
def _chunk(draw: st.DrawFn) -> bytes:
    size = draw(st.none() | BITS64)
    data = draw(st.binary(max_size=80))
    compression = draw(st.sampled_from(("zstd", "", "lz4", "\0")))
    return chunk_record(data, size, compression)


RECORDS = st.one_of(
    _any_record(),
    _metadata(),
    _attachment(),
    _chunk(),
    _record_of_any_length(),
)


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(st.lists(RECORDS, max_size=5))
def test_records_made_up_with_right_checksums_are_read_or_named(
    tmp_path: Path, records: list[bytes]
) -> None:
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, [HEADER, *records])
    _attack(path, None)


def _sample(draw: st.DrawFn, channel: int) -> bytes:
    axes = draw(st.integers(1, 3))
    message = _sample_messages(1, axes)
    message["channel"] = channel
    message["encapsulation"] = draw(st.sampled_from((0x100, 0x100, 0)))
    for name in COUNTS:
        message[name] = draw(st.sampled_from((axes, axes, axes, 2**32 - 1)))
    message["cycle"] = draw(BITS64)
    message["nanoseconds"] = draw(BITS32)
    message["seconds"] = draw(st.integers(-(2**31), 2**31 - 1))
    message["missing"] = draw(BITS32)
    return message.tobytes()


def _event_data(draw: st.DrawFn) -> bytes:
    """An event, in CDR."""
    words = draw(st.sampled_from(("emcy", "stop", "nonsense", "")))
    length = draw(st.sampled_from((len(words) + 1, 0, 2**32 - 1)))
    seconds = draw(st.integers(-5, 5))
    nanoseconds = draw(BITS32)
    axis = draw(st.integers(-2, 40))
    body = struct.pack("<4siIh2x", b"\0\1\0\0", seconds, nanoseconds, axis)
    packed_length = struct.pack("<I", length)
    rest = draw(st.binary(max_size=20))
    return body + packed_length + words.encode() + b"\0" + rest


@st.composite
def _messages(draw: st.DrawFn) -> bytes:
    kinds = st.sampled_from(("sample", "event", "any"))
    kind = draw(kinds)
    channel = draw(st.sampled_from((1, 1, 2, 2, 3)))
    if kind == "sample":
        return _sample(draw, channel)
    if kind == "event":
        data = _event_data(draw)
    else:
        data = draw(st.binary(max_size=60))
    logged_ns = draw(BITS64)
    published_ns = draw(BITS64)
    head = struct.pack("<HIQQ", channel, 0, logged_ns, published_ns)
    length = draw(st.none() | st.none() | BITS16)
    return raw_record(Opcode.MESSAGE, head + data, length)


@pytest.mark.slow
@settings(FUZZ, max_examples=200)
@given(st.lists(_messages(), max_size=6), st.booleans(), TEXTS)
@example([], True, "1")
def test_messages_made_up_in_genuine_chunks_are_read_or_named(
    tmp_path: Path, messages: list[bytes], defined: bool, count: str
) -> None:
    statistics = {
        "samples": count,
        "lost_cycles": "0",
        "missing": "[0, 0]",
        "valid": "true",
        "reason": "",
    }
    topics = b""
    if defined:
        topics = TOPICS
    chunk = chunk_record(topics + b"".join(messages))
    end = metadata_record(STATISTICS, sealed(statistics))
    records = [*_records_before_samples(), chunk, end]
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, records)
    _attack(path, None)


def test_the_made_up_files_are_ones_that_a_reader_takes(good: Path, tmp_path: Path) -> None:
    """So that the tests above reach the parsers: without a false byte such a file is a log."""
    log = read_log(good)
    sample = _sample_messages(1, axes=2)
    chunk = chunk_record(TOPICS + sample.tobytes())
    statistics = statistics_record(log.statistics)
    of_one_sample = {**statistics, "samples": "1", "missing": "[0, 0]"}
    end = metadata_record(STATISTICS, sealed(of_one_sample))
    made = [*_records_before_samples(), chunk, end]
    made_path = tmp_path / "made.mcap"
    path = finished_file(made_path, made)
    cycle = read_log(path).samples.cycle
    assert len(cycle) == 1


def _is_open(path: Path) -> bool:
    """Whether this process has a file open."""
    open_files: list[str] = []
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # that of the listing itself is closed
            target = entry.readlink()
            open_files.append(str(target))
    return str(path) in open_files


def test_a_log_is_closed_although_its_error_is_kept(tmp_path: Path) -> None:
    """The error's traceback holds the frames, and these hold what was read half."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="of another program")
        writer.finish()
    with pytest.raises(LogUnreadable) as caught:
        read_log(path)
    assert not _is_open(path)
    reader = LogReader(path)
    blocks = list(reader.until_damage())
    assert blocks == []
    assert reader.damage is not None
    assert not _is_open(path)
    assert caught.value is not None


def test_a_small_file_cannot_take_much_memory(tmp_path: Path) -> None:
    """Each chunk keeps its own bound; together they keep one that goes with the size of the
    file.
    """
    messages = _sample_messages(500_000, axes=2)
    chunk = chunk_record(messages.tobytes())
    assert len(chunk) * 200 < messages.nbytes
    first_message = messages[:1].tobytes()
    with_topics = chunk_record(TOPICS + first_message)
    records = [HEADER, with_topics, *[chunk] * 8]
    bomb_path = tmp_path / "bomb.mcap"
    path = finished_file(bomb_path, records)
    taken = 0
    with pytest.raises(LogUnreadable, match="times the file"):
        for block in LogReader(path):
            taken += len(block.cycle)
    taken_bytes = taken * messages.itemsize
    limit_bytes = 64 * 2**20 + 200 * path.stat().st_size
    assert taken_bytes <= limit_bytes
