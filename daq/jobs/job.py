"""A recalibration job: preflight, record, fit, decide, report;
it resumes the session of a job that was ended.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import FrameType

from daq.config.cell import Cell
from daq.config.recalibration import Recalibration
from daq.documents.session_state import Outcome
from daq.errors import ExitCode, TimeBoundReached
from daq.jobs import session as sessions
from daq.jobs.context import (
    SessionContext,
    Tools,
    before_motion,
    nearest_existing_folder,
    require_writable,
    section_of,
    sessions_that_count,
)
from daq.jobs.gain_target import file_of
from daq.jobs.journal import Journal, Level
from daq.jobs.operator import CellPolicy
from daq.jobs.recording import FixedRuns, basis_of, calibration_of_session, verified_runs
from daq.jobs.reporting import Conclusion, audit_entry, report_failure, report_success
from daq.jobs.session import Session
from daq.jobs.stages import OF_JOB, run_stages
from daq.ledger.audit import AuditAction
from daq.workflow.bus_lock import bus_lock
from drivers.canopen.network import SignalBlocker


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
        JobHeld, MotionRefused, ConfigurationError: nothing has moved; in a session, as the next
            line.
        DaqError, DriverError, IdentificationError: the error that ended the session; the axes were
            stopped, the controller's file is unchanged, and audit, state, metrics and summary
            report it.
    """
    section = section_of(cell)
    context = _context(cell_file, cell, tools, journal, who)
    now = tools.now()
    early = _not_due(section, cell, _counted(section, cell, now, journal), now)
    if early is not None:
        journal.say(Level.INFO, "not due", remark=early.remark)
        return early
    with bus_lock(cell, lock_folder):
        # Another job may have ended since.
        now = tools.now()
        found = sessions.begun_until(sessions.sessions(section.folder, cell.name), now)
        early = _not_due(section, cell, found, now)
        if early is not None:
            return early
        session = _resumed_or_new(section, cell, found, now, journal)
        journal = replace(journal, session=session.state.session)
        context = replace(context, journal=journal, began_s=tools.monotonic_s())
        try:
            audit_entry(
                context,
                AuditAction.RECALIBRATION_BEGUN,
                session,
                {"attempt": session.state.attempt},
            )
            with time_bound(section.max_duration_min) as in_time:

                @contextmanager
                def block_both() -> Iterator[Callable[[], bool] | None]:
                    with block_signals() as asked_again, in_time():
                        yield asked_again

                session = run_stages(OF_JOB, replace(context, block_signals=block_both), session)
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
    cell_file: Path,
    cell: Cell,
    tools: Tools,
    journal: Journal,
    *,
    who: str,
    lock_folder: Path | None = None,
) -> Preview:
    """Make all checks of a job before its first motion, and list its steps.

    What it makes to try whether files can be written is removed again.

    Raises:
        the errors of `recalibrate` up to the first motion.
    """
    section = section_of(cell)
    context = _context(cell_file, cell, tools, journal, who)
    now = tools.now()
    found = _counted(section, cell, now, journal)
    early = _not_due(section, cell, found, now)
    if early is not None:
        return Preview((), early.remark)
    with bus_lock(cell, lock_folder):
        found = sessions.begun_until(sessions.sessions(section.folder, cell.name), now)
        session = _open_session(section, cell, found, now)
        made: tuple[str, ...] = ()
        if session is not None:
            made = tuple(run.name for run in verified_runs(session).state.runs)
        left = [run for run in section.runs if run.name not in made]
        if left:
            folder = nearest_existing_folder(section.folder)
            there = replace(tools, free=lambda _: tools.free(folder))
            before_motion(replace(context, tools=there), take_over=False)
        else:
            require_writable(context)
    steps = []
    if left and section.warm_up_min:
        steps = [f"warm up for {section.warm_up_min:g} min"]
    steps += [f"mount {run.payload or 'none'}, record {run.name}" for run in left]
    if session is None or calibration_of_session(session) is None:
        steps += ["identify gains and missing effects"]
    steps += [
        "compare with the current gains",
        f"write, approved by: {cell.apply.by.value}",
        "report",
    ]
    taken = "a new session"
    if session is not None:
        taken = f"session {session.state.session} continues"
    return Preview(tuple(steps), taken)


def _context(
    cell_file: Path, cell: Cell, tools: Tools, journal: Journal, who: str
) -> SessionContext:
    """What the stages share in a job: the runs of the cell file, and its policy as the operator."""
    section = section_of(cell)
    policy = CellPolicy(cell, section, who, tools.run)
    return SessionContext(
        cell_file,
        cell,
        section,
        FixedRuns(section.runs),
        policy,
        file_of(cell),
        tools,
        journal,
        began_s=tools.monotonic_s(),
        must_write=policy.writes,
    )


def _counted(
    section: Recalibration, cell: Cell, now: datetime, journal: Journal
) -> tuple[Session, ...]:
    """Return the sessions of the cell that count at this time; see `sessions_that_count`."""
    return sessions_that_count(sessions.sessions(section.folder, cell.name), now, journal)


def _not_due(
    section: Recalibration, cell: Cell, found: tuple[Session, ...], now: datetime
) -> Conclusion | None:
    """Conclude early where no calibration is due."""
    good = sessions.last_good(found)
    if good is None:
        return None
    due = good.began + timedelta(hours=section.every_h)
    left = due - now
    if left <= timedelta(0):
        return None
    if _open_session(section, cell, found, now) is not None:  # begun with --now
        return None
    hours = left.total_seconds() / 3600.0
    remark = (
        f"The calibration of session {good.state.session} is good for another {hours:.1f} h "
        "(every_h)."
    )
    return Conclusion(Outcome.NOT_DUE, ExitCode.OK, None, remark)


def _open_session(
    section: Recalibration, cell: Cell, found: tuple[Session, ...], now: datetime
) -> Session | None:
    """Session that a job would resume; plans are read only where one is unfinished."""
    if not found or found[-1].finished:
        return None
    return sessions.resumable_session(found, basis_of(cell, section), now, section.resume_within_h)


def _resumed_or_new(
    section: Recalibration, cell: Cell, found: tuple[Session, ...], now: datetime, journal: Journal
) -> Session:
    session = _open_session(section, cell, found, now)
    if session is None:
        session = sessions.begin(section.folder, basis_of(cell, section), now)
        replace(journal, session=session.state.session).say(
            Level.INFO, "session begun", folder=str(session.folder)
        )
        return session
    attempt = session.state.attempt + 1
    replace(journal, session=session.state.session).say(
        Level.NOTICE, "session taken up", attempt=attempt
    )
    return sessions.resume(session, now)


STOP_RETRY_S = 1.0  #: After an alarm that came while the axes were being stopped for another reason


@contextmanager
def time_bound(minutes: float) -> Iterator[SignalBlocker]:
    """Raise TimeBoundReached in the block when its time is up;
    yields a function that defers it during a stop.

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
            signal.setitimer(signal.ITIMER_REAL, STOP_RETRY_S)
            return
        raise TimeBoundReached(
            "the job",
            found=f"more than {minutes:g} min since it began",
            expected="its end within max_duration_min",
            remedy="the axes were commanded to stop, and the next job continues the session; find "
            "in the log what takes so long, or raise max_duration_min",
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
