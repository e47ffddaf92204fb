"""Rows of W_tot = [V | −W | −W_uL | −W_kL χ_kL] (paper eq.
17), for everything that looks into a residual.

An estimate needs their triangles alone (ident/equations/reduction.py); these are for data of a
usual length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.equations.reduction import ReadRun, payload_values, reduce_rows
from ident.equations.rows import Rows, demanded_at_rows, motor_columns, row_filter, rows_of
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
        parts = [self.regressor[joint][:, rows], self.effects[joint][:, rows]]
        for index, indices in enumerate(self.payload_columns):
            parts.append(
                self.flange[joint][list(indices)][:, rows] * (self.mounting[rows] == index)
            )
        return np.concatenate(parts)

    def known(self, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """W_kL χ_kL of some rows: the joint torque of what is known of the payloads [Nm], shape (m,
        rows).
        """
        # An index of −1, no load, takes the last row, which stays zero.
        weights = np.zeros((len(self.payloads) + 1, 10))
        for index, payload in enumerate(self.payloads):
            weights[index] = payload.known_parameters
        return np.asarray(
            np.einsum("jpr,rp->jr", self.flange[:, :, rows], weights[self.mounting[rows]])
        )

    def motor_columns(self) -> Iterator[FloatArray]:
        """[v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i] of each motor in turn, columns first,
        shape (p + 2, r).

        Of a redundantly driven robot V_i in place of v_i, shape (m + p + 1, r).
        """
        known = self.known()
        for motor, to_motor in enumerate(self.drive_train.to_motor):
            if self.preload.size:
                current = self.drive[motor]
            else:
                current = self.current[motor][None]
            torque = motor_columns(
                to_motor, lambda joint: np.concatenate((self.of_joint(joint), known[joint][None]))
            )
            yield np.concatenate((current, torque))

    def torque(self, gains: FloatArray, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """Y = V g: joint torque from the measured current references (eq.
        4 through R) [Nm], shape (m, rows).
        """
        if self.preload.size:
            return np.asarray(np.einsum("amr,m->ar", self.drive[:, :, rows], gains))
        return self.drive_train.direction.T @ (gains[:, None] * self.current[:, rows])

    def only(self, rows: BoolArray | IntArray | slice) -> Observation:
        """Keep some of the rows, in the order of their indices; those of a slice are views."""
        return replace(self, **{name: getattr(self, name)[..., rows] for name in OBSERVATION_ROWS})

    def extended(self, columns: tuple[Column, ...], torque: FloatArray) -> Observation:
        """Add columns to W, torque of shape (m, extra, r) [Nm per unit];
        what preload hides of them is left out.
        """
        if self.preload.size:
            hidden = np.einsum("alr,apr->lpr", self.preload, torque)
            torque = torque - np.einsum("alr,lpr->apr", self.preload, hidden)
        return replace(
            self,
            columns=self.columns + columns,
            effects=np.concatenate((self.effects, torque), axis=1),
        )

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
        return reduce_rows(
            self,
            self._read_runs(demanded),
            support=support,
            flange=flange,
            given=payload_values(self.payloads, self.payload_columns, columns),
            instruments=demanded is not None,
        )

    def _parts(self) -> list[FloatArray]:
        """[W | W_L]: torque per unit of base parameters, effects and the payload's ten, shapes (m,
        …, r).
        """
        parts = [self.regressor, self.effects]
        if self.payloads:
            parts.append(self.flange)
        return parts

    def _columns(self) -> FloatArray:
        """Join the parts of [W | W_L], shape (m, p, r)."""
        return np.concatenate(self._parts(), axis=1)

    def _support(self) -> BoolArray:
        """Mask of the columns of [W | W_L] that each joint has, shape (m, p)."""
        return np.concatenate([part.any(axis=2) for part in self._parts()], axis=1)

    def _read_runs(self, demanded: Observation | None) -> Iterator[ReadRun]:
        """The rows of one run after the other, those of the demanded motion beside them."""
        for index, name in enumerate(self.runs):
            chosen = np.flatnonzero(self.run == index)
            if not len(chosen):
                yield name, None, ()
                continue
            places: IntArray | slice = chosen
            if len(chosen) == chosen[-1] - chosen[0] + 1:
                places = slice(int(chosen[0]), int(chosen[-1]) + 1)  # of a slice, rows are views
            own = self.only(places)
            columns = own._columns()
            rows = Rows(
                current=own.current,
                standard=columns,
                instrument=columns if demanded is None else demanded.only(places)._columns(),
                use=own.use,
                motor_use=own.motor_use,
                time_s=own.time_s,
                move=own.move,
                drive=own.drive,
                preload=own.preload,
            )
            mounting = int(own.mounting[0])
            yield name, self.payloads[mounting] if mounting >= 0 else None, (rows,)


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
    parts: list[tuple[Rows, FloatArray, FloatArray]] = []
    run = []
    move = []
    mounting = []
    first_move = 0
    shared = ("current", "use", "motor_use", "time_s", "drive", "preload")
    names: list[str] = []
    for index, data in enumerate(runs):
        pieces = rows_of(model, data, conditioning) if built is None else built[index]
        names.append(data.name)
        last = first_move
        if data.payload is None:
            mounted = -1
        else:
            mounted = mountings.index(data.payload.mounting)
        for rows in pieces:
            parts.append(
                (rows, rows.standard[:, base], np.ascontiguousarray(rows.standard[:, model.flange]))
            )
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
        **{
            name: np.concatenate([getattr(rows, name) for rows, _, _ in parts], axis=-1)
            for name in shared
        },
    )


def on_demanded_motion(model: Model, datasets: Sequence[Dataset], rows: Observation) -> Observation:
    """Replace the declared columns by those of the demanded motion, where a run's is known;
    effects' columns stay.

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
            own = rows.run == index
            asked = demanded_at_rows(data.demanded, row_filter(data, rows.conditioning))
            standard = model.regressor(asked, loaded=data.payload is not None)
            regressor[:, :, own], flange[:, :, own] = standard[:, base], standard[:, model.flange]
    return replace(rows, regressor=regressor, flange=flange)
