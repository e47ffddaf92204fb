"""Libraries know no command line, front doors open, and no name is defined twice."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import daq
import drivers
import ident
from daq.cli.app import ALIASES, VERBS

ROOT = Path(__file__).parents[2]
OPTION = re.compile(r"(?<![\w-])--[a-z]")
VERB = re.compile(rf"drivegain ({'|'.join((*(verb.name for verb in VERBS), *ALIASES))})\b")


def _strings(code: str) -> Iterator[str]:
    """Every string of a module, docstrings and the fixed parts of f-strings among them."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _commands(code: str) -> list[str]:
    """Strings of a module that name a verb or an option."""
    return [text for text in _strings(code) if OPTION.search(text) or VERB.search(text)]


@pytest.mark.parametrize(
    ("code", "is_found"),
    [
        ('raise ValueError("pass --known")', True),
        ('f"{name}: `drivegain fit` wrote it"', True),
        ('"""Read by `drivegain certificate`."""', True),
        ('"""Read by `drivegain report`."""', True),
        ('"a drivegain simulated amplifier"', False),
        ('"from -- to, a--b, -1"', False),
    ],
)
def test_a_verb_or_an_option_is_found(code: str, is_found: bool) -> None:
    assert bool(_commands(code)) == is_found


@pytest.mark.parametrize("package", ["ident", "drivers"])
def test_no_string_of_a_library_names_the_command_line(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    found = {str(file.relative_to(ROOT)): _commands(file.read_text()) for file in files}
    assert {file: texts for file, texts in found.items() if texts} == {}


@pytest.mark.parametrize("package", [daq, drivers, ident])
def test_every_name_of_a_front_door_is_there(package: ModuleType) -> None:
    missing: list[str] = []
    for name in package.__all__:
        try:
            getattr(package, name)
        except (ImportError, AttributeError):
            missing.append(name)
    assert missing == []


SAME_NAME = {
    "main": "`daq.cli` imports no typer before the program runs, and then `daq.cli.app`",
    "calibration_of": "front doors: of an identification in `ident`, of a fit of logs in `daq`",
}
"""Names that two modules define, with the reason."""


def _defined(code: str) -> Iterator[str]:
    """Classes and public functions of a module."""
    for node in ast.parse(code).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            is_private = node.name.startswith("_")
            if isinstance(node, ast.ClassDef) or not is_private:
                yield node.name


def test_no_class_or_public_function_is_defined_twice() -> None:
    """An independent simulator (`drivers.simulation`) may have its own."""
    modules: dict[str, list[str]] = {}
    for package in ("daq", "drivers", "ident"):
        files = (ROOT / package).rglob("*.py")
        for file in sorted(files):
            where = str(file.relative_to(ROOT))
            if not where.startswith("drivers/simulation/"):
                for name in _defined(file.read_text()):
                    modules.setdefault(name, []).append(where)
    twice = {name: found for name, found in modules.items() if len(found) > 1}
    assert {name: found for name, found in twice.items() if name not in SAME_NAME} == {}
    difference = set(SAME_NAME) - set(twice)
    assert sorted(difference) == []
