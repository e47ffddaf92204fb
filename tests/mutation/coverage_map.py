"""Which tests execute a line of the product:
measured once, by one run of the tests under coverage.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import coverage

from tests.mutation.contexts import DURATIONS_VARIABLE
from tests.studies.output import print_line

IN_ONE_PROCESS = "not processes"
"""Tests of `make test` and `make test-slow`, which every change must pass."""


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
        """Tests that execute a line; none where it runs at import or in other processes only."""
        return _tests_among(self._contexts(file).get(line, []))

    def executes(self, file: str, line: int) -> bool:
        """Whether a line is executed at all, by a test or at import."""
        return line in self._contexts(file)

    def tests_that_could_notice(self, file: str, line: int) -> tuple[str, ...]:
        """Tests that execute a line or use what it makes.

        What is made at import is used where its name is read. A line that no test executes may be
        executed by another process, which a test of the same file starts.
        """
        contexts = self._contexts(file)
        executing = contexts.get(line, [])
        if executing and "" not in executing:
            return _tests_among(executing)
        found: set[str] = set()
        source = (self.tree / file).read_text()
        for reader in lines_that_read(source, line):
            found.update(contexts.get(reader, []))
        if not _tests_among(found):
            for of_line in contexts.values():
                found.update(of_line)
        return _tests_among({*found, *executing})

    def duration_s(self, tests: Iterable[str]) -> float:
        """Sum of the durations of tests."""
        return sum(self.durations_s.get(test, 1.0) for test in tests)

    def cheapest_files(self, tests: Iterable[str], stem: str) -> tuple[str, ...]:
        """Files of tests: the one that is named after a module first, then the cheapest.

        Tests of a file share fixtures, so they are not torn apart.
        """
        cost_s: dict[str, float] = {}
        for test in tests:
            file = test.split("::")[0]
            cost_s[file] = cost_s.get(file, 0.0) + self.durations_s.get(test, 1.0)
        return tuple(
            sorted(cost_s, key=lambda file: (Path(file).stem != f"test_{stem}", cost_s[file]))
        )

    def affordable(self, tests: list[str], limit_s: float) -> list[str]:
        """Tests of the cheapest files that take a time together."""
        chosen: list[str] = []
        spent_s = 0.0
        for file in self.cheapest_files(tests, ""):
            of_file = [test for test in tests if test.split("::")[0] == file]
            spent_s += self.duration_s(of_file)
            if chosen and spent_s > limit_s:
                break
            chosen.extend(of_file)
        return chosen

    def _contexts(self, file: str) -> dict[int, list[str]]:
        return self.data.contexts_by_lineno(str(self.tree / file))


def _tests_among(contexts: Iterable[str]) -> tuple[str, ...]:
    """Names of tests; the empty context is what runs at import."""
    return tuple(sorted(context for context in contexts if context))


def lines_that_read(source: str, line: int) -> tuple[int, ...]:
    """Lines of a module that read a name which one of its statements assigns.

    Parameters
    ----------
    source : source of the module.
    line : line within an assignment, counted from 1.

    """
    tree = ast.parse(source)
    names: set[str] = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        assert node.end_lineno is not None
        if node.lineno <= line <= node.end_lineno:
            names.update(_assigned_names(node))
    readers: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) and node.id in names:
            readers.add(node.lineno)
        if isinstance(node, ast.Attribute) and node.attr in names:
            readers.add(node.lineno)
    return tuple(sorted(readers))


def _assigned_names(node: ast.Assign | ast.AnnAssign) -> Iterator[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    for target in targets:
        for part in ast.walk(target):
            if isinstance(part, ast.Name):
                yield part.id


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
        measured.close()
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
        IN_ONE_PROCESS,
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
