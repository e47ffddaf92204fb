"""A mistake of a recording reaches `fit`, `validate` and the calibration by name."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell_file import load_cell
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.environment import shipped_configurations
from daq.report.validation import validate_report, validation_view
from daq.workflow import fit as fit_module
from daq.workflow import validate as validate_module
from daq.workflow.fit import calibration_of, fit
from daq.workflow.validate import cross_validate
from ident.calibration import Calibration
from ident.data.run import Run
from ident.errors import ChannelsExchanged
from ident.estimators.method import Method
from tests.daq.workflow.test_fit import Shelf
from tests.ident.recordings import MOUNTED, record, tx40_truth

pytestmark = pytest.mark.slow

WHEN = datetime(2025, 1, 2, tzinfo=UTC)
FIT = [Path("run0"), Path("run1")]
CROSSED = [0, 2, 1, 3, 4, 5]


@pytest.fixture
def shelf(recorded: Shelf, monkeypatch: pytest.MonkeyPatch) -> Shelf:
    for module in (fit_module, validate_module):
        monkeypatch.setattr(module, "load_run", recorded.load)
    return recorded


@pytest.fixture(scope="module")
def recorded() -> Shelf:
    """One run without load, three with; of these one has its currents exchanged,
    one carries nothing.
    """
    truth = tx40_truth()
    rng = np.random.default_rng(5)

    def made(name: str, *, mounted: bool = False) -> Run:
        run = record(
            truth, name, rng, MOUNTED if mounted else None, noise_a=0.1, seconds=12.0, rate_hz=200.0
        )
        digest = name.encode().hex().ljust(64, "0")
        return replace(run, digest=digest)

    loaded = made("crossed", mounted=True)
    runs = [
        made("run0"),
        made("run1", mounted=True),
        replace(loaded, current_a=loaded.current_a[:, CROSSED]),
        replace(made("forgotten"), payload=MOUNTED),
        replace(loaded, name="thousandfold", current_a=1000.0 * loaded.current_a),
        replace(loaded, name="good"),
    ]
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    return Shelf(cell, {run.name: run for run in runs})


@pytest.fixture(scope="module")
def calibration(recorded: Shelf) -> Calibration:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", recorded.load)
        return calibration_of(fit(FIT), WHEN)


def test_nothing_is_said_of_good_recordings(shelf: Shelf, calibration: Calibration) -> None:
    assert calibration.diagnoses == ()
    logs = [*FIT, Path("good")]
    diagnoses = cross_validate({"one": calibration}, logs).diagnoses
    assert diagnoses == ()


@pytest.mark.parametrize(
    ("log", "name", "axes"),
    [
        ("crossed", "channels-exchanged", ("J2", "J3")),
        ("forgotten", "payload-differs", ()),
        ("thousandfold", "current-off-scale", ("J1",)),
    ],
)
def test_validate_names_the_log(
    shelf: Shelf, calibration: Calibration, log: str, name: str, axes: tuple[str, ...]
) -> None:
    logs = [Path(log)]
    found = cross_validate({"one": calibration}, logs)
    assert {one.name for one in found.diagnoses} == {name}
    runs = found.diagnoses[0].runs
    assert (runs, found.diagnoses[0].axes) == ((log,), axes)
    diagnoses = validate_report(calibration, found, {}).diagnoses
    assert diagnoses[0].name == name


def test_a_diagnosis_that_is_made_again_is_shown_once(
    shelf: Shelf, calibration: Calibration
) -> None:
    logs = [Path("thousandfold")]
    fresh = cross_validate({"one": calibration}, logs).diagnoses
    other = replace(fresh[0], runs=("another",))
    diagnoses = (*fresh, other)
    stored = replace(calibration, diagnoses=diagnoses)
    found = cross_validate({"one": stored}, [Path("thousandfold")])
    assert found.diagnoses == (*fresh, other)
    checks = [str(one) for one in validation_view(stored, found) if "CHECK " in str(one)]
    expected = len(fresh) + 1
    assert len(checks) == expected
    assert all(check.startswith("CHECK thousandfold, ") for check in checks[:-1])
    assert checks[-1].startswith("The fit of this calibration found: CHECK another, ")


def test_exchanged_currents_in_the_fit_are_an_error(shelf: Shelf) -> None:
    crossed = {
        name: replace(run, current_a=run.current_a[:, CROSSED]) for name, run in shelf.runs.items()
    }
    shelf.runs.update(crossed)
    try:
        for fixed in (False, True):
            with pytest.raises(ChannelsExchanged, match="the currents of J2 and J3: "):
                fit(FIT, gains_fixed=fixed)
    finally:
        shelf.runs.update(
            {n: replace(run, current_a=run.current_a[:, CROSSED]) for n, run in crossed.items()}
        )


def test_the_operator_may_say_that_no_currents_are_exchanged(shelf: Shelf) -> None:
    logs = [*FIT, Path("crossed")]
    with pytest.raises(ChannelsExchanged, match="--channels-as-wired"):
        fit(logs)
    diagnoses = fit(logs, channels_as_wired=True).diagnoses
    assert {one.name for one in diagnoses} >= {"axis-error"}


@pytest.mark.parametrize("fixed", [False, True])
def test_exchanged_currents_in_one_log_of_the_fit_name_it(shelf: Shelf, fixed: bool) -> None:
    logs = [*FIT, Path("crossed")]
    with pytest.raises(ChannelsExchanged, match="log crossed: the currents of J2 and J3"):
        fit(logs, gains_fixed=fixed)


def test_exchanged_currents_in_a_held_out_run_are_named(shelf: Shelf) -> None:
    holdout = [Path("crossed")]
    first = fit(FIT, holdout=holdout).diagnoses[0]
    expected = ("channels-exchanged", ("crossed",), ("J2", "J3"))
    assert (first.name, first.runs, first.axes) == expected


def test_a_calibration_keeps_what_was_said_of_its_fit(shelf: Shelf) -> None:
    fitted = fit(FIT, method=Method.WLS)
    made = calibration_of(fitted, WHEN)
    assert {one.name for one in made.diagnoses} == {"estimators-disagree"}
    assert (
        decode_calibration(encode_calibration(made), "calibration.yaml").diagnoses == made.diagnoses
    )
