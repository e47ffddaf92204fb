"""Find the gains in a controller's XML.

A number is named by a path from the root as it is written, prefixes included:
`Robot/Axis[@name='J1']/Gain` is the text of an element, `Robot/Axis[2]/@gain` an attribute. It is
read as an xs:double: decimal, whatever zeros it begins with (`010` is 10). A document type is
refused: without one there are no entities of the document's own, and nothing to fetch or to expand.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field
from xml.parsers import expat

from daq.errors import ControllerUnfit
from daq.formats.scalar import CORRECT_KEY, DECIMAL, ControllerDocument, KeyPath, Scalar, Values

TEXT = "text()"


@dataclass(slots=True)
class Element:
    """An element; places are bytes of the file."""

    name: str  #: as it is written, prefix included
    attributes: dict[str, str]  #: values by name
    #: its name, and its number in the file: a path from the root would grow with the depth
    label: str
    start: int  #: place of its start tag's `<`
    line: int  #: from 1
    end: int = 0  #: place of its end tag's `<`; that of its start tag where it is empty
    children: list[Element] = field(default_factory=list)  #: elements within it
    #: Text, comments and instructions between its elements, each in its place.
    pieces: list[tuple[str, str]] = field(default_factory=list)


def parse(content: bytes, name: str) -> tuple[Element, str]:
    """Read a file, without recursion however deep it is.

    Returns:
        an element around the root, with the comments next to it, and the encoding as declared.

    Raises:
        ControllerUnfit: it is no XML, or has a document type.
    """
    around = Element("", {}, "", 0, 0)
    encodings = ["utf-8"]
    opened = [around]
    count = itertools.count(1)
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def piece(kind: str, text: str) -> None:
        opened[-1].pieces.append((kind, text))

    def document_type(*_: object) -> None:
        raise ControllerUnfit(
            name,
            found="a document type (<!DOCTYPE …>)",
            expected="XML without one: it may define entities and fetch other files",
            remedy="remove it if the controller does without; nothing was written",
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        label = f"{tag}#{next(count)}"
        element = Element(tag, attributes, label, parser.CurrentByteIndex, parser.CurrentLineNumber)
        opened[-1].children.append(element)
        piece("element()", tag)
        opened.append(element)

    def end(_: str) -> None:
        opened.pop().end = parser.CurrentByteIndex

    parser.XmlDeclHandler = lambda _version, encoding, _standalone: encodings.append(
        encoding or encodings[0]
    )
    parser.StartDoctypeDeclHandler = document_type
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = lambda text: piece(TEXT, text)
    parser.CommentHandler = lambda text: piece("comment()", text)
    parser.ProcessingInstructionHandler = lambda target, text: piece(f"?{target}", text)
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ControllerUnfit(
            name,
            found=f"no XML ({error})",
            expected="one XML document",
            remedy="correct the file; nothing was written",
        ) from error
    return around, encodings[-1]


_SPACE = " \t\r\n"
_NAME = r"[^\s/\[\]@='\"<>&]+"
_CONDITION = rf"\[(?:@({_NAME})=(?:'([^']*)'|\"([^\"]*)\")|([1-9][0-9]*))\]"
_STEP = re.compile(rf"({_NAME})((?:{_CONDITION})*)")
_ATTRIBUTE = re.compile(r"\s+([^\s=/>]+)\s*=\s*(['\"])(.*?)\2", re.DOTALL)


@dataclass(frozen=True, slots=True)
class XmlDocument(ControllerDocument):
    """An XML file as it was read."""

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """See `ControllerDocument.locate`; a file with a document type is refused."""
        content = self.content
        around, _ = parse(content, self.name)
        return tuple(self._locate(content, around, key) for key in keys)

    def readings(self) -> tuple[Values]:
        """Read every attribute, piece of text, comment and instruction,
        and the order of the elements.
        """
        values: dict[KeyPath, str] = {}
        around, _ = parse(self.content, self.name)
        waiting = [around]
        while waiting:
            element = waiting.pop()
            for name, value in element.attributes.items():
                values[element.label, f"@{name}"] = value
            for position, (kind, text) in enumerate(element.pieces, start=1):
                values[element.label, f"{kind}[{position}]"] = text
            waiting.extend(element.children)
        return (values,)

    def path_of(self, key: str) -> KeyPath:
        """Return the path of an element's text, or of an attribute."""
        around, _ = parse(self.content, self.name)
        element, attribute = self._find(around, key)
        if attribute is None:
            return (element.label, f"{TEXT}[1]")
        return (element.label, f"@{attribute}")

    def number(self, value: str) -> str:
        """Return a number without the blanks around it."""
        return value.strip(_SPACE)

    def _locate(self, content: bytes, around: Element, key: str) -> Scalar:
        element, attribute = self._find(around, key)
        tag = len(content[: element.start].decode(self.encoding))
        at = tag + 1 + len(element.name)
        attributes: dict[str, tuple[int, str]] = {}
        while (match := _ATTRIBUTE.match(self.text, at)) is not None:
            attributes[match[1]] = (match.start(3), match[3])
            at = match.end()
        if attribute is not None:
            start, written = attributes[attribute]
        else:
            start = self.text.index(">", at) + 1
            # An empty element <Gain/> ends where it begins.
            closing_tag = len(content[: element.end].decode(self.encoding))
            end = max(start, closing_tag)
            written = self.text[start:end]
        number = written.strip(_SPACE)
        if not DECIMAL.fullmatch(number):
            raise self.unfit(
                key,
                f"line {element.line}: {written!r:.60}",
                "write a plain decimal number there, without entities, CDATA, comments or other "
                "elements next to it",
            )
        start += written.index(number)
        line = self.text.count("\n", 0, start) + 1
        return self.decimal_scalar(key, number, start, line)

    def _find(self, around: Element, key: str) -> tuple[Element, str | None]:
        """Return the element that a path names, and its attribute where it names one."""
        steps, attribute = self._steps(key)
        element = around
        walked = ""
        for step in steps:
            found = [child for child in element.children if step.matches(child)]
            if step.number is not None:
                found = found[step.number - 1 : step.number]
            place = walked or "the file"
            if not found:
                names = dict.fromkeys(child.name for child in element.children)
                has = ", ".join(names) or "no elements"
                text = f"no {step.written} in {place} (it has {has:.200})"
                raise self.unfit(key, text, CORRECT_KEY)
            if len(found) > 1:
                lines = ", ".join(str(one.line) for one in found[:12])
                remedy = (
                    f"choose one by an attribute ({step.name}[@name='…']) or its number "
                    f"({step.name}[1])"
                )
                text = f"{len(found)} of {step.written} in {place}, on lines {lines}"
                raise self.unfit(key, text, remedy)
            element = found[0]
            walked = f"{walked}/{step.written}".lstrip("/")
        if attribute is not None and attribute not in element.attributes:
            first = list(element.attributes)[:12]
            has = ", ".join(f"@{name}" for name in first) or "none"
            text = f"no attribute @{attribute} in {walked} (it has {has})"
            raise self.unfit(key, text, CORRECT_KEY)
        return element, attribute

    def _steps(self, key: str) -> tuple[list[_Step], str | None]:
        """Split a path into its elements and its attribute."""
        steps: list[_Step] = []
        at = 0
        if key.startswith("/"):
            at = 1
        while (match := _STEP.match(key, at)) is not None:
            steps.append(_step(match))
            at = match.end()
            if at == len(key):
                return steps, None
            if key[at] != "/":
                break
            last = re.fullmatch(f"@({_NAME})", key[at + 1 :])
            if last is not None:
                return steps, last[1]
            at += 1
        found = "a path that cannot be read"
        if at:
            found = f"{found} from {key[at:]!r} on"
        remedy = f"{CORRECT_KEY}: Robot/Axis[@name='J1']/Gain, or Robot/Axis[1]/@gain"
        raise self.unfit(key, found, remedy)


@dataclass(frozen=True, slots=True)
class _Step:
    """One part of a path."""

    written: str  #: as in the path
    name: str  #: of the element
    having: frozenset[tuple[str, str]]  #: attributes with their values
    number: int | None  #: among those, from 1; None where there must be one alone

    def matches(self, element: Element) -> bool:
        """Whether an element has the name and the attributes; its number is not compared."""
        return element.name == self.name and self.having <= element.attributes.items()


def _step(match: re.Match[str]) -> _Step:
    """Read one part of a path with its conditions: attributes, or a number."""
    having = set()
    number = None
    for condition in re.finditer(_CONDITION, match[2]):
        attribute, quoted, double_quoted, position = condition.groups()
        if attribute:
            value = double_quoted
            if quoted is not None:
                value = quoted
            having.add((attribute, value))
        elif number is None:
            number = int(position)
    return _Step(match[0], match[1], frozenset(having), number)


def xml_document(content: bytes, name: str) -> XmlDocument:
    """Parse an XML document.

    Raises:
        ControllerUnfit: they are no XML, have a document type, or are in an encoding in which ASCII
            is not one byte a character.
    """
    _, encoding = parse(content, name)
    ascii_bytes = bytes(range(128))
    try:
        text = content.decode(encoding)
        is_lossless = text.encode(encoding) == content
        is_ascii_based = ascii_bytes.decode(encoding).encode() == ascii_bytes
    except (UnicodeError, LookupError):
        is_lossless = False
    if not is_lossless or not is_ascii_based:
        raise ControllerUnfit(
            name,
            found=f"bytes that are not kept when they are read and written as {encoding}",
            expected="UTF-8, or an encoding of one byte a character that the file declares",
            remedy="save the file as UTF-8; nothing was written",
        )
    return XmlDocument(name, text, encoding)
