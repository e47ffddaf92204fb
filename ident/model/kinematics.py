"""Motions of the joints, and the poses of all joint frames that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.model.robot import JointKind, Robot


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of n joints over k samples, arrays of shape (k, n) [rad; m for a prismatic joint].

    Attributes:
        position_rad, velocity_rad_s, acceleration_rad_s2: of the joints.
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of n + 1 frames in the base frame over k samples; frame 0 is the base, frame i + 1 moves with joint i."""

    rotation: FloatArray  #: shape (n + 1, k, 3, 3)
    origin_m: FloatArray  #: shape (n + 1, k, 3)


def poses(robot: Robot, position_rad: FloatArray) -> Poses:
    """Forward kinematics.

    Args:
        robot: n joints.
        position_rad: of the joints [rad; m for a prismatic joint], shape (k, n).
    """
    samples, count = position_rad.shape
    rotation = np.empty((count + 1, samples, 3, 3))
    origin = np.empty((count + 1, samples, 3))
    rotation[0], origin[0] = np.eye(3), 0.0
    for index, joint in enumerate(robot.joints):
        parent = rotation[joint.parent + 1]
        offset = np.broadcast_to(joint.translation_m, (samples, 3))
        turn = np.broadcast_to(joint.rotation, (samples, 3, 3))
        if joint.kind is JointKind.PRISMATIC:
            offset = offset + position_rad[:, index, None] * (joint.rotation @ joint.axis)
        else:
            x, y, z = joint.axis  # Rodrigues' formula
            skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            angle, outer = position_rad[:, index, None, None], np.outer(joint.axis, joint.axis)
            turn = joint.rotation @ (outer + np.cos(angle) * (np.eye(3) - outer) + np.sin(angle) * skew)
        origin[index + 1] = origin[joint.parent + 1] + np.einsum("kij,kj->ki", parent, offset)
        rotation[index + 1] = parent @ turn
    return Poses(rotation, origin)
