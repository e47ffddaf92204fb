"""A file or folder of the user's with the name of a package is named by the first import that
fails.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from daq.errors import ExitCode

USE = {
    "daq": "import daq; daq.load_cell",
    "ident": "import ident; ident.identify",
    "command": "import sys; from daq.cli import main; sys.exit(main(['--help']))",
}


def _run(checkout: Path, folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a folder, which comes first on the path as it does beside a script."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def _shadow(folder: Path, name: str, content: str) -> Path:
    file = folder / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(content, encoding="utf-8")
    return file.parent if file.name == "__init__.py" else file


@pytest.mark.parametrize(
    "name", ["drivers.py", "drivers/__init__.py", "ident.py", "ident/__init__.py"]
)
def test_it_is_named_with_its_place(checkout: Path, tmp_path: Path, name: str) -> None:
    place = _shadow(tmp_path, name, "X = 1\n")
    failed = _run(checkout, tmp_path, USE["daq"])
    assert failed.returncode == 1
    *_, last = failed.stderr.splitlines()
    package = place.name.removesuffix(".py")
    assert last.startswith(
        f"ImportError: {package!r}: found {place}, which Python imports in the place of drivegain's"
    )
    assert f"expected {checkout / package}; rename {place.name!r}" in last


def test_the_command_line_names_it_in_one_line(checkout: Path, tmp_path: Path) -> None:
    place = _shadow(tmp_path, "drivers.py", "X = 1\n")
    failed = _run(checkout, tmp_path, USE["command"])
    assert failed.returncode == ExitCode.CONFIGURATION
    assert failed.stderr.startswith(f"error: 'drivers': found {place}, which")
    assert len(failed.stderr.splitlines()) == 1


def test_an_empty_folder_shadows_nothing(checkout: Path, tmp_path: Path) -> None:
    for name in ("daq", "drivers", "ident"):
        (tmp_path / name).mkdir()
    for code in USE.values():
        done = _run(checkout, tmp_path, code)
        assert done.returncode == 0, done.stderr


def test_another_import_that_fails_stays_what_it_is(checkout: Path, tmp_path: Path) -> None:
    _shadow(tmp_path, "yaml.py", "raise ImportError('a yaml of my own')\n")
    failed = _run(checkout, tmp_path, USE["daq"])
    last_line = failed.stderr.splitlines()[-1]
    assert last_line == "ImportError: a yaml of my own"
