"""Bring axes back within their limits before a recording: slowly, by a little, and only where the cell allows it.

An abrupt stop, of a brake or a killed recorder, may end a little beyond a limit. No recording begins there. A cell file
with `policy: {recovery_motion: allowed}` permits the return; it needs the same permission to move, and the same
interlock, as every motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import numpy as np

from daq.config.cell import Cell
from daq.config.policy import Permission
from daq.log.conversion import SiScaling
from daq.workflow.plan_file import check_way
from drivers.canopen.network import CanopenNetwork
from drivers.errors import MotionRefused
from drivers.motion.execute import execute
from drivers.move import AxisLimits, MotionPermission, Move, synchronised_move
from drivers.stream.stream import SyncStream
from drivers.stream.sync import Pacing

LARGEST_SHARE = 0.02  #: Of an axis's range: farther beyond a limit a person has to find out why
SLOW = 0.05  #: Share of an axis's limits of velocity and acceleration
INSIDE = 0.001  #: Share of the range by which the return ends within the limit: a loop at rest is off by some counts
LEAST_PER_S = 3.0  #: Least velocity and acceleration of a move [counts/s, counts/s²]


def recovery_move(
    cell: Cell, scale: SiScaling, start_counts: Sequence[int], limits: Sequence[AxisLimits]
) -> tuple[Move, tuple[AxisLimits, ...], str] | None:
    """Return the move that brings all axes within their limits, its own limits, and a remark; None if all are inside.

    Raises:
        MotionRefused: an axis is outside and the cell does not allow the return, or it is too long or not clear.
    """
    beyond = [
        max(limit.position_min_counts - start, start - limit.position_max_counts, 0)
        for start, limit in zip(start_counts, limits, strict=True)
    ]
    if not any(beyond):
        return None
    ranges = [limit.position_max_counts - limit.position_min_counts for limit in limits]
    found = "; ".join(
        f"{name} at {start} counts, {count} ({100.0 * count / max(span, 1):.2g} % of its range) beyond its limits"
        for name, start, count, span in zip(cell.axis_names, start_counts, beyond, ranges, strict=True)
        if count
    )
    _require_allowed(cell, found, max(count / max(span, 1) for count, span in zip(beyond, ranges, strict=True)))
    target = tuple(
        round(np.clip(start, limit.position_min_counts + INSIDE * span, limit.position_max_counts - INSIDE * span))
        if count
        else start
        for start, limit, count, span in zip(start_counts, limits, beyond, ranges, strict=True)
    )
    here, there = (scale.joint_position(np.array(counts)) for counts in (start_counts, target))
    check_way(cell, here, there, "the slow return within the limits")
    slow = tuple(
        AxisLimits(
            min(limit.position_min_counts, start),
            max(limit.position_max_counts, start),
            max(SLOW * limit.velocity_counts_s, LEAST_PER_S),
            max(SLOW * limit.acceleration_counts_s2, LEAST_PER_S),
        )
        for start, limit in zip(start_counts, limits, strict=True)
    )
    return synchronised_move(start_counts, target, slow), slow, f"{found}; it was brought back slowly"


def bring_back(
    network: CanopenNetwork, pacing: Pacing, move: Move, limits: tuple[AxisLimits, ...], granted_by: str
) -> None:
    """Make the recovery move; the network is then as after `prepare`.

    Raises:
        DriverError: as `execute`; the axes were stopped.
    """
    stream = SyncStream(network, pacing)
    with closing(execute(network, stream, (move,), MotionPermission(granted_by, limits))) as samples:
        for _ in samples:
            pass
    network.prepare()  # a motion ends the guards


def _require_allowed(cell: Cell, found: str, share: float) -> None:
    by_hand = "nothing has moved; bring it back by hand"
    if cell.chain is not None:
        remedy = f"{by_hand}: no motor of a closed chain moves alone"
    elif share > LARGEST_SHARE:
        remedy = f"{by_hand}, and find out how it got there: it is too far for `recovery_motion`"
    elif cell.recovery_motion is not Permission.ALLOWED:
        remedy = f"{by_hand}, or allow a slow return with `policy: {{recovery_motion: allowed}}` in the cell file"
    else:
        return
    raise MotionRefused(found, expected="every axis within its limits", remedy=remedy)
