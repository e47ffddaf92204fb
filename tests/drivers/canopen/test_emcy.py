"""The texts of error codes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.emcy import CODES, describe_error_code, remedy_of


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8611, "following error"),
        (0x8130, "life guard error or heartbeat error"),
        (0x2310, "continuous over-current at the output"),
        (0x7305, "incremental sensor 1 fault"),
        (0x231F, "continuous over-current at the output (this code is the maker's)"),
        (0x73A7, "sensor (this code is the maker's)"),
        (0xA123, "reserved (this code is the maker's)"),
        (0xFF01, "device specific, see the drive's manual"),
    ],
)
def test_a_code_has_the_text_of_its_standard_or_of_its_class(code: int, text: str) -> None:
    assert describe_error_code(code) == text


@given(st.integers(0, 0xFFFF))
def test_every_code_says_something(code: int) -> None:
    assert describe_error_code(code)
    assert (describe_error_code(code) == CODES.get(code)) == (code in CODES)


def test_every_code_has_a_remedy_of_its_class() -> None:
    assert remedy_of(0x7305).startswith(
        "check the plugs and cables of encoder and brake; then reset the fault"
    )
    assert remedy_of(0x8611).startswith("check brake, load and collision")
    assert remedy_of(0x8130).startswith("check the bus's cable")
    assert remedy_of(0xFF01).startswith("see the drive's manual")
    faults = [code for code in CODES if code > 0x00FF]
    for code in faults:
        assert "`CanopenNetwork.reset_faults`" in remedy_of(code)


@pytest.mark.parametrize("code", [0x0000, 0x0001, 0x00FF])
def test_a_code_of_no_error_asks_for_nothing(code: int) -> None:
    assert remedy_of(code) == "nothing: the drive reports no error"


def test_the_class_after_no_error_still_asks_for_a_reset() -> None:
    assert "reset the fault" in remedy_of(0x1000)
