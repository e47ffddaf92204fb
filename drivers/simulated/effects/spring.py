"""A spring between the link and its base: a gravity compensator, a cable or hose."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class Spring:
    """Torque −k·(q − rest) on the joint."""

    axis: int
    stiffness_nm_per_rad: float
    rest_rad: float

    def act(self, moment: Moment) -> None:
        """Add the torque."""
        moment.torque_nm[self.axis] -= self.stiffness_nm_per_rad * (moment.position_rad[self.axis] - self.rest_rad)
