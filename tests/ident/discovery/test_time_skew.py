"""A time skew counts only where instruments confirm it:
least squares find one in recordings without any.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.run import Run
from ident.discovery import evidence as evidence_module
from ident.discovery.evidence import Evidence, gather, with_effects
from ident.discovery.time_skew import time_skew
from ident.effects.effect import PlacedEffect
from ident.effects.electrical import TimeSkew
from ident.estimators.identify import identify
from tests.ident.loops import record_in_loop
from tests.ident.recordings import CONDITIONING, MOUNTED, Truth
from tests.studies.skew_study import late

THREE = replace(CONDITIONING, standstill_rad_s=(0.03,) * 3)


@pytest.fixture(scope="module")
def disturbed(small_truth: Truth) -> tuple[Run, ...]:
    """Two runs without a skew, of an arm that torques disturb inside its position loops."""
    rng = np.random.default_rng(11)
    return tuple(
        record_in_loop(small_truth, name, rng, payload, disturbance_nm=3.0, seconds=20.0)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    )


def _fitted(truth: Truth, runs: tuple[Run, ...]) -> Evidence:
    return gather(identify(truth.model, runs, THREE, keep_rows=True))


@pytest.mark.slow
def test_least_squares_find_a_skew_in_the_loop_that_instruments_do_not_confirm(
    small_truth: Truth, disturbed: tuple[Run, ...]
) -> None:
    found = time_skew(_fitted(small_truth, disturbed))
    assert found is not None
    assert abs(found.fit_seconds) > 2.0 * found.fit_std
    assert abs(found.seconds) < 3.0 * found.std
    assert not found.confirmed
    assert not found.is_in_model


@pytest.mark.slow
@pytest.mark.parametrize("planted_s", [0.008, -0.008])
def test_a_planted_skew_is_confirmed_with_its_value_and_sign(
    small_truth: Truth, disturbed: tuple[Run, ...], planted_s: float
) -> None:
    runs = tuple(late(run, planted_s) for run in disturbed)
    evidence = _fitted(small_truth, runs)
    found = time_skew(evidence)
    assert found is not None
    assert found.confirmed
    assert found.seconds == pytest.approx(planted_s, abs=3.0 * found.std)
    assert 5.0 * found.std < abs(planted_s)
    # Once it is in the model, the value is that of the model, with the filter that it has there.
    filter_s = 0.5 * abs(planted_s)
    backwards = int(planted_s < 0.0)
    setting = TimeSkew(filter_s=filter_s, backwards=backwards)
    effects = (PlacedEffect(setting, 0),)
    accepted = time_skew(with_effects(evidence, effects))
    assert accepted is not None
    assert accepted.is_in_model
    assert accepted.seconds == pytest.approx(found.seconds, abs=0.5 * found.std)


def test_without_instruments_a_skew_is_not_known(
    small_truth: Truth, disturbed: tuple[Run, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence_module, "with_demand", lambda data, *_: data)
    evidence = _fitted(small_truth, disturbed)
    assert time_skew(evidence) is None
