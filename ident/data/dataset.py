"""A run with its derivatives: low-passed positions, central differences,
and samples at standstill.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ident.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    Refusal,
    as_array,
    require_number,
    require_real,
    require_size,
    takes,
)
from ident.data.channel_faults import (
    ChannelFault,
    ChannelKind,
    faults_in_use,
    find_faults,
    left_out_samples,
    replaced_samples,
)
from ident.data.clipping import clipped_samples
from ident.data.conditioning import (
    Conditioning,
    central_differences,
    low_pass,
    require_cutoffs,
    require_settings,
)
from ident.data.held import HeldChannels, fill_held
from ident.data.run import Run, require_named, usual_conditioning
from ident.errors import DataUnfit
from ident.model.bodies import Payload
from ident.model.model import DriveTrain
from ident.model.robot import Motion
from ident.plausible import TEMPERATURES_C

STANDSTILL_SHARE_OF_SPEED = 0.01
"""Standstill speed as a share of the 95 % quantile of the joint's speed."""
STANDSTILL_SIGMAS = 6.0
"""Least standstill speed in standard deviations of the encoder's noise after filter and
difference.
"""

SLOWEST_HZ = 10.0
"""Sampling rate below which times are in another unit:
no controller records the motion of an arm so rarely.
"""

SETTLED_PERIODS = 4.0
"""Periods of the position low-pass after which its response to a wrong position is over:
1e-4 of it is left.
"""

LARGEST_JITTER = 0.01  #: Range of the steps of time, as a share of their median
MEDIAN_OF_NORMAL = 0.6745  #: Median of |Z| of a standard normal Z
#: Sizes of a current, in whatever unit, whose squares and their sums are exact enough
SMALLEST_CURRENT = 1e-30
LARGEST_CURRENT = 1e30

IN_SI = "give radians (metres for prismatic joints) and seconds"

LONGEST_MOVE_S = 2.0
"""Two seconds are some forty correlation times of the residual (lag one about 0.67 at 50 rows a
second).
"""


@dataclass(frozen=True, slots=True)
class Dataset:
    """A run with derivatives; arrays have the shape (k, n),
    and each axis is contiguous in memory.
    """

    name: str  #: of the run
    rate_hz: float  #: sampling rate
    time_s: FloatArray  #: shape (k,), from the run
    position_rad: FloatArray  #: of the joints, low-passed
    velocity_rad_s: FloatArray  #: of the joints, low-passed and differentiated
    acceleration_rad_s2: FloatArray  #: of the joints, low-passed and differentiated twice
    current_a: FloatArray  #: of the motors, as recorded
    moving: BoolArray  #: joint faster than its standstill speed
    motor_moving: BoolArray  #: motor faster than its joint's standstill speed times the reduction
    valid: BoolArray  #: position of joint i and current of motor i may be used
    #: number of the move of each sample, shape (k,); one longer than LONGEST_MOVE_S counts as
    #: several
    move: IntArray
    payload: Payload | None  #: what was mounted, None without load
    #: When the run began, on a clock that the runs of one session share; None without a clock.
    started_s: float | None = None
    #: Motion that the drives were asked for, all k samples; None where it is not known
    #: (`ident.data.demand`).
    demanded: Motion | None = None
    #: Temperature of each motor or its drive [°C], NaN for one without; None where none was
    #: recorded.
    temperature_c: FloatArray | None = None
    #: Samples whose current was clipped by a limit that the drive does not report; they are not
    #: valid. None where clipping was not looked for.
    clipped: BoolArray | None = None
    #: channels whose held readings were filled in; None where none was held
    held: HeldChannels | None = None
    #: What is wrong with samples that count; glitches were filled in, what is frozen is not valid.
    faults: tuple[ChannelFault, ...] = ()
    #: a motion that was asked for: nothing of a recording can be wrong with it
    is_planned: bool = False

    def motion(self, part: slice = slice(None)) -> Motion:
        """Motion of the joints over some of the samples."""
        return Motion(
            position_rad=self.position_rad[part],
            velocity_rad_s=self.velocity_rad_s[part],
            acceleration_rad_s2=self.acceleration_rad_s2[part],
        )


@takes(run=Run, drive_train=DriveTrain, conditioning=Conditioning | None)
def differentiate(
    run: Run, drive_train: DriveTrain, conditioning: Conditioning | None = None
) -> Dataset:
    """Filter the positions without phase, then take central differences (paper §2.3).

    Args:
        run: a recording of n joints.
        drive_train: R, for the speed of coupled motors.
        conditioning: cut-offs and standstill speeds; these are derived from the run where none are
            declared. Without it, filters for the run's sampling rate (`Conditioning.for_rates`).

    Raises:
        DataUnfit: wrong shapes, NaN, a sampling rate that is not constant or too low, or too short
            a recording.
    """
    require_named(run)
    refuse = partial(DataUnfit, run.name)
    if conditioning is None:
        conditioning = usual_conditioning([run])
    time_s = as_array("time_s", run.time_s, refuse=refuse)
    if time_s.ndim != 1:
        raise refuse(
            f"time_s has shape {time_s.shape}; expected (n_samples,), one entry per sample"
        )
    given = _checked(run, time_s, drive_train, conditioning, refuse)
    shape = given.current.shape
    rate_hz = replace(run, time_s=time_s).rate_hz
    faults = _faults_of(run, given, rate_hz, drive_train)
    filled_position, filled_current, held = fill_held(
        given.position,
        given.current,
        rate_hz,
        replaced_samples(faults, ChannelKind.POSITION, shape, drive_train.ratio),
        replaced_samples(faults, ChannelKind.CURRENT, shape),
    )
    raw = np.ascontiguousarray(filled_position.T)
    smooth = low_pass(raw, rate_hz, conditioning.position_cutoff_hz, conditioning.position_order)
    position, velocity, acceleration = central_differences(smooth, rate_hz)
    if conditioning.standstill_rad_s:
        speed = np.asarray(conditioning.standstill_rad_s)
    else:
        speed = standstill_speed(raw, smooth, rate_hz, conditioning)
    moving, motor_moving = moving_samples(velocity, speed, drive_train)
    # Central differences leave the first and the last sample out.
    inner = slice(1, -1)
    valid = np.ones_like(moving).T
    faults_found = faults
    if given.usable is not None:
        valid = np.array(given.usable[inner], dtype=np.bool_, order="F")
        faults_found = faults_in_use(faults, given.usable != 0.0)
    margin = round(SETTLED_PERIODS * rate_hz / conditioning.position_cutoff_hz)
    valid &= ~left_out_samples(faults, shape, margin)[inner]
    clipped = clipped_samples(given.current[inner], valid & motor_moving.T)
    valid &= ~clipped
    move: IntArray | FloatArray
    if given.move is None:
        move = _moves_between_standstills(moving)
    else:
        move = given.move[inner]
    temperature_c = given.temperature_c
    if temperature_c is not None:
        temperature_c = np.asfortranarray(temperature_c[inner])
    return Dataset(
        name=run.name,
        rate_hz=rate_hz,
        time_s=time_s[inner],
        position_rad=np.ascontiguousarray(position).T,
        velocity_rad_s=velocity.T,
        acceleration_rad_s2=acceleration.T,
        current_a=np.asfortranarray(filled_current[inner]),
        moving=moving.T,
        motor_moving=motor_moving.T,
        valid=valid,
        move=_split_moves(move, round(LONGEST_MOVE_S * rate_hz)),
        payload=run.payload,
        started_s=run.started_s,
        temperature_c=temperature_c,
        clipped=clipped,
        held=held,
        faults=faults_found,
    )


def _faults_of(
    run: Run, given: _CheckedArrays, rate_hz: float, drive_train: DriveTrain
) -> tuple[ChannelFault, ...]:
    """What is wrong with all samples of a run, as it was judged when it was read."""
    judged = run.judged_channels
    if judged is not None and judged.answers_for(
        run.position_rad, run.current_a, drive_train.ratio
    ):
        return judged.faults
    return find_faults(given.position, given.current, rate_hz, drive_train.ratio)


@dataclass(frozen=True, slots=True, eq=False)
class _CheckedArrays:
    """Arrays of a run of k samples and n axes, of the expected shapes."""

    position: FloatArray  #: shape (k, n)
    current: FloatArray  #: shape (k, n)
    usable: FloatArray | None  #: zero for a sample that may not be used, shape (k, n)
    move: FloatArray | None  #: shape (k,)
    temperature_c: FloatArray | None  #: shape (k, n)


def _checked(
    run: Run,
    time_s: FloatArray,
    drive_train: DriveTrain,
    conditioning: Conditioning,
    refuse: Refusal,
) -> _CheckedArrays:
    """Check the arrays of a run, and its times against the filters.

    Raises:
        DataUnfit: as of `differentiate`.
    """
    axes = len(drive_train.ratio)
    shape = (len(time_s), axes)
    each = "one row per entry of time_s, one column per axis"
    position = as_array("position_rad", run.position_rad, shape, each, refuse)
    require_size("position_rad", position, refuse, IN_SI)
    current = as_array("current_a", run.current_a, shape, each, refuse)
    _require_squares(current, refuse)
    usable = None
    if run.valid is not None:
        usable = as_array("valid", run.valid, shape, each, refuse)
    move = None
    if run.move is not None:
        move = as_array("move", run.move, shape[:1], "one entry per sample", refuse)
    temperature_c = _temperature(run.temperature_c, shape, each, refuse)
    _check(replace(run, time_s=time_s), axes, conditioning, refuse)
    return _CheckedArrays(position, current, usable, move, temperature_c)


def _require_squares(current: FloatArray, refuse: Refusal) -> None:
    """Refuse currents whose squares are zero or infinite in floating point.

    Raises:
        DataUnfit: as of `differentiate`.
    """
    largest = np.max(np.abs(current), axis=0, initial=0.0)
    is_wrong = (largest > 0.0) & ((largest < SMALLEST_CURRENT) | (largest > LARGEST_CURRENT))
    if np.any(is_wrong):
        axis = int(np.argmax(is_wrong))
        raise refuse(
            f"current_a has {largest[axis]:g} as the largest size on axis {axis + 1}; expected "
            "amperes, or another unit of the drive; correct the scale"
        )


def _moves_between_standstills(moving: BoolArray) -> IntArray:
    """Number of the move of each sample, shape (n, k) → (k,):
    a new one begins after every standstill of all joints.
    """
    any_moving = np.any(moving, axis=0).astype(np.int64)
    begins = np.diff(any_moving, prepend=1) > 0
    return np.cumsum(begins)


def _split_moves(move: IntArray | FloatArray, longest: int) -> IntArray:
    """Number of the move of each sample where long moves are split after so many samples,
    shape (k,).

    σ and folds need many moves, and continuous motion would be a single one.
    """
    count = len(move)
    starts = np.flatnonzero(np.diff(move, prepend=move[0] - 1))
    lengths = np.diff(starts, append=count)
    since_start = np.arange(count) - np.repeat(starts, lengths)
    begins = since_start % longest == 0
    return np.cumsum(begins, dtype=np.int64) - 1


def _temperature(
    values: object, shape: tuple[int, ...], each: str, refuse: Refusal
) -> FloatArray | None:
    """Temperatures of a run, shape (k, n), NaN where a motor has none; None without any."""
    if values is None:
        return None
    require_real("temperature_c", values, refuse)
    temperature_c = np.asarray(values, dtype=np.float64)
    if temperature_c.shape != shape:
        raise refuse(f"temperature_c has shape {temperature_c.shape}; expected {shape}, {each}")
    least, largest = TEMPERATURES_C
    wrong = np.argwhere((temperature_c < least) | (temperature_c > largest))
    if len(wrong):
        sample, motor = wrong[0].tolist()
        raise refuse(
            f"found a temperature_c of {temperature_c[sample, motor]:g} in sample {sample}, motor "
            f"{motor + 1}; expected {least:g} to {largest:g} °C, NaN for a motor without; convert "
            "it to °C (kelvin less 273.15)"
        )
    return temperature_c


def moving_samples(
    velocity: FloatArray, speed: FloatArray, drive_train: DriveTrain
) -> tuple[BoolArray, BoolArray]:
    """Samples of each joint, and of each motor, that are not at standstill, shape (n, k) each.

    Args:
        velocity: of the joints [rad/s or m/s], shape (n, k).
        speed: at which each joint begins to move, shape (n,).
        drive_train: R, for the speed of coupled motors.
    """
    moving = np.abs(velocity) >= speed[:, None]
    # Motor speed divided by the reduction, compared at the motor's joint, which may have another
    # number.
    motor_velocity = drive_train.direction @ velocity
    motor_speed = speed[list(drive_train.joints), None]
    return moving, np.abs(motor_velocity) >= motor_speed


def standstill_speed(
    raw: FloatArray, smooth: FloatArray, rate_hz: float, conditioning: Conditioning
) -> FloatArray:
    """Speed below which a joint of a run is at standstill, for callers that declare none,
    shape (n,).

    Dry friction is undetermined at standstill: rows of a resting joint bias its gain. The speed
    must lie above the noise of a resting joint and well below the speeds that identify it, so it is
    the larger of

    - STANDSTILL_SHARE_OF_SPEED of the 95 % quantile of |q̇|, and
    - STANDSTILL_SIGMAS of the noise of q̇ that comes from the encoder. What the low-pass takes out
      of the positions is white noise above its cut-off; its median absolute value gives σ_q, and
      the filters' impulse response σ_q̇.

    Args:
        raw, smooth: positions before and after the low-pass, shape (n, k).
        rate_hz: sampling rate.
        conditioning: the low-pass.
    """
    cutoff_hz = conditioning.position_cutoff_hz
    length = 2 * round(20.0 * rate_hz / cutoff_hz) + 1
    impulse = np.zeros((1, min(raw.shape[1], length)))
    impulse[0, impulse.shape[1] // 2] = 1.0
    response = low_pass(impulse, rate_hz, cutoff_hz, conditioning.position_order)
    removed = float(np.linalg.norm(impulse - response))
    _, rate, _ = central_differences(response, rate_hz)
    remaining_rate = float(np.linalg.norm(rate))
    removed_noise = np.median(np.abs(raw - smooth), axis=1)
    noise = removed_noise / MEDIAN_OF_NORMAL / removed
    # A joint that stands exactly still has rounding noise alone.
    largest = np.maximum(np.abs(raw).max(axis=1), 1.0)
    noise = np.maximum(noise, 1e-12 * largest)
    _, velocity, _ = central_differences(smooth, rate_hz)
    speed = np.quantile(np.abs(velocity), 0.95, axis=1)
    by_speed = STANDSTILL_SHARE_OF_SPEED * speed
    by_noise = STANDSTILL_SIGMAS * remaining_rate * noise
    return np.asarray(np.maximum(by_speed, by_noise))


@takes(motion=Motion, payload=Payload | None)
def planned(motion: Motion, rate_hz: float, payload: Payload | None = None) -> Dataset:
    """Make a dataset of a motion that was not recorded, for `ident.prediction`.

    Args:
        motion: q, q̇ and q̈ of n joints over k samples, shape (k, n) each; lists will do.
        rate_hz: sampling rate.
        payload: what is mounted, None without load.

    Raises:
        DataUnfit: the shapes differ, there is no sample, or a number is not finite or too large.
        ModelError: an argument is of another type, or the rate is not above zero.
    """
    refuse = partial(DataUnfit, "planned motion")
    rate_hz = require_number(
        "rate_hz", rate_hz, above=0.0, remedy="give the rate of the samples, such as 500"
    )
    position = as_array("position_rad", motion.position_rad, refuse=refuse)
    velocity = as_array("velocity_rad_s", motion.velocity_rad_s, refuse=refuse)
    acceleration = as_array("acceleration_rad_s2", motion.acceleration_rad_s2, refuse=refuse)
    shape = position.shape
    if position.ndim != 2 or not shape == velocity.shape == acceleration.shape:
        found = (
            f"{shape}, {velocity.shape} and {acceleration.shape}; expected (n_samples, n_axes) each"
        )
        raise refuse(f"position, velocity and acceleration have the shapes {found}")
    if not shape[0]:
        raise refuse("found no sample; expected one or more; give the motion to predict")
    require_size("position_rad", position, refuse, IN_SI)
    require_size("velocity_rad_s", velocity, refuse, IN_SI)
    require_size("acceleration_rad_s2", acceleration, refuse, IN_SI)
    everywhere = np.ones(shape, dtype=np.bool_)
    return Dataset(
        name="planned motion",
        rate_hz=rate_hz,
        time_s=np.arange(shape[0]) / rate_hz,
        position_rad=position,
        velocity_rad_s=velocity,
        acceleration_rad_s2=acceleration,
        current_a=np.zeros(shape),
        moving=everywhere,
        motor_moving=everywhere,
        valid=everywhere,
        move=np.zeros(shape[0], dtype=np.int64),
        payload=payload,
        is_planned=True,
    )


def _check(run: Run, count: int, conditioning: Conditioning, refuse: Refusal) -> None:
    """Refuse times that are not uniform or too few, and filters that do not fit them.

    Raises:
        DataUnfit: as of `differentiate`.
    """
    require_settings(conditioning)
    require_cutoffs(conditioning, refuse)
    samples = len(run.time_s)
    speeds = len(conditioning.standstill_rad_s)
    if speeds not in (0, count):
        raise refuse(f"{speeds} standstill speeds for {count} joints; give one a joint")
    if samples < 3:
        raise refuse(f"found {samples} samples; expected at least 2 s of motion; record longer")
    uneven = _uneven_times(run.time_s)
    if uneven:
        raise refuse(
            f"found sampling times that are not uniform: {uneven}; expected steps of one length, "
            f"within {100.0 * LARGEST_JITTER:g} %, because derivatives need a constant rate; "
            "resample to uniform times (`numpy.interp`), or cut the run at the gap and give each "
            "part as a run"
        )
    if run.rate_hz < SLOWEST_HZ:
        between_s = (run.time_s[-1] - run.time_s[0]) / (samples - 1)
        raise refuse(
            f"time_s has {between_s:g} s between samples; expected seconds, and at most "
            f"{1.0 / SLOWEST_HZ:g} s; if these are milliseconds, divide them by 1000"
        )
    cutoffs_hz = {
        "position": conditioning.position_cutoff_hz,
        "decimation": conditioning.decimation_cutoff_hz,
    }
    if conditioning.current_cutoff_hz:
        cutoffs_hz["current"] = conditioning.current_cutoff_hz
    name, highest = max(cutoffs_hz.items(), key=lambda item: item[1])
    least_rate_hz = 2.5 * highest
    if not run.rate_hz > least_rate_hz:
        needed = (
            f"`conditioning.{name}_cutoff_hz` of {highest:g} Hz needs more than "
            f"{least_rate_hz:g} Hz"
        )
        raise refuse(f"sampled at {run.rate_hz:g} Hz; {needed}: record faster, or lower it")
    if samples < 2.0 * run.rate_hz:
        long = f"only {samples / run.rate_hz:.2g} s long"
        raise refuse(f"{long}; expected at least 2 s, and about 30 moves for one percent")


def _uneven_times(time_s: FloatArray) -> str:
    """Say where times do not rise in steps of one length; empty where they do."""
    steps_s = np.diff(time_s)
    usual_s = float(np.median(steps_s))
    backwards = np.flatnonzero(steps_s <= 0.0)
    if len(backwards):
        first = int(backwards[0])
        return (
            f"time_s does not rise from sample {first} ({time_s[first]:.6g} s) to the next one "
            f"({time_s[first + 1]:.6g} s)"
        )
    if np.ptp(steps_s) <= LARGEST_JITTER * usual_s:
        return ""
    farthest = int(np.argmax(np.abs(steps_s - usual_s)))
    return (
        f"a step of {steps_s[farthest]:.4g} s after sample {farthest} "
        f"({time_s[farthest]:.6g} s), where the usual one is {usual_s:.4g} s"
    )
