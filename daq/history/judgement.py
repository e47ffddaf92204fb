"""Whether gains differ from those in a controller by more than noise: one answer for dry run, drives and job."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from daq.history.in_force import stds_in_force
from daq.history.store import HistoryStore
from daq.history.watch import dispersions_of
from daq.write_back.gain_gates import GainChange
from ident.drift import DISPERSION, ChangeDecision, decide


@dataclass(frozen=True, slots=True)
class Known:
    """What a history knows that a change is judged by; without one, nothing.

    Attributes:
        stds: σ of the numbers that are in the controller now, by axis [unit of the gain]; one that is not there, or 0,
            is taken as exact: somebody has entered it, or nothing is known of it.
        dispersions: how much more the cell's calibrations scatter than their σ says, by axis; `ident.drift.DISPERSION`
            for one that is not there.
    """

    stds: Mapping[str, float] = field(default_factory=dict)
    dispersions: Mapping[str, float] = field(default_factory=dict)


NOTHING = Known()


def known_of(store: HistoryStore, target: str, digest: str, changes: Sequence[GainChange]) -> Known:
    """What a history knows of the gains in a controller.

    Args:
        store: of the cell.
        target: the controller's file, or the drives, as events name it.
        digest: of the calibration that is judged: a number that happens to be near to it is not it, unless it is in
            force, and it does not tell how calibrations scatter.
        changes: one an axis.

    Raises:
        HistoryUnreadable: see `daq.history.store`.
    """
    entries, in_force = store.entries(), store.in_force(target)
    others = [entry for entry in entries if entry.digest != digest]
    whose = entries if in_force == digest else others
    gains = {change.axis: change.old for change in changes}
    return Known(stds_in_force(whose, in_force, gains), dispersions_of(others, tuple(gains)))


def judge(changes: Sequence[GainChange], known: Known) -> ChangeDecision:
    """Whether any of them is more than noise (`ident.drift.decide`); what is no number is left to a gate of its own.

    Args:
        changes: one an axis.
        known: by a history.
    """
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
