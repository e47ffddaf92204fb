"""Warm-up: cold grease makes a joint stiff, and it warms in the session."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class WarmUp:
    """Dry and viscous friction of the joint times 1 + cold_fraction·exp(−t/time_constant), t since power-on."""

    axis: int
    cold_fraction: float
    time_constant_s: float

    def act(self, moment: Moment) -> None:
        """Scale the joint's friction."""
        factor = 1.0 + self.cold_fraction * math.exp(-moment.time_s / self.time_constant_s)
        moment.bound_nm[self.axis] *= factor
        moment.viscous_nm_s_rad[self.axis] *= factor
