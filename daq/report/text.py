"""Text that comes from a file, made safe to show:
on a terminal, in a JSON document, in a spreadsheet; and tables.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from textwrap import wrap
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

#: Half width of the intervals and bands of reports and pictures, in standard deviations
SHOWN_SIGMAS = 2.0


def printable(text: str) -> str:
    """Spell out control characters, which could command a terminal; line ends stay."""
    return _spelled_out(text, "\n")


def _spelled_out(text: str, allowed: str = "") -> str:
    characters = []
    for character in text:
        if character.isprintable() or character in allowed:
            characters.append(character)
        else:
            characters.append(_spelled(character))
    return "".join(characters)


def _spelled(character: str) -> str:
    """A character as Python writes it: \\x1b, \\u202e."""
    number = ord(character)
    if number < 0x100:
        return f"\\x{number:02x}"
    if number < 0x10000:
        return f"\\u{number:04x}"
    return f"\\U{number:08x}"


def origin_text(cell: str, created: str) -> str:
    """Name a calibration by its cell and date; one that a library made may have neither."""
    of_cell = "a calibration without a name"
    if cell:
        of_cell = f"the calibration of {cell}"
    if created:
        return f"{of_cell}, {created}"
    return f"{of_cell}, without a date"


def minute_text(iso: str) -> str:
    """Write an ISO 8601 time to the minute, in UTC; any other text as it is."""
    try:
        return datetime.fromisoformat(iso).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return iso or "time not known"


def terminal_text(text: str) -> Text:
    """One line of text that rich does not read as markup;
    control characters and line ends are spelled out.
    """
    return Text(_spelled_out(text))


def terminal_lines(text: str) -> str:
    """Lines of a diff: control characters except tabs spelled out, line ends as \\n."""
    return "\n".join(_spelled_out(line, "\t") for line in text.splitlines())


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence of a view: a terminal breaks it at spaces alone, a pipe gets one line."""

    text: str
    style: str = ""  #: of rich

    def __str__(self) -> str:
        return self.text

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render as lines that fit the terminal."""
        text = printable(self.text)
        if console.is_terminal:
            text = break_lines(text, options.max_width)
        yield Text(text, style=self.style)


def break_lines(text: str, width: int) -> str:
    """Break the lines of a text that are longer than a terminal at spaces alone.

    A line that is a command is not broken, and a command in backticks stays on one line where it
    fits, so that they can be copied. Continued lines of an indented one are indented a little more.
    """
    lines: list[str] = []
    for line in text.split("\n"):
        if cell_len(line) <= width or _COMMAND_LINE.match(line):
            lines.append(line)
            continue
        indent = len(line) - len(line.lstrip(" "))
        lines += _broken(_words(line, width), indent, width)
    return "\n".join(lines)


_COMMAND_LINE = re.compile(r"\s*(?:[\w ]+: )?(?:drivegain |--\w)")
"""A line that begins with a command, or with the options to add to one."""
_COMMAND_OR_WORD = re.compile(r"[^\s`]*`[^`]*`[^\s`]*|\S+")


def _words(line: str, width: int) -> list[str]:
    """Words of a line; a command in backticks is one, unless it is longer than half a line."""
    words: list[str] = []
    for found in _COMMAND_OR_WORD.findall(line):
        if cell_len(found) > width // 2:
            words += found.split()
        else:
            words.append(found)
    return words


def _broken(words: Sequence[str], indent: int, width: int) -> list[str]:
    """Lines of words, the first indented, the others by two columns more where it is."""
    lines: list[str] = []
    line = " " * indent
    margin = 0
    if indent:
        margin = indent + 2
    for word in words:
        is_empty = not line.strip()
        needed = cell_len(line) + 1 + cell_len(word)
        if not is_empty and needed > width:
            lines.append(line)
            line = " " * margin + word
        elif is_empty:
            line += word
        else:
            line += f" {word}"
    return [*lines, line]


class WholeTable(Table):
    """Table without a frame that never cuts a value.

    Columns that a terminal has no room for follow below, after the first `keys` columns again.
    Where not even one of them fits after those, each value gets a line of its own.
    """

    def __init__(self, title: Text | None = None, *, keys: int = 1) -> None:
        super().__init__(
            title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False
        )
        self._keys = keys

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render as one table, as several below each other, or as a paragraph a row:
        heading and value.
        """
        free = options.update(width=_UNBOUNDED, min_width=0, max_width=_UNBOUNDED)
        room = options.max_width
        least = []
        wanted = []
        for column in self.columns:
            measured = [
                Measurement.get(console, free, value) for value in (column.header, *column.cells)
            ]
            wanted.append(max(one.maximum for one in measured))
            if column.no_wrap:
                least.append(wanted[-1])
            else:
                least.append(max(one.minimum for one in measured))
        everything = list(range(len(least)))
        if self._width(everything, wanted) <= room:
            yield from super().__rich_console__(console, options)
            return
        self.collapse_padding = self.collapse_padding or self._width(everything, least) > room
        blocks = [everything]
        if self._width(everything, least) > room:
            blocks = self._blocks(least, room)
        if self.title is not None:
            yield self.title
        for number, block in enumerate(blocks):
            if number:
                yield ""
            free_width = room - self._width(block, least)
            yield self._only(block, shared_width(least, wanted, block, free_width))
        if not blocks:
            yield from self._paragraphs(options.max_width)

    def _width(self, chosen: Collection[int], widths: list[int]) -> int:
        gap = _GAP - self.collapse_padding
        gaps = gap * (len(chosen) - 1)
        return sum(widths[index] for index in chosen) + gaps

    def _blocks(self, widths: list[int], room: int) -> list[list[int]]:
        """Columns of the tables below each other;
        none where a column does not fit after the keys.
        """
        keys = list(range(self._keys))
        blocks = [keys]
        for index in range(self._keys, len(widths)):
            if self._width([*keys, index], widths) > room:
                return []
            if self._width([*blocks[-1], index], widths) > room:
                blocks.append(keys)
            blocks[-1] = [*blocks[-1], index]
        return blocks

    def _only(self, chosen: list[int], widths: list[int]) -> Table:
        """Return some columns as a table, each of a width in which no word is broken."""
        part = Table(
            box=self.box, show_edge=False, pad_edge=False, collapse_padding=self.collapse_padding
        )
        columns = [self.columns[index] for index in chosen]
        for column, width in zip(columns, widths, strict=True):
            part.add_column(
                column.header, justify=column.justify, no_wrap=column.no_wrap, width=width
            )
        cells = zip(*(column.cells for column in columns), strict=True)
        for row, values in zip(self.rows, cells, strict=True):
            part.add_row(*values, style=row.style)
        return part

    def _paragraphs(self, width: int) -> Iterator[RenderableType]:
        names = [str(column.header) for column in self.columns]
        indent = max(map(cell_len, names)) + 2
        values = zip(*(column.cells for column in self.columns), strict=True)
        for number, (row, cells) in enumerate(zip(self.rows, values, strict=True)):
            if number:
                yield ""
            for name, value in zip(names, cells, strict=True):
                yield Text(
                    "\n".join(entry_lines(name, str(value), indent, width)), style=row.style or ""
                )


def shared_width(
    least: Sequence[int], wanted: Sequence[int], chosen: Sequence[int], free: int
) -> list[int]:
    """Widths of some columns: their least ones, and a share of what is free in proportion to what
    they want.

    Args:
        least: width of each column in which no word is broken.
        wanted: width of each column in which nothing is broken.
        chosen: indices of the columns.
        free: columns of the line that their least widths leave.
    """
    missing = [wanted[index] - least[index] for index in chosen]
    total = sum(missing)
    given = min(free, total)
    widths = []
    for index, need in zip(chosen, missing, strict=True):
        share = 0
        if total:
            share = round(given * need / total)
        widths.append(least[index] + share)
        given -= share
        total -= need
    return widths


#: Columns of a line
_UNBOUNDED = 10_000
_GAP = 3


def entry_lines(name: str, text: str, indent: int, width: int) -> list[str]:
    """Lines of a name and its text, broken at spaces alone;
    a word without room after the name is below it.

    Args:
        name: of the entry.
        text: printable, without line ends.
        indent: columns of the longest name and the gap after it.
        width: columns of a line.
    """
    below = max(map(cell_len, text.split()), default=0) > width - indent
    start = indent
    if below:
        start = 2
    broken = wrap(text, max(width - start, 1), break_long_words=False, break_on_hyphens=False)
    lines = [f"{'':{start}}{line}" for line in broken or [""]]
    if below:
        return [name, *lines]
    first, *others = lines
    blanks = " " * (indent - cell_len(name))
    return [f"{name}{blanks}{first.lstrip()}", *others]


def plain_table(
    headings: Iterable[str],
    *,
    title: str | None = None,
    left: Collection[int] = (0,),
    wrap: Collection[int] = (),
    keys: int = 1,
) -> Table:
    """Make a `WholeTable`; columns of words are aligned to the left,
    and cells of `wrap` may be broken into lines.
    """
    heading = None
    if title is not None:
        heading = terminal_text(title)
    table = WholeTable(heading, keys=keys)
    for index, name in enumerate(headings):
        justify: JustifyMethod = "right"
        if index in left:
            justify = "left"
        table.add_column(terminal_text(name), justify=justify, no_wrap=index not in wrap)
    return table


def known_text(value: float | None, form: str, unknown: str = "-") -> str:
    """Format a number by a format specification; `unknown` for one that is not known."""
    if value is None:
        return unknown
    return format(value, form)


def percent_text(percent: float) -> str:
    """Two decimals; a dash for an unknown value."""
    if math.isfinite(percent):
        return f"{percent:.2f}"
    return "-"


def spelled_bytes(text: str) -> str:
    """Spell out the bytes of a file's name that are not UTF-8, which no document can hold,
    as `\\udcff`.
    """
    return text.encode(errors="backslashreplace").decode()


_FORMULA = tuple("=+-@\t\n＝＋－＠")
"""First characters of a cell that a spreadsheet runs as a formula, which may start programs (OWASP,
CSV Injection).
"""


def inert(value: Any) -> Any:
    """Cell of a CSV: text that a spreadsheet would run as a formula gets an apostrophe,
    which marks it as text.

    Numbers are unchanged; bytes of a file's name that are not UTF-8 are spelled out.
    """
    if not isinstance(value, str):
        return value
    # csv does not quote a carriage return alone, and the text after it would become a cell of its
    # own.
    text = spelled_bytes(value).replace("\r\n", "\n").replace("\r", "\n")
    if text.startswith(_FORMULA):
        return f"'{text}"
    return text


def inert_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Row of a CSV, by heading, made inert."""
    return {heading: inert(value) for heading, value in row.items()}
