"""The page of what trials of a field found: every line and case has a row,
and every test that is named exists.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/evidence/field.md").read_text(encoding="utf-8")
LINES = set(range(1, 40))
CASES_THAT_THE_FIELD_SENT = {
    *range(1, 8),
    *range(10, 14),
    *range(15, 18),
    19,
    22,
    23,
    25,
    26,
    28,
    *range(31, 34),
    35,
    36,
    *range(38, 41),
    *range(42, 45),
}
NAMED = re.compile(r"`(tests/[\w/]+\.py)::([\w:]+)`")


@cache
def _tests_of(file: str) -> frozenset[str]:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    names = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            for method in node.body:
                if isinstance(method, ast.FunctionDef):
                    names.add(f"{node.name}::{method.name}")
    return frozenset(names)


def _rows(text: str) -> list[tuple[int, str]]:
    """Number and tests of each row."""
    rows = []
    for line in text.splitlines():
        row = re.fullmatch(r"\| (\d+) \| .* \| .* \| (.*) \|", line)
        if row is not None:
            rows.append((int(row[1]), row[2]))
    return rows


def test_every_test_that_is_named_exists() -> None:
    named = NAMED.findall(PAGE)
    assert len(named) > 150
    for file, name in named:
        assert name.rpartition("::")[2].startswith("test_"), name
        assert (ROOT / file).is_file(), file
        assert name in _tests_of(file), f"{file} has no {name}"


def test_every_line_and_every_case_has_a_row_with_a_test() -> None:
    lines, _, cases = PAGE.partition("## Small inputs")
    for text, numbers in ((lines, LINES), (cases, CASES_THAT_THE_FIELD_SENT)):
        rows = _rows(text)
        assert {number for number, _ in rows} == numbers
        for number, tests in rows:
            assert NAMED.search(tests) is not None, f"row {number}"
