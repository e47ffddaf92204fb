"""Promises of the repository about itself."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from daq.cli.app import VERBS, main

ROOT = Path(__file__).parents[2]
LOCK = (ROOT / "requirements.lock").read_text()


def test_the_lock_has_hashes_and_no_address() -> None:
    assert not re.search(r"[a-z]+://|@ |--(?:extra-)?index-url|--find-links", LOCK)
    pinned = re.findall(
        r"^([a-zA-Z0-9_.-]+)==\S+(?: ;[^\\\n]*)? \\\n    "
        r"--hash=sha256:[0-9a-f]{64}",
        LOCK,
        re.MULTILINE,
    )
    named = re.findall(r"^[a-zA-Z0-9].*$", LOCK, re.MULTILINE)
    assert len(pinned) == len(named) > 20


def test_every_dependency_is_in_the_lock() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = [
        *project["project"]["dependencies"],
        *project["dependency-groups"]["dev"],
        *project["build-system"]["requires"],
    ]
    locked = {_normal(name) for name in re.findall(r"^([a-zA-Z0-9_.-]+)==", LOCK, re.MULTILINE)}
    assert {_normal(re.split(r"[<>=~! ;\[]", one)[0]) for one in asked} <= locked


def test_the_decisions_are_numbered_once() -> None:
    pages = sorted((ROOT / "docs" / "decisions").glob("*"))
    numbers = [page.name[:4] for page in pages]
    assert len(set(numbers)) == len(numbers) > 0
    for page in pages:
        assert re.fullmatch(r"[0-9]{4}-[a-z0-9-]+\.md", page.name)
        assert page.read_text().startswith(f"# {page.name[:4]} ")


@pytest.mark.parametrize("name", [verb.name for verb in VERBS])
def test_every_verb_shows_an_example_of_itself(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "--help"]) == 0
    assert f"Example: drivegain {name}" in " ".join(capsys.readouterr().out.split())


def test_every_file_that_the_documents_point_to_is_there() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_make_target_that_the_documents_name_exists() -> None:
    made = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in ("README.md", "CONTRIBUTING.md"):
        for target in re.findall(r"\bmake ([a-z]+)\b(?=`|\n|  )", (ROOT / page).read_text()):
            assert target in made, f"{page}: make {target}"


def test_every_command_of_the_readme_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    commands = re.findall(
        r"^drivegain "
        r"([a-z]+)(.*)$",
        (ROOT / "README.md").read_text(),
        re.MULTILINE,
    )
    assert len(commands) >= 5
    for verb, rest in commands:
        assert verb in {one.name for one in VERBS}, (
            f"README names the verb {verb}, which is not there"
        )
        assert main([verb, "--help"]) == 0
        shown = capsys.readouterr().out
        for option in re.findall(r"--[a-z-]+", rest):
            assert option in shown, f"drivegain {verb} has no {option}"


def test_the_licence_is_the_whole_text() -> None:
    licence = (ROOT / "LICENSE").read_text()
    for part in (
        "Version 2.0, January 2004",
        "9. Accepting Warranty or Additional Liability",
        "END OF TERMS AND CONDITIONS",
    ):
        assert part in licence


def _normal(name: str) -> str:
    """Name of a distribution as indexes compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()
