"""Load-dependent friction: what the gear transmits presses its teeth together."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.effects.moment import Moment


@dataclass(frozen=True, slots=True)
class LoadFriction:
    """Dry friction Fs + coefficient·|τ_L|; τ_L is what the links ask of the joint (gravity, inertia, payload)."""

    axis: int
    coefficient: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        moment.bound_nm[self.axis] += self.coefficient * abs(moment.load_torque_nm[self.axis])
