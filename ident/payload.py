"""A body fixed to the last link: what is known of it, and what is not."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.link import LINK_PARAMETERS

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Payload:
    """A weighed body as it was mounted; each mounting has its own unknowns.

    Attributes:
        name: of the body.
        mounting: names one way of mounting it; runs that share it share their unknown parameters.
        known: known inertial parameters by their names in LINK_PARAMETERS, in the last joint's frame
            (paper eq. 5, χ_kL); the weighed mass alone is {"m": 4.59}.
    """

    name: str
    mounting: str
    known: dict[str, float] = field(default_factory=dict)

    @property
    def known_parameters(self) -> FloatArray:
        """χ_kL in the order of LINK_PARAMETERS, zero where unknown, shape (10,)."""
        return np.array([self.known.get(name, 0.0) for name in LINK_PARAMETERS])
