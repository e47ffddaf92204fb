"""Closed chains of the simulated cell against independent statements of the same physics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from daq.simulation.simulation_file import load_simulation
from drivers.simulation.dynamics import advance, turn_rotors
from drivers.simulation.plant import Plant, link_model, motor_rows
from drivers.simulation.spec import CellSpec, Closure, ClosureLost, SpecInvalid, UndeclaredEffect
from tests.drivers.simulation.cells import clean_cell

FloatArray = NDArray[np.float64]

SIMULATIONS = Path(__file__).parents[3] / "configs" / "simulation"

ROBOTS = ("five-bar", "orthoglide", "dualv")

MOBILITY = {"five-bar": 2, "orthoglide": 3, "dualv": 3}

ALL = ("x", "y", "z", "rx", "ry", "rz")


def cell(name: str, payload: str | None = None) -> CellSpec:
    """A shipped closed chain."""
    path = SIMULATIONS / f"{name}.yaml"
    return load_simulation(path, payload)


def frictionless(spec: CellSpec) -> CellSpec:
    """The same without friction and offsets."""
    axes = tuple(replace(a, viscous_nm_s_rad=0.0, coulomb_nm=0.0, offset_nm=0.0) for a in spec.axes)
    return replace(spec, axes=axes, passive={})


def released(spec: CellSpec) -> Plant:
    """A plant with open brakes."""
    plant = Plant(spec)
    closed = np.zeros(len(spec.axes), dtype=np.bool_)
    plant.set_brakes(closed)
    return plant


def posed(plant: Plant, rng: np.random.Generator) -> None:
    """Put a plant into a random closed pose, at rest."""
    assert plant.mechanism is not None
    n = len(plant._gain)
    reach = 0.06 if "slide-x" in plant.mechanism.joints else 0.3
    moved = plant._basis @ rng.uniform(-1.0, 1.0, plant.mechanism.mobility)
    absolute_moved = np.abs(moved[:n])
    largest_absolute_moved = absolute_moved.max()
    position = plant.mechanism.start_rad + reach * moved / largest_absolute_moved
    plant.position_rad[:] = plant.mechanism.closed(position)
    plant._settle()


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
        pin.forwardKinematics(self.model, self.data, q, v, np.zeros(self.n))
        pin.updateFramePlacements(self.model, self.data)
        aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobians = []
        changes = []
        for closure in self.spec.closures:
            sides = []
            for link in (closure.first, closure.second):
                frame = self.model.getFrameId(link, pin.FrameType.BODY)
                jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, aligned)
                acceleration = pin.getFrameClassicalAcceleration(
                    self.model, self.data, frame, aligned
                )
                turning = pin.getFrameVelocity(self.model, self.data, frame, aligned).angular
                sides.append((jacobian.copy(), acceleration.vector.copy(), turning.copy()))
            (j1, a1, w1), (j2, a2, w2) = sides
            first = self.data.oMf[self.model.getFrameId(closure.first, pin.FrameType.BODY)].rotation
            turn = np.kron(np.eye(2), first.T)
            keep = [ALL.index(direction) for direction in closure.directions]
            change = a2 - a1
            change[3:] -= np.cross(w1, w2)
            jacobians.append((turn @ (j2 - j1))[keep][:, self.order])
            changes.append((turn @ change)[keep])
        return np.vstack(jacobians), np.concatenate(changes)

    def accelerations(
        self, q: FloatArray, v: FloatArray, torque: FloatArray, change: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Accelerations with J_c a = −change, and the torque that passes from each joint to the
        links.
        """
        jacobian = self.rows(q, v)[0]
        order = np.ix_(self.order, self.order)
        mass = np.array(pin.crba(self.model, self.data, self._sorted(q)))[order]
        bias = pin.nonLinearEffects(self.model, self.data, self._sorted(q), self._sorted(v))[
            self.order
        ]
        rows = np.hstack(
            [
                motor_rows(self.spec.ratio),
                np.zeros((len(self.spec.axes), self.n - len(self.spec.axes))),
            ]
        )
        diagonal = np.diag([a.motor_inertia_kg_m2 for a in self.spec.axes])
        rotor = rows.T @ diagonal @ rows
        c = len(jacobian)
        system = np.block([[mass + rotor, jacobian.T], [jacobian, np.zeros((c, c))]])
        stacked_bias = np.concatenate([rows.T @ torque - bias, -change])
        solution = np.linalg.lstsq(system, stacked_bias, rcond=1e-13)[0]
        return solution[: self.n], torque @ rows - rotor @ solution[: self.n]


@pytest.mark.parametrize("payload", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_are_those_of_a_solution_with_multipliers(name: str, payload: bool) -> None:
    bodies = {"five-bar": "block", "orthoglide": "spindle", "dualv": "disc"}
    spec = frictionless(cell(name, bodies[name] if payload else None))
    plant = released(spec)
    reference = Constrained(spec, plant)
    rng = np.random.default_rng(3)
    step_s = plant._mechanics.step_s
    n = len(plant.position_rad)
    assert plant.mechanism is not None
    assert plant.mechanism.mobility == MOBILITY[name]
    for _ in range(4):
        posed(plant, rng)
        q = plant.position_rad.copy()
        jacobian, _ = reference.rows(q, np.zeros(n))
        v = plant._basis @ rng.uniform(-1.0, 1.0, plant.mechanism.mobility)
        largest_error = np.abs(jacobian @ v).max()
        assert largest_error < 1e-12
        # The speed of a step is closed where the step began, J_c(q − h v) v = 0, so that J_c(q) v =
        # h J̇_c v at its end.
        change = reference.rows(q, v)[1]
        jacobian_inverse = np.linalg.pinv(jacobian, rcond=1e-10)
        v += step_s * jacobian_inverse @ change
        current = rng.normal(0.0, 2.0, len(spec.axes))
        torque = plant._gain * current
        expected, load = reference.accelerations(q, v, torque, change)
        plant.velocity_rad_s[:] = v
        plant.step(current)
        found = (plant.velocity_rad_s - v) / step_s
        largest_absolute_expected = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, atol=1e-8 * largest_absolute_expected)
        largest_absolute_load = np.abs(load).max()
        np.testing.assert_allclose(plant.load_torque_nm, load, atol=1e-7 * largest_absolute_load)


@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_from_rest_are_those_of_pinocchio(name: str) -> None:
    """Against Pinocchio's own constrained dynamics,
    its proximal iterations taking the redundant rows.
    """
    spec = frictionless(cell(name))
    axes = tuple(replace(a, motor_inertia_kg_m2=0.0) for a in spec.axes)
    spec = replace(spec, axes=axes)
    plant = released(spec)
    assert plant.mechanism is not None
    rng = np.random.default_rng(4)
    posed(plant, rng)
    order = plant.mechanism.order
    n = len(plant.position_rad)
    model = link_model(spec)
    data = model.createData()
    constraints = pin.StdVec_RigidConstraintModel()
    for closure in spec.closures:
        links = (closure.first, closure.second)
        first, second = (model.frames[model.getFrameId(link, pin.FrameType.BODY)] for link in links)
        # A plane closes the third translation by itself; two points on the free axis close the two
        # other rotations.
        points = [np.zeros(3)]
        if len(closure.directions) == 5:
            points.append(0.1 * np.array([f"r{axis}" not in closure.directions for axis in "xyz"]))
        for point in points:
            at = pin.SE3(np.eye(3), point)
            rigid_constraint_model = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                model,
                first.parentJoint,
                first.placement * at,
                second.parentJoint,
                second.placement * at,
                pin.ReferenceFrame.LOCAL,
            )
            constraints.append(rigid_constraint_model)
    current = np.random.default_rng(5).normal(0.0, 1.0, len(spec.axes))
    torque = np.zeros(n)
    q = np.zeros(n)
    torque[order[: len(spec.axes)]] = motor_rows(spec.ratio).T @ (plant._gain * current)
    q[order] = plant.position_rad
    datas = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        datas.append(constraint.createData())
    pin.initConstraintDynamics(model, data, constraints, datas)
    settings = pin.ProximalSettings(1e-13, 1e-10, 200)
    expected = pin.constraintDynamics(
        model, data, q, np.zeros(n), torque, constraints, datas, settings
    )[order]
    plant.step(current)
    found = plant.velocity_rad_s / plant._mechanics.step_s
    largest_absolute_expected = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-8 * largest_absolute_expected)


def slides_of(place_m: FloatArray) -> FloatArray:
    """Inverse kinematics of an Orthoglide with rods of 310 mm,
    zero in the isotropic pose (Pashkevich et al. 2006).
    """
    others = np.array(
        [np.hypot(place_m[1], place_m[2]), np.hypot(place_m[2], place_m[0]), np.hypot(*place_m[:2])]
    )
    return np.asarray(place_m + 0.310 - np.sqrt(0.310**2 - others**2))


def test_an_orthoglide_moves_as_it_should_and_turns_nothing() -> None:
    spec = cell("orthoglide")
    plant = Plant(spec)
    assert plant.mechanism is not None
    changed_spec = replace(spec, payload=None)
    model = link_model(changed_spec)
    data = model.createData()
    frame = model.getFrameId("plate-centre", pin.FrameType.BODY)
    rng = np.random.default_rng(6)
    for place_m in rng.uniform(-0.04, 0.1, (5, 3)):
        position = plant.mechanism.start_rad
        for share in np.linspace(0.1, 1.0, 10):
            slides = slides_of(share * place_m)
            stacked_slides = np.concatenate([slides, position[3:]])
            position = plant.mechanism.closed(stacked_slides, (3,))
        sorted_position = np.empty(len(position))
        sorted_position[plant.mechanism.order] = position
        pin.framesForwardKinematics(model, data, sorted_position)
        translation = data.oMf[frame].translation
        np.testing.assert_allclose(translation, place_m, atol=1e-10)
        rotation = data.oMf[frame].rotation
        np.testing.assert_allclose(rotation, np.eye(3), atol=1e-10)


def test_the_rods_of_the_orthoglide_follow_from_its_design_rule() -> None:
    """Transmission factors of 0.5 to 2 in a cube of 200 mm (Chablat and Wenger 2003)."""
    factors = []
    grid = np.linspace(-0.073, 0.127, 5)
    for corner in np.stack(np.meshgrid(*[grid] * 3), axis=-1).reshape(-1, 3):
        columns = []
        for e in np.eye(3):
            place_m = corner + 1e-6 * e
            columns.append((slides_of(place_m) - slides_of(corner - 1e-6 * e)) / 2e-6)
        factors.append(1.0 / np.linalg.svd(np.array(columns).T, compute_uv=False))
    assert np.min(factors) == pytest.approx(0.5, abs=0.005)
    assert np.max(factors) == pytest.approx(2.0, abs=0.02)


def test_a_five_bar_follows_its_lagrangian() -> None:
    """Absolute angles θ of the cranks and ϕ of the rods,
    written out by hand with two multipliers.
    """
    spec = frictionless(cell("five-bar"))
    plant = released(spec)
    rng = np.random.default_rng(8)
    changed_spec = replace(spec, payload=None)
    model = link_model(changed_spec)
    names = model.names[1:]
    bodies = {name: model.inertias[model.getJointId(name)] for name in names}
    crank_m = 0.25
    rod_m = 0.45
    zero = {
        "crank-1": -2.35619449,
        "crank-2": -0.7853981634,
        "elbow-1": 1.598133444,
        "elbow-2": -1.598133444,
    }
    step_s = plant._mechanics.step_s
    for _ in range(5):
        posed(plant, rng)
        x = dict(zip(("crank-1", "crank-2", "elbow-1", "elbow-2"), plant.position_rad, strict=True))
        zeros = [x[f"crank-{k}"] + zero[f"crank-{k}"] for k in (1, 2)]
        angle = np.array(zeros)
        rod = angle + [x[f"elbow-{k}"] + zero[f"elbow-{k}"] for k in (1, 2)]
        # Coordinates y = (θ₁, θ₂, ϕ₁, ϕ₂); closure A₁ + l₁ e(θ₁) + l₂ e(ϕ₁) = A₂ + l₁ e(θ₂) + l₂
        # e(ϕ₂).
        mass = np.zeros((4, 4))
        bias = np.zeros(4)
        closure = np.zeros((2, 4))
        speed = rng.normal(0.0, 1.0, 2)
        across = np.array([-np.sin(angle), np.cos(angle)]) * crank_m * [1, -1]
        across_rod = np.array([-np.sin(rod), np.cos(rod)]) * rod_m * [1, -1]
        rates = np.concatenate([speed, np.linalg.solve(across_rod, -across @ speed)])
        curve = -(np.array([np.cos(angle), np.sin(angle)]) * crank_m * [1, -1]) @ rates[:2] ** 2
        curve -= (np.array([np.cos(rod), np.sin(rod)]) * rod_m * [1, -1]) @ rates[2:] ** 2
        closure[:, :2], closure[:, 2:] = across, across_rod
        closure_inverse = np.linalg.pinv(closure)
        rates += step_s * closure_inverse @ curve  # as in the test above
        for k in (0, 1):
            crank = bodies[f"crank-{k + 1}"]
            link = bodies[f"elbow-{k + 1}"]
            c = crank.lever[:2]
            r = link.lever[:2]
            mass[k, k] = crank.inertia[2, 2] + crank.mass * c @ c + link.mass * crank_m**2
            mass[k, k] += spec.axes[k].motor_inertia_kg_m2
            mass[2 + k, 2 + k] = link.inertia[2, 2] + link.mass * r @ r
            rod_difference = rod[k] - angle[k]
            along = np.cos(rod_difference)
            phase_rad = rod[k] - angle[k]
            beside = np.sin(phase_rad)
            mass[k, 2 + k] = mass[2 + k, k] = link.mass * crank_m * (r[0] * along - r[1] * beside)
            push = link.mass * crank_m * (r[0] * beside + r[1] * along)
            bias[k] = -push * rates[2 + k] ** 2
            bias[2 + k] = push * rates[k] ** 2
            weight = 9.81
            bias[k] += weight * (crank.mass * (c[0] * np.cos(angle[k]) - c[1] * np.sin(angle[k])))
            bias[k] += weight * link.mass * crank_m * np.cos(angle[k])
            bias[2 + k] += weight * link.mass * (r[0] * np.cos(rod[k]) - r[1] * np.sin(rod[k]))
        current = rng.normal(0.0, 1.0, 2)
        torque = np.concatenate([motor_rows(spec.ratio).T @ (plant._gain * current), np.zeros(2)])
        system = np.block([[mass, closure.T], [closure, np.zeros((2, 2))]])
        stacked_torque = np.concatenate([torque - bias, -closure @ rates / step_s])
        expected = np.linalg.solve(system, stacked_torque)[:4]
        rate_difference = rates[2:] - rates[:2]
        before = np.concatenate([rates[:2], rate_difference])
        plant.velocity_rad_s[:] = before
        plant.step(current)
        found = (plant.velocity_rad_s - before) / step_s
        expected_difference = expected[2:] - expected[:2]
        stacked_expected = np.concatenate([expected[:2], expected_difference])
        largest_absolute_expected = np.abs(expected).max()
        np.testing.assert_allclose(
            found,
            stacked_expected,
            atol=1e-7 * largest_absolute_expected,
        )


@pytest.mark.parametrize("name", ROBOTS)
def test_energy_drift_vanishes_with_the_step(name: str) -> None:
    def drift(substeps: int) -> float:
        spec = replace(frictionless(cell(name)), substeps=substeps)
        plant = released(spec)
        rng = np.random.default_rng(7)
        posed(plant, rng)
        reference = Constrained(spec, plant)
        rotor = np.array([a.motor_inertia_kg_m2 for a in spec.axes])

        def energy() -> float:
            q = reference._sorted(plant.position_rad)
            v = reference._sorted(plant.velocity_rad_s)
            motors = motor_rows(spec.ratio) @ plant.velocity_rad_s[: len(spec.axes)]
            kinetic = (
                pin.computeKineticEnergy(reference.model, reference.data, q, v)
                + 0.5 * rotor @ motors**2
            )
            return float(kinetic + pin.computePotentialEnergy(reference.model, reference.data, q))

        grid = np.linspace(0.4, 0.8, plant._basis.shape[1])
        kick = 3.0 * plant._basis @ grid
        largest_absolute_kick = np.abs(kick).max()
        plant.velocity_rad_s[:] = kick / largest_absolute_kick
        start = energy()
        for _ in range(40 * substeps):
            plant.step(np.zeros(len(spec.axes)))
        return abs(energy() - start)

    coarse = drift(4)
    fine = drift(16)
    assert coarse > 1e-9
    assert coarse / fine == pytest.approx(4.0, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_closures_hold_in_a_long_run_and_friction_only_takes_energy(name: str) -> None:
    spec = cell(name)
    plant = released(spec)
    assert plant.mechanism is not None
    n = len(spec.axes)
    motor_inertia = plant.motor_inertia_at(plant.position_rad)
    stiffness = 60.0 * np.abs(motor_inertia)
    worst = 0.0
    for k in range(4000):
        phase_rad = 2 * np.pi * 1.1 * k * plant._mechanics.step_s + np.arange(n)
        place = 0.12 * np.sin(phase_rad)
        place *= 0.3 if name == "orthoglide" else 1.0
        place_difference = place - plant.position_rad[:n]
        pull = stiffness * place_difference - 0.1 * stiffness * plant.velocity_rad_s[:n]
        plant.step(np.linalg.solve(motor_rows(spec.ratio).T, pull) / plant._gain)
        rubbing = plant._mechanics.directions.T @ plant._impulse
        assert rubbing @ plant.velocity_rad_s <= 1e-9
        if k % 20 == 0:
            worst = max(worst, float(np.abs(plant.mechanism.at(plant.position_rad)[0]).max()))
    assert worst < 1e-11
    position_difference_rad = plant.position_rad - plant.mechanism.start_rad
    assert np.abs(position_difference_rad).max() > 0.01
    expected = spec.ratio @ plant.position_rad[:n]
    np.testing.assert_allclose(plant.motor_rad, expected, rtol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_mechanism_loaded_below_its_friction_stays_exactly_where_it_is(name: str) -> None:
    spec = replace(cell(name), gravity_m_s2=(0.0, 0.0, 0.0))
    axes = tuple(replace(a, offset_nm=0.0) for a in spec.axes)
    spec = replace(spec, axes=axes)
    plant = released(spec)
    start = plant.position_rad.copy()
    below = np.array([0.9 * a.coulomb_nm / abs(a.gain_nm_per_a) for a in spec.axes])
    for k in range(60):
        phase_rad = k / 7.0 + np.arange(len(spec.axes))
        plant.step(below * np.cos(phase_rad))
        assert (plant.velocity_rad_s == 0.0).all()
    assert (plant.position_rad == start).all()
    for _ in range(40):
        plant.step(4.0 * below)
    absolute_velocity_rad_s = np.abs(plant.velocity_rad_s)
    assert absolute_velocity_rad_s.min() > 0.0


@pytest.mark.parametrize("name", ROBOTS)
def test_brakes_hold(name: str) -> None:
    plant = Plant(cell(name))
    for _ in range(20):
        plant.step(np.zeros(len(plant._gain)))
    assert (plant.velocity_rad_s == 0.0).all()


@pytest.mark.parametrize("name", ["five-bar", "orthoglide"])
def test_a_braked_motor_stays_while_the_others_move(name: str) -> None:
    spec = cell(name)
    plant = Plant(spec)
    closed = np.zeros(len(spec.axes), dtype=np.bool_)
    closed[0] = True
    plant.set_brakes(closed)
    for _ in range(100):
        plant.step(np.full(len(spec.axes), 1.5))
    expected = Plant(spec).position_rad[0]
    assert plant.position_rad[0] == expected
    absolute_velocity_rad_s = np.abs(plant.velocity_rad_s[1 : len(spec.axes)])
    assert absolute_velocity_rad_s.min() > 0.01


def test_an_effect_acts_on_a_passive_joint() -> None:
    spec = cell("five-bar")
    parameters = {"stiffness_nm_per_rad": 5.0, "rest_rad": 1.0}
    spring = UndeclaredEffect("spring", -1, parameters, joint="elbow-2")
    plain = released(frictionless(spec))
    changed_spec = replace(spec, effects=(spring,))
    sprung = released(frictionless(changed_spec))
    plain.step(np.zeros(2))
    sprung.step(np.zeros(2))
    velocity_difference_rad_s = sprung.velocity_rad_s - plain.velocity_rad_s
    change = velocity_difference_rad_s / plain._mechanics.step_s
    assert change @ np.array([0, 0, 0, 5.0]) > 0.0  # it works with the joint that it turns
    undeclared_effect = UndeclaredEffect("cogging", -1, {}, joint="elbow-2")
    effects = (undeclared_effect,)
    with pytest.raises(SpecInvalid, match="no motor"):
        Plant(replace(spec, effects=effects))
    changed_spring = replace(spring, joint="knee")
    with pytest.raises(SpecInvalid, match="elbow-1, elbow-2"):
        Plant(replace(spec, effects=(changed_spring,)))


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
    for k in range(300):
        phase_rad = 0.01 * k * np.arange(1.0, 7.0)
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
    far = spec.urdf.replace('<origin xyz="-0.15 0 0"', '<origin xyz="-2 0 0"')
    with pytest.raises(SpecInvalid, match="tip stays open"):
        Plant(replace(spec, urdf=far))
    welded = replace(tip, directions=("x", "y", "rz"))
    closures = (welded,)
    with pytest.raises(SpecInvalid, match=r"tip stays open|1 degrees of freedom"):
        Plant(replace(spec, closures=closures))
    changed_tip = replace(tip, second="knee")
    changed_spec = replace(spec, closures=(changed_tip,))
    with pytest.raises(SpecInvalid, match="no link knee; expected one of"):
        Plant(changed_spec)
    with pytest.raises(SpecInvalid, match="motors: the URDF has no joint hip"):
        Plant(replace(spec, motors=("crank-1", "hip")))
    assembly_rad = {k: v for k, v in spec.assembly_rad.items() if k != "elbow-2"}
    with pytest.raises(SpecInvalid, match="no position of elbow-2"):
        Plant(replace(spec, assembly_rad=assembly_rad))
    ratio = np.eye(1)
    start_rad = np.zeros(1)
    motors = spec.motors[:1]
    axes = spec.axes[:1]
    with pytest.raises(SpecInvalid, match="2 degrees of freedom"):
        Plant(
            replace(
                spec,
                motors=motors,
                axes=axes,
                ratio=ratio,
                start_rad=start_rad,
            )
        )
    with pytest.raises(SpecInvalid, match="start of crank-"):
        other = cell("dualv")
        Plant(replace(other, start_rad=np.array([0.2, 0.0, 0.0, 0.0])))


def test_motors_that_do_not_actuate_are_refused() -> None:
    spec = cell("orthoglide")
    # Both move the same leg.
    motors = ("slide-x", "rod-a-x", "coupler-x")
    start_rad = np.zeros(3)
    changed_spec = replace(spec, motors=motors, passive={}, start_rad=start_rad)
    with pytest.raises(SpecInvalid, match="move 2 of 3 degrees of freedom"):
        Plant(changed_spec)


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
    axes = cell("five-bar").axes
    axis = replace(axes[0], motor_inertia_kg_m2=0.5, viscous_nm_s_rad=0.0, coulomb_nm=0.0)
    closures = (Closure("hinge", "base", "door", ("x", "y", "z", "rx", "ry")),)
    start_rad = np.array([1.2])
    spec = replace(
        cell("five-bar"),
        urdf=urdf,
        axes=(replace(axis, offset_nm=0.0),),
        ratio=np.eye(1),
        closures=closures,
        motors=("hinge",),
        platform=None,
        passive={},
        assembly_rad={"hinge": 0.1},
        start_rad=start_rad,
    )
    plant = released(spec)
    plant.step(np.array([1.0]))
    expected = 7.36 / 1.5 * plant._mechanics.step_s
    assert plant.velocity_rad_s[0] == pytest.approx(expected)
