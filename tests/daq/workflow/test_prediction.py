"""The live prediction is that of a whole run under the filters of the fit, row by row."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell, model_of
from daq.errors import LogsDiffer
from daq.workflow.live_prediction import (
    LEAST_S,
    RECENT_S,
    PredictedRows,
    Predictor,
    Recent,
    predictor_of,
)
from daq.workflow.validate import conditioning_of, unpredictable
from ident.calibration import AcceptedEffect, Calibration, Parameter, Source
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.rows import row_filter, row_masks
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.prediction import predict_current
from tests.daq.console.feeds import facts, predicting_calibration

RATE_HZ = 500.0
SAMPLES = 3000
CYCLES = np.arange(SAMPLES)


def _motion(cell: Cell) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions [rad] that come to rest half-way, and currents [A], shape (k, n)."""
    time_s = np.arange(SAMPLES) / RATE_HZ
    frequency = 0.5 + 0.1 * np.arange(len(cell.axes))
    position = np.where(
        time_s[:, None] < 4.0, np.sin(2.0 * np.pi * frequency * time_s[:, None]), 0.0
    )
    position[time_s >= 4.0] = position[time_s < 4.0][-1]
    rng = np.random.default_rng(1)
    return 0.5 * position, rng.normal(0.0, 1.0, position.shape)


def _with_late_position(calibration: Calibration) -> Calibration:
    late = Parameter("late-position time 3", 0.012, 0.001, "s")
    effect = AcceptedEffect("late-position", "J3", {}, (late,), 6.0, 3.0)
    parameters = (*calibration.parameters, late)
    return replace(calibration, effects=(effect,), parameters=parameters)


@pytest.mark.parametrize(("block", "is_late"), [(1, False), (10, False), (997, False), (10, True)])
def test_rows_are_those_of_the_whole_run(cell: Cell, block: int, *, is_late: bool) -> None:
    calibration = predicting_calibration()
    model = model_of(cell)
    if is_late:
        calibration = _with_late_position(calibration)
    position, current = _motion(cell)
    predictor = Predictor(calibration, cell, None, RATE_HZ)
    blocks = [slice(at, at + block) for at in range(0, SAMPLES, block)]
    found = []
    for one in blocks:
        found.extend(predictor.take(CYCLES[one], position[one], current[one]))
    cycle = np.concatenate([part.cycle for part in found])
    predicted = np.concatenate([part.predicted for part in found])
    residual = np.concatenate([part.residual for part in found])
    # Each row once, without a gap, until the windows of the last samples are not whole.
    cycle_steps = set(np.diff(cycle))
    assert cycle_steps == {10}
    assert cycle[0] < 0.3 * RATE_HZ and cycle[-1] > SAMPLES - (
        0.6 * RATE_HZ if block < 100 else 1000
    )
    conditioning = conditioning_of(calibration)
    time_s = np.arange(SAMPLES) / RATE_HZ
    run = Run("whole", time_s, position, current, None, None)
    data = differentiate(run, model.drive_train, conditioning)
    filter_ = row_filter(data, conditioning)
    expected = filter_(predict_current(calibration, model, data).T)
    left = expected[:, :1] * 0.0 + filter_(data.current_a.T) - expected
    at_row = (cycle - 1 - filter_.half) / filter_.factor
    moving = np.isfinite(predicted).all(axis=1) & (cycle < 1900)
    assert np.count_nonzero(moving) > 50
    # The grid of the rows is another: the whole run's are interpolated between.
    axis = np.arange(expected.shape[1])
    for motor in range(len(cell.axes)):
        interpolated_at_row = np.interp(at_row, axis, expected[motor])
        assert predicted[moving, motor] == pytest.approx(interpolated_at_row[moving], abs=0.05)
    on_grid = moving & (at_row == np.floor(at_row))
    for motor in range(len(cell.axes)):
        rows = at_row[on_grid].astype(int)
        assert predicted[on_grid, motor] == pytest.approx(expected[motor, rows], abs=2e-4)
        assert residual[on_grid, motor] == pytest.approx(left[motor, rows], abs=2e-4)
    # Standstill is that of the fit, row by row.
    _, use = row_masks(model, data, conditioning)
    rows = at_row[at_row == np.floor(at_row)].astype(int)
    assert not use[:, rows].all() and use[:, rows].any()
    assert (np.isfinite(predicted)[at_row == np.floor(at_row)] == use[:, rows].T).all()


def test_nothing_is_predicted_at_standstill_and_a_gap_begins_anew(cell: Cell) -> None:
    predictor = Predictor(predicting_calibration(), cell, None, RATE_HZ)
    position, current = _motion(cell)
    (still,) = predictor.take(CYCLES[:500], position[2100:2600], current[2100:2600])
    assert np.isnan(still.predicted).all() and np.isnan(still.residual).all()
    # The gap is within the block.
    cycle = np.concatenate((CYCLES[500:600], CYCLES[:500] + 10_000))
    stacked_position = np.concatenate((position[2600:2700], position[:500]))
    stacked_current = np.concatenate((current[2600:2700], current[:500]))
    (after,) = predictor.take(
        cycle,
        stacked_position,
        stacked_current,
    )
    assert after.cycle[0] > 10_000
    assert np.isfinite(after.predicted).any()
    assert (after.band > 0.0).all()


def _rows(residual: float, seconds: float, motors: int = 2) -> PredictedRows:
    """Rows of one residual in the first motor, with a band of 1; the others rest."""
    count = round(50.0 * seconds)
    column = np.full((count, motors), np.nan)
    column[:, 0] = residual
    cycle = np.arange(count)
    predicted = 0.0 * column
    band = np.ones(motors)
    return PredictedRows(cycle, predicted, column, band)


def test_an_axis_is_judged_by_the_last_ten_seconds_in_which_it_moved() -> None:
    recent = Recent(50.0)
    assert recent.axes() == []
    recent.add(_rows(3.0, 0.9 * LEAST_S))
    assert not recent.axes()[0].conspicuous  # too short
    recent.add(_rows(3.0, 8.0 - 0.9 * LEAST_S))
    for _ in range(10):
        recent.add(_rows(np.nan, RECENT_S))  # a rest heals nothing
    found, other = recent.axes()
    expected = (None, None, 1.0, True)
    assert (found.measured, found.predicted, found.outside_share, found.conspicuous) == expected
    assert found.residual_rms == pytest.approx(3.0)
    assert (other.residual_rms, other.outside_share, other.conspicuous) == (None, 0.0, False)
    recent.add(_rows(0.5, 6.0))  # 4 s of 8 s are left in the ten seconds of motion
    outside_share = recent.axes()[0].outside_share
    assert outside_share == pytest.approx(0.4)
    assert not recent.axes()[0].conspicuous
    recent.add(_rows(0.5, 4.0))
    assert recent.axes()[0].outside_share == 0.0


def test_another_mass_than_that_of_the_calibration_is_refused(cell: Cell) -> None:
    parameter = Parameter("m:disc", 4.59, 0.0, "kg")
    known = parameter, Parameter("mx:disc", 0.1, 0.01, "kg m")
    calibration = predicting_calibration()
    parameters = (*calibration.parameters, *known)
    calibration = replace(calibration, parameters=parameters)
    weighed = replace(cell.payloads[0], name="disc", mounting="disc", mass_kg=4.59)
    run = replace(facts(cell, None), payload="disc")
    for mass_kg, remark in (
        (4.59, ""),
        (5.0, "carries 5 kg on mounting 'disc'; the calibration has 4.59 kg"),
    ):
        payloads = (replace(weighed, mass_kg=mass_kg),)
        changed_cell = replace(cell, payloads=payloads)
        _, found = predictor_of(calibration, changed_cell, run)
        assert remark in found and bool(found) == bool(remark)


def test_another_payload_on_the_mounting_of_the_calibration_is_not_predicted(cell: Cell) -> None:
    """A payload of the same mass, and one of which all is known: both are other bodies."""
    of_disc = Parameter("mx:flange", 0.1, 0.01, "kg m")
    sha256 = "a" * 64
    source = Source("loaded", sha256, "fit", payload="disc", mass_kg=4.59, mounting="flange")
    calibration = predicting_calibration()
    parameters = (*calibration.parameters, of_disc)
    calibration = replace(calibration, parameters=parameters, sources=(source,))
    weighed = replace(cell.payloads[0], name="box", mounting="flange", mass_kg=4.59)
    run = replace(facts(cell, None), payload="box")
    changed_cell = replace(cell, payloads=(weighed,))
    found, remark = predictor_of(calibration, changed_cell, run)
    assert found is None
    assert "found payload 'box' on mounting 'flange'; expected payload 'disc'" in remark
    known = {"m": 4.59, "mx": 0.2}
    for name in LINK_PARAMETERS:
        known.setdefault(name, 1.0 if name in {"Ixx", "Iyy", "Izz"} else 0.0)
    for payload in (Payload("box", "flange", {"m": 4.59}), Payload("box", "flange", known)):
        assert (
            unpredictable(calibration, payload)
            == "payload 'box' is not predicted: on mounting 'flange' the calibration knows 'disc'"
        )
    assert unpredictable(calibration, Payload("disc", "flange", {"m": 4.59})) == ""
    assert unpredictable(calibration, Payload("box", "elbow", known)) == ""


def test_what_the_calibration_does_not_know_is_not_predicted(cell: Cell) -> None:
    unknown = Predictor(
        predicting_calibration(), cell, Payload("body", "flange", {"m": 1.0}), RATE_HZ
    )
    assert "nothing is known of mounting" in unknown.problem
    position, current = _motion(cell)
    assert unknown.take(CYCLES, position, current) == []
    calibration = replace(predicting_calibration(), cell="other")
    changed_cell = replace(cell, folder=Path())
    with pytest.raises(LogsDiffer):
        Predictor(
            calibration,
            changed_cell,
            None,
            RATE_HZ,
        )
