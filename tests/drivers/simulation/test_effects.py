"""Every undeclared effect changes the torque with the signature it claims, and nothing else."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.simulation.effects import UNDECLARED_EFFECTS, Lag, Moment, Presliding, build_effect
from drivers.simulation.plant import Plant, link_model, motor_rows
from drivers.simulation.spec import SpecInvalid, UndeclaredEffect
from tests.drivers.simulation.cells import FloatArray, clean_cell

STEP_S = 0.25e-3
POSTURE = np.array([0.3, -0.5, 1.2, 0.4, 0.7, -0.2])
SPEED = np.array([0.6, -0.5, 0.8, -0.9, 0.7, 0.5])
AT_REST = np.zeros(6)


def plant_of(*effects: UndeclaredEffect) -> Plant:
    """The clean cell with effects."""
    spec = clean_cell(effects=effects)
    return Plant(spec)


def release_brakes(plant: Plant) -> None:
    """Open the brake of every axis."""
    closed = np.zeros(6, dtype=np.bool_)
    plant.set_brakes(closed)


def extra_torque_nm(
    effect: UndeclaredEffect,
    speed: FloatArray = SPEED,
    posture: FloatArray = POSTURE,
    current: FloatArray = AT_REST,
    load_nm: float = 0.0,
    time_s: float = 0.0,
) -> FloatArray:
    """Return the torque that the effect adds on each joint in one step,
    from its change of velocity.
    """
    after = []
    for plant in (plant_of(), plant_of(effect)):
        release_brakes(plant)
        plant.position_rad[:] = posture
        plant.velocity_rad_s[:] = speed
        plant.motor_rad[:] = clean_cell().ratio @ posture
        plant.load_torque_nm[:] = load_nm
        plant.time_s = time_s
        plant.step(current)
        velocity_rad_s = plant.velocity_rad_s.copy()
        after.append(velocity_rad_s)
    without, with_effect = after
    acceleration = (with_effect - without) / STEP_S
    inertia = step_inertia_kg_m2(posture)
    return np.asarray(inertia @ acceleration)


def step_inertia_kg_m2(posture: FloatArray) -> FloatArray:
    """Torque at the joints per acceleration in one step, viscous friction included."""
    spec = clean_cell()
    without_payload = replace(spec, payload=None)
    model = link_model(without_payload)
    data = model.createData()
    links = pin.crba(model, data, posture)
    viscous = [axis.viscous_nm_s_rad for axis in spec.axes]
    joints = STEP_S * np.diag(viscous)
    motors = []
    for axis in spec.axes:
        viscous_kg_m2 = STEP_S * axis.motor_viscous_nm_s_rad
        motors.append(axis.motor_inertia_kg_m2 + viscous_kg_m2)
    rows = motor_rows(spec.ratio)
    drives = rows.T @ np.diag(motors) @ rows
    return np.asarray(links + drives + joints)


def check_extra(
    effect: UndeclaredEffect, expected_nm: FloatArray, atol: float = 1e-6, **state: Any
) -> None:
    """Check the torque that the effect adds on each joint."""
    extra_nm = extra_torque_nm(effect, **state)
    np.testing.assert_allclose(extra_nm, expected_nm, atol=atol)


def check_axis(
    effect: UndeclaredEffect, axis: int, torque_nm: float, atol: float = 1e-6, **state: Any
) -> None:
    """Check the torque that the effect adds on one joint, and that it adds none on the others."""
    expected_nm = only(axis, torque_nm)
    check_extra(effect, expected_nm, atol, **state)


def moment_of_one_axis(time_s: float, step_s: float) -> Moment:
    """A moment of one axis in which everything is zero."""
    zeros = [np.zeros(1) for _ in range(10)]
    return Moment(time_s, step_s, *zeros)


def only(axis: int, value: float) -> FloatArray:
    """A torque on one joint."""
    torque_nm = np.zeros(6)
    torque_nm[axis] = value
    return torque_nm


@pytest.mark.parametrize("direction", [-1.0, 1.0])
@pytest.mark.parametrize("axis", range(6))
def test_odd_friction_opposes_the_motion_with_its_law(axis: int, direction: float) -> None:
    speed = direction * SPEED
    v = abs(SPEED[axis])
    sign = np.sign(speed[axis])

    stribeck = UndeclaredEffect("stribeck", axis, {"rise_nm": 2.0, "speed_rad_s": 0.3})
    size_nm = 2.0 * math.exp(-v / 0.3)
    check_axis(stribeck, axis, -sign * size_nm, speed=speed)

    root = {"torque_at_1_rad_s_nm": 1.5, "exponent": 1 / 3}
    effect = UndeclaredEffect("nonlinear-viscous", axis, root)
    size_nm = 1.5 * v ** (1 / 3)
    check_axis(effect, axis, -sign * size_nm, speed=speed)

    square = {"torque_at_1_rad_s_nm": 1.5, "exponent": 2.0}
    effect = UndeclaredEffect("nonlinear-viscous", axis, square)
    size_nm = 1.5 * v**2
    check_axis(effect, axis, -sign * size_nm, speed=speed)


@pytest.mark.parametrize("load_nm", [-20.0, 0.0, 5.0, 10.0])
def test_load_friction_is_proportional_to_the_size_of_the_load(load_nm: float) -> None:
    effect = UndeclaredEffect("load-friction", 2, {"coefficient": 0.12})
    speed_sign = np.sign(SPEED[2])
    size_nm = 0.12 * abs(load_nm)
    check_axis(effect, 2, -size_nm * speed_sign, load_nm=load_nm)


@pytest.mark.parametrize("load_nm", [-40.0, -3.0, 0.0, 25.0])
def test_a_gear_passes_a_part_of_the_power_whichever_side_drives(load_nm: float) -> None:
    """Power into the gear times η is the power out of it, friction of the joint included."""
    axis = clean_cell().axes[2]
    eta = 0.8
    speed = SPEED[2]
    dry = axis.coulomb_nm * np.sign(speed)
    viscous = axis.viscous_nm_s_rad * speed
    out = load_nm + dry + viscous
    effect = UndeclaredEffect("efficiency", 2, {"efficiency": eta})
    lost = -extra_torque_nm(effect, load_nm=load_nm)
    into = out + lost[2]
    power_in = into * speed
    power_out = out * speed
    if power_in > 0.0:
        assert power_out == pytest.approx(eta * power_in, abs=1e-6)
    else:
        assert power_in == pytest.approx(eta * power_out, abs=1e-6)
    np.testing.assert_allclose(lost, only(2, lost[2]), atol=1e-6)


def test_load_friction_knows_the_payload() -> None:
    torque = {}
    effect = UndeclaredEffect("load-friction", 1, {"coefficient": 0.1})
    for payload in (None, "disc"):
        spec = clean_cell(payload, (effect,))
        plant = Plant(spec)
        plant.step(np.zeros(6))
        model = link_model(spec)
        data = model.createData()
        weight = pin.computeGeneralizedGravity(model, data, spec.start_rad)
        np.testing.assert_allclose(plant.load_torque_nm, weight, atol=1e-9)
        torque[payload] = abs(plant.load_torque_nm[1])
    assert torque["disc"] > torque[None] + 10.0


def test_asymmetric_viscous_is_even_in_speed() -> None:
    effect = UndeclaredEffect("asymmetric-viscous", 1, {"coefficient_nm_s_rad": 0.8})
    forwards = extra_torque_nm(effect, -SPEED)
    backwards = extra_torque_nm(effect, SPEED)
    # Implicit in the step, so it acts on the speed at its end.
    absolute_speed = abs(SPEED[1])
    expected = only(1, -0.8 * absolute_speed)
    np.testing.assert_allclose(forwards, expected, atol=0.05)
    np.testing.assert_allclose(backwards, forwards, atol=0.05)


def test_spring_depends_on_position_alone() -> None:
    parameters = {"stiffness_nm_per_rad": 30.0, "rest_rad": 0.2}
    effect = UndeclaredEffect("spring", 1, parameters)
    stretch_rad = POSTURE[1] - 0.2
    torque_nm = -30.0 * stretch_rad
    check_axis(effect, 1, torque_nm, speed=SPEED)
    check_axis(effect, 1, torque_nm, speed=-SPEED)


@pytest.mark.parametrize("name", ["cable", "slack-cable"])
@pytest.mark.parametrize("rest_m", [-0.02, 0.2])
def test_a_cable_pulls_both_joints_that_it_is_led_around(name: str, rest_m: float) -> None:
    """Its torques are the slopes of one energy, ½ k stretch²."""
    parameters = {
        "other_axis": 4.0,
        "radius_m": 0.1,
        "other_radius_m": -0.05,
        "stiffness_n_per_m": 2500.0,
        "rest_m": rest_m,
    }
    effect = UndeclaredEffect(name, 2, parameters)

    def energy(turned: FloatArray) -> float:
        own_m = 0.1 * turned[2]
        other_m = 0.05 * turned[3]
        stretch_m = float(own_m - other_m) - rest_m
        if name == "slack-cable" and stretch_m < 0.0:
            return 0.0
        return 1250.0 * stretch_m**2

    slopes = []
    for joint in range(6):
        small_turn = only(joint, 1e-5)
        after = energy(POSTURE + small_turn)
        before = energy(POSTURE - small_turn)
        slope = (after - before) / 2e-5
        slopes.append(slope)
    check_extra(effect, -np.array(slopes), atol=1e-5)


def test_a_clipped_current_gives_no_more_than_its_limit() -> None:
    effect = UndeclaredEffect("clipped-current", 0, {"limit_a": 2.0})
    gain = clean_cell().axes[0].gain_nm_per_a
    for current in (-5.0, -1.0, 2.0, 3.0):
        given_a = np.clip(current, -2.0, 2.0)
        lost = gain * (current - given_a)
        check_axis(effect, 0, -lost, current=only(0, current))


def test_an_offset_that_drifts_fades_with_time() -> None:
    parameters = {"offset_nm": 3.0, "time_constant_s": 50.0}
    effect = UndeclaredEffect("offset-drift", 1, parameters)
    check_axis(effect, 1, -3.0)
    later_nm = 3.0 * math.exp(-2.0)
    check_axis(effect, 1, -later_nm, time_s=100.0)


@given(angle=st.floats(-3.0, 3.0))
@settings(max_examples=10)
def test_a_counterbalance_gives_the_work_of_its_force(angle: float) -> None:
    """Foot, lever and joint make a triangle;
    the torque is the slope of the energy F ds summed from the shortest.
    """
    base_m = 0.5
    lever_m = 0.2
    phase_rad = 0.4
    stiffness = 900.0
    preload = 60.0
    parameters = {
        "base_m": base_m,
        "lever_m": lever_m,
        "phase_rad": phase_rad,
        "stiffness_n_per_m": stiffness,
        "preload_n": preload,
    }
    effect = UndeclaredEffect("counterbalance", 1, parameters)

    def energy(q: float) -> float:
        angle_rad = q - phase_rad
        along_m = lever_m * math.cos(angle_rad)
        x_m = along_m - base_m
        y_m = lever_m * math.sin(angle_rad)
        shortest_m = base_m - lever_m
        longer_m = math.hypot(x_m, y_m) - shortest_m
        of_preload = preload * longer_m
        of_stiffness = 0.5 * stiffness * longer_m**2
        return of_preload + of_stiffness

    after = energy(angle + 1e-5)
    before = energy(angle - 1e-5)
    slope = (after - before) / 2e-5
    posture = POSTURE.copy()
    posture[1] = angle
    check_axis(effect, 1, -slope, atol=1e-4, posture=posture)


def test_position_friction_follows_the_joint_angle_and_the_sign_of_speed() -> None:
    parameters = {"amplitude_nm": 2.0, "phase_rad": 0.4}
    effect = UndeclaredEffect("position-friction", 2, parameters)
    speed_sign = np.sign(SPEED[2])
    for turn in (0.0, 1.0, 2.5):
        posture = POSTURE + only(2, turn)
        angle_rad = posture[2] - 0.4
        dry_nm = 2.0 * math.cos(angle_rad)
        check_axis(effect, 2, -dry_nm * speed_sign, posture=posture)


def test_cogging_repeats_with_the_motor_and_acts_along_its_gear() -> None:
    parameters = {"amplitude_nm": 0.7, "order": 4.0}
    effect = UndeclaredEffect("cogging", 5, parameters)
    ratio = clean_cell().ratio
    period_rad = 2 * np.pi / (4 * 32)
    for turn in (0.0, 0.01, period_rad):
        posture = POSTURE + only(5, turn)
        motor_rad = float(ratio[5] @ posture)
        phase_rad = 4.0 * motor_rad
        ripple = -0.7 * math.sin(phase_rad)
        # Motor 6 pulls on joints 5 and 6 (eq. 24)
        expected = np.array([0.0, 0.0, 0.0, 0.0, ripple, ripple])
        check_extra(effect, expected, posture=posture)


def test_saturation_takes_a_cubic_share_of_the_torque() -> None:
    effect = UndeclaredEffect("saturation", 0, {"half_current_a": 6.0})
    gain = clean_cell().axes[0].gain_nm_per_a
    for current in (-3.0, -0.3, 0.3, 3.0, 6.0):
        square = (current / 6.0) ** 2
        share_left = 1 / (1 + square)
        torque_nm = gain * current
        lost = torque_nm * (1 - share_left)
        check_axis(effect, 0, -lost, current=only(0, current))


def test_warm_up_fades_with_time() -> None:
    parameters = {"cold_fraction": 0.5, "time_constant_s": 100.0}
    effect = UndeclaredEffect("warm-up", 0, parameters)
    cold = extra_torque_nm(effect)[0]
    later = extra_torque_nm(effect, time_s=100.0)[0]
    axis = clean_cell().axes[0]
    viscous = axis.viscous_nm_s_rad * SPEED[0]
    friction = axis.coulomb_nm + viscous
    assert cold == pytest.approx(-0.5 * friction, rel=0.02)
    share_left = later / cold
    assert share_left == pytest.approx(math.exp(-1.0), rel=1e-3)


HEATED = {
    "viscous_percent_per_k": -2.0,
    "coulomb_percent_per_k": 0.5,
    "time_constant_s": 10.0,
    "resistance_k_per_w": 0.4,
}


def test_losses_heat_a_drive_to_their_balance_and_its_friction_follows() -> None:
    """Dry 5 Nm and viscous 10 Nm s/rad at 0.8 rad/s, and 2 Ω at 3 A, for 10 s and then for ever."""
    parameters = HEATED | {"winding_ohm": 2.0}
    undeclared_effect = UndeclaredEffect("temperature-friction", 0, parameters)
    effect = build_effect(undeclared_effect, 1)
    assert not isinstance(effect, Lag)
    moment = moment_of_one_axis(0.0, 0.1)
    moment.temperature_c[0] = 25.0
    moment.velocity_rad_s[0] = -0.8
    moment.current_a[0] = 3.0
    winding_w = 2.0 * 9.0
    above_k = 0.0
    for step in range(1000):
        moment.bound_nm[0] = 5.0
        moment.viscous_nm_s_rad[0] = 10.0
        warm_k = float(moment.temperature_c[0]) - 25.0
        effect(moment)
        dry_nm = moment.bound_nm[0]
        viscous_nm_s_rad = moment.viscous_nm_s_rad[0]
        dry_growth = 1.0 + 0.005 * warm_k
        assert dry_nm == pytest.approx(5.0 * dry_growth)
        viscous_growth = 1.0 - 0.02 * warm_k
        assert viscous_nm_s_rad == pytest.approx(10.0 * viscous_growth)
        dry_w = 0.8 * dry_nm
        viscous_w = 0.64 * viscous_nm_s_rad
        losses_w = winding_w + dry_w + viscous_w
        balance_k = 0.4 * losses_w
        # Euler's steps of a hundredth of the time constant.
        above_k += 0.01 * (balance_k - above_k)
        warm_k = moment.temperature_c[0] - 25.0
        assert warm_k == pytest.approx(above_k, rel=0.02)
        if step == 99:
            assert 0.6 < above_k / balance_k < 0.66
    # At the balance the temperature is resistance times losses.
    assert warm_k == pytest.approx(balance_k, rel=1e-3)


def test_a_plant_without_that_effect_stays_at_the_temperature_of_its_surroundings() -> None:
    heated = UndeclaredEffect("temperature-friction", 1, HEATED)
    plant = plant_of(heated)
    release_brakes(plant)
    plant.velocity_rad_s[:] = SPEED
    for _ in range(20):
        plant.step(np.zeros(6))
    assert plant.temperature_c[1] > 25.0
    others_c = np.delete(plant.temperature_c, 1)
    assert others_c.tolist() == [25.0] * 5


def test_presliding_builds_up_over_its_distance_after_a_reversal() -> None:
    effect = Presliding(axis=0, torque_nm=3.0, distance_rad=0.01)
    effect.bristle = -1.0
    moment = moment_of_one_axis(0.0, STEP_S)
    moment.velocity_rad_s[0] = 0.4
    travelled = 0.0
    torque = []
    while travelled < 0.05:
        moment.bound_nm[0] = 5.0
        moment.torque_nm[0] = 0.0
        effect(moment)
        travelled += 0.4 * STEP_S
        torque_nm = float(moment.torque_nm[0])
        torque.append(torque_nm)
        assert moment.bound_nm[0] == 2.0
        share_left = math.exp(-travelled / 0.01)
        bristle = 1.0 - 2.0 * share_left
        assert torque_nm == pytest.approx(-3.0 * bristle)
    assert torque[0] > 2.5
    assert torque[-1] < -2.9


def test_coupling_rubs_on_the_sum_of_two_joints() -> None:
    parameters = {"other_axis": 5, "coulomb_nm": 0.4, "viscous_nm_s_rad": 0.3}
    effect = UndeclaredEffect("coupling", 3, parameters)
    same = SPEED.copy()
    same[3:5] = [0.5, 0.9]
    size = -(0.4 + 0.3 * 1.4)
    on_both = np.array([0.0, 0.0, 0.0, size, size, 0.0])
    check_extra(effect, on_both, speed=same)

    against = SPEED.copy()
    against[3:5] = [0.9, -0.4]
    size = -(0.4 + 0.3 * 0.5)
    on_both = np.array([0.0, 0.0, 0.0, size, size, 0.0])
    check_extra(effect, on_both, speed=against)


def held_twist_rad(effect: UndeclaredEffect, current_a: float) -> float:
    """Return the twist between motor 1, driven by a current with its brake open,
    and its unloaded joint.
    """
    spec = clean_cell(effects=(effect,))
    # A joint that does not move under this current: the twist is the drive's alone.
    stuck = replace(spec.axes[0], coulomb_nm=500.0, offset_nm=0.0)
    axes = (stuck, *spec.axes[1:])
    stuck_spec = replace(spec, axes=axes)
    plant = Plant(stuck_spec)
    closed = np.array([False, True, True, True, True, True])
    plant.set_brakes(closed)
    for _ in range(4000):
        plant.step(only(0, current_a))
    assert plant.position_rad[0] == spec.start_rad[0]
    position_difference_rad = plant.position_rad[6] - plant.position_rad[0]
    return float(position_difference_rad)


def test_an_elastic_drive_twists_by_torque_over_stiffness() -> None:
    parameters = {"stiffness_nm_per_rad": 8000.0, "damping_nm_s_per_rad": 60.0}
    effect = UndeclaredEffect("elasticity", 0, parameters)
    gain = clean_cell().axes[0].gain_nm_per_a
    for current in (-1.0, 2.0):
        twist_rad = held_twist_rad(effect, current)
        expected_rad = gain * current / 8000.0
        assert twist_rad == pytest.approx(expected_rad, rel=1e-6)


def test_a_drive_with_backlash_has_its_gap_between_both_flanks() -> None:
    parameters = {"gap_rad": 0.002, "stiffness_nm_per_rad": 8000.0, "damping_nm_s_per_rad": 60.0}
    effect = UndeclaredEffect("backlash", 0, parameters)
    gain = clean_cell().axes[0].gain_nm_per_a
    forwards_rad = held_twist_rad(effect, 1.0)
    backwards_rad = held_twist_rad(effect, -1.0)
    lost = forwards_rad - backwards_rad
    twist_rad = gain / 8000.0
    assert lost == pytest.approx(0.002 + 2 * twist_rad, rel=1e-3)


def test_lag_is_of_first_order() -> None:
    lag = Lag(axis=1, time_constant_s=0.005)
    for k in range(1, 60):
        reported = np.array([1.0, 1.0])
        lag.report(reported, STEP_S)
        assert reported[0] == 1.0
        time_s = k * STEP_S
        share_left = math.exp(-time_s / 0.005)
        assert reported[1] == pytest.approx(1.0 - share_left)


BOUND_FRICTION = (
    UndeclaredEffect("stribeck", 0, {"rise_nm": 2.0, "speed_rad_s": 0.1}),
    UndeclaredEffect("load-friction", 0, {"coefficient": 0.2}),
    UndeclaredEffect("efficiency", 0, {"efficiency": 0.7}),
    UndeclaredEffect("nonlinear-viscous", 0, {"torque_at_1_rad_s_nm": 1.0, "exponent": 0.5}),
    UndeclaredEffect("position-friction", 0, {"amplitude_nm": 4.0, "phase_rad": 0.0}),
    UndeclaredEffect("warm-up", 0, {"cold_fraction": 1.0, "time_constant_s": 10.0}),
    UndeclaredEffect("presliding", 0, {"torque_nm": 9.0, "distance_rad": 0.01}),
    UndeclaredEffect("temperature-friction", 0, HEATED | {"coulomb_percent_per_k": -1.0}),
)


@given(
    speed=st.floats(-3.0, 3.0),
    load=st.floats(-60.0, 60.0),
    angle=st.floats(-3.0, 3.0),
    time=st.floats(0.0, 1e4),
)
@settings(max_examples=60, deadline=None)
def test_bounds_of_dry_friction_never_become_negative(
    speed: float, load: float, angle: float, time: float
) -> None:
    for undeclared_effect in BOUND_FRICTION:
        moment = moment_of_one_axis(time, STEP_S)
        moment.bound_nm[0] = 1.0
        moment.load_torque_nm[0] = load
        moment.velocity_rad_s[0] = speed
        moment.position_rad[0] = angle
        moment.temperature_c[0] = 25.0 + load * load
        effect = build_effect(undeclared_effect, 1)
        assert not isinstance(effect, Lag)
        effect(moment)
        assert moment.bound_nm[0] >= 0.0


def _refuse(name: str, axis: int, parameters: dict[str, float], match: str) -> None:
    """Check that an effect is refused, with a message."""
    effect = UndeclaredEffect(name, axis, parameters)
    with pytest.raises(SpecInvalid, match=match):
        build_effect(effect, 6)


def test_unknown_names_and_parameters_are_refused_with_what_exists() -> None:
    _refuse("striebeck", 0, {}, "stribeck, load-friction")
    stribeck = {"rise": 1.0, "speed_rad_s": 0.1}
    message = r"unknown parameter rise; missing parameter rise_nm; .* rise_nm, speed_rad_s"
    _refuse("stribeck", 0, stribeck, message)
    coupling = {"other_axis": 4, "coulomb_nm": 0.4, "viscous_nm_s_rad": 0.3}
    _refuse("coupling", 3, coupling, "other_axis")
    cable = {
        "other_axis": 7,
        "radius_m": 0.1,
        "other_radius_m": 0.1,
        "stiffness_n_per_m": 1.0,
        "rest_m": 0.0,
    }
    _refuse("cable", 3, cable, "other_axis")
    presliding = {"torque_nm": 1.0, "distance_rad": 0.1, "bristle": 1.0}
    _refuse("presliding", 0, presliding, "unknown parameter bristle")
    assert len(UNDECLARED_EFFECTS) == 21


def test_a_drive_too_stiff_for_the_step_is_refused() -> None:
    parameters = {"stiffness_nm_per_rad": 1e7, "damping_nm_s_per_rad": 1.0}
    effect = UndeclaredEffect("elasticity", 5, parameters)
    with pytest.raises(SpecInvalid, match="too stiff"):
        plant_of(effect)


@pytest.mark.slow
@settings(max_examples=30, deadline=None, derandomize=True)
@given(axis=st.integers(3, 5), stiffness=st.floats(10.0, 1e5), damping=st.floats(0.0, 10.0))
def test_a_drive_that_is_not_refused_comes_to_rest(
    axis: int, stiffness: float, damping: float
) -> None:
    """The flange without payload is lighter than its motor."""
    parameters = {"stiffness_nm_per_rad": stiffness, "damping_nm_s_per_rad": damping}
    effect = UndeclaredEffect("elasticity", axis, parameters)
    try:
        plant = plant_of(effect)
    except SpecInvalid as error:
        assert "too stiff" in str(error)
        return
    plant.velocity_rad_s[axis] = 1.0
    for _ in range(400):
        plant.step(np.zeros(6))
    absolute_velocity_rad_s = np.abs(plant.velocity_rad_s)
    assert absolute_velocity_rad_s.max() < 1.0
