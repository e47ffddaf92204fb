"""Faults that the mutation study plants:
what they are, where they stand, and which tests it runs.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from coverage import CoverageData

from tests.mutation.coverage_map import (
    CoverageMap,
    lines_that_read,
)
from tests.mutation.mutants import Mutant, compiles, mutants_of
from tests.mutation.study import Outcome, chosen_mutants, mirrored, room_of, summary

ROOT = Path(__file__).resolve().parents[2]


def _planted(source: str) -> set[tuple[str, str]]:
    """Kind and changed source of every mutant."""
    data = source.encode()
    return {(mutant.kind, mutant.planted(data).decode()) for mutant in mutants_of(data)}


@pytest.mark.parametrize(
    ("source", "kind", "changed"),
    [
        ("a < b\n", "comparison", "a <= b\n"),
        ("a is not None\n", "comparison", "a is None\n"),
        ("a not in b\n", "comparison", "a in b\n"),
        ("x = a - b\n", "arithmetic", "x = a + b\n"),
        ("x = a ** b\n", "arithmetic", "x = a * b\n"),
        ("x = a or b\n", "connective", "x = a and b\n"),
        ("x = not a\n", "not", "x = a\n"),
        ("x = -a\n", "sign", "x = a\n"),
        ("x = 3\n", "constant", "x = 4\n"),
        ("x = 0.5\n", "constant", "x = 1.0\n"),
        ("x = True\n", "constant", "x = False\n"),
        ("x = a[1:n]\n", "slice", "x = a[:n]\n"),
        ("x = np.minimum(a, b)\n", "function", "x = np.maximum(a, b)\n"),
        ("x = f(a, b)\n", "arguments", "x = f(b, a)\n"),
        ("if a:\n    f()\n", "condition", "if not (a):\n    f()\n"),
        ("if a:\n    f()\n", "call", "if a:\n    pass\n"),
        ("def f():\n    return a\n", "return", "def f():\n    return None\n"),
        ("def f():\n    raise E\n", "raise", "def f():\n    pass\n"),
        ("for a in b:\n    break\n", "loop", "for a in b:\n    continue\n"),
        ("x = 'é' + f(a * b)\n", "arithmetic", "x = 'é' + f(a / b)\n"),
    ],
)
def test_a_fault_of_each_kind_is_planted_at_its_place(source: str, kind: str, changed: str) -> None:
    assert (kind, changed) in _planted(source)


@pytest.mark.parametrize(
    "source",
    [
        '"""A docstring with 3 < 4."""\n',
        "def f(a: dict[str, 3]) -> 4: ...\n",
        "x = f'{a - b}'\n",
        "__all__ = ['a', 'b']\n",
        "if TYPE_CHECKING:\n    x = 3\n",
        "@f(3)\nclass A: ...\n",
        "x = math.isclose(a, b)\n",
    ],
)
def test_what_is_no_behaviour_gets_no_fault(source: str) -> None:
    assert _planted(source) == set()


@pytest.mark.slow
def test_every_fault_changes_the_program_of_a_real_file() -> None:
    source = (ROOT / "ident" / "arrays.py").read_bytes()
    original = ast.dump(ast.parse(source))
    mutants = [mutant for mutant in mutants_of(source) if compiles(mutant.planted(source))]
    assert len(mutants) > 50
    for mutant in mutants:
        assert ast.dump(ast.parse(mutant.planted(source))) != original, mutant
        assert source[: mutant.start].count(b"\n") + 1 == mutant.line


@pytest.mark.slow
def test_a_draw_is_repeated_by_its_seed_and_takes_every_room() -> None:
    first = chosen_mutants(ROOT, seed=5, count=60)
    again = chosen_mutants(ROOT, seed=5, count=60)
    other = chosen_mutants(ROOT, seed=6, count=60)
    assert first == again
    assert first != other
    rooms = {room_of(planted.file) for planted in first}
    assert {"ident/model", "daq/log", "drivers/stream", "ident"} <= rooms
    assert len(set(first)) == 60


@pytest.mark.parametrize(
    ("test", "file", "expected"),
    [
        ("tests/ident/model/test_base.py::test_a", "ident/model/base.py", True),
        ("tests/ident/data/test_run.py::test_a", "ident/model/base.py", False),
        ("tests/ident/test_weighing.py::test_a[1/2]", "ident/weighing.py", True),
        ("tests/ident/model/test_base.py::test_a", "ident/weighing.py", False),
        ("tests/pipeline/test_main_job.py::test_a", "daq/jobs/session.py", False),
    ],
)
def test_a_mirrored_test_stands_in_the_room_of_the_file(
    test: str, file: str, expected: bool
) -> None:
    assert mirrored(test, file) is expected


def test_the_summary_counts_what_was_missed_by_room() -> None:
    results = ["mirrored", "other", "survived", "not executed"]
    outcomes = [
        Outcome(number, "ident/model/base.py", 1, "sign", "-a", "a", result, "")
        for number, result in enumerate(results)
    ]
    lines = list(summary(outcomes))
    assert len(lines) == 2
    assert lines[0].startswith("ident/model ")
    assert lines[-1].startswith("all rooms ")
    assert "4 mutants, noticed    2, by the mirrored tests    1, missed 2" in lines[-1]


def test_a_planted_fault_can_be_taken_out_again() -> None:
    source = b"x = a < b\n"
    mutant = next(iter(mutants_of(source)))
    assert mutant == Mutant("comparison", 1, 6, 7, "<", "<=")
    assert mutant.planted(source) == b"x = a <= b\n"


@pytest.fixture
def nothing_recorded(tmp_path: Path) -> Iterator[CoverageMap]:
    """Coverage of no file, in memory."""
    data = CoverageData(no_disk=True)
    yield CoverageMap(data, {}, tmp_path)
    data.close(force=True)


def _recorded(empty: CoverageMap, source: str, executed: dict[str, list[int]]) -> CoverageMap:
    """Coverage of one file by tests; the empty name is what runs at import."""
    file = empty.tree / "a.py"
    file.write_text(source)
    for test, lines in executed.items():
        empty.data.set_context(test)
        empty.data.add_lines({str(file): lines})
    return replace(empty, durations_s={"tests/x/test_a.py::one": 3.0})


SOURCE = """LIMIT = 3
TABLE = {
    1: LIMIT,
}
def f(x):
    return x < LIMIT
def g(x):
    return TABLE[x]
"""


def test_lines_that_read_a_name_are_those_of_its_assignment() -> None:
    assert lines_that_read(SOURCE, 1) == (3, 6)
    assert lines_that_read(SOURCE, 3) == (8,)
    assert lines_that_read(SOURCE, 6) == ()


def test_a_constant_is_tried_with_the_tests_that_read_it(nothing_recorded: CoverageMap) -> None:
    executed = {"": [1, 2, 3, 5, 7], "tests/x/test_a.py::one": [6], "tests/y/test_b.py::two": [8]}
    covered = _recorded(nothing_recorded, SOURCE, executed)
    assert covered.tests_that_could_notice("a.py", 1) == ("tests/x/test_a.py::one",)
    assert covered.tests_that_could_notice("a.py", 3) == ("tests/y/test_b.py::two",)
    assert covered.tests_that_could_notice("a.py", 6) == ("tests/x/test_a.py::one",)
    # Nothing reads what line 5 makes by name, so every test of the file is tried.
    assert len(covered.tests_that_could_notice("a.py", 5)) == 2


def test_a_line_that_nothing_executes_is_tried_with_the_tests_of_its_file(
    nothing_recorded: CoverageMap,
) -> None:
    executed = {"": [1, 2, 3, 5, 7], "tests/x/test_a.py::one": [6]}
    covered = _recorded(nothing_recorded, SOURCE, executed)
    assert not covered.executes("a.py", 8)
    assert covered.executes("a.py", 1)
    assert covered.tests_that_could_notice("a.py", 8) == ("tests/x/test_a.py::one",)


def test_the_file_named_after_a_module_comes_first_and_then_the_cheapest(
    nothing_recorded: CoverageMap,
) -> None:
    durations = {
        "tests/x/test_dear.py::one": 3.0,
        "tests/x/test_dear.py::two": 3.0,
        "tests/x/test_cheap.py::one": 4.0,
        "tests/x/test_own.py::one": 9.0,
    }
    covered = replace(nothing_recorded, durations_s=durations)
    order = ["tests/x/test_own.py", "tests/x/test_cheap.py", "tests/x/test_dear.py"]
    assert list(covered.cheapest_files(durations, "own")) == order
    assert covered.affordable(list(durations), 10.0) == [
        "tests/x/test_cheap.py::one",
        "tests/x/test_dear.py::one",
        "tests/x/test_dear.py::two",
    ]
    # However dear it is, one file is tried.
    assert covered.affordable(list(durations), 1.0) == ["tests/x/test_cheap.py::one"]
