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
AXIS, COMPLIANCE, RATIO = 1, 8.0e-4, 0.2  # a resonance a few times as fast as the moves
STEPS_HZ = 8000.0
NEAR = frozenset({"elasticity", "lag", "backlash", "presliding", "load-friction"})


@pytest.fixture(scope="module")
def quick(small_truth: Truth) -> Evidence:
    """Runs at 1 kHz: the flanks of a gap are crossed in some milliseconds."""
    rng = np.random.default_rng(3)
    runs = tuple(
        record(
            small_truth,
            f"run{index}",
            rng,
            MOUNTED if index % 2 else None,
            noise_a=0.3,
            seconds=22.0,
            averaged=1,
        )
        for index in range(4)
    )
    return gathered(small_truth, runs)


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
    steps = max(8, round(STEPS_HZ / rate_hz))
    torque_sign = np.sign(torque[0])
    twist = torque[0] * compliance + half_gap * torque_sign
    rate = 0.0
    twists_rad = np.full(len(torque), twist)
    bends = np.zeros(len(torque))
    for k in range(len(torque) - 1):
        damping = 2.0 * RATIO * np.sqrt(inertia[k] / compliance)
        twists_rad[k] = twist
        before = rate
        for part in range(steps):
            torque_difference = torque[k + 1] - torque[k]
            pulled = torque[k] + torque_difference * part / steps
            if twist > half_gap:
                force = (twist - half_gap) / compliance + damping * rate
                force = max(force, 0.0) if half_gap else force
            elif twist < -half_gap:
                force = (twist + half_gap) / compliance + damping * rate
                force = min(force, 0.0) if half_gap else force
            else:
                force = 0.0
            rate += (pulled - force) / inertia[k] / (steps * rate_hz)
            twist += rate / (steps * rate_hz)
        bends[k] = (rate - before) * rate_hz
    twists_rad[-1] = twist
    bends[-1] = bends[-2]
    # Of the means from each sample to the next, those on both sides of a sample.
    bends[1:] = 0.5 * (bends[:-1] + bends[1:])
    return twists_rad, bends


def _on_a_spring(small: Evidence, truth: Truth, compliance: float, half_gap: float) -> Evidence:
    """Recordings of an arm whose joint stands behind its motor by the twist:
    torques of the arm where it is.
    """

    def torque(data: Dataset) -> FloatArray:
        run = fitted_signals(small.model, data, small.training, small.estimate)
        assert run.arm is not None
        through = (run.geared_torque_nm if half_gap else run.load_torque_nm)[AXIS]
        inertia = run.inertia(AXIS, AXIS)
        twist, bend = _stepped(through, inertia, run.rate_hz, compliance, half_gap)
        lag = np.stack((twist, np.gradient(twist) * run.rate_hz, bend))
        states = np.stack((data.position_rad, data.velocity_rad_s, data.acceleration_rad_s2))
        states[:, :, AXIS] -= lag
        motion = Motion(*states)
        return np.asarray(run.arm.load_change(motion))

    return bent(small, truth, torque)


def _found(start: Evidence) -> Evidence:
    families = tuple(family for family in EFFECTS if family[0].name in NEAR)
    rng = np.random.default_rng(0)
    effects = find_effects(start, rng, GATES, families, geometry=())
    return effects[-1].after


def test_one_effect_explains_a_resonance_in_the_band_and_none_joins(
    small: Evidence, small_truth: Truth
) -> None:
    start = _on_a_spring(small, small_truth, COMPLIANCE, 0.0)
    last = _found(start)
    ((effect, axis),) = [(placed.effect, placed.axis) for placed in last.effects]
    assert isinstance(effect, Elasticity)
    assert axis == AXIS
    assert effect.resonant_rad_nm == pytest.approx(COMPLIANCE, rel=0.15)
    found = last.estimate.parameters[len(last.rows_without_effects.columns)]
    assert found == pytest.approx(COMPLIANCE, rel=0.15)
    errors = [training_error(evidence).axes[AXIS] for evidence in (start, last, small)]
    assert errors[0] > 1.1 * errors[2]
    assert errors[1] < 1.03 * errors[2]
    assert last.estimate.gains == pytest.approx(small.estimate.gains, rel=0.01)


def test_one_effect_explains_a_gap_with_flanks_that_give_and_none_joins(
    quick: Evidence, small_truth: Truth
) -> None:
    start = _on_a_spring(quick, small_truth, 2e-4, 4e-3)
    last = _found(start)
    ((effect, axis),) = [(placed.effect, placed.axis) for placed in last.effects]
    assert isinstance(effect, Backlash)
    assert axis == AXIS
    assert last.estimate.parameters[len(last.rows_without_effects.columns)] == pytest.approx(
        4e-3, rel=0.15
    )
    errors = [training_error(evidence).axes[AXIS] for evidence in (start, last, quick)]
    # The gap is refined, the compliance of its flanks is one of the three that were proposed.
    assert errors[1] ** 2 - errors[2] ** 2 < 0.25 * (errors[0] ** 2 - errors[2] ** 2)


def test_windows_hold_all_that_a_gap_does() -> None:
    """The whole time in small steps, of one gap;
    all gaps at once, in windows around the turns of the torque.
    """
    rate_hz = 500.0
    time = np.arange(2500) / rate_hz
    torque = 12.0 * np.sin(2.0 * np.pi * 0.7 * time) * np.cos(2.0 * np.pi * 0.16 * time) + 3.0
    inertia = 0.5 + 0.2 * np.sin(time)
    gaps = np.array([4e-4, 2e-3])
    compliances = np.array([2e-4, 1e-4])
    still = np.zeros_like(torque)
    link = DrivenLink(rate_hz, inertia, torque, still, still)
    gears = Gears(gaps, compliances, RATIO)
    made = twists(link, gears).acceleration_rad_s2
    for one, gap, compliance in zip(made, gaps, compliances, strict=True):
        whole = _stepped(torque, inertia, rate_hz, compliance, gap)[1][100:-100]
        left = one[100:-100] - whole
        rms = np.sqrt(np.mean(left**2))
        rms_whole = np.sqrt(np.mean(whole**2))
        assert rms < 0.1 * rms_whole


def test_no_resonance_is_proposed_where_the_residual_holds_none(small: Evidence) -> None:
    assert propose_resonances(search_problem_of(small), GATES) == {}


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
    time = np.arange(round(60 + 40.0 / (ratio * share))) / rate_hz
    compliance_rad_nm = 1.0 / (inertia * resonance**2)
    torque_nm = np.sin(resonance * time)
    inertia_kg_m2 = np.full(len(time), inertia)
    passed = spring_torque(
        torque_nm,
        inertia_kg_m2,
        rate_hz,
        compliance_rad_nm,
        ratio,
    )
    settled = slice(len(time) // 2, None)
    expected = np.sin(resonance * time - np.pi / 2.0) / (2.0 * ratio)
    assert passed[settled] == pytest.approx(expected[settled], abs=0.02 / ratio)


def test_a_stiff_gear_or_none_passes_the_torque_as_it_is() -> None:
    torque = 1.0 - np.cos(np.arange(200.0) / 40.0)  # from rest
    inertia = np.ones(200)
    assert np.array_equal(spring_torque(torque, inertia, 1000.0, 0.0, 0.2), torque)
    assert np.array_equal(spring_torque(torque, -inertia, 1000.0, 1e-4, 0.2), torque)
    assert spring_torque(torque, inertia, 1000.0, 1e-9, 0.2) == pytest.approx(torque, abs=1e-3)


def test_the_first_order_is_the_limit_of_a_stiff_gear(small: Evidence) -> None:
    problem = search_problem_of(small)
    run = problem.runs[0]
    inertia_kg_m2 = np.ones_like(run.inertia_kg_m2)
    run = replace(run, inertia_kg_m2=inertia_kg_m2)
    time_cosine = np.cos(run.time_s)
    load_torque_nm = (1.0 - time_cosine) * np.ones((3, 1))
    slow = replace(run, load_torque_nm=load_torque_nm)
    first = Elasticity().columns(slow, AXIS)[..., 100:-100]
    assert Elasticity(2e-6, 0.3).columns(slow, AXIS)[..., 100:-100] == pytest.approx(
        first, abs=0.01
    )
    assert not np.allclose(Elasticity(0.1, 0.3).columns(slow, AXIS)[..., 100:-100], first, atol=0.1)


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
