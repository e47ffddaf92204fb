"""Console blocks of a page, as a reader types them, and the output that the page shows."""

from __future__ import annotations

import re
from dataclasses import dataclass

_BLOCK = re.compile(
    r"^```console(?P<terminal> second "
    r"terminal)?\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
ANYTHING = "…"


@dataclass(frozen=True, slots=True)
class Command:
    """One command of a page.

    Attributes:
        line: of the page, from 1.
        text: what is typed, continuation lines and here-documents included.
        seen: what the page shows after it; "…" matches anything.
        background: it runs on in a second terminal.
    """

    line: int
    text: str
    seen: str
    background: bool


def commands_of(page: str) -> tuple[Command, ...]:
    """Every command of a page, in order: a line that begins with "$ ", with the lines ("> ")
    that continue it.
    """
    found = []
    for block in _BLOCK.finditer(page):
        first = page.count("\n", 0, block.start("body")) + 1
        typed: list[str] = []
        shown: list[str] = []
        begun = first
        for number, line in enumerate(block["body"].splitlines(), start=first):
            if line.startswith("$ "):
                if typed:
                    found.append(
                        Command(begun, "\n".join(typed), "\n".join(shown), bool(block["terminal"]))
                    )
                typed = [line[2:]]
                shown = []
                begun = number
            elif line.startswith("> ") and typed and not shown:
                typed.append(line[2:])
            else:
                shown.append(line)
        if typed:
            found.append(
                Command(begun, "\n".join(typed), "\n".join(shown), bool(block["terminal"]))
            )
    return tuple(found)


def shows(seen: str, output: str) -> str | None:
    """The first line of what a page shows that is not in the output, in its order;
    None where all of it is there.

    Spacing does not count: tables are as wide as their numbers.
    """
    rest = _plain(output)
    for line in filter(None, map(_plain, seen.splitlines())):
        parts = [re.escape(part) for part in line.split(ANYTHING)]
        match = re.search(".*?".join(parts), rest)
        if match is None:
            return line
        rest = rest[match.end() :]
    return None


def _plain(text: str) -> str:
    return " ".join(re.sub(r"\x1b\[[0-9;]*m", "", text).split())
