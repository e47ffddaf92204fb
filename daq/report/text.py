"""Text that comes from a file, made safe to show: on a terminal, in a JSON document, in a spreadsheet; and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text


def printable(text: str) -> str:
    """Spell out control characters, which could command a terminal; line ends stay."""
    return "".join(c if c.isprintable() or c == "\n" else f"\\x{ord(c):02x}" for c in text)


def terminal_text(text: str) -> Text:
    """One line of text that rich does not read as markup; control characters and line ends are spelled out."""
    return Text("".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text))


def terminal_lines(text: str) -> str:
    """Lines for `rich.syntax`, which reads no markup: control characters except tabs spelled out, line ends as \\n."""
    lines = text.splitlines()
    return "\n".join("".join(c if c.isprintable() or c == "\t" else f"\\x{ord(c):02x}" for c in line) for line in lines)


class WholeTable(Table):
    """Table without a frame that never cuts a value: where it is too wide, each value gets a line of its own."""

    def __init__(self, title: Text | None = None) -> None:
        super().__init__(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render as a table, or as a paragraph a row: heading and value."""
        free = options.update(width=_UNBOUNDED, min_width=0, max_width=_UNBOUNDED)
        cells = [[*column.cells] for column in self.columns]
        needed = (_GAP - self.collapse_padding) * (len(cells) - 1)
        for column, values in zip(self.columns, cells, strict=True):
            widths = [Measurement.get(console, free, value) for value in (column.header, *values)]
            needed += max(one.maximum if column.no_wrap else one.minimum for one in widths)
        if needed <= options.max_width:
            yield from super().__rich_console__(console, options)
            return
        if self.title is not None:
            yield self.title
        names = [str(column.header) for column in self.columns]
        indent = max(map(cell_len, names))
        for number, row in enumerate(zip(*cells, strict=True)):
            if number:
                yield ""
            for name, value in zip(names, row, strict=True):
                yield Text(f"{name}{' ' * (indent - cell_len(name) + 2)}{value}")


_UNBOUNDED, _GAP = 10_000, 3  #: Columns of a line


def plain_table(
    headings: Iterable[str], *, title: str | None = None, left: Collection[int] = (0,), wrap: Collection[int] = ()
) -> Table:
    """Table without a frame; columns of words are aligned to the left, and cells of `wrap` may be broken into lines."""
    heading = None if title is None else terminal_text(title)
    table = WholeTable(heading)
    for index, name in enumerate(headings):
        table.add_column(terminal_text(name), justify="left" if index in left else "right", no_wrap=index not in wrap)
    return table


def percent_text(percent: float) -> str:
    """Two decimals; a dash for an unknown value."""
    return f"{percent:.2f}" if math.isfinite(percent) else "-"


def json_text(document: Any) -> str:
    """JSON document; numbers that JSON lacks become null, bytes of file names that are not UTF-8 are spelled out."""
    return spelled_bytes(json.dumps(_json_safe(document), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def picked(thing: object, *names: str) -> dict[str, Any]:
    """Copy attributes into a document under their own names."""
    return {name: getattr(thing, name) for name in names}


def spelled_bytes(text: str) -> str:
    """Spell out the bytes of a file's name that are not UTF-8, which no document can hold, as `\\udcff`."""
    return text.encode(errors="backslashreplace").decode()


def _json_safe(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(key): _json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_safe(item) for item in value]
    return value


_FORMULA = tuple("=+-@\t\n＝＋－＠")
"""First characters of a cell that a spreadsheet runs as a formula, which may start programs (OWASP, CSV Injection)."""


def inert(value: Any) -> Any:
    """Cell of a CSV: text that a spreadsheet would run as a formula gets an apostrophe, which marks it as text.

    Numbers are unchanged; bytes of a file's name that are not UTF-8 are spelled out.
    """
    if not isinstance(value, str):
        return value
    # csv does not quote a carriage return alone, and the text after it would become a cell of its own.
    text = spelled_bytes(value).replace("\r\n", "\n").replace("\r", "\n")
    return f"'{text}" if text.startswith(_FORMULA) else text


def inert_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Row of a CSV, by heading, made inert."""
    return {heading: inert(value) for heading, value in row.items()}
