"""`drivegain apply` and `drivegain rollback`, as a person uses them, on a copy of the demo cell."""

from __future__ import annotations

import hashlib
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
from daq.writeback.judgement import NOTHING, Spread
from daq.writeback.request import GainChange
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
    text = demo_path.read_text().replace("../robots", str(CONFIGS / "robots"))
    cell = cells / "cell.yaml"
    cell.write_text(text)
    shutil.copyfile(CONFIGS / "controllers" / "demo.yaml", controllers / "demo.yaml")
    calibration = recorded(demo_calibration(), datetime.now(UTC))
    configuration_sha256 = load_cell(cell).digest
    changed_calibration = replace(calibration, configuration_sha256=configuration_sha256)
    save_calibration(
        changed_calibration,
        folder / "calibration.yaml",
    )
    controller = controllers / "demo.yaml"
    calibration_path = folder / "calibration.yaml"
    return Bench(cell, controller, calibration_path)


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
    assert main(["apply", *(str(files.get(word, word)) for word in order), "--yes"]) != ExitCode.OK
    said = capsys.readouterr().err
    assert all(f"{label}:" in said for label in ("found", "expected", "do"))
    assert all(word in said for word in words)
    assert {path: path.read_bytes() for path in files.values()} == before
    assert not bench.audit.exists()


def test_a_dry_run_is_a_table_a_diff_and_no_trace(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.controller.read_bytes()
    assert bench.apply() == ExitCode.OK
    shown = capsys.readouterr().out
    fourth = next(line for line in shown.splitlines() if line.startswith("J4"))
    # Old, new ± σ, σ %, change %, change in σ with its mark, nameplate, distance from it.
    assert " ".join(fourth.split()) == (
        "J4 -11.52 -9.210 ± 0.037 0.40 -20.1 59.7 * -11.52 -20.1 Nm/A"
    )
    assert "+    gain: -9.2100" in shown
    assert "nothing was written" in shown
    assert bench.controller.read_bytes() == before
    assert not bench.audit.exists()


def test_the_command_shows_writes_and_rolls_back(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.controller.read_bytes()
    assert bench.apply("--json") == ExitCode.OK
    dry = json.loads(capsys.readouterr().out)
    assert (dry["applied"], dry["refusals"], dry["backup"]) == (False, [], None)
    assert [change["axis"] for change in dry["changes"]] == list(AXES)
    assert all(change["significant"] for change in dry["changes"])

    assert bench.apply("--yes", "--base", "0" * 64) == ExitCode.CALIBRATION_REFUSED
    assert "--base" in capsys.readouterr().err
    assert (
        bench.apply("--yes", "--max-change-percent", "10", "--json") == ExitCode.CALIBRATION_REFUSED
    )
    outcome = capsys.readouterr()
    refusals = json.loads(outcome.out)["refusals"]
    gates = {refusal["gate"] for refusal in refusals}
    assert gates == {"change"}
    assert "J4" in outcome.err
    assert bench.controller.read_bytes() == before
    assert bench.actions() == [AuditAction.REFUSED] * 2

    assert bench.apply("--yes", "--base", dry["base_sha256"], "--by", "Ada") == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    last_line = lines[-1]
    undo = shlex.split(last_line.removeprefix("To undo: drivegain "))
    expected = ["rollback", str(bench.cell)]
    assert undo == expected
    assert b"-9.2100" in bench.controller.read_bytes()

    assert bench.apply("--yes") == ExitCode.OK
    assert "these gains already" in capsys.readouterr().out

    assert main(undo) == ExitCode.OK
    restored = capsys.readouterr().out
    assert "Restored" in restored
    assert "Let the controller load the file." in restored
    assert bench.controller.read_bytes() == before
    there = [AuditAction.APPLY_BEGUN, AuditAction.APPLIED, AuditAction.CALIBRATION_ENTERED]
    back = [AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK]
    assert bench.actions() == [*[AuditAction.REFUSED] * 2, *there, AuditAction.NOTHING_TO_DO, *back]
    assert read(bench.audit)[2].who == f"Ada (login {login()})"
    events = history_of(bench.cell).events
    targets = [event.target for event in events]
    assert targets == [str(bench.controller)] * 2


def test_the_audit_says_who_what_and_from_which_logs(bench: Bench) -> None:
    before = bench.controller.read_bytes()
    assert bench.apply("--yes") == ExitCode.OK
    begun, applied, entered = read(bench.audit)
    content = bench.calibration.read_bytes()
    calibration = decode_calibration(content, "")
    assert entered.details["document"] == encode_calibration(calibration).decode()
    expected = (AuditAction.APPLY_BEGUN, login(), str(bench.controller))
    assert (begun.action, begun.who, begun.subject) == expected
    assert applied.details == {"begun": begun.number}
    digests = demo_calibration().sources
    logs = begun.details["logs"]
    assert isinstance(logs, list)
    assert [(log["name"], log["sha256"]) for log in logs] == [
        (one.name, one.sha256) for one in digests
    ]
    changes = begun.details["changes"]
    assert isinstance(changes, list)
    assert [(change["axis"], change["old"], change["new"]) for change in changes][3] == (
        "J4",
        -11.52,
        -9.21,
    )
    reported = begun.details["calibration"]
    assert isinstance(reported, dict)
    assert reported["file"] == str(bench.calibration)
    assert begun.details["sha256_before"] != begun.details["sha256_after"]
    assert len(bench.controller.read_bytes()) != len(before)


def test_another_configuration_is_refused_until_someone_says_so(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.cell.write_text(bench.cell.read_text() + "# changed\n")
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "--configuration-changed" in capsys.readouterr().err
    assert bench.apply("--yes", "--configuration-changed") == ExitCode.OK


def test_the_mass_may_be_entered_at_the_write_back(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = recorded(demo_calibration(), datetime.now(UTC))
    once = with_recordings(calibration, entered_kg=None)
    configuration_sha256 = load_cell(bench.cell).digest
    changed_once = replace(once, configuration_sha256=configuration_sha256)
    save_calibration(changed_once, bench.calibration)
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
    assert tightened(policy, None, 40.0, None) == replace(policy, max_nameplate_percent=40.0)
    assert tightened(policy, 20.0, None, 0.5) == replace(policy, max_std_percent=0.5)
    for asked in ((20.1, None, None), (None, 51.0, None), (None, None, 3.1)):
        with pytest.raises(UsageError, match="wider than the cell's"):
            tightened(policy, *asked)
    assert bench.apply("--max-change-percent", "36") == ExitCode.USAGE
    assert "policy: {apply: {max_change_percent: ...}}" in capsys.readouterr().err


def test_the_cell_s_policy_is_the_bound(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.cell.write_text(bench.cell.read_text() + "policy: {apply: {max_change_percent: 15}}\n")
    assert bench.apply("--configuration-changed", "--json") == ExitCode.CALIBRATION_REFUSED
    printed = capsys.readouterr().out
    refusals = json.loads(printed)["refusals"]
    assert [(one["gate"], one["subject"]) for one in refusals] == [("change", "J4")]


def test_a_policy_that_wants_more_signatures_than_it_names_is_refused(bench: Bench) -> None:
    bench.cell.write_text(bench.cell.read_text() + "policy: {apply: {signatures: 1}}\n")
    assert bench.apply() == ExitCode.CONFIGURATION


def test_a_rollback_without_a_cell_says_that_it_is_not_recorded(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    assert main(["rollback", "--to", str(bench.controller)]) == ExitCode.OK
    assert "No audit log has this rollback" in capsys.readouterr().out
    audit = tmp_path / "elsewhere.jsonl"
    assert main(["rollback", "--to", str(bench.controller), "--audit", str(audit)]) == ExitCode.OK
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
    before = bench.controller.read_bytes()
    os.mkfifo(bench.audit)
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "the cell's audit, a regular file" in capsys.readouterr().err
    assert bench.controller.read_bytes() == before
    files = bench.controller.parent.glob("*.bak")
    assert not list(files)


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
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.OK
    lines = bench.audit.read_bytes().splitlines(keepends=True)
    if spoil == "deleted":
        bench.audit.unlink()
    else:
        kept = {"an end cut off": lines[0], "one line cut": lines[0][:40], "emptied": b""}[spoil]
        bench.audit.write_bytes(kept)
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.DATA_UNFIT
    assert "noted elsewhere" in capsys.readouterr().err


def test_an_audit_that_lost_a_rollback_is_noticed(bench: Bench) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    written = bench.audit.read_bytes()
    assert bench.rollback() == ExitCode.OK
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.OK
    bench.audit.write_bytes(written)
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.DATA_UNFIT


def test_two_cells_of_one_controller_s_file_and_one_audit_know_their_own_writes(
    bench: Bench,
) -> None:
    shared = "\nhistory: {audit: shared.jsonl, store: %s.sqlite}\n"
    other = bench.cell.with_name("other.yaml")
    text = bench.cell.read_text()
    bench.cell.write_text(text + shared % "one")
    changed_text = text.replace("name: demo", "name: other")
    other.write_text(changed_text + shared % "two")
    for file, factor in ((bench.cell, 1.0), (other, 1.01)):
        declared = load_cell(file)
        made = recorded(demo_calibration(), datetime.now(UTC))
        gains = tuple(replace(gain, value=gain.value * factor) for gain in made.gains)
        calibration = replace(
            made, cell=declared.name, configuration_sha256=declared.digest, gains=gains
        )
        save_calibration(
            calibration,
            bench.calibration,
        )
        base = () if factor == 1.0 else ("--base", sha256(bench.controller.read_bytes()))
        assert (
            main(["apply", str(bench.calibration), "--cell", str(file), "--yes", *base])
            == ExitCode.OK
        )
    for file in (bench.cell, other):
        assert main(["history", str(file), "--verify"]) == ExitCode.OK
    assert main(["rollback", "--cell", str(other)]) == ExitCode.OK
    for file in (bench.cell, other):
        assert main(["history", str(file), "--verify"]) == ExitCode.OK


def test_a_dry_run_says_that_the_history_cannot_be_read(
    bench: Bench, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.cell.with_name("cell.history.sqlite").write_text("not a history, " * 100)
    assert bench.apply() == ExitCode.OK
    error_output = capsys.readouterr().err
    assert "the history cannot be read" in caplog.text + error_output


@pytest.mark.parametrize("name", ["A\udcff", "A\x1b[31m", "A\u202e"])
def test_a_name_that_cannot_be_shown_is_no_name(bench: Bench, name: str) -> None:
    before = bench.controller.read_bytes()
    assert bench.apply("--yes", "--by", name) == ExitCode.USAGE
    assert bench.controller.read_bytes() == before


def test_after_a_kill_behind_the_write_the_same_command_enters_the_history(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("daq.writeback.target.enter_calibration", killed)
        assert bench.apply("--yes") == ExitCode.INTERRUPTED
    assert b"-9.2100" in bench.controller.read_bytes()
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "has the new content, complete; the history lacks this write" in said
    assert "nothing was written" not in said
    for _ in range(2):
        assert bench.apply("--yes") == ExitCode.OK
        assert "these gains already" in capsys.readouterr().out
        history = history_of(bench.cell)
        assert history.in_force(str(bench.controller)) == history.entries[0].digest
        expected = [read(bench.audit)[1].sha256]
        assert [event.audit for event in history.events] == expected
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.OK
    assert bench.rollback() == ExitCode.OK
    assert bench.rollback() == ExitCode.OK
    history = history_of(bench.cell)
    assert history.in_force(str(bench.controller)) == history.entries[0].digest


def test_a_dry_run_of_what_is_there_already_enters_the_history_nothing(bench: Bench) -> None:
    bench.controller.write_bytes(bench.controller.read_bytes())
    assert bench.apply() == ExitCode.OK
    assert not bench.audit.exists()


def test_a_history_that_is_none_does_not_make_a_write_undone(
    bench: Bench, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.cell.with_name("cell.history.sqlite").write_text("not a history, " * 100)
    assert bench.apply("--yes") == ExitCode.OK
    error_output = capsys.readouterr().err
    assert "the history may lack this write" in caplog.text + error_output
    assert b"-9.2100" in bench.controller.read_bytes()


def _change(axis: str, current_gain: float, new: float, std: float) -> GainChange:
    return GainChange(axis, axis, 1, current_gain, new, std, "Nm/A", current_gain, "")


def significant(changes: tuple[GainChange, ...], known: Spread = NOTHING) -> set[str]:
    """Axes whose change is marked as more than noise in the table that the operator reads."""
    shown = io.StringIO()
    console = Console(file=shown, width=120)
    console.print(change_table(changes, known))
    lines = shown.getvalue().splitlines()
    return {line.split()[0] for line in lines if " * " in line}


def test_what_is_significant_is_a_matter_of_sigma_not_of_per_cent() -> None:
    large = _change("J1", 30.0, 33.0, 3.0)  # 10 %, 1 σ
    small = _change("J2", 30.0, 30.3, 0.03)  # 1 %, 10 σ
    broken = _change("J3", 30.0, float("nan"), 0.1)
    assert significant((large, small, broken)) == {"J2"}
    assert significant((broken,)) == set()
    # 2.5 % are 3.5 σ of the new gain alone, and 2.5 σ where the current gain is as uncertain.
    middle = _change("J4", 10.0, 10.25, 0.07)
    assert significant((middle,)) == {"J4"}
    known = Spread({"J4": 0.07})
    assert significant((middle,), known) == set()


def test_the_number_in_the_file_has_the_sigma_of_its_calibration(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    def fourth() -> dict[str, object]:
        capsys.readouterr()
        assert bench.apply("--json") == ExitCode.OK
        document = json.loads(capsys.readouterr().out)
        found: dict[str, object] = document["changes"][3]
        return found

    # Entered by hand: exact
    assert fourth()["change_sigmas"] == pytest.approx(-2.31 / (DISPERSION * 0.03684))
    assert bench.apply("--yes") == ExitCode.OK
    content = bench.calibration.read_bytes()
    known = decode_calibration(content, "")
    gain = known.gains[3]
    moved = replace(gain, value=gain.value * 1.015)
    gains = (*known.gains[:3], moved, *known.gains[4:])
    changed_known = replace(known, gains=gains)
    save_calibration(changed_known, bench.calibration)
    found = fourth()
    assert found["change_sigmas"] == pytest.approx(
        0.015 * 9.21 / (DISPERSION * 0.03684 * 2**0.5), rel=0.01
    )
    assert found["significant"] is False  # 3.7 σ would be, were the number exact
    assert bench.apply() == ExitCode.OK
    shown = capsys.readouterr().out
    assert "σ of both" in shown
    assert "No gain has changed by more than noise: the largest change is J4 +1.5 % (" in shown
    assert "Nothing needs to be written." in shown
    far = replace(gain, value=gain.value * 1.1)
    calibration = replace(known, gains=(*known.gains[:3], far, *known.gains[4:]))
    save_calibration(calibration, bench.calibration)
    assert bench.apply() == ExitCode.OK
    assert "Nothing needs to be written" not in capsys.readouterr().out


def _shown_base(shown: str) -> str:
    """Options that the dry run prints for the write."""
    return shown.split("--yes --base ")[1].split(maxsplit=1)[0]


@pytest.mark.slow
def test_the_base_of_a_dry_run_writes_that_change_and_no_other(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.controller.read_bytes()
    fitted = bench.calibration.read_bytes()
    assert bench.apply() == ExitCode.OK
    base = _shown_base(capsys.readouterr().out)
    assert bench.apply("--json") == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    assert document["base"] == base
    # Another calibration under the same name.
    known = decode_calibration(fitted, "")
    gain = known.gains[3].value
    moved = replace(known.gains[3], value=gain * 1.01)
    gains = (*known.gains[:3], moved, *known.gains[4:])
    calibration = replace(known, gains=gains)
    save_calibration(calibration, bench.calibration)
    assert bench.apply("--yes", "--base", base) == ExitCode.CALIBRATION_REFUSED
    error_output = capsys.readouterr().err
    assert ("the keys or the factors have changed since the dry run") in " ".join(
        error_output.split()
    )
    assert bench.apply("--base", base) == ExitCode.CALIBRATION_REFUSED
    shown = capsys.readouterr().out
    assert _shown_base(shown) != base
    bench.calibration.write_bytes(fitted)
    # Other keys in the cell: the gains of J1 and J2 exchanged.
    cell = bench.cell.read_text()
    swapped = cell.replace("[drives.J1.gain, drives.J2.gain,", "[drives.J2.gain, drives.J1.gain,")
    assert swapped != cell
    bench.cell.write_text(swapped)
    assert (
        bench.apply("--yes", "--base", base, "--configuration-changed")
        == ExitCode.CALIBRATION_REFUSED
    )
    bench.cell.write_text(cell)
    # Another file.
    bench.controller.write_bytes(before + b"# seen by K.\n")
    assert bench.apply("--yes", "--base", base) == ExitCode.CALIBRATION_REFUSED
    assert "as --base says" in " ".join(capsys.readouterr().err.split())
    bench.controller.write_bytes(before)
    files = bench.controller.parent.glob("*.bak")
    assert not list(files)
    assert bench.apply("--yes", "--base", base) == ExitCode.OK
    (backup,) = bench.controller.parent.glob("*.bak")
    assert f".{base}.bak" in backup.name
    # Asked for once more, what it wants is there already.
    assert bench.apply("--yes", "--base", base) == ExitCode.OK
    changed_base = base.replace("-", "_")
    for wrong in ("abc", base[:-1], changed_base, "x" * 64):
        assert bench.apply("--yes", "--base", wrong) == ExitCode.USAGE


def test_a_dry_run_of_a_file_that_changed_since_the_recording_reports_the_way_on(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bench.calibration.read_bytes()
    known = decode_calibration(content, "")
    digest = hashlib.sha256(bench.controller.read_bytes()).hexdigest()
    calibration = with_recordings(known, controller_sha256=digest)
    save_calibration(calibration, bench.calibration)
    bench.controller.write_bytes(bench.controller.read_bytes() + b"# seen by K.\n")
    assert bench.apply("--yes") == ExitCode.CALIBRATION_REFUSED
    assert "--base" not in capsys.readouterr().out
    assert bench.apply() == ExitCode.CALIBRATION_REFUSED
    base = _shown_base(capsys.readouterr().out)
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
    assert (
        bench.apply("--configuration-changed", "--max-std-percent", "0.01")
        == ExitCode.CALIBRATION_REFUSED
    )


@pytest.mark.parametrize("place", ["controller", "cell", "calibration", "store", "notes"])
@pytest.mark.parametrize("refused", [False, True])
def test_no_other_file_becomes_an_audit(
    bench: Bench, capsys: pytest.CaptureFixture[str], place: str, refused: bool
) -> None:
    notes = bench.cell.with_name("notes.txt")
    store = bench.cell.with_name("cell.history.sqlite")
    notes.write_text("the robot was moved\non Monday\n")
    audit = {"store": store, "notes": notes}.get(place) or getattr(bench, place)
    bench.cell.write_text(
        bench.cell.read_text() + f"history: {{store: {json.dumps(str(store))}, audit: "
        f"{json.dumps(str(audit))}}}\n"
    )
    paths = [bench.controller, bench.cell, bench.calibration, notes]
    before = [path.read_bytes() for path in paths]
    strict = ["--max-change-percent", "1"] if refused else []
    assert bench.apply("--yes", "--configuration-changed", *strict) != ExitCode.OK
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
    written = bench.controller.read_bytes()
    for audit in (bench.controller, link):
        assert (
            main(["rollback", "--to", str(bench.controller), "--audit", str(audit)]) != ExitCode.OK
        )
    assert (bench.cell.read_bytes(), bench.controller.read_bytes()) == (cell, written)


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
    names = {path.name for path in controller.parent.iterdir()}
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
    assert {path.name for path in controller.parent.iterdir()} == names
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
    error_output = capsys.readouterr().err
    assert "the history may lack this write" in caplog.text + error_output
    assert b"-9.2100" in bench.controller.read_bytes()


def _linked(bench: Bench, target: Path) -> None:
    """Move the controller's file there; the cell file's name of it becomes a symbolic link."""
    target.parent.mkdir(exist_ok=True)
    bench.controller.rename(target)
    bench.controller.symlink_to(target)


def _all_refused(bench: Bench, found: str, capsys: pytest.CaptureFixture[str]) -> None:
    if bench.controller.exists():
        before = bench.controller.read_bytes()
    else:
        before = b""
    capsys.readouterr()
    for code in (bench.apply(), bench.apply("--yes"), bench.rollback()):
        assert code == ExitCode.CALIBRATION_REFUSED
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    assert output.count(found) == 3
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.CALIBRATION_REFUSED
    assert found in " ".join(capsys.readouterr().err.split())
    assert before == (bench.controller.read_bytes() if bench.controller.exists() else b"")


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
    bench.controller.parent.rename(tmp_path / "open")
    bench.controller.parent.symlink_to(tmp_path / "open")
    assert bench.apply("--yes") == ExitCode.OK
    (tmp_path / "open").chmod(0o777)
    _all_refused(bench, "everybody may write", capsys)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
@pytest.mark.parametrize("folder", [False, True], ids=["file", "folder"])
@pytest.mark.parametrize("behind", [False, True], ids=["named", "behind one's own"])
def test_another_user_s_link_to_the_cell_file_is_refused(
    bench: Bench, tmp_path: Path, folder: bool, behind: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    link = bench.controller.parent if folder else bench.controller
    moved = tmp_path / "moved"
    alias = tmp_path / "alias"
    link.rename(moved)
    if behind:
        alias.symlink_to(moved)
        link.symlink_to(alias)
    else:
        link.symlink_to(moved)
    assert bench.apply("--yes") == ExitCode.OK
    os.lchown(alias if behind else link, 4711, 4711)
    _all_refused(bench, "user 4711 has made", capsys)
    (moved / "demo.yaml" if folder else moved).unlink()  # a rollback would bring it back, there
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
    assert {entry.subject for entry in read(bench.audit)} == {str(target), "history of demo"}
    events = history_of(bench.cell).events
    targets = {event.target for event in events}
    assert targets == {str(target)}
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.OK


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
        before = bench.controller.read_bytes()
        if closed:
            reading, writing = os.pipe()
        else:
            reading = None
            writing = os.open("/dev/full", os.O_WRONLY)
        if reading is not None:
            os.close(reading)
        command = [sys.executable, "-m", "daq", *arguments, "--cell", str(bench.cell)]
        done = subprocess.run(
            command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False
        )
        os.close(writing)
        assert bench.controller.read_bytes() != before
        assert done.returncode == ExitCode.UNEXPECTED
        assert re.search(r'^(error: +|\{"error": ")standard output\b', done.stderr, re.MULTILINE)
        assert f"only the printed output is lost: {bench.controller} was written" in done.stderr
        assert not re.search("nothing was|another folder|Traceback|Exception", done.stderr)


@pytest.mark.slow
def test_a_report_that_nobody_can_read_is_no_report_of_a_write(bench: Bench) -> None:
    before = bench.controller.read_bytes()
    arguments = ["apply", str(bench.calibration), "--yes", "--json", "--cell", str(bench.cell)]
    command = [sys.executable, "-m", "daq", *arguments]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.returncode == ExitCode.UNEXPECTED
    assert "whose other end is closed" in done.stderr
    assert "nothing was written" in done.stderr
    assert bench.controller.read_bytes() == before
    # A reader that is there, or a file, takes the report.
    report = bench.cell.with_name("report.json")
    with report.open("w") as file:
        done = subprocess.run(command, stdout=file, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == ExitCode.OK
    assert json.loads(report.read_text())
    assert bench.controller.read_bytes() != before


@pytest.mark.slow
def test_a_change_that_cannot_be_shown_is_not_written(bench: Bench) -> None:
    before = bench.controller.read_bytes()
    command = [
        sys.executable,
        "-m",
        "daq",
        "apply",
        str(bench.calibration),
        "--yes",
        "--cell",
        str(bench.cell),
    ]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == ExitCode.UNEXPECTED
    assert "no space left" in done.stderr
    assert bench.controller.read_bytes() == before


@pytest.mark.slow
def test_an_output_that_fails_says_which_were_written_before(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.apply("--yes") == ExitCode.OK
    plot = bench.cell.with_name("gains.svg")
    folder = bench.cell.with_name("none")
    assert (
        main(["history", str(bench.cell), "--plot", str(plot), "--csv", str(folder / "x.csv")])
        == ExitCode.UNEXPECTED
    )
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
        before = bench.controller.read_bytes()
        with monkeypatch.context() as patch:
            patch.setattr(place, interrupted)
            assert work() == ExitCode.INTERRUPTED
        assert bench.controller.read_bytes() != before
        shown = capsys.readouterr().err
        assert f"interrupted: {bench.controller} was written" in shown
        assert shown.count("\n") == 1
    assert bench.actions()[:3] == [
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.CALIBRATION_ENTERED,
    ]
    assert bench.actions()[3:] == [AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK]
    assert main(["history", str(bench.cell), "--verify"]) == ExitCode.OK


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_write_says_that_nothing_was_changed(
    bench: Bench,
    number: signal.Signals,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = bench.controller.read_bytes()
    monkeypatch.setattr("daq.writeback.target.propose", lambda *_: signal.raise_signal(number))
    assert bench.apply("--yes") == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == "interrupted: nothing was changed\n"
    assert bench.controller.read_bytes() == before
    assert not bench.audit.exists()


@pytest.mark.parametrize("option", ["--ram-only", "--save-unknown"])
def test_an_option_of_the_drives_is_not_ignored_without_them(
    bench: Bench, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = bench.controller.read_bytes()
    codes = {bench.apply("--yes", option), bench.rollback(option), bench.apply(option)}
    assert codes == {ExitCode.USAGE}
    error_output = capsys.readouterr().err
    assert error_output.count(f"error:    {option}\n") == 3
    assert bench.controller.read_bytes() == before


@pytest.mark.slow
def test_the_name_of_a_controller_file_neither_commands_the_terminal_nor_makes_a_line(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    file = bench.controller.with_name("ctl\x1b[31m\nerror: fake.yaml")
    shutil.copyfile(bench.controller, file)
    assert bench.apply("--to", str(file), "--yes") == ExitCode.OK
    assert bench.rollback("--to", str(file)) == ExitCode.OK
    plot = bench.cell.with_name("p\nerror: fake.svg")
    assert main(["history", str(bench.cell), "--plot", str(plot)]) == ExitCode.OK
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
    before = bench.controller.read_bytes()
    assert bench.apply("--yes") == ExitCode.UNEXPECTED
    error_output = capsys.readouterr().err
    assert f"error:    {lock}\n" in error_output
    assert bench.controller.read_bytes() == before


def test_an_audit_in_no_folder_is_named(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    audit = bench.cell.with_name("none") / "audit.jsonl"
    bench.cell.write_text(f"{bench.cell.read_text()}history: {{audit: {json.dumps(str(audit))}}}\n")
    before = bench.controller.read_bytes()
    assert bench.apply("--yes", "--configuration-changed") == ExitCode.UNEXPECTED
    error_output = capsys.readouterr().err
    assert f"error:    {audit}\n" in error_output
    assert bench.controller.read_bytes() == before


@pytest.mark.slow
def test_a_terminal_without_greek_letters_gets_them_spelled_out(bench: Bench) -> None:
    file = bench.controller.with_name("é😀.yaml")
    bench.controller.rename(file)
    command = [
        sys.executable,
        "-m",
        "daq",
        "apply",
        str(bench.calibration),
        "--cell",
        str(bench.cell),
        "--to",
    ]
    shown = []
    for more in ([], ["--json"]):
        environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
        done = subprocess.run(
            [*command, str(file), *more], capture_output=True, env=environment, check=False
        )
        assert (done.returncode, done.stderr) == (ExitCode.OK, b"")
        shown.append(done.stdout.decode("ascii"))
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
