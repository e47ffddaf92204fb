"""`drivegain rollback`: the controller's file as it was before the last write."""

from __future__ import annotations

import difflib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.syntax import Syntax

from daq.cli.applier import ByOption, applier, audit_of, own_file, tell_history
from daq.cli.drives import DrivesOption, RamOnlyOption, SaveUnknownOption, saving_of
from daq.cli.rollback_drives import rollback_drives
from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.cell import Cell
from daq.configuration.cell_file import load_cell
from daq.digest import sha256
from daq.errors import ConfigurationInconsistent, OutputFailed, UsageError
from daq.write_back.controller_write import Restored, roll_back


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
    now, doer, book = datetime.now(UTC), applier(by), audit if declared is None else audit_of(declared, (cell, to))
    if audit is not None:
        own_file(audit, (to,))
    if drives:
        if declared is None or to is not None:
            raise UsageError(
                "--drives",
                found="no --cell" if declared is None else "--to beside it",
                expected="--cell CELL alone, which says where the gains are in the drives",
                remedy="name the cell, and no file",
            )
        saving = saving_of(ram_only, save_unknown)
        rollback_drives(declared, now=now, doer=doer, saving=saving, audit=book, yes=yes, json=json)
        return
    file = _file(declared, cell, to)
    try:
        done = roll_back(
            file,
            now,
            audit=book,
            who=str(doer),
            format=None if declared is None or declared.controller is None else declared.controller.format,
        )
    except OSError as error:
        raise OutputFailed.of(file, error) from error
    if declared is not None:
        tell_history(
            declared,
            lambda store: store.rolled_back(
                at=now,
                who=str(doer),
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
    stood = "the file was gone" if done.backup is None else f"what stood there is now {done.backup.name}"
    console.print(f"Restored {done.source.name} to {done.file}; {stood}.", markup=False)
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
