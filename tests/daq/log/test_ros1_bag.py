"""ROS 1 bags as `rosbags` writes them:
the same numbers, the nodes that published them, or an error.
"""

from __future__ import annotations

import bz2
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from daq import environment
from daq.errors import ConfigurationMissing, DataError, LogCorrupt, TableUnfit
from daq.log.bag_table import read_bag
from daq.log.container import LARGEST_CHUNK
from daq.log.importing import reader_of
from daq.log.message import JOINTS_SCHEMA
from daq.log.ros1_bag import unpack_chunk
from tests.daq.log.test_bag import (
    EFFORT,
    JOINTS,
    POSITION,
    ROWS,
    START_NS,
    STEP_NS,
    assert_whole,
    read,
)
from tests.daq.logs import damaged

TYPES = get_typestore(Stores.ROS1_NOETIC)
STATE = TYPES.types[JOINTS_SCHEMA]
HEADER = TYPES.types["std_msgs/msg/Header"]
STAMP = TYPES.types["builtin_interfaces/msg/Time"]
COMPRESSIONS = (None, *Writer.CompressionFormat)


def record(
    path: Path,
    compression: Writer.CompressionFormat | None = None,
    *,
    second: bool = False,
    rows: int = ROWS,
) -> Path:
    """The recording of `test_bag`; a second node sends zeros between the messages of the first
    one.
    """
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        arm = writer.add_connection(
            "/joint_states", JOINTS_SCHEMA, typestore=TYPES, callerid="/arm_driver"
        )
        other = writer.add_connection(
            "/joint_states", JOINTS_SCHEMA, typestore=TYPES, callerid="/fake_controller"
        )
        chatter = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=TYPES)
        for row in range(rows):
            time_ns = START_NS + row * STEP_NS
            writer.write(arm, time_ns, _serialised(row, time_ns, POSITION[row], EFFORT[row]))
            writer.write(chatter, time_ns, b"\x02\x00\x00\x00hi")
            if second:
                between_ns = time_ns + STEP_NS // 2
                position = np.zeros(6)
                effort = np.zeros(6)
                writer.write(other, between_ns, _serialised(row, between_ns, position, effort))
    return path


def _serialised(row: int, time_ns: int, position: Any, effort: Any) -> bytes:
    stamp = STAMP(*divmod(time_ns, 10**9))
    header = HEADER(row, stamp, "base")
    message = STATE(header, list(JOINTS), position, np.zeros(0), effort)
    return bytes(TYPES.serialize_ros1(message, JOINTS_SCHEMA))


@pytest.mark.parametrize("compression", COMPRESSIONS, ids=str)
def test_a_bag_of_ros_1_has_the_same_numbers(
    compression: Writer.CompressionFormat | None, tmp_path: Path
) -> None:
    path = tmp_path / "run.bag"
    bag = record(path, compression)
    assert reader_of(bag) is read_bag
    assert_whole(read(bag))
    renamed = bag.rename(tmp_path / "recording")
    assert reader_of(renamed) is read_bag
    assert_whole(read(renamed))


def test_the_nodes_that_publish_the_same_joints_are_named(tmp_path: Path) -> None:
    """Frame, joints and fields are the same; the bag knows the nodes."""
    path = tmp_path / "run.bag"
    bag = record(path, second=True)
    with pytest.raises(
        TableUnfit,
        match=r"1: /arm_driver, position and effort .*; 2: "
        r"/fake_controller, position",
    ):
        read(bag)
    assert_whole(read(bag, publisher=1))
    assert not read(bag, publisher=2).values.any()


def test_without_the_package_its_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = record(tmp_path / "run.bag")
    monkeypatch.setattr(environment, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationMissing, match=r"pip install 'drivegain\[ros1\]'"):
        read(bag)


def test_an_unfinished_bag_says_how_to_repair_it(tmp_path: Path) -> None:
    bag = record(tmp_path / "run.bag")
    bag.write_bytes(bag.read_bytes()[:-3000])
    with pytest.raises(LogCorrupt, match="rosbag reindex"):
        read(bag)


def test_a_bag_packed_by_bz2_with_a_damaged_byte_is_called_damaged(tmp_path: Path) -> None:
    bag = record(tmp_path / "run.bag", Writer.CompressionFormat.BZ2)
    content = bytearray(bag.read_bytes())
    packed_at = content.index(b"BZh9")
    content[packed_at + 2000] ^= 0xFF
    bag.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"found damaged bytes; .*copy it again"):
        read(bag)


def test_an_index_that_does_not_fit_the_messages_is_called_damaged(tmp_path: Path) -> None:
    """The library asserts it, without words."""
    bag = record(tmp_path / "run.bag")
    content = bytearray(bag.read_bytes())
    header_bytes = bytes([47, 0, 0, 0])
    in_index = content.index(b"op=\x04")
    record_at = content.rindex(header_bytes, 0, in_index)
    first_time_at = record_at + 4 + 47 + 4
    content[first_time_at] ^= 0x01
    bag.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"found damaged bytes; .*copy it again"):
        read(bag)


def test_two_bags_in_one_file_are_refused(tmp_path: Path) -> None:
    """The second one was left out without a word."""
    bag = record(tmp_path / "run.bag")
    content = bag.read_bytes()
    bag.write_bytes(content + content)
    behind = f"found {len(content)} bytes behind its end, which begin as another bag does"
    with pytest.raises(LogCorrupt, match=f"{behind}; .*`head -c {len(content)}`"):
        read(bag)
    bag.write_bytes(content + b"\n")
    with pytest.raises(LogCorrupt, match="found 1 byte behind its end; expected one bag"):
        read(bag)


@pytest.mark.slow
@pytest.mark.parametrize("size", [LARGEST_CHUNK, LARGEST_CHUNK + 1])
def test_a_chunk_that_unfolds_to_more_than_a_chunk_is_refused(size: int) -> None:
    packed = bz2.compress(bytes(size))
    if size == LARGEST_CHUNK:
        assert len(unpack_chunk(bz2.BZ2Decompressor, packed)) == size
        return
    with pytest.raises(ValueError, match="unfolds to more than"):
        unpack_chunk(bz2.BZ2Decompressor, packed)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, ...]:
    """A bag of each compression."""
    folder = tmp_path_factory.mktemp("ros1")
    return tuple(
        record(folder / f"{number}.bag", one, rows=20).read_bytes()
        for number, one in enumerate(COMPRESSIONS)
    )


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    kind=st.integers(0, len(COMPRESSIONS) - 1),
    hurt=st.sampled_from(["flip", "cut", "junk"]),
)
def test_a_damaged_bag_is_read_or_refused(
    seed: int, kind: int, hurt: str, bags: tuple[bytes, ...], tmp_path_factory: Any
) -> None:
    rng = random.Random(seed)
    path = tmp_path_factory.getbasetemp() / "hurt.bag"
    path.write_bytes(damaged(bags[kind], hurt, rng.randrange(len(bags[kind])), rng, junk_bytes=40))
    try:
        table = read(path)
    except DataError:
        return
    assert table.values.shape[1] == 12
