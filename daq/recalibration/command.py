"""Programs of the cell's own: the interlock's and the mount's."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from daq.configuration.recalibration import Command

TOLD = 400
"""Characters of what a program said that are shown."""


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
            said, _ = process.communicate(timeout=command.timeout_s)
        except subprocess.TimeoutExpired:
            _end(process)
            return Finished(None, f"not ended within {command.timeout_s:g} s")
        except BaseException:
            _end(process)
            raise
    return Finished(process.returncode, said.decode("utf-8", errors="replace").strip()[-TOLD:])


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    if process.stdout is not None:
        process.stdout.close()
