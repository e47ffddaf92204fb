"""Candidates tested on a residual: the search problem, and trials of effects on it,
in-sample and on held-out moves.

Friction differs from run to run, as temperature and mounting do. A search that took moves of all
runs as exchangeable would find laws in that. So `prepare_search` takes the friction of every run as
drawn around the common one: the rows are decorrelated (`ident.equations.run_scatter`), and trials,
folds and bootstrap see what a law within the runs explains. The estimate knows nothing of it:
shifts of gains are those of the estimate (`Folds.estimate_factor`).

A *candidate* is an effect with one choice of settings on one axis. A *trial* projects its columns
off all declared directions, gains included, and measures what they explain of the residual:
in-sample, and on folds of held-out moves. A *family* is one effect with all settings that the
dictionary tries.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from ident.arrays import FloatArray, IntArray
from ident.data.conditioning import as_recorded
from ident.data.dataset import Dataset
from ident.discovery.candidate_fits import (
    CandidateFit,
    Felt,
    MotorSums,
    Projection,
    crossed_gram,
    fall_of_motors,
    felt_by,
    fit_candidates,
    in_batches,
    is_new,
    projected_gram,
    pushed,
    scored_along,
    solved,
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
from ident.model.robot import Motion

ColumnCache = dict[tuple[Effect, int], npt.NDArray[np.float32]]
"""Columns of candidates by effect and axis.

There are hundreds, and single precision is enough for their trials.
"""
DECORRELATED_TOGETHER = 16  #: Candidates that are decorrelated at once
MOVES_WANTED = 60
SHORTEST_PIECE_S = 0.25
UNSEEN = 1e-9  #: Share of a direction, squared, below which the folds of a fit do not show it
#: Fields of `Signals` that do not change in a run
NO_SERIES = frozenset({"rate_hz", "rotor_inertia_kg_m2", "arm"})
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
    #: From the estimate to the best fit where friction differs by run, in the scale of the
    #: unknowns, shape (f,).
    step: FloatArray
    #: Columns of motion and time alone, which stay the same from turn to turn, before they are
    #: placed at joints.
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
        torque = self.torque_at_rows if at_rows else self.torque
        placed = [
            (number, effect)
            for number, family in enumerate(families)
            for effect in family
            if is_placeable(effect, axis, self.model.robot)
        ]
        trials = self.trials(torque(effect, axis) for _, effect in placed)
        members: dict[int, list[tuple[Effect, CandidateTrial]]] = {}
        for (number, effect), trial in zip(placed, trials, strict=True):
            if trial is not None:
                members.setdefault(number, []).append((effect, trial))
        return tuple(FamilyTrials(axis, tuple(found)) for found in members.values())

    def trials(self, torques: Iterable[FloatArray]) -> tuple[CandidateTrial | None, ...]:
        """Test candidates given by their joint torques (m, p, r);
        None where the model contains them already.
        """
        return _scored(self.folds, self._felt(torques))

    def fits(self, torques: Iterable[FloatArray]) -> tuple[CandidateFit | None, ...]:
        """Fit candidates to all rows, without folds and moves, which takes a tenth of the time;
        see `trials`.
        """
        return fit_candidates(self.folds, self._felt(torques))

    def fits_at_rows(
        self, effects: Iterable[Effect], axis: int
    ) -> list[tuple[Effect, CandidateFit]]:
        """Fit effects on an axis by columns built at the rows;
        those that the model contains already, or that cannot be there, are left out.
        """
        robot = self.model.robot
        placed = [effect for effect in effects if is_placeable(effect, axis, robot)]
        fits = self.fits(self.torque_at_rows(effect, axis) for effect in placed)
        found: list[tuple[Effect, CandidateFit]] = []
        for effect, fit in zip(placed, fits, strict=True):
            if fit is not None:
                found.append((effect, fit))
        return found

    def _felt(self, torques: Iterable[FloatArray]) -> Iterator[tuple[int, Felt]]:
        """Number of columns of each candidate, and its whitened columns;
        some are decorrelated at once.
        """
        problem, to_motor = self.folds.linearisation, self.model.drive_train.to_motor
        # One torque after the other is in memory: it is far larger than what single motors feel of
        # it.
        whitened = (
            (torque.shape[1], problem.whitened_by_motor(torque, to_motor)) for torque in torques
        )
        while together := list(islice(whitened, DECORRELATED_TOGETHER)):
            widths, felt = zip(*together, strict=True)
            yield from zip(widths, problem.decorrelated_by_motor(felt), strict=True)

    def torque(self, effect: Effect, axis: int) -> FloatArray:
        """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (m,
        p, r).
        """
        if isinstance(effect, GeometryEffect):
            # The torque of the whole arm, once more, and it is smooth
            return self.torque_at_rows(effect, axis)
        kept = self.cache.get((effect, axis))
        if kept is None:
            columns = effect_columns(
                effect, axis, self.runs, self.datasets, self.observation.conditioning
            )
            kept = columns.astype(np.float32)
            if effect.abscissa.is_independent_of_model:
                self.cache[effect, axis] = kept
        return at_joints(effect, axis, kept.astype(np.float64), self.model.drive_train)

    def torque_at_rows(self, effect: Effect, axis: int) -> FloatArray:
        """Build the same from signals that are decimated already:
        fast, and good for effects that change slowly.
        """
        if effect.abscissa in FAST:
            return self.torque(effect, axis)
        conditioning = self.observation.conditioning
        parts = [
            as_recorded(run.rate_hz, conditioning, columns_at(effect, run, axis))
            for run in self.rows
        ]
        columns = np.concatenate(parts, axis=-1)
        return at_joints(effect, axis, columns, self.model.drive_train)


@dataclass(frozen=True, slots=True)
class FamilyTrials:
    """Trials of one family on one axis."""

    axis: int  #: index
    members: tuple[tuple[Effect, CandidateTrial], ...]  #: settings and their trials, at least one

    def nested(self) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, m),
        with the setting chosen by the other folds alone.
        """
        chosen = np.argmax(np.stack([trial.training_fall for _, trial in self.members]), axis=0)
        return np.stack([self.members[best][1].held_out[fold] for fold, best in enumerate(chosen)])


@dataclass(frozen=True, slots=True)
class CandidateTrial:
    """Result of testing one candidate."""

    coefficients: FloatArray  #: in-sample, in the unit of the columns, shape (p,)
    fallen: FloatArray  #: in-sample fall of ‖e‖² of each motor, shape (m,)
    #: fall of ‖e‖² on the other folds, by which a setting may be chosen, shape (folds,)
    training_fall: FloatArray
    #: ‖e‖² of each fold and motor with the candidate fitted on the others, shape (folds, m)
    held_out: FloatArray
    score: FloatArray  #: Φ⊥ᵀe, shape (p,)
    #: Φ⊥ᵀe of each cluster with the candidate fitted: its noise alone, shape (clusters, p)
    scatter: FloatArray
    gram: FloatArray  #: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p)
    #: Without the moves of most leverage, of a candidate that rests on few; None of one that rests
    #: on many.
    rest: MoveScores | None = None

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the coefficients by the scatter of moves, G⁻¹XᵀXG⁻¹ (Liang & Zeger, 1986),
        shape (p, p).
        """
        spread = self._spread()
        return np.asarray(spread.T @ spread)

    @property
    def deviations(self) -> FloatArray:
        """σ of the coefficients, by the same scatter, shape (p,)."""
        return np.asarray(np.sqrt(np.sum(self._spread() ** 2, axis=0)))

    def _spread(self) -> FloatArray:
        """What each cluster adds to the coefficients, shape (clusters, p)."""
        return np.asarray(self.scatter @ np.linalg.pinv(self.gram.sum(axis=0)))


def shares_explained(
    search_problem: SearchProblem, trials: Sequence[CandidateTrial | CandidateFit | None]
) -> list[float]:
    """Share of a motor's squared residual that each trial explains,
    of the motor that it affects most.
    """
    problem = search_problem.folds.linearisation
    left = np.bincount(problem.motor, problem.residual**2)
    return [0.0 if trial is None else float(np.max(trial.fallen / left)) for trial in trials]


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
    floors = noise_floors(datasets, observation.conditioning)
    rows: list[Signals] = []
    for run, data in zip(runs, datasets, strict=True):
        at_rate = {
            array.name: getattr(run, array.name)
            for array in fields(run)
            if array.name not in NO_SERIES
        }
        sampled = {
            name: array for name, array in at_rate.items() if array is not None and array.shape[-1]
        }
        known = {name: array for name, array in sampled.items() if name != "inertia_kg_m2"}
        arrays = {
            name: decimate_rows(data, observation.conditioning, array)
            for name, array in known.items()
        }
        time_s, none = arrays["time_s"], run.inertia_kg_m2[..., :0]
        rate_hz = float((len(time_s) - 1) / (time_s[-1] - time_s[0]))
        # The arm of a closed chain moves joints that are not axes: it is followed from the axes
        # again.
        states = (
            decimate_rows(data, observation.conditioning, state.T).T
            for state in (data.position_rad, data.velocity_rad_s, data.acceleration_rad_s2)
        )
        arm = None if run.arm is None else replace(run.arm, motion=Motion(*states))
        rows.append(
            Signals(
                rate_hz=rate_hz,
                inertia_kg_m2=none,
                arm=arm,
                rotor_inertia_kg_m2=run.rotor_inertia_kg_m2,
                **arrays,
            )
        )
    return SearchProblem(
        model=model,
        datasets=datasets,
        observation=observation,
        runs=runs,
        rows=tuple(rows),
        folds=folds,
        floors_a=tuple(None if floor is None else floor.noise_a for floor in floors),
        step=step,
        cache={} if cache is None else cache,
    )


def folds_around(
    model: Model, observation: Observation, estimate: Estimate
) -> tuple[Folds, FloatArray]:
    """The problem around an estimate in folds, with friction that differs by run,
    and the step to its best fit.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    pieces, move_of = _pieces(observation)
    problem = linearise(
        replace(observation, move=pieces),
        estimate.gains,
        estimate.parameters,
        estimate.axis_noise,
        gains_fixed=estimate.gains_fixed,
    )
    problem, step = _with_friction_of_runs(problem, model, observation, estimate).fitted()
    return cut_into_folds(problem, move_of=move_of), step


def _with_friction_of_runs(
    problem: Linearisation, model: Model, observation: Observation, estimate: Estimate
) -> Linearisation:
    """Let viscous and dry friction differ at random from run to run;
    the same problem of a single run.

    The rows of a redundant drive hold all motors at once, and their derivative to a gain would no
    longer be exact.
    """
    if len(np.unique(observation.run)) < 2 or model.is_redundant:
        return problem
    rubbing = np.flatnonzero(np.isin(observation.base.independent, model.friction_columns))
    deviation = FRICTION_OF_A_RUN * np.abs(estimate.parameters[rubbing])
    torque = observation.regressor[:, rubbing] * deviation[:, None]
    return problem.beside_scatter(torque, model.drive_train.to_motor, observation.run)


def _pieces(observation: Observation) -> tuple[IntArray, IntArray]:
    """Piece of a move that each row belongs to, shape (r,),
    and the move that each piece with rows belongs to.

    The scatter of moves is known well only from many: moves of a short recording are cut into
    pieces of many correlation times (0.05 s) each. Folds still take whole moves.
    """
    time_s, move = observation.time_s, observation.move
    first = np.flatnonzero(np.diff(move, prepend=move[0] - 1))
    length = np.diff(first, append=len(move))
    total_s = float(np.sum(time_s[first + length - 1] - time_s[first]))
    shortest_s = (
        max(SHORTEST_PIECE_S, total_s / MOVES_WANTED) if len(first) < MOVES_WANTED else np.inf
    )
    since_s = time_s - np.repeat(time_s[first], length)
    piece = np.floor(since_s / shortest_s).astype(np.int64)
    change = (np.diff(move, prepend=move[0] - 1) != 0) | (np.diff(piece, prepend=-1) != 0)
    pieces = np.cumsum(change).astype(np.int64)
    used = np.flatnonzero(observation.motor_use.any(axis=0))
    _, at = np.unique(pieces[used], return_index=True)
    return pieces, move[used[at]]


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
    parts = [columns.T[chosen] for chosen in candidates]
    felt = (
        {own.motor: part[:, own.rows] for own in folds.motors if part[:, own.rows].any()}
        for part in parts
    )
    return _scored(folds, zip(map(len, parts), felt, strict=True))


def _scored(
    folds: Folds, candidates: Iterable[tuple[int, Felt]]
) -> tuple[CandidateTrial | None, ...]:
    """Test candidates, each given by its number of columns and these."""
    before = folds.square_sum(folds.residual)

    def score(width: int, batch: Sequence[Felt]) -> Sequence[CandidateTrial | None]:
        return _scored_together(folds, before, width, batch)

    return in_batches(candidates, score)


def _scored_together(
    folds: Folds, before: FloatArray, width: int, candidates: Sequence[Felt]
) -> Sequence[CandidateTrial | None]:
    """Test candidates with the same number of columns p.

    Everything is computed from products that are summed block by block, so that no candidate needs
    a pass over the rows of its own. What the declared model contains already leaves before the sums
    over moves and folds are made.

    Args:
        folds: the problem.
        before: ‖r‖² of each fold and motor, shape (folds, m).
        width: p.
        candidates: their columns.
    """
    made: list[_Products] = []
    for own in folds.motors:
        numbers = felt_by(candidates, own.motor)
        if len(numbers):
            made.append(_products(own, numbers, candidates))
    sums = MotorSums.empty(folds, len(candidates), width)
    for one in made:
        one.add_to(sums)
    projection = Projection.of(folds, sums)
    new = np.flatnonzero(is_new(projection.gram, sums.squares))
    results: list[CandidateTrial | None] = [None] * len(candidates)
    if not len(new):
        return results
    if len(new) < len(candidates):
        made = [one.only(new) for one in made]
        sums = sums.only(new)
        projection = projection.only(new)
    trials = _tried_on_folds(folds, before, made, sums, projection)
    for number, trial in zip(new, trials, strict=True):
        results[number] = trial
    return results


def _tried_on_folds(
    folds: Folds,
    before: FloatArray,
    made: Sequence[_Products],
    sums: MotorSums,
    projection: Projection,
) -> tuple[CandidateTrial, ...]:
    """Test c candidates that the declared model lacks on moves and folds; see `_scored_together`
    and `_HeldOut`.
    """
    along = projection.along
    # Φ⊥ = Φ − J H⁻¹ JᵀΦ, of each cluster.
    gram = crossed_gram(pushed(along, folds.cluster_hessian), along)
    cluster_score = -scored_along(along, folds.cluster_score)
    for one in made:
        at = np.ix_(one.own.cluster, one.felt)
        crossed = crossed_gram(one.jacobian, along[one.felt][..., one.own.seen])
        gram[at] += one.gram - crossed - np.swapaxes(crossed, -1, -2)
        cluster_score[at] += one.score
    fitted = np.linalg.solve(gram.sum(axis=0), cluster_score.sum(axis=0)[..., None])[..., 0]
    fallen = fall_of_motors(folds, sums, along, fitted)
    scatter = cluster_score - (gram @ fitted[..., None])[..., 0]
    held_out = _held_out(folds, before, made, sums)
    score = cluster_score.sum(axis=0)
    trials: list[CandidateTrial] = []
    for place in range(len(along)):
        own_gram = gram[:, place]
        trial = CandidateTrial(
            coefficients=fitted[place],
            fallen=fallen[place],
            training_fall=held_out.training_fall[:, place],
            held_out=held_out.squares[:, :, place],
            score=score[place],
            scatter=scatter[:, place],
            gram=own_gram,
            rest=_rest(folds, made, place, own_gram),
        )
        trials.append(trial)
    return tuple(trials)


@dataclass(frozen=True, slots=True)
class _HeldOut:
    """Candidates fitted without each fold, beside a model fitted without it."""

    training_fall: FloatArray  #: fall of ‖e‖² on the other folds, shape (folds, c)
    squares: FloatArray  #: ‖e‖² on the fold, shape (folds, m, c)


def _held_out(
    folds: Folds, before: FloatArray, made: Sequence[_Products], sums: MotorSums
) -> _HeldOut:
    """Fit candidates with J and Φ of the other folds, for each fold k: Φ − J w_k."""
    _, count, width, unknowns = sums.jacobian.shape
    # ΦᵀJ, ΦᵀΦ, Φᵀe and Φᵀr of each fold and motor.
    parts = (folds.count, len(folds.linearisation.gamma), count, width)
    part_jacobian = np.zeros((*parts, unknowns))
    part_gram = np.zeros((*parts, width))
    part_score = np.zeros(parts)
    part_held = np.zeros(parts)
    for one in made:
        place = np.s_[:, one.own.motor, one.felt]
        spread = np.zeros((folds.count, len(one.felt), width, unknowns))
        spread[..., one.own.seen] = one.own.by_fold(one.jacobian, folds.count)
        part_jacobian[place] = spread
        part_gram[place] = one.own.by_fold(one.gram, folds.count)
        part_score[place] = one.own.by_fold(one.score, folds.count)
        part_held[place] = one.own.by_fold(one.held, folds.count)
    coupling = sums.jacobian.sum(axis=0) - part_jacobian.sum(axis=1)
    step_of_folds: list[FloatArray] = []
    pushed_of_folds: list[FloatArray] = []
    for factor, own_coupling, hessian in zip(
        folds.factors, coupling, folds.part_hessian, strict=True
    ):
        step = solved(factor, own_coupling)
        step_of_folds.append(step)
        pushed_of_folds.append(pushed(step, hessian))
    steps = np.stack(step_of_folds)
    drive = part_score.sum(axis=(0, 1)) - part_score.sum(axis=1)
    drive -= (steps @ folds.scores[:, None, :, None])[..., 0]
    shown = part_held - (steps[:, None] @ folds.part_score[:, :, None, :, None])[..., 0]
    # What the other folds do not show at all is left as it is: in its own unit, the shortest of all
    # solutions.
    unit = np.sqrt(sums.squares)
    schur = sums.gram.sum(axis=0) - part_gram.sum(axis=1) - crossed_gram(coupling, steps)
    inverse = _shortest_inverse(schur / (unit[:, :, None] * unit[:, None, :]))
    without = (inverse @ (drive / unit)[..., None])[..., 0] / unit
    # r − (Φ − J w_k) fitted, squared motor by motor.
    inside = projected_gram(part_gram, part_jacobian, steps[:, None], np.stack(pushed_of_folds))
    squares = before[:, :, None] - 2.0 * np.einsum("kncp,kcp->knc", shown, without)
    squares += np.einsum("kcp,kncpq,kcq->knc", without, inside, without)
    return _HeldOut(np.sum(drive * without, axis=-1), squares)


def _shortest_inverse(matrices: FloatArray) -> FloatArray:
    """Pseudoinverse of matrices in their own units, shape (…, p, p);
    of single numbers without a decomposition.
    """
    if matrices.shape[-1] > 1:
        return np.asarray(np.linalg.pinv(matrices, rcond=UNSEEN))
    return np.divide(1.0, matrices, out=np.zeros_like(matrices), where=matrices != 0.0)


@dataclass(frozen=True, slots=True)
class _Products:
    """Products of the candidates that one motor feels with its rows, block by block,
    and of these with J, e and r.
    """

    own: MotorRows  #: the motor's rows
    felt: IntArray  #: these candidates, among those of the batch
    jacobian: FloatArray  #: ΦᵀJ, shape (blocks, c, p, s)
    gram: FloatArray  #: ΦᵀΦ, shape (blocks, c, p, p)
    score: FloatArray  #: Φᵀe, shape (blocks, c, p)
    held: FloatArray  #: Φᵀr, shape (blocks, c, p)

    def add_to(self, sums: MotorSums) -> None:
        """Put the sums over all blocks into their places."""
        sums.put(
            self.own,
            self.felt,
            jacobian=self.jacobian.sum(axis=0),
            gram=self.gram.sum(axis=0),
            score=self.score.sum(axis=0),
        )

    def only(self, chosen: IntArray) -> _Products:
        """The same of some of the candidates of the batch, which are counted anew."""
        inside = np.flatnonzero(np.isin(self.felt, chosen))
        return _Products(
            own=self.own,
            felt=np.searchsorted(chosen, self.felt[inside]),
            jacobian=self.jacobian[:, inside],
            gram=self.gram[:, inside],
            score=self.score[:, inside],
            held=self.held[:, inside],
        )


def _products(own: MotorRows, numbers: IntArray, candidates: Sequence[Felt]) -> _Products:
    inside = np.stack([candidates[number][own.motor] for number in numbers])
    flat = own.sums(inside.reshape(-1, inside.shape[-1]), own.equations)
    beside = flat.reshape(len(flat), *inside.shape[:2], -1)
    return _Products(
        own=own,
        felt=numbers,
        jacobian=beside[..., :-2],
        gram=own.grams(inside),
        score=beside[..., -2],
        held=beside[..., -1],
    )


def _rest(
    folds: Folds, made: Sequence[_Products], place: int, projected: FloatArray
) -> MoveScores | None:
    """One candidate without the moves of most leverage; None where it rests on many."""
    if moves_behind(projected) >= FEW_MOVES:
        return None
    crossed = np.zeros((*projected.shape[:2], folds.linearisation.jacobian.width))
    squares = np.zeros(projected.shape)
    scores = np.zeros(projected.shape[:2])
    for one in made:
        for index in np.flatnonzero(one.felt == place):
            clusters = one.own.cluster
            crossed[clusters[:, None], :, one.own.seen] += np.swapaxes(one.jacobian[:, index], 1, 2)
            squares[clusters] += one.gram[:, index]
            scores[clusters] += one.score[:, index]
    return without_most_leverage(folds, crossed, squares, scores, projected)
