"""A link behind a gear that is not rigid:
what friction holds, what the twist changes, and what the gear passes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence
from ident.effects.signals import Signals
from ident.effects.transmission import Backlash, Elasticity
from ident.effects.twist import DrivenLink, Gears, link_of, torque_of_twist, twists
from ident.model.robot import Motion
from tests.ident.recordings import search_problem_of

pytestmark = pytest.mark.slow

RATE_HZ = 1000.0
INERTIA_KG_M2 = 0.2
DRY_NM = 4.0
HALF_GAP_RAD = 3e-3
COMPLIANCE_RAD_NM = 1e-4
RATIO = 0.3
STEPS = 40  #: Of a sample, where every step is computed
AXIS = 1


def _back_and_forth(weight_nm: float) -> DrivenLink:
    """A motor that moves, rests for a while, and moves back; the link has a weight."""
    time_s = np.arange(2400) / RATE_HZ
    speed = np.zeros_like(time_s)
    for begin_s, direction in ((0.1, 1.0), (1.2, -1.0)):
        inside = (time_s >= begin_s) & (time_s < begin_s + 0.7)
        time_difference_s = time_s[inside] - begin_s
        speed[inside] = direction * 0.8 * np.sin(np.pi * time_difference_s / 0.7) ** 2
    torque = weight_nm + INERTIA_KG_M2 * np.gradient(speed) * RATE_HZ
    inertia_kg_m2 = np.full(len(time_s), INERTIA_KG_M2)
    dry_nm = np.full(len(time_s), DRY_NM)
    return DrivenLink(
        RATE_HZ,
        inertia_kg_m2,
        torque,
        speed,
        dry_nm,
    )


def _stepped(
    link: DrivenLink, gap_rad: float, compliance_rad_nm: float, twist_rad: float
) -> NDArray[np.float64]:
    """What the gear passes, step by step from the first sample to the last:
    two masses with friction, no windows.
    """
    damping = 2.0 * RATIO * np.sqrt(INERTIA_KG_M2 / compliance_rad_nm)
    step_s = 1.0 / (STEPS * link.rate_hz)
    lag_rate = 0.0
    passed = np.zeros(len(link.torque_nm))
    for sample in range(len(passed) - 1):
        summed = 0.0
        for part in range(STEPS):
            share = part / STEPS
            clipped_twist_rad = np.clip(twist_rad, -gap_rad, gap_rad)
            pressed = twist_rad - clipped_twist_rad
            force = pressed / compliance_rad_nm + damping * lag_rate
            if gap_rad > 0.0:
                if pressed == 0.0:
                    force = 0.0
                elif pressed > 0.0:
                    force = max(force, 0.0)
                else:
                    force = min(force, 0.0)
            moving_nm = (1.0 - share) * link.torque_nm[sample] + share * link.torque_nm[sample + 1]
            motor_rad_s = (1.0 - share) * link.speed_rad_s[sample] + share * link.speed_rad_s[
                sample + 1
            ]
            link_rad_s = motor_rad_s - lag_rate - step_s * (moving_nm - force) / INERTIA_KG_M2
            most = step_s * DRY_NM / INERTIA_KG_M2
            link_rad_s = np.sign(link_rad_s) * max(abs(link_rad_s) - most, 0.0)
            lag_rate = motor_rad_s - link_rad_s
            twist_rad += step_s * lag_rate
            summed += force
        passed[sample] = summed / STEPS
    passed[-1] = passed[-2]
    # Of the means from each sample to the next, those on both sides of a sample.
    passed[1:] = 0.5 * (passed[:-1] + passed[1:])
    return passed


@pytest.mark.parametrize("weight_nm", [0.0, 2.0, -1.0])
@pytest.mark.parametrize("gap_rad", [0.0, HALF_GAP_RAD])
def test_windows_hold_all_that_a_held_link_does(weight_nm: float, gap_rad: float) -> None:
    """The whole time in small steps; in windows around turns and rests,
    with a spring between them.
    """
    link = _back_and_forth(weight_nm)
    half_gap_rad = np.array([gap_rad])
    compliance_rad_nm = np.array([COMPLIANCE_RAD_NM])
    gears = Gears(half_gap_rad, compliance_rad_nm, RATIO)
    found = twists(link, gears)
    twist_rad = float(found.twist_rad[0, 0])
    whole = _stepped(link, gap_rad, COMPLIANCE_RAD_NM, twist_rad)
    settled = slice(150, -50)
    passed_difference_nm = found.passed_nm[0] - whole
    left = passed_difference_nm[settled]
    rigid = (link.pushed_nm - whole)[settled]
    rms = np.sqrt(np.mean(left**2))
    rms_rigid = np.sqrt(np.mean(rigid**2))
    assert rms < 0.15 * rms_rigid


def test_a_motor_that_turns_back_crosses_the_gap_without_its_link() -> None:
    """Friction of 4 Nm holds a weight of 2 Nm until the motor has crossed the gap,
    of whichever size.
    """
    link = _back_and_forth(2.0)
    way_rad = np.cumsum(link.speed_rad_s) / RATE_HZ
    turned = 1200
    half_gap_rad = np.array([HALF_GAP_RAD, 2.0 * HALF_GAP_RAD])
    compliance_rad_nm = np.full(2, COMPLIANCE_RAD_NM)
    gears = Gears(half_gap_rad, compliance_rad_nm, RATIO)
    passed = twists(link, gears).passed_nm
    back_rad = way_rad[turned] - way_rad[turned:]
    unwound_rad = 10.0 * COMPLIANCE_RAD_NM
    for one, half_gap in zip(passed, gears.half_gap_rad, strict=True):
        behind = one[turned:]
        is_in_gap = (back_rad > unwound_rad) & (back_rad < 1.8 * half_gap)
        is_across = back_rad > 2.5 * half_gap + unwound_rad
        absolute_behind = np.abs(behind[is_in_gap])
        assert absolute_behind.max() == 0.0
        mean_behind = np.mean(behind[is_across][:100])
        assert mean_behind < -1.0


@given(dry_nm=st.floats(0.0, 20.0), weight_nm=st.floats(-5.0, 5.0))
@settings(max_examples=25, deadline=None)
def test_a_stiff_gear_without_a_gap_passes_what_a_rigid_one_does_in_motion(
    dry_nm: float, weight_nm: float
) -> None:
    link = replace(_back_and_forth(weight_nm), dry_nm=np.full(2400, dry_nm))
    compliance_rad_nm = np.array([1e-7])
    half_gap_rad = np.zeros(1)
    stiff = Gears(half_gap_rad, compliance_rad_nm, 1.0)
    found = twists(link, stiff)
    is_fast = np.abs(link.speed_rad_s) > 0.3
    assert found.passed_nm[0][is_fast] == pytest.approx(
        link.pushed_nm[is_fast], abs=0.05 * (1.0 + dry_nm)
    )
    absolute_twist_rad = np.abs(found.twist_rad)
    assert absolute_twist_rad.max() < 1e-5


@pytest.fixture(scope="module")
def run(small: Evidence) -> Signals:
    return search_problem_of(small).runs[0]


@pytest.mark.parametrize("size_rad", [1e-4, 2e-3])
def test_a_twist_changes_the_torque_as_the_model_of_the_twisted_arm_says(
    run: Signals, size_rad: float
) -> None:
    """D(δ) − M δ̈ is the torque of links and payload at q − δ, less that at q;
    the mass matrix is exact here.
    """
    assert run.arm is not None
    time_s = np.arange(len(run.time_s)) / run.rate_hz
    twist = size_rad * np.sin(2.0 * np.pi * 0.9 * time_s + 0.4)
    rate = np.gradient(twist) * run.rate_hz
    bend = np.gradient(rate) * run.rate_hz
    motion = run.arm.motion

    def lagging(values: FloatArray, by: FloatArray) -> FloatArray:
        changed = values.copy()
        changed[:, AXIS] -= by
        return changed

    position_rad = lagging(motion.position_rad, twist)
    velocity_rad_s = lagging(motion.velocity_rad_s, rate)
    twisted = Motion(
        position_rad,
        velocity_rad_s,
        lagging(motion.acceleration_rad_s2, bend),
    )
    expected = run.arm.load_change(twisted)
    acceleration_rad_s2 = lagging(motion.acceleration_rad_s2, bend)
    pushed = replace(motion, acceleration_rad_s2=acceleration_rad_s2)
    torque = torque_of_twist(run, AXIS, twist)
    found = torque + run.arm.load_change(pushed)
    inside = slice(5, -5)
    absolute_expected = np.abs(expected[:, inside])
    scale = absolute_expected.max()
    assert found[:, inside] == pytest.approx(expected[:, inside], abs=0.01 * scale)


def test_a_constant_twist_is_a_zero_that_is_off(run: Signals) -> None:
    """So that a gap which weight holds on one side is not named as a zero beside the gap."""
    assert run.arm is not None
    half_gap = 2e-3
    position = run.arm.motion.position_rad.copy()
    position[:, AXIS] -= half_gap
    motion = replace(run.arm.motion, position_rad=position)
    expected = run.arm.load_change(motion)
    twist_rad = np.full(len(run.time_s), half_gap)
    found = torque_of_twist(run, AXIS, twist_rad)
    assert np.abs(expected).max() > 1e-3
    # Derivatives are interpolated between postures 10 ms apart.
    largest_absolute_expected = np.abs(expected).max()
    assert found == pytest.approx(expected, abs=5e-3 * largest_absolute_expected)


def test_without_friction_a_held_link_is_one_that_is_not(run: Signals) -> None:
    free = replace(run, geared_torque_nm=run.load_torque_nm)
    moves_with_motor = Backlash(0.0, HALF_GAP_RAD, COMPLIANCE_RAD_NM, RATIO)
    held = moves_with_motor.with_settings({"held": 1})
    other = AXIS + 1
    assert held.columns(free, AXIS)[other] == pytest.approx(
        moves_with_motor.columns(free, AXIS)[other], abs=1e-6
    )
    link = link_of(free, AXIS, held=True)
    assert not np.any(link.dry_nm)


def test_a_rotor_in_the_load_does_not_move_behind_the_gear(run: Signals) -> None:
    """A setting of the effect does what a known rotor of the signals does."""
    smallest = run.inertia(AXIS, AXIS).min()
    inertia_kg_m2 = 0.3 * float(smallest)
    known = [0.0] * len(run.current_a)
    known[AXIS] = inertia_kg_m2
    beside = replace(run, rotor_inertia_kg_m2=tuple(known))
    backlash = Backlash(0.0, HALF_GAP_RAD, COMPLIANCE_RAD_NM, RATIO, 1)
    for effect in (
        backlash,
        Elasticity(COMPLIANCE_RAD_NM, RATIO, 1),
    ):
        with_rotor = effect.with_settings({"rotor_inertia_kg_m2": inertia_kg_m2})
        assert with_rotor.columns(run, AXIS) == pytest.approx(effect.columns(beside, AXIS))
        assert not np.allclose(with_rotor.columns(run, AXIS), effect.columns(run, AXIS))
