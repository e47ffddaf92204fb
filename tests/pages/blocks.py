"""Reads the code blocks of a page, and what the page's source says about them to the tests.

A comment before a block, which readers do not see, is its mark: ``<!-- not run: REASON -->``, or
``<!-- run by: FILE -->`` where a test of another room runs it, or ``<!-- saved as: FILE -->`` where
the reader saves it and a command of the page runs it. A comment that begins with ``<!-- before:``
has Python that stands for what the reader brings; ``<!-- needs: PACKAGE -->`` names what may be
missing.

Blocks of the language ``console`` are typed, line by line; those of ``python`` are executed. A
command in a block of any other language needs a mark.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

BEFORE = re.compile(r"^<!-- before:\n(.*?)^-->$", re.MULTILINE | re.DOTALL)
MARK = r"(?:^<!-- (?P<mark>not run|run by|saved as): (?P<reason>[^\n]+) -->\n+)?"
FENCE = re.compile(
    MARK + r"^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
NEEDS = re.compile(r"^<!-- needs: (\S+) -->$", re.MULTILINE)
PROMPT = "$ "
PROGRAMS = (
    "drivegain",
    "pip",
    "python",
    "python3",
    "make",
    "sudo",
    "ip",
    "cat",
    "echo",
    "mkdir",
    "dask",
    "git",
)
COMMAND = re.compile(rf"^(?:[A-Z_]+=\S+ )*(?:{'|'.join(PROGRAMS)}|\S*bin/\S+) .*$")
INLINE = re.compile(r"(?<![`\\])`(drivegain [a-z][^`\n]*)`(?!`)")


class State(Enum):
    """What the tests do with a block."""

    RUN = "run"
    MARKED = "not run, with a reason"
    OPEN = "neither"


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block."""

    line: int  #: of the fence
    language: str  #: what follows the fence
    text: str
    reason: str | None  #: why no test runs it
    elsewhere: str | None  #: the test of another room that runs it
    saved_as: str | None  #: the file that a command of the page runs

    @property
    def runs_here(self) -> bool:
        """Whether it is Python without a mark."""
        marks = (self.reason, self.elsewhere, self.saved_as)
        return self.language == "python" and marks == (None, None, None)

    @property
    def is_console(self) -> bool:
        """Whether a reader types it at a prompt."""
        return self.language.split(" ")[0] == "console"

    @property
    def state(self) -> State:
        """What the tests do with it."""
        if self.reason is not None:
            return State.MARKED
        if self.elsewhere is not None or self.is_console or self.language == "python":
            return State.RUN
        return State.OPEN

    @property
    def commands(self) -> tuple[str, ...]:
        """Lines of a shell that the reader types."""
        lines = self.text.splitlines()
        if self.is_console:
            return tuple(line.removeprefix(PROMPT) for line in lines if line.startswith(PROMPT))
        if self.language in ("", "sh"):
            return tuple(line for line in lines if COMMAND.match(line))
        return ()


def blocks_of(page: str) -> tuple[Block, ...]:
    """All fenced blocks of a page, in order."""
    blocks = []
    for found in FENCE.finditer(page):
        line = page.count("\n", 0, found.start("language")) + 1
        marks = {found["mark"]: found["reason"]}
        block = Block(
            line,
            found["language"],
            found["text"],
            marks.get("not run"),
            marks.get("run by"),
            marks.get("saved as"),
        )
        blocks.append(block)
    return tuple(blocks)


def without_marked(page: str) -> str:
    """The page with empty lines for its blocks that have a mark."""

    def emptied(found: re.Match[str]) -> str:
        block: str = found[0]
        if found["mark"] is None:
            return block
        return "\n" * block.count("\n")

    return FENCE.sub(emptied, page)


def inline_commands(page: str) -> tuple[str, ...]:
    """Commands of drivegain inside a sentence or a table."""
    return tuple(INLINE.findall(FENCE.sub("", page)))


def python_before(page: str) -> str:
    """What the reader of a page brings, as Python."""
    return "\n".join(BEFORE.findall(page))


def needed_packages(page: str) -> tuple[str, ...]:
    """Packages without which the blocks of a page cannot run."""
    return tuple(NEEDS.findall(page))


def pages(docs: Path) -> tuple[Path, ...]:
    """Every page of the site."""
    return tuple(sorted(docs.rglob("*.md")))
