"""Cells of any robot: prismatic axes in mm, leads, gains in N/A,
and a bus that is long enough for its axes.
"""

from __future__ import annotations

import shutil
from math import pi, radians
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from daq.config.cell import DEGREE, MILLIMETRE, joint_unit, model_of
from daq.config.cell_buses import answer_us, frame_bits
from daq.config.cell_file import load_cell
from daq.config.cell_schema import gain_joints
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent, PositionImplausible, SchemaMismatch
from daq.log.conversion import check_limits, scaling
from daq.log.metadata import AxisReadback, Readback
from daq.report.plots import plot_torques
from daq.simulation.simulation_file import load_simulation
from ident.model.model import DriveTrain
from ident.model.robot import JointKind
from ident.model.urdf import robot_from_urdf
from tests.conftest import CHECKOUT

GANTRY = load_cell(CHECKOUT / "configs/cells/gantry.yaml")
SEVEN = load_cell(CHECKOUT / "configs/cells/seven-axis.yaml")


@pytest.fixture
def configurations(tmp_path: Path) -> Path:
    """A copy of the shipped configurations that a test may spoil."""
    folder = tmp_path / "configs"
    shutil.copytree(shipped_configurations(), folder)
    return folder


def _spoil(path: Path, *changes: tuple[str, str]) -> Path:
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")
    return path


def test_the_gantry_is_read_in_si_units() -> None:
    x, _, z, a, _ = GANTRY.axes
    assert x.unit == MILLIMETRE
    assert z.unit == MILLIMETRE
    assert a.unit == DEGREE
    assert x.limits.position == pytest.approx((0.0, 1.4))
    assert (z.limits.velocity, z.limits.acceleration) == pytest.approx((0.6, 4.5))
    expected = (radians(-175), radians(175))
    assert a.limits.position == expected
    gain_units = [axis.gain_unit for axis in GANTRY.axes]
    assert gain_units == ["N/A", "N/A", "N/A", "Nm/A", "Nm/A"]
    assert GANTRY.conditioning.standstill_rad_s == pytest.approx((0.008, 0.008, 0.005, 0.03, 0.03))
    # One turn of the screw moves Z by 20 mm; five of a belt motor move X and Y by 150 mm each.
    assert GANTRY.ratio[2, 2] == pytest.approx(2 * pi / 0.020)
    assert GANTRY.ratio[:2, :2] == pytest.approx(5 * 2 * pi / 0.150 * np.array([[1, 1], [1, -1]]))
    ratio = GANTRY.ratio[4].tolist()
    assert ratio == [0, 0, 0, -50, 50]
    joints = model_of(GANTRY).robot.joints
    kinds = [joint.kind.value for joint in joints]
    assert kinds == ["prismatic", "prismatic", "prismatic", "revolute", "revolute"]


def test_a_turn_of_the_screw_is_its_lead() -> None:
    axes = tuple(AxisReadback(name, 0.003) for name in GANTRY.axis_names)
    scale = scaling(GANTRY, Readback(axes))
    counts = np.array([0, 0, 65536, 0, 0])
    assert scale.joint_position(counts) == pytest.approx([0, 0, 0.020, 0, 0])
    # Both belt motors a turn forwards: X alone moves, by a fifth of the pulley's circumference.
    found = scale.joint_position(np.array([65536, 65536, 0, 0, 0]))
    assert found == pytest.approx([0.030, 0, 0, 0, 0])


@pytest.mark.parametrize("name", ["gantry", "seven-axis", "rx90", "kr270"])
def test_declaration_and_truth_speak_of_one_robot(name: str) -> None:
    path = CHECKOUT / f"configs/cells/{name}.yaml"
    cell = load_cell(path)
    payload = cell.payloads[0].name
    spec = load_simulation(CHECKOUT / f"configs/simulation/{name}.yaml", payload)
    np.testing.assert_allclose(spec.ratio, cell.ratio, rtol=1e-9)
    assert spec.gravity_m_s2 == cell.gravity_m_s2
    assert spec.payload is not None
    assert spec.payload.mass_kg == cell.payloads[0].mass_kg
    texts = (cell.urdf, spec.urdf)
    declared, plant = (robot_from_urdf(text, spec.gravity_m_s2) for text in texts)
    for one, other in zip(declared.joints, plant.joints, strict=True):
        np.testing.assert_array_equal(one.translation_m, other.translation_m)
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.axis, other.axis)
    for start, axis, true in zip(spec.start_rad, cell.axes, spec.axes, strict=True):
        assert axis.limits.position[0] < start < axis.limits.position[1]
        assert axis.identity is not None
        expected = (true.node_id, true.serial)
        assert (axis.node_id, axis.identity.serial) == expected
        assert 0.02 < abs(true.gain_nm_per_a / axis.nameplate_gain - 1) < 0.1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("position_mm: [0, 1400], velocity_mm_s: 1500, acceleration_mm_s2: 6000",
         "position_deg: [0, 140], velocity_deg_s: 150, acceleration_deg_s2: 600",
         "limits in deg, and joint X of the URDF is prismatic; expected position_mm, "
         "velocity_mm_s"),
        ("position_deg: [-175, 175], velocity_deg_s: 240, acceleration_deg_s2: 1200",
         "position_mm: [-175, 175], velocity_mm_s: 240, acceleration_mm_s2: 1200",
         "limits in mm, and joint A of the URDF is revolute; expected position_deg"),
        ("[0, 1400]", "[0, 1.4]", "range of at least 5 mm; are these m"),
        ("[0, 1400]", "[0, 1400000]", "at most ±100000 mm; are these counts or µm"),
        ("[0, 500]", "[500, 0]", "the lower limit first"),
        ("lead_mm: 20.0 ", "zero_offset_deg: 3.0\n    "
                           "lead_mm: 20.0 ", "deg, and joint Z .* expected zero_offset_mm"),
        ("nameplate_gain_nm_per_a: 12.0", "lead_mm: 5\n    "
                                          "nameplate_gain_nm_per_a: 12.0", "only a prismatic joint"),  # noqa: E501
        ("nameplate_gain_n_per_a: 157.1", "nameplate_gain_nm_per_a: 157.1", "a gain in Nm, .* "
                                                                            "joint Z, "
                                                                            "which is pris"),
        ("nameplate_gain_n_per_a: 157.1", "nameplate_gain: 157.1\n    "
                                          "gain_unit: Nm/mV", "gain_unit: .* N per"),
        ("nameplate_gain_nm_per_a: 12.0", "nameplate_gain_n_per_a: 12.0", "a gain in N, .* joint "
                                                                          "A, which is revolute"),
        ("standstill_mm_s: [8, 8, 5, null, null]", "#", "0 speeds; expected 5"),
        ("standstill_mm_s: [8, 8, 5, null, "
         "null]", "standstill_mm_s: [8, 8, 5, null]", "4 speeds; expected 5"),
        ("[8, 8, 5, null, null]", "[8, 8, null, null, "
                        "null]", "None for Z, which is prismatic; expected a speed"),
        ("[null, null, null, 0.03, "
         "0.03]", "[0.1, null, null, 0.03, 0.03]", "0.1 for X, .* expected null"),
    ],
)  # fmt: skip
def test_mm_and_degrees_are_not_confused(
    configurations: Path, old: str, new: str, message: str
) -> None:
    gantry_path = configurations / "cells/gantry.yaml"
    path = _spoil(gantry_path, (old, new))
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(path)


def test_limits_in_metres_are_recognised_by_the_urdf(configurations: Path) -> None:
    gantry_path = configurations / "cells/gantry.yaml"
    path = _spoil(gantry_path, ("[0, 1400]", "[0, 14]"))
    urdf = configurations / "robots/gantry.urdf"
    _spoil(urdf, ('lower="0.0" upper="1.4"', 'lower="0.0" upper="14.2"'))
    with pytest.raises(
        ConfigurationInconsistent, match="the numbers of the URDF in m; expected mm; multiply by 1e"
    ):
        load_cell(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "velocity_mm_s: 600",
            "velocity_deg_s: 600",
            r"axes\[2\].limits: .*for a prismatic joint "
            r"position_mm",
        ),
        ("lead_mm: 20.0", "lead_mm: 0.0", r"axes\[2\]: .*not zero"),
        ("nameplate_gain_n_per_a: 157.1", "gain_unit: N/A", "nameplate_gain_n_per_a"),
        ("lead_mm: 20.0", "lead_m: 0.02", "unknown key 'lead_m'.*lead_mm"),
    ],
)
def test_a_misspelt_prismatic_axis_is_refused(
    configurations: Path, old: str, new: str, message: str
) -> None:
    gantry_path = configurations / "cells/gantry.yaml"
    path = _spoil(gantry_path, (old, new))
    with pytest.raises(SchemaMismatch, match=message):
        load_cell(path)


def test_positions_outside_the_limits_are_reported_in_mm() -> None:
    position = np.full((10, 5), 0.2)
    position[3, 1] = 350.0
    with pytest.raises(PositionImplausible) as caught:
        check_limits("log", position, GANTRY)
    text = str(caught.value)
    assert "axis Y" in text
    assert "joint positions from 200 to 3.5e+05 mm" in text
    assert "0 to 900 mm" in text
    assert "mm were taken for m" in text


@pytest.mark.parametrize(
    ("ends_m", "said"),
    [
        ((0.7, 1.1), "most likely the zero is wrong: moved by -745 to -155 mm"),
        ((0.0, 1.1), "mm were taken for m"),
    ],
    ids=["as many as the axis can make", "more"],
)
def test_positions_that_another_zero_brings_within_the_limits_are_not_blamed_on_units(
    ends_m: tuple[float, float], said: str
) -> None:
    position = np.full((10, 5), 0.2)
    position[:, 1] = np.linspace(*ends_m, 10)
    with pytest.raises(PositionImplausible) as caught:
        check_limits("log", position, GANTRY)
    assert said in str(caught.value)


def test_one_start_a_joint(tmp_path: Path) -> None:
    for name in ("gantry.yaml", "gantry-plant.urdf"):
        shutil.copyfile(CHECKOUT / "configs/simulation" / name, tmp_path / name)
    gantry_path = tmp_path / "gantry.yaml"
    path = _spoil(gantry_path, ("[700, 450, 200, null, null]", "[700, 450, null, null, null]"))
    with pytest.raises(ConfigurationInconsistent, match="joint 3"):
        load_simulation(path)
    _spoil(path, ("[700, 450, null, null, null]", "[700, 450, 200, null]"))
    with pytest.raises(ConfigurationInconsistent, match="4 positions"):
        load_simulation(path)


ENTRY = st.sampled_from((0.0, 0.0, 1.0, -5.0, 50.0, 314.159))


@given(
    st.integers(1, 6).flatmap(
        lambda n: st.lists(st.lists(ENTRY, min_size=n, max_size=n), min_size=n, max_size=n)
    )
)
def test_the_joint_of_a_gain_is_that_of_its_reduction(rows: list[list[float]]) -> None:
    ratio = np.array(rows)
    ratio_rank = np.linalg.matrix_rank(ratio)
    assume(ratio_rank == len(ratio) and np.linalg.cond(ratio) < 1e6)
    found = ratio[np.arange(len(ratio)), list(gain_joints(ratio))]
    np.testing.assert_array_equal(found, DriveTrain(ratio).reduction)


def test_the_longest_frame_is_that_of_the_standard() -> None:
    """Eight bytes: 108 bits, 24 bits of stuffing and three of space."""
    assert [frame_bits(size) for size in (0, 1, 8)] == [55, 65, 135]


def test_seven_axes_do_not_fit_into_a_millisecond(configurations: Path) -> None:
    profile = SEVEN.axes[0].profile
    assert profile is not None
    profiles = [profile] * 6
    assert answer_us(profiles, 1_000_000) == 865.0
    timed = [("interface: virtual", "interface: socketcan"), ("pacing: lockstep", "pacing: timed")]
    seven_axis_path = configurations / "cells/seven-axis.yaml"
    cell = load_cell(_spoil(seven_axis_path, *timed))
    assert cell.sync is not None
    path = _spoil(configurations / "cells/seven-axis.yaml", ("period_us: 2000", "period_us: 1000"))
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"answers of 7 axes.* by 89 % on average, "
        r"100 % .*: 1112 or",
    ):
        load_cell(path)
    _spoil(
        path, ("pacing: timed", "pacing: lockstep"), ("interface: socketcan", "interface: virtual")
    )
    assert load_cell(path).sync is not None


def test_a_picture_says_newton_where_the_joint_slides() -> None:
    time_s = np.linspace(0.0, 1.0, 50)
    force = np.stack([np.sin(9 * time_s), np.cos(9 * time_s)], axis=1)
    torque, sliding = (
        plot_torques(time_s, force, 0.9 * force, ("Z", "A"), forces=forces)
        for forces in (("Nm", "Nm"), ("N", "Nm"))
    )
    assert torque != sliding


def test_every_kind_of_joint_has_a_unit() -> None:
    names = {joint_unit(kind).name for kind in JointKind}
    assert names == {"deg", "mm"}
    assert MILLIMETRE.spell(0.0125) == "12.5 mm"
    assert DEGREE.spell(pi) == "180 deg"
