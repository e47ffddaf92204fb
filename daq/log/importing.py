"""Convert files of other controllers to logs.

A log holds int32. If the files hold angles, the count of each axis is the smallest power of two
with which the largest value still fits. The rounding error, half a count, is then at most 4.7e-10
of that value, and a power of two scales without a rounding error of its own: raw = round(value /
count).

`wanted` is the content of the import description, in all functions of the import; its sections say
which columns hold a quantity.
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
from daq.config.foreign_files import HEAD_BYTES, foreign_kind
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
from daq.errors import ConfigurationInconsistent, TableUnfit, UsageError, counted
from daq.files import open_regular, sha256
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
from daq.log.table import (
    ROW_MARGIN,
    Reader,
    Table,
    compare_stamps,
    rows_at_rate,
    section_values,
    unreadable,
)
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
UNIX_NS = range(10**18, 3 * 10**18)
"""Stamps that are taken for a wall clock's, counted since 1970: the years 2001 to 2065.
Any others count from the start of some computer or program.
"""
SMALLEST_MAGNITUDE = 1e-200
"""Columns whose values are all at most this are taken for zeros,
whose power of two may be below the range of a float.
"""
ZEROS_EXPONENT = -30  #: Power of two by which such a column is counted


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
    stated = load_import(description)
    _require_name_of_holdout(stated, holdout)
    if holdout is not None and os.path.realpath(holdout) == os.path.realpath(out):
        raise UsageError(
            str(holdout),
            found="one name for both logs",
            expected="a name for each of them",
            remedy="give `--holdout` another name than `--out`",
        )
    cell_file = cell_path or description.parent / stated.cell
    cell = load_cell(cell_file)
    _require_files(stated, data)
    with_all_columns = with_columns(stated, data, cell.axis_names)
    _check_columns(with_all_columns, description, data)
    _check_cell(with_all_columns, cell, description)
    wanted = in_order_of_axes(with_all_columns, cell.axis_names)
    tables = _read_tables(wanted, data)
    check_sizes(wanted, cell, tables)
    recording = _judged_recording(wanted, cell, tables)
    rate_hz = recording.used.rate_hz
    digests = {name: table.digest for name, table in tables.items()}
    started_ns, started_wall_ns, timing = _start_times(wanted, tables, recording.clock)
    payload = _payload(wanted, cell)
    run = RunInfo(
        run_id=_run_id(digests),
        rate_hz=rate_hz,
        payload=payload,
        operator=wanted.operator,
        software=software,
        started_wall_ns=started_wall_ns,
        started_monotonic_ns=started_wall_ns,
        origin=_origin(wanted, digests),
        timing=timing,
    )
    slow_columns = _slow_columns(wanted, cell, tables, recording.clock, rate_hz)
    samples = _LogSamples(cell, bundle(cell_file), recording.kept, slow_columns, run, started_ns)
    all_rows = range(len(recording.kept.counts))
    holdout_statistics = None
    if wanted.holdout is None or holdout is None:
        statistics = samples.write(out, all_rows)
    else:
        split = _first_row_of_holdout(wanted, wanted.holdout.from_s, rate_hz, len(all_rows))
        holdout_statistics = samples.write(holdout, all_rows[split:])
        try:
            statistics = samples.write(out, all_rows[:split])
        # An interrupt, too: one log without the other would look like a whole import.
        except BaseException:
            holdout.unlink()
            raise
    remarks: list[str] = []
    for table in tables.values():
        remarks += table.remarks
    remarks += recording.remarks
    remarks += fault_remarks(recording.faults, recording.used)
    return Imported(statistics, timing, tuple(remarks), holdout_statistics)


def _run_id(digests: Mapping[str, str]) -> str:
    """Return the identity of a run by the digests of its files: the same files, the same run."""
    all_digests = repr(sorted(digests.items()))
    digest = sha256(all_digests.encode())
    return f"import-{digest[:16]}"


def _origin(wanted: ImportDescription, digests: Mapping[str, str]) -> str:
    """Return where a log comes from: the description and the files, with their digests."""
    sources = [f"{name} ({digest[:12]})" for name, digest in digests.items()]
    return f"imported as {wanted.name} from " + ", ".join(sources)


def _require_name_of_holdout(wanted: ImportDescription, holdout: Path | None) -> None:
    """Refuse a description with a held-out part that has no name,
    and a name without such a part.
    """
    has_part = wanted.holdout is not None
    has_name = holdout is not None
    if has_part == has_name:
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


def _first_row_of_holdout(
    wanted: ImportDescription, from_s: float, rate_hz: float, count: int
) -> int:
    """Return the first row of the held-out part, of `count` rows at a rate.

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
class _SlowColumns:
    """A quantity that is logged less often than the samples."""

    quantity: Quantity
    period_samples: int  #: from one reading to the next
    values: FloatArray  #: at every sample [Nm or °C], shape (k, n)


@dataclass(frozen=True, slots=True, eq=False)
class _LogSamples:
    """Samples of a recording, all of which or a part go into a log."""

    cell: Cell
    files: Mapping[str, bytes]  #: the cell's bundle
    columns: Converted
    slow: list[_SlowColumns]
    run: RunInfo  #: the facts about the whole recording
    started_ns: int  #: stamp of its first sample

    def write(self, out: Path, rows: range) -> RunStatistics:
        """Write some rows of the recording into a new log, whose cycles count from 0.

        Raises:
            UsageError, OutputFailed: the log cannot be written.
        """
        step_ns = 1e9 / self.run.rate_hz
        run = self._run_of(rows)
        content = LogContent.of(self.cell, run, self.files, self.columns.readback)
        joint_position = self.columns.scale.joint_position_of
        # A crash of an import loses no sample: the log needs no clock to flush by, and leaves no
        # `.part`.
        with LogWriter(out, content, joint_position, clock_ns=lambda: 0, keeps_part=False) as log:
            no_statusword = (0,) * len(self.cell.axes)
            counts = self.columns.counts[rows.start : rows.stop].tolist()
            current_raw = self.columns.current_raw[rows.start : rows.stop].tolist()
            for cycle, row in enumerate(rows):
                time_ns = self.started_ns + round(row * step_ns)
                log.readings(_slow_readings(self.slow, row, time_ns))
                position = tuple(counts[cycle])
                current = tuple(current_raw[cycle])
                sample = Sample(cycle, time_ns, position, current, no_statusword)
                log.write(sample)
            log.conclude(valid=True)
        return log.statistics

    def _run_of(self, rows: range) -> RunInfo:
        """Return the facts about a part of the recording, which starts later than the whole."""
        if len(rows) == len(self.columns.counts):
            return self.run
        later_ns = round(rows.start * 1e9 / self.run.rate_hz)
        wall_ns = 0  # the time of day is unknown
        if self.run.started_wall_ns:
            wall_ns = self.run.started_wall_ns + later_ns
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


def _judged_recording(
    wanted: ImportDescription, cell: Cell, tables: dict[str, Table]
) -> JudgedRecording:
    """Judge and convert the rows of the files.

    Where a recording has several faults, the first check that fails names one of them.

    Raises:
        TableUnfit, PositionImplausible: the files cannot be used.
    """
    file_position = section_values(wanted.position, tables)
    current = section_values(wanted.current, tables)
    require_changing(file_position, current, wanted, tables)
    both = np.hstack((file_position, current))
    require_own_columns((wanted.position, wanted.current), both, tables)
    remarks: tuple[str, ...] = ()
    if wanted.position.unit is PositionUnit.COUNTS:
        file_position, remarks = signed_counts(file_position, wanted)
        check_counts(file_position, wanted, tables)
    position = file_position * counting_signs(wanted.position.reversed, cell.axis_names)
    clock = _file_clock(wanted, tables)
    used = _used_rows(wanted, cell, tables, clock, len(position))
    check_current(current, wanted, tables)
    sound = sound_columns(position, current, used)
    columns = _converted(wanted, cell, position[used.row], current, clock)
    joint_rad = columns.joint_rad
    if len(wanted.position.files) == 1:
        table = tables[wanted.position.files[0]]
        subject = str(table.path)
    else:
        subject = f"import description {wanted.name!r}"
    check_limits(subject, joint_rad, cell)
    check_motion(subject, joint_rad, cell)
    check_steps(wanted, tables, joint_rad, used.rate_hz, clock, cell)
    # After the limits of the robot, which may say more of a position that goes on displaced.
    require_mendable(sound.faults, used, displaced=True)
    check_speed(subject, joint_rad, used.rate_hz, cell)
    check_velocity(wanted, cell, tables, clock, joint_rad, used.rate_hz)
    current_a = columns.current_raw * columns.scale.current_per_unit
    warn_of_unsigned(wanted.name, joint_rad, current_a, used.rate_hz, cell)
    is_resampled = clock is not None and clock.timing.resampled
    if sound.faults and is_resampled:
        # Where rows stay as they are, a fit mends them; a spline would spread what is wrong.
        columns = _converted(wanted, cell, sound.position[used.row], sound.current, clock)
    return JudgedRecording(used, clock, columns, sound.faults, remarks)


def _file_clock(wanted: ImportDescription, tables: Mapping[str, Table]) -> Clock | None:
    """Return the clock of the time column; None without one.

    A row is a repeated one only if the numbers of every file repeat.
    """
    if wanted.time is None:
        return None
    numbers = np.hstack([table.values for table in tables.values()])
    return clock_of(tables[wanted.time.file], wanted.time, numbers)


def _used_rows(
    wanted: ImportDescription,
    cell: Cell,
    tables: Mapping[str, Table],
    clock: Clock | None,
    count: int,
) -> UsedRows:
    """Return the rows that a clock uses, or all `count` rows at the stated rate."""
    if clock is not None:
        return UsedRows(clock.row, clock.time_s, clock.timing.rate_hz, wanted, tables, cell)
    assert wanted.rate_hz is not None  # load_import requires a time column or a rate
    return UsedRows(np.arange(count), None, wanted.rate_hz, wanted, tables, cell)


def _converted(
    wanted: ImportDescription,
    cell: Cell,
    position: FloatArray,
    current: FloatArray,
    clock: Clock | None,
) -> Converted:
    """Convert columns of a file to those of a log.

    Args:
        wanted: with the units and the factors of the columns.
        cell: the cell.
        position: of the rows that are used, shape (rows used, n).
        current: of all rows, shape (rows, n).
        clock: chooses the rows of the currents, and resamples both; None without a time column.
    """
    counts, count_rad = _counts(wanted, cell, position, clock)
    factors = wanted.current.factors(cell.axis_names)
    scaled_current = on_clock(current, clock) * np.array(factors)
    current_raw, current_per_unit = quantise(scaled_current)
    axes = []
    for index, axis in enumerate(cell.axes):
        rad_per_count = None if count_rad is None else float(count_rad[index])
        axes.append(AxisReadback(axis.name, float(current_per_unit[index]), rad_per_count))
    readback = Readback(tuple(axes))
    scale = scaling(cell, readback)
    # The log keeps the counts of an encoder with the wraps of its counter; a fit reads them
    # unwrapped. Angles do not wrap.
    continuous_counts = counts
    if count_rad is None:
        continuous_counts = unwrapped(counts.astype(np.int32))
    joint_rad = scale.joint_position(continuous_counts)
    return Converted(counts, current_raw, readback, scale, joint_rad)


def _read_tables(wanted: ImportDescription, data: Path) -> dict[str, Table]:
    """Read every file of the description with the reader of its kind.

    Returns:
        The tables by the names of the files, in the order of the description, with as many rows
        each.

    Raises:
        TableUnfit: a file cannot be read, has another number of rows, or too few.
    """
    read: dict[str, Table] = {}
    part = wanted.keep
    is_part_by_time = part is not None and part.is_by_time
    if part is not None and is_part_by_time and wanted.rate_hz is not None:
        wanted = _with_part_of_rows(wanted, rows_at_rate(wanted.rate_hz, part))
    columns_of_files = wanted.files()
    if wanted.time is not None:
        # The file with the stamps comes first: where a part is chosen by time, it says which rows
        # of the other files these are.
        timed_file = wanted.time.file
        path = data / timed_file
        timed = reader_of(path)(path, wanted, columns_of_files[timed_file], wanted.time)
        read[timed_file] = timed
        if is_part_by_time:
            end = timed.first_row + len(timed.values)
            wanted = _with_part_of_rows(wanted, slice(timed.first_row, end))
    for name, columns in columns_of_files.items():
        if name not in read:
            path = data / name
            read[name] = reader_of(path)(path, wanted, columns, None)
    tables = {name: read[name] for name in columns_of_files}
    _require_equal_rows(tables)
    if wanted.time is not None:
        timed = tables[wanted.time.file]
        for name, table in tables.items():
            remarks = (*table.remarks, *compare_stamps(timed, table))
            tables[name] = replace(table, remarks=remarks)
    position = tables[wanted.position.files[0]]
    if len(position.values) < FEWEST_ROWS:
        rows = counted(len(position.values), "row")
        raise TableUnfit(
            str(position.path),
            found=f"{rows} of numbers",
            expected="a row for each sample of a motion",
            remedy="was the export interrupted? export the recording again",
        )
    return tables


def _require_equal_rows(tables: Mapping[str, Table]) -> None:
    """Refuse files of different lengths: a row of one belongs to the same row of the others."""
    counts = {len(table.values) for table in tables.values()}
    if len(counts) <= 1:
        return
    paths = [str(table.path) for table in tables.values()]
    row_counts: list[str] = []
    for name, table in tables.items():
        rows = counted(len(table.values), "row")
        row_counts.append(f"{rows} in {name}")
    raise TableUnfit(
        ", ".join(paths),
        found=" and ".join(row_counts),
        expected="as many in each",
        remedy="one of them ends early, or they are of different runs; export them again",
    )


def _with_part_of_rows(wanted: ImportDescription, rows: slice) -> ImportDescription:
    """Return a description that keeps these rows, counted from 0, instead of a part by time."""
    part = KeptPart(from_row=rows.start + 1, to_row=rows.stop)
    return wanted.model_copy(update={"keep": part})


def _slow_columns(
    wanted: ImportDescription,
    cell: Cell,
    tables: Mapping[str, Table],
    clock: Clock | None,
    rate_hz: float,
) -> list[_SlowColumns]:
    """Return torques of the motors [Nm] and temperatures [°C], where the files have them."""
    slow = []
    torque = wanted.torque
    if torque is not None:
        factors = np.array(torque.factors(cell.axis_names))
        torque_nm = on_clock(section_values(torque, tables), clock) * factors
        if torque.side is Side.JOINT:
            # τ_joint = Rᵀ τ_motor (eq. 24); in rows of samples, τ_motorᵀ = τ_jointᵀ R⁻¹.
            torque_nm = torque_nm @ np.linalg.inv(cell.ratio)
        period_samples = max(1, round(rate_hz / TORQUE_HZ))
        slow.append(_SlowColumns(Quantity.TORQUE, period_samples, torque_nm))
    temperature = wanted.temperature
    if temperature is not None:
        temperature_c = on_clock(section_values(temperature, tables), clock)
        period_samples = max(1, round(rate_hz / TEMPERATURE_HZ))
        slow.append(_SlowColumns(Quantity.TEMPERATURE, period_samples, temperature_c))
    return slow


def _slow_readings(slow: list[_SlowColumns], row: int, time_ns: int) -> Iterator[SlowReading]:
    """Yield the slow readings of a sample, where one of their periods begins."""
    for columns in slow:
        if row % columns.period_samples == 0:
            for axis, value in enumerate(columns.values[row].tolist()):
                yield SlowReading(time_ns, axis, columns.quantity, value)


def _start_times(
    wanted: ImportDescription, tables: Mapping[str, Table], clock: Clock | None
) -> tuple[int, int, Timing | None]:
    """Return the first stamp and the wall time of the log [ns], and its timing.

    Both times are 0 where they are unknown; there is no timing without a time column.
    """
    if wanted.time is None or clock is None:
        return 0, 0, None
    stamps = tables[wanted.time.file].stamps
    assert stamps is not None  # clock_of has used them
    first_ns = stamps.first_ns
    if first_ns < 0:
        return 0, 0, clock.timing
    timing = replace(clock.timing, started_s=first_ns * 1e-9)
    # Stamps that count from some other start say nothing of the time of day.
    wall_ns = first_ns if first_ns in UNIX_NS else 0
    return first_ns, wall_ns, timing


def _quantum_exponent(largest: float) -> int:
    """Return the least e with largest ≤ LARGEST_RAW · 2ᵉ."""
    if largest <= SMALLEST_MAGNITUDE:
        return ZEROS_EXPONENT
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
    exponents = [_quantum_exponent(magnitude) for magnitude in largest.tolist()]
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
    is_resampled = clock is not None and clock.timing.resampled
    if wanted.position.unit is PositionUnit.COUNTS:
        if not is_resampled:
            return position.astype(np.int64), None
        turns = [axis.counts_per_revolution for axis in cell.axes]
        counts_per_turn = np.array(turns, dtype=np.float64)
        motor_counts = unwrapped(position.astype(np.int32))
        angle_rad = motor_counts * (2.0 * pi / counts_per_turn)
    else:
        angle_rad = in_si(position, wanted.position, cell)
    if wanted.position.side is Side.JOINT:
        # q_motorᵀ = qᵀ Rᵀ, in rows of samples. Zero is that of the controller; `zero_offset_deg`
        # leads from there to the URDF's.
        angle_rad = angle_rad @ cell.ratio.T
    if clock is not None:
        angle_rad = clock.positions(angle_rad)
    return quantise(angle_rad)


def _payload(wanted: ImportDescription, cell: Cell) -> Payload | None:
    """Return the payload that the description names; None if it names none.

    Raises:
        ConfigurationInconsistent: the cell has none of that name and mounting, or several.
    """
    if wanted.payload is None:
        return None
    matches = []
    for mounted in cell.payloads:
        is_mounting = wanted.mounting is None or wanted.mounting == mounted.mounting
        if mounted.name == wanted.payload and is_mounting:
            matches.append(mounted)
    if len(matches) == 1:
        return matches[0].payload
    found = f"payload {wanted.payload!r}"
    if wanted.mounting:
        found += f", mounting {wanted.mounting!r}"
    described = [f"{mounted.name} at {mounted.mounting}" for mounted in cell.payloads]
    known = ", ".join(described) or "none"
    raise ConfigurationInconsistent(
        f"import description {wanted.name!r}",
        found=found,
        expected=f"one of the cell's ({known})",
        remedy="`payload: NAME` and, if needed, `mounting: NAME`, as in the cell file",
    )


def _require_files(wanted: ImportDescription, data: Path) -> None:
    """Refuse files that are not there, or of a kind that no reader takes, before their columns are
    judged by what a file of another kind would have.

    Raises:
        TableUnfit: for the first such file.
    """
    for file in wanted.files():
        path = data / file
        if path.is_dir():
            continue
        try:
            with open_regular(path) as stream:
                head = stream.read(HEAD_BYTES)
        except OSError as error:
            raise unreadable(path, error, "a CSV or MATLAB file, or a ROS bag") from error
        foreign = foreign_kind(head)
        if foreign is not None and reader_of(path) is read_csv:
            raise TableUnfit(
                str(path),
                found=foreign.value,
                expected="a CSV or MATLAB file, or a ROS bag",
                remedy=foreign.remedy,
            )


def _check_columns(wanted: ImportDescription, description: Path, data: Path) -> None:
    """Refuse a column that is read as two quantities, or as that of two axes:
    one of them would be made up.

    Args:
        wanted: with a column for each axis.
        description: its file.
        data: folder of the files.
    """
    key_by_place: dict[tuple[Path, str], str] = {}
    for key, file, column in _columns_by_key(wanted):
        first_key = key_by_place.setdefault((Path(file), str(column)), key)
        if first_key != key:
            remedy = "correct `columns` in the import description"
            is_called_csv = Path(file).suffix.lower() == ".csv"
            if not is_called_csv and reader_of(data / file) is read_csv:
                remedy += (
                    f"; {file} is read as a CSV file, because its content is no bag: if it should "
                    "be one, copy it again"
                )
            raise ConfigurationInconsistent(
                f"{description}: {key}",
                found=f"column {column} of {file}, which is also {first_key}",
                expected="a column of its own for each quantity of each axis",
                remedy=remedy,
            )


def _columns_by_key(wanted: ImportDescription) -> Iterator[tuple[str, str, Column]]:
    """Yield each column that is read: its key in the description, its file, and itself."""
    if wanted.time is not None:
        yield "time.column", wanted.time.file, wanted.time.column
    for key, section in wanted.sections():
        for index, (file, column) in enumerate(section.places):
            yield f"{key}.columns[{index}]", file, column


def _check_cell(wanted: ImportDescription, cell: Cell, description: Path) -> None:
    """Refuse a description that does not fit the axes of the cell.

    Raises:
        ConfigurationInconsistent: names the key of the description.
    """
    axis_count = len(cell.axes)
    for key, section in wanted.sections():
        if len(section.places) != axis_count:
            found = counted(len(section.places), "column")
            expected = f"{axis_count}, one for each axis of cell {cell.name!r}"
            raise ConfigurationInconsistent(
                f"{description}: {key}.columns",
                found=found,
                expected=expected,
                remedy="correct the description, or choose the cell with --cell",
            )
        reversed_axes = getattr(section, "reversed", ())
        unknown_axes = [name for name in reversed_axes if name not in cell.axis_names]
        if unknown_axes:
            axis_names = ", ".join(cell.axis_names)
            raise ConfigurationInconsistent(
                f"{description}: {key}.reversed",
                found=", ".join(unknown_axes),
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
    revolute_axes = [axis.name for axis in cell.axes if axis.unit is not MILLIMETRE]
    for key, motion in (("position", wanted.position), ("velocity", wanted.velocity)):
        if motion is None or motion.unit not in lengths:
            continue
        if revolute_axes or motion.side is Side.MOTOR:
            turned = f"axis {revolute_axes[0]}" if revolute_axes else "a motor"
            raise ConfigurationInconsistent(
                f"{description}: {key}.unit",
                found=f"{motion.unit.value}, while {turned} turns",
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
    """Return the file and the column of a place; of a bag, the file and the field, without the
    joint: a field of a bag is one quantity.
    """
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
        for file, reader in readers.items():
            if reader is read_bag:
                bags.add(file)
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
        if len(places) == 1 and len(axis_names) > 1:
            places = _places_of_axes(places[0], readers, axis_names)
        # Currents and torques are both in `effort`: joint states have no other field for them.
        field = key if key in FIELDS else "effort"
        columns: list[Column] = []
        for file, column in places:
            if file in bags:
                columns.append(_field_and_joint(column, field))
            else:
                columns.append(column)
        files: str | tuple[str, ...] = section.file
        if isinstance(files, tuple):
            files = tuple(file for file, _ in places)
        changed[key] = replace(section, file=files, columns=tuple(columns))
    with_all_columns = wanted.model_copy(update=changed)
    _require_used_settings(with_all_columns, data)
    _check_torque(with_all_columns, bags)
    return with_all_columns


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


def _places_of_axes(
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


def _field_and_joint(column: Column, field: str) -> str:
    """Return a column of a bag as `FIELD.JOINT`; `field` is that of a joint without one."""
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
    current_sources = {_source(place, bags) for place in wanted.current.places}
    # Dictionaries keep each name once, in the order of the axes.
    shared_names: dict[str, None] = {}
    shared_files: dict[str, None] = {}
    for place in wanted.torque.places:
        source = _source(place, bags)
        if source in current_sources:
            _, name = source
            file, _ = place
            shared_names[name] = None
            shared_files[file] = None
    if shared_names:
        columns = ", ".join(shared_names)
        files = ", ".join(shared_files)
        raise ConfigurationInconsistent(
            f"import description {wanted.name!r}: torque.columns",
            found=f"{columns} of {files}, which current is read from",
            expected="the controller's own torque, in columns (of a bag: in a field) of its own",
            remedy="name those columns, or leave `torque` out; no fit needs it",
        )
