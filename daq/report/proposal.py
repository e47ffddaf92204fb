"""A proposed change of a controller's file or of the drives:
tables for the operator, and what `--json` prints.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.report.document import Figure, Report
from daq.report.gains import with_deviation
from daq.report.text import plain_table, terminal_lines, terminal_text
from daq.writeback.drive_target import DriveEdit
from daq.writeback.file_target import FileEdit
from daq.writeback.judgement import NO_HISTORY, NOT_JUDGED, HistoryFigures, judge, noise_note
from daq.writeback.request import Edit, GainChange, GainOrigin
from daq.writeback.target import E, Proposal, Written


class Refused(Report):
    """A check that failed."""

    gate: str
    subject: str
    found: str
    expected: str
    remedy: str


class FileGain(Report):
    """A current gain in the controller's file, and the gain that is planned there."""

    axis: str
    key: str
    line: int
    old: Figure
    """current gain; the key keeps its name"""
    new: Figure
    """as it is read back; null where there is none to write"""
    change_percent: Figure
    change_sigmas: Figure
    """signed as change_percent"""
    significant: bool
    std_percent: Figure
    nameplate: float
    nameplate_percent: Figure
    unit: str


class FileChange(Report):
    """`apply` to the controller's file."""

    file: str
    base_sha256: str
    base: str
    """BEFORE-AFTER of this change, for --base"""
    applied: bool
    backup: str | None
    changes: list[FileGain]
    refusals: list[Refused]
    diff: str


class RestoredObject(Report):
    """An object in a drive before and after."""

    axis: str
    object: str
    old: Figure
    """current gain, as a number of the drive; null where the drive has none"""
    new: Figure


class DriveGain(RestoredObject):
    """A current gain in a drive, and the gain that is planned there."""

    std: float
    nameplate: float
    unit: str


class DriveChange(Report):
    """`apply --drives`; `record`, `source` and `saved` are there once the drives are written."""

    cell: str | None
    base_sha256: str
    base: str
    applied: bool
    record: str = ""
    source: str | None = None
    saved: bool = False
    changes: list[DriveGain]
    refusals: list[Refused]


class FileRollback(Report):
    """`rollback` of the controller's file."""

    file: str
    restored: str
    """backup that was restored"""
    backup: str | None
    """of the content before"""
    diff: str
    audit: str | None


class DriveRollback(Report):
    """`rollback --drives`; the last two are there once the drives are written."""

    drives: str
    source: str
    restored: bool
    changes: list[RestoredObject]
    record: str = ""
    saved: bool = False


def show_proposal(
    proposal: Proposal[E], console: Console, known: HistoryFigures = NO_HISTORY
) -> None:
    """Print the change as a table and as a diff, judged by the history."""
    edit = proposal.edit
    console.print(change_table(edit.changes, known))
    note = noise_note(edit.changes, known)
    console.print(terminal_text(f"* {note}"), style="dim")
    judged, sentence = judge(edit.changes, known)
    if judged and edit.has_effect and not any(change.significant for change in judged.values()):
        console.print(
            terminal_text(f"{sentence[0].upper()}{sentence[1:]}. Nothing needs to be written.")
        )
    console.print()
    if isinstance(edit, DriveEdit):
        console.print(terminal_lines(edit.diff.removesuffix("\n")))
    if isinstance(edit, FileEdit) and edit.diff:
        _show_diff(terminal_lines(edit.diff), console)


def change_table(changes: tuple[GainChange, ...], known: HistoryFigures = NO_HISTORY) -> Table:
    """Make the table of current and new gains, with the figures to judge a change by."""
    current = GainOrigin.CURRENT.value
    headings = (
        "axis",
        current,
        "identified ± σ",
        "σ %",
        "Δ %",
        "Δ in σ",
        "nameplate",
        "from it %",
        "unit",
    )
    table = plain_table(headings, left=(0, len(headings) - 1))
    judged, _ = judge(changes, known)
    for change in changes:
        found = judged.get(change.axis, NOT_JUDGED)
        mark = " "
        if found.significant:
            mark = "*"
        table.add_row(
            terminal_text(change.axis),
            f"{change.current_gain:.5g}",
            with_deviation(change.new, change.std),
            f"{change.std_percent:.2f}",
            f"{change.change_percent:+.1f}",
            f"{abs(found.sigmas):.1f} {mark}",
            f"{change.nameplate_gain:.5g}",
            f"{change.nameplate_percent:+.1f}",
            terminal_text(change.unit),
        )
    return table


def proposal_report(
    proposal: Proposal[E], written: Written | None, known: HistoryFigures
) -> FileChange | DriveChange:
    """Return a proposal and its outcome; `written` is None where nothing was written."""
    edit = proposal.edit
    if isinstance(edit, DriveEdit):
        return _drive_change(proposal, written)
    judgements, _ = judge(edit.changes, known)
    changes = []
    for change in edit.changes:
        judged = judgements.get(change.axis, NOT_JUDGED)
        changes.append(
            FileGain.of(
                change,
                judged,
                old=change.current_gain,
                change_sigmas=judged.sigmas,
                nameplate=change.nameplate_gain,
            )
        )
    backup = None
    if written is not None:
        backup = str(written.backup)
    diff = ""
    if isinstance(edit, FileEdit):
        diff = edit.diff
    return FileChange.of(
        edit,
        proposal,
        file=edit.place,
        applied=written is not None,
        backup=backup,
        changes=changes,
        diff=diff,
    )


def _drive_change(proposal: Proposal[E], written: Written | None) -> DriveChange:
    edit = proposal.edit
    cell = proposal.target.cell
    # A calibration restores no record.
    outcome = {}
    if written is not None:
        outcome = {**_outcome(written), "source": None}
    name = None
    if cell is not None:
        name = cell.name
    return DriveChange.of(
        cell=name,
        base_sha256=edit.base_sha256,
        base=edit.base,
        applied=written is not None,
        changes=[_drive_gain(change) for change in edit.changes],
        refusals=proposal.refusals,
        **outcome,
    )


def _drive_gain(change: GainChange) -> DriveGain:
    return DriveGain.of(
        change, object=change.key, old=change.current_gain, nameplate=change.nameplate_gain
    )


def _outcome(written: Written) -> dict[str, Any]:
    """Keys that are there once the drives are written."""
    return {
        "record": str(written.backup),
        "saved": all(change.saved for change in written.parameters),
    }


def show_drive_rollback(edit: DriveEdit, console: Console) -> None:
    """Print a planned rollback of the drives."""
    for value, write in zip(edit.values, edit.writes, strict=True):
        new = value.parameter.value(write.word)
        console.print(f"{value.axis.name}, {value.parameter}: {value.value:.9g} -> {new:.9g}")
    if edit.record is not None:
        console.print(
            f"These are the gains before the write of {edit.record.at} by "
            f"{terminal_text(edit.record.who).plain}."
        )


def drive_rollback_report(edit: DriveEdit, written: Written | None) -> DriveRollback:
    """Return a rollback of the drives; `written` is None where nothing was written."""
    outcome = {}
    if written is not None:
        outcome = _outcome(written)
    changes = []
    for value, write in zip(edit.values, edit.writes, strict=True):
        restored = RestoredObject(
            axis=value.axis.name,
            object=str(value.parameter),
            old=value.value,
            new=value.parameter.value(write.word),
        )
        changes.append(restored)
    return DriveRollback(
        drives=edit.subject,
        source=str(edit.source),
        restored=written is not None,
        changes=changes,
        **outcome,
    )


def show_file_rollback(written: Written, console: Console) -> None:
    """Print a rollback of the controller's file as a diff and a line."""
    edit = written.edit
    backup = written.backup
    _show_diff(terminal_lines(_rollback_diff(edit)), console)
    replaced = "the file was gone"
    if backup is not None:
        replaced = f"the replaced content is in {backup.name}"
    source = ""
    if edit.source is not None:
        source = edit.source.name
    console.print(terminal_text(f"Restored {source} to {edit.subject}; {replaced}."))
    console.print("Let the controller load the file.")


def file_rollback_report(written: Written, audit: Path | None) -> FileRollback:
    """Return a rollback of the controller's file; `audit` is the log that has it."""
    return FileRollback.of(
        written,
        file=written.edit.subject,
        restored=str(written.edit.source),
        diff=_rollback_diff(written.edit),
        audit=audit,
    )


def _rollback_diff(edit: Edit) -> str:
    name = terminal_text(Path(edit.subject).name).plain
    before = (edit.before or b"").decode(errors="replace").splitlines()
    after = edit.after.decode(errors="replace").splitlines()
    diff = difflib.unified_diff(
        before, after, f"{name} (was)", f"{name} (restored)", lineterm="", n=1
    )
    return "\n".join(diff)


def _show_diff(diff: str, console: Console) -> None:
    """Print whole lines, also in a pipe, so that a number is never broken and a line can be
    copied.
    """
    for line in diff.splitlines():
        console.print(Text(line, style=_DIFF_STYLES.get(line[:1], "")), soft_wrap=True)


_DIFF_STYLES = {"+": "green", "-": "red", "@": "cyan"}
