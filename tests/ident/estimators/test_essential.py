"""Essential parameters: the procedure of §4.2, and what it must leave alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.equations.system import System
from ident.estimators.comparison import Essential, essential, relative_std_percent
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.least_squares import tls, wls
from ident.estimators.maximum_likelihood import ml
from tests.ident.recordings import GAINS

ESTIMATORS = (wls, tls, ml)


@pytest.fixture(scope="module")
def system(noisy_found: Identification) -> System:
    """System of noisy runs."""
    return noisy_found.system


def _robot_std_percent(found: Essential) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    robot = len(found.system.columns)
    return relative_std_percent(found.estimate.parameters, found.estimate.parameters_std)[:robot]


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("ratio", [10.0, 30.0])
def test_the_spread_of_what_stays_is_below_the_ratio(
    system: System, estimator: Callable[[System], Estimate], ratio: float
) -> None:
    found = essential(system, estimator, ratio)
    relative = _robot_std_percent(found)
    assert relative.max() < ratio * relative.min()
    assert len(found.removed) + len(found.system.columns) == len(system.columns) == 61
    assert len(found.estimate.gains) == 6
    payload = [column.name for column in found.system.unknowns if ":" in column.name]
    assert len(payload) == 9
    names = {column.name for column in found.system.columns} | {step.name for step in found.removed}
    expected = {column.name for column in system.columns}
    assert names == expected


def test_each_step_takes_the_worst_of_a_new_estimate(system: System) -> None:
    found = essential(system, wls, 20.0)
    current = system
    names = [column.name for column in system.columns]
    for step in found.removed[:5]:
        estimate = wls(current)
        relative = relative_std_percent(estimate.parameters, estimate.parameters_std)[: len(names)]
        worst = int(np.argmax(relative))
        assert step.name == names[worst]
        assert step.std_percent == pytest.approx(relative[worst])
        assert relative.max() >= 20.0 * relative.min()
        current = current.holding({worst: 0.0})
        del names[worst]


@pytest.mark.slow
def test_gains_hardly_change_and_the_error_hardly_grows(system: System) -> None:
    whole = ml(system)
    found = essential(system, ml, 30.0)
    assert len(found.removed) > 10
    assert found.estimate.gains == pytest.approx(whole.gains, rel=0.02)
    assert found.estimate.gains == pytest.approx(GAINS, rel=0.03)
    before = whole.relative_error(system).total
    after = found.estimate.relative_error(found.system).total
    assert before <= after < 1.05 * before


@pytest.mark.slow
def test_the_whole_estimate_holds_zeros_and_predicts_the_same(system: System) -> None:
    found = essential(system, tls, 20.0)
    removed = {step.name for step in found.removed}
    for column, value, std in zip(
        found.whole.unknowns, found.whole.parameters, found.whole.parameters_std, strict=True
    ):
        assert (value == 0.0 and std == 0.0) == (column.name in removed)
    assert found.whole.relative_error(system).axes == pytest.approx(
        found.estimate.relative_error(found.system).axes
    )


@given(st.lists(st.integers(0, 60), min_size=1, max_size=8, unique=True), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_parameters_held_where_they_were_found_change_nothing(
    system: System, held: list[int], seed: int
) -> None:
    """W χ with some of χ given is the same torque, at joints, motors and moves alike."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=len(system.unknowns))
    gains = rng.normal(size=6)
    rest = system.holding({index: float(values[index]) for index in held})
    left = np.delete(values, held)
    expected = [c.name for i, c in enumerate(system.unknowns) if i not in held]
    assert [c.name for c in rest.unknowns] == expected
    stacked_gains = np.concatenate((gains, values, [1.0]))
    one = system.joints.square_sum(stacked_gains)
    assert rest.joints.square_sum(np.concatenate((gains, left, [1.0]))) == pytest.approx(
        one, rel=1e-8
    )
    one = system.motors.square_sum(np.concatenate(([1.0], values, [1.0])))
    assert rest.motors.square_sum(np.concatenate(([1.0], left, [1.0]))) == pytest.approx(
        one, rel=1e-8
    )
    for before, after in zip(system.clusters[:3], rest.clusters[:3], strict=True):
        for rows, others in zip(before, after, strict=True):
            assert others @ np.concatenate(([1.0], left, [1.0])) == pytest.approx(
                rows @ np.concatenate(([1.0], values, [1.0])), rel=1e-8, abs=1e-8
            )


def test_a_ratio_that_leaves_nothing_is_refused(system: System) -> None:
    with pytest.raises(ValueError, match="above 1"):
        essential(system, wls, 1.0)


def test_a_parameter_of_zero_is_infinitely_uncertain() -> None:
    std = np.array([1.0, 1.0, 1.0])
    expected = [np.inf, 50.0, 50.0]
    assert relative_std_percent(np.array([0.0, 2.0, -2.0]), std).tolist() == expected
