"""The dry-friction solver against its own conditions and against another solver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from drivers.simulation.dynamics import DEPENDENT, MAX_SWEEPS, TOLERANCE_RAD_S, solve


def problem(seed: int, joints: int, extra: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """W, free speeds and bounds of `joints` joints and `extra` directions that depend on them."""
    rng = np.random.default_rng(seed)
    # Inertias of condition up to 1e6, turned any way: far worse than an arm's.
    turn, _ = np.linalg.qr(rng.standard_normal((joints, joints)))
    factor = turn * 10.0 ** rng.uniform(-1.5, 1.5, joints)
    directions = np.vstack(
        [np.eye(joints), rng.integers(-1, 2, (extra, joints)) + np.eye(joints)[:extra] * 3.0]
    )
    inverse = np.linalg.inv(factor @ factor.T)
    delassus = directions @ inverse @ directions.T
    free = directions @ rng.standard_normal(joints)
    return (
        delassus,
        free,
        np.abs(rng.standard_normal(len(directions))) * rng.integers(0, 2, len(directions)),
    )


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), extra=st.integers(0, 2))
@settings(max_examples=150, deadline=None)
def test_solution_meets_its_conditions_and_only_dissipates(
    seed: int, joints: int, extra: int
) -> None:
    smallest_extra = min(extra, joints)
    delassus, free, bound = problem(seed, joints, smallest_extra)
    impulse = np.zeros(len(free))
    certificate = solve(delassus, free, bound, impulse, TOLERANCE_RAD_S, MAX_SWEEPS, DEPENDENT)
    speed = free + delassus @ impulse
    assert certificate <= TOLERANCE_RAD_S
    assert (np.abs(impulse) <= bound).all()
    inside = np.abs(impulse) < bound
    absolute_speed = np.abs(speed[inside])
    assert (absolute_speed <= 2 * TOLERANCE_RAD_S).all()
    assert (speed[~inside] * impulse[~inside] <= 2 * TOLERANCE_RAD_S * bound[~inside]).all()
    # Friction takes energy: ½ wᵀ W⁺ w falls by −λᵀ(w + w_free)/2.
    assert impulse @ (speed + free) <= 1e-9


@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6))
@settings(max_examples=60, deadline=None)
def test_solution_agrees_with_bounded_least_squares(seed: int, joints: int) -> None:
    delassus, free, bound = problem(seed, joints, 0)
    bound += 0.01
    impulse = np.zeros(joints)
    solve(delassus, free, bound, impulse, TOLERANCE_RAD_S, MAX_SWEEPS, DEPENDENT)
    lower = np.linalg.cholesky(delassus)
    # min ½ λᵀ W λ + w_freeᵀ λ = min ½ ‖Lᵀ λ + L⁻¹ w_free‖² up to a constant.
    box = (-bound, bound)
    other = lsq_linear(
        lower.T, -np.linalg.solve(lower, free), bounds=box, method="bvls", tol=1e-14, max_iter=1000
    )
    assert other.success
    np.testing.assert_allclose(impulse, other.x, atol=1e-6)


def test_the_start_value_does_not_change_the_speeds() -> None:
    delassus, free, bound = problem(7, 5, 2)
    cold = np.zeros(7)
    warm = np.full(7, 3.0)
    solve(delassus, free, bound, cold, TOLERANCE_RAD_S, MAX_SWEEPS, DEPENDENT)
    solve(delassus, free, bound, warm, TOLERANCE_RAD_S, MAX_SWEEPS, DEPENDENT)
    np.testing.assert_allclose(delassus @ cold, delassus @ warm, atol=1e-8)


def test_an_unfinished_solution_says_so() -> None:
    delassus = np.array([[1.0, 0.999], [0.999, 1.0]])
    free = np.array([1.0, -1.0])
    impulse = np.zeros(2)
    bound = np.full(2, 1e6)
    assert solve(delassus, free, bound, impulse, TOLERANCE_RAD_S, 3, DEPENDENT) > TOLERANCE_RAD_S


def test_known_case() -> None:
    impulse = np.zeros(1)
    delassus = np.array([[2.0]])
    bound = np.array([1.0])
    solve(
        delassus,
        np.array([3.0]),
        bound,
        impulse,
        TOLERANCE_RAD_S,
        MAX_SWEEPS,
        DEPENDENT,
    )
    assert impulse[0] == pytest.approx(-1.0)  # slides: 3 − 2·1 > 0
    free = np.array([3.0])
    solve(
        np.array([[2.0]]),
        free,
        np.array([9.0]),
        impulse,
        TOLERANCE_RAD_S,
        MAX_SWEEPS,
        DEPENDENT,
    )
    assert impulse[0] == pytest.approx(-1.5)  # sticks: exactly what stops it
