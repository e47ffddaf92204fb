"""`import ident` is enough: its names, its weight, the lines of its docstring, and the examples."""

from __future__ import annotations

import ast
import inspect
import runpy
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray

EXAMPLES = Path(__file__).parents[2] / "examples"
AXES = ("J1", "J2", "J3")
ARRAYS = ("time_s", "position_rad", "current_a")


@pytest.fixture(scope="module")
def example() -> SimpleNamespace:
    """Names of the first example."""
    names = runpy.run_path(str(EXAMPLES / "gains_from_arrays.py"))
    return SimpleNamespace(**names)


def _model(example: SimpleNamespace) -> ident.Model:
    robot = ident.robot_from_urdf(example.URDF)
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    return ident.Model(robot, drive_train)


def _two_runs(example: SimpleNamespace, model: ident.Model) -> list[ident.Run]:
    """Without a payload, and with the disc."""
    bare = example.record(model, "bare", None, 1)
    loaded = example.record(model, "loaded", example.DISC, 2)
    return [bare, loaded]


def _calibration(example: SimpleNamespace, found: ident.Identification) -> ident.Calibration:
    return ident.calibration_of(found, AXES, example.NAMEPLATE_NM_A)


def _check_gains(example: SimpleNamespace, found: ident.Identification) -> None:
    """The gains are the true ones, within their σ."""
    error = np.abs(found.estimate.gains - example.TRUE_GAINS_NM_A)
    limit = 4.0 * found.estimate.gains_std
    assert np.all(error < limit)


def _of_mass(name: str, mass_kg: float) -> ident.Payload:
    return ident.Payload(name, mounting="flange", known={"m": mass_kg})


def _check_predicted(
    calibration: ident.Calibration, model: ident.Model, motion: ident.Dataset
) -> None:
    torque_nm = ident.predict_torque(calibration, model, motion)
    assert np.isfinite(torque_nm).all()


def test_every_name_is_there() -> None:
    for name in ident.__all__:
        if name != "FloatArray":  # an alias, which has no name of its own
            assert getattr(ident, name).__name__ == name
    listed = set(dir(ident))
    assert set(ident.__all__) <= listed
    misspelt = "identfy"
    with pytest.raises(AttributeError, match=r"no attribute 'identfy'; it exports .*identify"):
        getattr(ident, misspelt)


def test_every_error_has_one_root() -> None:
    assert issubclass(ident.DataUnfit, ident.IdentificationError)


def test_importing_it_brings_nothing_along() -> None:
    words = (
        "import sys, ident; print([m for m in ('numpy', 'scipy', 'ident.model') if m in "
        "sys.modules])"
    )
    command = [sys.executable, "-c", words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_from_arrays_to_gains_in_ten_lines(
    example: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    documentation = ident.__doc__ or ""
    lines = [line[4:] for line in documentation.splitlines() if line.startswith("    ")]
    assert len(lines) <= 10
    model = _model(example)
    bare = example.record(model, "x", None, 0)
    loaded = example.record(model, "x", example.DISC, 1)
    given = {
        "np": np,
        "urdf_text": example.URDF,
        "gear_ratios": example.GEAR_RATIOS,
    }
    for name in ARRAYS:
        given[name] = getattr(bare, name)
        given[f"{name}_2"] = getattr(loaded, name)

    exec("\n".join(lines), given)  # noqa: S102 - the documented lines themselves are what is tested

    found = given["found"]
    assert isinstance(found, ident.Identification)
    _check_gains(example, found)
    printed = capsys.readouterr().out
    assert printed.count("[") == 2


def test_the_example_finds_the_gains(
    example: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    found = example.main()
    _check_gains(example, found)
    printed = capsys.readouterr().out
    assert printed.count("±") == 3


def test_the_calibration_predicts_a_run_that_the_fit_has_not_seen(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = _calibration(example, found)
    run = example.record(found.model, "another", example.DISC, 9)
    data = ident.differentiate(run, found.model.drive_train, found.conditioning)
    predicted = ident.predict_current(calibration, found.model, data)
    predicted_difference = predicted - data.current_a
    rest = predicted_difference[data.moving.all(axis=1)]
    shape = (len(run.time_s) - 2, 3)
    assert predicted.shape == data.current_a.shape == shape
    # The noise of the recording is 0.05 A; filtering the positions changes the direction of dry
    # friction for a moment.
    mean_square_rest = np.mean(rest**2, axis=0)
    rms_rest = np.sqrt(mean_square_rest)
    assert np.all(rms_rest < 0.08)
    mean_square_current = np.mean(data.current_a**2, axis=0)
    rms_current_a = np.sqrt(mean_square_current)
    assert np.all(rms_current_a > 0.3)


def test_a_calibration_needs_one_name_an_axis(example: SimpleNamespace) -> None:
    found = example.main()
    with pytest.raises(
        ident.ModelError, match="2 axis names, 3 nameplate gains and 2 units for 3 identified"
    ):
        ident.calibration_of(found, ("J1", "J2"), example.NAMEPLATE_NM_A)


def test_currents_are_predicted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    path = str(EXAMPLES / "predict_current.py")
    runpy.run_path(path, run_name="__main__")
    out = capsys.readouterr().out
    lines = [line for line in out.splitlines() if "largest currents" in line]
    currents_a = []
    for line in lines:
        _, currents = line.split("currents ")
        second = currents.split(", ")[1]
        currents_a.append(float(second.removesuffix(" A")))
    # Raising the disc costs motor 2 at least its weight at a hand's breadth.
    bare_a, loaded_a = currents_a
    assert loaded_a > bare_a + 0.2


def _slow_motion(axes: int = 3, samples: int = 200) -> ident.Motion:
    time_s = np.arange(samples) / 100.0
    phase = time_s[:, None] + np.arange(axes)
    position = np.sin(phase)
    velocity = np.cos(phase)
    return ident.Motion(position, velocity, -position)


def test_a_misspelt_parameter_of_a_payload_is_refused() -> None:
    with pytest.raises(
        ident.ModelError,
        match=r"'disc'.* 'mass'; expected names among .*mz, m; "
        r"write .*'m': 4.59",
    ):
        ident.Payload("disc", mounting="flange", known={"mass": 4.59})


def test_a_payload_of_another_mass_is_not_predicted(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = _calibration(example, found)

    heavier = _of_mass("disc", 6.0)
    motion = ident.planned(_slow_motion(), 100.0, heavier)
    with pytest.raises(ident.DataUnfit, match=r"weighs 6 kg; expected 4.59 kg as in the fit"):
        ident.predict_current(calibration, found.model, motion)

    weighed_again = _of_mass("disc", 4.595)
    motion = ident.planned(_slow_motion(), 100.0, weighed_again)
    current_a = ident.predict_current(calibration, found.model, motion)
    assert np.isfinite(current_a).all()


@pytest.mark.parametrize("other_kg", [1.5, 6.0])
def test_the_mass_of_a_payload_is_that_of_the_fit_on_its_mounting(
    example: SimpleNamespace, other_kg: float
) -> None:
    """Neither its mass on another mounting nor that of a held-out run was identified there."""
    found = example.main()
    calibration = _calibration(example, found)
    elsewhere = ident.Source("first", "", "fit", payload="disc", mass_kg=other_kg, mounting="elbow")
    held_out = replace(elsewhere, role="holdout", mounting="flange")
    sources = (elsewhere, *calibration.sources, held_out)
    several = replace(calibration, sources=sources)

    other = _of_mass("disc", other_kg)
    other_motion = ident.planned(_slow_motion(), 100.0, other)
    message = rf"weighs {other_kg:g} kg; expected 4.59 kg as in"
    with pytest.raises(ident.DataUnfit, match=message):
        ident.predict_torque(several, found.model, other_motion)

    own_motion = ident.planned(_slow_motion(), 100.0, example.DISC)
    _check_predicted(several, found.model, own_motion)


def test_a_calibration_without_mountings_names_each_mass(example: SimpleNamespace) -> None:
    """Earlier versions did not write the mounting, so any of the masses may have been on it."""
    found = example.main()
    calibration = _calibration(example, found)
    disc = replace(calibration.sources[0], mounting=None)
    lighter = replace(disc, mass_kg=1.5)
    earlier = replace(calibration, sources=(disc, lighter))
    for mass_kg in (1.5, example.DISC.known["m"]):
        payload = _of_mass("disc", mass_kg)
        motion = ident.planned(_slow_motion(), 100.0, payload)
        _check_predicted(earlier, found.model, motion)
    heavier = _of_mass("disc", 6.0)
    motion = ident.planned(_slow_motion(), 100.0, heavier)
    with pytest.raises(ident.DataUnfit, match=r"weighs 6 kg; expected 1.5 or 4.59 kg as in"):
        ident.predict_torque(earlier, found.model, motion)


def test_another_payload_on_a_known_mounting_is_not_predicted(example: SimpleNamespace) -> None:
    """What the calibration holds of the mounting is the inertia of the disc, not of a box."""
    found = example.main()
    calibration = _calibration(example, found)
    disc_kg = example.DISC.known["m"]
    for known in ({"m": 2.0}, {"m": disc_kg}, {}):
        box = ident.Payload("box", mounting="flange", known=known)
        motion = ident.planned(_slow_motion(), 100.0, box)
        with pytest.raises(
            ident.DataUnfit,
            match=r"found payload 'box' on mounting 'flange'; expected payload 'disc', .*"
            "the same name; .* a mounting of its own",
        ):
            ident.predict_torque(calibration, found.model, motion)

    box = _of_mass("box", disc_kg)
    disc_run = example.record(found.model, "box", example.DISC, 9)
    box_run = replace(disc_run, payload=box)
    with pytest.raises(ident.DataUnfit, match="found payload 'box' on mounting 'flange'"):
        ident.external_torque(calibration, found.model, box_run)
    with pytest.raises(ident.DataUnfit, match="found payload 'box' on mounting 'flange'"):
        ident.prediction_band(calibration, found.model, [box_run])
    # Weighing ignores what a run says of its payload.
    mass_kg = ident.weigh(calibration, found.model, [box_run]).mass_kg
    assert mass_kg == pytest.approx(disc_kg, rel=0.1)


def test_two_payloads_keep_their_own_mountings(example: SimpleNamespace) -> None:
    """A name that the calibration knows on another mounting is no name of this one's."""
    found = example.main()
    calibration = _calibration(example, found)
    elsewhere = ident.Source("earlier", "", "fit", payload="box", mass_kg=2.0, mounting="elbow")
    sources = (*calibration.sources, elsewhere)
    both = replace(calibration, sources=sources)
    box = _of_mass("box", 2.0)
    motion = ident.planned(_slow_motion(), 100.0, box)
    with pytest.raises(ident.DataUnfit, match="expected payload 'disc', of which"):
        ident.predict_torque(both, found.model, motion)
    # Calibrations of earlier versions do not say which mounting a payload had.
    without_mountings = tuple(replace(one, mounting=None) for one in both.sources)
    earlier = replace(both, sources=without_mountings)
    _check_predicted(earlier, found.model, motion)
    only_disc = replace(earlier, sources=without_mountings[:1])
    with pytest.raises(ident.DataUnfit, match="expected payload 'disc', of which"):
        ident.predict_torque(only_disc, found.model, motion)


def test_a_planned_motion_holds_numbers_of_one_shape() -> None:
    motion = _slow_motion()
    motion.velocity_rad_s[7, 1] = np.nan
    with pytest.raises(
        ident.DataUnfit,
        match="velocity_rad_s holds 1 non-finite values, the first in sample 7, axis 2",
    ):
        ident.planned(motion, 100.0)

    motion = _slow_motion()
    transposed = motion.acceleration_rad_s2.T
    across = ident.Motion(motion.position_rad, motion.velocity_rad_s, transposed)
    with pytest.raises(
        ident.DataUnfit,
        match=r"\(200, 3\), \(200, 3\) and \(3, 200\); expected "
        r"\(n_samples, n_axes\)",
    ):
        ident.planned(across, 100.0)


def test_lists_are_as_good_as_arrays(example: SimpleNamespace) -> None:
    found = example.main()
    nameplates = list(example.NAMEPLATE_NM_A)
    calibration = ident.calibration_of(found, list(AXES), nameplates)
    gear_matrix = np.diag(example.GEAR_RATIOS)
    drive_train = ident.DriveTrain(gear_matrix.tolist())
    model = ident.Model(found.model.robot, drive_train)
    run = example.record(found.model, "lists", example.DISC, 3)

    time_s = run.time_s.tolist()
    position_rad = run.position_rad.tolist()
    current_a = run.current_a.tolist()
    lists = ident.Run("lists", time_s, position_rad, current_a, example.DISC)
    data = ident.differentiate(run, model.drive_train, found.conditioning)
    same = ident.differentiate(lists, model.drive_train, found.conditioning)
    assert np.array_equal(data.velocity_rad_s, same.velocity_rad_s)
    assert np.array_equal(data.current_a, same.current_a)

    torque_nm = ident.measured_torque(calibration, model, run.current_a)
    same_nm = ident.measured_torque(calibration, model, current_a)
    assert np.array_equal(torque_nm, same_nm)

    motion = _slow_motion()
    listed = ident.Motion(
        motion.position_rad.tolist(),
        motion.velocity_rad_s.tolist(),
        motion.acceleration_rad_s2.tolist(),
    )
    planned = ident.planned(motion, 100.0)
    planned_of_lists = ident.planned(listed, 100.0)
    torque_nm = ident.predict_torque(calibration, model, planned)
    same_nm = ident.predict_torque(calibration, model, planned_of_lists)
    assert np.array_equal(torque_nm, same_nm)


class Frame:
    """A table as pandas has it: it becomes an array, and is none."""

    def __init__(self, values: FloatArray) -> None:
        """Store the values."""
        self._values = values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        """Return the values."""
        del copy
        return np.asarray(self._values, dtype=dtype)


@pytest.mark.slow
def test_data_frames_are_as_good_as_arrays_to_interpreter_and_type_checker(
    example: SimpleNamespace,
) -> None:
    robot = ident.robot_from_urdf(example.URDF)
    gear_matrix = np.diag(example.GEAR_RATIOS)
    drive_train = ident.DriveTrain(Frame(gear_matrix))
    model = ident.Model(robot, drive_train)
    runs = _two_runs(example, model)
    frames = []
    for run in runs:
        valid = np.ones(run.current_a.shape)
        framed_run = ident.Run(
            run.name,
            Frame(run.time_s),
            Frame(run.position_rad),
            Frame(run.current_a),
            run.payload,
            valid=valid.tolist(),
        )
        frames.append(framed_run)

    found = ident.identify(model, runs)
    same = ident.identify(model, frames)
    assert np.array_equal(found.estimate.gains, same.estimate.gains)
    assert np.array_equal(found.estimate.gains_std, same.estimate.gains_std)
    nameplate = Frame(np.array(example.NAMEPLATE_NM_A))
    fixed = ident.identify(model, frames, fixed_gains=nameplate)
    gains = fixed.estimate.gains.tolist()
    assert gains == list(example.NAMEPLATE_NM_A)

    calibration = ident.calibration_of(same, AXES, nameplate)
    nameplates = [gain.nameplate for gain in calibration.gains]
    assert nameplates == list(example.NAMEPLATE_NM_A)
    diagnoses = ident.diagnose(same, AXES, nameplate)
    assert diagnoses == ident.diagnose(found, AXES, nameplates)

    motion = _slow_motion()
    position = Frame(motion.position_rad)
    velocity = motion.velocity_rad_s.tolist()
    framed = ident.Motion(position, velocity, motion.acceleration_rad_s2)
    regressor = model.regressor(motion)
    assert np.array_equal(regressor, model.regressor(framed))

    current_a = runs[0].current_a
    torque_nm = ident.measured_torque(calibration, model, Frame(current_a))
    same_nm = ident.measured_torque(calibration, model, current_a)
    assert np.array_equal(torque_nm, same_nm)


def test_the_parameters_that_a_type_checker_sees_are_those_of_the_class() -> None:
    """Constructors are written twice: for type checkers with whatever becomes an array,
    at run time by the fields.
    """
    for kind in (ident.Run, ident.Motion, ident.DriveTrain):
        text = textwrap.dedent(inspect.getsource(kind))
        tree = ast.parse(text)
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        (checked,) = [function for function in functions if function.name == "__init__"]
        names = [argument.arg for argument in checked.args.args]
        own = inspect.signature(kind).parameters
        assert names == ["self", *own]
        checked_defaults = [ast.literal_eval(one) for one in checked.args.defaults]
        own_defaults = [one.default for one in own.values()]
        given_defaults = [one for one in own_defaults if one is not inspect.Parameter.empty]
        assert checked_defaults == given_defaults


def test_filters_need_not_be_given(example: SimpleNamespace) -> None:
    found = example.main()
    assert found.conditioning == ident.Conditioning()  # 500 Hz
    slow = []
    for run in _two_runs(example, found.model):
        arrays = {name: getattr(run, name)[::10] for name in ARRAYS}
        slow.append(replace(run, **arrays))
    of_slow = ident.identify(found.model, iter(slow))
    assert of_slow.conditioning.position_cutoff_hz == pytest.approx(16.0)
    assert of_slow.conditioning.decimation_cutoff_hz == pytest.approx(8.0)
    _check_gains(example, of_slow)


@pytest.mark.slow
def test_a_calibration_brings_its_filters(example: SimpleNamespace) -> None:
    model = example.main().model
    runs = _two_runs(example, model)
    loaded = runs[1]
    given = ident.Conditioning(30.0, decimation_cutoff_hz=15.0)
    identified = ident.identify(model, runs, given)
    calibration = ident.calibration_of(identified, AXES, [1.0, 1.0, 1.0])
    assert calibration.conditioning == given

    weighed = ident.weigh(calibration, model, [loaded])
    same = ident.weigh(calibration, model, [loaded], given)
    other = ident.weigh(calibration, model, [loaded], ident.Conditioning())
    assert weighed.mass_kg == same.mass_kg
    assert weighed.mass_kg != other.mass_kg

    quiet = ident.prediction_band(calibration, model, [loaded])
    external = ident.external_torque(calibration, model, loaded, band=quiet)
    same_external = ident.external_torque(calibration, model, loaded, given, quiet)
    assert np.array_equal(external.torque_nm, same_external.torque_nm)
    changed_calibration = replace(calibration, filter={})
    with pytest.raises(
        ident.ModelError,
        match=r"the filter of the calibration: found nothing; "
        r".*give `conditioning`",
    ):
        ident.weigh(changed_calibration, model, [loaded])


def test_wrong_sizes_and_transposed_arrays_are_refused_with_their_shapes(
    example: SimpleNamespace,
) -> None:
    found = example.main()
    drive_train = ident.DriveTrain(np.diag([100.0, 100.0]))
    with pytest.raises(
        ident.ModelError,
        match=r"drive train has shape \(2, 2\), "
        r"expected \(3, 3\)",
    ):
        ident.Model(found.model.robot, drive_train)
    run = example.record(found.model, "run", None, 3)
    turned = ident.Run("turned", run.time_s, run.position_rad.T, run.current_a)
    with pytest.raises(
        ident.DataUnfit,
        match=r"position_rad has shape \(3, \d+\); expected \(\d+, 3\), one row "
        r".*transpose it\?",
    ):
        ident.identify(found.model, [turned], found.conditioning)
    fixed_gains = np.ones(2)
    with pytest.raises(ident.ModelError, match=r"fixed_gains has shape \(2,\); expected \(3,\)"):
        ident.identify(found.model, [run], found.conditioning, fixed_gains=fixed_gains)
    calibration = _calibration(example, found)
    motion = _slow_motion()
    across = ident.Motion(
        motion.position_rad.T, motion.velocity_rad_s.T, motion.acceleration_rad_s2.T
    )
    planned = ident.planned(across, 100.0)
    with pytest.raises(ident.ModelError, match=r"shapes \(3, 200\).*expected \(n_samples, 3\)"):
        ident.predict_torque(calibration, found.model, planned)


def _columns(run: ident.Run, scale: list[float]) -> ident.Run:
    position_rad = np.asarray(run.position_rad) * scale
    return replace(run, position_rad=position_rad)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_axis_in_degrees_is_refused_by_the_limits_of_its_joint(
    example: SimpleNamespace, axis: int
) -> None:
    model = _model(example)
    scale = [1.0, 1.0, 1.0]
    scale[axis] = 180.0 / np.pi
    runs = [_columns(run, scale) for run in _two_runs(example, model)]
    name = AXES[axis]
    message = (
        rf"run 'bare', axis {name}: found positions that move by .* rad; expected at "
        "most 6 rad, .* in the URDF; are these degrees .give `numpy.radians`"
    )
    with pytest.raises(ident.IdentificationError, match=message):
        ident.identify(model, runs)


def test_an_axis_without_limits_is_not_guessed_to_be_in_degrees(example: SimpleNamespace) -> None:
    """A continuous joint may turn as far as it likes."""
    urdf = example.URDF.replace('type="revolute"', 'type="continuous"')
    assert urdf != example.URDF
    robot = ident.robot_from_urdf(urdf)
    travels = [joint.travel for joint in robot.joints]
    assert travels == [None, None, None]
    limited = ident.robot_from_urdf(example.URDF)
    travels = [joint.travel for joint in limited.joints]
    assert travels == [6.0, 6.0, 6.0]


def test_the_largest_float_as_a_limit_is_none(example: SimpleNamespace) -> None:
    """Some exporters of URDFs write it where a joint has no limit."""
    urdf = example.URDF.replace('lower="-3"', 'lower="-3.4e38"')
    urdf = urdf.replace('upper="3"', 'upper="3.4e38"')
    assert urdf != example.URDF
    robot = ident.robot_from_urdf(urdf)
    ranges = [joint.range for joint in robot.joints]
    assert ranges == [None, None, None]
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    ident.Model(robot, drive_train)


def test_a_robot_made_by_hand_takes_lists_and_whole_numbers_of_numpy(
    example: SimpleNamespace,
) -> None:
    robot = ident.robot_from_urdf(example.URDF)
    joints: Any = list(robot.joints)
    motors: Any = tuple(np.arange(len(joints)))
    by_hand = replace(robot, joints=joints, motors=motors)
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    ident.Model(by_hand, drive_train)


@pytest.mark.slow
def test_exchanged_currents_name_the_function_that_tests_their_order(
    example: SimpleNamespace,
) -> None:
    model = _model(example)
    recorded = _two_runs(example, model)
    for order in ([1, 0, 2], [2, 1, 0]):
        runs = []
        for run in recorded:
            exchanged_a = run.current_a[:, order]
            runs.append(replace(run, current_a=exchanged_a))
        with pytest.raises(
            ident.IdentificationError, match=r"expected .*`exchanged_channels`"
        ) as refused:
            ident.identify(model, runs)
        assert isinstance(refused.value, ident.NotConverged | ident.ModelContradicted)
        conditioning = ident.Conditioning()
        named = ident.exchanged_channels(model, runs, conditioning, AXES)
        assert named is not None


@pytest.mark.slow
def test_held_out_runs_judge_the_effects_of_a_library_user(example: SimpleNamespace) -> None:
    """As on the command line: what they do not confirm is not in the calibration."""
    found = example.main()
    model = found.model
    runs = _two_runs(example, model)

    def with_friction(run: ident.Run, friction_nm: float) -> ident.Run:
        """Dry friction of J2 that changes with its position."""
        current_a = np.array(run.current_a)
        position_rad = np.asarray(run.position_rad)
        angle_rad = position_rad[:, 1]
        direction = np.sign(np.gradient(angle_rad))
        gain_nm_a = example.TRUE_GAINS_NM_A[1]
        torque_nm = friction_nm * direction * np.cos(angle_rad)
        current_a[:, 1] += torque_nm / gain_nm_a
        return replace(run, current_a=current_a)

    fitted = [with_friction(run, 3.0) for run in runs]
    held_out = example.record(model, "held out", example.DISC, 3)
    again = ident.identify(model, fitted, axes=list(AXES))
    name = "position-friction"
    written_with_friction = {3.0: {name}, 0.0: set[str]()}
    for friction_nm, written in written_with_friction.items():
        unseen = with_friction(held_out, friction_nm)
        evidence = ident.gather(again, fitted, holdout=[unseen])
        rng = np.random.default_rng(0)
        steps = ident.find_effects(evidence, rng)
        effects = steps[-1].after.effects
        effect_names = {placed.effect.name for placed in effects}
        assert effect_names == {name}

        judged = ident.accept_on_holdout(evidence, steps)
        verdicts = judged[-1].verdicts
        judged_names = {one.placed.effect.name for one in verdicts}
        assert judged_names == {name}

        nameplates = example.NAMEPLATE_NM_A
        calibration = ident.calibration_of(again, AXES, nameplates, steps=judged)
        written_names = {effect.name for effect in calibration.effects}
        assert written_names == written
