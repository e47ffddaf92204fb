"""Runs, one after the other, reduced to triangles: the observation matrix is never held whole (TSQR).

Rows are reduced in the standard columns [V | W_st], separately for each payload mounting. The same triangles serve
every choice of base parameters and of known payload parameters, because a payload has the columns of the link that
carries it, in the rows in which it was mounted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.demand import with_demand
from ident.data.run import Run
from ident.equations.instants import Instants, instants_of
from ident.equations.rows import CHUNK_ROWS, Rows, RunRows, rows_of
from ident.equations.system import System
from ident.equations.triangles import Triangles, qr_update, triangle
from ident.errors import DataUnfit
from ident.model.base import SMALLEST_COLUMN, BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Column, Model

MAX_CLUSTERS = 256
"""Moves of very long data are joined with their neighbours: 256 clusters estimate the scatter as well as 3000."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """The motor rows of one move, or of several that follow each other in one run."""

    mounting: int  #: index into the payloads, −1 without load
    run: int  #: index into the runs
    #: For each motor i the rows, or where they are many their triangle, of [v_i | (T W_st)_i], the columns that the
    #: motor's equation can hold (``Layout.motor``); with instruments [v_i | (T W_st)_i | (T Z_st)_i]. Of a redundantly
    #: driven robot always the rows, with the torques per unit of all gains, V_i, in place of v_i.
    factors: tuple[FloatArray, ...]
    preload: FloatArray  #: N of these rows, shape (rows, m, m − d); empty where no motor works against another


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of [v_1 … v_m | W_st] that each joint's or motor's equation holds."""

    joint: tuple[IntArray, ...]  #: for each joint, indices into [V | W_st], ascending
    motor: tuple[IntArray, ...]  #: for each motor, indices of W_st; its own current comes before them


@dataclass(frozen=True, slots=True)
class Reduction:
    """Triangles of several runs in standard columns."""

    model: Model  #: the declared model
    conditioning: Conditioning  #: the filters that the rows went through
    payloads: tuple[Payload, ...]  #: one for each mounting
    runs: tuple[str, ...]  #: names of the runs
    #: For each mounting, −1 (without load) first, the triangle of each joint's rows.
    joints: tuple[tuple[FloatArray, ...], ...]
    joint_rows: IntArray  #: equations of each joint, shape (m,)
    motor_rows: IntArray  #: equations of each motor, shape (m,)
    clusters: tuple[Cluster, ...]  #: in the order of the runs
    instrumented: bool = False  #: the clusters hold instruments, made of the demanded motion
    kept: tuple[RunRows, ...] = ()  #: the runs with all their rows, where they were asked for
    instants: tuple[Instants, ...] = ()  #: a few rows of each run, where they were asked for

    def base(self) -> BaseParameters:
        """The base parameters that these rows show.

        Raises:
            DataUnfit: a joint never moves.
        """
        for joint, rows in enumerate(self.joint_rows):
            if not rows:
                reason = f"{self.model.robot.axes[joint].name} never moves faster than its standstill speed in any run"
                raise DataUnfit(", ".join(self.runs), reason)
        names = tuple(column.name for column in self.model.columns)
        return base_parameters(np.concatenate([self._standard(index) for index in range(len(self.joints))]), names)

    def _standard(self, index: int) -> FloatArray:
        """W_st of all joints' triangles of a mounting (0: without load), columns spread out."""
        count, columns = self.model.robot.axis_count, layout(self.model).joint
        return np.concatenate(
            [_widened(f, c, count + len(self.model.columns)) for f, c in zip(self.joints[index], columns, strict=True)]
        )[:, count:]

    def payload_columns(self) -> tuple[tuple[int, ...], ...]:
        """For each mounting, its unknown parameters that these rows see, as indices of LINK_PARAMETERS."""
        chosen: list[tuple[int, ...]] = []
        for index, payload in enumerate(self.payloads):
            flange = self._standard(index + 1)[:, self.model.flange]
            norms = np.linalg.norm(flange, axis=0)
            # On a platform that never turns, most of the ten are rounding errors beside the mass.
            shown = norms > SMALLEST_COLUMN * norms.max(initial=0.0)
            unknown = tuple(i for i, name in enumerate(LINK_PARAMETERS) if name not in payload.known and shown[i])
            names = tuple(LINK_PARAMETERS[i] for i in unknown)
            seen = base_parameters(flange[:, list(unknown)], names).independent if unknown else ()
            chosen.append(tuple(unknown[i] for i in seen))
        return tuple(chosen)

    def system(self, base: BaseParameters, payload_columns: tuple[tuple[int, ...], ...]) -> System:
        """Eq. (17) with these base parameters and unknown payload parameters."""
        plan, count, standard = layout(self.model), self.model.robot.axis_count, len(self.model.columns)
        leading = len(base.independent)
        width = leading + sum(map(len, payload_columns)) + 1

        def chosen(rows: FloatArray, mounting: int) -> FloatArray:
            """[W | W_uL | W_kL χ_kL] among the standard columns."""
            out = np.zeros((len(rows), width))
            out[:, :leading] = rows[:, list(base.independent)]
            if mounting >= 0:
                flange, first = rows[:, self.model.flange], leading + sum(map(len, payload_columns[:mounting]))
                indices = list(payload_columns[mounting])
                out[:, first : first + len(indices)] = flange[:, indices]
                out[:, -1] = flange @ self.payloads[mounting].known_parameters
            return out

        joints = []
        for joint in range(count):
            parts = []
            for index, factors in enumerate(self.joints):
                spread = _widened(factors[joint], plan.joint[joint], count + standard)
                parts.append(np.concatenate((spread[:, :count], -chosen(spread[:, count:], index - 1)), axis=1))
            joints.append(triangle(parts, count + width))

        lead = count if self.model.is_redundant else 1

        def part(cluster: Cluster, number: int) -> list[FloatArray]:
            """The columns of each motor's equation in one of the parts of a cluster's rows: W_st, Z_st."""
            return [
                chosen(
                    _widened(rows[:, lead + number * len(c) : lead + (number + 1) * len(c)], c, standard),
                    cluster.mounting,
                )
                for rows, c in zip(cluster.factors, plan.motor, strict=True)
            ]

        clusters = tuple(
            tuple(np.concatenate((rows[:, :lead], own), 1) for rows, own in zip(c.factors, part(c, 0), strict=True))
            for c in self.clusters
        )
        instruments = tuple(tuple(part(c, 1)) for c in self.clusters) if self.instrumented else ()
        motors = tuple(triangle((cluster[motor] for cluster in clusters), lead + width) for motor in range(count))
        named = zip(base.names, base.independent, strict=True)
        return System(
            model=self.model,
            base=base,
            columns=tuple(Column(name, self.model.columns[index].unit) for name, index in named),
            payloads=self.payloads,
            payload_columns=payload_columns,
            runs=self.runs,
            joints=Triangles(tuple(joints), self.joint_rows),
            motors=Triangles(motors, self.motor_rows),
            clusters=clusters,
            cluster_runs=tuple((cluster.run, cluster.mounting) for cluster in self.clusters),
            instruments=instruments,
            preload=tuple(c.preload for c in self.clusters) if self.model.is_redundant else (),
        )


def layout(model: Model) -> Layout:
    """Columns of [V | W_st] that each joint's or motor's equation can hold (Model.support through T)."""
    support, train = model.support, model.drive_train
    current = np.ones_like(train.direction) if model.is_redundant else train.direction.T != 0.0
    mixed = (np.abs(train.to_motor) > 0.0).astype(np.int64) @ support.astype(np.int64) > 0
    return Layout(
        joint=tuple(np.flatnonzero(np.concatenate((v, w))) for v, w in zip(current, support, strict=True)),
        motor=tuple(np.flatnonzero(row) for row in mixed),
    )


def reduce_runs(
    model: Model,
    runs: Iterable[Run | RunRows],
    conditioning: Conditioning,
    *,
    payloads: Sequence[Payload] = (),
    instruments: bool = False,
    keep_rows: bool = False,
    keep_instants: bool = False,
    chunk_rows: int = CHUNK_ROWS,
) -> Reduction:
    """Reduce runs one after the other; no more than one of them is held, unless their rows are asked for.

    Args:
        model: the declared model.
        runs: read while they are reduced, or the rows already built of them; a mounting that several share has one set
            of unknowns.
        conditioning: the filters.
        payloads: known beforehand; others are added as runs bring them.
        instruments: keep those of the demanded motion beside the rows; where it is not known, the recorded one serves.
        keep_rows: keep all runs and their rows, for `observe`.
        keep_instants: keep a few rows of each run, for hypotheses about its geometry.
        chunk_rows: rows built at once; the result does not depend on it.

    Raises:
        DataUnfit: a run is unfit, leaves no usable row, or contradicts another about a mounting.
    """
    count, plan = model.robot.axis_count, layout(model)
    instruments = instruments and not model.is_redundant
    width = tuple(len(columns) for columns in plan.joint)
    seen_payloads = list(payloads)
    joints = [[np.zeros((c, c)) for c in width] for _ in range(len(seen_payloads) + 1)]
    joint_rows, motor_rows = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    names: list[str] = []
    clusters: list[Cluster] = []
    kept: list[RunRows] = []
    instants: list[Instants] = []
    known = False
    for run in runs:
        data = run.data if isinstance(run, RunRows) else differentiate(run, model.drive_train, conditioning)
        mounting = mounting_index(data.payload, seen_payloads, data.name)
        joints += [[np.zeros((c, c)) for c in width] for _ in range(len(seen_payloads) + 1 - len(joints))]
        if keep_instants:
            chosen = instants_of(model, data, conditioning)
            instants += [] if chosen is None else [chosen]
        if instruments:
            data = with_demand(data, model.drive_train, conditioning)
            known |= data.demanded is not None
        moves: dict[int, list[tuple[list[FloatArray], FloatArray]]] = {}
        built: Iterable[Rows] = (
            run.pieces if isinstance(run, RunRows) else rows_of(model, data, conditioning, chunk_rows)
        )
        if keep_rows:
            kept.append(RunRows(data, tuple(built)))
            built = kept[-1].pieces
        for rows in built:
            for joint, used in enumerate(rows.use):
                own = plan.joint[joint][plan.joint[joint] < count]
                if model.is_redundant:
                    current = rows.drive[joint][:, used]
                else:
                    current = model.drive_train.direction[own, joint, None] * rows.current[own][:, used]
                standard = rows.standard[joint][plan.joint[joint][len(own) :] - count][:, used]
                columns = np.concatenate((current, standard))
                joints[mounting + 1][joint] = qr_update(joints[mounting + 1][joint], columns)
            joint_rows += rows.use.sum(axis=1)
            motor_rows += rows.motor_use.sum(axis=1)
            for move, parts in _motor_rows(model, rows, plan, instruments=instruments).items():
                moves.setdefault(move, []).append(parts)
        for pieces in moves.values():
            clusters.append(_cluster(mounting, len(names), pieces))
            if len(clusters) > 2 * MAX_CLUSTERS:
                clusters = _joined(clusters)
        names.append(data.name)
    if len(clusters) > MAX_CLUSTERS:
        clusters = _joined(clusters)
    return Reduction(
        model=model,
        conditioning=conditioning,
        payloads=tuple(seen_payloads),
        runs=tuple(names),
        joints=tuple(tuple(factors) for factors in joints),
        joint_rows=joint_rows,
        motor_rows=motor_rows,
        clusters=tuple(clusters),
        instrumented=known,
        kept=tuple(kept),
        instants=tuple(instants),
    )


def mounting_index(payload: Payload | None, payloads: list[Payload], run: str) -> int:
    """Index of a payload among those met so far, to which a new one is added; −1 without load.

    Raises:
        DataUnfit: its mounting carries something else here than in another run.
    """
    if payload is None:
        return -1
    for index, known in enumerate(payloads):
        if known.mounting == payload.mounting:
            if known != payload:
                raise DataUnfit(
                    run,
                    f"mounting {payload.mounting!r} carries {payload} here and {known} in another run; "
                    "give each way of mounting a name of its own",
                )
            return index
    payloads.append(payload)
    return len(payloads) - 1


def _motor_rows(
    model: Model, rows: Rows, plan: Layout, *, instruments: bool
) -> dict[int, tuple[list[FloatArray], FloatArray]]:
    """Rows [v_i | (T W_st)_i] of each motor, with instruments (T Z_st)_i too, and N, parted by move."""
    to_motor = model.drive_train.to_motor
    by_motor = []
    for motor, held in enumerate(plan.motor):
        joints = np.flatnonzero(to_motor[motor])
        parts_of = (rows.standard, rows.instrument) if instruments else (rows.standard,)
        mixed = [sum(to_motor[motor, joint] * part[joint][held] for joint in joints) for part in parts_of]
        own = rows.drive[motor] if model.is_redundant else rows.current[motor][None]
        by_motor.append(np.concatenate((own, *map(np.asarray, mixed))))
    parts: dict[int, tuple[list[FloatArray], FloatArray]] = {}
    for move in np.unique(rows.move):
        here = rows.motor_use & (rows.move == move)
        if here.any():
            own_rows = [columns[:, used].T for columns, used in zip(by_motor, here, strict=True)]
            parts[int(move)] = own_rows, rows.preload[:, :, here[0]].transpose(2, 0, 1)
    return parts


def _cluster(mounting: int, run: int, pieces: list[tuple[list[FloatArray], FloatArray]]) -> Cluster:
    preload = np.concatenate([one for _, one in pieces])
    factors = zip(*(rows for rows, _ in pieces), strict=True)
    if preload.size:
        return Cluster(mounting, run, tuple(np.concatenate(parts) for parts in factors), preload)
    return Cluster(mounting, run, tuple(triangle(parts, parts[0].shape[1]) for parts in factors), preload[:0])


def _joined(clusters: list[Cluster]) -> list[Cluster]:
    """Neighbours of one run joined in pairs."""
    joined: list[Cluster] = []
    index = 0
    while index < len(clusters):
        pair = clusters[index : index + 2]
        if len(pair) == 2 and pair[0].run == pair[1].run:
            joined.append(_cluster(pair[0].mounting, pair[0].run, [(list(one.factors), one.preload) for one in pair]))
            index += 2
        else:
            joined.append(pair[0])
            index += 1
    return joined


def _widened(factor: FloatArray, columns: IntArray, width: int) -> FloatArray:
    out = np.zeros((len(factor), width))
    out[:, columns] = factor
    return out
