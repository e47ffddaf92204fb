"""CSV files of other controllers: the same numbers in a log, or an error and nothing."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat

from daq.cli.app import main
from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.config.import_description import ImportDescription
from daq.config.yaml_file import parse_yaml, read_model
from daq.errors import ConfigurationInconsistent, ExitCode, OutputFailed, TableUnfit, UsageError
from daq.log.conversion import load_run
from daq.log.importing import import_recording, quantise
from daq.log.reader import read_log
from daq.report.document import json_tree
from daq.report.log import info_report
from ident.data.channel_faults import FaultKind, find_faults
from ident.data.torque_channel import torque_slope
from ident.model.robot import Motion
from tests.daq.command_line import run_verb
from tests.studies.real_runs import ur10

FloatArray = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
NAMES = [f"q{i}" for i in range(1, 7)] + [f"i{i}" for i in range(1, 7)]


class Bench:
    """A folder with the demo cell, a recording of it and its description, for a test to spoil."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        """Store the folders."""
        self.checkout = checkout
        self.folder = folder
        self.data = folder / "data"
        self.out = folder / "out" / "run.mcap"
        phase_rad = np.arange(300)[:, None] / 40.0 + np.arange(6)
        self.joint_deg = 20.0 * np.sin(phase_rad)
        self.current_a = np.cos(np.arange(300)[:, None] / 7.0 + np.arange(6))

    def prepare(self) -> Bench:
        """Make all files."""
        configs_folder = self.checkout / "configs"
        shutil.copytree(configs_folder, self.folder / "configs")
        self.data.mkdir()
        self.out.parent.mkdir()
        stacked_joint_deg = np.hstack((self.joint_deg, self.current_a))
        self.write_csv(stacked_joint_deg)
        self.describe()
        return self

    def write_csv(self, values: FloatArray, delimiter: str = ",") -> None:
        """The recording, positions before currents."""
        lines = [
            delimiter.join(NAMES),
            *(delimiter.join(map(repr, row)) for row in values.tolist()),
        ]
        run_path = self.data / "run.csv"
        text = "\n".join(lines) + "\n"
        run_path.write_text(text, encoding="utf-8")

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
        position = {"file": "run.csv", "columns": NAMES[:6], "unit": "deg", "side": "joint"}
        current = {"file": "run.csv", "columns": NAMES[6:], "unit": "A"}
        document: dict[str, object] = {
            "name": "run",
            "cell": "../cells/demo.yaml",
            "position": position,
            "current": current,
            "rate_hz": 1000,
        }
        document.update(changes)
        text = json.dumps({key: value for key, value in document.items() if value is not None})
        self.description.write_text(
            text,
            encoding="utf-8",
        )

    def run(self) -> int:
        """The command; its exit code."""
        return run_verb("import", self.description, "--data", self.data, "--out", self.out)

    @property
    def left(self) -> list[str]:
        """List the folder of the log."""
        files = self.out.parent.iterdir()
        return sorted(path.name for path in files)


@pytest.fixture
def bench(checkout: Path, tmp_path: Path) -> Bench:
    """A bench with good files."""
    return Bench(checkout, tmp_path).prepare()


def test_the_files_are_beside_the_description_where_no_folder_is_named(bench: Bench) -> None:
    beside = bench.description.parent / "run.csv"
    beside.write_bytes((bench.data / "run.csv").read_bytes())
    assert main(["import", str(bench.description), "--out", str(bench.out)]) == ExitCode.OK
    assert bench.left == [bench.out.name]


def test_joint_degrees_come_back_as_radians(bench: Bench) -> None:
    assert bench.run() == 0
    run, cell = load_run(bench.out)
    assert cell.name == "demo"
    assert run.rate_hz == pytest.approx(1000.0)
    expected = np.radians(bench.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, bench.current_a, atol=1e-9)
    assert run.payload is None
    assert bench.left == ["run.mcap"]


def test_motor_radians_counts_and_joint_degrees_are_the_same_run(bench: Bench) -> None:
    cell = load_run_of(bench)
    joint_rad = np.radians(bench.joint_deg)
    motor_rad = joint_rad @ cell.T
    counts = np.rint(motor_rad / (2 * pi) * 65536)
    for unit, values in (("rad", motor_rad), ("counts", counts)):
        bench.write_csv(np.hstack((values, bench.current_a)))
        position = {"file": "run.csv", "columns": NAMES[:6], "unit": unit, "side": "motor"}
        bench.describe(position=position)
        bench.out.unlink(missing_ok=True)
        assert bench.run() == 0
        position_rad = load_run(bench.out)[0].position_rad
        expected = np.radians(bench.joint_deg)
        np.testing.assert_allclose(position_rad, expected, atol=3e-6)


def load_run_of(bench: Bench) -> FloatArray:
    """R of the bench's cell."""
    text = (bench.folder / "configs/cells/demo.yaml").read_bytes()
    tree = parse_yaml(text, "cell").tree
    ratio = tree["drive_train"]["ratio"]
    return np.array(ratio, dtype=np.float64)


def test_column_numbers_semicolons_and_decimal_commas(bench: Bench) -> None:
    stacked_joint_deg = np.hstack((bench.joint_deg, 1000.0 * bench.current_a))
    bench.write_csv(stacked_joint_deg, delimiter=";")
    path = bench.data / "run.csv"
    text = path.read_text(encoding="utf-8")
    changed_text = text.replace(".", ",")
    path.write_text("exported by X\n" + changed_text, encoding="utf-8-sig")
    position = {"file": "run.csv", "columns": [1, 2, 3, 4, 5, 6], "unit": "deg", "side": "joint"}
    current = {"file": "run.csv", "columns": [7, 8, 9, 10, 11, 12], "unit": "A", "factor": 0.001}
    table = {"delimiter": ";", "decimal": ",", "skip_rows": 1}
    bench.describe(
        table=table,
        position=position,
        current=current,
        payload="disc",
    )
    assert bench.run() == 0
    run = load_run(bench.out)[0]
    expected = np.radians(bench.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, bench.current_a, atol=1e-9)
    assert run.payload is not None
    assert run.payload.known == {"m": 4.59}


def test_a_robot_with_a_joint_that_follows_an_axis_is_imported_by_its_axes(bench: Bench) -> None:
    urdf = bench.folder / "configs/robots/tx40.urdf"
    follower = """<link name="behind"/><joint name="rod" type="revolute"><origin xyz="0 0 0.1"/>
      <parent link="link6"/><child link="behind"/><axis xyz="0 1 0"/>
      <limit lower="-9" upper="9" velocity="1" effort="1"/>
      <mimic joint="J5" multiplier="-0.5" offset="0.1"/></joint></robot>"""
    text = urdf.read_text(encoding="utf-8")
    changed_text = text.replace("</robot>", follower)
    urdf.write_text(changed_text, encoding="utf-8")
    assert bench.run() == 0
    run, cell = load_run(bench.out)
    still = np.zeros_like(run.position_rad)
    joints = model_of(cell).follow(Motion(run.position_rad, still, still)).joints
    expected = np.radians(bench.joint_deg)
    actual = joints.position_rad[:, :6]
    np.testing.assert_allclose(actual, expected, atol=2e-9)
    joint_rad = np.radians(bench.joint_deg[:, 4])
    np.testing.assert_allclose(joints.position_rad[:, 6], 0.1 - 0.5 * joint_rad, atol=2e-9)


def test_the_same_files_give_the_same_log(bench: Bench) -> None:
    assert bench.run() == 0
    first = bench.out.read_bytes()
    bench.out.unlink()
    assert bench.run() == 0
    assert bench.out.read_bytes() == first


@given(arrays(np.float64, (5, 2), elements=st.floats(-1e12, 1e12)))
def test_nothing_is_lost_by_counting(values: FloatArray) -> None:
    raw, quantum = quantise(values)
    largest = np.abs(values).max(axis=0)
    largest_absolute_raw = np.abs(raw).max()
    assert largest_absolute_raw <= 2**31 - 1
    assert (np.abs(values - raw * quantum) <= quantum / 2).all()
    assert (quantum[largest > 1e-200] <= 1e-9 * largest[largest > 1e-200]).all()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("q1,q2", "q1,qq", ("columns q1, qq", "one column 'q2'")),
        ("\n20.0,", "\n", ()),
        ("q1,", "", ("expected: 11, as in the header",)),
    ],
)
def test_wrong_columns(
    bench: Bench, capsys: pytest.CaptureFixture[str], old: str, new: str, said: tuple[str, ...]
) -> None:
    if old == "\n20.0,":
        run_path = bench.data / "run.csv"
        rows = run_path.read_text(encoding="utf-8").splitlines()
        old = rows[7]
        new = rows[7].partition(",")[2]
        said = ("run.csv:8", "11 columns", "12, as in the header")
    bench.spoil_csv(old, new)
    _refused(bench, capsys, 4, *said)


def _refused(bench: Bench, capsys: pytest.CaptureFixture[str], code: int, *said: str) -> None:
    assert bench.run() == code
    output = capsys.readouterr()
    assert output.out == ""
    for label in ("error:", "found:", "expected:", "do:"):
        assert label in output.err
    for text in said:
        assert text in output.err
    assert bench.left == []


@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "", "n/a", "1.2.3", "1e999"])
def test_a_field_that_is_no_finite_number(
    bench: Bench, capsys: pytest.CaptureFixture[str], word: str
) -> None:
    run_path = bench.data / "run.csv"
    rows = run_path.read_text(encoding="utf-8").splitlines()
    fields = rows[41].split(",")
    fields[8] = word
    bench.spoil_csv(rows[41], ",".join(fields))
    _refused(bench, capsys, 4, "run.csv:42, column i3", repr(word), "a finite number")


@pytest.mark.parametrize(("copied", "original"), [(3, 1), (10, 7)])
def test_two_axes_with_the_same_numbers_are_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str], copied: int, original: int
) -> None:
    values = np.hstack((bench.joint_deg, bench.current_a))
    values[:, copied] = values[:, original]
    bench.write_csv(values)
    _refused(
        bench,
        capsys,
        4,
        f"column {NAMES[copied]}",
        f"the same number as column {NAMES[original]} of run.csv",
    )


def test_a_copy_of_a_file_is_no_other_axis(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    _file_of_each_axis(bench)
    files = bench.data.glob("*1.csv")
    first = sorted(files)[0]
    sorted_files = sorted(bench.data.glob("*2.csv"))
    second = sorted_files[0]
    second.write_bytes(first.read_bytes())
    _refused(bench, capsys, 4, second.name, f"of {first.name} in all")


def test_units_by_the_name_of_an_axis_are_compared_with_the_file(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    units = ["deg"] * 6 + ["A"] * 5 + ["mA"]
    header = ",".join(NAMES)
    bench.spoil_csv(header, header + "\n" + ",".join(units))
    path = bench.folder / "configs/cells/demo.yaml"
    of_axes = dict.fromkeys(load_cell(path).axis_names, "A")
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": of_axes}
    bench.describe(current=current)
    _refused(bench, capsys, 4, f"column {NAMES[11]}", "unit 'mA' in the line of units", "'A'")


def test_a_missing_file(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    (bench.data / "run.csv").unlink()
    _refused(bench, capsys, 4, "run.csv", "no such file", "--data")


@pytest.mark.parametrize("text", ["", "\n\n", ",".join(NAMES), ",".join(NAMES) + "\n"])
def test_an_empty_file(bench: Bench, capsys: pytest.CaptureFixture[str], text: str) -> None:
    run_path = bench.data / "run.csv"
    run_path.write_text(text, encoding="utf-8")
    _refused(bench, capsys, 4, "before the numbers", "a line of numbers for each sample")


def test_every_truncation_that_shows_is_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    run_path = bench.data / "run.csv"
    data = run_path.read_bytes().rstrip(b"\n")
    last = data.rpartition(b"\n")[2]
    for keep in (3, len(last) // 2, last.rindex(b","), last.rindex(b",") + 1):
        (bench.data / "run.csv").write_bytes(data[: len(data) - len(last) + keep])
        _refused(bench, capsys, 4, "run.csv:301", "the file ends early")


def test_binary_is_no_csv(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    (bench.data / "run.csv").write_bytes(b"q1\n\xff\xfe\x00")
    _refused(bench, capsys, 4, "no UTF-8")


def test_degrees_declared_as_radians(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    position = {"file": "run.csv", "columns": NAMES[:6], "unit": "rad", "side": "joint"}
    bench.describe(position=position)
    _refused(bench, capsys, 4, "degrees were taken for radians")


def test_radians_declared_as_degrees(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    joint_rad = np.radians(bench.joint_deg)
    stacked_joint_rad = np.hstack((joint_rad, bench.current_a))
    bench.write_csv(stacked_joint_rad)
    _refused(bench, capsys, 4, "radians were taken for degrees")


def test_fractional_counts(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    position = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    bench.describe(position=position)
    _refused(bench, capsys, 4, "run.csv:2, column q2", "a whole number of encoder counts")


def test_files_of_different_length(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    run_path = bench.data / "run.csv"
    lines = run_path.read_text(encoding="utf-8").splitlines()
    short_path = bench.data / "short.csv"
    short_path.write_text("\n".join(lines[:-5]) + "\n", encoding="utf-8")
    current = {"file": "short.csv", "columns": NAMES[6:], "unit": "A"}
    bench.describe(current=current)
    _refused(bench, capsys, 4, "300 rows in run.csv and 295 rows in short.csv")


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
        (
            {
                "position": {
                    "file": "run.csv",
                    "columns": NAMES[:6],
                    "unit": "grad",
                    "side": "joint",
                }
            },
            ("position.unit",),
        ),
        (
            {
                "position": {
                    "file": "run.csv",
                    "columns": NAMES[:6],
                    "unit": "counts",
                    "side": "joint",
                }
            },
            ("motor",),
        ),
        (
            {"current": {"file": "run.csv", "columns": NAMES[6:], "unit": "mA"}},
            ("'mA'", "current in 'A'", "factor"),
        ),
        (
            {"current": {"file": "run.csv", "columns": NAMES[6:11], "unit": "A"}},
            ("5 columns", "6, as many"),
        ),
    ],
)
def test_a_wrong_description(
    bench: Bench,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
    said: tuple[str, ...],
) -> None:
    bench.describe(**changes)
    _refused(bench, capsys, 6, *said)


def test_a_duplicate_key_in_the_description(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.description.write_text(
        bench.description.read_text(encoding="utf-8") + "\n", encoding="utf-8"
    )
    text = bench.description.read_text(encoding="utf-8").replace(
        '"rate_hz": 1000', '"rate_hz": 1000,\n"rate_hz": 500'
    )
    bench.description.write_text(text, encoding="utf-8")
    _refused(bench, capsys, 6, "run.yaml:2", "duplicate key 'rate_hz', first on line 1")


def test_a_missing_description(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.description.unlink()
    _refused(bench, capsys, 6, "run.yaml", "no such file")


def test_an_existing_log_stays(bench: Bench) -> None:
    bench.out.write_bytes(b"precious")
    with pytest.raises(UsageError, match="a file of that name"):
        import_recording(bench.description, bench.data, bench.out, software="x")
    assert bench.out.read_bytes() == b"precious"
    assert bench.left == ["run.mcap"]


def test_a_full_disk_leaves_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert bench.run() == 1
    assert bench.left == []


def test_a_rate_that_makes_the_joints_too_fast(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.describe(rate_hz=100_000.0)
    _refused(bench, capsys, 4, "deg/s", "rate_hz is too high")


@pytest.mark.parametrize("wrong", [0.1, 1.0, 10.0])
def test_a_rate_that_is_ten_times_off_is_noticed(
    bench: Bench, wrong: float, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """At 1 kHz the joints reach 80 to 90 % of the slowest limit."""
    seconds = np.arange(1000)[:, None] / 1000.0
    phase_rad = 2.0 * np.pi * seconds + np.arange(6)
    bench.joint_deg = 30.0 * np.sin(phase_rad)
    bench.current_a = np.cos(seconds * 140.0 + np.arange(6))
    bench.joint_deg[500, 2] += 0.5  # one outlier is not taken for a wrong rate
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    rate_hz = 1000.0 * wrong
    bench.describe(rate_hz=rate_hz)
    if wrong > 1.0:
        _refused(bench, capsys, 4, "deg/s", "rate_hz is too high")
    else:
        assert bench.run() == 0
    assert ("no joint is faster than" in caplog.text) is (wrong < 1.0)


@pytest.mark.parametrize("size", [True, False])
def test_currents_without_their_sign_are_noticed(
    bench: Bench, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, size: bool
) -> None:
    """The log is made, since other programs can read it; a fit refuses it."""
    seconds = np.arange(2000)[:, None] / 1000.0
    bench.joint_deg = 20.0 * np.sin(5.0 * seconds + np.arange(6))
    current = np.cos(30.0 * seconds + np.arange(6))
    bench.current_a = np.abs(current) if size else current
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    assert bench.run() == 0
    assert ("J1, J2, J3, J4, J5, J6: found currents that are never negative" in caplog.text) is size
    capsys.readouterr()
    code = main(["fit", str(bench.out)])
    said = capsys.readouterr().err
    assert code == 4
    assert ("never negative" in said) is size
    assert "heavier payload" not in said


@pytest.mark.parametrize("back", [False, True])
def test_a_step_that_no_motor_makes(
    bench: Bench, capsys: pytest.CaptureFixture[str], back: bool
) -> None:
    """A step of 0.5 rad in one sample: the speeds over many samples do not show it."""
    bench.joint_deg[120 : 121 if back else None, 2] += np.degrees(0.5)
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _refused(
        bench,
        capsys,
        4,
        "run.csv:122, column q3, axis J3",
        "in one sample",
        "the limit in the cell configuration",
    )


def test_a_step_of_an_axis_that_rests_is_refused_too(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing else of that axis changes, and the step itself is no noise to compare it with."""
    bench.joint_deg[:, 2] = 60.0
    bench.joint_deg[120, 2] += np.degrees(0.5)
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _refused(
        bench,
        capsys,
        4,
        "column q3, axis J3",
        "in one sample",
        "the limit in the cell configuration",
    )


SMALL_GLITCH_DEG = 1.5
"""A step that `check_steps` accepts beside the motion of this axis."""


def test_a_glitch_that_no_limit_rules_out_is_said_and_left_to_the_fit(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.joint_deg[120, 2] += SMALL_GLITCH_DEG
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    assert bench.run() == 0
    printed = capsys.readouterr().out
    said = " ".join(printed.split())
    assert "run.csv:122, column q3, axis J3: a position that leaves its course by up to 1." in said
    run, cell = load_run(bench.out)
    position_deg = np.degrees(run.position_rad[120, 2])
    assert position_deg == pytest.approx(bench.joint_deg[120, 2], abs=1e-4)
    (fault,) = find_faults(run.position_rad, run.current_a, run.rate_hz, cell.ratio)
    expected = (FaultKind.GLITCH, 2, [[120, 121]])
    assert (fault.kind, fault.axis, fault.stretches.tolist()) == expected


def test_a_glitch_of_a_current_among_resampled_rows_does_not_reach_the_log(bench: Bench) -> None:
    phase_rad = UNEVEN_MS[:, None] / 160.0 + np.arange(6)
    bench.joint_deg = 20.0 * np.sin(phase_rad)
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _with_time(bench, UNEVEN_MS)
    assert bench.run() == 0
    sound, _ = load_run(bench.out)
    bench.out.unlink()
    bench.current_a[200, 1] *= 100.0
    bench.write_csv(np.hstack((bench.joint_deg, bench.current_a)))
    _with_time(bench, UNEVEN_MS)
    assert bench.run() == 0
    mended, _ = load_run(bench.out)
    assert np.array_equal(mended.position_rad, sound.position_rad)
    current_difference_a = mended.current_a - sound.current_a
    assert np.abs(current_difference_a).max() < 0.1


def test_an_axis_at_rest_may_have_no_current(bench: Bench) -> None:
    """Its brake holds it, and its motor has no power."""
    bench.joint_deg[:, 2] = 60.0
    bench.current_a[:, 2] = 0.0
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    assert bench.run() == 0


def test_a_step_is_found_in_resampled_samples_too(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    phase_rad = UNEVEN_MS[:, None] / 160.0 + np.arange(6)
    bench.joint_deg = 20.0 * np.sin(phase_rad)
    bench.joint_deg[150:, 3] += np.degrees(0.5)
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _with_time(bench, UNEVEN_MS)
    _refused(bench, capsys, 4, "column q4, axis J4", "in one sample")


def test_noise_and_a_coarse_encoder_are_no_steps(bench: Bench) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(scale=0.2, size=(300, 6))
    bench.write_csv(np.hstack((np.round((bench.joint_deg + noise) / 0.1) * 0.1, bench.current_a)))
    assert bench.run() == 0


@pytest.mark.parametrize(("bits", "signed"), [(16, False), (16, True), (20, False), (14, True)])
def test_a_counter_of_fewer_than_32_bits_that_wraps(
    bench: Bench, capsys: pytest.CaptureFixture[str], bits: int, signed: bool
) -> None:
    joint_rad = np.radians(bench.joint_deg)
    counts = np.rint(joint_rad @ load_run_of(bench).T / (2 * pi) * 65536)
    least = -(2 ** (bits - 1)) if signed else 0
    counts_from_zero = counts[:, 0] - least
    wrapped = counts_from_zero % 2**bits + least
    absolute_wrapped_step = np.abs(np.diff(wrapped))
    lower_limit = 2 ** (bits - 1)
    assert absolute_wrapped_step.max() > lower_limit
    counts[:, 0] = wrapped
    stacked_counts = np.hstack((counts, bench.current_a))
    bench.write_csv(stacked_counts)
    position = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    bench.describe(position=position)
    _refused(
        bench, capsys, 4, "column q1", f"a counter of {bits} bits that wraps", "unwrap the column"
    )


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("timed", [False, True])
def test_a_row_or_two_are_no_recording(
    bench: Bench, capsys: pytest.CaptureFixture[str], rows: int, timed: bool
) -> None:
    if timed:
        _with_time(bench, np.arange(300.0))
    path = bench.data / "run.csv"
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    path.write_text(
        "".join(lines[: rows + 1]),
        encoding="utf-8",
    )
    _refused(bench, capsys, 4, f"{rows} rows of numbers", "was the export interrupted?")


@pytest.mark.parametrize("change", [0.2, 0.4, -0.3])
@pytest.mark.parametrize("sudden", [False, True])
def test_a_rate_that_drifts(
    bench: Bench, capsys: pytest.CaptureFixture[str], change: float, sudden: bool
) -> None:
    """The drift scales velocities, and gains by up to 17 %, while every single step looks right."""
    share = (np.arange(299) > 150) if sudden else np.linspace(0.0, 1.0, 299)
    cumulative = np.cumsum(4.0 * (1.0 + change * share))
    time_s = np.concatenate(([0.0], cumulative))
    _with_time(bench, time_s)
    _refused(
        bench,
        capsys,
        4,
        "run.csv, column t",
        "Hz in parts of the recording",
        "give rate_hz instead of time",
    )


@pytest.mark.slow
def test_an_import_that_is_terminated_leaves_nothing(bench: Bench) -> None:
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
    words = ["import", str(bench.description), "--data", str(bench.data), "--out", str(bench.out)]
    done = subprocess.run(
        [sys.executable, "-c", script, *words],
        cwd=bench.checkout,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == ExitCode.INTERRUPTED
    assert bench.left == []
    assert "Traceback" not in done.stderr
    assert "no file was written" in done.stderr


def test_a_number_that_is_no_current(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.current_a[120, 3] = 1e300
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _refused(bench, capsys, 4, "run.csv:122, column i4", "1e+300")


@pytest.mark.parametrize(("value", "words"), [(0.0, "zero in every row"), (3.0, "3 in every row")])
def test_a_dead_channel(
    bench: Bench, capsys: pytest.CaptureFixture[str], value: float, words: str
) -> None:
    bench.current_a[:, 2] = value
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _refused(bench, capsys, 4, "column i3", words)


def test_a_last_number_that_may_lack_digits(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bench.data / "run.csv"
    content = path.read_bytes()[:-3]
    path.write_bytes(content)
    _refused(bench, capsys, 4, "without an end of line")


@pytest.mark.parametrize("change", [{"rate_hz": 1e-9}, {"rate_hz": 1e9}])
def test_rates_beyond_reason(
    bench: Bench, capsys: pytest.CaptureFixture[str], change: dict[str, object]
) -> None:
    bench.describe(**change)
    _refused(bench, capsys, 6, "rate_hz")


def _with_time(
    bench: Bench, time_s: np.ndarray[tuple[Any, ...], np.dtype[np.floating[Any]]]
) -> None:
    run_path = bench.data / "run.csv"
    lines = run_path.read_text(encoding="utf-8").splitlines()
    timed = [
        "t," + lines[0],
        *(f"{t!r},{line}" for t, line in zip(time_s.tolist(), lines[1:], strict=True)),
    ]
    text = "\n".join(timed) + "\n"
    (bench.data / "run.csv").write_text(text, encoding="utf-8")
    time = {"file": "run.csv", "column": "t", "unit": "ms"}
    bench.describe(rate_hz=None, time=time)


def test_the_rate_of_a_time_column(bench: Bench) -> None:
    time_s = (
        5000.0 + 4.0 * np.arange(300) + 0.3 * np.sin(np.arange(300)) * (np.arange(300) % 299 != 0)
    )
    _with_time(
        bench,
        time_s,
    )
    assert bench.run() == 0
    rate_hz = load_run(bench.out)[0].rate_hz
    assert rate_hz == pytest.approx(250.0)


@pytest.mark.parametrize(("index", "shift"), [(100, 12.0), (100, -4.0), (100, -5.0), (299, 9.0)])
def test_a_jump_in_the_time_column(bench: Bench, index: int, shift: float) -> None:
    time_s = 4.0 * np.arange(300) + shift * (np.arange(300) >= index)
    _with_time(bench, time_s)
    pattern = rf"run\.csv:{index + 2}, column t"
    with pytest.raises(TableUnfit, match=pattern):
        import_recording(bench.description, bench.data, bench.out, software="x")
    assert bench.left == []


UNEVEN_MS = np.concatenate(([0], np.cumsum(np.random.default_rng(3).choice([3, 5], 299)))).astype(
    np.float64
)


def test_a_uniform_time_column_gives_the_samples_of_a_rate(bench: Bench) -> None:
    assert bench.run() == 0
    expected = read_log(bench.out).samples
    bench.out.unlink()
    _with_time(bench, np.arange(300.0))
    assert bench.run() == 0
    found = read_log(bench.out).samples
    for name in ("time_ns", "position_counts", "current_raw"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))


def test_jittered_stamps_are_the_sample_times(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.joint_deg = 20.0 * np.sin(UNEVEN_MS[:, None] / 160.0 + np.arange(6))
    bench.current_a = np.cos(UNEVEN_MS[:, None] / 280.0 + np.arange(6))
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a))
    bench.write_csv(stacked_joint_deg)
    _with_time(bench, UNEVEN_MS)
    assert (
        main(
            [
                "import",
                str(bench.description),
                "--data",
                str(bench.data),
                "--out",
                str(bench.out),
                "--json",
            ]
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert document["timing"]["resampled"] is True
    longest_step_s = document["timing"]["longest_step_s"]
    assert longest_step_s == pytest.approx(0.005)
    report = info_report(bench.out)
    timing = json_tree(report)["timing"]
    assert timing == document["timing"]
    run = load_run(bench.out)[0]
    at_ms = 1e3 * run.time_s[:, None]
    position_deg = np.degrees(run.position_rad)
    absolute_position_deg = np.abs(position_deg - 20.0 * np.sin(at_ms / 160.0 + np.arange(6)))
    assert absolute_position_deg.max() < 1e-3
    expected = np.cos(at_ms / 280.0 + np.arange(6))
    np.testing.assert_allclose(run.current_a, expected, atol=(5.0 / 280.0) ** 2 / 8)


TURN_WITH_WRAPS = np.array([2**30, *[1024] * 5])


def _with_counts_that_wrap(bench: Bench, joint_rad: FloatArray) -> None:
    """Write counts of an encoder of 30 bits on the first motor, which wraps after two turns,
    and 10 bits elsewhere.
    """
    cell = bench.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8").replace("revolution: 65536", f"revolution: {2**30}", 1)
    changed_text = text.replace("revolution: 65536", "revolution: 1024")
    cell.write_text(changed_text, encoding="utf-8")
    turns = joint_rad @ load_run_of(bench).T / (2 * pi)
    counts = np.rint(turns * TURN_WITH_WRAPS).astype(np.int64).astype(np.int32).astype(np.float64)
    counts_steps = np.diff(counts[:, 0])
    absolute_counts_step = np.abs(counts_steps)
    assert absolute_counts_step.max() > 2**31
    stacked_counts = np.hstack((counts, bench.current_a))
    bench.write_csv(stacked_counts)


def test_counts_at_a_rate_go_on_over_a_wrap(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checks see the motion, not the jumps of the counter; what is too fast is so still."""
    joint_rad = np.radians(30.0 * np.sin(np.arange(300)[:, None] / 160.0 + np.arange(6)))
    _with_counts_that_wrap(bench, joint_rad)
    counted = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    bench.describe(position=counted, rate_hz=10_000)
    _refused(bench, capsys, 4, "deg/s", "rate_hz is too high")
    bench.describe(position=counted)
    assert bench.run() == 0
    run = load_run(bench.out)[0]
    np.testing.assert_allclose(run.position_rad[:, 0], joint_rad[:, 0], atol=1e-8)


def test_counts_without_a_sign_are_those_with_one(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drive's counter of 32 bits that a tool reads as unsigned jumps by 2³² at zero;
    one column stays above it.
    """
    joint_rad = np.radians(bench.joint_deg)
    motor_rad = joint_rad @ load_run_of(bench).T
    counts = np.rint(motor_rad / (2 * pi) * 65536)
    counted = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    bench.describe(position=counted)
    stacked_counts = np.hstack((counts, bench.current_a))
    bench.write_csv(stacked_counts)
    assert bench.run() == 0
    expected = load_run(bench.out)[0].position_rad
    bench.out.unlink()
    unsigned = np.where(counts < 0, counts + 2**32, counts)
    unsigned_steps = np.diff(unsigned, axis=0)
    absolute_unsigned_step = np.abs(unsigned_steps)
    assert (absolute_unsigned_step > 2**31).any()
    stacked_unsigned = np.hstack((unsigned, bench.current_a))
    bench.write_csv(stacked_unsigned)
    capsys.readouterr()
    assert bench.run() == 0
    assert (
        "column q1: counts of 32 bits without a sign, read as counts with one"
    ) in capsys.readouterr().out
    position_rad = load_run(bench.out)[0].position_rad
    np.testing.assert_array_equal(position_rad, expected)


def test_resampled_counts_go_on_over_a_wrap_and_are_finer_than_a_count(bench: Bench) -> None:
    turn = TURN_WITH_WRAPS
    ratio = load_run_of(bench)
    joint_rad = np.radians(30.0 * np.sin(UNEVEN_MS[:, None] / 160.0 + np.arange(6)))
    _with_counts_that_wrap(bench, joint_rad)
    _with_time(bench, UNEVEN_MS)
    counted = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    time = {"file": "run.csv", "column": "t", "unit": "ms"}
    bench.describe(rate_hz=None, position=counted, time=time)
    assert bench.run() == 0
    run = load_run(bench.out)[0]
    expected = np.radians(30.0 * np.sin(1e3 * run.time_s[:, None] / 160.0 + np.arange(6)))
    position_difference_rad = run.position_rad - expected
    error = (position_difference_rad @ ratio.T / (2 * pi) * turn)[:, 1:]
    assert np.abs(error).max() < 1.0
    rms_error = np.sqrt(np.mean(error**2))
    assert rms_error < 0.35  # once rounded; a second time would make 0.41 of 0.29
    assert np.abs(run.position_rad[:, 0] - expected[:, 0]).max() < 1e-6


@pytest.mark.parametrize(
    ("first", "unit", "started_s", "recorded"),
    [
        (0.0, "ms", 0.0, False),
        (512_300.0, "ms", 512.3, False),
        (1_772_348_400_000.0, "ms", 1_772_348_400.0, True),
    ],
)
def test_the_first_stamp_is_when_the_run_began(
    bench: Bench, first: float, unit: str, started_s: float, recorded: bool
) -> None:
    time_s = first + 4.0 * np.arange(300)
    _with_time(bench, time_s)
    assert bench.run() == 0
    run = load_run(bench.out)[0]
    assert run.started_s == pytest.approx(started_s, abs=1e-6)
    assert run.recording is not None
    assert (run.recording.recorded_s is not None) is recorded


def test_without_stamps_or_before_a_trigger_nothing_is_known_of_the_start(bench: Bench) -> None:
    assert bench.run() == 0
    started_s = load_run(bench.out)[0].started_s
    assert started_s is None
    bench.out.unlink()
    time_s = 4.0 * np.arange(300) - 100.0
    _with_time(bench, time_s)
    assert bench.run() == 0
    assert load_run(bench.out)[0].started_s is None


def test_a_date_in_a_file_is_when_the_run_began(bench: Bench) -> None:
    _with_time(bench, np.arange(300.0))
    path = bench.data / "run.csv"
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    dated = []
    for index in range(300):
        dated.append(f"2026-03-01T08:00:{index // 100:02d}.{index % 100:02d}+01:00,")
    text = "\n".join(
        [head, *(date + row.partition(",")[2] for date, row in zip(dated, rows, strict=True))]
    )
    path.write_text(text + "\n", encoding="utf-8")
    time = {"file": "run.csv", "column": "t", "unit": "iso8601"}
    bench.describe(rate_hz=None, time=time)
    assert bench.run() == 0
    run = load_run(bench.out)[0]
    assert run.rate_hz == pytest.approx(100.0)
    assert run.started_s == 1_772_348_400.0


def test_a_unit_that_makes_a_stamp_absurd(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    time_s = 1_772_348_400_000_000.0 + 4.0 * np.arange(300)
    _with_time(bench, time_s)
    _refused(bench, capsys, 4, "run.csv:2, column t", "correct `unit` of `time`")


def test_a_first_row_that_is_there_twice(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    time_s = 4.0 * np.arange(300)
    _with_time(bench, time_s)
    run_path = bench.data / "run.csv"
    rows = run_path.read_text(encoding="utf-8").splitlines()
    bench.spoil_csv(rows[1], f"{rows[1]}\n{rows[1]}")
    assert bench.run() == 0
    assert "1 duplicated and dropped" in capsys.readouterr().out
    position_rad = load_run(bench.out)[0].position_rad
    expected = np.radians(bench.joint_deg)
    np.testing.assert_allclose(position_rad, expected, atol=2e-9)


def test_zero_offsets_count_on_the_joint_side_too(bench: Bench) -> None:
    cell = bench.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8")
    changed_text = text.replace("zero_offset_deg: 0.0", "zero_offset_deg: 30.0", 1)
    cell.write_text(changed_text, encoding="utf-8")
    assert bench.run() == 0
    expected = np.radians(bench.joint_deg + np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    position_rad = load_run(bench.out)[0].position_rad
    np.testing.assert_allclose(position_rad, expected, atol=2e-9)


@pytest.mark.parametrize("mapping", [False, True])
def test_a_factor_for_each_axis(bench: Bench, mapping: bool) -> None:
    factors = [0.5, 1, -2.0, 0.1, 3, 1.0]
    named = dict(reversed([*zip((f"J{i}" for i in range(1, 7)), factors, strict=True)]))
    factor = named if mapping else factors
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": "A", "factor": factor}
    bench.describe(current=current)
    assert bench.run() == 0
    actual = load_run(bench.out)[0].current_a
    expected = bench.current_a * factors
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
    bench: Bench, capsys: pytest.CaptureFixture[str], factor: object, said: tuple[str, ...]
) -> None:
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": "A", "factor": factor}
    bench.describe(current=current)
    _refused(bench, capsys, 6, *said)


SPEEDS = [f"v{i}" for i in range(1, 7)]


def _with_velocity(bench: Bench, velocity_deg_s: FloatArray, **changes: object) -> None:
    header = ",".join((*NAMES, *SPEEDS))
    values = np.hstack((bench.joint_deg, bench.current_a, velocity_deg_s))
    run_path = bench.data / "run.csv"
    np.savetxt(run_path, values, delimiter=",", header=header, comments="")
    velocity = {"file": "run.csv", "columns": SPEEDS, "unit": "deg/s", "side": "joint", **changes}
    bench.describe(
        velocity=velocity,
    )


def _velocity_deg_s() -> FloatArray:
    phase_rad = np.arange(300)[:, None] / 40.0 + np.arange(6)
    return 20.0 / 0.040 * np.cos(phase_rad)


@pytest.mark.parametrize("side", ["joint", "motor"])
@pytest.mark.parametrize("unit", ["deg/s", "rad/s"])
def test_velocities_that_agree_change_nothing(bench: Bench, side: str, unit: str) -> None:
    assert bench.run() == 0
    expected = read_log(bench.out).samples.position_counts
    bench.out.unlink()
    velocity = _velocity_deg_s() + np.random.default_rng(0).normal(scale=20.0, size=(300, 6))
    velocity = velocity if unit == "deg/s" else np.radians(velocity)
    _with_velocity(
        bench,
        velocity if side == "joint" else velocity @ load_run_of(bench).T,
        side=side,
        unit=unit,
    )
    assert bench.run() == 0
    samples = read_log(bench.out).samples
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
    ],
)
def test_velocities_that_disagree_name_the_axis(
    bench: Bench,
    capsys: pytest.CaptureFixture[str],
    factors: tuple[float, ...],
    said: tuple[str, ...],
) -> None:
    velocity_deg_s = _velocity_deg_s() * factors
    _with_velocity(bench, velocity_deg_s)
    _refused(bench, capsys, 4, *said)


def test_counts_need_an_encoder(bench: Bench) -> None:
    cell = bench.folder / "configs/cells/tx40.yaml"
    position = {"file": "run.csv", "columns": NAMES[:6], "unit": "counts", "side": "motor"}
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": "Nm(motor, a priori)"}
    bench.describe(
        cell=str(cell),
        position=position,
        current=current,
    )
    with pytest.raises(ConfigurationInconsistent, match="counts_per_revolution"):
        import_recording(bench.description, bench.data, bench.out, software="x")


@pytest.mark.slow
def test_the_real_tx40(checkout: Path, shared_data: Path, tmp_path: Path) -> None:
    """Nine seconds of a real arm: every number of the files is in the log to half a count."""
    out = tmp_path / "tx40.mcap"
    description = checkout / "configs/imports/tx40.yaml"
    assert (
        main(["import", str(description), "--data", str(shared_data / "tx40"), "--out", str(out)])
        == 0
    )
    run, cell = load_run(out)
    motor_rad = np.loadtxt(shared_data / "tx40/pos_read_data.csv", delimiter=",", skiprows=1)
    current = np.loadtxt(shared_data / "tx40/curr_data.csv", delimiter=",", skiprows=1)
    assert run.position_rad.shape == (45000, 6)
    assert run.rate_hz == pytest.approx(5000.0)
    zero_offset_rad = [axis.zero_offset_rad for axis in cell.axes]
    offset_rad = np.array(zero_offset_rad)
    largest_absolute_motor_rad = np.abs(motor_rad).max()
    position_difference_rad = run.position_rad - offset_rad
    np.testing.assert_allclose(
        position_difference_rad @ cell.ratio.T,
        motor_rad,
        atol=1e-9 * largest_absolute_motor_rad,
    )
    largest_absolute_current = np.abs(current).max()
    np.testing.assert_allclose(run.current_a, current, atol=1e-9 * largest_absolute_current)
    # NOTICE: q2 has an offset of −π/2, q3 of +π/2; the arm starts stretched up, both URDF angles
    # near zero.
    np.testing.assert_allclose(run.position_rad[0, 1:3], 0.0, atol=1e-3)


@pytest.mark.parametrize("what", ["device", "pipe"])
def test_a_recording_that_is_no_regular_file_is_refused(bench: Bench, what: str) -> None:
    recording = bench.data / "run.csv"
    recording.unlink()
    if what == "device":
        recording.symlink_to("/dev/null")
    else:
        os.mkfifo(recording)
    with pytest.raises(TableUnfit, match="no regular file"):
        import_recording(bench.description, bench.data, bench.out, software="test")
    assert not bench.out.exists()


def test_a_payload_that_is_not_the_cells_is_named_as_it_was_given(bench: Bench) -> None:
    bench.describe(payload="brick")
    with pytest.raises(ConfigurationInconsistent, match="'brick'") as caught:
        import_recording(bench.description, bench.data, bench.out, software="test")
    assert "None" not in str(caught.value)
    assert "payload: NAME" in str(caught.value)


def test_a_full_disk_is_not_reported_as_a_recording(bench: Bench) -> None:
    bench.out.parent.rmdir()
    with pytest.raises(OutputFailed) as caught:
        import_recording(bench.description, bench.data, bench.out, software="test")
    assert "nothing was written" in str(caught.value)
    assert "record" not in str(caught.value)


# -- the controller's own torque, and temperatures
# -------------------------------------------------------------------


def with_slow_columns(
    bench: Bench, torque_nm: FloatArray, temperature_c: FloatArray, **torque: object
) -> None:
    """Add a file of torques and temperatures."""
    names = [f"t{i}" for i in range(1, 7)] + [f"c{i}" for i in range(1, 7)]
    values = np.hstack((torque_nm, temperature_c)).tolist()
    lines = [",".join(names), *(",".join(map(repr, row)) for row in values)]
    slow_path = bench.data / "slow.csv"
    text = "\n".join(lines) + "\n"
    slow_path.write_text(text, encoding="utf-8")
    temperature = {"file": "slow.csv", "columns": names[6:]}
    bench.describe(
        rate_hz=50,
        torque={"file": "slow.csv", "columns": names[:6], **torque},
        temperature=temperature,
    )


@pytest.mark.parametrize("side", ["motor", "joint"])
def test_torque_columns_give_a_slope_and_temperature_columns_a_temperature(
    bench: Bench, side: str
) -> None:
    ratio = load_run_of(bench)
    gain = np.array([33.0, 32.0, 24.0, -9.0, 16.0, 6.8])
    motor_nm = gain * bench.current_a / np.diag(ratio)
    torque = motor_nm if side == "motor" else motor_nm @ ratio
    grid = np.linspace(25.0, 31.0, 300)
    temperature_c = grid[:, None] + np.arange(6)
    torque_nm = 1000.0 * torque
    with_slow_columns(bench, torque_nm, temperature_c, side=side, factor=0.001)
    assert bench.run() == 0
    run, _ = load_run(bench.out)
    # 300 rows at 50 Hz: a torque in every second row, a temperature a second.
    slow_readings = info_report(bench.out).slow_readings
    expected = {"torque": 6 * 150, "temperature": 6 * 6}
    assert slow_readings == expected
    slopes = [torque_slope([channel]) for channel in run.torque_channels]
    assert [slope.value for slope in slopes if slope is not None] == pytest.approx(gain, rel=1e-6)
    assert run.temperature_c is not None
    # One reading a second, interpolated; the last second keeps its value.
    np.testing.assert_allclose(run.temperature_c[:250], temperature_c[:250], atol=1e-6)
    np.testing.assert_allclose(run.current_a, bench.current_a, atol=1e-9)


def test_a_torque_column_too_few_and_a_factor_of_zero_are_refused(bench: Bench) -> None:
    for torque, said in (
        ({"columns": ["i1", "i2"], "side": "motor"}, "2 columns"),
        ({"columns": SPEEDS, "side": "motor", "factor": 0.0}, "factor"),
        ({"columns": SPEEDS, "side": "motor", "factor": [1.0, 2.0]}, "torque.factor"),
    ):
        bench.describe(torque={"file": "run.csv", **torque})
        with pytest.raises(ConfigurationInconsistent, match=said):
            import_recording(bench.description, bench.data, bench.out, software="test")
    # Every section is checked, whatever comes after it.
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": "A", "factor": [1.0, 2.0]}
    bench.describe(current=current, torque={"file": "run.csv", "columns": SPEEDS, "side": "motor"})
    with pytest.raises(ConfigurationInconsistent, match=r"current\.factor"):
        import_recording(bench.description, bench.data, bench.out, software="test")


def test_a_column_is_not_both_current_and_torque(bench: Bench) -> None:
    columns = [*SPEEDS[:3], "i4", *SPEEDS[4:]]
    torque = {"file": "./run.csv", "columns": columns, "side": "motor"}
    bench.describe(torque=torque)
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"torque\.columns: found i4 of .*, which "
        r"current is read from",
    ):
        import_recording(bench.description, bench.data, bench.out, software="test")


def test_the_shipped_description_shows_every_setting(checkout: Path) -> None:
    """Its lines that are commented out are valid, and with them nothing is missing."""
    text = (checkout / "configs/imports/tx40.yaml").read_text(encoding="utf-8")
    encoded_text = re.sub(r"(?m)^# ( *[a-z_]+:)", r"\1", text).encode()
    document = parse_yaml(encoded_text, "tx40.yaml")
    wanted = read_model(document, ImportDescription)
    assert document.tree.keys() == ImportDescription.model_fields.keys()
    sections = {"table": wanted.table, "time": wanted.time, **dict(wanted.sections())}
    for key, section in sections.items():
        assert section is not None
        expected = {field.name for field in fields(section)}
        assert document.tree[key].keys() == expected, key


def test_an_import_without_them_has_neither(bench: Bench) -> None:
    assert bench.run() == 0
    run, _ = load_run(bench.out)
    assert run.torque_channels == ()
    assert run.temperature_c is None


@pytest.mark.parametrize(
    ("key", "columns"),
    [("position", [*NAMES[:5], "q1"]), ("current", NAMES[:6]), ("temperature", NAMES[6:])],
)
def test_a_column_is_read_as_one_thing(
    checkout: Path, tmp_path: Path, key: str, columns: list[str]
) -> None:
    bench = Bench(checkout, tmp_path).prepare()
    section = {"position": {"unit": "deg", "side": "joint"}, "current": {"unit": "A"}}.get(key, {})
    bench.describe(**{key: {"file": "run.csv", "columns": columns, **section}})
    with pytest.raises(ConfigurationInconsistent, match="which is also"):
        import_recording(bench.description, bench.data, bench.out, software="test")


@pytest.mark.parametrize("step", [4_000_000, 4_000, 4])
def test_stamps_in_another_unit_have_no_rate_of_a_robot(
    checkout: Path, tmp_path: Path, step: int
) -> None:
    bench = Bench(checkout, tmp_path).prepare()
    rows = np.hstack((step * np.arange(300.0)[:, None], bench.joint_deg, bench.current_a))
    lines = [",".join(("t", *NAMES)), *(",".join(map(repr, row)) for row in rows.tolist())]
    run_path = bench.data / "run.csv"
    run_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    time = {"file": "run.csv", "column": "t", "unit": "s"}
    bench.describe(rate_hz=None, time=time)
    with pytest.raises(TableUnfit, match="Hz with `unit: s`"):
        import_recording(bench.description, bench.data, bench.out, software="test")


def _two_files(bench: Bench) -> None:
    """Positions with stamps in one file, currents in another one."""
    stamps = 0.004 * np.arange(300)
    with_time = np.column_stack((stamps, bench.joint_deg))
    for name, names, values in (
        ("position.csv", ["t", *NAMES[:6]], with_time),
        ("current.csv", NAMES[6:], bench.current_a),
    ):
        lines = [",".join(names), *(",".join(map(repr, row)) for row in values.tolist())]
        text = "\n".join(lines) + "\n"
        (bench.data / name).write_text(text, encoding="utf-8")


def test_times_that_are_kept_are_rows_of_the_other_file(bench: Bench) -> None:
    """0.4 to 0.8 s at 250 Hz; the files that have no stamps give the same rows."""
    _two_files(bench)
    position = {"file": "position.csv", "columns": NAMES[:6], "unit": "deg", "side": "joint"}
    current = {"file": "current.csv", "columns": NAMES[6:], "unit": "A"}
    time = {"file": "position.csv", "column": "t", "unit": "s"}
    keep = {"from_s": 0.4, "to_s": 0.8}
    bench.describe(
        position=position,
        current=current,
        rate_hz=None,
        time=time,
        keep=keep,
    )
    assert bench.run() == 0
    run, _ = load_run(bench.out)
    expected = np.radians(bench.joint_deg[100:201])
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, bench.current_a[100:201], atol=1e-9)
    assert run.started_s == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("keep", "rows"),
    [
        ({"from_row": 21}, slice(20, 300)),
        ({"to_row": 280}, slice(0, 280)),
        ({"from_s": 0.02, "to_s": 0.25}, slice(20, 251)),
    ],
)
def test_rows_are_kept_at_a_stated_rate(bench: Bench, keep: dict[str, float], rows: slice) -> None:
    bench.describe(keep=keep)
    assert bench.run() == 0
    position_rad = load_run(bench.out)[0].position_rad
    expected = np.radians(bench.joint_deg[rows])
    np.testing.assert_allclose(position_rad, expected, atol=2e-9)


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
    bench: Bench, capsys: pytest.CaptureFixture[str], keep: dict[str, float], said: str
) -> None:
    bench.describe(keep=keep)
    _refused(bench, capsys, 6, said)


@pytest.mark.parametrize("timed", [False, True])
def test_a_held_out_end_becomes_a_log_of_its_own(bench: Bench, timed: bool) -> None:
    """No sample is in both, and none is lost."""
    if timed:
        time_s = 1_772_348_400_000.0 + 4.0 * np.arange(300)
        _with_time(bench, time_s)
    part = {"from_s": 0.8 if timed else 0.2}
    if timed:
        time = {"file": "run.csv", "column": "t", "unit": "ms"}
    else:
        time = None
    bench.describe(rate_hz=None if timed else 1000, time=time, holdout=part)
    held_out = bench.out.with_name("held-out.mcap")
    imported = import_recording(
        bench.description, bench.data, bench.out, software="test", holdout=held_out
    )
    assert imported.statistics.samples == 200
    assert imported.holdout is not None
    assert imported.holdout.samples == 100
    runs = [load_run(path)[0] for path in (bench.out, held_out)]
    position_rad = [run.position_rad for run in runs]
    joined = np.vstack(position_rad)
    expected = np.radians(bench.joint_deg)
    np.testing.assert_allclose(joined, expected, atol=2e-9)
    current_a = [run.current_a for run in runs]
    stacked_current_a = np.vstack(current_a)
    np.testing.assert_allclose(stacked_current_a, bench.current_a, atol=1e-9)
    if timed:
        started_s = runs[1].started_s
        assert started_s == pytest.approx(1_772_348_400.8, abs=1e-3)
    run_id = read_log(bench.out).head.run.run_id
    assert run_id != read_log(held_out).head.run.run_id


def test_the_command_writes_both_logs_and_reports_them(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.describe(holdout={"from_s": 0.2})
    held_out = bench.out.with_name("held-out.mcap")
    command = ["import", str(bench.description), "--data", str(bench.data), "--out", str(bench.out)]
    assert main([*command, "--holdout", str(held_out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 200
    expected = {"log": str(held_out), "samples": 100}
    assert report["holdout"] == expected


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
    bench: Bench, part: dict[str, float] | None, named: bool, error: type[Exception], said: str
) -> None:
    bench.describe(holdout=part)
    held_out = bench.out.with_name("held-out.mcap") if named else None
    with pytest.raises(error, match=said):
        import_recording(
            bench.description, bench.data, bench.out, software="test", holdout=held_out
        )
    assert bench.left == []


def test_a_log_that_cannot_be_written_leaves_no_held_out_part(bench: Bench) -> None:
    bench.describe(holdout={"from_s": 0.2})
    bench.out.write_bytes(b"mine")
    holdout = bench.out.with_name("held-out.mcap")
    with pytest.raises(UsageError):
        import_recording(
            bench.description,
            bench.data,
            bench.out,
            software="test",
            holdout=holdout,
        )
    assert bench.left == ["run.mcap"]


@pytest.mark.slow
def test_the_real_ur10_is_split_by_its_description(shared_data: Path, tmp_path: Path) -> None:
    """A ROS 2 bag in SQLite; the two logs are the parts that the studies read past the import."""
    bag = "ur10_exciting_trajectory.db3"
    description = tmp_path / "ur10.yaml"
    document = {
        "name": "ur10",
        "cell": str(shared_data / "ur10/ur10-cell.yaml"),
        "position": {"file": bag, "columns": ["position"], "unit": "rad", "side": "joint"},
        "current": {"file": bag, "columns": ["effort"], "unit": "Nm"},
        "time": {"file": bag, "column": "header.stamp", "unit": "ns"},
        "holdout": {"from_s": 16.512},
    }
    description.write_text(json.dumps(document), encoding="utf-8")
    logs = tmp_path / "fit.mcap", tmp_path / "held-out.mcap"
    import_recording(description, shared_data / "ur10", logs[0], software="test", holdout=logs[1])
    recording = ur10(shared_data)
    (whole,) = recording.runs
    (is_fit,) = recording.part_of
    for log, part in zip(logs, (1, 0), strict=True):
        run, _ = load_run(log)
        assert run.rate_hz == pytest.approx(125.0)
        expected = whole.position_rad[is_fit == part]
        np.testing.assert_allclose(run.position_rad, expected, atol=1e-8)
        np.testing.assert_allclose(run.current_a, whole.current_a[is_fit == part], atol=1e-6)


def _file_of_each_axis(bench: Bench, later_s: float = 0.0, began_s: float = 0.0) -> None:
    """A trace of each axis, with stamps of its own, as the tool of a drive exports them."""
    for axis in range(6):
        stamps = began_s + 0.004 * np.arange(300) + (later_s if axis == 2 else 0.0)
        columns = np.column_stack((stamps, bench.joint_deg[:, axis], bench.current_a[:, axis]))
        lines = ["t,position,current", *(",".join(map(repr, row)) for row in columns.tolist())]
        text = "\n".join(lines) + "\n"
        (bench.data / f"axis{axis + 1}.csv").write_text(text, encoding="utf-8")
    files = [f"axis{axis + 1}.csv" for axis in range(6)]
    current = {"file": files, "columns": ["current"] * 6, "unit": "A"}
    position = {"file": files, "columns": ["position"], "unit": "deg", "side": "joint"}
    time = {"file": "axis1.csv", "column": "t", "unit": "s"}
    bench.describe(
        position=position,
        current=current,
        rate_hz=None,
        time=time,
    )


def test_axes_come_from_a_file_each(bench: Bench) -> None:
    _file_of_each_axis(bench)
    assert bench.run() == 0
    run, _ = load_run(bench.out)
    expected = np.radians(bench.joint_deg)
    np.testing.assert_allclose(run.position_rad, expected, atol=2e-9)
    np.testing.assert_allclose(run.current_a, bench.current_a, atol=1e-9)


def test_an_error_names_the_file_of_its_axis(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    _file_of_each_axis(bench)
    path = bench.data / "axis4.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    good = lines[41]
    lines[41] = ",".join((*good.split(",")[:2], "1e9"))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    _refused(bench, capsys, 4, "axis4.csv:42, column current")
    lines[41] = ",".join((good.split(",")[0], "5000.0", "0.1"))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    _refused(bench, capsys, 4, "import description 'run', axis J4")


@pytest.mark.parametrize("later_s", [0.05, 86400.0])
def test_files_of_axes_whose_dates_differ_are_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str], later_s: float
) -> None:
    _file_of_each_axis(bench, later_s, began_s=1_772_000_000.0)
    _refused(
        bench,
        capsys,
        4,
        "axis3.csv",
        f"{later_s:.6g} s after those of axis1.csv",
        "of different times",
    )


def test_files_of_axes_belong_together_by_their_stamps(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row that one file lacks would shift its axis; a clock that begins elsewhere is said."""
    _file_of_each_axis(bench, later_s=0.1)
    assert bench.run() == 0
    assert "axis3.csv: its stamps begin 0.1 s after those of axis1.csv" in capsys.readouterr().out
    bench.out.unlink()
    path = bench.data / "axis3.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:50], *lines[51:], "1.3,0.0,0.0"]) + "\n", encoding="utf-8")
    _refused(
        bench, capsys, 4, "axis3.csv:51, column time", "rows of the same instants in both files"
    )


@pytest.mark.parametrize(
    ("files", "columns", "said"),
    [
        (["axis1.csv", "axis2.csv"], ["position"], "2 columns"),
        (["axis1.csv", "axis2.csv"], ["position"] * 3, "as many files as columns"),
    ],
)
def test_files_and_columns_that_do_not_match_are_refused(
    bench: Bench,
    capsys: pytest.CaptureFixture[str],
    files: list[str],
    columns: list[str],
    said: str,
) -> None:
    _file_of_each_axis(bench)
    current = {"file": files, "columns": columns, "unit": "A"}
    bench.describe(current=current)
    _refused(bench, capsys, 6, said)


@pytest.mark.parametrize("kind", ["mapping", "list"])
def test_currents_of_one_cell_may_have_several_units(bench: Bench, kind: str) -> None:
    """As N of a prismatic axis beside Nm of the others."""
    cell = bench.folder / "configs/cells/demo.yaml"
    text = cell.read_text(encoding="utf-8")
    assert text.count("nameplate_gain_nm_per_a:") == 6
    first, *rest = re.split("nameplate_gain_nm_per_a:(.*)", text)
    for axis, gain in enumerate(rest[::2]):
        unit = "Nm/N" if axis == 1 else "Nm/Nm"
        first += f'nameplate_gain: {gain.strip()}\n    gain_unit: "{unit}"' + rest[2 * axis + 1]
    cell.write_text(first, encoding="utf-8")
    units = {f"J{axis + 1}": "N" if axis == 1 else "Nm" for axis in range(6)}
    stated: object
    if kind == "mapping":
        stated = units
    else:
        stated = list(units.values())
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": stated}
    bench.describe(current=current)
    assert bench.run() == 0
    axes = load_run(bench.out)[1].axes
    gain_units = [axis.gain_unit for axis in axes]
    assert gain_units[:3] == [
        "Nm/Nm",
        "Nm/N",
        "Nm/Nm",
    ]


@pytest.mark.parametrize("unit", ["Nm", ["Nm"] * 5, {"J1": "Nm"}])
def test_units_of_other_axes_are_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str], unit: object
) -> None:
    current = {"file": "run.csv", "columns": NAMES[6:], "unit": unit}
    bench.describe(current=current)
    _refused(bench, capsys, 6, "current.unit")


@pytest.mark.parametrize("unit", ["deg", "counts"])
def test_axes_that_count_the_other_way_are_reversed(bench: Bench, unit: str) -> None:
    """Their velocities are checked likewise."""
    values = bench.joint_deg
    side = "joint"
    if unit == "counts":
        joint_rad = np.radians(bench.joint_deg)
        values = np.rint(joint_rad @ load_run_of(bench).T / (2 * pi) * 65536)
        side = "motor"
    section = {"file": "run.csv", "columns": NAMES[:6], "unit": unit, "side": side}
    bench.write_csv(np.hstack((values, bench.current_a)))
    bench.describe(position=section)
    assert bench.run() == 0
    expected = load_run(bench.out)[0].position_rad
    bench.out.unlink()
    values = values.copy()
    values[:, [1, 3]] *= -1.0
    bench.write_csv(np.hstack((values, bench.current_a)))
    position = {**section, "reversed": ["J2", "J4"]}
    bench.describe(position=position)
    assert bench.run() == 0
    position_rad = load_run(bench.out)[0].position_rad
    np.testing.assert_allclose(position_rad, expected, atol=1e-9)


def test_velocities_have_signs_of_their_own(bench: Bench) -> None:
    names = [*NAMES, *(f"v{axis + 1}" for axis in range(6))]
    velocity = np.gradient(bench.joint_deg, 0.001, axis=0)
    velocity[:, 2] *= -1.0
    stacked_joint_deg = np.hstack((bench.joint_deg, bench.current_a, velocity))
    rows = stacked_joint_deg.tolist()
    lines = [",".join(names), *(",".join(map(repr, row)) for row in rows)]
    run_path = bench.data / "run.csv"
    run_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    section = {"file": "run.csv", "columns": names[12:], "unit": "deg/s", "side": "joint"}
    bench.describe(velocity=section)
    assert bench.run() == 4
    bench.describe(velocity={**section, "reversed": ["J3"]})
    assert bench.run() == 0


@pytest.mark.parametrize("key", ["position", "velocity"])
def test_a_reversed_axis_that_is_none_is_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    section = {
        "file": "run.csv",
        "columns": NAMES[:6],
        "unit": "deg",
        "side": "joint",
        "reversed": ["J9"],
    }
    if key == "velocity":
        columns = [f"v{axis}" for axis in range(6)]
        section |= {"unit": "deg/s", "columns": columns}
    bench.describe(**{key: section})
    _refused(bench, capsys, 6, f"{key}.reversed", "J9", "some of J1, J2")


def _with_setting(bench: Bench, key: str, value: object) -> None:
    """A description with one more setting, of a section where the key has a dot."""
    section, dot, setting = key.rpartition(".")
    if not dot:
        bench.describe(**{key: value})
        return
    sections: dict[str, dict[str, object]] = {
        "position": {"columns": NAMES[:6], "unit": "deg", "side": "joint"},
        "current": {"columns": NAMES[6:], "unit": "A"},
        "velocity": {"columns": SPEEDS, "unit": "deg/s", "side": "joint"},
        "torque": {"columns": SPEEDS, "side": "motor"},
    }
    bench.describe(**{section: {"file": "run.csv", **sections[section], setting: value}})


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
    bench: Bench, key: str, value: object
) -> None:
    _with_setting(bench, key, value)
    with pytest.raises(ConfigurationInconsistent) as caught:
        import_recording(bench.description, bench.data, bench.out, software="test")
    assert caught.value.subject == f"import description 'run': {key}"
    assert "run.csv" in caught.value.found
    assert "a ROS bag" in caught.value.expected
    assert bench.left == []


def test_settings_for_bags_and_csv_are_refused_for_matlab(bench: Bench) -> None:
    run_path = bench.data / "run.mat"
    savemat(run_path, {"q": bench.joint_deg, "i": bench.current_a})
    position = {"file": "run.mat", "columns": ["q"], "unit": "deg", "side": "joint"}
    current = {"file": "run.mat", "columns": ["i"], "unit": "A"}
    bench.describe(position=position, current=current)
    assert bench.run() == 0
    bench.out.unlink()
    for setting, value, kind in (
        ("topic", "/joint_states", "a ROS bag"),
        ("table", {"delimiter": ";"}, "a CSV file"),
        ("table", {"skip_rows": 4}, "a CSV file"),
    ):
        bench.describe(position=position, current=current, **{setting: value})
        with pytest.raises(ConfigurationInconsistent, match=f"'run': {setting}: .*{kind}"):
            import_recording(bench.description, bench.data, bench.out, software="test")
    # The defaults may be spelled out: they ask for nothing.
    bench.describe(position=position, current=current, table={"delimiter": ","}, topic=None)
    assert bench.run() == 0


@pytest.mark.parametrize(
    ("changes", "place", "found", "expected"),
    [
        ({"file": 3}, "position.file", "integer 3", "a valid string, or a valid array"),
        ({"columns": [0, *NAMES[1:6]]}, "position.columns[0]", "integer 0", "a valid string, or"),
        ({"reversed": ["J1", "J1"]}, "position.reversed", "J1 more than once", "each axis once"),
    ],
)
def test_a_value_of_no_allowed_kind_is_one_fault_in_words(
    bench: Bench,
    capsys: pytest.CaptureFixture[str],
    changes: Any,
    place: str,
    found: str,
    expected: str,
) -> None:
    """A fault was there once for each kind, under names of pydantic: `file.constrained-str`."""
    position = {"file": "run.csv", "columns": NAMES[:6], "unit": "deg", "side": "joint"} | changes
    bench.describe(position=position)
    assert bench.run() == ExitCode.CONFIGURATION
    shown = capsys.readouterr().err
    assert f": {place}\n" in shown
    for text in (found, expected):
        assert text in shown
    for internal in ("constrained", "tuple[", "dict["):
        assert internal not in shown
    assert not bench.left


def test_a_mounting_without_a_payload_is_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log was that of a bare arm, without a word."""
    bench.describe(mounting="flange-a")
    _refused(bench, capsys, 6, "mounting", "'flange-a' without `payload`")


@pytest.mark.parametrize("delimiter", ["1", "e", "-", "_", '"', "\n", "\0"])
def test_a_delimiter_that_numbers_or_names_have_is_refused(
    bench: Bench, capsys: pytest.CaptureFixture[str], delimiter: str
) -> None:
    bench.describe(table={"delimiter": delimiter})
    _refused(bench, capsys, 6, "a delimiter that no number or name has")


def test_one_name_for_both_logs_is_refused_before_anything_is_written(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second log found the first in its way, and the advice was to move it away."""
    bench.describe(holdout={"from_s": 0.2})
    link = bench.out.with_name("link.mcap")
    link.symlink_to(bench.out.name)
    for name in (bench.out, link):
        with pytest.raises(UsageError, match="one name for both logs"):
            import_recording(
                bench.description, bench.data, bench.out, software="test", holdout=name
            )
    assert bench.left == ["link.mcap"]


def test_a_folder_that_is_not_there_is_what_is_named(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """The advice was to free space."""
    bench.out = bench.folder / "none" / "run.mcap"
    assert bench.run() == ExitCode.UNEXPECTED
    shown = capsys.readouterr().err
    assert f"no folder {bench.out.parent}" in shown
    assert "mkdir -p" in shown
    assert "space" not in shown
    assert not bench.out.parent.exists()
