"""The gears between motors and joints, as one matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.errors import ModelError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DriveTrain:
    """q_motor = R q_joint and τ_joint = Rᵀ τ_motor (paper eq. 24).

    Attributes:
        ratio: R, shape (n, n), invertible; row i belongs to motor i.
    """

    ratio: FloatArray

    def __post_init__(self) -> None:
        ratio = self.ratio
        if ratio.ndim != 2 or ratio.shape[0] != ratio.shape[1]:
            raise ModelError(f"the drive train must be a square matrix, found shape {ratio.shape}")
        condition = float(np.linalg.cond(ratio))
        if not np.isfinite(condition) or condition > 1e8:
            raise ModelError(f"the drive train is not invertible (condition {condition:.3g}): {ratio.tolist()}")

    @property
    def joints(self) -> tuple[int, ...]:
        """The joint that each motor is told by: its own, or that of its largest ratio where it does not drive that."""
        return tuple(i if row[i] != 0.0 else int(np.argmax(np.abs(row))) for i, row in enumerate(self.ratio))

    @property
    def reduction(self) -> FloatArray:
        """N of each motor, shape (n,): its ratio to the joint that it is told by."""
        return np.asarray(self.ratio[np.arange(len(self.ratio)), list(self.joints)], dtype=np.float64)

    @property
    def direction(self) -> FloatArray:
        """Rows r_i = R_i / N_i, shape (n, n): τ_joint = Σ_i r_iᵀ g_i v_i with the joint drive gains g_i."""
        return self.ratio / self.reduction[:, None]

    @property
    def to_motor(self) -> FloatArray:
        """T with g_i v_i = (T τ_joint)_i, the inverse of the transposed directions, shape (n, n)."""
        return np.asarray(np.linalg.inv(self.direction.T), dtype=np.float64)

    @property
    def coupled(self) -> tuple[int, ...]:
        """Motors that turn with more than one joint: their rotor inertia and friction need columns of their own."""
        return tuple(i for i, row in enumerate(self.ratio) if np.count_nonzero(row) > 1)
