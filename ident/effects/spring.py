"""A torque proportional to position: gas spring, cable or hose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.effects.abscissa import Abscissa
from ident.effects.effect import Property, Side
from ident.model import Column
from ident.signals import Signals

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Spring:
    """τ = c · q, with c · q₀ in the declared offset

    Source: Hooke's law. Signature: position, at any speed; a gravity term differs from it over a large range only.
    """

    name: ClassVar[str] = "spring"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("stiffness", "Nm/rad"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(signals.position_rad[axis])[None]
