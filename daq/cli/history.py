"""`drivegain history`: every calibration of a cell, how its gains have changed, and whether they drift."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from daq.cli.terminal import say_written
from daq.cli.verb import JsonOption, Verb, print_json
from daq.cli.writing import applier
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.errors import (
    ConfigurationInconsistent,
    DataError,
    HistoryUnreadable,
    OutputFailed,
    UsageError,
)
from daq.files import replace_file
from daq.jobs.session import sessions
from daq.ledger.audit import AuditAction, AuditVerdict, append, verify
from daq.ledger.entry import Acknowledgement, iso, utc
from daq.ledger.store import HistoryStore
from daq.ledger.verify import AuditedWrite, acknowledgement_flaws, catch_up, event_flaws, unknown_writes, writes_to
from daq.ledger.watch import Series, watch
from daq.report.history import COLUMNS, csv_text, plot_history
from daq.report.history_view import describe, describe_actions, in_force, show, show_axis
from daq.report.text import printable
from daq.workflow.calibration_file import decode, read
from daq.writeback.file_access import resolve_links

# `drivegain history --verify`: whether audit and history are what was written, and what became of killed writes.


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
            DataError: the audit is not what was written, with the first line that is not and all flaws.
            HistoryUnreadable: the history's file is broken, its rows are not what the audit tells, or it does not know
                of a write.
        """
        if not self.verdict.holds:
            first = self.verdict.flaws[0]
            more = "".join(f"\n  line {flaw.line}: {flaw.flaw.value}: {flaw.says}" for flaw in self.verdict.flaws)
            raise DataError(
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
    history, the audit. Raises as `daq.ledger.audit.verify` and the store.
    """
    verdict, broken = _verdict(cell, place, store), store.integrity()
    if not verdict.holds:  # its entries prove nothing
        return Checked(place.audit, place.store, verdict, broken)
    entries = verdict.entries
    by_digest = {one.sha256: one for one in entries}
    events = [(number, event, by_digest.get(event.audit or "")) for number, event in enumerate(store.events(), start=1)]
    broken += tuple(
        printable(f"event {number}: {says}")
        for number, event, entry in events
        if entry is not None
        for says in event_flaws(event, entry, entries)
    )
    broken += tuple(
        printable(f"acknowledgement of {noted.axis} at {iso(noted.at)}: {says}")
        for noted in store.acknowledgements()
        if (entry := by_digest.get(noted.audit)) is not None
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


_PICTURES = {".png": b"\x89PNG", ".svg": b"<?xml"}
"""Suffixes of pictures, and how such a file begins."""


def history_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file; it says where its history is.")],
    axis: Annotated[str | None, typer.Option("--axis", help="One axis: every calibration of its gain.")] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Picture to write, .png or .svg.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="Table to write, for a spreadsheet.")] = None,
    add: Annotated[Path | None, typer.Option("--add", help="Enter a calibration by hand.")] = None,
    acknowledge: Annotated[
        str | None, typer.Option("--acknowledge", metavar="AXIS", help="A change is explained: a new baseline begins.")
    ] = None,
    by: Annotated[
        str | None, typer.Option("--by", help="With --acknowledge: who explains it; you, by default.")
    ] = None,
    why: Annotated[str | None, typer.Option("--why", help="With --acknowledge: what happened.")] = None,
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="DATE", help="With --acknowledge: first day that counts for the new baseline."),
    ] = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Check audit and history, by themselves and together; exit code 4 if broken."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show the calibrations of a cell, which were applied, the change of each gain with its σ, and alarms.

    An alarm means that a gain has changed by more than noise: a drift that adds up (CUSUM), a steady trend, or one
    calibration far off. What it may come from is asked, not claimed. docs/evidence/drift.md says how often an alarm is
    false.
    """
    declared = load_cell(cell)
    place = _place(declared, cell)
    picture = None if plot is None else _picture(plot)
    _check_csv(csv)
    if acknowledge is None and (why is not None or since is not None or by is not None):
        raise UsageError(
            "--by, --why, --since",
            found="no --acknowledge",
            expected="them with --acknowledge AXIS",
            remedy="name the axis whose change is explained",
        )
    now = datetime.now(UTC)
    with HistoryStore(place.store) as store:
        if add is not None:
            _add(store, declared, place, add, now)
        all_series = watch(store.entries(), store.acknowledgements())
        if acknowledge is not None:
            _acknowledge(store, place, _named(all_series, acknowledge, declared), by, why, since, now)
            all_series = watch(store.entries(), store.acknowledgements())
        chosen = all_series if axis is None else (_named(all_series, axis, declared),)
        if picture is not None:
            _plot(picture, chosen, declared)
        if csv is not None:
            _write_csv(csv, chosen)
        entries = store.entries()
        current = in_force(declared, store)
        actions = describe_actions(entries, store.events(), current)
        if verify and declared.controller_path is not None:
            # Where its links lead decides which writes are this cell's: another user's link could hide some.
            resolve_links(declared.controller_path)
        checked = verify_history(declared, place, store) if verify else None
        console = Console(soft_wrap=True, highlight=False, markup=False)
        if json:
            document = describe(declared.name, entries, chosen, all_series, current)
            print_json(document if checked is None else {**document, "audit": checked.document})
        else:
            if checked is not None:
                checked.say(console)
            elif axis is not None:
                show_axis(chosen[0], all_series, actions, console)
            else:
                show(entries, all_series, actions, console)
            say_written(console, picture, csv)
        if checked is not None:
            checked.require()


def _place(cell: Cell, file: Path) -> HistoryPlace:
    if cell.history is None:
        raise ConfigurationInconsistent(
            str(file), found="no history", expected="a cell file", remedy="give the cell file, not a log"
        )
    return cell.history


def _add(store: HistoryStore, cell: Cell, place: HistoryPlace, file: Path, now: datetime) -> None:
    content = read(file)
    calibration = decode(content, str(file))
    if calibration.cell != cell.name:
        raise DataError(
            str(file),
            found=f"a calibration of cell {calibration.cell!r}",
            expected=f"one of {cell.name!r}",
            remedy="give the file of the cell that it belongs to; nothing was entered",
        )
    new = store.add(calibration, digest=hashlib.sha256(content).hexdigest(), at=now)
    outcome_text = "entered" if new else "it was in the history already"
    console = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    console.print(f"{file.name}: {outcome_text}.")
    # Whoever wrote it may have been killed before the history knew.
    for write in catch_up(cell, place, store):
        console.print(f"Entered too: {printable(str(write))}.")
    left = verify_history(cell, place, store)
    if left.unknown or not left.verdict.holds:
        console.print("Not all writes that the audit tells of could be entered: see `drivegain history CELL --verify`.")


def _acknowledge(
    store: HistoryStore,
    place: HistoryPlace,
    series: Series,
    by: str | None,
    why: str | None,
    since: str | None,
    now: datetime,
) -> None:
    if not why or not why.strip():
        raise UsageError(
            "--why",
            found="nothing",
            expected="what happened, for whoever reads this in a year",
            remedy='give it: --why "gearbox changed"',
        )
    # Of a drift, only the newest calibration surely shows the gain as it is now; a log's clock may be ahead of ours.
    begins = min(series.points[-1].entry.recorded, now) if since is None else _day(since, now)
    who = str(applier(by))
    try:
        entry = append(
            place.audit,
            AuditAction.ACKNOWLEDGED,
            at=now,
            who=who,
            subject=f"gain of {series.axis}",
            details={"axis": series.axis, "since": begins.isoformat(), "why": why},
        )
    except OSError as error:
        raise OutputFailed.of(place.audit, error) from error
    store.acknowledge(Acknowledgement(series.axis, begins, now, who, why, entry.sha256))


def _day(text: str, now: datetime) -> datetime:
    never = datetime.min.replace(tzinfo=UTC)
    found = utc(text, never)
    if found == never:
        raise UsageError(
            "--since", found=repr(text), expected="a date, 2026-03-02, or a time with its zone", remedy="spell it so"
        )
    if found > now:
        # Until then every calibration would be left out, and no alarm of the axis told.
        raise UsageError(
            "--since",
            found=f"{text!r}, which is {found:%Y-%m-%d %H:%M:%S} UTC",
            expected=f"no later than now, {now:%Y-%m-%d %H:%M:%S} UTC",
            remedy="give the day of the change, with its zone where the day here is not that of UTC "
            "(2026-03-02T00:00+10:00); of a change that is still to come acknowledge the alarm when it is told",
        )
    return found


def _named(all_series: tuple[Series, ...], axis: str, cell: Cell) -> Series:
    known = {series.axis: series for series in all_series}
    if axis not in cell.axis_names:
        raise UsageError(
            "axis", found=repr(axis), expected=f"one of {', '.join(cell.axis_names)}", remedy="give its name"
        )
    if axis not in known or not known[axis].points:
        raise UsageError(
            "history",
            found=f"no identified gain of {axis}",
            expected="at least one calibration",
            remedy="enter one: drivegain history CELL --add CALIBRATION",
        )
    return known[axis]


def _picture(path: Path) -> Path:
    begins = _PICTURES.get(path.suffix.lower())
    if begins is None:
        raise UsageError("--plot", found=path.name, expected="a name in .png or .svg", remedy="give one")
    _require_replaceable(path, begins)
    return path


def _check_csv(path: Path | None) -> None:
    if path is not None:
        _require_replaceable(path, ",".join(COLUMNS[:3]).encode())


def _require_replaceable(path: Path, begins: bytes) -> None:
    """A file of another kind is not written over."""
    if path.is_dir() or (path.is_file() and path.stat().st_size and not path.read_bytes().startswith(begins)):
        raise UsageError(
            str(path),
            found="something of another kind",
            expected="no file, or an earlier one of the same kind",
            remedy="choose another name, or move it away",
        )


def _plot(path: Path, chosen: tuple[Series, ...], cell: Cell) -> None:
    drawn = [series for series in chosen if series.points]
    if not drawn:
        raise UsageError(
            "--plot", found="an empty history", expected="at least one calibration", remedy="fit and apply one first"
        )
    try:
        plot_history(path, drawn, title=f"Drive gains of {cell.name}")
    except OSError as error:
        raise OutputFailed.of(path, error) from error


def _write_csv(path: Path, chosen: tuple[Series, ...]) -> None:
    try:
        replace_file(path, csv_text(chosen).encode())
    except OSError as error:
        raise OutputFailed.of(path, error) from error


HISTORY = Verb("history", history_verb, "drivegain history cells/demo.yaml --axis J4 --plot history.png")
