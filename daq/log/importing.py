"""Convert files of other controllers to logs.

A log holds int32. If the files hold angles, the count of each axis is the smallest power of two
with which the largest value still fits. The rounding error, half a count, is then at most 4.7e-10
of that value, and a power of two scales without a rounding error of its own: raw = round(value /
count).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from math import ceil, log2, pi
from pathlib import Path

import numpy as np

from daq.config.cell import MILLIMETRE, Cell
from daq.config.cell_file import bundle, load_cell
from daq.config.import_description import (
    Column,
    CsvLayout,
    ImportDescription,
    KeptPart,
    PositionUnit,
    ScaledColumns,
    Section,
    Side,
    TemperatureColumns,
    VelocityUnit,
    load_import,
)
from daq.errors import ConfigurationInconsistent, TableUnfit, UsageError
from daq.files import sha256
from daq.log.bag_file import SQLITE_MAGIC, first_bytes
from daq.log.bag_table import FIELDS, read_bag
from daq.log.column_faults import UsedRows, fault_remarks, require_mendable, sound_columns
from daq.log.container import MAGIC
from daq.log.conversion import SiScaling, check_limits, scaling, unwrapped
from daq.log.csv_table import read_csv
from daq.log.mat_table import read_mat
from daq.log.mcap_bag import ZSTD_MAGIC
from daq.log.metadata import AxisReadback, Readback, RunInfo, RunStatistics, Timing
from daq.log.plausibility import (
    LARGEST_RAW,
    check_counts,
    check_current,
    check_motion,
    check_sizes,
    check_speed,
    check_steps,
    check_velocity,
    counting_signs,
    in_si,
    require_changing,
    require_own_columns,
    signed_counts,
    warn_of_unsigned,
)
from daq.log.resampling import Clock, clock_of, on_clock
from daq.log.ros1_bag import ROS_1_MAGIC
from daq.log.table import ROW_MARGIN, Reader, Table, compare_stamps, rows_at_rate, section_values
from daq.log.writer import LogContent, LogWriter
from drivers.messages import Quantity, Sample, SlowReading
from ident.arrays import FloatArray, IntArray
from ident.data.channel_faults import ChannelFault
from ident.model.bodies import Payload

FEWEST_ROWS = 3  #: Rows of a recording; fewer have neither a rate nor a motion
TORQUE_HZ = 20.0
TEMPERATURE_HZ = 1.0
"""Rates at which the controller's own torque and temperatures are kept:
enough for a slope and for a warm-up.
"""
#: Stamps from 2001 to 2065 are since 1970; any others since some start
UNIX_NS = range(10**18, 3 * 10**18)


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import."""

    statistics: RunStatistics  #: of the log
    timing: Timing | None  #: what the time stamps showed; None without a time column
    remarks: tuple[str, ...]  #: oddities of the files that were mended
    holdout: RunStatistics | None = None  #: of the log of the held-out part; None without one


def import_recording(
    description: Path,
    data: Path,
    out: Path,
    *,
    software: str,
    cell_path: Path | None = None,
    holdout: Path | None = None,
) -> Imported:
    """Convert the files that a description names to a log.

    The same input gives the same bytes: no clock is read.

    Args:
        description: the import description.
        data: folder of the files (CSV, MATLAB or bags) that the description names.
        out: the log to write; it does not exist after an error.
        software: name and version to put into the log.
        cell_path: cell file to use instead of the description's.
        holdout: likewise, the log of the held-out part; None where the description has none.

    Raises:
        ConfigurationError: description or cell are wrong, or contradict each other.
        TableUnfit, PositionImplausible: the files cannot be used.
        UsageError, OutputFailed: a log cannot be written.
    """
    wanted = load_import(description)
    _require_name_of_holdout(wanted, holdout)
    if holdout is not None and os.path.realpath(holdout) == os.path.realpath(out):
        raise UsageError(
            str(holdout),
            found="one name for both logs",
            expected="a name for each of them",
            remedy="give `--holdout` another name than `--out`",
        )
    path = cell_path or description.parent / wanted.cell
    cell = load_cell(path)
    wanted = with_columns(wanted, data, cell.axis_names)
    _check_cell(wanted, cell, description)
    wanted = in_order_of_axes(wanted, cell.axis_names)
    files = _read_tables(wanted, data)
    check_sizes(wanted, cell, files)
    recorded = _recorded(wanted, cell, files)
    rate_hz = recorded.used.rate_hz
    digests = {name: file.digest for name, file in files.items()}
    started_ns, started_wall_ns, timing = _start(wanted, files, recorded.clock)
    sources = ", ".join(f"{name} ({d[:12]})" for name, d in digests.items())
    all_digests = repr(sorted(digests.items())).encode()
    payload = _payload(wanted, cell)
    run = RunInfo(
        run_id=f"import-{sha256(all_digests)[:16]}",
        rate_hz=rate_hz,
        payload=payload,
        operator=wanted.operator,
        software=software,
        started_wall_ns=started_wall_ns,
        started_monotonic_ns=started_wall_ns,
        origin=f"imported as {wanted.name} from " + sources,
        timing=timing,
    )
    slow = _slow(wanted, cell, files, recorded.clock, rate_hz)
    samples = _LogSamples(cell, bundle(path), recorded.kept, slow, run, started_ns)
    rows = range(len(recorded.kept.counts))
    of_holdout = None
    if wanted.holdout is None or holdout is None:
        statistics = samples.write(out, rows)
    else:
        first = _first_of_holdout(wanted, wanted.holdout.from_s, rate_hz, len(rows))
        of_holdout = samples.write(holdout, rows[first:])
        try:
            statistics = samples.write(out, rows[:first])
        # An interrupt, too: one log without the other would look like a whole import.
        except BaseException:
            holdout.unlink()
            raise
    remarks: list[str] = []
    for file in files.values():
        remarks += file.remarks
    remarks += recorded.remarks
    remarks += fault_remarks(recorded.faults, recorded.used)
    return Imported(statistics, timing, tuple(remarks), of_holdout)


def _require_name_of_holdout(wanted: ImportDescription, holdout: Path | None) -> None:
    """Refuse a description with a held-out part that has no name,
    and a name without such a part.
    """
    if (wanted.holdout is None) == (holdout is None):
        return
    subject = f"import description {wanted.name!r}"
    if holdout is None:
        raise UsageError(
            subject,
            found="`holdout`, and no name for the log of that part",
            expected="a name for the second log",
            remedy="give `--holdout FILE`",
        )
    raise UsageError(
        subject,
        found="no `holdout`",
        expected="`holdout: {from_s: SECONDS}`, the begin of it",
        remedy=f"add it to the description, or leave out {holdout}",
    )


def _first_of_holdout(wanted: ImportDescription, from_s: float, rate_hz: float, count: int) -> int:
    """Return the first sample of the held-out part.

    Raises:
        TableUnfit: one of the parts has too few samples.
    """
    first = ceil(from_s * rate_hz - ROW_MARGIN)
    if FEWEST_ROWS <= first <= count - FEWEST_ROWS:
        return first
    imported_s = count / rate_hz
    raise TableUnfit(
        f"import description {wanted.name!r}: holdout.from_s",
        found=f"{from_s:g} s, of {imported_s:.6g} s that are imported",
        expected="a time in the recording, since its first sample",
        remedy="correct `holdout`",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _LogSamples:
    """Samples of a recording, all of which or a part go into a log."""

    cell: Cell
    files: Mapping[str, bytes]  #: the cell's bundle
    kept: Converted
    slow: list[tuple[Quantity, int, FloatArray]]
    run: RunInfo
    started_ns: int

    def write(self, out: Path, rows: range) -> RunStatistics:
        """Write some samples into a new log.

        Raises:
            UsageError, OutputFailed: the log cannot be written.
        """
        step_ns = 1e9 / self.run.rate_hz
        run = self._run_of(rows)
        readback = self.kept.readback
        content = LogContent.of(self.cell, run, self.files, readback)
        # A crash of an import loses no sample, so no clock is needed to flush in time.
        with LogWriter(
            out, content, self.kept.scale.joint_position_of, clock_ns=lambda: 0, keeps_part=False
        ) as log:
            silent = (0,) * len(self.cell.axes)
            counts = self.kept.counts[rows.start : rows.stop].tolist()
            current_raw = self.kept.current_raw[rows.start : rows.stop].tolist()
            for cycle, row in enumerate(rows):
                time_ns = self.started_ns + round(row * step_ns)
                log.readings(_readings(self.slow, row, time_ns))
                position = tuple(counts[cycle])
                current = tuple(current_raw[cycle])
                sample = Sample(cycle, time_ns, position, current, silent)
                log.write(sample)
            log.conclude(valid=True)
        return log.statistics

    def _run_of(self, rows: range) -> RunInfo:
        """Return the facts about a part of the recording."""
        if len(rows) == len(self.kept.counts):
            return self.run
        later_ns = round(rows.start * 1e9 / self.run.rate_hz)
        if self.run.started_wall_ns:
            wall_ns = self.run.started_wall_ns + later_ns
        else:
            wall_ns = 0
        timing = self.run.timing
        if timing is not None and timing.started_s is not None:
            timing = replace(timing, started_s=timing.started_s + later_ns * 1e-9)
        return replace(
            self.run,
            run_id=f"{self.run.run_id}-{rows.start}-{rows.stop}",
            started_wall_ns=wall_ns,
            started_monotonic_ns=wall_ns,
            origin=f"{self.run.origin}, samples {rows.start + 1} to {rows.stop}",
            timing=timing,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Converted:
    """Columns of a file as a log has them, and as a fit reads them."""

    counts: IntArray  #: positions of the motors, shape (k, n)
    current_raw: IntArray  #: shape (k, n)
    readback: Readback  #: with the unit of each
    scale: SiScaling
    joint_rad: FloatArray  #: positions of the joints [rad; m of a prismatic joint], shape (k, n)


@dataclass(frozen=True, slots=True, eq=False)
class JudgedRecording:
    """A recording that a robot can have made."""

    used: UsedRows
    clock: Clock | None  #: None without a time column
    kept: Converted  #: what the log is to hold
    faults: tuple[ChannelFault, ...]  #: readings that are none
    remarks: tuple[str, ...]  #: on what was mended besides


def _recorded(wanted: ImportDescription, cell: Cell, files: dict[str, Table]) -> JudgedRecording:
    """Judge and convert what the files hold.

    Raises:
        TableUnfit, PositionImplausible: the files cannot be used.
    """
    table = files[wanted.position.files[0]]
    position = section_values(wanted.position, files)
    current = section_values(wanted.current, files)
    require_changing(position, current, wanted, files)
    require_own_columns(wanted.position, position, files)
    require_own_columns(wanted.current, current, files)
    remarks: tuple[str, ...] = ()
    if wanted.position.unit is PositionUnit.COUNTS:
        position, remarks = signed_counts(position, wanted)
        check_counts(position, wanted, files)
    position = position * counting_signs(wanted.position.reversed, cell.axis_names)
    clock = None
    rate_hz = wanted.rate_hz
    row = np.arange(len(position))
    if wanted.time is not None:
        numbers = np.hstack([file.values for file in files.values()])
        clock = clock_of(files[wanted.time.file], wanted.time, numbers)
        rate_hz = clock.timing.rate_hz
        row = clock.row
    assert rate_hz is not None  # load_import requires one of the two
    time_s = None if clock is None else clock.time_s
    used = UsedRows(row, time_s, rate_hz, wanted, files, cell)
    check_current(current, wanted, files)
    sound = sound_columns(position, current, used)
    kept = _converted(wanted, cell, position[row], current, clock)
    joint_rad = kept.joint_rad
    if len(wanted.position.files) == 1:
        subject = str(table.path)
    else:
        subject = f"import description {wanted.name!r}"
    check_limits(subject, joint_rad, cell)
    check_motion(subject, joint_rad, cell)
    check_steps(wanted, files, joint_rad, rate_hz, clock, cell)
    require_mendable(sound.faults, used, displaced=True)
    check_speed(subject, joint_rad, rate_hz, cell)
    check_velocity(wanted, cell, files, clock, joint_rad, rate_hz)
    current_a = kept.current_raw * kept.scale.current_per_unit
    warn_of_unsigned(wanted.name, joint_rad, current_a, rate_hz, cell)
    is_resampled = clock is not None and clock.timing.resampled
    if sound.faults and is_resampled:
        # Where rows stay as they are, a fit mends them; a spline would spread what is wrong.
        kept = _converted(wanted, cell, sound.position[row], sound.current, clock)
    return JudgedRecording(used, clock, kept, sound.faults, remarks)


def _converted(
    wanted: ImportDescription,
    cell: Cell,
    position: FloatArray,
    current: FloatArray,
    clock: Clock | None,
) -> Converted:
    """Convert positions of the rows that are used, and currents of all rows."""
    counts, count_rad = _counts(wanted, cell, position, clock)
    factors = wanted.current.factors(cell.axis_names)
    scaled = on_clock(current, clock) * np.array(factors)
    raw, unit = quantise(scaled)
    axes = []
    for index, axis in enumerate(cell.axes):
        rad_per_count = None if count_rad is None else float(count_rad[index])
        axes.append(AxisReadback(axis.name, float(unit[index]), rad_per_count))
    readback = Readback(tuple(axes))
    scale = scaling(cell, readback)
    # As a fit reads them: the log keeps an encoder's counts as the counter had them, with its
    # wraps.
    continuous = counts
    if count_rad is None:
        continuous = unwrapped(counts.astype(np.int32))
    joint_rad = scale.joint_position(continuous)
    return Converted(counts, raw, readback, scale, joint_rad)


def _read_tables(wanted: ImportDescription, data: Path) -> dict[str, Table]:
    """Read every file of the description with the reader of its kind."""
    part = wanted.keep
    if part is not None and part.is_by_time and wanted.rate_hz is not None:
        rows = rows_at_rate(wanted.rate_hz, part)
        wanted = wanted.model_copy(update={"keep": _part_of_rows(rows)})
    read: dict[str, Table] = {}
    # The file with the stamps comes first: where times are kept, it says which rows of the others
    # these are.
    files = wanted.files()
    for name in sorted(files, key=lambda one: wanted.time is None or one != wanted.time.file):
        is_timed = wanted.time is not None and wanted.time.file == name
        if is_timed:
            time = wanted.time
        else:
            time = None
        path = data / name
        table = reader_of(path)(path, wanted, files[name], time)
        read[name] = table
        if time is not None and part is not None and part.is_by_time:
            end = table.first_row + len(table.values)
            rows = slice(table.first_row, end)
            wanted = wanted.model_copy(update={"keep": _part_of_rows(rows)})
    tables = {name: read[name] for name in files}
    counts = {len(file.values) for file in tables.values()}
    if len(counts) > 1:
        paths = [str(file.path) for file in tables.values()]
        row_counts = [f"{len(file.values)} rows in {name}" for name, file in tables.items()]
        raise TableUnfit(
            ", ".join(paths),
            found=" and ".join(row_counts),
            expected="as many in each",
            remedy="one of them ends early, or they are of different runs; export them again",
        )
    if wanted.time is not None:
        timed = tables[wanted.time.file]
        for name, table in tables.items():
            remarks = (*table.remarks, *compare_stamps(timed, table))
            tables[name] = replace(table, remarks=remarks)
    position = tables[wanted.position.files[0]]
    if len(position.values) < FEWEST_ROWS:
        raise TableUnfit(
            str(position.path),
            found=f"{len(position.values)} rows of numbers",
            expected="a row for each sample of a motion",
            remedy="was the export interrupted? export the recording again",
        )
    return tables


def _part_of_rows(rows: slice) -> KeptPart:
    """Return the part of a recording that has these rows, counted from 0."""
    return KeptPart(from_row=rows.start + 1, to_row=rows.stop)


def _slow(
    wanted: ImportDescription,
    cell: Cell,
    files: dict[str, Table],
    clock: Clock | None,
    rate_hz: float,
) -> list[tuple[Quantity, int, FloatArray]]:
    """Return torques of the motors [Nm] and temperatures [°C] at every sample,
    each with its period in samples.
    """
    found = []
    if (torque := wanted.torque) is not None:
        factors = np.array(torque.factors(cell.axis_names))
        values = on_clock(section_values(torque, files), clock) * factors
        if torque.side is Side.JOINT:
            values = values @ np.linalg.inv(cell.ratio)  # τ_joint = Rᵀ τ_motor (eq. 24)
        every = max(1, round(rate_hz / TORQUE_HZ))
        found.append((Quantity.TORQUE, every, values))
    if (temperature := wanted.temperature) is not None:
        values = on_clock(section_values(temperature, files), clock)
        every = max(1, round(rate_hz / TEMPERATURE_HZ))
        found.append((Quantity.TEMPERATURE, every, values))
    return found


def _readings(
    slow: list[tuple[Quantity, int, FloatArray]], cycle: int, time_ns: int
) -> Iterator[SlowReading]:
    """Yield the slow readings of a sample, where one of their periods begins."""
    for quantity, every, values in slow:
        if cycle % every == 0:
            for axis, value in enumerate(values[cycle].tolist()):
                yield SlowReading(time_ns, axis, quantity, value)


def _start(
    wanted: ImportDescription, files: dict[str, Table], clock: Clock | None
) -> tuple[int, int, Timing | None]:
    """Return the first stamp and the wall time of the log [ns], and its timing.

    Both times are 0 where they are unknown, and there is no timing then.
    """
    if wanted.time is None or clock is None:
        return 0, 0, None
    file = files[wanted.time.file]
    assert file.stamps is not None  # clock_of has used them
    first_ns = file.stamps.first_ns
    if first_ns < 0:
        return 0, 0, clock.timing
    timing = replace(clock.timing, started_s=first_ns * 1e-9)
    # Stamps that count from some other start say nothing of the time of day.
    wall_ns = first_ns if first_ns in UNIX_NS else 0
    return first_ns, wall_ns, timing


def _quantum_exponent(largest: float) -> int:
    """Return the power of two whose multiples up to LARGEST_RAW reach a magnitude."""
    if largest <= 1e-200:
        return -30
    return ceil(log2(largest / LARGEST_RAW))


def quantise(values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Round values to integers of at most 31 bits, times a power of two for each column.

    Args:
        values: finite numbers, shape (k, n).

    Returns:
        raw, shape (k, n), and quantum, shape (n,), with |values − raw · quantum| ≤ quantum / 2 and
        quantum ≤ 2 / (2³¹ − 1) of the largest magnitude of the column.
    """
    largest = np.abs(values).max(axis=0)
    exponents = [_quantum_exponent(top) for top in largest.tolist()]
    quantum = np.ldexp(1.0, np.array(exponents))
    raw = np.rint(values / quantum)
    return raw.astype(np.int64), quantum


def _counts(
    wanted: ImportDescription, cell: Cell, position: FloatArray, clock: Clock | None
) -> tuple[IntArray, FloatArray | None]:
    """Return motor counts and the motor angle of a count [rad],
    None if the counts are the encoder's.

    Between two samples the encoder's count is not a whole number: resampled counts are stored as
    angles, much finer, so that they are not rounded a second time.
    """
    resampled = clock is not None and clock.timing.resampled
    if wanted.position.unit is PositionUnit.COUNTS:
        if not resampled:
            return position.astype(np.int64), None
        turn = np.array([axis.counts_per_revolution for axis in cell.axes], dtype=np.float64)
        motor_counts = unwrapped(position.astype(np.int32))
        position = motor_counts * (2.0 * pi / turn)
    else:
        position = in_si(position, wanted.position, cell)
    if wanted.position.side is Side.JOINT:
        # Zero is that of the controller; `zero_offset_deg` leads from there to the URDF's.
        position = position @ cell.ratio.T
    return quantise(position if clock is None else clock.positions(position))


def _payload(wanted: ImportDescription, cell: Cell) -> Payload | None:
    if wanted.payload is None:
        return None
    matches = [
        p
        for p in cell.payloads
        if p.name == wanted.payload and wanted.mounting in {None, p.mounting}
    ]
    if len(matches) == 1:
        return matches[0].payload
    described = [f"{p.name} at {p.mounting}" for p in cell.payloads]
    known = ", ".join(described) or "none"
    raise ConfigurationInconsistent(
        f"import description {wanted.name!r}",
        found=f"payload {wanted.payload!r}"
        + (f", mounting {wanted.mounting!r}" if wanted.mounting else ""),
        expected=f"one of the cell's ({known})",
        remedy="`payload: NAME` and, if needed, `mounting: NAME`, as in the cell file",
    )


def _check_columns(wanted: ImportDescription, description: Path) -> None:
    """Refuse a column that is read as two quantities, or as that of two axes:
    one of them would be made up.
    """
    read: dict[tuple[Path, str], str] = {}
    if wanted.time is None:
        timed = []
    else:
        timed = [("time.column", wanted.time.file, wanted.time.column)]
    for key, section in wanted.sections():
        places = enumerate(section.places)
        timed += [(f"{key}.columns[{index}]", file, column) for index, (file, column) in places]
    for key, file, column in timed:
        first = read.setdefault((Path(file), str(column)), key)
        if first != key:
            raise ConfigurationInconsistent(
                f"{description}: {key}",
                found=f"column {column} of {file}, which is also {first}",
                expected="a column of its own for each quantity of each axis",
                remedy="correct `columns` in the import description",
            )


def _check_cell(wanted: ImportDescription, cell: Cell, description: Path) -> None:
    n = len(cell.axes)
    _check_columns(wanted, description)
    for key, section in wanted.sections():
        if len(section.places) != n:
            found = f"{len(section.places)} columns"
            expected = f"{n}, one for each axis of cell {cell.name!r}"
            raise ConfigurationInconsistent(
                f"{description}: {key}.columns",
                found=found,
                expected=expected,
                remedy="correct the description, or choose the cell with --cell",
            )
        reversed_axes = getattr(section, "reversed", ())
        others = [name for name in reversed_axes if name not in cell.axis_names]
        if others:
            axis_names = ", ".join(cell.axis_names)
            raise ConfigurationInconsistent(
                f"{description}: {key}.reversed",
                found=", ".join(others),
                expected=f"some of {axis_names}",
                remedy="name axes of the cell, or correct the cell with --cell",
            )
        if isinstance(section, ScaledColumns) and section.factors(cell.axis_names) is None:
            axis_names = ", ".join(cell.axis_names)
            raise ConfigurationInconsistent(
                f"{description}: {key}.factor",
                found=str(section.factor),
                expected=f"one for each of {axis_names}",
                remedy="write a number for all axes, a list in their order, or a mapping from "
                "their names",
            )
    units = wanted.current.units(cell.axis_names)
    if units is None:
        axis_names = ", ".join(cell.axis_names)
        raise ConfigurationInconsistent(
            f"{description}: current.unit",
            found=str(wanted.current.unit),
            expected=f"one for each of {axis_names}",
            remedy="write a unit for all axes, a list in their order, or a mapping from "
            "their names",
        )
    for axis, unit in zip(cell.axes, units, strict=True):
        known_units = {f"Nm/{unit}", f"N/{unit}"}
        if axis.gain_unit not in known_units:
            gain_current = axis.gain_unit.partition("/")[2]
            raise ConfigurationInconsistent(
                f"{description}: current.unit",
                found=f"{unit!r}, while the gain of axis {axis.name} is in {axis.gain_unit!r}",
                expected=f"current in {gain_current!r}",
                remedy="state that unit, and `factor` to convert the numbers of the file to it",
            )
    has_counts = all(axis.counts_per_revolution is not None for axis in cell.axes)
    if wanted.position.unit is PositionUnit.COUNTS and not has_counts:
        raise ConfigurationInconsistent(
            f"{description}: position.unit",
            found="counts, and axes without counts_per_revolution",
            expected="counts_per_revolution for each axis of the cell",
            remedy="add it to the cell file",
        )
    lengths = {PositionUnit.M, PositionUnit.MM, VelocityUnit.M, VelocityUnit.MM}
    turning = [axis.name for axis in cell.axes if axis.unit is not MILLIMETRE]
    for key, moved in (("position", wanted.position), ("velocity", wanted.velocity)):
        if moved is None or moved.unit not in lengths:
            continue
        if turning or moved.side is Side.MOTOR:
            turned = f"axis {turning[0]}" if turning else "a motor"
            raise ConfigurationInconsistent(
                f"{description}: {key}.unit",
                found=f"{moved.unit.value}, while {turned} turns",
                expected="rad or deg (m or mm for the prismatic axes among them), or counts",
                remedy="correct the unit; convert the columns of the file to it",
            )
    _payload(wanted, cell)


def in_order_of_axes(wanted: ImportDescription, axis_names: Sequence[str]) -> ImportDescription:
    """Return a description with units and factors in the order of the axes,
    where it has them by name.
    """
    changed: dict[str, Section] = {}
    units = wanted.current.units(axis_names)
    if units is None:
        current = wanted.current
    else:
        current = replace(wanted.current, unit=units)
    for key, section in (("current", current), ("torque", wanted.torque)):
        if section is None:
            factors = None
        else:
            factors = section.factors(axis_names)
        if section is not None and factors is not None:
            changed[key] = replace(section, factor=factors)
    return wanted.model_copy(update=changed)


def _source(place: tuple[str, Column], bags: Set[str]) -> tuple[Path, str]:
    """Return file and column, of a bag file and field."""
    file, column = place
    name = str(column)
    if file in bags:
        name = name.partition(".")[0]
    return Path(file), name


_HEADS: dict[bytes, Reader] = {
    MAGIC: read_bag,
    SQLITE_MAGIC: read_bag,
    ROS_1_MAGIC: read_bag,
    ZSTD_MAGIC: read_bag,
    b"MATLAB ": read_mat,
    b"\x89HDF\r\n": read_mat,
}
_SUFFIXES: dict[str, Reader] = {
    ".mcap": read_bag,
    ".db3": read_bag,
    ".bag": read_bag,
    ".mat": read_mat,
}


def reader_of(path: Path) -> Reader:
    """Return the reader of a file, or of a folder with the parts of a bag;
    the name decides if the content does not.
    """
    if path.is_dir():
        return read_bag
    head = first_bytes(path)
    for start, reader in _HEADS.items():
        if head.startswith(start):
            return reader
    return _SUFFIXES.get(path.suffix.lower(), read_csv)


def with_columns(
    wanted: ImportDescription, data: Path, axis_names: Sequence[str]
) -> ImportDescription:
    """Return a description with a column for each axis, where it names all of them at once.

    The columns of a bag may be joints; the section says which field is meant. A single column may
    be a whole field (`position`: its joints are called as the axes) or a whole matrix of a MATLAB
    file (`q`: a column for each axis).

    Raises:
        TableUnfit: a file is of a format that is not read, or a temperature is sought in a bag.
        ConfigurationInconsistent: torques are to be read from where the currents are, or a setting
            is for files of another kind.
    """
    changed: dict[str, Section] = {}
    bags = set[str]()
    for key, section in wanted.sections():
        readers = {file: reader_of(data / file) for file in section.files}
        bags |= {file for file, reader in readers.items() if reader is read_bag}
        if isinstance(section, TemperatureColumns) and bags.intersection(section.files):
            fields = ", ".join(FIELDS)
            path = data / section.files[0]
            raise TableUnfit(
                str(path),
                found="`temperature` from a ROS 2 bag",
                expected=f"a file with temperatures; joint states have {fields} alone",
                remedy="leave `temperature` out of the import description, or name a CSV or MATLAB "
                "file with it",
            )
        places = section.places
        if len(places) == 1 < len(axis_names):
            places = _of_all_axes(places[0], readers, axis_names)
        field = key if key in FIELDS else "effort"
        columns: list[Column] = []
        for file, column in places:
            columns.append(_of_field(column, field) if file in bags else column)
        files: str | tuple[str, ...] = section.file
        if isinstance(files, tuple):
            files = tuple(file for file, _ in places)
        changed[key] = replace(section, file=files, columns=tuple(columns))
    whole = wanted.model_copy(update=changed)
    _require_used_settings(whole, data)
    _check_torque(whole, bags)
    return whole


BAG_SETTINGS = ("topic", "publisher", "rhythm")  #: Of an import description, for bags alone


def _require_used_settings(wanted: ImportDescription, data: Path) -> None:
    """Refuse settings of a kind of files that the description does not name:
    nothing would read them.

    Raises:
        ConfigurationInconsistent: a topic, publisher or rhythm without a bag, or the layout of CSV
            files without one.
    """
    for key, section in wanted.sections():
        for setting in BAG_SETTINGS:
            if getattr(section, setting, None) is not None:
                _require_reader(wanted, data, read_bag, section.files, f"{key}.{setting}")
    for setting in BAG_SETTINGS:
        if getattr(wanted, setting) is not None:
            _require_reader(wanted, data, read_bag, tuple(wanted.files()), setting)
    if wanted.table != CsvLayout():
        _require_reader(wanted, data, read_csv, tuple(wanted.files()), "table")


_FILES_READ_BY: dict[Reader, str] = {read_bag: "a ROS bag", read_csv: "a CSV file"}


def _require_reader(
    wanted: ImportDescription, data: Path, reader: Reader, files: tuple[str, ...], setting: str
) -> None:
    """Refuse a setting that only one reader takes, where none of some files is read by it."""
    if any(reader_of(data / file) is reader for file in files):
        return
    kind = _FILES_READ_BY[reader]
    raise ConfigurationInconsistent(
        f"import description {wanted.name!r}: {setting}",
        found=f"a value, and no file that has it: {', '.join(files)}",
        expected=f"`{setting}` only where a file is {kind}",
        remedy=f"leave `{setting}` out, or name {kind}",
    )


def _of_all_axes(
    place: tuple[str, Column], readers: Mapping[str, Reader], axis_names: Sequence[str]
) -> tuple[tuple[str, Column], ...]:
    """Return the place of each axis, where one column may name all of them:
    a field of a bag, or a matrix.
    """
    file, column = place
    if readers[file] is read_bag and column in FIELDS:
        names = list(axis_names)
    elif readers[file] is read_mat:
        names = [str(number) for number, _ in enumerate(axis_names, start=1)]
    else:
        return (place,)
    return tuple((file, f"{column}.{name}") for name in names)


def _of_field(column: Column, field: str) -> str:
    """Return the column of a bag that a joint, or a field and a joint, name."""
    name = str(column)
    if name.partition(".")[0] in FIELDS:
        return name
    return f"{field}.{name}"


def _check_torque(wanted: ImportDescription, bags: Set[str]) -> None:
    """Refuse torques from the columns, or from the field of a bag, of the currents:
    their slope would be made up.
    """
    if wanted.torque is None:
        return
    read = {_source(place, bags) for place in wanted.current.places}
    repeated = [place for place in wanted.torque.places if _source(place, bags) in read]
    shared = dict.fromkeys(repeated)
    if shared:
        names = dict.fromkeys(_source(place, bags)[1] for place in shared)
        files = dict.fromkeys(file for file, _ in shared)
        columns = ", ".join(names)
        sources = ", ".join(files)
        raise ConfigurationInconsistent(
            f"import description {wanted.name!r}: torque.columns",
            found=f"{columns} of {sources}, which current is read from",
            expected="the controller's own torque, in columns (of a bag: in a field) of its own",
            remedy="name those columns, or leave `torque` out; no fit needs it",
        )
