"""Names of cells in an audit log: a rename is an entry, and counts for the entries before it.

Nothing in the log is rewritten. Whoever folds the log reads it under the names that its cells have
now (`with_present_names`, once: a name that a rename has freed may be another cell's by now). What
is entered later under the old name is of another cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from daq.ledger.audit import AuditAction, AuditEntry


@dataclass(frozen=True, slots=True)
class RenamedCell:
    """A rename in an audit log."""

    old: str
    new: str
    at: str  #: ISO 8601 time with its zone
    robot: object  #: of the cell, as plain JSON; None where the entry lacks it

    @property
    def remedy(self) -> str:
        """What to do where a cell file has the old name: a twin with that name looks the same."""
        return (
            f"if this is the robot that was renamed, write its present name {self.new!r} into the "
            "cell file (`name:`); if it is another robot, give it another name, or another audit "
            "log (`history.audit` of the cell file)"
        )


def drives_of(cell: str) -> str:
    """Return the name of a cell's drives in audit and history."""
    return f"drives of cell {cell}"


def rename_of(entry: AuditEntry) -> RenamedCell | None:
    """Return the rename that an entry makes; None where it is another entry."""
    old = entry.details.get("old_name")
    new = entry.details.get("cell")
    if (
        entry.action is not AuditAction.RENAMED
        or not isinstance(old, str)
        or not isinstance(new, str)
    ):
        return None
    return RenamedCell(old, new, entry.at, entry.details.get("robot"))


def with_present_names(entries: Sequence[AuditEntry]) -> Sequence[AuditEntry]:
    """Return the entries with the names that their cells have now,
    and the digests that they have in the file.
    """
    if all(one.action is not AuditAction.RENAMED for one in entries):
        return entries
    present: dict[str, str] = {}
    found = []
    for one in reversed(entries):
        rename = rename_of(one)
        if rename is not None:
            # A rename itself stays as it was made.
            present[rename.old] = present.get(rename.new, rename.new)
            found.append(one)
        else:
            found.append(_under_present_name(one, present))
    return tuple(reversed(found))


def _under_present_name(one: AuditEntry, present: Mapping[str, str]) -> AuditEntry:
    details = dict(one.details)
    cell = details.get("cell")
    if isinstance(cell, str):
        details["cell"] = present.get(cell, cell)
    calibration = details.get("calibration")
    if isinstance(calibration, dict) and isinstance(calibration.get("cell"), str):
        of_cell = calibration["cell"]
        details["calibration"] = {**calibration, "cell": present.get(of_cell, of_cell)}
    subjects = {drives_of(old): drives_of(new) for old, new in present.items()}
    return replace(one, details=details, subject=subjects.get(one.subject, one.subject))


def renames_to(entries: Sequence[AuditEntry], cell: str) -> tuple[RenamedCell, ...]:
    """Return the renames after which a cell has its present name, oldest first:
    one for each name that it had.
    """
    present: dict[str, str] = {}
    found = []
    for one in reversed(entries):
        rename = rename_of(one)
        if rename is None:
            continue
        present[rename.old] = present.get(rename.new, rename.new)
        if present[rename.old] == cell:
            found.append(rename)
    return tuple(reversed(found))


def former_names(entries: Sequence[AuditEntry], cell: str) -> frozenset[str]:
    """Return the names that a cell had before."""
    return frozenset(rename.old for rename in renames_to(entries, cell)) - {cell}


def renamed_to(entries: Iterable[AuditEntry], cell: str) -> RenamedCell | None:
    """Return the rename after which a cell has another name;
    None where it has its own, or got it back.
    """
    found: RenamedCell | None = None
    for one in entries:
        rename = rename_of(one)
        if rename is None:
            continue
        if rename.old == cell:
            found = rename
        elif rename.new == cell:
            found = None
    return found


NOT_OF_HISTORY = frozenset(
    {AuditAction.RENAMED, AuditAction.RECALIBRATION_BEGUN, AuditAction.RECALIBRATION_ENDED}
)
"""Entries that leave nothing in a history:
a job that is held for its cell's old name has two, and renames nothing.
"""


def cell_names(entries: Iterable[AuditEntry]) -> frozenset[str]:
    """Return the names of all cells that have something in a history:
    calibrations, writes, explained changes.
    """
    names: set[str] = set()
    for one in entries:
        if one.action in NOT_OF_HISTORY:
            continue
        calibration = one.details.get("calibration")
        if isinstance(calibration, dict):
            of_calibration = calibration.get("cell")
        else:
            of_calibration = None
        names |= {
            name for name in (one.details.get("cell"), of_calibration) if isinstance(name, str)
        }
    return frozenset(names)


def names_in(entries: Iterable[AuditEntry]) -> tuple[str, ...]:
    """Return the names of the cells that have calibrations in an audit log,
    in the order in which they came.
    """
    names: dict[str, None] = {}
    for one in entries:
        name = one.details.get("cell")
        if one.action is AuditAction.CALIBRATION_ENTERED and isinstance(name, str):
            names[name] = None
    return tuple(names)
