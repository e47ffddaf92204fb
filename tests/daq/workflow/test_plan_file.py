"""plan.yaml: read back as it was written, and strict about what a hand may have changed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.cli import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.same_cell import calibrated_robot
from daq.config.workspace import Clearance
from daq.errors import ConfigurationInconsistent, ExitCode, SchemaMismatch
from daq.report.plan_preview import find_preview
from daq.workflow.plan import Plan, load_plan, plan, save_plan, way_to_first_target
from drivers.errors import MotionRefused
from ident.calibration import CalibratedRobot
from ident.model.urdf import read_urdf
from ident.planning.clearance import Box

pytestmark = pytest.mark.slow

CELLS = Path(__file__).parents[3] / "configs" / "cells"
OLD = """format: drivegain-plan
cell: demo
seed: 1
condition: 1500.0
moves:
  - {target_deg: [0, 0, 90, 0, 0, 0], velocity: 0.5, acceleration: 0.5, dwell_s: 0.1}
  - {target_deg: [10, 5, 80, 0, 0, 0], velocity: 0.5, acceleration: 0.5}
"""


@pytest.fixture(scope="module")
def demo() -> Cell:
    """The demonstration's cell."""
    return load_cell(CELLS / "demo.yaml")


@pytest.fixture(scope="module")
def made(demo: Cell) -> Plan:
    """A short plan for it."""
    return plan(demo, seed=1, duration_s=8.0, exchanges=10)


@pytest.fixture
def followed(tmp_path: Path) -> Cell:
    """The demonstration's cell with a joint that follows J5, within ±0.5 rad of its own."""
    folder = tmp_path / "configs"
    shutil.copytree(CELLS.parent, folder)
    urdf = folder / "robots" / "tx40.urdf"
    follower = """<link name="behind"/><joint name="rod" type="revolute"><origin xyz="0 0 0.1"/>
      <parent link="link6"/><child link="behind"/><axis xyz="0 1 0"/>
      <limit lower="-0.5" upper="0.5" velocity="9" effort="9"/>
      <mimic joint="J5" multiplier="-0.5" offset="0.1"/></joint></robot>"""
    text = urdf.read_text(encoding="utf-8")
    urdf.write_text(text.replace("</robot>", follower), encoding="utf-8")
    return load_cell(folder / "cells" / "demo.yaml")


def _with_limits_of_j5(cell: Cell, lower_deg: float, upper_deg: float) -> Cell:
    *before, fifth, last = cell.axes
    position = (float(np.radians(lower_deg)), float(np.radians(upper_deg)))
    narrow = replace(fifth, limits=replace(fifth.limits, position=position))
    return replace(cell, axes=(*before, narrow, last))


def test_a_joint_that_follows_an_axis_keeps_its_own_limits_in_a_plan(
    followed: Cell, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationInconsistent) as caught:
        plan(followed, seed=1, duration_s=8.0, exchanges=0)
    error = caught.value
    assert "limits of J5" in error.subject
    assert error.found.startswith("joint rod, which follows it, from -")
    assert error.expected == "-28.648 deg to 28.648 deg, its limits in the URDF"
    # (±0.5 − 0.1)/(−0.5) = −0.8 and 1.2 rad
    assert "give J5 `limits` within -45.837 deg to 68.755 deg, or correct" in error.remedy
    narrow = _with_limits_of_j5(followed, -45.8, 68.7)
    made = plan(narrow, seed=1, duration_s=8.0, exchanges=0, largest_condition=1e12)
    path = tmp_path / "plan.yaml"
    save_plan(made, path)
    assert load_plan(path, narrow).moves == made.moves
    by_hand = OLD.replace("[10, 5, 80, 0, 0, 0]", "[10, 5, 80, 0, 90, 0]")
    path.write_text(by_hand, encoding="utf-8")
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"moves\[1\], J5: found joint rod, which follows it, at -39\.2.* deg; expected -28",
    ):
        load_plan(path, followed)


@pytest.mark.parametrize("name", ["demo", "gantry"])
@settings(deadline=None, max_examples=4, derandomize=True)
@given(seed=st.integers(0, 100))
def test_a_plan_is_read_as_it_was_made(
    tmp_path_factory: pytest.TempPathFactory, name: str, seed: int
) -> None:
    cell = load_cell(CELLS / f"{name}.yaml")
    path = tmp_path_factory.mktemp("plan") / "plan.yaml"
    made = plan(
        cell,
        seed=seed,
        duration_s=14.0,
        exchanges=8,
        largest_condition=1e12,  # the moves are what is read, however good they are
        largest_std_percent=1e6,
    )
    save_plan(made, path)
    found = load_plan(path, cell)
    assert found.moves == made.moves
    assert found.duration_s == pytest.approx(made.duration_s)
    assert found.predicted_std_percent == pytest.approx(made.predicted_std_percent, abs=5e-4)
    expected = (made.units, cell.name, seed)
    assert (found.units, found.cell, found.seed) == expected


def test_moves_that_would_tear_a_closed_chain_are_refused(tmp_path: Path) -> None:
    cell = load_cell(CELLS / "dualv.yaml")
    path = tmp_path / "plan.yaml"
    text = (
        "format: drivegain-plan\ncell: dualv\nseed: 1\ncondition: 1500.0\nmoves:\n"
        "  - {target_deg: [0, 0, 0, 0], velocity: 0.5, acceleration: 0.5, dwell_s: 0.1}\n"
    )
    path.write_text(text)
    read = load_plan(path, cell)
    start_rad = np.radians([0.3, 0.0, 0.0, 0.0])
    assert way_to_first_target(cell, read, start_rad) == (read.moves, "")
    with pytest.raises(
        MotionRefused,
        match=r"the loops do not close, or are close to a "
        r"singularity, at .*closures",
    ):
        way_to_first_target(cell, load_plan(path, cell), np.radians([0.0, 8.0, 0.0, 0.0]))
    path.write_text(text + "  - {target_deg: [0, 12, 0, 0], velocity: 0.5, acceleration: 0.5}\n")
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"moves\[1\], on the way there: found that "
        r"the loops do not",
    ):
        load_plan(path, cell)


def _with_joint_renamed(cell: Cell) -> Cell:
    name = read_urdf(cell.urdf).joints[2].name
    urdf = cell.urdf.replace(f'"{name}"', '"another"')
    return replace(cell, urdf=urdf)


def _with_other_node(cell: Cell) -> Cell:
    third = replace(cell.axes[2], node_id=33)
    axes = (*cell.axes[:2], third, *cell.axes[3:])
    return replace(cell, axes=axes)


def _with_other_product(cell: Cell) -> Cell:
    identity = cell.axes[2].identity
    assert identity is not None
    changed_identity = replace(identity, product_code=7)
    third = replace(cell.axes[2], identity=changed_identity)
    axes = (*cell.axes[:2], third, *cell.axes[3:])
    return replace(cell, axes=axes)


OTHER_ROBOTS: dict[str, tuple[Callable[[Cell], Cell], str, str]] = {
    "another joint": (
        _with_joint_renamed,
        r"joint \S+ \(revolute, behind .*; expected joint another \(revolute",
        "joints",
    ),
    "another node": (
        _with_other_node,
        r"drive of J3 with node id 3; expected drive of J3 with node id 33",
        "drives",
    ),
    "another product": (
        _with_other_product,
        r"drive of J3 with product code 0x40200; expected .* with product code 0x7",
        "drives",
    ),
}


@pytest.mark.parametrize("kind", OTHER_ROBOTS)
def test_a_plan_of_another_robot_with_the_same_cell_name_is_refused(
    kind: str, demo: Cell, made: Plan, tmp_path: Path
) -> None:
    change, message, part = OTHER_ROBOTS[kind]
    other = change(demo)
    assert other.name == demo.name
    path = tmp_path / "plan.yaml"
    save_plan(made, path)
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_plan(path, other)
    # A plan of an earlier version has the digests alone.
    assert made.robot is not None
    robot = _digests_alone(made.robot)
    changed_made = replace(made, robot=robot)
    save_plan(changed_made, path)
    with pytest.raises(ConfigurationInconsistent, match=f"other {part}.*; expected the same"):
        load_plan(path, other)


def test_a_plan_is_of_the_same_robot_once_its_cell_file_says_more_of_the_drives(
    demo: Cell, made: Plan, tmp_path: Path
) -> None:
    axes = tuple(replace(axis, identity=None) for axis in demo.axes)
    unnamed = replace(demo, axes=axes)
    robot = calibrated_robot(unnamed)
    path = tmp_path / "plan.yaml"
    for stated in (robot, _digests_alone(robot)):
        changed_made = replace(made, robot=stated)
        save_plan(changed_made, path)
        assert load_plan(path, demo).robot == stated


def _digests_alone(robot: CalibratedRobot) -> CalibratedRobot:
    return replace(robot, joints=(), drives=(), motors=())


def test_a_plan_is_read_with_a_corrected_description(
    demo: Cell, made: Plan, tmp_path: Path
) -> None:
    first = demo.axes[0]
    assert first.identity is not None
    exchanged_drive = replace(first.identity, serial=9999)
    zero_offset_rad = first.zero_offset_rad + 0.01
    axis = replace(first, zero_offset_rad=zero_offset_rad, identity=exchanged_drive)
    axes = (axis, *demo.axes[1:])
    gravity_m_s2 = (0.0, 0.1, -9.8)
    corrected = replace(demo, axes=axes, gravity_m_s2=gravity_m_s2)
    path = tmp_path / "plan.yaml"
    save_plan(made, path)
    assert load_plan(path, corrected).robot == made.robot


def test_a_plan_of_an_earlier_version_is_read(demo: Cell, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(OLD)
    found = load_plan(path, demo)
    assert found.predicted_std_percent == ()
    assert len(found.moves) == 2


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (
            "velocity: 0.5, acceleration: 0.5}",
            "velocity: 0.5, acceleration: 0.00005}",
            SchemaMismatch,
            "acceleration",
        ),
        (
            "velocity: 0.5, acceleration: 0.5}",
            "velocity: 1.5, acceleration: 0.5}",
            SchemaMismatch,
            "velocity",
        ),
        (
            "velocity: 0.5, acceleration: 0.5}",
            "velocity: .nan, acceleration: 0.5}",
            SchemaMismatch,
            "velocity",
        ),
        ("dwell_s: 0.1", "dwell_s: 61", SchemaMismatch, "dwell_s"),
        ("target_deg: [10, 5", "target_deg: [10, 500", ConfigurationInconsistent, "500 deg"),
        ("target_deg: [10, 5,", "target_deg: [10,", ConfigurationInconsistent, "5 positions"),
        ("target_deg: [10, 5", "target: [10, 5", ConfigurationInconsistent, "target_deg"),
        ("cell: demo", "cell: other", ConfigurationInconsistent, "other"),
        ("condition: 1500.0", "condition: -1.0", SchemaMismatch, "condition"),
        ("moves:", "predicted_std_percent: [1.0]\nmoves:", ConfigurationInconsistent, "one a gain"),
        (
            "moves:",
            "predicted_std_percent: [0, 1, 1, 1, 1, 1]\nmoves:",
            SchemaMismatch,
            "predicted_std_percent",
        ),
        ("moves:", "surprise: 1\nmoves:", SchemaMismatch, "surprise"),
    ],
)
def test_what_a_hand_may_have_changed_is_refused(
    demo: Cell, tmp_path: Path, old: str, new: str, error: type[Exception], message: str
) -> None:
    path = tmp_path / "plan.yaml"
    assert old in OLD
    path.write_text(OLD.replace(old, new, 1))
    with pytest.raises(error, match=message):
        load_plan(path, demo)


def test_more_than_an_hour_is_refused(demo: Cell, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(
        OLD + "  - {target_deg: [10, 5, 80, 0, 0, 0], velocity: 1, acceleration: 1, "
        "dwell_s: 60}\n" * 61
    )
    with pytest.raises(ConfigurationInconsistent, match="at most 3600 s"):
        load_plan(path, demo)


def test_a_way_through_a_declared_obstacle_is_refused(
    demo: Cell, made: Plan, tmp_path: Path
) -> None:
    path = tmp_path / "plan.yaml"
    save_plan(made, path)
    lower_m = (-0.6, -0.6, 0.3)
    upper_m = (0.6, 0.6, 1.2)
    everywhere = Box("press", lower_m, upper_m)
    clearance = Clearance(None, 0.01, (), (everywhere,))
    blocked = replace(demo, clearance=clearance)
    with pytest.raises(ConfigurationInconsistent, match="press"):
        load_plan(path, blocked)


def test_the_command_line_says_how_well_each_gain_will_be_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan.yaml"
    arguments = [
        "plan",
        str(CELLS / "demo.yaml"),
        "--out",
        str(out),
        "--duration",
        "8",
        "--exchanges",
        "10",
    ]
    assert main([*arguments, "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    expected = ["J1", "J2", "J3", "J4", "J5", "J6"]
    assert [gain["axis"] for gain in found["gains"]] == expected
    first_gain = found["gains"][0]
    assert "identifiable only through inertia" in first_gain["words"]
    alone_percent = found["gains"][0]["alone_percent"]
    assert alone_percent["gravity"] is None
    assert any("guess" in line for line in found["assumed"])
    weak = [gain for gain in found["gains"] if gain["verdict"] != "good"]
    assert weak
    assert all("; add " in gain["words"] for gain in weak)
    assert main(arguments) == ExitCode.OK
    text = capsys.readouterr().out
    assert "predicted σ" in text
    assert (
        "The way to its first target is not checked: the cell file declares no `workspace`"
    ) in text
    page = tmp_path / "look.html"
    for _ in range(2):  # a preview is replaced
        assert main([*arguments, "--preview", str(page)]) == ExitCode.OK
    plan_path = tmp_path / "plan.yaml"
    assert find_preview(plan_path) == page
    assert main([*arguments, "--preview", str(tmp_path / "look.pdf")]) == ExitCode.USAGE
    assert "a name that ends in .html" in capsys.readouterr().err
    assert main([*arguments, "--sigma", "0.1"]) == ExitCode.USAGE
    assert main([*arguments, "--payload", "anvil"]) == ExitCode.CONFIGURATION
