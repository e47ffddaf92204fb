"""Reading a URDF: the joint tree for identification,
bodies and effort limits for the planner and the prior.

The reader takes from a URDF what identification needs and skips the rest (meshes, transmissions,
plugins). Joints are ordered and merged as Pinocchio does it, which the tests compare with: depth
first, branches in the order of their joints' names, fixed joints merged into the moving joint
before them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, inf, isfinite, nan, sin, sqrt
from os import PathLike
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from ident.arrays import (
    LARGEST_NUMBER,
    FloatArray,
    as_array,
    require_entries,
    require_kind,
    require_names,
    require_number,
    takes,
)
from ident.errors import ModelError
from ident.model.bodies import Body, steiner
from ident.model.pivots import cut_pivots
from ident.model.robot import (
    Closure,
    Joint,
    JointCoupling,
    JointKind,
    Place,
    Robot,
    poses,
    require_directions,
)

SAME_POSITION = 1e-3  #: Largest difference of two statements of one position [rad or m]
FOLLOWS_BY_ITSELF = "no `hold` of it: a joint that mimics an axis is read as one that follows it"
"""What to do about a held joint that follows an axis."""
XACRO_SPACES = (
    "{http://www.ros.org/wiki/xacro}",
    "{http://ros.org/wiki/xacro}",
    "{http://wiki.ros.org/xacro}",
)
"""Namespaces of xacro, as its files name them."""
XACRO_EXPRESSION = "${"
UNBOUND_PREFIX = "unbound prefix"  #: Of the parser's message
LARGEST_DISTANCE_M = 50.0  #: Between joints that follow each other: more than any gantry has
#: Of a link: beyond these a number is noise of an export, whatever its unit, and products overflow
LEAST_MASS = 1e-9
LARGEST_MASS = 1e9
LARGEST_INERTIA = 1e15
#: Of a joint that follows another one: a rack has 1e3 rad/m, a fine screw 1e-5 m/rad
LEAST_MULTIPLIER = 1e-9
LARGEST_MULTIPLIER = 1e6
LARGEST_OFFSET = 1e6  #: [rad or m]; likewise


@dataclass(frozen=True, slots=True, eq=False)
class UrdfRobot:
    """The n moving joints of a URDF."""

    joints: tuple[Joint, ...]  #: their geometry, depth first from the base
    #: What each joint moves, in its frame, links behind fixed joints included; mass zero where none
    #: is given.
    bodies: tuple[Body, ...]
    effort_limit: FloatArray  #: [Nm or N], shape (n,); inf where none is given
    links: Mapping[str, Place]  #: frame of every link of the URDF, by name


@dataclass(frozen=True, slots=True)
class LinkPair:
    """Two links of a URDF whose frames coincide in some directions: a joint that closes a loop.

    A URDF describes a tree; a link on a fixed joint gives each end of the closure its frame.
    """

    name: str  #: of the closure
    first: str  #: link
    second: str  #: link
    #: of ident.model.robot.DIRECTIONS, along and about the axes of the first link
    directions: tuple[str, ...]


WRITE_CLOSURE = "write LinkPair(name, first, second, directions)"


@takes()
def robot_from_urdf(
    urdf: str,
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81),
    *,
    closures: Sequence[LinkPair] = (),
    motors: Sequence[str] = (),
    assembly_rad: Mapping[str, float] | None = None,
    platform: str | None = None,
) -> Robot:
    """Read the kinematic tree of a URDF, and close its loops.

    A joint with `<mimic>` is no axis: it follows the joint that it names, and what its link weighs
    loads that axis.

    Args:
        urdf: text of the URDF; fixed joints are merged into their parents, inertias are not used.
        gravity_m_s2: gravity in the base frame.
        closures: which links coincide; none of a serial robot.
        motors: joint of each axis of a closed chain, in the order of the axes. Without closures,
            every joint that follows none has a motor.
        assembly_rad: roughly, the position of every joint at which the closures hold [rad; m of a
            prismatic joint]; joints that are not named are at 0.
        platform: link that carries the payload; that of the last joint when None.

    Raises:
        ModelError: the text is no URDF, has no moving joint, or one of more than one degree of
            freedom; a closure, motor, assembly pose or platform names what it does not have; a
            joint mimics one that does not move, or itself, or is in a closed chain.
    """
    found = read_urdf(urdf)
    gravity = as_array("gravity_m_s2", gravity_m_s2, (3,), "in the base frame [m/s²]")
    require_entries("closures", closures, LinkPair, WRITE_CLOSURE)
    require_names("motors", motors)
    if assembly_rad is None:
        assembly_rad = {}
    require_kind("assembly_rad", assembly_rad, Mapping, "write {'joint': 0.5}")
    require_names("assembly_rad", list(assembly_rad))
    for joint_name, position in assembly_rad.items():
        remedy = "give its position in rad, or m"
        require_number(f"assembly_rad[{joint_name!r}]", position, remedy=remedy)
    if platform is not None:
        require_kind("platform", platform, str, "give the name of a link")
    index = {joint.name: number for number, joint in enumerate(found.joints)}
    couplings = _couplings(mimics_of(urdf), index)
    if couplings and closures:
        follower = found.joints[couplings[0].follower].name
        raise ModelError(
            f"joint {follower!r} has <mimic>, and the robot has closures; expected one of the two: "
            "delete <mimic>, and describe what couples the joint as a closure"
        )
    _require_joints("the list of motors", motors, index)
    _require_joints("the assembly pose", assembly_rad, index)
    closed = tuple(_closure(found, pair) for pair in closures)
    carrier = None
    if platform is not None:
        carrier = _place_of(found, platform, "the platform")
        if carrier.joint < 0:
            raise ModelError(
                f"the platform {platform!r} does not move; expected the link that "
                "carries the payload"
            )
    driven = tuple(index[name] for name in motors)
    if couplings and not driven:
        followers = {coupling.follower for coupling in couplings}
        driven = tuple(number for number in index.values() if number not in followers)
    robot = Robot(
        joints=found.joints,
        gravity_m_s2=gravity,
        closures=closed,
        motors=driven,
        platform=carrier,
        couplings=couplings,
    )
    if not robot.is_constrained:
        return robot
    pose = [assembly_rad.get(joint.name, 0.0) for joint in found.joints]
    robot = replace(robot, assembly_rad=np.array(pose))
    if not closed:
        return robot
    return replace(robot, pivots=cut_pivots(robot))


def _require_joints(source: str, names: Iterable[str], joints: Mapping[str, int]) -> None:
    """Refuse names of joints that the URDF does not have.

    Raises:
        ModelError: one is not among the moving joints.
    """
    for name in names:
        if name not in joints:
            raise ModelError(
                f"{source} names joint {name!r}; expected one of the URDF's moving joints: "
                f"{', '.join(joints)}"
            )


def _place_of(found: UrdfRobot, link: str, source: str) -> Place:
    """Frame of a link.

    Raises:
        ModelError: the URDF does not have it.
    """
    if link not in found.links:
        names = ", ".join(sorted(found.links))
        raise ModelError(f"{source} names link {link!r}; the URDF has the links {names}")
    return found.links[link]


def _closure(found: UrdfRobot, pair: LinkPair) -> Closure:
    """Read a closure.

    Raises:
        ModelError: it has a link that the URDF does not have, or unknown directions.
    """
    require_kind("name of a closure", pair.name, str, WRITE_CLOSURE)
    source = f"closure {pair.name!r}"
    require_kind(f"first link of {source}", pair.first, str, WRITE_CLOSURE)
    require_kind(f"second link of {source}", pair.second, str, WRITE_CLOSURE)
    require_directions(pair.name, pair.directions)
    first = _place_of(found, pair.first, source)
    second = _place_of(found, pair.second, source)
    return Closure(name=pair.name, first=first, second=second, directions=tuple(pair.directions))


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint that follows another one, `<mimic>`: q = multiplier · q_leader + offset."""

    leader: str  #: name of the joint that it follows
    multiplier: float
    offset: float  #: [rad or m]

    @property
    def at_rest(self) -> bool:
        """Whether it stays at its offset, wherever the leader is."""
        return self.multiplier == 0.0


def hold_joints(urdf: str, position_rad: Mapping[str, float]) -> str:
    """Return a URDF in which joints that are no axes of the arm (a gripper's, a mobile base's)
    are fixed.

    Args:
        urdf: text of the URDF.
        position_rad: position of each held joint [rad; m for a prismatic joint], by name. A joint
            that mimics a held one, directly or through others, follows it. Joints of type floating
            and planar can only be held at 0.

    Raises:
        ModelError: the text is no URDF, a name is no movable joint, or a joint cannot be held
            there: it mimics one that moves, or one by which it is elsewhere.
    """
    robot = _root(urdf)
    movable = _movable(robot)
    for name in position_rad:
        if name not in movable:
            raise ModelError(
                f"no movable joint {name!r} in the URDF; expected one of {', '.join(movable)}"
            )
    mimics = _mimics(movable)
    followed = _followed(mimics, position_rad)
    for name, position in position_rad.items():
        _require_free(name, position, mimics, followed, movable)
    positions = {**followed, **position_rad}
    for name, position in positions.items():
        _fix(movable[name], position)
    return tostring(robot, encoding="unicode")


def mimics_of(urdf: str) -> dict[str, Mimic]:
    """Return the joints of a URDF that move and mimic another one, by name.

    Raises:
        ModelError: the text is no URDF, or a multiplier or an offset is no number, or one that no
            mechanism has.
    """
    robot = _root(urdf)
    return _mimics(_movable(robot))


def _movable(robot: Element) -> dict[str, Element]:
    """Joints that are not fixed, by name."""
    movable: dict[str, Element] = {}
    for joint in robot.findall("joint"):
        if joint.get("type") != "fixed":
            movable[_name(joint)] = joint
    return movable


def first_leader(name: str, mimics: Mapping[str, Mimic]) -> Mimic:
    """Return how a joint follows the joint at the head of its chain of followers.

    Args:
        name: of a joint that mimics another one.
        mimics: of the URDF (`mimics_of`).

    Raises:
        ModelError: the chain leads back to one of its joints, or multiplies to a number that no
            mechanism has.
    """
    seen = {name}
    found = mimics[name]
    while found.leader in mimics:
        if found.leader in seen:
            raise ModelError(
                f"joint {name!r} mimics {mimics[name].leader!r}, which follows it in turn; "
                "expected a joint at the head that mimics none"
            )
        seen.add(found.leader)
        before = mimics[found.leader]
        # q = a (b q_leader + c) + d
        multiplier = found.multiplier * before.multiplier
        offset = found.multiplier * before.offset + found.offset
        found = Mimic(leader=before.leader, multiplier=multiplier, offset=offset)
        _require_mechanism(name, found)
    return found


def _couplings(mimics: Mapping[str, Mimic], index: Mapping[str, int]) -> tuple[JointCoupling, ...]:
    """Return how each follower depends on a joint that follows none."""
    couplings: list[JointCoupling] = []
    for name in mimics:
        mimic = first_leader(name, mimics)
        if mimic.leader not in index:
            leaders = [joint for joint in index if joint not in mimics]
            moving = ", ".join(leaders) or "none"
            raise ModelError(
                f"joint {name!r} mimics {mimic.leader!r}, which is no joint of the URDF that "
                f"moves; expected one of {moving}; hold {name!r} where it stays (`hold_joints`)"
            )
        coupling = JointCoupling(
            follower=index[name],
            leader=index[mimic.leader],
            multiplier=mimic.multiplier,
            offset=mimic.offset,
        )
        couplings.append(coupling)
    return tuple(couplings)


def _mimics(movable: Mapping[str, Element]) -> dict[str, Mimic]:
    """What each of some joints follows, by its name; without those that follow none."""
    found: dict[str, Mimic] = {}
    for name, joint in movable.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        multiplier = _finite(mimic.get("multiplier", "1"))
        offset = _finite(mimic.get("offset", "0"))
        if multiplier is None or offset is None:
            raise ModelError(
                f"<mimic> of {name!r} in the URDF has a multiplier or offset that is no number"
            )
        follows = Mimic(mimic.get("joint", ""), multiplier, offset)
        _require_mechanism(name, follows)
        found[name] = follows
    return found


def _require_mechanism(name: str, mimic: Mimic) -> None:
    """Refuse a follower that no mechanism moves so: positions and torques of it would overflow."""
    size = abs(mimic.multiplier)
    if not mimic.at_rest and not LEAST_MULTIPLIER <= size <= LARGEST_MULTIPLIER:
        raise ModelError(
            f"joint {name!r} mimics joint {mimic.leader!r} with the multiplier "
            f"{mimic.multiplier:g}; expected a size of {LEAST_MULTIPLIER:g} to "
            f"{LARGEST_MULTIPLIER:g}: correct <mimic> of {name!r}"
        )
    if abs(mimic.offset) > LARGEST_OFFSET:
        raise ModelError(
            f"joint {name!r} mimics joint {mimic.leader!r} with the offset {mimic.offset:g}; "
            f"expected at most {LARGEST_OFFSET:g} rad or m: correct <mimic> of {name!r}"
        )


def _followed(mimics: Mapping[str, Mimic], position_rad: Mapping[str, float]) -> dict[str, float]:
    """Return the position of every joint that follows held ones,
    through any number of others [rad or m].
    """
    followed: dict[str, float] = {}
    for _ in mimics:  # a chain is no longer than the number of its followers
        for name, mimic in mimics.items():
            leader = followed.get(mimic.leader, position_rad.get(mimic.leader))
            if leader is not None:
                followed[name] = mimic.multiplier * leader + mimic.offset
    return followed


def _require_free(
    name: str,
    position: float,
    mimics: Mapping[str, Mimic],
    followed: Mapping[str, float],
    movable: Mapping[str, Element],
) -> None:
    """Refuse to hold a joint that another one moves, or holds elsewhere."""
    mimic = mimics.get(name)
    if mimic is None:
        return
    elsewhere = followed.get(name)
    if mimic.at_rest:
        elsewhere = mimic.offset
    if elsewhere is not None:
        if not np.isclose(position, elsewhere, rtol=0.0, atol=SAME_POSITION):
            raise ModelError(
                f"joint {name!r} is held at {position:g} and mimics joint {mimic.leader!r}, by "
                f"which it is at {elsewhere:g}; expected the same position [rad or m], or `hold` "
                "of one of the two"
            )
    elif mimic.leader in movable:
        raise ModelError(
            f"joint {name!r} mimics joint {mimic.leader!r} (multiplier {mimic.multiplier:g}), "
            f"which moves: it follows and cannot be held; expected {FOLLOWS_BY_ITSELF}"
        )


def _fix(element: Element, position: float) -> None:
    """Make a joint a fixed one whose origin is its pose at a position."""
    name = _name(element)
    kind = element.get("type")
    rotation, translation = _origin(element, name)
    if kind not in ("floating", "planar"):
        joint = _joint(element, Place(-1, rotation, translation))
        robot = Robot((joint,), np.zeros(3))
        placed = poses(robot, np.array([[position]]))
        rotation = placed.rotation[1, 0]
        translation = placed.origin_m[1, 0]
    elif position != 0.0:
        raise ModelError(f"joint {name!r} is of type {kind!r} and held at {position:g}; expected 0")
    for child in list(element):
        if child.tag not in ("parent", "child"):
            element.remove(child)
    element.set("type", "fixed")
    xyz = " ".join(map(repr, translation.tolist()))
    rpy = " ".join(map(repr, _roll_pitch_yaw(rotation)))
    element.append(Element("origin", {"xyz": xyz, "rpy": rpy}))


def _roll_pitch_yaw(rotation: FloatArray) -> tuple[float, float, float]:
    """Angles about the fixed axes x, y and z of a rotation [rad]."""
    roll = atan2(rotation[2, 1], rotation[2, 2])
    s = sin(roll)
    c = cos(roll)
    # With this roll the other two are exact for every pitch, 90° included.
    pitch_sine = -rotation[2, 0]
    pitch_cosine = s * rotation[2, 1] + c * rotation[2, 2]
    yaw_sine = s * rotation[0, 2] - c * rotation[0, 1]
    yaw_cosine = c * rotation[1, 1] - s * rotation[1, 2]
    pitch = atan2(pitch_sine, pitch_cosine)
    yaw = atan2(yaw_sine, yaw_cosine)
    return roll, pitch, yaw


def read_urdf(urdf: str) -> UrdfRobot:
    """Read joints, bodies and effort limits of a URDF.

    A link without a readable mass or centre of mass counts as massless, one without a readable
    inertia as a point mass, and a number that no link has is none: they only guide the choice of
    moves, and a URDF for identification need not have them.

    Raises:
        ModelError: the text is no URDF, has no moving joint, or a joint of more than one degree of
            freedom.
    """
    links, joints_behind, root = _tree(urdf)
    base = Place(-1, np.eye(3), np.zeros(3))
    places = {root: base}
    joints: list[Joint] = []
    bodies: list[Body] = []
    effort_limit: list[float] = []
    pending = [(base, element) for element in joints_behind[root]]
    while pending:
        before, element = pending.pop()
        link = _link_at(element, "child")
        here = _place_behind(before, element)
        body = _body(links[link])
        if element.get("type") != "fixed":
            number = len(joints)
            joints.append(_joint(element, here))
            bodies.append(body)
            effort_limit.append(_effort_limit(element))
            here = Place(number, np.eye(3), np.zeros(3))
        elif here.joint >= 0:
            moved = bodies[here.joint]
            bodies[here.joint] = _joined(moved, _placed(body, here))
        places[link] = here
        pending += [(here, behind) for behind in joints_behind[link]]
    if not joints:
        raise ModelError(
            "the URDF has no moving joint; expected at least one revolute or prismatic joint"
        )
    return UrdfRobot(tuple(joints), tuple(bodies), np.array(effort_limit), places)


def _place_behind(before: Place, element: Element) -> Place:
    """Frame of a joint, in the frame of the moving joint before it."""
    own_rotation, own_translation = _origin(element, _name(element))
    rotation = before.rotation @ own_rotation
    translation = before.translation_m + before.rotation @ own_translation
    return Place(joint=before.joint, rotation=rotation, translation_m=translation)


#: Characters of a path in the place of a text; a longer one is not repeated in a message
LONGEST_NAME = 255


def _root(urdf: str) -> Element:
    """Return <robot>, without a namespace."""
    try:
        robot = fromstring(urdf)
    except (ParseError, TypeError, ValueError) as error:
        if UNBOUND_PREFIX in str(error):
            raise ModelError(
                f"the URDF cannot be read: {error}, a prefix of a name whose namespace is not "
                "declared; expected "
                'xmlns:PREFIX="..." in <robot>, or elements without a prefix; a file with xacro: '
                "is expanded by "
                "`xacro robot.urdf.xacro > robot.urdf`"
            ) from error
        if not isinstance(urdf, (str, bytes, PathLike)):
            raise ModelError(
                f"the URDF is of type {type(urdf).__name__}; expected text: pass "
                "Path(...).read_text()"
            ) from error
        if _looks_like_file_name(str(urdf)):
            raise ModelError(
                f"{urdf!r} looks like a file name; expected text: pass Path(...).read_text()"
            ) from error
        raise ModelError(f"the URDF cannot be read: {error}; expected XML") from error
    space = robot.tag.removesuffix("robot")
    is_robot = robot.tag == space + "robot"
    is_namespace = not space or space.startswith("{")
    if not (is_robot and is_namespace):
        raise ModelError(
            f"the URDF cannot be read: its outermost element is <{robot.tag}>; expected <robot>"
        )
    if robot.get("version", "1.0") not in ("1.0", "1.1"):
        raise ModelError(f"the URDF is of version {robot.get('version')}; expected 1.0 or 1.1")
    _require_expanded(robot)
    for element in robot.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.removeprefix(space)
        else:  # a comment
            element.tag = ""
    return robot


def _looks_like_file_name(text: str) -> bool:
    """Whether a text is short, of one line and without any element."""
    is_empty = not text.strip()
    is_short = len(text) <= LONGEST_NAME
    is_one_line = "\n" not in text
    has_element = "<" in text
    return is_short and is_one_line and not is_empty and not has_element


def _require_expanded(robot: Element) -> None:
    """Refuse xacro: macros and expressions that make a URDF once they are expanded."""
    for element in robot.iter():
        tag = str(element.tag)
        is_macro = tag.startswith(XACRO_SPACES)
        has_expression = any(XACRO_EXPRESSION in value for value in element.attrib.values())
        if is_macro or has_expression:
            name = f"{XACRO_EXPRESSION}...}} in <{tag}>"
            if is_macro:
                name = f"<xacro:{tag.rpartition('}')[2]}>"
            raise ModelError(
                f"the file is xacro that is not expanded (it has {name}); expected the output of "
                "`xacro robot.urdf.xacro > robot.urdf`"
            )


def _tree(urdf: str) -> tuple[dict[str, Element], dict[str, list[Element]], str]:
    """Return the links, the joints behind each (last name first, to be popped),
    and the link without a parent.
    """
    robot = _root(urdf)
    links = {_name(link): link for link in robot.findall("link")}
    joints = {_name(joint): joint for joint in robot.findall("joint")}
    for kind, named in (("link", links), ("joint", joints)):
        if len(named) != len(robot.findall(kind)):
            raise ModelError(f"two {kind}s of the URDF have the same name; expected one name each")
    behind: dict[str, list[Element]] = {name: [] for name in links}
    children = set()
    for name in sorted(joints, reverse=True):
        parent = _link_at(joints[name], "parent")
        child = _link_at(joints[name], "child")
        for link in (parent, child):
            if link not in links:
                raise ModelError(
                    f"joint {name!r} connects link {link!r}, which the URDF does not have"
                )
        if child in children:
            raise ModelError(f"link {child!r} is the child of two joints; expected a tree")
        children.add(child)
        behind[parent].append(joints[name])
    if not links:
        raise ModelError(
            "the URDF has no <link>; expected the links of an arm, and the joints between them"
        )
    roots = [name for name in links if name not in children]
    if not roots:
        raise ModelError(
            "every link of the URDF is behind a joint; expected a tree, with one link "
            "that is the base"
        )
    if len(roots) != 1:
        raise ModelError(
            f"the URDF has {len(roots)} links without a parent ({', '.join(roots)}); expected "
            "one, the base"
        )
    return links, behind, roots[0]


KINDS = {
    "revolute": JointKind.REVOLUTE,
    "continuous": JointKind.REVOLUTE,
    "prismatic": JointKind.PRISMATIC,
}
"""Joints of one degree of freedom, by their type in a URDF."""


def _joint(element: Element, at: Place) -> Joint:
    """Read a moving joint.

    Raises:
        ModelError: it has several degrees of freedom, an axis without a direction, or lies too far
            away.
    """
    name = _name(element)
    kind = element.get("type", "")
    if kind not in KINDS:
        found = element.get("type")
        raise ModelError(
            f"joint {name!r} is of type {found!r}; expected revolute, continuous, "
            "prismatic or fixed"
        )
    axis = np.array([1.0, 0.0, 0.0])
    declared = element.find("axis")
    if declared is not None:
        axis = _vector(declared, "xyz", name)
    length = float(np.linalg.norm(axis))
    if length > 0.0:
        axis = axis / length
    unit_length = float(np.linalg.norm(axis))
    if not np.isclose(unit_length, 1.0, atol=1e-6):
        raise ModelError(
            f"joint {name!r} has the axis {axis.tolist()}; expected a direction of length one"
        )
    distance = float(np.max(np.abs(at.translation_m)))
    if not distance <= LARGEST_DISTANCE_M:
        raise ModelError(
            f"joint {name!r} lies {distance:.3g} m from the one before it; expected at most "
            f"{LARGEST_DISTANCE_M:g} m: is the URDF in mm?"
        )
    lowest: float | None = None
    travel: float | None = None
    limits = _position_limits(element)
    # Exporters leave a bound out where a joint has none: only a follower's range is guarded.
    is_read = limits is not None and (limits.are_whole or element.find("mimic") is not None)
    if limits is not None and is_read and limits.range is not None:
        lowest, highest = limits.range
        travel = highest - lowest
    return Joint(
        name=name,
        kind=KINDS[kind],
        parent=at.joint,
        rotation=at.rotation,
        translation_m=at.translation_m,
        axis=axis,
        travel=travel,
        lowest=lowest,
    )


@dataclass(frozen=True, slots=True)
class PositionLimits:
    """Limits of a joint as its URDF writes them; a bound that is left out is 0, as URDF says."""

    lower: str | None
    upper: str | None

    @property
    def are_whole(self) -> bool:
        """Whether the URDF has both bounds."""
        return self.lower is not None and self.upper is not None

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest position [rad or m]; None where the limits say nothing."""
        lower, upper = self._numbers()
        # Some exporters write the largest float where a joint has no limit.
        if 0.0 < upper - lower <= LARGEST_NUMBER:
            return lower, upper
        return None

    @property
    def are_contradictory(self) -> bool:
        """Whether a bound is no number, or the upper one is below the lower one."""
        lower, upper = self._numbers()
        return not lower <= upper

    def _numbers(self) -> tuple[float, float]:
        lower = "0" if self.lower is None else self.lower
        upper = "0" if self.upper is None else self.upper
        try:
            return float(lower), float(upper)
        except ValueError:
            return nan, nan

    def __str__(self) -> str:
        lower = "no lower (0)"
        if self.lower is not None:
            lower = f"lower={self.lower!r}"
        upper = "no upper (0)"
        if self.upper is not None:
            upper = f"upper={self.upper!r}"
        return f"{lower} and {upper}"


def position_limits_of(urdf: str) -> dict[str, PositionLimits]:
    """Return the limits of the movable joints of a URDF that have some, by name.

    Raises:
        ModelError: the text is no URDF.
    """
    found: dict[str, PositionLimits] = {}
    for name, joint in _movable(_root(urdf)).items():
        limits = _position_limits(joint)
        if limits is not None:
            found[name] = limits
    return found


def _position_limits(element: Element) -> PositionLimits | None:
    """Limits of a joint; None for one that has none."""
    limit = element.find("limit")
    if limit is None or element.get("type") == "continuous":
        return None
    return PositionLimits(limit.get("lower"), limit.get("upper"))


def _effort_limit(element: Element) -> float:
    """Effort limit of a moving joint; the limit element must be complete,
    and only a continuous joint may lack it.
    """
    name = _name(element)
    limit = element.find("limit")
    if limit is None:
        if element.get("type") == "continuous":
            return inf
        raise ModelError(f"joint {name!r} has no <limit>; expected one with effort and velocity")
    _number(limit, "velocity", name)
    return _number(limit, "effort", name)


def _body(link: Element) -> Body:
    """Mass, centre and inertia of a link in its own frame."""
    inertial = link.find("inertial")
    nothing = Body(0.0, np.zeros(3), np.zeros((3, 3)))
    if inertial is None:
        return nothing
    name = _name(link)
    try:
        mass = _number(_part(inertial, "mass", name), "value", name)
        rotation, centre = _origin(inertial, name)
    except ModelError:
        return nothing
    is_noise = mass != 0.0 and not LEAST_MASS <= abs(mass) <= LARGEST_MASS
    distance = float(np.max(np.abs(centre)))
    if is_noise or distance > LARGEST_DISTANCE_M:
        return nothing
    try:
        tensor = _inertia_tensor(_part(inertial, "inertia", name), name)
    except ModelError:
        return Body(mass, centre, np.zeros((3, 3)))
    if np.max(np.abs(tensor)) > LARGEST_INERTIA:
        return Body(mass, centre, np.zeros((3, 3)))
    return Body(mass, centre, rotation @ tensor @ rotation.T)


def _inertia_tensor(element: Element, name: str) -> FloatArray:
    """Tensor of an <inertia>, shape (3, 3).

    Raises:
        ModelError: an entry is missing or no number.
    """
    xx = _number(element, "ixx", name)
    xy = _number(element, "ixy", name)
    xz = _number(element, "ixz", name)
    yy = _number(element, "iyy", name)
    yz = _number(element, "iyz", name)
    zz = _number(element, "izz", name)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _placed(body: Body, at: Place) -> Body:
    """Write a body in the frame of the joint that moves it."""
    centre = at.translation_m + at.rotation @ body.centre_m
    inertia = at.rotation @ body.inertia_kg_m2 @ at.rotation.T
    return Body(body.mass_kg, centre, inertia)


def _joined(first: Body, second: Body) -> Body:
    """Two bodies of one frame as one, about the common centre of mass."""
    mass = first.mass_kg + second.mass_kg
    inertia = first.inertia_kg_m2 + second.inertia_kg_m2
    if mass == 0.0:
        return Body(0.0, np.zeros(3), inertia)
    of_first = first.mass_kg * first.centre_m
    of_second = second.mass_kg * second.centre_m
    centre = (of_first + of_second) / mass
    # μ (‖d‖² 1 − d dᵀ), μ the reduced mass
    distance = first.centre_m - second.centre_m
    reduced_mass = first.mass_kg * second.mass_kg / mass
    return Body(mass, centre, inertia + reduced_mass * steiner(distance))


def _origin(element: Element, name: str) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation of an <origin>; angles about fixed x, y, z, in this order."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    if "quat_xyzw" in origin.attrib:
        raise ModelError(
            f"{name!r} has an origin with quat_xyzw, which URDF 1.0 does not know; expected rpy"
        )
    angles = _vector(origin, "rpy", name)
    translation = _vector(origin, "xyz", name)
    return _rotation(angles), translation


def _rotation(angles_rad: FloatArray) -> FloatArray:
    """Rotation by angles about fixed x, y, z, in this order, by its unit quaternion, (3, 3)."""
    half = 0.5 * angles_rad
    cx, cy, cz = map(cos, half)
    sx, sy, sz = map(sin, half)
    x = sx * cy * cz - cx * sy * sz
    y = cx * sy * cz + sx * cy * sz
    z = cx * cy * sz - sx * sy * cz
    w = cx * cy * cz + sx * sy * sz
    length = sqrt(x * x + y * y + z * z + w * w)
    x /= length
    y /= length
    z /= length
    w /= length
    # Twice the products of the quaternion's components
    xx = 2.0 * x * x
    yy = 2.0 * y * y
    zz = 2.0 * z * z
    xy = 2.0 * y * x
    xz = 2.0 * z * x
    yz = 2.0 * z * y
    xw = 2.0 * x * w
    yw = 2.0 * y * w
    zw = 2.0 * z * w
    rotation = np.empty((3, 3))
    rotation[0] = (1.0 - (yy + zz), xy - zw, xz + yw)
    rotation[1] = (xy + zw, 1.0 - (xx + zz), yz - xw)
    rotation[2] = (xz - yw, yz + xw, 1.0 - (xx + yy))
    return rotation


def _name(element: Element) -> str:
    """Name of a link or joint."""
    name = element.get("name", "")
    if not name:
        raise ModelError(
            f"a {element.tag} of the URDF has no name; expected one for each link and joint"
        )
    return name


def _link_at(joint: Element, end: str) -> str:
    """Name of the parent or child link of a joint."""
    part = _part(joint, end, _name(joint))
    return part.get("link", "")


def _part(element: Element, tag: str, name: str) -> Element:
    """An element inside of another one."""
    found = element.find(tag)
    if found is None:
        raise ModelError(f"{element.tag} of {name!r} in the URDF has no <{tag}>; expected one")
    return found


def _vector(element: Element, key: str, name: str) -> FloatArray:
    """Three numbers of an attribute; zeros where it is left out."""
    text = element.get(key, "0 0 0")
    numbers = [_finite(word) for word in text.split()]
    if len(numbers) != 3 or None in numbers:
        raise ModelError(
            f"<{element.tag}> of {name!r} in the URDF has {key}={text!r}; expected three numbers"
        )
    vector = np.array(numbers, dtype=np.float64)
    if np.max(np.abs(vector)) > LARGEST_NUMBER:
        raise ModelError(
            f"<{element.tag}> of {name!r} in the URDF has {key}={text!r}; expected at most "
            f"{LARGEST_NUMBER:g} in each of three numbers"
        )
    return vector


def _number(element: Element, key: str, name: str) -> float:
    """A number of an attribute."""
    text = element.get(key, "")
    number = _finite(text)
    if number is None:
        raise ModelError(
            f"<{element.tag}> of {name!r} in the URDF has {key}={text!r}; expected a number"
        )
    return number


def _finite(text: str) -> float | None:
    """A finite number from its text; None where it is none."""
    try:
        number = float(text)
    except ValueError:
        return None
    if "_" in text or not isfinite(number):
        return None
    return number
