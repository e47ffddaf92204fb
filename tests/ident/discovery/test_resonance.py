"""Flexible gears and gears with a gap whose resonance lies in the band:
one effect explains it, and none joins.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.evidence import Evidence
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.discovery.resonance import propose_resonances, refined_gear
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import columns_at
from ident.effects.signals import fitted_signals
from ident.effects.transmission import Backlash, Elasticity
from ident.effects.twist import DrivenLink, Gears, spring_torque, twists
from ident.model.robot import Motion
from tests.ident.recordings import (
    MOUNTED,
    Truth,
    bent,
    gathered,
    record,
    search_problem_of,
    training_error,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
GATES = Gates(draws=199)
AXIS = 1
COMPLIANCE = 8.0e-4  #: of a resonance a few times as fast as the moves [rad/Nm]
RATIO = 0.2  #: of damping
STEPS_HZ = 8000.0
NEAR = frozenset({"elasticity", "lag", "backlash", "presliding", "load-friction"})


@pytest.fixture(scope="module")
def quick(small_truth: Truth) -> Evidence:
    """Runs at 1 kHz: the flanks of a gap are crossed in some milliseconds."""
    rng = np.random.default_rng(3)
    runs = []
    for index, payload in enumerate((None, MOUNTED, None, MOUNTED)):
        run = record(
            small_truth,
            f"run{index}",
            rng,
            payload,
            noise_a=0.3,
            seconds=22.0,
            averaged=1,
        )
        runs.append(run)
    return gathered(small_truth, tuple(runs))


def _stepped(
    torque: FloatArray,
    inertia: FloatArray,
    rate_hz: float,
    compliance: float,
    half_gap: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Twist and its acceleration by small explicit steps from the first sample to the last,
    no windows.
    """
    steps_of_sample = round(STEPS_HZ / rate_hz)
    steps = max(8, steps_of_sample)
    steps_hz = steps * rate_hz
    flank = half_gap * np.sign(torque[0])
    twist = torque[0] * compliance + flank
    rate = 0.0
    twists_rad = np.full(len(torque), twist)
    bends = np.zeros(len(torque))
    for k in range(len(torque) - 1):
        stiffness = inertia[k] / compliance
        damping = 2.0 * RATIO * np.sqrt(stiffness)
        torque_difference = torque[k + 1] - torque[k]
        twists_rad[k] = twist
        before = rate
        for part in range(steps):
            pulled = torque[k] + torque_difference * part / steps
            beyond = 0.0
            if twist > half_gap:
                beyond = twist - half_gap
            elif twist < -half_gap:
                beyond = twist + half_gap
            force = 0.0
            if beyond:
                force = beyond / compliance + damping * rate
            if half_gap and force * beyond < 0.0:  # a flank does not pull
                force = 0.0
            acceleration = (pulled - force) / inertia[k]
            rate += acceleration / steps_hz
            twist += rate / steps_hz
        bends[k] = (rate - before) * rate_hz
    twists_rad[-1] = twist
    bends[-1] = bends[-2]
    # Of the means from each sample to the next, those on both sides of a sample.
    before_samples = bends[:-1]
    behind_samples = bends[1:]
    bends[1:] = 0.5 * (before_samples + behind_samples)
    return twists_rad, bends


def _on_a_spring(small: Evidence, truth: Truth, compliance: float, half_gap: float) -> Evidence:
    """Recordings of an arm whose joint stands behind its motor by the twist:
    torques of the arm where it is.
    """

    def torque(data: Dataset) -> FloatArray:
        run = fitted_signals(small.model, data, small.training, small.estimate)
        assert run.arm is not None
        if half_gap:
            through = run.geared_torque_nm[AXIS]
        else:
            through = run.load_torque_nm[AXIS]
        inertia = run.inertia(AXIS, AXIS)
        twist, bend = _stepped(through, inertia, run.rate_hz, compliance, half_gap)
        twist_rate = np.gradient(twist) * run.rate_hz
        position_rad = data.position_rad.copy()
        velocity_rad_s = data.velocity_rad_s.copy()
        acceleration_rad_s2 = data.acceleration_rad_s2.copy()
        position_rad[:, AXIS] -= twist
        velocity_rad_s[:, AXIS] -= twist_rate
        acceleration_rad_s2[:, AXIS] -= bend
        motion = Motion(position_rad, velocity_rad_s, acceleration_rad_s2)
        return np.asarray(run.arm.load_change(motion))

    return bent(small, truth, torque)


def _found(start: Evidence) -> Evidence:
    families = [family for family in EFFECTS if family[0].name in NEAR]
    rng = np.random.default_rng(0)
    steps = find_effects(start, rng, GATES, tuple(families), geometry=())
    return steps[-1].after


def _coefficient_of_effect(evidence: Evidence) -> float:
    """The first coefficient behind the parameters of the model."""
    first = len(evidence.rows_without_effects.columns)
    return float(evidence.estimate.parameters[first])


def _error_percent(evidence: Evidence) -> float:
    """Error of the axis on the data of the fit."""
    return training_error(evidence).axes[AXIS]


def test_one_effect_explains_a_resonance_in_the_band_and_none_joins(
    small: Evidence, small_truth: Truth
) -> None:
    start = _on_a_spring(small, small_truth, COMPLIANCE, 0.0)
    last = _found(start)
    (placed,) = last.effects
    assert isinstance(placed.effect, Elasticity)
    assert placed.axis == AXIS
    assert placed.effect.resonant_rad_nm == pytest.approx(COMPLIANCE, rel=0.15)
    found = _coefficient_of_effect(last)
    assert found == pytest.approx(COMPLIANCE, rel=0.15)
    of_rigid_arm = _error_percent(small)
    without_effect = _error_percent(start)
    with_effect = _error_percent(last)
    assert without_effect > 1.1 * of_rigid_arm
    assert with_effect < 1.03 * of_rigid_arm
    assert last.estimate.gains == pytest.approx(small.estimate.gains, rel=0.01)


def test_one_effect_explains_a_gap_with_flanks_that_give_and_none_joins(
    quick: Evidence, small_truth: Truth
) -> None:
    start = _on_a_spring(quick, small_truth, 2e-4, 4e-3)
    last = _found(start)
    (placed,) = last.effects
    assert isinstance(placed.effect, Backlash)
    assert placed.axis == AXIS
    found = _coefficient_of_effect(last)
    assert found == pytest.approx(4e-3, rel=0.15)
    # The gap is refined, the compliance of its flanks is one of the three that were proposed.
    of_rigid_arm = _error_percent(quick) ** 2
    added_by_gap = _error_percent(start) ** 2 - of_rigid_arm
    left = _error_percent(last) ** 2 - of_rigid_arm
    assert left < 0.25 * added_by_gap


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_windows_hold_all_that_a_gap_does() -> None:
    """All the time in small steps, of one gap;
    all gaps at once, in windows around the turns of the torque.
    """
    rate_hz = 500.0
    time = np.arange(2500) / rate_hz
    turns = 2.0 * np.pi * time
    fast = np.sin(0.7 * turns)
    slow = np.cos(0.16 * turns)
    torque = 12.0 * fast * slow + 3.0
    inertia = 0.5 + 0.2 * np.sin(time)
    gaps = np.array([4e-4, 2e-3])
    compliances = np.array([2e-4, 1e-4])
    still = np.zeros_like(torque)
    link = DrivenLink(rate_hz, inertia, torque, still, still)
    gears = Gears(gaps, compliances, RATIO)
    made = twists(link, gears).acceleration_rad_s2
    inner = slice(100, -100)
    for one, gap, compliance in zip(made, gaps, compliances, strict=True):
        _, bend = _stepped(torque, inertia, rate_hz, compliance, gap)
        stepped = bend[inner]
        difference = one[inner] - stepped
        assert _rms(difference) < 0.1 * _rms(stepped)


def test_no_resonance_is_proposed_where_the_residual_holds_none(small: Evidence) -> None:
    problem = search_problem_of(small)
    assert propose_resonances(problem, GATES) == {}


@given(
    rate_hz=st.sampled_from((100.0, 250.0, 1000.0)),
    share=st.floats(0.02, 0.3),
    ratio=st.floats(0.05, 1.0),
    inertia=st.floats(1e-3, 1e2),
)
@settings(max_examples=40, deadline=None)
def test_a_spring_passes_a_wave_as_its_transfer_function_says(
    rate_hz: float, share: float, ratio: float, inertia: float
) -> None:
    """H = ω²/(ω² − w² + 2iζωw), at the resonance exactly, whatever the rate."""
    resonance = 2.0 * np.pi * share * rate_hz
    settling = 40.0 / (ratio * share)
    samples = round(60 + settling)
    time = np.arange(samples) / rate_hz
    stiffness_nm_rad = inertia * resonance**2
    compliance_rad_nm = 1.0 / stiffness_nm_rad
    torque_nm = np.sin(resonance * time)
    inertia_kg_m2 = np.full(len(time), inertia)
    passed = spring_torque(
        torque_nm,
        inertia_kg_m2,
        rate_hz,
        compliance_rad_nm,
        ratio,
    )
    middle = samples // 2
    phase = resonance * time - np.pi / 2.0
    expected = np.sin(phase) / (2.0 * ratio)
    assert passed[middle:] == pytest.approx(expected[middle:], abs=0.02 / ratio)


def test_a_stiff_gear_or_none_passes_the_torque_as_it_is() -> None:
    phase = np.arange(200.0) / 40.0
    torque = 1.0 - np.cos(phase)  # from rest
    inertia = np.ones(200)
    by_no_gear = spring_torque(torque, inertia, 1000.0, 0.0, 0.2)
    assert np.array_equal(by_no_gear, torque)
    of_negative_inertia = spring_torque(torque, -inertia, 1000.0, 1e-4, 0.2)
    assert np.array_equal(of_negative_inertia, torque)
    by_stiff_gear = spring_torque(torque, inertia, 1000.0, 1e-9, 0.2)
    assert by_stiff_gear == pytest.approx(torque, abs=1e-3)


def test_the_first_order_is_the_limit_of_a_stiff_gear(small: Evidence) -> None:
    problem = search_problem_of(small)
    run = problem.runs[0]
    inertia_kg_m2 = np.ones_like(run.inertia_kg_m2)
    run = replace(run, inertia_kg_m2=inertia_kg_m2)
    growing = 1.0 - np.cos(run.time_s)
    load_torque_nm = growing * np.ones((3, 1))
    slow = replace(run, load_torque_nm=load_torque_nm)

    def columns(effect: Elasticity) -> FloatArray:
        """Columns without the first and the last samples."""
        return effect.columns(slow, AXIS)[..., 100:-100]

    first_order = columns(Elasticity())
    of_stiff_gear = columns(Elasticity(2e-6, 0.3))
    of_soft_gear = columns(Elasticity(0.1, 0.3))
    assert of_stiff_gear == pytest.approx(first_order, abs=0.01)
    assert not np.allclose(of_soft_gear, first_order, atol=0.1)


@pytest.mark.parametrize("held", [0, 1])
def test_a_gap_is_refined_to_the_form_in_which_its_link_is_held_or_not(
    quick: Evidence, small_truth: Truth, held: int
) -> None:
    gap = Backlash(0.0, half_gap_rad=4e-3, resonant_rad_nm=2e-4, damping_ratio=0.25)
    planted = replace(gap, held=held, sags=1)

    def torque(data: Dataset) -> FloatArray:
        run = fitted_signals(quick.model, data, quick.training, quick.estimate)
        columns = columns_at(planted, run, AXIS)
        return planted.half_gap_rad * columns[:, 0]

    evidence = bent(quick, small_truth, torque)
    problem = search_problem_of(evidence)
    found = refined_gear(problem, gap, AXIS)
    assert isinstance(found, Backlash)
    assert found.held == held
    assert found.half_gap_rad == pytest.approx(4e-3, rel=0.3)
