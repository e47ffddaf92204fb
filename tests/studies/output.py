"""Output of the studies: lines while they run, and tables as CSV,
which the pages of docs/evidence show.
"""

from __future__ import annotations

import csv
import io
import re
import sys


def print_line(line: str) -> None:
    """Print a line at once, also into a file."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def as_csv(markdown: str) -> str:
    """Rows of the first Markdown table of a text, headings first."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for line in markdown.splitlines():
        if line.startswith("|"):
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1])]
            if not all(re.fullmatch(r":?-+:?", cell) for cell in cells):
                writer.writerow(cells)
        elif text.getvalue():
            break
    return text.getvalue()
