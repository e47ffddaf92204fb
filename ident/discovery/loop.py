"""Find missing effects: add what the residual calls for, refit all, and examine the new residual.

`find_effects` is the entry; `ident.discovery.evidence.gather` prepares the rows behind an
identification for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ident.arrays import FloatArray, require_entries, require_kind, require_progress, takes
from ident.discovery.balancer import propose_balancers
from ident.discovery.cables import propose_cables
from ident.discovery.candidates import ColumnCache, FamilyTrials, SearchProblem
from ident.discovery.choice import choice_covariance, is_small, scored_beside
from ident.discovery.effect_verdict import EffectVerdict
from ident.discovery.evidence import Evidence, place_names, with_estimate
from ident.discovery.gates import (
    Gates,
    PartsLeftOut,
    covariance_of,
    impossible,
    in_noise,
    own_unknowns,
    possible_values,
    probability_of_zero,
    require_gates,
    values_of,
    whitened_columns,
)
from ident.discovery.geometry_check import CLOCK, check_geometry
from ident.discovery.joining import (
    FIT_ERRORS,
    JointFit,
    SetAside,
    join,
    judge_beside_others,
    keys_of,
    linearised,
    refitted_with,
    refuted_by_structure,
    with_joint_settings,
)
from ident.discovery.known_mistakes import JoinedMistakes, join_mistakes
from ident.discovery.own_settings import propose_own_settings
from ident.discovery.resonance import gears_around, propose_resonances, refined_gear
from ident.discovery.ripple import propose_orders
from ident.discovery.rotor_search import propose_losses_without_rotor
from ident.discovery.search import (
    Finding,
    choose_effect,
    rank_effects,
    rank_families,
    refine_setting,
)
from ident.discovery.structure import (
    MIN_MOVES_FOR_STRUCTURE,
    detection_limits_nm,
    find_structure,
    is_inadequate,
)
from ident.effects.dictionary import GEOMETRY
from ident.effects.effect import Effect, EffectKey, PlacedEffect, effect_key
from ident.effects.own import families_of, search_families
from ident.effects.position import Counterbalance
from ident.effects.transmission import Ripple
from ident.effects.unnamed import is_unnamed
from ident.errors import TooFewMoves

MAX_EFFECTS = 12  #: More effects than this on one robot mean that the declared model is wrong
#: Fewer pieces of moves than this for each effect cannot show that all of them are there
PIECES_PER_EFFECT = 3


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop: the findings, and the model after it."""

    findings: tuple[Finding, ...]  #: named effects on all axes, the best on left-out moves first
    #: Smooth and periodic terms: on the axis of the best named effect, which must not be much worse
    #: than they are, or on all axes where no named effect passed.
    structures: tuple[Finding, ...]
    #: torque (root mean square) that a detectable effect has at each motor, shape (m,)
    limits_nm: FloatArray
    #: the finding, or the structure without a name, that joined the model; None ends the loop
    accepted: Finding | None
    after: Evidence  #: the model with it
    #: what would have joined the model, but for parts left out or the joint fit
    set_aside: tuple[SetAside, ...] = ()
    #: Reason why the search ended here although the residual may call for more. Empty in every
    #: other turn, the last one too, where nothing more has passed the gates.
    ended: str = ""
    #: σ of each gain [Nm/A] from the choice of the effects, contained in that of `after`, shape
    #: (m,); last turn only.
    choice_std: FloatArray | None = None
    declared: bool = False  #: the cell declares the effect that joined: it was not searched for
    #: of held-out runs on each effect that was found; last turn only
    verdicts: tuple[EffectVerdict, ...] = ()
    #: Effects that left although nothing refutes them, and so may be true: σ contains what they
    #: would move. Last turn only.
    left_open: tuple[PlacedEffect, ...] = ()

    def ranked(self, count: int) -> tuple[Finding, ...]:
        """The best findings on named effects, and the accepted one wherever it ranks."""
        best = self.findings[:count]
        added = self.accepted
        if added is None:
            return best
        listed = {effect_key(one.effect, one.axis) for one in best}
        if effect_key(added.effect, added.axis) in listed:
            return best
        return (*best, added)


@takes(
    start=Evidence,
    rng=np.random.Generator,
    gates=Gates | None,
    axes=Sequence,
    own_effects=Sequence,
)
def find_effects(
    start: Evidence,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] | None = None,
    progress: Callable[[str], None] | None = None,
    axes: Sequence[str] = (),
    geometry: tuple[tuple[Effect, ...], ...] | None = None,
    mistakes: Sequence[Finding] | None = None,
    own_effects: Sequence[Effect] = (),
) -> tuple[Step, ...]:
    """Find effects that the model lacks, add them one by one, and refit everything after each.

    Mistakes of the description that a check names join first (`check_geometry`, `join_mistakes`).
    Where the check names a delay, it is made again after the search, and what it names then joins
    if it passes. What is named then and does not join is set aside in the last turn. Each turn of
    the loop:

    1. proposes settings (`propose_orders`, `propose_resonances`) and tests every family on every
       axis: its columns, made from the motion and the predicted load and current, are projected off
       all declared directions, and the fall of the squared residual is measured in-sample and on
       left-out moves (`rank_effects`);
    2. passes a candidate only through all gates: larger than noise makes anywhere in the search,
       better on most folds, large enough to matter, and physically possible (`Gates`,
       `impossible`);
    3. chooses the best on left-out moves, the simplest among equals (`choose_effect`), if it lowers
       the error on runs or regions of the workspace left out, and raises it there on no motor
       (`PartsLeftOut`);
    4. tests terms without a name, splines and motor harmonics, on the same axis, or on all axes if
       no named effect passed; one that explains much more replaces the named effect
       (`find_structure`, `is_inadequate`). A term that moves a gain by more than its σ does not
       join; the name that it refutes then joins only if it moves none either
       (`refuted_by_structure`);
    5. refines its setting (`refine_setting`), adds it, and refits gains, parameters and effects
       together;
    6. asks instruments from the demanded motion whether the effect is a disturbance in the position
       loop;
    7. linearises the problem around the joint fit and deals whole moves to folds
       (`prepare_search`); every effect in the model must still pass, beside all the others, or it
       leaves (`without_effects_of`). A term without a name may not make a named effect leave: then
       it does not join;
    8. asks whether what turns with the motion passes in rows that are clear of stops, too
       (`refuted_clear_of_stops`).

    What parts left out or a gate of the joint fit refuse is in `Step.set_aside`, and the next best
    is tried. The ambiguity of an accepted effect holds what could not be distinguished from it,
    passed before, and does not pass beside it.

    It ends when nothing passes, at one effect for PIECES_PER_EFFECT pieces, or after MAX_EFFECTS
    turns. The covariance of the last estimate includes the choice of its effects in the σ of gains
    and parameters (`choice_covariance`). An effect that its own σ does not show leaves
    (`end_search`). Held-out runs take no part in it: `ident.discovery.acceptance` judges by them.

    Args:
        start: identified by ``ml``, from `gather`.
        rng: of the bootstrap.
        gates: limits for a candidate.
        families: that are tried, the members of each with the settings to begin with; when None,
            the dictionary and those of installed packages.
        progress: called with a description of each step.
        axes: their names in it; those of the robot's joints when empty.
        geometry: the part of the dictionary that corrects the description of the robot; when None,
            all of it.
        mistakes: that the check has named beside this start; when None, and there is a geometry, it
            is made here.
        own_effects: effects that no installed package has, tried beside the families; several of
            one name are one family. They take the place of installed ones of the same name.

    Returns:
        the turns taken, one of each mistake that has joined among them; the last one has accepted
        nothing, unless MAX_EFFECTS was reached.

    Raises:
        EffectRefused: an effect of another package cannot be used.
        TooFewMoves: there are too few moves to leave some out.
    """
    gates = gates or Gates()
    require_gates(gates)
    if mistakes is not None:
        remedy = "leave it out: the check is made here then"
        require_kind("mistakes", mistakes, Sequence, remedy)
        require_entries("mistakes", mistakes, Finding, remedy)
    for name, given in {"families": families, "geometry": geometry}.items():
        if given is not None:
            _require_families(name, given)
    if progress is None:
        progress = _ignore
    require_progress(progress)
    if geometry is None:
        geometry = GEOMETRY
    if families is None:
        families = search_families(own_effects)
    else:
        families = (*families, *families_of(own_effects, "`own_effects`"))
    names = place_names(start.model, axes)
    steps: list[Step] = []
    if mistakes is None and geometry:
        mistakes = _named_mistakes(start, rng, gates, own_effects)
    if mistakes is None:
        mistakes = ()
    corrections = [found for found in mistakes if not isinstance(found.effect, CLOCK)]
    delays = [found for found in mistakes if isinstance(found.effect, CLOCK)]
    corrected = start
    aside: list[SetAside] = []
    if corrections:
        progress("adding what the check of the description has named")
        steps, corrected, refused = _corrected(start, mistakes, corrections, rng, gates)
        aside += refused
    seen = {keys_of(start), keys_of(corrected)}

    def search(start: Evidence, most: int) -> tuple[list[Step], JointFit]:
        return _searched(start, most, rng, gates, (*geometry, *families), seen, progress, names)

    found, model = search(corrected, MAX_EFFECTS)
    if delays and found[-1].accepted is None:
        progress("testing the clock beside what was found")
        named = _named_mistakes(model.evidence, rng, gates, own_effects)
        late = join_mistakes(model, named, rng, gates)
        aside += late.set_aside
        if late.joined:
            *found, last = found  # a turn that has found nothing is the last one of all
            found += _steps_of(late, late.joined, last.limits_nm)
            seen.add(keys_of(late.model.evidence))
            further, model = search(late.model.evidence, MAX_EFFECTS - len(found))
            found += further
    steps += found
    last = end_search(steps, model, gates, rng=rng)
    not_joined = [one for one in aside if one.finding.placed not in last.after.effects]
    return (*steps[:-1], replace(last, set_aside=(*not_joined, *last.set_aside)))


def _require_families(name: str, families: object) -> None:
    """Refuse what is no sequence of families, each a sequence of effects, as a `ModelError`."""
    remedy = f"leave it out, or write {name}=((effect,),)"
    require_kind(name, families, Sequence, remedy)
    require_entries(name, families, Sequence, remedy)
    for family in families:  # type: ignore[attr-defined]
        require_entries(f"a family of {name}", family, Effect, remedy)


def _corrected(
    start: Evidence,
    mistakes: Sequence[Finding],
    corrections: Sequence[Finding],
    rng: np.random.Generator,
    gates: Gates,
) -> tuple[list[Step], Evidence, tuple[SetAside, ...]]:
    """Join corrections of the description.

    The linearised problem ends here: it is large, and the search makes its own.

    Returns:
        a turn for each that joins, the model with them, and what does not join.
    """
    model = linearised(start, ColumnCache())
    joined = join_mistakes(model, corrections, rng, gates)
    limits_nm = detection_limits_nm(model.search_problem, gates)
    steps = _steps_of(joined, mistakes, limits_nm)
    return steps, joined.model.evidence, joined.set_aside


def _searched(
    start: Evidence,
    most: int,
    rng: np.random.Generator,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
    seen: set[frozenset[EffectKey]],
    progress: Callable[[str], None],
    names: Sequence[str],
) -> tuple[list[Step], JointFit]:
    """Take turns until one finds nothing, at most so many and at least one.

    Returns:
        the turns, and the model behind them.
    """
    model = linearised(start, ColumnCache())
    steps: list[Step] = []
    for _ in range(max(most, 1)):
        step, joined = _turn(model, rng, gates, families, seen, progress, names)
        if steps:
            tested = (*step.findings, *step.structures)
            steps[-1] = _settled(steps[-1], model.search_problem, tested, rng, gates)
        steps.append(step)
        if joined is None:
            break
        model = joined
        seen.add(keys_of(model.evidence))
    else:
        steps[-1] = _settled(steps[-1], model.search_problem, (), rng, gates)
    return steps, model


def _ignore(_line: str) -> None:
    """Take a line of progress where none is wanted."""


def _named_mistakes(
    start: Evidence, rng: np.random.Generator, gates: Gates, own_effects: Sequence[Effect]
) -> tuple[Finding, ...]:
    """Mistakes of description and clock that their check is certain of; none with too few moves."""
    (own,) = rng.spawn(1)  # the draws of the search stay what they are
    try:
        return check_geometry(start, own, gates, own_effects).certain_mistakes
    except TooFewMoves:
        return ()


def _steps_of(
    corrected: JoinedMistakes, mistakes: Sequence[Finding], limits_nm: FloatArray
) -> list[Step]:
    """A turn for each mistake that has joined.

    It has no rivals: the check has compared it with all of them.
    """
    steps: list[Step] = []
    for found, after in zip(corrected.joined, corrected.models, strict=True):
        accepted = replace(found, ambiguity=())
        steps.append(Step(tuple(mistakes), (), limits_nm, accepted, after))
    return steps


def end_search(
    steps: Sequence[Step],
    model: JointFit,
    gates: Gates,
    *,
    rng: np.random.Generator,
    left_open: Sequence[PlacedEffect] = (),
) -> Step:
    """Return the last step with the σ that is reported, and the effects that pass in this model.

    An effect leaves where its coefficients may all be zero by the covariance that is reported, none
    is larger than its own σ, or one of them is impossible. An effect that has passed beside another
    one must pass without it, too: after each that leaves, the rest is fitted again, and passes the
    gates of a joint fit again (`judge_beside_others`). Instruments, rows clear of stops and terms
    without a name are not asked again: instruments take as long as a fit. The worst leaves first.
    An effect that leaves here is not refuted by it, so that σ contains what it would move.

    The choice of the effects adds to the σ of gains and parameters, not to that of an effect's own
    coefficients: another model has no such coefficient.

    Of what stays, a coefficient that is a little outside its possible values is held at the nearest
    one.

    Args:
        steps: of the search; the last one is returned.
        model: what it ended with.
        gates: limits of the search.
        rng: of the bootstrap.
        left_open: effects that have left already, and may be true.
    """
    aside: list[SetAside] = []
    needed: set[PlacedEffect] = set()
    opened = list(left_open)
    while True:
        last = _with_choice(steps, model, gates, opened)
        failing = _unshown(last.after)
        by_what = "by the σ that is reported"
        if not failing and model.evidence.effects != steps[-1].after.effects:
            failing = _failing_again(model, rng, gates)
            by_what = "without what has left"
        failing = [one for one in failing if one[0] not in needed]
        if not failing:
            return replace(
                last,
                after=with_possible_values(last.after),
                set_aside=(*last.set_aside, *aside),
                left_open=tuple(opened),
            )
        worst, why, _ = max(failing, key=lambda one: one[2])
        others = tuple(placed for placed in model.evidence.effects if placed != worst)
        try:
            model = refitted_with(model, others)
        except FIT_ERRORS:
            needed.add(worst)  # the data cannot be fitted without it
            continue
        opened.append(worst)
        found = _finding_of(steps, worst)
        if found is not None:
            aside.append(SetAside(found, f"{by_what}, {why}"))


def _unshown(evidence: Evidence) -> list[tuple[PlacedEffect, str, float]]:
    """Effects that the covariance of an estimate does not show, why, and their chance to be zero.

    What the cell declares stays. An impossible coefficient counts like one that is certainly zero.
    """
    estimate = evidence.estimate
    failing: list[tuple[PlacedEffect, str, float]] = []
    for placed in evidence.effects[evidence.declared :]:
        own = own_unknowns(estimate, (placed,))
        values = values_of(estimate, own)
        covariance = covariance_of(estimate, own)
        std = estimate.parameters_std[own]
        wrong = impossible(placed.effect.coefficients, values, std)
        # What is not possible shows nothing: a part below zero must not carry the other one.
        shown = possible_values(placed.effect.coefficients, values, covariance)
        noise = in_noise(shown, covariance)
        is_any_known = np.any(np.abs(shown) >= std)
        if not noise and not is_unnamed(placed.effect) and not is_any_known:
            noise = (
                "each of its coefficients is less than its σ: what they are together is not known"
            )
        if wrong:
            failing.append((placed, wrong, 1.0))
        elif noise:
            chance = probability_of_zero(shown, covariance)
            failing.append((placed, noise, chance))
    return failing


def _failing_again(
    model: JointFit, rng: np.random.Generator, gates: Gates
) -> list[tuple[PlacedEffect, str, float]]:
    """Effects that do not pass a joint fit's gates, why, and how much worse left-out moves are."""
    evidence = model.evidence
    failing: list[tuple[PlacedEffect, str, float]] = []
    for placed in evidence.effects[evidence.declared :]:
        fall, why = judge_beside_others(model, placed, rng, gates)
        if why:
            failing.append((placed, why, -fall))
    return failing


def with_possible_values(evidence: Evidence) -> Evidence:
    """Hold coefficients of the effects that are not declared at the nearest possible value.

    They were outside by less than their noise. Everything else moves with them, to first order; σ
    stays what it is.
    """
    estimate = evidence.estimate
    own = own_unknowns(estimate, evidence.effects[evidence.declared :])
    if not len(own):
        return evidence
    count = len(estimate.gains)
    of_effects = count + own
    others = np.setdiff1d(np.arange(len(estimate.covariance)), of_effects)
    order = np.concatenate((of_effects, others))
    values = np.concatenate((estimate.gains, estimate.parameters))
    about = np.array([column.about for column in estimate.unknowns])
    values[count:] += about
    columns = [estimate.unknowns[index] for index in own]
    covariance = estimate.covariance[np.ix_(order, order)]
    moved = possible_values(columns, values[order], covariance)
    if np.array_equal(moved, values[order]):
        return evidence
    values[order] = moved
    held = replace(estimate, gains=values[:count], parameters=values[count:] - about)
    return with_estimate(evidence, held)


def _finding_of(steps: Sequence[Step], placed: PlacedEffect) -> Finding | None:
    """The finding by which an effect joined last."""
    for step in reversed(steps):
        found = step.accepted
        if found is not None and found.placed == placed:
            return found
    return None


def _with_choice(
    steps: Sequence[Step], model: JointFit, gates: Gates, left_open: Sequence[PlacedEffect]
) -> Step:
    """Return the last step, with the covariance from the choice of its effects in its estimate."""
    estimate = model.evidence.estimate
    in_model = model.evidence.effects
    of_effects: dict[PlacedEffect, tuple[Finding, tuple[Finding, ...]]] = {}
    for step in steps:  # an effect that left and joined again counts by its last turn
        found = step.accepted
        if found is not None and found.placed in in_model:
            of_effects[found.placed] = found, (*step.findings, *step.structures)
    last = steps[-1]
    left = _small_findings(last, model, gates)
    accepted = tuple(of_effects.values())
    choice = choice_covariance(model.search_problem, estimate, accepted, left, left_open)
    # The coefficient of an effect is that of a model with the effect: another model has none, not
    # another one.
    gains = len(estimate.gains)
    own = gains + own_unknowns(estimate, in_model)
    choice[own, :] = 0.0
    choice[:, own] = 0.0
    choice_std = np.sqrt(np.diag(choice)[:gains])
    last = replace(last, after=model.evidence, choice_std=choice_std)
    if not choice.any():
        return last
    chosen = replace(estimate, covariance=estimate.covariance + choice)
    return replace(last, after=replace(model.evidence, estimate=chosen))


def _small_findings(last: Step, model: JointFit, gates: Gates) -> tuple[Finding, ...]:
    """Findings of the last turn that did not join, and may be true, scored beside a model.

    A model without some of the effects of the last turn is not the one that its findings were
    scored beside.
    """
    if last.accepted is not None:  # its findings are of the model before it
        return ()
    found: list[Finding] = []
    for one in last.set_aside:
        # A name that structure refutes is no model that could be true.
        if one.moved and is_unnamed(one.finding.effect):
            found.append(one.finding)
    tested = (*last.findings, *last.structures)
    found += (finding for finding in tested if is_small(finding, gates))
    if model.evidence.effects == last.after.effects:
        return tuple(found)
    scored = [scored_beside(model.search_problem, finding) for finding in found]
    return tuple(finding for finding in scored if finding is not None)


def _turn(
    model: JointFit,
    rng: np.random.Generator,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
    seen: set[frozenset[EffectKey]],
    progress: Callable[[str], None],
    names: Sequence[str],
) -> tuple[Step, JointFit | None]:
    """Take one turn: the step, and the model with what was accepted; None where nothing was."""
    evidence = model.evidence
    problem = model.search_problem
    known = len(evidence.effects)
    moves = problem.folds.moves
    pieces = problem.folds.linearisation.cluster_count
    most = pieces // PIECES_PER_EFFECT
    if known:
        progress(f"searching for a missing effect beside the {known} found")
    else:
        progress("searching for a missing effect")
    proposed = _proposals(problem, evidence.effects, rng, gates, families)
    present = {placed.effect.name for placed in evidence.effects if not is_unnamed(placed.effect)}
    findings = rank_effects(problem, rng, gates, families, proposed, present)
    limits_nm = detection_limits_nm(problem, gates)
    turn = _Tested(problem, PartsLeftOut.of(problem), set(keys_of(evidence)), findings)
    while True:
        named, chosen = turn.choose(rng, gates, progress)
        if chosen is None or known >= most:
            break
        near = (*proposed.get(chosen.axis, ()), *families)
        effect = _refined(problem, chosen, near)
        accepted = replace(chosen, effect=effect)
        refuted = refuted_by_structure(model, accepted, turn.aside)
        name_and_axis = f"{effect.name} on {names[accepted.axis]}"
        progress(f"adding {name_and_axis}")
        joined = refuted or join(model, accepted, rng, gates, seen)
        if isinstance(joined, JointFit):
            accepted = with_joint_settings(accepted, joined.evidence)
            if named is not None and is_unnamed(effect):
                rival = PlacedEffect(effect, accepted.axis)
                explains_more = "{rival} explains clearly more of the same residual"
                turn.aside.append(SetAside(named, explains_more, rival))
            return turn.step(limits_nm, accepted, joined.evidence), joined
        progress(f"{name_and_axis} does not join the model: {joined.reason(names)}")
        turn.aside.append(joined)
        turn.leave_out(chosen, effect)
    ended = ""
    if chosen is not None:
        ended = f"{pieces} pieces of {moves} moves allow no more than {most} effects"
    elif moves < MIN_MOVES_FOR_STRUCTURE:
        ended = f"structure without a name needs {MIN_MOVES_FOR_STRUCTURE} moves, found {moves}"
    return replace(turn.step(limits_nm, None, evidence), ended=ended), None


@dataclass(slots=True)
class _Tested:
    """What a turn has tested and set aside so far."""

    problem: SearchProblem
    parts: PartsLeftOut  #: the same problem, in parts
    taken: set[EffectKey]  #: places in the model, or of what did not join
    findings: tuple[Finding, ...]  #: named effects, the best first
    structures: tuple[Finding, ...] = ()  #: terms without a name, the best first
    searched: range = range(0)  #: axes that they were searched on
    aside: list[SetAside] = field(default_factory=list)

    def choose(
        self, rng: np.random.Generator, gates: Gates, progress: Callable[[str], None]
    ) -> tuple[Finding | None, Finding | None]:
        """Choose the best named effect, and what joins: this, or a term that explains much more.

        Neither is refused by parts left out.
        """
        while True:
            named = choose_effect(self.findings, self.taken)
            if self._is_refused(named):
                continue
            axes = self._axes_of_structure(named)
            if axes != self.searched:
                if named is None:
                    progress("searching for structure that no named effect explains")
                self.structures = find_structure(self.problem, axes, rng, gates)
                self.searched = axes
            term = choose_effect(self.structures, self.taken)
            if self._is_refused(term):
                continue
            if named is not None and (term is None or not is_inadequate(named, term)):
                return named, named
            return named, term

    def _is_refused(self, found: Finding | None) -> bool:
        """Whether parts left out refuse a finding; it is then set aside."""
        if found is None:
            return False
        columns = whitened_columns(self.problem, found.effect, found.axis)
        why = self.parts.refusal(columns, found.coefficients)
        if not why:
            return False
        self.findings = _refused(self.findings, found, why)
        self.structures = _refused(self.structures, found, why)
        self.aside += _first_of_axis(self.aside, SetAside(found, why))
        return True

    def _axes_of_structure(self, named: Finding | None) -> range:
        """Axes to search for structure: that of a named effect, or all of them without one.

        Terms without a name are of driven joints.
        """
        axes = self.problem.axes
        if named is None:
            return range(axes)
        if named.axis >= axes:
            return range(0)
        return range(named.axis, named.axis + 1)

    def leave_out(self, chosen: Finding, effect: Effect) -> None:
        """Choose a finding no more, which did not join as this effect.

        The variables of an axis go together: if its best term may not join, no other term replaces
        it.
        """
        self.taken.add(effect_key(chosen.effect, chosen.axis))
        if is_unnamed(effect):
            of_axis = (one for one in self.structures if one.axis == chosen.axis)
            self.taken.update(effect_key(one.effect, one.axis) for one in of_axis)

    def step(self, limits_nm: FloatArray, accepted: Finding | None, after: Evidence) -> Step:
        """The turn with what was accepted."""
        aside = tuple(self.aside)
        return Step(self.findings, self.structures, limits_nm, accepted, after, aside)


def _refined(
    search_problem: SearchProblem, accepted: Finding, near: Sequence[Sequence[Effect]]
) -> Effect:
    """Return the effect that was chosen with its setting refined, and the form of a gear."""
    effect = refine_setting(search_problem, accepted.effect, accepted.axis, near)
    gear = refined_gear(search_problem, effect, accepted.axis)
    if gear == effect:
        return effect
    return refine_setting(search_problem, gear, accepted.axis, (gears_around(gear),))


def _proposals(
    search_problem: SearchProblem,
    effects: tuple[PlacedEffect, ...],
    rng: np.random.Generator,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
) -> dict[int, tuple[tuple[Effect, ...], ...]]:
    """Families of the dictionary with settings that only the data suggest, by axis."""
    kinds = {type(family[0]) for family in families}
    ripples: Mapping[int, tuple[tuple[Effect, ...], ...]] = {}
    if Ripple in kinds:
        ripples = propose_orders(search_problem, effects, rng, gates)
    resonances = propose_resonances(search_problem, gates, kinds)
    balanced = [placed.axis for placed in effects if isinstance(placed.effect, Counterbalance)]
    balancers = propose_balancers(search_problem, gates, families, balanced)
    cables = propose_cables(search_problem, gates, families)
    own_settings = propose_own_settings(search_problem, gates, families)
    own: dict[int, tuple[tuple[Effect, ...], ...]] = {}
    for proposed in (ripples, resonances, balancers, cables, own_settings):
        for axis, of_axis in proposed.items():
            own[axis] = (*own.get(axis, ()), *of_axis)
    return propose_losses_without_rotor(search_problem, gates, families, own)


def _first_of_axis(aside: Sequence[SetAside], new: SetAside) -> tuple[SetAside, ...]:
    """A finding that parts left out refuse.

    Nothing where a better one of its kind on this axis was set aside before.
    """
    axis = new.finding.axis
    has_no_name = is_unnamed(new.finding.effect)
    for one in aside:
        if one.finding.axis == axis and is_unnamed(one.finding.effect) == has_no_name:
            return ()
    return (new,)


def _refused(findings: Sequence[Finding], refused: Finding, why: str) -> tuple[Finding, ...]:
    new = replace(refused, passed=False, refusals=(*refused.refusals, why))
    return tuple(new if finding is refused else finding for finding in findings)


def _settled(
    step: Step,
    problem: SearchProblem,
    tested: Sequence[Finding],
    rng: np.random.Generator,
    gates: Gates,
) -> Step:
    """Limit the ambiguity of an accepted effect to rivals that passed before it joined, not now.

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
    tested_before = (*step.findings, *step.structures)
    passed_before = {one.placed for one in tested_before if one.passed}
    rivals: dict[EffectKey, PlacedEffect] = {}
    for rival in step.accepted.ambiguity:
        if rival in passed_before:
            rivals[effect_key(rival.effect, rival.axis)] = rival
    passes_now = {effect_key(one.effect, one.axis): one.passed for one in tested}
    again: list[FamilyTrials] = []
    for key, rival in rivals.items():
        if key not in passes_now:
            again += problem.test(((rival.effect,),), rival.axis)
    for found in rank_families(problem, again, rng, gates):
        passes_now[effect_key(found.effect, found.axis)] = found.passed
    left: list[PlacedEffect] = []
    for key, rival in rivals.items():
        if key != own and not passes_now.get(key, False):
            left.append(rival)
    accepted = replace(step.accepted, ambiguity=tuple(left))
    return replace(step, accepted=accepted)
