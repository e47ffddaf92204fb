"""Noise of encoders whose misfit is tested:
how large it is for certain, and how it is correlated in time.

The certain part is what counts and differences from sample to sample show. A misfit that is far
above it has a cause.

The correlation decides σ of an estimate. Each encoder has white noise and noise that decays over a
correlation time τ,

    cov(ε_t, ε_s) = σ² ((1 − a) δ_ts + a exp(−|t − s|/τ)),

alike on all encoders. Of ε only the part in the misfit's directions B_t is seen, so that the
covariance of a misfit is that of ε times B_tᵀ B_s. a and τ maximise the restricted likelihood
(Patterson and Thompson, Biometrika 1971, 58): it knows that the fitted numbers have taken a part of
the noise with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray

CORRELATION_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  #: Times τ that are tried
CORRELATED = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 1.0)  #: Shares a of σ² that are tried
SMALLEST_EIGENVALUE = 1e-9  #: Of the correlation: rounding


@dataclass(frozen=True, slots=True, eq=False)
class RunNoise:
    """Eigenvectors of the correlated part in one run, and the standard deviation along each."""

    ways: FloatArray  #: a column each, shape (r, r)
    std: FloatArray  #: in units of σ, shape (r,)


@dataclass(frozen=True, slots=True, eq=False)
class MisfitNoise:
    """Correlation of the misfits of all runs; runs are independent of each other."""

    runs: tuple[RunNoise, ...]
    effective: float  #: independent numbers that scatter as much as these do

    def white(self, rows: FloatArray) -> FloatArray:
        """Make the noise of rows white, shape (r, …) of all runs one after the other."""
        parts: list[FloatArray] = []
        first = 0
        for run in self.runs:
            last = first + len(run.std)
            turned = run.ways.T @ rows[first:last]
            parts.append((turned.T / run.std).T)
            first = last
        return np.concatenate(parts)


@dataclass(frozen=True, slots=True, eq=False)
class RunDirections:
    """When the misfits of a run were seen, and in which directions."""

    time_s: FloatArray  #: of each sample, shape (k,)
    basis: FloatArray  #: B, orthonormal columns, shape (k, m, m − d)


def estimate_noise(
    directions: Sequence[RunDirections], jacobian: FloatArray, right: FloatArray
) -> MisfitNoise:
    """Estimate the correlation from the residual of a linear fit.

    Args:
        directions: of each run; a sample has m − d rows.
        jacobian: of independent numbers, shape (r, p).
        right: what they are fitted to, shape (r,).
    """
    best_criterion = _criterion(np.ones(len(right)), jacobian, right)
    best = _white([one.basis.shape[0] * one.basis.shape[2] for one in directions])
    for time_s in CORRELATION_S:
        decomposed = [_decomposed(one, time_s) for one in directions]
        values = np.concatenate([one[0] for one in decomposed])
        turned = _turned([one[1] for one in decomposed], np.column_stack((jacobian, right)))
        for share in CORRELATED:
            variance = 1.0 - share + share * values
            criterion = _criterion(variance, turned[:, :-1], turned[:, -1])
            if criterion < best_criterion:
                best_criterion = criterion
                best = _correlated(decomposed, share)
    return best


def _white(counts: Sequence[int]) -> MisfitNoise:
    runs = tuple(RunNoise(np.eye(count), np.ones(count)) for count in counts)
    return MisfitNoise(runs, float(sum(counts)))


def _decomposed(run: RunDirections, correlation_s: float) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues and eigenvectors of exp(−|t − s|/τ) B_tᵀ B_s, shapes (r,) and (r, r)."""
    apart_s = np.abs(run.time_s[:, None] - run.time_s[None, :])
    decay = np.exp(-apart_s / correlation_s)
    # One row for each sample and direction: the products of all of them are one matrix product.
    samples, motors, count = run.basis.shape
    rows = np.swapaxes(run.basis, 1, 2).reshape(samples * count, motors)
    correlation = (rows @ rows.T) * np.repeat(np.repeat(decay, count, axis=0), count, axis=1)
    values, ways = np.linalg.eigh(correlation)
    return np.maximum(values, SMALLEST_EIGENVALUE), ways


def _turned(ways: Sequence[FloatArray], rows: FloatArray) -> FloatArray:
    ends = np.cumsum([len(one) for one in ways])
    parts = np.split(rows, ends[:-1])
    return np.concatenate([one.T @ part for one, part in zip(ways, parts, strict=True)])


def _criterion(variance: FloatArray, jacobian: FloatArray, right: FloatArray) -> float:
    """Twice the negative restricted log-likelihood, σ² at its maximum, but for a constant."""
    scale = 1.0 / np.sqrt(variance)
    triangle = np.linalg.qr(scale[:, None] * np.column_stack((jacobian, right)), mode="r")
    diagonal = np.abs(np.diag(triangle))
    free = len(right) - jacobian.shape[1]
    tiny = np.finfo(np.float64).tiny
    of_residual = 2.0 * free * np.log(max(diagonal[-1], tiny))
    of_fit = 2.0 * np.sum(np.log(np.maximum(diagonal[:-1], tiny)))
    return float(np.sum(np.log(variance)) + of_residual + of_fit)


def _correlated(decomposed: Sequence[tuple[FloatArray, FloatArray]], share: float) -> MisfitNoise:
    runs: list[RunNoise] = []
    for values, ways in decomposed:
        runs.append(RunNoise(ways, np.sqrt(1.0 - share + share * values)))
    variance = np.concatenate([run.std**2 for run in runs])
    # A mean square of n numbers with these variances scatters as one of this many independent ones
    # (Satterthwaite).
    effective = np.sum(variance) ** 2 / np.sum(variance**2)
    return MisfitNoise(tuple(runs), float(effective))
