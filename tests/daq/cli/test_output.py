"""Standard output and error that never hold up whoever prints."""

from __future__ import annotations

import errno
import json
import logging
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.cli.output import (
    CHUNK_BYTES,
    PATIENCE_S,
    PROGRESS_BYTES,
    REMARKS_BYTES,
    OutputKind,
    OutputWriter,
    Piece,
    QueuedOutput,
    is_behind,
    say_losses_as,
    wait_until_shown,
    write_if_taken,
)
from daq.cli.terminal import say, show_steps, status, until_interrupted
from daq.errors import ExitCode
from daq.jobs.journal import Form, Journal, Level
from daq.jobs.story import Story
from tests.daq.cli.screens import full_pipe, printing_to
from tests.daq.command_line import run_verb

LONG_S = 20.0  #: For what takes milliseconds
NOBODY_S = 0.05  #: Patience where nobody reads


@dataclass
class FakeFile:
    """A file whose reader takes bytes only while it reads."""

    content: bytes = b""
    error: OSError | None = None
    reads: threading.Event = field(default_factory=threading.Event)
    is_waited_for: threading.Event = field(default_factory=threading.Event)

    def write(self, _descriptor: int, content: bytes) -> int:
        self.is_waited_for.set()
        assert self.reads.wait(LONG_S)
        if self.error is not None:
            raise self.error
        taken = content[:1000]  # as a file may
        self.content += taken
        return len(taken)


@pytest.fixture
def file() -> Iterator[FakeFile]:
    """A file that nobody reads yet; released at the end, so that no thread stays."""
    made = FakeFile()
    yield made
    made.reads.set()


def _writer(file: FakeFile) -> OutputWriter:
    writer = OutputWriter(-1, file.write)
    writer.start()
    return writer


def _remark(number: int) -> Piece:
    content = b"%099d\n" % number
    return Piece(OutputKind.REMARK, content)


def test_pieces_get_out_in_order_and_whole(file: FakeFile) -> None:
    file.reads.set()
    writer = _writer(file)
    content = b"x" * 3 * CHUNK_BYTES
    pieces = [_remark(1), Piece(OutputKind.RESULT, content), _remark(2)]
    for piece in pieces:
        writer.put(piece)
    writer.wait()
    expected = b"".join(piece.content for piece in pieces)
    assert file.content == expected
    writer.close()


def test_where_nobody_reads_printing_returns_and_the_end_comes_in_its_bound(file: FakeFile) -> None:
    writer = _writer(file)
    for number in range(1000):
        writer.put(_remark(number))
    assert file.is_waited_for.wait(LONG_S)
    began_s = time.monotonic()
    writer.close(NOBODY_S)
    waited_s = time.monotonic() - began_s
    assert NOBODY_S <= waited_s < LONG_S
    assert file.content == b""


def test_remarks_beyond_the_room_are_left_out_and_counted_in_their_place(file: FakeFile) -> None:
    writer = _writer(file)
    kept = REMARKS_BYTES // 100
    for number in range(kept + 7):
        writer.put(_remark(number))
    writer.put(Piece(OutputKind.RESULT, b"the result\n"))
    writer.put(_remark(-1))  # there is no room for what comes before it
    file.reads.set()
    writer.wait()
    writer.put(_remark(-2))
    writer.wait()
    lines = file.content.decode().splitlines()
    expected = list(range(kept))
    assert [int(line) for line in lines[:kept]] == expected
    assert lines[kept:-1] == ["(8 lines were left out here: nothing read the output)", "the result"]
    last_line = lines[-1]
    assert int(last_line) == -2
    writer.close()


def test_a_remark_that_is_larger_than_the_room_gets_out_where_nothing_waits(file: FakeFile) -> None:
    file.reads.set()
    writer = _writer(file)
    content = b"x" * (REMARKS_BYTES + 1)
    writer.put(Piece(OutputKind.REMARK, content))
    writer.wait()
    assert file.content == content
    writer.close()


def test_results_are_never_left_out(file: FakeFile) -> None:
    writer = _writer(file)
    part = b"r" * (REMARKS_BYTES // 2)
    for _ in range(5):
        writer.put(Piece(OutputKind.RESULT, part))
    waiting = threading.Thread(target=writer.wait_for_results)
    waiting.start()
    waiting.join(NOBODY_S)
    assert waiting.is_alive()
    file.reads.set()
    waiting.join(LONG_S)
    assert file.content == 5 * part
    writer.close()


def test_a_reader_that_takes_a_little_at_a_time_is_not_left(file: FakeFile) -> None:
    """Patience counts from the last byte that was taken."""
    now_s = 0.0

    def clock() -> float:
        nonlocal now_s
        now_s += 0.4 * PATIENCE_S
        file.reads.set()
        taken = len(file.content)
        while len(file.content) == taken < 5000:  # before the next look, the reader takes a part
            time.sleep(0.001)
        return now_s

    writer = OutputWriter(-1, file.write, clock)
    writer.start()
    content = b"x" * 5000
    writer.put(Piece(OutputKind.REMARK, content))
    writer.close(0.5 * PATIENCE_S)
    assert file.content == content


@pytest.mark.parametrize("kind", [OutputKind.RESULT, OutputKind.REMARK])
def test_an_error_counts_where_a_result_is_lost(file: FakeFile, kind: OutputKind) -> None:
    file.error = OSError(errno.ENOSPC, "full")
    writer = _writer(file)
    writer.put(Piece(kind, b"x"))
    file.reads.set()
    if kind is OutputKind.RESULT:
        with pytest.raises(OSError, match="full"):
            writer.wait_for_results()
    else:
        writer.wait_for_results()
        writer.wait()
    writer.put(_remark(1))  # nobody needs it
    with pytest.raises(OSError, match="full"):
        writer.put(Piece(OutputKind.RESULT, b"x"))
    with pytest.raises(OSError, match="full"):
        writer.wait()
    writer.close()


def test_a_file_that_another_program_has_made_non_blocking_gets_everything(
    full_pipe: tuple[int, int],
) -> None:
    reading, writing = full_pipe
    os.set_blocking(writing, False)
    writer = OutputWriter(writing)
    writer.start()
    writer.put(Piece(OutputKind.RESULT, b"the result\n"))
    taken = b""
    while not taken.endswith(b"the result\n"):
        taken += os.read(reading, 4096)
    writer.close()


@pytest.fixture(name="full_pipe")
def _full_pipe() -> Iterator[tuple[int, int]]:
    """A pipe that takes nothing any more: its ends to read and to write."""
    with full_pipe() as ends:
        yield ends


def _read_on(reading: int, ending: bytes) -> bytes:
    """Read what was written behind the dots."""
    taken = b""
    while not taken.endswith(ending):
        taken += os.read(reading, 65536)
    return taken.lstrip(b".")


def test_journal_story_and_remarks_return_and_keep_their_order_with_results(
    full_pipe: tuple[int, int],
) -> None:
    def now() -> datetime:
        return datetime(2026, 1, 1, tzinfo=UTC)

    reading, writing = full_pipe
    with printing_to(writing):
        journal = Journal(sys.stderr, Form.JSON, now)
        journal.say(Level.INFO, "first")
        say("second")
        story = Story(sys.stderr, Form.TEXT, now)
        story.say(Level.WARNING, "third")
        with show_steps() as stepper:
            stepper.step("fourth")
        with status("not for a pipe") as report_step:
            report_step("fifth")
        # As without any handler: pytest has installed its own.
        assert logging.lastResort is not None
        logging.lastResort.handle(
            logging.makeLogRecord({"msg": "sixth", "levelno": logging.WARNING})
        )
        shown = _read_on(reading, b"sixth\n").decode().splitlines()
    document = json.loads(shown[0])
    assert document["event"] == "first"
    expected = ["second", "! third:", "fourth (0 s)", "fifth", "sixth"]
    assert [line.strip() for line in shown[1:]] == expected


def test_a_journal_for_programs_says_what_it_lacks_as_an_event(full_pipe: tuple[int, int]) -> None:
    reading, writing = full_pipe
    with printing_to(writing):
        journal = Journal(sys.stderr, Form.JSON, lambda: datetime(2026, 1, 1, tzinfo=UTC))
        say_losses_as(lambda lines: journal.line(Level.WARNING, "lines left out", lines=lines))
        for number in range(3):
            text = "x" * (REMARKS_BYTES // 3)
            journal.say(Level.INFO, "event", number=number, text=text)
        shown = _read_on(reading, b'"lines": 1}\n')
    events = [json.loads(line) for line in shown.splitlines()]
    assert [event.get("number") for event in events] == [0, 1, None]
    last_event = events[-1]
    assert last_event["event"] == "lines left out"


def test_a_bar_is_not_drawn_while_the_terminal_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    operator_side, session_side = pty.openpty()
    monkeypatch.setenv("TERM", "xterm")
    with printing_to(session_side) as output, show_steps() as stepper:
        termios.tcflow(session_side, termios.TCOOFF)
        stepper.step("recording")
        for number in range(2000):
            stepper.progress(number, 2000, "moves")
            _redraw(stepper)
        assert is_behind(sys.stderr)
        ((_, writer),) = output._writers
        assert writer._waiting_bytes < 3 * PROGRESS_BYTES
        say("a remark", err=True)
        threading.Thread(
            target=_drain, args=(operator_side, shown := bytearray()), daemon=True
        ).start()
        termios.tcflow(session_side, termios.TCOON)
        _wait_for(lambda: b"a remark" in shown)
    os.close(session_side)


PROGRESS = """
import sys
from daq.cli.terminal import progress_bar
with progress_bar("recording") as report:
    before = set(sys.modules)
    for number in range(3):
        report(number, 3, "moves")
    loaded = sorted(set(sys.modules) - before)
print(loaded)
"""


def test_the_first_progress_of_a_bar_loads_no_module() -> None:
    """It comes while axes move, and their SYNC would wait for it."""
    operator_side, session_side = pty.openpty()
    environment = {**os.environ, "TERM": "xterm"}
    with subprocess.Popen(
        [sys.executable, "-c", PROGRESS],
        stdout=subprocess.PIPE,
        stderr=session_side,
        env=environment,
        text=True,
    ) as process:
        os.close(session_side)
        shown = bytearray()
        _drain(operator_side, shown)
        loaded, _ = process.communicate(timeout=LONG_S)
    assert process.returncode == 0
    assert loaded.strip() == "[]"
    assert b"recording" in shown


def _redraw(stepper: object) -> None:
    stepper._bars.refresh()  # type: ignore[attr-defined]


def _drain(descriptor: int, shown: bytearray) -> None:
    with suppress(OSError):  # EIO: the terminal has gone
        while piece := os.read(descriptor, 4096):
            shown += piece
    os.close(descriptor)


def test_streams_in_memory_and_closed_ones_stay(
    monkeypatch: pytest.MonkeyPatch, capsys: object
) -> None:
    before = (sys.stdout, sys.stderr)
    with QueuedOutput():
        assert (sys.stdout, sys.stderr) == before
    monkeypatch.setattr(sys, "stdout", None)
    with QueuedOutput():
        assert sys.stdout is None
        wait_until_shown(sys.stdout, sys.stderr)


def test_what_runs_until_an_interrupt_waits_for_no_reader(full_pipe: tuple[int, int]) -> None:
    reading, writing = full_pipe
    with printing_to(writing) as output:
        say("where the page is")
        with until_interrupted():
            raise KeyboardInterrupt
        output.wait_for_results()
        _read_on(reading, b"where the page is\n")


def test_the_word_of_an_interrupt_before_anything_runs_does_not_block(
    full_pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, writing = full_pipe
    with os.fdopen(os.dup(writing), "w", buffering=1) as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        write_if_taken("nobody takes this\n")
        os.read(reading, 1 << 20)
        write_if_taken("interrupted\n")
    assert os.read(reading, 1 << 20) == b"interrupted\n"


COMMAND = [sys.executable, "-m", "daq", "explain-emcy", "8611h", "--json"]


@pytest.mark.slow
def test_a_reader_that_comes_late_and_is_slow_gets_the_whole_result(
    full_pipe: tuple[int, int], checkout: Path
) -> None:
    reading, writing = full_pipe
    with subprocess.Popen(COMMAND, stdout=writing, stderr=subprocess.PIPE, cwd=checkout) as process:
        assert process.stderr is not None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2 * PATIENCE_S + 4.0)  # both streams have given up remarks
        taken = b""
        while not taken.endswith(b"}\n"):
            piece = os.read(reading, 4096 if taken.endswith(b".") or not taken else 20)
            taken += piece
            time.sleep(0.001)
        assert process.wait(LONG_S) == ExitCode.OK
        assert process.stderr.read() == b""
    assert json.loads(taken.lstrip(b"."))["code"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_result_that_nobody_takes_ends_with_a_signal(
    full_pipe: tuple[int, int], checkout: Path, number: signal.Signals
) -> None:
    _, writing = full_pipe
    with subprocess.Popen(
        COMMAND, stdout=writing, stderr=subprocess.PIPE, text=True, cwd=checkout
    ) as process:
        assert process.stderr is not None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2 * PATIENCE_S + 4.0)  # both streams have given up remarks
        process.send_signal(number)
        assert process.wait(PATIENCE_S + LONG_S) == ExitCode.INTERRUPTED
        assert process.stderr.read() == "interrupted: the output was not read to its end\n"


@pytest.mark.slow
def test_a_defect_is_printed_and_ends_where_nobody_reads(
    full_pipe: tuple[int, int], checkout: Path
) -> None:
    """The traceback of an unexpected error, for a reader and for none."""
    script = """
import sys
import daq.cli.app
def fail(*_):
    raise RuntimeError("a defect")
daq.cli.app._run = fail
sys.exit(daq.cli.app.main())
"""
    command = [sys.executable, "-c", script, "explain-emcy"]
    timeout = PATIENCE_S + LONG_S
    done = subprocess.run(command, stderr=full_pipe[1], cwd=checkout, timeout=timeout, check=False)
    assert done.returncode == ExitCode.UNEXPECTED
    read = subprocess.run(command, capture_output=True, text=True, cwd=checkout, check=False)
    assert read.returncode == ExitCode.UNEXPECTED
    assert read.stderr.endswith("RuntimeError: a defect\n")


def test_in_process_the_streams_are_those_of_before(capfd: pytest.CaptureFixture[str]) -> None:
    before = (sys.stdout, sys.stderr)
    threads = threading.active_count()
    assert run_verb("explain-emcy", "8611h") == ExitCode.OK
    assert (sys.stdout, sys.stderr) == before
    assert "8611" in capfd.readouterr().out
    _wait_for(lambda: threading.active_count() == threads)


def _wait_for(is_reached: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LONG_S
    while not is_reached():
        assert time.monotonic() < end_s
        time.sleep(0.002)
