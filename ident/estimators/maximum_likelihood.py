"""Structured total least squares: the errors are in the current references alone.

The positions of a geared robot are known to a few µrad; what differs from run to run is the current
reference. So for each motor i, with T from the drive train (g_i v_i = (T τ)_i),

    v_i = γ_i (T W χ + T W_uL χ_uL + T W_kL χ_kL)_i + e_i,      γ_i = 1/g_i,     e_i ~ (0, σ_i²),

and the estimate minimises Σ_i r_i log ‖e_i‖, the likelihood of r_i rows at the best σ_i: the
maximum-likelihood member of the paper's family. For given σ_i its equations are those of least
Σ_i ‖e_i‖²/σ_i². In the paper's terms it is the total least squares of eq. (17) that corrects the
columns V only. It does not change when a current is given in another unit or the columns are
scaled.
"""

from __future__ import annotations

import numpy as np

from ident.arrays import FloatArray
from ident.equations.currents import Currents
from ident.equations.linearisation import jackknife_covariance
from ident.equations.system import System, require_known_payload, require_rows
from ident.errors import DataUnfit, NotConverged, RankDeficient
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import Scaling, tls, wls
from ident.estimators.method import Method

MAX_ITERATIONS = 100
STEP_TOLERANCE = 1e-7  #: Relative step of the gains; their standard deviations are some 1e-3
LARGEST_DAMPING = 1e6
#: After these σ stays: with internal preload it would settle more slowly than the gains
NOISE_ITERATIONS = 20


def ml(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Damped Gauss-Newton from the likeliest of the linear estimates.

    Args:
        system: of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (m,); the problem is then linear.

    Raises:
        DataUnfit: free gains without a known payload, or fewer rows than unknowns.
        RankDeficient: no linear estimate gives every gain a value to start from.
        TooFewMoves: for the covariance.
        NotConverged: after MAX_ITERATIONS the cost still falls, or no damped step lowers it.
    """
    return _maximum_likelihood(system, system, Method.ML, fixed_gains)


def iv(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Two-stage least squares: `ml` with the columns projected on those of the demanded motion.

    Where a torque disturbs the arm inside its position loop, recorded motion and error share a
    cause, and `ml` is biased. The demanded motion knows nothing of the disturbance: Σ_i γ_i/σ_i² (T
    Ŵ)_iᵀ e_i = 0 and v̂_iᵀ e_i = 0, with Ŵ and v̂ of that motion, hold in the mean however strong
    it is (Söderström & Stoica, System Identification, ch. 8; for robots Janot, Vandanjon & Gautier
    2014). σ is the jackknife of these conditions.

    Arguments and errors are those of `ml`.

    Raises:
        DataUnfit: no run of the system has instruments.
    """
    if fixed_gains is None:
        require_known_payload(system)
    if system.model.is_redundant:
        raise DataUnfit(
            ", ".join(system.runs),
            "the robot has more motors than degrees of freedom, and iv needs an equation for each "
            "motor alone; choose the method ml",
        )
    if not system.instruments:
        raise DataUnfit(
            ", ".join(system.runs),
            "the demanded motion is not known: the joints do not move from rest to rest at "
            "trapezoidal speed; choose the method ml, or record point-to-point moves",
        )
    return _maximum_likelihood(system.on_instruments(), system, Method.IV, fixed_gains)


def _maximum_likelihood(
    system: System, recorded: System, method: Method, fixed_gains: FloatArray | None
) -> Estimate:
    """Estimate from one system; σ from the residuals of the recorded one."""
    require_rows(system)
    has_fixed_gains = fixed_gains is not None
    if fixed_gains is None:
        require_known_payload(system)
        gains, iterations = _gauss_newton(system)
        free = len(system.unknowns) + system.axis_count
    else:
        gains = fixed_gains
        iterations = 0
        free = len(system.unknowns)
    parameters, noise = system.currents.settled(gains, free)
    full = np.concatenate((gains, parameters, [1.0]))
    weighted = system.weighted_singular_values(full, free, gains=not has_fixed_gains)
    condition = float(weighted[0] / weighted[-1])
    covariance = jackknife_covariance(
        system, gains, parameters, noise, gains_fixed=has_fixed_gains, recorded=recorded
    )
    axis_noise = recorded.currents.noise(gains, parameters, free, noise)
    rows = int(system.currents.rows.sum())
    return Estimate(
        method=method,
        gains=gains,
        gains_fixed=has_fixed_gains,
        unknowns=system.unknowns,
        parameters=parameters,
        covariance=covariance,
        axis_noise=axis_noise,
        singular_values=weighted,
        condition=condition,
        rows=rows,
        iterations=iterations,
    )


def _gauss_newton(system: System) -> tuple[FloatArray, int]:
    """Gains by variable projection: χ is eliminated, so that only m unknowns are iterated."""
    currents = system.currents
    gains = _start(system)
    noise = np.ones(system.axis_count)
    for _ in range(3):
        parameters = currents.whitened(gains, noise).parameters(gains)
        noise = currents.noise(gains, parameters, 0, noise)
    costs = [currents.cost(gains, parameters, noise)]
    damping = 1e-3
    for iteration in range(1, MAX_ITERATIONS + 1):
        gram, gradient = _projected_equations(currents, gains, noise)
        # Judged before damping: a step made small by damping alone is a failure, not an optimum.
        undamped = np.linalg.lstsq(gram, gradient, rcond=None)[0]
        step = float(np.max(np.abs(undamped)))
        if step < STEP_TOLERANCE:
            return gains, iteration
        while True:
            diagonal = np.diag(np.diag(gram))
            damped_gram = gram + damping * diagonal
            relative = np.linalg.solve(damped_gram, gradient)
            trial = gains / (1.0 + relative)
            keeps_signs = np.sign(trial) == np.sign(gains)
            if np.all(keeps_signs):
                parameters = currents.whitened(trial, noise).parameters(trial)
                trial_cost = currents.cost(trial, parameters, noise)
                rounding = 1e-12 * abs(costs[-1])
                if trial_cost <= costs[-1] + rounding:
                    break
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                raise NotConverged("ml", iteration, tuple(costs), step)
        gains = trial
        damping = max(damping * 0.1, 1e-12)
        if iteration <= NOISE_ITERATIONS:
            noise = currents.noise(gains, parameters, 0, noise)
        costs.append(currents.cost(gains, parameters, noise))
    raise NotConverged("ml", MAX_ITERATIONS, tuple(costs), step)


def _start(system: System) -> FloatArray:
    """Gains of the likeliest linear estimate: each of them is the best on some data."""
    currents = system.currents
    even = np.ones(system.axis_count)

    def cost(gains: FloatArray) -> float:
        parameters = currents.whitened(gains, even).parameters(gains)
        return currents.cost(gains, parameters, even)

    estimates = [wls(system), tls(system, Scaling.COLUMNS), tls(system, Scaling.BOTH)]
    usable = []
    for estimate in estimates:
        is_usable = np.isfinite(estimate.gains) & (estimate.gains != 0.0)
        if np.all(is_usable):
            usable.append(estimate.gains)
    if not usable:
        names = tuple(f"gain {motor + 1}" for motor in range(system.axis_count))
        raise RankDeficient("no linear estimate gives every gain a value", names)
    return min(usable, key=cost)


def _projected_equations(
    currents: Currents, gains: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of relative steps of 1/g, with χ projected out; shapes (m, m) and (m,)."""
    whitened = currents.whitened(gains, noise)
    parameters = whitened.parameters(gains)
    residual = whitened.residual(gains, parameters)
    # Relative steps of 1/g, so that motors of different units are alike.
    columns = currents.corrected(gains, noise, whitened, residual) * gains
    unit_columns = whitened.linear / np.linalg.norm(whitened.linear, axis=0)
    q, _ = np.linalg.qr(unit_columns)
    projected = columns - q @ (q.T @ columns)
    return projected.T @ projected, projected.T @ residual
