"""Compare a calibration with the current gains, and write it where the operator approves."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from typing import Any

from daq.documents.calibration_file import read_calibration_bytes
from daq.documents.session_state import Decision, JudgedGain, Outcome, PlannedWrite, finite
from daq.errors import writing
from daq.files import replace_file, sha256, sha256_of
from daq.jobs.context import SessionContext
from daq.jobs.journal import Level
from daq.jobs.session import CALIBRATION, Session
from daq.ledger.audit import AuditAction
from daq.ledger.audit import read as read_audit
from daq.ledger.fold import History
from daq.ledger.ledger import record_session
from daq.report.document import json_text
from daq.report.job_schemas import FailedCheck, ProposalReport, ProposedGain
from daq.writeback.gates.gate import Gate
from daq.writeback.judgement import HistoryFigures, figures_of_history, judge
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Written
from ident.calibration import Calibration

CHANGED_SINCE_START = (
    "The controller's file was written or rolled back since the session began: an operator decides."
)
PROPOSAL = "proposal.json"
DIFF = "proposal.diff"


def decide_outcome(
    context: SessionContext, session: Session, calibration: Calibration, history: History
) -> Session:
    """Compare a calibration with the current gains, and act on it;
    the outcome is in the returned state.

    Raises:
        CalibrationRefused: a check failed; the controller's file is unchanged, and the session is
            over.
        AuditUnusable, OutputFailed: see `daq.writeback.target`.
    """
    now = context.tools.now()
    digest = sha256_of(session.folder / CALIBRATION) or ""
    before = session.state.target
    touched = _written_since(context, session)
    if before is not None and _has_written(context, before, calibration):
        if touched or not context.target.in_drives:
            # The job was killed right after its write: the history has it by now, and it is never
            # repeated.
            words = (
                "the controller has these gains already: an earlier job of this session wrote them"
            )
            context.journal.say(Level.NOTICE, words)
            return session.update(outcome=Outcome.APPLIED)
        return _saved_again(context, session, calibration)
    proposal = _proposed(context, session, calibration, now)
    edit = proposal.edit
    decision = decision_of(
        proposal, figures_of_history(history, context.target.subject, digest, edit.changes)
    )
    differs = any(gain.differs for gain in decision.gains)
    if differs and touched:
        decision = decision.model_copy(
            update={"remark": f"{decision.remark} {CHANGED_SINCE_START}"}
        )
    context.journal.say(
        Level.NOTICE,
        "compared with the gains in the controller",
        words=decision.remark,
        differs=differs,
    )
    after = sha256(edit.after)
    unsigned = any(refusal.gate is Gate.SIGNATURE for refusal in proposal.refusals)
    target = PlannedWrite(
        file=str(edit.name),
        base_sha256=edit.base_sha256,
        after_sha256=after,
        looked_at=edit.base,
        unsigned=unsigned,
        in_drives=context.target.in_drives,
    )
    _write_proposal(session, proposal, after)
    # Before anything is written: after a kill, the digest of the file shows whether it was.
    session = session.update(decision=decision, target=target)
    closed = [refusal for refusal in proposal.refusals if refusal.gate is not Gate.SIGNATURE]
    if closed:
        for refusal in closed:
            context.journal.say(
                Level.ERROR, "a check failed", gate=refusal.gate.value, text=str(refusal)
            )
        session.update(outcome=Outcome.REFUSED)
        _apply(context, proposal, now)  # which refuses it, and writes that down
    if not edit.has_effect or not differs:
        return session.update(outcome=Outcome.UNCHANGED)
    if proposal.refusals or not context.operator.approve(proposal, touched=touched):
        details = {
            "session": session.state.session,
            "calibration_sha256": digest,
            "sha256_before": target.base_sha256,
            "sha256_after": after,
        }
        record_session(
            context.target.history.audit,
            AuditAction.PROPOSED,
            at=context.tools.now(),
            who=context.who,
            subject=context.target.subject,
            details=details,
        )
        context.journal.say(
            Level.NOTICE, "proposed: an operator has to apply it", folder=str(session.folder)
        )
        return session.update(outcome=Outcome.PROPOSED)
    return _written(context, session, proposal, now)


def _written(
    context: SessionContext, session: Session, proposal: Proposal[Any], now: datetime
) -> Session:
    """Write a change that the operator has approved."""
    written = _apply(context, proposal, now)
    if written is not None:
        subject = proposal.edit.subject
        context.journal.say(
            Level.NOTICE,
            "written to the controller's file",
            file=subject,
            backup=str(written.backup),
        )
        if written.not_in_history:
            words = (
                "the history may lack this write; the next job, apply or history --add enters it"
            )
            context.journal.say(Level.WARNING, words, text=written.not_in_history)
    return session.update(outcome=Outcome.APPLIED)


def _has_written(context: SessionContext, before: PlannedWrite, calibration: Calibration) -> bool:
    """Whether an earlier job of this session has put its content in place."""
    if before.base_sha256 == before.after_sha256:
        return False
    return context.content_sha256(calibration) == before.after_sha256


def _saved_again(context: SessionContext, session: Session, calibration: Calibration) -> Session:
    """Let drives save what a killed job wrote:
    without its last entry in the audit log, they may not have saved.
    """
    now = context.tools.now()
    proposal = _proposed(context, session, calibration, now)
    context.journal.say(Level.NOTICE, "the drives have these gains, and may not have saved them")
    if proposal.refusals or not context.operator.approve(proposal, touched=False):
        return session.update(outcome=Outcome.PROPOSED)
    return _written(context, session, proposal, now)


def _proposed(
    context: SessionContext, session: Session, calibration: Calibration, now: datetime
) -> Proposal[Any]:
    path = session.folder / CALIBRATION
    request = Request(calibration, now, file=path, content=read_calibration_bytes(path))
    with context.opened_target() as target:
        return context.tools.propose(target, request)


def _apply(context: SessionContext, proposal: Proposal[Any], now: datetime) -> Written | None:
    """Write what was proposed.

    The bus is not kept open while the operator looks at the change. What is in the drives is read
    again, and another change than the one that was looked at is refused.
    """
    audit = context.target.history.audit
    with writing(proposal.edit.place):
        if proposal.refusals or not context.target.in_drives:
            return context.tools.apply(proposal, now, audit=audit, who=context.who)
        with context.opened_target() as target:
            request = replace(proposal.request, base=proposal.edit.base)
            again = context.tools.propose(target, request)
            return context.tools.apply(again, now, audit=audit, who=context.who)


def decision_of(proposal: Proposal[Any], known: HistoryFigures) -> Decision:
    """Judge which gains differ significantly from the current ones (`daq.writeback.judgement`),
    each among all axes.
    """
    judged, words = judge(proposal.edit.changes, known)
    gains = []
    for change in proposal.edit.changes:
        if change.axis not in judged:
            continue
        drift = judged[change.axis]
        gain = JudgedGain(
            axis=change.axis,
            unit=change.unit,
            old=change.current_gain,
            new=change.new,
            old_std=known.stds[change.axis],
            new_std=change.std,
            change_percent=finite(drift.percent),
            drift_sigma=finite(drift.sigmas),
            differs=drift.significant,
        )
        gains.append(gain)
    return Decision(gains=tuple(gains), remark=words)


def _written_since(context: SessionContext, session: Session) -> bool:
    """Whether the audit has a write or a rollback of the controller's file since the session began.

    An earlier job may have been killed right after its write, and an operator may have undone that
    since. The file is then as it was before, and the job must not repeat the write.
    """
    entries = read_audit(context.target.history.audit)
    begun = 0
    for index, entry in enumerate(entries):
        if entry.action is AuditAction.RECALIBRATION_BEGUN and entry.subject == str(session.folder):
            begun = index
            break
    file = context.target.subject
    ends = (AuditAction.APPLIED, AuditAction.ROLLED_BACK)
    # Without the entry of the begin, the older part of the audit was moved away: all entries are
    # later.
    return any(entry.action in ends and entry.subject == file for entry in entries[begun:])


def _write_proposal(session: Session, proposal: Proposal[Any], after_sha256: str) -> None:
    """Write the change next to the calibration, as JSON and as a diff."""
    changes = [ProposedGain.of(change, old=change.current_gain) for change in proposal.edit.changes]
    refusals = [
        FailedCheck(gate=refusal.gate.value, text=str(refusal)) for refusal in proposal.refusals
    ]
    report = ProposalReport(
        file=str(proposal.edit.name),
        base_sha256=proposal.edit.base_sha256,
        after_sha256=after_sha256,
        changes=changes,
        refusals=refusals,
    )
    contents = {PROPOSAL: json_text(report), DIFF: proposal.edit.diff}
    for name, content in contents.items():
        path = session.folder / name
        with writing(path):
            replace_file(path, content.encode())
