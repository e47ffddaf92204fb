"""An estimate with the rows that it rests on, and its refits:
with effects, without, and by instruments.

`gather` makes it. The search (`ident.discovery.loop`) and the comparison of errors (`before_after`)
work on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ident.arrays import FloatArray, require_names, takes
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.demand import DemandCache, as_demanded, with_demand
from ident.data.run import Run, SeenRuns
from ident.data.run_channels import channels_of
from ident.discovery.gates import own_unknowns, values_of
from ident.effects.effect import PlacedEffect, effect_torque
from ident.effects.geometry_corrections import (
    GeometryEffect,
    corrected_dataset,
    corrected_model,
    is_correction,
)
from ident.effects.rotor import beside_rotors
from ident.effects.signals import Signals, fitted_signals, session_began_s
from ident.equations.observation import Observation, observe, on_demanded_motion
from ident.equations.reduction import mounting_index, reduce_built, regrouped
from ident.equations.rows import rows_of
from ident.equations.system import System
from ident.errors import ModelError
from ident.estimators.estimate import Estimate, Identification, RelativeError
from ident.estimators.identify import each_run, estimate_with
from ident.estimators.method import Method
from ident.model.model import Column, Model

#: Corrections of the geometry in one refit; a zero that is wrong by 2° settles in two
RELINEARISATIONS = 4
SETTLED = 0.1  #: Share of σ below which a further correction is not worth its time


@dataclass(frozen=True, slots=True)
class Uncorrected:
    """The description and the recordings as they were given."""

    model: Model  #: as declared
    datasets: tuple[Dataset, ...]  #: all runs, held-out runs last


@dataclass(frozen=True, slots=True)
class Evidence:
    """An estimate with its rows at hand, for searches and plots."""

    model: Model  #: the declared model, with the corrections
    conditioning: Conditioning  #: the filters
    datasets: tuple[Dataset, ...]  #: all runs, held-out runs last
    held_out: int  #: number of held-out runs
    rows_without_effects: Observation  #: rows of all runs, without effects
    training: Observation  #: rows of the fit, with the columns of the effects
    holdout: Observation | None  #: rows of the held-out runs, None without any
    effects: tuple[PlacedEffect, ...]  #: in the model, in the order of their columns
    estimate: Estimate  #: of the training rows
    #: how many of the effects, the first ones, the cell declares: no search takes them out
    declared: int = 0
    #: Effects whose applied part has corrected model, runs and rows
    #: (`ident.effects.geometry_corrections`).
    corrections: tuple[PlacedEffect, ...] = ()
    uncorrected: Uncorrected | None = None  #: as they were before; None where nothing was corrected
    #: demanded positions of the runs as they were given
    demands: DemandCache = field(default_factory=DemandCache, repr=False, compare=False)
    _identification: list[Identification] = field(
        default_factory=list, init=False, repr=False, compare=False
    )

    @property
    def fit_runs(self) -> tuple[Dataset, ...]:
        """Runs of the fit."""
        return self.datasets[: len(self.datasets) - self.held_out]

    @property
    def identification(self) -> Identification:
        """The estimate with its equations reduced, effects among them;
        kept, because reducing takes long.
        """
        if not self._identification:
            training = self.training.system()
            if self.holdout is None:
                holdout = None
            else:
                holdout = self.holdout.system()
            channels = tuple(channels_of(self.model, data) for data in self.fit_runs)
            found = Identification(
                self.model, self.conditioning, training, holdout, self.estimate, channels=channels
            )
            self._identification.append(found)
        return self._identification[0]

    @property
    def holdout_error(self) -> RelativeError | None:
        """Error on held-out rows [%]."""
        if self.holdout is None:
            return None
        return self.estimate.relative_error(self.holdout.system())


@takes(found=Identification, runs=Iterable, holdout=Iterable)
def gather(
    found: Identification, runs: Iterable[Run] = (), holdout: Iterable[Run] = ()
) -> Evidence:
    """Build the rows behind an identification from its runs and held-out runs,
    unless it has kept them.

    Raises:
        ModelError: the runs are not those of the fit, and the identification has kept none; or an
            argument is of another type.
        DataUnfit: a run is unfit, is given twice, or carries what no run of the fit has carried.
    """
    model = found.model
    conditioning = found.conditioning
    if found.gathered is None:
        seen = SeenRuns()
        trained = _differentiated(found, each_run(runs, seen, found.system.payloads))
        _require_runs_of_fit(found, trained)
        unseen = _differentiated(found, each_run(holdout, seen, found.system.payloads))
        datasets = (*trained, *unseen)
        rows = observe(model, datasets, conditioning, found.system)
        held_out = len(unseen)
    else:
        datasets, rows = found.gathered
        held_out = len(datasets) - len(found.system.runs)
    training, rest = _split_holdout(rows, held_out)
    evidence = Evidence(
        model, conditioning, datasets, held_out, rows, training, rest, (), found.estimate
    )
    evidence._identification.append(found)
    return evidence


def _differentiated(found: Identification, runs: Iterable[Run]) -> list[Dataset]:
    """Differentiate runs as those of a fit.

    Raises:
        DataUnfit: a run is unfit, or its mounting carried another payload in the fit.
    """
    payloads = list(found.system.payloads)
    differentiated: list[Dataset] = []
    for run in runs:
        mounting_index(run.payload, payloads, run.name)
        differentiated.append(differentiate(run, found.model.drive_train, found.conditioning))
    return differentiated


def _require_runs_of_fit(found: Identification, given: Sequence[Dataset]) -> None:
    """Refuse other runs than those of a fit.

    Raises:
        ModelError: some are missing, or were not in it.
    """
    names = tuple(data.name for data in given)
    if names == found.system.runs:
        return
    runs_given = ", ".join(names) or "no runs"
    of_fit = ", ".join(found.system.runs)
    raise ModelError(
        f"gather was given {runs_given}; expected the runs of the fit, {of_fit}, which it has not "
        "kept; write gather(found, [bare, loaded])"
    )


def place_names(model: Model, axes: Sequence[str]) -> list[str]:
    """Names of the places of effects (`Robot.places`) for messages.

    Args:
        model: of the robot.
        axes: names of the axes, or of all places; those of the robot's joints when empty.

    Raises:
        ModelError: they are no list of names, or of another number.
    """
    robot = model.robot
    own = [place.name for place in robot.places]
    if len(axes) == 0:
        return own
    if len(axes) != len(own):
        require_names("axes", axes, robot.axis_count)
    require_names("axes", axes)
    return [*axes, *own[len(axes) :]]


def with_effects(
    before: Evidence, effects: tuple[PlacedEffect, ...], runs: Sequence[Signals] = ()
) -> Evidence:
    """Refit the same data with these effects in the model, gains included.

    Load and current are the model's predictions, so columns of them are built twice: with the
    estimate before, and with the estimate that they led to. Where an effect corrects the geometry,
    its column is that of a small change: what it finds is applied to the description, and
    everything is built again, until nothing is left to apply.

    Args:
        before: the same data.
        effects: of the model. Those of the result may hold another applied part.
        runs: signals of the runs of the fit around the estimate before, where they are at hand.
    """
    return settled_corrections(with_first_order_effects(before, effects, runs))


def with_first_order_effects(
    before: Evidence, effects: tuple[PlacedEffect, ...], runs: Sequence[Signals] = ()
) -> Evidence:
    """As `with_effects`, but what a correction of the geometry finds is not applied to the
    description.
    """
    corrections = tuple(placed for placed in effects if is_correction(placed))
    if _is_same_geometry(before.corrections, corrections):
        return _refitted(before, effects, runs)
    return _refitted(with_corrections(before, corrections), effects, ())


def settled_corrections(found: Evidence) -> Evidence:
    """Apply what corrections of the geometry have found to the description and refit,
    until nothing is left to apply.

    Args:
        found: with effects; without a correction among them it is returned as it is.
    """
    for _ in range(RELINEARISATIONS):
        moved = _relinearised(found)
        if moved is None:
            break
        corrections = tuple(placed for placed in moved if is_correction(placed))
        found = _refitted(with_corrections(found, corrections), moved, ())
    return found


def with_corrections(before: Evidence, corrections: tuple[PlacedEffect, ...]) -> Evidence:
    """The same data under the declared model with other corrections, refitted without any effect.

    Rows and base parameters are built anew: where gravity is turned, other parameters can be seen.
    """
    given = before.uncorrected or Uncorrected(before.model, before.datasets)
    model = corrected_model(given.model, corrections)
    datasets = tuple(corrected_dataset(data, corrections) for data in given.datasets)
    conditioning = before.conditioning
    rows = [tuple(rows_of(model, data, conditioning)) for data in datasets]
    of_fit = zip(datasets[: len(datasets) - before.held_out], rows, strict=False)
    system = regrouped(reduce_built(model, of_fit, payloads=before.training.payloads))
    observation = observe(model, datasets, conditioning, system, rows)
    training, holdout = _split_holdout(observation, before.held_out)
    earlier = before.estimate
    estimate = estimate_with(earlier.method, training.system(), earlier.fixed_gains)
    return replace(
        before,
        model=model,
        datasets=datasets,
        rows_without_effects=observation,
        training=training,
        holdout=holdout,
        effects=(),
        estimate=estimate,
        corrections=corrections,
        uncorrected=given if corrections else None,
    )


def coefficients_of(estimate: Estimate, placed: PlacedEffect) -> tuple[FloatArray, FloatArray]:
    """Coefficients of an effect in an estimate, with what was applied to the description, and σ;
    shape (p,) each.
    """
    own = own_unknowns(estimate, (placed,))
    return values_of(estimate, own), estimate.parameters_std[own]


def _is_same_geometry(one: Sequence[PlacedEffect], other: Sequence[PlacedEffect]) -> bool:
    """Whether two sets of corrections have corrected a description alike."""
    return _applied(one) == _applied(other)


def _applied(corrections: Sequence[PlacedEffect]) -> dict[PlacedEffect, tuple[float, ...]]:
    """The applied part of each correction that has one."""
    found: dict[PlacedEffect, tuple[float, ...]] = {}
    for placed in corrections:
        if isinstance(placed.effect, GeometryEffect) and any(placed.effect.applied):
            found[placed] = placed.effect.applied
    return found


def _relinearised(found: Evidence) -> tuple[PlacedEffect, ...] | None:
    """The effects of a fit with what their corrections have found applied;
    None where nothing is left to apply.
    """
    effects: list[PlacedEffect] = []
    is_moved = False
    for placed in found.effects:
        kept = placed
        if isinstance(placed.effect, GeometryEffect):
            values, std = coefficients_of(found.estimate, placed)
            left = np.abs(values - np.array(placed.effect.applied))
            if np.any(left > SETTLED * std):
                is_moved = True
                kept = replace(placed, effect=placed.effect.with_applied(values.tolist()))
        effects.append(kept)
    return tuple(effects) if is_moved else None


def _refitted(
    before: Evidence, effects: tuple[PlacedEffect, ...], runs: Sequence[Signals]
) -> Evidence:
    """Refit with effects; the description has their corrections already."""
    current = before
    is_independent = all(placed.effect.abscissa.is_independent_of_model for placed in effects)
    for signals in (runs,) if is_independent else (runs, ()):
        around = current
        current = refitted_around(around, effects, signals)
    if current.holdout is None or not effects:
        return current
    began_s = session_began_s(before.fit_runs)  # held-out runs must not affect the fit
    held_out = before.datasets[len(before.fit_runs) :]
    torque = _torques(effects, around, held_out, began_s)
    return replace(
        current, holdout=current.holdout.extended(_columns_of(before.model, effects), torque)
    )


def refitted_around(
    around: Evidence, effects: tuple[PlacedEffect, ...], runs: Sequence[Signals] = ()
) -> Evidence:
    """Refit the same data once; load and current of the effects' columns are predictions of the
    estimate before.

    Args:
        around: the same data and description.
        effects: of the model. Held-out rows of the result do not have their columns.
        runs: signals of the runs of the fit around the estimate before, where they are at hand.
    """
    training, unseen = _split_holdout(around.rows_without_effects, around.held_out)
    if effects:
        torque = _torques(effects, around, around.fit_runs, session_began_s(around.fit_runs), runs)
        training = training.extended(_columns_of(around.model, effects), torque)
    estimate = estimate_with(around.estimate.method, training.system(), around.estimate.fixed_gains)
    return replace(around, training=training, holdout=unseen, effects=effects, estimate=estimate)


def _columns_of(model: Model, effects: Sequence[PlacedEffect]) -> tuple[Column, ...]:
    """Columns of effects at their joints."""
    columns: list[Column] = []
    for placed in effects:
        kind = model.robot.places[placed.axis].kind
        columns += [column.at(kind) for column in placed.columns]
    return tuple(columns)


def by_instruments(evidence: Evidence) -> Estimate | None:
    """Estimate the same model of the same runs by ``iv``;
    None where the demanded motion of no run is known.

    Load and current of the effects' columns are predictions of the estimate by ``ml``, in the
    instruments too.
    """
    system = _with_instruments(evidence)
    estimate = evidence.estimate
    if system is None:
        return None
    return estimate_with(Method.IV, system, estimate.fixed_gains)


def _with_instruments(evidence: Evidence) -> System | None:
    """System with instruments from the demanded motion;
    None where none is known or the drive is redundant.
    """
    model = evidence.model
    if model.is_redundant:
        return None
    asked = tuple(_with_demand(evidence, index) for index in range(len(evidence.fit_runs)))
    if all(data.demanded is None for data in asked):
        return None
    demanded = on_demanded_motion(model, asked, evidence.training)
    if evidence.effects:
        datasets = tuple(map(as_demanded, asked))
        began_s = session_began_s(evidence.fit_runs)
        demanded = replace(
            demanded, effects=_torques(evidence.effects, evidence, datasets, began_s)
        )
        del datasets
    del asked  # free the copies of the runs before the equations are built
    return evidence.training.system(demanded)


def _with_demand(evidence: Evidence, index: int) -> Dataset:
    """A run of the fit with its demanded motion, in the corrected description.

    The demand is rebuilt from the run as it was given: what corrects the recorded positions
    corrects it, too.
    """
    if evidence.uncorrected is None:
        given = evidence.datasets
    else:
        given = evidence.uncorrected.datasets
    asked = with_demand(
        given[index], evidence.model.drive_train, evidence.conditioning, evidence.demands
    )
    if asked.demanded is None:
        return evidence.datasets[index]
    corrected = corrected_dataset(as_demanded(asked), evidence.corrections)
    return replace(evidence.datasets[index], demanded=corrected.motion())


def _torques(
    effects: Sequence[PlacedEffect],
    around: Evidence,
    datasets: Sequence[Dataset],
    began_s: float | None,
    runs: Sequence[Signals] = (),
) -> FloatArray:
    """Columns of effects on the rows of runs, load and current predicted by an estimate, shape (m,
    p, r).
    """
    parts = []
    through_links = any(placed.effect.needs_inertia for placed in effects)
    # One by one: signals at full rate are the largest arrays of a search
    for index, data in enumerate(datasets):
        if runs:
            run = runs[index]
        else:
            model = around.model
            rows = around.training
            estimate = around.estimate
            run = fitted_signals(model, data, rows, estimate, began_s, inertia=through_links)
        run = beside_rotors(run, effects)
        given = (run,), (data,), around.conditioning, around.model
        parts.append(
            np.concatenate(
                [effect_torque(placed.effect, placed.axis, *given) for placed in effects], axis=1
            )
        )
    return np.concatenate(parts, axis=2)


def without_effects(evidence: Evidence, estimate: Estimate) -> Evidence:
    """Return the same data under the declared model alone, with its estimate by ``ml``."""
    if evidence.corrections:
        evidence = with_corrections(evidence, ())
    training, rest = _split_holdout(evidence.rows_without_effects, evidence.held_out)
    return replace(
        evidence, training=training, holdout=rest, effects=(), estimate=estimate, declared=0
    )


def with_estimate(evidence: Evidence, estimate: Estimate) -> Evidence:
    """Return the same rows with another estimate of the same unknowns, its equations kept."""
    changed = replace(evidence, estimate=estimate)
    changed._identification.extend(
        replace(one, estimate=estimate) for one in evidence._identification
    )
    return changed


def _split_holdout(
    observation: Observation, held_out: int
) -> tuple[Observation, Observation | None]:
    """Split rows of all runs into those of the fit and those of the last, held-out runs."""
    if not held_out:
        return observation, None
    first = int(np.searchsorted(observation.run, len(observation.runs) - held_out))
    return observation.only(slice(first)), observation.only(slice(first, None))
