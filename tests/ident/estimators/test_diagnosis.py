"""Each mistake of a recording is named, by run or axis, and it alone;
none is named in clean recordings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.data.unsigned_current import unsigned_currents
from ident.discovery.evidence import gather
from ident.errors import (
    GAIN_UNSEEN,
    CurrentReversed,
    CurrentUnsigned,
    Diagnosis,
    ModelContradicted,
    PayloadDiffers,
    UnitsMistaken,
)
from ident.estimators.diagnosis import (
    axis_error_diagnoses,
    channel_errors,
    diagnose,
    exchanged_channels,
    gain_diagnoses,
    require_explained_currents,
    scale_diagnoses,
    unsigned_channels,
)
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.identify import identify
from ident.estimators.least_squares import wls
from ident.estimators.method import Method
from ident.estimators.payload_diagnosis import payload_differences
from ident.estimators.refusals import idle_joints, require_plausible, require_units
from ident.model.model import Column, DriveTrain, Model
from ident.model.robot import Joint, JointKind, Robot
from ident.plausible import UNIT_RATIO, WEIGHT_RATIO
from tests.ident.mistaken import (
    AXES,
    BODY,
    SMALL,
    diagnosed,
    small_recordings,
    turned,
    with_currents,
)
from tests.ident.recordings import MOUNTED, FloatArray, Truth, record

pytestmark = pytest.mark.slow

NOTHING = 0.0 * BODY
"""Parameters of a payload that was left off."""


@pytest.fixture(scope="module")
def clean(small_truth: Truth) -> list[Run]:
    return small_recordings(small_truth, 0)


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_named_in_clean_recordings(small_truth: Truth, seed: int) -> None:
    noise_a = (0.02, 0.1, 0.15)[seed % 3]
    runs = small_recordings(small_truth, seed, count=3, noise_a=noise_a)
    limit = np.full(3, 99.0)
    by_ml = diagnosed(small_truth, runs[:2], runs[2:], effort_limit=limit)
    assert by_ml == ()
    by_wls = diagnosed(
        small_truth, runs[1:], runs[:1], fixed=True, method=Method.WLS, effort_limit=limit
    )
    assert by_wls == ()
    assert exchanged_channels(small_truth.model, runs[:2], SMALL, AXES) is None


def test_a_payload_turned_in_one_run_of_three(small_truth: Truth) -> None:
    bodies = {3: turned(np.pi)}
    runs = small_recordings(small_truth, 0, count=6, bodies=bodies)
    (found,) = diagnosed(small_truth, runs)
    assert found.name == "payload-differs"
    assert found.runs == ("r3",)
    assert found.axes == ()
    assert "not turned?" in found.text


def test_of_two_loaded_runs_neither_can_be_blamed_alone(small_truth: Truth) -> None:
    bodies = {1: turned(np.pi)}
    runs = small_recordings(small_truth, 1, bodies=bodies)
    (found,) = diagnosed(small_truth, runs, fixed=True)
    assert found.name == "payload-differs"
    assert found.runs == ("r1", "r3")


def test_a_payload_turned_in_the_held_out_run(small_truth: Truth) -> None:
    bodies = {3: turned(np.pi)}
    runs = small_recordings(small_truth, 2, bodies=bodies)
    (found,) = diagnosed(small_truth, runs[:2], runs[2:])
    assert found.name == "payload-differs"
    assert found.runs == ("r3",)


@pytest.mark.parametrize(
    ("run", "body"),
    [pytest.param(3, NOTHING, id="left off"), pytest.param(2, BODY, id="left on")],
)
def test_a_payload_left_off_or_on_in_one_run_leaves_no_numbers(
    small_truth: Truth, run: int, body: FloatArray
) -> None:
    runs = small_recordings(small_truth, 0, count=6, bodies={run: body})
    with pytest.raises(PayloadDiffers, match=rf"run r{run}: .*was it mounted in this run"):
        diagnosed(small_truth, runs, fixed=True)


def test_the_only_loaded_run_without_its_payload(small_truth: Truth) -> None:
    """Fixed gains that are off by 10 to 20 % say nothing of a payload;
    a weight of nearly nothing does.
    """
    runs = small_recordings(small_truth, 0, count=2)
    gains_off = with_currents(runs, np.array([1.2, 0.85, 1.1]))
    assert diagnosed(small_truth, gains_off, fixed=True) == ()
    without_payload = _second_run_without_payload(small_truth)
    (found,) = diagnosed(small_truth, [runs[0], without_payload], fixed=True)
    assert found.name == "payload-differs"
    assert found.runs == ("r1",)


def _second_run_without_payload(truth: Truth) -> Run:
    """The run that says that it is loaded, and is not."""
    _, second = small_recordings(truth, 0, count=2, bodies={1: NOTHING})
    return second


def test_the_difference_is_estimated_as_planted(small_truth: Truth) -> None:
    """Twice the mass, at the same centre."""
    heavier = BODY.copy()
    heavier[6:] *= 2.0
    runs = small_recordings(small_truth, 4, bodies={3: heavier}, noise_a=0.02)
    gains = small_truth.gains
    known = identify(small_truth.model, runs[:2], SMALL, holdout=runs[3:], fixed_gains=gains)
    assert known.holdout is not None
    estimate = known.estimate
    (found,) = payload_differences(known.holdout, estimate.gains, estimate.parameters)
    seen = [6, 8, 9]  # my lies along the last axis, which is horizontal
    assert found.difference[seen] == pytest.approx(BODY[seen], rel=0.1)
    assert found.probability < 1e-6


@pytest.mark.parametrize("order", [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]], ids=str)
def test_exchanged_currents_are_named(
    small_truth: Truth, clean: list[Run], order: list[int]
) -> None:
    runs = with_currents(clean[:2], 1.0, order)
    found = exchanged_channels(small_truth.model, runs, SMALL, AXES)
    assert found is not None
    exchanged = [AXES[axis] for axis, channel in enumerate(order) if channel != axis]
    assert found.axes == tuple(exchanged)


def test_one_motor_that_explains_another_current_better_is_no_exchange(
    small_truth: Truth, clean: list[Run]
) -> None:
    """Both equations of a pair must ask for the exchange, not their sum:
    here only that of J2 does.
    """
    mixed = []
    for run in clean[:2]:
        rng = np.random.default_rng(3)
        current_a = run.current_a.copy()
        current_a[:, 2] = current_a[:, 1] + 0.3 * current_a[:, 2]
        current_a[:, 1] += 2.0 * rng.standard_normal(len(current_a))
        mixed.append(replace(run, current_a=current_a))
    errors = channel_errors(small_truth.model, mixed, SMALL)
    assert errors[1, 2] < errors[1, 1]
    assert exchanged_channels(small_truth.model, mixed, SMALL, AXES) is None


def test_a_reversed_current_only_turns_a_free_gain(small_truth: Truth, clean: list[Run]) -> None:
    runs = with_currents(clean, np.array([1.0, -1.0, 1.0]))
    (found,) = diagnosed(small_truth, runs)
    assert found.name == "current-reversed"
    assert found.axes == ("J2",)
    assert "position" not in found.remedy


def test_a_reversed_position_of_a_vertical_axis_is_not_blamed_on_its_current_alone(
    small_truth: Truth, clean: list[Run]
) -> None:
    """The mirror image of the arm has the same torques, but for the sign of this one."""
    signs = np.array([-1.0, 1.0, 1.0])
    mirrored = [replace(run, position_rad=run.position_rad * signs) for run in clean]
    for runs in (mirrored, with_currents(clean, signs)):
        (found,) = diagnosed(small_truth, runs)
        assert found.name == "current-reversed"
        assert found.axes == ("J1",)
        assert "this current the other way? If not, does the position" in found.remedy


@pytest.mark.parametrize(
    ("signs", "named"),
    [
        ([1.0, 1.0, -1.0], "wrist"),
        ([1.0, -1.0, 1.0], "arm"),
        ([1.0, -1.0, -1.0], "arm, wrist"),
        ([-1.0, 1.0, 1.0], "base"),
        ([-1.0, 1.0, -1.0], "base, wrist"),
        ([-1.0, -1.0, 1.0], "base, arm"),
    ],
)
def test_a_reversed_current_with_fixed_gains(
    small_truth: Truth, clean: list[Run], signs: list[float], named: str
) -> None:
    axes = ("base", "arm", "wrist")  # not the joints' names in the URDF
    runs = with_currents(clean[:1], np.array(signs))
    model = small_truth.model
    gains = small_truth.gains
    with pytest.raises(CurrentReversed, match=f"axis {named}: "):
        identify(model, runs, SMALL, fixed_gains=gains, method=Method.WLS, axes=axes)


@pytest.mark.parametrize(
    ("fixed", "words"),
    [(False, "all drive gains.*mA"), (True, "the weight of the payload.*mA")],
)
def test_currents_in_milliamperes_are_named(
    small_truth: Truth, clean: list[Run], fixed: bool, words: str
) -> None:
    runs = with_currents(clean[:2], 1000.0)
    with pytest.raises(UnitsMistaken, match=words):
        diagnosed(small_truth, runs, fixed=fixed)


@pytest.mark.parametrize(
    ("fixed", "words"),
    [(False, "all drive gains.*g and read as kg"), (True, "the weight of the payload.*mA")],
)
def test_a_mass_in_grams_is_named(
    small_truth: Truth, clean: list[Run], fixed: bool, words: str
) -> None:
    bare, loaded = clean[:2]
    known = {"m": 1000.0 * MOUNTED.known["m"]}
    heavy = replace(loaded, payload=replace(MOUNTED, known=known))
    with pytest.raises(UnitsMistaken, match=words):
        diagnosed(small_truth, [bare, heavy], fixed=fixed)


@given(st.lists(st.floats(0.001, 1000.0), min_size=2, max_size=5))
def test_all_gains_must_be_off_alike(ratio: list[float]) -> None:
    signs = (-1.0) ** np.arange(len(ratio))
    gains = np.array(ratio) * signs
    nameplate = np.ones(len(ratio))
    all_above = min(ratio) > UNIT_RATIO
    all_below = max(ratio) < 1.0 / UNIT_RATIO
    if all_above or all_below:
        with pytest.raises(UnitsMistaken):
            require_units(gains, nameplate)
    else:
        require_units(gains, nameplate)


def test_one_gain_off_its_nameplate(small_truth: Truth, clean: list[Run]) -> None:
    runs = with_currents(clean, np.array([1.0, 1.0, 5.0]))
    (found,) = diagnosed(small_truth, runs)
    assert found.name == "gain-off-nameplate"
    assert found.axes == ("J3",)
    assert "or a length of the URDF wrong? measure the lengths" in found.remedy


def test_torques_above_the_limits_of_the_urdf(small_truth: Truth, clean: list[Run]) -> None:
    """Without a payload nothing else speaks of mA."""
    runs = with_currents(clean[:1], 1000.0)
    limit = np.array([99.0, np.inf, 99.0])
    (found,) = diagnosed(small_truth, runs, fixed=True, effort_limit=limit)
    assert found.name == "torque-above-limit"
    effort_limit = np.full(3, np.inf)
    assert diagnosed(small_truth, runs, fixed=True, effort_limit=effort_limit) == ()


def test_an_error_on_one_axis(small_truth: Truth, clean: list[Run]) -> None:
    rng = np.random.default_rng(0)
    noisy = [_with_noise_on_j3(run, rng) for run in clean[:2]]
    (found,) = diagnosed(small_truth, noisy, fixed=True)
    assert found.name == "axis-error"
    assert found.runs == ()
    assert found.axes == ("J3",)


def _with_noise_on_j3(run: Run, rng: np.random.Generator) -> Run:
    noise_a = rng.standard_normal(run.current_a.shape) * np.array([0.0, 0.0, 1.0])
    return replace(run, current_a=run.current_a + noise_a)


def test_an_error_of_a_held_out_run_is_that_runs_alone(
    small_truth: Truth, clean: list[Run]
) -> None:
    """The rows of a search for effects name all runs, those of the fit first."""
    noisy = _with_noise_on_j3(clean[2], np.random.default_rng(0))
    gains = small_truth.gains
    found = identify(
        small_truth.model, clean[:2], SMALL, holdout=[noisy], fixed_gains=gains, keep_rows=True
    )
    for identified in (found, gather(found).identification):
        (one,) = diagnose(identified, AXES, gains)
        assert one.name == "axis-error"
        assert one.runs == ("r2",)
        assert one.axes == ("J3",)


def test_a_tiny_torque_is_no_error(small_truth: Truth) -> None:
    size = np.array([30.0, 20.0, 0.01])
    left = np.array([1.0, 1.0, 0.09])
    idle = idle_joints(small_truth.model, size, left)
    (found,) = axis_error_diagnoses(size, left, idle, AXES, ())
    assert found.name == "axis-idle"
    assert found.axes == ("J3",)
    runs = small_recordings(small_truth, 5, count=1)
    gains = small_truth.gains
    estimate = identify(small_truth.model, runs, SMALL, fixed_gains=gains).estimate
    error_percent = (3.3, 5.0, 900.0)
    error = RelativeError(error_percent, 4.0)
    require_plausible(estimate, error, AXES, idle)
    with pytest.raises(ModelContradicted, match="900 % on axis J3"):
        require_plausible(estimate, error, AXES)


def test_axes_that_never_move_apart_leave_no_parameters(small_truth: Truth) -> None:
    def tied(position_rad: FloatArray) -> FloatArray:
        bent_rad = position_rad.copy()
        bent_rad[:, 2] = 0.5 * position_rad[:, 1] + 1e-6 * position_rad[:, 2]
        return bent_rad

    rng = np.random.default_rng(0)
    run = record(
        small_truth,
        "tied",
        rng,
        seconds=16.0,
        noise_a=0.05,
        rate_hz=200.0,
        bend=tied,
    )
    (found,) = diagnosed(small_truth, [run], fixed=True, method=Method.WLS)
    assert found.name == "ill-conditioned"


def test_the_unit_of_an_effect_is_no_bad_condition(small_truth: Truth) -> None:
    """A coefficient in rad/Nm is some 1e-5, and its column some 1e5 times as large as those of
    masses.
    """
    runs = small_recordings(small_truth, 0, count=2)
    gains = small_truth.gains
    found = identify(small_truth.model, runs, SMALL, fixed_gains=gains, keep_rows=True)
    assert found.gathered is not None
    _, rows = found.gathered
    samples = rows.current.shape[1]
    effect = np.zeros((3, 1, samples))
    rng = np.random.default_rng(0)
    effect[1, 0] = rng.standard_normal(samples)
    columns = (Column("effect", "1"),)
    conditions = []
    for unit in (1.0, 1e6):
        system = rows.extended(columns, unit * effect).system()
        conditions.append(wls(system, gains).condition)
    small_unit, large_unit = conditions
    assert small_unit == pytest.approx(found.estimate.condition, rel=0.1)
    assert large_unit == pytest.approx(found.estimate.condition, rel=0.1)
    assert large_unit == pytest.approx(small_unit, rel=1e-6)


def test_another_estimator_far_from_ml(small_truth: Truth, clean: list[Run]) -> None:
    """IDIM-WLS takes the noise in the currents for smaller gains."""
    found = diagnosed(small_truth, clean, method=Method.WLS)
    names = {one.name for one in found}
    axes = {one.axes[0] for one in found}
    assert names == {"estimators-disagree"}
    assert "J3" in axes
    assert "by wls" in found[0].found
    assert "noise in the currents" in found[0].remedy


def test_the_instruments_need_not_agree_with_ml(small_truth: Truth, clean: list[Run]) -> None:
    """Where a disturbance moves the arm, ml is the one that is off."""
    found = identify(small_truth.model, clean, SMALL)
    gains = 1.3 * found.estimate.gains
    by_iv = replace(found.estimate, method=Method.IV, gains=gains)
    diagnoses_of_iv = diagnose(replace(found, estimate=by_iv), AXES)
    assert not _named("estimators-disagree", diagnoses_of_iv)
    by_tls = replace(by_iv, method=Method.TLS)
    diagnoses_of_tls = diagnose(replace(found, estimate=by_tls), AXES)
    apart = _named("estimators-disagree", diagnoses_of_tls)
    assert apart
    assert "an effect that the model lacks" in apart[0].remedy


def _named(name: str, diagnoses: Iterable[Diagnosis]) -> list[Diagnosis]:
    return [diagnosis for diagnosis in diagnoses if diagnosis.name == name]


def limits_in(text: str) -> tuple[float, float]:
    """Return the range that a diagnosis promises, as `0.7 to 1.3`."""
    found = re.search(r"([0-9.]+) to ([0-9.]+)", text)
    assert found is not None
    return float(found[1]), float(found[2])


@given(
    scale=st.floats(0.01, 0.69) | st.floats(0.71, 1.29) | st.floats(1.31, 100.0),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_the_scale_of_a_current_beside_a_calibration(scale: float, sign: float) -> None:
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((2, 200))
    measured = predicted.copy()
    measured[1] *= sign * scale
    use = np.ones((2, 200), dtype=bool)
    found = list(scale_diagnoses(measured, predicted, use, "ab", ("r",)))
    is_reversed = bool(_named("current-reversed", found))
    assert is_reversed == (sign < 0.0)
    off_scale = _named("current-off-scale", found)
    is_off_scale = not 0.7 <= scale <= 1.3
    assert bool(off_scale) == is_off_scale
    for one in off_scale:
        assert limits_in(one.expected) == (0.7, 1.3)
        assert one.axes == ("b",)


def test_noise_makes_no_scale(small_truth: Truth) -> None:
    """Twenty times the same torque, at 1.3 of the prediction,
    with noise of a seventh of its size.
    """
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((1, 400))
    use = np.ones((1, 400), dtype=bool)
    for seed in range(1, 21):
        rng = np.random.default_rng(seed)
        noise = 0.15 * rng.standard_normal((1, 400))
        measured = 1.3 * predicted + noise
        found = scale_diagnoses(measured, predicted, use, "a", ("r",))
        assert not list(found)


@given(
    ratio=st.floats(0.05, 20.0),
    std=st.floats(0.0, 0.5),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_a_gain_is_named_where_the_text_says(ratio: float, std: float, sign: float) -> None:
    """Outside the range that the text has, by more than the σ that it has."""
    nameplate = np.array([sign * 20.0])
    gains = ratio * nameplate
    estimate = an_estimate(gains, std * np.abs(nameplate))
    diagnoses = gain_diagnoses(estimate, nameplate, ("J1",))
    found = _named("gain-off-nameplate", diagnoses)
    is_below = ratio + 3.0 * std < 0.7
    is_above = ratio - 3.0 * std > 1.3
    is_off = is_below or is_above
    assert bool(found) == is_off
    for one in found:
        assert limits_in(one.expected) == (0.7, 1.3)
        assert one.expected.endswith("within 3 σ")


@pytest.mark.parametrize(
    ("gain", "std", "is_named"),
    [
        (-204.0, 97.0, True),  # of a drive of 40 Nm/A
        (2216.0, 1030.0, True),
        (-63.0, 63.0, True),
        (55.0, 59.0, True),
        (36.0, 17.0, False),  # uncertain, and not absurd
        (36.0, 5.0, False),
        (-40.0, 4.0, False),  # a reversed current, which has its own name
    ],
)
def test_a_gain_that_the_moves_hardly_show_is_named_where_its_number_is_absurd(
    gain: float, std: float, is_named: bool
) -> None:
    gains = np.array([gain])
    estimate = an_estimate(gains, np.array([std]))
    nameplate = np.array([38.0])
    diagnoses = gain_diagnoses(estimate, nameplate, ("J1",))
    found = _named(GAIN_UNSEEN, diagnoses)
    assert bool(found) == is_named
    for one in found:
        assert one.axes == ("J1",)
        assert "record" in one.remedy


@pytest.mark.parametrize(
    ("gain", "std_percent"), [(-8.06, 3.33), (-8.27, 1.76), (-8.31, 1.99), (-9.21, 2.75)]
)
def test_the_papers_gains_are_not_off_their_nameplates(gain: float, std_percent: float) -> None:
    """J4 in Tables 2 and 4: up to 30 % below the nameplate of 11.52, with σ of 2 to 3 %."""
    nameplate = np.array([-11.52])
    std = std_percent / 100.0 * abs(gain)
    estimate = an_estimate(np.array([gain]), np.array([std]))
    found = gain_diagnoses(estimate, nameplate, ("J4",))
    assert not list(found)


def an_estimate(gains: FloatArray, std: FloatArray) -> Estimate:
    """An estimate of gains alone."""
    covariance = np.diag(std**2)
    axis_noise = np.ones(len(gains))
    parameters = np.zeros(0)
    singular_values = np.ones(1)
    return Estimate(
        method=Method.ML,
        gains=gains,
        gains_fixed=False,
        unknowns=(),
        parameters=parameters,
        covariance=covariance,
        axis_noise=axis_noise,
        singular_values=singular_values,
        condition=1.0,
        rows=9,
    )


def test_ranges_in_texts_are_those_that_are_tested(small_truth: Truth, clean: list[Run]) -> None:
    """A factor that a refusal names is the one that it tests."""
    gains = np.full(3, 1.01 * UNIT_RATIO)
    words = rf"0\.7 to 1\.3, and within a factor of {UNIT_RATIO:g} on one axis"
    with pytest.raises(UnitsMistaken, match=words):
        require_units(gains, np.ones(3))
    without_payload = _second_run_without_payload(small_truth)
    (found,) = diagnosed(small_truth, [clean[0], without_payload], fixed=True)
    assert found.expected == f"1, and within a factor of {WEIGHT_RATIO:g}"


@pytest.mark.parametrize("factor", [0.51, 2.0])
def test_a_current_in_another_ampere_is_named(
    small_truth: Truth, clean: list[Run], factor: float
) -> None:
    """A torque constant that is applied twice, or an ampere that is a peak value of two."""
    runs = with_currents(clean, np.array([1.0, factor, 1.0]))
    (found,) = diagnosed(small_truth, runs)
    assert found.name == "gain-off-nameplate"
    assert found.axes == ("J2",)
    ratio = re.search(r"([0-9.]+) times the nameplate$", found.found)
    assert ratio is not None
    assert float(ratio[1]) == pytest.approx(1.0 / factor, rel=0.05)


def test_the_axis_whose_friction_jumps_through_zero_is_found_by_its_equation(
    small_truth: Truth,
) -> None:
    """Without noise, and at 200 Hz, the current of J3 is near zero in two samples of 16 s."""
    model = small_truth.model
    (run,) = small_recordings(small_truth, 3, count=1, noise_a=0.0)
    assert unsigned_channels(model, [run], SMALL, AXES) is None
    size_a = np.abs(run.current_a[:, 2])
    current_a = run.current_a.copy()
    current_a[:, 2] = size_a
    unsigned = replace(run, current_a=current_a)
    by_shape = unsigned_currents(unsigned, model.drive_train.ratio)
    assert not by_shape.any()
    found = unsigned_channels(model, [unsigned], SMALL, AXES)
    assert found is not None
    assert found.axes == ("J3",)
    offset_a = np.array([0.0, 0.0, 2.0 * float(size_a.max())])
    lifting = replace(run, current_a=run.current_a + offset_a)
    assert unsigned_channels(model, [lifting], SMALL, AXES) is None


def test_the_missing_sign_of_each_axis_is_named_by_its_equation(small_truth: Truth) -> None:
    (run,) = small_recordings(small_truth, 3, count=1, noise_a=0.0)
    sign = np.array([1.0, 1.0, -1.0])
    sized = replace(run, current_a=sign * np.abs(run.current_a))
    found = unsigned_channels(small_truth.model, [sized], SMALL, AXES)
    assert found is not None
    expected = f"never negative ({AXES[0]}, {AXES[1]}) or never positive ({AXES[2]})"
    assert expected in found.found


def _pendulum_run() -> Run:
    """An arm that hangs, is lifted and let down again, with hardly any friction:
    its current has one sign, almost.

    From rest at zero torque the current rises as a line, as the size of a current does where it
    turns.
    """
    rate_hz = 500.0
    lift_s = np.arange(0.0, 0.6, 1.0 / rate_hz)
    ramp = np.clip(lift_s / 0.6, 0.0, 1.0)
    way = ramp**2 * (3.0 - 2.0 * ramp)
    pause = np.zeros(25)
    lifts = []
    for lift in range(20):
        height_rad = 1.2 if lift % 2 else 0.84
        up = height_rad * way
        at_the_top = height_rad + pause
        down = height_rad * way[::-1]
        lifts += [up, at_the_top, down, pause]
    position_rad = np.concatenate(lifts)
    time_s = np.arange(len(position_rad)) / rate_hz
    velocity_rad_s = np.gradient(position_rad, time_s)
    acceleration_rad_s2 = np.gradient(velocity_rad_s, time_s)
    direction = np.sign(np.round(velocity_rad_s, 3))
    current_a = np.sin(position_rad) + 0.005 * acceleration_rad_s2 + 0.02 * direction
    rng = np.random.default_rng(1)
    noise_a = 1e-3 * rng.standard_normal(len(current_a))
    noisy_a = current_a + noise_a
    return Run("lifts", time_s, position_rad[:, None], noisy_a[:, None])


def test_a_load_that_is_always_carried_is_explained_by_the_equation_of_its_motor() -> None:
    rotation = np.eye(3)
    translation_m = np.zeros(3)
    z_axis = np.array([0.0, 0.0, 1.0])
    link = Joint("J1", JointKind.REVOLUTE, -1, rotation, translation_m, z_axis)
    gravity_m_s2 = np.array([0.0, -9.81, 0.0])
    robot = Robot((link,), gravity_m_s2)
    drive_train = DriveTrain(np.eye(1))
    pendulum = Model(robot, drive_train)
    conditioning = Conditioning(standstill_rad_s=(0.03,))
    run = _pendulum_run()
    ratio = np.eye(1)
    assert unsigned_currents(run, ratio).all()  # by its shape alone it would be called a size
    require_explained_currents(run, pendulum, conditioning, ("J1",))


def test_a_size_is_refused_whatever_its_load(small_truth: Truth) -> None:
    """The sizes of the currents of an arm, which its equations do not explain."""
    (run,) = small_recordings(small_truth, 3, count=1)
    current_a = np.abs(run.current_a)
    sizes = replace(run, current_a=current_a)
    with pytest.raises(CurrentUnsigned, match="J1, J2, J3"):
        require_explained_currents(sizes, small_truth.model, SMALL, AXES)


@pytest.mark.parametrize("method", [Method.LS, Method.WLS, Method.TLS, Method.ML])
def test_a_recording_is_judged_alike_whatever_the_method(
    small_truth: Truth, clean: list[Run], method: Method
) -> None:
    """The estimator is named for what it makes of the noise, the recording for its mistake."""
    runs = with_currents(clean, np.array([1.0, 0.51, 1.0]))
    found = diagnosed(small_truth, runs, method=method)
    by_ml = diagnosed(small_truth, runs)
    of_the_recording = [one for one in found if one.name != "estimators-disagree"]
    assert tuple(of_the_recording) == by_ml
