"""A guided session: from a wired cell to an accepted calibration, with a person who mounts,
weighs and approves.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from io import StringIO
from pathlib import Path

from daq.config.cell import Cell, WeighedPayload
from daq.documents.session_state import GuidedState
from daq.errors import ConfigurationInconsistent, DaqError
from daq.jobs import session as sessions
from daq.jobs.acceptance import Accept
from daq.jobs.context import (
    SessionContext,
    Tools,
    before_motion,
    nearest_existing_folder,
    require_replaceable,
    sessions_that_count,
)
from daq.jobs.gain_target import target_of
from daq.jobs.guided import (
    GuidedSettings,
    Rehearse,
    UntilPrecise,
    fit_corrected_command,
    next_step_after,
    plan_with_room,
)
from daq.jobs.journal import Journal, Level
from daq.jobs.operator import Operator
from daq.jobs.reporting import Conclusion, audit_entry, report_failure, report_success
from daq.jobs.session import Basis, Session
from daq.jobs.stages import TO_DECISION, Certify, Stage, run_stages
from daq.ledger.audit import AuditAction
from daq.workflow.bus_lock import bus_lock
from daq.workflow.experiment import experiment_of
from drivers.canopen.network import SignalBlocker
from drivers.errors import DriverError, all_notes

RESUME_WITHIN_H = 12.0  #: An older session has another temperature, and perhaps another payload


def calibrate(
    cell_file: Path,
    cell: Cell,
    settings: GuidedSettings,
    operator: Operator,
    tools: Tools,
    journal: Journal,
    *,
    block_signals: SignalBlocker = nullcontext,
    lock_folder: Path | None = None,
) -> Conclusion:
    """Calibrate a cell with an operator, or go on with the session that was ended before.

    Raises:
        JobHeld, MotionRefused, ConfigurationError: nothing has moved; in a session, as the next
            line.
        DaqError, DriverError, IdentificationError: the error that ended the session; the axes were
            stopped, and audit and state report it. The same call goes on from there.
    """
    context = context_of(cell_file, cell, settings, operator, tools, journal)
    with bus_lock(cell, lock_folder):
        session = _resumed_or_new(context)
        journal = replace(journal, session=session.state.session)
        context = replace(
            context, journal=journal, began_s=tools.monotonic_s(), block_signals=block_signals
        )
        try:
            audit_entry(
                context,
                AuditAction.RECALIBRATION_BEGUN,
                session,
                {"attempt": session.state.attempt},
            )
            session = run_stages(stages_of(settings), context, session)
        except BaseException as error:
            report_failure(context, session.folder, error)
            _name_next_step(cell_file, session.folder, error)
            raise
        return report_success(context, session)


def _name_next_step(cell_file: Path, folder: Path, error: BaseException) -> None:
    """Add to an error which blocks the session has, and what the same command does next."""
    found = next((one for one in sessions.sessions(folder.parent) if one.folder == folder), None)
    if found is None or not isinstance(found.state, GuidedState):
        return
    blocks = ", ".join(run.name for run in found.state.runs)
    # By what could not be recorded
    is_taken = any(note.startswith("kept: ") for note in all_notes(error))
    if not is_taken:
        error.add_note(f"kept: {blocks or 'no block yet'}")
    next_step = next_step_after(error, cell_file, found)
    if next_step:
        error.add_note(f"hint: {next_step}")


def stages_of(settings: GuidedSettings) -> tuple[Stage, ...]:
    """Return the stages of a guided session: as a job, but for rehearsal and acceptance."""
    rehearsal: tuple[Stage, ...] = ()
    if settings.rehearse:
        rehearsal = (Rehearse(UntilPrecise(settings)),)
    return (*rehearsal, *TO_DECISION, Accept(), Certify())


def context_of(
    cell_file: Path,
    cell: Cell,
    settings: GuidedSettings,
    operator: Operator,
    tools: Tools,
    journal: Journal,
) -> SessionContext:
    """Return what the stages of a guided session share."""
    return SessionContext(
        cell_file, cell, settings, UntilPrecise(settings), operator, target_of(cell), tools, journal
    )


def session_basis(cell: Cell) -> Basis:
    """Return what a session must share with the present cell to be resumed;
    its plans are its own.
    """
    return Basis(cell.name, cell.digest, "")


def _resumed_or_new(context: SessionContext) -> Session:
    """Take up the newest session if it is unfinished, of the same cell file and recent;
    else begin one.
    """
    now = context.tools.now()
    folder = context.settings.folder
    found = sessions_that_count(sessions.sessions(folder, context.cell.name), now, context.journal)
    session = sessions.resumable_session(found, session_basis(context.cell), now, RESUME_WITHIN_H)
    if session is None:
        _say_why_new(context, found, now)
        session = sessions.begin(folder, session_basis(context.cell), now, GuidedState)
        context.journal.say(Level.NOTICE, "session begun", folder=str(session.folder))
        _warn_of_unwritable(context)
        return session
    attempt = session.state.attempt + 1
    blocks = [run.name for run in session.state.runs]
    context.journal.say(
        Level.NOTICE, "session taken up", attempt=attempt, recorded=", ".join(blocks) or "nothing"
    )
    return sessions.resume(session, now)


def _warn_of_unwritable(context: SessionContext) -> None:
    """Say before anything moves that this user cannot write the gains: another one may apply them
    after the session.
    """
    try:
        require_replaceable(context)
    except DaqError as error:
        text = f"{error.subject}: {error.found}"
        context.journal.say(Level.WARNING, "this user cannot write the gains", text=text)


def _say_why_new(context: SessionContext, found: tuple[Session, ...], now: datetime) -> None:
    """Say why an unfinished session is not taken up."""
    if not found or found[-1].finished:
        return
    last = found[-1]
    command = ""
    if isinstance(last.state, GuidedState):
        command = fit_corrected_command(context.file, last)
    refit = ""
    if command:
        refit = f". Its blocks are not lost: `{command}` fits them with the present file"
    reason = f"the cell file has changed since{refit}"
    if now - last.began > timedelta(hours=RESUME_WITHIN_H):
        reason = f"it is older than {RESUME_WITHIN_H:g} h"
    context.journal.say(
        Level.WARNING,
        "an unfinished session is not taken up",
        folder=str(last.folder),
        reason=reason,
    )


@dataclass(frozen=True, slots=True)
class CheckLine:
    """One line of the table before a session."""

    name: str  #: what was checked
    text: str  #: what was found; empty where an error says it
    error: DaqError | DriverError | None = None  #: why it did not pass

    @property
    def passed(self) -> bool:
        """Whether a session can begin, as far as this line goes."""
        return self.error is None


def check_readiness(
    context: SessionContext, payload: str | None, block_s: float
) -> tuple[CheckLine, ...]:
    """Check what a session needs, and predict what it can know;
    nothing moves, and nothing is written.
    """
    return (
        _checked(
            "cell file", lambda: f"{len(context.cell.axes)} axes, digest {context.cell.digest[:12]}"
        ),
        _checked("payload", lambda: _payload_text(context.cell, payload)),
        _checked("disk, interlock, drives", lambda: _ready_text(context)),
        _checked("expected precision", lambda: _predicted_text(context, payload, block_s)),
    )


def _checked(name: str, ask: Callable[[], str]) -> CheckLine:
    """Ask, and turn an error into a line."""
    try:
        return CheckLine(name, ask())
    except (DaqError, DriverError) as error:
        return CheckLine(name, "", error)


def payload_for_blocks(cell: Cell, name: str | None) -> WeighedPayload:
    """Return the body for the loaded blocks: the named one, or the only one of the cell.

    Raises:
        ConfigurationInconsistent: the cell has no such body, or several and none was named.
    """
    names = [payload.name for payload in cell.payloads]
    if name is None and len(names) == 1:
        name = names[0]
    for payload in cell.payloads:
        if payload.name == name:
            return payload
    found = "none named"
    if name is not None:
        found = repr(name)
    if names:
        expected = f"one of {', '.join(names)}"
        remedy = "name one of them with --payload"
    else:
        expected = "at least one in `payloads`: its mass is the scale of all gains"
        remedy = "add it to the cell file with its mass"
    raise ConfigurationInconsistent(
        f"payload of cell {cell.name!r}", found=found, expected=expected, remedy=remedy
    )


def _payload_text(cell: Cell, name: str | None) -> str:
    payload = payload_for_blocks(cell, name)
    return f"{payload.name}, {payload.mass_kg:g} kg within {payload.mass_tolerance_kg:g} kg"


def _ready_text(context: SessionContext) -> str:
    there = nearest_existing_folder(context.settings.folder)
    tools = replace(context.tools, free=lambda _: context.tools.free(there))
    quiet = replace(context.journal, stream=StringIO())
    checked = replace(context, tools=tools, journal=quiet, must_write=True)
    before_motion(checked, take_over=False)
    return (
        "free space, files that can be written, history readable, robot released, drives as "
        "declared and without power"
    )


def _predicted_text(context: SessionContext, payload: str | None, block_s: float) -> str:
    if payload not in [one.name for one in context.cell.payloads]:
        payload = None  # the line of the payload says so
    experiment = experiment_of(context.cell, payload)
    plan, _ = plan_with_room(context, experiment, context.settings.seed, block_s)
    predicted = zip(context.cell.axis_names, plan.predicted_std_percent, strict=True)
    listed = ", ".join(f"{axis} {std:.2f} %" for axis, std in predicted)
    return f"predicted σ after one bare and one loaded block: {listed}"
