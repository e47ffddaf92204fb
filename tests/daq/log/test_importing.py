"""CSV files of other controllers: the same numbers in a log, or an error and nothing."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import fields
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.io import savemat

from daq.cli.app import main
from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.config.import_description import ImportDescription
from daq.config.yaml_file import parse_yaml, read_model
from daq.errors import (
    ConfigurationInconsistent,
    ExitCode,
    OutputFailed,
    TableUnfit,
    UsageError,
    counted,
)
from daq.log.conversion import load_run
from daq.log.importing import Imported, import_recording, quantise
from daq.log.reader import read_log
from daq.report.document import json_tree
from daq.report.log import info_report
from ident.data.channel_faults import FaultKind, find_faults
from ident.data.run import Run
from ident.data.torque_channel import torque_slope
from ident.model.robot import Motion
from tests.studies.real_runs import ur10

FloatArray = NDArray[np.float64]
AXIS_NUMBERS = range(1, 7)
POSITION_NAMES = [f"q{axis}" for axis in AXIS_NUMBERS]
CURRENT_NAMES = [f"i{axis}" for axis in AXIS_NUMBERS]
VELOCITY_NAMES = [f"v{axis}" for axis in AXIS_NUMBERS]
NAMES = [*POSITION_NAMES, *CURRENT_NAMES]
COUNTS_PER_REVOLUTION = 65536
"""Counts per revolution of every encoder of the demo cell."""


def phases_rad(time: FloatArray) -> FloatArray:
    """Phases of six axes in the same motion, a radian after each other, shape (samples, 6)."""
    return time[:, None] + np.arange(6)


def swing_deg(time: FloatArray, amplitude_deg: float = 20.0) -> FloatArray:
    """Positions of six axes that swing, shape (samples, 6)."""
    return amplitude_deg * np.sin(phases_rad(time))


def write_table(path: Path, names: Sequence[str], values: FloatArray, delimiter: str = ",") -> None:
    """Write a CSV file with its header; every number in full."""
    lines = [delimiter.join(names)]
    for row in values.tolist():
        fields = map(repr, row)
        lines.append(delimiter.join(fields))
    write_lines(path, lines)


def read_lines(path: Path) -> list[str]:
    """Lines of a text file."""
    return path.read_text(encoding="utf-8").splitlines()


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a text file."""
    text = "\n".join(lines) + "\n"
    path.write_text(text, encoding="utf-8")


def position_section(unit: str = "deg", side: str = "joint", **changes: Any) -> dict[str, Any]:
    """The section of a description that says where the positions are."""
    section = {"file": "run.csv", "columns": POSITION_NAMES, "unit": unit, "side": side}
    return section | changes


def current_section(unit: Any = "A", **changes: Any) -> dict[str, Any]:
    """The section of a description that says where the currents are."""
    section = {"file": "run.csv", "columns": CURRENT_NAMES, "unit": unit}
    return section | changes


def velocity_section(unit: str = "deg/s", side: str = "joint", **changes: Any) -> dict[str, Any]:
    """The section of a description that says where the velocities are."""
    section = {"file": "run.csv", "columns": VELOCITY_NAMES, "unit": unit, "side": side}
    return section | changes


def time_section(unit: str, file: str = "run.csv") -> dict[str, str]:
    """The section of a description that says where the stamps are."""
    return {"file": file, "column": "t", "unit": unit}


class ImportInputs:
    """A folder with the demo cell, a recording of it and its description, for a test to spoil."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        """Store the folders."""
        self.checkout = checkout
        self.folder = folder
        self.data = folder / "data"
        self.out = folder / "out" / "run.mcap"
        index = np.arange(300)
        self.joint_deg = swing_deg(index / 40.0)
        self.current_a = np.cos(phases_rad(index / 7.0))

    def prepare(self) -> ImportInputs:
        """Make all files."""
        configs_folder = self.checkout / "configs"
        shutil.copytree(configs_folder, self.folder / "configs")
        self.data.mkdir()
        self.out.parent.mkdir()
        self.write_recording()
        self.describe()
        return self

    def write_recording(self) -> None:
        """Write the positions and currents as they are now."""
        values = np.hstack((self.joint_deg, self.current_a))
        self.write_csv(values)

    def write_csv(self, values: FloatArray, delimiter: str = ",") -> None:
        """The recording, positions before currents."""
        run_path = self.data / "run.csv"
        write_table(run_path, NAMES, values, delimiter)

    def spoil_csv(self, old: str, new: str) -> None:
        """Replace something in the recording."""
        path = self.data / "run.csv"
        text = path.read_text(encoding="utf-8")
        assert old in text
        changed_text = text.replace(old, new, 1)
        path.write_text(changed_text, encoding="utf-8")

    @property
    def description(self) -> Path:
        """The description's path."""
        return self.folder / "configs/imports/run.yaml"

    def describe(self, **changes: object) -> None:
        """The description, with some values replaced; None removes."""
        document: dict[str, object] = {
            "name": "run",
            "cell": "../cells/demo.yaml",
            "position": position_section(),
            "current": current_section(),
            "rate_hz": 1000,
        }
        document.update(changes)
        stated = {key: value for key, value in document.items() if value is not None}
        text = json.dumps(stated)
        self.description.write_text(text, encoding="utf-8")

    def command(self, *options: str) -> list[str]:
        """The words of `drivegain import` for these files."""
        words = ["import", self.description, "--data", self.data, "--out", self.out]
        return [*map(str, words), *options]

    def load(self) -> Run:
        """The run of the log."""
        run, _ = load_run(self.out)
        return run

    def split(self, holdout: Path | None) -> Imported:
        """Import the recording, with its held-out part as another log."""
        return import_recording(
            self.description, self.data, self.out, software="test", holdout=holdout
        )

    def run(self) -> int:
        """The command; its exit code."""
        return main(self.command())

    @property
    def left(self) -> list[str]:
        """List the folder of the log."""
        files = self.out.parent.iterdir()
        return sorted(path.name for path in files)


@pytest.fixture
def inputs(checkout: Path, tmp_path: Path) -> ImportInputs:
    """A folder with good files."""
    return ImportInputs(checkout, tmp_path).prepare()


def test_the_files_are_beside_the_description_where_no_folder_is_named(
    inputs: ImportInputs,
) -> None:
    beside = inputs.description.parent / "run.csv"
    beside.write_bytes((inputs.data / "run.csv").read_bytes())
    words = ["import", str(inputs.description), "--out", str(inputs.out)]
    assert main(words) == ExitCode.OK
    assert inputs.left == [inputs.out.name]


def test_joint_degrees_come_back_as_radians(inputs: ImportInputs) -> None:
    assert inputs.run() == 0
    run, cell = load_run(inputs.out)
    assert cell.name == "demo"
    assert run.rate_hz == pytest.approx(1000.0)
    expected = np.radians(inputs.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, inputs.current_a, atol=1e-9)
    assert run.payload is None
    assert inputs.left == ["run.mcap"]


def test_motor_radians_counts_and_joint_degrees_are_the_same_run(inputs: ImportInputs) -> None:
    ratio = ratio_of(inputs)
    joint_rad = np.radians(inputs.joint_deg)
    motor_rad = joint_rad @ ratio.T
    counts = counts_of(inputs)
    for unit, values in (("rad", motor_rad), ("counts", counts)):
        inputs.write_csv(np.hstack((values, inputs.current_a)))
        inputs.describe(position=position_section(unit, "motor"))
        inputs.out.unlink(missing_ok=True)
        assert inputs.run() == 0
        run = inputs.load()
        np.testing.assert_allclose(run.position_rad, joint_rad, atol=3e-6)


def ratio_of(inputs: ImportInputs) -> FloatArray:
    """R of the demo cell."""
    text = (inputs.folder / "configs/cells/demo.yaml").read_bytes()
    tree = parse_yaml(text, "cell").tree
    ratio = tree["drive_train"]["ratio"]
    return np.array(ratio, dtype=np.float64)


def counts_of(inputs: ImportInputs) -> FloatArray:
    """Encoder counts of the motors, without offsets, shape (samples, 6)."""
    joint_rad = np.radians(inputs.joint_deg)
    motor_rad = joint_rad @ ratio_of(inputs).T
    turns = motor_rad / (2 * pi)
    return np.rint(turns * COUNTS_PER_REVOLUTION)


def test_column_numbers_semicolons_and_decimal_commas(inputs: ImportInputs) -> None:
    current_ma = 1000.0 * inputs.current_a
    values = np.hstack((inputs.joint_deg, current_ma))
    inputs.write_csv(values, delimiter=";")
    path = inputs.data / "run.csv"
    text = path.read_text(encoding="utf-8")
    changed_text = text.replace(".", ",")
    path.write_text("exported by X\n" + changed_text, encoding="utf-8-sig")
    position = position_section(columns=[1, 2, 3, 4, 5, 6])
    current_columns = [7, 8, 9, 10, 11, 12]
    current = current_section(columns=current_columns, factor=0.001)
    table = {"delimiter": ";", "decimal": ",", "skip_rows": 1}
    inputs.describe(table=table, position=position, current=current, payload="disc")
    assert inputs.run() == 0
    run = inputs.load()
    expected = np.radians(inputs.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, inputs.current_a, atol=1e-9)
    assert run.payload is not None
    assert run.payload.known == {"m": 4.59}


def test_a_robot_with_a_joint_that_follows_an_axis_is_imported_by_its_axes(
    inputs: ImportInputs,
) -> None:
    urdf = inputs.folder / "configs/robots/tx40.urdf"
    follower = """<link name="behind"/><joint name="rod" type="revolute"><origin xyz="0 0 0.1"/>
      <parent link="link6"/><child link="behind"/><axis xyz="0 1 0"/>
      <limit lower="-9" upper="9" velocity="1" effort="1"/>
      <mimic joint="J5" multiplier="-0.5" offset="0.1"/></joint></robot>"""
    text = urdf.read_text(encoding="utf-8")
    changed_text = text.replace("</robot>", follower)
    urdf.write_text(changed_text, encoding="utf-8")
    assert inputs.run() == 0
    run, cell = load_run(inputs.out)
    still = np.zeros_like(run.position_rad)
    motion = Motion(run.position_rad, still, still)
    joints = model_of(cell).follow(motion).joints
    expected = np.radians(inputs.joint_deg)
    axes_rad = joints.position_rad[:, :6]
    rod_rad = joints.position_rad[:, 6]
    np.testing.assert_allclose(axes_rad, expected, atol=2e-9)
    joint_rad = np.radians(inputs.joint_deg[:, 4])
    follower_rad = 0.1 - 0.5 * joint_rad
    np.testing.assert_allclose(rod_rad, follower_rad, atol=2e-9)


def test_the_same_files_give_the_same_log(inputs: ImportInputs) -> None:
    assert inputs.run() == 0
    first = inputs.out.read_bytes()
    inputs.out.unlink()
    assert inputs.run() == 0
    assert inputs.out.read_bytes() == first


@given(arrays(np.float64, (5, 2), elements=st.floats(-1e12, 1e12)))
def test_nothing_is_lost_by_counting(values: FloatArray) -> None:
    raw, quantum = quantise(values)
    largest = np.abs(values).max(axis=0)
    largest_absolute_raw = np.abs(raw).max()
    assert largest_absolute_raw <= 2**31 - 1
    rounding = np.abs(values - raw * quantum)
    assert (rounding <= quantum / 2).all()
    moves = largest > 1e-200
    finest = 1e-9 * largest[moves]
    assert (quantum[moves] <= finest).all()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("q1,q2", "q1,qq", ("columns q1, qq", "one column 'q2'")),
        ("\n20.0,", "\n", ()),
        ("q1,", "", ("expected: 11, as in the header",)),
    ],
)
def test_wrong_columns(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    said: tuple[str, ...],
) -> None:
    if old == "\n20.0,":
        run_path = inputs.data / "run.csv"
        rows = read_lines(run_path)
        old = rows[7]
        new = rows[7].partition(",")[2]
        said = ("run.csv:8", "11 columns", "12, as in the header")
    inputs.spoil_csv(old, new)
    _refused(inputs, capsys, 4, *said)


def _refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], code: int, *said: str
) -> None:
    assert inputs.run() == code
    output = capsys.readouterr()
    assert output.out == ""
    for label in ("error:", "found:", "expected:", "do:"):
        assert label in output.err
    for text in said:
        assert text in output.err
    assert inputs.left == []


@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "", "n/a", "1.2.3", "1e999"])
def test_a_field_that_is_no_finite_number(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], word: str
) -> None:
    run_path = inputs.data / "run.csv"
    rows = read_lines(run_path)
    fields = rows[41].split(",")
    fields[8] = word
    inputs.spoil_csv(rows[41], ",".join(fields))
    _refused(inputs, capsys, 4, "run.csv:42, column i3", repr(word), "a finite number")


@pytest.mark.parametrize(("copied", "original"), [(3, 1), (10, 7)])
def test_two_axes_with_the_same_numbers_are_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], copied: int, original: int
) -> None:
    values = np.hstack((inputs.joint_deg, inputs.current_a))
    values[:, copied] = values[:, original]
    inputs.write_csv(values)
    same = f"the same number as column {NAMES[original]} of run.csv"
    _refused(inputs, capsys, 4, f"column {NAMES[copied]}", same)


def test_a_copy_of_a_file_is_no_other_axis(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    _file_of_each_axis(inputs)
    files = inputs.data.glob("*1.csv")
    first = sorted(files)[0]
    sorted_files = sorted(inputs.data.glob("*2.csv"))
    second = sorted_files[0]
    second.write_bytes(first.read_bytes())
    found = f"of {first.name} in all"
    _refused(inputs, capsys, 4, second.name, found)


def test_units_by_the_name_of_an_axis_are_compared_with_the_file(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    header = ",".join(NAMES)
    units = ["deg"] * 6 + ["A"] * 5 + ["mA"]
    inputs.spoil_csv(header, f"{header}\n{','.join(units)}")
    path = inputs.folder / "configs/cells/demo.yaml"
    of_axes = dict.fromkeys(load_cell(path).axis_names, "A")
    inputs.describe(current=current_section(of_axes))
    found = "unit 'mA' in the line of units"
    _refused(inputs, capsys, 4, f"column {CURRENT_NAMES[5]}", found, "'A'")


def test_a_missing_file(inputs: ImportInputs, capsys: pytest.CaptureFixture[str]) -> None:
    (inputs.data / "run.csv").unlink()
    _refused(inputs, capsys, 4, "run.csv", "no such file", "--data")


@pytest.mark.parametrize("text", ["", "\n\n", ",".join(NAMES), ",".join(NAMES) + "\n"])
def test_an_empty_file(inputs: ImportInputs, capsys: pytest.CaptureFixture[str], text: str) -> None:
    run_path = inputs.data / "run.csv"
    run_path.write_text(text, encoding="utf-8")
    _refused(inputs, capsys, 4, "before the numbers", "a line of numbers for each sample")


def test_every_truncation_that_shows_is_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    run_path = inputs.data / "run.csv"
    data = run_path.read_bytes().rstrip(b"\n")
    last = data.rpartition(b"\n")[2]
    last_comma = last.rindex(b",")
    complete = data.removesuffix(last)
    middle = len(last) // 2
    for kept_bytes in (3, middle, last_comma, last_comma + 1):
        run_path.write_bytes(complete + last[:kept_bytes])
        _refused(inputs, capsys, 4, "run.csv:301", "the file ends early")


def test_binary_is_no_csv(inputs: ImportInputs, capsys: pytest.CaptureFixture[str]) -> None:
    (inputs.data / "run.csv").write_bytes(b"q1\n\xff\xfe\x00")
    _refused(inputs, capsys, 4, "no UTF-8")


def test_degrees_declared_as_radians(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.describe(position=position_section("rad"))
    _refused(inputs, capsys, 4, "degrees were taken for radians")


def test_radians_declared_as_degrees(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.joint_deg = np.radians(inputs.joint_deg)
    inputs.write_recording()
    _refused(inputs, capsys, 4, "radians were taken for degrees")


def test_fractional_counts(inputs: ImportInputs, capsys: pytest.CaptureFixture[str]) -> None:
    inputs.describe(position=position_section("counts", "motor"))
    _refused(inputs, capsys, 4, "run.csv:2, column q2", "a whole number of encoder counts")


def test_files_of_different_length(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = read_lines(inputs.data / "run.csv")
    short = inputs.data / "short.csv"
    write_lines(short, lines[:-5])
    inputs.describe(current=current_section(file="short.csv"))
    _refused(inputs, capsys, 4, "300 rows in run.csv and 295 rows in short.csv")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"rat_hz": 1000, "rate_hz": None},
            ("unknown key 'rat_hz'", "rate_hz (did you mean that?)"),
        ),
        ({"rate_hz": None}, ("neither rate_hz nor time",)),
        ({"time": {"file": "run.csv", "column": "q1", "unit": "s"}}, ("both rate_hz and time",)),
        ({"rate_hz": "1000"}, ("rate_hz", 'text "1000"', "a valid number")),
        ({"payload": "brick"}, ("'brick'", "disc at flange-a")),
        ({"cell": "../cells/none.yaml"}, ("none.yaml", "no such file")),
        ({"position": position_section("grad")}, ("position.unit",)),
        ({"position": position_section("counts")}, ("motor",)),
        ({"current": current_section("mA")}, ("'mA'", "current in 'A'", "factor")),
        ({"current": current_section(columns=CURRENT_NAMES[:5])}, ("5 columns", "6, as many")),
    ],
)
def test_a_wrong_description(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
    said: tuple[str, ...],
) -> None:
    inputs.describe(**changes)
    _refused(inputs, capsys, 6, *said)


def test_a_duplicate_key_in_the_description(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    text = inputs.description.read_text(encoding="utf-8") + "\n"
    repeated = text.replace('"rate_hz": 1000', '"rate_hz": 1000,\n"rate_hz": 500')
    inputs.description.write_text(repeated, encoding="utf-8")
    _refused(inputs, capsys, 6, "run.yaml:2", "duplicate key 'rate_hz', first on line 1")


def test_a_missing_description(inputs: ImportInputs, capsys: pytest.CaptureFixture[str]) -> None:
    inputs.description.unlink()
    _refused(inputs, capsys, 6, "run.yaml", "no such file")


def test_an_existing_log_stays(inputs: ImportInputs) -> None:
    inputs.out.write_bytes(b"precious")
    with pytest.raises(UsageError, match="a file of that name"):
        import_recording(inputs.description, inputs.data, inputs.out, software="x")
    assert inputs.out.read_bytes() == b"precious"
    assert inputs.left == ["run.mcap"]


def test_a_full_disk_leaves_nothing(inputs: ImportInputs, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert inputs.run() == 1
    assert inputs.left == []


def test_a_rate_that_makes_the_joints_too_fast(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.describe(rate_hz=100_000.0)
    _refused(inputs, capsys, 4, "deg/s", "rate_hz is too high")


@pytest.mark.parametrize("wrong", [0.1, 1.0, 10.0])
def test_a_rate_that_is_ten_times_off_is_noticed(
    inputs: ImportInputs,
    wrong: float,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """At 1 kHz the joints reach 80 to 90 % of the slowest limit."""
    time_s = np.arange(1000) / 1000.0
    inputs.joint_deg = swing_deg(2.0 * np.pi * time_s, 30.0)
    inputs.current_a = np.cos(phases_rad(time_s * 140.0))
    inputs.joint_deg[500, 2] += 0.5  # one outlier is not taken for a wrong rate
    inputs.write_recording()
    rate_hz = 1000.0 * wrong
    inputs.describe(rate_hz=rate_hz)
    if wrong > 1.0:
        _refused(inputs, capsys, 4, "deg/s", "rate_hz is too high")
    else:
        assert inputs.run() == 0
    warned = "no joint is faster than" in caplog.text
    assert warned is (wrong < 1.0)


@pytest.mark.parametrize("size", [True, False])
def test_currents_without_their_sign_are_noticed(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    size: bool,
) -> None:
    """The log is made, since other programs can read it; a fit refuses it."""
    time_s = np.arange(2000) / 1000.0
    inputs.joint_deg = swing_deg(5.0 * time_s)
    inputs.current_a = np.cos(phases_rad(30.0 * time_s))
    if size:
        inputs.current_a = np.abs(inputs.current_a)
    inputs.write_recording()
    assert inputs.run() == 0
    assert ("J1, J2, J3, J4, J5, J6: found currents that are never negative" in caplog.text) is size
    capsys.readouterr()
    code = main(["fit", str(inputs.out)])
    said = capsys.readouterr().err
    assert code == 4
    assert ("never negative" in said) is size
    assert "heavier payload" not in said


@pytest.mark.parametrize("back", [False, True])
def test_a_step_that_no_motor_makes(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], back: bool
) -> None:
    """A step of 0.5 rad in one sample: the speeds over many samples do not show it."""
    end = 121 if back else 300
    step_deg = np.degrees(0.5)
    inputs.joint_deg[120:end, 2] += step_deg
    inputs.write_recording()
    _refused(
        inputs,
        capsys,
        4,
        "run.csv:122, column q3, axis J3",
        "in one sample",
        "the limit in the cell configuration",
    )


def test_a_step_of_an_axis_that_rests_is_refused_too(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing else of that axis changes, and the step itself is no noise to compare it with."""
    inputs.joint_deg[:, 2] = 60.0
    step_deg = np.degrees(0.5)
    inputs.joint_deg[120, 2] += step_deg
    inputs.write_recording()
    _refused(
        inputs,
        capsys,
        4,
        "column q3, axis J3",
        "in one sample",
        "the limit in the cell configuration",
    )


SMALL_GLITCH_DEG = 1.5
"""A step that `check_steps` accepts beside the motion of this axis."""


def test_a_glitch_that_no_limit_rules_out_is_said_and_left_to_the_fit(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.joint_deg[120, 2] += SMALL_GLITCH_DEG
    inputs.write_recording()
    assert inputs.run() == 0
    printed = capsys.readouterr().out
    said = " ".join(printed.split())
    assert "run.csv:122, column q3, axis J3: a position that leaves its course by up to 1." in said
    run, cell = load_run(inputs.out)
    position_deg = np.degrees(run.position_rad[120, 2])
    recorded_deg = inputs.joint_deg[120, 2]
    assert position_deg == pytest.approx(recorded_deg, abs=1e-4)
    (fault,) = find_faults(run.position_rad, run.current_a, run.rate_hz, cell.ratio)
    assert fault.kind is FaultKind.GLITCH
    assert fault.axis == 2
    assert fault.stretches.tolist() == [[120, 121]]


def test_a_glitch_of_a_current_among_resampled_rows_does_not_reach_the_log(
    inputs: ImportInputs,
) -> None:
    inputs.joint_deg = swing_deg(UNEVEN_MS / 160.0)
    inputs.write_recording()
    _with_time(inputs, UNEVEN_MS)
    assert inputs.run() == 0
    sound, _ = load_run(inputs.out)
    inputs.out.unlink()
    inputs.current_a[200, 1] *= 100.0
    inputs.write_recording()
    _with_time(inputs, UNEVEN_MS)
    assert inputs.run() == 0
    mended, _ = load_run(inputs.out)
    assert np.array_equal(mended.position_rad, sound.position_rad)
    current_difference_a = mended.current_a - sound.current_a
    assert np.abs(current_difference_a).max() < 0.1


def test_an_axis_at_rest_may_have_no_current(inputs: ImportInputs) -> None:
    """Its brake holds it, and its motor has no power."""
    inputs.joint_deg[:, 2] = 60.0
    inputs.current_a[:, 2] = 0.0
    inputs.write_recording()
    assert inputs.run() == 0


def test_a_step_is_found_in_resampled_samples_too(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.joint_deg = swing_deg(UNEVEN_MS / 160.0)
    step_deg = np.degrees(0.5)
    inputs.joint_deg[150:, 3] += step_deg
    inputs.write_recording()
    _with_time(inputs, UNEVEN_MS)
    _refused(inputs, capsys, 4, "column q4, axis J4", "in one sample")


def test_noise_and_a_coarse_encoder_are_no_steps(inputs: ImportInputs) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(scale=0.2, size=(300, 6))
    noisy_deg = inputs.joint_deg + noise
    steps = np.round(noisy_deg / 0.1)
    inputs.joint_deg = steps * 0.1
    inputs.write_recording()
    assert inputs.run() == 0


@pytest.mark.parametrize(("bits", "signed"), [(16, False), (16, True), (20, False), (14, True)])
def test_a_counter_of_fewer_than_32_bits_that_wraps(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], bits: int, signed: bool
) -> None:
    counts = counts_of(inputs)
    least = 0
    if signed:
        least = -(2 ** (bits - 1))
    counts_from_zero = counts[:, 0] - least
    wrapped = counts_from_zero % 2**bits + least
    absolute_wrapped_step = np.abs(np.diff(wrapped))
    lower_limit = 2 ** (bits - 1)
    assert absolute_wrapped_step.max() > lower_limit
    counts[:, 0] = wrapped
    stacked_counts = np.hstack((counts, inputs.current_a))
    inputs.write_csv(stacked_counts)
    inputs.describe(position=position_section("counts", "motor"))
    found = f"a counter of {bits} bits that wraps"
    _refused(inputs, capsys, 4, "column q1", found, "unwrap the column")


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("timed", [False, True])
def test_a_row_or_two_are_no_recording(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], rows: int, timed: bool
) -> None:
    if timed:
        _with_time(inputs, np.arange(300.0))
    path = inputs.data / "run.csv"
    header_and_rows = read_lines(path)[: rows + 1]
    write_lines(path, header_and_rows)
    found = f"{counted(rows, 'row')} of numbers"
    _refused(inputs, capsys, 4, found, "was the export interrupted?")


@pytest.mark.parametrize("change", [0.2, 0.4, -0.3])
@pytest.mark.parametrize("sudden", [False, True])
def test_a_rate_that_drifts(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], change: float, sudden: bool
) -> None:
    """The drift scales velocities, and gains by up to 17 %, while every single step looks right."""
    if sudden:
        share = np.repeat([0.0, 1.0], [151, 148])
    else:
        share = np.linspace(0.0, 1.0, 299)
    steps_ms = 4.0 * (1.0 + change * share)
    time_ms = np.concatenate(([0.0], np.cumsum(steps_ms)))
    _with_time(inputs, time_ms)
    _refused(
        inputs,
        capsys,
        4,
        "run.csv, column t",
        "Hz in parts of the recording",
        "give rate_hz instead of time",
    )


@pytest.mark.slow
def test_an_import_that_is_terminated_leaves_nothing(inputs: ImportInputs) -> None:
    """SIGTERM ends a process at once, unless the verb asks for an interrupt instead."""
    script = (
        "import os, signal, sys\n"
        "from daq.cli.app import main\n"
        "from daq.log.writer import LogWriter\n"
        "write = LogWriter.write\n"
        "def terminate(log, sample):\n"
        "    write(log, sample)\n"
        "    if sample.cycle == 200:\n"
        "        assert log.part.exists()\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "LogWriter.write = terminate\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", script, *inputs.command()]
    done = subprocess.run(
        command,
        cwd=inputs.checkout,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == ExitCode.INTERRUPTED
    assert inputs.left == []
    assert "Traceback" not in done.stderr
    assert "no file was written" in done.stderr


def test_a_number_that_is_no_current(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.current_a[120, 3] = 1e300
    inputs.write_recording()
    _refused(inputs, capsys, 4, "run.csv:122, column i4", "1e+300")


@pytest.mark.parametrize(("value", "words"), [(0.0, "zero in every row"), (3.0, "3 in every row")])
def test_a_dead_channel(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], value: float, words: str
) -> None:
    inputs.current_a[:, 2] = value
    inputs.write_recording()
    _refused(inputs, capsys, 4, "column i3", words)


def test_a_last_number_that_may_lack_digits(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    path = inputs.data / "run.csv"
    content = path.read_bytes()[:-3]
    path.write_bytes(content)
    _refused(inputs, capsys, 4, "without an end of line")


@pytest.mark.parametrize("change", [{"rate_hz": 1e-9}, {"rate_hz": 1e9}])
def test_rates_beyond_reason(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], change: dict[str, object]
) -> None:
    inputs.describe(**change)
    _refused(inputs, capsys, 6, "rate_hz")


def _with_time(inputs: ImportInputs, time_ms: NDArray[np.floating[Any]]) -> None:
    """Put a column of stamps before the recording's columns."""
    run_path = inputs.data / "run.csv"
    header, *rows = read_lines(run_path)
    timed = [f"t,{header}"]
    for stamp_ms, row in zip(time_ms.tolist(), rows, strict=True):
        timed.append(f"{stamp_ms!r},{row}")
    write_lines(run_path, timed)
    inputs.describe(rate_hz=None, time=time_section("ms"))


def test_the_rate_of_a_time_column(inputs: ImportInputs) -> None:
    index = np.arange(300)
    jitter_ms = 0.3 * np.sin(index)
    jitter_ms[299] = 0.0
    time_ms = 5000.0 + 4.0 * index + jitter_ms
    _with_time(inputs, time_ms)
    assert inputs.run() == 0
    assert inputs.load().rate_hz == pytest.approx(250.0)


@pytest.mark.parametrize(("index", "shift"), [(100, 12.0), (100, -4.0), (100, -5.0), (299, 9.0)])
def test_a_jump_in_the_time_column(inputs: ImportInputs, index: int, shift: float) -> None:
    time_ms = 4.0 * np.arange(300)
    time_ms[index:] += shift
    _with_time(inputs, time_ms)
    pattern = rf"run\.csv:{index + 2}, column t"
    with pytest.raises(TableUnfit, match=pattern):
        import_recording(inputs.description, inputs.data, inputs.out, software="x")
    assert inputs.left == []


UNEVEN_RNG = np.random.default_rng(3)
UNEVEN_STEPS_MS = UNEVEN_RNG.choice([3, 5], 299)
UNEVEN_MS = np.concatenate(([0.0], np.cumsum(UNEVEN_STEPS_MS)))


def test_a_uniform_time_column_gives_the_samples_of_a_rate(inputs: ImportInputs) -> None:
    assert inputs.run() == 0
    expected = read_log(inputs.out).samples
    inputs.out.unlink()
    _with_time(inputs, np.arange(300.0))
    assert inputs.run() == 0
    found = read_log(inputs.out).samples
    for name in ("time_ns", "position_counts", "current_raw"):
        found_values = getattr(found, name)
        assert np.array_equal(found_values, getattr(expected, name))


def test_jittered_stamps_are_the_sample_times(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.joint_deg = swing_deg(UNEVEN_MS / 160.0)
    inputs.current_a = np.cos(phases_rad(UNEVEN_MS / 280.0))
    inputs.write_recording()
    _with_time(inputs, UNEVEN_MS)
    assert main(inputs.command("--json")) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["timing"]["resampled"] is True
    longest_step_s = document["timing"]["longest_step_s"]
    assert longest_step_s == pytest.approx(0.005)
    report = info_report(inputs.out)
    timing = json_tree(report)["timing"]
    assert timing == document["timing"]
    # Not the object of a drive, which no recorder has read
    assert set(report.current.values()) == {"a column of the imported file"}
    run = inputs.load()
    time_ms = 1e3 * run.time_s
    position_deg = np.degrees(run.position_rad)
    expected_deg = swing_deg(time_ms / 160.0)
    position_error_deg = np.abs(position_deg - expected_deg)
    assert position_error_deg.max() < 1e-3
    expected_a = np.cos(phases_rad(time_ms / 280.0))
    # A line between samples that are 5 ms apart
    atol_a = (5.0 / 280.0) ** 2 / 8
    np.testing.assert_allclose(run.current_a, expected_a, atol=atol_a)


COUNTS_WITH_WRAPS = np.array([2**30, 1024, 1024, 1024, 1024, 1024])
"""Encoder counts a revolution, of which the first wraps in 32 bits."""


def _with_counts_that_wrap(inputs: ImportInputs, joint_rad: FloatArray) -> None:
    """Write counts of an encoder of 30 bits on the first motor, which wraps after two turns,
    and 10 bits elsewhere.
    """
    cell = inputs.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8")
    of_30_bits = f"revolution: {2**30}"
    first_changed = text.replace("revolution: 65536", of_30_bits, 1)
    changed_text = first_changed.replace("revolution: 65536", "revolution: 1024")
    cell.write_text(changed_text, encoding="utf-8")
    motor_rad = joint_rad @ ratio_of(inputs).T
    turns = motor_rad / (2 * pi)
    turned_counts = np.rint(turns * COUNTS_WITH_WRAPS)
    all_counts = turned_counts.astype(np.int64)
    counts = all_counts.astype(np.int32).astype(np.float64)
    counts_steps = np.diff(counts[:, 0])
    absolute_counts_step = np.abs(counts_steps)
    assert absolute_counts_step.max() > 2**31
    stacked_counts = np.hstack((counts, inputs.current_a))
    inputs.write_csv(stacked_counts)


def test_counts_at_a_rate_go_on_over_a_wrap(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checks see the motion, not the jumps of the counter; what is too fast is so still."""
    joint_deg = swing_deg(np.arange(300) / 160.0, 30.0)
    joint_rad = np.radians(joint_deg)
    _with_counts_that_wrap(inputs, joint_rad)
    counted = position_section("counts", "motor")
    inputs.describe(position=counted, rate_hz=10_000)
    _refused(inputs, capsys, 4, "deg/s", "rate_hz is too high")
    inputs.describe(position=counted)
    assert inputs.run() == 0
    first_axis_rad = inputs.load().position_rad[:, 0]
    expected_rad = joint_rad[:, 0]
    np.testing.assert_allclose(first_axis_rad, expected_rad, atol=1e-8)


def test_counts_without_a_sign_are_those_with_one(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drive's counter of 32 bits that a tool reads as unsigned jumps by 2³² at zero;
    one column stays above it.
    """
    counts = counts_of(inputs)
    inputs.describe(position=position_section("counts", "motor"))
    stacked_counts = np.hstack((counts, inputs.current_a))
    inputs.write_csv(stacked_counts)
    assert inputs.run() == 0
    expected = inputs.load().position_rad
    inputs.out.unlink()
    is_negative = counts < 0
    unsigned = np.where(is_negative, counts + 2**32, counts)
    assert (unsigned >= 0).all()
    unsigned_steps = np.diff(unsigned, axis=0)
    absolute_unsigned_step = np.abs(unsigned_steps)
    assert (absolute_unsigned_step > 2**31).any()
    stacked_unsigned = np.hstack((unsigned, inputs.current_a))
    inputs.write_csv(stacked_unsigned)
    capsys.readouterr()
    assert inputs.run() == 0
    printed = capsys.readouterr().out
    assert "column q1: counts of 32 bits without a sign, read as counts with one" in printed
    position_rad = inputs.load().position_rad
    np.testing.assert_array_equal(position_rad, expected)


def test_resampled_counts_go_on_over_a_wrap_and_are_finer_than_a_count(
    inputs: ImportInputs,
) -> None:
    ratio = ratio_of(inputs)
    joint_deg = swing_deg(UNEVEN_MS / 160.0, 30.0)
    joint_rad = np.radians(joint_deg)
    _with_counts_that_wrap(inputs, joint_rad)
    _with_time(inputs, UNEVEN_MS)
    counted = position_section("counts", "motor")
    inputs.describe(rate_hz=None, position=counted, time=time_section("ms"))
    assert inputs.run() == 0
    run = inputs.load()
    time_ms = 1e3 * run.time_s
    expected_deg = swing_deg(time_ms / 160.0, 30.0)
    expected_rad = np.radians(expected_deg)
    position_difference_rad = run.position_rad - expected_rad
    motor_difference_rad = position_difference_rad @ ratio.T
    difference_turns = motor_difference_rad / (2 * pi)
    difference_counts = difference_turns * COUNTS_WITH_WRAPS
    error = difference_counts[:, 1:]
    assert np.abs(error).max() < 1.0
    rms_error = np.sqrt(np.mean(error**2))
    assert rms_error < 0.35  # once rounded; a second time would make 0.41 of 0.29
    first_axis_difference_rad = position_difference_rad[:, 0]
    assert np.abs(first_axis_difference_rad).max() < 1e-6


@pytest.mark.parametrize(
    ("first", "unit", "started_s", "recorded"),
    [
        (0.0, "ms", 0.0, False),
        (512_300.0, "ms", 512.3, False),
        (1_772_348_400_000.0, "ms", 1_772_348_400.0, True),
    ],
)
def test_the_first_stamp_is_when_the_run_began(
    inputs: ImportInputs, first: float, unit: str, started_s: float, recorded: bool
) -> None:
    time_ms = first + 4.0 * np.arange(300)
    _with_time(inputs, time_ms)
    assert inputs.run() == 0
    run = inputs.load()
    assert run.started_s == pytest.approx(started_s, abs=1e-6)
    assert run.recording is not None
    assert (run.recording.recorded_s is not None) is recorded


def test_without_stamps_or_before_a_trigger_nothing_is_known_of_the_start(
    inputs: ImportInputs,
) -> None:
    assert inputs.run() == 0
    started_s = inputs.load().started_s
    assert started_s is None
    inputs.out.unlink()
    time_ms = 4.0 * np.arange(300) - 100.0
    _with_time(inputs, time_ms)
    assert inputs.run() == 0
    assert inputs.load().started_s is None


def test_a_date_in_a_file_is_when_the_run_began(inputs: ImportInputs) -> None:
    _with_time(inputs, np.arange(300.0))
    path = inputs.data / "run.csv"
    header, *rows = read_lines(path)
    dated = [header]
    for index, row in enumerate(rows):
        second = index // 100
        hundredth = index % 100
        time_of_day = f"08:00:{second:02d}.{hundredth:02d}"
        date = f"2026-03-01T{time_of_day}+01:00"
        _, _, values = row.partition(",")
        dated.append(f"{date},{values}")
    assert len(dated) == 301
    write_lines(path, dated)
    inputs.describe(rate_hz=None, time=time_section("iso8601"))
    assert inputs.run() == 0
    run = inputs.load()
    assert run.rate_hz == pytest.approx(100.0)
    assert run.started_s == 1_772_348_400.0


def test_a_unit_that_makes_a_stamp_absurd(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    time_ms = 1_772_348_400_000_000.0 + 4.0 * np.arange(300)
    _with_time(inputs, time_ms)
    _refused(inputs, capsys, 4, "run.csv:2, column t", "correct `unit` of `time`")


def test_a_first_row_that_is_there_twice(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    time_ms = 4.0 * np.arange(300)
    _with_time(inputs, time_ms)
    first_row = read_lines(inputs.data / "run.csv")[1]
    inputs.spoil_csv(first_row, f"{first_row}\n{first_row}")
    assert inputs.run() == 0
    assert "1 duplicated and dropped" in capsys.readouterr().out
    run = inputs.load()
    expected = np.radians(inputs.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)


def test_zero_offsets_count_on_the_joint_side_too(inputs: ImportInputs) -> None:
    cell = inputs.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8")
    changed_text = text.replace("zero_offset_deg: 0.0", "zero_offset_deg: 30.0", 1)
    cell.write_text(changed_text, encoding="utf-8")
    assert inputs.run() == 0
    expected_deg = inputs.joint_deg.copy()
    expected_deg[:, 0] += 30.0
    expected = np.radians(expected_deg)
    position_rad = inputs.load().position_rad
    np.testing.assert_allclose(position_rad, expected, atol=2e-9)


@pytest.mark.parametrize("mapping", [False, True])
def test_a_factor_for_each_axis(inputs: ImportInputs, mapping: bool) -> None:
    factors = [0.5, 1, -2.0, 0.1, 3, 1.0]
    factor: object = factors
    if mapping:
        factor = {f"J{axis}": factors[axis - 1] for axis in reversed(AXIS_NUMBERS)}
    inputs.describe(current=current_section(factor=factor))
    assert inputs.run() == 0
    actual = inputs.load().current_a
    expected = inputs.current_a * factors
    np.testing.assert_allclose(actual, expected, atol=3e-9)


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        ([1.0, 2.0], ("current.factor", "(1.0, 2.0)", "one for each of J1, J2")),
        ({"J1": 1.0, "J9": 1.0}, ("current.factor", "'J9': 1.0", "a mapping from their names")),
        ([1.0, 2.0, 3.0, 0.0, 1.0, 1.0], ("current.factor", "0")),
        ({"J1": 0.0}, ("current.factor", "0")),
    ],
)
def test_factors_of_other_axes(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], factor: object, said: tuple[str, ...]
) -> None:
    inputs.describe(current=current_section(factor=factor))
    _refused(inputs, capsys, 6, *said)


def _with_velocity(inputs: ImportInputs, velocity_deg_s: FloatArray, **changes: Any) -> None:
    values = np.hstack((inputs.joint_deg, inputs.current_a, velocity_deg_s))
    run_path = inputs.data / "run.csv"
    write_table(run_path, [*NAMES, *VELOCITY_NAMES], values)
    inputs.describe(velocity=velocity_section(**changes))


def _velocity_deg_s() -> FloatArray:
    phase_rad = phases_rad(np.arange(300) / 40.0)
    return 20.0 / 0.040 * np.cos(phase_rad)


@pytest.mark.parametrize("side", ["joint", "motor"])
@pytest.mark.parametrize("unit", ["deg/s", "rad/s"])
def test_velocities_that_agree_change_nothing(inputs: ImportInputs, side: str, unit: str) -> None:
    assert inputs.run() == 0
    expected = read_log(inputs.out).samples.position_counts
    inputs.out.unlink()
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=20.0, size=(300, 6))
    velocity = _velocity_deg_s() + noise
    if unit == "rad/s":
        velocity = np.radians(velocity)
    if side == "motor":
        velocity = velocity @ ratio_of(inputs).T
    _with_velocity(inputs, velocity, side=side, unit=unit)
    assert inputs.run() == 0
    samples = read_log(inputs.out).samples
    assert np.array_equal(samples.position_counts, expected)


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        (
            (1, 1, -1, 1, 1, 1),
            ("column v3, axis J3", "move -1 times as fast", "agree with the positions to 20 %"),
        ),
        ((1, 1, 1, 1, pi / 180, 1), ("axis J5", "move 57.3 times as fast")),
        ((0, 1, 1, 1, 1, 1), ("axis J1", "differ from it by 100 %")),
        (
            (1, pi / 180, -1, 1, 1, pi / 180),
            ("axis J2", "so do those of J3 (-1 times), J6 (57.3 times)"),
        ),
    ],
)
def test_velocities_that_disagree_name_every_axis(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    factors: tuple[float, ...],
    said: tuple[str, ...],
) -> None:
    velocity_deg_s = _velocity_deg_s() * factors
    _with_velocity(inputs, velocity_deg_s)
    _refused(inputs, capsys, 4, *said)


def test_counts_need_an_encoder(inputs: ImportInputs) -> None:
    cell = inputs.folder / "configs/cells/tx40.yaml"
    position = position_section("counts", "motor")
    current = current_section("Nm(motor, a priori)")
    inputs.describe(cell=str(cell), position=position, current=current)
    with pytest.raises(ConfigurationInconsistent, match="counts_per_revolution"):
        import_recording(inputs.description, inputs.data, inputs.out, software="x")


@pytest.mark.slow
def test_the_real_tx40(checkout: Path, shared_data: Path, tmp_path: Path) -> None:
    """Nine seconds of a real arm: every number of the files is in the log to half a count."""
    out = tmp_path / "tx40.mcap"
    description = checkout / "configs/imports/tx40.yaml"
    recordings = shared_data / "tx40"
    words = ["import", description, "--data", recordings, "--out", out]
    assert main([str(word) for word in words]) == 0
    run, cell = load_run(out)
    position_path = recordings / "pos_read_data.csv"
    current_path = recordings / "curr_data.csv"
    motor_rad = np.loadtxt(position_path, delimiter=",", skiprows=1)
    current = np.loadtxt(current_path, delimiter=",", skiprows=1)
    assert run.position_rad.shape == (45000, 6)
    assert run.rate_hz == pytest.approx(5000.0)
    zero_offset_rad = [axis.zero_offset_rad for axis in cell.axes]
    offset_rad = np.array(zero_offset_rad)
    position_difference_rad = run.position_rad - offset_rad
    from_joints_rad = position_difference_rad @ cell.ratio.T
    motor_atol_rad = 1e-9 * np.abs(motor_rad).max()
    np.testing.assert_allclose(from_joints_rad, motor_rad, atol=motor_atol_rad)
    current_atol = 1e-9 * np.abs(current).max()
    np.testing.assert_allclose(run.current_a, current, atol=current_atol)
    # NOTICE: q2 has an offset of −π/2, q3 of +π/2; the arm starts stretched up, both URDF angles
    # near zero.
    start_rad = run.position_rad[0, 1:3]
    np.testing.assert_allclose(start_rad, 0.0, atol=1e-3)


@pytest.mark.parametrize("what", ["device", "pipe"])
def test_a_recording_that_is_no_regular_file_is_refused(inputs: ImportInputs, what: str) -> None:
    recording = inputs.data / "run.csv"
    recording.unlink()
    if what == "device":
        recording.symlink_to("/dev/null")
    else:
        os.mkfifo(recording)
    with pytest.raises(TableUnfit, match="no regular file"):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")
    assert not inputs.out.exists()


def test_a_payload_that_is_not_the_cells_is_named_as_it_was_given(inputs: ImportInputs) -> None:
    inputs.describe(payload="brick")
    with pytest.raises(ConfigurationInconsistent, match="'brick'") as caught:
        import_recording(inputs.description, inputs.data, inputs.out, software="test")
    assert "None" not in str(caught.value)
    assert "payload: NAME" in str(caught.value)


def test_a_full_disk_is_not_reported_as_a_recording(inputs: ImportInputs) -> None:
    inputs.out.parent.rmdir()
    with pytest.raises(OutputFailed) as caught:
        import_recording(inputs.description, inputs.data, inputs.out, software="test")
    assert "nothing was written" in str(caught.value)
    assert "record" not in str(caught.value)


# -- the controller's own torque, and temperatures
# -------------------------------------------------------------------


TORQUE_NAMES = [f"t{axis}" for axis in AXIS_NUMBERS]
TEMPERATURE_NAMES = [f"c{axis}" for axis in AXIS_NUMBERS]


def with_slow_columns(
    inputs: ImportInputs, torque_nm: FloatArray, temperature_c: FloatArray, **changes: object
) -> None:
    """Add a file of torques and temperatures."""
    values = np.hstack((torque_nm, temperature_c))
    slow_path = inputs.data / "slow.csv"
    write_table(slow_path, [*TORQUE_NAMES, *TEMPERATURE_NAMES], values)
    torque = {"file": "slow.csv", "columns": TORQUE_NAMES, **changes}
    temperature = {"file": "slow.csv", "columns": TEMPERATURE_NAMES}
    inputs.describe(rate_hz=50, torque=torque, temperature=temperature)


@pytest.mark.parametrize("side", ["motor", "joint"])
def test_torque_columns_give_a_slope_and_temperature_columns_a_temperature(
    inputs: ImportInputs, side: str
) -> None:
    ratio = ratio_of(inputs)
    gain = np.array([33.0, 32.0, 24.0, -9.0, 16.0, 6.8])
    motor_torque = gain * inputs.current_a
    torque = motor_torque / np.diag(ratio)
    if side == "joint":
        torque = torque @ ratio
    grid = np.linspace(25.0, 31.0, 300)
    later_c = np.arange(6)
    temperature_c = grid[:, None] + later_c
    torque_nm = 1000.0 * torque
    with_slow_columns(inputs, torque_nm, temperature_c, side=side, factor=0.001)
    assert inputs.run() == 0
    run, _ = load_run(inputs.out)
    # 300 rows at 50 Hz: a torque in every second row, a temperature a second.
    slow_readings = info_report(inputs.out).slow_readings
    assert slow_readings == {"torque": 6 * 150, "temperature": 6 * 6}
    slopes = [torque_slope([channel]) for channel in run.torque_channels]
    values = [slope.value for slope in slopes if slope is not None]
    assert values == pytest.approx(gain, rel=1e-6)
    assert run.temperature_c is not None
    # One reading a second, interpolated; the last second keeps its value.
    found_c = run.temperature_c[:250]
    np.testing.assert_allclose(found_c, temperature_c[:250], atol=1e-6)
    np.testing.assert_allclose(run.current_a, inputs.current_a, atol=1e-9)


@pytest.mark.parametrize(
    ("torque", "said"),
    [
        ({"columns": ["i1", "i2"], "side": "motor"}, "2 columns"),
        ({"columns": VELOCITY_NAMES, "side": "motor", "factor": 0.0}, "factor"),
        ({"columns": VELOCITY_NAMES, "side": "motor", "factor": [1.0, 2.0]}, "torque.factor"),
    ],
)
def test_a_torque_column_too_few_and_a_factor_of_zero_are_refused(
    inputs: ImportInputs, torque: dict[str, Any], said: str
) -> None:
    inputs.describe(torque={"file": "run.csv", **torque})
    with pytest.raises(ConfigurationInconsistent, match=said):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


def test_every_section_is_checked_whatever_comes_after_it(inputs: ImportInputs) -> None:
    current = current_section(factor=[1.0, 2.0])
    torque = {"file": "run.csv", "columns": VELOCITY_NAMES, "side": "motor"}
    inputs.describe(current=current, torque=torque)
    with pytest.raises(ConfigurationInconsistent, match=r"current\.factor"):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


def test_a_column_is_not_both_current_and_torque(inputs: ImportInputs) -> None:
    columns = ["v1", "v2", "v3", "i4", "v5", "v6"]
    torque = {"file": "./run.csv", "columns": columns, "side": "motor"}
    inputs.describe(torque=torque)
    pattern = r"torque\.columns: found i4 of .*, which current is read from"
    with pytest.raises(ConfigurationInconsistent, match=pattern):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


def test_the_shipped_description_shows_every_setting(checkout: Path) -> None:
    """Its lines that are commented out are valid, and with them nothing is missing."""
    text = (checkout / "configs/imports/tx40.yaml").read_text(encoding="utf-8")
    encoded_text = re.sub(r"(?m)^# ( *[a-z_]+:)", r"\1", text).encode()
    document = parse_yaml(encoded_text, "tx40.yaml")
    wanted = read_model(document, ImportDescription)
    assert document.tree.keys() == ImportDescription.model_fields.keys()
    sections: dict[str, Any] = dict(wanted.sections())
    sections["table"] = wanted.table
    sections["time"] = wanted.time
    for key, section in sections.items():
        assert section is not None
        expected = {field.name for field in fields(section)}
        assert document.tree[key].keys() == expected, key


def test_a_shipped_description_says_where_its_recordings_are_from(checkout: Path) -> None:
    """The recordings are not shipped."""
    descriptions = sorted((checkout / "configs/imports").glob("*.yaml"))
    assert descriptions
    for path in descriptions:
        head = re.match(r"(#.*\n)+", path.read_text(encoding="utf-8"))
        assert head is not None, path
        assert "repository" in head[0], path
        assert "License" in head[0], path


def test_an_import_without_them_has_neither(inputs: ImportInputs) -> None:
    assert inputs.run() == 0
    run, _ = load_run(inputs.out)
    assert run.torque_channels == ()
    assert run.temperature_c is None


@pytest.mark.parametrize(
    ("key", "section"),
    [
        ("position", position_section(columns=[*POSITION_NAMES[:5], "q1"])),
        ("current", current_section(columns=POSITION_NAMES)),
        ("temperature", {"file": "run.csv", "columns": CURRENT_NAMES}),
    ],
)
def test_a_column_is_read_as_one_thing(
    inputs: ImportInputs, key: str, section: dict[str, Any]
) -> None:
    inputs.describe(**{key: section})
    with pytest.raises(ConfigurationInconsistent, match="which is also"):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


@pytest.mark.parametrize("step", [4_000_000, 4_000, 4])
def test_stamps_in_another_unit_have_no_rate_of_a_robot(inputs: ImportInputs, step: int) -> None:
    stamps = step * np.arange(300.0)
    values = np.column_stack((stamps, inputs.joint_deg, inputs.current_a))
    run_path = inputs.data / "run.csv"
    write_table(run_path, ["t", *NAMES], values)
    inputs.describe(rate_hz=None, time=time_section("s"))
    with pytest.raises(TableUnfit, match="Hz with `unit: s`"):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


def _two_files(inputs: ImportInputs) -> None:
    """Positions with stamps in one file, currents in another one."""
    stamps_s = 0.004 * np.arange(300)
    with_time = np.column_stack((stamps_s, inputs.joint_deg))
    position_path = inputs.data / "position.csv"
    current_path = inputs.data / "current.csv"
    write_table(position_path, ["t", *POSITION_NAMES], with_time)
    write_table(current_path, CURRENT_NAMES, inputs.current_a)


def test_times_that_are_kept_are_rows_of_the_other_file(inputs: ImportInputs) -> None:
    """0.4 to 0.8 s at 250 Hz; the files that have no stamps give the same rows."""
    _two_files(inputs)
    position = position_section(file="position.csv")
    current = current_section(file="current.csv")
    inputs.describe(
        position=position,
        current=current,
        rate_hz=None,
        time=time_section("s", "position.csv"),
        keep={"from_s": 0.4, "to_s": 0.8},
    )
    assert inputs.run() == 0
    run, _ = load_run(inputs.out)
    expected = np.radians(inputs.joint_deg[100:201])
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    expected_a = inputs.current_a[100:201]
    np.testing.assert_allclose(run.current_a, expected_a, atol=1e-9)
    assert run.started_s == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("keep", "rows"),
    [
        ({"from_row": 21}, slice(20, 300)),
        ({"to_row": 280}, slice(0, 280)),
        ({"from_s": 0.02, "to_s": 0.25}, slice(20, 251)),
    ],
)
def test_rows_are_kept_at_a_stated_rate(
    inputs: ImportInputs, keep: dict[str, float], rows: slice
) -> None:
    inputs.describe(keep=keep)
    assert inputs.run() == 0
    run = inputs.load()
    expected = np.radians(inputs.joint_deg[rows])
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)


@pytest.mark.parametrize(
    ("keep", "said"),
    [
        ({"from_row": 5, "to_row": 4}, "a begin before the end"),
        ({"from_s": 1.0, "to_s": 1.0}, "a begin before the end"),
        ({"from_row": 5, "to_s": 4.0}, "rows or times, not both"),
        ({"from_row": 0}, "greater than or equal to 1"),
    ],
)
def test_a_part_that_is_none_is_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], keep: dict[str, float], said: str
) -> None:
    inputs.describe(keep=keep)
    _refused(inputs, capsys, 6, said)


@pytest.mark.parametrize("timed", [False, True])
def test_a_held_out_end_becomes_a_log_of_its_own(inputs: ImportInputs, timed: bool) -> None:
    """No sample is in both, and none is lost."""
    if timed:
        time_ms = 1_772_348_400_000.0 + 4.0 * np.arange(300)
        _with_time(inputs, time_ms)
        time = time_section("ms")
        inputs.describe(rate_hz=None, time=time, holdout={"from_s": 0.8})
    else:
        inputs.describe(holdout={"from_s": 0.2})
    held_out = inputs.out.with_name("held-out.mcap")
    imported = inputs.split(held_out)
    assert imported.statistics.samples == 200
    assert imported.holdout is not None
    assert imported.holdout.samples == 100
    fitted, _ = load_run(inputs.out)
    left_out, _ = load_run(held_out)
    position_rad = np.vstack((fitted.position_rad, left_out.position_rad))
    expected = np.radians(inputs.joint_deg)
    np.testing.assert_allclose(position_rad, expected, atol=2e-9)
    current_a = np.vstack((fitted.current_a, left_out.current_a))
    np.testing.assert_allclose(current_a, inputs.current_a, atol=1e-9)
    if timed:
        assert left_out.started_s == pytest.approx(1_772_348_400.8, abs=1e-3)
    run_id = read_log(inputs.out).head.run.run_id
    assert run_id != read_log(held_out).head.run.run_id


def test_the_command_writes_both_logs_and_reports_them(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs.describe(holdout={"from_s": 0.2})
    held_out = inputs.out.with_name("held-out.mcap")
    command = inputs.command("--holdout", str(held_out), "--json")
    assert main(command) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 200
    assert report["holdout"] == {"log": str(held_out), "samples": 100}


@pytest.mark.parametrize(
    ("part", "named", "error", "said"),
    [
        ({"from_s": 0.2}, False, UsageError, "give `--holdout FILE`"),
        (None, True, UsageError, "found no `holdout`"),
        ({"from_s": 0.3}, True, TableUnfit, "found 0.3 s, of 0.3 s that are imported"),
        ({"from_s": 0.001}, True, TableUnfit, "found 0.001 s, of 0.3 s"),
    ],
)
def test_a_held_out_part_that_is_none_is_refused(
    inputs: ImportInputs,
    part: dict[str, float] | None,
    named: bool,
    error: type[Exception],
    said: str,
) -> None:
    inputs.describe(holdout=part)
    held_out = inputs.out.with_name("held-out.mcap") if named else None
    with pytest.raises(error, match=said):
        inputs.split(held_out)
    assert inputs.left == []


def test_a_log_that_cannot_be_written_leaves_no_held_out_part(inputs: ImportInputs) -> None:
    inputs.describe(holdout={"from_s": 0.2})
    inputs.out.write_bytes(b"mine")
    holdout = inputs.out.with_name("held-out.mcap")
    with pytest.raises(UsageError):
        inputs.split(holdout)
    assert inputs.left == ["run.mcap"]


@pytest.mark.slow
def test_the_real_ur10_is_split_by_its_description(shared_data: Path, tmp_path: Path) -> None:
    """A ROS 2 bag in SQLite; the two logs are the parts that the studies read past the import."""
    folder = shared_data / "ur10"
    bag = "ur10_exciting_trajectory.db3"
    cell = folder / "ur10-cell.yaml"
    document = {
        "name": "ur10",
        "cell": str(cell),
        "position": position_section("rad", file=bag, columns=["position"]),
        "current": current_section("Nm", file=bag, columns=["effort"]),
        "time": {"file": bag, "column": "header.stamp", "unit": "ns"},
        "holdout": {"from_s": 16.512},
    }
    description = tmp_path / "ur10.yaml"
    description.write_text(json.dumps(document), encoding="utf-8")
    fit_log = tmp_path / "fit.mcap"
    held_out_log = tmp_path / "held-out.mcap"
    import_recording(description, folder, fit_log, software="test", holdout=held_out_log)
    recording = ur10(shared_data)
    (whole,) = recording.runs
    (is_fit,) = recording.part_of
    for log, part in ((fit_log, 1), (held_out_log, 0)):
        run, _ = load_run(log)
        assert run.rate_hz == pytest.approx(125.0)
        in_part = is_fit == part
        expected_rad = whole.position_rad[in_part]
        expected_nm = whole.current_a[in_part]
        np.testing.assert_allclose(run.position_rad, expected_rad, atol=1e-8)
        np.testing.assert_allclose(run.current_a, expected_nm, atol=1e-6)


def _file_of_each_axis(inputs: ImportInputs, later_s: float = 0.0, began_s: float = 0.0) -> None:
    """A trace of each axis, with stamps of its own, as the tool of a drive exports them."""
    files = []
    for axis in range(6):
        stamps_s = began_s + 0.004 * np.arange(300)
        if axis == 2:
            stamps_s += later_s
        position_deg = inputs.joint_deg[:, axis]
        current_a = inputs.current_a[:, axis]
        values = np.column_stack((stamps_s, position_deg, current_a))
        file = f"axis{axis + 1}.csv"
        path = inputs.data / file
        write_table(path, ["t", "position", "current"], values)
        files.append(file)
    current_columns = ["current"] * 6
    position = position_section(file=files, columns=["position"])
    current = current_section(file=files, columns=current_columns)
    time = time_section("s", "axis1.csv")
    inputs.describe(position=position, current=current, rate_hz=None, time=time)


def test_axes_come_from_a_file_each(inputs: ImportInputs) -> None:
    _file_of_each_axis(inputs)
    assert inputs.run() == 0
    run, _ = load_run(inputs.out)
    expected = np.radians(inputs.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, inputs.current_a, atol=1e-9)


def test_an_error_names_the_file_of_its_axis(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    _file_of_each_axis(inputs)
    path = inputs.data / "axis4.csv"
    lines = read_lines(path)
    stamp_s, position_deg, _ = lines[41].split(",")
    lines[41] = f"{stamp_s},{position_deg},1e9"
    write_lines(path, lines)
    _refused(inputs, capsys, 4, "axis4.csv:42, column current")
    lines[41] = f"{stamp_s},5000.0,0.1"
    write_lines(path, lines)
    _refused(inputs, capsys, 4, "import description 'run', axis J4")


@pytest.mark.parametrize("later_s", [0.05, 86400.0])
def test_files_of_axes_whose_dates_differ_are_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], later_s: float
) -> None:
    _file_of_each_axis(inputs, later_s, began_s=1_772_000_000.0)
    found = f"{later_s:.6g} s after those of axis1.csv"
    _refused(inputs, capsys, 4, "axis3.csv", found, "of different times")


def test_files_of_axes_belong_together_by_their_stamps(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row that one file lacks would shift its axis; a clock that begins elsewhere is said."""
    _file_of_each_axis(inputs, later_s=0.1)
    assert inputs.run() == 0
    assert "axis3.csv: its stamps begin 0.1 s after those of axis1.csv" in capsys.readouterr().out
    inputs.out.unlink()
    path = inputs.data / "axis3.csv"
    lines = read_lines(path)
    del lines[50]
    lines.append("1.3,0.0,0.0")
    write_lines(path, lines)
    expected = "rows of the same instants in both files"
    _refused(inputs, capsys, 4, "axis3.csv:51, column time", expected)


@pytest.mark.parametrize(
    ("files", "columns", "said"),
    [
        (["axis1.csv", "axis2.csv"], ["position"], "2 columns"),
        (["axis1.csv", "axis2.csv"], ["position"] * 3, "as many files as columns"),
    ],
)
def test_files_and_columns_that_do_not_match_are_refused(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    files: list[str],
    columns: list[str],
    said: str,
) -> None:
    _file_of_each_axis(inputs)
    current = {"file": files, "columns": columns, "unit": "A"}
    inputs.describe(current=current)
    _refused(inputs, capsys, 6, said)


@pytest.mark.parametrize("kind", ["mapping", "list"])
def test_currents_of_one_cell_may_have_several_units(inputs: ImportInputs, kind: str) -> None:
    """As N of a prismatic axis beside Nm of the others."""
    cell = inputs.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8")
    assert text.count("nameplate_gain_nm_per_a:") == 6
    first, *rest = re.split("nameplate_gain_nm_per_a:(.*)", text)
    for axis, gain in enumerate(rest[::2]):
        unit = "Nm/N" if axis == 1 else "Nm/Nm"
        after = rest[2 * axis + 1]
        first += f"nameplate_gain: {gain.strip()}\n"
        first += f'    gain_unit: "{unit}"{after}'
    cell.write_text(first, encoding="utf-8")
    units = {"J1": "Nm", "J2": "N", "J3": "Nm", "J4": "Nm", "J5": "Nm", "J6": "Nm"}
    stated: object
    if kind == "mapping":
        stated = units
    else:
        stated = list(units.values())
    inputs.describe(current=current_section(stated))
    assert inputs.run() == 0
    axes = load_run(inputs.out)[1].axes
    gain_units = [axis.gain_unit for axis in axes]
    assert gain_units[:3] == ["Nm/Nm", "Nm/N", "Nm/Nm"]


@pytest.mark.parametrize("unit", ["Nm", ["Nm"] * 5, {"J1": "Nm"}])
def test_units_of_other_axes_are_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], unit: object
) -> None:
    inputs.describe(current=current_section(unit))
    _refused(inputs, capsys, 6, "current.unit")


@pytest.mark.parametrize("unit", ["deg", "counts"])
def test_axes_that_count_the_other_way_are_reversed(inputs: ImportInputs, unit: str) -> None:
    """Their velocities are checked likewise."""
    values = inputs.joint_deg
    side = "joint"
    if unit == "counts":
        values = counts_of(inputs)
        side = "motor"
    section = position_section(unit, side)
    inputs.write_csv(np.hstack((values, inputs.current_a)))
    inputs.describe(position=section)
    assert inputs.run() == 0
    expected = inputs.load().position_rad
    inputs.out.unlink()
    values = values.copy()
    values[:, 1] *= -1.0
    values[:, 3] *= -1.0
    inputs.write_csv(np.hstack((values, inputs.current_a)))
    position = {**section, "reversed": ["J2", "J4"]}
    inputs.describe(position=position)
    assert inputs.run() == 0
    position_rad = inputs.load().position_rad
    np.testing.assert_allclose(position_rad, expected, atol=1e-9)


def test_velocities_have_signs_of_their_own(inputs: ImportInputs) -> None:
    velocity_deg_s = np.gradient(inputs.joint_deg, 0.001, axis=0)
    velocity_deg_s[:, 2] *= -1.0
    _with_velocity(inputs, velocity_deg_s)
    assert inputs.run() == 4
    inputs.describe(velocity=velocity_section(reversed=["J3"]))
    assert inputs.run() == 0


@pytest.mark.parametrize("key", ["position", "velocity"])
def test_a_reversed_axis_that_is_none_is_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    if key == "velocity":
        section = velocity_section(reversed=["J9"])
    else:
        section = position_section(reversed=["J9"])
    inputs.describe(**{key: section})
    _refused(inputs, capsys, 6, f"{key}.reversed", "J9", "some of J1, J2")


TORQUE_SECTION = {"file": "run.csv", "columns": VELOCITY_NAMES, "side": "motor"}


def _with_setting(inputs: ImportInputs, key: str, value: object) -> None:
    """A description with one more setting, of a section where the key has a dot."""
    section, dot, setting = key.rpartition(".")
    if not dot:
        inputs.describe(**{key: value})
        return
    sections: dict[str, dict[str, Any]] = {
        "position": position_section(),
        "current": current_section(),
        "velocity": velocity_section(),
        "torque": TORQUE_SECTION,
    }
    with_setting = sections[section] | {setting: value}
    inputs.describe(**{section: with_setting})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("topic", "/joint_states"),
        ("publisher", 1),
        ("rhythm", 2),
        ("position.topic", "/joint_states"),
        ("current.publisher", 2),
        ("velocity.topic", "/joint_states"),
        ("torque.publisher", 1),
    ],
)
def test_a_setting_for_bags_is_refused_where_no_file_is_a_bag(
    inputs: ImportInputs, key: str, value: object
) -> None:
    _with_setting(inputs, key, value)
    with pytest.raises(ConfigurationInconsistent) as caught:
        import_recording(inputs.description, inputs.data, inputs.out, software="test")
    assert caught.value.subject == f"import description 'run': {key}"
    assert "run.csv" in caught.value.found
    assert "a ROS bag" in caught.value.expected
    assert inputs.left == []


@pytest.mark.parametrize(
    ("setting", "value", "kind"),
    [
        ("topic", "/joint_states", "a ROS bag"),
        ("table", {"delimiter": ";"}, "a CSV file"),
        ("table", {"skip_rows": 4}, "a CSV file"),
    ],
)
def test_settings_for_bags_and_csv_are_refused_for_matlab(
    inputs: ImportInputs, setting: str, value: object, kind: str
) -> None:
    run_path = inputs.data / "run.mat"
    savemat(run_path, {"q": inputs.joint_deg, "i": inputs.current_a})
    position = position_section(file="run.mat", columns=["q"])
    current = current_section(file="run.mat", columns=["i"])
    inputs.describe(position=position, current=current)
    assert inputs.run() == 0
    inputs.out.unlink()
    # The defaults may be stated: they ask for nothing.
    stated_default = {"delimiter": ","}
    inputs.describe(position=position, current=current, table=stated_default, topic=None)
    assert inputs.run() == 0
    inputs.out.unlink()
    inputs.describe(position=position, current=current, **{setting: value})
    pattern = f"'run': {setting}: .*{kind}"
    with pytest.raises(ConfigurationInconsistent, match=pattern):
        import_recording(inputs.description, inputs.data, inputs.out, software="test")


@pytest.mark.parametrize(
    ("changes", "place", "found", "expected"),
    [
        ({"file": 3}, "position.file", "integer 3", "a valid string, or a valid array"),
        ({"columns": [0, *NAMES[1:6]]}, "position.columns[0]", "integer 0", "a valid string, or"),
        ({"reversed": ["J1", "J1"]}, "position.reversed", "J1 more than once", "each axis once"),
    ],
)
def test_a_value_of_no_allowed_kind_is_one_fault_in_words(
    inputs: ImportInputs,
    capsys: pytest.CaptureFixture[str],
    changes: Any,
    place: str,
    found: str,
    expected: str,
) -> None:
    """A fault was there once for each kind, under names of pydantic: `file.constrained-str`."""
    inputs.describe(position=position_section(**changes))
    assert inputs.run() == ExitCode.CONFIGURATION
    shown = capsys.readouterr().err
    assert f": {place}\n" in shown
    for text in (found, expected):
        assert text in shown
    for internal in ("constrained", "tuple[", "dict["):
        assert internal not in shown
    assert not inputs.left


def test_a_mounting_without_a_payload_is_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log was that of a bare arm, without a word."""
    inputs.describe(mounting="flange-a")
    _refused(inputs, capsys, 6, "mounting", "'flange-a' without `payload`")


@pytest.mark.parametrize("delimiter", ["1", "e", "-", "_", '"', "\n", "\0"])
def test_a_delimiter_that_numbers_or_names_have_is_refused(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str], delimiter: str
) -> None:
    inputs.describe(table={"delimiter": delimiter})
    _refused(inputs, capsys, 6, "a delimiter that no number or name has")


def test_one_name_for_both_logs_is_refused_before_anything_is_written(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second log found the first in its way, and the advice was to move it away."""
    inputs.describe(holdout={"from_s": 0.2})
    link = inputs.out.with_name("link.mcap")
    link.symlink_to(inputs.out.name)
    for name in (inputs.out, link):
        with pytest.raises(UsageError, match="one name for both logs"):
            inputs.split(name)
    assert inputs.left == ["link.mcap"]


def test_a_folder_that_is_not_there_is_what_is_named(
    inputs: ImportInputs, capsys: pytest.CaptureFixture[str]
) -> None:
    """The advice was to free space."""
    inputs.out = inputs.folder / "none" / "run.mcap"
    assert inputs.run() == ExitCode.UNEXPECTED
    shown = capsys.readouterr().err
    assert f"no folder {inputs.out.parent}" in shown
    assert "mkdir -p" in shown
    assert "space" not in shown
    assert not inputs.out.parent.exists()
