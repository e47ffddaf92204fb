"""Magnetic saturation: the torque constant drops with the current."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class Saturation:
    """Torque g·i / (1 + (i / half_current)²): half the torque constant is left at half_current.

    To first order the current that a torque needs is v = v₀ + v₀³/half_current², v₀ = τ/g.
    """

    axis: int
    half_current_a: float

    def act(self, moment: Moment) -> None:
        """Lower the motor's torque."""
        moment.motor_torque_nm[self.axis] /= 1.0 + (moment.current_a[self.axis] / self.half_current_a) ** 2
