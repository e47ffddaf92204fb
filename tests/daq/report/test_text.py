"""Tables on a narrow terminal and in a pipe: no value is cut."""

from __future__ import annotations

import io
import re
import sys
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.text import Text

from daq.cli.failure import ErrorParts, show_failure
from daq.cli.terminal import output_console, print_view, say
from daq.report.log import log_lines
from daq.report.text import Sentence, break_lines, plain_table, shared_width

SHA256 = "0123456789abcdef" * 4


def _shown(parts: list[RenderableType], width: int) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, soft_wrap=True, highlight=False, markup=False)
    for part in parts:
        console.print(part)
    return out.getvalue()


def _on_terminal(parts: list[RenderableType], width: int) -> str:
    out = io.StringIO()
    console = Console(
        file=out,
        width=width,
        force_terminal=True,
        color_system=None,
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    for part in parts:
        console.print(part)
    return out.getvalue()


def _digits(text: str) -> list[str]:
    return re.findall(r"\d[\d.]*", text)


@pytest.mark.slow
@given(
    st.lists(
        st.lists(st.floats(0, 1e15).map("{:.9g} ± 0.123456".format), min_size=7, max_size=7),
        max_size=4,
    ),
    st.integers(20, 120),
)
def test_every_number_is_whole_at_any_width(rows: list[list[str]], width: int) -> None:
    headings = [f"heading {number}" for number in range(7)]
    table = plain_table(headings, title="Gains", wrap=(6,))
    for row in rows:
        table.add_row(*row)
    text = _shown([table], width)
    assert "…" not in text
    for value in chain.from_iterable(rows):
        assert _digits(value)[0] in text


WORDS = st.text(
    st.characters(whitelist_categories=("Ll", "Lu", "Nd"), max_codepoint=0x24F),
    min_size=1,
    max_size=14,
)
SENTENCES = st.lists(WORDS, max_size=30).map(" ".join)


@pytest.mark.slow
@given(
    rows=st.lists(st.lists(SENTENCES, min_size=5, max_size=5), min_size=1, max_size=3),
    wrap=st.sets(st.integers(0, 4)),
)
@pytest.mark.parametrize("width", [40, 80, 120])
def test_no_word_of_a_table_is_broken_or_cut_whatever_columns_wrap(
    rows: list[list[str]], wrap: set[int], width: int
) -> None:
    headings = [f"h{number}" for number in range(5)]
    table = plain_table(headings, left=range(5), wrap=wrap)
    for row in rows:
        table.add_row(*row)
    shown = _on_terminal([table], width)
    words = shown.split()
    for value in chain.from_iterable(rows):
        assert set(value.split()) <= set(words)


@given(
    least=st.lists(st.integers(1, 30), min_size=1, max_size=6),
    more=st.lists(st.integers(0, 200), min_size=6, max_size=6),
    free=st.integers(0, 100),
)
def test_columns_share_what_is_free_and_none_gets_more_than_it_wants(
    least: list[int], more: list[int], free: int
) -> None:
    wanted = [one + extra for one, extra in zip(least, more, strict=False)]
    widths = shared_width(least, wanted, range(len(least)), free)
    assert all(low <= width <= high for low, width, high in zip(least, widths, wanted, strict=True))
    difference = sum(wanted) - sum(least)
    expected = min(free, difference)
    assert sum(widths) - sum(least) == expected


@given(st.lists(SENTENCES, max_size=4), st.integers(20, 120), st.integers(0, 6))
def test_a_long_line_is_broken_between_words_alone(
    sentences: list[str], width: int, indent: int
) -> None:
    text = "\n".join(" " * indent + sentence for sentence in sentences)
    broken = break_lines(text, width)
    assert broken.split() == text.split()
    for line in broken.split("\n"):
        assert cell_len(line) <= width or len(line.split()) == 1
    if all(cell_len(line) <= width for line in text.split("\n")):
        assert broken == text


def test_a_command_is_not_broken() -> None:
    command = (
        "drivegain record press-4/cells/press-4.yaml plan.yaml --out loaded.mcap --enable-motion"
    )
    for line in (f"Next: {command}", command, f"  {command}", "  --yes --base " + "0" * 60):
        assert break_lines(line, 40) == line
    text = f"word after word comes before `drivegain scan CELL` and {'x ' * 30}"
    lines = break_lines(text, 60).split("\n")
    assert any("`drivegain scan CELL`" in line for line in lines)


def test_every_line_of_a_verb_is_broken_between_words_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`say`, views and errors break lines alike; a pipe gets whole lines."""
    sentence = "averages of the exchanges " * 8
    failure = ErrorParts("DataError", sentence, sentence, sentence, sentence, 4)
    for is_terminal in (True, False):
        monkeypatch.setattr("sys.stdout.isatty", lambda is_terminal=is_terminal: is_terminal)
        monkeypatch.setattr("sys.stderr.isatty", lambda is_terminal=is_terminal: is_terminal)
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.setenv("TERM", "dumb")
        say(sentence, err=True)
        print_view([sentence, Text(sentence, "bold"), Sentence(sentence)])
        show_failure(failure, json_wanted=False)
        for text in capsys.readouterr():
            lines = [line.rstrip() for line in text.splitlines()]
            assert "exchanges" in text
            assert (max(map(cell_len, lines)) <= 80) is is_terminal
            assert not any(line.endswith(("avera", "excha")) for line in lines)


def test_a_digest_is_on_one_line_of_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stdout.isatty()
    console = output_console()
    description = {"sha256": SHA256, "a key of many letters and more": "x" * 200}
    for line in log_lines(description, console.width):
        console.print(line)
    lines = capsys.readouterr().out.splitlines()
    assert any(SHA256 in line for line in lines)
    assert len(lines) == 2
