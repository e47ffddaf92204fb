"""A question of a session is answered by what is typed behind it,
not by keys that were pressed before.
"""

from __future__ import annotations

import os
import pty
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import pytest

from daq.cli.calibrate import SHOWN_WITHIN_S, Person, ask
from daq.config.recalibration import PlannedRun
from daq.errors import JobHeld
from tests.daq.cli.screens import full_pipe, printing_to
from tests.daq.drives import demo_cell

SECONDS_TO_WAIT = 20.0  #: For what takes milliseconds


class SessionSide:
    """The session's side of a terminal, in the place of `sys.stdin`,
    which tells when a line is waited for.
    """

    def __init__(self, side: TextIO) -> None:
        self.is_read = threading.Event()
        self._side = side

    def isatty(self) -> bool:
        return self._side.isatty()

    def fileno(self) -> int:
        return self._side.fileno()

    def readline(self) -> str:
        self.is_read.set()
        return self._side.readline()


@dataclass(frozen=True)
class Terminal:
    """A terminal with a person at it."""

    operator_side: int
    session_side: SessionSide

    def press(self, keys: str) -> None:
        """Type, and wait until the terminal shows it:
        then it is in the queue that the session reads.
        """
        os.write(self.operator_side, keys.encode())
        shown = b""
        while len(shown) < len(keys.replace("\n", "\r\n")):
            shown += os.read(self.operator_side, 100)

    def answered(self, question: str, keys: str) -> str:
        """Ask a question; type once it waits, and return what it takes for its answer."""
        answers: list[str] = []
        self.session_side.is_read.clear()
        asking = threading.Thread(target=lambda: answers.append(ask(question)), daemon=True)
        asking.start()
        assert self.session_side.is_read.wait(SECONDS_TO_WAIT)
        self.press(keys)
        asking.join(SECONDS_TO_WAIT)
        (answer,) = answers
        return answer


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """A terminal in the place of this process' input."""
    operator_side, session_side = pty.openpty()
    with os.fdopen(session_side, encoding="utf-8") as opened:
        side = SessionSide(opened)
        monkeypatch.setattr(sys, "stdin", side)
        yield Terminal(operator_side, side)
    os.close(operator_side)


@pytest.mark.parametrize("typed_ahead", ["\n", "\n\n\n", "yes\n", "4.59\n4.59\n", "no Enter yet"])
def test_what_was_typed_before_a_question_does_not_answer_it(
    terminal: Terminal, capsys: pytest.CaptureFixture[str], typed_ahead: str
) -> None:
    terminal.press(typed_ahead)
    assert terminal.answered("The robot moves now: Enter starts it", "behind it\n") == "behind it"
    said_so = "typed before this question does not count" in capsys.readouterr().err
    assert said_so == typed_ahead.endswith("\n")


def test_two_questions_need_two_answers(terminal: Terminal) -> None:
    """Enter twice at the first question leaves the second one open."""
    assert terminal.answered("Leave the cell, press Enter", "first\nonce more\n") == "first"
    assert terminal.answered("The robot moves now: Enter starts it", "second\n") == "second"


def test_the_lines_of_a_pipe_are_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A script that answers has written all its lines before the first question."""
    answers = tmp_path / "answers"
    answers.write_text("4.59\nyes\n", encoding="utf-8")
    with answers.open(encoding="utf-8") as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        assert ask("Mass") == "4.59"
        assert ask("Type yes") == "yes"
        with pytest.raises(JobHeld):
            ask("Anything else")


@pytest.mark.parametrize("answer", ["no", "stop", "yes", "é\x7f", "x" * 100_000])
def test_a_line_that_is_not_empty_does_not_permit_motion(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    answer: str,
) -> None:
    """A robot must not move because its operator has typed *no*."""
    cell = demo_cell(tmp_path)
    person = Person(cell, "operator", may_move=True, asks_before_motion=True)
    run = PlannedRun(name="block-1-bare", plan_file=Path("plan.yaml"))
    lines = tmp_path / "lines"
    lines.write_text(f"{answer}\n \n{answer}\n", encoding="utf-8")
    with lines.open(encoding="utf-8") as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        assert person.permit_motion(run) == "operator"  # by the second line, a blank one
        with pytest.raises(JobHeld, match="no answer: the input has ended"):
            person.mount(run)
    shown = capsys.readouterr().err
    assert shown.count("expected Enter alone. Nothing moves") == 2
    assert len(shown) < 1000


def test_an_answer_to_a_question_that_went_nowhere_starts_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    answers = tmp_path / "answers"
    answers.write_text("\n\n", encoding="utf-8")
    with answers.open(encoding="utf-8") as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        with (
            Path("/dev/full").open("wb") as full,
            printing_to(full.fileno()),
            pytest.raises(JobHeld, match="a question that cannot be shown; the error output takes"),
        ):
            ask("The robot moves now")
        monkeypatch.setattr(sys, "stderr", None)
        with pytest.raises(JobHeld, match="cannot be shown; the error output is closed"):
            ask("The robot moves now")
        assert pipe.readline() == "\n"  # no answer was taken


def test_a_closed_input_is_one_that_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(JobHeld, match="no answer: the input has ended"):
        ask("Mass")


def test_what_was_typed_before_a_stalled_screen_shows_the_question_does_not_answer_it(
    terminal: Terminal,
) -> None:
    answers: list[str] = []
    with full_pipe() as (reading, writing), printing_to(writing):
        asking = threading.Thread(
            target=lambda: answers.append(ask("The robot moves now")), daemon=True
        )
        asking.start()
        time.sleep(2 * SHOWN_WITHIN_S)
        terminal.press("\n")
        assert not terminal.session_side.is_read.is_set()
        shown = b""
        while shown.count(b">>> The robot moves now: ") < 2:
            shown += os.read(reading, 65536)
        assert terminal.session_side.is_read.wait(SECONDS_TO_WAIT)
        terminal.press("behind it\n")
        asking.join(SECONDS_TO_WAIT)
    assert answers == ["behind it"]
    assert b"typed before this question does not count" in shown
