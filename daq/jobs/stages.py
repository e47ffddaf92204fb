"""The stages of a session, in order; each leaves its result in the session's folder and finds that
of the one before.

A stage that finds its own result there does nothing, so a session goes on where it was ended. A
scheduled job and a guided session take the same stages: they differ in the schedule of runs and in
the operator.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from daq.documents.session_state import WatchedGain
from daq.errors import CalibrationUnreadable, OutputFailed
from daq.files import sha256_of
from daq.jobs.context import SessionContext, before_motion
from daq.jobs.decision import decide_outcome
from daq.jobs.journal import Level
from daq.jobs.recording import calibration_of_session, fit_session, record_runs, verified_runs
from daq.jobs.session import CALIBRATION, Session
from daq.ledger.ledger import MAY_LACK, enter_calibration, read_history
from daq.ledger.watch import alarm_text, watch
from daq.report.certificate import status_text
from ident.calibration import Calibration


class Stage(Protocol):
    """One stage of a session."""

    def run(self, context: SessionContext, session: Session) -> Session:
        """Do what the session lacks of this stage; return it with the new state, which is written.

        Raises:
            DaqError, DriverError, IdentificationError: the session stays as it was until then.
        """


class Record:
    """Record the runs that the schedule asks for."""

    def run(self, context: SessionContext, session: Session) -> Session:
        """Check disk, places to write to, history, interlock and drives, then record;
        nothing is checked where nothing is left.
        """
        session = verified_runs(session)
        if context.schedule.is_complete(session):
            return session
        before_motion(context.within("preflight"))
        return record_runs(context, session)


class Identify:
    """Fit the recordings, search what the model lacks, write calibration and report."""

    def run(self, context: SessionContext, session: Session) -> Session:
        """See `daq.jobs.recording.fit_session`."""
        return fit_session(context.within("fit"), session)


class WatchDrift:
    """Enter the calibration into the history, and look at the drift of each gain."""

    def run(self, context: SessionContext, session: Session) -> Session:
        """Enter it before the decision: what is only proposed is in the history, too.

        This also ends the write of a killed job.
        """
        calibration = calibration_made(session)
        journal = context.within("watch").journal
        digest = sha256_of(session.folder / CALIBRATION) or ""
        enter_calibration(
            context.ledger, calibration, digest=digest, who=context.who, at=context.tools.now()
        )
        history = read_history(context.ledger)
        if history.may_lack:
            journal.say(Level.WARNING, "history may be incomplete", text=MAY_LACK)
        series = watch(history.entries, history.acknowledgements)
        watched = tuple(WatchedGain(axis=one.axis, alarm=alarm_text(one) or "") for one in series)
        session = session.update(watched=watched)
        for gain in watched:
            if gain.alarm:
                # Each slice of a slow drift may be small enough to be written without an operator.
                journal.say(Level.WARNING, "drift", axis=gain.axis, text=gain.alarm)
        return session


class Decide:
    """Compare the gains with the current ones, and write them where the operator approves."""

    def run(self, context: SessionContext, session: Session) -> Session:
        """See `daq.jobs.decision.decide_outcome`."""
        history = read_history(context.ledger)
        return decide_outcome(context.within("decide"), session, calibration_made(session), history)


class Certify:
    """Make the certificate again: who wrote the gains and when,
    and whether new moves accept them.
    """

    def run(self, context: SessionContext, session: Session) -> Session:
        """Write the page; where the file system refuses, the session ends all the same:
        its gains are what counts.
        """
        journal = context.within("certify").journal
        calibration = calibration_made(session)
        now = context.tools.now()
        try:
            certificate = context.tools.certify(
                context.file, context.cell, calibration, session.folder, now
            )
        except OutputFailed as error:
            calibration_file = session.folder / CALIBRATION
            remedy = (
                f"`drivegain certificate {calibration_file} --cell {context.file}` makes another"
            )
            journal.say(
                Level.WARNING,
                "the certificate is that of before the decision",
                text=f"{error}; {remedy}",
            )
            return session
        status = status_text(certificate.comparison)
        journal.say(Level.NOTICE, "certified", id=certificate.origin.id, text=status)
        return session


TO_DECISION: tuple[Stage, ...] = (Record(), Identify(), WatchDrift(), Decide())
"""Stages that job, guided session and demonstration share."""
OF_JOB: tuple[Stage, ...] = (*TO_DECISION, Certify())
"""Stages of the scheduled job."""


def run_stages(stages: Sequence[Stage], context: SessionContext, session: Session) -> Session:
    """Take the stages in order; return the session with its last state."""
    for stage in stages:
        session = stage.run(context, session)
    return session


def calibration_made(session: Session) -> Calibration:
    """Return the calibration that an earlier stage has written.

    Raises:
        CalibrationUnreadable: it was changed or removed since.
    """
    found = calibration_of_session(session)
    if found is None:
        raise CalibrationUnreadable(
            str(session.folder / CALIBRATION),
            found="another content than this session wrote, or no file",
            expected="the calibration that was made from the recordings of this session",
            remedy="start the session again: it identifies again from its recordings",
        )
    return found
