"""Terms without a name: a smooth function of one variable, and a periodic one of the motor's angle.

They fit structure that no named effect explains.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import AxisNumber, Effect, GearSide, Property, Range, Switch
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin

INTERVALS = 6
"""Intervals of the variable's range; cubic B-splines over them have three more coefficients."""
MOTOR_VARIABLES = frozenset({Abscissa.CURRENT, Abscissa.TORQUE_RATE})
FOLDED = frozenset({Abscissa.VELOCITY, Abscissa.OTHER_VELOCITY})
"""Variables taken by magnitude: no smooth function of v follows dry friction's jump at zero."""
LINEAR_IN_MODEL = frozenset({(Abscissa.VELOCITY, 1), (Abscissa.LOAD, 0), (Abscissa.CURRENT, 0)})
"""Variable and `signed` of p · x that is declared: viscous friction, and a change of the gain."""
PERIODIC_ORDERS = (1, 2, 3, 4, 6)


@dataclass(frozen=True, slots=True)
class Smooth(Effect):
    """τ = p · Σ c_k S_k(x).

    S_k are combinations of the cubic B-splines over a uniform division of the range of x (de Boor,
    A Practical Guide to Splines), and p is 1, or sign(q̇) where `signed`. Of a velocity, x is the
    magnitude and p its own sign. The declared terms are not among them: p itself (offset, dry
    friction), and p · x of LINEAR_IN_MODEL.
    """

    declares = Property.SMOOTH
    refined = ()  # its range is that of the data

    variable: Abscissa  #: x
    #: Its range; outside of it the function keeps its value at the end.
    lower: Annotated[float, Range(-1e12, 1e12)] = 0.0
    upper: Annotated[float, Range(-1e12, 1e12)] = 1.0  #: upper end of the range
    signed: Switch = 0  #: 1 where p turns with the direction of motion, else 0
    other_axis: AxisNumber = 0  #: number of the other axis, from 1, where x is its velocity; else 0

    @property
    def side(self) -> GearSide:
        """Motor where the variable is the motor's, else joint."""
        if self.variable in MOTOR_VARIABLES:
            return GearSide.MOTOR
        return GearSide.JOINT

    @property
    def axis_setting(self) -> str:
        """The other axis, where x is its velocity."""
        if self.variable is Abscissa.OTHER_VELOCITY:
            return "other_axis"
        return ""

    @property
    def settings_fault(self) -> str:
        """Another axis where x is not its velocity, or an empty range."""
        if self.other_axis and not self.axis_setting:
            return f"other_axis = {self.other_axis:g}; it has no other axis: 0"
        if not self.lower < self.upper:
            return f"the range {self.lower:g} to {self.upper:g}; it must not be empty"
        return ""

    @property
    def name(self) -> str:
        """Name after the variable."""
        return f"smooth-{self.variable.name.lower().replace('_', '-')}"

    @property
    def abscissa(self) -> Abscissa:
        """Variable x."""
        return self.variable

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """One linear parameter a combination."""
        count = self._combinations().shape[1]
        return tuple(Column(f"part {number}", "Nm") for number in range(1, count + 1))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (p, k)."""
        other_axis: int | None = None
        if self.other_axis:
            other_axis = self.other_axis - 1
        x = signals.variable(self.variable, axis, other_axis)
        turning = signals.velocity_rad_s[axis]
        if self.variable in FOLDED:
            turning = x
            x = np.abs(x)
        columns = self.shapes(x)
        if self.signed:
            columns = columns * np.sign(turning)
        return columns

    def shapes(self, x: FloatArray) -> FloatArray:
        """Functions S_k at values of x, of a velocity its magnitude, shape (p, k)."""
        basis = cubic_basis(x, self.lower, self.upper)
        return np.asarray(self._combinations().T @ basis)

    def _combinations(self) -> FloatArray:
        """Weights of the B-splines in each S_k, shape (INTERVALS + 3, p).

        They are orthogonal to those of the declared terms. The weights of a constant are all one,
        those of x itself rise evenly (Greville).
        """
        if self.variable is Abscissa.OTHER_VELOCITY and self.signed:
            # Dry friction of another joint is not declared on this one
            return np.eye(INTERVALS + 3)
        powers = 1
        if (self.variable, self.signed) in LINEAR_IN_MODEL:
            powers = 2
        declared = np.vander(np.arange(INTERVALS + 3.0), powers)
        complete, _ = np.linalg.qr(declared, mode="complete")
        return np.asarray(complete[:, powers:])


def _waves() -> Iterator[Column]:
    for order in PERIODIC_ORDERS:
        yield Column(f"cosine {order}", "Nm")
        yield Column(f"sine {order}", "Nm")


@dataclass(frozen=True, slots=True)
class Periodic(Effect):
    """τ = Σ a_k cos kθ + b_k sin kθ, θ the motor's angle, k in PERIODIC_ORDERS.

    It is multiplied by sign(q̇) where `signed`.

    Source: Fourier series of any torque, or friction, that repeats with the motor.
    """

    name = "periodic-motor-angle"
    side = GearSide.MOTOR
    declares = Property.PERIODIC_IN_MOTOR_ANGLE
    abscissa = Abscissa.MOTOR_ANGLE
    coefficients = tuple(_waves())

    signed: Switch = 0  #: 1 where it turns with the direction of motion, else 0

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2 · orders, k)."""
        waves = self.shapes(signals.motor_position_rad[axis])
        if self.signed:
            waves = waves * np.sign(signals.velocity_rad_s[axis])
        return waves

    def shapes(self, x: FloatArray) -> FloatArray:
        """Functions cos kθ and sin kθ at values x of θ [rad], shape (p, k)."""
        waves: list[FloatArray] = []
        for order in PERIODIC_ORDERS:
            waves += cos_sin(order * x)
        return np.stack(waves)


def cubic_basis(x: FloatArray, lower: float, upper: float) -> FloatArray:
    """Uniform cubic B-splines, shape (INTERVALS + 3, k); they sum to one."""
    share = np.clip((x - lower) / (upper - lower), 0.0, 1.0)
    place = share * INTERVALS
    interval = np.minimum(place.astype(np.int64), INTERVALS - 1)
    u = place - interval
    parts = (
        (1.0 - u) ** 3,
        3.0 * u**3 - 6.0 * u**2 + 4.0,
        -3.0 * u**3 + 3.0 * u**2 + 3.0 * u + 1.0,
        u**3,
    )
    count = len(x)
    samples = np.arange(count)
    basis = np.zeros((INTERVALS + 3, count))
    for offset, part in enumerate(parts):
        basis[interval + offset, samples] = part / 6.0
    return basis


def is_unnamed(effect: Effect) -> bool:
    """Whether it is a smooth or periodic term, which fits anything and names no cause."""
    return isinstance(effect, Smooth | Periodic)
