"""Find the effect that a residual calls for, or report that it calls for none.

The lag-one correlation of a residual is about 0.67, so textbook tests are wrong. A candidate must
pass every gate:

1. its Wald statistic, clustered by move, exceeds the largest one of all candidates in 99 % of draws
   that give the noise of each move a random sign (wild bootstrap, Cameron et al. 2008), or in 95 %
   if the candidate is strong (`Gates`). The joints of a robot are of one design: a family in the
   model already competes on the other axes with itself alone. Corrections of the geometry compete
   among themselves, too. The smaller probability counts, so that this gate alone lets noise pass in
   up to two or three times 1 % (5 %) of all searches: `rank_families`;
2. it lowers the error on at least three quarters of the folds of held-out moves;
3. it explains at least 3 % of the squared residual of the motor that it affects most;
4. that motor's error on held-out moves falls by at least 2 %;
5. its coefficients are possible: none is outside what physics allows by more than 2 σ, and no time
   constant is longer than the data.

Effects that are to join must pass further gates: see `ident.discovery.gates`.

Candidates are ranked by held-out moves, and the setting of a family (its exponent, its speed) is
chosen anew inside each fold, by the other folds alone: the score of a family has not seen what it
is scored on.

Structure that no named effect explains is found in the same way: see `ident.discovery.structure`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import BoolArray, FloatArray
from ident.discovery.candidates import CandidateTrial, FamilyTrials, SearchProblem
from ident.discovery.few_moves import (
    FEW_MOVES,
    FEWEST_MOVES,
    ByMove,
    is_tested_on_others,
    moves_behind,
    what_to_record,
)
from ident.discovery.gates import SIGMAS, Gates, certain_delays, impossible
from ident.discovery.refinement import refine_together
from ident.effects.effect import Effect, PlacedEffect, fits_data, is_placeable
from ident.effects.geometry_corrections import GeometryEffect, LatePosition
from ident.effects.own import search_families
from ident.effects.position import AlongTwoJoints, Compensator, Counterbalance, Hinge, Spring

EffectKey = tuple[str, int, tuple[float, ...]]

AS_GOOD = 0.99  #: Share of the best one's fall on held-out moves that counts as equal
CABLE_MORE = 0.15
"""Share by which a cable over two joints must explain more than a spring,
a hinge or a compensator of one of them.
"""
CLEARLY = 0.95
"""Confidence of a paired comparison over folds (Student's t;
folds share training data, so it is a rough one).
"""
#: Steps of the golden section: the bracket between two neighbours becomes an eighteenth
GOLDEN_STEPS = 6
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of testing one family on one axis."""

    effect: Effect  #: with the setting that explains most
    axis: int  #: index of the joint (or motor)
    coefficients: FloatArray  #: first estimate of its linear parameters
    deviations: FloatArray  #: their σ by the scatter of moves
    #: That noise alone makes a candidate this strong among all, or among those of known families;
    #: None where it rests on too few moves for a test.
    probability: float | None
    folds_better: float  #: share of folds on which it lowers the error
    explained: float  #: share of the squared residual of the motor that it affects most
    #: error of that motor on held-out moves without it, ‖e‖/‖v‖ of the current [%]
    error_before_percent: float
    error_after_percent: float  #: the same with it [%]
    error_fall: float  #: relative fall from one to the other
    held_out_fall: float  #: fall of the whole whitened ‖e‖² on held-out moves; the rank
    passed: bool  #: whether it passes every gate
    #: ‖e‖² of the whole on each fold, shape (folds,), for paired comparisons
    fold_errors: FloatArray
    #: Other effects that cannot be distinguished from this one by their score on held-out moves.
    ambiguity: tuple[PlacedEffect, ...] = ()
    #: Of the motor's squared residual beyond noise, roughly: the noise is an estimate, often from
    #: standstill. None where it is not known, or nothing is left beyond it. No gate uses it.
    share_of_excess: float | None = None
    refusals: tuple[str, ...] = ()  #: gates that it did not pass, in words
    #: What to record, where too few moves show it to tell it from noise: one of the refusals; else
    #: empty.
    too_few_moves: str = ""
    impossible: str = ""  #: coefficients that physics does not allow, in words: one of the refusals

    @property
    def placed(self) -> PlacedEffect:
        """The effect on its axis."""
        return PlacedEffect(self.effect, self.axis)


def rank_effects(
    search_problem: SearchProblem,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] | None = None,
    proposed: Mapping[int, tuple[tuple[Effect, ...], ...]] | None = None,
    known: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Test all families on all axes and rank them, the best on held-out moves first.

    Without families, these are those of the dictionary and of installed packages.

    What is proposed for an axis takes the place of the families of the same name there. ``known``
    are names of effects in the model: see `rank_families`.
    """
    if families is None:
        families = search_families()
    tested: list[FamilyTrials] = []
    for axis in range(len(search_problem.model.robot.places)):
        own = (proposed or {}).get(axis, ())
        names = {family[0].name for family in own}
        shared = (family for family in families if family[0].name not in names)
        fitting: list[tuple[Effect, ...]] = []
        for family in (*shared, *own):
            members = tuple(one for one in family if is_tried(search_problem, one, axis))
            if members:
                fitting.append(members)
        tested += search_problem.test(fitting, axis)
    return rank_families(search_problem, tested, rng, gates or Gates(), known)


def is_tried(search_problem: SearchProblem, effect: Effect, axis: int) -> bool:
    """Return whether an effect can be on an axis, and these data can show it there."""
    if not is_placeable(effect, axis, search_problem.model.robot):
        return False
    if effect.least_moves > search_problem.folds.moves:
        return False
    return fits_data(effect, search_problem.runs, axis)


def rank_families(
    search_problem: SearchProblem,
    tested: Sequence[FamilyTrials],
    rng: np.random.Generator,
    gates: Gates,
    known: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Judge each family by the gates, beside all that are tested with it,
    and rank them by held-out moves.

    Args:
        search_problem: around the model.
        tested: families on axes.
        rng: of the bootstrap.
        gates: limits.
        known: names of effects in the model. Families of these names compete among themselves as
            well, and the smaller of both probabilities counts. So do the corrections of the
            geometry, because they are few beside hundreds of other candidates. They have no other
            precedence: `choose_effect` takes what lowers the error of held-out moves most.

    The level of the smaller probability is not that of one. 2000 draws of noise with 60 moves,
    heteroscedastic, and 100 independent candidates, of which 14 are corrections and 12 of known
    families, pass a limit of 1 % in 1.4 % by all candidates, 2.5 % with the corrections and 3.8 %
    with the known families; a limit of 5 % in 6.5, 10.8 and 14.6 %. The other gates are not in
    these figures, and what noise makes of a whole search is in docs/evidence.
    """
    if not tested:
        return ()
    trials = tuple(trial for family in tested for _, trial in family.members)
    probability = chances(trials, rng, gates.draws)
    effects = [effect for family in tested for effect, _ in family.members]
    is_known = np.array([effect.name in known for effect in effects])
    is_geometry = np.array([isinstance(effect, GeometryEffect) for effect in effects])
    for alike in (is_known, is_geometry):
        if alike.any():
            among_them = chances(
                tuple(trials[index] for index in np.flatnonzero(alike)), rng, gates.draws
            )
            probability[alike] = np.fmin(probability[alike], among_them)
    probabilities = iter(probability)
    sizes = MotorSizes.of(search_problem)
    findings = [_judge(search_problem, sizes, family, probabilities, gates) for family in tested]
    ranked = sorted(findings, key=lambda finding: -finding.held_out_fall)
    errors = np.stack([finding.fold_errors for finding in ranked])
    better = is_better(errors[:, None], errors[None])
    # Those that a paired comparison cannot distinguish from it.
    rivals = ~(better | better.T | np.eye(len(ranked), dtype=np.bool_))
    rivals &= np.array([finding.held_out_fall > 0 for finding in ranked])
    places = [finding.placed for finding in ranked]
    return tuple(
        replace(finding, ambiguity=tuple(places[index] for index in np.flatnonzero(row)))
        for finding, row in zip(ranked, rivals, strict=True)
    )


def choose_effect(findings: Sequence[Finding], taken: Collection[EffectKey] = ()) -> Finding | None:
    """Choose the best that passed; of those as good on the same axis,
    the one with the fewest parameters.

    So a hinge that starts outside the joint's range is reported as a spring. Beside an effect whose
    settings are fitted to the residual, nearly as good is not enough: folds must not distinguish
    them, or a balancer would be a spring with harmonics. A cable over two joints has many settings,
    so it must explain clearly more than what one joint does. Places that are taken, in the model or
    refused, are not chosen again.
    """
    passed = [
        found
        for found in findings
        if found.passed and effect_key(found.effect, found.axis) not in taken
    ]
    if not passed:
        return None
    best = passed[0]
    if isinstance(best.effect, AlongTwoJoints):
        best = next((found for found in passed if _is_simpler_than_cable(found, best)), best)
    alike = [
        finding
        for finding in passed
        if finding.axis == best.axis
        and finding.held_out_fall >= AS_GOOD * best.held_out_fall
        and not (best.effect.refined and is_better(best.fold_errors, finding.fold_errors))
    ]
    return min(
        alike,
        key=lambda finding: len(finding.effect.coefficients) + len(_own_settings(finding.effect)),
    )


def _is_simpler_than_cable(found: Finding, cable: Finding) -> bool:
    """Whether an effect of the position of one joint of a cable's pair explains nearly as much as
    the cable.
    """
    if not isinstance(found.effect, Spring | Hinge | Compensator | Counterbalance):
        return False
    pair = (cable.axis, (cable.effect.second_axis or 0) - 1)
    return found.axis in pair and cable.held_out_fall < (1.0 + CABLE_MORE) * found.held_out_fall


def effect_key(effect: Effect, axis: int) -> EffectKey:
    """Identify an effect on an axis by its family and `Effect.key_settings`:
    two orders of a ripple are two.
    """
    settings = effect.settings
    return effect.name, axis, tuple(settings[name] for name in effect.key_settings)


def _own_settings(effect: Effect) -> dict[str, float]:
    """Settings without those that choose a form of the same effect."""
    return {
        name: value for name, value in effect.settings.items() if name not in effect.form_settings
    }


def is_better(one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether one ‖e‖² is less than the other by a paired comparison over folds, folds last."""
    gain = other - one
    return np.asarray(
        paired_t(gain) > scipy.special.stdtrit(gain.shape[-1] - 1, 0.5 + CLEARLY / 2.0)
    )


def paired_t(gain: FloatArray) -> FloatArray:
    """Student's t of the fall of ‖e‖² on each fold, folds last."""
    error = np.std(gain, axis=-1, ddof=1) * np.sqrt(gain.shape[-1])
    return np.asarray(gain.sum(axis=-1) / np.maximum(error, np.finfo(np.float64).tiny))


def refine_setting(
    search_problem: SearchProblem, effect: Effect, axis: int, families: Iterable[Sequence[Effect]]
) -> Effect:
    """Refine the first real setting by golden section on the squared residual,
    between its neighbours in the family.

    The search is over the logarithm. An effect without a positive real setting, or at the end of
    its family, is returned unchanged. Settings that an effect refines together are left to
    `refine_together`.
    """
    if effect.refined_once_chosen:
        return refine_together(search_problem, effect, axis)
    family = next((members for members in families if effect in members), ())
    for name, value in effect.settings.items():
        if not isinstance(value, float):
            continue
        grid = sorted(
            member.settings[name]
            for member in family
            if member.with_settings({name: value}) == effect
        )
        place = grid.index(value) if value in grid else 0
        if 0 < place < len(grid) - 1 and grid[0] > 0:
            lower = grid[place - 1]
            upper = grid[place + 1]
            declared = effect.nearly_declared.get(name)
            if declared is not None and value < declared.least:
                upper = min(upper, declared.least)
            elif declared is not None:
                lower = max(lower, declared.largest)
            return _golden_section(search_problem, effect, axis, name, lower, upper)
    return effect


@dataclass(frozen=True, slots=True, eq=False)
class MotorSizes:
    """What all candidates of a turn are compared with."""

    before: FloatArray  #: ‖e‖² of each fold and motor on held-out moves, shape (folds, m)
    residual: FloatArray  #: ‖e‖² of each motor, shape (m,)
    current: FloatArray  #: ‖v‖² of each motor, shape (m,)

    @classmethod
    def of(cls, search_problem: SearchProblem) -> MotorSizes:
        """Sum the squares of a problem around the model."""
        folds = search_problem.folds
        problem = folds.linearisation
        count = len(problem.gamma)
        residual = np.zeros(count)
        current = np.zeros(count)
        np.add.at(residual, problem.motor, problem.residual**2)
        np.add.at(current, problem.motor, problem.current**2)
        before = folds.square_sum(folds.residual)
        return cls(before, residual, current)


def _judge(
    search_problem: SearchProblem,
    sizes: MotorSizes,
    family: FamilyTrials,
    probabilities: Iterator[float],
    gates: Gates,
) -> Finding:
    problem = search_problem.folds.linearisation
    before = sizes.before
    probability = [next(probabilities) for _ in family.members]
    # A setting that needs impossible coefficients is chosen only where every setting of the family
    # does.
    fewest = min(len(effect.coefficients) for effect, _ in family.members)
    ruled_out = [_ruled_out(effect, trial, fewest) for effect, trial in family.members]
    possible = [index for index, why in enumerate(ruled_out) if not why] or range(
        len(family.members)
    )
    best = max(possible, key=lambda index: float(family.members[index][1].fallen.sum()))
    effect, trial = family.members[best]
    if len(effect.coefficients) > fewest:
        # High powers rest on few moves, whose random signs test nothing: the simplest form is
        # surprising for both.
        plain = (
            index for index in possible if len(family.members[index][0].coefficients) == fewest
        )
        probability[best] = float(
            np.fmin.reduce([probability[best], *(probability[index] for index in plain)])
        )
    after = replace(family, members=tuple(family.members[index] for index in possible)).nested()
    fall = before.sum(axis=1) - after.sum(axis=1)
    # Another motor may supply a joint's torque (R): the drive in question is the one whose residual
    # falls most.
    motor = int(np.argmax(trial.fallen))
    own = float(sizes.residual[motor])
    size = float(sizes.current[motor])
    explained = float(trial.fallen[motor] / own)
    error_before, error_after = (
        float(np.sqrt(part[:, motor].sum() / size)) for part in (before, after)
    )
    error_fall = 1.0 - error_after / error_before
    folds_better = float(np.mean(fall > 0))
    # A small mistake of the geometry is spread over all motors, and bends their gains.
    may_be_small = isinstance(effect, GeometryEffect)
    if isinstance(effect, LatePosition):
        may_be_small = bool(certain_delays(trial.coefficients, trial.deviations).all())
    strong = folds_better >= gates.strong_folds and error_fall >= gates.strong_fall
    if strong:
        false_alarm = gates.strong_false_alarm
    else:
        false_alarm = gates.false_alarm
    if np.isnan(probability[best]):
        chance = None
    else:
        chance = float(probability[best])
    may_be_noise = chance is None or chance > false_alarm
    too_few_moves = ""
    if chance is None:
        by_chance = ""
    else:
        by_chance = f"noise makes one as strong with p = {chance:.3f}"
    if may_be_noise and (chance is None or is_tested_on_others(trial.rest)):
        too_few_moves = what_to_record(effect, trial.gram, trial.rest)
        by_chance = too_few_moves
    verdicts = (
        (may_be_noise, by_chance),
        (
            folds_better < gates.folds_better,
            f"it is better on {100 * folds_better:.0f} % of the folds only",
        ),
        (
            explained < gates.explained and not may_be_small,
            f"it explains {100 * explained:.1f} % of the squared residual only",
        ),
        (
            error_fall < gates.error_fall and not may_be_small,
            f"the error on left-out moves changes by {-100 * error_fall:+.1f} % only",
        ),
        (fall.sum() <= 0.0, "the error on left-out moves does not fall"),
        (bool(ruled_out[best]), ruled_out[best]),
    )
    refusals = tuple(words for refused, words in verdicts if refused)
    floor_a = search_problem.floors_a[motor]
    if floor_a is None:
        excess = 0.0
    else:
        excess = own - problem.shown(motor) * (floor_a / problem.noise[motor]) ** 2
    return Finding(
        effect=effect,
        axis=family.axis,
        coefficients=trial.coefficients,
        deviations=trial.deviations,
        probability=chance,
        folds_better=folds_better,
        explained=explained,
        error_before_percent=100.0 * error_before,
        error_after_percent=100.0 * error_after,
        error_fall=error_fall,
        held_out_fall=float(fall.sum()),
        passed=not refusals,
        share_of_excess=min(float(trial.fallen[motor]) / excess, 1.0) if excess > 0.0 else None,
        fold_errors=after.sum(axis=1),
        refusals=refusals,
        too_few_moves=too_few_moves,
        impossible=ruled_out[best],
    )


def _ruled_out(effect: Effect, trial: CandidateTrial, fewest: int) -> str:
    """Which coefficients are impossible; of a form with more of them than the fewest of its family,
    without tolerance.

    Two that are nearly collinear each hide in their σ, however certain both together are. What is
    left of a rotor may be zero within its σ: it is fitted to say how well the rotor is known.
    """
    is_richer = len(effect.coefficients) > fewest and not effect.fits_rotor
    tolerance = 0.0 if is_richer else SIGMAS
    return impossible(effect.coefficients, trial.coefficients, trial.deviations, tolerance)


def chances(trials: tuple[CandidateTrial, ...], rng: np.random.Generator, draws: int) -> FloatArray:
    """Probability of each candidate's Wald statistic under random signs of the moves,
    for the largest of all.

    A candidate that rests on few moves has a heavy tail, and would hide every other one: it
    competes with all, but the others do not compete with it. It is tested without the moves of most
    leverage where the others are enough, and has no probability (NaN) where no test is left.
    """
    signs = rng.choice((-1.0, 1.0), size=(draws, len(trials[0].scatter)))
    of_many: dict[int, ByMove] = {}
    of_few: dict[int, ByMove] = {}
    for number, trial in enumerate(trials):
        if moves_behind(trial.gram) >= FEW_MOVES:
            of_many[number] = trial
        elif trial.rest is not None and is_tested_on_others(trial.rest):
            of_many[number] = trial.rest
        elif moves_behind(trial.gram) >= FEWEST_MOVES:
            of_few[number] = trial
    probability = np.full(len(trials), np.nan)
    surprise = np.zeros(draws)
    for part in (of_many, of_few):
        observed, drawn = _surprises(list(part.values()), signs)
        surprise = np.maximum(surprise, drawn)
        probability[list(part)] = (1.0 + np.sum(surprise[None] >= observed[:, None], axis=1)) / (
            draws + 1.0
        )
    return probability


def _surprises(candidates: Sequence[ByMove], signs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Surprise of each candidate, shape (c,), and of the most surprising one of each draw,
    shape (draws,).
    """
    widths = np.array([len(one.score) for one in candidates], dtype=np.int64)
    observed = np.empty(len(candidates))
    surprise = np.zeros(len(signs))
    for freedom in np.unique(widths).tolist():
        numbers = np.flatnonzero(widths == freedom).tolist()
        alike = [candidates[number] for number in numbers]
        score, scatter = (
            np.stack(parts)
            for parts in zip(*((one.score, one.scatter) for one in alike), strict=True)
        )
        # The candidate is in the fit here: else its own torque would count as noise, and the
        # strongest would hide best.
        inverse = np.linalg.pinv(np.swapaxes(scatter, 1, 2) @ scatter)
        wald = (score[:, None] @ inverse @ score[:, :, None])[:, 0, 0]
        if freedom == 1:
            drawn = _drawn_numbers(
                scatter[:, :, 0].T, np.stack([one.gram[:, 0, 0] for one in alike], axis=1), signs
            )
        else:
            drawn = reduce(np.maximum, (_drawn_wald(one, signs) for one in alike))
        # On the scale of −log p, so that candidates with one and with two coefficients compete
        # alike.
        observed[numbers] = _surprise(wald, freedom)
        surprise = np.maximum(surprise, _surprise(drawn, freedom))
    return observed, surprise


def _surprise(wald: FloatArray, freedom: int) -> FloatArray:
    """−log p of χ² statistics, finite however large they are."""
    return np.asarray(
        -np.log(np.maximum(scipy.special.chdtrc(freedom, wald), np.finfo(np.float64).tiny))
    )


def _drawn_wald(trial: ByMove, signs: FloatArray) -> FloatArray:
    """Wald statistic of each draw, with a scatter of its own;
    with one for all, few moves would look too certain.

    In a draw, x_m becomes s_m x_m; its sum S is taken for an effect β = G⁻¹S, and the rest in move
    m is s_m x_m − G_m β (the studentised wild bootstrap of Cameron, Gelbach & Miller, 2008).
    """
    x = trial.scatter
    gram = trial.gram
    (moves, p), (row, column) = x.shape, np.tril_indices(x.shape[1])
    sums = signs @ x
    fitted = sums @ np.linalg.pinv(gram.sum(axis=0))
    # Symmetric matrices by their lower triangle. First Σ_m s_m (x_m (G_m β)ᵀ + (G_m β) x_mᵀ),
    # linear in β.
    mixed = gram[:, column] * x[:, row, None] + gram[:, row] * x[:, column, None]
    crossed = (signs @ mixed.reshape(moves, -1)).reshape(-1, len(row), p) @ fitted[:, :, None]
    # Σ_m (G_m β)(G_m β)ᵀ, linear in ββᵀ: one matrix for all draws.
    products = (gram.reshape(moves, -1).T @ gram.reshape(moves, -1)).reshape(p, p, p, p)
    squares = products[row[:, None], row, column[:, None], column]
    squares += np.where(row == column, 0.0, products[row[:, None], column, column[:, None], row])
    left = np.empty((len(signs), p, p))
    left[:, row, column] = (
        (x.T @ x)[row, column] - crossed[:, :, 0] + (fitted[:, row] * fitted[:, column]) @ squares.T
    )
    left[:, column, row] = left[:, row, column]
    # A coefficient that no draw scatters
    left += 1e-12 * np.trace(left, axis1=1, axis2=2)[:, None, None] * np.eye(p)
    return np.asarray(np.sum(sums * np.linalg.solve(left, sums[:, :, None])[:, :, 0], axis=1))


def _drawn_numbers(x: FloatArray, gram: FloatArray, signs: FloatArray) -> FloatArray:
    """The same for candidates with one coefficient each, the largest of all;
    x_m and G_m of shape (moves, c).
    """
    sums = signs @ x
    fitted = sums / gram.sum(axis=0)
    left = (
        np.sum(x**2, axis=0)
        - 2.0 * fitted * (signs @ (x * gram))
        + fitted**2 * np.sum(gram**2, axis=0)
    )
    return np.asarray(np.max(sums**2 / left, axis=1))


def _golden_section(
    search_problem: SearchProblem, effect: Effect, axis: int, name: str, lower: float, upper: float
) -> Effect:
    a = float(np.log(lower))
    b = float(np.log(upper))

    def fall(x: float) -> float:
        changed = effect.with_settings({name: float(np.exp(x))})
        (fit,) = search_problem.fits([search_problem.torque(changed, axis)])
        if fit is None:
            return -np.inf
        return float(fit.fallen.sum())

    inner = b - GOLDEN * (b - a)
    outer = a + GOLDEN * (b - a)
    at_inner = fall(inner)
    at_outer = fall(outer)
    for _ in range(GOLDEN_STEPS):
        if at_inner > at_outer:
            b = outer
            outer = inner
            at_outer = at_inner
            inner = b - GOLDEN * (b - a)
            at_inner = fall(inner)
        else:
            a = inner
            inner = outer
            at_inner = at_outer
            outer = a + GOLDEN * (b - a)
            at_outer = fall(outer)
    best = float(f"{np.exp((a + b) / 2.0):.4g}")
    better = fall(np.log(best)) > fall(np.log(effect.settings[name]))
    return effect.with_settings({name: best}) if better else effect
