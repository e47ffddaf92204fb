"""Viscous friction that is not proportional to speed (lubricants shear-thin, seals and churning do not)."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class NonlinearViscous:
    """Friction c·|v|^η against the motion, v in rad/s, beside the linear one.

    It joins the bound of dry friction, which can only dissipate: as an explicit torque |v|^(1/3) would chatter at zero.
    """

    axis: int
    torque_at_1_rad_s_nm: float
    exponent: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        moment.bound_nm[self.axis] += self.torque_at_1_rad_s_nm * abs(moment.velocity_rad_s[self.axis]) ** self.exponent
