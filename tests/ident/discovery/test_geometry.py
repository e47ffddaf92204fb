"""Mistakes of the description, planted into recordings:
found as what they are, and gains as if they were not there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from ident.calibration import Calibration, Parameter, calibration_of
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
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import (
    GravityDirection,
    LatePosition,
    ZeroOffset,
    rotation_by,
    turn_between,
)
from ident.estimators.identify import identify
from ident.model.bodies import Payload
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


WRONG_ZERO = Mistake("zero-offset", 1, (-ZERO_RAD,), zero_rad=ZERO_RAD)
LATE_POSITION = Mistake("late-position", 2, (LATE_S,), late_s=LATE_S)
LEANING_BASE = Mistake("gravity-direction", 0, (-TILT_RAD, 0.0), tilt_rad=TILT_RAD)
MISTAKES = (WRONG_ZERO, LATE_POSITION, LEANING_BASE)
CLEAN = Mistake("nothing", 0, ())

PAYLOADS = (None, MOUNTED, None, MOUNTED)
"""Payload of each of four runs; None without load."""


def _declared(mistake: Mistake) -> Truth:
    return _leaning(three_axes_truth(), [mistake.tilt_rad, 0.0, 0.0])


def _leaning(truth: Truth, turn_rad: list[float]) -> Truth:
    """The same robot, whose base is declared to lean."""
    robot = truth.model.robot
    rotation = rotation_by(np.array(turn_rad))
    gravity_m_s2 = rotation @ robot.gravity_m_s2
    changed_robot = replace(robot, gravity_m_s2=gravity_m_s2)
    model = Model(changed_robot, truth.model.drive_train)
    return replace(truth, model=model)


def _with_mistake(run: Run, mistake: Mistake) -> Run:
    position = run.position_rad.copy()
    axis = mistake.axis
    position[:, axis] += mistake.zero_rad
    own = position[:, axis]
    earlier_s = run.time_s - mistake.late_s
    position[:, axis] = np.interp(earlier_s, run.time_s, own)
    return replace(run, position_rad=position)


def _recorded(
    truth: Truth,
    name: str,
    rng: np.random.Generator,
    payloads: tuple[Payload | None, ...],
) -> tuple[Run, ...]:
    """A run of 15 s for each payload."""
    runs: list[Run] = []
    for number, payload in enumerate(payloads):
        run = record(
            truth,
            f"{name}{number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=NOISE_A,
            payload=payload,
        )
        runs.append(run)
    return tuple(runs)


@cache
def _runs() -> tuple[Run, ...]:
    truth = three_axes_truth()
    rng = np.random.default_rng(8)
    return _recorded(truth, "run ", rng, (*PAYLOADS, MOUNTED))


@cache
def _polar_runs() -> tuple[Run, ...]:
    """Of two joints, a slide and a wrist."""
    rng = np.random.default_rng(5)
    return _recorded(polar_truth(), "r", rng, PAYLOADS)


@cache
def _fitted(mistake: Mistake) -> Evidence:
    runs = tuple(_with_mistake(run, mistake) for run in _runs())
    declared = _declared(mistake)
    return gathered(declared, runs[:4], runs[4:])


@cache
def _searched(mistake: Mistake) -> tuple[Step, ...]:
    rng = np.random.default_rng(0)
    return find_effects(_fitted(mistake), rng, GATES)


@cache
def _checked(mistake: Mistake) -> GeometryCheck:
    return _check(_fitted(mistake))


def _check(evidence: Evidence) -> GeometryCheck:
    rng = np.random.default_rng(0)
    return check_geometry(evidence, rng, GATES)


def _places(findings: Iterable[Finding]) -> list[tuple[str, int]]:
    """Name and axis of each."""
    return [(one.effect.name, one.axis) for one in findings]


def _with_current(run: Run, motor: int, added_a: FloatArray) -> Run:
    """The run with a further current of one motor."""
    current = run.current_a.copy()
    current[:, motor] += added_a
    return replace(run, current_a=current)


def _moved(runs: tuple[Run, ...], offset: FloatArray) -> tuple[Run, ...]:
    """The runs with further offsets of the positions."""
    moved: list[Run] = []
    for run in runs:
        position = run.position_rad + offset
        moved.append(replace(run, position_rad=position))
    return tuple(moved)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_is_named_alone_with_its_size_and_bends_no_gain(mistake: Mistake) -> None:
    start = _fitted(mistake)
    last = _searched(mistake)[-1].after
    (placed,) = last.effects
    assert placed.effect.name == mistake.name
    assert placed.axis == mistake.axis
    values, deviations = coefficients_of(last.estimate, placed)
    difference = np.abs(values - mistake.values)
    assert np.all(difference < 3.0 * deviations)
    absolute_mistake = abs(mistake.values[0])
    assert np.all(deviations < 0.15 * absolute_mistake)
    truth = three_axes_truth()
    gain_difference = last.estimate.gains - truth.gains
    limits = 3.0 * last.estimate.gains_std
    assert np.all(np.abs(gain_difference) < limits)
    clean = _fitted(CLEAN)
    error = last.identification.training_error.total
    clean_error = clean.identification.training_error.total
    assert error < 1.02 * clean_error

    # The description is what it was without the correction, to the last bit.
    again = without_effects(last, start.estimate)
    assert np.array_equal(again.training.regressor, start.training.regressor)
    assert again.datasets == start.datasets
    assert again.corrections == ()


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_the_check_beside_a_fit_names_it_too(mistake: Mistake) -> None:
    (found,) = _checked(mistake).mistakes
    assert found.effect.name == mistake.name
    assert found.axis == mistake.axis
    coefficient_difference = np.abs(found.coefficients - mistake.values)
    limits = 3.0 * found.deviations
    assert np.all(coefficient_difference < limits)


def test_a_wrong_zero_and_a_leaning_base_are_both_named_with_their_sizes() -> None:
    """Alone, each takes over a part of the other."""
    both = Mistake("both", 1, (), zero_rad=ZERO_RAD, tilt_rad=TILT_RAD)
    mistakes = _checked(both).mistakes
    found = {one.effect.name: one for one in mistakes}
    assert set(found) == {"zero-offset", "gravity-direction"}
    zero = found["zero-offset"]
    assert zero.axis == 1
    error_rad = abs(zero.coefficients[0] + ZERO_RAD)
    assert error_rad < 3.0 * zero.deviations[0]

    turn = found["gravity-direction"]
    errors_rad = np.abs(turn.coefficients - LEANING_BASE.values)
    limits_rad = 3.0 * turn.deviations
    assert np.all(errors_rad < limits_rad)


@pytest.mark.parametrize(("j2_deg", "slide_m"), [(2.0, 0.006), (2.0, -0.006), (-1.0, 0.006)])
def test_two_wrong_zeros_are_both_named_with_their_sizes(j2_deg: float, slide_m: float) -> None:
    """Whichever was found first had a value that no correction of the file would have confirmed."""
    j2_rad = np.radians(j2_deg)
    offset = np.array([0.0, j2_rad, slide_m, 0.0])
    runs = _moved(_polar_runs(), offset)
    evidence = gathered(polar_truth(), runs)

    check = _check(evidence)

    found = {one.axis: one for one in check.mistakes}
    assert set(found) == {1, 2}
    for axis, one in found.items():
        assert one.effect.name == "zero-offset"
        error = abs(one.coefficients[0] + offset[axis])
        assert error < 3.0 * one.deviations[0]


def test_a_wrong_zero_and_late_currents_are_both_named() -> None:
    currents_ms = (3.0, 3.0, 3.0)
    delays = Delays((), currents_ms=currents_ms)
    runs: list[Run] = []
    for run in _runs()[:4]:
        with_wrong_zero = _with_mistake(run, WRONG_ZERO)
        runs.append(_delayed(with_wrong_zero, delays))
    evidence = gathered(three_axes_truth(), tuple(runs))

    check = _check(evidence)

    places = _places(check.mistakes)
    assert set(places) == {("zero-offset", 1), ("time-skew", 0)}
    found = {one.effect.name: one for one in check.mistakes}
    zero = found["zero-offset"]
    error_rad = abs(zero.coefficients[0] + ZERO_RAD)
    assert error_rad < 3.0 * zero.deviations[0]
    skew = found["time-skew"]
    error_s = abs(skew.coefficients[0] - 0.003)
    assert error_s < 3.0 * skew.deviations[0]


@dataclass(frozen=True)
class Late:
    """What must be named late: effect, axis and delay."""

    effect: str
    axis: int
    delay_ms: float


@dataclass(frozen=True)
class Delays:
    """What is recorded late, and what must be said of it."""

    said: tuple[Late, ...]
    positions_ms: tuple[float, ...] = (0.0, 0.0, 0.0)
    currents_ms: tuple[float, ...] = (0.0, 0.0, 0.0)


def _late_currents(delays_ms: dict[int, float]) -> Delays:
    """Currents of some axes are late."""
    said = tuple(Late("lag", axis, delay_ms) for axis, delay_ms in delays_ms.items())
    currents_ms = tuple(delays_ms.get(axis, 0.0) for axis in range(3))
    return Delays(said, currents_ms=currents_ms)


def _late_position(axis: int, delay_ms: float) -> Delays:
    """The position of one axis is late."""
    positions_ms = [0.0, 0.0, 0.0]
    positions_ms[axis] = delay_ms
    said = Late("late-position", axis, delay_ms)
    return Delays((said,), positions_ms=tuple(positions_ms))


def _skewed_currents(delay_ms: float) -> Delays:
    """All currents are late."""
    said = Late("time-skew", 0, delay_ms)
    return Delays((said,), currents_ms=(delay_ms,) * 3)


def _skewed_positions(delay_ms: float) -> Delays:
    """All positions are late."""
    said = Late("time-skew", 0, -delay_ms)
    return Delays((said,), positions_ms=(delay_ms,) * 3)


DELAYS = {
    "all currents": _skewed_currents(3.0),
    "all positions": _skewed_positions(3.0),
    "all currents by 1 ms": _skewed_currents(1.0),
    "current of J1": _late_currents({0: 3.0}),
    "current of J2": _late_currents({1: 3.0}),
    "current of J2, early": _late_currents({1: -3.0}),
    "current of J3": _late_currents({2: 5.0}),
    "currents of J1 and J2": _late_currents({0: 3.0, 1: 3.0}),
    "currents of J2 and J3": _late_currents({1: 5.0, 2: 5.0}),
    "position of J1": _late_position(0, 3.0),
    "position of J2": _late_position(1, 3.0),
    "position of J3": _late_position(2, 3.0),
    "position of J3, early": _late_position(2, -3.0),
}


def _delayed(run: Run, delays: Delays) -> Run:
    def late(values: FloatArray, delays_ms: tuple[float, ...]) -> FloatArray:
        moved = []
        for own, delay_ms in zip(values.T, delays_ms, strict=True):
            earlier_s = run.time_s - 1e-3 * delay_ms
            moved.append(np.interp(earlier_s, run.time_s, own))
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

    found = _check(evidence).mistakes

    for one, late in zip(found, delays.said, strict=True):
        assert one.effect.name == late.effect
        assert one.axis == late.axis
        delay_s = 1e-3 * late.delay_ms
        error_s = abs(one.coefficients[0] - delay_s)
        assert error_s < 3.0 * one.deviations[0] < 1e-3


def test_a_current_behind_a_filter_is_late_once() -> None:
    """A delay fits its beginning alone; the position of that joint is not late as well."""
    share = 0.4  # of a new sample
    rate_hz = _runs()[0].rate_hz
    delay_s = (1.0 / share - 1.0) / rate_hz
    runs: list[Run] = []
    for run in _runs()[:4]:
        current = run.current_a.copy()
        first_a = current[0, 1]
        from_first = current[:, 1] - first_a
        filtered = signal.lfilter([share], [1.0, share - 1.0], from_first)
        current[:, 1] = filtered + first_a
        runs.append(replace(run, current_a=current))
    evidence = gathered(three_axes_truth(), tuple(runs))

    check = _check(evidence)

    assert _places(check.mistakes) == [("lag", 1)]
    first_coefficient = check.mistakes[0].coefficients[0]
    assert first_coefficient == pytest.approx(delay_s, rel=0.1)


def test_undeclared_friction_is_no_late_current() -> None:
    """A friction that saturates with the speed changes where the torque does, on its axis alone."""
    truth = three_axes_truth()
    runs: list[Run] = []
    for run in _runs()[:4]:
        velocity = np.gradient(run.position_rad[:, 1], run.time_s)
        friction_nm = 4.0 * np.tanh(velocity / 0.3)
        friction_a = friction_nm / truth.gains[1]
        runs.append(_with_current(run, 1, friction_a))
    evidence = gathered(truth, tuple(runs))

    found = _check(evidence)

    assert found.mistakes == ()


@pytest.mark.parametrize("zero_deg", [-15.0, 30.0])
def test_the_check_gives_a_large_zero_its_size(zero_deg: float) -> None:
    """The column of a zero is for small ones: by it alone, 30° are 35 ± 1°."""
    zero_rad = np.radians(zero_deg)
    mistake = Mistake("zero-offset", 1, (-zero_rad,), zero_rad=zero_rad)

    (found,) = _checked(mistake).mistakes

    assert found.effect.name == "zero-offset"
    assert found.axis == 1
    coefficient_difference = np.abs(found.coefficients - mistake.values)
    limits = 3.0 * found.deviations
    assert np.all(coefficient_difference < limits)


def test_a_clean_recording_names_nothing_and_shows_the_direction_of_gravity() -> None:
    after = _searched(CLEAN)[-1].after
    assert after.effects == ()
    check = _checked(CLEAN)
    assert check.mistakes == ()
    assert check.hidden_zeros == (0, 2)  # about the vertical, and behind the last joint
    assert check.gravity is not None
    limit_rad = 4.0 * check.gravity.turn_std_rad
    assert check.gravity.turn_rad < limit_rad < np.radians(0.5)


def test_the_direction_of_gravity_has_the_sigma_of_the_joint_fit() -> None:
    """Over clean cells, each component of the turn is as far from zero as its σ says:
    32 of them tell it to 12 %.
    """
    truth = three_axes_truth()
    far: list[FloatArray] = []
    for seed in range(16):
        runs = small_recordings(truth, 1000 + seed)
        identification = identify(truth.model, runs, SMALL, keep_rows=True)
        gravity = _check(gather(identification)).gravity
        assert gravity is not None
        turn = turn_between(gravity.declared_m_s2, gravity.found_m_s2)
        variances_rad2 = np.diag(gravity.covariance_rad2)
        far.append(turn / np.sqrt(variances_rad2))
        along = turn / np.linalg.norm(turn)
        variance_along_rad2 = along @ gravity.covariance_rad2 @ along
        std_rad = np.sqrt(variance_along_rad2)
        assert gravity.turn_std_rad == pytest.approx(std_rad)
    mean_squared_far = np.mean(np.square(far))
    assert 0.8 < np.sqrt(mean_squared_far) < 1.2


def test_a_slide_between_two_joints_shows_millimetres_of_its_zero() -> None:
    """What is mounted behind the wrist is weighed, so the slide's zero is a lever that the first
    joints feel.
    """
    moved = np.array([0.0, 0.0, 0.006, 0.0])
    runs = _moved(_polar_runs(), moved)
    evidence = gathered(polar_truth(), runs)

    found = _check(evidence)

    assert found.hidden_zeros == (0, 3)
    (slide,) = found.mistakes
    assert slide.effect.name == "zero-offset"
    assert slide.axis == 2
    error_m = abs(slide.coefficients[0] + 0.006)
    assert error_m < 3.0 * slide.deviations[0] < 0.0012


def test_slides_that_come_before_every_joint_show_nothing_of_their_zeros() -> None:
    rng = np.random.default_rng(9)
    truth = gantry_truth()
    runs = _recorded(truth, "r", rng, PAYLOADS)
    evidence = gathered(truth, runs)
    found = _check(evidence)
    assert {0, 1, 2} <= set(found.hidden_zeros)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_that_wide_moves_show_stands_alone(mistake: Mistake) -> None:
    assert _checked(mistake).alike == ()


def test_check_geometry_where_j1_hardly_moves_names_the_lean_and_the_zero_of_j2() -> None:
    """One of the two was named alone, with a σ of a twelfth of its size."""
    truth = three_axes_truth()
    leaning = _leaning(truth, [0.0, TILT_RAD, 0.0])
    rng = np.random.default_rng(8)
    less = np.array([0.06, 1.0, 1.0])

    def with_j1_hardly_moving(position_rad: FloatArray) -> FloatArray:
        return np.asarray(position_rad * less)

    runs: list[Run] = []
    for number, payload in enumerate(PAYLOADS):
        run = record(
            truth,
            f"run {number}",
            rng,
            seconds=15.0,
            rate_hz=500.0,
            averaged=2,
            noise_a=0.1,
            payload=payload,
            bend=with_j1_hardly_moving,
        )
        runs.append(run)
    # The gain of J1 is not seen
    fixed = identify(leaning.model, runs, SMALL, fixed_gains=truth.gains)
    evidence = gather(fixed, runs)

    check = _check(evidence)

    assert len(check.mistakes) == 1
    (alike,) = check.alike
    places = _places(alike.findings)
    assert set(places) == {("gravity-direction", 0), ("zero-offset", 1)}
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
        spring_nm = 6.0 * run.position_rad[:, 1]
        spring_a = spring_nm / truth.gains[1]
        runs.append(_with_current(run, 1, spring_a))
    evidence = gathered(truth, tuple(runs))

    found = _check(evidence)

    assert found.mistakes == ()


def test_check_geometry_names_a_small_zero_beside_a_large_spring_of_another_axis() -> None:
    """The spring explains more, but nothing of what the zero does to the arm."""
    zero_rad = 0.5 * ZERO_RAD
    mistake = replace(WRONG_ZERO, zero_rad=zero_rad)
    truth = three_axes_truth()
    runs: list[Run] = []
    for run in _runs()[:4]:
        spring_nm = 2.0 * run.position_rad[:, 2]
        spring_a = spring_nm / truth.gains[2]
        with_spring = _with_current(run, 2, spring_a)
        runs.append(_with_mistake(with_spring, mistake))
    evidence = gathered(truth, tuple(runs))

    (found,) = _check(evidence).mistakes

    assert found.effect.name == "zero-offset"
    assert found.axis == 1
    coefficient_deg = np.degrees(found.coefficients[0])
    assert coefficient_deg == pytest.approx(-1.0, abs=0.3)


def _parameters_without(calibration: Calibration, effect: str) -> tuple[Parameter, ...]:
    """Its parameters, without those of an effect."""
    parameters = calibration.parameters
    return tuple(one for one in parameters if not one.name.startswith(effect))


def test_the_correction_is_in_the_prediction_of_a_calibration() -> None:
    start = _fitted(WRONG_ZERO)
    steps = _searched(WRONG_ZERO)
    nameplate = (33.0, 33.0, -24.0)
    axes = ("J1", "J2", "J3")
    calibration = calibration_of(start.identification, axes, nameplate, steps=steps)
    (accepted,) = calibration.effects
    assert accepted.name == "zero-offset"
    assert accepted.axis == "J2"
    assert accepted.settings == {}
    coefficient = accepted.coefficients[0].value
    assert coefficient == pytest.approx(-ZERO_RAD, abs=0.002)

    last = steps[-1].after
    # Its verdict is that of all motors together, and so are its errors.
    assert start.holdout_error is not None
    assert last.holdout_error is not None
    assert accepted.error_before_percent == pytest.approx(start.holdout_error.total)
    assert accepted.error_after_percent == pytest.approx(last.holdout_error.total)

    data = start.datasets[-1]
    moving = data.motor_moving.all(axis=1)
    predicted = predict_current(calibration, start.model, data)
    error_a = (predicted - data.current_a)[moving]
    rms_a = np.sqrt(np.mean(error_a**2))
    assert rms_a < 1.1 * NOISE_A

    # The corrected model predicts the same; the declared one does not.
    declared = _parameters_without(calibration, "zero-offset")
    without = replace(calibration, effects=(), parameters=declared)
    predicted = predict_current(without, start.model, data)
    error_a = (predicted - data.current_a)[moving]
    declared_rms_a = np.sqrt(np.mean(error_a**2))
    assert declared_rms_a > 1.05 * rms_a
    assert last.model is not start.model


def test_a_body_is_weighed_with_the_corrected_geometry() -> None:
    start = _fitted(LEANING_BASE)
    steps = _searched(LEANING_BASE)
    nameplate = (33.0, 33.0, -24.0)
    axes = ("J1", "J2", "J3")
    calibration = calibration_of(start.identification, axes, nameplate, steps=steps)
    run = _runs()[4]
    loaded = _with_mistake(run, LEANING_BASE)
    weighed = weigh(calibration, start.model, [loaded], start.conditioning)
    mass_difference_kg = abs(weighed.mass_kg - PAYLOAD_TRUTH["m"])
    assert mass_difference_kg < 3.0 * weighed.mass_std_kg
    robot = three_axes_truth().model.robot
    level = replace(start.model, robot=robot)
    parameters = _parameters_without(calibration, "gravity-direction")
    without = replace(
        calibration,
        effects=(),
        parameters=parameters,
        covariance_factor=None,
    )
    expected = weigh(without, level, [loaded], start.conditioning)
    assert weighed.values == pytest.approx(expected.values, abs=2e-3)


def test_before_and_after_are_of_the_same_rows() -> None:
    start = _fitted(LATE_POSITION)
    steps = _searched(LATE_POSITION)
    compared = account(start, steps)
    assert compared.holdout_change is not None
    assert compared.holdout_change.total.sigmas < -2.0
    (added,) = compared.total.added
    assert added.effect.name == "late-position"

    evidence = steps[-1].after
    left_out = left_out_runs(evidence, start.estimate.gains)
    assert left_out.together is not None
    in_sample = compared.total.after.in_sample
    assert left_out.together.total < 1.1 * in_sample.total


def test_a_correction_that_leaves_is_taken_back() -> None:
    start = _fitted(WRONG_ZERO)
    offset = PlacedEffect(ZeroOffset(), 1)
    late = PlacedEffect(LatePosition(), 2)
    both = with_effects(start, (offset, late))
    assert set(both.corrections) == {offset, late}
    alone = with_effects(both, (late,))
    directly = with_effects(start, (late,))
    same_gains = pytest.approx(directly.estimate.gains, rel=1e-6)
    assert alone.estimate.gains == same_gains
    assert alone.corrections == (late,)


def test_a_declared_turn_of_gravity_is_within_twenty_degrees() -> None:
    columns = GravityDirection().coefficients
    largest_deg = [np.degrees(column.largest) for column in columns]
    assert largest_deg == pytest.approx([20.05, 20.05], abs=0.1)


def test_a_gantry_that_leans_is_named_and_upright_it_bends_no_gain() -> None:
    """In an upright gravity the mass of a linear axis, its rotor and the offset of its friction are
    two numbers; they are three but for a millionth once what is found of a lean is applied.
    """
    truth = gantry_truth()
    leaning = _leaning(truth, [0.03, -0.04, 0.0])
    rng = np.random.default_rng(9)
    runs = _recorded(truth, "run ", rng, PAYLOADS)
    evidence = gathered(leaning, runs)

    steps = find_effects(evidence, np.random.default_rng(0), GATES, ())

    last = steps[-1].after
    (placed,) = last.effects
    assert isinstance(placed.effect, GravityDirection)
    found = last.model.robot.gravity_m_s2
    _, deviations = coefficients_of(last.estimate, placed)
    horizontal_m_s2 = np.linalg.norm(found[:2])
    lean_left_rad = horizontal_m_s2 / np.linalg.norm(found)
    deviation_norm = np.linalg.norm(deviations)
    assert lean_left_rad < 3.0 * deviation_norm
    gain_difference = np.abs(last.estimate.gains - truth.gains)
    limits = 3.0 * last.estimate.gains_std
    assert np.all(gain_difference < limits)
