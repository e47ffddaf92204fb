"""Tables on a narrow terminal and in a pipe: no value is cut."""

from __future__ import annotations

import io
import re
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console, RenderableType

from daq.cli.terminal import output_console
from daq.report.log import log_lines
from daq.report.text import plain_table

SHA256 = "0123456789abcdef" * 4


def _shown(parts: list[RenderableType], width: int) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, soft_wrap=True, highlight=False, markup=False)
    for part in parts:
        console.print(part)
    return out.getvalue()


def _digits(text: str) -> list[str]:
    return re.findall(r"\d[\d.]*", text)


@given(
    st.lists(st.lists(st.floats(0, 1e15).map("{:.9g} ± 0.123456".format), min_size=7, max_size=7), max_size=4),
    st.integers(20, 120),
)
def test_every_number_is_whole_at_any_width(rows: list[list[str]], width: int) -> None:
    table = plain_table([f"heading {number}" for number in range(7)], title="Gains", wrap=(6,))
    for row in rows:
        table.add_row(*row)
    text = _shown([table], width)
    assert "…" not in text
    assert all(_digits(value)[0] in text for row in rows for value in row)


def test_a_digest_is_on_one_line_of_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stdout.isatty()
    console = output_console()
    for line in log_lines({"sha256": SHA256, "a key of many letters and more": "x" * 200}, console.width):
        console.print(line)
    lines = capsys.readouterr().out.splitlines()
    assert any(SHA256 in line for line in lines)
    assert len(lines) == 2
