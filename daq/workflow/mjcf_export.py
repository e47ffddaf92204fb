"""A calibrated robot as an MJCF model for MuJoCo.

| of the calibration | in the model |
|---|---|
| bodies, joint frames, gravity | `<body>`, `<inertial>`, `<joint>`, `<option gravity>`; positions are the same |
| Ia, fv, fs of a joint | `armature`, `damping`, `frictionloss` of the joint |
| Iam, fvm, fsm of a motor that turns with several joints | the same of a `<fixed>` tendon with the motor's direction |
| drive gain | `gear` of a `<motor>` on the joint or tendon: its `ctrl` is the current reference |
| springs, friction of joints without a motor | at their joint (`daq.workflow.mjcf_effects`) |
| closure of a loop | `<connect>` or `<weld>` between two sites |
| `<visual>`, `<collision>` of the URDF | `<geom>` of class `visual`, `collision`; meshes stay where they are |

MuJoCo makes dry friction a soft constraint. `solreffriction` and `solimpfriction` are as stiff as a
step allows: a joint that friction can stop within a step stops, and one that moves on has its whole
dry friction. Loops are closed by soft constraints, too.
"""  # noqa: E501

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from daq.workflow.mjcf_effects import JointEffects
from daq.workflow.urdf_shapes import ShapeKind, UrdfShape, UrdfShapes
from ident.arrays import FloatArray
from ident.calibration import Gain
from ident.model.bodies import body_of
from ident.model.closures import origin
from ident.model.model import Model
from ident.model.robot import Closure, JointKind, Place, poses
from ident.physical.drive_terms import DriveTerms, LeftOver, drive_terms

FORMAT = "drivegain-mjcf"  #: What the comment at the head of a written model says it is
TIME_STEP_S = 0.001
CLOSED_SHARE = 1e-6
"""Change of a distance from position to position, as a share of the robot's size,
below which it is constant.
"""
#: Distance of the two points that hold a hinge of a loop, as a share of the robot's size
HINGE_SHARE = 0.1
WORLD = "world"  #: Name of MuJoCo's own body, which no other one may have
THINNEST_M = 1e-3  #: Shorter links are not drawn
VISUAL = "visual"  #: Class of the shapes that are drawn
COLLISION = "collision"  #: Class of those that links touch each other with
_LENGTHS = frozenset({"x", "y", "z"})
_TURNS = {"rx": 0, "ry": 1, "rz": 2}


@dataclass(frozen=True, slots=True, eq=False)
class MjcfSource:
    """What a model is written from."""

    name: str  #: of the model
    model: Model  #: with the geometry that is written
    standard: FloatArray  #: χ_st without payload, of bodies that can exist, shape (c,)
    gains: tuple[Gain, ...]  #: one an axis
    #: Frames of the URDF's links by name: the joint that moves each of them, and where it is in
    #: that joint's frame.
    frames: Mapping[str, Place]
    lower: FloatArray  #: least position of each axis [rad or m], -inf without a limit, shape (m,)
    upper: FloatArray  #: largest position, shape (m,)
    shapes: UrdfShapes  #: of the URDF's links
    folder: Path  #: that the model will be in; names of mesh files are relative to it
    effects: JointEffects  #: of the calibration
    #: for the comment at the head, besides what the writer itself leaves out
    remarks: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Mjcf:
    """A model that was written."""

    content: bytes
    left_over: tuple[LeftOver, ...]  #: parameters, or parts of them, that the model lacks
    open_closures: tuple[str, ...]  #: names of closures that no constraint of MuJoCo says
    actuators: tuple[str, ...]  #: joint or tendon that each axis' actuator acts on


def write_mjcf(source: MjcfSource, closed_positions: FloatArray) -> Mjcf:
    """Write a robot as an MJCF model.

    Args:
        source: the robot.
        closed_positions: some positions of all joints at which the loops are closed, shape (k, n);
            of a serial robot they do not matter.
    """
    model = source.model
    robot = model.robot
    terms = drive_terms(model, source.standard)
    root = Element("mujoco", model=source.name)
    SubElement(
        root,
        "compiler",
        angle="radian",
        autolimits="true",
        inertiafromgeom="false",
        balanceinertia="false",
    )
    gravity = _numbers(robot.gravity_m_s2)
    SubElement(
        root, "option", timestep=repr(TIME_STEP_S), gravity=gravity, integrator="implicitfast"
    )
    _add_defaults(root)
    meshes = _add_meshes(root, source)
    bodies = _add_bodies(root, source, terms)
    _add_shapes(source, bodies, meshes)
    _add_frames(source, bodies)
    open_closures = tuple(_add_closures(root, source, bodies, closed_positions))
    _add_tendons(root, source, terms)
    actuators = tuple(_add_actuators(root, source))
    if robot.is_constrained:
        keyframe = SubElement(root, "keyframe")
        SubElement(keyframe, "key", name="assembly", qpos=_numbers(model.assembly.position_rad))
    left = [*source.remarks, *_describe_left(terms.left_over, open_closures, _units(source.gains))]
    indent(root)
    head = f"<!-- {_comment_text(left)} -->\n".encode()
    content = head + tostring(root, encoding="utf-8") + b"\n"
    return Mjcf(content, terms.left_over, open_closures, actuators)


def _add_defaults(root: Element) -> None:
    default = SubElement(root, "default")
    friction = {
        "solreffriction": _numbers((2.0 * TIME_STEP_S, 1.0)),
        "solimpfriction": "0.999 0.999 0.001 0.5 2",
    }
    SubElement(default, "joint", friction)
    SubElement(default, "tendon", friction)
    SubElement(default, "equality", solref=_numbers((4.0 * TIME_STEP_S, 1.0)))
    # What is drawn has neither mass nor contact.
    SubElement(
        default,
        "geom",
        type="capsule",
        size="0.02",
        contype="0",
        conaffinity="0",
        mass="0",
        group="2",
    )
    visual = SubElement(default, "default", {"class": VISUAL})
    SubElement(visual, "geom", group="2")
    # Contact changes torques: who wants it gives this class contype="1" conaffinity="1".
    collision = SubElement(default, "default", {"class": COLLISION})
    SubElement(collision, "geom", group="3")


def _add_meshes(root: Element, source: MjcfSource) -> dict[tuple[Path, tuple[float, ...]], str]:
    """Add each mesh once for each scale, and return their names."""
    names: dict[tuple[Path, tuple[float, ...]], str] = {}
    for shape in source.shapes.found:
        if shape.mesh is not None:
            names.setdefault((shape.mesh, shape.size), f"mesh {len(names) + 1}")
    if not names:
        return names
    asset = SubElement(root, "asset")
    folder = source.folder.resolve()
    for (file, scale), name in names.items():
        # A shell, because a mesh that is not closed has no volume; its inertia is not used.
        relative = Path(os.path.relpath(file, folder)).as_posix()
        SubElement(asset, "mesh", name=name, file=relative, scale=_numbers(scale), inertia="shell")
    return names


def _add_shapes(
    source: MjcfSource,
    bodies: Sequence[Element],
    meshes: Mapping[tuple[Path, tuple[float, ...]], str],
) -> None:
    """Add what the URDF shows of its links, and the shapes that they touch others with."""
    for shape in source.shapes.found:
        place = source.frames[shape.link]
        use = COLLISION if shape.is_collision else VISUAL
        geom = SubElement(bodies[place.joint + 1], "geom", {"class": use, "type": shape.kind.value})
        if shape.mesh is None:
            geom.set("size", _numbers(_half_sizes(shape)))
        else:
            geom.set("mesh", meshes[shape.mesh, shape.size])
        geom.set("pos", _numbers(place.translation_m + place.rotation @ shape.translation_m))
        geom.set("quat", _quaternion(place.rotation @ shape.rotation))
        if shape.colour is not None:
            geom.set("rgba", _numbers(shape.colour))


def _half_sizes(shape: UrdfShape) -> tuple[float, ...]:
    """Sizes as MuJoCo has them: half the sides of a box and half the length of a cylinder."""
    if shape.kind is ShapeKind.BOX:
        return tuple(0.5 * side_m for side_m in shape.size)
    if shape.kind is ShapeKind.SPHERE:
        return shape.size
    radius_m, length_m = shape.size
    return radius_m, 0.5 * length_m


def _add_bodies(root: Element, source: MjcfSource, terms: DriveTerms) -> list[Element]:
    """Add a body for each joint, and return the world with them: frame i + 1 moves with joint i."""
    model = source.model
    robot = model.robot
    links = source.standard[model.link_columns]
    names = _body_names(source)
    # Where the URDF shows nothing, capsules from joint to joint say where the robot is.
    is_drawn = any(not shape.is_collision for shape in source.shapes.found)
    bodies = [SubElement(root, "worldbody")]
    for index, joint in enumerate(robot.joints):
        parent = bodies[joint.parent + 1]
        if not is_drawn and np.linalg.norm(joint.translation_m) > THINNEST_M:
            SubElement(parent, "geom", fromto=_numbers((0.0, 0.0, 0.0, *joint.translation_m)))
        body = SubElement(
            parent,
            "body",
            name=names[index],
            pos=_numbers(joint.translation_m),
            quat=_quaternion(joint.rotation),
        )
        _add_joint(body, source, terms, index)
        inertial = body_of(links[index])
        tensor = inertial.inertia_kg_m2
        # MuJoCo's order: the diagonal first.
        entries = (
            tensor[0, 0],
            tensor[1, 1],
            tensor[2, 2],
            tensor[0, 1],
            tensor[0, 2],
            tensor[1, 2],
        )
        SubElement(
            body,
            "inertial",
            pos=_numbers(inertial.centre_m),
            mass=repr(inertial.mass_kg),
            fullinertia=_numbers(entries),
        )
        bodies.append(body)
    return bodies


def _add_joint(body: Element, source: MjcfSource, terms: DriveTerms, index: int) -> None:
    robot = source.model.robot
    joint = robot.joints[index]
    kind = "slide" if joint.kind is JointKind.PRISMATIC else "hinge"
    element = SubElement(body, "joint", name=joint.name, type=kind, axis=_numbers(joint.axis))
    drive = joint_drive(source, terms, index)
    for attribute, value in drive.items():
        element.set(attribute, _number(value))
    if index in robot.axis_joints:
        axis = robot.axis_joints.index(index)
        limits = (source.lower[axis], source.upper[axis])
        if np.isfinite(limits).all():
            element.set("range", _numbers(limits))


def joint_drive(source: MjcfSource, terms: DriveTerms, index: int) -> dict[str, float]:
    """Rotor, friction and spring of a joint, by the attributes of MuJoCo;
    those of a spring only where it has one.
    """
    robot = source.model.robot
    effects = source.effects
    drive = {
        "armature": 0.0,
        "damping": float(effects.damping[index]),
        "frictionloss": float(effects.dry_friction[index]),
    }
    if index in robot.axis_joints:
        axis = robot.axis_joints.index(index)
        drive["armature"] += float(terms.inertia.of_axes[axis])
        drive["damping"] += float(terms.damping.of_axes[axis])
        drive["frictionloss"] += float(terms.dry_friction.of_axes[axis])
    if effects.stiffness[index] > 0.0:
        drive["stiffness"] = float(effects.stiffness[index])
        drive["springref"] = float(effects.spring_rest[index])
    return drive


def _body_names(source: MjcfSource) -> list[str]:
    """Name of the URDF's link that each joint moves:
    of links with its frame, the first from the base.

    A link with the name of MuJoCo's own body gets another one, and a site keeps its name.
    """
    named: dict[int, str] = {}
    for name, place in source.frames.items():
        if place.joint >= 0 and _is_joint_frame(place):
            named.setdefault(place.joint, name)
    names = [named.get(index, joint.name) for index, joint in enumerate(source.model.robot.joints)]
    return [f"{name} link" if name == WORLD else name for name in names]


def _is_joint_frame(place: Place) -> bool:
    return not place.translation_m.any() and np.array_equal(place.rotation, np.eye(3))


def _add_frames(source: MjcfSource, bodies: Sequence[Element]) -> None:
    """Add a site for each link that is fixed to a moving one, or to the base."""
    own = set(_body_names(source))
    for name, place in source.frames.items():
        if name not in own:
            _add_site(bodies, name, place)


def _add_site(bodies: Sequence[Element], name: str, place: Place) -> None:
    SubElement(
        bodies[place.joint + 1],
        "site",
        name=name,
        pos=_numbers(place.translation_m),
        quat=_quaternion(place.rotation),
    )


def _add_closures(
    root: Element, source: MjcfSource, bodies: Sequence[Element], closed_positions: FloatArray
) -> Iterator[str]:
    """Add a constraint for each follower and closure,
    and return the closures that MuJoCo has none for.
    """
    robot = source.model.robot
    if not robot.is_constrained:
        return
    equality = SubElement(root, "equality")
    for coupling in robot.couplings:
        SubElement(
            equality,
            "joint",
            joint1=robot.joints[coupling.follower].name,
            joint2=robot.joints[coupling.leader].name,
            polycoef=_numbers((coupling.offset, coupling.multiplier, 0.0, 0.0, 0.0)),
        )
    size_m = source.model.assembly.size_m
    for closure in robot.closures:
        holds = set(closure.directions)
        free = [axis for name, axis in _TURNS.items() if name not in holds]
        if holds >= _LENGTHS and not free:
            _tie(equality, bodies, "weld", closure)
        elif holds >= _LENGTHS and len(free) == 1:
            along = HINGE_SHARE * size_m * np.eye(3)[free[0]]
            _tie(equality, bodies, "connect", closure)
            _tie(equality, bodies, "connect", closure, along, along)
        else:
            gap_m = _lasting_gap(source, closure, closed_positions)
            if gap_m is None or len(free) < 3:
                yield closure.name
            else:
                _tie(equality, bodies, "connect", closure, gap_m)


def _lasting_gap(source: MjcfSource, closure: Closure, positions: FloatArray) -> FloatArray | None:
    """Where the second frame of a closure is in its first, if it is there at every position,
    shape (3,) [m].

    A planar mechanism closes in two directions and stays where it is in the third one.
    """
    placed = poses(source.model.robot, positions)
    apart = origin(placed, closure.second) - origin(placed, closure.first)
    frame = placed.rotation[closure.first.joint + 1] @ closure.first.rotation
    gaps_m = np.einsum("kji,kj->ki", frame, apart)
    gap_m = gaps_m.mean(axis=0)
    largest_m = float(np.abs(gaps_m - gap_m).max())
    return gap_m if largest_m <= CLOSED_SHARE * source.model.assembly.size_m else None


def _tie(
    equality: Element,
    bodies: Sequence[Element],
    kind: str,
    closure: Closure,
    in_first_m: FloatArray | None = None,
    in_second_m: FloatArray | None = None,
) -> None:
    """Tie the frames of a closure, at a point in each of them; at their origins without one."""
    suffix = "" if in_second_m is None else " along"
    names = []
    places = ((closure.first, in_first_m), (closure.second, in_second_m))
    for number, (place, point_m) in enumerate(places, start=1):
        name = f"{closure.name} {number}{suffix}"
        beside_m = np.zeros(3) if point_m is None else place.rotation @ point_m
        _add_site(bodies, name, Place(place.joint, place.rotation, place.translation_m + beside_m))
        names.append(name)
    SubElement(equality, kind, name=f"{closure.name}{suffix}", site1=names[0], site2=names[1])


def _add_tendons(root: Element, source: MjcfSource, terms: DriveTerms) -> None:
    """Add a tendon for each motor that turns with several joints."""
    model = source.model
    if not model.drive_train.coupled:
        return
    tendon = SubElement(root, "tendon")
    for motor in model.drive_train.coupled:
        fixed = SubElement(
            tendon,
            "fixed",
            name=source.gains[motor].axis,
            armature=_number(terms.inertia.of_motors[motor]),
            damping=_number(terms.damping.of_motors[motor]),
            frictionloss=_number(terms.dry_friction.of_motors[motor]),
        )
        for joint, share in zip(model.robot.axes, model.drive_train.direction[motor], strict=True):
            if share != 0.0:
                SubElement(fixed, "joint", joint=joint.name, coef=_number(share))


def _add_actuators(root: Element, source: MjcfSource) -> Iterator[str]:
    """Add a motor for each axis, and return the joint or tendon that it acts on."""
    model = source.model
    actuator = SubElement(root, "actuator")
    for axis, gain in enumerate(source.gains):
        is_coupled = axis in model.drive_train.coupled
        acts_on = "tendon" if is_coupled else "joint"
        name = gain.axis if is_coupled else model.robot.axes[axis].name
        SubElement(
            actuator, "motor", {"name": gain.axis, acts_on: name, "gear": _number(gain.value)}
        )
        yield f"{acts_on} {name}"


def _units(gains: Sequence[Gain]) -> str:
    """Units of the actuators' inputs."""
    units = dict.fromkeys(gain.unit.partition("/")[2] for gain in gains)
    return ", ".join(units)


def _describe_left(
    left_over: Sequence[LeftOver], open_closures: Sequence[str], units: str
) -> Iterator[str]:
    yield (
        f"ctrl of each actuator is the current reference of its drive [{units}], gear its "
        "identified drive gain"
    )
    if left_over:
        shown = ", ".join(f"{left.name} = {left.value:.6g} {left.unit}" for left in left_over)
        yield f"NOT in this model: {shown}"
    if open_closures:
        yield f"NOT closed in this model: {', '.join(open_closures)}"


def _comment_text(lines: Sequence[str]) -> str:
    """Text of a comment: two hyphens would end it (XML 1.0, 2.5)."""
    text = "\n     ".join((f"format: {FORMAT}", *lines))
    plain = "".join(letter if letter.isprintable() or letter == "\n" else " " for letter in text)
    return re.sub("-(?=-)|-$", "~", plain)


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(_number(value) for value in values)


def _quaternion(rotation: FloatArray) -> str:
    """MuJoCo's order: the scalar first."""
    return _numbers(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
