"""The reference text in the source tree is that of the code."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


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


def _descriptions(node: Any) -> Iterator[str]:
    if isinstance(node, list):
        for item in node:
            yield from _descriptions(item)
    elif isinstance(node, dict):
        for key, item in node.items():
            if key == "description" and isinstance(item, str):
                yield item
            else:
                yield from _descriptions(item)


def test_a_description_in_a_schema_is_one_paragraph(checkout: Path) -> None:
    """Editors show it as it is: a line end of the source, or a list, would break it."""
    described: list[str] = []
    for path in sorted((checkout / "docs/reference/schemas").glob("*.json")):
        described += _descriptions(json.loads(path.read_text(encoding="utf-8")))
    assert len(described) > 100
    assert [text for text in described if " ".join(text.split()) != text] == []
    assert [text for text in described if " - " in text] == []


INERTIAL = {"Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz"}  #: Their section says it


def test_every_key_of_a_cell_file_is_described(checkout: Path) -> None:
    """By the comment beside the field of its class."""
    text = (checkout / "docs/reference/schemas/cell.json").read_text(encoding="utf-8")
    schema = json.loads(text)
    bare: set[str] = set()
    for section in (schema, *schema["$defs"].values()):
        for key, field in section.get("properties", {}).items():
            if "description" not in field:
                bare.add(key)
    assert bare == INERTIAL
    page = (checkout / "docs/reference/cell-file.md").read_text(encoding="utf-8")
    assert "| `bitrate_bit_s` | Of the bus \\[bit/s\\]. whole number" in page
    assert "None to ignore it" not in page  # a cell file has null
