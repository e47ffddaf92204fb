"""Bodies: the ten inertial parameters of a link or payload, and the matrix that is positive definite for real ones.

With the inertia tensor I and the first moment h about the link frame's origin, and the mass m, the pseudo-inertia is

    P = [ Σ   h ]        Σ = ½ tr(I)·1 − I = ∫ r rᵀ dm.
        [ hᵀ  m ],

P ≻ 0 holds for every distribution of positive mass, and only then: m > 0, I about the centre of mass ≻ 0 and the
triangle inequality of its principal moments together (Wensing, Kim, Slotine: Linear Matrix Inequalities for Physically
Consistent Inertial Parameter Identification, 2018). P is linear in the ten parameters: a linear matrix inequality.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from numbers import Real

import numpy as np

from ident.arrays import FloatArray, require_kind
from ident.errors import ModelError

LOADED = "_loaded"
"""Ends the name of what a payload adds to a friction parameter (`Model.friction_by_payload`)."""
LINK_PARAMETERS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""Inertia about the link frame's origin, first moments, mass, in the paper's order; a payload is a link too (§2.2)."""

LINK_UNITS = ("kg m²",) * 6 + ("kg m",) * 3 + ("kg",)
_ROWS, _COLUMNS = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Payload:
    """A weighed body as it was mounted; each mounting has its own unknowns.

    Raises:
        ModelError: a name is not in LINK_PARAMETERS, a value is no finite number, or no body of positive mass has the
            values, as far as enough of them are given to tell.
    """

    name: str  #: of the body
    mounting: str  #: names one way of mounting it; runs that share it share their unknown parameters
    #: Known inertial parameters by their names in LINK_PARAMETERS, in the frame of the joint that carries it (paper
    #: eq. 5, χ_kL); the weighed mass alone is {"m": 4.59}.
    known: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_kind("known", self.known, dict, "write its mass as {'m': 4.59}")
        for name, value in self.known.items():
            require_kind(f"known[{name!r}]", value, Real, "give numbers in SI units: {'m': 4.59}")
        foreign = sorted(set(self.known) - set(LINK_PARAMETERS))
        if foreign:
            raise ModelError(
                f"payload {self.name!r} has the known parameters {', '.join(map(repr, foreign))}; expected names among "
                f"{', '.join(LINK_PARAMETERS)}; write its mass as {{'m': 4.59}}"
            )
        contradiction = _contradiction(self.known)
        if contradiction:
            raise ModelError(
                f"payload {self.name!r} has {contradiction}; expected values of a body, in SI units, the inertia about "
                "the origin of the joint's frame (paper eq. 5); correct them, or give the mass alone"
            )

    @property
    def known_parameters(self) -> FloatArray:
        """χ_kL in the order of LINK_PARAMETERS, zero where unknown, shape (10,)."""
        return np.array([self.known.get(name, 0.0) for name in LINK_PARAMETERS])


_THIN = 1e-6  #: Extent of a body in a direction, as a share of that in all, below which it has none
_SLACK = 1e-6  #: Share by which values that were rounded in a data sheet may miss those of a body


def _contradiction(known: Mapping[str, float]) -> str:
    """Say why no body of positive mass has some inertial parameters; empty where one has."""
    for name, value in known.items():
        if not isfinite(value):
            return f"{name} = {value:g}"
    if known.get("m", 1.0) <= 0.0:
        return f"a mass of {known['m']:g} kg"
    if not set(LINK_PARAMETERS[:6]) <= set(known):
        return ""
    matrix = pseudo_inertia(np.array([known.get(name, 0.0) for name in LINK_PARAMETERS]))
    is_whole = set(LINK_PARAMETERS) <= set(known)
    compared = matrix if is_whole else matrix[:3, :3]
    diagonal = np.abs(np.diag(compared))
    extent = max(float(diagonal[:3].sum()), float(np.finfo(np.float64).tiny))
    # A point or a rod has no extent in some directions: there rounding is all that there is.
    diagonal[:3] = np.maximum(diagonal[:3], _THIN * extent)
    size = np.sqrt(diagonal)
    least = float(np.linalg.eigvalsh(compared / np.outer(size, size))[0])
    if least >= -_SLACK:
        return ""
    if float(np.linalg.eigvalsh(matrix[:3, :3])[0]) < -_SLACK * float(np.trace(matrix[:3, :3])):
        return "moments of inertia of which one is below zero or above the sum of the other two"
    return "an inertia that is too small for its mass so far from the joint's frame"


def pseudo_inertia(link: FloatArray) -> FloatArray:
    """P of a link's parameters in the order of LINK_PARAMETERS, shape (10,) → (4, 4) [kg m², kg m, kg]."""
    inertia = _symmetric(link[:6])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = link[6:9]
    out[3, 3] = link[9]
    return out


def link_parameters(pseudo: FloatArray) -> FloatArray:
    """The inverse of `pseudo_inertia`, shape (4, 4) → (10,); a matrix that is not symmetric counts as its mean."""
    even = 0.5 * (pseudo + pseudo.T)
    inertia = np.trace(even[:3, :3]) * np.eye(3) - even[:3, :3]
    return np.concatenate((inertia[_ROWS, _COLUMNS], even[:3, 3], even[3:, 3]))


@dataclass(frozen=True, slots=True)
class Body:
    """Mass, centre and inertia of a link, as a URDF declares them."""

    mass_kg: float  #: of the link
    centre_m: FloatArray  #: centre of mass in the link frame, shape (3,)
    inertia_kg_m2: FloatArray  #: tensor about the centre of mass, axes of the link frame, shape (3, 3)

    @property
    def parameters(self) -> FloatArray:
        """About the link frame's origin (Huygens-Steiner), in the order of LINK_PARAMETERS, shape (10,)."""
        c = self.centre_m
        inertia = self.inertia_kg_m2 + self.mass_kg * (c @ c * np.eye(3) - np.outer(c, c))
        return np.concatenate((inertia[_ROWS, _COLUMNS], self.mass_kg * c, (self.mass_kg,)))


def body_of(link: FloatArray) -> Body:
    """The body that ten parameters describe.

    Args:
        link: in the order of LINK_PARAMETERS, with a positive mass, shape (10,).
    """
    mass = float(link[9])
    c = link[6:9] / mass
    return Body(mass, c, _symmetric(link[:6]) - mass * (c @ c * np.eye(3) - np.outer(c, c)))


def _symmetric(upper: FloatArray) -> FloatArray:
    out = np.zeros((3, 3))
    out[_ROWS, _COLUMNS] = upper
    return out + np.triu(out, 1).T
