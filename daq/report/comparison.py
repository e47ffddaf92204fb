"""A calibration compared with the current gains, or with the nameplate,
and its state by the cell's ledger.

The judgement is that of `drivegain apply`: the same gates, and the same figures of the history. If
the controller was not read, the current gains are not known: the gains are compared with the
nameplate, and its limit applies.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.config.policy import ApplyPolicy
from daq.config.same_cell import require_cell_of
from daq.errors import CalibrationRefused, DaqError
from daq.files import sha256
from daq.ledger.fold import Event
from daq.ledger.ledger import Ledger, Standing, read_standing
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates.gate import Gate, GateContext, Refusal
from daq.writeback.gates.table import check_gates
from daq.writeback.judgement import (
    NO_HISTORY,
    HistoryFigures,
    figures_of_history,
    read_history_figures,
)
from daq.writeback.request import Edit, GainChange, GainOrigin, Request
from daq.writeback.target import propose
from ident.calibration import Calibration

OPERATORS = frozenset({Gate.SIGNATURE, Gate.BASE})
"""Gates that an operator opens by reviewing or signing; the calibration itself is not at fault."""


NO_LEDGER = Standing(
    None,
    unknown="no audit log was read; `drivegain certificate CALIBRATION --cell CELL` reads "
    "that of the cell",
)
"""State of a calibration where no cell was given."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Gains with the current ones, or with the nameplate where the controller was not read."""

    changes: tuple[GainChange, ...]  #: one an axis
    refusals: tuple[Refusal, ...]  #: failed checks
    policy: ApplyPolicy  #: limits
    known: HistoryFigures = NO_HISTORY  #: σ of the current gains, by the history
    #: planned change of the controller's file; None where it was not read
    edit: FileEdit | None = None
    unread: str = ""  #: why it was not read
    command: str = ""  #: that shows the change and, with --yes, writes it
    standing: Standing = NO_LEDGER  #: of the calibration by the cell's ledger

    @property
    def changed_by_hand(self) -> bool:
        """Whether the controller's file has other gains than the last write left there."""
        write = self.standing.write
        edit = self.edit
        if write is None or edit is None or self.standing.ended is not None:
            return False
        return edit.subject == write.target and edit.has_effect

    @property
    def in_force(self) -> Event | None:
        """Write after which the controller has these gains;
        None where it has others now, or never had these.
        """
        write = self.standing.write
        edit = self.edit
        if write is None or self.standing.ended is not None:
            return None
        if edit is not None and (edit.subject != write.target or edit.has_effect):
            return None
        return write

    def allowed_percent(self, change: GainChange) -> tuple[float, float]:
        """Limits of the change of a gain [% of the gain that is compared];
        infinite where it has none.
        """
        compared = change.compared_gain
        if not compared or not math.isfinite(compared):
            return -math.inf, math.inf
        nameplate = change.nameplate_gain / compared
        bound = self.policy.max_nameplate_percent
        lower = nameplate * (1.0 - bound / 100.0)
        upper = nameplate * (1.0 + bound / 100.0)
        ends = [100.0 * (lower - 1.0), 100.0 * (upper - 1.0)]
        if self.edit is not None:
            most = self.policy.max_change_percent
            if (absolute := self.policy.max_change.get(change.axis)) is not None:
                most = min(most, abs(100.0 * absolute / compared))
            ends = [max(min(ends), -most), min(max(ends), most)]
        return min(ends), max(ends)


def without_controller(
    calibration: Calibration, unread: str, now: datetime, cell: Cell | None = None
) -> Comparison:
    """Compare with the nameplate, and check the gates that need no controller.

    Args:
        calibration: whose gains are judged.
        unread: why the controller was not read.
        now: wall-clock time, for the age of the logs.
        cell: from the logs, None where there is none; then the default limits hold.
    """
    nameplates = {gain.axis: gain.nameplate for gain in calibration.gains}
    changes = changes_from(nameplates, GainOrigin.NAMEPLATE, calibration)
    edit = Edit(subject="", before=b"", after=b"", changes=changes)
    refusals = check_gates(GateContext(Request(calibration, now), edit, cell))
    not_judged = {Gate.CHANGE, *OPERATORS}
    judged = tuple(refusal for refusal in refusals if refusal.gate not in not_judged)
    policy = ApplyPolicy()
    if cell is not None:
        policy = cell.apply
    return Comparison(changes, judged, policy, unread=unread)


def changes_from(
    compared: Mapping[str, float], compared_with: GainOrigin, calibration: Calibration
) -> tuple[GainChange, ...]:
    """Return the changes of the gains from others, by axis, that are in no file."""
    changes = []
    for gain in calibration.gains:
        change = GainChange.of(gain, "", 0, compared[gain.axis], (gain.value, ""))
        changes.append(replace(change, compared_with=compared_with))
    return tuple(changes)


def compare(
    cell: Cell,
    request: Request,
    command: str = "",
    *,
    file: Path | None = None,
    audit: Path | None = None,
) -> Comparison:
    """Compare a calibration with the controller's file of a cell, as `apply` would; reads only.

    Without a file that can be read the gains are compared with the nameplate, and the reason is
    kept.

    Args:
        cell: from its file.
        request: calibration to judge.
        command: that shows the change; see `Comparison`.
        file: another controller file than the cell's.
        audit: another audit log than the cell's.

    Raises:
        CalibrationRefused: it is of another cell.
    """
    require_cell_of(
        request.calibration,
        cell,
        CalibrationRefused,
        f"calibration of cell {request.calibration.cell!r}",
        remedy="give the cell that was calibrated",
    )
    standing = _standing(cell, request, file or cell.controller_path, audit)
    if cell.controller is not None and not cell.controller.gains:
        places = zip(cell.axis_names, cell.controller.objects, strict=True)
        listed = ", ".join(f"{axis} {entry.parameter}" for axis, entry in places)
        unread = (
            f"The drives hold the gains ({listed}), and this page does not open the bus: "
            f"`{command} --drives`."
        )
        return replace(
            without_controller(request.calibration, unread, request.now, cell), standing=standing
        )
    try:
        proposal = propose(FileTarget.of(cell, file), request)
    except DaqError as error:
        unread = f"The controller was not read: {error}."
        return replace(
            without_controller(request.calibration, unread, request.now, cell), standing=standing
        )
    edit = proposal.edit
    known = read_history_figures(cell, edit.subject, request, edit.changes, audit)
    return Comparison(
        changes=edit.changes,
        refusals=proposal.refusals,
        policy=cell.apply,
        known=known,
        edit=edit,
        command=command,
        standing=standing,
    )


def _standing(cell: Cell, request: Request, file: Path | None, audit: Path | None) -> Standing:
    """Read the state of a calibration; the reason where it cannot be read."""
    ledger = Ledger.of(cell, audit)
    if ledger is None:
        return Standing(None, unknown="the cell has no audit log")
    place = None
    if file is not None:
        place = os.path.realpath(file)
    try:
        return read_standing(ledger, sha256(request.signed), request.now, place)
    except DaqError as error:
        return Standing(None, unknown=str(error))


def before_write(comparison: Comparison, digest: str) -> Comparison | None:
    """Compare with the previous gains, those before the write that is in force;
    None where there is none of them.

    Args:
        comparison: with the controller, whose current gains are those of the calibration.
        digest: SHA-256 of the calibration's file.
    """
    standing = comparison.standing
    if comparison.in_force is None:
        return None
    before = standing.before
    if any(change.axis not in before for change in comparison.changes):
        return None
    compared = []
    for change in comparison.changes:
        gain = before[change.axis]
        compared.append(replace(change, compared_gain=gain, compared_with=GainOrigin.PREVIOUS))
    changes = tuple(compared)
    # The previous gains were those of another calibration: none is in force for them.
    others = replace(standing.history, events=())
    known = figures_of_history(others, "", digest, changes)
    return replace(comparison, changes=changes, refusals=(), known=known)
