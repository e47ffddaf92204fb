"""What is believed of the links where the data say nothing: the URDF's own inertias, or a ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.model.bodies import Body, pseudo_inertia
from ident.model.robot import read_urdf

FloatArray = NDArray[np.float64]

DEFAULT_MASS_KG = 1.0
"""Of a link of which the URDF says no mass."""
DEFAULT_RADIUS_M = 0.1
"""Of the solid ball that stands for a link whose inertia the URDF does not say, or says wrongly."""
_THINNEST = 1e-6
"""Smallest share of a ball's second moment that a link of the URDF may have in any direction: a rod or a plate passes,
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
    """Inertial parameters of the moving links of a URDF, bodies behind fixed joints included, shape (n, 10).

    Raises:
        ModelError: the text is no URDF.
    """
    return np.array([body.parameters for body in read_urdf(urdf).bodies])


def inertia_prior(urdf: str) -> InertiaPrior:
    """The URDF's inertias where they are those of a body; else a solid ball about the centre of mass.

    The ball has DEFAULT_RADIUS_M, and the URDF's mass and centre of mass; without a mass, DEFAULT_MASS_KG at the
    origin of the link frame.

    Raises:
        ModelError: the text is no URDF.
    """
    links = urdf_links(urdf)
    assumed = []
    for index, link in enumerate(links):
        mass = float(link[9])
        centre = link[6:9] / mass if mass > 0.0 else np.zeros(3)
        moment = 0.4 * DEFAULT_RADIUS_M**2 * np.eye(3)
        ball = Body(mass if mass > 0.0 else DEFAULT_MASS_KG, centre, (mass if mass > 0.0 else DEFAULT_MASS_KG) * moment)
        inside = np.linalg.inv(np.linalg.cholesky(pseudo_inertia(ball.parameters)))
        if np.linalg.eigvalsh(inside @ pseudo_inertia(link) @ inside.T)[0] < _THINNEST:
            links[index] = ball.parameters
            assumed.append(index)
    return InertiaPrior(links, tuple(assumed))
