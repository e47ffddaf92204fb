"""Tables of the session study: a way that failed counts as missed,
and has no part in the errors.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from daq.errors import UsageError
from ident.errors import IdentificationError
from tests.studies.session_study import way_or_reason
from tests.studies.session_tables import SessionRow, robot_rows, row_of, summary, write_tables
from tests.studies.study_rows import from_csv

GUIDED = {
    "motion_s": 60.0,
    "changes": 1,
    "missing": "",
    "error_percent": {"J1": 0.3, "J2": -0.8},
    "std_percent": {"J1": 0.3, "J2": 0.4},
}
STEPS = {"duration_s": 20.0, "worst_error_percent": {"10": 1.4, "20": 0.8}}


def _unit(guided: dict[str, Any], steps: dict[str, Any], seed: int = 1) -> dict[str, Any]:
    return {"robot": "RX-90", "seed": seed, "guided": guided, "step_by_step": steps}


def test_a_unit_has_its_times_with_the_changes_of_the_payload_and_its_errors_over_sigma() -> None:
    row = row_of(_unit(GUIDED, STEPS))
    assert row.ratio == pytest.approx((60.0 + 180.0) / (3.0 * 20.0 + 180.0))
    assert row.rms_z == pytest.approx(math.sqrt((1.0 + 4.0) / 2.0))
    assert row.worst_error_percent == pytest.approx(0.8)
    assert not row.target_missed


def test_a_way_that_failed_is_missed_with_its_reason() -> None:
    failed = way_or_reason(_trip)
    assert failed == {"failed": "IdentificationError: J2 tripped"}
    row = row_of(_unit(failed, STEPS))
    assert row.target_missed
    assert row.ratio == math.inf
    assert math.isnan(row.rms_z)
    assert row.reason == "IdentificationError: J2 tripped"
    units = [_unit(GUIDED, STEPS), _unit(failed, STEPS, 2)]
    all_rows = robot_rows(units)
    robots = [one.robot for one in all_rows]
    assert robots == ["RX-90", "all"]
    assert all_rows[0].targets_missed == 1
    rms_z = all_rows[0].rms_z
    assert rms_z == pytest.approx(math.sqrt(2.5))
    # What did not end has no changes and no errors.
    assert all_rows[0].changes == "1 to 1"
    worst_error_percent = all_rows[0].worst_error_percent
    assert worst_error_percent == pytest.approx(0.8)
    assert "RX-90-2: IdentificationError: J2 tripped" in summary([_unit(failed, STEPS, 2)])


def test_a_defect_of_the_code_ends_the_study() -> None:
    with pytest.raises(ZeroDivisionError):
        way_or_reason(lambda: {"ratio": 1 / 0})
    with pytest.raises(KeyboardInterrupt):
        way_or_reason(_interrupt)


def test_the_other_way_that_never_was_enough_takes_for_ever() -> None:
    steps: dict[str, Any] = {"duration_s": None, "worst_error_percent": {}}
    unit = _unit(GUIDED, steps)
    assert row_of(unit).ratio == 0.0
    refused = way_or_reason(_refuse)
    row = row_of(_unit(GUIDED, refused))
    assert row.ratio == 0.0
    assert row.reason == refused["failed"]


def test_tables_come_back_as_they_were_written(tmp_path: Path) -> None:
    units = [_unit(GUIDED, STEPS, 2), _unit(GUIDED, STEPS)]
    write_tables(tmp_path, units)
    text = (tmp_path / "session.csv").read_text(encoding="utf-8")
    rows = from_csv(SessionRow, text)
    seeds = [row.seed for row in rows]
    assert seeds == [1, 2]
    assert rows[0].ratio == 1.0


def _trip() -> dict[str, Any]:
    raise IdentificationError("J2 tripped")


def _refuse() -> dict[str, Any]:
    raise UsageError("plan", found="no way", expected="one", remedy="widen the limits")


def _interrupt() -> dict[str, Any]:
    raise KeyboardInterrupt
