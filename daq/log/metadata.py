"""Metadata and readback of a log: how it was recorded, the answers of the amplifiers,
and the outcome.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Annotated, Any, TypeVar

from pydantic import Field, FiniteFloat, TypeAdapter, ValidationError

from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS, Payload

T = TypeVar("T")

RUN = "drivegain.run"
STATISTICS = "drivegain.statistics"
READBACK = "readback.json"
"""Names of two metadata records and an attachment."""
RECORDED = "recorded"  #: Origin of a log that is no import; `salvage` adds to it
LARGEST_COUNT = 2**64  #: Largest number of cycles, which are uint64 in the log
CLOCK_NS = range(-(2**63), 2**63)  #: Times and differences of clocks, which are int64 [ns]
RATES_HZ = (1e-3, 1e6)  #: Slowest and fastest sampling rate
VERSION = "1"  #: Version of the log contract; a reader refuses any other
#: Entry with the checksum of the others. Outside chunks, a log without its end has no other
#: checksum.
SEAL = "crc32"


_Count = Annotated[int, Field(ge=0, le=LARGEST_COUNT)]
_Clock = Annotated[int, Field(ge=CLOCK_NS.start, lt=CLOCK_NS.stop)]


class Role(Enum):
    """Whether a payload was mounted; not the use of the log in a fit
    (`ident.calibration.Source.role`).
    """

    UNLOADED = "unloaded"
    LOADED = "loaded"


@dataclass(frozen=True, slots=True)
class Timing:
    """Time stamps of an imported recording, and the uniform clock that its log has
    (`daq.log.resampling`).
    """

    rows: _Count  #: rows of the file
    rate_hz: FiniteFloat  #: rate of the log [Hz]
    usual_step_s: FiniteFloat  #: median step between stamps [s]
    longest_step_s: FiniteFloat  #: longest step [s]
    jitter_s: FiniteFloat  #: standard deviation of the steps, missing samples apart [s]
    #: largest distance of a stamp from a uniform clock that starts with the first one [s]
    drift_s: FiniteFloat
    missing: _Count  #: samples that are missing between the first and the last; interpolated
    resampled: bool  #: whether the samples were moved to a uniform clock
    duplicates: _Count = 0  #: rows left out because they repeat the one before
    #: samples left out because they are too close to the one before to give a speed
    close: _Count = 0
    #: first stamp by the file's clock [s]; None before zero, as of a trigger's
    started_s: FiniteFloat | None = None


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Facts known when a recording starts."""

    run_id: str  #: unique identifier
    rate_hz: float  #: sampling rate as requested of SYNC, exactly [Hz]
    payload: Payload | None  #: mounted payload, None without load
    operator: str  #: person responsible for the recording
    software: str  #: name and version of the recorder
    started_wall_ns: int  #: Unix time of the start [ns]
    #: the monotonic clock at the same moment [ns]; the difference reveals a clock jump
    started_monotonic_ns: int
    origin: str = RECORDED  #: RECORDED, or the sources of an import
    speed: float = 1.0  #: speed of the moves as a share of the plan's; 1 except for a first run
    #: Mass of the payload as weighed for this recording [kg]; None if it was not entered.
    entered_kg: float | None = None
    #: digest of the controller's file at the start; None without one
    controller_sha256: str | None = None
    #: time stamps of an import; None without stamps, and for a recording
    timing: Timing | None = None

    @property
    def has_clock(self) -> bool:
        """Whether the samples have the time at which they were taken, not only their order."""
        if self.origin.startswith(RECORDED):
            return True
        return self.timing is not None and self.timing.started_s is not None

    @property
    def role(self) -> Role:
        """Loaded or unloaded."""
        return Role.UNLOADED if self.payload is None else Role.LOADED

    @property
    def wall_minus_monotonic_ns(self) -> int:
        """Offset between the stamps of the samples and the monotonic clock of the recording
        computer [ns].
        """
        return self.started_wall_ns - self.started_monotonic_ns


@dataclass(frozen=True, slots=True)
class RunStatistics:
    """Facts known when a recording ends."""

    samples: _Count  #: number of cycles in the log
    lost_cycles: _Count  #: number of cycles missing from it
    missing: tuple[_Count, ...]  #: number of samples without an answer, for each axis
    valid: bool  #: whether the recorder considers the run usable
    reason: str = ""  #: why not
    partial: bool = False  #: the log was salvaged from a recording that was never finished
    #: Difference of the two clocks at the end [ns]; compared with the start it reveals a changed
    #: wall clock. None in salvaged and imported logs.
    wall_minus_monotonic_ns: _Clock | None = None


class Loss(Enum):
    """Kinds of frames that make a run invalid. Logs hold these names, so they must not change."""

    MISSING = "missing answers"
    LATE = "late answers"
    WRONG_LENGTH = "answers of wrong length"
    DUPLICATE = "answers twice"
    SURPLUS = "PDOs that no axis was configured to send"
    SKIPPED_PERIODS = "periods without SYNC"
    KERNEL = "frames dropped by the kernel"
    INTERFACE = "frames dropped by the interface"
    BACKLOG = "frames dropped by the capture process"

    @property
    def masked(self) -> bool:
        """Whether the samples carry the axis in `missing`;
        the recorder could not interpret the others.
        """
        return self not in (Loss.DUPLICATE, Loss.SURPLUS, Loss.SKIPPED_PERIODS)


def loss_reason(counts: Mapping[Loss, int]) -> str:
    """Return the losses above zero as `RunStatistics.reason`; empty without any."""
    losses = [f"{count} {loss.value}" for loss, count in counts.items() if count]
    return ", ".join(losses)


def reports_only_losses(reason: str) -> bool:
    """Return whether a reason consists of masked losses only, as `loss_reason` writes them."""
    parts = [part.partition(" ") for part in reason.split(", ")]
    masked = {loss.value for loss in Loss if loss.masked}
    return all(count.isdecimal() and name in masked for count, _, name in parts)


def run_record(info: RunInfo) -> dict[str, str]:
    """Encode the metadata `drivegain.run`."""
    payload = info.payload or Payload("", "")
    entered_kg = "" if info.entered_kg is None else repr(info.entered_kg)
    timing = "" if info.timing is None else json.dumps(asdict(info.timing))
    return {
        "version": VERSION,
        "run_id": info.run_id,
        "rate_hz": repr(info.rate_hz),
        "role": info.role.value,
        "payload": payload.name,
        "mounting": payload.mounting,
        "payload_known": json.dumps(payload.known, sort_keys=True),
        "operator": info.operator,
        "software": info.software,
        "started_wall_ns": str(info.started_wall_ns),
        "started_monotonic_ns": str(info.started_monotonic_ns),
        "wall_minus_monotonic_ns": str(info.wall_minus_monotonic_ns),
        "origin": info.origin,
        "speed": repr(info.speed),
        "payload_entered_kg": entered_kg,
        "controller_sha256": info.controller_sha256 or "",
        "timing": timing,
    }


def run_from_record(record: Mapping[str, str]) -> RunInfo:
    """Decode `run_record`; logs of earlier versions lack speed, second weighing,
    controller and timing.

    Raises:
        KeyError: an entry is missing.
        ValueError: an entry is invalid.
    """
    if record["version"] != VERSION:
        raise ValueError(
            f"version {record['version']!r:.40} of the log contract; this software reads {VERSION}"
        )
    payload = None
    if Role(record["role"]) is Role.LOADED:
        known = _validated(dict[str, FiniteFloat], record["payload_known"])
        is_known = known.keys() <= set(LINK_PARAMETERS)
        if not is_known or known.get("m", 1.0) <= 0.0:
            raise ValueError(
                f"known payload {record['payload_known']!r:.80}: expected parameters "
                "with a mass above 0"
            )
        try:
            payload = Payload(record["payload"], record["mounting"], known)
        except ModelError as error:
            raise ValueError(str(error)) from error
    rate_hz = float(record["rate_hz"])
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise ValueError(f"sampling rate {record['rate_hz']!r:.40}")
    speed = float(record.get("speed", "1"))
    if not 0.0 < speed <= 1.0:
        raise ValueError(f"share of the plan's speed {record['speed']!r:.40}")
    entered = record.get("payload_entered_kg", "")
    if entered and not 0.0 < float(entered) < math.inf:
        raise ValueError(f"mass of the payload as entered {entered!r:.40}")
    wall_ns = int(record["started_wall_ns"])
    monotonic_ns = int(record["started_monotonic_ns"])
    if wall_ns < 0 or wall_ns not in CLOCK_NS or monotonic_ns not in CLOCK_NS:
        wall = record["started_wall_ns"]
        monotonic = record["started_monotonic_ns"]
        raise ValueError(f"start times {wall!r:.40}, {monotonic!r:.40}")
    timing = record.get("timing")
    return RunInfo(
        run_id=record["run_id"],
        rate_hz=rate_hz,
        payload=payload,
        operator=record["operator"],
        software=record["software"],
        started_wall_ns=wall_ns,
        started_monotonic_ns=monotonic_ns,
        origin=record["origin"],
        speed=speed,
        entered_kg=float(entered) if entered else None,
        controller_sha256=record.get("controller_sha256") or None,
        timing=_validated(Timing, timing) if timing else None,
    )


def statistics_record(statistics: RunStatistics) -> dict[str, str]:
    """The metadata `drivegain.statistics`."""
    offset_ns = statistics.wall_minus_monotonic_ns
    return {
        "samples": str(statistics.samples),
        "lost_cycles": str(statistics.lost_cycles),
        "missing": json.dumps(statistics.missing),
        "valid": json.dumps(statistics.valid),
        "reason": statistics.reason,
        "partial": json.dumps(statistics.partial),
        "wall_minus_monotonic_ns": "" if offset_ns is None else str(offset_ns),
    }


def statistics_from_record(record: Mapping[str, str]) -> RunStatistics:
    """Decode `statistics_record`; logs of earlier versions are never partial.

    Raises:
        KeyError: an entry is missing.
        ValueError: an entry is invalid.
    """
    offset_ns = record.get("wall_minus_monotonic_ns", "")
    tree = {
        "samples": int(record["samples"]),
        "lost_cycles": int(record["lost_cycles"]),
        "missing": json.loads(record["missing"]),
        "valid": json.loads(record["valid"]),
        "reason": record["reason"],
        "partial": json.loads(record.get("partial", "false")),
        "wall_minus_monotonic_ns": int(offset_ns) if offset_ns else None,
    }
    statistics = _validated(RunStatistics, json.dumps(tree))
    most_missing = max(statistics.missing, default=0)
    if most_missing > statistics.samples:
        raise ValueError(f"{most_missing} answers missing in {statistics.samples} samples")
    return statistics


def _validated(kind: type[T], data: str | bytes) -> T:
    """Decode a foreign JSON document; a ValueError names the first place that does not fit."""
    try:
        return TypeAdapter(kind).validate_json(data, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        found = first["input"]
        expected = first["msg"].removeprefix("Input should be ")
        raise ValueError(f"{place} is {found!r:.40}, expected {expected}") from error


def sealed(record: Mapping[str, str]) -> dict[str, str]:
    """Add the checksum of its entries to a record."""
    return {**record, SEAL: _checksum(record)}


def unsealed(record: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of a sealed record;
    records of earlier versions have no seal and are returned unchecked.

    Raises:
        ValueError: the checksum does not match.
    """
    entries = {key: value for key, value in record.items() if key != SEAL}
    checksum = _checksum(entries)
    if record.get(SEAL, checksum) != checksum:
        raise ValueError(f"entries of checksum {checksum}, sealed with {record[SEAL]!r:.40}")
    return entries


def _checksum(record: Mapping[str, str]) -> str:
    content = json.dumps(sorted(record.items())).encode()
    return f"{zlib.crc32(content):08x}"


_Quantum = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


@dataclass(frozen=True, slots=True)
class AxisReadback:
    """Answers of the amplifier of one axis."""

    name: str  #: name of the axis
    #: unit of the reference (A) per raw unit, from the profile's formula and objects
    current_per_unit: _Quantum
    #: Motor angle of a count [rad]; None for 2π / counts per revolution of the cell.
    position_rad_per_count: _Quantum | None = None
    #: Identity, serial number, rated current, PDO mapping and whatever else the amplifier reported.
    drive: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Readback:
    """Answers of all amplifiers when a recording started. Without them raw numbers have no unit."""

    axes: Annotated[tuple[AxisReadback, ...], Field(min_length=1)]


def readback_of_drives(
    names: Sequence[str], ampere_per_unit: Sequence[float], answers: Mapping[str, Any]
) -> Readback:
    """Make the readback of a prepared network.

    Args:
        names: names of the axes, in their order.
        ampere_per_unit: result of CanopenNetwork.ampere_per_unit().
        answers: result of CanopenNetwork.readback(), by axis name.
    """
    axes = []
    for name, scale in zip(names, ampere_per_unit, strict=True):
        axes.append(AxisReadback(name, scale, drive=dict(answers[name])))
    return Readback(tuple(axes))


def readback_bytes(readback: Readback) -> bytes:
    """Encode the attachment."""
    return json.dumps(asdict(readback), indent=1).encode()


def readback_from_bytes(data: bytes) -> Readback:
    """Decode the attachment.

    Raises:
        ValueError: it is not a readback.
    """
    return _validated(Readback, data)
