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
    bodies: dict[str, list[int]] = {}
    for mounting, payload in enumerate(system.payloads):
        if MASS in payload.known:
            bodies.setdefault(payload.name, []).append(mounting)
    columns = [_mass_column(system, mountings) for mountings in bodies.values()]
    known = [
        (name, column) for name, column in zip(bodies, columns, strict=True) if column is not None
    ]
    if not known:
        return ()
    mass_alone = all(set(payload.known) <= {MASS} for payload in system.payloads)
    if len(known) == 1 and mass_alone and estimate.method in (Method.LS, Method.WLS):
        ((name, _),) = known
        # The last column of W_tot is proportional to m, so the solution is too; the weights of wls
        # only change alike.
        mass_kg = system.payloads[bodies[name][0]].known[MASS]
        shifts = np.concatenate((estimate.gains, estimate.parameters))[:, None] / mass_kg
    else:
        extended = _with_columns(system, [column for _, column in known])
        shifts = _responses(extended, estimate, len(known))
    responses = []
    for number, (name, _) in enumerate(known):
        mass_kg = system.payloads[bodies[name][0]].known[MASS]
        gain_per_kg = shifts[: system.axis_count, number]
        parameters_per_kg = shifts[system.axis_count :, number]
        responses.append(MassResponse(name, mass_kg, gain_per_kg, parameters_per_kg))
    return tuple(responses)


MotorColumns = list[tuple[FloatArray, ...]]
"""A column of W on the rows of each motor, cluster by cluster;
on the rows of the demanded motion likewise.
"""


@dataclass(frozen=True, slots=True)
class _MassColumn:
    """MotorColumns of a mass on the motors' rows."""

    clusters: MotorColumns
    instruments: MotorColumns  #: empty without instruments


def _mass_column(system: System, mountings: Sequence[int]) -> _MassColumn | None:
    """Torque of each motor per kg of a payload, zero where it is not mounted;
    None where it cannot be rebuilt.
    """
    mass_alone = all(set(system.payloads[mounting].known) == {MASS} for mounting in mountings)
    weights = None if mass_alone else _weights(system)
    if weights is None and not mass_alone:
        return None

    def on(parts: Sequence[tuple[FloatArray, ...]], leading: int) -> MotorColumns:
        made: MotorColumns = []
        for (_, mounting), rows in zip(system.cluster_runs, parts, strict=True):
            own: list[FloatArray] = []
            for motor in rows:
                if mounting not in mountings:
                    own.append(np.zeros(len(motor)))
                elif weights is None:
                    own.append(motor[:, -1] / system.payloads[mounting].known[MASS])
                else:
                    own.append(motor[:, leading : leading + len(weights)] @ weights)
            made.append(tuple(own))
        return made

    return _MassColumn(
        on(system.clusters, system.leading), on(system.instruments, 0) if system.instruments else []
    )


def _weights(system: System) -> FloatArray | None:
    """Sum of base columns that is the column of the payload link's mass;
    None where some are not in the system.
    """
    base = system.base
    if tuple(column.name for column in system.columns[: len(base.names)]) != base.names:
        return None
    return base.grouping[:, system.model.flange][:, LINK_PARAMETERS.index(MASS)]


def _with_columns(system: System, added: Sequence[_MassColumn]) -> System:
    """Put columns before the last one, that of what is known, on the motors' rows."""

    def widened(
        parts: Sequence[tuple[FloatArray, ...]], columns: Sequence[MotorColumns]
    ) -> MotorColumns:
        made: MotorColumns = []
        for cluster, rows in enumerate(parts):
            own: list[FloatArray] = []
            for motor, matrix in enumerate(rows):
                new = np.stack([column[cluster][motor] for column in columns], axis=1)
                own.append(np.concatenate((matrix[:, :-1], new, matrix[:, -1:]), axis=1))
            made.append(tuple(own))
        return made

    clusters = tuple(widened(system.clusters, [column.clusters for column in added]))
    instruments: tuple[tuple[FloatArray, ...], ...] = ()
    if system.instruments:
        instruments = tuple(widened(system.instruments, [column.instruments for column in added]))
    motors = tuple(triangle(rows, rows[0].shape[1]) for rows in zip(*clusters, strict=True))
    return replace(
        system,
        clusters=clusters,
        instruments=instruments,
        motors=Triangles(motors, system.motors.rows),
    )


def _responses(extended: System, estimate: Estimate, count: int) -> FloatArray:
    """dθ/dm of (gains, parameters) for each of the last `count` columns of W, shape (m + p,
    count).
    """
    if estimate.method is Method.IV and extended.instruments:
        extended = extended.on_instruments()
    gains = estimate.gains
    values = np.concatenate((estimate.parameters, np.zeros(count)))
    if estimate.method.is_of_currents:
        # That of these equations: on instruments it is not that of the recorded motion, which the
        # estimate has.
        noise = extended.currents.noise(gains, values)
    elif estimate.method is Method.LS:
        noise = 1.0 / np.abs(gains)
    elif estimate.method is Method.WLS:
        noise = wls_row_std(extended) / np.abs(gains)
    else:
        noise = tls_row_std(extended) / np.abs(gains)
    currents = extended.currents
    whitened = currents.whitened(gains, noise)
    drive = whitened.drive
    if estimate.method.is_of_currents or estimate.method is Method.TLS:
        residual = whitened.residual(gains, values)
        drive = currents.corrected(gains, noise, whitened, residual)
    parameters = whitened.linear[:, :-count]
    masses = whitened.linear[:, -count:]
    # An essential fit has set the others to zero: they do not move.
    is_free = (estimate.parameters != 0.0) | (estimate.parameters_std > 0.0)
    jacobian = np.concatenate((drive, -parameters[:, is_free]), axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    moved = np.linalg.lstsq(jacobian / scale, masses, rcond=None)[0] / scale[:, None]
    shifts = np.zeros((len(gains) + len(estimate.parameters), count))
    shifts[: len(gains)] = moved[: len(gains)]
    shifts[len(gains) + np.flatnonzero(is_free)] = moved[len(gains) :]
    return shifts
