"""Cogging: the motor's torque ripples with its angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class Cogging:
    """Torque −amplitude·sin(order·θ + phase) of the motor, θ its rotor angle; the amplitude in joint units."""

    axis: int
    amplitude_nm: float
    order: float
    phase_rad: float = 0.0

    def act(self, moment: Moment) -> None:
        """Subtract the ripple from the motor's torque."""
        ripple = math.sin(self.order * moment.motor_rad[self.axis] + self.phase_rad)
        moment.motor_torque_nm[self.axis] -= self.amplitude_nm * ripple
