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
    text = (ROOT / "pyproject.toml").read_text()
    project = tomllib.loads(text)
    dependencies = project["project"]["dependencies"]
    dev = project["dependency-groups"]["dev"]
    requires = project["build-system"]["requires"]
    asked = [
        *dependencies,
        *dev,
        *requires,
    ]
    matches = re.findall(r"^([a-zA-Z0-9_.-]+)==", LOCK, re.MULTILINE)
    locked = {_normal(name) for name in matches}
    assert {_normal(re.split(r"[<>=~! ;\[]", one)[0]) for one in asked} <= locked


def test_the_decisions_are_numbered_once() -> None:
    decisions_folder = ROOT / "docs" / "decisions"
    pages = sorted(decisions_folder.glob("*"))
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
    printed = capsys.readouterr().out
    assert f"Example: drivegain {name}" in " ".join(printed.split())


def test_every_file_that_the_documents_point_to_is_there() -> None:
    files = (ROOT / "docs").rglob("*.md")
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *files):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_make_target_that_the_documents_name_exists() -> None:
    text = (ROOT / "Makefile").read_text()
    matches = re.findall(r"^([a-z]+):", text, re.MULTILINE)
    made = set(matches)
    for page in ("README.md", "CONTRIBUTING.md"):
        for target in re.findall(r"\bmake ([a-z]+)\b(?=`|\n|  )", (ROOT / page).read_text()):
            assert target in made, f"{page}: make {target}"


def test_every_command_of_the_readme_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "README.md").read_text()
    commands = re.findall(
        r"^drivegain "
        r"([a-z]+)(.*)$",
        text,
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
