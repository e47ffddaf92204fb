"""Pieces of a page that needs no other file: no address, pictures inside, every text escaped.

The page reads on a phone (16 px; wide tables scroll in a box of their own, those with a verdict
stack their cells), on paper (the first sheet is one page of A4 or Letter, closed sections are left
out) and in dark mode. Colour-blind readers can distinguish the colours, and no meaning rests on
colour alone.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from unicodedata import category

MARK = '<meta name="generator" content="drivegain">'
"""Text at the beginning of every page, by which an earlier one is recognised."""
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Unicode categories: control, format, surrogates, private, unassigned,
separators of lines and paragraphs.
"""
LIGHT = {
    "paper": "#fff",
    "ink": "#1a1a1a",
    "soft": "#595959",
    "line": "#d4d4d4",
    "shade": "#f0f0f0",
    "data": "#0072B2",
    "act": "#B34700",
    "pale": "#6AAFE0",
}
_DARK = {
    "paper": "#16181a",
    "ink": "#ececec",
    "soft": "#b0b0b0",
    "line": "#44484c",
    "shade": "#26292d",
    "data": "#56B4E9",
    "act": "#F0A060",
    "pale": "#2F6F99",
}
_CODE = re.compile("`([^`\n]+)`")
_OPTION = re.compile(r"(?<!\S)--?[\w-]+")
_NUMBER = re.compile(r"[+\-±]?([\d.]+(e[+-]?\d+)?|nan|inf)( .*)?|-")
DRAWING = """
svg text { fill: var(--ink); font: 14px system-ui, sans-serif; font-variant-numeric: tabular-nums;
  stroke: var(--paper); stroke-width: 4px; stroke-linejoin: round; paint-order: stroke; }
svg .soft { fill: var(--soft); font-size: 13px; } svg .end { text-anchor: end; } svg .mid { text-anchor: middle; }
svg .grid { stroke: var(--line); } svg .zero { stroke: var(--ink); } svg .limit { stroke: var(--act); stroke-width: 2; }
svg .range { fill: var(--shade); } svg .band { fill: var(--data); opacity: 0.25; }
svg .bar { stroke: var(--data); stroke-width: 3; } svg .dot { fill: var(--data); }
svg .hollow { fill: var(--paper); stroke: var(--soft); stroke-width: 2; }
svg .full { fill: var(--data); } svg .empty { fill: var(--paper); stroke: var(--soft); }
svg .alike { fill: var(--pale); stroke: var(--data); }
svg path { fill: none; stroke: var(--data); } svg .line { stroke-width: 2; } svg .thin { stroke-width: 1; }
svg .wide { stroke: var(--pale); stroke-width: 4; }
svg .dashed { stroke: var(--ink); stroke-width: 1.5; stroke-dasharray: 4 2; }
svg .other { stroke: var(--act); stroke-width: 2; stroke-dasharray: 5 3; }
svg .cloud { stroke-width: 2.2; stroke-linecap: round; opacity: 0.4; }
svg .rest { stroke: var(--act); stroke-width: 2.2; stroke-linecap: round; opacity: 0.4; }
"""
"""Style of the drawings of `daq.report.svg`.

A text has an edge in the colour of the paper: no line crosses it.
"""


def palette(light: Mapping[str, str], dark: Mapping[str, str]) -> str:
    """Return the style of the colours of a page on the screen,
    those of every page and some of its own.
    """

    def variables(colours: Mapping[str, str]) -> str:
        return " ".join(f"--{name}: {colour};" for name, colour in colours.items())

    return f"""
:root {{ color-scheme: light dark; {variables({**LIGHT, **light})} }}
@media (prefers-color-scheme: dark) {{ :root {{ {variables({**_DARK, **dark})} }} }}
@media print {{ :root {{ {variables(LIGHT)} }} }}
"""


_STYLE = (
    palette({}, {})
    + DRAWING
    + """
* { box-sizing: border-box; }
body { font: 16px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 56rem;
  margin: 1.5rem auto; padding: 0 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 0.6rem; }
h2 { font-size: 1.15rem; margin: 1.4rem 0 0.4rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 0.8rem 0 0.2rem; }
p, ul { margin: 0.4rem 0; }
.kind { color: var(--soft); margin: 0; }
.verdict { border-left: 0.4rem solid var(--data); background: var(--shade); padding: 0.6rem 0.8rem; font-size: 1.1rem;
  margin: 0.8rem 0 0; }
.next { border-left: 0.4rem solid var(--data); background: var(--shade); margin: 0; padding: 0 0.8rem 0.6rem; }
.act { border-color: var(--act); } .quiet { border-color: var(--soft); }
code { font: 0.95em ui-monospace, monospace; } code span { white-space: nowrap; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.1rem 1rem; margin: 0.8rem 0; }
dt { color: var(--soft); } dd { margin: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.5rem 0; font-variant-numeric: tabular-nums; overflow-wrap: normal; }
caption { text-align: left; font-weight: bold; padding: 0.2rem 0; }
th, td { padding: 0.2rem 0.7rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: baseline; }
th { font-weight: 600; } td { white-space: nowrap; } thead th { color: var(--soft); font-weight: normal; }
th:first-child, .text { text-align: left; } th:first-child { padding-left: 0; }
.names tbody th { white-space: nowrap; position: sticky; left: 0; background: var(--paper); }
.words { width: 100%; } .words .text { white-space: normal; }
.pair { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); gap: 0 1.5rem; }
.pair > section { grid-column: 1 / -1; } .paper { display: none; }
figure { margin: 0.6rem 0; max-width: 26rem; } figcaption { color: var(--soft); font-size: 0.9rem; }
svg { width: 100%; height: auto; display: block; }
details { border-bottom: 1px solid var(--line); } details > :not(summary) { margin-left: 0.2rem; }
summary { cursor: pointer; padding: 0.5rem 0; font-weight: 600; }
summary:focus-visible { outline: 3px solid var(--data); }
@media (max-width: 40rem) {
  th, td { padding: 0.2rem 0.4rem; }
  .words, .words tbody { display: block; } .words thead { display: none; }
  .words tr { display: grid; grid-template-columns: 7.2rem 1fr; gap: 0 1rem; padding: 0.4rem 0;
    border-bottom: 1px solid var(--line); }
  .words th, .words td { border: 0; padding: 0; text-align: left; white-space: normal; overflow-wrap: anywhere; }
  .words td:last-child { grid-area: 1 / 2; }
  .stacked, .stacked tbody { display: block; } .stacked thead { display: none; }
  .stacked tr { display: flex; flex-wrap: wrap; gap: 0 0.6rem; padding: 0.3rem 0;
    border-bottom: 1px solid var(--line); }
  .stacked th { flex-basis: 100%; } .stacked th, .stacked td { border: 0; padding: 0; text-align: left; }
  .words td:not(:last-child)::before { content: attr(data-name); display: block; color: var(--soft);
    font-size: 0.9rem; }
}
@page { margin: 10mm; }
@media print {
  html { font-size: 8.5pt; }
  body { margin: 0; padding: 0; max-width: none; font-size: 8.5pt; line-height: 1.27; }
  h1 { font-size: 14pt; margin: 0 0 1mm; } h2 { font-size: 10pt; margin: 2mm 0 0.8mm; }
  h3 { font-size: 8.5pt; margin: 1.5mm 0 0.5mm; } p, ul { margin: 0.8mm 0; } dl { margin: 1.5mm 0; }
  .verdict { font-size: 10pt; margin: 1.5mm 0 0; padding: 1.2mm 2mm; } .next { padding: 0 2mm 1.2mm; }
  .screen { display: none; } .paper { display: block; }
  .sheet > dl { grid-template-columns: max-content 1fr max-content 1fr; gap: 0 3mm; }
  .sheet > dl > dt.long { grid-column: 1; } .sheet > dl > dd.long { grid-column: 2 / -1; }
  .pair { grid-template-columns: repeat(auto-fit, minmax(55mm, 1fr)); gap: 0 5mm; }
  .pair > section { grid-column: auto; }
  .scroll { overflow: visible; } figure { max-width: 62mm; margin: 1mm 0; } figcaption { font-size: 7pt; }
  table { margin: 1mm 0; } th, td { padding: 0.3mm 1.5mm; border-width: 0.5pt; } td { white-space: normal; }
  .pair table { font-size: 7pt; }
  .paper dl { font-size: 7pt; line-height: 1.25; gap: 0 3mm; margin: 0; }
  .paper dd { font-family: ui-monospace, monospace; }
  .sign { display: flex; gap: 8mm; margin-top: 9mm; break-inside: avoid; }
  .sign span { flex: 1; border-top: 0.5pt solid var(--ink); padding-top: 0.5mm; color: var(--soft); }
  figure, table, dl, .verdict { break-inside: avoid; } h2, h3 { break-after: avoid; } .next { break-before: avoid; }
  .details { break-before: page; }
  details:not([open]), .details:not(:has(details[open])) { display: none; }
}
"""
)


def html_page(title: str, body: Iterable[str]) -> str:
    """Build a page without script; the pieces of the body come from the functions below,
    which escape every text.
    """
    return html_document(title, MARK, _STYLE, "\n".join(body))


def html_document(title: str, mark: str, style: str, body: str, script: str = "") -> str:
    """Build a document that opens no address and runs no script but the given one,
    whatever text the body holds.

    Args:
        title: plain text.
        mark: `meta` element by which the page is recognised.
        style: content of `style`.
        body: content of `body`, escaped.
        script: the only script.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = ""
    if script:
        allowed = f" script-src 'sha256-{digest}';"
    policy = f"default-src 'none';{allowed} img-src data:; style-src 'unsafe-inline'"
    ending = ""
    if script:
        ending = f"<script>{script}</script>\n"
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{mark}
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{spelled(title)}</title>
<style>{style}</style>
</head>
<body>
{body}
{ending}</body>
</html>
"""


def element(tag: str, text: str, kind: str = "") -> str:
    """Build an element of plain text, `code` between back quotes; its kind is a CSS class."""
    named = ""
    if kind:
        named = f' class="{kind}"'
    words = _CODE.sub(_code, spelled(text))
    return f"<{tag}{named}>{words}</{tag}>"


def _code(found: re.Match[str]) -> str:
    """Mark a command up; a line is never broken within the name of an option."""
    command = _OPTION.sub(r"<span>\g<0></span>", found[1])
    return f"<code>{command}</code>"


def paragraph(text: str, kind: str = "") -> str:
    """Build a paragraph of plain text; its kind is a CSS class."""
    return element("p", text, kind)


def section(title: str, *body: str) -> str:
    """Build a section under a heading."""
    return "\n".join(("<section>", element("h2", title), *body, "</section>"))


def part(title: str, *body: str) -> str:
    """Build a part of a section under a smaller heading."""
    return "\n".join(("<section>", element("h3", title), *body, "</section>"))


def on_paper(*body: str) -> str:
    """Show something on paper alone."""
    return "\n".join(('<section class="paper">', *body, "</section>"))


def on_screen(*body: str) -> str:
    """Show something on the screen alone."""
    return "\n".join(('<div class="screen">', *body, "</div>"))


def signature_line(*names: str) -> str:
    """Build lines to be filled in by hand, side by side, each above its name; for paper alone."""
    lines = "".join(element("span", name) for name in names)
    return f'<div class="paper sign">{lines}</div>'


def folded(title: str, *body: str) -> str:
    """Build a section that a reader opens; paper shows it if it was open."""
    return "\n".join(("<details>", element("summary", title), *body, "</details>"))


def html_list(texts: Iterable[str]) -> str:
    """Build a list of plain texts."""
    return f"<ul>{''.join(element('li', text) for text in texts)}</ul>"


#: Characters of a value that takes the width of the paper, where shorter ones take half of it
_LONG = 48


def terms(pairs: Iterable[tuple[str, str]]) -> str:
    """Build a list of names with their values."""
    parts = []
    for name, value in pairs:
        kind = ""
        if len(value) > _LONG:
            kind = "long"
        parts.append(element("dt", name, kind))
        parts.append(element("dd", value, kind))
    return f"<dl>{''.join(parts)}</dl>"


def table(
    caption: str, headings: Sequence[str], rows: Iterable[Sequence[str]], kind: str = ""
) -> str:
    """Build a table of plain texts; the first cell of each row is its heading,
    and its kind is a CSS class.

    A column with any cell that is no number is aligned to the left. Kind "words" is for rows that
    end in a sentence: a phone shows each row as a card. Kind "names" keeps the names of the rows in
    sight where the table scrolls. Kind "stacked" is for long names and few numbers: a phone shows
    the numbers below the name.
    """
    lines = list(rows)
    styles = []
    for column in range(len(headings)):
        cells_of_column = [line[column] for line in lines]
        styles.append(_alignment(cells_of_column))
    names = [spelled(heading) for heading in headings]
    columns = list(zip(names, styles, strict=True))
    head = "".join(f'<th scope="col"{style}>{name}</th>' for name, style in columns)
    opening = "<table>"
    if kind:
        opening = f'<table class="{kind}">'
    parts = ['<div class="scroll">', opening, _optional("caption", caption)]
    parts += [f"<thead><tr>{head}</tr></thead>", "<tbody>"]
    for first, *others in lines:
        cells = ""
        for text, (name, style) in zip(others, columns[1:], strict=True):
            cells += f'<td{style} data-name="{name}">{spelled(text)}</td>'
        parts.append(f'<tr><th scope="row">{spelled(first)}</th>{cells}</tr>')
    parts += ["</tbody></table>", "</div>"]
    return "\n".join(parts)


def _alignment(cells: Iterable[str]) -> str:
    """Return the attribute of a column with any cell that is no number;
    empty for one of numbers.
    """
    if all(_NUMBER.fullmatch(cell) for cell in cells):
        return ""
    return ' class="text"'


def _optional(tag: str, text: str) -> str:
    """Build an element of plain text; empty where there is none."""
    if not text:
        return ""
    return element(tag, text)


def figure(svg: str, caption: str = "", title: str = "") -> str:
    """Show a drawing of `daq.report.svg` under its title, with its caption."""
    head = _optional("h3", title)
    foot = _optional("figcaption", caption)
    return f"<figure>{head}{svg}{foot}</figure>"


def pair(figures: Iterable[str]) -> str:
    """Show figures side by side where there is room."""
    return f'<div class="pair">{"".join(figures)}</div>'


def spelled(text: str) -> str:
    """Escape markup and spell out invisible characters."""
    return escape(visible_text(text))


def visible_text(text: str) -> str:
    """Spell out invisible characters.

    HTML allows no control characters, and those that reverse the direction of writing (U+202E and
    others of category Cf) can make a name look like another.
    """
    return "".join(map(_visible, text))


def _visible(character: str) -> str:
    if character == "\n" or category(character) not in _UNSEEN:
        return character
    return f"\\u{ord(character):04x}"
