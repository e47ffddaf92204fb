"""A wrong zero or length of a redundant drive:
named by a fit, corrected for `residual`, kept by the calibration.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache, partial
from math import radians
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.log.reader import LossyLogs
from daq.report.certificate import certificate_report, certify
from daq.report.comparison import without_controller
from daq.report.document import json_tree
from daq.report.gains import encoder_text
from daq.workflow import fit as fitting
from daq.workflow.fit import (
    Fit,
    _with_geometry_of_encoders,
    _with_uncertain_geometry,
    calibration_of,
    close_loop,
    fit,
)
from daq.workflow.geometry_diagnoses import calibrated_model, encoder_misfit_of, geometry_diagnoses
from ident.calibration import Calibration
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.evidence import gather, with_effects
from ident.discovery.geometry_covariance import evidence_with_geometry, shift_in_sigmas
from ident.discovery.loop import find_effects
from ident.effects.effect import PlacedEffect
from ident.effects.position import Spring
from ident.errors import ModelError
from ident.estimators.geometry_estimate import GeometryEstimate, GeometryFinding
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.model.closed_chain import positions, reach
from ident.model.geometry import GeometryKind, GeometryParameter, described_length
from ident.model.model import Column
from ident.model.robot import Robot
from tests.conftest import CHECKOUT
from tests.daq.calibrations import RECORDED

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
CELL = load_cell(CHECKOUT / "configs/cells/dualv.yaml")
GAINS = np.array([7.3, 6.8, -7.1, -7.5])
LOGS = (Path("bare.mcap"), Path("loaded.mcap"))
ZERO = GeometryParameter(GeometryKind.ZERO, "crank-2")
ROD = GeometryParameter(GeometryKind.LENGTH, "elbow-3", "arm-3")
RATE_HZ = 250.0
COUNT_RAD = 2.0 * np.pi / (65536 * 5)
LINK = (0.004, 0.0, 0.0, 0.005, 0.0, 0.006, 0.08, 0.01, 0.0, 0.8)
"""Inertia, first moments and mass of each link."""
AXIS = (0.03, 0.1, 0.3, 0.02)
"""Rotor inertia and friction of each axis."""


def with_corrected_geometry(start: Fit) -> Fit:
    """The fit with the zeros and lengths that the encoders show, as a search begins with it."""
    if start.is_corrected:
        return start
    return _with_uncertain_geometry(_with_geometry_of_encoders(start))


def _positions(seed: int) -> FloatArray:
    """Positions of the motors, 9 s, that the closures allow:
    the poses that fit a smooth motion best.
    """
    model = model_of(CELL)
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 9.0, 1.0 / RATE_HZ)
    frequency_hz = rng.uniform(0.2, 1.4, (4, 5))
    start_phase = rng.uniform(0.0, 2.0 * np.pi, (4, 5))
    turns = frequency_hz * time_s[:, None, None]
    waves = np.sin(2.0 * np.pi * turns + start_phase)
    wished = 0.06 * np.sum(waves, axis=2)
    axis_joints = list(model.robot.axis_joints)
    home = model.assembly.position_rad[axis_joints]
    axes_rad = home + wished
    found = reach(model.robot, model.assembly, axes_rad).position_rad
    axes = found[:, axis_joints]
    closed = positions(model.robot, model.assembly, axes)
    assert np.allclose(closed, found, atol=1e-8)
    return axes


@cache
def _runs() -> tuple[Run, Run]:
    """A run without load and one with the cell's payload, internal preload in both."""
    model = model_of(CELL)
    rng = np.random.default_rng(0)
    standard = np.zeros(len(model.columns))
    for columns in model.link_columns:
        standard[columns] = LINK
    for joint in model.robot.axis_joints:
        first = 14 * joint + 10
        standard[first : first + 4] = AXIS
    body = CELL.payloads[0].payload
    made: list[Run] = []
    for name, seed, payload in (("bare", 3, None), ("loaded", 4, body)):
        exact = _positions(seed)
        time_s = np.arange(len(exact)) / RATE_HZ
        no_current = np.zeros_like(exact)
        blank = Run(name, time_s, exact, no_current, payload)
        data = differentiate(blank, model.drive_train, CELL.conditioning)
        mounted = standard.copy()
        if payload is not None:
            mass_kg = payload.known["m"]
            mounted[model.flange] += 0.05, 0.0, 0.0, 0.05, 0.0, 0.09, 0.9, 0.3, 0.0, mass_kg
        motion = data.motion()
        torque = np.einsum("mck,c->km", model.regressor(motion), mounted)
        to_motors = model.follow(motion).to_motors
        hidden = np.linalg.qr(to_motors, mode="complete").Q[:, :, 3]
        hidden_sign = np.sign(hidden[:, :1])
        preload_nm = 1.0 + 2.0 * np.sin(1.3 * data.time_s)
        preload = preload_nm[:, None] * hidden * hidden_sign
        current_a = 0.004 * rng.standard_normal(exact.shape)
        current_a[1:-1] += (torque + preload) / GAINS
        counts = np.round(exact / COUNT_RAD)
        position_rad = COUNT_RAD * counts
        run = replace(blank, position_rad=position_rad, current_a=current_a)
        made.append(run)
    bare, loaded = made
    return bare, loaded


def _read(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let logs be those runs, as another description of the cell converts them."""
    zero_offset_rad = [axis.zero_offset_rad for axis in cell.axes]
    offset = np.array(zero_offset_rad)
    runs = dict(zip(LOGS, _runs(), strict=True))

    def load_run(
        path: Path, given: Cell | None = None, lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        del given, lossy
        run = runs[Path(path)]
        position_rad = run.position_rad + offset
        return replace(run, position_rad=position_rad), cell

    monkeypatch.setattr(fitting, "load_run", load_run)


def _with_zero(degrees: float) -> Cell:
    names = [axis.name for axis in CELL.axes]
    number = names.index("crank-2")
    axes = list(CELL.axes)
    axes[number] = replace(axes[number], zero_offset_rad=radians(degrees))
    return replace(CELL, axes=tuple(axes))


def _with_rod(percent: float) -> Cell:
    before, name, after = CELL.urdf.partition('<joint name="tip-3"')
    length_m = 0.28 * (1.0 + percent / 100.0)
    longer = f'xyz="{length_m!r} 0 0"'
    changed_after = after.replace('xyz="0.28 0 0"', longer, 1)
    urdf = before + name + changed_after
    return replace(CELL, urdf=urdf)


def _errors(fitted: Fit) -> FloatArray:
    """Errors of the gains in their σ."""
    gain_difference = fitted.estimate.gains - GAINS
    return np.asarray(gain_difference / fitted.estimate.gains_std)


def _saved_and_loaded(calibration: Calibration, folder: Path) -> Calibration:
    path = folder / "calibration.yaml"
    save_calibration(calibration, path)
    return load_calibration(path)


def _angle_between(first: FloatArray, second: FloatArray) -> float:
    """Angle of the turn from one rotation matrix to another."""
    turn = first.T @ second
    cosine = 0.5 * (np.trace(turn) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.fixture(scope="module")
def clean() -> Fit:
    with pytest.MonkeyPatch.context() as patch:
        _read(CELL, patch)
        return fit(LOGS)


def test_a_right_description_is_fitted_as_it_is(clean: Fit) -> None:
    assert clean.geometry is not None
    assert not clean.geometry.is_significant
    assert clean.diagnoses == ()
    assert with_corrected_geometry(clean) is clean
    misfit = calibration_of(clean, RECORDED).encoder_misfit
    assert misfit is not None
    assert misfit.applied is False
    assert misfit.significant is False
    assert misfit.corrections == ()
    assert misfit.unit == "rad"
    errors = np.abs(_errors(clean))
    assert np.all(errors < 3.0)


@pytest.mark.parametrize(
    ("cell", "parameter", "change", "name", "remedy"),
    [
        (
            _with_zero(0.5),
            ZERO,
            -np.radians(0.5),
            "zero-off",
            r"add -0\.500\d* to `zero_offset_deg` of crank-2 in the cell file, which makes it "
            r"-?0\.000\d*",
        ),
        (_with_rod(0.3), ROD, -0.00084, "length-off", "279.99.|280.00. mm in place of 280.840 mm"),
    ],
    ids=["zero", "rod"],
)
def test_a_wrong_number_is_named_and_corrected(
    cell: Cell,
    parameter: GeometryParameter,
    change: float,
    name: str,
    remedy: str,
    clean: Fit,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    _read(cell, monkeypatch)
    fitted = fit(LOGS)
    first = fitted.diagnoses[0]
    axes = ("crank-2",) if parameter is ZERO else ()
    assert first.name == name
    assert first.axes == axes
    assert "explains alone" in first.found
    assert re.search(remedy, first.remedy)
    assert "described geometry" in first.remedy
    assert fitted.geometry is not None
    (correction,) = fitted.geometry.corrections
    assert correction.parameter == parameter
    change_difference = abs(correction.change - change)
    assert change_difference < 4.0 * correction.std
    corrected = with_corrected_geometry(fitted)
    assert with_corrected_geometry(corrected) is corrected
    errors_corrected = np.abs(_errors(corrected))
    assert np.all(errors_corrected < 3.0)
    if parameter is ZERO:
        errors = np.abs(_errors(fitted))
        assert np.max(errors) > 3.0
    gains_std = corrected.estimate.gains_std
    limit = 1.5 * clean.estimate.gains_std
    assert np.all(gains_std < limit)
    assert corrected.geometry_covariance is not None
    variances = np.diag(corrected.geometry_covariance)
    of_gains = variances[: len(GAINS)]
    added = np.sqrt(of_gains)
    assert np.all(added > 0.0)
    assert np.all(added < gains_std)
    (diagnosis,) = geometry_diagnoses(corrected.geometry, cell, applied=True)
    assert "corrected geometry" in diagnosis.remedy
    # The calibration keeps the correction, and predicts with it, whatever the description says now.
    changed_corrected = replace(corrected, diagnoses=(diagnosis,))
    calibration = calibration_of(changed_corrected, RECORDED)
    read = _saved_and_loaded(calibration, tmp_path)
    assert read.encoder_misfit == calibration.encoder_misfit
    joints = model_of(CELL).robot.joints
    for described in (cell, CELL):
        robot = calibrated_model(read, described).robot
        second_joint = robot.axis_joints[1]
        turned = robot.joints[second_joint].rotation
        right = joints[second_joint].rotation
        offset_rad = described.axes[1].zero_offset_rad
        angle_rad = _angle_between(right, turned)
        assert angle_rad == pytest.approx(offset_rad, abs=2e-5)
        rod_m = described_length(robot, ROD)
        assert rod_m == pytest.approx(0.28, abs=2e-6)
    if parameter is ZERO:
        assert calibration.encoder_misfit is not None
        first_correction = calibration.encoder_misfit.corrections[0]
        correction_of_another = replace(first_correction, joint="motor-2")
        misfit = replace(calibration.encoder_misfit, corrections=(correction_of_another,))
        changed_read = replace(read, encoder_misfit=misfit)
        with pytest.raises(ModelError, match="'motor-2' was corrected, and no axis"):
            calibrated_model(changed_read, cell)
    comparison = without_controller(read, "not read", RECORDED)
    certificate = certify(read, comparison)
    document = json_tree(certificate_report(certificate))
    corrections = document["encoder_misfit"]["corrections"]
    assert corrections[0]["kind"] == parameter.kind.value
    assert "the gains are those of the corrected geometry" in document["identity"]["Encoders"]


def test_the_uncertainty_of_the_geometry_reaches_the_gains_beside_effects(clean: Fit) -> None:
    fitted = replace(clean.final, gathered=None)
    with pytest.MonkeyPatch.context() as patch:
        _read(CELL, patch)
        evidence = gather(fitted, _runs())
    effects = (PlacedEffect(Spring(), 1),)
    joined = with_effects(evidence, effects)
    assert joined.identification.estimate is joined.estimate
    count = len(evidence.estimate.covariance)
    gains = len(GAINS)
    # In another order, and with a parameter that the estimate with effects lacks, as after another
    # turn of gravity.
    reversed_unknowns = reversed(evidence.estimate.unknowns)
    unknowns = (Column("of another gravity", "kg m"), *reversed_unknowns)
    added_variances = np.arange(1.0, count + 2.0)
    extra = np.diag(added_variances)
    changed = evidence_with_geometry(joined, extra, unknowns)
    covariance_difference = changed.estimate.covariance - joined.estimate.covariance
    difference = np.diag(covariance_difference)
    of_gains = list(difference[:gains])
    assert of_gains == pytest.approx([1.0, 2.0, 3.0, 4.0])
    unknown_names = [column.name for column in unknowns]
    added = dict(zip(unknown_names, added_variances[gains:], strict=True))
    names = [column.name for column in joined.estimate.unknowns]
    of_names = [added.get(name, 0.0) for name in names]
    of_parameters = list(difference[gains:])
    assert of_parameters == pytest.approx(of_names)
    found_names = [name for name in names if name in added]
    assert len(found_names) == count - gains
    assert changed.identification.estimate is changed.estimate


def test_the_uncertainty_of_the_geometry_is_in_sigma_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a search that adds nothing, σ is that of the fit with the corrected geometry."""
    _read(_with_zero(0.5), monkeypatch)
    find_none = partial(find_effects, families=(), geometry=())
    monkeypatch.setattr(fitting, "find_effects", find_none)
    fitted = fit(LOGS, keep_rows=True)
    closed = close_loop(fitted, 0)
    last_step = closed.steps[-1]
    assert last_step.after.effects == ()
    assert closed.geometry_covariance is not None
    bare = closed.evidence().training.system()
    covariance = estimate_with(Method.ML, bare).covariance
    expected = covariance + closed.geometry_covariance
    found = closed.identification.estimate.covariance
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-15)
    std = np.sqrt(np.diag(expected))
    expected_std = std[: len(GAINS)]
    gains_std = closed.estimate.gains_std
    assert gains_std == pytest.approx(expected_std, rel=1e-6)
    again = close_loop(closed, 0)
    assert again.estimate.gains_std == pytest.approx(gains_std, rel=1e-6)


def test_the_alternative_that_moves_gains_by_most_of_their_sigma_counts(clean: Fit) -> None:
    """A gain of small σ that moves by three of them counts for more than one of large σ that moves
    by one.
    """
    std = clean.estimate.gains_std
    count = len(clean.estimate.covariance)
    least_known = int(np.argmax(std))
    best_known = int(np.argmin(std))
    few = np.zeros(count)
    few[least_known] = 1.0 * std[least_known]
    many = np.zeros(count)
    many[best_known] = 3.0 * std[best_known]
    shift = shift_in_sigmas(few, clean.estimate)
    assert shift == pytest.approx(1.0)
    shift = shift_in_sigmas(many, clean.estimate)
    assert shift == pytest.approx(3.0)


def _finding(
    *causes: GeometryEstimate, alternatives: tuple[tuple[GeometryEstimate, ...], ...] = ()
) -> GeometryFinding:
    variances = [one.std**2 for one in causes]
    covariance = np.diag(variances)
    return GeometryFinding(4e-4, 6e-6, 5e-6, True, causes, covariance, alternatives, ())


def test_what_encoders_cannot_tell_apart_is_said() -> None:
    zero = GeometryEstimate(ZERO, 1e-3, 1e-5)
    rod = GeometryEstimate(ROD, -3e-4, 1e-6)
    finding = _finding(zero, alternatives=((rod,),))
    (one,) = geometry_diagnoses(finding, CELL, applied=False)
    assert one.name == "zero-off"
    assert (
        "not distinguishable from a length from elbow-3 to arm-3 that is 0.3000 ± 0.0010 mm shorter"
    ) in one.found

    together = _finding(zero, rod)
    (both,) = geometry_diagnoses(together, CELL, applied=False)
    assert both.name == "geometry-off"
    assert both.axes == ("crank-2",)
    assert "explain together" in both.found

    misfit = encoder_misfit_of(finding, CELL, applied=True)
    assert misfit is not None
    assert misfit.alternatives == (
        "a length from elbow-3 to arm-3 that is 0.3000 ± 0.0010 mm shorter than described",
    )

    diagnoses = geometry_diagnoses(None, CELL, applied=False)
    assert list(diagnoses) == []


def test_a_misfit_that_nothing_explains_is_called_so() -> None:
    (none,) = geometry_diagnoses(_finding(), CELL, applied=False)
    assert none.name == "geometry-off"
    assert (
        "miss the loops by 0.4 mrad, which no zero, length, place on the base or late "
        "encoder explains"
    ) in none.found
    assert none.expected == "0.005 mrad, the noise of the encoders"
    assert "arms that bend, play in joints" in none.remedy
    misfit = encoder_misfit_of(_finding(), CELL, applied=False)
    assert misfit is not None
    text = encoder_text(misfit)
    assert (
        "miss the loops by 0.4 mrad, where their noise is 0.005 mrad, which no zero, length"
    ) in text
    assert "all zeros and lengths together leave 0.006 mrad" in text


def test_a_late_encoder_is_named_and_not_corrected(tmp_path: Path, clean: Fit) -> None:
    parameter = GeometryParameter(GeometryKind.DELAY, "crank-2")
    late = GeometryEstimate(parameter, 0.003, 1e-6)
    finding = _finding(late)
    (one,) = geometry_diagnoses(finding, CELL, applied=False)
    assert one.name == "position-late"
    assert one.axes == ("crank-2",)
    assert "an encoder of crank-2 that is late by 3.0000 ± 0.0010 ms explains alone" in one.found
    assert "look for what delays the encoder of crank-2" in one.remedy
    assert "residual" not in one.remedy
    fitted = replace(clean, geometry=finding)
    assert with_corrected_geometry(fitted) is fitted

    calibration = calibration_of(fitted, RECORDED)
    misfit = _saved_and_loaded(calibration, tmp_path).encoder_misfit
    assert misfit == calibration.encoder_misfit
    assert misfit is not None
    assert misfit.corrections == ()
    assert misfit.noise == 5e-6
    text = encoder_text(misfit)
    assert "explained by an encoder of crank-2 that is late by 3.0000 ± 0.0010 ms" in text


def test_a_late_encoder_that_may_be_a_wrong_zero_corrects_none() -> None:
    zero = GeometryEstimate(ZERO, 1e-3, 1e-5)
    parameter = GeometryParameter(GeometryKind.DELAY, "crank-2")
    late = GeometryEstimate(parameter, 0.003, 1e-6)
    finding = _finding(zero, alternatives=((late,),))
    assert finding.corrections == ()
    misfit = encoder_misfit_of(finding, CELL, applied=False)
    assert misfit is not None
    text = encoder_text(misfit)
    assert "explained by the zero of crank-2" in text
    assert "; or by an encoder of crank-2" in text


def _y_of_crank_3(robot: Robot) -> float:
    (joint,) = [joint for joint in robot.joints if joint.name == "crank-3"]
    return float(joint.translation_m[1])


def test_a_place_on_the_base_is_named_and_corrected(clean: Fit, tmp_path: Path) -> None:
    parameter = GeometryParameter(GeometryKind.PLACE, "crank-3", "y")
    place = GeometryEstimate(parameter, -3e-4, 1e-7)
    finding = _finding(place)
    (one,) = geometry_diagnoses(finding, CELL, applied=False)
    assert one.name == "place-off"
    assert one.axes == ()
    off = "the place of crank-3 on the base off by -0.3000 ± 0.0001 mm in y (to be added to it)"
    assert f"{off} explains alone" in one.found
    robot = model_of(CELL).robot
    described_m = _y_of_crank_3(robot)
    described_mm = 1e3 * described_m
    corrected_mm = described_mm - 0.3
    assert f"{corrected_mm:.3f} mm in place of {described_mm:.3f} mm" in one.remedy

    geometry_covariance = np.zeros((1, 1))
    fitted = replace(clean, geometry=finding, geometry_covariance=geometry_covariance)
    calibration = calibration_of(fitted, RECORDED)
    read = _saved_and_loaded(calibration, tmp_path)
    moved_m = _y_of_crank_3(calibrated_model(read, CELL).robot)
    corrected_m = described_m - 3e-4
    assert moved_m == pytest.approx(corrected_m)
    assert read.encoder_misfit is not None
    assert off in encoder_text(read.encoder_misfit)
