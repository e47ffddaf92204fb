"""Bodies: the ten inertial parameters of a link or payload,
and the matrix that is positive definite for real ones.

With the inertia tensor I and the first moment h about the link frame's origin, and the mass m, the
pseudo-inertia is

    P = [ Σ   h ]        Σ = ½ tr(I)·1 − I = ∫ r rᵀ dm.
        [ hᵀ  m ],

P ≻ 0 holds for every distribution of positive mass that is not flat, and only then: m > 0, I about
the centre of mass ≻ 0 and the triangle inequality of its principal moments together (Wensing, Kim,
Slotine: Linear Matrix Inequalities for Physically Consistent Inertial Parameter Identification,
2018). For a plate, a rod or a point, P is singular, P ⪰ 0. P is linear in the ten parameters: a
linear matrix inequality.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from numbers import Real

import numpy as np

from ident.arrays import LARGEST_NUMBER, FloatArray, as_float, require_kind, require_no_flag
from ident.errors import ModelError

LOADED = "_loaded"
"""Suffix of the name of the part of a friction parameter that a payload adds
(`Model.friction_by_payload`).
"""
LINK_PARAMETERS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""Inertia about the link frame's origin, first moments, mass; a payload is a link too (§2.2)."""

LINK_UNITS = ("kg m²",) * 6 + ("kg m",) * 3 + ("kg",)
#: Largest negative eigenvalue that rounding in a drawing may give, as a share of the inertia's size
DRAWING_ROUNDING = 1e-3
_ROWS, _COLUMNS = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Payload:
    """A weighed body as it was mounted; each mounting has its own unknowns.

    Raises:
        ModelError: an argument is of another type, a name is not in LINK_PARAMETERS, a value is no
            finite number, the mass is not above zero, the tolerance is below zero, or no body has
            such an inertia.
    """

    name: str  #: of the body
    #: names one way of mounting it; runs that share it share their unknown parameters
    mounting: str
    #: Known inertial parameters by their names in LINK_PARAMETERS, in the frame of the joint that
    #: carries it (paper eq. 5, χ_kL); the weighed mass alone is {"m": 4.59}.
    known: dict[str, float] = field(default_factory=dict)
    #: Tolerance of the weighed mass [kg], a standard deviation; 0 where none is declared.
    #: σ of the gains does not contain it: `Calibration.payload_mass` says how far it changes each
    #: gain. σ of what `weigh` finds does.
    mass_tolerance_kg: float = 0.0

    def __post_init__(self) -> None:
        self._require_kinds()
        _require_link_names(self)
        _require_mass_tolerance(self)
        _require_finite(self)
        _require_mass_above_zero(self)
        _require_possible_inertia(self)

    def _require_kinds(self) -> None:
        """Refuse arguments of another type, all but the tolerance, as a `ModelError`."""
        example = "write Payload('disc', 'flange', {'m': 4.59})"
        require_kind("name of a payload", self.name, str, example)
        require_kind(f"mounting of payload {self.name!r}", self.mounting, str, example)
        require_kind("known", self.known, dict, "write its mass as {'m': 4.59}")
        remedy = "give numbers in SI units: {'m': 4.59}"
        for name, value in self.known.items():
            require_kind(f"known[{name!r}]", value, Real, remedy)
            require_no_flag(f"known[{name!r}]", value, remedy)

    @property
    def known_parameters(self) -> FloatArray:
        """χ_kL in the order of LINK_PARAMETERS, zero where unknown, shape (10,)."""
        values = [self.known.get(name, 0.0) for name in LINK_PARAMETERS]
        return np.array(values)


def _require_link_names(payload: Payload) -> None:
    """Refuse names that are not in LINK_PARAMETERS, as a `ModelError`."""
    foreign = sorted(set(payload.known) - set(LINK_PARAMETERS))
    if not foreign:
        return
    found = ", ".join(map(repr, foreign))
    expected = ", ".join(LINK_PARAMETERS)
    raise ModelError(
        f"payload {payload.name!r} has the known parameters {found}; expected names among "
        f"{expected}; write its mass as {{'m': 4.59}}"
    )


def _require_mass_tolerance(payload: Payload) -> None:
    """Refuse a tolerance that is no number, negative or not finite, as a `ModelError`."""
    remedy = "give kilograms, such as 0.01"
    require_kind("mass_tolerance_kg", payload.mass_tolerance_kg, Real, remedy)
    require_no_flag("mass_tolerance_kg", payload.mass_tolerance_kg, remedy)
    tolerance_kg = as_float(payload.mass_tolerance_kg)
    if not 0.0 <= tolerance_kg <= LARGEST_NUMBER:
        found = f"a mass tolerance of {tolerance_kg:g} kg"
        raise ModelError(
            f"payload {payload.name!r} has {found}; expected zero or more; give that of the scale"
        )


def _require_finite(payload: Payload) -> None:
    """Refuse values that are not finite or above LARGEST_NUMBER, as a `ModelError`."""
    too_large: list[str] = []
    are_finite = True
    for name, value in payload.known.items():
        size = abs(as_float(value))
        if not size <= LARGEST_NUMBER:
            too_large.append(f"{name} = {as_float(value):g}")
            if not isfinite(size):
                are_finite = False
    if not too_large:
        return
    found = ", ".join(too_large)
    expected = "finite numbers"
    if are_finite:
        expected = f"numbers of at most {LARGEST_NUMBER:g} in size"
    raise ModelError(
        f"payload {payload.name!r} has {found}; expected {expected}; leave out what is not known"
    )


def _require_mass_above_zero(payload: Payload) -> None:
    """Refuse a known mass that is not above zero, as a `ModelError`."""
    mass_kg = payload.known.get("m")
    # A negative mass would reverse the sign of every gain.
    if mass_kg is not None and not mass_kg > 0.0:
        raise ModelError(
            f"payload {payload.name!r} weighs {mass_kg:g} kg; expected its mass, above 0 kg; "
            "weigh it"
        )


def _require_possible_inertia(payload: Payload) -> None:
    """Refuse an inertia that no distribution of mass has, as far as it is known.

    A point, a rod and a plate are accepted.

    Raises:
        ModelError: the second moments Σ, or the pseudo-inertia where all ten parameters are known,
            have a negative eigenvalue; or a moment of inertia is negative.
    """
    known = payload.known
    moments = set(LINK_PARAMETERS[:6])
    if not moments <= set(known):
        _require_no_negative_moment(payload)
        return
    pseudo = pseudo_inertia(payload.known_parameters)
    second_moments = pseudo[:3, :3]
    judged = second_moments
    if set(known) == set(LINK_PARAMETERS):
        judged = pseudo
    # The sum of the eigenvalues' sizes: the trace for a body
    size = float(np.linalg.norm(second_moments, "nuc"))
    # The rows of the second moments and of the mass have other units: compare them at a common
    # size.
    scale = np.ones(len(judged))
    if size > 0.0:
        scale[:3] = np.sqrt(size)
    if judged is pseudo:
        scale[3] = np.sqrt(known["m"])
    scaled = judged / np.outer(scale, scale)
    eigenvalues = np.linalg.eigvalsh(scaled)
    smallest = float(eigenvalues[0])
    if smallest >= -DRAWING_ROUNDING:
        return
    values = [f"{name} = {known[name]:g}" for name in LINK_PARAMETERS if name in known]
    inertia = ", ".join(values)
    raise ModelError(
        f"payload {payload.name!r} has an inertia that no body has: {inertia} [kg m², kg m, kg]; "
        "expected one whose principal moments are positive, none above the sum of the others, "
        "about the joint's origin (Huygens-Steiner with mx, my, mz included); check signs and "
        "frame, or give the mass alone"
    )


def _require_no_negative_moment(payload: Payload) -> None:
    """Refuse a known moment of inertia that is negative, as a `ModelError`."""
    found: list[str] = []
    for name in ("Ixx", "Iyy", "Izz"):
        value = payload.known.get(name, 0.0)
        if value < 0.0:
            found.append(f"{name} = {value:g} kg m²")
    if found:
        negative = ", ".join(found)
        raise ModelError(
            f"payload {payload.name!r} has {negative}; expected moments of inertia of zero or more"
        )


def pseudo_inertia(link: FloatArray) -> FloatArray:
    """P of a link's parameters (LINK_PARAMETERS), (10,) → (4, 4) [kg m², kg m, kg]."""
    inertia = _symmetric(link[:6])
    first_moment = link[6:9]
    # Σ = ½ tr(I) 1 − I
    half_trace = 0.5 * np.trace(inertia)
    out = np.empty((4, 4))
    out[:3, :3] = half_trace * np.eye(3) - inertia
    out[:3, 3] = first_moment
    out[3, :3] = first_moment
    out[3, 3] = link[9]
    return out


def pseudo_factors(links: FloatArray) -> FloatArray:
    """Cholesky factor L of each link's pseudo-inertia, (n, 10) → (n, 4, 4)."""
    pseudo_inertias = np.array([pseudo_inertia(link) for link in links])
    return np.asarray(np.linalg.cholesky(pseudo_inertias))


def link_parameters(pseudo: FloatArray) -> FloatArray:
    """The inverse of `pseudo_inertia`, (4, 4) → (10,), for the symmetric part of the matrix."""
    symmetric = 0.5 * (pseudo + pseudo.T)
    second_moments = symmetric[:3, :3]
    first_moments = symmetric[:3, 3]
    inertia = np.trace(second_moments) * np.eye(3) - second_moments
    return _as_parameters(inertia, first_moments, symmetric[3, 3])


def _as_parameters(inertia: FloatArray, first_moment: FloatArray, mass: float) -> FloatArray:
    """Parameters of a link in the order of LINK_PARAMETERS, shape (10,)."""
    upper = inertia[_ROWS, _COLUMNS]
    return np.concatenate((upper, first_moment, (mass,)))


@dataclass(frozen=True, slots=True)
class Body:
    """Mass, centre and inertia of a link, as a URDF declares them."""

    mass_kg: float  #: of the link
    centre_m: FloatArray  #: centre of mass in the link frame, shape (3,)
    #: tensor about the centre of mass, axes of the link frame, shape (3, 3)
    inertia_kg_m2: FloatArray

    @property
    def parameters(self) -> FloatArray:
        """About the link frame's origin (Huygens-Steiner), as LINK_PARAMETERS, shape (10,)."""
        mass = self.mass_kg
        inertia = self.inertia_kg_m2 + mass * steiner(self.centre_m)
        return _as_parameters(inertia, mass * self.centre_m, mass)


def body_of(link: FloatArray) -> Body:
    """The body that ten parameters describe.

    Args:
        link: in the order of LINK_PARAMETERS, with a positive mass, shape (10,).
    """
    mass = float(link[9])
    centre_m = link[6:9] / mass
    about_origin = _symmetric(link[:6])
    inertia = about_origin - mass * steiner(centre_m)
    return Body(mass, centre_m, inertia)


def steiner(centre_m: FloatArray) -> FloatArray:
    """c · c 1 − c cᵀ, shape (3, 3): inertia of a unit mass at a point."""
    square = centre_m @ centre_m
    return np.asarray(square * np.eye(3) - np.outer(centre_m, centre_m))


def _symmetric(upper: FloatArray) -> FloatArray:
    """Symmetric matrix of its upper triangle, row by row, shape (6,) → (3, 3)."""
    out = np.zeros((3, 3))
    out[_ROWS, _COLUMNS] = upper
    lower = np.triu(out, 1).T
    return out + lower
