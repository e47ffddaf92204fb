"""Refuse numbers that no robot moves by: a glitch of an encoder, a wrong unit, rate or column, a counter that wraps.

The functions `impossible_*` judge samples, of an import as of a recording of our own, and return what they found. The
checks of an import name the file, the column or axis, and the setting of the import description to correct.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from math import pi

import numpy as np

from daq.config.cell import Axis, Cell
from daq.config.import_description import ImportDescription, ScaledColumns, Side, TemperatureColumns, VelocityUnit
from daq.errors import CurrentImplausible, DataError, PositionImplausible, TableUnfit
from daq.log.resampling import Clock, on_clock
from daq.log.table import Table
from ident.arrays import BoolArray, FloatArray
from ident.data.run import Run
from ident.data.unsigned_current import require_signed_currents
from ident.errors import CurrentUnsigned

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
LARGEST_NUMBER = 1e12  #: Of a position, speed, current or torque in any unit
TEMPERATURES_C = (-60.0, 250.0)  #: Of a drive or a motor; kelvin above -23 °C are more
VELOCITY_WINDOW_S = 0.1  #: Time over which the ways by velocities and by positions are compared
STEP_NOISE, STEP_PERCENTILE, STEP_OUTLIER = 10.0, 95.0, 5.0
"""A step between two samples is refused beyond SPEED_MARGIN, by this multiple of the typical change of a step (noise,
coarse encoders), if it is this multiple of that percentile of all steps: a wrong rate makes all of them larger."""
NOISE_SHARE, NOISE_CHANGES, SPARSE_NOISE = 0.01, 20, 0.005
"""Where fewer samples than this share, or than this number, change their step at all, as of an axis at rest, the
changes may be the glitch itself: as noise they then count up to this share of the joint's range."""
GLITCH_SAMPLES, ABSURD = 10, 1e6
"""An outlier has at most so many samples above a tenth of it, where a short motion has more; or it is so many times the
99th percentile, which no current is."""
COUNTER_BITS = range(12, 32)  #: Counters whose wraps are found; those of 32 bits are followed
COUNTER_SHARE = 0.75  #: Least share of its range that a counter which wraps was seen in
STILL = 1e-3  #: Difference of speed that is no contradiction, as a share of the velocity limit


def check_sizes(wanted: ImportDescription, cell: Cell, files: dict[str, Table]) -> None:
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


def check_counts(position: FloatArray, wanted: ImportDescription, file: Table) -> None:
    """Refuse counts that are no whole numbers of 32 bits, and those of a counter that wraps at fewer bits."""
    wrong = np.argwhere((position != np.rint(position)) | (np.abs(position) > LARGEST_RAW))
    if wrong.size:
        row, column = wrong[0].tolist()
        raise TableUnfit(
            file.place(row, wanted.position.columns[column]),
            found=f"{position[row, column]!r}",
            expected="a whole number of encoder counts of at most 31 bits",
            remedy="correct `unit` in the import description",
        )
    for index, counts in enumerate(position.T):
        steps = np.abs(np.diff(counts))
        row = int(np.argmax(steps)) + 1
        bits = _bits_of_counter(float(counts.min()), float(counts.max()), float(steps[row - 1]))
        if bits is not None:
            raise TableUnfit(
                file.place(row, wanted.position.columns[index]),
                found=f"a step of {steps[row - 1]:.0f} counts, and all counts within {bits} bits: a counter that wraps",
                expected="counts that go on, or a counter of 32 bits",
                remedy="export the position of all turns, or unwrap the column",
            )


def _bits_of_counter(least: float, largest: float, step: float) -> int | None:
    """Return the bits of a counter that wraps, by its range and its largest step; None if it need not wrap.

    No motor makes half of its counter's range in one sample.
    """
    for bits in COUNTER_BITS:
        size = 2.0**bits
        inside = (least >= 0.0 and largest < size) or (least >= -size / 2.0 and largest < size / 2.0)
        if inside and largest - least >= COUNTER_SHARE * size and step > size / 2.0:
            return bits
    return None


def check_velocity(
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
    stated = on_clock(files[velocity.file].take(velocity.columns), clock)
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


def check_current(current: FloatArray, wanted: ImportDescription, file: Table) -> None:
    """Refuse outliers: one absurd number would make the count of its column so coarse that the others become zero."""
    for index, column in enumerate(wanted.current.columns):
        if len(current) > 1 and not np.ptp(current[:, index]):
            raise TableUnfit(
                f"{file.path}, column {column}",
                found=f"{current[0, index]:g} in every row" if current[0, index] else "zero in every row",
                expected="the current reference of a motor that moves",
                remedy="is the channel connected, and the column the right one?",
            )
    found = impossible_current(current)
    if found is not None:
        raise TableUnfit(
            file.place(found.row, wanted.current.columns[found.axis]),
            found=found.found,
            expected=found.expected,
            remedy="samples are never invented: cut the recording there, or export it again",
        )


@dataclass(frozen=True, slots=True)
class Impossible:
    """A number among the samples that no robot moves by."""

    axis: int  #: index of the axis
    row: int  #: index of the sample
    found: str
    expected: str


def impossible_current(current: FloatArray) -> Impossible | None:
    """Return the first current that is an outlier, None without one.

    Args:
        current: of the motors, in any unit, shape (k, n).
    """
    size = np.abs(current)
    usual = np.percentile(size, 99.0, axis=0)
    others = usual[usual > 0.0]
    # An axis whose current is almost always zero is compared with the other one of the smallest current.
    least = float(others.min()) if others.size else 0.0
    for axis, own in enumerate(usual.tolist()):
        column = size[:, axis]
        row = int(np.argmax(column))
        peak = float(column[row])
        compared = own if own > 0.0 else least
        is_rare = np.count_nonzero(column > 0.1 * peak) <= GLITCH_SAMPLES
        times = LARGEST_OUTLIER if is_rare else ABSURD
        if peak > times * max(compared, 1e-200):
            found = f"{current[row, axis]:.6g}, while 99 % of the column are within {own:.3g}"
            return Impossible(axis, row, found, "a current")
    return None


def impossible_speed(joint_rad: FloatArray, rate_hz: float, cell: Cell) -> Impossible | None:
    """Return the first axis that is too fast over many samples, far above the noise; None without one.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.
        cell: with the velocity limits.
    """
    step = _speed_samples(joint_rad, rate_hz)
    fastest = _fastest(joint_rad, rate_hz)
    for index, axis in enumerate(cell.axes):
        limit = axis.limits.velocity
        if fastest[index] > SPEED_MARGIN * limit:
            found = f"{axis.unit.spell(float(fastest[index]))}/s over {step} samples at {rate_hz:g} Hz"
            return Impossible(index, 0, found, _speed_limit(axis))
    return None


def impossible_step(joint_rad: FloatArray, rate_hz: float, cell: Cell) -> Impossible | None:
    """Return the first step between two samples that no motor makes, None without one.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.
        cell: with the velocity limits.
    """
    steps = np.diff(joint_rad, axis=0)
    if not len(steps):
        return None
    changes = np.abs(np.diff(steps, axis=0))
    for index, axis in enumerate(cell.axes):
        sizes = np.abs(steps[:, index])
        step = int(np.argmax(sizes))
        size = float(sizes[step])
        usual = float(np.percentile(sizes, STEP_PERCENTILE))
        lower, upper = axis.limits.position
        noise = _step_noise(changes[:, index], upper - lower)
        largest = SPEED_MARGIN * axis.limits.velocity / rate_hz + noise
        if size > max(largest, STEP_OUTLIER * usual):
            found = f"a step of {axis.unit.spell(size)} in one sample, {axis.unit.spell(size * rate_hz)}/s"
            return Impossible(index, step + 1, found, _speed_limit(axis))
    return None


def _step_noise(changes: FloatArray, range_rad: float) -> float:
    """Largest step that noise or a coarse encoder makes [rad or m], from the changes of an axis's steps, shape (k,)."""
    typical = changes[changes > 0.0]
    if not typical.size:
        return 0.0
    noise = STEP_NOISE * float(np.median(typical))
    if typical.size < max(NOISE_SHARE * len(changes), NOISE_CHANGES):
        return min(noise, SPARSE_NOISE * range_rad)
    return noise


def _speed_limit(axis: Axis) -> str:
    limit = axis.unit.spell(axis.limits.velocity)
    largest = axis.unit.spell(SPEED_MARGIN * axis.limits.velocity)
    return f"at most {largest}/s, {SPEED_MARGIN:g} times {limit}/s, the limit in the cell configuration"


def _speed_samples(joint_rad: FloatArray, rate_hz: float) -> int:
    """Samples over which a speed is measured: a tenth of a second, and at most a tenth of the run."""
    return max(1, min(round(0.1 * rate_hz), len(joint_rad) // 10))


def _fastest(joint_rad: FloatArray, rate_hz: float) -> FloatArray:
    """Speed of each axis that a few outliers do not raise [rad/s or m/s], shape (n,)."""
    step = _speed_samples(joint_rad, rate_hz)
    speeds = np.abs(joint_rad[step:] - joint_rad[:-step]) * rate_hz / step
    if not len(speeds):
        return np.zeros(joint_rad.shape[1])
    return np.asarray(np.percentile(speeds, SPEED_PERCENTILE, axis=0), dtype=np.float64)


def between_answers(joint_rad: FloatArray, answered: BoolArray) -> FloatArray:
    """Return positions with straight lines in the place of samples without an answer, shape (k, n).

    An unanswered sample says nothing of the position, and must not count as a step.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        answered: whether every motor that moves the joint answered, shape (k, n).
    """
    if answered.all():
        return joint_rad
    filled = joint_rad.copy()
    every = np.arange(len(joint_rad))
    for axis in np.flatnonzero(~answered.all(axis=0) & answered.any(axis=0)).tolist():
        known = answered[:, axis]
        filled[:, axis] = np.interp(every, every[known], joint_rad[known, axis])
    filled[:, ~answered.any(axis=0)] = 0.0
    return filled


_GLITCH = (
    "record again, and check the encoder, its cable and the object that the drive sends; a counter of fewer than 32 "
    "bits that wraps is read as a step"
)


def motion_fault(
    name: str, cell: Cell, rate_hz: float, position_rad: FloatArray, current: FloatArray, answered: BoolArray
) -> DataError | None:
    """Return the error for a recording of our own that no robot moves by, None for a plausible one.

    Args:
        name: of the recording in the message.
        cell: with the limits.
        rate_hz: rate of the samples.
        position_rad: joint positions [rad; m of a prismatic joint], shape (k, n).
        current: of the motors, shape (k, n).
        answered: whether every motor that moves the joint answered, shape (k, n).
    """
    known_rad = between_answers(position_rad, answered)
    found = impossible_step(known_rad, rate_hz, cell)
    if found is not None:
        return PositionImplausible(
            f"{name}, axis {cell.axes[found.axis].name}",
            found=f"{found.found}, at {found.row / rate_hz:.6g} s",
            expected=found.expected,
            remedy=_GLITCH,
        )
    found = impossible_speed(known_rad, rate_hz, cell)
    if found is not None:
        return PositionImplausible(
            f"{name}, axis {cell.axes[found.axis].name}",
            found=found.found,
            expected=found.expected,
            remedy="check `drive_train.ratio`, `counts_per_revolution` and the velocity limit in the cell file",
        )
    found = impossible_current(current)
    if found is not None:
        return CurrentImplausible(
            f"{name}, axis {cell.axes[found.axis].name}",
            found=f"a current of {found.found}, at {found.row / rate_hz:.6g} s",
            expected=found.expected,
            remedy="record again, and check the object that the drive sends as its current",
        )
    return None


def check_speed(name: str, joint_rad: FloatArray, rate_hz: float, cell: Cell) -> None:
    """Refuse implausible speeds. A wrong rate scales them all; over many samples they are far above the noise."""
    found = impossible_speed(joint_rad, rate_hz, cell)
    if found is not None:
        raise TableUnfit(
            f"{name}, axis {cell.axes[found.axis].name}",
            found=found.found,
            expected=found.expected,
            remedy="most likely rate_hz is too high, or the unit of the time column or of the positions is another",
        )
    limits = np.array([axis.limits.velocity for axis in cell.axes])
    share = float((_fastest(joint_rad, rate_hz) / limits).max())
    if share < SLOW_SHARE:
        _LOG.warning(
            "warning: %s: at %g Hz no joint is faster than %.2g %% of its velocity limit; is the rate of the recording "
            "right? A rate that is too low falsifies inertias without any other sign, and moves that slow do not "
            "identify them.",
            name,
            rate_hz,
            100.0 * share,
        )


def check_steps(
    wanted: ImportDescription, file: Table, joint_rad: FloatArray, rate_hz: float, clock: Clock | None, cell: Cell
) -> None:
    """Refuse a step between two samples that no motor makes: a lost or doubled row, an angle or a counter that wraps.

    Args:
        wanted: with the columns of the positions.
        file: the file that they are in.
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
        row = int(clock.row[min(np.searchsorted(clock.time_s, clock.tick_s[row]), len(clock.row) - 1)])
    raise TableUnfit(
        f"{file.place(row, wanted.position.columns[found.axis])}, axis {cell.axes[found.axis].name}",
        found=found.found,
        expected=found.expected,
        remedy="cut the recording there, or export it again; a column that wraps (at 360 degrees, at a turn of "
        "the motor, as a counter) has to be made continuous",
    )


def check_motion(name: str, joint_rad: FloatArray, cell: Cell) -> None:
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


def warn_of_unsigned(name: str, joint_rad: FloatArray, current_a: FloatArray, rate_hz: float, cell: Cell) -> None:
    """Warn of currents without their sign: the log can be read, but no fit takes it.

    Args:
        name: of the recording.
        joint_rad, current_a: joint positions and currents, shape (k, n).
        rate_hz: rate of the samples.
        cell: with drive train and names of the axes.
    """
    run = Run(name, np.arange(len(joint_rad)) / rate_hz, joint_rad, current_a)
    try:
        require_signed_currents(run, cell.ratio, cell.axis_names)
    except CurrentUnsigned as error:
        _LOG.warning("warning: %s; no fit takes this log", error)
