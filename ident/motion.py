"""How the joints move: what a regressor needs to know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """A piece of motion of n joints over k samples, joint-first, shape (n, k) [rad, or m for a prismatic joint].

    Attributes:
        position_rad, velocity_rad_s, acceleration_rad_s2: of the joints.
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
