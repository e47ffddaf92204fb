"""`drivegain init`: a folder for a new cell."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import Verb
from daq.environment import shipped_configurations
from daq.errors import OutputFailed, UsageError

TEMPLATES = (
    ("cells/demo.yaml", "cells/{name}.yaml"),
    ("controllers/demo.yaml", "controllers/{name}.yaml"),
    ("drives/generic-cia402.yaml", "drives/generic-cia402.yaml"),
    ("robots/tx40.urdf", "robots/tx40.urdf"),
    ("imports/tx40.yaml", "imports/{name}.yaml"),
)
"""Shipped files, and their names in the new folder."""

HEADS = {
    "cells": """\
# The cell {name}. Its numbers are those of the arm that `drivegain demo` moves: replace every one of them.
""",
    "controllers": """\
# Joint drive gains of {name}: replace this file with your controller's own. drivegain changes the numbers that
# `controller.gains` in the cell file names, and keeps comments, order and spacing.
""",
    "imports": """\
# Converts CSV files of another controller to a log; not needed where drivegain records.
#   drivegain import imports/{name}.yaml --data FOLDER --out run.mcap
""",
}
"""First comment of a new file, by the folder of its template; it replaces the template's own."""

BUS = """\
bus:
  # A cell on two buses has a list here, and each axis says `bus: left` or `bus: right`:
  #   - {name: left, interface: socketcan, channel: can0}
  #   - {name: right, interface: socketcan, channel: can1}
"""
"""Comment on the bus of a new cell."""

AXES = """\
axes:
  # One entry for each motor, from the base to the tool, in the order of the joints in the URDF.
  #   name                     name of the axis in messages, tables and logs
  #   node_id                  CANopen node id of its amplifier, 1 to 127
  #   drive                    drive profile: the name of a file in ../drives/
  #   identity                 object 1018h as `drivegain scan` shows it, so that a wrong amplifier is never moved;
  #                            leave the line out to accept any
  #   counts_per_revolution    of the motor's encoder, as object 6064h counts
  #   zero_offset_deg          joint angle of the URDF where the motor's counts are zero
  #   nameplate_gain_nm_per_a  the manufacturer's gain: Nm at the joint per A of the current reference; negative where
  #                            the current counts against the joint
  #   limits                   range that a plan may use, well inside the mechanical stops
  # A prismatic axis has lead_mm (travel per turn), zero_offset_mm, nameplate_gain_n_per_a, and limits position_mm,
  # velocity_mm_s and acceleration_mm_s2; its standstill speed is standstill_mm_s.
"""
"""Comment on the axes of a new cell."""

PAYLOADS = """\
payloads:
  # mass_kg must be weighed. Values from a drawing may be added, for `drivegain fit --known cad`:
  #   centre_m: [x, y, z]                       centre of mass in the frame of the last joint
  #   inertia_kg_m2: [xx, xy, xz, yy, yz, zz]   about the centre of mass, signs as in a URDF (xy = -integral of xy dm)
  # Single parameters about the frame's origin go under known: {mz: 0.4}. Every mounting has its own name.
"""
"""Comment on the payloads of a new cell."""

SIMULATED_BUS = """\
bus:
  interface: socketcand                    # the hub of `drivegain simulate demo`
  channel: can0
  host: 127.0.0.1
  port: 29536
  bitrate_bit_s: 1000000
sync:
  period_us: 1000
  pacing: lockstep                         # the simulated cell answers as fast as this computer can
"""
"""Bus and sampling of a cell whose amplifiers `drivegain simulate demo` simulates."""


def make_folder(folder: Path, *, simulated: bool = False) -> tuple[Path, ...]:
    """Copy the templates into a new folder, all of them or none; return the files.

    Args:
        folder: new, or empty.
        simulated: write the bus of `drivegain simulate demo` into the cell file.

    Raises:
        UsageError: the folder's name cannot be a cell's, or the folder is not empty.
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
            raise UsageError(
                str(folder), found="something in it", expected="a new or empty folder", remedy="choose another name"
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{name}.") as temporary:
            whole = Path(temporary) / name
            written = tuple(_copy(source, whole, target.format(name=name), name) for source, target in TEMPLATES)
            if simulated:
                _use_simulated_bus(whole / "cells" / f"{name}.yaml")
            whole.chmod(0o755)
            whole.rename(folder)
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    return tuple(folder / path.relative_to(whole) for path in written)


def init(
    folder: Annotated[Path, typer.Argument(help="Folder to create; its name becomes the cell's.")],
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Use the bus of `drivegain simulate demo`, to try the verbs.")
    ] = False,
) -> None:
    """Create a folder for a new cell, with commented templates to fill in."""
    for path in make_folder(folder, simulated=simulated):
        typer.echo(path)


def _copy(source: str, folder: Path, target: str, name: str) -> Path:
    path = folder / target
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(shipped_configurations() / source, path)
    if path.suffix == ".yaml":
        text = path.read_text(encoding="utf-8")
        text = re.sub(r"^(name|controller): (demo|tx40)$", rf"\1: {name}", text, flags=re.MULTILINE)
        text = re.sub(r"\A(#.*\n)+", HEADS.get(Path(source).parent.name, r"\g<0>").format(name=name), text)
        text = text.replace("\nbus:\n", f"\n{BUS}").replace("axes:\n", AXES).replace("payloads:\n", PAYLOADS)
        text = text.replace("../controllers/demo.yaml", f"../controllers/{name}.yaml")
        text = text.replace("../cells/tx40.yaml", f"../cells/{name}.yaml")
        text = text.replace("interface: virtual  ", "interface: socketcan").replace("channel: demo", "channel: can0")
        text = text.replace("pacing: lockstep", "pacing: timed   ").replace("unit: Nm(motor, a priori)", "unit: A")
        path.write_text(text, encoding="utf-8")
    return path


def _use_simulated_bus(cell: Path) -> None:
    text = cell.read_text(encoding="utf-8")
    cell.write_text(
        re.sub(r"^bus:\n.*?(?=^axes:)", SIMULATED_BUS, text, flags=re.MULTILINE | re.DOTALL), encoding="utf-8"
    )


INIT = Verb("init", init, "drivegain init cells/press-4")
