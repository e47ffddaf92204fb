"""Base parameters: the smallest set of standard columns that spans the same torques (paper §2.1,
QR method).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray

SMALLEST_COLUMN = 1e-9  #: Norm of a column, relative to the largest, that is rounding error
#: Share of a column's norm that is left of it where it is clearly independent of others
CLEAR = 1e-3
SMALLEST_WEIGHT = 1e-6  #: Smaller weights count as zero


@dataclass(frozen=True, slots=True)
class BaseParameters:
    """Independent standard columns, and their grouping with the others."""

    independent: tuple[int, ...]  #: indices of the base columns among the standard ones, ascending
    grouping: FloatArray  #: shape (b, c): base parameter = grouping @ standard parameters
    names: tuple[str, ...]  #: leading name and what is regrouped with it


def independent_columns(
    matrix: FloatArray, tolerance: float = 1e-8, smallest: float = SMALLEST_COLUMN
) -> list[int]:
    """Indices of a largest set of independent columns, ascending; of equals the first are taken.

    A column is independent if, after projection off the chosen columns, more than ``tolerance`` of
    its norm remains. Columns of which more than CLEAR remains are taken first: where gravity is
    vertical but for a millionth, the mass of a horizontal carriage and its rotor's inertia differ
    by a millionth of a constant force. The offset of the friction is this force, and the choice;
    the difference of the two would stand for it with weights of a million.

    Args:
        matrix: shape (r, c).
        tolerance: relative to each column's norm.
        smallest: columns with a norm below this share of the largest count as zero: normalised, one
            of them could be chosen, and the condition number would become 1e16.
    """
    norms = np.linalg.norm(matrix, axis=0)
    is_nonzero = norms > smallest * float(norms.max(initial=0.0))
    candidates = np.flatnonzero(is_nonzero).tolist()
    independent: list[int] = []
    basis = np.zeros((matrix.shape[0], 0))
    for smallest_share in (max(CLEAR, tolerance), tolerance):
        deferred: list[int] = []
        for column in candidates:
            unit = matrix[:, column] / norms[column]
            rest = unit - basis @ (basis.T @ unit)
            # Twice is enough (Kahan): the first projection cancels digits
            rest -= basis @ (basis.T @ rest)
            share = float(np.linalg.norm(rest))
            if share > smallest_share:
                independent.append(column)
                basis = np.column_stack((basis, rest / share))
            elif share > tolerance:
                deferred.append(column)
        candidates = deferred
    return sorted(independent)


def base_parameters(
    triangle: FloatArray, names: tuple[str, ...], tolerance: float = 1e-8
) -> BaseParameters:
    """Find them in the triangular factor of an observation matrix.

    Taking columns in the given order keeps the paper's regrouping (``Izz1 + Ia1 + …``).

    Args:
        triangle: any matrix with the same Gram matrix as the observation matrix, shape (r, c).
        names: of the c standard parameters.
        tolerance: of `independent_columns`.
    """
    norms = np.linalg.norm(triangle, axis=0)
    is_present = norms > SMALLEST_COLUMN * float(norms.max(initial=0.0))
    independent = independent_columns(triangle, tolerance)
    scale = norms[independent]
    scaled = triangle[:, independent] / scale
    scaled_weights, *_ = linalg.lstsq(scaled, triangle)
    weights = scaled_weights / scale[:, None]
    weights[:, ~is_present] = 0.0
    weights[:, independent] = np.eye(len(independent))
    weights[np.abs(weights) < SMALLEST_WEIGHT] = 0.0
    base_names = [names[leading] for leading in independent]
    for number, other in np.argwhere(weights):
        if other != independent[number]:
            weight = round(float(weights[number, other]), 6)
            sign = "-"
            if weight > 0:
                sign = "+"
            base_names[number] += f" {sign} {abs(weight)}*{names[other]}"
    return BaseParameters(tuple(independent), weights, tuple(base_names))
