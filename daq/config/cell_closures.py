"""Closed chains in a cell file: `closures`, and what `robot` says of motors,
platform and assembly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import radians
from typing import Annotated, Literal
from xml.etree import ElementTree

import numpy as np
from pydantic import Field

from daq.config.yaml_file import Fault, Name, StrictModel
from ident.errors import ModelError
from ident.model.closed_chain import assemble
from ident.model.robot import Joint, JointKind, Place, Robot
from ident.model.urdf import LinkPair, UrdfRobot, mimics_of, read_urdf, robot_from_urdf

Direction = Literal["x", "y", "z", "rx", "ry", "rz"]


class ClosureModel(StrictModel):
    """Two links of the URDF whose frames coincide: the joint that closes a loop."""

    name: Name  #: of the closure, in messages and effects
    first: Name  #: link of the URDF
    second: Name  #: link whose frame coincides with that of the first
    directions: Annotated[
        tuple[Direction, ...],
        Field(
            min_length=1,
            max_length=6,
            description="Along and about the axes of the first link's frame.",
        ),
    ]


STANDING = (0.0, 0.0, -9.81)
"""Gravity of a robot that stands on its base [m/s²]."""


class ChainModel(StrictModel):
    """Keys of a robot with closures, next to its URDF."""

    motors: Annotated[
        tuple[Name, ...],
        Field(description="Joint of each axis of a closed chain, in the order of the axes."),
    ] = ()
    platform: Annotated[Name | None, Field(description="Link that carries the payload.")] = None
    mobility: Annotated[
        int | None, Field(ge=1, le=32, description="Degrees of freedom of a closed chain.")
    ] = None
    assembly_deg: Annotated[
        Mapping[str, float],
        Field(description="Positions of the revolute joints at which the closures nearly hold."),
    ] = Field(default_factory=dict)
    assembly_mm: Annotated[
        Mapping[str, float], Field(description="The same of the prismatic joints.")
    ] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ClosedChain:
    """How the loops of a URDF's tree close, or which of its joints have motors where others follow
    them.
    """

    closures: tuple[LinkPair, ...]
    motors: tuple[str, ...]  #: joint of each axis, in the order of the axes
    platform: str | None  #: link that carries the payload; that of the last joint when None
    #: roughly, positions of all joints at which the closures hold [rad or m]
    assembly_rad: dict[str, float]
    #: Joints without a motor, in the order of the URDF's tree; not those that follow another one in
    #: a fixed ratio.
    passive_joints: tuple[Joint, ...]
    #: names of the joints that the loops are cut at and that turn about one axis
    pivots: tuple[str, ...] = ()

    @property
    def undriven_names(self) -> tuple[str, ...]:
        """Where an effect can act without a motor, in the order of `Robot.places`."""
        return (*(joint.name for joint in self.passive_joints), *self.pivots)


def chain_of(
    robot: ChainModel, closures: tuple[ClosureModel, ...], urdf: str
) -> ClosedChain | None:
    """Return the closed chain of a cell file, None of a serial robot whose every joint has a motor.

    Raises:
        ModelError: the URDF cannot be read.
    """
    if not closures:
        return _followed_chain(robot, urdf)
    revolute = {name: radians(position) for name, position in robot.assembly_deg.items()}
    prismatic = {name: 1e-3 * position for name, position in robot.assembly_mm.items()}
    pairs = [LinkPair(one.name, one.first, one.second, one.directions) for one in closures]
    joints = read_urdf(urdf).joints
    passive = [joint for joint in joints if joint.name not in robot.motors]
    chain = ClosedChain(
        closures=tuple(pairs),
        motors=robot.motors,
        platform=robot.platform,
        assembly_rad=revolute | prismatic,
        passive_joints=tuple(passive),
    )
    # Which closures are pivots does not depend on gravity.
    closed = robot_with(chain, urdf, STANDING)
    return replace(chain, pivots=closed.pivot_names)


def _followed_chain(robot: ChainModel, urdf: str) -> ClosedChain | None:
    """Return the chain of a robot without loops in which joints mimic axes; None if none does."""
    followers = mimics_of(urdf)
    if not followers:
        return None
    names = [joint.name for joint in read_urdf(urdf).joints]
    motors = tuple(name for name in names if name not in followers)
    return ClosedChain((), motors, robot.platform, {}, ())


def platform_frame(robot: ChainModel, urdf: str) -> Place:
    """Return the platform's frame, in which payloads are drawn,
    relative to the joint that carries it.

    Without a `platform`, that joint's own frame.

    Raises:
        ModelError: the URDF cannot be read.
    """
    if robot.platform is None:
        return Place(-1, np.eye(3), np.zeros(3))
    return read_urdf(urdf).links[robot.platform]


def robot_with(
    chain: ClosedChain | None,
    urdf: str,
    gravity_m_s2: tuple[float, float, float],
    platform: str | None = None,
) -> Robot:
    """Read a cell's robot.

    Args:
        chain: how its loops close, with the link that carries the payload; None of a serial robot.
        urdf: text of the URDF.
        gravity_m_s2: gravity in the base frame.
        platform: of a serial robot, the link that carries the payload; that of the last joint when
            None.

    Raises:
        ModelError: see `ident.model.urdf.robot_from_urdf`.
    """
    if chain is None:
        return robot_from_urdf(urdf, gravity_m_s2, platform=platform)
    return robot_from_urdf(
        urdf,
        gravity_m_s2,
        closures=chain.closures,
        motors=chain.motors,
        assembly_rad=chain.assembly_rad,
        platform=chain.platform,
    )


def chain_faults(
    robot: ChainModel, closures: tuple[ClosureModel, ...], urdf: str
) -> Iterator[Fault]:
    """Find a closed chain that is described by halves, does not close,
    or is not moved by its motors.

    Raises:
        ModelError: the URDF cannot be read.
    """
    given = [key for key in ChainModel.model_fields if getattr(robot, key)]
    if not closures:
        for key in given:
            if key != "platform":
                yield Fault(
                    ("robot", key), "given without `closures`", "no such key in a serial robot"
                )
        yield from _carrier_faults(robot, urdf)
        return
    for key, what in (
        ("motors", "the joint of each axis"),
        ("mobility", "the maker's degrees of freedom"),
    ):
        if key not in given:
            yield Fault(("robot", key), "missing", what)
    tree = read_urdf(urdf)
    unknown = [*_unknown_names(robot, closures, tree)]
    yield from unknown
    kinds = {joint.name: joint.kind for joint in tree.joints}
    for key, kind in (("assembly_deg", JointKind.REVOLUTE), ("assembly_mm", JointKind.PRISMATIC)):
        for name in getattr(robot, key):
            if kinds.get(name, kind) is not kind:
                found = f"joint {name}, which is {kinds[name].value}"
                yield Fault(("robot", key, name), found, f"a {kind.value} joint")
    if {"motors", "mobility"} <= set(given) and not unknown:
        try:
            chain = chain_of(robot, closures, urdf)
            assemble(robot_with(chain, urdf, STANDING), robot.mobility)
        except ModelError as error:
            found, _, expected = str(error).partition("; expected ")
            yield Fault(
                ("closures",),
                found,
                expected or "a mechanism that closes, and that its motors move",
            )


def _carrier_faults(robot: ChainModel, urdf: str) -> Iterator[Fault]:
    """Find a link of a serial robot that cannot carry the payload."""
    if robot.platform is None:
        return
    links = read_urdf(urdf).links
    moving = [name for name, place in links.items() if place.joint >= 0]
    if robot.platform not in moving:
        found = f"{robot.platform!r}"
        if robot.platform in links:
            found += ", which does not move"
        known = ", ".join(moving)
        yield Fault(("robot", "platform"), found, f"a link that moves: {known}")


def mechanism_faults(closures: tuple[ClosureModel, ...], urdf: str) -> Iterator[Fault]:
    """Find closures that are there twice, and joints of a closed chain that follow another one by
    the URDF.

    The equations of a closed chain do not read `<mimic>`; a second closure of the same frames only
    costs rank.
    """
    yield from _repeated(closures)
    try:
        if closures:
            joints = ElementTree.fromstring(urdf).findall("{*}joint")
        else:
            joints = []
    except ElementTree.ParseError:
        return  # the check of the robot says so
    for joint in joints:
        leader = joint.find("{*}mimic")
        if leader is not None and joint.get("type") != "fixed":
            name = joint.get("name")
            leader_name = leader.get("joint")
            found = f"joint {name} mimics {leader_name} in the URDF"
            yield Fault(
                ("robot", "urdf"),
                found,
                "no <mimic>: describe the mechanism that couples them in `closures`",
            )


def _repeated(closures: tuple[ClosureModel, ...]) -> Iterator[Fault]:
    """Find closures of the same links in the same directions."""
    seen: dict[object, str] = {}
    for index, one in enumerate(closures):
        key = frozenset((one.first, one.second)), frozenset(one.directions)
        if key in seen:
            found = f"{one.name}, which closes {one.first} and {one.second} as {seen[key]} does"
            yield Fault(("closures", index), found, "each closure once")
        seen.setdefault(key, one.name)


def _unknown_names(
    robot: ChainModel, closures: tuple[ClosureModel, ...], tree: UrdfRobot
) -> Iterator[Fault]:
    """Find names of joints and links that the URDF lacks."""
    joints = [joint.name for joint in tree.joints]
    a_joint = f"a joint of the URDF that moves: {', '.join(joints)}"
    a_link = f"a link of the URDF: {', '.join(tree.links)}"
    for index, name in enumerate(robot.motors):
        if name not in joints:
            yield Fault(("robot", "motors", index), f"{name!r}", a_joint)
    for key in ("assembly_deg", "assembly_mm"):
        for name in getattr(robot, key):
            if name not in joints:
                yield Fault(("robot", key, name), "no such joint", a_joint)
    if robot.platform is not None and robot.platform not in tree.links:
        yield Fault(("robot", "platform"), f"{robot.platform!r}", a_link)
    for index, one in enumerate(closures):
        for end in ("first", "second"):
            name = getattr(one, end)
            if name not in tree.links:
                yield Fault(("closures", index, end), f"{name!r}", a_link)
