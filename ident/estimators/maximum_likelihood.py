"""Structured total least squares: the errors are in the current references alone.

The positions of a geared robot are known to a few µrad; what differs from run to run is the current reference. So for
each motor i, with T from the drive train (g_i v_i = (T τ)_i),

    v_i = γ_i (T W χ + T W_uL χ_uL + T W_kL χ_kL)_i + e_i,      γ_i = 1/g_i,     e_i ~ (0, σ_i²),

and the estimate minimises Σ_i ‖e_i‖²/σ_i² with σ_i estimated along: the maximum-likelihood member of the paper's
family. In the paper's terms it is the total least squares of eq. (17) that corrects the columns V only. It does not
change when a current is given in another unit or the columns are scaled.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.equations.linearisation import jackknife_covariance
from ident.equations.system import System, Triangles, require_known_payload, require_rows, solve
from ident.errors import DataUnfit, NotConverged, RankDeficient
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import Scaling, tls, wls
from ident.estimators.method import Method

MAX_ITERATIONS = 100
STEP_TOLERANCE = 1e-7  #: Relative step of the gains; their standard deviations are some 1e-3
LARGEST_DAMPING = 1e6


def ml(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Damped Gauss-Newton from the likeliest of the linear estimates.

    Args:
        system: of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (n,); the problem is then linear.

    Raises:
        DataUnfit: free gains without a known payload, or fewer rows than unknowns.
        RankDeficient: no linear estimate gives every gain a value to start from.
        TooFewMoves: for the covariance.
        NotConverged: the cost still falls, or cannot fall, after MAX_ITERATIONS.
    """
    return _maximum_likelihood(system, system, Method.ML, fixed_gains)


def iv(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Two-stage least squares: `ml` with the columns projected on those of the demanded motion.

    Where a torque disturbs the arm inside its position loop, recorded motion and error share a cause, and `ml` is
    biased. The demanded motion knows nothing of the disturbance: Σ_i (T L̂_i)ᵀ e_i γ_i/σ_i² = 0 and v̂_iᵀ e_i = 0 with L̂
    and v̂ of that motion hold in the mean however strong it is (Söderström & Stoica, System Identification, ch. 8; for
    robots Janot, Vandanjon & Gautier 2014). σ is the jackknife of these conditions.

    Arguments and errors are those of `ml`.

    Raises:
        DataUnfit: no run of the system has instruments.
    """
    if fixed_gains is None:
        require_known_payload(system)
    if not system.instruments:
        raise DataUnfit(
            ", ".join(system.runs),
            "the demanded motion is not known: the joints do not move from rest to rest at trapezoidal speed; "
            "choose the method ml, or record point-to-point moves",
        )
    return _maximum_likelihood(system.on_instruments(), system, Method.IV, fixed_gains)


def _maximum_likelihood(system: System, recorded: System, method: Method, fixed_gains: FloatArray | None) -> Estimate:
    """Estimate from one system; σ from the residuals of the recorded one."""
    require_rows(system)
    triangles = system.motors
    if fixed_gains is None:
        require_known_payload(system)
        gamma, iterations = _gauss_newton(system)
    else:
        gamma, iterations = 1.0 / fixed_gains, 0
    free = len(system.unknowns) + (0 if fixed_gains is not None else system.joint_count)
    parameters, noise = settled(triangles, gamma, free)
    full = np.concatenate((1.0 / gamma, parameters, [1.0]))
    weighted = system.joints.weighted_system(full, free, gains=fixed_gains is None)
    covariance = jackknife_covariance(
        system, 1.0 / gamma, parameters, noise, gains_fixed=fixed_gains is not None, recorded=recorded
    )
    return Estimate(
        method=method,
        gains=1.0 / gamma,
        gains_fixed=fixed_gains is not None,
        unknowns=system.unknowns,
        parameters=parameters,
        covariance=covariance,
        axis_noise=noise_of(recorded.motors, gamma, parameters, free),
        singular_values=weighted,
        condition=float(weighted[0] / weighted[-1]),
        rows=int(triangles.rows.sum()),
        iterations=iterations,
    )


def _scaled_linear(triangles: Triangles, gamma: FloatArray, noise: FloatArray) -> FloatArray:
    return np.concatenate([f[:, 1:-1] * (g / s) for f, g, s in zip(triangles.factors, gamma, noise, strict=True)])


def _parameters(triangles: Triangles, gamma: FloatArray, noise: FloatArray) -> FloatArray:
    """χ for given γ: linear least squares."""
    right = np.concatenate(
        [(f[:, 0] - g * f[:, -1]) / s for f, g, s in zip(triangles.factors, gamma, noise, strict=True)]
    )
    return solve(_scaled_linear(triangles, gamma, noise), right)[0]


def _residuals(triangles: Triangles, gamma: FloatArray, parameters: FloatArray) -> list[FloatArray]:
    vectors = (np.concatenate(([1.0], -g * parameters, [-g])) for g in gamma)
    return [factor @ vector for factor, vector in zip(triangles.factors, vectors, strict=True)]


def settled(triangles: Triangles, gamma: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
    """χ and σ of each motor's current [A] for given γ, shapes (p,) and (n,): a fixed point of a few rounds."""
    noise = noise_of(triangles, gamma, _parameters(triangles, gamma, np.ones(len(gamma))), free)
    for _ in range(30):
        parameters = _parameters(triangles, gamma, noise)
        updated = noise_of(triangles, gamma, parameters, free)
        if np.allclose(updated, noise, rtol=1e-10):
            break
        noise = updated
    return parameters, noise


def noise_of(triangles: Triangles, gamma: FloatArray, parameters: FloatArray, free: int) -> FloatArray:
    """σ of each motor's current [A] around an estimate, shape (n,); ``free`` parameters are shared among the motors.

    It is 1 for a motor without rows, which has no residual.
    """
    size = np.array([float(e @ e) for e in _residuals(triangles, gamma, parameters)])
    size[triangles.rows == 0] = 1.0
    return np.asarray(np.sqrt(size / np.maximum(triangles.rows - free / len(gamma), 1.0)))


def _gauss_newton(system: System) -> tuple[FloatArray, int]:
    """γ by variable projection: χ is eliminated for each γ, so that only n unknowns are iterated."""
    count, triangles = system.joint_count, system.motors
    # Start from the linear estimate under which the data are most likely. Each of them is the best on some data.
    starts = [wls(system), tls(system, Scaling.COLUMNS), tls(system, Scaling.BOTH)]
    gammas = [1.0 / start.gains for start in starts if np.all(np.isfinite(start.gains)) and np.all(start.gains != 0.0)]
    if not gammas:
        names = tuple(f"gain {motor + 1}" for motor in range(count))
        raise RankDeficient("no linear estimate gives every gain a value", names)
    even = np.ones(count)
    gamma = min(gammas, key=lambda one: _log_likelihood_cost(triangles, one, _parameters(triangles, one, even)))
    noise = np.ones(count)
    for _ in range(3):
        parameters = _parameters(triangles, gamma, noise)
        noise = noise_of(triangles, gamma, parameters, 0)
    cost = [_log_likelihood_cost(triangles, gamma, parameters)]
    damping = 1e-3
    for iteration in range(1, MAX_ITERATIONS + 1):
        parameters = _parameters(triangles, gamma, noise)
        residual = np.concatenate([e / s for e, s in zip(_residuals(triangles, gamma, parameters), noise, strict=True)])
        linear = _scaled_linear(triangles, gamma, noise)
        vector = np.concatenate(([0.0], parameters, [1.0]))
        # Relative steps of γ, so that motors of different units are alike.
        steps = zip(triangles.factors, gamma / noise, strict=True)
        gain_columns = linalg.block_diag(*((factor @ vector * step)[:, None] for factor, step in steps))
        q, _ = np.linalg.qr(linear / np.linalg.norm(linear, axis=0))
        projected = gain_columns - q @ (q.T @ gain_columns)
        gram, gradient = projected.T @ projected, projected.T @ residual
        # Judged before damping: a step made small by damping alone is a failure, not an optimum.
        step = float(np.max(np.abs(np.linalg.lstsq(gram, gradient, rcond=None)[0])))
        if step < STEP_TOLERANCE:
            return gamma, iteration
        while True:
            relative = np.linalg.solve(gram + damping * np.diag(np.diag(gram)), gradient)
            trial = gamma * (1.0 + relative)
            if np.all(np.sign(trial) == np.sign(gamma)):
                candidate = _parameters(triangles, trial, noise)
                trial_cost = _log_likelihood_cost(triangles, trial, candidate)
                if trial_cost <= cost[-1] + 1e-12 * abs(cost[-1]):
                    break
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                raise NotConverged("ml", iteration, tuple(cost), step)
        gamma, damping = trial, max(damping * 0.1, 1e-12)
        noise = noise_of(triangles, gamma, candidate, 0)
        cost.append(trial_cost)
    raise NotConverged("ml", MAX_ITERATIONS, tuple(cost), step)


def _log_likelihood_cost(triangles: Triangles, gamma: FloatArray, parameters: FloatArray) -> float:
    """−log L up to constants, with each σ_i at its optimum: Σ r_i log ‖e_i‖."""
    residuals = _residuals(triangles, gamma, parameters)
    return float(sum(rows * np.log(np.linalg.norm(e)) for rows, e in zip(triangles.rows, residuals, strict=True)))
