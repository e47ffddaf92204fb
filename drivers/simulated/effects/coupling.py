"""Coupling: friction between two axes that the drive train matrix does not know."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.simulated.effects.moment import Moment


@dataclass(slots=True)
class Coupling:
    """Dry and viscous friction on the sum of two joints' speeds (a shaft of one that runs through the other, eq. 25).

    Attributes:
        axis: one joint.
        other_axis: number of the other joint, from 1 as a person counts.
        coulomb_nm, viscous_nm_s_rad: of the shared friction.
        direction: index of its direction of dry friction, filled in by the plant.
    """

    axis: int
    other_axis: float
    coulomb_nm: float
    viscous_nm_s_rad: float
    direction: int = field(default=-1, init=False)

    @property
    def other(self) -> int:
        """Index of the other joint, from 0."""
        return int(self.other_axis) - 1

    def act(self, moment: Moment) -> None:
        """Set the bound of the shared friction and add its viscous part."""
        moment.bound_nm[self.direction] += self.coulomb_nm
        shared = self.viscous_nm_s_rad * (moment.velocity_rad_s[self.axis] + moment.velocity_rad_s[self.other])
        moment.torque_nm[self.axis] -= shared
        moment.torque_nm[self.other] -= shared
