"""The reference text in the source tree is that of the code."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path


def lagging_files(folder: Path) -> list[str]:
    """Files that are not up to date, in an interpreter that has seen no class of a test."""
    command = [sys.executable, "-m", "docs.reference_pages", "--check"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.returncode == bool(done.stdout)
    return done.stdout.splitlines()


def test_pages_and_schemas_are_as_the_code_has_them(checkout: Path) -> None:
    """If not: `make reference`."""
    assert lagging_files(checkout) == []


def test_a_page_and_a_schema_that_lag_behind_are_named(checkout: Path, tmp_path: Path) -> None:
    for name in ("daq", "drivers", "ident", "configs", "lazy_names.py", "pyproject.toml"):
        (tmp_path / name).symlink_to(checkout / name)
    shutil.copytree(
        checkout / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("__pycache__")
    )
    reference = tmp_path / "docs" / "reference"
    gates = reference / "gates.md"
    gates.write_text(
        gates.read_text(encoding="utf-8").replace("| signature |", "| autograph |"),
        encoding="utf-8",
    )
    (reference / "schemas" / "error.json").unlink()
    (reference / "schemas" / "gone.json").write_text("{}\n")
    names = [Path(line).name for line in lagging_files(tmp_path)]
    assert names == ["gates.md", "error.json", "gone.json"]
