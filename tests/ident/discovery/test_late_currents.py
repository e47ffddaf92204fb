"""Rates of torque, the delays of all currents at once, and the size that a delay has in a fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.evidence import Evidence, coefficients_of
from ident.discovery.late_currents import (
    LateCurrents,
    find_late_currents,
    rough_torque_rates,
    torque_rates,
    try_delays,
    with_delays,
)
from ident.effects.effect import PlacedEffect
from ident.effects.electrical import Lag, TimeSkew
from tests.ident.mistaken import small_recordings
from tests.ident.recordings import gathered, search_problem_of, three_axes_truth

FloatArray = NDArray[np.float64]


@cache
def _late(*delays_ms: float) -> Evidence:
    runs = []
    for run in small_recordings(three_axes_truth(), 3, noise_a=0.03):
        columns = zip(run.current_a.T, delays_ms, strict=True)
        late = [
            np.interp(run.time_s - 1e-3 * delay_ms, run.time_s, current)
            for current, delay_ms in columns
        ]
        current_a = np.stack(late, axis=1)
        runs.append(replace(run, current_a=current_a))
    return gathered(three_axes_truth(), tuple(runs))


def _found(*delays_ms: float) -> LateCurrents | None:
    evidence = _late(*delays_ms)
    problem = search_problem_of(evidence)
    rates = torque_rates(evidence)
    tested = try_delays(problem, rates)
    return find_late_currents(problem, tested, rates)


def test_differences_of_rows_are_nearly_the_rate_of_torque() -> None:
    evidence = _late(0.0, 0.0, 0.0)
    use = evidence.training.motor_use
    rough = rough_torque_rates(evidence)[use]
    exact = torque_rates(evidence)[use]
    rough_norm = np.linalg.norm(rough)
    exact_norm = np.linalg.norm(exact)
    cosine = float(rough @ exact) / float(rough_norm * exact_norm)
    assert cosine > 0.9


def test_currents_that_are_not_late_are_not_named() -> None:
    found = _found(0.0, 0.0, 0.0)
    assert found is None or isinstance(found.effects[0].effect, TimeSkew)
    if found is not None:  # a common delay that may be zero
        assert abs(found.seconds[0]) < 3e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delays_ms", "effects"),
    [
        ((4.0, 4.0, 4.0), (PlacedEffect(TimeSkew(), 0),)),
        ((-4.0, -4.0, -4.0), (PlacedEffect(TimeSkew(), 0),)),
        ((4.0, 4.0, 0.0), (PlacedEffect(Lag(), 0), PlacedEffect(Lag(), 1))),
        ((4.0, -4.0, 0.0), (PlacedEffect(Lag(), 0), PlacedEffect(Lag(), 1))),
        ((0.0, 0.0, 5.0), (PlacedEffect(Lag(), 2),)),
    ],
)
def test_delays_are_common_or_those_of_the_late_axes(
    delays_ms: tuple[float, float, float], effects: tuple[PlacedEffect, ...]
) -> None:
    found = _found(*delays_ms)
    assert found is not None
    assert found.effects == effects
    for placed, seconds in zip(found.effects, found.seconds, strict=True):
        assert seconds == pytest.approx(1e-3 * delays_ms[placed.axis], abs=6e-4)


def test_one_current_that_is_left_to_test_is_no_common_delay() -> None:
    """The model has a lag of the other two already:
    nothing says that they are late by the same time.
    """
    evidence = _late(4.0, 4.0, 4.0)
    problem = search_problem_of(evidence)
    rates = torque_rates(evidence)
    left = [
        one
        for one in try_delays(problem, rates)
        if one.axis == 2 or isinstance(one.members[0][0], TimeSkew)
    ]
    found = find_late_currents(problem, left, rates)
    assert found is None or PlacedEffect(TimeSkew(), 0) not in found.effects


@pytest.mark.slow
@pytest.mark.parametrize("delay_ms", [8.0, -8.0])
def test_a_long_delay_has_its_size_in_the_fit(delay_ms: float) -> None:
    """Without its filter, jumps of the torque shorten it."""
    evidence = _late(0.0, delay_ms, 0.0)
    effects = (PlacedEffect(Lag(), 1),)
    fitted = with_delays(evidence, effects, np.array([7e-4 * delay_ms]))
    (placed,) = fitted.effects
    seconds, std = coefficients_of(fitted.estimate, placed)
    absolute_second = abs(seconds[0] - 1e-3 * delay_ms)
    assert absolute_second < 3.0 * std[0] < 1e-3
    expected = int(delay_ms < 0.0)
    assert placed.effect.settings["backwards"] == expected
    filter_s = placed.effect.settings["filter_s"]
    assert filter_s == pytest.approx(5e-4 * abs(delay_ms), rel=0.1)
