"""Convert files of other controllers to logs.

A log holds int32. If the files hold angles, the count of each axis is the smallest power of two with which the largest
value still fits. The rounding error, half a count, is then at most 4.7e-10 of that value, and a power of two scales
without a rounding error of its own: raw = round(value / count).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil, log2, pi
from pathlib import Path

import numpy as np

from daq.config.cell import MILLIMETRE, Cell
from daq.config.cell_file import bundle, load_cell
from daq.config.import_description import (
    ImportDescription,
    PositionUnit,
    ScaledColumns,
    Side,
    TemperatureColumns,
    VelocityUnit,
    load_import,
)
from daq.errors import ConfigurationInconsistent, PositionImplausible, TableUnfit
from daq.log.conversion import check_limits, scaling, unwrapped
from daq.log.formats import reader_of, with_columns
from daq.log.metadata import AxisReadback, Readback, RunInfo, RunStatistics, Timing
from daq.log.resampling import Clock, clock_of
from daq.log.table import Table
from daq.log.writer import NOTHING_KEPT, LogContent, LogWriter
from drivers.stream.sample import Quantity, Sample, SlowReading
from ident.arrays import FloatArray, IntArray
from ident.model.bodies import Payload

_LOG = logging.getLogger("drivegain")
LARGEST_RAW = 2**31 - 1
SMALLEST_MOTION = 0.02  #: Smallest motion of at least one joint, as a share of its range
LARGEST_OUTLIER = 1000.0
"""Largest current, in multiples of the 99th percentile of its column; a real peak is some ten times that."""
SPEED_MARGIN = 3.0
"""Largest speed, in multiples of the joint's velocity limit, which is often a guess; a wrong rate is off by more."""
SPEED_PERCENTILE = 99.9
"""Percentile of a run's speeds that is compared with the limit: a few outliers do not mean a wrong rate."""
SLOW_SHARE = 0.1
"""Share of the velocity limits; if no joint is ever faster, the real rate may be ten times the declared one."""
TORQUE_HZ, TEMPERATURE_HZ = 20.0, 1.0
"""Rates at which the controller's own torque and temperatures are kept: enough for a slope and for a warm-up."""
LARGEST_NUMBER = 1e12  #: Of a position, speed, current or torque in any unit
TEMPERATURES_C = (-60.0, 250.0)  #: Of a drive or a motor; kelvin above -23 °C are more
VELOCITY_WINDOW_S = 0.1  #: Time over which the ways by velocities and by positions are compared
STILL = 1e-3  #: Difference of speed that is no contradiction, as a share of the velocity limit
UNIX_NS = range(10**18, 3 * 10**18)  #: Stamps from 2001 to 2065 are since 1970; any others since some start
LATEST_NS = 9 * 10**18  #: The latest stamp that a log holds, roughly


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import."""

    statistics: RunStatistics  #: of the log
    timing: Timing | None  #: what the time stamps showed; None without a time column
    remarks: tuple[str, ...]  #: oddities of the files that were mended


def import_recording(
    description: Path, data: Path, out: Path, *, software: str, cell_path: Path | None = None
) -> Imported:
    """Convert the files that a description names to a log. The same input gives the same bytes: no clock is read.

    Args:
        description: the import description.
        data: folder of the files (CSV, MATLAB or bags) that the description names.
        out: the log to write; it does not exist after an error.
        software: name and version to put into the log.
        cell_path: cell file to use instead of the description's.

    Raises:
        ConfigurationError: description or cell are wrong, or contradict each other.
        TableUnfit, PositionImplausible: the files cannot be used.
        UsageError, OutputFailed: the log cannot be written.
    """
    wanted = load_import(description)
    path = cell_path or description.parent / wanted.cell
    cell = load_cell(path)
    wanted = with_columns(wanted, data, cell.axis_names)
    _check_cell(wanted, cell, description)
    files = _read_tables(wanted, data)
    _check_sizes(wanted, cell, files)
    table = files[wanted.position.file]
    position = table.take(wanted.position.columns)
    current = files[wanted.current.file].take(wanted.current.columns)
    _check_current(current, wanted, files[wanted.current.file])
    if wanted.position.unit is PositionUnit.COUNTS:
        _check_counts(position, wanted, table)
    clock = _clock(wanted, files)
    rate_hz = wanted.rate_hz if clock is None else clock.timing.rate_hz
    assert rate_hz is not None  # load_import requires one of the two
    if clock is not None:
        position = position[clock.row]
    counts, count_rad = _counts(wanted, cell, position, clock)
    factors = wanted.current.factors(cell.axis_names)
    raw, unit = quantise(_on_clock(current, clock) * np.array(factors))
    readback = Readback(
        tuple(
            AxisReadback(axis.name, float(unit[i]), None if count_rad is None else float(count_rad[i]))
            for i, axis in enumerate(cell.axes)
        )
    )
    scale = scaling(cell, readback)
    # As a fit reads them: the log keeps an encoder's counts as the counter had them, with its wraps.
    joint_rad = scale.joint_position(unwrapped(counts.astype(np.int32)) if count_rad is None else counts)
    check_limits(str(table.path), joint_rad, cell)
    _check_motion(str(table.path), joint_rad, cell)
    _check_speed(str(table.path), joint_rad, rate_hz, cell)
    _check_velocity(wanted, cell, files, clock, joint_rad, rate_hz)
    digests = {name: file.digest for name, file in files.items()}
    slow = _slow(wanted, cell, files, clock)
    started_ns, started_wall_ns, timing = _start(wanted, files, clock)
    run = RunInfo(
        run_id=f"import-{hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()[:16]}",
        rate_hz=rate_hz,
        payload=_payload(wanted, cell),
        operator=wanted.operator,
        software=software,
        started_wall_ns=started_wall_ns,
        started_monotonic_ns=started_wall_ns,
        origin=f"imported as {wanted.name} from " + ", ".join(f"{name} ({d[:12]})" for name, d in digests.items()),
        timing=timing,
    )
    content = LogContent.of(cell, run, bundle(path), readback)
    opened = False
    try:
        # A crash of an import loses no sample, so no clock is needed to flush in time.
        with LogWriter(out, content, scale.joint_position_of, clock_ns=lambda: 0, remedy=NOTHING_KEPT) as log:
            opened = True
            time_ns = (started_ns + np.rint(np.arange(len(counts)) * (1e9 / rate_hz)).astype(np.int64)).tolist()
            silent = (0,) * len(cell.axes)
            for cycle, row in enumerate(zip(time_ns, counts.tolist(), raw.tolist(), strict=True)):
                log.readings(_readings(slow, cycle, row[0]))
                log.write(Sample(cycle, row[0], tuple(row[1]), tuple(row[2]), silent))
            log.conclude(valid=True)
    except BaseException:
        if opened:
            log.part.unlink(missing_ok=True)
        raise
    return Imported(log.statistics, timing, tuple(remark for file in files.values() for remark in file.remarks))


def _read_tables(wanted: ImportDescription, data: Path) -> dict[str, Table]:
    """Read every file of the description with the reader of its kind."""
    tables = {}
    for name, columns in wanted.files().items():
        time = wanted.time if wanted.time is not None and wanted.time.file == name else None
        tables[name] = reader_of(data / name)(data / name, wanted, columns, time)
    if len({len(file.values) for file in tables.values()}) > 1:
        raise TableUnfit(
            ", ".join(str(file.path) for file in tables.values()),
            found=" and ".join(f"{len(file.values)} rows in {name}" for name, file in tables.items()),
            expected="as many in each",
            remedy="one of them ends early, or they are of different runs; export them again",
        )
    return tables


def _clock(wanted: ImportDescription, files: dict[str, Table]) -> Clock | None:
    """Return the clock of the time column, None without one."""
    if wanted.time is None:
        return None
    return clock_of(files[wanted.time.file], wanted.time, np.hstack([file.values for file in files.values()]))


def _on_clock(values: FloatArray, clock: Clock | None) -> FloatArray:
    """Move columns of the file, shape (rows, n), to the samples of the log, shape (k, n)."""
    return values if clock is None else clock.currents(values[clock.row])


def _slow(
    wanted: ImportDescription, cell: Cell, files: dict[str, Table], clock: Clock | None
) -> list[tuple[Quantity, int, FloatArray]]:
    """Return torques of the motors [Nm] and temperatures [°C] at every sample, each with its period in samples."""
    rate_hz = wanted.rate_hz if clock is None else clock.timing.rate_hz
    assert rate_hz is not None
    found = []
    if (torque := wanted.torque) is not None:
        factors = np.array(torque.factors(cell.axis_names))
        values = _on_clock(files[torque.file].take(torque.columns), clock) * factors
        if torque.side is Side.JOINT:
            values = values @ np.linalg.inv(cell.ratio)  # τ_joint = Rᵀ τ_motor (eq. 24)
        found.append((Quantity.TORQUE, max(1, round(rate_hz / TORQUE_HZ)), values))
    if (temperature := wanted.temperature) is not None:
        values = _on_clock(files[temperature.file].take(temperature.columns), clock)
        found.append((Quantity.TEMPERATURE, max(1, round(rate_hz / TEMPERATURE_HZ)), values))
    return found


def _readings(slow: list[tuple[Quantity, int, FloatArray]], cycle: int, time_ns: int) -> Iterator[SlowReading]:
    """Yield the slow readings of a sample, where one of their periods begins."""
    for quantity, every, values in slow:
        if cycle % every == 0:
            for axis, value in enumerate(values[cycle].tolist()):
                yield SlowReading(time_ns, axis, quantity, value)


def _start(wanted: ImportDescription, files: dict[str, Table], clock: Clock | None) -> tuple[int, int, Timing | None]:
    """Return the first stamp of the log and the time of day [ns; 0 where unknown], and the timing with the former.

    Raises:
        TableUnfit: the first stamp is later than a log can hold.
    """
    if wanted.time is None or clock is None:
        return 0, 0, None
    file = files[wanted.time.file]
    assert file.stamps is not None  # clock_of has used them
    first_ns = file.stamps.first_ns
    if first_ns >= LATEST_NS:
        raise TableUnfit(
            file.place(0, wanted.time.column),
            found=f"a stamp of {first_ns * 1e-9:.4g} s",
            expected="seconds since 1970, or since some start",
            remedy="correct `unit` of `time` in the import description: is it ms, us or ns?",
        )
    if first_ns < 0:
        return 0, 0, clock.timing
    return first_ns, first_ns if first_ns in UNIX_NS else 0, replace(clock.timing, started_s=first_ns * 1e-9)


def quantise(values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Round values to integers of at most 31 bits, times a power of two for each column.

    Args:
        values: finite numbers, shape (k, n).

    Returns:
        raw, shape (k, n), and quantum, shape (n,), with |values − raw · quantum| ≤ quantum / 2 and
        quantum ≤ 2 / (2³¹ − 1) of the largest magnitude of the column.
    """
    largest = np.abs(values).max(axis=0)
    exponent = [ceil(log2(top / LARGEST_RAW)) if top > 1e-200 else -30 for top in largest.tolist()]
    quantum = np.ldexp(1.0, np.array(exponent))
    return np.rint(values / quantum).astype(np.int64), quantum


def _check_sizes(wanted: ImportDescription, cell: Cell, files: dict[str, Table]) -> None:
    """Refuse numbers that no robot has in any unit: the file is damaged, or a column is another."""
    for key, section in wanted.sections():
        table, size = files[section.file], LARGEST_NUMBER
        values, least, largest = table.take(section.columns), -size, size
        if isinstance(section, TemperatureColumns):
            least, largest = TEMPERATURES_C
        if isinstance(section, ScaledColumns):
            with np.errstate(over="ignore"):
                values = values * np.array(section.factors(cell.axis_names))
        wrong = np.argwhere(~((least <= values) & (values <= largest)))
        if wrong.size:
            row, column = wrong[0].tolist()
            raise TableUnfit(
                table.place(row, section.columns[column]),
                found=f"{values[row, column]:g}, as {key}",
                expected=f"from {least:g} to {largest:g}",
                remedy="correct the number, or the columns or the factor of that section in the import description",
            )


def _check_counts(position: FloatArray, wanted: ImportDescription, file: Table) -> None:
    """Refuse counts that are no whole numbers of 32 bits."""
    wrong = np.argwhere((position != np.rint(position)) | (np.abs(position) > LARGEST_RAW))
    if wrong.size:
        row, column = wrong[0].tolist()
        raise TableUnfit(
            file.place(row, wanted.position.columns[column]),
            found=f"{position[row, column]!r}",
            expected="a whole number of encoder counts of at most 31 bits",
            remedy="correct `unit` in the import description",
        )


def _counts(
    wanted: ImportDescription, cell: Cell, position: FloatArray, clock: Clock | None
) -> tuple[IntArray, FloatArray | None]:
    """Return motor counts and the motor angle of a count [rad], None if the counts are the encoder's.

    Between two samples the encoder's count is not a whole number: resampled counts are stored as angles, much finer,
    so that they are not rounded a second time.
    """
    resampled = clock is not None and clock.timing.resampled
    if wanted.position.unit is PositionUnit.COUNTS:
        if not resampled:
            return position.astype(np.int64), None
        turn = np.array([axis.counts_per_revolution for axis in cell.axes], dtype=np.float64)
        position = unwrapped(position.astype(np.int32)) * (2.0 * pi / turn)
    elif wanted.position.unit in {PositionUnit.DEG, PositionUnit.MM}:
        # On the joint side a prismatic axis is in mm; on the motor side everything is an angle.
        units = [axis.unit.si if wanted.position.side is Side.JOINT else pi / 180.0 for axis in cell.axes]
        position = position * np.array(units)
    if wanted.position.side is Side.JOINT:
        # Zero is that of the controller; `zero_offset_deg` leads from there to the URDF's.
        position = position @ cell.ratio.T
    return quantise(position if clock is None else clock.positions(position))


def _payload(wanted: ImportDescription, cell: Cell) -> Payload | None:
    if wanted.payload is None:
        return None
    matches = [p for p in cell.payloads if p.name == wanted.payload and wanted.mounting in {None, p.mounting}]
    if len(matches) == 1:
        return matches[0].payload
    known = ", ".join(f"{p.name} at {p.mounting}" for p in cell.payloads) or "none"
    raise ConfigurationInconsistent(
        f"import description {wanted.name!r}",
        found=f"payload {wanted.payload!r}" + (f", mounting {wanted.mounting!r}" if wanted.mounting else ""),
        expected=f"one of the cell's ({known})",
        remedy="`payload: NAME` and, if needed, `mounting: NAME`, as in the cell file",
    )


def _check_cell(wanted: ImportDescription, cell: Cell, description: Path) -> None:
    n = len(cell.axes)
    for key, section in wanted.sections():
        if len(section.columns) != n:
            raise ConfigurationInconsistent(
                f"{description}: {key}.columns",
                found=f"{len(section.columns)} columns",
                expected=f"{n}, one for each axis of cell {cell.name!r}",
                remedy="correct the description, or choose the cell with --cell",
            )
        if isinstance(section, ScaledColumns) and section.factors(cell.axis_names) is None:
            raise ConfigurationInconsistent(
                f"{description}: {key}.factor",
                found=str(section.factor),
                expected=f"one for each of {', '.join(cell.axis_names)}",
                remedy="write a number for all axes, a list in their order, or a mapping from their names",
            )
    for axis in cell.axes:
        if axis.gain_unit not in {f"Nm/{wanted.current.unit}", f"N/{wanted.current.unit}"}:
            raise ConfigurationInconsistent(
                f"{description}: current.unit",
                found=f"{wanted.current.unit!r}, while the gain of axis {axis.name} is in {axis.gain_unit!r}",
                expected=f"current in {axis.gain_unit.partition('/')[2]!r}",
                remedy="state that unit, and `factor` to convert the numbers of the file to it",
            )
    if wanted.position.unit is PositionUnit.COUNTS and any(a.counts_per_revolution is None for a in cell.axes):
        raise ConfigurationInconsistent(
            f"{description}: position.unit",
            found="counts, and axes without counts_per_revolution",
            expected="counts_per_revolution for each axis of the cell",
            remedy="add it to the cell file",
        )
    lengths = {PositionUnit.M, PositionUnit.MM, VelocityUnit.M, VelocityUnit.MM}
    for key, moved in (("position", wanted.position), ("velocity", wanted.velocity)):
        turning = [axis.name for axis in cell.axes if axis.unit is not MILLIMETRE]
        if moved is not None and moved.unit in lengths and (turning or moved.side is Side.MOTOR):
            raise ConfigurationInconsistent(
                f"{description}: {key}.unit",
                found=f"{moved.unit.value}, while {'axis ' + turning[0] if turning else 'a motor'} turns",
                expected="rad or deg (m or mm for the prismatic axes among them), or counts",
                remedy="correct the unit; convert the columns of the file to it",
            )
    _payload(wanted, cell)


def _check_velocity(
    wanted: ImportDescription,
    cell: Cell,
    files: dict[str, Table],
    clock: Clock | None,
    joint_rad: FloatArray,
    rate_hz: float,
) -> None:
    """Compare velocity columns with the positions, by the way moved in VELOCITY_WINDOW_S: it needs no derivative."""
    if (velocity := wanted.velocity) is None:
        return
    stated = _on_clock(files[velocity.file].take(velocity.columns), clock)
    if velocity.unit in {VelocityUnit.DEG, VelocityUnit.MM}:
        units = [axis.unit.si if velocity.side is Side.JOINT else pi / 180.0 for axis in cell.axes]
        stated = stated * np.array(units)
    if velocity.side is Side.MOTOR:
        stated = stated @ np.linalg.inv(cell.ratio).T
    step = min(max(1, round(VELOCITY_WINDOW_S * rate_hz)), len(stated) - 1)
    summed = np.cumsum(0.5 * (stated[1:] + stated[:-1]) / rate_hz, axis=0)
    summed = np.vstack((np.zeros_like(stated[:1]), summed))
    expected, moved = (values[step:] - values[:-step] for values in (summed, joint_rad))
    still = np.array([STILL * axis.limits.velocity for axis in cell.axes]) * step / rate_hz
    error, size = (np.sqrt(np.mean(values**2, axis=0)) for values in (expected - moved, moved))
    for index in np.flatnonzero(error > velocity.tolerance * size + still).tolist():
        way, stated_way = moved[:, index], expected[:, index]
        ratio = float(way @ stated_way) / max(float(stated_way @ stated_way), 1e-300)
        raise TableUnfit(
            f"{files[velocity.file].path}, column {velocity.columns[index]}, axis {cell.axes[index].name}",
            found=f"positions that move {ratio:.3g} times as fast as this velocity says, and differ from it by "
            f"{100.0 * float(error[index]) / max(float(size[index]), 1e-300):.3g} %",
            expected=f"velocities that agree with the positions to {100.0 * velocity.tolerance:g} %",
            remedy="check `unit` and `side` of both, the order of their columns, and the rate or the unit of the time; "
            "or leave `velocity` out",
        )


def _check_current(current: FloatArray, wanted: ImportDescription, file: Table) -> None:
    """Refuse outliers: one absurd number would make the count of its column so coarse that the others become zero."""
    size = np.abs(current)
    usual = np.percentile(size, 99.0, axis=0)
    for index, column in enumerate(wanted.current.columns):
        row = int(np.argmax(size[:, index]))
        if size[row, index] == 0.0:
            raise TableUnfit(
                f"{file.path}, column {column}",
                found="zero in every row",
                expected="the current reference of a motor that moves",
                remedy="is the channel connected, and the column the right one?",
            )
        if size[row, index] > LARGEST_OUTLIER * max(usual[index], 1e-200):
            raise TableUnfit(
                file.place(row, column),
                found=f"{current[row, index]:.6g}, while 99 % of the column are within {usual[index]:.3g}",
                expected="a current",
                remedy="samples are never invented: cut the recording there, or export it again",
            )


def _check_speed(name: str, joint_rad: FloatArray, rate_hz: float, cell: Cell) -> None:
    """Refuse implausible speeds. A wrong rate scales them all; over many samples they are far above the noise."""
    step = max(1, min(round(0.1 * rate_hz), len(joint_rad) // 10))
    speeds = np.abs(joint_rad[step:] - joint_rad[:-step]) * rate_hz / step
    fastest = np.percentile(speeds, SPEED_PERCENTILE, axis=0)
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    for axis, speed, limit in zip(cell.axes, fastest.tolist(), limits.tolist(), strict=True):
        if speed > SPEED_MARGIN * limit:
            raise TableUnfit(
                f"{name}, axis {axis.name}",
                found=f"{axis.unit.spell(speed)}/s over {step} samples at {rate_hz:g} Hz",
                expected=f"at most {axis.unit.spell(limit)}/s, the limit in the cell configuration",
                remedy="most likely rate_hz is too high, or the unit of the time column or of the positions is another",
            )
    share = float((fastest / limits).max())
    if share < SLOW_SHARE:
        _LOG.warning(
            "warning: %s: at %g Hz no joint is faster than %.2g %% of its velocity limit; is the rate of the recording "
            "right? A rate that is too low falsifies inertias without any other sign, and moves that slow do not "
            "identify them.",
            name,
            rate_hz,
            100.0 * share,
        )


def _check_motion(name: str, joint_rad: FloatArray, cell: Cell) -> None:
    """Refuse runs without motion: radians taken for degrees shrink it 57 times, which limits do not reveal."""
    ranges = [axis.limits.position[1] - axis.limits.position[0] for axis in cell.axes]
    share = np.ptp(joint_rad, axis=0) / np.array(ranges)
    if share.max() < SMALLEST_MOTION:
        raise PositionImplausible(
            name,
            found=f"motion over at most {100.0 * share.max():.2g} % of any joint's range",
            expected=f"at least {100.0 * SMALLEST_MOTION:g} % on one joint",
            remedy="most likely radians were taken for degrees, or joint for motor side; correct the description",
        )
