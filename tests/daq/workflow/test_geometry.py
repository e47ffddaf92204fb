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
    time_s = np.arange(0.0, 9.0, 1.0 / RATE_HZ)[:, None, None]
    frequency_hz = rng.uniform(0.2, 1.4, (4, 5))
    phase = rng.uniform(0.0, 2.0 * np.pi, (4, 5))
    phase_sine = np.sin(2.0 * np.pi * frequency_hz * time_s + phase)
    wished = 0.06 * np.sum(phase_sine, axis=2)
    axis_joints = list(model.robot.axis_joints)
    home = model.assembly.position_rad[axis_joints]
    axes_rad = home + wished
    found = reach(model.robot, model.assembly, axes_rad).position_rad
    axes = found[:, list(model.robot.axis_joints)]
    assert np.allclose(positions(model.robot, model.assembly, axes), found, atol=1e-8)
    return axes


@cache
def _runs() -> tuple[Run, Run]:
    """A run without load and one with the cell's payload, internal preload in both."""
    model = model_of(CELL)
    rng = np.random.default_rng(0)
    standard = np.zeros(len(model.columns))
    for columns in model.link_columns:
        standard[columns] = 0.004, 0.0, 0.0, 0.005, 0.0, 0.006, 0.08, 0.01, 0.0, 0.8
    for joint in model.robot.axis_joints:
        standard[14 * joint + 10 : 14 * joint + 14] = 0.03, 0.1, 0.3, 0.02
    body = CELL.payloads[0].payload
    made: list[Run] = []
    for seed, payload in ((3, None), (4, body)):
        exact = _positions(seed)
        time_s = np.arange(len(exact)) / RATE_HZ
        current_a = np.zeros_like(exact)
        blank = Run(
            LOGS[len(made)].stem,
            time_s,
            exact,
            current_a,
            payload,
        )
        data = differentiate(blank, model.drive_train, CELL.conditioning)
        mounted = standard.copy()
        if payload is not None:
            mass_kg = payload.known["m"]
            mounted[model.flange] += 0.05, 0.0, 0.0, 0.05, 0.0, 0.09, 0.9, 0.3, 0.0, mass_kg
        torque = np.einsum("mck,c->km", model.regressor(data.motion()), mounted)
        to_motors = model.follow(data.motion()).to_motors
        hidden = np.linalg.qr(to_motors, mode="complete").Q[:, :, 3]
        hidden_sign = np.sign(hidden[:, :1])
        hidden = hidden * hidden_sign
        torque = torque + (1.0 + 2.0 * np.sin(1.3 * data.time_s))[:, None] * hidden
        current = 0.004 * rng.standard_normal(exact.shape)
        current[1:-1] += torque / GAINS
        counted = COUNT_RAD * np.round(exact / COUNT_RAD)
        changed_blank = replace(blank, position_rad=counted, current_a=current)
        made.append(changed_blank)
    return made[0], made[1]


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
    axes = [
        replace(one, zero_offset_rad=radians(degrees)) if one.name == "crank-2" else one
        for one in CELL.axes
    ]
    return replace(CELL, axes=tuple(axes))


def _with_rod(percent: float) -> Cell:
    before, name, after = CELL.urdf.partition('<joint name="tip-3"')
    longer = f'xyz="{0.28 * (1.0 + percent / 100.0)!r} 0 0"'
    changed_after = after.replace('xyz="0.28 0 0"', longer, 1)
    urdf = before + name + changed_after
    return replace(CELL, urdf=urdf)


def _errors(fitted: Fit) -> FloatArray:
    """Errors of the gains in their σ."""
    gain_difference = fitted.estimate.gains - GAINS
    return np.asarray(gain_difference / fitted.estimate.gains_std)


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
    kept = calibration_of(clean, RECORDED).encoder_misfit
    assert kept is not None
    expected = (False, False, (), "rad")
    assert (kept.applied, kept.significant, kept.corrections, kept.unit) == expected
    assert np.all(np.abs(_errors(clean)) < 3.0)


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
    assert first.name == name
    assert first.axes == (("crank-2",) if parameter is ZERO else ())
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
    assert np.all(np.abs(_errors(corrected)) < 3.0)
    if parameter is ZERO:
        assert np.max(np.abs(_errors(fitted))) > 3.0
    assert np.all(corrected.estimate.gains_std < 1.5 * clean.estimate.gains_std)
    assert corrected.geometry_covariance is not None
    geometry_covariance_diagonal = np.diag(corrected.geometry_covariance)
    added = np.sqrt(geometry_covariance_diagonal)[: len(GAINS)]
    assert np.all((added > 0.0) & (added < corrected.estimate.gains_std))
    (diagnosis,) = geometry_diagnoses(corrected.geometry, cell, applied=True)
    assert "corrected geometry" in diagnosis.remedy
    # The calibration keeps the correction, and predicts with it, whatever the description says now.
    changed_corrected = replace(corrected, diagnoses=(diagnosis,))
    calibration = calibration_of(changed_corrected, RECORDED)
    save_calibration(calibration, tmp_path / "calibration.yaml")
    read = load_calibration(tmp_path / "calibration.yaml")
    assert read.encoder_misfit == calibration.encoder_misfit
    for described in (cell, CELL):
        robot = calibrated_model(read, described).robot
        turned = robot.joints[robot.axis_joints[1]].rotation
        joints = model_of(CELL).robot.joints
        expected = joints[robot.axis_joints[1]].rotation
        offset = described.axes[1].zero_offset_rad
        assert np.arccos(
            np.clip(0.5 * (np.trace(expected.T @ turned) - 1.0), -1.0, 1.0)
        ) == pytest.approx(offset, abs=2e-5)
        assert described_length(robot, ROD) == pytest.approx(0.28, abs=2e-6)
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
    extra = np.diag(np.arange(1.0, count + 2.0))
    changed = evidence_with_geometry(joined, extra, unknowns)
    covariance_difference = changed.estimate.covariance - joined.estimate.covariance
    difference = np.diag(covariance_difference)
    names = [column.name for column in joined.estimate.unknowns]
    added = {column.name: float(number) for number, column in enumerate(unknowns, start=gains + 1)}
    assert list(difference[:gains]) == pytest.approx([1.0, 2.0, 3.0, 4.0])
    assert list(difference[gains:]) == pytest.approx([added.get(name, 0.0) for name in names])
    assert sum(name in added for name in names) == count - gains
    assert changed.identification.estimate is changed.estimate


def test_the_uncertainty_of_the_geometry_is_in_sigma_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a search that adds nothing, σ is that of the fit with the corrected geometry."""
    _read(_with_zero(0.5), monkeypatch)
    monkeypatch.setattr(fitting, "find_effects", partial(find_effects, families=(), geometry=()))
    fitted = fit(LOGS, keep_rows=True)
    closed = close_loop(fitted, 0)
    last_step = closed.steps[-1]
    assert last_step.after.effects == ()
    assert closed.geometry_covariance is not None
    bare = closed.evidence().training.system()
    covariance = estimate_with(Method.ML, bare).covariance
    expected = covariance + closed.geometry_covariance
    assert closed.identification.estimate.covariance == pytest.approx(expected, rel=1e-6, abs=1e-15)
    expected_diagonal_root = np.sqrt(np.diag(expected))
    assert closed.estimate.gains_std == pytest.approx(
        expected_diagonal_root[: len(GAINS)], rel=1e-6
    )
    again = close_loop(closed, 0)
    assert again.estimate.gains_std == pytest.approx(closed.estimate.gains_std, rel=1e-6)


def test_the_alternative_that_moves_gains_by_most_of_their_sigma_counts(clean: Fit) -> None:
    """A gain of small σ that moves by three of them counts for more than one of large σ that moves
    by one.
    """
    std = clean.estimate.gains_std
    few = np.zeros(len(clean.estimate.covariance))
    few[int(np.argmax(std))] = 1.0 * std.max()
    many = np.zeros(len(clean.estimate.covariance))
    many[int(np.argmin(std))] = 3.0 * std.min()
    shift = shift_in_sigmas(few, clean.estimate)
    assert shift == pytest.approx(1.0)
    assert shift_in_sigmas(many, clean.estimate) == pytest.approx(3.0)


def _finding(
    *causes: GeometryEstimate, alternatives: tuple[tuple[GeometryEstimate, ...], ...] = ()
) -> GeometryFinding:
    covariance = np.diag([one.std**2 for one in causes])
    return GeometryFinding(4e-4, 6e-6, 5e-6, True, causes, covariance, alternatives, (), ())


def test_what_encoders_cannot_tell_apart_is_said() -> None:
    zero = GeometryEstimate(ZERO, 1e-3, 1e-5)
    rod = GeometryEstimate(ROD, -3e-4, 1e-6)
    finding = _finding(zero, alternatives=((rod,),))
    (one,) = geometry_diagnoses(finding, CELL, applied=False)
    assert one.name == "zero-off"
    assert (
        "not distinguishable from a length from elbow-3 to arm-3 that is 0.3000 ± 0.0010 mm shorter"
    ) in one.found
    (both,) = geometry_diagnoses(_finding(zero, rod), CELL, applied=False)
    assert (both.name, both.axes) == ("geometry-off", ("crank-2",))
    assert "explain together" in both.found
    kept = encoder_misfit_of(_finding(zero, alternatives=((rod,),)), CELL, applied=True)
    assert kept is not None
    assert kept.alternatives == (
        "a length from elbow-3 to arm-3 that is 0.3000 ± 0.0010 mm shorter than described",
    )
    assert list(geometry_diagnoses(None, CELL, applied=False)) == []


def test_a_misfit_that_nothing_explains_is_called_so() -> None:
    (none,) = geometry_diagnoses(_finding(), CELL, applied=False)
    assert none.name == "geometry-off"
    assert (
        "miss the loops by 0.4 mrad, which no zero, length, place on the base or late "
        "encoder explains"
    ) in none.found
    assert none.expected == "0.005 mrad, the noise of the encoders"
    assert "arms that bend, play in joints" in none.remedy
    kept = encoder_misfit_of(_finding(), CELL, applied=False)
    assert kept is not None
    text = encoder_text(kept)
    assert (
        "miss the loops by 0.4 mrad, where their noise is 0.005 mrad, which no zero, length"
    ) in text
    assert "all zeros and lengths together leave 0.006 mrad" in text


def test_a_late_encoder_is_named_and_not_corrected(tmp_path: Path, clean: Fit) -> None:
    parameter = GeometryParameter(GeometryKind.DELAY, "crank-2")
    late = GeometryEstimate(parameter, 0.003, 1e-6)
    (one,) = geometry_diagnoses(_finding(late), CELL, applied=False)
    assert (one.name, one.axes) == ("position-late", ("crank-2",))
    assert "an encoder of crank-2 that is late by 3.0000 ± 0.0010 ms explains alone" in one.found
    assert "look for what delays the encoder of crank-2" in one.remedy
    assert "residual" not in one.remedy
    fitted = replace(clean, geometry=_finding(late))
    assert with_corrected_geometry(fitted) is fitted
    calibration = calibration_of(fitted, RECORDED)
    save_calibration(calibration, tmp_path / "calibration.yaml")
    path = tmp_path / "calibration.yaml"
    kept = load_calibration(path).encoder_misfit
    assert kept == calibration.encoder_misfit
    assert kept is not None
    assert (kept.corrections, kept.noise) == ((), 5e-6)
    assert (
        "explained by an encoder of crank-2 that is late by 3.0000 ± 0.0010 ms"
    ) in encoder_text(kept)


def test_a_late_encoder_that_may_be_a_wrong_zero_corrects_none() -> None:
    zero = GeometryEstimate(ZERO, 1e-3, 1e-5)
    parameter = GeometryParameter(GeometryKind.DELAY, "crank-2")
    late = GeometryEstimate(parameter, 0.003, 1e-6)
    finding = _finding(zero, alternatives=((late,),))
    assert finding.corrections == ()
    kept = encoder_misfit_of(finding, CELL, applied=False)
    assert kept is not None
    assert "explained by the zero of crank-2" in encoder_text(kept)
    assert "; or by an encoder of crank-2" in encoder_text(kept)


def test_a_place_on_the_base_is_named_and_corrected(clean: Fit, tmp_path: Path) -> None:
    parameter = GeometryParameter(GeometryKind.PLACE, "crank-3", "y")
    place = GeometryEstimate(parameter, -3e-4, 1e-7)
    finding = _finding(place)
    (one,) = geometry_diagnoses(finding, CELL, applied=False)
    assert (one.name, one.axes) == ("place-off", ())
    off = "the place of crank-3 on the base off by -0.3000 ± 0.0001 mm in y (to be added to it)"
    assert f"{off} explains alone" in one.found
    robot = model_of(CELL).robot
    joints = {joint.name: joint for joint in robot.joints}
    translation_m = float(joints["crank-3"].translation_m[1])
    described_mm = 1e3 * translation_m
    assert f"{described_mm - 0.3:.3f} mm in place of {described_mm:.3f} mm" in one.remedy
    geometry_covariance = np.zeros((1, 1))
    fitted = replace(clean, geometry=finding, geometry_covariance=geometry_covariance)
    calibration = calibration_of(fitted, RECORDED)
    save_calibration(calibration, tmp_path / "calibration.yaml")
    read = load_calibration(tmp_path / "calibration.yaml")
    moved = {joint.name: joint for joint in calibrated_model(read, CELL).robot.joints}
    assert moved["crank-3"].translation_m[1] == pytest.approx(1e-3 * described_mm - 3e-4)
    assert read.encoder_misfit is not None
    assert off in encoder_text(read.encoder_misfit)
