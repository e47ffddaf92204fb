"""The shapes of a URDF's links, `<visual>` and `<collision>`, and the limits of its joints,
for other models.

Meshes are files next to the URDF. `package://NAME/…` is looked for in each folder above the URDF:
as NAME in it, or in it where it is NAME itself. What cannot be read is listed with its reason,
because a shape moves no torque.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element, fromstring

import numpy as np
from scipy.spatial.transform import Rotation

from daq.workflow.mesh_files import ShapeUnreadable, check_mesh
from ident.arrays import FloatArray

PACKAGE_SCHEMES = ("package://", "model://")
FILE_SCHEME = "file://"
MESH_FORMATS = (".stl", ".obj", ".msh")  #: That MuJoCo reads
LIMITED_JOINTS = frozenset({"revolute", "prismatic"})


class ShapeKind(Enum):
    """Geometry of a shape, by its name in a URDF."""

    BOX = "box"
    CYLINDER = "cylinder"
    CAPSULE = "capsule"
    SPHERE = "sphere"
    MESH = "mesh"


@dataclass(frozen=True, slots=True, eq=False)
class UrdfShape:
    """One `<visual>` or `<collision>` of a link."""

    link: str
    is_collision: bool
    kind: ShapeKind
    rotation: FloatArray  #: shape's axes in the link's frame, shape (3, 3)
    translation_m: FloatArray  #: its origin there, shape (3,)
    #: Sides of a box; radius and length of a cylinder or capsule; radius of a sphere; scales of a
    #: mesh [m; 1].
    size: tuple[float, ...]
    mesh: Path | None  #: file of a mesh
    #: red, green, blue, opacity, 0 to 1; None where the URDF has none
    colour: tuple[float, ...] | None


@dataclass(frozen=True, slots=True)
class UrdfShapes:
    """Shapes of a URDF."""

    found: tuple[UrdfShape, ...]
    left_out: tuple[str, ...]  #: shapes that cannot be carried over, each with its reason


def shapes_of(urdf: str, folder: Path) -> UrdfShapes:
    """Read the shapes of all links.

    Args:
        urdf: text of a URDF that the robot was read from.
        folder: of the URDF's file, from where its meshes are found.
    """
    root = fromstring(urdf)
    colours = dict(_named_colours(root))
    found: list[UrdfShape] = []
    left_out: list[str] = []
    for link in root.findall("link"):
        name = link.get("name", "")
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                try:
                    found.append(_shape(element, name, folder, colours))
                except ShapeUnreadable as reason:
                    left_out.append(f"{tag} of {name}: {reason}")
    return UrdfShapes(tuple(found), tuple(left_out))


def joint_ranges(urdf: str) -> dict[str, tuple[float, float]]:
    """Return the least and the largest position of each moving joint [rad or m];
    infinite without a usable limit.
    """
    ranges: dict[str, tuple[float, float]] = {}
    for joint in fromstring(urdf).findall("joint"):
        limit = joint.find("limit")
        ranges[joint.get("name", "")] = (-inf, inf)
        if limit is None or joint.get("type") not in LIMITED_JOINTS:
            continue
        lower = _as_number(limit.get("lower", "0"))
        upper = _as_number(limit.get("upper", "0"))
        if lower is not None and upper is not None and lower < upper:
            ranges[joint.get("name", "")] = (lower, upper)
    return ranges


def _shape(
    element: Element, link: str, folder: Path, colours: dict[str, tuple[float, ...]]
) -> UrdfShape:
    geometry = element.find("geometry")
    children = [] if geometry is None else list(geometry)
    if len(children) != 1:
        raise ShapeUnreadable(f"{len(children)} geometries, where one is expected")
    body = children[0]
    kinds = {kind.value: kind for kind in ShapeKind}
    if body.tag not in kinds:
        raise ShapeUnreadable(f"<{body.tag}>, which is none of {', '.join(kinds)}")
    kind = kinds[body.tag]
    rotation, translation_m = _origin(element)
    size = _size(body, kind)
    mesh = None
    if kind is ShapeKind.MESH:
        mesh = _mesh_file(body.get("filename", ""), folder, size)
    return UrdfShape(
        link=link,
        is_collision=element.tag == "collision",
        kind=kind,
        rotation=rotation,
        translation_m=translation_m,
        size=size,
        mesh=mesh,
        colour=_colour(element, colours),
    )


def _size(body: Element, kind: ShapeKind) -> tuple[float, ...]:
    if kind is ShapeKind.MESH:
        scale = _numbers(body, "scale", "1 1 1", 3)
        if 0.0 in scale:
            raise ShapeUnreadable(f"scale {body.get('scale')!r}, where no number may be 0")
        return scale
    if kind is ShapeKind.BOX:
        size = _numbers(body, "size", "", 3)
    elif kind is ShapeKind.SPHERE:
        size = _numbers(body, "radius", "", 1)
    else:
        size = (*_numbers(body, "radius", "", 1), *_numbers(body, "length", "", 1))
    if min(size) <= 0.0:
        raise ShapeUnreadable(f"<{body.tag}> with a size of {min(size):g} m, which is not positive")
    return size


def _origin(element: Element) -> tuple[FloatArray, FloatArray]:
    """Axes and origin of a shape in its link;
    roll, pitch and yaw turn about the axes of the link.
    """
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    angles_rad = _numbers(origin, "rpy", "0 0 0", 3)
    rotation = Rotation.from_euler("xyz", angles_rad).as_matrix()
    return rotation, np.array(_numbers(origin, "xyz", "0 0 0", 3))


def _mesh_file(name: str, folder: Path, scale: tuple[float, ...]) -> Path:
    """Return the file that a URDF names, where it exists and MuJoCo reads it."""
    path = next((place for place in _places(name, folder) if place.is_file()), None)
    if path is None:
        raise ShapeUnreadable(f"no file {name!r} next to or above the URDF")
    ending = path.suffix.lower()
    if ending not in MESH_FORMATS:
        raise ShapeUnreadable(
            f"{path.name} is no {', '.join(MESH_FORMATS)}; convert it, and name it in the URDF"
        )
    try:
        check_mesh(path, scale)
    except OSError as error:
        raise ShapeUnreadable(f"{path.name} cannot be read: {error.strerror}") from error
    return path.resolve()


def _places(name: str, folder: Path) -> Iterator[Path]:
    """Where a mesh may be."""
    if name.startswith(FILE_SCHEME):
        yield Path(unquote(name.removeprefix(FILE_SCHEME)))
        return
    scheme = next((one for one in PACKAGE_SCHEMES if name.startswith(one)), None)
    if scheme is None:
        yield folder / name
        return
    package, _, rest = name.removeprefix(scheme).partition("/")
    above = folder.resolve()
    for parent in (above, *above.parents):
        if parent.name == package:
            yield parent / rest
        yield parent / package / rest


def _named_colours(root: Element) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Materials with a colour, at the head or where they are first used."""
    for material in root.iter("material"):
        colour = _own_colour(material)
        if colour is not None and material.get("name"):
            yield material.get("name", ""), colour


def _colour(element: Element, named: dict[str, tuple[float, ...]]) -> tuple[float, ...] | None:
    material = element.find("material")
    if material is None:
        return None
    return _own_colour(material) or named.get(material.get("name", ""))


def _own_colour(material: Element) -> tuple[float, ...] | None:
    """Colour of a material; None without one, or where it is none:
    a picture is no reason to stop.
    """
    colour = material.find("color")
    if colour is None:
        return None
    try:
        return _numbers(colour, "rgba", "", 4)
    except ShapeUnreadable:
        return None


def _numbers(element: Element, key: str, default: str, count: int) -> tuple[float, ...]:
    text = element.get(key, default)
    numbers = [_as_number(word) for word in text.split()]
    found = tuple(number for number in numbers if number is not None)
    if len(numbers) != count or len(found) != count:
        raise ShapeUnreadable(
            f"<{element.tag}> with {key}={text!r}, where {count} numbers are expected"
        )
    return found


def _as_number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if isfinite(number) else None
