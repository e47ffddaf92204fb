"""Eq. (17) reduced to what an estimator needs of it: triangles, however many rows there were."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.equations.currents import Currents, PreloadedCurrents
from ident.equations.triangles import Triangles, qr_update, singular_values, solve, triangle
from ident.errors import DataUnfit, PayloadMissing, RankDeficient
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload
from ident.model.model import Column, DriveTrain, Model


@dataclass(frozen=True, slots=True)
class Equations:
    """Unknowns of equation (17), and the runs that show them.

    W_tot χ_tot = ρ with χ_tot = (g, χ, χ_uL, 1).
    """

    model: Model  #: the declared model
    base: BaseParameters  #: how the base parameters were regrouped
    columns: tuple[Column, ...]  #: name and unit of the columns of W: base parameters, then effects
    payloads: tuple[Payload, ...]  #: one for each mounting
    #: For each mounting, its unknown parameters that these data see, as indices of LINK_PARAMETERS.
    payload_columns: tuple[tuple[int, ...], ...]
    runs: tuple[str, ...]  #: names of the runs

    @property
    def drive_train(self) -> DriveTrain:
        """The drive train R."""
        return self.model.drive_train

    @property
    def axis_count(self) -> int:
        """Number of motors m."""
        return len(self.drive_train.ratio)

    @property
    def leading(self) -> int:
        """Number of columns of currents in motors' rows: the own one, with preload those of all."""
        return self.axis_count if self.model.is_redundant else 1

    @property
    def unknowns(self) -> tuple[Column, ...]:
        """χ, then χ_uL of each mounting: everything linear that is estimated beside the gains."""
        unknowns = list(self.columns)
        for payload, indices in zip(self.payloads, self.payload_columns, strict=True):
            for index in indices:
                name = f"{LINK_PARAMETERS[index]}:{payload.mounting}"
                unknowns.append(Column(name, LINK_UNITS[index]))
        return tuple(unknowns)


@dataclass(frozen=True, slots=True, eq=False)
class GivenUnknowns:
    """Unknowns that get a value: their columns join W_kL χ_kL, the last one."""

    kept: IntArray  #: columns that stay, the last one among them
    given: IntArray  #: columns whose value is not zero
    values: FloatArray  #: of these, shape (given,)

    @classmethod
    def of(cls, values: Mapping[int, float], count: int) -> GivenUnknowns:
        """From values by index into so many unknowns."""
        remaining = [index for index in range(count + 1) if index not in values]
        nonzero = [index for index, value in values.items() if value]
        nonzero_values = [values[index] for index in nonzero]
        kept = np.array(remaining, dtype=np.int64)
        given = np.array(nonzero, dtype=np.int64)
        return cls(kept=kept, given=given, values=np.array(nonzero_values))

    def joined_in(self, rows: FloatArray, first: int) -> FloatArray:
        """Rows without the columns of these unknowns, whose torque joins the last column.

        Args:
            rows: of currents, unknowns and W_kL χ_kL, shape (r, first + count + 1).
            first: number of columns of currents.
        """
        currents = np.arange(first)
        columns = np.concatenate((currents, first + self.kept))
        joined = rows[:, columns]
        given_columns = rows[:, first + self.given]
        joined[:, -1] += given_columns @ self.values
        return joined

    def joined_in_triangles(self, triangles: Triangles, first: int) -> Triangles:
        """The same of triangles, which are made triangular again."""
        factors: list[FloatArray] = []
        for factor in triangles.factors:
            rows = self.joined_in(factor, first)
            width = rows.shape[1]
            factors.append(triangle((rows,), width))
        return Triangles(tuple(factors), triangles.rows)

    def joined_in_clusters(
        self, clusters: Sequence[Sequence[FloatArray]], first: int
    ) -> tuple[tuple[FloatArray, ...], ...]:
        """The same of the rows of each motor in each cluster, shape (r, first + count + 1)."""
        joined: list[tuple[FloatArray, ...]] = []
        for cluster in clusters:
            of_motors = [self.joined_in(rows, first) for rows in cluster]
            joined.append(tuple(of_motors))
        return tuple(joined)


@dataclass(frozen=True, slots=True)
class System(Equations):
    """The equations of several runs as triangles, W_tot = [V | −W | −W_uL | −W_kL χ_kL]."""

    joints: Triangles  #: of each joint's rows of W_tot, c = m + p + 1 columns
    #: Triangle of each motor's rows [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], p + 2 columns: the
    #: equation g_i v_i = (T W χ + T W_kL χ_kL)_i holds one current alone.
    motors: Triangles
    #: For each cluster the rows or the triangle of each motor's rows. Of a redundantly driven robot
    #: always the rows, of all motors alike, and with the torque per unit of each gain in place of
    #: the own current: [V_i | …].
    clusters: tuple[tuple[FloatArray, ...], ...]
    #: Of each cluster the index of its run, and that of its payload, −1 without load.
    cluster_runs: tuple[tuple[int, int], ...] = ()
    #: For each cluster the rows of its instruments, [(T [Z | Z_uL])_i | (T Z_kL χ_kL)_i] of the
    #: demanded motion; empty where none is known.
    instruments: tuple[tuple[FloatArray, ...], ...] = ()
    #: Of a redundantly driven robot, N of each cluster's rows, shapes (rows, m, m − d); of others
    #: empty.
    preload: tuple[FloatArray, ...] = ()

    def weighted_singular_values(
        self, solution: FloatArray, free: int, *, gains: bool
    ) -> FloatArray:
        """Singular values of W_r, rows of a joint divided by its residual's deviation (Table 5).

        An effect's coefficient may have any unit, such as rad/Nm, where others have kg m². Its
        column is scaled to the median norm of the base parameters' columns: otherwise the condition
        would depend on that unit.

        Args:
            solution: (g, χ, χ_uL, 1) of eq. (17).
            free: number of estimated parameters.
            gains: whether the columns V belong to the unknowns.
        """
        count = self.axis_count
        residual_std = self.joints.residual_std(solution, free)
        matrix = self.joints.stacked(1.0 / residual_std)
        norms = np.linalg.norm(matrix, axis=0)
        base_names = self.base.names
        has_base_name = [column.name in base_names for column in self.columns]
        is_base = np.array(has_base_name, dtype=np.bool_)
        if is_base.any():
            base = count + np.flatnonzero(is_base)
            effects = count + np.flatnonzero(~is_base)
            typical_norm = np.median(norms[base])
            divisors = np.where(norms > 0.0, norms, 1.0)
            scale = typical_norm / divisors[effects]
            matrix[:, effects] *= scale
        first = count
        if gains:
            first = 0
        return singular_values(matrix[:, first:-1])

    @property
    def seen_runs(self) -> tuple[str, ...]:
        """Names of the runs that have rows here; `runs` may name others of the same observation."""
        seen = {run for run, _ in self.cluster_runs}
        return tuple(self.runs[index] for index in sorted(seen))

    def preload_of(self, cluster: int) -> FloatArray:
        """N of a cluster's rows, (rows, m, m − d); empty where no motor works against another."""
        if self.preload:
            return self.preload[cluster]
        return np.empty((0, self.axis_count, 0))

    @property
    def currents(self) -> Currents:
        """The motors' equations, for maximum likelihood."""
        if not self.model.is_redundant:
            return Currents.of_motors(self.motors)
        rows: list[FloatArray] = []
        for of_motor in zip(*self.clusters, strict=True):
            rows.append(np.concatenate(of_motor))
        preload = np.concatenate(self.preload)
        return PreloadedCurrents.of_rows(rows, preload)

    @property
    def knows_payload(self) -> bool:
        """Whether any row carries a known payload: the last column of W_tot is not zero."""
        for factor in self.joints.factors:
            known_torque = factor[:, -1]
            if known_torque.any():
                return True
        return False

    def holding(self, values: Mapping[int, float]) -> System:
        """Give some unknowns a value: their columns join W_kL χ_kL.

        Args:
            values: by index into ``unknowns``; zero takes a parameter out of the model (paper
                §4.2).
        """
        given = GivenUnknowns.of(values, len(self.unknowns))
        columns = [column for index, column in enumerate(self.columns) if index not in values]
        payload_columns: list[tuple[int, ...]] = []
        first = len(self.columns)
        for indices in self.payload_columns:
            unknown = [
                parameter for index, parameter in enumerate(indices, first) if index not in values
            ]
            payload_columns.append(tuple(unknown))
            first += len(indices)
        joints = given.joined_in_triangles(self.joints, self.axis_count)
        motors = given.joined_in_triangles(self.motors, self.leading)
        clusters = given.joined_in_clusters(self.clusters, self.leading)
        instruments = given.joined_in_clusters(self.instruments, 0)
        return replace(
            self,
            columns=tuple(columns),
            payload_columns=tuple(payload_columns),
            joints=joints,
            motors=motors,
            clusters=clusters,
            instruments=instruments,
        )

    def on_instruments(self) -> System:
        """Replace each motor's columns by their projection on its instruments: the first stage.

        What is left of a column depends on the demanded motion alone; a disturbance that moved the
        arm is gone from it.
        """
        projected = [self._projected(motor) for motor in range(self.axis_count)]
        factors: list[FloatArray] = []
        for rows in projected:
            width = rows[0].shape[1]
            factors.append(triangle(rows, width))
        motors = Triangles(tuple(factors), self.motors.rows)
        clusters = tuple(zip(*projected, strict=True))
        return replace(self, motors=motors, clusters=clusters)

    def _projected(self, motor: int) -> list[FloatArray]:
        """Rows of a motor in each cluster, [v | Z B] with the B that makes ‖W − Z B‖ least."""
        instruments = np.concatenate([cluster[motor] for cluster in self.instruments])
        columns = np.concatenate([cluster[motor][:, 1:] for cluster in self.clusters])
        seen = np.flatnonzero(np.any(instruments, axis=0))
        count = len(seen)
        stacked = np.concatenate((instruments[:, seen], columns), axis=1)
        # R of [Z | W]: its upper rows hold R_Z and what Z explains of W.
        upper = qr_update(None, stacked.T)[:count]
        coefficients, _ = solve(upper[:, :count], upper[:, count:])
        projected: list[FloatArray] = []
        for cluster, own_instruments in zip(self.clusters, self.instruments, strict=True):
            current = cluster[motor][:, :1]
            explained = own_instruments[motor][:, seen] @ coefficients
            projected.append(np.concatenate((current, explained), axis=1))
        return projected


def require_rows(system: System) -> None:
    """Refuse fewer equations than unknowns.

    Raises:
        DataUnfit: for a motor.
    """
    runs = ", ".join(system.runs)
    unknown_count = len(system.unknowns)
    for motor, rows in enumerate(system.motors.rows):
        if not rows:
            names = " and ".join(_joints_of_motor(system, motor))
            raise DataUnfit(
                runs,
                f"{names}, which motor {motor + 1} turns with, never move at the same time; record "
                "moves in which they do, or use another estimator than ml",
            )
        if rows <= unknown_count:
            raise DataUnfit(
                runs,
                f"motor {motor + 1} has {int(rows)} usable rows for {unknown_count} unknowns; "
                "record longer, or move it more",
            )


def _joints_of_motor(system: System, motor: int) -> list[str]:
    """Names of the joints that a motor turns with."""
    train = system.drive_train
    turned = train.direction[motor] != 0
    mixed = train.to_motor[motor] != 0
    joints = np.flatnonzero(turned | mixed)
    axes = system.model.robot.axes
    return [axes[joint].name for joint in joints]


def require_known_payload(system: System) -> None:
    """Refuse a system without a known payload: it is homogeneous, so gains have no scale.

    Raises:
        PayloadMissing: no run carries one.
    """
    if not system.knows_payload:
        raise PayloadMissing(system.runs)


KNOWN_PAYLOAD = "known payload"  #: Name of what is known of the payloads, among the unknowns


def require_distinct(system: System, *, gains: bool) -> None:
    """Refuse rows that do not distinguish their unknowns.

    Args:
        system: of the fit.
        gains: whether the gains are unknown too.

    Raises:
        RankDeficient: [W | W_uL | W_kL χ_kL], or with known gains [W | W_uL], has dependent
            columns, as when every run carries the payload; or, with unknown gains, a motor's
            current is constant zero.
    """
    dependent = dependent_unknowns(system, gains=gains)
    if dependent:
        remedy = _remedy_of_dependence(system, dependent)
        raise RankDeficient(f"the data do not distinguish payload and robot: {remedy}", dependent)
    if gains:
        _require_currents(system)


def dependent_unknowns(system: System, *, gains: bool) -> tuple[str, ...]:
    """Names of the unknowns whose columns depend on those of the others.

    Where the gains are known, what is known of the payloads is no unknown: W_kL χ_kL goes to the
    right side, with the measured torque.

    Args:
        system: of the fit.
        gains: whether the gains are unknown too.
    """
    names = [column.name for column in system.unknowns]
    without_currents = [factor[:, system.axis_count :] for factor in system.joints.factors]
    columns = np.concatenate(without_currents)
    if gains and system.knows_payload:
        names.append(KNOWN_PAYLOAD)
    else:
        columns = columns[:, :-1]
    independent = base_parameters(columns, tuple(names)).independent
    return tuple(name for index, name in enumerate(names) if index not in independent)


def _remedy_of_dependence(system: System, dependent: tuple[str, ...]) -> str:
    """What to record, or to say of the payload, where unknowns depend on each other."""
    is_bare_seen = any(mounting < 0 for _, mounting in system.cluster_runs)
    if not is_bare_seen:
        return "record the same robot without load too"
    robot = system.model.robot
    has_few_joints = robot.carrier < robot.joint_count - 1
    if has_few_joints and dependent == (KNOWN_PAYLOAD,):
        return (
            "what is known of the payload does not show behind so few joints: say more of it, as "
            "its centre of mass (`centre_m`) besides its mass"
        )
    return "move every joint through more of its range"


def _require_currents(system: System) -> None:
    """Refuse a motor whose current is zero in all of its rows.

    Raises:
        RankDeficient: for its gain.
    """
    for motor, factor in enumerate(system.motors.factors):
        column = 0
        if system.leading > 1:
            column = motor
        is_zero = not np.any(factor[:, column])
        if system.motors.rows[motor] and is_zero:
            name = f"gain {motor + 1}"
            raise RankDeficient(
                f"the current of motor {motor + 1} is zero throughout: is its channel connected?",
                (name,),
            )
