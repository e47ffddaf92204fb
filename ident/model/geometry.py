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
from ident.model.model import Model
from ident.model.robot import Closure, Joint, JointKind, Place, Robot, turned_about

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
    places: list[GeometryParameter] = []
    for joint in robot.joints:
        if joint.parent < 0:
            places += [
                GeometryParameter(GeometryKind.PLACE, joint.name, axis) for axis in DIRECTIONS
            ]
    return tuple(places)


def encoder_delays(robot: Robot) -> tuple[GeometryParameter, ...]:
    """Return the delays of the encoders, in the order of the axes;
    `with_geometry` knows none of them.
    """
    return tuple(GeometryParameter(GeometryKind.DELAY, joint.name) for joint in robot.axes)


@dataclass(frozen=True, slots=True)
class _LinkEnd:
    """A point of a link, at which another joint or a closure is."""

    link: int  #: joint that moves the link, −1 for the base
    end: str  #: name of the other joint, or of the closure
    vector_m: FloatArray  #: from the origin of the link's joint, shape (3,)


def _link_ends(robot: Robot) -> Iterator[_LinkEnd]:
    """Points of all links: the joints behind them, then the frames that close loops."""
    for joint in robot.joints:
        yield _LinkEnd(joint.parent, joint.name, joint.translation_m)
    for closure in robot.closures:
        for place in (closure.first, closure.second):
            yield _LinkEnd(place.joint, closure.name, place.translation_m)


def _lengths(robot: Robot) -> Iterator[GeometryParameter]:
    """Lengths of the moving links."""
    for one in _link_ends(robot):
        length_m = np.linalg.norm(one.vector_m)
        if one.link >= 0 and length_m > SHORTEST_LENGTH_M:
            link = robot.joints[one.link].name
            yield GeometryParameter(GeometryKind.LENGTH, link, one.end)


def described_length(robot: Robot, parameter: GeometryParameter) -> float:
    """Return a length, or a place, as it is described [m].

    Raises:
        ModelError: the robot has no such link or joint.
    """
    if parameter in base_places(robot):
        number = _joint_number(robot, parameter.joint)
        direction = DIRECTIONS.index(parameter.end)
        place_m = robot.joints[number].translation_m
        return float(place_m[direction])
    for one in _link_ends(robot):
        if _is_end(robot, parameter, one.link, one.end):
            return float(np.linalg.norm(one.vector_m))
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
        parameter = one.parameter
        if parameter not in known:
            raise _unknown(robot, parameter)
        match parameter.kind:
            case GeometryKind.ZERO:
                changed = _with_zero(changed, parameter.joint, one.change)
            case GeometryKind.PLACE:
                changed = _with_place(changed, parameter, one.change)
            case _:
                changed = _with_length(changed, parameter, one.change)
    return changed


def model_with_geometry(model: Model, changes: Iterable[GeometryChange]) -> Model:
    """Return the model of a robot with other zeros, lengths and places.

    Raises:
        ModelError: the robot has no such joint or link, or its loops do not close with them.
    """
    return replace(model, robot=with_geometry(model.robot, changes))


def unit_of(model: Model, parameter: GeometryParameter) -> float:
    """Return the size to compare a change with: a radian, or the size of the robot [m]."""
    kinds = {joint.name: joint.kind for joint in model.robot.joints}
    is_zero = parameter.kind is GeometryKind.ZERO
    if is_zero and kinds[parameter.joint] is JointKind.REVOLUTE:
        return 1.0
    return model.assembly.size_m


def _unknown(robot: Robot, parameter: GeometryParameter) -> ModelError:
    """Error of a number that the description does not have."""
    known = (*geometry_parameters(robot), *base_places(robot))
    names = ", ".join(one.name for one in known)
    return ModelError(f"the robot has no {parameter.name}; expected one of: {names}")


def _joint_number(robot: Robot, name: str) -> int:
    """Index of a joint."""
    names = [joint.name for joint in robot.joints]
    return names.index(name)


def _with_joint(robot: Robot, number: int, joint: Joint) -> Robot:
    """The robot with another joint at an index."""
    joints = list(robot.joints)
    joints[number] = joint
    return replace(robot, joints=tuple(joints))


def _with_place(robot: Robot, parameter: GeometryParameter, change_m: float) -> Robot:
    """The robot with a joint elsewhere on the base."""
    number = _joint_number(robot, parameter.joint)
    joint = robot.joints[number]
    direction = DIRECTIONS.index(parameter.end)
    place_m = joint.translation_m.copy()
    place_m[direction] += change_m
    moved = replace(joint, translation_m=place_m)
    return _with_joint(robot, number, moved)


def _with_zero(robot: Robot, name: str, change: float) -> Robot:
    """The robot with another zero of a joint."""
    number = _joint_number(robot, name)
    joint = robot.joints[number]
    if joint.kind is JointKind.REVOLUTE:
        rotation = joint.rotation @ turned_about(joint.axis, change)
        moved = replace(joint, rotation=rotation)
    else:
        direction = joint.rotation @ joint.axis
        translation_m = joint.translation_m + change * direction
        moved = replace(joint, translation_m=translation_m)
    changed = _with_joint(robot, number, moved)
    if robot.assembly_rad is None:
        return changed
    pose_rad = robot.assembly_rad.copy()
    pose_rad[number] -= change
    return replace(changed, assembly_rad=pose_rad)


def _with_length(robot: Robot, parameter: GeometryParameter, change_m: float) -> Robot:
    """The robot with another length of a link."""
    joints: list[Joint] = []
    for joint in robot.joints:
        moved = joint
        if _is_end(robot, parameter, joint.parent, joint.name):
            translation_m = _longer(joint.translation_m, change_m)
            moved = replace(joint, translation_m=translation_m)
        joints.append(moved)
    closures = [_moved_closure(robot, parameter, closure, change_m) for closure in robot.closures]
    return replace(robot, joints=tuple(joints), closures=tuple(closures))


def _is_end(robot: Robot, parameter: GeometryParameter, link: int, end: str) -> bool:
    """Whether a length leads from the joint of a link to this end."""
    if link < 0:
        return False
    name = robot.joints[link].name
    return name == parameter.joint and end == parameter.end


def _moved_closure(
    robot: Robot, parameter: GeometryParameter, closure: Closure, change_m: float
) -> Closure:
    """A closure whose frames move with a length."""
    ends: list[Place] = []
    for place in (closure.first, closure.second):
        moved = place
        if _is_end(robot, parameter, place.joint, closure.name):
            translation_m = _longer(place.translation_m, change_m)
            moved = replace(place, translation_m=translation_m)
        ends.append(moved)
    first, second = ends
    return replace(closure, first=first, second=second)


def _longer(vector_m: FloatArray, change_m: float) -> FloatArray:
    """Return a vector that is longer by some length."""
    length_m = float(np.linalg.norm(vector_m))
    factor = 1.0 + change_m / length_m
    return np.asarray(vector_m * factor)
