"""The sizes on the page on installing are those of the locked versions."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from docs.sizes import EXTRAS, PAGE, closure, megabytes, table

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


def test_every_extra_has_a_size_and_a_use_on_the_page() -> None:
    extras = {f"`{name}`" for name in EXTRAS}
    sizes = {name.removesuffix(" adds") for name in shown_mb()}
    assert extras <= sizes
    uses = re.findall(r"^\| (`[a-z0-9]+`) \| `", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert set(uses) == extras


def test_an_extra_is_in_the_lock_so_that_its_tests_run(checkout: Path) -> None:
    lock = (checkout / "requirements.lock").read_text(encoding="utf-8")
    locked = {canonicalize_name(name) for name in re.findall(r"(?m)^([\w.-]+)==", lock)}
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for extra, needed in project["optional-dependencies"].items():
        for text in needed:
            assert canonicalize_name(Requirement(text).name) in locked, extra


def test_the_needs_of_needs_are_counted_and_extras_are_not() -> None:
    assert closure(["scipy"]) == {"scipy", "numpy"}
    without = closure(["drivegain"])
    assert {"drivegain", "numpy", "mcap", "pydantic-core"} <= without
    assert not {"starlette", "pin"} & without
    assert {"starlette", "anyio"} <= closure(["drivegain[console]"])


def test_sizes_have_two_digits() -> None:
    assert table({"a": 412.3, "b": 4.9}).splitlines()[2:] == ["| a | 410 |", "| b | 5 |"]
