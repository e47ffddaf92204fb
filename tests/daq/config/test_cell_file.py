"""Cell files: read whole, bundled whole, refused with the reason."""

from __future__ import annotations

import re
import shutil
from math import radians
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import PacingMode, joint_names, model_of
from daq.config.cell_buses import bus_address, bus_parts, cell_address, drive_axes
from daq.config.cell_file import bundle, cell_from_bundle, load_cell
from daq.config.drive import drive_from_text
from daq.config.yaml_file import parse_yaml
from daq.environment import shipped_configurations
from daq.errors import (
    ConfigurationError,
    ConfigurationInconsistent,
    ConfigurationMissing,
    SchemaMismatch,
)
from drivers.canopen.bus import BusAddress
from drivers.canopen.split_bus import SplitAddress
from drivers.profiles.profile import Amplitude, ObjectEntry, TapPoint
from ident.model.urdf import read_urdf
from tests.two_buses import LEFT, RIGHT, on_two_buses


@pytest.fixture
def configurations(tmp_path: Path) -> Path:
    """A copy of the shipped configurations that a test may spoil."""
    folder = tmp_path / "configs"
    shutil.copytree(shipped_configurations(), folder)
    return folder


def _spoil(path: Path, old: str, new: str) -> Path:
    text = path.read_text(encoding="utf-8")
    assert old in text
    changed_text = text.replace(old, new, 1)
    path.write_text(changed_text, encoding="utf-8")
    return path


def test_the_demo_cell_is_read_in_si_units(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    path = str(checkout / "configs/cells/demo.yaml")
    assert load_cell(path).digest == cell.digest
    assert cell.name == "demo"
    expected = ("J1", "J2", "J3", "J4", "J5", "J6")
    assert cell.axis_names == expected
    np.testing.assert_array_equal(cell.ratio[5], [0, 0, 0, 0, 32, 32])
    position = cell.axes[4].limits.position
    assert position == (radians(-115), radians(128))
    nameplate_gain = cell.axes[3].nameplate_gain
    assert nameplate_gain == -11.52
    assert cell.axes[0].gain_unit == "Nm/A"
    known = cell.payloads[0].payload.known
    assert known == {"m": 4.59}
    assert cell.sync is not None
    assert cell.sync.pacing is PacingMode.LOCKSTEP
    assert cell.controller_path == checkout / "configs/controllers/demo.yaml"
    profile = cell.axes[0].profile
    assert profile is not None
    object_entry = ObjectEntry(0x6074, 0, 16, signed=True)
    assert profile.current == object_entry
    assert profile.amplitude == Amplitude.RMS
    assert profile.tap == TapPoint.REFERENCE
    node_ids = [axis.node_id for axis in drive_axes(cell)]
    assert node_ids == [1, 2, 3, 4, 5, 6]
    assert bus_address(cell).interface == "virtual"


def test_a_cell_without_a_bus_only_imports(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/tx40.yaml")
    assert cell.buses == ()
    expected = radians(-90)
    assert cell.axes[1].zero_offset_rad == expected
    assert cell.axes[0].gain_unit == "Nm/Nm(motor, a priori)"
    with pytest.raises(ConfigurationInconsistent, match="no bus"):
        bus_address(cell)
    with pytest.raises(ConfigurationInconsistent, match="without node_id"):
        drive_axes(cell)


@pytest.mark.parametrize(
    "kept", ["", "    identity: {vendor_id: 1}\n", "    identity: {vendor_id: 1, serial: 2}\n"]
)
def test_an_axis_may_leave_its_identity_open_or_a_part_of_it(
    configurations: Path, kept: str
) -> None:
    path = configurations / "cells/demo.yaml"
    text = path.read_text()
    path.write_text(re.sub(r"    identity: .*\n", kept, text))
    assert path.read_text() != text
    identity = drive_axes(load_cell(path))[0].identity
    assert (identity is None) == (kept == "")
    assert identity is None or identity.product_code is None


def test_limits_in_rad_are_recognised_without_limits_in_the_urdf(configurations: Path) -> None:
    """On continuous joints no number of the URDF gives the unit away,
    but no axis can move more than a few degrees.
    """
    urdf = configurations / "robots/tx40.urdf"
    path = configurations / "cells/demo.yaml"
    changed_text = re.sub(r"<limit [^>]*>", "", urdf.read_text()).replace(
        '"revolute"', '"continuous"'
    )
    urdf.write_text(changed_text)
    load_cell(path)
    text = path.read_text()
    in_rad = re.sub(r"position_deg: \[[^]]*\]", "position_deg: [-3.1, 3.1]", text)
    path.write_text(in_rad)
    with pytest.raises(ConfigurationInconsistent, match=r"6 faults(.|\n)*are these in rad"):
        load_cell(path)
    path.write_text(in_rad.replace("[-3.1, 3.1]", "[-10, 10]", 1))  # one axis moves
    load_cell(path)


def test_a_log_with_an_implausible_cell_can_be_read(configurations: Path) -> None:
    """Earlier versions recorded with it, and the copy in a log cannot be corrected."""
    path = configurations / "cells/demo.yaml"
    files = bundle(path)
    changed_cell_yaml = files["cell.yaml"].replace(b"mass_kg: 4.59", b"mass_kg: 4590")
    heavy = {**files, "cell.yaml": changed_cell_yaml}
    first_payload = cell_from_bundle(heavy).payloads[0]
    assert first_payload.mass_kg == 4590.0
    for old, new in (
        (b"mass_kg: 4.59", b"mass_kg: 4.59\n    centre_m: [-20, 30, 50]"),
        (b"velocity_deg_s: 200", b"velocity_deg_s: 1.0e15"),
        (b"payloads:", b"effects: [{name: sprung, axis: J1}]\npayloads:"),
    ):
        assert old in files["cell.yaml"]
        cell = cell_from_bundle({**files, "cell.yaml": files["cell.yaml"].replace(old, new, 1)})
        assert cell.name == "demo"


def test_a_bundle_takes_the_data_sheet_along_that_a_profile_names(
    checkout: Path, tmp_path: Path
) -> None:
    cells = tmp_path / "cells"
    drives = tmp_path / "drives"
    cells.mkdir()
    drives.mkdir()
    configs = checkout / "configs"
    text = (configs / "cells/demo.yaml").read_text().replace("../robots", str(configs / "robots"))
    (cells / "cell.yaml").write_text(text)
    profile = (configs / "drives/generic-cia402.yaml").read_text()
    (drives / "generic-cia402.yaml").write_text(profile)
    path = cells / "cell.yaml"
    assert not [name for name in bundle(path) if name.endswith(".eds")]
    (drives / "generic-cia402.yaml").write_text(profile + "eds: maker.eds\n")
    (drives / "maker.eds").write_bytes(b"[FileInfo]\n")
    cell_path = cells / "cell.yaml"
    assert bundle(cell_path)["drives/generic-cia402.eds"] == b"[FileInfo]\n"
    (drives / "maker.eds").unlink()
    with pytest.raises(ConfigurationMissing, match=r"maker\.eds"):
        bundle(cells / "cell.yaml")


def test_a_bundle_is_the_same_cell_without_its_files(checkout: Path) -> None:
    path = checkout / "configs/cells/demo.yaml"
    files = bundle(path)
    assert set(files) == {"cell.yaml", "robot.urdf", "drives/generic-cia402.yaml"}
    cell = load_cell(path)
    again = cell_from_bundle({**files, "readback.json": b"{}"})
    assert again.digest == cell.digest
    assert again.axes == cell.axes
    assert again.urdf == cell.urdf
    assert again.folder is None
    with pytest.raises(ConfigurationMissing, match=r"robot\.urdf"):
        cell_from_bundle({name: data for name, data in files.items() if name != "robot.urdf"})


def test_the_digest_follows_every_file(configurations: Path) -> None:
    path = configurations / "cells/demo.yaml"
    before = load_cell(path).digest
    generic_cia402_path = configurations / "drives/generic-cia402.yaml"
    _spoil(generic_cia402_path, "amplitude: rms", "amplitude: peak")
    assert load_cell(path).digest != before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("    - [32, 0, 0, 0, 0, 0]\n", "", "5 rows"),
        ("[32, 0, 0, 0, 0, 0]", "[32, 0, 0, 0, 0]", r"rows of 5, 6 numbers; expected 6 × 6"),
        ("[0, 0, 0, 0, 32, 32]", "[0, 0, 0, 0, 45, 0]", "singular"),
        ("node_id: 2", "node_id: 1", "1, used 2 times"),
        ("node_id: 2", "node_id: 128", "1 to 127"),
        ("node_id: 2\n", "#\n", "axes.1..node_id: found nothing"),
        ("name: J2", "name: J1", "J1, used 2 times"),
        ("[-170, 170]", "[170, -170]", "lower limit first"),
        ("[-170, 170]", "[-2.967, 2.967]", "the numbers of the URDF in rad"),
        (
            "[-170, 170]",
            "[-2.5, 2.5]",
            "the numbers of the URDF in rad; expected deg; multiply by 57.3",
        ),
        (
            "velocity_deg_s: 200",
            "velocity_deg_s: 5.2",
            r"velocity_deg_s: found 5.2 deg/s, the "
            r"number .* rad/s",
        ),
        (
            "mass_kg: 4.59",
            "mass_kg: 4590",
            r"payloads.0..mass_kg: found 4590 kg; expected at most "
            r"2500 kg, or .*in g",
        ),
        (
            "-9.81]",
            "-9.81]\n  rated_payload_kg: 2.3",
            "found 4.59 kg; expected at most the 2.3 kg of `robot.rated",
        ),
        (
            "payloads:",
            "payloads:\n  - {name: ring, mounting: flange-b, mass_kg: 1686}",
            "367 times another payload",
        ),
        ("[-170, 170]", "[-17000, 17000]", "at most ±720 deg"),
        ("[-170, 170]", "[-0.05, 0.05]", "a range of at least 0.2 deg"),
        ("mass_kg: 4.59", "mass_kg: -4.59", "positive mass"),
        ("gain_nm_per_a: 25.65", "gain_nm_per_a: 0", "not zero"),
        ("-9.81]", "-9810]", "9810 m/s²"),
        ("mass_kg: 4.59", "mass_kg: 1.0e-9", "is this in t"),
        (
            "mass_kg: 4.59",
            "mass_kg: 4.59\n    centre_m: [-20, 30, 50]",
            "61.64 m from the origin; .*in mm",
        ),
        (
            "mass_kg: 4.59",
            "mass_kg: 4.59\n    centre_m: [1.0e200, 0, 0]",
            "1e.200 m from the origin",
        ),
        (
            "mass_kg: 4.59",
            "mass_kg: 4.59\n    centre_m: [0, 0, 0]\n    inertia_kg_m2: [6000, 0, 0, "
            "6000, 0, 6000]",
            r"inertia_kg_m2: found a radius of gyration √\(I/m\) of 36.* m; expected at most 5 m; "
            r"is this in kg mm²",
        ),
        (
            "mass_kg: 4.59",
            "mass_kg: 4.59\n    centre_m: [0, 0, 0]\n    inertia_kg_m2: [1.0e200, 0, 0, 1.0e200, "
            "0, 1.0e200]",
            "radius of gyration",
        ),
        ("mass_kg: 4.59", "mass_kg: 4.59\n    known: {mx: 459}", "100 m from the origin"),
        (
            "mass_kg: 4.59",
            "mass_kg: 4.59\n    known: {Ixx: 1.0e308}",
            r"known.Ixx: found a radius of gyration",
        ),
        (
            "velocity_deg_s: 200",
            "velocity_deg_s: 1.0e-322",
            "velocity_deg_s: .*expected 0.01 to 100000 deg/s",
        ),
        (
            "velocity_deg_s: 200",
            "velocity_deg_s: 1.0e15",
            "velocity_deg_s: .*expected 0.01 to 100000 deg/s",
        ),
        (
            "acceleration_deg_s2: 800",
            "acceleration_deg_s2: 1.0e308",
            r"acceleration_deg_s2: .*deg/s²",
        ),
        (
            "[32, 0, 0, 0, 0, 0]",
            "[1.0e-300, 0, 0, 0, 0, 0]",
            r"ratio\[0\]: found 1e-300, 0, .*0.01 to 1e.07",
        ),
        (
            "[32, 0, 0, 0, 0, 0]",
            "[1.0e200, 0, 0, 0, 0, 0]",
            r"ratio\[0\]: found 1e.200, 0, .*0.01 to 1e.07",
        ),
        ("[32, 0, 0, 0, 0, 0]", "[32, 1.0e-9, 0, 0, 0, 0]", "no smaller coupling than 1e-06"),
        ("gain_nm_per_a: 25.65", "gain_nm_per_a: 5.0e-324", "1e-05 to 1e.07 in size"),
        ("gain_nm_per_a: 25.65", "gain_nm_per_a: 1.0e100", "1e-05 to 1e.07 in size"),
        (
            "payloads:",
            "effects: [{name: sprung, axis: J1}]\npayloads:",
            "no such effect; expected one of stribeck",
        ),
        (
            "payloads:",
            "effects: [{name: cogging, axis: J1, settings: {order: 2.5}}]\npayloads:",
            "2.5; .*whole number",
        ),
        (
            "payloads:",
            "effects: [{name: stribeck, axis: J1, settings: {gap: 1}}]\npayloads:",
            "found settings gap",
        ),
        ("payloads:", "effects: [{name: passive-spring, axis: J1}]\npayloads:", "without a motor"),
        (
            "payloads:",
            "effects: [{name: inertial-coupling, axis: J3, settings: {other_axis: 2}}]\npayloads:",
            r"effects\[0\].axis: .* the pair the other way",
        ),
        ("[0.03, 0.03, ", "[0.03, ", "5 speeds"),
        ("[drives.J1.gain, ", "[", "5 keys"),
        ("tx40.urdf", "../simulation/demo.yaml", "a URDF of an arm"),
        ("sync:\n  period_us: 1000\n  pacing: lockstep ", "#", "sampling period"),
        (
            "interface: virtual",
            "interface: socketcan",
            "lockstep on a bus of interface socketcan; expected timed",
        ),
        (
            "interface: virtual",
            "interface: pcan",
            "lockstep on a bus of interface pcan; expected timed",
        ),
        (
            "period_us: 1000",
            "period_us: 999",
            r"999, while drive generic-cia402 refreshes .* every "
            r"1000 µs; .*1000 or",
        ),
    ],
)
def test_a_cell_that_contradicts_itself_is_refused(
    configurations: Path, old: str, new: str, message: str
) -> None:
    demo_path = configurations / "cells/demo.yaml"
    path = _spoil(demo_path, old, new)
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(path)


def test_axes_in_another_order_than_their_joints_are_refused(configurations: Path) -> None:
    urdf = configurations / "robots/tx40.urdf"
    changed_text = urdf.read_text().replace('"J1"', '"J0"')
    text = changed_text.replace('"J2"', '"J1"').replace('"J0"', '"J2"')
    urdf.write_text(text)
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"axes\[0\]\.name: found J2 as the joint "
        r"of axis J1",
    ):
        load_cell(configurations / "cells/demo.yaml")


def test_an_empty_urdf_is_no_robot(configurations: Path) -> None:
    (configurations / "robots/tx40.urdf").write_text(" \n")
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"robot\.urdf: found an empty file; "
        r"expected a URDF of an arm",
    ):
        load_cell(configurations / "cells/demo.yaml")


@pytest.mark.parametrize("lead", ["5.0e-324", "1.0e300"])
def test_a_lead_that_no_screw_has_is_refused(configurations: Path, lead: str) -> None:
    gantry_path = configurations / "cells/gantry.yaml"
    path = _spoil(gantry_path, "lead_mm: 20.0", f"lead_mm: {lead}")
    with pytest.raises(SchemaMismatch, match=r"0\.01 to 10000 mm in size"):
        load_cell(path)


@pytest.mark.parametrize(
    ("interface", "pacing"),
    [("socketcand", "lockstep"), ("socketcan", "timed"), ("socketcand", "timed")],
)
def test_lockstep_is_for_buses_that_a_simulated_cell_can_be_on(
    configurations: Path, interface: str, pacing: str
) -> None:
    demo_path = configurations / "cells/demo.yaml"
    path = _spoil(demo_path, "interface: virtual", f"interface: {interface}")
    cell = load_cell(_spoil(path, "pacing: lockstep", f"pacing: {pacing}"))
    assert cell.sync is not None
    assert cell.sync.pacing is PacingMode(pacing)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "velocity_deg_s: 200",
            "velocity_deg: 200",
            r"axes\[0\].limits.velocity_deg: "
            r".*velocity_deg_s",
        ),
        ("velocity_deg_s: 200", "velocity_deg_s: -200", "greater than 0"),
        ("pacing: lockstep", "pacing: slowly", "'lockstep' or 'timed'"),
        (
            "nameplate_gain_nm_per_a: 25.65",
            "gain_unit: Nm/A",
            "nameplate_gain together with gain_unit",
        ),
        ("mounting: flange-a", "", r"payloads\[0\].mounting: found nothing"),
    ],
)
def test_a_misspelt_cell_is_refused(configurations: Path, old: str, new: str, message: str) -> None:
    demo_path = configurations / "cells/demo.yaml"
    path = _spoil(demo_path, old, new)
    with pytest.raises(SchemaMismatch, match=message):
        load_cell(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("drive: generic-cia402", "drive: unheard-of", "no file .*generic-cia402"),
        ("tx40.urdf", "none.urdf", "no such file"),
    ],
)
def test_a_missing_file_is_named(configurations: Path, old: str, new: str, message: str) -> None:
    demo_path = configurations / "cells/demo.yaml"
    path = _spoil(demo_path, old, new)
    with pytest.raises(ConfigurationMissing, match=message):
        load_cell(path)
    with pytest.raises(ConfigurationMissing, match="nowhere"):
        load_cell(configurations / "nowhere.yaml")


def test_a_cell_file_copied_without_its_robot_says_which_file_to_copy(
    configurations: Path, tmp_path: Path
) -> None:
    copied = tmp_path / "elsewhere" / "kr270.yaml"
    copied.parent.mkdir()
    shutil.copyfile(configurations / "cells/kr270.yaml", copied)
    with pytest.raises(ConfigurationMissing) as raised:
        load_cell(copied)
    assert "kr270.urdf" in raised.value.subject
    assert "belongs to" in raised.value.expected
    assert "kr270.yaml" in raised.value.expected
    assert "copy it" in raised.value.remedy


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("index: 0x6064", "index: 0x64"),
        ("amplitude: rms", "amplitude: RMS"),
        ("type: i32}", "type: i64}"),
        ("tap:", "tip:"),
    ],
)
def test_a_wrong_drive_profile_is_refused(old: str, new: str) -> None:
    generic_cia402_path = shipped_configurations() / "drives/generic-cia402.yaml"
    text = generic_cia402_path.read_text(encoding="utf-8")
    drive = drive_from_text(text.encode(), "x")
    assert drive.saturation_bit == 11
    changed_content = text.replace(old, new, 1).encode()
    with pytest.raises(ConfigurationError):
        drive_from_text(changed_content, "x")


@pytest.fixture
def two_buses(configurations: Path) -> Path:
    """The demo cell on two."""
    path = configurations / "cells/demo.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(
        on_two_buses(text, "socketcan", "can0", "can1"),
        encoding="utf-8",
    )
    return _spoil(path, "pacing: lockstep", "pacing: timed")


def test_a_cell_may_have_several_buses(two_buses: Path) -> None:
    cell = load_cell(two_buses)
    expected = ["left"] * 3 + ["right"] * 3
    assert [axis.bus for axis in cell.axes] == expected
    address = cell_address(cell)
    assert isinstance(address, SplitAddress)
    assert str(address) == "left (socketcan:can0) + right (socketcan:can1)"
    sorted_node_ids = [sorted(part.node_ids) for part in bus_parts(cell)]
    assert sorted_node_ids == [list(LEFT), list(RIGHT)]
    with pytest.raises(ConfigurationInconsistent, match="2 buses; expected one"):
        bus_address(cell)


def test_a_list_of_one_bus_is_one_bus(configurations: Path) -> None:
    path = configurations / "cells/demo.yaml"
    listed = _spoil(
        path, "bus:\n  interface: virtual", "bus:\n  - name: main\n    interface: virtual"
    )
    cell = load_cell(
        _spoil(_spoil(listed, "  channel: demo", "    channel: demo"), "  bitrate", "    bitrate")
    )
    assert cell_address(cell) == BusAddress("virtual", "demo")
    buses = {axis.bus for axis in cell.axes}
    assert buses == {"main"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "    bus: right\n",
            "",
            r"axes\[3\].bus: found nothing; expected the bus .* several: "
            r"left, right",
        ),
        ("bus: right\n", "bus: middle\n", r"axes\[3\].bus: found middle, .* one of left, right"),
        (
            "name: right",
            "name: left",
            r"bus\[1\].name: found left, used 2 times; expected each "
            r"name once",
        ),
        (
            "channel: can1",
            "channel: can0",
            r"bus\[1\]: found socketcan can0, which bus "
            r"left is too",
        ),
        (
            "node_id: 4",
            "node_id: 1",
            r"node_id: found 1, used 2 times; expected each node once, on "
            r"all buses",
        ),
        (
            "  - {name: right",
            "  - {name: spare, interface: pcan, channel: x}\n  - {name: right",
            "spare without an axi",
        ),
        ("pacing: timed", "pacing: lockstep", "lockstep on a bus of interface socketcan"),
        (
            "pacing: timed",
            "pacing: timed\n  producer: J1",
            "J1 with 2 buses; expected recorder: no other producer",
        ),
        (
            "channel: can1",
            "channel: can1, bitrate_bit_s: 250000",
            r"load bus right by 1\d\d % .* at 250000 bit/s",
        ),
    ],
)
def test_two_buses_that_contradict_each_other_are_refused(
    two_buses: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(_spoil(two_buses, old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name: right, ", "", r"bus\[1\].name: found nothing"),
        ("channel: can1", "chanel: can1", r"bus\[1\].chanel: found unknown key .*channel"),
        ("channel: can1", "channel: 1", r"demo.yaml:\d+: bus\[1\].channel: found integer 1"),
    ],
)
def test_a_misspelt_bus_of_several_is_refused_with_its_place(
    two_buses: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(SchemaMismatch, match=message):
        load_cell(_spoil(two_buses, old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "  channel: demo",
            "  chanel: demo",
            r"demo.yaml:\d+: bus.chanel: found unknown key "
            r".*channel",
        ),
        ("  channel: demo", "  name: x", "bus.name: found unknown key"),
    ],
)
def test_a_misspelt_single_bus_is_refused_with_its_place(
    configurations: Path, old: str, new: str, message: str
) -> None:
    path = configurations / "cells/demo.yaml"
    with pytest.raises(SchemaMismatch, match=message):
        load_cell(_spoil(path, old, new))


@pytest.mark.parametrize("store", ["demo.yaml", "../controllers/demo.yaml", "../cells/other.yaml"])
def test_a_history_that_would_replace_another_file_is_refused(
    configurations: Path, store: str
) -> None:
    cell = configurations / "cells" / "demo.yaml"
    other_path = configurations / "cells" / "other.yaml"
    other_path.hardlink_to(cell)
    with cell.open("a", encoding="utf-8") as stream:
        stream.write(f"\nhistory: {{store: {store}}}\n")
    with pytest.raises(ConfigurationInconsistent, match="a file of the history's own"):
        load_cell(cell)


GRIPPER = """
  <link name="left"><inertial><mass value="0.3"/></inertial></link>
  <link name="right"/>
  <joint name="swivel" type="revolute"><origin xyz="0 0 0.1"/><parent link="link6"/><child link="left"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="left"/><child link="right"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.05" velocity="1" effort="1"/></joint>
</robot>"""  # noqa: E501


@pytest.fixture
def with_gripper(configurations: Path) -> Path:
    """The cell of the TX-40 with a gripper of two joints in its URDF, not yet held."""
    path = configurations / "robots/tx40.urdf"
    _spoil(path, "</robot>", GRIPPER)
    return configurations / "cells/tx40.yaml"


def test_joints_that_are_no_axes_are_held(with_gripper: Path) -> None:
    path = shipped_configurations() / "cells/tx40.yaml"
    bare = model_of(load_cell(path)).robot
    cell = load_cell(_spoil(with_gripper, "\naxes:", "\nhold: {swivel: 30, slide: 0.02}\naxes:"))
    robot = model_of(cell).robot
    expected = [joint.name for joint in bare.joints]
    assert [joint.name for joint in robot.joints] == expected
    urdf = (shipped_configurations() / "robots/tx40.urdf").read_text()
    flange = read_urdf(urdf)
    carrying = read_urdf(cell.urdf)
    last_body = carrying.bodies[-1]
    mass_kg = flange.bodies[-1].mass_kg
    assert last_body.mass_kg == pytest.approx(mass_kg + 0.3)
    assert '<origin xyz="0.0 0.0 0.1" rpy="0.0 0.5235987755982988 0.0" />' in cell.urdf
    assert '<origin xyz="0.0 0.02 0.0"' in cell.urdf
    logged = cell_from_bundle(bundle(with_gripper))
    assert logged.urdf == cell.urdf
    assert logged.recording_digest == cell.recording_digest


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        (
            "",
            r"axes: found 6 axes; expected .*J6, swivel, slide.*hold: \{swivel: 0.0, "
            r"slide: 0.0\}",
        ),
        ("hold: {swivel: 0}", r"axes: found 6 axes; .*hold: \{slide: 0.0\}"),
        (
            "hold: {swivel: 0, slide: 0, thumb: 0}",
            "hold: found no movable joint 'thumb'.*J6, swivel, slide",
        ),
        ("hold: {swivel: 0, slide: 0, J6: 0}", "hold.J6: found a joint that is also one of `axes`"),
        ("hold: {swivel: 90, slide: 0}", "hold.swivel: found 90 deg; expected -57.3 to 57.3 deg"),
        ("hold: {swivel: 0, slide: 20}", "hold.slide: found 20 m; expected 0 to 0.05 m"),
    ],
)
def test_a_joint_is_an_axis_or_held(with_gripper: Path, hold: str, message: str) -> None:
    path = _spoil(with_gripper, "\naxes:", f"\n{hold}\naxes:")
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(path)


FOLLOWER = """
  <link name="behind"/>
  <joint name="rod" type="revolute"><origin xyz="0 0 0.1"/><parent link="link6"/><child link="behind"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/>
    <mimic joint="J5" multiplier="-1"/></joint>
</robot>"""  # noqa: E501


@pytest.mark.parametrize(
    ("limits", "written"),
    [
        ('lower="1" upper="-1"', "lower='1' and upper='-1'"),
        ('lower="-1" upper="nan"', "lower='-1' and upper='nan'"),
        ('lower="-1" upper="one"', "lower='-1' and upper='one'"),
        ('lower="1"', r"lower='1' and no upper \(0\)"),
    ],
    ids=["swapped", "not a number", "text", "one-sided"],
)
def test_limits_of_a_follower_that_contradict_themselves_are_refused(
    limits: str, written: str, configurations: Path
) -> None:
    """Without them, nothing kept a plan from moving the follower too far."""
    follower = FOLLOWER.replace('lower="-1" upper="1"', limits)
    _spoil(configurations / "robots/tx40.urdf", "</robot>", follower)
    with pytest.raises(
        ConfigurationInconsistent,
        match=f"joint rod, which mimics J5, with the limits {written}; expected numbers",
    ):
        load_cell(configurations / "cells/tx40.yaml")


def test_a_bound_that_is_left_out_is_zero_for_a_follower_and_a_held_joint(
    configurations: Path, with_gripper: Path
) -> None:
    """As URDF defines it. Any other joint has no limit then, as its exporter means."""
    urdf = configurations / "robots/tx40.urdf"
    one_sided = urdf.read_text().replace('lower="-1" upper="1"', 'lower="-1"')
    urdf.write_text(one_sided)
    joints = {joint.name: joint for joint in read_urdf(one_sided).joints}
    assert joints["swivel"].range is None
    follower = FOLLOWER.replace('lower="-1" upper="1"', 'lower="-1"')
    followed = read_urdf(one_sided.replace("</robot>", follower))
    rod = next(joint for joint in followed.joints if joint.name == "rod")
    assert rod.range == (-1.0, 0.0)
    path = _spoil(with_gripper, "\naxes:", "\nhold: {swivel: 10, slide: 0}\naxes:")
    with pytest.raises(ConfigurationInconsistent, match=r"found 10 deg; expected -57\.3 to 0 deg"):
        load_cell(path)


def test_a_joint_that_mimics_an_axis_follows_it(configurations: Path) -> None:
    path = configurations / "robots/tx40.urdf"
    _spoil(path, "</robot>", FOLLOWER)
    cell = load_cell(configurations / "cells/tx40.yaml")
    model = model_of(cell)
    assert cell.place_names == cell.axis_names
    expected = [joint.name for joint in model.robot.axes]
    names = [joint.name for joint in model.robot.places]
    assert names == expected
    assert joint_names(cell) == ("J1", "J2", "J3", "J4", "J5", "J6")
    (coupling,) = model.robot.couplings
    assert model.robot.joints[coupling.follower].name == "rod"
    assert model.robot.joints[coupling.leader].name == "J5"
    assert coupling.multiplier == -1.0


def test_a_body_on_a_joint_that_follows_may_be_named(configurations: Path) -> None:
    path = configurations / "robots/tx40.urdf"
    _spoil(path, "</robot>", FOLLOWER)
    capsule = "{name: rod, link: rod, from_m: [0, 0, 0], to_m: [0, 0, 0.1], radius_m: 0.02}"
    declared = f"\nclearance: {{capsules: [{capsule}]}}\naxes:"
    tx40_path = configurations / "cells/tx40.yaml"
    cell = load_cell(_spoil(tx40_path, "\naxes:", declared))
    assert cell.clearance is not None
    (body,) = cell.clearance.capsules
    assert body.name == "rod"
    assert body.link == 6


@pytest.mark.parametrize("logged", [False, True], ids=["a file", "a log"])
def test_a_joint_that_follows_an_axis_cannot_be_held(configurations: Path, logged: bool) -> None:
    path = configurations / "robots/tx40.urdf"
    _spoil(path, "</robot>", FOLLOWER)
    tx40_path = configurations / "cells/tx40.yaml"
    cell = _spoil(tx40_path, "\naxes:", "\nhold: {rod: 0.0}\naxes:")
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"joint '?rod'? mimics .*J5.* "
        r"\(multiplier -1\)",
    ) as refused:
        if logged:
            cell_from_bundle(bundle(cell))
        else:
            load_cell(cell)
    assert "no `hold` of it" in str(refused.value)
    assert "hold: {" not in str(refused.value)


@pytest.mark.parametrize(
    ("mimic", "advice"),
    [
        (
            '<mimic joint="swivel"/>',
            r"slide mimics swivel .*; expected `hold` of swivel if that is "
            r"no axis, and slide",
        ),
        (
            '<mimic joint="J6" multiplier="0"/>',
            "slide mimics J6 .*; expected `hold` of slide at its offset, 0 rad",
        ),
    ],
    ids=["of a gripper", "that never moves"],
)
def test_a_joint_that_follows_no_axis_is_held_with_its_leader(
    with_gripper: Path, mimic: str, advice: str
) -> None:
    slide = '<axis xyz="0 1 0"/><limit lower="0"'
    urdf = with_gripper.parent.parent / "robots/tx40.urdf"
    changed_text = urdf.read_text().replace(slide, mimic + slide)
    urdf.write_text(changed_text)
    with pytest.raises(ConfigurationInconsistent, match=advice):
        load_cell(with_gripper)
    follows = "swivel" in mimic
    if follows:
        hold = "hold: {swivel: 0.5}"
    else:
        hold = "hold: {swivel: 0.5, slide: 0.0}"
    path = _spoil(with_gripper, "\naxes:", f"\n{hold}\naxes:")
    cell = load_cell(path)
    assert model_of(cell).robot.joint_count == 6


def test_a_base_that_floats_is_held_to_be_an_arm(configurations: Path) -> None:
    world = (
        '<link name="w"/><joint name="f" type="floating"><parent link="w"/><child '
        'link="base"/></joint></robot>'
    )
    path = configurations / "robots/tx40.urdf"
    _spoil(path, "</robot>", world)
    cell = configurations / "cells/tx40.yaml"
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"'f' is of type 'floating'.*`hold: "
        r"\{JOINT: POSITION\}`",
    ):
        load_cell(cell)
    model = model_of(load_cell(_spoil(cell, "\naxes:", "\nhold: {f: 0.0}\naxes:")))
    assert model.robot.joint_count == 6


@pytest.mark.parametrize("text", ["<robot name='arm'>\n<link name='a'>", "no XML " * 2000])
def test_a_urdf_that_cannot_be_read_is_named_with_its_line_and_not_repeated(
    checkout: Path, tmp_path: Path, text: str
) -> None:
    folder = tmp_path / "configs"
    shutil.copytree(checkout / "configs", folder)
    cell = folder / "cells/demo.yaml"
    yaml = parse_yaml(cell.read_bytes(), "cell")
    name = yaml.tree["robot"]["urdf"]
    (cell.parent / name).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationInconsistent) as caught:
        load_cell(cell)
    assert f"{name}: the URDF cannot be read: " in caught.value.found
    assert "line " in caught.value.found
    assert len(str(caught.value)) < 1500
