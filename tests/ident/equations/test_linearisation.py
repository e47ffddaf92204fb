"""The Jacobian against finite differences of the residual."""

from __future__ import annotations

import numpy as np
import pytest

from ident.data.run import Run
from ident.equations.linearisation import linearise
from tests.ident.recordings import Truth, gathered


def test_jacobian_is_the_slope_of_the_residual(truth: Truth, clean_runs: tuple[Run, ...]) -> None:
    start = gathered(truth, clean_runs)
    gains, parameters, noise = start.estimate.gains, start.estimate.parameters, np.full(6, 0.1)

    def problem(step: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return linearise(start.training, gains + step[:6], parameters + step[6:], noise, gains_fixed=False).residual

    around = linearise(start.training, gains, parameters, noise, gains_fixed=False)
    rng = np.random.default_rng(0)
    for _ in range(3):
        scaled = 1e-6 * rng.normal(size=len(around.free))
        step = np.zeros(6 + len(parameters))
        step[around.free] = scaled * around.scale
        slope = (problem(step) - problem(-step)) / 2.0
        assert slope == pytest.approx(-around.jacobian @ scaled, abs=1e-4 * np.max(np.abs(slope)))
