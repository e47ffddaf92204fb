"""Find the gains in a controller's XML.

A number is named by a path from the root as it is written, prefixes included: `Robot/Axis[@name='J1']/Gain` is the text
of an element, `Robot/Axis[2]/@gain` an attribute. It is read as an xs:double: decimal, whatever zeros it begins with
(`010` is 10). A document type is refused: without one there are no entities of the document's own, and nothing to fetch
or to expand.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from daq.errors import ControllerUnfit
from daq.writeback.formats.scalar import CORRECT_KEY, ControllerDocument, KeyPath, Leaves, Scalar, unfit

TEXT = "text()"
_ENCODING_OF_NONE = "utf-8"


@dataclass(frozen=True, slots=True)
class Element:
    """An element; places are bytes of the file.

    Attributes:
        label: its name, and its number in the file: a path from the root would grow with the depth.
        start, end: of its start tag's `<`, and of its end tag's.
        pieces: text, comments and instructions between its elements, each in its place.
    """

    name: str
    attributes: dict[str, str]
    label: str
    start: int
    line: int
    ends: list[int] = field(default_factory=list)
    children: list[Element] = field(default_factory=list)
    pieces: list[tuple[str, str]] = field(default_factory=list)

    @property
    def end(self) -> int:
        """Place of its end tag's `<`; that of its start tag where it is empty."""
        return self.ends[0]


@dataclass(frozen=True, slots=True)
class ParsedXml:
    """A file as expat sees it."""

    root: Element  #: its root element
    around: Element  #: parent of the root, with the comments beside it
    encoding: str  #: as declared


def parse(content: bytes, name: str) -> ParsedXml:
    """Read a whole file.

    Raises:
        ControllerUnfit: it is no XML, or has a document type.
    """
    reader = _Reader(name)
    try:
        reader.read(content)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ControllerUnfit(
            name,
            found=f"no XML ({error})",
            expected="one XML document",
            remedy="correct the file; nothing was written",
        ) from error
    return ParsedXml(reader.root.children[0], reader.root, reader.encoding)


class _Reader:
    """Build the tree from expat's events, without recursion however deep the file is."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.encoding = _ENCODING_OF_NONE
        self.root = Element("", {}, "", 0, 0)
        self._open = [self.root]
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.XmlDeclHandler = self._declaration
        self._parser.StartDoctypeDeclHandler = self._document_type
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = lambda text: self._piece(TEXT, text)
        self._parser.CommentHandler = lambda text: self._piece("comment()", text)
        self._parser.ProcessingInstructionHandler = lambda target, text: self._piece(f"?{target}", text)

    def read(self, content: bytes) -> None:
        """Parse a whole file."""
        self._parser.Parse(content, True)

    def _declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        self.encoding = encoding or _ENCODING_OF_NONE

    def _document_type(self, *_: object) -> None:
        raise ControllerUnfit(
            self._name,
            found="a document type (<!DOCTYPE …>)",
            expected="XML without one: it may define entities and fetch other files",
            remedy="remove it if the controller does without; nothing was written",
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        parent = self._open[-1]
        self._count += 1
        element = Element(
            name,
            attributes,
            f"{name}#{self._count}",
            self._parser.CurrentByteIndex,
            self._parser.CurrentLineNumber,
        )
        parent.children.append(element)
        parent.pieces.append(("element()", name))
        self._open.append(element)

    def _end(self, name: str) -> None:
        self._open.pop().ends.append(self._parser.CurrentByteIndex)

    def _piece(self, kind: str, text: str) -> None:
        self._open[-1].pieces.append((kind, text))


_SPACE = " \t\r\n"
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_NAME = r"[^\s/\[\]@='\"<>&]+"
_CONDITION = rf"\[(?:@({_NAME})=(?:'([^']*)'|\"([^\"]*)\")|([1-9][0-9]*))\]"
_STEP = re.compile(rf"({_NAME})((?:{_CONDITION})*)")
_ATTRIBUTE = re.compile(r"\s+([^\s=/>]+)\s*=\s*(?:'([^']*)'|\"([^\"]*)\")")


@dataclass(frozen=True, slots=True)
class XmlDocument(ControllerDocument):
    """An XML file as it was read."""

    encoding: str  #: of the file

    @property
    def content(self) -> bytes:
        """The text as bytes of the file."""
        return self.text.encode(self.encoding)

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`; a file with a document type is refused."""
        content = self.content
        root = parse(content, self.name).root
        return tuple(self._locate(content, root, key) for key in keys)

    def readings(self) -> tuple[Leaves]:
        """Read every attribute, piece of text, comment and instruction, and the order of the elements."""
        return (dict(_leaves(self)),)

    def leaf(self, key: str) -> KeyPath:
        """Return the path of an element's text, or of an attribute."""
        return self._find(parse(self.content, self.name).root, key).leaf

    def number(self, leaf: str) -> str:
        """Return a number without the blanks around it."""
        return leaf.strip(_SPACE)

    def _locate(self, content: bytes, root: Element, key: str) -> Scalar:
        place = self._find(root, key)
        element = place.element
        tag = len(content[: element.start].decode(self.encoding))
        at = tag + 1 + len(element.name)
        attributes: dict[str, tuple[int, str]] = {}
        while (match := _ATTRIBUTE.match(self.text, at)) is not None:
            group = 2 if match[2] is not None else 3
            attributes[match[1]] = (match.start(group), match[group])
            at = match.end()
        if place.attribute is not None:
            start, written = attributes[place.attribute]
        else:
            start = self.text.index(">", at) + 1
            # An empty element <Gain/> ends where it begins.
            end = max(start, len(content[: element.end].decode(self.encoding)))
            written = self.text[start:end]
        number = written.strip(_SPACE)
        if not _NUMBER.fullmatch(number):
            raise unfit(
                self.name,
                key,
                f"line {element.line}: {written!r:.60}",
                "write a plain decimal number there, without entities, CDATA, comments or other elements beside it",
            )
        start += written.index(number)
        return Scalar(key, float(number), number, start, start + len(number), self.text.count("\n", 0, start) + 1)

    def _find(self, root: Element, key: str) -> _Place:
        steps, attribute = self._steps(key)
        candidates, walked = [root], ""
        for position, step in enumerate(steps):
            inside = candidates if position == 0 else candidates[0].children
            candidates = step.choose(inside)
            if len(candidates) != 1:
                raise self._not_one(key, step, candidates, inside, walked)
            walked = f"{walked}/{step.written}".lstrip("/")
        element = candidates[0]
        if attribute is None:
            return _Place(element, None)
        if attribute not in element.attributes:
            has = ", ".join(f"@{name}" for name in list(element.attributes)[:12]) or "none"
            raise unfit(self.name, key, f"no attribute @{attribute} in {walked} (it has {has})", CORRECT_KEY)
        return _Place(element, attribute)

    def _steps(self, key: str) -> tuple[list[_Step], str | None]:
        """Split a path into its elements and its attribute."""
        steps: list[_Step] = []
        at = 1 if key.startswith("/") else 0
        while (match := _STEP.match(key, at)) is not None:
            conditions = [(c[1], c[2] if c[2] is not None else c[3], c[4]) for c in re.finditer(_CONDITION, match[2])]
            having = tuple((name, value) for name, value, _ in conditions if name)
            number = next((int(position) for name, _, position in conditions if not name), None)
            steps.append(_Step(match[0], match[1], having, number))
            at = match.end()
            if at == len(key):
                return steps, None
            if key[at] != "/":
                break
            last = re.fullmatch(f"@({_NAME})", key[at + 1 :])
            if last is not None:
                return steps, last[1]
            at += 1
        raise unfit(
            self.name,
            key,
            "a path that cannot be read" + (f" from {key[at:]!r} on" if at else ""),
            f"{CORRECT_KEY}: Robot/Axis[@name='J1']/Gain, or Robot/Axis[1]/@gain",
        )

    def _not_one(
        self, key: str, step: _Step, found: list[Element], inside: list[Element], walked: str
    ) -> ControllerUnfit:
        place = walked or "the file"
        if found:
            lines = ", ".join(str(element.line) for element in found[:12])
            remedy = f"choose one by an attribute ({step.name}[@name='…']) or its number ({step.name}[1])"
            return unfit(self.name, key, f"{len(found)} of {step.written} in {place}, on lines {lines}", remedy)
        has = ", ".join(dict.fromkeys(element.name for element in inside)) or "no elements"
        return unfit(self.name, key, f"no {step.written} in {place} (it has {has:.200})", CORRECT_KEY)


@dataclass(frozen=True, slots=True)
class _Place:
    """An element, or one of its attributes."""

    element: Element
    attribute: str | None

    @property
    def leaf(self) -> KeyPath:
        """Path among the leaves."""
        return (self.element.label, f"{TEXT}[1]" if self.attribute is None else f"@{self.attribute}")


@dataclass(frozen=True, slots=True)
class _Step:
    """One part of a path."""

    written: str  #: as in the path
    name: str  #: of the element
    having: tuple[tuple[str, str], ...]  #: attributes with their values
    number: int | None  #: among those, from 1; None where there must be one alone

    def choose(self, elements: list[Element]) -> list[Element]:
        """Select the elements that the step means."""
        meant = [
            element
            for element in elements
            if element.name == self.name and all(element.attributes.get(name) == value for name, value in self.having)
        ]
        return meant if self.number is None else meant[self.number - 1 : self.number]


def xml_document(content: bytes, name: str) -> XmlDocument:
    """Parse an XML document.

    Raises:
        ControllerUnfit: they are no XML, have a document type, or are in an encoding in which ASCII is not one byte a
            character.
    """
    encoding = parse(content, name).encoding
    ascii_characters = bytes(range(128))
    try:
        text = content.decode(encoding)
        kept = text.encode(encoding) == content and ascii_characters.decode(encoding).encode() == ascii_characters
    except (UnicodeError, LookupError):
        kept = False
    if not kept:
        raise ControllerUnfit(
            name,
            found=f"bytes that are not kept when they are read and written as {encoding}",
            expected="UTF-8, or an encoding of one byte a character that the file declares",
            remedy="save the file as UTF-8; nothing was written",
        )
    return XmlDocument(name, text, encoding)


def _leaves(document: XmlDocument) -> Iterator[tuple[KeyPath, str]]:
    """Walk over all leaves of a document."""
    waiting = [parse(document.content, document.name).around]
    while waiting:
        element = waiting.pop()
        for name, value in element.attributes.items():
            yield (element.label, f"@{name}"), value
        for position, (kind, text) in enumerate(element.pieces, start=1):
            yield (element.label, f"{kind}[{position}]"), text
        waiting.extend(element.children)
