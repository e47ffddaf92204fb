"""Candidates on few moves: tested by the others, or not tested, with what to record;
they hide no other candidate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.candidates import CandidateTrial, FamilyTrials, SearchProblem, score_candidates
from ident.discovery.evidence import Evidence
from ident.discovery.few_moves import FEW_MOVES, FEWEST_MOVES, LEVERAGE, RECORD, moves_behind
from ident.discovery.gates import Gates
from ident.discovery.search import Finding, rank_families
from ident.effects.electrical import Saturation
from ident.effects.signals import Abscissa
from ident.equations.linearisation import Folds, Jacobian, Linearisation, cut_into_folds
from tests.ident.recordings import search_problem_of, whole

FloatArray = NDArray[np.float64]

GATES = Gates(draws=199)
MOVES = 60
ROWS = 8
WIDTH = 3


@pytest.fixture(scope="module")
def search_problem(small: Evidence) -> SearchProblem:
    return search_problem_of(small)


def _folds(rng: np.random.Generator, torque: FloatArray) -> Folds:
    """One motor; the residual is a torque, shape (rows,), and noise that moves share,
    as far as no column takes it.
    """
    jacobian = rng.normal(size=(MOVES * ROWS, WIDTH))
    loud = np.repeat(rng.uniform(0.5, 1.5, MOVES), ROWS)
    raw = (
        torque
        + loud * rng.normal(size=MOVES * ROWS)
        + np.repeat(0.5 * rng.normal(size=MOVES), ROWS)
    )
    residual = raw - jacobian @ np.linalg.lstsq(jacobian, raw, rcond=None)[0]
    current = 5.0 * rng.normal(size=len(raw))
    motor = np.zeros(len(raw), dtype=np.int64)
    cluster = np.repeat(np.arange(MOVES), ROWS)
    source = np.arange(len(raw))
    seen = (np.arange(WIDTH),)
    gamma = np.ones(1)
    free = np.arange(WIDTH)
    problem = Linearisation(
        jacobian=Jacobian((jacobian.T,), seen, WIDTH),
        residual=residual,
        current=current,
        motor=motor,
        cluster=cluster,
        source=source,
        gamma=gamma,
        noise=np.ones(1),
        free=free,
        scale=np.ones(WIDTH),
    )
    return cut_into_folds(problem)


def _column(rng: np.random.Generator, large: int, others: float) -> FloatArray:
    """A column that is large in some moves, and has a size in the others, shape (rows,)."""
    size = np.full(MOVES, others)
    size[rng.choice(MOVES, large, replace=False)] = 1.0
    return np.asarray(np.repeat(size, ROWS) * rng.normal(size=MOVES * ROWS))


def _trial(
    rng: np.random.Generator, coefficient: float, *, large: int, others: float
) -> CandidateTrial:
    column = _column(rng, large, others)
    torque = coefficient * column
    folds = _folds(rng, torque)
    sorted_column = column[folds.linearisation.source, None]
    candidates = [slice(0, 1)]
    (trial,) = score_candidates(folds, sorted_column, candidates)
    assert trial is not None
    return trial


def _judged(problem: SearchProblem, *trials: CandidateTrial) -> list[Finding]:
    """Findings of a saturation in the order of the trials,
    which are given the shapes of a robot with three motors.
    """
    shaped = [replace(one, left_out=np.zeros((8, 3)), fall_by_motor=np.ones(3)) for one in trials]
    families = [FamilyTrials(0, ((Saturation(), one),)) for one in shaped]
    rng = np.random.default_rng(2)
    ranked = rank_families(problem, families, rng, GATES)
    of_trials = {id(finding.coefficients): finding for finding in ranked}
    return [of_trials[id(one.coefficients)] for one in shaped]


def test_without_the_moves_of_most_leverage_is_a_fit_of_the_others() -> None:
    rng = np.random.default_rng(1)
    column = _column(rng, 3, 0.2)
    torque = 2.0 * column
    folds = _folds(rng, torque)
    problem = folds.linearisation
    columns = column[problem.source, None]
    candidates = [slice(0, 1)]
    (trial,) = score_candidates(folds, columns, candidates)
    assert trial is not None
    assert trial.without_leverage is not None
    gram_order = np.argsort(trial.gram[:, 0, 0])
    largest = gram_order[-LEVERAGE:]
    others = ~np.isin(problem.cluster, largest)
    both = np.hstack((whole(problem.jacobian), columns))[others]
    fitted = np.linalg.lstsq(both, problem.residual[others], rcond=None)[0]
    left = both[:, -1] - both[:, :-1] @ np.linalg.lstsq(both[:, :-1], both[:, -1], rcond=None)[0]
    after = problem.residual[others] - both @ fitted
    rest = trial.without_leverage
    assert rest.score[0] / rest.gram.sum() == pytest.approx(fitted[-1], rel=1e-6)
    expected = np.bincount(problem.cluster[others], left * after, minlength=MOVES)
    np.testing.assert_allclose(trial.without_leverage.scatter[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(
        trial.without_leverage.gram[:, 0, 0],
        np.bincount(problem.cluster[others], left**2, minlength=MOVES),
        atol=1e-6,
    )


def test_a_saturation_that_rests_on_few_moves_is_tested_by_the_others_where_they_show_it(
    search_problem: SearchProblem,
) -> None:
    rng = np.random.default_rng(3)
    trial = _trial(rng, 3.0, large=2, others=0.1)
    assert moves_behind(trial.gram) < FEW_MOVES
    (finding,) = _judged(search_problem, trial)
    assert finding.probability is not None
    assert finding.probability <= GATES.false_alarm
    assert finding.too_few_moves == ""


@pytest.mark.parametrize("others", [0.0, 1e-3])
def test_a_saturation_on_two_moves_alone_is_not_tested_and_says_what_to_record(
    search_problem: SearchProblem, others: float
) -> None:
    rng = np.random.default_rng(4)
    trial = _trial(rng, 3.0, large=2, others=others)
    assert moves_behind(trial.gram) < FEWEST_MOVES
    (finding,) = _judged(search_problem, trial)
    assert finding.probability is None
    assert not finding.passed
    expected = f"it rests on two moves, too few to test it: record more {RECORD[Abscissa.CURRENT]}"
    assert finding.refusals[0] == (expected)
    assert finding.too_few_moves == finding.refusals[0]


@pytest.mark.slow
def test_noise_on_few_moves_that_the_others_do_not_show_is_no_effect(
    search_problem: SearchProblem,
) -> None:
    """Of 200 candidates on noise 10 ± 3.1 have p ≤ 0.05; the test by the others keeps its size."""
    rng = np.random.default_rng(5)
    false = 0
    for _ in range(200):
        (finding,) = _judged(search_problem, _trial(rng, 0.0, large=2, others=0.1))
        assert finding.probability is not None
        false += finding.probability <= 0.05
        if finding.probability > GATES.strong_false_alarm:
            assert finding.refusals[0].startswith("it rests on ")
            assert "p =" not in finding.refusals[0]
    assert 2 <= false <= 20


def test_candidates_on_few_moves_set_no_limit_for_others(search_problem: SearchProblem) -> None:
    rng = np.random.default_rng(6)
    strong = _trial(rng, 0.16, large=MOVES, others=1.0)
    few = [_trial(rng, 0.0, large=4, others=0.0) for _ in range(5)]
    assert all(FEWEST_MOVES <= moves_behind(one.gram) < FEW_MOVES for one in few)
    (alone,) = _judged(search_problem, strong)
    beside = _judged(search_problem, strong, *few)
    assert beside[0].probability == alone.probability
    # They compete with all, by the heavy tail of few moves.
    (lonely,) = _judged(search_problem, few[0])
    assert lonely.probability is not None
    assert beside[1].probability is not None
    assert beside[1].probability >= lonely.probability
