"""The kind of a document of drivegain, for the message about a file that was given in the place of another."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum


class DocumentKind(Enum):
    """Kind of a document, as a message names it."""

    CELL = "a cell file"
    PLAN = "a plan of moves"
    CALIBRATION = "a calibration"
    RESIDUAL = "the numbers of a residual report"
    DRIVE_PROFILE = "a drive profile"
    DRIVE_RECORD = "a record of a write to drives"
    IMPORT = "an import description"
    SIMULATION = "a simulation file"
    SCENARIO = "a scenario of faults"
    LOG = "a log (MCAP)"
    URDF = "a URDF"


FORMATS = {
    "drivegain-plan": DocumentKind.PLAN,
    "drivegain-calibration": DocumentKind.CALIBRATION,
    "drivegain-residual": DocumentKind.RESIDUAL,
    "drivegain drive record 1": DocumentKind.DRIVE_RECORD,
}
"""Kinds whose files say it themselves, by the value of `format`."""
KEYS = {
    DocumentKind.CELL: {"robot", "drive_train", "axes"},
    DocumentKind.DRIVE_PROFILE: {"position", "current", "current_scale"},
    DocumentKind.IMPORT: {"cell", "position", "current"},
    DocumentKind.SIMULATION: {"urdf", "ratio", "axes"},
    DocumentKind.SCENARIO: {"faults"},
}
"""Keys that a file of a kind has, and of those before it no other; the first kind that fits counts."""
MAGIC_OF_LOGS = b"\x89MCAP"


def kind_of_tree(tree: object) -> DocumentKind | None:
    """Return the kind of a parsed document; None for one of no known kind."""
    if not isinstance(tree, Mapping):
        return None
    stated = tree.get("format")
    if isinstance(stated, str) and stated in FORMATS:
        return FORMATS[stated]
    return next((kind for kind, keys in KEYS.items() if keys <= tree.keys()), None)


def kind_of_head(content: bytes) -> DocumentKind | None:
    """Return the kind of a file that is no YAML, by its first bytes; None for one of no known kind."""
    if content.startswith(MAGIC_OF_LOGS):
        return DocumentKind.LOG
    head = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    return DocumentKind.URDF if head.startswith(b"<") and b"<robot" in head else None


IN_ORDER = "give the files in the order of the command's help"  #: Remedy for a file in the place of another
