"""Find missing effects: add what the residual calls for, refit everything, and examine the new residual.

`find_effects` is the entry; `gather` prepares the rows behind an identification for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.discovery.candidates import ColumnCache, prepare_search
from ident.discovery.search import (
    MIN_MOVES_FOR_STRUCTURE,
    EffectKey,
    Finding,
    Gates,
    choose_effect,
    detection_limits_nm,
    effect_key,
    find_structure,
    is_inadequate,
    rank_effects,
    rank_families,
    refine_setting,
)
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect, effect_torque, joints_of
from ident.effects.signals import fitted_signals, session_began_s
from ident.equations.rows import Observation, observe
from ident.errors import NotConverged, RankDeficient
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.identify import Identification, estimate_with
from ident.model.model import Model

UNFITTED = (NotConverged, RankDeficient, np.linalg.LinAlgError)
MAX_EFFECTS = 12  #: More effects than this on one robot mean that the declared model is wrong


@dataclass(frozen=True, slots=True)
class Evidence:
    """An estimate with its rows at hand, for searches and plots."""

    model: Model  #: the declared model
    conditioning: Conditioning  #: the filters
    datasets: tuple[Dataset, ...]  #: all runs, held-out runs last
    held_out: int  #: number of held-out runs
    rows_without_effects: Observation  #: rows of all runs, without effects
    training: Observation  #: rows of the fit, with the columns of the effects
    holdout: Observation | None  #: rows of the held-out runs, None without any
    effects: tuple[PlacedEffect, ...]  #: in the model, in the order of their columns
    estimate: Estimate  #: of the training rows

    @property
    def trained(self) -> tuple[Dataset, ...]:
        """Runs of the fit."""
        return self.datasets[: len(self.datasets) - self.held_out]

    @property
    def identification(self) -> Identification:
        """The estimate with its equations reduced, effects among them."""
        holdout = None if self.holdout is None else self.holdout.system()
        return Identification(self.model, self.conditioning, self.training.system(), holdout, self.estimate)

    @property
    def holdout_error(self) -> RelativeError | None:
        """Error on held-out rows [%]."""
        return None if self.holdout is None else self.estimate.relative_error(self.holdout.system())


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop: the findings, and the model after it."""

    findings: tuple[Finding, ...]  #: named effects on all axes, the best on held-out moves first
    #: Smooth and periodic terms: on the axis of the best named effect, which must not be much worse than they are, or
    #: on all axes where no named effect passed.
    structures: tuple[Finding, ...]
    limits_nm: FloatArray  #: torque (root mean square) that a detectable effect has at each motor, shape (n,)
    accepted: Finding | None  #: the finding, or the structure without a name, that joined the model; None ends the loop
    after: Evidence  #: the model with it
    ended: str = ""  #: reason why the search ended here although the residual may call for more; else empty


def find_effects(
    start: Evidence,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] = EFFECTS,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Step, ...]:
    """Find effects that the model lacks, add them one by one, and refit everything after each.

    Each turn of the loop:

    1. linearises the problem around the estimate and deals whole moves to folds (`prepare_search`);
    2. tests every family of the dictionary on every axis: its columns, made from the motion and the predicted load and
       current, are projected off all declared directions, and the fall of the squared residual is measured in-sample
       and on held-out moves (`rank_effects`);
    3. passes a candidate only through all gates: larger than noise makes anywhere in the search, better on most folds,
       and large enough to matter (`Gates`);
    4. chooses the best on held-out moves, the simplest among equals (`choose_effect`);
    5. tests terms without a name, splines and motor harmonics, on the same axis, or on all axes if no named effect
       passed; one that explains much more replaces the named effect (`find_structure`, `is_inadequate`);
    6. refines its setting (`refine_setting`), adds it, and refits gains, parameters and effects together;
    7. drops earlier effects on the same joints that no longer pass the gates.

    It ends when nothing passes, or after MAX_EFFECTS. Held-out runs take no part in it.

    Args:
        start: identified by ``ml``, from `gather`.
        rng: of the bootstrap.
        gates: limits for a candidate.
        families: the dictionary.
        progress: called with a description of each step.

    Returns:
        the turns taken; the last one has accepted nothing, unless MAX_EFFECTS was reached.
    """
    gates = gates or Gates()
    steps: list[Step] = []
    current = start
    cache: ColumnCache = {}
    refused: dict[EffectKey, str] = {}
    for _ in range(MAX_EFFECTS):
        known = len(current.effects)
        progress("searching for a missing effect" + (f" beside the {known} found" if known else ""))
        search_problem = prepare_search(current.model, start.trained, current.training, current.estimate, cache)
        findings = rank_effects(search_problem, rng, gates, families)
        taken = frozenset((*refused, *(effect_key(placed.effect, placed.axis) for placed in current.effects)))
        accepted = choose_effect(findings, taken)
        axes = range(search_problem.axes) if accepted is None else (accepted.axis,)
        if accepted is None:
            progress("searching for structure that no named effect explains")
        structures = find_structure(search_problem, axes, rng, gates)
        best = choose_effect(structures, taken)
        if accepted is None or (best is not None and is_inadequate(accepted, best)):
            accepted = best
        limits_nm = detection_limits_nm(search_problem, gates)
        if accepted is None:
            moves, reasons = search_problem.folds.moves, [*refused.values()]
            if moves < MIN_MOVES_FOR_STRUCTURE:
                reasons.append(f"structure without a name needs {MIN_MOVES_FOR_STRUCTURE} moves, found {moves}")
            steps.append(Step(findings, structures, limits_nm, None, current, "; ".join(reasons)))
            break
        key = effect_key(accepted.effect, accepted.axis)
        accepted = replace(accepted, effect=refine_setting(search_problem, accepted.effect, accepted.axis, families))
        progress(f"adding {accepted.effect.name} on axis {accepted.axis + 1}")
        try:
            joined = with_effects(current, (*current.effects, PlacedEffect(accepted.effect, accepted.axis)))
        except UNFITTED as error:
            # The linearised problem distinguished the effect from the model, the whole one does not.
            refused[key] = f"{accepted.effect.name} on axis {accepted.axis + 1} cannot be added: {error}"
            progress(refused[key])
            continue
        current = _without_redundant(joined, rng, gates)
        steps.append(Step(findings, structures, limits_nm, accepted, current))
    if not steps:
        steps.append(Step(findings, structures, limits_nm, None, current, "; ".join(refused.values())))
    return tuple(steps)


def gather(found: Identification, runs: Iterable[Run], holdout: Iterable[Run] = ()) -> Evidence:
    """Build the rows behind an identification from its runs and held-out runs."""
    model, conditioning = found.model, found.conditioning
    trained = tuple(differentiate(run, model.drive_train, conditioning) for run in runs)
    unseen = tuple(differentiate(run, model.drive_train, conditioning) for run in holdout)
    rows = observe(model, (*trained, *unseen), conditioning, found.system)
    training, rest = _split_holdout(rows, len(unseen))
    return Evidence(model, conditioning, (*trained, *unseen), len(unseen), rows, training, rest, (), found.estimate)


def with_effects(before: Evidence, effects: tuple[PlacedEffect, ...]) -> Evidence:
    """Refit the same data with these effects in the model, gains included.

    Load and current are the model's predictions, so columns of them are built twice: with the estimate before, and
    with the estimate that they led to.
    """
    current, began_s = before, session_began_s(before.trained)  # held-out runs must not affect the fit
    fixed = before.estimate.gains if before.estimate.gains_fixed else None
    passes = 1 if all(placed.effect.abscissa.is_kinematic for placed in effects) else 2
    for _ in range(passes):
        runs = [
            fitted_signals(before.model, data, current.training, current.estimate, began_s) for data in before.datasets
        ]
        rows = before.rows_without_effects
        for placed in effects:
            torque = effect_torque(placed.effect, placed.axis, runs, before.datasets, rows.conditioning, before.model)
            rows = rows.extended(placed.columns, torque)
        training, rest = _split_holdout(rows, before.held_out)
        estimate = estimate_with(before.estimate.method, training.system(), fixed)
        current = replace(before, training=training, holdout=rest, effects=effects, estimate=estimate)
    return current


def without_effects(evidence: Evidence, estimate: Estimate) -> Evidence:
    """Return the same data under the declared model alone, with its estimate by ``ml``."""
    training, rest = _split_holdout(evidence.rows_without_effects, evidence.held_out)
    return replace(evidence, training=training, holdout=rest, effects=(), estimate=estimate)


def _split_holdout(observation: Observation, held_out: int) -> tuple[Observation, Observation | None]:
    """Split rows of all runs into those of the fit and those of the last, held-out runs."""
    if not held_out:
        return observation, None
    rows = observation.run >= len(observation.runs) - held_out
    return observation.only(~rows), observation.only(rows)


def _without_redundant(current: Evidence, rng: np.random.Generator, gates: Gates) -> Evidence:
    """Drop effects that the last one made redundant: earlier ones on its joints must pass the gates again."""
    *earlier, last = current.effects
    train = current.model.drive_train
    touched = joints_of(last.effect, last.axis, train)
    for placed in earlier:
        if not touched & joints_of(placed.effect, placed.axis, train):
            continue
        try:
            rest = with_effects(current, tuple(other for other in current.effects if other != placed))
        except UNFITTED:
            continue  # the data cannot be fitted without it
        search_problem = prepare_search(rest.model, rest.trained, rest.training, rest.estimate)
        findings = rank_families(search_problem, search_problem.test(((placed.effect,),), placed.axis), rng, gates)
        if not findings or not findings[0].passed:
            current = rest
    return current
