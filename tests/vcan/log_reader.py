"""Samples of a log by the `mcap` package and the layout of its schema,
without any code of the product.

A message of /cell/samples is `drivegain_msgs/msg/AxisSamples` in CDR: four bytes of encapsulation,
then the fields in order, each aligned to its own size from behind the encapsulation. The definition
is in the log itself.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

SAMPLES_TOPIC = "/cell/samples"
RUN = "drivegain.run"
STATISTICS = "drivegain.statistics"
ENCAPSULATION_BYTES = 4
UNFINISHED = ".part"


@dataclass(frozen=True, eq=False)
class Recorded:
    """Samples of a log as arrays.

    Attributes:
        started_ns: wall time of the start of the run [ns since 1970].
        valid: the recorder's verdict; None where it did not come to one.
        reason: why it is not valid.
    """

    cycle: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    values: NDArray[np.int64]  #: position, current, statusword of each axis, shape (k, n, 3)
    missing: NDArray[np.int64]
    started_ns: int
    valid: bool | None
    reason: str = ""


@dataclass(frozen=True)
class _Sample:
    cycle: int
    time_ns: int
    values: list[tuple[int, int, int]]
    missing: int


def read_recorded(path: Path) -> Recorded | None:
    """Return the samples of a finished or unfinished log; None for one without samples.

    Raises:
        McapError: a log with its final name is damaged.
    """
    topics: dict[int, str] = {}
    samples: list[_Sample] = []
    metadata: dict[str, dict[str, str]] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        elif isinstance(record, Message) and topics.get(record.channel_id) == SAMPLES_TOPIC:
            samples.append(_sample(record.data))
    if not samples:
        return None
    verdict = metadata.get(STATISTICS)
    valid = None
    reason = ""
    if verdict is not None:
        reason = verdict["reason"]
        valid = bool(json.loads(verdict["valid"]))
    return Recorded(
        np.array([one.cycle for one in samples], dtype=np.int64),
        np.array([one.time_ns for one in samples], dtype=np.int64),
        np.array([one.values for one in samples], dtype=np.int64),
        np.array([one.missing for one in samples], dtype=np.int64),
        int(metadata[RUN]["started_wall_ns"]),
        valid,
        reason,
    )


def _records(path: Path) -> Iterator[McapRecord]:
    """Yield the records, of an unfinished log those before its end."""
    with path.open("rb") as stream:
        try:
            yield from StreamReader(stream, validate_crcs=True).records
        except (McapError, struct.error, EOFError):
            if not path.name.endswith(UNFINISHED):
                raise


def _sample(data: bytes) -> _Sample:
    fields = _Fields(data[ENCAPSULATION_BYTES:])
    (cycle,) = fields.take("Q", 1)
    (seconds,) = fields.take("i", 1)
    (nanoseconds,) = fields.take("I", 1)
    positions = fields.sequence("i")
    currents = fields.sequence("i")
    statuswords = fields.sequence("H")
    (missing,) = fields.take("I", 1)
    values = list(zip(positions, currents, statuswords, strict=True))
    return _Sample(cycle, 1_000_000_000 * seconds + nanoseconds, values, missing)


class _Fields:
    """Fields of a CDR message in their order."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, code: str, count: int) -> tuple[int, ...]:
        """Return numbers of one type, the first of them aligned to its size."""
        size = struct.calcsize(f"<{code}")
        self._at += -self._at % size
        found: tuple[int, ...] = struct.unpack_from(f"<{count}{code}", self._data, self._at)
        self._at += count * size
        return found

    def sequence(self, code: str) -> tuple[int, ...]:
        """Return a sequence: its length, then its elements."""
        (count,) = self.take("I", 1)
        return self.take(code, count)
