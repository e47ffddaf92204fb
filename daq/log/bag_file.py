"""Open a file of a bag: MCAP or SQLite of ROS 2, or one of ROS 1; each may be packed by zstd.

The file may be truncated, damaged or malicious: its size bounds what it is unpacked to, and what
it makes SQLite compute.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NoReturn

import zstandard

from daq.config.foreign_files import HEAD_BYTES
from daq.config.yaml_file import MAGIC_OF_LOGS
from daq.errors import (
    LogCorrupt,
    LogForeign,
    LogMissing,
    LogTruncated,
    OutputFailed,
    counted,
    reason_of,
)
from daq.files import open_regular
from daq.log.container import LARGEST_CHUNK, LARGEST_RATIO, LARGEST_RECORD, MAGIC
from daq.log.mcap_bag import ZSTD_MAGIC, BagMessage, McapBag, Topic
from daq.log.message import JOINTS_SCHEMA
from daq.log.ros1_bag import ROS_1_MAGIC, Ros1Bag, more_behind
from daq.log.table import kind_of_content

SQLITE_MAGIC = b"SQLite format 3\0"
#: Most instructions of SQLite for any file, and STEPS_A_BYTE more for each byte of it; reading a
#: message takes 20
STEPS = 10_000_000
STEPS_A_BYTE = 2
STEPS_A_COUNT = 1000  #: Instructions after which SQLite calls `_count_steps`
BYTES_A_TOPIC = 64  #: Least size of a topic in the file
PIECE_BYTES = 2**20  #: Unpacked at a time
PACKED_SUFFIXES = (".zstd", ".zst")  #: Of a file that is packed by zstd: ROS 2's, and zstd's own


class SqliteBag:
    """A bag in SQLite (.db3), which has no checksums:
    a flipped bit of a number passes, as in every reader of it.
    """

    def __init__(self, path: Path, source: Path) -> None:
        """Store the path, which errors name, and that of the content: another one if the file at
        the first is packed.
        """
        self.path = path
        self._source = source
        self._counts_left = 0  # calls of `_count_steps` before SQLite is stopped
        self._bytes_left = 0

    def messages(self) -> Generator[BagMessage, None, None]:
        """Yield the messages in the order of their recording.

        Raises:
            LogUnreadable: one of its kinds, with the row of the table where there is one.
        """
        # Only read, and without locks: no file is made next to it.
        uri = f"{self._source.absolute().as_uri()}?immutable=1"
        try:
            self._refuse_unfinished()
            with closing(sqlite3.connect(uri, uri=True)) as database:
                self._set_bounds(database)
                # Without this, SQLite would leave out the rows of broken pages without a word.
                (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
                if found != "ok":
                    raise self._broken(str(self.path), str(found))
                self._refuse_second_database(database)
                yield from self._messages(database)
        except OSError as error:
            raise LogMissing(
                str(self.path),
                found=reason_of(error),
                expected="a ROS 2 bag",
                remedy="check the name",
            ) from error
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise self._broken(str(self.path), str(error)) from error

    def corrupt(self, place: int, found: str, expected: str) -> LogCorrupt:
        """Make the error for a row of a table."""
        return self._broken(f"{self.path}, row {place}", found, expected)

    def _set_bounds(self, database: sqlite3.Connection) -> None:
        """Bound time and memory: a table of the file may be a view or have computed columns,
        and so any number of rows of any size.
        """
        with open_regular(self._source) as stream:
            size = os.fstat(stream.fileno()).st_size
        self._bytes_left = size
        steps = STEPS + STEPS_A_BYTE * size
        self._counts_left = steps // STEPS_A_COUNT
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_RECORD)
        database.set_progress_handler(self._count_steps, STEPS_A_COUNT)
        database.execute("PRAGMA trusted_schema = OFF")

    def _refuse_second_database(self, database: sqlite3.Connection) -> None:
        """Refuse a second database behind the pages of the first: SQLite would not read it."""
        (pages,) = database.execute("PRAGMA page_count").fetchone()
        (page_bytes,) = database.execute("PRAGMA page_size").fetchone()
        end = pages * page_bytes
        with open_regular(self._source) as stream:
            size = os.fstat(stream.fileno()).st_size
            stream.seek(end)
            is_another = stream.read(len(SQLITE_MAGIC)) == SQLITE_MAGIC
        if is_another:
            raise more_behind(self.path, end, size, is_bag=True)

    def _count_steps(self) -> bool:
        """Count STEPS_A_COUNT instructions more; SQLite stops where this returns True."""
        self._counts_left -= 1
        return self._counts_left < 0

    def _messages(self, database: sqlite3.Connection) -> Iterator[BagMessage]:
        topics = self._topics(database)
        query = "SELECT id, topic_id, timestamp, data FROM messages"
        for row, topic_id, time_ns, data in database.execute(query):
            topic = topics.get(topic_id)
            if topic is None or not isinstance(time_ns, int) or not isinstance(data, bytes):
                found = f"topic {topic_id}, time {time_ns!r:.40}"
                raise self.corrupt(row, found, "a topic, nanoseconds and bytes")
            self._count_bytes(row, len(data))
            yield BagMessage(row, topic, time_ns, data)

    def _topics(self, database: sqlite3.Connection) -> dict[int, Topic]:
        """Return the topics by their id."""
        topics: dict[int, Topic] = {}
        # A counter, as a file may have very many topics: a search of those before takes too long.
        channels = Counter[str]()
        query = "SELECT id, name, type, serialization_format FROM topics"
        for topic_id, stored_name, schema, encoding in database.execute(query):
            name = str(stored_name)
            self._count_bytes(topic_id, BYTES_A_TOPIC + len(name))
            has_joint_states = schema == JOINTS_SCHEMA and encoding == "cdr"
            channels[name] += 1
            topics[topic_id] = Topic(name, has_joint_states, channel=channels[name])
        return topics

    def _count_bytes(self, row: int, size: int) -> None:
        """Count the bytes of a row; refuse more than the file has, as a computed table may give."""
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise self.corrupt(row, "more bytes than the file has", "a recording")

    def _refuse_unfinished(self) -> None:
        """Refuse a file next to which SQLite has left its write-ahead log or rollback journal:
        the file would be read without the messages of the log, or with half of a change.
        """
        database = self.path
        unpack = ""
        # Of a packed file they have the name that it had before it was packed.
        if self._source != self.path and self.path.suffix in PACKED_SUFFIXES:
            database = self.path.with_suffix("")
            unpack = f" unpack the copy (`zstd -d {self.path.name} -o {database.name}`),"
        contents = {
            "-wal": "with messages that are not in the bag yet",
            "-journal": "which undoes a change that was not finished",
        }
        for suffix, content in contents.items():
            rest = database.with_name(f"{database.name}{suffix}")
            if rest.exists() and rest.stat().st_size > 0:
                raise LogTruncated(
                    str(self.path),
                    found=f"{rest.name}, {content}",
                    expected="a finished bag",
                    remedy=f"the recorder was killed: copy both,{unpack} and run `sqlite3 "
                    f"{database.name} 'PRAGMA quick_check'` there",
                )

    def _broken(
        self, subject: str, found: str, expected: str = "a ROS 2 bag in SQLite"
    ) -> LogCorrupt:
        remedy = (
            "copy it again from where it was recorded, or convert it: `ros2 bag convert` with "
            "storage_id mcap"
        )
        return LogCorrupt(subject, found=found, expected=expected, remedy=remedy)


@contextmanager
def open_bag(path: Path) -> Iterator[McapBag | SqliteBag | Ros1Bag]:
    """Open a file of a bag as the kind that its first bytes show.

    Damage behind these bytes is an error of the iteration over its messages.

    Raises:
        LogMissing: it cannot be opened, or a packed one cannot be read.
        LogTruncated: it ends within the first bytes of a bag.
        LogForeign: it is of another kind.
        LogCorrupt: it is empty; or it is packed, and the content is damaged, empty, or larger than
            that of a recording.
        OutputFailed: there is no folder or no room for the unpacked content.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise LogCorrupt(
            str(path),
            found="an empty file",
            expected="a recording",
            remedy="copy it again from where it was recorded, or record again",
        )
    if not first_bytes(path).startswith(ZSTD_MAGIC):
        yield _bag(path, path)
        return
    try:
        temporary = TemporaryDirectory()
    except OSError as error:
        raise _no_room("folder for temporary files", error, path) from error
    with temporary as folder:
        source = Path(folder) / "bag"
        _unpack_file(path, source)
        if source.stat().st_size == 0:
            raise _not_unpacked(path, "a file that unfolds to nothing: it was cut")
        yield _bag(path, source)


def _bag(path: Path, source: Path) -> McapBag | SqliteBag | Ros1Bag:
    """Return the bag with the content of `source`; errors name `path`."""
    head = first_bytes(source)
    if head.startswith(SQLITE_MAGIC):
        return SqliteBag(path, source)
    if head.startswith(ROS_1_MAGIC):
        return Ros1Bag(path, source)
    if not head.startswith(MAGIC_OF_LOGS):
        _refuse_other_kind(path, source, head)
    return McapBag(path, source)


def _refuse_other_kind(path: Path, source: Path, head: bytes) -> NoReturn:
    """Refuse a file without the first bytes of a bag.

    Raises:
        LogMissing: it cannot be opened.
        LogTruncated: it ends within these bytes.
        LogForeign: it is of another kind.
    """
    expected = "a ROS bag: MCAP or SQLite of ROS 2, or one of ROS 1"
    try:
        with open_regular(source):
            pass
    except OSError as error:
        raise LogMissing(
            str(path),
            found=reason_of(error),
            expected=expected,
            remedy="check --data and the file name in the import description",
        ) from error
    magics = (MAGIC, SQLITE_MAGIC, ROS_1_MAGIC)
    if head and any(magic.startswith(head) for magic in magics):
        size = counted(len(head), "byte")
        raise LogTruncated(
            str(path),
            found=f"{size} with which a bag begins",
            expected="a recording",
            remedy="copy it again from where it was recorded, or record again",
        )
    found, remedy = kind_of_content(head)
    raise LogForeign(str(path), found=found, expected=expected, remedy=remedy)


def first_bytes(path: Path) -> bytes:
    """Return the first bytes of a file, by which its kind is known.

    There are none where it cannot be read; opening it reports that.
    """
    with suppress(OSError), open_regular(path) as stream:
        return stream.read(HEAD_BYTES)
    return b""


def _unpack_file(path: Path, target: Path) -> None:
    """Unpack a file; see `open_bag` for the errors."""
    try:
        with target.open("wb") as stream:
            for piece in _unpacked_pieces(path):
                stream.write(piece)
    except OSError as error:
        raise _no_room(str(target), error, path) from error


def _no_room(subject: str, error: OSError, path: Path) -> OutputFailed:
    return OutputFailed(
        subject,
        found=reason_of(error),
        expected=f"room for what {path.name} unfolds to",
        remedy="free space, or name another folder in the environment variable TMPDIR",
    )


def _unpacked_pieces(path: Path) -> Iterator[bytes]:
    """Yield the unpacked content of a file.

    Raises:
        LogMissing: it cannot be read.
        LogCorrupt: it is damaged, or its content is larger than that of a recording.
    """
    try:
        with open_regular(path) as packed:
            packed_bytes = os.fstat(packed.fileno()).st_size
            bytes_left = LARGEST_CHUNK + LARGEST_RATIO * packed_bytes
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while piece := reader.read(PIECE_BYTES):
                bytes_left -= len(piece)
                if bytes_left < 0:
                    found = f"a file that unfolds to more than {LARGEST_RATIO} times its size"
                    raise _not_unpacked(path, found)
                yield piece
    except zstandard.ZstdError as error:
        raise _not_unpacked(path, str(error)) from error
    except OSError as error:
        raise LogMissing(
            str(path),
            found=reason_of(error),
            expected="a recording, packed by zstd",
            remedy="copy it again from where it was recorded",
        ) from error


def _not_unpacked(path: Path, found: str) -> LogCorrupt:
    return LogCorrupt(
        str(path),
        found=found,
        expected="a recording, packed by zstd",
        remedy="copy it again from where it was recorded",
    )
