"""`drivegain calibrate`: what its terminal shows while a block is recorded."""

from __future__ import annotations

import errno
import io
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import typer

from daq.cli.calibrate import Looks, show_check
from daq.errors import ExitCode
from daq.jobs.calibrate import CheckLine
from daq.jobs.journal import Form
from daq.jobs.story import Story
from daq.log.feed import Feed, QuickGain, QuickLook
from drivers.errors import BusError

LOOK = QuickLook("block-2-loaded", 3, 9, 31.0, gains=[QuickGain("J1", "Nm/A", 33.9, 0.4, 0.5)])


@pytest.fixture
def looks(tmp_path: Path) -> Looks:
    """While the second block is recorded."""
    story = Story(io.StringIO(), Form.TEXT, lambda: datetime(2026, 1, 5, tzinfo=UTC))
    feed = Feed(tmp_path / "cell.yaml")
    return Looks(feed, story, block=LOOK.block)


def test_a_look_is_printed_where_the_errors_go_now(
    looks: Looks, capsys: pytest.CaptureFixture[str]
) -> None:
    """A progress bar replaces the stream while it is shown."""
    looks.show(LOOK)
    look = replace(LOOK, move=4)
    looks.show(look)
    changed_gain = replace(LOOK.gains[0], std_percent=0.1)
    gains = [changed_gain]
    changed_look = replace(LOOK, move=5, gains=gains)
    looks.show(changed_look)
    said = capsys.readouterr().err.splitlines()
    assert [line.split(",")[1] for line in said] == [" move 3 of 9", " move 4 of 9", " move 5 of 9"]
    assert looks.remark == "moves, J1 ± 0.10 % (target 0.5 %)"


def test_a_look_that_comes_after_its_block_does_not_disturb_the_operator(
    looks: Looks, capsys: pytest.CaptureFixture[str]
) -> None:
    looks.block = ""
    looks.show(LOOK)
    looks.block = "block-3-held-out"
    looks.show(LOOK)
    assert capsys.readouterr().err == ""


def test_what_is_missing_is_printed_once_in_a_block(
    looks: Looks, capsys: pytest.CaptureFixture[str]
) -> None:
    waiting = replace(LOOK, gains=[], missing="no payload")
    for move in (1, 2, 3):
        look = replace(waiting, move=move)
        looks.show(look)
    assert capsys.readouterr().err == "No gains yet: no payload.\n"


def test_a_check_that_fails_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    refused = BusError("virtual:127.0.0.1:29536", "Connection refused")
    refused.__cause__ = ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
    check_line = CheckLine("disk, interlock, drives", "", refused)
    lines = (CheckLine("cell file", "6 axes"), check_line)
    with pytest.raises(typer.Exit) as ended:
        show_check(lines)
    assert ended.value.exit_code == ExitCode.CONFIGURATION
    printed = capsys.readouterr().out
    first, failed, *parts = printed.splitlines()
    assert first == "✓ cell file: 6 axes"
    assert failed == "✗ disk, interlock, drives"
    expected = ["error", "found", "expected", "do"]
    assert [line.split(":")[0].strip() for line in parts] == expected
    assert "drivegain simulate demo" in parts[-1]
