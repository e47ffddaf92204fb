"""Text from a file as a terminal may show it: it neither commands the terminal nor is read as rich's markup."""

from __future__ import annotations

from rich.text import Text


def terminal_text(text: str) -> Text:
    """The same text, control characters spelt out."""
    return Text("".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text))


def terminal_lines(text: str) -> str:
    """Lines for `rich.syntax`, which knows no markup: control characters spelt out, but for tabs; line ends as \\n."""
    lines = text.splitlines()
    return "\n".join("".join(c if c.isprintable() or c == "\t" else f"\\x{ord(c):02x}" for c in line) for line in lines)
