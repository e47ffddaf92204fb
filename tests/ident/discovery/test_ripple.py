"""Ripple of an order that no list holds:
found against motor and joint angle, and not found in noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery import loop
from ident.discovery.evidence import Evidence
from ident.discovery.gates import Gates
from ident.discovery.joining import SetAside
from ident.discovery.loop import find_effects
from ident.discovery.ripple import Periodogram, _fast_length, periodogram, propose_orders
from ident.discovery.search import Finding
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.electrical import Cogging
from ident.effects.transmission import Ripple
from tests.ident.recordings import (
    MOUNTED,
    Truth,
    acting_on,
    bent,
    gathered,
    record,
    search_problem_of,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
GATES = Gates(draws=199)
RIPPLES = tuple(family for family in EFFECTS if isinstance(family[0], Ripple | Cogging))


def _rippling(small: Evidence, truth: Truth, axis: int, order: float, size_nm: float) -> Evidence:
    ratio = truth.model.drive_train.ratio[axis, axis]

    def torque(data: Dataset) -> FloatArray:
        torque_nm = size_nm * np.cos(order * ratio * data.position_rad[:, axis] - 0.8)
        return acting_on(axis, 3, torque_nm)

    return bent(small, truth, torque)


@pytest.mark.parametrize(
    ("axis", "order"),
    [(0, 0.37), pytest.param(2, 37.0 / 45.0, id="37-of-the-joint")],
)
def test_an_order_between_the_whole_ones_is_named(
    small: Evidence, small_truth: Truth, axis: int, order: float
) -> None:
    start = _rippling(small, small_truth, axis, order, 4.0)
    rng = np.random.default_rng(0)
    effects = find_effects(start, rng, GATES, RIPPLES, geometry=())
    last = effects[-1].after
    ((placed, effect),) = [(placed.axis, placed.effect) for placed in last.effects]
    assert isinstance(effect, Ripple)
    assert placed == axis
    # A line is one period over the range wide; it is found to a tenth of that.
    position_rad = [data.position_rad[:, axis] for data in small.datasets]
    stacked_position_rad = np.concatenate(position_rad)
    range_rev = np.ptp(stacked_position_rad) / (2.0 * np.pi)
    order_error = abs(effect.order - order)
    assert order_error * 40.0 * range_rev < 0.1
    found = last.estimate.parameters[len(last.rows_without_effects.columns) :][:2]
    assert np.hypot(*found) == pytest.approx(4.0, rel=0.1)


def test_an_order_that_may_not_join_is_tried_once(
    small: Evidence, small_truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refined before it is refused, and must not be chosen again with the order that it had
    before.
    """
    refused: list[Finding] = []

    def refuse(model: object, found: Finding, *_: object) -> SetAside:
        refused.append(found)
        assert len(refused) < 5
        return SetAside(found, "refused")

    monkeypatch.setattr(loop, "join", refuse)
    (step,) = find_effects(
        _rippling(small, small_truth, 0, 0.37, 4.0),
        np.random.default_rng(0),
        GATES,
        RIPPLES,
        geometry=(),
    )
    assert step.accepted is None
    assert len(refused) == len(step.set_aside)


def test_noise_proposes_no_order(small: Evidence) -> None:
    """Correlated noise of a size that differs from move to move; 15 draws of one per cent each."""
    rng = np.random.default_rng(8)
    problem = search_problem_of(small)
    folds = problem.folds
    alarms = 0
    for _ in range(15):
        size = rng.uniform(0.2, 2.0, folds.linearisation.cluster_count)[folds.linearisation.cluster]
        noise = size * np.convolve(rng.normal(size=len(size)), (0.6, 1.0, 0.6), "same")
        linearisation = replace(folds.linearisation, residual=noise)
        changed_fold = replace(folds, linearisation=linearisation)
        drawn = replace(
            problem,
            folds=changed_fold,
        )
        alarms += bool(propose_orders(drawn, (), rng, GATES))
    assert alarms <= 1


def test_an_order_in_the_model_or_next_to_one_is_not_proposed_again(
    small: Evidence, small_truth: Truth
) -> None:
    evidence = _rippling(small, small_truth, 1, 2.6, 4.0)
    problem = search_problem_of(evidence)
    rng = np.random.default_rng(0)
    (family,) = propose_orders(problem, (), rng, GATES)[1]
    nearest: Effect = min(family, key=lambda member: abs(member.settings["order"] - 2.6))
    assert nearest.settings["order"] == pytest.approx(2.6, abs=0.01)
    effects = (PlacedEffect(nearest, 1),)
    assert propose_orders(problem, effects, rng, GATES) == {}


def test_the_transform_is_the_sum_over_the_rows_of_each_move(small_truth: Truth) -> None:
    rng = np.random.default_rng(3)
    runs = tuple(
        record(small_truth, name, rng, payload, noise_a=0.3, averaged=1)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    )
    problem = search_problem_of(gathered(small_truth, runs))
    made = periodogram(problem, 1, 0)
    assert made is not None
    chosen = len(made.orders) // 10
    order = float(made.orders[chosen])
    columns = problem.torque(Ripple(order), 1)
    folds = problem.folds
    changed_linearisation = replace(folds.linearisation, scatter=None)
    to_motor = problem.model.drive_train.to_motor
    slow = (
        # Decorrelation of the runs is on the residual's side here; summed over moves it is the
        # same.
        changed_linearisation.whitened(columns, to_motor)
        * folds.linearisation.decorrelated(folds.linearisation.residual)[:, None]
    )
    by_move = np.stack([np.bincount(folds.linearisation.cluster, part) for part in slow.T])
    # The transform counts its angle from another origin.
    assert np.hypot(*made.scores[:, :, chosen]) == pytest.approx(
        np.hypot(*by_move), rel=0.02, abs=0.01 * by_move.max()
    )


def test_signs_leave_the_noise_as_it_is() -> None:
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(2, 40, 5))
    orders = np.arange(5.0)
    made = Periodogram(0, 0, 3.0, orders, scores)
    signs = np.ones((1, 40))
    same = made.statistic(signs)
    assert made.statistic(-np.ones((1, 40))) == pytest.approx(same)
    assert np.mean(made.statistic(rng.choice((-1.0, 1.0), (500, 40)))) == pytest.approx(
        2.0, rel=0.1
    )


@pytest.mark.parametrize(("least", "length"), [(16.0, 16), (1499.5, 1536), (19997.0, 20480)])
def test_bins_have_a_length_of_small_factors(least: float, length: int) -> None:
    assert _fast_length(least) == length
