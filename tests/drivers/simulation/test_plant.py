"""The mechanics of the simulated cell against independent statements of the same physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.simulation.plant import Plant, link_model, motor_rows
from drivers.simulation.spec import CellSpec, FrictionUnsolved, SpecInvalid
from tests.drivers.simulation.cells import FloatArray, clean_cell

OPEN = np.zeros(6, dtype=np.bool_)


def links(spec: CellSpec) -> tuple[pin.Model, pin.Data]:
    """The links alone, as Pinocchio has them."""
    model = link_model(spec)
    return model, model.createData()


def frictionless(spec: CellSpec) -> CellSpec:
    """The same cell without any friction or offset."""
    axes = tuple(
        replace(
            axis,
            viscous_nm_s_rad=0.0,
            coulomb_nm=0.0,
            motor_viscous_nm_s_rad=0.0,
            motor_coulomb_nm=0.0,
            offset_nm=0.0,
        )
        for axis in spec.axes
    )
    return replace(spec, axes=axes)


def friction_nm(plant: Plant) -> FloatArray:
    """Torque of dry friction and brakes on each coordinate in the last step [Nm], shape (N,)."""
    return np.asarray(plant._mechanics.directions.T @ plant._impulse / plant._mechanics.step_s)


def currents_for(spec: CellSpec, torque_nm: FloatArray) -> FloatArray:
    """Motor currents that put these torques on the joints (eq. 24)."""
    gain_nm_per_a = [axis.gain_nm_per_a for axis in spec.axes]
    gain = np.array(gain_nm_per_a)
    return np.asarray(np.linalg.solve(motor_rows(spec.ratio).T, torque_nm) / gain)


def apparent_inertia(spec: CellSpec, position: FloatArray) -> FloatArray:
    """Inertia of links and rotors, eq. 25 written out."""
    model, data = links(spec)
    rows = motor_rows(spec.ratio)
    rotor = np.diag([axis.motor_inertia_kg_m2 for axis in spec.axes])
    return np.asarray(pin.crba(model, data, position) + rows.T @ rotor @ rows)


@pytest.mark.parametrize("payload", [None, "disc"])
def test_inverse_dynamics_gives_back_the_applied_torque(payload: str | None) -> None:
    spec = clean_cell(payload)
    plant = Plant(spec)
    plant.set_brakes(OPEN)
    model, data = links(spec)
    rows = motor_rows(spec.ratio)
    gain = np.array([axis.gain_nm_per_a for axis in spec.axes])
    inertia = np.array([axis.motor_inertia_kg_m2 for axis in spec.axes])
    viscous = np.array([axis.viscous_nm_s_rad for axis in spec.axes])
    coulomb = np.array([axis.coulomb_nm for axis in spec.axes])
    motor_viscous = np.array([axis.motor_viscous_nm_s_rad for axis in spec.axes])
    motor_coulomb = np.array([axis.motor_coulomb_nm for axis in spec.axes])
    offset = np.array([axis.offset_nm for axis in spec.axes])
    step_s = 0.25e-3
    checked = 0
    for k in range(1200):
        phase_rad = 2 * np.pi * np.array([2.0, 2.3, 3.1, 3.7, 4.1, 5.3]) * k * step_s
        current = 1.5 * np.sin(phase_rad)
        q = plant.position_rad.copy()
        v = plant.velocity_rad_s.copy()
        plant.step(current)
        after = plant.velocity_rad_s
        motor = rows @ after
        a = (after - v) / step_s
        smallest_absolute_after = np.abs(after).min()
        smallest_absolute_motor = np.abs(motor).min()
        if min(smallest_absolute_after, smallest_absolute_motor) < 1e-6:
            continue  # something sticks: its friction is whatever holds it
        needed = pin.rnea(model, data, q, v, a) + rows.T @ (inertia * (rows @ a))
        needed += viscous * after + coulomb * np.sign(after) + offset
        needed += rows.T @ (motor_viscous * motor + motor_coulomb * np.sign(motor))
        actual = rows.T @ (gain * current)
        np.testing.assert_allclose(actual, needed, atol=1e-6)
        checked += 1
    assert checked > 600


def test_energy_drift_of_a_free_arm_vanishes_with_the_step() -> None:
    def drift(substeps: int) -> float:
        spec = replace(frictionless(clean_cell()), substeps=substeps)
        plant = Plant(spec)
        plant.set_brakes(OPEN)
        model, data = links(spec)

        def energy() -> float:
            q = plant.position_rad
            v = plant.velocity_rad_s
            kinetic = 0.5 * v @ apparent_inertia(spec, q) @ v
            return float(kinetic + pin.computePotentialEnergy(model, data, q))

        start = energy()
        for _ in range(250 * substeps):
            plant.step(np.zeros(6))
        return abs(energy() - start)

    # Semi-implicit Euler is of first order
    assert drift(4) / drift(16) == pytest.approx(4.0, rel=0.3)


def test_friction_and_brakes_only_take_energy() -> None:
    plant = Plant(clean_cell("disc"))
    rng = np.random.default_rng(5)
    for k in range(800):
        if k % 100 == 0:
            plant.set_brakes(rng.random(6) < 0.3)
        before = plant.velocity_rad_s.copy()
        plant.step(rng.normal(0.0, 2.0, 6))
        limit = 1e-9 * (1.0 + np.abs(before).max())
        assert friction_nm(plant) @ plant.velocity_rad_s <= limit


@given(
    share=st.lists(st.floats(-0.97, 0.97), min_size=6, max_size=6),
    payload=st.sampled_from([None, "disc", "plate"]),
)
@settings(max_examples=25, deadline=None)
def test_a_joint_loaded_below_its_friction_stays_exactly_where_it_is(
    share: list[float], payload: str | None
) -> None:
    spec = clean_cell(payload)
    model, data = links(spec)
    gravity = pin.computeGeneralizedGravity(model, data, spec.start_rad)
    coulomb_nm = [axis.coulomb_nm for axis in spec.axes]
    bound = np.array(coulomb_nm)
    offset_nm = [axis.offset_nm for axis in spec.axes]
    offset = np.array(offset_nm)
    torque_nm = gravity + offset + np.array(share) * bound
    current = currents_for(spec, torque_nm)
    plant = Plant(spec)
    plant.set_brakes(OPEN)
    for _ in range(40):
        plant.step(current)
    assert (plant.velocity_rad_s == 0.0).all()
    assert (plant.position_rad == spec.start_rad).all()


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_joint_loaded_above_its_friction_moves_that_way(joint: int, sign: float) -> None:
    spec = clean_cell()
    model, data = links(spec)
    load = pin.computeGeneralizedGravity(model, data, spec.start_rad) + [
        axis.offset_nm for axis in spec.axes
    ]
    # Motor 6 rubs on joints 5 and 6, so both bounds are given in full.
    coulomb_nm = spec.axes[joint].coulomb_nm
    motor_coulomb_nm = spec.axes[joint].motor_coulomb_nm
    own = coulomb_nm + motor_coulomb_nm + (joint == 4) * spec.axes[5].motor_coulomb_nm
    load[joint] += sign * 1.2 * own
    plant = Plant(spec)
    plant.set_brakes(OPEN)
    for _ in range(40):
        plant.step(currents_for(spec, load))
    assert sign * plant.velocity_rad_s[joint] > 0.0


def test_coupled_motors_follow_equations_24_and_25() -> None:
    spec = replace(frictionless(clean_cell()), gravity_m_s2=(0.0, 0.0, 0.0))
    gain_nm_per_a = [axis.gain_nm_per_a for axis in spec.axes]
    gain = np.array(gain_nm_per_a)
    model, data = links(spec)
    rotor = [axis.motor_inertia_kg_m2 for axis in spec.axes]
    expected = pin.crba(model, data, spec.start_rad) + np.diag(rotor)
    expected[4, 4] += rotor[5]
    expected[4, 5] += rotor[5]
    expected[5, 4] += rotor[5]
    for motor in range(6):
        plant = Plant(spec)
        plant.set_brakes(OPEN)
        plant.step(np.eye(6)[motor] * 0.5)
        torque = expected @ plant.velocity_rad_s / 0.25e-3
        pulled = np.eye(6)[motor] * 0.5 * gain[motor]
        if motor == 5:
            pulled[4] = pulled[5]  # τ_c5 = N5 τ_r5 + N6 τ_r6
        np.testing.assert_allclose(torque, pulled, atol=1e-8)


def test_friction_of_the_coupled_motor_acts_on_the_sum_of_both_joints() -> None:
    spec = clean_cell()
    plants = []
    for rubbing in (0.0, 1.6):
        changed_axis = replace(spec.axes[5], motor_coulomb_nm=rubbing)
        axes = (*spec.axes[:5], changed_axis)
        changed_spec = replace(spec, axes=axes)
        plant = Plant(changed_spec)
        plant.set_brakes(OPEN)
        plant.velocity_rad_s[4:] = [-1.0, 0.4]  # joint 6 forwards, yet motor 6 backwards
        plant.step(np.zeros(6))
        plants.append(plant)
    change = friction_nm(plants[1]) - friction_nm(plants[0])
    np.testing.assert_allclose(change[4:], [1.6, 1.6], atol=1e-7)


@pytest.mark.parametrize("payload", ["disc", "plate"])
def test_a_payload_adds_exactly_its_weight_to_what_the_brakes_hold(payload: str) -> None:
    held = {}
    for name in (None, payload):
        plant = Plant(clean_cell(name))
        for _ in range(200):
            plant.step(np.zeros(6))
        assert (plant.velocity_rad_s == 0.0).all()
        held[name] = friction_nm(plant)
    spec = clean_cell(payload)
    body = spec.payload
    assert body is not None
    model, data = links(clean_cell())

    def potential_j(q: FloatArray) -> float:
        pin.forwardKinematics(model, data, q)
        centre_m = np.array(body.centre_m)
        return float(body.mass_kg * 9.81 * data.oMi[6].act(centre_m)[2])

    step = 1e-6
    expected = []
    for e in np.eye(6):
        expected.append(
            (potential_j(spec.start_rad + step * e) - potential_j(spec.start_rad - step * e))
            / (2 * step)
        )
    difference = held[payload] - held[None]
    np.testing.assert_allclose(difference, expected, atol=1e-6)


def test_what_does_not_fit_together_is_refused() -> None:
    spec = clean_cell()
    changed_spec = replace(spec, axes=spec.axes[:5])
    with pytest.raises(SpecInvalid, match="6 joints"):
        Plant(changed_spec)
    ratio = np.zeros((6, 6))
    with pytest.raises(SpecInvalid, match="invertible"):
        Plant(replace(spec, ratio=ratio))
    with pytest.raises(SpecInvalid, match="cannot be read"):
        Plant(replace(spec, urdf="<robot"))
    urdf = spec.urdf.replace('name="J1" type="revolute"', 'name="J1" type="continuous"')
    with pytest.raises(SpecInvalid, match="continuous"):
        Plant(
            replace(
                spec,
                urdf=urdf,
            )
        )


def test_a_plant_that_cannot_be_advanced_says_so() -> None:
    plant = Plant(clean_cell())
    with pytest.raises(FrictionUnsolved, match="residual"):
        plant.step(np.full(6, np.nan))


def test_a_motor_on_another_joint_brakes_that_joint() -> None:
    spec = clean_cell()
    ratio = spec.ratio.copy()
    ratio[[0, 1]] = ratio[[1, 0]]  # motor 1 drives joint 2, motor 2 joint 1
    changed_spec = replace(spec, ratio=ratio)
    plant = Plant(changed_spec)
    closed = np.array([False, True, True, True, True, True])
    plant.set_brakes(closed)
    for _ in range(200):
        plant.step(np.zeros(6))
    assert plant.velocity_rad_s[1] != 0.0  # joint 2 falls, for the brake of its motor is open
    assert plant.velocity_rad_s[0] == 0.0
    expected = 32.0 * plant.position_rad[1]
    assert plant.motor_rad[0] == pytest.approx(expected)
