"""How much of the torque a model does not tell, in per cent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RelativeError:
    """‖ρ‖/‖Y‖ of each axis and of all together [%]; it means nothing without the filter beside it."""

    axes: tuple[float, ...]
    total: float


def relative_error(measured_nm: FloatArray, predicted_nm: FloatArray, use: BoolArray) -> RelativeError:
    """‖ρ_j‖/‖Y_j‖ of each joint and of all together [%] (paper Table 6); NaN for a joint without a row that counts.

    Args:
        measured_nm, predicted_nm: joint torque, shape (n, r).
        use: rows of each joint that count, shape (n, r).
    """
    size = np.sum(measured_nm**2, axis=1, where=use)
    return of_squares(size, np.sum((measured_nm - predicted_nm) ** 2, axis=1, where=use))


def of_squares(size: FloatArray, left: FloatArray) -> RelativeError:
    """The same from ‖Y_j‖² and ‖ρ_j‖² of each joint, both of shape (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = 100.0 * np.sqrt(left / size)
        total = 100.0 * np.sqrt(left.sum() / size.sum())
    return RelativeError(tuple(float(value) for value in axes), float(total))
