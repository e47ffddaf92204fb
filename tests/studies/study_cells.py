"""The simulated cells of the studies:
each seed has a truth of its own, drawn around the clean cell.

Nothing that records or fits reads a truth: the simulator is built from it, and the scoring is given
`Truth`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.spec import AxisSpec, Body, CellSpec
from ident.model.bodies import LINK_PARAMETERS, Payload

PAYLOADS = ("disc", "plate")


@dataclass(frozen=True, slots=True)
class World:
    """Noise of a study's cells.

    Attributes:
        noise_factor: of the current noise, against the clean cell.
        disturbance_percent: torque disturbance inside the position loop, root mean square in
            percent of rated torque.
        friction_percent: standard deviation of each axis' friction from run to run, in percent;
            within a run it stays.
    """

    noise_factor: float
    disturbance_percent: float
    friction_percent: float = 0.0


WORLDS = {
    "measurement": World(1.59, 0.0),
    "quiet": World(0.18, 0.0),
    "loop3": World(1.0, 3.0),
    "loop8": World(1.0, 8.0),
    "runs": World(1.59, 0.0, 2.0),
}
"""The first leaves a relative error of 3.5 % without any effect (docs/evidence/estimators.md),
the quiet one 0.4 %.

The last has the noise of the first, and friction that differs from run to run, as temperature and
remounting do it.
"""
CORRELATION_S = (0.002, 0.050)
"""Range of the disturbance's correlation time, drawn for each axis, logarithmically uniform [s]."""
GAIN_SPREAD = 0.10
"""Half-widths of uniform draws, as a share of the clean cell's value: gains keep their sign."""
FRICTION_SPREAD = 0.30
INERTIA_SPREAD = 0.20
LINK_SPREAD = 0.10
"""Of each link's mass and, with it, of its inertia about its centre of mass: another density."""
LINK_CENTRE_M = 0.005
"""Half-widths of uniform displacements of a centre of mass [m]."""
PAYLOAD_CENTRE_M = 0.010
PAYLOAD_INERTIA_SPREAD = 0.20
CAD_CENTRE_STD_M = 0.001
CAD_INERTIA_STD = 0.03
"""How far the CAD model of a payload is off, standard deviations:
mounted 1 mm beside the drawing, simple solids.
"""


@dataclass(frozen=True, slots=True)
class PayloadTruth:
    """One body that can be mounted.

    Attributes:
        mass_kg: true, and as weighed: a wrong weight is no business of these studies.
        parameters: the ten true inertial parameters in the frame of the last joint, by
            LINK_PARAMETERS.
        cad: the ten as a CAD model gives them: the weighed mass, centre and inertia with the errors
            stated above.
    """

    mass_kg: float
    parameters: dict[str, float]
    cad: dict[str, float]


@dataclass(frozen=True, slots=True)
class Truth:
    """True values with which a fit of a study's cell is scored.

    Attributes:
        seed: of the cell.
        noise_factor: of the current noise, against the clean cell.
        gains_nm_per_a: true joint drive gains, by axis.
        payloads: by name.
        axes: everything true of each axis (drivers.simulation.spec.AxisSpec).
    """

    seed: int
    noise_factor: float
    gains_nm_per_a: tuple[float, ...]
    payloads: dict[str, PayloadTruth]
    axes: tuple[dict[str, Any], ...]


@dataclass(frozen=True, slots=True)
class StudyCell:
    """One simulated cell; what is mounted and the noise of a run are chosen by `spec_of`.

    Attributes:
        seed: it was drawn from.
        noise_factor: of the current noise, against the clean cell.
        bare: without load.
        bodies: that can be mounted, by name.
        friction_percent: standard deviation of each axis' friction from run to run.
    """

    seed: int
    noise_factor: float
    bare: CellSpec
    bodies: dict[str, Body]
    friction_percent: float = 0.0


def study_cell(seed: int, noise_factor: float = 1.0, disturbance_percent: float = 0.0) -> StudyCell:
    """Draw a cell.

    Noise and disturbance change nothing else: cells of one seed have one truth in every world.

    Args:
        seed: the same seed gives the same cell.
        noise_factor: of the current noise, against the clean cell.
        disturbance_percent: of every axis, with a correlation time drawn for each.

    Raises:
        ConfigurationError: from the clean cell's file.
    """
    path = shipped_simulation("clean")
    bare = load_simulation(path)
    # The fourth stream draws the drawing of a payload (`truth_of`).
    axes_rng, links_rng, payload_rng, loop_rng = (
        np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(part,)))
        for part in (0, 1, 2, 4)
    )
    low, high = np.log(CORRELATION_S)
    correlation_s = np.exp(loop_rng.uniform(float(low), float(high), len(bare.axes)))
    bodies = {}
    for name in PAYLOADS:
        body = load_simulation(path, name).payload
        if body is None:
            raise ValueError(f"payload {name} of {path}: no body")
        bodies[name] = _drawn_body(body, payload_rng)
    urdf = _drawn_links(bare.urdf, links_rng)
    axes = tuple(
        replace(
            _drawn_axis(axis, axes_rng, noise_factor),
            torque_disturbance_percent=disturbance_percent,
            disturbance_correlation_s=float(time_s),
        )
        for axis, time_s in zip(bare.axes, correlation_s, strict=True)
    )
    spec = replace(
        bare,
        urdf=urdf,
        axes=axes,
    )
    return StudyCell(seed, noise_factor, spec, bodies)


def world_cell(seed: int, world: str) -> StudyCell:
    """Draw a cell of one of WORLDS."""
    chosen = WORLDS[world]
    cell = study_cell(seed, chosen.noise_factor, chosen.disturbance_percent)
    return replace(cell, friction_percent=chosen.friction_percent)


def spec_of(cell: StudyCell, payload: str | None, run: int) -> CellSpec:
    """The cell as it is for one run.

    Args:
        cell: drawn.
        payload: name of the mounted body, or None.
        run: each run of a cell has a noise of its own, and a friction where it differs from run to
            run.
    """
    body = None if payload is None else cell.bodies[payload]
    rng = np.random.default_rng(np.random.SeedSequence(cell.seed, spawn_key=(5, run)))
    factors = 1.0 + 0.01 * cell.friction_percent * rng.standard_normal(len(cell.bare.axes))
    axes = tuple(
        _rubbing(axis, float(factor)) for axis, factor in zip(cell.bare.axes, factors, strict=True)
    )
    seed = 1000 * cell.seed + run
    return replace(cell.bare, axes=axes, payload=body, seed=seed)


def _rubbing(axis: AxisSpec, factor: float) -> AxisSpec:
    """The same axis with all of its friction times a factor."""
    viscous_nm_s_rad = factor * axis.viscous_nm_s_rad
    coulomb_nm = factor * axis.coulomb_nm
    motor_viscous_nm_s_rad = factor * axis.motor_viscous_nm_s_rad
    motor_coulomb_nm = factor * axis.motor_coulomb_nm
    return replace(
        axis,
        viscous_nm_s_rad=viscous_nm_s_rad,
        coulomb_nm=coulomb_nm,
        motor_viscous_nm_s_rad=motor_viscous_nm_s_rad,
        motor_coulomb_nm=motor_coulomb_nm,
    )


def truth_of(cell: StudyCell) -> Truth:
    """Return the true values of a cell, with which a fit is scored."""
    rng = np.random.default_rng(np.random.SeedSequence(cell.seed, spawn_key=(3,)))
    payloads = {}
    for name, body in cell.bodies.items():
        centre_m = _triple(np.array(body.centre_m) + CAD_CENTRE_STD_M * rng.standard_normal(3))
        inertia_kg_m2 = _scaled_inertia(body, 1.0 + CAD_INERTIA_STD * float(rng.standard_normal()))
        drawing = Body(
            body.mass_kg,
            centre_m,
            inertia_kg_m2,
        )
        payloads[name] = PayloadTruth(body.mass_kg, link_parameters(body), link_parameters(drawing))
    axes = tuple(asdict(axis) for axis in cell.bare.axes)
    gains_nm_per_a = tuple(axis.gain_nm_per_a for axis in cell.bare.axes)
    return Truth(
        cell.seed,
        cell.noise_factor,
        gains_nm_per_a,
        payloads,
        axes,
    )


def truth_from(document: dict[str, Any]) -> Truth:
    """Rebuild a truth from its `dataclasses.asdict`, read back from JSON."""
    payloads = {name: PayloadTruth(**payload) for name, payload in document["payloads"].items()}
    gains_nm_per_a = tuple(document["gains_nm_per_a"])
    axes = tuple(document["axes"])
    return Truth(
        seed=document["seed"],
        noise_factor=document["noise_factor"],
        gains_nm_per_a=gains_nm_per_a,
        payloads=payloads,
        axes=axes,
    )


def declared_payload(name: str) -> Payload:
    """Return a payload as a log of the study declares it:
    the weighed mass of the disc alone, of the plate nothing.

    The plate's mass is what the study looks for (paper, Tables 7 and 8).
    """
    known = {"m": study_masses()["disc"]} if name == "disc" else {}
    return Payload(name, "flange-a", known)


def study_masses() -> dict[str, float]:
    """Masses of the payloads [kg]; every seed has the same."""
    path = shipped_simulation("clean")
    bodies = {name: load_simulation(path, name).payload for name in PAYLOADS}
    return {name: body.mass_kg for name, body in bodies.items() if body is not None}


def link_parameters(body: Body) -> dict[str, float]:
    """The ten inertial parameters of a body in the frame that it is fixed to,
    by LINK_PARAMETERS.
    """
    xx, xy, xz, yy, yz, zz = body.inertia_kg_m2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    centre_m = np.array(body.centre_m)
    parts = pin.Inertia(body.mass_kg, centre_m, inertia).toDynamicParameters()
    m, mx, my, mz, ixx, ixy, iyy, ixz, iyz, izz = (float(part) for part in parts)
    return dict(zip(LINK_PARAMETERS, (ixx, ixy, ixz, iyy, iyz, izz, mx, my, mz, m), strict=True))


def _drawn_axis(axis: AxisSpec, rng: np.random.Generator, noise_factor: float) -> AxisSpec:
    def around(value: float, spread: float) -> float:
        return value * (1.0 + spread * float(rng.uniform(-1.0, 1.0)))

    gain_nm_per_a = around(axis.gain_nm_per_a, GAIN_SPREAD)
    motor_inertia_kg_m2 = around(axis.motor_inertia_kg_m2, INERTIA_SPREAD)
    viscous_nm_s_rad = around(axis.viscous_nm_s_rad, FRICTION_SPREAD)
    coulomb_nm = around(axis.coulomb_nm, FRICTION_SPREAD)
    motor_viscous_nm_s_rad = around(axis.motor_viscous_nm_s_rad, FRICTION_SPREAD)
    motor_coulomb_nm = around(axis.motor_coulomb_nm, FRICTION_SPREAD)
    offset_nm = around(axis.offset_nm, FRICTION_SPREAD)
    current_noise_a = noise_factor * axis.current_noise_a
    return replace(
        axis,
        gain_nm_per_a=gain_nm_per_a,
        motor_inertia_kg_m2=motor_inertia_kg_m2,
        viscous_nm_s_rad=viscous_nm_s_rad,
        coulomb_nm=coulomb_nm,
        motor_viscous_nm_s_rad=motor_viscous_nm_s_rad,
        motor_coulomb_nm=motor_coulomb_nm,
        offset_nm=offset_nm,
        current_noise_a=current_noise_a,
    )


def _drawn_body(body: Body, rng: np.random.Generator) -> Body:
    """The same mass, mounted a little elsewhere,
    and of another shape as far as its inertia goes.
    """
    centre_m = np.array(body.centre_m)
    centre = centre_m + PAYLOAD_CENTRE_M * rng.uniform(-1.0, 1.0, 3)
    scale = 1.0 + PAYLOAD_INERTIA_SPREAD * float(rng.uniform(-1.0, 1.0))
    return replace(body, centre_m=_triple(centre), inertia_kg_m2=_scaled_inertia(body, scale))


def _drawn_links(urdf: str, rng: np.random.Generator) -> str:
    """Every link with another density and another centre of mass: still a body that can exist."""
    # The text is a file of this repository, so it is trusted.
    robot = ElementTree.fromstring(urdf)
    for inertial in robot.iterfind("link/inertial"):
        scale = 1.0 + LINK_SPREAD * float(rng.uniform(-1.0, 1.0))
        shift = LINK_CENTRE_M * rng.uniform(-1.0, 1.0, 3)
        origin, mass, inertia = (_child(inertial, tag) for tag in ("origin", "mass", "inertia"))
        centre = np.array([float(value) for value in origin.attrib["xyz"].split()]) + shift
        origin.attrib["xyz"] = " ".join(repr(float(value)) for value in centre)
        mass.attrib["value"] = repr(scale * float(mass.attrib["value"]))
        for key, value in inertia.attrib.items():
            inertia.attrib[key] = repr(scale * float(value))
    return ElementTree.tostring(robot, encoding="unicode")


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = element.find(tag)
    if found is None:
        raise ValueError(f"the plant's URDF: a link's inertial has no <{tag}>")
    return found


def _scaled_inertia(body: Body, scale: float) -> tuple[float, float, float, float, float, float]:
    xx, xy, xz, yy, yz, zz = (scale * value for value in body.inertia_kg_m2)
    return xx, xy, xz, yy, yz, zz


def _triple(values: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
