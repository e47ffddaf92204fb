"""The two terminals of a reader who types the commands of a page."""

from __future__ import annotations

import shlex
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from daq.cli.app import main
from tests.pipeline.next_step import next_step
from tests.pipeline.transcript import Command, shows

LONGEST_S = 300
STARTED_S = 60
"""Of a command; of what runs on in the second terminal, until it is of use."""
ASKS_FOR_STATUS = "echo $?"


@dataclass(slots=True)
class Reader:
    """Types the commands of a page, and compares what they print with what the page shows."""

    page: str  #: for messages
    capfd: pytest.CaptureFixture[str]
    #: verbs that outputs named as the next step
    proposed: set[str | None] = field(default_factory=set)

    def follow(self, commands: list[Command]) -> None:
        """Type one command after the other, each seeing the exit code of the one before.

        A command that fails is a mistake, unless the page shows its error or asks for its exit
        code.
        """
        status = 0
        for number, command in enumerate(commands):
            following = commands[number + 1 :]
            if command.background:
                with second_terminal(command):
                    self.follow(following)
                return
            status, output = first_terminal(command.text, status, self.capfd)
            where = f"{self.page}, line {command.line}: $ {command.text}\n{output}"
            assert "Traceback" not in output, where
            if status == 0:
                self.proposed.add(next_step(output))
            else:
                asked = bool(following) and following[0].text == ASKS_FOR_STATUS
                assert asked or "error:" in command.seen, f"{where}\n--- exit code {status}"
            missing = shows(command.seen, output)
            assert missing is None, f"{where}\n--- the page also shows: {missing}"


@contextmanager
def second_terminal(command: Command) -> Iterator[None]:
    """Something that runs on until the reader is done;
    it begins to be of use when it has said what the page shows.
    """
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
            wanted = command.seen.splitlines()[0]
            said = ""
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


def first_terminal(text: str, status: int, capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and output of one command.

    `drivegain` runs in this process, as its console script would run it: thirty processes would
    spend most of their time importing the same libraries.
    """
    words = shlex.split(text)
    if words[0] == "drivegain" and not {"|", ">", "2>", "&&"} & set(words):
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
