"""Whether the cell lets the robot move: its interlock, asked anew before every motion."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from daq.configuration.recalibration import Interlock, InterlockFile, PlannedRun, Recalibration
from daq.errors import MountFailed, NotReleased
from daq.recalibration.command import Runner

NOTHING = "none"
"""What the mount command is told where a run is without load."""
_LOOK_BYTES = 4096


def require_release(interlock: Interlock, run: Runner, now: Callable[[], datetime], folder: Path) -> None:
    """Go on only where the interlock says so; a program that cannot run and a file that cannot be read say no.

    Args:
        interlock: of the cell.
        run: runs its command.
        now: wall clock, asked when the file is: the command before it may take its time.
        folder: in which the command runs.

    Raises:
        NotReleased: it does not let the robot move.
    """
    if interlock.command is not None:
        ended = run(interlock.command, (), folder)
        if ended.code != 0:
            raise _held(f"interlock command {interlock.command.arguments[0]}", str(ended), "exit code 0")
    if interlock.file is not None:
        _require_file(interlock.file, now)


def mount(section: Recalibration, planned: PlannedRun, run: Runner) -> None:
    """Have the payload of a run mounted, or none; asked before every run, also where nothing changes.

    Raises:
        MountFailed: the command did not end with 0, in its time.
    """
    wanted = planned.payload or NOTHING
    ended = run(section.mount, (wanted,), section.working_folder)
    if ended.code != 0:
        raise MountFailed(
            f"mount command {section.mount.arguments[0]} {wanted}",
            found=str(ended),
            expected="exit code 0: it is mounted as the run needs it",
            remedy=f"mount {wanted} by hand or see to the changer; the next job goes on with run {planned.name}",
        )


def _require_file(file: InterlockFile, now: Callable[[], datetime]) -> None:
    subject = f"interlock file {file.path}"
    expected = f"{file.says!r} in its first line, written within the last {file.max_age_s:g} s"
    try:
        # A FIFO of that name must not keep us waiting for its other end.
        descriptor = os.open(file.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            # Of the file that is open: a gateway may put another in its place meanwhile.
            found, asked = os.fstat(descriptor), now()
            if not stat.S_ISREG(found.st_mode):
                raise _held(subject, "no regular file", expected)
            head = os.read(descriptor, _LOOK_BYTES)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise _held(subject, (error.strerror or type(error).__name__).lower(), expected) from error
    says = head.decode("utf-8", errors="replace").partition("\n")[0].strip()
    if says != file.says:
        raise _held(subject, repr(says[:80]), expected)
    age_s = asked.timestamp() - found.st_mtime
    # One from the future is of another clock: how old it is, nobody knows.
    if not -file.max_age_s <= age_s <= file.max_age_s:
        raise _held(subject, f"an age of {age_s:.0f} s", expected)


def _held(subject: str, found: str, expected: str) -> NotReleased:
    return NotReleased(
        subject,
        found=found,
        expected=expected,
        remedy="nothing moves: close the cell, leave nobody inside, set automatic mode; the next job takes it up",
    )
