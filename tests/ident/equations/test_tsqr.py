"""The triangle of streamed rows against the QR of the whole matrix."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.equations.triangles import BLOCK_ROWS, qr_update
from tests.bench.torque_fit import qr_merge

FloatArray = NDArray[np.float64]


def _gram_error(triangle: FloatArray, matrix: FloatArray) -> float:
    """max |(RᵀR − AᵀA)_ij| / (‖a_i‖ ‖a_j‖):
    relative to the columns, however differently they are scaled.
    """
    norms = np.linalg.norm(matrix, axis=0)
    norms[norms == 0.0] = 1.0
    unit = matrix / norms
    found = triangle / norms
    return float(np.max(np.abs(found.T @ found - unit.T @ unit), initial=0.0))


def _streamed(matrix: FloatArray, cuts: list[int]) -> FloatArray:
    triangle = None
    for first, last in pairwise([0, *sorted(cuts), len(matrix)]):
        columns = np.ascontiguousarray(matrix[first:last].T)
        triangle = qr_update(triangle, columns)
    assert triangle is not None
    return triangle


@st.composite
def _matrices(draw: st.DrawFn) -> FloatArray:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows = draw(st.integers(0, 120))
    count = draw(st.integers(1, 30))
    matrix = rng.normal(size=(rows, count)) * 10.0 ** rng.integers(-6, 7, count)
    for column in draw(st.lists(st.integers(0, count - 1), max_size=3)):
        matrix[:, column] = 0.0
    for column in draw(st.lists(st.integers(0, count - 1), max_size=3)):
        matrix[:, column] = matrix[:, (column + 1) % count]
    return np.asarray(matrix)


@settings(deadline=None, max_examples=150)
@given(_matrices(), st.data())
def test_any_cutting_gives_the_triangle_of_the_whole(
    matrix: FloatArray, data: st.DataObject
) -> None:
    cuts = data.draw(st.lists(st.integers(0, len(matrix)), max_size=6))
    triangle = _streamed(matrix, cuts)
    count = matrix.shape[1]
    assert triangle.shape == (count, count)
    assert np.all(np.tril(triangle, -1) == 0.0)
    assert _gram_error(triangle, matrix) < 1e-12


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(40, 300), st.integers(1, 90))
def test_equals_numpy_up_to_the_signs_of_rows(seed: int, count: int, rows: int, chunk: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows + count, count))
    expected = np.linalg.qr(matrix, mode="r")
    cuts = list(range(chunk, len(matrix), chunk))
    found = _streamed(matrix, cuts)
    diagonal_sign = np.sign(np.diag(found))
    expected_diagonal_sign = np.sign(np.diag(expected))
    signs = diagonal_sign * expected_diagonal_sign
    matrix_condition = np.linalg.cond(matrix)
    matrix_norm = np.linalg.norm(matrix)
    bound = 1e-12 * matrix_condition * matrix_norm
    absolute_expected = np.abs(signs[:, None] * found - expected)
    assert np.max(absolute_expected) < bound


def test_blocks_inside_one_call_do_not_show() -> None:
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(2 * BLOCK_ROWS + 17, 9))
    expected = np.linalg.qr(matrix, mode="r")
    columns = np.ascontiguousarray(matrix.T)
    found = qr_update(None, columns)
    absolute_diagonal = np.abs(np.diag(found))
    absolute_expected_diagonal = np.abs(np.diag(expected))
    assert absolute_diagonal == pytest.approx(absolute_expected_diagonal, rel=1e-12)
    assert _gram_error(found, matrix) < 1e-13
    # The same rows as a view whose time is not contiguous.
    assert np.array_equal(qr_update(None, matrix.T), found)


def test_keeps_singular_values_that_the_gram_matrix_loses() -> None:
    rng = np.random.default_rng(2)
    left = np.linalg.qr(rng.normal(size=(3000, 12)))[0]
    right = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    truth = np.logspace(0.0, -11.0, 12)
    matrix = (left * truth) @ right.T
    cuts = list(range(100, 3000, 100))
    streamed = np.linalg.svd(_streamed(matrix, cuts), compute_uv=False)
    streamed_error = np.abs(streamed - truth)
    assert np.max(streamed_error) < 1e-14
    gram = np.sqrt(np.abs(np.linalg.eigvalsh(matrix.T @ matrix)))[::-1]
    assert abs(gram[-1] / truth[-1] - 1.0) > 1.0


def test_leaves_its_arguments_alone() -> None:
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(4, 10))
    triangle = qr_update(None, columns)
    kept = columns.copy()
    kept_triangle = triangle.copy()
    qr_update(triangle, columns)
    assert np.array_equal(columns, kept)
    assert np.array_equal(triangle, kept_triangle)


def test_other_columns_than_before_are_refused() -> None:
    triangle = np.zeros((4, 4))
    columns = np.zeros((3, 10))
    with pytest.raises(ValueError, match="expected 4 columns"):
        qr_update(triangle, columns)


def test_no_rows_are_a_zero_triangle() -> None:
    columns = np.zeros((3, 0))
    assert np.array_equal(qr_update(None, columns), np.zeros((3, 3)))
    assert np.array_equal(qr_merge((), 2), np.zeros((2, 2)))


def test_joints_meet_in_one_triangle() -> None:
    rng = np.random.default_rng(4)
    places = ((0, 1, 2, 3, 4), (4, 2), (3,))
    whole = []
    parts = []
    for chosen in places:
        rows = np.zeros((30, 5))
        rows[:, chosen] = rng.normal(size=(30, len(chosen)))
        whole.append(rows)
        columns = np.ascontiguousarray(rows[:, chosen].T)
        parts.append((qr_update(None, columns), chosen))
    triangle = qr_merge(parts, 5)
    matrix = np.concatenate(whole)
    assert _gram_error(triangle, matrix) < 1e-13
