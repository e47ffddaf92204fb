"""From runs to an estimate, and from its residual to a model that lacks less: the whole way in two functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.conditioning import Conditioning
from ident.dataset import Dataset, differentiate
from ident.effects.effect import Effect
from ident.effects.torque import effect_torque
from ident.errors import DataUnfit
from ident.estimate import Estimate, Method
from ident.estimators.least_squares import ls, wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.total_least_squares import tls
from ident.model import Column, Model
from ident.observation import Observation, observe, require_distinct
from ident.relative_error import RelativeError
from ident.run import Run
from ident.search import Finding, Gates, find
from ident.signals import signals

FloatArray = NDArray[np.float64]

MAX_EFFECTS = 6
"""More than this on one robot means that the declared model is wrong, not that it lacks an effect."""


@dataclass(frozen=True, slots=True)
class PlacedEffect:
    """An effect on an axis (index from 0)."""

    effect: Effect
    axis: int

    @property
    def columns(self) -> tuple[Column, ...]:
        """Its linear parameters, named after effect, axis and settings: an axis may have cogging of two orders."""
        name, number = self.effect.name, self.axis + 1
        settings = ", ".join(f"{key} {value:.6g}" for key, value in self.effect.settings.items())
        suffix = f" ({settings})" if settings else ""
        return tuple(
            Column(f"{name} {column.name} {number}{suffix}", column.unit) for column in self.effect.coefficients
        )


@dataclass(frozen=True, slots=True)
class Identification:
    """An estimate with the rows it rests on, and the rows that it has not seen.

    Attributes:
        model: the declared model.
        datasets: of all runs, hold-out runs included.
        training: rows of the fit, with the columns of the effects.
        holdout: rows of the runs that were held out, None without any.
        effects: in the model, in the order of their columns.
        estimate: of the training rows.
        bare: rows of all runs, without effects.
        held_out: which of the datasets were held out.
    """

    model: Model
    datasets: tuple[Dataset, ...]
    training: Observation
    holdout: Observation | None
    effects: tuple[PlacedEffect, ...]
    estimate: Estimate
    bare: Observation
    held_out: tuple[int, ...]

    @property
    def training_error(self) -> RelativeError:
        """On the rows of the fit [%]."""
        return self.estimate.relative_error(self.training)

    @property
    def holdout_error(self) -> RelativeError | None:
        """On the rows that the fit has not seen [%]."""
        return None if self.holdout is None else self.estimate.relative_error(self.holdout)


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop: what was found, and the model with it."""

    findings: tuple[Finding, ...]
    accepted: Finding | None
    after: Identification


def estimate_with(method: Method, observation: Observation, fixed_gains: FloatArray | None = None) -> Estimate:
    """Run one estimator by its name.

    Raises:
        DataUnfit: ``tls`` with fixed gains: it has nothing to correct then.
    """
    if method is Method.LS:
        return ls(observation, fixed_gains)
    if method is Method.WLS:
        return wls(observation, fixed_gains)
    if method is Method.ML:
        return ml(observation, fixed_gains)
    if fixed_gains is not None:
        raise DataUnfit(", ".join(observation.runs), "tls needs free gains; with fixed gains choose ls, wls or ml")
    return tls(observation)


def identify(
    model: Model,
    runs: Sequence[Run],
    conditioning: Conditioning,
    *,
    holdout: Sequence[Run] = (),
    method: Method = Method.ML,
    fixed_gains: FloatArray | None = None,
) -> Identification:
    """One global step: all gains and all parameters from all runs.

    Args:
        model: the declared model.
        runs: of the fit: without load, and with a weighed payload where the gains are free.
        conditioning: the filters.
        holdout: runs that the fit must not see; their payload mountings must be among those of ``runs``.
        method: estimator.
        fixed_gains: known gains, shape (n,).

    Raises:
        DataUnfit, RankDeficient, NotConverged: see observation and estimators.
    """
    datasets = tuple(differentiate(run, model.drive_train, conditioning) for run in (*runs, *holdout))
    held_out = tuple(range(len(runs), len(datasets)))
    mounted = {run.payload.mounting for run in runs if run.payload is not None}
    for run in holdout:
        if run.payload is not None and run.payload.mounting not in mounted:
            mounting = f"mounting {run.payload.mounting!r}"
            raise DataUnfit(run.name, f"held out with {mounting}, which no run of the fit carries: it stays unknown")
    bare = observe(model, datasets, conditioning)
    training, rest = _parted(bare, held_out)
    require_distinct(training, gains=fixed_gains is None)
    estimate = estimate_with(method, training, fixed_gains)
    return Identification(model, datasets, training, rest, (), estimate, bare, held_out)


def with_effects(before: Identification, effects: tuple[PlacedEffect, ...]) -> Identification:
    """The same data with effects in the model, everything refitted, gains included.

    Load and current are the model's predictions, so the columns are built twice: with the estimate before, and with
    the estimate that they led to.
    """
    current = before
    fixed = before.estimate.gains if before.estimate.gains_fixed else None
    for _ in range(2):
        runs = [signals(before.model, data, current.training, current.estimate) for data in before.datasets]
        whole = before.bare
        for placed in effects:
            torque = effect_torque(placed.effect, placed.axis, runs, before.datasets, whole.conditioning, before.model)
            whole = whole.extended(placed.columns, torque)
        training, rest = _parted(whole, before.held_out)
        estimate = estimate_with(before.estimate.method, training, fixed)
        current = Identification(
            before.model, before.datasets, training, rest, effects, estimate, before.bare, before.held_out
        )
    return current


def close_the_loop(
    start: Identification,
    rng: np.random.Generator,
    gates: Gates | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Step, ...]:
    """Find what the residual asks for, add it, refit everything, and look again, until nothing passes the gates.

    Hold-out runs take no part in it.

    Args:
        start: identified by ``ml``.
        rng: of the bootstrap.
        gates: what a candidate must show.
        progress: told what is being done, in words.

    Returns:
        the turns taken; the last one has accepted nothing, unless MAX_EFFECTS was reached.
    """
    steps: list[Step] = []
    current = start
    trained = tuple(data for index, data in enumerate(start.datasets) if index not in start.held_out)
    for _ in range(MAX_EFFECTS):
        progress(f"looking for an effect beside {len(current.effects)} known")
        findings = find(current.model, trained, current.training, current.estimate, rng, gates)
        accepted = next((finding for finding in findings if finding.passed), None)
        if accepted is None:
            steps.append(Step(findings, None, current))
            break
        progress(f"adding {accepted.effect.name} on axis {accepted.axis + 1}")
        current = with_effects(current, (*current.effects, PlacedEffect(accepted.effect, accepted.axis)))
        steps.append(Step(findings, accepted, current))
    return tuple(steps)


def _parted(whole: Observation, held_out: tuple[int, ...]) -> tuple[Observation, Observation | None]:
    if not held_out:
        return whole, None
    rows = np.isin(whole.run, held_out)
    return whole.only(~rows), whole.only(rows)
