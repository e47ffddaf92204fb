"""Noise of encoders whose misfit is tested: its certain size and its correlation in time.

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
            along_ways = run.ways.T @ rows[first:last]
            white = along_ways.T / run.std
            parts.append(white.T)
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
    rows = np.column_stack((jacobian, right))
    uncorrelated = np.ones(len(right))
    best_criterion = _criterion(uncorrelated, rows)
    best = _white(directions)
    for time_s in CORRELATION_S:
        spectra = [_spectrum(run, time_s) for run in directions]
        eigenvalues = np.concatenate([spectrum.values for spectrum in spectra])
        rows_along_ways = _along_ways(spectra, rows)
        for share in CORRELATED:
            variance = _variance(eigenvalues, share)
            criterion = _criterion(variance, rows_along_ways)
            if criterion < best_criterion:
                best_criterion = criterion
                best = _correlated(spectra, share)
    return best


def _variance(eigenvalues: FloatArray, share: float) -> FloatArray:
    """Variances (1 − a) + a λ along the eigenvectors, in units of σ²."""
    return 1.0 - share + share * eigenvalues


def _white(directions: Sequence[RunDirections]) -> MisfitNoise:
    """Noise that is not correlated at all."""
    runs: list[RunNoise] = []
    total = 0
    for run in directions:
        samples, _, count = run.basis.shape
        size = samples * count
        runs.append(RunNoise(np.eye(size), np.ones(size)))
        total += size
    return MisfitNoise(tuple(runs), float(total))


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Eigenvalues and eigenvectors of exp(−|t − s|/τ) B_tᵀ B_s in one run."""

    values: FloatArray  #: shape (r,)
    ways: FloatArray  #: a column each, shape (r, r)


def _spectrum(run: RunDirections, correlation_s: float) -> _Spectrum:
    apart_s = np.abs(run.time_s[:, None] - run.time_s[None, :])
    decay = np.exp(-apart_s / correlation_s)
    # One row for each sample and direction: the products of all of them are one matrix product.
    samples, motors, count = run.basis.shape
    rows = np.swapaxes(run.basis, 1, 2).reshape(samples * count, motors)
    decay_of_samples = np.repeat(decay, count, axis=0)
    decay_of_rows = np.repeat(decay_of_samples, count, axis=1)
    correlation = (rows @ rows.T) * decay_of_rows
    values, ways = np.linalg.eigh(correlation)
    return _Spectrum(np.maximum(values, SMALLEST_EIGENVALUE), ways)


def _along_ways(spectra: Sequence[_Spectrum], rows: FloatArray) -> FloatArray:
    """Rows of all runs, in components along the eigenvectors of their run."""
    components: list[FloatArray] = []
    first = 0
    for spectrum in spectra:
        last = first + len(spectrum.values)
        components.append(spectrum.ways.T @ rows[first:last])
        first = last
    return np.concatenate(components)


def _criterion(variance: FloatArray, rows: FloatArray) -> float:
    """Twice the negative restricted log-likelihood, σ² at its maximum, but for a constant.

    Args:
        variance: of each row, shape (r,).
        rows: the jacobian and what it is fitted to, shape (r, p + 1).
    """
    scale = 1.0 / np.sqrt(variance)
    triangle = np.linalg.qr(scale[:, None] * rows, mode="r")
    tiny = np.finfo(np.float64).tiny
    diagonal = np.abs(np.diag(triangle))
    of_fitted = np.maximum(diagonal[:-1], tiny)
    of_residual = max(diagonal[-1], tiny)
    # log det C + log det JᵀC⁻¹J + (r − p) log ‖residual‖², by the diagonal of R
    row_count, width = rows.shape
    freedom = row_count - (width - 1)
    residual_term = 2.0 * freedom * np.log(of_residual)
    fit_term = 2.0 * np.sum(np.log(of_fitted))
    return float(np.sum(np.log(variance)) + residual_term + fit_term)


def _correlated(spectra: Sequence[_Spectrum], share: float) -> MisfitNoise:
    runs: list[RunNoise] = []
    for spectrum in spectra:
        std = np.sqrt(_variance(spectrum.values, share))
        runs.append(RunNoise(spectrum.ways, std))
    variance = np.concatenate([run.std**2 for run in runs])
    # A mean square of n numbers with these variances scatters as one of this many independent ones
    # (Satterthwaite).
    effective = np.sum(variance) ** 2 / np.sum(variance**2)
    return MisfitNoise(tuple(runs), float(effective))
