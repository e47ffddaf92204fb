"""The terminal of a verb: output files that are not overwritten by accident, progress, views,
and Ctrl-C.
"""

from __future__ import annotations

import os
import shutil
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console, RenderableType
from rich.text import Text

from daq.cli.output import release_results
from daq.cli.verb import judged_output
from daq.errors import OutputFailed, UsageError, first_few, writing
from daq.files import is_taken, replace_file, what_has_name
from daq.report.text import break_lines, terminal_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from daq.cli.patient_live import PatientProgress
    from drivers.canopen.network import SignalBlocker

#: Called with the number done, the total, and a remark
ProgressCallback = Callable[[int, int, str], None]

WRITTEN: list[Path] = []
"""Files and folders that this command has written, for the message of an error or interrupt that
comes later.
"""


CHANGED: list[str] = []
"""Changes that this command has made to files that others fill, too, such as the audit log: a
clause each, for the message of an error or interrupt that comes later.
"""

STARTED: list[Path] = []
"""Folders that this command was filling when it was interrupted."""

_MADE: list[Path] = []
"""Folders that this command has made before it had anything to put into them."""


@contextmanager
def write_output(path: Path) -> Iterator[None]:
    """Write a file or folder within the block, as `writing`,
    and note in `WRITTEN` that it is there.
    """
    try:
        with writing(path):
            yield
    except KeyboardInterrupt:
        if path.is_dir() and any(path.iterdir()):
            STARTED.append(path)
        raise
    WRITTEN.append(path)


@contextmanager
def write_new_folder(folder: Path) -> Iterator[Path]:
    """Write a new folder within the block, all of it or nothing.

    Yields:
        a hidden folder next to it, to write into; it gets the name at the end of the block.

    Raises:
        UsageError: there is something in the folder, or a file of this name.
        OutputFailed: the file system refuses.
    """
    from tempfile import TemporaryDirectory

    with write_output(folder):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(
                str(folder),
                found="something in it",
                expected="a new or empty folder",
                remedy="choose another name",
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as temporary:
            whole = Path(temporary) / "whole"
            whole.mkdir()
            yield whole
            whole.rename(folder)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, within `replace_output`."""
    with replace_output(path):
        replace_file(path, content.encode() if isinstance(content, str) else content)


@contextmanager
def replace_output(path: Path) -> Iterator[None]:
    """Write a file or folder within the block, as `write_output`,
    and say on stderr which files were there before.

    What can be made again, such as a plan or a calibration, may replace an earlier file of its kind
    (`check_replaceable`); a log replaces nothing.
    """
    before = _files_of(path)
    with write_output(path):
        yield
    after = _files_of(path)
    replaced = [file for file, state in before.items() if file in after and after[file] != state]
    if not replaced:
        return
    oldest_ns = min(before[file].modified_ns for file in replaced)
    since = datetime.fromtimestamp(oldest_ns / 1e9, UTC)
    names = [str(file) for file in replaced]
    named = first_few(names, NAMED_FILES, separator=", ")
    replaced_text = terminal_text(f"Replaced: {named} (of {since:%Y-%m-%d %H:%M} UTC)")
    say(replaced_text.plain, err=True)


NAMED_FILES = 4  #: Replaced files that are named; of more, their number is said


@dataclass(frozen=True, slots=True)
class _FileState:
    """What differs after a file was replaced."""

    inode: int
    modified_ns: int


def _files_of(path: Path) -> dict[Path, _FileState]:
    """Return a file, or each file in a folder, by name; empty where there is none."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found = {}
    for file in files:
        with suppress(OSError):  # it is not there
            status = file.stat()
            if stat.S_ISREG(status.st_mode):
                found[file] = _FileState(status.st_ino, status.st_mtime_ns)
    return found


def make_folder(folder: Path) -> None:
    """Create a folder, with its parents, before there is anything to put into it;
    it is removed if it stays empty.

    Raises:
        UsageError: a file, or a link that leads nowhere, has its name.
    """
    require_folder_name(folder)
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    _MADE.extend(reversed(missing))
    folder.mkdir(parents=True, exist_ok=True)


def require_folder_name(folder: Path | None) -> None:
    """Refuse, before any work, the name of a file or of a link that leads nowhere for a folder."""
    if folder is not None and is_taken(folder) and not folder.is_dir():
        raise UsageError(
            str(folder),
            found=what_has_name(folder),
            expected="a folder, or a new name",
            remedy="choose another name, or move it away",
        )


def remove_empty_folders() -> None:
    """Remove the folders of `make_folder` that are still empty."""
    while _MADE:
        with suppress(OSError):  # not empty
            _MADE.pop().rmdir()


def check_output(out: Path | None, inputs: Iterable[Path | None], format_: str) -> None:
    """Refuse to overwrite an input, or a file that does not begin with its format."""
    check_link(out)
    if out is None or not out.exists():
        return
    if any(given is not None and _is_same(out, given) for given in inputs):
        raise UsageError(
            str(out),
            found="one of the input files",
            expected="a file of its own",
            remedy="choose another name",
        )
    check_replaceable(out, f"format: {format_}", format_)


def _is_same(out: Path, given: Path) -> bool:
    """Whether a file to write is an input; what reads an input says why that cannot be read."""
    try:
        return given.exists() and out.samefile(given)
    except OSError:
        return False


def require_different(out: Path | None, **folders: Path | None) -> None:
    """Refuse --out and an option of a folder that have the same name."""
    for option, folder in folders.items():
        if out is not None and folder is not None and out.resolve() == folder.resolve():
            raise UsageError(
                str(out),
                found=f"the same name for --out and --{option}",
                expected="a name for each",
                remedy=f"choose another name for --{option}",
            )


def check_folder(out: Path | None) -> None:
    """Refuse, before the work is done, an output file in a folder that does not exist."""
    check_link(out)
    if out is not None and not out.parent.is_dir():
        raise OutputFailed(
            str(out),
            found="no such folder",
            expected="a folder that exists",
            remedy="create it, or choose another",
        )


def check_link(out: Path | None) -> None:
    """Refuse, before the work is done, a link into a folder that does not exist."""
    if out is None or out.exists() or not out.is_symlink():
        return
    if not Path(os.path.realpath(out)).parent.is_dir():
        raise OutputFailed(
            str(out),
            found=what_has_name(out),
            expected="a link into a folder that exists",
            remedy="remove the link, or create that folder",
        )


def check_page(out: Path, option: str) -> None:
    """Refuse a name for a page whose suffix says another format than HTML."""
    if out.suffix.lower() in ("", ".html"):
        return
    raise UsageError(
        f"{option} {out}",
        found=f"a name that ends in {out.suffix}",
        expected="a name that ends in .html",
        remedy="choose such a name; a browser prints the page, or saves it as a PDF",
    )


def check_replaceable(out: Path, mark: str, kind: str) -> None:
    """Refuse to overwrite a file of another kind:
    one that is not empty and lacks the mark of this kind in its head.

    What `judged_output` refuses is refused too: a file in a folder that the command line names was
    not judged there.
    """
    judged_output(out)
    if out.is_file():
        with out.open("rb") as stream:
            head = stream.read(4096)
        replaceable = not head or mark.encode() in head
        found = f"an existing file that is no {kind}"
    else:
        replaceable = not is_taken(out)
        found = what_has_name(out)
    if not replaceable:
        raise UsageError(
            str(out),
            found=found,
            expected="no file, or an earlier one of the same kind",
            remedy="choose another name, or move it away",
        )


def one_of(remedy: str, **options: object) -> None:
    """Require exactly one of several options, by their names on the command line."""
    if not any(options.values()):
        names = ", ".join(f"--{name}" for name in options)
        raise UsageError(names, found="neither", expected="one of them", remedy=remedy)
    at_most_one(**options)


def at_most_one(**options: object) -> None:
    """Refuse options that exclude each other, by their names on the command line."""
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value]
    if len(given) > 1:
        raise UsageError(
            given[0],
            found=f"{', '.join(given[1:])} beside it",
            expected="one of them",
            remedy="leave out all but one",
        )


class _WholeWords(Console):
    """Console that breaks long lines of text at spaces,
    where a terminal would break them within a word.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does, with lines of text that fit a terminal."""
        shown = objects
        if self.is_terminal:
            shown = tuple(self._fitting(one) for one in objects)
        super().print(*shown, **options)

    def _fitting(self, one: Any) -> Any:
        if isinstance(one, str):
            return break_lines(one, self.width)
        if isinstance(one, Text) and not one.spans:
            return Text(break_lines(one.plain, self.width), style=one.style)
        return one


def say(text: str, *, err: bool = False) -> None:
    """Print text for a person; a terminal gets lines broken at spaces,
    a pipe or file gets them as they are.
    """
    stream = sys.stderr if err else sys.stdout
    shown = text
    if stream is not None and stream.isatty():
        shown = break_lines(text, shutil.get_terminal_size().columns)
    typer.echo(shown, err=err)


def output_console() -> Console:
    """Console of stdout; a pipe has no width, so nothing in it is broken into lines."""
    console = _WholeWords(soft_wrap=True, highlight=False, markup=False)
    if not console.is_terminal:
        console.width = PIPE_COLUMNS
    return console


PIPE_COLUMNS = 1_000  #: Wider than any table


def print_view(parts: Iterable[RenderableType], *written: Path | None) -> None:
    """Print tables and lines on stdout, then the files written;
    a terminal breaks lines between words alone.
    """
    console = output_console()
    for part in parts:
        console.print(part)
    say_written(console, *written)


def say_written(console: Console, *paths: Path | None) -> None:
    """Print the files and folders that were written, a line each;
    None for those that were not asked for.
    """
    for path in paths:
        if path is not None:
            page = path / "report.html"
            name = f"{path}/" if path.is_dir() else str(path)
            seen = f" (certificate: {page})" if page.exists() else ""
            console.print(terminal_text(f"Written: {name}{seen}"))


def say_last(text: str) -> None:
    """Print the last line of a command on stderr;
    the exit code says it where that takes nothing.
    """
    with suppress(OSError, ValueError):  # a full disk, a reader that has gone, a closed stream
        say(text, err=True)


class Stepper:
    """Progress of steps that follow each other:
    a line for each as it ends, whole and at once, for a file or pipe.
    """

    def __init__(self) -> None:
        self._title = ""
        self._began_s = 0.0

    def step(self, title: str) -> None:
        """End the current step and begin the next."""
        self.end()
        self._title = title
        self._began_s = time.monotonic()

    def progress(self, done: int, total: int, remark: str) -> None:
        """Report progress within the step, which a line that cannot be taken back does not;
        a total of 0 is unknown.
        """

    def end(self) -> None:
        """End the current step."""
        if self._title:
            typer.echo(
                f"{terminal_text(self._title)} ({time.monotonic() - self._began_s:.0f} s)", err=True
            )
        self._title = ""


class _Bars(Stepper):
    """Progress bars."""

    def __init__(self, bars: Progress) -> None:
        super().__init__()
        self._bars = bars
        self._task: TaskID | None = None

    def step(self, title: str) -> None:
        self.end()
        self._task = self._bars.add_task(title, total=None, remark="")

    def progress(self, done: int, total: int, remark: str) -> None:
        if self._task is not None:
            of = f"{done}/{total} " if total else ""
            self._bars.update(self._task, completed=done, total=total or None, remark=of + remark)

    def end(self) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=1, total=1)
            self._bars.stop_task(self._task)


def _prepared_bars() -> PatientProgress | None:
    """Return bars on stderr, not shown yet; None where it is no terminal.

    What draws them is loaded, and was used once: the first frame of a recording takes no longer
    than the next ones.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    from daq.cli.patient_live import PatientProgress

    remark = TextColumn("{task.fields[remark]}", style="dim")
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        remark,
    )
    bars = PatientProgress(*columns, console=console, refresh_per_second=5)
    trial = bars.add_task("", total=1, remark="")
    bars.update(trial, completed=1)
    console.render_lines(bars.get_renderable())
    bars.remove_task(trial)
    return bars


@contextmanager
def _steps_on(bars: PatientProgress | None) -> Iterator[Stepper]:
    if bars is None:
        lines = Stepper()
        yield lines
        lines.end()
        return
    with bars:
        stepper = _Bars(bars)
        yield stepper
        stepper.end()


@contextmanager
def show_steps() -> Iterator[Stepper]:
    """Show progress on stderr, in a terminal as bars;
    the last step is ended unless an error is raised.
    """
    with _steps_on(_prepared_bars()) as stepper:
        yield stepper


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressCallback]:
    """Show one progress bar on stderr from the first progress on:
    none where the work is refused.

    It is prepared at once: a recorder that moves axes must not wait for a library to load.
    """
    bars = _prepared_bars()
    with ExitStack() as stack:
        shown: list[Stepper] = []

        def report(done: int, total: int, remark: str) -> None:
            if not shown:
                shown.append(stack.enter_context(_steps_on(bars)))
                shown[0].step(title)
            shown[0].progress(done, total, remark)

        yield report


@contextmanager
def status(title: str) -> Iterator[Callable[[str], None]]:
    """Show work of unknown length on stderr: in a terminal a spinner with the step,
    elsewhere a line for each step.
    """
    from rich.spinner import Spinner

    from daq.cli.patient_live import PatientLive

    console = Console(stderr=True, highlight=False)
    spinner = Spinner("dots", title, style="status.spinner")
    with PatientLive(spinner, console=console, refresh_per_second=SPINNER_HZ, transient=True):

        def show_step(step: str) -> None:
            if console.is_terminal:
                spinner.update(text=terminal_text(step))
            else:
                # A line of a file, whatever its length
                console.print(f"  {step}", style="dim", soft_wrap=True)

        yield show_step


SPINNER_HZ = 12.5  #: Frames of the spinner a second


@contextmanager
def until_interrupted() -> Iterator[None]:
    """End a block that runs until Ctrl-C without an error;
    what it has printed is not waited for after that.
    """
    try:
        yield
    except KeyboardInterrupt:
        release_results()


@contextmanager
def delay_signals() -> Iterator[None]:
    """Let a short write and the records of it be completed before a signal is a KeyboardInterrupt.

    Unlike the blocker of `interruptible`, which drops a signal during a stop, this one raises it
    afterwards. Outside the main thread nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    with _handled_by(lambda number, _: came.append(number), SIGNALS):
        yield
    if came:
        raise KeyboardInterrupt


ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  #: Signals that ask a program to end
SIGNALS = (*ENDING, signal.SIGQUIT, signal.SIGTSTP)
"""Those, Ctrl-\\ and Ctrl-Z: a recorder that is suspended would leave its axes to themselves."""
GRACE_S = 10.0  #: Longer than a stop of all axes takes
ONE_KEY_S = 0.3  #: Signals that are closer together count as one


@contextmanager
def interruptible(
    clock: Callable[[], float] = time.monotonic,
    signals: tuple[signal.Signals, ...] = SIGNALS,
    *,
    moves_again: bool = False,
) -> Iterator[SignalBlocker]:
    """Turn signals within the block into KeyboardInterrupt,
    and ignore those that follow within `GRACE_S`.

    By default SIGTERM, SIGHUP and SIGQUIT end a process at once, SIGTSTP suspends it, and the axes
    would keep moving; a shell starts background jobs (&) with SIGINT ignored, and only a handler of
    our own makes them interruptible. The first signal starts the stop of the axes, which a second
    one must not cut short; later signals count again, so that a hanging stop can be left. The
    yielded context manager protects a stop that a fault has started in the same way; a signal that
    arrives meanwhile is dropped, because it asks for what is happening already. The context yields
    a function that returns whether a second signal came, after which the settings of the axes need
    not be restored any more. Outside the main thread, where Python handles no signals, nothing
    changes.

    Args:
        clock: monotonic [s].
        signals: that interrupt.
        moves_again: the command may go on to another motion after the protected end of a good one.
            A signal that came during this end is then raised after it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield nullcontext
        return

    blocked_until_s = last_s = float("-inf")
    signals_seen = 0

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal blocked_until_s, last_s, signals_seen
        now_s = clock()
        # A terminal and a shell may both pass one key on.
        signals_seen += now_s - last_s >= ONE_KEY_S
        last_s = now_s
        if now_s >= blocked_until_s:
            blocked_until_s = now_s + GRACE_S
            raise KeyboardInterrupt

    @contextmanager
    def block_signals() -> Iterator[Callable[[], bool]]:
        nonlocal blocked_until_s
        earlier_s = blocked_until_s
        is_stopping = sys.exception() is not None or clock() < earlier_s
        seen_before = signals_seen
        blocked_until_s = max(blocked_until_s, clock() + GRACE_S)
        try:
            yield lambda: signals_seen > 1
        finally:
            blocked_until_s = earlier_s
        if moves_again and signals_seen > seen_before and not is_stopping:
            blocked_until_s = clock() + GRACE_S
            raise KeyboardInterrupt

    with _handled_by(interrupt, signals):
        yield block_signals


@contextmanager
def _handled_by(
    handler: Callable[[int, FrameType | None], None], signals: Iterable[signal.Signals]
) -> Iterator[None]:
    """Handle signals within the block by a function."""
    before = [(number, signal.signal(number, handler)) for number in signals]
    try:
        yield
    finally:
        for number, earlier in before:
            signal.signal(number, earlier)
