"""ROS 2 bags in SQLite, and packed ones, as `rosbags` writes them:
the same numbers, or an error.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from io import FileIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from daq.cli import main
from daq.config.foreign_files import HEAD_BYTES
from daq.errors import (
    DataError,
    ExitCode,
    LogCorrupt,
    LogForeign,
    LogMissing,
    LogTruncated,
    OutputFailed,
    TableUnfit,
)
from daq.log.bag_file import open_bag
from daq.log.importing import reader_of
from daq.log.mcap_bag import unpack_message
from daq.log.message import JOINTS_SCHEMA
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

TYPES = get_typestore(Stores.ROS2_HUMBLE)


def record(folder: Path, storage: StoragePlugin, packed: CompressionMode, rows: int = ROWS) -> Path:
    """The recording of `test_bag`, with another topic, written by the library of another maker."""
    state = TYPES.types[JOINTS_SCHEMA]
    header = TYPES.types["std_msgs/msg/Header"]
    stamp = TYPES.types["builtin_interfaces/msg/Time"]
    text = TYPES.types["std_msgs/msg/String"]
    writer = Writer(folder, version=9, storage_plugin=storage)
    writer.set_compression(packed, CompressionFormat.ZSTD)
    with writer:
        joints = writer.add_connection("/joint_states", JOINTS_SCHEMA, typestore=TYPES)
        chatter = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=TYPES)
        for row in range(rows):
            time_ns = START_NS + row * STEP_NS
            at = header(stamp(*divmod(time_ns, 10**9)), "base")
            message = state(at, list(JOINTS), POSITION[row], np.zeros(0), EFFORT[row])
            writer.write(joints, time_ns, TYPES.serialize_cdr(message, JOINTS_SCHEMA))
            writer.write(
                chatter, time_ns, TYPES.serialize_cdr(text("hello"), "std_msgs/msg/String")
            )
    return folder


KINDS = list(product(StoragePlugin, CompressionMode))
# There is no such kind
KINDS.remove((StoragePlugin.SQLITE3, CompressionMode.STORAGE))


@pytest.mark.parametrize(("storage", "packed"), KINDS, ids=lambda value: value.name.lower())
def test_every_kind_of_bag_has_the_same_numbers(
    storage: StoragePlugin, packed: CompressionMode, tmp_path: Path
) -> None:
    """As a folder and as its one file, whatever they are called."""
    bag_folder = tmp_path / "bag"
    folder = record(bag_folder, storage, packed).rename(tmp_path / "run #1 50%?")
    assert_whole(read(folder))
    (file,) = [file for file in folder.iterdir() if file.name != "metadata.yaml"]
    assert_whole(read(file))
    plain = file.rename(tmp_path / "data")
    assert reader_of(plain) is reader_of(folder)
    assert_whole(read(plain))


def test_a_file_that_a_player_has_unpacked_is_read_once(tmp_path: Path) -> None:
    bag_folder = tmp_path / "bag"
    folder = record(bag_folder, StoragePlugin.SQLITE3, CompressionMode.FILE)
    packed = folder / "bag.db3.zstd"
    with packed.open("rb") as stream, (folder / "bag.db3").open("wb") as unpacked:
        zstandard.ZstdDecompressor().copy_stream(stream, unpacked)
    assert_whole(read(folder))


@pytest.mark.parametrize(
    ("content", "kind", "message"),
    [
        (b"notes of the run\n", LogForeign, "a text file that begins with 'notes of the run'"),
        (b"t,q1\n0,1\n", LogForeign, "a text file that begins with 't,q1'"),
        (b"PAR1" + bytes(20), LogForeign, "a Parquet file"),
        (bytes(30), LogForeign, "a file of an unknown kind"),
        (b"#ROSB", LogTruncated, "5 bytes with which a bag begins; .*copy it again"),
        (b"SQLite", LogTruncated, "6 bytes with which a bag begins"),
        (b"\x89MC", LogTruncated, "3 bytes with which a bag begins"),
    ],
)
def test_a_file_that_is_no_bag_is_named_by_its_kind(
    content: bytes, kind: type[DataError], message: str, tmp_path: Path
) -> None:
    """The advice was that of commands that take logs."""
    path = tmp_path / "run.bag"
    path.write_bytes(content)
    with pytest.raises(kind, match=f"found {message}") as caught:
        read(path)
    assert "command's help" not in str(caught.value)


def test_a_bag_that_is_not_there_is_called_missing(tmp_path: Path) -> None:
    with pytest.raises(LogMissing, match=r"no such file .*; expected a ROS bag.*--data"):
        read(tmp_path / "run.bag")


def test_two_databases_in_one_file_are_refused(tmp_path: Path) -> None:
    """SQLite reads the first one, and does not look behind it."""
    folder = record(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    file = folder / "bag.db3"
    content = file.read_bytes()
    file.write_bytes(content + content)
    with pytest.raises(LogCorrupt, match=f"{len(content)} bytes behind its end, .* another bag"):
        read(file)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short bag in SQLite."""
    folder = tmp_path_factory.mktemp("bags")
    bag_folder = folder / "bag"
    return record(bag_folder, StoragePlugin.SQLITE3, CompressionMode.NONE, rows=60) / "bag.db3"


COMPUTED = """
    ALTER TABLE messages RENAME TO kept;
    CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, unused INTEGER,
                           data BLOB GENERATED ALWAYS AS (zeroblob({size})) VIRTUAL);
    INSERT INTO messages SELECT id, topic_id, timestamp, 0 FROM kept;
"""  # noqa: E501
ENDLESS = """
    ALTER TABLE messages RENAME TO kept;
    CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
                            SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM n WHERE {which};
"""  # noqa: E501
MANY_TOPICS = """
    ALTER TABLE topics RENAME TO kept;
    CREATE VIEW topics AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
                          SELECT id, {name} AS name, '' AS type, '' AS serialization_format FROM n;
"""
MORE_TOPICS = """
    WITH RECURSIVE n(id) AS (SELECT 100 UNION ALL SELECT id + 1 FROM n WHERE id < 40000)
    INSERT INTO topics (id, name, type, serialization_format, offered_qos_profiles,
                        type_description_hash)
    SELECT id, '/topic_' || id, hex(zeroblob(40)), 'cdr', '', '' FROM n;
"""


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (COMPUTED.format(size=50_000_000), "more bytes than the file has"),
        (COMPUTED.format(size=900_000_000), "string or blob too big"),
        (ENDLESS.format(which="id < 0"), "interrupted"),
        (ENDLESS.format(which="1"), "/joint_states with encapsulation 00"),
        (MANY_TOPICS.format(name="''"), "more bytes than the file has"),
        (
            MANY_TOPICS.format(name="hex(zeroblob(20000000))"),
            "row 1: found more bytes than the file has",
        ),
        ("DROP TABLE topics", "no such table: topics"),
        ("DELETE FROM topics", "found topic 1, time 17000"),
        (
            "UPDATE messages SET timestamp = 'noon'",
            "time 'noon'; expected a topic, nanoseconds and bytes",
        ),
        ("UPDATE messages SET data = 5", "expected a topic, nanoseconds and bytes"),
        ("UPDATE messages SET data = x'00010000'", "/joint_states with a message of 4 bytes"),
        ("UPDATE topics SET offered_qos_profiles = '" + "[" * 100_000 + "'", None),
        (MORE_TOPICS, None),
    ],
)
def test_a_hostile_database_is_refused_in_bounded_time(
    script: str, message: str | None, database: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bag.db3"
    shutil.copyfile(database, path)
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(script)
    began = time.process_time()
    if message is None:  # what is not needed is not parsed
        assert len(read(path).values) == 60
    else:
        with pytest.raises(LogCorrupt, match=message) as caught:
            read(path)
        assert str(path) in str(caught.value)
    assert time.process_time() - began < 5.0


@pytest.mark.parametrize("topic", [None, "/chatter"])
def test_a_bag_without_the_joints_says_what_it_has(
    topic: str | None, database: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bag.db3"
    shutil.copyfile(database, path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(
            "DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = "
            "'/joint_states')"
        )
    with pytest.raises(
        TableUnfit,
        match=r"found topics /chatter; expected (a topic|/chatter) of "
        r"type sensor_msgs",
    ):
        read(path, topic=topic)


@pytest.mark.parametrize(
    ("suffix", "found"),
    [
        ("-wal", "messages that are not in the bag yet"),
        ("-journal", "which undoes a change that was not finished"),
    ],
)
def test_a_database_that_its_recorder_has_not_finished_is_refused(
    suffix: str, found: str, database: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bag.db3"
    shutil.copyfile(database, path)
    rest = tmp_path / f"bag.db3{suffix}"
    rest.touch()
    assert len(read(path).values) == 60
    rest.write_bytes(b"rows")
    pattern = (
        rf"found bag\.db3{suffix}, .*{found}; expected a finished bag; "
        r".*: copy both, and run `sqlite3 bag\.db3 'PRAGMA quick_check'` there"
    )
    with pytest.raises(
        LogTruncated,
        match=pattern,
    ):
        read(path)


@pytest.mark.parametrize("packed_suffix", [".zstd", ".zst"])
@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_a_database_that_was_packed_before_its_recorder_finished_it_is_refused(
    suffix: str, packed_suffix: str, database: Path, tmp_path: Path
) -> None:
    """SQLite has named its log before the file was packed."""
    path = tmp_path / f"bag.db3{packed_suffix}"
    content = zstandard.compress(database.read_bytes())
    path.write_bytes(content)
    assert len(read(path).values) == 60
    rest = tmp_path / f"bag.db3{suffix}"
    rest.write_bytes(b"rows")
    pattern = (
        rf"found bag\.db3{suffix}, .*; expected a finished bag; "
        rf".*: copy both, unpack the copy \(`zstd -d bag\.db3{packed_suffix} -o bag\.db3`\), and "
        r"run `sqlite3 bag\.db3 'PRAGMA quick_check'` there"
    )
    with pytest.raises(LogTruncated, match=pattern):
        read(path)


@settings(deadline=None, max_examples=80, derandomize=True)
@given(seed=st.integers(0, 10**6), hurt=st.sampled_from(("flip", "cut", "junk")))
def test_a_damaged_database_is_read_or_refused(
    seed: int, hurt: str, database: Path, tmp_path_factory: Any
) -> None:
    """SQLite has no checksums: a flipped bit of a number passes, a broken page does not."""
    rng = random.Random(seed)
    content = database.read_bytes()
    path = tmp_path_factory.getbasetemp() / "hurt.db3"
    path.write_bytes(damaged(content, hurt, rng.randrange(len(content)), rng, junk_bytes=40))
    try:
        table = read(path)
    except DataError as error:
        assert str(path) in str(error)
    else:
        assert 0 < len(table.values) <= 60


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap.zstd"
    content = zstandard.compress(bytes(2**28))
    path.write_bytes(content)
    with pytest.raises(
        LogCorrupt,
        match="unfolds to more than 200 times its size; expected a recording, packed by zstd",
    ):
        read(path)
    with pytest.raises(ValueError, match="bytes that unfold to 268435456"):
        unpack_message(zstandard.compress(bytes(2**28)))
    with pytest.raises(ValueError, match="packed bytes"):
        unpack_message(zstandard.compress(bytes(range(200)))[:-9])


@pytest.mark.parametrize(
    "change", [lambda data: data[:-50], lambda data: data[:50] + bytes(50) + data[100:]]
)
def test_a_packed_file_that_is_damaged_is_named(
    change: Callable[[bytes], bytes], database: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bag.db3.zstd"
    content = change(zstandard.compress(database.read_bytes()))
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("name", ["bag.db3", "bag.mcap", "bag.bag", "bag.mcap.zstd"])
def test_an_empty_file_is_called_that(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.touch()
    with (
        pytest.raises(LogCorrupt, match=f"{name}: found an empty file; expected a recording"),
        open_bag(path),
    ):
        pass


@pytest.mark.parametrize("length", [4, 8, 12])
def test_a_packed_file_that_was_cut_before_its_first_block_is_called_that(
    tmp_path: Path, length: int
) -> None:
    packed = zstandard.ZstdCompressor().compress(b"x" * 1000)
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(packed[:length])
    with (
        pytest.raises(LogCorrupt, match="found a file that unfolds to nothing: it was cut"),
        open_bag(path),
    ):
        pass


class UnreadableFile(FileIO):
    """A file on a disk that gives its first bytes and no more."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= HEAD_BYTES:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(size) or b""


def test_a_packed_file_that_cannot_be_read_is_named_not_the_room_for_its_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(zstandard.compress(bytes(1000)))
    monkeypatch.setattr("daq.log.bag_file.open_regular", UnreadableFile)
    with (
        pytest.raises(LogMissing, match=r"bag\.mcap\.zstd: found input/output error; .* zstd"),
        open_bag(path),
    ):
        pass


def test_no_folder_for_what_a_file_unfolds_to_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(zstandard.compress(bytes(1000)))
    missing = tmp_path / "missing"
    monkeypatch.setattr(tempfile, "tempdir", str(missing))
    pattern = (
        r"folder for temporary files: found no such file or directory; expected room for what "
        r"bag\.mcap\.zstd unfolds to; .*TMPDIR"
    )
    with pytest.raises(OutputFailed, match=pattern), open_bag(path):
        pass


def test_no_room_for_what_a_file_unfolds_to_is_an_error(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    checkout: Path,
) -> None:
    """As on a full disk."""
    bag_folder = tmp_path / "bag"
    folder = record(bag_folder, StoragePlugin.MCAP, CompressionMode.FILE)
    description = tmp_path / "run.yaml"
    text = (
        f"name: run\ncell: {checkout / 'configs/cells/demo.yaml'}\n"
        "position: {file: bag, columns: [position], unit: rad, side: joint}\n"
        "current: {file: bag, columns: [effort], unit: A}\ntime: {file: bag, column: header.stamp, "
        "unit: ns}\n"
    )
    description.write_text(text)
    words = [
        "import",
        str(description),
        "--data",
        str(folder.parent),
        "--out",
        str(tmp_path / "log.mcap"),
    ]
    assert main(words) == 0
    (tmp_path / "log.mcap").unlink()
    full = tmp_path / "full"
    full.mkdir()
    (full / "bag").symlink_to("/dev/full")
    monkeypatch.setattr("daq.log.bag_file.TemporaryDirectory", lambda: nullcontext(str(full)))
    assert main(words) == ExitCode.UNEXPECTED
    error_output = capfd.readouterr().err
    said = " ".join(error_output.split())
    assert "no space left on device" in said
    assert "TMPDIR" in said
