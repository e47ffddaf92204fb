"""Rows of W_tot = [V | −W | −W_uL | −W_kL χ_kL] (paper eq. 17), for everything that looks into a residual.

An estimate needs their triangles alone (ident/equations/reduction.py); these are for data of a usual length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning, Decimator, decimator
from ident.data.dataset import Dataset
from ident.equations.system import Equations, System
from ident.equations.triangles import Triangles, triangle_of
from ident.errors import DataUnfit
from ident.model.model import Column, Model, preload_directions, spread
from ident.model.robot import Motion

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


def at_rows(data: Dataset, conditioning: Conditioning) -> Dataset:
    """A run at the rows of the equations: motion and clock, and nothing else of it."""
    time_s = decimate_rows(data, conditioning, data.time_s)
    temperature_c = None if data.temperature_c is None else decimate_rows(data, conditioning, data.temperature_c.T).T
    return replace(
        data,
        rate_hz=float((len(time_s) - 1) / (time_s[-1] - time_s[0])),
        time_s=time_s,
        position_rad=decimate_rows(data, conditioning, data.position_rad.T).T,
        velocity_rad_s=decimate_rows(data, conditioning, data.velocity_rad_s.T).T,
        acceleration_rad_s2=decimate_rows(data, conditioning, data.acceleration_rad_s2.T).T,
        temperature_c=temperature_c,
    )


def row_masks(model: Model, data: Dataset, conditioning: Conditioning) -> tuple[BoolArray, BoolArray]:
    """Rows of each axis, and of each motor, that count (Observation.use, .motor_use), both of shape (m, r).

    Preload joins the equations of all motors: of a redundant drive, rows count in which all of them move.
    """
    drive_train = model.drive_train
    filter_ = decimator(data.rate_hz, conditioning.decimation_cutoff_hz)
    # A row's share of standstill is weighted as the filter weights its samples.
    window = Decimator(np.abs(filter_.taps) / np.abs(filter_.taps).sum(), filter_.factor)
    share = conditioning.standstill_share
    use = (window((~data.moving.T).astype(np.float64)) <= share) & (window((~data.valid.T).astype(np.float64)) == 0.0)
    motor_still = window((~data.motor_moving.T).astype(np.float64)) > share
    # Motor i's equation mixes the joints in row i of T (DriveTrain.to_motor); each of them must count.
    needed = np.abs(drive_train.to_motor) > 0
    turned = np.abs(drive_train.direction) > 0
    motor_use = np.stack([use[needed[i] | turned[i]].all(axis=0) & ~motor_still[i] for i in range(len(use))])
    # A coupled motor that sticks leaves an undetermined torque in the equations of all joints it turns with.
    for motor in drive_train.coupled:
        use &= ~(turned[motor][:, None] & motor_still[motor][None, :])
    if model.is_redundant:
        use[:] = motor_use[:] = use.all(axis=0) & motor_use.all(axis=0)
    return use, motor_use


def chunks(filter_: Decimator, samples: int, chunk_rows: int) -> Iterator[slice]:
    """Cut a run's samples into pieces that hold the whole windows of at most ``chunk_rows`` rows each.

    Pieces end at a block of the decimator, except at the end of the run, so that the filter needs no padding.
    """
    rows, blocks = filter_.rows(samples), -(-len(filter_.taps) // filter_.factor)
    for first in range(0, rows, chunk_rows):
        last = min(first + chunk_rows, rows) - 1
        yield slice(first * filter_.factor, min((last + blocks) * filter_.factor, samples))


@dataclass(frozen=True, slots=True)
class Rows:
    """Consecutive decimated rows of one run; arrays are joint-first and time-last."""

    current: FloatArray  #: current references of the motors [A], shape (m, r)
    standard: FloatArray  #: torque at each joint per unit of each standard parameter, shape (m, c, r)
    instrument: FloatArray  #: the same for the demanded motion; the same array where none is known
    use: BoolArray  #: rows of each joint that count: moving and valid, shape (m, r)
    motor_use: BoolArray  #: rows of each motor that count: all joints it turns with, and itself, moving, shape (m, r)
    time_s: FloatArray  #: of each row, since the start of the run, shape (r,)
    move: IntArray  #: number of each row's move within the run, shape (r,)
    #: Of a redundantly driven robot: torque at each axis per unit of each motor's gain, preload taken out, shape
    #: (m, m, r), and N, the torques that move nothing, shape (m, m − d, r). Of others (m, 0, r) both.
    drive: FloatArray
    preload: FloatArray


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
    use, motor_use = row_masks(model, data, conditioning)
    if not use.any():
        raise DataUnfit(data.name, "no row is left after the standstill and validity masks; did the robot move?")
    centres = filter_.centres(len(data.time_s))
    time_s, move = data.time_s[centres] - data.time_s[0], data.move[centres]
    first, support = 0, model.support
    asked = None if data.demanded is None else _decimated(data.demanded, filter_)
    for part in chunks(filter_, len(data.time_s), chunk_rows):
        if model.is_redundant:
            standard, drive, preload = _balanced(model, data, part, filter_)
        else:
            regressor = model.regressor(data.motion(part))
            standard = np.zeros((*support.shape, filter_.rows(regressor.shape[2])))
            standard[support] = filter_(regressor[support])
            drive = preload = np.empty((len(support), 0, standard.shape[2]))
        piece = slice(first, first + standard.shape[2])
        first = piece.stop
        yield Rows(
            current=filter_(data.current_a[part].T),
            standard=standard,
            instrument=standard if asked is None else model.regressor(_part(asked, piece)),
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
    """Rows of a redundantly driven robot: columns of the parameters and of the gains at the axes, and N.

    Both sides of Aᵀ diag(v) g = Gᵀ W χ go through the filter, because A changes from sample to sample; then, with an A
    that went through the same filter, they are written as torques of the axes.
    """
    columns, to_motors = model.balance(data.motion(part))
    currents = data.current_a[part].T
    slow = filter_(to_motors)
    standard = spread(filter_(columns), slow)
    drive = spread(filter_(to_motors * currents), slow)
    return standard, drive, np.ascontiguousarray(preload_directions(slow).transpose(1, 2, 0))


def _decimated(demanded: Motion, filter_: Decimator) -> Motion:
    """A demanded motion at the rows: it is slow enough for their rate, and an instrument need not be exact."""
    return Motion(*(filter_(getattr(demanded, field.name).T).T for field in fields(Motion)))


def _part(motion: Motion, rows: slice) -> Motion:
    return Motion(motion.position_rad[rows], motion.velocity_rad_s[rows], motion.acceleration_rad_s2[rows])


@dataclass(frozen=True, slots=True)
class RunRows:
    """A run with all its rows, for a search: it needs them after the fit."""

    data: Dataset  #: the run
    pieces: tuple[Rows, ...]  #: its rows, piece by piece


OBSERVATION_ROWS = (
    "current",
    "drive",
    "preload",
    "regressor",
    "effects",
    "flange",
    "use",
    "motor_use",
    "time_s",
    "run",
    "move",
    "mounting",
)
"""Fields of an observation that have a row last."""


@dataclass(frozen=True, slots=True)
class Observation(Equations):
    """Rows of several runs, before any scaling; arrays are joint-first and time-last."""

    current: FloatArray  #: decimated current references of the motors [A], shape (m, r)
    regressor: FloatArray  #: torque at each joint per unit of each base parameter: W without effects, shape (m, b, r)
    effects: FloatArray  #: the same of each effect, the other columns of W, shape (m, e, r)
    flange: FloatArray  #: columns of the payload's link, also of the payload while it was mounted, shape (m, 10, r)
    use: BoolArray  #: rows of each joint that count: moving and valid, shape (m, r)
    motor_use: BoolArray  #: rows of each motor that count: all joints it turns with, and itself, moving, shape (m, r)
    time_s: FloatArray  #: of each row, since the start of its run, shape (r,)
    run: IntArray  #: index of each row's run, shape (r,)
    move: IntArray  #: number of each row's move, unique over all runs, shape (r,)
    mounting: IntArray  #: index into payloads, −1 without load, shape (r,)
    drive: FloatArray  #: as of Rows, shape (m, m, r) or (m, 0, r)
    preload: FloatArray  #: N, shape (m, m − d, r)
    conditioning: Conditioning  #: the filters these rows went through

    def of_joint(self, joint: int, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """[W | W_uL] of some rows of a joint, shape (p, rows)."""
        parts = [self.regressor[joint][:, rows], self.effects[joint][:, rows]]
        for index, indices in enumerate(self.payload_columns):
            parts.append(self.flange[joint][list(indices)][:, rows] * (self.mounting[rows] == index))
        return np.concatenate(parts)

    def known(self, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """W_kL χ_kL of some rows: the joint torque of what is known of the payloads [Nm], shape (m, rows)."""
        # An index of −1, no load, takes the last row, which stays zero.
        weights = np.zeros((len(self.payloads) + 1, 10))
        for index, payload in enumerate(self.payloads):
            weights[index] = payload.known_parameters
        return np.asarray(np.einsum("jpr,rp->jr", self.flange[:, :, rows], weights[self.mounting[rows]]))

    def motor_columns(self) -> Iterator[FloatArray]:
        """[v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i] of each motor in turn, columns first, shape (p + 2, r).

        Of a redundantly driven robot V_i in place of v_i, shape (m + p + 1, r).
        """
        known = self.known()
        if self.preload.size:
            for axis, drive in enumerate(self.drive):
                yield np.concatenate((drive, self.of_joint(axis), known[axis][None]))
            return
        for current, row in zip(self.current, self.drive_train.to_motor, strict=True):
            first, *others = np.flatnonzero(row).tolist()  # T is invertible
            columns = np.concatenate((current[None], self.of_joint(first), known[first][None]))
            columns[1:] *= row[first]
            for joint in others:
                columns[1:-1] += row[joint] * self.of_joint(joint)
                columns[-1] += row[joint] * known[joint]
            yield columns

    def torque(self, gains: FloatArray, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """Y = V g: joint torque from the measured current references (eq. 4 through R) [Nm], shape (m, rows)."""
        if self.preload.size:
            return np.asarray(np.einsum("amr,m->ar", self.drive[:, :, rows], gains))
        return self.drive_train.direction.T @ (gains[:, None] * self.current[:, rows])

    def only(self, rows: BoolArray | IntArray | slice) -> Observation:
        """Keep some of the rows, in the order of their indices; those of a slice are views."""
        return replace(self, **{name: getattr(self, name)[..., rows] for name in OBSERVATION_ROWS})

    def extended(self, columns: tuple[Column, ...], torque: FloatArray) -> Observation:
        """Add columns to W, torque of shape (m, extra, r) [Nm per unit]; what preload hides of them is left out."""
        if self.preload.size:
            hidden = np.einsum("alr,apr->lpr", self.preload, torque)
            torque = torque - np.einsum("alr,lpr->apr", self.preload, hidden)
        return replace(self, columns=self.columns + columns, effects=np.concatenate((self.effects, torque), axis=1))

    def _by_move(self, first_column: int = 0) -> tuple[tuple[FloatArray, ...], ...]:
        """The motors' rows that count, parted by move, with their columns from one on."""
        by_move, parts = np.argsort(self.move, kind="stable"), []
        moves = np.unique(self.move[self.motor_use.any(axis=0)])
        for columns, used in zip(self.motor_columns(), self.motor_use, strict=True):
            order = by_move[used[by_move]]
            pieces = np.split(columns[first_column:, order], np.searchsorted(self.move[order], moves[1:]), axis=1)
            parts.append([piece.T for piece in pieces])
        return tuple(zip(*parts, strict=True))

    def system(self, demanded: Observation | None = None) -> System:
        """Reduce the rows to triangles.

        Args:
            demanded: the same rows and columns for the demanded motion: they become the system's instruments.
        """
        known, direction, preloaded = self.known(), self.drive_train.direction, self.preload.size > 0
        joints = []
        for joint, used in enumerate(self.use):
            current = self.drive[joint][:, used] if preloaded else direction[:, joint, None] * self.current[:, used]
            joints.append(
                triangle_of(np.concatenate((current, -self.of_joint(joint, used), -known[joint, used][None])))
            )
        clusters, runs, preload = self._by_move(), [], []
        motors = [triangle_of(np.concatenate(rows).T) for rows in zip(*clusters, strict=True)]
        for move in np.unique(self.move[self.motor_use.any(axis=0)]):
            first = int(np.argmax(self.move == move))
            runs.append((int(self.run[first]), int(self.mounting[first])))
            if preloaded:
                preload.append(self.preload[:, :, (self.move == move) & self.motor_use[0]].transpose(2, 0, 1))
        return System(
            model=self.model,
            base=self.base,
            columns=self.columns,
            payloads=self.payloads,
            payload_columns=self.payload_columns,
            runs=self.runs,
            joints=Triangles(tuple(joints), self.use.sum(axis=1)),
            motors=Triangles(tuple(motors), self.motor_use.sum(axis=1)),
            clusters=clusters,
            cluster_runs=tuple(runs),
            instruments=() if demanded is None else demanded._by_move(first_column=1),
            preload=tuple(preload),
        )


def observe(
    model: Model, runs: Iterable[Dataset | RunRows], conditioning: Conditioning, like: Equations
) -> Observation:
    """Build the rows of several runs.

    Args:
        model: the declared model.
        runs: differentiated runs, or the rows already built of them; each one's payload mounting is among those of
            ``like``.
        conditioning: the filters; every column and the currents go through the same decimation.
        like: whose base parameters and payload parameters these are.

    Raises:
        DataUnfit: a run leaves no usable row.
    """
    base = list(like.base.independent)
    mountings = [payload.mounting for payload in like.payloads]
    parts: list[tuple[Rows, FloatArray, FloatArray]] = []
    run, move, mounting = [], [], []
    first_move, shared = 0, ("current", "use", "motor_use", "time_s", "drive", "preload")
    names: list[str] = []
    for index, given in enumerate(runs):
        data, pieces = (
            (given.data, given.pieces) if isinstance(given, RunRows) else (given, rows_of(model, given, conditioning))
        )
        names.append(data.name)
        last, mounted = first_move, -1 if data.payload is None else mountings.index(data.payload.mounting)
        for rows in pieces:
            parts.append((rows, rows.standard[:, base], np.ascontiguousarray(rows.standard[:, model.flange])))
            move.append(rows.move + first_move)
            last = int(move[-1].max()) + 1
            run.append(np.full(len(rows.move), index, dtype=np.int64))
            mounting.append(np.full(len(rows.move), mounted, dtype=np.int64))
        first_move = last
    return Observation(
        model=model,
        columns=like.columns[: len(base)],
        base=like.base,
        regressor=np.concatenate([regressor for _, regressor, _ in parts], axis=2),
        effects=np.zeros((model.robot.axis_count, 0, sum(map(len, run)))),
        flange=np.concatenate([flange for _, _, flange in parts], axis=2),
        run=np.concatenate(run),
        move=np.concatenate(move),
        mounting=np.concatenate(mounting),
        payloads=like.payloads,
        payload_columns=like.payload_columns,
        runs=tuple(names),
        conditioning=conditioning,
        **{name: np.concatenate([getattr(rows, name) for rows, _, _ in parts], axis=-1) for name in shared},
    )


def on_demanded_motion(model: Model, datasets: Sequence[Dataset], rows: Observation) -> Observation:
    """Replace the declared columns by those of the demanded motion, where a run's is known; effects' columns stay.

    Args:
        model: the declared model.
        datasets: the runs of the rows.
        rows: of these runs.
    """
    regressor, flange, base = rows.regressor.copy(), rows.flange.copy(), list(rows.base.independent)
    for index, data in enumerate(datasets):
        if data.demanded is not None:
            own = rows.run == index
            standard = model.regressor(_decimated(data.demanded, row_filter(data, rows.conditioning)))
            regressor[:, :, own], flange[:, :, own] = standard[:, base], standard[:, model.flange]
    return replace(rows, regressor=regressor, flange=flange)
