"""Share of the choice of effects in σ: rivals of those that joined, and those that stayed out.

The covariance of a joint fit takes its effects as given. But the search has chosen them, on the
same data. Another model r could be the true one. It would put the gains and parameters θ at θ_r,
and averaged over the models (Buckland, Burnham & Augustin 1997; here around the one that was
chosen, whose estimate is kept) the covariance grows by

    C_r = w_r (θ_r − θ)(θ_r − θ)ᵀ,      w_r = o_r/(1 + Σ o),      o_r = p_r/(1 − p_r),

with Σ over the rivals of the same effect, or of the same axis, and p_r the probability that r
predicts left-out moves better than the chosen model, by a paired comparison over folds (Student's
t). Models that do equally well have equal weights. They are

- for each effect in the fit, those of its ambiguity set in its place;
- for each axis, one further effect that is no noise (`Gates.false_alarm`, over all candidates) and
  possible, but too small for the other gates: a saturation that explains 3 % of the residual may
  move a gain by five σ. A term without a name that did not join because it moves a gain is one of
  them;
- each effect that left although nothing refutes it: held-out runs decide nothing, or σ itself hides
  it. No other model takes a part of its weight, because the gains of a model with it are what they
  would be if it is true.

θ_r is taken to first order, from products with columns that the search has made before: no refit.
The error of the settings that were searched (exponents, time constants) is left out: it was below a
tenth of σ wherever it was measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray
from ident.discovery.candidates import CandidateTrial, SearchProblem, score_candidates
from ident.discovery.gates import Gates, impossible, shifts_by, whitened_columns, without_effects_of
from ident.discovery.search import Finding, paired_t
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import GeometryEffect
from ident.estimators.estimate import Estimate


def choice_covariance(
    search_problem: SearchProblem,
    estimate: Estimate,
    accepted: Sequence[tuple[Finding, Sequence[Finding]]],
    left: Sequence[Finding],
    open_effects: Sequence[PlacedEffect] = (),
) -> FloatArray:
    """Covariance of (gains, parameters) from the choice of the effects, shape (m + p, m + p).

    Args:
        search_problem: linearised around the joint fit.
        estimate: the joint fit.
        accepted: each effect that is still in the fit, with the findings of its turn.
        left: findings that are no noise, but did not join; `fold_errors` are beside this fit.
        open_effects: effects that left the fit, and may be true.
    """
    size = len(estimate.covariance)
    shifts = [np.zeros((0, size))]
    for finding, others in accepted:
        found = {one.placed: one for one in others}
        rivals = [found[placed] for placed in finding.ambiguity if placed in found]
        if not rivals:
            continue
        reduced = without_effects_of(search_problem, estimate, (finding.placed,))
        torque = reduced.torque
        errors = finding.fold_errors
        shifts.append(_by_rivals(reduced.search_problem, torque, errors, rivals, size))
    folds = search_problem.folds
    errors = folds.square_sum(folds.residual).sum(axis=1)
    nothing = np.zeros(len(folds.residual))
    for axis in sorted({one.axis for one in left}):
        rivals = [one for one in left if one.axis == axis]
        shifts.append(_by_rivals(search_problem, nothing, errors, rivals, size))
    for placed in open_effects:
        shifts.append(_by_open_effect(search_problem, errors, placed, size))
    # Σ C_r over all models r.
    all_shifts = np.concatenate(shifts)
    return all_shifts.T @ all_shifts


def is_small(finding: Finding, gates: Gates) -> bool:
    """Whether a finding is no noise and possible, but too small for the other gates."""
    if finding.probability is None or finding.probability > gates.false_alarm:
        return False
    if impossible(finding.effect.coefficients, finding.coefficients, finding.deviations):
        return False
    return (
        finding.folds_better < gates.folds_better
        or finding.explained < gates.explained
        or finding.error_fall < gates.error_fall
    )


def scored_beside(search_problem: SearchProblem, finding: Finding) -> Finding | None:
    """Score a finding of another turn beside the present fit; None where the fit contains it.

    Args:
        search_problem: linearised around the fit.
        finding: of a problem around another fit.
    """
    columns = whitened_columns(search_problem, finding.effect, finding.axis)
    trial = _trial_of(search_problem, columns)
    if trial is None:
        return None
    fold_errors = trial.left_out.sum(axis=1)
    return replace(finding, coefficients=trial.coefficients, fold_errors=fold_errors)


def _trial_of(search_problem: SearchProblem, columns: FloatArray) -> CandidateTrial | None:
    """Test whitened columns, shape (rows, p), as one candidate."""
    together = slice(0, columns.shape[1])
    (trial,) = score_candidates(search_problem.folds, columns, (together,))
    return trial


def _by_open_effect(
    search_problem: SearchProblem, fold_errors: FloatArray, placed: PlacedEffect, size: int
) -> FloatArray:
    """√w_r (θ_r − θ) of the model with an effect that left, shape (1, size).

    It has no row where the fit contains the effect.
    """
    effect = placed.effect
    if isinstance(effect, GeometryEffect):  # the description no longer has its applied part
        effect = effect.with_applied([0.0] * len(effect.coefficients))
    columns = whitened_columns(search_problem, effect, placed.axis)
    trial = _trial_of(search_problem, columns)
    if trial is None:
        return np.zeros((0, size))
    with_effect = trial.left_out.sum(axis=1)
    weight = _weights(fold_errors, with_effect[None])
    moved = shifts_by(search_problem.folds, columns @ trial.coefficients, size)
    return np.sqrt(weight)[:, None] * moved


def _weights(chosen: FloatArray, others: FloatArray) -> FloatArray:
    """Weight w_r of each model beside the chosen one, shape (models,), by ‖e‖² on each fold.

    Args:
        chosen: of the chosen model, shape (folds,).
        others: of the other models, shape (models, folds).
    """
    gain = chosen - others
    freedom = gain.shape[1] - 1
    is_better = scipy.special.stdtr(freedom, paired_t(gain))  # p_r
    is_worse = np.maximum(1.0 - is_better, np.finfo(np.float64).eps)
    odds = is_better / is_worse
    return np.asarray(odds / (1.0 + odds.sum()))


def _by_rivals(
    search_problem: SearchProblem,
    torque: FloatArray,
    fold_errors: FloatArray,
    rivals: Sequence[Finding],
    size: int,
) -> FloatArray:
    """√w_r (θ_r − θ) of models with another effect in place of the chosen one, (rivals, size).

    Args:
        search_problem: around the fit, without the chosen effect.
        torque: of the chosen effect, whitened, shape (rows,); zero where there is none.
        fold_errors: ‖e‖² of the chosen model on each fold, shape (folds,).
        rivals: the other effects.
        size: m + p.
    """
    errors_of_rivals = np.stack([one.fold_errors for one in rivals])
    weights = _weights(fold_errors, errors_of_rivals)
    shifts = []
    for rival, weight in zip(rivals, weights, strict=True):
        columns = whitened_columns(search_problem, rival.effect, rival.axis)
        trial = _trial_of(search_problem, columns)
        if trial is not None:
            more_torque = columns @ trial.coefficients - torque
            moved = shifts_by(search_problem.folds, more_torque, size)
            shifts.append(np.sqrt(weight) * moved)
    return np.reshape(shifts, (-1, size))
