"""Decide about a calibration: keep the gains in the controller, propose new ones to an operator, or write them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from daq.config.policy import AppliedBy
from daq.errors import DaqError, OutputFailed
from daq.files import replace_file, sha256, sha256_of
from daq.jobs.context import JobContext
from daq.jobs.journal import Level
from daq.jobs.session import CALIBRATION, Decision, JudgedGain, Outcome, Session, Target, WatchedGain
from daq.ledger.audit import AuditAction, append
from daq.ledger.audit import read as read_audit
from daq.ledger.judgement import Known, judge, known_of
from daq.ledger.ledger import Ledger
from daq.ledger.watch import alarm_text, watch
from daq.workflow.calibration_file import read
from daq.writeback.file_access import resolve_links
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates.gate import Gate
from daq.writeback.request import GainChange, Request
from daq.writeback.target import Proposal, Written
from ident.calibration import Calibration
from ident.drift.change import FALSE_ALARM


@dataclass(slots=True)
class GainHistory:
    """History of a cell while a job uses it."""

    ledger: Ledger  #: open
    controller: Path  #: file whose gains are in force
    now: Callable[[], datetime]  #: wall clock
    digest: str = ""  #: of the session's calibration, once it is entered

    @property
    def target(self) -> str:
        """Name of the controller's file in the history."""
        return str(resolve_links(self.controller))

    def enter(self, calibration: Calibration, path: Path) -> None:
        """Enter the session's calibration; once, however often the session is resumed.

        Raises:
            DataError, HistoryUnreadable, OutputFailed: see `daq.ledger.store`.
        """
        self.digest = sha256_of(path) or ""
        self.ledger.add(calibration, digest=self.digest, at=self.now())

    def note_applied(self, sha256_after: str) -> None:
        """Enter, once, that the controller's file has this session's gains and this SHA-256. Raises as `enter`."""
        self.ledger.record_applied(self.digest, at=self.now(), target=self.target, sha256_after=sha256_after)

    def watched(self) -> tuple[WatchedGain, ...]:
        """Alarms of the drift charts, in the order of the axes. Raises as `enter`."""
        series = watch(self.ledger.entries(), self.ledger.acknowledgements())
        return tuple(WatchedGain(axis=one.axis, alarm=alarm_text(one) or "") for one in series)

    def known(self, changes: Sequence[GainChange]) -> Known:
        """Evidence by which the changes of the gains are judged. Raises as `enter`."""
        return known_of(self.ledger, self.target, self.digest, changes)


CHANGED_SINCE_START = "The controller's file was written or rolled back since the session began: an operator decides."
PROPOSAL, DIFF = "proposal.json", "proposal.diff"


def decide_outcome(
    context: JobContext, session: Session, calibration: Calibration, gain_history: GainHistory
) -> Session:
    """Compare a calibration with the gains in the controller, and act on it; the outcome is in the returned state.

    Raises:
        CalibrationRefused: a check failed; the controller's file is unchanged, and the session is over.
        AuditUnusable, OutputFailed: see `daq.writeback.target`.
    """
    session = _written_before(context, session, gain_history)
    if session.state.outcome is not None:
        return session
    path, now = session.folder / CALIBRATION, context.tools.now()
    request = Request(calibration, now, file=path, content=read(path))
    proposal = context.tools.propose(FileTarget.of(context.cell), request)
    edit = proposal.edit
    decision = decision_of(proposal, gain_history)
    differs, touched = any(gain.differs for gain in decision.gains), _written_since(context, session)
    if differs and touched:
        decision = decision.model_copy(update={"remark": f"{decision.remark} {CHANGED_SINCE_START}"})
    context.journal.say(Level.NOTICE, "compared with the gains in the controller", words=decision.remark)
    after = sha256(edit.after)
    target = Target(
        file=str(edit.file),
        base_sha256=edit.base_sha256,
        after_sha256=after,
        looked_at=edit.base,
        unsigned=any(refusal.gate is Gate.SIGNATURE for refusal in proposal.refusals),
    )
    _write_proposal(session, proposal, after)
    # Before anything is written: after a kill, the digest of the file shows whether it was.
    session = session.update(decision=decision, target=target)
    closed = [refusal for refusal in proposal.refusals if refusal.gate is not Gate.SIGNATURE]
    if closed:
        for refusal in closed:
            context.journal.say(Level.ERROR, "a check failed", gate=refusal.gate.value, text=str(refusal))
        session.update(outcome=Outcome.REFUSED)
        _apply(context, proposal, now)  # which refuses it, and writes that down
    if not edit.has_effect or not differs:
        return session.update(outcome=Outcome.UNCHANGED)
    if proposal.refusals or needs_person(context) or touched:
        _propose(context, session, target)
        return session.update(outcome=Outcome.PROPOSED)
    written = _apply(context, proposal, now)
    if written is not None:
        context.journal.say(
            Level.NOTICE, "written to the controller's file", file=edit.subject, backup=str(written.backup)
        )
    _note(context, gain_history, after)
    return session.update(outcome=Outcome.APPLIED)


def _apply(context: JobContext, proposal: Proposal[FileEdit], now: datetime) -> Written | None:
    try:
        return context.tools.apply(proposal, now, audit=context.target.history.audit, who=context.who)
    except OSError as error:
        raise OutputFailed.of(proposal.edit.file, error) from error


def _note(context: JobContext, gain_history: GainHistory, after_sha256: str) -> None:
    """Enter the write in the history; the controller has its gains already, so a failure is only reported."""
    try:
        gain_history.note_applied(after_sha256)
    except DaqError as error:
        context.journal.say(Level.WARNING, "the history does not know of this write", text=str(error))


def needs_person(context: JobContext) -> bool:
    """Whether an operator applies the gains: by the cell's policy, and whenever drives are written."""
    return context.cell.apply.by is AppliedBy.PERSON or bool(context.target.controller.objects)


def decision_of(proposal: Proposal[FileEdit], gain_history: GainHistory) -> Decision:
    """Judge which gains differ significantly from the controller's (`daq.ledger.judgement`), each among all axes."""
    known = gain_history.known(proposal.edit.changes)
    found = judge(proposal.edit.changes, known)
    changes = {change.axis: change for change in proposal.edit.changes}
    gains = tuple(
        JudgedGain(
            axis=axis,
            unit=changes[axis].unit,
            old=changes[axis].old,
            old_std=known.stds[axis],
            new=changes[axis].new,
            new_std=changes[axis].std,
            change_percent=_finite(drift.percent),
            drift_sigma=_finite(drift.sigmas),
            differs=probability <= FALSE_ALARM,
        )
        for axis, drift, probability in zip(found.axes, found.changes, found.adjusted, strict=True)
    )
    return Decision(gains=gains, remark=found.words)


def _written_before(context: JobContext, session: Session, gain_history: GainHistory) -> Session:
    """Recognise a write whose job was killed right after it: it is entered, and never repeated."""
    target = session.state.target
    if target is None or target.base_sha256 == target.after_sha256:
        return session
    if sha256_of(Path(target.file)) != target.after_sha256:
        return session
    context.journal.say(
        Level.NOTICE, "the controller's file has these gains already: an earlier job of this session wrote it"
    )
    _note(context, gain_history, target.after_sha256)
    return session.update(outcome=Outcome.APPLIED)


def _written_since(context: JobContext, session: Session) -> bool:
    """Whether the audit has a write or a rollback of the controller's file since the session began.

    An earlier job may have been killed right after its write, and an operator may have undone that since. The file is
    then as it was before, and the job must not repeat the write.
    """
    entries = read_audit(context.target.history.audit)
    begun = [
        index
        for index, entry in enumerate(entries)
        if entry.action is AuditAction.RECALIBRATION_BEGUN and entry.subject == str(session.folder)
    ]
    file = str(resolve_links(context.target.file))
    ends = (AuditAction.APPLIED, AuditAction.ROLLED_BACK)
    # Without the entry of the begin, the older part of the audit was moved away: all entries are later.
    return any(entry.action in ends and entry.subject == file for entry in entries[begun[0] if begun else 0 :])


def _propose(context: JobContext, session: Session, target: Target) -> None:
    append(
        context.target.history.audit,
        AuditAction.PROPOSED,
        at=context.tools.now(),
        who=context.who,
        subject=str(resolve_links(context.target.file)),
        details={
            "session": session.state.session,
            "calibration_sha256": sha256_of(session.folder / CALIBRATION) or "",
            "sha256_before": target.base_sha256,
            "sha256_after": target.after_sha256,
        },
    )
    context.journal.say(Level.NOTICE, "proposed: an operator has to apply it", folder=str(session.folder))


def _write_proposal(session: Session, proposal: Proposal[FileEdit], after_sha256: str) -> None:
    """Write the change beside the calibration, as JSON and as a diff."""
    document = {
        "file": str(proposal.edit.file),
        "base_sha256": proposal.edit.base_sha256,
        "after_sha256": after_sha256,
        "changes": [
            {
                "axis": change.axis,
                "key": change.key,
                "old": _finite(change.old),
                "new": _finite(change.new),
                "std": _finite(change.std),
                "unit": change.unit,
                "change_percent": _finite(change.change_percent),
            }
            for change in proposal.edit.changes
        ],
        "refusals": [{"gate": refusal.gate.value, "text": str(refusal)} for refusal in proposal.refusals],
    }
    try:
        replace_file(session.folder / PROPOSAL, (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode())
        replace_file(session.folder / DIFF, proposal.edit.diff.encode())
    except OSError as error:
        raise OutputFailed.of(session.folder / PROPOSAL, error) from error


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
