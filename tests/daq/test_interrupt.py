"""Signals that stop a recording."""

from __future__ import annotations

import signal

import pytest

from daq.cli.interrupt import GRACE_S, SIGNALS, interruptible


def test_signals_that_were_ignored_from_birth_are_heard_and_others_left_alone() -> None:
    """A script's & starts its commands deaf to SIGINT."""
    deaf = signal.signal(signal.SIGINT, signal.SIG_IGN)
    hangup = signal.getsignal(signal.SIGHUP)
    try:
        with interruptible(signals=(signal.SIGINT, signal.SIGTERM)):
            assert signal.getsignal(signal.SIGHUP) == hangup
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, deaf)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_interrupts_once_and_again_after_the_stop_had_its_time(number: signal.Signals) -> None:
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
