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

from ident.arrays import FloatArray, IntArray
from ident.data.dataset import Dataset
from ident.discovery.noise_floor import noise_floors
from ident.effects.effect import Effect, at_joints, effect_torque, is_placeable
from ident.effects.signals import Abscissa, Signals, fitted_signals, session_began_s
from ident.equations.linearisation import Folds, cut_into_folds, linearise
from ident.equations.rows import Observation, decimate_rows
from ident.estimators.estimate import Estimate
from ident.model.model import Model

ColumnCache = dict[tuple[Effect, int], FloatArray]

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
    #: Columns of motion and time alone, which stay the same from turn to turn.
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
        if not placed:
            return ()
        trials = self.trials([torque(effect, axis) for _, effect in placed])
        members: dict[int, list[tuple[Effect, Trial]]] = {}
        for (number, effect), trial in zip(placed, trials, strict=True):
            if trial is not None:
                members.setdefault(number, []).append((effect, trial))
        return tuple(FamilyTrials(axis, tuple(found)) for found in members.values())

    def trials(self, torques: Sequence[FloatArray]) -> tuple[Trial | None, ...]:
        """Test candidates given by their joint torques (n, p, r); None where the model contains them already."""
        ends = np.cumsum([torque.shape[1] for torque in torques])
        candidates = [slice(int(end) - torque.shape[1], int(end)) for end, torque in zip(ends, torques, strict=True)]
        whole = np.concatenate(torques, axis=1)
        columns = self.folds.problem.whitened(whole, self.model.drive_train.to_motor)
        return score_candidates(self.folds, columns, candidates)

    def torque(self, effect: Effect, axis: int) -> FloatArray:
        """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (n, p, r)."""
        if (effect, axis) in self.cache:
            return self.cache[effect, axis]
        made = effect_torque(effect, axis, self.runs, self.datasets, self.observation.conditioning, self.model)
        if effect.abscissa.is_kinematic:
            self.cache[effect, axis] = made
        return made

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
        arrays = {name: decimate_rows(data, observation.conditioning, array) for name, array in at_rate.items()}
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


def score_candidates(folds: Folds, columns: FloatArray, candidates: Sequence[slice]) -> tuple[Trial | None, ...]:
    """Project columns off all declared directions, gains included, and measure what they explain.

    Everything is computed from products that are summed block by block, so that no candidate needs a pass over the rows
    of its own.

    Args:
        folds: the problem in folds.
        columns: whitened candidate columns, shape (rows, q).
        candidates: which columns belong together.

    Returns:
        one trial a candidate; None where the declared model contains it already.
    """
    made = _products(folds, columns)
    motor_jacobian, fold_jacobian = made.part_jacobian.sum(axis=0), made.part_jacobian.sum(axis=1)
    motor_gram, gram_sum = made.part_gram.sum(axis=0), made.cluster_gram.sum(axis=0)
    whole_jacobian = motor_jacobian.sum(axis=0)
    # Φ⊥ = Φ − J H⁻¹ JᵀΦ, of each move and of each motor.
    along = linalg.cho_solve(folds.full_factor, whole_jacobian)
    all_pushed, motor_pushed = folds.cluster_hessian @ along, folds.part_hessian.sum(axis=0) @ along
    cluster_score = made.cluster_score - folds.cluster_score @ along
    motor_score = made.part_score.sum(axis=0) - folds.motor_score @ along
    # The same with J and Φ of the other folds, for each fold k: Φ − J w_k.
    coupling = whole_jacobian - fold_jacobian
    steps = np.stack([linalg.cho_solve(*pair) for pair in zip(folds.factors, coupling, strict=True)])
    pushed = folds.part_hessian @ steps[:, None]
    drive = made.part_score.sum(axis=(0, 1)) - made.part_score.sum(axis=1) - (folds.scores[:, None] @ steps)[:, 0]
    shown = made.part_held - folds.part_score @ steps
    before, squares = folds.square_sum(folds.residual), np.diag(gram_sum)
    trials: list[Trial | None] = []
    for chosen in candidates:
        w, step = along[:, chosen], steps[:, :, chosen]
        cluster_gram = _projected_gram(
            made.cluster_gram[:, chosen, chosen], made.cluster_jacobian[:, :, chosen], w[None], all_pushed[:, :, chosen]
        )
        gram = cluster_gram.sum(axis=0)
        root = np.sqrt(np.maximum(np.diag(gram), 0.0))
        left = np.all(np.diag(gram) > REDUNDANT_SHARE * squares[chosen])
        if not left or np.linalg.cond(gram / np.outer(root, root)) > 1e10:
            trials.append(None)
            continue
        score = cluster_score[:, chosen].sum(axis=0)
        coefficients = np.linalg.solve(gram, score)
        own = motor_gram[:, chosen, chosen], motor_jacobian[:, :, chosen], w[None], motor_pushed[:, :, chosen]
        explained = np.einsum("p,npq,q->n", coefficients, _projected_gram(*own), coefficients)
        # Without fold k; what the other folds do not show at all is left as it is: in its own unit, the shortest of
        # all solutions.
        unit = np.sqrt(squares[chosen])
        part_gram = made.part_gram[:, :, chosen, chosen]
        rest = motor_gram[:, chosen, chosen].sum(axis=0) - part_gram.sum(axis=1)
        schur = rest - np.swapaxes(coupling[:, :, chosen], 1, 2) @ step
        inverse = np.linalg.pinv(schur / np.outer(unit, unit), rcond=UNSEEN)
        fitted = (inverse @ (drive[:, chosen] / unit)[:, :, None])[:, :, 0] / unit
        # r − (Φ − J w_k) fitted, squared motor by motor.
        inside = _projected_gram(part_gram, made.part_jacobian[:, :, :, chosen], step[:, None], pushed[:, :, :, chosen])
        rose = np.einsum("kp,knpq,kq->kn", fitted, inside, fitted)
        trials.append(
            Trial(
                coefficients=coefficients,
                fallen=2.0 * motor_score[:, chosen] @ coefficients - explained,
                training_fall=np.sum(drive[:, chosen] * fitted, axis=1),
                held_out=before - 2.0 * np.einsum("knp,kp->kn", shown[:, :, chosen], fitted) + rose,
                score=score,
                scatter=cluster_score[:, chosen] - cluster_gram @ coefficients,
                gram=cluster_gram,
            )
        )
    return tuple(trials)


def _projected_gram(gram: FloatArray, jacobian: FloatArray, along: FloatArray, pushed: FloatArray) -> FloatArray:
    """(Φ − J w)ᵀ(Φ − J w) of each part, shape (…, p, p), with ``pushed`` = JᵀJ w."""
    crossed = np.swapaxes(jacobian, -1, -2) @ along
    return np.asarray(gram - crossed - np.swapaxes(crossed, -1, -2) + np.swapaxes(along, -1, -2) @ pushed)


@dataclass(frozen=True, slots=True)
class _Products:
    """Products of candidate columns Φ (many candidates side by side) with the problem, shape (…, q) for q columns."""

    cluster_jacobian: FloatArray  #: JᵀΦ of each cluster
    cluster_gram: FloatArray  #: ΦᵀΦ of each cluster
    cluster_score: FloatArray  #: Φᵀe of each cluster
    part_jacobian: FloatArray  #: JᵀΦ of each fold and motor
    part_gram: FloatArray  #: ΦᵀΦ of each fold and motor
    part_score: FloatArray  #: Φᵀe of each fold and motor
    part_held: FloatArray  #: Φᵀr of each fold and motor


def _products(folds: Folds, columns: FloatArray) -> _Products:
    problem, n = folds.problem, len(folds.problem.gamma)
    f, q = problem.jacobian.shape[1], columns.shape[1]
    clusters, count = problem.cluster_count, folds.count
    shapes = [(*parts, *shape) for parts in ((clusters,), (count, n)) for shape in ((f, q), (q, q), (q,))]
    made = _Products(*map(np.zeros, (*shapes, shapes[-1])))
    felt = [bool(np.any(columns[problem.motor == motor])) for motor in range(n)]
    for rows, k, m, i in folds.blocks:
        if not felt[i]:
            continue
        inside = columns[rows]
        jacobian, gram, score = problem.jacobian[rows].T @ inside, inside.T @ inside, problem.residual[rows] @ inside
        made.cluster_jacobian[m] += jacobian
        made.cluster_gram[m] += gram
        made.cluster_score[m] += score
        made.part_jacobian[k, i] += jacobian
        made.part_gram[k, i] += gram
        made.part_score[k, i] += score
        made.part_held[k, i] += folds.residual[rows] @ inside
    return made
