"""`export mjcf` keeps what a URDF shows: names, frames, shapes and meshes;
with `--urdf` it needs no cell file.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from daq.cli.app import main
from ident.model.robot import poses
from tests.conftest import CHECKOUT
from tests.daq.robot_calibrations import CalibratedRobot, apart, calibrated_robot, robot_of
from tests.daq.workflow.test_export_mjcf import SAME, is_moving

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
ROBOTS = CHECKOUT / "configs/robots"
CELLS = CHECKOUT / "configs/cells"
CORNERS = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
SQUARE = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.1, 0.0), (0.0, 0.1, 0.0))
SQUARE_FACES = ((0, 1, 2), (0, 2, 3))
VISUAL_GROUP = 2
COLLISION_GROUP = 3


def stl_of(faces: Sequence[Sequence[int]], points: Sequence[Sequence[float]] = CORNERS) -> bytes:
    """A binary STL of triangles between points."""
    header = b" " * 80
    face_count = struct.pack("<I", len(faces))
    body = bytearray(header + face_count)
    vertices = np.array(points)
    normal = (0.0, 0.0, 0.0)
    for face in faces:
        corners = vertices[list(face)].ravel()
        body += struct.pack("<12fH", *normal, *corners, 0)
    return bytes(body)


def with_shapes(robot: str, shapes: dict[str, str], head: str = "") -> str:
    """The URDF of a shipped robot with shapes in some links."""
    urdf = (ROBOTS / f"{robot}.urdf").read_text()
    for link, text in shapes.items():
        tag = f'<link name="{link}">'
        assert urdf.count(tag) == 1
        urdf = urdf.replace(tag, tag + text)
    return urdf.replace("<link", head + "<link", 1)


def loaded(path: Path) -> Any:
    """Load a model from its file; MuJoCo warns of what it changes in it."""
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    finally:
        mujoco.set_mju_user_warning(None)
    assert warnings == []
    return model


def inverse_nm(simulated: Any, robot: CalibratedRobot) -> FloatArray:
    """Torque of each axis of a serial robot by MuJoCo's inverse dynamics, shape (m, k)."""
    data = mujoco.MjData(simulated)
    torques = []
    states = robot.states
    for state in range(len(states.position_rad)):
        data.qpos[:] = states.position_rad[state]
        data.qvel[:] = states.velocity_rad_s[state]
        data.qacc[:] = states.acceleration_rad_s2[state]
        mujoco.mj_inverse(simulated, data)
        torques.append(data.qfrc_inverse.copy())
    return np.array(torques).T


def missing_nm(report: dict[str, Any], robot: CalibratedRobot) -> FloatArray:
    """Torque that the document says the model lacks, shape (m, k)."""
    value_of = {entry["name"]: entry["value"] for entry in report["not_in_mjcf"]}
    values = [value_of.get(column.name, 0.0) for column in robot.model.columns]
    regressor = robot.model.regressor(robot.states)
    torque_nm = np.einsum("jck,c->jk", regressor, np.array(values))
    return np.asarray(torque_nm)


def check_torques(
    simulated: Any, report: dict[str, Any], robot: CalibratedRobot, use: NDArray[np.bool_]
) -> None:
    """MuJoCo's torques are the predicted ones in the states to use."""
    found_nm = inverse_nm(simulated, robot) + missing_nm(report, robot)
    predicted_nm = robot.predicted_nm()
    assert apart(found_nm[:, use], predicted_nm[:, use]) <= SAME


def export_code(*arguments: object) -> int:
    """Run the command; its exit code."""
    texts = [str(argument) for argument in arguments]
    return main(["export", "mjcf", *texts])


def export(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Run the command."""
    assert export_code(*arguments, "--json") == 0
    printed = capsys.readouterr().out
    report: dict[str, Any] = json.loads(printed)
    return report


SHAPES = {
    "link1": '<visual><geometry><box size="0.2 0.4 0.6"/></geometry><material '
    'name="grey"/></visual>',
    "link2": '<visual><origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><geometry><mesh '
    'filename="package://arm_description/meshes/link 2.stl" scale="2 2 -2"/></geometry></visual>',
    "link3": '<visual><geometry><mesh filename="../meshes/flat.STL"/></geometry></visual>'
    '<collision><geometry><cylinder radius="0.05" length="0.4"/></geometry></collision>',
    "link5": '<visual><geometry><sphere radius="0.07"/></geometry><material name="own"><color '
    'rgba="1 0 0 0.5"/></material></visual>',
}


@pytest.fixture
def urdf_of_arm(tmp_path: Path) -> Path:
    """The TX-40 in a package of ROS, with meshes."""
    package = tmp_path / "arm_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "meshes/link 2.stl").write_bytes(stl_of(FACES))
    (package / "meshes/flat.STL").write_bytes(stl_of(SQUARE_FACES, SQUARE))
    path = package / "urdf/tx40.urdf"
    head = '<material name="grey"><color rgba="0.25 0.5 0.75 1"/></material>'
    tool = (
        '<link name="tool"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>'
        '<joint name="mount" type="fixed"><origin xyz="0.1 0.02 0.3" rpy="0.4 -0.2 1.1"/>'
        '<parent link="link6"/><child link="tool"/></joint></robot>'
    )
    urdf = with_shapes("tx40", SHAPES, head)
    path.write_text(urdf.replace("</robot>", tool))
    return path


def test_a_urdf_alone_gives_the_predicted_torque_with_its_shapes(
    tmp_path: Path, urdf_of_arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Shapes touch nothing: torques are those of the model without them."""
    robot = uncoupled_arm(tmp_path)
    out = tmp_path / "models/robot.xml"
    out.parent.mkdir()
    calibration = robot.saved(tmp_path)

    report = export(capsys, calibration, "--urdf", urdf_of_arm, "--out", out)

    assert report["same_configuration"] is None
    assert report["shapes_left_out"] == []
    mesh_names = [Path(mesh).name for mesh in report["meshes"]]
    assert mesh_names == ["flat.STL", "link 2.stl"]
    simulated = loaded(out)
    # Stops of the URDF, which are narrower than those of the cell, push back.
    position_rad = robot.states.position_rad
    lower_rad, upper_rad = simulated.jnt_range.T
    is_inside = (position_rad > lower_rad) & (position_rad < upper_rad)
    moving = is_moving(robot) & is_inside.all(axis=1)
    assert moving.sum() >= 50
    check_torques(simulated, report, robot, moving)
    joints = [joint.name for joint in robot.model.robot.joints]
    simulated_joints = [simulated.joint(number).name for number in range(simulated.njnt)]
    assert simulated_joints == joints
    bodies = {simulated.body(number).name for number in range(1, simulated.nbody)}
    assert bodies == {"link1", "link2", "link3", "link4", "link5", "link6"}


def uncoupled_arm(folder: Path) -> CalibratedRobot:
    """The TX-40 with a motor for each joint."""
    coupled = "- [0, 0, 0, 0, 32, 32]"
    text = (CELLS / "tx40.yaml").read_text()
    assert text.count(coupled) == 1
    (folder / "cells").mkdir()
    (folder / "robots").mkdir()
    content = (ROBOTS / "tx40.urdf").read_bytes()
    (folder / "robots/tx40.urdf").write_bytes(content)
    cell = folder / "cells/tx40.yaml"
    uncoupled = text.replace(coupled, "- [0, 0, 0, 0, 0, 32]")
    cell.write_text(uncoupled)
    return calibrated_robot(cell)


def test_shapes_are_where_the_urdf_has_them(
    tmp_path: Path, urdf_of_arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = uncoupled_arm(tmp_path)
    out = tmp_path / "robot.xml"
    calibration = robot.saved(tmp_path)
    export(capsys, calibration, "--urdf", urdf_of_arm, "--out", out)
    simulated = loaded(out)
    data = mujoco.MjData(simulated)
    data.qpos[:] = robot.states.position_rad[3]
    mujoco.mj_kinematics(simulated, data)
    placed = poses(robot.model.robot, robot.states.position_rad[3:4])

    visuals: dict[str, Any] = {}
    collisions: dict[str, Any] = {}
    of_groups = {VISUAL_GROUP: visuals, COLLISION_GROUP: collisions}
    for geom in geoms_of(simulated):
        link = body_name(simulated, geom)
        of_group = of_groups[geom.group[0]]
        assert link not in of_group
        of_group[link] = geom
    assert set(visuals) == {"link1", "link2", "link3", "link5", "link6"}
    assert set(collisions) == {"link3"}
    assert not simulated.geom_contype.any()
    assert not simulated.geom_conaffinity.any()

    box = visuals["link1"]
    assert box.size == pytest.approx((0.1, 0.2, 0.3))
    assert box.rgba == pytest.approx((0.25, 0.5, 0.75, 1.0))
    cylinder = collisions["link3"]
    assert cylinder.size[:2] == pytest.approx((0.05, 0.2))
    sphere = visuals["link5"]
    assert sphere.rgba == pytest.approx((1.0, 0.0, 0.0, 0.5))

    # Corners of the mesh in the world: by the model, and by the URDF.
    geom = visuals["link2"]
    mesh = geom.dataid[0]
    first = simulated.mesh_vertadr[mesh]
    end = first + simulated.mesh_vertnum[mesh]
    vertices = simulated.mesh_vert[first:end]
    geom_rotation = data.geom_xmat[geom.id].reshape(3, 3)
    shown = data.geom_xpos[geom.id] + vertices @ geom_rotation.T
    corners = np.array(CORNERS) * (2.0, 2.0, -2.0)
    mesh_rotation = Rotation.from_euler("xyz", (0.4, -0.5, 0.6))
    mesh_origin_m = np.array((0.1, 0.2, 0.3))
    in_link = mesh_rotation.apply(corners) + mesh_origin_m
    link_rotation = placed.rotation[2, 0]
    in_world = placed.origin_m[2, 0] + in_link @ link_rotation.T
    for corner in in_world:
        distances_m = np.linalg.norm(shown - corner, axis=1)
        assert distances_m.min() < 1e-6

    # What is behind a fixed joint is in the frame of its own link.
    tool = visuals["link6"]
    flange_rotation = placed.rotation[6, 0]
    at_tool = placed.origin_m[6, 0] + flange_rotation @ (0.1, 0.02, 0.3)
    assert data.geom_xpos[tool.id] == pytest.approx(at_tool, abs=1e-12)
    tool_rotation = Rotation.from_euler("xyz", (0.4, -0.2, 1.1))
    turned = flange_rotation @ tool_rotation.as_matrix()
    found_rotation = data.geom_xmat[tool.id].reshape(3, 3)
    assert found_rotation == pytest.approx(turned, abs=1e-12)


def geoms_of(simulated: Any) -> list[Any]:
    """Shapes of a model."""
    return [simulated.geom(number) for number in range(simulated.ngeom)]


def body_name(simulated: Any, element: Any) -> Any:
    """The body of a shape or a site."""
    body = simulated.body(element.bodyid[0])
    return body.name


def test_limits_are_those_of_the_urdf(
    tmp_path: Path, urdf_of_arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A joint without limits has none in the model."""
    robot = uncoupled_arm(tmp_path)
    urdf = urdf_of_arm.read_text()
    first = urdf.index("<limit")
    end = urdf.index("/>", first) + 2
    limit = urdf[first:end]
    changed = urdf.replace(limit, '<limit lower="-1.25" upper="0.5" effort="9" velocity="9"/>', 1)
    last_limit = changed.rindex("<limit")
    last = changed.rindex("<joint", 0, last_limit)
    end = changed.index(">", last)
    head = changed[last:end]
    changed_head = head.replace("revolute", "continuous")
    changed = changed.replace(head, changed_head)
    urdf_of_arm.write_text(changed)
    out = tmp_path / "robot.xml"
    calibration = robot.saved(tmp_path)

    export(capsys, calibration, "--urdf", urdf_of_arm, "--out", out)

    simulated = loaded(out)
    first_joint = simulated.joint(0)
    assert first_joint.range == pytest.approx((-1.25, 0.5))
    assert simulated.jnt_limited.tolist() == [1, 1, 1, 1, 1, 0]


def test_the_shapes_of_a_cell_are_those_of_its_urdf(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A coupled wrist needs its cell file, and meshes are found from the folder of the URDF."""
    (tmp_path / "cells").mkdir()
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots/arm.stl").write_bytes(stl_of(FACES))
    mesh = '<visual><geometry><mesh filename="arm.stl"/></geometry></visual>'
    urdf = with_shapes("kr270", {"link3": mesh})
    (tmp_path / "robots/kr270.urdf").write_text(urdf)
    cell = tmp_path / "cells/kr270.yaml"
    cell.write_text((CELLS / "kr270.yaml").read_text())
    robot = calibrated_robot(cell)
    out = tmp_path / "robot.xml"
    calibration = robot.saved(tmp_path)

    report = export(capsys, cell, calibration, "--out", out)

    simulated = loaded(out)
    (geom,) = geoms_of(simulated)
    assert body_name(simulated, geom) == "link3"
    check_torques(simulated, report, robot, is_moving(robot))


def test_shapes_that_mujoco_cannot_read_are_listed_and_the_rest_is_written(
    tmp_path: Path, urdf_of_arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = uncoupled_arm(tmp_path)
    meshes = urdf_of_arm.parent.parent / "meshes"
    (meshes / "text.stl").write_text("solid arm\nendsolid arm\n")
    complete = stl_of(FACES)
    (meshes / "cut.stl").write_bytes(complete[:-7])
    (meshes / "none.stl").write_bytes(stl_of(()))
    (meshes / "arm.dae").write_text("<COLLADA/>")
    wrong = {
        '<mesh filename="../meshes/text.stl"/>': "no binary STL",
        '<mesh filename="../meshes/cut.stl"/>': "was cut",
        '<mesh filename="../meshes/none.stl"/>': "0 triangles",
        '<mesh filename="../meshes/arm.dae"/>': "arm.dae is no .stl",
        '<mesh filename="package://elsewhere/arm.stl"/>': "no file 'package://elsewhere/arm.stl'",
        '<mesh filename="../meshes/link 2.stl" scale="1 0 1"/>': "scale '1 0 1'",
        '<box size="1 2"/>': "size='1 2'",
        '<sphere radius="nan"/>': "radius='nan'",
        '<cylinder radius="0.1" length="-1"/>': "not positive",
        "<cone/>": "<cone>",
    }
    visuals = [f"<visual><geometry>{text}</geometry></visual>" for text in wrong]
    link = '<link name="link4">'
    with_visuals = link + "".join(visuals) + "<visual/>"
    urdf = urdf_of_arm.read_text().replace(link, with_visuals)
    urdf_of_arm.write_text(urdf)
    out = tmp_path / "robot.xml"
    file = robot.saved(tmp_path)

    report = export(capsys, file, "--urdf", urdf_of_arm, "--out", out)

    left_out = report["shapes_left_out"]
    reasons = [*wrong.values(), "0 geometries"]
    assert len(left_out) == len(reasons)
    for reason, expected in zip(left_out, reasons, strict=True):
        assert reason.startswith("visual of link4: ")
        assert expected in reason
    assert loaded(out).ngeom == 6
    assert "Shapes NOT in this model: visual of link4: " in out.read_text()
    assert export_code(file, "--urdf", urdf_of_arm, "--out", out) == 0
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    assert "Shapes that are not in the model: visual of link4: " in words


def test_a_urdf_of_another_robot_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("kr270")
    file = robot.saved(tmp_path)
    out = tmp_path / "robot.xml"
    seven_axis = ROBOTS / "seven-axis.urdf"
    assert export_code(file, "--out", out, "--urdf", seven_axis) == 6
    assert "7 moving joints: J1" in capsys.readouterr().err
    own = ROBOTS / "kr270.urdf"  # its wrist is coupled
    assert export_code(file, "--out", out, "--urdf", own) == 4
    bomb = tmp_path / "bomb.urdf"
    bomb.write_text('<!DOCTYPE robot [<!ENTITY a "b">]><robot name="r"/>')
    assert export_code(file, "--out", out, "--urdf", bomb) == 6
    assert export_code(robot.cell_file, file, "--out", out, "--urdf", own) == 2
    assert export_code(file, "--out", out) == 2
    assert not out.exists()


def test_a_frame_on_the_base_is_a_site_of_the_world(
    tmp_path: Path, urdf_of_arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = uncoupled_arm(tmp_path)
    out = tmp_path / "robot.xml"
    calibration = robot.saved(tmp_path)
    export(capsys, calibration, "--urdf", urdf_of_arm, "--out", out)
    simulated = loaded(out)
    base = simulated.site("base")
    assert base.bodyid[0] == 0
    tool = simulated.site("tool")
    assert body_name(simulated, tool) == "link6"
