"""A simulation file: the truth of a simulated cell.

Only `simulate` and `demo` read it; no fit, plan or report does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, ClassVar
from xml.etree import ElementTree

import numpy as np
from pydantic import Field, model_validator

from daq.config.cell import DEGREE, MILLIMETRE
from daq.config.checks import centre_faults, gyration_faults, moment_faults
from daq.config.urdf_text import urdf_text
from daq.config.yaml_file import (
    Document,
    DocumentKind,
    Fault,
    Location,
    StrictModel,
    fault_texts,
    parse_yaml,
    read_model,
    read_yaml_bytes,
)
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent, ConfigurationMissing, UsageError
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.spec import (
    AxisSpec,
    Body,
    CellSpec,
    Closure,
    PassiveFriction,
    UndeclaredEffect,
)
from ident.plausible import GAIN, RATIO, within

#: J3, or 3
AxisName = Annotated[str, Field(pattern=r"^J[1-9][0-9]?$")] | Annotated[int, Field(ge=1)]

LONGEST_S = 1e6
MASS_KG = (1e-6, 1e5)  #: Mass of a payload
CURRENT_A = (1e-6, 1e6)  #: Rated and peak current of an amplifier
#: Any other number, in its own unit: far beyond any robot, far below an overflow
LARGEST_NUMBER = 1e9
#: No simulated cell runs for that long; beyond 2⁶³ periods nothing could count them
LAST_CYCLE = 10**12

_Name = Annotated[str, Field(min_length=1)]
_Time = Annotated[float, Field(ge=0, le=LONGEST_S)]
_Duration = Annotated[float, Field(gt=0, le=LONGEST_S)]
_Cycle = Annotated[int, Field(ge=0, le=LAST_CYCLE)]
_Cycles = Annotated[int, Field(ge=1, le=LAST_CYCLE)]
_EmcyCode = Annotated[int, Field(ge=0x1000, le=0xFFFF)]


class FaultModel(StrictModel):
    """Something that goes wrong; times count from power-on, in the time of the plant."""

    fault: FaultKind
    axis: AxisName | None = None
    at_s: _Time | None = None
    at_cycle: _Cycle | None = None
    for_s: _Duration | None = None
    cycles: _Cycles | None = None
    emcy_code: _EmcyCode | None = None

    @model_validator(mode="after")
    def _one_form(self) -> FaultModel:
        if self.at_s is not None and self.at_cycle is not None:
            raise ValueError("at_s or at_cycle, not both")
        if self.for_s is not None and self.cycles is not None:
            raise ValueError("for_s or cycles, not both")
        if (self.emcy_code is not None) != (self.fault is FaultKind.EMERGENCY):
            raise ValueError("emcy_code for the fault emergency, and for no other")
        return self

    def spec(self, period_us: int) -> FaultSpec:
        """In SYNCs."""
        begin = self.at_cycle or 0
        if self.at_s is not None:
            begin = round(self.at_s * 1e6 / period_us)
        cycles = self.cycles
        if self.for_s is not None:
            cycles = max(1, round(self.for_s * 1e6 / period_us))
        axis = None
        if self.axis is not None:
            axis = axis_index(self.axis)
        return FaultSpec(self.fault, axis, begin, cycles, self.emcy_code or 0)


class ScenarioModel(StrictModel):
    """A scenario file."""

    document_kind: ClassVar[DocumentKind | None] = DocumentKind.SCENARIO

    faults: Annotated[tuple[FaultModel, ...], Field(min_length=1)]


def load_scenario(path: Path, axes: int, period_us: int) -> tuple[FaultSpec, ...]:
    """Read a scenario file; its faults come on top of those of the simulation file.

    Args:
        path: of the file.
        axes: that the cell has.
        period_us: of its SYNC.

    Raises:
        ConfigurationError: the file is missing, wrong, or names an axis that the cell lacks.
    """
    document = parse_yaml(read_yaml_bytes(path), str(path))
    model = read_model(document, ScenarioModel)
    wrong = absent_axes(model.faults, axes)
    if wrong:
        texts = fault_texts(document, wrong)
        raise ConfigurationInconsistent(**texts, remedy="correct the scenario file")
    return tuple(fault.spec(period_us) for fault in model.faults)


def absent_axes(faults: Sequence[FaultModel], axes: int) -> list[Fault]:
    """Describe faults on axes that the cell lacks."""
    absent = []
    for number, fault in enumerate(faults):
        if fault.axis is not None and axis_index(fault.axis) >= axes:
            place = ("faults", number, "axis")
            absent.append(Fault(place, f"axis {fault.axis}", f"J1 to J{axes}"))
    return absent


def axis_index(axis: str | int) -> int:
    """Index from 0 of an axis given as "J3" or by its number from 1."""
    if isinstance(axis, str):
        return int(axis.removeprefix("J")) - 1
    return axis - 1


class PlantedEffectModel(StrictModel):
    """An undeclared effect, on an axis, on a passive joint of a closed chain,
    or in the pivot of a closure.
    """

    name: _Name
    axis: AxisName | None = None
    joint: _Name | None = None
    closure: _Name | None = None
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_place(self) -> PlantedEffectModel:
        places = (self.axis, self.joint, self.closure)
        given = [place for place in places if place is not None]
        if len(given) != 1:
            raise ValueError(
                "axis, or joint for a passive joint, or closure for a pivot: one of them"
            )
        return self

    def effect(self) -> UndeclaredEffect:
        """As the plant knows it."""
        axis = -1
        if self.axis is not None:
            axis = axis_index(self.axis)
        parameters = dict(self.parameters)
        return UndeclaredEffect(self.name, axis, parameters, self.joint, self.closure)


class SimulationModel(StrictModel):
    """A simulation file."""

    reference: ClassVar[str] = "schemas.md"
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.SIMULATION

    urdf: _Name
    gravity_m_s2: tuple[float, float, float]
    ratio: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1)]
    sync_period_us: Annotated[int, Field(ge=250, le=1_000_000)]
    substeps: Annotated[int, Field(ge=1, le=100)]
    seed: Annotated[int, Field(ge=0)]
    start_deg: tuple[float | None, ...] = ()
    start_mm: tuple[float | None, ...] = ()
    axes: Annotated[tuple[AxisSpec, ...], Field(min_length=1, max_length=32)]
    payloads: dict[str, Body] = Field(default_factory=dict)
    tuned_with: str | None = None  #: body that the loops are tuned to carry, and to do without
    effects: tuple[PlantedEffectModel, ...] = ()
    faults: tuple[FaultModel, ...] = ()
    closures: tuple[Closure, ...] = ()
    motors: tuple[str, ...] = ()
    platform: str | None = None
    assembly_deg: dict[str, float] = Field(default_factory=dict)
    assembly_mm: dict[str, float] = Field(default_factory=dict)
    passive: dict[str, PassiveFriction] = Field(default_factory=dict)


def require_simulator() -> None:
    """Refuse to simulate without the packages that move the simulated cell.

    Raises:
        ConfigurationMissing: with the extra to install.
    """
    missing = [package for package in ("pinocchio", "numba") if find_spec(package) is None]
    if missing:
        raise ConfigurationMissing(
            "the simulated cell",
            found=f"no package {' and '.join(missing)}",
            expected="the mechanics and the compiler of the optional extra `simulation`",
            remedy="pip install 'drivegain[simulation]'",
        )


def load_simulation(path: Path, payload: str | None = None) -> CellSpec:
    """Read a simulation file.

    Args:
        path: of the file.
        payload: name of the mounted body, or None.

    Raises:
        ConfigurationError: the file is missing, wrong, or contradicts itself.
        UsageError: there is no such payload.
    """
    document = parse_yaml(read_yaml_bytes(path), str(path))
    model = read_model(document, SimulationModel)
    _check(document, model)
    urdf_path = path.parent / model.urdf
    urdf = urdf_text(read_yaml_bytes(urdf_path), str(urdf_path))
    _refuse(document, list(_mimic_faults(urdf)))
    if model.closures:
        _refuse(document, list(_closed_chain_faults(model, urdf)))
    if payload is not None and payload not in model.payloads:
        raise UsageError(
            f"payload {payload!r}",
            found="no such body in the simulation",
            expected=f"one of {_payload_names(model)}",
            remedy=f"choose one, or add it to {path}",
        )
    start = [_position_si(degrees, millimetres) for degrees, millimetres in _starts(model)]
    assembly = {}
    for name, degrees in model.assembly_deg.items():
        assembly[name] = DEGREE.si * degrees
    for name, millimetres in model.assembly_mm.items():
        assembly[name] = MILLIMETRE.si * millimetres
    mounted = None
    if payload is not None:
        mounted = model.payloads[payload]
    tuned_with = None
    if model.tuned_with is not None:
        tuned_with = model.payloads[model.tuned_with]
    effects = tuple(effect.effect() for effect in model.effects)
    faults = tuple(fault.spec(model.sync_period_us) for fault in model.faults)
    return CellSpec(
        urdf=urdf,
        gravity_m_s2=model.gravity_m_s2,
        ratio=np.array(model.ratio, dtype=np.float64),
        axes=model.axes,
        start_rad=np.array(start),
        payload=mounted,
        effects=effects,
        sync_period_us=model.sync_period_us,
        substeps=model.substeps,
        seed=model.seed,
        faults=faults,
        closures=model.closures,
        motors=model.motors,
        platform=model.platform,
        assembly_rad=assembly,
        passive=model.passive,
        tuned_with=tuned_with,
    )


def shipped_simulation(name: str = "demo") -> Path:
    """A simulation file that comes with drivegain."""
    return shipped_configurations() / "simulation" / f"{name}.yaml"


def _starts(model: SimulationModel) -> list[tuple[float | None, float | None]]:
    """Position of each joint: degrees and millimetres, one of them None."""
    unknown = (None,) * len(model.axes)
    degrees = model.start_deg or unknown
    millimetres = model.start_mm or unknown
    return list(zip(degrees, millimetres, strict=True))


def _position_si(degrees: float | None, millimetres: float | None) -> float:
    """Position of a joint [rad or m]; 0 where neither is given."""
    if degrees is not None:
        return DEGREE.si * degrees
    return MILLIMETRE.si * (millimetres or 0.0)


def _payload_names(model: SimulationModel) -> str:
    return ", ".join(model.payloads) or "none: it has no payloads"


def _refuse(document: Document, faults: list[Fault]) -> None:
    """Refuse a simulation file with faults."""
    if faults:
        texts = fault_texts(document, faults)
        raise ConfigurationInconsistent(**texts, remedy="correct the simulation file")


def _check(document: Document, model: SimulationModel) -> None:
    n = len(model.axes)
    faults = [
        *_closure_key_faults(model),
        *_ratio_faults(model),
        *_start_faults(model),
        *_axis_faults(model),
    ]
    if model.tuned_with is not None and model.tuned_with not in model.payloads:
        expected = f"one of {_payload_names(model)}"
        faults.append(Fault(("tuned_with",), repr(model.tuned_with), expected))
    faults += absent_axes(model.faults, n)
    faults += _implausible(model)
    _refuse(document, faults)


def _closure_key_faults(model: SimulationModel) -> Iterator[Fault]:
    """Find keys of closed chains in the file of a robot without closures."""
    if model.closures:
        return
    for key in ("motors", "platform", "assembly_deg", "assembly_mm", "passive"):
        if getattr(model, key):
            expected = "closures of a closed chain, or none of its keys"
            yield Fault((key,), "given without closures", expected)


def _ratio_faults(model: SimulationModel) -> Iterator[Fault]:
    """Find a drive train of another size than the robot."""
    n = len(model.axes)
    rows = len(model.ratio)
    is_square = all(len(row) == n for row in model.ratio)
    if rows != n or not is_square:
        yield Fault(("ratio",), f"{rows} rows", f"{n} × {n}, a row for each motor")


def _start_faults(model: SimulationModel) -> Iterator[Fault]:
    """Find start positions that are too many, too few, or both an angle and a length."""
    n = len(model.axes)
    angles = len(model.start_deg)
    lengths = len(model.start_mm)
    has_angles = bool(model.start_deg) or not model.start_mm
    if angles != n and has_angles:
        yield Fault(("start_deg",), f"{angles} angles", f"{n}, one for each joint")
        return
    if lengths not in (0, n):
        yield Fault(("start_mm",), f"{lengths} positions", f"{n}, one for each joint")
        return
    key = "start_deg"
    if model.start_mm:
        key = "start_mm"
    for joint, found in enumerate(_starts(model), start=1):
        if found.count(None) != 1:
            yield Fault((key,), f"joint {joint}: {found}", "deg, or mm, and null")


def _axis_faults(model: SimulationModel) -> Iterator[Fault]:
    """Find node ids used twice, gains of zero, and effects on axes that the cell lacks."""
    n = len(model.axes)
    node_ids = {axis.node_id for axis in model.axes}
    if len(node_ids) != n:
        yield Fault(("axes",), "a node id used twice", "each node once")
    for index, axis in enumerate(model.axes):
        if axis.gain_nm_per_a == 0.0:
            place = ("axes", index, "gain_nm_per_a")
            yield Fault(place, "0", "a gain that is not zero")
    for index, effect in enumerate(model.effects):
        if effect.axis is not None and axis_index(effect.axis) >= n:
            axis_place = ("effects", index, "axis")
            yield Fault(axis_place, f"axis {effect.axis}", f"J1 to J{n}")


def _implausible(model: SimulationModel) -> Iterator[Fault]:
    """Find numbers by which the plant overflows, and payloads that are no bodies."""
    for name, body in model.payloads.items():
        path = ("payloads", name)
        if not within(body.mass_kg, MASS_KG):
            least_kg, most_kg = MASS_KG
            expected = f"{least_kg:g} to {most_kg:g} kg"
            yield Fault((*path, "mass_kg"), f"{body.mass_kg:g} kg", expected)
            continue
        inertia_path = (*path, "inertia_kg_m2")
        yield from centre_faults((*path, "centre_m"), body.centre_m)
        yield from gyration_faults(inertia_path, body.inertia_kg_m2, body.mass_kg)
        yield from moment_faults(inertia_path, body.inertia_kg_m2)
    for index, axis in enumerate(model.axes):
        place = ("axes", index)
        gain = abs(axis.gain_nm_per_a)
        if gain != 0.0:  # `_axis_faults` finds 0
            yield from _bound_faults((*place, "gain_nm_per_a"), gain, GAIN)
        rated_a = axis.rated_current_a
        peak_a = axis.peak_current_a
        yield from _bound_faults((*place, "rated_current_a"), rated_a, CURRENT_A)
        yield from _bound_faults((*place, "peak_current_a"), peak_a, CURRENT_A)
    _, largest_ratio = RATIO
    for index, row in enumerate(model.ratio):
        if not all(abs(number) <= largest_ratio for number in row):
            numbers = ", ".join(f"{number:g}" for number in row)
            yield Fault(("ratio", index), numbers, f"at most ±{largest_ratio:g}")
    bounded = {"gain_nm_per_a", "rated_current_a", "peak_current_a"}
    others = model.model_dump(exclude={"payloads", "ratio"})
    for where, number in _numbers((), others):
        if where[-1] in bounded:
            continue
        if not abs(number) <= LARGEST_NUMBER:
            yield Fault(where, f"{number:g}", f"at most ±{LARGEST_NUMBER:g}")


def _bound_faults(where: Location, value: float, bounds: tuple[float, float]) -> Iterator[Fault]:
    if not within(value, bounds):
        least, most = bounds
        yield Fault(where, f"{value:g}", f"{least:g} to {most:g} in size")


def _numbers(path: Location, value: object) -> Iterator[tuple[Location, float]]:
    """Yield the floating-point numbers of a document, each with its path."""
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers((*path, key), inner)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _numbers((*path, index), inner)


def _mimic_faults(urdf: str) -> Iterator[Fault]:
    """Find joints that follow another one: the plant would take each for a joint of its own."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError:
        return  # the plant says so
    for joint in root.iter("joint"):
        mimic = joint.find("mimic")
        if mimic is None or joint.get("type") == "fixed":
            continue
        yield Fault(
            ("urdf",),
            f"joint {joint.get('name')} with <mimic> of {mimic.get('joint')}",
            "a URDF without <mimic>: describe the mechanism that couples the joints in `closures`, "
            "or fix the joint",
        )


def _closed_chain_faults(model: SimulationModel, urdf: str) -> Iterator[Fault]:
    """Find names of a closed chain that the URDF lacks, and joints with two places or none."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError:
        return  # the plant says so
    links = [link.get("name", "") for link in root.iter("link")]
    yield from _link_faults(model, links)
    kinds = {}
    for joint in root.iter("joint"):
        name = joint.get("name", "")
        kind = joint.get("type", "")
        if kind != "fixed":
            kinds[name] = kind
    yield from _joint_faults(model, kinds)


def _link_faults(model: SimulationModel, links: list[str]) -> Iterator[Fault]:
    """Find closures and a platform of links that the URDF lacks, and closures of nothing."""
    wanted = f"a link of the URDF: {', '.join(links)}"
    for number, closure in enumerate(model.closures):
        place = ("closures", number)
        first = closure.first
        second = closure.second
        if first not in links:
            yield Fault((*place, "first"), first, wanted)
        if second not in links:
            yield Fault((*place, "second"), second, wanted)
        if first == second:
            yield Fault((*place, "second"), f"{second} twice", "two links")
        different = set(closure.directions)
        if len(different) != len(closure.directions):
            yield Fault((*place, "directions"), "a direction twice", "each direction once")
    if model.platform is not None and model.platform not in links:
        yield Fault(("platform",), model.platform, wanted)


def _joint_faults(model: SimulationModel, joints: dict[str, str]) -> Iterator[Fault]:
    """Find motors, positions and friction of joints that the URDF lacks,
    given the kinds of its joints.
    """
    wanted = f"joints of the URDF: {', '.join(joints)}"
    n = len(model.axes)
    motors = set(model.motors)
    has_one_each = len(motors) == len(model.motors) == n
    if not has_one_each or not motors <= set(joints):
        found = ", ".join(model.motors) or "none"
        yield Fault(("motors",), found, f"{n} different {wanted}")
    prismatic = {name for name, kind in joints.items() if kind == "prismatic"}
    revolute = set(joints) - prismatic
    angles = set(model.assembly_deg)
    lengths = set(model.assembly_mm)
    yield from _assembly_faults("assembly_deg", angles, revolute, f"revolute {wanted}")
    yield from _assembly_faults("assembly_mm", lengths, prismatic, f"prismatic {wanted}")
    for name in model.passive:
        if name not in joints:
            yield Fault(("passive", name), name, "a passive joint")
        elif name in motors:
            yield Fault(("passive", name), "a joint with a motor", "a passive joint")


def _assembly_faults(key: str, given: set[str], joints: set[str], wanted: str) -> Iterator[Fault]:
    """Find rough positions of joints of another kind, and joints without one."""
    wrong = sorted(given - joints)
    if wrong:
        yield Fault((key,), ", ".join(wrong), wanted)
    missing = sorted(joints - given)
    if missing:
        yield Fault((key,), f"no {', '.join(missing)}", "a rough position of every joint")
