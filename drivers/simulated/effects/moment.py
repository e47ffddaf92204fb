"""What an undeclared effect sees of the plant in one substep, and what it may change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(slots=True)
class Moment:
    """One substep of n joints and motors, N coordinates and m directions of dry friction.

    Coordinates are the joints first, then the motors behind a flexible drive; of a prismatic joint N for Nm, m for rad.

    Attributes:
        time_s: since power-on.
        step_s: length of the substep.
        position_rad, velocity_rad_s: at its start, shape (N,); read only.
        motor_rad: rotor angles, shape (n,); read only.
        current_a: in the motors, shape (n,); read only.
        load_torque_nm: what the links asked of each joint in the step before, shape (n,); read only.
        bound_nm: of dry friction, shape (m,); the first n are the joints'. May be changed; must not become negative.
        viscous_nm_s_rad: of viscous friction, shape (N,); may be changed.
        torque_nm: other torques on each coordinate, shape (N,); may be changed.
        motor_torque_nm: of each motor, in joint units, shape (n,); may be changed.
    """

    time_s: float
    step_s: float
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    motor_rad: FloatArray
    current_a: FloatArray
    load_torque_nm: FloatArray
    bound_nm: FloatArray
    viscous_nm_s_rad: FloatArray
    torque_nm: FloatArray
    motor_torque_nm: FloatArray
