"""Whether a finding may join the model: refit everything with it,
and judge every effect beside all the others.

`join` is the entry. It refits gains, parameters and effects together, asks instruments from the
demanded motion whether the effect is a disturbance in the position loop, linearises the problem
around the joint fit, and lets each effect pass all gates again beside the others; what fails
leaves. A finding that may not join is returned as `SetAside`, with why. `refuted_by_structure` asks
before the refit whether a name is only similar to what would bend a gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.beside_stops import fitted_clear_of_stops, turns_with_motion
from ident.discovery.braking import describe_driving_friction, is_friction_of_motion
from ident.discovery.candidates import (
    CandidateTrial,
    ColumnCache,
    FamilyTrials,
    SearchProblem,
    prepare_search,
    score_candidates,
)
from ident.discovery.evidence import (
    Evidence,
    by_instruments,
    settled_corrections,
    with_effects,
    with_first_order_effects,
)
from ident.discovery.gates import (
    CERTAIN_DELAY_SIGMAS,
    Gates,
    PartsLeftOut,
    certain_delays,
    covariance_of,
    gain_shifts,
    impossible,
    in_noise,
    moved_gains,
    own_unknowns,
    runs_to_leave_out,
    uncertain_amplitude,
    values_of,
    whitened_columns,
    without_effects_of,
)
from ident.discovery.late_currents import Delay
from ident.discovery.refinement import refine_together
from ident.discovery.rotor_search import with_refined_rotor
from ident.discovery.search import Finding, is_better, rank_families
from ident.discovery.structure import is_inadequate
from ident.effects.effect import Effect, EffectKey, PlacedEffect, Reported, effect_key
from ident.effects.geometry_corrections import LatePosition, is_correction
from ident.effects.signals import Abscissa
from ident.effects.unnamed import is_unnamed
from ident.errors import NotConverged, RankDeficient
from ident.estimators.estimate import Estimate

#: Errors of a fit that its data do not determine
FIT_ERRORS = (NotConverged, RankDeficient, np.linalg.LinAlgError)
#: Confidence of a contradiction by instruments: one search tests a dozen effects by them
INSTRUMENT_CONFIDENCE = 0.999
#: Refits of an effect whose settings are fitted; each moves them by a fraction of the one before
REFINEMENTS = 4


@dataclass(frozen=True, slots=True)
class SetAside:
    """A finding that passed the search, but did not join the model."""

    finding: Finding
    words: str = ""  #: why it did not, `{rival}` in the place of the rival's name
    rival: PlacedEffect | None = None  #: an effect that is kept instead, or that explains more
    moved: tuple[tuple[int, float], ...] = ()  #: gains that it would move: index, and by how many σ

    def reason(self, axes: Sequence[str]) -> str:
        """Why it did not join, in words, with the names of the axes."""
        if self.rival is None:
            words = self.words
        else:
            words = self.words.replace("{rival}", self.rival.name_among(axes))
        if not self.moved:
            return words
        gains = self.moved_text(axes)
        if words:
            return f"it would move {gains}, and {words}"
        return f"it has no name, and would move {gains}"

    def moved_text(self, axes: Sequence[str]) -> str:
        """Which gains it would move, and by how many σ, with the names of the axes."""
        return ", ".join(f"the gain of {axes[motor]} by {size:.1f} σ" for motor, size in self.moved)


@dataclass(frozen=True, slots=True)
class JointFit:
    """A joint fit, and the problem linearised around it."""

    evidence: Evidence
    search_problem: SearchProblem


def linearised(evidence: Evidence, cache: ColumnCache) -> JointFit:
    """Linearise the problem around a joint fit."""
    model = evidence.model
    estimate = evidence.estimate
    problem = prepare_search(
        model, evidence.fit_runs, evidence.training, estimate, cache, evidence.effects
    )
    return JointFit(evidence, problem)


def linearised_after(evidence: Evidence, before: JointFit) -> JointFit:
    """Linearise around a refit; columns of motion are kept unless a correction has changed the
    motion.
    """
    pairs = zip(evidence.datasets, before.evidence.datasets, strict=True)
    is_same_motion = all(data is data_before for data, data_before in pairs)
    cache = before.search_problem.cache
    if not is_same_motion:
        cache = ColumnCache()
    return linearised(evidence, cache)


def refitted_with(model: JointFit, effects: tuple[PlacedEffect, ...]) -> JointFit:
    """Refit the same data with these effects, and linearise around the fit."""
    refitted = with_effects(model.evidence, effects, model.search_problem.runs)
    return linearised_after(refitted, model)


def keys_of(evidence: Evidence) -> frozenset[EffectKey]:
    """Keys of the effects of a model."""
    return frozenset(effect_key(placed.effect, placed.axis) for placed in evidence.effects)


def join(
    model: JointFit,
    accepted: Finding,
    rng: np.random.Generator,
    gates: Gates,
    seen: set[frozenset[EffectKey]],
) -> JointFit | SetAside:
    """Refit with a finding in the model and drop what no longer passes;
    or say why it may not join.

    Args:
        model: without the finding.
        accepted: the finding.
        rng: of the bootstrap.
        gates: limits.
        seen: effects of each model that the search has had: without this, two effects that replace
            each other would do so for ever.
    """
    refitted = _refit(model, accepted)
    if isinstance(refitted, SetAside):
        return refitted
    accepted = with_joint_settings(accepted, refitted.evidence)
    pruned = _pruned(refitted, accepted, rng, gates)
    if isinstance(pruned, SetAside):
        return pruned
    if keys_of(pruned.evidence) in seen:
        return SetAside(accepted, "it would only exchange places with an effect that it replaces")
    placed = accepted.placed
    # Instruments have been asked by the refit: again only where other effects have left since.
    if pruned is not refitted:
        why = refuted_by_instruments(pruned.evidence, placed)
        if why:
            return SetAside(accepted, why)
    why = refuted_clear_of_stops(pruned.evidence, placed)
    if why:
        return SetAside(accepted, why)
    return pruned


def refuted_clear_of_stops(evidence: Evidence, placed: PlacedEffect) -> str:
    """Why an effect of a joint fit may be friction of joints at rest alone; empty where it may not.

    Such friction is only in rows next to a stop. In a fit of rows that are clear of stops, the
    effect is then nearer to zero than to the joint fit. Rows that would not show an effect of that
    size refute nothing.
    """
    if not turns_with_motion(placed.effect):
        return ""
    try:
        clear_of_stops = fitted_clear_of_stops(evidence)
    except FIT_ERRORS:
        return ""
    why = _contradicted_by(clear_of_stops, evidence, placed)
    if not why:
        return ""
    return f"in rows that are clear of stops, {why}"


def refuted_by_structure(
    model: JointFit, found: Finding, aside: Sequence[SetAside]
) -> SetAside | None:
    """Why a named effect may not join; None where nothing speaks against it.

    It may not where unnamed structure on its axis explains clearly more, was set aside because it
    bends a gain, and the named effect bends one, too: then it only resembles the truth. It does no
    harm where it bends no gain. Where it still lowers the error with the structure in the model, it
    explains something else. A term against the time, or the session, refutes nothing where no run
    can be left out: it can separate the loaded runs from the others.
    """
    if is_unnamed(found.effect):
        return None
    problem = model.search_problem
    folds = model.search_problem.folds
    ignored: tuple[Abscissa, ...] = ()
    if not runs_to_leave_out(problem.observation):
        ignored = (Abscissa.TIME, Abscissa.SESSION)
    before = float(folds.square_sum(folds.residual).sum())
    for term in _structure_that_moves_gains(aside):
        if term.axis != found.axis or term.effect.abscissa in ignored:
            continue
        named_columns = whitened_columns(problem, found.effect, found.axis)
        term_columns = whitened_columns(problem, term.effect, term.axis)
        columns = np.hstack((named_columns, term_columns))
        count = named_columns.shape[1]
        candidates = [slice(0, count), slice(count, None), slice(None)]
        by_name, by_term, by_both = score_candidates(folds, columns, candidates)
        if by_name is None or by_term is None or by_both is None:
            continue
        # ‖r‖² of each fold; the named effect with its refined settings, not those of its finding.
        name_errors = by_name.left_out.sum(axis=1)
        term_errors = by_term.left_out.sum(axis=1)
        both_errors = by_both.left_out.sum(axis=1)
        named = replace(
            found,
            coefficients=by_name.coefficients,
            fold_errors=name_errors,
            left_out_fall=before - float(name_errors.sum()),
        )
        adds_to_term = is_better(both_errors, term_errors)
        if adds_to_term or not is_inadequate(named, term):
            continue
        moved = _moved_by(model, named)
        if moved:
            return SetAside(found, "{rival} explains clearly more", term.placed, moved)
    return None


def _structure_that_moves_gains(aside: Sequence[SetAside]) -> list[Finding]:
    """Unnamed terms that were set aside because they would move a gain."""
    terms: list[Finding] = []
    for one in aside:
        if one.moved and is_unnamed(one.finding.effect):
            terms.append(one.finding)
    return terms


def _refit(model: JointFit, accepted: Finding) -> JointFit | SetAside:
    """Refit with a finding in the model;
    or say why it may not join, whatever else is in the model.
    """
    evidence = model.evidence
    problem = model.search_problem
    last = accepted.placed
    if is_unnamed(last.effect):
        moved = _moved_by(model, accepted)  # to first order: a refit takes longer
        if moved:
            return SetAside(accepted, moved=moved)
    try:
        first_order = with_first_order_effects(evidence, (*evidence.effects, last), problem.runs)
        # Before the problem is linearised: it and the instruments together would need much memory.
        why = refuted_by_instruments(first_order, last)
        if why:
            return SetAside(accepted, why)
        refitted = settled_corrections(first_order)
        if refitted is not first_order:
            why = refuted_by_instruments(refitted, last)
            if why:
                return SetAside(accepted, why)
        joined = linearised_after(refitted, model)
        if is_correction(last):
            joined = _with_all_refined(joined)
        else:
            joined = with_refined_settings(joined)
    except FIT_ERRORS as error:
        # To first order the data told the effect from the model, in a complete fit they do not.
        return SetAside(accepted, f"it cannot be fitted: {error}")
    unnamed = [placed for placed in refitted.effects if is_unnamed(placed.effect)]
    if last in unnamed:  # found by equality: no setting of an unnamed term is refined
        reduced = without_effects_of(joined.search_problem, refitted.estimate, unnamed)
        moved = moved_gains(reduced.gain_shifts, evidence.estimate.gains_std)
        if moved:
            return SetAside(accepted, moved=moved)
    return joined


def _moved_by(model: JointFit, found: Finding) -> tuple[tuple[int, float], ...]:
    """Index of each gain that a finding would move by more than its σ, to first order,
    and by how many σ.
    """
    problem = model.search_problem
    torque = whitened_columns(problem, found.effect, found.axis) @ found.coefficients
    return moved_gains(gain_shifts(problem.folds, torque), model.evidence.estimate.gains_std)


def with_refined_settings(model: JointFit, index: int = -1) -> JointFit:
    """Refine the settings of an effect around the joint fit and refit, until they stay as they are.

    The settings that fit the residual of the model without the effect best may be far from those of
    the joint fit, because that model is wrong.

    Args:
        model: the joint fit.
        index: place of the effect among those of the model.
    """
    for _ in range(REFINEMENTS):
        effects = list(model.evidence.effects)
        placed = effects[index]
        effect = _refined_in(model, placed)
        if effect == placed.effect:
            break
        effects[index] = replace(placed, effect=effect)
        model = refitted_with(model, tuple(effects))
    return model


def _with_all_refined(model: JointFit) -> JointFit:
    """Refine the settings of every effect: those so far were found with a wrong geometry."""
    for index in range(len(model.evidence.effects)):
        model = with_refined_settings(model, index)
    return model


def _refined_in(model: JointFit, placed: PlacedEffect) -> Effect:
    """Return an effect of a joint fit with the settings that are fitted refined around it."""
    effect = placed.effect
    axis = placed.axis
    estimate = model.evidence.estimate
    if effect.fits_rotor:
        own = own_unknowns(estimate, (placed,))
        coefficients = estimate.parameters[own]
        deviations = estimate.parameters_std[own]
        return with_refined_rotor(model.search_problem, effect, axis, coefficients, deviations)
    if effect.refined:
        reduced = without_effects_of(model.search_problem, estimate, (placed,))
        return refine_together(reduced.search_problem, effect, axis)
    return effect


def with_joint_settings(accepted: Finding, evidence: Evidence) -> Finding:
    """A finding with the settings that its effect has in a joint fit."""
    key = effect_key(accepted.effect, accepted.axis)
    for placed in evidence.effects:
        if effect_key(placed.effect, placed.axis) == key:
            return replace(accepted, effect=placed.effect)
    return accepted


def refuted_by_instruments(evidence: Evidence, placed: PlacedEffect) -> str:
    """Why an effect of a joint fit may be a disturbance in the position loop alone;
    empty where it may not.

    A torque that disturbs the arm moves it, and the loop answers with current. Columns made of the
    recorded motion then explain a part of that current, which those of the demanded motion do not
    (the bias of least squares in a closed loop). The coefficient by instruments is then nearer to
    zero than to that of the fit: it may be zero, or it is another number. Instruments that would
    not show an effect of that size refute no named one; nor do those by which nothing can be
    fitted.
    """
    try:
        estimate = by_instruments(evidence)
    except FIT_ERRORS:
        return ""
    if estimate is None:
        return ""
    why = _contradicted_by(estimate, evidence, placed)
    if why:
        return f"with instruments from the demanded motion, {why}"
    return ""


def _contradicted_by(other: Estimate, evidence: Evidence, placed: PlacedEffect) -> str:
    """Why another estimate of the same unknowns contradicts an effect of a joint fit;
    empty where it does not.
    """
    own = own_unknowns(other, (placed,))
    values = values_of(other, own)
    fitted = values_of(evidence.estimate, own)
    return _contradiction(placed, values, fitted, covariance_of(other, own))


def _contradiction(
    placed: PlacedEffect, values: FloatArray, fitted: FloatArray, covariance: FloatArray
) -> str:
    """Why coefficients of another estimate contradict those of a fit; empty where they do not.

    Args:
        placed: the effect.
        values: of its coefficients by the other estimate, shape (p,).
        fitted: the same of the fit.
        covariance: of the values, shape (p, p).
    """
    why_zero = in_noise(values, covariance, INSTRUMENT_CONFIDENCE)
    if why_zero and is_unnamed(placed.effect):
        return why_zero
    precision = np.linalg.pinv(covariance, hermitian=True)
    # |values − fitted|² > |values|² in units of σ, multiplied out.
    is_nearer_to_zero = float(fitted @ precision @ (fitted - 2.0 * values)) > 0.0
    if not is_nearer_to_zero:
        return ""
    if why_zero:
        # The other estimate refutes only an effect that it would have shown.
        is_fit_in_its_noise = bool(in_noise(fitted, covariance))
        if is_fit_in_its_noise:
            return ""
        return why_zero
    is_same_in_noise = bool(in_noise(fitted - values, covariance, INSTRUMENT_CONFIDENCE))
    if is_same_in_noise:
        return ""
    return _sizes_text(placed, values, fitted)


def _sizes_text(placed: PlacedEffect, values: FloatArray, fitted: FloatArray) -> str:
    """Say how large an effect is by instruments, and by the fit."""
    parts: list[str] = []
    for column, value, found in zip(placed.effect.coefficients, values, fitted, strict=True):
        parts.append(f"{column.name} is {value:.3g} {column.unit}, not {found:.3g} as in the fit")
    return ", ".join(parts)


def _pruned(
    model: JointFit, accepted: Finding, rng: np.random.Generator, gates: Gates
) -> JointFit | SetAside:
    """Drop effects that no longer pass beside the last one;
    or say why the last one may not stay.
    """
    last = model.evidence.effects[-1]
    indispensable: set[PlacedEffect] = set()  # the data cannot be fitted without these
    while True:
        evidence = model.evidence
        failing: list[_Failing] = []
        for placed in evidence.effects[evidence.declared :]:
            left_out_fall, why = judge_beside_others(model, placed, rng, gates)
            if why and placed not in indispensable:
                failing.append(_Failing(placed, left_out_fall, why))
        if not failing:
            return model
        named = [one.placed for one in failing if not is_unnamed(one.placed.effect)]
        if is_unnamed(last.effect) and named:
            return SetAside(accepted, "{rival} would no longer pass beside it", named[0])
        worst = min(failing, key=lambda one: one.left_out_fall)
        if worst.placed == last:
            return SetAside(accepted, f"in the joint fit it no longer passes: {worst.why}")
        try:
            others = tuple(placed for placed in evidence.effects if placed != worst.placed)
            model = refitted_with(model, others)
        except FIT_ERRORS:
            indispensable.add(worst.placed)


@dataclass(frozen=True, slots=True)
class _Failing:
    """An effect of a joint fit that does not pass beside the others."""

    placed: PlacedEffect
    left_out_fall: float  #: fall of ‖e‖² on left-out moves
    why: str


def judge_beside_others(
    model: JointFit, placed: PlacedEffect, rng: np.random.Generator, gates: Gates
) -> tuple[float, str]:
    """Judge an effect of a joint fit beside all others.

    Returns:
        fall of ‖e‖² on left-out moves, and why it does not pass, empty where it does.
    """
    effect = placed.effect
    is_delay = isinstance(effect, Delay | LatePosition)
    limits = gates
    if is_delay:
        # A delay is judged by its length: beside dry friction it is a small part of a motor's
        # residual.
        limits = replace(gates, explained=0.0, error_fall=0.0)
    estimate = model.evidence.estimate
    reduced = without_effects_of(model.search_problem, estimate, (placed,))
    problem = reduced.search_problem
    columns = reduced.columns
    # Simpler forms of the effect have the first columns of it.
    of_forms = [slice(len(form.coefficients)) for form in effect.forms]
    trials = score_candidates(problem.folds, columns, of_forms)
    members: list[tuple[Effect, CandidateTrial]] = []
    for form, trial in zip(effect.forms, trials, strict=True):
        if trial is not None:
            members.append((form, trial))
    if not members:
        return 0.0, "the model contains it already"
    family = FamilyTrials(placed.axis, tuple(members))
    (finding,) = rank_families(problem, (family,), rng, limits)
    own = own_unknowns(estimate, (placed,))
    values = values_of(estimate, own)
    covariance = covariance_of(estimate, own)
    deviations = estimate.parameters_std[own]
    reasons = [*finding.refusals, in_noise(values, covariance)]
    if is_delay:
        reasons.append(_uncertain_delay(finding, values, deviations, gates))
    if effect.reported is Reported.AMPLITUDE:
        reasons.append(uncertain_amplitude(values, covariance))
    reasons.append(impossible(effect.coefficients, values, deviations))
    if is_friction_of_motion(effect):
        reasons.append(describe_driving_friction(model.evidence, placed.axis))
    reasons.append(PartsLeftOut.of(problem).refusal(columns, values))
    given = [reason for reason in reasons if reason]
    each_once = dict.fromkeys(given)
    return finding.left_out_fall, "; ".join(each_once)


def _uncertain_delay(
    finding: Finding, seconds: FloatArray, deviations: FloatArray, gates: Gates
) -> str:
    """Why a delay of a joint fit may not stay;
    empty where it explains much, or is far from zero.
    """
    is_small = finding.explained < gates.explained or finding.error_fall < gates.error_fall
    if not is_small or certain_delays(seconds, deviations).all():
        return ""
    return f"it explains little, and is less than {CERTAIN_DELAY_SIGMAS:g} σ from zero"
