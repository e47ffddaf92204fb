"""The sizes on the page on installing are those of the locked versions."""

from __future__ import annotations

import re

import pytest

from docs.sizes import PAGE, closure, megabytes, table

ROW = re.compile(r"^\| (.+) \| (\d+) \|$", re.MULTILINE)
ANOTHER_PYTHON = 0.25
"""Wheels of another version of Python or processor have other sizes."""


def shown_mb() -> dict[str, int]:
    """What the page says."""
    return {name: int(size) for name, size in ROW.findall(PAGE.read_text(encoding="utf-8"))}


@pytest.mark.parametrize(
    ("name", "wanted", "without"),
    [
        ("numpy and scipy, for `ident` alone", "numpy scipy", ""),
        ("`console` adds", "drivegain[console]", "drivegain"),
        ("`foxglove` adds", "drivegain[foxglove]", "drivegain"),
    ],
)
def test_a_size_of_the_page_is_that_of_this_environment(
    name: str, wanted: str, without: str
) -> None:
    added = closure(wanted.split()) - closure(without.split())
    assert shown_mb()[name] == pytest.approx(megabytes(added), rel=ANOTHER_PYTHON)


def test_the_needs_of_needs_are_counted_and_extras_are_not() -> None:
    assert closure(["scipy"]) == {"scipy", "numpy"}
    without = closure(["drivegain"])
    assert {"drivegain", "numpy", "mcap", "pydantic-core"} <= without
    assert not {"starlette", "pin"} & without
    assert {"starlette", "anyio"} <= closure(["drivegain[console]"])


def test_sizes_have_two_digits() -> None:
    assert table({"a": 412.3, "b": 4.9}).splitlines()[2:] == ["| a | 410 |", "| b | 5 |"]
