"""Whatever is sent into a log is read back unchanged, also by any other MCAP reader."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from daq.errors import LogIncomplete, OutputFailed, UsageError
from daq.log.container import RecordFile
from daq.log.reader import LogReader, SampleBlock, read_log
from daq.log.writer import LogWriter
from drivers.messages import CellEvent, EventKind, Quantity, Sample, SlowReading
from tests.daq.logs import DISC, START_NS, content, joints, samples, write

LARGEST_S = 2**31
LARGEST_NS = LARGEST_S * 10**9 - 1
I32 = st.integers(-(2**31), 2**31 - 1)
WORDS = st.integers(0, 0xFFFF)
TIMES_NS = st.integers(0, LARGEST_NS)


def _samples_of(axes: int) -> st.SearchStrategy[Sample]:
    """Samples of so many axes."""
    cycles = st.integers(0, 2**63)
    largest_missing = 2**axes - 1
    counts = st.tuples(*[I32] * axes)
    currents = st.tuples(*[I32] * axes)
    statuswords = st.tuples(*[WORDS] * axes)
    missing = st.integers(0, largest_missing)
    return st.builds(Sample, cycles, TIMES_NS, counts, currents, statuswords, missing)


@st.composite
def _recordings(draw: st.DrawFn) -> tuple[int, list[Sample]]:
    axes = draw(st.integers(1, 8))
    rows = draw(st.lists(_samples_of(axes), min_size=1, max_size=20))
    return axes, rows


_characters = st.characters(blacklist_characters="\0", blacklist_categories=["Cs"])
EVENT = st.builds(
    CellEvent,
    TIMES_NS,
    st.none() | st.integers(0, 31),
    st.sampled_from(EventKind),
    st.integers(0, 2**32 - 1),
    st.text(_characters, max_size=30),
)
EVENTS = st.lists(EVENT, max_size=5)
READING = st.builds(
    SlowReading,
    TIMES_NS,
    st.integers(0, 0),
    st.sampled_from(Quantity),
    st.floats(allow_nan=False, allow_infinity=False),
)
READINGS = st.lists(READING, max_size=5)


def opened(path: Path, axes: int) -> LogWriter:
    """A writer of a log for so many axes, at a standing clock."""
    return LogWriter(path, content(axes), joints, clock_ns=lambda: 0)


def numbered(count: int, axes: int = 1) -> list[Sample]:
    """Samples in which each axis has the number of the row as its position."""
    return samples([[number] * axes for number in range(count)])


def one_sample() -> list[Sample]:
    """The content of a short log of one axis."""
    return samples([[0]])


def second_axis(blocks: Iterable[SampleBlock]) -> NDArray[np.int64]:
    """Position counts of the second axis in some blocks of samples."""
    stacked = np.concatenate([block.position_counts for block in blocks])
    return np.asarray(stacked[:, 1])


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(_recordings(), READINGS)
def test_slow_readings_come_back_and_leave_the_samples_alone(
    recording: tuple[int, list[Sample]], readings: list[SlowReading]
) -> None:
    axes, rows = recording
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        b_path = Path(folder) / "b.mcap"
        bare = write(b_path, content(axes), rows)
        with opened(path, axes) as writer:
            writer.readings(readings)
            for sample in rows:
                writer.write(sample)
            writer.conclude(valid=True)
        found = read_log(path)
        without = read_log(bare)
        # Such topics are in a log only where it has some.
        has_topic = b"AxisReading" in path.read_bytes()
        assert has_topic == bool(readings)
        assert b"AxisReading" not in bare.read_bytes()
    assert found.readings == tuple(readings)
    assert without.readings == ()
    position_counts = found.samples.position_counts.tolist()
    assert position_counts == without.samples.position_counts.tolist()


def test_a_reading_of_an_axis_that_the_log_lacks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    torque = SlowReading(5, 2, Quantity.TORQUE, 1.0)
    with opened(path, axes=2) as log:
        log.reading(torque)
        rows = [(1, 2), (3, 4)]
        for sample in samples(rows):
            log.write(sample)
        log.conclude(valid=True)
    with pytest.raises(
        LogIncomplete, match="temperature of axis 2, counted from 0; expected those of 2 axes"
    ):
        read_log(path)


def test_an_event_that_names_a_file_whose_name_is_no_utf_8_is_logged(tmp_path: Path) -> None:
    """The error of a full disk names the log:
    were it not logged, it would hide why the axes were stopped.
    """
    event = CellEvent(
        START_NS, None, EventKind.ENDED, 0, "OutputFailed: \udcff.mcap: no space left"
    )
    path = tmp_path / "a.mcap"
    rows = samples([[0, 0]])
    write(path, content(2), rows, [event])
    log = read_log(path)
    texts = [found.text for found in log.events]
    assert texts == [r"OutputFailed: \udcff.mcap: no space left"]


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(_recordings(), EVENTS)
def test_round_trip(recording: tuple[int, list[Sample]], events: list[CellEvent]) -> None:
    axes, rows = recording
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        log = read_log(write(path, content(axes), rows, events))
    found = log.samples
    assert found.cycle.tolist() == [sample.cycle for sample in rows]
    assert found.time_ns.tolist() == [sample.time_ns for sample in rows]
    assert found.position_counts.tolist() == [list(sample.position_counts) for sample in rows]
    assert found.current_raw.tolist() == [list(sample.current_raw) for sample in rows]
    assert found.statusword.tolist() == [list(sample.statusword) for sample in rows]
    assert found.missing.tolist() == [sample.missing for sample in rows]
    assert log.events == tuple(events)


@pytest.mark.parametrize("axes", [1, 2, 5, 6])
def test_the_start_and_the_end_come_back(tmp_path: Path, axes: int) -> None:
    start = content(axes, DISC)
    ones = (1,) * axes
    twos = (2,) * axes
    threes = (3,) * axes
    rows = [
        Sample(3, 3, ones, twos, threes, 0),
        Sample(4, 4, ones, twos, threes, 1),
        Sample(9, 9, ones, twos, threes, 1),
    ]
    path = tmp_path / "a.mcap"
    log = read_log(write(path, start, rows, verdict=(False, "emergency stop")))
    assert log.head.run == start.run
    assert log.head.readback == start.readback
    cell_yaml = log.head.files["cell.yaml"]
    assert cell_yaml == start.files["cell.yaml"]
    statistics = log.statistics
    no_other_missing = (0,) * (axes - 1)
    assert statistics.samples == 3
    assert statistics.lost_cycles == 4
    assert statistics.missing == (2, *no_other_missing)
    assert not statistics.valid
    assert statistics.reason == "emergency stop"
    assert not (tmp_path / "a.mcap.part").exists()


def _decoded(path: Path) -> dict[str, list[Any]]:
    """Messages of a log by topic, as the decoder of the MCAP library reads them."""
    decoded: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            assert schema.encoding == "ros2msg"
            assert channel.message_encoding == "cdr"
            decoded.setdefault(channel.topic, []).append(message)
    return decoded


@pytest.mark.parametrize("axes", [1, 2, 5, 6])
def test_another_reader_decodes_the_same(tmp_path: Path, axes: int) -> None:
    multiples = np.arange(1, axes + 1)
    position_counts = np.outer(np.arange(45), multiples)
    rows = samples(position_counts.tolist(), missing=1)
    event = CellEvent(START_NS, 0, EventKind.EMCY, 0x8130, "Lebenszeichen fehlt: Ä")
    path = tmp_path / "a.mcap"
    write(path, content(axes), rows, [event])

    decoded = _decoded(path)

    messages = decoded["/cell/samples"]
    assert len(messages) == len(rows)
    for message, sample in zip(messages, rows, strict=True):
        seconds_ns = message.stamp.sec * 10**9
        stamp_ns = seconds_ns + message.stamp.nanosec
        assert stamp_ns == sample.time_ns
        assert message.cycle == sample.cycle
        assert message.missing == sample.missing
        assert tuple(message.position_counts) == sample.position_counts
        assert tuple(message.current_raw) == sample.current_raw
        assert tuple(message.statusword) == sample.statusword
    emergency = decoded["/cell/events"][0]
    assert emergency.axis == 0
    assert emergency.kind == "emcy"
    assert emergency.code == 0x8130
    assert emergency.text == event.text
    states = decoded["/joint_states"]
    assert len(states) == 3  # 45 ms at 50 Hz
    state = states[1]
    names = [f"J{number}" for number in multiples]
    assert state.name == names
    counts = rows[20].position_counts
    assert list(state.position) == pytest.approx(joints(counts))


def test_samples_are_on_disk_within_200_ms_of_recorded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.log.reader.BLOCK_SAMPLES", 1)  # a block a chunk
    path = tmp_path / "a.mcap"
    reader = LogReader(path)
    write(path, content(1), numbered(1000))
    blocks = [len(block.cycle) for block in LogReader(path)]
    assert max(blocks) <= 150
    assert sum(blocks) == 1000
    assert reader.digest == ""


def test_samples_are_on_disk_within_200_ms_of_wall_time(tmp_path: Path) -> None:
    now_ns = 0
    path = tmp_path / "a.mcap"
    sizes = []
    with LogWriter(path, content(1), joints, clock_ns=lambda: now_ns) as log:
        for sample in numbered(20):
            now_ns += 50_000_000
            log.write(sample)
            sizes.append(log.part.stat().st_size)
    for before, after in zip(sizes, sizes[5:], strict=False):
        assert after > before


def test_an_error_leaves_the_part_with_everything_so_far(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def record() -> None:
        with opened(path, axes=1) as log:
            for sample in numbered(7):
                log.write(sample)
            raise RuntimeError("bus gone")

    with pytest.raises(RuntimeError, match="bus gone"):
        record()
    assert not path.exists()
    part = tmp_path / "a.mcap.part"
    data = part.read_bytes()
    found: list[McapRecord] = []
    with part.open("rb") as stream, pytest.raises(EndOfFile):
        found.extend(StreamReader(stream).records)
    sequences = [record.sequence for record in found if isinstance(record, Message)]
    # Seven samples; after the first of them the first JointState and currents.
    assert sequences == [10, 0, 0, *range(11, 17)]
    with pytest.raises(UsageError, match="unfinished"):
        write(path, content(1), one_sample())
    assert part.read_bytes() == data


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, content(1), one_sample())
    before = path.read_bytes()
    with pytest.raises(UsageError, match="a file of that name"):
        write(path, content(1), samples([[1]]))
    assert path.read_bytes() == before
    without_folder = tmp_path / "none" / "a.mcap"
    with pytest.raises(OutputFailed, match="found no folder"):
        write(without_folder, content(1), one_sample())


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "none"])
def test_a_file_that_appeared_meanwhile_is_not_replaced(
    tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:
        _without_hard_links(monkeypatch)
    path = tmp_path / "a.mcap"

    def record() -> None:
        with opened(path, axes=1) as log:
            for sample in numbered(5):
                log.write(sample)
            log.conclude(True)
            path.write_bytes(b"another program's")

    with pytest.raises(UsageError, match=r"a\.mcap\.part") as raised:
        record()
    assert path.read_bytes() == b"another program's"
    assert "which was not there" in raised.value.found
    path.unlink()
    (tmp_path / "a.mcap.part").rename(path)
    log = read_log(path)
    assert len(log.samples.cycle) == 5
    assert not log.partial


def test_a_file_system_without_hard_links_gives_the_name_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _without_hard_links(monkeypatch)
    path = tmp_path / "a.mcap"
    write(path, content(1), one_sample())
    cycle = read_log(path).samples.cycle
    assert len(cycle) == 1
    assert list(tmp_path.iterdir()) == [path]


def _without_hard_links(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_self: Path, _target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")  # as FAT says it (link(2), EPERM)

    monkeypatch.setattr(Path, "hardlink_to", refused)


@pytest.mark.parametrize(
    "sample",
    [
        Sample(0, 0, (1, 2), (1, 2), (0, 0)),
        Sample(0, 0, (2**31,), (0,), (0,)),
        Sample(-1, 0, (0,), (0,), (0,)),
    ],
)
def test_a_sample_that_does_not_fit_is_refused(tmp_path: Path, sample: Sample) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(ValueError, match="does not fit a log of 1 axes"):
        write(path, content(1), [sample])


def test_a_log_without_samples_is_incomplete(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(LogIncomplete, match="no samples"):
        read_log(write(path, content(1), []))


def test_samples_have_chunks_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant layout, so that a chunk is one `frombuffer`."""
    monkeypatch.setattr("daq.log.reader.BLOCK_SAMPLES", 1)  # a block a chunk
    event = CellEvent(START_NS, None, EventKind.MOVE_START, 0, "")
    path = tmp_path / "a.mcap"
    write(path, content(2), numbered(900, axes=2), [event])
    chunks = [chunk for _, chunk in RecordFile(path) if isinstance(chunk, Chunk)]
    sizes = [chunk.uncompressed_size for chunk in chunks]
    blocks = list(LogReader(path))
    expected = [1, *[150] * 5, 149]
    cycle_counts = [len(block.cycle) for block in blocks]
    assert cycle_counts == expected
    assert len(sizes) == 2 * len(blocks)
    np.testing.assert_array_equal(second_axis(blocks), np.arange(900))


@pytest.mark.parametrize("size", [1, 7, 149, 151, 10_000])
def test_the_size_of_a_block_changes_nothing_but_the_blocks(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.log.reader.BLOCK_SAMPLES", size)
    path = tmp_path / "a.mcap"
    write(path, content(2), numbered(900, axes=2))
    blocks = list(LogReader(path))
    largest_cycle_count = max(len(block.cycle) for block in blocks)
    assert largest_cycle_count <= size + 149
    np.testing.assert_array_equal(second_axis(blocks), np.arange(900))
    undamaged = LogReader(path)
    block_count = len(list(undamaged.until_damage()))
    assert block_count == len(blocks)
    assert undamaged.damage is None
    data = path.read_bytes()
    without_last_bytes = data[: undamaged.whole_bytes - 5]
    path.write_bytes(without_last_bytes)
    cut = LogReader(path)
    saved = second_axis(cut.until_damage())
    assert cut.damage is not None
    np.testing.assert_array_equal(saved, np.arange(900))


def test_a_log_of_which_no_one_said_how_it_went_is_not_valid(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with opened(path, axes=1) as log:
        (sample,) = samples([[1]])
        log.write(sample)
    statistics = read_log(path).statistics
    assert not statistics.valid
    assert statistics.reason == "not concluded"
