"""`hold` of a cell file: joints of the URDF that are no axes of the cell, such as a gripper's or a mobile base's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import radians
from xml.etree import ElementTree

from daq.config.cell_schema import CellModel
from daq.config.yaml_file import Document, Fault, fault_texts
from daq.errors import ConfigurationInconsistent
from ident.errors import ModelError
from ident.model.urdf import LINKAGE, Mimic, hold_joints, mimics_of


def held_urdf(document: Document, model: CellModel, urdf: str) -> str:
    """Return the URDF with the joints of `hold` fixed at their positions, the text itself without `hold`.

    Raises:
        ConfigurationInconsistent: a held joint does not exist, is an axis too, mimics a joint that moves,
            or is held where it cannot be.
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
        found, _, expected = str(error).partition("; expected ")
        faults = [Fault(("hold",), found, expected or "joints of the URDF that are no axes, each with its position")]
    if faults:
        raise ConfigurationInconsistent(**fault_texts(document, faults), remedy="correct the cell file")
    return fixed


def _faults(model: CellModel, held: dict[str, float], joints: dict[str, ElementTree.Element]) -> Iterator[Fault]:
    """Find held joints that are axes, and positions that the URDF excludes."""
    for name, position in held.items():
        if name in model.axis_names:
            yield Fault(("hold", name), "a joint that is also one of `axes`", "an axis or a held joint, not both")
        limit = joints[name].find("{*}limit")
        kind = joints[name].get("type")
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


def mimic_faults(axes: Sequence[str], urdf: str) -> Iterator[Fault]:
    """Find joints that mimic another one and still move: the equations give each joint a motion of its own.

    Args:
        axes: names of the axes.
        urdf: text of the URDF, its held joints fixed; a joint that follows a held one is fixed with it.

    Raises:
        ModelError: the URDF cannot be read.
    """
    mimics = mimics_of(urdf)
    for name, mimic in mimics.items():
        found = f"joint {name} mimics {mimic.leader} (multiplier {mimic.multiplier:g})"
        if mimic.at_rest:
            expected = f"`hold` of {name} at its offset, {mimic.offset:g} rad or m: by that multiplier it never moves"
            yield Fault(("robot", "urdf"), found, expected)
            continue
        first = _first_leader(name, mimics)
        if first in axes:
            yield Fault(("robot", "urdf"), found, LINKAGE)
        else:
            expected = f"`hold` of {first} if that is no axis, and {name} follows it; else {LINKAGE}"
            yield Fault(("robot", "urdf"), found, expected)


def _first_leader(name: str, mimics: Mapping[str, Mimic]) -> str:
    """Return the joint at the head of a chain of followers; one of them where they follow each other in a circle."""
    seen = {name}
    leader = mimics[name].leader
    while leader in mimics and leader not in seen:
        seen.add(leader)
        leader = mimics[leader].leader
    return leader
