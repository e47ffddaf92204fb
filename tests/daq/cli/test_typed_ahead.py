"""A question of a session is answered by what is typed behind it, not by keys that were pressed before."""

from __future__ import annotations

import os
import pty
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from daq.cli.calibrate import ask
from daq.errors import JobHeld

SECONDS_TO_WAIT = 20.0


@dataclass(frozen=True)
class Keyboard:
    """The operator's side of the terminal that the session reads."""

    side: int

    def press(self, keys: str) -> None:
        """Type, and wait until the terminal shows it: then it is in the queue that the session reads."""
        os.write(self.side, keys.encode())
        shown = b""
        while len(shown) < len(keys.replace("\n", "\r\n")):
            shown += os.read(self.side, 100)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Keyboard]:
    """A terminal in the place of this process' input."""
    operator_side, session_side = pty.openpty()
    with os.fdopen(session_side, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield Keyboard(operator_side)
    os.close(operator_side)


class Asked(threading.Thread):
    """A question that waits for its answer."""

    def __init__(self, question: str) -> None:
        super().__init__(daemon=True)
        self.question = question
        self.answer: str | None = None

    def put(self, capsys: pytest.CaptureFixture[str]) -> str:
        """Start it; return what is on the screen once it waits."""
        self.start()
        said = ""
        deadline = time.monotonic() + SECONDS_TO_WAIT
        while not said.endswith(": ") and time.monotonic() < deadline:
            time.sleep(0.01)
            said += capsys.readouterr().err
        self.join(0.05)
        assert self.is_alive(), f"answered already: {said}"
        return said

    def run(self) -> None:
        self.answer = ask(self.question)


@pytest.mark.parametrize("typed_ahead", ["\n", "\n\n\n", "yes\n", "4.59\n4.59\n", "no Enter yet"])
def test_what_was_typed_before_a_question_does_not_answer_it(
    keyboard: Keyboard, capsys: pytest.CaptureFixture[str], typed_ahead: str
) -> None:
    keyboard.press(typed_ahead)
    question = Asked("The robot moves now. Press Enter to start")
    said = question.put(capsys)
    keyboard.press("behind it\n")
    question.join(SECONDS_TO_WAIT)
    assert question.answer == "behind it"
    said_so = "typed before this question does not count" in said
    assert said_so == typed_ahead.endswith("\n")


def test_two_questions_need_two_answers(keyboard: Keyboard, capsys: pytest.CaptureFixture[str]) -> None:
    """Enter twice at the first question leaves the second one open."""
    first = Asked("Mount it, leave the cell, then press Enter")
    first.put(capsys)
    keyboard.press("\n\n")
    first.join(SECONDS_TO_WAIT)
    assert first.answer == ""
    second = Asked("The robot moves now. Press Enter to start")
    second.put(capsys)
    keyboard.press("\n")
    second.join(SECONDS_TO_WAIT)
    assert second.answer == ""


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
