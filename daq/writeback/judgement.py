"""Whether gains differ from those in a controller by more than noise:
one answer for dry run, drives, page and job.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daq.config.cell import Cell
from daq.errors import DaqError
from daq.files import sha256
from daq.ledger.fold import History
from daq.ledger.ledger import MAY_LACK, Ledger, read_history
from daq.ledger.watch import dispersions_of
from daq.writeback.request import GainChange, Request
from ident.drift.change import DISPERSION, FALSE_ALARM, decide

_LOG = logging.getLogger("drivegain")

SAME_SIGMAS = 0.5
"""A current gain that is as near to a gain of the history is that gain,
rounded for the controller's file.
"""


@dataclass(frozen=True, slots=True)
class Spread:
    """Figures of a history that a change is judged by; empty without a history."""

    #: σ of the current gains, by axis [unit of the gain]; a gain whose σ is missing, or 0, is taken
    #: as exact: a person entered it, or the history does not have it.
    stds: Mapping[str, float] = field(default_factory=dict)
    #: Scatter of the cell's calibrations over their σ, by axis; `ident.drift.change.DISPERSION` for
    #: a missing one.
    dispersions: Mapping[str, float] = field(default_factory=dict)


NOTHING = Spread()


@dataclass(frozen=True, slots=True)
class JudgedChange:
    """The change of one gain, judged among all axes."""

    percent: float = math.nan  #: as of `ident.drift.change.Change`
    #: the change in σ of both as calibrations scatter, negative where the gain has decreased
    sigmas: float = math.nan
    significant: bool = False  #: whether it is more than noise, at FALSE_ALARM over all axes


NOT_JUDGED = JudgedChange()
"""Judgement of a gain whose numbers are not finite."""


def query_history(
    cell: Cell,
    target: str,
    request: Request,
    changes: Sequence[GainChange],
    audit: Path | None = None,
) -> Spread:
    """Return the figures of a cell's history; none, with a warning, where it cannot be read.

    Args:
        cell: as it is now.
        target: the controller's file, or the drives, as the audit log names them.
        request: calibration that is judged.
        changes: of its gains.
        audit: another audit log than the cell's.
    """
    ledger = Ledger.of(cell, audit)
    if ledger is None:
        return NOTHING
    try:
        history = read_history(ledger)
    except DaqError as error:
        _LOG.warning(
            "the history cannot be read, so the current gains are taken as exact: %s", error
        )
        return NOTHING
    if history.may_lack:
        _LOG.warning(MAY_LACK)
    if history.renamed is not None:
        _LOG.warning(
            "the history of cell %r is under its name %r, so the current gains are taken as exact",
            cell.name,
            history.renamed.new,
        )
    return known_of(history, target, sha256(request.signed), changes)


def known_of(history: History, target: str, digest: str, changes: Sequence[GainChange]) -> Spread:
    """Return the figures of a history for the current gains.

    The σ of a current gain is that of the calibration in force, if the gain is still that
    calibration's. Else it is that of the newest calibration with this gain: the history lacks a
    write after a kill, or when a backup was copied back by hand. It is 0 for a gain of no
    calibration, such as a nameplate, which a person entered.

    The calibration that is judged, by its digest, is left out: a gain that is near to it is another
    one unless it is in force, and the scatter is that of the others.
    """
    entries = history.entries
    in_force = history.in_force(target)
    others = [entry for entry in entries if entry.digest != digest]
    gains = {change.axis: change.compared_gain for change in changes}
    stds = dict.fromkeys(gains, 0.0)
    # Oldest first, then the one in force: the last one that fits counts.
    for entry in sorted(
        entries if in_force == digest else others, key=lambda entry: entry.digest == in_force
    ):
        for gain in entry.gains:
            if gain.axis in gains and abs(gains[gain.axis] - gain.value) <= SAME_SIGMAS * gain.std:
                stds[gain.axis] = gain.std
    return Spread(stds, dispersions_of(others, tuple(gains)))


def judge(changes: Sequence[GainChange], known: Spread) -> tuple[dict[str, JudgedChange], str]:
    """Judge changes by axis, and say the result in one sentence.

    Left out are gains whose numbers are not finite: these have a gate of their own.
    """
    comparable = [
        change
        for change in changes
        if all(map(math.isfinite, (change.compared_gain, change.new, change.std)))
        and change.std >= 0.0
    ]
    found = decide(
        tuple(change.axis for change in comparable),
        [change.compared_gain for change in comparable],
        [known.stds.get(change.axis, 0.0) for change in comparable],
        [change.new for change in comparable],
        [change.std for change in comparable],
        dispersion=[known.dispersions.get(change.axis, DISPERSION) for change in comparable],
    )
    judged = (
        JudgedChange(one.percent, one.sigmas, s)
        for one, s in zip(found.changes, found.significant, strict=True)
    )
    return dict(zip(found.axes, judged, strict=True)), found.words


def noise_note(changes: Sequence[GainChange], known: Spread) -> str:
    """Say what "more than noise" means for these changes, all from the same kind of gain."""
    exact = [change for change in changes if not known.stds.get(change.axis)]
    taken = "σ of both gains is taken into account"
    if exact:
        listed = ", ".join(change.axis for change in exact)
        whose = "all axes" if len(exact) == len(changes) else listed
        taken = f"the {exact[0].compared_with.value} is taken as exact on {whose}"
    return (
        "more than noise: the probability that noise alone makes such a change, on any axis, is "
        f"below {100 * FALSE_ALARM:g} %; {taken}"
    )
