"""What is wrong with an axis, seen beside the joint of the URDF that it moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from daq.configuration.cell_schema import AxisModel, CellModel
from daq.configuration.drive_train import gain_joints, ratio_of
from daq.configuration.joint_unit import DEGREE, MILLIMETRE, joint_unit
from daq.configuration.yaml_file import Fault, Location
from ident.robot import Joint, JointKind


@dataclass(frozen=True, slots=True)
class Plausible:
    """Positions that a joint can have, in its unit.

    Attributes:
        farthest, too_far: largest position, and what a larger one most likely is.
        shortest, too_short: smallest range, and what a smaller one most likely is.
    """

    farthest: float
    too_far: str
    shortest: float
    too_short: str


_PLAUSIBLE = {
    DEGREE: Plausible(720.0, "counts or motor degrees", 0.2, "revolutions"),
    MILLIMETRE: Plausible(100_000.0, "counts or µm", 5.0, "m"),
}


def axis_faults(model: CellModel, joints: Sequence[Joint], urdf: str) -> Iterator[Fault]:
    """Every axis that contradicts itself or its joint.

    Args:
        model: the cell file.
        joints: of its robot; none where that could not be read.
        urdf: text of the robot.
    """
    si_limits = _urdf_limits(urdf)
    for index, axis in enumerate(model.axes):
        path: Location = ("axes", index)
        if index < len(joints):
            yield from _kind_faults(path, axis, joints[index])
        in_si = si_limits[index] if index < len(si_limits) else None
        yield from _limit_faults((*path, "limits", f"position_{axis.limits.unit.name}"), axis, in_si)
        for unit, offset in ((DEGREE, axis.zero_offset_deg), (MILLIMETRE, axis.zero_offset_mm)):
            farthest = _PLAUSIBLE[unit].farthest
            if offset is not None and abs(offset) > farthest:
                yield Fault((*path, f"zero_offset_{unit.name}"), f"{offset:g}", f"at most ±{farthest:g} {unit.name}")
    yield from _gain_faults(model, joints)
    yield from _standstill_faults(model, joints)


def _kind_faults(path: Location, axis: AxisModel, joint: Joint) -> Iterator[Fault]:
    """Degrees for a revolute joint, mm for a prismatic one."""
    unit, written = joint_unit(joint.kind), axis.limits.unit
    what = f"joint {joint.name} of the URDF is {joint.kind.value}"
    if written is not unit:
        name = unit.name
        yield Fault(
            (*path, "limits"),
            f"limits in {written.name}, and {what}",
            f"position_{name}, velocity_{name}_s and acceleration_{name}_s2",
        )
    offsets = ((DEGREE, axis.zero_offset_deg), (MILLIMETRE, axis.zero_offset_mm))
    for other, offset in offsets:
        if offset is not None and other is not unit:
            yield Fault((*path, f"zero_offset_{other.name}"), f"{other.name}, and {what}", f"zero_offset_{unit.name}")
    if axis.lead_mm is not None and joint.kind is not JointKind.PRISMATIC:
        yield Fault((*path, "lead_mm"), f"a lead, and {what}", "nothing: only a prismatic joint moves so far a turn")


def _gain_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    try:
        gained = gain_joints(ratio_of(model))
    except ValueError:
        gained = ()  # the drive train is refused elsewhere
    for index, axis in enumerate(model.axes):
        gains = {
            "nameplate_gain": axis.nameplate_gain,
            "nameplate_gain_nm_per_a": axis.nameplate_gain_nm_per_a,
            "nameplate_gain_n_per_a": axis.nameplate_gain_n_per_a,
        }
        key, value = next((key, value) for key, value in gains.items() if value is not None)
        if not value:
            yield Fault(("axes", index, key), "0", "the manufacturer's gain, signed, not zero")
        if index >= len(gained) or gained[index] >= len(joints):
            continue
        joint = joints[gained[index]]
        force = joint_unit(joint.kind).force
        written = {"nameplate_gain_nm_per_a": "Nm", "nameplate_gain_n_per_a": "N"}.get(key)
        if written is None:
            key, written = "gain_unit", (axis.gain_unit or "").partition("/")[0].strip()
        if written in {"Nm", "N"} and written != force:
            yield Fault(
                ("axes", index, key),
                f"a gain in {written}, and it acts on joint {joint.name}, which is {joint.kind.value}",
                f"{force} per unit of the current reference",
            )


def _limit_faults(path: Location, axis: AxisModel, in_si: tuple[float, float] | None) -> Iterator[Fault]:
    (lower, upper), unit = axis.limits.position, axis.limits.unit
    plausible = _PLAUSIBLE[unit]
    found = f"[{lower:g}, {upper:g}] {unit.name}"
    if lower >= upper:
        yield Fault(path, found, "the lower limit first")
    elif max(abs(lower), abs(upper)) > plausible.farthest:
        yield Fault(path, found, f"at most ±{plausible.farthest:g} {unit.name}; are these {plausible.too_far}?")
    elif upper - lower < plausible.shortest:
        yield Fault(
            path, found, f"a range of at least {plausible.shortest:g} {unit.name}; are these {plausible.too_short}?"
        )
    elif in_si is not None and in_si[0] < in_si[1]:
        tolerance = 0.1 * (in_si[1] - in_si[0])
        if abs(lower - in_si[0]) < tolerance and abs(upper - in_si[1]) < tolerance:
            remedy = f"{unit.name}; multiply by {1.0 / unit.si:.3g}"
            yield Fault(path, f"{found}, the numbers of the URDF in {unit.si_name}", remedy)


def _standstill_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    """One speed for each axis, in the list of its unit; without a prismatic axis the other list is left out."""
    n = len(model.axes)
    lists = {
        "standstill_rad_s": model.conditioning.standstill_rad_s,
        "standstill_mm_s": model.conditioning.standstill_mm_s,
    }
    prismatic = [joint.kind is JointKind.PRISMATIC for joint in joints] or [
        axis.limits.unit is MILLIMETRE for axis in model.axes
    ]
    needed = {"standstill_rad_s": not all(prismatic), "standstill_mm_s": any(prismatic)}
    complete = True
    for key, speeds in lists.items():
        if len(speeds) != n and (speeds or needed[key]):
            complete = False
            yield Fault(
                ("conditioning", key), f"{len(speeds)} speeds", f"{n}, one for each axis (null in the other list)"
            )
    if not complete:
        return
    for index, along in enumerate(prismatic[:n]):
        for key, speeds in lists.items():
            wanted = along == (key == "standstill_mm_s")
            if speeds and (speeds[index] is not None) != wanted:
                kind = JointKind.PRISMATIC if along else JointKind.REVOLUTE
                found = f"{speeds[index]} for {model.axes[index].name}, which is {kind.value}"
                yield Fault(
                    ("conditioning", key, index), found, "a speed" if wanted else "null, it is in the other list"
                )


def _urdf_limits(urdf: str) -> list[tuple[float, float] | None]:
    """Limits of the moving joints as the URDF writes them [rad or m], in document order; [] when it cannot be read."""
    try:
        joints = ElementTree.fromstring(urdf).iter("joint")
        limits: list[tuple[float, float] | None] = []
        for joint in joints:
            if joint.get("type") not in {"revolute", "continuous", "prismatic"}:
                continue
            limit = joint.find("limit")
            if limit is None or joint.get("type") == "continuous":
                limits.append(None)
            else:
                limits.append((float(limit.get("lower", "0")), float(limit.get("upper", "0"))))
    except (ElementTree.ParseError, ValueError):
        return []
    return limits
