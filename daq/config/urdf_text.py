"""The text of a URDF from its bytes, by the encoding that the file declares."""

from __future__ import annotations

import codecs
import re

from daq.config.foreign_files import foreign_kind
from daq.errors import ConfigurationInconsistent

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_DECLARED = re.compile(rb"""<\?xml[^>]*?\bencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
DEFAULTS = ("utf-8", "utf8")  #: The encoding of XML without a declaration
LONGEST_NAME = 200  #: Characters of a line that may be the name of a file
DECLARATION_BYTES = 1024  #: An XML declaration ends within so many bytes


def urdf_text(data: bytes, name: str) -> str:
    """Return the text of a URDF.

    A byte order mark decides on the encoding, then the XML declaration. Without either, or where
    UTF-8 is declared, it is UTF-8, or Windows-1252 where the bytes are no UTF-8: many editors
    declare the one and save the other. White space before the declaration, which XML forbids, is
    left out.

    Args:
        data: content of the file.
        name: of the file, for messages.

    Raises:
        ConfigurationInconsistent: the declared encoding is unknown, the bytes are not in it, or it
            is a file of another kind.
    """
    foreign = foreign_kind(data)
    if foreign is not None:
        raise ConfigurationInconsistent(
            name, found=foreign.value, expected="a URDF", remedy=foreign.remedy
        )
    text = _decoded(data, name).lstrip()
    # A checkout that makes files of symbolic links leaves one line, the name of the real file.
    is_name = 0 < len(text) <= LONGEST_NAME and "\n" not in text.rstrip() and "<" not in text
    if is_name:
        raise ConfigurationInconsistent(
            name,
            found=f"one line of text, {text.rstrip()!r}",
            expected="a URDF",
            remedy="give the robot's URDF, not a file with its name",
        )
    return text


def _decoded(data: bytes, name: str) -> str:
    """Decode a URDF by its byte order mark or its declaration."""
    encoding = _encoding_of(data)
    try:
        return data.decode(encoding)
    except LookupError as error:
        raise _refused(name, f"the encoding {encoding!r}, which is not known") from error
    except UnicodeDecodeError as error:
        if encoding.lower() in DEFAULTS:
            return data.decode("cp1252", errors="replace")
        raise _refused(
            name, f"byte {error.start} is not in the declared encoding {encoding!r}"
        ) from error
    except UnicodeError as error:  # of encodings of host names, and of `undefined`
        raise _refused(name, f"bytes that are not in the declared encoding {encoding!r}") from error


def _encoding_of(data: bytes) -> str:
    """Return the encoding by the byte order mark or the declaration, UTF-8 without either."""
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    declared = _DECLARED.search(data[:DECLARATION_BYTES])
    if declared is None:
        return DEFAULTS[0]
    return declared[1].decode("ascii")


def _refused(name: str, found: str) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(
        name,
        found=found,
        expected="a URDF in the encoding that its first line declares",
        remedy='save it as UTF-8, with encoding="UTF-8" in its first line',
    )
