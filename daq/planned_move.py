"""One move of a plan, and the way it takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell
from drivers.trapezoid import Trapezoid, synchronised

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One synchronised point-to-point move.

    Attributes:
        target_rad: joint positions at its end [rad; m of a prismatic joint], shape (n,).
        velocity, acceleration: share of the joints' limits, above 0 up to 1.
        dwell_s: rest after it [s].
    """

    target_rad: tuple[float, ...]
    velocity: float
    acceleration: float
    dwell_s: float


def path_of(cell: Cell, start_rad: FloatArray, move: PlannedMove) -> Trapezoid:
    """The joint trapezoid of a move from where the robot stands."""
    velocity = np.array([axis.limits.velocity for axis in cell.axes]) * move.velocity
    acceleration = np.array([axis.limits.acceleration for axis in cell.axes]) * move.acceleration
    return synchronised(start_rad, np.array(move.target_rad), velocity, acceleration)


def paths_of(cell: Cell, moves: Sequence[PlannedMove]) -> tuple[Trapezoid, ...]:
    """Of all moves but the first: where the robot stands before that is not known."""
    starts = (np.array(move.target_rad) for move in moves)
    return tuple(path_of(cell, start, move) for start, move in zip(starts, moves[1:], strict=False))


def duration_of(cell: Cell, moves: Sequence[PlannedMove]) -> float:
    """From the first target to the end of the last dwell [s]."""
    return float(sum(path.duration_s for path in paths_of(cell, moves)) + sum(move.dwell_s for move in moves))
