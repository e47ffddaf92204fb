"""`drivegain history --verify`: whether audit and history are what was written, and what became of killed writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from daq.cli.verb import printable
from daq.configuration.cell import Cell
from daq.configuration.history_place import HistoryPlace
from daq.errors import AuditBroken, HistoryUnreadable
from daq.history.store import HistoryStore
from daq.recalibration.session import sessions
from daq.write_back.audit import AuditVerdict, verify


@dataclass(frozen=True, slots=True)
class Checked:
    """What was found.

    Attributes:
        audit, store: the two files.
        verdict: of the audit.
        broken: what SQLite finds broken in the history.
    """

    audit: Path
    store: Path
    verdict: AuditVerdict
    broken: tuple[str, ...]

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
        console.print(f"{self.store}: {'sound' if not self.broken else 'BROKEN'}.")

    def require(self) -> None:
        """Raise what is wrong.

        Raises:
            AuditBroken: the audit is not what was written, with the first line that is not and all flaws.
            HistoryUnreadable: the history's file is broken.
        """
        if not self.verdict.holds:
            first = self.verdict.flaws[0]
            more = "".join(f"\n  line {flaw.line}: {flaw.flaw.value}: {flaw.says}" for flaw in self.verdict.flaws)
            raise AuditBroken(
                f"{self.audit}, line {first.line}",
                found=f"{len(self.verdict.flaws)} places that are not what was written{more}\n ",
                expected="entries that were never changed, moved or taken away",
                remedy="keep this file as it is, compare it with a backup, ask who can write to it; until that is "
                "known trust the controller's file by its backups only, and begin another audit (`history.audit`)",
            )
        if self.broken:
            raise HistoryUnreadable(
                str(self.store),
                found="; ".join(self.broken[:5]),
                expected="a sound SQLite file",
                remedy="keep a copy, and restore the last good one from a backup",
            )


def verify_history(cell: Cell, place: HistoryPlace, store: HistoryStore) -> Checked:
    """Check both files; what must be in the audit, the history knows, and the sessions of scheduled recalibrations.

    Raises as `daq.write_back.audit.verify` and the store.
    """
    past = () if cell.recalibration is None else sessions(cell.recalibration.folder, cell.name)
    ends = [session.state.audit_sha256 for session in past]
    heads = store.audited().union(end for end in ends if end is not None)
    return Checked(place.audit, place.store, verify(place.audit, heads), store.integrity())
