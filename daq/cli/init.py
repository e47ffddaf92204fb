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


def make_cell_folder(folder: Path, *, simulated: bool = False) -> tuple[Path, ...]:
    """Copy the templates into a new or empty folder, all of them or none; return the files."""
    import yaml

    texts = yaml.safe_load(
        (shipped_configurations() / "templates" / "new-cell.yaml").read_text(encoding="utf-8")
    )
    name = folder.resolve().name
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise UsageError(
            str(folder),
            found=f"a folder called {name!r}",
            expected="a name of letters, digits, . _ -",
            remedy="rename it",
        )
    with write_new_folder(folder) as whole:
        written = tuple(
            _copy(source, whole / target.format(name=name), name, texts)
            for source, target in TEMPLATES
        )
        if simulated:
            cell = whole / "cells" / f"{name}.yaml"
            text = cell.read_text(encoding="utf-8")
            bus = re.compile(r"^bus:\n.*?(?=^axes:)", re.MULTILINE | re.DOTALL)
            cell.write_text(bus.sub(texts["simulated_bus"], text), encoding="utf-8")
    return tuple(folder / path.relative_to(whole) for path in written)


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
        say("The cell is that of the demonstration: a six-axis arm on a simulated bus.", err=True)
    else:
        say(
            f"Edit {cell} first: its numbers are an example's, and its comments say what "
            "replaces them.",
            err=True,
        )
    say_next("drivegain", "scan", cell)


def _copy(source: str, path: Path, name: str, texts: dict[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(shipped_configurations() / source, path)
    if path.suffix == ".yaml":
        text = path.read_text(encoding="utf-8")
        text = re.sub(r"^(name|controller): (demo|tx40)$", rf"\1: {name}", text, flags=re.MULTILINE)
        text = re.sub(
            r"\A(#.*\n)+",
            texts["heads"].get(Path(source).parent.name, r"\g<0>").format(name=name),
            text,
        )
        for key in ("bus", "axes", "payloads"):
            text = text.replace(f"\n{key}:\n", f"\n{texts[key]}")
        text = text.replace("../controllers/demo.yaml", f"../controllers/{name}.yaml")
        text = text.replace("../cells/tx40.yaml", f"../cells/{name}.yaml")
        text = text.replace("interface: virtual  ", "interface: socketcan").replace(
            "channel: demo", "channel: can0"
        )
        text = text.replace("pacing: lockstep", "pacing: timed   ").replace(
            "unit: Nm(motor, a priori)", "unit: A"
        )
        text = text.replace("\nsync:\n  period_us: 1000\n", f"\n{texts['sync']}")
        path.write_text(text, encoding="utf-8")
    return path
