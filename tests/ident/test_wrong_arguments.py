"""Wrong arguments of a caller without a type checker:
each is refused with what was found, expected, and what to do.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.data.dataset import differentiate
from ident.data.run_channels import channels_of
from ident.estimators.refusals import unlikely_units
from tests.ident.arms import THREE_AXES
from tests.ident.recordings import MOUNTED, Truth, record

DRIVE_TRAIN = ident.DriveTrain(np.diag([40.0, 50.0, -45.0]))


@pytest.fixture(scope="module")
def short(small_truth: Truth) -> tuple[ident.Run, ident.Run]:
    """A run without load and one with, long enough for a fit."""
    rng = np.random.default_rng(7)
    bare = record(small_truth, "bare", rng, None)
    loaded = record(small_truth, "loaded", rng, MOUNTED)
    return bare, loaded


Change = Callable[[Any], Any]
lax: Any = ident  #: As a notebook sees it


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param(
            lambda r: replace(r, time_s=r.time_s.reshape(-1, 2)),
            r"'bare': time_s .*\(n_samples,\)",
            id="time of two columns",
        ),
        pytest.param(
            lambda r: replace(r, time_s=0.001),
            r"'bare': time_s has shape \(\); expected",
            id="a rate for the time",
        ),
        pytest.param(
            lambda r: replace(r, time_s=np.append(r.time_s[:-1], np.nan)),
            "time_s holds 1 .* sample 4999;",
            id="a gap in time",
        ),
        pytest.param(
            lambda r: replace(r, time_s=[[0.0], [0.1, 0.2]]),
            "'bare': time_s is no array of numbers.*expected",
            id="ragged time",
        ),
        pytest.param(
            lambda r: replace(r, time_s=r.time_s[:-9]),
            r"position_rad has shape \(\d+, 3\); expected.*one row",
            id="short time",
        ),
        pytest.param(
            lambda r: replace(r, position_rad=[[0.0] * 3, [0.1]]),
            "'bare': position_rad is no array",
            id="ragged positions",
        ),
        pytest.param(
            lambda r: replace(r, current_a=[["one", "two", "three"]]),
            "'bare': current_a is no array of numbers",
            id="words",
        ),
        pytest.param(
            lambda r: replace(r, position_rad=r.position_rad.T),
            r"\(3, \d+\); expected .* transpose it\?",
            id="transposed",
        ),
        pytest.param(
            lambda r: replace(r, current_a=r.current_a + 0.5j),
            "'bare': current_a is of complex numbers .* expected real ones; give their real part",
            id="complex currents",
        ),
        pytest.param(
            lambda r: replace(
                r,
                position_rad=np.ma.masked_array(
                    r.position_rad, r.time_s[:, None] * [1, 1, 1] > 9.0
                ),
            ),
            r"position_rad is a masked array with \d+ masked values; expected numbers; fill them",
            id="masked positions",
        ),
        pytest.param(
            lambda r: replace(
                r, current_a=np.array([[None, 1.0, "x"]] * len(r.time_s), dtype=object)
            ),
            "current_a is no array of numbers: it holds None of type NoneType; "
            "expected .* convert it",
            id="objects",
        ),
        pytest.param(
            lambda r: replace(r, current_a=r.current_a.astype(str)),
            "'bare': current_a is no array of numbers: its type is <U32",
            id="numbers as text",
        ),
        pytest.param(
            lambda r: replace(r, temperature_c=r.current_a + 0.5j),
            "'bare': temperature_c is of complex numbers",
            id="complex temperatures",
        ),
        pytest.param(
            lambda r: replace(r, position_rad=None),
            "'bare': position_rad .*expected",
            id="no position",
        ),
        pytest.param(
            lambda r: replace(r, valid=np.ones(len(r.time_s))),
            r"'bare': valid has shape .* expected \(",
            id="valid of samples",
        ),
        pytest.param(
            lambda r: replace(r, move=np.zeros(9)),
            r"'bare': move has shape \(9,\); expected \(\d+,\)",
            id="few moves",
        ),
        pytest.param(
            lambda r: replace(r, payload=4.0),
            "'bare' is of type float; expected Payload; write",
            id="a mass for the payload",
        ),
    ],
)
def test_identify_one_wrong_run_is_refused(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], change: Change, words: str
) -> None:
    bare, loaded = short
    wrong = change(bare)
    with pytest.raises(ident.IdentificationError, match=words):
        ident.identify(small_truth.model, [wrong, loaded], ident.Conditioning())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param(
            lambda r: replace(r, time_s=1000.0 * r.time_s),
            r"'bare': time_s has 4 s between samples; expected seconds, .* divide them by 1000",
            id="milliseconds",
        ),
        pytest.param(
            lambda r: replace(r, started_s="monday"),
            "started_s of 'bare' is 'monday' of type str; expected a finite number; leave it out",
            id="a date as the beginning",
        ),
        pytest.param(
            lambda r: replace(r, started_s=float("nan")),
            "started_s of 'bare' is nan; expected a finite number",
            id="NaN as the beginning",
        ),
        pytest.param(
            lambda r: replace(r, current_a=1e-200 * r.current_a),
            "'bare': current_a has .*e-2.. as the largest size on axis 1; expected amperes",
            id="currents whose squares vanish",
        ),
        pytest.param(
            lambda r: replace(r, current_a=1e200 * r.current_a),
            r"'bare': current_a has .*e\+2.. as the largest size on axis 1; expected amperes",
            id="currents whose squares overflow",
        ),
    ],
)
def test_identify_the_same_mistake_in_every_run_is_refused(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], change: Change, words: str
) -> None:
    runs = [change(run) for run in short]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ident.IdentificationError, match=words):
            ident.identify(small_truth.model, runs)


@pytest.mark.parametrize(
    "factors",
    [
        pytest.param(np.full(3, 180.0 / np.pi), id="degrees"),
        pytest.param(np.array([1.0, 180.0 / np.pi, 1.0]), id="degrees of one axis"),
        pytest.param(np.array([40.0, 50.0, -45.0]), id="angles of the motors"),
    ],
)
def test_angles_in_other_units_are_named_with_how_far_the_joint_turns(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], factors: FloatArray
) -> None:
    runs = []
    for run in short:
        position_rad = np.asarray(run.position_rad) * factors
        runs.append(replace(run, position_rad=position_rad))
    words = (
        r"axis q\d: found positions that move by \d+\.?\d* rad; expected at most 6 rad, the travel "
        r"of this joint in the URDF; are these degrees .*, or the motor's angle before the gear"
    )
    with pytest.raises(ident.IdentificationError, match=words):
        ident.identify(small_truth.model, runs)
    robot = small_truth.model.robot
    joints = tuple(replace(joint, travel=None) for joint in robot.joints)
    changed_robot = replace(robot, joints=joints)
    without_limits = replace(small_truth.model, robot=changed_robot)
    words = (
        r"found q\d turning by \d+\.?\d* rad in run '\w+'; expected a joint's angle in rad: "
        r"are these degrees"
    )
    with pytest.raises(ident.IdentificationError, match=words):
        ident.identify(without_limits, runs)


def test_a_range_or_current_of_a_robot_is_not_taken_for_other_units(
    small_truth: Truth, short: tuple[ident.Run, ident.Run]
) -> None:
    model = small_truth.model
    channels = []
    for run in short:
        data = differentiate(run, model.drive_train)
        channels.append(channels_of(model, data))
    axes = ("J1", "J2", "J3")
    assert unlikely_units(channels, model, axes) == ""

    in_milliamperes = []
    for one in channels:
        limits = 1000.0 * one.limits
        in_milliamperes.append(replace(one, limits=limits))
    found = unlikely_units(in_milliamperes, model, axes)
    assert "are these milliamperes" in found


Call = Callable[[Any, Any], Any]


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        pytest.param(
            "position_cutoff_hz", 0.0, "'bare': .*cut-off of 0 Hz; expected above", id="cut-off"
        ),
        pytest.param("decimation_cutoff_hz", -1, "of -1 Hz; expected", id="decimation"),
        pytest.param("position_cutoff_hz", float("nan"), "'bare': ", id="NaN"),
        pytest.param(
            "position_cutoff_hz",
            "40",
            "position_cutoff_hz of the conditioning is of type str; expected Real; give a number",
            id="cut-off of text",
        ),
        pytest.param(
            "standstill_share",
            None,
            "standstill_share of the conditioning is of type NoneType; expected Real",
            id="share of text",
        ),
        pytest.param(
            "position_order",
            2.5,
            "position_order of the conditioning is 2.5; expected a whole number",
            id="broken order",
        ),
        pytest.param(
            "position_order",
            0,
            "position_order of the conditioning is 0; expected 1 to 10; 4 is usual",
            id="order zero",
        ),
        pytest.param(
            "position_order",
            500,
            "position_order of the conditioning is 500; expected 1 to 10",
            id="order of hundreds",
        ),
    ],
)
def test_identify_a_wrong_setting_of_the_conditioning_is_refused(
    small_truth: Truth,
    short: tuple[ident.Run, ident.Run],
    setting: str,
    value: Any,
    words: str,
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ident.IdentificationError, match=words):
            lax.identify(small_truth.model, list(short), lax.Conditioning(**{setting: value}))


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        pytest.param(
            [30.0, 0.0, 20.0],
            r"fixed_gains is \[30.0, 0.0, 20.0\]; expected no zero",
            id="zero gain",
        ),
        pytest.param(
            [30.0, float("nan"), 20.0],
            "fixed_gains holds 1 .* sample 1; give numbers",
            id="NaN gain",
        ),
        pytest.param(
            30.0, r"fixed_gains has shape \(\); expected \(3,\), one per motor", id="a gain"
        ),
        pytest.param(
            ["a", "b", "c"], r"fixed_gains is no array of numbers.*expected \(3,\)", id="words"
        ),
    ],
)
def test_identify_wrong_fixed_gains_are_refused(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], gains: Any, words: str
) -> None:
    conditioning = ident.Conditioning()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ident.IdentificationError, match=words):
            ident.identify(small_truth.model, list(short), conditioning, fixed_gains=gains)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        pytest.param(
            lambda m, r: lax.identify(m, r[0], lax.Conditioning()),
            r"type Run; .* give a list: \[bare, load",
            id="one run",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, r, lax.Conditioning(), holdout=r[0]),
            "holdout .* give a list",
            id="one held out",
        ),
        pytest.param(
            lambda m, _: lax.identify(m, [], lax.Conditioning()),
            "^no run was given; expected one without load",
            id="no run",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, [r[0].time_s], lax.Conditioning()),
            "type ndarray; expected Run; write",
            id="arrays",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, r, 40.0),
            "type float; expected Conditioning; write Conditioning",
            id="a cut-off",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, [r[0], r[0]]),
            "'bare': found two runs of this name; expected another",
            id="one name",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, r, holdout=[r[1]]),
            "'loaded': found two runs of this name",
            id="held out, too",
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf(THREE_AXES.urdf, closures=[("loop", "a", "b", ("x",))]),
            r"an entry of closures is of type tuple; expected LinkPair; "
            r"write LinkPair\(name, first",
            id="a tuple for a closure",
        ),
        pytest.param(
            lambda *_: lax.Motion(None, [[0.0]], [[0.0]]),
            "position_rad of the motion is None; expected an arr",
            id="no motion",
        ),
        pytest.param(
            lambda m, r: lax.identify(m.robot, r, lax.Conditioning()),
            "type Robot; expected Model; write",
            id="no model",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, [replace(one, name=k) for k, one in enumerate(r)]),
            r"name of a run is of type int; expected str; write Run\('bare'",
            id="a number as the name of a run",
        ),
        pytest.param(
            lambda m, r: differentiate(replace(r[0], name=None), m.drive_train),
            "name of a run is of type NoneType; expected str",
            id="no name of one run",
        ),
        pytest.param(
            lambda *_: lax.DriveTrain(np.zeros((0, 0))), r"found shape \(0, 0\)", id="no ratio"
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf("\ud800"),
            "looks like a file name; expected text|the URDF cannot be read",
            id="half a character",
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf("<robot name='\ud800'/>"),
            "the URDF cannot be read: .*surrogates not allowed; expected XML",
            id="half a character in a URDF",
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf(None),
            "the URDF is of type NoneType; expected text: pass Path",
            id="no URDF",
        ),
        pytest.param(
            lambda *_: lax.Payload("disc", "flange", {"m": True}),
            r"known\['m'\] is True; expected a number; give numbers in SI units",
            id="a truth value as a mass",
        ),
        pytest.param(
            lambda m, r: lax.identify(m, r, lax.Conditioning(), method="foo"),
            "'foo'; expected one of ls, wls",
            id="method",
        ),
        pytest.param(
            lambda *_: lax.Payload("disc", "flange", 4.0),
            "known is of type float; expected dict; write",
            id="a mass",
        ),
        pytest.param(
            lambda *_: lax.Payload("disc", "flange", {"m": "4"}),
            r"known\['m'\] is of type str; .* SI units",
            id="text",
        ),
        pytest.param(
            lambda *_: lax.Model(THREE_AXES.urdf, DRIVE_TRAIN),
            r"type str; expected Robot; .*robot_from_urdf\(",
            id="URDF",
        ),
        pytest.param(
            lambda m, _: lax.Model(m.robot, np.diag([40.0] * 3)),
            r"ndarray; expected DriveTrain; .*np.diag\(",
            id="ratios",
        ),
        pytest.param(
            lambda *_: lax.DriveTrain([100, -50]),
            r"found shape \(2,\); write np.diag\(gear_ratios",
            id="vector",
        ),
        pytest.param(
            lambda *_: lax.DriveTrain([[1.0], [1.0, 2.0]]),
            "the drive train is no array of numbers.*expected",
            id="ragged",
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf("robot.urdf"),
            r"looks like a file name; .* pass Path\(...\).read_te",
            id="file name",
        ),
        pytest.param(
            lambda *_: lax.robot_from_urdf(Path("robot.urdf")),
            "'robot.urdf'.* looks like a file name; expected",
            id="path",
        ),
        pytest.param(
            lambda *_: lax.planned(lax.Motion([["a"]], [[0.0]], [[0.0]]), 9.0),
            "position_rad of the motion is no array of",
            id="plan",
        ),
    ],
)
def test_an_argument_of_another_kind_is_refused(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], call: Call, words: str
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ident.IdentificationError, match=words):
            call(small_truth.model, list(short))


def test_runs_of_different_logs_may_have_one_name(
    small_truth: Truth, short: tuple[ident.Run, ident.Run]
) -> None:
    """Sessions in folders of their own give their logs the same names."""
    bare, loaded = short
    digest = "b" * 64
    changed_loaded = replace(loaded, name=bare.name, digest=digest)
    changed_bare = replace(bare, digest="a" * 64)
    of_logs = [changed_bare, changed_loaded]
    same = ident.identify(small_truth.model, of_logs)
    expected = ident.identify(small_truth.model, short)
    assert np.array_equal(same.estimate.gains, expected.estimate.gains)


def test_a_recording_that_is_given_twice_is_refused_with_both_roles(
    small_truth: Truth, short: tuple[ident.Run, ident.Run]
) -> None:
    """It would count twice, be held out of nothing, or be without load and loaded at once."""
    bare, loaded = short
    again = replace(bare, name="again")
    as_loaded = replace(again, payload=loaded.payload)
    remedy = r"expected each recording once, .*; leave one of the two out"
    first = r"as in run 'bare', without load"
    words = rf"run 'again': found the same samples, without load, {first}; {remedy}"
    model = small_truth.model
    with pytest.raises(ident.DataUnfit, match=words):
        ident.identify(model, [bare, again, loaded])
    with pytest.raises(ident.DataUnfit, match=words):
        ident.identify(model, short, holdout=[again])
    words = rf"with payload 'disc', {first}; {remedy}"
    with pytest.raises(ident.DataUnfit, match=words):
        ident.identify(model, [bare, as_loaded])


def test_one_recording_may_be_split_into_fit_and_hold_out_by_its_valid_samples(
    small_truth: Truth, short: tuple[ident.Run, ident.Run]
) -> None:
    bare, loaded = short
    is_first = np.zeros(bare.position_rad.shape, dtype=bool)
    count = len(bare.time_s)
    is_first[: count * 2 // 3] = True
    of_fit = replace(bare, valid=is_first)
    held_out = replace(bare, name="the rest", valid=~is_first)
    model = small_truth.model
    found = ident.identify(model, [of_fit, loaded], holdout=[held_out])
    assert found.holdout is not None


@pytest.mark.slow
def test_a_method_may_be_named(small_truth: Truth, short: tuple[ident.Run, ident.Run]) -> None:
    model = small_truth.model
    conditioning = ident.Conditioning()
    for method in ident.Method:
        found = ident.identify(model, short, conditioning, method=method.value)
        assert found.estimate.method is method


def test_several_runs_are_named_one_by_one(
    small_truth: Truth, short: tuple[ident.Run, ident.Run]
) -> None:
    still = []
    for run in short:
        position_rad = run.position_rad * [1.0, 0.0, 1.0]
        still.append(replace(run, position_rad=position_rad))
    with pytest.raises(ident.DataUnfit, match=r"^runs bare, loaded: axis q1: found q1 never moves"):
        ident.identify(small_truth.model, still, ident.Conditioning())


def test_lists_and_arrays_of_objects_or_without_a_masked_value_are_as_good(
    short: tuple[ident.Run, ident.Run],
) -> None:
    run = short[0]
    train = DRIVE_TRAIN
    expected = ident.differentiate(run, train)
    values = np.asarray(run.current_a)
    without_mask = np.ma.masked_array(values)
    of_objects = values.astype(object)
    lists = values.tolist()
    for current_a in (without_mask, of_objects, lists):
        changed_run = replace(run, current_a=current_a)
        same = ident.differentiate(changed_run, train)
        assert np.array_equal(same.current_a, expected.current_a)


@pytest.fixture(scope="module")
def arguments(small_truth: Truth, short: tuple[ident.Run, ident.Run]) -> dict[str, Any]:
    """Right arguments of the public functions, by their names."""
    model = small_truth.model
    conditioning = ident.Conditioning()
    found = ident.identify(model, short, conditioning)
    gains = found.estimate.gains
    axes = ("J1", "J2", "J3")
    calibration = ident.calibration_of(found, axes, gains)
    bare, loaded = short
    data = ident.differentiate(bare, model.drive_train)
    motion = data.motion()
    rng = np.random.default_rng(0)
    return {
        "calibration": calibration,
        "model": model,
        "data": data,
        "run": bare,
        "runs": short,
        "loaded": (loaded,),
        "quiet": (bare,),
        "current_a": bare.current_a,
        "found": found,
        "axes": axes,
        "nameplate": gains,
        "motion": motion,
        "rate_hz": 500.0,
        "drive_train": model.drive_train,
        "conditioning": conditioning,
        "instants": found.instants,
        "gains": gains,
        "start": None,
        "rng": rng,
    }


FUNCTIONS = (
    "predict_torque",
    "predict_current",
    "measured_torque",
    "weigh",
    "external_torque",
    "prediction_band",
    "calibration_of",
    "planned",
    "differentiate",
    "identify",
    "diagnose",
    "exchanged_channels",
    "find_turned_geometry",
    "find_effects",
    "gather",
)
COMPLEX = 1j * np.ones((4, 3))
WRONG_VALUES: tuple[Any, ...] = (3.5, "words", object(), {"a": 1}, ["x", "y"], COMPLEX)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_no_public_function_has_a_traceback_for_an_argument_of_another_type(
    arguments: dict[str, Any], function: str
) -> None:
    called = getattr(lax, function)
    if function == "gather":
        needed = ["found", "runs"]
    else:
        parameters = inspect.signature(called).parameters.values()
        needed = [one.name for one in parameters if one.default is one.empty]
    right = [arguments[name] for name in needed]
    for place, name in enumerate(needed):
        for value in WRONG_VALUES:
            if name == "rate_hz" and isinstance(value, float):
                continue  # it is one
            wrong = list(right)
            wrong[place] = value
            with pytest.raises(ident.IdentificationError, match="expected"):
                called(*wrong)


def test_a_run_in_the_place_of_data_or_of_a_band_is_named(arguments: dict[str, Any]) -> None:
    calibration = arguments["calibration"]
    model = arguments["model"]
    run = arguments["run"]
    with pytest.raises(
        ident.ModelError,
        match=r"loaded of weigh is of type Run; expected Iterable; give .*loaded=",
    ):
        lax.weigh(calibration, model, run)
    with pytest.raises(
        ident.ModelError, match="data of predict_torque is of type Run; expected Dataset"
    ):
        lax.predict_torque(calibration, model, run)
    with pytest.raises(
        ident.ModelError, match="conditioning of external_torque is of type Run; expected Cond"
    ):
        lax.external_torque(calibration, model, run, run)


@pytest.mark.parametrize(
    ("axes", "nameplate", "words"),
    [
        ("abc", [1.0, 1.0, 1.0], "axes is the text 'abc'; expected a list of names"),
        ([1, 2, 3], [1.0, 1.0, 1.0], "an entry of axes is of type int; expected str"),
        (
            ["J1", "J1", "J2"],
            [1.0, 1.0, 1.0],
            "axes are J1, J1, J2; expected another name for each",
        ),
        (
            ["J1", "J2", "J3"],
            [1.0, 0.0, 1.0],
            r"nameplate is \[1.0, 0.0, 1.0\]; expected .* none "
            r"of them zero",
        ),
        (["J1", "J2", "J3"], [[1.0], [1.0], [1.0]], "nameplate is .*expected one gain per axis"),
    ],
)
def test_a_calibration_of_odd_axes_is_refused(
    arguments: dict[str, Any], axes: Any, nameplate: Any, words: str
) -> None:
    with pytest.raises(ident.ModelError, match=words):
        ident.calibration_of(arguments["found"], axes, nameplate)


def test_the_tolerance_of_a_payloads_mass_is_that_of_a_cell_file(
    small_truth: Truth, short: tuple[ident.Run, ident.Run], arguments: dict[str, Any]
) -> None:
    model = small_truth.model
    axes = arguments["axes"]
    nameplate = arguments["nameplate"]
    exact_calibration = arguments["calibration"]
    bare, loaded = short
    declared = replace(MOUNTED, mass_tolerance_kg=0.02)
    with_tolerance = replace(loaded, payload=declared)
    found = ident.identify(model, [bare, with_tolerance], ident.Conditioning())
    calibration = ident.calibration_of(found, axes, nameplate)
    # What `daq.calibration_of` does with `mass_tolerance_kg` of the cell file
    payload_mass = exact_calibration.payload_mass
    by_cell_file = [one.weighed_to(0.02) for one in payload_mass]
    assert list(calibration.payload_mass) == by_cell_file
    gains = calibration.payload_mass[0].gains
    assert gains[1].tolerance_std > 0.0
    body = ident.weigh(calibration, model, [loaded])
    assert body.mass_reference_std_kg == pytest.approx(0.02, rel=0.1)
    exact = ident.weigh(exact_calibration, model, [loaded])
    assert exact.mass_reference_std_kg == 0.0


@pytest.mark.parametrize(
    ("function", "given", "words"),
    [
        ("find_effects", ("evidence",), r"missing a required argument: 'rng'; .*\(start, rng, \["),
        ("identify", ("model",), r"missing a required argument: 'runs'; .*identify\(model, runs, "),
        ("calibration_of", ("found",), r"missing .*'axes'; .*\(found, axes, nameplate, \[units"),
        ("plan_moves", ("model",), "missing .*'limits'; expected plan_moves"),
        ("robot_from_urdf", (), "missing .*'urdf'; expected robot_from_urdf"),
        ("gather", ("found",), r"given no runs; .*write gather\(found, \[bare, loaded\]\)"),
    ],
)
def test_a_call_that_lacks_arguments_names_them_all(
    arguments: dict[str, Any], function: str, given: tuple[str, ...], words: str
) -> None:
    values = [arguments.get(name) for name in given]
    with pytest.raises(ident.ModelError, match=words):
        getattr(lax, function)(*values)


def test_an_argument_that_does_not_exist_is_named(arguments: dict[str, Any]) -> None:
    with pytest.raises(ident.ModelError, match="unexpected keyword argument 'effects'; expected"):
        lax.calibration_of(arguments["found"], ("J1",), [1.0], effects=[])


def test_a_seed_in_the_place_of_a_generator_and_one_effect_are_corrected(
    arguments: dict[str, Any],
) -> None:
    evidence = ident.gather(arguments["found"], arguments["runs"])
    with pytest.raises(ident.ModelError, match=r"write rng=np\.random\.default_rng\(0\)"):
        lax.find_effects(evidence, 0)
    rng = np.random.default_rng(0)
    one = ident.planned  # anything that is no list
    with pytest.raises(ident.ModelError, match=r"give a list, with one .*: own_effects=\["):
        lax.find_effects(evidence, rng, own_effects=one)
    with pytest.raises(ident.ModelError, match="axes is the text 'ab'; expected a list of names"):
        lax.find_effects(evidence, rng, axes="ab")
    with pytest.raises(ident.ModelError, match="axes has 1 names; expected"):
        lax.find_effects(evidence, rng, axes=["J1"])
    with pytest.raises(ident.ModelError, match="axes is the text 'ab'; expected a list of names"):
        lax.identify(evidence.model, arguments["runs"], axes="ab")


def _carrying(run: Any, payload: Any) -> Any:
    return replace(run, name=f"{run.name} again", payload=payload)


def test_runs_that_are_not_those_of_the_fit_are_refused_by_gather(
    arguments: dict[str, Any],
) -> None:
    found = replace(arguments["found"], gathered=None)
    bare, loaded = arguments["runs"]
    words = rf"was given {bare.name}; expected the runs of the"
    with pytest.raises(ident.ModelError, match=words):
        ident.gather(found, [bare])
    with pytest.raises(ident.ModelError, match="gather was given no runs; expected the runs of"):
        ident.gather(found)
    renamed = replace(loaded, name="yesterday")
    words = rf"was given {bare.name}, yesterday; expected"
    with pytest.raises(ident.ModelError, match=words):
        ident.gather(found, [bare, renamed])
    held_out = replace(bare, name="held out")
    with pytest.raises(ident.DataUnfit, match="found the same samples, without load, as in run"):
        ident.gather(found, [bare, loaded], [held_out])


def test_a_held_out_run_with_another_payload_is_refused_by_gather(
    arguments: dict[str, Any],
) -> None:
    found = replace(arguments["found"], gathered=None)
    bare, loaded = arguments["runs"]
    mounted = loaded.payload
    position_rad = loaded.position_rad + 0.01
    shifted = replace(loaded, position_rad=position_rad)
    to_wall = replace(mounted, mounting="wall")
    on_wall = _carrying(shifted, to_wall)
    with pytest.raises(ident.DataUnfit, match="held out with mounting 'wall', which no run of the"):
        ident.gather(found, [bare, loaded], [on_wall])
    mass_kg = 2.0 * mounted.known["m"]
    heavy = replace(mounted, known={"m": mass_kg})
    heavier = _carrying(shifted, heavy)
    words = f"mounting {mounted.mounting!r} carries"
    with pytest.raises(ident.DataUnfit, match=words):
        ident.gather(found, [bare, loaded], [heavier])


@pytest.mark.parametrize("rates_hz", ["500", [0.0], [-1.0], [np.nan], [None], 500.0, [np.inf]])
def test_sampling_rates_that_are_none_are_refused(rates_hz: Any) -> None:
    with pytest.raises(ident.ModelError, match=r"rates_hz is .*; give a list of sampling rates"):
        ident.Conditioning.for_rates(rates_hz)


@pytest.mark.parametrize(
    "changed",
    [
        {"position_order": "four"},
        {"position_order": np.nan},
        {"decimation_cutoff_hz": None},
        {"standstill_share": True},
        {"standstill_rad_s": ["slow"]},
    ],
)
def test_settings_of_a_filter_that_are_no_numbers_are_refused(changed: dict[str, Any]) -> None:
    right = ident.Conditioning().document()
    document = {**right, **changed}
    (setting,) = changed
    with pytest.raises(ident.ModelError, match=f"{setting} of the .* is "):
        ident.Conditioning.of_document(document)


@pytest.mark.parametrize("name", ["lower", "upper", "velocity", "acceleration"])
def test_limits_that_no_robot_has_are_refused(arguments: dict[str, Any], name: str) -> None:
    ones = np.ones(3)
    limits = {"lower": -ones, "upper": ones, "velocity": ones, "acceleration": 2.0 * ones}
    sign = -1.0 if name == "lower" else 1.0
    limits[name] = sign * 1e300 * ones
    joint_limits = ident.JointLimits(**limits)
    words = rf"limits\.{name} has .*; expected at most 1e\+30"
    with pytest.raises(ident.ModelError, match=words):
        _planned(arguments, limits=joint_limits)


def test_a_gain_of_zero_is_refused_before_the_geometry_is_judged(
    arguments: dict[str, Any],
) -> None:
    model = arguments["model"]
    instants = arguments["found"].instants
    with pytest.raises(ident.ModelError, match=r"gains is \[0.0, 1.0, 2.0\]; expected no zero"):
        ident.find_turned_geometry(model, instants, [0, 1, 2])


def test_gains_by_name_are_told_how_to_become_a_list(arguments: dict[str, Any]) -> None:
    robot = arguments["model"].robot
    axes = [joint.name for joint in robot.axes]
    by_name = dict.fromkeys(axes, 1.0)
    with pytest.raises(
        ident.ModelError, match=r"nameplate is a dictionary .*write \[nameplate\[name\] for name in"
    ):
        lax.calibration_of(arguments["found"], axes, by_name)
    with pytest.raises(ident.ModelError, match=r"write \[fixed_gains\[name\] for name in axes"):
        lax.identify(arguments["model"], arguments["runs"], fixed_gains=by_name)


def _planned(arguments: dict[str, Any], **changed: Any) -> Any:
    """A plan without tries, with some arguments changed."""
    ones = np.ones(3)
    model = arguments["model"]
    limits = ident.JointLimits(-ones, ones, ones, 2.0 * ones)
    nameplate = 20.0 * ones
    usual = {
        "model": model,
        "limits": limits,
        "payload": MOUNTED,
        "nameplate": nameplate,
        "urdf": THREE_AXES.urdf,
        "duration_s": 30.0,
        "exchanges": 0,
    }
    usual.update(changed)
    return lax.plan_moves(**usual)


def _with_joint(arguments: dict[str, Any], **changed: Any) -> ident.Model:
    """The model with another second joint, as it is made by hand."""
    robot = arguments["model"].robot
    first, second, third = robot.joints
    joints = (first, replace(second, **changed), third)
    return ident.Model(replace(robot, joints=joints), DRIVE_TRAIN)


def _searched(arguments: dict[str, Any], **changed: Any) -> Any:
    """A search for effects, with an argument that ends it before it begins."""
    evidence = ident.gather(arguments["found"], arguments["runs"])
    usual = {"start": evidence, "rng": np.random.default_rng(0)}
    return lax.find_effects(**{**usual, **changed})


def _external(arguments: dict[str, Any], **changed: Any) -> Any:
    """External torque with a band of which some numbers are changed."""
    ones = np.ones(3)
    scale = np.ones((3, 4))
    band = ident.Band(
        scale=scale,
        factor=ones,
        threshold=ones,
        correlation_s=ones,
        quiet_s=ones,
        alarms_per_hour=1.0,
    )
    changed_band = replace(band, **changed)
    calibration = arguments["calibration"]
    model = arguments["model"]
    run = arguments["run"]
    return ident.external_torque(calibration, model, run, band=changed_band)


def _predicted(arguments: dict[str, Any], **changed: Any) -> FloatArray:
    """A prediction by a calibration of which some parts are changed."""
    calibration = replace(arguments["calibration"], **changed)
    data = ident.planned(arguments["motion"], 500.0)
    return ident.predict_current(calibration, arguments["model"], data)


def _turned(arguments: dict[str, Any], **changed: Any) -> Any:
    """A judgement of the geometry by rows of which some are changed."""
    model = arguments["model"]
    gains = arguments["gains"]
    instants = replace(arguments["instants"][0], **changed)
    return ident.find_turned_geometry(model, [instants], gains)


WITH_ROBOT = lax.robot_from_urdf


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (
            lambda _: lax.Payload(3.5, "flange"),
            "name of a payload is of type float; expected str; write Payload",
        ),
        (
            lambda _: lax.Payload("disc", None),
            "mounting of payload 'disc' is of type NoneType; expected str",
        ),
        (
            lambda _: lax.Payload("disc", "flange", {"m": 10**400}),
            "has m = inf; expected finite numbers",
        ),
        (
            lambda _: lax.Payload("disc", "flange", {"m": 4.0}, mass_tolerance_kg=True),
            "mass_tolerance_kg is True; expected a number",
        ),
        (
            lambda a: lax.Model(a["model"].robot, DRIVE_TRAIN, friction_by_payload="no"),
            "friction_by_payload is of type str; expected bool; give True or False",
        ),
        (
            lambda a: a["model"].regressor(np.zeros((9, 3))),
            "motion is of type ndarray; expected Motion; write Motion",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, (0.0, -9.81)),
            r"gravity_m_s2 has shape \(2,\); expected \(3,\), in the base frame",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, ("0", "0", "down")),
            "gravity_m_s2 is no array of numbers",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, closures=None),
            "closures is of type NoneType; expected Iterable; write LinkPair",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, closures={"loop": 1}),
            "closures is of type dict; expected a list; write LinkPair",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, motors="q0"),
            r"motors is the text 'q0'; expected a list of names; write \['q0'\]",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, motors=[1]),
            "an entry of motors is of type int; expected str",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, motors=["q9"]),
            "motors names joint 'q9'; expected one of the URDF's moving joints: q0, q1, q2",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, assembly_rad=["q0"]),
            "assembly_rad is of type list; expected Mapping; write",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, assembly_rad={"q0": float("nan")}),
            r"assembly_rad\['q0'\] is nan; expected a finite number",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, platform=["link2"]),
            "platform is of type list; expected str; give the name of a link",
        ),
        (
            lambda _: WITH_ROBOT(THREE_AXES.urdf, closures=[lax.LinkPair("a", 1, "link2", "x")]),
            "first link of closure 'a' is of type int; expected str",
        ),
        (
            lambda _: WITH_ROBOT(
                THREE_AXES.urdf, closures=[lax.LinkPair("a", "link0", "link2", "xy")]
            ),
            "directions of closure 'a' is the text 'xy'; expected a list",
        ),
        (
            lambda a: _with_joint(a, kind="revolute"),
            "kind of joint 'q1' is of type str; expected JointKind",
        ),
        (
            lambda a: _with_joint(a, parent=1),
            "parent of joint 'q1' is 1; expected a whole number from -1 to 0",
        ),
        (
            lambda a: _with_joint(a, axis=np.array([0.0, 2.0, 0.0])),
            "axis of joint 'q1' has the length 2; expected a unit vector",
        ),
        (
            lambda a: _with_joint(a, rotation=np.eye(4)),
            r"rotation of joint 'q1' has shape \(4, 4\); expected \(3, 3\)",
        ),
        (
            lambda a: ident.Model(replace(a["model"].robot, motors=(0, 1, 7)), DRIVE_TRAIN),
            "an entry of motors is 7; expected a whole number from 0 to 2",
        ),
        (
            lambda a: ident.Model(replace(a["model"].robot, joints=None), DRIVE_TRAIN),
            "joints of the robot is of type NoneType; expected Sequence",
        ),
        (
            lambda a: _planned(a, conditioning=lax.Conditioning(position_cutoff_hz="40")),
            "position_cutoff_hz of the conditioning is of type str",
        ),
        (
            lambda a: _planned(a, conditioning=lax.Conditioning(decimation_cutoff_hz=0.0)),
            "cut-off of 0 Hz; expected above 0 Hz",
        ),
        (
            lambda a: _planned(a, duration_s=10**400),
            "duration_s is inf; expected a finite number",
        ),
        (
            lambda a: _planned(a, nameplate=[10**400] * 3),
            "nameplate is no array of numbers",
        ),
        (
            lambda a: lax.diagnose(a["found"], a["axes"], effort_limit=[1.0]),
            r"effort_limit has shape \(1,\); expected \(3,\), one per axis",
        ),
        (
            lambda a: lax.diagnose(a["found"], a["axes"], effort_limit=[1.0, np.nan, 1.0]),
            "effort_limit is .*; expected no number below zero; give inf",
        ),
        (
            lambda a: lax.identify(a["model"], a["runs"], judge="no"),
            "judge of identify is of type str; expected bool",
        ),
        (
            lambda a: lax.identify(a["model"], a["runs"], method=np.ones(2)),
            "method of identify is of type ndarray; expected Method or str",
        ),
        (
            lambda a: lax.calibration_of(a["found"], a["axes"], a["nameplate"], steps=["x"]),
            "an entry of steps is of type str; expected Step",
        ),
        (
            lambda a: _searched(a, gates=ident.Gates(false_alarm=3.5)),
            "false_alarm of the gates is 3.5; expected a share from 0 to 1; 0.01 is usual",
        ),
        (
            lambda a: _searched(a, gates=lax.Gates(draws=9.5)),
            "draws of the gates is 9.5; expected a whole number",
        ),
        (
            lambda a: _searched(a, gates=ident.Gates(draws=50)),
            "draws of the gates is 50, .* false_alarm is 0.01; expected at least 99 draws; 999 is",
        ),
        (
            lambda a: _searched(a, progress="print"),
            "progress is of type str; expected a function of one text; write progress=print",
        ),
        (
            lambda a: _searched(a, families=(1,)),
            "an entry of families is of type int; expected Sequence; leave it out",
        ),
        (
            lambda a: _searched(a, mistakes=["x"]),
            "an entry of mistakes is of type str; expected Finding; leave it out",
        ),
        (
            lambda a: lax.accept_on_holdout(
                ident.gather(a["found"], a["runs"]), ["x"], progress=print
            ),
            "an entry of steps is of type str; expected Step",
        ),
        (
            lambda a: _external(a, scale=np.ones((2, 4))),
            r"scale of the band has shape \(2, 4\); expected \(3, 4\), one row per joint",
        ),
        (
            lambda a: _predicted(a, gains=["x"]),
            "an entry of gains of the calibration is of type str; expected Gain",
        ),
        (
            lambda a: _predicted(a, gains=[replace(a["calibration"].gains[0], value=np.nan)] * 3),
            "has the gain of J1 nan; expected a number",
        ),
        (
            lambda a: _predicted(a, effects=None),
            "effects of the calibration is of type NoneType; expected Iterable; take it from",
        ),
        (
            lambda a: _turned(a, current_a=np.ones((2, 2))),
            r"current_a of the instants has shape \(2, 2\); expected \(3, ",
        ),
        (
            lambda a: lax.GrowingFit(a["model"], None, ()).with_run(a["run"]),
            "conditioning is of type NoneType; expected Conditioning; write Conditioning",
        ),
        (
            lambda a: lax.GrowingFit(a["model"], a["conditioning"], "disc").with_run(a["run"]),
            "payloads is of type str; expected a list; give a tuple of the payloads",
        ),
        (
            lambda a: ident.GrowingFit(a["model"], a["conditioning"], ()).with_run(lax),
            "run is of type module; expected Run; write Run",
        ),
    ],
)
def test_a_wrong_value_inside_a_public_object_is_refused_by_name(
    arguments: dict[str, Any], use: Change, words: str
) -> None:
    with pytest.raises(ident.IdentificationError, match=words):
        use(arguments)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("payload", 4.0, "payload of 'bare' is of type float; expected Payload; write"),
        ("digest", ["x"], "digest of 'bare' is of type list; expected str"),
        ("partial", "no", "partial of 'bare' is of type str; expected bool"),
        ("recording", "log", "recording of 'bare' is of type str; expected Recording"),
        ("torque_channels", 1, "torque_channels of 'bare' is of type int; expected"),
        ("judged_channels", True, "judged_channels of 'bare' is of type bool; expected"),
    ],
)
def test_a_field_of_a_run_that_is_no_array_is_refused_wherever_the_run_is_used(
    arguments: dict[str, Any], field: str, value: Any, words: str
) -> None:
    wrong = replace(arguments["run"], **{field: value})
    model = arguments["model"]
    with pytest.raises(ident.ModelError, match=words):
        ident.differentiate(wrong, model.drive_train)
    with pytest.raises(ident.ModelError, match=words):
        ident.identify(model, [wrong, *arguments["loaded"]])


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("decimation_cutoff_hz", float("nan"), "cut-off of nan Hz; expected above 0 Hz"),
        ("current_cutoff_hz", float("nan"), "cut-off of nan Hz; expected above 0 Hz"),
        ("current_cutoff_hz", float("inf"), "cut-off of inf Hz; expected above 0 Hz, and finite"),
        ("standstill_share", 3.5, "standstill_share of the conditioning is 3.5; expected 0 to 1"),
        ("position_cutoff_hz", True, "position_cutoff_hz of the conditioning is True; expected a"),
        ("standstill_rad_s", 0.03, "standstill_rad_s .* is of type float; expected a tuple"),
        ("standstill_rad_s", (0.03, -1.0, 0.03), "entry 2 of standstill_rad_s .* is -1; expected"),
        ("standstill_rad_s", (0.03, "x", 0.03), "entry 2 of standstill_rad_s .* of type str"),
    ],
)
def test_a_setting_of_the_conditioning_that_is_no_number_of_its_range_is_refused(
    arguments: dict[str, Any], setting: str, value: Any, words: str
) -> None:
    conditioning = lax.Conditioning(**{setting: value})
    with pytest.raises(ident.IdentificationError, match=words):
        ident.differentiate(arguments["run"], arguments["drive_train"], conditioning)
