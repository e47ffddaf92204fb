"""What is wrong with a cell although each of its values is well-formed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from math import hypot
from xml.etree import ElementTree

import numpy as np

from daq.configuration.cell import Pacing
from daq.configuration.cell_schema import AxisModel, CellModel
from daq.configuration.yaml_file import Document, Fault, describe
from daq.errors import ConfigurationInconsistent
from drivers.profile import DriveProfile
from ident.errors import ModelError
from ident.robot import JointKind, robot_from_urdf

LARGEST_POSITION_DEG = 720.0
SMALLEST_RANGE_DEG = 0.2
SIMULATED_INTERFACES = ("virtual", "socketcand")
"""Buses on which a simulated cell can be; every other one may have a machine on it."""
LARGEST_CONDITION = 1e8
"""Of R; above it, joint positions cannot be told from motor positions."""


def check(document: Document, model: CellModel, urdf: str, profiles: Mapping[str, DriveProfile]) -> None:
    """Refuse a cell that contradicts itself.

    Args:
        document: the cell file, for the lines.
        model: what it says.
        urdf: text of its robot.
        profiles: of its drives, by name.

    Raises:
        ConfigurationInconsistent: with every contradiction and its line.
    """
    faults = [
        *_robot_faults(model, urdf),
        *_ratio_faults(model),
        *_bus_faults(model),
        *_sync_faults(model, profiles),
        *_axis_faults(model, urdf),
        *_list_faults(model),
    ]
    if faults:
        raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the cell file")


def _robot_faults(model: CellModel, urdf: str) -> Iterator[Fault]:
    gravity = hypot(*model.robot.gravity_m_s2)
    if not 9.7 < gravity < 9.9:
        yield Fault(("robot", "gravity_m_s2"), f"{gravity:.4g} m/s² in all", "9.78 to 9.83 m/s², anywhere on Earth")
    try:
        robot = robot_from_urdf(urdf, model.robot.gravity_m_s2)
    except ModelError as error:
        yield Fault(("robot", "urdf"), str(error), "a URDF of an arm")
        return
    if len(robot.joints) != len(model.axes):
        names = ", ".join(joint.name for joint in robot.joints)
        yield Fault(("axes",), f"{len(model.axes)} axes", f"one for each moving joint of the URDF ({names})")
    for index, joint in enumerate(robot.joints[: len(model.axes)]):
        if joint.kind is not JointKind.REVOLUTE:
            yield Fault(
                ("axes", index, "limits"),
                f"limits in deg, and joint {joint.name} of the URDF is {joint.kind.value}",
                "a revolute joint",
            )


def _ratio_faults(model: CellModel) -> Iterator[Fault]:
    path = ("drive_train", "ratio")
    ratio, n = model.drive_train.ratio, len(model.axes)
    if len(ratio) != n or any(len(row) != n for row in ratio):
        shape = f"{len(ratio)} rows of {', '.join(map(str, sorted({len(row) for row in ratio})))} numbers"
        yield Fault(path, shape, f"{n} × {n}, a row for each motor")
        return
    condition = float(np.linalg.cond(np.array(ratio, dtype=np.float64)))
    if not np.isfinite(condition) or condition > LARGEST_CONDITION:
        yield Fault(path, f"a singular matrix (condition {condition:.3g})", "one that can be inverted")


def _bus_faults(model: CellModel) -> Iterator[Fault]:
    if model.bus is None:
        return
    if model.sync is None:
        yield Fault(("sync",), "nothing", "a sampling period, because the cell has a bus")
    for index, axis in enumerate(model.axes):
        for key in ("node_id", "drive", "identity", "counts_per_revolution"):
            if getattr(axis, key) is None:
                yield Fault(("axes", index, key), "nothing", "a value, because the cell has a bus")
    used = Counter(axis.node_id for axis in model.axes if axis.node_id is not None)
    for index, axis in enumerate(model.axes):
        if axis.node_id is None:
            continue
        if not 1 <= axis.node_id <= 127:
            yield Fault(("axes", index, "node_id"), str(axis.node_id), "1 to 127 (CiA 301)")
        if used[axis.node_id] > 1:
            yield Fault(
                ("axes", index, "node_id"), f"{axis.node_id}, used {used[axis.node_id]} times", "each node once"
            )


def _sync_faults(model: CellModel, profiles: Mapping[str, DriveProfile]) -> Iterator[Fault]:
    if model.bus is None or model.sync is None:
        return
    if model.sync.pacing is Pacing.LOCKSTEP and model.bus.interface not in SIMULATED_INTERFACES:
        yield Fault(
            ("sync", "pacing"),
            f"lockstep on a bus of interface {model.bus.interface}",
            f"timed: lockstep makes the time of the samples up, which is true of a simulated cell "
            f"({' or '.join(SIMULATED_INTERFACES)}) alone",
        )
    for drive in model.drives:
        refresh_us = profiles[drive].update_period_us
        if refresh_us > model.sync.period_us:
            yield Fault(
                ("sync", "period_us"),
                f"{model.sync.period_us}, while drive {drive} refreshes its objects every {refresh_us} µs",
                f"{refresh_us} or more: faster than that, samples repeat old values and motion becomes a staircase",
            )


def _axis_faults(model: CellModel, urdf: str) -> Iterator[Fault]:
    radian_limits = _urdf_limits(urdf)
    for index, axis in enumerate(model.axes):
        gain_key = "nameplate_gain" if axis.nameplate_gain_nm_per_a is None else "nameplate_gain_nm_per_a"
        if not (axis.nameplate_gain or axis.nameplate_gain_nm_per_a):
            yield Fault(("axes", index, gain_key), "0", "the manufacturer's gain, signed, not zero")
        in_radians = radian_limits[index] if index < len(radian_limits) else None
        yield from _limit_faults(("axes", index, "limits", "position_deg"), axis, in_radians)
        if abs(axis.zero_offset_deg) > LARGEST_POSITION_DEG:
            yield Fault(("axes", index, "zero_offset_deg"), f"{axis.zero_offset_deg:g}", "at most ±720 deg")


def _limit_faults(
    path: tuple[str | int, ...], axis: AxisModel, in_radians: tuple[float, float] | None
) -> Iterator[Fault]:
    lower, upper = axis.limits.position_deg
    found = f"[{lower:g}, {upper:g}] deg"
    if lower >= upper:
        yield Fault(path, found, "the lower limit first")
    elif max(abs(lower), abs(upper)) > LARGEST_POSITION_DEG:
        yield Fault(path, found, f"at most ±{LARGEST_POSITION_DEG:g} deg; are these counts or motor degrees?")
    elif upper - lower < SMALLEST_RANGE_DEG:
        yield Fault(path, found, f"a range of at least {SMALLEST_RANGE_DEG:g} deg; are these revolutions?")
    elif in_radians is not None and in_radians[0] < in_radians[1]:
        tolerance = 0.1 * (in_radians[1] - in_radians[0])
        if abs(lower - in_radians[0]) < tolerance and abs(upper - in_radians[1]) < tolerance:
            yield Fault(path, f"{found}, the numbers of the URDF in rad", "deg; multiply by 57.3")


def _urdf_limits(urdf: str) -> list[tuple[float, float] | None]:
    """Limits of the moving joints as the URDF writes them [rad], in document order; [] when it cannot be read."""
    try:
        joints = ElementTree.fromstring(urdf).iter("joint")
        limits: list[tuple[float, float] | None] = []
        for joint in joints:
            if joint.get("type") not in {"revolute", "continuous", "prismatic"}:
                continue
            limit = joint.find("limit")
            if limit is None or joint.get("type") != "revolute":
                limits.append(None)
            else:
                limits.append((float(limit.get("lower", "0")), float(limit.get("upper", "0"))))
    except (ElementTree.ParseError, ValueError):
        return []
    return limits


def _list_faults(model: CellModel) -> Iterator[Fault]:
    n = len(model.axes)
    names = Counter(axis.name for axis in model.axes)
    for index, axis in enumerate(model.axes):
        if names[axis.name] > 1:
            yield Fault(("axes", index, "name"), f"{axis.name}, used {names[axis.name]} times", "each name once")
    if len(model.conditioning.standstill_rad_s) != n:
        found = f"{len(model.conditioning.standstill_rad_s)} speeds"
        yield Fault(("conditioning", "standstill_rad_s"), found, f"{n}, one for each axis")
    if model.controller is not None and len(model.controller.gains) != n:
        yield Fault(("controller", "gains"), f"{len(model.controller.gains)} keys", f"{n}, one for each axis")
    mountings = Counter((payload.name, payload.mounting) for payload in model.payloads)
    for index, payload in enumerate(model.payloads):
        if payload.mass_kg <= 0:
            yield Fault(("payloads", index, "mass_kg"), f"{payload.mass_kg:g}", "a positive mass [kg]")
        if mountings[payload.name, payload.mounting] > 1:
            yield Fault(("payloads", index, "name"), f"{payload.name} twice in one mounting", "each mounting once")
