"""Where the elements of a URDF stand in its bytes; nothing in the text can make the reader work for it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.parsers import expat

from daq.errors import SchemaMismatch

MAX_BYTES = 16 * 2**20
"""No URDF is larger; meshes are files of their own."""
MAX_DEPTH = 64
"""Elements in elements; a URDF has five or so, and readers that recurse end at some depth."""
_TAG = re.compile(rb"<[^\s/>]+(?:\s+[^\s=>/]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*\s*(/?)>")


@dataclass(slots=True)
class Element:
    """One element at or below the level of links and joints.

    Attributes:
        name: of its tag.
        attributes: as given.
        start, tag_end, end: offsets of '<', behind the start tag, and behind the whole element.
        empty: written as <name/>.
        children: one level further down.
    """

    name: str
    attributes: dict[str, str]
    start: int
    tag_end: int
    empty: bool
    end: int = -1
    children: list[Element] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Markup:
    """The elements of a URDF.

    Attributes:
        file: what messages call it.
        root: <robot>.
        head_comments: start and end of comments before it.
        links, joints: by their names.
        fixed: links that fixed joints hold to a link, by its name.
    """

    file: str
    root: Element
    head_comments: tuple[tuple[int, int], ...]
    links: Mapping[str, Element]
    joints: Mapping[str, Element]
    fixed: Mapping[str, tuple[str, ...]]

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
