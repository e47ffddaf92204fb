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
from daq.ledger.judgement import NOTHING
from daq.report.gains import gain_table, torque_table
from daq.report.log import log_table
from daq.report.paper_tables import PaperTable
from daq.report.proposal import change_table
from daq.report.text import plain_table
from daq.writeback.request import GainChange
from ident.calibration import Gain

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


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_no_table_of_gains_cuts_a_digit(width: int) -> None:
    gains = tuple(Gain(f"shoulder-lift-joint-{n}", 1234.5678901 + n, 0.00012345, "Nm/A", 1230.1) for n in range(3))
    changes = tuple(
        GainChange(one.axis, "drives.gain", n, one.nameplate, one.value, one.std, one.unit, one.nameplate, "1")
        for n, one in enumerate(gains)
    )
    paper = PaperTable("Table 1", ("parameter", *("10 CAD: value",) * 6), (("zz1", *("1.2345678",) * 6),))
    whole = [gain_table(gains), torque_table((None,) * 3, gains), change_table(changes, NOTHING), *paper.view()]
    wide, narrow = _shown(whole, 1000), _shown(whole, width)
    assert "…" not in narrow
    for number in set(_digits(wide)):
        assert number in narrow


def test_a_digest_is_on_one_line_of_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stdout.isatty()
    output_console().print(log_table({"sha256": SHA256, "a key of many letters and more": "x" * 200}))
    lines = capsys.readouterr().out.splitlines()
    assert any(SHA256 in line for line in lines)
    assert len(lines) == 2
