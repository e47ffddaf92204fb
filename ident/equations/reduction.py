"""Runs reduced to triangles one by one: W_tot is never in memory at once (TSQR).

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
from itertools import groupby

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
    """Differentiate runs one by one and build their rows; errors as of `reduce_runs`."""
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
    """Reduce runs one after the other; no more than one of them is in memory.

    Args:
        model: the declared model.
        runs: read while they are reduced; a mounting that several share has one set of unknowns.
        conditioning: the filters.
        payloads: known beforehand; others are added as runs bring them.
        instruments: add those of the demanded motion to the rows; where it is not known, the
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
    read_runs = ((data.name, data.payload, pieces) for data, pieces in runs)
    return reduce_rows(
        standard_equations(model, payloads),
        read_runs,
        support=model.support,
        flange=columns[model.flange],
        instruments=instruments and not model.is_redundant,
        compact=True,
    )


def standard_equations(model: Model, payloads: Sequence[Payload] = ()) -> Equations:
    """The unknowns before any regrouping: every standard parameter, and none of the payloads."""
    names = tuple(column.name for column in model.columns)
    count = len(names)
    every_parameter = BaseParameters(tuple(range(count)), np.eye(count), names)
    return Equations(
        model=model,
        base=every_parameter,
        columns=model.columns,
        payloads=tuple(payloads),
        payload_columns=((),) * len(payloads),
        runs=(),
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
        instruments: add those of the demanded motion to the rows.
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
    if given is None:
        given = {}
    return reducer.system(given)


@dataclass(frozen=True, slots=True)
class _Cluster:
    """Motor rows of one move, or of several in a run, in the columns that each motor has."""

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
        self.model = unknowns.model
        self.leading = unknowns.leading
        self.columns = support.shape[1]
        joint_support = _support_with_currents(self.model, support)
        self.of_joint = [np.flatnonzero(row) for row in joint_support]
        support_of_motors = motor_support(self.model.drive_train, support)
        self.of_motor = [np.flatnonzero(row) for row in support_of_motors]
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
        factors = self._factors_of(mounting)
        moves: dict[int, list[_Cluster]] = {}
        for rows in pieces:
            for joint, columns in enumerate(self.of_joint):
                own_rows = _rows_of_joint(self.model, rows, joint, columns)
                factors[joint] = qr_update(factors[joint], own_rows)
            self.joint_rows += rows.use.sum(axis=1)
            self.motor_rows += rows.motor_use.sum(axis=1)
            if rows.instrument is not rows.standard:
                self.has_demanded_motion = True
            for move, cluster in self._clusters_of(rows, mounting):
                parts = moves.setdefault(move, [])
                parts.append(cluster)
        for parts in moves.values():
            cluster = parts[0]
            if len(parts) > 1 or self.compact:
                cluster = _merged(parts)
            self.clusters.append(cluster)
        self.names.append(name)

    def _factors_of(self, mounting: int) -> list[FloatArray]:
        """Triangle of each joint's rows with a mounting, so far; zero where no run had it."""
        if mounting not in self.joints:
            widths = [len(columns) for columns in self.of_joint]
            self.joints[mounting] = [np.zeros((width, width)) for width in widths]
        return self.joints[mounting]

    def _clusters_of(self, rows: Rows, mounting: int) -> list[tuple[int, _Cluster]]:
        """Number and motor rows of each move; none where every motor is at standstill."""
        any_motor = rows.motor_use.any(axis=0)
        moves = np.unique(rows.move[any_motor])
        if not len(moves):
            return []
        motors = range(len(self.of_motor))
        by_motor = [self._by_move(rows, motor, moves) for motor in motors]
        run = len(self.names)
        clusters: list[tuple[int, _Cluster]] = []
        for index, move in enumerate(moves.tolist()):
            factors = tuple(of_moves[index] for of_moves in by_motor)
            is_of_move = rows.move == move
            counted = rows.motor_use[0] & is_of_move
            preload = rows.preload[:, :, counted].transpose(2, 0, 1)
            clusters.append((move, _Cluster(mounting, run, factors, preload)))
        return clusters

    def _by_move(self, rows: Rows, motor: int, moves: IntArray) -> list[FloatArray]:
        """[v_i | (T W)_i] of a motor in each move, with instruments [v_i | (T W)_i | (T Z)_i]."""
        to_motor = self.model.drive_train.to_motor[motor]
        chosen = self.of_motor[motor]
        if self.model.is_redundant:
            currents = rows.drive[motor]
        else:
            currents = rows.current[motor][None]
        parts = [currents, _chosen_columns(to_motor, rows.standard, chosen)]
        if self.instruments:
            parts.append(_chosen_columns(to_motor, rows.instrument, chosen))
        used = np.flatnonzero(rows.motor_use[motor])
        order = np.argsort(rows.move[used], kind="stable")
        used = used[order]
        columns = np.concatenate(parts)[:, used]
        ends = np.searchsorted(rows.move[used], moves[1:])
        return [of_move.T for of_move in np.split(columns, ends, axis=1)]

    def system(self, given: Mapping[int, float]) -> System:
        """The equations without given columns; what a joint or motor does not have is zero."""
        without_clusters = self._without_clusters()
        unknowns = GivenUnknowns.of(given, len(without_clusters.unknowns))
        if given:
            without_clusters = without_clusters.holding(given)
        mountings = [one.mounting for one in self.clusters]
        waiting = self._taken_rows()
        clusters: list[list[FloatArray]] = []
        instruments: list[list[FloatArray]] = []
        for motor in range(len(waiting)):
            rows = waiting[motor]
            waiting[motor] = []
            own = _Columns(motor, mountings, unknowns)
            clusters.append(own.of(rows, self._currents, self.leading))
            if self.has_demanded_motion:
                instruments.append(own.of(rows, self._instruments, 0))
        return replace(
            without_clusters,
            clusters=tuple(zip(*clusters, strict=True)),
            instruments=tuple(zip(*instruments, strict=True)),
        )

    def _taken_rows(self) -> list[list[FloatArray]]:
        """Take the rows of each motor in each cluster out of here.

        They are by far the largest part: those of one motor alone are in memory twice while they
        are put into their columns.
        """
        taken: list[list[FloatArray]] = []
        for motor in range(len(self.of_motor)):
            of_clusters = [one.factors[motor] for one in self.clusters]
            taken.append(of_clusters)
        self.clusters.clear()
        return taken

    def _without_clusters(self) -> System:
        """The equations with all columns, before the rows of each cluster are added."""
        joints = [self._joint(joint) for joint in range(len(self.of_joint))]
        motors = [self._motor(motor) for motor in range(len(self.of_motor))]
        every_parameter = tuple(range(BODY))
        cluster_runs = [(one.run, one.mounting) for one in self.clusters]
        payload_columns = (every_parameter,) * len(self.payloads)
        of_joints = Triangles(tuple(joints), self.joint_rows)
        of_motors = Triangles(tuple(motors), self.motor_rows)
        preload: list[FloatArray] = []
        if self.model.is_redundant:
            preload = [one.preload for one in self.clusters]
        return System(
            model=self.model,
            base=self.unknowns.base,
            columns=self.unknowns.columns,
            payloads=tuple(self.payloads),
            payload_columns=payload_columns,
            runs=tuple(self.names),
            joints=of_joints,
            motors=of_motors,
            clusters=(),
            cluster_runs=tuple(cluster_runs),
            preload=tuple(preload),
        )

    def _joint(self, joint: int) -> FloatArray:
        """[V | −W | −W_L of each mounting | 0] of a joint: the triangles of all mountings."""
        count = len(self.of_joint)
        columns = self.of_joint[joint]
        motors = np.count_nonzero(columns < count)
        no_rows = np.empty((0, count + self._width))
        parts: list[FloatArray] = [no_rows]
        for mounting, factors in self.joints.items():
            rows = factors[joint]
            currents = np.zeros((len(rows), count))
            currents[:, columns[:motors]] = rows[:, :motors]
            standard = columns[motors:] - count
            linear = self._linear(rows[:, motors:], standard, mounting)
            both = np.concatenate((currents, -linear), axis=1)
            parts.append(both)
        return np.concatenate(parts)

    def _motor(self, motor: int) -> FloatArray:
        """[v_i | W | W_L of each mounting | 0] of a motor: the triangles of all mountings."""
        width = self.leading + len(self.of_motor[motor])
        no_rows = np.empty((0, self.leading + self._width))
        parts: list[FloatArray] = [no_rows]
        for mounting in self.joints:
            clusters = [one for one in self.clusters if one.mounting == mounting]
            rows = [one.factors[motor][:, :width] for one in clusters]
            factor = triangle(rows, width)
            parts.append(self._currents(factor, motor, mounting))
        return np.concatenate(parts)

    @property
    def _width(self) -> int:
        """Number of the columns of [W | W_L of each mounting | 0]."""
        of_robot = len(self.unknowns.columns)
        of_payloads = BODY * len(self.payloads)
        return of_robot + of_payloads + 1

    def _currents(self, rows: FloatArray, motor: int, mounting: int) -> FloatArray:
        """[v_i | W | W_L of each mounting | 0] from the columns that a motor has."""
        chosen = self.of_motor[motor]
        first = self.leading
        end = first + len(chosen)
        linear = self._linear(rows[:, first:end], chosen, mounting)
        return np.concatenate((rows[:, :first], linear), axis=1)

    def _instruments(self, rows: FloatArray, motor: int, mounting: int) -> FloatArray:
        """[Z | Z_L of each mounting | 0] from the columns that a motor has."""
        chosen = self.of_motor[motor]
        first = self.leading + len(chosen)
        return self._linear(rows[:, first:], chosen, mounting)

    def _linear(self, rows: FloatArray, chosen: IntArray, mounting: int) -> FloatArray:
        """[W | W_L of each mounting | 0] from some of the columns."""
        robot = len(self.unknowns.columns)
        every = np.zeros((len(rows), self.columns))
        every[:, chosen] = rows
        out = np.zeros((len(rows), self._width))
        out[:, :robot] = every[:, :robot]
        if mounting >= 0:
            first = robot + BODY * mounting
            last = first + BODY
            out[:, first:last] = every[:, self.flange]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """How the rows of a motor get the columns of a system."""

    motor: int  #: index
    mountings: Sequence[int]  #: of each cluster
    given: GivenUnknowns  #: leave the columns

    def of(
        self,
        clusters: Sequence[FloatArray],
        columns: Callable[[FloatArray, int, int], FloatArray],
        first: int,
    ) -> list[FloatArray]:
        """Rows of the motor in each cluster, in some columns, so many of currents first.

        Neighbours with the same mounting have the same columns, and are put into them together: a
        cluster has a few dozen rows, and each call would cost more than its numbers.
        """
        found: list[FloatArray] = []
        begin = 0
        for mounting, neighbours in groupby(self.mountings):
            end = begin + len(list(neighbours))
            parts = clusters[begin:end]
            begin = end
            rows = columns(np.concatenate(parts), self.motor, mounting)
            joined = self.given.joined_in(rows, first)
            ends = np.cumsum([len(part) for part in parts])
            found += np.split(joined, ends[:-1])
        return found


def _support_with_currents(model: Model, support: BoolArray) -> BoolArray:
    """Mask of the columns of [V | W] that each joint has, shape (m, m + c)."""
    direction = model.drive_train.direction
    if model.is_redundant:
        currents = np.ones_like(direction, dtype=np.bool_)
    else:
        currents = direction.T != 0.0
    return np.concatenate((currents, support), axis=1)


def motor_support(train: DriveTrain, support: BoolArray) -> BoolArray:
    """Mask of the columns of W that each motor's equation has, from each joint's, (m, c) each."""
    is_mixed = np.abs(train.to_motor) > 0.0
    joints_with_column = is_mixed.astype(np.int64) @ support.astype(np.int64)
    return np.asarray(joints_with_column > 0)


def _rows_of_joint(model: Model, rows: Rows, joint: int, columns: IntArray) -> FloatArray:
    """The given columns of [V | W] of a joint, in the rows that count, columns first."""
    count = len(rows.use)
    used = rows.use[joint]
    motors = columns[columns < count]
    if model.is_redundant:
        currents = rows.drive[joint][:, used]
    else:
        direction = model.drive_train.direction[motors, joint]
        own_currents = rows.current[motors][:, used]
        currents = direction[:, None] * own_currents
    standard = columns[len(motors) :] - count
    own_columns = rows.standard[joint][np.ix_(standard, used)]
    return np.concatenate((currents, own_columns))


def _chosen_columns(to_motor: FloatArray, columns: FloatArray, chosen: IntArray) -> FloatArray:
    """(T W)_i in the columns that a motor has, from those of all joints, shape (m, c, r)."""
    return motor_columns(to_motor, lambda joint: columns[joint][chosen])


def _merged(parts: Sequence[_Cluster]) -> _Cluster:
    """One cluster of several parts of a run: triangles, or with preload all rows."""
    first = parts[0]
    preload = np.concatenate([one.preload for one in parts])
    factors: list[FloatArray] = []
    for motor in range(len(first.factors)):
        rows = [one.factors[motor] for one in parts]
        if preload.size:
            factors.append(np.concatenate(rows))
        else:
            width = rows[0].shape[1]
            factors.append(triangle(rows, width))
    if not preload.size:
        preload = preload[:0]
    return replace(first, factors=tuple(factors), preload=preload)


def _joined(clusters: list[_Cluster]) -> list[_Cluster]:
    """Neighbours of one run joined in pairs."""
    joined: list[_Cluster] = []
    index = 0
    while index < len(clusters):
        pair = clusters[index : index + 2]
        runs = {cluster.run for cluster in pair}
        if len(pair) == 2 and len(runs) == 1:
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
    dependent = {index: 0.0 for index in range(count) if index not in base.independent}
    known = payload_values(standard.payloads, payload_columns, count)
    reduced = standard.holding(dependent | known)
    columns: list[Column] = []
    for name, column in zip(base.names, reduced.columns, strict=True):
        columns.append(Column(name, column.unit))
    return replace(reduced, base=base, columns=tuple(columns))


def payload_values(
    payloads: Sequence[Payload], payload_columns: Sequence[Sequence[int]], first: int
) -> dict[int, float]:
    """Values of payload parameters that are no unknowns, zero where unknown (`System.holding`).

    Args:
        payloads: of the system.
        payload_columns: the unknown parameters of each, as indices of LINK_PARAMETERS.
        first: index of the first payload's first parameter among the unknowns.
    """
    values: dict[int, float] = {}
    for payload, unknown in zip(payloads, payload_columns, strict=True):
        known = payload.known_parameters.tolist()
        for index, value in enumerate(known):
            if index not in unknown:
                values[first + index] = value
        first += BODY
    return values


def shown_base(standard: System) -> BaseParameters:
    """The base parameters that a system in standard parameters shows.

    Raises:
        JointStill: a joint never moves.
    """
    require_moved(standard, [joint.name for joint in standard.model.robot.axes])
    names = tuple(column.name for column in standard.columns)
    columns = _linear_columns(standard)[:, : len(names)]
    columns = _with_one_friction_where_no_row_is_bare(standard.model, columns)
    return base_parameters(columns, names)


def require_moved(standard: System, axes: Sequence[str]) -> None:
    """Refuse runs in none of which a joint moves.

    Args:
        standard: of the runs.
        axes: name of each axis.

    Raises:
        JointStill: for this joint.
    """
    for name, rows in zip(axes, standard.joints.rows, strict=True):
        if not rows:
            found = f"{name} never moves above its standstill speed in any run"
            raise JointStill(", ".join(standard.runs), (name,), found)


def _with_one_friction_where_no_row_is_bare(model: Model, columns: FloatArray) -> FloatArray:
    """Columns of W without a payload's part of a friction that no bare row shows: both are one."""
    if not model.friction_by_payload:
        return columns
    columns = columns.copy()
    pairs = zip(model.friction_columns, model.loaded_friction_columns, strict=True)
    for declared, added in pairs:
        declared_column = columns[:, declared]
        difference = declared_column - columns[:, added]
        smallest = SMALLEST_COLUMN * np.linalg.norm(declared_column)
        if np.linalg.norm(difference) <= smallest:
            columns[:, added] = 0.0
    return columns


def shown_payload_columns(standard: System) -> tuple[tuple[int, ...], ...]:
    """Unknown parameters of each mounting that a system in standard parameters shows."""
    columns = _linear_columns(standard)
    chosen: list[tuple[int, ...]] = []
    for mounting, payload in enumerate(standard.payloads):
        first = len(standard.columns) + BODY * mounting
        flange = columns[:, first : first + BODY]
        norms = np.linalg.norm(flange, axis=0)
        # On a platform that never turns, most of the ten are rounding errors compared with the
        # mass.
        is_shown = norms > SMALLEST_COLUMN * norms.max(initial=0.0)
        unknown: list[int] = []
        for index, name in enumerate(LINK_PARAMETERS):
            if is_shown[index] and name not in payload.known:
                unknown.append(index)
        chosen.append(_independent_payload_columns(flange, unknown))
    return tuple(chosen)


def _independent_payload_columns(flange: FloatArray, unknown: list[int]) -> tuple[int, ...]:
    """Those of some parameters of a payload whose columns do not depend on each other."""
    if not unknown:
        return ()
    names = tuple(LINK_PARAMETERS[index] for index in unknown)
    base = base_parameters(flange[:, unknown], names)
    return tuple(unknown[index] for index in base.independent)


def _linear_columns(standard: System) -> FloatArray:
    """[W | W_L of each mounting] of all joints below each other."""
    first = standard.axis_count
    parts = [-factor[:, first:-1] for factor in standard.joints.factors]
    return np.concatenate(parts)
