"""A history that a killed writer never entered, or whose audit log is no audit log:
reported, refused, repaired.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.errors import ExitCode
from daq.ledger.audit import AuditAction, read
from daq.ledger.fold import WriteAction
from tests.daq.calibrations import calibration_for
from tests.daq.command_line import run_verb
from tests.daq.histories import history_of


@pytest.fixture
def applied(cell_file: Path) -> Path:
    """A calibration that the cell's controller has."""
    calibration = calibration_for(cell_file)
    assert run_verb("apply", cell_file, calibration, "--yes") == ExitCode.OK
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    return calibration


def place_of(cell_file: Path) -> HistoryPlace:
    place = load_cell(cell_file).history
    assert place is not None
    return place


def test_an_audit_of_any_length_is_not_read_into_memory(
    cell_file: Path, applied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with place_of(cell_file).audit.open("ab") as stream:
        stream.truncate(1 << 40)  # no block of it is on the disk
    assert run_verb("history", cell_file, "--verify") == ExitCode.DATA_UNFIT
    assert "more than 1073741824 bytes" in capsys.readouterr().err
    calibration_text = str(calibration_for(cell_file, 1.01))
    assert run_verb("apply", cell_file, calibration_text, "--yes") == ExitCode.CALIBRATION_REFUSED
    assert "more than 1073741824 bytes" in capsys.readouterr().err


def kill_before_the_end(cell_file: Path) -> None:
    """Leave what a writer leaves that is killed right after the rename:
    the begin in the audit, and no more.
    """
    audit = place_of(cell_file).audit
    begun, *_ = audit.read_bytes().splitlines(keepends=True)
    audit.write_bytes(begun)
    audit.with_name(f"{audit.name}.head").unlink()


@pytest.mark.parametrize("repair", ["apply", "add", "rollback"])
def test_a_write_that_was_killed_before_its_end_is_a_finding_until_it_is_entered(
    cell_file: Path, applied: Path, repair: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kill_before_the_end(cell_file)
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.DATA_UNFIT
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "no event of entry 1 of the audit, apply begun" in said
    assert "history CELL --add CALIBRATION" in said
    if repair == "apply":
        assert main(["apply", str(cell_file), str(applied), "--yes"]) == ExitCode.OK
    else:
        assert main(["history", str(cell_file), "--add", str(applied)]) == ExitCode.OK
    if repair == "rollback":
        assert main(["rollback", str(cell_file)]) == ExitCode.OK
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK
    events = history_of(cell_file).events
    found = [event.action for event in events]
    expected = [WriteAction.APPLIED, *([WriteAction.ROLLED_BACK] if repair == "rollback" else [])]
    assert found == expected
    path = place_of(cell_file).audit
    actions = [entry.action for entry in read(path)]
    assert actions.count(AuditAction.WRITE_FOUND) == 1


def test_a_write_that_was_killed_is_entered_before_the_one_that_follows(
    cell_file: Path, applied: Path
) -> None:
    kill_before_the_end(cell_file)
    assert run_verb("history", cell_file, "--add", applied) == ExitCode.OK
    later = calibration_for(cell_file, 1.02)
    assert run_verb("apply", cell_file, later, "--yes") == ExitCode.OK
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    history = history_of(cell_file)
    first, second = history.entries
    digests = [event.digest for event in history.events]
    assert digests == [first.digest, second.digest]
