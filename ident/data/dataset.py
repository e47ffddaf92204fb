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
from ident.data.conditioning import Conditioning, central_differences, low_pass
from ident.data.held import HeldChannels, fill_held
from ident.data.run import Run, usual_conditioning
from ident.errors import DataUnfit
from ident.model.bodies import Payload
from ident.model.model import DriveTrain
from ident.model.robot import Motion

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
    valid: BoolArray  #: sample may be used
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
            self.position_rad[part], self.velocity_rad_s[part], self.acceleration_rad_s2[part]
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
    refuse = partial(DataUnfit, run.name)
    if conditioning is None:
        conditioning = usual_conditioning([run])
    time_s = as_array("time_s", run.time_s, refuse=refuse)
    if time_s.ndim != 1:
        raise refuse(
            f"time_s has shape {time_s.shape}; expected (n_samples,), one entry per sample"
        )
    shape = (len(time_s), len(drive_train.ratio))
    each = "one row per entry of time_s, one column per axis"
    position = as_array("position_rad", run.position_rad, shape, each, refuse)
    current = as_array("current_a", run.current_a, shape, each, refuse)
    if run.valid is None:
        usable = None
    else:
        usable = as_array("valid", run.valid, shape, each, refuse)
    if run.move is None:
        logged = None
    else:
        logged = as_array("move", run.move, shape[:1], "one entry per sample", refuse)
    temperature_c = _temperature(run.temperature_c, shape, each, refuse)
    run = replace(run, time_s=time_s)
    _check(run, shape[1], conditioning, refuse)
    rate = run.rate_hz
    recorded_current = current
    faults = find_faults(position, current, rate, drive_train.ratio)
    position, current, held = fill_held(
        position,
        current,
        rate,
        replaced_samples(faults, ChannelKind.POSITION, shape, drive_train.ratio),
        replaced_samples(faults, ChannelKind.CURRENT, shape),
    )
    raw = np.ascontiguousarray(position.T)
    smooth = low_pass(raw, rate, conditioning.position_cutoff_hz, conditioning.position_order)
    position, velocity, acceleration = central_differences(smooth, rate)
    speed = np.asarray(
        conditioning.standstill_rad_s or standstill_speed(raw, smooth, rate, conditioning)
    )
    moving, motor_moving = moving_samples(velocity, speed, drive_train)
    if usable is None:
        valid = np.ones_like(moving).T
    else:
        valid = np.array(usable[1:-1], dtype=np.bool_, order="F")
    margin = round(SETTLED_PERIODS * rate / conditioning.position_cutoff_hz)
    valid &= ~left_out_samples(faults, shape, margin)[1:-1]
    clipped = clipped_samples(recorded_current[1:-1], valid & motor_moving.T)
    valid &= ~clipped
    # If the log has no moves, a new one begins after every standstill of all joints.
    any_moving = np.any(moving, axis=0)
    move: FloatArray | IntArray
    if logged is None:
        begins_to_move = np.diff(any_moving.astype(np.int64), prepend=1) > 0
        move = np.cumsum(begins_to_move)
    else:
        move = logged[1:-1]
    # Long moves are split: σ and folds need many moves, and continuous motion would be a single
    # one.
    starts = np.flatnonzero(np.diff(move, prepend=move[0] - 1))
    since = np.arange(len(move)) - np.repeat(starts, np.diff(starts, append=len(move)))
    move = np.cumsum(since % round(LONGEST_MOVE_S * rate) == 0, dtype=np.int64) - 1
    return Dataset(
        name=run.name,
        rate_hz=rate,
        time_s=time_s[1:-1],
        position_rad=np.ascontiguousarray(position).T,
        velocity_rad_s=velocity.T,
        acceleration_rad_s2=acceleration.T,
        current_a=np.asfortranarray(current[1:-1]),
        moving=moving.T,
        motor_moving=motor_moving.T,
        valid=valid,
        move=move,
        payload=run.payload,
        started_s=run.started_s,
        temperature_c=None if temperature_c is None else np.asfortranarray(temperature_c[1:-1]),
        clipped=clipped,
        held=held,
        faults=faults if usable is None else faults_in_use(faults, usable != 0.0),
    )


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
    # Motor speed divided by the reduction, compared at the motor's own joint, which may have
    # another number.
    return moving, np.abs(drive_train.direction @ velocity) >= speed[list(drive_train.joints), None]


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
    impulse = np.zeros(
        (1, min(raw.shape[1], 2 * round(20.0 * rate_hz / conditioning.position_cutoff_hz) + 1))
    )
    impulse[0, impulse.shape[1] // 2] = 1.0
    response = low_pass(
        impulse, rate_hz, conditioning.position_cutoff_hz, conditioning.position_order
    )
    removed = float(np.linalg.norm(impulse - response))
    kept = float(np.linalg.norm(0.5 * rate_hz * (response[:, 2:] - response[:, :-2])))
    noise = np.median(np.abs(raw - smooth), axis=1) / 0.6745 / removed
    # A joint that is held exactly still has rounding noise alone.
    noise = np.maximum(noise, 1e-12 * np.maximum(np.abs(raw).max(axis=1), 1.0))
    speed = np.quantile(np.abs(0.5 * rate_hz * (smooth[:, 2:] - smooth[:, :-2])), 0.95, axis=1)
    return np.asarray(
        np.maximum(STANDSTILL_SHARE_OF_SPEED * speed, STANDSTILL_SIGMAS * kept * noise)
    )


@takes(motion=Motion, payload=Payload | None)
def planned(motion: Motion, rate_hz: float, payload: Payload | None = None) -> Dataset:
    """Make a dataset of a motion that was not recorded, for `ident.prediction`.

    Args:
        motion: q, q̇ and q̈ of n joints over k samples, shape (k, n) each; lists will do.
        rate_hz: sampling rate.
        payload: what is mounted, None without load.

    Raises:
        DataUnfit: the shapes differ, or a number is not finite.
        ModelError: an argument is of another type, or the rate is not above zero.
    """
    refuse = partial(DataUnfit, "planned motion")
    rate_hz = require_number(
        "rate_hz", rate_hz, above=0.0, remedy="give the rate of the samples, such as 500"
    )
    labels = "position_rad", "velocity_rad_s", "acceleration_rad_s2"
    position, velocity, acceleration = (
        as_array(label, getattr(motion, label), refuse=refuse) for label in labels
    )
    shape = position.shape
    if position.ndim != 2 or not shape == velocity.shape == acceleration.shape:
        found = (
            f"{shape}, {velocity.shape} and {acceleration.shape}; expected (n_samples, n_axes) each"
        )
        raise refuse(f"position, velocity and acceleration have the shapes {found}")
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
    samples = len(run.time_s)
    speeds = len(conditioning.standstill_rad_s)
    if speeds not in (0, count):
        raise refuse(f"{speeds} standstill speeds for {count} joints; give one a joint")
    step = np.diff(run.time_s)
    if samples < 3 or np.any(step <= 0) or np.ptp(step) > 0.01 * float(np.median(step)):
        raise refuse(
            "the sampling times are not uniform; derivatives need a constant rate without gaps"
        )
    if run.rate_hz < SLOWEST_HZ:
        between_s = (run.time_s[-1] - run.time_s[0]) / (samples - 1)
        raise refuse(
            f"time_s has {between_s:g} s between samples; expected seconds, and at most "
            f"{1.0 / SLOWEST_HZ:g} s; if these are milliseconds, divide them by 1000"
        )
    lowest, highest = sorted((conditioning.position_cutoff_hz, conditioning.decimation_cutoff_hz))
    if not lowest > 0.0:
        raise refuse(
            f"filtered with a cut-off of {lowest:g} Hz; expected above 0 Hz: see Conditioning"
        )
    if not run.rate_hz > 2.5 * highest:
        position = conditioning.position_cutoff_hz >= conditioning.decimation_cutoff_hz
        key = f"conditioning.{'position' if position else 'decimation'}_cutoff_hz"
        needed = f"`{key}` of {highest:g} Hz needs more than {2.5 * highest:g} Hz"
        raise refuse(f"sampled at {run.rate_hz:g} Hz; {needed}: record faster, or lower it")
    if samples < 2.0 * run.rate_hz:
        long = f"only {samples / run.rate_hz:.2g} s long"
        raise refuse(f"{long}; expected at least 2 s, and about 30 moves for one percent")
