"""Read joint states from ROS bags as tables.

A column is `position.JOINT`, `velocity.JOINT` or `effort.JOINT`; the time column is `header.stamp`.
Messages of one stamp that hold different joints make one row, because several publishers may share
a topic. Several that publish the same joints differ in node, channel, frame, joints, fields or the
rhythm of their stamps, and the import description chooses one of them. Columns of different topics
or publishers, as positions and efforts, are joined by their stamps.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.import_description import Column, ImportDescription, KeptPart, TimeColumn, TimeUnit
from daq.errors import TableUnfit, counted, on_one_line
from daq.files import read_regular
from daq.log.bag_file import open_bag
from daq.log.mcap_bag import JointState, Topic, joint_state_from_cdr, unpack_message
from daq.log.message import JOINTS_SCHEMA
from daq.log.table import (
    LATEST_NS,
    Table,
    digest_of,
    require_finite,
    require_kept,
    rows_in_time,
    stamps_of_ns,
)
from ident.arrays import BoolArray, FloatArray, IntArray

STAMP = "header.stamp"  #: Name of the time column
FIELDS = ("position", "velocity", "effort")
PACKED = ".zstd"  #: Suffix of a file that is packed as a whole
METADATA = "metadata.yaml"  #: Of a bag in its folder
LARGEST_METADATA = 64 * 2**20
#: Files of a bag in its folder
PATTERNS = ("*.mcap", "*.db3", "*.bag", "*.mcap.zstd", "*.db3.zstd", "*.bag.zstd")


def read_bag(
    path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None
) -> Table:
    """Read columns of a bag, which is a file or a folder of several.

    Raises:
        LogUnreadable: a file is no bag, ends early or is damaged.
        TableUnfit: there are no joint states, or not those that the columns name.
    """
    if time is not None and (time.column != STAMP or time.unit is not TimeUnit.NANOSECOND):
        found = f"time column {time.column!r} in {time.unit.value}"
        raise _unfit(
            path,
            found,
            f"`column: {STAMP}` and `unit: ns`",
            "correct `time` in the import description",
        )
    if not columns:
        raise _unfit(
            path,
            "the time column alone",
            "`position` or `current` in the bag that has the stamps",
            "correct `time`: name the file of `position` and `current`, or state `rate_hz` in its "
            "place; rows of other files have no stamps in a bag",
        )
    sources = _sources(path, wanted, columns)
    rows: dict[_ColumnSource, _Rows] = {}
    for source, own in sources.items():
        fields_and_joints = tuple(_field_and_joint(path, column) for column in own)
        rows[source] = _Rows(path, fields_and_joints, source.publisher, wanted.rhythm)
    topics: dict[str, bool] = {}
    for file in _files(path):
        with open_bag(file) as bag, closing(bag.messages()) as messages:
            for message in messages:
                topic = message.topic
                reading = [rows[source] for source in sources if source.reads(topic)]
                has_been = topics.get(topic.name, False)
                topics[topic.name] = has_been or topic.has_joint_states
                if reading:
                    try:
                        state = joint_state_from_cdr(unpack_message(message.data))
                        for one in reading:
                            one.add(state, message.time_ns, topic)
                    except ValueError as error:
                        raise bag.corrupt(
                            message.place, f"{topic.name} with {error}", JOINTS_SCHEMA
                        ) from error
    for source in sources:
        _require_one_topic(path, source, topics)
    if len(rows) == 1:
        (only,) = rows.values()
        return only.table(columns, time, wanted.keep)
    parts = {source: rows[source].table(own, STAMPED, None) for source, own in sources.items()}
    return _joined(path, parts, columns, time, wanted.keep)


STAMPED = TimeColumn(file="", column=STAMP, unit=TimeUnit.NANOSECOND)
"""Stands for the time column: tables that are joined need their stamps."""


@dataclass(frozen=True, slots=True)
class _ColumnSource:
    """Where columns are published."""

    topic: str | None  #: None: the only topic of joint states
    publisher: int | None  #: its number on that topic; None: the only one

    def reads(self, topic: Topic) -> bool:
        """Whether messages of a topic are read."""
        return topic.has_joint_states and self.topic in {None, topic.name}

    def __str__(self) -> str:
        topic = self.topic or "the topic"
        if self.publisher is None:
            return topic
        return f"{topic} (publisher {self.publisher})"


def _sources(
    path: Path, wanted: ImportDescription, columns: tuple[Column, ...]
) -> dict[_ColumnSource, tuple[Column, ...]]:
    """Return the columns of each source, in their order.

    Raises:
        TableUnfit: two sections have one column from different sources.
    """
    usual = _ColumnSource(wanted.topic, wanted.publisher)
    source_of: dict[Column, _ColumnSource] = {}
    for section in wanted.published():
        topic = section.topic or usual.topic
        publisher = section.publisher or usual.publisher
        own = _ColumnSource(topic, publisher)
        for file, column in section.places:
            parts = Path(file).parts
            if parts != path.parts[-len(parts) :]:
                continue
            if source_of.setdefault(column, own) != own:
                found = f"column {column!r} from {source_of[column]} and from {own}"
                raise _unfit(
                    path,
                    found,
                    "one source of each column",
                    "correct `topic` and `publisher` of its sections",
                )
    found_columns: dict[_ColumnSource, list[Column]] = {}
    for column in columns:
        found_columns.setdefault(source_of.get(column, usual), []).append(column)
    return {source: tuple(own) for source, own in found_columns.items()}


def _require_one_topic(path: Path, source: _ColumnSource, topics: dict[str, bool]) -> None:
    """Refuse a bag without the topic of a source, or with several that it may be.

    Args:
        path: of the bag.
        source: whose topic is sought.
        topics: those of the bag, and whether they have joint states.
    """
    of_joints = [topic for topic, has_joints in topics.items() if has_joints]
    used = [topic for topic in of_joints if source.topic in {None, topic}]
    if not used:
        found = "no message"
        remedy = "is this the right bag?"
        if topics:
            listed = ", ".join(map(on_one_line, topics))
            found = f"topics {listed}"
        if of_joints and source.topic is not None:
            listed = ", ".join(map(on_one_line, of_joints))
            remedy = f"correct `topic` in the import description; joint states are on {listed}"
        sought = source.topic or "a topic"
        expected = f"{sought} of type {JOINTS_SCHEMA}"
        raise _unfit(path, found, expected, remedy)
    if len(used) > 1:
        remedy = (
            "choose one in the import description: `topic: NAME`; where positions and efforts are "
            "on different ones, `topic` under `position` and `current`"
        )
        listed = ", ".join(map(on_one_line, used))
        found = f"joint states on {len(used)} topics, {listed}"
        raise _unfit(path, found, "one topic", remedy)


def _joined(
    path: Path,
    parts: dict[_ColumnSource, Table],
    columns: tuple[Column, ...],
    time: TimeColumn | None,
    keep: KeptPart | None,
) -> Table:
    """Join columns of several sources by their stamps, which must be the same but for the ends.

    Raises:
        TableUnfit: stamps differ: nothing is interpolated between messages.
    """
    stamps_ns = {source: _exact_ns(table) for source, table in parts.items()}
    first_ns = max(int(stamps[0]) for stamps in stamps_ns.values())
    last_ns = min(int(stamps[-1]) for stamps in stamps_ns.values())
    reference, *others = parts
    values: dict[Column, FloatArray] = {}
    shared_ns = _between(stamps_ns[reference], first_ns, last_ns)
    for source in others:
        own_ns = _between(stamps_ns[source], first_ns, last_ns)
        if not len(shared_ns) or not np.array_equal(own_ns, shared_ns):
            raise _not_joined(path, {one: stamps_ns[one] for one in (reference, source)})
    remarks: list[str] = []
    for source, table in parts.items():
        is_shared = _is_between(stamps_ns[source], first_ns, last_ns)
        for column in table.columns:
            values[column] = table.take((column,))[is_shared]
        remarks += table.remarks
        left_out = int(np.count_nonzero(~is_shared))
        if left_out:
            remarks.append(
                "left out, as other columns have none there: "
                f"{counted(left_out, 'stamp')} of {source}"
            )
    clock = stamps_of_ns(shared_ns.tolist())
    rows = slice(None)
    if keep is not None:
        if keep.is_by_time:
            rows = rows_in_time(clock, keep)
        else:
            rows = keep.rows
        require_kept(path, len(shared_ns), rows)
    first_row, _, _ = rows.indices(len(shared_ns))
    all_values = np.hstack([values[column] for column in columns])
    kept = all_values[rows]
    clock = stamps_of_ns(shared_ns[rows].tolist())
    return Table(
        path=path,
        columns=columns,
        values=kept,
        digest=digest_of(kept, clock),
        stamps=None if time is None else clock,
        first_row=first_row,
        remarks=tuple(remarks),
    )


def _exact_ns(table: Table) -> IntArray:
    """Return the stamps of a table in nanoseconds, shape (k,)."""
    stamps = table.stamps
    if stamps is None:
        raise ValueError("a table without stamps")
    since_first_ns = np.rint(1e9 * stamps.time_s)
    return since_first_ns.astype(np.int64) + stamps.first_ns


def _is_between(stamps_ns: IntArray, first_ns: int, last_ns: int) -> BoolArray:
    return np.asarray((stamps_ns >= first_ns) & (stamps_ns <= last_ns))


def _between(stamps_ns: IntArray, first_ns: int, last_ns: int) -> IntArray:
    return stamps_ns[_is_between(stamps_ns, first_ns, last_ns)]


def _not_joined(path: Path, stamps_ns: dict[_ColumnSource, IntArray]) -> TableUnfit:
    """Make the error for two sources without the same stamps."""
    described = []
    for source, own_ns in stamps_ns.items():
        step_s = 0.0
        if len(own_ns) > 1:
            step_s = 1e-9 * float(np.median(np.diff(own_ns)))
        stamps = counted(len(own_ns), "stamp")
        described.append(f"{stamps} each {step_s:.6g} s on {source}")
    first, second = stamps_ns.values()
    common = len(np.intersect1d(first, second))
    both = " and ".join(described)
    return _unfit(
        path,
        f"{both}, {common} of them the same",
        "messages of the same stamps",
        "nothing is interpolated between messages: record them with one stamp, or write each field "
        "to a CSV file with rows of the same instants, and name the files by `file` of `position` "
        "and `current`",
    )


def _files(path: Path) -> list[Path]:
    """Files of a bag in their order; `path` itself if it is no folder."""
    if not path.is_dir():
        return [path]
    files: list[Path] = []
    for pattern in PATTERNS:
        files += path.glob(pattern)
    # A player leaves what it has unpacked next to the packed file.
    unpacked = {file.with_name(file.name + PACKED) for file in files}
    once = [file for file in files if file not in unpacked]
    _require_parts(path, once)
    return sorted(once, key=_part)


def _require_parts(folder: Path, files: list[Path]) -> None:
    """Refuse a folder that lacks a file which the recorder names:
    without it, the recording would end early.

    Raises:
        TableUnfit: a file is not there.
    """
    there = {file.name.removesuffix(PACKED) for file in files}
    named = _named_parts(folder / METADATA)
    missing = []
    for name in named:
        file_name = Path(name).name
        if file_name.removesuffix(PACKED) not in there:
            missing.append(name)
    # A person may have renamed a file.
    if missing and 0 < len(files) < len(named):
        listed = ", ".join(missing)
        files_named = counted(len(named), "file")
        raise TableUnfit(
            str(folder),
            found=f"no {listed}, which {METADATA} names",
            expected=f"all {files_named} of the bag",
            remedy="copy the folder again; if the file was removed on purpose, take its name out "
            f"of {METADATA}",
        )


def _named_parts(metadata: Path) -> list[str]:
    """Return the files of a bag by its metadata, none if there are none;
    the rest of it is not read.

    It may hold megabytes of quality of service, which no reader of YAML bounds.
    """
    try:
        text = read_regular(metadata, LARGEST_METADATA).decode("utf-8", errors="replace")
    except OSError:
        return []  # a recorder that is killed leaves none
    found = []
    lines = iter(text.splitlines())
    for line in lines:
        if line.strip() == "relative_file_paths:":
            break
    for line in lines:
        item = line.strip()
        if not item.startswith("- "):
            break
        found.append(item.removeprefix("- ").strip().strip("'\""))
    return found


def _part(file: Path) -> tuple[int, str]:
    """Key of the files of a bag, NAME_0 to NAME_10."""
    name = file.name.removesuffix(PACKED)
    return len(name), name


def _unfit(
    path: Path,
    found: str,
    expected: str,
    remedy: str = "correct `columns` in the import description",
) -> TableUnfit:
    return TableUnfit(str(path), found=found, expected=expected, remedy=remedy)


def _field_and_joint(path: Path, column: Column) -> tuple[str, str]:
    field, _, joint = str(column).partition(".")
    if field not in FIELDS or not joint:
        raise _unfit(path, f"column {column!r}", "position.JOINT, velocity.JOINT or effort.JOINT")
    return field, joint


@dataclass(slots=True)
class _Publisher:
    """Messages that one node may have published:
    they have one frame, one set of joints and the same fields.
    """

    number: int  #: from 1, in the order of their first messages
    node: str  #: its name, where the bag has it
    frame: str | None  #: None where the header is empty
    joints: frozenset[str]
    fields: tuple[str, ...]  #: with values
    channel: int  #: among those of the topic
    first_ns: int  #: time of the recording of its first message
    last_ns: int  #: and of its last
    messages: int = 0

    def may_be(self, other: _Publisher) -> bool:
        """Whether one node may be both: it leaves out the header of some messages,
        or has channels after each other.
        """
        if self.node != other.node:
            return False
        if self.fields != other.fields:
            return False
        if self.channel != other.channel:
            is_apart = self.last_ns < other.first_ns or other.last_ns < self.first_ns
            return is_apart and self.frame == other.frame
        return self.frame is None or other.frame is None

    def __str__(self) -> str:
        fields = " and ".join(self.fields) or "no values"
        if self.frame is None:
            frame = "without a header"
        else:
            frame = f"frame {self.frame!r}"
        joints = ", ".join(map(on_one_line, sorted(self.joints)))
        node = ""
        if self.node:
            node = f"{on_one_line(self.node)}, "
        if self.channel > 1:
            node += f"channel {self.channel}, "
        messages = counted(self.messages, "message")
        return f"{self.number}: {node}{fields} of {joints}, {frame}, {messages}"


SEPARATE = (
    "no message has all fields: where those of one instant have one stamp, choose the publisher of "
    "each section, as in `position: {{..., publisher: {position}}}` and `current: {{..., "
    "publisher: {effort}}}`; else write each field to a CSV file, with rows of the same instants, "
    "and name the files by `file` of `position` and `current`"
)
FEWEST_OF_A_PUBLISHER = 10  #: Messages by which its rhythm is known
#: Largest difference of a step from the usual one in an even row of stamps, as a share of it
EVEN_SHARE = 0.05
#: Offset of a second row, as a share of the step, above which it may be every other stamp of one
CENTRED_SHARE = 0.35
MOSTLY = 0.95  #: Share of the steps that are even in such a row
#: Stamps from here on, 2001, are times of day; earlier ones are since some start
SINCE_1970_NS = 10**18
UNDECIDED = 1000  #: Messages with a stamp of 0 that wait for a later one, which says what 0 means


class _Rows:
    """Rows of joint states: a message begins one, or completes that of its stamp.

    A stamp of 0 is the first instant of a clock that starts at 0, as simulation time does, or the
    stamp that a publisher left out. The first other stamp of the bag tells the two apart.
    """

    def __init__(
        self,
        path: Path,
        columns: tuple[tuple[str, str], ...],
        publisher: int | None,
        rhythm: int | None,
    ) -> None:
        """Store the columns, each with field and joint, and what is chosen:
        a publisher, and a row of even stamps.
        """
        self._path = path
        self._chosen = publisher
        self._rhythm = rhythm
        self._publishers: dict[
            tuple[str, int, str | None, frozenset[str], tuple[str, ...]], _Publisher
        ] = {}
        self._zero_is_a_time: bool | None = None  # None until a stamp has shown it
        self._undecided: list[tuple[JointState, int]] = []  # with the time of their recording
        self._columns = columns
        self._stamp_ns = array("q")
        self._values = array("d")
        self._present = bytearray()
        self._begun: dict[int, int] = {}  # incomplete rows by their stamp
        # Field, index and column, by the names
        self._places: dict[tuple[str, ...], list[tuple[str, int, int]]] = {}
        self._unstamped = 0

    def add(self, state: JointState, log_time_ns: int, topic: Topic) -> None:
        """Add a message; one without a stamp is taken at the time of its recording.

        Raises:
            TableUnfit: it has fewer values than joints.
            ValueError: no log can hold the time of its recording.
        """
        if state.names not in self._places:
            if len(set(state.names)) < len(state.names):
                twice = next(name for name in state.names if state.names.count(name) > 1)
                raise _unfit(
                    self._path,
                    f"joint {on_one_line(twice)} twice in one message",
                    "each joint once",
                    "mend its publisher",
                )
            places = []
            for column, (field, joint) in enumerate(self._columns):
                if joint in state.names:
                    places.append((field, state.names.index(joint), column))
            self._places[state.names] = places
        if not self._places[state.names]:
            return  # joints of something else
        publisher = self._publisher_of(state, log_time_ns, topic)
        publisher.messages += 1
        publisher.last_ns = max(publisher.last_ns, log_time_ns)
        if self._chosen not in {None, publisher.number}:
            return
        if self._zero_is_a_time is None:
            if state.stamp_ns == 0:
                _require_possible(log_time_ns)
                self._undecided.append((state, log_time_ns))
                if len(self._undecided) == UNDECIDED:
                    self._decide(zero_is_a_time=False)
                return
            self._decide(zero_is_a_time=state.stamp_ns < SINCE_1970_NS)
        self._take(state, log_time_ns)

    def _publisher_of(self, state: JointState, log_time_ns: int, topic: Topic) -> _Publisher:
        fields = tuple(field for field in FIELDS if getattr(state, field))
        joints = frozenset(state.names)
        if not state.frame and state.stamp_ns == 0:
            frame = None
        else:
            frame = state.frame
        key = (topic.publisher, topic.channel, frame, joints, fields)
        if key not in self._publishers:
            self._publishers[key] = _Publisher(
                number=len(self._publishers) + 1,
                node=topic.publisher,
                frame=frame,
                joints=joints,
                fields=fields,
                channel=topic.channel,
                first_ns=log_time_ns,
                last_ns=log_time_ns,
            )
        return self._publishers[key]

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
        if any(not getattr(state, field) for field, _, _ in places):
            return  # `_require_one_publisher` says so
        width = len(self._columns)
        stamp_ns = state.stamp_ns
        if stamp_ns == 0 and not self._zero_is_a_time:
            self._unstamped += 1
            stamp_ns = log_time_ns
        _require_possible(stamp_ns)
        row = self._begun.get(stamp_ns)
        if row is None or self._has_value(row, places):
            row = self._begun[stamp_ns] = len(self._stamp_ns)
            self._stamp_ns.append(stamp_ns)
            self._values.extend([0.0] * width)
            self._present.extend(bytes(width))
        for field, index, column in places:
            numbers: tuple[float, ...] = getattr(state, field)
            if index >= len(numbers):
                names = counted(len(state.names), "name")
                values = counted(len(numbers), "value")
                found = f"a message with {names} and {values}"
                raise _unfit(
                    self._path,
                    f"{found} of {field}",
                    "one value a joint",
                    "does this controller publish it?",
                )
            self._values[row * width + column] = numbers[index]
            self._present[row * width + column] = 1
        end = (row + 1) * width
        if all(self._present[row * width : end]):
            del self._begun[stamp_ns]

    def _has_value(self, row: int, places: list[tuple[str, int, int]]) -> bool:
        """Whether a row has a value of these places already."""
        start = row * len(self._columns)
        return any(self._present[start + column] for _, _, column in places)

    def _require_one_publisher(self) -> None:
        """Refuse joints that several nodes publish, and fields that no node publishes.

        Raises:
            TableUnfit: several publish the same joints, the chosen one is not there, or a field has
                no values.
        """
        known = list(self._publishers.values())
        if self._chosen is not None:
            if self._chosen > len(known):
                listed = "; ".join(map(str, known)) or "none"
                raise _unfit(
                    self._path,
                    f"publisher {self._chosen}, and those of the topic are {listed}",
                    "the number of one of them",
                    "correct `publisher` in the import description",
                )
            known = [known[self._chosen - 1]]
        wanted = {joint for _, joint in self._columns}
        sharing = []
        for one in known:
            others = [other for other in known if other is not one and not one.may_be(other)]
            if any(one.joints & other.joints & wanted for other in others):
                sharing.append(one)
        if sharing:
            raise self._several_publishers(sharing)
        for one in known:
            lacking = []
            for field, joint in self._columns:
                if joint in one.joints and field not in one.fields:
                    lacking.append(field)
            if lacking:
                field = lacking[0]
                names = counted(len(one.joints), "name")
                found = f"messages with {names} and 0 values of {field}"
                remedy = "does this controller publish it?"
                if any(field in other.fields for other in self._publishers.values()):
                    remedy = self._choice_of_each_field()
                raise _unfit(self._path, found, "one value a joint", remedy)

    def _several_publishers(self, sharing: list[_Publisher]) -> TableUnfit:
        """Make the error for several publishers of the same joints."""
        fullest = self._fullest(sharing)
        fields = {field for field, _ in self._columns}
        if fields <= set(fullest.fields):
            remedy = (
                f"choose one in the import description, as in `publisher: {fullest.number}`, or "
                "record again without the others"
            )
        else:
            remedy = self._choice_of_each_field()
        listed = "; ".join(map(str, sharing))
        return _unfit(
            self._path,
            f"{len(sharing)} publishers of the same joints on one topic: {listed}",
            "one publisher of each joint",
            remedy,
        )

    def _choice_of_each_field(self) -> str:
        """Return the advice for positions and efforts of different publishers."""
        numbers = {"position": 1, "effort": 2}
        for one in reversed(self._publishers.values()):
            numbers |= dict.fromkeys(one.fields, one.number)
        return SEPARATE.format(position=numbers["position"], effort=numbers["effort"])

    def _fullest(self, publishers: list[_Publisher]) -> _Publisher:
        """Return the publisher with most of the fields that are read, then with most messages."""
        fields = {field for field, _ in self._columns}

        def fields_and_messages(publisher: _Publisher) -> tuple[int, int]:
            used = fields & set(publisher.fields)
            return len(used), publisher.messages

        return max(publishers, key=fields_and_messages)

    def table(
        self, columns: tuple[Column, ...], time: TimeColumn | None, part: KeptPart | None
    ) -> Table:
        """Return the complete rows of the part that is kept.

        Raises:
            TableUnfit: a joint is missing in every row or between complete ones, or a number is not
                finite.
        """
        self._decide(zero_is_a_time=self._zero_is_a_time is True)
        self._require_one_publisher()
        width = len(self._columns)
        present: BoolArray = np.frombuffer(self._present, dtype=np.bool_).reshape(-1, width)
        values: FloatArray = np.frombuffer(self._values).reshape(-1, width)
        stamp_ns = self._stamp_ns
        if self._rhythm is not None:
            is_chosen = self._chosen_rhythm(self._rhythm)
            present = present[is_chosen]
            values = values[is_chosen]
            stamp_ns = array("q", np.asarray(stamp_ns)[is_chosen].tolist())
        kept = self._kept(stamp_ns, part)
        present = present[kept]
        values = values[kept]
        stamp_ns = stamp_ns[kept]
        is_number = present & ~np.isnan(values)
        self._require_joints(columns, present, is_number)
        is_complete = np.asarray(is_number.all(axis=1))
        complete = np.flatnonzero(is_complete)
        if complete.size:
            inside = slice(complete[0], complete[-1] + 1)
        else:
            inside = slice(0, 1)
        if not is_complete[inside].all():
            row = inside.start + int(np.argmin(is_complete[inside]))
            raise self._incomplete_row(columns, stamp_ns[row], present[row], is_number[row])
        remarks = self._remarks(present, is_number, inside)
        clock = stamps_of_ns(stamp_ns[inside])
        if self._rhythm is None:
            self._require_one_rhythm(clock.time_s)
        stamps = None if time is None else clock
        digest = digest_of(values[inside], clock)
        first_row = kept.start + inside.start
        table = Table(
            path=self._path,
            columns=columns,
            values=values[inside],
            digest=digest,
            stamps=stamps,
            first_row=first_row,
            remarks=remarks,
        )
        return require_finite(table)

    def _require_one_rhythm(self, time_s: FloatArray) -> None:
        """Refuse the messages of two publishers that nothing but their stamps tells apart.

        Raises:
            TableUnfit: the stamps are two even rows of them, one between the other.
        """
        found = interleaved(time_s)
        if found is None:
            return
        first = f"1: {found.first} messages each {found.first_step_s:.6g} s"
        second = f"2: {found.second} messages each {found.second_step_s:.6g} s between them"
        raise _unfit(
            self._path,
            f"stamps of two publishers of the same joints: {first}; {second}",
            "one publisher of each joint",
            "choose one in the import description, as in `rhythm: 1`; better, record again with "
            "one of the two nodes stopped, or give one of them another topic or `frame_id`",
        )

    def _chosen_rhythm(self, number: int) -> BoolArray:
        """Return which rows are of the publisher that is chosen by its rhythm, shape (k,).

        Raises:
            TableUnfit: there are no two rhythms, or a lost or late stamp leaves open which messages
                are of which.
        """
        if self._stamp_ns:
            time_s = stamps_of_ns(self._stamp_ns).time_s
        else:
            time_s = np.empty(0)
        found = interleaved(time_s)
        if found is None:
            raise _unfit(
                self._path,
                f"`rhythm: {number}`, and no two even rows of stamps",
                "stamps of two publishers, each of which stamps evenly",
                "leave `rhythm` out of the import description",
            )
        rows = (found.is_first, ~found.is_first)
        is_even = all(_share_of_usual_steps(time_s[one]) == 1.0 for one in rows)
        if not is_even:
            raise _unfit(
                self._path,
                f"`rhythm: {number}`, and stamps of two publishers with steps that are not even",
                "two rows of stamps that are even to the last one",
                "a message is lost or late, so that stamps do not say of which publisher some are: "
                "record again with one of the two nodes stopped",
            )
        return rows[number - 1]

    def _kept(self, stamp_ns: Sequence[int], part: KeptPart | None) -> slice:
        """Return the rows of the part that is kept."""
        count = len(stamp_ns)
        rows = slice(None) if part is None else part.rows
        if part is not None and part.is_by_time and count:
            rows = rows_in_time(stamps_of_ns(stamp_ns), part)
        if part is not None:
            require_kept(self._path, count, rows)
        return slice(*rows.indices(count))

    def _require_joints(
        self, columns: tuple[Column, ...], present: BoolArray, is_number: BoolArray
    ) -> None:
        """Refuse joints that no message has, and fields that are never a number."""
        absent = _listed(columns, np.asarray(~present.any(axis=0)))
        if absent:
            found: set[str] = set()
            for names in self._places:
                found.update(names)
            joints = ", ".join(map(on_one_line, sorted(found))) or "none"
            raise _unfit(self._path, f"joints {joints}", f"those of {absent}")
        empty = _listed(columns, np.asarray(~is_number.any(axis=0)))
        if empty:
            remedy = "does this controller measure it? name a field that it publishes"
            raise _unfit(self._path, f"nan in every message for {empty}", "numbers", remedy)

    def _incomplete_row(
        self, columns: tuple[Column, ...], stamp_ns: int, present: BoolArray, is_number: BoolArray
    ) -> TableUnfit:
        """Make the error for a row between complete ones that lacks joints, or numbers of them."""
        at = f"at {stamp_ns * 1e-9:.9f} s"
        absent = _listed(columns, ~present)
        if absent:
            return _unfit(
                self._path,
                f"no {absent} {at}",
                "all joints in messages of the same stamp",
                "messages are missing, or joints are stamped apart: record a topic that has all "
                "joints in each message",
            )
        empty = _listed(columns, ~is_number)
        return _unfit(
            self._path,
            f"nan for {empty} {at}",
            "numbers, but for the begin and the end of the bag",
            "samples are never invented: import what is before it and what is after it by `keep`, "
            "as recordings of their own",
        )

    def _remarks(self, present: BoolArray, is_number: BoolArray, inside: slice) -> tuple[str, ...]:
        """Say what was left out at the ends of the bag, and what was chosen."""
        remarks = []
        is_outside = np.ones(len(present), dtype=np.bool_)
        is_outside[inside] = False
        has_joints = present.all(axis=1)
        lacking = int(np.count_nonzero(is_outside & ~has_joints))
        empty = int(np.count_nonzero(is_outside & has_joints))
        if lacking:
            remarks.append(
                "left out, as joints are missing at the ends of the bag: "
                f"{counted(lacking, 'stamp')}"
            )
        if empty:
            remarks.append(
                f"left out, as values are nan at the ends of the bag: {counted(empty, 'stamp')}"
            )
        if self._unstamped:
            unstamped = counted(self._unstamped, "message")
            remarks.append(f"{unstamped} without a stamp: the time of the recording is used")
        if self._chosen is not None:
            others = [one for one in self._publishers.values() if one.number != self._chosen]
            remarks += [f"left out, of another publisher: {other}" for other in others]
        return tuple(remarks)


@dataclass(frozen=True, slots=True, eq=False)
class Interleaved:
    """Two even rows of stamps, one between the other."""

    first: int  #: number of stamps
    first_step_s: float
    second: int
    second_step_s: float
    is_first: BoolArray  #: which of the stamps are of the first row, in their order, shape (k,)


def interleaved(time_s: FloatArray) -> Interleaved | None:
    """Return what two publishers left, each of which stamps evenly; None for the stamps of one.

    One publisher may be uneven, but what is left when an even row of its stamps is taken out is not
    even as well.

    Args:
        time_s: stamps in the order of the messages, shape (k,).
    """
    order = np.argsort(time_s, kind="stable")
    ordered_s = time_s[order]
    if len(ordered_s) < 4 * FEWEST_OF_A_PUBLISHER:
        return None
    steps_s = np.diff(ordered_s)
    usual_s = float(np.median(steps_s))
    if usual_s <= 0.0 or _share_near(steps_s, usual_s) >= MOSTLY:
        return None
    double_s = float(np.median(steps_s[:-1] + steps_s[1:]))
    longest_s = float(steps_s.max())
    for step_s in (double_s, usual_s, longest_s):
        for start in range(2):
            is_first = _even_row(ordered_s, step_s, start)
            first_s = ordered_s[is_first]
            second_s = ordered_s[~is_first]
            if min(len(first_s), len(second_s)) < FEWEST_OF_A_PUBLISHER:
                continue
            if _is_even(first_s) and _is_even(second_s):
                first_step_s = float(np.median(np.diff(first_s)))
                second_step_s = float(np.median(np.diff(second_s)))
                is_same_rate = abs(second_step_s - first_step_s) <= EVEN_SHARE * first_step_s
                shorter_s = float(np.quantile(steps_s, 0.25))
                if is_same_rate and shorter_s > CENTRED_SHARE * first_step_s:
                    continue  # one loop that is early and late in turn
                in_order_of_messages = np.empty(len(order), dtype=np.bool_)
                in_order_of_messages[order] = is_first
                return Interleaved(
                    first=len(first_s),
                    first_step_s=first_step_s,
                    second=len(second_s),
                    second_step_s=second_step_s,
                    is_first=in_order_of_messages,
                )
    return None


def _even_row(time_s: FloatArray, step_s: float, start: int) -> BoolArray:
    """Return which stamps follow each other at a step, from one of them on, shape (k,)."""
    is_in_row = np.zeros(len(time_s), dtype=np.bool_)
    is_in_row[start] = True
    last_s = time_s[start]
    for number in range(start + 1, len(time_s)):
        late_s = time_s[number] - last_s - step_s
        if abs(late_s) <= EVEN_SHARE * step_s:
            is_in_row[number] = True
            last_s = time_s[number]
    return is_in_row


def _is_even(time_s: FloatArray) -> bool:
    """Whether most steps are the usual one, over all of the time."""
    return _share_of_usual_steps(time_s) >= MOSTLY


def _share_of_usual_steps(time_s: FloatArray) -> float:
    """Share of the steps that are the usual one; zero where that is none."""
    steps_s = np.diff(np.sort(time_s))
    usual_s = float(np.median(steps_s))
    if usual_s <= 0.0:
        return 0.0
    return _share_near(steps_s, usual_s)


def _share_near(steps_s: FloatArray, usual_s: float) -> float:
    """Share of the steps that are nearly the usual one."""
    is_near = np.abs(steps_s - usual_s) <= EVEN_SHARE * usual_s
    return float(np.mean(is_near))


def _listed(columns: tuple[Column, ...], is_listed: BoolArray) -> str:
    """Name some of the columns; empty without any."""
    return ", ".join(on_one_line(str(columns[number])) for number in np.flatnonzero(is_listed))


def _require_possible(time_ns: int) -> None:
    if time_ns >= LATEST_NS:
        raise ValueError(f"a time of {time_ns} ns")
