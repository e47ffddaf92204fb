"""Undeclared effects of closed chains: named on the right joint, and the gains stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from ident.calibration import Calibration, calibration_of
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.before_after import assess, error_on, floor_on, holdout_change, left_on
from ident.discovery.candidates import prepare_search
from ident.discovery.evidence import gather, with_effects
from ident.discovery.gates import Gates, own_unknowns, without_effects_of
from ident.discovery.loop import find_effects
from ident.effects.effect import PlacedEffect
from ident.effects.position import Spring
from ident.equations.rows import row_filter, row_masks
from ident.errors import CurrentReversed
from ident.estimators.diagnosis import diagnose, exchanged_channels
from ident.estimators.estimate import relative_error
from ident.estimators.identify import identify
from ident.model.closed_chain import TreeMotion
from ident.prediction import measured_current, measured_torque, placed_effect, predict_torque
from tests.ident.closed_recordings import Made, recorded
from tests.ident.mechanisms import FIVE_BAR, PLANAR, THREE_LEGS, Mechanism
from tests.ident.recordings import search_problem_of

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
GATES = Gates(draws=199)
Torque = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


def _friction(q: FloatArray, v: FloatArray, load: FloatArray) -> FloatArray:
    del q, load
    return 0.25 * np.sign(v) + 0.1 * v


def _spring(q: FloatArray, v: FloatArray, load: FloatArray) -> FloatArray:
    del v, load
    return 3.0 * (q - 0.2)


def _load_friction(q: FloatArray, v: FloatArray, load: FloatArray) -> FloatArray:
    del q
    return np.abs(load) * np.sign(v)


CASES = (
    (FIVE_BAR, "right-rod", _friction, "passive-friction"),
    (PLANAR, "elbow-2", _friction, "passive-friction"),
    (THREE_LEGS, "slide-1", _spring, "spring"),
    (THREE_LEGS, "slide-0", _load_friction, "load-friction"),
    (FIVE_BAR, "left-rod", _spring, "passive-spring"),
)


def _planted(
    mechanism: Mechanism, joint: str, torque: Torque, size: float
) -> tuple[Made, tuple[Run, ...]]:
    """Recordings in which a joint needs more torque than the model says:
    on top of the currents, by virtual power.
    """
    if torque is _load_friction:
        seconds = 12.0
    else:
        seconds = 14.0 if mechanism is THREE_LEGS else 18.0
    made = recorded(mechanism, 7, seconds=seconds, noise_a=0.01)
    runs = []
    joints = made.model.robot.joints
    index = [one.name for one in joints].index(joint)
    driven = list(made.model.robot.axis_joints)
    for run in made.runs:
        data = differentiate(run, made.model.drive_train, made.conditioning)
        followed: TreeMotion = made.model.follow(data.motion())
        q = followed.joints.position_rad[:, index]
        v = followed.joints.velocity_rad_s[:, index]
        standard = made.standard.copy()
        if run.payload is not None:
            standard[made.model.flange] += made.payload
        loads = made.model.torques(data.motion(), standard)[0]
        if index in driven:
            load = loads[driven.index(index)]
        else:
            load = np.zeros(len(q))
        needed = followed.to_joints[:, index] * (size * torque(q, v, load))[:, None]
        a = followed.to_motors
        inverse = np.linalg.inv(np.swapaxes(a, 1, 2) @ a)
        motors = np.einsum("kmd,kd->km", a @ inverse, needed)
        current = run.current_a.copy()
        current[1:-1] += motors / mechanism.gains
        runs.append(replace(run, current_a=current))
    return made, tuple(runs)


@pytest.mark.parametrize(
    ("mechanism", "joint", "torque", "family"), CASES, ids=lambda one: getattr(one, "name", None)
)
def test_an_effect_is_named_on_its_joint(
    mechanism: Mechanism, joint: str, torque: Torque, family: str
) -> None:
    if torque is _load_friction:
        size = 0.12
    else:
        size = {"five-bar": 1.0, "planar": 0.06, "three-legs": 150.0}[mechanism.name]
    made, runs = _planted(mechanism, joint, torque, size)
    identified = identify(made.model, runs, made.conditioning, keep_rows=True)
    rng = np.random.default_rng(0)
    steps = find_effects(gather(identified), rng, GATES)
    places = [one.name for one in made.model.robot.places]
    effects = steps[-1].after.effects
    found = [(placed.effect.name, places[placed.axis]) for placed in effects]
    assert found == [(family, joint)]
    gains = steps[-1].after.estimate
    absolute_gain = np.abs(gains.gains)
    assert np.all(
        np.abs(gains.gains / mechanism.gains - 1.0) < 4.0 * gains.gains_std / absolute_gain
    )
    axes = [f"J{number}" for number in range(1, len(mechanism.gains) + 1)]
    calibration = calibration_of(identified, axes, mechanism.gains, steps=steps)
    (accepted,) = calibration.effects
    if joint in made.model.robot.passive_names:
        named = joint
    else:
        named = axes[places.index(joint)]
    assert (accepted.name, accepted.axis) == (family, named)
    last_step = steps[-1]
    expected = last_step.after.effects[0]
    assert placed_effect(accepted, calibration)[0] == expected
    without = calibration_of(identified, axes, mechanism.gains)
    assert _error(calibration, made, runs[0]) < 0.8 * _error(without, made, runs[0])


def _error(calibration: Calibration, made: Made, run: Run) -> float:
    """Share of the torque of all axes that a calibration leaves."""
    data = differentiate(run, made.model.drive_train, made.conditioning)
    use = row_masks(made.model, data, made.conditioning)[0]
    filter_ = row_filter(data, made.conditioning)
    measured = filter_(measured_torque(calibration, made.model, data.current_a, data.motion()).T)
    predicted_nm = filter_(predict_torque(calibration, made.model, data).T)
    return relative_error(measured, predicted_nm, use).total


def test_internal_preload_is_in_no_comparison() -> None:
    made = recorded(PLANAR, 7, seconds=12.0, noise_a=0.01)
    identified = identify(made.model, made.runs, made.conditioning)
    calibration = calibration_of(
        identified, ["J1", "J2", "J3", "J4"][: len(PLANAR.gains)], PLANAR.gains
    )
    gains = tuple(
        replace(g, value=float(v)) for g, v in zip(calibration.gains, PLANAR.gains, strict=True)
    )
    calibration = replace(
        calibration,
        gains=gains,
    )
    run = made.runs[0]
    data = differentiate(run, made.model.drive_train, made.conditioning)
    to_motors = made.model.follow(data.motion()).to_motors
    whole, _ = np.linalg.qr(to_motors, mode="complete")
    mobility = made.model.assembly.mobility
    preload = whole[:, :, mobility:].sum(axis=2)
    preloaded = data.current_a + 0.5 * preload / PLANAR.gains
    arguments = calibration, made.model
    seen = measured_torque(*arguments, data.current_a, data.motion())
    assert_allclose(
        measured_torque(*arguments, preloaded, data.motion()), seen, rtol=0.0, atol=1e-10
    )
    assert not np.allclose(
        measured_torque(*arguments, preloaded),
        measured_torque(*arguments, data.current_a),
        atol=0.1,
    )
    shown = measured_current(*arguments, preloaded, data.motion())
    assert_allclose(shown * PLANAR.gains, seen, rtol=0.0, atol=1e-10)
    first_run = made.runs[0]
    current_a = _at_samples(first_run, preloaded)
    changed_run = replace(made.runs[0], current_a=current_a)
    assert _error(calibration, made, changed_run) < 5.0


def test_internal_preload_is_no_error() -> None:
    """Preload is far larger than the error; the model is exact,
    so seen moves are predicted as well as unseen ones.
    """
    made = recorded(PLANAR, 7, seconds=12.0, noise_a=0.01, preload_nm=2.0)
    evidence = gather(identify(made.model, made.runs, made.conditioning, keep_rows=True))
    rows = evidence.training
    estimate = evidence.estimate
    errors = assess(evidence, estimate.gains).errors
    assert (
        0.8 * errors.cross_validated.total < errors.in_sample.total < errors.cross_validated.total
    )
    # e shows three of four shares of the noise: what it leaves, divided by these, is the noise of
    # the currents.
    assert left_on(rows, estimate) == pytest.approx(estimate.axis_noise, rel=0.02)
    floor = floor_on(rows, estimate, estimate.axis_noise).relative(estimate.gains)
    assert floor.axes == pytest.approx(errors.in_sample.axes, rel=0.02)
    search_problem = search_problem_of(evidence)
    shown = [
        search_problem.folds.linearisation.effective_rows(motor)
        for motor in range(len(estimate.gains))
    ]
    mobility = made.model.assembly.mobility
    assert sum(shown) == pytest.approx(mobility * np.sum(rows.motor_use[0]))
    parameters = 1.01 * estimate.parameters
    worse = replace(estimate, parameters=parameters)
    changed_evidence = replace(evidence, holdout=rows, estimate=worse)
    change = holdout_change(replace(evidence, holdout=rows), changed_evidence)
    assert change is not None
    assert change.is_harm
    rise = error_on(rows, worse).left - error_on(rows, estimate).left
    assert change.total.rise == pytest.approx(np.sum(rise / np.square(estimate.axis_noise)))


def test_an_effect_is_taken_out_of_the_rows_of_all_motors() -> None:
    """The derivative to a gain holds the corrected current:
    without an effect, that of the same fit without it.
    """
    made = recorded(PLANAR, 7, seconds=12.0, noise_a=0.01, preload_nm=2.0)
    bare = gather(identify(made.model, made.runs, made.conditioning, keep_rows=True))
    placed = PlacedEffect(Spring(), 1)
    joined = with_effects(bare, (placed,))
    estimate = joined.estimate
    parameters = np.delete(estimate.parameters, own_unknowns(estimate, (placed,)))
    declared = replace(estimate, parameters=parameters)
    without_effects = without_effects_of(search_problem_of(joined), estimate, (placed,))
    search_problem = without_effects.search_problem
    problems = (
        search_problem,
        prepare_search(made.model, joined.fit_runs, bare.training, declared),
    )
    found, expected = (
        problem.folds.linearisation.jacobian.columns(np.arange(4)) for problem in problems
    )
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def _at_samples(run: Run, inner: FloatArray) -> FloatArray:
    """Currents of a run from those of its differentiated samples,
    which lack the first and the last one.
    """
    return np.concatenate((run.current_a[:1], inner, run.current_a[-1:]))


@pytest.mark.parametrize("mechanism", [FIVE_BAR, PLANAR], ids=lambda one: one.name)
def test_no_diagnosis_fails_on_a_closed_chain(mechanism: Mechanism) -> None:
    made = recorded(mechanism, 7, seconds=12.0, noise_a=0.01)
    axes = [joint.name for joint in made.model.robot.axes]
    limit = np.full(len(mechanism.gains), 1e3)
    for gains in (None, mechanism.gains):
        identified = identify(made.model, made.runs, made.conditioning, fixed_gains=gains)
        assert diagnose(identified, axes, mechanism.gains, limit) == ()
    assert exchanged_channels(made.model, made.runs, made.conditioning, axes) is None
    turned = mechanism.gains * np.where(np.arange(len(mechanism.gains)) == 1, -1.0, 1.0)
    with pytest.raises(CurrentReversed, match=axes[1]):
        identify(made.model, made.runs, made.conditioning, fixed_gains=turned)


def test_a_clean_closed_chain_has_no_effect() -> None:
    for mechanism in (FIVE_BAR, PLANAR):
        made = recorded(mechanism, 8, seconds=18.0, noise_a=0.01)
        rng = np.random.default_rng(0)
        steps = find_effects(
            gather(identify(made.model, made.runs, made.conditioning, keep_rows=True)),
            rng,
            GATES,
        )
        assert not steps[-1].after.effects
