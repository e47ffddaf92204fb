"""Read ROS 1 bags: the package `rosbags`, of the extra `ros1`,
walks through the file and makes CDR of its messages.
"""

from __future__ import annotations

import bz2
import errno
import os
import struct
from collections.abc import Callable, Generator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame

from daq.environment import require_packages
from daq.errors import LogCorrupt, LogMissing, counted, reason_of
from daq.files import open_regular
from daq.log.container import LARGEST_CHUNK
from daq.log.mcap_bag import BagMessage, Topic
from daq.log.message import JOINTS_SCHEMA

ROS_1_MAGIC = b"#ROSBAG V"
ROS_1_VERSION = b"#ROSBAG V2.0"  #: First line of a bag that is read
_DAMAGE = (
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    ArithmeticError,
    RuntimeError,
    TypeError,
    ValueError,
    MemoryError,
)
"""What the library raises of a damaged file, besides its own errors and those of `struct`."""
_DAMAGED_PLACE = {None, errno.EINVAL, errno.EOVERFLOW}
"""Numbers of an OSError that says nothing of the file system: that of bz2 has none, and the others
refuse a place in the file that no file has.
"""


class Ros1Bag:
    """A bag of ROS 1 (.bag), which names the node that published each message."""

    def __init__(self, path: Path, source: Path) -> None:
        """Store the path and where the content is."""
        self.path = path
        self._source = source

    def messages(self) -> Generator[BagMessage, None, None]:
        """Yield the messages in the order of their recording.

        Raises:
            ConfigurationMissing: the package is not installed.
            LogUnreadable: one of its kinds.
        """
        require_packages(str(self.path), "the reader of ROS 1 bags", "ros1", "rosbags")
        reading: Any = import_module("rosbags.rosbag1")
        types: Any = import_module("rosbags.typesys")
        serde: Any = import_module("rosbags.serde")
        try:
            self._refuse_more_behind(reading.reader.Header)
            # The header of ROS 1 has a number more; the types of ROS 2 are those of the CDR.
            store = types.get_typestore(types.Stores.ROS2_HUMBLE)
            with reading.Reader(self._source) as bag:
                _bound(bag.chunks)
                topics = {one.id: _topic_of(one) for one in bag.connections}
                for number, (connection, time_ns, data) in enumerate(bag.messages(), start=1):
                    topic = topics[connection.id]
                    content = b""
                    if topic.has_joint_states:
                        content = bytes(store.ros1_to_cdr(data, JOINTS_SCHEMA))
                    yield BagMessage(number, topic, time_ns, content)
        except OSError as error:
            if error.errno in _DAMAGED_PLACE:
                raise self._damaged(error) from error
            raise LogMissing(
                str(self.path),
                found=reason_of(error),
                expected="a ROS 1 bag",
                remedy="check the name",
            ) from error
        except reading.ReaderError as error:
            raise self._broken(str(self.path), str(error), "a ROS 1 bag") from error
        except (serde.SerdeError, struct.error, *_DAMAGE) as error:
            raise self._damaged(error) from error

    def corrupt(self, place: int, found: str, expected: str) -> LogCorrupt:
        """Make the error for a message."""
        return self._broken(f"{self.path}, message {place}", found, expected)

    def _refuse_more_behind(self, header: Any) -> None:
        """Refuse bytes behind the index, with which a bag ends: no reader would look at them.

        Args:
            header: class of the library that reads the fields of a record.

        Raises:
            LogCorrupt: there are such bytes, as of two bags that were joined into one file.
        """
        with open_regular(self._source) as stream:
            size = os.fstat(stream.fileno()).st_size
            if stream.readline().strip() != ROS_1_VERSION:
                return  # the library names its version
            fields = header.read(stream)
            index_at = fields.get_uint64("index_pos")
            if index_at == 0:
                return  # its recorder was killed: the library says so
            records = fields.get_uint32("conn_count") + fields.get_uint32("chunk_count")
            stream.seek(index_at)
            for _ in range(records):
                if not _skip_record(stream):
                    return  # the library names the damage
            end = stream.tell()
            if end >= size:
                return
            is_bag = stream.read(len(ROS_1_MAGIC)) == ROS_1_MAGIC
        raise more_behind(self.path, end, size, is_bag=is_bag)

    def _damaged(self, error: Exception) -> LogCorrupt:
        """Make the error for bytes at which the library fails."""
        found = "damaged bytes"
        if type(error) is ValueError:
            found += f", {error}"
        return self._broken(str(self.path), found, "a ROS 1 bag")

    def _broken(self, subject: str, found: str, expected: str) -> LogCorrupt:
        remedy = "copy it again from where it was recorded, or repair it: `rosbag reindex`"
        return LogCorrupt(subject, found=found, expected=expected, remedy=remedy)


def more_behind(path: Path, end: int, size: int, *, is_bag: bool) -> LogCorrupt:
    """Make the error for a file that goes on behind the end of its bag.

    Args:
        path: of the file.
        end: bytes of the bag.
        size: bytes of the file.
        is_bag: another bag begins there.
    """
    behind = counted(size - end, "byte")
    found = f"{behind} behind its end"
    if is_bag:
        found += ", which begin as another bag does"
    return LogCorrupt(
        str(path),
        found=found,
        expected="one bag",
        remedy="files joined by `cat` are no bag: give each recording by itself; the first one "
        f"alone is `head -c {end}` of the file",
    )


def _topic_of(connection: Any) -> Topic:
    """Return the topic of a connection, with the node that published it."""
    node = str(connection.ext.callerid or "")
    return Topic(str(connection.topic), connection.msgtype == JOINTS_SCHEMA, node)


def _skip_record(stream: BinaryIO) -> bool:
    """Go to the end of a record, which is a header and data; False where the file ends before."""
    for _ in range(2):
        length = stream.read(4)
        if len(length) < 4:
            return False
        stream.seek(int.from_bytes(length, "little"), os.SEEK_CUR)
    return True


def _bound(chunks: dict[int, Any]) -> None:
    """Bound what a chunk unfolds to; the library unfolds all of it."""
    for position, chunk in chunks.items():
        name = getattr(chunk.decompressor, "__module__", "")
        if name == "bz2":
            chunks[position] = chunk._replace(
                decompressor=partial(unpack_chunk, bz2.BZ2Decompressor)
            )
        elif name.startswith("lz4"):
            chunks[position] = chunk._replace(
                decompressor=partial(unpack_chunk, lz4.frame.LZ4FrameDecompressor)
            )


def unpack_chunk(kind: Callable[[], Any], data: bytes) -> bytes:
    """Return what a chunk unfolds to.

    Raises:
        ValueError: it is more than a chunk has, or ends early.
    """
    unpack = kind()
    content: bytes = unpack.decompress(data, LARGEST_CHUNK)
    if not unpack.eof:
        raise ValueError(
            f"a chunk of {len(data)} bytes that ends early, or unfolds to more than {LARGEST_CHUNK}"
        )
    return content
