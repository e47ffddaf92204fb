"""`drivegain history --verify`: whether audit and history are what was written, and what became of killed writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from daq.cli.verb import printable
from daq.configuration.cell import Cell
from daq.configuration.history_place import HistoryPlace
from daq.errors import AuditBroken, HistoryUnreadable
from daq.history.audited import AuditedWrite, acknowledgement_flaws, event_flaws, unknown_writes, writes_to
from daq.history.entry import iso
from daq.history.store import HistoryStore
from daq.recalibration.session import sessions
from daq.write_back.audit import AuditVerdict, verify

_ADDING = (
    "`drivegain history CELL --add CALIBRATION` for each calibration that was written, oldest first, which enters what "
    "the audit tells of them. Where one is no more to be had, keep both files and begin audit and history anew "
    "(`history.audit`, `history.store`)"
)
_SHOWN = 5
"""Sentences of a kind in an error; --json has all."""


@dataclass(frozen=True, slots=True)
class Checked:
    """What was found.

    Attributes:
        audit, store: the two files.
        verdict: of the audit.
        broken: what is broken in the history, and where its rows are not what the audit tells.
        unknown: writes of which the history does not know.
        late: whether the history knows of a later write than one of these: it cannot be entered behind that.
    """

    audit: Path
    store: Path
    verdict: AuditVerdict
    broken: tuple[str, ...]
    unknown: tuple[AuditedWrite, ...] = ()
    late: bool = False

    @property
    def document(self) -> dict[str, Any]:
        """For --json."""
        return {
            "file": str(self.audit),
            "entries": len(self.verdict.entries),
            "holds": self.verdict.holds,
            "broken_line": self.verdict.broken,
            "flaws": [{"line": f.line, "flaw": f.flaw.value, "says": f.says} for f in self.verdict.flaws],
            "torn_lines": list(self.verdict.torn),
            "open_writes": [
                {
                    "number": one.begun.number,
                    "at": one.begun.at,
                    "who": one.begun.who,
                    "file": one.begun.subject,
                    "content": one.content.value,
                }
                for one in self.verdict.open_writes
            ],
            "history_broken": list(self.broken),
            "unknown_writes": [
                {
                    "number": one.ended.number,
                    "at": one.ended.at,
                    "who": one.ended.who,
                    "file": one.ended.subject,
                    "action": one.ended.action.value,
                    "calibration_sha256": one.calibration,
                }
                for one in self.unknown
            ],
        }

    def say(self, console: Console) -> None:
        """For a person; flaws are the error's to tell."""
        state = "unbroken" if self.verdict.holds else "BROKEN"
        console.print(f"{self.audit}: {len(self.verdict.entries)} entries, chain {state}.")
        if self.verdict.torn:
            lines = ", ".join(map(str, self.verdict.torn))
            console.print(f"Unfinished lines, left by a writer that was killed: {lines}. They are no flaw.")
        for one in self.verdict.open_writes:
            begun = one.begun
            console.print(
                f"Line of entry {begun.number}: {begun.action.value} by {printable(begun.who)} at {begun.at} was never "
                f"ended; {printable(begun.subject)} was found {one.content.value}."
            )
        console.print(f"{self.store}: {'BROKEN' if self.broken else 'NOT COMPLETE' if self.unknown else 'sound'}.")

    def require(self) -> None:
        """Raise what is wrong.

        Raises:
            AuditBroken: the audit is not what was written, with the first line that is not and all flaws.
            HistoryUnreadable: the history's file is broken, its rows are not what the audit tells, or it does not know
                of a write.
        """
        if not self.verdict.holds:
            first = self.verdict.flaws[0]
            more = "".join(f"\n  line {flaw.line}: {flaw.flaw.value}: {flaw.says}" for flaw in self.verdict.flaws)
            raise AuditBroken(
                f"{self.audit}, line {first.line}",
                found=f"{len(self.verdict.flaws)} places that are not what was written{more}\n ",
                expected="entries that were never changed, moved or taken away",
                remedy="keep this file as it is, compare it with a backup, ask who can write to it; until that is "
                "known trust the controller's file by its backups only, and begin audit and history anew, both "
                "(`history.audit`, `history.store`): the old history would look for what is missing for ever",
            )
        unknown = [printable(f"no event of {one}") for one in self.unknown]
        if self.broken:
            raise HistoryUnreadable(
                str(self.store),
                found=_first([*self.broken, *unknown]),
                expected="a sound SQLite file with the rows that drivegain wrote",
                remedy="keep a copy, ask who can write to it, and restore the last good one from a backup",
            )
        if self.unknown:
            raise HistoryUnreadable(
                str(self.store),
                found=_first(unknown),
                expected="an event of every write to this cell's controller that the audit tells of",
                remedy="it knows of a later write: restore the last good one from a backup, or build it anew in "
                f"another file (`history.store`) with {_ADDING}"
                if self.late
                else f"{_ADDING}; of a rollback with any one",
            )


def verify_history(cell: Cell, place: HistoryPlace, store: HistoryStore) -> Checked:
    """Check both files, each by itself and against the other.

    What must be in the audit, the history knows, and the sessions of scheduled recalibrations; what must be in the
    history, the audit. Raises as `daq.write_back.audit.verify` and the store.
    """
    verdict, broken = _verdict(cell, place, store), store.integrity()
    if not verdict.holds:  # its entries prove nothing
        return Checked(place.audit, place.store, verdict, broken)
    entries = verdict.entries
    told = {one.sha256: one for one in entries}
    events = [(number, event, told.get(event.audit or "")) for number, event in enumerate(store.events(), start=1)]
    broken += tuple(
        printable(f"event {number}: {says}")
        for number, event, entry in events
        if entry is not None
        for says in event_flaws(event, entry, entries)
    )
    broken += tuple(
        printable(f"acknowledgement of {noted.axis} at {iso(noted.at)}: {says}")
        for noted in store.acknowledgements()
        if (entry := told.get(noted.audit)) is not None
        for says in acknowledgement_flaws(noted, entry)
    )
    unknown, late = unknown_writes(writes_to(cell, entries), store.audited())
    return Checked(place.audit, place.store, verdict, broken, tuple(unknown), late != unknown)


def _verdict(cell: Cell, place: HistoryPlace, store: HistoryStore) -> AuditVerdict:
    past = () if cell.recalibration is None else sessions(cell.recalibration.folder, cell.name)
    ends = [session.state.audit_sha256 for session in past]
    return verify(place.audit, store.audited().union(end for end in ends if end is not None))


def _first(sentences: Sequence[str]) -> str:
    more = len(sentences) - _SHOWN
    return "; ".join(sentences[:_SHOWN]) + (f"; and {more} more (--json tells all)" if more > 0 else "")
