"""Zeros of two joints that are wrong at once, beside a fit.

Where J2 is off by +5° and J3 by −5°, only the link between them is turned: what gravity does to it is that of another
centre of mass, and the arm behind it hangs as it should. Neither zero explains anything alone. Both together are a
candidate with two columns, and pass by the same tests as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray
from ident.discovery.candidates import CandidateTrial, FamilyTrials, SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.search import chances, sigma_by_moves
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import ZeroOffset

CERTAIN_SIGMAS = 4.0  #: By which each of two zeros must be off
SCREENED_CHANCE = 1e-4  #: Of Wald's test, above which the moves' random signs need not be drawn


@dataclass(frozen=True, slots=True)
class PairOfZeros:
    """What is known of the zeros of two joints when both are fitted."""

    effects: tuple[PlacedEffect, PlacedEffect]
    torque_nm: FloatArray  #: their columns at the joints, shape (m, 2, r)
    trial: CandidateTrial

    @property
    def axes(self) -> tuple[int, int]:
        """Of the two joints."""
        first, second = self.effects
        return first.axis, second.axis

    @property
    def deviations(self) -> FloatArray:
        """σ of both zeros, by the scatter of moves, shape (2,)."""
        return sigma_by_moves(self.trial)

    def fall(self, problem: SearchProblem) -> FloatArray:
        """Fall of ‖e‖² on each fold of held-out moves, shape (folds,)."""
        before = problem.folds.square_sum(problem.folds.residual).sum(axis=1)
        return np.asarray(before - self.trial.held_out.sum(axis=1))


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
    torques = [np.concatenate((columns[first], columns[second]), axis=1) for first, second in paired]
    pairs: list[PairOfZeros] = []
    for (first, second), torque_nm, trial in zip(paired, torques, problem.trials(torques), strict=True):
        if trial is not None:
            pairs.append(PairOfZeros((zeros[first], zeros[second]), torque_nm, trial))
    return tuple(pairs)


def pairs_that_pass(
    problem: SearchProblem, pairs: Sequence[PairOfZeros], rng: np.random.Generator, gates: Gates
) -> tuple[PairOfZeros, ...]:
    """Return the pairs of which both zeros are wrong, the best on held-out moves first.

    Args:
        problem: that they were tried on.
        pairs: from `try_pairs`.
        rng: of the bootstrap.
        gates: limits; the probability is that of the strongest of all pairs under noise.
    """
    if all(_chance_by_wald(pair.trial) > SCREENED_CHANCE for pair in pairs):
        return ()
    passed: list[tuple[float, PairOfZeros]] = []
    chance_of_pair = chances(tuple(pair.trial for pair in pairs), rng, gates.draws)
    for pair, chance in zip(pairs, chance_of_pair, strict=True):
        fall = pair.fall(problem)
        is_certain = bool(np.all(np.abs(pair.trial.coefficients) > CERTAIN_SIGMAS * pair.deviations))
        is_better = float(fall.sum()) > 0.0 and float(np.mean(fall > 0.0)) >= gates.folds_better
        if is_certain and is_better and chance <= gates.false_alarm:
            passed.append((float(fall.sum()), pair))
    passed.sort(key=lambda one: -one[0])
    return tuple(pair for _, pair in passed)


def _chance_by_wald(trial: CandidateTrial) -> float:
    """Probability of coefficients as far from zero where both are zero, by the scatter of moves."""
    wald = float(trial.score @ np.linalg.pinv(trial.scatter.T @ trial.scatter) @ trial.score)
    return float(scipy.special.chdtrc(len(trial.score), wald))
