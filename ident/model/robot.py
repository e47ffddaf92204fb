"""A robot: its joints, how its loops close, its motions and poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import (
    FloatArray,
    as_array,
    is_whole_number,
    require_entries,
    require_kind,
    require_names,
    require_number,
)
from ident.errors import ModelError


class JointKind(Enum):
    """One-degree-of-freedom joints."""

    REVOLUTE = "revolute"
    PRISMATIC = "prismatic"


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint and the link behind it."""

    name: str  #: as in the URDF
    kind: JointKind  #: revolute or prismatic
    parent: int  #: index of the joint before it, -1 for the base
    #: rotation of the joint frame in the parent's frame at position zero, (3, 3)
    rotation: FloatArray
    translation_m: FloatArray  #: its origin there, (3,)
    axis: FloatArray  #: unit vector of the motion in the joint frame, (3,)
    #: Distance from the lowest to the highest position that its description allows [rad or m]; None
    #: where it has no limits. Recorded positions that go far beyond it are in another unit.
    travel: float | None = None
    #: Lowest position that its description allows [rad or m]; None where it has no limits.
    lowest: float | None = None

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest position that its description allows; None where it has no limits."""
        if self.travel is None or self.lowest is None:
            return None
        return self.lowest, self.lowest + self.travel


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A frame fixed to the link behind a joint (-1: to the base), written in that joint's frame."""

    joint: int  #: index of the joint, -1 for the base
    rotation: FloatArray  #: of the frame in that joint's frame, (3, 3)
    translation_m: FloatArray  #: its origin there, (3,)


UNIT_TOLERANCE = 1e-6  #: Largest difference of the length of a joint's axis from one

#: Before the name of a closure in the name of its pivot
PIVOT_PREFIX = "pivot"

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""Directions in which a closure holds: along and about the axes of its first frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """A joint that closes a loop of the tree:
    two frames on two links that coincide in some directions.

    A ball joint coincides in x, y, z; a hinge about z in x, y, z, rx, ry; in a planar mechanism x,
    y are enough.
    """

    name: str  #: as the cell file has it
    first: Place  #: frame whose axes the directions are
    second: Place  #: frame that coincides with it
    directions: tuple[str, ...]  #: of DIRECTIONS; in the others the links move freely


@dataclass(frozen=True, slots=True)
class JointCoupling:
    """A joint without a motor that follows another one by a gear or a linkage:
    q = multiplier · q_leader + offset.
    """

    follower: int  #: index of the joint that follows
    leader: int  #: index of the joint that it follows, which follows none itself
    multiplier: float  #: [rad or m of the follower, per rad or m of the leader]
    offset: float  #: position of the follower where the leader is at zero [rad or m]


@dataclass(frozen=True, slots=True)
class Pivot:
    """A joint at which a loop is cut, and that turns about one axis; see `ident.model.pivots`."""

    closure: int  #: index of the closure among the robot's
    axis: int  #: axis of the closure's first frame that it turns about: 0, 1 or 2


@dataclass(frozen=True, slots=True)
class Robot:
    """A tree of n joints on a fixed base, in a closed chain with loop closures and joints without a
    motor.

    Joints without a motor may also follow others in a fixed ratio (`couplings`).
    """

    joints: tuple[Joint, ...]  #: depth first from the base
    #: in the base frame, shape (3,): of a base on a wall or a ceiling, it points another way
    gravity_m_s2: FloatArray
    closures: tuple[Closure, ...] = ()  #: none of a serial robot
    #: joint that each axis drives, in the order of the axes; empty: every joint is driven
    motors: tuple[int, ...] = ()
    #: Positions of all joints at which the closures hold: which of several ways of assembly is
    #: meant. Shape (n,).
    assembly_rad: FloatArray | None = None
    #: frame of the link that carries the payload; None: that of the last joint
    platform: Place | None = None
    #: Gravity before its direction was corrected, shape (3,); None where it was not.
    declared_gravity_m_s2: FloatArray | None = None
    #: Joints at which loops are cut, without those in which friction is the same as in a joint of
    #: the tree.
    pivots: tuple[Pivot, ...] = ()
    #: Joints that follow another one in a fixed ratio (`<mimic>` of a URDF).
    couplings: tuple[JointCoupling, ...] = ()

    @property
    def is_constrained(self) -> bool:
        """Whether joints depend on each other: loops close, or joints follow others."""
        return bool(self.closures or self.couplings)

    @property
    def joint_count(self) -> int:
        """n, passive joints included."""
        return len(self.joints)

    @property
    def carrier(self) -> int:
        """Index of the joint whose link carries the payload."""
        if self.platform is None:
            return self.joint_count - 1
        return self.platform.joint

    @property
    def mounting_m(self) -> FloatArray:
        """Where the payload is mounted, in the frame of the joint that carries it, shape (3,)."""
        if self.platform is None:
            return np.zeros(3)
        return self.platform.translation_m

    @property
    def axis_joints(self) -> tuple[int, ...]:
        """Joint of each axis."""
        if self.motors:
            return self.motors
        return tuple(range(len(self.joints)))

    @property
    def axes(self) -> tuple[Joint, ...]:
        """Driven joints, in the order of the axes: all of a serial robot."""
        return tuple(self.joints[joint] for joint in self.axis_joints)

    @property
    def passive_joints(self) -> tuple[int, ...]:
        """Joints without a motor: none of a serial robot."""
        return tuple(joint for joint in range(len(self.joints)) if joint not in self.axis_joints)

    @property
    def place_joints(self) -> tuple[int, ...]:
        """Joints at which an effect can act: those of the axes, then those without a motor.

        A follower is none: it turns as its leader does, so friction or a spring in it is one in its
        leader.
        """
        followers = {coupling.follower for coupling in self.couplings}
        passive = [joint for joint in self.passive_joints if joint not in followers]
        return (*self.axis_joints, *passive)

    @property
    def places(self) -> tuple[Joint, ...]:
        """Where an effect can act: the joints of `place_joints`,
        and the pivots that loops are cut at.
        """
        joints = [self.joints[joint] for joint in self.place_joints]
        pivots = [self._as_joint(pivot) for pivot in self.pivots]
        return (*joints, *pivots)

    def _as_joint(self, pivot: Pivot) -> Joint:
        """A pivot as a joint behind the link of its closure's first frame."""
        closure = self.closures[pivot.closure]
        first = closure.first
        return Joint(
            name=f"{PIVOT_PREFIX} {closure.name}",
            kind=JointKind.REVOLUTE,
            parent=first.joint,
            rotation=first.rotation,
            translation_m=first.translation_m,
            axis=np.eye(3)[pivot.axis],
        )

    @property
    def passive_names(self) -> tuple[str, ...]:
        """Names of the joints without a motor."""
        return tuple(self.joints[joint].name for joint in self.passive_joints)

    @property
    def pivot_names(self) -> tuple[str, ...]:
        """Names of the pivots, each after its closure."""
        return tuple(self._as_joint(pivot).name for pivot in self.pivots)

    @property
    def undriven_names(self) -> tuple[str, ...]:
        """Names of the places without a motor, in the order of `places`."""
        return tuple(place.name for place in self.places[self.axis_count :])

    @property
    def axis_count(self) -> int:
        """m: number of motors, and of the columns of a recording."""
        return len(self.axis_joints)


def require_described(robot: Robot) -> None:
    """Refuse a robot made by hand of which a part is not of the type or shape that is declared,
    or refers to one that the robot does not have.

    Whether its loops close is found later (`ident.model.closed_chain.assemble`).

    Raises:
        ModelError: a part is of another type or shape, no finite number, or has the index of a
            joint or closure that the robot does not have; a direction of a closure is none of
            DIRECTIONS; or a joint follows a follower.
    """
    _require_parts("joints", robot.joints, Joint)
    if not robot.joints:
        raise ModelError("the robot has no joint; expected at least one; read it from a URDF")
    for index, joint in enumerate(robot.joints):
        _require_joint(joint, index)
    as_array("gravity_m_s2", robot.gravity_m_s2, (3,), "in the base frame [m/s²]")
    count = robot.joint_count
    require_kind("motors of the robot", robot.motors, Sequence, "give a tuple of joints' indices")
    for motor in robot.motors:
        _require_index("an entry of motors", motor, count)
    for closure in _require_parts("closures", robot.closures, Closure):
        require_kind("name of a closure", closure.name, str, "give a text that names it")
        _require_place(f"first of closure {closure.name!r}", closure.first, count)
        _require_place(f"second of closure {closure.name!r}", closure.second, count)
        require_directions(closure.name, closure.directions)
    for coupling in _require_parts("couplings", robot.couplings, JointCoupling):
        _require_index("follower of a coupling", coupling.follower, count)
        _require_index("leader of a coupling", coupling.leader, count)
        require_number("multiplier of a coupling", coupling.multiplier)
        require_number("offset of a coupling", coupling.offset)
    _require_leaders(robot)
    _require_pivots(robot)
    if robot.assembly_rad is not None:
        as_array("assembly_rad", robot.assembly_rad, (count,), "one position per joint")
    if robot.platform is not None:
        _require_place("platform", robot.platform, count)


def require_directions(closure: str, directions: Sequence[str]) -> None:
    """Refuse directions of a closure that are not some of DIRECTIONS, each once, as a `ModelError`.

    Args:
        closure: its name.
        directions: in which its frames coincide.
    """
    source = f"closure {closure!r}"
    require_names(f"directions of {source}", directions)
    are_known = set(directions) <= set(DIRECTIONS)
    are_distinct = len(set(directions)) == len(directions)
    if not (directions and are_known and are_distinct):
        given = ", ".join(directions) or "none"
        known = ", ".join(DIRECTIONS)
        raise ModelError(
            f"{source} has the directions {given}; expected some of {known}, each once"
        )


def _require_leaders(robot: Robot) -> None:
    """Refuse a joint that follows a follower, as a `ModelError`."""
    followers = {coupling.follower for coupling in robot.couplings}
    for coupling in robot.couplings:
        if coupling.leader in followers:
            follower = robot.joints[coupling.follower].name
            leader = robot.joints[coupling.leader].name
            raise ModelError(
                f"joint {follower!r} follows {leader!r}, a follower itself; expected a leader that "
                "follows none; give the joint at the head, and the product of the multipliers"
            )


def _require_pivots(robot: Robot) -> None:
    """Refuse pivots of closures that the robot does not have, as a `ModelError`."""
    _require_parts("pivots", robot.pivots, Pivot)
    if robot.pivots and not robot.closures:
        raise ModelError(
            "the robot has a pivot and no closure; expected none; a pivot is where a loop is cut"
        )
    for pivot in robot.pivots:
        _require_index("closure of a pivot", pivot.closure, len(robot.closures), of="a closure")
        _require_index("axis of a pivot", pivot.axis, 3, of="an axis")


Part = TypeVar("Part")


def _require_parts(name: str, values: tuple[Part, ...], kind: type[Part]) -> tuple[Part, ...]:
    """Return the parts of a robot; refuse what is no list of them, as a `ModelError`."""
    remedy = f"give a tuple of {kind.__name__}, or read the robot from a URDF"
    require_kind(f"{name} of the robot", values, Sequence, remedy)
    require_entries(f"{name} of the robot", values, kind, remedy)
    return values


def _require_joint(joint: Joint, index: int) -> None:
    """Refuse a joint with a part of another type or shape, as a `ModelError`."""
    require_kind(f"name of joint {index}", joint.name, str, "give its name in the URDF")
    label = f"of joint {joint.name!r}"
    require_kind(f"kind {label}", joint.kind, JointKind, "write JointKind.REVOLUTE")
    # The joint before it has a lower index: poses are found in this order.
    _require_index(f"parent {label}", joint.parent, index, least=-1)
    as_array(f"rotation {label}", joint.rotation, (3, 3), "in the parent's frame")
    as_array(f"translation_m {label}", joint.translation_m, (3,), "in the parent's frame")
    axis = as_array(f"axis {label}", joint.axis, (3,), "in the joint's frame")
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise ModelError(
            f"axis {label} has the length {length:.6g}; expected a unit vector; divide it by that"
        )
    if joint.travel is not None:
        remedy = "leave it out without limits"
        require_number(f"travel {label}", joint.travel, above=0.0, remedy=remedy)
    if joint.lowest is not None:
        require_number(f"lowest {label}", joint.lowest, remedy="leave it out without limits")


def _require_place(label: str, place: Place, count: int) -> None:
    """Refuse a frame with a part of another type or shape, as a `ModelError`."""
    require_kind(label, place, Place, "write Place(joint, rotation, translation_m)")
    _require_index(f"joint of the {label}", place.joint, count, least=-1)
    as_array(f"rotation of the {label}", place.rotation, (3, 3), "in the joint's frame")
    as_array(f"translation_m of the {label}", place.translation_m, (3,), "in the joint's frame")


def _require_index(
    label: str, index: object, end: int, *, least: int = 0, of: str = "a joint"
) -> None:
    """Refuse an index that is not in [least, end), as a `ModelError`."""
    if is_whole_number(index) and least <= index < end:
        return
    expected = f"a whole number from {least} to {end - 1}"
    if end - least == 1:
        expected = f"{least}"
    raise ModelError(f"{label} is {index!r:.60}; expected {expected}; give the index of {of}")


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of n joints over k samples, arrays of shape (k, n) [rad; m for a prismatic joint].

    Lists and data frames will do for arrays.

    Raises:
        ModelError: one of them is no array of numbers.
    """

    position_rad: FloatArray  #: q
    velocity_rad_s: FloatArray  #: q̇, per s
    acceleration_rad_s2: FloatArray  #: q̈, per s²

    if (
        TYPE_CHECKING
    ):  # `__post_init__` takes whatever becomes an array, so type checkers must, too.

        def __init__(
            self, position_rad: ArrayLike, velocity_rad_s: ArrayLike, acceleration_rad_s2: ArrayLike
        ) -> None: ...

    def __post_init__(self) -> None:
        for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2"):
            value = getattr(self, name)
            if not isinstance(value, np.ndarray):
                object.__setattr__(self, name, as_array(f"{name} of the motion", value))


def each_state(motion: Motion, change: Callable[[FloatArray], FloatArray]) -> Motion:
    """Return a motion whose positions, velocities and accelerations are changed alike."""
    return Motion(
        position_rad=change(motion.position_rad),
        velocity_rad_s=change(motion.velocity_rad_s),
        acceleration_rad_s2=change(motion.acceleration_rad_s2),
    )


def at_rest(position_rad: FloatArray) -> Motion:
    """Return the motion of joints that stay at positions, shape (k, n)."""
    still = np.zeros_like(position_rad)
    return Motion(position_rad, still, still)


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of n + 1 frames in the base frame over k samples;
    frame 0 is the base, frame i + 1 moves with joint i.
    """

    rotation: FloatArray  #: shape (n + 1, k, 3, 3)
    origin_m: FloatArray  #: shape (n + 1, k, 3)


def poses(robot: Robot, position_rad: FloatArray) -> Poses:
    """Forward kinematics: find the pose of every joint's frame in the base.

    Args:
        robot: n joints.
        position_rad: of the joints [rad; m for a prismatic joint], shape (k, n).
    """
    samples, count = position_rad.shape
    rotation = np.empty((count + 1, samples, 3, 3))
    origin = np.empty((count + 1, samples, 3))
    rotation[0] = np.eye(3)
    origin[0] = 0.0
    in_parent = _rotations_in_parent(robot, position_rad)
    for index, joint in enumerate(robot.joints):
        before = joint.parent + 1
        here = index + 1
        parent = rotation[before]
        np.add(origin[before], parent @ joint.translation_m, out=origin[here])
        if joint.kind is JointKind.PRISMATIC:
            direction = parent @ (joint.rotation @ joint.axis)
            origin[here] += position_rad[:, index, None] * direction
        np.matmul(parent, in_parent[index], out=rotation[here])
    return Poses(rotation, origin)


def joints_to_base(robot: Robot, joint: int) -> Iterator[int]:
    """Yield a joint and those before it, down to the base; nothing for the base itself, -1."""
    while joint >= 0:
        yield joint
        joint = robot.joints[joint].parent


def _rotations_in_parent(robot: Robot, position_rad: FloatArray) -> FloatArray:
    """Rotation of each joint's frame in its parent's, shape (n, k, 3, 3).

    Rodrigues' formula for all joints at once, R = R₀ (a aᵀ + cos q (1 − a aᵀ) + sin q [a]), with
    [a] the matrix of a ×. A prismatic joint does not turn: its angle is zero.
    """
    joints = robot.joints
    axes = np.array([joint.axis for joint in joints])
    at_zero = np.array([joint.rotation for joint in joints])  # R₀
    is_revolute = np.array([joint.kind is JointKind.REVOLUTE for joint in joints])
    outer = axes[:, :, None] * axes[:, None]
    crosses = np.array([skew(axis) for axis in axes])
    across = np.eye(3) - outer
    terms = np.stack((outer, across, crosses), axis=1)
    terms_in_parent = at_zero[:, None] @ terms
    angle = position_rad.T * is_revolute[:, None]
    factors = np.stack((np.ones_like(angle), np.cos(angle), np.sin(angle)), axis=2)
    # (n, k, 3 terms) @ (n, 3 terms, 9) is (n, k, 9)
    rotations = factors @ terms_in_parent.reshape(-1, 3, 9)
    return np.asarray(rotations.reshape(*angle.shape, 3, 3))


def skew(vector: FloatArray) -> FloatArray:
    """Matrix of the cross product with a vector, shape (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turned_about(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Rotation by an angle about a unit vector, shape (3, 3): Rodrigues' formula."""
    cross = skew(axis)
    sine = np.sin(angle_rad)
    one_less_cosine = 1.0 - np.cos(angle_rad)
    return np.asarray(np.eye(3) + sine * cross + one_less_cosine * (cross @ cross))
