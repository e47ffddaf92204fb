"""Text and numbers from an untrusted file:
in tables, pictures and on the terminal they are only shown.
"""

from __future__ import annotations

import codecs
import csv
import io
import json
import warnings
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from daq.cli.app import _spelled
from daq.jobs.cell_fit import Failure, Summary
from daq.jobs.fleet import FIRST_COLUMNS, FleetRow, fleet_csv, fleet_report
from daq.ledger.ledger import read_history
from daq.ledger.watch import Series, watch
from daq.report.document import json_text
from daq.report.history import csv_text, plot_history
from daq.report.proposal import show_proposal
from daq.report.text import inert, printable, terminal_lines, terminal_text
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.request import Request
from daq.writeback.target import Proposal, propose
from ident.calibration import Gain
from tests.daq.calibrations import AXES, demo_calibration, recorded
from tests.daq.histories import calibration_of, enter, ledger_in

FORMULAS = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "＝1", "a\r=1"]


@pytest.mark.parametrize("text", FORMULAS[:-1])
def test_a_formula_is_text_to_a_spreadsheet(text: str) -> None:
    assert inert(text) == "'" + text.replace("\r", "\n")


@pytest.mark.slow
@given(st.text() | st.floats() | st.none())
def test_a_cell_is_what_it_was_but_for_an_apostrophe(value: object) -> None:
    shown = inert(value)
    if isinstance(value, str):
        lines = value.replace("\r\n", "\n").replace("\r", "\n")
        assert shown in (lines, f"'{lines}")
        assert not shown.startswith(tuple("=+-@\t\n"))
        assert "\r" not in shown
    else:
        assert shown is value


def test_bytes_of_a_name_that_are_no_characters_are_spelt_out() -> None:
    assert inert("b\udcff.mcap") == "b\\udcff.mcap"


def _row(name: str, unit: str) -> FleetRow:
    gain = Gain(name, -3.5, 0.01, unit, -3.4)
    result = Summary((gain,), (), 3.0, False, False)
    configuration_sha256 = "0" * 64
    return FleetRow(name, configuration_sha256, (name,), (), result, 1.0, file=Path(name))


@pytest.mark.parametrize("text", [*FORMULAS, "b\udcff"])
def test_the_table_of_a_fleet_has_no_formula_and_can_be_written(text: str) -> None:
    rows = (_row(text, text), FleetRow(text, "", (text,), (), Failure(text, text, 4), 0.0))
    made = fleet_csv(rows)
    assert made.encode().decode() == made
    assert made.startswith(",".join(FIRST_COLUMNS))
    string_io = io.StringIO(made, newline="")
    header, *lines = csv.reader(string_io)
    for cell in chain(header, *lines):
        assert not cell.startswith(tuple("=+@\t\r\n"))
    assert len(lines) == 2
    column = inert(f"{text} gain")
    assert lines[0][header.index(column)] == "-3.5"  # numbers stay numbers
    assert json_text(fleet_report(rows)).encode()


def _watched(path: Path, times: tuple[datetime, ...], unit: str = "Nm/A") -> tuple[Series, ...]:
    ledger = ledger_in(path)
    for number, time in enumerate(times):
        made = replace(calibration_of(number), created=time.isoformat())
        gains = tuple(replace(gain, unit=unit) for gain in made.gains)
        calibration = replace(made, gains=gains)
        enter(
            ledger,
            recorded(calibration, time),
        )
    history = read_history(ledger)
    return watch(history.entries, history.acknowledgements)


def test_the_table_of_a_history_has_no_formula(tmp_path: Path) -> None:
    all_series = _watched(tmp_path, (datetime(2026, 1, 5, tzinfo=UTC),), unit="=cmd|'/c calc'!A1")
    made = csv_text(all_series)
    string_io = io.StringIO(made, newline="")
    for row in csv.DictReader(string_io):
        assert row["unit"] == "'=cmd|'/c calc'!A1"
        assert float(row["gain"])


@pytest.mark.parametrize(
    "times",
    [
        (datetime(9999, 12, 31, 23, tzinfo=UTC),),
        (datetime(2026, 1, 5, tzinfo=UTC), datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)),
        (datetime(1, 1, 1, 1, tzinfo=UTC), datetime(9999, 1, 1, tzinfo=UTC)),
    ],
)
def test_a_history_that_ends_with_the_calendar_is_drawn(
    times: tuple[datetime, ...], tmp_path: Path
) -> None:
    with warnings.catch_warnings(action="error"):
        drawn = plot_history(_watched(tmp_path, times)[:1], "svg", title="demo")
    assert drawn.startswith(b"<?xml")


def _proposal(folder: Path, unit: str) -> Proposal[FileEdit]:
    file = folder / "robot.yaml"
    file.write_text("".join(f"{axis}: 30.0  # tab\t[/]\n" for axis in AXES))
    demo = demo_calibration()
    gains = tuple(replace(gain, unit=unit) for gain in demo.gains)
    made = replace(demo, gains=gains)
    target = FileTarget(file, dict(zip(AXES, AXES, strict=True)))
    now = datetime(2025, 1, 2, tzinfo=UTC)
    return propose(
        target,
        Request(made, now),
    )


@pytest.mark.parametrize("unit", ["[/]", "[red]Nm/A", "Nm\x1b[2J", "\x9b2J"])
def test_a_unit_neither_commands_the_terminal_nor_is_markup(unit: str, tmp_path: Path) -> None:
    shown = io.StringIO()
    proposal = _proposal(tmp_path, unit)
    console = Console(file=shown, width=200, force_terminal=False)
    show_proposal(proposal, console)
    assert "\x1b" not in shown.getvalue()
    assert "\x9b" not in shown.getvalue()
    changed_unit = unit.replace("\x1b", "\\x1b")
    assert changed_unit.replace("\x9b", "\\x9b") in shown.getvalue()


@given(st.text())
def test_terminal_text_has_no_control_characters(text: str) -> None:
    assert terminal_text(text).plain.isprintable()
    assert terminal_lines(text).replace("\n", "").replace("\t", "").isprintable()


@given(st.text("aσ±€漢🤖 ", max_size=8))
@settings(max_examples=20)
def test_what_an_output_lacks_is_spelled_so_that_json_reads_it_as_it_was(text: str) -> None:
    codecs.register_error("spelled in tests", _spelled)
    shown = text.encode("ascii", "spelled in tests").decode("ascii")
    assert json.loads(f'"{shown}"') == text


def test_one_character_that_an_output_lacks_is_spelled_alone() -> None:
    codecs.register_error("spelled in tests", _spelled)
    shown = "5 ± 1 A, σ".encode("latin-1", "spelled in tests")
    assert shown == b"5 \xb1 1 A, \\u03c3"


def test_characters_are_spelled_as_python_writes_them() -> None:
    assert printable("\x1b\u202e\U000e0001") == r"\x1b\u202e\U000e0001"


def test_lines_keep_their_tabs_and_lose_their_carriage_returns() -> None:
    assert terminal_lines("-a:\t1\r\n+a:\t2\r\n") == "-a:\t1\n+a:\t2"
