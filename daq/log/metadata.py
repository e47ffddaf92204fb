"""Who recorded what, with which load, and how it went: the metadata of a log."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from ident.model.bodies import LINK_PARAMETERS, Payload

RUN, STATISTICS = "drivegain.run", "drivegain.statistics"
LARGEST_COUNT = 2**64
"""Of cycles: their numbers are uint64 in the log."""
VERSION = "1"
"""Of the log's contract; a reader refuses a higher one."""
SEAL = "crc32"
"""Entry with the checksum of the others: of what stands outside chunks, a log without its end has no other."""


class Role(Enum):
    """What a run is for."""

    UNLOADED = "unloaded"
    LOADED = "loaded"


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What is known when a recording starts.

    Attributes:
        run_id: unique; given by the caller.
        rate_hz: samples a second, exactly as asked of SYNC.
        payload: what was mounted, None without load.
        operator: who stands for it.
        software: name and version of the recorder.
        started_wall_ns: Unix time of the start [ns].
        started_monotonic_ns: the monotonic clock at the same moment [ns]; a clock jump shows in the difference.
        origin: where the samples came from: "recorded", or the import's sources.
        speed: share of the plan's speed that the moves were made with; 1 but for a first run.
        entered_kg: mass of the payload as somebody read it off the scale for this recording; None where nobody did.
        controller_sha256: digest of the controller's file at the start; None where the cell names none.
    """

    run_id: str
    rate_hz: float
    payload: Payload | None
    operator: str
    software: str
    started_wall_ns: int
    started_monotonic_ns: int
    origin: str = "recorded"
    speed: float = 1.0
    entered_kg: float | None = None
    controller_sha256: str | None = None

    @property
    def role(self) -> Role:
        """Loaded or unloaded."""
        return Role.UNLOADED if self.payload is None else Role.LOADED

    @property
    def wall_minus_monotonic_ns(self) -> int:
        """What turns the stamps of the samples into the monotonic clock of the recording computer [ns]."""
        return self.started_wall_ns - self.started_monotonic_ns


@dataclass(frozen=True, slots=True)
class RunStatistics:
    """What is known when a recording ends.

    Attributes:
        samples: cycles in the log.
        lost_cycles: cycles that are not.
        missing: samples in which the axis did not answer, one number an axis.
        valid: whether the recorder stands for the run.
        reason: why not.
        partial: the log holds what could be saved of a recording that was never finished.
        wall_minus_monotonic_ns: the two clocks at the end [ns]; against the start it shows whether the wall clock was
            set meanwhile. None where nobody has looked: in salvaged and imported logs.
    """

    samples: int
    lost_cycles: int
    missing: tuple[int, ...]
    valid: bool
    reason: str = ""
    partial: bool = False
    wall_minus_monotonic_ns: int | None = None


def run_record(info: RunInfo) -> dict[str, str]:
    """The metadata `drivegain.run`."""
    payload = info.payload
    return {
        "version": VERSION,
        "run_id": info.run_id,
        "rate_hz": repr(info.rate_hz),
        "role": info.role.value,
        "payload": "" if payload is None else payload.name,
        "mounting": "" if payload is None else payload.mounting,
        "payload_known": "{}" if payload is None else json.dumps(payload.known, sort_keys=True),
        "operator": info.operator,
        "software": info.software,
        "started_wall_ns": str(info.started_wall_ns),
        "started_monotonic_ns": str(info.started_monotonic_ns),
        "wall_minus_monotonic_ns": str(info.wall_minus_monotonic_ns),
        "origin": info.origin,
        "speed": repr(info.speed),
        "payload_entered_kg": "" if info.entered_kg is None else repr(info.entered_kg),
        "controller_sha256": info.controller_sha256 or "",
    }


def run_from_record(record: Mapping[str, str]) -> RunInfo:
    """What `run_record` wrote; logs of earlier versions say nothing of speed, second weighing and controller.

    Raises:
        KeyError: an entry is missing.
        ValueError: an entry is not what it must be.
    """
    if record["version"] != VERSION:
        raise ValueError(f"version {record['version']!r} of the log contract; this software reads {VERSION}")
    payload = None
    if Role(record["role"]) is Role.LOADED:
        known = json.loads(record["payload_known"])
        if not isinstance(known, dict) or not known.keys() <= set(LINK_PARAMETERS):
            raise ValueError(f"known payload parameters {record['payload_known']!r}")
        numbers = {key: _number(value) for key, value in known.items()}
        if not all(map(math.isfinite, numbers.values())) or numbers.get("m", 1.0) <= 0.0:
            raise ValueError(f"known payload {record['payload_known']!r}: not finite numbers with a mass above 0")
        payload = Payload(record["payload"], record["mounting"], numbers)
    rate_hz = float(record["rate_hz"])
    if not 0.0 < rate_hz < 1e6:
        raise ValueError(f"sampling rate {record['rate_hz']!r}")
    speed = float(record.get("speed", "1"))
    if not 0.0 < speed <= 1.0:
        raise ValueError(f"share of the plan's speed {record['speed']!r}")
    entered = record.get("payload_entered_kg", "")
    if entered and not 0.0 < float(entered) < math.inf:
        raise ValueError(f"mass of the payload as entered {entered!r:.40}")
    wall_ns = int(record["started_wall_ns"])
    if not 0 <= wall_ns < 2**63:
        raise ValueError(f"start time {record['started_wall_ns']!r}")
    return RunInfo(
        run_id=record["run_id"],
        rate_hz=rate_hz,
        payload=payload,
        operator=record["operator"],
        software=record["software"],
        started_wall_ns=wall_ns,
        started_monotonic_ns=int(record["started_monotonic_ns"]),
        origin=record["origin"],
        speed=speed,
        entered_kg=float(entered) if entered else None,
        controller_sha256=record.get("controller_sha256") or None,
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
    """What `statistics_record` wrote; logs of earlier versions are never partial.

    Raises:
        KeyError: an entry is missing.
        ValueError: an entry is not what it must be.
    """
    missing, valid = json.loads(record["missing"]), json.loads(record["valid"])
    partial = json.loads(record.get("partial", "false"))
    if not (isinstance(valid, bool) and isinstance(partial, bool) and isinstance(missing, list)):
        found = f"missing {record['missing']!r}, valid {record['valid']!r}, partial {partial!r}"
        raise ValueError(found)  # noqa: TRY004 - a foreign record
    offset_ns = record.get("wall_minus_monotonic_ns", "")
    samples, lost_cycles = int(record["samples"]), int(record["lost_cycles"])
    for count in (samples, lost_cycles, *missing):
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= LARGEST_COUNT:
            raise ValueError(f"a count of {count!r:.40}")
    if max(missing, default=0) > samples:
        raise ValueError(f"{max(missing)} answers missing in {samples} samples")
    return RunStatistics(
        samples=samples,
        lost_cycles=lost_cycles,
        missing=tuple(missing),
        valid=valid,
        reason=record["reason"],
        partial=partial,
        wall_minus_monotonic_ns=int(offset_ns) if offset_ns else None,
    )


def sealed(record: Mapping[str, str]) -> dict[str, str]:
    """A record with the checksum of its entries."""
    return {**record, SEAL: _checksum(record)}


def unsealed(record: Mapping[str, str]) -> dict[str, str]:
    """The entries of a sealed record; one of an earlier version has no seal and is taken as it is.

    Raises:
        ValueError: they are not those that were sealed.
    """
    entries = {key: value for key, value in record.items() if key != SEAL}
    if record.get(SEAL, _checksum(entries)) != _checksum(entries):
        raise ValueError(f"entries of checksum {_checksum(entries)}, sealed with {record[SEAL]!r:.40}")
    return entries


def _checksum(record: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(record.items())).encode()):08x}"


def _number(value: object) -> float:
    """A number of a foreign JSON document; NaN for anything else, also for an integer that no float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan
