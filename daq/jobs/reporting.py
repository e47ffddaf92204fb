"""Report the end of a job: in the audit, the session's state and summary,
the metrics and the journal.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from prometheus_client import CollectorRegistry, Gauge, generate_latest

from daq.documents.session_state import GuidedState, Outcome, RecordedRun, SessionState
from daq.errors import (
    AuditUnusable,
    DaqError,
    DataError,
    ExitCode,
    HistoryUnreadable,
    OutputFailed,
    WriteUnconfirmed,
    counted,
    exit_code,
    writing,
)
from daq.files import replace_file, sha256
from daq.jobs import session as sessions
from daq.jobs.context import SessionContext
from daq.jobs.guided import fit_corrected_command, go_on, next_step_after
from daq.jobs.journal import Level
from daq.jobs.recording import calibration_of_session
from daq.jobs.session import CALIBRATION, REPORT, Session
from daq.ledger.audit import AuditAction, AuditEntry
from daq.ledger.ledger import MAY_LACK, read_history, record_session
from daq.report.document import json_text
from daq.report.job_schemas import JobReport, RefusedJob, SessionReport
from daq.report.residual_page import PAGE
from daq.writeback.gates.fit import OF_DESCRIPTION
from drivers.errors import stop_notes
from ident.calibration import Calibration
from ident.errors import Diagnosis

AnyReport = TypeVar("AnyReport", JobReport, SessionReport)

SUMMARY_TEXT = "summary.txt"
SUMMARY_JSON = "summary.json"
NOTHING_TO_DO = ["nothing"]


@dataclass(frozen=True, slots=True)
class Conclusion:
    """How a job ended."""

    outcome: Outcome  #: of the job
    exit_code: int  #: of the command
    session: Session | None  #: with its final state; None where none was begun
    remark: str  #: reason, in one sentence
    #: of the operator, after an error that has ended a guided session; empty otherwise
    next_step: str = ""


def report_success(context: SessionContext, session: Session) -> Conclusion:
    """Report a session whose state has its outcome.

    Raises:
        OutputFailed, AuditUnusable: something could not be written; everything else was.
    """
    outcome = session.state.outcome or Outcome.STOPPED
    remark = ""
    if session.state.decision is not None:
        remark = session.state.decision.remark
    code = ExitCode.OK
    if outcome is Outcome.PROPOSED:
        code = ExitCode.PROPOSED
    elif _is_contradicted(session.state):
        code = ExitCode.NOT_ACCEPTED
    return _report(context, Conclusion(outcome, int(code), session, remark), session, "")


def report_failure(context: SessionContext, folder: Path, error: BaseException) -> None:
    """Report the error that ended a job; failures of the report itself are attached to the error as
    notes.
    """
    try:
        session = _session_in(folder)
        interrupted = isinstance(error, KeyboardInterrupt)
        outcome = session.state.outcome or (Outcome.INTERRUPTED if interrupted else Outcome.STOPPED)
        code = ExitCode.INTERRUPTED
        if not interrupted:
            code = exit_code(type(error)) or ExitCode.UNEXPECTED
        if str(error):
            problem = f"{type(error).__name__}: {error}"
        elif interrupted:
            problem = "interrupted"
        else:
            problem = type(error).__name__
        remark = "; ".join((problem, *stop_notes(error)))
        next_step = ""
        if isinstance(session.state, GuidedState):
            next_step = next_step_after(error, context.file, session)
        _report(
            context, Conclusion(outcome, int(code), session, remark, next_step), session, problem
        )
    except Exception as second:  # noqa: BLE001 - whatever it is, it must not hide the error that ended the job
        reason = str(second) or type(second).__name__
        error.add_note(f"kept: the end of the session may not be recorded: {reason}")


def _session_in(folder: Path) -> Session:
    """Return the session of a folder.

    Raises:
        DataError: its state cannot be read.
    """
    for session in sessions.sessions(folder.parent):
        if session.folder == folder:
            return session
    raise DataError(
        str(folder),
        found="no session that can be read",
        expected="the state of the session that has ended",
        remedy="restore its folder",
    )


def audit_entry(
    context: SessionContext, action: AuditAction, session: Session, details: dict[str, object]
) -> AuditEntry:
    """Append an entry about the session to the audit.

    Raises:
        AuditUnusable, OutputFailed: it could not be written.
    """
    all_details = {"session": session.state.session, "cell": context.cell.name, **details}
    return record_session(
        context.target.history.audit,
        action,
        at=context.tools.now(),
        who=context.who,
        subject=str(session.folder),
        details=all_details,
    )


def _report(
    context: SessionContext, ended: Conclusion, session: Session, problem: str
) -> Conclusion:
    """Write down how a session ended: in audit, state, summary and metrics.

    Raises:
        OutputFailed, AuditUnusable: something could not be written; everything else was.
    """
    outcome = ended.outcome
    code = ended.exit_code
    now = context.tools.now()
    state = session.state.with_(
        outcome=outcome, exit_code=code, problem=problem, ended=now.isoformat(timespec="seconds")
    )
    unwritten: DaqError | None = None
    try:
        calibration_sha256 = None
        if state.fitted is not None:
            calibration_sha256 = state.fitted.calibration_sha256
        details: dict[str, object] = {
            "outcome": outcome.value,
            "exit_code": code,
            "problem": problem,
            "logs": {run.name: run.sha256 for run in state.runs},
            "calibration_sha256": calibration_sha256,
        }
        entry = audit_entry(context, AuditAction.RECALIBRATION_ENDED, session, details)
        # Stored here too: a chain does not show by itself that its last lines are missing.
        state = state.with_(audit_sha256=entry.sha256)
    except (AuditUnusable, OutputFailed) as error:
        words = "the audit log may lack the end of the session"
        context.journal.say(Level.ERROR, words, text=str(error))
        unwritten = error
    session = Session(session.folder, state)
    conclusion = replace(ended, session=session)
    level = Level.ERROR
    if outcome.good:
        level = Level.NOTICE
    context.journal.say(
        level, "session ended", outcome=outcome.value, exit_code=code, remark=ended.remark
    )
    try:
        _write_summary(conclusion, session, context.file)
    finally:
        # Last: a session that is over has its summary, also after a kill.
        sessions.save(session)
    found = sessions.begun_until(sessions.sessions(context.settings.folder, context.cell.name), now)
    if context.settings.metrics is not None:
        duration_s = context.tools.monotonic_s() - context.began_s
        try:
            write_metrics(
                context.settings.metrics,
                context.cell.name,
                conclusion,
                now,
                duration_s,
                sessions.last_good(found),
            )
        except OutputFailed as error:
            # A monitor reports missing metrics itself; the calibration is done.
            context.journal.say(Level.ERROR, "metrics could not be written", text=str(error))
    _remove_old(context, found)
    if unwritten is not None:
        raise unwritten
    return conclusion


def _write_summary(conclusion: Conclusion, session: Session, cell_file: Path) -> None:
    """Write the summary as text and as JSON.

    Raises:
        OutputFailed: the file system refuses.
    """
    is_guided = isinstance(session.state, GuidedState)
    if is_guided:
        report = session_report(conclusion, cell_file)
    else:
        report = conclusion_report(conclusion, cell_file)
    contents = {SUMMARY_TEXT: text(conclusion, cell_file), SUMMARY_JSON: json_text(report)}
    for name, content in contents.items():
        path = session.folder / name
        with writing(path):
            replace_file(path, content.encode())


def _remove_old(context: SessionContext, found: tuple[Session, ...]) -> None:
    # Where the calibrations in force are unknown, all sessions stay.
    try:
        history = read_history(context.ledger)
    except (AuditUnusable, HistoryUnreadable) as error:
        context.journal.say(Level.WARNING, "no old session removed", text=str(error))
        return
    if history.may_lack:
        context.journal.say(Level.WARNING, "no old session removed", text=MAY_LACK)
        return
    newest = {event.target: event.digest for event in history.events}
    in_force = frozenset(digest for digest in newest.values() if digest is not None)
    for folder in sessions.remove_old(found, context.settings.keep_sessions, in_force):
        context.journal.say(Level.INFO, "old session removed", folder=str(folder))


def conclusion_report(conclusion: Conclusion, cell_file: Path) -> JobReport | RefusedJob:
    """Return how a job ended, for `recalibrate --json` and summary.json."""
    return _as_report(JobReport, conclusion, cell_file)


def session_report(conclusion: Conclusion, cell_file: Path) -> SessionReport | RefusedJob:
    """Return how a guided session ended, for `calibrate --json` and summary.json."""
    return _as_report(SessionReport, conclusion, cell_file)


def _as_report(
    kind: type[AnyReport], conclusion: Conclusion, cell_file: Path
) -> AnyReport | RefusedJob:
    refused = RefusedJob(
        outcome=conclusion.outcome,
        exit_code=conclusion.exit_code,
        remark=conclusion.remark,
        to_do=to_do(conclusion, cell_file),
    )
    session = conclusion.session
    if session is None:
        return refused
    # Not strictly: what is a tuple in a state is a list in its mapping.
    values = {**session.state.model_dump(), **dict(refused), "folder": str(session.folder)}
    return kind.model_validate(values, strict=False)


def _run_text(run: RecordedRun) -> str:
    recordings = counted(run.attempts, "recording")
    return f"  {run.name}: {run.samples} samples, {run.lost_cycles} cycles lost, {recordings}"


def text(conclusion: Conclusion, cell_file: Path) -> str:
    """Write the summary as text."""
    session = conclusion.session
    # The remark of a decision is printed above its table.
    decided = (
        session is not None and session.state.decision is not None and not session.state.problem
    )
    lines = [f"Outcome: {conclusion.outcome.value} (exit code {conclusion.exit_code})"]
    if conclusion.remark and not decided:
        lines.append(conclusion.remark)
    if session is not None:
        state = session.state
        lines.append(
            f"Session {state.session} of cell {state.cell}, begun {state.began}, attempt "
            f"{state.attempt}."
        )
        lines += map(_run_text, state.runs)
        if state.fitted is not None:
            lines += ["", "Residual:", *(f"  {sentence}" for sentence in state.fitted.sentences)]
        if state.decision is not None:
            lines += ["", f"Gains: {state.decision.remark}"]
            for gain in state.decision.gains:
                change = ""
                if gain.change_percent is not None:
                    change = f", {gain.change_percent:+.2f} %"
                drift = ""
                if gain.drift_sigma is not None:
                    drift = f" ({abs(gain.drift_sigma):.1f} σ)"
                differs = ""
                if gain.differs:
                    differs = ": differs"
                lines.append(
                    f"  {gain.axis}: current gain {gain.old:.5g}, identified {gain.new:.5g} ± "
                    f"{gain.new_std:.2g} {gain.unit}{change}{drift}{differs}"
                )
        if isinstance(state, GuidedState):
            lines += _guided_lines(state)
        drifts = [gain.alarm for gain in state.watched if gain.alarm]
        if drifts:
            lines += [
                "",
                "Drift (`drivegain history` shows it):",
                *(f"  {alarm}" for alarm in drifts),
            ]
    lines += _closing(conclusion, cell_file)
    return "\n".join(lines) + "\n"


def ending(conclusion: Conclusion, cell_file: Path) -> str:
    """Write the end of a session for a person who has seen how it went."""
    lines = ["", f"Outcome: {conclusion.outcome.value}"]
    session = conclusion.session
    if session is not None and isinstance(session.state, GuidedState):
        state = session.state
        if state.acceptance is not None and state.acceptance.accepted:  # said just before
            state = state.model_copy(update={"acceptance": None})
        lines += _guided_lines(state)
    lines += _closing(conclusion, cell_file)
    return "\n".join(lines) + "\n"


def _closing(conclusion: Conclusion, cell_file: Path) -> list[str]:
    """List the files of a session and the next steps."""
    lines: list[str] = []
    session = conclusion.session
    if session is not None:
        lines += ["", f"Folder: {session.folder}"]
        page = session.folder / REPORT / PAGE
        if page.exists():
            lines.append(f"Report: {page}")
    return [*lines, "", "To do:", *(f"  {line}" for line in to_do(conclusion, cell_file))]


def _guided_lines(state: GuidedState) -> list[str]:
    """What a guided session adds: what was not reached, and whether new moves accept the gains."""
    lines: list[str] = []
    if state.missing:
        lines += ["", f"Not reached: {state.missing}"]
    if state.would_help:
        lines += ["What would help:", *(f"  {line}" for line in state.would_help)]
    if state.acceptance is not None:
        verdict = "NOT ACCEPTED"
        if state.acceptance.accepted:
            verdict = "Accepted"
        lines += ["", f"{verdict} on new moves: {state.acceptance.remark}."]
    return lines


def undo_command(cell_file: Path, *, in_drives: bool) -> str:
    """Return the command that undoes a write to the controller's file, or to the drives."""
    command = f"drivegain rollback {shlex.quote(str(cell_file.absolute()))}"
    if in_drives:
        command += " --drives --yes"
    return command


def to_do(conclusion: Conclusion, cell_file: Path) -> list[str]:
    """List the next steps for the operator, a line each:
    those of the outcome, and what the fit says to check.

    What is wrong with the description comes first as long as nothing is written: with a corrected
    cell file, the calibration of the old one can no longer be.
    """
    steps = _steps(conclusion, cell_file)
    diagnoses = _diagnoses(conclusion)
    checks = [f"CHECK {one.subject}: {one.remedy}" for one in diagnoses]
    is_described_wrongly = any(one.name in OF_DESCRIPTION for one in diagnoses)
    session = conclusion.session
    if is_described_wrongly and session is not None and isinstance(session.state, GuidedState):
        command = fit_corrected_command(cell_file, session)
        checks.append(f"with the corrected file, this fits the recorded blocks again: {command}")
    if checks and steps == NOTHING_TO_DO:
        return checks
    if is_described_wrongly and conclusion.outcome is Outcome.PROPOSED:
        return [*checks, "or, with the description as it is:", *steps]
    return [*steps, *checks]


def _diagnoses(conclusion: Conclusion) -> tuple[Diagnosis, ...]:
    """What a good calibration says to check;
    a failed check of another outcome says itself what to do.
    """
    if conclusion.session is None or not conclusion.outcome.good:
        return ()
    calibration = calibration_of_session(conclusion.session)
    if calibration is None:
        return ()
    return calibration.diagnoses


def _steps(conclusion: Conclusion, cell_file: Path) -> list[str]:
    """List the next steps of an outcome."""
    session = conclusion.session
    outcome = conclusion.outcome
    target = None
    if session is not None:
        target = session.state.target
    undo = undo_command(cell_file, in_drives=target is not None and target.in_drives)
    if outcome is Outcome.APPLIED and session is not None and _is_contradicted(session.state):
        return [
            f"undo the write: {undo}",
            "compare the controller's numbers and the payload with the certificate, then "
            "calibrate again",
        ]
    if outcome is Outcome.PROPOSED and session is not None and target is not None:
        calibration = shlex.quote(str(session.folder / CALIBRATION))
        cell = shlex.quote(str(cell_file.absolute()))
        sign = (
            f"let a second person sign it: drivegain sign calibration {calibration} --key KEY "
            "--name NAME"
        )
        command = f"drivegain apply {cell} {calibration}"
        if target.in_drives:
            command += " --drives"
        return [
            *([sign] if target.unsigned else []),
            command,
            "if the change that it shows is right, write it:",
            f"{command} --yes --base {target.looked_at}",
        ]
    if outcome is Outcome.APPLIED and target is not None:
        loading = ["let the controller load the file"]
        if target.in_drives:
            loading = []
        return [*loading, f"to undo it: {undo}"]
    if conclusion.next_step:
        return [conclusion.next_step]
    is_to_go_on = outcome in (Outcome.STOPPED, Outcome.INTERRUPTED)
    if is_to_go_on and session is not None and isinstance(session.state, GuidedState):
        return [go_on(session.state)]
    return {
        Outcome.REFUSED: [
            "find out why the check failed; the same command then begins a new session"
        ],
        Outcome.UNFIT: [
            "find out what is wrong with the recordings (`drivegain info LOG`); the same command "
            "then begins a new session"
        ],
        Outcome.STOPPED: [
            "remove the cause; the same command continues this session while it is recent"
        ],
        Outcome.INTERRUPTED: [
            "nothing, or the same command again: it continues this session while it is recent"
        ],
    }.get(outcome, NOTHING_TO_DO)


def _is_contradicted(state: SessionState) -> bool:
    """Whether new moves contradict the gains that were written."""
    return (
        isinstance(state, GuidedState)
        and state.acceptance is not None
        and not state.acceptance.accepted
    )


PREFIX = "drivegain_recalibration_"


def write_metrics(
    folder: Path,
    cell: str,
    conclusion: Conclusion,
    ended: datetime,
    duration_s: float,
    good: Session | None,
) -> Path:
    """Write the metrics for the textfile collector of the Prometheus node exporter;
    the file is replaced whole.

    Where the session of this job has no calibration, figures are those of the last good one.

    Raises:
        OutputFailed: the file system refuses.
    """
    shown = conclusion.session
    calibration = None
    if shown is not None:
        calibration = calibration_of_session(shown)
    if calibration is None and good is not None:
        shown = good
        calibration = calibration_of_session(good)
    registry = CollectorRegistry()

    def gauge(name: str, text: str, *labels: str) -> Gauge:
        return Gauge(PREFIX + name, text, ("cell", *labels), registry=registry)

    outcomes = gauge("outcome", "1 for the outcome of the last job, 0 for the others.", "outcome")
    for outcome in Outcome:
        outcomes.labels(cell, outcome.value).set(float(outcome is conclusion.outcome))
    gauge("exit_code", "Of the last job.").labels(cell).set(conclusion.exit_code)
    gauge("last_run_timestamp_seconds", "When the last job ended.").labels(cell).set(
        ended.timestamp()
    )
    gauge("duration_seconds", "Of the last job.").labels(cell).set(duration_s)
    if good is not None:
        last = gauge("last_success_timestamp_seconds", "When the last good calibration was begun.")
        last.labels(cell).set(good.began.timestamp())
    if shown is not None:
        _set_session_gauges(gauge, shown.state, cell)
    if calibration is not None:
        _set_calibration_gauges(gauge, calibration, cell)
    path = folder / f"drivegain_{file_stem(cell)}.prom"
    with writing(path):
        replace_file(path, generate_latest(registry))
        try:
            # The collector is another user, and a service's umask may be strict.
            path.chmod(0o644)
        except OSError as error:
            raise WriteUnconfirmed.of(path, error) from error
    return path


def file_stem(cell: str) -> str:
    """File name of a cell; with six digits of its hash where characters that distinguish two cells
    were lost.
    """
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", cell)
    if plain == cell:
        return plain
    return f"{plain}_{sha256(cell.encode())[:6]}"


def _set_session_gauges(gauge: Callable[..., Gauge], state: SessionState, cell: str) -> None:
    lost = gauge("lost_cycles", "Cycles that are not in any recording of a run.", "run")
    missing = gauge(
        "missing_answers", "Answers of drives that never came, of all recordings of a run.", "run"
    )
    attempts = gauge("recordings", "Recordings of a run until a valid one.", "run")
    for run in state.runs:
        lost.labels(cell, run.name).set(run.lost_cycles)
        missing.labels(cell, run.name).set(sum(run.missing))
        attempts.labels(cell, run.name).set(run.attempts)
    if state.watched:
        alarm = gauge(
            "drift_alarm", "1 where the chart of all calibrations raises an alarm, else 0.", "axis"
        )
        for watched in state.watched:
            alarm.labels(cell, watched.axis).set(float(bool(watched.alarm)))
    if state.decision is not None:
        drift = gauge(
            "gain_drift_sigma", "Change from the current gain, in σ of the change.", "axis"
        )
        in_force = gauge(
            "gain_in_force", "Current gain when the job looked, in Nm or N per A.", "axis", "unit"
        )
        for gain in state.decision.gains:
            in_force.labels(cell, gain.axis, gain.unit).set(gain.old)
            if gain.drift_sigma is not None:
                drift.labels(cell, gain.axis).set(gain.drift_sigma)


def _set_calibration_gauges(
    gauge: Callable[..., Gauge], calibration: Calibration, cell: str
) -> None:
    value = gauge("gain", "Identified drive gain, in Nm or N per A.", "axis", "unit")
    std = gauge("gain_std", "Its standard deviation, in the same unit.", "axis", "unit")
    for gain in calibration.gains:
        value.labels(cell, gain.axis, gain.unit).set(gain.value)
        std.labels(cell, gain.axis, gain.unit).set(gain.std)
    residual = gauge("residual_percent", "Relative error of the torques.", "axis", "data")
    axes = [gain.axis for gain in calibration.gains]
    for data, error in (
        ("fit", calibration.relative_error_percent),
        ("holdout", calibration.holdout_error_percent),
    ):
        if error is not None:
            for axis, percent in zip((*axes, "total"), (*error.axes, error.total), strict=True):
                residual.labels(cell, axis, data).set(percent)
