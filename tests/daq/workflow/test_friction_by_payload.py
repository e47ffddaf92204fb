"""`friction_by_payload` of a cell file: friction with a payload is its own in fit,
calibration and predictions.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.same_cell import differing_sections
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.environment import shipped_configurations
from daq.workflow import fit as fit_module
from daq.workflow import validate as validate_module
from daq.workflow.fit import calibration_of, fit
from daq.workflow.validate import validate
from tests.daq.workflow.test_fit import Shelf
from tests.ident.recordings import GAINS, MOUNTED, record, tx40_truth

WARMER = 0.75  #: Friction in the loaded runs over that in the bare ones, which came first


@pytest.fixture(scope="module")
def payload_friction_cell(cell: Cell) -> Cell:
    """The demo cell, whose friction may differ between bare and loaded runs."""
    return replace(cell, friction_by_payload=True)


@pytest.fixture(scope="module")
def shelf(payload_friction_cell: Cell) -> Shelf:
    truth = tx40_truth()
    parameters = truth.parameters.copy()
    parameters[truth.model.friction_columns] *= WARMER
    warm = replace(truth, parameters=parameters)
    rng = np.random.default_rng(4)
    runs = {}
    for number, (arm, payload) in enumerate(
        [(truth, None), (truth, None), (warm, MOUNTED), (warm, MOUNTED)]
    ):
        run = record(arm, f"run{number}", rng, payload, noise_a=0.05, seconds=22.0)
        digest = f"{number:064x}"
        runs[run.name] = replace(run, digest=digest)
    return Shelf(payload_friction_cell, runs)


@pytest.mark.slow
def test_gains_are_true_and_the_calibration_predicts_with_the_friction_of_the_payload(
    shelf: Shelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    monkeypatch.setattr(validate_module, "load_run", shelf.load)
    logs = [Path("run0"), Path("run1"), Path("run2")]
    fitted = fit(logs)
    assert np.all(np.abs(fitted.estimate.gains / GAINS - 1.0) < 0.01)
    file = tmp_path / "calibration.yaml"
    created = datetime(2026, 1, 5, tzinfo=UTC)
    save_calibration(calibration_of(fitted, created), file)
    calibration = load_calibration(file)
    names = {parameter.name for parameter in calibration.parameters}
    assert {"fs1_loaded", "fv6_loaded", "fsm6_loaded"} <= names
    # Of a loaded run that no fit has seen.
    (validation,) = validate(calibration, [Path("run3")], shelf.cell)
    parameters = tuple(
        replace(one, value=0.0) if one.name.endswith("_loaded") else one
        for one in calibration.parameters
    )
    forgetful = replace(
        calibration,
        parameters=parameters,
    )
    (without,) = validate(forgetful, [Path("run3")], shelf.cell)
    assert without.error.total > 2.0 * validation.error.total


@pytest.mark.slow
def test_without_the_key_friction_that_falls_becomes_gain(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed_cell = replace(shelf.cell, friction_by_payload=False)
    without_key = replace(shelf, cell=changed_cell)
    monkeypatch.setattr(fit_module, "load_run", without_key.load)
    logs = [Path("run0"), Path("run1"), Path("run2")]
    fitted = fit(logs)
    assert np.max(np.abs(fitted.estimate.gains / GAINS - 1.0)) > 0.015


def test_a_description_that_differs_in_it_is_another_one_for_a_fit(
    payload_friction_cell: Cell,
) -> None:
    changed_cell = replace(payload_friction_cell, friction_by_payload=False)
    assert differing_sections(payload_friction_cell, changed_cell) == ("friction_by_payload",)


def test_the_key_is_read_and_is_off_where_a_cell_file_does_not_have_it(tmp_path: Path) -> None:
    shipped = shipped_configurations() / "cells" / "demo.yaml"
    assert not load_cell(shipped).friction_by_payload
    text = shipped.read_text(encoding="utf-8")
    text = text.replace(
        "urdf: ../robots/tx40.urdf", f"urdf: {shipped.parent.parent / 'robots' / 'tx40.urdf'}"
    )
    changed = tmp_path / "demo.yaml"
    changed.write_text(f"{text}friction_by_payload: true\n", encoding="utf-8")
    assert load_cell(changed).friction_by_payload
