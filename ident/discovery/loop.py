"""Closing the loop: what the residual asks for is added, everything is refitted, and the residual is asked again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.discovery.candidates import ColumnCache, prepare_search
from ident.discovery.search import (
    Finding,
    Gates,
    Place,
    choose_effect,
    place_of,
    rank_effects,
    rank_families,
    refine_setting,
)
from ident.discovery.structure import MIN_MOVES, detection_limits_nm, find_structure, is_inadequate
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.placement import effect_torque, joints_of
from ident.effects.signals import fitted_signals, session_began_s
from ident.equations.observation import Observation, observe
from ident.errors import NotConverged, RankDeficient
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.identify import Identification, estimate_with
from ident.model.model import Column, Model

FloatArray = NDArray[np.float64]

UNFITTED = (NotConverged, RankDeficient, np.linalg.LinAlgError)
MAX_EFFECTS = 12
"""More than this on one robot means that the declared model is wrong, not that it lacks an effect."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """An estimate with its rows at hand: what a search for effects, and a picture, looks into.

    Attributes:
        model: the declared model.
        conditioning: the filters.
        datasets: of all runs, hold-out runs last.
        held_out: how many of them were held out.
        bare: rows of all runs, without effects.
        training: rows of the fit, with the columns of the effects.
        holdout: rows of the runs that were held out, None without any.
        effects: in the model, in the order of their columns.
        estimate: of the training rows.
    """

    model: Model
    conditioning: Conditioning
    datasets: tuple[Dataset, ...]
    held_out: int
    bare: Observation
    training: Observation
    holdout: Observation | None
    effects: tuple[PlacedEffect, ...]
    estimate: Estimate

    @property
    def trained(self) -> tuple[Dataset, ...]:
        """The runs of the fit."""
        return self.datasets[: len(self.datasets) - self.held_out]

    @property
    def columns(self) -> tuple[Column, ...]:
        """Of W: base parameters, then effects."""
        return self.training.columns

    @property
    def training_error(self) -> RelativeError:
        """On the rows of the fit [%]."""
        return self.estimate.relative_error(self.training.system())

    @property
    def holdout_error(self) -> RelativeError | None:
        """On the rows that the fit has not seen [%]."""
        return None if self.holdout is None else self.estimate.relative_error(self.holdout.system())


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop: what was found, and the model with it.

    Attributes:
        findings: named effects on all axes, the best on left-out moves first.
        structures: smooth and periodic terms: on the axis of the best named effect, which must not be much worse than
            they are, or on all axes where no named effect passed.
        limits_nm: torque (root mean square) that an effect must have at each motor to be found, shape (n,).
        accepted: the finding, or the structure that no name was found for, that joined the model; None ends the loop.
        after: the model with it.
        ended: what, beside silence, ended the search here; empty where it was silence.
    """

    findings: tuple[Finding, ...]
    structures: tuple[Finding, ...]
    limits_nm: FloatArray
    accepted: Finding | None
    after: Evidence
    ended: str = ""


def gather(found: Identification, runs: Iterable[Run], holdout: Iterable[Run] = ()) -> Evidence:
    """The rows behind an identification.

    Args:
        found: from the same runs.
        runs, holdout: of the fit, and those that it has not seen.
    """
    model, conditioning = found.model, found.conditioning
    trained = tuple(differentiate(run, model.drive_train, conditioning) for run in runs)
    unseen = tuple(differentiate(run, model.drive_train, conditioning) for run in holdout)
    bare = observe(model, (*trained, *unseen), conditioning, found.system)
    training, rest = _parted(bare, len(unseen))
    return Evidence(model, conditioning, (*trained, *unseen), len(unseen), bare, training, rest, (), found.estimate)


def with_effects(before: Evidence, effects: tuple[PlacedEffect, ...]) -> Evidence:
    """The same data with effects in the model, everything refitted, gains included.

    Load and current are the model's predictions, so columns of them are built twice: with the estimate before, and
    with the estimate that they led to.
    """
    # Of the fit's runs: a hold-out must not move what is fitted.
    current, began_s = before, session_began_s(before.trained)
    fixed = before.estimate.gains if before.estimate.gains_fixed else None
    passes = 1 if all(placed.effect.abscissa.is_kinematic for placed in effects) else 2
    for _ in range(passes):
        runs = [
            fitted_signals(before.model, data, current.training, current.estimate, began_s) for data in before.datasets
        ]
        whole = before.bare
        for placed in effects:
            torque = effect_torque(placed.effect, placed.axis, runs, before.datasets, whole.conditioning, before.model)
            whole = whole.extended(placed.columns, torque)
        training, rest = _parted(whole, before.held_out)
        estimate = estimate_with(before.estimate.method, training.system(), fixed)
        current = replace(before, training=training, holdout=rest, effects=effects, estimate=estimate)
    return current


def find_effects(
    start: Evidence,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] = EFFECTS,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Step, ...]:
    """Find what the residual asks for, add it, refit everything, and look again, until nothing passes the gates.

    Hold-out runs take no part in it.

    Args:
        start: identified by ``ml``.
        rng: of the bootstrap.
        gates: what a candidate must show.
        families: the dictionary.
        progress: told what is being done, in words.

    Returns:
        the turns taken; the last one has accepted nothing, unless MAX_EFFECTS was reached.
    """
    gates = gates or Gates()
    steps: list[Step] = []
    current = start
    cache: ColumnCache = {}
    refused: dict[Place, str] = {}
    for _ in range(MAX_EFFECTS):
        known = len(current.effects)
        progress("looking for an effect that the model lacks" + (f" beside the {known} found" if known else ""))
        search_problem = prepare_search(current.model, start.trained, current.training, current.estimate, cache)
        findings = rank_effects(search_problem, rng, gates, families)
        taken = frozenset((*refused, *(place_of(placed.effect, placed.axis) for placed in current.effects)))
        accepted = choose_effect(findings, taken)
        axes = range(search_problem.axes) if accepted is None else (accepted.axis,)
        if accepted is None:
            progress("looking for structure that no named effect explains")
        structures = find_structure(search_problem, axes, rng, gates)
        best = choose_effect(structures, taken)
        if accepted is None or (best is not None and is_inadequate(accepted, best)):
            accepted = best
        limits_nm = detection_limits_nm(search_problem, gates)
        if accepted is None:
            few = search_problem.folds.moves < MIN_MOVES
            words = [
                f"{search_problem.folds.moves} moves are too few (of {MIN_MOVES}) to ask for what has no name"
            ] * few
            steps.append(Step(findings, structures, limits_nm, None, current, "; ".join((*refused.values(), *words))))
            break
        place = place_of(accepted.effect, accepted.axis)
        accepted = replace(accepted, effect=refine_setting(search_problem, accepted.effect, accepted.axis, families))
        progress(f"adding {accepted.effect.name} on axis {accepted.axis + 1}")
        try:
            joined = with_effects(current, (*current.effects, PlacedEffect(accepted.effect, accepted.axis)))
        except UNFITTED as error:
            # What the linearised problem told apart, the whole one does not.
            refused[place] = f"{accepted.effect.name} on axis {accepted.axis + 1} cannot be added: {error}"
            progress(refused[place])
            continue
        current = _without_idle(joined, rng, gates)
        steps.append(Step(findings, structures, limits_nm, accepted, current))
    if not steps:
        steps.append(Step(findings, structures, limits_nm, None, current, "; ".join(refused.values())))
    return tuple(steps)


def _without_idle(current: Evidence, rng: np.random.Generator, gates: Gates) -> Evidence:
    """Take out what the effect that joined last has made idle: earlier ones on its joints must pass the gates anew."""
    *earlier, last = current.effects
    train = current.model.drive_train
    felt = joints_of(last.effect, last.axis, train)
    for placed in earlier:
        if not felt & joints_of(placed.effect, placed.axis, train):
            continue
        try:
            rest = with_effects(current, tuple(other for other in current.effects if other != placed))
        except UNFITTED:
            continue  # what the data cannot be fitted without is not idle
        search_problem = prepare_search(rest.model, rest.trained, rest.training, rest.estimate)
        (finding, *_) = rank_families(
            search_problem, search_problem.test(((placed.effect,),), placed.axis), rng, gates
        ) or (None,)
        if finding is None or not finding.passed:
            current = rest
    return current


def _parted(whole: Observation, held_out: int) -> tuple[Observation, Observation | None]:
    if not held_out:
        return whole, None
    rows = whole.run >= len(whole.runs) - held_out
    return whole.only(~rows), whole.only(rows)
