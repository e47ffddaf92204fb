"""Find missing effects: add what the residual calls for, refit everything, and examine the new residual.

`find_effects` is the entry; `ident.discovery.evidence.gather` prepares the rows behind an identification for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.balancer import propose_balancers
from ident.discovery.candidates import ColumnCache, FamilyTrials, SearchProblem, prepare_search, score_candidates
from ident.discovery.choice import choice_covariance, is_small
from ident.discovery.evidence import Evidence, by_instruments, with_effects
from ident.discovery.gates import (
    Gates,
    RunsLeftOut,
    gain_shifts,
    impossible,
    in_noise,
    moved_gains,
    own_unknowns,
    whitened_columns,
    without_effects_of,
)
from ident.discovery.refinement import refine_together
from ident.discovery.resonance import propose_resonances
from ident.discovery.ripple import propose_orders
from ident.discovery.search import (
    EffectKey,
    Finding,
    choose_effect,
    effect_key,
    rank_effects,
    rank_families,
    refine_setting,
)
from ident.discovery.structure import MIN_MOVES_FOR_STRUCTURE, detection_limits_nm, find_structure, is_inadequate
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.position import Counterbalance
from ident.effects.transmission import Ripple
from ident.effects.unnamed import is_unnamed
from ident.errors import EffectRefused, NotConverged, RankDeficient

UNFITTED = (NotConverged, RankDeficient, np.linalg.LinAlgError)
MAX_EFFECTS = 12  #: More effects than this on one robot mean that the declared model is wrong
SHOWN = 0.999  #: Confidence of what instruments show: a dozen effects may ask them in one search
REFINEMENTS = 4  #: Refits of an effect whose settings are fitted; each moves them by a fraction of the one before
PIECES_PER_EFFECT = 3  #: Fewer pieces of moves than this for each effect cannot show that all of them are there


@dataclass(frozen=True, slots=True)
class SetAside:
    """A finding that passed the search, but did not join the model."""

    finding: Finding
    words: str = ""  #: why it did not, `{rival}` in the place of the rival's name
    rival: PlacedEffect | None = None  #: an effect that is kept instead
    moved: tuple[tuple[int, float], ...] = ()  #: gains that it would move: index, and by how many σ

    def reason(self, axes: Sequence[str]) -> str:
        """Why it did not join, in words, with the names of the axes."""
        if self.moved:
            gains = ", ".join(f"the gain of {axes[motor]} by {size:.1f} σ" for motor, size in self.moved)
            return f"it has no name, and would move {gains}"
        return self.words if self.rival is None else self.words.replace("{rival}", self.rival.name_among(axes))


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop: the findings, and the model after it."""

    findings: tuple[Finding, ...]  #: named effects on all axes, the best on held-out moves first
    #: Smooth and periodic terms: on the axis of the best named effect, which must not be much worse than they are, or
    #: on all axes where no named effect passed.
    structures: tuple[Finding, ...]
    limits_nm: FloatArray  #: torque (root mean square) that a detectable effect has at each motor, shape (m,)
    accepted: Finding | None  #: the finding, or the structure without a name, that joined the model; None ends the loop
    after: Evidence  #: the model with it
    set_aside: tuple[SetAside, ...] = ()  #: what would have joined the model, but for runs left out or the joint fit
    ended: str = ""  #: reason why the search ended here although the residual may call for more; else empty
    #: σ of each gain [Nm/A] from the choice of the effects, contained in that of `after`, shape (m,); last turn only.
    choice_std: FloatArray | None = None
    declared: bool = False  #: the cell declares the effect that joined: it was not searched for

    def ranked(self, count: int) -> tuple[Finding, ...]:
        """The best findings on named effects, and the accepted one wherever it ranks."""
        best, added = self.findings[:count], self.accepted
        if added is None or any((one.effect, one.axis) == (added.effect, added.axis) for one in best):
            return best
        return (*best, added)


def find_effects(
    start: Evidence,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] = EFFECTS,
    progress: Callable[[str], None] = lambda _: None,
    axes: Sequence[str] = (),
) -> tuple[Step, ...]:
    """Find effects that the model lacks, add them one by one, and refit everything after each.

    Each turn of the loop:

    1. proposes settings (`propose_orders`, `propose_resonances`) and tests every family on every axis: its columns,
       made from the motion and the predicted load and current, are projected off all declared directions, and the fall
       of the squared residual is measured in-sample and on held-out moves (`rank_effects`);
    2. passes a candidate only through all gates: larger than noise makes anywhere in the search, better on most folds,
       large enough to matter, and physically possible (`Gates`, `impossible`);
    3. chooses the best on held-out moves, the simplest among equals (`choose_effect`), if it does not raise the error
       on runs left out (`RunsLeftOut`);
    4. tests terms without a name, splines and motor harmonics, on the same axis, or on all axes if no named effect
       passed; one that explains much more replaces the named effect (`find_structure`, `is_inadequate`), but not if it
       moves a gain by more than its σ;
    5. refines its setting (`refine_setting`), adds it, and refits gains, parameters and effects together;
    6. asks instruments from the demanded motion whether the effect is a disturbance in the position loop;
    7. linearises the problem around the joint fit and deals whole moves to folds (`prepare_search`); every effect in
       the model must still pass, beside all the others, or it leaves (`without_effects_of`). A term without a name may
       not make a named effect leave: then it does not join.

    What runs left out or a gate of the joint fit refuse is in `Step.set_aside`, and the next best is tried. The
    ambiguity of an accepted effect holds what could not be distinguished from it, passed before, and does not pass
    beside it.

    It ends when nothing passes, at one effect for PIECES_PER_EFFECT pieces, or after MAX_EFFECTS turns. Held-out runs
    take no part in it. The covariance of the last estimate includes the choice of its effects (`choice_covariance`).

    Args:
        start: identified by ``ml``, from `gather`.
        rng: of the bootstrap.
        gates: limits for a candidate.
        families: the dictionary.
        progress: called with a description of each step.
        axes: their names in it; those of the robot's joints when empty.

    Returns:
        the turns taken; the last one has accepted nothing, unless MAX_EFFECTS was reached.
    """
    gates, cache = gates or Gates(), ColumnCache()
    model = _linearised(start, cache)
    names = axes or [joint.name for joint in start.model.robot.places]
    steps: list[Step] = []
    seen = {_keys(start)}
    for _ in range(MAX_EFFECTS):
        step, joined = _turn(model, rng, gates, families, seen, progress, names)
        if steps:
            steps[-1] = _settled(steps[-1], model.search_problem, (*step.findings, *step.structures), rng, gates)
        steps.append(step)
        if joined is None:
            break
        model = joined
        seen.add(_keys(model.evidence))
    else:
        steps[-1] = _settled(steps[-1], model.search_problem, (), rng, gates)
    return (*steps[:-1], _with_choice(steps, model, gates))


def with_declared(
    start: Evidence,
    declared: Sequence[PlacedEffect],
    rng: np.random.Generator,
    progress: Callable[[str], None] = lambda _: None,
    axes: Sequence[str] = (),
) -> tuple[Step, ...]:
    """Add effects that the cell declares, and refit everything with each; settings that are refined are fitted, too.

    Args:
        start: identified by ``ml``, from `gather`, without effects.
        declared: the effects, with the settings to begin with.
        rng: of the bootstrap, for what the findings say; no gate keeps an effect out.
        progress: called with a description of each step.
        axes: their names in it; those of the robot's joints when empty.

    Returns:
        a step an effect; a search that begins with the last one's evidence keeps them.

    Raises:
        EffectRefused: the model contains an effect already, or its coefficients are impossible.
        NotConverged, RankDeficient: see `ident.identify`.
    """
    gates, cache, evidence, steps = Gates(), ColumnCache(), start, list[Step]()
    names = axes or [joint.name for joint in start.model.robot.places]
    for placed in declared:
        name = placed.name_among(names)
        progress(f"fitting the declared {name}")
        joined = with_effects(evidence, (*evidence.effects, placed))
        model = _resettled(_linearised(replace(joined, declared=len(joined.effects)), cache))
        evidence, estimate, last = model.evidence, model.evidence.estimate, model.evidence.effects[-1]
        reduced = without_effects_of(model.search_problem, estimate, (last,))
        problem, columns = reduced.search_problem, reduced.columns
        (trial,) = score_candidates(problem.folds, columns, (slice(0, columns.shape[1]),))
        own = own_unknowns(estimate, (last,))
        wrong = impossible(last.effect.coefficients, estimate.parameters[own], estimate.parameters_std[own])
        if trial is None or wrong:
            raise EffectRefused(f"the declared {name}: {wrong or 'the model contains it already'}")
        (finding,) = rank_families(problem, (FamilyTrials(last.axis, ((last.effect, trial),)),), rng, gates)
        limits_nm = detection_limits_nm(model.search_problem, gates)
        steps.append(Step((), (), limits_nm, finding, evidence, declared=True))
    return tuple(steps)


def _with_choice(steps: Sequence[Step], model: _JointFit, gates: Gates) -> Step:
    """Return the last step, what the choice of its effects adds to the covariance of its estimate included."""
    estimate, accepted = model.evidence.estimate, dict[PlacedEffect, tuple[Finding, tuple[Finding, ...]]]()
    for step in steps:  # an effect that left and joined again counts by its last turn
        found = step.accepted
        if found is not None and (placed := PlacedEffect(found.effect, found.axis)) in model.evidence.effects:
            accepted[placed] = found, (*step.findings, *step.structures)
    last, left = steps[-1], list[Finding]()
    if last.accepted is None:  # its findings are of the last model
        left += [aside.finding for aside in last.set_aside if aside.moved]
        left += [found for found in (*last.findings, *last.structures) if is_small(found, gates)]
    choice = choice_covariance(model.search_problem, estimate, tuple(accepted.values()), left)
    last = replace(last, choice_std=np.sqrt(np.diag(choice)[: len(estimate.gains)]))
    if not choice.any():
        return last
    chosen = replace(estimate, covariance=estimate.covariance + choice)
    return replace(last, after=replace(model.evidence, estimate=chosen))


@dataclass(frozen=True, slots=True)
class _JointFit:
    """A joint fit, and the problem linearised around it."""

    evidence: Evidence
    search_problem: SearchProblem


def _linearised(evidence: Evidence, cache: ColumnCache) -> _JointFit:
    problem = prepare_search(evidence.model, evidence.fit_runs, evidence.training, evidence.estimate, cache)
    return _JointFit(evidence, problem)


def _keys(evidence: Evidence) -> frozenset[EffectKey]:
    return frozenset(effect_key(placed.effect, placed.axis) for placed in evidence.effects)


def _turn(
    model: _JointFit,
    rng: np.random.Generator,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
    seen: set[frozenset[EffectKey]],
    progress: Callable[[str], None],
    names: Sequence[str],
) -> tuple[Step, _JointFit | None]:
    """Take one turn: the step, and the model with what was accepted; None where nothing was."""
    evidence, problem = model.evidence, model.search_problem
    known, moves = len(evidence.effects), problem.folds.moves
    most = problem.folds.linearisation.cluster_count // PIECES_PER_EFFECT
    progress("searching for a missing effect" + (f" beside the {known} found" if known else ""))
    proposed = _proposals(problem, evidence.effects, rng, gates, families)
    present = {placed.effect.name for placed in evidence.effects if not is_unnamed(placed.effect)}
    findings, structures = rank_effects(problem, rng, gates, families, proposed, present), tuple[Finding, ...]()
    limits_nm, runs = detection_limits_nm(problem, gates), RunsLeftOut.of(problem)
    taken, searched, aside, ended = set(_keys(evidence)), range(0), list[SetAside](), ""
    while True:
        named = choose_effect(findings, taken)
        if named is not None and (why := runs.refusal(whitened_columns(problem, named.effect, named.axis))):
            findings = _refused(findings, named, why)
            aside += _first_of_axis(aside, SetAside(named, why))
            continue
        axes = range(problem.axes) if named is None else range(named.axis, named.axis + 1)
        axes = axes if axes.stop <= problem.axes else range(0)  # terms without a name are of driven joints
        if axes != searched:
            if named is None:
                progress("searching for structure that no named effect explains")
            structures, searched = find_structure(problem, axes, rng, gates), axes
        accepted = term = choose_effect(structures, taken)
        if term is not None and (why := runs.refusal(whitened_columns(problem, term.effect, term.axis))):
            structures = _refused(structures, term, why)
            aside += _first_of_axis(aside, SetAside(term, why))
            continue
        if named is not None and (term is None or not is_inadequate(named, term)):
            accepted = named
        if accepted is None or known >= most:
            break
        near = (*proposed.get(accepted.axis, ()), *families)
        effect = refine_setting(problem, accepted.effect, accepted.axis, near)
        accepted = replace(accepted, effect=effect)
        progress(f"adding {effect.name} on {names[accepted.axis]}")
        joined = _join(model, accepted, rng, gates, seen)
        if isinstance(joined, _JointFit):
            accepted = _as_joined(accepted, joined.evidence)
            if named is not None and is_unnamed(effect):
                rival = PlacedEffect(effect, accepted.axis)
                aside.append(SetAside(named, "{rival} explains clearly more of the same residual", rival))
            return Step(findings, structures, limits_nm, accepted, joined.evidence, tuple(aside)), joined
        progress(f"{effect.name} on {names[accepted.axis]} does not join the model: {joined.reason(names)}")
        aside.append(joined)
        # The variables of an axis go together: if its best term may not join, no other term replaces it.
        others = structures if is_unnamed(effect) else ()
        taken |= {effect_key(one.effect, one.axis) for one in (accepted, *others) if one.axis == accepted.axis}
    if accepted is not None:
        pieces = problem.folds.linearisation.cluster_count
        ended = f"{pieces} pieces of {moves} moves allow no more than {most} effects"
    elif moves < MIN_MOVES_FOR_STRUCTURE:
        ended = f"structure without a name needs {MIN_MOVES_FOR_STRUCTURE} moves, found {moves}"
    return Step(findings, structures, limits_nm, None, evidence, tuple(aside), ended), None


def _proposals(
    search_problem: SearchProblem,
    effects: tuple[PlacedEffect, ...],
    rng: np.random.Generator,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
) -> dict[int, tuple[tuple[Effect, ...], ...]]:
    """Families with settings that only the data suggest, by axis, of those that the dictionary holds."""
    kinds = {type(family[0]) for family in families}
    ripples = propose_orders(search_problem, effects, rng, gates) if Ripple in kinds else {}
    resonances = propose_resonances(search_problem, gates, kinds)
    balanced = [placed.axis for placed in effects if isinstance(placed.effect, Counterbalance)]
    balancers = propose_balancers(search_problem, gates, families, balanced)
    found = (ripples, resonances, balancers)
    return {axis: tuple(f for one in found for f in one.get(axis, ())) for axis in {a for one in found for a in one}}


def _first_of_axis(aside: Sequence[SetAside], new: SetAside) -> tuple[SetAside, ...]:
    """Finding that runs left out refuse, unless a better finding of its kind on this axis was set aside before."""
    kind = new.finding.axis, is_unnamed(new.finding.effect)
    return () if kind in {(one.finding.axis, is_unnamed(one.finding.effect)) for one in aside} else (new,)


def _refused(findings: Sequence[Finding], refused: Finding, why: str) -> tuple[Finding, ...]:
    new = replace(refused, passed=False, refusals=(*refused.refusals, why))
    return tuple(new if finding is refused else finding for finding in findings)


def _join(
    model: _JointFit, accepted: Finding, rng: np.random.Generator, gates: Gates, seen: set[frozenset[EffectKey]]
) -> _JointFit | SetAside:
    """Refit with a finding in the model and drop what no longer passes; or say why it may not join."""
    joined = _refit(model, accepted)
    if isinstance(joined, _JointFit):
        accepted = _as_joined(accepted, joined.evidence)
    pruned = joined if isinstance(joined, SetAside) else _pruned(joined, accepted, rng, gates)
    if isinstance(pruned, SetAside):
        return pruned
    if _keys(pruned.evidence) in seen:
        return SetAside(accepted, "it would only exchange places with an effect that it replaces")
    last = PlacedEffect(accepted.effect, accepted.axis)
    why = "" if pruned is joined else _refuted_by_instruments(pruned.evidence, last)
    return SetAside(accepted, why) if why else pruned


def _refit(model: _JointFit, accepted: Finding) -> _JointFit | SetAside:
    """Refit with a finding in the model; or say why it may not join, whatever else is in the model."""
    evidence, problem = model.evidence, model.search_problem
    last, gains_std = PlacedEffect(accepted.effect, accepted.axis), evidence.estimate.gains_std
    if is_unnamed(last.effect):  # before the refit, which takes longer
        torque = whitened_columns(problem, last.effect, last.axis) @ accepted.coefficients
        if moved := moved_gains(gain_shifts(problem.folds, torque), gains_std):
            return SetAside(accepted, moved=moved)
    try:
        refitted = with_effects(evidence, (*evidence.effects, last), problem.runs)
        # Asked here: after it, the linearised problem would take memory beside the instruments.
        if why := _refuted_by_instruments(refitted, last):
            return SetAside(accepted, why)
        joined = _resettled(_linearised(refitted, problem.cache))
    except UNFITTED as error:
        # The linearised problem distinguished the effect from the model, the whole one does not.
        return SetAside(accepted, f"it cannot be fitted: {error}")
    terms = [placed for placed in refitted.effects if is_unnamed(placed.effect)]
    if last in terms:  # no setting of theirs is refined
        together = without_effects_of(joined.search_problem, refitted.estimate, terms)
        if moved := moved_gains(together.gain_shifts, gains_std):
            return SetAside(accepted, moved=moved)
    return joined


def _resettled(model: _JointFit) -> _JointFit:
    """Refine the settings of the last effect around the joint fit and refit, until they stay as they are.

    The model without an effect may be far off, and the settings that fit its residual best with it.
    """
    for _ in range(REFINEMENTS):
        evidence, last = model.evidence, model.evidence.effects[-1]
        if not last.effect.refined:
            break
        reduced = without_effects_of(model.search_problem, evidence.estimate, (last,))
        effect = refine_together(reduced.search_problem, last.effect, last.axis)
        if effect == last.effect:
            break
        others = evidence.effects[:-1]
        refitted = with_effects(evidence, (*others, PlacedEffect(effect, last.axis)), model.search_problem.runs)
        model = _linearised(refitted, model.search_problem.cache)
    return model


def _as_joined(accepted: Finding, evidence: Evidence) -> Finding:
    """A finding with the settings that its effect has in a joint fit."""
    key = effect_key(accepted.effect, accepted.axis)
    found = (placed.effect for placed in evidence.effects if effect_key(placed.effect, placed.axis) == key)
    return replace(accepted, effect=next(found, accepted.effect))


def _refuted_by_instruments(evidence: Evidence, placed: PlacedEffect) -> str:
    """Why an effect of a joint fit may be a disturbance in the position loop alone; empty where it may not.

    A torque that disturbs the arm moves it, and comes back in the current: columns of the recorded motion then explain
    a part of it, which those of the demanded motion do not. Their coefficients may be zero, and are nearer to zero than
    to those of the fit. Instruments that would not show an effect of that size refute no named one; nor do those by
    which nothing can be fitted.
    """
    try:
        estimate = by_instruments(evidence)
    except UNFITTED:
        return ""
    if estimate is None:
        return ""
    own = own_unknowns(estimate, (placed,))
    place, values, fitted = len(estimate.gains) + own, estimate.parameters[own], evidence.estimate.parameters[own]
    covariance = estimate.covariance[np.ix_(place, place)]
    if not (why := in_noise(values, covariance, SHOWN)):
        return ""
    precision = np.linalg.pinv(covariance, hermitian=True)
    nearer = float(fitted @ precision @ (fitted - 2.0 * values)) > 0.0  # |values − fitted|² > |values|²
    if not is_unnamed(placed.effect) and (not nearer or in_noise(fitted, covariance)):
        return ""
    return f"with instruments from the demanded motion, {why}"


def _pruned(model: _JointFit, accepted: Finding, rng: np.random.Generator, gates: Gates) -> _JointFit | SetAside:
    """Drop effects that no longer pass beside the last one; or say why the last one may not stay."""
    last = model.evidence.effects[-1]
    needed: set[PlacedEffect] = set()
    while True:
        evidence = model.evidence
        judged = [
            (placed, *_beside_others(model, placed, rng, gates)) for placed in evidence.effects[evidence.declared :]
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
            model = _linearised(rest, model.search_problem.cache)
        except UNFITTED:
            needed.add(worst)  # the data cannot be fitted without it


def _beside_others(model: _JointFit, placed: PlacedEffect, rng: np.random.Generator, gates: Gates) -> tuple[float, str]:
    """Judge an effect of a joint fit beside all others: fall of ‖e‖² on held-out moves, and why it does not pass."""
    estimate = model.evidence.estimate
    reduced = without_effects_of(model.search_problem, estimate, (placed,))
    problem, columns = reduced.search_problem, reduced.columns
    (trial,) = score_candidates(problem.folds, columns, (slice(0, columns.shape[1]),))
    if trial is None:
        return 0.0, "the model contains it already"
    (finding,) = rank_families(problem, (FamilyTrials(placed.axis, ((placed.effect, trial),)),), rng, gates)
    own = own_unknowns(estimate, (placed,))
    values, place = estimate.parameters[own], len(estimate.gains) + own
    joint = in_noise(values, estimate.covariance[np.ix_(place, place)])
    physics = impossible(placed.effect.coefficients, values, estimate.parameters_std[own])
    reasons = (*finding.refusals, joint, physics, RunsLeftOut.of(problem).refusal(columns))
    return finding.held_out_fall, "; ".join(dict.fromkeys(reason for reason in reasons if reason))


def _settled(
    step: Step, problem: SearchProblem, tested: Sequence[Finding], rng: np.random.Generator, gates: Gates
) -> Step:
    """Limit the ambiguity of an accepted effect to rivals that passed before it joined and no longer do.

    Args:
        step: with what was accepted.
        problem: linearised with it in the model.
        tested: on that problem; rivals that are not among them are tested here.
        rng: of the bootstrap.
        gates: limits.
    """
    if step.accepted is None:
        return step
    own = effect_key(step.accepted.effect, step.accepted.axis)
    passed = {(one.effect, one.axis) for one in (*step.findings, *step.structures) if one.passed}
    rivals = {
        effect_key(one.effect, one.axis): one for one in step.accepted.ambiguity if (one.effect, one.axis) in passed
    }
    now = {effect_key(one.effect, one.axis): one.passed for one in tested}
    missing = [one for key, one in rivals.items() if key not in now]
    again = [trial for one in missing for trial in problem.test(((one.effect,),), one.axis)]
    now |= {effect_key(one.effect, one.axis): one.passed for one in rank_families(problem, again, rng, gates)}
    left = tuple(one for key, one in rivals.items() if key != own and not now.get(key, False))
    return replace(step, accepted=replace(step.accepted, ambiguity=left))
