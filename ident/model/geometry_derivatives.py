"""Derivative of the axes' torques with respect to a number of a closed chain's description.

A robot with as many motors as degrees of freedom shows a wrong zero or length in its torques alone.
In them it acts through everything: the way of all passive joints, their velocities and
accelerations, and the leverage of each torque.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.model.geometry import GeometryChange, GeometryKind, GeometryParameter, with_geometry
from ident.model.model import Model
from ident.model.robot import JointKind, Motion

STEP = 1e-4
"""Step of the central differences [rad, or of the robot's size]: the error of their second order is
some 1e-8 of the torque, and rounding in poses that are closed to 1e-12 is as small.
"""


def model_with_geometry(model: Model, changes: Iterable[GeometryChange]) -> Model:
    """Return the model of a robot with other zeros, lengths and places.

    Raises:
        ModelError: the robot has no such joint or link, or its loops do not close with them.
    """
    return replace(model, robot=with_geometry(model.robot, changes))


def torque_derivative(
    model: Model,
    motion: Motion,
    standard: FloatArray,
    parameter: GeometryParameter,
    step: float | None = None,
) -> FloatArray:
    """Return the change of the axes' torques per unit of a zero or a length,
    at the recorded positions.

    It is the torque that the corrected robot needs less the one that the described robot needs, for
    the same recorded motion, by central differences of `Model.torques`. For a column of the effects
    at a declared robot, use it as it is; torques of a redundant drive are without preload.

    Args:
        model: with the described geometry.
        motion: of m axes over k samples.
        standard: χ_st, shape (c,).
        parameter: of `ident.model.geometry.geometry_parameters`.
        step: of the differences [rad or m]; STEP when None.

    Returns:
        shape (m, k) [Nm/rad or Nm/m; N for Nm of a prismatic axis].

    Raises:
        ModelError: the robot has no such joint or link, or its loops cannot be closed with the
            geometry a step away.
    """
    if step is None:
        step = STEP * unit_of(model, parameter)
    ahead = _torque(model, motion, standard, GeometryChange(parameter, step))
    behind = _torque(model, motion, standard, GeometryChange(parameter, -step))
    return np.asarray((ahead - behind) / (2.0 * step))


def unit_of(model: Model, parameter: GeometryParameter) -> float:
    """Return the size to compare a change with: a radian, or the size of the robot [m]."""
    kinds = {joint.name: joint.kind for joint in model.robot.joints}
    is_zero = parameter.kind is GeometryKind.ZERO
    if is_zero and kinds[parameter.joint] is JointKind.REVOLUTE:
        return 1.0
    return model.assembly.size_m


def _torque(
    model: Model, motion: Motion, standard: FloatArray, change: GeometryChange
) -> FloatArray:
    """Torque at each axis of a robot with another geometry [Nm or N], shape (m, k)."""
    changed = model_with_geometry(model, (change,))
    _, _, torque = changed.torques(motion, standard)
    return torque
