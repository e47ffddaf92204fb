"""A simulation file: the truth of a simulated cell. Only `simulate` and `demo` read it; no fit, plan or report does."""

from __future__ import annotations

import re
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
from drivers.simulation.spec import AxisSpec, Body, CellSpec, Closure, PassiveFriction, UndeclaredEffect
from ident.plausible import GAIN, RATIO, within

AxisName = Annotated[str, Field(pattern=r"^J[1-9][0-9]?$")] | Annotated[int, Field(ge=1)]  #: J3, or 3

LONGEST_S = 1e6
MASS_KG = (1e-6, 1e5)  #: Mass of a payload
CURRENT_A = (1e-6, 1e6)  #: Rated and peak current of an amplifier
LARGEST_NUMBER = 1e9  #: Any other number, in its own unit: far beyond any robot, far below an overflow
LAST_CYCLE = 10**12  #: No simulated cell runs for that long; beyond 2⁶³ periods nothing could count them


class FaultModel(StrictModel):
    """Something that goes wrong; times count from power-on, in the time of the plant."""

    fault: FaultKind
    axis: AxisName | None = None
    at_s: Annotated[float, Field(ge=0, le=LONGEST_S)] | None = None
    at_cycle: Annotated[int, Field(ge=0, le=LAST_CYCLE)] | None = None
    for_s: Annotated[float, Field(gt=0, le=LONGEST_S)] | None = None
    cycles: Annotated[int, Field(ge=1, le=LAST_CYCLE)] | None = None
    emcy_code: Annotated[int, Field(ge=0x1000, le=0xFFFF)] | None = None

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
        begin = self.at_cycle or 0 if self.at_s is None else round(self.at_s * 1e6 / period_us)
        cycles = self.cycles if self.for_s is None else max(1, round(self.for_s * 1e6 / period_us))
        axis = None if self.axis is None else axis_index(self.axis)
        return FaultSpec(self.fault, axis, begin, cycles, self.emcy_code or 0)


class ScenarioModel(StrictModel):
    """A whole scenario file."""

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
    if wrong := absent_axes(model.faults, axes):
        raise ConfigurationInconsistent(**fault_texts(document, wrong), remedy="correct the scenario file")
    return tuple(fault.spec(period_us) for fault in model.faults)


def absent_axes(faults: Sequence[FaultModel], axes: int) -> list[Fault]:
    """Describe faults on axes that the cell lacks."""
    return [
        Fault(("faults", number, "axis"), f"axis {fault.axis}", f"J1 to J{axes}")
        for number, fault in enumerate(faults)
        if fault.axis is not None and axis_index(fault.axis) >= axes
    ]


def axis_index(axis: str | int) -> int:
    """Index from 0 of an axis given as "J3" or by its number from 1."""
    number = int(re.sub(r"^J", "", axis)) if isinstance(axis, str) else axis
    return number - 1


class PlantedEffectModel(StrictModel):
    """An undeclared effect, on an axis, on a passive joint of a closed chain, or in the pivot of a closure."""

    name: Annotated[str, Field(min_length=1)]
    axis: AxisName | None = None
    joint: Annotated[str, Field(min_length=1)] | None = None
    closure: Annotated[str, Field(min_length=1)] | None = None
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_place(self) -> PlantedEffectModel:
        given = [place for place in (self.axis, self.joint, self.closure) if place is not None]
        if len(given) != 1:
            raise ValueError("axis, or joint for a passive joint, or closure for a pivot: one of them")
        return self

    def effect(self) -> UndeclaredEffect:
        """As the plant knows it."""
        axis = -1 if self.axis is None else axis_index(self.axis)
        return UndeclaredEffect(self.name, axis, dict(self.parameters), self.joint, self.closure)


class SimulationModel(StrictModel):
    """A whole simulation file."""

    reference: ClassVar[str] = "schemas.md"
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.SIMULATION

    urdf: Annotated[str, Field(min_length=1)]
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
    if model.closures and (wrong := [*_closed_chain_faults(model, urdf)]):
        raise ConfigurationInconsistent(**fault_texts(document, wrong), remedy="correct the simulation file")
    if payload is not None and payload not in model.payloads:
        raise UsageError(
            f"payload {payload!r}",
            found="no such body in the simulation",
            expected=f"one of {', '.join(model.payloads) or 'none: it has no payloads'}",
            remedy=f"choose one, or add it to {path}",
        )
    return CellSpec(
        urdf=urdf,
        gravity_m_s2=model.gravity_m_s2,
        ratio=np.array(model.ratio, dtype=np.float64),
        axes=model.axes,
        start_rad=np.array(
            [
                MILLIMETRE.si * (millimetres or 0.0) if degrees is None else DEGREE.si * degrees
                for degrees, millimetres in _starts(model)
            ]
        ),
        payload=None if payload is None else model.payloads[payload],
        effects=tuple(effect.effect() for effect in model.effects),
        sync_period_us=model.sync_period_us,
        substeps=model.substeps,
        seed=model.seed,
        faults=tuple(fault.spec(model.sync_period_us) for fault in model.faults),
        closures=model.closures,
        motors=model.motors,
        platform=model.platform,
        assembly_rad={name: DEGREE.si * degrees for name, degrees in model.assembly_deg.items()}
        | {name: MILLIMETRE.si * millimetres for name, millimetres in model.assembly_mm.items()},
        passive=model.passive,
        tuned_with=None if model.tuned_with is None else model.payloads[model.tuned_with],
    )


def shipped_simulation(name: str = "demo") -> Path:
    """A simulation file that comes with drivegain."""
    return shipped_configurations() / "simulation" / f"{name}.yaml"


def _starts(model: SimulationModel) -> list[tuple[float | None, float | None]]:
    """Position of each joint: degrees and millimetres, one of them None."""
    n = len(model.axes)
    return list(zip(model.start_deg or (None,) * n, model.start_mm or (None,) * n, strict=True))


def _check(document: Document, model: SimulationModel) -> None:
    n = len(model.axes)
    faults = [
        Fault((key,), "given without closures", "closures of a closed chain, or none of its keys")
        for key in ("motors", "platform", "assembly_deg", "assembly_mm", "passive")
        if getattr(model, key) and not model.closures
    ]
    if len(model.ratio) != n or any(len(row) != n for row in model.ratio):
        faults.append(Fault(("ratio",), f"{len(model.ratio)} rows", f"{n} × {n}, a row for each motor"))
    if len(model.start_deg) != n and (model.start_deg or not model.start_mm):
        faults.append(Fault(("start_deg",), f"{len(model.start_deg)} angles", f"{n}, one for each joint"))
    elif len(model.start_mm) not in (0, n):
        faults.append(Fault(("start_mm",), f"{len(model.start_mm)} positions", f"{n}, one for each joint"))
    else:
        faults += [
            Fault(("start_mm" if model.start_mm else "start_deg",), f"joint {joint}: {found}", "deg, or mm, and null")
            for joint, found in enumerate(_starts(model), start=1)
            if found.count(None) != 1
        ]
    if len({axis.node_id for axis in model.axes}) != n:
        faults.append(Fault(("axes",), "a node id used twice", "each node once"))
    faults += [
        Fault(("axes", index, "gain_nm_per_a"), "0", "a gain that is not zero")
        for index, axis in enumerate(model.axes)
        if axis.gain_nm_per_a == 0.0
    ]
    faults += [
        Fault(("effects", index, "axis"), f"axis {effect.axis}", f"J1 to J{n}")
        for index, effect in enumerate(model.effects)
        if effect.axis is not None and axis_index(effect.axis) >= n
    ]
    if model.tuned_with is not None and model.tuned_with not in model.payloads:
        names = ", ".join(model.payloads) or "none: it has no payloads"
        faults.append(Fault(("tuned_with",), repr(model.tuned_with), f"one of {names}"))
    faults += absent_axes(model.faults, n)
    faults += _implausible(model)
    if faults:
        raise ConfigurationInconsistent(**fault_texts(document, faults), remedy="correct the simulation file")


def _implausible(model: SimulationModel) -> Iterator[Fault]:
    """Find numbers by which the plant overflows, and payloads that are no bodies."""
    for name, body in model.payloads.items():
        path = ("payloads", name)
        if not within(body.mass_kg, MASS_KG):
            yield Fault((*path, "mass_kg"), f"{body.mass_kg:g} kg", f"{MASS_KG[0]:g} to {MASS_KG[1]:g} kg")
            continue
        yield from centre_faults((*path, "centre_m"), body.centre_m)
        yield from gyration_faults((*path, "inertia_kg_m2"), body.inertia_kg_m2, body.mass_kg)
        yield from moment_faults((*path, "inertia_kg_m2"), body.inertia_kg_m2)
    for index, axis in enumerate(model.axes):
        for key, value, bounds in (
            ("gain_nm_per_a", abs(axis.gain_nm_per_a) or GAIN[0], GAIN),  # `_check` refuses 0
            ("rated_current_a", axis.rated_current_a, CURRENT_A),
            ("peak_current_a", axis.peak_current_a, CURRENT_A),
        ):
            if not within(value, bounds):
                yield Fault(("axes", index, key), f"{value:g}", f"{bounds[0]:g} to {bounds[1]:g} in size")
    for index, row in enumerate(model.ratio):
        if not all(abs(number) <= RATIO[1] for number in row):
            yield Fault(("ratio", index), ", ".join(f"{number:g}" for number in row), f"at most ±{RATIO[1]:g}")
    bounded = {"gain_nm_per_a", "rated_current_a", "peak_current_a"}
    for where, number in _numbers((), model.model_dump(exclude={"payloads", "ratio"})):
        if where[-1] not in bounded and not abs(number) <= LARGEST_NUMBER:
            yield Fault(where, f"{number:g}", f"at most ±{LARGEST_NUMBER:g}")


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


def _closed_chain_faults(model: SimulationModel, urdf: str) -> Iterator[Fault]:
    """Find names of a closed chain that the URDF lacks, and joints with two places or none."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError:
        return  # the plant says so
    yield from _link_faults(model, [link.get("name", "") for link in root.iter("link")])
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in root.iter("joint")}
    yield from _joint_faults(model, {name: kind for name, kind in kinds.items() if kind != "fixed"})


def _link_faults(model: SimulationModel, links: list[str]) -> Iterator[Fault]:
    """Find closures and a platform of links that the URDF lacks, and closures of nothing."""
    wanted = f"a link of the URDF: {', '.join(links)}"
    for number, closure in enumerate(model.closures):
        for key, link in (("first", closure.first), ("second", closure.second)):
            if link not in links:
                yield Fault(("closures", number, key), link, wanted)
        if closure.first == closure.second:
            yield Fault(("closures", number, "second"), f"{closure.second} twice", "two links")
        if len(set(closure.directions)) != len(closure.directions):
            yield Fault(("closures", number, "directions"), "a direction twice", "each direction once")
    if model.platform is not None and model.platform not in links:
        yield Fault(("platform",), model.platform, wanted)


def _joint_faults(model: SimulationModel, joints: dict[str, str]) -> Iterator[Fault]:
    """Find motors, positions and friction of joints that the URDF lacks, given the kinds of its joints."""
    wanted = f"joints of the URDF: {', '.join(joints)}"
    unknown = set(model.motors) - set(joints)
    if unknown or len(set(model.motors)) != len(model.motors) or len(model.motors) != len(model.axes):
        yield Fault(("motors",), ", ".join(model.motors) or "none", f"{len(model.axes)} different {wanted}")
    prismatic = {name for name, kind in joints.items() if kind == "prismatic"}
    for key, there in (("assembly_deg", set(joints) - prismatic), ("assembly_mm", prismatic)):
        given = set(getattr(model, key))
        if wrong := sorted(given - there):
            yield Fault((key,), ", ".join(wrong), f"{'prismatic' if key == 'assembly_mm' else 'revolute'} {wanted}")
        if missing := sorted(there - given):
            yield Fault((key,), f"no {', '.join(missing)}", "a rough position of every joint")
    for name in model.passive:
        if name not in joints or name in model.motors:
            yield Fault(("passive", name), "a joint with a motor" if name in joints else name, "a passive joint")
