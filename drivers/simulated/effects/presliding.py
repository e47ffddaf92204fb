"""Presliding: contacts bend before they slide, so friction builds up over a distance after each reversal."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(slots=True)
class Presliding:
    """Dahl's friction torque·z, dz/dq = (1 − z·sign(v)) / distance (Dahl 1968), in the place of as much dry friction.

    Attributes:
        axis: joint.
        torque_nm: of friction after a long way in one direction.
        distance_rad: over which 63 % of a change of z happens.
        bristle: z, the state.
    """

    axis: int
    torque_nm: float
    distance_rad: float
    bristle: float = 0.0

    def act(self, moment: Moment) -> None:
        """Exchange dry friction for Dahl's; z is advanced by the exact solution over the way of the step."""
        velocity = moment.velocity_rad_s[self.axis]
        if velocity != 0.0:
            end = math.copysign(1.0, velocity)
            self.bristle = end + (self.bristle - end) * math.exp(-abs(velocity) * moment.step_s / self.distance_rad)
        moment.bound_nm[self.axis] = max(0.0, moment.bound_nm[self.axis] - self.torque_nm)
        moment.torque_nm[self.axis] -= self.torque_nm * self.bristle
