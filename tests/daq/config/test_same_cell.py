"""A log, a calibration and a description are of one cell, or are refused;
a corrected description is named.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell import Cell, CellAxis
from daq.config.cell_file import bundle, load_cell
from daq.config.same_cell import (
    calibrated_robot,
    correction_of,
    differing_sections,
    differing_zeros,
    mismatch,
    mismatch_of_calibration,
    robot_differences,
)
from daq.documents.calibration_file import decode_calibration, encode_calibration, save_calibration
from daq.errors import ConfigurationInconsistent, ExitCode, LogsDiffer
from daq.log.conversion import load_run
from daq.workflow.experiment import PlannedMove
from daq.workflow.fit import LogLoader
from daq.workflow.plan import Plan, load_plan, save_plan
from daq.workflow.weigh import weigh_logs
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import DISC, demo_content, rising_counts, samples, write

ROWS = samples(rising_counts(60, 6))
EQUAL_ROWS = samples([[row] * 6 for row in range(60)])

Change = Callable[[str], str]
"""What changes the text of a cell file."""


@pytest.fixture
def demo_file(checkout: Path, tmp_path: Path) -> Path:
    """A copy of the demo cell's file, in a folder of its own."""
    return _copy(checkout, tmp_path, lambda text: text)


@pytest.fixture
def demo(checkout: Path) -> Cell:
    return load_cell(checkout / "configs/cells/demo.yaml")


@pytest.fixture
def log(checkout: Path, tmp_path: Path) -> Path:
    """A log of the demo cell, without load."""
    path = tmp_path / "bare.mcap"
    return write(path, demo_content(checkout), ROWS)


def _copy(checkout: Path, folder: Path, change: Change, name: str = "cell.yaml") -> Path:
    text = (checkout / "configs/cells/demo.yaml").read_text(encoding="utf-8")
    text = text.replace("../", f"{checkout}/configs/")
    path = folder / name
    path.write_text(change(text), encoding="utf-8")
    return path


def _replaced(old: str, new: str) -> Change:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def _calibration(cell: str) -> Calibration:
    """A calibration of a cell with these axes, with every setting of its filter."""
    conditioning = Conditioning(standstill_rad_s=(0.03,) * 6)
    settings = conditioning.document()
    return replace(demo_calibration(), cell=cell, filter=settings)


def _calibration_of(cell: Cell) -> Calibration:
    """A calibration of a cell with the name demo, which names its robot."""
    robot = calibrated_robot(cell)
    return replace(_calibration("demo"), robot=robot)


def _with_first_axis(cell: Cell, axis: CellAxis) -> Cell:
    _, *others = cell.axes
    return replace(cell, axes=(axis, *others))


def _with_identity(axis: CellAxis, **changes: int) -> CellAxis:
    """The axis of a drive with another serial number or vendor."""
    assert axis.identity is not None
    identity = replace(axis.identity, **changes)
    return replace(axis, identity=identity)


def _with_a_sliding_joint(cell: Cell) -> Cell:
    urdf = cell.urdf.replace('type="revolute"', 'type="prismatic"', 1)
    return replace(cell, urdf=urdf)


@dataclass(frozen=True)
class OtherCell:
    """A change that makes it another cell or robot, and what the message says of it."""

    change: Change
    message: str


ANOTHER_NAME = OtherCell(
    _replaced("name: demo", "name: press"),
    "a log of cell 'demo'; expected one of cell 'press'",
)
ANOTHER_AXIS = OtherCell(
    _replaced("name: J2", "name: A2"),
    "axes J1, J2, .*; expected J1, A2",
)
ANOTHER_NODE = OtherCell(
    _replaced("node_id: 3", "node_id: 33"),
    "drive of J3 with node id 3; expected drive of J3 with node id 33",
)
OTHERS = {
    "another name": ANOTHER_NAME,
    "another axis": ANOTHER_AXIS,
    "another node": ANOTHER_NODE,
}


@pytest.mark.parametrize("kind", OTHERS)
def test_another_cell_is_refused_with_what_shows_it(
    kind: str, checkout: Path, tmp_path: Path, log: Path
) -> None:
    case = OTHERS[kind]
    other = load_cell(_copy(checkout, tmp_path, case.change))
    message = f"{case.message}.*another robot's description gives wrong gains"
    with pytest.raises(LogsDiffer, match=message):
        load_run(log, other)


def test_a_log_of_exchanged_node_numbers_is_to_be_recorded_again(demo: Cell, log: Path) -> None:
    j1, j2, *others = demo.axes
    exchanged_j1 = replace(j1, node_id=j2.node_id)
    exchanged_j2 = replace(j2, node_id=j1.node_id)
    exchanged = replace(demo, axes=(exchanged_j1, exchanged_j2, *others))
    message = (
        "drive of J1 with node id 1; .*; expected drive of J1 with node id 2; "
        ".*record again with the corrected cell file"
    )
    with pytest.raises(LogsDiffer, match=message):
        load_run(log, exchanged)


@pytest.mark.parametrize("name", ["gantry", "dualv", "five-bar", "seven-axis"])
def test_a_robot_with_another_number_of_axes_is_another_one(
    name: str, checkout: Path, log: Path
) -> None:
    other = load_cell(checkout / f"configs/cells/{name}.yaml")
    with pytest.raises(LogsDiffer, match=f"a log of cell 'demo'; expected one of cell '{name}'"):
        load_run(log, other)


def test_a_robot_with_another_number_of_axes_and_the_same_name_is_another_one(
    checkout: Path, log: Path
) -> None:
    gantry = load_cell(checkout / "configs/cells/gantry.yaml")
    cell = replace(gantry, name="demo")
    with pytest.raises(LogsDiffer, match="axes J1, J2"):
        load_run(log, cell)


def test_a_correction_without_the_payload_of_the_log_is_refused(
    checkout: Path, tmp_path: Path
) -> None:
    content = demo_content(checkout, payload=DISC)
    loaded = write(tmp_path / "loaded.mcap", content, ROWS)
    other_payload = _replaced("name: disc", "name: cube")
    renamed = load_cell(_copy(checkout, tmp_path, other_payload))
    message = "payload disc on flange-a, which the given description does not have"
    with pytest.raises(LogsDiffer, match=message):
        load_run(loaded, renamed)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<joint name="J2"', '<joint name="elbow"'),
        ('type="revolute"', 'type="prismatic"'),
    ],
    ids=["name", "kind"],
)
def test_a_robot_with_other_joints_is_another_one(old: str, new: str, demo: Cell) -> None:
    assert old in demo.urdf
    urdf = demo.urdf.replace(old, new, 1)
    found = mismatch(demo, replace(demo, urdf=urdf))
    assert found is not None
    assert "as in the given description" in found.expected


def test_drives_of_other_serial_numbers_are_of_another_robot(
    checkout: Path, demo: Cell, tmp_path: Path
) -> None:
    """The drives of this log reported the serial number 7, and its description names none."""
    without_serials = partial(re.sub, r", serial: \d+", "")
    unnamed = _copy(checkout, tmp_path, without_serials)
    content = replace(demo_content(checkout), files=bundle(unnamed))
    log = write(tmp_path / "bare.mcap", content, ROWS)
    unnamed_cell = replace(demo, axes=load_cell(unnamed).axes)
    j1 = unnamed_cell.axes[0]
    cell_of_7 = _with_first_axis(unnamed_cell, _with_identity(j1, serial=7))
    cell_of_8 = _with_first_axis(unnamed_cell, _with_identity(j1, serial=8))

    load_run(log, cell_of_7)
    message = "serial number 7, reported by the drive of axis J1; expected 8"
    with pytest.raises(LogsDiffer, match=message):
        load_run(log, cell_of_8)
    found = mismatch(cell_of_7, cell_of_8)
    assert found is not None
    assert found.found == "serial number 7 of axis J1"


UPSIDE_DOWN = _replaced("gravity_m_s2: [0.0, 0.0, -9.81]", "gravity_m_s2: [0.0, 0.0, 9.81]")
HIGHER_GAIN = _replaced("nameplate_gain_nm_per_a: ", "nameplate_gain_nm_per_a: 1")
HEAVIER = _replaced("mass_kg: 4.59", "mass_kg: 4.60")
HIGHER_CUTOFF = _replaced("position_cutoff_hz: 40", "position_cutoff_hz: 41")


def _with_comment(text: str) -> str:
    return f"# later\n{text}"


@dataclass(frozen=True)
class Correction:
    """A change that is a correction, and the sections that then differ."""

    change: Change
    sections: tuple[str, ...]


CORRECTIONS = {
    "gravity": Correction(UPSIDE_DOWN, ("robot.gravity_m_s2",)),
    "nameplate": Correction(HIGHER_GAIN, ("axes.nameplate_gain (J1)",)),
    "mass": Correction(HEAVIER, ("payloads",)),
    "filter": Correction(HIGHER_CUTOFF, ("conditioning",)),
    "comment": Correction(_with_comment, ()),
}


@pytest.mark.parametrize("kind", CORRECTIONS)
def test_a_corrected_description_is_taken_and_recorded(
    kind: str, checkout: Path, demo: Cell, tmp_path: Path, log: Path
) -> None:
    correction = CORRECTIONS[kind]
    corrected = load_cell(_copy(checkout, tmp_path, correction.change))
    run, described = load_run(log, corrected)
    assert described is corrected
    assert run.recording is not None
    assert run.recording.corrected == correction.sections
    replaced_digest = demo.digest if correction.sections else None
    assert run.recording.replaced_configuration_sha256 == replaced_digest
    uncorrected, _ = load_run(log)
    assert uncorrected.recording is not None
    assert uncorrected.recording.replaced_configuration_sha256 is None


def test_geometry_ratio_and_zero_are_corrections(demo: Cell) -> None:
    j1, *others, j6 = demo.axes
    zeroed_j1 = replace(j1, zero_offset_rad=0.1)
    zeroed_j6 = replace(j6, zero_offset_rad=0.2)
    urdf = demo.urdf.replace("0.225", "0.2251")
    ratio = 2.0 * demo.ratio
    axes = (zeroed_j1, *others, zeroed_j6)
    corrected = replace(demo, urdf=urdf, ratio=ratio, axes=axes)
    assert corrected.urdf != demo.urdf
    assert mismatch(demo, corrected) is None
    assert differing_sections(demo, corrected) == (
        "robot.urdf",
        "drive_train.ratio",
        "axes.zero_offset (J1, J6)",
    )


def test_a_description_that_is_refused_now_can_be_corrected_by_one_of_its_name(
    demo_file: Path,
) -> None:
    files = bundle(demo_file)
    given = load_cell(demo_file)
    with_a_node_twice = files["cell.yaml"].replace(b"node_id: 3", b"node_id: 2")
    corrected = {**files, "cell.yaml": with_a_node_twice}
    correction = correction_of("a.mcap", corrected, given)
    assert correction is not None
    assert correction.sections == ("cell.yaml",)
    renamed = with_a_node_twice.replace(b"name: demo", b"name: press")
    of_press = {**files, "cell.yaml": renamed}
    with pytest.raises(LogsDiffer, match="a log of cell 'press'; expected one of cell 'demo'"):
        correction_of("a.mcap", of_press, given)


def test_a_correction_is_said_once_for_logs_that_share_a_description(
    checkout: Path, tmp_path: Path, log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = demo_content(checkout, DISC)
    loaded = write(tmp_path / "loaded.mcap", content, EQUAL_ROWS)
    corrected = load_cell(_copy(checkout, tmp_path, UPSIDE_DOWN))
    loader = LogLoader.of([log, loaded], corrected)
    list(loader.runs([log, loaded], "fit"))
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [
        f"{log}: the given description of the cell replaces the one in the log; they differ in "
        "robot.gravity_m_s2"
    ]
    sources = tuple(loader.sources)
    corrections = []
    for source in sources:
        assert source.recording is not None
        corrections.append(source.recording.corrected)
    assert corrections == [("robot.gravity_m_s2",), ("robot.gravity_m_s2",)]
    # As the calibration keeps it.
    calibration = replace(demo_calibration(), sources=sources)
    encoded = encode_calibration(calibration)
    decoded = decode_calibration(encoded, "calibration.yaml")
    assert decoded.sources == sources


def test_logs_of_two_descriptions_are_not_weighed_by_one_model(
    checkout: Path, tmp_path: Path, log: Path
) -> None:
    upside_down = _copy(checkout, tmp_path, UPSIDE_DOWN)
    content = replace(demo_content(checkout), files=bundle(upside_down))
    other = write(tmp_path / "other.mcap", content, EQUAL_ROWS)
    calibration = _calibration("demo")
    message = r"in robot\.gravity_m_s2; expected one description for all logs"
    with pytest.raises(LogsDiffer, match=message):
        weigh_logs(calibration, [log, other])
    with pytest.raises(LogsDiffer, match=message):
        weigh_logs(calibration, [log], bare=[other])


#: Commands by the exit code that they end with
VERBS_BY_CODE = {
    ExitCode.DATA_UNFIT: {
        "fit": "fit LOG LOG --cell CELL",
        "fit with fixed gains": "fit LOG --gains fixed --cell CELL",
        "fit of cases": "fit LOG LOG --cases out --cell CELL",
        "residual": "residual LOG LOG --cell CELL",
        "validate": "validate CALIBRATION LOG --cell CELL",
        "weigh": "weigh CALIBRATION LOG --cell CELL",
        "contact": "contact CALIBRATION LOG --cell CELL",
        "monitor": "monitor CELL --calibration DEMO --once",
    },
    ExitCode.CALIBRATION_REFUSED: {
        "certificate": "certificate DEMO --cell CELL",
        "apply": "apply CELL DEMO --configuration-changed",
    },
    ExitCode.CONFIGURATION: {
        "export urdf": "export urdf CELL DEMO --out out.urdf",
        "export mjcf": "export mjcf CELL DEMO --out out.xml",
        "export bag": "export bag LOG --calibration CALIBRATION --out bag",
    },
}


@dataclass(frozen=True)
class Command:
    """A command with words for its files, and the exit code that it ends with."""

    words: str
    code: ExitCode


def _commands(by_code: dict[ExitCode, dict[str, str]]) -> dict[str, Command]:
    commands = {}
    for code, words_of in by_code.items():
        for verb, words in words_of.items():
            commands[verb] = Command(words, code)
    return commands


VERBS = _commands(VERBS_BY_CODE)


def _run(command: Command, files: dict[str, Path]) -> int:
    """Run a command, with the path of each file for its word."""
    arguments = []
    for word in command.words.split():
        argument = files.get(word, word)
        arguments.append(str(argument))
    return main(arguments)


def _one_line(text: str) -> str:
    """A printed text without its line breaks."""
    return " ".join(text.split())


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_refuses_the_description_of_another_robot(
    verb: str,
    checkout: Path,
    tmp_path: Path,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The log is of cell demo; the description is of cell press, with the same axes;
    a calibration of each.
    """
    monkeypatch.chdir(tmp_path)
    press_calibration = tmp_path / "press-calibration.yaml"
    save_calibration(_calibration("press"), press_calibration)
    demo_calibration_file = tmp_path / "demo-calibration.yaml"
    save_calibration(_calibration("demo"), demo_calibration_file)
    files = {
        "LOG": log,
        "CELL": _copy(checkout, tmp_path, ANOTHER_NAME.change),
        "CALIBRATION": press_calibration,
        "DEMO": demo_calibration_file,
    }
    command = VERBS[verb]
    assert _run(command, files) == command.code
    error_output = _one_line(capsys.readouterr().err)
    assert "'demo'" in error_output
    assert "'press'" in error_output


ANOTHER_PRODUCT = OtherCell(
    lambda text: text.replace("product_code: 0x00040200", "product_code: 0x00040300"),
    "drive of J1 with product code",
)
NODE_33 = OtherCell(_replaced("node_id: 3", "node_id: 33"), "drive of J3 with node id")
#: Another robot of the same name, and the difference that is named
SAME_NAME = {"drive": ANOTHER_PRODUCT, "node": NODE_33}
OF_ANOTHER_ROBOT_BY_CODE = {
    ExitCode.DATA_UNFIT: {
        "validate": "validate CALIBRATION LOG",
        "export csv": "export csv CALIBRATION LOG --out out.csv",
        "console": "console CELL --calibration CALIBRATION",
        "weigh": "weigh CALIBRATION LOG",
        "contact": "contact CALIBRATION LOG",
        "monitor": "monitor CELL --calibration CALIBRATION --once",
        "history": "history CELL --add CALIBRATION",
    },
    ExitCode.CALIBRATION_REFUSED: {
        "certificate": "certificate CALIBRATION --cell CELL",
        "beside": "certificate OWN --beside CALIBRATION --cell CELL",
        "apply": "apply CELL CALIBRATION --configuration-changed",
    },
    ExitCode.CONFIGURATION: {
        "export urdf": "export urdf CELL CALIBRATION --out out.urdf",
        "export mjcf": "export mjcf CELL CALIBRATION --out out.xml",
        "export bag": "export bag LOG --calibration CALIBRATION --out bag",
    },
}
OF_ANOTHER_ROBOT = _commands(OF_ANOTHER_ROBOT_BY_CODE)


@pytest.mark.parametrize("different", SAME_NAME)
@pytest.mark.parametrize("verb", OF_ANOTHER_ROBOT)
def test_every_verb_refuses_a_calibration_of_another_robot_with_the_same_name(
    verb: str,
    different: str,
    checkout: Path,
    demo_file: Path,
    tmp_path: Path,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    case = SAME_NAME[different]
    other = load_cell(_copy(checkout, tmp_path, case.change, "other.yaml"))
    other_calibration = tmp_path / "other-calibration.yaml"
    save_calibration(_calibration_of(other), other_calibration)
    own_calibration = tmp_path / "own-calibration.yaml"
    save_calibration(_calibration_of(load_cell(demo_file)), own_calibration)
    files = {
        "LOG": log,
        "CELL": demo_file,
        "CALIBRATION": other_calibration,
        "OWN": own_calibration,
    }
    command = OF_ANOTHER_ROBOT[verb]
    assert _run(command, files) == command.code
    captured = capsys.readouterr()
    output = _one_line(captured.out + captured.err)
    assert "another robot with the cell name 'demo'" in output
    # The number is left out: on the page of `beside`, the calibration is the own one.
    assert case.message in output


def test_a_calibration_names_the_joint_in_which_its_robot_differs(demo: Cell) -> None:
    calibration = _calibration_of(demo)
    assert mismatch_of_calibration(calibration, demo) is None
    found = mismatch_of_calibration(calibration, _with_a_sliding_joint(demo))
    assert found is not None
    assert found.found == (
        "another robot with the cell name 'demo': joint J1 (prismatic, on the base)"
    )
    assert found.expected == "joint J1 (revolute, on the base), as in the calibration"


def test_what_a_description_corrects_or_leaves_open_makes_no_other_robot(demo: Cell) -> None:
    calibration = _calibration_of(demo)
    j1 = demo.axes[0]
    exchanged = _with_first_axis(demo, _with_identity(j1, serial=99))
    unnamed = _with_first_axis(demo, replace(j1, identity=None))
    zeroed = _with_first_axis(demo, replace(j1, zero_offset_rad=0.1))
    longer_urdf = demo.urdf.replace("0.225", "0.2251")
    lengthened = replace(demo, urdf=longer_urdf)
    for cell in (exchanged, unnamed, zeroed, lengthened):
        assert mismatch_of_calibration(calibration, cell) is None
    # Files of earlier versions do not name their robot.
    of_earlier_version = _calibration("demo")
    assert mismatch_of_calibration(of_earlier_version, unnamed) is None


def _without_vendors(cell: Cell) -> Cell:
    axes = tuple(replace(axis, identity=None) for axis in cell.axes)
    return replace(cell, axes=axes)


def _with_another_vendor(cell: Cell) -> Cell:
    j1 = cell.axes[0]
    assert j1.identity is not None
    vendor_id = j1.identity.vendor_id + 1
    return _with_first_axis(cell, _with_identity(j1, vendor_id=vendor_id))


def _with_another_parent(cell: Cell) -> Cell:
    """The last joint on the base, beside the arm."""
    first, *_, last = re.finditer(r'<parent link="([^"]+)"', cell.urdf)
    before = cell.urdf[: last.start(1)]
    after = cell.urdf[last.end(1) :]
    root = first[1]
    return replace(cell, urdf=before + root + after)


def _plan_of(cell: Cell) -> Plan:
    home = (0.0,) * 6
    move = PlannedMove(home, velocity=0.1, acceleration=0.1, dwell_s=0.1)
    units = tuple(axis.unit for axis in cell.axes)
    return Plan(
        cell="demo",
        seed=1,
        condition=1.0,
        predicted_std_percent=(),
        duration_s=1.0,
        moves=(move,),
        units=units,
        robot=calibrated_robot(cell),
    )


def _refused_documents(made_with: Cell, used_with: Cell, plan_file: Path) -> list[str]:
    """Documents of one cell that another one refuses."""
    refused = []
    if mismatch(made_with, used_with) is not None:
        refused.append("log")
    calibration = _calibration_of(made_with)
    if mismatch_of_calibration(calibration, used_with) is not None:
        refused.append("calibration")
    plan = _plan_of(made_with)
    save_plan(plan, plan_file)
    try:
        read = load_plan(plan_file, used_with)
    except ConfigurationInconsistent as error:
        assert error.subject == f"{plan_file}: robot"
        refused.append("plan")
    else:
        assert read.robot == plan.robot
    return refused


@pytest.mark.parametrize(
    ("change", "same"),
    [
        (_without_vendors, True),
        (_with_another_vendor, False),
        (_with_a_sliding_joint, False),
        (_with_another_parent, False),
    ],
)
def test_logs_plans_and_calibrations_agree_on_what_one_robot_is(
    change: Callable[[Cell], Cell], same: bool, demo: Cell, tmp_path: Path
) -> None:
    plan_file = tmp_path / "plan.yaml"
    changed = change(demo)
    expected = [] if same else ["log", "calibration", "plan"]
    assert _refused_documents(demo, changed, plan_file) == expected
    assert _refused_documents(changed, demo, plan_file) == expected


def test_a_robot_with_fewer_axes_is_named_by_its_axes(demo: Cell) -> None:
    robot = calibrated_robot(demo)
    of_two_axes = replace(robot, drives=robot.drives[:2])
    (difference,) = robot_differences(of_two_axes, robot)
    assert difference.found == "axes J1, J2"
    assert difference.expected == "axes J1, J2, J3, J4, J5, J6"


def test_a_calibration_keeps_the_robot_that_it_is_of(demo: Cell) -> None:
    robot = calibrated_robot(demo)
    content = encode_calibration(_calibration_of(demo))
    decoded = decode_calibration(content, "calibration.yaml")
    assert decoded.robot == robot
    section = f"robot:\n  kinematics_sha256: {robot.kinematics_sha256}"
    assert section.encode() in content


def test_the_axes_whose_zeros_differ_are_found_among_the_sections(
    checkout: Path, demo_file: Path, tmp_path: Path
) -> None:
    def change_two_zeros(text: str) -> str:
        return text.replace("zero_offset_deg: 0.0", "zero_offset_deg: 2.0", 2)

    other_file = _copy(checkout, tmp_path, change_two_zeros, "o.yaml")
    sections = differing_sections(load_cell(demo_file), load_cell(other_file))
    assert differing_zeros(sections) == ("J1", "J2")
    assert differing_zeros(("axes.limits (J1)", "robot.gravity_m_s2")) == ()
