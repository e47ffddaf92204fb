"""Refuse numbers of a foreign recording that no robot moves by: a wrong unit, rate or column.

Each check names the file, the column or axis, what was found, and the setting of the import
description to correct. A step, a speed or a current is judged as in a recording of our own
(`daq.log.impossible`), and so are readings that are none (`daq.log.column_faults`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from math import pi

import numpy as np

from daq.config.cell import Cell
from daq.config.import_description import (
    ImportDescription,
    PositionColumns,
    PositionUnit,
    ScaledColumns,
    Section,
    Side,
    TemperatureColumns,
    VelocityColumns,
    VelocityUnit,
)
from daq.errors import PositionImplausible, TableUnfit
from daq.log.impossible import fastest_speeds, impossible_current, impossible_speed, impossible_step
from daq.log.resampling import Clock, on_clock
from daq.log.table import Table, section_place, section_values
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.data.unsigned_current import require_signed_currents
from ident.errors import CurrentUnsigned
from ident.plausible import TEMPERATURES_C

_LOG = logging.getLogger("drivegain")
LARGEST_RAW = 2**31 - 1
LARGEST_UNSIGNED = 2**32 - 1
#: Values of a column that is compared with others; a line at rest may be zero on two axes
FEWEST_DIFFERENT = 3
SMALLEST_MOTION = 0.02  #: Smallest motion of at least one joint, as a share of its range
SLOW_SHARE = 0.1
"""Share of the velocity limits; if no joint is ever faster,
the real rate may be ten times the declared one.
"""
LARGEST_NUMBER = 1e12  #: Of a position, speed, current or torque in any unit
VELOCITY_WINDOW_S = 0.1  #: Time over which the ways by velocities and by positions are compared
STILL = 1e-3  #: Difference of speed that is no contradiction, as a share of the velocity limit


def check_sizes(wanted: ImportDescription, cell: Cell, files: dict[str, Table]) -> None:
    """Refuse numbers that no robot has in any unit: the file is damaged, or a column is another."""
    for key, section in wanted.sections():
        least = -LARGEST_NUMBER
        largest = LARGEST_NUMBER
        values = section_values(section, files)
        if isinstance(section, TemperatureColumns):
            least, largest = TEMPERATURES_C
        if isinstance(section, ScaledColumns):
            with np.errstate(over="ignore"):
                values = values * np.array(section.factors(cell.axis_names))
        is_inside = (least <= values) & (values <= largest)
        wrong = np.argwhere(~is_inside)
        if wrong.size:
            row, column = wrong[0].tolist()
            raise TableUnfit(
                section_place(section, files, row, column),
                found=f"{values[row, column]:g}, as {key}",
                expected=f"from {least:g} to {largest:g}",
                remedy="correct the number, or the columns or the factor of that section in the "
                "import description",
            )


def check_counts(
    position: FloatArray, wanted: ImportDescription, files: Mapping[str, Table]
) -> None:
    """Refuse counts that are no whole numbers of 32 bits."""
    is_broken = position != np.rint(position)
    is_large = np.abs(position) > LARGEST_RAW
    wrong = np.argwhere(is_broken | is_large)
    if wrong.size:
        row, column = wrong[0].tolist()
        raise TableUnfit(
            section_place(wanted.position, files, row, column),
            found=f"{position[row, column]!r}",
            expected="a whole number of encoder counts of at most 31 bits",
            remedy="correct `unit` in the import description",
        )


def signed_counts(
    position: FloatArray, wanted: ImportDescription
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return counts with a sign where a column has them of 32 bits without:
    the same counter, read as a drive does.

    Args:
        position: as the file has it, shape (rows, n).
        wanted: with the columns of the positions.

    Returns:
        position, shape (rows, n), and a remark for each column that was changed.
    """
    signed = position.copy()
    remarks = []
    for index, (_, column) in enumerate(wanted.position.places):
        counts = position[:, index]
        is_positive = counts.min() >= 0.0
        if is_positive and LARGEST_RAW < counts.max() <= LARGEST_UNSIGNED:
            signed[counts > LARGEST_RAW, index] -= LARGEST_UNSIGNED + 1.0
            remarks.append(
                f"column {column}: counts of 32 bits without a sign, read as counts with one"
            )
    return signed, tuple(remarks)


def counting_signs(reversed_axes: Sequence[str], axes: Sequence[str]) -> FloatArray:
    """Return −1 for each axis that counts the other way in a file, 1 for the others, shape (n,)."""
    return np.array([-1.0 if axis in reversed_axes else 1.0 for axis in axes])


def in_si(values: FloatArray, columns: PositionColumns | VelocityColumns, cell: Cell) -> FloatArray:
    """Convert positions or velocities to rad or m, shape (k, n).

    On the joint side a prismatic axis is in mm where others are in degrees; on the motor side
    everything is an angle.
    """
    if columns.unit not in {PositionUnit.DEG, PositionUnit.MM, VelocityUnit.DEG, VelocityUnit.MM}:
        return values
    if columns.side is Side.JOINT:
        units = [axis.unit.si for axis in cell.axes]
    else:
        units = [pi / 180.0 for _ in cell.axes]
    return values * np.array(units, dtype=np.float64)


def _root_mean_square(values: FloatArray) -> FloatArray:
    """Return the root mean square of each column, shape (n,)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def check_velocity(
    wanted: ImportDescription,
    cell: Cell,
    files: dict[str, Table],
    clock: Clock | None,
    joint_rad: FloatArray,
    rate_hz: float,
) -> None:
    """Compare velocity columns with the positions, by the way moved in VELOCITY_WINDOW_S:
    it needs no derivative.
    """
    velocity = wanted.velocity
    if velocity is None:
        return
    signs = counting_signs(velocity.reversed, cell.axis_names)
    of_file = section_values(velocity, files) * signs
    stated = in_si(on_clock(of_file, clock), velocity, cell)
    if velocity.side is Side.MOTOR:
        stated = stated @ np.linalg.inv(cell.ratio).T
    step = max(1, round(VELOCITY_WINDOW_S * rate_hz))
    step = min(step, len(stated) - 1)
    # ∫ v dt, by the trapezoidal rule
    steps = 0.5 * (stated[1:] + stated[:-1]) / rate_hz
    summed = np.cumsum(steps, axis=0)
    summed = np.vstack((np.zeros_like(stated[:1]), summed))
    expected = summed[step:] - summed[:-step]
    moved = joint_rad[step:] - joint_rad[:-step]
    still_speeds = [STILL * axis.limits.velocity for axis in cell.axes]
    still = np.array(still_speeds) * step / rate_hz
    error = _root_mean_square(expected - moved)
    size = _root_mean_square(moved)
    largest = velocity.tolerance * size + still
    for index in np.flatnonzero(error > largest).tolist():
        way = moved[:, index]
        stated_way = expected[:, index]
        stated_square = max(float(stated_way @ stated_way), 1e-300)
        ratio = float(way @ stated_way) / stated_square
        error_percent = 100.0 * float(error[index]) / max(float(size[index]), 1e-300)
        tolerance_percent = 100.0 * velocity.tolerance
        file, column = velocity.places[index]
        raise TableUnfit(
            f"{files[file].path}, column {column}, axis {cell.axes[index].name}",
            found=f"positions that move {ratio:.3g} times as fast as this velocity says, and "
            f"differ from it by {error_percent:.3g} %",
            expected=f"velocities that agree with the positions to {tolerance_percent:g} %",
            remedy="check `unit` and `side` of both, the order of their columns, and the rate or "
            "the unit of the time; or leave `velocity` out",
        )


def require_changing(
    position: FloatArray, current: FloatArray, wanted: ImportDescription, files: Mapping[str, Table]
) -> None:
    """Refuse a current of one value, unless the position of its axis does not change either.

    Args:
        position, current: as their files have them, shape (rows, n).
        wanted: with the columns of the currents.
        files: the tables, by the name of their file.

    Raises:
        TableUnfit: a current has one value while its axis moves.
    """
    for index, (file, column) in enumerate(wanted.current.places):
        is_constant = len(current) > 1 and not np.ptp(current[:, index])
        if is_constant and np.ptp(position[:, index]):
            value = current[0, index]
            number = f"{value:g}" if value else "zero"
            raise TableUnfit(
                f"{files[file].path}, column {column}",
                found=f"{number} in every row",
                expected="the current reference of a motor that moves",
                remedy="is the channel connected, and the column the right one?",
            )


def require_own_columns(section: Section, values: FloatArray, files: Mapping[str, Table]) -> None:
    """Refuse the same numbers for two axes:
    a copy of a column, or of a file, has the place of another one.

    Args:
        section: with the columns.
        values: as their files have them, shape (rows, n).
        files: the tables, by the name of their file.

    Raises:
        TableUnfit: two columns that change are equal in every row.
    """
    first_of: dict[bytes, int] = {}
    for index in range(values.shape[1]):
        column = values[:, index]
        if np.unique(column).size < FEWEST_DIFFERENT:
            continue
        first = first_of.setdefault(column.tobytes(), index)
        if first == index:
            continue
        earlier = section.places[first]
        later = section.places[index]
        raise TableUnfit(
            f"{files[later[0]].path}, column {later[1]}",
            found=f"the same number as column {earlier[1]} of {earlier[0]} in all "
            f"{len(column)} rows",
            expected="a column of its own for each axis: no two axes read alike to the last digit",
            remedy="one of them is a copy: export the axis again, and correct `file` or `columns` "
            "in the description",
        )


def check_current(
    current: FloatArray, wanted: ImportDescription, files: Mapping[str, Table]
) -> None:
    """Refuse outliers: one absurd number would make the count of its column so coarse that the
    others become zero.
    """
    found = impossible_current(current)
    if found is not None:
        place = section_place(wanted.current, files, found.row, found.axis)
        remedy = (
            "samples are never invented: cut the recording there, by `keep`, or export it again"
        )
        raise found.error(TableUnfit, place, remedy)


def check_speed(name: str, joint_rad: FloatArray, rate_hz: float, cell: Cell) -> None:
    """Refuse implausible speeds.

    A wrong rate scales them all; over many samples they are far above the noise.
    """
    found = impossible_speed(joint_rad, rate_hz, cell)
    if found is not None:
        remedy = (
            "most likely rate_hz is too high, or the unit of the time column or of the "
            "positions is another"
        )
        raise found.error(TableUnfit, f"{name}, axis {cell.axes[found.axis].name}", remedy)
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    shares = fastest_speeds(joint_rad, rate_hz) / limits
    share = float(shares.max())
    if share < SLOW_SHARE:
        _LOG.warning(
            "warning: %s: at %g Hz no joint is faster than %.2g %% of its velocity limit; is the "
            "rate of the recording right? A rate that is too low falsifies inertias without any "
            "other sign, and moves that slow do not identify them.",
            name,
            rate_hz,
            100.0 * share,
        )


def check_steps(
    wanted: ImportDescription,
    files: Mapping[str, Table],
    joint_rad: FloatArray,
    rate_hz: float,
    clock: Clock | None,
    cell: Cell,
) -> None:
    """Refuse a step between two samples that no motor makes:
    a lost or doubled row, an angle or a counter that wraps.

    Args:
        wanted: with the columns of the positions.
        files: the tables, by the name of their file.
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.
        clock: of the file's time column; None without one.
        cell: with the velocity limits.
    """
    found = impossible_step(joint_rad, rate_hz, cell)
    if found is None:
        return
    row = found.row
    if clock is not None:
        following = np.searchsorted(clock.time_s, clock.tick_s[row])
        row = int(clock.row[min(following, len(clock.row) - 1)])
    place = section_place(wanted.position, files, row, found.axis)
    axis_name = cell.axes[found.axis].name
    raise found.error(
        TableUnfit,
        f"{place}, axis {axis_name}",
        "cut the recording there, by `keep` of the import description, or export it again; a "
        "column that wraps (at 360 degrees, at a turn of the motor, as a counter) has to be made "
        "continuous; in a bag, do two nodes publish the same joints on the topic?",
    )


def check_motion(name: str, joint_rad: FloatArray, cell: Cell) -> None:
    """Refuse runs without motion: radians taken for degrees shrink it 57 times,
    which limits do not reveal.
    """
    limits = np.array([axis.limits.position for axis in cell.axes])
    ranges = limits[:, 1] - limits[:, 0]
    share = np.ptp(joint_rad, axis=0) / ranges
    still = [cell.axes[index].name for index in np.flatnonzero(share == 0.0)]
    if len(still) == len(cell.axes):
        raise PositionImplausible(
            name,
            found="positions that never change, on any axis",
            expected="a recording of an arm that moves",
            remedy="did the axes move? check the columns of `position` in the description",
        )
    if still:
        _LOG.warning(
            "warning: %s: the position of %s never changes; if it moved, check its encoder or "
            "its column",
            name,
            " and ".join(still),
        )
    if share.max() < SMALLEST_MOTION:
        largest_percent = 100.0 * share.max()
        raise PositionImplausible(
            name,
            found=f"motion over at most {largest_percent:.2g} % of any joint's range",
            expected=f"at least {100.0 * SMALLEST_MOTION:g} % on one joint",
            remedy="most likely radians were taken for degrees, or joint for motor side; correct "
            "the description",
        )


def warn_of_unsigned(
    name: str, joint_rad: FloatArray, current_a: FloatArray, rate_hz: float, cell: Cell
) -> None:
    """Warn of currents without their sign: the log can be read;
    a fit takes it only if the motion explains them.

    Args:
        name: of the recording.
        joint_rad, current_a: joint positions and currents, shape (k, n).
        rate_hz: rate of the samples.
        cell: with drive train and names of the axes.
    """
    time_s = np.arange(len(joint_rad)) / rate_hz
    run = Run(name, time_s, joint_rad, current_a)
    try:
        require_signed_currents(run, cell.ratio, cell.axis_names)
    except CurrentUnsigned as error:
        _LOG.warning(
            "warning: %s; a fit refuses this log unless the motion explains the current", error
        )
