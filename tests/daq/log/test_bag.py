"""ROS 2 bags: the joint states that an independent writer put in,
or an error that says what is there.
"""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

from daq.cli import main
from daq.config.import_description import (
    CurrentColumns,
    ImportDescription,
    KeptPart,
    PositionColumns,
    PositionUnit,
    Side,
    TimeColumn,
    TimeUnit,
    load_import,
)
from daq.errors import (
    ConfigurationInconsistent,
    DaqError,
    DataError,
    LogForeign,
    LogTruncated,
    SchemaMismatch,
    TableUnfit,
)
from daq.log.bag_table import STAMP, interleaved, read_bag
from daq.log.conversion import load_run
from daq.log.importing import import_recording
from daq.log.mcap_bag import joint_state_from_cdr
from daq.log.message import DEFINITIONS, JOINTS_SCHEMA
from daq.log.reader import read_log
from daq.log.table import Table
from tests.daq.command_line import run_verb
from tests.daq.logs import damaged

JOINTS = ("J1", "J2", "J3", "J4", "J5", "J6")
START_NS = 1_700_000_000_123_456_789
STEP_NS = 4_000_000
ROWS = 200
_ROW = np.arange(ROWS)[:, None]
_JOINT = np.arange(6)
POSITION = 0.35 * np.sin(_ROW / 9.0 + _JOINT)
EFFORT = np.cos(_ROW / 7.0 + _JOINT)
VALUES = np.hstack((POSITION, EFFORT))
TIME_S = np.arange(ROWS) * 4e-3
TIME = TimeColumn(file="run.mcap", column=STAMP, unit=TimeUnit.NANOSECOND)
POSITION_COLUMNS = tuple(f"position.{joint}" for joint in JOINTS)
EFFORT_COLUMNS = tuple(f"effort.{joint}" for joint in JOINTS)
COLUMNS = POSITION_COLUMNS + EFFORT_COLUMNS

Message = tuple[str, dict[str, Any]]
"""A topic, and the content of a message on it."""


def stamped_header(stamp_ns: int, frame: str = "base") -> dict[str, Any]:
    """The header of a message."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = {"sec": seconds, "nanosec": nanoseconds}
    return {"stamp": stamp, "frame_id": frame}


def row_ns(row: int) -> int:
    """Stamp of a row of the recording."""
    return START_NS + row * STEP_NS


def message(row: int, joints: Sequence[int] = range(6), **changes: Any) -> dict[str, Any]:
    """A joint state of some joints in a row of the recording, with some fields replaced."""
    positions = [float(POSITION[row, joint]) for joint in joints]
    efforts = [float(EFFORT[row, joint]) for joint in joints]
    content: dict[str, Any] = {
        "header": stamped_header(row_ns(row)),
        "name": [JOINTS[joint] for joint in joints],
        "position": positions,
        "velocity": [],
        "effort": efforts,
    }
    return content | changes


def joint_states(contents: Iterable[dict[str, Any]]) -> list[Message]:
    """Messages on the usual topic."""
    return [("/joint_states", content) for content in contents]


def write_bag(path: Path, messages: Iterable[Message], **options: Any) -> Path:
    """A bag with these joint states, by topic, each recorded half a millisecond after the one
    before.
    """
    with path.open("wb") as stream, Ros2Writer(stream, **options) as writer:
        schema = writer.register_msgdef(JOINTS_SCHEMA, DEFINITIONS[JOINTS_SCHEMA])
        for number, (topic, content) in enumerate(messages):
            log_time = START_NS + 500_000 * number
            writer.write_message(topic, schema, content, log_time=log_time)
    return path


def describe(topic: str | None = None, **changes: Any) -> ImportDescription:
    """A description, with what the reader needs of it alone."""
    needed = {"topic": topic, "position": None, "current": None}
    return ImportDescription.model_construct(**needed | changes)


def read(
    path: Path, columns: tuple[str, ...] = COLUMNS, topic: str | None = None, **changes: Any
) -> Table:
    """Columns with their stamps."""
    return read_bag(path, describe(topic, **changes), columns, TIME)


def recording() -> list[Message]:
    """The recording, all joints in each message."""
    return joint_states(message(row) for row in range(ROWS))


def assert_whole(table: Table) -> None:
    """The table is the recording, to the last bit."""
    np.testing.assert_array_equal(table.values, VALUES)
    assert table.stamps is not None
    assert table.stamps.first_ns == START_NS
    np.testing.assert_allclose(table.stamps.time_s, TIME_S, atol=1e-12)


@pytest.mark.parametrize("compression", CompressionType)
def test_a_bag_is_read_as_it_was_written(compression: CompressionType, tmp_path: Path) -> None:
    run_path = tmp_path / "run.mcap"
    path = write_bag(run_path, recording(), compression=compression, chunk_size=4000)
    assert_whole(read(path))


def test_joints_in_another_order_in_each_message_are_the_same_samples(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    contents = []
    for row in range(ROWS):
        order = rng.permutation(6).tolist()
        contents.append(message(row, order))
    path = write_bag(tmp_path / "run.mcap", joint_states(contents))
    table = read(path)
    assert_whole(table)
    assert table.remarks == ()


def _repack(source: Path, target: Path, **options: Any) -> Path:
    """The messages of a bag, written once more by the general writer with its own options."""
    with source.open("rb") as read_from, target.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, content in make_reader(read_from).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            target_channel = channels[channel.id]
            writer.add_message(target_channel, content.log_time, content.data, content.publish_time)
        writer.finish()
    return target


@pytest.mark.parametrize(
    "options",
    [{"use_chunking": False}, {"enable_crcs": False}, {"enable_data_crcs": True}],
    ids=lambda options: next(iter(options)),
)
def test_chunks_and_checksums_are_optional(options: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    plain = write_bag(path, recording())
    target = tmp_path / "run.mcap"
    table = read(_repack(plain, target, **options))
    assert_whole(table)


def test_several_publishers_make_one_row_a_stamp(tmp_path: Path) -> None:
    """One driver publishes the arm and another the wrist, each in a message of its own;
    a gripper is no axis.

    The bag begins after the arm's message of its first stamp, and ends before the wrist's of its
    last one.
    """
    contents = []
    for row in range(ROWS):
        contents.append(message(row, (2, 0, 1)))
        contents.append(message(row, (), name=["finger"]))
        contents.append(message(row, (5, 3, 4)))
    parts = joint_states(contents)
    path = tmp_path / "run.mcap"
    table = read(write_bag(path, parts))
    assert_whole(table)
    assert table.remarks == ()

    cut_path = tmp_path / "cut.mcap"
    cut_parts = parts[1:-1]
    cut = read(write_bag(cut_path, cut_parts))
    np.testing.assert_array_equal(cut.values, VALUES[1:-1])
    assert cut.remarks == ("left out, as joints are missing at the ends of the bag: 2 stamps",)

    messages = [*parts[:32], *parts[33:]]
    gap_path = tmp_path / "gap.mcap"
    with pytest.raises(
        TableUnfit,
        match=r"found no position.J4, .* at 1700000000.163456.*; "
        r"expected all joints in",
    ):
        read(write_bag(gap_path, messages))


def _unmeasured(row: int) -> dict[str, Any]:
    """A message of a broadcaster whose hardware has not answered: it sends NaN."""
    effort = [float("nan")] * 6
    position = [float("nan")] * 6
    return message(row, effort=effort, position=position)


def test_messages_before_the_first_reading_are_left_out(tmp_path: Path) -> None:
    contents = [message(row) for row in range(ROWS)]
    for row in (0, 1, 2, ROWS - 1):
        contents[row] = _unmeasured(row)
    path = tmp_path / "run.mcap"
    table = read(write_bag(path, joint_states(contents)))
    np.testing.assert_array_equal(table.values, VALUES[3:-1])
    assert table.stamps is not None
    assert table.stamps.first_ns == row_ns(3)
    assert table.remarks == ("left out, as values are nan at the ends of the bag: 4 stamps",)
    assert table.place(0, "position.J1") == f"{tmp_path}/run.mcap, row 4, column position.J1"


def test_a_reading_that_is_missing_among_others_is_refused(tmp_path: Path) -> None:
    parts = recording()
    effort = [0.5, float("nan"), 0.5, 0.5, 0.5, 0.5]
    parts[50] = ("/joint_states", message(50, effort=effort))
    path = tmp_path / "run.mcap"
    bag = write_bag(path, parts)
    with pytest.raises(
        TableUnfit,
        match=r"found nan for effort\.J2 at 1700000000\.323456\d+ s; "
        r".*by `keep`",
    ):
        read(bag)
    keep = KeptPart(to_row=50)
    table = read(bag, keep=keep)
    np.testing.assert_array_equal(table.values, VALUES[:50])


@pytest.mark.parametrize(
    ("part", "rows"),
    [
        (KeptPart(from_row=11, to_row=20), slice(10, 20)),
        (KeptPart(from_s=0.04, to_s=0.08), slice(10, 21)),
        (KeptPart(from_s=0.041), slice(11, None)),
    ],
)
def test_a_part_of_a_bag_is_kept(part: KeptPart, rows: slice, tmp_path: Path) -> None:
    run_path = tmp_path / "run.mcap"
    path = write_bag(run_path, recording())
    table = read(path, keep=part)
    np.testing.assert_array_equal(table.values, VALUES[rows])
    assert table.stamps is not None
    assert table.stamps.first_ns == row_ns(rows.start)
    assert table.first_row == rows.start


def _other_publisher(row: int, frame: str = "base", **changes: Any) -> dict[str, Any]:
    """A second node with the same joints, halfway between two messages of the first one."""
    header = stamped_header(row_ns(row) + STEP_NS // 2, frame)
    position = [0.0] * 6
    other = message(row, header=header, position=position, effort=[])
    return other | changes


def _with_another(frame: str = "base", **changes: Any) -> list[Message]:
    contents = []
    for row in range(ROWS):
        contents.append(message(row))
        if row % 10 == 5:
            contents.append(_other_publisher(row, frame, **changes))
    return joint_states(contents)


@pytest.mark.parametrize(
    ("parts", "other"),
    [
        (_with_another(), "2: position of J1, J2, J3, J4, J5, J6, frame 'base', 20 messages"),
        (
            _with_another("world", effort=[0.0] * 6),
            "2: position and effort of J1, J2, J3, J4, J5, J6, frame 'world', 20 messages",
        ),
        (
            _with_another(name=["J1", "J2"], position=[0.0, 0.0]),
            "2: position of J1, J2, frame 'base', 20 messages",
        ),
    ],
    ids=["without effort", "another frame", "some joints"],
)
def test_two_publishers_of_the_same_joints_are_named_and_one_is_chosen(
    parts: list[Message], other: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    bag = write_bag(path, parts)
    with pytest.raises(
        TableUnfit, match="found 2 publishers of the same joints on one topic"
    ) as caught:
        read(bag)
    first = "1: position and effort of J1, J2, J3, J4, J5, J6, frame 'base', 200 messages"
    assert caught.value.found.endswith(f"{first}; {other}")
    assert "`publisher: 1`" in caught.value.remedy
    table = read(bag, publisher=1)
    assert_whole(table)
    assert table.remarks == (f"left out, of another publisher: {other}",)
    with pytest.raises(
        TableUnfit,
        match=r"found publisher 3, and those of the topic are "
        r"1: .*; 2: ",
    ):
        read(bag, publisher=3)


def test_a_publisher_without_the_field_is_not_chosen_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    bag = write_bag(path, _with_another())
    with pytest.raises(TableUnfit, match="found messages with 6 names and 0 values of effort"):
        read(bag, publisher=2)


def _of_sections(position: dict[str, Any], current: dict[str, Any]) -> dict[str, Any]:
    """Sections whose positions and efforts have a topic or a publisher of their own."""
    moved = PositionColumns(
        file="run.mcap",
        columns=POSITION_COLUMNS,
        unit=PositionUnit.RAD,
        side=Side.JOINT,
        **position,
    )
    measured = CurrentColumns(
        file="run.mcap",
        columns=EFFORT_COLUMNS,
        unit="A",
        **current,
    )
    return {"position": moved, "current": measured}


def _apart(effort_topic: str, *, effort_rows: Sequence[int] = range(ROWS)) -> list[Message]:
    """Positions in messages of their own, and efforts in others."""
    parts = []
    for row in range(ROWS):
        position = message(row, effort=[])
        parts.append(("/joint_states", position))
        if row in effort_rows:
            effort = message(row, position=[])
            parts.append((effort_topic, effort))
    return parts


@pytest.mark.parametrize(
    ("topic", "position", "current"),
    [
        ("/efforts", {"topic": "/joint_states"}, {"topic": "/efforts"}),
        ("/joint_states", {"publisher": 1}, {"publisher": 2}),
    ],
    ids=["two topics", "two publishers of a topic"],
)
def test_positions_and_efforts_of_different_messages_are_joined_by_their_stamps(
    topic: str, position: dict[str, Any], current: dict[str, Any], tmp_path: Path
) -> None:
    sections = _of_sections(position, current)
    path = tmp_path / "run.mcap"
    bag = write_bag(path, _apart(topic))
    assert_whole(read(bag, **sections))

    # Beginning and end are those of the shorter one.
    effort_rows = range(10, ROWS - 20)
    messages = _apart(topic, effort_rows=effort_rows)
    bag = write_bag(path, messages)
    table = read(bag, **sections)
    np.testing.assert_array_equal(table.values, VALUES[10:-20])
    assert table.stamps is not None
    assert table.stamps.first_ns == row_ns(10)
    remarks = "\n".join(table.remarks)
    of_topic = "left out, as other columns have none there: 30 stamps of /joint_states"
    of_publisher = "30 stamps of the topic (publisher 1)"
    assert of_topic in remarks or of_publisher in remarks
    keep = KeptPart(from_row=3, to_row=52)
    part = read(bag, keep=keep, **sections)
    np.testing.assert_array_equal(part.values, table.values[2:52])
    assert part.first_row == 2


def test_messages_that_cannot_be_joined_are_named_with_their_rates(tmp_path: Path) -> None:
    sections = _of_sections({"topic": "/joint_states"}, {"topic": "/efforts"})
    messages = _apart("/efforts", effort_rows=range(0, ROWS, 2))
    path = tmp_path / "run.mcap"
    bag = write_bag(path, messages)
    with pytest.raises(TableUnfit) as caught:
        read(bag, **sections)
    rates = (
        "200 stamps each 0.004 s on /joint_states and 100 stamps each 0.008 s on /efforts, 100 of "
        "them the same"
    )
    assert caught.value.found == rates
    assert "nothing is interpolated between messages" in caught.value.remedy
    with pytest.raises(TableUnfit, match="`topic` under `position` and `current`"):
        read(bag)
    absent = _of_sections({"topic": "/joint_states"}, {"topic": "/absent"})
    with pytest.raises(
        TableUnfit, match="found topics /joint_states, /efforts; expected /absent of type"
    ):
        read(bag, **absent)


@pytest.mark.parametrize("publisher", [None, 1])
def test_positions_and_efforts_in_separate_messages_have_a_way(
    publisher: int | None, tmp_path: Path
) -> None:
    parts = _apart("/joint_states")
    path = tmp_path / "run.mcap"
    bag = write_bag(path, parts)
    with pytest.raises(TableUnfit, match="write each field to a CSV file") as caught:
        read(bag, publisher=publisher)
    assert (
        "`position: {..., publisher: 1}` and `current: {..., publisher: 2}`"
    ) in caught.value.remedy


def _same_content(every: int, later_ns: int) -> list[Message]:
    """A second node with the same joints, frame and fields: its stamps alone are others."""
    stamped = []
    for row in range(ROWS):
        stamp_ns = row_ns(row)
        stamped.append((stamp_ns, row))
        if row % every == 0:
            stamped.append((stamp_ns + later_ns, row))
    stamped.sort()
    contents = []
    for stamp_ns, row in stamped:
        header = stamped_header(stamp_ns)
        contents.append(message(row, header=header))
    return joint_states(contents)


@pytest.mark.parametrize(("every", "later_ns"), [(1, 1_000_000), (1, 2_700_000), (5, 1_300_000)])
def test_two_publishers_with_nothing_but_other_stamps_are_refused(
    every: int, later_ns: int, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    messages = _same_content(every, later_ns)
    bag = write_bag(path, messages)
    with pytest.raises(TableUnfit, match="stamps of two publishers") as caught:
        read(bag)
    found = caught.value.found
    other_rows = ROWS // every
    other_step_s = 0.004 * every
    assert f"{ROWS} messages each 0.004 s" in found
    assert f"{other_rows} messages each {other_step_s:g} s" in found
    assert "`frame_id`" in caught.value.remedy
    assert "`rhythm: 1`" in caught.value.remedy
    first = read(bag, rhythm=1)
    assert_whole(first)
    second = read(bag, rhythm=2)
    np.testing.assert_array_equal(second.values, VALUES[::every])
    assert second.stamps is not None
    assert second.stamps.first_ns == START_NS + later_ns


def test_a_rhythm_is_chosen_only_where_each_message_has_one(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run.mcap", recording())
    with pytest.raises(
        TableUnfit,
        match=r"found `rhythm: 2`, and no two even rows of stamps; .* "
        r"leave `rhythm` out",
    ):
        read(path, rhythm=2)
    lost = _same_content(1, 1_300_000)
    del lost[2 * ROWS - 21]
    run_path = tmp_path / "run.mcap"
    with pytest.raises(
        TableUnfit,
        match=r"found `rhythm: 1`, and (stamps of two publishers with "
        r"steps|no two even)",
    ):
        read(write_bag(run_path, lost), rhythm=1)


def _write_channels(
    path: Path, parts: Iterable[tuple[int, dict[str, Any]]], nodes: Sequence[str] = ("", "")
) -> Path:
    """A bag in which two channels have one topic, with the names of their nodes."""
    messages = [(f"/{number}", content) for number, content in parts]
    source = write_bag(path.with_suffix(".source"), messages)
    with source.open("rb") as read_from, path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for schema, channel, content in make_reader(read_from).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                topic = int(channel.topic[1:])
                metadata = {}
                if nodes[topic]:
                    metadata["callerid"] = nodes[topic]
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    "/joint_states", "cdr", number, metadata
                )
            target_channel = channels[channel.topic]
            writer.add_message(target_channel, content.log_time, content.data, content.publish_time)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("nodes", "named"),
    [
        (
            ("", ""),
            r"2: channel 2, position "
            r"and effort",
        ),
        (("/arm", "/fake"), r"1: /arm, .*; 2: /fake, channel 2, "),
    ],
)
def test_publishers_with_a_channel_each_are_named_and_chosen(
    nodes: Sequence[str], named: str, tmp_path: Path
) -> None:
    """Frame, joints and fields are the same."""
    parts = []
    for row in range(ROWS):
        parts.append((0, message(row)))
        position = [0.0] * 6
        parts.append((1, message(row, position=position)))
    path = tmp_path / "run.mcap"
    bag = _write_channels(path, parts, nodes)
    with pytest.raises(TableUnfit, match=named):
        read(bag)
    assert_whole(read(bag, publisher=1))
    other = read(bag, publisher=2)
    positions = other.values[:, :6]
    assert not positions.any()


def test_channels_after_each_other_are_one_publisher(tmp_path: Path) -> None:
    """A recorder that is set up anew in one file gives the topic another channel."""
    parts = []
    for row in range(ROWS):
        channel = row * 2 // ROWS
        parts.append((channel, message(row)))
    run_path = tmp_path / "run.mcap"
    path = _write_channels(run_path, parts)
    assert_whole(read(path))


@pytest.mark.parametrize("jitter", [0.02, 0.1, 0.3])
def test_uneven_stamps_of_one_publisher_are_not_two(jitter: float) -> None:
    random = np.random.default_rng(3)
    steps = np.arange(3000)
    noise = random.uniform(-1.0, 1.0, 3000)
    time_s = 0.004 * (steps + jitter * noise)
    assert interleaved(time_s) is None
    odd = steps % 2
    in_turn_s = 0.004 * (steps + jitter * 0.4 * odd)
    assert interleaved(in_turn_s) is None
    lost = np.delete(time_s, random.integers(0, 3000, 200))
    assert interleaved(lost) is None


def test_the_same_message_twice_is_two_rows(tmp_path: Path) -> None:
    """The resampling decides what duplicates mean."""
    first, *others = recording()
    path = tmp_path / "run.mcap"
    bag = write_bag(path, [first, first, *others])
    table = read(bag)
    assert len(table.values) == ROWS + 1


def test_joints_that_are_never_stamped_together_are_refused(tmp_path: Path) -> None:
    contents = []
    for row in range(ROWS):
        joints = (3, 4, 5)
        if row % 2:
            joints = (0, 1, 2)
        contents.append(message(row, joints))
    parts = joint_states(contents)
    path = tmp_path / "run.mcap"
    with pytest.raises(
        TableUnfit,
        match=r"found no position.J1, position.J2.*same stamp.*record a "
        r"topic that has all",
    ):
        read(write_bag(path, parts))


def test_without_stamps_the_time_of_recording_is_used(tmp_path: Path) -> None:
    header = stamped_header(0, frame="")
    contents = [message(row, header=header) for row in range(ROWS)]
    path = tmp_path / "run.mcap"
    table = read(write_bag(path, joint_states(contents)))
    assert table.stamps is not None
    recorded_s = np.arange(ROWS) * 5e-4
    np.testing.assert_allclose(table.stamps.time_s, recorded_s, atol=1e-12)
    assert table.remarks == ("200 messages without a stamp: the time of the recording is used",)


def _simulated(row: int, joints: Sequence[int] = range(6)) -> dict[str, Any]:
    """A message of a simulator, whose clock starts at 0."""
    header = stamped_header(row * STEP_NS, frame="")
    return message(row, joints, header=header)


@pytest.mark.parametrize(
    "parts", [(range(6),), ((2, 0, 1), (5, 3, 4))], ids=["one publisher", "two publishers"]
)
def test_a_clock_that_starts_at_0_keeps_its_first_stamp(
    parts: tuple[Sequence[int], ...], tmp_path: Path
) -> None:
    contents = []
    for row in range(ROWS):
        for joints in parts:
            contents.append(_simulated(row, joints))
    path = tmp_path / "run.mcap"
    table = read(write_bag(path, joint_states(contents)))
    np.testing.assert_array_equal(table.values, VALUES)
    assert table.stamps is not None
    assert table.stamps.first_ns == 0
    np.testing.assert_allclose(table.stamps.time_s, TIME_S, atol=1e-12)
    assert table.remarks == ()


def test_a_message_without_stamp_among_times_of_day_has_the_time_of_its_recording(
    tmp_path: Path,
) -> None:
    messages = recording()
    header = stamped_header(0, frame="")
    messages[0] = ("/joint_states", message(0, header=header))
    path = tmp_path / "run.mcap"
    table = read(write_bag(path, messages))
    assert_whole(table)
    assert table.remarks == ("1 message without a stamp: the time of the recording is used",)


def _write_files(folder: Path, count: int, rows: int) -> None:
    """Write the recording in several files of so many rows."""
    folder.mkdir()
    messages = recording()
    for number in range(count):
        path = folder / f"bag_{number}.mcap"
        first = number * rows
        part = messages[first : first + rows]
        write_bag(path, part)


def test_a_folder_is_one_bag_of_several_files(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    _write_files(folder, count=11, rows=20)
    assert_whole(read(folder))


def _in_parts(folder: Path, listed: str) -> Path:
    """A bag of three files, with the metadata that its recorder writes."""
    _write_files(folder, count=3, rows=80)
    metadata = (
        f"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n{listed}  "
        "topics: []\n"
    )
    (folder / "metadata.yaml").write_text(metadata, encoding="utf-8")
    return folder


LISTED = """\
  - bag_0.mcap
  - bag_1.mcap
  - bag_2.mcap
"""
QUOTED = LISTED.replace("  - ", "    - '").replace(".mcap", ".mcap'")


@pytest.mark.parametrize("listed", [LISTED, QUOTED])
def test_a_bag_that_lacks_a_part_is_refused(listed: str, tmp_path: Path) -> None:
    """Without its last part it would end early, and nothing else shows it."""
    bag_folder = tmp_path / "bag"
    folder = _in_parts(bag_folder, listed)
    assert_whole(read(folder))
    (folder / "bag_2.mcap").rename(folder / "renamed_2.mcap")
    assert_whole(read(folder))
    (folder / "renamed_2.mcap").unlink()
    with pytest.raises(
        TableUnfit,
        match=r"found no bag_2\.mcap, which metadata\.yaml names; "
        r"expected all 3 files",
    ):
        read(folder)


def test_a_topic_is_chosen(tmp_path: Path) -> None:
    desired = [9.0] * 6
    others = []
    for row in range(ROWS):
        content = message(row, position=desired)
        others.append(("/desired", content))
    messages = [*others, *recording()]
    path = tmp_path / "run.mcap"
    bag = write_bag(path, messages)
    with pytest.raises(
        TableUnfit,
        match=r"found joint states on 2 topics, /desired, "
        r"/joint_states; .*`topic: NAME`",
    ):
        read(bag)
    assert_whole(read(bag, topic="/joint_states"))
    with pytest.raises(
        TableUnfit,
        match=r"found topics /desired, /joint_states; expected /arm of type sensor_msgs.*; correct "
        r"`topic` .*; joint states are on /desired, /joint_states$",
    ):
        read(bag, topic="/arm")


@pytest.mark.parametrize("section", [None, "position", "current"])
def test_an_empty_topic_is_refused_in_the_description(
    section: str | None, checkout: Path, tmp_path: Path
) -> None:
    document = _document(checkout)
    keys = document
    if section is not None:
        keys = document[section]
    keys["topic"] = ""
    description = _write_description(tmp_path, document)
    with pytest.raises(SchemaMismatch, match="topic"):
        load_import(description)


def test_stamps_alone_from_a_bag_are_refused(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.mcap", recording())
    with pytest.raises(TableUnfit, match=r"found the time column alone; .*correct `time`"):
        read(bag, ())


def test_names_with_line_ends_are_escaped_in_a_message(tmp_path: Path) -> None:
    names = ["J1\nfound", "J2\r\n", "J3", "J4", "J5", "J6"]
    messages = joint_states([message(0, name=names)])
    bag = write_bag(tmp_path / "run.mcap", messages)
    with pytest.raises(TableUnfit) as caught:
        read(bag, ("position.J3", "position.J7"))
    assert str(caught.value).isprintable()
    assert r"'J1\nfound'" in caught.value.found


@pytest.mark.parametrize(
    ("columns", "changes", "error"),
    [
        (
            ("position.J7",),
            {},
            "found joints J1, J2, J3, J4, J5, J6; expected those of position.J7",
        ),
        (
            ("torque.J1",),
            {},
            "found column 'torque.J1'; expected position.JOINT, velocity.JOINT or effort.JOINT",
        ),
        (("velocity.J1",), {}, "6 names and 0 values of velocity"),
        (("effort.J1",), {"effort": [1.0, float("nan")] + [0.0] * 4}, None),
        (
            ("effort.J2",),
            {"effort": [1.0, float("nan")] + [0.0] * 4},
            "found nan in every message for effort.J2; expected numbers",
        ),
        (
            ("effort.J2",),
            {"effort": [1.0, float("inf")] + [0.0] * 4},
            "row 1, column effort.J2: found inf",
        ),
    ],
)
def test_what_a_bag_lacks_is_named(
    columns: tuple[str, ...], changes: dict[str, Any], error: str | None, tmp_path: Path
) -> None:
    messages = joint_states([message(0, **changes)])
    path = tmp_path / "run.mcap"
    bag = write_bag(path, messages)
    if error is None:
        table = read(bag, columns)
        assert table.values.tolist() == [[1.0]]
        return
    with pytest.raises(TableUnfit, match=error):
        read(bag, columns)


def _document(checkout: Path) -> dict[str, Any]:
    """An import description of the bag `run.mcap`."""
    position = {"file": "run.mcap", "columns": ["position"], "unit": "rad", "side": "joint"}
    current = {"file": "run.mcap", "columns": ["effort"], "unit": "A"}
    time = {"file": "run.mcap", "column": STAMP, "unit": "ns"}
    return {
        "name": "run",
        "cell": str(checkout / "configs/cells/demo.yaml"),
        "position": position,
        "current": current,
        "time": time,
    }


def _write_description(tmp_path: Path, document: dict[str, Any]) -> Path:
    """The file of an import description."""
    path = tmp_path / "run.yaml"
    path.write_text(json.dumps(document))
    return path


def test_a_bag_is_imported_with_its_joints_as_axes(checkout: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_bag(path, recording())
    document = _document(checkout)
    description = _write_description(tmp_path, document)
    out = tmp_path / "log.mcap"
    assert run_verb("import", description, "--data", tmp_path, "--out", out) == 0
    run, _ = load_run(out)
    assert run.rate_hz == pytest.approx(250.0)
    np.testing.assert_allclose(run.position_rad, POSITION, atol=1e-8)
    np.testing.assert_allclose(run.current_a, EFFORT, atol=1e-8)

    document["position"]["columns"] = list(JOINTS)
    document["current"]["columns"] = list(JOINTS)
    description = _write_description(tmp_path, document)
    again = tmp_path / "again.mcap"
    assert run_verb("import", description, "--data", tmp_path, "--out", again) == 0
    assert again.read_bytes() == out.read_bytes()

    document["time"] = {"file": "run.mcap", "column": "stamp", "unit": "s"}
    description = _write_description(tmp_path, document)
    refused = tmp_path / "x.mcap"
    code = run_verb("import", description, "--data", tmp_path, "--out", refused)
    assert code == 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"nowhere: found no such file .*; expected a CSV or MATLAB file, or a ROS bag"),
        (b"PAR1" + bytes(20), "nowhere: found a Parquet file; expected a CSV or MATLAB file, or"),
        (
            b"J1,J2\n1,2\n",
            "which is also position.columns.*nowhere is read as a CSV file.*is no bag",
        ),
    ],
    ids=["missing", "parquet", "text"],
)
def test_the_same_joints_of_a_file_that_is_no_bag_are_answered_by_the_file(
    content: bytes | None, message: str, checkout: Path, tmp_path: Path
) -> None:
    document = _document(checkout)
    for key in ("position", "current"):
        document[key] |= {"file": "nowhere", "columns": list(JOINTS)}
    document["time"]["file"] = "nowhere"
    if content is not None:
        (tmp_path / "nowhere").write_bytes(content)
    description = _write_description(tmp_path, document)
    with pytest.raises(DaqError, match=message):
        import_recording(description, tmp_path, tmp_path / "log.mcap", software="test")


@pytest.mark.parametrize("columns", [list(JOINTS), ["effort"], list(POSITION_COLUMNS)])
def test_a_bag_has_no_temperature(checkout: Path, tmp_path: Path, columns: list[str]) -> None:
    path = tmp_path / "run.mcap"
    write_bag(path, recording()[:1])
    out = tmp_path / "log.mcap"
    document = _document(checkout)
    document["temperature"] = {"file": "run.mcap", "columns": columns}
    description = _write_description(tmp_path, document)
    with pytest.raises(
        TableUnfit, match="found `temperature` from a ROS 2 bag; expected a file with temperatures"
    ):
        import_recording(description, tmp_path, out, software="test")
    assert not out.exists()


def test_torques_of_a_bag_come_from_another_field_than_the_currents(
    checkout: Path, tmp_path: Path
) -> None:
    contents = []
    for row in range(ROWS):
        content = message(row)
        content["velocity"] = content["effort"]
        contents.append(content)
    path = tmp_path / "run.mcap"
    write_bag(path, joint_states(contents))
    document = _document(checkout)
    out = tmp_path / "log.mcap"
    other_joints = ["K0", "K1", "K2", "K3", "K4", "K5"]
    # The field counts: the effort of other joints is no torque either where that of the axes is a
    # current.
    for columns in (list(JOINTS), ["effort"], list(EFFORT_COLUMNS), other_joints):
        document["torque"] = {"file": "run.mcap", "columns": columns, "side": "joint"}
        description = _write_description(tmp_path, document)
        with pytest.raises(
            ConfigurationInconsistent,
            match=r"found effort of run\.mcap, which "
            r"current is read from",
        ):
            import_recording(description, tmp_path, out, software="test")
    document["torque"] = {"file": "run.mcap", "columns": ["velocity"], "side": "joint"}
    description = _write_description(tmp_path, document)
    import_recording(description, tmp_path, out, software="test")
    run, _ = load_run(out)
    assert run.torque_channels


def test_a_healthy_bag_is_called_a_bag(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    bag = write_bag(path, recording())
    target = tmp_path / "sums.mcap"
    sums = _repack(bag, target, enable_data_crcs=True)
    saved = tmp_path / "saved.mcap"
    for words in (
        ["info", bag],
        ["info", sums],
        ["salvage", bag, "--out", saved],
    ):
        arguments = [str(word) for word in words]
        assert main(arguments) == 4
        error_output = capfd.readouterr().err
        said = " ".join(error_output.split())
        assert "joint states of J1, J2, J3, J4, J5, J6 on /joint_states" in said
        assert "damaged" not in said
        assert "drivegain import" in said
        assert "the joints as `columns`" in said
    text_path = tmp_path / "text.mcap"
    with pytest.raises(
        LogForeign,
        match=r"with /chatter; .*reads bags with "
        r"sensor_msgs/msg/JointState",
    ):
        read_log(_of_text(text_path))
    with pytest.raises(
        TableUnfit,
        match="found topics /chatter; expected a topic of type sensor_msgs/msg/JointState",
    ):
        read(text_path)


def _of_text(path: Path) -> Path:
    with path.open("wb") as stream, Ros2Writer(stream) as writer:
        schema = writer.register_msgdef("std_msgs/msg/String", "string data")
        writer.write_message("/chatter", schema, {"data": "hello"})
    return path


@pytest.mark.parametrize("size", [100, 300, 1000])
def test_a_bag_that_ends_before_its_first_message_is_not_salvaged(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], size: int
) -> None:
    path = tmp_path / "run.mcap"
    bag = write_bag(path, recording())
    content = bag.read_bytes()
    bag.write_bytes(content[:size])
    saved = tmp_path / "saved.mcap"
    for words in (
        ["info", bag],
        ["fit", bag],
        ["salvage", bag, "--out", saved],
    ):
        arguments = [str(word) for word in words]
        assert main(arguments) == 4
        failure = capfd.readouterr().err
        assert "the begin of a bag of" in failure
        assert "`drivegain salvage`" not in failure


def test_a_bag_of_a_killed_recorder_is_called_unfinished(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    bag = write_bag(path, recording(), chunk_size=4000)
    content = bag.read_bytes()[:-2000]
    bag.write_bytes(content)
    with pytest.raises(LogTruncated, match=r"expected a finished bag; .*mcap recover"):
        read(bag)
    with pytest.raises(LogForeign, match="joint states of J1"):
        read_log(bag)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(seed=st.integers(0, 10**6), hurt=st.sampled_from(("flip", "cut", "junk")))
def test_a_damaged_bag_is_refused_or_the_same(
    seed: int, hurt: str, bag_bytes: bytes, tmp_path_factory: Any
) -> None:
    """With the checksums of ROS 2 (chunks only), damage between them may remove a chunk,
    never change a number.
    """
    rng = random.Random(seed)
    path = tmp_path_factory.getbasetemp() / "hurt.mcap"
    place = rng.randrange(len(bag_bytes))
    content = damaged(bag_bytes, hurt, place, rng, junk_bytes=40)
    path.write_bytes(content)
    try:
        table = read(path)
    except DataError as error:
        assert str(path) in str(error)
    else:
        rows = {row.tobytes() for row in table.values}
        recorded_rows = {row.tobytes() for row in VALUES}
        assert rows <= recorded_rows


@pytest.fixture(scope="module")
def bag_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A bag of some chunks."""
    path = tmp_path_factory.mktemp("bag") / "run.mcap"
    messages = recording()[:60]
    bag = write_bag(path, messages, chunk_size=4000)
    return bag.read_bytes()


@settings(deadline=None, max_examples=200, derandomize=True)
@given(st.binary(max_size=200), st.integers(0, 1))
def test_any_bytes_are_a_joint_state_or_refused(data: bytes, order: int) -> None:
    encapsulation = bytes((0, order, 0, 0))
    try:
        state = joint_state_from_cdr(encapsulation + data)
    except ValueError:
        return
    for field in (state.names, state.position, state.effort):
        assert len(field) <= len(data)


def test_a_message_of_the_other_byte_order_is_read() -> None:
    stamp = struct.pack(">iI", 5, 6)
    empty_frame = struct.pack(">I", 1) + b"\0\0\0\0"
    names = struct.pack(">I", 2)
    for name in (b"J1", b"J2"):
        names += struct.pack(">I", 3) + name + b"\0\0"
    positions = struct.pack(">I2d", 2, 1.5, -2.5)
    no_velocities = struct.pack(">I", 0)
    no_efforts = struct.pack(">I", 0)
    fields = (stamp, empty_frame, names, positions, no_velocities, no_efforts)

    state = joint_state_from_cdr(b"\0\0\0\0" + b"".join(fields))

    assert state.stamp_ns == 5_000_000_006
    assert state.names == ("J1", "J2")
    assert state.position == (1.5, -2.5)
    assert state.effort == ()


def test_a_joint_twice_in_one_message_is_refused(tmp_path: Path) -> None:
    names = ["J1", "J1", *JOINTS[2:]]
    messages = joint_states([message(0, name=names)])
    path = tmp_path / "run.mcap"
    with pytest.raises(TableUnfit, match="joint J1 twice"):
        read(write_bag(path, messages))
