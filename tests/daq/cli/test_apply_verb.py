"""`drivegain apply` and `drivegain rollback`, as a person uses them, on a copy of the demo cell."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import pytest
from rich.console import Console

from daq.cli.app import main
from daq.cli.apply import entered_masses, require_separate_audit, tightened
from daq.config.cell_file import load_cell
from daq.config.policy import ApplyPolicy
from daq.documents.calibration_file import decode_calibration, encode_calibration, save_calibration
from daq.environment import login
from daq.errors import AuditUnusable, ExitCode, UsageError
from daq.files import sha256
from daq.ledger.audit import AuditAction, read, verify
from daq.report.proposal import change_table
from daq.writeback.judgement import NO_HISTORY, HistoryFigures
from daq.writeback.request import GainChange
from ident.calibration import Calibration
from ident.drift.change import DISPERSION
from tests.daq.calibrations import AXES, demo_calibration, recorded, with_recordings
from tests.daq.histories import history_of

CONFIGS = Path(__file__).parents[3] / "configs"


@dataclass(frozen=True)
class Bench:
    """A cell of one's own, and a calibration of it that was recorded just now."""

    cell: Path
    controller: Path
    calibration: Path

    @property
    def audit(self) -> Path:
        """Audit log of the cell."""
        return self.cell.with_name("cell.audit.jsonl")

    @property
    def content(self) -> bytes:
        """Content of the controller's file."""
        return self.controller.read_bytes()

    @property
    def backups(self) -> list[Path]:
        """Copies of the controller's file from before a write."""
        files = self.controller.parent.glob("*.bak")
        return list(files)

    def apply(self, *options: str) -> int:
        """The command."""
        return main(["apply", str(self.calibration), "--cell", str(self.cell), *options])

    def rollback(self, *options: str) -> int:
        """The command."""
        return main(["rollback", "--cell", str(self.cell), *options])

    def actions(self) -> list[AuditAction]:
        """Actions in the audit, whose chain is unbroken."""
        verdict = verify(self.audit)
        assert verdict.holds
        assert verdict.open_writes == ()
        return [entry.action for entry in verdict.entries]

    def add_to_cell_file(self, text: str) -> None:
        """Add lines to the cell file."""
        before = self.cell.read_text()
        self.cell.write_text(before + text)

    def save(self, calibration: Calibration) -> None:
        """Save a calibration of the configuration that the cell has now."""
        digest = load_cell(self.cell).digest
        of_this_cell = replace(calibration, configuration_sha256=digest)
        save_calibration(of_this_cell, self.calibration)

    def saved(self) -> Calibration:
        """The calibration in the file."""
        content = self.calibration.read_bytes()
        return decode_calibration(content, "")


def verify_history(cell: Path) -> int:
    """Status of `drivegain history --verify`."""
    return main(["history", str(cell), "--verify"])


def error_output(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed to standard error, in one line."""
    printed = capsys.readouterr().err
    return " ".join(printed.split())


def printed_document(capsys: pytest.CaptureFixture[str]) -> Any:
    """The JSON document that was printed."""
    printed = capsys.readouterr().out
    return json.loads(printed)


def with_fourth_gain(calibration: Calibration, factor: float) -> Calibration:
    """The calibration with the gain of J4 times a factor."""
    gains = list(calibration.gains)
    gains[3] = replace(gains[3], value=gains[3].value * factor)
    return replace(calibration, gains=tuple(gains))


def run_in_process(arguments: list[str], stdout: int | IO[str]) -> subprocess.CompletedProcess[str]:
    """Run the command line in a new process."""
    command = [sys.executable, "-m", "daq", *arguments]
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """In folders with blanks in their names."""
    return _bench_in(tmp_path)


def _bench_in(folder: Path) -> Bench:
    """A cell in a folder."""
    cells = folder / "the cells"
    controllers = folder / "controllers"
    cells.mkdir()
    controllers.mkdir()
    demo_path = CONFIGS / "cells" / "demo.yaml"
    robots = CONFIGS / "robots"
    text = demo_path.read_text().replace("../robots", str(robots))
    cell = cells / "cell.yaml"
    cell.write_text(text)
    controller = controllers / "demo.yaml"
    shutil.copyfile(CONFIGS / "controllers" / "demo.yaml", controller)
    bench = Bench(cell, controller, folder / "calibration.yaml")
    calibration = recorded(demo_calibration(), datetime.now(UTC))
    bench.save(calibration)
    return bench


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (
            ("cell", "controller"),
            ("controllers/demo.yaml", "no calibration", "`drivegain fit` wrote"),
        ),
        (
            ("cell", "cell"),
            ("cell.yaml", "found:    a cell file", "expected: a calibration of version"),
        ),
        (
            ("calibration", "cell"),
            (
                "calibration.yaml",
                "found:    a calibration",
                "expected: a cell file",
                "CELL comes first",
            ),
        ),
        (
            ("controller", "calibration"),
            ("demo.yaml", "file of another kind, with controller", "CELL comes first"),
        ),
        (
            ("cell", "calibration", "--to", "calibration"),
            ("drives.J1.gain", "no key 'drives'", "the controller's file?"),
        ),
        (
            ("cell", "calibration", "--to", "cell"),
            ("drives.J1.gain", "no key 'drives'", "the controller's file?"),
        ),
    ],
)
def test_exchanged_files_are_named_and_stay_as_they_are(
    bench: Bench, order: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"cell": bench.cell, "calibration": bench.calibration, "controller": bench.controller}
    before = {path: path.read_bytes() for path in files.values()}
    arguments = [str(files.get(word, word)) for word in order]
    status = main(["apply", *arguments, "--yes"])
    assert status != ExitCode.OK
    said = capsys.readouterr().err
    for label in ("found", "expected", "do"):
        assert f"{label}:" in said
    for word in words:
        assert word in said
    after = {path: path.read_bytes() for path in files.values()}
    assert after == before
    assert not bench.audit.exists()


def test_a_dry_run_is_a_table_a_diff_and_no_trace(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.content
    assert bench.apply() == ExitCode.OK
    shown = capsys.readouterr().out
    fourth = next(line for line in shown.splitlines() if line.startswith("J4"))
    # Old, new ± σ, σ %, change %, change in σ with its mark, nameplate, distance from it.
    row = " ".join(fourth.split())
    assert row == "J4 -11.52 -9.210 ± 0.037 0.40 -20.1 59.7 * -11.52 -20.1 Nm/A"
    assert "+    gain: -9.2100" in shown
    assert "nothing was written" in shown
    assert bench.content == before
    assert not bench.audit.exists()


def test_the_command_shows_writes_and_rolls_back(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.content
    assert bench.apply("--json") == ExitCode.OK
    dry = printed_document(capsys)
    assert dry["applied"] is False
    assert dry["refusals"] == []
    assert dry["backup"] is None
    axes = [change["axis"] for change in dry["changes"]]
    assert axes == list(AXES)
    for change in dry["changes"]:
        assert change["significant"]

    assert bench.apply("--yes", "--base", "0" * 64) == ExitCode.CALIBRATION_REFUSED
    assert "--base" in capsys.readouterr().err
    status = bench.apply("--yes", "--max-change-percent", "10", "--json")
    assert status == ExitCode.CALIBRATION_REFUSED
    outcome = capsys.readouterr()
    refusals = json.loads(outcome.out)["refusals"]
    gates = {refusal["gate"] for refusal in refusals}
    assert gates == {"change"}
    assert "J4" in outcome.err
    assert bench.content == before
    assert bench.actions() == [AuditAction.REFUSED] * 2

    status = bench.apply("--yes", "--base", dry["base_sha256"], "--by", "Ada")
    assert status == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    last_line = lines[-1]
    undo = shlex.split(last_line.removeprefix("To undo: drivegain "))
    expected = ["rollback", str(bench.cell)]
    assert undo == expected
    assert b"-9.2100" in bench.content

    assert bench.apply("--yes") == ExitCode.OK
    assert "these gains already" in capsys.readouterr().out

    assert main(undo) == ExitCode.OK
    restored = capsys.readouterr().out
    assert "Restored" in restored
    assert "Let the controller load the file." in restored
    assert bench.content == before
    assert bench.actions() == [
        AuditAction.REFUSED,
        AuditAction.REFUSED,
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.NOTHING_TO_DO,
        AuditAction.ROLLBACK_BEGUN,
        AuditAction.ROLLED_BACK,
    ]
    assert read(bench.audit)[2].who == f"Ada (login {login()})"
    events = history_of(bench.cell).events
    targets = [event.target for event in events]
    assert targets == [str(bench.controller)] * 2


def test_the_audit_says_who_what_and_from_which_logs(bench: Bench) -> None:
    before = bench.content
    assert bench.apply("--yes") == ExitCode.OK
    begun, applied, entered = read(bench.audit)
    document = encode_calibration(bench.saved())
    assert entered.details["document"] == document.decode()
    assert begun.action is AuditAction.APPLY_BEGUN
    assert begun.who == login()
    assert begun.subject == str(bench.controller)
    assert applied.details == {"begun": begun.number}
    logs = begun.details["logs"]
    assert isinstance(logs, list)
    names_and_digests = [(log["name"], log["sha256"]) for log in logs]
    sources = demo_calibration().sources
    assert names_and_digests == [(one.name, one.sha256) for one in sources]
    changes = begun.details["changes"]
    assert isinstance(changes, list)
    fourth = changes[3]
    assert fourth["axis"] == "J4"
    assert fourth["old"] == -11.52
    assert fourth["new"] == -9.21
    reported = begun.details["calibration"]
    assert isinstance(reported, dict)
    assert reported["file"] == str(bench.calibration)
    assert begun.details["sha256_before"] != begun.details["sha256_after"]
    assert len(bench.content) != len(before)


def test_another_configuration_is_refused_until_someone_says_so(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.add_to_cell_file("# changed\n")
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "--configuration-changed" in capsys.readouterr().err
    assert bench.apply("--yes", "--configuration-changed") == ExitCode.OK


def test_the_mass_may_be_entered_at_the_write_back(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = recorded(demo_calibration(), datetime.now(UTC))
    once = with_recordings(calibration, entered_kg=None)
    bench.save(once)
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "--payload-mass disc=KG" in capsys.readouterr().err
    assert bench.apply("--yes", "--payload-mass", "disc=4.61") == ExitCode.CALIBRATION_REFUSED
    assert bench.apply("--yes", "--payload-mass", "disc") == ExitCode.USAGE
    assert bench.apply("--yes", "--payload-mass", "disc=4.592") == ExitCode.OK


@pytest.mark.parametrize(
    "text", ["disc", "disc=", "disc=-1", "disc=nan", "disc=inf", "=4.59", "block=4.59", "disc=1=2"]
)
def test_what_is_no_mass_of_a_payload_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        entered_masses([text], demo_calibration())


def test_options_may_be_tighter_than_the_cell_and_not_wider(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ApplyPolicy(max_change_percent=20.0)
    tighter_nameplate = replace(policy, max_nameplate_percent=40.0)
    assert tightened(policy, None, 40.0, None) == tighter_nameplate
    tighter_std = replace(policy, max_std_percent=0.5)
    assert tightened(policy, 20.0, None, 0.5) == tighter_std
    for wider in ((20.1, None, None), (None, 51.0, None), (None, None, 3.1)):
        with pytest.raises(UsageError, match="wider than the cell's"):
            tightened(policy, *wider)
    assert bench.apply("--max-change-percent", "36") == ExitCode.USAGE
    assert "policy: {apply: {max_change_percent: ...}}" in capsys.readouterr().err


def test_the_cell_s_policy_is_the_bound(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.add_to_cell_file("policy: {apply: {max_change_percent: 15}}\n")
    status = bench.apply("--configuration-changed", "--json")
    assert status == ExitCode.CALIBRATION_REFUSED
    (refusal,) = printed_document(capsys)["refusals"]
    assert refusal["gate"] == "change"
    assert refusal["subject"] == "J4"


def test_a_policy_that_wants_more_signatures_than_it_names_is_refused(bench: Bench) -> None:
    bench.add_to_cell_file("policy: {apply: {signatures: 1}}\n")
    assert bench.apply() == ExitCode.CONFIGURATION


def test_a_rollback_without_a_cell_says_that_it_is_not_recorded(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    without_cell = ["rollback", "--to", str(bench.controller)]
    assert main(without_cell) == ExitCode.OK
    assert "No audit log has this rollback" in capsys.readouterr().out
    audit = tmp_path / "elsewhere.jsonl"
    status = main([*without_cell, "--audit", str(audit)])
    assert status == ExitCode.OK
    assert "No audit log has this rollback" not in capsys.readouterr().out
    actions = [entry.action for entry in read(audit)]
    assert actions == [
        AuditAction.ROLLBACK_BEGUN,
        AuditAction.ROLLED_BACK,
    ]
    assert main(["rollback"]) == ExitCode.USAGE


def test_without_room_for_the_audit_nothing_is_written(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.content
    os.mkfifo(bench.audit)
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "the cell's audit, a regular file" in capsys.readouterr().err
    assert bench.content == before
    assert bench.backups == []


def test_no_one_takes_a_write_out_of_the_cell_s_audit(bench: Bench, tmp_path: Path) -> None:
    other = tmp_path / "other.jsonl"
    assert bench.apply("--yes", "--audit", str(other)) == ExitCode.USAGE
    assert bench.apply("--yes") == ExitCode.OK
    assert bench.rollback("--audit", str(other)) == ExitCode.USAGE
    assert not other.exists()
    assert bench.actions() == [
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.CALIBRATION_ENTERED,
    ]


@pytest.mark.parametrize("spoil", ["an end cut off", "one line cut", "emptied", "deleted"])
def test_an_audit_that_lost_a_write_is_noticed(
    bench: Bench, capsys: pytest.CaptureFixture[str], spoil: str
) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    assert verify_history(bench.cell) == ExitCode.OK
    lines = bench.audit.read_bytes().splitlines(keepends=True)
    match spoil:
        case "an end cut off":
            bench.audit.write_bytes(lines[0])
        case "one line cut":
            bench.audit.write_bytes(lines[0][:40])
        case "emptied":
            bench.audit.write_bytes(b"")
        case "deleted":
            bench.audit.unlink()
    assert verify_history(bench.cell) == ExitCode.DATA_UNFIT
    assert "noted elsewhere" in capsys.readouterr().err


def test_an_audit_that_lost_a_rollback_is_noticed(bench: Bench) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    written = bench.audit.read_bytes()
    assert bench.rollback() == ExitCode.OK
    assert verify_history(bench.cell) == ExitCode.OK
    bench.audit.write_bytes(written)
    assert verify_history(bench.cell) == ExitCode.DATA_UNFIT


def test_two_cells_of_one_controller_s_file_and_one_audit_know_their_own_writes(
    bench: Bench,
) -> None:
    shared = "\nhistory: {audit: shared.jsonl, store: %s.sqlite}\n"
    cell = bench.cell
    other = cell.with_name("other.yaml")
    text = cell.read_text()
    other_text = text.replace("name: demo", "name: other")
    cell.write_text(text + shared % "one")
    other.write_text(other_text + shared % "two")

    _save_calibration_of(cell, bench.calibration, 1.0)
    assert bench.apply("--yes") == ExitCode.OK
    other_bench = replace(bench, cell=other)
    _save_calibration_of(other, bench.calibration, 1.01)
    base = sha256(bench.content)
    assert other_bench.apply("--yes", "--base", base) == ExitCode.OK
    assert verify_history(cell) == ExitCode.OK
    assert verify_history(other) == ExitCode.OK

    assert other_bench.rollback() == ExitCode.OK
    assert verify_history(cell) == ExitCode.OK
    assert verify_history(other) == ExitCode.OK


def _save_calibration_of(cell_file: Path, calibration_file: Path, factor: float) -> None:
    """Save a calibration of a cell, with the gains of the demo times a factor."""
    cell = load_cell(cell_file)
    demo = recorded(demo_calibration(), datetime.now(UTC))
    gains = [replace(gain, value=gain.value * factor) for gain in demo.gains]
    calibration = replace(
        demo,
        cell=cell.name,
        configuration_sha256=cell.digest,
        gains=tuple(gains),
    )
    save_calibration(calibration, calibration_file)


def test_a_dry_run_says_that_the_history_cannot_be_read(
    bench: Bench, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.cell.with_name("cell.history.sqlite").write_text("not a history, " * 100)
    assert bench.apply() == ExitCode.OK
    printed = capsys.readouterr().err
    assert "the history cannot be read" in caplog.text + printed


@pytest.mark.parametrize("name", ["A\udcff", "A\x1b[31m", "A\u202e"])
def test_a_name_that_cannot_be_shown_is_no_name(bench: Bench, name: str) -> None:
    before = bench.content
    assert bench.apply("--yes", "--by", name) == ExitCode.USAGE
    assert bench.content == before


def test_after_a_kill_behind_the_write_the_same_command_enters_the_history(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("daq.writeback.target.enter_calibration", killed)
        assert bench.apply("--yes") == ExitCode.INTERRUPTED
    assert b"-9.2100" in bench.content
    said = error_output(capsys)
    assert "has the new content, complete; the history lacks this write" in said
    assert "nothing was written" not in said
    for _ in range(2):
        assert bench.apply("--yes") == ExitCode.OK
        assert "these gains already" in capsys.readouterr().out
        _assert_first_is_in_force(bench)
        (event,) = history_of(bench.cell).events
        applied = read(bench.audit)[1]
        assert event.audit == applied.sha256
    assert verify_history(bench.cell) == ExitCode.OK
    assert bench.rollback() == ExitCode.OK
    assert bench.rollback() == ExitCode.OK
    _assert_first_is_in_force(bench)


def _assert_first_is_in_force(bench: Bench) -> None:
    """Check that the history's first calibration is in force."""
    history = history_of(bench.cell)
    in_force = history.in_force(str(bench.controller))
    assert in_force == history.entries[0].digest


def test_a_dry_run_of_what_is_there_already_enters_the_history_nothing(bench: Bench) -> None:
    bench.controller.write_bytes(bench.content)
    assert bench.apply() == ExitCode.OK
    assert not bench.audit.exists()


def test_a_history_that_is_none_does_not_make_a_write_undone(
    bench: Bench, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.cell.with_name("cell.history.sqlite").write_text("not a history, " * 100)
    assert bench.apply("--yes") == ExitCode.OK
    printed = capsys.readouterr().err
    assert "the history may lack this write" in caplog.text + printed
    assert b"-9.2100" in bench.content


def _change(axis: str, current_gain: float, new: float, std: float) -> GainChange:
    return GainChange(axis, axis, 1, current_gain, new, std, "Nm/A", current_gain, "")


def significant(changes: tuple[GainChange, ...], known: HistoryFigures = NO_HISTORY) -> set[str]:
    """Axes whose change is marked as more than noise in the table that the operator reads."""
    shown = io.StringIO()
    console = Console(file=shown, width=120)
    console.print(change_table(changes, known))
    lines = shown.getvalue().splitlines()
    marked = [line for line in lines if " * " in line]
    return {line.split()[0] for line in marked}


def test_what_is_significant_is_a_matter_of_sigma_not_of_per_cent() -> None:
    large = _change("J1", 30.0, 33.0, 3.0)  # 10 %, 1 σ
    small = _change("J2", 30.0, 30.3, 0.03)  # 1 %, 10 σ
    broken = _change("J3", 30.0, float("nan"), 0.1)
    assert significant((large, small, broken)) == {"J2"}
    assert significant((broken,)) == set()
    # 2.5 % are 3.5 σ of the new gain alone, and 2.5 σ where the current gain is as uncertain.
    middle = _change("J4", 10.0, 10.25, 0.07)
    assert significant((middle,)) == {"J4"}
    known = HistoryFigures({"J4": 0.07})
    assert significant((middle,), known) == set()


def test_the_number_in_the_file_has_the_sigma_of_its_calibration(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    def fourth() -> dict[str, object]:
        capsys.readouterr()
        assert bench.apply("--json") == ExitCode.OK
        document = printed_document(capsys)
        found: dict[str, object] = document["changes"][3]
        return found

    # Entered by hand: exact
    change_nm_a = -2.31
    std_nm_a = DISPERSION * 0.03684
    assert fourth()["change_sigmas"] == pytest.approx(change_nm_a / std_nm_a)
    assert bench.apply("--yes") == ExitCode.OK
    known = bench.saved()
    moved = with_fourth_gain(known, 1.015)
    save_calibration(moved, bench.calibration)
    found = fourth()
    change_nm_a = 0.015 * 9.21
    std_of_both_nm_a = std_nm_a * 2**0.5
    expected = pytest.approx(change_nm_a / std_of_both_nm_a, rel=0.01)
    assert found["change_sigmas"] == expected
    assert found["significant"] is False  # 3.7 σ would be, were the number exact
    assert bench.apply() == ExitCode.OK
    shown = capsys.readouterr().out
    assert "σ of both" in shown
    assert "No gain has changed by more than noise: the largest change is J4 +1.5 % (" in shown
    assert "Nothing needs to be written." in shown
    far = with_fourth_gain(known, 1.1)
    save_calibration(far, bench.calibration)
    assert bench.apply() == ExitCode.OK
    assert "Nothing needs to be written" not in capsys.readouterr().out


def _shown_base(shown: str) -> str:
    """Options that the dry run prints for the write."""
    _, after_base = shown.split("--yes --base ")
    return after_base.split(maxsplit=1)[0]


@pytest.mark.slow
def test_the_base_of_a_dry_run_writes_that_change_and_no_other(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.content
    fitted = bench.calibration.read_bytes()
    assert bench.apply() == ExitCode.OK
    shown = capsys.readouterr().out
    base = _shown_base(shown)
    assert bench.apply("--json") == ExitCode.OK
    document = printed_document(capsys)
    assert document["base"] == base
    # Another calibration under the same name.
    moved = with_fourth_gain(bench.saved(), 1.01)
    save_calibration(moved, bench.calibration)
    assert bench.apply("--yes", "--base", base) == ExitCode.CALIBRATION_REFUSED
    said = error_output(capsys)
    assert "the keys or the factors have changed since the dry run" in said
    assert bench.apply("--base", base) == ExitCode.CALIBRATION_REFUSED
    shown = capsys.readouterr().out
    assert _shown_base(shown) != base
    bench.calibration.write_bytes(fitted)
    # Other keys in the cell: the gains of J1 and J2 exchanged.
    cell = bench.cell.read_text()
    swapped = cell.replace("[drives.J1.gain, drives.J2.gain,", "[drives.J2.gain, drives.J1.gain,")
    assert swapped != cell
    bench.cell.write_text(swapped)
    status = bench.apply("--yes", "--base", base, "--configuration-changed")
    assert status == ExitCode.CALIBRATION_REFUSED
    bench.cell.write_text(cell)
    # Another file.
    bench.controller.write_bytes(before + b"# seen by K.\n")
    assert bench.apply("--yes", "--base", base) == ExitCode.CALIBRATION_REFUSED
    assert "as --base says" in error_output(capsys)
    bench.controller.write_bytes(before)
    assert bench.backups == []
    assert bench.apply("--yes", "--base", base) == ExitCode.OK
    (backup,) = bench.backups
    assert f".{base}.bak" in backup.name
    # Asked for once more, what it wants is there already.
    assert bench.apply("--yes", "--base", base) == ExitCode.OK
    with_another_sign = base.replace("-", "_")
    for wrong in ("abc", base[:-1], with_another_sign, "x" * 64):
        assert bench.apply("--yes", "--base", wrong) == ExitCode.USAGE


def test_a_dry_run_of_a_file_that_changed_since_the_recording_reports_the_way_on(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    digest = sha256(bench.content)
    calibration = with_recordings(bench.saved(), controller_sha256=digest)
    save_calibration(calibration, bench.calibration)
    changed = bench.content + b"# seen by K.\n"
    bench.controller.write_bytes(changed)
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "--base" not in capsys.readouterr().out
    assert bench.apply() == ExitCode.CALIBRATION_REFUSED
    shown = capsys.readouterr().out
    base = _shown_base(shown)
    assert bench.apply("--max-change-percent", "1") == ExitCode.CALIBRATION_REFUSED
    assert "--yes" not in capsys.readouterr().out  # another gate refuses
    assert bench.apply("--yes", "--base", base) == ExitCode.OK
    capsys.readouterr()
    # The file is another one than at the recording, by this very write.
    assert bench.apply("--yes") == ExitCode.OK
    assert "these gains already" in capsys.readouterr().out
    last_action = bench.actions()[-1]
    assert last_action is AuditAction.NOTHING_TO_DO
    assert bench.apply() == ExitCode.OK
    assert bench.actions().count(AuditAction.NOTHING_TO_DO) == 1
    status = bench.apply("--configuration-changed", "--max-std-percent", "0.01")
    assert status == ExitCode.CALIBRATION_REFUSED


@pytest.mark.parametrize("place", ["controller", "cell", "calibration", "store", "notes"])
@pytest.mark.parametrize("refused", [False, True])
def test_no_other_file_becomes_an_audit(
    bench: Bench, capsys: pytest.CaptureFixture[str], place: str, refused: bool
) -> None:
    notes = bench.cell.with_name("notes.txt")
    store = bench.cell.with_name("cell.history.sqlite")
    notes.write_text("the robot was moved\non Monday\n")
    audit_of = {
        "controller": bench.controller,
        "cell": bench.cell,
        "calibration": bench.calibration,
        "store": store,
        "notes": notes,
    }
    store_name = json.dumps(str(store))
    audit_name = json.dumps(str(audit_of[place]))
    bench.add_to_cell_file(f"history: {{store: {store_name}, audit: {audit_name}}}\n")
    paths = [bench.controller, bench.cell, bench.calibration, notes]
    before = [path.read_bytes() for path in paths]
    options = ["--yes", "--configuration-changed"]
    if refused:
        options += ["--max-change-percent", "1"]
    assert bench.apply(*options) != ExitCode.OK
    contents = [path.read_bytes() for path in paths]
    assert contents == before
    assert not store.exists()
    if not refused:
        assert "audit" in capsys.readouterr().err


def test_a_rollback_writes_into_no_other_file(bench: Bench) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    link = bench.controller.with_name("audit.jsonl")
    link.hardlink_to(bench.cell)
    cell = bench.cell.read_bytes()
    written = bench.content
    for audit in (bench.controller, link):
        status = main(["rollback", "--to", str(bench.controller), "--audit", str(audit)])
        assert status != ExitCode.OK
    assert bench.cell.read_bytes() == cell
    assert bench.content == written


@pytest.fixture
def open_bench() -> Iterator[Bench]:
    """In folders that every user can write to; those of pytest are their owner's alone."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bench = _bench_in(folder)
        for place in (folder, bench.cell.parent, bench.controller.parent):
            place.chmod(0o777)
        yield bench


NOBODY = 65534
FOREIGN_GROUP = 4711  #: No one is in it


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to another user")
@pytest.mark.parametrize("verb", ["apply", "rollback"])
def test_a_controller_file_of_a_foreign_group_stays_and_its_group_is_named(
    open_bench: Bench, verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was "operation not permitted … free space or rights"."""
    command = open_bench.apply
    if verb == "rollback":
        assert open_bench.apply("--yes") == ExitCode.OK
        command = open_bench.rollback
    controller = open_bench.controller
    os.chown(controller, NOBODY, FOREIGN_GROUP)
    for place in open_bench.cell.parent.iterdir():
        os.chown(place, NOBODY, -1)
    before = controller.read_bytes()
    names = sorted(path.name for path in controller.parent.iterdir())
    capsys.readouterr()
    os.seteuid(NOBODY)
    try:
        code = command("--yes")
    finally:
        os.seteuid(0)
    assert code == ExitCode.UNEXPECTED
    said = capsys.readouterr().err
    assert "a file of its group 4711, not " in said
    assert "it is as it was; run the command as its owner and in its group" in said
    assert "free space" not in said
    assert controller.read_bytes() == before
    names_after = sorted(path.name for path in controller.parent.iterdir())
    assert names_after == names
    begun, failed = read(open_bench.audit)[-2:]
    assert failed.action is AuditAction.FAILED
    assert failed.details["begun"] == begun.number


def test_whatever_the_history_does_a_write_is_not_called_undone(
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed")

    monkeypatch.setattr("daq.writeback.target.enter_calibration", broken)
    assert bench.apply("--yes") == ExitCode.OK
    printed = capsys.readouterr().err
    assert "the history may lack this write" in caplog.text + printed
    assert b"-9.2100" in bench.content


def _linked(bench: Bench, target: Path) -> None:
    """Move the controller's file there; the cell file's name of it becomes a symbolic link."""
    target.parent.mkdir(exist_ok=True)
    bench.controller.rename(target)
    bench.controller.symlink_to(target)


def _content_or_nothing(path: Path) -> bytes:
    """Content of a file that may not be there."""
    if path.exists():
        return path.read_bytes()
    return b""


def _all_refused(bench: Bench, found: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = _content_or_nothing(bench.controller)
    capsys.readouterr()
    assert bench.apply() == ExitCode.CALIBRATION_REFUSED
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert bench.rollback() == ExitCode.CALIBRATION_REFUSED
    said = error_output(capsys)
    assert said.count(found) == 3
    assert verify_history(bench.cell) == ExitCode.CALIBRATION_REFUSED
    assert found in error_output(capsys)
    assert _content_or_nothing(bench.controller) == before


def test_a_link_of_the_cell_file_into_a_folder_that_everybody_may_write_is_refused(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "open" / "gains.yaml"
    _linked(bench, target)
    assert bench.apply("--yes") == ExitCode.OK
    (tmp_path / "open").chmod(0o777)
    _all_refused(bench, "everybody may write", capsys)


def test_a_linked_folder_of_the_cell_file_that_everybody_may_write_is_refused(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "open"
    bench.controller.parent.rename(folder)
    bench.controller.parent.symlink_to(folder)
    assert bench.apply("--yes") == ExitCode.OK
    folder.chmod(0o777)
    _all_refused(bench, "everybody may write", capsys)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
@pytest.mark.parametrize("folder", [False, True], ids=["file", "folder"])
@pytest.mark.parametrize("behind", [False, True], ids=["named", "behind one's own"])
def test_another_user_s_link_to_the_cell_file_is_refused(
    bench: Bench, tmp_path: Path, folder: bool, behind: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / "moved"
    if folder:
        link = bench.controller.parent
        controller = moved / "demo.yaml"
    else:
        link = bench.controller
        controller = moved
    link.rename(moved)
    if behind:
        alias = tmp_path / "alias"
        alias.symlink_to(moved)
        link.symlink_to(alias)
        foreign = alias
    else:
        link.symlink_to(moved)
        foreign = link
    assert bench.apply("--yes") == ExitCode.OK
    os.lchown(foreign, 4711, 4711)
    _all_refused(bench, "user 4711 has made", capsys)
    controller.unlink()  # a rollback would bring it back, there
    _all_refused(bench, "user 4711 has made", capsys)


def test_links_of_the_cell_file_in_a_circle_are_called_so(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.controller.unlink()
    bench.controller.symlink_to(bench.controller)
    _all_refused(bench, "round in a circle", capsys)


def test_a_link_of_one_s_own_is_followed_and_history_and_audit_name_the_file_behind_it(
    bench: Bench, tmp_path: Path
) -> None:
    """So do those of earlier versions, which never saw the link: they go on to match."""
    target = tmp_path / "elsewhere" / "gains.yaml"
    _linked(bench, target)
    before = target.read_bytes()
    assert bench.apply("--yes") == ExitCode.OK
    assert bench.rollback() == ExitCode.OK
    assert bench.controller.is_symlink()
    assert target.read_bytes() == before
    subjects = {entry.subject for entry in read(bench.audit)}
    assert subjects == {str(target), "history of demo"}
    events = history_of(bench.cell).events
    targets = {event.target for event in events}
    assert targets == {str(target)}
    assert verify_history(bench.cell) == ExitCode.OK


def _closed_pipe() -> int:
    """The end to write of a pipe that no one reads."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True], ids=["full disk", "closed pipe"])
def test_an_output_that_fails_after_a_write_says_what_was_written(
    bench: Bench, closed: bool
) -> None:
    # The table of `apply` is printed before the write: without --json nothing would be written.
    apply = ["apply", str(bench.calibration), "--yes", "--json"]
    commands = [apply, ["rollback"]]
    if closed:  # that is seen before the write
        assert bench.apply("--yes") == ExitCode.OK
        commands.remove(apply)
    for arguments in commands:
        before = bench.content
        if closed:
            writing = _closed_pipe()
        else:
            writing = os.open("/dev/full", os.O_WRONLY)
        done = run_in_process([*arguments, "--cell", str(bench.cell)], writing)
        os.close(writing)
        assert bench.content != before
        assert done.returncode == ExitCode.UNEXPECTED
        assert re.search(r'^(error: +|\{"error": ")standard output\b', done.stderr, re.MULTILINE)
        assert f"only the printed output is lost: {bench.controller} was written" in done.stderr
        assert not re.search("nothing was|another folder|Traceback|Exception", done.stderr)


@pytest.mark.slow
def test_a_report_that_nobody_can_read_is_no_report_of_a_write(bench: Bench) -> None:
    before = bench.content
    arguments = ["apply", str(bench.calibration), "--yes", "--json", "--cell", str(bench.cell)]
    writing = _closed_pipe()
    done = run_in_process(arguments, writing)
    os.close(writing)
    assert done.returncode == ExitCode.UNEXPECTED
    assert "whose other end is closed" in done.stderr
    assert "nothing was written" in done.stderr
    assert bench.content == before
    # A reader that is there, or a file, takes the report.
    report = bench.cell.with_name("report.json")
    with report.open("w") as file:
        done = run_in_process(arguments, file)
    assert done.returncode == ExitCode.OK
    assert json.loads(report.read_text())
    assert bench.content != before


@pytest.mark.slow
def test_a_change_that_cannot_be_shown_is_not_written(bench: Bench) -> None:
    before = bench.content
    arguments = ["apply", str(bench.calibration), "--yes", "--cell", str(bench.cell)]
    with Path("/dev/full").open("w") as full:
        done = run_in_process(arguments, full)
    assert done.returncode == ExitCode.UNEXPECTED
    assert "no space left" in done.stderr
    assert bench.content == before


@pytest.mark.slow
def test_an_output_that_fails_says_which_were_written_before(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    plot = bench.cell.with_name("gains.svg")
    csv = bench.cell.with_name("none") / "x.csv"
    status = main(["history", str(bench.cell), "--plot", str(plot), "--csv", str(csv)])
    assert status == ExitCode.UNEXPECTED
    shown = capsys.readouterr().err
    assert f"kept:     {plot} was written before that" in shown
    assert "nothing was changed" not in shown
    assert plot.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize(
    "place", ["daq.writeback.target.record_write", "daq.writeback.file_target.replace_file"]
)
def test_a_signal_within_a_write_is_heard_when_the_write_and_its_records_are_whole(
    bench: Bench,
    number: signal.Signals,
    place: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module, _, name = place.rpartition(".")
    genuine = getattr(sys.modules[module], name)

    def interrupted(*given: object, **named: object) -> object:
        signal.raise_signal(number)
        return genuine(*given, **named)

    works: list[Callable[[], int]] = [lambda: bench.apply("--yes"), bench.rollback]
    for work in works:
        before = bench.content
        with monkeypatch.context() as patch:
            patch.setattr(place, interrupted)
            assert work() == ExitCode.INTERRUPTED
        assert bench.content != before
        shown = capsys.readouterr().err
        assert f"interrupted: {bench.controller} was written" in shown
        assert shown.count("\n") == 1
    assert bench.actions() == [
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.ROLLBACK_BEGUN,
        AuditAction.ROLLED_BACK,
    ]
    assert verify_history(bench.cell) == ExitCode.OK


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_write_says_that_nothing_was_changed(
    bench: Bench,
    number: signal.Signals,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = bench.content
    monkeypatch.setattr("daq.writeback.target.propose", lambda *_: signal.raise_signal(number))
    assert bench.apply("--yes") == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == "interrupted: nothing was changed\n"
    assert bench.content == before
    assert not bench.audit.exists()


@pytest.mark.parametrize("option", ["--ram-only", "--save-unknown"])
def test_an_option_of_the_drives_is_not_ignored_without_them(
    bench: Bench, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.content
    assert bench.apply("--yes", option) == ExitCode.USAGE
    assert bench.rollback(option) == ExitCode.USAGE
    assert bench.apply(option) == ExitCode.USAGE
    printed = capsys.readouterr().err
    assert printed.count(f"error:    {option}\n") == 3
    assert bench.content == before


@pytest.mark.slow
def test_the_name_of_a_controller_file_neither_commands_the_terminal_nor_makes_a_line(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    file = bench.controller.with_name("ctl\x1b[31m\nerror: fake.yaml")
    shutil.copyfile(bench.controller, file)
    assert bench.apply("--to", str(file), "--yes") == ExitCode.OK
    assert bench.rollback("--to", str(file)) == ExitCode.OK
    plot = bench.cell.with_name("p\nerror: fake.svg")
    status = main(["history", str(bench.cell), "--plot", str(plot)])
    assert status == ExitCode.OK
    file.unlink()
    assert bench.apply("--to", str(file)) == ExitCode.CALIBRATION_REFUSED
    output = capsys.readouterr()
    assert "Restored" in output.out
    for text in (output.out, output.err):
        assert "\x1b" not in text
        assert "ctl\\x1b[31m" in text
        assert not re.search(r"^error: fake", text, re.MULTILINE)


@pytest.mark.parametrize("made", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to("/dev/null")])
def test_something_else_in_place_of_the_lock_is_named(
    bench: Bench, made: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    lock = bench.controller.with_name(".demo.yaml.lock")
    made(lock)
    before = bench.content
    assert bench.apply("--yes") == ExitCode.UNEXPECTED
    printed = capsys.readouterr().err
    assert f"error:    {lock}\n" in printed
    assert bench.content == before


def test_an_audit_in_no_folder_is_named(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    audit = bench.cell.with_name("none") / "audit.jsonl"
    audit_name = json.dumps(str(audit))
    bench.add_to_cell_file(f"history: {{audit: {audit_name}}}\n")
    before = bench.content
    assert bench.apply("--yes", "--configuration-changed") == ExitCode.UNEXPECTED
    printed = capsys.readouterr().err
    assert f"error:    {audit}\n" in printed
    assert bench.content == before


@pytest.mark.slow
def test_a_terminal_without_greek_letters_gets_them_spelled_out(bench: Bench) -> None:
    file = bench.controller.with_name("é😀.yaml")
    bench.controller.rename(file)
    command = [sys.executable, "-m", "daq", "apply", str(bench.calibration)]
    command += ["--cell", str(bench.cell), "--to", str(file)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    shown = []
    for options in ([], ["--json"]):
        done = subprocess.run(
            [*command, *options], capture_output=True, env=environment, check=False
        )
        assert done.returncode == ExitCode.OK
        assert done.stderr == b""
        text = done.stdout.decode("ascii")
        shown.append(text)
    assert "-9.210 \\u00b1 0.037" in shown[0]
    document = json.loads(shown[1])
    assert document["file"] == str(file)


def test_an_audit_is_compared_with_every_other_file_of_the_command(tmp_path: Path) -> None:
    audit = tmp_path / "cell.audit.jsonl"
    other = tmp_path / "controller.yaml"
    require_separate_audit(audit, (None, other))
    for others in ((None, audit), (other, None, audit)):
        with pytest.raises(AuditUnusable, match="the same file as"):
            require_separate_audit(audit, others)


def test_an_audit_under_another_name_is_the_same_file(tmp_path: Path) -> None:
    audit = tmp_path / "cell.audit.jsonl"
    audit.touch()
    link = tmp_path / "controller.yaml"
    link.hardlink_to(audit)
    with pytest.raises(AuditUnusable, match="the same file as"):
        require_separate_audit(audit, (link,))
