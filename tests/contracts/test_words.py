"""The counter behind `make words`: identifiers, broken lines and docstrings count,
technical words do not. The glossary is true."""

from __future__ import annotations

import re

import pytest

from tests.words import BASELINE, DOCSTRING, PHRASES, ROOT, Source, count, working_tree


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("x = told_of(DIGITS_OF_TOLD_PEAK)", {"told": 2}),
        ("class Telling: ...", {"tell, tells, telling": 1}),
        ('raise Refused("the newest backup takes "\n    f"{name} back")', {"take … back": 1}),
        ("# a gate\n# is closed", {"closed gate": 1}),
        ("undo = plan_the_way_back()", {"way back": 1}),
        ("it stands in the file", {"stand, stands, stood, standing": 1}),
        (
            "standstill standard_rows standalone stand-alone: the joint stands still; understand, "
            "outstanding",
            {},
        ),
        ("import drivers.stranger", {"stranger": 1}),
        ("Deed.APPLIED, the_doer", {"deed, doer": 2}),
        ("retold, gates are checked, the bus is closed, garbage collection", {}),
    ],
)
def test_phrases_are_counted_in_identifiers_and_over_lines(
    text: str, found: dict[str, int]
) -> None:
    source = Source.of("daq/x.txt", text)
    counted = {phrase.name: len(list(phrase.found_in(source))) for phrase in PHRASES}
    assert {name: number for name, number in counted.items() if number} == found


def test_docstrings_are_found_by_their_first_word() -> None:
    text = (
        '"""Of a module."""\ndef f():\n    """What it does."""\ndef g():\n    """Office '
        'hours."""\n    return "What"\n'
    )
    odd_docstrings = Source.of("daq/x.py", text).odd_docstrings()
    assert list(odd_docstrings) == ["Of a module.", "What it does."]


def test_the_name_of_a_file_counts() -> None:
    sources = iter([Source.of("tests/test_looked_at.py", "")])
    looked_at = count(sources)["looked_at"]
    assert looked_at == [0, 1, 0]


def test_old_words_that_the_changelog_quotes_do_not_count() -> None:
    text = "- `told_of` is now `records_of`; it told the time"
    sources = iter([Source.of("CHANGELOG.md", text)])
    assert count(sources)["told"] == [0, 0, 1]


def test_the_baseline_has_every_phrase() -> None:
    expected = {*(phrase.name for phrase in PHRASES), DOCSTRING}
    assert set(BASELINE) == expected


def test_the_working_tree_is_read() -> None:
    paths = {source.path for source in working_tree()}
    assert {"README.md", "Makefile", "daq/__init__.py", "tests/conftest.py"} <= paths
    assert not {"LICENSE", "tests/words.py"} & paths


def test_every_identifier_of_the_glossary_is_in_the_code() -> None:
    files = (
        file for folder in ("daq", "ident", "drivers") for file in (ROOT / folder).rglob("*.py")
    )
    code = {name for file in files for name in re.findall(r"\w+", file.read_text())} | {
        "daq",
        "drivers",
    }
    glossary_path = ROOT / "docs" / "glossary.md"
    text = glossary_path.read_text()
    rows = re.findall(r"^\|.*\| (`.*`) \|$", text, re.MULTILINE)
    named = set()
    for row in rows:
        for name in re.findall(r"`([^`]+)`", row):
            named.add(name)
    assert len(named) > 100
    assert sorted(name for name in named if not set(name.split(".")) <= code) == []
