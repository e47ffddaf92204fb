"""What the history knows of the gains that a controller has now."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from daq.history.entry import Entry, Event

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
