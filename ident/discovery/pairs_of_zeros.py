"""Zeros of two joints that are wrong at once, beside a fit.

Where J2 is off by +5° and J3 by −5°, only the link between them is turned: what gravity does to it
is that of another centre of mass, and the arm behind it hangs as it should. Neither zero explains
anything alone. Both together are a candidate with two columns, and pass by the same tests as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.candidates import CandidateTrial, FamilyTrials, SearchProblem
from ident.discovery.gates import Gates, probability_of_zero
from ident.discovery.search import bootstrap_probabilities
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import ZeroOffset

CERTAIN_SIGMAS = 4.0  #: By which each of two zeros must be off
SCREENED_CHANCE = 1e-4  #: Of Wald's test, above which the moves' random signs need not be drawn


@dataclass(frozen=True, slots=True)
class PairOfZeros:
    """Zeros of two joints as one candidate."""

    effects: tuple[PlacedEffect, PlacedEffect]
    torque_nm: FloatArray  #: their columns at the joints, shape (m, 2, r)
    trial: CandidateTrial  #: of both columns

    @property
    def axes(self) -> tuple[int, int]:
        """Axes of the two joints."""
        first, second = self.effects
        return first.axis, second.axis

    def fall(self, problem: SearchProblem) -> FloatArray:
        """Fall of ‖e‖² on each fold of left-out moves, shape (folds,)."""
        folds = problem.folds
        before = folds.square_sum(folds.residual).sum(axis=1)
        after = self.trial.left_out.sum(axis=1)
        return np.asarray(before - after)


def try_pairs(problem: SearchProblem, tested: Sequence[FamilyTrials]) -> tuple[PairOfZeros, ...]:
    """Fit the zeros of every two joints.

    Args:
        problem: with rows that serve as signals.
        tested: families on their axes; those of zeros are paired.
    """
    zeros: dict[int, PlacedEffect] = {}
    columns: dict[int, FloatArray] = {}
    for family in tested:
        effect = family.members[0][0]
        if isinstance(effect, ZeroOffset):
            zeros[family.axis] = PlacedEffect(effect, family.axis)
            columns[family.axis] = problem.torque_at_rows(effect, family.axis)
    paired = list(combinations(zeros, 2))
    torques: list[FloatArray] = []
    for first, second in paired:
        of_both = (columns[first], columns[second])
        torques.append(np.concatenate(of_both, axis=1))
    trials = problem.trials(torques)
    pairs: list[PairOfZeros] = []
    for (first, second), torque_nm, trial in zip(paired, torques, trials, strict=True):
        if trial is not None:
            effects = (zeros[first], zeros[second])
            pairs.append(PairOfZeros(effects, torque_nm, trial))
    return tuple(pairs)


def pairs_that_pass(
    problem: SearchProblem, pairs: Sequence[PairOfZeros], rng: np.random.Generator, gates: Gates
) -> tuple[PairOfZeros, ...]:
    """Return the pairs of which both zeros are wrong, the best on left-out moves first.

    Args:
        problem: that they were tried on.
        pairs: from `try_pairs`.
        rng: of the bootstrap.
        gates: limits; the probability is that of the strongest of all pairs under noise.
    """
    trials = tuple(pair.trial for pair in pairs)
    by_wald = (probability_of_zero(trial.coefficients, trial.covariance) for trial in trials)
    if all(probability > SCREENED_CHANCE for probability in by_wald):
        return ()
    passed: list[tuple[float, PairOfZeros]] = []
    probabilities = bootstrap_probabilities(trials, rng, gates.draws)
    for pair, probability in zip(pairs, probabilities, strict=True):
        fall = pair.fall(problem)
        share_of_folds = float(np.mean(fall > 0.0))
        limits = CERTAIN_SIGMAS * pair.trial.deviations
        is_certain = np.all(np.abs(pair.trial.coefficients) > limits)
        is_better = fall.sum() > 0.0 and share_of_folds >= gates.folds_better
        if is_certain and is_better and probability <= gates.false_alarm:
            passed.append((float(fall.sum()), pair))
    passed.sort(key=lambda one: -one[0])
    return tuple(pair for _, pair in passed)
