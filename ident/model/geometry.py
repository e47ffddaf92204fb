"""What a description may have wrong of a closed chain:
zeros of driven joints, lengths of links, places on the base.

A parameter is a number that the description gives; its change is what has to be added to that
number. The zero of a joint is added to all of its recorded positions (`zero_offset_deg` of the cell
file). A length is the distance from the origin of a link's joint to the next joint, or to the frame
that closes a loop, along the described direction. A place is a coordinate of a joint's origin on
the base.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.errors import ModelError
from ident.model.robot import Closure, Joint, JointKind, Place, Robot, skew

DIRECTIONS = ("x", "y", "z")  #: Axes of the base
#: Origins that are closer to each other have no direction along which to be wrong
SHORTEST_LENGTH_M = 1e-6


class GeometryKind(Enum):
    """What a number of the description is."""

    ZERO = "zero"  #: of a driven joint [rad; m of a prismatic joint]
    LENGTH = "length"  #: of a link, between two points of it [m]
    PLACE = "place"  #: coordinate of a joint on the base, in the axes of the base [m]
    #: of a joint's encoder behind the others [s], which is no number of the description
    DELAY = "delay"


@dataclass(frozen=True, slots=True)
class GeometryParameter:
    """One number of a robot's description."""

    kind: GeometryKind
    #: name of the joint: the one with the zero, on the base, or late, or the one that moves the
    #: link
    joint: str
    #: Of a length: name of the joint or of the closure at the other end of the link; of a place: x,
    #: y or z.
    end: str = ""

    @property
    def name(self) -> str:
        """Name for messages, as `zero of crank-1` or `length from crank-1 to elbow-1`."""
        match self.kind:
            case GeometryKind.ZERO:
                return f"zero of {self.joint}"
            case GeometryKind.LENGTH:
                return f"length from {self.joint} to {self.end}"
            case GeometryKind.PLACE:
                return f"{self.end} of {self.joint} on the base"
            case GeometryKind.DELAY:
                return f"delay of the encoder of {self.joint}"


@dataclass(frozen=True, slots=True)
class GeometryChange:
    """What has to be added to a number of the description."""

    parameter: GeometryParameter
    change: float  #: [rad or m]


def geometry_parameters(robot: Robot) -> tuple[GeometryParameter, ...]:
    """Return the zeros of all driven joints, in the order of the axes,
    then the lengths of all moving links.

    Of a length of zero there is no direction, and the places of joints on the base are no lengths.
    """
    zeros = [GeometryParameter(GeometryKind.ZERO, joint.name) for joint in robot.axes]
    return (*zeros, *_lengths(robot))


def base_places(robot: Robot) -> tuple[GeometryParameter, ...]:
    """Return the coordinates of all joints on the base."""
    on_base = [joint.name for joint in robot.joints if joint.parent < 0]
    found = []
    for name in on_base:
        for axis in DIRECTIONS:
            found.append(GeometryParameter(GeometryKind.PLACE, name, axis))
    return tuple(found)


def encoder_delays(robot: Robot) -> tuple[GeometryParameter, ...]:
    """Return the delays of the encoders, in the order of the axes;
    `with_geometry` knows none of them.
    """
    return tuple(GeometryParameter(GeometryKind.DELAY, joint.name) for joint in robot.axes)


def _lengths(robot: Robot) -> Iterator[GeometryParameter]:
    for joint in robot.joints:
        if joint.parent >= 0 and np.linalg.norm(joint.translation_m) > SHORTEST_LENGTH_M:
            yield GeometryParameter(
                GeometryKind.LENGTH, robot.joints[joint.parent].name, joint.name
            )
    for closure in robot.closures:
        for place in (closure.first, closure.second):
            if place.joint >= 0 and np.linalg.norm(place.translation_m) > SHORTEST_LENGTH_M:
                yield GeometryParameter(
                    GeometryKind.LENGTH, robot.joints[place.joint].name, closure.name
                )


def described_length(robot: Robot, parameter: GeometryParameter) -> float:
    """Return a length, or a place, as it is described [m].

    Raises:
        ModelError: the robot has no such link or joint.
    """
    if parameter in base_places(robot):
        joint = robot.joints[_joint_number(robot, parameter.joint)]
        return float(joint.translation_m[DIRECTIONS.index(parameter.end)])
    for joint in robot.joints:
        if _is_end(robot, parameter, joint.parent, joint.name):
            return float(np.linalg.norm(joint.translation_m))
    for closure in robot.closures:
        for place in (closure.first, closure.second):
            if _is_end(robot, parameter, place.joint, closure.name):
                return float(np.linalg.norm(place.translation_m))
    raise _unknown(robot, parameter)


def with_geometry(robot: Robot, changes: Iterable[GeometryChange]) -> Robot:
    """Return the robot with other zeros, lengths and places.

    Its joints' positions are those that are recorded, so a zero turns the frame of its joint.

    Args:
        robot: as it is described.
        changes: to add to the numbers of the description.

    Raises:
        ModelError: the robot has no such joint or link.
    """
    changed = robot
    known = {*geometry_parameters(robot), *base_places(robot)}
    for one in changes:
        if one.parameter not in known:
            raise _unknown(robot, one.parameter)
        match one.parameter.kind:
            case GeometryKind.ZERO:
                changed = _with_zero(changed, one.parameter.joint, one.change)
            case GeometryKind.PLACE:
                changed = _with_place(changed, one.parameter, one.change)
            case _:
                changed = _with_length(changed, one.parameter, one.change)
    return changed


def _unknown(robot: Robot, parameter: GeometryParameter) -> ModelError:
    known = (*geometry_parameters(robot), *base_places(robot))
    names = ", ".join(one.name for one in known)
    return ModelError(f"the robot has no {parameter.name}; expected one of: {names}")


def _joint_number(robot: Robot, name: str) -> int:
    return [joint.name for joint in robot.joints].index(name)


def _with_place(robot: Robot, parameter: GeometryParameter, change_m: float) -> Robot:
    number = _joint_number(robot, parameter.joint)
    joint = robot.joints[number]
    place_m = joint.translation_m.copy()
    place_m[DIRECTIONS.index(parameter.end)] += change_m
    moved = replace(joint, translation_m=place_m)
    return replace(robot, joints=(*robot.joints[:number], moved, *robot.joints[number + 1 :]))


def _with_zero(robot: Robot, name: str, change: float) -> Robot:
    number = _joint_number(robot, name)
    joint = robot.joints[number]
    if joint.kind is JointKind.REVOLUTE:
        moved = replace(joint, rotation=joint.rotation @ _turn(joint.axis, change))
    else:
        moved = replace(
            joint, translation_m=joint.translation_m + change * (joint.rotation @ joint.axis)
        )
    joints = (*robot.joints[:number], moved, *robot.joints[number + 1 :])
    pose = robot.assembly_rad
    if pose is not None:
        pose = pose.copy()
        pose[number] -= change
    return replace(robot, joints=joints, assembly_rad=pose)


def _turn(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Rotation by an angle about a unit vector, shape (3, 3): Rodrigues' formula."""
    cross = skew(axis)
    return np.asarray(
        np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * (cross @ cross)
    )


def _with_length(robot: Robot, parameter: GeometryParameter, change_m: float) -> Robot:
    joints = tuple(
        _moved_joint(joint, change_m)
        if _is_end(robot, parameter, joint.parent, joint.name)
        else joint
        for joint in robot.joints
    )
    closures = tuple(
        _moved_closure(robot, parameter, closure, change_m) for closure in robot.closures
    )
    return replace(robot, joints=joints, closures=closures)


def _is_end(robot: Robot, parameter: GeometryParameter, link: int, end: str) -> bool:
    """Whether a length leads from the joint of a link to this end."""
    return link >= 0 and (robot.joints[link].name, end) == (parameter.joint, parameter.end)


def _moved_joint(joint: Joint, change_m: float) -> Joint:
    return replace(joint, translation_m=_longer(joint.translation_m, change_m))


def _moved_closure(
    robot: Robot, parameter: GeometryParameter, closure: Closure, change_m: float
) -> Closure:
    ends: list[Place] = []
    for place in (closure.first, closure.second):
        if _is_end(robot, parameter, place.joint, closure.name):
            ends.append(replace(place, translation_m=_longer(place.translation_m, change_m)))
        else:
            ends.append(place)
    return replace(closure, first=ends[0], second=ends[1])


def _longer(vector_m: FloatArray, change_m: float) -> FloatArray:
    """Return a vector that is longer by some length."""
    length_m = float(np.linalg.norm(vector_m))
    return np.asarray(vector_m * (1.0 + change_m / length_m))
