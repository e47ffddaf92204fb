"""`drivegain rollback`: the controller's file as it was before the last write."""

from __future__ import annotations

import difflib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.syntax import Syntax

from daq.cli.verb import JsonOption, Verb, print_json
from daq.errors import OutputFailed
from daq.write_back.controller_write import Written, roll_back


def rollback(
    to: Annotated[Path, typer.Option(help="Controller file to restore from its newest backup.")],
    json: JsonOption = False,
) -> None:
    """Restore the newest backup of a controller file; what it replaces is backed up too, so a second one undoes it."""
    try:
        written = roll_back(to, datetime.now(UTC))
    except OSError as error:
        raise OutputFailed.of(to, error) from error
    diff = _diff(written)
    if json:
        print_json(
            {
                "file": str(written.file),
                "restored": str(written.restored),
                "backup": str(written.backup),
                "diff": diff,
            }
        )
        return
    console = Console(soft_wrap=True, highlight=False)
    console.print(Syntax(diff, "diff", background_color="default", word_wrap=True))
    name = written.restored.name if written.restored else ""
    console.print(f"Restored {name} to {written.file}; what stood there is now {written.backup.name}.")


def _diff(written: Written) -> str:
    lines = difflib.unified_diff(
        written.before.decode(errors="replace").splitlines(),
        written.after.decode(errors="replace").splitlines(),
        f"{written.file.name} (was)",
        f"{written.file.name} (restored)",
        lineterm="",
        n=1,
    )
    return "\n".join(lines)


ROLLBACK = Verb("rollback", rollback, "drivegain rollback --to controllers/demo.yaml")
