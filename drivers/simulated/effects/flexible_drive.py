"""A gear that gives: elasticity and backlash between a motor and the links it drives."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.effects.moment import Moment


@dataclass(slots=True)
class Elasticity:
    """A spring and a damper in the drive of one motor: the motor becomes a coordinate of its own (two masses).

    Attributes:
        axis: motor.
        stiffness_nm_per_rad, damping_nm_s_per_rad: in joint units.
        coordinate, row: the motor's coordinate and its row r of the drive train, filled in by the plant.
    """

    axis: int
    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float
    coordinate: int = field(default=-1, init=False)
    row: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), init=False)

    def act(self, moment: Moment) -> None:
        """Add the drive's torque to the links and subtract it from the motor."""
        _transmit(self, moment, 0.0)


@dataclass(slots=True)
class Backlash:
    """Elasticity with a gap: the drive transmits only where the teeth touch, and there it only pushes.

    Attributes:
        gap_rad: free play between the flanks, in joint units; the others as in Elasticity.
    """

    axis: int
    gap_rad: float
    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float
    coordinate: int = field(default=-1, init=False)
    row: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), init=False)

    def act(self, moment: Moment) -> None:
        """Add the drive's torque to the links and subtract it from the motor."""
        _transmit(self, moment, self.gap_rad / 2.0)


def _transmit(drive: Elasticity | Backlash, moment: Moment, half_gap_rad: float) -> None:
    n = len(drive.row)
    twist = float(moment.position_rad[drive.coordinate] - drive.row @ moment.position_rad[:n])
    rate = float(moment.velocity_rad_s[drive.coordinate] - drive.row @ moment.velocity_rad_s[:n])
    deflection = twist - min(max(twist, -half_gap_rad), half_gap_rad)
    if half_gap_rad > 0.0 and deflection == 0.0:
        return
    torque = drive.stiffness_nm_per_rad * deflection + drive.damping_nm_s_per_rad * rate
    if half_gap_rad > 0.0:
        # A flank pushes and never pulls, however fast it is left.
        torque = max(torque, 0.0) if deflection > 0.0 else min(torque, 0.0)
    moment.torque_nm[drive.coordinate] -= torque
    moment.torque_nm[:n] += drive.row * torque
