"""Candidates tested on a residual: the search problem, and trials of effects on it,
in-sample and on left-out moves.

Friction differs from run to run, as temperature and mounting do. A search that took moves of all
runs as exchangeable would find laws in that. So `prepare_search` gives the friction of each run a
random deviation from the common one. The rows are decorrelated from it
(`ident.equations.run_scatter`), and trials, folds and bootstrap see what a law within the runs
explains. The estimate knows nothing of it: shifts of gains are those of the estimate
(`Folds.estimate_factor`).

A *candidate* is an effect with one choice of settings on one axis. A *trial* projects its columns
off all declared directions, gains included, and measures what they explain of the residual:
in-sample, and on folds of left-out moves. A *family* is one effect with all settings that the
dictionary tries.

Symbols, of the whitened and decorrelated rows of all motors:

    J    Jacobian of the declared model (`ident.equations.linearisation`), H = JᵀJ
    e    residual of the estimate, all rows in its fit
    r    residual of each row by a fit without its fold
    Φ    columns of a candidate, p of them
    Φ⊥   Φ − J H⁻¹JᵀΦ, what of them the declared model cannot make
    G    Φ⊥ᵀΦ⊥, so that the best coefficients are β = G⁻¹ Φ⊥ᵀe
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from ident.arrays import FloatArray, IntArray
from ident.data.conditioning import Conditioning, as_recorded
from ident.data.dataset import Dataset
from ident.discovery.candidate_fits import (
    CandidateFit,
    MotorSums,
    Projection,
    WhitenedColumns,
    candidates_of_motor,
    crossed_gram,
    fall_of_motors,
    fit_candidates,
    in_batches,
    is_new,
    projected_gram,
    solved,
    times_hessian,
    times_score,
)
from ident.discovery.few_moves import FEW_MOVES, MoveScores, moves_behind, without_most_leverage
from ident.discovery.noise_floor import noise_floors
from ident.effects.effect import (
    Effect,
    PlacedEffect,
    at_joints,
    columns_at,
    effect_columns,
    is_placeable,
)
from ident.effects.geometry_corrections import GeometryEffect
from ident.effects.rotor import beside_rotors
from ident.effects.signals import Abscissa, Signals, fitted_signals, session_began_s
from ident.equations.linearisation import Folds, Linearisation, MotorRows, cut_into_folds, linearise
from ident.equations.observation import Observation
from ident.equations.rows import decimate_rows
from ident.estimators.estimate import Estimate
from ident.model.model import Model
from ident.model.robot import each_state

ColumnCache = dict[tuple[Effect, int], npt.NDArray[np.float32]]
"""Columns of candidates by effect and axis.

There are hundreds, and single precision is enough for their trials.
"""
DECORRELATED_TOGETHER = 16  #: Candidates that are decorrelated at once
MOVES_WANTED = 60  #: Number of moves below which moves are cut into pieces
SHORTEST_PIECE_S = 0.25  #: Five times the correlation time of a residual
#: Singular value of a candidate's Gram matrix in its own units, relative to the largest, at which
#: the other folds no longer show that combination of its columns
SMALLEST_SINGULAR = 1e-9
#: Fields of `Signals` that do not change in a run, or that no effect needs at the rows
NOT_DECIMATED = frozenset({"rate_hz", "rotor_inertia_kg_m2", "arm", "inertia_kg_m2"})
FRICTION_OF_A_RUN = 0.03
"""Standard deviation of fv and fs from run to run, as a share of each:
a few degrees of the grease make as much.
"""
FAST = frozenset({Abscissa.MOTOR_ANGLE})  #: Variables that turn within a decimated row


@dataclass(frozen=True, slots=True)
class SearchProblem:
    """The residual of an estimate, ready for trials of candidates."""

    model: Model  #: the declared model
    datasets: Sequence[Dataset]  #: the runs of the fit
    observation: Observation  #: their rows, with the columns of the effects accepted so far
    runs: tuple[Signals, ...]  #: predicted signals of each run, at full rate
    rows: tuple[Signals, ...]  #: the same at the observation's rows, without inertia
    folds: Folds  #: the problem around the estimate, in folds of moves
    #: Estimate of each motor's noise in a row, which no model of motion explains [A]; None where
    #: not known.
    floors_a: tuple[float | None, ...]
    #: Step from the estimate to the best fit with friction that differs by run, in the scale of the
    #: unknowns (`Linearisation.scale`), shape (f,).
    step: FloatArray
    #: Columns that depend on motion and time alone, before they are placed at joints: they stay
    #: the same in every turn of a search.
    cache: ColumnCache = field(default_factory=dict)

    @property
    def axes(self) -> int:
        """Number of axes."""
        return self.observation.axis_count

    def test(
        self, families: Iterable[Sequence[Effect]], axis: int, *, at_rows: bool = False
    ) -> tuple[FamilyTrials, ...]:
        """Test families on an axis; families that the model contains already are left out.

        Columns built `at_rows` are fast, and good for effects that change slowly.
        """
        if at_rows:
            torque = self.torque_at_rows
        else:
            torque = self.torque
        robot = self.model.robot
        placed: list[Effect] = []
        family_of: list[int] = []
        for number, family in enumerate(families):
            for effect in family:
                if is_placeable(effect, axis, robot):
                    placed.append(effect)
                    family_of.append(number)
        # Trials of all families together: candidates of one width share matrix products.
        trials = self.trials(torque(effect, axis) for effect in placed)
        members: dict[int, list[tuple[Effect, CandidateTrial]]] = {}
        for number, effect, trial in zip(family_of, placed, trials, strict=True):
            if trial is not None:
                members.setdefault(number, []).append((effect, trial))
        return tuple(FamilyTrials(axis, tuple(found)) for found in members.values())

    def trials(self, torques: Iterable[FloatArray]) -> tuple[CandidateTrial | None, ...]:
        """Test candidates given by joint torques (m, p, r); None where the model contains them."""
        return _scored(self.folds, self._whitened(torques))

    def test_each(
        self, placed: Iterable[PlacedEffect], torques: Iterable[FloatArray]
    ) -> tuple[FamilyTrials, ...]:
        """Test effects, each by itself, by their joint torques (m, p, r).

        Those that the model contains already are left out.
        """
        trials = self.trials(torques)
        tested: list[FamilyTrials] = []
        for one, trial in zip(placed, trials, strict=True):
            if trial is not None:
                tested.append(FamilyTrials(one.axis, ((one.effect, trial),)))
        return tuple(tested)

    def fits(self, torques: Iterable[FloatArray]) -> tuple[CandidateFit | None, ...]:
        """Fit candidates given by joint torques (m, p, r) to all rows, without folds.

        It takes a tenth of the time.
        """
        return fit_candidates(self.folds, self._whitened(torques))

    def fits_at_rows(self, effects: Iterable[Effect], axis: int) -> list[FitAtRows]:
        """Fit effects on an axis by columns built at the rows.

        Those that the model contains already, or that cannot be there, are left out.
        """
        robot = self.model.robot
        placed = [effect for effect in effects if is_placeable(effect, axis, robot)]
        fits = self.fits(self.torque_at_rows(effect, axis) for effect in placed)
        shares = shares_explained(self, fits)
        found: list[FitAtRows] = []
        for effect, fit, share in zip(placed, fits, shares, strict=True):
            if fit is not None:
                found.append(FitAtRows(effect, fit, share))
        return found

    def _whitened(self, torques: Iterable[FloatArray]) -> Iterator[tuple[int, WhitenedColumns]]:
        """Yield the number of columns of each candidate, and its whitened columns.

        DECORRELATED_TOGETHER candidates are decorrelated at once. Only one torque, (m, p, r), is in
        memory at a time: it is far larger than the columns of the motors that it loads.
        """
        problem = self.folds.linearisation
        to_motor = self.model.drive_train.to_motor
        remaining = iter(torques)
        while True:
            widths: list[int] = []
            whitened: list[dict[int, FloatArray]] = []
            for torque in islice(remaining, DECORRELATED_TOGETHER):
                widths.append(torque.shape[1])
                whitened.append(problem.whitened_by_motor(torque, to_motor))
            if not whitened:
                return
            decorrelated = problem.decorrelated_by_motor(whitened)
            yield from zip(widths, decorrelated, strict=True)

    def torque(self, effect: Effect, axis: int) -> FloatArray:
        """Return an effect's columns as joint torques on the rows [Nm per unit], shape (m, p, r).

        The rows are those of the observation.
        """
        if isinstance(effect, GeometryEffect):
            # The torque of the whole arm, once more, and it is smooth
            return self.torque_at_rows(effect, axis)
        rounded = self.cache.get((effect, axis))
        if rounded is None:
            columns = effect_columns(
                effect, axis, self.runs, self.datasets, self.observation.conditioning
            )
            # Rounded also where it is not cached, so that a cache does not change a result.
            rounded = columns.astype(np.float32)
            if effect.abscissa.is_independent_of_model:
                self.cache[effect, axis] = rounded
        return at_joints(effect, axis, rounded.astype(np.float64), self.model.drive_train)

    def torque_at_rows(self, effect: Effect, axis: int) -> FloatArray:
        """Build the same, shape (m, p, r), from signals at the rows.

        It is fast, and good for effects that change slowly.
        """
        if effect.abscissa in FAST:
            return self.torque(effect, axis)
        conditioning = self.observation.conditioning
        columns_of_runs: list[FloatArray] = []
        for run in self.rows:
            own = columns_at(effect, run, axis)
            columns_of_runs.append(as_recorded(run.rate_hz, conditioning, own))
        columns = np.concatenate(columns_of_runs, axis=-1)
        return at_joints(effect, axis, columns, self.model.drive_train)


@dataclass(frozen=True, slots=True)
class FitAtRows:
    """An effect on an axis, fitted by columns built at the rows."""

    effect: Effect
    fit: CandidateFit
    share: float  #: that it explains of the squared residual of its strongest motor


@dataclass(frozen=True, slots=True)
class FamilyTrials:
    """Trials of one family on one axis."""

    axis: int  #: index
    members: tuple[tuple[Effect, CandidateTrial], ...]  #: settings and their trials, at least one

    def nested(self) -> FloatArray:
        """‖r‖² by fold and motor, shape (folds, m): each fold's setting is chosen by the others.

        So the score of a family has not seen what it is scored on (nested cross-validation).
        """
        trials = [trial for _, trial in self.members]
        training_falls = np.stack([trial.training_fall for trial in trials])
        best_of_folds = np.argmax(training_falls, axis=0)
        squares = [trials[best].left_out[fold] for fold, best in enumerate(best_of_folds)]
        return np.stack(squares)


@dataclass(frozen=True, slots=True)
class CandidateTrial:
    """Result of testing one candidate; symbols as at the top of this module."""

    coefficients: FloatArray  #: β, in-sample, in the unit of the columns, shape (p,)
    fall_by_motor: FloatArray  #: in-sample fall of ‖e‖² of each motor, shape (m,)
    #: fall of ‖e‖² on the other folds, by which a setting may be chosen, shape (folds,)
    training_fall: FloatArray
    #: ‖e‖² of each fold and motor with the candidate fitted on the others, shape (folds, m)
    left_out: FloatArray
    score: FloatArray  #: Φ⊥ᵀe, shape (p,)
    #: X: Φ⊥ᵀ(e − Φ⊥β) of each cluster, its noise alone, shape (clusters, p)
    scatter: FloatArray
    gram: FloatArray  #: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p); their sum is G
    #: The candidate without the moves of most leverage, where it rests on few moves; None where it
    #: rests on many.
    without_leverage: MoveScores | None = None

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the coefficients by the scatter of moves, shape (p, p).

        It is G⁻¹XᵀXG⁻¹ (Liang & Zeger, 1986).
        """
        shares = self._cluster_shares()
        return np.asarray(shares.T @ shares)

    @property
    def deviations(self) -> FloatArray:
        """σ of the coefficients, by the same scatter, shape (p,)."""
        variances = np.sum(self._cluster_shares() ** 2, axis=0)
        return np.asarray(np.sqrt(variances))

    def _cluster_shares(self) -> FloatArray:
        """Share of each cluster's noise in the coefficients, X G⁻¹, shape (clusters, p)."""
        inverse = np.linalg.pinv(self.gram.sum(axis=0))
        return np.asarray(self.scatter @ inverse)


def shares_explained(
    search_problem: SearchProblem, trials: Sequence[CandidateTrial | CandidateFit | None]
) -> list[float]:
    """Return the share of the squared residual that each trial explains, of its strongest motor."""
    problem = search_problem.folds.linearisation
    squares_by_motor = np.bincount(problem.motor, problem.residual**2)
    shares: list[float] = []
    for trial in trials:
        if trial is None:
            shares.append(0.0)
        else:
            share_by_motor = trial.fall_by_motor / squares_by_motor
            shares.append(float(np.max(share_by_motor)))
    return shares


def prepare_search(
    model: Model,
    datasets: Sequence[Dataset],
    observation: Observation,
    estimate: Estimate,
    cache: ColumnCache | None = None,
    effects: Sequence[PlacedEffect] = (),
) -> SearchProblem:
    """Linearise around an estimate by ``ml``, cut into folds, and predict the signals of every run.

    The caller may keep a cache from turn to turn, for these datasets alone. Of the effects in the
    estimate, the signals know the rotors that they show.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    began_s = session_began_s(datasets)
    fitted = (fitted_signals(model, data, observation, estimate, began_s) for data in datasets)
    runs = tuple(beside_rotors(run, effects) for run in fitted)
    folds, step = folds_around(model, observation, estimate)

    floors_a: list[float | None] = []
    for floor in noise_floors(datasets, observation.conditioning):
        if floor is None:
            floors_a.append(None)
        else:
            floors_a.append(floor.noise_a)
    rows: list[Signals] = []
    for run, data in zip(runs, datasets, strict=True):
        rows.append(_signals_at_rows(run, data, observation.conditioning))
    if cache is None:
        cache = {}
    return SearchProblem(
        model=model,
        datasets=datasets,
        observation=observation,
        runs=runs,
        rows=tuple(rows),
        folds=folds,
        floors_a=tuple(floors_a),
        step=step,
        cache=cache,
    )


def _signals_at_rows(run: Signals, data: Dataset, conditioning: Conditioning) -> Signals:
    """Decimate the signals of a run to its rows; inertia is left out."""
    series: dict[str, FloatArray] = {}
    for one in fields(run):
        if one.name in NOT_DECIMATED:
            continue
        array = getattr(run, one.name)
        # A signal that the run lacks is None, or has no samples.
        if array is not None and array.shape[-1]:
            series[one.name] = decimate_rows(data, conditioning, array)
    time_s = series["time_s"]
    duration_s = time_s[-1] - time_s[0]
    # The arm of a closed chain moves joints that are not axes: it is followed from the axes again.
    arm = run.arm
    if arm is not None:
        # Samples come first in a dataset, and last in what is decimated.
        decimated = each_state(
            data.motion(), lambda states: decimate_rows(data, conditioning, states.T).T
        )
        arm = replace(arm, motion=decimated)
    return Signals(
        rate_hz=float((len(time_s) - 1) / duration_s),
        inertia_kg_m2=run.inertia_kg_m2[..., :0],
        arm=arm,
        rotor_inertia_kg_m2=run.rotor_inertia_kg_m2,
        **series,
    )


def folds_around(
    model: Model, observation: Observation, estimate: Estimate
) -> tuple[Folds, FloatArray]:
    """Return the problem around an estimate in folds, and the step to its best fit, shape (u,).

    Friction differs from run to run in it.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    piece_of_row, move_of_piece = _pieces(observation)
    problem = linearise(
        replace(observation, move=piece_of_row),  # its clusters are pieces of moves
        estimate.gains,
        estimate.parameters,
        estimate.axis_noise,
        gains_fixed=estimate.gains_fixed,
    )
    with_friction = _with_friction_of_runs(problem, model, observation, estimate)
    problem, step = with_friction.fitted()
    return cut_into_folds(problem, move_of=move_of_piece), step


def _with_friction_of_runs(
    problem: Linearisation, model: Model, observation: Observation, estimate: Estimate
) -> Linearisation:
    """Let viscous and dry friction differ at random from run to run.

    The problem of a single run stays the same.
    The rows of a redundant drive hold all motors at once, and their derivative to a gain would no
    longer be exact.
    """
    runs = np.unique(observation.run)
    if len(runs) < 2 or model.is_redundant:
        return problem
    is_friction = np.isin(observation.base.independent, model.friction_columns)
    friction = np.flatnonzero(is_friction)
    deviation = FRICTION_OF_A_RUN * np.abs(estimate.parameters[friction])
    torque = observation.regressor[:, friction] * deviation[:, None]
    return problem.decorrelated_from_runs(torque, model.drive_train.to_motor, observation.run)


def _pieces(observation: Observation) -> tuple[IntArray, IntArray]:
    """Return the piece of a move of each row, shape (r,), and the move of each piece with rows.

    The scatter of moves is known well only from many: moves of a short recording are cut into
    pieces of many correlation times (0.05 s) each. Folds still take whole moves.
    """
    time_s = observation.time_s
    move = observation.move
    begins_move = np.diff(move, prepend=move[0] - 1) != 0
    first = np.flatnonzero(begins_move)
    row_count = np.diff(first, append=len(move))
    last = first + row_count - 1
    moving_s = float(np.sum(time_s[last] - time_s[first]))
    if len(first) < MOVES_WANTED:
        piece_s = max(SHORTEST_PIECE_S, moving_s / MOVES_WANTED)
    else:
        piece_s = np.inf  # each move is one piece
    since_begin_s = time_s - np.repeat(time_s[first], row_count)
    number_in_move = np.floor(since_begin_s / piece_s).astype(np.int64)
    begins_piece = np.diff(number_in_move, prepend=-1) != 0
    piece = np.cumsum(begins_move | begins_piece).astype(np.int64)
    used_rows = np.flatnonzero(observation.motor_use.any(axis=0))
    _, first_used = np.unique(piece[used_rows], return_index=True)
    return piece, move[used_rows[first_used]]


def score_candidates(
    folds: Folds, columns: FloatArray, candidates: Sequence[slice]
) -> tuple[CandidateTrial | None, ...]:
    """Project columns off all declared directions, gains included, and measure what they explain.

    Args:
        folds: the problem in folds.
        columns: whitened candidate columns, shape (rows, q).
        candidates: which columns belong together.

    Returns:
        one trial a candidate; None where the declared model contains it already.
    """
    whitened: list[tuple[int, WhitenedColumns]] = []
    for chosen in candidates:
        candidate = columns.T[chosen]
        by_motor: dict[int, FloatArray] = {}
        for own in folds.motors:
            of_motor = candidate[:, own.rows]
            if of_motor.any():
                by_motor[own.motor] = of_motor
        whitened.append((len(candidate), by_motor))
    return _scored(folds, whitened)


def _scored(
    folds: Folds, candidates: Iterable[tuple[int, WhitenedColumns]]
) -> tuple[CandidateTrial | None, ...]:
    """Test candidates, each given by its number of columns and the columns of its motors."""
    before = folds.square_sum(folds.residual)

    def score(width: int, batch: Sequence[WhitenedColumns]) -> Sequence[CandidateTrial | None]:
        return _scored_together(folds, before, width, batch)

    return in_batches(candidates, score)


def _scored_together(
    folds: Folds, before: FloatArray, width: int, candidates: Sequence[WhitenedColumns]
) -> Sequence[CandidateTrial | None]:
    """Test candidates with the same number of columns p.

    Everything is computed from products that are summed block by block, so that no candidate needs
    a pass over the rows of its own. Candidates that the declared model contains already are dropped
    before the sums over moves and folds are made.

    Args:
        folds: the problem.
        before: ‖r‖² of each fold and motor, shape (folds, m).
        width: p.
        candidates: their columns.
    """
    of_motors: list[_Products] = []
    for own in folds.motors:
        numbers = candidates_of_motor(candidates, own.motor)
        if len(numbers):
            of_motors.append(_products(own, numbers, candidates))
    sums = MotorSums.empty(folds, len(candidates), width)
    for products in of_motors:
        products.add_to(sums)
    projection = Projection.of(folds, sums)
    new = np.flatnonzero(is_new(projection.gram, sums.squares))
    results: list[CandidateTrial | None] = [None] * len(candidates)
    if not len(new):
        return results
    if len(new) < len(candidates):
        of_motors = [products.only(new) for products in of_motors]
        sums = sums.only(new)
        projection = projection.only(new)
    trials = _tried_on_folds(folds, before, of_motors, sums, projection)
    for number, trial in zip(new, trials, strict=True):
        results[number] = trial
    return results


def _tried_on_folds(
    folds: Folds,
    before: FloatArray,
    of_motors: Sequence[_Products],
    sums: MotorSums,
    projection: Projection,
) -> tuple[CandidateTrial, ...]:
    """Test c candidates that the declared model lacks, on moves and on folds.

    Args:
        folds, before: see `_scored_together`.
        of_motors: products of the candidates with the rows of each motor.
        sums: the same, summed over all rows.
        projection: of the candidates.
    """
    along = projection.along  # w = H⁻¹JᵀΦ, transposed
    # Of each cluster: Φ⊥ᵀΦ⊥ = wᵀJᵀJ w + ΦᵀΦ − ΦᵀJ w − wᵀJᵀΦ, and Φ⊥ᵀe = Φᵀe − wᵀJᵀe.
    gram = crossed_gram(times_hessian(along, folds.cluster_hessian), along)
    cluster_score = -times_score(along, folds.cluster_score)
    for products in of_motors:
        own = products.own
        clusters_of_candidates = np.ix_(own.cluster, products.numbers)
        seen_along = along[products.numbers][..., own.seen]
        crossed = crossed_gram(products.jacobian, seen_along)
        own_gram = products.gram - crossed - np.swapaxes(crossed, -1, -2)
        gram[clusters_of_candidates] += own_gram
        cluster_score[clusters_of_candidates] += products.score
    # β = G⁻¹ Φ⊥ᵀe, with both summed over clusters; each cluster's scatter is Φ⊥ᵀe − Φ⊥ᵀΦ⊥ β.
    score = cluster_score.sum(axis=0)
    beta = np.linalg.solve(gram.sum(axis=0), score[..., None])[..., 0]
    fall_by_motor = fall_of_motors(folds, sums, along, beta)
    fitted_score = (gram @ beta[..., None])[..., 0]
    scatter = cluster_score - fitted_score
    training_fall, left_out = _left_out(folds, before, of_motors, sums)
    trials: list[CandidateTrial] = []
    for number in range(len(along)):
        projected = gram[:, number]
        trial = CandidateTrial(
            coefficients=beta[number],
            fall_by_motor=fall_by_motor[number],
            training_fall=training_fall[:, number],
            left_out=left_out[:, :, number],
            score=score[number],
            scatter=scatter[:, number],
            gram=projected,
            without_leverage=_without_leverage(folds, of_motors, number, projected),
        )
        trials.append(trial)
    return tuple(trials)


def _left_out(
    folds: Folds, before: FloatArray, of_motors: Sequence[_Products], sums: MotorSums
) -> tuple[FloatArray, FloatArray]:
    """Fit candidates with J and Φ of the other folds, for each fold k.

    There the declared model takes J w_k of the columns, with w_k = H_k⁻¹ J_kᵀΦ_k of the rows that
    are not in the fold. What is left of them, Φ − J w_k, is fitted on these rows, and predicts the
    fold.

    Returns:
        fall of ‖e‖² on the other folds, shape (folds, c), and ‖r‖² on the fold, (folds, m, c).
    """
    _, count, width, unknowns = sums.jacobian.shape
    # ΦᵀJ, ΦᵀΦ, Φᵀe and Φᵀr of each fold and motor.
    motors = len(folds.linearisation.gamma)
    parts = (folds.count, motors, count, width)
    part_jacobian = np.zeros((*parts, unknowns))
    part_gram = np.zeros((*parts, width))
    part_score = np.zeros(parts)
    part_left_out_score = np.zeros(parts)
    for products in of_motors:
        own = products.own
        numbers = products.numbers
        motor_of_candidates = np.s_[:, own.motor, numbers]
        # A motor sees some of the unknowns only.
        jacobian = np.zeros((folds.count, len(numbers), width, unknowns))
        jacobian[..., own.seen] = own.by_fold(products.jacobian, folds.count)
        part_jacobian[motor_of_candidates] = jacobian
        part_gram[motor_of_candidates] = own.by_fold(products.gram, folds.count)
        part_score[motor_of_candidates] = own.by_fold(products.score, folds.count)
        left_out_score = own.by_fold(products.left_out_score, folds.count)
        part_left_out_score[motor_of_candidates] = left_out_score
    # Of the other folds: all, less the fold's own part.
    other_jacobian = sums.jacobian.sum(axis=0) - part_jacobian.sum(axis=1)
    along_of_folds: list[FloatArray] = []
    along_hessian_of_folds: list[FloatArray] = []
    for factor, jacobian, hessian in zip(
        folds.factors, other_jacobian, folds.part_hessian, strict=True
    ):
        along_of_fold = solved(factor, jacobian)
        along_of_folds.append(along_of_fold)
        along_hessian_of_folds.append(times_hessian(along_of_fold, hessian))
    along = np.stack(along_of_folds)  # w_kᵀ, shape (folds, c, p, f)
    # (Φ − J w_k)ᵀe on the other folds, shape (folds, c, p).
    other_score = part_score.sum(axis=(0, 1)) - part_score.sum(axis=1)
    other_score -= (along @ folds.scores[:, None, :, None])[..., 0]
    # (Φ − J w_k)ᵀr on the fold, motor by motor, shape (folds, m, c, p).
    declared_score = (along[:, None] @ folds.part_score[:, :, None, :, None])[..., 0]
    fold_score = part_left_out_score - declared_score
    # G of the other folds; a combination of columns that they do not show at all gets no
    # coefficient: in the columns' own units, β_k is the shortest of all solutions.
    unit = np.sqrt(sums.squares)
    other_gram = sums.gram.sum(axis=0) - part_gram.sum(axis=1)
    projected = other_gram - crossed_gram(other_jacobian, along)
    units = unit[:, :, None] * unit[:, None, :]
    inverse = _shortest_inverse(projected / units)
    score_in_own_unit = (other_score / unit)[..., None]
    beta = (inverse @ score_in_own_unit)[..., 0] / unit
    # ‖r − (Φ − J w_k) β_k‖² = ‖r‖² − 2 β_kᵀ(Φ − J w_k)ᵀr + β_kᵀ(Φ − J w_k)ᵀ(Φ − J w_k) β_k, of
    # fold k, motor n and candidate c.
    along_hessian = np.stack(along_hessian_of_folds)
    fold_gram = projected_gram(part_gram, part_jacobian, along[:, None], along_hessian)
    linear = np.einsum("kncp,kcp->knc", fold_score, beta)
    squares = before[:, :, None] - 2.0 * linear
    squares += np.einsum("kcp,kncpq,kcq->knc", beta, fold_gram, beta)
    training_fall = np.sum(other_score * beta, axis=-1)
    return training_fall, squares


def _shortest_inverse(matrices: FloatArray) -> FloatArray:
    """Pseudoinverse of matrices in their own units, shape (…, p, p).

    That of single numbers needs no decomposition.
    """
    if matrices.shape[-1] > 1:
        return np.asarray(np.linalg.pinv(matrices, rcond=SMALLEST_SINGULAR))
    inverse = np.zeros_like(matrices)
    np.divide(1.0, matrices, out=inverse, where=matrices != 0.0)
    return inverse


@dataclass(frozen=True, slots=True)
class _Products:
    """Products with J, Φ, e and r, block by block, of the candidates that load one motor."""

    own: MotorRows  #: the motor's rows
    numbers: IntArray  #: of these candidates, c of them, among those of the batch
    jacobian: FloatArray  #: ΦᵀJ, shape (blocks, c, p, s)
    gram: FloatArray  #: ΦᵀΦ, shape (blocks, c, p, p)
    score: FloatArray  #: Φᵀe, shape (blocks, c, p)
    left_out_score: FloatArray  #: Φᵀr, shape (blocks, c, p)

    def add_to(self, sums: MotorSums) -> None:
        """Put the sums over all blocks into their places."""
        jacobian = self.jacobian.sum(axis=0)
        gram = self.gram.sum(axis=0)
        score = self.score.sum(axis=0)
        sums.put(self.own, self.numbers, jacobian=jacobian, gram=gram, score=score)

    def only(self, chosen: IntArray) -> _Products:
        """The same of some of the candidates, numbered by their place in ``chosen``."""
        inside = np.flatnonzero(np.isin(self.numbers, chosen))
        return _Products(
            own=self.own,
            numbers=np.searchsorted(chosen, self.numbers[inside]),
            jacobian=self.jacobian[:, inside],
            gram=self.gram[:, inside],
            score=self.score[:, inside],
            left_out_score=self.left_out_score[:, inside],
        )


def _products(
    own: MotorRows, numbers: IntArray, candidates: Sequence[WhitenedColumns]
) -> _Products:
    """Products of those candidates, by number, that load a motor."""
    columns = np.stack([candidates[number][own.motor] for number in numbers])
    count, width, rows = columns.shape
    flat = own.sums(columns.reshape(-1, rows), own.equations)
    # The equations of a motor are J, then e and r (`MotorRows.equations`).
    with_equations = flat.reshape(len(flat), count, width, -1)
    return _Products(
        own=own,
        numbers=numbers,
        jacobian=with_equations[..., :-2],
        gram=own.grams(columns),
        score=with_equations[..., -2],
        left_out_score=with_equations[..., -1],
    )


def _without_leverage(
    folds: Folds, of_motors: Sequence[_Products], number: int, projected: FloatArray
) -> MoveScores | None:
    """One candidate without the moves of most leverage; None where it rests on many.

    Args:
        folds: the problem.
        of_motors: products of all candidates of the batch.
        number: of the candidate.
        projected: its Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p).
    """
    if moves_behind(projected) >= FEW_MOVES:
        return None
    clusters_and_columns = projected.shape[:2]
    unknowns = folds.linearisation.jacobian.width
    jacobian = np.zeros((*clusters_and_columns, unknowns))
    squares = np.zeros(projected.shape)
    scores = np.zeros(clusters_and_columns)
    for products in of_motors:
        own = products.own
        clusters = own.cluster
        for index in np.flatnonzero(products.numbers == number):
            # Both index arrays go first: the shape is that of (clusters, s, p).
            own_jacobian = np.swapaxes(products.jacobian[:, index], 1, 2)
            jacobian[clusters[:, None], :, own.seen] += own_jacobian
            squares[clusters] += products.gram[:, index]
            scores[clusters] += products.score[:, index]
    return without_most_leverage(folds, jacobian, squares, scores, projected)
