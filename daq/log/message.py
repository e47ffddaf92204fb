"""The messages of a log: their ROS 2 definitions and their CDR bytes.

CDR (OMG DDSI-RTPS, XCDR1) is four bytes of encapsulation, then the fields in order. Each field is
aligned to its own size, counted from the end of the encapsulation. A sequence is its length and its
elements. A string ends with NUL, which its length includes.

With a given number of axes an AxisSamples message has a constant size, so numpy reads a chunk of
them at once.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Sequence, Sized

import numpy as np
from numpy.typing import NDArray

from drivers.messages import CellEvent, EventKind, Quantity, Sample, SlowReading

SAMPLES_TOPIC = "/cell/samples"
EVENTS_TOPIC = "/cell/events"
JOINTS_TOPIC = "/joint_states"
SAMPLES_SCHEMA = "drivegain_msgs/msg/AxisSamples"
EVENTS_SCHEMA = "drivegain_msgs/msg/CellEvent"
JOINTS_SCHEMA = "sensor_msgs/msg/JointState"
CURRENTS_TOPIC = "/cell/currents"
CURRENTS_SCHEMA = "drivegain_msgs/msg/AxisCurrents"
URDF_TOPIC = "/robot_description"
URDF_SCHEMA = "std_msgs/msg/String"
READING_TOPICS = {Quantity.TORQUE: "/cell/torque", Quantity.TEMPERATURE: "/cell/temperature"}
"""Topics of the slow readings; a log without such readings has no such topic."""
READING_SCHEMA = "drivegain_msgs/msg/AxisReading"
RawArray = NDArray[np.int32]  #: Counts and currents as amplifiers send them
LARGEST_AXES = 32  #: Number of bits in `missing`
_NS_PER_S = 1_000_000_000

_SEPARATOR = "=" * 80 + "\n"
_TIME = _SEPARATOR + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
DEFINITIONS = {
    SAMPLES_SCHEMA: """\
# One SYNC cycle of a cell, as the amplifiers sent it.
uint64 cycle                      # number of the sampling period; one without SYNC leaves a gap
builtin_interfaces/Time stamp     # of the SYNC, since 1970
int32[] position_counts           # motor side [encoder counts]
int32[] current_raw               # reference or actual current, by the profile [its unit; /cell/currents: A]
uint16[] statusword               # CiA 402 object 6041h
uint32 missing                    # bit i: axis i did not answer, its values repeat the last known ones
"""
    + _TIME,
    EVENTS_SCHEMA: """\
# Something that happened in a cell, before the sample of the same stamp.
builtin_interfaces/Time stamp
int16 axis                        # from 0, -1 is the whole cell
string kind                       # emcy, nmt, state, sample lost, move start, move end, ...
uint32 code                       # EMCY code, NMT state, statusword, number of the move or of the cycle, by kind
string text                       # for people
"""
    + _TIME,
    READING_SCHEMA: """\
# A value that is read a few times a second, beside the samples.
builtin_interfaces/Time stamp
int16 axis                        # from 0
float64 value                     # /cell/torque: the drive's own, at the motor [Nm]; /cell/temperature: [degC]
"""
    + _TIME,
    CURRENTS_SCHEMA: """\
# Currents of a cell, in the order of its axes: as recorded (/cell/currents), predicted or residual, by the topic.
builtin_interfaces/Time stamp     # of the SYNC, since 1970
float64[] current_a               # [A; where the cell's gain is in another unit, what it is multiplied by]
"""
    + _TIME,
    URDF_SCHEMA: "string data                       # the robot's URDF: lengths in m, "
    "angles in rad\n",
    JOINTS_SCHEMA: """\
std_msgs/Header header            # stamp of the SYNC, since 1970
string[] name                     # joints of the URDF, in the order of the axes
float64[] position                # [rad; m of a prismatic joint]
float64[] velocity                # [rad/s or m/s], mean over some 20 ms, or between two samples if that is longer
float64[] effort                  # [Nm or N], torque of the drives by a calibration's gains; empty without one
"""
    + _SEPARATOR
    + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + _TIME,
}
"""Full ros2msg definitions by schema name, with the definitions they refer to."""
SCHEMA_OF = {
    SAMPLES_TOPIC: SAMPLES_SCHEMA,
    EVENTS_TOPIC: EVENTS_SCHEMA,
    JOINTS_TOPIC: JOINTS_SCHEMA,
    CURRENTS_TOPIC: CURRENTS_SCHEMA,
    URDF_TOPIC: URDF_SCHEMA,
    **dict.fromkeys(READING_TOPICS.values(), READING_SCHEMA),
}
"""Schema name of every topic of a log."""

_ENCAPSULATION = b"\x00\x01\x00\x00"  #: CDR, little-endian
#: Encapsulation, stamp and axis of a CellEvent, up to its `kind`
_EVENT_HEAD = struct.Struct("<4siIh2x")
#: An AxisReading: encapsulation, stamp, axis and value
_READING = struct.Struct("<4siIh6xd")
_NO_AXIS = -1  #: Number in the place of an axis, in an event of the cell


def sample_struct(axes: int) -> struct.Struct:
    """Return the layout of an AxisSamples message, encapsulation first."""
    padding = ""
    if axes % 2:
        padding = "2x"  # uint16[] of odd length leaves `missing` unaligned
    return struct.Struct(f"<4sQiII{axes}iI{axes}iI{axes}H{padding}I")


def sample_bytes(layout: struct.Struct, sample: Sample) -> bytes:
    """Encode one sample.

    Args:
        layout: of `sample_struct`, for the number of axes.
        sample: to be encoded.

    Raises:
        struct.error: a value does not fit its type, or the number of axes the layout.
    """
    axes = len(sample.position_counts)
    seconds, nanoseconds = divmod(sample.time_ns, _NS_PER_S)
    return layout.pack(
        _ENCAPSULATION,
        sample.cycle,
        seconds,
        nanoseconds,
        axes,
        *sample.position_counts,
        axes,
        *sample.current_raw,
        axes,
        *sample.statusword,
        sample.missing,
    )


@functools.cache
def sample_dtype(axes: int) -> np.dtype[np.void]:
    """Return the numpy type of an MCAP record (opcode, length, 22 bytes of header)
    with an AxisSamples message.

    `positions`, `currents` and `statuswords` are the lengths of the arrays after them.
    """
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("encapsulation", "<u4"),
        ("cycle", "<u8"),
        ("seconds", "<i4"),
        ("nanoseconds", "<u4"),
        ("positions", "<u4"),
        ("position_counts", "<i4", (axes,)),
        ("currents", "<u4"),
        ("current_raw", "<i4", (axes,)),
        ("statuswords", "<u4"),
        ("statusword", "<u2", (axes,)),
    ]
    if axes % 2:
        fields.append(("padding", "<u2"))
    fields.append(("missing", "<u4"))
    return np.dtype(fields)


ENCAPSULATION_WORD = int.from_bytes(_ENCAPSULATION, "little")
"""The field `encapsulation` of `sample_dtype`."""


def event_bytes(event: CellEvent) -> bytes:
    """Encode one event."""
    seconds, nanoseconds = divmod(event.time_ns, _NS_PER_S)
    axis = event.axis
    if axis is None:
        axis = _NO_AXIS
    head = _EVENT_HEAD.pack(_ENCAPSULATION, seconds, nanoseconds, axis)
    kind = _string_bytes(event.kind.value)
    # The head ends at a multiple of 4, so the alignment counts from `kind`, too.
    padding = _padding(kind, 4)
    code = struct.pack("<I", event.code)
    text = _string_bytes(event.text)
    return head + kind + padding + code + text


def event_from_bytes(data: bytes) -> CellEvent:
    """Decode one event.

    Raises:
        ValueError, struct.error: the bytes are not a CellEvent of this software.
    """
    encapsulation, seconds, nanoseconds, number = _EVENT_HEAD.unpack_from(data)
    _require_cdr(encapsulation)
    kind, kind_end = _read_string(data, _EVENT_HEAD.size)
    padding = -kind_end % 4
    code_start = kind_end + padding
    (code,) = struct.unpack_from("<I", data, code_start)
    text, _ = _read_string(data, code_start + 4)
    time_ns = _time_ns(seconds, nanoseconds)
    axis = number
    if number == _NO_AXIS:
        axis = None
    return CellEvent(time_ns, axis, EventKind(kind), code, text)


def reading_bytes(reading: SlowReading) -> bytes:
    """Encode one slow reading; the topic names its quantity."""
    seconds, nanoseconds = divmod(reading.time_ns, _NS_PER_S)
    return _READING.pack(_ENCAPSULATION, seconds, nanoseconds, reading.axis, reading.value)


def reading_from_bytes(data: bytes, quantity: Quantity) -> SlowReading:
    """Decode one slow reading.

    Raises:
        ValueError, struct.error: the bytes are not an AxisReading of this software.
    """
    encapsulation, seconds, nanoseconds, axis, value = _READING.unpack(data)
    _require_cdr(encapsulation)
    time_ns = _time_ns(seconds, nanoseconds)
    is_axis = 0 <= axis < LARGEST_AXES
    if not is_axis or not math.isfinite(value):
        raise ValueError(f"a value of {value} for axis {axis}")
    return SlowReading(time_ns, axis, quantity, value)


def _require_cdr(encapsulation: bytes) -> None:
    """Refuse a message in another encoding: its bytes have another order."""
    if encapsulation != _ENCAPSULATION:
        raise ValueError(f"encapsulation {encapsulation!r}, expected little-endian CDR")


def _time_ns(seconds: int, nanoseconds: int) -> int:
    """Return the time of a stamp [ns since 1970]; raises ValueError for one that is none."""
    if seconds < 0 or nanoseconds >= _NS_PER_S:
        raise ValueError(f"time {seconds} s, {nanoseconds} ns")
    return seconds * _NS_PER_S + nanoseconds


def _padding(data: bytes | bytearray, alignment: int) -> bytes:
    """Return zeros from the end of the data to the next multiple of `alignment` bytes."""
    count = -len(data) % alignment
    return b"\0" * count


def _length_bytes(values: Sized) -> bytes:
    """Encode the length of a sequence."""
    return struct.pack("<I", len(values))


def _string_bytes(text: str) -> bytes:
    """Encode a string: its length, its bytes in UTF-8, and NUL."""
    without_nul = text.replace("\0", " ")
    # Bytes of a file name that are no UTF-8 are in its text as lone surrogates; an error may name
    # such a file.
    encoded = without_nul.encode("utf-8", "backslashreplace")
    data = encoded + b"\0"
    return _length_bytes(data) + data


def _read_string(data: bytes, start: int) -> tuple[str, int]:
    """Decode the string at a position; return it with the position after it."""
    (length,) = struct.unpack_from("<I", data, start)
    text_start = start + 4
    end = text_start + length
    encoded = data[text_start:end]
    if len(encoded) != length or encoded[-1:] != b"\0":
        raise ValueError(f"a string of {length} bytes that does not end")
    text = encoded[:-1].decode("utf-8")
    return text, end


def joint_state_prefix(names: Sequence[str]) -> bytes:
    """Encode the fields of a JointState between its stamp and its positions.

    They are the same in every message.
    """
    # The stamp before them has 8 bytes, so the alignment may be counted from here.
    frame_id = _string_bytes("")
    data = bytearray(frame_id)
    data += _padding(data, 4)
    data += _length_bytes(names)
    for name in names:
        data += _padding(data, 4)
        data += _string_bytes(name)
    return bytes(data)


def joint_state_bytes(
    prefix: bytes,
    time_ns: int,
    position: Sequence[float],
    velocity: Sequence[float],
    effort: Sequence[float] = (),
) -> bytes:
    """Encode a JointState.

    Args:
        prefix: of `joint_state_prefix`.
        time_ns: stamp [ns since 1970].
        position: [rad; m of a prismatic joint], shape (n,).
        velocity: [rad/s; m/s of a prismatic joint], shape (n,).
        effort: [Nm; N of a prismatic joint], shape (n,) or empty.
    """
    return _doubles_bytes(time_ns, prefix, position, velocity, effort)


def currents_bytes(time_ns: int, current_a: Sequence[float]) -> bytes:
    """Encode the currents of all axes [A], shape (n,)."""
    return _doubles_bytes(time_ns, b"", current_a)


def text_bytes(text: str) -> bytes:
    """Encode a String."""
    return _ENCAPSULATION + _string_bytes(text)


def _doubles_bytes(time_ns: int, prefix: bytes, *sequences: Sequence[float]) -> bytes:
    """Encode a message of a stamp, other fields and sequences of float64.

    Args:
        time_ns: stamp [ns since 1970].
        prefix: the other fields, encoded.
        sequences: after them, in order.
    """
    seconds, nanoseconds = divmod(time_ns, _NS_PER_S)
    stamp = struct.pack("<iI", seconds, nanoseconds)
    data = bytearray(stamp + prefix)
    for values in sequences:
        data += _padding(data, 4)
        data += _length_bytes(values)
        # An empty sequence has no element that would have to be aligned.
        if len(values):
            data += _padding(data, 8)
            data += struct.pack(f"<{len(values)}d", *values)
    return _ENCAPSULATION + bytes(data)
