"""Read joint states from ROS 2 bags as tables.

A column is `position.JOINT`, `velocity.JOINT` or `effort.JOINT`; the time column is `header.stamp`. Messages of one
stamp that hold different joints make one row, because several publishers may share a topic.
"""

from __future__ import annotations

from array import array
from contextlib import closing
from pathlib import Path

import numpy as np

from daq.config.import_description import Column, ImportDescription, TimeColumn, TimeUnit
from daq.errors import TableUnfit, counted
from daq.log.bag_file import open_bag
from daq.log.mcap_bag import JointState, joint_state_from_cdr, unpack_message
from daq.log.message import JOINTS_SCHEMA
from daq.log.table import LATEST_NS, Table, digest_of, require_finite, stamps_of_ns

STAMP = "header.stamp"  #: Name of the time column
FIELDS = ("position", "velocity", "effort")
PACKED = ".zstd"  #: Suffix of a file that is packed as a whole
PATTERNS = ("*.mcap", "*.db3", "*.mcap.zstd", "*.db3.zstd")  #: Files of a bag in its folder


def read_bag(path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None) -> Table:
    """Read columns of a bag, which is a file or a folder of several.

    Raises:
        LogUnreadable: a file is no bag, ends early or is damaged.
        TableUnfit: there are no joint states, or not those that the columns name.
    """
    if time is not None and (time.column != STAMP or time.unit is not TimeUnit.NANOSECOND):
        found = f"time column {time.column!r} in {time.unit.value}"
        raise _unfit(path, found, f"`column: {STAMP}` and `unit: ns`", "correct `time` in the import description")
    rows = _Rows(path, tuple(_field_and_joint(path, column) for column in columns))
    topics: dict[str, bool] = {}
    for file in _files(path):
        with open_bag(file) as bag, closing(bag.messages()) as messages:
            for message in messages:
                topic = message.topic
                chosen = topic.has_joint_states and wanted.topic in {None, topic.name}
                topics[topic.name] = chosen
                if chosen:
                    try:
                        rows.add(joint_state_from_cdr(unpack_message(message.data)), message.time_ns)
                    except ValueError as error:
                        raise bag.corrupt(message.place, f"{topic.name} with {error}", JOINTS_SCHEMA) from error
    used = [topic for topic, chosen in topics.items() if chosen]
    if not used:
        found = f"topics {', '.join(topics)}" if topics else "no message"
        raise _unfit(path, found, f"{wanted.topic or 'a topic'} of type {JOINTS_SCHEMA}", "is this the right bag?")
    if len(used) > 1:
        remedy = "choose one in the import description: `topic: NAME`"
        raise _unfit(path, f"joint states on {len(used)} topics, {', '.join(used)}", "one topic", remedy)
    return rows.table(columns, time)


def _files(path: Path) -> list[Path]:
    """Files of a bag in their order; `path` itself if it is no folder."""
    if not path.is_dir():
        return [path]
    files = [file for pattern in PATTERNS for file in path.glob(pattern)]
    # A player leaves what it has unpacked beside the packed file.
    unpacked = {file.with_name(file.name + PACKED) for file in files}
    once = [file for file in files if file not in unpacked]
    return sorted(once, key=_part)


def _part(file: Path) -> tuple[int, str]:
    """Key of the files of a bag, NAME_0 to NAME_10."""
    name = file.name.removesuffix(PACKED)
    return len(name), name


def _unfit(
    path: Path, found: str, expected: str, remedy: str = "correct `columns` in the import description"
) -> TableUnfit:
    return TableUnfit(str(path), found=found, expected=expected, remedy=remedy)


def _field_and_joint(path: Path, column: Column) -> tuple[str, str]:
    field, _, joint = str(column).partition(".")
    if field not in FIELDS or not joint:
        raise _unfit(path, f"column {column!r}", "position.JOINT, velocity.JOINT or effort.JOINT")
    return field, joint


SINCE_1970_NS = 10**18  #: Stamps from here on, 2001, are times of day; earlier ones are since some start
UNDECIDED = 1000  #: Messages with a stamp of 0 that wait for a later one, which says what 0 means


class _Rows:
    """Rows of joint states: a message begins one, or completes that of its stamp.

    A stamp of 0 is the first instant of a clock that starts at 0, as simulation time does, or the stamp that a
    publisher left out. The first other stamp of the bag tells the two apart.
    """

    def __init__(self, path: Path, columns: tuple[tuple[str, str], ...]) -> None:
        """Store the columns, each with field and joint."""
        self._path = path
        self._zero_is_a_time: bool | None = None  # None until a stamp has shown it
        self._undecided: list[tuple[JointState, int]] = []  # with the time of their recording
        self._columns = columns
        self._stamp_ns = array("q")
        self._values = array("d")
        self._present = bytearray()
        self._begun: dict[int, int] = {}  # incomplete rows by their stamp
        self._places: dict[tuple[str, ...], list[tuple[str, int, int]]] = {}  # field, index and column, by the names
        self._unstamped = 0

    def add(self, state: JointState, log_time_ns: int) -> None:
        """Add a message; one without a stamp is taken at the time of its recording.

        Raises:
            TableUnfit: it has fewer values than joints.
            ValueError: no log can hold the time of its recording.
        """
        if state.names not in self._places:
            if len(set(state.names)) < len(state.names):
                twice = next(name for name in state.names if state.names.count(name) > 1)
                raise _unfit(self._path, f"joint {twice} twice in one message", "each joint once", "mend its publisher")
            self._places[state.names] = [
                (field, state.names.index(joint), column)
                for column, (field, joint) in enumerate(self._columns)
                if joint in state.names
            ]
        if not self._places[state.names]:
            return  # joints of something else
        if self._zero_is_a_time is None:
            if state.stamp_ns == 0:
                _require_possible(log_time_ns)
                self._undecided.append((state, log_time_ns))
                if len(self._undecided) == UNDECIDED:
                    self._decide(zero_is_a_time=False)
                return
            self._decide(zero_is_a_time=state.stamp_ns < SINCE_1970_NS)
        self._take(state, log_time_ns)

    def _decide(self, *, zero_is_a_time: bool) -> None:
        """Fix the meaning of a stamp of 0, and take the messages that waited for it."""
        self._zero_is_a_time = zero_is_a_time
        waiting = self._undecided
        self._undecided = []
        for state, log_time_ns in waiting:
            self._take(state, log_time_ns)

    def _take(self, state: JointState, log_time_ns: int) -> None:
        """Begin or complete the row of a message."""
        places = self._places[state.names]
        width = len(self._columns)
        stamp_ns = state.stamp_ns
        if stamp_ns == 0 and not self._zero_is_a_time:
            self._unstamped += 1
            stamp_ns = log_time_ns
        _require_possible(stamp_ns)
        row = self._begun.get(stamp_ns)
        if row is None or any(self._present[row * width + column] for _, _, column in places):
            row = self._begun[stamp_ns] = len(self._stamp_ns)
            self._stamp_ns.append(stamp_ns)
            self._values.extend([0.0] * width)
            self._present.extend(bytes(width))
        for field, index, column in places:
            numbers: tuple[float, ...] = getattr(state, field)
            if index >= len(numbers):
                found = f"a message with {len(state.names)} names and {len(numbers)} values of {field}"
                raise _unfit(self._path, found, "one value a joint", "does this controller publish it?")
            self._values[row * width + column] = numbers[index]
            self._present[row * width + column] = 1
        if all(self._present[row * width : (row + 1) * width]):
            del self._begun[stamp_ns]

    def table(self, columns: tuple[Column, ...], time: TimeColumn | None) -> Table:
        """Return the complete rows.

        Raises:
            TableUnfit: a joint is missing in every row or between complete ones, or a number is not finite.
        """
        self._decide(zero_is_a_time=self._zero_is_a_time is True)
        width = len(self._columns)
        present = np.frombuffer(self._present, dtype=np.bool_).reshape(-1, width)
        joints = sorted({name for names in self._places for name in names})
        absent = [str(columns[number]) for number in np.flatnonzero(~present.any(axis=0))]
        if absent:
            raise _unfit(self._path, f"joints {', '.join(joints) or 'none'}", f"those of {', '.join(absent)}")
        whole = np.flatnonzero(present.all(axis=1))
        inside = slice(whole[0], whole[-1] + 1) if whole.size else slice(0, 1)
        if not whole.size or len(whole) < len(present[inside]):
            row = int(np.argmin(present[inside].all(axis=1))) + inside.start
            lacking = [str(columns[number]) for number in np.flatnonzero(~present[row])]
            raise _unfit(
                self._path,
                f"no {', '.join(lacking)} at {self._stamp_ns[row] * 1e-9:.9f} s",
                "all joints in messages of the same stamp",
                "messages are missing, or joints are stamped apart: record a topic that has all joints in each message",
            )
        remarks = []
        if len(whole) < len(present):
            left_out = counted(len(present) - len(whole), "stamp")
            remarks.append(f"left out, as joints are missing at the ends of the bag: {left_out}")
        if self._unstamped:
            unstamped = counted(self._unstamped, "message")
            remarks.append(f"{unstamped} without a stamp: the time of the recording is used")
        values = np.frombuffer(self._values).reshape(-1, width)[inside]
        clock = stamps_of_ns(self._stamp_ns[inside])
        stamps = None if time is None else clock
        table = Table(self._path, columns, values, digest_of(values, clock), stamps, remarks=tuple(remarks))
        return require_finite(table)


def _require_possible(time_ns: int) -> None:
    if time_ns >= LATEST_NS:
        raise ValueError(f"a time of {time_ns} ns")
