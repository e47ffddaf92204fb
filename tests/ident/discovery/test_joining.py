"""What instruments from the demanded motion say of an effect that a fit in a position loop has found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.discovery.joining import _contradiction
from ident.effects.effect import PlacedEffect
from ident.effects.friction import NonlinearViscous
from ident.effects.geometry_corrections import LatePosition
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth

LATE = PlacedEffect(LatePosition(), 1)


def contradiction(value: float, std: float, fitted: float, placed: PlacedEffect = LATE) -> str:
    """What is said of one coefficient."""
    return _contradiction(placed, np.array([value]), np.array([fitted]), np.array([[std**2]]))


@pytest.mark.parametrize(
    ("value_ms", "said"),
    [
        (0.3, "may all be zero"),  # nothing is left of it by instruments
        (1.3, "0.0013 s, not 0.0042"),  # a third of it is left: what the fit says is mostly the loop
        (3.0, ""),  # nearer to the fit than to zero
        (4.0, ""),
    ],
)
def test_contradiction_by_instruments_is_said_with_its_size(value_ms: float, said: str) -> None:
    words = contradiction(1e-3 * value_ms, 0.34e-3, 4.2e-3)
    assert said in words
    assert bool(words) == bool(said)


def test_contradiction_of_instruments_that_show_nothing_refutes_no_named_effect() -> None:
    """Without point-to-point moves of that joint σ by instruments is larger than the effect."""
    assert contradiction(0.5, 3.0, 4.2) == ""
    unnamed = PlacedEffect(Smooth(next(iter(Abscissa))), 1)
    count = len(unnamed.effect.coefficients)
    covariance = 9.0 * np.eye(count)
    assert _contradiction(unnamed, np.full(count, 0.5), np.full(count, 4.2), covariance) != ""


@given(
    fitted=st.floats(0.01, 10.0),
    share=st.floats(0.51, 3.0),
    std=st.floats(1e-4, 100.0),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_contradiction_never_refutes_what_instruments_find_at_half_the_size(
    fitted: float, share: float, std: float, sign: float
) -> None:
    placed = PlacedEffect(NonlinearViscous(0.5), 0)
    assert contradiction(sign * share * fitted, std, sign * fitted, placed) == ""
