"""From a session's logs to its calibration and its report."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from daq.calibration_file import load, save
from daq.digest import sha256_of
from daq.errors import CalibrationMissing, CalibrationRefused, CalibrationUnreadable, DataError, OutputFailed
from daq.recalibration import session as sessions
from daq.recalibration.journal import Journal, Level
from daq.recalibration.recording import Cellside, log_of
from daq.recalibration.session import CALIBRATION, REPORT, Fitted, Outcome, Session
from daq.report.fit import start_of
from daq.report.residual_summary import summary
from ident.calibration import Calibration
from ident.errors import IdentificationError


def fit_session(side: Cellside, session: Session, journal: Journal) -> tuple[Session, Calibration]:
    """Fit the logs, close the loop, and write calibration and report; nothing where that was done before.

    Raises:
        DataError, IdentificationError: the recordings cannot be used; the session is over.
        OutputFailed: the file system refuses.
    """
    done = calibration_of_session(session)
    if done is not None:
        return session, done
    logs = [log_of(session, run.name) for run in side.section.runs if not run.holdout]
    unseen = [log_of(session, run.name) for run in side.section.runs if run.holdout]
    journal.say(Level.INFO, "identifying", logs=[log.name for log in logs], holdout=[log.name for log in unseen])
    try:
        fitted = side.tools.fit(logs, holdout=unseen)
        closed = side.tools.close_loop(fitted, side.section.seed, lambda step: journal.say(Level.INFO, step))
        changed = side.tools.account(start_of(closed), closed.steps)
    except (DataError, IdentificationError):
        # The same logs would end in the same way: the next job records others.
        sessions.save(replace(session, state=session.state.with_(outcome=Outcome.UNFIT)))
        raise
    calibration = side.tools.calibration(closed, side.tools.now())
    path, report = session.folder / CALIBRATION, session.folder / REPORT
    try:
        save(calibration, path)
        report.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputFailed.of(path, error) from error
    side.tools.save_report(closed, changed, calibration, report)
    fit = Fitted(calibration_sha256=sha256_of(path) or "", sentences=summary(closed, changed))
    for sentence in fit.sentences:
        journal.say(Level.INFO, "found", text=sentence)
    return sessions.save(replace(session, state=session.state.with_(fitted=fit))), calibration


def calibration_of_session(session: Session) -> Calibration | None:
    """The calibration that the state speaks of, None where there is none, or where it is not of the session's logs."""
    path, fitted = session.folder / CALIBRATION, session.state.fitted
    if fitted is None or sha256_of(path) != fitted.calibration_sha256:
        return None
    try:
        found = _loaded(path, fitted.calibration_sha256)
    except (CalibrationMissing, CalibrationUnreadable, CalibrationRefused):
        return None
    own = {run.sha256 for run in session.state.runs}
    return found if {source.sha256 for source in found.sources} == own else None


@lru_cache(maxsize=2)
def _loaded(path: Path, _sha256: str) -> Calibration:
    """Read once for all that tell of it: a content of that digest stays what it is."""
    return load(path)
