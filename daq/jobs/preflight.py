"""What must hold before a job begins, and before it moves anything."""

from __future__ import annotations

from datetime import datetime, timedelta

from daq.config.cell import Cell, MotionPolicy
from daq.config.recalibration import Recalibration
from daq.errors import ConfigurationInconsistent, DiskSpaceShort, JobHeld, OutputFailed
from daq.jobs.interlock import require_release
from daq.jobs.journal import Journal, Level
from daq.jobs.recording import GainTarget, JobContext
from daq.jobs.session import Session, last_good
from daq.ledger.store import HistoryStore
from daq.workflow.safeguards import agree
from daq.writeback.file_access import resolve_links
from drivers.errors import MotionRefused

CLOCK_SLACK = timedelta(minutes=1)
"""A time service sets a clock back by less."""


def target_of(cell: Cell) -> GainTarget:
    """What a job compares its gains with.

    Raises:
        ConfigurationInconsistent: the cell names no file of a controller.
        ControllerUnfit: its name is a symbolic link that a write would not follow (`daq.writeback.file_access`).
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
    """What the cell file says of its scheduled job, after it was compared with the rest of the file.

    Raises:
        ConfigurationInconsistent: there is none, or a run's payload is not the cell's.
        MotionRefused: the cell's policy does not allow a motion that nobody asked for.
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
            "a scheduled job moves the robot when nobody asks for it: nothing moves unless the cell file says "
            "`policy: {motion: allowed}`"
        )
    return cell.recalibration


def require_clock(found: tuple[Session, ...], now: datetime) -> None:
    """Refuse to write times that lie before those that are written down.

    Raises:
        JobHeld: the clock is behind the newest session.
    """
    last = max(found, key=lambda session: session.last_written, default=None)
    if last is not None and now + CLOCK_SLACK < last.last_written:
        raise JobHeld(
            "the clock of this computer",
            found=now.isoformat(timespec="seconds"),
            expected=f"a time after {last.last_written.isoformat(timespec='seconds')}, which stands in {last.folder}",
            remedy="set the clock (`timedatectl`), or where it is right, move that folder away: it was made by a wrong "
            "one; ages, history and audit would be in the wrong order",
        )


def due_in(found: tuple[Session, ...], every_h: float, now: datetime) -> timedelta:
    """Time until the next calibration is due, counted from the begin of the last good one; not positive when it is."""
    good = last_good(found)
    return timedelta(0) if good is None else good.began + timedelta(hours=every_h) - now


def before_motion(context: JobContext, journal: Journal) -> None:
    """Room on the disk, the history, the interlock, and the drives.

    Raises:
        HistoryUnreadable: what the gains would be compared with; nothing has moved.
        DiskSpaceShort, NotReleased, DriverError: nothing has moved.
        OutputFailed: the session's folder has gone.
    """
    section = context.section
    try:
        free_mb = context.tools.free(section.folder) / 1e6
    except OSError as error:
        raise OutputFailed.of(section.folder, error) from error
    if free_mb < section.min_free_mb:
        raise DiskSpaceShort(
            str(section.folder),
            found=f"{free_mb:.0f} MB free",
            expected=f"{section.min_free_mb:g} MB (min_free_mb)",
            remedy="nothing has moved; free space, keep fewer sessions, or name a folder on another disk",
        )
    with HistoryStore(context.target.history.store) as store:
        store.entries()
    require_release(section.interlock, context.tools.run, context.tools.now, section.working_folder)
    journal.say(Level.INFO, "the interlock lets the robot move", free_mb=round(free_mb))
    context.tools.drives(context.cell, context.block_signals)
    journal.say(Level.INFO, "drives are as declared, without fault and without power")
