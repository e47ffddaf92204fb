"""`drivegain init`: a folder for a new cell."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import Verb
from daq.errors import OutputExists, OutputFailed, UsageError
from daq.resources import shipped_configurations

TEMPLATES = (
    ("cells/demo.yaml", "cells/{name}.yaml"),
    ("controllers/demo.yaml", "controllers/{name}.yaml"),
    ("drives/generic-cia402.yaml", "drives/generic-cia402.yaml"),
    ("robots/tx40.urdf", "robots/tx40.urdf"),
    ("imports/tx40.yaml", "imports/{name}.yaml"),
)
"""Shipped files, and what they are called in the new folder."""


def make_folder(folder: Path) -> tuple[Path, ...]:
    """Copy the templates into a new folder; all of them or none.

    Raises:
        UsageError: the folder's name is no name of a cell.
        OutputExists: the folder holds something.
        OutputFailed: the file system refuses.
    """
    name = folder.resolve().name
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise UsageError(
            str(folder),
            found=f"a folder called {name!r}",
            expected="a name of letters, digits, . _ -",
            remedy="rename it",
        )
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputExists(
                str(folder), found="something in it", expected="a new or empty folder", remedy="choose another name"
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{name}.") as temporary:
            whole = Path(temporary) / name
            written = tuple(_copy(source, whole, target.format(name=name), name) for source, target in TEMPLATES)
            whole.chmod(0o755)
            whole.rename(folder)
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    return tuple(folder / path.relative_to(whole) for path in written)


def init(
    folder: Annotated[Path, typer.Argument(help="Folder to make; its name becomes the cell's.")],
) -> None:
    """Make a folder for a new cell, with commented templates to fill in."""
    for path in make_folder(folder):
        typer.echo(path)


def _copy(source: str, folder: Path, target: str, name: str) -> Path:
    path = folder / target
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(shipped_configurations() / source, path)
    if path.suffix == ".yaml":
        text = path.read_text(encoding="utf-8")
        text = re.sub(r"^(name|controller): (demo|tx40)$", rf"\1: {name}", text, flags=re.MULTILINE)
        text = text.replace("../controllers/demo.yaml", f"../controllers/{name}.yaml")
        text = text.replace("../cells/tx40.yaml", f"../cells/{name}.yaml")
        text = text.replace("interface: virtual ", "interface: socketcan ").replace("channel: demo", "channel: can0")
        text = text.replace("pacing: lockstep ", "pacing: timed ").replace("unit: Nm(motor, a priori)", "unit: A")
        path.write_text(text, encoding="utf-8")
    return path


INIT = Verb("init", init, "drivegain init cells/press-4")
