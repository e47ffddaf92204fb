"""Whether data contradict a prior: the tests are those of least squares with one column more, and
of the distribution of a sum of squares, both written out in another way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import linalg, stats

from ident.physical.prior_check import PriorCheck, check_prior

FloatArray = NDArray[np.float64]
LINKS = 2
DATA_ROWS = 12
UNKNOWNS = 17
ROWS = DATA_ROWS + 10 * LINKS
TOLERANCE = 0.2
LEVEL = 0.01  #: Share of right priors that are called wrong, by three tests together
#: Places of the diagonal in the upper triangle of a symmetric 4 × 4 matrix, row by row
DIAGONAL = (0, 4, 7, 9)
seeds = st.integers(0, 10_000)


def _problem(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, y and S of the rows of the data."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(ROWS, UNKNOWNS))
    right = rng.normal(size=ROWS)
    factor = rng.normal(size=(DATA_ROWS, DATA_ROWS))
    return matrix, right, factor @ factor.T / DATA_ROWS


def _check(matrix: FloatArray, right: FloatArray, data_covariance: FloatArray) -> PriorCheck:
    return check_prior(matrix, right, data_covariance, LINKS, TOLERANCE)


def _heavier(link: int) -> FloatArray:
    """What the rows of a link's prior lack where the link is heavier, per unit of s."""
    column = np.zeros(ROWS)
    for place in DIAGONAL:
        column[DATA_ROWS + 10 * link + place] = 1.0 / TOLERANCE
    return column


def _covariance(data_covariance: FloatArray) -> FloatArray:
    return np.asarray(linalg.block_diag(data_covariance, np.eye(10 * LINKS)))


def _share_by_least_squares(
    matrix: FloatArray, column: FloatArray, right: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """1 + s of M x − s c = y, and its σ where the rows have that covariance."""
    widened = np.column_stack((matrix, -column))
    inverse = np.linalg.pinv(widened)
    share = inverse[-1] @ right
    variance = inverse[-1] @ covariance @ inverse[-1]
    return 1.0 + float(share), float(np.sqrt(variance))


@given(seeds)
@settings(max_examples=8)
def test_weights_and_their_sigma_are_those_of_least_squares_with_a_column_more(seed: int) -> None:
    matrix, right, data_covariance = _problem(seed)
    check = _check(matrix, right, data_covariance)
    covariance = _covariance(data_covariance)
    of_all = np.zeros(ROWS)
    for link in range(LINKS):
        column = _heavier(link)
        of_all += column
        ratio, std = _share_by_least_squares(matrix, column, right, covariance)
        assert check.link_ratios[link] == pytest.approx(ratio, rel=1e-6)
        assert check.link_ratio_stds[link] == pytest.approx(std, rel=1e-6)
    ratio, std = _share_by_least_squares(matrix, of_all, right, covariance)
    assert check.mass_ratio == pytest.approx(ratio, rel=1e-6)
    assert check.mass_ratio_std == pytest.approx(std, rel=1e-6)


@given(seeds, st.floats(-0.9, 3.0))
@settings(max_examples=8)
def test_links_that_all_weigh_more_are_found_to_weigh_that(seed: int, share: float) -> None:
    matrix, unknowns, data_covariance = _problem(seed)
    of_all = _heavier(0) + _heavier(1)
    right = matrix @ unknowns[:UNKNOWNS] - share * of_all
    check = _check(matrix, right, data_covariance)
    assert check.mass_ratio == pytest.approx(1.0 + share, abs=1e-9)


@given(seeds)
@settings(max_examples=8)
def test_the_misfit_has_mean_and_variance_of_its_chi_square_distribution(seed: int) -> None:
    matrix, right, data_covariance = _problem(seed)
    check = _check(matrix, right, data_covariance)
    # ‖r‖² is a sum of squares of independent normal numbers with these variances.
    outside = linalg.null_space(matrix.T)
    variances = np.linalg.eigvalsh(outside.T @ _covariance(data_covariance) @ outside)
    mean = float(np.sum(variances))
    variance = 2.0 * float(np.sum(variances**2))
    # So many times a χ² of so many degrees of freedom has the same mean and variance.
    degrees = 2.0 * mean**2 / variance
    factor = mean / degrees
    misfit = outside.T @ right
    assert check.degrees_of_freedom == pytest.approx(degrees, rel=1e-9)
    assert check.chi_square == pytest.approx(float(misfit @ misfit) / factor, rel=1e-9)


def test_independent_rows_leave_as_many_degrees_of_freedom_as_they_exceed_the_unknowns() -> None:
    matrix, right, _ = _problem(3)
    check = _check(matrix, right, np.eye(DATA_ROWS))
    _, squares, _, _ = np.linalg.lstsq(matrix, right)
    assert check.degrees_of_freedom == pytest.approx(ROWS - UNKNOWNS)
    assert check.chi_square == pytest.approx(squares.item())


def test_a_link_that_no_row_but_its_prior_concerns_says_nothing_of_its_weight() -> None:
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(ROWS, UNKNOWNS))
    own = slice(DATA_ROWS + 10, ROWS)
    matrix[own] = 0.0
    identity = np.zeros((ROWS, 10))
    identity[own] = np.eye(10)
    matrix = np.column_stack((matrix[:, : UNKNOWNS - 8], identity))
    check = _check(matrix, rng.normal(size=ROWS), np.eye(DATA_ROWS))
    assert np.isfinite(check.link_ratio_stds).tolist() == [True, False]
    assert check.link_ratios[1] == 1.0
    assert np.isfinite(check.mass_ratio_std)


FITTING = PriorCheck(
    chi_square=20.0,
    degrees_of_freedom=20.0,
    mass_ratio=1.0,
    mass_ratio_std=0.1,
    link_ratios=np.ones(4),
    link_ratio_stds=np.full(4, 0.1),
)
#: σ beyond which one of three two-sided tests is, and one of four links in one of them
SIGMAS_OF_ALL = float(stats.norm.isf(LEVEL / 3.0 / 2.0))
SIGMAS_OF_A_LINK = float(stats.norm.isf(LEVEL / 3.0 / 4.0 / 2.0))


def test_a_prior_that_fits_is_not_wrong() -> None:
    assert not FITTING.is_misfit
    assert not FITTING.is_mass_wrong
    assert FITTING.wrong_links == ()
    assert not FITTING.is_wrong


@pytest.mark.parametrize(("factor", "is_wrong"), [(0.999, False), (1.001, True)])
def test_a_misfit_is_judged_at_a_third_of_the_level(factor: float, is_wrong: bool) -> None:
    limit = float(stats.chi2.isf(LEVEL / 3.0, FITTING.degrees_of_freedom))
    check = replace(FITTING, chi_square=factor * limit)
    assert check.is_misfit is is_wrong
    assert check.is_wrong is is_wrong


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("factor", "is_wrong"), [(0.999, False), (1.001, True)])
def test_too_light_and_too_heavy_are_judged_at_a_third_of_the_level(
    sign: float, factor: float, is_wrong: bool
) -> None:
    sigmas = sign * factor * SIGMAS_OF_ALL
    check = replace(FITTING, mass_ratio=1.0 + 0.1 * sigmas)
    assert check.is_mass_wrong is is_wrong
    assert check.is_wrong is is_wrong


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("factor", "wrong"), [(0.999, ()), (1.001, (2,))])
def test_a_link_is_judged_among_all_links(
    sign: float, factor: float, wrong: tuple[int, ...]
) -> None:
    ratios = np.ones(4)
    ratios[2] += 0.1 * sign * factor * SIGMAS_OF_A_LINK
    check = replace(FITTING, link_ratios=ratios)
    assert check.wrong_links == wrong
    assert check.is_wrong is bool(wrong)


def test_what_is_not_seen_is_not_wrong() -> None:
    stds = np.full(4, np.inf)
    ratios = np.full(4, 1e6)
    check = replace(
        FITTING, link_ratios=ratios, link_ratio_stds=stds, mass_ratio=1e6, mass_ratio_std=np.inf
    )
    assert not check.is_wrong
