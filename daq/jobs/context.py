"""What the stages of a session share, and the checks before it begins and before it moves anything.

The last of them takes over the drives that a killed recorder has left with power.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from daq.config.cell import Cell, MotionPolicy
from daq.config.recalibration import PlannedRun, Recalibration
from daq.errors import (
    ConfigurationInconsistent,
    DiskSpaceShort,
    JobHeld,
    OutputFailed,
    writing,
)
from daq.files import require_takes_files
from daq.jobs.block_check import BlockFacts, look_at_block, look_at_geometry
from daq.jobs.certificate import renew_certificate
from daq.jobs.gain_target import GainTarget, NetworkMaker
from daq.jobs.journal import Journal, Level
from daq.jobs.operator import Operator
from daq.jobs.session import Session, begun_until
from daq.ledger.audit import try_append
from daq.ledger.ledger import Ledger, read_history
from daq.report.certificate import Certificate
from daq.report.plan_preview import save_preview
from daq.workflow.choices import LARGEST_STD_PERCENT
from daq.workflow.experiment import Experiment
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from daq.workflow.interlock import Runner, release_check, run_command
from daq.workflow.plan import Plan, PlanGoal, TargetBox, plan
from daq.workflow.record import Recorded, RecordingRequest, network_of, record
from daq.workflow.safeguards import FreeBytes, agree, free_bytes
from daq.workflow.validate import Validation, validate
from daq.writeback.file_access import try_writing
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Target, Written, apply, propose
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from drivers.canopen.setup import read_consumers
from drivers.errors import DriveFault, MotionRefused, StateRefused
from drivers.motion.execute import DEFAULT_BOUNDS
from drivers.profiles.cia402 import POWERLESS, Goal, State, decode
from drivers.profiles.profile import Axis
from ident.calibration import Calibration
from ident.discovery.before_after import Account, account
from ident.discovery.evidence import Evidence
from ident.discovery.loop import Step
from ident.errors import Diagnosis

PROGRAM_SINCE = datetime(2026, 1, 1, tzinfo=UTC)
"""No right clock is before this program was made:
a computer without battery begins in 1970, or at an older date.
"""

# A killed recorder cannot remove the power. Its drives watch its heartbeat (1016h) and quick stop
# when it stays away, so a session waits for that. Most drives then remove the power themselves.
# Those that stay in QUICK STOP ACTIVE (605Ah = 5 to 8) or SWITCHED ON lose it here, at standstill,
# with the interlock closed. A drive that watches no killed recorder belongs to another controller:
# it is left alone.

FAULTS = (State.FAULT, State.FAULT_REACTION_ACTIVE)
#: States of power without a motion that a killed recorder leaves
LEFT = (State.QUICK_STOP_ACTIVE, State.SWITCHED_ON)
#: Without power in the motor, and without a request for it
IDLE = (*POWERLESS, State.READY_TO_SWITCH_ON)
#: For the quick stop after a guard has expired; a simulated cell on a busy machine may be that slow
STOP_S = 15.0
ASK_S = 0.1  #: Between two questions for the states
STANDSTILL_S = 0.2  #: Between two readings of a position that must agree
OTHERS = (
    "nothing was changed: end the other controller; if a recorder was killed there, `drivegain "
    "record` takes the drive over, or switch it off and on"
)

Powered = tuple[tuple[Axis, int], ...]  #: Axes with power, and their statuswords


def check_drives(cell: Cell, block_signals: SignalBlocker, take_over: bool) -> None:
    """Check identity and state of every drive; nothing moves.

    Args:
        cell: whose drives these are.
        block_signals: as in `network_of`.
        take_over: remove the power of drives that a killed recorder left with it; else nothing is
            changed.

    Raises:
        DriveFault: one has a fault; to reset it is a person's decision.
        StateRefused: one has power already: another controller drives this robot, or it moves.
        BusBusy: another master commands the bus; nothing was sent.
        DriverError: a drive does not answer, is another one than declared, or the bus has gone.
    """
    with network_of(cell, block_signals) as network:
        # A recorder on another computer is not excluded by the lock of the bus
        network.require_quiet()
        network.check_identities()
        left = _with_power(network)
        if not left:
            return
        _require_ours(network, left)
        left = _wait(network, left)
        _require_stopped(network, left)
        if take_over:
            for axis, _ in left:
                network.disable(axis, Goal.SWITCH_ON_DISABLED)


def _with_power(network: CanopenNetwork) -> Powered:
    """Return the axes with power.

    Raises:
        DriveFault: an axis has a fault.
    """
    found = tuple(zip(network.axes, network.statuswords(), strict=True))
    for axis, statusword in found:
        if (state := decode(statusword)) in FAULTS:
            raise DriveFault(
                axis, f"{state} before the job began; find its cause, then reset it", statusword
            )
    return tuple((axis, statusword) for axis, statusword in found if decode(statusword) not in IDLE)


def _require_ours(network: CanopenNetwork, left: Powered) -> None:
    """Refuse axes that do not watch a recorder which is gone."""
    network.require_quiet()  # also hears the heartbeat of a recorder that is still there
    for axis, statusword in left:
        entries = read_consumers(network.link.objects(axis.node_id)) or ()
        if not any(network.was_ours(value) for _, value in entries):
            raise _refused(axis, statusword, OTHERS)


def _wait(network: CanopenNetwork, left: Powered) -> Powered:
    """Let the guards expire and the axes stop by themselves;
    return those that have power all the same.
    """
    clock = network.link.clock
    end_ns = clock() + network.guard_ms * 10**6 + round(STOP_S * 1e9)
    while left and clock() < end_ns:
        network.link.wait(ASK_S)
        left = _with_power(network)
    return left


def _require_stopped(network: CanopenNetwork, left: Powered) -> None:
    """Refuse axes that are in another state than a killed recorder leaves, or move."""
    axes = [axis for axis, _ in left]
    before = _positions(network, axes)
    network.link.wait(STANDSTILL_S if left else 0.0)
    for (axis, statusword), here, there in zip(
        left, before, _positions(network, axes), strict=True
    ):
        if decode(statusword) not in LEFT:
            raise _refused(axis, statusword, OTHERS)
        if abs(there - here) > DEFAULT_BOUNDS.standstill_counts:
            moves = (
                f"it moves by {abs(there - here)} counts in {STANDSTILL_S:g} s: press the "
                "emergency stop"
            )
            raise _refused(axis, statusword, moves)


def _positions(network: CanopenNetwork, axes: Sequence[Axis]) -> tuple[int, ...]:
    return tuple(network.link.objects(axis.node_id).read(axis.profile.position) for axis in axes)


def _refused(axis: Axis, statusword: int, remedy: str) -> StateRefused:
    return StateRefused(
        axis, "no power before a job begins", str(decode(statusword)), statusword, remedy=remedy
    )


class Planner(Protocol):
    """Makes a plan of a cell."""

    def __call__(
        self,
        cell: Cell,
        /,
        *,
        seed: int,
        duration_s: float,
        speed: float = 1.0,
        largest_condition: float | None = None,
        largest_std_percent: float = LARGEST_STD_PERCENT,
        experiment: Experiment | None = None,
        goal: PlanGoal | None = None,
        box: TargetBox | None = None,
    ) -> Plan:
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


class ChangeWriter(Protocol):
    """Writes what was planned."""

    def __call__(
        self, proposal: Proposal[Any], now: datetime, *, audit: Path, who: str
    ) -> Written | None:
        """As `daq.writeback.target.apply`."""


@dataclass(frozen=True, slots=True)
class Tools:
    """Functions that a job calls; tests replace those whose result they know."""

    #: writes the report of a fit into a folder
    save_report: Callable[[Fit, Account, Calibration, Path], object]
    #: Checks the drives before anything moves, and takes over those of a killed recorder if the
    #: last argument says so.
    drives: Callable[[Cell, SignalBlocker, bool], None] = check_drives
    plan: Planner = plan
    #: writes a page that shows a plan, from its file
    preview: Callable[[Cell, Plan, Path, Path], None] = save_preview
    record: Recorder = record
    #: reads what the log of a block shows
    look: Callable[[Cell, Path, Sequence[Path]], BlockFacts] = look_at_block
    #: judges the described geometry by logs
    geometry: Callable[[Cell, Sequence[Path]], Diagnosis | None] = look_at_geometry
    fit: Fitter = fit
    close_loop: Callable[[Fit, int, Callable[[str], None]], Fit] = close_loop
    calibration: Callable[[Fit, datetime], Calibration] = calibration_of
    account: Callable[[Evidence, Sequence[Step]], Account] = account
    network: NetworkMaker = network_of  #: opens the drives that hold gains
    propose: Callable[[Target[Any], Request], Proposal[Any]] = propose
    apply: ChangeWriter = apply
    #: predicts logs with a calibration
    validate: Callable[[Calibration, Sequence[Path], Cell], tuple[Validation, ...]] = validate
    certify: Callable[[Path, Cell, Calibration, Path, datetime], Certificate] = renew_certificate
    run: Runner = run_command  #: runs a command of the cell
    free: FreeBytes = free_bytes  #: free bytes of a folder's disk
    now: Callable[[], datetime] = lambda: datetime.now(UTC)  #: wall clock with time zone
    monotonic_s: Callable[[], float] = time.monotonic  #: clock for durations [s]


class SessionSettings(Protocol):
    """Limits and places of a session; the cell's `recalibration` has them for a job."""

    @property
    def folder(self) -> Path:
        """Parent of the sessions, each with logs, state and report; absolute."""

    @property
    def warm_up_min(self) -> float:
        """Duration of the moves before the first run, which are not logged [min]."""

    @property
    def retries(self) -> int:
        """Further attempts of a run that its recorder marked invalid."""

    @property
    def min_free_mb(self) -> float:
        """Free space on the disk that is required at the start [MB]."""

    @property
    def seed(self) -> int:
        """Seed of the significance test."""

    @property
    def keep_sessions(self) -> int:
        """Number of ended sessions whose logs are kept."""

    @property
    def metrics(self) -> Path | None:
        """Folder of Prometheus' textfile collector, None without one."""


@dataclass(frozen=True, slots=True)
class NextRun:
    """The next recording of a session."""

    planned: PlannedRun  #: its name and payload
    plan: Plan  #: its moves


class Schedule(Protocol):
    """Which runs a session consists of: those of the cell file,
    or blocks until every gain is precise.
    """

    def prepare(self, context: SessionContext, session: Session) -> Session:
        """Make what the first runs need, before anything moves."""

    def runs(self, session: Session) -> tuple[PlannedRun, ...]:
        """Return the runs that are known so far, recorded or not, in their order."""

    def is_complete(self, session: Session) -> bool:
        """Whether nothing is left to record; the recorded runs of the session are verified."""

    def next_run(self, context: SessionContext, session: Session) -> tuple[Session, NextRun | None]:
        """Decide the next run; None where the session has what it needs.

        The decision is in the session's state.

        Args:
            context: of the session.
            session: its recorded runs are verified.
        """

    def after_run(self, context: SessionContext, session: Session) -> Session:
        """Judge what was recorded so far."""


@dataclass(frozen=True, slots=True)
class SessionContext:
    """Everything that the stages of a session share."""

    file: Path  #: cell file
    cell: Cell  #: read from it
    settings: SessionSettings  #: limits and places of the session
    schedule: Schedule  #: which runs it consists of
    operator: Operator  #: who mounts, permits motion and approves
    target: GainTarget  #: place that the gains are compared with and written to
    tools: Tools  #: functions that the stages call
    journal: Journal  #: log of the session, labelled with session and stage
    began_s: float = 0.0  #: start on the monotonic clock [s]
    block_signals: SignalBlocker = nullcontext  #: keeps signals away while the axes are stopped
    #: Whether the gains are lost work if this session cannot write them: those of a job that
    #: writes. Another person may apply those of a guided session, or of a job that only proposes.
    must_write: bool = False

    @property
    def who(self) -> str:
        """Name of the operator in audit and logs."""
        return self.operator.who

    def opened_target(self) -> AbstractContextManager[Target[Any]]:
        """Open the place of the gains; see `GainTarget.opened`."""
        return self.target.opened(self.tools.network, self.block_signals)

    def content_sha256(self, calibration: Calibration) -> str | None:
        """Return the SHA-256 of what is in the place of the gains now;
        see `GainTarget.content_sha256`.
        """
        return self.target.content_sha256(calibration, self.tools.network, self.block_signals)

    @property
    def ledger(self) -> Ledger:
        """The ledger of the cell."""
        place = self.target.history
        return Ledger(self.cell, place.audit, place.store)

    def within(self, stage: str) -> SessionContext:
        """The same context, with a journal that names the stage."""
        return replace(self, journal=replace(self.journal, step=stage))


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
            expected = f"one of the cell's payloads: {', '.join(payloads) or 'there are none'}"
            raise ConfigurationInconsistent(
                f"recalibration.runs[{index}].payload",
                found=repr(run.payload),
                expected=expected,
                remedy="correct the cell file",
            )
        if not agree(run.mass_kg, payload.mass_kg, payload.mass_tolerance_kg):
            raise ConfigurationInconsistent(
                f"recalibration.runs[{index}].mass_kg",
                found=f"{run.mass_kg:g} kg",
                expected=f"{payload.mass_kg:g} kg ± {payload.mass_tolerance_kg:g} kg, as "
                f"`payloads` has {run.payload}",
                remedy="weigh the payload again: its mass is in every gain",
            )
    if cell.motion is not MotionPolicy.ALLOWED:
        raise MotionRefused(
            f"`policy: {{motion: {cell.motion.value}}}` for a job that moves the robot without "
            "an operator",
            expected="`policy: {motion: allowed}` in the cell file",
            remedy="nothing has moved; whoever answers for the cell writes it there, or a person "
            "records with `drivegain record`",
        )
    return cell.recalibration


def sessions_that_count(
    found: tuple[Session, ...], now: datetime, journal: Journal
) -> tuple[Session, ...]:
    """Return the sessions of the past, and say those that were made under a later date.

    A date that was wrong once must not hold every job until that day comes. The session is left as
    it is, for a person.

    Raises:
        JobHeld: the clock is before this program was made, so it is the clock that is wrong.
    """
    if now < PROGRAM_SINCE:
        raise JobHeld(
            "the clock of this computer",
            found=now.isoformat(timespec="seconds"),
            expected=f"a time after {PROGRAM_SINCE:%Y-%m-%d}, when this program was made",
            remedy="nothing was begun; set the clock (`timedatectl`): ages of calibrations, names "
            "of folders, history and audit log depend on it",
        )
    counted = begun_until(found, now)
    for session in found:
        if session in counted:
            continue
        text = (
            f"found {session.folder}, begun {session.state.began}; expected a time before now, "
            f"{now.isoformat(timespec='seconds')}; it counts neither for what is due nor as the "
            "last calibration, and is not continued. If it was made under a wrong date, move the "
            "folder away once its logs are not needed; if the clock is behind now, set it "
            "(`timedatectl`)"
        )
        journal.say(
            Level.WARNING,
            "a session from the future does not count",
            text=text,
            folder=str(session.folder),
        )
    return counted


def _require_own_history(context: SessionContext) -> None:
    """Refuse a session whose calibration its history cannot take.

    Raises:
        JobHeld: the cell has another name now, or its history is of another robot with its name.
        HistoryUnreadable, AuditUnusable: see `read_history`.
    """
    history = read_history(context.ledger)
    name = context.cell.name
    if history.renamed is not None:
        raise JobHeld(
            f"cell {name!r}",
            found=f"a robot that was renamed to {history.renamed.new!r} at {history.renamed.at}",
            expected="a cell file with its present name",
            remedy=f"nothing has moved; {history.renamed.remedy}; then make the schedule again "
            "(`drivegain schedule`)",
        )
    if history.other_robots:
        raise JobHeld(
            str(context.ledger.audit),
            found=str(history.other_robots[0]),
            expected="a history of one robot",
            remedy="nothing has moved; give the cell file of that robot, or name another audit log "
            "for this one (`history.audit` of the cell file)",
        )
    for other in history.possible_names:
        text = (
            f"found calibrations of cell {other!r} in the audit log, of a robot with the same "
            f"joints and drives, and none of {name!r}; if this is that robot under a new name, "
            f"`drivegain history {context.file} --rename {other}` takes its history and sessions "
            "over"
        )
        context.journal.say(Level.WARNING, "the cell may have been renamed", text=text)


def nearest_existing_folder(folder: Path) -> Path:
    """Return a folder, or the nearest one above it that is there."""
    folders = (folder, *folder.parents)
    return next(path for path in folders if path.is_dir())


def require_writable(context: SessionContext) -> None:
    """Check that the session can write what it will write after the recordings:
    its folder, the audit log, and the controller's file if it must write the gains.

    What it makes to try that is removed again.

    Raises:
        OutputFailed, AuditUnusable, ControllerUnfit: it cannot; nothing has moved.
    """
    folder = context.settings.folder
    with _reporting_refusals(folder, "a folder for sessions that this user may write"):
        require_takes_files(nearest_existing_folder(folder))
    audit = context.target.history.audit
    with _reporting_refusals(audit, "an audit log that this user may write"):
        try_append(audit)
    if context.must_write:
        require_replaceable(context)


def require_replaceable(context: SessionContext) -> None:
    """Check that this user can replace the controller's file; gains in drives have none.

    Raises:
        OutputFailed, ControllerUnfit: the file cannot be replaced; nothing has moved.
    """
    file = context.target.file
    if file is None:
        return
    with _reporting_refusals(file, "a controller's file that this session can replace"):
        try_writing(file, context.tools.now())


@contextmanager
def _reporting_refusals(place: Path, expected: str) -> Iterator[None]:
    """Report a refusal of the file system in the block, before anything moves.

    Raises:
        OutputFailed: it refuses.
    """
    try:
        yield
    except OSError as error:
        missing = OutputFailed.of_missing_folder(place, error)
        if missing is not None:
            raise missing from error
        refused = OutputFailed.of(place, error, state="nothing has moved")
        found = refused.found
        failing_path = error.filename
        if failing_path is not None and str(failing_path) != str(place):
            found = f"{failing_path}: {found}"
        raise OutputFailed(
            refused.subject,
            found=found,
            expected=expected,
            remedy=refused.remedy,
        ) from error


def before_motion(context: SessionContext, *, take_over: bool = True) -> None:
    """Check disk space, places to write to, history, interlock and drives.

    Args:
        context: of the job.
        take_over: remove the power of drives that a killed recorder left with it; else nothing is
            changed.

    Raises:
        DiskSpaceShort, JobHeld, HistoryUnreadable, AuditUnusable, NotReleased, DriverError: nothing
            has moved.
        OutputFailed: the session's folder is gone; or as `require_writable`.
        ControllerUnfit: as `require_writable`.
    """
    settings = context.settings
    tools = context.tools
    with writing(settings.folder):
        free_mb = tools.free(settings.folder) / 1e6
    if free_mb < settings.min_free_mb:
        raise DiskSpaceShort(
            str(settings.folder),
            found=f"{free_mb:.0f} MB free",
            expected=f"{settings.min_free_mb:g} MB (min_free_mb)",
            remedy="nothing has moved; free space, keep fewer sessions, or name a folder on "
            "another disk",
        )
    # What is wrong with it is better known now than after the recordings.
    require_writable(context)
    # The new gains are compared with the history.
    _require_own_history(context)
    release_check(context.cell, tools.now, tools.run)()
    context.journal.say(Level.INFO, "the interlock lets the robot move", free_mb=round(free_mb))
    tools.drives(context.cell, context.block_signals, take_over)
    context.journal.say(Level.INFO, "drives are as declared, without fault and without power")
