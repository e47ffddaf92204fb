"""Whether gains differ from those in a controller by more than noise: one answer for dry run, drives and job."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from daq.ledger.store import HistoryStore
from daq.ledger.watch import dispersions_of
from daq.writeback.request import GainChange
from ident.drift.change import DISPERSION, ChangeDecision, decide

SAME_SIGMAS = 0.5
"""A number in the controller's file that is as near to a gain of the history is that gain, rounded for the file."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Figures of a history that a change is judged by; empty without a history."""

    #: Σ of the numbers that are in the controller now, by axis [unit of the gain]; a missing one, or 0, is taken as
    #: exact: a person entered that number, or the history does not have it.
    stds: Mapping[str, float] = field(default_factory=dict)
    #: Scatter of the cell's calibrations over their σ, by axis; `ident.drift.change.DISPERSION` for a missing one.
    dispersions: Mapping[str, float] = field(default_factory=dict)


NOTHING = Spread()


def known_of(store: HistoryStore, target: str, digest: str, changes: Sequence[GainChange]) -> Spread:
    """Return the figures of a history for the gains in a controller.

    The σ of a gain is that of the calibration in force where the number is still that calibration's. Else it is that of
    the newest calibration with this number: the history lacks a write after a kill, or when a backup was copied back by
    hand. It is 0 for a number of no calibration, which a person entered.

    The calibration that is judged, by its digest, is left out: a number that is near to it is another one unless it is
    in force, and the scatter is that of the others.

    Raises:
        HistoryUnreadable: see `daq.ledger.store`.
    """
    entries, in_force = store.entries(), store.in_force(target)
    others = [entry for entry in entries if entry.digest != digest]
    gains = {change.axis: change.old for change in changes}
    stds = dict.fromkeys(gains, 0.0)
    # Oldest first, then the one in force: the last one that fits counts.
    for entry in sorted(entries if in_force == digest else others, key=lambda entry: entry.digest == in_force):
        for gain in entry.gains:
            if gain.axis in gains and abs(gains[gain.axis] - gain.value) <= SAME_SIGMAS * gain.std:
                stds[gain.axis] = gain.std
    return Spread(stds, dispersions_of(others, tuple(gains)))


def judge(changes: Sequence[GainChange], known: Spread) -> ChangeDecision:
    """Decide whether any change is more than noise; numbers that are not finite have a gate of their own."""
    comparable = [
        change
        for change in changes
        if all(map(math.isfinite, (change.old, change.new, change.std))) and change.std >= 0.0
    ]
    return decide(
        tuple(change.axis for change in comparable),
        [change.old for change in comparable],
        [known.stds.get(change.axis, 0.0) for change in comparable],
        [change.new for change in comparable],
        [change.std for change in comparable],
        dispersion=[known.dispersions.get(change.axis, DISPERSION) for change in comparable],
    )
