"""Pieces of a page that stands for itself: no script, no address, pictures inside; every text is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from unicodedata import category

GENERATOR = "drivegain"
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Categories of Unicode: control, format, surrogates, private, unassigned, separators of lines and paragraphs."""
_STYLE = """
body { font: 11pt/1.45 sans-serif; color: #111; max-width: 60em; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #999; }
table { border-collapse: collapse; margin: 0.8em 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: bold; padding: 0.2em 0; }
th, td { padding: 0.15em 0.7em; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1em 0; } figcaption { color: #444; font-size: 0.9em; }
img { max-width: 100%; }
.summary { border-left: 4px solid #0072B2; padding-left: 1em; }
@media print { body { margin: 0; max-width: none; font-size: 9.5pt; } figure, table { break-inside: avoid; } }
"""


def page(title: str, body: Iterable[str]) -> str:
    """A whole document.

    Args:
        title: plain text.
        body: pieces made by the functions below.
    """
    # The policy makes sure of it: whatever a file's text may hold, a browser opens no address for this page.
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta name="generator" content="{GENERATOR}">',
            '<meta http-equiv="Content-Security-Policy" '
            "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_spelt(title)}</title>",
            f"<style>{_STYLE}</style>",
            "</head>",
            "<body>",
            f"<h1>{_spelt(title)}</h1>",
            *body,
            "</body>",
            "</html>",
            "",
        )
    )


def section(title: str, *body: str) -> str:
    """A part of the page under a heading."""
    return "\n".join(("<section>", f"<h2>{_spelt(title)}</h2>", *body, "</section>"))


def paragraph(text: str) -> str:
    """Plain text."""
    return f"<p>{_spelt(text)}</p>"


def listed(texts: Iterable[str], kind: str = "") -> str:
    """Plain texts one below the other.

    Args:
        texts: an entry each.
        kind: class of the list in the page's style, a word.
    """
    entries = "".join(f"<li>{_spelt(text)}</li>" for text in texts)
    return f'<ul class="{_spelt(kind)}">{entries}</ul>' if kind else f"<ul>{entries}</ul>"


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Plain texts in rows; the first cell of each row is its heading."""
    head = "".join(f'<th scope="col">{_spelt(heading)}</th>' for heading in headings)
    lines = [
        f'<tr><th scope="row">{_spelt(row[0])}</th>' + "".join(f"<td>{_spelt(cell)}</td>" for cell in row[1:]) + "</tr>"
        for row in rows
    ]
    return "\n".join(
        (
            f"<table><caption>{_spelt(caption)}</caption>",
            f"<thead><tr>{head}</tr></thead>",
            "<tbody>",
            *lines,
            "</tbody></table>",
        )
    )


def picture(png: bytes, caption: str) -> str:
    """A picture inside the page, with what it shows in words."""
    data = base64.b64encode(png).decode("ascii")
    words = _spelt(caption)
    return f'<figure><img alt="{words}" src="data:image/png;base64,{data}"><figcaption>{words}</figcaption></figure>'


def _spelt(text: str) -> str:
    """Text as a browser may show it: markup escaped, and what is not seen spelt out.

    Control characters are no HTML, and those that turn the direction of writing (U+202E and its kind, category Cf) let
    a name look like another one.
    """
    shown = "".join(c if c == "\n" or category(c) not in _UNSEEN else f"\\u{ord(c):04x}" for c in text)
    return escape(shown)
