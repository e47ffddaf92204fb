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
from daq.write_back.controller_write import Restored, roll_back


def rollback(
    to: Annotated[Path, typer.Option("--to", help="Controller file to restore from its newest backup.")],
    json: JsonOption = False,
) -> None:
    """Take the last write to a controller file back; what that replaces is backed up too, so a second one undoes it.

    A file that somebody has edited since, and a backup that somebody has changed, are refused.
    """
    try:
        done = roll_back(to, datetime.now(UTC))
    except OSError as error:
        raise OutputFailed.of(to, error) from error
    diff = _diff(done)
    if json:
        print_json(
            {
                "file": str(done.file),
                "restored": str(done.source),
                "backup": None if done.backup is None else str(done.backup),
                "diff": diff,
            }
        )
        return
    console = Console(soft_wrap=True, highlight=False)
    console.print(Syntax(diff, "diff", background_color="default", word_wrap=True))
    stood = "the file was gone" if done.backup is None else f"what stood there is now {done.backup.name}"
    console.print(f"Restored {done.source.name} to {done.file}; {stood}.", markup=False)


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


ROLLBACK = Verb("rollback", rollback, "drivegain rollback --to controllers/demo.yaml")
