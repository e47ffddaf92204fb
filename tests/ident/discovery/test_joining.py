"""What instruments from the demanded motion say of an effect that a fit in a position loop has
found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.discovery.candidates import ColumnCache
from ident.discovery.evidence import with_effects
from ident.discovery.gates import Gates
from ident.discovery.joining import _contradiction, judge_beside_others, linearised
from ident.effects.effect import PlacedEffect
from ident.effects.friction import NonlinearViscous
from ident.effects.geometry_corrections import LatePosition
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth
from tests.ident.mistaken import small_recordings
from tests.ident.recordings import gathered, three_axes_truth

LATE = PlacedEffect(LatePosition(), 1)


def contradiction(value: float, std: float, fitted: float, placed: PlacedEffect = LATE) -> str:
    """What is said of one coefficient."""
    covariance = np.array([[std**2]])
    return _contradiction(placed, np.array([value]), np.array([fitted]), covariance)


@pytest.mark.parametrize(
    ("value_ms", "said"),
    [
        (0.3, "may all be zero"),  # nothing is left of it by instruments
        # A third of it is left: what the fit says is mostly the loop
        (1.3, "0.0013 s, not 0.0042"),
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
    variable = next(iter(Abscissa))
    unnamed = PlacedEffect(Smooth(variable), 1)
    count = len(unnamed.effect.coefficients)
    covariance = 9.0 * np.eye(count)
    fitted = np.full(count, 4.2)
    assert _contradiction(unnamed, np.full(count, 0.5), fitted, covariance) != ""


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


@pytest.mark.slow
@pytest.mark.parametrize(("delay_ms", "stays"), [(0.0, False), (0.1, False), (8.0, True)])
def test_a_delay_that_explains_little_must_be_far_from_zero(delay_ms: float, stays: bool) -> None:
    runs = []
    for run in small_recordings(three_axes_truth(), 3, noise_a=0.03):
        position = run.position_rad.copy()
        position[:, 1] = np.interp(run.time_s - 1e-3 * delay_ms, run.time_s, position[:, 1])
        runs.append(replace(run, position_rad=position))
    fitted = with_effects(gathered(three_axes_truth(), tuple(runs)), (LATE,))
    joint = linearised(fitted, ColumnCache())
    rng = np.random.default_rng(0)
    placed = fitted.effects[0]
    _, why = judge_beside_others(joint, placed, rng, Gates())
    assert ("it explains little, and is less than 5 σ from zero" in why) is not stays
