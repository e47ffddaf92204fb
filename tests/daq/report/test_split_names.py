"""Names that splits of the data choose for one residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.report.split_names import names_by_split
from ident.discovery.evidence import Evidence
from ident.discovery.loop import Step
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.friction import LoadFriction
from ident.effects.position import Spring
from ident.effects.transmission import Efficiency
from tests.daq.report.test_residual_report import finding

FOLDS = 8
SPRING = PlacedEffect(Spring(), 2)
FRICTION = PlacedEffect(LoadFriction(0), 2)
LOSS = PlacedEffect(Efficiency(0.0), 2)


def _found(placed: PlacedEffect, squares: NDArray[np.float64], *rivals: PlacedEffect) -> Finding:
    return replace(finding(placed, rivals=rivals), fold_errors=squares)


def _turn(evidence: Evidence, added: Finding | None, *others: Finding) -> Step:
    findings = others if added is None else (added, *others)
    limits_nm = np.ones(3)
    return Step(findings, (), limits_nm, added, evidence)


@pytest.fixture
def evidence() -> Evidence:
    """No part of it is read: the findings have all that counts."""
    return object.__new__(Evidence)


def test_one_name_where_the_added_effect_is_best_without_each_fold(evidence: Evidence) -> None:
    squares = np.ones(FOLDS)
    added = _found(FRICTION, squares, LOSS)
    step = _turn(evidence, added, _found(LOSS, np.full(FOLDS, 1.2)))
    (only,) = names_by_split(step)
    assert only.placed == FRICTION
    assert only.splits == FOLDS
    assert only.of == FOLDS


def test_two_names_where_one_fold_decides(evidence: Evidence) -> None:
    """The loss is worse on the first fold alone: without it, it is clearly the better name."""
    grid = np.linspace(0.0, 0.01, FOLDS)
    squares = np.full(FOLDS, 0.95) + grid
    squares[0] = 1.8
    added = _found(FRICTION, np.ones(FOLDS), LOSS)
    step = _turn(evidence, added, _found(LOSS, squares))
    first, second = names_by_split(step)
    expected = (FRICTION, FOLDS - 1)
    assert (first.placed, first.splits) == expected
    assert (second.placed, second.splits) == (LOSS, 1)


def test_one_name_where_another_is_better_by_no_more_than_chance(evidence: Evidence) -> None:
    """The simplest name of equals was added: a hinge from beyond the joint's range is a spring."""
    squares = 0.99 + 0.1 * np.resize([-1.0, 1.0], FOLDS)
    added = _found(FRICTION, np.ones(FOLDS), LOSS)
    step = _turn(evidence, added, _found(LOSS, squares))
    (only,) = names_by_split(step)
    assert only.placed == FRICTION


def test_a_candidate_that_explains_something_else_is_no_name(evidence: Evidence) -> None:
    """A spring that stays beside the friction is another effect, however much it explains."""
    squares = np.ones(FOLDS)
    added = _found(FRICTION, squares, LOSS)
    step = _turn(evidence, added, _found(SPRING, np.full(FOLDS, 0.1)))
    names = names_by_split(step)
    assert [name.placed for name in names] == [FRICTION]


def test_a_candidate_that_failed_a_gate_is_no_name(evidence: Evidence) -> None:
    squares = np.ones(FOLDS)
    added = _found(FRICTION, squares, LOSS)
    failed = replace(_found(LOSS, np.full(FOLDS, 0.1)), passed=False)
    step = _turn(evidence, added, failed)
    assert [name.placed for name in names_by_split(step)] == [FRICTION]


def test_no_name_where_nothing_was_added(evidence: Evidence) -> None:
    squares = np.ones(FOLDS)
    step = _turn(evidence, None, _found(LOSS, squares))
    assert names_by_split(step) == ()


@given(
    st.lists(st.tuples(st.floats(0.0, 9.0), st.floats(0.0, 9.0)), min_size=FOLDS, max_size=FOLDS)
)
def test_each_split_chooses_one_name(pairs: list[tuple[float, float]]) -> None:
    squares = np.array(pairs).T
    added = _found(FRICTION, squares[0], LOSS)
    step = _turn(object.__new__(Evidence), added, _found(LOSS, squares[1]))
    names = names_by_split(step)
    assert sum(name.splits for name in names) == FOLDS
    expected = sorted(names, key=lambda name: -name.splits)
    assert list(names) == expected
    if np.all(squares[0] <= squares[1]):
        assert [name.placed for name in names] == [FRICTION]
