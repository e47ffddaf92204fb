"""`drivegain rollback`: undo the last write to the controller's file or to its drives."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from daq.cli.verb import JsonOption, Verb, print_json
from daq.cli.writing import (
    Applier,
    ByOption,
    DrivesOption,
    RamOnlyOption,
    SaveUnknownOption,
    applier,
    audit_of,
    drives_on_the_bus,
    record_in_history,
    require_separate_audit,
    saving_of,
    saving_text,
)
from daq.errors import ConfigurationInconsistent, OutputFailed, UsageError

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.writeback.target import Written
    from drivers.canopen.parameters import Saving


def rollback(
    cell: Annotated[Path | None, typer.Option(help="Cell file; it names the controller file and the audit.")] = None,
    to: Annotated[
        Path | None, typer.Option("--to", help="Controller file to restore, instead of the one that the cell names.")
    ] = None,
    by: ByOption = None,
    drives: DrivesOption = False,
    ram_only: RamOnlyOption = False,
    save_unknown: SaveUnknownOption = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --drives: write; without it the rollback is only shown.")
    ] = False,
    audit: Annotated[Path | None, typer.Option("--audit", help="Audit file, where no --cell names it.")] = None,
    json: JsonOption = False,
) -> None:
    """Undo the last write to a controller file; the replaced content is backed up too, so a second rollback undoes it.

    A file that was edited since, and a backup that was changed, are refused. With --to alone the audit is not known:
    give it with --audit, or the rollback is not in an audit. Drives are shown first and written with --yes: their
    values are in no file that could be reviewed.
    """
    from daq.config.cell_file import load_cell
    from daq.report.proposal import describe_file_rollback, show_file_rollback
    from daq.writeback import target
    from daq.writeback.file_target import FileTarget

    declared = None if cell is None else load_cell(cell)
    if declared is not None and audit is not None:
        raise UsageError(
            "--audit",
            found="--cell beside it",
            expected="one of the two: writes to a cell's controller are in the cell's audit",
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
    format_ = None if declared is None or declared.controller is None else declared.controller.format
    file = FileTarget(_file(declared, cell, to), format=format_, cell=declared)
    try:
        written = target.rollback(file, now, audit=book, who=str(actor))
    except OSError as error:
        raise OutputFailed.of(file.file, error) from error
    if declared is not None:
        _enter(declared, written, now, actor)
    if json:
        print_json({**describe_file_rollback(written), "audit": None if book is None else str(book)})
        return
    console = Console(soft_wrap=True, highlight=False)
    show_file_rollback(written, console)
    if book is None:
        console.print("Not in an audit: neither --cell nor --audit was given.", markup=False)


def rollback_drives(
    declared: Cell, *, now: datetime, actor: Applier, saving: Saving, audit: Path | None, yes: bool, json: bool
) -> None:
    """Show the values in the drives before the last write, and restore them with `yes`; a second time undoes it.

    Args:
        declared: the cell.
        now, actor, audit: as for a controller's file.
        saving: whether the drives save.
        yes: write.
        json: print a document instead of text.
    """
    from daq.report.proposal import describe_drive_rollback, show_drive_rollback
    from daq.writeback import target
    from daq.writeback.drive_target import record_folder

    written: Written | None = None
    console = Console(soft_wrap=True, highlight=False, markup=False)
    with drives_on_the_bus(declared, saving) as drives:
        planned = drives.plan_rollback()
        if not json:
            show_drive_rollback(planned, console)
        if yes:
            try:
                written = target.rollback(drives, now, audit=audit, who=str(actor), planned=planned)
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if written is not None:
        _enter(declared, written, now, actor)
    if json:
        print_json(describe_drive_rollback(planned, written))
    elif written is None:
        console.print("Dry run, nothing was written. To restore them, repeat the command with --yes.")
    else:
        backup = "" if written.backup is None else written.backup.name
        console.print(f"Restored the values of {planned.source}; those before are now in {backup}.", end=" ")
        console.print(saving_text(saving))


def _enter(cell: Cell, written: Written, now: datetime, actor: Applier) -> None:
    from daq.files import sha256

    edit = written.edit
    record_in_history(
        cell,
        actor,
        lambda ledger: ledger.record_rolled_back(
            at=now, target=edit.subject, sha256_after=sha256(edit.after), entry=written.audit_sha256
        ),
    )


def _file(cell: Cell | None, cell_file: Path | None, to: Path | None) -> Path:
    if to is not None:
        return to
    if cell is None:
        raise UsageError(
            "rollback",
            found="neither a cell nor a controller file",
            expected="--cell CELL",
            remedy="name the cell whose controller is to be rolled back",
        )
    if cell.controller_path is None:
        raise ConfigurationInconsistent(
            f"{cell_file}: controller", found="no file", expected="one", remedy="give it with --to FILE"
        )
    return cell.controller_path


ROLLBACK = Verb("rollback", rollback, "drivegain rollback --cell cells/demo.yaml")
