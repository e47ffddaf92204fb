"""A clear way between two positions of the axes, where the straight one is not clear.

Two trees of positions grow, one from each end; each of their branches is a straight way that is
clear. A tree grows towards a random position, then the other one towards what it has reached, until
they meet (RRT-Connect; Kuffner & LaValle, ICRA 2000).
"""

from __future__ import annotations

import numpy as np

from ident.arrays import FloatArray
from ident.planning.clearance import Checker

MOST_BRANCHES = 200  #: Of both trees
#: Of the way to a position, the first that is clear is gone
SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
SAME = 1e-9  #: Distance of two positions that are the same, as a share of the room


class _Tree:
    """Positions that are reached from one end by straight ways that are clear."""

    def __init__(self, root: FloatArray) -> None:
        self._positions = [root]
        self._parents = [-1]

    def grow(
        self, checker: Checker, target: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[int, FloatArray] | None:
        """Go towards a position from the nearest one: number and position of what is reached;
        None where it is shut.
        """
        room = np.where(upper > lower, upper - lower, 1.0)
        differences = np.array(self._positions) - target
        distances = np.linalg.norm(differences / room, axis=1)
        nearest = int(np.argmin(distances))
        start = self._positions[nearest]
        if distances[nearest] < SAME:
            return nearest, start
        reached = farthest_towards(checker, start, target, lower, upper)
        if reached is None:
            return None
        self._positions.append(reached)
        self._parents.append(nearest)
        return len(self._positions) - 1, reached

    def way_to(self, number: int) -> list[FloatArray]:
        """Positions from the root to one of them."""
        way: list[FloatArray] = []
        while number >= 0:
            way.append(self._positions[number])
            number = self._parents[number]
        return way[::-1]


def clear_way(
    checker: Checker,
    start: FloatArray,
    end: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
) -> tuple[FloatArray, ...] | None:
    """Return the positions between start and end at which a clear way turns;
    None where no way was found.

    Args:
        checker: of the robot and its room.
        start, end: positions of the axes [rad or m], shape (m,).
        lower, upper: between which the way stays, shape (m,); they contain both ends.
        rng: of the positions that are tried.

    Returns:
        positions of shape (m,); none of them where the straight way is clear.
    """
    if checker.obstruction(start, end) is None:
        return ()
    from_start = _Tree(start)
    from_end = _Tree(end)
    for branch in range(MOST_BRANCHES):
        from_start_grows = branch % 2 == 0
        if from_start_grows:
            growing = from_start
            other = from_end
        else:
            growing = from_end
            other = from_start
        target = rng.uniform(lower, upper)
        grown = growing.grow(checker, target, lower, upper)
        if grown is None:
            continue
        number, reached = grown
        met = other.grow(checker, reached, lower, upper)
        if met is None:
            continue
        other_number, meeting = met
        if checker.obstruction(reached, meeting) is not None:
            continue
        way = [*growing.way_to(number), *reversed(other.way_to(other_number))]
        if not from_start_grows:
            way.reverse()
        return _shortened(checker, way)
    return None


def farthest_towards(
    checker: Checker, start: FloatArray, target: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray | None:
    """Return the farthest of some positions on the way to a target that the robot can go to;
    None where it is shut.

    Args:
        checker: of the robot and its room.
        start, target: positions of the axes [rad or m], shape (m,).
        lower, upper: limits of the axes, shape (m,).
    """
    ends = start + np.array(SHARES)[:, None] * (target - start)
    return checker.farthest(start, ends, lower, upper)


def _shortened(checker: Checker, way: list[FloatArray]) -> tuple[FloatArray, ...]:
    """Positions between the ends of a way, without those that a straight way can leave out."""
    turns: list[FloatArray] = []
    here = 0
    last = len(way) - 1
    while True:
        ahead = last
        while ahead > here + 1 and checker.obstruction(way[here], way[ahead]) is not None:
            ahead -= 1
        if ahead == last:
            return tuple(turns)
        turns.append(way[ahead])
        here = ahead
