"""Gates beside the score: physics, runs left out, gains, and every effect beside all the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import linalg

from ident.data.dataset import Dataset
from ident.discovery import gates, joining, loop
from ident.discovery.candidates import SearchProblem, score_candidates
from ident.discovery.error_change import ErrorChange
from ident.discovery.evidence import Evidence, gather, with_effects
from ident.discovery.few_moves import FEWEST_MOVES, moves_behind
from ident.discovery.gates import (
    MIN_RUNS,
    REGIONS,
    Gates,
    PartsLeftOut,
    gain_shifts,
    impossible,
    in_noise,
    moved_gains,
    own_unknowns,
    possible_values,
    regions_to_leave_out,
    runs_to_leave_out,
    uncertain_amplitude,
    whitened_columns,
    without_effects_of,
)
from ident.discovery.joining import SetAside
from ident.discovery.loop import Step, find_effects
from ident.discovery.search import (
    Finding,
    rank_effects,
    rank_families,
)
from ident.effects.dictionary import EFFECTS, GEOMETRY
from ident.effects.effect import Effect, EffectKey, PlacedEffect, effect_key
from ident.effects.electrical import Lag
from ident.effects.friction import NonlinearViscous, Stribeck, TemperatureFriction, WarmUp
from ident.effects.position import Hinge, Spring
from ident.effects.signals import Abscissa, Signals
from ident.effects.unnamed import Smooth
from ident.equations.linearisation import Linearisation, cut_into_folds
from ident.estimators.estimate import Estimate
from ident.estimators.identify import identify
from ident.model.model import Column
from tests.ident.loops import record_in_loop
from tests.ident.recordings import (
    CONDITIONING,
    MOUNTED,
    Truth,
    acting_on,
    bent,
    search_problem_of,
    whole,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
GATES = Gates(draws=199)
EITHER_SIGN = {
    "asymmetric-viscous",
    "position-friction",
    "spring",
    "passive-spring",
    "gravity-compensator",
    "cogging",
    "ripple",
    "inertial-coupling",
    "temperature-friction",
    "lag",
    "time-skew",
    "offset-drift",
}
STICKING = (Stribeck(0.3),)
numbers = st.floats(-1e3, 1e3)


def first_rng() -> np.random.Generator:
    """The generator that every search of this file starts with."""
    return np.random.default_rng(0)


def rank(problem: SearchProblem, *families: tuple[Effect, ...]) -> tuple[Finding, ...]:
    """Findings of some families on every axis, the best first."""
    return rank_effects(problem, first_rng(), GATES, families)


def search_sticking(start: Evidence) -> tuple[Step, ...]:
    """Turns of a search for friction at low speed alone."""
    return find_effects(start, first_rng(), GATES, (STICKING,))


def families_named(*names: str) -> tuple[tuple[Effect, ...], ...]:
    """Families of the dictionary by their names."""
    return tuple(family for family in EFFECTS if family[0].name in names)


def two_runs(small: Evidence) -> SearchProblem:
    """Search problem of so few runs that none can be left out."""
    count = MIN_RUNS - 1
    training = small.training.only(small.training.run < count)
    datasets = small.datasets[:count]
    return search_problem_of(replace(small, training=training, datasets=datasets))


def with_independent_coefficients(
    joined: Evidence, own: IntArray, values: Sequence[float], variance: float
) -> Evidence:
    """The same fit with other coefficients, independent of all others."""
    estimate = joined.estimate
    parameters = estimate.parameters.copy()
    parameters[own] = values
    place = len(estimate.gains) + own
    covariance = estimate.covariance.copy()
    covariance[place, :] = 0.0
    covariance[:, place] = 0.0
    covariance[place, place] = variance
    changed_estimate = replace(estimate, parameters=parameters, covariance=covariance)
    return replace(joined, estimate=changed_estimate)


@pytest.fixture(scope="module")
def search_problem(small: Evidence) -> SearchProblem:
    return search_problem_of(small)


@given(value=numbers, std=st.floats(0.0, 1e3), least=numbers, width=st.floats(0.0, 1e3))
def test_a_coefficient_is_impossible_two_sigma_outside_its_range(
    value: float, std: float, least: float, width: float
) -> None:
    largest = least + width
    column = Column("amplitude", "Nm", least, largest)
    outside = max(least - value, value - largest)
    values = np.array([value])
    deviations = np.array([std])
    named = impossible((column,), values, deviations)
    two_sigma = 2.0 * std
    beyond_two_sigma = outside > two_sigma
    excess = outside - two_sigma
    at_the_limit = abs(excess) < 1e-9
    assert bool(named) == beyond_two_sigma or at_the_limit
    assert not named or "amplitude" in named
    unbounded = Column("stiffness", "Nm/rad")
    assert not impossible((unbounded,), values, deviations)


def test_every_family_declares_its_signs() -> None:
    """Friction dissipates, a gear gives and a motor weakens;
    springs, ripples and delays have either sign.
    """
    for family in EFFECTS:
        effect = family[0]
        coefficients = effect.coefficients
        # What two joints of a cable share has the sign of the product of its radii.
        signed = [column for column in coefficients if column.name != "shared stiffness"]
        bound = {column.least == 0.0 for column in signed}
        assert bound == {effect.name not in EITHER_SIGN}, effect.name

        falling = {column.name for column in coefficients if column.largest == 0.0}
        expected = set()
        if effect.name == "temperature-friction":
            expected.add("viscous")
        assert falling == expected

        placed_columns = PlacedEffect(effect, 0).columns
        placed_least = [column.least for column in placed_columns]
        least = [column.least for column in coefficients]
        assert placed_least == least


def test_a_time_constant_is_no_longer_than_the_data(search_problem: SearchProblem) -> None:
    runs = search_problem.runs
    ends_s = [float(run.time_s[-1]) for run in runs]
    span_s = max(ends_s)
    later = []
    for index, run in enumerate(runs):
        session_s = run.time_s + 100.0 * index
        later.append(replace(run, session_s=session_s))

    within_a_run = WarmUp(0.99 * span_s, 0)
    beyond_a_run = WarmUp(1.01 * span_s, 0)
    assert within_a_run.fits_in(runs, 0)
    assert not beyond_a_run.fits_in(later, 0)
    within_the_session = WarmUp(300.0, 1)
    beyond_the_session = WarmUp(400.0, 1)
    assert within_the_session.fits_in(later, 0)
    assert not beyond_the_session.fits_in(later, 0)

    too_slow = WarmUp(900.0, 0)
    findings = rank(search_problem, (too_slow,), (Spring(),))
    tried = {finding.effect.name for finding in findings}
    assert tried == {"spring"}


def test_a_candidate_that_rests_on_one_move_is_not_tested_and_hides_no_other(
    search_problem: SearchProblem,
) -> None:
    position_rad = [run.position_rad[1] for run in search_problem.rows]
    position = np.concatenate(position_rad)
    counted = position[search_problem.observation.use[1]]
    start_rad = float(counted.max()) - 0.02
    farthest = (Hinge(start_rad, 1),)
    (family,) = search_problem.test((farthest,), 1)
    gram = family.members[0][1].gram
    assert moves_behind(gram) < FEWEST_MOVES
    spring = search_problem.test(((Spring(),),), 1)[0]

    ranked = rank_families(search_problem, [spring, family], first_rng(), GATES)
    only = rank_families(search_problem, [spring], first_rng(), GATES)

    probabilities = {found.effect.name: found.probability for found in ranked}
    expected = {"spring": only[0].probability, "hinge": None}
    assert probabilities == expected
    (hinge,) = (found for found in ranked if found.effect.name == "hinge")
    assert hinge.refusals[0] == (
        "it rests on three moves, too few to test it: record more moves to that end of the "
        "axis' range"
    )


def with_temperature(runs: Sequence[Signals], last_c: float) -> list[Signals]:
    """The same runs, the first two of three drives warming from 30 °C; the third reports none."""
    time_s = runs[0].time_s
    reported = np.linspace(30.0, last_c, len(time_s))
    missing = np.full_like(reported, np.nan)
    temperature_c = np.stack((reported, reported, missing))
    return [replace(run, temperature_c=temperature_c) for run in runs]


def test_friction_against_temperature_is_tried_where_every_run_has_one_that_changes(
    search_problem: SearchProblem,
) -> None:
    effect = TemperatureFriction()
    runs = search_problem.runs
    assert not effect.fits_in(runs, 1)  # no temperatures at all

    warming = with_temperature(runs, 35.0)
    assert effect.fits_in(warming, 1)
    assert not effect.fits_in(warming, 2)  # its drive reports none
    one_without = [*warming[:-1], runs[-1]]
    assert not effect.fits_in(one_without, 1)
    nearly_constant = with_temperature(runs, 30.5)
    assert not effect.fits_in(nearly_constant, 1)

    # Where it is not known, the friction is that at 40 °C.
    without_any = effect.columns(runs[0], 1)
    assert not without_any.any()
    without_this_drive = effect.columns(warming[0], 2)
    assert not without_this_drive.any()


def _sticking(small: Evidence, truth: Truth, amplitude_nm: float) -> Evidence:
    """More friction of joint 2 at low speed, or less."""

    def torque(data: Dataset) -> FloatArray:
        v = data.velocity_rad_s[:, 1]
        speed = np.abs(v)
        share = np.exp(-speed / 0.3)
        torque_nm = amplitude_nm * share
        return acting_on(1, 3, np.sign(v) * torque_nm)

    return bent(small, truth, torque)


@pytest.fixture(scope="module")
def sticking(small: Evidence, small_truth: Truth) -> Evidence:
    return _sticking(small, small_truth, 6.0)


@pytest.fixture(scope="module")
def slipping(small: Evidence, small_truth: Truth) -> Evidence:
    return _sticking(small, small_truth, -6.0)


def test_physics_alone_refuses_less_friction_at_low_speed(
    sticking: Evidence, slipping: Evidence
) -> None:
    """In all else the two recordings are mirror images."""
    more = rank(search_problem_of(sticking), STICKING)[0]
    assert more.axis == 1
    assert more.passed
    assert more.refusals == ()

    less = rank(search_problem_of(slipping), STICKING)[0]
    assert less.axis == 1
    assert not less.passed
    (refusal,) = less.refusals
    assert "physics allows" in refusal


def test_of_a_family_the_possible_setting_is_taken(slipping: Evidence) -> None:
    """Less friction at low speed resembles drag that grows with the root of the speed,
    which is possible.
    """
    drag = NonlinearViscous(0.5)
    family = (*STICKING, drag)
    best = rank(search_problem_of(slipping), family)[0]
    assert best.effect == drag
    assert best.axis == 1
    assert best.passed


def test_runs_are_left_out_where_their_payload_is_in_another(small: Evidence) -> None:
    rows = small.training
    assert runs_to_leave_out(rows) == (0, 1, 2, 3)
    without_last = rows.only(rows.run != 3)
    assert runs_to_leave_out(without_last) == (0, 2)  # run 1 is now the only loaded one
    largest_run = MIN_RUNS - 1
    too_few = rows.only(rows.run < largest_run)
    assert runs_to_leave_out(too_few) == ()


def error_without_each_run(run: IntArray, matrix: FloatArray, residual: FloatArray) -> float:
    """Sum of the squared errors on each of four runs of a fit of the three others."""
    total = 0.0
    for left_out in range(4):
        own = run == left_out
        others = ~own
        solution = np.linalg.lstsq(matrix[others], residual[others], rcond=None)
        predicted = matrix[own] @ solution[0]
        error = residual[own] - predicted
        total += float(error @ error)
    return total


def test_an_error_on_runs_left_out_is_that_of_a_fit_of_the_others(
    search_problem: SearchProblem,
) -> None:
    problem = search_problem.folds.linearisation
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(len(problem.motor), 2))
    residual = problem.residual
    columns = noise + 0.3 * residual[:, None]
    run = search_problem.observation.run[problem.source]
    declared = whole(problem.jacobian)
    both = np.concatenate((declared, columns), axis=1)

    error_with = error_without_each_run(run, both, residual)
    error_without = error_without_each_run(run, declared, residual)
    parts = PartsLeftOut.of(search_problem)
    change = parts.change(columns)

    expected = error_with - error_without
    assert change.total.rise == pytest.approx(expected, rel=1e-4)


def test_what_one_run_alone_shows_stays_where_it_is_without_that_run(
    search_problem: SearchProblem,
) -> None:
    """A hose that one run alone stretches has no row in the others:
    a fit of these does not move it, nor fails.
    """
    folds = search_problem.folds
    run = search_problem.observation.run
    last_run = run.max()
    elsewhere = folds.linearisation.of_clusters(run) != last_run
    hessian = folds.cluster_hessian.copy()
    score = folds.cluster_score.copy()
    hessian[elsewhere, -1, :] = 0.0
    hessian[elsewhere, :, -1] = 0.0
    score[elsewhere, -1] = 0.0
    changed_fold = replace(folds, cluster_hessian=hessian, cluster_score=score)
    shown_once = replace(search_problem, folds=changed_fold)

    others = PartsLeftOut.of(shown_once).others[last_run]

    assert others is not None
    step = linalg.cho_solve(others.factor, others.score)
    assert step[-1] == 0.0
    total_hessian = hessian[elsewhere].sum(axis=0)
    total_score = score[elsewhere].sum(axis=0)
    moved_hessian = total_hessian[:-1, :-1]
    moved_score = total_score[:-1]
    solution = np.linalg.lstsq(moved_hessian, moved_score, rcond=None)
    expected = solution[0]
    largest_step = np.abs(expected).max()
    tolerance = 1e-6 * largest_step
    np.testing.assert_allclose(step[:-1], expected, rtol=1e-4, atol=tolerance)


def _levels(small: Evidence, truth: Truth, levels: tuple[float, ...]) -> SearchProblem:
    """A spring at joint 2 that has another stiffness in each run."""
    names = [data.name for data in small.datasets]

    def torque(data: Dataset) -> FloatArray:
        run = names.index(data.name)
        torque_nm = levels[run] * data.position_rad[:, 1]
        return acting_on(1, 3, torque_nm)

    return search_problem_of(bent(small, truth, torque))


def _powers_of_the_run(problem: SearchProblem, powers: int) -> FloatArray:
    """The spring at joint 2 as a polynomial of the run's number, whitened, shape (rows, powers)."""
    run = problem.observation.run.astype(np.float64)
    exponents = np.arange(1, powers + 1)
    powers_of_run = run ** exponents[:, None]
    spring = problem.torque(Spring(), 1)[:, :1]
    to_motor = problem.model.drive_train.to_motor
    return problem.folds.linearisation.whitened(spring * powers_of_run, to_motor)


@pytest.mark.parametrize(
    ("levels", "powers"), [((4.0, -4.0, 4.0, -4.0), 3), ((0.0, 3.0, 6.0, 9.0), 1)]
)
def test_what_only_moves_of_the_same_run_predict_is_refused(
    small: Evidence, small_truth: Truth, levels: tuple[float, ...], powers: int
) -> None:
    """Three powers follow any four levels on moves left out;
    a run left out shows that they are no law.
    """
    problem = _levels(small, small_truth, levels)
    columns = _powers_of_the_run(problem, powers)
    candidates = (slice(0, powers),)
    folds = problem.folds
    (trial,) = score_candidates(folds, columns, candidates)
    assert trial is not None
    error = folds.square_sum(folds.residual)
    assert trial.left_out.sum() < 0.9 * error.sum()
    refusal = PartsLeftOut.of(problem).refusal(columns, trial.coefficients)
    assert bool(refusal) == (powers == 3)


def squared_residual(linearisation: Linearisation, axis_noise: FloatArray) -> float:
    """Sum of the squares of the residual of a linearisation in Nm²."""
    residual_nm = linearisation.residual * axis_noise[linearisation.motor]
    return float(residual_nm @ residual_nm)


def test_without_an_effect_the_joint_fit_is_the_declared_one_to_first_order(
    sticking: Evidence,
) -> None:
    placed = PlacedEffect(STICKING[0], 1)
    joined = with_effects(sticking, (placed,))
    assert placed.columns[0] in joined.estimate.unknowns  # with its possible values

    reduced = without_effects_of(search_problem_of(joined), joined.estimate, (placed,))

    reduced_rows = reduced.search_problem.folds.linearisation
    declared_rows = search_problem_of(sticking).folds.linearisation
    reduced_square = squared_residual(reduced_rows, joined.estimate.axis_noise)
    declared_square = squared_residual(declared_rows, sticking.estimate.axis_noise)
    assert reduced_square == pytest.approx(declared_square, rel=0.01)
    shifts = joined.estimate.gains - sticking.estimate.gains
    largest_std = float(np.max(sticking.estimate.gains_std))
    assert reduced.gain_shifts == pytest.approx(shifts, abs=0.5 * largest_std)


def test_gains_that_move_by_more_than_sigma_are_named(
    search_problem: SearchProblem, small: Evidence
) -> None:
    """A torque that is a part of motor 1's own torque is a change of its gain;
    fixed gains cannot move.
    """
    folds = search_problem.folds
    std = small.estimate.gains_std
    three_sigma = 3.0 * std[0]
    share = three_sigma / small.estimate.gains[0]
    jacobian = whole(folds.linearisation.jacobian)
    motor_torque = jacobian[:, 0]
    shifts = gain_shifts(folds, -share * motor_torque)
    assert shifts[0] == pytest.approx(three_sigma, rel=1e-6)
    motors = [motor for motor, _ in moved_gains(shifts, std)]
    assert motors == [0]
    fixed_std = np.zeros(3)
    assert moved_gains(shifts, fixed_std) == ()


def test_coefficients_in_their_noise_are_no_effect() -> None:
    covariance = np.diag([1.0, 4.0])
    within_noise = np.array([1.0, 2.0])
    beyond_noise = np.array([3.0, 0.0])
    assert in_noise(within_noise, covariance)
    assert not in_noise(beyond_noise, covariance)


def _term_after(sticking: Evidence, order: tuple[Effect, ...]) -> joining.JointFit | SetAside:
    """Joint fit of a named effect and a term that can replace it,
    judged as if the last one had just joined.
    """
    effects = tuple(PlacedEffect(effect, 1) for effect in order)
    joined = with_effects(sticking, effects)
    last = order[-1]
    one = np.ones(1)
    fold_errors = np.ones(8)
    finding = Finding(last, 1, one, one, 0.0, 1.0, 0.1, 5.0, 4.0, 0.2, 9.0, True, fold_errors)
    model = joining.linearised(joined, {})
    return joining._pruned(model, finding, first_rng(), GATES)


def test_a_term_without_a_name_makes_no_named_effect_leave(sticking: Evidence) -> None:
    friction = STICKING[0]
    placed_friction = PlacedEffect(friction, 1)
    term = Smooth(Abscissa.VELOCITY, 0.03, 6.5, 1)

    term_last = _term_after(sticking, (friction, term))
    assert isinstance(term_last, SetAside)
    assert term_last.rival == placed_friction
    reason = term_last.reason(("J1", "J2", "J3"))
    assert reason == "stribeck on J2 would no longer pass beside it"

    term_first = _term_after(sticking, (term, friction))
    assert isinstance(term_first, joining.JointFit)
    assert term_first.evidence.effects == (placed_friction,)


def test_the_number_of_effects_is_bounded_by_the_moves(
    sticking: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "PIECES_PER_EFFECT", 1000)
    (step,) = search_sticking(sticking)
    assert step.accepted is None
    assert step.findings[0].passed
    assert "moves allow no more than 0 effects" in step.ended


def passed_keys(step: Step) -> set[EffectKey]:
    """Keys of the findings that passed in a turn."""
    passed = [one for one in step.findings if one.passed]
    return {effect_key(one.effect, one.axis) for one in passed}


def test_rivals_are_those_that_stop_passing_beside_it(small: Evidence, small_truth: Truth) -> None:
    """A hose that becomes taut little by little, which hinges and harmonics follow equally well."""

    def torque(data: Dataset) -> FloatArray:
        q = data.position_rad[:, 1]
        stretch = 4.0 * (q + 0.3)
        torque_nm = 2.0 * np.log1p(np.exp(stretch))
        return acting_on(1, 3, torque_nm)

    families = families_named("hinge", "gravity-compensator", "stribeck")
    start = bent(small, small_truth, torque)
    steps = find_effects(start, first_rng(), GATES, families)

    first, second = steps[:2]
    assert first.accepted is not None
    assert first.accepted.ambiguity
    no_longer_passed = passed_keys(first) - passed_keys(second)
    for rival in first.accepted.ambiguity:
        assert effect_key(rival.effect, rival.axis) in no_longer_passed

    last = steps[-1]
    plain = with_effects(start, last.after.effects)
    added = last.choice_std
    assert added is not None
    assert np.all(added > 0.0)
    expected_std = np.hypot(plain.estimate.gains_std, added)
    gains_std = last.after.estimate.gains_std
    assert gains_std == pytest.approx(expected_std, rel=1e-3)


@pytest.fixture(scope="module")
def disturbed(small_truth: Truth) -> Evidence:
    """Identified from runs with a disturbance in the position loop,
    and nothing else undeclared in them.
    """
    rng = first_rng()
    conditioning = replace(CONDITIONING, standstill_rad_s=(0.03, 0.03, 0.03))
    runs = []
    for index in range(4):
        mounted = MOUNTED if index % 2 else None
        run = record_in_loop(small_truth, f"run{index}", rng, mounted, disturbance_nm=2.0)
        runs.append(run)
    identified = identify(small_truth.model, runs, conditioning)
    return gather(identified, runs)


@pytest.mark.parametrize("has_gate", [True, False])
def test_a_disturbance_in_the_loop_is_no_effect(
    disturbed: Evidence, has_gate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without instruments the search takes it for a skew of the time stamps."""
    geometry = GEOMETRY
    if not has_gate:
        geometry = ()
        monkeypatch.setattr(joining, "by_instruments", lambda _: None)
    families = families_named("time-skew")

    first, *_ = find_effects(disturbed, first_rng(), GATES, families, geometry=geometry)

    assert (first.accepted is None) == has_gate
    by_instruments = [
        one for one in first.set_aside if "instruments from the demanded" in one.words
    ]
    refused = [one.finding.effect.name for one in by_instruments]
    assert ("time-skew" in refused) == has_gate


def test_an_effect_joins_beside_a_disturbance_in_the_loop(
    disturbed: Evidence, small_truth: Truth
) -> None:
    bent_by_friction = _sticking(disturbed, small_truth, 12.0)
    first, *_ = find_effects(bent_by_friction, first_rng(), GATES, (STICKING,), geometry=())
    assert first.accepted is not None
    friction = PlacedEffect(STICKING[0], 1)
    assert first.after.effects == (friction,)


def test_two_runs_are_judged_on_regions_of_the_workspace(small: Evidence) -> None:
    problem = two_runs(small)
    parts = PartsLeftOut.of(problem)
    assert parts.name == "regions of the workspace"
    assert len(parts.others) == REGIONS

    observation = problem.observation
    position_rad = [run.position_rad for run in problem.rows]
    position = np.concatenate(position_rad, axis=1)
    region = regions_to_leave_out(observation, position)

    # A move is in one region, and regions are postures: moves of one are nearer to each other than
    # to all others.
    region_of_move = []
    mean_of_move = []
    for move in np.unique(observation.move):
        of_move = observation.move == move
        (only_region,) = np.unique(region[of_move])
        region_of_move.append(only_region)
        positions = position[:, of_move]
        mean_of_move.append(positions.mean(axis=1))
    move_counts = np.bincount(region_of_move)
    assert np.ptp(move_counts) <= 3

    means = np.stack(mean_of_move)
    centred = means - means.mean(axis=0)
    units = centred / means.std(axis=0)
    variances = []
    for one in range(REGIONS):
        inside = units[np.equal(region_of_move, one)]
        variance = inside.var(axis=0)
        variances.append(variance.sum())
    total_variance = units.var(axis=0).sum()
    assert np.mean(variances) < 0.8 * total_variance


def test_few_moves_are_not_parted_into_regions(small: Evidence) -> None:
    rows = small.training
    unique_moves = np.unique(rows.move)
    move_count = 2 * REGIONS - 1
    few_moves = unique_moves[:move_count]
    few = rows.only(np.isin(rows.move, few_moves))
    row_count = len(few.move)
    position = np.zeros((3, row_count))
    region = regions_to_leave_out(few, position)
    assert len(region) == 0


def test_a_region_with_the_only_payload_stays(small: Evidence) -> None:
    """Where one region holds all the loaded rows, a fit without it knows no gain."""
    rows = small.training
    loaded = rows.mounting >= 0
    side = np.where(loaded, 1.0, -1.0)
    position = np.stack((side, np.zeros_like(side)))
    region = regions_to_leave_out(rows, position)
    other_regions = 1 + region % (REGIONS - 1)
    only_one = np.where(loaded, 0, other_regions)
    assert 0 not in gates._can_be_left_out(rows, only_one)


def test_what_holds_in_one_region_alone_is_refused(small: Evidence) -> None:
    """Dry friction of joint 2 that differs by region at random:
    seven powers of the region's number follow it.
    """
    problem = two_runs(small)
    parts = PartsLeftOut.of(problem)
    linear = problem.folds.linearisation
    part = parts.part_of[linear.cluster]
    last_part = REGIONS - 1.0
    region = 2.0 * part / last_part - 1.0
    rubbing = whitened_columns(problem, Stribeck(100.0), 1)
    polynomials = np.polynomial.legendre.legvander(region, REGIONS - 1)
    powers = np.asarray(rubbing * polynomials[:, 1:])
    rng = np.random.default_rng(6)
    level = rng.normal(0.0, 4.0, REGIONS)
    torque = rubbing[:, 0] * level[part]
    bent_rows = replace(linear, residual=linear.residual + torque)
    move_of = linear.of_clusters(problem.observation.move)
    folds = cut_into_folds(bent_rows, move_of=move_of)
    differing = PartsLeftOut.of(replace(problem, folds=folds))

    candidates = (slice(0, REGIONS - 1),)
    (trial,) = score_candidates(folds, powers, candidates)

    assert trial is not None
    error = folds.square_sum(folds.residual)
    assert trial.left_out.sum() < 0.9 * error.sum()
    assert differing.refusal(powers, trial.coefficients)


def test_the_unit_of_a_coefficient_does_not_choose_the_motor_that_must_improve(
    small: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Friction of two joints in one effect, most of it of the second one."""
    problem = search_problem_of(small)
    parts = PartsLeftOut.of(problem)
    first = whitened_columns(problem, Stribeck(100.0), 0)
    second = whitened_columns(problem, Stribeck(100.0), 1)
    columns = np.column_stack((first, second))
    coefficients = np.array([0.1, 10.0])
    asked: list[int | None] = []

    def is_no_fall(change: ErrorChange, motor: int | None = None) -> bool:
        asked.append(motor)
        return False

    monkeypatch.setattr(ErrorChange, "harm", lambda change, data: "")
    monkeypatch.setattr(ErrorChange, "is_enough", True)
    monkeypatch.setattr(ErrorChange, "is_fall", is_no_fall)
    for unit in (1.0, 1e3):
        units = np.array([unit, 1.0])
        parts.refusal(columns * units, coefficients / units)
    assert asked == [1, 1]


def test_an_effect_that_the_reported_sigma_does_not_show_leaves(sticking: Evidence) -> None:
    """What joined later may have taken its certainty: the σ that is reported decides."""
    steps = search_sticking(sticking)
    shown = steps[-1].after
    effects = [placed.effect for placed in shown.effects]
    assert effects == [STICKING[0]]
    estimate = shown.estimate
    own = len(estimate.gains) + own_unknowns(estimate, shown.effects)
    covariance = estimate.covariance.copy()
    covariance[own, own] += 1e4
    unsure = replace(shown, estimate=replace(estimate, covariance=covariance))
    model = joining.linearised(unsure, {})

    last = loop.end_search(steps, model, GATES, rng=first_rng())

    assert last.after.effects == ()
    left = last.set_aside[-1]
    assert left.finding.effect == STICKING[0]
    assert left.words.startswith("by the σ that is reported, its coefficients may all be zero")
    gains = last.after.estimate.gains
    assert gains == pytest.approx(sticking.estimate.gains, rel=1e-6)


def test_the_choice_of_effects_adds_to_gains_and_not_to_what_only_one_model_has(
    sticking: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    (*_, shown) = search_sticking(sticking)

    def wide(_: object, estimate: Estimate, *__: object) -> FloatArray:
        identity = np.eye(len(estimate.covariance))
        return 1e4 * identity

    monkeypatch.setattr(loop, "choice_covariance", wide)
    (*_, last) = search_sticking(sticking)

    estimate = last.after.estimate
    own = own_unknowns(estimate, last.after.effects)
    shown_std = shown.after.estimate.parameters_std[own]
    assert estimate.parameters_std[own] == pytest.approx(shown_std)
    assert np.all(estimate.gains_std > 99.0)


def test_an_impossible_part_leaves_with_its_effect(sticking: Evidence) -> None:
    """Friction that grows while the joint moves fast, from a fit that no gate has judged."""
    friction = PlacedEffect(STICKING[0], 1)
    fast_friction = PlacedEffect(Hinge(0.0, 1), 1)
    joined = with_effects(sticking, (friction, fast_friction))
    own = own_unknowns(joined.estimate, joined.effects[1:])
    wrong = with_independent_coefficients(joined, own, [-3.0], 0.01)

    ((placed, why, _),) = loop._unshown(wrong)

    assert placed == joined.effects[1]
    assert "physics allows no less than 0" in why
    declared = replace(wrong, declared=2)
    assert not loop._unshown(declared)


def test_values_that_are_not_possible_are_held_and_the_others_follow() -> None:
    """The least squares of the same problem with the first value fixed at zero."""
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((40, 3))
    columns[:, 1] += 0.8 * columns[:, 0]
    noise = 0.1 * rng.standard_normal(40)
    coefficients = np.array([-0.3, 4.0, 1.0])
    measured = columns @ coefficients + noise
    normal_matrix = columns.T @ columns
    inverse = np.linalg.inv(normal_matrix)
    covariance: FloatArray = inverse.astype(np.float64)
    free = covariance @ columns.T @ measured
    preload = Column("preload", "Nm", least=0.0)

    fixed = possible_values((preload,), free, covariance)

    solution = np.linalg.lstsq(columns[:, 1:], measured, rcond=None)
    others = solution[0]
    assert fixed[0] == 0.0
    assert fixed[1:] == pytest.approx(others)
    possible = np.array([0.5, 1.0, 2.0])
    unchanged = possible_values((preload,), possible, covariance)
    assert np.array_equal(unchanged, possible)


def _warming(small: Evidence, dry_sigmas: float, viscous_sigmas: float) -> Evidence:
    """A joint fit whose warm-up has coefficients of so many σ, independent of everything else."""
    warm_up = PlacedEffect(WarmUp(10.0, 0), 1)
    joined = with_effects(small, (warm_up,))
    own = own_unknowns(joined.estimate, joined.effects)
    return with_independent_coefficients(joined, own, [dry_sigmas, viscous_sigmas], 1.0)


def reason_to_leave(evidence: Evidence) -> str:
    """Why the only effect that the covariance does not show leaves."""
    ((_, why, _),) = loop._unshown(evidence)
    return why


def test_a_part_that_is_a_little_impossible_is_held_at_the_bound_and_carries_no_test(
    small: Evidence,
) -> None:
    warming = _warming(small, -1.9, 8.0)
    assert not loop._unshown(warming)
    bounded = loop.with_possible_values(warming)
    estimate = bounded.estimate
    own = own_unknowns(estimate, bounded.effects)
    assert estimate.parameters[own] == pytest.approx([0.0, 8.0])
    assert estimate.gains == pytest.approx(warming.estimate.gains)
    assert np.array_equal(estimate.covariance, warming.estimate.covariance)

    # By Wald's test of both, p = 0.03; of what is possible of it, p = 0.14.
    in_noise_where_possible = _warming(small, -1.8, 2.0)
    assert "may all be zero" in reason_to_leave(in_noise_where_possible)
    impossible_part = _warming(small, -2.1, 8.0)
    assert "physics allows no less than 0" in reason_to_leave(impossible_part)
    declared = replace(warming, declared=1)
    assert loop.with_possible_values(declared).estimate is warming.estimate


def test_a_hose_only_pulls_and_a_current_is_early_by_milliseconds() -> None:
    upward = Hinge(0.5, 1).coefficients[0]
    downward = Hinge(0.5, -1).coefficients[0]
    assert upward.least == 0.0
    assert upward.largest == np.inf
    assert downward.least == -np.inf
    assert downward.largest == 0.0

    coefficients = Lag().coefficients
    early_by_21_ms = np.array([-0.021])
    early_by_4_ms = np.array([-0.004])
    assert impossible(coefficients, early_by_21_ms, np.array([0.003]))
    assert not impossible(coefficients, early_by_4_ms, np.array([0.001]))


def test_an_amplitude_that_is_known_at_some_angles_only_says_to_turn_further() -> None:
    # The cosine is six σ from zero; at the angles of the sine nothing is known.
    values = np.array([6.0, 0.5])
    covariance = np.diag([1.0, 9.0])
    message = uncertain_amplitude(values, covariance)
    assert message.startswith("its amplitude is 6.02, and its σ up to 3 at some angles")
    rotation = np.array([[0.6, -0.8], [0.8, 0.6]])
    rotated_covariance = rotation @ covariance @ rotation.T
    assert uncertain_amplitude(rotation @ values, rotated_covariance) == message


def test_an_amplitude_of_three_sigma_at_every_angle_is_known() -> None:
    covariance = np.eye(2)
    known = np.array([3.0, 0.0])
    unknown = np.array([2.9, 0.0])
    assert uncertain_amplitude(known, covariance) == ""
    assert uncertain_amplitude(unknown, covariance) != ""
