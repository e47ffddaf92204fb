"""Read the sections of a DCF, `[title]` and `name=value`: by a scanner that knows the places, and by configparser."""

from __future__ import annotations

import configparser
import re
from dataclasses import dataclass, field

from daq.errors import ControllerUnfit
from daq.formats.scalar import KeyPath

_LINE = re.compile(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)")
_SECTION = re.compile(r"\s*\[([^\]]*)\]\s*")
_ENTRY = re.compile(r"\s*([^=]*?)\s*=\s*(.*?)\s*")
_BYTE_ORDER_MARK = "ï»¿"  #: That of UTF-8, each byte a character


@dataclass(frozen=True, slots=True)
class DcfEntry:
    """`name = value`; the place is that of the value."""

    name: str
    value: str
    start: int
    line: int


@dataclass(frozen=True, slots=True)
class DcfSection:
    """The entries under one `[title]`; keys and titles in lower case, as CiA 306 ignores the case."""

    title: str
    line: int
    entries: list[DcfEntry] = field(default_factory=list)


def sections_of(text: str) -> list[DcfSection]:
    """Split the text into sections; comments and lines other than `name=value` are skipped."""
    sections: list[DcfSection] = []
    for number, line in enumerate(_LINE.finditer(text), start=1):
        written = line[1].removeprefix(_BYTE_ORDER_MARK) if number == 1 else line[1]
        if written.lstrip().startswith(";"):
            continue
        title = _SECTION.fullmatch(written)
        entry = _ENTRY.fullmatch(written)
        if title is not None:
            sections.append(DcfSection(title[1].strip().lower(), number))
        elif entry is not None and sections:
            start = line.end(1) - len(written) + entry.start(2)
            sections[-1].entries.append(DcfEntry(entry[1].lower(), entry[2], start, number))
    return sections


def parsed_values(file: str, text: str) -> dict[KeyPath, str]:
    """Return the values by section and name, as configparser reads them.

    Raises:
        ControllerUnfit: it cannot read them.
    """
    parser = configparser.RawConfigParser(
        strict=False,
        allow_no_value=True,
        delimiters=("=",),
        comment_prefixes=(";",),
        empty_lines_in_values=False,
        default_section="\0",
    )
    try:
        parser.read_string(text.removeprefix(_BYTE_ORDER_MARK))
    except (configparser.Error, AttributeError) as error:
        # An indented line goes on with the value above it; without a value, Python before 3.13 fails for want of one.
        no_value = isinstance(error, AttributeError)
        why = "an indented line below a name without `=`" if no_value else " ".join(str(error).split())[:200]
        raise ControllerUnfit(
            file,
            found=f"no DCF ({why})",
            expected="sections of name=value (CiA 306)",
            remedy="correct the file; nothing was written",
        ) from error
    return {
        (section.strip().lower(), name): value or ""
        for section in parser.sections()
        for name, value in parser.items(section)
    }
