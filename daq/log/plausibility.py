"""Refuse numbers of a foreign recording that no robot moves by: a wrong unit, rate or column.

Each check names the file, the column or axis, the number it found, and the setting of the import
description to correct. Steps, speeds and currents are judged as in a recording by drivegain
(`daq.log.impossible`), and so are faults of a channel (`daq.log.column_faults`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from math import pi

import numpy as np

from daq.config.cell import Cell
from daq.config.import_description import (
    Column,
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
LARGEST_RAW = 2**31 - 1  #: Largest signed integer of 32 bits
LARGEST_UNSIGNED = 2**32 - 1  #: Largest unsigned integer of 32 bits
#: Fewest different values of a column that is compared with others: two axes at rest may both read
#: zero
FEWEST_DIFFERENT = 3
SMALLEST_MOTION = 0.02  #: Smallest motion of at least one joint, as a share of its range
#: Share of the velocity limits. If no joint is ever faster, the real rate may be ten times the
#: declared one.
SLOW_SHARE = 0.1
LARGEST_NUMBER = 1e12  #: Largest position, speed, current or torque, in any unit
#: Time over which the displacements by velocities and by positions are compared
VELOCITY_WINDOW_S = 0.1
#: Difference of speed that is no contradiction, as a share of the velocity limit
SPEED_TOLERANCE = 1e-3
#: Least divisor of a ratio that only appears in a message
SMALLEST_DIVISOR = 1e-300


def check_sizes(wanted: ImportDescription, cell: Cell, files: dict[str, Table]) -> None:
    """Refuse numbers that no robot has in any unit: the file is damaged, or a column is wrong."""
    for key, section in wanted.sections():
        least = -LARGEST_NUMBER
        largest = LARGEST_NUMBER
        if isinstance(section, TemperatureColumns):
            least, largest = TEMPERATURES_C
        values = section_values(section, files)
        if isinstance(section, ScaledColumns):
            factors = np.array(section.factors(cell.axis_names))
            with np.errstate(over="ignore"):
                values = values * factors
        is_inside = (least <= values) & (values <= largest)
        outside = np.argwhere(~is_inside)
        if outside.size:
            row, column = outside[0].tolist()
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
    """Refuse counts that are no signed integers of 32 bits."""
    has_fraction = position != np.rint(position)
    is_too_large = np.abs(position) > LARGEST_RAW
    wrong = np.argwhere(has_fraction | is_too_large)
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
    """Convert columns of unsigned counts of 32 bits to signed ones, as a drive reads its counter.

    Args:
        position: counts of the file, shape (rows, n).
        wanted: with the columns of the positions.

    Returns:
        signed counts, shape (rows, n), and a remark for each column that was changed.
    """
    signed = position.copy()
    remarks = []
    for index, (_, column) in enumerate(wanted.position.places):
        counts = position[:, index]
        is_positive = counts.min() >= 0.0
        is_unsigned = is_positive and LARGEST_RAW < counts.max() <= LARGEST_UNSIGNED
        if is_unsigned:
            # Two's complement: the largest unsigned count is −1.
            is_negative = counts > LARGEST_RAW
            signed[is_negative, index] -= LARGEST_UNSIGNED + 1.0
            remarks.append(
                f"column {column}: counts of 32 bits without a sign, read as counts with one"
            )
    return signed, tuple(remarks)


def counting_signs(reversed_axes: Sequence[str], axes: Sequence[str]) -> FloatArray:
    """Return −1 for each axis that a file has in the opposite direction, else 1, shape (n,)."""
    signs = np.ones(len(axes))
    for index, axis in enumerate(axes):
        if axis in reversed_axes:
            signs[index] = -1.0
    return signs


def in_si(values: FloatArray, columns: PositionColumns | VelocityColumns, cell: Cell) -> FloatArray:
    """Convert positions to rad or m, or velocities to rad/s or m/s.

    On the joint side the values of a prismatic axis are in mm where others are in degrees; on the
    motor side everything is an angle.

    Args:
        values: in the unit of the columns, shape (k, n).
        columns: unit, and side of the gears.
        cell: with the kinds of its axes.

    Returns:
        converted values, shape (k, n).
    """
    if columns.unit not in {PositionUnit.DEG, PositionUnit.MM, VelocityUnit.DEG, VelocityUnit.MM}:
        return values
    if columns.side is Side.JOINT:
        factors = [axis.unit.si for axis in cell.axes]
    else:
        factors = [pi / 180.0] * len(cell.axes)
    return values * np.array(factors, dtype=np.float64)


def _root_mean_square(values: FloatArray) -> FloatArray:
    """Return the root mean square of each column, shape (n,)."""
    mean_square = np.mean(values**2, axis=0)
    return np.asarray(np.sqrt(mean_square))


def _integrate(velocity_rad_s: FloatArray, rate_hz: float) -> FloatArray:
    """Integrate velocities from the first sample on, by the trapezoidal rule, shape (k, n)."""
    steps_rad = 0.5 * (velocity_rad_s[1:] + velocity_rad_s[:-1]) / rate_hz
    start_rad = np.zeros_like(velocity_rad_s[:1])
    summed_rad = np.cumsum(steps_rad, axis=0)
    return np.vstack((start_rad, summed_rad))


def check_velocity(
    wanted: ImportDescription,
    cell: Cell,
    files: dict[str, Table],
    clock: Clock | None,
    joint_rad: FloatArray,
    rate_hz: float,
) -> None:
    """Refuse velocity columns that contradict the positions.

    The displacements in VELOCITY_WINDOW_S are compared: they need no derivative, which would
    amplify noise.

    Args:
        wanted: with the columns of the velocities; without them nothing is checked.
        cell: with drive train and velocity limits.
        files: the tables, by the name of their file.
        clock: of the file's time column; None without one.
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.

    Raises:
        TableUnfit: the two differ by more than the tolerance of the import description.
    """
    velocity = wanted.velocity
    if velocity is None:
        return
    signs = counting_signs(velocity.reversed, cell.axis_names)
    of_file = section_values(velocity, files) * signs
    of_samples = on_clock(of_file, clock)
    velocity_rad_s = in_si(of_samples, velocity, cell)
    if velocity.side is Side.MOTOR:
        velocity_rad_s = velocity_rad_s @ np.linalg.inv(cell.ratio).T
    window = max(1, round(VELOCITY_WINDOW_S * rate_hz))
    window = min(window, len(velocity_rad_s) - 1)
    integral_rad = _integrate(velocity_rad_s, rate_hz)
    stated_rad = integral_rad[window:] - integral_rad[:-window]
    moved_rad = joint_rad[window:] - joint_rad[:-window]
    error_rad = _root_mean_square(stated_rad - moved_rad)
    size_rad = _root_mean_square(moved_rad)
    # Of an axis at rest, the tolerance alone would allow no noise.
    noise_rad_s = np.array([SPEED_TOLERANCE * axis.limits.velocity for axis in cell.axes])
    noise_rad = noise_rad_s * window / rate_hz
    largest_rad = velocity.tolerance * size_rad + noise_rad
    wrong = np.flatnonzero(error_rad > largest_rad).tolist()
    if not wrong:
        return
    # Slope of the straight line through zero that maps stated to moved displacements.
    stated_square = np.maximum(np.sum(stated_rad**2, axis=0), SMALLEST_DIVISOR)
    ratio = np.sum(moved_rad * stated_rad, axis=0) / stated_square
    error_percent = 100.0 * error_rad / np.maximum(size_rad, SMALLEST_DIVISOR)
    first = wrong[0]
    found = (
        f"positions that move {ratio[first]:.3g} times as fast as this velocity says, and differ "
        f"from it by {error_percent[first]:.3g} %"
    )
    others = [f"{cell.axes[axis].name} ({ratio[axis]:.3g} times)" for axis in wrong[1:]]
    if others:
        found += f"; so do those of {', '.join(others)}"
    tolerance_percent = 100.0 * velocity.tolerance
    file, column = velocity.places[first]
    raise TableUnfit(
        f"{files[file].path}, column {column}, axis {cell.axes[first].name}",
        found=found,
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
            number = "zero"
            if value:
                number = f"{value:g}"
            raise TableUnfit(
                f"{files[file].path}, column {column}",
                found=f"{number} in every row",
                expected="the current reference of a motor that moves",
                remedy="is the channel connected, and the column the right one?",
            )


def require_own_columns(
    sections: Sequence[Section], values: FloatArray, files: Mapping[str, Table]
) -> None:
    """Refuse the same numbers for two axes or quantities: one of the columns, of the variables or
    of the files is a copy.

    Args:
        sections: with the columns.
        values: of all sections, as their files have them, shape (rows, n).
        files: the tables, by the name of their file.

    Raises:
        TableUnfit: two columns that change are equal in every row.
    """
    places: list[tuple[str, Column]] = []
    for section in sections:
        places += section.places
    index_by_content: dict[bytes, int] = {}
    for index in range(values.shape[1]):
        numbers = values[:, index]
        if np.unique(numbers).size < FEWEST_DIFFERENT:
            continue
        first_index = index_by_content.setdefault(numbers.tobytes(), index)
        if first_index == index:
            continue
        first_file, first_column = places[first_index]
        file, column = places[index]
        raise TableUnfit(
            f"{files[file].path}, column {column}",
            found=f"the same number as column {first_column} of {first_file} in all "
            f"{len(numbers)} rows",
            expected="a column of its own for each quantity of each axis: no two read alike to the "
            "last digit",
            remedy="one of them is a copy: export the axis again, and correct `file` or `columns` "
            "in the description",
        )


def check_current(
    current: FloatArray, wanted: ImportDescription, files: Mapping[str, Table]
) -> None:
    """Refuse outliers.

    A log has currents as integers. One absurd number would make their unit so coarse that the
    others become zero.
    """
    found = impossible_current(current)
    if found is None:
        return
    place = section_place(wanted.current, files, found.row, found.axis)
    remedy = "samples are never invented: cut the recording there, by `keep`, or export it again"
    raise found.error(TableUnfit, place, remedy)


def check_speed(name: str, joint_rad: FloatArray, rate_hz: float, cell: Cell) -> None:
    """Refuse speeds far above the velocity limits, and warn of speeds far below all of them.

    A wrong rate scales every speed. Speeds are computed over many samples, where noise is small.
    """
    found = impossible_speed(joint_rad, rate_hz, cell)
    if found is not None:
        axis_name = cell.axes[found.axis].name
        remedy = (
            "most likely rate_hz is too high, or the unit of the time column or of the "
            "positions is another"
        )
        raise found.error(TableUnfit, f"{name}, axis {axis_name}", remedy)
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    shares = fastest_speeds(joint_rad, rate_hz) / limits
    largest_share = float(shares.max())
    if largest_share < SLOW_SHARE:
        _LOG.warning(
            "warning: %s: at %g Hz no joint is faster than %.2g %% of its velocity limit; is the "
            "rate of the recording right? A rate that is too low falsifies inertias without any "
            "other sign, and moves that slow do not identify them.",
            name,
            rate_hz,
            100.0 * largest_share,
        )


def check_steps(
    wanted: ImportDescription,
    files: Mapping[str, Table],
    joint_rad: FloatArray,
    rate_hz: float,
    clock: Clock | None,
    cell: Cell,
) -> None:
    """Refuse a step between two samples that no motor makes.

    Its cause is a lost or doubled row, or an angle or a counter that wraps.

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
        # The row is that of a tick; the message needs the row of the file at or after it.
        following = np.searchsorted(clock.time_s, clock.tick_s[row])
        last = len(clock.row) - 1
        row = int(clock.row[min(following, last)])
    place = section_place(wanted.position, files, row, found.axis)
    axis_name = cell.axes[found.axis].name
    remedy = (
        "cut the recording there, by `keep` of the import description, or export it again; a "
        "column that wraps (at 360 degrees, at a turn of the motor, as a counter) has to be made "
        "continuous; in a bag, do two nodes publish the same joints on the topic?"
    )
    raise found.error(TableUnfit, f"{place}, axis {axis_name}", remedy)


def check_motion(name: str, joint_rad: FloatArray, cell: Cell) -> None:
    """Refuse runs without motion, or nearly so.

    Radians taken for degrees make the motion 57 times smaller, which position limits do not reveal.
    """
    limits = np.array([axis.limits.position for axis in cell.axes])
    ranges = limits[:, 1] - limits[:, 0]
    shares = np.ptp(joint_rad, axis=0) / ranges
    still_axes = [cell.axes[index].name for index in np.flatnonzero(shares == 0.0)]
    if len(still_axes) == len(cell.axes):
        raise PositionImplausible(
            name,
            found="positions that never change, on any axis",
            expected="a recording of an arm that moves",
            remedy="did the axes move? check the columns of `position` in the description",
        )
    if still_axes:
        _LOG.warning(
            "warning: %s: the position of %s never changes; if it moved, check its encoder or "
            "its column",
            name,
            " and ".join(still_axes),
        )
    largest_share = shares.max()
    if largest_share < SMALLEST_MOTION:
        largest_percent = 100.0 * largest_share
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
    """Warn of currents without their sign.

    Such a log can be read; a fit accepts it only if the motion explains the currents.

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
