"""Which block comes next in a guided session: without load, or with the payload.

With one friction for all blocks, the first three are bare, loaded, and loaded once more, held out.
Pairs follow in an order that cancels drift: loaded, bare, bare, loaded. The means of the bare and
of the loaded blocks then lie at one time, and friction that falls evenly as the arm gets warm is
the same for both.

With `friction_by_payload`, a change of friction between bare and loaded blocks is no gain, in
whatever order they come. So the order is the one that takes a person the least time, and a change
of the payload takes minutes. All bare blocks that the target needs by the plan come first; then the
payload stays on. Gains are seen by the difference of bare and loaded blocks: of n and k of them, σ²
of a gain falls as 1/n + 1/k. Where the time of the session is too short for the target, the order
is the one that leaves σ smallest at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum


class BlockRole(Enum):
    """What a block is for."""

    BARE = "bare"
    LOADED = "loaded"
    HELD_OUT = "held-out"


FIRST_BLOCKS = (BlockRole.BARE, BlockRole.LOADED, BlockRole.HELD_OUT)
NEXT_BLOCKS = (BlockRole.LOADED, BlockRole.BARE, BlockRole.BARE, BlockRole.LOADED)
MOST_BARE_FIRST = 6
"""Bare blocks before the first loaded one at most: what a plan predicts is only a prediction."""
CHANGE_S = 180.0  #: Time of a person to change the payload [s]
ROUNDING = 1e-9  #: Relative
FAR = 4000  #: Blocks that no session has


@dataclass(frozen=True, slots=True)
class BlocksSoFar:
    """Blocks of the fit that are there, and what is on the flange now."""

    bare: int
    loaded: int
    is_mounted: bool  #: whether the last block carried the payload


def first_blocks(bare: int) -> tuple[BlockRole, ...]:
    """Return the blocks with which every session begins:
    so many bare ones, then a loaded one, and one held out.
    """
    return (*(BlockRole.BARE,) * bare, *FIRST_BLOCKS[1:])


def bare_blocks_first(variance_ratio: float, blocks_in_time: int) -> int:
    """Return how many bare blocks to record before the payload is mounted, at least one.

    Of n bare and as many loaded blocks, σ² is that of one of each over n. One bare block too many
    costs its time; with one too few the payload comes off again, which takes longer. Of a session
    too short for the target, half of the blocks of the fit are bare.

    Args:
        variance_ratio: predicted σ² of the worst gain over that of its target, with one bare and
            one loaded block.
        blocks_in_time: number of blocks until the time limit, the held-out one included.
    """
    most = min(MOST_BARE_FIRST, max(1, (blocks_in_time - 1) // 2))
    if not math.isfinite(variance_ratio):
        return most
    return min(max(1, math.ceil(variance_ratio - ROUNDING)), most)


def fixed_role(number: int) -> BlockRole:
    """Return the role of a block by its number from 0, in the order that cancels drift."""
    if number < len(FIRST_BLOCKS):
        return FIRST_BLOCKS[number]
    return NEXT_BLOCKS[(number - len(FIRST_BLOCKS)) % len(NEXT_BLOCKS)]


@dataclass(frozen=True, slots=True)
class BlocksToCome:
    """Further blocks of the fit."""

    bare: int
    loaded: int

    @property
    def count(self) -> int:
        """Number of them."""
        return self.bare + self.loaded


def quickest_way(
    so_far: BlocksSoFar, variance_ratio: float, block_s: float, most: int = FAR
) -> BlocksToCome:
    """Return the further blocks with which every gain is precise in the least time of a person.

    Where they are more than there is time for, it is the blocks of that time that leave σ smallest.

    Args:
        so_far: at least one block of each kind.
        variance_ratio: σ² of the worst gain over that of its target, above one.
        block_s: duration of a block [s].
        most: number of blocks until the recording ends, at least one.
    """
    present = 1.0 / so_far.bare + 1.0 / so_far.loaded
    wanted = present / variance_ratio * (1.0 + ROUNDING)
    quickest: BlocksToCome | None = None
    for bare in range(most + 1):
        if quickest is not None and block_s * bare >= _time_s(so_far, quickest, block_s):
            break  # The bare blocks alone take as long
        way = _with_bare(so_far, bare, wanted)
        if way is None or not 1 <= way.count <= most:
            continue
        time_s = _time_s(so_far, way, block_s)
        if quickest is None or time_s < _time_s(so_far, quickest, block_s):
            quickest = way
    if quickest is not None:
        return quickest

    def relative_variance(way: BlocksToCome) -> float:
        bare = so_far.bare + way.bare
        loaded = so_far.loaded + way.loaded
        return 1.0 / bare + 1.0 / loaded

    all_the_time = [BlocksToCome(bare, most - bare) for bare in range(most + 1)]
    return min(all_the_time, key=relative_variance)


def next_role(so_far: BlocksSoFar, way: BlocksToCome) -> BlockRole:
    """Return the role of the next block: the payload stays as it is while that is of use."""
    if so_far.is_mounted:
        if way.loaded:
            return BlockRole.LOADED
        return BlockRole.BARE
    if way.bare:
        return BlockRole.BARE
    return BlockRole.LOADED


def _with_bare(so_far: BlocksSoFar, bare: int, wanted: float) -> BlocksToCome | None:
    """The fewest loaded blocks that are enough for so many bare ones;
    None where no number is.
    """
    left = wanted - 1.0 / (so_far.bare + bare)
    if left <= 0.0:
        return None
    loaded = math.ceil(1.0 / left - ROUNDING)
    return BlocksToCome(bare, max(0, loaded - so_far.loaded))


def _time_s(so_far: BlocksSoFar, way: BlocksToCome, block_s: float) -> float:
    """Time of a person for further blocks [s]."""
    others = way.loaded
    if so_far.is_mounted:
        others = way.bare
    return block_s * way.count + (CHANGE_S if others else 0.0)
