"""Point-to-point moves that excite every parameter: random moves, then exchange (paper §2.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell
from daq.configuration.cell_model import model_of
from daq.errors import PlanUnfit
from drivers.trapezoid import Trapezoid, synchronised
from ident.excitation import condition, independent_columns, weighted_columns
from ident.motion import Motion

FloatArray = NDArray[np.float64]

LARGEST_CONDITION = 3500.0
"""Of the weighted observation matrix; the paper's trajectories have 1930 to 2817 (Table 5)."""
SAMPLE_S = 0.02
POSITION_MARGIN = 0.03
"""Share of a joint's range that targets keep from its limits."""


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One synchronised point-to-point move.

    Attributes:
        target_rad: joint positions at its end [rad], shape (n,).
        velocity, acceleration: share of the joints' limits, above 0 up to 1.
        dwell_s: rest after it [s].
    """

    target_rad: tuple[float, ...]
    velocity: float
    acceleration: float
    dwell_s: float


@dataclass(frozen=True, slots=True)
class Plan:
    """A run's moves.

    Attributes:
        cell: name of the cell it was made for.
        seed: it was made from.
        condition: of the weighted observation matrix that these moves give.
        duration_s: from the first target to the end of the last dwell [s]; how long the way to the first target takes
            depends on where the robot stands.
        moves: in order.
    """

    cell: str
    seed: int
    condition: float
    duration_s: float
    moves: tuple[PlannedMove, ...]


def path_of(cell: Cell, start_rad: FloatArray, move: PlannedMove) -> Trapezoid:
    """The joint trapezoid of a move from where the robot stands."""
    velocity = np.array([axis.limits.velocity for axis in cell.axes]) * move.velocity
    acceleration = np.array([axis.limits.acceleration for axis in cell.axes]) * move.acceleration
    return synchronised(start_rad, np.array(move.target_rad), velocity, acceleration)


def duration_of(cell: Cell, moves: Sequence[PlannedMove]) -> float:
    """From the first target to the end of the last dwell [s]."""
    targets = [np.array(move.target_rad) for move in moves]
    ways = (path_of(cell, here, move).duration_s for here, move in zip(targets, moves[1:], strict=False))
    return float(sum(ways) + sum(move.dwell_s for move in moves))


def plan(
    cell: Cell,
    *,
    seed: int,
    duration_s: float = 40.0,
    exchanges: int = 400,
    speed: float = 1.0,
    largest_condition: float = LARGEST_CONDITION,
    progress: Callable[[int, float], None] = lambda _done, _condition: None,
) -> Plan:
    """Choose moves inside the joint limits until the observation matrix is well conditioned.

    Random targets fill the duration; then targets are exchanged one at a time, and an exchange stays when it lowers the
    condition number without making the run longer.

    Args:
        cell: with robot and limits.
        seed: the same seed gives the same plan.
        duration_s: of the run [s].
        exchanges: tries; every one of them is made.
        speed: share of the limits that the fastest moves may use.
        largest_condition: a plan worse than this is refused.
        progress: told the number of tries and the condition so far.

    Raises:
        PlanUnfit: no plan of this length reaches the condition.
    """
    rng = np.random.default_rng(seed)
    draft = _Draft(cell, rng, duration_s, speed)
    pieces = [draft.columns(index) for index in range(len(draft.moves))]
    independent = list(independent_columns(draft.model, pieces))
    informations = [piece[:, independent].T @ piece[:, independent] for piece in pieces]
    best = condition(np.sum(informations, axis=0))
    for done in range(1, exchanges + 1):
        index = int(rng.integers(len(draft.moves)))
        before = draft.moves[index]
        draft.moves[index] = draft.random_move()
        if draft.duration() <= duration_s:
            trial = list(informations)
            # A target is the end of one move and the start of the next.
            for touched in range(index, min(index + 2, len(draft.moves))):
                piece = draft.columns(touched)[:, independent]
                trial[touched] = piece.T @ piece
            value = condition(np.sum(trial, axis=0))
            if value < best:
                best, informations, before = value, trial, draft.moves[index]
        draft.moves[index] = before
        progress(done, best)
    if best > largest_condition:
        raise PlanUnfit(
            f"plan of {duration_s:g} s for cell {cell.name!r}",
            found=f"condition {best:.0f} of the weighted observation matrix after {exchanges} exchanges",
            expected=f"at most {largest_condition:.0f}",
            remedy="allow a longer run, more exchanges, wider joint limits or higher speed",
        )
    return Plan(cell.name, seed, best, draft.duration(), tuple(draft.moves))


class _Draft:
    """Moves that are still being exchanged."""

    def __init__(self, cell: Cell, rng: np.random.Generator, duration_s: float, speed: float) -> None:
        self.cell = cell
        self.model = model_of(cell)
        self._rng = rng
        self._speed = speed
        limits = np.array([axis.limits.position for axis in cell.axes])
        margin = POSITION_MARGIN * (limits[:, 1] - limits[:, 0])
        self._low, self._high = limits[:, 0] + margin, limits[:, 1] - margin
        # Equal noise in every current reference; only its ratio between the joints matters.
        self._noise_nm = np.abs([axis.nameplate_gain for axis in cell.axes])
        self._home = 0.5 * (self._low + self._high)
        self.moves: list[PlannedMove] = []
        while True:
            self.moves.append(self.random_move())
            if self.duration() > duration_s:
                self.moves.pop()
                break
        if len(self.moves) < 5:
            raise PlanUnfit(
                f"plan of {duration_s:g} s for cell {cell.name!r}",
                found=f"room for {len(self.moves)} moves",
                expected="at least 5, better 30",
                remedy="allow a longer run",
            )

    def random_move(self) -> PlannedMove:
        # Slow and fast moves both: friction is told from inertia by moves of different speed and acceleration.
        return PlannedMove(
            target_rad=tuple(float(value) for value in self._rng.uniform(self._low, self._high)),
            velocity=float(round(self._speed * self._rng.uniform(0.35, 1.0), 3)),
            acceleration=float(round(self._speed * self._rng.uniform(0.4, 1.0), 3)),
            dwell_s=0.1,
        )

    def _start(self, index: int) -> FloatArray:
        return np.array(self.moves[index - 1].target_rad) if index else self._home

    def columns(self, index: int) -> FloatArray:
        path = path_of(self.cell, self._start(index), self.moves[index])
        times = np.arange(0.5 * SAMPLE_S, path.duration_s, SAMPLE_S)
        position, velocity, acceleration = (part.T for part in path.at(times))
        return weighted_columns(self.model, Motion(position, velocity, acceleration), self._noise_nm)

    def duration(self) -> float:
        return duration_of(self.cell, self.moves)


def slowed(cell: Cell, plan_: Plan, override: float) -> Plan:
    """The same ways at a share of their speed, as for a first run; the condition is that of the plan as it was made."""
    moves = tuple(
        replace(move, velocity=move.velocity * override, acceleration=move.acceleration * override**2)
        for move in plan_.moves
    )
    return replace(plan_, duration_s=duration_of(cell, moves), moves=moves)
