"""What is wrong with a cell although each of its values is well-formed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from math import hypot

import numpy as np

from daq.configuration.axis_checks import axis_faults
from daq.configuration.bus_checks import bus_faults
from daq.configuration.cell_schema import CellModel, PayloadModel
from daq.configuration.clearance import clearance_faults
from daq.configuration.controller_target import controller_faults
from daq.configuration.drive_train import ratio_of
from daq.configuration.sync_checks import producer_faults
from daq.configuration.yaml_file import Document, Fault, describe
from daq.errors import ConfigurationInconsistent
from daq.signature import public_keys
from drivers.profile import DriveProfile
from ident.errors import ModelError
from ident.robot import Joint, robot_from_urdf

LARGEST_CONDITION = 1e8
"""Of R; above it, joint positions cannot be told from motor positions."""

LARGEST_TOLERANCE = 0.1
"""Of a payload's mass: a wrong weight scales all gains alike."""


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
    joints, faults = _robot(model, urdf)
    faults += [
        *_ratio_faults(model),
        *bus_faults(model, profiles),
        *producer_faults(model),
        *axis_faults(model, joints, urdf),
        *_list_faults(model),
        *_signer_faults(model.policy.apply.signers),
        *clearance_faults(model.workspace, model.clearance, [axis.name for axis in model.axes]),
    ]
    if faults:
        raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the cell file")


def _robot(model: CellModel, urdf: str) -> tuple[tuple[Joint, ...], list[Fault]]:
    """The joints of the URDF, none where it cannot be read, and what is wrong with the robot as a whole."""
    faults = []
    gravity = hypot(*model.robot.gravity_m_s2)
    if not 9.7 < gravity < 9.9:
        found = f"{gravity:.4g} m/s² in all"
        faults.append(Fault(("robot", "gravity_m_s2"), found, "9.78 to 9.83 m/s², anywhere on Earth"))
    try:
        joints = robot_from_urdf(urdf, model.robot.gravity_m_s2).joints
    except ModelError as error:
        return (), [*faults, Fault(("robot", "urdf"), str(error), "a URDF of an arm")]
    if len(joints) != len(model.axes):
        names = ", ".join(joint.name for joint in joints)
        expected = f"one for each moving joint of the URDF ({names})"
        faults.append(Fault(("axes",), f"{len(model.axes)} axes", expected))
    return joints, faults


def _ratio_faults(model: CellModel) -> Iterator[Fault]:
    path = ("drive_train", "ratio")
    ratio, n = model.drive_train.ratio, len(model.axes)
    if len(ratio) != n or any(len(row) != n for row in ratio):
        shape = f"{len(ratio)} rows of {', '.join(map(str, sorted({len(row) for row in ratio})))} numbers"
        yield Fault(path, shape, f"{n} × {n}, a row for each motor")
        return
    condition = float(np.linalg.cond(ratio_of(model)))
    if not np.isfinite(condition) or condition > LARGEST_CONDITION:
        yield Fault(path, f"a singular matrix (condition {condition:.3g})", "one that can be inverted")


def _list_faults(model: CellModel) -> Iterator[Fault]:
    n = len(model.axes)
    names = Counter(axis.name for axis in model.axes)
    for index, axis in enumerate(model.axes):
        if names[axis.name] > 1:
            yield Fault(("axes", index, "name"), f"{axis.name}, used {names[axis.name]} times", "each name once")
    if model.controller is not None:
        on_a_bus = bool(model.buses) and all(axis.node_id is not None and axis.drive for axis in model.axes)
        yield from controller_faults(model.controller, n, on_a_bus=on_a_bus)
    mountings = Counter(payload.mounting for payload in model.payloads)
    for index, payload in enumerate(model.payloads):
        if payload.mass_kg <= 0:
            yield Fault(("payloads", index, "mass_kg"), f"{payload.mass_kg:g}", "a positive mass [kg]")
        elif payload.mass_tolerance_kg > LARGEST_TOLERANCE * payload.mass_kg:
            found = f"{payload.mass_tolerance_kg:g} kg for {payload.mass_kg:g} kg"
            yield Fault(
                ("payloads", index, "mass_tolerance_kg"), found, "at most a tenth of the mass: it is in every gain"
            )
        if mountings[payload.mounting] > 1:
            yield Fault(
                ("payloads", index, "mounting"),
                f"{payload.mounting}, used {mountings[payload.mounting]} times",
                "each mounting a name of its own: it stands for one body in one place",
            )
        yield from _inertia_faults(payload, index)


def _signer_faults(signers: Mapping[str, str]) -> Iterator[Fault]:
    """A key that is none would be found at the first signature only, long after the recording."""
    good: dict[str, str] = {}
    for name, line in signers.items():
        try:
            public_keys({**good, name: line})
        except ConfigurationInconsistent as error:
            yield Fault(("policy", "apply", "signers", name), error.found, error.expected)
        else:
            good[name] = line


def _inertia_faults(payload: PayloadModel, index: int) -> Iterator[Fault]:
    """No body has an inertia with a moment below zero, or above the sum of the other two."""
    if payload.inertia_kg_m2 is None:
        return
    xx, xy, xz, yy, yz, zz = payload.inertia_kg_m2
    least, middle, largest = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    margin = 1e-9 * abs(largest)
    if least < -margin or largest > least + middle + margin:
        yield Fault(
            ("payloads", index, "inertia_kg_m2"),
            f"principal moments {least:.4g}, {middle:.4g}, {largest:.4g} kg m²",
            "those of a body about its centre of mass: none below 0, none above the sum of the other two",
        )
