"""Context of a recalibration job, and the checks before it begins and before it moves anything."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

from daq.config.cell import Cell, MotionPolicy
from daq.config.controller import Controller
from daq.config.policy import HistoryPlace
from daq.config.recalibration import Recalibration
from daq.errors import ConfigurationInconsistent, DiskSpaceShort, JobHeld, writing
from daq.jobs.drives import check_drives
from daq.jobs.journal import Journal, Level
from daq.jobs.session import Session
from daq.ledger.ledger import Ledger, read_history
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from daq.workflow.interlock import Runner, release_check, run_command
from daq.workflow.plan import Plan, plan
from daq.workflow.record import Recorded, RecordingRequest, record
from daq.workflow.safeguards import FreeBytes, agree, free_bytes
from daq.writeback.file_access import resolve_links
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Written, apply, propose
from drivers.canopen.network import SignalBlocker
from drivers.errors import MotionRefused
from ident.calibration import Calibration
from ident.discovery.before_after import Account, account
from ident.discovery.evidence import Evidence
from ident.discovery.loop import Step

CLOCK_SLACK = timedelta(minutes=1)  #: A time service sets a clock back by less


class Planner(Protocol):
    """Makes a plan of a cell."""

    def __call__(self, cell: Cell, *, seed: int, duration_s: float) -> Plan:
        """As `daq.workflow.plan.plan`."""


class Recorder(Protocol):
    """Records a run; the axes move."""

    def __call__(
        self,
        request: RecordingRequest,
        *,
        free: FreeBytes,
        block_signals: SignalBlocker,
        require_released: Callable[[], None],
    ) -> Recorded:
        """As `daq.workflow.record.record`."""


class Fitter(Protocol):
    """Fits the logs of a session."""

    def __call__(self, logs: Sequence[Path], *, holdout: Sequence[Path]) -> Fit:
        """As `daq.workflow.fit.fit`."""


class LoopCloser(Protocol):
    """Adds the effects that a fit lacks."""

    def __call__(self, start: Fit, seed: int, progress: Callable[[str], None]) -> Fit:
        """As `daq.workflow.fit.close_loop`."""


class Proposer(Protocol):
    """Plans a write to a controller's file."""

    def __call__(self, target: FileTarget, request: Request) -> Proposal[FileEdit]:
        """As `daq.writeback.target.propose`."""


class ChangeWriter(Protocol):
    """Writes what was planned."""

    def __call__(self, proposal: Proposal[FileEdit], now: datetime, *, audit: Path, who: str) -> Written | None:
        """As `daq.writeback.target.apply`."""


@dataclass(frozen=True, slots=True)
class Tools:
    """Functions that a job calls; tests replace those whose result they know."""

    save_report: Callable[[Fit, Account, Calibration, Path], None]  #: writes the report of a fit into a folder
    #: Checks the drives before anything moves, and takes over those of a killed recorder if the last argument says so.
    drives: Callable[[Cell, SignalBlocker, bool], None] = check_drives
    plan: Planner = plan
    record: Recorder = record
    fit: Fitter = fit
    close_loop: LoopCloser = close_loop
    calibration: Callable[[Fit, datetime], Calibration] = calibration_of
    account: Callable[[Evidence, Sequence[Step]], Account] = account
    propose: Proposer = propose
    apply: ChangeWriter = apply
    run: Runner = run_command  #: runs a command of the cell
    free: FreeBytes = free_bytes  #: free bytes of a folder's disk
    now: Callable[[], datetime] = lambda: datetime.now(UTC)  #: wall clock with time zone
    monotonic_s: Callable[[], float] = time.monotonic  #: clock for durations [s]


@dataclass(frozen=True, slots=True)
class GainTarget:
    """Controller file that a job writes, and the history of its cell."""

    controller: Controller  #: its declaration in the cell file
    file: Path  #: absolute path
    history: HistoryPlace  #: files of history and audit


@dataclass(frozen=True, slots=True)
class JobContext:
    """Everything that the steps of a job share."""

    file: Path  #: cell file
    cell: Cell  #: read from it
    section: Recalibration  #: its `recalibration`
    target: GainTarget  #: controller file that the gains are compared with and written to
    tools: Tools  #: functions that the job calls
    journal: Journal  #: log of the job, labelled with session and step
    who: str  #: name of the job in audit and logs
    began_s: float = 0.0  #: start of the job on the monotonic clock [s]
    block_signals: SignalBlocker = nullcontext  #: keeps signals away while the axes are stopped

    @property
    def ledger(self) -> Ledger:
        """The ledger of the cell."""
        place = self.target.history
        return Ledger(self.cell, place.audit, place.store)

    def within(self, step: str) -> JobContext:
        """The same context, with a journal that names the step."""
        return replace(self, journal=replace(self.journal, step=step))


def target_of(cell: Cell) -> GainTarget:
    """Find the controller file of a cell.

    Raises:
        ConfigurationInconsistent: the cell names no controller file.
        ControllerUnfit: it is a symbolic link that a write would not follow (`daq.writeback.file_access`).
    """
    file = cell.controller_path
    if cell.controller is None or file is None or cell.history is None:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}: controller",
            found="no file",
            expected="a controller's file: a job compares its gains with those in it",
            remedy="name it in the cell file; what is kept in drives alone is recorded and applied by hand",
        )
    resolve_links(file)  # refused now, not after an hour of recordings
    return GainTarget(cell.controller, file, cell.history)


def section_of(cell: Cell) -> Recalibration:
    """Return the cell's `recalibration`, checked against the rest of the cell file.

    Raises:
        ConfigurationInconsistent: there is none, or a run's payload differs from the cell's.
        MotionRefused: the cell's policy does not allow motion without an operator.
    """
    if cell.recalibration is None:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}",
            found="no `recalibration`",
            expected="its runs, its interlock and how payloads are mounted",
            remedy="complete the cell file, as in docs/how-to/schedule-recalibration.md",
        )
    payloads = {payload.name: payload for payload in cell.payloads}
    for index, run in enumerate(cell.recalibration.runs):
        if run.payload is None or run.mass_kg is None:
            continue
        payload = payloads.get(run.payload)
        if payload is None:
            raise ConfigurationInconsistent(
                f"recalibration.runs[{index}].payload",
                found=repr(run.payload),
                expected=f"one of the cell's payloads: {', '.join(payloads) or 'there are none'}",
                remedy="correct the cell file",
            )
        if not agree(run.mass_kg, payload.mass_kg, payload.mass_tolerance_kg):
            raise ConfigurationInconsistent(
                f"recalibration.runs[{index}].mass_kg",
                found=f"{run.mass_kg:g} kg",
                expected=f"{payload.mass_kg:g} kg ± {payload.mass_tolerance_kg:g} kg, as `payloads` has {run.payload}",
                remedy="weigh the payload again: its mass is in every gain",
            )
    if cell.motion is not MotionPolicy.ALLOWED:
        raise MotionRefused(
            f"`policy: {{motion: {cell.motion.value}}}` for a job that moves the robot without an operator",
            expected="`policy: {motion: allowed}` in the cell file",
            remedy="nothing has moved; whoever answers for the cell writes it there, or a person records with "
            "`drivegain record`",
        )
    return cell.recalibration


def require_clock(found: tuple[Session, ...], now: datetime) -> None:
    """Check that the clock is not behind the times of the recorded sessions.

    Raises:
        JobHeld: the clock is behind the newest session.
    """
    last = max(found, key=lambda session: session.last_written, default=None)
    if last is not None and now + CLOCK_SLACK < last.last_written:
        raise JobHeld(
            "the clock of this computer",
            found=now.isoformat(timespec="seconds"),
            expected=f"a time after {last.last_written.isoformat(timespec='seconds')}, found in {last.folder}",
            remedy="set the clock (`timedatectl`), or where it is right, move that folder away: it was made by a wrong "
            "one; ages, history and audit would be in the wrong order",
        )


def before_motion(context: JobContext, *, take_over: bool = True) -> None:
    """Check disk space, history, interlock and drives.

    Args:
        context: of the job.
        take_over: remove the power of drives that a killed recorder left with it; else nothing is changed.

    Raises:
        DiskSpaceShort, HistoryUnreadable, AuditUnusable, NotReleased, DriverError: nothing has moved.
        OutputFailed: the session's folder is gone.
    """
    section, tools = context.section, context.tools
    with writing(section.folder):
        free_mb = tools.free(section.folder) / 1e6
    if free_mb < section.min_free_mb:
        raise DiskSpaceShort(
            str(section.folder),
            found=f"{free_mb:.0f} MB free",
            expected=f"{section.min_free_mb:g} MB (min_free_mb)",
            remedy="nothing has moved; free space, keep fewer sessions, or name a folder on another disk",
        )
    read_history(context.ledger)  # the gains are compared with it: unreadable now is better than after the recordings
    release_check(context.cell, tools.now, tools.run)()
    context.journal.say(Level.INFO, "the interlock lets the robot move", free_mb=round(free_mb))
    tools.drives(context.cell, context.block_signals, take_over)
    context.journal.say(Level.INFO, "drives are as declared, without fault and without power")
