"""The documentation: its size, and that files and messages name pages that exist."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from daq.config.cell import model_of, robot_of
from daq.config.cell_file import load_cell
from ident.equations.triangles import triangle_of
from ident.model.base import base_parameters
from ident.model.closed_chain import reach
from ident.model.robot import Motion

ROOT = Path(__file__).parents[2]
LARGEST_PICTURE_BYTES = 150_000
PAGES = sorted((ROOT / "docs").rglob("*.md"))


def test_pages_named_in_code_and_messages_exist() -> None:
    completed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    listed = completed.stdout.split("\n")
    places = [name for name in listed if re.search(r"\.(py|md|yaml|toml|svg)$|^Makefile$", name)]
    named = 0
    for place in places:
        if (ROOT / place).exists():
            text = (ROOT / place).read_text(encoding="utf-8")
        else:
            text = ""
        for found in re.findall(r"\bdocs/[\w./-]+", text):
            page = found.rstrip(".")
            # A decision may be named by its number alone.
            exists = (ROOT / page).exists() or any(ROOT.glob(f"{page}-*.md"))
            assert exists, f"{place} names {page}"
            named += 1
    assert named > 20


def test_files_named_in_the_documentation_exist() -> None:
    named = 0
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES):
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`((?:daq|ident|drivers|tests|configs)/[\w./-]+)`", text):
            # NAME is for the reader to fill in.
            assert "NAME" in name or (ROOT / name).exists(), (
                f"{page.relative_to(ROOT)} names {name}"
            )
            named += 1
    assert named > 20


def test_the_first_commands_of_a_page_come_after_the_path_that_they_need() -> None:
    """A reader who types the page from its beginning has no `drivegain` before."""
    for page in ("README.md", "docs/tutorial/guide.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        first = re.search(r"^(\$ )?drivegain \w", text, re.MULTILINE)
        assert first is not None, page
        assert 'export PATH="$PWD/.venv/bin:$PATH"' in text[: first.start()], page


def test_every_page_is_in_the_navigation() -> None:
    reached = set()
    for page in PAGES:
        for toctree in re.findall(r"```\{toctree\}(.*?)```", page.read_text(), re.DOTALL):
            reached |= {line.strip().rpartition("/")[2] for line in toctree.splitlines()}
    for page in PAGES:
        if page.parent.name != "decisions" and page.stem not in ("index", "glossary"):
            assert page.stem in reached, page


ABOUT_ONE_THING = {
    "how-to/troubleshoot.md": ("EMCY", "`INVALID`", "`weak`", "exit code 10", "Lamps"),
    "how-to/replace-a-motor.md": ("amplifier", "motor"),
    "how-to/check-the-wiring.md": ("termina", "## The current scale"),
    "how-to/act-on-a-proposal.md": ("`proposal.json`", "drivegain apply"),
    "how-to/describe-any-robot.md": ("lead_mm", "`drive_train.ratio`"),
    "how-to/describe-a-closed-chain.md": ("closures:",),
    "how-to/load-the-bus.md": ("## Two buses",),
    "how-to/import-recordings.md": ("drivegain import",),
    "how-to/export-a-log.md": ("drivegain export",),
    "how-to/salvage-a-log.md": ("drivegain salvage",),
    "how-to/weigh-a-payload.md": ("drivegain weigh",),
    "how-to/find-contacts.md": ("drivegain contact",),
}
"""What readers looked for, by the page that has it; some were one page."""
NOT_THERE = {
    "how-to/describe-any-robot.md": ("closures:", "## Two buses"),
    "how-to/import-recordings.md": ("drivegain export", "drivegain salvage"),
    "how-to/weigh-a-payload.md": ("drivegain contact",),
}


def test_pages_that_were_missing_are_there_and_are_about_one_thing() -> None:
    for name, words in ABOUT_ONE_THING.items():
        page = (ROOT / "docs" / name).read_text(encoding="utf-8")
        for word in words:
            assert word in page, f"{name} lacks {word}"
    for name, words in NOT_THERE.items():
        page = (ROOT / "docs" / name).read_text(encoding="utf-8")
        for word in words:
            assert word not in page, f"{name} has {word}"


def test_pictures_are_small_and_load_nothing() -> None:
    pictures_folder = ROOT / "docs" / "pictures"
    files = pictures_folder.iterdir()
    pictures = [one for one in files if one.is_file()]
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size < LARGEST_PICTURE_BYTES, picture
        if picture.suffix == ".svg":
            text = picture.read_text(encoding="utf-8")
            addresses = re.findall(r"https?://[^\"')\s]+", text)
            assert set(addresses) <= {"http://www.w3.org/2000/svg"}, picture


@pytest.fixture(scope="module")
def drawings() -> ModuleType:
    drawings_path = ROOT / "docs" / "drawings.py"
    spec = importlib.util.spec_from_file_location("drawings", drawings_path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["five-bar", "orthoglide", "dualv"])
def test_drawn_mechanisms_are_those_of_the_cells(drawings: Any, name: str) -> None:
    shown = drawings.mechanism(name)
    cells_folder = ROOT / "configs" / "cells"
    path = cells_folder / f"{name}.yaml"
    robot = robot_of(load_cell(path))
    assert len(shown.motors) == robot.axis_count
    assert len(shown.passive) == len(robot.passive_joints)
    assert len(shown.closures) == len(robot.closures)
    # Loops close in the drawing, and the platform is drawn on the link that carries the payload.
    assert all(np.allclose(first, second, atol=1e-9) for first, second in shown.closures)
    body = np.array(shown.bodies[shown.carrier])
    smallest_body = body.min(axis=0)
    assert (shown.platform > smallest_body - 1e-9).all() and (
        shown.platform < body.max(axis=0) + 1e-9
    ).all()


def test_the_picture_of_the_mechanisms_is_up_to_date(drawings: Any) -> None:
    drawn = drawings.mechanisms()
    pictures_folder = ROOT / "docs" / "pictures"
    kept = (pictures_folder / "mechanisms.svg").read_text(encoding="utf-8")
    number = r"-?\d+\.\d"
    assert re.sub(number, "#", drawn) == re.sub(number, "#", kept), "run `make screenshots`"
    # The last digit of a coordinate is the processor's.
    found, expected = (
        np.array(re.findall(number, text), dtype=np.float64) for text in (drawn, kept)
    )
    np.testing.assert_allclose(found, expected, atol=0.11)


CHAINS = {
    "five-bar": ("five-bar", "Izz mx my m"),
    "Orthoglide": ("orthoglide", "m"),
    "DualV-like": ("dualv", "Izz mx my m"),
}
"""Row of the table in the method's page: cell, and the parameters of a payload that show."""


@pytest.mark.parametrize("row", CHAINS)
def test_what_is_identifiable_on_a_closed_chain_is_as_documented(row: str) -> None:
    name, shown = CHAINS[row]
    cells_folder = ROOT / "configs" / "cells"
    path = cells_folder / f"{name}.yaml"
    cell = load_cell(path)
    model = model_of(cell)
    draw = np.random.default_rng(1)
    positions = np.array([axis.limits.position for axis in cell.axes])
    robot, (lower, upper) = model.robot, positions.T
    axes_rad = 0.6 * draw.uniform(lower, upper, (400, len(lower)))
    found = reach(robot, model.assembly, axes_rad)
    position = found.position_rad[found.closed][:, list(robot.axis_joints)]
    speed, acceleration = draw.standard_normal((2, *position.shape))
    acceleration_rad_s2 = 8.0 * acceleration
    motion = Motion(position, speed, acceleration_rad_s2)
    columns = np.concatenate(list(model.regressor(motion)), axis=1).T
    triangle = triangle_of(columns.T)
    base = base_parameters(triangle, tuple(column.name for column in model.columns))
    counts = (
        f"{robot.joint_count}, {robot.axis_count}, {model.assembly.mobility} | {columns.shape[1]} "
        f"→ {len(base.names)}"
    )
    explanation_folder = ROOT / "docs" / "explanation"
    text = (explanation_folder / "method.md").read_text(encoding="utf-8")
    assert (f"| {row} | {counts} |") in text
    payload = np.linalg.norm(columns[:, model.flange], axis=0)
    names = (column.name.rstrip("0123456789") for column in model.columns[model.flange])
    seen = [name for name, size in zip(names, payload, strict=True) if size > 1e-9 * payload.max()]
    assert " ".join(seen) == shown
