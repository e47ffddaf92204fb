"""Whether gains differ from those in a controller by more than noise:
dry run, write, certificate and job all ask here, so that they agree.
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
"""Largest distance of a current gain from a calibrated one of the history [σ of the latter].

Within it both are the same gain; the difference is the rounding in the controller's file.
"""


@dataclass(frozen=True, slots=True)
class HistoryFigures:
    """σ and scatter of gains by a history, by which a change is judged; empty without a history."""

    #: σ of the current gains, by axis [unit of the gain]. A gain without σ, or with a σ of 0, is
    #: taken as exact: a person entered it, or the history does not have it.
    stds: Mapping[str, float] = field(default_factory=dict)
    #: Scatter of the cell's calibrations over their σ, by axis. For a missing axis it is
    #: `ident.drift.change.DISPERSION`.
    dispersions: Mapping[str, float] = field(default_factory=dict)


NO_HISTORY = HistoryFigures()
"""Figures of a cell without a history."""


@dataclass(frozen=True, slots=True)
class JudgedChange:
    """The change of one gain, judged among all axes."""

    percent: float = math.nan  #: the change, as in `ident.drift.change.Change`
    #: the change over its σ, which includes the scatter of calibrations; negative for a gain that
    #: has decreased
    sigmas: float = math.nan
    significant: bool = False  #: whether it is more than noise, at FALSE_ALARM over all axes


NOT_JUDGED = JudgedChange()
"""Judgement of a gain whose numbers are not finite."""


def read_history_figures(
    cell: Cell,
    target: str,
    request: Request,
    changes: Sequence[GainChange],
    audit: Path | None = None,
) -> HistoryFigures:
    """Return the figures of a cell's history for the current gains.

    They are `NO_HISTORY` for a cell without one, and, with a warning, where it cannot be read or is
    under a new name of the cell.

    Args:
        cell: as it is now.
        target: the controller's file, or the drives, as the audit log names them.
        request: with the calibration that is judged.
        changes: of its gains.
        audit: another audit log than the cell's.
    """
    ledger = Ledger.of(cell, audit)
    if ledger is None:
        return NO_HISTORY
    try:
        history = read_history(ledger)
    except DaqError as error:
        _LOG.warning(
            "the history cannot be read, so the current gains are taken as exact: %s", error
        )
        return NO_HISTORY
    if history.may_lack:
        _LOG.warning(MAY_LACK)
    if history.renamed is not None:
        _LOG.warning(
            "the history of cell %r is under its name %r, so the current gains are taken as exact",
            cell.name,
            history.renamed.new,
        )
        return NO_HISTORY  # what is under the old name since then is of another cell
    digest = sha256(request.signed)  # of the calibration's file
    return figures_of_history(history, target, digest, changes)


def figures_of_history(
    history: History, target: str, digest: str, changes: Sequence[GainChange]
) -> HistoryFigures:
    """Return the figures of a history for the current gains.

    The σ of a current gain is found in this order:

    1. the calibration in force, if it has this gain;
    2. the newest calibration with this gain. The history lacks a write after a kill, or when a
       backup was copied back by hand;
    3. 0 if no calibration has it: a person entered it, such as a nameplate.

    The calibration that is judged is left out of the scatter. As a calibration of the current gain
    it counts only if it is in force: otherwise that gain is from elsewhere, however near it is.

    Args:
        history: of the cell.
        target: the controller's file, or the drives, as the audit log names them.
        digest: SHA-256 of the calibration that is judged.
        changes: of its gains.
    """
    in_force = history.in_force(target)
    others = [entry for entry in history.entries if entry.digest != digest]
    if in_force == digest:
        candidates = list(history.entries)
    else:
        candidates = others
    # Oldest first, the one in force last: a later one with the gain replaces those before.
    by_precedence = sorted(candidates, key=lambda entry: entry.digest == in_force)
    current_gains = {change.axis: change.compared_gain for change in changes}
    stds = dict.fromkeys(current_gains, 0.0)
    for entry in by_precedence:
        for gain in entry.gains:
            if gain.axis not in current_gains:
                continue
            distance = abs(current_gains[gain.axis] - gain.value)
            if distance <= SAME_SIGMAS * gain.std:
                stds[gain.axis] = gain.std
    axes = tuple(current_gains)
    dispersions = dispersions_of(others, axes)
    return HistoryFigures(stds, dispersions)


def judge(
    changes: Sequence[GainChange], figures: HistoryFigures
) -> tuple[dict[str, JudgedChange], str]:
    """Judge changes by axis, and say the result in one sentence.

    Gains with numbers that are not finite are left out: the gate `finite_gains` refuses them.
    """
    comparable = [change for change in changes if _is_comparable(change)]
    axes = tuple(change.axis for change in comparable)
    current_gains = [change.compared_gain for change in comparable]
    current_stds = [figures.stds.get(axis, 0.0) for axis in axes]
    new_gains = [change.new for change in comparable]
    new_stds = [change.std for change in comparable]
    dispersions = [figures.dispersions.get(axis, DISPERSION) for axis in axes]
    decision = decide(
        axes,
        current_gains,
        current_stds,
        new_gains,
        new_stds,
        dispersion=dispersions,
    )
    judged = {}
    decided = zip(decision.axes, decision.changes, decision.significant, strict=True)
    for axis, change, is_significant in decided:
        judged[axis] = JudgedChange(change.percent, change.sigmas, is_significant)
    return judged, decision.words


def _is_comparable(change: GainChange) -> bool:
    """Return whether both gains and σ are numbers that a change can be computed from."""
    numbers = (change.compared_gain, change.new, change.std)
    is_finite = all(map(math.isfinite, numbers))
    return is_finite and change.std >= 0.0


def noise_note(changes: Sequence[GainChange], figures: HistoryFigures) -> str:
    """Say what "more than noise" means for these changes.

    All of them are compared with gains of one origin, such as the current gains.
    """
    exact = [change for change in changes if not figures.stds.get(change.axis)]
    sigma_note = "σ of both gains is taken into account"
    if exact:
        origin = exact[0].compared_with.value
        exact_axes = ", ".join(change.axis for change in exact)
        if len(exact) == len(changes):
            exact_axes = "all axes"
        sigma_note = f"the {origin} is taken as exact on {exact_axes}"
    false_alarm_percent = 100 * FALSE_ALARM
    return (
        "more than noise: the probability that noise alone makes such a change, on any axis, is "
        f"below {false_alarm_percent:g} %; {sigma_note}"
    )
