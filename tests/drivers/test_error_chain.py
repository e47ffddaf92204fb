"""Errors and the errors behind them: foreign ones cannot be compared, and chains may be cycles."""

from __future__ import annotations

from canopen.sdo.exceptions import SdoAbortedError

from drivers.errors import (
    DriverError,
    ObjectAccessError,
    all_notes,
    error_chain,
    stop_notes,
    text_of,
)

ABORT_READ_ONLY = 0x0601_0002


class Unwritable(Exception):
    """A foreign error whose text fails."""

    def __str__(self) -> str:
        raise ValueError("no text")


def test_a_chain_with_sdo_aborts_has_every_error_once() -> None:
    """canopen compares the abort code of an error with that of anything, which has none."""
    abort = SdoAbortedError(ABORT_READ_ONLY)
    again = SdoAbortedError(ABORT_READ_ONLY)
    access = ObjectAccessError(2, "1A00h:00", "aborted", ABORT_READ_ONLY)
    access.__cause__ = abort
    abort.__context__ = again
    chain = error_chain(access)
    expected = [id(access), id(abort), id(again)]
    assert [id(error) for error in chain] == expected


def test_a_chain_that_is_a_cycle_ends() -> None:
    first = DriverError("first")
    second = DriverError("second")
    first.__cause__ = second
    second.__context__ = first
    second.__cause__ = second
    assert error_chain(first) == (first, second)
    assert error_chain(None) == ()


def test_the_notes_of_a_stop_are_found_behind_a_later_error() -> None:
    later = DriverError("the disk is full")
    cause = DriverError("node 2 is in fault")
    later.__context__ = cause
    for note in (
        "while stopping: node 2 does not answer",
        "not confirmed without power: J2",
        "hint: look",
    ):
        cause.add_note(note)
    later.add_note("not confirmed without power: J2")
    confirmed = ("not confirmed without power: J2", "while stopping: node 2 does not answer")
    assert stop_notes(later) == confirmed
    assert all_notes(later) == (*confirmed, "hint: look")


def test_an_error_whose_text_fails_has_none() -> None:
    assert text_of(Unwritable()) == ""
    assert text_of(DriverError("a fault")) == "a fault"
