"""Rows of [V | W] of one run in standard parameters, filtered and decimated (paper eqs. 13 and 14);
the columns of a motor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray, true_stretches
from ident.data.conditioning import (
    Conditioning,
    Decimator,
    as_recorded,
    current_rows,
    memory_samples,
    torque_rows,
)
from ident.data.dataset import Dataset
from ident.errors import DataUnfit, ModelError
from ident.model.model import Model, preload_directions, spread
from ident.model.robot import Motion, each_state

#: Decimated rows built at once: the regressor of their samples stays in the cache's reach
CHUNK_ROWS = 256
SHORTEST_REST_S = 0.2  #: A standstill that is shorter is one of a joint that turns back
FEWEST_ROWS = 10  #: Rows of the shortest run


def row_filter(data: Dataset, conditioning: Conditioning) -> Decimator:
    """The parallel decimation of a run's currents to rows; `torque_rows` is that of torques.

    Raises:
        DataUnfit: the run is too short for it.
    """
    cutoff_hz = conditioning.decimation_cutoff_hz
    filter_ = current_rows(data.rate_hz, conditioning)
    samples = len(data.time_s)
    if filter_.rows(samples) < FEWEST_ROWS:
        duration_s = samples / data.rate_hz
        raise DataUnfit(
            data.name, f"{duration_s:.2g} s are too short to decimate at {cutoff_hz:g} Hz"
        )
    return filter_


def decimate_rows(data: Dataset, conditioning: Conditioning, columns: FloatArray) -> FloatArray:
    """Parallel decimation of full-rate columns of a run to the observation's rows:
    shape (..., k) → (..., r).
    """
    filter_ = current_rows(data.rate_hz, conditioning)
    return filter_(columns)


def torques_at_rows(data: Dataset, conditioning: Conditioning, columns: FloatArray) -> FloatArray:
    """Decimate columns of torque as the equations do, shape (..., k) → (..., r):
    through the low-pass of the currents, too, where they went through one.
    """
    filter_ = torque_rows(data.rate_hz, conditioning)
    return filter_(columns)


def at_rows(data: Dataset, conditioning: Conditioning) -> Dataset:
    """A run at the rows of the equations: motion and clock, and nothing else of it."""
    time_s = decimate_rows(data, conditioning, data.time_s)
    duration_s = time_s[-1] - time_s[0]

    def decimated(samples: FloatArray) -> FloatArray:
        """Time first, shape (k, m) → (r, m)."""
        return decimate_rows(data, conditioning, samples.T).T

    temperature_c = data.temperature_c
    if temperature_c is not None:
        temperature_c = decimated(temperature_c)
    return replace(
        data,
        rate_hz=float((len(time_s) - 1) / duration_s),
        time_s=time_s,
        position_rad=decimated(data.position_rad),
        velocity_rad_s=decimated(data.velocity_rad_s),
        acceleration_rad_s2=decimated(data.acceleration_rad_s2),
        temperature_c=temperature_c,
    )


def row_masks(
    model: Model, data: Dataset, conditioning: Conditioning
) -> tuple[BoolArray, BoolArray]:
    """Rows of each axis, and of each motor, that count (Observation.use, .motor_use),
    both of shape (m, r).

    Where the currents went through a low-pass, a row has torques of samples around its own window,
    too. At most `standstill_share` of it may be those of a rest, in which dry friction may be any.
    A joint that turns back rests for a moment only, and its friction turns with it. Samples whose
    current alone is not valid do no harm there; where no axis is valid, positions are not known,
    and neither is any torque.

    A flag of `Dataset.valid` is of an axis: of the position of joint i, and of the current of
    motor i, which is in the equations of all joints that it turns.

    Preload joins the equations of all motors: of a redundant drive, rows count in which all of them
    move.
    """
    drive_train = model.drive_train
    # A row's share of standstill is weighted as the filter weights its samples.
    window = _shares(current_rows(data.rate_hz, conditioning))
    largest_share = conditioning.standstill_share
    still_share = _share_without(data.moving, window)
    invalid_share = _share_without(data.valid, window)
    is_wrong = invalid_share > 0.0
    use = (still_share <= largest_share) & ~is_wrong
    motor_still = _share_without(data.motor_moving, window) > largest_share
    if conditioning.current_cutoff_hz:
        memory = _shares(torque_rows(data.rate_hz, conditioning))
        shortest = round(SHORTEST_REST_S * data.rate_hz)
        use &= _share_without(~_rests(~data.moving, shortest), memory) <= largest_share
        is_known = np.asarray(data.valid.any(axis=1), dtype=np.bool_)
        use &= _share_without(is_known[:, None], memory) == 0.0
        motor_rests = _rests(~data.motor_moving, shortest)
        motor_still |= _share_without(~motor_rests, memory) > largest_share
    # Motor i's equation mixes the joints in row i of T (DriveTrain.to_motor); each of them must
    # count.
    is_mixed = np.abs(drive_train.to_motor) > 0
    is_turned = np.abs(drive_train.direction) > 0
    motor_use = np.empty_like(use)
    for motor, still in enumerate(motor_still):
        joints = is_mixed[motor] | is_turned[motor]
        motor_use[motor] = use[joints].all(axis=0) & ~still & ~is_wrong[motor]
    # A coupled motor that sticks leaves an undetermined torque in the equations of all joints it
    # turns with.
    for motor in drive_train.coupled:
        stuck = is_turned[motor][:, None] & motor_still[motor][None, :]
        use &= ~stuck
    # Row j is Y_j = Σ_i r_ij g_i v_i: a current that is wrong spoils the rows of all joints that
    # its motor turns.
    for motor, turned in enumerate(is_turned):
        spoiled = turned[:, None] & is_wrong[motor][None, :]
        use &= ~spoiled
    if model.is_redundant:
        all_move = use.all(axis=0) & motor_use.all(axis=0)
        use[:] = all_move
        motor_use[:] = all_move
    return use, motor_use


def require_any_row(data: Dataset, use: BoolArray) -> None:
    """Refuse a run without a row that counts, by those of each axis, shape (m, r).

    Raises:
        DataUnfit: no row counts.
    """
    if not use.any():
        raise DataUnfit(
            data.name, "no row is left after the standstill and validity masks; did the robot move?"
        )


def _rests(still: BoolArray, shortest: int) -> BoolArray:
    """Samples of each column that are still for so many samples at least, shape (k, m)."""
    found = np.zeros_like(still)
    for own, column in zip(found.T, still.T, strict=True):
        for begin, end in true_stretches(column):
            own[begin:end] = end - begin >= shortest
    return found


def _shares(filter_: Decimator) -> Decimator:
    """Weight of each sample in a filter's window, as a share of all."""
    weights = np.abs(filter_.taps)
    return Decimator(weights / weights.sum(), filter_.factor)


def _share_without(flags: BoolArray, window: Decimator) -> FloatArray:
    """Share of each row's samples that do not have a flag, shape (k, m) → (m, r)."""
    without = ~flags.T
    return window(without.astype(np.float64))


def chunks(filter_: Decimator, samples: int, chunk_rows: int) -> Iterator[slice]:
    """Cut a run's samples into pieces, each with the complete windows of at most ``chunk_rows``
    rows.

    Pieces end at a block of the decimator, except at the end of the run, so that the filter needs
    no padding.
    """
    factor = filter_.factor
    rows = filter_.rows(samples)
    blocks_of_window = ceil(len(filter_.taps) / factor)
    for first in range(0, rows, chunk_rows):
        last = min(first + chunk_rows, rows) - 1
        end = (last + blocks_of_window) * factor
        yield slice(first * factor, min(end, samples))


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
        ModelError: the currents of a redundant drive went through a low-pass.
    """
    if model.is_redundant and conditioning.current_cutoff_hz:
        raise ModelError(
            f"found current_cutoff_hz = {conditioning.current_cutoff_hz:g} for a robot with more "
            "motors than degrees of freedom; expected 0: how the motors share a torque changes "
            "while they move, and a low-pass of their currents is not modelled; leave it out"
        )
    filter_ = row_filter(data, conditioning)
    use, motor_use = row_masks(model, data, conditioning)
    require_any_row(data, use)
    samples = len(data.time_s)
    centres = filter_.centres(samples)
    time_s = data.time_s[centres] - data.time_s[0]
    move = data.move[centres]
    demanded = None
    if data.demanded is not None:
        demanded = demanded_at_rows(data.demanded, filter_)
    of_torque = torque_rows(data.rate_hz, conditioning)
    first = 0
    for part in chunks(filter_, samples, chunk_rows):
        if model.is_redundant:
            standard, drive, preload = _balanced(model, data, part, filter_)
        else:
            standard = _filtered_regressor(model, data, part, of_torque)
            drive = np.empty((len(standard), 0, standard.shape[2]))
            preload = drive
        piece = slice(first, first + standard.shape[2])
        first = piece.stop
        instrument = standard
        if demanded is not None:
            instrument = _instruments(model, data, demanded, piece, conditioning)
        yield Rows(
            current=filter_(data.current_a[part].T),
            standard=standard,
            instrument=instrument,
            use=use[:, piece],
            motor_use=motor_use[:, piece],
            time_s=time_s[piece],
            move=move[piece],
            drive=drive,
            preload=preload,
        )


def _filtered_regressor(model: Model, data: Dataset, part: slice, filter_: Decimator) -> FloatArray:
    """Columns of the parameters at the joints, shape (m, c, r);
    those that a joint does not have are zero.
    """
    regressor = model.regressor(data.motion(part), loaded=data.payload is not None)
    support = model.support
    rows = filter_.rows(regressor.shape[2])
    filtered = np.zeros((*support.shape, rows))
    filtered[support] = filter_(regressor[support])
    return filtered


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
    filtered_to_motors = filter_(to_motors)
    standard = spread(filter_(columns), filtered_to_motors)
    driven = filter_(to_motors * currents)
    drive = spread(driven, filtered_to_motors)
    preload = preload_directions(filtered_to_motors).transpose(1, 2, 0)
    return standard, drive, np.ascontiguousarray(preload)


def demanded_at_rows(demanded: Motion, filter_: Decimator) -> Motion:
    """Decimate a demanded motion to the rows:
    it is slow enough for their rate, and an instrument need not be exact.
    """
    return each_state(demanded, lambda states: filter_(states.T).T)


def _instruments(
    model: Model, data: Dataset, demanded: Motion, piece: slice, conditioning: Conditioning
) -> FloatArray:
    """Columns of the parameters of some rows for the demanded motion, shape (m, c, r).

    Args:
        model: the declared model.
        data: the run.
        demanded: its demanded motion at all rows.
        piece: the rows.
        conditioning: the filters.
    """
    rate_hz = data.rate_hz / row_filter(data, conditioning).factor
    memory = memory_samples(rate_hz, conditioning)
    first = max(piece.start - memory, 0)
    around = slice(first, piece.stop + memory)
    part = each_state(demanded, lambda states: states[around])
    columns = model.regressor(part, loaded=data.payload is not None)
    recorded = as_recorded(rate_hz, conditioning, columns)
    return recorded[..., piece.start - first : piece.stop - first]


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
