"""Counts what of the pages a test runs: ``python -m tests.pages``."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.pages.blocks import blocks_of, pages

DOCS = Path(__file__).parents[2] / "docs"
FOLLOWED = ("tutorial/guide.md",)
"""Pages whose console blocks `make test-processes` types to the letter."""


def main() -> str:
    """One line for Python, one for commands."""
    python = {"run": 0, "not run, with a reason": 0}
    commands = {"run": 0, "not run, with a reason": 0, "not run yet": 0}
    for page in pages(DOCS):
        followed = page.relative_to(DOCS).as_posix() in FOLLOWED
        for block in blocks_of(page.read_text(encoding="utf-8")):
            if block.language == "python":
                python["run" if block.reason is None else "not run, with a reason"] += 1
            typed = followed and block.language.startswith("console")
            state = "not run, with a reason" if block.reason is not None else "run" if typed else "not run yet"
            commands[state] += len(block.commands)
    return f"{_line('Python blocks', python)}\n{_line('commands', commands)}\n"


def _line(name: str, counts: dict[str, int]) -> str:
    parts = ", ".join(f"{number} {state}" for state, number in counts.items())
    return f"{name} of the pages: {sum(counts.values())}; {parts}"


if __name__ == "__main__":
    sys.stdout.write(main())
