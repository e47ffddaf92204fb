"""The description of a cell out of a log, as files that `load_cell` reads.

A log has the files of its cell under fixed names (`daq.config.cell_file.bundle`), and the cell file
names others: `../robots/tx40.urdf`. Laid out as the cell file names them, its text stays as it is,
and so does its digest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath

from daq.config.cell_file import CELL, DRIVES, URDF
from daq.config.cell_schema import CellModel
from daq.config.yaml_file import parse_yaml, read_model
from daq.errors import ConfigurationInconsistent

CELLS = "cells"  #: Folder of the cell file, where it names files next to its own folder
FILE_NAME = re.compile(r"\w[\w.-]*")


def extracted_cell(files: Mapping[str, bytes]) -> tuple[PurePosixPath, dict[PurePosixPath, bytes]]:
    """Lay out the files of a cell so that each is where the cell file looks for it.

    Args:
        files: of a log, or as returned by `bundle`; other entries are ignored.

    Returns:
        the place of the cell file, and the content of each file by its place; all relative to one
        folder.

    Raises:
        ConfigurationInconsistent: a file would be outside of that folder.
        ConfigurationError: the cell file is not what its schema says.
    """
    content = files[CELL]
    model = read_model(parse_yaml(content, CELL), CellModel)
    urdf = PurePosixPath(model.robot.urdf)
    if urdf.is_absolute():  # of another computer
        content = content.replace(str(model.robot.urdf).encode(), URDF.encode(), 1)
        urdf = PurePosixPath(URDF)
    folder = PurePosixPath()
    for _ in range(urdf.parts.count("..")):
        folder /= CELLS
    name = model.name if FILE_NAME.fullmatch(model.name) else "cell"
    place = folder / f"{name}.yaml"
    placed = {place: content, _inside(folder / urdf): files[URDF]}
    # A profile is looked for in `drives` next to the cell file, and next to its folder.
    drives = folder.parent / "drives"
    for drive in model.drives:
        profile = files[f"{DRIVES}{drive}.yaml"]
        placed[_inside(drives / f"{drive}.yaml")] = profile
        sheet = files.get(f"{DRIVES}{drive}.eds")
        if sheet is not None:
            tree = parse_yaml(profile, drive).tree
            placed[_inside(drives / str(tree["eds"]))] = sheet
    return place, placed


def _inside(path: PurePosixPath) -> PurePosixPath:
    """Return a path without `..`.

    Raises:
        ConfigurationInconsistent: it leads out of the folder.
    """
    parts: list[str] = []
    for part in path.parts:
        if part != "..":
            parts.append(part)
        elif parts:
            parts.pop()
        else:
            parts = ["/"]
            break
    if parts[:1] == ["/"]:
        raise ConfigurationInconsistent(
            "the cell file of the log",
            found=f"a file {str(path)!r}",
            expected="files inside one folder",
            remedy="`drivegain export bag` has the URDF, too; write the cell file by hand",
        )
    return PurePosixPath(*parts)
