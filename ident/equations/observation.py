"""Rows of W_tot = [V | −W | −W_uL | −W_kL χ_kL] (eq. 17), for whatever looks into a residual.

An estimate needs their triangles alone (ident/equations/reduction.py); these are for data of a
usual length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning, as_recorded
from ident.data.dataset import Dataset
from ident.equations.reduction import ReadRun, payload_values, reduce_rows
from ident.equations.rows import (
    Rows,
    demanded_at_rows,
    motor_columns,
    row_filter,
    rows_of,
)
from ident.equations.system import Equations, System
from ident.model.model import Column, Model

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
    #: torque at each joint per unit of each base parameter: W without effects, shape (m, b, r)
    regressor: FloatArray
    effects: FloatArray  #: the same of each effect, the other columns of W, shape (m, e, r)
    #: columns of the payload's link, also of the payload while it was mounted, shape (m, 10, r)
    flange: FloatArray
    use: BoolArray  #: rows of each joint that count: moving and valid, shape (m, r)
    #: rows of each motor that count: all joints it turns with, and itself, moving, shape (m, r)
    motor_use: BoolArray
    time_s: FloatArray  #: of each row, since the start of its run, shape (r,)
    run: IntArray  #: index of each row's run, shape (r,)
    move: IntArray  #: number of each row's move, unique over all runs, shape (r,)
    mounting: IntArray  #: index into payloads, −1 without load, shape (r,)
    drive: FloatArray  #: as of Rows, shape (m, m, r) or (m, 0, r)
    preload: FloatArray  #: N, shape (m, m − d, r)
    conditioning: Conditioning  #: the filters these rows went through

    def of_joint(self, joint: int, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """[W | W_uL] of some rows of a joint, shape (p, rows)."""
        base = self.regressor[joint][:, rows]
        effects = self.effects[joint][:, rows]
        flange = self.flange[joint]
        parts = [base, effects]
        mounting = self.mounting[rows]
        for index, indices in enumerate(self.payload_columns):
            columns = flange[list(indices)][:, rows]
            is_mounted = mounting == index
            parts.append(columns * is_mounted)
        return np.concatenate(parts)

    def known(self) -> FloatArray:
        """W_kL χ_kL: joint torque of what is known of the payloads [Nm], shape (m, r)."""
        # An index of −1, no load, takes the last row, which stays zero.
        weights = np.zeros((len(self.payloads) + 1, 10))
        for index, payload in enumerate(self.payloads):
            weights[index] = payload.known_parameters
        parameters = weights[self.mounting]
        # Σ_p (W_L)_jpr χ_rp of each joint j and row r
        torque = np.einsum("jpr,rp->jr", self.flange, parameters)
        return np.asarray(torque)

    def motor_columns(self) -> Iterator[FloatArray]:
        """[v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i] of each motor, columns first, (p + 2, r).

        Of a redundantly driven robot V_i in place of v_i, shape (m + p + 1, r).
        """
        known = self.known()

        def of_joint(joint: int) -> FloatArray:
            """[W | W_uL | W_kL χ_kL] of a joint."""
            return np.concatenate((self.of_joint(joint), known[joint][None]))

        for motor, to_motor in enumerate(self.drive_train.to_motor):
            if self.preload.size:
                current = self.drive[motor]
            else:
                current = self.current[motor][None]
            torque = motor_columns(to_motor, of_joint)
            yield np.concatenate((current, torque))

    def torque(self, gains: FloatArray, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """Y = V g: joint torque from measured currents (eq. 4 through R) [Nm], shape (m, rows)."""
        if self.preload.size:
            # Σ_m V_amr g_m of each axis a and row r
            torque = np.einsum("amr,m->ar", self.drive[:, :, rows], gains)
            return np.asarray(torque)
        motor_torque = gains[:, None] * self.current[:, rows]
        return self.drive_train.direction.T @ motor_torque

    def only(self, rows: BoolArray | IntArray | slice) -> Observation:
        """Keep some of the rows, in the order of their indices; those of a slice are views."""
        chosen = {name: getattr(self, name)[..., rows] for name in OBSERVATION_ROWS}
        return replace(self, **chosen)

    def extended(self, columns: tuple[Column, ...], torque: FloatArray) -> Observation:
        """Add columns to W, (m, extra, r) [Nm per unit]; what preload hides of them is left out."""
        if self.preload.size:
            # (1 − N Nᵀ) of the torque, row by row
            hidden = np.einsum("alr,apr->lpr", self.preload, torque)
            hidden_torque = np.einsum("alr,lpr->apr", self.preload, hidden)
            torque = torque - hidden_torque
        effects = np.concatenate((self.effects, torque), axis=1)
        return replace(self, columns=self.columns + columns, effects=effects)

    def system(self, demanded: Observation | None = None) -> System:
        """Reduce the rows to triangles.

        Args:
            demanded: the same rows and columns for the demanded motion: they become the system's
                instruments.
        """
        support = self._support()
        if demanded is not None:
            support |= demanded._support()
        columns = len(self.columns)
        flange = np.arange(columns, support.shape[1])
        given = payload_values(self.payloads, self.payload_columns, columns)
        runs = self._read_runs(demanded)
        has_instruments = demanded is not None
        return reduce_rows(
            self, runs, support=support, flange=flange, given=given, instruments=has_instruments
        )

    def _parts(self) -> list[FloatArray]:
        """[W | W_L]: torque per unit of base parameters, effects and payload, shapes (m, …, r)."""
        parts = [self.regressor, self.effects]
        if self.payloads:
            parts.append(self.flange)
        return parts

    def _columns(self) -> FloatArray:
        """Join the parts of [W | W_L], shape (m, p, r)."""
        return np.concatenate(self._parts(), axis=1)

    def _support(self) -> BoolArray:
        """Mask of the columns of [W | W_L] that each joint has, shape (m, p)."""
        masks = [part.any(axis=2) for part in self._parts()]
        return np.concatenate(masks, axis=1)

    def _read_runs(self, demanded: Observation | None) -> Iterator[ReadRun]:
        """The rows of one run after the other, with those of the demanded motion."""
        for index, name in enumerate(self.runs):
            indices = np.flatnonzero(self.run == index)
            if not len(indices):
                yield name, None, ()
                continue
            chosen = _as_slice(indices)
            own = self.only(chosen)
            columns = own._columns()
            instrument = columns
            if demanded is not None:
                instrument = demanded.only(chosen)._columns()
            rows = Rows(
                current=own.current,
                standard=columns,
                instrument=instrument,
                use=own.use,
                motor_use=own.motor_use,
                time_s=own.time_s,
                move=own.move,
                drive=own.drive,
                preload=own.preload,
            )
            payload = None
            mounting = int(own.mounting[0])
            if mounting >= 0:
                payload = self.payloads[mounting]
            yield name, payload, (rows,)


def _as_slice(indices: IntArray) -> IntArray | slice:
    """Ascending indices as a slice where none is left out: the rows of a slice are views."""
    first = int(indices[0])
    last = int(indices[-1])
    if len(indices) == last - first + 1:
        return slice(first, last + 1)
    return indices


def observe(
    model: Model,
    runs: Sequence[Dataset],
    conditioning: Conditioning,
    like: Equations,
    built: Sequence[Sequence[Rows]] | None = None,
) -> Observation:
    """Build the rows of several runs.

    Args:
        model: the declared model.
        runs: differentiated runs; each one's payload mounting is among those of ``like``.
        conditioning: the filters; every column and the currents go through the same decimation.
        like: whose base parameters and payload parameters these are.
        built: the rows of each run, piece by piece, where they are at hand.

    Raises:
        DataUnfit: a run leaves no usable row.
    """
    base = list(like.base.independent)
    mountings = [payload.mounting for payload in like.payloads]
    parts: list[Rows] = []
    regressor: list[FloatArray] = []
    flange: list[FloatArray] = []
    run: list[IntArray] = []
    move: list[IntArray] = []
    mounting: list[IntArray] = []
    moves_before = 0
    for index, data in enumerate(runs):
        pieces: Iterable[Rows]
        if built is None:
            pieces = rows_of(model, data, conditioning)
        else:
            pieces = built[index]
        mounted = -1
        if data.payload is not None:
            mounted = mountings.index(data.payload.mounting)
        moves_so_far = moves_before
        for rows in pieces:
            count = len(rows.move)
            own_move = rows.move + moves_before
            moves_so_far = int(own_move.max()) + 1
            parts.append(rows)
            regressor.append(rows.standard[:, base])
            of_flange = rows.standard[:, model.flange]
            flange.append(np.ascontiguousarray(of_flange))
            move.append(own_move)
            run.append(np.full(count, index, dtype=np.int64))
            mounting.append(np.full(count, mounted, dtype=np.int64))
        moves_before = moves_so_far
    run_of_row = np.concatenate(run)
    no_effects = np.zeros((model.robot.axis_count, 0, len(run_of_row)))
    current = np.concatenate([rows.current for rows in parts], axis=-1)
    use = np.concatenate([rows.use for rows in parts], axis=-1)
    motor_use = np.concatenate([rows.motor_use for rows in parts], axis=-1)
    time_s = np.concatenate([rows.time_s for rows in parts])
    drive = np.concatenate([rows.drive for rows in parts], axis=-1)
    preload = np.concatenate([rows.preload for rows in parts], axis=-1)
    return Observation(
        model=model,
        columns=like.columns[: len(base)],
        base=like.base,
        regressor=np.concatenate(regressor, axis=2),
        effects=no_effects,
        flange=np.concatenate(flange, axis=2),
        run=run_of_row,
        move=np.concatenate(move),
        mounting=np.concatenate(mounting),
        payloads=like.payloads,
        payload_columns=like.payload_columns,
        runs=tuple(data.name for data in runs),
        conditioning=conditioning,
        current=current,
        use=use,
        motor_use=motor_use,
        time_s=time_s,
        drive=drive,
        preload=preload,
    )


def on_demanded_motion(model: Model, datasets: Sequence[Dataset], rows: Observation) -> Observation:
    """Replace declared columns by those of the demanded motion where it is known; effects stay.

    Args:
        model: the declared model.
        datasets: the runs of the rows.
        rows: of these runs.
    """
    regressor = rows.regressor.copy()
    flange = rows.flange.copy()
    base = list(rows.base.independent)
    for index, data in enumerate(datasets):
        if data.demanded is not None:
            of_run = rows.run == index
            filter_ = row_filter(data, rows.conditioning)
            demanded = demanded_at_rows(data.demanded, filter_)
            at_rows = model.regressor(demanded, loaded=data.payload is not None)
            rate_hz = data.rate_hz / filter_.factor
            standard = as_recorded(rate_hz, rows.conditioning, at_rows)
            regressor[:, :, of_run] = standard[:, base]
            flange[:, :, of_run] = standard[:, model.flange]
    return replace(rows, regressor=regressor, flange=flange)
