"""Which tests execute a line of the product:
measured once, by one run of the tests under coverage.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import coverage

from tests.mutation.contexts import DURATIONS_VARIABLE
from tests.studies.output import print_line

FAST = "not processes and not slow"
"""Tests of `make test`: those that a developer runs."""


NOT_OF_BEHAVIOUR = ("contracts", "data", "mutation", "pages", "vcan")
"""Folders of tests that judge sources and pages, or need a bus that is not on every machine."""


@dataclass(frozen=True, slots=True)
class CoverageMap:
    """Tests that execute each line of the product.

    Attributes
    ----------
    data : coverage's recordings, with one context a test.
    durations_s : duration of each test.
    tree : root of the tree that was measured.

    """

    data: coverage.CoverageData
    durations_s: dict[str, float]
    tree: Path

    def tests_of(self, file: str, line: int) -> tuple[str, ...]:
        """Tests that execute a line, the fastest first;
        none where it runs at import or in other processes only.
        """
        contexts = self.data.contexts_by_lineno(str(self.tree / file)).get(line, [])
        tests = [context for context in contexts if context]
        return tuple(sorted(tests, key=lambda test: self.durations_s.get(test, 0.0)))

    def runs_at_import(self, file: str, line: int) -> bool:
        """Whether a line is executed outside of all tests:
        what it makes is used by tests that do not execute it.
        """
        return "" in self.data.contexts_by_lineno(str(self.tree / file)).get(line, [])


def measured_map(tree: Path, folder: Path, jobs: int) -> CoverageMap:
    """Run the tests of a tree under coverage, once for each of their rooms;
    a room that was measured is not run again.

    Raises
    ------
    RuntimeError : where tests of a room fail without any fault planted.

    """
    folder.mkdir(parents=True, exist_ok=True)
    rooms = test_rooms(tree)
    with ThreadPoolExecutor(jobs) as pool:
        for room in pool.map(lambda room: _measure(tree, folder, room), rooms):
            print_line(f"coverage: {room}")
    data = coverage.CoverageData(basename=str(folder / "all.sqlite"))
    durations: dict[str, float] = {}
    for room in rooms:
        measured = coverage.CoverageData(basename=str(_data_file(folder, room)))
        measured.read()
        data.update(measured)
        durations.update(json.loads(_durations_file(folder, room).read_text()))
    return CoverageMap(data, durations, tree)


def test_rooms(tree: Path) -> tuple[str, ...]:
    """Folders of tests two levels deep, such as `tests/ident/model`, and files between them."""
    rooms: list[str] = []
    for package in sorted((tree / "tests").iterdir()):
        if not package.is_dir() or package.name in NOT_OF_BEHAVIOUR:
            continue
        rooms.extend(_rooms_of(tree, package))
    return tuple(rooms)


def _rooms_of(tree: Path, package: Path) -> Iterator[str]:
    folders = [folder for folder in sorted(package.iterdir()) if any(folder.glob("test_*.py"))]
    yield from (str(folder.relative_to(tree)) for folder in folders)
    yield from (str(file.relative_to(tree)) for file in sorted(package.glob("test_*.py")))


def _data_file(folder: Path, room: str) -> Path:
    return folder / f"{room.replace('/', '-')}.sqlite"


def _durations_file(folder: Path, room: str) -> Path:
    return folder / f"{room.replace('/', '-')}.durations.json"


NO_TESTS_WERE_COLLECTED = 5


def _measure(tree: Path, folder: Path, room: str) -> str:
    durations = _durations_file(folder, room)
    if durations.exists():
        return f"{room}: measured before"
    data = _data_file(folder, room)
    environment = environment_of(tree)
    environment["COVERAGE_FILE"] = str(data)
    environment[DURATIONS_VARIABLE] = str(durations.with_suffix(".part"))
    sources = ",".join(str(tree / package) for package in ("daq", "ident", "drivers"))
    command = [sys.executable, "-m", "coverage", "run", f"--source={sources}", "--rcfile=/dev/null"]
    command += [
        "-m",
        "pytest",
        "-q",
        "-p",
        "tests.mutation.contexts",
        "-p",
        "no:cacheprovider",
        "-m",
        FAST,
        room,
    ]
    done = subprocess.run(
        command, cwd=tree, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, NO_TESTS_WERE_COLLECTED):
        raise RuntimeError(
            f"without any fault, tests of {room} "
            f"fail:\n{done.stdout[-3000:]}\n{done.stderr[-1000:]}"
        )
    durations.with_suffix(".part").rename(durations)
    return room


def environment_of(tree: Path) -> dict[str, str]:
    """Environment in which the tests import the product from a tree."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = str(tree)
    environment["OMP_NUM_THREADS"] = "1"
    return environment
