"""Whatever is sent into a log is read back unchanged, also by any other MCAP reader."""

from __future__ import annotations

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

from daq.errors import LogIncomplete, OutputFailed, UsageError
from daq.log.container import RecordFile
from daq.log.reader import LogReader, read_log
from daq.log.writer import LogWriter
from drivers.messages import CellEvent, EventKind, Quantity, Sample, SlowReading
from tests.daq.logs import DISC, START_NS, content, joints, samples, write

I32 = st.integers(-(2**31), 2**31 - 1)


@st.composite
def _recordings(draw: st.DrawFn) -> tuple[int, list[Sample]]:
    axes = draw(st.integers(1, 8))
    rows = draw(
        st.lists(
            st.builds(
                Sample,
                st.integers(0, 2**63),
                st.integers(0, 2**31 * 10**9 - 1),
                st.tuples(*[I32] * axes),
                st.tuples(*[I32] * axes),
                st.tuples(*[st.integers(0, 0xFFFF)] * axes),
                st.integers(0, 2**axes - 1),
            ),
            min_size=1,
            max_size=20,
        )
    )
    return axes, rows


EVENTS = st.lists(
    st.builds(
        CellEvent,
        st.integers(0, 2**31 * 10**9 - 1),
        st.none() | st.integers(0, 31),
        st.sampled_from(EventKind),
        st.integers(0, 2**32 - 1),
        st.text(st.characters(blacklist_characters="\0", blacklist_categories=["Cs"]), max_size=30),
    ),
    max_size=5,
)


READINGS = st.lists(
    st.builds(
        SlowReading,
        st.integers(0, 2**31 * 10**9 - 1),
        st.integers(0, 0),
        st.sampled_from(Quantity),
        st.floats(allow_nan=False, allow_infinity=False),
    ),
    max_size=5,
)


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
        with LogWriter(path, content(axes), joints, clock_ns=lambda: 0) as writer:
            writer.readings(readings)
            for sample in rows:
                writer.write(sample)
            writer.conclude(valid=True)
        found = read_log(path)
        without = read_log(bare)
        # Such topics are in a log only where it has some.
        expected = [bool(readings), False]
        assert [b"AxisReading" in log.read_bytes() for log in (path, bare)] == expected
    assert found.readings == tuple(readings)
    assert without.readings == ()
    position_counts = found.samples.position_counts.tolist()
    assert position_counts == without.samples.position_counts.tolist()


def test_a_reading_of_an_axis_that_the_log_lacks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, content(2), joints, clock_ns=lambda: 0) as log:
        slow_reading = SlowReading(5, 2, Quantity.TORQUE, 1.0)
        log.reading(slow_reading)
        rows = [(1, 2), (3, 4)]
        for sample in samples(rows):
            log.write(sample)
        log.conclude(valid=True)
    with pytest.raises(
        LogIncomplete, match="temperature of axis 2, counted from 0; expected those of 2 axes"
    ):
        read_log(tmp_path / "a.mcap")


def test_an_event_that_names_a_file_whose_name_is_no_utf_8_is_logged(tmp_path: Path) -> None:
    """The error of a full disk names the log:
    were it not logged, it would hide why the axes were stopped.
    """
    event = CellEvent(
        START_NS, None, EventKind.ENDED, 0, "OutputFailed: \udcff.mcap: no space left"
    )
    path = tmp_path / "a.mcap"
    log = read_log(write(path, content(2), samples([[0, 0]]), [event]))
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
    expected = [s.cycle for s in rows]
    assert log.samples.cycle.tolist() == expected
    time_ns = [s.time_ns for s in rows]
    assert log.samples.time_ns.tolist() == time_ns
    position_counts = [list(s.position_counts) for s in rows]
    assert log.samples.position_counts.tolist() == position_counts
    current_raw = log.samples.current_raw.tolist()
    assert current_raw == [list(s.current_raw) for s in rows]
    statuswords = [list(s.statusword) for s in rows]
    assert log.samples.statusword.tolist() == statuswords
    missing = log.samples.missing.tolist()
    assert missing == [s.missing for s in rows]
    assert log.events == tuple(events)


@pytest.mark.parametrize("axes", [1, 2, 5, 6])
def test_the_start_and_the_end_come_back(tmp_path: Path, axes: int) -> None:
    start = content(axes, DISC)
    rows = [
        Sample(k, k, (1,) * axes, (2,) * axes, (3,) * axes, missing)
        for k, missing in ((3, 0), (4, 1), (9, 1))
    ]
    path = tmp_path / "a.mcap"
    log = read_log(write(path, start, rows, verdict=(False, "emergency stop")))
    assert log.head.run == start.run
    assert log.head.readback == start.readback
    cell_yaml = log.head.files["cell.yaml"]
    assert cell_yaml == start.files["cell.yaml"]
    statistics = log.statistics
    expected = (3, 4, (2,) + (0,) * (axes - 1))
    assert (statistics.samples, statistics.lost_cycles, statistics.missing) == expected
    assert (statistics.valid, statistics.reason) == (False, "emergency stop")
    assert not (tmp_path / "a.mcap.part").exists()


@pytest.mark.parametrize("axes", [1, 2, 5, 6])
def test_another_reader_decodes_the_same(tmp_path: Path, axes: int) -> None:
    position_counts = np.outer(np.arange(45), np.arange(1, axes + 1))
    rows = samples(position_counts.tolist(), missing=1)
    event = CellEvent(START_NS, 0, EventKind.EMCY, 0x8130, "Lebenszeichen fehlt: Ä")
    a_path = tmp_path / "a.mcap"
    path = write(a_path, content(axes), rows, [event])
    decoded: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert (schema.encoding if schema else "", channel.message_encoding) == (
                "ros2msg",
                "cdr",
            )
            decoded.setdefault(channel.topic, []).append(message)
    assert len(decoded["/cell/samples"]) == len(rows)
    for message, sample in zip(decoded["/cell/samples"], rows, strict=True):
        assert message.stamp.sec * 10**9 + message.stamp.nanosec == sample.time_ns
        expected = (sample.cycle, sample.missing)
        assert (message.cycle, message.missing) == expected
        assert tuple(message.position_counts) == sample.position_counts
        assert tuple(message.current_raw) == sample.current_raw
        assert tuple(message.statusword) == sample.statusword
    emergency = decoded["/cell/events"][0]
    assert (emergency.axis, emergency.kind, emergency.code) == (0, "emcy", 0x8130)
    assert emergency.text == event.text
    assert len(decoded["/joint_states"]) == 3  # 45 ms at 50 Hz
    state = decoded["/joint_states"][1]
    assert state.name == [f"J{i + 1}" for i in range(axes)]
    counts = rows[20].position_counts
    assert list(state.position) == pytest.approx(joints(counts))


def test_samples_are_on_disk_within_200_ms_of_recorded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.log.reader.BLOCK_SAMPLES", 1)  # a block a chunk
    rows = samples([[k] for k in range(1000)])
    reader = LogReader(tmp_path / "a.mcap")
    a_path = tmp_path / "a.mcap"
    path = write(a_path, content(1), rows)
    blocks = [len(block.cycle) for block in LogReader(path)]
    assert max(blocks) <= 150
    assert sum(blocks) == 1000
    assert reader.digest == ""


def test_samples_are_on_disk_within_200_ms_of_wall_time(tmp_path: Path) -> None:
    now_ns = 0
    rows = samples([[k] for k in range(20)])
    path = tmp_path / "a.mcap"
    with LogWriter(path, content(1), joints, clock_ns=lambda: now_ns) as log:
        sizes = []
        for sample in rows:
            now_ns += 50_000_000
            log.write(sample)
            sizes.append(log.part.stat().st_size)
    assert all(sizes[k + 5] > sizes[k] for k in range(len(sizes) - 5))


def test_an_error_leaves_the_part_with_everything_so_far(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with (
        pytest.raises(RuntimeError, match="bus gone"),
        LogWriter(path, content(1), joints, clock_ns=lambda: 0) as log,
    ):
        rows = [[k] for k in range(7)]
        for sample in samples(rows):
            log.write(sample)
        raise RuntimeError("bus gone")
    assert not path.exists()
    part = tmp_path / "a.mcap.part"
    data = part.read_bytes()
    found: list[McapRecord] = []
    with part.open("rb") as stream, pytest.raises(EndOfFile):
        found.extend(StreamReader(stream).records)
    sequences = [record.sequence for record in found if isinstance(record, Message)]
    # Seven samples; after the first of them the first JointState and currents.
    expected = [10, 0, 0, *range(11, 17)]
    assert sequences == expected
    with pytest.raises(UsageError, match="unfinished"):
        write(path, content(1), samples([[0]]))
    assert part.read_bytes() == data


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    a_path = tmp_path / "a.mcap"
    path = write(a_path, content(1), samples([[0]]))
    before = path.read_bytes()
    with pytest.raises(UsageError, match="a file of that name"):
        write(path, content(1), samples([[1]]))
    assert path.read_bytes() == before
    with pytest.raises(OutputFailed, match="found no folder"):
        write(tmp_path / "none" / "a.mcap", content(1), samples([[0]]))


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "none"])
def test_a_file_that_appeared_meanwhile_is_not_replaced(
    tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:
        _without_hard_links(monkeypatch)
    path = tmp_path / "a.mcap"

    def record() -> None:
        with LogWriter(path, content(1), joints, clock_ns=lambda: 0) as log:
            rows = [[number] for number in range(5)]
            for sample in samples(rows):
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
    assert (len(log.samples.cycle), log.partial) == (5, False)


def test_a_file_system_without_hard_links_gives_the_name_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _without_hard_links(monkeypatch)
    a_path = tmp_path / "a.mcap"
    path = write(a_path, content(1), samples([[0]]))
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
    cell_event = CellEvent(START_NS, None, EventKind.MOVE_START, 0, "")
    events = [cell_event]
    path = tmp_path / "a.mcap"
    file = RecordFile(write(path, content(2), samples([[k, k] for k in range(900)]), events))
    sizes = [chunk.uncompressed_size for offset, chunk in file if isinstance(chunk, Chunk)]
    a_path = tmp_path / "a.mcap"
    blocks = list(LogReader(a_path))
    expected = [1, *[150] * 5, 149]
    cycle_counts = [len(block.cycle) for block in blocks]
    assert cycle_counts == expected
    assert len(sizes) == 2 * len(blocks)
    position_counts = [b.position_counts for b in blocks]
    stacked_position_counts = np.concatenate(position_counts)
    np.testing.assert_array_equal(stacked_position_counts[:, 1], np.arange(900))


@pytest.mark.parametrize("size", [1, 7, 149, 151, 10_000])
def test_the_size_of_a_block_changes_nothing_but_the_blocks(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.log.reader.BLOCK_SAMPLES", size)
    a_path = tmp_path / "a.mcap"
    path = write(a_path, content(2), samples([[k, k] for k in range(900)]))
    blocks = list(LogReader(path))
    largest_cycle_count = max(len(block.cycle) for block in blocks)
    assert largest_cycle_count <= size + 149
    stacked_position_counts = np.concatenate([b.position_counts for b in blocks])
    np.testing.assert_array_equal(stacked_position_counts[:, 1], np.arange(900))
    whole = LogReader(path)
    assert (len(list(whole.until_damage())), whole.damage) == (len(blocks), None)
    path.write_bytes(path.read_bytes()[: whole.whole_bytes - 5])
    cut = LogReader(path)
    position_counts = [b.position_counts for b in cut.until_damage()]
    saved = np.concatenate(position_counts)[:, 1]
    assert cut.damage is not None
    np.testing.assert_array_equal(saved, np.arange(900))


def test_a_log_of_which_no_one_said_how_it_went_is_not_valid(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, content(1), joints, clock_ns=lambda: 0) as log:
        log.write(samples([[1]])[0])
    a_path = tmp_path / "a.mcap"
    statistics = read_log(a_path).statistics
    assert (statistics.valid, statistics.reason) == (False, "not concluded")
