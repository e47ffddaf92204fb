"""From a calibration to the physically consistent parameters of its robot."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from daq.config.cell import Cell
from daq.errors import ControllerUnfit, SchemaMismatch
from daq.formats.xml_document import Element, parse
from daq.workflow.experiment import limits_of
from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration, Parameter
from ident.effects.effect import Property
from ident.effects.geometry_corrections import corrected_model
from ident.errors import ModelError
from ident.model.base import BaseParameters
from ident.model.bodies import Body
from ident.model.closed_chain import Assembly, assemble, follow
from ident.model.model import Model
from ident.model.robot import Motion, Robot
from ident.physical.physical import (
    InertiaPrior,
    PhysicalParameters,
    inertia_prior,
    physical_parameters,
    random_motion,
    regroup,
)
from ident.prediction import corrections_of, placed_effect

SAMPLES = 400
"""Random states on which torques are compared:
some ten times as many equations as a six-axis arm has parameters.
"""
SEED = 0
MOTION = 0.6
"""Share of the limits of speed and acceleration within which the states lie: recorded runs have a
root mean square of about a third of their limits, and uniform states one of 0.58 of theirs.
"""


CHAIN_SHARES = (1.0, 0.7, 0.5, 0.3, 0.1)
"""Shares of the ranges of a closed chain's motors within which its loops may close everywhere."""


@dataclass(frozen=True, slots=True)
class Shift:
    """One base parameter that had to move."""

    name: str  #: leading name of the base parameter
    identified: float  #: before
    realised: float  #: after
    deviations: float  #: the change in standard deviations of the fit


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalRobot:
    """Bodies of the robot, from a calibration."""

    parameters: PhysicalParameters  #: with their certificate
    prior: InertiaPrior  #: what was believed of the links beforehand
    #: Of base parameters, largest first; none where the identified ones are those of a possible
    #: robot.
    shifts: tuple[Shift, ...]


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedBase:
    """Base parameters of a calibration, with weights of full precision."""

    grouping: BaseParameters  #: for b base parameters
    parameters: tuple[Parameter, ...]  #: of the calibration, in the order of the grouping
    columns: FloatArray  #: the model's regressor of random states, shape (n, c, k)

    @property
    def values(self) -> FloatArray:
        """Identified values, shape (b,)."""
        return np.array([parameter.value for parameter in self.parameters])

    def shifts(self, possible: PhysicalParameters) -> tuple[Shift, ...]:
        """List the changes to the base parameters of a possible robot, the largest first;
        none where it has the identified ones.
        """
        if possible.exact:
            return ()
        found: list[Shift] = []
        for parameter, after in zip(self.parameters, possible.realised.tolist(), strict=True):
            change = abs(after - parameter.value)
            deviations = float("inf")
            if parameter.std > 0.0:
                deviations = change / parameter.std
            leading = parameter.name.split(" ", 1)[0]
            found.append(Shift(leading, parameter.value, after, deviations))
        return tuple(sorted(found, key=lambda shift: -shift.deviations))


def identified_base(calibration: Calibration, model: Model, limits: FloatArray) -> IdentifiedBase:
    """Find the base parameters of a calibration's robot, without effects and payloads.

    Args:
        calibration: with base parameters.
        model: of the same robot, with the calibration's corrections.
        limits: ranges of random states, as of `ident.physical.physical.random_motion`, shape
            (4, n).

    Raises:
        ModelError: the calibration is of another robot.
    """
    of_effects: set[str] = set()
    for effect in calibration.effects:
        of_effects.update(coefficient.name for coefficient in effect.coefficients)
    known: dict[str, Parameter] = {}
    for parameter in calibration.parameters:
        is_of_payload = ":" in parameter.name or parameter.is_payload_friction
        if not is_of_payload and parameter.name not in of_effects:
            known[parameter.name] = parameter
    columns = model.regressor(random_states(model, limits))
    rows = columns.transpose(0, 2, 1).reshape(-1, columns.shape[1])
    grouping = regroup(model, tuple(known), rows)
    parameters = tuple(known[name] for name in grouping.names)
    return IdentifiedBase(grouping, parameters, columns)


def physical_robot(
    calibration: Calibration,
    model: Model,
    limits: FloatArray,
    urdf: str,
    missing: Sequence[AcceptedEffect] = (),
) -> PhysicalRobot:
    """The parameters of bodies that could exist and need the torques that the calibration says.

    Args:
        calibration: its gains, payloads and effects take no part; an axis with an accepted effect
            of friction may have any sign of fv and fs, because they are only a part of its
            friction. So may one with an effect of another package, of whatever kind, whether the
            package is installed or not: the bodies are the same on every computer.
        limits: ranges in which the torques are compared, as of
            `ident.physical.physical.random_motion`, shape (4, n).
        urdf: with the prior of the bodies.
        missing: effects of the calibration that were taken out of it because their packages are not
            installed.

    Raises:
        ModelError: the calibration is of another robot.
        NotPhysical: no set was found.
    """
    model = corrected_model(model, corrections_of(calibration))
    base = identified_base(calibration, model, limits)
    prior = inertia_prior(urdf)
    friction = _axes_with_other_friction(calibration, missing)
    found = physical_parameters(model, base.grouping, base.values, base.columns, prior, friction)
    return PhysicalRobot(found, prior, base.shifts(found))


def _axes_with_other_friction(
    calibration: Calibration, missing: Sequence[AcceptedEffect]
) -> frozenset[int]:
    """Axes (from 0) on which fs and fv may be only a part of the friction."""
    places = calibration.places
    axes: set[int] = set()
    for accepted in (*calibration.effects, *missing):
        if accepted.package is None:
            placed, _ = placed_effect(accepted, calibration)
            if placed.effect.declares is Property.ODD_IN_VELOCITY:
                axes.add(placed.axis)
        elif accepted.axis in places:
            axes.add(places.index(accepted.axis))
        else:  # ALL_AXES
            axes.update(range(len(calibration.gains)))
    return frozenset(axes)


def random_states(model: Model, limits: FloatArray) -> Motion:
    """Draw the states on which torques are compared.

    The ranges of the motors of a closed chain may hold positions that its loops do not reach; then
    the ranges are narrower, about their middle. Of more motors than degrees of freedom, some lead
    and the others follow.

    Args:
        model: the declared model.
        limits: as of `ident.physical.physical.random_motion`, shape (4, n).

    Raises:
        ModelError: the loops of a closed chain close in no such range.
    """
    if not model.robot.is_constrained:
        return random_motion(limits, SAMPLES, SEED)
    leading, robot, assembly = _leading_motors(model)
    failure: ModelError | None = None
    for share in CHAIN_SHARES:
        narrow = limits[:, leading]
        narrow[1] *= share
        try:
            followed = follow(robot, assembly, random_motion(narrow, SAMPLES, SEED))
        except ModelError as error:
            failure = error
            continue
        motors = list(model.robot.axis_joints)
        joints = followed.joints
        return Motion(
            joints.position_rad[:, motors],
            joints.velocity_rad_s[:, motors],
            joints.acceleration_rad_s2[:, motors],
        )
    assert failure is not None
    raise failure


def _leading_motors(model: Model) -> tuple[list[int], Robot, Assembly]:
    """As many axes as there are degrees of freedom, the best ones to lead,
    and the robot without the other motors.
    """
    found: list[tuple[list[int], Robot, Assembly]] = []
    failure: ModelError | None = None
    for axes in combinations(range(model.robot.axis_count), model.assembly.mobility):
        motors = tuple(model.robot.axis_joints[axis] for axis in axes)
        robot = replace(model.robot, motors=motors)
        try:
            assembly = assemble(robot)
        except ModelError as error:
            failure = error
            continue
        found.append((list(axes), robot, assembly))
    if not found:
        assert failure is not None
        raise failure
    return min(found, key=lambda one: one[2].condition)


def cell_limits(cell: Cell) -> FloatArray:
    """Middle and half of the range of each axis, and MOTION of its speed and acceleration,
    shape (4, n) [rad, s].
    """
    limits = limits_of(cell)
    middle = 0.5 * (limits.lower + limits.upper)
    half_range = 0.5 * (limits.upper - limits.lower)
    return np.array([middle, half_range, MOTION * limits.velocity, MOTION * limits.acceleration])


MAX_BYTES = 16 * 2**20  #: No URDF is larger; meshes are files of their own
#: Elements in elements; a URDF has five or so, and readers that recurse end at some depth
MAX_DEPTH = 64
_TAG = re.compile(rb"<[^\s/>]+(?:\s+[^\s=>/]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*\s*/?>")


@dataclass(frozen=True, slots=True)
class Markup:
    """The elements of a URDF."""

    file: str  #: name in messages
    content: bytes  #: of the file
    root: Element  #: <robot>
    links: Mapping[str, Element]  #: links by name
    joints: Mapping[str, Element]  #: joints by name
    fixed: Mapping[str, Sequence[str]]  #: links that fixed joints hold to a link, by its name

    @property
    def newline(self) -> bytes:
        """Line end of the file."""
        return b"\r\n" if b"\r\n" in self.content else b"\n"

    def find(self, kind: str, name: str) -> Element:
        """Return the link or joint of this name.

        Raises:
            SchemaMismatch: there is none.
        """
        elements = self.links if kind == "link" else self.joints
        if name not in elements:
            known = ", ".join(sorted(elements)) or "none"
            raise refused(
                self.file, f"no {kind} {name!r} (there are {known})", "the robot of the calibration"
            )
        return elements[name]

    def only(self, element: Element, name: str) -> Element | None:
        """Return the child of this name, None without one.

        Raises:
            SchemaMismatch: there are several; readers differ in which of them counts.
        """
        found = [child for child in element.children if child.name == name]
        if len(found) > 1:
            what = f"<{element.name} name={element.attributes.get('name', '')!r}>"
            raise refused(
                self.file, f"{len(found)} <{name}> in {what}", "at most one", "remove the wrong one"
            )
        return found[0] if found else None

    def tag_end(self, element: Element) -> int:
        """Return the offset after an element's start tag.

        Raises:
            SchemaMismatch: the tag cannot be read.
        """
        tag = _TAG.match(self.content, element.start)
        if tag is None:
            found = f"a tag <{element.name}> that cannot be read at byte {element.start}"
            raise refused(self.file, found, "plain XML")
        return tag.end()

    def end(self, element: Element) -> int:
        """Return the offset after a whole element."""
        tag_end = self.tag_end(element)
        if self.is_empty(element):
            return tag_end
        return self.content.index(b">", element.end) + 1

    def is_empty(self, element: Element) -> bool:
        """Whether an element is written as <name/>."""
        return self.content.startswith(b"/>", self.tag_end(element) - 2)

    def indentation(self, at: int) -> bytes:
        """Return the space before an offset in its line;
        empty where something else is before it.
        """
        line = self.content[self.content.rfind(b"\n", 0, at) + 1 : at]
        return line if not line.strip() else b""


def parse_markup(content: bytes, file: str) -> Markup:
    """Find links and joints.

    Raises:
        SchemaMismatch: not well-formed, not UTF-8, too large, too deep, with a document type (which
            can define entities and name files), or two links or joints of one name.
    """
    if len(content) > MAX_BYTES:
        raise refused(file, f"{len(content)} bytes", f"at most {MAX_BYTES}")
    try:
        content.decode("utf-8")
        around, encoding = parse(content, file)
    except UnicodeDecodeError as error:
        raise refused(file, str(error), "UTF-8", "save it as UTF-8") from error
    except ControllerUnfit as error:
        expected = "well-formed XML without a document type: a URDF needs no entities"
        raise refused(file, error.found, expected, "correct the file") from error
    if encoding.lower() not in {"utf-8", "us-ascii", "ascii"}:
        raise refused(file, f"encoding {encoding!r}", "UTF-8", "save it as UTF-8")
    (root,) = around.children
    if root.name != "robot":
        raise refused(file, f"<{root.name}>", "a URDF, <robot> around all")
    level = [root]
    for _ in range(MAX_DEPTH):
        level = list(chain.from_iterable(element.children for element in level))
    if level:
        raise refused(file, f"more than {MAX_DEPTH} elements in each other", "a URDF")
    named: dict[str, dict[str, Element]] = {"link": {}, "joint": {}}
    for element in root.children:
        if element.name in named:
            name = element.attributes.get("name", "")
            if name in named[element.name]:
                raise refused(file, f"two of <{element.name} name={name!r}>", "a name for each")
            named[element.name][name] = element
    fixed: dict[str, list[str]] = {}
    for joint in named["joint"].values():
        if joint.attributes.get("type") == "fixed":
            fixed.setdefault(_link_of(file, joint, "parent"), []).append(
                _link_of(file, joint, "child")
            )
    return Markup(file, content, root, named["link"], named["joint"], fixed)


def refused(
    file: str, found: str, expected: str, remedy: str = "give another URDF"
) -> SchemaMismatch:
    """The error for a file that is no URDF to write into."""
    return SchemaMismatch(file, found=found, expected=expected, remedy=remedy)


def _link_of(file: str, joint: Element, end: str) -> str:
    named = [child.attributes.get("link") for child in joint.children if child.name == end]
    if len(named) != 1 or named[0] is None:
        raise refused(
            file, f"joint {joint.attributes.get('name')!r} without one <{end} link=...>", "one"
        )
    return named[0]


FORMAT = "drivegain-urdf"  #: What the comment at the head of a written URDF says it is
_MERGED = b"<!-- drivegain: this body's inertia is in that of the moving link it is fixed to -->"


@dataclass(frozen=True, slots=True, eq=False)
class JointUpdate:
    """New values of a joint and the link it moves."""

    #: Everything that moves with the joint as one: its link and what fixed joints hold to it, in
    #: the link frame.
    body: Body
    damping: float  #: viscous friction, not negative [Nm/(rad/s), N/(m/s)]
    friction: float  #: dry friction, not negative [Nm, N]


@dataclass(frozen=True, slots=True)
class Updated:
    """A URDF with its new values."""

    content: bytes  #: the file
    links: dict[str, str]  #: name of the link that each joint moves, by the joint's name
    #: links whose own inertia was taken out, because it is part of a moving link's
    merged: tuple[str, ...]


def update_urdf(
    content: bytes, name: str, joints: Mapping[str, JointUpdate], provenance: str
) -> Updated:
    """Replace or insert <inertial> of each moving link and damping and friction of its joint.

    What the identification calls a link is all that moves as one. Its whole inertia goes to the
    link behind the moving joint; the <inertial> of links that fixed joints hold to it becomes a
    comment, or their masses would count twice. Links fixed to the base keep theirs: no torque
    depends on them. Comments, order, line ends, meshes and all other elements and attributes are
    the same bytes as before.

    Args:
        joints: of every moving joint, by its name.
        provenance: for the comment at the head; one of an earlier export is replaced.

    Raises:
        SchemaMismatch: it is no plain URDF: not well-formed, not UTF-8, with a document type, or
            without one of these joints or links, or two inertias in one.
    """
    markup = parse_markup(content, name)
    edits = [_header(markup, provenance)]
    links: dict[str, str] = {}
    merged: list[str] = []
    for joint, update in joints.items():
        element = markup.find("joint", joint)
        links[joint] = _link_of(name, element, "child")
        link = markup.find("link", links[joint])
        edits.append(_put(markup, link, markup.only(link, "inertial"), _inertial(update.body)))
        edits.append(_dynamics(markup, element, update))
        for other in _held_by(links[joint], markup.fixed):
            old = markup.only(markup.find("link", other), "inertial")
            if old is not None:
                merged.append(other)
                edits.append((old.start, markup.end(old), _MERGED))
    out = content
    for start, end, replacement in sorted(edits, reverse=True):
        out = out[:start] + replacement + out[end:]
    return Updated(out, links, tuple(merged))


def _held_by(link: str, fixed: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for child in fixed.get(link, ()):
        yield child
        yield from _held_by(child, fixed)


_Edit = tuple[int, int, bytes]  #: Start and end of what is replaced, and what replaces it


def _inertial(body: Body) -> list[str]:
    x, y, z = (repr(float(value)) for value in body.centre_m)
    values = " ".join(
        f'i{"xyz"[row]}{"xyz"[column]}="{float(body.inertia_kg_m2[row, column])!r}"'
        for row, column in zip(*np.triu_indices(3), strict=True)
    )
    return [
        "<inertial>",
        f'  <origin xyz="{x} {y} {z}" rpy="0 0 0"/>',
        f'  <mass value="{body.mass_kg!r}"/>',
        f"  <inertia {values}/>",
        "</inertial>",
    ]


def _put(markup: Markup, parent: Element, old: Element | None, lines: list[str]) -> _Edit:
    """Put an element in the place of the old one, or first into its parent."""
    new = [line.encode() for line in lines]
    if old is not None:
        return (
            old.start,
            markup.end(old),
            (markup.newline + markup.indentation(old.start)).join(new),
        )
    indentation = markup.indentation(parent.start)
    inner = markup.newline + indentation + b"  "
    text = inner + inner.join(new)
    tag_end = markup.tag_end(parent)
    if not markup.is_empty(parent):
        return tag_end, tag_end, text
    close = markup.newline + indentation + b"</" + parent.name.encode() + b">"
    return markup.content.rindex(b"/", parent.start, tag_end), tag_end, b">" + text + close


def _dynamics(markup: Markup, joint: Element, update: JointUpdate) -> _Edit:
    values = {
        key: f'{key}="{value!r}"'
        for key, value in (("damping", update.damping), ("friction", update.friction))
    }
    old = markup.only(joint, "dynamics")
    if old is None:
        return _put(markup, joint, None, [f"<dynamics {' '.join(values.values())}/>"])
    tag_end = markup.tag_end(old)
    tag = markup.content[old.start : tag_end]
    for key, written in values.items():
        given = re.search(rb"(?<=\s)" + key.encode() + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", tag)
        first = len(b"<dynamics")
        start, end = (first, first) if given is None else given.span()
        tag = tag[:start] + (b" " if given is None else b"") + written.encode() + tag[end:]
    return old.start, tag_end, tag


def _header(markup: Markup, provenance: str) -> _Edit:
    # Two hyphens would end the comment's text (XML 1.0, 2.5).
    said = re.sub("-(?=-)|-$", "~", "".join(c if c.isprintable() else " " for c in provenance))
    comment = f"<!-- format: {FORMAT}. {said} -->".encode()
    for earlier in re.finditer(rb"(?s)<!--.*?-->", markup.content[: markup.root.start]):
        if f"format: {FORMAT}".encode() in earlier[0]:
            return *earlier.span(), comment
    return markup.root.start, markup.root.start, comment + markup.newline
