"""Gates beside the score: physics, runs left out, gains, and every effect beside all the others."""

from __future__ import annotations

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
from ident.discovery.loop import find_effects
from ident.discovery.search import (
    Finding,
    rank_effects,
    rank_families,
)
from ident.effects.dictionary import EFFECTS, GEOMETRY
from ident.effects.effect import Effect, PlacedEffect, effect_key
from ident.effects.electrical import Lag
from ident.effects.friction import NonlinearViscous, Stribeck, TemperatureFriction, WarmUp
from ident.effects.position import Hinge, Spring
from ident.effects.signals import Abscissa, Signals
from ident.effects.unnamed import Smooth
from ident.equations.linearisation import cut_into_folds
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


@pytest.fixture(scope="module")
def search_problem(small: Evidence) -> SearchProblem:
    return search_problem_of(small)


@given(value=numbers, std=st.floats(0.0, 1e3), least=numbers, width=st.floats(0.0, 1e3))
def test_a_coefficient_is_impossible_two_sigma_outside_its_range(
    value: float, std: float, least: float, width: float
) -> None:
    column = Column("amplitude", "Nm", least, least + width)
    outside = max(least - value, value - (least + width))
    deviations = np.array([std])
    named = impossible((column,), np.array([value]), deviations)
    assert bool(named) == (outside > 2.0 * std) or abs(outside - 2.0 * std) < 1e-9
    assert not named or "amplitude" in named
    columns = (Column("stiffness", "Nm/rad"),)
    assert not impossible(columns, np.array([value]), np.array([std]))


def test_every_family_declares_its_signs() -> None:
    """Friction dissipates, a gear gives and a motor weakens;
    springs, ripples and delays have either sign.
    """
    for family in EFFECTS:
        # What two joints of a cable share has the sign of the product of its radii.
        coefficients = family[0].coefficients
        signed = [column for column in coefficients if column.name != "shared stiffness"]
        bound = {column.least == 0.0 for column in signed}
        expected = {family[0].name not in EITHER_SIGN}
        assert bound == expected, family[0].name
        falling = {column.name for column in family[0].coefficients if column.largest == 0.0}
        assert falling == ({"viscous"} if family[0].name == "temperature-friction" else set())
        columns = PlacedEffect(family[0], 0).columns
        assert [column.least for column in columns] == [
            column.least for column in family[0].coefficients
        ]


def test_a_time_constant_is_no_longer_than_the_data(search_problem: SearchProblem) -> None:
    runs = search_problem.runs
    span_s = max(float(run.time_s[-1]) for run in runs)
    later = [replace(run, session_s=run.time_s + 100.0 * index) for index, run in enumerate(runs)]
    time_constant_s = 0.99 * span_s
    assert WarmUp(time_constant_s, 0).fits_in(runs, 0)
    warm_up = WarmUp(1.01 * span_s, 0)
    assert not warm_up.fits_in(later, 0)
    assert WarmUp(300.0, 1).fits_in(later, 0)
    fits = WarmUp(400.0, 1).fits_in(later, 0)
    assert not fits
    rng = np.random.default_rng(0)
    families = ((WarmUp(900.0, 0),), (Spring(),))
    tried = rank_effects(search_problem, rng, GATES, families)
    assert {finding.effect.name for finding in tried} == {"spring"}


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
    families = ((Spring(),),)
    trials = [search_problem.test(families, 1)[0], family]
    rng = np.random.default_rng(0)
    ranked = rank_families(search_problem, trials, rng, GATES)
    judged = {found.effect.name: found.probability for found in ranked}
    only = rank_families(search_problem, trials[:1], np.random.default_rng(0), GATES)
    expected = {"spring": only[0].probability, "hinge": None}
    assert judged == expected
    (hinge,) = (found for found in ranked if found.effect.name == "hinge")
    assert hinge.refusals[0] == (
        "it rests on three moves, too few to test it: record more moves to that end of the "
        "axis' range"
    )


def test_friction_against_temperature_is_tried_where_every_run_has_one_that_changes(
    search_problem: SearchProblem,
) -> None:
    effect = TemperatureFriction()
    runs = search_problem.runs
    assert not effect.fits_in(runs, 1)  # no temperatures at all

    def with_temperature(last_c: float) -> list[Signals]:
        time_s = runs[0].time_s
        one = np.linspace(30.0, last_c, len(time_s))
        return [
            replace(run, temperature_c=np.stack((one, one, np.full_like(one, np.nan))))
            for run in runs
        ]

    warming = with_temperature(35.0)
    assert effect.fits_in(warming, 1)
    assert not effect.fits_in(warming, 2)  # its drive reports none
    last_run = runs[-1]
    fits = effect.fits_in([*warming[:-1], last_run], 1)
    assert not fits  # one run was recorded without
    assert not effect.fits_in(with_temperature(30.5), 1)
    # Where it is not known, the friction is that at 40 °C.
    assert not effect.columns(runs[0], 1).any()
    assert not effect.columns(warming[0], 2).any()


def _sticking(small: Evidence, truth: Truth, amplitude_nm: float) -> Evidence:
    """More friction of joint 2 at low speed, or less."""

    def torque(data: Dataset) -> FloatArray:
        v = data.velocity_rad_s[:, 1]
        torque_nm = amplitude_nm * np.sign(v) * np.exp(-np.abs(v) / 0.3)
        return acting_on(1, 3, torque_nm)

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
    for start, possible in ((sticking, True), (slipping, False)):
        rng = np.random.default_rng(0)
        best = rank_effects(search_problem_of(start), rng, GATES, (STICKING,))[0]
        assert (best.axis, best.passed) == (1, possible)
        assert [("physics allows" in words) for words in best.refusals] == (
            [] if possible else [True]
        )


def test_of_a_family_the_possible_setting_is_taken(slipping: Evidence) -> None:
    """Less friction at low speed resembles drag that grows with the root of the speed,
    which is possible.
    """
    family = (*STICKING, NonlinearViscous(0.5))
    rng = np.random.default_rng(0)
    best = rank_effects(search_problem_of(slipping), rng, GATES, (family,))[0]
    expected = (family[1], 1, True)
    assert (best.effect, best.axis, best.passed) == expected


def test_runs_are_left_out_where_their_payload_is_in_another(small: Evidence) -> None:
    rows = small.training
    expected = (0, 1, 2, 3)
    assert runs_to_leave_out(rows) == expected
    observation = rows.only(rows.run != 3)
    assert runs_to_leave_out(observation) == (0, 2)  # run 1 is now the only loaded one
    assert runs_to_leave_out(rows.only(rows.run < MIN_RUNS - 1)) == ()


def test_an_error_on_runs_left_out_is_that_of_a_fit_of_the_others(
    search_problem: SearchProblem,
) -> None:
    problem = search_problem.folds.linearisation
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(len(problem.motor), 2)) + 0.3 * problem.residual[:, None]
    run = search_problem.observation.run[problem.source]
    declared = whole(problem.jacobian)
    both = np.concatenate((declared, columns), axis=1)
    rise = 0.0
    for left_out in range(4):
        own = run == left_out
        for matrix, sign in ((both, 1.0), (declared, -1.0)):
            fitted = np.linalg.lstsq(matrix[~own], problem.residual[~own], rcond=None)[0]
            rise += sign * float(np.sum((problem.residual[own] - matrix[own] @ fitted) ** 2))
    total = PartsLeftOut.of(search_problem).change(columns).total
    assert total.rise == pytest.approx(rise, rel=1e-4)


def test_what_one_run_alone_shows_stays_where_it_is_without_that_run(
    search_problem: SearchProblem,
) -> None:
    """A hose that one run alone stretches has no row in the others:
    a fit of these does not move it, nor fails.
    """
    folds = search_problem.folds
    observation = search_problem.observation
    last_run = observation.run.max()
    elsewhere = folds.linearisation.of_clusters(observation.run) != last_run
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
    expected = np.linalg.lstsq(
        hessian[elsewhere].sum(axis=0)[:-1, :-1], score[elsewhere].sum(axis=0)[:-1], rcond=None
    )
    largest_absolute_expected = np.abs(expected[0]).max()
    np.testing.assert_allclose(
        step[:-1], expected[0], rtol=1e-4, atol=1e-6 * largest_absolute_expected
    )


def _levels(small: Evidence, truth: Truth, levels: tuple[float, ...]) -> SearchProblem:
    """A spring at joint 2 that has another stiffness in each run."""
    names = [data.name for data in small.datasets]
    start = bent(
        small,
        truth,
        lambda data: acting_on(1, 3, levels[names.index(data.name)] * data.position_rad[:, 1]),
    )
    return search_problem_of(start)


def _powers_of_the_run(problem: SearchProblem, powers: int) -> FloatArray:
    """The spring at joint 2 as a polynomial of the run's number, whitened, shape (rows, powers)."""
    run = problem.observation.run.astype(np.float64)
    torque = problem.torque(Spring(), 1)[:, :1] * run ** np.arange(1, powers + 1)[:, None]
    to_motor = problem.model.drive_train.to_motor
    return problem.folds.linearisation.whitened(torque, to_motor)


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
    (trial,) = score_candidates(problem.folds, columns, candidates)
    assert trial is not None
    assert trial.left_out.sum() < 0.9 * problem.folds.square_sum(problem.folds.residual).sum()
    assert bool(PartsLeftOut.of(problem).refusal(columns)) == (powers == 3)


def test_without_an_effect_the_joint_fit_is_the_declared_one_to_first_order(
    sticking: Evidence,
) -> None:
    placed = PlacedEffect(STICKING[0], 1)
    joined = with_effects(sticking, (placed,))
    assert placed.columns[0] in joined.estimate.unknowns  # with its possible values
    reduced = without_effects_of(search_problem_of(joined), joined.estimate, (placed,))
    noise = (joined.estimate.axis_noise, sticking.estimate.axis_noise)
    ends = (
        reduced.search_problem.folds.linearisation,
        search_problem_of(sticking).folds.linearisation,
    )
    squares = [
        np.sum((end.residual * own[end.motor]) ** 2) for end, own in zip(ends, noise, strict=True)
    ]
    assert squares[0] == pytest.approx(squares[1], rel=0.01)
    shifts = joined.estimate.gains - sticking.estimate.gains
    largest_gains_std = float(np.max(sticking.estimate.gains_std))
    assert reduced.gain_shifts == pytest.approx(shifts, abs=0.5 * largest_gains_std)


def test_gains_that_move_by_more_than_sigma_are_named(
    search_problem: SearchProblem, small: Evidence
) -> None:
    """A torque that is a part of motor 1's own torque is a change of its gain;
    fixed gains cannot move.
    """
    problem = search_problem.folds.linearisation
    std = small.estimate.gains_std
    first_gain = small.estimate.gains[0]
    share = 3.0 * std[0] / first_gain
    torque = -share * whole(problem.jacobian)[:, 0]
    shifts = gain_shifts(search_problem.folds, torque)
    assert shifts[0] == pytest.approx(3.0 * std[0], rel=1e-6)
    motors = [motor for motor, _ in moved_gains(shifts, std)]
    assert motors == [0]
    gains_std = np.zeros(3)
    assert moved_gains(shifts, gains_std) == ()


def test_coefficients_in_their_noise_are_no_effect() -> None:
    covariance = np.diag([1.0, 4.0])
    assert in_noise(np.array([1.0, 2.0]), covariance)
    assert not in_noise(np.array([3.0, 0.0]), covariance)


def _term_after(sticking: Evidence, order: tuple[Effect, ...]) -> joining.JointFit | SetAside:
    """Joint fit of a named effect and a term that can replace it,
    judged as if the last one had just joined.
    """
    effects = tuple(PlacedEffect(effect, 1) for effect in order)
    joined = with_effects(sticking, effects)
    coefficients = np.ones(1)
    deviations = np.ones(1)
    fold_errors = np.ones(8)
    finding = Finding(
        order[-1], 1, coefficients, deviations, 0.0, 1.0, 0.1, 5.0, 4.0, 0.2, 9.0, True, fold_errors
    )
    model = joining.linearised(joined, {})
    rng = np.random.default_rng(0)
    return joining._pruned(model, finding, rng, GATES)


def test_a_term_without_a_name_makes_no_named_effect_leave(sticking: Evidence) -> None:
    term = Smooth(Abscissa.VELOCITY, 0.03, 6.5, 1)
    order = (STICKING[0], term)
    refused = _term_after(sticking, order)
    assert isinstance(refused, SetAside)
    expected = PlacedEffect(STICKING[0], 1)
    assert refused.rival == expected
    assert refused.reason(("J1", "J2", "J3")) == "stribeck on J2 would no longer pass beside it"
    kept = _term_after(sticking, (term, STICKING[0]))
    assert isinstance(kept, joining.JointFit)
    placed_effect = PlacedEffect(STICKING[0], 1)
    assert kept.evidence.effects == (placed_effect,)


def test_the_number_of_effects_is_bounded_by_the_moves(
    sticking: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "PIECES_PER_EFFECT", 1000)
    rng = np.random.default_rng(0)
    (step,) = find_effects(sticking, rng, GATES, (STICKING,))
    assert step.accepted is None
    assert step.findings[0].passed
    assert "moves allow no more than 0 effects" in step.ended


def test_rivals_are_those_that_stop_passing_beside_it(small: Evidence, small_truth: Truth) -> None:
    """A hose that becomes taut little by little, which hinges and harmonics follow equally well."""

    def torque(data: Dataset) -> FloatArray:
        q = data.position_rad[:, 1]
        torque_nm = 2.0 * np.log1p(np.exp(4.0 * (q + 0.3)))
        return acting_on(1, 3, torque_nm)

    families = tuple(
        family
        for family in EFFECTS
        if family[0].name in {"hinge", "gravity-compensator", "stribeck"}
    )
    start = bent(small, small_truth, torque)
    rng = np.random.default_rng(0)
    steps = find_effects(start, rng, GATES, families)
    first, second = steps[:2]
    assert first.accepted is not None
    assert first.accepted.ambiguity
    passed = []
    for step in (first, second):
        passed.append({effect_key(one.effect, one.axis) for one in step.findings if one.passed})
    for rival in first.accepted.ambiguity:
        passed_difference = passed[0] - passed[1]
        assert effect_key(rival.effect, rival.axis) in passed_difference
    effects = steps[-1].after.effects
    plain = with_effects(start, effects).estimate
    whole = steps[-1].after.estimate
    added = steps[-1].choice_std
    assert added is not None
    assert np.all(added > 0.0)
    assert whole.gains_std == pytest.approx(np.hypot(plain.gains_std, added), rel=1e-3)


@pytest.fixture(scope="module")
def disturbed(small_truth: Truth) -> Evidence:
    """Identified from runs with a disturbance in the position loop,
    and nothing else undeclared in them.
    """
    rng = np.random.default_rng(0)
    standstill_rad_s = (0.03,) * 3
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    runs = [
        record_in_loop(
            small_truth, f"run{index}", rng, MOUNTED if index % 2 else None, disturbance_nm=2.0
        )
        for index in range(4)
    ]
    return gather(identify(small_truth.model, runs, conditioning), runs)


@pytest.mark.parametrize("has_gate", [True, False])
def test_a_disturbance_in_the_loop_is_no_effect(
    disturbed: Evidence, has_gate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without instruments the search takes it for a skew of the time stamps."""
    if not has_gate:
        monkeypatch.setattr(joining, "by_instruments", lambda _: None)
    families = tuple(family for family in EFFECTS if family[0].name == "time-skew")
    geometry = GEOMETRY if has_gate else ()
    rng = np.random.default_rng(0)
    first, *_ = find_effects(disturbed, rng, GATES, families, geometry=geometry)
    assert (first.accepted is None) == has_gate
    refused = [
        one.finding.effect.name
        for one in first.set_aside
        if "instruments from the demanded" in one.words
    ]
    assert ("time-skew" in refused) == has_gate


def test_an_effect_joins_beside_a_disturbance_in_the_loop(
    disturbed: Evidence, small_truth: Truth
) -> None:
    bent_by_friction = _sticking(disturbed, small_truth, 12.0)
    rng = np.random.default_rng(0)
    first, *_ = find_effects(bent_by_friction, rng, GATES, (STICKING,), geometry=())
    assert first.accepted is not None
    expected = (PlacedEffect(STICKING[0], 1),)
    assert first.after.effects == expected


def test_two_runs_are_judged_on_regions_of_the_workspace(small: Evidence) -> None:
    rows = small.training.run < MIN_RUNS - 1
    training = small.training.only(rows)
    short = replace(small, training=training, datasets=small.datasets[: MIN_RUNS - 1])
    problem = search_problem_of(short)
    parts = PartsLeftOut.of(problem)
    assert parts.name == "regions of the workspace"
    assert len(parts.others) == REGIONS
    position_rad = [run.position_rad for run in problem.rows]
    position = np.concatenate(position_rad, axis=1)
    region = regions_to_leave_out(problem.observation, position)
    observation = problem.observation
    # A move is in one region, and regions are postures: moves of one are nearer to each other than
    # to all others.
    moves = np.unique(observation.move)
    unique_regions = [np.unique(region[observation.move == move]) for move in moves]
    of_move = np.array(unique_regions)
    expected = (len(moves), 1)
    assert of_move.shape == expected
    assert np.ptp(np.bincount(of_move[:, 0])) <= 3
    mean_positions = [position[:, observation.move == move].mean(axis=1) for move in moves]
    means = np.stack(mean_positions)
    mean_difference = means - means.mean(axis=0)
    units = mean_difference / means.std(axis=0)
    inside = [units[of_move[:, 0] == one].var(axis=0).sum() for one in range(REGIONS)]
    units_variance = units.var(axis=0)
    assert np.mean(inside) < 0.8 * units_variance.sum()


def test_few_moves_are_not_parted_into_regions(small: Evidence) -> None:
    rows = small.training
    unique_moves = np.unique(rows.move)
    few = rows.only(np.isin(rows.move, unique_moves[: 2 * REGIONS - 1]))
    position = np.zeros((3, len(few.move)))
    assert len(regions_to_leave_out(few, position)) == 0


def test_a_region_with_the_only_payload_stays(small: Evidence) -> None:
    """Where one region holds all the loaded rows, a fit without it knows no gain."""
    rows = small.training
    position = np.stack((np.where(rows.mounting >= 0, 1.0, -1.0), np.zeros(len(rows.move))))
    region = regions_to_leave_out(rows, position)
    only_one = np.where(rows.mounting >= 0, 0, 1 + region % (REGIONS - 1))
    assert 0 not in gates._can_be_left_out(rows, only_one)


def test_what_holds_in_one_region_alone_is_refused(small: Evidence) -> None:
    """Dry friction of joint 2 that differs by region at random:
    seven powers of the region's number follow it.
    """
    rows = small.training.run < MIN_RUNS - 1
    training = small.training.only(rows)
    short = replace(small, training=training, datasets=small.datasets[: MIN_RUNS - 1])
    problem = search_problem_of(short)
    parts = PartsLeftOut.of(problem)
    linear = problem.folds.linearisation
    region = 2.0 * parts.part_of[linear.cluster] / (REGIONS - 1.0) - 1.0
    rubbing = whitened_columns(problem, Stribeck(100.0), 1)
    powers = np.asarray(rubbing * np.polynomial.legendre.legvander(region, REGIONS - 1)[:, 1:])
    rng = np.random.default_rng(6)
    level = rng.normal(0.0, 4.0, REGIONS)[parts.part_of[linear.cluster]]
    torque = rubbing[:, 0] * level
    residual = linear.residual + torque
    bent_rows = replace(linear, residual=residual)
    move_of = linear.of_clusters(problem.observation.move)
    folds = cut_into_folds(bent_rows, move_of=move_of)
    differing = PartsLeftOut.of(replace(problem, folds=folds))
    candidates = (slice(0, REGIONS - 1),)
    (trial,) = score_candidates(folds, powers, candidates)
    assert trial is not None
    assert trial.left_out.sum() < 0.9 * folds.square_sum(folds.residual).sum()
    assert differing.refusal(powers)


def test_an_effect_that_the_reported_sigma_does_not_show_leaves(sticking: Evidence) -> None:
    """What joined later may have taken its certainty: the σ that is reported decides."""
    rng = np.random.default_rng(0)
    steps = find_effects(sticking, rng, GATES, (STICKING,))
    shown = steps[-1].after
    effects = [placed.effect for placed in shown.effects]
    assert effects == [STICKING[0]]
    own = len(shown.estimate.gains) + own_unknowns(shown.estimate, shown.effects)
    covariance = shown.estimate.covariance.copy()
    covariance[own, own] += 1e4
    estimate = replace(shown.estimate, covariance=covariance)
    unsure = replace(shown, estimate=estimate)
    model = joining.linearised(unsure, {})
    last = loop.end_search(steps, model, GATES, rng=np.random.default_rng(0))
    assert last.after.effects == ()
    finding = last.set_aside[-1].finding
    assert finding.effect == STICKING[0]
    words = last.set_aside[-1].words
    assert words.startswith("by the σ that is reported, its coefficients may all be zero")
    assert last.after.estimate.gains == pytest.approx(sticking.estimate.gains, rel=1e-6)


def test_the_choice_of_effects_adds_to_gains_and_not_to_what_only_one_model_has(
    sticking: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    (*_, shown) = find_effects(sticking, rng, GATES, (STICKING,))

    def wide(_: object, estimate: Estimate, *__: object) -> FloatArray:
        identity = np.eye(len(estimate.covariance))
        return 1e4 * identity

    monkeypatch.setattr(loop, "choice_covariance", wide)
    (*_, last) = find_effects(sticking, np.random.default_rng(0), GATES, (STICKING,))
    own = own_unknowns(last.after.estimate, last.after.effects)
    assert last.after.estimate.parameters_std[own] == pytest.approx(
        shown.after.estimate.parameters_std[own]
    )
    gains_std = last.after.estimate.gains_std
    assert np.all(gains_std > 99.0)


def test_an_impossible_part_leaves_with_its_effect(sticking: Evidence) -> None:
    """Friction that grows while the joint moves fast, from a fit that no gate has judged."""
    effect = Hinge(0.0, 1)
    placed_effect = PlacedEffect(STICKING[0], 1)
    effects = (placed_effect, PlacedEffect(effect, 1))
    joined = with_effects(sticking, effects)
    estimate = joined.estimate
    own = own_unknowns(estimate, joined.effects[1:])
    parameters = estimate.parameters.copy()
    parameters[own] = -3.0
    covariance = estimate.covariance.copy()
    place = len(estimate.gains) + own
    covariance[place, :] = 0.0
    covariance[:, place] = 0.0
    covariance[place, place] = 0.01
    changed_estimate = replace(estimate, parameters=parameters, covariance=covariance)
    wrong = replace(joined, estimate=changed_estimate)
    ((placed, why, _),) = loop._unshown(wrong)
    assert placed == joined.effects[1]
    assert "physics allows no less than 0" in why
    evidence = replace(wrong, declared=2)
    assert not loop._unshown(evidence)


def test_values_that_are_not_possible_are_held_and_the_others_follow() -> None:
    """The least squares of the same problem with the first value fixed at zero."""
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((40, 3))
    columns[:, 1] += 0.8 * columns[:, 0]
    measured = columns @ np.array([-0.3, 4.0, 1.0]) + 0.1 * rng.standard_normal(40)
    inverse = np.linalg.inv(columns.T @ columns)
    covariance: FloatArray = inverse.astype(np.float64)
    free = covariance @ columns.T @ measured
    column = Column("preload", "Nm", least=0.0)
    held = possible_values((column,), free, covariance)
    others = np.linalg.lstsq(columns[:, 1:], measured, rcond=None)[0]
    assert held[0] == 0.0
    assert held[1:] == pytest.approx(others)
    possible = np.array([0.5, 1.0, 2.0])
    assert np.array_equal(
        possible_values((Column("preload", "Nm", least=0.0),), possible, covariance), possible
    )


def _warming(small: Evidence, dry_sigmas: float, viscous_sigmas: float) -> Evidence:
    """A joint fit whose warm-up has coefficients of so many σ, independent of everything else."""
    effect = WarmUp(10.0, 0)
    effects = (PlacedEffect(effect, 1),)
    joined = with_effects(small, effects)
    estimate = joined.estimate
    own = own_unknowns(estimate, joined.effects)
    place = len(estimate.gains) + own
    parameters = estimate.parameters.copy()
    parameters[own] = dry_sigmas, viscous_sigmas
    covariance = estimate.covariance.copy()
    covariance[place, :] = 0.0
    covariance[:, place] = 0.0
    covariance[place, place] = 1.0
    changed_estimate = replace(estimate, parameters=parameters, covariance=covariance)
    return replace(joined, estimate=changed_estimate)


def test_a_part_that_is_a_little_impossible_is_held_at_the_bound_and_carries_no_test(
    small: Evidence,
) -> None:
    warming = _warming(small, -1.9, 8.0)
    assert not loop._unshown(warming)
    held = loop.with_possible_values(warming)
    own = own_unknowns(held.estimate, held.effects)
    assert held.estimate.parameters[own] == pytest.approx([0.0, 8.0])
    assert held.estimate.gains == pytest.approx(warming.estimate.gains)
    assert np.array_equal(held.estimate.covariance, warming.estimate.covariance)
    # By Wald's test of both, p = 0.03; of what is possible of it, p = 0.14.
    evidence = _warming(small, -1.8, 2.0)
    ((_, why, _),) = loop._unshown(evidence)
    assert "may all be zero" in why
    ((_, why, _),) = loop._unshown(_warming(small, -2.1, 8.0))
    assert "physics allows no less than 0" in why
    changed_warming = replace(warming, declared=1)
    assert loop.with_possible_values(changed_warming).estimate is warming.estimate


def test_a_hose_only_pulls_and_a_current_is_early_by_milliseconds() -> None:
    ranges = {sense: Hinge(0.5, sense).coefficients[0] for sense in (1, -1)}
    assert (ranges[1].least, ranges[1].largest) == (0.0, np.inf)
    expected = (-np.inf, 0.0)
    last_range = ranges[-1]
    assert (last_range.least, ranges[-1].largest) == expected
    deviations = np.array([0.003])
    assert impossible(Lag().coefficients, np.array([-0.021]), deviations)
    assert not impossible(Lag().coefficients, np.array([-0.004]), np.array([0.001]))


def test_an_amplitude_that_is_known_at_some_angles_only_says_to_turn_further() -> None:
    # The cosine is six σ from zero; at the angles of the sine nothing is known.
    values = np.array([6.0, 0.5])
    covariance = np.diag([1.0, 9.0])
    said = uncertain_amplitude(values, covariance)
    assert said.startswith("its amplitude is 6.02, and its σ up to 3 at some angles")
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    rotated = uncertain_amplitude(turned @ values, turned @ covariance @ turned.T)
    assert rotated == said


def test_an_amplitude_of_three_sigma_at_every_angle_is_known() -> None:
    assert uncertain_amplitude(np.array([3.0, 0.0]), np.eye(2)) == ""
    assert uncertain_amplitude(np.array([2.9, 0.0]), np.eye(2)) != ""
