"""Dry friction that changes over a revolution of the joint (an eccentric gear, a bearing out of line)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class PositionFriction:
    """Dry friction Fs + amplitude·cos(q − phase), never below zero."""

    axis: int
    amplitude_nm: float
    phase_rad: float

    def act(self, moment: Moment) -> None:
        """Change the bound of dry friction."""
        change = self.amplitude_nm * math.cos(moment.position_rad[self.axis] - self.phase_rad)
        moment.bound_nm[self.axis] = max(0.0, moment.bound_nm[self.axis] + change)
