"""Share of the choice of effects in σ:
against refits with a rival, and with an effect that stayed out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.choice import choice_covariance, is_small
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.search import Finding
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.friction import NonlinearViscous, Stribeck
from tests.ident.recordings import Truth, acting_on, bent, search_problem_of

FloatArray = NDArray[np.float64]
SPEED_RAD_S = 0.3
FOLDS = np.arange(8.0)


def _sticking(small: Evidence, truth: Truth, torque_nm: float) -> Evidence:
    """Joint 2 sticks at low speed."""

    def torque(data: Dataset) -> FloatArray:
        v = data.velocity_rad_s[:, 1]
        return acting_on(1, 3, torque_nm * np.sign(v) * np.exp(-np.abs(v) / SPEED_RAD_S))

    return bent(small, truth, torque)


@pytest.fixture(scope="module")
def sticking(small: Evidence, small_truth: Truth) -> Evidence:
    return _sticking(small, small_truth, 8.0)


def _finding(
    effect: Effect, ambiguity: tuple[PlacedEffect, ...] = (), fold_errors: FloatArray = FOLDS
) -> Finding:
    ones = np.ones(1)
    return Finding(
        effect, 1, ones, ones, 0.0, 1.0, 0.1, 5.0, 4.0, 0.2, 9.0, True, fold_errors, ambiguity
    )


@pytest.mark.parametrize(("lead", "weight"), [(0.0, 0.5), (-1e3, 0.0)])
def test_a_rival_adds_its_distance_by_its_odds(
    sticking: Evidence, lead: float, weight: float
) -> None:
    """Refits with either effect are that far apart;
    a rival that every fold refutes has no weight.
    """
    effect = Stribeck(SPEED_RAD_S)
    other = NonlinearViscous(1.0 / 3.0)
    joined, instead = (with_effects(sticking, (PlacedEffect(one, 1),)) for one in (effect, other))
    fold_errors = FOLDS - lead + 1e-3 * np.resize((-1.0, 1.0), 8)
    rival = _finding(other, fold_errors=fold_errors)
    ambiguity = (PlacedEffect(other, 1),)
    finding = _finding(effect, ambiguity)
    problem = search_problem_of(joined)
    accepted = ((finding, (rival,)),)
    added = choice_covariance(problem, joined.estimate, accepted, ())
    apart = instead.estimate.gains - joined.estimate.gains
    spread = np.sqrt(np.diag(added)[:3])
    largest_absolute_apart = np.abs(apart).max()
    assert spread == pytest.approx(
        np.sqrt(weight) * np.abs(apart), abs=0.1 * largest_absolute_apart
    )


def test_what_is_no_noise_but_too_small_adds_what_it_would_move(
    small: Evidence, small_truth: Truth
) -> None:
    """The declared model alone, although joint 2 sticks:
    refits without and with the effect are that far apart.
    """
    effect = Stribeck(SPEED_RAD_S)
    sticking = _sticking(small, small_truth, 2.0)
    effects = (PlacedEffect(effect, 1),)
    joined = with_effects(sticking, effects)
    problem = search_problem_of(sticking)
    errors = problem.folds.square_sum(problem.folds.residual).sum(axis=1)
    fold_errors = errors - 1e3 + FOLDS
    found = _finding(effect, fold_errors=fold_errors)
    diagonal = np.diag(choice_covariance(problem, sticking.estimate, (), (found,)))
    std = np.sqrt(diagonal[:3])
    gain_difference = joined.estimate.gains - sticking.estimate.gains
    apart = np.abs(gain_difference)
    assert std == pytest.approx(apart, abs=0.1 * apart.max())


def test_a_small_effect_is_possible_and_no_noise_and_fails_a_gate_of_size() -> None:
    found = _finding(Stribeck(SPEED_RAD_S))
    gates = Gates()
    assert not is_small(found, gates)
    for small in (
        replace(found, explained=0.01),
        replace(found, error_fall=0.01),
        replace(found, folds_better=0.5),
    ):
        assert is_small(small, gates)
        finding = replace(small, probability=0.02)
        assert not is_small(finding, gates)
        coefficients = np.array([-99.0])
        changed_small = replace(small, coefficients=coefficients)
        assert not is_small(changed_small, gates)


def test_an_effect_without_rivals_adds_nothing(sticking: Evidence) -> None:
    effect = Stribeck(SPEED_RAD_S)
    effects = (PlacedEffect(effect, 1),)
    joined = with_effects(sticking, effects)
    problem = search_problem_of(joined)
    accepted = ((_finding(effect), ()),)
    assert not choice_covariance(problem, joined.estimate, accepted, ()).any()
