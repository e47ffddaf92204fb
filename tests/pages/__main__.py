"""Counts what of the pages a test runs: ``python -m tests.pages``."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from tests.pages.blocks import State, blocks_of, pages

DOCS = Path(__file__).parents[2] / "docs"


def main() -> str:
    """One line for Python, one for commands."""
    python: Counter[State] = Counter()
    commands: Counter[State] = Counter()
    for page in pages(DOCS):
        for block in blocks_of(page.read_text(encoding="utf-8")):
            if block.language == "python":
                python[block.state] += 1
            commands[block.state] += len(block.commands)
    return f"{_line('Python blocks', python)}\n{_line('commands', commands)}\n"


def _line(name: str, counts: Counter[State]) -> str:
    parts = ", ".join(f"{counts[state]} {state.value}" for state in State)
    return f"{name} of the pages: {counts.total()}; {parts}"


if __name__ == "__main__":
    sys.stdout.write(main())
