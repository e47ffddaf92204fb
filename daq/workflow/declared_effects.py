"""Effects that a cell file declares, in a fit: a counterbalance that the robot is known to have needs no search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.effects import place_effect
from daq.config.yaml_file import Fault
from daq.errors import ConfigurationInconsistent, UsageError
from ident.discovery.declared import with_declared
from ident.discovery.evidence import Evidence, gather, with_effects, without_effects
from ident.discovery.loop import Step
from ident.effects.effect import PlacedEffect
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.estimators.refusals import require_plausible

BOOTSTRAP_SEED = 0  #: Fixes the verdict of a significance test; no decision depends on it for declared effects


def declared_effects(cell: Cell) -> tuple[PlacedEffect, ...]:
    """Return the effects that a cell declares, where no setting is given with those of the dictionary's first member.

    Raises:
        ConfigurationInconsistent: there is no such effect, or it has no such setting, on this axis.
    """
    robot, placed = model_of(cell).robot, []
    for declared in cell.effects:
        found = place_effect(declared.name, declared.axis, declared.settings, robot)
        if isinstance(found, Fault):
            raise ConfigurationInconsistent(
                f"effects of cell {cell.name!r}: {declared.name} on {cell.place_names[declared.axis]}",
                found=found.found,
                expected=found.expected,
                remedy="correct the cell file",
            )
        placed.append(found)
    return tuple(placed)


def refuse_effects(cell: Cell, option: str) -> None:
    """Refuse a way of fitting that leaves out what the cell declares.

    Raises:
        UsageError: the cell declares effects.
    """
    if cell.effects:
        names = ", ".join(f"{effect.name} on {cell.place_names[effect.axis]}" for effect in cell.effects)
        raise UsageError(
            option,
            found=f"a cell that declares effects: {names}",
            expected="a cell without effects: this way of fitting leaves them out",
            remedy="fit without the option, or name a cell file without `effects` with --cell",
        )


def with_effects_of_cell(
    start: Identification, effects: tuple[PlacedEffect, ...], axes: Sequence[str]
) -> tuple[Step, ...]:
    """Add the effects that a cell declares; settings are fitted by ``ml``, then all by the method that was asked for.

    Raises:
        IdentificationError: a refit failed, or the model with the effects contradicts the data.
    """
    estimate = start.estimate
    fixed = estimate.gains if estimate.gains_fixed else None
    by_ml = estimate if estimate.method is Method.ML else estimate_with(Method.ML, start.system, fixed)
    steps = with_declared(
        replace(gather(start), estimate=by_ml), effects, np.random.default_rng(BOOTSTRAP_SEED), axes=axes
    )
    after = steps[-1].after
    if estimate.method is not Method.ML:
        after = with_declared_again(after, estimate)
        steps = (*steps[:-1], replace(steps[-1], after=after))
    error = after.estimate.relative_error(after.identification.system)
    require_plausible(after.estimate, error, axes[: len(estimate.gains)])
    return steps


def with_declared_again(evidence: Evidence, estimate: Estimate) -> Evidence:
    """Fit the same data and effects by the estimator, and with the gains, of an estimate without effects."""
    refitted = with_effects(without_effects(evidence, estimate), evidence.effects)
    return replace(refitted, declared=evidence.declared)
