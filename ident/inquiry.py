"""A residual put to candidates: the problem in folds, the signals that effects are made of, and trials of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ident.dataset import Dataset
from ident.effects.abscissa import Abscissa
from ident.effects.effect import Effect
from ident.effects.torque import at_joints, effect_torque, is_placeable
from ident.estimate import Estimate
from ident.linearisation import linearise
from ident.model import Model
from ident.noise_floor import noise_floors
from ident.observation import Observation
from ident.residual import Folds, cut
from ident.rows import decimate_rows
from ident.signals import Signals, session_began_s, signals
from ident.trial import Trial, put_to_test

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ColumnCache = dict[tuple[Effect, int], FloatArray]
MOVES_WANTED = 60
SHORTEST_PIECE_S = 0.25
FAST = frozenset({Abscissa.MOTOR_ANGLE})
"""Variables that turn within a decimated row."""


@dataclass(frozen=True, slots=True)
class Tested:
    """A family on one axis, tested with each of its settings that says something.

    Attributes:
        axis: index.
        members: settings and their trials, at least one.
    """

    axis: int
    members: tuple[tuple[Effect, Trial], ...]

    def nested(self) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, n), the setting chosen by the other folds alone."""
        chosen = np.argmax(np.stack([trial.training_fall for _, trial in self.members]), axis=0)
        return np.stack([self.members[best][1].held_out[fold] for fold, best in enumerate(chosen)])


@dataclass(frozen=True, slots=True)
class Inquiry:
    """What candidates are tested on.

    Attributes:
        model: the declared model.
        datasets: the runs of the fit.
        observation: their rows, with the columns of effects accepted so far.
        runs: what the model predicts of each run, at full rate.
        rows: the same at the observation's rows.
        folds: the problem around the estimate.
        floors_a: noise of each motor's current in a row that no model of motion explains; None where not known.
        cache: columns of motion and time alone, which stay the same from turn to turn.
    """

    model: Model
    datasets: Sequence[Dataset]
    observation: Observation
    runs: tuple[Signals, ...]
    rows: tuple[Signals, ...]
    folds: Folds
    floors_a: tuple[float | None, ...]
    cache: ColumnCache = field(default_factory=dict)

    @property
    def axes(self) -> int:
        """Number of axes."""
        return self.observation.joint_count

    def torque(self, effect: Effect, axis: int) -> FloatArray:
        """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (n, p, r)."""
        if (effect, axis) in self.cache:
            return self.cache[effect, axis]
        made = effect_torque(effect, axis, self.runs, self.datasets, self.observation.conditioning, self.model)
        if effect.abscissa.is_kinematic:
            self.cache[effect, axis] = made
        return made

    def slow_torque(self, effect: Effect, axis: int) -> FloatArray:
        """The same of an effect that changes slowly: made at the rows, which is as good and much faster."""
        if effect.abscissa in FAST:
            return self.torque(effect, axis)
        columns = np.concatenate([effect.columns(run, axis) for run in self.rows], axis=-1)
        return at_joints(effect, axis, columns, self.model.drive_train)

    def trials(self, torques: Sequence[FloatArray]) -> tuple[Trial | None, ...]:
        """Candidates given by their joint torques (n, p, r); None where the model says the same already."""
        ends = np.cumsum([torque.shape[1] for torque in torques])
        candidates = [slice(int(end) - torque.shape[1], int(end)) for end, torque in zip(ends, torques, strict=True)]
        whole = np.concatenate(torques, axis=1)
        columns = self.folds.problem.whitened(whole, self.model.drive_train.to_motor)
        return put_to_test(self.folds, columns, candidates)

    def test(self, families: Iterable[Sequence[Effect]], axis: int, *, at_rows: bool = False) -> tuple[Tested, ...]:
        """Families on an axis; those of which the model lacks nothing are left out."""
        torque = self.slow_torque if at_rows else self.torque
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
        return tuple(Tested(axis, tuple(found)) for found in members.values())


def inquire(
    model: Model,
    datasets: Sequence[Dataset],
    observation: Observation,
    estimate: Estimate,
    cache: ColumnCache | None = None,
) -> Inquiry:
    """Linearise around an estimate, cut into folds, and predict what effects are made of.

    Args:
        model: the declared model.
        datasets: the runs of the fit, in the observation's order.
        observation: their rows, with the columns of effects accepted so far.
        estimate: by ``ml`` on that observation.
        cache: kept by the caller from turn to turn; of these datasets alone.

    Raises:
        TooFewMoves: to leave some out.
    """
    pieces, whole = _pieces(observation)
    began_s = session_began_s(datasets)
    runs = tuple(signals(model, data, observation, estimate, began_s) for data in datasets)
    problem = linearise(
        replace(observation, move=pieces),
        estimate.gains,
        estimate.parameters,
        estimate.axis_noise,
        gains_fixed=estimate.gains_fixed,
    )
    rows = tuple(_at_rows(run, data, observation) for run, data in zip(runs, datasets, strict=True))
    floors = noise_floors(datasets, observation.conditioning)
    return Inquiry(
        model=model,
        datasets=datasets,
        observation=observation,
        runs=runs,
        rows=rows,
        folds=cut(problem, whole=whole),
        floors_a=tuple(None if floor is None else floor.noise_a for floor in floors),
        cache={} if cache is None else cache,
    )


def _pieces(observation: Observation) -> tuple[IntArray, IntArray]:
    """The piece of a move that each row belongs to, shape (r,), and the move that each piece with rows is of.

    Whoever weighs a candidate by the scatter of moves needs many: those of a short recording are cut into pieces of
    many correlation times (0.05 s) each. Folds still take whole moves.
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


def _at_rows(run: Signals, data: Dataset, observation: Observation) -> Signals:
    def rows(column: FloatArray) -> FloatArray:
        return decimate_rows(data, observation.conditioning, column)

    time_s = rows(run.time_s[None])[0]
    return replace(
        run,
        rate_hz=float((len(time_s) - 1) / (time_s[-1] - time_s[0])),
        time_s=time_s,
        session_s=rows(run.session_s[None])[0],
        position_rad=rows(run.position_rad),
        velocity_rad_s=rows(run.velocity_rad_s),
        acceleration_rad_s2=rows(run.acceleration_rad_s2),
        motor_position_rad=rows(run.motor_position_rad),
        inertia_kg_m2=rows(run.inertia_kg_m2),
        load_torque_nm=rows(run.load_torque_nm),
        geared_torque_nm=rows(run.geared_torque_nm),
        motor_torque_nm=rows(run.motor_torque_nm),
        current_a=rows(run.current_a),
    )
