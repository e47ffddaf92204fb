"""Which block comes next in a guided session: without load, or with the payload.

The first three are bare, loaded, and loaded once more, held out. What follows depends on the model of friction.

With one friction for all blocks, pairs follow in an order that cancels drift: loaded, bare, bare, loaded. The means of
the bare and of the loaded blocks then lie at the same time, and friction that falls evenly as the arm gets warm is the
same for both.

With `friction_by_load`, a change of friction between bare and loaded blocks is no gain, in whatever order they come. So
the order is the one that takes a person the least time, and a change of the payload takes minutes. Of n bare and k
loaded blocks, σ² of a gain falls as 1/n + 1/k: gains are seen by the difference of the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class BlockRole(Enum):
    """What a block is for."""

    BARE = "bare"
    LOADED = "loaded"
    HELD_OUT = "held-out"


FIRST_BLOCKS = (BlockRole.BARE, BlockRole.LOADED, BlockRole.HELD_OUT)
NEXT_BLOCKS = (BlockRole.LOADED, BlockRole.BARE, BlockRole.BARE, BlockRole.LOADED)
CHANGE_S = 180.0  #: Time of a person to change the payload [s]
ROUNDING = 1e-9  #: Relative
MOST_BLOCKS = 60  #: Of one kind, in a look ahead


@dataclass(frozen=True, slots=True)
class BlocksSoFar:
    """Blocks of the fit that are there, and what is on the flange now."""

    bare: int
    loaded: int
    is_mounted: bool  #: whether the last block carried the payload


def fixed_role(number: int) -> BlockRole:
    """Return the role of a block by its number from 0, in the order that cancels drift."""
    if number < len(FIRST_BLOCKS):
        return FIRST_BLOCKS[number]
    return NEXT_BLOCKS[(number - len(FIRST_BLOCKS)) % len(NEXT_BLOCKS)]


def quickest_role(so_far: BlocksSoFar, variance_ratio: float, block_s: float) -> BlockRole:
    """Return the role with which the least time of a person is left until every gain is precise.

    Args:
        so_far: at least one block of each kind.
        variance_ratio: σ² of the worst gain over that of its target.
        block_s: duration of a block [s].
    """
    bare = so_far.bare
    loaded = so_far.loaded
    wanted = (1.0 / bare + 1.0 / loaded) / variance_ratio * (1.0 + ROUNDING)
    kept = BlockRole.LOADED if so_far.is_mounted else BlockRole.BARE
    changed = BlockRole.BARE if so_far.is_mounted else BlockRole.LOADED
    least_s = float("inf")
    # Where no look ahead is long enough, the kind with fewer blocks helps most.
    best = BlockRole.LOADED if loaded < bare or (loaded == bare and so_far.is_mounted) else BlockRole.BARE
    for more_bare in range(MOST_BLOCKS + 1):
        for more_loaded in range(MOST_BLOCKS + 1):
            is_enough = 1.0 / (bare + more_bare) + 1.0 / (loaded + more_loaded) <= wanted
            if not is_enough or more_bare + more_loaded == 0:
                continue
            more_kept = more_loaded if so_far.is_mounted else more_bare
            needs_change = more_bare + more_loaded > more_kept
            time_s = block_s * (more_bare + more_loaded) + (CHANGE_S if needs_change else 0.0)
            if time_s < least_s:
                least_s = time_s
                best = kept if more_kept else changed
            break  # with more loaded blocks it takes longer
    return best
