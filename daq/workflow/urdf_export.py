"""From a calibration to the physically consistent parameters of its robot."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.errors import ConfigurationMissing, SchemaMismatch
from ident.calibration import Calibration
from ident.effects.effect import Property
from ident.model.bodies import Body
from ident.model.model import Model
from ident.physical.physical import (
    InertiaPrior,
    PhysicalParameters,
    inertia_prior,
    physical_parameters,
    random_motion,
    regroup,
)
from ident.prediction import placed_effect

FloatArray = NDArray[np.float64]

SAMPLES = 400
"""Random states on which torques are compared: some ten times as many equations as a six-axis arm has parameters."""
SEED = 0
MOTION = 0.6
"""Share of the limits of speed and acceleration within which the states lie: recorded runs have a root mean square of
about a third of their limits, and uniform states one of 0.58 of theirs."""


@dataclass(frozen=True, slots=True)
class Shift:
    """One base parameter that had to move."""

    name: str  #: leading name of the base parameter
    identified: float  #: before and after
    realised: float  #: before and after
    deviations: float  #: the change in standard deviations of the fit


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalRobot:
    """Bodies of the robot, from a calibration."""

    parameters: PhysicalParameters  #: with their certificate
    prior: InertiaPrior  #: what was believed of the links beforehand
    #: Of base parameters, largest first; none where the identified ones are those of a possible robot.
    shifts: tuple[Shift, ...]


def require_solver() -> None:
    """Say at once that the solver is missing, before anything is computed.

    Raises:
        ConfigurationMissing: with the extra to install.
    """
    missing = [package for package in ("cvxpy", "clarabel") if find_spec(package) is None]
    if missing:
        raise ConfigurationMissing(
            "physical parameters",
            found=f"no package {' and '.join(missing)}",
            expected="the semidefinite solver of the optional extra `physical`",
            remedy="pip install 'drivegain[physical]'",
        )


def physical_robot(calibration: Calibration, model: Model, limits: FloatArray, urdf: str) -> PhysicalRobot:
    """The parameters of bodies that could exist and need the torques that the calibration says.

    Args:
        calibration: its gains, payloads and effects take no part; an axis with an accepted effect of friction may have
            any sign of fv and fs, because they are only a part of its friction.
        model: the declared model of its robot.
        limits: ranges in which the torques are compared, as of `ident.physical.physical.random_motion`, shape (4, n).
        urdf: for the prior.

    Raises:
        ModelError: the calibration is of another robot.
        NotPhysical: no set was found.
    """
    columns = model.regressor(random_motion(limits, SAMPLES, SEED))
    of_effects = {coefficient.name for effect in calibration.effects for coefficient in effect.coefficients}
    known = {p.name: p for p in calibration.parameters if p.name not in of_effects and ":" not in p.name}
    base = regroup(model, tuple(known), columns.transpose(0, 2, 1).reshape(-1, columns.shape[1]))
    placed = [placed_effect(effect, calibration)[0] for effect in calibration.effects]
    friction = frozenset(one.axis for one in placed if one.effect.declares is Property.ODD_IN_VELOCITY)
    prior = inertia_prior(urdf)
    values = np.array([known[name].value for name in base.names])
    found = physical_parameters(model, base, values, columns, prior, friction)
    shifts = []
    if not found.exact:
        for name, before, after in zip(base.names, found.identified, found.realised, strict=True):
            std = known[name].std
            deviations = float(abs(after - before) / std) if std > 0.0 else float("inf")
            shifts.append(Shift(name.split(" ", 1)[0], float(before), float(after), deviations))
    return PhysicalRobot(found, prior, tuple(sorted(shifts, key=lambda shift: -shift.deviations)))


def cell_limits(cell: Cell) -> FloatArray:
    """Middle and half of the range of each axis, and MOTION of its speed and acceleration, shape (4, n) [rad, s]."""
    ends = np.array([axis.limits.position for axis in cell.axes])
    speed = [MOTION * axis.limits.velocity for axis in cell.axes]
    acceleration = [MOTION * axis.limits.acceleration for axis in cell.axes]
    return np.array([ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0]), speed, acceleration])


MAX_BYTES = 16 * 2**20  #: No URDF is larger; meshes are files of their own
MAX_DEPTH = 64  #: Elements in elements; a URDF has five or so, and readers that recurse end at some depth
_TAG = re.compile(rb"<[^\s/>]+(?:\s+[^\s=>/]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*\s*(/?)>")


@dataclass(slots=True)
class Element:
    """One element at or below the level of links and joints."""

    name: str  #: of its tag
    attributes: dict[str, str]  #: as given
    start: int  #: offsets of '<', behind the start tag, and behind the whole element
    tag_end: int  #: offsets of '<', behind the start tag, and behind the whole element
    empty: bool  #: written as <name/>
    end: int = -1  #: offsets of '<', behind the start tag, and behind the whole element
    children: list[Element] = field(default_factory=list)  #: one level further down


@dataclass(frozen=True, slots=True)
class Markup:
    """The elements of a URDF."""

    file: str  #: what messages call it
    root: Element  #: <robot>
    head_comments: tuple[tuple[int, int], ...]  #: start and end of comments before it
    links: Mapping[str, Element]  #: by their names
    joints: Mapping[str, Element]  #: by their names
    fixed: Mapping[str, tuple[str, ...]]  #: links that fixed joints hold to a link, by its name

    def joint(self, name: str) -> Element:
        """The joint of this name.

        Raises:
            SchemaMismatch: there is none.
        """
        return self._named(self.joints, "joint", name)

    def link(self, name: str) -> Element:
        """The link of this name.

        Raises:
            SchemaMismatch: there is none.
        """
        return self._named(self.links, "link", name)

    def only(self, element: Element, name: str) -> Element | None:
        """The child of this name, None without one.

        Raises:
            SchemaMismatch: there are several; readers differ in which of them counts.
        """
        found = [child for child in element.children if child.name == name]
        if len(found) > 1:
            what = f"<{element.name} name={element.attributes.get('name', '')!r}>"
            raise refused(self.file, f"{len(found)} <{name}> in {what}", "at most one", "remove the wrong one")
        return found[0] if found else None

    def child_of(self, joint: str) -> str:
        """Name of the link that a joint moves.

        Raises:
            SchemaMismatch: it names none.
        """
        return _end(self.file, self.joint(joint), "child")

    def _named(self, elements: Mapping[str, Element], kind: str, name: str) -> Element:
        if name not in elements:
            known = ", ".join(sorted(elements)) or "none"
            raise refused(self.file, f"no {kind} {name!r} (there are {known})", "the robot of the calibration")
        return elements[name]


def parse_markup(content: bytes, file: str) -> Markup:
    """Find links and joints.

    Raises:
        SchemaMismatch: not well-formed, not UTF-8, too large, too deep, with a document type (which can define
            entities and name files), or two links or joints of one name.
    """
    if len(content) > MAX_BYTES:
        raise refused(file, f"{len(content)} bytes", f"at most {MAX_BYTES}")
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise refused(file, str(error), "UTF-8", "save it as UTF-8") from error
    reader = _Reader(content, file)
    try:
        reader.parse()
    except expat.ExpatError as error:
        raise refused(file, str(error), "well-formed XML", "correct the file") from error
    root = reader.root
    if root is None or root.name != "robot":
        raise refused(file, "no <robot>" if root is None else f"<{root.name}>", "a URDF, <robot> around all")
    links = _by_name(file, root, "link")
    joints = _by_name(file, root, "joint")
    fixed: dict[str, tuple[str, ...]] = {}
    for joint in joints.values():
        if joint.attributes.get("type") == "fixed":
            parent = _end(file, joint, "parent")
            fixed[parent] = (*fixed.get(parent, ()), _end(file, joint, "child"))
    return Markup(file, root, tuple(reader.comments), links, joints, fixed)


def refused(file: str, found: str, expected: str, remedy: str = "give another URDF") -> SchemaMismatch:
    """The error for a file that is no URDF to write into."""
    return SchemaMismatch(file, found=found, expected=expected, remedy=remedy)


class _Reader:
    """Offsets from expat; entities are refused where they could be defined, so none is ever expanded."""

    def __init__(self, content: bytes, file: str) -> None:
        self.content = content
        self.file = file
        self.root: Element | None = None
        self.comments: list[tuple[int, int]] = []
        self._open: list[Element] = []
        self._parser = expat.ParserCreate()
        self._parser.XmlDeclHandler = self._declaration
        self._parser.StartDoctypeDeclHandler = self._document_type
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._stop
        self._parser.CommentHandler = self._comment

    def parse(self) -> None:
        """Read all of it."""
        self._parser.Parse(self.content, True)

    def _declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in {"utf-8", "us-ascii", "ascii"}:
            raise refused(self.file, f"encoding {encoding!r}", "UTF-8", "save it as UTF-8")

    def _document_type(self, name: str, *_: object) -> None:
        raise refused(self.file, f"a document type declaration {name!r}", "none: a URDF needs no entities")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= MAX_DEPTH:
            raise refused(self.file, f"more than {MAX_DEPTH} elements in each other", "a URDF")
        start = self._parser.CurrentByteIndex
        tag = _TAG.match(self.content, start)
        if tag is None:
            raise refused(self.file, f"a tag <{name}> that cannot be read at byte {start}", "plain XML")
        element = Element(name, attributes, start, tag.end(), empty=tag.group(1) == b"/")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _stop(self, _name: str) -> None:
        element = self._open.pop()
        element.end = element.tag_end if element.empty else self.content.index(b">", self._parser.CurrentByteIndex) + 1

    def _comment(self, _text: str) -> None:
        if self.root is None:
            start = self._parser.CurrentByteIndex
            self.comments.append((start, self.content.index(b"-->", start) + 3))


def _by_name(file: str, root: Element, kind: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in root.children:
        if element.name == kind:
            name = element.attributes.get("name", "")
            if name in found:
                raise refused(file, f"two of <{kind} name={name!r}>", "a name for each")
            found[name] = element
    return found


def _end(file: str, joint: Element, which: str) -> str:
    named = [child.attributes.get("link") for child in joint.children if child.name == which]
    if len(named) != 1 or named[0] is None:
        raise refused(file, f"joint {joint.attributes.get('name')!r} without one <{which} link=...>", "one")
    return named[0]


FORMAT = "drivegain-urdf"  #: What the comment at the head of a written URDF says it is
_MERGED = b"<!-- drivegain: this body's inertia is in that of the moving link it is fixed to -->"


@dataclass(frozen=True, slots=True, eq=False)
class JointUpdate:
    """New values of a joint and the link it moves."""

    #: Everything that moves with the joint as one: its link and what fixed joints hold to it, in the link frame.
    body: Body
    damping: float  #: viscous friction, not negative [Nm/(rad/s), N/(m/s)]
    friction: float  #: dry friction, not negative [Nm, N]


@dataclass(frozen=True, slots=True)
class Updated:
    """A URDF with its new values."""

    content: bytes  #: the file
    links: dict[str, str]  #: name of the link that each joint moves, by the joint's name
    merged: tuple[str, ...]  #: links whose own inertia was taken out, because it is part of a moving link's


def update_urdf(content: bytes, name: str, joints: Mapping[str, JointUpdate], provenance: str) -> Updated:
    """Replace or insert <inertial> of each moving link and damping and friction of its joint.

    What the identification calls a link is all that moves as one. Its whole inertia goes to the link behind the moving
    joint; the <inertial> of links that fixed joints hold to it becomes a comment, or their masses would count twice.
    Links fixed to the base keep theirs: no torque depends on them. Comments, order, line ends, meshes and all other
    elements and attributes are the same bytes as before.

    Args:
        content: the user's file.
        name: what to call it in messages.
        joints: of every moving joint, by its name.
        provenance: for the comment at the head; one of an earlier export is replaced.

    Raises:
        SchemaMismatch: it is no plain URDF: not well-formed, not UTF-8, with a document type, or without one of these
            joints or links, or two inertias in one.
    """
    markup = parse_markup(content, name)
    newline = b"\r\n" if b"\r\n" in content else b"\n"
    edits: list[tuple[int, int, bytes]] = []
    links: dict[str, str] = {}
    merged: list[str] = []
    for joint, update in joints.items():
        element = markup.joint(joint)
        link = markup.child_of(joint)
        links[joint] = link
        inertial = "\n".join(_inertial(update.body)).encode().replace(b"\n", newline)
        edits.append(_put(content, markup.link(link), markup.only(markup.link(link), "inertial"), inertial, newline))
        edits.append(_dynamics(content, element, markup.only(element, "dynamics"), update, newline))
        for other in _held_by(link, markup.fixed):
            old = markup.only(markup.link(other), "inertial")
            if old is not None:
                merged.append(other)
                edits.append((old.start, old.end, _MERGED))
    edits.append(_header(content, markup.root, markup.head_comments, provenance, newline))
    out = content
    for start, end, replacement in sorted(edits, reverse=True):
        out = out[:start] + replacement + out[end:]
    return Updated(out, links, tuple(merged))


def _held_by(link: str, fixed: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for child in fixed.get(link, ()):
        yield child
        yield from _held_by(child, fixed)


def _inertial(body: Body) -> tuple[str, ...]:
    x, y, z = (repr(float(value)) for value in body.centre_m)
    values = " ".join(
        f'i{"xyz"[row]}{"xyz"[column]}="{float(body.inertia_kg_m2[row, column])!r}"'
        for row, column in zip(*np.triu_indices(3), strict=True)
    )
    return (
        "<inertial>",
        f'  <origin xyz="{x} {y} {z}" rpy="0 0 0"/>',
        f'  <mass value="{body.mass_kg!r}"/>',
        f"  <inertia {values}/>",
        "</inertial>",
    )


def _put(content: bytes, parent: Element, old: Element | None, new: bytes, newline: bytes) -> tuple[int, int, bytes]:
    """Edit that puts an element in the place of the old one, or first into its parent."""
    if old is not None:
        return old.start, old.end, new.replace(newline, newline + _indentation(content, old.start))
    inner = newline + _indentation(content, parent.start) + b"  "
    text = inner + new.replace(newline, inner)
    if not parent.empty:
        return parent.tag_end, parent.tag_end, text
    close = newline + _indentation(content, parent.start) + b"</" + parent.name.encode() + b">"
    slash = content.rindex(b"/", parent.start, parent.tag_end)
    return slash, parent.tag_end, b">" + text + close


def _dynamics(
    content: bytes, joint: Element, old: Element | None, update: JointUpdate, newline: bytes
) -> tuple[int, int, bytes]:
    values = {"damping": repr(update.damping), "friction": repr(update.friction)}
    if old is None:
        text = "<dynamics " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>"
        return _put(content, joint, None, text.encode(), newline)
    tag = content[old.start : old.tag_end]
    for key, value in values.items():
        written = f'{key}="{value}"'.encode()
        given = re.search(rb"(?<=\s)" + key.encode() + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", tag)
        first = len(b"<dynamics")
        tag = tag[:first] + b" " + written + tag[first:] if given is None else _spliced(tag, given, written)
    return old.start, old.tag_end, tag


def _spliced(text: bytes, at: re.Match[bytes], new: bytes) -> bytes:
    return text[: at.start()] + new + text[at.end() :]


def _header(
    content: bytes, root: Element, comments: Sequence[tuple[int, int]], provenance: str, newline: bytes
) -> tuple[int, int, bytes]:
    # Two hyphens would end the comment's text (XML 1.0, 2.5).
    said = re.sub("-(?=-)|-$", "~", "".join(c if c.isprintable() else " " for c in provenance))
    comment = f"<!-- format: {FORMAT}. {said} -->".encode()
    for start, end in comments:
        if f"format: {FORMAT}".encode() in content[start:end]:
            return start, end, comment
    return root.start, root.start, comment + newline


def _indentation(content: bytes, at: int) -> bytes:
    line = content[content.rfind(b"\n", 0, at) + 1 : at]
    return line if not line.strip() else b""
