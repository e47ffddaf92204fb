"""Findings as a test of the geometry or of a search returns them."""

from __future__ import annotations

import numpy as np

from ident.discovery.search import Finding
from ident.effects.effect import Effect


def passed_finding(effect: Effect, axis: int, value: float, std: float) -> Finding:
    """A finding of one coefficient that has passed every gate."""
    coefficients = np.array([value])
    deviations = np.array([std])
    fold_errors = np.ones(8)
    return Finding(
        effect=effect,
        axis=axis,
        coefficients=coefficients,
        deviations=deviations,
        probability=0.001,
        folds_better=1.0,
        explained=0.5,
        error_before_percent=5.0,
        error_after_percent=4.0,
        error_fall=0.2,
        left_out_fall=9.0,
        passed=True,
        fold_errors=fold_errors,
    )
