"""Noise floor: the noise of each motor's current at standstill, which bounds a model's error from below.

While a joint stands still no model of motion has anything to explain: friction holds it within ±Fs, the amplifier's
integrator creeps, and faster changes of the current are noise of measurement and control. Each standstill of a motor
is filtered and decimated like every row (windows wholly inside), a parabola in time is subtracted, and the rest gives
an estimate of σ² from each dwell d,

    s_d² = ‖M_d v_d‖²/tr(M_d P_d),        M_d = I − H_d,

with H_d the projection on (1, t, t²) and P_d the correlation that the filter itself gives to rows of white noise, so
that a short dwell counts only by what the detrending leaves of it. s_d² is nearly σ² χ²_ν/ν with ν = tr(MP)²/tr(MPMP)
(Satterthwaite 1946); divided by the median of χ²_ν/ν every dwell is as likely above σ² as below, and σ² is their
median, weighted by ν. A median, because an axis slips or rings in some of its dwells.

Limits. It is a lower bound: standstill does not show ripple, commutation error and the differentiated noise of the
encoder; noise slower than a dwell is subtracted with the parabola. It is too high where an axis hunts about its target
in most of its dwells. Dwells with one constant number (power stage off, brake on) are no measurement and are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning, decimator
from ident.data.dataset import Dataset
from ident.equations.rows import row_filter

MIN_DWELLS = 8
MIN_FREEDOM = 20.0  #: σ is then known to 20 %
_TREND = 3  #: Coefficients of the parabola: a straight line would leave the bend of a settling controller
_MEDIAN_EFFICIENCY = 2.0 / np.pi  #: Efficiency of a median of many against their mean (van der Vaart 1998, §21.2)


@dataclass(frozen=True, slots=True)
class NoiseFloor:
    """Noise floor of one motor."""

    noise_a: float  #: σ of the current in the observation's rows [A]
    dwells: int  #: number of standstills used
    freedom: float  #: their degrees of freedom, ν summed

    @property
    def std_percent(self) -> float:
        """Relative standard deviation of noise_a itself, for Gaussian noise [%]."""
        return 100.0 / float(np.sqrt(2.0 * _MEDIAN_EFFICIENCY * self.freedom))


def noise_floors(datasets: Sequence[Dataset], conditioning: Conditioning) -> tuple[NoiseFloor | None, ...]:
    """Estimate the noise of each motor's current in rows, None where it rested too seldom or too briefly.

    Raises:
        DataUnfit: a run is too short for the filter.
    """
    return tuple(_floor(datasets, conditioning, motor) for motor in range(datasets[0].current_a.shape[1]))


def _floor(datasets: Sequence[Dataset], conditioning: Conditioning, motor: int) -> NoiseFloor | None:
    dwells: list[tuple[float, float]] = []
    for data in datasets:
        filter_ = row_filter(data, conditioning)
        still = ~data.motor_moving[:, motor] & data.valid[:, motor]
        edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            current = data.current_a[start:stop, motor]
            if filter_.rows(len(current)) > _TREND and np.ptp(current) > 0.0:
                dwells.append(_variance(filter_(current), data.rate_hz, conditioning.decimation_cutoff_hz))
    if len(dwells) < MIN_DWELLS:
        return None
    variance, freedom = np.array(dwells).T
    if freedom.sum() < MIN_FREEDOM:
        return None
    likely = variance * freedom / scipy.special.chdtri(freedom, 0.5)
    order = np.argsort(likely)
    share = np.cumsum(freedom[order]) / freedom.sum()
    middle = likely[order][int(np.searchsorted(share, 0.5))]
    return NoiseFloor(float(np.sqrt(middle)), len(dwells), float(freedom.sum()))


def _variance(seen: FloatArray, rate_hz: float, cutoff_hz: float) -> tuple[float, float]:
    """Variance s_d² [A²] and freedom ν of one dwell, by its rows."""
    trend, expected, freedom = _detrending(rate_hz, cutoff_hz, len(seen))
    return float(np.sum((seen - trend @ (trend.T @ seen)) ** 2)) / expected, freedom


@lru_cache(maxsize=1024)
def _detrending(rate_hz: float, cutoff_hz: float, rows: int) -> tuple[FloatArray, float, float]:
    """Orthonormal parabolas over so many rows, shape (rows, 3), tr(MP) and ν: every dwell of this length has them."""
    filter_ = decimator(rate_hz, cutoff_hz)
    trend, _ = np.linalg.qr(np.vander(np.arange(rows, dtype=np.float64), _TREND))
    rest = np.eye(rows) - trend @ trend.T
    lags = filter_.factor * np.arange(rows)
    taps = filter_.taps
    of_lag = np.array([float(taps[lag:] @ taps[: len(taps) - lag]) if lag < len(taps) else 0.0 for lag in lags])
    correlation = of_lag[np.abs(np.subtract.outer(np.arange(rows), np.arange(rows)))] / of_lag[0]
    spread = rest @ correlation @ rest
    expected = float(np.trace(spread))
    return trend, expected, expected**2 / float(np.sum(spread**2))
