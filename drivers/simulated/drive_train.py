"""The gears of the simulated cell: how motors, joints and directions of dry friction hang together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.errors import SpecInvalid

FloatArray = NDArray[np.float64]


def reduction(ratio: FloatArray) -> FloatArray:
    """N of each motor, shape (n,): its own joint's ratio, or its largest where it does not drive that joint.

    Raises:
        SpecInvalid: the matrix is not square or not invertible.
    """
    if ratio.ndim != 2 or ratio.shape[0] != ratio.shape[1]:
        raise SpecInvalid(f"the drive train must be a square matrix, found shape {ratio.shape}")
    if not np.isfinite(ratio).all() or np.linalg.matrix_rank(ratio) < len(ratio):
        raise SpecInvalid(f"the drive train must be invertible, found {ratio.tolist()}")
    own = np.diag(ratio)
    largest = ratio[np.arange(len(own)), np.argmax(np.abs(ratio), axis=1)]
    return np.where(own != 0.0, own, largest)


def motor_rows(ratio: FloatArray) -> FloatArray:
    """r_i = R_i / N_i, shape (n, n): a motor's torque in joint units acts on the joints along r_i (eq. 24)."""
    return np.asarray(ratio / reduction(ratio)[:, None], dtype=np.float64)
