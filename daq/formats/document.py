"""Read a controller's file in any format, and replace numbers in it so that every other byte stays.

Comments, order, quotes, spacing, line ends and encoding belong to the person who wrote the file
(docs/decisions/0023-documents-keep-their-bytes.md).

To add a format:

1. Write `formats/<name>_document.py` with a frozen dataclass that derives from
   `ControllerDocument`. It implements `locate` (keys to places in the text) and `readings` (all
   values, once for each parser). It overrides `path_of` where keys are no dotted paths, and
   `number` where a parser's value contains blanks around the number; `encoding` is that of a file
   that is not UTF-8.
2. Add one entry to `FORMATS` below, and the name of the format to `ControllerFormat`: the word in
   the cell file.
3. In `tests/daq/formats/test_documents.py` add a strategy of files and a reader that knows nothing
   of this project's keys to `CASES`, and the suffixes to `test_the_name_gives_the_format` (`a.conf`
   is there for a suffix that no format has).
4. Name the format in `docs/how-to/write-gains.md`; `make reference` writes the other pages.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from daq.config.controller import ControllerFormat
from daq.config.yaml_file import MAX_BYTES, read_file
from daq.errors import ControllerUnfit
from daq.formats.dcf_document import dcf_document
from daq.formats.json_document import json_document
from daq.formats.scalar import ControllerDocument
from daq.formats.xml_document import xml_document
from daq.formats.yaml_document import yaml_document


@dataclass(frozen=True, slots=True)
class FormatOfFile:
    """What belongs to a format."""

    read: Callable[[bytes, str], ControllerDocument]  #: from content and name of a file
    suffixes: tuple[str, ...]  #: of its files
    #: a comment behind a number on its line; None where a format has none there
    comment: re.Pattern[str] | None = None


FORMATS = {
    ControllerFormat.YAML: FormatOfFile(
        yaml_document,
        (".yaml", ".yml"),
        re.compile(r"[^\r\n#]*[ \t]#[ \t]*([^\r\n]*[^\s])"),
    ),
    ControllerFormat.JSON: FormatOfFile(json_document, (".json",)),
    ControllerFormat.XML: FormatOfFile(
        xml_document, (".xml",), re.compile(r"[^\r\n]*?<!--[ \t]*([^\r\n]*?)[ \t]*-->")
    ),
    ControllerFormat.DCF: FormatOfFile(dcf_document, (".dcf", ".eds")),
}


def format_of(name: str) -> ControllerFormat:
    """Return the format that a file's name says, a backup's too; YAML where it says none."""
    for suffix in reversed(Path(name).suffixes):
        for known, kind in FORMATS.items():
            if suffix.lower() in kind.suffixes:
                return known
    return ControllerFormat.YAML


def comment_behind(rest: str, name: str, file_format: ControllerFormat | None = None) -> str:
    """Return the comment after a number on its line, empty where there is none.

    Args:
        rest: text of the file after the number.
        name: of the file.
        file_format: of the file; None where its name says it.
    """
    pattern = FORMATS[file_format or format_of(name)].comment
    if pattern is None:
        return ""
    found = pattern.match(rest)
    if found is None:
        return ""
    return found[1]


def decode_document(
    content: bytes,
    name: str,
    format: ControllerFormat | None = None,  # noqa: A002
) -> ControllerDocument:
    """Parse a controller file; without a format, its name says it.

    Raises:
        ControllerUnfit: the bytes are no text of that format; other flaws are found by `locate`.
    """
    kind = FORMATS[format or format_of(name)]
    return kind.read(content, name)


def read_controller_file(path: Path) -> bytes:
    """Read a controller file; a pipe or device is not waited for.

    Raises:
        ControllerUnfit: there is none, it is no regular file, is too large, or cannot be read.
    """
    return read_file(
        path,
        ControllerUnfit,
        expected=f"the controller's file, at most {MAX_BYTES >> 20} MiB",
        remedy="correct `controller.file` of the cell configuration, or give --to FILE",
    )
