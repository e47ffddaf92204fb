"""A smooth function of one variable: what no named effect explains, and still depends on something."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side, values
from ident.model.model import Column

FloatArray = NDArray[np.float64]

INTERVALS = 6
"""Of the variable's range; cubic B-splines over them have three more coefficients."""
MOTOR_VARIABLES = frozenset({Abscissa.CURRENT, Abscissa.TORQUE_RATE})
FOLDED = frozenset({Abscissa.VELOCITY, Abscissa.OTHER_VELOCITY})
"""Variables of which the size is taken: dry friction has its jump at zero, which no smooth function of v follows."""
LINEAR_IN_MODEL = frozenset({(Abscissa.VELOCITY, 1), (Abscissa.LOAD, 0), (Abscissa.CURRENT, 0)})
"""Variable and `signed` of p · x that is declared: viscous friction, and what a change of the gain is."""


@dataclass(frozen=True, slots=True)
class Smooth:
    """τ = p · Σ c_k S_k(x)

    S_k are combinations of the cubic B-splines over a uniform division of the range of x (de Boor, A Practical Guide to
    Splines), and p is 1, or sign(q̇) where `signed`. Of a velocity x is the size, and p its own sign. What the model
    declares is not among them: p itself (offset, dry friction), and p · x of LINEAR_IN_MODEL.

    Attributes:
        variable: x.
        lower, upper: its range; outside of it the function keeps its value at the end.
        signed: 1 where p turns with the direction of motion, else 0.
        other_axis: number of the other axis, from 1, where x speaks of one; else 0.
    """

    holds: ClassVar[Property] = Property.SMOOTH

    variable: Abscissa
    lower: float = 0.0
    upper: float = 1.0
    signed: int = 0
    other_axis: int = 0

    @property
    def side(self) -> Side:
        """On the motor, where the variable is the motor's."""
        return Side.MOTOR if self.variable in MOTOR_VARIABLES else Side.JOINT

    @property
    def name(self) -> str:
        """Of the variable."""
        return f"smooth-{self.variable.name.lower().replace('_', '-')}"

    @property
    def abscissa(self) -> Abscissa:
        """The variable."""
        return self.variable

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"lower": self.lower, "upper": self.upper, "signed": self.signed, "other_axis": self.other_axis}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return tuple(Column(f"part {number}", "Nm") for number in range(1, self._mixture().shape[1] + 1))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (p, k)."""
        x = values(self.variable, signals, axis, self.other_axis - 1 if self.other_axis else None)
        sign = np.sign(x if self.variable in FOLDED else signals.velocity_rad_s[axis])
        basis = cubic_basis(np.abs(x) if self.variable in FOLDED else x, self.lower, self.upper)
        basis = self._mixture().T @ basis
        return np.asarray(basis * sign if self.signed else basis)

    def _mixture(self) -> FloatArray:
        """Weights of the B-splines in each S_k, shape (INTERVALS + 3, p), orthogonal to those of what is declared.

        The B-splines' weights of a constant are all one, those of x itself rise evenly (Greville).
        """
        if self.variable is Abscissa.OTHER_VELOCITY and self.signed:
            return np.eye(INTERVALS + 3)  # dry friction of another joint is not declared on this one
        powers = 2 if (self.variable, self.signed) in LINEAR_IN_MODEL else 1
        declared = np.vander(np.arange(INTERVALS + 3.0), powers)
        return np.asarray(np.linalg.qr(declared, mode="complete")[0][:, powers:])


def cubic_basis(x: FloatArray, lower: float, upper: float) -> FloatArray:
    """Uniform cubic B-splines, shape (INTERVALS + 3, k); they sum to one."""
    place = np.clip((x - lower) / (upper - lower), 0.0, 1.0) * INTERVALS
    interval = np.minimum(place.astype(np.int64), INTERVALS - 1)
    u = place - interval
    parts = ((1.0 - u) ** 3, 3.0 * u**3 - 6.0 * u**2 + 4.0, -3.0 * u**3 + 3.0 * u**2 + 3.0 * u + 1.0, u**3)
    basis = np.zeros((INTERVALS + 3, len(x)))
    for offset, part in enumerate(parts):
        basis[interval + offset, np.arange(len(x))] = part / 6.0
    return basis


# A periodic function of the motor's angle: what no single ripple order explains.


ORDERS = (1, 2, 3, 4, 6)


@dataclass(frozen=True, slots=True)
class Periodic:
    """τ = Σ a_k cos kθ + b_k sin kθ, θ the motor's angle, k in ORDERS

    Source: Fourier series of whatever repeats with the motor. Where `signed`, times sign(q̇): friction that does.

    Attributes:
        signed: 1 where it turns with the direction of motion, else 0.
    """

    side: ClassVar[Side] = Side.MOTOR
    holds: ClassVar[Property] = Property.PERIODIC_IN_MOTOR_ANGLE
    name: ClassVar[str] = "periodic-motor-angle"
    abscissa: ClassVar[Abscissa] = Abscissa.MOTOR_ANGLE

    signed: int = 0

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"signed": self.signed}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return tuple(Column(f"{part} {order}", "Nm") for order in ORDERS for part in ("cosine", "sine"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2 · orders, k)."""
        angle = signals.motor_position_rad[axis]
        waves = np.stack([wave(order * angle) for order in ORDERS for wave in (np.cos, np.sin)])
        return np.asarray(waves * np.sign(signals.velocity_rad_s[axis]) if self.signed else waves)
