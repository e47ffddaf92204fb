"""How gains and parameters depend on the mass of a known payload: the derivative of the estimator.

The known payload alone gives the gains their scale, so a wrong mass bends all of them, and where
nothing else is known of the payload, no residual shows it. With e(g, χ, m) the whitened residual of
the motors' equations, J its derivative to the unknowns and w = −∂e/∂m the column of the mass, an
estimate that makes ‖e‖ least moves by

    dθ/dm = (JᵀJ)⁻¹ Jᵀ w,      θ = (g, χ, χ_uL),

to the first order in the noise. If the mass is all that is known, J θ = m w, and every gain is
proportional to m. With the drawing of a payload (centre, inertia) known too, a wrong mass
contradicts it, and each gain answers in its own way.

The column of the mass is that of the link that carries the payload, in the rows in which it is
mounted. Beside the base parameters this is no new column: W_st = W · grouping (`ident.model.base`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.equations.system import System
from ident.equations.triangles import Triangles, triangle
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import tls_row_std, wls_row_std
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS

MASS = "m"  #: Its name among LINK_PARAMETERS


@dataclass(frozen=True, slots=True)
class MassResponse:
    """Change of each gain and each parameter with the mass of one payload."""

    payload: str  #: name of the body; in several mountings it is the same body
    mass_kg: float  #: as it was taken for known
    gain_per_kg: FloatArray  #: dg/dm of each motor [Nm at the joint per A and kg], shape (m,)
    #: d(χ, χ_uL)/dm of each parameter of the estimate [its unit per kg], shape (p,)
    parameters_per_kg: FloatArray


def mass_responses(system: System, estimate: Estimate) -> tuple[MassResponse, ...]:
    """Differentiate an estimate to the mass of each known payload.

    For the estimators of the joints' equations (``ls``, ``wls``, ``tls``) the motors' equations are
    used with the same weights, which is the same to the first order in the noise unless axes are
    coupled. Where the mass of one body is all that is known, ``ls`` and ``wls`` are proportional to
    it.

    Args:
        system: that the estimate was made from.
        estimate: with free gains; parameters that it has set to zero with certainty stay there.

    Returns:
        one a body whose mass is known; empty for fixed gains.
    """
    if estimate.gains_fixed:
        return ()
    names: list[str] = []
    masses_kg: list[float] = []
    columns: list[_MassColumn] = []
    for name, mountings in _mountings_of_bodies(system).items():
        column = _mass_column(system, mountings)
        if column is not None:
            names.append(name)
            masses_kg.append(system.payloads[mountings[0]].known[MASS])
            columns.append(column)
    if not columns:
        return ()
    is_proportional = all(set(payload.known) <= {MASS} for payload in system.payloads)
    if len(columns) == 1 and is_proportional and estimate.method in (Method.LS, Method.WLS):
        # The last column of W_tot is proportional to m, so the solution is too; the weights of wls
        # only change alike.
        solution = np.concatenate((estimate.gains, estimate.parameters))
        shifts = solution[:, None] / masses_kg[0]
    else:
        extended = _with_columns(system, columns)
        shifts = _responses(extended, estimate, len(columns))
    responses: list[MassResponse] = []
    for name, mass_kg, per_kg in zip(names, masses_kg, shifts.T, strict=True):
        gain_per_kg = per_kg[: system.axis_count]
        parameters_per_kg = per_kg[system.axis_count :]
        responses.append(MassResponse(name, mass_kg, gain_per_kg, parameters_per_kg))
    return tuple(responses)


def _mountings_of_bodies(system: System) -> dict[str, list[int]]:
    """Mountings of each body whose mass is known, by its name."""
    bodies: dict[str, list[int]] = {}
    for mounting, payload in enumerate(system.payloads):
        if MASS in payload.known:
            bodies.setdefault(payload.name, []).append(mounting)
    return bodies


MotorColumns = list[tuple[FloatArray, ...]]
"""A column of W on the rows of each motor, cluster by cluster; on demanded motion likewise."""


@dataclass(frozen=True, slots=True)
class _MassColumn:
    """MotorColumns of a mass on the motors' rows."""

    clusters: MotorColumns
    instruments: MotorColumns  #: empty without instruments


def _mass_column(system: System, mountings: Sequence[int]) -> _MassColumn | None:
    """Torque of each motor per kg of a payload; None where it cannot be rebuilt.

    It is zero where the payload is not mounted.
    """
    known = [set(system.payloads[mounting].known) for mounting in mountings]
    is_mass_alone = all(names == {MASS} for names in known)
    base_weights: FloatArray | None = None
    if not is_mass_alone:
        base_weights = _base_weights(system)
        if base_weights is None:
            return None

    def per_kg(motor: FloatArray, mounting: int, leading: int) -> FloatArray:
        """The column on the rows of one motor; base columns begin at `leading`."""
        if mounting not in mountings:
            return np.zeros(len(motor))
        if base_weights is None:
            known_torque = motor[:, -1]
            return np.asarray(known_torque / system.payloads[mounting].known[MASS])
        base_columns = motor[:, leading : leading + len(base_weights)]
        return np.asarray(base_columns @ base_weights)

    def on_rows(parts: Sequence[tuple[FloatArray, ...]], leading: int) -> MotorColumns:
        made: MotorColumns = []
        for (_, mounting), rows in zip(system.cluster_runs, parts, strict=True):
            made.append(tuple(per_kg(motor, mounting, leading) for motor in rows))
        return made

    clusters = on_rows(system.clusters, system.leading)
    instruments: MotorColumns = []
    if system.instruments:
        instruments = on_rows(system.instruments, 0)
    return _MassColumn(clusters, instruments)


def _base_weights(system: System) -> FloatArray | None:
    """Weights of base columns in that of the payload link's mass; None where some are missing."""
    base = system.base
    leading_columns = system.columns[: len(base.names)]
    if tuple(column.name for column in leading_columns) != base.names:
        return None
    flange = base.grouping[:, system.model.flange]
    return flange[:, LINK_PARAMETERS.index(MASS)]


def _with_columns(system: System, added: Sequence[_MassColumn]) -> System:
    """Put columns before the last one, that of what is known, on the motors' rows."""

    def widened(
        parts: Sequence[tuple[FloatArray, ...]], columns: Sequence[MotorColumns]
    ) -> tuple[tuple[FloatArray, ...], ...]:
        made: MotorColumns = []
        for cluster, rows in enumerate(parts):
            own: list[FloatArray] = []
            for motor, matrix in enumerate(rows):
                new = np.stack([column[cluster][motor] for column in columns], axis=1)
                unknown = matrix[:, :-1]
                known = matrix[:, -1:]
                own.append(np.concatenate((unknown, new, known), axis=1))
            made.append(tuple(own))
        return tuple(made)

    clusters = widened(system.clusters, [column.clusters for column in added])
    instruments: tuple[tuple[FloatArray, ...], ...] = ()
    if system.instruments:
        instruments = widened(system.instruments, [column.instruments for column in added])
    factors = tuple(triangle(rows, rows[0].shape[1]) for rows in zip(*clusters, strict=True))
    motors = Triangles(factors, system.motors.rows)
    return replace(system, clusters=clusters, instruments=instruments, motors=motors)


def _responses(extended: System, estimate: Estimate, count: int) -> FloatArray:
    """dθ/dm of (gains, parameters) for the last `count` columns of W, shape (m + p, count)."""
    method = estimate.method
    if method is Method.IV and extended.instruments:
        extended = extended.on_instruments()
    gains = estimate.gains
    gain_count = len(gains)
    values = np.concatenate((estimate.parameters, np.zeros(count)))
    if method.is_of_currents:
        # That of these equations: on instruments it is not that of the recorded motion, which the
        # estimate has.
        noise = extended.currents.noise(gains, values)
    elif method is Method.LS:
        noise = 1.0 / np.abs(gains)
    elif method is Method.WLS:
        noise = wls_row_std(extended) / np.abs(gains)
    else:
        noise = tls_row_std(extended) / np.abs(gains)
    currents = extended.currents
    whitened = currents.whitened(gains, noise)
    drive = whitened.drive
    if method.is_of_currents or method is Method.TLS:
        residual = whitened.residual(gains, values)
        drive = currents.corrected(gains, noise, whitened, residual)
    parameters = whitened.linear[:, :-count]
    masses = whitened.linear[:, -count:]
    # An essential fit has set the others to zero: they do not move.
    is_free = (estimate.parameters != 0.0) | (estimate.parameters_std > 0.0)
    jacobian = np.concatenate((drive, -parameters[:, is_free]), axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    scaled_shifts = np.linalg.lstsq(jacobian / scale, masses, rcond=None)[0]
    free_shifts = scaled_shifts / scale[:, None]
    shifts = np.zeros((gain_count + len(is_free), count))
    free_parameters = gain_count + np.flatnonzero(is_free)
    shifts[:gain_count] = free_shifts[:gain_count]
    shifts[free_parameters] = free_shifts[gain_count:]
    return shifts
