"""Closed chains of the simulated cell against independent statements of the same physics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from daq.simulation.simulation_file import load_simulation
from drivers.simulation.dynamics import advance, turn_rotors
from drivers.simulation.plant import Plant, link_model, motor_rows
from drivers.simulation.spec import (
    AxisSpec,
    CellSpec,
    Closure,
    ClosureLost,
    SpecInvalid,
    UndeclaredEffect,
)
from tests.drivers.simulation.cells import clean_cell

FloatArray = NDArray[np.float64]

SHIPPED_CELLS = Path(__file__).parents[3] / "configs" / "simulation"

ROBOTS = ("five-bar", "orthoglide", "dualv")

MOBILITY = {"five-bar": 2, "orthoglide": 3, "dualv": 3}

ALL = ("x", "y", "z", "rx", "ry", "rz")


def cell(name: str, payload: str | None = None) -> CellSpec:
    """A shipped closed chain."""
    path = SHIPPED_CELLS / f"{name}.yaml"
    return load_simulation(path, payload)


def without_motor_inertia(spec: CellSpec) -> CellSpec:
    """The same with rotors that have no inertia."""
    axes = tuple(replace(axis, motor_inertia_kg_m2=0.0) for axis in spec.axes)
    return replace(spec, axes=axes)


def without_offset(axis: AxisSpec) -> AxisSpec:
    """The same axis without an offset of its torque."""
    return replace(axis, offset_nm=0.0)


def frictionless(spec: CellSpec) -> CellSpec:
    """The same without friction and offsets."""
    axes = []
    for axis in spec.axes:
        smooth = replace(axis, viscous_nm_s_rad=0.0, coulomb_nm=0.0)
        axes.append(without_offset(smooth))
    return replace(spec, axes=tuple(axes), passive={})


def released(spec: CellSpec) -> Plant:
    """A plant with open brakes."""
    plant = Plant(spec)
    axis_count = len(spec.axes)
    closed = np.zeros(axis_count, dtype=np.bool_)
    plant.set_brakes(closed)
    return plant


def largest_absolute(values: FloatArray) -> float:
    """The largest magnitude of an array."""
    magnitudes = np.abs(values)
    return float(magnitudes.max())


def start_step(plant: Plant, velocity_rad_s: FloatArray, current_a: FloatArray) -> FloatArray:
    """Accelerations of one step from a velocity, under a current."""
    plant.velocity_rad_s[:] = velocity_rad_s
    plant.step(current_a)
    change_rad_s = plant.velocity_rad_s - velocity_rad_s
    return change_rad_s / plant._mechanics.step_s


def posed(plant: Plant, rng: np.random.Generator) -> None:
    """Put a plant into a random closed pose, at rest."""
    assert plant.mechanism is not None
    motor_count = len(plant._gain)
    reach = 0.3
    if "slide-x" in plant.mechanism.joints:
        reach = 0.06
    direction = rng.uniform(-1.0, 1.0, plant.mechanism.mobility)
    moved = plant._basis @ direction
    scale = reach / largest_absolute(moved[:motor_count])
    position = plant.mechanism.start_rad + scale * moved
    plant.position_rad[:] = plant.mechanism.closed(position)
    plant._settle()


@dataclass(frozen=True)
class LinkMotion:
    """A link's frame along the axes of the world."""

    jacobian: FloatArray
    acceleration: FloatArray
    angular_rad_s: FloatArray
    rotation: FloatArray


class Constrained:
    """The equations of motion with multipliers, from Pinocchio's frames alone."""

    def __init__(self, spec: CellSpec, plant: Plant) -> None:
        assert plant.mechanism is not None
        self.spec = spec
        self.order = plant.mechanism.order
        self.model = link_model(spec)
        self.data = self.model.createData()
        self.n = len(self.order)

    def _sorted(self, values: FloatArray) -> FloatArray:
        out = np.empty(self.n)
        out[self.order] = values
        return out

    def rows(self, q: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobian of the closures and its change times the velocity,
        both in the order of the plant.
        """
        q = self._sorted(q)
        v = self._sorted(v)
        no_acceleration = np.zeros(self.n)
        pin.forwardKinematics(self.model, self.data, q, v, no_acceleration)
        pin.updateFramePlacements(self.model, self.data)
        jacobians = []
        changes = []
        for closure in self.spec.closures:
            first = self._link_motion(closure.first, q)
            second = self._link_motion(closure.second, q)
            turn = np.kron(np.eye(2), first.rotation.T)
            closed = [ALL.index(direction) for direction in closure.directions]
            change = second.acceleration - first.acceleration
            change[3:] -= np.cross(first.angular_rad_s, second.angular_rad_s)
            jacobian = turn @ (second.jacobian - first.jacobian)
            in_plant_order = jacobian[:, self.order]
            in_first_frame = turn @ change
            jacobians.append(in_plant_order[closed])
            changes.append(in_first_frame[closed])
        return np.vstack(jacobians), np.concatenate(changes)

    def _link_motion(self, link: str, q: FloatArray) -> LinkMotion:
        """Motion of a link, from the kinematics computed last."""
        model = self.model
        data = self.data
        aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        frame = model.getFrameId(link, pin.FrameType.BODY)
        jacobian = pin.computeFrameJacobian(model, data, q, frame, aligned)
        acceleration = pin.getFrameClassicalAcceleration(model, data, frame, aligned)
        velocity = pin.getFrameVelocity(model, data, frame, aligned)
        return LinkMotion(
            jacobian.copy(),
            acceleration.vector.copy(),
            velocity.angular.copy(),
            data.oMf[frame].rotation,
        )

    def accelerations(
        self, q: FloatArray, v: FloatArray, torque: FloatArray, change: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Accelerations with J_c a = −change, and the torque that passes from each joint to the
        links.
        """
        jacobian = self.rows(q, v)[0]
        sorted_q = self._sorted(q)
        sorted_v = self._sorted(v)
        sorted_mass = np.array(pin.crba(self.model, self.data, sorted_q))
        sorted_bias = pin.nonLinearEffects(self.model, self.data, sorted_q, sorted_v)
        mass = sorted_mass[np.ix_(self.order, self.order)]
        bias = sorted_bias[self.order]

        axis_count = len(self.spec.axes)
        motors = motor_rows(self.spec.ratio)
        passive = np.zeros((axis_count, self.n - axis_count))
        rows = np.hstack([motors, passive])
        inertias = [axis.motor_inertia_kg_m2 for axis in self.spec.axes]
        rotor = rows.T @ np.diag(inertias) @ rows

        c = len(jacobian)
        corner = np.zeros((c, c))
        links = [mass + rotor, jacobian.T]
        system = np.block([links, [jacobian, corner]])
        free_torque = rows.T @ torque - bias
        right_side = np.concatenate([free_torque, -change])
        solution = np.linalg.lstsq(system, right_side, rcond=1e-13)[0]
        acceleration = solution[: self.n]
        load = torque @ rows - rotor @ acceleration
        return acceleration, load


@pytest.mark.parametrize("payload", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_are_those_of_a_solution_with_multipliers(name: str, payload: bool) -> None:
    bodies = {"five-bar": "block", "orthoglide": "spindle", "dualv": "disc"}
    body = bodies[name] if payload else None
    spec = frictionless(cell(name, body))
    plant = released(spec)
    reference = Constrained(spec, plant)
    rng = np.random.default_rng(3)
    step_s = plant._mechanics.step_s
    rest = np.zeros(len(plant.position_rad))
    assert plant.mechanism is not None
    assert plant.mechanism.mobility == MOBILITY[name]

    for _ in range(4):
        posed(plant, rng)
        q = plant.position_rad.copy()
        jacobian, _ = reference.rows(q, rest)
        direction = rng.uniform(-1.0, 1.0, plant.mechanism.mobility)
        v = plant._basis @ direction
        assert largest_absolute(jacobian @ v) < 1e-12

        # The speed of a step is closed where the step began, J_c(q − h v) v = 0, so that J_c(q) v =
        # h J̇_c v at its end.
        change = reference.rows(q, v)[1]
        jacobian_inverse = np.linalg.pinv(jacobian, rcond=1e-10)
        v += step_s * jacobian_inverse @ change
        current = rng.normal(0.0, 2.0, len(spec.axes))
        torque = plant._gain * current
        expected, load = reference.accelerations(q, v, torque, change)

        found = start_step(plant, v, current)

        tolerance = 1e-8 * largest_absolute(expected)
        np.testing.assert_allclose(found, expected, atol=tolerance)
        load_tolerance = 1e-7 * largest_absolute(load)
        np.testing.assert_allclose(plant.load_torque_nm, load, atol=load_tolerance)


def point_constraints(spec: CellSpec, model: pin.Model) -> pin.StdVec_RigidConstraintModel:
    """The closures of a cell as points that coincide, in the terms of Pinocchio."""
    constraints = pin.StdVec_RigidConstraintModel()
    for closure in spec.closures:
        first_frame = model.getFrameId(closure.first, pin.FrameType.BODY)
        second_frame = model.getFrameId(closure.second, pin.FrameType.BODY)
        first = model.frames[first_frame]
        second = model.frames[second_frame]
        # A plane closes the third translation by itself; two points on the free axis close the two
        # other rotations.
        points = [np.zeros(3)]
        if len(closure.directions) == 5:
            free = [f"r{axis}" not in closure.directions for axis in "xyz"]
            points.append(0.1 * np.array(free))
        for point in points:
            at = pin.SE3(np.eye(3), point)
            constraint = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                model,
                first.parentJoint,
                first.placement * at,
                second.parentJoint,
                second.placement * at,
                pin.ReferenceFrame.LOCAL,
            )
            constraints.append(constraint)
    return constraints


@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_from_rest_are_those_of_pinocchio(name: str) -> None:
    """Against Pinocchio's own constrained dynamics,
    its proximal iterations taking the redundant rows.
    """
    spec = without_motor_inertia(frictionless(cell(name)))
    plant = released(spec)
    assert plant.mechanism is not None
    rng = np.random.default_rng(4)
    posed(plant, rng)
    order = plant.mechanism.order
    axis_count = len(spec.axes)
    current_rng = np.random.default_rng(5)
    current = current_rng.normal(0.0, 1.0, axis_count)
    rest = np.zeros(len(plant.position_rad))
    torque = np.zeros_like(rest)
    q = np.zeros_like(rest)
    motor_torque = plant._gain * current
    torque[order[:axis_count]] = motor_rows(spec.ratio).T @ motor_torque
    q[order] = plant.position_rad

    model = link_model(spec)
    data = model.createData()
    constraints = point_constraints(spec, model)
    datas = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        datas.append(constraint.createData())
    pin.initConstraintDynamics(model, data, constraints, datas)
    settings = pin.ProximalSettings(1e-13, 1e-10, 200)
    sorted_acceleration = pin.constraintDynamics(
        model, data, q, rest, torque, constraints, datas, settings
    )
    expected = sorted_acceleration[order]

    plant.step(current)

    found = plant.velocity_rad_s / plant._mechanics.step_s
    tolerance = 1e-8 * largest_absolute(expected)
    np.testing.assert_allclose(found, expected, atol=tolerance)


def slides_of(place_m: FloatArray) -> FloatArray:
    """Inverse kinematics of an Orthoglide with rods of 310 mm,
    zero in the isotropic pose (Pashkevich et al. 2006).
    """
    x, y, z = place_m
    across = [np.hypot(y, z), np.hypot(z, x), np.hypot(x, y)]
    along = np.sqrt(0.310**2 - np.square(across))
    return np.asarray(place_m + 0.310 - along)


def test_an_orthoglide_moves_as_it_should_and_turns_nothing() -> None:
    spec = cell("orthoglide")
    plant = Plant(spec)
    assert plant.mechanism is not None
    empty = replace(spec, payload=None)
    model = link_model(empty)
    data = model.createData()
    frame = model.getFrameId("plate-centre", pin.FrameType.BODY)
    rng = np.random.default_rng(6)
    places_m = rng.uniform(-0.04, 0.1, (5, 3))

    for place_m in places_m:
        position = plant.mechanism.start_rad
        for share in np.linspace(0.1, 1.0, 10):
            slides = slides_of(share * place_m)
            start = np.concatenate([slides, position[3:]])
            position = plant.mechanism.closed(start, (3,))
        sorted_position = np.empty_like(position)
        sorted_position[plant.mechanism.order] = position
        pin.framesForwardKinematics(model, data, sorted_position)
        plate = data.oMf[frame]
        np.testing.assert_allclose(plate.translation, place_m, atol=1e-10)
        np.testing.assert_allclose(plate.rotation, np.eye(3), atol=1e-10)


def test_the_rods_of_the_orthoglide_follow_from_its_design_rule() -> None:
    """Transmission factors of 0.5 to 2 in a cube of 200 mm (Chablat and Wenger 2003)."""
    factors = []
    grid_m = np.linspace(-0.073, 0.127, 5)
    coordinates = np.meshgrid(grid_m, grid_m, grid_m)
    corners = np.stack(coordinates, axis=-1).reshape(-1, 3)
    for corner in corners:
        columns = []
        for step_m in 1e-6 * np.eye(3):
            ahead = slides_of(corner + step_m)
            behind = slides_of(corner - step_m)
            columns.append((ahead - behind) / 2e-6)
        jacobian = np.array(columns).T
        singular_values = np.linalg.svd(jacobian, compute_uv=False)
        factors.append(1.0 / singular_values)
    assert np.min(factors) == pytest.approx(0.5, abs=0.005)
    assert np.max(factors) == pytest.approx(2.0, abs=0.02)


CRANK_M = 0.25

ROD_M = 0.45

ASSEMBLY_RAD = {
    "crank-1": -2.35619449,
    "crank-2": -0.7853981634,
    "elbow-1": 1.598133444,
    "elbow-2": -1.598133444,
}


def unit_vectors(angle: FloatArray) -> FloatArray:
    """The directions e(angle), one a column."""
    return np.array([np.cos(angle), np.sin(angle)])


def normal_vectors(angle: FloatArray) -> FloatArray:
    """The derivatives e′(angle), one a column."""
    return np.array([-np.sin(angle), np.cos(angle)])


class FiveBarByHand:
    """Equations of motion in the coordinates y = (θ₁, θ₂, ϕ₁, ϕ₂).

    Closure: A₁ + l₁ e(θ₁) + l₂ e(ϕ₁) = A₂ + l₁ e(θ₂) + l₂ e(ϕ₂).
    """

    def __init__(self, spec: CellSpec) -> None:
        empty = replace(spec, payload=None)
        model = link_model(empty)
        self.axes = spec.axes
        self.bodies = {}
        for name in model.names[1:]:
            joint = model.getJointId(name)
            self.bodies[name] = model.inertias[joint]

    def angles(self, position_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Absolute angles of the cranks and of the rods."""
        assembly = np.array(list(ASSEMBLY_RAD.values()))
        joints = position_rad + assembly
        crank = joints[:2]
        rod = crank + joints[2:]
        return crank, rod

    def closure(self, crank: FloatArray, rod: FloatArray) -> FloatArray:
        """Jacobian of the closure, shape (2, 4)."""
        signs = [1, -1]
        across_crank = CRANK_M * normal_vectors(crank) * signs
        across_rod = ROD_M * normal_vectors(rod) * signs
        return np.hstack([across_crank, across_rod])

    def closure_change(self, crank: FloatArray, rod: FloatArray, rates: FloatArray) -> FloatArray:
        """Change of that Jacobian with time, times the rates."""
        signs = [1, -1]
        along_crank = CRANK_M * unit_vectors(crank) * signs
        along_rod = ROD_M * unit_vectors(rod) * signs
        along = np.hstack([along_crank, along_rod])
        return -along @ rates**2

    def mass_and_bias(
        self, crank: FloatArray, rod: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mass matrix, and the torques of gravity and of the rates."""
        mass = np.zeros((4, 4))
        bias = np.zeros(4)
        for k in (0, 1):
            turned = k
            swung = 2 + k
            body = self.bodies[f"crank-{k + 1}"]
            link = self.bodies[f"elbow-{k + 1}"]
            c = body.lever[:2]
            r = link.lever[:2]
            crank_inertia = body.inertia[2, 2] + body.mass * c @ c
            rod_inertia = link.inertia[2, 2] + link.mass * r @ r
            mass[turned, turned] = crank_inertia + link.mass * CRANK_M**2
            mass[turned, turned] += self.axes[k].motor_inertia_kg_m2
            mass[swung, swung] = rod_inertia

            bend = rod[k] - crank[k]
            cosine = np.cos(bend)
            sine = np.sin(bend)
            coupling = link.mass * CRANK_M
            along = r[0] * cosine - r[1] * sine
            across = r[0] * sine + r[1] * cosine
            mass[turned, swung] = coupling * along
            mass[swung, turned] = coupling * along
            centrifugal = coupling * across
            bias[turned] -= centrifugal * rates[swung] ** 2
            bias[swung] += centrifugal * rates[turned] ** 2

            crank_lever = c[0] * np.cos(crank[k]) - c[1] * np.sin(crank[k])
            rod_lever = r[0] * np.cos(rod[k]) - r[1] * np.sin(rod[k])
            bias[turned] += 9.81 * body.mass * crank_lever
            bias[turned] += 9.81 * coupling * np.cos(crank[k])
            bias[swung] += 9.81 * link.mass * rod_lever
        return mass, bias


def joint_rates(rates: FloatArray) -> FloatArray:
    """The plant's cranks and elbows from the absolute rates."""
    crank = rates[:2]
    rod = rates[2:]
    return np.concatenate([crank, rod - crank])


def test_a_five_bar_follows_its_lagrangian() -> None:
    """Absolute angles θ of the cranks and ϕ of the rods,
    written out by hand with two multipliers.
    """
    spec = frictionless(cell("five-bar"))
    plant = released(spec)
    by_hand = FiveBarByHand(spec)
    rng = np.random.default_rng(8)
    step_s = plant._mechanics.step_s
    assert plant.mechanism is not None
    assert plant.mechanism.joints == tuple(ASSEMBLY_RAD)

    for _ in range(5):
        posed(plant, rng)
        crank, rod = by_hand.angles(plant.position_rad)
        closure = by_hand.closure(crank, rod)
        crank_rates = rng.normal(0.0, 1.0, 2)
        moved = closure[:, :2] @ crank_rates
        rod_rates = np.linalg.solve(closure[:, 2:], -moved)
        rates = np.concatenate([crank_rates, rod_rates])
        change = by_hand.closure_change(crank, rod, rates)
        rates += step_s * np.linalg.pinv(closure) @ change  # as in the test above
        mass, bias = by_hand.mass_and_bias(crank, rod, rates)

        current = rng.normal(0.0, 1.0, 2)
        motor_torque = plant._gain * current
        crank_torque = motor_rows(spec.ratio).T @ motor_torque
        torque = np.concatenate([crank_torque, np.zeros(2)])
        corner = np.zeros((2, 2))
        system = np.block([[mass, closure.T], [closure, corner]])
        still_open = closure @ rates / step_s
        right_side = np.concatenate([torque - bias, -still_open])
        expected = np.linalg.solve(system, right_side)[:4]

        found = start_step(plant, joint_rates(rates), current)

        tolerance = 1e-7 * largest_absolute(expected)
        np.testing.assert_allclose(found, joint_rates(expected), atol=tolerance)


def energy(plant: Plant, reference: Constrained) -> float:
    """Kinetic and potential energy of a plant without payload or friction."""
    spec = reference.spec
    q = reference._sorted(plant.position_rad)
    v = reference._sorted(plant.velocity_rad_s)
    axis_speeds = plant.velocity_rad_s[: len(spec.axes)]
    motor_speeds = motor_rows(spec.ratio) @ axis_speeds
    inertias = [axis.motor_inertia_kg_m2 for axis in spec.axes]
    rotors = 0.5 * np.dot(inertias, motor_speeds**2)
    links = pin.computeKineticEnergy(reference.model, reference.data, q, v)
    potential = pin.computePotentialEnergy(reference.model, reference.data, q)
    return float(links + rotors + potential)


def energy_drift(spec: CellSpec, substeps: int) -> float:
    """Change of the energy in forty steps without current."""
    finer = replace(spec, substeps=substeps)
    plant = released(finer)
    rng = np.random.default_rng(7)
    posed(plant, rng)
    reference = Constrained(finer, plant)
    grid = np.linspace(0.4, 0.8, plant._basis.shape[1])
    kick = 3.0 * plant._basis @ grid
    plant.velocity_rad_s[:] = kick / largest_absolute(kick)
    start = energy(plant, reference)
    no_current = np.zeros(len(spec.axes))
    for _ in range(40 * substeps):
        plant.step(no_current)
    return abs(energy(plant, reference) - start)


@pytest.mark.parametrize("name", ROBOTS)
def test_energy_drift_vanishes_with_the_step(name: str) -> None:
    spec = frictionless(cell(name))
    coarse = energy_drift(spec, 4)
    fine = energy_drift(spec, 16)
    assert coarse > 1e-9
    assert coarse / fine == pytest.approx(4.0, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_closures_hold_in_a_long_run_and_friction_only_takes_energy(name: str) -> None:
    spec = cell(name)
    plant = released(spec)
    assert plant.mechanism is not None
    n = len(spec.axes)
    step_s = plant._mechanics.step_s
    reach = 0.12
    if name == "orthoglide":
        reach *= 0.3
    motor_inertia = plant.motor_inertia_at(plant.position_rad)
    stiffness = 60.0 * np.abs(motor_inertia)
    damping = 0.1 * stiffness
    to_current = motor_rows(spec.ratio).T
    largest_opening = 0.0

    axis_numbers = np.arange(n)
    angular_frequency = 2 * np.pi * 1.1
    for k in range(4000):
        time_s = k * step_s
        phase_rad = angular_frequency * time_s + axis_numbers
        place = reach * np.sin(phase_rad)
        error = place - plant.position_rad[:n]
        pull = stiffness * error - damping * plant.velocity_rad_s[:n]
        torque = np.linalg.solve(to_current, pull)
        plant.step(torque / plant._gain)
        rubbing = plant._mechanics.directions.T @ plant._impulse
        assert rubbing @ plant.velocity_rad_s <= 1e-9
        if k % 20 == 0:
            opening = plant.mechanism.at(plant.position_rad)[0]
            largest_opening = max(largest_opening, largest_absolute(opening))

    assert largest_opening < 1e-11
    moved_rad = plant.position_rad - plant.mechanism.start_rad
    assert largest_absolute(moved_rad) > 0.01
    motor_rad = spec.ratio @ plant.position_rad[:n]
    np.testing.assert_allclose(plant.motor_rad, motor_rad, rtol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_mechanism_loaded_below_its_friction_stays_exactly_where_it_is(name: str) -> None:
    shipped = cell(name)
    axes = tuple(without_offset(axis) for axis in shipped.axes)
    spec = replace(shipped, axes=axes, gravity_m_s2=(0.0, 0.0, 0.0))
    plant = released(spec)
    start = plant.position_rad.copy()
    breakaway_a = [axis.coulomb_nm / abs(axis.gain_nm_per_a) for axis in spec.axes]
    below_a = 0.9 * np.array(breakaway_a)
    axis_numbers = np.arange(len(spec.axes))

    for k in range(60):
        phase_rad = k / 7.0 + axis_numbers
        plant.step(below_a * np.cos(phase_rad))
        assert (plant.velocity_rad_s == 0.0).all()
    assert (plant.position_rad == start).all()

    for _ in range(40):
        plant.step(4.0 * below_a)
    speeds_rad_s = np.abs(plant.velocity_rad_s)
    assert speeds_rad_s.min() > 0.0


@pytest.mark.parametrize("name", ROBOTS)
def test_brakes_hold(name: str) -> None:
    plant = Plant(cell(name))
    no_current = np.zeros(len(plant._gain))
    for _ in range(20):
        plant.step(no_current)
    assert (plant.velocity_rad_s == 0.0).all()


@pytest.mark.parametrize("name", ["five-bar", "orthoglide"])
def test_a_braked_motor_stays_while_the_others_move(name: str) -> None:
    spec = cell(name)
    plant = Plant(spec)
    start_rad = plant.position_rad.copy()
    axis_count = len(spec.axes)
    closed = np.zeros(axis_count, dtype=np.bool_)
    closed[0] = True
    plant.set_brakes(closed)
    current_a = np.full(axis_count, 1.5)
    for _ in range(100):
        plant.step(current_a)
    assert plant.position_rad[0] == start_rad[0]
    speeds_rad_s = np.abs(plant.velocity_rad_s[1:axis_count])
    assert speeds_rad_s.min() > 0.01


def test_an_effect_acts_on_a_passive_joint() -> None:
    spec = cell("five-bar")
    parameters = {"stiffness_nm_per_rad": 5.0, "rest_rad": 1.0}
    spring = UndeclaredEffect("spring", -1, parameters, joint="elbow-2")
    with_spring = replace(spec, effects=(spring,))
    plain = released(frictionless(spec))
    sprung = released(frictionless(with_spring))
    no_current = np.zeros(2)

    plain.step(no_current)
    sprung.step(no_current)

    change_rad_s = sprung.velocity_rad_s - plain.velocity_rad_s
    change = change_rad_s / plain._mechanics.step_s
    pull_nm = np.array([0, 0, 0, 5.0])
    assert change @ pull_nm > 0.0  # it works with the joint that it turns

    cogging = UndeclaredEffect("cogging", -1, {}, joint="elbow-2")
    with_cogging = replace(spec, effects=(cogging,))
    with pytest.raises(SpecInvalid, match="no motor"):
        Plant(with_cogging)
    elsewhere = replace(spring, joint="knee")
    with_unknown_joint = replace(spec, effects=(elsewhere,))
    with pytest.raises(SpecInvalid, match="elbow-1, elbow-2"):
        Plant(with_unknown_joint)


def test_a_serial_plant_takes_the_same_step_as_before() -> None:
    """Bit for bit the mass matrix, bias and step that a serial robot always had."""
    spec = clean_cell("disc")
    plant = released(spec)
    model = link_model(spec)
    data = model.createData()
    other = released(spec)
    position = other.position_rad.copy()
    velocity = np.zeros(6)
    impulse = np.zeros(len(other._impulse))
    load = np.zeros(6)
    motor = np.zeros(6)
    bound = other._bound * other._mechanics.step_s
    axis_numbers = np.arange(1.0, 7.0)

    for k in range(300):
        phase_rad = 0.01 * k * axis_numbers
        current = 1.5 * np.sin(phase_rad)
        plant.step(current)
        mass = np.ascontiguousarray(pin.crba(model, data, position))
        bias = pin.nonLinearEffects(model, data, position, velocity)
        motor_torque = other._gain * current
        viscous = other._viscous.copy()
        torque = other._torque.copy()
        advance(
            other._constants,
            mass,
            bias,
            viscous,
            motor_torque,
            torque,
            bound,
            impulse,
            position,
            velocity,
            load,
        )

    assert plant.mechanism is None
    assert (plant.position_rad == position).all()
    assert (plant.velocity_rad_s == velocity).all()
    assert (plant.load_torque_nm == load).all()
    turn_rotors(other._mechanics.rotor_direction, position, motor)
    assert (plant.motor_rad == motor).all()


def test_what_does_not_close_or_move_is_refused() -> None:
    spec = cell("five-bar")
    (tip,) = spec.closures

    far_urdf = spec.urdf.replace('<origin xyz="-0.15 0 0"', '<origin xyz="-2 0 0"')
    too_far = replace(spec, urdf=far_urdf)
    with pytest.raises(SpecInvalid, match="tip stays open"):
        Plant(too_far)

    welded_tip = replace(tip, directions=("x", "y", "rz"))
    welded = replace(spec, closures=(welded_tip,))
    with pytest.raises(SpecInvalid, match=r"tip stays open|1 degrees of freedom"):
        Plant(welded)

    tip_at_knee = replace(tip, second="knee")
    unknown_link = replace(spec, closures=(tip_at_knee,))
    with pytest.raises(SpecInvalid, match="no link knee; expected one of"):
        Plant(unknown_link)

    unknown_motor = replace(spec, motors=("crank-1", "hip"))
    with pytest.raises(SpecInvalid, match="motors: the URDF has no joint hip"):
        Plant(unknown_motor)

    assembly_rad = dict(spec.assembly_rad)
    del assembly_rad["elbow-2"]
    incomplete_assembly = replace(spec, assembly_rad=assembly_rad)
    with pytest.raises(SpecInvalid, match="no position of elbow-2"):
        Plant(incomplete_assembly)

    one_motor = replace(
        spec,
        motors=spec.motors[:1],
        axes=spec.axes[:1],
        ratio=np.eye(1),
        start_rad=np.zeros(1),
    )
    with pytest.raises(SpecInvalid, match="2 degrees of freedom"):
        Plant(one_motor)

    start_rad = np.array([0.2, 0.0, 0.0, 0.0])
    open_start = replace(cell("dualv"), start_rad=start_rad)
    with pytest.raises(SpecInvalid, match="start of crank-"):
        Plant(open_start)


def test_motors_that_do_not_actuate_are_refused() -> None:
    spec = cell("orthoglide")
    # Both move the same leg.
    motors = ("slide-x", "rod-a-x", "coupler-x")
    start_rad = np.zeros(3)
    on_one_leg = replace(spec, motors=motors, passive={}, start_rad=start_rad)
    with pytest.raises(SpecInvalid, match="move 2 of 3 degrees of freedom"):
        Plant(on_one_leg)


def test_closures_that_cannot_be_met_are_reported() -> None:
    plant = released(cell("orthoglide"))
    plant.position_rad[0] = 2.0  # no rod is that long
    plant._resting[:3] = True
    with pytest.raises(ClosureLost, match=r"closures at .* keep the limits of motion away"):
        plant._settle()


def test_a_closure_of_two_rotations_leaves_the_third_free() -> None:
    """A door on two hinge frames swings by more than a right angle."""
    urdf = """<robot name="door"><link name="base"/>
    <joint name="hinge" type="revolute"><origin xyz="0 0 0"/><parent link="base"/><child link="door"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="3" effort="9"/></joint>
    <link name="door"><inertial><mass value="2"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link></robot>"""  # noqa: E501
    five_bar = cell("five-bar")
    smooth_axis = frictionless(five_bar).axes[0]
    axis = replace(smooth_axis, motor_inertia_kg_m2=0.5)
    hinges = Closure("hinge", "base", "door", ("x", "y", "z", "rx", "ry"))
    spec = replace(
        five_bar,
        urdf=urdf,
        axes=(axis,),
        ratio=np.eye(1),
        closures=(hinges,),
        motors=("hinge",),
        platform=None,
        passive={},
        assembly_rad={"hinge": 0.1},
        start_rad=np.array([1.2]),
    )
    plant = released(spec)

    plant.step(np.array([1.0]))

    gained_rad_s = 7.36 / 1.5 * plant._mechanics.step_s
    assert plant.velocity_rad_s[0] == pytest.approx(gained_rad_s)
