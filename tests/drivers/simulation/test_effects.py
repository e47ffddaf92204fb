"""Every undeclared effect changes the torque with the signature it claims, and nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

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


def extra_torque_nm(
    effect: UndeclaredEffect,
    speed: FloatArray = SPEED,
    posture: FloatArray = POSTURE,
    current: FloatArray | None = None,
    load_nm: float = 0.0,
    time_s: float = 0.0,
) -> FloatArray:
    """Return the torque that the effect adds on each joint in one step,
    from its change of velocity.
    """
    after = []
    for effects in ((), (effect,)):
        plant = Plant(clean_cell(effects=effects))
        closed = np.zeros(6, dtype=np.bool_)
        plant.set_brakes(closed)
        plant.position_rad[:] = posture
        plant.velocity_rad_s[:] = speed
        plant.motor_rad[:] = clean_cell().ratio @ posture
        plant.load_torque_nm[:] = load_nm
        plant.time_s = time_s
        plant.step(np.zeros(6) if current is None else current)
        after.append(plant.velocity_rad_s.copy())
    spec = clean_cell()
    rows = motor_rows(spec.ratio)
    changed_spec = replace(spec, payload=None)
    model = link_model(changed_spec)
    viscous_nm_s_rad = [axis.viscous_nm_s_rad for axis in spec.axes]
    viscous = np.diag(viscous_nm_s_rad)
    motor = [axis.motor_inertia_kg_m2 + STEP_S * axis.motor_viscous_nm_s_rad for axis in spec.axes]
    inertia = (
        pin.crba(model, model.createData(), posture)
        + rows.T @ np.diag(motor) @ rows
        + STEP_S * viscous
    )
    after_difference = after[1] - after[0]
    return np.asarray(inertia @ after_difference / STEP_S)


def only(axis: int, value: float) -> FloatArray:
    """A torque on one joint."""
    return np.asarray(value * np.eye(6)[axis])


@pytest.mark.parametrize("direction", [-1.0, 1.0])
@pytest.mark.parametrize("axis", range(6))
def test_odd_friction_opposes_the_motion_with_its_law(axis: int, direction: float) -> None:
    speed = direction * SPEED
    v = abs(SPEED[axis])
    s = np.sign(speed[axis])
    parameters = {"torque_at_1_rad_s_nm": 1.5, "exponent": 1 / 3}
    undeclared_effect = UndeclaredEffect("nonlinear-viscous", axis, parameters)
    cases = (
        (
            UndeclaredEffect("stribeck", axis, {"rise_nm": 2.0, "speed_rad_s": 0.3}),
            2.0 * math.exp(-v / 0.3),
        ),
        (
            undeclared_effect,
            1.5 * v ** (1 / 3),
        ),
        (
            UndeclaredEffect(
                "nonlinear-viscous", axis, {"torque_at_1_rad_s_nm": 1.5, "exponent": 2.0}
            ),
            1.5 * v**2,
        ),
    )
    for effect, size in cases:
        expected = only(axis, -s * size)
        np.testing.assert_allclose(extra_torque_nm(effect, speed), expected, atol=1e-6)


@pytest.mark.parametrize("load_nm", [-20.0, 0.0, 5.0, 10.0])
def test_load_friction_is_proportional_to_the_size_of_the_load(load_nm: float) -> None:
    effect = UndeclaredEffect("load-friction", 2, {"coefficient": 0.12})
    extra = extra_torque_nm(effect, load_nm=load_nm)
    speed_sign = np.sign(SPEED[2])
    expected = only(2, -0.12 * abs(load_nm) * speed_sign)
    np.testing.assert_allclose(extra, expected, atol=1e-6)


@pytest.mark.parametrize("load_nm", [-40.0, -3.0, 0.0, 25.0])
def test_a_gear_passes_a_part_of_the_power_whichever_side_drives(load_nm: float) -> None:
    """Power into the gear times η is the power out of it, friction of the joint included."""
    axis = clean_cell().axes[2]
    eta = 0.8
    speed_sign = np.sign(SPEED[2])
    friction = speed_sign * axis.coulomb_nm + axis.viscous_nm_s_rad * SPEED[2]
    out = load_nm + friction
    effect = UndeclaredEffect("efficiency", 2, {"efficiency": eta})
    lost = -extra_torque_nm(effect, load_nm=load_nm)
    into = out + lost[2]
    power_in = into * SPEED[2]
    power_out = out * SPEED[2]
    assert (power_out if power_in > 0.0 else power_in) == pytest.approx(
        eta * (power_in if power_in > 0.0 else power_out), abs=1e-6
    )
    expected = only(2, lost[2])
    np.testing.assert_allclose(lost, expected, atol=1e-6)


def test_load_friction_knows_the_payload() -> None:
    torque = {}
    for payload in (None, "disc"):
        effects = (UndeclaredEffect("load-friction", 1, {"coefficient": 0.1}),)
        plant = Plant(clean_cell(payload, effects))
        plant.step(np.zeros(6))
        model = link_model(clean_cell(payload))
        weight = pin.computeGeneralizedGravity(model, model.createData(), clean_cell().start_rad)
        np.testing.assert_allclose(plant.load_torque_nm, weight, atol=1e-9)
        torque[payload] = plant.load_torque_nm[1]
    absolute_disc = abs(torque["disc"])
    absolute_torque = abs(torque[None])
    assert absolute_disc > absolute_torque + 10.0


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
    for speed in (SPEED, -SPEED):
        expected = only(1, -30.0 * (POSTURE[1] - 0.2))
        np.testing.assert_allclose(extra_torque_nm(effect, speed), expected, atol=1e-6)


@pytest.mark.parametrize("name", ["cable", "slack-cable"])
@pytest.mark.parametrize("rest_m", [-0.02, 0.2])
def test_a_cable_pulls_both_joints_that_it_is_led_around(name: str, rest_m: float) -> None:
    """Its torques are the slopes of one energy, ½ k stretch²."""
    parameters = {"other_axis": 4.0, "radius_m": 0.1, "other_radius_m": -0.05}
    effect = UndeclaredEffect(
        name, 2, {**parameters, "stiffness_n_per_m": 2500.0, "rest_m": rest_m}
    )

    def energy(turned: FloatArray) -> float:
        stretch_m = float(0.1 * turned[2] - 0.05 * turned[3]) - rest_m
        if name == "slack-cable" and stretch_m < 0.0:
            return 0.0
        return 1250.0 * stretch_m**2

    slopes = []
    for joint in range(6):
        slopes.append(energy(POSTURE + only(joint, 1e-5)) - energy(POSTURE - only(joint, 1e-5)))
    expected = -np.array(slopes) / 2e-5
    np.testing.assert_allclose(extra_torque_nm(effect), expected, atol=1e-5)


def test_a_clipped_current_gives_no_more_than_its_limit() -> None:
    effect = UndeclaredEffect("clipped-current", 0, {"limit_a": 2.0})
    gain = clean_cell().axes[0].gain_nm_per_a
    for current in (-5.0, -1.0, 2.0, 3.0):
        largest_current = max(current, -2.0)
        given_a = min(largest_current, 2.0)
        lost = gain * (current - given_a)
        actual = extra_torque_nm(effect, current=only(0, current))
        expected = only(0, -lost)
        np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_an_offset_that_drifts_fades_with_time() -> None:
    parameters = {"offset_nm": 3.0, "time_constant_s": 50.0}
    effect = UndeclaredEffect("offset-drift", 1, parameters)
    expected = only(1, -3.0)
    np.testing.assert_allclose(extra_torque_nm(effect), expected, atol=1e-6)
    actual = extra_torque_nm(effect, time_s=100.0)
    np.testing.assert_allclose(actual, only(1, -3.0 * math.exp(-2.0)), atol=1e-6)


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
    }
    effect = UndeclaredEffect("counterbalance", 1, {**parameters, "preload_n": preload})

    def energy(q: float) -> float:
        difference_cosine = math.cos(q - phase_rad)
        difference_sine = math.sin(q - phase_rad)
        lever = lever_m * np.array([difference_cosine, difference_sine])
        lever_difference = lever - [base_m, 0.0]
        lever_difference_norm = np.linalg.norm(lever_difference)
        longer_m = float(lever_difference_norm) - (base_m - lever_m)
        return preload * longer_m + 0.5 * stiffness * longer_m**2

    difference = energy(angle + 1e-5) - energy(angle - 1e-5)
    expected = -difference / 2e-5
    posture = np.where(np.arange(6) == 1, angle, POSTURE)
    actual = extra_torque_nm(effect, posture=posture)
    np.testing.assert_allclose(actual, only(1, expected), atol=1e-4)


def test_position_friction_follows_the_joint_angle_and_the_sign_of_speed() -> None:
    parameters = {"amplitude_nm": 2.0, "phase_rad": 0.4}
    effect = UndeclaredEffect("position-friction", 2, parameters)
    for turn in (0.0, 1.0, 2.5):
        posture = POSTURE + only(2, turn)
        posture_cosine = math.cos(posture[2] - 0.4)
        speed_sign = np.sign(SPEED[2])
        expected = only(2, -2.0 * posture_cosine * speed_sign)
        actual = extra_torque_nm(effect, posture=posture)
        np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_cogging_repeats_with_the_motor_and_acts_along_its_gear() -> None:
    parameters = {"amplitude_nm": 0.7, "order": 4.0}
    effect = UndeclaredEffect("cogging", 5, parameters)
    ratio = clean_cell().ratio
    for turn in (0.0, 0.01, 2 * np.pi / (4 * 32)):
        posture = POSTURE + only(5, turn)
        phase_rad = 4.0 * float(ratio[5] @ posture)
        ripple = -0.7 * math.sin(phase_rad)
        # Motor 6 pulls on joints 5 and 6 (eq. 24)
        expected = np.array([0.0, 0.0, 0.0, 0.0, ripple, ripple])
        actual = extra_torque_nm(effect, posture=posture)
        np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_saturation_takes_a_cubic_share_of_the_torque() -> None:
    effect = UndeclaredEffect("saturation", 0, {"half_current_a": 6.0})
    gain = clean_cell().axes[0].gain_nm_per_a
    for current in (-3.0, -0.3, 0.3, 3.0, 6.0):
        extra = extra_torque_nm(effect, current=only(0, current))
        lost = gain * current * (1 - 1 / (1 + (current / 6.0) ** 2))
        expected = only(0, -lost)
        np.testing.assert_allclose(extra, expected, atol=1e-6)


def test_warm_up_fades_with_time() -> None:
    parameters = {"cold_fraction": 0.5, "time_constant_s": 100.0}
    effect = UndeclaredEffect("warm-up", 0, parameters)
    cold = extra_torque_nm(effect)[0]
    later = extra_torque_nm(effect, time_s=100.0)[0]
    axis = clean_cell().axes[0]
    expected = -0.5 * (axis.coulomb_nm + axis.viscous_nm_s_rad * SPEED[0])
    assert cold == pytest.approx(expected, rel=0.02)
    assert later / cold == pytest.approx(math.exp(-1.0), rel=1e-3)


HEATED = {
    "viscous_percent_per_k": -2.0, "coulomb_percent_per_k": 0.5, "time_constant_s": 10.0, "resistance_k_per_w": 0.4,  # noqa: E501
}  # fmt: skip


def test_losses_heat_a_drive_to_their_balance_and_its_friction_follows() -> None:
    """Dry 5 Nm and viscous 10 Nm s/rad at 0.8 rad/s, and 2 Ω at 3 A, for 10 s and then for ever."""
    parameters = HEATED | {"winding_ohm": 2.0}
    undeclared_effect = UndeclaredEffect("temperature-friction", 0, parameters)
    effect = build_effect(undeclared_effect, 1)
    assert not isinstance(effect, Lag)
    moment = Moment(0.0, 0.1, *(np.zeros(1) for _ in range(10)))
    moment.temperature_c[0], moment.velocity_rad_s[0], moment.current_a[0] = 25.0, -0.8, 3.0
    above_k = 0.0
    for step in range(1000):
        moment.bound_nm[0], moment.viscous_nm_s_rad[0] = 5.0, 10.0
        temperature_c = float(moment.temperature_c[0])
        warm_k = temperature_c - 25.0
        effect(moment)
        assert moment.bound_nm[0] == pytest.approx(5.0 * (1.0 + 0.005 * warm_k))
        assert moment.viscous_nm_s_rad[0] == pytest.approx(10.0 * (1.0 - 0.02 * warm_k))
        dry_w = moment.bound_nm[0] * 0.8
        viscous_w = moment.viscous_nm_s_rad[0] * 0.64
        # Euler's steps of a hundredth of the time constant.
        above_k += 0.01 * (0.4 * (2.0 * 9.0 + dry_w + viscous_w) - above_k)
        assert moment.temperature_c[0] - 25.0 == pytest.approx(above_k, rel=0.02)
        if step == 99:
            assert 0.6 < above_k / (0.4 * (18.0 + dry_w + viscous_w)) < 0.66
    # At the balance the temperature is resistance times losses.
    expected = 0.4 * (18.0 + dry_w + viscous_w)
    assert moment.temperature_c[0] - 25.0 == pytest.approx(expected, rel=1e-3)


def test_a_plant_without_that_effect_stays_at_the_temperature_of_its_surroundings() -> None:
    heated = UndeclaredEffect("temperature-friction", 1, HEATED)
    spec = clean_cell(effects=(heated,))
    plant = Plant(spec)
    closed = np.zeros(6, dtype=np.bool_)
    plant.set_brakes(closed)
    plant.velocity_rad_s[:] = SPEED
    for _ in range(20):
        plant.step(np.zeros(6))
    assert plant.temperature_c[1] > 25.0
    temperature_c = plant.temperature_c[[0, 2, 3, 4, 5]].tolist()
    assert temperature_c == [25.0] * 5


def test_presliding_builds_up_over_its_distance_after_a_reversal() -> None:
    effect = Presliding(axis=0, torque_nm=3.0, distance_rad=0.01)
    effect.bristle = -1.0
    moment = Moment(0.0, STEP_S, *(np.zeros(1) for _ in range(10)))
    moment.velocity_rad_s[0] = 0.4
    travelled = 0.0
    torque = []
    while travelled < 0.05:
        moment.bound_nm[0], moment.torque_nm[0] = 5.0, 0.0
        effect(moment)
        travelled += 0.4 * STEP_S
        torque.append(float(moment.torque_nm[0]))
        assert moment.bound_nm[0] == 2.0
        expected = -3.0 * (1.0 - 2.0 * math.exp(-travelled / 0.01))
        assert torque[-1] == pytest.approx(expected)
    assert torque[0] > 2.5
    assert torque[-1] < -2.9


def test_coupling_rubs_on_the_sum_of_two_joints() -> None:
    parameters = {"other_axis": 5, "coulomb_nm": 0.4, "viscous_nm_s_rad": 0.3}
    effect = UndeclaredEffect("coupling", 3, parameters)
    same = SPEED.copy()
    same[3:5] = [0.5, 0.9]
    size = -(0.4 + 0.3 * 1.4)
    expected = only(3, size) + only(4, size)
    np.testing.assert_allclose(extra_torque_nm(effect, same), expected, atol=1e-6)
    against = SPEED.copy()
    against[3:5] = [0.9, -0.4]
    size = -(0.4 + 0.3 * 0.5)
    np.testing.assert_allclose(
        extra_torque_nm(effect, against), only(3, size) + only(4, size), atol=1e-6
    )


def held_twist_rad(effect: UndeclaredEffect, current_a: float) -> float:
    """Return the twist between motor 1, driven by a current with its brake open,
    and its unloaded joint.
    """
    spec = clean_cell(effects=(effect,))
    # A joint that does not move under this current: the twist is the drive's alone.
    changed_axis = replace(spec.axes[0], coulomb_nm=500.0, offset_nm=0.0)
    axes = (changed_axis, *spec.axes[1:])
    changed_spec = replace(spec, axes=axes)
    plant = Plant(changed_spec)
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
        expected = gain * current / 8000.0
        assert held_twist_rad(effect, current) == pytest.approx(expected, rel=1e-6)


def test_a_drive_with_backlash_has_its_gap_between_both_flanks() -> None:
    parameters = {"gap_rad": 0.002, "stiffness_nm_per_rad": 8000.0, "damping_nm_s_per_rad": 60.0}
    effect = UndeclaredEffect("backlash", 0, parameters)
    gain = clean_cell().axes[0].gain_nm_per_a
    lost = held_twist_rad(effect, 1.0) - held_twist_rad(effect, -1.0)
    expected = 0.002 + 2 * gain / 8000.0
    assert lost == pytest.approx(expected, rel=1e-3)


def test_lag_is_of_first_order() -> None:
    lag = Lag(axis=1, time_constant_s=0.005)
    for k in range(1, 60):
        reported = np.array([1.0, 1.0])
        lag.report(reported, STEP_S)
        assert reported[0] == 1.0
        expected = 1.0 - math.exp(-k * STEP_S / 0.005)
        assert reported[1] == pytest.approx(expected)


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
    for name, parameters in (
        ("stribeck", {"rise_nm": 2.0, "speed_rad_s": 0.1}),
        ("load-friction", {"coefficient": 0.2}),
        ("efficiency", {"efficiency": 0.7}),
        ("nonlinear-viscous", {"torque_at_1_rad_s_nm": 1.0, "exponent": 0.5}),
        ("position-friction", {"amplitude_nm": 4.0, "phase_rad": 0.0}),
        ("warm-up", {"cold_fraction": 1.0, "time_constant_s": 10.0}),
        ("presliding", {"torque_nm": 9.0, "distance_rad": 0.01}),
        ("temperature-friction", HEATED | {"coulomb_percent_per_k": -1.0}),
    ):
        moment = Moment(time, STEP_S, *(np.zeros(1) for _ in range(10)))
        moment.bound_nm[0], moment.load_torque_nm[0] = 1.0, load
        moment.velocity_rad_s[0], moment.position_rad[0] = speed, angle
        moment.temperature_c[0] = 25.0 + load * load
        undeclared_effect = UndeclaredEffect(name, 0, parameters)
        effect = build_effect(undeclared_effect, 1)
        assert not isinstance(effect, Lag)
        effect(moment)
        assert moment.bound_nm[0] >= 0.0


def test_unknown_names_and_parameters_are_refused_with_what_exists() -> None:
    effect = UndeclaredEffect("striebeck", 0, {})
    with pytest.raises(SpecInvalid, match="stribeck, load-friction"):
        build_effect(effect, 6)
    parameters = {"rise": 1.0, "speed_rad_s": 0.1}
    with pytest.raises(
        SpecInvalid,
        match=r"unknown parameter rise; missing parameter rise_nm; .* rise_nm, "
        r"speed_rad_s",
    ):
        build_effect(UndeclaredEffect("stribeck", 0, parameters), 6)
    undeclared_effect = UndeclaredEffect(
        "spring", 6, {"stiffness_nm_per_rad": 1.0, "rest_rad": 0.0}
    )
    with pytest.raises(SpecInvalid, match="axis 7"):
        build_effect(undeclared_effect, 6)
    with pytest.raises(SpecInvalid, match="other_axis"):
        build_effect(
            UndeclaredEffect(
                "coupling", 3, {"other_axis": 4, "coulomb_nm": 0.4, "viscous_nm_s_rad": 0.3}
            ),
            6,
        )
    cable = {
        "other_axis": 7,
        "radius_m": 0.1,
        "other_radius_m": 0.1,
        "stiffness_n_per_m": 1.0,
        "rest_m": 0.0,
    }
    with pytest.raises(SpecInvalid, match="other_axis"):
        build_effect(UndeclaredEffect("cable", 3, cable), 6)
    with pytest.raises(SpecInvalid, match="unknown parameter bristle"):
        build_effect(
            UndeclaredEffect(
                "presliding", 0, {"torque_nm": 1.0, "distance_rad": 0.1, "bristle": 1.0}
            ),
            6,
        )
    assert len(UNDECLARED_EFFECTS) == 21


def test_a_drive_too_stiff_for_the_step_is_refused() -> None:
    parameters = {"stiffness_nm_per_rad": 1e7, "damping_nm_s_per_rad": 1.0}
    effect = UndeclaredEffect("elasticity", 5, parameters)
    with pytest.raises(SpecInvalid, match="too stiff"):
        Plant(clean_cell(effects=(effect,)))


@pytest.mark.slow
@settings(max_examples=30, deadline=None, derandomize=True)
@given(axis=st.integers(3, 5), stiffness=st.floats(10.0, 1e5), damping=st.floats(0.0, 10.0))
def test_a_drive_that_is_not_refused_comes_to_rest(
    axis: int, stiffness: float, damping: float
) -> None:
    """The flange without payload is lighter than its motor."""
    parameters = {"stiffness_nm_per_rad": stiffness, "damping_nm_s_per_rad": damping}
    try:
        effects = (UndeclaredEffect("elasticity", axis, parameters),)
        plant = Plant(clean_cell(effects=effects))
    except SpecInvalid as error:
        assert "too stiff" in str(error)
        return
    plant.velocity_rad_s[axis] = 1.0
    for _ in range(400):
        plant.step(np.zeros(6))
    absolute_velocity_rad_s = np.abs(plant.velocity_rad_s)
    assert absolute_velocity_rad_s.max() < 1.0
