"""Convert CSV files of other controllers to logs.

A log holds int32. If the files hold angles, the count of each axis is the smallest power of two with which the largest
value still fits. The rounding error, half a count, is then at most 4.7e-10 of that value, and a power of two scales
without a rounding error of its own: raw = round(value / count).
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, log2, pi
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_file import bundle, load_cell
from daq.config.import_description import ImportDescription, PositionUnit, Side, Table, load_import
from daq.errors import ConfigurationInconsistent, PositionImplausible, TableUnfit
from daq.files import open_regular
from daq.log.conversion import check_limits, scaling
from daq.log.metadata import AxisReadback, Readback, RunInfo, RunStatistics
from daq.log.writer import NOTHING_KEPT, LogContent, LogWriter
from drivers.stream.sample import Sample
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
TIME_TOLERANCE = 0.5  #: Largest deviation of a time stamp, as a share of the period


def import_csv(
    description: Path, data: Path, out: Path, *, software: str, cell_path: Path | None = None
) -> RunStatistics:
    """Convert the files that a description names to a log. The same input gives the same bytes: no clock is read.

    Args:
        description: the import description.
        data: folder of the CSV files.
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
    _check_cell(wanted, cell, description)
    timed = () if wanted.time is None else (wanted.time.file,)
    names = dict.fromkeys((wanted.position.file, wanted.current.file, *timed))
    files = {name: read_table(data / name, wanted.table) for name in names}
    position = numbers(files[wanted.position.file], wanted.position.columns)
    current = numbers(files[wanted.current.file], wanted.current.columns)
    if len({len(file.rows) for file in files.values()}) > 1:
        raise TableUnfit(
            ", ".join(str(file.path) for file in files.values()),
            found=" and ".join(f"{len(file.rows)} rows in {name}" for name, file in files.items()),
            expected="as many in each",
            remedy="one of them ends early, or they are of different runs; export them again",
        )
    rate_hz = _rate_hz(wanted, files)
    counts, count_rad = _counts(wanted, cell, position, files[wanted.position.file])
    _check_current(current, wanted, files[wanted.current.file])
    raw, unit = quantise(current * wanted.current.factor)
    readback = Readback(
        tuple(
            AxisReadback(axis.name, float(unit[i]), None if count_rad is None else float(count_rad[i]))
            for i, axis in enumerate(cell.axes)
        )
    )
    scale = scaling(cell, readback)
    joint_rad = scale.joint_position(counts)
    check_limits(str(data / wanted.position.file), joint_rad, cell)
    _check_motion(str(data / wanted.position.file), joint_rad, cell)
    _check_speed(str(data / wanted.position.file), joint_rad, rate_hz, cell)
    digests = {name: hashlib.sha256("\n".join(file.rows).encode()).hexdigest() for name, file in files.items()}
    run = RunInfo(
        run_id=f"import-{hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()[:16]}",
        rate_hz=rate_hz,
        payload=_payload(wanted, cell),
        operator=wanted.operator,
        software=software,
        started_wall_ns=0,
        started_monotonic_ns=0,
        origin=f"imported as {wanted.name} from " + ", ".join(f"{name} ({d[:12]})" for name, d in digests.items()),
    )
    content = LogContent(run, bundle(path), readback, cell.axis_names)
    opened = False
    try:
        # A crash of an import loses no sample, so no clock is needed to flush in time.
        with LogWriter(out, content, scale.joint_position_of, clock_ns=lambda: 0, remedy=NOTHING_KEPT) as log:
            opened = True
            time_ns = np.rint(np.arange(len(counts)) * (1e9 / rate_hz)).astype(np.int64).tolist()
            silent = (0,) * len(cell.axes)
            for cycle, row in enumerate(zip(time_ns, counts.tolist(), raw.tolist(), strict=True)):
                log.write(Sample(cycle, row[0], tuple(row[1]), tuple(row[2]), silent))
            log.conclude(valid=True)
    except BaseException:
        if opened:
            log.part.unlink(missing_ok=True)
        raise
    return log.statistics


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


def _counts(
    wanted: ImportDescription, cell: Cell, position: FloatArray, file: TableFile
) -> tuple[IntArray, FloatArray | None]:
    """Return motor counts and the motor angle of a count [rad], None if the counts are the encoder's."""
    if wanted.position.unit is PositionUnit.COUNTS:
        fractional = np.argwhere(position != np.rint(position))
        if fractional.size or np.abs(position).max() > LARGEST_RAW:
            row, column = fractional[0] if fractional.size else np.argwhere(np.abs(position) > LARGEST_RAW)[0]
            raise TableUnfit(
                f"{file.path}:{file.first_line + row}, column {wanted.position.columns[column]}",
                found=f"{position[row, column]!r}",
                expected="a whole number of encoder counts of at most 31 bits",
                remedy="correct `unit` in the import description",
            )
        return position.astype(np.int64), None
    angle_rad = position
    if wanted.position.unit is PositionUnit.DEG:
        # On the joint side a prismatic axis is in mm; on the motor side everything is an angle.
        units = [axis.unit.si if wanted.position.side is Side.JOINT else pi / 180.0 for axis in cell.axes]
        angle_rad = position * np.array(units)
    if wanted.position.side is Side.JOINT:
        offset_rad = np.array([axis.zero_offset_rad for axis in cell.axes])
        angle_rad = (angle_rad - offset_rad) @ cell.ratio.T
    return quantise(angle_rad)


def _rate_hz(wanted: ImportDescription, files: dict[str, TableFile]) -> float:
    """Return the rate of the description, or that of the time column.

    Raises:
        TableUnfit: a time stamp deviates by more than half a period.
    """
    if wanted.time is None:
        assert wanted.rate_hz is not None  # load_import requires one of the two
        return wanted.rate_hz
    file = files[wanted.time.file]
    time_s = numbers(file, (wanted.time.column,))[:, 0] * wanted.time.unit.seconds
    time_s = time_s - time_s[0]
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    wrong = np.abs(np.diff(time_s) - period_s) > TIME_TOLERANCE * period_s
    if period_s <= 0.0 or wrong.any():
        row = int(np.argmax(wrong))
        raise TableUnfit(
            f"{file.path}:{file.first_line + row + 1}, column {wanted.time.column}",
            found=f"{time_s[min(row + 1, len(time_s) - 1)] - time_s[row]:.6g} s after the sample before",
            expected=f"{period_s:.6g} s, the same between all samples",
            remedy="samples are missing or duplicated: cut the recording there; or give rate_hz if stamps are coarse",
        )
    return float((len(time_s) - 1) / time_s[-1])


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
    if len(wanted.position.columns) != n:
        raise ConfigurationInconsistent(
            f"{description}: position.columns",
            found=f"{len(wanted.position.columns)} columns",
            expected=f"{n}, one for each axis of cell {cell.name!r}",
            remedy="correct the description, or choose the cell with --cell",
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
    _payload(wanted, cell)


def _check_current(current: FloatArray, wanted: ImportDescription, file: TableFile) -> None:
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
                f"{file.path}:{file.first_line + row}, column {column}",
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


@dataclass(frozen=True, slots=True)
class TableFile:
    """A CSV file as lines."""

    path: Path  #: path of the file
    table: Table  #: its layout
    names: tuple[str, ...]  #: column names from the header; empty without one
    rows: tuple[str, ...]  #: lines of numbers
    first_line: int  #: line number of the first row, from 1

    def fields(self, row: str) -> list[str]:
        """Split a line into fields without quotes and white space."""
        parts = row.split() if self.table.delimiter == " " else row.split(self.table.delimiter)
        return [part.strip().strip('"').strip() for part in parts]


def read_table(path: Path, table: Table) -> TableFile:
    """Read a file as lines, all of the same number of fields.

    Raises:
        TableUnfit: the file cannot be read, has no rows, ends early, or a line has another number of fields.
    """
    try:
        with open_regular(path) as stream:
            text = stream.read().decode("utf-8-sig")
    except OSError as error:
        raise TableUnfit(
            str(path),
            found=(error.strerror or type(error).__name__).lower(),
            expected="a CSV file",
            remedy="check --data and the file name in the import description",
        ) from error
    except UnicodeDecodeError as error:
        raise TableUnfit(
            str(path), found=f"byte {error.start} is no UTF-8", expected="text", remedy="is this a CSV file?"
        ) from error
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith(("\n", "\r")):
        # The last number may lack digits without any other sign.
        raise TableUnfit(
            f"{path}:{len(lines)}",
            found=f"a last line {lines[-1][-40:]!r} without an end of line",
            expected="an end of line, as after all others",
            remedy="the file ends early: export or copy it again; if the exporter never writes the last one, add it",
        )
    while lines and not lines[-1].strip():
        lines.pop()
    start = table.skip_rows + (1 if table.header else 0)
    rows = tuple(lines[start:])
    if not rows:
        raise TableUnfit(
            str(path),
            found=f"{len(lines)} lines, of which {min(start, len(lines))} before the numbers",
            expected="a line of numbers for each sample",
            remedy="was the export interrupted?",
        )
    bare = TableFile(path, table, (), rows, start + 1)
    names = tuple(bare.fields(lines[table.skip_rows])) if table.header else ()
    _check_shape(bare, len(names))
    return TableFile(path, table, names, rows, start + 1)


def numbers(file: TableFile, columns: Sequence[str | int]) -> FloatArray:
    """Read columns as numbers, shape (k, len(columns)).

    Raises:
        TableUnfit: a column is missing, or a field is not a finite number.
    """
    indices = [_index(file, column) for column in columns]
    table = file.table
    rows = [row.replace(",", ".") for row in file.rows] if table.decimal == "," else file.rows
    try:
        values = np.loadtxt(
            rows,
            delimiter=None if table.delimiter == " " else table.delimiter,
            usecols=indices,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
    except ValueError as error:
        raise _not_numeric(file, indices) from error
    if not np.isfinite(values).all():
        raise _not_numeric(file, indices)
    return np.asarray(values, dtype=np.float64)


def _check_shape(file: TableFile, named: int) -> None:
    counts = np.array([len(file.fields(row)) for row in file.rows])
    usual = named or Counter(counts.tolist()).most_common(1)[0][0]
    wrong = np.flatnonzero(counts != usual)
    last = len(file.rows) - 1
    if wrong.size and (wrong[0] != last or counts[last] > usual or last == 0):
        first = int(wrong[0])
        raise TableUnfit(
            f"{file.path}:{file.first_line + first}",
            found=f"{counts[first]} columns",
            expected=f"{usual}, as in {'the header' if named else 'most lines'}",
            remedy="check the delimiter in the import description, and the export",
        )
    if wrong.size or not file.fields(file.rows[last])[-1]:
        raise TableUnfit(
            f"{file.path}:{file.first_line + last}",
            found=f"a last line {file.rows[last][-40:]!r} of {counts[last]} fields",
            expected=f"{usual} complete fields",
            remedy="the file ends early; export or copy it again",
        )


def _index(file: TableFile, column: str | int) -> int:
    width = len(file.fields(file.rows[0]))
    if isinstance(column, int):
        if column <= width:
            return column - 1
        raise TableUnfit(
            str(file.path), found=f"{width} columns", expected=f"a column {column}", remedy="columns count from 1"
        )
    if file.names.count(column) == 1:
        return file.names.index(column)
    raise TableUnfit(
        str(file.path),
        found=f"columns {', '.join(file.names)}",
        expected=f"one column {column!r}",
        remedy="correct `columns` in the import description",
    )


def _not_numeric(file: TableFile, indices: list[int]) -> TableUnfit:
    """Make the error for the first field that is not a finite number."""
    for number, row in enumerate(file.rows):
        fields = file.fields(row)
        for index in indices:
            text = fields[index].replace(",", ".") if file.table.decimal == "," else fields[index]
            try:
                finite = math.isfinite(float(text))
            except ValueError:
                finite = False
            if not finite:
                label = file.names[index] if file.names else str(index + 1)
                return TableUnfit(
                    f"{file.path}:{file.first_line + number}, column {label}",
                    found=repr(fields[index]),
                    expected="a finite number",
                    remedy="samples are never invented: cut the recording there, or export it again",
                )
    return TableUnfit(
        str(file.path), found="fields that are no numbers", expected="numbers", remedy="check the decimal sign"
    )
