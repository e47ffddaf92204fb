"""Refinement of settings: from any start in their ranges to the best values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.arrays import FloatArray
from ident.discovery.candidate_fits import CandidateFit
from ident.discovery.candidates import SearchProblem
from ident.discovery.refinement import refine_together
from ident.effects.effect import Effect, Property, Range
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column

LEAST = 0.5
LARGEST = 3.0
BEST = (1.7, 0.9)
SCALE = 1e4
"""Fall of the squared residual at the best settings."""


@dataclass(frozen=True, slots=True)
class Bump(Effect):
    """A torque around a position, of a width."""

    name = "bump"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("height", "Nm"),)

    centre_rad: Annotated[float, Range(LEAST, LARGEST)]
    width_rad: Annotated[float, Range(LEAST, LARGEST)]

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        raise AssertionError("the search problem of this test needs none")


class _Hill:
    """A search problem whose fall has one hump, at BEST."""

    def torque_at_rows(self, effect: Effect, axis: int) -> Effect:
        return effect

    def fits(self, effects: Sequence[Effect]) -> list[CandidateFit]:
        (effect,) = effects
        centre, width = (effect.settings[name] for name in ("centre_rad", "width_rad"))
        centre_difference = centre - BEST[0]
        width_difference = width - BEST[1]
        distance = centre_difference**2 + width_difference**2
        fall_by_motor = np.array([SCALE / (1.0 + distance)])
        coefficients = np.array([1.0])
        return [CandidateFit(coefficients=coefficients, fall_by_motor=fall_by_motor)]


def _refined(centre_rad: float, width_rad: float) -> tuple[float, ...]:
    hill = cast(SearchProblem, _Hill())
    bump = Bump(centre_rad, width_rad)
    effect = refine_together(hill, bump, axis=0)
    return tuple(effect.settings.values())


@given(st.floats(LEAST, LARGEST), st.floats(LEAST, LARGEST))
@settings(max_examples=60)
def test_settings_are_refined_to_the_best_from_any_start(centre: float, width: float) -> None:
    assert _refined(centre, width) == pytest.approx(BEST, abs=0.02)


@pytest.mark.parametrize("centre", [LEAST, LARGEST])
@pytest.mark.parametrize("width", [LEAST, LARGEST])
def test_settings_are_refined_from_the_ends_of_their_ranges(centre: float, width: float) -> None:
    assert _refined(centre, width) == pytest.approx(BEST, abs=0.02)


def test_settings_that_are_the_best_stay_as_they_are() -> None:
    assert _refined(*BEST) == BEST
