"""Statistical honesty: folds do not leak, a seed fixes the result, and noise alone gets no name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg

from ident.discovery.candidates import (
    CandidateTrial,
    ColumnCache,
    FamilyTrials,
    SearchProblem,
    score_candidates,
)
from ident.discovery.evidence import Evidence
from ident.discovery.gates import Gates
from ident.discovery.search import rank_effects, rank_families
from ident.effects.dictionary import EFFECTS
from ident.effects.electrical import Cogging
from ident.effects.friction import PositionFriction, Stribeck
from ident.equations.linearisation import Folds, Linearisation, cut_into_folds, linearise
from tests.ident.recordings import search_problem_of, with_current

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
GATES = Gates(draws=199)
KNOWN = ("nonlinear-viscous", "load-friction")


@pytest.fixture(scope="module")
def search_problem(small: Evidence) -> SearchProblem:
    return search_problem_of(small)


@pytest.fixture(scope="module")
def problem(small: Evidence) -> Linearisation:
    estimate = small.estimate
    return linearise(
        small.training, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=False
    )


def _fold_of_rows(folds: Folds) -> IntArray:
    row_count = len(folds.linearisation.motor)
    fold = np.empty(row_count, dtype=np.int64)
    for rows, number, _, _ in folds.blocks:
        fold[rows] = number
    return fold


def _shows_its_own(folds: Folds, other: Folds) -> float:
    """Effect on the held-out residual of fold 0 of a change of three in all its rows:
    three, if it has no influence.
    """
    own = _fold_of_rows(folds) == 0
    residual_difference = other.residual - folds.residual
    return float(np.mean(residual_difference[own]))


def _changed(problem: Linearisation, folds: Folds) -> Linearisation:
    in_first_fold = _fold_of_rows(folds) == 0
    clusters = folds.linearisation.cluster[in_first_fold]
    is_changed = np.isin(problem.cluster, np.unique(clusters))
    residual = problem.residual + 3.0 * is_changed
    return replace(problem, residual=residual)


def test_a_held_out_fold_does_not_influence_its_own_prediction(problem: Linearisation) -> None:
    folds = cut_into_folds(problem)
    fold = _fold_of_rows(folds)
    every_cluster: set[int] = set()
    for number in range(folds.count):
        clusters = folds.linearisation.cluster[fold == number]
        part = set(clusters.tolist())
        assert not part & every_cluster
        every_cluster |= part
    assert len(every_cluster) == problem.cluster_count

    changed = cut_into_folds(_changed(problem, folds))

    change = changed.residual - folds.residual
    assert change[fold == 0] == pytest.approx(3.0)
    absolute_change = np.abs(change[fold != 0])
    assert np.max(absolute_change) > 1e-3


def _fitted_on_all_rows(folds: Folds) -> Folds:
    """Folds with the residual of one fit of all rows, which has seen what it predicts."""
    linear = folds.linearisation
    gradient = linear.jacobian.on_columns(linear.residual)
    step = linalg.cho_solve(folds.full_factor, gradient)
    residual = linear.residual - linear.jacobian @ step
    return replace(folds, residual=np.asarray(residual))


def test_a_planted_leak_is_seen(problem: Linearisation, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same figure of merit on a residual of the fit of all rows,
    and on folds that part the moves.
    """
    folds = cut_into_folds(problem)
    changed = cut_into_folds(_changed(problem, folds))
    assert _shows_its_own(folds, changed) == pytest.approx(3.0)

    leaking = _fitted_on_all_rows(folds)
    leaking_changed = _fitted_on_all_rows(changed)
    assert _shows_its_own(leaking, leaking_changed) < 2.9

    # Pieces of one move dealt to different folds: they share its noise. The move's number is what
    # forbids it.
    row = np.arange(len(problem.cluster))
    pieces = 4 * problem.cluster + row % 4
    parted = replace(problem, cluster=pieces)
    piece_count = 4 * problem.cluster_count
    move_of = np.arange(piece_count) // 4
    by_move = cut_into_folds(parted, move_of=move_of)
    by_piece = cut_into_folds(parted)
    assert max(_folds_of_pieces(by_move)) == 1
    assert min(_folds_of_pieces(by_piece)) == 4


def _folds_of_moves(move: IntArray, fold: IntArray) -> list[int]:
    """In how many folds each move is."""
    counts = []
    for number in np.unique(move):
        folds = np.unique(fold[move == number])
        counts.append(len(folds))
    return counts


def _folds_of_pieces(folds: Folds) -> list[int]:
    """In how many folds each move of four pieces is."""
    move = folds.linearisation.cluster // 4
    return _folds_of_moves(move, _fold_of_rows(folds))


def test_pieces_of_a_short_recording_stay_in_the_fold_of_their_move(small: Evidence) -> None:
    rows = small.training.run < 2
    training = small.training.only(rows)
    short = replace(small, training=training, datasets=small.datasets[:2])
    search_problem = search_problem_of(short)
    folds = search_problem.folds
    assert folds.moves < folds.linearisation.cluster_count  # cut into pieces, as there are few
    fold = _fold_of_rows(folds)
    move = short.training.move[folds.linearisation.source]
    assert max(_folds_of_moves(move, fold)) == 1


def _verdicts(problem: SearchProblem) -> list[tuple[object, ...]]:
    """What a search with one seed says of each candidate."""
    rng = np.random.default_rng(4)
    verdicts: list[tuple[object, ...]] = []
    for finding in rank_effects(problem, rng, GATES):
        candidate = (finding.effect, finding.axis)
        verdicts.append((*candidate, finding.probability, finding.left_out_fall))
    return verdicts


def test_the_same_seed_gives_the_same_verdict(small: Evidence) -> None:
    first = _verdicts(search_problem_of(small))
    second = _verdicts(search_problem_of(small))
    assert first == second


def test_a_setting_is_chosen_without_the_fold_that_it_is_scored_on(
    search_problem: SearchProblem,
) -> None:
    """A family is scored on each fold with the setting that the others chose, best on it or not."""
    orders = range(1, 13)
    family = tuple(Cogging(order) for order in orders)
    (tested,) = search_problem.test([family], 0)
    scored = tested.nested()
    trials = [trial for _, trial in tested.members]
    for fold in range(search_problem.folds.count):
        training_falls = [trial.training_fall[fold] for trial in trials]
        chosen = trials[np.argmax(training_falls)]
        assert np.array_equal(scored[fold], chosen.left_out[fold])
    # Among twelve settings that mean nothing, the best of each fold looks like an effect.
    folds = search_problem.folds
    before = folds.square_sum(folds.residual).sum()
    errors = [trial.left_out.sum(axis=1) for trial in trials]
    best_error = np.min(errors, axis=0).sum()
    assert best_error < before
    assert scored.sum() > best_error


def test_the_choice_of_a_setting_does_not_see_its_fold(problem: Linearisation) -> None:
    """Whatever fold 0 measures, the fall on the others, which chooses, is the same."""
    rng = np.random.default_rng(7)
    folds = cut_into_folds(problem)
    own = _fold_of_rows(folds) == 0
    columns = rng.normal(size=(len(own), 3))
    linear = folds.linearisation
    added = 5.0 * own * columns[:, 0]
    changed = cut_into_folds(replace(linear, residual=linear.residual + added))
    each_column = [slice(0, 1), slice(1, 2), slice(2, 3)]
    before = score_candidates(folds, columns, each_column)
    after = score_candidates(changed, columns, each_column)
    for one, other in zip(before, after, strict=True):
        assert one is not None
        assert other is not None
        on_own = pytest.approx(one.training_fall[0], rel=1e-6)
        on_others = pytest.approx(one.training_fall[1:], rel=1e-3)
        assert other.training_fall[0] == on_own
        assert other.training_fall[1:] != on_others


def _noise_of(evidence: Evidence) -> FloatArray:
    """The measured currents less those that the estimate predicts."""
    estimate = evidence.estimate
    observed = evidence.training
    to_motor = evidence.model.drive_train.to_motor
    motor_torque = to_motor @ estimate.predicted_torque(observed)
    predicted = motor_torque / estimate.gains[:, None]
    return observed.current - predicted


def test_shuffled_residuals_get_no_name(small: Evidence) -> None:
    """Twenty times every move's noise gets a random sign, on each motor alone:
    one false name at most.

    Nor do families that are known from another axis, which compete among themselves: one more at
    most.
    """
    rng = np.random.default_rng(12)
    noise = _noise_of(small)
    move = small.training.move
    move_count = int(move.max()) + 1
    # A choice of families, settings and axes that competes as the whole dictionary does, at a part
    # of its price.
    families = tuple(family[::4] for family in EFFECTS)
    alone = tuple(family for family in families if family[0].name in KNOWN)
    cache: ColumnCache = {}
    false = 0
    known = 0
    for _ in range(20):
        sign_of_move = rng.choice((-1.0, 1.0), size=(3, move_count))
        sign = sign_of_move[:, move]
        added_a = (sign - 1.0) * noise
        evidence = with_current(small, added_a)
        problem = search_problem_of(evidence, cache)
        findings = rank_effects(problem, rng, GATES, families)
        false += any(finding.passed for finding in findings)
        related = rank_effects(problem, rng, GATES, alone, known=KNOWN)
        known += any(finding.passed for finding in related)
    assert false <= 1
    assert known <= 2


def test_a_family_known_from_another_axis_competes_with_its_own_name(small: Evidence) -> None:
    """Noise makes one as strong less often among few candidates;
    the others are judged as before.
    """
    problem = search_problem_of(small)
    families = tuple(family[::4] for family in EFFECTS)

    def probabilities(known: Sequence[str]) -> dict[tuple[str, int], float]:
        rng = np.random.default_rng(3)
        found = {}
        for one in rank_effects(problem, rng, GATES, families, known=known):
            if one.probability is not None:  # of one that rests on too few moves
                found[one.effect.name, one.axis] = one.probability
        return found

    plain = probabilities(())
    related = probabilities(KNOWN)
    assert plain.keys() == related.keys()
    for key, probability in plain.items():
        if key[0] in KNOWN:
            assert related[key] <= probability
        else:
            assert related[key] == probability
    assert sum(related.values()) < sum(plain.values())


def _noise_trial(
    rng: np.random.Generator, moves: int, columns: int, rows: int = 8
) -> CandidateTrial:
    """A candidate on noise alone, in moves of different loudness."""
    x = rng.normal(size=(moves, rows, columns))
    loudness = rng.uniform(0.5, 2.0, size=(moves, 1, 1))
    x *= loudness
    of_rows = rng.normal(size=(moves, rows))
    of_moves = rng.normal(size=(moves, 1))
    e = of_rows + 0.7 * of_moves
    gram = np.einsum("mra,mrb->mab", x, x)
    score = np.einsum("mra,mr->ma", x, e)
    total_score = score.sum(axis=0)
    coefficients = np.linalg.solve(gram.sum(axis=0), total_score)
    fall = float(total_score @ coefficients)
    fall_by_motor = np.array([fall])
    scatter = score - gram @ coefficients
    left_out = np.zeros((8, 1))
    training_fall = np.zeros(8)
    return CandidateTrial(
        coefficients=coefficients,
        fall_by_motor=fall_by_motor,
        training_fall=training_fall,
        left_out=left_out,
        score=total_score,
        scatter=scatter,
        gram=gram,
    )


# Of 400 candidates on noise 20 ± 4.4 have p ≤ 0.05 by chance alone; three deviations on either
# side. With twelve moves of different loudness the bootstrap is a little too sure (6 to 9 % in 1500
# draws): a tenth is the most allowed.
@pytest.mark.parametrize("columns", [1, 2])
@pytest.mark.parametrize(("moves", "least", "most"), [(12, 7, 40), (60, 7, 33)])
def test_the_bootstrap_keeps_its_size(
    search_problem: SearchProblem, moves: int, columns: int, least: int, most: int
) -> None:
    rng = np.random.default_rng(100 * moves + columns)
    effects = (Stribeck(0.1), PositionFriction())
    effect = effects[columns - 1]
    left_out = np.zeros((8, 3))
    fall_by_motor = np.ones(3)
    false = 0
    for _ in range(400):
        on_noise = _noise_trial(rng, moves, columns)
        trial = replace(on_noise, left_out=left_out, fall_by_motor=fall_by_motor)
        members = ((effect, trial),)
        tested = [FamilyTrials(0, members)]
        (finding,) = rank_families(search_problem, tested, rng, GATES)
        assert finding.probability is not None
        false += finding.probability <= 0.05
    assert least <= false <= most
