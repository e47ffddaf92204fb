"""The present version opens the files of the version before:
cell, log, calibrations, audit and history.

`tests/data/make_previous_version.py` made them: wls.yaml was applied, then ml.yaml, which was
rolled back; tls.yaml was entered by hand, and a change of J4 was acknowledged.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration
from daq.ledger.audit import read as read_audit
from daq.ledger.audit import verify
from daq.ledger.fold import writes_to
from daq.ledger.ledger import Ledger, read_history
from daq.log.reader import read_log
from tests.daq.histories import history_of

FILES = Path(__file__).parents[1] / "data" / "previous_version"
J4 = {"wls": -9.0029, "ml": -9.6291, "tls": -9.507}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the files, which a test may change."""
    return shutil.copytree(FILES, tmp_path / "previous")


@pytest.fixture
def cell(folder: Path) -> Path:
    """The cell file in the copy."""
    return folder / "cells" / "press.yaml"


def _json(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main([*map(str, arguments), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def _where_it_was_made(cell: Path) -> Cell:
    """The cell with its controller file under the name that the audit has for it."""
    declared = load_cell(cell)
    assert declared.history is not None
    (subject,) = {
        one.subject for one in read_audit(declared.history.audit) if "applied" in one.action.value
    }
    return replace(declared, folder=Path(subject).parents[1] / "cells")


def _digest(cell: Path, method: str) -> str:
    """SHA-256 of a calibration, as the history has it."""
    (digest,) = [one.digest for one in history_of(cell).entries if one.method == method]
    return digest


def test_calibrations_and_the_log_are_read(folder: Path) -> None:
    for method, gain in J4.items():
        calibration = load_calibration(folder / f"{method}.yaml")
        assert (calibration.cell, calibration.method) == ("press", method)
        assert calibration.gains[3].value == pytest.approx(gain, abs=5e-4)
    log = read_log(folder / "held-out.mcap")
    assert log.head.run.payload is not None
    assert log.head.run.payload.name == "disc"
    assert len(log.samples.time_ns) == log.statistics.samples > 1000


def test_validate_predicts_the_log(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = _json(capsys, "validate", folder / "ml.yaml", folder / "held-out.mcap")
    (log,) = found["logs"]
    assert (log["same_configuration"], log["seen_by_fit"]) == (True, False)
    assert log["relative_error_percent"]["total"] == pytest.approx(1.64, abs=0.2)


def test_the_history_is_what_was_written(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = _json(capsys, "history", cell, "--verify")
    assert found["calibrations"] == 3
    assert found["in_force"] == _digest(cell, "wls")
    (j4,) = [axis for axis in found["axes"] if axis["axis"] == "J4"]
    assert [one["why"] for one in j4["acknowledged"]] == ["gearbox exchanged"]
    audit = found["audit"]
    # Of the SQLite file: three calibrations, and the acknowledgement with the name of the cell.
    assert (audit["entries"], audit["holds"], audit["flaws"], audit["open_writes"]) == (
        7 + 4,
        True,
        [],
        [],
    )
    assert (audit["history_broken"], audit["unknown_writes"]) == ([], [])


def test_the_history_knows_all_writes_of_the_audit(cell: Path) -> None:
    declared = _where_it_was_made(cell)
    assert declared.history is not None
    writes = writes_to(declared, verify(declared.history.audit).entries, ())
    assert [write.ended.who.split()[0] for write in writes] == ["Ada", "Bert", "Cleo"]
    ledger = Ledger.of(declared)
    assert ledger is not None
    assert [event.audit for event in read_history(ledger).events] == [
        write.ended.sha256 for write in writes
    ]


def test_a_changed_line_of_the_audit_is_found(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = cell.with_name("press.audit.jsonl")
    audit.write_text(audit.read_text().replace("Bert", "Eve", 1))
    assert main(["history", str(cell), "--verify"]) == 4
    assert "line 3" in capsys.readouterr().err


def test_rollback_undoes_the_last_write(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    controller = cell.parents[1] / "controllers" / "press.yaml"
    assert str(J4["wls"]) in controller.read_text()
    _json(capsys, "rollback", "--cell", cell, "--by", "Fay")
    assert str(J4["ml"]) in controller.read_text()
    found = _json(capsys, "history", cell, "--verify")
    assert found["audit"]["entries"] == 9 + 4
    assert found["in_force"] == _digest(cell, "ml")


def test_apply_writes_behind_it(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = cell.parents[1]
    arguments = (
        "apply",
        folder / "tls.yaml",
        "--cell",
        cell,
        "--yes",
        "--payload-mass",
        "disc=4.59",
    )
    assert _json(capsys, *arguments)["applied"]
    found = _json(capsys, "history", cell, "--verify")
    assert (found["calibrations"], found["in_force"]) == (3, _digest(cell, "tls"))
