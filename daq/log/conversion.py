"""Convert a log with its cell to a `Run` in SI."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.arguments import A_PATH, checks_arguments, of_kind, optional
from daq.config.cell import DEGREE, Cell, model_of
from daq.config.same_cell import Correction, correction_of
from daq.errors import CurrentSaturated, LogIncomplete, LogsDiffer, PositionImplausible, RunInvalid
from daq.log.impossible import motion_fault
from daq.log.message import RawArray
from daq.log.metadata import Readback, reports_only_losses
from daq.log.reader import Log, LossyLogs, SampleChecks, read_log
from drivers.messages import CellEvent, EventKind, Quantity, SlowReading
from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.channel_faults import JudgedChannels, faults_in_use, find_faults
from ident.data.run import Recording, Run
from ident.data.torque_channel import TorqueChannel
from ident.data.unsigned_current import unsigned_currents
from ident.model.model import DriveTrain
from ident.plausible import TEMPERATURES_C, format_at_limit

_LOG = logging.getLogger("drivegain")
LIMIT_MARGIN = 0.05  #: Largest excursion beyond the limits, as a share of the joint's range
#: Largest share of an axis's samples with an active limit; these samples are masked
LARGEST_SATURATED = 0.1
AVERAGED_S = 0.005  #: Half of the time around a torque over which its current is averaged
#: Distances from it at which the current has another noise, but hardly another value
NEARBY_S = 0.01, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class SiScaling:
    """Factors from raw numbers to SI."""

    rad_per_count: FloatArray  #: motor angle of a count [rad], shape (n,)
    to_joint: FloatArray  #: R⁻¹, shape (n, n)
    #: joint position where R⁻¹ q_motor is zero [rad; m of a prismatic joint], shape (n,)
    offset_rad: FloatArray
    current_per_unit: FloatArray  #: unit of the current reference (A) per raw unit, shape (n,)

    def joint_position(self, counts: NDArray[np.integer]) -> FloatArray:
        """Return joint positions [rad or m] of motor counts, shape (..., n):
        q = R⁻¹ q_motor + offset (paper eq. 24)
        """
        motor_rad = counts * self.rad_per_count
        return motor_rad @ self.to_joint.T + self.offset_rad

    def joints_known(self, answered: BoolArray) -> BoolArray:
        """Return whether every motor that moves a joint answered, shape (..., n),
        from the answers of the motors.
        """
        size = np.abs(self.to_joint)
        moves = size > 1e-12 * size.max()
        is_unknown = ~answered @ moves.T
        return np.asarray(~is_unknown, dtype=np.bool_)

    def joint_position_of(self, counts: tuple[int, ...]) -> list[float]:
        """Convert one sample, for /joint_states."""
        motor_counts = np.array(counts, dtype=np.int64)
        position: list[float] = self.joint_position(motor_counts).tolist()
        return position


def scaling(cell: Cell, readback: Readback) -> SiScaling:
    """Return the scaling of a cell with the answers of its amplifiers.

    Raises:
        LogIncomplete: cell and readback have different axes, or neither defines a count.
    """
    names = tuple(axis.name for axis in readback.axes)
    if names != cell.axis_names:
        raise LogIncomplete(
            f"cell {cell.name!r}",
            found=f"a readback of {', '.join(names)}",
            expected=f"one of {', '.join(cell.axis_names)}",
            remedy="the log and the cell configuration do not belong together",
        )
    angles = []
    for axis, answer in zip(cell.axes, readback.axes, strict=True):
        if answer.position_rad_per_count is not None:
            angles.append(answer.position_rad_per_count)
        elif axis.counts_per_revolution is not None:
            angles.append(2.0 * pi / axis.counts_per_revolution)
        else:
            raise LogIncomplete(
                f"cell {cell.name!r}, axis {axis.name}",
                found="no counts_per_revolution",
                expected="it in the cell configuration, or a count in the log's readback",
                remedy="add it to the cell file and record or import again",
            )
    to_joint = np.asarray(np.linalg.inv(cell.ratio), dtype=np.float64)
    offsets_rad = [axis.zero_offset_rad for axis in cell.axes]
    currents_per_unit = [answer.current_per_unit for answer in readback.axes]
    return SiScaling(
        rad_per_count=np.array(angles),
        to_joint=to_joint,
        offset_rad=np.array(offsets_rad),
        current_per_unit=np.array(currents_per_unit),
    )


@checks_arguments(path=A_PATH, cell=optional(of_kind(Cell)), lossy=of_kind(LossyLogs))
def load_run(
    path: Path | str, cell: Cell | None = None, lossy: LossyLogs = LossyLogs.REFUSED
) -> tuple[Run, Cell]:
    """Read a log as a run, with the cell in the log or another description of it.

    A given description has to be of the same cell (`daq.config.same_cell`), and also replaces the
    mass of the payload that the log records; `Run.recording` says what it corrects. Warns of a
    partial log, of accepted losses, and of a run slower than planned.

    Raises:
        UsageError: an argument is of another type.
        LogsDiffer: the given description is of another cell.
        DataError: the log cannot be read, or its samples cannot be used.
        ident.CurrentUnsigned: drives report the size of the current only.
        ConfigurationError: the cell in the log is inconsistent.
    """
    path = Path(path)
    log = read_log(path)
    if log.partial:
        _LOG.warning(
            "%s is PARTIAL: salvaged from a recording that was never finished; nothing of it is "
            "written back",
            path,
        )
    if (speed := log.head.run.speed) < 1.0:
        _LOG.warning(
            "%s was recorded at %g %% of the plan's speed: it identifies gains and inertias less "
            "well than planned",
            path,
            100.0 * speed,
        )
    if cell is None:
        own = log.head.cell(path)
        return run_from_log(log, own, lossy), own
    serials = [_serial(axis.drive) for axis in log.head.readback.axes]
    correction = correction_of(str(path), log.head.files, cell, serials)
    return _corrected(run_from_log(log, cell, lossy), cell, correction), cell


def _corrected(run: Run, cell: Cell, correction: Correction | None) -> Run:
    """Return a run with the payload's mass of a given description,
    and the record of what that corrects.

    Raises:
        LogsDiffer: the description lacks the payload of the run.
    """
    payload = run.payload
    if payload is not None and "m" in payload.known:
        declared = {(one.name, one.mounting): one.mass_kg for one in cell.payloads}
        mass_kg = declared.get((payload.name, payload.mounting))
        if mass_kg is not None:
            known = {**payload.known, "m": mass_kg}
            run = replace(run, payload=replace(payload, known=known))
        elif correction is not None:
            names = [f"{name} on {mounting}" for name, mounting in declared]
            payloads = ", ".join(names) or "it has none"
            raise LogsDiffer(
                run.name,
                found=f"payload {payload.name} on {payload.mounting}, which the given description "
                "does not have",
                expected=f"one of its payloads: {payloads}",
                remedy="keep name and mounting of the payload; its mass and tolerance may be "
                "corrected",
            )
    if correction is None or run.recording is None:
        return run
    recording = replace(
        run.recording,
        replaced_configuration_sha256=correction.configuration_sha256,
        corrected=correction.sections,
    )
    return replace(run, recording=recording)


def _has_accepted_losses(log: Log, lossy: LossyLogs) -> bool:
    """Return whether the log is used although it has lost samples; warn of one that is.

    Raises:
        RunInvalid: the recorder marked the log invalid, and it is not accepted.
    """
    if log.statistics.valid:
        return False
    reason = log.statistics.reason
    only_losses = reports_only_losses(reason)
    if lossy is LossyLogs.ACCEPTED and only_losses:
        _LOG.warning(
            "%s has lost %s: its samples are left out, and nothing of it is written back",
            log.path,
            reason,
        )
        return True
    remedy = "record it again"
    if only_losses:
        remedy += "; or use it anyway with --accept-losses"
    raise RunInvalid(
        str(log.path),
        found=f"a run that its recorder marked invalid ({reason or 'no reason given'})",
        expected="a valid run",
        remedy=remedy,
    )


def run_from_log(log: Log, cell: Cell, lossy: LossyLogs = LossyLogs.REFUSED) -> Run:
    """Convert a log to SI.

    Raises:
        RunInvalid: its recorder marked it invalid.
        CyclesLost: SYNC cycles are missing.
        ClockImplausible: the time stamps show another rate, or one of them is early or late.
        CurrentSaturated: a limit was active in more than a tenth of an axis's samples.
        PositionImplausible: positions far outside the joint limits, a step or a speed that no motor
            makes, or readings of a position that are none and that nothing mends
            (`ident.data.channel_faults`).
        CurrentImplausible: likewise of a current, or it is an outlier.
        LogIncomplete: cell and log do not belong together.
        ident.CurrentUnsigned: drives report the size of the current only.
    """
    name = log.path.stem
    samples = log.samples
    rate_hz = log.head.run.rate_hz
    accepted = _has_accepted_losses(log, lossy)
    checks = SampleChecks(log.path)
    checks.take(samples)
    lost = checks.fault(rate_hz)
    if lost is not None:
        raise lost
    scale = scaling(cell, log.head.readback)
    motor_counts = continuous_counts(samples.position_counts, log.head.readback)
    position_rad = scale.joint_position(motor_counts)
    limited = limit_active(cell, samples.statusword)
    limited_percent = 100.0 * limited.mean(axis=0)
    _require_current_below_limit(log, cell, limited_percent)
    answered = answers(samples.missing, len(cell.axes))
    valid = answered & ~limited
    current = samples.current_raw * scale.current_per_unit
    known = scale.joints_known(answered)
    every_fault = find_faults(position_rad, current, rate_hz, cell.ratio)
    faults = faults_in_use(every_fault, known)
    check_limits(str(log.path), position_rad, cell, valid)
    fault = motion_fault(str(log.path), cell, rate_hz, position_rad, current, known, faults)
    if fault is not None:
        raise fault
    run = log.head.run
    cycles = samples.cycle - samples.cycle[0]
    started_s = float(samples.time_ns[0]) * 1e-9
    converted = Run(
        name=name,
        time_s=cycles.astype(np.float64) / rate_hz,
        position_rad=position_rad,
        current_a=current,
        payload=run.payload,
        move=moves(log.events, samples.time_ns),
        digest=log.digest,
        valid=valid,
        started_s=started_s if run.has_clock else None,
        partial=log.partial or accepted,
        temperature_c=temperatures(log),
        torque_channels=torque_channels(log, cell, current, valid),
        recording=_recording_of(log, limited_percent),
        judged_channels=JudgedChannels(position_rad, current, cell.ratio, every_fault),
    )
    if unsigned_currents(converted, cell.ratio).any():
        from ident.estimators.diagnosis import require_explained_currents  # noqa: PLC0415 - needs scipy, seldom

        require_explained_currents(converted, model_of(cell), cell.conditioning, cell.axis_names)
    return converted


def _require_current_below_limit(log: Log, cell: Cell, limited_percent: FloatArray) -> None:
    """Refuse a log with a limit active in too many samples of an axis.

    Raises:
        CurrentSaturated: a limit was active in more than LARGEST_SATURATED of them.
    """
    worst = int(np.argmax(limited_percent))
    largest_percent = 100.0 * LARGEST_SATURATED
    if limited_percent[worst] > largest_percent:
        active_percent = format_at_limit(limited_percent[worst], largest_percent, 1)
        raise CurrentSaturated(
            f"{log.path}, axis {cell.axes[worst].name}",
            found=f"a limit active in {active_percent} % of the samples",
            expected=f"at most {largest_percent:g} %",
            remedy="plan slower moves, or a smaller payload",
        )


def _recording_of(log: Log, limited_percent: FloatArray) -> Recording:
    """Return what a log says of its recording."""
    run = log.head.run
    serials = [_serial(axis.drive) for axis in log.head.readback.axes]
    recorded_s = None
    if run.started_wall_ns:  # an import without the time of day writes 0
        recorded_s = run.started_wall_ns * 1e-9
    return Recording(
        recorded_s=recorded_s,
        entered_kg=run.entered_kg,
        serials=tuple(serials),
        saturated_percent=tuple(limited_percent.tolist()),
        lost_cycles=log.statistics.lost_cycles,
        missing=log.statistics.missing,
        controller_sha256=run.controller_sha256,
        operator=run.operator or None,
    )


def limit_active(cell: Cell, statusword: NDArray[np.uint16]) -> BoolArray:
    """Return whether a limit of each axis's current was active, shape (k, n), from its statuswords,
    shape (k, n).
    """
    masks = []
    for axis in cell.axes:
        if axis.profile is None:
            bit = None
        else:
            bit = axis.profile.saturation_bit
        masks.append(0 if bit is None else 1 << bit)
    limit_bits = statusword & np.array(masks, dtype=np.uint16)
    return np.asarray(limit_bits != 0, dtype=np.bool_)


def answers(missing: NDArray[np.uint32], axes: int) -> BoolArray:
    """Return whether each axis answered in each cycle, shape (k, n),
    from the bits of those that did not.
    """
    bits = np.arange(axes, dtype=np.uint32)
    is_missing = missing[:, None] >> bits & 1
    return np.asarray(is_missing == 0, dtype=np.bool_)


def continuous_counts(position_counts: RawArray, readback: Readback) -> IntArray:
    """Return positions without the wraps of an encoder's counter, shape (k, n)."""
    is_counter = [axis.position_rad_per_count is None for axis in readback.axes]
    return np.where(is_counter, unwrapped(position_counts), position_counts)


def _serial(drive: Mapping[str, Any]) -> int | None:
    """Serial number of an amplifier (1018h:04, 32 bits); None if it reported none."""
    serial = drive.get("serial")
    if type(serial) is int and 0 <= serial < 2**32:
        return serial
    return None


def moves(events: tuple[CellEvent, ...], time_ns: IntArray) -> IntArray | None:
    """Return the number of the move of each sample, shape (k,); None in a log without moves.

    A move lasts until the next one starts, so the standstill between two moves belongs to the
    first. Samples before the first start belong to the first move.
    """
    starts = [(event.time_ns, event.code) for event in events if event.kind is EventKind.MOVE_START]
    if not starts:
        return None
    number: IntArray
    begin_ns, number = np.array(sorted(starts), dtype=np.int64).T
    begun = np.searchsorted(begin_ns, time_ns, side="right")
    return number[np.maximum(begun - 1, 0)]


def readings_by_axis(
    readings: Iterable[SlowReading], quantity: Quantity
) -> dict[int, tuple[IntArray, FloatArray]]:
    """Return times [ns] and values of the readings of a quantity, in the order of time,
    by the index of their axis.
    """
    found = defaultdict(list)
    for reading in readings:
        if reading.quantity is quantity:
            found[reading.axis].append((reading.time_ns, reading.value))
    series = {}
    for axis, own in found.items():
        stamps, values = zip(*sorted(own), strict=True)
        stamps_ns = np.array(stamps, dtype=np.int64)
        series[axis] = stamps_ns, np.array(values, dtype=np.float64)
    return series


def temperatures(log: Log) -> FloatArray | None:
    """Return the temperature of each axis at each sample [°C], shape (k, n);
    None in a log without any.

    It is interpolated between readings, and constant before the first and after the last; NaN for
    an axis without. A reading that no motor has, such as of a broken sensor, is left out.
    """
    readings = readings_by_axis(log.readings, Quantity.TEMPERATURE)
    if not readings:
        return None
    first_ns = log.samples.time_ns[0]
    since_ns = log.samples.time_ns - first_ns
    celsius = np.full(log.samples.position_counts.shape, np.nan)
    least, largest = TEMPERATURES_C
    for axis, (at_ns, values) in readings.items():
        possible = (values >= least) & (values <= largest)
        if np.any(possible):
            at_possible_ns = at_ns[possible] - first_ns
            celsius[:, axis] = np.interp(since_ns, at_possible_ns, values[possible])
    return celsius


def torque_channels(
    log: Log, cell: Cell, current: FloatArray, valid: BoolArray
) -> tuple[TorqueChannel, ...]:
    """Return each axis's own torque with its current, one channel an axis;
    none in a log without torques.

    The current is the mean over AVERAGED_S around the reading, because an SDO shows only within
    some milliseconds when the drive read its torque; the current nearby is the mean over NEARBY_S
    before and after it.

    Args:
        log: with the readings.
        cell: its drive train leads from the motors to the joints.
        current: recorded currents in the gains' unit, shape (k, n).
        valid: samples that may be used, shape (k, n).
    """
    readings = readings_by_axis(log.readings, Quantity.TORQUE)
    if not readings:
        return ()
    time_ns = log.samples.time_ns
    rate_hz = log.head.run.rate_hz
    half = round(AVERAGED_S * rate_hz)
    near = max(half + 1, round(NEARBY_S[0] * rate_hz))
    far = max(half + 2, round(NEARBY_S[1] * rate_hz))
    sums = np.zeros((2, len(current) + 1, len(cell.axes)))
    np.cumsum((current, valid), axis=1, out=sums[:, 1:])
    channels = []
    none = np.empty(0, dtype=np.int64), np.empty(0)
    for axis, reduction in enumerate(DriveTrain(cell.ratio).reduction):
        at_ns, values = readings.get(axis, none)
        row = np.searchsorted(time_ns, at_ns - round(0.5e9 / rate_hz))
        inside = (row >= far) & (row + far < len(time_ns))
        row = row[inside]
        at_ns = at_ns[inside]
        axis_sums = sums[:, :, axis]
        at_reading = _window_means(axis_sums, row - half, row + half + 1)
        before = _window_means(axis_sums, row - far, row - near)
        after = _window_means(axis_sums, row + near + 1, row + far + 1)
        # Every sample of the three windows is valid.
        usable = at_reading[1] + before[1] + after[1] == 3.0
        nearby_a = 0.5 * (before[0] + after[0])
        motor_torque_nm = values[inside][usable]
        channel = TorqueChannel(
            time_s=(at_ns[usable] - time_ns[0]) * 1e-9,
            current_a=at_reading[0, usable],
            nearby_a=nearby_a[usable],
            torque_nm=float(reduction) * motor_torque_nm,
        )
        channels.append(channel)
    return tuple(channels)


def _window_means(sums: FloatArray, first: IntArray, end: IntArray) -> FloatArray:
    """Return means over the rows from `first` up to `end`, shape (2, m), from the sums of all rows
    before each, shape (2, k + 1).
    """
    return np.asarray((sums[:, end] - sums[:, first]) / (end - first))


def check_limits(
    name: str, position_rad: FloatArray, cell: Cell, valid: BoolArray | None = None
) -> None:
    """Refuse positions that no joint of this cell can have.

    Args:
        name: name of the recording in the message.
        position_rad: joint positions [rad; m of a prismatic joint], shape (k, n).
        cell: cell with the limits.
        valid: samples to check, shape (k, n).

    Raises:
        PositionImplausible: a joint is outside its limits by more than 5 % of its range.
    """
    for index, axis in enumerate(cell.axes):
        if valid is None:
            column = position_rad[:, index]
        else:
            column = position_rad[valid[:, index], index]
        lower, upper = axis.limits.position
        margin = LIMIT_MARGIN * (upper - lower)
        if not column.size:
            continue
        lowest = float(column.min())
        highest = float(column.max())
        if lowest < lower - margin or highest > upper + margin:
            unit = axis.unit
            if unit is DEGREE:
                confused = "degrees were taken for radians"
            else:
                confused = "mm were taken for m"
            remedy = (
                f"most likely {confused} (or counts for either); else check motor or joint side, "
                "ratio and zero offset"
            )
            least = lower - margin - lowest
            most = upper + margin - highest
            if least <= most:  # as many as the joint can make, from another zero
                if unit is DEGREE:
                    key = "zero_offset_deg"
                else:
                    key = "zero_offset_mm"
                smallest_move = least / unit.si
                largest_move = most / unit.si
                remedy = (
                    f"most likely the zero is wrong: moved by {smallest_move:+.0f} to "
                    f"{largest_move:+.0f} {unit.name}, these positions are within the limits; "
                    f"correct `{key}` of {axis.name} in the cell file, or the zero in the "
                    "controller; else check motor or joint side, ratio and units"
                )
            lower_limit = lower / unit.si
            lowest_found = lowest / unit.si
            raise PositionImplausible(
                f"{name}, axis {axis.name}",
                found=f"joint positions from {lowest_found:.5g} to {unit.spell(highest)}",
                expected=f"{lower_limit:.5g} to {unit.spell(upper)}, the limits in the cell "
                "configuration",
                remedy=remedy,
            )


def unwrapped(counts: RawArray, before: tuple[RawArray, IntArray] | None = None) -> IntArray:
    """Unwrap the positions of a 32 bit encoder counter, shape (k, n).

    A jump of more than half the range between two samples is a wrap: no motor makes 2³¹ counts in
    one period.

    Args:
        counts: positions of k samples, shape (k, n).
        before: raw and unwrapped position of the sample before them, shape (n,) each; None at the
            start of a log.
    """
    if before is None:
        last = counts[0]
        total = counts[0].astype(np.int64)
    else:
        last, total = before
    # The difference in 32 bits is the step of less than half the range, whether the counter wrapped
    # or not.
    words = np.concatenate((last[None, :], counts)).astype(np.int32).view(np.uint32)
    steps = np.diff(words, axis=0).view(np.int32)
    return np.asarray(total + steps.cumsum(axis=0, dtype=np.int64), dtype=np.int64)
