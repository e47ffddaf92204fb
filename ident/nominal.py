"""A robot as it may be expected to be before anything is identified: only to choose moves by, never to fit with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.excitation import ExpectedPayload
from ident.link import LINK_PARAMETERS
from ident.model import Model
from ident.motion import Motion
from ident.payload import Payload
from ident.pseudo_inertia import Body
from ident.robot import Robot, read_urdf

FloatArray = NDArray[np.float64]

LINK_MASS_KG = 5.0
"""Of each link where the URDF has no inertias, as a slender rod to the next joint."""
ROD_RADIUS_M = 0.05
STEEL_KG_M3 = 7850.0
DRY_FRICTION = 0.05
VISCOUS_FRICTION = 0.10
ROTOR = 0.03
"""Shares of a joint's torque limit: dry friction, viscous friction at its speed limit, rotor at its acceleration limit.
Of the size that geared arms have (paper, Table 3)."""
TORQUE_RESERVE = 3.0
"""Torque limit over the largest rigid-body torque, where the URDF gives none."""


def nominal_links(robot: Robot, urdf: str) -> tuple[FloatArray, bool]:
    """Inertial parameters of the links, shape (n, 10), and whether the URDF gave them.

    Args:
        robot: of this URDF.
        urdf: its text; where no link in it has a mass, rods of LINK_MASS_KG are assumed.
    """
    bodies = read_urdf(urdf).bodies
    if any(body.mass_kg > 0.0 for body in bodies):
        return np.array([body.parameters for body in bodies]), True
    links = []
    for index in range(robot.joint_count):
        ways = [joint.translation_m for joint in robot.joints if joint.parent == index]
        way = ways[0] if ways else 0.1 * robot.joints[index].axis
        slender = LINK_MASS_KG / 12.0 * (way @ way * np.eye(3) - np.outer(way, way))
        thick = 0.5 * LINK_MASS_KG * ROD_RADIUS_M**2 * np.eye(3)
        links.append(Body(LINK_MASS_KG, 0.5 * way, slender + thick).parameters)
    return np.array(links), False


def side_of_cube(mass_kg: float) -> float:
    """Of steel [m]."""
    return float((mass_kg / STEEL_KG_M3) ** (1.0 / 3.0))


def nominal_payload(robot: Robot, payload: Payload) -> ExpectedPayload:
    """A steel cube of the weighed mass, a side from the last joint's frame in every direction; what is known is kept.

    A body off the last axis is what a technician is asked to mount: on it, no gravity would act about that axis.
    """
    mass = payload.known.get("m", LINK_MASS_KG)
    side = side_of_cube(mass)
    axis = robot.joints[-1].axis
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    centre = side * (axis + 0.7 * across + 0.7 * np.cross(axis, across))
    cube = Body(mass, centre, mass * side**2 / 6.0 * np.eye(3))
    guess = dict(zip(LINK_PARAMETERS, cube.parameters, strict=True))
    parameters = np.array([payload.known.get(name, guess[name]) for name in LINK_PARAMETERS])
    return ExpectedPayload(frozenset(payload.known), parameters)


def nominal_torque_limits(model: Model, urdf: str, links: FloatArray, lively: Motion) -> FloatArray:
    """Of each joint [Nm or N], shape (n,): the URDF's effort limit, else TORQUE_RESERVE times what rigid links need.

    Args:
        model: the declared model.
        urdf: its text.
        links: inertial parameters with the payload on the last one, shape (n, 10).
        lively: motion as fast as the limits allow.
    """
    columns = model.regressor(lively)
    rigid = np.concatenate([columns[:, 14 * index : 14 * index + 10] for index in range(len(links))], axis=1)
    largest = np.abs(np.einsum("jck,c->jk", rigid, links.reshape(-1))).max(axis=1)
    declared = read_urdf(urdf).effort_limit
    usable = (declared > 0.0) & (declared < 1e6)  # some exporters write 0, others 1e9 for "not known"
    return np.where(usable, declared, TORQUE_RESERVE * np.maximum(largest, 1e-3))


def nominal_parameters(
    model: Model,
    links: FloatArray,
    torque_limit: FloatArray,
    velocity_limit: FloatArray,
    acceleration_limit: FloatArray,
) -> FloatArray:
    """Standard parameters of links and drives, shape (c,).

    Args:
        model: the declared model.
        links: shape (n, 10).
        torque_limit, velocity_limit, acceleration_limit: of the joints, shape (n,).
    """
    parameters = np.zeros(len(model.columns))
    for index, link in enumerate(links):
        first = 14 * index
        parameters[first : first + 10] = link
        parameters[first + 10] = ROTOR * torque_limit[index] / acceleration_limit[index]
        parameters[first + 11] = VISCOUS_FRICTION * torque_limit[index] / velocity_limit[index]
        parameters[first + 12] = DRY_FRICTION * torque_limit[index]
    for number, motor in enumerate(model.drive_train.coupled):
        first = 14 * len(links) + 3 * number
        parameters[first : first + 3] = parameters[14 * motor + 10 : 14 * motor + 13]
    return parameters
