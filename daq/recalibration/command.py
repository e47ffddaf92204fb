"""Programs of the cell's own: the interlock's and the mount's."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from daq.configuration.recalibration import Command

TOLD = 400
"""Characters of what a program said that are shown."""
_KEPT_BYTES = 4 * TOLD
"""As many as those characters may take in UTF-8."""
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class Finished:
    """How a program ended.

    Attributes:
        code: exit code; negative for the signal that ended it; None where it never ran, or ran too long.
        said: the end of what it said, or why it did not run.
    """

    code: int | None
    said: str

    def __str__(self) -> str:
        ended = "no exit code" if self.code is None else f"exit code {self.code}"
        return f"{ended}{f' ({self.said})' if self.said else ''}"


Runner = Callable[[Command, tuple[str, ...], Path], Finished]
"""Runs a command with further arguments in a folder."""


def run_command(command: Command, further: tuple[str, ...], folder: Path) -> Finished:
    """Run a program to its end, without a shell and without our input.

    It has a session of its own: a Ctrl-C that stops us does not end it half-way unasked, and when it takes too long, or
    we are interrupted, all that it started is ended with it.

    Args:
        command: program, arguments, and how long it may take.
        further: arguments behind those.
        folder: in which it runs.
    """
    try:
        process = subprocess.Popen(
            (*command.arguments, *further),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except OSError as error:
        return Finished(None, f"{command.arguments[0]}: {(error.strerror or type(error).__name__).lower()}")
    with process:
        try:
            said = _said(process, command.timeout_s)
        except subprocess.TimeoutExpired:
            _end(process)
            return Finished(None, f"not ended within {command.timeout_s:g} s")
        except BaseException:
            _end(process)
            raise
    return Finished(process.returncode, said.decode("utf-8", errors="replace").strip()[-TOLD:])


def _said(process: subprocess.Popen[bytes], timeout_s: float) -> bytes:
    """The end of what a program says until it has ended; the rest of it is read, and not kept.

    Raises:
        subprocess.TimeoutExpired: it takes longer.
    """
    assert process.stdout is not None
    ends_s, said = time.monotonic() + timeout_s, b""
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


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    if process.stdout is not None:
        process.stdout.close()
