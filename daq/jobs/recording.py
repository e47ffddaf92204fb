"""Record the runs of a session and fit them: plans, warm-up, recordings, calibration, report."""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from daq.config.cell import Cell
from daq.config.recalibration import PlannedRun, Recalibration
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.documents.session_state import Fitted, Outcome, RecordedRun
from daq.errors import (
    CalibrationMissing,
    CalibrationRefused,
    CalibrationUnreadable,
    ConfigurationError,
    DataError,
    LogUnreadable,
    RunInvalid,
    writing,
)
from daq.files import sha256, sha256_of
from daq.jobs.context import NextRun, SessionContext
from daq.jobs.journal import Journal, Level
from daq.jobs.session import CALIBRATION, REPORT, Basis, Session
from daq.log.container import UNFINISHED
from daq.log.salvage import salvage
from daq.report.fit import start_of
from daq.report.residual import headline_of, summary
from daq.report.residual_page import PAGE
from daq.workflow.experiment import experiment_of
from daq.workflow.fit import check_holdout
from daq.workflow.interlock import release_check
from daq.workflow.plan import Plan, load_plan, save_plan
from daq.workflow.record import Recorded, RecordingRequest
from ident.calibration import Calibration
from ident.errors import IdentificationError

WARM_UP = "warm-up"


def log_of(session: Session, name: str) -> Path:
    """Log file of a run."""
    return session.folder / f"{name}.mcap"


def basis_of(cell: Cell, section: Recalibration) -> Basis:
    """Current basis of a session of this cell; a missing plan counts as another one."""
    plans = [sha256_of(run.plan_file) or "" for run in section.runs if run.plan_file is not None]
    return Basis(cell.name, cell.digest, sha256(" ".join(plans).encode()))


def _is_unchanged(session: Session, run: RecordedRun) -> bool:
    """Whether the log of a run has the digest in the state."""
    return sha256_of(log_of(session, run.name)) == run.sha256


def verified_runs(session: Session) -> Session:
    """Drop the runs whose logs do not match the digests in the state."""
    runs = tuple(run for run in session.state.runs if _is_unchanged(session, run))
    return replace(session, state=session.state.with_(runs=runs))


def record_runs(context: SessionContext, session: Session) -> Session:
    """Make the recordings that the session lacks; its state is written after each of them.

    Raises:
        JobHeld, NotReleased: before a run; the recordings until then are kept.
        RunInvalid: every recording of a run was invalid.
        DriverError, OutputFailed, ConfigurationError: see `daq.workflow.record`.
    """
    session = context.schedule.prepare(context, verified_runs(session))
    is_warm = False
    while True:
        session, run = context.schedule.next_run(context, session)
        if run is None:
            return session
        planned = run.planned
        run_context = context.within(f"record {planned.name}")
        context.operator.mount(planned)
        run_context.journal.say(Level.INFO, "mounted", payload=planned.payload or "none")
        if not is_warm:
            _warm_up(context, session, run)
            is_warm = True
        recorded = record_valid(run_context, session, run)
        session = session.update(runs=(*session.state.runs, recorded))
        session = context.schedule.after_run(context, session)


def _warm_up(context: SessionContext, session: Session, run: NextRun) -> None:
    """Make the moves of a run for the warm-up."""
    seconds = run.plan.duration_s
    passes = math.ceil(60.0 * context.settings.warm_up_min / seconds)
    journal = context.within(WARM_UP).journal
    for number in range(1, passes + 1):
        journal.say(Level.INFO, "warming up", number=number, of=passes, seconds=seconds)
        move_without_log(context, session, run)


def move_without_log(
    context: SessionContext, session: Session, run: NextRun, speed: float = 1.0
) -> None:
    """Make the moves of a run, recorded under the same supervision; the log is dropped.

    Args:
        context: of the session.
        session: in whose folder the log is meanwhile.
        run: its moves.
        speed: share of the planned speed at which these moves are.
    """
    out = log_of(session, WARM_UP)
    out.unlink(missing_ok=True)
    out.with_name(out.name + UNFINISHED).unlink(missing_ok=True)
    _record(context, run, out, speed)
    out.unlink()


@dataclass(frozen=True, slots=True)
class FixedRuns:
    """The runs that the cell file lists, each with the plan that it names."""

    listed: tuple[PlannedRun, ...]

    def prepare(self, context: SessionContext, session: Session) -> Session:
        """Make the plans of all runs that are left, before anything moves."""
        for planned in self._left(session):
            self._plan(context.within("plan"), session, planned)
        return session

    def runs(self, session: Session) -> tuple[PlannedRun, ...]:
        """Return all of them, whatever was recorded."""
        return self.listed

    def is_complete(self, session: Session) -> bool:
        """Whether each of them is recorded."""
        return not self._left(session)

    def next_run(self, context: SessionContext, session: Session) -> tuple[Session, NextRun | None]:
        """Return the first one that is not recorded."""
        for planned in self._left(session):
            return session, NextRun(planned, self._plan(context.within("plan"), session, planned))
        return session, None

    def after_run(self, context: SessionContext, session: Session) -> Session:
        """Judge nothing: all of them are recorded, whatever they show."""
        return session

    def _left(self, session: Session) -> list[PlannedRun]:
        made = {run.name for run in session.state.runs}
        return [planned for planned in self.listed if planned.name not in made]

    def _plan(self, context: SessionContext, session: Session, planned: PlannedRun) -> Plan:
        """Load the approved plan, or make the plan of the seed once a session."""
        if planned.plan_file is not None:
            return load_plan(planned.plan_file, context.cell)
        assert planned.plan is not None  # the schema requires one of the two
        seed = planned.plan.seed
        duration_s = planned.plan.duration_s
        path = session.folder / f"plan-{seed}-{duration_s:g}s.yaml"
        if path.exists():
            with suppress(ConfigurationError):  # what was damaged is made again
                return load_plan(path, context.cell)
        context.journal.say(Level.INFO, "planning", seed=seed, duration_s=duration_s)
        with writing(path):
            body = next((run.payload for run in self.listed if run.payload is not None), None)
            experiment = experiment_of(context.cell, body)
            save_plan(
                context.tools.plan(
                    context.cell, seed=seed, duration_s=duration_s, experiment=experiment
                ),
                path,
            )
        return load_plan(path, context.cell)  # as a person can read it


def record_valid(context: SessionContext, session: Session, run: NextRun) -> RecordedRun:
    """Record a run, again if the recording is invalid."""
    planned = run.planned
    out = log_of(session, planned.name)
    lost = 0
    missing = (0,) * len(context.cell.axes)
    for attempt in range(1, context.settings.retries + 2):
        _set_aside(out, context.journal)
        context.journal.say(Level.INFO, "recording", attempt=attempt, seconds=run.plan.duration_s)
        recorded = _record(context, run, out)
        log = recorded.log
        for warning in recorded.warnings:
            context.journal.say(Level.WARNING, "warning of the recorder", text=warning)
        lost += log.lost_cycles
        missing = tuple(one + other for one, other in zip(missing, log.missing, strict=True))
        if log.valid:
            context.journal.say(
                Level.INFO, "recorded", samples=log.samples, lost_cycles=lost, missing=missing
            )
            return RecordedRun(
                name=planned.name,
                sha256=sha256_of(out) or "",
                attempts=attempt,
                samples=log.samples,
                lost_cycles=lost,
                missing=missing,
            )
        context.journal.say(
            Level.WARNING, "recording is invalid", reason=log.reason, attempt=attempt
        )
    raise RunInvalid(
        str(out),
        found=f"{context.settings.retries + 1} recordings, none of them valid (the last: "
        f"{log.reason})",
        expected="a valid one",
        remedy="see to the bus, the load of this computer and the encoders; the next job records "
        "this run again",
    )


def _record(context: SessionContext, run: NextRun, out: Path, speed: float = 1.0) -> Recorded:
    """Make one recording; the interlock is checked before the drives are used,
    and again before they get power.

    Waiting for the drives and mapping their PDOs takes seconds, in which the cell may be opened.
    """
    planned = run.planned
    # `section_of` has checked that the cell has it.
    payload = next(
        (one.payload for one in context.cell.payloads if one.name == planned.payload), None
    )
    request = RecordingRequest(
        context.file,
        context.cell,
        run.plan,
        out,
        payload=payload,
        operator=context.who,
        granted_by=context.operator.permit_motion(planned),
        run_id=str(uuid.uuid4()),
        speed=speed,
        entered_kg=planned.mass_kg,
        unguarded=context.operator.unguarded,
    )
    require_released = release_check(context.cell, context.tools.now, context.tools.run)
    return context.tools.record(
        request,
        free=context.tools.free,
        block_signals=context.block_signals,
        require_released=require_released,
    )


def _set_aside(out: Path, journal: Journal) -> None:
    """Rename the remnants of an earlier recording of this name:
    a log that the state does not list, or half of one.
    """
    part = out.with_name(out.name + UNFINISHED)
    with writing(out):
        if out.exists():
            renamed = next(_free_names(out, "aside"))
            out.rename(renamed)
            journal.say(Level.NOTICE, "set aside", log=renamed.name)
        if part.exists():
            partial = next(_free_names(out, "partial"))
            try:
                salvage(part, partial)
                part.unlink()
            except LogUnreadable as error:
                unfinished = partial.with_name(partial.name + UNFINISHED)
                partial = part.rename(unfinished)
                journal.say(Level.NOTICE, "nothing to salvage", found=error.found)
            journal.say(Level.NOTICE, "half a recording kept as partial", log=partial.name)


def _free_names(out: Path, kind: str) -> Iterator[Path]:
    for number in range(1, 1000):
        path = out.with_name(f"{out.stem}-{kind}-{number}{out.suffix}")
        unfinished = path.with_name(path.name + UNFINISHED)
        if not path.exists() and not unfinished.exists():
            yield path


def fit_session(context: SessionContext, session: Session) -> Session:
    """Fit the logs, add missing effects, and write calibration and report,
    unless an earlier job did.

    Raises:
        DataError, IdentificationError: the recordings cannot be used; the session is over.
        OutputFailed: the file system refuses.
    """
    if calibration_of_session(session) is not None:
        return session
    runs = context.schedule.runs(session)
    logs = [log_of(session, run.name) for run in runs if not run.holdout]
    unseen = [log_of(session, run.name) for run in runs if run.holdout]
    names = [log.name for log in logs]
    unseen_names = [log.name for log in unseen]
    context.journal.say(Level.INFO, "identifying", logs=names, holdout=unseen_names)
    try:
        fitted = context.tools.fit(logs, holdout=unseen)
        closed = context.tools.close_loop(
            fitted, context.settings.seed, lambda step: context.journal.say(Level.INFO, step)
        )
        check_holdout(closed)
        changed = context.tools.account(start_of(closed), closed.steps)
    except (DataError, IdentificationError):
        # The same logs would fail again: the next job records new ones.
        session.update(outcome=Outcome.UNFIT)
        raise
    calibration = context.tools.calibration(closed, context.tools.now())
    path = session.folder / CALIBRATION
    report = session.folder / REPORT
    with writing(path):
        save_calibration(calibration, path)
    with writing(report):
        report.mkdir(exist_ok=True)
    context.tools.save_report(closed, changed, calibration, report)
    context.journal.say(Level.INFO, "certificate", page=str(report / PAGE))
    fit = Fitted(
        calibration_sha256=sha256_of(path) or "",
        sentences=summary(closed, changed, calibration.effects),
    )
    in_short = headline_of(closed, changed, calibration.effects).sentences()
    for sentence in fit.sentences:
        context.journal.say(Level.INFO, "found", text=sentence, in_short=sentence in in_short)
    return session.update(fitted=fit)


def calibration_of_session(session: Session) -> Calibration | None:
    """Calibration of a session; None where there is none, or where it was made from other logs."""
    path = session.folder / CALIBRATION
    fitted = session.state.fitted
    if fitted is None or sha256_of(path) != fitted.calibration_sha256:
        return None
    try:
        found = load_calibration(path)
    except (CalibrationMissing, CalibrationUnreadable, CalibrationRefused):
        return None
    own = {run.sha256 for run in session.state.runs}
    if {source.sha256 for source in found.sources} == own:
        return found
    return None
