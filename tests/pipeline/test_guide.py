"""docs/tutorial/guide.md, followed to the letter, in two terminals."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.pipeline.transcript import Command, commands_of, shows

PORT = 29536
"""Of the hub, as the page and `init --simulated` say."""
LONGEST_S, STARTED_S = 300, 60
"""Of a command; of what runs on in the second terminal, until it is of use."""


@contextmanager
def second_terminal(command: Command, folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """Something that runs on until the reader is done; it begins to be of use when it has said what the page shows."""
    with subprocess.Popen(
        ["bash", "-c", f"exec {command.text}"],
        cwd=folder,
        env=environment,
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


def test_the_guide_is_followed_to_the_letter(checkout: Path, tmp_path: Path) -> None:
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", PORT)) == 0:
            pytest.skip(f"port {PORT} of this machine is in use: a simulated cell in another terminal?")
    commands = commands_of((checkout / "docs" / "tutorial" / "guide.md").read_text(encoding="utf-8"))
    assert len(commands) > 25
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "200",
    }
    walk(list(commands), tmp_path, environment, 0)


def walk(commands: list[Command], folder: Path, environment: dict[str, str], status: int) -> None:
    """One command after the other, each seeing the exit code of the one before."""
    for number, command in enumerate(commands):
        if command.background:
            with second_terminal(command, folder, environment):
                walk(commands[number + 1 :], folder, environment, status)
            return
        done = subprocess.run(
            ["bash", "-c", f"(exit {status}); {command.text}"],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )
        status = done.returncode
        where = f"docs/tutorial/guide.md, line {command.line}: $ {command.text}\n{done.stdout}"
        assert "Traceback" not in done.stdout, where
        missing = shows(command.seen, done.stdout)
        assert missing is None, f"{where}\n--- the page also shows: {missing}"
