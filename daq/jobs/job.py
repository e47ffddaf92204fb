"""The job: preflight, record, fit, decide, propose or apply, report; taken up where an earlier one was ended."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from daq.config.cell import Cell
from daq.config.recalibration import Recalibration
from daq.errors import AuditUnusable, DaqError, ExitCode, HistoryUnreadable, OutputFailed, exit_code
from daq.files import replace_file
from daq.jobs import session as sessions
from daq.jobs.conclusion import SUMMARY_JSON, SUMMARY_TEXT, Conclusion, document, text
from daq.jobs.interlock import time_bound
from daq.jobs.journal import Figures, Journal, Level, write_metrics
from daq.jobs.preflight import before_motion, due_in, require_clock, section_of, target_of
from daq.jobs.recording import (
    GainTarget,
    JobContext,
    basis_of,
    calibration_of_session,
    fit_session,
    record_runs,
    verified_runs,
)
from daq.jobs.session import Outcome, Session, SessionState
from daq.jobs.tools import Tools
from daq.jobs.verdict import GainHistory, decide_outcome
from daq.ledger.audit import AuditAction, AuditEntry, append
from daq.ledger.judgement import digests_in_force
from daq.ledger.store import HistoryStore
from daq.workflow.safeguards import bus_lock
from drivers.canopen.network import SignalBlocker
from drivers.errors import WHILE

# The end of a job, told wherever somebody may look: audit, state, summary, metrics, journal.


CODES = {Outcome.PROPOSED: ExitCode.PROPOSED}
"""Of ends that are no errors; the others are OK."""


@dataclass(frozen=True, slots=True)
class JobReporter:
    """Says how a job has ended, wherever somebody may look.

    Attributes:
        cell_file, cell, section, target: of the cell.
        tools, journal, who: of the job.
        began_s: monotonic time of its begin [s].
    """

    cell_file: Path
    cell: Cell
    section: Recalibration
    target: GainTarget
    tools: Tools
    journal: Journal
    who: str
    began_s: float

    def succeeded(self, session: Session) -> Conclusion:
        """Of a session whose state has its outcome.

        Raises:
            OutputFailed, AuditUnusable: something could not be written; all else was.
        """
        outcome = session.state.outcome or Outcome.STOPPED
        remark = "" if session.state.decision is None else session.state.decision.remark
        return self._report(session, outcome, CODES.get(outcome, ExitCode.OK), remark, "")

    def failed(self, folder: Path, error: BaseException) -> None:
        """What fails while this is told is noted on the error, which goes on its way."""
        try:
            session = next(one for one in sessions.sessions(folder.parent) if one.folder == folder)
            interrupted = isinstance(error, KeyboardInterrupt)
            outcome = session.state.outcome or (Outcome.INTERRUPTED if interrupted else Outcome.STOPPED)
            code = ExitCode.INTERRUPTED if interrupted else exit_code(type(error)) or ExitCode.UNEXPECTED
            problem = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            notes = [note for note in getattr(error, "__notes__", ()) if note.startswith(WHILE)]
            self._report(session, outcome, code, "; ".join((problem, *notes)), problem)
        except (DaqError, OSError, StopIteration) as second:
            error.add_note(f"kept: the session's end could not be written down: {second}")

    def audit(self, action: AuditAction, session: Session, details: dict[str, object]) -> AuditEntry:
        """Add an entry about the session.

        Raises:
            AuditUnusable, OutputFailed: it could not be written.
        """
        try:
            return append(
                self.target.history.audit,
                action,
                at=self.tools.now(),
                who=self.who,
                subject=str(session.folder),
                details={"session": session.state.session, "cell": self.cell.name, **details},
            )
        except OSError as error:
            raise OutputFailed.of(self.target.history.audit, error) from error

    def _report(self, session: Session, outcome: Outcome, code: int, remark: str, problem: str) -> Conclusion:
        now = self.tools.now()
        state = session.state.with_(
            outcome=outcome, exit_code=int(code), problem=problem, ended=now.isoformat(timespec="seconds")
        )
        unwritten: DaqError | None = None
        try:
            details = _end_details(state)
            entry = self.audit(AuditAction.RECALIBRATION_ENDED, session, details)
            # Noted here too: a chain cannot tell by itself that its last lines are missing.
            state = state.with_(audit_sha256=entry.sha256)
        except (AuditUnusable, OutputFailed) as error:
            self.journal.say(Level.ERROR, "the audit could not be written", text=str(error))
            unwritten = error
        session = sessions.save(replace(session, state=state))
        conclusion = Conclusion(outcome, int(code), session, remark)
        level = Level.NOTICE if outcome.good else Level.ERROR
        self.journal.say(level, "session ended", outcome=outcome.value, exit_code=int(code), remark=remark)
        self._write_summary(conclusion)
        self._write_metrics(conclusion, now)
        self._remove_old()
        if unwritten is not None:
            raise unwritten
        return conclusion

    def _remove_old(self) -> None:
        try:
            with HistoryStore(self.target.history.store) as store:
                in_force = digests_in_force(store.events())
        except HistoryUnreadable as error:
            # What a controller rests on is not known: nothing of it may go.
            self.journal.say(Level.WARNING, "no old session removed", text=str(error))
            return
        found = sessions.sessions(self.section.folder, self.cell.name)
        for folder in sessions.remove_old(found, self.section.keep_sessions, in_force):
            self.journal.say(Level.INFO, "old session removed", folder=str(folder))

    def _write_summary(self, conclusion: Conclusion) -> None:
        if conclusion.session is None:
            return
        folder = conclusion.session.folder
        try:
            replace_file(folder / SUMMARY_TEXT, text(conclusion, self.cell_file).encode())
            replace_file(
                folder / SUMMARY_JSON,
                (json.dumps(document(conclusion, self.cell_file), indent=2, ensure_ascii=False) + "\n").encode(),
            )
        except OSError as error:
            raise OutputFailed.of(folder, error) from error

    def _write_metrics(self, conclusion: Conclusion, now: datetime) -> None:
        if self.section.metrics is None:
            return
        good = sessions.last_good(sessions.sessions(self.section.folder, self.cell.name))
        shown = conclusion.session
        calibration = None if shown is None else calibration_of_session(shown)
        if calibration is None and good is not None:
            shown, calibration = good, calibration_of_session(good)
        figures = Figures(
            cell=self.cell.name,
            outcome=conclusion.outcome,
            exit_code=conclusion.exit_code,
            ended=now,
            duration_s=self.tools.monotonic_s() - self.began_s,
            last_good=None if good is None else good.began,
            state=None if shown is None else shown.state,
            calibration=calibration,
        )
        try:
            write_metrics(figures, self.section.metrics)
        except OutputFailed as error:
            # A monitor that sees nothing says so itself; the calibration is done.
            self.journal.say(Level.ERROR, "metrics could not be written", text=str(error))


def _end_details(state: SessionState) -> dict[str, object]:
    return {
        "outcome": None if state.outcome is None else state.outcome.value,
        "exit_code": state.exit_code,
        "problem": state.problem,
        "logs": {run.name: run.sha256 for run in state.runs},
        "calibration_sha256": None if state.fitted is None else state.fitted.calibration_sha256,
    }


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
    """Do the cell's scheduled recalibration, or what an earlier job has left of it.

    Args:
        cell_file: of the cell.
        cell: what it says.
        tools: the functions of other rooms.
        journal: is told everything.
        who: the job, by a name that a person recognises.
        undisturbed: keeps signals from the stop of the axes.
        lock_folder: of the bus's lock, see `daq.workflow.safeguards`.

    Raises:
        JobHeld, MotionRefused, ConfigurationError: nothing has moved; or as the next line, in a session.
        DaqError, DriverError, IdentificationError: whatever ended the session; the axes were stopped, the controller's
            file stands as it was, and audit, state, metrics and summary tell of it.
    """
    section, target = section_of(cell), target_of(cell)
    if (early := _not_due(section, cell, tools.now())) is not None:
        journal.say(Level.INFO, "not due", remark=early.remark)
        return early
    with bus_lock(cell, lock_folder):
        # Another job may have ended between the question and the lock.
        if (early := _not_due(section, cell, tools.now())) is not None:
            return early
        began_s = tools.monotonic_s()
        session = _resumed_or_new(section, cell, tools.now(), journal)
        journal = journal.within(session=session.state.session)
        reporter = JobReporter(cell_file, cell, section, target, tools, journal, who, began_s)
        try:
            reporter.audit(AuditAction.RECALIBRATION_BEGUN, session, {"attempt": session.state.attempt})
            with time_bound(section.max_duration_min) as in_time:
                context = JobContext(cell_file, cell, section, target, tools, who, _both(block_signals, in_time))
                session = _go(context, session, journal)
        except BaseException as error:
            reporter.failed(session.folder, error)
            raise
        return reporter.succeeded(session)


@dataclass(frozen=True, slots=True)
class Preview:
    """What a job would do now.

    Attributes:
        steps: in words, in order; none where nothing is due.
        remark: why there are none, or which session is taken up.
    """

    steps: tuple[str, ...]
    remark: str


def preview(
    cell_file: Path, cell: Cell, tools: Tools, journal: Journal, *, who: str, lock_folder: Path | None = None
) -> Preview:
    """Ask all that a job asks before it moves anything, and say what it would do; nothing is written.

    Raises:
        As `recalibrate`, up to the first motion.
    """
    section, target = section_of(cell), target_of(cell)
    now = tools.now()
    if (early := _not_due(section, cell, now)) is not None:
        return Preview((), early.remark)
    with bus_lock(cell, lock_folder):
        found = sessions.sessions(section.folder, cell.name)
        session = sessions.resumable_session(found, basis_of(cell, section), now, section.resume_within_h)
        made = () if session is None else tuple(run.name for run in verified_runs(session).state.runs)
        left = [run for run in section.runs if run.name not in made]
        if left:
            folder = _nearest(section.folder)
            there = replace(tools, free=lambda _: tools.free(folder))
            before_motion(JobContext(cell_file, cell, section, target, there, who, nullcontext), journal)
    steps = [f"warm up for {section.warm_up_min:g} min"] if left and section.warm_up_min else []
    steps += [f"mount {run.payload or 'none'}, record {run.name}" for run in left]
    if session is None or calibration_of_session(session) is None:
        steps += ["fit and close the loop"]
    steps += ["compare with the controller's gains", f"apply by {cell.apply.by.value}", "report"]
    taken = "a new session" if session is None else f"session {session.state.session} is taken up"
    return Preview(tuple(steps), taken)


def _go(context: JobContext, session: Session, journal: Journal) -> Session:
    if len(verified_runs(session).state.runs) < len(context.section.runs):
        before_motion(context, journal.within(step="preflight"))
        session = record_runs(context, session, journal)
    session, calibration = fit_session(context, session, journal.within(step="fit"))
    with GainHistory(
        context.cell, context.target.history, context.target.file, context.tools.now, context.who
    ) as gain_history:
        gain_history.enter(calibration, session.folder / sessions.CALIBRATION)
        session = sessions.save(replace(session, state=session.state.with_(watched=gain_history.watched())))
        for gain in session.state.watched:
            if gain.alarm:
                # Slices of a slow drift may each be small enough to be written without anybody.
                journal.within(step="watch").say(Level.WARNING, "drift", axis=gain.axis, text=gain.alarm)
        return decide_outcome(context, session, calibration, gain_history, journal.within(step="decide"))


def _not_due(section: Recalibration, cell: Cell, now: datetime) -> Conclusion | None:
    """Also the place where a clock that went back is noticed: every age hangs on it."""
    found = sessions.sessions(section.folder, cell.name)
    require_clock(found, now)
    left = due_in(found, section.every_h, now)
    good = sessions.last_good(found)
    if left <= timedelta(0) or good is None:
        return None
    hours = left.total_seconds() / 3600.0
    remark = f"The calibration of session {good.state.session} is good for another {hours:.1f} h (every_h)."
    return Conclusion(Outcome.NOT_DUE, ExitCode.OK, None, remark)


def _resumed_or_new(section: Recalibration, cell: Cell, now: datetime, journal: Journal) -> Session:
    found, basis = sessions.sessions(section.folder, cell.name), basis_of(cell, section)
    session = sessions.resumable_session(found, basis, now, section.resume_within_h)
    if session is None:
        session = sessions.begin(section.folder, basis, now)
        journal.within(session=session.state.session).say(Level.INFO, "session begun", folder=str(session.folder))
        return session
    state = session.state.with_(
        attempt=session.state.attempt + 1,
        attempt_began=now.isoformat(timespec="seconds"),
        outcome=None,
        exit_code=None,
        problem="",
        ended=None,
    )
    journal.within(session=state.session).say(Level.NOTICE, "session taken up", attempt=state.attempt)
    return sessions.save(replace(session, state=state))


def _both(one: SignalBlocker, other: SignalBlocker) -> SignalBlocker:
    @contextmanager
    def both() -> Iterator[None]:
        with ExitStack() as stack:
            stack.enter_context(one())
            stack.enter_context(other())
            yield

    return both


def _nearest(folder: Path) -> Path:
    """The folder, or the nearest one above it that is there."""
    return next((path for path in (folder, *folder.parents) if path.is_dir()), folder)
