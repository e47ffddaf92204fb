"""Find the effect that a residual asks for, or say that it asks for none.

The lag-one correlation of a residual is about 0.67, so textbook tests lie. A candidate must pass every gate:

1. cluster Wald, max-T: its statistic, clustered by move, is larger than the largest of all candidates' in 99 % of
   draws in which each move's noise keeps its size and gets a random sign (a wild bootstrap, Cameron et al. 2008);
2. it is better on at least three quarters of the folds of left-out moves;
3. it explains at least 3 % of the squared residual of the motor that feels it most;
4. that motor's error on left-out moves falls by at least 2 %.

Candidates are ranked by left-out moves, and the setting of a family (its exponent, its speed) is chosen anew inside
each fold, by the other folds alone: the score of a family has not seen what it is scored on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from ident.dataset import Dataset
from ident.effects import EFFECTS
from ident.effects.effect import Effect
from ident.effects.torque import effect_torque
from ident.estimate import Estimate
from ident.linearisation import linearise
from ident.model import Model
from ident.observation import Observation
from ident.residual import Folds, Trial, cut, put_to_test
from ident.signals import signals

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Gates:
    """What a candidate must show before it may join the model."""

    false_alarm: float = 0.01
    folds_better: float = 0.75
    explained: float = 0.03
    error_fall: float = 0.02
    draws: int = 999


@dataclass(frozen=True, slots=True)
class Finding:
    """One family on one axis, and what the data say of it.

    Attributes:
        effect: with the setting that explains most.
        axis: index of the joint (or motor).
        coefficients: first estimate of its linear parameters.
        probability: that noise alone makes a candidate this strong somewhere among all.
        folds_better: share of folds on which it lowers the error.
        explained: share of the squared residual of the motor that feels it most.
        error_before_percent, error_after_percent: of that motor on left-out moves, ‖e‖/‖v‖ of its current [%].
        error_fall: relative fall from one to the other.
        held_out_fall: fall of the whole whitened ‖e‖² on left-out moves; the rank.
        passed: whether every gate is open.
        ambiguity: other families whose left-out score cannot be told from this one's.
    """

    effect: Effect
    axis: int
    coefficients: FloatArray
    probability: float
    folds_better: float
    explained: float
    error_before_percent: float
    error_after_percent: float
    error_fall: float
    held_out_fall: float
    passed: bool
    ambiguity: tuple[str, ...] = ()


def find(
    model: Model,
    datasets: Sequence[Dataset],
    observation: Observation,
    estimate: Estimate,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] = EFFECTS,
) -> tuple[Finding, ...]:
    """All families on all axes, the best on left-out moves first.

    Args:
        model: the declared model.
        datasets: the runs of the fit, in the observation's order.
        observation: their rows, with the columns of effects accepted so far.
        estimate: by ``ml`` on that observation.
        rng: of the bootstrap.
        gates: what a candidate must show.
        families: the dictionary.
    """
    gates = gates or Gates()
    runs = [signals(model, data, observation, estimate) for data in datasets]
    problem = linearise(
        observation, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=estimate.gains_fixed
    )
    folds = cut(problem)
    problem = folds.problem
    hessian = linalg.cho_factor(problem.jacobian.T @ problem.jacobian, lower=True)
    to_motor = model.drive_train.to_motor
    tried: list[tuple[int, tuple[tuple[Effect, Trial], ...]]] = []
    for axis in range(observation.joint_count):
        for family in families:
            members: list[tuple[Effect, Trial]] = []
            for effect in family:
                torque = effect_torque(effect, axis, runs, datasets, observation.conditioning, model)
                motors = (to_motor @ torque.reshape(len(torque), -1)).reshape(torque.shape)
                trial = put_to_test(folds, hessian, problem.whitened(motors))
                if trial is not None:
                    members.append((effect, trial))
            if members:
                tried.append((axis, tuple(members)))
    probabilities = _max_t(tuple(trial for _, members in tried for _, trial in members), rng, gates.draws)
    findings, first = [], 0
    for axis, tested in tried:
        findings.append(_judge(folds, axis, tested, probabilities[first : first + len(tested)], gates))
        first += len(tested)
    return _with_ambiguity(folds, tuple(findings), tuple(members for _, members in tried))


def _nested(members: tuple[tuple[Effect, Trial], ...]) -> FloatArray:
    """‖e‖² of each fold and motor, the setting chosen by the other folds alone."""
    chosen = np.argmax(np.stack([trial.training_fall for _, trial in members]), axis=0)
    return np.stack([members[best][1].held_out[fold] for fold, best in enumerate(chosen)])


def _judge(
    folds: Folds, axis: int, members: tuple[tuple[Effect, Trial], ...], probability: FloatArray, gates: Gates
) -> Finding:
    problem = folds.problem
    best = int(np.argmax([float(trial.fallen.sum()) for _, trial in members]))
    effect, trial = members[best]
    before, after = folds.square_sum(folds.residual), _nested(members)
    fall = before.sum(axis=1) - after.sum(axis=1)
    # A joint's torque may be another motor's to give (R): the drive in question is the one whose residual falls most.
    motor = int(np.argmax(trial.fallen))
    rows = problem.motor == motor
    own, size = float(np.sum(problem.residual[rows] ** 2)), float(np.sum(problem.current[rows] ** 2))
    explained = float(trial.fallen[motor] / own)
    error_before, error_after = (float(np.sqrt(part[:, motor].sum() / size)) for part in (before, after))
    error_fall = 1.0 - error_after / error_before
    folds_better = float(np.mean(fall > 0))
    passed = (
        probability[best] <= gates.false_alarm
        and folds_better >= gates.folds_better
        and explained >= gates.explained
        and error_fall >= gates.error_fall
    )
    return Finding(
        effect=effect,
        axis=axis,
        coefficients=trial.coefficients,
        probability=float(probability[best]),
        folds_better=folds_better,
        explained=explained,
        error_before_percent=100.0 * error_before,
        error_after_percent=100.0 * error_after,
        error_fall=error_fall,
        held_out_fall=float(fall.sum()),
        passed=bool(passed),
    )


def _max_t(trials: tuple[Trial, ...], rng: np.random.Generator, draws: int) -> FloatArray:
    """Probability of each candidate's Wald statistic under random signs of the moves, for the largest of all."""
    moves = trials[0].scatter.shape[0]
    signs = rng.choice((-1.0, 1.0), size=(draws, moves))
    observed, largest = np.empty(len(trials)), np.full(draws, -np.inf)
    for index, trial in enumerate(trials):
        # The candidate is in the fit here: else its own torque would count as noise, and the strongest would hide best.
        inverse = np.linalg.pinv(trial.scatter.T @ trial.scatter)
        freedom, drawn = len(trial.score), signs @ trial.scatter
        # On the scale of −log p, so that candidates with one and with two coefficients compete alike.
        observed[index] = -stats.chi2.logsf(float(trial.score @ inverse @ trial.score), freedom)
        largest = np.maximum(largest, -stats.chi2.logsf(np.einsum("dp,pq,dq->d", drawn, inverse, drawn), freedom))
    return np.asarray((1.0 + np.sum(largest[None] >= observed[:, None], axis=1)) / (draws + 1.0))


def _with_ambiguity(
    folds: Folds, findings: tuple[Finding, ...], members: tuple[tuple[tuple[Effect, Trial], ...], ...]
) -> tuple[Finding, ...]:
    """Rank, and name for each finding the others that a paired comparison over folds cannot tell from it."""
    scores = [_nested(family).sum(axis=1) for family in members]
    order = sorted(range(len(findings)), key=lambda i: -findings[i].held_out_fall)
    ranked = []
    for index in order:
        finding = findings[index]
        alike = []
        for other in order:
            if other == index or findings[other].held_out_fall <= 0:
                continue
            difference = scores[other] - scores[index]
            error = float(np.std(difference, ddof=1)) * np.sqrt(len(difference))
            if abs(float(difference.sum())) <= error:
                alike.append(f"{findings[other].effect.name} on axis {findings[other].axis + 1}")
        ranked.append(replace(finding, ambiguity=tuple(alike)))
    return tuple(ranked)
