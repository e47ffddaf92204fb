"""The command that is named as the next step fits what is in the folder."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.cli.fit import ResidualRequest, _say_after_search
from daq.cli.next_step import (
    FolderRuns,
    free_name,
    runs_in,
    say_after_calibration,
    say_after_fit,
    say_after_plan,
    say_after_record,
)
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration
from daq.workflow import plan as plan_module
from daq.workflow.plan import Plan, load_plan, save_plan
from ident.calibration import AcceptedEffect
from ident.errors import Diagnosis
from ident.estimators.estimate import RelativeError
from tests.daq.calibrations import calibration_for, demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.logs import DISC, demo_content, samples, write
from tests.pipeline.next_step import next_step

LogMaker = Callable[..., Path]
CELL = Path("configs/cells/demo.yaml")
STILL = [[0] * 6] * 20


@pytest.fixture
def cell(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    """The demo cell, with its files in the working folder."""
    shutil.copytree(checkout / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    return load_cell(CELL)


@pytest.fixture
def make_log(cell: Cell, checkout: Path) -> LogMaker:
    """Make logs of the demo cell, each a second younger than the one before."""
    ages = count(1_000_000_000)

    def make(name: str, *, loaded: bool = False, verdict: tuple[bool, str] = (True, "")) -> Path:
        start = demo_content(checkout, DISC if loaded else None)
        path = write(Path(name), start, samples(STILL), verdict=verdict)
        age_s = next(ages)
        os.utime(path, (age_s, age_s))
        return path

    return make


@pytest.fixture(scope="module")
def made(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """A plan of the demo cell from seed 1."""
    cell_file = checkout / "configs/cells/demo.yaml"
    out = tmp_path_factory.mktemp("plan") / "plan.yaml"
    quick = ["--duration", "15", "--exchanges", "0", "--sigma", "9"]
    assert run_verb("plan", cell_file, "--out", out, *quick) == 0
    return load_plan(out, load_cell(cell_file))


def written(name: str, plan: Plan, std_percent: float, seed: int) -> Plan:
    """A plan file with other predictions; the plan that it holds."""
    predicted_std_percent = (std_percent,) * 6
    changed = replace(plan, predicted_std_percent=predicted_std_percent, seed=seed)
    save_plan(changed, Path(name))
    return changed


def words(said: str) -> list[str]:
    """The words of the next step, which can be typed."""
    assert next_step(said) is not None
    (line,) = said.splitlines()
    return shlex.split(line.removeprefix("Next: "))


def test_runs_of_a_folder_are_the_valid_ones_of_this_cell(cell: Cell, make_log: LogMaker) -> None:
    log = make_log("b.mcap", loaded=True)
    loaded = [log, make_log("a.mcap", loaded=True)]
    bare = make_log("bare.mcap")
    make_log("lossy.mcap", verdict=(False, "3 cycles lost"))
    Path("other.mcap").write_bytes(b"no log")
    runs = runs_in(Path(), "demo")
    expected = FolderRuns((bare,), tuple(loaded))
    assert runs == expected
    assert runs_in(Path(), "saw") == FolderRuns()


@pytest.mark.slow
def test_logs_that_take_long_to_read_are_not_read_for_a_hint(
    cell: Cell,
    made: Plan,
    make_log: LogMaker,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("daq.cli.next_step.LARGEST_FOLDER_BYTES", 10)
    written("plan.yaml", made, 0.6, seed=1)
    bare = make_log("bare.mcap")
    assert runs_in(Path(), "demo") is None
    say_after_record(CELL, cell, Path("plan.yaml"), bare, loaded=False)
    assert "--payload" in words(capsys.readouterr().err)  # the run with the payload is never wrong
    log = make_log("loaded.mcap", loaded=True)
    say_after_record(CELL, cell, Path("plan.yaml"), log, loaded=True)
    assert capsys.readouterr().err == ""  # of the others nothing is known


def test_a_free_name_is_counted_on(tmp_path: Path) -> None:
    for name in ("log.mcap", "log-2.mcap", "log-3.mcap"):
        assert free_name(tmp_path / "log.mcap") == tmp_path / name
        (tmp_path / name).touch()


def test_each_plan_is_followed_by_the_run_that_is_missing(
    cell: Cell, made: Plan, make_log: LogMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    """plan, plan, record, record, record: the order of the tutorial, and that of the README."""
    first = written("plan.yaml", made, 0.6, seed=1)
    say_after_plan(CELL, cell, Path("plan.yaml"), first)
    bare = ["record", str(CELL), "plan.yaml", "--out", "unloaded.mcap", "--enable-motion"]
    error_output = capsys.readouterr().err
    assert words(error_output)[1:] == bare
    second = written("plan-2.yaml", made, 0.6, seed=2)
    say_after_plan(CELL, cell, Path("plan-2.yaml"), second)
    assert words(capsys.readouterr().err)[1:] == bare

    say_after_record(CELL, cell, Path("plan.yaml"), make_log("bare.mcap"), loaded=False)
    weighed = ["--payload", "disc", "--mass", "KG", "--enable-motion"]
    loaded = ["record", str(CELL), "plan.yaml", "--out", "loaded.mcap", *weighed]
    assert words(capsys.readouterr().err)[1:] == loaded
    say_after_plan(CELL, cell, Path("plan-2.yaml"), second)
    assert words(capsys.readouterr().err)[1:] == loaded

    log = make_log("loaded.mcap", loaded=True)
    say_after_record(CELL, cell, Path("plan.yaml"), log, loaded=True)
    assert words(capsys.readouterr().err)[1:] == [
        "fit",
        "bare.mcap",
        "loaded.mcap",
        "--out",
        "calibration.yaml",
    ]
    say_after_plan(CELL, cell, Path("plan-2.yaml"), second)
    held_out = ["record", str(CELL), "plan-2.yaml", "--out", "held-out.mcap", *weighed]
    assert words(capsys.readouterr().err)[1:] == held_out

    Path("calibration.yaml").touch()
    say_after_record(
        CELL, cell, Path("plan-2.yaml"), make_log("held-out.mcap", loaded=True), loaded=True
    )
    search = words(capsys.readouterr().err)
    expected = ["residual", "bare.mcap", "loaded.mcap", "--holdout"]
    assert search[1:5] == expected
    assert search[5:] == ["held-out.mcap", "--out", "calibration-2.yaml", "--report", "report"]
    say_after_record(
        CELL, cell, Path("plan-2.yaml"), make_log("more.mcap", loaded=True), loaded=True
    )
    assert capsys.readouterr().err == ""  # it is not plain which of them is held out


def test_a_plan_beside_a_weak_one_is_recorded_itself(
    cell: Cell, made: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    written("weak.yaml", made, 1.2, seed=1)
    Path("notes.yaml").write_text("mine: 1\n")
    better = written("better.yaml", made, 0.6, seed=3)
    say_after_plan(CELL, cell, Path("better.yaml"), better)
    assert "better.yaml" in words(capsys.readouterr().err)
    longer = written("longer.yaml", made, 0.5, seed=3)  # of the same seed: the same moves, and more
    say_after_plan(CELL, cell, Path("longer.yaml"), longer)
    assert "longer.yaml" in words(capsys.readouterr().err)


def test_a_run_with_load_that_was_first_is_followed_by_one_without(
    cell: Cell, made: Plan, make_log: LogMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    written("plan.yaml", made, 0.6, seed=1)
    log = make_log("first.mcap", loaded=True)
    say_after_record(CELL, cell, Path("plan.yaml"), log, loaded=True)
    assert "--payload" not in words(capsys.readouterr().err)


def test_the_search_does_not_replace_the_file_of_the_fit(
    cell: Cell, make_log: LogMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log("bare.mcap")
    fitted = replace(demo_calibration(), diagnoses=())
    for written_by_fit, expected in (
        (Path("calibration.yaml"), "calibration-2.yaml"),
        (None, "calibration-2.yaml"),
    ):
        Path("calibration.yaml").touch()
        say_after_fit(fitted, [log], written_by_fit)
        search = words(capsys.readouterr().err)
        assert search[search.index("--out") + 1] == expected


def test_a_calibration_is_followed_by_its_dry_run(
    cell: Cell, make_log: LogMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log("bare.mcap")
    file = calibration_for(CELL)
    say_after_calibration(load_calibration(file), file, [log], None)
    error_output = capsys.readouterr().err
    expected = ["drivegain", "apply", str(CELL), str(file)]
    assert words(error_output) == expected
    gains = tuple(replace(gain, std=0.0) for gain in demo_calibration().gains)
    fixed = replace(demo_calibration(), gains=gains)
    assert fixed.gains_fixed
    say_after_calibration(fixed, Path("calibration.yaml"), [log], CELL)
    assert capsys.readouterr().err == ""


def test_other_moves_come_before_a_search_and_a_write_where_a_gain_is_not_seen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unseen = Diagnosis(
        "gain-unseen", (), ("J1",), "a gain of -63 ± 63", "a gain", "record faster moves"
    )
    found = replace(demo_calibration(), diagnoses=(unseen,))
    say_after_fit(found, [], None)
    say_after_calibration(found, Path("calibration.yaml"), [], CELL)
    said = capsys.readouterr().err
    assert said.count("Next: record the moves that CHECK asks for") == 2
    assert "drivegain" not in said


ZERO_OFF = Diagnosis(
    "zero-off",
    (),
    ("J2",),
    "the zero of J2 off by +2.00 ± 0.10 °",
    "that of the URDF",
    "correct it",
)
OTHER_BODY = Diagnosis("payload-differs", ("loaded",), (), "a body", "another", "was it turned?")
LARGE = RelativeError((40.0,) * 6, 40.0)
CORRECTED = AcceptedEffect("zero-offset", "J2", {}, (), 6.0, 3.0)
REFUTED = AcceptedEffect("stribeck", "J2", {}, (), 3.0, 6.0)


@pytest.mark.parametrize(
    ("changed", "printed", "expected"),
    [
        (
            {"diagnoses": (ZERO_OFF,), "effects": (CORRECTED,)},
            None,
            "Next: correct the description as CHECK says",
        ),
        ({"diagnoses": (OTHER_BODY,)}, None, "Next: find the cause of what CHECK says"),
        ({}, (OTHER_BODY,), "Next: find the cause of what CHECK says"),
        (
            {"effects": (REFUTED,)},
            None,
            "`drivegain apply` refuses this calibration: effect stribeck on J2",
        ),
        ({"diagnoses": (ZERO_OFF,), "effects": (CORRECTED,)}, (), "Next: drivegain apply"),
        (
            {"recording_configuration_sha256": "c" * 64},
            None,
            "refuses this calibration: calibration: recorded with cell",
        ),
        (
            {"relative_error_percent": LARGE, "holdout_error_percent": LARGE},
            None,
            "a relative error of 40.0 %",
        ),
    ],
    ids=[
        "a description that the fit corrects",
        "another body",
        "of another log",
        "a gate",
        "corrected since",
        "another description",
        "its error",
    ],
)
def test_nothing_is_written_before_what_is_wrong_is_corrected(
    cell: Cell,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any],
    printed: tuple[Diagnosis, ...] | None,
    expected: str,
) -> None:
    file = calibration_for(CELL, **changed)
    say_after_calibration(load_calibration(file), file, [], CELL, printed)
    said = capsys.readouterr().err
    assert expected in said
    assert ("Next: drivegain apply" in said) == (expected == "Next: drivegain apply")


def test_a_calibration_that_the_cell_of_the_logs_refuses_is_not_applied_next(
    cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    """The certificate of the same search says that it must not be written."""
    path = calibration_for(CELL, relative_error_percent=LARGE, holdout_error_percent=LARGE)
    doubtful = load_calibration(path)
    shutil.rmtree("configs")
    assert say_after_calibration(doubtful, Path("calibration.yaml"), [], None, described=cell)
    assert "`drivegain apply` refuses this calibration" in capsys.readouterr().err


@pytest.mark.parametrize("diagnoses", [(ZERO_OFF,), ()], ids=["zero off", "right"])
def test_a_search_that_wrote_nothing_names_itself_only_where_nothing_is_to_be_corrected(
    cell: Cell, capsys: pytest.CaptureFixture[str], diagnoses: tuple[Diagnosis, ...]
) -> None:
    calibration = replace(load_calibration(calibration_for(CELL)), diagnoses=diagnoses)
    logs = [Path("bare.mcap")]
    request = ResidualRequest(logs=logs, cell=CELL)
    _say_after_search(request, calibration, cell)
    said = capsys.readouterr().err
    assert ("Next: correct the description" in said) == bool(diagnoses)
    assert ("Next: drivegain residual bare.mcap" in said) == (not diagnoses)


@pytest.mark.parametrize(
    ("options", "says", "next_verb"),
    [
        ((), "Edit saw/cells/saw.yaml first", "scan"),
        (("--simulated",), "The cell is that of the demonstration", "calibrate"),
    ],
)
def test_a_new_cell_file_is_edited_first_unless_it_is_of_the_simulated_cell(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    says: str,
    next_verb: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code = run_verb("init", "saw", *options)
    assert code == 0
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith(says)
    assert next_step(last) == next_verb


@pytest.mark.slow
def test_a_replaced_file_is_named_and_an_unrelated_one_is_not(
    cell: Cell, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = [
        "plan",
        str(CELL),
        "--out",
        "plan.yaml",
        "--duration",
        "15",
        "--exchanges",
        "0",
        "--sigma",
        "9",
    ]
    assert main(plan) == 0
    assert "Replaced" not in capsys.readouterr().err
    os.utime("plan.yaml", (1_700_000_000, 1_700_000_000))
    assert main([*plan, "--preview", "plan.html"]) == 0
    assert "Replaced: plan.yaml (of 2023-11-14 22:13 UTC)" in capsys.readouterr().err.splitlines()
    assert main([*plan, "--preview", "plan.html", "--json"]) == 0
    said = capsys.readouterr().err
    assert "Replaced: plan.yaml (of" in said
    assert "Replaced: plan.html (of" in said
    assert plan_module.read_plan(Path("plan.yaml")).seed == 1
