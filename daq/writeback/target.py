"""Propose a change of a target, apply it, and roll it back: the one path by which gains reach a controller.

A target is a place that holds the gains of a cell: the controller's file (`FileTarget`) or the drives themselves
(`DriveTarget`). It plans an `Edit` and writes it. Everything else is done here, once for all targets: the gates, the
audit before and after the write, and the refusal.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from daq.config.cell import Cell
from daq.errors import CalibrationRefused
from daq.ledger.audit import AuditAction, AuditRecorder
from daq.writeback.gates.gate import GateContext, Refusal, refusal_error
from daq.writeback.gates.table import check_gates
from daq.writeback.request import Edit, GainChange, Request
from drivers.canopen.parameters import ParameterChange
from ident.calibration import Calibration

E = TypeVar("E", bound=Edit)


@dataclass(frozen=True, slots=True)
class Written:
    """A change that was made.

    Attributes:
        edit: the change.
        backup: file with the content before it; None where there was none.
        parameters: one for each drive that was written.
        audit_sha256: digest of the audit's last entry about it, to be noted elsewhere; None without an audit.
    """

    edit: Edit
    backup: Path | None
    parameters: tuple[ParameterChange, ...] = ()
    audit_sha256: str | None = None


class Target(Protocol[E]):
    """A place that holds the gains of a cell; frozen."""

    @property
    def cell(self) -> Cell | None:
        """The cell as it is now; None for a library without one."""

    @property
    def subject(self) -> str:
        """The target, as audit and history name it."""

    def plan(self, calibration: Calibration) -> E:
        """Plan the change that a calibration makes; reads only.

        Raises:
            ConfigurationInconsistent: the cell does not say where the gains are.
            CalibrationRefused: the calibration has other axes than the target.
            ControllerUnfit: the target cannot be read, or cannot hold a gain.
        """

    def plan_rollback(self) -> E:
        """Plan to restore the content before the last write; reads only.

        Raises:
            CalibrationRefused: there is none.
            ControllerChanged: the content was changed since; a rollback would lose that.
            ControllerUnfit: the target cannot be read, or its backup was changed.
        """

    def lock(self, edit: E) -> contextlib.AbstractContextManager[None]:
        """Exclude other writers.

        Raises:
            CalibrationRefused: another drivegain is writing.
            ControllerChanged: the content is not the one that the change was planned for.
        """

    def details(self, edit: E) -> Mapping[str, object]:
        """Describe the change for the audit, as plain JSON with finite numbers."""

    def write(self, edit: E, now: datetime, who: str) -> Written:
        """Make the change, all of it or none, under the lock; keep the content before it first.

        Raises:
            ControllerChanged: the content is not the one that the change was planned for.
            DriverError: from the drives.
            OSError: from the file system; the content is as it was.
        """


@dataclass(frozen=True, slots=True)
class Proposal(Generic[E]):
    """A planned change with the verdict of the gates.

    Attributes:
        target: where it would be made.
        edit: the change.
        refusals: failed checks; only a proposal without any can be applied.
        evidence: digests of what the change rests on, for the audit.
    """

    target: Target[E]
    edit: E
    refusals: tuple[Refusal, ...]
    evidence: Mapping[str, object] = field(default_factory=dict)

    @property
    def error(self) -> CalibrationRefused:
        """The error for a proposal with failed checks."""
        return refusal_error(self.edit.subject, self.refusals)


def propose(target: Target[E], request: Request) -> Proposal[E]:
    """Plan what a calibration changes in a target, and check every gate; reads only.

    Raises:
        UsageError: the value of --base is no digest.
        ConfigurationInconsistent, CalibrationRefused, ControllerUnfit: see `Target.plan`.
        DriverError: from the drives.
    """
    edit = target.plan(request.calibration)
    refusals = check_gates(GateContext(request, edit, target.cell))
    return Proposal(target, edit, refusals, request.evidence)


def apply(proposal: Proposal[E], now: datetime, *, audit: Path | None = None, who: str = "") -> Written | None:
    """Make a proposed change.

    Args:
        proposal: without refusals.
        now: time for the name of the backup, and for the audit.
        audit: file that records the beginning before anything is replaced, the end, and refusals; None for none.
        who: the operator or the job.

    Returns:
        the change, None where there was nothing to write.

    Raises:
        CalibrationRefused: a check failed; every failed one is listed.
        CalibrationRefused, DriverError, OSError: see `Target.lock` and `Target.write`.
        AuditUnusable: the beginning could not be recorded; nothing was written.
    """
    edit, recorder = proposal.edit, AuditRecorder(audit, who, now)
    details = {**proposal.target.details(edit), **proposal.evidence}
    if proposal.refusals:
        recorder.record_refusal(Path(edit.subject), proposal.refusals, details)
        raise proposal.error
    if not edit.has_effect:
        recorder.record_no_change(Path(edit.subject), edit.after, details)
        return None
    actions = (AuditAction.APPLY_BEGUN, AuditAction.APPLIED)
    return _write(proposal.target, edit, recorder, actions, details, details)


def rollback(
    target: Target[E], now: datetime, *, audit: Path | None = None, who: str = "", planned: E | None = None
) -> Written:
    """Restore the content before the last write.

    The replaced content is kept as well, so that a second rollback undoes the first. A file that was deleted comes
    back as it was before the last write.

    Args:
        target: where.
        now, audit, who: as in `apply`.
        planned: rollback that was planned and shown already.

    Raises:
        CalibrationRefused: see `Target.plan_rollback`.
        CalibrationRefused, DriverError, OSError: see `Target.lock` and `Target.write`.
        AuditUnusable: the beginning could not be recorded; nothing was written.
    """
    recorder, asked = AuditRecorder(audit, who, now), {"asked": "rollback"}
    edit = planned
    if edit is None:
        with recorder.record_refusal_of(Path(target.subject), asked):
            edit = target.plan_rollback()
    actions = (AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK)
    return _write(target, edit, recorder, actions, target.details(edit), asked)


def _write(
    target: Target[E],
    edit: E,
    recorder: AuditRecorder,
    actions: tuple[AuditAction, AuditAction],
    details: Mapping[str, object],
    refused_details: Mapping[str, object],
) -> Written:
    """Write under the lock, between the two entries of the audit."""
    subject = Path(edit.subject)
    with contextlib.ExitStack() as held:
        with recorder.record_refusal_of(subject, refused_details):
            held.enter_context(target.lock(edit))
        written, audit_sha256 = recorder.record_write(
            *actions, subject, edit.before, edit.after, details,
            partial(target.write, edit, recorder.at, recorder.who),
        )  # fmt: skip
    return replace(written, audit_sha256=audit_sha256)


def audited_change(change: GainChange) -> dict[str, object]:
    """One gain for the audit, which takes finite numbers only."""
    numbers = {"old": change.old, "new": change.new, "std": change.std}
    finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    return {"axis": change.axis, "key": change.key, "unit": change.unit, **finite}
