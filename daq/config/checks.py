"""Find contradictions in a cell file of well-formed values:
robot, drive train, axes, buses, SYNC, payloads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, sqrt
from xml.etree import ElementTree

import numpy as np

from daq.config.cell import DEGREE, MILLIMETRE, joint_unit
from daq.config.cell_buses import bus_faults, producer_faults
from daq.config.cell_closures import (
    chain_faults,
    chain_of,
    mechanism_faults,
    platform_frame,
    robot_with,
)
from daq.config.cell_schema import AxisModel, CellModel, gain_joints, ratio_of
from daq.config.controller import controller_faults
from daq.config.policy import max_change_faults, signer_faults
from daq.config.workspace import clearance_faults
from daq.config.yaml_file import Document, Fault, Location, fault_texts
from daq.errors import ConfigurationInconsistent
from drivers.profiles.profile import DriveProfile
from ident.errors import ModelError
from ident.model.robot import Joint, JointKind, Robot
from ident.model.urdf import first_leader, mimics_of, position_limits_of, read_urdf
from ident.plausible import (
    ACCELERATION,
    FARTHEST_CENTRE_M,
    FARTHEST_DEG,
    FARTHEST_MM,
    GAIN,
    GRAVITY_M_S2,
    HEAVIEST_PAYLOAD_KG,
    LARGEST_GYRATION_M,
    LIGHTEST_PAYLOAD_KG,
    PAYLOAD_RATIO,
    RATIO,
    RAW_GAIN,
    SHORTEST_DEG,
    SHORTEST_MM,
    SHORTEST_OF_ALL_DEG,
    SMALLEST_COUPLING,
    SPEED,
    TOLERANCE_SHARE,
    range_text,
    within,
)

OTHER_JOINT = "is of type"  #: Of the reader's message about a joint that can be no axis
#: Largest condition number of R; above it, joint positions do not follow from motor positions
LARGEST_CONDITION = 1e8


def check(
    document: Document,
    model: CellModel,
    urdf: str,
    profiles: Mapping[str, DriveProfile],
    *,
    logged: bool = False,
) -> None:
    """Refuse a cell that contradicts itself.

    Args:
        document: the cell file, for the lines.
        model: its content.
        urdf: text of its robot.
        profiles: drive profiles, by name.
        logged: the file is a log's copy, which cannot be corrected: typing mistakes are left to the
            diagnoses of a fit.

    Raises:
        ConfigurationInconsistent: with every contradiction and its line.
    """
    robot = None
    if logged:
        faults = []
    else:
        faults = [*mechanism_faults(model.closures, urdf)]
    if not faults:
        robot, faults = _robot(model, urdf)
    joints = () if robot is None else robot.axes
    passive = () if robot is None else robot.passive_names
    names = model.axis_names
    faults += [
        *_ratio_faults(model),
        *bus_faults(model, profiles),
        *producer_faults(model),
        *_axis_faults(model, joints),
        *_list_faults(model),
        *_effect_faults(model, robot, logged=logged),
        *signer_faults(model.policy.apply.signers),
        *clearance_faults(model.workspace, model.clearance, [*names, *passive]),
        *max_change_faults(model.policy.apply, names),
    ]
    if not logged:
        faults += [
            *_mass_faults(model),
            *_size_faults(model),
            *_range_faults(model),
            *_si_faults(model, urdf),
        ]
        faults += _order_faults(model, joints)
        if robot is not None:
            faults += _follower_limit_faults(urdf)
    if robot is not None:
        faults += _frame_faults(model, urdf)
    if faults:
        is_of_urdf = any(fault.path == ("robot", "urdf") for fault in faults)
        remedy = "correct the cell file"
        if is_of_urdf:
            remedy += ", or the URDF that it names"
        raise ConfigurationInconsistent(**fault_texts(document, faults), remedy=remedy)


def _robot(model: CellModel, urdf: str) -> tuple[Robot | None, list[Fault]]:
    """Return the robot, None if it cannot be read or its loops do not close,
    and the faults of it as a whole.
    """
    faults = []
    gravity = hypot(*model.robot.gravity_m_s2)
    if not GRAVITY_M_S2[0] < gravity < GRAVITY_M_S2[1]:
        found = f"{gravity:.4g} m/s² in all"
        expected = f"{range_text(GRAVITY_M_S2)} m/s², as anywhere on Earth"
        faults.append(Fault(("robot", "gravity_m_s2"), found, expected))
    axes = model.axis_names
    try:
        of_urdf = _urdf_faults(model, urdf)
        if of_urdf:
            return None, faults + of_urdf
        chain = chain_of(model.robot, model.closures, urdf)
        robot = robot_with(chain, urdf, model.robot.gravity_m_s2, model.robot.platform)
    except ModelError as error:
        found, _, expected = str(error).partition("; expected ")
        # The place is that of the cell file, which only names it
        found = f"{model.robot.urdf}: {found}"
        expected = f"a URDF of an arm: {expected}" if expected else "a URDF of an arm"
        if OTHER_JOINT in found:
            expected += "; `hold: {JOINT: POSITION}` fixes a joint that is no axis"
        return None, [*faults, Fault(("robot", "urdf"), found, expected)]
    names = [joint.name for joint in robot.axes]
    more = len(names) - len(axes)
    if more and model.closures:
        found = f"{len(names)} joints for {len(axes)} axes"
        expected = f"the joint of each axis, in their order ({', '.join(axes)})"
        faults.append(Fault(("robot", "motors"), found, expected))
    elif more:
        expected = f"one for each moving joint of the URDF ({', '.join(names)})"
        if more > 0:
            others = [name for name in names if name not in axes]
            unmoved = others[-more:]
            held = ", ".join(f"{name}: 0.0" for name in unmoved)
            expected += (
                "; joints that are no axes are held at a position [deg; m if prismatic]: "
                f"`hold: {{{held}}}`"
            )
        faults.append(Fault(("axes",), f"{len(axes)} axes", expected))
    for index, name in enumerate(axes[: len(model.robot.motors)]):
        # Either the list has the wrong joint or the axis the wrong name; both cannot stay: an
        # effect may name either.
        if name in robot.passive_names:
            joint = model.robot.motors[index]
            found = f"{joint} as the joint of axis {name}, and joint {name} without a motor"
            expected = f"{name}, or another name of that axis (`axes[{index}].name`)"
            faults.append(Fault(("robot", "motors", index), found, expected))
    return robot, faults


def _urdf_faults(model: CellModel, urdf: str) -> list[Fault]:
    """Find what keeps a URDF from being read as the robot of the axes;
    the first kind of fault alone.
    """
    if not urdf.strip():
        return [Fault(("robot", "urdf"), "an empty file", "a URDF of an arm")]
    faults = [*mimic_faults(model.axis_names, urdf)]
    if faults:
        return faults
    return [*chain_faults(model.robot, model.closures, urdf)]


def mimic_faults(axes: Sequence[str], urdf: str) -> Iterator[Fault]:
    """Find joints that mimic another one and follow no axis:
    such a joint stays, or its leader has to be held.

    Args:
        axes: names of the axes.
        urdf: text of the URDF, its held joints fixed; a joint that follows a held one is fixed with
            it.

    Raises:
        ModelError: the URDF cannot be read, or joints mimic each other.
    """
    mimics = mimics_of(urdf)
    if not mimics:
        return
    leaders = [joint.name for joint in read_urdf(urdf).joints if joint.name not in mimics]
    for name, mimic in mimics.items():
        found = f"joint {name} mimics {mimic.leader} (multiplier {mimic.multiplier:g})"
        if mimic.at_rest:
            expected = (
                f"`hold` of {name} at its offset, {mimic.offset:g} rad or m: by that "
                "multiplier it never moves"
            )
            yield Fault(("robot", "urdf"), found, expected)
            continue
        first = first_leader(name, mimics).leader
        # Axes may have other names than their joints, so names count only where there are joints
        # without an axis.
        has_other_joints = len(leaders) > len(axes)
        if first not in leaders or (has_other_joints and first not in axes):
            expected = (
                f"`hold` of {first} if that is no axis, and {name} follows it; else an axis of "
                f"{first}"
            )
            yield Fault(("robot", "urdf"), found, expected)


def _follower_limit_faults(urdf: str) -> Iterator[Fault]:
    """Find followers whose limits say nothing because they contradict themselves: a plan could not
    keep them.
    """
    mimics = mimics_of(urdf)
    for name, limits in position_limits_of(urdf).items():
        if name in mimics and limits.are_contradictory:
            found = f"joint {name}, which mimics {mimics[name].leader}, with the limits {limits}"
            expected = "numbers, the lower one first: a plan keeps the limits of a follower"
            yield Fault(("robot", "urdf"), found, expected)


def _order_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    """Find axes with the name of another axis's joint:
    they are in another order than their joints.
    """
    driven = [joint.name for joint in joints]
    if len(driven) != len(model.axes):
        return
    for index, (axis, joint) in enumerate(zip(model.axes, driven, strict=True)):
        if axis.name != joint and axis.name in driven:
            path: Location = ("axes", index, "name")
            if model.robot.motors:
                path = ("robot", "motors", index)
            found = (
                f"{joint} as the joint of axis {axis.name}, and {axis.name} as that of another axis"
            )
            expected = f"{axis.name}, or another name of that axis (`axes[{index}].name`)"
            yield Fault(path, found, expected)


def _ratio_faults(model: CellModel) -> Iterator[Fault]:
    path = ("drive_train", "ratio")
    ratio = model.drive_train.ratio
    n = len(model.axes)
    if len(ratio) != n or any(len(row) != n for row in ratio):
        widths = sorted({len(row) for row in ratio})
        listed = ", ".join(map(str, widths))
        shape = f"{len(ratio)} rows of {listed} numbers"
        yield Fault(path, shape, f"{n} × {n}, a row for each motor")
        return
    implausible = False
    for motor, row in enumerate(np.abs(ratio_of(model)).tolist()):
        has_small_coupling = any(0.0 < number < SMALLEST_COUPLING for number in row)
        has_other_reduction = any(row) and not within(max(row), RATIO)
        if has_small_coupling or has_other_reduction:
            implausible = True
            numbers = [f"{number:g}" for number in ratio[motor]]
            found = ", ".join(numbers)
            expected = (
                f"a reduction of {RATIO[0]:g} to {RATIO[1]:g} rad/rad (rad/m), and no "
                "smaller coupling than "
            )
            yield Fault((*path, motor), found, f"{expected}{SMALLEST_COUPLING:g}")
    if implausible:
        return
    condition = float(np.linalg.cond(ratio_of(model)))
    if not np.isfinite(condition) or condition > LARGEST_CONDITION:
        yield Fault(
            path, f"a singular matrix (condition {condition:.3g})", "one that can be inverted"
        )
    free = model.robot.mobility
    motors = len(model.robot.motors)
    if free is None or motors <= free:
        return
    for motor, row in enumerate(ratio):
        others = []
        for joint, axis in enumerate(model.axes):
            if joint != motor and row[joint] != 0.0:
                others.append(axis.name)
        if others:  # the rule of ident.model.model.Model
            listed = ", ".join(others)
            found = f"the motor of {model.axes[motor].name} also turns with {listed}"
            expected = f"zeros off the diagonal: {motors} motors for {free} degrees of freedom"
            yield Fault((*path, motor), found, expected)


def _list_faults(model: CellModel) -> Iterator[Fault]:
    n = len(model.axes)
    names = Counter(model.axis_names)
    for index, axis in enumerate(model.axes):
        if names[axis.name] > 1:
            found = f"{axis.name}, used {names[axis.name]} times"
            yield Fault(("axes", index, "name"), found, "each name once")
    if model.controller is not None:
        have_nodes = all(axis.node_id is not None and axis.drive for axis in model.axes)
        on_a_bus = bool(model.buses) and have_nodes
        yield from controller_faults(model.controller, n, on_a_bus=on_a_bus)
    mountings = Counter(payload.mounting for payload in model.payloads)
    for index, payload in enumerate(model.payloads):
        if payload.mass_kg <= 0:
            yield Fault(
                ("payloads", index, "mass_kg"), f"{payload.mass_kg:g}", "a positive mass [kg]"
            )
        elif payload.mass_tolerance_kg > TOLERANCE_SHARE * payload.mass_kg:
            found = f"{payload.mass_tolerance_kg:g} kg for {payload.mass_kg:g} kg"
            expected = "at most a tenth of the mass: it is in every gain"
            yield Fault(("payloads", index, "mass_tolerance_kg"), found, expected)
        if mountings[payload.mounting] > 1:
            found = f"{payload.mounting}, used {mountings[payload.mounting]} times"
            path = ("payloads", index, "mounting")
            yield Fault(
                path,
                found,
                "each mounting a name of its own: it denotes one body in one place",
            )
        if payload.inertia_kg_m2 is not None:
            yield from moment_faults(("payloads", index, "inertia_kg_m2"), payload.inertia_kg_m2)


def _effect_faults(model: CellModel, robot: Robot | None, *, logged: bool) -> Iterator[Fault]:
    """Find effects that are nowhere or twice in one place;
    in a file, also those that cannot be there.

    A log is read whatever its effects are: the fit refuses those that cannot be.
    """
    if not model.effects:
        return
    from daq.config.effects import place_effect  # noqa: PLC0415 - loads scipy, which cells without effects do not need

    undriven = () if robot is None else robot.undriven_names
    names = [*model.axis_names, *undriven]
    placed = [(effect.name, effect.axis) for effect in model.effects]
    is_chain_unknown = bool(model.closures) and not undriven
    for index, effect in enumerate(model.effects):
        if effect.axis not in names and not is_chain_unknown:
            known = ", ".join(names)
            yield Fault(("effects", index, "axis"), repr(effect.axis), f"one of {known}")
        elif placed.index((effect.name, effect.axis)) < index:
            found = f"{effect.name} on {effect.axis} twice"
            yield Fault(("effects", index), found, "each effect once on an axis")
        elif not logged and robot is not None and len(names) == len(robot.places):
            place = names.index(effect.axis)
            placed_effect = place_effect(effect.name, place, effect.settings, robot)
            if isinstance(placed_effect, Fault):
                yield replace(placed_effect, path=("effects", index, *placed_effect.path))


def _frame_faults(model: CellModel, urdf: str) -> Iterator[Fault]:
    """Find single parameters of a payload in the frame of a platform's link,
    where only all of them can be turned.
    """
    mounted = platform_frame(model.robot, urdf)
    if np.allclose(mounted.rotation, np.eye(3)) and not mounted.translation_m.any():
        return
    for index, payload in enumerate(model.payloads):
        if payload.known is not None:
            found = (
                f"single parameters, and the link {model.robot.platform} is not at the origin "
                "of its joint"
            )
            expected = "`centre_m` and `inertia_kg_m2`, in the frame of that link"
            yield Fault(("payloads", index, "known"), found, expected)


def _mass_faults(model: CellModel) -> Iterator[Fault]:
    """Find payloads that this robot cannot carry, and masses in g among those in kg."""
    rated_kg = model.robot.rated_payload_kg
    masses_kg = [payload.mass_kg for payload in model.payloads if payload.mass_kg > 0]
    lightest_kg = min(masses_kg, default=0.0)
    for index, payload in enumerate(model.payloads):
        path = ("payloads", index, "mass_kg")
        found = f"{payload.mass_kg:g} kg"
        if rated_kg is not None and payload.mass_kg > rated_kg:
            yield Fault(path, found, f"at most the {rated_kg:g} kg of `robot.rated_payload_kg`")
        elif rated_kg is None and payload.mass_kg > HEAVIEST_PAYLOAD_KG:
            expected = (
                f"at most {HEAVIEST_PAYLOAD_KG:g} kg, or a `robot.rated_payload_kg`; is this in g?"
            )
            yield Fault(path, found, expected)
        elif 0.0 < payload.mass_kg < LIGHTEST_PAYLOAD_KG:
            yield Fault(path, found, f"at least {LIGHTEST_PAYLOAD_KG:g} kg; is this in t?")
        elif payload.mass_kg > PAYLOAD_RATIO * lightest_kg > 0.0:
            found += f", {payload.mass_kg / lightest_kg:.3g} times another payload"
            yield Fault(path, found, f"at most {PAYLOAD_RATIO:g} times; is one of them in g?")


def _size_faults(model: CellModel) -> Iterator[Fault]:
    """Find payloads that are larger than any arm carries: mm for m, kg mm² for kg m²."""
    for index, payload in enumerate(model.payloads):
        path: Location = ("payloads", index)
        mass_kg = payload.mass_kg if payload.mass_kg > 0.0 else np.inf
        if payload.centre_m is not None:
            yield from centre_faults((*path, "centre_m"), payload.centre_m)
        if payload.inertia_kg_m2 is not None:
            yield from gyration_faults((*path, "inertia_kg_m2"), payload.inertia_kg_m2, mass_kg)
        for name, value in payload.known_parameters.items():
            if name.startswith("I"):
                yield from gyration_faults((*path, "known", name), (value,), mass_kg)
            else:
                yield from centre_faults((*path, "known", name), (value / mass_kg,))


_OVERFLOWS = 1e100  #: Moments of inertia whose eigenvalues may overflow


def centre_faults(path: Location, centre_m: Sequence[float]) -> Iterator[Fault]:
    """Find a centre of mass in mm."""
    far_m = hypot(*centre_m)
    if not within(far_m, (0.0, FARTHEST_CENTRE_M)):
        found = f"a centre of mass {far_m:.4g} m from the origin"
        yield Fault(path, found, f"at most {FARTHEST_CENTRE_M:g} m; is this in mm?")


def gyration_faults(
    path: Location, inertia_kg_m2: Sequence[float], mass_kg: float
) -> Iterator[Fault]:
    """Find an inertia in kg mm², by its radius of gyration √(I/m)."""
    radius_m = sqrt(max(map(abs, inertia_kg_m2)) / mass_kg)
    if not within(radius_m, (0.0, LARGEST_GYRATION_M)):
        found = f"a radius of gyration √(I/m) of {radius_m:.4g} m"
        yield Fault(path, found, f"at most {LARGEST_GYRATION_M:g} m; is this in kg mm²?")


def moment_faults(path: Location, inertia_kg_m2: Sequence[float]) -> Iterator[Fault]:
    """Find inertias of no body: a principal moment below zero, or above the sum of the other two.

    Args:
        path: of the inertia.
        inertia_kg_m2: xx, xy, xz, yy, yz, zz about the centre of mass.
    """
    if not max(map(abs, inertia_kg_m2)) < _OVERFLOWS:
        return  # `gyration_faults` refuses it
    xx, xy, xz, yy, yz, zz = inertia_kg_m2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    least, middle, largest = np.linalg.eigvalsh(inertia)
    margin = 1e-9 * abs(largest)
    if least < -margin or largest > least + middle + margin:
        found = f"principal moments {least:.4g}, {middle:.4g}, {largest:.4g} kg m²"
        yield Fault(
            path,
            found,
            "those of a body about its centre of mass: none below 0, none above the sum of the "
            "other two",
        )


@dataclass(frozen=True, slots=True)
class _Plausible:
    """Positions that a joint can have, in its unit."""

    farthest: float  #: largest position
    too_far: str  #: most likely unit of a larger one
    shortest: float  #: smallest range
    too_short: str  #: most likely unit of a smaller one


_PLAUSIBLE = {
    DEGREE: _Plausible(FARTHEST_DEG, "counts or motor degrees", SHORTEST_DEG, "revolutions"),
    MILLIMETRE: _Plausible(FARTHEST_MM, "counts or µm", SHORTEST_MM, "m"),
}


@dataclass(frozen=True, slots=True)
class _UrdfLimits:
    """Limits of a joint by the URDF, in SI."""

    #: lower and upper end [rad or m]; None for a continuous joint
    position: tuple[float, float] | None
    velocity: float  #: largest speed [rad/s or m/s]; 0 if it is not given


def _axis_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    """Find axes that contradict themselves or their joint of the URDF."""
    for index, axis in enumerate(model.axes):
        path: Location = ("axes", index)
        if index < len(joints):
            yield from _kind_faults(path, axis, joints[index])
        key = f"position_{axis.limits.unit.name}"
        yield from _limit_faults((*path, "limits", key), axis)
        for unit, offset in axis.zero_offsets.items():
            farthest = _PLAUSIBLE[unit].farthest
            if abs(offset) > farthest:
                key = f"zero_offset_{unit.name}"
                expected = f"at most ±{farthest:g} {unit.name}"
                yield Fault((*path, key), f"{offset:g}", expected)
    yield from _gain_faults(model, joints)
    yield from _standstill_faults(model, joints)


def _kind_faults(path: Location, axis: AxisModel, joint: Joint) -> Iterator[Fault]:
    """Find degrees for a prismatic joint, and mm for a revolute one."""
    unit = joint_unit(joint.kind)
    written = axis.limits.unit
    what = f"joint {joint.name} of the URDF is {joint.kind.value}"
    if written is not unit:
        name = unit.name
        expected = f"position_{name}, velocity_{name}_s and acceleration_{name}_s2"
        yield Fault((*path, "limits"), f"limits in {written.name}, and {what}", expected)
    for other in axis.zero_offsets:
        if other is not unit:
            key = f"zero_offset_{other.name}"
            yield Fault((*path, key), f"{other.name}, and {what}", f"zero_offset_{unit.name}")
    if axis.lead_mm is not None and joint.kind is not JointKind.PRISMATIC:
        yield Fault(
            (*path, "lead_mm"), f"a lead, and {what}", "nothing: only a prismatic joint has a lead"
        )


def _gain_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    try:
        gained = gain_joints(ratio_of(model))
    except ValueError:
        gained = ()  # _ratio_faults refuses the drive train
    for index, axis in enumerate(model.axes):
        ((key, gain),) = axis.nameplate_gains.items()
        if not gain:
            expected = "the nameplate gain of the data sheet, signed, not zero"
            yield Fault(("axes", index, key), "0", expected)
        if index >= len(gained) or gained[index] >= len(joints):
            continue
        joint = joints[gained[index]]
        force = joint_unit(joint.kind).force
        written = {"nameplate_gain_nm_per_a": "Nm", "nameplate_gain_n_per_a": "N"}.get(key)
        if written is None:
            key = "gain_unit"
            written = (axis.gain_unit or "").partition("/")[0].strip()
        if written in {"Nm", "N"} and written != force:
            kind = joint.kind.value
            found = f"a gain in {written}, and it acts on joint {joint.name}, which is {kind}"
            expected = f"{force} per unit of the current reference"
            yield Fault(("axes", index, key), found, expected)


def _limit_faults(path: Location, axis: AxisModel) -> Iterator[Fault]:
    lower, upper = axis.limits.position
    unit = axis.limits.unit
    plausible = _PLAUSIBLE[unit]
    found = f"[{lower:g}, {upper:g}] {unit.name}"
    if lower >= upper:
        yield Fault(path, found, "the lower limit first")
    elif max(abs(lower), abs(upper)) > plausible.farthest:
        expected = f"at most ±{plausible.farthest:g} {unit.name}; are these {plausible.too_far}?"
        yield Fault(path, found, expected)
    elif upper - lower < plausible.shortest:
        smallest = f"{plausible.shortest:g} {unit.name}"
        expected = f"a range of at least {smallest}; are these {plausible.too_short}?"
        yield Fault(path, found, expected)


def _range_faults(model: CellModel) -> Iterator[Fault]:
    """Find speeds, accelerations and gains that no axis has."""
    for index, axis in enumerate(model.axes):
        unit = axis.limits.unit.name
        ((key, gain),) = axis.nameplate_gains.items()
        path: Location = ("axes", index)
        speed_path = (*path, "limits", f"velocity_{unit}_s")
        yield from _outside(speed_path, axis.limits.velocity, SPEED, f"{unit}/s")
        acceleration_path = (*path, "limits", f"acceleration_{unit}_s2")
        acceleration = axis.limits.acceleration
        yield from _outside(acceleration_path, acceleration, ACCELERATION, f"{unit}/s²")
        gain_bounds = RAW_GAIN if key == "nameplate_gain" else GAIN
        yield from _outside((*path, key), abs(gain), gain_bounds, "in size")


def _outside(
    path: Location, value: float, bounds: tuple[float, float], unit: str
) -> Iterator[Fault]:
    """Find a number outside its bounds; zero is another fault."""
    if value != 0.0 and not within(value, bounds):
        yield Fault(path, f"{value:g} {unit}", f"{bounds[0]:g} to {bounds[1]:g} {unit}")


def _si_faults(model: CellModel, urdf: str) -> Iterator[Fault]:
    """Find limits in rad or m: the numbers of the URDF,
    or no revolute axis with a range of some degrees.
    """
    limits = _urdf_limits(urdf)
    joint_names = model.robot.motors or limits
    of_urdf = dict(enumerate(limits.get(name) for name in joint_names))
    in_degrees = [axis.limits for axis in model.axes if axis.limits.unit is DEGREE]
    ranges_deg = [limit.position[1] - limit.position[0] for limit in in_degrees]
    narrow = all(SHORTEST_DEG < range_deg < SHORTEST_OF_ALL_DEG for range_deg in ranges_deg)
    for index, axis in enumerate(model.axes):
        lower, upper = axis.limits.position
        velocity = axis.limits.velocity
        unit = axis.limits.unit
        path = ("axes", index, "limits")
        in_si = of_urdf.get(index)
        multiply = f"multiply by {1.0 / unit.si:.3g}"
        remedy = f"{unit.name}; {multiply}"
        where = (*path, f"position_{unit.name}")
        found = f"[{lower:g}, {upper:g}] {unit.name}"
        farthest_si = _PLAUSIBLE[unit].farthest * unit.si
        if in_si is not None and _within_urdf((lower, upper), in_si.position, farthest_si):
            yield Fault(where, f"{found}, the numbers of the URDF in {unit.si_name}", remedy)
        elif narrow and unit is DEGREE:
            found += f", and on no axis a range of {SHORTEST_OF_ALL_DEG:g} deg"
            yield Fault(where, found, f"limits in deg; are these in rad? {multiply}")
        if in_si is None:
            continue
        if abs(velocity - in_si.velocity) < 0.1 * in_si.velocity:
            found = f"{velocity:g} {unit.name}/s, the number of the URDF in {unit.si_name}/s"
            yield Fault((*path, f"velocity_{unit.name}_s"), found, remedy)


def _within_urdf(
    written: tuple[float, float], in_si: tuple[float, float] | None, farthest: float
) -> bool:
    """Whether limits lie within those of the URDF as numbers, and fill most of them:
    their unit is then SI too.
    """
    if in_si is None:
        return False
    lower, upper = in_si
    if not lower < upper or max(abs(lower), abs(upper)) > farthest:
        return False
    span = upper - lower
    written_lower, written_upper = written
    begins_inside = written_lower > lower - 0.1 * span
    ends_inside = written_upper < upper + 0.1 * span
    if not begins_inside or not ends_inside:
        return False
    return written_upper - written_lower > 0.5 * span


def _standstill_faults(model: CellModel, joints: Sequence[Joint]) -> Iterator[Fault]:
    """Check for one speed for each axis, in the list of its unit, or for none at all:
    they are then derived.
    """
    n = len(model.axes)
    lists = {
        "standstill_rad_s": model.conditioning.standstill_rad_s,
        "standstill_mm_s": model.conditioning.standstill_mm_s,
    }
    units = [joint_unit(joint.kind) for joint in joints]
    if not units:
        units = [axis.limits.unit for axis in model.axes]
    if not any(lists.values()):
        return
    keys = ["standstill_mm_s" if unit is MILLIMETRE else "standstill_rad_s" for unit in units]
    short = []
    for key, speeds in lists.items():
        is_needed = bool(speeds) or key in keys
        if is_needed and len(speeds) != n:
            short.append(key)
    for key in short:
        expected = f"{n}, one for each axis (null in the other list)"
        yield Fault(("conditioning", key), f"{len(lists[key])} speeds", expected)
    if short:
        return
    for index, own in enumerate(keys[:n]):
        kind = JointKind.PRISMATIC if own == "standstill_mm_s" else JointKind.REVOLUTE
        for key, speeds in lists.items():
            if speeds and (speeds[index] is None) == (key == own):
                name = model.axes[index].name
                found = f"{speeds[index]} for {name}, which is {kind.value}"
                if key == own:
                    expected = "a speed"
                else:
                    expected = "null, it is in the other list"
                yield Fault(("conditioning", key, index), found, expected)


def _urdf_limits(urdf: str) -> dict[str, _UrdfLimits | None]:
    """Read the limits of the moving joints from the URDF by name, in document order;
    {} if it cannot be read.
    """
    try:
        joints = ElementTree.fromstring(urdf).iter("joint")
        limits: dict[str, _UrdfLimits | None] = {}
        for joint in joints:
            if joint.get("type") not in {"revolute", "continuous", "prismatic"}:
                continue
            limit = joint.find("limit")
            name = joint.get("name", "")
            limits[name] = None
            if limit is None:
                continue
            lower = float(limit.get("lower", "0"))
            upper = float(limit.get("upper", "0"))
            is_continuous = joint.get("type") == "continuous"
            position = None if is_continuous else (lower, upper)
            velocity = float(limit.get("velocity", "0"))
            limits[name] = _UrdfLimits(position, velocity)
    except (ElementTree.ParseError, ValueError):
        return {}
    return limits
