"""The job: preflight, record, fit, decide, propose or apply, report; taken up where an earlier one was ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from daq.bus_lock import bus_lock
from daq.configuration.cell import Cell
from daq.configuration.recalibration import Recalibration
from daq.errors import ExitCode
from daq.recalibration import session as sessions
from daq.recalibration.ending import Ending
from daq.recalibration.fitting import calibration_of_session, fit_session
from daq.recalibration.journal import Journal, Level
from daq.recalibration.past import Past
from daq.recalibration.preflight import before_motion, due_in, require_clock, section_of, target_of
from daq.recalibration.recording import Cellside, basis_of, record_runs, standing_runs
from daq.recalibration.report import Conclusion
from daq.recalibration.session import Outcome, Session
from daq.recalibration.time_bound import time_bound
from daq.recalibration.tools import Tools
from daq.recalibration.verdict import settle
from daq.write_back.audit import AuditAction
from drivers.network import Undisturbed


def recalibrate(
    cell_file: Path,
    cell: Cell,
    tools: Tools,
    journal: Journal,
    *,
    who: str,
    undisturbed: Undisturbed = nullcontext,
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
        lock_folder: of the bus's lock, see `daq.bus_lock`.

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
        session = _taken_up_or_new(section, cell, tools.now(), journal)
        journal = journal.within(session=session.state.session)
        ending = Ending(cell_file, cell, section, target, tools, journal, who, began_s)
        try:
            ending.audit(AuditAction.RECALIBRATION_BEGUN, session, {"attempt": session.state.attempt})
            with time_bound(section.max_duration_min) as in_time:
                side = Cellside(cell_file, cell, section, target, tools, who, _both(undisturbed, in_time))
                session = _go(side, session, journal)
        except BaseException as error:
            ending.failed(session.folder, error)
            raise
        return ending.succeeded(session)


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
        session = sessions.to_take_up(found, basis_of(cell, section), now, section.resume_within_h)
        made = () if session is None else tuple(run.name for run in standing_runs(session).state.runs)
        left = [run for run in section.runs if run.name not in made]
        if left:
            folder = _nearest(section.folder)
            there = replace(tools, free=lambda _: tools.free(folder))
            before_motion(Cellside(cell_file, cell, section, target, there, who, nullcontext), journal)
    steps = [f"warm up for {section.warm_up_min:g} min"] if left and section.warm_up_min else []
    steps += [f"mount {run.payload or 'none'}, record {run.name}" for run in left]
    if session is None or calibration_of_session(session) is None:
        steps += ["fit and close the loop"]
    steps += ["compare with the controller's gains", f"apply by {cell.apply.by.value}", "report"]
    taken = "a new session" if session is None else f"session {session.state.session} is taken up"
    return Preview(tuple(steps), taken)


def _go(side: Cellside, session: Session, journal: Journal) -> Session:
    if len(standing_runs(session).state.runs) < len(side.section.runs):
        before_motion(side, journal.within(step="preflight"))
        session = record_runs(side, session, journal)
    session, calibration = fit_session(side, session, journal.within(step="fit"))
    with Past(side.cell, side.target.history, side.target.file, side.tools.now, side.who) as past:
        past.keep(calibration, session.folder / sessions.CALIBRATION)
        session = sessions.save(replace(session, state=session.state.with_(watched=past.watched())))
        for gain in session.state.watched:
            if gain.alarm:
                # Slices of a slow drift may each be small enough to be written without anybody.
                journal.within(step="watch").say(Level.WARNING, "drift", axis=gain.axis, text=gain.alarm)
        return settle(side, session, calibration, past, journal.within(step="decide"))


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


def _taken_up_or_new(section: Recalibration, cell: Cell, now: datetime, journal: Journal) -> Session:
    found, basis = sessions.sessions(section.folder, cell.name), basis_of(cell, section)
    session = sessions.to_take_up(found, basis, now, section.resume_within_h)
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


def _both(one: Undisturbed, other: Undisturbed) -> Undisturbed:
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
