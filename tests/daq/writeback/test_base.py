"""--base approves the reviewed change of a file or of the drives, and no other."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.config.cell import Cell
from daq.errors import CalibrationRefused, UsageError
from daq.writeback.gates.gate import GateContext
from daq.writeback.gates.target import base as base_gate
from daq.writeback.request import Edit, GateFinding, Request, change_digest, parse_base
from drivers.simulation.cell import SimulatedCell
from tests.daq.calibrations import IDENTIFIED, NAMEPLATE, demo_calibration
from tests.daq.drives import apply_in_drives, entered_gain


def _findings(base: str | None, before: bytes, after: bytes) -> list[GateFinding]:
    now = datetime(2025, 1, 2, tzinfo=UTC)
    request = Request(demo_calibration(), now, base=base)
    edit = Edit(subject="x", before=before, after=after)
    context = GateContext(request, edit)
    return list(base_gate(context))


@given(st.binary(max_size=20), st.binary(max_size=20), st.binary(max_size=20))
def test_a_change_is_known_by_both_of_its_ends(before: bytes, after: bytes, another: bytes) -> None:
    base = f" {change_digest(before, after).upper()}\n"
    reviewed, _ = parse_base(base, before)
    expected = hashlib.sha256(before).hexdigest()
    assert reviewed == expected
    assert _findings(change_digest(before, after), before, after) == []
    assert bool(_findings(change_digest(before, after), before, another)) == (
        another not in (before, after)
    )
    assert (parse_base(change_digest(another, after), before)[0] == reviewed) == (another == before)


def test_the_whole_digest_alone_names_no_change() -> None:
    digest = hashlib.sha256(b"old").hexdigest()
    assert parse_base(digest, b"old") == (digest, None)
    assert _findings(digest, b"old", b"any") == []
    assert _findings(None, b"old", b"any") == []


@pytest.mark.parametrize(
    "text", ["", "-", "a" * 63, "g" * 64, "a" * 12, f"{'a' * 12}-", f"{'a' * 12}-{'a' * 64}"]
)
def test_what_is_no_digest_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="12 digits, a hyphen, 12 digits"):
        parse_base(text, b"old")


def test_the_drives_get_the_change_that_was_reviewed_and_no_other(
    drive_cell: Cell, simulation: SimulatedCell, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = demo_calibration()
    apply_in_drives(drive_cell, calibration=calibration, base=None, yes=False)
    printed = capsys.readouterr().out
    base = printed.split("--base ")[1].split(maxsplit=1)[0]
    gain = calibration.gains[3].value
    moved = replace(calibration.gains[3], value=gain * 1.01)
    gains = (*calibration.gains[:3], moved, *calibration.gains[4:])
    another = replace(calibration, gains=gains)
    with pytest.raises(CalibrationRefused, match="have changed since the dry run"):
        apply_in_drives(drive_cell, calibration=another, base=base, yes=True)
    assert [entered_gain(node) for node in simulation.nodes] == pytest.approx(NAMEPLATE)
    apply_in_drives(drive_cell, calibration=calibration, base=base, yes=True)
    assert [entered_gain(node) for node in simulation.nodes] == pytest.approx(IDENTIFIED)
    with pytest.raises(CalibrationRefused, match="as --base says"):
        apply_in_drives(drive_cell, calibration=another, base=base, yes=True)
