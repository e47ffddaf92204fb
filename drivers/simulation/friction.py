"""Dry friction that really sticks: a complementarity problem on velocities, solved by projected Gauss-Seidel.

Along each direction d_k (a joint, or a motor that turns with several joints) friction gives an impulse λ_k with

    |λ_k| ≤ b_k,     w_k > 0 ⇒ λ_k = −b_k,     w_k < 0 ⇒ λ_k = +b_k,     w = w_free + W λ,     W = D A⁻¹ Dᵀ,

where w = D v⁺ are the speeds at the end of the step and b_k is the bound [Nm] times the step [s]. This is the
optimality condition of the convex problem min ½ λᵀ W λ + w_freeᵀ λ over the box |λ| ≤ b, so v⁺ is unique even where λ
is not (dependent directions, eq. 25 of the seed paper), and no smoothing constant enters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile with numba, cached in the ``__pycache__`` beside the function's file (NUMBA_CACHE_DIR overrides it).

    numba invalidates a cached function when its own file changes, not when a function it calls in another file does:
    so compiled functions call only compiled functions of their own file.
    """
    return cast(F, numba.njit(cache=True)(function))


FloatArray = NDArray[np.float64]

TOLERANCE_RAD_S = 1e-10  #: Largest speed that a direction may keep while its friction is inside its bound [rad/s]

MAX_SWEEPS = 2_000

SWEEPS_A_ROUND = 10  #: Sweeps that find which directions stick, before these are solved for directly

DEPENDENT = 1e-9  #: Relative pivot below which a sticking direction depends on those before it


@compiled
def solve(
    delassus: FloatArray, free: FloatArray, bound: FloatArray, impulse: FloatArray, tolerance: float, sweeps: int
) -> float:
    """Solve for the impulses in place, starting from those of the step before.

    Gauss-Seidel sweeps find which directions stick; where they converge slowly (ill-conditioned inertias), the sticking
    ones are solved for directly, stopping at the first bound. Both only lower the convex cost, so together they end.

    Args:
        delassus: W, shape (m, m), symmetric, positive on the diagonal.
        free: speeds without dry friction [rad/s], shape (m,).
        bound: largest impulse of each direction [Nm s], shape (m,), not negative.
        impulse: λ, start value in and solution out, shape (m,).
        tolerance: largest accepted certificate [rad/s].
        sweeps: largest number of Gauss-Seidel sweeps.

    Returns:
        the certificate: the largest |λ_k − clip(λ_k − w_k/W_kk, −b_k, b_k)| W_kk [rad/s], recomputed after the last
        sweep. It is zero exactly at the solution; a direction inside its bound has |w_k| at most this.
    """
    for k in range(len(free)):
        if not np.isfinite(free[k]):
            return np.inf  # a comparison with NaN would pass for a solution
        impulse[k] = min(max(impulse[k], -bound[k]), bound[k])
    residual = np.inf
    for sweep in range(sweeps):
        change = 0.0
        for k in range(len(free)):
            if bound[k] > 0.0:
                moved = _relaxed(delassus, free, bound, impulse, k)
                change = max(change, abs(moved - impulse[k]) * delassus[k, k])
                impulse[k] = moved
        if change <= tolerance:
            residual = 0.0
            for k in range(len(free)):
                moved = _relaxed(delassus, free, bound, impulse, k)
                residual = max(residual, abs(moved - impulse[k]) * delassus[k, k])
            if residual <= tolerance:
                break
        if sweep % SWEEPS_A_ROUND == SWEEPS_A_ROUND - 1:
            _stick(delassus, free, bound, impulse)
    return residual


@compiled
def _relaxed(delassus: FloatArray, free: FloatArray, bound: FloatArray, impulse: FloatArray, k: int) -> float:
    """Return the impulse of direction k for given impulses of the others."""
    w = free[k]
    for j in range(len(free)):
        w += delassus[k, j] * impulse[j]
    return float(min(max(impulse[k] - w / delassus[k, k], -bound[k]), bound[k]))


@compiled
def _stick(delassus: FloatArray, free: FloatArray, bound: FloatArray, impulse: FloatArray) -> None:
    """Bring the directions inside their bounds to rest by Cholesky, in as many pieces as bounds are met on the way."""
    m = len(free)
    lower = np.zeros((m, m))
    step = np.zeros(m)
    for _ in range(m):
        # Factorise W over the free directions; a dependent one keeps its impulse, the others can stop it as well.
        inside = np.abs(impulse) < bound
        for i in range(m):
            step[i] = 0.0
            if not inside[i]:
                continue
            pivot = delassus[i, i]
            step[i] = -free[i]
            for j in range(m):
                step[i] -= delassus[i, j] * impulse[j]
            for j in range(i):
                if inside[j]:
                    s = delassus[i, j]
                    for k in range(j):
                        if inside[k]:
                            s -= lower[i, k] * lower[j, k]
                    lower[i, j] = s / lower[j, j]
                    pivot -= lower[i, j] ** 2
                    step[i] -= lower[i, j] * step[j]
            if pivot <= DEPENDENT * delassus[i, i]:
                inside[i] = False
                step[i] = 0.0
            else:
                lower[i, i] = np.sqrt(pivot)
                step[i] /= lower[i, i]
        if not _advance(lower, inside, bound, impulse, step):
            break


@compiled
def _advance(
    lower: FloatArray, inside: NDArray[np.bool_], bound: FloatArray, impulse: FloatArray, step: FloatArray
) -> bool:
    """Finish the substitution, step as far as the bounds allow, and return whether a bound was met."""
    m = len(step)
    length = 1.0
    blocking = -1
    for i in range(m - 1, -1, -1):
        if inside[i]:
            for k in range(i + 1, m):
                if inside[k]:
                    step[i] -= lower[k, i] * step[k]
            step[i] /= lower[i, i]
            room = (bound[i] if step[i] > 0.0 else -bound[i]) - impulse[i]
            if abs(step[i]) * length > abs(room):
                length = room / step[i]
                blocking = i
    for i in range(m):
        if inside[i]:
            impulse[i] = min(max(impulse[i] + length * step[i], -bound[i]), bound[i])
    if blocking >= 0:
        impulse[blocking] = bound[blocking] if step[blocking] > 0.0 else -bound[blocking]
    return blocking >= 0
