"""Candidates tested on a residual: the search problem, and trials of effects on it, in-sample and on held-out moves.

A *candidate* is an effect with one choice of settings on one axis. A *trial* projects its columns off all declared
directions, gains included, and measures what they explain of the residual: in-sample, and on folds of held-out moves. A
*family* is one effect with all settings that the dictionary tries.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy import linalg

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.dataset import Dataset
from ident.discovery.noise_floor import noise_floors
from ident.effects.effect import Effect, at_joints, is_placeable
from ident.effects.signals import Abscissa, Signals, fitted_signals, session_began_s
from ident.equations.linearisation import Folds, cut_into_folds, linearise
from ident.equations.rows import Observation, decimate_rows
from ident.estimators.estimate import Estimate
from ident.model.model import Model

ColumnCache = dict[tuple[Effect, int], FloatArray]

BATCH_COLUMNS = 48  #: Columns tested together: enough for fast products, few enough to keep memory small
MOVES_WANTED = 60
SHORTEST_PIECE_S = 0.25
REDUNDANT_SHARE = 1e-6  #: Share of a column that must be left when all declared directions are projected out of it
UNSEEN = 1e-9  #: Share of a direction, squared, below which the folds of a fit do not show it
FAST = frozenset({Abscissa.MOTOR_ANGLE})  #: Variables that turn within a decimated row


@dataclass(frozen=True, slots=True)
class SearchProblem:
    """The residual of an estimate, ready for trials of candidates."""

    model: Model  #: the declared model
    datasets: Sequence[Dataset]  #: the runs of the fit
    observation: Observation  #: their rows, with the columns of the effects accepted so far
    runs: tuple[Signals, ...]  #: predicted signals of each run, at full rate
    rows: tuple[Signals, ...]  #: the same at the observation's rows
    folds: Folds  #: the problem around the estimate, in folds of moves
    #: Noise of each motor's current in a row that no model of motion explains; None where not known.
    floors_a: tuple[float | None, ...]
    #: Columns of motion and time alone, which stay the same from turn to turn, before they are placed at joints.
    cache: ColumnCache = field(default_factory=dict)

    @property
    def axes(self) -> int:
        """Number of axes."""
        return self.observation.joint_count

    def test(
        self, families: Iterable[Sequence[Effect]], axis: int, *, at_rows: bool = False
    ) -> tuple[FamilyTrials, ...]:
        """Test families on an axis; families that the model contains already are left out.

        Columns built `at_rows` are fast, and good for effects that change slowly.
        """
        torque = self._torque_at_rows if at_rows else self.torque
        placed = [
            (number, effect)
            for number, family in enumerate(families)
            for effect in family
            if is_placeable(effect, axis, self.model.robot)
        ]
        trials = self.trials(torque(effect, axis) for _, effect in placed)
        members: dict[int, list[tuple[Effect, Trial]]] = {}
        for (number, effect), trial in zip(placed, trials, strict=True):
            if trial is not None:
                members.setdefault(number, []).append((effect, trial))
        return tuple(FamilyTrials(axis, tuple(found)) for found in members.values())

    def trials(self, torques: Iterable[FloatArray]) -> tuple[Trial | None, ...]:
        """Test candidates given by their joint torques (n, p, r); None where the model contains them already."""
        problem, to_motor = self.folds.problem, self.model.drive_train.to_motor
        trials: list[Trial | None] = []
        parts: list[FloatArray] = []
        for torque in torques:
            parts.append(problem.whitened(torque, to_motor))
            if sum(part.shape[1] for part in parts) >= BATCH_COLUMNS:
                trials += _scored(self.folds, parts)
                parts = []
        return (*trials, *_scored(self.folds, parts))

    def torque(self, effect: Effect, axis: int) -> FloatArray:
        """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (n, p, r)."""
        columns = self.cache.get((effect, axis))
        if columns is None:
            conditioning = self.observation.conditioning
            pairs = zip(self.datasets, self.runs, strict=True)
            parts = [decimate_rows(data, conditioning, effect.columns(run, axis)) for data, run in pairs]
            columns = np.concatenate(parts, axis=-1)
            if effect.abscissa.is_kinematic:
                self.cache[effect, axis] = columns
        return at_joints(effect, axis, columns, self.model.drive_train)

    def _torque_at_rows(self, effect: Effect, axis: int) -> FloatArray:
        if effect.abscissa in FAST:
            return self.torque(effect, axis)
        columns = np.concatenate([effect.columns(run, axis) for run in self.rows], axis=-1)
        return at_joints(effect, axis, columns, self.model.drive_train)


@dataclass(frozen=True, slots=True)
class FamilyTrials:
    """Trials of one family on one axis."""

    axis: int  #: index
    members: tuple[tuple[Effect, Trial], ...]  #: settings and their trials, at least one

    def nested(self) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, n), with the setting chosen by the other folds alone."""
        chosen = np.argmax(np.stack([trial.training_fall for _, trial in self.members]), axis=0)
        return np.stack([self.members[best][1].held_out[fold] for fold, best in enumerate(chosen)])


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of testing one candidate."""

    coefficients: FloatArray  #: in-sample, in the unit of the columns, shape (p,)
    fallen: FloatArray  #: in-sample fall of ‖e‖² of each motor, shape (n,)
    training_fall: FloatArray  #: fall of ‖e‖² on the other folds, by which a setting may be chosen, shape (folds,)
    held_out: FloatArray  #: ‖e‖² of each fold and motor with the candidate fitted on the others, shape (folds, n)
    score: FloatArray  #: Φ⊥ᵀe, shape (p,)
    scatter: FloatArray  #: Φ⊥ᵀe of each cluster with the candidate fitted: its noise alone, shape (clusters, p)
    gram: FloatArray  #: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p)


def prepare_search(
    model: Model,
    datasets: Sequence[Dataset],
    observation: Observation,
    estimate: Estimate,
    cache: ColumnCache | None = None,
) -> SearchProblem:
    """Linearise around an estimate by ``ml``, cut into folds, and predict the signals of every run.

    The caller may keep a cache from turn to turn, for these datasets alone.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    pieces, move_of = _pieces(observation)
    began_s = session_began_s(datasets)
    runs = tuple(fitted_signals(model, data, observation, estimate, began_s) for data in datasets)
    problem = linearise(
        replace(observation, move=pieces),
        estimate.gains,
        estimate.parameters,
        estimate.axis_noise,
        gains_fixed=estimate.gains_fixed,
    )
    floors = noise_floors(datasets, observation.conditioning)
    rows: list[Signals] = []
    for run, data in zip(runs, datasets, strict=True):
        at_rate = {array.name: getattr(run, array.name) for array in fields(run) if array.name != "rate_hz"}
        known = {name: array for name, array in at_rate.items() if array is not None}
        arrays = {name: decimate_rows(data, observation.conditioning, array) for name, array in known.items()}
        time_s = arrays["time_s"]
        rows.append(Signals(rate_hz=float((len(time_s) - 1) / (time_s[-1] - time_s[0])), **arrays))
    return SearchProblem(
        model=model,
        datasets=datasets,
        observation=observation,
        runs=runs,
        rows=tuple(rows),
        folds=cut_into_folds(problem, move_of=move_of),
        floors_a=tuple(None if floor is None else floor.noise_a for floor in floors),
        cache={} if cache is None else cache,
    )


def _pieces(observation: Observation) -> tuple[IntArray, IntArray]:
    """Piece of a move that each row belongs to, shape (r,), and the move that each piece with rows belongs to.

    The scatter of moves is known well only from many: moves of a short recording are cut into pieces of many
    correlation times (0.05 s) each. Folds still take whole moves.
    """
    time_s, move = observation.time_s, observation.move
    first = np.flatnonzero(np.diff(move, prepend=move[0] - 1))
    length = np.diff(first, append=len(move))
    total_s = float(np.sum(time_s[first + length - 1] - time_s[first]))
    shortest_s = max(SHORTEST_PIECE_S, total_s / MOVES_WANTED) if len(first) < MOVES_WANTED else np.inf
    since_s = time_s - np.repeat(time_s[first], length)
    piece = np.floor(since_s / shortest_s).astype(np.int64)
    change = (np.diff(move, prepend=move[0] - 1) != 0) | (np.diff(piece, prepend=-1) != 0)
    pieces = np.cumsum(change).astype(np.int64)
    used = np.flatnonzero(observation.motor_use.any(axis=0))
    _, at = np.unique(pieces[used], return_index=True)
    return pieces, move[used[at]]


def _scored(folds: Folds, parts: Sequence[FloatArray]) -> tuple[Trial | None, ...]:
    """Test the candidates of one batch, each with whitened columns of shape (rows, p)."""
    if not parts:
        return ()
    ends = np.cumsum([part.shape[1] for part in parts]).tolist()
    candidates = [slice(end - part.shape[1], end) for end, part in zip(ends, parts, strict=True)]
    return score_candidates(folds, np.concatenate(parts, axis=1), candidates)


def score_candidates(folds: Folds, columns: FloatArray, candidates: Sequence[slice]) -> tuple[Trial | None, ...]:
    """Project columns off all declared directions, gains included, and measure what they explain.

    Everything is computed from products that are summed block by block, so that no candidate needs a pass over the rows
    of its own; candidates with the same number of columns p are computed together.

    Args:
        folds: the problem in folds.
        columns: whitened candidate columns, shape (rows, q).
        candidates: which columns belong together.

    Returns:
        one trial a candidate; None where the declared model contains it already.
    """
    made = _products(folds, columns)
    motor_jacobian, fold_jacobian = made.part_jacobian.sum(axis=0), made.part_jacobian.sum(axis=1)
    motor_gram, squares = made.part_gram.sum(axis=0), np.diag(made.part_gram.sum(axis=(0, 1)))
    whole_jacobian = motor_jacobian.sum(axis=0)
    # Φ⊥ = Φ − J H⁻¹ JᵀΦ, of each move and of each motor.
    along = linalg.cho_solve(folds.full_factor, whole_jacobian.T).T
    all_pushed, motor_pushed = along @ folds.cluster_hessian, along @ folds.part_hessian.sum(axis=0)
    cluster_score = made.cluster_score - folds.cluster_score @ along.T
    motor_score = made.part_score.sum(axis=0) - folds.motor_score @ along.T
    # The same with J and Φ of the other folds, for each fold k: Φ − J w_k.
    coupling = whole_jacobian - fold_jacobian
    steps = np.stack([linalg.cho_solve(factor, c.T).T for factor, c in zip(folds.factors, coupling, strict=True)])
    pushed = steps[:, None] @ folds.part_hessian
    drive = (
        made.part_score.sum(axis=(0, 1)) - made.part_score.sum(axis=1) - np.einsum("kqf,kf->kq", steps, folds.scores)
    )
    shown = made.part_held - np.einsum("kqf,knf->knq", steps, folds.part_score)
    before = folds.square_sum(folds.residual)
    trials: list[Trial | None] = [None] * len(candidates)
    starts, stops = np.array([(chosen.start, chosen.stop) for chosen in candidates]).T
    for width in np.unique(stops - starts):
        numbers = np.flatnonzero(stops - starts == width)
        at = starts[numbers, None] + np.arange(width)  # shape (c, p)
        pair = at[:, :, None], at[:, None, :]
        gram = _projected_gram(made.cluster_gram[:, *pair], made.cluster_jacobian[:, at], along[at], all_pushed[:, at])
        kept = _is_new(gram.sum(axis=0), squares[at])
        numbers, at, gram = numbers[kept], at[kept], gram[:, kept]
        pair = at[:, :, None], at[:, None, :]
        score = cluster_score[:, at].sum(axis=0)
        fitted = np.linalg.solve(gram.sum(axis=0), score[..., None])[..., 0]
        own = _projected_gram(motor_gram[:, *pair], motor_jacobian[:, at], along[at], motor_pushed[:, at])
        fallen = 2.0 * np.einsum("ncp,cp->cn", motor_score[:, at], fitted)
        fallen -= np.einsum("cp,ncpq,cq->cn", fitted, own, fitted)
        scatter = cluster_score[:, at] - (gram @ fitted[..., None])[..., 0]
        # Without fold k; what the other folds do not show at all is left as it is: in its own unit, the shortest of
        # all solutions.
        unit, step = np.sqrt(squares[at]), steps[:, at]
        part_gram = made.part_gram[:, :, *pair]
        rest = motor_gram[:, *pair].sum(axis=0) - part_gram.sum(axis=1)
        schur = rest - coupling[:, at] @ np.swapaxes(step, -1, -2)
        inverse = np.linalg.pinv(schur / (unit[:, :, None] * unit[:, None, :]), rcond=UNSEEN)
        without = (inverse @ (drive[:, at] / unit)[..., None])[..., 0] / unit
        # r − (Φ − J w_k) fitted, squared motor by motor.
        inside = _projected_gram(part_gram, made.part_jacobian[:, :, at], step[:, None], pushed[:, :, at])
        held_out = before[:, :, None] - 2.0 * np.einsum("kncp,kcp->knc", shown[:, :, at], without)
        held_out += np.einsum("kcp,kncpq,kcq->knc", without, inside, without)
        training = np.sum(drive[:, at] * without, axis=-1)
        for place, number in enumerate(numbers):
            trials[number] = Trial(
                coefficients=fitted[place],
                fallen=fallen[place],
                training_fall=training[:, place],
                held_out=held_out[:, :, place],
                score=score[place],
                scatter=scatter[:, place],
                gram=gram[:, place],
            )
    return tuple(trials)


def _is_new(gram: FloatArray, squares: FloatArray) -> BoolArray:
    """Which candidates the declared model lacks, by Φ⊥ᵀΦ⊥, shape (c, p, p), and ‖φ‖² of their columns, shape (c, p)."""
    size = np.diagonal(gram, axis1=1, axis2=2)
    new = np.asarray(np.all(size > REDUNDANT_SHARE * squares, axis=1))
    root = np.sqrt(size[new])
    new[new] = np.linalg.cond(gram[new] / (root[:, :, None] * root[:, None, :])) <= 1e10
    return new


def _projected_gram(gram: FloatArray, jacobian: FloatArray, along: FloatArray, pushed: FloatArray) -> FloatArray:
    """(Φ − J w)ᵀ(Φ − J w) of each part, shape (…, p, p), from ΦᵀΦ, ΦᵀJ, wᵀ and wᵀJᵀJ, the last three (…, p, f)."""
    crossed = jacobian @ np.swapaxes(along, -1, -2)
    return np.asarray(gram - crossed - np.swapaxes(crossed, -1, -2) + pushed @ np.swapaxes(along, -1, -2))


@dataclass(frozen=True, slots=True)
class _Products:
    """Products of q candidate columns Φ (many candidates side by side) with the problem."""

    cluster_jacobian: FloatArray  #: ΦᵀJ of each cluster, shape (clusters, q, f)
    cluster_gram: FloatArray  #: ΦᵀΦ of each cluster, shape (clusters, q, q)
    cluster_score: FloatArray  #: Φᵀe of each cluster, shape (clusters, q)
    part_jacobian: FloatArray  #: ΦᵀJ of each fold and motor, shape (folds, n, q, f)
    part_gram: FloatArray  #: ΦᵀΦ of each fold and motor, shape (folds, n, q, q)
    part_score: FloatArray  #: Φᵀe of each fold and motor, shape (folds, n, q)
    part_held: FloatArray  #: Φᵀr of each fold and motor, shape (folds, n, q)


def _products(folds: Folds, columns: FloatArray) -> _Products:
    problem, n = folds.problem, len(folds.problem.gamma)
    f, q = problem.jacobian.shape[1], columns.shape[1]
    clusters, count = problem.cluster_count, folds.count
    shapes = [(*parts, *shape) for parts in ((clusters,), (count, n)) for shape in ((q, f), (q, q), (q,))]
    made = _Products(*map(np.zeros, (*shapes, shapes[-1])))
    for own in folds.motors:
        # Most candidates act on one motor: only columns that this one feels, and unknowns that it holds, take part.
        inside, motor = columns[own.rows].T, problem.motor[own.rows.start]
        felt = np.flatnonzero(inside.any(axis=1))
        inside = inside[felt]
        products = own.sums(inside, np.concatenate((own.jacobian, inside)))
        scores = own.sums(inside, np.stack((problem.residual[own.rows], folds.residual[own.rows])))
        jacobian, gram = np.split(products, [len(own.seen)], axis=2)
        made.cluster_jacobian[np.ix_(own.cluster, felt, own.seen)] += jacobian
        made.cluster_gram[np.ix_(own.cluster, felt, felt)] += gram
        made.cluster_score[np.ix_(own.cluster, felt)] += scores[:, :, 0]
        (present, products), (_, scores) = own.by_fold(products), own.by_fold(scores)
        jacobian, gram = np.split(products, [len(own.seen)], axis=2)
        made.part_jacobian[:, motor][np.ix_(present, felt, own.seen)] = jacobian
        made.part_gram[:, motor][np.ix_(present, felt, felt)] = gram
        made.part_score[:, motor][np.ix_(present, felt)] = scores[:, :, 0]
        made.part_held[:, motor][np.ix_(present, felt)] = scores[:, :, 1]
    return made
