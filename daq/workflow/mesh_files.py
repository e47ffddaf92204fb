"""Whether MuJoCo reads a mesh: it refuses the whole model for one file that it cannot read.

The ending of the file's name decides which reader it uses: binary STL, OBJ, or its own MSH. The
conditions are those of MuJoCo 4.0, as a test shows with files of each kind: at least four vertices,
all finite, triangles between vertices that exist, and an area above zero. Of an OBJ it shows only
the faces of the first object or group, without a warning, so one with several is refused too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from ident.arrays import FloatArray, IntArray

STL_HEAD_BYTES = 84  #: Of a binary STL: 80 of text, 4 of the number of triangles
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
LEAST_TRIANGLES = 2  #: In an STL: one has three corners, and four vertices are wanted
MOST_TRIANGLES = 200_000
MSH_HEAD_BYTES = 16  #: Numbers of vertices, normals, texture coordinates and triangles
LEAST_VERTICES = 4
LARGEST_COORDINATE = 1e9  #: The STL reader refuses somewhat more
LEAST_AREA_M2 = 1e-14  #: Ten times what is refused
CORNERS = 3  #: Least corners of a face
NORMAL = 2  #: Place of the normal in `vertex/texture/normal`
_PRIMITIVES = frozenset({b"f", b"l", b"p"})


class ShapeUnreadable(Exception):
    """A shape that is left out; its text is the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class _Triangles:
    vertices: FloatArray  #: shape (v, 3)
    faces: IntArray  #: vertices of each triangle, from 0, shape (t, 3)


def check_mesh(path: Path, scale: tuple[float, ...]) -> None:
    """Refuse a mesh that MuJoCo does not read, or not all of.

    Args:
        path: of a `.stl`, `.obj` or `.msh`, in letters of either case.
        scale: of each coordinate.

    Raises:
        ShapeUnreadable: it does not; the text says why, and what to do.
        OSError: the file cannot be read.
    """
    read = {".stl": _read_stl, ".obj": _read_obj, ".msh": _read_msh}[path.suffix.lower()]
    mesh = read(path)
    if not np.all(np.abs(mesh.vertices) <= LARGEST_COORDINATE):  # nor NaN
        raise ShapeUnreadable(
            f"{path.name} has vertices that are no finite numbers, or beyond "
            f"{LARGEST_COORDINATE:g}; save it again"
        )
    if len(mesh.vertices) < LEAST_VERTICES:
        raise ShapeUnreadable(
            f"{path.name} has {len(mesh.vertices)} vertices, where at least {LEAST_VERTICES} are "
            "read; save it with more"
        )
    if not np.all((mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))):
        raise ShapeUnreadable(
            f"{path.name} has faces between vertices that it lacks, or was cut; save it again"
        )
    corners = mesh.vertices[mesh.faces] * np.array(scale)
    first_sides = corners[:, 1] - corners[:, 0]
    second_sides = corners[:, 2] - corners[:, 0]
    normals = np.cross(first_sides, second_sides)
    area_m2 = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    if area_m2 < LEAST_AREA_M2:
        raise ShapeUnreadable(
            f"{path.name} has faces of {area_m2:g} m² in all, where more than "
            f"{LEAST_AREA_M2:g} m² is read; save it with faces, and check its scale"
        )


def _read_stl(path: Path) -> _Triangles:
    """Read a binary STL; equal corners are one vertex."""
    content = path.read_bytes()
    count = int.from_bytes(content[STL_HEAD_BYTES - 4 : STL_HEAD_BYTES], "little")
    size = STL_HEAD_BYTES + STL_TRIANGLE.itemsize * count
    if len(content) < STL_HEAD_BYTES or len(content) != size:
        raise ShapeUnreadable(f"{path.name} is no binary STL, or was cut; save it as binary STL")
    if not LEAST_TRIANGLES <= count <= MOST_TRIANGLES:
        allowed = f"{LEAST_TRIANGLES} to {MOST_TRIANGLES}"
        raise ShapeUnreadable(
            f"{path.name} has {count} triangles, where {allowed} are read; save it with "
            "fewer or more"
        )
    triangles = np.frombuffer(content, STL_TRIANGLE, count, STL_HEAD_BYTES)
    corners = triangles["corners"].reshape(-1, 3).astype(np.float64)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return _Triangles(vertices, faces.reshape(-1, 3).astype(np.int64))


def _read_msh(path: Path) -> _Triangles:
    """Read MuJoCo's own format: four counts, then float32 and int32."""
    content = path.read_bytes()
    counts = np.frombuffer(content[:MSH_HEAD_BYTES].ljust(MSH_HEAD_BYTES, b"\0"), "<i4")
    vertices, normals, texture, faces = counts.tolist()
    size = MSH_HEAD_BYTES + 12 * vertices + 12 * normals + 8 * texture + 12 * faces
    is_whole = len(content) == size and faces >= 0
    if not is_whole or not {normals, texture} <= {0, vertices} or vertices < LEAST_VERTICES:
        raise ShapeUnreadable(f"{path.name} is no MSH of MuJoCo, or was cut; save it as binary STL")
    points = np.frombuffer(content, "<f4", 3 * vertices, MSH_HEAD_BYTES)
    first_face = size - 12 * faces
    indices = np.frombuffer(content, "<i4", 3 * faces, first_face)
    return _Triangles(
        points.reshape(-1, 3).astype(np.float64), indices.reshape(-1, 3).astype(np.int64)
    )


@dataclass(slots=True)
class _ObjContent:
    """What the lines of an OBJ say, as they are read."""

    vertices: list[list[float]] = field(default_factory=list)
    normals: int = 0
    faces: list[tuple[int, int, int]] = field(default_factory=list)
    bare_corners: int = 0  #: corners without a normal
    largest_normal: int = -1  #: of the other corners, from 0
    shapes: int = 0  #: objects and groups that have faces, lines or points
    is_open: bool = False  #: whether the present one has

    def add_face(self, words: list[bytes]) -> None:
        """Add a face: its corners are numbers of a vertex, texture and normal, as `1/2/3`."""
        corners = [self._vertex_of(word) for word in words]
        for second, third in pairwise(corners[1:]):
            self.faces.append((corners[0], second, third))

    def _vertex_of(self, word: bytes) -> int:
        numbers = word.split(b"/")  # of the vertex, its texture and its normal
        if len(numbers) > NORMAL and numbers[NORMAL]:
            normal = _from_zero(int(numbers[NORMAL]), self.normals)
            self.largest_normal = max(self.largest_normal, normal)
        else:
            self.bare_corners += 1
        return _from_zero(int(numbers[0]), len(self.vertices))


def _from_zero(number: int, known: int) -> int:
    """Return a number that counts from 1, or back from the last one with -1, as from 0.

    Raises:
        ValueError: it is 0, or before the first.
    """
    found = number - 1
    if number < 0:
        found = known + number
    if number == 0 or found < 0:
        raise ValueError(f"{number} is no vertex")
    return found


def _read_obj(path: Path) -> _Triangles:
    """Read vertices and faces of an OBJ; polygons are fans of triangles."""
    content = _ObjContent()
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            _read_obj_line(content, line.split())
        except ValueError as error:
            raise ShapeUnreadable(
                f"{path.name} has a line {number} that is none of an OBJ ({error}); save it as "
                "binary STL"
            ) from error
    if content.shapes > 1:
        raise ShapeUnreadable(
            f"{path.name} has {content.shapes} objects or groups, where only the first is read; "
            "join them, or save it as binary STL"
        )
    has_normals = content.largest_normal >= 0
    if has_normals and (content.bare_corners or content.largest_normal >= content.normals):
        raise ShapeUnreadable(
            f"{path.name} has corners without a normal, or with one that it lacks; save it with a "
            "normal for each corner, or without any"
        )
    vertices = np.array(content.vertices, dtype=np.float64).reshape(-1, 3)
    return _Triangles(vertices, np.array(content.faces, dtype=np.int64).reshape(-1, 3))


def _read_obj_line(content: _ObjContent, words: list[bytes]) -> None:
    """Add what a line says.

    Raises:
        ValueError: it has no three coordinates, or a corner that is no number of a vertex.
    """
    if not words:
        return
    key, *values = words
    if key == b"v":
        if len(values) < CORNERS:
            raise ValueError(f"{len(values)} coordinates")
        content.vertices.append([float(value) for value in values[:CORNERS]])
    elif key == b"vn":
        content.normals += 1
    elif key in {b"o", b"g"}:
        content.is_open = False
    elif key in _PRIMITIVES:
        if not content.is_open:
            content.shapes += 1
        content.is_open = True
        if key == b"f":
            content.add_face(values)
