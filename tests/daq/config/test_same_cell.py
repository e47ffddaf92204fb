"""A log, a calibration and a description are of one cell, or are refused;
a corrected description is named.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell import Cell
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
from ident.calibration import Calibration, Source
from ident.data.conditioning import Conditioning
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import DISC, demo_content, rising_counts, samples, write

ROWS = samples(rising_counts(60, 6))


@pytest.fixture
def demo(checkout: Path, tmp_path: Path) -> Path:
    """A copy of the demo cell's file, in a folder of its own."""
    return _copy(checkout, tmp_path, lambda text: text)


@pytest.fixture
def log(checkout: Path, tmp_path: Path) -> Path:
    """A log of the demo cell, without load."""
    path = tmp_path / "bare.mcap"
    return write(path, demo_content(checkout), ROWS)


def _copy(
    checkout: Path, folder: Path, change: Callable[[str], str], name: str = "cell.yaml"
) -> Path:
    text = (checkout / "configs/cells/demo.yaml").read_text(encoding="utf-8")
    changed_text = text.replace("../", f"{checkout}/configs/")
    changed = change(changed_text)
    path = folder / name
    path.write_text(changed, encoding="utf-8")
    return path


def _replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def _calibration(cell: str) -> Calibration:
    """A calibration of a cell with these axes, with every setting of its filter."""
    standstill_rad_s = (0.03,) * 6
    document = Conditioning(standstill_rad_s=standstill_rad_s).document()
    return replace(demo_calibration(), cell=cell, filter=document)


OTHERS: dict[str, tuple[Callable[[str], str], str]] = {
    "another name": (
        _replaced("name: demo", "name: press"),
        "a log of cell 'demo'; expected one of cell 'press'",
    ),
    "another axis": (_replaced("name: J2", "name: A2"), "axes J1, J2, .*; expected J1, A2"),
    "another node": (
        _replaced("node_id: 3", "node_id: 33"),
        "drive of J3 with node id 3; expected drive of J3 with node id 33",
    ),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_another_cell_is_refused_with_what_shows_it(
    kind: str, checkout: Path, tmp_path: Path, log: Path
) -> None:
    change, message = OTHERS[kind]
    path = _copy(checkout, tmp_path, change)
    other = load_cell(path)
    with pytest.raises(
        LogsDiffer, match=f"{message}.*another robot's description gives wrong gains"
    ):
        load_run(log, other)


def test_a_log_of_exchanged_node_numbers_is_to_be_recorded_again(checkout: Path, log: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    first, second, *others = cell.axes
    exchanged = (
        replace(first, node_id=second.node_id),
        replace(second, node_id=first.node_id),
        *others,
    )
    changed_cell = replace(cell, axes=exchanged)
    with pytest.raises(
        LogsDiffer,
        match=r"drive of J1 with node id 1; .*; expected drive of J1 with node id 2; .*record "
        r"again with the corrected "
        r"cell file",
    ):
        load_run(log, changed_cell)


@pytest.mark.parametrize("name", ["gantry", "dualv", "five-bar", "seven-axis"])
def test_a_robot_with_another_number_of_axes_is_another_one(
    name: str, checkout: Path, log: Path
) -> None:
    path = checkout / f"configs/cells/{name}.yaml"
    with pytest.raises(LogsDiffer, match=f"a log of cell 'demo'; expected one of cell '{name}'"):
        load_run(log, load_cell(path))


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
    path = tmp_path / "loaded.mcap"
    loaded = write(path, demo_content(checkout, payload=DISC), ROWS)
    renamed = load_cell(_copy(checkout, tmp_path, _replaced("name: disc", "name: cube")))
    with pytest.raises(
        LogsDiffer, match="payload disc on flange-a, which the given description does not have"
    ):
        load_run(loaded, renamed)


def test_a_robot_with_other_joints_is_another_one(checkout: Path) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    for old, new in (
        ('<joint name="J2"', '<joint name="elbow"'),
        ('type="revolute"', 'type="prismatic"'),
    ):
        assert old in demo.urdf
        urdf = demo.urdf.replace(old, new, 1)
        found = mismatch(demo, replace(demo, urdf=urdf))
        assert found is not None
        assert "as in the given description" in found.expected


def test_drives_of_other_serial_numbers_are_of_another_robot(
    checkout: Path, tmp_path: Path
) -> None:
    """The drives of this log reported the serial number 7, and its description names none."""
    unnamed = _copy(checkout, tmp_path, lambda text: re.sub(r", serial: \d+", "", text))
    content = replace(demo_content(checkout), files=bundle(unnamed))
    path = tmp_path / "bare.mcap"
    log = write(path, content, ROWS)
    declared = load_cell(checkout / "configs/cells/demo.yaml")

    def with_serial(serial: int) -> Cell:
        axes = load_cell(unnamed).axes
        assert axes[0].identity is not None
        identity = replace(axes[0].identity, serial=serial)
        changed_axis = replace(axes[0], identity=identity)
        return replace(declared, axes=(changed_axis, *axes[1:]))

    load_run(log, with_serial(7))
    with pytest.raises(
        LogsDiffer, match="serial number 7, reported by the drive of axis J1; expected 8"
    ):
        load_run(log, with_serial(8))
    found = mismatch(with_serial(7), with_serial(8))
    assert found is not None
    assert found.found == "serial number 7 of axis J1"


UPSIDE_DOWN = _replaced("gravity_m_s2: [0.0, 0.0, -9.81]", "gravity_m_s2: [0.0, 0.0, 9.81]")
CORRECTIONS: dict[str, tuple[Callable[[str], str], tuple[str, ...]]] = {
    "gravity": (UPSIDE_DOWN, ("robot.gravity_m_s2",)),
    "nameplate": (
        _replaced("nameplate_gain_nm_per_a: ", "nameplate_gain_nm_per_a: 1"),
        ("axes.nameplate_gain (J1)",),
    ),
    "mass": (_replaced("mass_kg: 4.59", "mass_kg: 4.60"), ("payloads",)),
    "filter": (_replaced("position_cutoff_hz: 40", "position_cutoff_hz: 41"), ("conditioning",)),
    "comment": (lambda text: f"# later\n{text}", ()),
}


@pytest.mark.parametrize("kind", CORRECTIONS)
def test_a_corrected_description_is_taken_and_recorded(
    kind: str, checkout: Path, tmp_path: Path, log: Path
) -> None:
    change, sections = CORRECTIONS[kind]
    path = _copy(checkout, tmp_path, change)
    corrected = load_cell(path)
    run, described = load_run(log, corrected)
    assert described is corrected
    assert run.recording is not None
    assert run.recording.corrected == sections
    own = load_cell(checkout / "configs/cells/demo.yaml")
    assert run.recording.replaced_configuration_sha256 == (own.digest if sections else None)
    plain, _ = load_run(log)
    assert plain.recording is not None
    assert plain.recording.replaced_configuration_sha256 is None


def test_geometry_ratio_and_zero_are_corrections(checkout: Path) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    changed_axis = replace(demo.axes[-1], zero_offset_rad=0.2)
    axes = (
        replace(demo.axes[0], zero_offset_rad=0.1),
        *demo.axes[1:-1],
        changed_axis,
    )
    urdf = demo.urdf.replace("0.225", "0.2251")
    ratio = 2.0 * demo.ratio
    mended = replace(demo, urdf=urdf, ratio=ratio, axes=axes)
    assert mended.urdf != demo.urdf
    assert mismatch(demo, mended) is None
    assert differing_sections(demo, mended) == (
        "robot.urdf",
        "drive_train.ratio",
        "axes.zero_offset (J1, J6)",
    )


def test_a_description_that_is_refused_now_can_be_corrected_by_one_of_its_name(
    checkout: Path, demo: Path
) -> None:
    files = bundle(demo)
    given = load_cell(demo)
    changed_cell_yaml = files["cell.yaml"].replace(b"node_id: 3", b"node_id: 2")
    broken = {**files, "cell.yaml": changed_cell_yaml}
    correction = correction_of("a.mcap", broken, given)
    assert correction is not None
    assert correction.sections == ("cell.yaml",)
    other = {**broken, "cell.yaml": broken["cell.yaml"].replace(b"name: demo", b"name: press")}
    with pytest.raises(LogsDiffer, match="a log of cell 'press'; expected one of cell 'demo'"):
        correction_of("a.mcap", other, given)


def test_a_correction_is_said_once_for_logs_that_share_a_description(
    checkout: Path, tmp_path: Path, log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "loaded.mcap"
    loaded = write(
        path,
        demo_content(checkout, DISC),
        samples([[k] * 6 for k in range(60)]),
    )
    corrected = load_cell(_copy(checkout, tmp_path, UPSIDE_DOWN))
    reading = LogLoader.of([log, loaded], corrected)
    list(reading.runs([log, loaded], "fit"))
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [
        f"{log}: the given description of the cell replaces the one in the log; they differ in "
        "robot.gravity_m_s2"
    ]
    found = [
        source.recording.corrected for source in reading.sources if source.recording is not None
    ]
    expected = [("robot.gravity_m_s2",)] * 2
    assert found == expected
    # As the calibration keeps it.
    calibration = replace(demo_calibration(), sources=tuple(reading.sources))
    again: tuple[Source, ...] = decode_calibration(
        encode_calibration(calibration), "calibration.yaml"
    ).sources
    assert again == tuple(reading.sources)


def test_logs_of_two_descriptions_are_not_weighed_by_one_model(
    checkout: Path, tmp_path: Path, log: Path
) -> None:
    content = replace(demo_content(checkout), files=bundle(_copy(checkout, tmp_path, UPSIDE_DOWN)))
    rows = [[k] * 6 for k in range(60)]
    path = tmp_path / "other.mcap"
    other = write(path, content, samples(rows))
    calibration = _calibration("demo")
    with pytest.raises(
        LogsDiffer,
        match=r"in robot\.gravity_m_s2; expected one description "
        r"for all logs",
    ):
        weigh_logs(calibration, [log, other])
    with pytest.raises(
        LogsDiffer,
        match=r"in robot\.gravity_m_s2; expected one description "
        r"for all logs",
    ):
        weigh_logs(calibration, [log], bare=[other])


VERBS: dict[str, tuple[list[str], ExitCode]] = {
    "fit": (["fit", "LOG", "LOG", "--cell", "CELL"], ExitCode.DATA_UNFIT),
    "fit with fixed gains": (
        ["fit", "LOG", "--gains", "fixed", "--cell", "CELL"],
        ExitCode.DATA_UNFIT,
    ),
    "fit of cases": (
        ["fit", "LOG", "LOG", "--cases", "out", "--cell", "CELL"],
        ExitCode.DATA_UNFIT,
    ),
    "residual": (["residual", "LOG", "LOG", "--cell", "CELL"], ExitCode.DATA_UNFIT),
    "validate": (["validate", "CALIBRATION", "LOG", "--cell", "CELL"], ExitCode.DATA_UNFIT),
    "weigh": (["weigh", "CALIBRATION", "LOG", "--cell", "CELL"], ExitCode.DATA_UNFIT),
    "contact": (["contact", "CALIBRATION", "LOG", "--cell", "CELL"], ExitCode.DATA_UNFIT),
    "certificate": (["certificate", "DEMO", "--cell", "CELL"], ExitCode.CALIBRATION_REFUSED),
    "export urdf": (
        ["export", "urdf", "CELL", "DEMO", "--out", "out.urdf"],
        ExitCode.CONFIGURATION,
    ),
    "export mjcf": (["export", "mjcf", "CELL", "DEMO", "--out", "out.xml"], ExitCode.CONFIGURATION),
    "export bag": (
        ["export", "bag", "LOG", "--calibration", "CALIBRATION", "--out", "bag"],
        ExitCode.CONFIGURATION,
    ),
    "monitor": (["monitor", "CELL", "--calibration", "DEMO", "--once"], ExitCode.DATA_UNFIT),
    "apply": (["apply", "CELL", "DEMO", "--configuration-changed"], ExitCode.CALIBRATION_REFUSED),
}


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
    cell = _copy(checkout, tmp_path, OTHERS["another name"][0])
    calibration = tmp_path / "press-calibration.yaml"
    save_calibration(_calibration("press"), calibration)
    of_demo = tmp_path / "demo-calibration.yaml"
    save_calibration(_calibration("demo"), of_demo)
    files = {
        "LOG": str(log),
        "CELL": str(cell),
        "CALIBRATION": str(calibration),
        "DEMO": str(of_demo),
    }
    arguments, code = VERBS[verb]
    assert main([files.get(word, word) for word in arguments]) == code
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "'demo'" in said
    assert "'press'" in said


SAME_NAME: dict[str, tuple[Callable[[str], str], str]] = {
    "drive": (
        lambda text: text.replace("product_code: 0x00040200", "product_code: 0x00040300"),
        "drive of J1 with product code 0x40200",
    ),
    "node": (_replaced("node_id: 3", "node_id: 33"), "drive of J3 with node id 3"),
}
OF_ANOTHER_ROBOT: dict[str, tuple[list[str], ExitCode]] = {
    "validate": (["validate", "CALIBRATION", "LOG"], ExitCode.DATA_UNFIT),
    "export csv": (
        ["export", "csv", "CALIBRATION", "LOG", "--out", "out.csv"],
        ExitCode.DATA_UNFIT,
    ),
    "console": (["console", "CELL", "--calibration", "CALIBRATION"], ExitCode.DATA_UNFIT),
    "weigh": (["weigh", "CALIBRATION", "LOG"], ExitCode.DATA_UNFIT),
    "contact": (["contact", "CALIBRATION", "LOG"], ExitCode.DATA_UNFIT),
    "certificate": (["certificate", "CALIBRATION", "--cell", "CELL"], ExitCode.CALIBRATION_REFUSED),
    "beside": (
        ["certificate", "OWN", "--beside", "CALIBRATION", "--cell", "CELL"],
        ExitCode.CALIBRATION_REFUSED,
    ),
    "export urdf": (
        ["export", "urdf", "CELL", "CALIBRATION", "--out", "out.urdf"],
        ExitCode.CONFIGURATION,
    ),
    "export mjcf": (
        ["export", "mjcf", "CELL", "CALIBRATION", "--out", "out.xml"],
        ExitCode.CONFIGURATION,
    ),
    "export bag": (
        ["export", "bag", "LOG", "--calibration", "CALIBRATION", "--out", "bag"],
        ExitCode.CONFIGURATION,
    ),
    "monitor": (["monitor", "CELL", "--calibration", "CALIBRATION", "--once"], ExitCode.DATA_UNFIT),
    "apply": (
        ["apply", "CELL", "CALIBRATION", "--configuration-changed"],
        ExitCode.CALIBRATION_REFUSED,
    ),
    "history": (["history", "CELL", "--add", "CALIBRATION"], ExitCode.DATA_UNFIT),
}


@pytest.mark.parametrize("different", SAME_NAME)
@pytest.mark.parametrize("verb", OF_ANOTHER_ROBOT)
def test_every_verb_refuses_a_calibration_of_another_robot_with_the_same_name(
    verb: str,
    different: str,
    checkout: Path,
    tmp_path: Path,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    change, said = SAME_NAME[different]
    own = _copy(checkout, tmp_path, lambda text: text)
    path = _copy(checkout, tmp_path, change, "other.yaml")
    other = load_cell(path)
    of_other = tmp_path / "other-calibration.yaml"
    calibration = replace(_calibration("demo"), robot=calibrated_robot(other))
    save_calibration(calibration, of_other)
    of_own = tmp_path / "own-calibration.yaml"
    save_calibration(replace(_calibration("demo"), robot=calibrated_robot(load_cell(own))), of_own)
    files = {"LOG": str(log), "CELL": str(own), "CALIBRATION": str(of_other), "OWN": str(of_own)}
    arguments, code = OF_ANOTHER_ROBOT[verb]
    assert main([files.get(word, word) for word in arguments]) == code
    captured = capsys.readouterr()
    text = " ".join((captured.out + captured.err).split())
    assert "another robot with the cell name 'demo'" in text
    # On the page of `beside`, the calibration is the own one.
    assert said.rsplit(" ", 1)[0] in text


def test_a_calibration_names_the_joint_in_which_its_robot_differs(checkout: Path) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    calibration = replace(_calibration("demo"), robot=calibrated_robot(demo))
    assert mismatch_of_calibration(calibration, demo) is None
    urdf = demo.urdf.replace('type="revolute"', 'type="prismatic"', 1)
    sliding = replace(demo, urdf=urdf)
    found = mismatch_of_calibration(calibration, sliding)
    assert found is not None
    assert found.found == (
        "another robot with the cell name 'demo': joint J1 (prismatic, on the base)"
    )
    assert found.expected == "joint J1 (revolute, on the base), as in the calibration"


def test_what_a_description_corrects_or_leaves_open_makes_no_other_robot(checkout: Path) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    calibration = replace(_calibration("demo"), robot=calibrated_robot(demo))
    first = demo.axes[0]
    assert first.identity is not None
    identity = replace(first.identity, serial=99)
    exchanged = replace(first, identity=identity)
    unnamed = replace(first, identity=None)
    for axis in (exchanged, unnamed, replace(first, zero_offset_rad=0.1)):
        axes = (axis, *demo.axes[1:])
        cell = replace(demo, axes=axes)
        assert mismatch_of_calibration(calibration, cell) is None
    urdf = demo.urdf.replace("0.225", "0.2251")
    lengthened = replace(demo, urdf=urdf)
    assert mismatch_of_calibration(calibration, lengthened) is None
    # Files of earlier versions do not name their robot.
    assert (
        mismatch_of_calibration(_calibration("demo"), replace(demo, axes=(unnamed, *demo.axes[1:])))
        is None
    )


def _without_vendors(cell: Cell) -> Cell:
    axes = tuple(replace(axis, identity=None) for axis in cell.axes)
    return replace(cell, axes=axes)


def _with_another_vendor(cell: Cell) -> Cell:
    first = cell.axes[0]
    assert first.identity is not None
    vendor_id = first.identity.vendor_id + 1
    identity = replace(first.identity, vendor_id=vendor_id)
    axes = (replace(first, identity=identity), *cell.axes[1:])
    return replace(cell, axes=axes)


def _with_a_sliding_joint(cell: Cell) -> Cell:
    urdf = cell.urdf.replace('type="revolute"', 'type="prismatic"', 1)
    return replace(cell, urdf=urdf)


def _with_another_parent(cell: Cell) -> Cell:
    """The last joint on the base, beside the arm."""
    root = re.search(r'<parent link="([^"]+)"', cell.urdf)
    last = list(re.finditer(r'<parent link="([^"]+)"', cell.urdf))[-1]
    assert root is not None
    urdf = cell.urdf[: last.start(1)] + root[1] + cell.urdf[last.end(1) :]
    return replace(cell, urdf=urdf)


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
    change: Callable[[Cell], Cell], same: bool, checkout: Path, tmp_path: Path
) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    for made_with, used_with in ((demo, change(demo)), (change(demo), demo)):
        calibration = replace(_calibration("demo"), robot=calibrated_robot(made_with))
        plan_file = tmp_path / "plan.yaml"
        target_rad = (0.0,) * 6
        move = PlannedMove(target_rad, velocity=0.1, acceleration=0.1, dwell_s=0.1)
        units = tuple(axis.unit for axis in demo.axes)
        made = Plan(
            cell="demo",
            seed=1,
            condition=1.0,
            predicted_std_percent=(),
            duration_s=1.0,
            moves=(move,),
            units=units,
            robot=calibrated_robot(made_with),
        )
        save_plan(made, plan_file)
        refused = []
        if mismatch(made_with, used_with) is not None:
            refused.append("log")
        if mismatch_of_calibration(calibration, used_with) is not None:
            refused.append("calibration")
        try:
            read = load_plan(plan_file, used_with)
        except ConfigurationInconsistent as error:
            assert error.subject == f"{plan_file}: robot"
            refused.append("plan")
        else:
            assert read.robot == made.robot
        assert refused == ([] if same else ["log", "calibration", "plan"])


def test_a_robot_with_fewer_axes_is_named_by_its_axes(checkout: Path) -> None:
    path = checkout / "configs/cells/demo.yaml"
    robot = calibrated_robot(load_cell(path))
    changed_robot = replace(robot, drives=robot.drives[:2])
    (difference,) = robot_differences(changed_robot, robot)
    assert difference.found == "axes J1, J2"
    assert difference.expected == "axes J1, J2, J3, J4, J5, J6"


def test_a_calibration_keeps_the_robot_that_it_is_of(checkout: Path) -> None:
    demo = load_cell(checkout / "configs/cells/demo.yaml")
    robot = calibrated_robot(demo)
    calibration = replace(_calibration("demo"), robot=robot)
    content = encode_calibration(calibration)
    assert decode_calibration(content, "calibration.yaml").robot == robot
    assert f"robot:\n  kinematics_sha256: {robot.kinematics_sha256}".encode() in content


def test_the_axes_whose_zeros_differ_are_found_among_the_sections(
    checkout: Path, demo: Path, tmp_path: Path
) -> None:
    other = _copy(
        checkout,
        tmp_path,
        lambda text: text.replace("zero_offset_deg: 0.0", "zero_offset_deg: 2.0", 2),
        "o.yaml",
    )
    sections = differing_sections(load_cell(demo), load_cell(other))
    assert differing_zeros(sections) == ("J1", "J2")
    assert differing_zeros(("axes.limits (J1)", "robot.gravity_m_s2")) == ()
