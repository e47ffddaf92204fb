"""A recalibration job: preflight, record, fit, decide, report; it resumes the session of a job that was ended."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import FrameType

from daq.config.cell import Cell
from daq.config.policy import AppliedBy
from daq.config.recalibration import Recalibration
from daq.documents.calibration_file import read_calibration_bytes
from daq.documents.session_state import Decision, JudgedGain, Outcome, PlannedWrite, WatchedGain
from daq.errors import ExitCode, TimeBoundReached, writing
from daq.files import replace_file, sha256, sha256_of
from daq.jobs import session as sessions
from daq.jobs.context import JobContext, Tools, before_motion, require_clock, section_of, target_of
from daq.jobs.journal import Journal, Level
from daq.jobs.recording import basis_of, calibration_of_session, fit_session, record_runs, verified_runs
from daq.jobs.reporting import Conclusion, audit_entry, report_failure, report_success
from daq.jobs.session import CALIBRATION, Session
from daq.ledger.audit import AuditAction
from daq.ledger.audit import read as read_audit
from daq.ledger.fold import History
from daq.ledger.ledger import MAY_LACK, enter_calibration, read_history, record_session
from daq.ledger.watch import alarm_text, watch
from daq.report.document import json_text
from daq.report.job_schemas import FailedCheck, ProposalReport, ProposedGain
from daq.workflow.bus_lock import bus_lock
from daq.writeback.file_access import resolve_links
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates.gate import Gate
from daq.writeback.judgement import Spread, judge, known_of
from daq.writeback.request import GainChange, Request
from daq.writeback.target import Proposal, Written
from drivers.canopen.network import SignalBlocker
from ident.calibration import Calibration


def recalibrate(
    cell_file: Path,
    cell: Cell,
    tools: Tools,
    journal: Journal,
    *,
    who: str,
    block_signals: SignalBlocker = nullcontext,
    lock_folder: Path | None = None,
) -> Conclusion:
    """Recalibrate a cell, or finish the session of an earlier job.

    Raises:
        JobHeld, MotionRefused, ConfigurationError: nothing has moved; in a session, as the next line.
        DaqError, DriverError, IdentificationError: the error that ended the session; the axes were stopped, the
            controller's file is unchanged, and audit, state, metrics and summary report it.
    """
    section = section_of(cell)
    target = target_of(cell)
    if (early := _not_due(section, cell, tools.now())) is not None:
        journal.say(Level.INFO, "not due", remark=early.remark)
        return early
    with bus_lock(cell, lock_folder):
        # Another job may have ended since.
        if (early := _not_due(section, cell, tools.now())) is not None:
            return early
        began_s = tools.monotonic_s()
        session = _resumed_or_new(section, cell, tools.now(), journal)
        journal = replace(journal, session=session.state.session)
        context = JobContext(cell_file, cell, section, target, tools, journal, who, began_s)
        try:
            audit_entry(context, AuditAction.RECALIBRATION_BEGUN, session, {"attempt": session.state.attempt})
            with time_bound(section.max_duration_min) as in_time:

                @contextmanager
                def block_both() -> Iterator[Callable[[], bool] | None]:
                    with block_signals() as asked_again, in_time():
                        yield asked_again

                session = _run(replace(context, block_signals=block_both), session)
        except BaseException as error:
            report_failure(context, session.folder, error)
            raise
        return report_success(context, session)


@dataclass(frozen=True, slots=True)
class Preview:
    """Steps that a job would take now."""

    steps: tuple[str, ...]  #: in words, in order; empty where nothing is due
    remark: str  #: why there are none, or which session is resumed


def preview(
    cell_file: Path, cell: Cell, tools: Tools, journal: Journal, *, who: str, lock_folder: Path | None = None
) -> Preview:
    """Make all checks of a job before its first motion, and list its steps; nothing is written.

    Raises:
        the errors of `recalibrate` up to the first motion.
    """
    section = section_of(cell)
    target = target_of(cell)
    now = tools.now()
    if (early := _not_due(section, cell, now)) is not None:
        return Preview((), early.remark)
    with bus_lock(cell, lock_folder):
        session = _open_session(section, cell, sessions.sessions(section.folder, cell.name), now)
        made = () if session is None else tuple(run.name for run in verified_runs(session).state.runs)
        left = [run for run in section.runs if run.name not in made]
        if left:
            folder = next((path for path in (section.folder, *section.folder.parents) if path.is_dir()), section.folder)
            there = replace(tools, free=lambda _: tools.free(folder))
            before_motion(JobContext(cell_file, cell, section, target, there, journal, who), take_over=False)
    steps = [f"warm up for {section.warm_up_min:g} min"] if left and section.warm_up_min else []
    steps += [f"mount {run.payload or 'none'}, record {run.name}" for run in left]
    if session is None or calibration_of_session(session) is None:
        steps += ["fit and close the loop"]
    steps += ["compare with the controller's gains", f"apply by {cell.apply.by.value}", "report"]
    taken = "a new session" if session is None else f"session {session.state.session} is taken up"
    return Preview(tuple(steps), taken)


def _run(context: JobContext, session: Session) -> Session:
    """Take the steps that the session lacks; returns it with its outcome."""
    if len(verified_runs(session).state.runs) < len(context.section.runs):
        before_motion(context.within("preflight"))
        session = record_runs(context, session)
    session, calibration = fit_session(context.within("fit"), session)
    digest = sha256_of(session.folder / sessions.CALIBRATION) or ""
    # Before the decision: what is only proposed is in the history, too. This also ends the write of a killed job.
    enter_calibration(context.ledger, calibration, digest=digest, who=context.who, at=context.tools.now())
    history = read_history(context.ledger)
    if history.may_lack:
        context.within("watch").journal.say(Level.WARNING, "history may be incomplete", text=MAY_LACK)
    series = watch(history.entries, history.acknowledgements)
    watched = tuple(WatchedGain(axis=one.axis, alarm=alarm_text(one) or "") for one in series)
    session = session.update(watched=watched)
    for gain in watched:
        if gain.alarm:
            # Each slice of a slow drift may be small enough to be written without an operator.
            context.within("watch").journal.say(Level.WARNING, "drift", axis=gain.axis, text=gain.alarm)
    return decide_outcome(context.within("decide"), session, calibration, history)


def _not_due(section: Recalibration, cell: Cell, now: datetime) -> Conclusion | None:
    """Conclude early where no calibration is due; also checks the clock, on which every age depends."""
    found = sessions.sessions(section.folder, cell.name)
    require_clock(found, now)
    good = sessions.last_good(found)
    left = timedelta(0) if good is None else good.began + timedelta(hours=section.every_h) - now
    if good is None or left <= timedelta(0):
        return None
    if _open_session(section, cell, found, now) is not None:  # begun with --now
        return None
    hours = left.total_seconds() / 3600.0
    remark = f"The calibration of session {good.state.session} is good for another {hours:.1f} h (every_h)."
    return Conclusion(Outcome.NOT_DUE, ExitCode.OK, None, remark)


def _open_session(section: Recalibration, cell: Cell, found: tuple[Session, ...], now: datetime) -> Session | None:
    """Session that a job would resume; plans are read only where one is unfinished."""
    if not found or found[-1].finished:
        return None
    return sessions.resumable_session(found, basis_of(cell, section), now, section.resume_within_h)


def _resumed_or_new(section: Recalibration, cell: Cell, now: datetime, journal: Journal) -> Session:
    session = _open_session(section, cell, sessions.sessions(section.folder, cell.name), now)
    if session is None:
        session = sessions.begin(section.folder, basis_of(cell, section), now)
        replace(journal, session=session.state.session).say(Level.INFO, "session begun", folder=str(session.folder))
        return session
    attempt = session.state.attempt + 1
    replace(journal, session=session.state.session).say(Level.NOTICE, "session taken up", attempt=attempt)
    return session.update(
        attempt=attempt,
        attempt_began=now.isoformat(timespec="seconds"),
        outcome=None,
        exit_code=None,
        problem="",
        ended=None,
    )


CHANGED_SINCE_START = "The controller's file was written or rolled back since the session began: an operator decides."
PROPOSAL = "proposal.json"
DIFF = "proposal.diff"


def decide_outcome(context: JobContext, session: Session, calibration: Calibration, history: History) -> Session:
    """Compare a calibration with the gains in the controller, and act on it; the outcome is in the returned state.

    Raises:
        CalibrationRefused: a check failed; the controller's file is unchanged, and the session is over.
        AuditUnusable, OutputFailed: see `daq.writeback.target`.
    """
    path = session.folder / CALIBRATION
    now = context.tools.now()
    digest = sha256_of(path) or ""
    before = session.state.target
    if before is not None and before.base_sha256 != before.after_sha256 == sha256_of(context.target.file):
        # The job was killed right after its write: the history has it by now, and it is never repeated.
        words = "the controller's file has these gains already: an earlier job of this session wrote it"
        context.journal.say(Level.NOTICE, words)
        return session.update(outcome=Outcome.APPLIED)
    request = Request(calibration, now, file=path, content=read_calibration_bytes(path))
    proposal = context.tools.propose(FileTarget.of(context.cell), request)
    edit = proposal.edit
    decision = decision_of(proposal, known_of(history, str(resolve_links(context.target.file)), digest, edit.changes))
    differs = any(gain.differs for gain in decision.gains)
    touched = _written_since(context, session)
    if differs and touched:
        decision = decision.model_copy(update={"remark": f"{decision.remark} {CHANGED_SINCE_START}"})
    context.journal.say(Level.NOTICE, "compared with the gains in the controller", words=decision.remark)
    after = sha256(edit.after)
    target = PlannedWrite(
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
    # An operator writes drives, whatever the policy says.
    needs_person = context.cell.apply.by is AppliedBy.PERSON or bool(context.target.controller.objects)
    if proposal.refusals or needs_person or touched:
        record_session(
            context.target.history.audit,
            AuditAction.PROPOSED,
            at=context.tools.now(),
            who=context.who,
            subject=str(resolve_links(context.target.file)),
            details={
                "session": session.state.session,
                "calibration_sha256": digest,
                "sha256_before": target.base_sha256,
                "sha256_after": after,
            },
        )
        context.journal.say(Level.NOTICE, "proposed: an operator has to apply it", folder=str(session.folder))
        return session.update(outcome=Outcome.PROPOSED)
    written = _apply(context, proposal, now)
    if written is not None:
        context.journal.say(
            Level.NOTICE, "written to the controller's file", file=edit.subject, backup=str(written.backup)
        )
        if written.not_in_history:
            words = "the history does not have this write; the next job, apply or history --add enters it"
            context.journal.say(Level.WARNING, words, text=written.not_in_history)
    return session.update(outcome=Outcome.APPLIED)


def _apply(context: JobContext, proposal: Proposal[FileEdit], now: datetime) -> Written | None:
    with writing(proposal.edit.file):
        return context.tools.apply(proposal, now, audit=context.target.history.audit, who=context.who)


def decision_of(proposal: Proposal[FileEdit], known: Spread) -> Decision:
    """Judge which gains differ significantly from the controller's (`daq.writeback.judgement`), each among all axes."""
    judged, words = judge(proposal.edit.changes, known)
    gains = tuple(
        JudgedGain(
            axis=change.axis,
            unit=change.unit,
            old=change.old,
            new=change.new,
            old_std=known.stds[change.axis],
            new_std=change.std,
            change_percent=_finite(judged[change.axis].percent),
            drift_sigma=_finite(judged[change.axis].sigmas),
            differs=judged[change.axis].significant,
        )
        for change in proposal.edit.changes
        if change.axis in judged
    )
    return Decision(gains=gains, remark=words)


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


def _write_proposal(session: Session, proposal: Proposal[FileEdit], after_sha256: str) -> None:
    """Write the change beside the calibration, as JSON and as a diff."""
    report = ProposalReport(
        file=str(proposal.edit.file),
        base_sha256=proposal.edit.base_sha256,
        after_sha256=after_sha256,
        changes=[_proposed_gain(change) for change in proposal.edit.changes],
        refusals=[FailedCheck(gate=refusal.gate.value, text=str(refusal)) for refusal in proposal.refusals],
    )
    with writing(session.folder / PROPOSAL):
        replace_file(session.folder / PROPOSAL, json_text(report).encode())
        replace_file(session.folder / DIFF, proposal.edit.diff.encode())


def _proposed_gain(change: GainChange) -> ProposedGain:
    return ProposedGain(
        axis=change.axis,
        key=change.key,
        old=change.old,
        new=change.new,
        std=change.std,
        unit=change.unit,
        change_percent=change.change_percent,
    )


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


AGAIN_S = 1.0  #: After an alarm that came while the axes were being stopped for another reason


@contextmanager
def time_bound(minutes: float) -> Iterator[SignalBlocker]:
    """Raise TimeBoundReached in the block when its time is up; yields a function that defers it during a stop.

    There is no alarm outside the main thread, where Python handles no signals.

    Raises:
        TimeBoundReached: in the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield nullcontext
        return
    stopping = 0

    def up(_number: int, _frame: FrameType | None) -> None:
        if stopping:
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
            return
        raise TimeBoundReached(
            "the job",
            found=f"more than {minutes:g} min since it began",
            expected="its end within max_duration_min",
            remedy="the axes were commanded to stop; the next job resumes the session; raise max_duration_min, or "
            "see what takes so long in its log",
        )

    @contextmanager
    def block_signals() -> Iterator[None]:
        nonlocal stopping
        stopping += 1
        try:
            yield
        finally:
            stopping -= 1

    before = signal.signal(signal.SIGALRM, up)
    signal.setitimer(signal.ITIMER_REAL, 60.0 * minutes)
    try:
        yield block_signals
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
