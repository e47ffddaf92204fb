"""The paper's cases, and the tables of their validation:
on recordings whose truth the tests know.
"""

from __future__ import annotations

import io
import json
import re
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.cli import main
from daq.config.cell import Cell, WeighedPayload
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.environment import shipped_configurations
from daq.errors import LogsDiffer
from daq.log.reader import LossyLogs
from daq.report.paper_tables import (
    condition_table,
    mass_tables,
    paper_error_table,
    paper_gain_table,
    parameter_table,
)
from daq.workflow import fit as fit_module
from daq.workflow import validate as validate_module
from daq.workflow.cases import (
    CASES,
    ReducedLogs,
    calibration_of_case,
    essential_fit,
    fit_case,
    reduce_logs,
)
from daq.workflow.choices import Known
from daq.workflow.fit import fit
from daq.workflow.validate import CrossValidation, Mass, cross_validate
from ident.calibration import Calibration
from ident.data.run import Run
from ident.errors import DataUnfit
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, Payload
from tests.ident.recordings import GAINS, MOUNTED, PAYLOAD_TRUTH, record, tx40_truth

pytestmark = pytest.mark.slow

CREATED = datetime(2025, 1, 2, tzinfo=UTC)
CASE_NAMES = [case.name for case in CASES]
PLATE = Payload("plate", "b")
"""The same body as the disc, of which the log says nothing:
a fit that finds its mass finds 4.59 kg.
"""


@dataclass(frozen=True)
class Shelf:
    """Runs by the name of a log, in the place of files."""

    cell: Cell
    runs: dict[str, Run]

    def load(
        self, path: Path, cell: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return self.runs[path.name], cell or self.cell


@pytest.fixture(scope="module")
def shelf() -> Shelf:
    """Two runs without load, two with the disc, one of each unseen,
    and two with an unweighed plate.
    """
    truth = tx40_truth()
    rng = np.random.default_rng(5)
    drawn = dict(PAYLOAD_TRUTH)
    del drawn["m"]
    disc = WeighedPayload("disc", "a", 4.59, 0.005, drawn)
    plate = WeighedPayload("plate", "z", 4.5, 0.005, {})
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = replace(load_cell(path), payloads=(disc, plate))
    mounted = {
        "bare1": None,
        "disc1": MOUNTED,
        "bare2": None,
        "disc2": MOUNTED,
        "bare3": None,
        "disc3": MOUNTED,
        "plate1": PLATE,
        "plate2": PLATE,
    }
    runs = {}
    for index, name in enumerate(mounted):
        payload = mounted[name]
        run = record(truth, name, rng, payload, noise_a=0.1)
        digest = f"{index:064x}"
        runs[name] = replace(run, digest=digest)
    return Shelf(cell, runs)


@pytest.fixture(autouse=True)
def _shelved(shelf: Shelf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    monkeypatch.setattr(validate_module, "load_run", shelf.load)


@pytest.fixture(scope="module")
def reduced(shelf: Shelf) -> ReducedLogs:
    """Read once for all cases."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", shelf.load)
        logs = _paths("bare1", "disc1", "bare2", "disc2")
        return reduce_logs(logs, _paths("disc3"))


@pytest.fixture(scope="module")
def written(shelf: Shelf, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of all cases as the command writes it, and what it prints."""
    folder = tmp_path_factory.mktemp("written") / "cases"
    logs = ["bare1", "disc1", "bare2", "disc2", "--holdout", "disc3"]
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(fit_module, "load_run", shelf.load)
        options = ["--cases", str(folder), "--essential", "20", "--json"]
        code = main(["fit", *logs, *options])
    assert code == 0
    document = json.loads(printed.getvalue())
    return folder, document


@pytest.fixture(scope="module")
def calibrations(written: tuple[Path, dict[str, Any]]) -> dict[str, Calibration]:
    """One a case."""
    folder, _ = written
    loaded = {}
    for name in CASE_NAMES:
        path = folder / f"{name}.yaml"
        loaded[name] = load_calibration(path)
    return loaded


def _paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


def _error(calibration: Calibration) -> float:
    gains = np.array([gain.value for gain in calibration.gains])
    relative_error = np.abs(gains / GAINS - 1.0)
    return float(relative_error.max())


def _table_names(page: str) -> list[str]:
    """The tables of a page, by its headings."""
    headings = [line for line in page.splitlines() if line.startswith("## ")]
    return [heading[3:10] for heading in headings]


def _serve(monkeypatch: pytest.MonkeyPatch, run: Run, cell: Cell) -> None:
    """Give this run to a validation in the place of every log."""
    monkeypatch.setattr(validate_module, "load_run", lambda *_: (run, cell))


def test_every_case_is_what_it_says(calibrations: dict[str, Calibration]) -> None:
    nameplate = [gain.nameplate for gain in calibrations["ml"].gains]
    manufacturer = [gain.value for gain in calibrations["manufacturer"].gains]
    assert manufacturer == nameplate

    identified_counts = {
        "manufacturer": 10,
        "case-1": 0,
        "case-2": 9,
        "case-3": 0,
        "case-4": 9,
        "ml": 9,
    }
    payload_names = {f"{parameter}:a" for parameter in LINK_PARAMETERS}
    for name, count in identified_counts.items():
        parameters = calibrations[name].parameters
        of_payload = [parameter for parameter in parameters if ":" in parameter.name]
        identified = [parameter for parameter in of_payload if parameter.std > 0.0]
        assert len(identified) == count
        names = {parameter.name for parameter in of_payload}
        assert names == payload_names

    assert calibrations["case-1"].method == "wls"
    assert calibrations["case-2"].method == "wls"
    assert calibrations["case-3"].method == "tls"
    assert calibrations["case-4"].method == "tls"


def test_a_right_drawing_helps_wls_and_ml_needs_none(calibrations: dict[str, Calibration]) -> None:
    errors = {name: _error(calibrations[name]) for name in CASE_NAMES}
    assert errors["case-1"] < errors["case-2"]
    assert errors["case-4"] < errors["case-2"]
    assert errors["ml"] < errors["case-2"]
    assert errors["ml"] < 0.01


def test_a_wrong_drawing_spoils_what_relies_on_it(reduced: ReducedLogs) -> None:
    disc, plate = reduced.cell.payloads
    wrong_values = {name: 1.1 * value for name, value in disc.known.items()}
    wrong = replace(disc, known=wrong_values)
    cell = replace(reduced.cell, payloads=(wrong, plate))
    spoilt = replace(reduced, cell=cell)

    def error(logs: ReducedLogs, known: Known) -> float:
        fitted = fit_case(logs, Method.ML, known)
        calibration = calibration_of_case(fitted, CREATED)
        return _error(calibration)

    assert error(reduced, Known.CAD) < 0.01
    assert error(spoilt, Known.CAD) > 0.02
    assert error(spoilt, Known.MASS) < 0.01


def test_one_reading_gives_what_fit_gives(reduced: ReducedLogs) -> None:
    other = fit(reduced.logs, holdout=reduced.holdout)
    found = fit_case(reduced, Method.ML, Known.MASS).fitted
    same_gains = pytest.approx(other.estimate.gains, rel=1e-9)
    assert found.estimate.gains == same_gains
    assert found.sources == other.sources
    one = found.identification.holdout_error
    two = other.identification.holdout_error
    assert one is not None
    assert two is not None
    assert one.axes == pytest.approx(two.axes)


def test_essential_parameters_leave_no_trace_in_the_file(
    reduced: ReducedLogs, tmp_path: Path
) -> None:
    fitted = fit_case(reduced, Method.WLS, Known.MASS).fitted
    found = essential_fit(fitted, 20.0)
    calibration = calibration_of_case(found, CREATED)
    assert found.essential is not None
    removed = {step.name for step in found.essential.removed}
    assert len(removed) > 5
    names = {parameter.name for parameter in calibration.parameters}
    assert not removed & names

    path = tmp_path / "c.yaml"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration
    error = calibration.holdout_error_percent
    assert error is not None
    runs = cross_validate({"c": calibration}, _paths("disc3")).runs
    found_again = runs[0].errors["c"]
    same_errors = pytest.approx(error.axes, rel=1e-6)
    assert found_again.axes == same_errors


def test_a_run_held_out_must_carry_what_the_fit_has_met() -> None:
    logs = _paths("bare1", "disc1")
    with pytest.raises(DataUnfit, match="'b', which no run of the fit carries"):
        reduce_logs(logs, _paths("plate1"))


@pytest.fixture(scope="module")
def found(shelf: Shelf, calibrations: dict[str, Calibration]) -> CrossValidation:
    """All cases on runs of all three kinds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validate_module, "load_run", shelf.load)
        logs = _paths("disc2", "bare3", "disc3", "plate1", "plate2")
        return cross_validate(calibrations, logs)


def test_cross_validation_distinguishes_good_gains_from_bad(found: CrossValidation) -> None:
    """Tables 7 and 8: mass errors follow the gains' errors;
    the mean of Table 6 is least for the best.
    """
    errors: dict[str, list[float]] = {label: [] for label in found.calibrations}
    mass_of_payload_kg = {"disc": 4.59, "plate": 4.5}  # the cell's word
    for run in found.weighed:
        payload = run.payload.name
        mass_kg = mass_of_payload_kg[payload]
        for label, mass in run.masses.items():
            assert isinstance(mass, Mass)
            assert mass.error_percent is not None
            error_kg = abs(mass.mass_kg - mass_kg)
            error_percent = 100.0 * error_kg / mass_kg
            assert mass.error_percent == pytest.approx(error_percent)
            if payload == "disc":
                errors[label].append(mass.error_percent)
            assert 0.0 < mass.std_percent <= mass.std_with_gains_percent < 10.0
    means = {label: np.mean(errors[label]) for label in errors}
    assert means["ml"] < 1.0
    assert means["ml"] < means["case-2"]
    assert means["ml"] < means["manufacturer"]
    errors_of_runs = [run.errors for run in found.runs if run.errors]
    by_ml = [of_run["ml"].total for of_run in errors_of_runs]
    by_manufacturer = [of_run["manufacturer"].total for of_run in errors_of_runs]
    assert np.mean(by_ml) < np.mean(by_manufacturer)


def test_what_was_seen_and_what_cannot_be_predicted_is_said(found: CrossValidation) -> None:
    runs = {run.run: run for run in found.runs}
    seen_by = runs["disc2"].seen_by
    assert seen_by == tuple(found.calibrations)
    assert runs["disc3"].seen_by == ()
    assert runs["plate1"].errors == {}
    assert "leaves its mass open" in runs["plate1"].left_out
    for run in found.runs:
        assert run.condition is not None
        assert 10.0 < run.condition < 1e5
    validated = [validation.run for validation in found.validations]
    assert validated == ["disc2", "bare3", "disc3"]


def test_without_bare_runs_the_calibrations_robot_serves(
    calibrations: dict[str, Calibration],
) -> None:
    logs = _paths("disc3", "plate1")
    two = {name: calibrations[name] for name in ("ml", "case-2")}
    found = cross_validate(two, logs)
    assert not found.with_bare_runs
    for run in found.weighed:
        # No robot was identified with the nameplate gains
        assert list(run.masses) == ["ml", "case-2"]
        mass = run.masses["ml"]
        assert isinstance(mass, Mass)
        assert mass.mass_kg == pytest.approx(4.59, rel=0.01)
    (table, other) = mass_tables(found)
    assert "the robot is that of the calibration" in table.notes[0]
    assert other.number == 8
    assert other.title == "mass of payload plate (b), 4.5 kg"


def test_an_unknown_mounting_is_weighed_and_not_predicted(
    shelf: Shelf, calibrations: dict[str, Calibration]
) -> None:
    payload = replace(MOUNTED, mounting="c")
    elsewhere = replace(shelf.runs["disc3"], payload=payload)
    ml = {"ml": calibrations["ml"]}
    with pytest.MonkeyPatch.context() as patch:
        _serve(patch, elsewhere, shelf.cell)
        found = cross_validate(ml, _paths("x"))
    assert "nothing is known of mounting 'c'" in found.runs[0].left_out
    masses = found.weighed[0].masses
    assert isinstance(masses["ml"], Mass)


def test_another_weight_in_the_same_mounting_is_refused(
    shelf: Shelf, calibrations: dict[str, Calibration]
) -> None:
    payload = replace(MOUNTED, known={"m": 2.0})
    other = replace(shelf.runs["disc3"], payload=payload)
    case_4 = {"case-4": calibrations["case-4"]}
    with pytest.MonkeyPatch.context() as patch:
        _serve(patch, other, shelf.cell)
        with pytest.raises(DataUnfit, match=r"carries 2 kg .* has 4\.59 kg"):
            cross_validate(case_4, _paths("x"))


def test_a_run_too_short_to_weigh_says_why(
    shelf: Shelf, calibrations: dict[str, Calibration]
) -> None:
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    short = record(truth, "short", rng, MOUNTED, seconds=4.0, noise_a=0.1)
    ml = {"ml": calibrations["ml"]}
    with pytest.MonkeyPatch.context() as patch:
        _serve(patch, short, shelf.cell)
        found = cross_validate(ml, _paths("short"))
    failure = found.weighed[0].masses["ml"]
    assert isinstance(failure, str)
    assert "record longer" in failure
    table = mass_tables(found)[0]
    assert "record longer" in table.markdown()


def test_filters_must_be_the_same(calibrations: dict[str, Calibration]) -> None:
    ml = calibrations["ml"]
    other = replace(ml, filter={**ml.filter, "decimation_cutoff_hz": 5.0})
    with pytest.raises(LogsDiffer, match="calibration other"):
        cross_validate({"ml": ml, "other": other}, _paths("bare3"))


def test_the_tables_have_the_papers_form(
    calibrations: dict[str, Calibration], found: CrossValidation
) -> None:
    case_3 = calibrations["case-3"]
    case_4 = calibrations["case-4"]
    one = parameter_table(3, case_3, case_4, "IDIM-TLS")
    rows = {row[0]: row for row in one.rows}
    assert rows["m:a"] == ("m:a", "4.59", "—", "4.59", "—", "0.00")
    assert rows["mx:a"][2] == "—"  # given in case 3
    assert rows["mx:a"][4] != "—"  # found in case 4
    assert rows["‖ρ‖/‖Y‖"][1].endswith(" %")

    gains = paper_gain_table(4, case_3, case_4, "IDIM-TLS")
    first, second, *_ = gains.rows
    assert first[:2] == ("J1", "32.96")
    assert second[:2] == ("J2", "32.96")
    changes_percent = [abs(gain.change_percent) for gain in case_4.gains]
    mean_percent = np.mean(changes_percent)
    last_row = gains.rows[-1]
    printed_percent = float(last_row[-1])
    assert printed_percent == pytest.approx(mean_percent, abs=0.006)

    conditions = condition_table(found)
    assert len(conditions.headings) == 1 + 5

    errors = paper_error_table(found)
    assert len(errors.rows) == 3 * 6 + 1
    of_ml = [run.errors["ml"].axes for run in found.runs if run.errors]
    mean_percent = np.mean(of_ml)
    column = errors.headings.index("ml")
    last_row = errors.rows[-1]
    printed_percent = float(last_row[column])
    assert printed_percent == pytest.approx(mean_percent, abs=0.006)

    masses = mass_tables(found)
    numbers = [table.number for table in masses]
    assert numbers == [7, 8]

    for table in (one, gains, conditions, errors, *masses):
        for row in table.rows:
            assert len(row) == len(table.headings)
        line_count = table.markdown().count("\n| ")
        assert line_count == len(table.rows) + 2


def test_the_command_line_writes_cases_and_tables(
    written: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, printed = written
    logs = ["bare1", "disc1", "bare2", "disc2"]
    cases = printed["cases"]
    assert set(cases) == set(CASE_NAMES)
    assert cases["case-2"]["removed"]
    file_names = {path.name for path in folder.iterdir()}
    calibration_names = {f"{name}.yaml" for name in CASE_NAMES}
    assert file_names == calibration_names | {"tables.md"}
    page = (folder / "tables.md").read_text(encoding="utf-8")
    assert _table_names(page) == ["Table 1", "Table 2", "Table 3", "Table 4"]

    out = tmp_path / "validation"
    ml = str(folder / "ml.yaml")
    runs = ["bare3", "disc3", "plate1"]
    options = ["--beside", str(folder), "--out", str(out), "--json"]
    code = main(["validate", ml, *runs, *options])
    assert code == 0
    checked = json.loads(capsys.readouterr().out)
    own, *others = checked["calibrations"]
    assert own == "ml"
    assert others == ["case-1", "case-2", "case-3", "case-4", "manufacturer"]
    first_log = checked["logs"][0]
    assert first_log["log"] == "bare3"
    relative_error_percent = checked["runs"][2]["relative_error_percent"]
    assert relative_error_percent == {}
    masses = checked["payloads"][0]["masses"]
    assert masses["ml"]["error_percent"] < 1.0
    page = (out / "tables.md").read_text(encoding="utf-8")
    assert _table_names(page) == ["Table 5", "Table 6", "Table 7", "Table 8"]

    assert main(["validate", ml, "disc3", "plate1"]) == 0
    text = capsys.readouterr().out
    assert "\nMass of payload disc (a), 4.59 kg\n" in text
    assert not re.search(r"Table \d|§|manufacturer", text)
    assert "leaves its mass open" in text

    case_3 = ("--known", "cad", "--method", "tls", "--essential", "20")
    code = main(["fit", *logs, *case_3, "--json"])
    assert code == 0
    document = json.loads(capsys.readouterr().out)
    gains = [gain["value"] for gain in document["gains"]]
    written_case = load_calibration(folder / "case-3.yaml")
    written_gains = [gain.value for gain in written_case.gains]
    assert gains == pytest.approx(written_gains, rel=1e-6)


def test_what_does_not_go_together_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["fit", "bare1", "disc1", "--cases", str(tmp_path)]
    assert main([*command, "--method", "wls"]) == 2
    assert "--cases" in capsys.readouterr().err

    (tmp_path / "tables.md").write_text("my own notes", encoding="utf-8")
    assert main(command) == 2
    assert "tables.md" in capsys.readouterr().err

    empty = tmp_path / "empty"
    empty.mkdir()
    missing = str(tmp_path / "none.yaml")
    code = main(["validate", missing, "bare1", "--beside", str(empty)])
    assert code == 4
    assert "empty" in capsys.readouterr().err
