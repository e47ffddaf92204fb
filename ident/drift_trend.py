"""A gain that changes steadily: the slope of the straight line through its calibrations, over the σ of that slope.

With gᵢ the gain of calibration i = 1 … n and wᵢ = 1/σᵢ² (weighted least squares; Draper & Smith, Applied Regression
Analysis, ch. 9)::

    t = Σ wᵢ (i − ī) gᵢ / √(Σ wᵢ (i − ī)²),    ī = Σ wᵢ i / Σ wᵢ

Without drift t is standard normal for every n. A chart of deviations from a baseline is blind to what happens while the
baseline is made. The line needs none: of all tests that do not know the level, |t| is the most powerful against a drift
that goes on from the first calibration to the last. It is worse than the CUSUM at what comes late, because all the
calibrations before it pull at the line too; so neither replaces the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FEWEST = 4
"""Calibrations of the first line that is looked at; through fewer it is hardly more than one difference."""


@dataclass(frozen=True, slots=True)
class Line:
    """The line through all calibrations of one gain.

    Attributes:
        start, start_std: its value at the first calibration, in the unit of the gain.
        slope, slope_std: in that unit a calibration.
    """

    start: float
    start_std: float
    slope: float
    slope_std: float


def line(values: FloatArray, stds: FloatArray) -> Line:
    """Weighted least squares.

    Args:
        values, stds: shape (n,), n ≥ 2, oldest first, σ > 0.
    """
    weights = 1.0 / stds**2
    total = float(weights.sum())
    places = np.arange(len(values))
    middle, mean = float(weights @ places) / total, float(weights @ values) / total
    spread = float(weights @ (places - middle) ** 2)
    slope = float(weights @ ((places - middle) * (values - mean))) / spread
    start_std = math.sqrt(1.0 / total + middle**2 / spread)
    return Line(mean - slope * middle, start_std, slope, 1.0 / math.sqrt(spread))


def trend(values: FloatArray, stds: FloatArray, dispersion: FloatArray | float) -> FloatArray:
    """t of the line through the first n calibrations, for every n and any number of gains at once.

    Args:
        values, stds: magnitudes, shape (..., n), oldest first, σ > 0.
        dispersion: scatter of repeated calibrations over their σ, shape (...) or a number.

    Returns:
        shape (..., n), positive where the magnitude rises; 0 for the first FEWEST − 1.
    """
    found = np.zeros(values.shape)
    total, middle, mean, spread, product = (np.zeros(values.shape[:-1]) for _ in range(5))
    # About running means (West 1979): differences of large sums lose their digits where one σ is far below the others.
    for i in range(values.shape[-1]):
        weight = 1.0 / stds[..., i] ** 2
        total = total + weight
        away = i - middle
        middle = middle + weight / total * away
        mean = mean + weight / total * (values[..., i] - mean)
        spread = spread + weight * away * (i - middle)
        product = product + weight * away * (values[..., i] - mean)
        if i + 1 >= FEWEST:
            found[..., i] = product / np.sqrt(spread) / dispersion
    return found
