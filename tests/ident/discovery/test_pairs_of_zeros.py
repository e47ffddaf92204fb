"""Zeros of two joints that hide each other, planted into recordings of an arm with an elbow."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ident.data.run import Run
from ident.discovery.gates import Gates
from ident.discovery.geometry_check import check_geometry
from ident.effects.geometry_corrections import ZeroOffset
from tests.ident.recordings import MOUNTED, gathered, record, tx40_truth

pytestmark = pytest.mark.slow

OPPOSITE_RAD = np.array([0.0, 1.0, -1.0, 0.0, 0.0, 0.0]) * np.radians(5.0)
GATES = Gates(draws=199)


@cache
def _runs() -> tuple[Run, ...]:
    rng = np.random.default_rng(12)
    return tuple(
        record(
            tx40_truth(),
            f"run {number}",
            rng,
            seconds=20.0,
            rate_hz=200.0,
            noise_a=0.03,
            payload=payload,
        )
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED))
    )


def test_two_zeros_that_hide_each_other_are_both_named_with_their_sizes() -> None:
    """None of the two passes alone: only the upper arm is turned."""
    runs = tuple(replace(run, position_rad=run.position_rad + OPPOSITE_RAD) for run in _runs())
    evidence = gathered(tx40_truth(), runs)
    rng = np.random.default_rng(0)
    mistakes = check_geometry(evidence, rng, GATES).mistakes
    found = {one.axis: one for one in mistakes}
    assert set(found) == {1, 2}
    for axis, one in found.items():
        assert isinstance(one.effect, ZeroOffset)
        absolute_coefficient = abs(one.coefficients[0] + OPPOSITE_RAD[axis])
        assert absolute_coefficient < 3.0 * one.deviations[0] < np.radians(2.0)


def test_right_zeros_make_no_pair() -> None:
    evidence = gathered(tx40_truth(), _runs())
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    assert check.mistakes == ()
