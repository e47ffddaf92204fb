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


@pytest.fixture(scope="module")
def example() -> SimpleNamespace:
    """Names of the first example."""
    return SimpleNamespace(**runpy.run_path(str(EXAMPLES / "gains_from_arrays.py")))


def test_every_name_is_there() -> None:
    for name in ident.__all__:
        if name != "FloatArray":  # an alias, which has no name of its own
            assert getattr(ident, name).__name__ == name
    assert set(ident.__all__) <= set(dir(ident))
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
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_from_arrays_to_gains_in_ten_lines(
    example: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [line[4:] for line in (ident.__doc__ or "").splitlines() if line.startswith("    ")]
    assert len(lines) <= 10
    robot = ident.robot_from_urdf(example.URDF)
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    model = ident.Model(robot, drive_train)
    bare, loaded = (
        example.record(model, "x", payload, seed)
        for seed, payload in enumerate((None, example.DISC))
    )
    given = {
        "np": np,
        "urdf_text": example.URDF,
        "gear_ratios": example.GEAR_RATIOS,
        **{name: getattr(bare, name) for name in ("time_s", "position_rad", "current_a")},
        **{f"{name}_2": getattr(loaded, name) for name in ("time_s", "position_rad", "current_a")},
    }
    exec("\n".join(lines), given)  # noqa: S102 - the documented lines themselves are what is tested
    found = given["found"]
    assert isinstance(found, ident.Identification)
    gain_difference = found.estimate.gains - example.TRUE_GAINS_NM_A
    error = np.abs(gain_difference)
    assert np.all(error < 4.0 * found.estimate.gains_std)
    printed = capsys.readouterr().out
    assert printed.count("[") == 2


def test_the_example_finds_the_gains(
    example: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    found = example.main()
    gain_difference = np.abs(found.estimate.gains - example.TRUE_GAINS_NM_A)
    assert np.all(gain_difference < 4.0 * found.estimate.gains_std)
    printed = capsys.readouterr().out
    assert printed.count("±") == 3


def test_the_calibration_predicts_a_run_that_the_fit_has_not_seen(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    run = example.record(found.model, "another", example.DISC, 9)
    data = ident.differentiate(run, found.model.drive_train, found.conditioning)
    predicted = ident.predict_current(calibration, found.model, data)
    predicted_difference = predicted - data.current_a
    rest = predicted_difference[data.moving.all(axis=1)]
    assert predicted.shape == data.current_a.shape == (len(run.time_s) - 2, 3)
    # The noise of the recording is 0.05 A; filtering the positions changes the direction of dry
    # friction for a moment.
    rms_rest = np.sqrt(np.mean(rest**2, axis=0))
    assert np.all(rms_rest < 0.08)
    rms_current_a = np.sqrt(np.mean(data.current_a**2, axis=0))
    assert np.all(rms_current_a > 0.3)


def test_a_calibration_needs_one_name_an_axis(example: SimpleNamespace) -> None:
    with pytest.raises(
        ident.ModelError, match="2 axis names, 3 nameplate gains and 2 units for 3 identified"
    ):
        ident.calibration_of(example.main(), ("J1", "J2"), example.NAMEPLATE_NM_A)


def test_currents_are_predicted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / "predict_current.py"), run_name="__main__")
    out = capsys.readouterr().out
    bare, loaded = (line for line in out.splitlines() if "largest currents" in line)
    # Raising the disc costs motor 2 at least its weight at a hand's breadth.
    ampere = [
        float(line.split("currents ")[1].split(", ")[1].removesuffix(" A"))
        for line in (bare, loaded)
    ]
    assert ampere[1] > ampere[0] + 0.2


def _slow_motion(axes: int = 3, samples: int = 200) -> ident.Motion:
    time_s = np.arange(samples)[:, None] / 100.0 + np.arange(axes)
    return ident.Motion(np.sin(time_s), np.cos(time_s), -np.sin(time_s))


def test_a_misspelt_parameter_of_a_payload_is_refused() -> None:
    with pytest.raises(
        ident.ModelError,
        match=r"'disc'.* 'mass'; expected names among .*mz, m; "
        r"write .*'m': 4.59",
    ):
        ident.Payload("disc", mounting="flange", known={"mass": 4.59})


def test_a_payload_of_another_mass_is_not_predicted(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    heavier = ident.Payload("disc", mounting="flange", known={"m": 6.0})
    with pytest.raises(ident.DataUnfit, match=r"weighs 6 kg; expected 4.59 kg as in the fit"):
        ident.predict_current(
            calibration, found.model, ident.planned(_slow_motion(), 100.0, heavier)
        )
    same = ident.Payload("disc", mounting="flange", known={"m": 4.595})  # weighed again
    assert np.isfinite(
        ident.predict_current(calibration, found.model, ident.planned(_slow_motion(), 100.0, same))
    ).all()


@pytest.mark.parametrize("other_kg", [1.5, 6.0])
def test_the_mass_of_a_payload_is_that_of_the_fit_on_its_mounting(
    example: SimpleNamespace, other_kg: float
) -> None:
    """Neither its mass on another mounting nor that of a held-out run was identified there."""
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    elsewhere = ident.Source("first", "", "fit", payload="disc", mass_kg=other_kg, mounting="elbow")
    held_out = replace(elsewhere, role="holdout", mounting="flange")
    sources = (elsewhere, *calibration.sources, held_out)
    several = replace(calibration, sources=sources)
    other = ident.Payload("disc", mounting="flange", known={"m": other_kg})
    other_motion = ident.planned(_slow_motion(), 100.0, other)
    with pytest.raises(ident.DataUnfit, match=rf"weighs {other_kg:g} kg; expected 4.59 kg as in"):
        ident.predict_torque(several, found.model, other_motion)
    own_motion = ident.planned(_slow_motion(), 100.0, example.DISC)
    assert np.isfinite(ident.predict_torque(several, found.model, own_motion)).all()


def test_a_calibration_without_mountings_names_each_mass(example: SimpleNamespace) -> None:
    """Earlier versions did not write the mounting, so any of the masses may have been on it."""
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    disc = replace(calibration.sources[0], mounting=None)
    lighter = replace(disc, mass_kg=1.5)
    earlier = replace(calibration, sources=(disc, lighter))
    for mass_kg in (1.5, example.DISC.known["m"]):
        payload = ident.Payload("disc", mounting="flange", known={"m": mass_kg})
        motion = ident.planned(_slow_motion(), 100.0, payload)
        assert np.isfinite(ident.predict_torque(earlier, found.model, motion)).all()
    heavier = ident.Payload("disc", mounting="flange", known={"m": 6.0})
    motion = ident.planned(_slow_motion(), 100.0, heavier)
    with pytest.raises(ident.DataUnfit, match=r"weighs 6 kg; expected 1.5 or 4.59 kg as in"):
        ident.predict_torque(earlier, found.model, motion)


def test_another_payload_on_a_known_mounting_is_not_predicted(example: SimpleNamespace) -> None:
    """What the calibration holds of the mounting is the inertia of the disc, not of a box."""
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
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
    box_run = replace(
        example.record(found.model, "box", example.DISC, 9),
        payload=ident.Payload("box", "flange", {"m": disc_kg}),
    )
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
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    elsewhere = ident.Source("earlier", "", "fit", payload="box", mass_kg=2.0, mounting="elbow")
    sources = (*calibration.sources, elsewhere)
    both = replace(calibration, sources=sources)
    box = ident.Payload("box", mounting="flange", known={"m": 2.0})
    motion = ident.planned(_slow_motion(), 100.0, box)
    with pytest.raises(ident.DataUnfit, match="expected payload 'disc', of which"):
        ident.predict_torque(both, found.model, motion)
    # Calibrations of earlier versions do not say which mounting a payload had.
    without_mountings = tuple(replace(one, mounting=None) for one in both.sources)
    earlier = replace(both, sources=without_mountings)
    assert np.isfinite(ident.predict_torque(earlier, found.model, motion)).all()
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
    with pytest.raises(
        ident.DataUnfit,
        match=r"\(200, 3\), \(200, 3\) and \(3, 200\); expected "
        r"\(n_samples, n_axes\)",
    ):
        motion = _slow_motion()
        ident.planned(
            ident.Motion(motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2.T),
            100.0,
        )


def test_lists_are_as_good_as_arrays(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = ident.calibration_of(found, ["J1", "J2", "J3"], list(example.NAMEPLATE_NM_A))
    gear_matrix = np.diag(example.GEAR_RATIOS)
    drive_train = ident.DriveTrain(gear_matrix.tolist())
    model = ident.Model(found.model.robot, drive_train)
    run = example.record(found.model, "lists", example.DISC, 3)
    lists = ident.Run(
        "lists",
        run.time_s.tolist(),
        run.position_rad.tolist(),
        run.current_a.tolist(),
        example.DISC,
    )
    data, same = (
        ident.differentiate(one, model.drive_train, found.conditioning) for one in (run, lists)
    )
    assert np.array_equal(data.velocity_rad_s, same.velocity_rad_s)
    assert np.array_equal(data.current_a, same.current_a)
    assert np.array_equal(
        ident.measured_torque(calibration, model, run.current_a),
        ident.measured_torque(calibration, model, run.current_a.tolist()),
    )
    motion = _slow_motion()
    states = (motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2)
    listed = ident.Motion(*(state.tolist() for state in states))
    assert np.array_equal(
        ident.predict_torque(calibration, model, ident.planned(motion, 100.0)),
        ident.predict_torque(calibration, model, ident.planned(listed, 100.0)),
    )


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
    runs = [
        example.record(model, "bare", None, 1),
        example.record(model, "loaded", example.DISC, 2),
    ]
    frames = [
        ident.Run(
            run.name,
            Frame(run.time_s),
            Frame(run.position_rad),
            Frame(run.current_a),
            run.payload,
            valid=np.ones(run.current_a.shape).tolist(),
        )
        for run in runs
    ]
    found = ident.identify(model, runs)
    same = ident.identify(model, frames)
    assert np.array_equal(found.estimate.gains, same.estimate.gains)
    assert np.array_equal(found.estimate.gains_std, same.estimate.gains_std)
    nameplate = Frame(np.array(example.NAMEPLATE_NM_A))
    fixed = ident.identify(model, frames, fixed_gains=nameplate)
    gains = fixed.estimate.gains.tolist()
    assert gains == list(example.NAMEPLATE_NM_A)
    axes = ("J1", "J2", "J3")
    calibration = ident.calibration_of(same, axes, nameplate)
    nameplates = [gain.nameplate for gain in calibration.gains]
    assert nameplates == list(example.NAMEPLATE_NM_A)
    assert ident.diagnose(same, axes, nameplate) == ident.diagnose(
        found, axes, list(example.NAMEPLATE_NM_A)
    )
    motion = _slow_motion()
    framed = ident.Motion(
        Frame(motion.position_rad), motion.velocity_rad_s.tolist(), motion.acceleration_rad_s2
    )
    assert np.array_equal(model.regressor(motion), model.regressor(framed))
    frame = Frame(runs[0].current_a)
    torque_nm = ident.measured_torque(calibration, model, frame)
    current_a = runs[0].current_a
    assert np.array_equal(torque_nm, ident.measured_torque(calibration, model, current_a))


def test_the_parameters_that_a_type_checker_sees_are_those_of_the_class() -> None:
    """Constructors are written twice: for type checkers with whatever becomes an array,
    at run time by the fields.
    """
    for kind in (ident.Run, ident.Motion, ident.DriveTrain):
        text = textwrap.dedent(inspect.getsource(kind))
        tree = ast.parse(text)
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        (checked,) = (node for node in functions if node.name == "__init__")
        names = [argument.arg for argument in checked.args.args]
        own = inspect.signature(kind).parameters
        assert names == ["self", *own]
        defaults = [ast.literal_eval(one) for one in checked.args.defaults]
        expected = [one.default for one in own.values() if one.default is not one.empty]
        assert defaults == expected


def test_filters_need_not_be_given(example: SimpleNamespace) -> None:
    found = example.main()
    assert found.conditioning == ident.Conditioning()  # 500 Hz
    runs = [
        example.record(found.model, "bare", None, 1),
        example.record(found.model, "loaded", example.DISC, 2),
    ]
    slow = [
        replace(
            run,
            time_s=run.time_s[::10],
            position_rad=run.position_rad[::10],
            current_a=run.current_a[::10],
        )
        for run in runs
    ]
    of_slow = ident.identify(found.model, iter(slow))
    assert of_slow.conditioning.position_cutoff_hz == pytest.approx(16.0)
    assert of_slow.conditioning.decimation_cutoff_hz == pytest.approx(8.0)
    gain_difference = of_slow.estimate.gains - example.TRUE_GAINS_NM_A
    error = np.abs(gain_difference)
    assert np.all(error < 4.0 * of_slow.estimate.gains_std)


@pytest.mark.slow
def test_a_calibration_brings_its_filters(example: SimpleNamespace) -> None:
    model = example.main().model
    runs = [
        example.record(model, "bare", None, 1),
        example.record(model, "loaded", example.DISC, 2),
    ]
    given = ident.Conditioning(30.0, decimation_cutoff_hz=15.0)
    calibration = ident.calibration_of(
        ident.identify(model, runs, given), ("J1", "J2", "J3"), [1.0, 1.0, 1.0]
    )
    assert calibration.conditioning == given
    weighed = ident.weigh(calibration, model, runs[1:])
    assert weighed.mass_kg == ident.weigh(calibration, model, runs[1:], given).mass_kg
    assert (
        weighed.mass_kg != ident.weigh(calibration, model, runs[1:], ident.Conditioning()).mass_kg
    )
    quiet = ident.prediction_band(calibration, model, runs[1:])
    external = ident.external_torque(calibration, model, runs[1], band=quiet)
    same = ident.external_torque(calibration, model, runs[1], given, quiet)
    assert np.array_equal(external.torque_nm, same.torque_nm)
    changed_calibration = replace(calibration, filter={})
    with pytest.raises(
        ident.ModelError,
        match=r"the filter of the calibration: found nothing; "
        r".*give `conditioning`",
    ):
        ident.weigh(changed_calibration, model, runs[1:])


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
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    motion = _slow_motion()
    across = ident.Motion(
        motion.position_rad.T, motion.velocity_rad_s.T, motion.acceleration_rad_s2.T
    )
    with pytest.raises(ident.ModelError, match=r"shapes \(3, 200\).*expected \(n_samples, 3\)"):
        ident.predict_torque(calibration, found.model, ident.planned(across, 100.0))


def _columns(run: ident.Run, scale: list[float]) -> ident.Run:
    position_rad = np.asarray(run.position_rad) * scale
    return replace(run, position_rad=position_rad)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_axis_in_degrees_is_refused_by_the_limits_of_its_joint(
    example: SimpleNamespace, axis: int
) -> None:
    robot = ident.robot_from_urdf(example.URDF)
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    model = ident.Model(robot, drive_train)
    scale = [1.0, 1.0, 1.0]
    scale[axis] = 180.0 / np.pi
    runs = [
        _columns(example.record(model, name, payload, seed), scale)
        for name, payload, seed in (("bare", None, 1), ("loaded", example.DISC, 2))
    ]
    with pytest.raises(
        ident.IdentificationError,
        match=rf"run 'bare', axis J{axis + 1}: found positions that move by .* rad; expected at "
        "most 6 rad, .* in the URDF; are these degrees .give `numpy.radians`",
    ):
        ident.identify(model, runs)


def test_an_axis_without_limits_is_not_guessed_to_be_in_degrees(example: SimpleNamespace) -> None:
    """A continuous joint may turn as far as it likes."""
    urdf = example.URDF.replace('type="revolute"', 'type="continuous"')
    assert urdf != example.URDF
    robot = ident.robot_from_urdf(urdf)
    assert [joint.travel for joint in robot.joints] == [None, None, None]
    joints = ident.robot_from_urdf(example.URDF).joints
    assert [joint.travel for joint in joints] == [6.0, 6.0, 6.0]


def test_the_largest_float_as_a_limit_is_none(example: SimpleNamespace) -> None:
    """Some exporters of URDFs write it where a joint has no limit."""
    urdf = example.URDF.replace('lower="-3"', 'lower="-3.4e38"').replace(
        'upper="3"', 'upper="3.4e38"'
    )
    assert urdf != example.URDF
    robot = ident.robot_from_urdf(urdf)
    assert [joint.range for joint in robot.joints] == [None, None, None]
    ident.Model(robot, ident.DriveTrain(np.diag(example.GEAR_RATIOS)))


def test_a_robot_made_by_hand_takes_lists_and_whole_numbers_of_numpy(
    example: SimpleNamespace,
) -> None:
    robot = ident.robot_from_urdf(example.URDF)
    joints: Any = list(robot.joints)
    motors: Any = tuple(np.arange(len(robot.joints)))
    by_hand = replace(robot, joints=joints, motors=motors)
    ident.Model(by_hand, ident.DriveTrain(np.diag(example.GEAR_RATIOS)))


@pytest.mark.slow
def test_exchanged_currents_name_the_function_that_tests_their_order(
    example: SimpleNamespace,
) -> None:
    robot = ident.robot_from_urdf(example.URDF)
    drive_train = ident.DriveTrain(np.diag(example.GEAR_RATIOS))
    model = ident.Model(robot, drive_train)
    bare = example.record(model, "bare", None, 1)
    loaded = example.record(model, "loaded", example.DISC, 2)
    for order in ([1, 0, 2], [2, 1, 0]):
        runs = [replace(run, current_a=run.current_a[:, order]) for run in (bare, loaded)]
        with pytest.raises(
            ident.IdentificationError, match=r"expected .*`exchanged_channels`"
        ) as refused:
            ident.identify(model, runs)
        assert isinstance(refused.value, ident.NotConverged | ident.ModelContradicted)
        named = ident.exchanged_channels(model, runs, ident.Conditioning(), ("J1", "J2", "J3"))
        assert named is not None


@pytest.mark.slow
def test_held_out_runs_judge_the_effects_of_a_library_user(example: SimpleNamespace) -> None:
    """As on the command line: what they do not confirm is not in the calibration."""
    found = example.main()
    model = found.model
    runs = [
        example.record(model, name, payload, seed)
        for name, payload, seed in (("bare", None, 1), ("loaded", example.DISC, 2))
    ]

    def with_friction(run: ident.Run, friction_nm: float) -> ident.Run:
        """Dry friction of J2 that changes with its position."""
        current_a = np.array(run.current_a)
        position_rad = np.asarray(run.position_rad)
        angle_rad = position_rad[:, 1]
        direction = np.sign(np.gradient(angle_rad))
        gain_nm_a = example.TRUE_GAINS_NM_A[1]
        current_a[:, 1] += friction_nm * direction * np.cos(angle_rad) / gain_nm_a
        return replace(run, current_a=current_a)

    fitted = [with_friction(run, 3.0) for run in runs]
    held_out = example.record(model, "held out", example.DISC, 3)
    axes = ["J1", "J2", "J3"]
    again = ident.identify(model, fitted, axes=axes)
    name = "position-friction"
    for friction_nm, written in ((3.0, {name}), (0.0, set())):
        unseen = with_friction(held_out, friction_nm)
        evidence = ident.gather(again, fitted, holdout=[unseen])
        rng = np.random.default_rng(0)
        steps = ident.find_effects(evidence, rng)
        effects = steps[-1].after.effects
        assert {placed.effect.name for placed in effects} == {name}
        judged = ident.accept_on_holdout(evidence, steps)
        verdicts = judged[-1].verdicts
        assert {one.placed.effect.name for one in verdicts} == {name}
        calibration = ident.calibration_of(
            again, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A, steps=judged
        )
        assert {effect.name for effect in calibration.effects} == written
