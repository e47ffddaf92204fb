"""Pieces of a page that needs no other file: no script, no address, pictures inside, every text escaped.

The page reads on a phone (16 px, wide tables scroll in a box of their own), on paper (the first sheet is one A4 page)
and in dark mode. Colour-blind readers can distinguish the colours, those of `daq.report.picture`, and no meaning rests
on colour alone.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from unicodedata import category

MARK = '<meta name="generator" content="drivegain">'
"""Text at the beginning of every page, by which an earlier one is recognised."""
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Unicode categories: control, format, surrogates, private, unassigned, separators of lines and paragraphs."""
_STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1a1a1a; --soft: #595959; --line: #d4d4d4; --shade: #f2f2f2;
  --data: #0072B2; --act: #B34700; }
@media (prefers-color-scheme: dark) { :root { --paper: #16181a; --ink: #ececec; --soft: #b0b0b0; --line: #44484c;
  --shade: #232629; --data: #56B4E9; --act: #F0A060; } }
* { box-sizing: border-box; }
body { font: 16px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 56rem;
  margin: 1.5rem auto; padding: 0 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 0.6rem; }
h2 { font-size: 1.15rem; margin: 1.4rem 0 0.4rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 0.8rem 0 0.2rem; }
p, ul { margin: 0.4rem 0; }
.kind { color: var(--soft); margin: 0; }
.verdict { border-left: 0.4rem solid var(--data); background: var(--shade); padding: 0.6rem 0.8rem; font-size: 1.1rem;
  margin: 0.8rem 0; }
.act { border-color: var(--act); } .quiet { border-color: var(--soft); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.1rem 1rem; margin: 0.6rem 0; }
dt { color: var(--soft); } dd { margin: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.5rem 0; font-variant-numeric: tabular-nums; overflow-wrap: normal; }
caption { text-align: left; font-weight: bold; padding: 0.2rem 0; }
th, td { padding: 0.2rem 0.6rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: baseline; }
th { font-weight: 600; } td { white-space: nowrap; } thead th { color: var(--soft); font-weight: normal; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.words td:last-child, .words th:last-child { text-align: left; white-space: normal; min-width: 13.5rem; }
.pair { display: flex; flex-wrap: wrap; gap: 0 1.5rem; } .pair figure { flex: 1 1 21rem; max-width: 30rem; }
figure { margin: 0.6rem 0; } figure svg { max-width: 30rem; } figcaption { color: var(--soft); font-size: 0.9rem; }
svg { width: 100%; height: auto; display: block; } img { max-width: 100%; background: #fff; }
svg text { fill: var(--ink); font: 12px system-ui, sans-serif; font-variant-numeric: tabular-nums; }
svg .soft { fill: var(--soft); } svg .end { text-anchor: end; } svg .mid { text-anchor: middle; }
svg .grid { stroke: var(--line); } svg .zero { stroke: var(--ink); } svg .limit { stroke: var(--act); stroke-width: 2; }
svg .range { fill: var(--shade); } svg .band { fill: var(--data); opacity: 0.25; }
svg .bar { stroke: var(--data); stroke-width: 3; } svg .line { stroke: var(--data); stroke-width: 2; fill: none; }
svg .dot { fill: var(--data); } svg .hollow { fill: var(--paper); stroke: var(--soft); stroke-width: 2; }
details { border-bottom: 1px solid var(--line); } details > :not(summary) { margin-left: 0.2rem; }
summary { cursor: pointer; padding: 0.5rem 0; font-weight: 600; }
pre { overflow-x: auto; background: var(--shade); padding: 0.5rem; font-size: 0.9rem; }
@page { size: A4; margin: 13mm; }
@media print {
  :root { --paper: #fff; --ink: #000; --soft: #444; --line: #bbb; --shade: #f2f2f2; --data: #0072B2; --act: #B34700; }
  html { font-size: 8.5pt; } body { margin: 0; padding: 0; max-width: none; font-size: 9pt; }
  h1 { font-size: 15pt; } h2 { font-size: 11pt; margin: 3mm 0 1mm; } .verdict { font-size: 11pt; margin: 2mm 0; }
  .pair { flex-wrap: nowrap; } .pair figure { flex: 1 1 0; min-width: 0; } .scroll { overflow: visible; }
  th, td { padding: 0.4mm 1.5mm; } td { white-space: normal; }
  .sheet { break-after: page; } figure, table, dl, .verdict { break-inside: avoid; } h2, h3 { break-after: avoid; }
}
"""


def page(title: str, body: Iterable[str]) -> str:
    """Build the document; the pieces of the body come from the functions below, which escape every text."""
    # The security policy keeps a browser from opening an address, whatever text a file holds.
    pieces = "\n".join(body)
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{MARK}
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{spelled(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
{pieces}
</body>
</html>
"""


def element(tag: str, text: str, kind: str = "") -> str:
    """Build an element of plain text; its kind is a CSS class."""
    named = f' class="{kind}"' if kind else ""
    return f"<{tag}{named}>{spelled(text)}</{tag}>"


def paragraph(text: str, kind: str = "") -> str:
    """Build a paragraph of plain text; its kind is a CSS class."""
    return element("p", text, kind)


def section(title: str, *body: str) -> str:
    """Build a section under a heading."""
    return "\n".join(("<section>", element("h2", title), *body, "</section>"))


def folded(title: str, *body: str) -> str:
    """Build a section that a reader opens; paper shows it if it was open."""
    return "\n".join(("<details>", element("summary", title), *body, "</details>"))


def listed(texts: Iterable[str]) -> str:
    """Build a list of plain texts."""
    return f"<ul>{''.join(element('li', text) for text in texts)}</ul>"


def terms(pairs: Iterable[tuple[str, str]]) -> str:
    """Build a list of names with their values."""
    return f"<dl>{''.join(element('dt', name) + element('dd', value) for name, value in pairs)}</dl>"


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Build a table of plain texts; the first cell of each row is its heading, and its kind is a CSS class."""
    head = "".join(f'<th scope="col">{spelled(heading)}</th>' for heading in headings)
    lines = [f'<table class="{kind}">' if kind else "<table>", element("caption", caption) if caption else ""]
    lines += [f"<thead><tr>{head}</tr></thead>", "<tbody>"]
    for first, *others in rows:
        lines.append(f'<tr><th scope="row">{spelled(first)}</th>{"".join(element("td", one) for one in others)}</tr>')
    return "\n".join(('<div class="scroll">', *lines, "</tbody></table>", "</div>"))


def figure(svg: str, caption: str) -> str:
    """Show a drawing of `daq.report.svg` with its caption."""
    return f"<figure>{svg}{element('figcaption', caption)}</figure>"


def picture(png: bytes, caption: str) -> str:
    """Embed a picture with its caption."""
    data, words = base64.b64encode(png).decode("ascii"), spelled(caption)
    return f'<figure><img alt="{words}" src="data:image/png;base64,{data}"><figcaption>{words}</figcaption></figure>'


def spelled(text: str) -> str:
    """Escape markup and spell out invisible characters.

    HTML allows no control characters, and those that reverse the direction of writing (U+202E and others of category
    Cf) can make a name look like another.
    """
    return escape("".join(c if c == "\n" or category(c) not in _UNSEEN else f"\\u{ord(c):04x}" for c in text))
