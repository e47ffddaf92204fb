"""Signals that stop a recording."""

from __future__ import annotations

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from daq.cli.plan import say_how_to_resume
from daq.cli.record import _interrupted
from daq.cli.terminal import GRACE_S, SIGNALS, delay_signals, interruptible
from daq.errors import ExitCode
from drivers.errors import DriveFault


def test_signals_that_were_ignored_from_birth_are_heard_and_others_left_alone() -> None:
    """A script's & starts its commands deaf to SIGINT."""
    deaf = signal.signal(signal.SIGINT, signal.SIG_IGN)
    hangup = signal.getsignal(signal.SIGHUP)
    try:
        signals = (signal.SIGINT, signal.SIGTERM)
        with interruptible(signals=signals):
            assert signal.getsignal(signal.SIGHUP) == hangup
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, deaf)


def test_a_signal_during_a_write_counts_after_it_and_another_thread_may_write_too() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), delay_signals():
        signal.raise_signal(signal.SIGTERM)
        done.append("written")
    with ThreadPoolExecutor() as pool, delay_signals():
        pool.submit(_write_undisturbed, done).result()
    assert done == ["written", "elsewhere"]


def _write_undisturbed(done: list[str]) -> None:
    with delay_signals():
        done.append("elsewhere")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_interrupts_once_and_again_after_the_stop_had_its_time(
    number: signal.Signals,
) -> None:
    before = [signal.getsignal(each) for each in SIGNALS]
    now_s = 100.0
    with interruptible(lambda: now_s):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        now_s += GRACE_S / 2
        for impatient in SIGNALS:
            signal.raise_signal(impatient)
        now_s += GRACE_S
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_what_must_not_be_disturbed_is_not_for_as_long_as_a_stop_takes() -> None:
    now_s = 100.0
    with interruptible(lambda: now_s) as block_signals:
        with block_signals():
            signal.raise_signal(signal.SIGINT)  # the first of all: a fault began this stop
            now_s += GRACE_S / 2
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        now_s += GRACE_S + 1
        with block_signals():
            now_s += GRACE_S
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)  # a hanging stop can be left


@pytest.mark.parametrize("moves_again", [False, True])
def test_a_signal_at_the_end_of_a_good_run_stops_a_job_that_would_move_again(
    moves_again: bool,
) -> None:
    """It was dropped, and the job mounted the payload and recorded the next run."""
    now_s = 100.0
    went_on = False
    with interruptible(lambda: now_s, moves_again=moves_again) as block_signals:
        try:
            with block_signals() as asked_again:
                signal.raise_signal(signal.SIGTERM)
                assert asked_again is not None
                assert not asked_again()  # the settings are restored all the same
            went_on = True
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGTERM)  # the stop that has begun has its time
    assert went_on is not moves_again


def test_a_signal_during_a_stop_that_an_error_or_a_signal_has_begun_is_dropped() -> None:
    now_s = 100.0
    with interruptible(lambda: now_s, moves_again=True) as block_signals:
        with pytest.raises(DriveFault):
            try:
                raise DriveFault(3, "EMCY 7305h")
            finally:
                with block_signals():
                    signal.raise_signal(signal.SIGINT)
        now_s += 2 * GRACE_S
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with block_signals():
            signal.raise_signal(signal.SIGINT)


def test_a_second_signal_gives_up_restoring_and_one_key_is_one_signal() -> None:
    now_s = 100.0
    with interruptible(lambda: now_s) as block_signals:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with block_signals() as asked_again:
            assert asked_again is not None
            signal.raise_signal(signal.SIGTERM)  # by the shell, of the same key
            assert not asked_again()
            now_s += 1.0
            signal.raise_signal(signal.SIGINT)
            assert asked_again()


def test_what_is_not_known_to_rest_is_not_said_to() -> None:
    out = Path("run.mcap")
    assert "axes stopped" in _interrupted(KeyboardInterrupt(), None, out)
    fault = DriveFault(3, "EMCY 7305h")
    fault.add_note("while stopping: node 2 does not answer")
    stopping = KeyboardInterrupt()
    stopping.__context__ = fault
    assert "emergency" not in _interrupted(stopping, None, out)
    cut = KeyboardInterrupt()
    cut.add_note("not confirmed without power: J2 (node 2)")
    cut.__context__ = ValueError("in between")
    cut.__context__.__context__ = fault
    said = _interrupted(cut, None, out)
    assert "J2 (node 2) NOT CONFIRMED WITHOUT POWER, use the emergency stop" in said
    assert "EMCY 7305h" in said
    assert "node 2 does not answer" in said
    harmless = KeyboardInterrupt()
    harmless.__context__ = BlockingIOError()
    assert "axes stopped" in _interrupted(harmless, None, out)
    circle = KeyboardInterrupt()
    circle.__context__ = ValueError("in between")
    circle.__context__.__context__ = circle
    assert "axes stopped" in _interrupted(circle, None, out)


@pytest.mark.parametrize("module", ["daq.cli.app", "typer.core"])
def test_an_interrupt_while_the_command_is_imported_is_no_traceback(module: str) -> None:
    script = f"""
import signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored

def interrupt(event, given):
    if event == "import" and given[0] == {module!r}:
        signal.raise_signal(signal.SIGINT)

sys.addaudithook(interrupt)
from daq.cli import main
sys.exit(main(["explain-emcy", "--help"]))
"""  # noqa: E501
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    expected = (ExitCode.INTERRUPTED, "", "interrupted\n")
    assert (done.returncode, done.stdout, done.stderr) == expected


def test_an_interrupted_plan_says_how_to_get_what_it_had(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(KeyboardInterrupt), say_how_to_resume([0, 8, 16], 3000):
        raise KeyboardInterrupt
    assert capsys.readouterr().err == (
        "16 of 3000 exchanges were tried; --exchanges 16 writes their plan\n"
    )
    with pytest.raises(KeyboardInterrupt), say_how_to_resume([0], 3000):
        raise KeyboardInterrupt
    assert capsys.readouterr().err == ""
