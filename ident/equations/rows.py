"""The rows that a run gives: the filter that makes them, the samples behind each, and whether it counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning, Decimator, decimator
from ident.data.dataset import Dataset
from ident.errors import DataUnfit
from ident.model.model import DriveTrain, Model

CHUNK_ROWS = 256  #: Decimated rows built at once: the regressor of their samples stays in the cache's reach


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
            f"{samples / data.rate_hz:.2g} s are too short to decimate at {conditioning.decimation_cutoff_hz:g} Hz",
        )
    return filter_


def decimate_rows(data: Dataset, conditioning: Conditioning, columns: FloatArray) -> FloatArray:
    """Parallel decimation of full-rate columns of a run to the observation's rows: shape (..., k) → (..., r)."""
    return decimator(data.rate_hz, conditioning.decimation_cutoff_hz)(columns)


def row_masks(drive_train: DriveTrain, data: Dataset, conditioning: Conditioning) -> tuple[BoolArray, BoolArray]:
    """Rows of each joint, and of each motor, that count (Observation.use, .motor_use), both of shape (n, r)."""
    filter_ = row_filter(data, conditioning)
    # A row's share of standstill is weighted as the filter weights its samples.
    window = Decimator(np.abs(filter_.taps) / np.abs(filter_.taps).sum(), filter_.factor)
    share = conditioning.standstill_share
    use = (window((~data.moving.T).astype(np.float64)) <= share) & (window((~data.valid.T).astype(np.float64)) == 0.0)
    motor_still = window((~data.motor_moving.T).astype(np.float64)) > share
    # Motor i's equation mixes the joints in row i of T (Model: g v = T τ); each of them must count.
    needed = np.abs(drive_train.to_motor) > 0
    turned = np.abs(drive_train.direction) > 0
    motor_use = np.stack([use[needed[i] | turned[i]].all(axis=0) & ~motor_still[i] for i in range(len(use))])
    # A coupled motor that sticks leaves an undetermined torque in the equations of all joints it turns with.
    for motor in drive_train.coupled:
        use &= ~(turned[motor][:, None] & motor_still[motor][None, :])
    return use, motor_use


def chunks(filter_: Decimator, samples: int, chunk_rows: int) -> Iterator[slice]:
    """Cut a run's samples into pieces with the whole windows of up to so many rows.

    A piece ends with a whole block of the decimator, where the run does not end before: it is then filtered in place.
    """
    rows, blocks = filter_.rows(samples), -(-len(filter_.taps) // filter_.factor)
    for first in range(0, rows, chunk_rows):
        last = min(first + chunk_rows, rows) - 1
        yield slice(first * filter_.factor, min((last + blocks) * filter_.factor, samples))


@dataclass(frozen=True, slots=True)
class Rows:
    """Consecutive decimated rows of one run; arrays are joint-first and time-last."""

    current: FloatArray  #: current references of the motors [A], shape (n, r)
    standard: FloatArray  #: torque at each joint per unit of each standard parameter, shape (n, c, r)
    use: BoolArray  #: rows of each joint that count: moving and valid, shape (n, r)
    motor_use: BoolArray  #: rows of each motor that count: all joints it turns with, and itself, moving, shape (n, r)
    time_s: FloatArray  #: of each row, since the start of the run, shape (r,)
    move: IntArray  #: number of each row's move within the run, shape (r,)


def rows_of(model: Model, data: Dataset, conditioning: Conditioning, chunk_rows: int = CHUNK_ROWS) -> Iterator[Rows]:
    """Build, filter and decimate a run's rows piece by piece; the pieces together do not depend on their length.

    Args:
        model: the declared model.
        data: a differentiated run.
        conditioning: every column and the currents go through the same decimation.
        chunk_rows: rows built at once.

    Raises:
        DataUnfit: the run is too short for the filter, or no row of it counts.
    """
    filter_ = row_filter(data, conditioning)
    use, motor_use = row_masks(model.drive_train, data, conditioning)
    if not use.any():
        raise DataUnfit(data.name, "no row is left after the standstill and validity masks; did the robot move?")
    centres = filter_.centres(len(data.time_s))
    time_s, move = data.time_s[centres] - data.time_s[0], data.move[centres]
    first, support = 0, model.support
    for part in chunks(filter_, len(data.time_s), chunk_rows):
        whole = model.regressor(data.motion(part))
        standard = np.zeros((*support.shape, filter_.rows(whole.shape[2])))
        standard[support] = filter_(whole[support])
        piece = slice(first, first + standard.shape[2])
        first = piece.stop
        yield Rows(
            current=filter_(data.current_a[part].T),
            standard=standard,
            use=use[:, piece],
            motor_use=motor_use[:, piece],
            time_s=time_s[piece],
            move=move[piece],
        )
