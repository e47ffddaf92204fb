"""Viscous friction that differs with the direction of motion."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class AsymmetricViscous:
    """Friction coefficient Fv + c forwards and Fv − c backwards, that is a torque −c·|v| beside −Fv·v."""

    axis: int
    coefficient_nm_s_rad: float

    def act(self, moment: Moment) -> None:
        """Change the joint's viscous coefficient by the sign of its speed; it never becomes a drive (negative)."""
        change = self.coefficient_nm_s_rad if moment.velocity_rad_s[self.axis] >= 0.0 else -self.coefficient_nm_s_rad
        moment.viscous_nm_s_rad[self.axis] = max(0.0, moment.viscous_nm_s_rad[self.axis] + change)
