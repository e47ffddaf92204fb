"""`drivegain explain-emcy`."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.advice import for_command_line
from daq.cli.scan import read_code
from daq.errors import ExitCode
from drivers.canopen.emcy import remedy_of
from tests.daq.command_line import run_verb


@settings(deadline=None)
@given(st.integers(0, 0xFFFF))
def test_every_spelling_of_a_manual_is_the_same_code(code: int) -> None:
    for spelling in (f"{code:x}", f"{code:04X}", f"{code:04X}h", f"0x{code:x}", f" {code:X}H "):
        assert read_code(spelling) == code


@pytest.mark.parametrize(
    ("code", "words", "standard"),
    [
        ("8611", "following error", True),  # CiA 402-2
        ("0x2310", "continuous over-current", True),
        ("3210h", "over-voltage", True),
        ("8130", "heartbeat", True),  # CiA 301
        ("8613", "the maker's", False),
        ("FF01", "device specific", False),
    ],
)
def test_codes_of_the_standards_and_of_makers(
    capsys: pytest.CaptureFixture[str], code: str, words: str, standard: bool
) -> None:
    assert run_verb("explain-emcy", code) == ExitCode.OK
    assert words in capsys.readouterr().out
    assert run_verb("explain-emcy", code, "--json") == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    expected = (read_code(code), standard)
    assert (document["code"], document["standard"]) == expected
    assert words in document["text"]
    text = remedy_of(read_code(code))
    assert document["remedy"] == for_command_line(text)
    assert document["remedy"].endswith(
        "then reset the fault with `drivegain scan CELL --reset-faults`"
    )


@pytest.mark.parametrize("code", ["", "8g11", "12345", "-1", "0x", "eight"])
def test_what_is_no_code_is_refused(capsys: pytest.CaptureFixture[str], code: str) -> None:
    assert run_verb("explain-emcy", "--", code) == ExitCode.USAGE
    assert "hexadecimal" in capsys.readouterr().err
