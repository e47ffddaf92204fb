"""Settings between those of the dictionary, parsimony,
and effects that a later one has made idle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.discovery.search import Finding, choose_effect, rank_effects, refine_setting
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.electrical import Cogging
from ident.effects.friction import AsymmetricViscous, Stribeck, WarmUp
from ident.effects.position import Hinge, Spring
from tests.ident.recordings import Truth, acting_on, bent, search_problem_of

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
GATES = Gates(draws=199)


def _needing(small: Evidence, truth: Truth, torque: Callable[[Dataset], FloatArray]) -> Evidence:
    return bent(small, truth, lambda data: acting_on(1, 3, torque(data)))


def _low_speed(data: Dataset, speed_rad_s: float = 0.17) -> FloatArray:
    v = data.velocity_rad_s[:, 1]
    return np.asarray(20.0 * np.sign(v) * np.exp(-np.abs(v) / speed_rad_s))


def test_a_setting_between_two_of_the_dictionary_is_found(
    small: Evidence, small_truth: Truth
) -> None:
    evidence = _needing(small, small_truth, _low_speed)
    search_problem = search_problem_of(evidence)
    families = (EFFECTS[0],)
    rng = np.random.default_rng(0)
    best = rank_effects(search_problem, rng, GATES, families)[0]
    effect = refine_setting(search_problem, best.effect, best.axis, families)
    assert isinstance(effect, Stribeck)
    assert best.axis == 1
    assert effect.speed_rad_s == pytest.approx(0.17, rel=0.1)
    assert effect not in EFFECTS[0]


@pytest.mark.parametrize(
    "effect",
    [Spring(), Cogging(3), Stribeck(0.05), Stribeck(0.5), Stribeck(0.123), WarmUp(20.0, 0)],
)
def test_a_whole_signed_or_outermost_setting_stays(small: Evidence, effect: Effect) -> None:
    assert refine_setting(search_problem_of(small), effect, 1, EFFECTS) == effect


def test_an_effect_that_a_later_one_makes_idle_is_taken_out(
    small: Evidence, small_truth: Truth
) -> None:
    bare = _needing(small, small_truth, _low_speed)
    placed_effect = PlacedEffect(AsymmetricViscous(), 1)
    effects = (placed_effect, PlacedEffect(AsymmetricViscous(), 2))
    start = with_effects(bare, effects)
    rng = np.random.default_rng(0)
    last_effect = find_effects(start, rng, GATES)[-1]
    last = last_effect.after
    assert [(placed.effect.name, placed.axis) for placed in last.effects] == [("stribeck", 1)]


def test_an_effect_that_is_still_needed_stays(small: Evidence, small_truth: Truth) -> None:
    start = _needing(
        small, small_truth, lambda data: _low_speed(data) + 9.0 * data.position_rad[:, 1]
    )
    rng = np.random.default_rng(0)
    effects = find_effects(start, rng, GATES)
    last = effects[-1].after
    expected = {("stribeck", 1), ("spring", 1)}
    assert {(placed.effect.name, placed.axis) for placed in last.effects} == expected


def _finding(effect: Effect, fall: float, axis: int = 1, *, passed: bool = True) -> Finding:
    coefficients = np.ones(len(effect.coefficients))
    deviations = np.ones(len(effect.coefficients))
    fold_errors = np.ones(8)
    return Finding(
        effect=effect,
        axis=axis,
        coefficients=coefficients,
        deviations=deviations,
        probability=0.001,
        folds_better=1.0,
        explained=0.2,
        error_before_percent=5.0,
        error_after_percent=4.0,
        error_fall=0.2,
        left_out_fall=fall,
        passed=passed,
        fold_errors=fold_errors,
    )


HINGE = Hinge(-2.5, 1)
SPRING = Spring()


@pytest.mark.parametrize(
    ("findings", "name"),
    [
        ([_finding(HINGE, 100.0), _finding(SPRING, 99.5)], "spring"),
        ([_finding(HINGE, 100.0), _finding(SPRING, 90.0)], "hinge"),
        ([_finding(HINGE, 100.0), _finding(SPRING, 99.5, axis=2)], "hinge"),
        ([_finding(HINGE, 100.0), _finding(SPRING, 99.5, passed=False)], "hinge"),
        ([_finding(HINGE, 100.0, passed=False), _finding(SPRING, 99.5)], "spring"),
    ],
)
def test_of_two_that_explain_alike_the_simpler_is_chosen(
    findings: list[Finding], name: str
) -> None:
    chosen = choose_effect(findings)
    assert chosen is not None
    assert chosen.effect.name == name


def test_where_nothing_passed_nothing_is_chosen() -> None:
    assert choose_effect([]) is None
    findings = [_finding(SPRING, 10.0, passed=False)]
    assert choose_effect(findings) is None
