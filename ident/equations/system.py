"""Eq. (17) reduced to what an estimator needs of it: triangles, however many rows there were.

R of the stack [R_before; new rows] is R of all rows so far, so that the observation matrix is never held whole. R is
unique up to the sign of its rows, and ‖R x‖ = ‖W x‖ for every x. Each step is Householder's (LAPACK ``tpqrt``, which
knows that the upper part is a triangle), so R carries a backward error of some ε ‖column‖ in every column, whatever the
condition number. The Gram matrix is twice as fast and squares the condition number: singular values below √ε ‖W‖ are
lost in it (docs/evidence has both, measured).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from ident.arrays import FloatArray, IntArray
from ident.errors import DataUnfit, RankDeficient
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload
from ident.model.model import Column, DriveTrain

BLOCK_ROWS = 1024  #: Rows folded in at once: 80 columns of them stay in a core's own cache

REFLECTORS = 8
"""Householder vectors applied together; wider blocks cost more inside themselves than they save on the rest."""


@dataclass(frozen=True, slots=True)
class Triangles:
    """R of the QR factorisation of each axis' equations; ‖R x‖ is the norm of their residual for any x."""

    factors: tuple[FloatArray, ...]  #: one for each axis, shape (≤c, c)
    rows: IntArray  #: number of equations of each axis, shape (n,)

    def stacked(self, weight: FloatArray) -> FloatArray:
        """All axes below each other, each scaled by its weight."""
        return np.concatenate([factor * scale for factor, scale in zip(self.factors, weight, strict=True)])

    def residual_std(self, vector: FloatArray, free: int) -> FloatArray:
        """Standard deviation of each axis' residual R x; ``free`` parameters are shared among the axes (eq. 9)."""
        size = self.square_sum(vector)
        return np.asarray(np.sqrt(size / np.maximum(self.rows - free / len(self.rows), 1.0)))

    def square_sum(self, vector: FloatArray) -> FloatArray:
        """‖R x‖² of each axis, shape (n,)."""
        return np.array([float(np.sum((factor @ vector) ** 2)) for factor in self.factors])

    def weighted_system(self, solution: FloatArray, free: int, *, gains: bool) -> FloatArray:
        """Singular values of W_r with rows of a joint divided by its residual's deviation (paper Table 5).

        Args:
            solution: (g, χ, χ_uL, 1) of eq. (17).
            free: number of estimated parameters.
            gains: whether the columns V belong to the unknowns.
        """
        first = 0 if gains else len(self.factors)
        return singular_values(self.stacked(1.0 / self.residual_std(solution, free))[:, first:-1])


def triangle(parts: Iterable[FloatArray], columns: int) -> FloatArray:
    """R of rows that come in pieces below each other, shape (≤columns, columns).

    Args:
        parts: pieces of rows, each of shape (m, columns).
        columns: c, for the case of no rows.
    """
    rows = np.concatenate([np.empty((0, columns)), *parts])
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64) if len(rows) > columns else rows


def triangle_of(columns: FloatArray) -> FloatArray:
    """R of rows that are given column by column, shape (c, k) → (≤c, c); columns that are zero take no part."""
    held = np.flatnonzero(columns.any(axis=1))
    out = np.zeros((len(held), len(columns)))
    out[:, held] = qr_update(None, columns[held])
    return out


def solve(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares with unit-norm columns inside: solution and (MᵀM)⁻¹.

    Scaling columns changes no least-squares solution, but spares digits where kilograms are beside kg m².
    """
    norms = np.linalg.norm(matrix, axis=0)
    norms[norms == 0.0] = 1.0
    u, s, vt = np.linalg.svd(matrix / norms, full_matrices=False)
    keep = s > s[0] * 1e-13
    half = vt[keep].T / s[keep] / norms[:, None]
    return half @ (u[:, keep].T @ right), half @ half.T


def singular_values(matrix: FloatArray) -> FloatArray:
    """In decreasing order."""
    return np.asarray(np.linalg.svd(matrix, compute_uv=False), dtype=np.float64)


def qr_update(triangle: FloatArray | None, columns: FloatArray) -> FloatArray:
    """R of the rows behind ``triangle`` and the rows in ``columns``.

    Args:
        triangle: what an earlier call returned, None at the start; left as it is.
        columns: further rows, column by column with time last, shape (c, k); any k, none too; left as they are.

    Returns:
        upper triangular, shape (c, c); with fewer than c independent rows it is singular, but never smaller.

    Raises:
        ValueError: the number of columns is not that of the triangle.
    """
    count, rows = columns.shape
    if triangle is not None and triangle.shape != (count, count):
        raise ValueError(f"expected {triangle.shape[0]} columns, as in the rows before, found {count}")
    if not count or not rows:
        return np.zeros((count, count)) if triangle is None else triangle
    out = np.zeros((count, count), order="F") if triangle is None else np.array(triangle, order="F")
    for first in range(0, rows, BLOCK_ROWS):
        # Time last in C order is (rows, columns) in Fortran order: LAPACK gets it without a transposition.
        block = np.array(columns[:, first : first + BLOCK_ROWS], order="C")
        out = lapack.dtpqrt(0, min(REFLECTORS, count), out, block.T, overwrite_a=1, overwrite_b=1)[0]
    return np.triu(out)


@dataclass(frozen=True, slots=True)
class Equations:
    """Unknowns of eq. (17), and the runs that show them: W_tot χ_tot = ρ with χ_tot = (g, χ, χ_uL, 1)."""

    drive_train: DriveTrain  #: R
    base: BaseParameters  #: how the base parameters were regrouped
    columns: tuple[Column, ...]  #: name and unit of the columns of W: base parameters, then effects
    payloads: tuple[Payload, ...]  #: one for each mounting
    #: For each mounting, its unknown parameters that these data see, as indices of LINK_PARAMETERS.
    payload_columns: tuple[tuple[int, ...], ...]
    runs: tuple[str, ...]  #: names of the runs

    @property
    def joint_count(self) -> int:
        """n."""
        return len(self.drive_train.ratio)

    @property
    def unknowns(self) -> tuple[Column, ...]:
        """χ, then χ_uL of each mounting: everything linear that is estimated beside the gains."""
        return self.columns + tuple(
            Column(f"{LINK_PARAMETERS[index]}:{payload.mounting}", LINK_UNITS[index])
            for payload, indices in zip(self.payloads, self.payload_columns, strict=True)
            for index in indices
        )


@dataclass(frozen=True, slots=True)
class System(Equations):
    """The equations of several runs as triangles, W_tot = [V | −W | −W_uL | −W_kL χ_kL]."""

    joints: Triangles  #: triangle of each joint's rows of W_tot, c = n + p + 1 columns
    #: Triangle of each motor's rows [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], p + 2 columns: the equation g_i v_i =
    #: (T W χ + T W_kL χ_kL)_i holds one current alone.
    motors: Triangles
    #: For each cluster the rows or the triangle of each motor's rows.
    clusters: tuple[tuple[FloatArray, ...], ...]
    #: Of each cluster the index of its run, and that of its payload, −1 without load.
    cluster_runs: tuple[tuple[int, int], ...] = ()
    #: Beside the rows of each cluster those of its instruments, [(T [Z | Z_uL])_i | (T Z_kL χ_kL)_i] of the demanded
    #: motion; empty where none is known.
    instruments: tuple[tuple[FloatArray, ...], ...] = ()

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
            clusters=tuple(tuple(held(rows, 1) for rows in cluster) for cluster in self.clusters),
            instruments=tuple(tuple(held(rows, 0) for rows in cluster) for cluster in self.instruments),
        )

    def on_instruments(self) -> System:
        """Replace each motor's columns by their projection on its instruments: the first of two stages.

        What is left of a column depends on the demanded motion alone; a disturbance that moved the arm is gone from it.
        """
        projected = []
        for motor in range(self.joint_count):
            instruments = np.concatenate([cluster[motor] for cluster in self.instruments])
            seen = np.flatnonzero(np.any(instruments, axis=0))
            columns = np.concatenate([cluster[motor][:, 1:] for cluster in self.clusters])
            both = triangle((np.concatenate((instruments[:, seen], columns), axis=1),), len(seen) + columns.shape[1])
            stage, _ = solve(both[: len(seen), : len(seen)], both[: len(seen), len(seen) :])
            projected.append(
                [
                    np.concatenate((rows[motor][:, :1], known[motor][:, seen] @ stage), axis=1)
                    for rows, known in zip(self.clusters, self.instruments, strict=True)
                ]
            )
        factors = tuple(triangle(rows, rows[0].shape[1]) for rows in projected)
        return replace(self, motors=Triangles(factors, self.motors.rows), clusters=tuple(zip(*projected, strict=True)))


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
                "never move at the same time; record moves in which they do, or use another estimator than ml",
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
