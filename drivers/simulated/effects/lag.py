"""Lag: the amplifier reports its current reference late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Lag:
    """First-order lag of the reported current reference; the current itself is not late.

    Attributes:
        axis: motor.
        time_constant_s: of the lag.
        value_a: of the filter, the state.
    """

    axis: int
    time_constant_s: float
    value_a: float = 0.0

    def report(self, reported_a: NDArray[np.float64], step_s: float) -> None:
        """Replace this axis' reference by the filtered one; called once a substep (exact for a held input)."""
        self.value_a += (float(reported_a[self.axis]) - self.value_a) * -np.expm1(-step_s / self.time_constant_s)
        reported_a[self.axis] = self.value_a
