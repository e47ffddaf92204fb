"""Find the effect that a residual calls for, or report that it calls for none.

The lag-one correlation of a residual is about 0.67, so textbook tests are wrong. A candidate must
pass every gate:

1. its Wald statistic, clustered by move, exceeds the largest one of all candidates in 99 % of draws
   that give the noise of each move a random sign (wild bootstrap, Cameron et al. 2008), or in 95 %
   if the candidate is strong (`Gates`). The joints of a robot are of one design: a family in the
   model already competes on the other axes with itself alone, too, and corrections of the geometry
   compete among themselves, too. The smaller of both probabilities counts, so that noise alone
   passes this gate in more than 1 % (5 %) of all searches, up to three times as many:
   `rank_families`;
2. it lowers the error on at least three quarters of the folds of left-out moves;
3. it explains at least 3 % of the squared residual of the motor that it affects most;
4. that motor's error on left-out moves falls by at least 2 %;
5. its coefficients are possible: none is outside what physics allows by more than 2 σ, and no time
   constant is longer than the data.

Effects that are to join must pass further gates: see `ident.discovery.gates`.

Candidates are ranked by left-out moves, and the setting of a family (its exponent, its speed) is
chosen anew inside each fold, by the other folds alone: the score of a family has not seen what it
is scored on.

Structure that no named effect explains is found in the same way: see `ident.discovery.structure`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import BoolArray, FloatArray
from ident.discovery.candidates import CandidateTrial, FamilyTrials, SearchProblem
from ident.discovery.few_moves import (
    FEW_MOVES,
    FEWEST_MOVES,
    MoveScores,
    is_tested_on_others,
    moves_behind,
    what_to_record,
)
from ident.discovery.gates import SIGMAS, Gates, certain_delays, impossible
from ident.discovery.refinement import refine_together
from ident.effects.effect import (
    Effect,
    EffectKey,
    PlacedEffect,
    effect_key,
    fits_data,
    is_placeable,
)
from ident.effects.geometry_corrections import GeometryEffect, LatePosition
from ident.effects.own import search_families
from ident.effects.position import AlongTwoJoints, Compensator, Counterbalance, Hinge, Spring

#: An effect whose ‖e‖² on left-out moves falls by this share of the best one's fall is as good
EQUAL_FALL_SHARE = 0.99
CABLE_MARGIN = 0.15
"""Share by which a cable over two joints must explain more than a spring,
a hinge or a compensator of one of them.
"""
PAIRED_CONFIDENCE = 0.95
"""Confidence of a paired comparison over folds (Student's t;
folds share training data, so it is a rough one).
"""
#: Steps of the golden section, each of which leaves 0.618 of the bracket: together an eighteenth
GOLDEN_STEPS = 6
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
OF_ONE_JOINT = (Spring, Hinge, Compensator, Counterbalance)
"""Effects of the position of one joint, which a cable over two joints resembles."""
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of testing one family on one axis."""

    effect: Effect  #: with the setting that explains most
    axis: int  #: index of the joint (or motor)
    coefficients: FloatArray  #: first estimate of its linear parameters
    deviations: FloatArray  #: their σ by the scatter of moves
    #: p-value: that noise alone makes the strongest of all candidates as strong, or of those that
    #: it competes with (`rank_families`); None where it rests on too few moves for a test.
    probability: float | None
    folds_better: float  #: share of folds on which it lowers the error
    explained: float  #: share of the squared residual of the motor that it affects most
    #: error of that motor on left-out moves without it, ‖e‖/‖v‖ of the current [%]
    error_before_percent: float
    error_after_percent: float  #: the same with it [%]
    error_fall: float  #: relative fall from one to the other
    left_out_fall: float  #: fall of the whitened ‖e‖² of all motors on left-out moves; the rank
    passed: bool  #: whether it passes every gate
    #: whitened ‖e‖² of all motors on each fold, shape (folds,), for paired comparisons
    fold_errors: FloatArray
    #: Other effects that cannot be distinguished from this one by their score on left-out moves.
    ambiguity: tuple[PlacedEffect, ...] = ()
    #: Rough share that it explains of what the motor's squared residual has beyond noise: the noise
    #: is an estimate, often from standstill. None where that is not known, or the residual is no
    #: larger than the noise. No gate uses it.
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
    """Test all families on all axes and rank them, the best on left-out moves first.

    Without families, these are those of the dictionary and of installed packages.

    What is proposed for an axis takes the place of the families of the same name there. ``known``
    are names of effects in the model: see `rank_families`.
    """
    if families is None:
        families = search_families()
    if proposed is None:
        proposed = {}
    tested: list[FamilyTrials] = []
    for axis in range(len(search_problem.model.robot.places)):
        own = proposed.get(axis, ())
        names = {family[0].name for family in own}
        shared = [family for family in families if family[0].name not in names]
        fitting: list[tuple[Effect, ...]] = []
        for family in (*shared, *own):
            members = tuple(one for one in family if is_testable(search_problem, one, axis))
            if members:
                fitting.append(members)
        tested += search_problem.test(fitting, axis)
    return rank_families(search_problem, tested, rng, gates or Gates(), known)


def is_testable(search_problem: SearchProblem, effect: Effect, axis: int) -> bool:
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
    """Judge each family by the gates, and rank them by left-out moves.

    Args:
        search_problem: around the model.
        tested: families on axes.
        rng: of the bootstrap.
        gates: limits.
        known: names of effects in the model. Families of these names compete among themselves as
            well, and the smaller of both probabilities counts. So do the corrections of the
            geometry, because they are few beside hundreds of other candidates. They have no other
            precedence: `choose_effect` takes what lowers the error of left-out moves most.

    The smaller probability lets more noise pass than its limit says. A simulation of 2000 draws has
    heteroscedastic noise of 60 moves, and 100 independent candidates, of which 14 are corrections
    and 12 of known families. Some candidate passes

        limit   against all   also among corrections   also among known families
        1 %     1.4 %         2.5 %                    3.8 %
        5 %     6.5 %         10.8 %                   14.6 %

    of the draws. The other gates are not in these figures; docs/evidence has how often noise passes
    a complete search.
    """
    if not tested:
        return ()
    effects: list[Effect] = []
    trials: list[CandidateTrial] = []
    for family in tested:
        for effect, trial in family.members:
            effects.append(effect)
            trials.append(trial)
    probability = bootstrap_probabilities(tuple(trials), rng, gates.draws)
    is_known = np.array([effect.name in known for effect in effects])
    is_geometry = np.array([isinstance(effect, GeometryEffect) for effect in effects])
    for is_in_group in (is_known, is_geometry):
        if not is_in_group.any():
            continue
        group = tuple(trials[index] for index in np.flatnonzero(is_in_group))
        within_group = bootstrap_probabilities(group, rng, gates.draws)
        # fmin takes the number where the other is NaN, a candidate without a test.
        probability[is_in_group] = np.fmin(probability[is_in_group], within_group)
    counts = [len(family.members) for family in tested]
    of_families = np.split(probability, np.cumsum(counts)[:-1])
    squares = MotorSquares.of(search_problem)
    findings: list[Finding] = []
    for family, own_probability in zip(tested, of_families, strict=True):
        findings.append(_judge(search_problem, squares, family, own_probability, gates))
    ranked = sorted(findings, key=lambda finding: -finding.left_out_fall)
    return _with_ambiguity(ranked)


def _with_ambiguity(ranked: Sequence[Finding]) -> tuple[Finding, ...]:
    """Give each finding those that a paired comparison cannot distinguish from it."""
    errors = np.stack([finding.fold_errors for finding in ranked])
    better = is_better(errors[:, None], errors[None])  # [i, j]: i is better than j
    oneself = np.eye(len(ranked), dtype=np.bool_)
    rivals = ~(better | better.T | oneself)
    # What does not lower the error is no rival of anything.
    rivals &= np.array([finding.left_out_fall > 0 for finding in ranked])
    places = [finding.placed for finding in ranked]
    compared: list[Finding] = []
    for finding, is_rival in zip(ranked, rivals, strict=True):
        ambiguity = tuple(places[index] for index in np.flatnonzero(is_rival))
        compared.append(replace(finding, ambiguity=ambiguity))
    return tuple(compared)


def choose_effect(findings: Sequence[Finding], taken: Collection[EffectKey] = ()) -> Finding | None:
    """Choose the best that passed; of those as good on its axis, the one with fewest parameters.

    So a hinge that starts outside the joint's range is reported as a spring. Beside an effect whose
    settings are fitted to the residual, nearly as good is not enough: folds must not distinguish
    them, or a balancer would be a spring with harmonics. A cable over two joints has many settings,
    so it must explain clearly more than what one joint does. Places that are taken, in the model or
    refused, are not chosen again.
    """
    passed: list[Finding] = []
    for found in findings:
        if found.passed and effect_key(found.effect, found.axis) not in taken:
            passed.append(found)
    if not passed:
        return None
    best = passed[0]
    if isinstance(best.effect, AlongTwoJoints):
        simpler = [found for found in passed if _is_simpler_than_cable(found, best)]
        if simpler:
            best = simpler[0]
    alike = [found for found in passed if _is_as_good(found, best)]
    return min(alike, key=lambda finding: _parameter_count(finding.effect))


def _is_as_good(finding: Finding, best: Finding) -> bool:
    """Whether an effect on the same axis explains as much as the best one."""
    if finding.axis != best.axis:
        return False
    if finding.left_out_fall < EQUAL_FALL_SHARE * best.left_out_fall:
        return False
    if not best.effect.refined:
        return True
    return not is_better(best.fold_errors, finding.fold_errors)


def _is_simpler_than_cable(found: Finding, cable: Finding) -> bool:
    """Whether one joint of a cable's pair alone, by its position, explains nearly as much."""
    if not isinstance(found.effect, OF_ONE_JOINT):
        return False
    axes = [cable.axis]
    if cable.effect.second_axis is not None:
        axes.append(cable.effect.second_axis - 1)  # a number, from 1
    if found.axis not in axes:
        return False
    return cable.left_out_fall < (1.0 + CABLE_MARGIN) * found.left_out_fall


def _parameter_count(effect: Effect) -> int:
    """Number of coefficients and settings, without those that choose a form of the same effect."""
    own_settings = [name for name in effect.settings if name not in effect.form_settings]
    return len(effect.coefficients) + len(own_settings)


def is_better(one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether one ‖e‖² is less than the other by a paired comparison over folds.

    Args:
        one, other: ‖e‖² of each fold, shape (…, folds).

    Returns:
        shape (…,).
    """
    gain = other - one
    freedom = gain.shape[-1] - 1
    limit = scipy.special.stdtrit(freedom, 0.5 + PAIRED_CONFIDENCE / 2.0)
    return np.asarray(paired_t(gain) > limit)


def paired_t(gain: FloatArray) -> FloatArray:
    """Student's t of the fall of ‖e‖² on each fold, shape (…, folds) → (…,)."""
    fold_std = np.std(gain, axis=-1, ddof=1)
    std_error = fold_std * np.sqrt(gain.shape[-1])  # of the sum over folds
    return np.asarray(gain.sum(axis=-1) / np.maximum(std_error, TINY))


def refine_setting(
    search_problem: SearchProblem, effect: Effect, axis: int, families: Iterable[Sequence[Effect]]
) -> Effect:
    """Refine the first real setting by golden section on the squared residual.

    The search is over the logarithm, between the setting's neighbours in the family. An effect
    without a positive real setting, or at the end of its family, is returned unchanged. Settings
    that an effect refines together are left to `refine_together`.
    """
    if effect.refined_once_chosen:
        return refine_together(search_problem, effect, axis)
    family = next((members for members in families if effect in members), ())
    for name, value in effect.settings.items():
        if not isinstance(value, float):
            continue
        differ_here_alone = [
            member for member in family if member.with_settings({name: value}) == effect
        ]
        grid = sorted(member.settings[name] for member in differ_here_alone)
        if value not in grid or grid[0] <= 0:
            continue
        place = grid.index(value)
        is_inside = 0 < place < len(grid) - 1
        if not is_inside:
            continue
        lower = grid[place - 1]
        upper = grid[place + 1]
        # The bracket stays on its side of the values that make the effect a declared term.
        declared = effect.nearly_declared.get(name)
        if declared is not None and value < declared.least:
            upper = min(upper, declared.least)
        elif declared is not None:
            lower = max(lower, declared.largest)
        return _golden_section(search_problem, effect, axis, name, lower, upper)
    return effect


@dataclass(frozen=True, slots=True, eq=False)
class MotorSquares:
    """Squares of the model without any candidate, which all of them are compared with."""

    before: FloatArray  #: ‖e‖² of each fold and motor on left-out moves, shape (folds, m)
    residual: FloatArray  #: ‖e‖² of each motor, shape (m,)
    current: FloatArray  #: ‖v‖² of each motor, shape (m,)

    @classmethod
    def of(cls, search_problem: SearchProblem) -> MotorSquares:
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

    def relative_error(self, squares: FloatArray, motor: int) -> float:
        """Error of a motor, ‖e‖/‖v‖ of its current.

        Args:
            squares: ‖e‖² of each fold and motor, shape (folds, m).
            motor: index of it.
        """
        error_square = squares[:, motor].sum()
        return float(np.sqrt(error_square / float(self.current[motor])))


def _judge(
    search_problem: SearchProblem,
    motor_squares: MotorSquares,
    family: FamilyTrials,
    probability: FloatArray,
    gates: Gates,
) -> Finding:
    """Judge the setting of a family that explains most.

    Args:
        search_problem: around the model.
        motor_squares: of the model.
        family: its trials on one axis.
        probability: of each member, shape (members,); NaN without a test.
        gates: limits.
    """
    members = family.members
    widths = [len(effect.coefficients) for effect, _ in members]
    ruled_out = [_ruled_out(effect, trial, min(widths)) for effect, trial in members]
    # A setting that needs impossible coefficients is chosen only where every setting of the family
    # does.
    possible = [index for index, why in enumerate(ruled_out) if not why]
    if not possible:
        possible = list(range(len(members)))
    falls = [float(trial.fall_by_motor.sum()) for _, trial in members]
    best = max(possible, key=lambda index: falls[index])
    effect, trial = members[best]
    possible_members = tuple(members[index] for index in possible)
    # ‖r‖² by fold and motor, without the family and with it.
    before = motor_squares.before
    after = replace(family, members=possible_members).nested()
    fall_of_folds = before.sum(axis=1) - after.sum(axis=1)
    # Another motor may supply a joint's torque (R): the drive in question is the one whose residual
    # falls most.
    motor = int(np.argmax(trial.fall_by_motor))
    error_before = motor_squares.relative_error(before, motor)
    error_after = motor_squares.relative_error(after, motor)
    finding = Finding(
        effect=effect,
        axis=family.axis,
        coefficients=trial.coefficients,
        deviations=trial.deviations,
        probability=_probability_of(best, possible, widths, probability),
        folds_better=float(np.mean(fall_of_folds > 0)),
        explained=float(trial.fall_by_motor[motor] / motor_squares.residual[motor]),
        error_before_percent=100.0 * error_before,
        error_after_percent=100.0 * error_after,
        error_fall=1.0 - error_after / error_before,
        left_out_fall=float(fall_of_folds.sum()),
        passed=True,
        share_of_excess=_share_of_excess(search_problem, motor_squares, trial, motor),
        fold_errors=after.sum(axis=1),
        impossible=ruled_out[best],
    )
    return _with_refusals(finding, trial, gates)


def _probability_of(
    best: int, possible: Sequence[int], widths: Sequence[int], probability: FloatArray
) -> float | None:
    """Probability of the best setting of a family; None where none has a test.

    A form with more columns, such as high powers, may rest on few moves, whose random signs test
    nothing. The smallest probability of the family's simplest forms then speaks for it.

    Args:
        best: index of the member that explains most.
        possible: indices of members with possible coefficients.
        widths: number of columns of each member.
        probability: of each member, shape (members,).
    """
    competing = [probability[best]]
    fewest = min(widths)
    if widths[best] > fewest:
        competing += [probability[index] for index in possible if widths[index] == fewest]
    smallest = float(np.fmin.reduce(competing))
    if np.isnan(smallest):
        return None
    return smallest


def _with_refusals(finding: Finding, trial: CandidateTrial, gates: Gates) -> Finding:
    """The finding with the gates that it does not pass."""
    refusals: list[str] = []
    too_few_moves = ""
    if _may_be_noise(finding, gates):
        if finding.probability is None or is_tested_on_others(trial.without_leverage):
            too_few_moves = what_to_record(finding.effect, trial.gram, trial.without_leverage)
            refusals.append(too_few_moves)
        else:
            refusals.append(f"noise makes one as strong with p = {finding.probability:.3f}")
    if finding.folds_better < gates.folds_better:
        percent = 100 * finding.folds_better
        refusals.append(f"it is better on {percent:.0f} % of the folds only")
    may_be_small = _may_be_small(finding)
    if finding.explained < gates.explained and not may_be_small:
        percent = 100 * finding.explained
        refusals.append(f"it explains {percent:.1f} % of the squared residual only")
    if finding.error_fall < gates.error_fall and not may_be_small:
        percent = -100 * finding.error_fall
        refusals.append(f"the error on left-out moves changes by {percent:+.1f} % only")
    if finding.left_out_fall <= 0.0:
        refusals.append("the error on left-out moves does not fall")
    if finding.impossible:
        refusals.append(finding.impossible)
    if not refusals:
        return finding
    return replace(finding, passed=False, refusals=tuple(refusals), too_few_moves=too_few_moves)


def _may_be_noise(finding: Finding, gates: Gates) -> bool:
    """Whether noise alone makes such a candidate too often, or there is no test of it."""
    if finding.probability is None:
        return True
    is_strong = finding.folds_better >= gates.strong_folds
    if is_strong and finding.error_fall >= gates.strong_fall:
        return finding.probability > gates.strong_false_alarm
    return finding.probability > gates.false_alarm


def _may_be_small(finding: Finding) -> bool:
    """Whether it counts however little it explains of one motor: a mistake of the geometry does.

    Such a mistake is spread over all motors, and bends gains.
    """
    if isinstance(finding.effect, LatePosition):
        is_certain = certain_delays(finding.coefficients, finding.deviations)
        return bool(is_certain.all())
    return isinstance(finding.effect, GeometryEffect)


def _share_of_excess(
    search_problem: SearchProblem, motor_squares: MotorSquares, trial: CandidateTrial, motor: int
) -> float | None:
    """Share of a motor's squared residual beyond its noise; see `Finding.share_of_excess`."""
    floor_a = search_problem.floors_a[motor]
    if floor_a is None:
        return None
    problem = search_problem.folds.linearisation
    # The residual is whitened by σ: the square of a row of noise alone is (floor/σ)² on average.
    noise_square = float(problem.effective_rows(motor) * (floor_a / problem.noise[motor]) ** 2)
    excess = float(motor_squares.residual[motor]) - noise_square
    if excess <= 0.0:
        return None
    return min(float(trial.fall_by_motor[motor]) / excess, 1.0)


def _ruled_out(effect: Effect, trial: CandidateTrial, fewest: int) -> str:
    """Name the coefficients that are impossible.

    A coefficient may be outside of what physics allows by SIGMAS. A form with more of them than the
    simplest of its family has no such tolerance: where two columns are nearly collinear, each σ is
    large enough to excuse any value, however certain both together are. The rest of a rotor keeps
    it: it is fitted only to say how well the rotor is known, and may well be zero.
    """
    is_richer = len(effect.coefficients) > fewest
    if is_richer and not effect.fits_rotor:
        tolerance = 0.0
    else:
        tolerance = SIGMAS
    return impossible(effect.coefficients, trial.coefficients, trial.deviations, tolerance)


def bootstrap_probabilities(
    trials: tuple[CandidateTrial, ...], rng: np.random.Generator, draws: int
) -> FloatArray:
    """Probability that noise alone makes a candidate as strong, of each candidate, shape (n,).

    It is the share of draws of random signs of the moves in which the largest Wald statistic of all
    candidates is as large as the candidate's own, on the scale of `_surprise` (wild cluster
    bootstrap, Cameron, Gelbach & Miller 2008). So it is a p-value for the complete search.

    A candidate that rests on few moves has draws with a heavy tail, in which no other one would
    stand out. It is tested without the moves of most leverage where the other moves are enough.
    Where they are not, it must exceed the draws of all candidates, while those that rest on many
    moves need exceed only each other. It has no probability (NaN) where too few moves are left for
    any test.
    """
    moves = len(trials[0].scatter)
    signs = rng.choice((-1.0, 1.0), size=(draws, moves))
    of_many: dict[int, Tested] = {}
    of_few: dict[int, Tested] = {}
    for number, trial in enumerate(trials):
        if moves_behind(trial.gram) >= FEW_MOVES:
            of_many[number] = trial
        elif trial.without_leverage is not None and is_tested_on_others(trial.without_leverage):
            of_many[number] = trial.without_leverage
        elif moves_behind(trial.gram) >= FEWEST_MOVES:
            of_few[number] = trial
    probability = np.full(len(trials), np.nan)
    # The largest surprise of each draw: of the first group, then of both.
    largest = np.zeros(draws)
    for group in (of_many, of_few):
        observed, drawn = _surprises(list(group.values()), signs)
        largest = np.maximum(largest, drawn)
        as_surprising = np.sum(largest[None] >= observed[:, None], axis=1)
        probability[list(group)] = (1.0 + as_surprising) / (draws + 1.0)
    return probability


Tested = CandidateTrial | MoveScores
"""A candidate on all moves, or without those of most leverage."""


def _surprises(candidates: Sequence[Tested], signs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Surprise of candidates, shape (c,), and of the most surprising one of each draw, (draws,).

    The Wald statistic of a candidate is sᵀ(XᵀX)⁻¹s, with s = Φ⊥ᵀe and X its scatter by clusters
    (`ident.discovery.candidates`).

    Args:
        candidates: c of them.
        signs: s_m of each draw and cluster, shape (draws, moves).
    """
    widths = np.array([len(one.score) for one in candidates], dtype=np.int64)
    observed = np.empty(len(candidates))
    largest = np.zeros(len(signs))
    for freedom in np.unique(widths).tolist():
        numbers = np.flatnonzero(widths == freedom).tolist()
        alike = [candidates[number] for number in numbers]
        score = np.stack([one.score for one in alike])
        scatter = np.stack([one.scatter for one in alike])
        # X is of the fit with the candidate: otherwise its own torque would count as noise, the
        # more the stronger it is.
        covariance = np.swapaxes(scatter, 1, 2) @ scatter
        inverse = np.linalg.pinv(covariance)
        wald = (score[:, None] @ inverse @ score[:, :, None])[:, 0, 0]
        if freedom == 1:
            gram = np.stack([one.gram[:, 0, 0] for one in alike], axis=1)
            drawn = _drawn_numbers(scatter[:, :, 0].T, gram, signs)
        else:
            drawn = reduce(np.maximum, (_drawn_wald(one, signs) for one in alike))
        # On the scale of −log p, candidates with one and with two coefficients compare.
        observed[numbers] = _surprise(wald, freedom)
        largest = np.maximum(largest, _surprise(drawn, freedom))
    return observed, largest


def _surprise(wald: FloatArray, freedom: int) -> FloatArray:
    """−log p of χ² statistics, finite however large they are."""
    p = scipy.special.chdtrc(freedom, wald)
    return np.asarray(-np.log(np.maximum(p, TINY)))


def _drawn_wald(trial: Tested, signs: FloatArray) -> FloatArray:
    """Wald statistic Sᵀ L⁻¹ S of each draw, shape (draws,).

    In a draw, the noise x_m of each move m becomes s_m x_m. The sum S = Σ s_m x_m is taken for an
    effect β = G⁻¹S, which leaves l_m = s_m x_m − G_m β in move m, and L = Σ l_m l_mᵀ. Each draw has
    an L of its own (studentised wild bootstrap, Cameron, Gelbach & Miller 2008): with one for all
    draws, few moves would look too certain.
    """
    x = trial.scatter
    gram = trial.gram
    moves, p = x.shape
    sums = signs @ x  # S
    beta = sums @ np.linalg.pinv(gram.sum(axis=0))
    # The three terms of L = Σ x_m x_mᵀ − Σ s_m(…) + Σ (G_m β)(G_m β)ᵀ. Symmetric matrices are
    # stored by their lower triangle: entry (row, column) of each.
    row, column = np.tril_indices(p)
    # Σ_m x_m x_mᵀ, the same in all draws.
    fixed = (x.T @ x)[row, column]
    # Σ_m s_m (x_m (G_m β)ᵀ + (G_m β) x_mᵀ), linear in β.
    mixed = gram[:, column] * x[:, row, None]
    mixed = mixed + gram[:, row] * x[:, column, None]
    drawn_mixed = signs @ mixed.reshape(moves, -1)
    crossed = drawn_mixed.reshape(-1, len(row), p) @ beta[:, :, None]
    # Σ_m (G_m β)(G_m β)ᵀ, linear in ββᵀ: one matrix for all draws.
    flat = gram.reshape(moves, -1)
    products = (flat.T @ flat).reshape(p, p, p, p)
    squares = products[row[:, None], row, column[:, None], column]
    mirrored = products[row[:, None], column, column[:, None], row]
    squares += np.where(row == column, 0.0, mirrored)
    beta_squares = beta[:, row] * beta[:, column]
    scatter = np.empty((len(signs), p, p))  # L
    scatter[:, row, column] = fixed - crossed[:, :, 0] + beta_squares @ squares.T
    scatter[:, column, row] = scatter[:, row, column]
    # L is singular where a coefficient does not scatter in a draw.
    trace = np.trace(scatter, axis1=1, axis2=2)
    scatter += 1e-12 * trace[:, None, None] * np.eye(p)
    solution = np.linalg.solve(scatter, sums[:, :, None])[:, :, 0]
    return np.asarray(np.sum(sums * solution, axis=1))


def _drawn_numbers(x: FloatArray, gram: FloatArray, signs: FloatArray) -> FloatArray:
    """The largest of `_drawn_wald` of candidates with one coefficient each, shape (draws,).

    Args:
        x: x_m of each candidate, shape (moves, c).
        gram: G_m, shape (moves, c).
        signs: s_m, shape (draws, moves).
    """
    sums = signs @ x
    beta = sums / gram.sum(axis=0)
    # Σ_m (s_m x_m − G_m β)² = Σ_m x_m² − 2 β Σ_m s_m x_m G_m + β² Σ_m G_m².
    fixed = np.sum(x**2, axis=0)
    crossed = signs @ (x * gram)
    squares = np.sum(gram**2, axis=0)
    scatter = fixed - 2.0 * beta * crossed + beta**2 * squares
    wald = sums**2 / scatter
    return np.asarray(np.max(wald, axis=1))


def _golden_section(
    search_problem: SearchProblem, effect: Effect, axis: int, name: str, lower: float, upper: float
) -> Effect:
    """Refine one setting between two bounds where that lowers ‖e‖²; see `refine_setting`."""
    a = float(np.log(lower))
    b = float(np.log(upper))

    def fall(log_value: float) -> float:
        """In-sample fall of ‖e‖² of all motors."""
        changed = effect.with_settings({name: float(np.exp(log_value))})
        (fit,) = search_problem.fits([search_problem.torque(changed, axis)])
        if fit is None:
            return -np.inf
        return float(fit.fall_by_motor.sum())

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
    middle = np.exp((a + b) / 2.0)
    best = float(f"{middle:.4g}")
    given = effect.settings[name]
    if fall(np.log(best)) > fall(np.log(given)):
        return effect.with_settings({name: best})
    return effect
