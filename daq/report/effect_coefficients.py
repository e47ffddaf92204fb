"""What a fit says of the coefficients of an effect in it."""

from __future__ import annotations

from ident.calibration import Parameter
from ident.effects.placed import PlacedEffect
from ident.loop import Evidence


def coefficients(evidence: Evidence, placed: PlacedEffect) -> tuple[Parameter, ...]:
    """The linear parameters of an effect with their σ, by their short names; empty where it is not in the model."""
    estimate = evidence.estimate
    index = {column.name: number for number, column in enumerate(estimate.unknowns)}
    return tuple(
        Parameter(
            short.name,
            float(estimate.parameters[index[whole.name]]),
            float(estimate.parameters_std[index[whole.name]]),
            whole.unit,
        )
        for short, whole in zip(placed.effect.coefficients, placed.columns, strict=True)
        if whole.name in index
    )
