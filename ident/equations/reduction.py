"""Runs, one after the other, reduced to triangles:
the observation matrix is never held whole (TSQR).

`reduce_rows` makes every `System`. Its unknowns are at first those of the columns that the rows
have, and all ten parameters of the payload of each mounting; `System.holding` then gives some of
them a value. The rows of `reduce_runs` have the standard parameters: `regrouped` chooses base
parameters among them, and moves what is known of the payloads to W_kL χ_kL. So the same triangles
serve every such choice.

A payload has the columns of the link that carries it, in the rows in which it was mounted:
triangles hold them once, separately for each mounting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.demand import with_demand
from ident.data.run import Run
from ident.equations.rows import CHUNK_ROWS, Rows, motor_columns, rows_of
from ident.equations.system import Equations, GivenUnknowns, System
from ident.equations.triangles import Triangles, qr_update, triangle
from ident.errors import DataUnfit, JointStill
from ident.model.base import SMALLEST_COLUMN, BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Column, DriveTrain, Model

MAX_CLUSTERS = 256
"""Moves of very long data are joined with their neighbours:
256 clusters estimate the scatter as well as 3000.
"""

BODY = len(LINK_PARAMETERS)  #: Parameters of a payload

#: Name of a run, what was mounted, and its rows, piece by piece
ReadRun = tuple[str, Payload | None, Iterable[Rows]]


def rows_of_runs(
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning,
    *,
    instruments: bool = False,
    chunk_rows: int = CHUNK_ROWS,
) -> Iterator[tuple[Dataset, Iterable[Rows]]]:
    """Differentiate runs one after the other and build their rows;
    arguments and errors are those of `reduce_runs`.
    """
    for run in runs:
        data = differentiate(run, model.drive_train, conditioning)
        if instruments:
            data = with_demand(data, model.drive_train, conditioning)
        yield data, rows_of(model, data, conditioning, chunk_rows)


def reduce_runs(
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning,
    *,
    payloads: Sequence[Payload] = (),
    instruments: bool = False,
    chunk_rows: int = CHUNK_ROWS,
) -> System:
    """Reduce runs one after the other; no more than one of them is held.

    Args:
        model: the declared model.
        runs: read while they are reduced; a mounting that several share has one set of unknowns.
        conditioning: the filters.
        payloads: known beforehand; others are added as runs bring them.
        instruments: keep those of the demanded motion beside the rows; where it is not known, the
            recorded one serves.
        chunk_rows: rows built at once; the result does not depend on it.

    Returns:
        the equations in the standard parameters, and the ten of each payload.

    Raises:
        DataUnfit: a run is unfit, leaves no usable row, or contradicts another about a mounting.
    """
    instruments = instruments and not model.is_redundant
    built = rows_of_runs(model, runs, conditioning, instruments=instruments, chunk_rows=chunk_rows)
    return reduce_built(model, built, payloads=payloads, instruments=instruments)


def reduce_built(
    model: Model,
    runs: Iterable[tuple[Dataset, Iterable[Rows]]],
    *,
    payloads: Sequence[Payload] = (),
    instruments: bool = False,
) -> System:
    """Reduce runs whose rows are built; arguments, result and errors are those of `reduce_runs`."""
    columns = np.arange(len(model.columns))
    return reduce_rows(
        standard_equations(model, payloads),
        ((data.name, data.payload, pieces) for data, pieces in runs),
        support=model.support,
        flange=columns[model.flange],
        instruments=instruments and not model.is_redundant,
        compact=True,
    )


def standard_equations(
    model: Model, payloads: Sequence[Payload] = (), runs: Sequence[str] = ()
) -> Equations:
    """The unknowns before any regrouping: every standard parameter, and none of the payloads."""
    names = tuple(column.name for column in model.columns)
    every = BaseParameters(tuple(range(len(names))), np.eye(len(names)), names)
    return Equations(
        model, every, model.columns, tuple(payloads), ((),) * len(payloads), tuple(runs)
    )


# From rows to triangles


def reduce_rows(
    unknowns: Equations,
    runs: Iterable[ReadRun],
    *,
    support: BoolArray,
    flange: IntArray,
    given: Mapping[int, float] | None = None,
    instruments: bool = False,
    compact: bool = False,
) -> System:
    """Build W_tot (eq. 17) from rows, as triangles.

    Args:
        unknowns: model and columns of the robot; payloads known beforehand.
        runs: read one after the other; their columns are those of ``unknowns``, and perhaps others
            for ``flange``.
        support: mask of the columns that each joint has, shape (m, c).
        flange: which columns are those of the link that carries the payload, shape (10,); none
            without payloads.
        given: unknowns that get a value, as for `System.holding`, where all payloads are known
            beforehand.
        instruments: keep those of the demanded motion beside the rows.
        compact: reduce the motors' rows of a move to a triangle, and join moves where there are
            very many.

    Returns:
        equations with all ten parameters of each payload among the unknowns, but for those that are
        given.

    Raises:
        DataUnfit: a run is unfit, leaves no usable row, or contradicts another about a mounting.
    """
    reducer = _Reducer(unknowns, support, flange, instruments, compact)
    for name, payload, pieces in runs:
        reducer.add(name, payload, pieces)
        if compact and len(reducer.clusters) > 2 * MAX_CLUSTERS:
            reducer.clusters = _joined(reducer.clusters)
    if compact and len(reducer.clusters) > MAX_CLUSTERS:
        reducer.clusters = _joined(reducer.clusters)
    return reducer.system({} if given is None else given)


@dataclass(frozen=True, slots=True)
class _Cluster:
    """Motor rows of one move, or of several that follow each other in one run,
    in the columns that each motor has.
    """

    mounting: int  #: index into the payloads, −1 without load
    run: int  #: index into the runs
    #: For each motor the rows, or where they are many their triangle, of [v_i | (T W)_i], with
    #: instruments [v_i | (T W)_i | (T Z)_i]. Of a redundantly driven robot always the rows, with
    #: the torques per unit of all gains, V_i, in place of v_i.
    factors: tuple[FloatArray, ...]
    #: N of these rows, shape (rows, m, m − d); empty where no motor works against another
    preload: FloatArray


class _Reducer:
    """Triangles of the rows so far, in the columns that each joint and each motor has."""

    def __init__(
        self,
        unknowns: Equations,
        support: BoolArray,
        flange: IntArray,
        instruments: bool,
        compact: bool,
    ) -> None:
        self.unknowns = unknowns
        self.flange = flange
        self.instruments = instruments
        self.compact = compact
        self.model = model = unknowns.model
        self.leading = unknowns.leading
        self.columns = support.shape[1]
        self.of_joint = [np.flatnonzero(row) for row in _support_with_currents(model, support)]
        self.of_motor = [np.flatnonzero(row) for row in motor_support(model.drive_train, support)]
        self.payloads = list(unknowns.payloads)
        self.names: list[str] = []
        #: By mounting, −1 without load, the triangle of each joint's rows [V | W].
        self.joints: dict[int, list[FloatArray]] = {}
        self.joint_rows = np.zeros(unknowns.axis_count, dtype=np.int64)
        self.motor_rows = np.zeros(unknowns.axis_count, dtype=np.int64)
        self.clusters: list[_Cluster] = []
        self.has_demanded_motion = False

    def add(self, name: str, payload: Payload | None, pieces: Iterable[Rows]) -> None:
        """Fold in the rows of a run."""
        mounting = mounting_index(payload, self.payloads, name)
        empty = [np.zeros((len(columns), len(columns))) for columns in self.of_joint]
        factors = self.joints.setdefault(mounting, empty)
        moves: dict[int, list[_Cluster]] = {}
        for rows in pieces:
            for joint, columns in enumerate(self.of_joint):
                factors[joint] = qr_update(
                    factors[joint], _rows_of_joint(self.model, rows, joint, columns)
                )
            self.joint_rows += rows.use.sum(axis=1)
            self.motor_rows += rows.motor_use.sum(axis=1)
            self.has_demanded_motion |= rows.instrument is not rows.standard
            numbers = np.unique(rows.move[rows.motor_use.any(axis=0)])
            if not len(numbers):
                continue  # every motor at standstill
            by_motor = [self._by_move(rows, motor, numbers) for motor in range(len(self.of_motor))]
            for move, own in zip(numbers.tolist(), zip(*by_motor, strict=True), strict=True):
                counted = rows.motor_use[0] & (rows.move == move)
                preload = rows.preload[:, :, counted].transpose(2, 0, 1)
                moves.setdefault(move, []).append(_Cluster(mounting, len(self.names), own, preload))
        for parts in moves.values():
            self.clusters.append(
                parts[0] if len(parts) == 1 and not self.compact else _merged(parts)
            )
        self.names.append(name)

    def _by_move(self, rows: Rows, motor: int, moves: IntArray) -> list[FloatArray]:
        """[v_i | (T W)_i] of a motor, with instruments [v_i | (T W)_i | (T Z)_i],
        in the rows of each move.
        """
        to_motor = self.model.drive_train.to_motor[motor]
        held = self.of_motor[motor]
        parts = [rows.drive[motor] if self.model.is_redundant else rows.current[motor][None]]
        parts.append(_held_columns(to_motor, rows.standard, held))
        if self.instruments:
            parts.append(_held_columns(to_motor, rows.instrument, held))
        used = np.flatnonzero(rows.motor_use[motor])
        used = used[np.argsort(rows.move[used], kind="stable")]
        columns = np.concatenate(parts)[:, used]
        ends = np.searchsorted(rows.move[used], moves[1:])
        return [own.T for own in np.split(columns, ends, axis=1)]

    def system(self, given: Mapping[int, float]) -> System:
        """The equations with all columns but those that are given;
        what a joint or motor does not have is zero.
        """
        without_clusters = self._without_clusters()
        unknowns = GivenUnknowns.of(given, len(without_clusters.unknowns))
        if given:
            without_clusters = without_clusters.holding(given)
        # The clusters are by far the largest part: none of them is held twice.
        clusters: list[tuple[FloatArray, ...]] = []
        instruments: list[tuple[FloatArray, ...]] = []
        for one in self.clusters:
            clusters.append(self._of_cluster(one, self._currents, unknowns, self.leading))
            if self.has_demanded_motion:
                instruments.append(self._of_cluster(one, self._instruments, unknowns, 0))
        return replace(without_clusters, clusters=tuple(clusters), instruments=tuple(instruments))

    def _without_clusters(self) -> System:
        """The equations with all columns, before the rows of each cluster are added."""
        return System(
            model=self.model,
            base=self.unknowns.base,
            columns=self.unknowns.columns,
            payloads=tuple(self.payloads),
            payload_columns=(tuple(range(BODY)),) * len(self.payloads),
            runs=tuple(self.names),
            joints=Triangles(tuple(map(self._joint, range(len(self.of_joint)))), self.joint_rows),
            motors=Triangles(tuple(map(self._motor, range(len(self.of_motor)))), self.motor_rows),
            clusters=(),
            cluster_runs=tuple((one.run, one.mounting) for one in self.clusters),
            preload=tuple(one.preload for one in self.clusters) if self.model.is_redundant else (),
        )

    def _joint(self, joint: int) -> FloatArray:
        """[V | −W | −W_L of each mounting | 0] of a joint:
        the triangles of all mountings below each other.
        """
        count = len(self.of_joint)
        columns = self.of_joint[joint]
        motors = np.count_nonzero(columns < count)
        parts: list[FloatArray] = [np.empty((0, count + self._width))]
        for mounting, factors in self.joints.items():
            rows = factors[joint]
            currents = np.zeros((len(rows), count))
            currents[:, columns[:motors]] = rows[:, :motors]
            linear = self._linear(rows[:, motors:], columns[motors:] - count, mounting)
            parts.append(np.concatenate((currents, -linear), axis=1))
        return np.concatenate(parts)

    def _motor(self, motor: int) -> FloatArray:
        """[v_i | W | W_L of each mounting | 0] of a motor:
        the triangles of all mountings below each other.
        """
        width = self.leading + len(self.of_motor[motor])
        parts: list[FloatArray] = [np.empty((0, self.leading + self._width))]
        for mounting in self.joints:
            rows = [
                one.factors[motor][:, :width] for one in self.clusters if one.mounting == mounting
            ]
            parts.append(self._currents(triangle(rows, width), motor, mounting))
        return np.concatenate(parts)

    @property
    def _width(self) -> int:
        """Number of the columns of [W | W_L of each mounting | 0]."""
        return len(self.unknowns.columns) + BODY * len(self.payloads) + 1

    def _of_cluster(
        self,
        cluster: _Cluster,
        columns: Callable[[FloatArray, int, int], FloatArray],
        given: GivenUnknowns,
        first: int,
    ) -> tuple[FloatArray, ...]:
        """Rows of each motor: some columns of a cluster, so many of currents first,
        without those that are given.
        """
        motors: list[FloatArray] = []
        for motor, factor in enumerate(cluster.factors):
            rows = columns(factor, motor, cluster.mounting)
            motors.append(given.joined_in(rows, first))
        return tuple(motors)

    def _currents(self, rows: FloatArray, motor: int, mounting: int) -> FloatArray:
        """[v_i | W | W_L of each mounting | 0] from the columns that a motor has."""
        held = self.of_motor[motor]
        linear = self._linear(rows[:, self.leading : self.leading + len(held)], held, mounting)
        return np.concatenate((rows[:, : self.leading], linear), axis=1)

    def _instruments(self, rows: FloatArray, motor: int, mounting: int) -> FloatArray:
        """[Z | Z_L of each mounting | 0] from the columns that a motor has."""
        held = self.of_motor[motor]
        return self._linear(rows[:, self.leading + len(held) :], held, mounting)

    def _linear(self, rows: FloatArray, held: IntArray, mounting: int) -> FloatArray:
        """[W | W_L of each mounting | 0] from some of the columns."""
        robot = len(self.unknowns.columns)
        every = np.zeros((len(rows), self.columns))
        every[:, held] = rows
        out = np.zeros((len(rows), self._width))
        out[:, :robot] = every[:, :robot]
        if mounting >= 0:
            first = robot + BODY * mounting
            out[:, first : first + BODY] = every[:, self.flange]
        return out


def _support_with_currents(model: Model, support: BoolArray) -> BoolArray:
    """Mask of the columns of [V | W] that each joint has, shape (m, m + c)."""
    direction = model.drive_train.direction
    if model.is_redundant:
        currents = np.ones_like(direction, dtype=np.bool_)
    else:
        currents = direction.T != 0.0
    return np.concatenate((currents, support), axis=1)


def motor_support(train: DriveTrain, support: BoolArray) -> BoolArray:
    """Mask of the columns of W that the equation of each motor has, from those of each joint,
    both of shape (m, c).
    """
    mixed = np.abs(train.to_motor) > 0.0
    return np.asarray(mixed.astype(np.int64) @ support.astype(np.int64) > 0)


def _rows_of_joint(model: Model, rows: Rows, joint: int, columns: IntArray) -> FloatArray:
    """The given columns of [V | W] of a joint, in the rows that count, columns first."""
    used = rows.use[joint]
    motors = columns[columns < len(rows.use)]
    if model.is_redundant:
        currents = rows.drive[joint][:, used]
    else:
        currents = model.drive_train.direction[motors, joint, None] * rows.current[motors][:, used]
    standard = columns[len(motors) :] - len(rows.use)
    return np.concatenate((currents, rows.standard[joint][np.ix_(standard, used)]))


def _held_columns(to_motor: FloatArray, columns: FloatArray, held: IntArray) -> FloatArray:
    """(T W)_i in the columns that a motor has, from those of all joints, shape (m, c, r)."""
    return motor_columns(to_motor, lambda joint: columns[joint][held])


def _merged(parts: Sequence[_Cluster]) -> _Cluster:
    """One cluster of several parts of a run: triangles, or with preload all rows."""
    first = parts[0]
    preload = np.concatenate([one.preload for one in parts])
    of_motors = zip(*(one.factors for one in parts), strict=True)
    if preload.size:
        return replace(first, factors=tuple(map(np.concatenate, of_motors)), preload=preload)
    factors = tuple(triangle(own, own[0].shape[1]) for own in of_motors)
    return replace(first, factors=factors, preload=preload[:0])


def _joined(clusters: list[_Cluster]) -> list[_Cluster]:
    """Neighbours of one run joined in pairs."""
    joined: list[_Cluster] = []
    index = 0
    while index < len(clusters):
        pair = clusters[index : index + 2]
        if len(pair) == 2 and pair[0].run == pair[1].run:
            joined.append(_merged(pair))
        else:
            joined.append(pair[0])
            pair = pair[:1]
        index += len(pair)
    return joined


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
                    f"mounting {payload.mounting!r} carries {payload} here and {known} in another "
                    "run; give each way of mounting a name of its own",
                )
            return index
    payloads.append(payload)
    return len(payloads) - 1


# Unknowns of a system in standard parameters


def regrouped(
    standard: System,
    base: BaseParameters | None = None,
    payload_columns: tuple[tuple[int, ...], ...] | None = None,
) -> System:
    """Eq. (17) of a system in the standard parameters and the ten of each payload.

    Args:
        standard: of `reduce_runs`.
        base: the base parameters; those that its rows show, when None.
        payload_columns: the unknown parameters of each payload, as indices of LINK_PARAMETERS;
            those that its rows show when None.

    Raises:
        JointStill: a joint never moves, where the base parameters are looked for.
    """
    if base is None:
        base = shown_base(standard)
    if payload_columns is None:
        payload_columns = shown_payload_columns(standard)
    count = len(standard.columns)
    given = {index: 0.0 for index in range(count) if index not in base.independent}
    found = standard.holding(given | payload_values(standard.payloads, payload_columns, count))
    names = zip(base.names, found.columns, strict=True)
    return replace(
        found, base=base, columns=tuple(Column(name, column.unit) for name, column in names)
    )


def payload_values(
    payloads: Sequence[Payload], payload_columns: Sequence[Sequence[int]], first: int
) -> dict[int, float]:
    """Values of the payloads' parameters that are no unknowns, zero where not known,
    for `System.holding`.

    Args:
        payloads: of the system.
        payload_columns: the unknown parameters of each, as indices of LINK_PARAMETERS.
        first: index of the first payload's first parameter among the unknowns.
    """
    values: dict[int, float] = {}
    for mounting, (payload, unknown) in enumerate(zip(payloads, payload_columns, strict=True)):
        for index, value in enumerate(payload.known_parameters.tolist()):
            if index not in unknown:
                values[first + BODY * mounting + index] = value
    return values


def shown_base(standard: System) -> BaseParameters:
    """The base parameters that a system in standard parameters shows.

    Raises:
        JointStill: a joint never moves.
    """
    for joint, rows in enumerate(standard.joints.rows):
        if not rows:
            name = standard.model.robot.axes[joint].name
            found = f"{name} never moves above its standstill speed in any run"
            raise JointStill(", ".join(standard.runs), (name,), found)
    names = tuple(column.name for column in standard.columns)
    columns = _linear_columns(standard)[:, : len(names)]
    return base_parameters(_with_one_friction_where_no_row_is_bare(standard.model, columns), names)


def _with_one_friction_where_no_row_is_bare(model: Model, columns: FloatArray) -> FloatArray:
    """The columns of W without what a payload adds to a friction that no bare row shows:
    the two are one parameter.
    """
    if not model.friction_by_payload:
        return columns
    columns = columns.copy()
    for declared, added in zip(model.friction_columns, model.loaded_friction_columns, strict=True):
        apart = np.linalg.norm(columns[:, declared] - columns[:, added])
        if apart <= SMALLEST_COLUMN * np.linalg.norm(columns[:, declared]):
            columns[:, added] = 0.0
    return columns


def shown_payload_columns(standard: System) -> tuple[tuple[int, ...], ...]:
    """For each mounting, its unknown parameters that a system in standard parameters shows
    (LINK_PARAMETERS).
    """
    columns = _linear_columns(standard)
    chosen: list[tuple[int, ...]] = []
    for mounting, payload in enumerate(standard.payloads):
        first = len(standard.columns) + BODY * mounting
        flange = columns[:, first : first + BODY]
        norms = np.linalg.norm(flange, axis=0)
        # On a platform that never turns, most of the ten are rounding errors beside the mass.
        shown = norms > SMALLEST_COLUMN * norms.max(initial=0.0)
        unknown = tuple(
            i for i, name in enumerate(LINK_PARAMETERS) if name not in payload.known and shown[i]
        )
        names = tuple(LINK_PARAMETERS[i] for i in unknown)
        if unknown:
            seen = base_parameters(flange[:, list(unknown)], names).independent
        else:
            seen = ()
        chosen.append(tuple(unknown[i] for i in seen))
    return tuple(chosen)


def _linear_columns(standard: System) -> FloatArray:
    """[W | W_L of each mounting] of all joints below each other."""
    return np.concatenate(
        [-factor[:, standard.axis_count : -1] for factor in standard.joints.factors]
    )
