"""Whether the description of a robot, or the clock of its recordings, is wrong:
without a search, correcting nothing.

Zeros of joints, the direction of gravity, late positions and late currents are tested on the rows
of a fit (`ident.effects.geometry_corrections`, `ident.discovery.late_currents`). Where one of them
passes, it must also lower the error on left-out moves more than every named effect of one axis; or,
with the best of these effects in the model, it must still explain most of what it does alone. A
spring that the model lacks explains a part of what a wrong zero does; friction that it lacks on
another axis does not. What is left is fitted together with everything else, and must pass by the σ
of that fit, which is the one that is reported.

Two zeros that are wrong at once bend each other's numbers: alone, one of them takes over a part of
the other. So the test is repeated beside what it has found until it finds nothing more, and all
numbers are those of one fit together. Two that are wrong by opposite amounts turn only the link
between them, and neither passes alone (`ident.discovery.pairs_of_zeros`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.alike_corrections import alike_corrections, axes_to_move, explains_beside
from ident.discovery.candidates import FamilyTrials, SearchProblem, folds_around
from ident.discovery.evidence import Evidence, coefficients_of, with_effects
from ident.discovery.gates import (
    Gates,
    certain_delays,
    covariance_of,
    impossible,
    in_noise,
    own_unknowns,
)
from ident.discovery.joining import FIT_ERRORS, INSTRUMENT_CONFIDENCE, refuted_by_instruments
from ident.discovery.late_currents import (
    Delay,
    find_late_currents,
    rough_torque_rates,
    torque_rates,
    try_delays,
    with_delays,
)
from ident.discovery.pairs_of_zeros import PairOfZeros, pairs_that_pass, try_pairs
from ident.discovery.search import Finding, rank_families
from ident.effects.dictionary import GEOMETRY
from ident.effects.effect import Effect, PlacedEffect, effect_torque, fits_data, is_placeable
from ident.effects.electrical import Lag, TimeSkew
from ident.effects.geometry_corrections import (
    GeometryEffect,
    GravityDirection,
    LatePosition,
    ZeroOffset,
    turned_gravity,
)
from ident.effects.own import search_families
from ident.effects.signals import Abscissa, Signals, fitted_signals, session_began_s
from ident.equations.rows import at_rows
from ident.errors import TooFewMoves
from ident.estimators.estimate import Estimate
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.model.robot import JointKind, Robot

AT_ROWS = frozenset(
    {
        Abscissa.VELOCITY,
        Abscissa.POSITION,
        Abscissa.LOAD,
        Abscissa.TIME,
        Abscissa.SESSION,
        Abscissa.CURRENT,
    }
)
"""Variables of the effects that a correction competes with:
they change slowly enough to be built at the rows.
"""
CLOCK = (Lag, TimeSkew, LatePosition)  #: Effects of signals that are recorded at different times
LARGEST_ZERO_STD_RAD = 0.007
"""Largest σ with which a zero that is wrong by 2° is still named, 0.4°;
usual are some hundredths of a degree.
"""
LARGEST_ZERO_STD_M = 0.0012  #: The same of a slide whose zero is wrong by 6 mm
LEAST_DELAY_S = 5e-4  #: Shortest delay of a current that is named: less is a filter of the drive
LEAST_EARLY_SHARE = Gates().smallest_share
"""Share of its motor's squared residual that an early current of a single axis must explain,
as any effect of a search.
"""
MOST_ROUNDS = 4  #: Tests one after the other, each with the mistakes found before in its model
LEAST_SETTLED_STD = 0.1
"""Least σ of a correction in the joint fit, relative to the σ of its column to first order.

Where gravity leans and a joint hardly moves, a base parameter of the corrected robot has the same
column as the correction. The fit then puts the correction into that parameter, and the σ that it
gives the correction itself is one of rounding errors.
"""


@dataclass(frozen=True, slots=True)
class Gravity:
    """Direction of gravity as the torques show it, beside the declared one."""

    declared_m_s2: FloatArray  #: in the base frame, shape (3,)
    found_m_s2: FloatArray  #: of the same length, shape (3,)
    turn_rad: float  #: angle between both
    turn_std_rad: float  #: its σ
    #: of the turn about both axes of `ident.effects.geometry_corrections.across`, (2, 2)
    covariance_rad2: FloatArray


@dataclass(frozen=True, slots=True)
class AlikeCorrections:
    """Corrections of which the data show that one is needed, and not which."""

    #: the mistake that was found, then those that explain the same; at least two
    findings: tuple[Finding, ...]
    #: axes that must turn further, so that other data tell these apart
    axes_to_move: tuple[int, ...]

    def contain(self, placed: PlacedEffect) -> bool:
        """Whether a correction is one of them."""
        return any(found.placed == placed for found in self.findings)


@dataclass(frozen=True, slots=True)
class GeometryCheck:
    """What a fit says of the description of its robot, and of the clock of its recordings."""

    gravity: Gravity | None  #: None where the data do not show it, as in a plane that is level
    #: Corrections of the description and of the clock that the data ask for, by one fit of all of
    #: them.
    mistakes: tuple[Finding, ...]
    #: axes whose zero the data cannot show: another one makes nearly the same torques
    hidden_zeros: tuple[int, ...]
    alike: tuple[AlikeCorrections, ...] = ()  #: of each mistake that does not stand alone
    #: axes whose zeros are seen one by one, and not both at once
    hidden_pairs: tuple[tuple[int, int], ...] = ()

    @property
    def certain_mistakes(self) -> tuple[Finding, ...]:
        """Mistakes that the data tell apart from every other correction."""
        certain: list[Finding] = []
        for mistake in self.mistakes:
            has_rival = any(alike.contain(mistake.placed) for alike in self.alike)
            if not has_rival:
                certain.append(mistake)
        return tuple(certain)


@dataclass(frozen=True, slots=True)
class _Round:
    """One test with the mistakes that earlier tests have found in the model."""

    evidence: Evidence  #: the fit that it was made on
    problem: SearchProblem
    findings: tuple[Finding, ...]  #: of all corrections, the best first
    pairs: tuple[PairOfZeros, ...]  #: of zeros that the data each show alone, wrong or not
    settled: _Settled | None  #: what it has found; None for nothing


@dataclass(frozen=True, slots=True)
class _Settled:
    """Mistakes by the fit that has them in its model."""

    mistakes: tuple[Finding, ...]
    corrected: Evidence  #: with these mistakes corrected


@dataclass(frozen=True, slots=True)
class _Suspect:
    """A mistake that may explain the residual, to first order."""

    effects: tuple[PlacedEffect, ...]  #: one; two zeros; or the delays of several currents
    torque_nm: FloatArray  #: their columns as joint torque per unit coefficient, shape (m, p, r)
    values: FloatArray  #: their coefficients, shape (p,)
    left_out_fall: float  #: fall of the whitened ‖e‖² on left-out moves

    @classmethod
    def of_pair(cls, problem: SearchProblem, pair: PairOfZeros) -> _Suspect:
        """The suspicion that both zeros of a pair are wrong."""
        fall = float(pair.fall(problem).sum())
        return cls(pair.effects, pair.torque_nm, pair.trial.coefficients, fall)

    @property
    def is_pair(self) -> bool:
        """Whether it is two zeros that hide each other."""
        return len(self.effects) > 1 and not self.is_of_currents

    @property
    def is_of_currents(self) -> bool:
        """Whether currents are late."""
        return isinstance(self.effects[0].effect, Delay)

    def explains_beside(self, problem: SearchProblem, rival_nm: FloatArray) -> bool:
        """Whether it explains most of what it does beside a rival, too."""
        return explains_beside(problem, self.torque_nm, self.left_out_fall, rival_nm)


@dataclass(frozen=True, slots=True)
class _Rivals:
    """What suspects compete with."""

    #: of all effects, the suspects too; the best on left-out moves first
    findings: tuple[Finding, ...]
    #: columns (m, p, r) of the fast effects, which cannot be built at the rows
    at_full_rate: dict[PlacedEffect, FloatArray]

    def findings_of(self, effects: Sequence[PlacedEffect]) -> tuple[Finding, ...]:
        """Findings of some effects, in their order."""
        by_family = {(found.effect.name, found.axis): found for found in self.findings}
        return tuple(by_family[placed.effect.name, placed.axis] for placed in effects)

    def others(self, suspect: _Suspect) -> list[Finding]:
        """Findings that a suspect competes with, the best first.

        Delays of currents do not compete with each other: they were fitted together.
        """
        own = {(placed.effect.name, placed.axis) for placed in suspect.effects}
        others: list[Finding] = []
        for found in self.findings:
            is_own = (found.effect.name, found.axis) in own
            is_fellow_delay = suspect.is_of_currents and isinstance(found.effect, Delay)
            if not is_own and not is_fellow_delay:
                others.append(found)
        return others

    def has_better_fast(self, delay: Finding) -> bool:
        """Whether a fast effect of the axis of a delay passes, and explains more than it does."""
        if not isinstance(delay.effect, CLOCK):
            return False
        for found in self.findings:
            is_fast = found.placed in self.at_full_rate
            is_rival = is_fast and found.passed and _is_of_axis(found, delay)
            if is_rival and found.left_out_fall > delay.left_out_fall:
                return True
        return False

    def torque_nm(self, problem: SearchProblem, found: Finding) -> FloatArray:
        """Columns of a finding at the joints, shape (m, p, r)."""
        if found.placed in self.at_full_rate:
            return self.at_full_rate[found.placed]
        return problem.torque_at_rows(found.effect, found.axis)


def check_geometry(
    evidence: Evidence,
    rng: np.random.Generator,
    gates: Gates | None = None,
    own_effects: Sequence[Effect] = (),
) -> GeometryCheck:
    """Test geometry and clock beside a fit.

    Args:
        evidence: identified by ``ml``, from `gather`.
        rng: of the bootstrap.
        gates: limits for a mistake, those of a search; its share of one motor's residual is not
            among them.
        own_effects: that a mistake competes with, beside those of the dictionary and of installed
            packages.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
        EffectRefused: an effect of another package cannot be used.
    """
    families = search_families(own_effects)
    # No share of one motor's residual is asked for: a wrong zero is spread over all motors, and a
    # delay is judged by its length.
    gates = replace(gates or Gates(), explained=0.0, error_fall=0.0)
    first = _tested_once(evidence, families, rng, gates)
    rounds = [first]
    while len(rounds) < MOST_ROUNDS:
        settled = rounds[-1].settled
        if settled is None:
            break
        try:
            rounds.append(_tested_once(settled.corrected, families, rng, gates))
        except TooFewMoves:  # which moves are valid depends on the corrected description
            break
    mistakes = _in_one_fit(rounds)
    robot = evidence.model.robot
    return GeometryCheck(
        gravity=_gravity(evidence, first.problem),
        mistakes=mistakes,
        hidden_zeros=_hidden_zeros(first.findings, robot),
        hidden_pairs=_hidden_pairs(first.pairs, robot),
        alike=_all_alike(evidence, rounds, mistakes, rng, gates),
    )


def _tested_once(
    evidence: Evidence, families: Sequence[Sequence[Effect]], rng: np.random.Generator, gates: Gates
) -> _Round:
    """Test geometry and clock once; what the model has in it already is not tested.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    problem = _problem_at_rows(evidence)
    of_geometry = _without_second_delays(_tested(problem, GEOMETRY), evidence)
    # First with rates of torque that are rough but quick: where nothing passes, the test is over.
    rough_delays = try_delays(problem, rough_torque_rates(evidence))
    rough_delays = _without_second_delays(rough_delays, evidence)
    screened = rank_families(problem, (*of_geometry, *rough_delays), rng, gates)
    hidden = _hidden_zeros(screened, problem.model.robot)
    pairs = try_pairs(problem, [family for family in of_geometry if family.axis not in hidden])
    wrong_pairs = pairs_that_pass(problem, pairs, rng, gates)
    if not wrong_pairs and not any(found.passed for found in screened):
        return _Round(evidence, problem, screened, pairs, None)
    rates_nm_s = torque_rates(evidence)
    delays = _without_second_delays(try_delays(problem, rates_nm_s), evidence)
    tested = (*of_geometry, *delays)
    findings = rank_families(problem, tested, rng, gates)
    suspects = _suspects(problem, findings, delays, rates_nm_s)
    of_pairs = tuple(_Suspect.of_pair(problem, pair) for pair in wrong_pairs)
    rivals = _rivals(evidence, problem, families, tested, (*suspects, *of_pairs), rng, gates)
    # Pairs come second: two zeros always explain more than one, also where one is enough.
    settled = _first_that_stands(evidence, problem, suspects, rivals)
    if settled is None:
        settled = _first_that_stands(evidence, problem, of_pairs, rivals)
    return _Round(evidence, problem, findings, pairs, settled)


def _without_second_delays(
    tested: Sequence[FamilyTrials], evidence: Evidence
) -> tuple[FamilyTrials, ...]:
    """Trials without those of delays of signals that have a delay in the model already:
    a second one would only mend the form of the first.
    """
    others: list[FamilyTrials] = []
    for family in tested:
        effect, _ = family.members[0]
        if not _is_second_delay(PlacedEffect(effect, family.axis), evidence):
            others.append(family)
    return tuple(others)


def _is_second_delay(placed: PlacedEffect, evidence: Evidence) -> bool:
    """Whether the model has a delay of the same signals already."""
    if isinstance(placed.effect, TimeSkew):
        return any(isinstance(known.effect, TimeSkew) for known in evidence.effects)
    if not isinstance(placed.effect, CLOCK):
        return False
    of_axis = [known.effect for known in evidence.effects if known.axis == placed.axis]
    return any(isinstance(known, (Lag, LatePosition)) for known in of_axis)


def _in_one_fit(rounds: Sequence[_Round]) -> tuple[Finding, ...]:
    """Mistakes of all rounds that are not zero by the fit that corrects all of them,
    with values and σ of this fit.
    """
    settled = [one.settled for one in rounds if one.settled is not None]
    if not settled:
        return ()
    if len(settled) == 1:
        return settled[0].mistakes
    estimate = settled[-1].corrected.estimate
    mistakes: list[Finding] = []
    for found in chain.from_iterable(one.mistakes for one in settled):
        values, deviations = coefficients_of(estimate, found.placed)
        covariance = _covariance_of(estimate, found.placed)
        # What an earlier round found may have been a part of what a later one found.
        if not in_noise(values, covariance, INSTRUMENT_CONFIDENCE):
            mistakes.append(replace(found, coefficients=values, deviations=deviations))
    return tuple(mistakes)


def _all_alike(
    evidence: Evidence,
    rounds: Sequence[_Round],
    mistakes: Sequence[Finding],
    rng: np.random.Generator,
    gates: Gates,
) -> tuple[AlikeCorrections, ...]:
    """For each correction of the description, those that the data do not tell apart from it beside
    all others.
    """
    found: list[AlikeCorrections] = []
    for mistake in mistakes:
        if not isinstance(mistake.effect, GeometryEffect):
            continue
        others = tuple(one.placed for one in mistakes if one is not mistake)
        beside_others = _round_beside(rounds, evidence, others)
        if beside_others is None:
            try:
                beside_others = _ranked_beside(evidence, others, rng, gates)
            # TooFewMoves: which moves are valid depends on the corrected description.
            except (*FIT_ERRORS, TooFewMoves):
                continue
        alike = _alike(beside_others, mistake)
        if alike:
            placed = [one.placed for one in alike]
            axes = axes_to_move(placed, evidence.model.robot, evidence.fit_runs)
            found.append(AlikeCorrections(alike, axes))
    return tuple(found)


def _round_beside(
    rounds: Sequence[_Round], evidence: Evidence, others: Sequence[PlacedEffect]
) -> _Round | None:
    """The round with some mistakes and no others in its model; None where there was none."""
    effects = {*evidence.effects, *others}
    return next((one for one in rounds if set(one.evidence.effects) == effects), None)


def _ranked_beside(
    evidence: Evidence, others: tuple[PlacedEffect, ...], rng: np.random.Generator, gates: Gates
) -> _Round:
    """All corrections ranked with some mistakes in the model.

    Raises:
        NotConverged, RankDeficient: see `ident.identify`.
        TooFewMoves: there are too few moves to leave some out.
    """
    beside = with_effects(evidence, (*evidence.effects, *others))
    problem = _problem_at_rows(beside)
    findings = rank_families(problem, _tested(problem, GEOMETRY), rng, gates)
    return _Round(beside, problem, findings, (), None)


def _alike(beside: _Round, mistake: Finding) -> tuple[Finding, ...]:
    """A mistake and the corrections that the data do not tell apart from it;
    empty where it stands alone.
    """
    corrections = [found for found in beside.findings if isinstance(found.effect, GeometryEffect)]
    # As ranked in this round: its ambiguity names the corrections that folds do not distinguish
    # from it.
    ranked = next((one for one in corrections if one.placed == mistake.placed), None)
    if ranked is None:
        return ()
    others = alike_corrections(beside.problem, ranked, corrections)
    if not others:
        return ()
    alike = [mistake]
    for other in others:
        torque_nm = beside.problem.torque_at_rows(other.effect, other.axis)
        suspect = _Suspect((other.placed,), torque_nm, other.coefficients, other.left_out_fall)
        settled = _settled(beside.evidence, suspect, (other,))
        if settled is None:
            alike.append(other)
        else:
            alike.append(settled.mistakes[0])
    return tuple(alike)


def _suspects(
    problem: SearchProblem,
    findings: Sequence[Finding],
    of_currents: Sequence[FamilyTrials],
    rates_nm_s: FloatArray,
) -> tuple[_Suspect, ...]:
    """The mistakes that pass, the best on left-out moves first.

    Late currents are one suspect, whichever of them pass. They are a suspect also where a late
    position passes and no late current does: the delays of several currents, none of which passes
    alone, look like a late position.
    """
    suspects: list[_Suspect] = []
    passed = [found for found in findings if found.passed]
    for found in passed:
        is_late = isinstance(found.effect, LatePosition)
        if is_late and not certain_delays(found.coefficients, found.deviations).all():
            continue
        if not isinstance(found.effect, Delay):
            torque_nm = problem.torque_at_rows(found.effect, found.axis)
            suspects.append(
                _Suspect((found.placed,), torque_nm, found.coefficients, found.left_out_fall)
            )
    if any(isinstance(found.effect, CLOCK) for found in passed):
        late = find_late_currents(problem, of_currents, rates_nm_s)
        if late is not None:
            before = float(problem.folds.square_sum(problem.folds.residual).sum())
            fall = before - float(late.left_out.sum())
            suspects.append(_Suspect(late.effects, late.torque_nm, late.seconds, fall))
    return tuple(sorted(suspects, key=lambda one: -one.left_out_fall))


def _rivals(
    evidence: Evidence,
    problem: SearchProblem,
    families: Sequence[Sequence[Effect]],
    tested: Sequence[FamilyTrials],
    suspects: Sequence[_Suspect],
    rng: np.random.Generator,
    gates: Gates,
) -> _Rivals:
    """Test everything that the suspects compete with, and they themselves, each beside all others.

    A late current or position also competes with what is fast on its axis: presliding, a gear with
    a gap or a spring in it.
    """
    slow = (*tested, *_tested(problem, _slow(families)))
    late_axes: set[int] = set()
    for suspect in suspects:
        for placed in suspect.effects:
            if isinstance(placed.effect, CLOCK) and placed.effect.has_axis:
                late_axes.add(placed.axis)
    at_full_rate: dict[PlacedEffect, FloatArray] = {}
    if late_axes:
        at_full_rate = _columns_at_full_rate(evidence, families, sorted(late_axes))
    fast = problem.test_each(at_full_rate, at_full_rate.values())
    findings = rank_families(problem, (*slow, *fast), rng, gates)
    return _Rivals(findings, at_full_rate)


def _first_that_stands(
    evidence: Evidence, problem: SearchProblem, suspects: Sequence[_Suspect], rivals: _Rivals
) -> _Settled | None:
    """The best suspect that stands beside all rivals, and in the joint fit;
    None where none does.
    """
    for suspect in suspects:
        own = rivals.findings_of(suspect.effects)
        # It passed among the corrections, and must pass again among all rivals.
        if not suspect.is_pair and not any(found.passed for found in own):
            continue
        best = suspects[0]
        if suspect is not best and not suspect.explains_beside(problem, best.torque_nm):
            continue
        if not _stands_beside(problem, suspect, own, rivals):
            continue
        settled = _settled(evidence, suspect, own)
        if settled is not None:
            return settled
    return None


def _stands_beside(
    problem: SearchProblem, suspect: _Suspect, own: Sequence[Finding], rivals: _Rivals
) -> bool:
    """Whether a suspect explains more than every rival, or most of that with the best one fitted.

    The delay of each late current must stand in this way beside the effects of its own axis, too. A
    spring or a gap in a gear explains what a delay does, and more: where one passes and explains
    more than a delay of its axis, the delay is not named before that effect is in the model.

    Args:
        problem: around the fit.
        suspect: the mistake.
        own: the finding of each of its effects alone.
        rivals: everything else.
    """
    others = rivals.others(suspect)
    if not others:  # no other effect could be fitted
        return True
    best = others[0]
    is_best = suspect.left_out_fall >= best.left_out_fall
    if not is_best and not suspect.explains_beside(problem, rivals.torque_nm(problem, best)):
        return False
    if any(rivals.has_better_fast(found) for found in own):
        return False
    if not suspect.is_of_currents:
        return True
    for index, delay in enumerate(own):
        of_axis = [other for other in others if _is_of_axis(other, delay)]
        if not of_axis or of_axis[0].left_out_fall <= delay.left_out_fall:
            continue
        column_nm = suspect.torque_nm[:, [index]]
        rival_nm = rivals.torque_nm(problem, of_axis[0])
        if not explains_beside(problem, column_nm, delay.left_out_fall, rival_nm):
            return False
    return True


def _is_of_axis(other: Finding, found: Finding) -> bool:
    """Whether a finding is an effect on the axis of another one, and no correction of the arm."""
    is_same = found.effect.has_axis and other.axis == found.axis
    return is_same and not isinstance(other.effect, GeometryEffect)


def _settled(evidence: Evidence, suspect: _Suspect, own: Sequence[Finding]) -> _Settled | None:
    """A suspect with values and σ of a fit with it in the model; None where it does not stand.

    A column is linear in the mistake, and so exact for a small one only: the fit corrects the
    robot, builds the column again, and repeats this until nothing is left to correct. By the σ of
    that fit, the mistake must not be zero, and it must be possible; and instruments from the
    demanded motion must not show that a disturbance in the position loop looks like it. A mistake
    without such a fit has no size that could be reported.

    Args:
        evidence: without it.
        suspect: the mistake.
        own: the finding of each of its effects alone.
    """
    try:
        if suspect.is_of_currents:
            corrected = with_delays(evidence, suspect.effects, suspect.values)
        else:
            corrected = with_effects(evidence, (*evidence.effects, *suspect.effects))
    except FIT_ERRORS:
        return None
    estimate = corrected.estimate
    mistakes: list[Finding] = []
    added = corrected.effects[-len(own) :]  # the suspect's, behind those of the model
    for found, placed in zip(own, added, strict=True):
        values, deviations = coefficients_of(estimate, placed)
        covariance = _covariance_of(estimate, placed)
        settled = replace(found, effect=placed.effect, coefficients=values, deviations=deviations)
        if np.any(deviations < LEAST_SETTLED_STD * found.deviations):
            # A parameter of the corrected robot has taken the correction up (LEAST_SETTLED_STD):
            # the values to first order stay.
            settled = found
            covariance = np.diag(found.deviations**2)
        if impossible(settled.effect.coefficients, settled.coefficients, settled.deviations):
            continue
        if suspect.is_of_currents and _is_unlikely_delay(settled):
            continue
        if in_noise(settled.coefficients, covariance, INSTRUMENT_CONFIDENCE):
            continue
        if isinstance(placed.effect, CLOCK) and refuted_by_instruments(corrected, placed):
            continue
        mistakes.append(settled)
    # Of a pair both must stand: one zero alone had its own test, and did not pass.
    is_half_a_pair = suspect.is_pair and len(mistakes) < len(own)
    if not mistakes or is_half_a_pair:
        return None
    return _Settled(tuple(mistakes), corrected)


def _is_unlikely_delay(found: Finding) -> bool:
    """Whether the delay of currents is too short to be named,
    or is one that no drive has and that explains little.

    A filter of a drive makes its current late. One that is early is a mistake of stamps, which is
    large; less is what another effect leaves, or a loop that answers to the noise of its encoder.
    """
    delay_s = float(found.coefficients[0])
    if abs(delay_s) < LEAST_DELAY_S:
        return True
    is_early_alone = delay_s < 0.0 and isinstance(found.effect, Lag)
    return is_early_alone and found.explained < LEAST_EARLY_SHARE


def _covariance_of(estimate: Estimate, placed: PlacedEffect) -> FloatArray:
    """Covariance of the coefficients of an effect in a fit, shape (p, p)."""
    return covariance_of(estimate, own_unknowns(estimate, (placed,)))


def _gravity(evidence: Evidence, problem: SearchProblem) -> Gravity | None:
    """The direction of gravity by a fit of it together with everything else;
    None where that fit shows none.
    """
    placed = PlacedEffect(GravityDirection(), 0)
    torque_nm = problem.torque_at_rows(placed.effect, placed.axis)
    (trial,) = problem.trials([torque_nm])
    if trial is None:
        return None
    training = evidence.training.extended(placed.columns, torque_nm)
    try:
        estimate = estimate_with(Method.ML, training.system(), evidence.estimate.fixed_gains)
    except FIT_ERRORS:
        return None
    declared_m_s2 = evidence.model.robot.gravity_m_s2
    turn, _ = coefficients_of(estimate, placed)
    angle = float(np.linalg.norm(turn))
    # σ is that along the turn that was found; any direction will do for no turn at all.
    direction = np.array([1.0, 0.0])
    if angle > 0.0:
        direction = turn / angle
    covariance_rad2 = _covariance_of(estimate, placed)
    return Gravity(
        declared_m_s2=declared_m_s2,
        found_m_s2=turned_gravity(declared_m_s2, turn.tolist()),
        turn_rad=angle,
        turn_std_rad=float(np.sqrt(direction @ covariance_rad2 @ direction)),
        covariance_rad2=covariance_rad2,
    )


def _hidden_zeros(findings: Sequence[Finding], robot: Robot) -> tuple[int, ...]:
    """Axes whose zero could be wrong by 2°, or 6 mm, without being named."""
    std_of_axis: dict[int, float] = {}
    for found in findings:
        if isinstance(found.effect, ZeroOffset):
            std_of_axis[found.axis] = float(found.deviations[0])
    hidden: list[int] = []
    for axis in range(robot.axis_count):
        if not is_placeable(ZeroOffset(), axis, robot):
            continue
        # Without a finding the declared model makes the same torques.
        std = std_of_axis.get(axis, np.inf)
        if std > _largest_zero_std(robot, axis):
            hidden.append(axis)
    return tuple(hidden)


def _hidden_pairs(pairs: Sequence[PairOfZeros], robot: Robot) -> tuple[tuple[int, int], ...]:
    """Axes whose zeros could be wrong by opposite amounts without being named,
    although each alone would be.
    """
    hidden: list[tuple[int, int]] = []
    for pair in pairs:
        largest_std = np.array([_largest_zero_std(robot, axis) for axis in pair.axes])
        if np.any(pair.trial.deviations > largest_std):
            hidden.append(pair.axes)
    return tuple(hidden)


def _largest_zero_std(robot: Robot, axis: int) -> float:
    """Largest σ with which a wrong zero is still named [rad or m]."""
    if robot.axes[axis].kind is JointKind.PRISMATIC:
        return LARGEST_ZERO_STD_M
    return LARGEST_ZERO_STD_RAD


def _tested(
    problem: SearchProblem, families: Sequence[Sequence[Effect]]
) -> tuple[FamilyTrials, ...]:
    """Trials of families on all axes, built at the rows."""
    tested: list[FamilyTrials] = []
    for axis in range(len(problem.model.robot.places)):
        fitting: list[list[Effect]] = []
        for family in families:
            placeable = [one for one in family if is_placeable(one, axis, problem.model.robot)]
            members = [one for one in placeable if fits_data(one, problem.rows, axis)]
            if members:
                fitting.append(members)
        tested += problem.test(fitting, axis, at_rows=True)
    return tuple(tested)


def _slow(families: Sequence[Sequence[Effect]]) -> tuple[Sequence[Effect], ...]:
    """Families whose columns can be built at the rows."""
    return tuple(
        family
        for family in families
        if family[0].abscissa in AT_ROWS and not family[0].needs_inertia
    )


def _fast(families: Sequence[Sequence[Effect]]) -> tuple[Sequence[Effect], ...]:
    """Families of one axis that look like a late current and are built at full rate."""
    found: list[Sequence[Effect]] = []
    for family in families:
        effect = family[0]
        is_through_links = effect.needs_inertia and effect.has_axis
        if effect.abscissa is Abscissa.DISTANCE or is_through_links:
            found.append(family)
    return tuple(found)


def _columns_at_full_rate(
    evidence: Evidence, families: Sequence[Sequence[Effect]], axes: Sequence[int]
) -> dict[PlacedEffect, FloatArray]:
    """Columns of the fast effects of some axes at the joints, shape (m, p, r) each."""
    model = evidence.model
    conditioning = evidence.conditioning
    began_s = session_began_s(evidence.fit_runs)
    placed: list[PlacedEffect] = []
    for family in _fast(families):
        for axis in axes:
            for effect in family:
                if is_placeable(effect, axis, model.robot):
                    placed.append(PlacedEffect(effect, axis))
    parts: dict[PlacedEffect, list[FloatArray]] = {one: [] for one in placed}
    for data in evidence.fit_runs:  # one after the other: signals at full rate are large
        signals = fitted_signals(model, data, evidence.training, evidence.estimate, began_s)
        for one in placed:
            parts[one].append(
                effect_torque(one.effect, one.axis, (signals,), (data,), conditioning, model)
            )
    return {one: np.concatenate(of_runs, axis=-1) for one, of_runs in parts.items()}


def _problem_at_rows(evidence: Evidence) -> SearchProblem:
    """The residual of a fit with signals of the decimated motion: a twentieth of the samples."""
    observation = evidence.training
    estimate = evidence.estimate
    began_s = session_began_s(evidence.fit_runs)
    rows: list[Signals] = []
    for data in evidence.fit_runs:
        slow = at_rows(data, evidence.conditioning)
        rows.append(
            fitted_signals(evidence.model, slow, observation, estimate, began_s, inertia=False)
        )
    folds, step = folds_around(evidence.model, observation, estimate)
    return SearchProblem(
        model=evidence.model,
        datasets=evidence.fit_runs,
        observation=observation,
        runs=tuple(rows),
        rows=tuple(rows),
        folds=folds,
        step=step,
        floors_a=(None,) * observation.axis_count,
    )
