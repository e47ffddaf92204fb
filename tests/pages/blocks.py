"""Reads the code blocks of a page, and what the page's source says about them to the tests.

A comment before a block, which readers do not see, is its mark: ``<!-- not run: REASON -->``, or
``<!-- run by: FILE -->`` where a test of another room runs it. A comment that begins with
``<!-- before:`` has Python that stands for what the reader brings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

BEFORE = re.compile(r"^<!-- before:\n(.*?)^-->$", re.MULTILINE | re.DOTALL)
FENCE = re.compile(
    r"(?:^<!-- (?P<mark>not run|run by): (?P<reason>[^\n]+) -->\n+)?^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
COMMAND = re.compile(r"^(?:\$ )?((?:drivegain|pip|python|python3|make|sudo|ip|cat|echo|mkdir|\.venv/\S+) .*)$")


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block."""

    line: int  #: of the fence
    language: str  #: what follows the fence
    text: str
    reason: str | None  #: why no test runs it
    elsewhere: str | None  #: the test of another room that runs it

    @property
    def runs_here(self) -> bool:
        """Whether it is Python without a mark."""
        return self.language == "python" and self.reason is None and self.elsewhere is None

    @property
    def commands(self) -> tuple[str, ...]:
        """Lines of a shell that the reader types."""
        if self.language.split(" ")[0] not in ("", "console", "sh"):
            return ()
        found = [COMMAND.match(line) for line in self.text.splitlines()]
        return tuple(one[1] for one in found if one is not None)


def blocks_of(page: str) -> tuple[Block, ...]:
    """All fenced blocks of a page, in order."""
    blocks = []
    for found in FENCE.finditer(page):
        line = page.count("\n", 0, found.start("language")) + 1
        reason = found["reason"] if found["mark"] == "not run" else None
        elsewhere = found["reason"] if found["mark"] == "run by" else None
        blocks.append(Block(line, found["language"], found["text"], reason, elsewhere))
    return tuple(blocks)


def python_before(page: str) -> str:
    """What the reader of a page brings, as Python."""
    return "\n".join(BEFORE.findall(page))


def pages(docs: Path) -> tuple[Path, ...]:
    """Every page of the site."""
    return tuple(sorted(docs.rglob("*.md")))
