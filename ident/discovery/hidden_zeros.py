"""Why recordings do not show the zero of a joint: no moves could, or these do not."""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.alike_corrections import axes_before
from ident.model.robot import JointKind, Robot, joints_to_base

UPRIGHT = 0.1
"""Largest sine of the angle between an axis and gravity, 6°, at which the axis counts as vertical:
a zero that is off by 2° turns gravity by a tenth of that at most.
"""


class ZeroHiddenBy(Enum):
    """What hides the zero of a joint."""

    #: another zero turns the whole arm about a vertical axis, or shifts it: all torques stay
    SYMMETRY = "symmetry"
    #: no joint is behind it, so another zero is another body of unknown mass and centre
    LAST_LINK = "last link"
    MOVES = "moves"  #: nothing but these moves


def zero_hidden_by(robot: Robot, axis: int) -> ZeroHiddenBy:
    """Tell what hides the zero of an axis that recordings do not show.

    Args:
        robot: a serial robot, or a tree.
        axis: number of the axis.
    """
    if _is_symmetry(robot, axis):
        return ZeroHiddenBy.SYMMETRY
    number = robot.axis_joints[axis]
    if not any(joint.parent == number for joint in robot.joints):
        return ZeroHiddenBy.LAST_LINK
    return ZeroHiddenBy.MOVES


def _is_symmetry(robot: Robot, axis: int) -> bool:
    """Whether another zero moves the whole arm in a way that no torque depends on."""
    before = [robot.axes[other] for other in axes_before(axis, robot)]
    if any(joint.kind is JointKind.REVOLUTE for joint in before):
        return False
    if robot.axes[axis].kind is JointKind.PRISMATIC:
        return True
    # Slides before it keep its direction; the whole arm turns with it where they run along it.
    return all(_is_upright(robot, other) for other in (axis, *axes_before(axis, robot)))


def _is_upright(robot: Robot, axis: int) -> bool:
    """Whether an axis that no joint turns is along gravity."""
    gravity = robot.gravity_m_s2
    size = float(np.linalg.norm(gravity))
    direction = _direction(robot, robot.axis_joints[axis])
    return float(np.linalg.norm(np.cross(direction, gravity))) <= UPRIGHT * size


def _direction(robot: Robot, number: int) -> FloatArray:
    """Direction of a joint's axis in the base frame at position zero, shape (3,)."""
    direction = robot.joints[number].axis
    for joint in joints_to_base(robot, number):
        direction = robot.joints[joint].rotation @ direction
    return np.asarray(direction)
