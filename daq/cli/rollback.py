"""`drivegain rollback`: the controller's file as it was before the last write."""

from __future__ import annotations

import difflib
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.syntax import Syntax

from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.cli.writing import (
    Applier,
    ByOption,
    DrivesOption,
    RamOnlyOption,
    SaveUnknownOption,
    applier,
    audit_of,
    on_the_bus,
    outcome,
    record_in_history,
    require_separate_audit,
    saving_of,
    saving_text,
)
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, OutputFailed, UsageError
from daq.files import sha256
from daq.ledger.store import HistoryStore
from daq.writeback.drive_proposal import drives_of
from daq.writeback.drive_record import record_folder
from daq.writeback.drive_target import DriveRollback, DrivesWritten, plan_drive_rollback, roll_back_drives
from daq.writeback.file_target import Restored, roll_back
from drivers.canopen.parameters import Saving

# The drives as before the last write: what `drivegain rollback --drives` does.


def rollback_drives(
    declared: Cell, *, now: datetime, actor: Applier, saving: Saving, audit: Path | None, yes: bool, json: bool
) -> None:
    """Show what stood in the drives before the last write, and put it back with `yes`; a second time undoes it.

    Args:
        declared: the cell.
        now, doer, audit: as for a controller's file.
        saving: whether the drives keep it.
        yes: write.
        json: tell it to a program.
    """
    done: DrivesWritten | None = None
    with on_the_bus(declared) as network:
        planned = plan_drive_rollback(declared, network)
        if not json:
            _show_rollback(planned)
        if yes:
            try:
                done = roll_back_drives(planned, network, now, saving=saving, audit=audit, who=str(actor))
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if done is not None:
        record_in_history(declared, partial(_record_rollback, done, now, actor))
    if json:
        print_json(_rollback_document(planned, done))
        return
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if done is None:
        console.print("Dry run, nothing was written. To put it back, repeat the command with --yes.")
        return
    console.print(
        f"Restored the values of {done.source}; those before are now in {done.record.name}. {saving_text(saving)}"
    )


def _show_rollback(rollback: DriveRollback) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for value, write in zip(rollback.base, rollback.writes, strict=True):
        new = value.parameter.value(write.word)
        console.print(f"{value.axis.name}, {value.parameter}: {value.value:.9g} -> {new:.9g}")
    console.print(f"These stood there before the write of {rollback.record.at} by {printable(rollback.record.who)}.")


def _rollback_document(rollback: DriveRollback, done: DrivesWritten | None) -> dict[str, Any]:
    return {
        "drives": drives_of(rollback.cell),
        "source": str(rollback.record.path),
        "restored": done is not None,
        "changes": [
            {
                "axis": value.axis.name,
                "object": str(value.parameter),
                "old": value.value,
                "new": value.parameter.value(write.word),
            }
            for value, write in zip(rollback.base, rollback.writes, strict=True)
        ],
        **({} if done is None else outcome(done)),
    }


def _record_rollback(done: DrivesWritten, now: datetime, actor: Applier, store: HistoryStore) -> None:
    store.rolled_back(
        at=now, who=str(actor), target=done.target, sha256_after=done.sha256_after, audit=done.audit_sha256
    )


def rollback(
    cell: Annotated[
        Path | None, typer.Option(help="Cell file; it says which controller file, and which audit.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option("--to", help="Controller file to restore, instead of the one that the cell names.")
    ] = None,
    by: ByOption = None,
    drives: DrivesOption = False,
    ram_only: RamOnlyOption = False,
    save_unknown: SaveUnknownOption = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --drives: write; without it the way back is only shown.")
    ] = False,
    audit: Annotated[
        Path | None, typer.Option("--audit", help="Where it is written down, where no --cell says it.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Take the last write to a controller file back; what that replaces is backed up too, so a second one undoes it.

    A file that somebody has edited since, and a backup that somebody has changed, are refused. With --to alone nothing
    says where the audit is: give it with --audit, or nothing is written down. Drives are shown first and written on
    --yes: what stands in them is in no file that one could look at.
    """
    declared = None if cell is None else load_cell(cell)
    if declared is not None and audit is not None:
        raise UsageError(
            "--audit",
            found="--cell beside it",
            expected="one of the two: what is done to a cell's controller is in the cell's audit",
            remedy="leave --audit out; `history: {audit: ...}` of the cell file says where its audit is",
        )
    now, actor, book = datetime.now(UTC), applier(by), audit if declared is None else audit_of(declared, (cell, to))
    if audit is not None:
        require_separate_audit(audit, (to,))
    if drives:
        if declared is None or to is not None:
            raise UsageError(
                "--drives",
                found="no --cell" if declared is None else "--to beside it",
                expected="--cell CELL alone, which says where the gains are in the drives",
                remedy="name the cell, and no file",
            )
        saving = saving_of(ram_only, save_unknown)
        rollback_drives(declared, now=now, actor=actor, saving=saving, audit=book, yes=yes, json=json)
        return
    file = _file(declared, cell, to)
    try:
        done = roll_back(
            file,
            now,
            audit=book,
            who=str(actor),
            format=None if declared is None or declared.controller is None else declared.controller.format,
        )
    except OSError as error:
        raise OutputFailed.of(file, error) from error
    if declared is not None:
        record_in_history(
            declared,
            lambda store: store.rolled_back(
                at=now,
                who=str(actor),
                target=str(done.file),
                sha256_after=sha256(done.after),
                audit=done.audit_sha256,
            ),
        )
    diff = _diff(done)
    if json:
        print_json(
            {
                "file": str(done.file),
                "restored": str(done.source),
                "backup": None if done.backup is None else str(done.backup),
                "audit": None if book is None else str(book),
                "diff": diff,
            }
        )
        return
    console = Console(soft_wrap=True, highlight=False)
    console.print(Syntax(diff, "diff", background_color="default", word_wrap=True))
    replaced_text = "the file was gone" if done.backup is None else f"what stood there is now {done.backup.name}"
    console.print(f"Restored {done.source.name} to {done.file}; {replaced_text}.", markup=False)
    if book is None:
        console.print("Not written down: no --cell and no --audit was given.", markup=False)


def _file(cell: Cell | None, cell_file: Path | None, to: Path | None) -> Path:
    if to is not None:
        return to
    if cell is None:
        raise UsageError(
            "rollback",
            found="neither a cell nor a controller file",
            expected="--cell CELL",
            remedy="name the cell whose controller is to be as it was",
        )
    if cell.controller_path is None:
        raise ConfigurationInconsistent(
            f"{cell_file}: controller", found="no file", expected="one", remedy="give it with --to FILE"
        )
    return cell.controller_path


def _diff(done: Restored) -> str:
    lines = difflib.unified_diff(
        done.before.decode(errors="replace").splitlines(),
        done.after.decode(errors="replace").splitlines(),
        f"{done.file.name} (was)",
        f"{done.file.name} (restored)",
        lineterm="",
        n=1,
    )
    return "\n".join(lines)


ROLLBACK = Verb("rollback", rollback, "drivegain rollback --cell cells/demo.yaml")
