"""A controller's file, in whichever format: where its gains stand, and the same bytes with other numbers there.

Only the characters of a changed number are touched. Comments, order, quotes, spacing, line ends and encoding belong to
the human who wrote the file and stay byte for byte (docs/decisions/0023-documents-keep-their-bytes.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, Self

from daq.config.controller import ControllerFormat
from daq.errors import ControllerUnfit
from daq.writeback.formats.dcf_document import dcf_document
from daq.writeback.formats.json_document import json_document
from daq.writeback.formats.scalar import Scalar
from daq.writeback.formats.xml_document import xml_document
from daq.writeback.formats.yaml_document import yaml_document

MAX_BYTES = 4 * 2**20
"""No controller's parameter file is larger; a file that is must be something else."""

_SUFFIXES = (
    (".yaml", ControllerFormat.YAML),
    (".yml", ControllerFormat.YAML),
    (".json", ControllerFormat.JSON),
    (".xml", ControllerFormat.XML),
    (".dcf", ControllerFormat.DCF),
    (".eds", ControllerFormat.DCF),
)


class ControllerDocument(Protocol):
    """A controller's file as it was read; frozen."""

    @property
    def name(self) -> str:
        """What to call it in messages."""

    @property
    def text(self) -> str:
        """All of it."""

    @property
    def content(self) -> bytes:
        """The text as it stands in the file."""

    def locate(self, keys: tuple[str, ...]) -> tuple[Scalar, ...]:
        """Find the numbers of some keys, in their order.

        Raises:
            ControllerUnfit: the file does not parse, or a key leads to no number that can be changed on its own.
        """

    def with_values(self, spelling: Mapping[str, str]) -> Self:
        """The same text with other numbers, given as text by their keys, read back and compared.

        Raises:
            ControllerUnfit: as `locate`, or the new text does not say what was meant and nothing else.
        """

    def check_against(self, before: Self, spelling: Mapping[str, str]) -> None:
        """Refuse unless this file differs from `before` in the named numbers alone.

        Raises:
            ControllerUnfit: it differs in more, or in less.
        """


def format_of(name: str) -> ControllerFormat:
    """Format that a file's name tells, a backup's too; YAML where it tells none."""
    for suffix in reversed(Path(name).suffixes):
        for known, suffix_format in _SUFFIXES:
            if suffix.lower() == known:
                return suffix_format
    return ControllerFormat.YAML


def decode(content: bytes, name: str, format: ControllerFormat | None = None) -> ControllerDocument:  # noqa: A002
    """A controller file from its bytes.

    Args:
        content: of the file.
        name: what to call it in messages.
        format: of the file; None where its name tells.

    Raises:
        ControllerUnfit: the bytes are no text of that format. What is wrong further in, `locate` tells.
    """
    chosen_format = format or format_of(name)
    if chosen_format is ControllerFormat.JSON:
        return json_document(content, name)
    if chosen_format is ControllerFormat.XML:
        return xml_document(content, name)
    if chosen_format is ControllerFormat.DCF:
        return dcf_document(content, name)
    return yaml_document(content, name)


def read_bytes(path: Path) -> bytes:
    """Content of a controller file; a pipe or device is not waited for.

    Raises:
        ControllerUnfit: there is none, it is no regular file, is too large, or cannot be read.
    """
    try:
        # Looked at before it is opened: opening a pipe waits for its other end.
        if path.is_file():
            content = _bounded(path)
            if content is not None:
                return content
            found = f"more than {MAX_BYTES >> 20} MiB"
        else:
            found = "something that is no regular file" if path.exists() else "no such file"
    except OSError as error:
        found = (error.strerror or type(error).__name__).lower()
    raise ControllerUnfit(
        str(path),
        found=found,
        expected="the controller's file",
        remedy="correct `controller.file` of the cell configuration, or give --to FILE",
    )


def _bounded(path: Path) -> bytes | None:
    """The content, None where it has no end: the size that the file system tells is not believed."""
    with path.open("rb") as stream:
        content = stream.read(MAX_BYTES + 1)
    return content if len(content) <= MAX_BYTES else None
