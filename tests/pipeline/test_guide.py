"""docs/tutorial/guide.md, followed to the letter, in two terminals."""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from daq.cli.app import main
from tests.pipeline.next_step import next_step
from tests.pipeline.transcript import Command, commands_of, shows

pytestmark = pytest.mark.processes

PORT = 29536
"""Of the hub, as the page and `init --simulated` say."""
LONGEST_S, STARTED_S = 300, 60
"""Of a command; of what runs on in the second terminal, until it is of use."""


@contextmanager
def second_terminal(command: Command) -> Iterator[None]:
    """Something that runs on until the reader is done; it begins to be of use when it has said what the page shows."""
    with subprocess.Popen(
        ["bash", "-c", f"exec {command.text}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        # What it never says would be waited for forever.
        late = threading.Timer(STARTED_S, process.kill)
        late.start()
        try:
            assert process.stdout is not None
            wanted, said = command.seen.splitlines()[0], ""
            while shows(wanted, said) is not None:
                line = process.stdout.readline()
                assert line, f"line {command.line}: {command.text} ended with {said!r}"
                said += line
            late.cancel()
            yield
        finally:
            late.cancel()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=30) == 0


def test_the_guide_is_followed_to_the_letter(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", PORT)) == 0:
            pytest.skip(f"port {PORT} of this machine is in use: a simulated cell in another terminal?")
    commands = commands_of((checkout / "docs" / "tutorial" / "guide.md").read_text(encoding="utf-8"))
    assert len(commands) > 25
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    named: set[str | None] = set()
    walk(list(commands), 0, capfd, named)
    assert named == {None, "scan", "calibrate", "record", "fit", "residual", "apply"}


def walk(commands: list[Command], status: int, capfd: pytest.CaptureFixture[str], named: set[str | None]) -> None:
    """One command after the other, each seeing the exit code of the one before; `named` gets the next steps."""
    for number, command in enumerate(commands):
        if command.background:
            with second_terminal(command):
                walk(commands[number + 1 :], status, capfd, named)
            return
        status, output = first_terminal(command.text, status, capfd)
        where = f"docs/tutorial/guide.md, line {command.line}: $ {command.text}\n{output}"
        assert "Traceback" not in output, where
        if status == 0:
            named.add(next_step(output))
        missing = shows(command.seen, output)
        assert missing is None, f"{where}\n--- the page also shows: {missing}"


def first_terminal(text: str, status: int, capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and output of one command.

    `drivegain` runs in this process, as its console script would run it: thirty processes would spend most of their
    time importing the same libraries.
    """
    words = shlex.split(text)
    if words[0] == "drivegain":
        capfd.readouterr()
        status = main(words[1:])
        return status, "".join(capfd.readouterr())
    done = subprocess.run(
        ["bash", "-c", f"(exit {status}); {text}"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    return done.returncode, done.stdout
