"""Whether a log, a plan or a calibration and a description are of one cell,
and in what a corrected description differs.

A description that replaces the one in a log corrects it: gravity, zero offsets, ratios, geometry,
masses, nameplate. It is of the same cell where the name, the axes, their joints and their drives
are the same. All of these are needed: two robots of one make have the same axes and joints, and a
copied cell file even the same name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from itertools import zip_longest

from daq.config.cell import Cell, CellAxis
from daq.config.cell_file import CELL, cell_from_bundle
from daq.config.yaml_file import parse_yaml
from daq.errors import ConfigurationInconsistent, DaqError, LogsDiffer, SchemaMismatch, first_few
from daq.files import sha256
from ident.calibration import CalibratedDrive, CalibratedJoint, CalibratedRobot, Calibration
from ident.model.urdf import read_urdf

_REMEDY = (
    "another robot's description gives wrong gains: give the description of this cell, or none, "
    "since the log has its own; `name`, `axes`, joints and drives have to be as in the log, and "
    "everything else may be corrected"
)


_RECORD_AGAIN = (
    "the node numbers were exchanged after this recording, and a log keeps those that it was "
    "recorded with: record again with the corrected cell file"
)


@dataclass(frozen=True, slots=True)
class Mismatch:
    """What shows that two descriptions are of different cells."""

    found: str
    expected: str
    remedy: str = _REMEDY


@dataclass(frozen=True, slots=True)
class Correction:
    """What a description replaced in that of a log."""

    configuration_sha256: str  #: of the description in the log
    sections: tuple[str, ...]  #: of the cell file that differ, such as `robot.gravity_m_s2`


def correction_of(
    log: str, files: Mapping[str, bytes], given: Cell, serials: Sequence[int | None] = ()
) -> Correction | None:
    """Return what a given description replaces in that of a log;
    None where nothing of a fit depends on it.

    Args:
        log: name of the log in messages.
        files: the description in the log, as by `daq.config.cell_file.bundle`.
        given: the description that replaces it.
        serials: serial number that the drive of each axis reported; None for one that reported
            none.

    Raises:
        LogsDiffer: the description is of another cell.
        ConfigurationError: the log has no description that can be compared.
    """
    name = f"{log}, {CELL}"
    own: Cell | None
    try:
        own = cell_from_bundle(files, names={CELL: name})
    except (ConfigurationInconsistent, SchemaMismatch):
        # A description that this version refuses may be what the given one corrects: its names are
        # compared.
        own = None
        found = _mismatch_of_names(files, given, name) or _mismatch_of_drives(None, given, serials)
    else:
        found = mismatch(own, given) or _mismatch_of_drives(own, given, serials)
    if found is not None:
        raise LogsDiffer(log, found=found.found, expected=found.expected, remedy=found.remedy)
    if own is None:
        return Correction("", (CELL,))
    sections = differing_sections(own, given)
    return Correction(own.digest, sections) if sections else None


def mismatch(own: Cell, given: Cell) -> Mismatch | None:
    """Return what shows that a description is of another cell than that of a log;
    None for the same cell.
    """
    found = _mismatch_of_axes(own.name, own.axis_names, given)
    if found is not None:
        return found
    differences = robot_differences(calibrated_robot(own), calibrated_robot(given))
    if differences:
        if _has_exchanged_nodes(own, given):
            remedy = _RECORD_AGAIN
        else:
            remedy = _REMEDY
        expected = f"{expected_text(differences)}, as in the given description"
        return Mismatch(found_text(differences), expected, remedy)
    # A log was recorded with these very drives, so it alone is compared by serial numbers, too.
    for one, other in zip(own.axes, given.axes, strict=True):
        recorded = _serial(one)
        wanted = _serial(other)
        if recorded is not None and wanted is not None and recorded != wanted:
            found_serial = f"serial number {recorded} of axis {one.name}"
            return Mismatch(found_serial, f"{wanted}, as in the given description")
    return None


def _has_exchanged_nodes(own: Cell, given: Cell) -> bool:
    """Whether two descriptions have the same node numbers on other axes."""
    first = [axis.node_id for axis in own.axes]
    second = [axis.node_id for axis in given.axes]
    return first != second and set(first) == set(second)


def calibrated_robot(cell: Cell) -> CalibratedRobot:
    """Return a cell's robot as its plans, its calibrations and its history name it.

    What a description corrects (zero offsets, gravity, lengths, masses, nameplate gains) is no part
    of it, nor is a serial number: a drive that is exchanged does not make a robot another one.
    """
    described = read_urdf(cell.urdf).joints
    joints = []
    for joint in described:
        parent = "" if joint.parent < 0 else described[joint.parent].name
        joints.append(CalibratedJoint(joint.name, joint.kind.value, parent))
    drives = []
    for axis in cell.axes:
        vendor_id = None if axis.identity is None else axis.identity.vendor_id
        product_code = None if axis.identity is None else axis.identity.product_code
        drives.append(CalibratedDrive(axis.name, axis.node_id, vendor_id, product_code))
    motors = () if cell.chain is None else tuple(cell.chain.motors)
    parents = [joint.parent for joint in described]
    kinematics_sha256 = _sha256([_joints(cell), parents])
    return CalibratedRobot(
        kinematics_sha256, _drives_sha256(drives), tuple(joints), tuple(drives), motors
    )


def _drives_sha256(drives: Sequence[CalibratedDrive]) -> str:
    return _sha256([astuple(drive) for drive in drives])


@dataclass(frozen=True, slots=True)
class RobotDifference:
    """A joint or a drive in which two robots differ, in words."""

    found: str
    expected: str


def robot_differences(
    found: CalibratedRobot | None, expected: CalibratedRobot | None
) -> tuple[RobotDifference, ...]:
    """Name the joints and drives in which two robots differ; none for the same robot.

    This is the one rule for logs, plans and calibrations: the same axes, the same joints (name,
    kind, parent, motor) in the same order, and the same drives (node id, vendor, product). A number
    of a drive that one of the two leaves open differs from none.

    Args:
        found: robot of a file; None for a file of an earlier version that does not say it, so that
            nothing differs. A plan of an earlier version has the digests alone.
        expected: robot that is compared with.
    """
    if found is None or expected is None:
        return ()
    if not found.joints:
        return _differences_of_digests(found, expected)
    differences = []
    found_joints = map(_joint_text, found.joints)
    expected_joints = map(_joint_text, expected.joints)
    for one, other in zip_longest(found_joints, expected_joints):
        if one != other:
            differences.append(
                RobotDifference(one or "no further joint", other or "no further joint")
            )
    if found.motors != expected.motors:
        differences.append(
            RobotDifference(_motors_text(found.motors), _motors_text(expected.motors))
        )
    by_axis = {drive.axis: drive for drive in expected.drives}
    axes = [drive.axis for drive in found.drives]
    if axes != list(by_axis):
        differences.append(RobotDifference(f"axes {', '.join(axes)}", f"axes {', '.join(by_axis)}"))
    for drive in found.drives:
        if drive.axis in by_axis:
            differences += _differences_of_drives(drive, by_axis[drive.axis])
    return tuple(differences)


def _differences_of_digests(
    found: CalibratedRobot, expected: CalibratedRobot
) -> tuple[RobotDifference, ...]:
    """Compare the digests of a file that lists neither joints nor drives.

    Numbers that its cell file left open then, on every axis, may be declared by now.
    """
    differences = []
    if found.kinematics_sha256 != expected.kinematics_sha256:
        text = "joints (names, kinds, parents or motors)"
        differences.append(RobotDifference(f"other {text}", f"the same {text}"))
    without_vendor = []
    without_product = []
    without_both = []
    for drive in expected.drives:
        without_vendor.append(replace(drive, vendor_id=None))
        without_product.append(replace(drive, product_code=None))
        without_both.append(replace(drive, vendor_id=None, product_code=None))
    known = map(_drives_sha256, (expected.drives, without_vendor, without_product, without_both))
    if found.drives_sha256 not in known:
        text = "drives (node ids, vendors or product codes)"
        differences.append(RobotDifference(f"other {text}", f"the same {text}"))
    return tuple(differences)


def _joint_text(joint: CalibratedJoint) -> str:
    if joint.parent:
        behind = f"behind {joint.parent}"
    else:
        behind = "on the base"
    return f"joint {joint.name} ({joint.kind}, {behind})"


def _motors_text(motors: Sequence[str]) -> str:
    if motors:
        return f"motors on {', '.join(motors)}"
    return "a motor on every joint"


def _differences_of_drives(
    found: CalibratedDrive, expected: CalibratedDrive
) -> list[RobotDifference]:
    pairs = (
        ("node id", "d", found.node_id, expected.node_id),
        ("vendor id", "#x", found.vendor_id, expected.vendor_id),
        ("product code", "#x", found.product_code, expected.product_code),
    )
    differences = []
    for label, form, one, other in pairs:
        if one is not None and other is not None and one != other:
            drive = f"drive of {found.axis} with {label}"
            found_id = format(one, form)
            expected_id = format(other, form)
            differences.append(RobotDifference(f"{drive} {found_id}", f"{drive} {expected_id}"))
    return differences


_SHOWN = 3  #: Differences in a message


def found_text(differences: Sequence[RobotDifference]) -> str:
    """Join what was found of each difference;
    of many, the first ones and the number of the others.
    """
    return first_few([difference.found for difference in differences], _SHOWN)


def expected_text(differences: Sequence[RobotDifference]) -> str:
    """Join what was expected of each difference, as `found_text`."""
    return first_few([difference.expected for difference in differences], _SHOWN)


def mismatch_of_robot(calibration: Calibration, cell: Cell) -> Mismatch | None:
    """Return in what the robot of a calibration is not that of a cell;
    None for the same one, or one that is not known.

    The name of the cell is not compared.
    """
    if calibration.robot is None:
        return None
    differences = robot_differences(calibrated_robot(cell), calibration.robot)
    if not differences:
        return None
    return Mismatch(
        f"another robot with the cell name {cell.name!r}: {found_text(differences)}",
        f"{expected_text(differences)}, as in the calibration",
    )


def _sha256(content: object) -> str:
    return sha256(json.dumps(content).encode())


def mismatch_of_calibration(calibration: Calibration, cell: Cell) -> Mismatch | None:
    """Return what shows that a calibration is of another cell, or of another robot;
    None for the same one.
    """
    axes = tuple(gain.axis for gain in calibration.gains)
    if (cell.name, cell.axis_names) == (calibration.cell, axes):
        return mismatch_of_robot(calibration, cell)
    return Mismatch(
        f"cell {cell.name!r} with the axes {', '.join(cell.axis_names)}",
        f"cell {calibration.cell!r} with the axes {', '.join(axes)}, as in the calibration",
    )


def require_cell_of(
    calibration: Calibration, cell: Cell, error: type[DaqError], subject: str, *, remedy: str
) -> None:
    """Refuse a calibration that is of another cell, or of another robot.

    Raises:
        DaqError: of the given kind, about the subject.
    """
    found = mismatch_of_calibration(calibration, cell)
    if found is not None:
        raise error(subject, found=found.found, expected=found.expected, remedy=remedy)


def differing_sections(own: Cell, given: Cell) -> tuple[str, ...]:
    """Name the sections in which two descriptions of one cell differ,
    as far as a recording or its fit needs them.

    Both have the same axes (`mismatch`).
    """
    found = _sections(own)
    expected = _sections(given)
    sections = []
    for name in found:
        if name == "axes":
            sections += _differing_axes(own.axes, given.axes)
        elif found[name] != expected[name]:
            sections.append(name)
    return tuple(sections)


def _sections(cell: Cell) -> dict[str, object]:
    """Return what a recording or its fit needs of a description, by the keys of the cell file."""
    chain = cell.chain
    return {
        "robot.urdf": cell.urdf,
        GRAVITY: cell.gravity_m_s2,
        # Joints without a motor and pivots follow from the rest.
        "closures": None if chain is None else replace(chain, passive_joints=(), pivots=()),
        "robot.platform": cell.platform,
        "drive_train.ratio": cell.ratio.tolist(),
        "bus": cell.buses,
        "sync": cell.sync,
        "axes": cell.axes,
        "payloads": cell.payloads,
        "effects": cell.effects,
        "friction_by_payload": cell.friction_by_payload,
        "conditioning": cell.conditioning,
    }


def _differing_axes(own: Sequence[CellAxis], given: Sequence[CellAxis]) -> list[str]:
    """Name each key of the axes that differs, with its axes: `axes.limits (J1, J2)`."""
    sections = []
    for field in fields(CellAxis):
        differing = []
        for one, other in zip(own, given, strict=True):
            if getattr(one, field.name) != getattr(other, field.name):
                differing.append(one.name)
        if differing:
            key = _KEYS.get(field.name, field.name)
            names = ", ".join(differing)
            sections.append(f"axes.{key} ({names})")
    return sections


def differing_zeros(sections: Sequence[str]) -> tuple[str, ...]:
    """Return the axes of the zeros among sections that differ, as by `differing_sections`."""
    begin = f"axes.{_KEYS['zero_offset_rad']} ("
    for section in sections:
        if section.startswith(begin):
            names = section.removeprefix(begin).removesuffix(")")
            return tuple(names.split(", "))
    return ()


GRAVITY = "robot.gravity_m_s2"  #: Section of gravity

_KEYS = {"zero_offset_rad": "zero_offset", "profile": "drive profile", "unit": "limits"}
"""Key of the cell file behind a field of `CellAxis` with another name."""


def _joints(cell: Cell) -> tuple[str, ...]:
    """Return name and kind of every joint that moves."""
    robot = read_urdf(cell.urdf)
    joints = tuple(f"{joint.name} ({joint.kind.value})" for joint in robot.joints)
    if cell.chain is None:
        return joints
    motors = ", ".join(cell.chain.motors)
    return (*joints, f"with motors on {motors}")


def _mismatch_of_axes(name: str, axes: tuple[str, ...], given: Cell) -> Mismatch | None:
    if name != given.name:
        return Mismatch(
            f"a log of cell {name!r}", f"one of cell {given.name!r}, as in the given description"
        )
    if axes != given.axis_names:
        found = ", ".join(axes)
        expected = ", ".join(given.axis_names)
        return Mismatch(f"axes {found}", f"{expected}, as in the given description")
    return None


def _mismatch_of_names(files: Mapping[str, bytes], given: Cell, name: str) -> Mismatch | None:
    """Compare name and axes with those of a description that this version refuses otherwise."""
    tree = parse_yaml(files[CELL], name).tree
    cell = tree if isinstance(tree, dict) else {}
    axes = cell.get("axes")
    entries = axes if isinstance(axes, list) else []
    names = tuple(str(entry.get("name")) for entry in entries if isinstance(entry, dict))
    return _mismatch_of_axes(str(cell.get("name")), names or given.axis_names, given)


def _mismatch_of_drives(
    own: Cell | None, given: Cell, serials: Sequence[int | None]
) -> Mismatch | None:
    """Compare the serial numbers that the drives reported at the recording with those of a
    description.

    Where the description in the log has a serial number, that one is compared (`mismatch`).
    """
    declared: tuple[int | None, ...] = (None,) * len(given.axes)
    if own is not None:
        declared = tuple(map(_serial, own.axes))
    for axis, in_log, recorded in zip(given.axes, declared, serials, strict=False):
        wanted = _serial(axis)
        if in_log is not None or recorded is None or wanted is None:
            continue
        if recorded != wanted:
            found = f"serial number {recorded}, reported by the drive of axis {axis.name}"
            return Mismatch(found, f"{wanted}, as in the given description")
    return None


def _serial(axis: CellAxis) -> int | None:
    """Serial number that a description gives to the drive of an axis;
    None where it leaves it open.
    """
    if axis.identity is None:
        return None
    return axis.identity.serial
