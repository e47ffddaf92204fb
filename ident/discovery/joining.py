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
from ident.discovery.braking import describe_driving_friction
from ident.discovery.candidates import (
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
from ident.effects.friction import PositionFriction, SpeedFriction
from ident.effects.geometry_corrections import LatePosition, is_correction
from ident.effects.signals import Abscissa
from ident.effects.unnamed import is_unnamed
from ident.errors import NotConverged, RankDeficient
from ident.estimators.estimate import Estimate

UNFITTED = (NotConverged, RankDeficient, np.linalg.LinAlgError)
SHOWN = 0.999  #: Confidence of what instruments show: a dozen effects may ask them in one search
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
    is_same = all(
        one is other for one, other in zip(evidence.datasets, before.evidence.datasets, strict=True)
    )
    return linearised(evidence, before.search_problem.cache if is_same else ColumnCache())


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
    """
    joined = _refit(model, accepted)
    if isinstance(joined, JointFit):
        accepted = as_joined(accepted, joined.evidence)
    pruned = joined if isinstance(joined, SetAside) else _pruned(joined, accepted, rng, gates)
    if isinstance(pruned, SetAside):
        return pruned
    if keys_of(pruned.evidence) in seen:
        return SetAside(accepted, "it would only exchange places with an effect that it replaces")
    last = accepted.placed
    if pruned is joined:
        why = ""
    else:
        why = refuted_by_instruments(pruned.evidence, last)
    why = why or refuted_clear_of_stops(pruned.evidence, last)
    return SetAside(accepted, why) if why else pruned


def refuted_clear_of_stops(evidence: Evidence, placed: PlacedEffect) -> str:
    """Why an effect of a joint fit may be friction of joints at rest alone; empty where it may not.

    In rows that are clear of stops it is then nearer to zero than to the fit. Rows that would not
    show an effect of that size refute nothing.
    """
    if not turns_with_motion(placed.effect):
        return ""
    try:
        clear = fitted_clear_of_stops(evidence)
    except UNFITTED:
        return ""
    why = _contradicted_by(clear, evidence, placed)
    return f"in rows that are clear of stops, {why}" if why else ""


def refuted_by_structure(
    model: JointFit, found: Finding, aside: Sequence[SetAside]
) -> SetAside | None:
    """Why a name may not join: structure on its axis explains clearly more,
    was set aside as it bends a gain, and the name bends one, too.

    The name is then only similar to the truth. It does no harm where it bends no gain, and is no
    mistake where it still lowers the error beside the structure: then it explains something else. A
    term against the time, or the session, refutes nothing where no run can be left out: it can
    separate the loaded runs from the others.
    """
    if is_unnamed(found.effect):
        return None
    problem = model.search_problem
    folds = model.search_problem.folds
    unsure = () if runs_to_leave_out(problem.observation) else (Abscissa.TIME, Abscissa.SESSION)
    before = float(folds.square_sum(folds.residual).sum())
    for term in (one.finding for one in aside if one.moved and is_unnamed(one.finding.effect)):
        if term.axis != found.axis or term.effect.abscissa in unsure:
            continue
        own, free = (whitened_columns(problem, one.effect, one.axis) for one in (found, term))
        parts = slice(0, own.shape[1]), slice(own.shape[1], None), slice(None)
        by_name, by_term, by_both = score_candidates(folds, np.hstack((own, free)), parts)
        if by_name is None or by_term is None or by_both is None:
            continue
        left = by_name.left_out.sum(axis=1)
        beside = by_both.left_out.sum(axis=1)
        again = replace(
            found,
            coefficients=by_name.coefficients,
            fold_errors=left,
            left_out_fall=before - float(left.sum()),
        )
        adds_to_term = is_better(beside, by_term.left_out.sum(axis=1))
        if not adds_to_term and is_inadequate(again, term) and (moved := _moved_by(model, again)):
            return SetAside(found, "{rival} explains clearly more", term.placed, moved)
    return None


def _refit(model: JointFit, accepted: Finding) -> JointFit | SetAside:
    """Refit with a finding in the model;
    or say why it may not join, whatever else is in the model.
    """
    evidence = model.evidence
    problem = model.search_problem
    last = accepted.placed
    # Asked before the refit, which takes longer.
    if is_unnamed(last.effect) and (moved := _moved_by(model, accepted)):
        return SetAside(accepted, moved=moved)
    try:
        first_order = with_first_order_effects(evidence, (*evidence.effects, last), problem.runs)
        # Asked here: after it, the linearised problem would take memory beside the instruments.
        if why := refuted_by_instruments(first_order, last):
            return SetAside(accepted, why)
        refitted = settled_corrections(first_order)
        if refitted is not first_order and (why := refuted_by_instruments(refitted, last)):
            return SetAside(accepted, why)
        joined = linearised_after(refitted, model)
        if is_correction(last):
            joined = _all_resettled(joined)
        else:
            joined = resettled(joined)
    except UNFITTED as error:
        # The linearised problem distinguished the effect from the model, the whole one does not.
        return SetAside(accepted, f"it cannot be fitted: {error}")
    terms = [placed for placed in refitted.effects if is_unnamed(placed.effect)]
    if last in terms:  # no setting of theirs is refined
        together = without_effects_of(joined.search_problem, refitted.estimate, terms)
        if moved := moved_gains(together.gain_shifts, evidence.estimate.gains_std):
            return SetAside(accepted, moved=moved)
    return joined


def _moved_by(model: JointFit, found: Finding) -> tuple[tuple[int, float], ...]:
    """Index of each gain that a finding would move by more than its σ, to first order,
    and by how many σ.
    """
    problem = model.search_problem
    torque = whitened_columns(problem, found.effect, found.axis) @ found.coefficients
    return moved_gains(gain_shifts(problem.folds, torque), model.evidence.estimate.gains_std)


def resettled(model: JointFit, index: int = -1) -> JointFit:
    """Refine the settings of an effect around the joint fit and refit, until they stay as they are.

    The model without an effect may be far off, and the settings that fit its residual best with it.

    Args:
        model: the joint fit.
        index: place of the effect among those of the model.
    """
    for _ in range(REFINEMENTS):
        evidence = model.evidence
        placed = evidence.effects[index]
        effect = _refined_in(model, placed)
        if effect == placed.effect:
            break
        effects = list(evidence.effects)
        effects[index] = replace(placed, effect=effect)
        refitted = with_effects(evidence, tuple(effects), model.search_problem.runs)
        model = linearised_after(replace(refitted, declared=evidence.declared), model)
    return model


def _all_resettled(model: JointFit) -> JointFit:
    """Refine the settings of every effect, which were those of another geometry."""
    for index in range(len(model.evidence.effects)):
        model = resettled(model, index)
    return model


def _refined_in(model: JointFit, placed: PlacedEffect) -> Effect:
    """Return an effect of a joint fit with the settings that are fitted refined around it."""
    effect = placed.effect
    axis = placed.axis
    estimate = model.evidence.estimate
    if effect.fits_rotor:
        own = own_unknowns(estimate, (placed,))
        fitted = estimate.parameters[own], estimate.parameters_std[own]
        return with_refined_rotor(model.search_problem, effect, axis, *fitted)
    if effect.refined:
        reduced = without_effects_of(model.search_problem, estimate, (placed,))
        return refine_together(reduced.search_problem, effect, axis)
    return effect


def as_joined(accepted: Finding, evidence: Evidence) -> Finding:
    """A finding with the settings that its effect has in a joint fit."""
    key = effect_key(accepted.effect, accepted.axis)
    found = (
        placed.effect
        for placed in evidence.effects
        if effect_key(placed.effect, placed.axis) == key
    )
    return replace(accepted, effect=next(found, accepted.effect))


def refuted_by_instruments(evidence: Evidence, placed: PlacedEffect) -> str:
    """Why an effect of a joint fit may be a disturbance in the position loop alone;
    empty where it may not.

    A torque that disturbs the arm moves it, and comes back in the current: columns of the recorded
    motion then explain a part of it, which those of the demanded motion do not. What the columns
    explain is then nearer to zero by instruments than to the fit: it may be zero, or it is another
    number than that of the fit. Instruments that would not show an effect of that size refute no
    named one; nor do those by which nothing can be fitted.
    """
    try:
        estimate = by_instruments(evidence)
    except UNFITTED:
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
    place = len(other.gains) + own
    values = values_of(other, own)
    fitted = values_of(evidence.estimate, own)
    return _contradiction(placed, values, fitted, other.covariance[np.ix_(place, place)])


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
    may_be_zero = in_noise(values, covariance, SHOWN)
    if may_be_zero and is_unnamed(placed.effect):
        return may_be_zero
    precision = np.linalg.pinv(covariance, hermitian=True)
    # |values − fitted|² > |values|²
    is_nearer_to_zero = float(fitted @ precision @ (fitted - 2.0 * values)) > 0.0
    if not is_nearer_to_zero:
        return ""
    if may_be_zero:
        would_be_seen = not in_noise(fitted, covariance)
        return may_be_zero if would_be_seen else ""
    differs = not in_noise(fitted - values, covariance, SHOWN)
    return _sizes_text(placed, values, fitted) if differs else ""


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
    needed: set[PlacedEffect] = set()
    while True:
        evidence = model.evidence
        judged = [
            (placed, *beside_others(model, placed, rng, gates))
            for placed in evidence.effects[evidence.declared :]
        ]
        failing = [one for one in judged if one[2] and one[0] not in needed]
        if not failing:
            return model
        named = next((placed for placed, _, _ in failing if not is_unnamed(placed.effect)), None)
        if is_unnamed(last.effect) and named is not None:
            return SetAside(accepted, "{rival} would no longer pass beside it", named)
        worst, _, why = min(failing, key=lambda one: one[1])
        if worst == last:
            return SetAside(accepted, f"in the joint fit it no longer passes: {why}")
        try:
            kept = tuple(placed for placed in evidence.effects if placed != worst)
            rest = with_effects(evidence, kept, model.search_problem.runs)
            model = linearised_after(rest, model)
        except UNFITTED:
            needed.add(worst)  # the data cannot be fitted without it


def beside_others(
    model: JointFit, placed: PlacedEffect, rng: np.random.Generator, gates: Gates
) -> tuple[float, str]:
    """Judge an effect of a joint fit beside all others:
    fall of ‖e‖² on left-out moves, and why it does not pass.
    """
    is_delay = isinstance(placed.effect, Delay | LatePosition)
    limits = gates
    if is_delay:
        # A delay is judged by its length: beside dry friction it is a small part of a motor's
        # residual.
        limits = replace(gates, explained=0.0, error_fall=0.0)
    estimate = model.evidence.estimate
    reduced = without_effects_of(model.search_problem, estimate, (placed,))
    problem = reduced.search_problem
    columns = reduced.columns
    forms = placed.effect.forms
    trials = score_candidates(
        problem.folds, columns, [slice(len(form.coefficients)) for form in forms]
    )
    members = tuple(
        (form, trial) for form, trial in zip(forms, trials, strict=True) if trial is not None
    )
    if not members:
        return 0.0, "the model contains it already"
    (finding,) = rank_families(problem, (FamilyTrials(placed.axis, members),), rng, limits)
    own = own_unknowns(estimate, (placed,))
    values = values_of(estimate, own)
    place = len(estimate.gains) + own
    joint = in_noise(values, estimate.covariance[np.ix_(place, place)])
    deviations = estimate.parameters_std[own]
    amplitude = ""
    if placed.effect.reported is Reported.AMPLITUDE:
        amplitude = uncertain_amplitude(values, estimate.covariance[np.ix_(place, place)])
    uncertain = ""
    if is_delay:
        uncertain = _uncertain_delay(finding, values, deviations, gates)
    physics = impossible(placed.effect.coefficients, values, deviations)
    if isinstance(placed.effect, SpeedFriction | PositionFriction):
        drives = describe_driving_friction(model.evidence, placed.axis)
    else:
        drives = ""
    reasons = (
        *finding.refusals,
        joint,
        uncertain,
        amplitude,
        physics,
        drives,
        PartsLeftOut.of(problem).refusal(columns),
    )
    return finding.left_out_fall, "; ".join(dict.fromkeys(reason for reason in reasons if reason))


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
