"""A zero that is lost, a base that is moved, after the calibration:
named by one run that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.calibration import Calibration, calibration_of
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.declared import with_declared
from ident.discovery.evidence import Evidence
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import GravityDirection, ZeroOffset, rotation_by
from ident.equations.rows import decimate_rows, row_masks
from ident.estimators.estimate import RelativeError
from ident.estimators.identify import identify
from ident.geometry_drift import GeometryDrift, geometry_drift
from ident.model.model import Model
from ident.prediction import measured_torque, predict_torque
from tests.ident.closed_recordings import recorded
from tests.ident.mechanisms import FIVE_BAR
from tests.ident.recordings import MOUNTED, gathered, record, tx40_truth

FloatArray = NDArray[np.float64]

AXES = tuple(f"J{number}" for number in range(1, 7))
NOISE_A = 0.05


@cache
def _new_run() -> Run:
    rng = np.random.default_rng(77)
    return record(
        tx40_truth(),
        "new",
        rng,
        seconds=30.0,
        rate_hz=500.0,
        averaged=2,
        noise_a=NOISE_A,
    )


@cache
def _fitted_runs() -> tuple[Run, ...]:
    rng = np.random.default_rng(5)
    return tuple(
        record(
            tx40_truth(),
            f"run {number}",
            rng,
            payload,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
        )
        for number, payload in enumerate((None, MOUNTED))
    )


@cache
def _fitted() -> tuple[Evidence, Calibration]:
    evidence = gathered(tx40_truth(), _fitted_runs())
    nameplate = (1.0,) * 6
    return evidence, calibration_of(evidence.identification, AXES, nameplate)


def _drift(
    run: Run,
    model: Model,
    known: Calibration | None = None,
    suspected: Collection[PlacedEffect] = (),
) -> GeometryDrift | None:
    evidence, calibration = _fitted()
    calibration = known or calibration
    data = differentiate(run, model.drive_train, evidence.conditioning)
    use, _ = row_masks(model, data, evidence.conditioning)
    left = measured_torque(calibration, model, data.current_a) - predict_torque(
        calibration, model, data
    )
    left_nm = decimate_rows(data, evidence.conditioning, left.T)
    return geometry_drift(calibration, model, data, evidence.conditioning, left_nm, use, suspected)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [1, 2])
def test_a_lost_zero_is_named_with_its_size(axis: int) -> None:
    position = _new_run().position_rad.copy()
    position[:, axis] += np.radians(3.0)
    run = replace(_new_run(), position_rad=position)
    found = _drift(run, tx40_truth().model)
    assert found is not None
    assert (found.placed.effect.name, found.placed.axis) == ("zero-offset", axis)
    assert np.degrees(found.values[0]) == pytest.approx(-3.0, abs=0.5)


def _offset(run: Run, axis: int, degrees: float) -> Run:
    position = run.position_rad.copy()
    position[:, axis] += np.radians(degrees)
    return replace(run, position_rad=position)


def test_of_two_zeros_that_explain_the_error_the_one_that_explains_more_is_named() -> None:
    """Both explain more than what the error is larger than in a fit that left much."""
    _, calibration = _fitted()
    axes = (2.5,) * 6
    errors = RelativeError(axes, 2.5)
    run = _offset(_new_run(), 2, 3.0)
    known = replace(calibration, relative_error_percent=errors)
    found = _drift(
        run,
        tx40_truth().model,
        known,
    )
    assert found is not None
    expected = PlacedEffect(ZeroOffset(), 2)
    assert found.placed == expected


@pytest.mark.slow
def test_a_zero_that_is_suspected_needs_not_explain_most_of_the_error() -> None:
    rng = np.random.default_rng(3)
    run = _offset(_new_run(), 1, 2.0)
    slow = np.repeat(rng.standard_normal((len(run.time_s) // 50 + 1, 6)), 50, axis=0)[
        : len(run.time_s)
    ]
    current_a = run.current_a + 0.03 * slow
    disturbed = replace(run, current_a=current_a)
    model = tx40_truth().model
    assert _drift(disturbed, model) is None
    suspected = (PlacedEffect(ZeroOffset(), 1),)
    found = _drift(disturbed, model, suspected=suspected)
    assert found is not None
    assert found.placed in suspected
    assert np.degrees(found.values[0]) == pytest.approx(-2.0, abs=0.5)
    assert _drift(_new_run(), model, suspected=suspected) is None


def test_a_moved_base_is_named() -> None:
    truth = tx40_truth().model
    vector_rad = np.array([0.0, np.radians(4.0), 0.0])
    turned = rotation_by(vector_rad) @ truth.robot.gravity_m_s2
    found = _drift(_new_run(), Model(replace(truth.robot, gravity_m_s2=turned), truth.drive_train))
    assert found is not None
    assert found.placed.effect.name == "gravity-direction"
    assert np.degrees(np.linalg.norm(found.values)) == pytest.approx(4.0, abs=0.5)


@pytest.mark.slow
def test_a_base_that_moved_after_gravity_was_corrected_is_named_with_its_size() -> None:
    """What has changed is counted from the gravity of the calibration,
    not from the declared one.
    """
    truth = tx40_truth()

    def tilted(degrees: float) -> Model:
        vector_rad = np.array([0.0, np.radians(degrees), 0.0])
        gravity_m_s2 = truth.model.robot.gravity_m_s2
        turned = rotation_by(vector_rad) @ gravity_m_s2
        robot = replace(truth.model.robot, gravity_m_s2=turned)
        return Model(robot, truth.model.drive_train)

    runs = _fitted_runs()
    changed_truth = replace(truth, model=tilted(5.0))
    start = gathered(changed_truth, runs)
    declared = (PlacedEffect(GravityDirection(), 0),)
    rng = np.random.default_rng(0)
    steps = with_declared(start, declared, rng)
    nameplate = (1.0,) * 6
    calibration = calibration_of(start.identification, AXES, nameplate, steps=steps)
    assert _drift(_new_run(), tilted(5.0), calibration) is None
    # The description now says 9°, of which 5° are corrected: 4° are new.
    found = _drift(_new_run(), tilted(9.0), calibration)
    assert found is not None
    assert found.placed.effect.name == "gravity-direction"
    assert np.degrees(np.linalg.norm(found.values)) == pytest.approx(4.0, abs=0.5)


def test_nothing_is_named_where_friction_or_a_gain_has_changed() -> None:
    run = _new_run()
    truth = tx40_truth()
    assert _drift(run, truth.model) is None
    current = run.current_a.copy()
    current[:, 1] += 4.0 * np.sign(np.gradient(run.position_rad[:, 1])) / truth.gains[1]
    current[:, 2] *= 1.2
    changed_run = replace(run, current_a=current)
    assert _drift(changed_run, truth.model) is None


@pytest.mark.slow
@pytest.mark.parametrize("run", [0, 1], ids=["bare", "loaded"])
def test_a_run_of_a_closed_chain_is_judged_as_well(run: int) -> None:
    made = recorded(FIVE_BAR, noise_a=0.02)
    identified = identify(made.model, made.runs, made.conditioning)
    calibration = calibration_of(identified, AXES[:2], FIVE_BAR.gains)
    data = differentiate(made.runs[run], made.model.drive_train, made.conditioning)
    use, _ = row_masks(made.model, data, made.conditioning)
    left = measured_torque(calibration, made.model, data.current_a) - predict_torque(
        calibration, made.model, data
    )
    # An error that the fit did not leave is worth a look.
    left = left + 0.3 * np.sin(3.0 * data.position_rad)
    left_nm = decimate_rows(data, made.conditioning, left.T)
    # No change of one number of the geometry explains it.
    assert geometry_drift(calibration, made.model, data, made.conditioning, left_nm, use) is None
