"""Expected inertias of the links where the data do not determine them: the URDF's own, or those of a ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.model.bodies import Body, pseudo_inertia
from ident.model.robot import read_urdf

FloatArray = NDArray[np.float64]

DEFAULT_MASS_KG = 1.0
"""Mass of a link without one in the URDF."""
DEFAULT_RADIUS_M = 0.1
"""Radius of the solid ball assumed for a link whose inertia the URDF lacks or that cannot exist."""
_THINNEST = 1e-6
"""Smallest share of a ball's second moment that a link of the URDF may have in any direction: rods and plates pass,
rounding errors around zero do not."""


@dataclass(frozen=True, slots=True)
class InertiaPrior:
    """One body a joint, in the order of the robot's joints.

    Attributes:
        links: parameters in the order of LINK_PARAMETERS, shape (n, 10).
        assumed: numbers (from 0) of the links for which a ball was taken.
    """

    links: FloatArray
    assumed: tuple[int, ...]


def urdf_links(urdf: str) -> FloatArray:
    """Return inertial parameters of the moving links of a URDF with bodies behind fixed joints, shape (n, 10).

    Raises:
        ModelError: the text is no URDF.
    """
    return np.array([body.parameters for body in read_urdf(urdf).bodies])


def inertia_prior(urdf: str) -> InertiaPrior:
    """Take the URDF's inertias where a body can have them, else those of a solid ball about the centre of mass.

    The ball has DEFAULT_RADIUS_M, and the URDF's mass and centre of mass; without a mass, DEFAULT_MASS_KG at the
    origin of the link frame.

    Raises:
        ModelError: the text is no URDF.
    """
    links = urdf_links(urdf)
    assumed = []
    for index, link in enumerate(links):
        has_mass = float(link[9]) > 0.0
        mass = float(link[9]) if has_mass else DEFAULT_MASS_KG
        centre = link[6:9] / mass if has_mass else np.zeros(3)
        ball = Body(mass, centre, mass * (0.4 * DEFAULT_RADIUS_M**2 * np.eye(3)))
        inside = np.linalg.inv(np.linalg.cholesky(pseudo_inertia(ball.parameters)))
        if np.linalg.eigvalsh(inside @ pseudo_inertia(link) @ inside.T)[0] < _THINNEST:
            links[index] = ball.parameters
            assumed.append(index)
    return InertiaPrior(links, tuple(assumed))
