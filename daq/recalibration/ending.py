"""The end of a job, told wherever somebody may look: audit, state, summary, metrics, journal."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from daq.atomic_file import replace_file
from daq.configuration.cell import Cell
from daq.configuration.recalibration import Recalibration
from daq.errors import AuditUnusable, DaqError, ExitCode, HistoryUnreadable, OutputFailed, exit_code
from daq.history.in_force import digests_in_force
from daq.history.store import HistoryStore
from daq.recalibration import session as sessions
from daq.recalibration.fitting import calibration_of_session
from daq.recalibration.journal import Journal, Level
from daq.recalibration.metrics import Figures, write_metrics
from daq.recalibration.recording import GainTarget
from daq.recalibration.report import SUMMARY_JSON, SUMMARY_TEXT, Conclusion, document, text
from daq.recalibration.session import Outcome, Session, SessionState
from daq.recalibration.tools import Tools
from daq.write_back.audit import AuditAction, AuditEntry, append
from drivers.errors import WHILE

CODES = {Outcome.PROPOSED: ExitCode.PROPOSED}
"""Of ends that are no errors; the others are OK."""


@dataclass(frozen=True, slots=True)
class Ending:
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
        return self._tell(session, outcome, CODES.get(outcome, ExitCode.OK), remark, "")

    def failed(self, folder: Path, error: BaseException) -> None:
        """What fails while this is told is noted on the error, which goes on its way."""
        try:
            session = next(one for one in sessions.sessions(folder.parent) if one.folder == folder)
            interrupted = isinstance(error, KeyboardInterrupt)
            outcome = session.state.outcome or (Outcome.INTERRUPTED if interrupted else Outcome.STOPPED)
            code = ExitCode.INTERRUPTED if interrupted else exit_code(type(error)) or ExitCode.UNEXPECTED
            problem = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            notes = [note for note in getattr(error, "__notes__", ()) if note.startswith(WHILE)]
            self._tell(session, outcome, code, "; ".join((problem, *notes)), problem)
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

    def _tell(self, session: Session, outcome: Outcome, code: int, remark: str, problem: str) -> Conclusion:
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
