"""Where a verb may write: never over what it was given, nor over a file of another kind; and what it says of it."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType, TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from daq.cli.verb import printable
from daq.errors import UsageError
from drivers.canopen.network import SignalBlocker

_LOOK_BYTES = 4096


def check_output(out: Path | None, inputs: Iterable[Path], format_: str) -> None:
    """Refuse an output that would destroy something.

    Args:
        out: file to write, None where nothing is written.
        inputs: files that the verb reads.
        format_: what the first lines of a file of the same kind say (``format: …``); such a file may be replaced.

    Raises:
        UsageError: it is one of the inputs, or a file of another kind.
    """
    if out is None or not out.exists():
        return
    if any(given.exists() and out.samefile(given) for given in inputs):
        raise UsageError(
            str(out), found="one of the files to read", expected="a name of its own", remedy="choose another name"
        )
    if not out.is_file() or f"format: {format_}".encode() not in _head(out):
        raise UsageError(
            str(out),
            found="something that is no " + format_,
            expected="no file, or an earlier one of the same kind",
            remedy="choose another name, or move it away",
        )


def say_written(console: Console, *paths: Path | None) -> None:
    """Tell what was written, a line each, as the last thing that a verb says.

    Args:
        console: for a person.
        paths: files and folders; None for what nobody asked for.
    """
    for path in paths:
        if path is not None:
            name = f"{path}/" if path.is_dir() else str(path)
            console.print(f"Written: {printable(name)}", markup=False, highlight=False)


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_LOOK_BYTES)


# Progress of long work, on stderr: stdout is for results.


ProgressCallback = Callable[[int, int, str], None]
"""Done, total, and a remark."""


class Stepper:
    """A bar for each of several steps, one after the other; a context manager."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("{task.fields[remark]}", style="dim"),
        )
        self._bars = Progress(*columns, console=Console(stderr=True), refresh_per_second=5)
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self._end()
        self._bars.stop()

    def step(self, title: str) -> None:
        """End the step before, and begin another."""
        self._end()
        self._task = self._bars.add_task(title, total=None, remark="")

    def progress(self, done: int, total: int, remark: str) -> None:
        """Within the step; a total of 0 is not known."""
        if self._task is not None:
            of = f"{done}/{total} " if total else ""
            self._bars.update(self._task, completed=done, total=total or None, remark=of + remark)

    def _end(self) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=1, total=1)
            self._bars.stop_task(self._task)


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressCallback]:
    """One bar."""
    with Stepper() as stepper:
        stepper.step(title)
        yield stepper.progress


@contextmanager
def status(title: str) -> Iterator[Callable[[str], None]]:
    """A spinner for work whose length nobody knows; every step it is told is a line."""
    console = Console(stderr=True, highlight=False)
    with console.status(title):

        def show_step(step: str) -> None:
            console.print(f"  {step}", style="dim")

        yield show_step


# Being told to stop while a robot moves: by Ctrl-C, by a service manager (SIGTERM), by a terminal that has gone.


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE_S = 10.0
"""Longer than a stop of all axes takes."""


@contextmanager
def interruptible(
    clock: Callable[[], float] = time.monotonic, signals: tuple[signal.Signals, ...] = SIGNALS
) -> Iterator[SignalBlocker]:
    """Turn some signals within the block into KeyboardInterrupt; pass over those that follow too soon.

    By default SIGTERM and SIGHUP end a process at once, and the axes would go on; a shell script starts what it puts
    into the background (&) deaf to SIGINT, and only a handler of its own makes it hear again. What follows the first
    signal is the stop of the axes: a second one, of an impatient person, must not cut that short. Later ones count
    again, so that nobody is left without a way out. A stop that a fault began is protected as long by whoever makes it,
    with what is yielded; a signal that comes meanwhile is dropped, for it asks for what is being done. In another
    thread than the main one nothing changes: Python handles no signals there.

    Args:
        clock: monotonic time [s].
        signals: those that interrupt.
    """
    if threading.current_thread() is not threading.main_thread():
        yield nullcontext
        return

    blocked_until_s = float("-inf")

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal blocked_until_s
        if clock() >= blocked_until_s:
            blocked_until_s = clock() + GRACE_S
            raise KeyboardInterrupt

    @contextmanager
    def block_signals() -> Iterator[None]:
        nonlocal blocked_until_s
        earlier_s, blocked_until_s = blocked_until_s, max(blocked_until_s, clock() + GRACE_S)
        try:
            yield
        finally:
            blocked_until_s = earlier_s

    before = [(number, signal.signal(number, interrupt)) for number in signals]
    try:
        yield block_signals
    finally:
        for number, handler in before:
            signal.signal(number, handler)
