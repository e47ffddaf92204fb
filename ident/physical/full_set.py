"""The full parameters of a robot as a calibration keeps them:
each with its σ and what it rests on.
"""

from __future__ import annotations

from dataclasses import dataclass

LEAST_TOLERANCE = 0.01  #: Of a prior
LARGEST_TOLERANCE = 0.5
"""Above it, a link of the prior's distribution is often no possible body:
first order in t is not enough.
"""


@dataclass(frozen=True, slots=True)
class FullParameter:
    """One standard parameter of a robot that can exist."""

    name: str  #: as in the model, `mx3`: no combination with others
    value: float
    std: float  #: its σ, from data and prior together
    unit: str
    basis: str  #: `data` or `prior`: which of the two has the larger part in its variance
    prior_share: float  #: the prior's part in it, 0 to 1
    #: value by the prior; None for rotors, friction and offsets, which have none
    prior: float | None
    prior_std: float | None  #: σ by the prior's tolerance; None likewise


@dataclass(frozen=True, slots=True)
class GainWithPrior:
    """What the prior would make of a gain; no controller gets it."""

    axis: str  #: name of the axis
    value: float  #: [unit of the gain]
    std: float  #: its σ [unit]


@dataclass(frozen=True, slots=True)
class FullSet:
    """All standard parameters under a prior on the links, and whether the data agree with it."""

    urdf: str  #: name of the prior's URDF; that of the cell where no other was given
    urdf_sha256: str  #: its digest
    tolerance: float  #: of the prior: one relative standard deviation of masses and second moments
    parameters: tuple[FullParameter, ...]  #: they belong to the gains of the calibration
    gains: tuple[GainWithPrior, ...]  #: one an axis; empty for fixed gains
    bounded: bool  #: values were moved to those of a robot that can exist
    chi_square: float  #: misfit of data and prior
    degrees_of_freedom: float  #: its mean where the prior is right
    #: How heavy all links are by the data, relative to the prior; None where the data do not show
    #: it.
    mass_ratio: float | None
    mass_ratio_std: float | None  #: its σ, the prior's tolerance included; None likewise
    contradictions: tuple[str, ...]  #: why the prior is wrong; empty where the data agree with it
