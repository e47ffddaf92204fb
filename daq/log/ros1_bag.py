"""Read ROS 1 bags: the package `rosbags`, of the extra `ros1`,
walks through the file and makes CDR of its messages.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Generator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import lz4.frame

from daq.environment import require_packages
from daq.errors import LogCorrupt, LogMissing, reason_of
from daq.log.container import LARGEST_CHUNK
from daq.log.mcap_bag import BagMessage, Topic
from daq.log.message import JOINTS_SCHEMA

ROS_1_MAGIC = b"#ROSBAG V"
_DAMAGE = (
    AssertionError,
    EOFError,
    LookupError,
    ArithmeticError,
    RuntimeError,
    TypeError,
    ValueError,
    MemoryError,
)
"""What the library raises of a damaged file, besides its own errors and those of `struct`."""


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
            raise LogMissing(
                str(self.path),
                found=reason_of(error),
                expected="a ROS 1 bag",
                remedy="check the name",
            ) from error
        except (reading.ReaderError, serde.SerdeError, struct.error, *_DAMAGE) as error:
            raise self._broken(
                str(self.path), f"{error}" or type(error).__name__, "a ROS 1 bag"
            ) from error

    def corrupt(self, place: int, found: str, expected: str) -> LogCorrupt:
        """Make the error for a message."""
        return self._broken(f"{self.path}, message {place}", found, expected)

    def _broken(self, subject: str, found: str, expected: str) -> LogCorrupt:
        remedy = "copy it again from where it was recorded, or repair it: `rosbag reindex`"
        return LogCorrupt(subject, found=found, expected=expected, remedy=remedy)


def _topic_of(connection: Any) -> Topic:
    """Return the topic of a connection, with the node that published it."""
    node = str(connection.ext.callerid or "")
    return Topic(str(connection.topic), connection.msgtype == JOINTS_SCHEMA, node)


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
