"""Whether the description of a robot is wrong, beside a fit: without a search, and without correcting anything.

Zeros of joints, the direction of gravity and late positions are tested on the rows of a fit
(`ident.effects.geometry_corrections`). Where one of them passes, it must also explain more of what is left out than
each named effect of one axis does, or most of it beside the best of these: a spring that the model lacks explains a
part of what a wrong zero does, and friction that it lacks on another axis does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.alike_corrections import alike_corrections, axes_to_move, explains_beside
from ident.discovery.candidates import FamilyTrials, SearchProblem, folds_around
from ident.discovery.evidence import Evidence, coefficients_of, with_effects
from ident.discovery.gates import Gates
from ident.discovery.search import Finding, rank_families
from ident.effects.dictionary import EFFECTS, GEOMETRY
from ident.effects.effect import Effect, PlacedEffect, is_placeable
from ident.effects.geometry_corrections import GravityDirection, ZeroOffset, turned_gravity
from ident.effects.signals import Abscissa, Signals, fitted_signals, session_began_s
from ident.equations.rows import at_rows
from ident.errors import IdentificationError

AT_ROWS = frozenset(
    {Abscissa.VELOCITY, Abscissa.POSITION, Abscissa.LOAD, Abscissa.TIME, Abscissa.SESSION, Abscissa.CURRENT}
)
"""Variables of the effects that a correction competes with: they change slowly enough to be built at the rows."""
SEEN_ZERO = 0.02  #: Largest σ of a zero that the data show, 1.1° or 20 mm; usual are some hundredths of a degree
LEAST_SETTLED_STD = 0.1
"""Least σ of a correction in the joint fit, in that of its column. Where gravity leans and a joint hardly moves, a base
parameter of the corrected robot is the same column as the turn itself, and leaves it a σ of rounding errors."""


@dataclass(frozen=True, slots=True)
class Gravity:
    """Direction of gravity as the torques show it, beside the declared one."""

    declared_m_s2: FloatArray  #: in the base frame, shape (3,)
    found_m_s2: FloatArray  #: of the same length, shape (3,)
    turn_rad: float  #: angle between both
    turn_std_rad: float  #: its σ


@dataclass(frozen=True, slots=True)
class GeometryCheck:
    """What a fit says of the description of its robot."""

    gravity: Gravity | None  #: None where the data do not show it, as in a plane that is level
    mistake: Finding | None  #: the correction that the data ask for; None where they ask for none
    hidden_zeros: tuple[int, ...]  #: axes whose zero the data cannot show: another one makes nearly the same torques
    #: The mistake and the corrections that the data do not tell apart from it; empty where the mistake stands alone.
    alike: tuple[Finding, ...] = ()
    axes_to_move: tuple[int, ...] = ()  #: axes that must turn further, so that other data tell these apart


def check_geometry(evidence: Evidence, rng: np.random.Generator, gates: Gates | None = None) -> GeometryCheck:
    """Test the geometry beside a fit.

    Args:
        evidence: identified by ``ml``, from `gather`.
        rng: of the bootstrap.
        gates: limits for a correction, those of a search.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    gates = gates or Gates()
    problem = _problem_at_rows(evidence)
    tested = _tested(problem, GEOMETRY)
    findings = rank_families(problem, tested, rng, gates)
    passed = [found for found in findings if found.passed]
    mistake = passed[0] if passed else None
    if mistake is not None:
        rivals = rank_families(problem, (*tested, *_tested(problem, _slow(EFFECTS))), rng, gates)
        best = max(rivals, key=lambda found: found.held_out_fall)
        is_best = (best.effect, best.axis) == (mistake.effect, mistake.axis)
        if not is_best and not explains_beside(problem, mistake, best):
            mistake = None
    alike: tuple[Finding, ...] = ()
    if mistake is not None:
        others = alike_corrections(problem, mistake, findings)
        mistake = _settled(evidence, mistake)
        if others:
            alike = (mistake, *(_settled(evidence, other) for other in others))
    zeros = [found for found in findings if isinstance(found.effect, ZeroOffset)]
    shown = {found.axis for found in zeros if found.deviations[0] < SEEN_ZERO}
    robot = evidence.model.robot
    can_be_wrong = [axis for axis in range(robot.axis_count) if is_placeable(ZeroOffset(), axis, robot)]
    return GeometryCheck(
        gravity=_gravity(findings, robot.gravity_m_s2),
        mistake=mistake,
        hidden_zeros=tuple(axis for axis in can_be_wrong if axis not in shown),
        alike=alike,
        axes_to_move=axes_to_move([PlacedEffect(one.effect, one.axis) for one in alike], robot, evidence.fit_runs),
    )


def _settled(evidence: Evidence, mistake: Finding) -> Finding:
    """A correction with the value that it has once it is applied to the description: its column is for small ones."""
    placed = PlacedEffect(mistake.effect, mistake.axis)
    try:
        corrected = with_effects(evidence, (*evidence.effects, placed))
    except IdentificationError:
        return mistake
    applied = corrected.effects[-1]
    values, deviations = coefficients_of(corrected.estimate, applied)
    if np.any(deviations < LEAST_SETTLED_STD * mistake.deviations):
        return mistake
    return replace(mistake, coefficients=values, deviations=deviations)


def _gravity(findings: Sequence[Finding], declared_m_s2: FloatArray) -> Gravity | None:
    """The direction of gravity among findings."""
    for found in findings:
        if isinstance(found.effect, GravityDirection):
            turn = found.coefficients
            angle = float(np.linalg.norm(turn))
            # σ along the turn that was found, its two components taken as independent; of no turn at all, any.
            along = turn / angle if angle > 0.0 else np.array([1.0, 0.0])
            return Gravity(
                declared_m_s2=declared_m_s2,
                found_m_s2=turned_gravity(declared_m_s2, turn.tolist()),
                turn_rad=angle,
                turn_std_rad=float(np.linalg.norm(along * found.deviations)),
            )
    return None


def _tested(problem: SearchProblem, families: Sequence[Sequence[Effect]]) -> tuple[FamilyTrials, ...]:
    """Trials of families on all axes, built at the rows."""
    tested: list[FamilyTrials] = []
    for axis in range(len(problem.model.robot.places)):
        fitting: list[tuple[Effect, ...]] = []
        for family in families:
            members = tuple(one for one in family if is_placeable(one, axis, problem.model.robot))
            fitting.append(tuple(one for one in members if one.fits_in(problem.rows, axis)))
        tested += problem.test([family for family in fitting if family], axis, at_rows=True)
    return tuple(tested)


def _slow(families: Sequence[Sequence[Effect]]) -> tuple[Sequence[Effect], ...]:
    """Families whose columns can be built at the rows."""
    return tuple(family for family in families if family[0].abscissa in AT_ROWS and not family[0].needs_inertia)


def _problem_at_rows(evidence: Evidence) -> SearchProblem:
    """The residual of a fit with signals of the decimated motion: a twentieth of the samples."""
    observation, estimate = evidence.training, evidence.estimate
    began_s = session_began_s(evidence.fit_runs)
    rows: list[Signals] = []
    for data in evidence.fit_runs:
        slow = at_rows(data, evidence.conditioning)
        rows.append(fitted_signals(evidence.model, slow, observation, estimate, began_s, inertia=False))
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
