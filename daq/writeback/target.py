"""Propose a change of a target, apply it, and roll it back:
the one path by which gains reach a controller.

A target is a place that holds the gains of a cell: the controller's file (`FileTarget`) or the
drives themselves (`DriveTarget`). It plans an `Edit` and writes it. Everything else is done here,
once for all targets: the gates, the audit before and after the write, the refusal, and the
calibration's entry in the history. Nothing else writes either.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from daq.arguments import (
    A_MOMENT,
    A_PATH,
    A_TEXT,
    checks_arguments,
    of_kind,
    optional,
    with_methods,
)
from daq.config.cell import Cell
from daq.errors import (
    AuditUnusable,
    CalibrationRefused,
    DaqError,
    OutputFailed,
    counted,
    evidence,
    reason_of,
)
from daq.files import sha256
from daq.ledger.audit import (
    BACKUPS_WITHOUT_LOG,
    GONE,
    AuditAction,
    AuditEntry,
    digest_now,
    unmade_write,
    verify,
)
from daq.ledger.fold import WriteAction
from daq.ledger.ledger import Ledger, enter_calibration, read_history, record_write
from daq.ledger.names import RenamedCell
from daq.writeback.file_access import backups_without_log
from daq.writeback.gates.fit import OF_DESCRIPTION
from daq.writeback.gates.gate import GateContext, Refusal
from daq.writeback.gates.table import check_gates
from daq.writeback.request import Edit, Request
from drivers.canopen.parameters import ParameterChange
from ident.calibration import Calibration

_LOG = logging.getLogger("drivegain")
E = TypeVar("E", bound=Edit)


@dataclass(frozen=True, slots=True)
class Written:
    """A change that was made."""

    edit: Edit  #: the change
    backup: Path | None  #: file with the content before it; None where there was none
    parameters: tuple[ParameterChange, ...] = ()  #: one for each drive that was written
    not_in_history: str = ""  #: why the history lacks it; empty where it does not


class Target(Protocol[E]):
    """A place that holds the gains of a cell; frozen."""

    @property
    def cell(self) -> Cell | None:
        """The cell as it is now; None for a library without one."""

    @property
    def subject(self) -> str:
        """The target, as audit and history name it."""

    def check_fields(self) -> None:
        """Refuse fields of another type.

        Raises:
            UsageError: there is one; it is named.
        """

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
            OSError: from the file system; the content is as it was, unless its digest shows the new
                one.
        """


@dataclass(frozen=True, slots=True)
class Proposal(Generic[E]):
    """A planned change with the verdict of the gates."""

    target: Target[E]  #: where it would be made
    request: Request  #: whose calibration it is
    edit: E  #: the change
    refusals: tuple[Refusal, ...]  #: failed checks; only a proposal without any can be applied

    @property
    def error(self) -> CalibrationRefused:
        """The error for a proposal with failed checks,
        with what its fit found wrong in the description.
        """
        error = self._refusal
        refused = {(refusal.found, refusal.remedy) for refusal in self.refusals}
        for diagnosis in self.request.calibration.diagnoses:
            if diagnosis.name not in OF_DESCRIPTION:
                continue
            if (diagnosis.found, diagnosis.remedy) in refused:
                continue
            error.add_note(
                f"hint: the fit of this calibration found {diagnosis.found}; {diagnosis.remedy}"
            )
            break  # the first one alone
        return error

    @property
    def _refusal(self) -> CalibrationRefused:
        """The failed checks; several are listed one a line."""
        if len(self.refusals) == 1:
            only = self.refusals[0]
            return CalibrationRefused(
                only.subject, found=only.found, expected=only.expected, remedy=only.remedy
            )
        # The list ends its last line; what is expected follows on a line of its own.
        lines = "".join(f"\n  {refusal}" for refusal in self.refusals)
        return CalibrationRefused(
            self.edit.subject,
            found=f"{len(self.refusals)} failed checks{lines}\n ",
            expected="none",
            remedy="nothing was written; each line ends with what to do",
        )


A_TARGET = with_methods(
    "a FileTarget or a DriveTarget", "check_fields", "plan", "plan_rollback", "write"
)


@checks_arguments(target=A_TARGET, request=of_kind(Request))
def propose(target: Target[E], request: Request) -> Proposal[E]:
    """Plan what a calibration changes in a target, and check every gate; reads only.

    Raises:
        UsageError: the value of --base is no digest, or an argument, or a field of one, is of
            another type.
        ConfigurationInconsistent, CalibrationRefused, ControllerUnfit: see `Target.plan`.
        DriverError: from the drives.
    """
    request.check_fields()
    target.check_fields()
    edit = target.plan(request.calibration)
    context = GateContext(request, edit, target.cell, _rename_of(target.cell))
    return Proposal(target, request, edit, check_gates(context))


def _rename_of(cell: Cell | None) -> RenamedCell | None:
    """The rename after which the robot of a cell has another name; None without one.

    A history that cannot be read tells of none: its own message says so.
    """
    if cell is None:
        return None
    ledger = Ledger.of(cell)
    if ledger is None:
        return None
    with contextlib.suppress(DaqError):
        return read_history(ledger).renamed
    return None


@checks_arguments(proposal=of_kind(Proposal), now=A_MOMENT, audit=optional(A_PATH), who=A_TEXT)
def apply(
    proposal: Proposal[E], now: datetime, *, audit: Path | None = None, who: str = ""
) -> Written | None:
    """Make a proposed change, and enter it in audit log and history.

    The history is part of the audit log: of a target without a cell there is none.

    Args:
        proposal: without refusals.
        now: time for the name of the backup, and for the audit.
        audit: file that records the beginning before anything is replaced, the end, the
            calibration, and refusals; None for none of it.
        who: the operator or the job.

    Returns:
        the change, None where there was nothing to write. What is written is not undone where the
        history cannot take it: a warning is logged, and the change says why.

    Raises:
        UsageError: an argument is of another type; nothing was written.
        CalibrationRefused: a check failed; every failed one is listed.
        CalibrationRefused, DriverError, OSError: see `Target.lock` and `Target.write`.
        OutputFailed: the file system failed once the new content was in place, or so that the
            content is not known.
        AuditUnusable: the beginning could not be recorded; nothing was written.
    """
    edit = proposal.edit
    recorder = _Recorder(audit, who, now, edit.subject)
    details = {**proposal.target.details(edit), **proposal.request.evidence}
    if proposal.refusals:
        refusals = []
        for refusal in proposal.refusals:
            refusals.append(
                {
                    "gate": refusal.gate.value,
                    "subject": refusal.subject,
                    "found": refusal.found,
                }
            )
        recorder.end(AuditAction.REFUSED, {"refusals": refusals, **details})
        raise proposal.error
    if not edit.has_effect:
        recorder.end(AuditAction.NOTHING_TO_DO, {"sha256_found": sha256(edit.after), **details})
        _complete_history(proposal, recorder)
        return None
    actions = (AuditAction.APPLY_BEGUN, AuditAction.APPLIED)
    written = _write(proposal.target, edit, recorder, actions, details, details)
    try:
        not_in_history = _complete_history(proposal, recorder)
    except BaseException as error:
        # Whoever reads of the interrupt must know that the write is done.
        error.add_note(f"kept: {_IN_PLACE.format(edit.subject)}")
        raise
    return replace(written, not_in_history=not_in_history)


@checks_arguments(
    target=A_TARGET,
    now=A_MOMENT,
    audit=optional(A_PATH),
    who=A_TEXT,
    planned=optional(of_kind(Edit)),
)
def rollback(
    target: Target[E],
    now: datetime,
    *,
    audit: Path | None = None,
    who: str = "",
    planned: E | None = None,
) -> Written:
    """Restore the content before the last write, and enter that in audit log and history,
    which are one.

    The replaced content is kept as well, so that a second rollback undoes the first. A file that
    was deleted comes back as it was before the last write.

    Args:
        target: where.
        now, audit, who: as in `apply`.
        planned: rollback that was planned and shown already.

    Raises:
        UsageError: an argument is of another type; nothing was written.
        CalibrationRefused: see `Target.plan_rollback`; or the last write was begun and not made.
        CalibrationRefused, DriverError, OSError: see `Target.lock` and `Target.write`.
        AuditUnusable: the beginning could not be recorded; nothing was written.
    """
    target.check_fields()
    refused_details = {"asked": "rollback"}
    if planned is None:
        subject = target.subject
    else:
        subject = planned.subject
    recorder = _Recorder(audit, who, now, subject)
    with recorder.refusals(refused_details):
        try:
            edit = planned or target.plan_rollback()
        except CalibrationRefused:
            # There is no earlier write either: the reason is the same.
            _require_made_write(recorder)
            raise
    actions = (AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK)
    return _write(target, edit, recorder, actions, target.details(edit), refused_details)


def _write(
    target: Target[E],
    edit: E,
    recorder: _Recorder,
    actions: tuple[AuditAction, AuditAction],
    details: Mapping[str, object],
    refused_details: Mapping[str, object],
) -> Written:
    """Write under the lock, between the two entries of the audit.

    Args:
        target: where.
        edit: the change.
        recorder: makes the entries.
        actions: that of the first entry, and that of the last one if all goes well.
        details: what the first entry says besides the digests.
        refused_details: what the entry says if the lock refuses the write.

    Raises:
        CalibrationRefused, DriverError, OSError, OutputFailed, AuditUnusable: see `apply`.
    """
    begun_action, done_action = actions
    with contextlib.ExitStack() as lock:
        with recorder.refusals(refused_details):
            lock.enter_context(target.lock(edit))
            if begun_action is AuditAction.ROLLBACK_BEGUN:
                # Under the lock, so that a write that still goes on is not taken for one.
                _require_made_write(recorder)
        digest_before = None if edit.before is None else sha256(edit.before)
        digest_after = sha256(edit.after)
        begun = recorder.begin(
            begun_action,
            {
                "sha256_before": digest_before,
                "sha256_after": digest_after,
                **details,
                **_note_of_absent_log(recorder),
            },
        )
        try:
            written = target.write(edit, recorder.at, recorder.who)
        # An interrupt ends a write, too.
        except BaseException as error:
            # It may come when all is done: the digest shows the content, whatever the error says.
            found_digest = digest_now(edit.subject)
            is_new_in_place = edit.has_effect and found_digest == digest_after
            is_old_in_place = found_digest == (digest_before or GONE)
            if begun is not None:
                last_action = done_action if is_new_in_place else AuditAction.FAILED
                failure = {
                    "begun": begun.number,
                    "error": f"{type(error).__name__}: {error}"[:500],
                    "sha256_found": found_digest,
                }
                recorder.end(last_action, failure)
            if isinstance(error, OSError) and not is_old_in_place:
                raise _error_after_replacement(edit, error, is_made=is_new_in_place) from error
            if is_new_in_place:
                error.add_note(f"kept: {_IN_PLACE.format(edit.subject)}")
            raise
        if begun is not None:
            recorder.end(done_action, {"begun": begun.number})
        return written


def _require_made_write(recorder: _Recorder) -> None:
    """Refuse a rollback where the last write is an `apply` that was begun and not made.

    The file is as it was before that write; a rollback would undo the write before it. A rollback
    that was begun and not made is no reason to refuse: this one makes it. An audit log that cannot
    be read shows neither; the entry that follows refuses it by name.

    Raises:
        CalibrationRefused: the last write was not made.
    """
    if recorder.audit is None:
        return
    try:
        verdict = verify(recorder.audit)
    except (AuditUnusable, OSError):
        return
    last = unmade_write(verdict, recorder.subject)
    if last is None or last.action is not AuditAction.APPLY_BEGUN:
        return
    backup_name = f"{Path(recorder.subject).name}.<time>.<digests>.bak"
    raise CalibrationRefused(
        recorder.subject,
        found=f"a last write, begun by {last.who} at {last.at}, that was not made",
        expected="a write to take back",
        remedy="nothing was changed, and nothing needs to be undone: the file is as it was before "
        "that write; to take back the write before it all the same, copy its backup "
        f"({backup_name}) over the file",
    )


def _note_of_absent_log(recorder: _Recorder) -> dict[str, object]:
    """Return what a new audit log says of the one that is absent; empty where none is missed.

    Backups of earlier writes without an audit log show that there was one.

    The write goes on: who removed the log must not thereby keep a technician from rolling back.
    """
    subject = Path(recorder.subject)
    is_file = subject.is_absolute()  # drives have a name, and no backups next to them
    if recorder.audit is None or not is_file:
        return {}
    count = backups_without_log(recorder.audit, subject)
    if count == 0:
        return {}
    _LOG.warning(
        "%s is absent, although %s has %s of earlier writes next to it: a new audit log begins "
        "with this write, and says so; if the old one was not moved on purpose, restore it and "
        "ask who removed it",
        recorder.audit,
        subject,
        counted(count, "backup"),
    )
    return {BACKUPS_WITHOUT_LOG: count}


def _complete_history(proposal: Proposal[E], recorder: _Recorder) -> str:
    """Enter the calibration whose gains the target has now;
    return why it could not be entered, empty if it was.

    The target may have had them before: their writer was killed, or they were entered by hand.
    """
    cell = proposal.target.cell
    if cell is None or recorder.audit is None:
        return ""
    ledger = Ledger.of(cell, recorder.audit)
    if ledger is None:
        return ""
    request = proposal.request
    digest = sha256(request.signed)
    try:
        enter_calibration(
            ledger, request.calibration, digest=digest, who=recorder.who, at=recorder.at
        )
        if proposal.edit.has_effect:
            return ""
        # Nothing had to be written: an entry says that the target has these gains all the same.
        in_force = read_history(ledger).in_force(recorder.subject)
        if in_force != digest:
            details = {
                "action": WriteAction.APPLIED.value,
                "begun": None,
                "calibration": {"sha256": digest, "cell": ledger.cell.name},
                "sha256_after": sha256(proposal.edit.after),
            }
            recorder.begin(AuditAction.WRITE_FOUND, details)
    except Exception as error:  # noqa: BLE001 - the target has these gains: no error of the history may call that undone
        _LOG.warning(
            "the history may lack this write: %s; `drivegain history CELL --add CALIBRATION` "
            "enters it",
            evidence(error),
        )
        return evidence(error)
    return ""


_IN_PLACE = "{} has the new content, complete; the history lacks this write"


def _error_after_replacement(edit: Edit, error: OSError, *, is_made: bool) -> OutputFailed:
    """Return the error for a write after which the content is the new one, or is not known."""
    if is_made:
        when = "after"
        advice = (
            f"{_IN_PLACE.format(edit.subject)}: `drivegain history CELL --add CALIBRATION` enters "
            "it, `drivegain rollback CELL` undoes it"
        )
    else:
        when = "during"
        advice = (
            f"whether {edit.subject} has the new content is not known: compare it with the newest "
            "backup next to it"
        )
    return OutputFailed(
        edit.subject,
        found=f"{reason_of(error)}, {when} the replacement",
        expected="a file system that completes what it began",
        remedy=f"check the disk; {advice}",
    )


@dataclass(frozen=True, slots=True)
class _Recorder:
    """Record one write to a controller: that it begins, before anything is replaced,
    and how it ended.
    """

    audit: Path | None  #: file of the audit log; None records nothing
    who: str  #: the person or the job
    at: datetime  #: time with its zone
    subject: str  #: the file, with symbolic links followed, or the drives

    def begin(self, action: AuditAction, details: Mapping[str, object]) -> AuditEntry | None:
        """Append an entry; where that fails, nothing may be written.

        Returns:
            The entry; None where nothing is recorded.

        Raises:
            OutputFailed, AuditUnusable: the audit log takes no entry.
        """
        if self.audit is None:
            return None
        try:
            return record_write(
                self.audit, action, at=self.at, who=self.who, subject=self.subject, details=details
            )
        except OSError as error:
            raise OutputFailed(
                str(self.audit),
                found=reason_of(error),
                expected="an audit log that takes an entry",
                remedy="nothing was written to the controller; free space or rights",
            ) from error

    def end(self, action: AuditAction, details: Mapping[str, object]) -> AuditEntry | None:
        """Append the last entry about the write; a failure is a warning, and returns None."""
        try:
            return self.begin(action, details)
        except (OutputFailed, AuditUnusable) as error:
            # The write is done, and the first entry has its digests: no reason to call it undone.
            # The line may be there all the same: a flush that failed says nothing about what the
            # disk has.
            _LOG.warning(
                "the audit log may lack the entry that it is %s: %s", action.value, evidence(error)
            )
            return None

    @contextlib.contextmanager
    def refusals(self, details: Mapping[str, object]) -> Iterator[None]:
        """Record a refusal that is raised within the context."""
        try:
            yield
        except CalibrationRefused as error:
            refusal = {"gate": "file", "subject": error.subject, "found": error.found}
            self.end(AuditAction.REFUSED, {"refusals": [refusal], **details})
            raise
