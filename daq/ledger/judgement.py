"""Whether gains differ from those in a controller by more than noise: one answer for dry run, drives and job."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from daq.ledger.entry import Entry, Event
from daq.ledger.store import HistoryStore
from daq.ledger.watch import dispersions_of
from daq.writeback.request import GainChange
from ident.drift.change import DISPERSION, ChangeDecision, decide

# What the history knows of the gains that a controller has now.


SAME_SIGMAS = 0.5
"""A number in the controller's file that is that near to a gain of the history is that gain, rounded for the file."""


def stds_in_force(entries: Iterable[Entry], in_force: str | None, gains: Mapping[str, float]) -> dict[str, float]:
    """σ of gains in a controller, by axis.

    That of the calibration which the history has as in force, where the number is still that calibration's; else that
    of the newest one whose number it is, since a write is not always told to the history (a process was killed behind
    it, a backup was copied back by hand); 0 for a number of no calibration, which somebody entered.

    Args:
        entries: of the history, oldest first.
        in_force: digest of the calibration that the history has as in force, None where it knows of none.
        gains: in the controller now, by axis.
    """
    stds = dict.fromkeys(gains, 0.0)
    for entry in sorted(entries, key=lambda entry: entry.digest == in_force):  # the last one that fits counts
        for gain in entry.gains:
            if gain.axis in gains and abs(gains[gain.axis] - gain.value) <= SAME_SIGMAS * gain.std:
                stds[gain.axis] = gain.std
    return stds


def digests_in_force(events: Iterable[Event]) -> frozenset[str]:
    """Digests of the calibrations whose gains some controller has, as far as a history knows; events oldest first."""
    newest = {event.target: event.digest for event in events}
    return frozenset(digest for digest in newest.values() if digest is not None)


@dataclass(frozen=True, slots=True)
class Known:
    """What a history knows that a change is judged by; without one, nothing.

    Attributes:
        stds: σ of the numbers that are in the controller now, by axis [unit of the gain]; one that is not there, or 0,
            is taken as exact: somebody has entered it, or nothing is known of it.
        dispersions: how much more the cell's calibrations scatter than their σ says, by axis;
        `ident.drift.change.DISPERSION` for one that is not there.
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
        HistoryUnreadable: see `daq.ledger.store`.
    """
    entries, in_force = store.entries(), store.in_force(target)
    others = [entry for entry in entries if entry.digest != digest]
    whose = entries if in_force == digest else others
    gains = {change.axis: change.old for change in changes}
    return Known(stds_in_force(whose, in_force, gains), dispersions_of(others, tuple(gains)))


def judge(changes: Sequence[GainChange], known: Known) -> ChangeDecision:
    """Whether any of them is more than noise (`ident.drift.change.decide`); what is no number is left to a gate of
    its own.

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
