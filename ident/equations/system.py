"""Eq. (17) reduced to what an estimator needs of it: triangles, however many rows there were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.equations.triangles import Triangles, triangle
from ident.errors import DataUnfit, RankDeficient
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload
from ident.model.model import Column, DriveTrain


@dataclass(frozen=True, slots=True)
class System:
    """W_tot χ_tot = ρ of several runs, W_tot = [V | −W | −W_uL | −W_kL χ_kL], χ_tot = (g, χ, χ_uL, 1)."""

    drive_train: DriveTrain  #: R
    base: BaseParameters  #: how the base parameters were regrouped
    columns: tuple[Column, ...]  #: name and unit of the columns of W: base parameters, then effects
    payloads: tuple[Payload, ...]  #: one for each mounting
    #: For each mounting, its unknown parameters that these data see, as indices of LINK_PARAMETERS.
    payload_columns: tuple[tuple[int, ...], ...]
    runs: tuple[str, ...]  #: names of the runs
    joints: Triangles  #: triangle of each joint's rows of W_tot, c = n + p + 1 columns
    #: Triangle of each motor's rows [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], p + 2 columns: the equation g_i v_i =
    #: (T W χ + T W_kL χ_kL)_i holds one current alone.
    motors: Triangles
    #: For each move (or neighbouring moves together), the rows or the triangle of each motor's rows.
    moves: tuple[tuple[FloatArray, ...], ...]

    @property
    def joint_count(self) -> int:
        """n."""
        return len(self.drive_train.ratio)

    @property
    def unknowns(self) -> tuple[Column, ...]:
        """χ, then χ_uL of each mounting: everything linear that is estimated beside the gains."""
        return unknowns(self.columns, self.payloads, self.payload_columns)

    @property
    def knows_payload(self) -> bool:
        """Whether any row carries a known payload: the last column of W_tot is not zero."""
        return any(bool(np.any(factor[:, -1])) for factor in self.joints.factors)

    def holding(self, values: Mapping[int, float]) -> System:
        """Give some parameters a value: their columns join W_kL χ_kL.

        Args:
            values: by index into ``columns``; zero takes a parameter out of the model (paper §4.2).
        """
        given = np.array([values.get(index, 0.0) for index in range(len(self.columns))])
        kept = [index for index in range(len(self.unknowns) + 1) if index not in values]

        def held(rows: FloatArray, first: int) -> FloatArray:
            linear = rows[:, first:].copy()
            linear[:, -1] += linear[:, : len(given)] @ given
            return np.concatenate((rows[:, :first], linear[:, kept]), axis=1)

        def folded(triangles: Triangles, first: int) -> Triangles:
            factors = (held(factor, first) for factor in triangles.factors)
            return Triangles(tuple(triangle((f,), f.shape[1]) for f in factors), triangles.rows)

        return replace(
            self,
            columns=tuple(column for index, column in enumerate(self.columns) if index not in values),
            joints=folded(self.joints, self.joint_count),
            motors=folded(self.motors, 1),
            moves=tuple(tuple(held(rows, 1) for rows in move) for move in self.moves),
        )


def unknowns(
    columns: tuple[Column, ...], payloads: tuple[Payload, ...], payload_columns: tuple[tuple[int, ...], ...]
) -> tuple[Column, ...]:
    """Names and units of χ, then χ_uL of each mounting."""
    return columns + tuple(
        Column(f"{LINK_PARAMETERS[index]}:{payload.mounting}", LINK_UNITS[index])
        for payload, indices in zip(payloads, payload_columns, strict=True)
        for index in indices
    )


def require_rows(system: System) -> None:
    """Refuse fewer equations than unknowns.

    Raises:
        DataUnfit: for a motor.
    """
    for motor, rows in enumerate(system.motors.rows):
        if not rows:
            train = system.drive_train
            joints = np.flatnonzero((train.direction[motor] != 0) | (train.to_motor[motor] != 0))
            raise DataUnfit(
                ", ".join(system.runs),
                f"joints {' and '.join(str(joint + 1) for joint in joints)}, which motor {motor + 1} is coupled to, "
                "never move at the same time; let them, or choose another estimator than ml",
            )
        if rows <= len(system.unknowns):
            raise DataUnfit(
                ", ".join(system.runs),
                f"motor {motor + 1} has {int(rows)} usable rows for {len(system.unknowns)} unknowns; "
                "record longer, or move it more",
            )


def require_known_payload(system: System) -> None:
    """Without a known payload the system (17) is homogeneous and gains have no scale.

    Raises:
        DataUnfit: no run carries one.
    """
    if not system.knows_payload:
        raise DataUnfit(
            ", ".join(system.runs),
            "no run carries a payload of known mass, so all gains could be scaled at will; "
            "record a run with a weighed payload, or hold the gains fixed",
        )


def require_distinct(system: System, *, gains: bool) -> None:
    """Refuse rows that do not distinguish their unknowns.

    Args:
        system: of the fit.
        gains: whether the gains are unknown too.

    Raises:
        RankDeficient: [W | W_uL | W_kL χ_kL] has dependent columns, as when every run carries the payload, or a
            motor's current is constant zero.
    """
    names = tuple(column.name for column in system.unknowns)
    columns = np.concatenate([factor[:, system.joint_count :] for factor in system.joints.factors])
    if system.knows_payload:
        names += ("known payload",)
    else:
        columns = columns[:, :-1]
    independent = base_parameters(columns, names).independent
    lost = tuple(name for index, name in enumerate(names) if index not in independent)
    if lost:
        raise RankDeficient(
            "the data do not distinguish payload and robot: record the same robot without load too", lost
        )
    if gains:
        for motor, factor in enumerate(system.motors.factors):
            if system.motors.rows[motor] and not np.any(factor[:, 0]):
                name = f"gain {motor + 1}"
                raise RankDeficient(
                    f"the current of motor {motor + 1} is zero throughout: is its channel connected?", (name,)
                )
