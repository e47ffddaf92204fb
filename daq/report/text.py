"""Text from a file as a terminal may show it: it neither commands the terminal nor is read as rich's markup."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.text import Text


def terminal_text(text: str) -> Text:
    """The same text, control characters spelt out."""
    return Text("".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text))


def terminal_lines(text: str) -> str:
    """Lines for `rich.syntax`, which knows no markup: control characters spelt out, but for tabs; line ends as \\n."""
    lines = text.splitlines()
    return "\n".join("".join(c if c.isprintable() or c == "\t" else f"\\x{ord(c):02x}" for c in line) for line in lines)


# Cells of a CSV as a spreadsheet may open them: text from elsewhere stays text.


_FORMULA = tuple("=+-@\t\n＝＋－＠")
"""What a cell begins with that is taken for a formula, which may start programs (OWASP, CSV Injection)."""


def inert(value: Any) -> Any:
    """One cell: text that would be a formula gets an apostrophe before it, by which spreadsheets know text.

    Numbers stay as they are. What of a file's name is no character (bytes that are not UTF-8) is spelt out.
    """
    if not isinstance(value, str):
        return value
    text = value.encode(errors="backslashreplace").decode()
    # csv puts no quotation marks about a carriage return alone, and what comes behind it would be a cell of its own.
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return f"'{text}" if text.startswith(_FORMULA) else text


def inert_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A line, by the columns' headings."""
    return {heading: inert(value) for heading, value in row.items()}
