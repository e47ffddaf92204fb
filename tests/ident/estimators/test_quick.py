"""The quick linear estimate: exact without noise, that of maximum likelihood with it,
in any unit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System
from ident.estimators.least_squares import wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.quick import QuickGains, mixed_tls, quick_gains
from ident.model.bodies import Payload
from tests.ident.closed_recordings import recorded
from tests.ident.mechanisms import FIVE_BAR
from tests.ident.pieces import noisy_pieces
from tests.ident.recordings import CONDITIONING, GAINS, Truth

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])
"""For the arm of three axes."""


@pytest.fixture(scope="module")
def pieces(truth: Truth) -> tuple[Run, ...]:
    """Six short recordings of the arm of six axes, one pair of them coupled."""
    return noisy_pieces(truth, 8, count=6)


@pytest.fixture(scope="module")
def standard(truth: Truth, pieces: tuple[Run, ...]) -> System:
    """Their equations."""
    return reduce_runs(truth.model, pieces, CONDITIONING)


def test_recordings_without_noise_give_gains_and_parameters_back(
    truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    system = regrouped(reduce_runs(truth.model, clean_runs, CONDITIONING))
    gains, parameters = mixed_tls(system)
    assert gains == pytest.approx(GAINS, rel=2e-4)
    expected = system.base.grouping @ truth.parameters
    assert parameters[: len(expected)] == pytest.approx(expected, rel=1e-3, abs=2e-3)


@pytest.mark.slow
def test_a_closed_chain_with_a_motor_for_each_freedom_is_one_of_these_robots() -> None:
    made = recorded(FIVE_BAR)
    system = regrouped(reduce_runs(made.model, made.runs, made.conditioning))
    gains, _ = mixed_tls(system)
    assert gains == pytest.approx(FIVE_BAR.gains, rel=1e-6)


def test_it_is_maximum_likelihood_to_a_fiftieth_of_its_error_bar(standard: System) -> None:
    found = quick_gains(standard)
    likeliest = ml(regrouped(standard))
    assert found.gains is not None
    assert found.gains_std is not None
    gain_difference = np.abs(found.gains - likeliest.gains)
    assert np.max(gain_difference / likeliest.gains_std) < 0.02
    assert found.gains_std == pytest.approx(likeliest.gains_std, rel=0.05)
    assert found.std_percent == pytest.approx(100.0 * found.gains_std / np.abs(GAINS), rel=0.2)


def test_weighted_least_squares_makes_gains_too_small_where_it_does_not(standard: System) -> None:
    found = quick_gains(standard)
    assert found.gains is not None
    assert np.max(np.abs(found.gains / GAINS - 1.0)) < 0.04
    gains = wls(regrouped(standard)).gains
    assert np.max(gains / GAINS) < 0.95


@pytest.fixture(scope="module")
def small_pieces(small_truth: Truth) -> tuple[Run, ...]:
    """Short recordings of the arm of three axes."""
    return noisy_pieces(small_truth, 5)


@pytest.fixture(scope="module")
def small_gains(small_truth: Truth, small_pieces: tuple[Run, ...]) -> QuickGains:
    """Their gains."""
    return quick_gains(reduce_runs(small_truth.model, small_pieces, SMALL))


@pytest.mark.slow
@settings(deadline=None, max_examples=10)
@given(exponents=st.lists(st.integers(-4, 4), min_size=3, max_size=3), heavier=st.floats(0.1, 10.0))
def test_gains_are_in_the_units_of_currents_and_payload(
    small_truth: Truth,
    small_pieces: tuple[Run, ...],
    small_gains: QuickGains,
    exponents: list[int],
    heavier: float,
) -> None:
    """A current in other units divides its gain;
    a payload of other weight multiplies all of them.
    """
    unit = 10.0 ** np.array(exponents)
    before = small_gains
    changed = []
    for run in small_pieces:
        payload = run.payload
        if payload is not None:
            known = {"m": heavier * payload.known["m"]}
            payload = Payload(payload.name, payload.mounting, known)
        current_a = run.current_a * unit
        changed_run = replace(run, current_a=current_a, payload=payload)
        changed.append(changed_run)
    after = quick_gains(reduce_runs(small_truth.model, changed, SMALL))
    assert before.gains is not None
    assert before.gains_std is not None
    assert after.gains == pytest.approx(heavier * before.gains / unit, rel=1e-6)
    assert after.gains_std == pytest.approx(heavier * before.gains_std / unit, rel=1e-5)
