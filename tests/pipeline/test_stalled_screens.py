"""Recordings whose screen takes nothing:
a pipe that nobody reads, a terminal whose output is stopped.

No cycle is lost, the log is finished, the bus is free, and SIGINT ends the command within a stated
time.
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.cli.output import PATIENCE_S
from daq.errors import ExitCode
from tests.daq.cli.screens import full_pipe
from tests.pipeline.simulated_bus import served_cell

pytestmark = pytest.mark.processes

BEGUN_BYTES = 60_000  #: Of a log: the axes move
WAIT_S = 120.0  #: For a whole recording on a busy computer
#: After SIGINT: two streams, and the stop of the axes as it is promised
END_S = 2 * PATIENCE_S + 10.0
MOTION_S = 20.0


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Iterator[Path]:
    """A cell file whose bus is the simulated cell's hub."""
    with served_cell(tmp_path_factory.mktemp("cell"), checkout) as cell_file:
        yield cell_file


@pytest.fixture(scope="module")
def plan(cell: Path) -> Path:
    """A plan for that cell."""
    path = cell.with_name("plan.yaml")
    wanted = ["--duration", f"{MOTION_S:g}", "--exchanges", "0"]
    assert main(["plan", str(cell), "--out", str(path), *wanted]) == ExitCode.OK
    return path


@dataclass(frozen=True)
class Screen:
    """Where a command prints to: nobody reads until `drain`."""

    reading: int
    writing: int

    def drain(self) -> bytes:
        """Read everything until the writers have gone."""
        os.close(self.writing)
        taken = b""
        with suppress(OSError):  # EIO: the end of a terminal
            while piece := os.read(self.reading, 65536):
                taken += piece
        return taken

    def stop(self) -> None:
        """Press Ctrl-S."""
        termios.tcflow(self.writing, termios.TCOOFF)

    def go_on(self) -> None:
        """Press Ctrl-Q."""
        termios.tcflow(self.writing, termios.TCOON)


@pytest.fixture(name="full_pipe")
def _full_pipe() -> Iterator[Screen]:
    """A pipe that takes nothing any more."""
    with full_pipe() as (reading, writing):
        yield Screen(reading, writing)


@pytest.fixture
def terminal() -> Iterator[Screen]:
    """A terminal of 80 columns."""
    reading, writing = pty.openpty()
    fcntl.ioctl(writing, termios.TIOCSWINSZ, b"\x18\x00\x50\x00\x00\x00\x00\x00")
    yield Screen(reading, writing)
    os.close(reading)


@contextmanager
def _start(checkout: Path, screen: Screen, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command on a screen; one that has not ended with the block is killed."""
    command = [sys.executable, "-m", "daq", *arguments]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=screen.writing,
        stderr=screen.writing,
        cwd=checkout,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _until(process: subprocess.Popen[bytes], is_reached: Callable[[], bool]) -> None:
    """Wait for something that the process does before it ends."""
    end_s = time.monotonic() + WAIT_S
    while not is_reached():
        assert process.poll() is None
        assert time.monotonic() < end_s
        time.sleep(0.02)


def _is_begun(log: Path) -> bool:
    part = log.with_name(f"{log.name}.part")
    return part.exists() and part.stat().st_size > BEGUN_BYTES


def _interrupted(process: subprocess.Popen[bytes]) -> int:
    """Send SIGINT; return the exit code, which comes in time."""
    process.send_signal(signal.SIGINT)
    return process.wait(timeout=END_S)


def _require_whole_log(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["info", str(log), "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert found["valid"]
    assert found["lost_cycles"] == 0
    assert found["duration_s"] > MOTION_S / 2


def _require_powerless(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bus can be used as soon as the settings of the axes are restored,
    and no axis has power.
    """
    end_s = time.monotonic() + END_S
    code = int(ExitCode.BUS_TAKEN)
    while code == ExitCode.BUS_TAKEN and time.monotonic() < end_s:
        capsys.readouterr()
        code = main(["scan", str(cell), "--json"])
    assert code == ExitCode.OK
    assert {node["state"] for node in json.loads(capsys.readouterr().out)["nodes"]} == {
        "SWITCH ON DISABLED"
    }


def _recording(cell: Path, plan: Path, log: Path) -> tuple[str, ...]:
    return ("record", str(cell), str(plan), "--out", str(log), "--enable-motion")


def test_a_recording_into_a_pipe_that_nobody_reads_is_whole_and_sigint_ends_it(
    cell: Path,
    plan: Path,
    full_pipe: Screen,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "bare.mcap"
    with _start(checkout, full_pipe, *_recording(cell, plan, log)) as process:
        _until(process, log.exists)
        # It waits for a reader of its result, without the bus.
        _require_whole_log(log, capsys)
        _require_powerless(cell, capsys)
        assert process.poll() is None
        assert _interrupted(process) == ExitCode.INTERRUPTED
    assert log.exists()


def test_a_recording_whose_remarks_nobody_reads_gives_its_result_and_ends_by_itself(
    cell: Path,
    plan: Path,
    full_pipe: Screen,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "bare.mcap"
    command = [sys.executable, "-m", "daq", *_recording(cell, plan, log), "--json"]
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=full_pipe.writing,
        cwd=checkout,
        timeout=WAIT_S,
        check=False,
    )
    assert done.returncode == ExitCode.OK
    assert json.loads(done.stdout)["lost_cycles"] == 0
    _require_whole_log(log, capsys)


def test_sigint_in_motion_stops_a_recording_into_a_pipe_that_nobody_reads(
    cell: Path,
    plan: Path,
    full_pipe: Screen,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "bare.mcap"
    with _start(checkout, full_pipe, *_recording(cell, plan, log)) as process:
        _until(process, lambda: _is_begun(log))
        assert _interrupted(process) == ExitCode.INTERRUPTED
    assert not log.exists()
    _require_powerless(cell, capsys)


def test_a_terminal_stopped_in_motion_holds_nothing_up_and_shows_the_result_later(
    cell: Path,
    plan: Path,
    terminal: Screen,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "bare.mcap"
    shown: list[bytes] = []
    with _start(checkout, terminal, *_recording(cell, plan, log)) as process:
        _until(process, lambda: _is_begun(log))
        terminal.stop()
        _until(process, log.exists)
        _require_whole_log(log, capsys)
        _require_powerless(cell, capsys)
        assert process.poll() is None
        reader = threading.Thread(target=lambda: shown.append(terminal.drain()))
        terminal.go_on()
        reader.start()
        assert process.wait(timeout=WAIT_S) == ExitCode.OK
        reader.join()
    words = b" ".join(shown[0].split())
    assert b"0 cycles lost, complete" in words
    assert words.index(b"complete") < words.index(b"Next: drivegain record")


def test_a_recording_outlives_its_terminal(
    cell: Path, plan: Path, tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The SSH connection is gone, and SIGHUP was ignored or never came;
    the result alone is lost.
    """
    log = tmp_path / "bare.mcap"
    terminal = Screen(*pty.openpty())
    with _start(checkout, terminal, *_recording(cell, plan, log)) as process:
        os.close(terminal.writing)
        _until(process, lambda: _is_begun(log))
        os.close(terminal.reading)
        assert process.wait(timeout=WAIT_S) == ExitCode.UNEXPECTED
    _require_whole_log(log, capsys)
    _require_powerless(cell, capsys)


def test_sigint_ends_a_recording_in_a_stopped_terminal(
    cell: Path,
    plan: Path,
    terminal: Screen,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "bare.mcap"
    with _start(checkout, terminal, *_recording(cell, plan, log)) as process:
        _until(process, lambda: _is_begun(log))
        terminal.stop()
        time.sleep(1.0)  # five frames of the bar
        assert _interrupted(process) == ExitCode.INTERRUPTED
    _require_powerless(cell, capsys)


@pytest.mark.parametrize("verb", ["monitor", "simulate"])
def test_sigint_ends_what_runs_until_then_in_a_stopped_terminal(
    cell: Path, terminal: Screen, checkout: Path, verb: str
) -> None:
    arguments = {
        "monitor": ["monitor", str(cell)],
        "simulate": ["simulate", "clean", "--port", "0"],
    }[verb]
    terminal.stop()
    with _start(checkout, terminal, *arguments) as process:
        # What it would print waits; it runs as soon as it handles SIGINT, in /proc/PID/status.
        _until(process, lambda: _handles_sigint(process.pid))
        time.sleep(5.0)
        assert process.poll() is None
        assert _interrupted(process) == ExitCode.OK


def _handles_sigint(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) >> (signal.SIGINT - 1) & 1)
