"""`hold` of a cell file: joints of the URDF that are no axes of the cell, such as a gripper's or a mobile base's."""

from __future__ import annotations

from collections.abc import Iterator
from math import radians
from xml.etree import ElementTree

from daq.config.cell_schema import CellModel
from daq.config.yaml_file import Document, Fault, describe
from daq.errors import ConfigurationInconsistent
from ident.errors import ModelError
from ident.model.urdf import hold_joints


def held_urdf(document: Document, model: CellModel, urdf: str) -> str:
    """Return the URDF with the joints of `hold` fixed at their positions, the text itself without `hold`.

    Raises:
        ConfigurationInconsistent: a held joint does not exist, is an axis too, or is held where it cannot be.
    """
    if not model.hold:
        return urdf
    try:
        joints = {joint.get("name", ""): joint for joint in ElementTree.fromstring(urdf).findall("{*}joint")}
        prismatic = {name for name, joint in joints.items() if joint.get("type") == "prismatic"}
        held = {name: at if name in prismatic else radians(at) for name, at in model.hold.items()}
        fixed = hold_joints(urdf, held)
        faults = [*_faults(model, held, joints)]
    except ElementTree.ParseError:
        return urdf  # the check of the robot says so
    except ModelError as error:
        faults = [Fault(("hold",), str(error), "joints of the URDF that are no axes, each with its position")]
    if faults:
        raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the cell file")
    return fixed


def _faults(model: CellModel, held: dict[str, float], joints: dict[str, ElementTree.Element]) -> Iterator[Fault]:
    """Find held joints that are axes, and positions that the URDF excludes."""
    for name, position in held.items():
        if name in {axis.name for axis in model.axes}:
            yield Fault(("hold", name), "a joint that is also one of `axes`", "an axis or a held joint, not both")
        limit, kind = joints[name].find("{*}limit"), joints[name].get("type")
        if limit is None or kind == "continuous":
            continue
        try:
            lower, upper = (float(limit.get(end, "0")) for end in ("lower", "upper"))
        except ValueError:
            continue  # a held joint's limits are needed for this check alone
        margin = 0.01 * (upper - lower)
        if lower < upper and not lower - margin <= position <= upper + margin:
            unit, spelled = (1.0, "m") if kind == "prismatic" else (radians(1.0), "deg")
            expected = f"{lower / unit:.4g} to {upper / unit:.4g} {spelled}, the limits in the URDF"
            yield Fault(("hold", name), f"{model.hold[name]:g} {spelled}", expected)
