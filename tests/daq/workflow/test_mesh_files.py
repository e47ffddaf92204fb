"""Meshes that MuJoCo reads, and those for which it refuses a whole model:
the same verdict as MuJoCo itself.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest

from daq.workflow.mesh_files import ShapeUnreadable, check_mesh

# A tetrahedron: as text for OBJ, as arrays for STL and MSH.
CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
TETRAHEDRON = CORNERS + FACES
POINTS = np.vstack((np.zeros(3), np.eye(3)))
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
OTHER_BODY = "v 5 5 5\nv 6 5 5\nv 5 6 5\nv 5 5 6\nf 5 7 6\nf 5 6 8\nf 5 8 7\nf 6 7 8\n"
FULL_SIZE = (1.0, 1.0, 1.0)


def stl(points: np.ndarray, triangles: np.ndarray = TRIANGLES) -> bytes:
    """A binary STL."""
    title = bytes(80)
    count = struct.pack("<I", len(triangles))
    facets = [facet(points[triangle]) for triangle in triangles]
    return b"".join((title, count, *facets))


def facet(corners: np.ndarray) -> bytes:
    """A triangle of a binary STL: its normal, its three corners and a number without a meaning."""
    normal = (0, 0, 1)
    return struct.pack("<12fH", *normal, *corners.ravel(), 0)


def msh(points: np.ndarray, triangles: np.ndarray = TRIANGLES, normals: int = 0) -> bytes:
    """A mesh of MuJoCo."""
    texture_points = 0
    counts = struct.pack("<4i", len(points), normals, texture_points, len(triangles))
    point_bytes = np.asarray(points, "<f4").tobytes()
    normal_bytes = np.ones((normals, 3), "<f4").tobytes()
    triangle_bytes = np.asarray(triangles, "<i4").tobytes()
    return counts + point_bytes + normal_bytes + triangle_bytes


def moved(place: int, value: float) -> np.ndarray:
    """The points with another first coordinate of one of them."""
    points = POINTS.copy()
    points[place, 0] = value
    return points


def written(path: Path, content: str | bytes) -> Path:
    """The path, with the content in its file."""
    if isinstance(content, str):
        content = content.encode()
    path.write_bytes(content)
    return path


def faces_in_mujoco(path: Path, scale: tuple[float, ...] = FULL_SIZE) -> int:
    """Number of triangles that MuJoCo has of a mesh.

    Raises:
        ValueError: it refuses the model.
    """
    scales = " ".join(map(str, scale))
    text = (
        f'<mujoco><asset><mesh name="m" file="{path}" inertia="shell" scale="{scales}"/></asset>'
        '<worldbody><geom type="mesh" mesh="m" contype="0" conaffinity="0" mass="0"/></worldbody>'
        "</mujoco>"
    )
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        model = mujoco.MjModel.from_xml_string(text)
    finally:
        mujoco.set_mju_user_warning(None)
    return int(model.nmeshface)


@dataclass(frozen=True)
class Mesh:
    """A file that MuJoCo reads, and the number of its triangles."""

    content: str | bytes
    triangles: int


@dataclass(frozen=True)
class RefusedMesh:
    """A file that MuJoCo refuses, and the reason that is given."""

    content: str | bytes
    reason: str


WINDOWS_LINES = TETRAHEDRON.replace("\n", "\r\n")
COLOURED_CORNERS = CORNERS.replace("\n", " 1 0 0\n")
CORNERS_AND_NORMAL = CORNERS + "vn 0 0 1\n"
FACES_FROM_THE_END = "f -4 -2 -3\nf -4 -3 -1\nf -4 -1 -2\nf -3 -2 -1\n"
QUAD_AND_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\nf 1 2 5\n"
NAMED_PARTS = "mtllib a.mtl\no arm\n" + CORNERS + "usemtl a\ns off\n" + FACES
WITH_TEXTURE = CORNERS + "vt 0 0\nvn 0 0 1\nf 1/1/1 3/1/1 2/1/1\nf 1/1/1 2/1/1 4/1/1\n"
FLAT_CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
CORNERS_ON_A_LINE = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 3 0 0\n"
FACE_WITH_NORMAL = "f 1//1 3//1 2//1\n"
STL = stl(POINTS)
MSH = msh(POINTS)
POINTS_ON_A_LINE = np.outer(np.arange(4.0), np.ones(3))
ONE_POINT = 0.0 * POINTS
NAN_POINT = moved(0, np.nan)
FAR_POINT = moved(0, 1e38)
SAME_TRIANGLE_TWICE = TRIANGLES[[0, 0]]

READ_OBJ = {
    "plain.obj": Mesh(TETRAHEDRON, 4),
    "windows.OBJ": Mesh(WINDOWS_LINES, 4),
    "before.obj": Mesh(FACES + CORNERS, 4),
    "back.obj": Mesh(CORNERS + FACES_FROM_THE_END, 4),
    "polygon.obj": Mesh(QUAD_AND_TRIANGLE, 3),
    "named.obj": Mesh(NAMED_PARTS, 4),
    "normals.obj": Mesh(CORNERS_AND_NORMAL + FACE_WITH_NORMAL + "f 1//-1 2//-1 4//-1\n", 2),
    "texture.obj": Mesh(WITH_TEXTURE, 2),
    "flat.obj": Mesh(FLAT_CORNERS + "f 1 2 3\nf 2 4 3\n", 2),
    "colours.obj": Mesh(COLOURED_CORNERS + FACES, 4),
    "line.obj": Mesh(TETRAHEDRON + "l 1 2\n", 4),
}
READ_STL = {
    "plain.stl": Mesh(STL, 4),
    "plain.STL": Mesh(stl(POINTS, TRIANGLES[:2]), 2),
}
READ_MSH = {
    "plain.msh": Mesh(MSH, 4),
    "normals.msh": Mesh(msh(POINTS, normals=4), 4),
}
READ = {**READ_OBJ, **READ_STL, **READ_MSH}


@pytest.mark.parametrize("name", READ)
def test_a_mesh_that_mujoco_reads_is_taken(name: str, tmp_path: Path) -> None:
    mesh = READ[name]
    path = written(tmp_path / name, mesh.content)
    check_mesh(path, FULL_SIZE)
    assert faces_in_mujoco(path) == mesh.triangles


WITHOUT_VERTICES = {
    "empty.obj": RefusedMesh("", "0 vertices"),
    "page.obj": RefusedMesh("<html>not found</html>", "0 vertices"),
}
REFUSED_OBJ = {
    "three.obj": RefusedMesh("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "3 vertices"),
    "missing.obj": RefusedMesh(TETRAHEDRON + "f 1 2 9\n", "vertices that it lacks"),
    "zero.obj": RefusedMesh(CORNERS + "f 0 1 2\n", "line 5"),
    "word.obj": RefusedMesh(TETRAHEDRON + "f 1 x 2\n", "line 9"),
    "continued.obj": RefusedMesh(CORNERS + "f 1 3 \\\n2\n" + FACES, "line 5"),
    "nan.obj": RefusedMesh(CORNERS + "v nan 0 0\n" + FACES, "no finite numbers"),
}
WITHOUT_AREA = {
    "one-point.obj": RefusedMesh("v 0 0 0\n" * 4 + FACES, "faces of 0 m²"),
    "one-line.obj": RefusedMesh(CORNERS_ON_A_LINE + FACES, "faces of 0 m²"),
    "flat.obj": RefusedMesh(FLAT_CORNERS, "faces of 0 m²"),
}
WITHOUT_A_NORMAL = {
    "mixed.obj": RefusedMesh(CORNERS_AND_NORMAL + FACE_WITH_NORMAL + FACES, "without a normal"),
    "normal.obj": RefusedMesh(CORNERS_AND_NORMAL + "f 1//9 3//9 2//9\n", "without a normal"),
}
REFUSED_STL = {
    "nan.stl": RefusedMesh(stl(NAN_POINT), "no finite numbers"),
    "far.stl": RefusedMesh(stl(FAR_POINT), "no finite numbers"),
    "one-point.stl": RefusedMesh(stl(ONE_POINT), "1 vertices"),
    "one-triangle.stl": RefusedMesh(stl(POINTS, SAME_TRIANGLE_TWICE), "3 vertices"),
    "one-line.stl": RefusedMesh(stl(POINTS_ON_A_LINE), "faces of 0 m²"),
    "cut.stl": RefusedMesh(STL[:-7], "was cut"),
}
NO_MSH = {
    "empty.msh": RefusedMesh(b"", "no MSH"),
    "cut.msh": RefusedMesh(MSH[:-4], "no MSH"),
    "gmsh.msh": RefusedMesh("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", "no MSH"),
    "normals.msh": RefusedMesh(msh(POINTS, normals=2), "no MSH"),
}
REFUSED_MSH = {
    "missing.msh": RefusedMesh(msh(POINTS, TRIANGLES + 6), "vertices that it lacks"),
    "negative.msh": RefusedMesh(msh(POINTS, TRIANGLES - 1), "vertices that it lacks"),
    "nan.msh": RefusedMesh(msh(NAN_POINT), "no finite numbers"),
    "one-point.msh": RefusedMesh(msh(ONE_POINT), "faces of 0 m²"),
}
REFUSED = {
    **WITHOUT_VERTICES,
    **REFUSED_OBJ,
    **WITHOUT_AREA,
    **WITHOUT_A_NORMAL,
    **REFUSED_STL,
    **NO_MSH,
    **REFUSED_MSH,
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_mesh_that_mujoco_refuses_is_named(name: str, tmp_path: Path) -> None:
    mesh = REFUSED[name]
    path = written(tmp_path / name, mesh.content)
    with pytest.raises(ShapeUnreadable) as caught:
        check_mesh(path, FULL_SIZE)
    message = str(caught.value)
    assert message.startswith(f"{name} ")
    assert mesh.reason in message
    with pytest.raises(ValueError, match="Error"):
        faces_in_mujoco(path)


def test_an_obj_of_several_bodies_is_refused_because_mujoco_shows_the_first(tmp_path: Path) -> None:
    upper = "o upper\n" + TETRAHEDRON
    lower = "o lower\n" + OTHER_BODY
    path = written(tmp_path / "arm.obj", upper + lower)
    assert faces_in_mujoco(path) == 4  # of 8
    with pytest.raises(ShapeUnreadable, match="2 objects or groups, where only the first is read"):
        check_mesh(path, FULL_SIZE)


def test_the_scale_decides_whether_a_mesh_has_an_area(tmp_path: Path) -> None:
    path = written(tmp_path / "arm.obj", TETRAHEDRON)
    mirrored_millimetres = (1e-3, 1e-3, -1e-3)
    tiny = (1e-8, 1e-8, 1e-8)
    check_mesh(path, mirrored_millimetres)
    with pytest.raises(ShapeUnreadable, match="check its scale"):
        check_mesh(path, tiny)
    with pytest.raises(ValueError, match="area is too small"):
        faces_in_mujoco(path, tiny)
