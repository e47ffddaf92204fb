"""Reading a URDF: the joint tree for identification,
bodies and effort limits for the planner and the prior.

The reader takes from a URDF what identification needs and skips the rest (meshes, transmissions,
plugins). Joints are ordered and merged as Pinocchio does it, which the tests compare with: depth
first, branches in the order of their joints' names, fixed joints merged into the moving joint
before them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, inf, isfinite, sin, sqrt
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

import numpy as np

from ident.arrays import FloatArray, require_kind
from ident.errors import ModelError
from ident.model.bodies import Body
from ident.model.pivots import cut_pivots
from ident.model.robot import (
    DIRECTIONS,
    Closure,
    Joint,
    JointCoupling,
    JointKind,
    Place,
    Robot,
    poses,
)

HELD_ALIKE = 1e-3  #: Largest difference of two statements of one position [rad or m]
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
    index = {joint.name: number for number, joint in enumerate(found.joints)}
    couplings = _couplings(mimics_of(urdf), index)
    if couplings and closures:
        follower = found.joints[couplings[0].follower].name
        raise ModelError(
            f"joint {follower!r} has <mimic>, and the robot has closures; expected one of the two: "
            "delete <mimic>, and describe what couples the joint as a closure"
        )

    def link(name: str, what: str) -> Place:
        if name not in found.links:
            raise ModelError(
                f"{what} names link {name!r}; the URDF has the links "
                f"{', '.join(sorted(found.links))}"
            )
        return found.links[name]

    for what, names in (("the list of motors", motors), ("the assembly pose", assembly_rad or {})):
        for name in names:
            if name not in index:
                raise ModelError(
                    f"{what} names joint {name!r}; the URDF has the moving joints "
                    f"{', '.join(index)}"
                )
    closed = []
    for pair in closures:
        require_kind(
            "an entry of closures",
            pair,
            LinkPair,
            "write LinkPair(name, first, second, directions)",
        )
        what = f"closure {pair.name!r}"
        unknown = [direction for direction in pair.directions if direction not in DIRECTIONS]
        if unknown or not pair.directions or len(set(pair.directions)) < len(pair.directions):
            given = ", ".join(pair.directions) or "none"
            raise ModelError(
                f"{what} has the directions {given}; expected some of "
                f"{', '.join(DIRECTIONS)}, each once"
            )
        closed.append(
            Closure(
                pair.name, link(pair.first, what), link(pair.second, what), tuple(pair.directions)
            )
        )
    if platform is None:
        carrier = None
    else:
        carrier = link(platform, "the platform")
    if carrier is not None and carrier.joint < 0:
        raise ModelError(
            f"the platform {platform!r} does not move; expected the link that carries the payload"
        )
    pose = np.array([(assembly_rad or {}).get(joint.name, 0.0) for joint in found.joints])
    driven = tuple(index[name] for name in motors)
    if couplings and not driven:
        followers = {coupling.follower for coupling in couplings}
        driven = tuple(number for number in index.values() if number not in followers)
    robot = Robot(
        joints=found.joints,
        gravity_m_s2=np.asarray(gravity_m_s2, dtype=np.float64),
        closures=tuple(closed),
        motors=driven,
        assembly_rad=pose if closed or couplings else None,
        platform=carrier,
        couplings=couplings,
    )
    if closed:
        return replace(robot, pivots=cut_pivots(robot))
    return robot


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint that follows another one:
    q = multiplier · q_leader + offset, the `<mimic>` of a URDF.
    """

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
    for name, position in {**followed, **position_rad}.items():
        _fix(movable[name], position)
    return tostring(robot, encoding="unicode")


def mimics_of(urdf: str) -> dict[str, Mimic]:
    """Return the joints of a URDF that move and mimic another one, by name.

    Raises:
        ModelError: the text is no URDF, or a multiplier or an offset is no number.
    """
    return _mimics(_movable(_root(urdf)))


def _movable(robot: Element) -> dict[str, Element]:
    return {_name(joint): joint for joint in robot.findall("joint") if joint.get("type") != "fixed"}


def first_leader(name: str, mimics: Mapping[str, Mimic]) -> Mimic:
    """Return how a joint follows the joint at the head of its chain of followers.

    Args:
        name: of a joint that mimics another one.
        mimics: of the URDF (`mimics_of`).

    Raises:
        ModelError: the chain leads back to one of its joints.
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
        offset = found.multiplier * before.offset + found.offset
        found = Mimic(before.leader, found.multiplier * before.multiplier, offset)
    return found


def _couplings(mimics: Mapping[str, Mimic], index: Mapping[str, int]) -> tuple[JointCoupling, ...]:
    """Return how each follower depends on a joint that follows none."""
    found = []
    for name in mimics:
        mimic = first_leader(name, mimics)
        if mimic.leader not in index:
            moving = ", ".join(joint for joint in index if joint not in mimics) or "none"
            raise ModelError(
                f"joint {name!r} mimics {mimic.leader!r}, which is no joint of the URDF that "
                f"moves; expected one of {moving}; hold {name!r} where it stays (`hold_joints`)"
            )
        found.append(
            JointCoupling(index[name], index[mimic.leader], mimic.multiplier, mimic.offset)
        )
    return tuple(found)


def _mimics(movable: Mapping[str, Element]) -> dict[str, Mimic]:
    found = {}
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
        found[name] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return found


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
    elsewhere = mimic.offset if mimic.at_rest else followed.get(name)
    if elsewhere is not None:
        if not np.isclose(position, elsewhere, rtol=0.0, atol=HELD_ALIKE):
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
        placed = poses(Robot((joint,), np.zeros(3)), np.array([[position]]))
        rotation = placed.rotation[1, 0]
        translation = placed.origin_m[1, 0]
    elif position != 0.0:
        raise ModelError(f"joint {name!r} is of type {kind!r} and held at {position:g}; expected 0")
    roll = atan2(rotation[2, 1], rotation[2, 2])
    # With this roll the other two are exact for every pitch, 90° included
    s, c = sin(roll), cos(roll)
    pitch = atan2(-rotation[2, 0], s * rotation[2, 1] + c * rotation[2, 2])
    yaw = atan2(s * rotation[0, 2] - c * rotation[0, 1], c * rotation[1, 1] - s * rotation[1, 2])
    for child in [child for child in element if child.tag not in ("parent", "child")]:
        element.remove(child)
    element.set("type", "fixed")
    spelled = {"xyz": translation.tolist(), "rpy": [roll, pitch, yaw]}
    element.append(
        Element("origin", {key: " ".join(map(repr, three)) for key, three in spelled.items()})
    )


def read_urdf(urdf: str) -> UrdfRobot:
    """Read joints, bodies and effort limits of a URDF.

    A link without a readable mass or centre of mass counts as massless, one without a readable
    inertia as a point mass: they only guide the choice of moves, and a URDF for identification need
    not have them.

    Raises:
        ModelError: the text is no URDF, has no moving joint, or a joint of more than one degree of
            freedom.
    """
    links, joints_behind, root = _tree(urdf)
    places = {root: Place(-1, np.eye(3), np.zeros(3))}
    joints: list[Joint] = []
    bodies: list[Body] = []
    effort_limit: list[float] = []
    pending = [(places[root], element) for element in joints_behind[root]]
    while pending:
        before, element = pending.pop()
        link = _link_at(element, "child")
        rotation, translation = _origin(element, _name(element))
        here = Place(
            before.joint,
            before.rotation @ rotation,
            before.translation_m + before.rotation @ translation,
        )
        if element.get("type") != "fixed":
            joints.append(_joint(element, here))
            bodies.append(_body(links[link]))
            effort_limit.append(_effort_limit(element))
            here = Place(len(joints) - 1, np.eye(3), np.zeros(3))
        elif here.joint >= 0:
            bodies[here.joint] = _joined(bodies[here.joint], _placed(_body(links[link]), here))
        places[link] = here
        pending += [(here, behind) for behind in joints_behind[link]]
    if not joints:
        raise ModelError(
            "the URDF has no moving joint; expected at least one revolute or prismatic joint"
        )
    return UrdfRobot(tuple(joints), tuple(bodies), np.array(effort_limit), places)


#: Characters of a path in the place of a text; a longer one is not repeated in a message
LONGEST_NAME = 255


def _root(urdf: str) -> Element:
    """Return <robot>, without a namespace."""
    try:
        robot = fromstring(urdf)
    except (ParseError, TypeError) as error:
        if UNBOUND_PREFIX in str(error):
            raise ModelError(
                f"the URDF cannot be read: {error}, a prefix of a name whose namespace is not "
                "declared; expected "
                'xmlns:PREFIX="..." in <robot>, or elements without a prefix; a file with xacro: '
                "is expanded by "
                "`xacro robot.urdf.xacro > robot.urdf`"
            ) from error
        text = str(urdf)
        if text.strip() and len(text) <= LONGEST_NAME and "<" not in text and "\n" not in text:
            raise ModelError(
                f"{urdf!r} looks like a file name; expected text: pass Path(...).read_text()"
            ) from error
        raise ModelError(f"the URDF cannot be read: {error}; expected XML") from error
    space = robot.tag.removesuffix("robot")
    if robot.tag != space + "robot" or (space and not space.startswith("{")):
        raise ModelError(
            f"the URDF cannot be read: its outermost element is <{robot.tag}>; expected <robot>"
        )
    if robot.get("version", "1.0") not in ("1.0", "1.1"):
        raise ModelError(f"the URDF is of version {robot.get('version')}; expected 1.0 or 1.1")
    _require_expanded(robot)
    for element in robot.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.removeprefix(space)
        else:
            element.tag = ""
    return robot


def _require_expanded(robot: Element) -> None:
    """Refuse xacro: macros and expressions that make a URDF once they are expanded."""
    for element in robot.iter():
        tag = str(element.tag)
        is_macro = tag.startswith(XACRO_SPACES)
        has_expression = any(XACRO_EXPRESSION in value for value in element.attrib.values())
        if is_macro or has_expression:
            if is_macro:
                name = f"<xacro:{tag.rpartition('}')[2]}>"
            else:
                name = f"{XACRO_EXPRESSION}...}} in <{tag}>"
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
        parent, child = (_link_at(joints[name], end) for end in ("parent", "child"))
        if parent not in links or child not in links:
            unknown = child if parent in links else parent
            raise ModelError(
                f"joint {name!r} connects link {unknown!r}, which the URDF does not have"
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


def _joint(element: Element, at: Place) -> Joint:
    name = _name(element)
    kind = element.get("type")
    if kind not in ("revolute", "continuous", "prismatic"):
        raise ModelError(
            f"joint {name!r} is of type {kind!r}; expected revolute, continuous, prismatic or fixed"
        )
    declared = element.find("axis")
    if declared is None:
        axis = np.array([1.0, 0.0, 0.0])
    else:
        axis = _vector(declared, "xyz", name)
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 0.0 else axis
    if not np.isclose(float(np.linalg.norm(axis)), 1.0, atol=1e-6):
        raise ModelError(
            f"joint {name!r} has the axis {axis.tolist()}; expected a direction of length one"
        )
    distance = float(np.max(np.abs(at.translation_m)))
    if not distance <= LARGEST_DISTANCE_M:
        raise ModelError(
            f"joint {name!r} lies {distance:.3g} m from the one before it; expected at most "
            f"{LARGEST_DISTANCE_M:g} m: is the URDF in mm?"
        )
    return Joint(
        name=name,
        kind=JointKind.PRISMATIC if kind == "prismatic" else JointKind.REVOLUTE,
        parent=at.joint,
        rotation=at.rotation,
        translation_m=at.translation_m,
        axis=axis,
    )


def _effort_limit(element: Element) -> float:
    """Effort limit of a moving joint; the limit element must be complete,
    and only a continuous joint may lack it.
    """
    limit = element.find("limit")
    if limit is None:
        if element.get("type") == "continuous":
            return inf
        raise ModelError(
            f"joint {_name(element)!r} has no <limit>; expected one with effort and velocity"
        )
    _number(limit, "velocity", _name(element))
    return _number(limit, "effort", _name(element))


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
    try:
        tensor = _part(inertial, "inertia", name)
        xx, xy, xz, yy, yz, zz = (
            _number(tensor, entry, name) for entry in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
    except ModelError:
        return Body(mass, centre, np.zeros((3, 3)))
    return Body(
        mass, centre, rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    )


def _placed(body: Body, at: Place) -> Body:
    """Write a body in the frame of the joint that moves it."""
    centre = at.translation_m + at.rotation @ body.centre_m
    return Body(body.mass_kg, centre, at.rotation @ body.inertia_kg_m2 @ at.rotation.T)


def _joined(first: Body, second: Body) -> Body:
    """Two bodies of one frame as one, about the common centre of mass."""
    mass = first.mass_kg + second.mass_kg
    if mass == 0.0:
        return Body(0.0, np.zeros(3), first.inertia_kg_m2 + second.inertia_kg_m2)
    centre = (first.mass_kg * first.centre_m + second.mass_kg * second.centre_m) / mass
    apart = first.centre_m - second.centre_m
    steiner = (
        first.mass_kg * second.mass_kg / mass * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    )
    return Body(mass, centre, first.inertia_kg_m2 + second.inertia_kg_m2 + steiner)


def _origin(element: Element, name: str) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation of an <origin>;
    the angles are about the fixed axes x, y, z, in this order.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    if "quat_xyzw" in origin.attrib:
        raise ModelError(
            f"{name!r} has an origin with quat_xyzw, which URDF 1.0 does not know; expected rpy"
        )
    half = 0.5 * _vector(origin, "rpy", name)
    (cx, cy, cz), (sx, sy, sz) = map(cos, half), map(sin, half)
    x = sx * cy * cz - cx * sy * sz
    y = cx * sy * cz + sx * cy * sz
    z = cx * cy * sz - sx * sy * cz
    w = cx * cy * cz + sx * sy * sz
    length = sqrt(x * x + y * y + z * z + w * w)
    x = x / length
    y = y / length
    z = z / length
    w = w / length
    rotation = [
        [1.0 - (2.0 * y * y + 2.0 * z * z), 2.0 * y * x - 2.0 * z * w, 2.0 * z * x + 2.0 * y * w],
        [2.0 * y * x + 2.0 * z * w, 1.0 - (2.0 * x * x + 2.0 * z * z), 2.0 * z * y - 2.0 * x * w],
        [2.0 * z * x - 2.0 * y * w, 2.0 * z * y + 2.0 * x * w, 1.0 - (2.0 * x * x + 2.0 * y * y)],
    ]
    return np.array(rotation), _vector(origin, "xyz", name)


def _name(element: Element) -> str:
    name = element.get("name", "")
    if not name:
        raise ModelError(
            f"a {element.tag} of the URDF has no name; expected one for each link and joint"
        )
    return name


def _link_at(joint: Element, end: str) -> str:
    """Name of the parent or child link of a joint."""
    return _part(joint, end, _name(joint)).get("link", "")


def _part(element: Element, tag: str, name: str) -> Element:
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
    return np.array(numbers, dtype=np.float64)


def _number(element: Element, key: str, name: str) -> float:
    text = element.get(key, "")
    number = _finite(text)
    if number is None:
        raise ModelError(
            f"<{element.tag}> of {name!r} in the URDF has {key}={text!r}; expected a number"
        )
    return number


def _finite(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if isfinite(number) and "_" not in text else None
