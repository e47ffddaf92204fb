"""Gains by linear algebra alone, for a look after each move.

Total least squares corrects the currents alone. The rows of motor i are
g_i v_i − (T W χ + T W_uL χ_uL)_i = (T W_kL χ_kL)_i + g_i e_i. Only the current v_i has an error,
e_i ~ (0, σ_i²), as in `ident.estimators.maximum_likelihood`. Rows are divided by an expected error
g_i σ_i. Columns without errors come first in one QR factorisation of all rows (mixed LS-TLS: Golub,
Hoffman & Stewart, Linear Algebra Appl. 88/89 (1987); Van Huffel & Vandewalle, The Total Least
Squares Problem, §3.5)::

                                      [ R_χχ  R_χk  R_χV ]
    Q [ −T W  −T W_uL | −T W_kL χ_kL | V ] = [       R_kk  R_kV ]
                                      [             R_VV ]

- R_VV has what remains of the currents when robot and payload have explained what they can. Its
  smallest generalised singular value, in units of the expected errors r_i/g_i², gives the ratio of
  the gains.
- R_kk + R_kV g = 0 gives their scale: the known weight of the payload.
- R_χχ χ + R_χk + R_χV g = 0 gives the parameters.

The expected errors come from the residuals of the solution before. The fixed point of these passes
is the estimate of `ml`; PASSES of them are close to it. `ls` and `wls` are as linear, but noise of
the currents makes their gains too small, by ten per cent and more where `ml` is off by one
(docs/evidence/stopping.md).

A redundantly driven robot has unknown preload in each row, so its gains are those of `tls`. σ is
that of `ml`, by leaving out one move at a time: rows are correlated, moves hardly.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.equations.linearisation import MIN_MOVES_TO_LEAVE_OUT, jackknife_covariance
from ident.equations.reduction import regrouped
from ident.equations.system import System, dependent_unknowns
from ident.equations.triangles import solve
from ident.estimators.least_squares import tls
from ident.plausible import LARGEST_GAIN_STD

#: Solutions, each with the errors that the one before has left; `ml` is then nearer than a fiftieth
#: of σ
PASSES = 4


class Unknown(Enum):
    """Why the gains are not known yet."""

    NO_PAYLOAD = "nothing recorded with a payload of known mass, which gives all gains their scale"
    NO_MOTION = "an axis has not moved yet"
    NOT_DISTINGUISHED = (
        "the moves do not distinguish payload and robot: record them without load too"
    )
    NO_CURRENT = "the current of a motor is zero throughout: is its channel connected?"
    FEW_ROWS = "too few rows in which a motor moves"
    FEW_MOVES = f"fewer than {MIN_MOVES_TO_LEAVE_OUT} moves"
    PAYLOAD_UNSEEN = "the payload does not show against the noise yet"


@dataclass(frozen=True, slots=True, eq=False)
class QuickGains:
    """The quick linear estimate of the gains."""

    #: [Nm at the joint per A, or N], shape (m,); None where they are not known yet
    gains: FloatArray | None
    #: σ of each, by leaving out one move at a time, shape (m,); None likewise
    gains_std: FloatArray | None
    unknown: Unknown | None = None  #: why they are not known; None where they are
    #: axes that this is about, by their index; none where it is about all
    axes: tuple[int, ...] = ()

    @property
    def std_percent(self) -> FloatArray | None:
        """σ of each gain [% of it], shape (m,); None where they are not known yet."""
        if self.gains is None or self.gains_std is None:
            return None
        size = np.abs(self.gains)
        return np.asarray(100.0 * self.gains_std / size)


def quick_gains(standard: System) -> QuickGains:
    """Estimate the gains, or say why nothing fixes them yet.

    Args:
        standard: in the standard parameters, as `ident.equations.reduction.reduce_runs` returns it.
    """
    if not _has_payload(standard):
        return QuickGains(None, None, Unknown.NO_PAYLOAD)
    resting = tuple(np.flatnonzero(standard.joints.rows == 0).tolist())
    if resting:
        return QuickGains(None, None, Unknown.NO_MOTION, resting)
    system = regrouped(standard)
    missing = _missing(system)
    if missing is not None:
        return missing
    gains, std = _gains_with_std(system)
    smallest_relative_std = np.min(std / np.abs(gains))
    if not smallest_relative_std <= LARGEST_GAIN_STD:  # also where it is NaN
        return QuickGains(None, None, Unknown.PAYLOAD_UNSEEN)
    return QuickGains(gains, std)


def _missing(system: System) -> QuickGains | None:
    """Say what these equations lack for an estimate; None where they lack nothing."""
    has_weight = [bool(np.any(factor[:, -1])) for factor in system.motors.factors]
    if not any(has_weight):
        return QuickGains(None, None, Unknown.NO_PAYLOAD)
    if dependent_unknowns(system, gains=True):
        return QuickGains(None, None, Unknown.NOT_DISTINGUISHED)
    currents = np.abs(system.currents.drive).sum(axis=0)
    dead = tuple(np.flatnonzero(currents == 0.0).tolist())
    if dead:
        return QuickGains(None, None, Unknown.NO_CURRENT, dead)
    has_few_rows = system.motors.rows <= len(system.unknowns)
    few = tuple(np.flatnonzero(has_few_rows).tolist())
    if few:
        return QuickGains(None, None, Unknown.FEW_ROWS, few)
    if len(system.clusters) < MIN_MOVES_TO_LEAVE_OUT:
        return QuickGains(None, None, Unknown.FEW_MOVES)
    return None


def _has_payload(standard: System) -> bool:
    """Whether any row of a system in standard parameters was recorded with a payload."""
    first = standard.axis_count + len(standard.columns)
    of_payload = [factor[:, first:-1] for factor in standard.joints.factors]
    return any(bool(np.any(columns)) for columns in of_payload)


def _gains_with_std(system: System) -> tuple[FloatArray, FloatArray]:
    """Gains and their σ, shape (m,) each."""
    if system.model.is_redundant:
        estimate = tls(system)
        gains = estimate.gains
        parameters = estimate.parameters
    else:
        gains, parameters = mixed_tls(system)
    free = len(gains) + len(parameters)
    noise_a = system.currents.noise(gains, parameters, free)
    covariance = jackknife_covariance(system, gains, parameters, noise_a, gains_fixed=False)
    variances = np.diag(covariance)
    return gains, np.sqrt(variances[: len(gains)])


def mixed_tls(system: System) -> tuple[FloatArray, FloatArray]:
    """Gains and parameters by total least squares that corrects the currents alone.

    Args:
        system: of a robot with one motor for each degree of freedom, with a known payload.

    Returns:
        g, shape (m,), and (χ, χ_uL), shape (p,).
    """
    rows = np.maximum(system.motors.rows, 1)
    # At first all rows have the same weight, and each current the same share of noise.
    weight = np.ones(system.axis_count)
    currents = [factor[:, 0] for factor in system.motors.factors]
    error_in_gains = np.array([float(current @ current) for current in currents])
    for _ in range(PASSES):
        gains, parameters = _solve_once(system, weight, error_in_gains)
        weight = np.sqrt(rows) / _residual_norms(system, gains, parameters)
        error_in_gains = rows / gains**2
    return gains, parameters


def _solve_once(
    system: System, weight: FloatArray, error_in_gains: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve the rows once.

    Args:
        system: the equations.
        weight: 1/(g_i σ_i) of each motor's rows, shape (m,).
        error_in_gains: r_i (weight_i σ_i)², the expected square of the errors in the column of each
            gain, shape (m,).
    """
    count = system.axis_count
    parts: list[FloatArray] = []
    for motor, factor in enumerate(system.motors.factors):
        drive = np.zeros((len(factor), count))
        drive[:, motor] = factor[:, 0]
        torque = factor[:, 1:]
        rows = np.concatenate((-torque, drive), axis=1)
        parts.append(weight[motor] * rows)
    stacked = np.concatenate(parts)
    # Index of the column −T W_kL χ_kL; those of the gains follow it
    payload = stacked.shape[1] - count - 1
    # Unit columns, because kg and kg m² differ in size; those of the gains in units of their
    # errors.
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    scale[-count:] = np.sqrt(error_in_gains)
    upper = np.asarray(np.linalg.qr(stacked / scale, mode="r"))
    of_gains = slice(payload + 1, None)
    _, _, directions = np.linalg.svd(upper[of_gains, of_gains])
    direction = directions[-1]
    # The payload has the coefficient one, so `scale` in scaled columns: R_kk scale + R_kV (size
    # direction) = 0.
    payload_scale = scale[payload]
    weight_of_payload = upper[payload, payload] * payload_scale
    size = -weight_of_payload / (upper[payload, of_gains] @ direction)
    scaled_gains = size * direction
    # R_χχ χ = −(R_χk + R_χV g)
    of_parameters = slice(None, payload)
    known = np.concatenate(([payload_scale], scaled_gains))
    right = -upper[of_parameters, payload:] @ known
    scaled_parameters, _ = solve(upper[of_parameters, of_parameters], right)
    gains = scaled_gains / scale[of_gains]
    parameters = scaled_parameters / scale[of_parameters]
    return gains, parameters


def _residual_norms(system: System, gains: FloatArray, parameters: FloatArray) -> FloatArray:
    """‖g_i v_i − (T W χ)_i − …‖ of each motor, shape (m,); never less than rounding."""
    epsilon = np.finfo(np.float64).eps
    norms: list[float] = []
    for gain, factor in zip(gains, system.motors.factors, strict=True):
        solution = np.concatenate(([gain], -parameters, [-1.0]))
        left = float(np.linalg.norm(factor @ solution))
        term_size = float(np.linalg.norm(factor * solution))
        rounding = epsilon * term_size
        norms.append(max(left, rounding))
    return np.array(norms)
