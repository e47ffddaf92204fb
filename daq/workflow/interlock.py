"""The interlock of a cell, which may hold back a motion as the drives may,
and the commands that a cell file names.
"""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path

from daq.config.cell import Cell
from daq.config.recalibration import Command, Interlock
from daq.errors import NotReleased, reason_of
from daq.files import open_regular

MAX_OUTPUT_CHARACTERS = 400  #: Characters of what a program said that are shown
_KEPT_BYTES = 4 * MAX_OUTPUT_CHARACTERS  #: As many as those characters may take in UTF-8
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class Finished:
    """How a program ended."""

    #: exit code; negative for the signal that ended it; None where it never ran, or ran too long
    code: int | None
    said: str  #: the end of what it said, or why it did not run

    def __str__(self) -> str:
        ended = "no exit code" if self.code is None else f"exit code {self.code}"
        if not self.said:
            return ended
        return f"{ended} ({self.said})"


#: Runs a command with further arguments in a folder
Runner = Callable[[Command, tuple[str, ...], Path], Finished]


def run_command(command: Command, further: tuple[str, ...], folder: Path) -> Finished:
    """Run a program to its end, without a shell and without our input.

    It has a session of its own: a Ctrl-C that stops us does not end it half-way unasked, and when
    it takes too long, or we are interrupted, all that it started is ended with it.
    """
    try:
        process = subprocess.Popen(
            (*command.command, *further),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except OSError as error:
        return Finished(None, f"{command.command[0]}: {reason_of(error)}")
    with process:
        try:
            said = _said(process, command.timeout_s)
        except BaseException as error:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if process.stdout is not None:
                process.stdout.close()
            if isinstance(error, subprocess.TimeoutExpired):
                return Finished(None, f"not ended within {command.timeout_s:g} s")
            raise
    text = said.decode("utf-8", errors="replace").strip()
    return Finished(process.returncode, text[-MAX_OUTPUT_CHARACTERS:])


def _said(process: subprocess.Popen[bytes], timeout_s: float) -> bytes:
    """The end of what a program says until it has ended; the rest of it is read, and not kept."""
    assert process.stdout is not None
    ends_s = time.monotonic() + timeout_s
    said = b""
    with selectors.DefaultSelector() as output:
        output.register(process.stdout, selectors.EVENT_READ)
        while (left_s := ends_s - time.monotonic()) > 0:
            if not output.select(left_s):
                continue
            piece = os.read(process.stdout.fileno(), _READ_BYTES)
            if not piece:
                process.wait(max(0.0, ends_s - time.monotonic()))
                return said
            said = (said + piece)[-_KEPT_BYTES:]
    raise subprocess.TimeoutExpired(process.args, timeout_s)


_LOOK_BYTES = 4096


def release_check(
    cell: Cell, now: Callable[[], datetime], run: Runner = run_command
) -> Callable[[], None]:
    """Return the check that the interlock of a cell releases the robot;
    it does nothing where the cell declares none.

    Args:
        cell: from its file; the interlock is in its `recalibration`.
        now: wall clock with time zone.
        run: runs a command of the cell.
    """
    section = cell.recalibration
    if section is None:
        return lambda: None
    return partial(require_release, section.interlock, run, now, section.working_folder)


def require_release(
    interlock: Interlock, run: Runner, now: Callable[[], datetime], folder: Path
) -> None:
    """Check that the interlock releases the robot;
    a program that fails and a file that is unreadable do not.

    Args:
        now: wall clock, asked when the file is: the command before it may take its time.

    Raises:
        NotReleased: it does not release the robot.
    """
    if interlock.command is not None:
        ended = run(Command(interlock.command, interlock.timeout_s), (), folder)
        if ended.code != 0:
            raise _held(f"interlock command {interlock.command[0]}", str(ended), "exit code 0")
    if interlock.file is not None:
        _require_file(interlock.file, interlock, now)


def _require_file(file: Path, interlock: Interlock, now: Callable[[], datetime]) -> None:
    subject = f"interlock file {file}"
    expected = (
        f"{interlock.says!r} in its first line, written within the last {interlock.max_age_s:g} s"
    )
    try:
        with open_regular(file) as stream:
            # Of the file that is open: a gateway may put another in its place meanwhile.
            found = os.fstat(stream.fileno())
            asked = now()
            head = stream.read(_LOOK_BYTES)
    except OSError as error:
        raise _held(subject, reason_of(error), expected) from error
    says = head.decode("utf-8", errors="replace").partition("\n")[0].strip()
    if says != interlock.says:
        raise _held(subject, repr(says[:80]), expected)
    age_s = asked.timestamp() - found.st_mtime
    # A time in the future is of another clock: the age is unknown.
    if not -interlock.max_age_s <= age_s <= interlock.max_age_s:
        raise _held(subject, f"an age of {age_s:.0f} s", expected)


def _held(subject: str, found: str, expected: str) -> NotReleased:
    return NotReleased(
        subject,
        found=found,
        expected=expected,
        remedy="nothing moves: close the cell, let everyone leave it and set automatic mode, then "
        "start again; a job goes on where it ended",
    )
