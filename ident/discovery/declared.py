"""Add the effects that a cell declares: they are fitted, not searched for.

A declared effect must be possible: a balancer does not push where it must pull. Where its
coefficients are not, the declaration is refused, unless the geometry or the clock is the cause
(`ident.discovery.geometry_check`): the torque of a balancer and that of gravity are alike, so that
a base that leans by a degree makes a true balancer look impossible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.discovery.candidates import ColumnCache, FamilyTrials, score_candidates
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates, impossible, own_unknowns, values_of, without_effects_of
from ident.discovery.geometry_check import check_geometry
from ident.discovery.joining import FIT_ERRORS, JointFit, linearised, with_refined_settings
from ident.discovery.loop import Step
from ident.discovery.rotor_search import declared_forms
from ident.discovery.search import Finding, rank_families
from ident.discovery.structure import detection_limits_nm
from ident.effects.effect import PlacedEffect
from ident.errors import EffectImpossible, EffectRefused, TooFewMoves


def with_declared(
    start: Evidence,
    declared: Sequence[PlacedEffect],
    rng: np.random.Generator,
    axes: Sequence[str] = (),
) -> tuple[Step, ...]:
    """Add effects that the cell declares, and refit everything with each;
    settings that are refined are fitted, too.

    Args:
        start: identified by ``ml``, from `gather`, without effects.
        declared: the effects, with the settings to begin with.
        rng: of the bootstrap, for what the findings say, and of the geometry's test where an effect
            is impossible.
        axes: their names; those of the robot's joints when empty.

    Returns:
        a step an effect; a search that begins with the last one's evidence keeps them. Where the
        geometry is to blame, coefficients may be impossible until it is corrected: ask
        `impossible_declared` after a search.

    Raises:
        EffectImpossible: the coefficients of an effect are impossible.
        EffectRefused: the model contains an effect already.
        EffectRefused: a rotor's inertia is given where the load does not contain the rotor.
        NotConverged, RankDeficient: see `ident.identify`.
    """
    gates = Gates()
    cache = ColumnCache()
    evidence = start
    steps: list[Step] = []
    names = axes or [joint.name for joint in start.model.robot.places]
    for placed in declared:
        joined = _with_declared_form(evidence, declared_forms(placed, evidence.training, names))
        joined = replace(joined, declared=len(joined.effects))
        model = with_refined_settings(linearised(joined, cache))
        evidence = model.evidence
        finding = _finding_beside_others(model, evidence.effects[-1], rng, gates)
        if finding is None:
            name = placed.name_among(names)
            raise EffectRefused(
                f"the declared {name}: found it in the model already; expected each effect once on "
                "an axis; declare it once"
            )
        limits_nm = detection_limits_nm(model.search_problem, gates)
        steps.append(Step((), (), limits_nm, finding, evidence, declared=True))
    wrong = impossible_declared(evidence, names)
    if wrong and not _is_geometry_to_blame(evidence, rng, names):
        raise EffectImpossible(f"the declared {wrong}")
    return tuple(steps)


def impossible_declared(evidence: Evidence, axes: Sequence[str]) -> str:
    """Name the first declared effect with impossible coefficients, and say which;
    empty where all are possible.

    Args:
        evidence: with the declared effects first.
        axes: their names.
    """
    estimate = evidence.estimate
    for placed in evidence.effects[: evidence.declared]:
        own = own_unknowns(estimate, (placed,))
        wrong = impossible(
            placed.effect.coefficients, values_of(estimate, own), estimate.parameters_std[own]
        )
        if wrong:
            return f"{placed.name_among(axes)}: {wrong}"
    return ""


def _is_geometry_to_blame(
    evidence: Evidence, rng: np.random.Generator, axes: Sequence[str]
) -> bool:
    """Whether the data ask for another geometry or clock,
    and all declared effects are possible with it.
    """
    try:
        mistakes = check_geometry(evidence, rng).mistakes
    except TooFewMoves:
        return False
    if not mistakes:
        return False
    corrections = tuple(found.placed for found in mistakes)
    try:
        corrected = with_effects(evidence, (*evidence.effects, *corrections))
    except FIT_ERRORS:
        return False
    return not impossible_declared(corrected, axes)


def _with_declared_form(evidence: Evidence, forms: Sequence[PlacedEffect]) -> Evidence:
    """Refit with the first form of a declared effect that the data can fit;
    the last one must be possible.
    """
    *richer, plain = forms
    for form in richer:
        try:
            return with_effects(evidence, (*evidence.effects, form))
        except FIT_ERRORS:
            continue
    return with_effects(evidence, (*evidence.effects, plain))


def _finding_beside_others(
    model: JointFit, placed: PlacedEffect, rng: np.random.Generator, gates: Gates
) -> Finding | None:
    """What a declared effect explains beside all others in the model;
    None where they contain it.
    """
    reduced = without_effects_of(model.search_problem, model.evidence.estimate, (placed,))
    problem = reduced.search_problem
    columns = reduced.columns
    (trial,) = score_candidates(problem.folds, columns, (slice(0, columns.shape[1]),))
    if trial is None:
        return None
    (finding,) = rank_families(
        problem, (FamilyTrials(placed.axis, ((placed.effect, trial),)),), rng, gates
    )
    return finding
