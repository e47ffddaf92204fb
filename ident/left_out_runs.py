"""Each run of a fit left out in turn: everything refitted without it, and the run predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from ident.current_error import CurrentError, error_on
from ident.errors import IdentificationError
from ident.estimators.maximum_likelihood import ml
from ident.loop import Evidence, with_effects
from ident.observation import Observation
from ident.relative_error import RelativeError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LeftOutRun:
    """One run of the fit, predicted by the others; `error` is None where they cannot, and `reason` says why."""

    run: str
    error: RelativeError | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LeftOutRuns:
    """Each run of the fit left out in turn.

    Attributes:
        runs: in the order of the fit.
        together: over the rows of all that could be predicted; None without any.
    """

    runs: tuple[LeftOutRun, ...]
    together: RelativeError | None


def left_out_runs(evidence: Evidence, weights_nm_a: FloatArray) -> LeftOutRuns:
    """Refit everything without each run of the fit in turn, and predict that run.

    A run that alone carries the known payload, or alone goes without, cannot be spared: it is told with the reason.

    Args:
        evidence: identified by ``ml``.
        weights_nm_a: of the whole error, shape (n,).
    """
    runs: list[LeftOutRun] = []
    errors: list[CurrentError] = []
    for index, data in enumerate(evidence.trained):
        try:
            errors.append(_error_without(evidence, index))
        except IdentificationError as error:
            runs.append(LeftOutRun(data.name, None, str(error)))
        else:
            runs.append(LeftOutRun(data.name, errors[-1].relative(weights_nm_a)))
    return LeftOutRuns(tuple(runs), reduce(add, errors).relative(weights_nm_a) if errors else None)


def _error_without(evidence: Evidence, left_out: int) -> CurrentError:
    """Of one run of the fit, the model refitted without it."""
    order = [index for index in range(len(evidence.trained)) if index != left_out] + [left_out]
    whole = _in_order(evidence.bare, order)
    last = whole.run == len(order) - 1
    training, held = whole.only(~last), whole.only(last)
    fixed = evidence.estimate.gains if evidence.estimate.gains_fixed else None
    bare = replace(
        evidence,
        datasets=tuple(evidence.datasets[index] for index in order),
        held_out=1,
        bare=whole,
        training=training,
        holdout=held,
        effects=(),
        estimate=ml(training.system(), fixed),
    )
    if not evidence.effects:
        return error_on(held, bare.estimate)
    refitted = with_effects(bare, evidence.effects)
    return error_on(refitted.holdout or held, refitted.estimate)


def _in_order(bare: Observation, order: Sequence[int]) -> Observation:
    """The rows of some runs, run by run in this order."""
    rows: IntArray = np.concatenate([np.flatnonzero(bare.run == run) for run in order])
    number = np.zeros(len(bare.runs), dtype=np.int64)
    number[list(order)] = np.arange(len(order))
    return replace(
        bare,
        current=bare.current[:, rows],
        robot=bare.robot[:, :, rows],
        flange=bare.flange[:, :, rows],
        use=bare.use[:, rows],
        motor_use=bare.motor_use[:, rows],
        time_s=bare.time_s[rows],
        run=number[bare.run[rows]],
        move=bare.move[rows],
        mounting=bare.mounting[rows],
        runs=tuple(bare.runs[run] for run in order),
    )
