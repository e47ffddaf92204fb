"""One error for every model and every data set: the part of each motor's current that a model does not explain.

For motor i, over the rows that count for it (Observation.motor_use), with γ_i = 1/g_i and T from the drive train,

    e_i = v_i − γ_i (T τ)_i,        ε_i = ‖e_i‖/‖v_i‖,        ε = √(Σ_i w_i²‖e_i‖² / Σ_i w_i²‖v_i‖²).

The current is measured: ‖v_i‖ is the same for every model of the same rows, while Y = V g (paper Table 6) scales with
the gains that a model finds. The weights w convert currents of different motors to torques at the joint, so that a
robot without coupled axes has the ε of Table 6. They are one set of gains for all models that are compared; whitened by
σ_i instead, ε would have a scale that an accepted effect moves. A robot with prismatic and revolute axes adds Nm to N
in ε, as Table 6 would; its ε_i are not affected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.discovery.loop import Evidence, with_effects
from ident.equations.linearisation import Folds
from ident.equations.observation import Observation
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate, RelativeError, of_squares
from ident.estimators.maximum_likelihood import ml


@dataclass(frozen=True, slots=True)
class CurrentError:
    """Sums over rows, so that errors of parts of the data can be added."""

    size: FloatArray  #: ‖v_i‖² of each motor [A²], shape (n,)
    left: FloatArray  #: ‖e_i‖² [A²], same shape

    def __add__(self, other: CurrentError) -> CurrentError:
        """Error on the rows of both."""
        return CurrentError(self.size + other.size, self.left + other.left)

    def relative(self, weights_nm_a: FloatArray) -> RelativeError:
        """ε_i and ε [%] with weights w, shape (n,); NaN for a motor without a row."""
        return of_squares(self.size * weights_nm_a**2, self.left * weights_nm_a**2)


def error_on(observation: Observation, estimate: Estimate) -> CurrentError:
    """Error of an estimate on rows, those of its fit or others with the same columns."""
    use, measured = observation.motor_use, observation.current
    predicted = observation.drive_train.to_motor @ estimate.predicted_torque(observation)
    residual = measured - predicted / estimate.gains[:, None]
    return CurrentError(np.sum(measured**2, axis=1, where=use), np.sum(residual**2, axis=1, where=use))


def error_left_out(folds: Folds) -> CurrentError:
    """Error on each fold's rows, predicted by a fit that has not seen their moves."""
    problem = folds.problem
    size, left = np.zeros(len(problem.noise)), np.zeros(len(problem.noise))
    np.add.at(size, problem.motor, (problem.current * problem.noise[problem.motor]) ** 2)
    np.add.at(left, problem.motor, (folds.residual * problem.noise[problem.motor]) ** 2)
    return CurrentError(size, left)


@dataclass(frozen=True, slots=True)
class LeftOutRun:
    """One run of the fit, predicted by the others; `error` is None where they cannot be fitted, with the reason."""

    run: str
    error: RelativeError | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LeftOutRuns:
    """Errors on each run of the fit, left out in turn."""

    runs: tuple[LeftOutRun, ...]  #: in the order of the fit
    together: RelativeError | None  #: over the rows of all runs that could be predicted; None without any


def left_out_runs(evidence: Evidence, weights_nm_a: FloatArray) -> LeftOutRuns:
    """Refit everything without each run of the fit in turn, and predict that run.

    The only run with the known payload, or the only one without, cannot be left out: it is listed with the reason.
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
    """Error on one run of the fit, with the model refitted without it."""
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
    """Sort rows by run, in this order."""
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
