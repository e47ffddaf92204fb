"""Mistakes of the description, planted into recordings:
found as what they are, and gains as if they were not there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from ident.calibration import calibration_of
from ident.data.run import Run
from ident.discovery.before_after import account, left_out_runs
from ident.discovery.evidence import (
    Evidence,
    coefficients_of,
    gather,
    with_effects,
    without_effects,
)
from ident.discovery.gates import Gates
from ident.discovery.geometry_check import GeometryCheck, check_geometry
from ident.discovery.loop import Step, find_effects
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import (
    GravityDirection,
    LatePosition,
    ZeroOffset,
    rotation_by,
    turn_between,
)
from ident.estimators.identify import identify
from ident.model.model import Model
from ident.prediction import predict_current
from ident.weighing import weigh
from tests.ident.mistaken import SMALL, small_recordings
from tests.ident.recordings import (
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    gantry_truth,
    gathered,
    polar_truth,
    record,
    three_axes_truth,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

GATES = Gates(draws=199)
NOISE_A = 0.03
ZERO_RAD = np.radians(2.0)
TILT_RAD = np.radians(2.0)
LATE_S = 0.003


@dataclass(frozen=True)
class Mistake:
    """What is wrong with a description, with the name, axis and values that must be found."""

    name: str
    axis: int
    values: tuple[float, ...]
    zero_rad: float = 0.0
    late_s: float = 0.0
    tilt_rad: float = 0.0


MISTAKES = (
    Mistake("zero-offset", 1, (-ZERO_RAD,), zero_rad=ZERO_RAD),
    Mistake("late-position", 2, (LATE_S,), late_s=LATE_S),
    Mistake("gravity-direction", 0, (-TILT_RAD, 0.0), tilt_rad=TILT_RAD),
)
CLEAN = Mistake("nothing", 0, ())


def _declared(mistake: Mistake) -> Truth:
    truth = three_axes_truth()
    robot = truth.model.robot
    vector_rad = np.array([mistake.tilt_rad, 0.0, 0.0])
    turned = rotation_by(vector_rad) @ robot.gravity_m_s2
    changed_robot = replace(robot, gravity_m_s2=turned)
    model = Model(changed_robot, truth.model.drive_train)
    return replace(truth, model=model)


def _with_mistake(run: Run, mistake: Mistake) -> Run:
    position = run.position_rad.copy()
    axis = mistake.axis
    position[:, axis] += mistake.zero_rad
    time_difference_s = run.time_s - mistake.late_s
    position[:, axis] = np.interp(time_difference_s, run.time_s, position[:, axis])
    return replace(run, position_rad=position)


@cache
def _runs() -> tuple[Run, ...]:
    truth = three_axes_truth()
    rng = np.random.default_rng(8)
    return tuple(
        record(
            truth,
            f"run {number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
            payload=payload,
        )
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED, MOUNTED))
    )


@cache
def _polar_runs() -> tuple[Run, ...]:
    """Of two joints, a slide and a wrist."""
    rng = np.random.default_rng(5)
    return tuple(
        record(
            polar_truth(),
            f"r{number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
            payload=payload,
        )
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED))
    )


@cache
def _fitted(mistake: Mistake) -> Evidence:
    runs = tuple(_with_mistake(run, mistake) for run in _runs())
    return gathered(_declared(mistake), runs[:4], runs[4:])


@cache
def _searched(mistake: Mistake) -> tuple[Step, ...]:
    return find_effects(_fitted(mistake), np.random.default_rng(0), GATES)


@cache
def _checked(mistake: Mistake) -> GeometryCheck:
    return check_geometry(_fitted(mistake), np.random.default_rng(0), GATES)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_is_named_alone_with_its_size_and_bends_no_gain(mistake: Mistake) -> None:
    start = _fitted(mistake)
    last = _searched(mistake)[-1].after
    (placed,) = last.effects
    expected = (mistake.name, mistake.axis)
    assert (placed.effect.name, placed.axis) == expected
    values, deviations = coefficients_of(last.estimate, placed)
    difference = np.abs(values - mistake.values)
    assert np.all(difference < 3.0 * deviations)
    absolute_mistake = abs(mistake.values[0])
    assert np.all(deviations < 0.15 * absolute_mistake)
    truth = three_axes_truth()
    gain_difference = last.estimate.gains - truth.gains
    off = np.abs(gain_difference)
    assert np.all(off < 3.0 * last.estimate.gains_std)
    clean = _fitted(CLEAN)
    assert (
        last.identification.training_error.total < 1.02 * clean.identification.training_error.total
    )
    # The description is what it was without the correction, to the last bit.
    again = without_effects(last, start.estimate)
    assert np.array_equal(again.training.regressor, start.training.regressor)
    assert again.datasets == start.datasets
    assert again.corrections == ()


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_the_check_beside_a_fit_names_it_too(mistake: Mistake) -> None:
    (found,) = _checked(mistake).mistakes
    expected = (mistake.name, mistake.axis)
    assert (found.effect.name, found.axis) == expected
    coefficient_difference = np.abs(found.coefficients - mistake.values)
    assert np.all(coefficient_difference < 3.0 * found.deviations)


def test_a_wrong_zero_and_a_leaning_base_are_both_named_with_their_sizes() -> None:
    """Alone, each takes over a part of the other."""
    both = Mistake("both", 1, (), zero_rad=ZERO_RAD, tilt_rad=TILT_RAD)
    mistakes = _checked(both).mistakes
    found = {one.effect.name: one for one in mistakes}
    assert set(found) == {"zero-offset", "gravity-direction"}
    zero = found["zero-offset"]
    assert zero.axis == 1
    absolute_coefficient = abs(zero.coefficients[0] + ZERO_RAD)
    assert absolute_coefficient < 3.0 * zero.deviations[0]
    turn = found["gravity-direction"]
    coefficient_difference = np.abs(turn.coefficients - (-TILT_RAD, 0.0))
    assert np.all(coefficient_difference < 3.0 * turn.deviations)


@pytest.mark.parametrize(("j2_deg", "slide_m"), [(2.0, 0.006), (2.0, -0.006), (-1.0, 0.006)])
def test_two_wrong_zeros_are_both_named_with_their_sizes(j2_deg: float, slide_m: float) -> None:
    """Whichever was found first had a value that no correction of the file would have confirmed."""
    offset = np.array([0.0, np.radians(j2_deg), slide_m, 0.0])
    runs = tuple(replace(run, position_rad=run.position_rad + offset) for run in _polar_runs())
    evidence = gathered(polar_truth(), runs)
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    found = {one.axis: one for one in check.mistakes}
    assert set(found) == {1, 2}
    for axis, one in found.items():
        assert one.effect.name == "zero-offset"
        absolute_coefficient = abs(one.coefficients[0] + offset[axis])
        assert absolute_coefficient < 3.0 * one.deviations[0]


def test_a_wrong_zero_and_late_currents_are_both_named() -> None:
    currents_ms = (3.0, 3.0, 3.0)
    delays = Delays((), currents_ms=currents_ms)
    runs = tuple(_delayed(_with_mistake(run, MISTAKES[0]), delays) for run in _runs()[:4])
    evidence = gathered(three_axes_truth(), runs)
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    found = {(one.effect.name, one.axis): one for one in check.mistakes}
    expected = {("zero-offset", 1), ("time-skew", 0)}
    assert set(found) == expected
    coefficients = found["zero-offset", 1].coefficients
    absolute_coefficient = abs(coefficients[0] + ZERO_RAD)
    first_deviation = found["zero-offset", 1].deviations[0]
    assert absolute_coefficient < 3.0 * first_deviation
    first_coefficient = found["time-skew", 0].coefficients[0]
    absolute_first_coefficient = abs(first_coefficient - 0.003)
    deviations = found["time-skew", 0].deviations
    assert absolute_first_coefficient < 3.0 * deviations[0]


@dataclass(frozen=True)
class Delays:
    """What is recorded late, and what must be said of it: effect, axis and delay."""

    said: tuple[tuple[str, int, float], ...]
    positions_ms: tuple[float, float, float] = (0.0, 0.0, 0.0)
    currents_ms: tuple[float, float, float] = (0.0, 0.0, 0.0)


DELAYS = {
    "all currents": Delays((("time-skew", 0, 3.0),), currents_ms=(3.0, 3.0, 3.0)),
    "all positions": Delays((("time-skew", 0, -3.0),), positions_ms=(3.0, 3.0, 3.0)),
    "all currents by 1 ms": Delays((("time-skew", 0, 1.0),), currents_ms=(1.0, 1.0, 1.0)),
    "current of J1": Delays((("lag", 0, 3.0),), currents_ms=(3.0, 0.0, 0.0)),
    "current of J2": Delays((("lag", 1, 3.0),), currents_ms=(0.0, 3.0, 0.0)),
    "current of J2, early": Delays((("lag", 1, -3.0),), currents_ms=(0.0, -3.0, 0.0)),
    "current of J3": Delays((("lag", 2, 5.0),), currents_ms=(0.0, 0.0, 5.0)),
    "currents of J1 and J2": Delays(
        (("lag", 0, 3.0), ("lag", 1, 3.0)), currents_ms=(3.0, 3.0, 0.0)
    ),
    "currents of J2 and J3": Delays(
        (("lag", 1, 5.0), ("lag", 2, 5.0)), currents_ms=(0.0, 5.0, 5.0)
    ),
    "position of J1": Delays((("late-position", 0, 3.0),), positions_ms=(3.0, 0.0, 0.0)),
    "position of J2": Delays((("late-position", 1, 3.0),), positions_ms=(0.0, 3.0, 0.0)),
    "position of J3": Delays((("late-position", 2, 3.0),), positions_ms=(0.0, 0.0, 3.0)),
    "position of J3, early": Delays((("late-position", 2, -3.0),), positions_ms=(0.0, 0.0, -3.0)),
}


def _delayed(run: Run, delays: Delays) -> Run:
    def late(values: FloatArray, delays_ms: tuple[float, ...]) -> FloatArray:
        moved = [
            np.interp(run.time_s - 1e-3 * delay_ms, run.time_s, own)
            for own, delay_ms in zip(values.T, delays_ms, strict=True)
        ]
        return np.stack(moved, axis=1)

    position_rad = late(run.position_rad, delays.positions_ms)
    current_a = late(run.current_a, delays.currents_ms)
    return replace(
        run,
        position_rad=position_rad,
        current_a=current_a,
    )


@pytest.mark.parametrize("name", DELAYS)
def test_the_check_names_what_is_late_with_its_delay(name: str) -> None:
    """A late current, a skew of all channels and a late encoder look alike,
    and each has another remedy.
    """
    delays = DELAYS[name]
    runs = tuple(_delayed(run, delays) for run in _runs()[:4])
    evidence = gathered(three_axes_truth(), runs)
    rng = np.random.default_rng(0)
    found = check_geometry(evidence, rng, GATES).mistakes
    expected = [(effect, axis) for effect, axis, _ in delays.said]
    assert [(one.effect.name, one.axis) for one in found] == expected
    for one, (_, _, delay_ms) in zip(found, delays.said, strict=True):
        absolute_coefficient = abs(one.coefficients[0] - 1e-3 * delay_ms)
        assert absolute_coefficient < 3.0 * one.deviations[0] < 1e-3


def test_a_current_behind_a_filter_is_late_once() -> None:
    """A delay fits its beginning alone; the position of that joint is not late as well."""
    share = 0.4  # of a new sample
    rate_hz = _runs()[0].rate_hz
    delay_s = (1.0 / share - 1.0) / rate_hz
    runs: list[Run] = []
    for run in _runs()[:4]:
        current = run.current_a.copy()
        current_difference = current[:, 1] - current[0, 1]
        current[:, 1] = (
            signal.lfilter([share], [1.0, share - 1.0], current_difference) + current[0, 1]
        )
        runs.append(replace(run, current_a=current))
    evidence = gathered(three_axes_truth(), tuple(runs))
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    assert [(one.effect.name, one.axis) for one in check.mistakes] == [("lag", 1)]
    first_coefficient = check.mistakes[0].coefficients[0]
    assert first_coefficient == pytest.approx(delay_s, rel=0.1)


def test_undeclared_friction_is_no_late_current() -> None:
    """A friction that saturates with the speed changes where the torque does, on its axis alone."""
    truth = three_axes_truth()
    runs: list[Run] = []
    for run in _runs()[:4]:
        current = run.current_a.copy()
        velocity = np.gradient(run.position_rad[:, 1], run.time_s)
        current[:, 1] += 4.0 * np.tanh(velocity / 0.3) / truth.gains[1]
        runs.append(replace(run, current_a=current))
    evidence = gathered(truth, tuple(runs))
    rng = np.random.default_rng(0)
    found = check_geometry(evidence, rng, GATES)
    assert found.mistakes == ()


@pytest.mark.parametrize("zero_deg", [-15.0, 30.0])
def test_the_check_gives_a_large_zero_its_size(zero_deg: float) -> None:
    """The column of a zero is for small ones: by it alone, 30° are 35 ± 1°."""
    zero_rad = np.radians(zero_deg)
    mistake = Mistake("zero-offset", 1, (-np.radians(zero_deg),), zero_rad=zero_rad)
    (found,) = _checked(mistake).mistakes
    assert (found.effect.name, found.axis) == ("zero-offset", 1)
    coefficient_difference = np.abs(found.coefficients - mistake.values)
    assert np.all(coefficient_difference < 3.0 * found.deviations)


def test_a_clean_recording_names_nothing_and_shows_the_direction_of_gravity() -> None:
    after = _searched(CLEAN)[-1].after
    assert after.effects == ()
    check = _checked(CLEAN)
    assert check.mistakes == ()
    assert check.hidden_zeros == (0, 2)  # about the vertical, and behind the last joint
    assert check.gravity is not None
    assert check.gravity.turn_rad < 4.0 * check.gravity.turn_std_rad < np.radians(0.5)


def test_the_direction_of_gravity_has_the_sigma_of_the_joint_fit() -> None:
    """Over clean cells, each component of the turn is as far from zero as its σ says:
    32 of them tell it to 12 %.
    """
    truth = three_axes_truth()
    far: list[FloatArray] = []
    for seed in range(16):
        runs = small_recordings(truth, 1000 + seed)
        evidence = gather(identify(truth.model, runs, SMALL, keep_rows=True))
        rng = np.random.default_rng(0)
        gravity = check_geometry(evidence, rng, GATES).gravity
        assert gravity is not None
        turn = turn_between(gravity.declared_m_s2, gravity.found_m_s2)
        covariance_rad2_diagonal = np.diag(gravity.covariance_rad2)
        far.append(turn / np.sqrt(covariance_rad2_diagonal))
        along = turn / np.linalg.norm(turn)
        assert gravity.turn_std_rad == pytest.approx(
            np.sqrt(along @ gravity.covariance_rad2 @ along)
        )
    mean_squared_far = np.mean(np.square(far))
    assert 0.8 < np.sqrt(mean_squared_far) < 1.2


def test_a_slide_between_two_joints_shows_millimetres_of_its_zero() -> None:
    """What is mounted behind the wrist is weighed, so the slide's zero is a lever that the first
    joints feel.
    """
    moved = np.array([0.0, 0.0, 0.006, 0.0])
    runs = tuple(replace(run, position_rad=run.position_rad + moved) for run in _polar_runs())
    evidence = gathered(polar_truth(), runs)
    rng = np.random.default_rng(0)
    found = check_geometry(evidence, rng, GATES)
    assert found.hidden_zeros == (0, 3)
    (slide,) = found.mistakes
    assert (slide.effect.name, slide.axis) == ("zero-offset", 2)
    absolute_coefficient = abs(slide.coefficients[0] + 0.006)
    assert absolute_coefficient < 3.0 * slide.deviations[0] < 0.0012


def test_slides_that_come_before_every_joint_show_nothing_of_their_zeros() -> None:
    rng = np.random.default_rng(9)
    truth = gantry_truth()
    runs = tuple(
        record(
            truth,
            f"r{number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
            payload=payload,
        )
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED))
    )
    evidence = gathered(truth, runs)
    found = check_geometry(evidence, np.random.default_rng(0), GATES)
    assert {0, 1, 2} <= set(found.hidden_zeros)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_that_wide_moves_show_stands_alone(mistake: Mistake) -> None:
    assert _checked(mistake).alike == ()


def test_check_geometry_where_j1_hardly_moves_names_the_lean_and_the_zero_of_j2() -> None:
    """One of the two was named alone, with a σ of a twelfth of its size."""
    truth = three_axes_truth()
    robot = truth.model.robot
    vector_rad = np.array([0.0, TILT_RAD, 0.0])
    lean = rotation_by(vector_rad) @ robot.gravity_m_s2
    changed_robot = replace(robot, gravity_m_s2=lean)
    model = Model(changed_robot, truth.model.drive_train)
    leaning = replace(truth, model=model)
    rng = np.random.default_rng(8)
    less = np.array([0.06, 1.0, 1.0])
    runs: list[Run] = []
    for number, payload in enumerate((None, MOUNTED, None, MOUNTED)):
        runs.append(
            record(
                truth,
                f"run {number}",
                rng,
                seconds=15.0,
                rate_hz=500.0,
                averaged=2,
                noise_a=0.1,
                payload=payload,
                bend=lambda q: q * less,
            )
        )
    # The gain of J1 is not seen
    fixed = identify(leaning.model, runs, SMALL, fixed_gains=truth.gains)
    evidence = gather(fixed, runs)
    check = check_geometry(evidence, np.random.default_rng(0), GATES)
    assert len(check.mistakes) == 1
    (alike,) = check.alike
    named = {(one.effect.name, one.axis) for one in alike.findings}
    expected = {("gravity-direction", 0), ("zero-offset", 1)}
    assert named == expected
    for one in alike.findings:
        coefficient_norm = np.linalg.norm(one.coefficients)
        coefficient_norm_deg = np.degrees(coefficient_norm)
        assert coefficient_norm_deg == pytest.approx(2.0, abs=0.5)
        largest_deviation = np.max(one.deviations)
        assert np.degrees(largest_deviation) > 0.01  # a lost direction would have none
    assert alike.axes_to_move == (0,)


def test_check_geometry_with_an_undeclared_spring_names_no_zero() -> None:
    """A wrong zero explains a part of what it leaves; the spring explains all of it."""
    truth = three_axes_truth()
    runs: list[Run] = []
    for run in _runs()[:4]:
        current = run.current_a.copy()
        current[:, 1] += 6.0 * run.position_rad[:, 1] / truth.gains[1]
        runs.append(replace(run, current_a=current))
    evidence = gathered(truth, tuple(runs))
    rng = np.random.default_rng(0)
    found = check_geometry(evidence, rng, GATES)
    assert found.mistakes == ()


def test_check_geometry_names_a_small_zero_beside_a_large_spring_of_another_axis() -> None:
    """The spring explains more, but nothing of what the zero does to the arm."""
    zero_rad = 0.5 * ZERO_RAD
    mistake = replace(MISTAKES[0], zero_rad=zero_rad)
    truth = three_axes_truth()
    runs: list[Run] = []
    for run in _runs()[:4]:
        current = run.current_a.copy()
        current[:, 2] += 2.0 * run.position_rad[:, 2] / truth.gains[2]
        runs.append(replace(_with_mistake(run, mistake), current_a=current))
    evidence = gathered(truth, tuple(runs))
    rng = np.random.default_rng(0)
    (found,) = check_geometry(evidence, rng, GATES).mistakes
    assert (found.effect.name, found.axis) == ("zero-offset", 1)
    coefficient_deg = np.degrees(found.coefficients[0])
    assert coefficient_deg == pytest.approx(-1.0, abs=0.3)


def test_the_correction_is_in_the_prediction_of_a_calibration() -> None:
    mistake = MISTAKES[0]
    start = _fitted(mistake)
    steps = _searched(mistake)
    nameplate = (33.0, 33.0, -24.0)
    axes = ("J1", "J2", "J3")
    calibration = calibration_of(start.identification, axes, nameplate, steps=steps)
    (accepted,) = calibration.effects
    assert (accepted.name, accepted.axis, accepted.settings) == ("zero-offset", "J2", {})
    coefficient = accepted.coefficients[0].value
    assert coefficient == pytest.approx(-ZERO_RAD, abs=0.002)
    last = steps[-1].after
    # Its verdict is that of all motors together, and so are its errors.
    assert start.holdout_error is not None
    assert last.holdout_error is not None
    assert accepted.error_before_percent == pytest.approx(start.holdout_error.total)
    assert accepted.error_after_percent == pytest.approx(last.holdout_error.total)
    data = start.datasets[-1]
    predicted = predict_current(calibration, start.model, data)
    moving = data.motor_moving.all(axis=1)
    left = (predicted - data.current_a)[moving]
    rms = np.sqrt(np.mean(left**2))
    assert rms < 1.1 * NOISE_A
    # The corrected model predicts the same; the declared one does not.
    declared = tuple(
        one for one in calibration.parameters if not one.name.startswith("zero-offset")
    )
    without = replace(calibration, effects=(), parameters=declared)
    difference = predict_current(without, start.model, data) - data.current_a
    bad = difference[moving]
    rms_bad = np.sqrt(np.mean(bad**2))
    assert rms_bad > 1.05 * np.sqrt(np.mean(left**2))
    assert last.model is not start.model


def test_a_body_is_weighed_with_the_corrected_geometry() -> None:
    mistake = MISTAKES[2]
    start = _fitted(mistake)
    steps = _searched(mistake)
    nameplate = (33.0, 33.0, -24.0)
    axes = ("J1", "J2", "J3")
    calibration = calibration_of(start.identification, axes, nameplate, steps=steps)
    run = _runs()[4]
    loaded = _with_mistake(run, mistake)
    weighed = weigh(calibration, start.model, [loaded], start.conditioning)
    mass_difference_kg = abs(weighed.mass_kg - PAYLOAD_TRUTH["m"])
    assert mass_difference_kg < 3.0 * weighed.mass_std_kg
    robot = three_axes_truth().model.robot
    level = replace(start.model, robot=robot)
    parameters = tuple(
        one for one in calibration.parameters if not one.name.startswith("gravity-direction")
    )
    without = replace(
        calibration,
        effects=(),
        parameters=parameters,
        covariance_factor=None,
    )
    expected = weigh(without, level, [loaded], start.conditioning)
    assert weighed.values == pytest.approx(expected.values, abs=2e-3)


def test_before_and_after_are_of_the_same_rows() -> None:
    mistake = MISTAKES[1]
    start = _fitted(mistake)
    steps = _searched(mistake)
    whole = account(start, steps)
    assert whole.holdout_change is not None
    assert whole.holdout_change.total.sigmas < -2.0
    assert [placed.effect.name for placed in whole.total.added] == ["late-position"]
    evidence = steps[-1].after
    left_out = left_out_runs(evidence, start.estimate.gains)
    assert left_out.together is not None
    in_sample = whole.total.after.in_sample
    assert left_out.together.total < 1.1 * in_sample.total


def test_a_correction_that_leaves_is_taken_back() -> None:
    start = _fitted(MISTAKES[0])
    offset = PlacedEffect(ZeroOffset(), 1)
    late = PlacedEffect(LatePosition(), 2)
    both = with_effects(start, (offset, late))
    assert set(both.corrections) == {offset, late}
    alone = with_effects(both, (late,))
    directly = with_effects(start, (late,))
    assert alone.estimate.gains == pytest.approx(directly.estimate.gains, rel=1e-6)
    assert alone.corrections == (late,)


def test_a_declared_turn_of_gravity_is_within_twenty_degrees() -> None:
    columns = GravityDirection().coefficients
    assert [np.degrees(column.largest) for column in columns] == pytest.approx(
        [20.05, 20.05], abs=0.1
    )


def test_a_gantry_that_leans_is_named_and_upright_it_bends_no_gain() -> None:
    """In an upright gravity the mass of a linear axis, its rotor and the offset of its friction are
    two numbers; they are three but for a millionth once what is found of a lean is applied.
    """
    truth = gantry_truth()
    robot = truth.model.robot
    lean = np.array([0.03, -0.04, 0.0])
    gravity_m_s2 = rotation_by(lean) @ robot.gravity_m_s2
    changed_robot = replace(robot, gravity_m_s2=gravity_m_s2)
    leaning = Model(changed_robot, truth.model.drive_train)
    rng = np.random.default_rng(9)
    runs = tuple(
        record(
            truth,
            f"run {number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
            payload=payload,
        )
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED))
    )
    changed_truth = replace(truth, model=leaning)
    effects = find_effects(gathered(changed_truth, runs), np.random.default_rng(0), GATES, ())
    last = effects[-1].after
    (placed,) = last.effects
    assert isinstance(placed.effect, GravityDirection)
    found = last.model.robot.gravity_m_s2
    _, deviations = coefficients_of(last.estimate, placed)
    lean_left_rad = np.linalg.norm(found[:2]) / np.linalg.norm(found)
    deviation_norm = np.linalg.norm(deviations)
    assert lean_left_rad < 3.0 * deviation_norm
    gain_difference = np.abs(last.estimate.gains - truth.gains)
    assert np.all(gain_difference < 3.0 * last.estimate.gains_std)
