"""Stribeck: dry friction is larger near standstill."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class Stribeck:
    """Dry friction Fs + rise·exp(−|v|/speed): static friction exceeds the sliding one (Bo and Pavelescu 1982)."""

    axis: int
    rise_nm: float
    speed_rad_s: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        speed = abs(moment.velocity_rad_s[self.axis])
        moment.bound_nm[self.axis] += self.rise_nm * math.exp(-speed / self.speed_rad_s)
