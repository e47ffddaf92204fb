"""The description of a cell out of a log is one that every verb takes."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest

from daq.config.cell_file import CELL, bundle, load_cell
from daq.config.extracted_cell import extracted_cell
from daq.config.same_cell import differing_sections
from daq.errors import ConfigurationInconsistent, ExitCode
from tests.daq.command_line import run_verb
from tests.daq.logs import demo_content, samples, write


@pytest.fixture
def log(checkout: Path, tmp_path: Path) -> Path:
    path = tmp_path / "bare.mcap"
    return write(path, demo_content(checkout), samples([[0] * 6] * 20))


def test_the_files_are_those_of_the_log_with_the_same_digest(
    log: Path, checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "cell"
    assert run_verb("info", log, "--extract-cell", folder) == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    last_line = lines[-1]
    assert last_line == f"Written: {folder}/cells/demo.yaml"
    found = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    assert found == ["cells/demo.yaml", "drives/generic-cia402.yaml", "robots/tx40.urdf"]
    own = load_cell(checkout / "configs/cells/demo.yaml")
    demo_path = folder / "cells/demo.yaml"
    assert load_cell(demo_path).digest == own.digest
    assert run_verb("info", log, "--extract-cell", folder) == ExitCode.USAGE
    assert "something in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("urdf", "places"),
    [
        ("tx40.urdf", ["demo.yaml", "drives/generic-cia402.yaml", "tx40.urdf"]),
        (
            "../../a/tx40.urdf",
            ["a/tx40.urdf", "cells/cells/demo.yaml", "cells/drives/generic-cia402.yaml"],
        ),
        ("/robots/tx40.urdf", ["demo.yaml", "drives/generic-cia402.yaml", "robot.urdf"]),
    ],
)
def test_each_file_is_where_the_cell_file_looks_for_it(
    checkout: Path, tmp_path: Path, urdf: str, places: list[str]
) -> None:
    files = bundle(checkout / "configs/cells/demo.yaml")
    files[CELL] = files[CELL].replace(b"../robots/tx40.urdf", urdf.encode())
    place, placed = extracted_cell(files)
    assert sorted(map(str, placed)) == places
    for path, content in placed.items():
        parent = (tmp_path / path).parent
        parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(content)
    own = load_cell(checkout / "configs/cells/demo.yaml")
    cell = load_cell(tmp_path / place)
    assert differing_sections(cell, own) == ()


def test_a_file_outside_of_the_folder_is_refused(checkout: Path) -> None:
    files = bundle(checkout / "configs/cells/demo.yaml")
    files[CELL] = files[CELL].replace(b"generic-cia402", b"a/../../../evil")
    files["drives/a/../../../evil.yaml"] = files["drives/generic-cia402.yaml"]
    with pytest.raises(ConfigurationInconsistent, match="files inside one folder"):
        extracted_cell(files)
    files = bundle(checkout / "configs/cells/demo.yaml")
    for path in extracted_cell(files)[1]:
        assert PurePosixPath("..") not in path.parents
