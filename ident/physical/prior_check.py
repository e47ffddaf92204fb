"""Whether data contradict a prior: by its total misfit, and by how heavy they find its links.

Rows of data and prior in units of their σ, M x = y, leave a misfit r = (1 − Q Qᵀ) y, Q an
orthonormal basis of M. With S the covariance of the rows, that of r is Σ = (1 − Q Qᵀ) S (1 − Q Qᵀ).
S is not quite one: the weights of the data are those of independent rows, and their errors are not.
‖r‖² has the mean tr Σ and the variance 2 tr Σ², so ‖r‖² tr Σ / tr Σ² has nearly the chi-square
distribution with (tr Σ)² / tr Σ² degrees of freedom (Satterthwaite, Biometrics Bulletin 2 (1946)).

The misfit is weak against one mistake that all links share: 30 % too heavy is 1.5 σ for a tolerance
of 20 %, one link at a time. A prior whose links all weigh 1 + s times what it says adds a column to
M, M x − s c = y; s by least squares, with its σ by S, is a test of that alone, and so is the same
for each link.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from ident.arrays import FloatArray

LEVEL = 0.01
"""Probability with which a right prior is called wrong, for the three tests together."""

_VISIBLE = 1e-12  #: Share of a link's rows that other parameters leave, below which it is rounding


@dataclass(frozen=True, slots=True, eq=False)
class PriorCheck:
    """Tests of a prior with n links by data."""

    chi_square: float  #: scaled misfit of data and prior
    degrees_of_freedom: float  #: its mean where the prior is right
    mass_ratio: float  #: how heavy all links are, by the data, relative to the prior
    #: its σ, the prior's tolerance included; infinite where the data do not show it
    mass_ratio_std: float
    link_ratios: FloatArray  #: the same of each link, shape (n,)
    link_ratio_stds: FloatArray  #: shape (n,); infinite for a link that the data do not show

    @property
    def is_misfit(self) -> bool:
        """Whether the total misfit is more than chance."""
        probability = special.chdtrc(self.degrees_of_freedom, self.chi_square)
        return float(probability) < LEVEL / 3.0

    @property
    def is_mass_wrong(self) -> bool:
        """Whether the data find all links lighter or heavier than the tolerance allows."""
        sigmas = (self.mass_ratio - 1.0) / self.mass_ratio_std
        return _chance(sigmas) < LEVEL / 3.0

    @property
    def wrong_links(self) -> tuple[int, ...]:
        """Links (from 0) that the data find lighter or heavier than the tolerance allows."""
        sigmas = (self.link_ratios - 1.0) / self.link_ratio_stds
        level = LEVEL / (3.0 * len(sigmas))
        wrong: list[int] = []
        for link, size in enumerate(sigmas.tolist()):
            if _chance(size) < level:
                wrong.append(link)
        return tuple(wrong)

    @property
    def is_wrong(self) -> bool:
        """Whether any test contradicts the prior."""
        return self.is_misfit or self.is_mass_wrong or bool(self.wrong_links)


def check_prior(
    matrix: FloatArray, right: FloatArray, data_covariance: FloatArray, links: int, tolerance: float
) -> PriorCheck:
    """Test a prior.

    Args:
        matrix: M, the rows of the data first, those of the links' prior last, ten a link, in the
            order of the upper triangle of a symmetric 4 × 4 matrix, shape (r, x).
        right: y, shape (r,).
        data_covariance: S of the rows of the data, shape (d, d); that of the prior's is one.
        links: n.
        tolerance: of the prior, one relative standard deviation.
    """
    rows = len(right)
    data_rows = len(data_covariance)
    norms = np.linalg.norm(matrix, axis=0)
    basis, _ = np.linalg.qr(matrix / norms)
    explained = basis @ (basis.T @ right)
    misfit = right - explained
    covariance = np.eye(rows)
    covariance[:data_rows, :data_rows] = data_covariance
    # The misfit's covariance P S P, P = I − Q Qᵀ. A sum of squares with it has the mean tr and
    # the variance 2 tr of the square: that of a scaled χ² (Satterthwaite).
    projection = np.eye(rows) - basis @ basis.T
    misfit_covariance = projection @ covariance @ projection
    mean = float(np.trace(misfit_covariance))
    square_sum = float(np.sum(misfit_covariance**2))
    misfit_square = float(misfit @ misfit)
    columns_of_links = projection @ _columns_of_mass(rows, links, tolerance)
    column_of_all = columns_of_links.sum(axis=1)
    columns = np.column_stack((columns_of_links, column_of_all))
    squares = np.sum(columns**2, axis=0)
    least_square = _VISIBLE * 4.0 / tolerance**2
    is_visible = squares > least_square
    squares = np.where(is_visible, squares, np.inf)
    weights = columns / squares
    ratios = 1.0 - weights.T @ misfit
    variances = np.einsum("rl,rs,sl->l", weights, covariance, weights)  # wᵀ S w of each column
    stds = np.where(is_visible, np.sqrt(variances), np.inf)
    chi_square = misfit_square * mean / square_sum
    degrees_of_freedom = mean**2 / square_sum
    return PriorCheck(
        chi_square=chi_square,
        degrees_of_freedom=degrees_of_freedom,
        mass_ratio=float(ratios[-1]),
        mass_ratio_std=float(stds[-1]),
        link_ratios=ratios[:-1],
        link_ratio_stds=stds[:-1],
    )


def _columns_of_mass(rows: int, links: int, tolerance: float) -> FloatArray:
    """Change of all rows where a link is heavier than its prior, per unit of s, shape (r, n).

    With E = 1, P and with it all ten parameters are 1 + t times the prior's.
    """
    columns = np.zeros((rows, links))
    first_of_prior = rows - 10 * links
    on_diagonal = np.array([0, 4, 7, 9])
    for link in range(links):
        first = first_of_prior + 10 * link
        columns[first + on_diagonal, link] = 1.0 / tolerance
    return columns


def _chance(sigmas: float) -> float:
    """Probability of a normal number at least as far from zero."""
    one_tail = special.ndtr(-abs(sigmas))
    return float(2.0 * one_tail)
