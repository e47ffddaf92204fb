"""XML as expat tells it: a tree with the places of its elements in the file, for `xml_document`."""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from daq.errors import ControllerUnfit

TEXT = "text()"
_ENCODING_OF_NONE = "utf-8"


@dataclass(frozen=True, slots=True)
class Element:
    """An element; places are bytes of the file.

    Attributes:
        label: its name, and its number in the file: a path from the root would grow with the depth.
        start, end: of its start tag's `<`, and of its end tag's.
        pieces: what stands between its elements: text, comments, instructions, each in its place.
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
        """Of its end tag's `<`; that of its start tag where it is empty."""
        return self.ends[0]


@dataclass(frozen=True, slots=True)
class ParsedXml:
    """A file as expat sees it.

    Attributes:
        root: its element.
        around: what has the root, and comments beside it, for pieces.
        encoding: that it declares.
    """

    root: Element
    around: Element
    encoding: str


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
    """What expat tells, as a tree; a way without recursion, however deep the file is."""

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
