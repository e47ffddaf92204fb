"""Rows of [V | W] of one run in standard parameters, filtered and decimated;
the columns of a motor (paper eq. 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning, Decimator, decimator
from ident.data.dataset import Dataset
from ident.errors import DataUnfit
from ident.model.model import Model, preload_directions, spread
from ident.model.robot import Motion

#: Decimated rows built at once: the regressor of their samples stays in the cache's reach
CHUNK_ROWS = 256


def row_filter(data: Dataset, conditioning: Conditioning) -> Decimator:
    """The parallel decimation of a run's columns to rows.

    Raises:
        DataUnfit: the run is too short for it.
    """
    filter_ = decimator(data.rate_hz, conditioning.decimation_cutoff_hz)
    samples = len(data.time_s)
    if filter_.rows(samples) < 10:
        raise DataUnfit(
            data.name,
            f"{samples / data.rate_hz:.2g} s are too short to decimate at "
            f"{conditioning.decimation_cutoff_hz:g} Hz",
        )
    return filter_


def decimate_rows(data: Dataset, conditioning: Conditioning, columns: FloatArray) -> FloatArray:
    """Parallel decimation of full-rate columns of a run to the observation's rows:
    shape (..., k) → (..., r).
    """
    return decimator(data.rate_hz, conditioning.decimation_cutoff_hz)(columns)


def at_rows(data: Dataset, conditioning: Conditioning) -> Dataset:
    """A run at the rows of the equations: motion and clock, and nothing else of it."""
    time_s = decimate_rows(data, conditioning, data.time_s)
    if data.temperature_c is None:
        temperature_c = None
    else:
        temperature_c = decimate_rows(data, conditioning, data.temperature_c.T).T
    return replace(
        data,
        rate_hz=float((len(time_s) - 1) / (time_s[-1] - time_s[0])),
        time_s=time_s,
        position_rad=decimate_rows(data, conditioning, data.position_rad.T).T,
        velocity_rad_s=decimate_rows(data, conditioning, data.velocity_rad_s.T).T,
        acceleration_rad_s2=decimate_rows(data, conditioning, data.acceleration_rad_s2.T).T,
        temperature_c=temperature_c,
    )


def row_masks(
    model: Model, data: Dataset, conditioning: Conditioning
) -> tuple[BoolArray, BoolArray]:
    """Rows of each axis, and of each motor, that count (Observation.use, .motor_use),
    both of shape (m, r).

    Preload joins the equations of all motors: of a redundant drive, rows count in which all of them
    move.
    """
    drive_train = model.drive_train
    filter_ = decimator(data.rate_hz, conditioning.decimation_cutoff_hz)
    # A row's share of standstill is weighted as the filter weights its samples.
    window = Decimator(np.abs(filter_.taps) / np.abs(filter_.taps).sum(), filter_.factor)
    share = conditioning.standstill_share
    use = (window((~data.moving.T).astype(np.float64)) <= share) & (
        window((~data.valid.T).astype(np.float64)) == 0.0
    )
    motor_still = window((~data.motor_moving.T).astype(np.float64)) > share
    # Motor i's equation mixes the joints in row i of T (DriveTrain.to_motor); each of them must
    # count.
    needed = np.abs(drive_train.to_motor) > 0
    turned = np.abs(drive_train.direction) > 0
    motor_use = np.stack(
        [use[needed[i] | turned[i]].all(axis=0) & ~motor_still[i] for i in range(len(use))]
    )
    # A coupled motor that sticks leaves an undetermined torque in the equations of all joints it
    # turns with.
    for motor in drive_train.coupled:
        use &= ~(turned[motor][:, None] & motor_still[motor][None, :])
    if model.is_redundant:
        use[:] = motor_use[:] = use.all(axis=0) & motor_use.all(axis=0)
    return use, motor_use


def chunks(filter_: Decimator, samples: int, chunk_rows: int) -> Iterator[slice]:
    """Cut a run's samples into pieces that hold the whole windows of at most ``chunk_rows`` rows
    each.

    Pieces end at a block of the decimator, except at the end of the run, so that the filter needs
    no padding.
    """
    rows = filter_.rows(samples)
    blocks = -(-len(filter_.taps) // filter_.factor)
    for first in range(0, rows, chunk_rows):
        last = min(first + chunk_rows, rows) - 1
        yield slice(first * filter_.factor, min((last + blocks) * filter_.factor, samples))


@dataclass(frozen=True, slots=True)
class Rows:
    """Consecutive decimated rows of one run; arrays are joint-first and time-last."""

    current: FloatArray  #: current references of the motors [A], shape (m, r)
    #: torque at each joint per unit of each standard parameter, shape (m, c, r)
    standard: FloatArray
    instrument: FloatArray  #: the same for the demanded motion; the same array where none is known
    use: BoolArray  #: rows of each joint that count: moving and valid, shape (m, r)
    #: rows of each motor that count: all joints it turns with, and itself, moving, shape (m, r)
    motor_use: BoolArray
    time_s: FloatArray  #: of each row, since the start of the run, shape (r,)
    move: IntArray  #: number of each row's move within the run, shape (r,)
    #: Of a redundantly driven robot: torque at each axis per unit of each motor's gain, preload
    #: taken out, shape (m, m, r), and N, the torques that move nothing, shape (m, m − d, r). Of
    #: others (m, 0, r) both.
    drive: FloatArray
    preload: FloatArray


def rows_of(
    model: Model, data: Dataset, conditioning: Conditioning, chunk_rows: int = CHUNK_ROWS
) -> Iterator[Rows]:
    """Build, filter and decimate a run's rows piece by piece;
    the pieces together do not depend on their length.

    Args:
        model: the declared model.
        data: a differentiated run.
        conditioning: every column and the currents go through the same decimation.
        chunk_rows: rows built at once.

    Raises:
        DataUnfit: the run is too short for the filter, or no row of it counts.
    """
    filter_ = row_filter(data, conditioning)
    use, motor_use = row_masks(model, data, conditioning)
    if not use.any():
        raise DataUnfit(
            data.name, "no row is left after the standstill and validity masks; did the robot move?"
        )
    centres = filter_.centres(len(data.time_s))
    time_s = data.time_s[centres] - data.time_s[0]
    move = data.move[centres]
    first = 0
    support = model.support
    if data.demanded is None:
        asked = None
    else:
        asked = demanded_at_rows(data.demanded, filter_)
    loaded = data.payload is not None
    for part in chunks(filter_, len(data.time_s), chunk_rows):
        if model.is_redundant:
            standard, drive, preload = _balanced(model, data, part, filter_)
        else:
            regressor = model.regressor(data.motion(part), loaded=loaded)
            standard = np.zeros((*support.shape, filter_.rows(regressor.shape[2])))
            standard[support] = filter_(regressor[support])
            drive = preload = np.empty((len(support), 0, standard.shape[2]))
        piece = slice(first, first + standard.shape[2])
        first = piece.stop
        yield Rows(
            current=filter_(data.current_a[part].T),
            standard=standard,
            instrument=standard
            if asked is None
            else model.regressor(_part(asked, piece), loaded=loaded),
            use=use[:, piece],
            motor_use=motor_use[:, piece],
            time_s=time_s[piece],
            move=move[piece],
            drive=drive,
            preload=preload,
        )


def _balanced(
    model: Model, data: Dataset, part: slice, filter_: Decimator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows of a redundantly driven robot:
    columns of the parameters and of the gains at the axes, and N.

    Both sides of Aᵀ diag(v) g = Gᵀ W χ go through the filter, because A changes from sample to
    sample; then, with an A that went through the same filter, they are written as torques of the
    axes.
    """
    columns, to_motors = model.balance(data.motion(part), loaded=data.payload is not None)
    currents = data.current_a[part].T
    slow = filter_(to_motors)
    standard = spread(filter_(columns), slow)
    drive = spread(filter_(to_motors * currents), slow)
    return standard, drive, np.ascontiguousarray(preload_directions(slow).transpose(1, 2, 0))


def demanded_at_rows(demanded: Motion, filter_: Decimator) -> Motion:
    """Decimate a demanded motion to the rows:
    it is slow enough for their rate, and an instrument need not be exact.
    """
    return Motion(*(filter_(getattr(demanded, field.name).T).T for field in fields(Motion)))


def _part(motion: Motion, rows: slice) -> Motion:
    return Motion(
        motion.position_rad[rows], motion.velocity_rad_s[rows], motion.acceleration_rad_s2[rows]
    )


def motor_columns(to_motor: FloatArray, of_joint: Callable[[int], FloatArray]) -> FloatArray:
    """Torque of one motor per unit of each column, (T W)_i, shape (c, r).

    Args:
        to_motor: row i of T (DriveTrain.to_motor), shape (m,).
        of_joint: torque at one of the joints per unit of each column, shape (c, r).
    """
    first, *others = np.flatnonzero(to_motor).tolist()  # T is invertible
    torque = to_motor[first] * of_joint(first)
    for joint in others:
        torque += to_motor[joint] * of_joint(joint)
    return np.asarray(torque)
