"""Read a cell file, or the copy of it in a log, as a `Cell`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from math import radians
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from daq.arguments import A_PATH, checks_arguments
from daq.config.cell import MILLIMETRE, Cell, CellAxis, DeclaredEffect, Limits, WeighedPayload
from daq.config.cell_closures import ClosedChain, chain_of, platform_frame
from daq.config.cell_schema import (
    AxisModel,
    CellModel,
    ConditioningModel,
    EffectModel,
    PayloadModel,
    ratio_of,
)
from daq.config.checks import check
from daq.config.drive import drive_from_text
from daq.config.urdf_text import urdf_text
from daq.config.workspace import clearance_of
from daq.config.yaml_file import (
    MAX_BYTES,
    Document,
    Fault,
    fault_texts,
    parse_yaml,
    read_file,
    read_model,
    read_yaml_bytes,
)
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent, ConfigurationMissing
from drivers.profiles.profile import DriveProfile, TapPoint
from ident.data.conditioning import Conditioning
from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS
from ident.model.robot import Place
from ident.model.urdf import PositionLimits, hold_joints, position_limits_of, read_urdf

CELL = "cell.yaml"
URDF = "robot.urdf"
DRIVES = "drives/"


@checks_arguments(path=A_PATH)
def load_cell(path: Path | str) -> Cell:
    """Read a cell file and all it refers to.

    Raises:
        UsageError: the argument is no path.
        ConfigurationError: a file is missing, is not what its schema says, or the cell is
            inconsistent.
    """
    path = Path(path)
    sources = _sources(path)
    names = {name: str(source) for name, source in sources.items()}
    return cell_from_bundle(_read_sources(sources), path, names)


def bundle(path: Path) -> dict[str, bytes]:
    """Read a cell file and all files that it refers to, by fixed names, for a log.

    Raises:
        ConfigurationError: a file is missing, or the cell file is not what its schema says.
    """
    return _read_sources(_sources(path))


def cell_from_bundle(
    files: Mapping[str, bytes], file: Path | None = None, names: Mapping[str, str] | None = None
) -> Cell:
    """Build the cell that a bundle describes.

    Args:
        files: as returned by `bundle`; other entries (a log has more attachments) are ignored.
        file: path of the cell file, None for a log.
        names: names of the files in messages.

    Raises:
        ConfigurationError: a file is missing, is not what its schema says, or the cell is
            inconsistent.
    """
    names = names or {}
    document = parse_yaml(_member(files, CELL, names), names.get(CELL, CELL))
    model = read_model(document, CellModel, None if file is None else file.parent)
    urdf = urdf_text(_member(files, URDF, names), names.get(URDF, URDF))
    members = {drive: f"{DRIVES}{drive}.yaml" for drive in model.drives}
    profiles: dict[str, DriveProfile] = {}
    for drive, member in members.items():
        content = _member(files, member, names)
        profiles[drive] = drive_from_text(content, names.get(member, member))
    urdf = held_urdf(document, model, urdf)
    check(document, model, urdf, profiles, logged=file is None)
    chain = chain_of(model.robot, model.closures, urdf)
    undriven = () if chain is None else chain.undriven_names
    places = [*model.axis_names, *undriven]
    mounted = platform_frame(model.robot, urdf)
    used = {name: files[name] for name in (CELL, URDF, *members.values())}
    recorded = {
        name: _canonical(name, content, names.get(name, name)) for name, content in used.items()
    }
    axes = [_axis(axis, model.bus_of(axis), profiles) for axis in model.axes]
    payloads = [_payload(payload, mounted) for payload in model.payloads]
    effects = [_effect(effect, places) for effect in model.effects]
    joints = _joints(model, chain, urdf)
    folder = None
    history = None
    recalibration = None
    if file is not None:
        folder = file.parent
        controller = None if model.controller is None else model.controller.file
        history = model.history.place(file, controller)
        if model.recalibration is not None:
            recalibration = model.recalibration.recalibration(file)
    return Cell(
        name=model.name,
        urdf=urdf,
        gravity_m_s2=model.robot.gravity_m_s2,
        ratio=ratio_of(model),
        buses=model.buses,
        sync=model.sync,
        axes=tuple(axes),
        payloads=tuple(payloads),
        conditioning=_conditioning(model.conditioning),
        controller=model.controller,
        chain=chain,
        platform=model.robot.platform,
        clearance=clearance_of(model.workspace, model.clearance, joints),
        effects=tuple(effects),
        folder=folder,
        digest=digest(used),
        recording_digest=digest(recorded),
        motion=model.policy.motion,
        unguarded=model.policy.unguarded,
        recovery_motion=model.policy.recovery_motion,
        apply=model.policy.apply,
        friction_by_payload=model.friction_by_payload,
        target_sigma_percent=model.target_sigma_percent,
        history=history,
        recalibration=recalibration,
    )


def held_urdf(document: Document, model: CellModel, urdf: str) -> str:
    """Return the URDF with the joints of `hold` fixed at their positions,
    the text itself without `hold`.

    These are joints that are no axes of the cell, such as a gripper's or a mobile base's.

    Raises:
        ConfigurationInconsistent: a held joint does not exist, is an axis too, mimics a joint that
            moves, or is held where it cannot be.
    """
    if not model.hold:
        return urdf
    try:
        robot = ElementTree.fromstring(urdf)
        joints = {joint.get("name", ""): joint for joint in robot.findall("{*}joint")}
        held = _held_positions(model, joints)
        fixed = hold_joints(urdf, held)
        limits = position_limits_of(urdf)
        faults = [*_hold_faults(model, held, joints, limits)]
    except ElementTree.ParseError:
        return urdf  # the check of the robot says so
    except ModelError as error:
        found, _, expected = str(error).partition("; expected ")
        if not expected:
            expected = "joints of the URDF that are no axes, each with its position"
        faults = [Fault(("hold",), found, expected)]
    if faults:
        texts = fault_texts(document, faults)
        raise ConfigurationInconsistent(**texts, remedy="correct the cell file")
    return fixed


def _held_positions(model: CellModel, joints: dict[str, ElementTree.Element]) -> dict[str, float]:
    """Return the positions of the held joints [rad; m if prismatic]."""
    held = {}
    for name, position in model.hold.items():
        joint = joints.get(name)
        is_prismatic = joint is not None and joint.get("type") == "prismatic"
        held[name] = position if is_prismatic else radians(position)
    return held


def _hold_faults(
    model: CellModel,
    held: dict[str, float],
    joints: dict[str, ElementTree.Element],
    limits_by_joint: Mapping[str, PositionLimits],
) -> Iterator[Fault]:
    """Find held joints that are axes, and positions that the URDF excludes."""
    for name, position in held.items():
        if name in model.axis_names:
            yield Fault(
                ("hold", name),
                "a joint that is also one of `axes`",
                "an axis or a held joint, not both",
            )
        limits = limits_by_joint.get(name)
        if limits is None or limits.range is None:
            continue  # a held joint's limits are needed for this check alone
        lower, upper = limits.range
        margin = 0.01 * (upper - lower)
        is_inside = lower - margin <= position <= upper + margin
        if not is_inside:
            kind = joints[name].get("type")
            if kind == "prismatic":
                in_si = 1.0
                unit = "m"
            else:
                in_si = radians(1.0)
                unit = "deg"
            allowed = f"{lower / in_si:.4g} to {upper / in_si:.4g} {unit}"
            found = f"{model.hold[name]:g} {unit}"
            yield Fault(("hold", name), found, f"{allowed}, the limits in the URDF")


def bundle_digest(files: Mapping[str, bytes]) -> str:
    """Return the `Cell.digest` of the cell that a bundle describes.

    The EDS files are not in it: they check a profile, and no cell depends on them.
    """
    used = {name: content for name, content in files.items() if not name.endswith(".eds")}
    return digest(used)


def digest(files: Mapping[str, bytes]) -> str:
    """Return the sha256 over names and contents, in the order of the names, hex."""
    total = hashlib.sha256()
    for name in sorted(files):
        content = files[name]
        total.update(f"{name}\0{len(content)}\0".encode())
        total.update(content)
    return total.hexdigest()


_AFTERWARDS = ("policy", "history", "recalibration", "target_sigma_percent")
"""Keys for the use of a calibration, and for the end of a recording;
no recording and no fit depends on them.
"""
_BOUNDS = ("rated_payload_kg",)
"""Keys of `robot` that only bound others; no recording and no fit depends on them."""
_SLOW_READINGS = ("torque", "temperature")
"""Keys of a drive profile for what is read alongside the samples;
samples and gains do not depend on them.
"""


def _canonical(member: str, content: bytes, name: str) -> bytes:
    """Content without its layout: comments, line breaks and the order of keys do not count."""
    if member == URDF:
        return content
    tree = parse_yaml(content, name).tree
    if member == CELL:
        tree = _without(tree, _AFTERWARDS)
        tree["robot"] = _without(tree["robot"], _BOUNDS)
    elif member.startswith(DRIVES) and member.endswith(".yaml"):
        tree = _without(tree, _SLOW_READINGS)
        if tree.get("facts"):
            tree["facts"] = _without(tree["facts"], _SLOW_READINGS)
    return json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()


def _without(tree: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in tree.items() if key not in keys}


def urdf_path(path: Path) -> Path:
    """Return the URDF that a cell file names.

    Raises:
        ConfigurationError: the cell file is missing, or is not what its schema says.
    """
    return _sources(path)[URDF]


def _sources(path: Path) -> dict[str, Path]:
    """Locate the members of a cell's bundle on disk."""
    model = read_model(parse_yaml(read_yaml_bytes(path), str(path)), CellModel)
    sources = {CELL: path, URDF: path.parent / model.robot.urdf}
    for drive in model.drives:
        profile = sources[f"{DRIVES}{drive}.yaml"] = drive_path(path.parent, drive)
        tree = parse_yaml(read_yaml_bytes(profile), str(profile)).tree
        # The schema is checked later
        eds = tree.get("eds") if isinstance(tree, dict) else None
        if isinstance(eds, str) and eds:
            sources[f"{DRIVES}{drive}.eds"] = profile.parent / eds
    return sources


def _read_sources(sources: Mapping[str, Path]) -> dict[str, bytes]:
    """Read the cell file and what belongs to it.

    Raises:
        ConfigurationMissing: a file cannot be read. Where a cell file was copied alone, the others
            are missing, so the message says to copy them.
    """
    cell_file = sources[CELL]
    content = {CELL: read_yaml_bytes(cell_file)}
    for name, source in sources.items():
        if name == CELL:
            continue
        content[name] = read_file(
            source,
            ConfigurationMissing,
            expected=f"a file that belongs to {cell_file}, of at most {MAX_BYTES} bytes",
            remedy=f"copy it to this place, or correct its name in {cell_file.name} or in the "
            "drive profile; a name is relative to the file that has it",
        )
    return content


def drive_path(folder: Path, drive: str) -> Path:
    """Find a profile next to the cell (drives/ or ../drives/), else the shipped one."""
    file = f"{drive}.yaml"
    candidates = (
        folder / "drives" / file,
        folder.parent / "drives" / file,
        shipped_configurations() / "drives" / file,
    )
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    shipped_profiles = candidates[-1].parent.glob("*.yaml")
    shipped = ", ".join(sorted(entry.stem for entry in shipped_profiles))
    tried = ", ".join(map(str, candidates))
    raise ConfigurationMissing(
        f"drive profile {drive!r}",
        found=f"no file {tried}",
        expected=f"a profile next to the cell, or a shipped one ({shipped})",
        remedy="correct the axis's `drive`, or write the profile",
    )


def _member(files: Mapping[str, bytes], member: str, names: Mapping[str, str]) -> bytes:
    if member in files:
        return files[member]
    available = ", ".join(sorted(files)) or "nothing"
    raise ConfigurationMissing(
        names.get(member, member),
        found=f"only {available}",
        expected=f"{member} among the files of the cell",
        remedy="the log or bundle is incomplete; record or import it again",
    )


def _axis(model: AxisModel, bus: str | None, profiles: Mapping[str, DriveProfile]) -> CellAxis:
    limits = model.limits
    unit = limits.unit
    # The checks require that it matches the kind of joint
    ((key, gain),) = model.nameplate_gains.items()
    force = "N" if key == "nameplate_gain_n_per_a" else "Nm"
    profile = None if model.drive is None else profiles[model.drive]
    # A gain by the actual current is another quantity, so its unit must show it.
    if profile is not None and profile.tap is TapPoint.ACTUAL:
        ampere = "A(actual)"
    else:
        ampere = "A"
    lower, upper = limits.position
    return CellAxis(
        name=model.name,
        node_id=model.node_id,
        drive=model.drive,
        profile=profile,
        identity=model.identity,
        bus=bus,
        counts_per_revolution=model.counts_per_revolution,
        unit=unit,
        zero_offset_rad=unit.si * model.zero_offsets.get(unit, 0.0),
        nameplate_gain=gain,
        gain_unit=model.gain_unit or f"{force}/{ampere}",
        limits=Limits(
            position=(unit.si * lower, unit.si * upper),
            velocity=unit.si * limits.velocity,
            acceleration=unit.si * limits.acceleration,
        ),
    )


def _conditioning(model: ConditioningModel) -> Conditioning:
    """Merge the two lists of standstill speeds;
    the checks guarantee that each joint is in the list of its kind.
    """
    millimetres = model.standstill_mm_s or (None,) * len(model.standstill_rad_s)
    radians = model.standstill_rad_s or (None,) * len(millimetres)
    rest = model.model_dump(exclude={"standstill_rad_s", "standstill_mm_s"})
    speeds = []
    for revolute_rad_s, prismatic_mm_s in zip(radians, millimetres, strict=True):
        if revolute_rad_s is not None:
            speeds.append(revolute_rad_s)
        else:
            speeds.append(MILLIMETRE.si * (prismatic_mm_s or 0.0))
    return Conditioning(**rest, standstill_rad_s=tuple(speeds))


def _joints(model: CellModel, chain: ClosedChain | None, urdf: str) -> dict[str, int]:
    """Return the index of the joint behind each axis,
    and behind each joint of a closed chain without a motor.
    """
    if chain is None:
        return {name: index for index, name in enumerate(model.axis_names)}
    joint_names = [joint.name for joint in read_urdf(urdf).joints]
    indices = {
        joint_name: index
        for index, joint_name in enumerate(joint_names)
        if joint_name not in chain.motors
    }
    for axis_name, motor in zip(model.axis_names, chain.motors, strict=True):
        indices[axis_name] = joint_names.index(motor)
    return indices


def _effect(effect: EffectModel, places: Sequence[str]) -> DeclaredEffect:
    return DeclaredEffect(effect.name, places.index(effect.axis), dict(effect.settings))


def _payload(model: PayloadModel, mounted: Place) -> WeighedPayload:
    known = model.known_parameters
    if model.centre_m is not None:
        centre_m, inertia = _in_joint_frame(mounted, model.centre_m, model.inertia_kg_m2)
        known = drawn_parameters(model.mass_kg, centre_m, inertia)
    return WeighedPayload(model.name, model.mounting, model.mass_kg, model.mass_tolerance_kg, known)


def _in_joint_frame(
    mounted: Place, centre_m: tuple[float, ...], about_centre_kg_m2: tuple[float, ...] | None
) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Write centre of mass and inertia about it, both in a link's frame,
    in the frame of the joint that moves it.
    """
    turned = mounted.rotation
    centre = mounted.translation_m + turned @ np.array(centre_m)
    if about_centre_kg_m2 is None:
        return tuple(centre.tolist()), None
    upper = np.triu_indices(3)
    inertia = np.zeros((3, 3))
    inertia[upper] = about_centre_kg_m2
    inertia += np.triu(inertia, 1).T  # symmetric
    inertia = turned @ inertia @ turned.T
    return tuple(centre.tolist()), tuple(inertia[upper].tolist())


def drawn_parameters(
    mass_kg: float, centre_m: tuple[float, ...], about_centre_kg_m2: tuple[float, ...] | None
) -> dict[str, float]:
    """Return first moments and, if given, the inertia about the frame's origin (Steiner),
    by LINK_PARAMETERS names.

    Args:
        mass_kg: mass of the body.
        centre_m: centre of mass, shape (3,).
        about_centre_kg_m2: xx, xy, xz, yy, yz, zz about the centre of mass, in the directions of
            the frame.
    """
    centre = np.array(centre_m)
    first_moments = mass_kg * centre
    known = dict(zip(("mx", "my", "mz"), first_moments.tolist(), strict=True))
    if about_centre_kg_m2 is not None:
        # I = I_c + m (c·c 1 − c cᵀ)
        square = centre @ centre * np.eye(3)
        steiner = mass_kg * (square - np.outer(centre, centre))
        inertia = np.array(about_centre_kg_m2) + steiner[np.triu_indices(3)]
        known |= dict(zip(LINK_PARAMETERS[:6], inertia.tolist(), strict=True))
    return known
