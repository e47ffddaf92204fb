"""Write a log as a rosbag2 folder: a bag in MCAP and its `metadata.yaml`, with all numbers in SI.

`metadata.yaml` is of version 5, which ROS 2 reads from Humble on. Topics are reliable and volatile,
but for the robot's description: like `robot_state_publisher`, it keeps the last message for late
subscribers.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from daq.config.cell import Cell, joint_names
from daq.config.same_cell import require_cell_of
from daq.errors import ConfigurationInconsistent, OutputFailed
from daq.files import fsync_folder, require_new
from daq.log.conversion import continuous_counts, scaling
from daq.log.message import (
    CURRENTS_TOPIC,
    DEFINITIONS,
    EVENTS_TOPIC,
    JOINTS_TOPIC,
    READING_TOPICS,
    SCHEMA_OF,
    URDF_TOPIC,
    currents_bytes,
    event_bytes,
    joint_state_bytes,
    joint_state_prefix,
    reading_bytes,
    text_bytes,
)
from daq.log.motion import MotionWatch
from daq.log.reader import Log, SampleChecks, read_log
from ident.arrays import FloatArray, IntArray
from ident.calibration import Calibration
from ident.model.model import DriveTrain

VELOCITY_S = 0.02  #: Time over which a velocity is the mean, as in a log's own joint states
# Values of rmw's enumerations
_RELIABLE, _VOLATILE, _TRANSIENT_LOCAL, _KEEP_LAST, _AUTOMATIC = 1, 2, 1, 1, 1


@dataclass(frozen=True, slots=True)
class BagWritten:
    """A bag that was written."""

    messages: dict[str, int]  #: number of messages by topic
    duration_s: float  #: from the first to the last message [s]
    partial: bool  #: the log was never finished
    #: whether the recorder marked the run valid, and its cycles and time steps are even
    valid: bool
    reason: str  #: why not


def export_bag(path: Path, out: Path, calibration: Calibration | None = None) -> BagWritten:
    """Write a bag from a log: joint states and currents at every SYNC, events, slow readings,
    the URDF.

    Args:
        path: log to read.
        out: folder to make; must not exist.
        calibration: of the log's cell; its gains give the effort of the joint states. None: no
            effort.

    Raises:
        UsageError: a file, folder or link of that name exists.
        OutputFailed: the file system refuses; nothing is left.
        ConfigurationInconsistent: the calibration is of another cell than the log.
        LogUnreadable: the log is damaged or incomplete; nothing is written.
    """
    require_new(out, "choose another --out")
    log = read_log(path)
    cell = log.head.cell(path)
    gains = []
    if calibration is not None:
        require_cell_of(
            calibration,
            cell,
            ConfigurationInconsistent,
            str(path),
            remedy="give a calibration of this cell",
        )
        gains = [gain.value for gain in calibration.gains]
    messages = sorted(_messages(log, cell, gains), key=lambda message: message[0])
    counts = Counter(topic for _, topic, _ in messages)
    first_ns = messages[0][0]
    last_ns = messages[-1][0]
    unfinished = out.with_name(out.name + ".part")
    name = f"{out.name}_0.mcap"
    try:
        unfinished.mkdir()
        try:
            with (unfinished / name).open("wb") as stream:
                _write(Writer(stream, compression=CompressionType.ZSTD), messages)
            metadata = _metadata(name, counts, first_ns, last_ns)
            (unfinished / "metadata.yaml").write_text(metadata, encoding="utf-8")
            unfinished.rename(out)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)  # once renamed, it is gone
        fsync_folder(out)
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    checks = SampleChecks(path)
    checks.take(log.samples)
    watch = MotionWatch(cell, log.head)
    watch.take(log.samples)
    verdict = watch.verdict(checks, log.statistics, lambda: (log.samples,))
    sorted_counts = dict(sorted(counts.items()))
    duration_s = (last_ns - first_ns) * 1e-9
    return BagWritten(sorted_counts, duration_s, log.partial, *verdict)


def _messages(log: Log, cell: Cell, gains: Sequence[float]) -> Iterator[tuple[int, str, bytes]]:
    """Yield stamp [ns], topic and CDR bytes of every message."""
    samples = log.samples
    scale = scaling(cell, log.head.readback)
    counts = continuous_counts(samples.position_counts, log.head.readback)
    position = scale.joint_position(counts)
    velocity = mean_velocity(position, samples.time_ns)
    current = samples.current_raw * scale.current_per_unit
    if len(gains):
        effort = joint_effort(cell, current, gains)
    else:
        effort = np.empty((len(current), 0))
    prefix = joint_state_prefix(joint_names(cell))
    stamps = samples.time_ns.tolist()
    yield stamps[0], URDF_TOPIC, text_bytes(cell.urdf)
    states = zip(position.tolist(), velocity.tolist(), effort.tolist(), strict=True)
    for time_ns, state, current_a in zip(stamps, states, current.tolist(), strict=True):
        yield time_ns, JOINTS_TOPIC, joint_state_bytes(prefix, time_ns, *state)
        yield time_ns, CURRENTS_TOPIC, currents_bytes(time_ns, current_a)
    for event in log.events:
        yield event.time_ns, EVENTS_TOPIC, event_bytes(event)
    for reading in log.readings:
        yield reading.time_ns, READING_TOPICS[reading.quantity], reading_bytes(reading)


def mean_velocity(position: FloatArray, time_ns: IntArray) -> FloatArray:
    """Mean velocity over VELOCITY_S about each sample, shorter at the ends [rad/s or m/s],
    shape (k, n).

    Args:
        position: [rad or m], shape (k, n).
        time_ns: increasing [ns], shape (k,).
    """
    half_ns = round(0.5e9 * VELOCITY_S)
    last = len(time_ns) - 1
    index = np.arange(last + 1)
    # At least from the sample before to the sample after
    previous = np.maximum(index - 1, 0)
    following = np.minimum(index + 1, last)
    before = np.searchsorted(time_ns, time_ns - half_ns)
    before = np.minimum(before, previous)
    after = np.searchsorted(time_ns, time_ns + half_ns, side="right") - 1
    after = np.maximum(after, following)
    elapsed_ns = np.maximum(time_ns[after] - time_ns[before], 1)
    elapsed_s = elapsed_ns * 1e-9
    way = position[after] - position[before]
    return np.asarray(way / elapsed_s[:, None])


def joint_effort(cell: Cell, current: FloatArray, gains: Sequence[float]) -> FloatArray:
    """Torque of the drives on each joint, Y = V g (paper eq. 4 through R) [Nm or N], shape (k, n).

    Args:
        cell: with the drive train.
        current: [unit of the gains' denominator], shape (k, n).
        gains: g of each axis, shape (n,).
    """
    return (np.asarray(gains) * current) @ DriveTrain(cell.ratio).direction


def _write(writer: Writer, messages: Sequence[tuple[int, str, bytes]]) -> None:
    writer.start(profile="ros2", library="drivegain")
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    for time_ns, topic, data in messages:
        if topic not in channels:
            schema = SCHEMA_OF[topic]
            if schema not in schemas:
                definition = DEFINITIONS[schema].encode()
                schemas[schema] = writer.register_schema(schema, "ros2msg", definition)
            qos_lines = [f"{line}\n" for line in _qos(topic)]
            metadata = {"offered_qos_profiles": "".join(qos_lines)}
            channels[topic] = writer.register_channel(topic, "cdr", schemas[schema], metadata)
        writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()


def _qos(topic: str) -> list[str]:
    """Return the lines of the quality of service that a topic was offered with."""
    if topic == URDF_TOPIC:
        depth = 1
        durability = _TRANSIENT_LOCAL
    else:
        depth = 10
        durability = _VOLATILE
    forever = ["    sec: 9223372036", "    nsec: 854775807"]
    return [
        f"- history: {_KEEP_LAST}",
        f"  depth: {depth}",
        f"  reliability: {_RELIABLE}",
        f"  durability: {durability}",
        "  deadline:",
        *forever,
        "  lifespan:",
        *forever,
        f"  liveliness: {_AUTOMATIC}",
        "  liveliness_lease_duration:",
        *forever,
        "  avoid_ros_namespace_conventions: false",
    ]


def _metadata(name: str, counts: Counter[str], first_ns: int, last_ns: int) -> str:
    """Return the text of `metadata.yaml`."""
    duration = f"nanoseconds: {last_ns - first_ns}"
    start = f"nanoseconds_since_epoch: {first_ns}"
    message_count = sum(counts.values())
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: mcap",
        "  duration:",
        f"    {duration}",
        "  starting_time:",
        f"    {start}",
        f"  message_count: {message_count}",
        "  topics_with_message_count:",
    ]
    for topic, count in sorted(counts.items()):
        qos_lines = [f"          {line}" for line in _qos(topic)]
        lines += [
            "    - topic_metadata:",
            f"        name: {topic}",
            f"        type: {SCHEMA_OF[topic]}",
            "        serialization_format: cdr",
            "        offered_qos_profiles: |",
            *qos_lines,
            f"      message_count: {count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        "  relative_file_paths:",
        f"    - {name}",
        "  files:",
        f"    - path: {name}",
        "      starting_time:",
        f"        {start}",
        "      duration:",
        f"        {duration}",
        f"      message_count: {message_count}",
    ]
    return "\n".join(lines) + "\n"
