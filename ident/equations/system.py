"""Eq. (17) reduced to what an estimator needs of it: triangles, however many rows there were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.equations.currents import Currents, PreloadedCurrents
from ident.equations.triangles import Triangles, singular_values, solve, triangle
from ident.errors import DataUnfit, PayloadMissing, RankDeficient
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload
from ident.model.model import Column, DriveTrain, Model


@dataclass(frozen=True, slots=True)
class Equations:
    """Unknowns of eq.

    (17), and the runs that show them: W_tot χ_tot = ρ with χ_tot = (g, χ, χ_uL, 1).
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
        """How many columns of the motors' rows belong to currents:
        the own one, or with preload those of all motors.
        """
        return self.axis_count if self.model.is_redundant else 1

    @property
    def unknowns(self) -> tuple[Column, ...]:
        """χ, then χ_uL of each mounting: everything linear that is estimated beside the gains."""
        return self.columns + tuple(
            Column(f"{LINK_PARAMETERS[index]}:{payload.mounting}", LINK_UNITS[index])
            for payload, indices in zip(self.payloads, self.payload_columns, strict=True)
            for index in indices
        )


@dataclass(frozen=True, slots=True, eq=False)
class GivenUnknowns:
    """Unknowns that get a value: their columns join W_kL χ_kL, the last one."""

    kept: IntArray  #: columns that stay, the last one among them
    given: IntArray  #: columns whose value is not zero
    values: FloatArray  #: of these, shape (given,)

    @classmethod
    def of(cls, values: Mapping[int, float], count: int) -> GivenUnknowns:
        """From values by index into so many unknowns."""
        kept = [index for index in range(count + 1) if index not in values]
        given = [index for index, value in values.items() if value]
        return cls(
            np.array(kept, dtype=np.int64),
            np.array(given, dtype=np.int64),
            np.array([values[index] for index in given]),
        )

    def joined_in(self, rows: FloatArray, first: int) -> FloatArray:
        """Rows without the columns of these unknowns, whose torque joins the last column.

        Args:
            rows: of currents, unknowns and W_kL χ_kL, shape (r, first + count + 1).
            first: number of columns of currents.
        """
        columns = np.concatenate((np.arange(first), first + self.kept))
        joined = rows[:, columns]
        joined[:, -1] += rows[:, first + self.given] @ self.values
        return joined


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
    #: Beside the rows of each cluster those of its instruments, [(T [Z | Z_uL])_i | (T Z_kL
    #: χ_kL)_i] of the demanded motion; empty where none is known.
    instruments: tuple[tuple[FloatArray, ...], ...] = ()
    #: Of a redundantly driven robot, N of each cluster's rows, shapes (rows, m, m − d); of others
    #: empty.
    preload: tuple[FloatArray, ...] = ()

    def weighted_singular_values(
        self, solution: FloatArray, free: int, *, gains: bool
    ) -> FloatArray:
        """Singular values of W_r with rows of a joint divided by its residual's deviation (paper
        Table 5).

        An effect's coefficient may have any unit, such as rad/Nm beside kg m². Its column is scaled
        to the median norm of the base parameters' columns: otherwise the condition would depend on
        that unit.

        Args:
            solution: (g, χ, χ_uL, 1) of eq. (17).
            free: number of estimated parameters.
            gains: whether the columns V belong to the unknowns.
        """
        count = self.axis_count
        matrix = self.joints.stacked(1.0 / self.joints.residual_std(solution, free))
        norms = np.linalg.norm(matrix, axis=0)
        base = np.array([column.name in self.base.names for column in self.columns], dtype=np.bool_)
        if base.any():
            size = np.median(norms[count + np.flatnonzero(base)])
            effects = count + np.flatnonzero(~base)
            matrix[:, effects] *= size / np.where(norms > 0.0, norms, 1.0)[effects]
        return singular_values(matrix[:, 0 if gains else count : -1])

    @property
    def seen_runs(self) -> tuple[str, ...]:
        """Names of the runs that have rows here; `runs` may name others of the same observation."""
        return tuple(self.runs[index] for index in sorted({run for run, _ in self.cluster_runs}))

    def preload_of(self, cluster: int) -> FloatArray:
        """N of a cluster's rows, shape (rows, m, m − d);
        empty where no motor works against another.
        """
        if self.preload:
            return self.preload[cluster]
        return np.empty((0, self.axis_count, 0))

    @property
    def currents(self) -> Currents:
        """The motors' equations, for maximum likelihood."""
        if not self.model.is_redundant:
            return Currents.of_motors(self.motors)
        rows = [np.concatenate(own) for own in zip(*self.clusters, strict=True)]
        return PreloadedCurrents.of_rows(rows, np.concatenate(self.preload))

    @property
    def knows_payload(self) -> bool:
        """Whether any row carries a known payload: the last column of W_tot is not zero."""
        return any(bool(np.any(factor[:, -1])) for factor in self.joints.factors)

    def holding(self, values: Mapping[int, float]) -> System:
        """Give some unknowns a value: their columns join W_kL χ_kL.

        Args:
            values: by index into ``unknowns``; zero takes a parameter out of the model (paper
                §4.2).
        """
        given = GivenUnknowns.of(values, len(self.unknowns))

        def folded(triangles: Triangles, first: int) -> Triangles:
            factors = (given.joined_in(factor, first) for factor in triangles.factors)
            return Triangles(tuple(triangle((f,), f.shape[1]) for f in factors), triangles.rows)

        payload_columns: list[tuple[int, ...]] = []
        first = len(self.columns)
        for indices in self.payload_columns:
            payload_columns.append(
                tuple(own for place, own in enumerate(indices, first) if place not in values)
            )
            first += len(indices)
        return replace(
            self,
            columns=tuple(
                column for index, column in enumerate(self.columns) if index not in values
            ),
            payload_columns=tuple(payload_columns),
            joints=folded(self.joints, self.axis_count),
            motors=folded(self.motors, self.leading),
            clusters=tuple(
                tuple(given.joined_in(rows, self.leading) for rows in cluster)
                for cluster in self.clusters
            ),
            instruments=tuple(
                tuple(given.joined_in(rows, 0) for rows in cluster) for cluster in self.instruments
            ),
        )

    def on_instruments(self) -> System:
        """Replace each motor's columns by their projection on its instruments:
        the first of two stages.

        What is left of a column depends on the demanded motion alone; a disturbance that moved the
        arm is gone from it.
        """
        projected = []
        for motor in range(self.axis_count):
            instruments = np.concatenate([cluster[motor] for cluster in self.instruments])
            seen = np.flatnonzero(np.any(instruments, axis=0))
            columns = np.concatenate([cluster[motor][:, 1:] for cluster in self.clusters])
            both = triangle(
                (np.concatenate((instruments[:, seen], columns), axis=1),),
                len(seen) + columns.shape[1],
            )
            stage, _ = solve(both[: len(seen), : len(seen)], both[: len(seen), len(seen) :])
            projected.append(
                [
                    np.concatenate((rows[motor][:, :1], known[motor][:, seen] @ stage), axis=1)
                    for rows, known in zip(self.clusters, self.instruments, strict=True)
                ]
            )
        factors = tuple(triangle(rows, rows[0].shape[1]) for rows in projected)
        return replace(
            self,
            motors=Triangles(factors, self.motors.rows),
            clusters=tuple(zip(*projected, strict=True)),
        )


def require_rows(system: System) -> None:
    """Refuse fewer equations than unknowns.

    Raises:
        DataUnfit: for a motor.
    """
    for motor, rows in enumerate(system.motors.rows):
        if not rows:
            train = system.drive_train
            axes = system.model.robot.axes
            joints = np.flatnonzero((train.direction[motor] != 0) | (train.to_motor[motor] != 0))
            raise DataUnfit(
                ", ".join(system.runs),
                f"{' and '.join(axes[joint].name for joint in joints)}, which motor {motor + 1} "
                "turns with, never move at the same time; record moves in which they do, or use "
                "another estimator than ml",
            )
        if rows <= len(system.unknowns):
            raise DataUnfit(
                ", ".join(system.runs),
                f"motor {motor + 1} has {int(rows)} usable rows for {len(system.unknowns)} "
                "unknowns; record longer, or move it more",
            )


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
        RankDeficient: [W | W_uL | W_kL χ_kL] has dependent columns, as when every run carries the
            payload, or a motor's current is constant zero.
    """
    names = tuple(column.name for column in system.unknowns)
    columns = np.concatenate([factor[:, system.axis_count :] for factor in system.joints.factors])
    if system.knows_payload:
        names += (KNOWN_PAYLOAD,)
    else:
        columns = columns[:, :-1]
    independent = base_parameters(columns, names).independent
    lost = tuple(name for index, name in enumerate(names) if index not in independent)
    if lost:
        is_bare_seen = any(mounting < 0 for _, mounting in system.cluster_runs)
        if is_bare_seen:
            missing = "move every joint through more of its range"
        else:
            missing = "record the same robot without load too"
        robot = system.model.robot
        if is_bare_seen and lost == (KNOWN_PAYLOAD,) and robot.carrier < robot.joint_count - 1:
            missing = (
                "what is known of the payload does not show behind so few joints: say more of it, "
                "as its centre of mass (`centre_m`) beside its mass"
            )
        raise RankDeficient(f"the data do not distinguish payload and robot: {missing}", lost)
    if gains:
        for motor, factor in enumerate(system.motors.factors):
            own = motor if system.leading > 1 else 0
            if system.motors.rows[motor] and not np.any(factor[:, own]):
                name = f"gain {motor + 1}"
                raise RankDeficient(
                    f"the current of motor {motor + 1} is zero throughout: is its channel "
                    "connected?",
                    (name,),
                )
