"""Which coordinates a plant has, along which of them motors act, and in which directions dry friction acts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.effects import Effect
from drivers.simulated.effects.coupling import Coupling
from drivers.simulated.effects.flexible_drive import Backlash, Elasticity
from drivers.simulated.errors import SpecInvalid

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """n motors, N coordinates, m directions of dry friction.

    Attributes:
        motor_direction: how each motor turns with the coordinates, shape (n, N).
        directions: of dry friction, shape (m, N); the first n are the joints.
        own_row: the direction that carries each motor's own dry friction and brake, shape (n,).
        lone: coordinate of each direction that has only one, else -1, shape (m,).
        flexible: drives that part a motor from its joints, in the order of their coordinates.
    """

    motor_direction: FloatArray
    directions: FloatArray
    own_row: NDArray[np.int64]
    lone: NDArray[np.int64]
    flexible: tuple[Elasticity | Backlash, ...]


def lay_out(rows: FloatArray, effects: Sequence[Effect]) -> Layout:
    """Count coordinates and directions, and tell the effects that add some where theirs are.

    Args:
        rows: r_i of the drive train, shape (n, n).
        effects: of the plant.

    Raises:
        SpecInvalid: two flexible drives are given for one motor.
    """
    n = len(rows)
    flexible = tuple(effect for effect in effects if isinstance(effect, Elasticity | Backlash))
    if len({drive.axis for drive in flexible}) < len(flexible):
        raise SpecInvalid("two flexible drives on one motor; give elasticity and gap in one backlash effect")
    total = n + len(flexible)
    motor_direction = np.hstack([rows, np.zeros((n, len(flexible)))])
    for coordinate, drive in enumerate(flexible, start=n):
        drive.coordinate, drive.row = coordinate, rows[drive.axis]
        motor_direction[drive.axis] = np.eye(total)[coordinate]
    directions = list(np.eye(n, total))
    own_row = np.zeros(n, dtype=np.int64)
    for motor, row in enumerate(motor_direction):
        moved = np.flatnonzero(row)
        if len(moved) == 1 and moved[0] < n:
            # A motor that turns with one joint alone shares that joint's direction; r_i is 1 there by its making.
            own_row[motor] = moved[0]
        else:
            own_row[motor] = len(directions)
            directions.append(row)
    for effect in effects:
        if isinstance(effect, Coupling):
            effect.direction = len(directions)
            shared = np.zeros(total)
            shared[[effect.axis, effect.other]] = 1.0
            directions.append(shared)
    lone = [np.flatnonzero(row)[0] if np.count_nonzero(row) == 1 else -1 for row in directions]
    return Layout(motor_direction, np.array(directions), own_row, np.array(lone, dtype=np.int64), flexible)
