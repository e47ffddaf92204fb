"""Change by accepted effects: errors of every motor in four ways, and every gain, before and after.

One error serves every model and every data set: the part of each motor's current that a model does
not explain. For motor i, over the rows that count for it (Observation.motor_use), with γ_i = 1/g_i
and T from the drive train,

    e_i = v_i − γ_i (T τ)_i,     ε_i = ‖e_i‖/‖v_i‖,     ε = √(Σ_i w_i²‖e_i‖² / Σ_i w_i²‖v_i‖²).

The current is measured: ‖v_i‖ is the same for every model of the same rows, while Y = V g (paper
Table 6) scales with the gains that a model finds. No model explains the internal preload of a
redundant drive: v and e are without the preload that is most likely under the model's g and σ,
diag(σ) T_D V g and diag(σ) T_D (V g − τ) (ident/equations/currents.py), and e_i then shows the
share P_ii of the variance of the current's noise. The weights w convert currents of different
motors to torques at the joint, so that a robot without coupled axes has the ε of Table 6. They are
one set of gains for all models that are compared; whitened by σ_i instead, ε would have a scale
that an accepted effect moves. A robot with prismatic and revolute axes adds Nm to N in ε, as Table
6 would; its ε_i are not affected. The four ways differ in the data that the model has seen:

- in-sample: all data; it cannot rise when an effect joins, so it proves nothing;
- cross-validated: all moves but those predicted (`cut_into_folds`, one Gauss-Newton step around the
  estimate, gains included); the choice of the effects has seen all moves, so the error is
  optimistic;
- left-out runs: all runs but the one predicted, everything refitted, load and current of the
  effects' columns too; the choice and the settings of the effects have seen the run;
- hold-out: no fit and no search has seen these runs; they judge what was found, one effect at a
  time (`ident.discovery.acceptance`), so the error of what is left is optimistic by that choice
  alone.

Estimates before and after share their noise, so the σ of a change is neither one's σ nor the root
of both squared. It is the jackknife of the change itself: leaving out block c of moves shifts g by
d_c = −(H − G_c)⁻¹ s_c (ident/equations/linearisation.py; the longer blocks of the two models serve
both), and

    σ_Δ² = (C − 1)/C Σ_c (Δd_c − mean)²,        Δd_c = d_c after − d_c before,        of C blocks.

It takes the effects as given; σ after the whole search includes their choice
(ident/discovery/choice.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray, IntArray
from ident.discovery.error_change import ErrorChange, change_of_errors
from ident.discovery.evidence import Evidence, Uncorrected, with_effects
from ident.discovery.loop import Step
from ident.discovery.noise_floor import MotorNoiseFloor, noise_floors
from ident.discovery.time_skew import CurrentDelay, time_skew
from ident.drift.change import FALSE_ALARM
from ident.effects.effect import PlacedEffect
from ident.equations.currents import whitening_transform
from ident.equations.linearisation import (
    Folds,
    cut_into_folds,
    independent_blocks,
    left_out_shifts,
    linearise,
    scatter_of,
)
from ident.equations.observation import Observation
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate, RelativeError, of_squares
from ident.estimators.identify import estimate_with


@dataclass(frozen=True, slots=True)
class CurrentError:
    """Sums over rows, so that errors of parts of the data can be added."""

    size: FloatArray  #: ‖v_i‖² of each motor [A²], shape (m,)
    left: FloatArray  #: ‖e_i‖² [A²], same shape

    def __add__(self, other: CurrentError) -> CurrentError:
        """Error on the rows of both."""
        return CurrentError(self.size + other.size, self.left + other.left)

    def relative(self, weights_nm_a: FloatArray) -> RelativeError:
        """ε_i and ε [%] with weights w, shape (m,); NaN for a motor without a row."""
        squared = weights_nm_a**2
        return of_squares(self.size * squared, self.left * squared)


def error_on(observation: Observation, estimate: Estimate) -> CurrentError:
    """Error of an estimate on rows, those of its fit or others with the same columns."""
    use = observation.motor_use
    seen = _currents(observation, estimate)
    size = np.sum(seen.measured**2, axis=1, where=use)
    left = np.sum(seen.left**2, axis=1, where=use)
    return CurrentError(size, left)


def left_on(observation: Observation, estimate: Estimate) -> FloatArray:
    """Root mean square of each motor's e_i [A], shape (m,); NaN without a row.

    That of a redundant drive is over √P_ii, so that it compares with the noise of the current.
    """
    shown = _currents(observation, estimate).shown
    rows = np.sum(shown, axis=1, where=observation.motor_use)
    left = error_on(observation, estimate).left
    mean_square = np.full(len(rows), np.nan)
    np.divide(left, rows, out=mean_square, where=rows > 0)
    return np.asarray(np.sqrt(mean_square))


def squares_left(observation: Observation, estimate: Estimate) -> FloatArray:
    """Squared error e_i² of each motor and row [A²], shape (m, r), of all rows."""
    return np.square(_currents(observation, estimate).left)


def holdout_change(start: Evidence, after: Evidence) -> ErrorChange | None:
    """Compare a model with all its effects with one without, on held-out rows; None without any."""
    if start.holdout is None or after.holdout is None:
        return None
    return compare_on_holdout(start, start, after)


def compare_on_holdout(start: Evidence, before: Evidence, after: Evidence) -> ErrorChange:
    """Compare two models on held-out rows, in units of the noise of a model without effects.

    Args:
        start: model without effects.
        before, after: the two models. Their held-out rows are the same.

    Raises:
        ValueError: nothing was held out.
    """
    if before.holdout is None or after.holdout is None:
        raise ValueError("two models can be compared on held-out rows only if runs were held out")
    return change_of_squares(
        before.holdout,
        squares_left(before.holdout, before.estimate),
        squares_left(after.holdout, after.estimate),
        start.estimate.axis_noise,
    )


def change_of_squares(
    rows: Observation, before: FloatArray, after: FloatArray, noise_a: FloatArray
) -> ErrorChange:
    """Compare squared errors of all rows [A²], shape (m, r) both, in units of the noise."""
    used = rows.motor_use
    motor, source = np.nonzero(used)
    variance = np.square(noise_a)[motor]
    return change_of_errors(
        before=before[used] / variance,
        after=after[used] / variance,
        motor=motor,
        move=rows.move[source],
        run=rows.run[source],
        motors=len(noise_a),
    )


@dataclass(frozen=True, slots=True)
class _Currents:
    """Currents of each motor and row, of a redundant drive without preload."""

    measured: FloatArray  #: v [A], shape (m, r)
    left: FloatArray  #: e [A], same shape
    #: share of the variance of the current's noise that e shows, P_ii, same shape
    shown: FloatArray


def _currents(observation: Observation, estimate: Estimate) -> _Currents:
    """Currents of rows under an estimate."""
    predicted = estimate.predicted_torque(observation)
    measured = observation.current
    gains = estimate.gains[:, None]
    if not observation.preload.size:
        # e = v − T τ/g.
        left = measured - observation.drive_train.to_motor @ predicted / gains
        return _Currents(measured, left, np.ones_like(measured))
    noise = estimate.axis_noise
    torque = observation.torque(estimate.gains)
    # diag(σ) T_D of each row, shape (r, m, m).
    preload = observation.preload.transpose(2, 0, 1)
    to_currents = noise[:, None] * whitening_transform(preload, estimate.gains, noise)
    return _Currents(
        measured=np.einsum("rij,jr->ir", to_currents, torque),
        left=np.einsum("rij,jr->ir", to_currents, torque - predicted),
        shown=np.einsum("rii->ir", to_currents) * gains,
    )


def error_left_out(folds: Folds) -> CurrentError:
    """Error on each fold's rows, predicted by a fit that has not seen their moves."""
    problem = folds.linearisation
    noise_a = problem.noise[problem.motor]
    size = np.zeros(len(problem.noise))
    left = np.zeros(len(problem.noise))
    np.add.at(size, problem.motor, (problem.current * noise_a) ** 2)
    np.add.at(left, problem.motor, (folds.residual * noise_a) ** 2)
    return CurrentError(size, left)


@dataclass(frozen=True, slots=True)
class RunError:
    """One run of the fit, predicted by the others."""

    run: str  #: its name
    error: RelativeError | None  #: on its rows [%]; None where the others cannot be fitted
    reason: str = ""  #: why there is no error


@dataclass(frozen=True, slots=True)
class RunErrors:
    """Errors on each run of the fit, left out in turn."""

    runs: tuple[RunError, ...]  #: in the order of the fit
    #: over the rows of all runs that could be predicted; None without any
    together: RelativeError | None


def left_out_runs(evidence: Evidence, weights_nm_a: FloatArray) -> RunErrors:
    """Refit everything without each run of the fit in turn, and predict that run.

    Motors count by weights_nm_a, shape (m,).

    The only run with the known payload, or the only one without, cannot be left out: it is listed
    with the reason.
    """
    runs: list[RunError] = []
    errors: list[CurrentError] = []
    for index, data in enumerate(evidence.fit_runs):
        try:
            errors.append(_error_without(evidence, index))
        except IdentificationError as error:
            runs.append(RunError(data.name, None, str(error)))
        else:
            runs.append(RunError(data.name, errors[-1].relative(weights_nm_a)))
    if not errors:
        return RunErrors(tuple(runs), None)
    together = reduce(add, errors)
    return RunErrors(tuple(runs), together.relative(weights_nm_a))


def _error_without(evidence: Evidence, left_out: int) -> CurrentError:
    """Error on one run of the fit, with the model refitted without it."""
    others = [index for index in range(len(evidence.fit_runs)) if index != left_out]
    order = [*others, left_out]
    observation = _in_order(evidence.rows_without_effects, order)
    is_last = observation.run == len(others)
    training = observation.only(~is_last)
    held = observation.only(is_last)
    of_all = evidence.estimate
    estimate = estimate_with(of_all.method, training.system(), of_all.fixed_gains)
    bare = replace(
        evidence,
        datasets=tuple(evidence.datasets[index] for index in order),
        held_out=1,
        rows_without_effects=observation,
        training=training,
        holdout=held,
        effects=(),
        uncorrected=_datasets_in_order(evidence.uncorrected, order),
        estimate=estimate,
    )
    if not evidence.effects:
        return error_on(held, estimate)
    refitted = with_effects(bare, evidence.effects)
    return error_on(refitted.holdout or held, refitted.estimate)


def _datasets_in_order(uncorrected: Uncorrected | None, order: Sequence[int]) -> Uncorrected | None:
    """Put recordings in this order, as they were before corrections."""
    if uncorrected is None:
        return None
    return replace(uncorrected, datasets=tuple(uncorrected.datasets[index] for index in order))


def _in_order(bare: Observation, order: Sequence[int]) -> Observation:
    """Sort rows by run, in this order."""
    of_runs = [np.flatnonzero(bare.run == run) for run in order]
    rows: IntArray = np.concatenate(of_runs)
    number = np.zeros(len(bare.runs), dtype=np.int64)
    number[list(order)] = np.arange(len(order))
    names = tuple(bare.runs[run] for run in order)
    return replace(bare.only(rows), run=number[bare.run[rows]], runs=names)


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Errors of one model [%]; None where not requested, or without held-out runs."""

    in_sample: RelativeError  #: on the rows of the fit
    cross_validated: RelativeError  #: on moves left out of one step of the fit
    left_out_runs: RunErrors | None  #: on runs left out of a fit of their own
    holdout: RelativeError | None  #: on runs that no fit and no search has seen


@dataclass(frozen=True, slots=True)
class Moves:
    """The linearised problem by move: what leaving moves out needs."""

    grams: FloatArray  #: G_c of each move, shape (C, f, f)
    scores: FloatArray  #: s_c of each move, shape (C, f)
    scale: FloatArray  #: unit of each unknown, shape (f,); the gains are the first
    runs: IntArray  #: run of each move, shape (C,)

    def blocks(self) -> IntArray:
        """First move of each block of moves that is independent of the others."""
        return independent_blocks(self.grams, self.scores, self.runs)

    def shifts(self, starts: IntArray) -> FloatArray:
        """Shift of the unknowns when each block is left out, shape (blocks, f)."""
        grams = np.add.reduceat(self.grams, starts)
        scores = np.add.reduceat(self.scores, starts)
        return left_out_shifts(grams, scores) * self.scale


@dataclass(frozen=True, slots=True)
class Assessment:
    """One model on its data."""

    effects: tuple[PlacedEffect, ...]  #: in the model
    errors: RelativeErrors  #: of the model
    gains: FloatArray  #: drive gains [Nm at the joint per A], shape (m,)
    gains_std: FloatArray  #: their σ, shape (m,)
    choice_std: FloatArray  #: the part of it that comes from the choice of the effects, shape (m,)
    moves: Moves | None  #: what each move says of the gains; None for fixed gains


@dataclass(frozen=True, slots=True)
class GainShift:
    """One gain without and with further effects [Nm at the joint per A]."""

    before: float  #: estimate without the effects
    before_std: float  #: its σ
    after: float  #: estimate with the effects
    after_std: float  #: its σ
    #: the part of it that comes from the choice of the effects (`choice_covariance`)
    choice_std: float
    change_std: float  #: σ of the change, 0 for a fixed gain
    #: whether the change is more than noise, at FALSE_ALARM over all axes (Bonferroni)
    significant: bool

    @property
    def change_percent(self) -> float:
        """Change [% of the gain before]."""
        return 100.0 * (self.after / self.before - 1.0)

    @property
    def change_std_percent(self) -> float:
        """σ of the change [% of the gain before]."""
        return 100.0 * self.change_std / abs(self.before)


@dataclass(frozen=True, slots=True)
class BeforeAfter:
    """Two models of the same data."""

    added: tuple[PlacedEffect, ...]  #: effects of the second model only
    removed: tuple[PlacedEffect, ...]  #: effects of the first model only
    before: RelativeErrors  #: errors of the first
    after: RelativeErrors  #: errors of the second
    gains: tuple[GainShift, ...]  #: one a motor


@dataclass(frozen=True, slots=True)
class Account:
    """Change by a whole search for effects."""

    #: noise of each motor's current, None where it is not known
    floors: tuple[MotorNoiseFloor | None, ...]
    left_a: FloatArray  #: `left_on` the rows of the fit after the last turn [A]
    #: Error that this noise alone would leave on the rows of the fit [%]: an estimate, at most the
    #: error of either model; NaN where it is not known or refuted.
    floor: RelativeError
    holdout_floor: RelativeError | None  #: the same on held-out rows, None without any
    #: The same of the lower limit of the noise where it is a bound (`MotorNoiseFloor.least_a`): no
    #: model's error is smaller.
    least_floor: RelativeError
    least_holdout_floor: RelativeError | None  #: the same on held-out rows, None without any
    #: change by each turn of the loop, None where it added nothing
    turns: tuple[BeforeAfter | None, ...]
    total: BeforeAfter  #: change from the declared model to the last one
    #: of the errors on held-out rows by all effects of the last model, None without any
    holdout_change: ErrorChange | None
    #: Delay of the currents after the positions, beside the effects of the last model; None where
    #: no instruments exist.
    skew: CurrentDelay | None = None


def account(
    start: Evidence,
    steps: Sequence[Step],
    *,
    leave_out_runs: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> Account:
    """Compare before and after every turn of `ident.discovery.loop.find_effects`, and in total.

    Args:
        start: without effects, identified by ``ml``; its gains weigh the errors of all.
        steps: from there.
        leave_out_runs: refit without each run in turn; takes as many fits as there are runs.
        progress: called with a description of each step.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    weights_nm_a = start.estimate.gains

    def assessed(evidence: Evidence) -> Assessment:
        count = len(evidence.effects)
        if count == 1:
            progress("errors with 1 effect in the model")
        else:
            progress(f"errors with {count} effects in the model")
        left_out: RunErrors | None = None
        if leave_out_runs:
            left_out = left_out_runs(evidence, weights_nm_a)
        return assess(evidence, weights_nm_a, left_out)

    first = last = assessed(start)
    turns: list[BeforeAfter | None] = []
    for step in steps:
        if step.after.effects == last.effects:
            turns.append(None)
            continue
        before = last
        last = assessed(step.after)
        turns.append(before_after(before, last))
    end = steps[-1]
    floors = noise_floors(start.fit_runs, start.conditioning)
    if end.choice_std is not None:
        last = replace(last, gains_std=end.after.estimate.gains_std, choice_std=end.choice_std)
    left_a = left_on(end.after.training, end.after.estimate)
    progress("time skew by instruments from the demanded motion")
    skew = time_skew(end.after)
    known_a = np.full(len(floors), np.nan)
    least_a = np.full(len(floors), np.nan)
    for motor, floor in enumerate(floors):
        if floor is None or floor.is_refuted(left_a[motor]):
            continue
        known_a[motor] = floor.noise_a
        if floor.is_bound:
            least_a[motor] = floor.least_a

    def error_of(noise_a: FloatArray, before: Observation, after: Observation) -> RelativeError:
        """Error by noise alone on some rows; a model that leaves less by chance is at the floor."""
        left_before = left_on(before, start.estimate)
        left_after = left_on(after, end.after.estimate)
        at_most = np.fmin(noise_a, np.fmin(left_before, left_after))
        at_most[np.isnan(noise_a)] = np.nan
        return floor_on(before, start.estimate, at_most).relative(weights_nm_a)

    training = start.training
    training_after = end.after.training
    holdout_floor: RelativeError | None = None
    least_holdout_floor: RelativeError | None = None
    if start.holdout is not None:
        holdout_after = end.after.holdout or start.holdout
        holdout_floor = error_of(known_a, start.holdout, holdout_after)
        least_holdout_floor = error_of(least_a, start.holdout, holdout_after)
    return Account(
        floors=floors,
        left_a=left_a,
        floor=error_of(known_a, training, training_after),
        holdout_floor=holdout_floor,
        least_floor=error_of(least_a, training, training_after),
        least_holdout_floor=least_holdout_floor,
        turns=tuple(turns),
        total=before_after(first, last),
        holdout_change=holdout_change(start, end.after),
        skew=skew,
    )


def assess(
    evidence: Evidence, weights_nm_a: FloatArray, left_out: RunErrors | None = None
) -> Assessment:
    """Compute the errors and gains of one model, identified by ``ml``.

    Motors count by weights_nm_a, shape (m,).

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    estimate = evidence.estimate
    problem = linearise(
        evidence.training,
        estimate.gains,
        estimate.parameters,
        estimate.axis_noise,
        gains_fixed=estimate.gains_fixed,
    )
    folds = cut_into_folds(problem)
    holdout: RelativeError | None = None
    if evidence.holdout is not None:
        holdout = error_on(evidence.holdout, estimate).relative(weights_nm_a)
    moves = None
    if not estimate.gains_fixed:
        runs = problem.of_clusters(evidence.training.run)
        moves = Moves(folds.cluster_hessian, folds.cluster_score, problem.scale, runs)
    return Assessment(
        effects=evidence.effects,
        errors=RelativeErrors(
            in_sample=error_on(evidence.training, estimate).relative(weights_nm_a),
            cross_validated=error_left_out(folds).relative(weights_nm_a),
            left_out_runs=left_out,
            holdout=holdout,
        ),
        gains=estimate.gains,
        gains_std=estimate.gains_std,
        choice_std=np.zeros(len(estimate.gains)),
        moves=moves,
    )


def before_after(before: Assessment, after: Assessment) -> BeforeAfter:
    """Compare two models of the same rows."""
    count = len(before.gains)
    change_std = np.zeros(count)
    if before.moves is not None and after.moves is not None:
        starts = min(before.moves.blocks(), after.moves.blocks(), key=len)
        shifts_after = after.moves.shifts(starts)[:, :count]
        shifts_before = before.moves.shifts(starts)[:, :count]
        covariance = scatter_of(shifts_after - shifts_before)
        change_std = np.sqrt(np.diag(covariance))
    limit = float(-scipy.special.ndtri(FALSE_ALARM / (2 * count)))
    gains: list[GainShift] = []
    for motor in range(count):
        change = after.gains[motor] - before.gains[motor]
        shift = GainShift(
            before=float(before.gains[motor]),
            before_std=float(before.gains_std[motor]),
            after=float(after.gains[motor]),
            after_std=float(after.gains_std[motor]),
            choice_std=float(after.choice_std[motor]),
            change_std=float(change_std[motor]),
            significant=bool(abs(change) > limit * change_std[motor]),
        )
        gains.append(shift)
    return BeforeAfter(
        added=tuple(placed for placed in after.effects if placed not in before.effects),
        removed=tuple(placed for placed in before.effects if placed not in after.effects),
        before=before.errors,
        after=after.errors,
        gains=tuple(gains),
    )


def floor_on(observation: Observation, estimate: Estimate, noise_a: FloatArray) -> CurrentError:
    """Error that noise alone would leave on some rows, by that of each motor [A], shape (m,);
    NaN for a motor whose noise is not known.
    """
    use = observation.motor_use
    seen = _currents(observation, estimate)
    size = np.sum(seen.measured**2, axis=1, where=use)
    rows = np.sum(seen.shown, axis=1, where=use)
    return CurrentError(size, rows * noise_a**2)
