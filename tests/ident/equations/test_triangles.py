"""What is read off triangles: norms, deviations, least squares,
against the rows that they stand for.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from ident.arrays import FloatArray
from ident.equations.triangles import (
    Triangles,
    least_squares,
    singular_values,
    solve,
    triangle,
    triangle_of,
)

COLUMNS = 4
ROWS = (30, 50)
"""Rows of two axes."""


@pytest.fixture
def rows() -> tuple[FloatArray, ...]:
    rng = np.random.default_rng(11)
    return tuple(rng.normal(size=(count, COLUMNS)) for count in ROWS)


@pytest.fixture
def triangles(rows: tuple[FloatArray, ...]) -> Triangles:
    factors = tuple(triangle((own,), COLUMNS) for own in rows)
    return Triangles(factors, np.array(ROWS))


def test_the_squares_of_each_axis_are_those_of_its_rows(
    rows: tuple[FloatArray, ...], triangles: Triangles
) -> None:
    vector = np.array([1.0, -2.0, 0.5, 3.0])
    expected = [np.sum((own @ vector) ** 2) for own in rows]
    assert_allclose(triangles.square_sum(vector), expected, rtol=1e-12)


def test_the_deviation_of_a_residual_counts_rows_less_a_share_of_the_unknowns(
    rows: tuple[FloatArray, ...], triangles: Triangles
) -> None:
    vector = np.array([1.0, -2.0, 0.5, 3.0])
    expected = []
    for own, count in zip(rows, ROWS, strict=True):
        # Ten unknowns are shared by two axes.
        count_root = np.sqrt(count - 5.0)
        expected.append(np.linalg.norm(own @ vector) / count_root)
    assert_allclose(triangles.residual_std(vector, free=10), expected, rtol=1e-12)


def test_fewer_rows_than_unknowns_have_one_degree_of_freedom(triangles: Triangles) -> None:
    vector = np.ones(COLUMNS)
    std = triangles.residual_std(vector, free=70)
    # 30 rows less 35 unknowns are none, 50 less 35 are 15.
    expected = np.sqrt(triangles.square_sum(vector) / [1.0, 15.0])
    assert_allclose(std, expected, rtol=1e-12)


def test_the_deviation_of_random_rows_is_that_of_their_noise() -> None:
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(2000, 3))
    noise = 0.2 * rng.normal(size=2000)
    right = columns @ [1.0, 2.0, 3.0] + noise
    fitted = np.linalg.lstsq(columns, right, rcond=None)[0]
    both = np.column_stack((columns, right))
    factors = (triangle((both,), 4),)
    one_axis = Triangles(factors, np.array([2000]))
    vector = np.array([*-fitted, 1.0])
    std = one_axis.residual_std(vector, free=3)
    # Four times the standard error of a deviation, 0.2/√(2·2000).
    assert std[0] == pytest.approx(0.2, abs=0.013)


def test_stacked_axes_are_scaled_each_by_its_weight(triangles: Triangles) -> None:
    weight = np.array([2.0, 0.5])
    stacked = triangles.stacked(weight)
    first = len(triangles.factors[0])
    expected = 2.0 * triangles.factors[0]
    assert_allclose(stacked[:first], expected)
    assert_allclose(stacked[first:], 0.5 * triangles.factors[1])


def test_few_rows_stay_as_they_are() -> None:
    few = np.arange(6.0).reshape(2, 3)
    assert_allclose(triangle((few,), 3), few)
    assert triangle((), 3).shape == (0, 3)


@given(st.integers(1, 40), st.integers(0, 1000))
def test_a_triangle_of_columns_has_zeros_for_columns_without_entries(rows: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(5, rows))
    columns[[1, 4]] = 0.0
    factor = triangle_of(columns)
    expected = columns @ columns.T
    assert_allclose(factor.T @ factor, expected, atol=1e-12 * rows)
    assert not factor[:, [1, 4]].any()


def test_least_squares_has_the_solution_and_the_inverse_of_the_normal_equations() -> None:
    rng = np.random.default_rng(2)
    # Units as far apart as kg and kg m² of a wrist.
    matrix = rng.normal(size=(40, 3)) * [1.0, 1e-4, 1e3]
    right = rng.normal(size=40)
    solution, inverse = solve(matrix, right)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert_allclose(solution, expected, rtol=1e-7)
    inverse_expected = np.linalg.inv(matrix.T @ matrix)
    assert_allclose(inverse, inverse_expected, rtol=1e-7)


def test_a_column_of_zeros_gets_zero_and_leaves_the_others_alone() -> None:
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(40, 3))
    matrix[:, 1] = 0.0
    right = rng.normal(size=40)
    solution, inverse = solve(matrix, right)
    others = matrix[:, [0, 2]]
    expected = np.linalg.lstsq(others, right, rcond=None)[0]
    assert_allclose(solution[[0, 2]], expected, rtol=1e-12)
    assert solution[1] == 0.0
    inverse_expected = np.linalg.inv(others.T @ others)
    assert_allclose(inverse[np.ix_([0, 2], [0, 2])], inverse_expected, rtol=1e-12)


def test_of_two_equal_columns_each_gets_half() -> None:
    column = np.linspace(1.0, 2.0, 20)
    matrix = np.column_stack((column, column))
    solution, _ = solve(matrix, 6.0 * column)
    assert_allclose(solution, [3.0, 3.0], rtol=1e-9)


@example(rows=4, columns=3, spread=0.0, seed=1)
@example(rows=2, columns=1, spread=0.0, seed=1)
@given(
    rows=st.integers(1, 60),
    columns=st.integers(1, 8),
    spread=st.floats(0.0, 6.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_back_substitution_solves_as_singular_values_do(
    rows: int, columns: int, spread: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-spread, spread, size=columns)
    matrix = rng.normal(size=(rows, columns)) * units
    right = rng.normal(size=rows)
    expected, _ = solve(matrix, right)
    found = least_squares(matrix, right)
    largest = np.max(np.abs(expected * units))
    assert_allclose(found * units, expected * units, rtol=1e-9, atol=1e-9 * largest)


@pytest.mark.parametrize("difference", [0.0, 1e-13, 1e-11])
def test_back_substitution_leaves_nearly_equal_columns_to_singular_values(
    difference: float,
) -> None:
    rng = np.random.default_rng(6)
    matrix = rng.normal(size=(40, 3))
    matrix[:, 2] = matrix[:, 1] + difference * matrix[:, 2]
    right = rng.normal(size=40)
    expected, _ = solve(matrix, right)
    assert np.array_equal(least_squares(matrix, right), expected)
    matrix[:, 0] = 0.0
    expected, _ = solve(matrix, right)
    assert np.array_equal(least_squares(matrix, right), expected)


@given(rows=st.integers(5, 3000), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_triangle_of_many_rows_is_numpys_up_to_the_signs_of_its_rows(
    rows: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, COLUMNS))
    found = triangle((matrix,), COLUMNS)
    expected = np.linalg.qr(matrix, mode="r")
    diagonal_sign = np.sign(np.diag(found))
    expected_diagonal_sign = np.sign(np.diag(expected))
    signs = diagonal_sign * expected_diagonal_sign
    assert_allclose(signs[:, None] * found, expected, rtol=1e-9, atol=1e-9)


def test_singular_values_fall() -> None:
    matrix = np.diag([1.0, 3.0, 2.0])
    values = singular_values(matrix)
    assert_allclose(values, [3.0, 2.0, 1.0])
