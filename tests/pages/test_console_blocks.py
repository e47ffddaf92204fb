"""Every command of every page is typed:
first the tutorial, to the letter, then the pages that continue it.

Each of these pages begins in a copy of the folder that the tutorial leaves.
"""

from __future__ import annotations

import os
import shlex
import shutil
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.pages.__main__ import main as counted
from tests.pages.blocks import (
    State,
    blocks_of,
    inline_commands,
    needed_packages,
    pages,
    without_marked,
)
from tests.pages.options import verb_options
from tests.pages.terminal import Reader
from tests.pipeline.transcript import Command, commands_of

DOCS = Path(__file__).parents[2] / "docs"
TUTORIAL = DOCS / "tutorial" / "guide.md"
PORT = 29536
"""Of the hub, as the page and `init --simulated` say."""
SHARED = "../shared/data"
"""Recordings of others, which are beside a checkout or not there."""


def typed(page: Path) -> list[Command]:
    """The commands of a page that have no mark."""
    return list(commands_of(without_marked(page.read_text(encoding="utf-8"))))


TYPED = [page for page in pages(DOCS) if typed(page) and page != TUTORIAL]


@dataclass(frozen=True, slots=True)
class Followed:
    """A tutorial that was followed."""

    folder: Path
    reader: Reader


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A wide screen, with `drivegain` on the PATH."""
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("COLUMNS", "200")
    return monkeypatch


@pytest.fixture(scope="module")
def tutorial_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tutorial is followed; empty until its test has passed."""
    return tmp_path_factory.mktemp("tutorial")


@pytest.fixture
def free_port() -> Iterator[None]:
    """Skip where another simulated cell has the port of the pages."""
    with socket.socket() as probe:
        taken = probe.connect_ex(("127.0.0.1", PORT)) == 0
    if taken:
        pytest.skip(f"port {PORT} of this machine is in use: a simulated cell in another terminal?")
    yield


@pytest.mark.usefixtures("free_port")
def test_the_tutorial_is_followed_to_the_letter(
    tutorial_folder: Path, terminal: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    commands = typed(TUTORIAL)
    assert len(commands) > 25
    terminal.chdir(tutorial_folder)
    reader = Reader("docs/tutorial/guide.md", capfd)
    reader.follow(commands)
    assert reader.proposed == {None, "calibrate", "record", "fit", "residual", "apply"}
    (tutorial_folder / "followed").touch()


@pytest.mark.parametrize("page", TYPED, ids=lambda page: str(page.relative_to(DOCS)))
@pytest.mark.usefixtures("free_port")
def test_the_commands_of_a_page_continue_the_tutorial(
    page: Path,
    tutorial_folder: Path,
    checkout: Path,
    tmp_path: Path,
    terminal: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    if not (tutorial_folder / "followed").exists():
        pytest.skip("the tutorial was not followed to its end")
    commands = typed(page)
    source = page.read_text(encoding="utf-8")
    for package in needed_packages(source):
        pytest.importorskip(package)
    shared = Path(os.environ.get("DRIVEGAIN_DATA", checkout / SHARED))
    if any(SHARED in command.text for command in commands):
        if not shared.is_dir():
            pytest.skip(f"no recordings of others: {shared} is not there")
        (tmp_path / "shared").mkdir()
        (tmp_path / SHARED.removeprefix("../")).symlink_to(shared)
    folder = tmp_path / "work"
    shutil.copytree(tutorial_folder, folder)
    # Of a checkout the pages name the shipped configurations.
    (folder / "configs").symlink_to(checkout / "configs")
    for block in blocks_of(source):
        if block.saved_as is not None:
            (folder / block.saved_as).write_text(block.text, encoding="utf-8")
    terminal.chdir(folder)
    Reader(str(page.relative_to(checkout)), capfd).follow(commands)


def test_a_saved_block_is_run_by_a_command_of_its_page() -> None:
    for page in pages(DOCS):
        source = page.read_text(encoding="utf-8")
        words: set[str] = set()
        for command in typed(page):
            words.update(shlex.split(command.text))
        for block in blocks_of(source):
            assert block.saved_as is None or block.saved_as in words, page


def test_every_command_is_typed_or_has_a_reason() -> None:
    neither = []
    for page in pages(DOCS):
        blocks = blocks_of(page.read_text(encoding="utf-8"))
        open_blocks = [block for block in blocks if block.commands and block.state is State.OPEN]
        neither += [
            f"{page.relative_to(DOCS)}, line {block.line}: {block.commands[0]}"
            for block in open_blocks
        ]
    assert neither == []
    assert counted().count(f" 0 {State.OPEN.value}") == 2


@pytest.fixture(scope="module")
def options() -> dict[str, frozenset[str]]:
    """Verbs with their options, as the command line has them."""
    return verb_options()


@pytest.mark.parametrize("page", pages(DOCS), ids=lambda page: str(page.relative_to(DOCS)))
def test_a_command_inside_a_sentence_names_a_verb_and_its_options(
    page: Path, options: dict[str, frozenset[str]]
) -> None:
    for command in inline_commands(page.read_text(encoding="utf-8")):
        words = [word.strip("[],") for word in shlex.split(command)[1:]]
        verb = words[0]
        kind = " ".join(words[:2])
        known = options[kind] if kind in options else options[verb]
        named = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert named <= known, f"{command}: {named - known}"
