"""`drivegain init`: a folder for a new cell."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.cli.next_step import say_next
from daq.cli.terminal import say, write_new_folder
from daq.cli.verb import judged_output
from daq.environment import shipped_configurations
from daq.errors import UsageError

TEMPLATES = (
    ("cells/demo.yaml", "cells/{name}.yaml"),
    ("controllers/demo.yaml", "controllers/{name}.yaml"),
    ("drives/generic-cia402.yaml", "drives/generic-cia402.yaml"),
    ("robots/tx40.urdf", "robots/tx40.urdf"),
    ("imports/tx40.yaml", "imports/{name}.yaml"),
)
"""Shipped files, and their names in the new folder."""
REPLACEMENTS = (
    ("../controllers/demo.yaml", "../controllers/{name}.yaml"),
    ("../cells/tx40.yaml", "../cells/{name}.yaml"),
    # The next three keep their length, so that the comments after them stay aligned.
    ("interface: virtual  ", "interface: socketcan"),
    ("channel: demo", "channel: can0"),
    ("pacing: lockstep", "pacing: timed   "),
    ("unit: Nm(motor, a priori)", "unit: A"),
)
"""Texts of a shipped file, and those of the new cell."""
CELL_NAME = re.compile(r"\w[\w.-]*")
_BUS_SECTION = re.compile(
    r"^bus:\n.*?(?=^axes:)",
    re.MULTILINE | re.DOTALL,
)
_SHIPPED_NAME = re.compile(
    r"^(name|controller): (demo|tx40)$",
    re.MULTILINE,
)
_FIRST_COMMENT = re.compile(r"\A(#.*\n)+")


def make_cell_folder(folder: Path, *, simulated: bool = False) -> tuple[Path, ...]:
    """Copy the templates into a new or empty folder, all of them or none; return the files.

    Args:
        folder: its name becomes the name of the cell.
        simulated: whether the cell is on the bus of `drivegain simulate demo`.

    Raises:
        UsageError: the folder has no name of a cell, or there is something in it.
        OutputFailed: the file system refuses.
    """
    import yaml

    texts_file = shipped_configurations() / "templates" / "new-cell.yaml"
    texts = yaml.safe_load(texts_file.read_text(encoding="utf-8"))
    name = folder.resolve().name
    if not CELL_NAME.fullmatch(name):
        raise UsageError(
            str(folder),
            found=f"a folder called {name!r}",
            expected="a name of letters, digits, . _ -",
            remedy="rename it",
        )
    # The files get their place at the end of the block, when all of them are complete.
    with write_new_folder(folder) as temporary:
        written = []
        for source, target in TEMPLATES:
            relative_path = target.format(name=name)
            _write_from_template(source, temporary / relative_path, name, texts)
            written.append(folder / relative_path)
        if simulated:
            cell = temporary / "cells" / f"{name}.yaml"
            text = cell.read_text(encoding="utf-8")
            text = _BUS_SECTION.sub(texts["simulated_bus"], text)
            cell.write_text(text, encoding="utf-8")
    return tuple(written)


def init(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder to create; its name becomes the cell's.", callback=judged_output
        ),
    ],
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Use the bus of `drivegain simulate demo`.")
    ] = False,
) -> None:
    """Create a folder for a new cell, with commented templates to fill in."""
    for path in make_cell_folder(folder, simulated=simulated):
        typer.echo(path)
    cell = folder / "cells" / f"{folder.resolve().name}.yaml"
    if simulated:
        say(
            "The cell is that of the demonstration, on the bus of `drivegain simulate demo`.",
            err=True,
        )
        say_next("drivegain", "calibrate", cell, "--enable-motion")
        return
    say(
        f"Edit {cell} first: its numbers are an example's, and its comments say what "
        "replaces them.",
        err=True,
    )
    say_next("drivegain", "scan", cell)


def _write_from_template(
    source: str,
    path: Path,
    name: str,
    texts: dict[str, Any],
) -> None:
    """Copy a shipped file; of YAML, replace names, bus and comments of the demonstration.

    Args:
        source: the file, below the shipped configurations.
        path: the copy.
        name: of the new cell.
        texts: comments and sections of a new cell, from `new-cell.yaml`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(shipped_configurations() / source, path)
    if path.suffix != ".yaml":
        return
    text = path.read_text(encoding="utf-8")
    text = _SHIPPED_NAME.sub(rf"\1: {name}", text)
    folder = Path(source).parent.name
    first_comment = texts["heads"].get(folder)
    if first_comment is not None:
        first_comment = first_comment.format(name=name)
        text = _FIRST_COMMENT.sub(first_comment, text)
    for key in ("bus", "axes", "payloads"):
        text = text.replace(f"\n{key}:\n", f"\n{texts[key]}")
    for old, new in REPLACEMENTS:
        text = text.replace(old, new.format(name=name))
    text = text.replace("\nsync:\n  period_us: 1000\n", f"\n{texts['sync']}")
    path.write_text(text, encoding="utf-8")
