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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice

import numpy as np
import numpy.typing as npt
from scipy import linalg

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.dataset import Dataset
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
#: Whitened columns of a candidate on the rows of each motor that feels it, (p, rows)
Felt = Mapping[int, FloatArray]

#: Columns tested together: enough for fast products, few enough to keep memory small
BATCH_COLUMNS = 48
DECORRELATED_TOGETHER = 16  #: Candidates that are decorrelated at once
MOVES_WANTED = 60
SHORTEST_PIECE_S = 0.25
#: Share of a column that must be left when all declared directions are projected out of it
REDUNDANT_SHARE = 1e-6
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
        columns = np.concatenate([columns_at(effect, run, axis) for run in self.rows], axis=-1)
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
    search_problem: SearchProblem, trials: Sequence[CandidateTrial | None]
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
    """Test candidates, each given by its number of columns and these,
    in batches of equal numbers.
    """
    trials: dict[int, CandidateTrial | None] = {}
    waiting: dict[int, dict[int, Felt]] = {}

    def score(width: int) -> None:
        batch = waiting.pop(width)
        trials.update(zip(batch, _scored_together(folds, width, list(batch.values())), strict=True))

    for number, (width, felt) in enumerate(candidates):
        waiting.setdefault(width, {})[number] = felt
        if len(waiting[width]) * width >= BATCH_COLUMNS:
            score(width)
    for width in tuple(waiting):
        score(width)
    return tuple(trials[number] for number in range(len(trials)))


def _scored_together(
    folds: Folds, width: int, candidates: Sequence[Felt]
) -> tuple[CandidateTrial | None, ...]:
    """Test c candidates with the same number of columns p.

    Everything is computed from products that are summed block by block, so that no candidate needs
    a pass over the rows of its own.
    """
    made = [
        _products(own, candidates)
        for own in folds.motors
        if any(own.motor in felt for felt in candidates)
    ]
    shape, unknowns = (len(candidates), width), folds.linearisation.jacobian.width
    # ΦᵀJ, ΦᵀΦ, Φᵀe and Φᵀr of each fold and motor.
    parts = (folds.count, len(folds.linearisation.gamma), *shape)
    part_jacobian, part_gram = np.zeros((*parts, unknowns)), np.zeros((*parts, width))
    part_score, part_held = np.zeros(parts), np.zeros(parts)
    for one in made:
        place = np.s_[:, one.own.motor, one.felt]
        spread = np.zeros((folds.count, len(one.felt), width, unknowns))
        spread[..., one.own.seen] = one.own.by_fold(one.jacobian, folds.count)
        part_jacobian[place], part_gram[place] = spread, one.own.by_fold(one.gram, folds.count)
        part_score[place], part_held[place] = (
            one.own.by_fold(part, folds.count) for part in (one.score, one.held)
        )
    motor_jacobian, fold_jacobian = part_jacobian.sum(axis=0), part_jacobian.sum(axis=1)
    motor_gram, whole_jacobian = part_gram.sum(axis=0), fold_jacobian.sum(axis=0)
    # Φ⊥ = Φ − J H⁻¹ JᵀΦ, of each cluster and of each motor.
    along = _solved(folds.full_factor, whole_jacobian)
    gram = _crossed(_pushed(along, folds.cluster_hessian), along)
    cluster_score = -_scored_along(along, folds.cluster_score)
    for one in made:
        at, crossed = (
            np.ix_(one.own.cluster, one.felt),
            _crossed(one.jacobian, along[one.felt][..., one.own.seen]),
        )
        gram[at] += one.gram - crossed - np.swapaxes(crossed, -1, -2)
        cluster_score[at] += one.score
    squares = np.diagonal(motor_gram.sum(axis=0), axis1=1, axis2=2)
    new = _is_new(gram.sum(axis=0), squares)
    if not new.all():
        kept = [felt for felt, is_new in zip(candidates, new, strict=True) if is_new]
        trials = iter(_scored_together(folds, width, kept) if kept else ())
        return tuple(next(trials) if is_new else None for is_new in new)
    fitted = np.linalg.solve(gram.sum(axis=0), cluster_score.sum(axis=0)[..., None])[..., 0]
    motor_score = part_score.sum(axis=0) - _scored_along(along, folds.motor_score)
    own = _projected_gram(
        motor_gram, motor_jacobian, along, _pushed(along, folds.part_hessian.sum(axis=0))
    )
    fallen = 2.0 * np.einsum("ncp,cp->cn", motor_score, fitted) - np.einsum(
        "cp,ncpq,cq->cn", fitted, own, fitted
    )
    scatter = cluster_score - (gram @ fitted[..., None])[..., 0]
    # The same with J and Φ of the other folds, for each fold k: Φ − J w_k.
    coupling = whole_jacobian - fold_jacobian
    steps = np.stack(
        [_solved(factor, part) for factor, part in zip(folds.factors, coupling, strict=True)]
    )
    drive = part_score.sum(axis=(0, 1)) - part_score.sum(axis=1)
    drive -= (steps @ folds.scores[:, None, :, None])[..., 0]
    shown = part_held - (steps[:, None] @ folds.part_score[:, :, None, :, None])[..., 0]
    # What the other folds do not show at all is left as it is: in its own unit, the shortest of all
    # solutions.
    unit = np.sqrt(squares)
    schur = motor_gram.sum(axis=0) - part_gram.sum(axis=1) - _crossed(coupling, steps)
    inverse = np.linalg.pinv(schur / (unit[:, :, None] * unit[:, None, :]), rcond=UNSEEN)
    without = (inverse @ (drive / unit)[..., None])[..., 0] / unit
    # r − (Φ − J w_k) fitted, squared motor by motor.
    pushed = np.stack(
        [_pushed(step, hessian) for step, hessian in zip(steps, folds.part_hessian, strict=True)]
    )
    inside = _projected_gram(part_gram, part_jacobian, steps[:, None], pushed)
    held_out = folds.square_sum(folds.residual)[:, :, None] - 2.0 * np.einsum(
        "kncp,kcp->knc", shown, without
    )
    held_out += np.einsum("kcp,kncpq,kcq->knc", without, inside, without)
    training = np.sum(drive * without, axis=-1)
    score = cluster_score.sum(axis=0)
    rests = [_rest(folds, made, place, gram[:, place]) for place in range(len(candidates))]
    return tuple(
        CandidateTrial(
            coefficients=fitted[place],
            fallen=fallen[place],
            training_fall=training[:, place],
            held_out=held_out[:, :, place],
            score=score[place],
            scatter=scatter[:, place],
            gram=gram[:, place],
            rest=rests[place],
        )
        for place in range(len(candidates))
    )


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


def _products(own: MotorRows, candidates: Sequence[Felt]) -> _Products:
    felt = np.array([number for number, columns in enumerate(candidates) if own.motor in columns])
    inside = np.stack([candidates[number][own.motor] for number in felt])
    flat = own.sums(inside.reshape(-1, inside.shape[-1]), own.equations)
    beside = flat.reshape(len(flat), *inside.shape[:2], -1)
    return _Products(
        own, felt, beside[..., :-2], own.sums(inside, inside), beside[..., -2], beside[..., -1]
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


def _is_new(gram: FloatArray, squares: FloatArray) -> BoolArray:
    """Mask of candidates that the declared model lacks, from Φ⊥ᵀΦ⊥, (c, p, p),
    and ‖φ‖² of their columns, (c, p).
    """
    size = np.diagonal(gram, axis1=1, axis2=2)
    new = np.asarray(np.all(size > REDUNDANT_SHARE * squares, axis=1))
    root = np.sqrt(size[new])
    new[new] = np.linalg.cond(gram[new] / (root[:, :, None] * root[:, None, :])) <= 1e10
    return new


def _solved(factor: tuple[FloatArray, bool], right: FloatArray) -> FloatArray:
    """H⁻¹JᵀΦ of each candidate, transposed, from ΦᵀJ, both of shape (c, p, f)."""
    return np.asarray(
        linalg.cho_solve(factor, right.reshape(-1, right.shape[-1]).T).T.reshape(right.shape)
    )


def _pushed(along: FloatArray, hessian: FloatArray) -> FloatArray:
    """w H of each part, shape (…, c, p, f), from w, shape (c, p, f), and H, shape (…, f, f)."""
    return (along.reshape(-1, along.shape[-1]) @ hessian).reshape(*hessian.shape[:-2], *along.shape)


def _scored_along(along: FloatArray, scores: FloatArray) -> FloatArray:
    """w s of each part, shape (parts, c, p), from w, shape (c, p, f), and s, shape (parts, f)."""
    return (scores @ along.reshape(-1, along.shape[-1]).T).reshape(-1, *along.shape[:-1])


def _crossed(first: FloatArray, second: FloatArray) -> FloatArray:
    """A Bᵀ of each candidate, shape (…, p, p), from A and B, shape (…, p, f)."""
    return np.asarray(first @ np.swapaxes(second, -1, -2))


def _projected_gram(
    gram: FloatArray, jacobian: FloatArray, along: FloatArray, pushed: FloatArray
) -> FloatArray:
    """(Φ − J w)ᵀ(Φ − J w) of each part, shape (…, p, p), from ΦᵀΦ, ΦᵀJ, wᵀ and wᵀJᵀJ,
    the last three (…, p, f).
    """
    crossed = _crossed(jacobian, along)
    return gram - crossed - np.swapaxes(crossed, -1, -2) + _crossed(pushed, along)
